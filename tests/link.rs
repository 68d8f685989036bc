//! The link, as a host and a bad line treat it: every whole request has one answer, and nothing else has any.

mod common;

use common::{controls, every_name, names, parameters, with_control};
use host_sim::commission_bench::Bench;
use host_sim::scoreboard::motors::Machine;
use proptest::prelude::*;
use quasidrive::commission::{Evidence, Nameplate, NoLoad, Phase, Progress};
use quasidrive::config::ConfigError;
use quasidrive::control::ControlConfig;
use quasidrive::fault::{ActiveLimits, Fault, Faults};
use quasidrive::link::frame::{Decoder, LONGEST, encode};
use quasidrive::link::message::{
    Answer, Identity, Message, Numbered, Refusal, Request, Status, Telemetry, VERSION,
};
use quasidrive::link::session::{Device, Session};
use quasidrive::parameters::Parameters;
use quasidrive::schema::{LONGEST_PATH, Value};
use quasidrive::supervisor::{Command, Mode};

/// A drive that only remembers what it was told.
struct Recorder {
    mode: Mode,
    parameters: Parameters,
    commands: Vec<Command>,
    told: Vec<&'static str>,
    telemetry: Vec<Telemetry>,
    evidence: Option<Evidence>,
    refusal: Option<Refusal<'static>>,
}

impl Recorder {
    fn new(mode: Mode) -> Self {
        Self {
            mode,
            parameters: parameters(),
            commands: Vec::new(),
            told: Vec::new(),
            telemetry: Vec::new(),
            evidence: None,
            refusal: None,
        }
    }

    fn done(&mut self, what: &'static str) -> Result<(), Refusal<'static>> {
        self.told.push(what);
        self.refusal.map_or(Ok(()), Err)
    }
}

impl Device for Recorder {
    fn identity(&self) -> Identity<'static> {
        Identity { version: VERSION, board: "a board", firmware: "1.2.3", build: "0123abc" }
    }

    fn status(&self) -> Status {
        Status { mode: self.mode, faults: Faults(u32::MAX), limits: ActiveLimits(u32::MAX) }
    }

    fn parameters(&self) -> &Parameters {
        &self.parameters
    }

    fn command(&mut self, command: Command) -> Result<(), Refusal<'static>> {
        self.commands.push(command);
        if command == Command::KeepAlive { Ok(()) } else { self.done("command") }
    }

    fn change_controller(&mut self, control: &ControlConfig) -> Result<(), Refusal<'static>> {
        self.parameters.drive.control = *control;
        self.done("change")
    }

    fn change_parameters(&mut self, parameters: &Parameters) -> Result<(), Refusal<'static>> {
        self.parameters = *parameters;
        self.done("write")
    }

    fn save_parameters(&mut self) -> Result<(), Refusal<'static>> {
        self.done("save")
    }

    fn commission(&mut self, nameplate: &Nameplate) -> Result<(), Refusal<'static>> {
        assert_eq!(*nameplate, NAMEPLATE);
        self.done("commission")
    }

    fn progress(&self) -> Progress {
        Progress { phase: Phase::Long, share: 0.25 }
    }

    fn evidence(&mut self) -> Option<Evidence> {
        self.evidence
    }

    fn set_telemetry(&mut self, decimation: u32) {
        assert_eq!(decimation, 7);
        self.told.push("telemetry");
    }

    fn next_telemetry(&mut self) -> Option<Telemetry> {
        self.telemetry.pop()
    }
}

const NAMEPLATE: Nameplate = Nameplate {
    voltage: Some(24.0),
    no_load_speed: None,
    counts_per_turn: Some(-4096),
    current: Some(5.0),
    speed: Some(300.0),
    travel: None,
};

/// Of a motor that was measured to the end: all that there can be.
fn evidence() -> Evidence {
    let bench = Bench::machine(&Machine::PAPER, 4096);
    let mut config = bench.config();
    config.no_load = Some(NoLoad { speed: 390.0, voltage: 24.0 });
    let mut evidence = None;
    bench.run_with(&config, |commission, _| evidence = Some(commission.evidence()));
    evidence.expect("played")
}

fn frame(sequence: u16, request: Request) -> Vec<u8> {
    bytes(&Numbered { sequence, request })
}

fn bytes(message: &impl serde::Serialize) -> Vec<u8> {
    encode(message, &mut [0; LONGEST]).expect("fits").to_vec()
}

/// The messages in a stream.
fn decode(decoder: &mut Decoder, stream: &[u8]) -> Vec<Vec<u8>> {
    stream.iter().filter_map(|byte| decoder.feed(*byte).map(<[u8]>::to_vec)).collect()
}

/// Shows a session's answers to a stream to `each`; gives their number.
fn answers(
    session: &mut Session,
    device: &mut Recorder,
    stream: &[u8],
    mut each: impl FnMut(u16, Answer),
) -> usize {
    let mut count = 0;
    for byte in stream {
        let Some(frame) = session.receive(*byte, device).map(<[u8]>::to_vec) else { continue };
        let messages = decode(&mut Decoder::new(), &frame);
        assert_eq!(messages.len(), 1, "one frame holds one message");
        match postcard::from_bytes(&messages[0]).expect("a message") {
            Message::Answer { sequence, answer } => each(sequence, answer),
            Message::Telemetry(_) => unreachable!("nobody asked"),
        }
        count += 1;
    }
    count
}

/// The answer to one request.
fn ask(device: &mut Recorder, request: Request, check: impl FnOnce(Answer)) {
    ask_in(&mut Session::default(), device, request, check);
}

/// The same in a conversation.
fn ask_in(
    session: &mut Session,
    device: &mut Recorder,
    request: Request,
    check: impl FnOnce(Answer),
) {
    let mut check = Some(check);
    let count = answers(session, device, &frame(0x1234, request), |sequence, answer| {
        assert_eq!(sequence, 0x1234);
        check.take().expect("one answer")(answer);
    });
    assert_eq!(count, 1);
}

/// Stages values, each of which must be taken.
fn stage(session: &mut Session, device: &mut Recorder, values: &[(&str, Value)]) {
    for &(name, value) in values {
        let request = Request::StageParameter { name, value };
        ask_in(session, device, request, |answer| assert_eq!(answer, Answer::Done, "{name}"));
    }
}

#[test]
fn every_request_has_its_answer() {
    let mut device = Recorder::new(Mode::Ready);
    let identity = device.identity();
    ask(&mut device, Request::Identify, |answer| assert_eq!(answer, Answer::Identity(identity)));
    let status = device.status();
    ask(&mut device, Request::Status, |answer| assert_eq!(answer, Answer::Status(status)));
    for request in
        [Request::SetTelemetry(7), Request::SaveParameters, Request::Command(Command::Arm)]
    {
        ask(&mut device, request, |answer| assert_eq!(answer, Answer::Done));
    }
    assert_eq!(device.told, ["telemetry", "save", "command"]);
}

#[test]
fn parameters_are_read_one_by_one() {
    for set in every_name() {
        let mut device = Recorder { parameters: set, ..Recorder::new(Mode::Running) };
        let values = names(set).into_iter().filter_map(|(name, value)| Some((name, value?)));
        let mut index = 0;
        for (name, value) in values {
            ask(&mut device, Request::ReadParameter(index), |answer| match (answer, value) {
                (Answer::Parameter { name: told, value }, Value::Number(wanted)) => {
                    assert_eq!(told, name);
                    // A NaN is one too.
                    assert!(
                        matches!(value, Value::Number(number) if number.to_bits() == wanted.to_bits())
                    );
                }
                (answer, wanted) => {
                    assert_eq!(answer, Answer::Parameter { name: &name, value: wanted });
                }
            });
            index += 1;
        }
        for index in [index, u16::MAX] {
            ask(&mut device, Request::ReadParameter(index), |answer| {
                assert_eq!(answer, Answer::Refused(Refusal::NoParameter));
            });
        }
    }
}

#[test]
fn parameters_are_changed_together() {
    let mut device = Recorder::new(Mode::Ready);
    let mut session = Session::default();
    let mut expected = parameters();
    stage(
        &mut session,
        &mut device,
        &[("limits.duty", Value::Number(0.5)), ("control.memory", Value::Name("Integral"))],
    );
    assert_eq!(device.parameters, expected, "staged is not in force");
    ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
        assert_eq!(answer, Answer::Done);
    });
    expected.drive.limits.duty = 0.5;
    let ControlConfig::Drive(drive_form) = &mut expected.drive.control else {
        unreachable!("it is the drive form")
    };
    *drive_form = drive_form.with_memory(quasidrive::control::drive_form::Memory::Integral);
    assert_eq!(device.parameters, expected);
    assert_eq!(device.told, ["write"]);
    ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
        assert_eq!(answer, Answer::Refused(Refusal::NothingStaged));
    });
}

#[test]
fn what_is_staged_is_forgotten_by_a_refusal_and_by_a_new_host() {
    let duty = ("limits.duty", Value::Number(0.5));
    let unfit = |name, value| Request::StageParameter { name, value };
    for (request, expected) in [
        (unfit("limits.dutty", duty.1), Some(Refusal::NoParameter)),
        (unfit("limits", duty.1), Some(Refusal::NoParameter)),
        (unfit("control.k1", duty.1), Some(Refusal::NoParameter)),
        (unfit("limits.duty", Value::Name("half")), Some(Refusal::UnfitValue)),
        (unfit("control", Value::Name("Neural")), Some(Refusal::UnfitValue)),
        (Request::Identify, None),
    ] {
        let mut device = Recorder::new(Mode::Ready);
        let mut session = Session::default();
        stage(&mut session, &mut device, &[duty]);
        ask_in(&mut session, &mut device, request, |answer| match expected {
            Some(refusal) => assert_eq!(answer, Answer::Refused(refusal), "{request:?}"),
            None => assert!(matches!(answer, Answer::Identity(_))),
        });
        ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
            assert_eq!(answer, Answer::Refused(Refusal::NothingStaged), "{request:?}");
        });
        assert_eq!(device.parameters, parameters());
    }
    // Refused as a whole, too.
    let mut device = Recorder::new(Mode::Ready);
    device.refusal = Some(Refusal::Busy);
    let mut session = Session::default();
    stage(&mut session, &mut device, &[duty]);
    for refusal in [Refusal::Busy, Refusal::NothingStaged] {
        ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
            assert_eq!(answer, Answer::Refused(refusal));
        });
    }
}

#[test]
fn a_controller_and_its_gains_change_in_every_mode_in_which_nothing_is_measured() {
    for mode in MODES.into_iter().filter(|mode| *mode != Mode::Armed) {
        for control in controls() {
            let mut device = Recorder::new(mode);
            let mut session = Session::default();
            let wanted = names(with_control(&parameters(), control));
            let values: Vec<_> = wanted
                .iter()
                .filter(|(name, _)| name.starts_with("control"))
                .filter_map(|(name, value)| Some((name.as_str(), (*value)?)))
                .collect();
            stage(&mut session, &mut device, &values);
            ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
                assert_eq!(answer, Answer::Done, "{mode:?}");
            });
            assert_eq!(device.told, ["change"]);
            assert_eq!(device.parameters.drive.control, control);
        }
    }
}

const MODES: [Mode; 7] = [
    Mode::Boot,
    Mode::Calibrating,
    Mode::Ready,
    Mode::Armed,
    Mode::Running,
    Mode::Stopping,
    Mode::Faulted,
];

#[test]
fn every_request_is_a_sign_of_life() {
    let mut device = Recorder::new(Mode::Running);
    for request in [
        Request::Identify,
        Request::Status,
        Request::ReadParameter(3),
        Request::StageParameter { name: "limits.duty", value: Value::Number(0.5) },
        Request::ApplyParameters,
        Request::SetTelemetry(7),
        Request::SaveParameters,
        Request::Command(Command::KeepAlive),
        Request::Command(Command::Speed(12.5)),
    ] {
        device.commands.clear();
        ask(&mut device, request, |_| {});
        assert_eq!(device.commands[0], Command::KeepAlive, "{request:?}");
        match request {
            Request::Command(Command::Speed(_)) => {
                assert_eq!(device.commands[1..], [Command::Speed(12.5)]);
            }
            _ => assert_eq!(device.commands[1..], [], "{request:?}"),
        }
    }
    device.commands.clear();
    let garbage = [0, 1, 2, 3, 0, 255, 255, 0];
    assert_eq!(answers(&mut Session::default(), &mut device, &garbage, |_, _| {}), 0);
    assert_eq!(device.commands, [], "garbage is no sign of life");
}

#[test]
fn other_parameters_change_and_are_saved_with_outputs_off_only() {
    for mode in MODES {
        let is_off = matches!(mode, Mode::Ready | Mode::Faulted);
        let expected = if is_off { Answer::Done } else { Answer::Refused(Refusal::Mode(mode)) };
        for request in [Request::ApplyParameters, Request::SaveParameters] {
            let mut device = Recorder::new(mode);
            let mut session = Session::default();
            let values =
                [("limits.duty", Value::Number(0.5)), ("control.load_torque", Value::Number(0.1))];
            stage(&mut session, &mut device, &values);
            ask_in(&mut session, &mut device, request, |answer| assert_eq!(answer, expected));
            assert_eq!(device.told.len(), usize::from(is_off), "{mode:?}");
        }
    }
}

#[test]
fn a_refusal_names_its_reason() {
    let config: Refusal = ConfigError {
        field: "control.observer_bandwidth",
        rule: "must be at most 0.13 of the sampling rate",
        value: 1e9,
    }
    .into();
    for refusal in [config, Refusal::Busy, Refusal::SpeedOutOfRange, Refusal::Mode(Mode::Boot)] {
        let mut device = Recorder::new(Mode::Ready);
        device.refusal = Some(refusal);
        for request in [Request::Command(Command::Arm), Request::SaveParameters] {
            ask(&mut device, request, |answer| assert_eq!(answer, Answer::Refused(refusal)));
        }
        for name in ["limits.duty", "control.load_torque"] {
            let mut session = Session::default();
            stage(&mut session, &mut device, &[(name, Value::Number(0.5))]);
            ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
                assert_eq!(answer, Answer::Refused(refusal), "{name}");
            });
        }
    }
    assert_eq!(
        config.to_string(),
        "control.observer_bandwidth must be at most 0.13 of the sampling rate, but is 1000000000.0"
    );
}

#[test]
fn a_request_of_a_later_version_is_refused() {
    let not_understood = |stream: &[u8]| {
        let mut device = Recorder::new(Mode::Ready);
        let count = answers(&mut Session::default(), &mut device, stream, |sequence, answer| {
            assert_eq!(sequence, 300);
            assert_eq!(answer, Answer::Refused(Refusal::NotUnderstood));
        });
        assert_eq!(count, 1);
        assert_eq!(device.commands, [], "and is no sign of life");
    };
    not_understood(&bytes(&(300_u16, 99_u8)));
    not_understood(&bytes(&(300_u16, 99_u8, [1_u8, 2, 3])));
    // Longer than what is known, and shorter.
    not_understood(&bytes(&(300_u16, Request::Status, 1_u8)));
    not_understood(&bytes(&(300_u16, 2_u8)));
}

#[test]
fn telemetry_comes_when_asked_for_between_answers() {
    let mut device = Recorder::new(Mode::Running);
    let mut session = Session::default();
    assert!(session.telemetry(&mut device).is_none());
    let telemetry =
        Telemetry { period: 9, speed: -1.5, interrupt_time: 3000, ..Default::default() };
    device.telemetry = vec![telemetry];
    let request = frame(1, Request::Status);
    let (begin, end) = request.split_at(3);
    // In the middle of a request's arrival too.
    assert_eq!(answers(&mut session, &mut device, begin, |_, _| {}), 0);
    let sent = session.telemetry(&mut device).expect("waiting").to_vec();
    let messages = decode(&mut Decoder::new(), &sent);
    assert_eq!(postcard::from_bytes(&messages[0]), Ok(Message::Telemetry(telemetry)));
    assert_eq!(answers(&mut session, &mut device, end, |_, _| {}), 1);
    assert!(session.telemetry(&mut device).is_none());
}

#[test]
fn a_motor_is_measured_where_the_drive_is_ready_only() {
    for mode in [Mode::Ready, Mode::Armed, Mode::Running, Mode::Commissioning, Mode::Faulted] {
        let mut device = Recorder::new(mode);
        let is_ready = mode == Mode::Ready;
        let expected = if is_ready { Answer::Done } else { Answer::Refused(Refusal::Mode(mode)) };
        ask(&mut device, Request::Commission(NAMEPLATE), |answer| assert_eq!(answer, expected));
        assert_eq!(device.told.contains(&"commission"), is_ready, "{mode:?}");
    }
    let mut device = Recorder::new(Mode::Ready);
    device.refusal = Some(Refusal::Config { field: "travel", rule: "must", value: 0.0 });
    ask(&mut device, Request::Commission(NAMEPLATE), |answer| {
        assert!(matches!(answer, Answer::Refused(Refusal::Config { field: "travel", .. })));
    });
}

#[test]
fn the_controller_stays_while_the_motor_is_measured_or_may_be_soon() {
    for mode in [Mode::Armed, Mode::Commissioning] {
        let mut device = Recorder::new(mode);
        let mut session = Session::default();
        stage(&mut session, &mut device, &[("control", Value::Name("Pi"))]);
        ask_in(&mut session, &mut device, Request::ApplyParameters, |answer| {
            assert_eq!(answer, Answer::Refused(Refusal::Mode(mode)));
        });
        assert!(device.told.is_empty(), "{mode:?}");
    }
}

#[test]
fn progress_is_told_at_any_time_and_evidence_with_outputs_off() {
    let mut device = Recorder::new(Mode::Commissioning);
    let progress = Progress { phase: Phase::Long, share: 0.25 };
    ask(&mut device, Request::ReadProgress, |answer| {
        assert_eq!(answer, Answer::Progress(progress));
    });
    let measured = evidence();
    assert!(measured.findings().inertia.is_ok());
    device.evidence = Some(measured);
    ask(&mut device, Request::ReadEvidence, |answer| {
        assert_eq!(answer, Answer::Refused(Refusal::Mode(Mode::Commissioning)));
    });
    for mode in [Mode::Ready, Mode::Faulted] {
        device.mode = mode;
        ask(&mut device, Request::ReadEvidence, |answer| {
            assert_eq!(answer, Answer::Evidence(measured));
        });
    }
    device.evidence = None;
    ask(&mut device, Request::ReadEvidence, |answer| {
        assert_eq!(answer, Answer::Refused(Refusal::NotCommissioned));
    });
}

#[test]
fn the_longest_message_fits() {
    // The longest refusals of a value are in `tests/parameters.rs`.
    let longest = "x".repeat(LONGEST_PATH);
    let request = Request::StageParameter { name: &longest, value: Value::Name(&longest) };
    assert!(frame(u16::MAX, request).len() <= LONGEST);
    let answer = Answer::Parameter { name: &longest, value: Value::Name(&longest) };
    assert!(bytes(&Message::Answer { sequence: u16::MAX, answer }).len() <= LONGEST);
    let identity = Identity {
        version: u16::MAX,
        board: &longest,
        firmware: "100.100.100-alpha.1",
        build: "0123456789012345678901234567890123456789-dirty",
    };
    let answer = Answer::Identity(identity);
    assert!(bytes(&Message::Answer { sequence: u16::MAX, answer }).len() <= LONGEST);
    let answer = Answer::Evidence(evidence());
    assert!(bytes(&Message::Answer { sequence: u16::MAX, answer }).len() <= LONGEST);
    let text = "x".repeat(LONGEST);
    assert_eq!(encode(&text.as_str(), &mut [0; LONGEST]), None, "what does not fit is no frame");
}

#[test]
fn faults_have_their_numbers_on_the_line() {
    let mut faults = Faults::NONE;
    faults.latch(Fault::CommandLost);
    let status = Status { mode: Mode::Faulted, faults, limits: ActiveLimits::NONE };
    let mut buffer = [0; 16];
    let sent = postcard::to_slice(&status, &mut buffer).expect("fits");
    // Mode 6, then 1 << 14 and 0 as variable-length integers.
    assert_eq!(sent, [6, 0x80, 0x80, 0x01, 0]);
}

#[test]
fn nothing_is_no_message() {
    // A checksum of zero over nothing, stuffed.
    assert_eq!(decode(&mut Decoder::new(), &[1, 1, 1, 1, 1, 0]), Vec::<Vec<u8>>::new());
    assert_eq!(decode(&mut Decoder::new(), &[0; 9]), Vec::<Vec<u8>>::new());
}

fn any_request() -> impl Strategy<Value = Request<'static>> {
    let number = any::<f32>();
    prop_oneof![
        Just(Request::Identify),
        Just(Request::Status),
        (0_u16..50).prop_map(Request::ReadParameter),
        Just(Request::StageParameter { name: "control", value: Value::Name("Pi") }),
        (
            any::<f32>(),
            prop::sample::select(vec!["limits.duty", "control.speed_bandwidth", "nothing"])
        )
            .prop_map(|(number, name)| Request::StageParameter {
                name,
                value: Value::Number(number)
            }),
        Just(Request::ApplyParameters),
        Just(Request::SetTelemetry(7)),
        number.prop_map(|speed| Request::Command(Command::Speed(speed))),
        Just(Request::Command(Command::Arm)),
    ]
}

/// What a line can do to a frame's bytes.
#[derive(Clone, Debug)]
enum Mutation {
    Flip { place: prop::sample::Index, bit: u8 },
    Replace { place: prop::sample::Index, byte: u8 },
    Insert { place: prop::sample::Index, byte: u8 },
    Remove { place: prop::sample::Index },
    Truncate { place: prop::sample::Index },
    Swap { place: prop::sample::Index, other: prop::sample::Index },
}

fn any_mutation() -> impl Strategy<Value = Mutation> {
    let place = any::<prop::sample::Index>;
    prop_oneof![
        (place(), 0_u8..8).prop_map(|(place, bit)| Mutation::Flip { place, bit }),
        (place(), any::<u8>()).prop_map(|(place, byte)| Mutation::Replace { place, byte }),
        (place(), any::<u8>()).prop_map(|(place, byte)| Mutation::Insert { place, byte }),
        place().prop_map(|place| Mutation::Remove { place }),
        place().prop_map(|place| Mutation::Truncate { place }),
        (place(), place()).prop_map(|(place, other)| Mutation::Swap { place, other }),
    ]
}

impl Mutation {
    fn apply(&self, bytes: &mut Vec<u8>) {
        if bytes.is_empty() {
            return;
        }
        let length = bytes.len();
        match self {
            Self::Flip { place, bit } => bytes[place.index(length)] ^= 1 << bit,
            Self::Replace { place, byte } => bytes[place.index(length)] = *byte,
            Self::Insert { place, byte } => bytes.insert(place.index(length), *byte),
            Self::Remove { place } => drop(bytes.remove(place.index(length))),
            Self::Truncate { place } => bytes.truncate(place.index(length)),
            Self::Swap { place, other } => bytes.swap(place.index(length), other.index(length)),
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn garbage_is_no_message(stream in prop::collection::vec(any::<u8>(), 0..2000)) {
        prop_assert_eq!(decode(&mut Decoder::new(), &stream), Vec::<Vec<u8>>::new());
    }

    /// Garbage of many short frames: a byte in three is a zero.
    #[test]
    fn short_garbage_is_no_message(
        stream in prop::collection::vec(prop_oneof![Just(0_u8), any::<u8>(), 1_u8..9], 0..2000),
    ) {
        prop_assert_eq!(decode(&mut Decoder::new(), &stream), Vec::<Vec<u8>>::new());
    }

    #[test]
    fn a_changed_frame_is_dropped(
        sequence: u16,
        request in any_request(),
        mutations in prop::collection::vec(any_mutation(), 1..4),
    ) {
        let original = frame(sequence, request);
        let mut changed = original.clone();
        for mutation in &mutations {
            mutation.apply(&mut changed);
        }
        changed.push(0);
        let message = decode(&mut Decoder::new(), &original).remove(0);
        for decoded in decode(&mut Decoder::new(), &changed) {
            prop_assert_eq!(&decoded, &message, "only what was sent");
        }
    }

    #[test]
    fn whole_requests_have_one_answer_each_whatever_is_between_them(
        parts in prop::collection::vec(
            (prop::collection::vec(any::<u8>(), 0..600), any_request(), any_mutation()),
            1..6,
        ),
    ) {
        const CHANGED: u16 = 1000;
        let mut stream = Vec::new();
        for (sequence, (garbage, request, mutation)) in (0..).zip(&parts) {
            let mut changed = frame(CHANGED, *request);
            mutation.apply(&mut changed);
            stream.extend(garbage);
            stream.extend(changed);
            stream.extend(frame(sequence, *request));
        }
        let mut device = Recorder::new(Mode::Ready);
        let mut answered = Vec::new();
        answers(&mut Session::default(), &mut device, &stream, |sequence, _| answered.push(sequence));
        // A mutation may change nothing, or a zero at an end only.
        answered.retain(|sequence| *sequence != CHANGED);
        prop_assert_eq!(answered, (0..parts.len() as u16).collect::<Vec<_>>());
    }
}

#[test]
fn an_overlong_frame_costs_no_memory_and_harms_no_other() {
    assert!(size_of::<Decoder>() <= LONGEST + 16);
    let mut decoder = Decoder::new();
    for length in [LONGEST - 1, LONGEST, LONGEST + 1, 1_000_000] {
        let overlong = vec![0x55; length];
        assert_eq!(decode(&mut decoder, &overlong), Vec::<Vec<u8>>::new());
        let whole = frame(5, Request::Status);
        assert_eq!(decode(&mut decoder, &whole).len(), 1, "{length}");
        // Its end is no frame either, whatever it looks like.
        assert_eq!(decode(&mut decoder, &overlong), Vec::<Vec<u8>>::new());
        assert_eq!(decode(&mut decoder, &whole[1..]).len(), 0, "{length}");
    }
}
