//! The image that is flashed, from reset on, without a motor. Needs the image: `cargo xtask firmware`.
#![allow(clippy::panic, reason = "a test's way to fail with the reason")]

use quasidrive::fault::Faults;
use quasidrive::link::frame::{Decoder, LONGEST, encode};
use quasidrive::link::message::{Answer, Message, Numbered, Refusal, Request, Status};
use quasidrive::schema::Value;
use quasidrive::supervisor::{Command, Mode};
use std::path::PathBuf;
use virtual_board::chip::{Reset, Violated};
use virtual_board::world::{AnaloguePin, Gates, InputPin};
use virtual_board::{Image, VirtualBoard, World};

/// Exception number of the control interrupt, ADC1_2.
const CONTROL: u16 = 18 + 16;

/// When the firmware has learnt its offsets and waits (s).
const READY: f64 = 0.3;

/// A board with 24 V, 25 °C, no motor, but an encoder that turns and a current from V to U through the shunts, both as told. Writes down
/// what the gates were told, and when U's current was looked at.
#[derive(Default)]
struct Bench {
    /// Speed (rad/s).
    speed: f64,
    /// Armature current (A), which leaves U and so lowers its reading.
    current: f64,
    switches: Vec<(f64, Gates)>,
    looks: Vec<f64>,
}

/// Voltage at a shunt's pad without current, and per ampere to ground (V, V/A): 2.057 V and 27.43 mV/A after the amplifier.
const PAD: f64 = 2.057 / 16.0;
const PAD_PER_AMPERE: f64 = 27.43e-3 / 16.0;

impl World for Bench {
    fn switch(&mut self, time: f64, gates: Gates) {
        self.switches.push((time, gates));
    }

    fn voltage(&mut self, time: f64, pin: AnaloguePin) -> f64 {
        match pin {
            AnaloguePin::ShuntU => {
                self.looks.push(time);
                PAD - PAD_PER_AMPERE * self.current
            }
            AnaloguePin::ShuntV => PAD + PAD_PER_AMPERE * self.current,
            AnaloguePin::ShuntW => PAD,
            AnaloguePin::BusVoltage => 24.0 * 18.0 / 187.0,
            AnaloguePin::Temperature => 3.3 * 4.7 / 14.7,
            AnaloguePin::Potentiometer => 0.0,
        }
    }

    fn encoder_edges(&mut self, time: f64) -> i64 {
        (self.speed * time / std::f64::consts::TAU * 4096.0).floor() as i64
    }

    fn level(&mut self, _time: f64, pin: InputPin) -> bool {
        match pin {
            InputPin::Button => true,
        }
    }
}

fn image() -> Image {
    let built = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/firmware/b_g431b_esc1.elf");
    let path = std::env::var_os("QUASIDRIVE_ELF").map_or(built.into(), PathBuf::from);
    let data = std::fs::read(&path).unwrap_or_else(|error| {
        panic!("{}: {error}; cargo xtask firmware builds it", path.display())
    });
    Image::from_elf(&data).expect("an image")
}

fn booted() -> VirtualBoard<Bench> {
    booted_in(Bench::default())
}

fn booted_in(world: Bench) -> VirtualBoard<Bench> {
    let mut board = VirtualBoard::new(&image(), world);
    run(&mut board, READY);
    board
}

fn run(board: &mut VirtualBoard<Bench>, seconds: f64) {
    let end = board.time() + seconds;
    if let Err(stop) = board.run_until(end) {
        panic!("{stop}, in {:?}", board.place());
    }
}

/// Asks the firmware something over the serial line, and gives its answer to `look`.
fn ask<R>(board: &mut VirtualBoard<Bench>, request: Request, look: impl FnOnce(&Answer) -> R) -> R {
    ask_within(0.02, board, request, look)
}

/// The same of what takes longer (s).
fn ask_within<R>(
    time: f64,
    board: &mut VirtualBoard<Bench>,
    request: Request,
    look: impl FnOnce(&Answer) -> R,
) -> R {
    send(board, request);
    run(board, time);
    let mut decoder = Decoder::new();
    for byte in board.received() {
        if let Some(message) = decoder.feed(byte) {
            match postcard::from_bytes(message) {
                Ok(Message::Answer { sequence: 7, answer }) => return look(&answer),
                other => panic!("{other:?}"),
            }
        }
    }
    panic!("no answer to {request:?} in {:?}, after {:?}", board.place(), board.resets());
}

fn send(board: &mut VirtualBoard<Bench>, request: Request) {
    let mut buffer = [0; LONGEST];
    let frame = encode(&Numbered { sequence: 7, request }, &mut buffer).expect("a frame");
    board.received();
    board.send(frame);
}

/// All parameters in force, by name.
fn read_parameters(board: &mut VirtualBoard<Bench>) -> Vec<(String, String)> {
    let read = |index| {
        ask(board, Request::ReadParameter(index), |answer| match answer {
            Answer::Parameter { name, value } => Some((name.to_string(), format!("{value:?}"))),
            Answer::Refused(Refusal::NoParameter) => None,
            other => panic!("{other:?}"),
        })
    };
    (0..).map_while(read).collect()
}

/// Highest temperature of the board (°C) that differs from the default, to tell sets of parameters apart.
const WARM: f32 = 61.0;

/// Changes a parameter.
fn change(board: &mut VirtualBoard<Bench>) {
    let value = Value::Number(WARM);
    ask(board, Request::StageParameter { name: "protection.temperature", value }, done);
    ask(board, Request::ApplyParameters, done);
}

fn done(answer: &Answer) {
    assert!(matches!(answer, Answer::Done), "{answer:?}");
}

/// Arms, and waits until the bridge is driven.
fn arm(board: &mut VirtualBoard<Bench>) {
    ask(board, Request::Command(Command::Arm), done);
    run(board, 0.05);
    assert_eq!(status(board).mode, Mode::Running);
}

fn status(board: &mut VirtualBoard<Bench>) -> Status {
    ask(board, Request::Status, |answer| match answer {
        Answer::Status(status) => *status,
        other => panic!("{other:?}"),
    })
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn it_comes_up_with_outputs_off_and_says_who_it_is() {
    let mut board = booted();
    assert_eq!(board.resets().len(), 1, "{:?}", board.resets());
    assert_eq!(status(&mut board).mode, Mode::Ready);
    ask(&mut board, Request::Identify, |answer| match answer {
        Answer::Identity(identity) => assert_eq!(identity.board, "b-g431b-esc1"),
        other => panic!("{other:?}"),
    });
    assert!(!board.main_output());
    assert_eq!(board.gates(), Gates::OFF);
    assert_eq!(board.world(|world| world.switches.len()), 0);
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn its_control_interrupt_comes_once_a_period() {
    let mut board = booted();
    board.statistics().clear();
    run(&mut board, 0.5);
    let handler = &board.statistics().handlers()[&CONTROL];
    // 170 MHz / 8496
    let rate = handler.count as f64 / 0.5;
    assert!((rate - 20_009.4).abs() < 3.0, "{rate}");
    assert!(handler.cycles.max < 8496 / 2, "{handler:?}");
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn it_plays_the_same_twice() {
    let play = || {
        let mut board = booted();
        ask(&mut board, Request::SetTelemetry(20), |_| ());
        run(&mut board, 0.2);
        (board.received(), board.instructions(), board.flash())
    };
    let (first, second) = (play(), play());
    assert!(first.0.len() > 1000);
    assert!(first == second);
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn it_stays_within_what_the_data_sheet_allows() {
    let board = booted();
    // But for the moment in which clocks are set up.
    let lasting = |violated: &Violated| violated.to.is_none_or(|to| to - violated.from > 20e-6);
    let lasting: Vec<_> = board.violations().into_iter().filter(lasting).collect();
    assert_eq!(lasting, []);
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn faults_of_the_program_end_the_outputs_and_then_by_the_watchdog() {
    type Fault = fn(&mut VirtualBoard<Bench>);
    // With the time until the outputs are off (s): by the watchdog 50 ms after it was last fed, which the main loop may do once more within
    // its turn of 10 ms; or at once, where a core that sleeps wakes with the next interrupt, a period and its handler later.
    let faults: [(&str, f64, Fault); 5] = [
        ("interrupt stuck on", 0.061, |board| board.force_interrupt(18, Some(true))),
        ("interrupt stuck off", 0.061, |board| board.force_interrupt(18, Some(false))),
        ("panic", 70e-6, |board| assert!(board.jump_to("rust_begin_unwind"))),
        ("hard fault", 70e-6, |board| board.jump(0x1fff_fff0)),
        ("stack overflow", 70e-6, |board| board.exhaust_stack(16)),
    ];
    for (name, limit, fault) in faults {
        let mut board = booted();
        arm(&mut board);
        let start = board.time();
        fault(&mut board);
        run(&mut board, 0.1);
        let reset = board.resets().get(1).unwrap_or_else(|| panic!("no reset by {name}"));
        assert_eq!(reset.reset, Reset::Watchdog, "{name}");
        let time = board.off_since() - start;
        assert!(time < limit, "{name}: outputs off after {time} s");
        assert!(!board.main_output(), "{name}");
    }
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn a_broken_crystal_ends_in_a_watchdog_reset() {
    let mut board = booted();
    arm(&mut board);
    let start = board.time();
    board.break_crystal();
    run(&mut board, 0.1);
    assert!(board.off_since() - start < 1e-6, "by the clock security system");
    assert_eq!(board.resets()[1].reset, Reset::Watchdog);
    // From then on it waits for the crystal, with outputs off.
    assert_eq!(board.gates(), Gates::OFF);
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn armed_it_charges_then_drives_and_keeps_the_dead_time_throughout() {
    let mut board = booted();
    arm(&mut board);
    ask(&mut board, Request::Command(Command::Off), done);
    assert_eq!(board.gates(), Gates::OFF);
    run(&mut board, 0.05);
    let off_since = board.off_since();
    assert!(board.time() - off_since > 0.04);
    let switches = board.world(|world| std::mem::take(&mut world.switches));
    for leg in 0..2 {
        check_leg(leg, &switches);
    }
    assert!(switches.iter().all(|(_, gates)| !gates.high[2] && !gates.low[2]), "W");
}

/// Shortest time from one switch's end to the other's begin (s): 136 cycles of 170 MHz.
const DEAD_TIME: f64 = 0.8e-6;

/// Dead time of a leg, and that its low side alone comes first, for 20 ms at least.
fn check_leg(leg: usize, switches: &[(f64, Gates)]) {
    let (mut before, mut ended) = ([false; 2], [f64::NEG_INFINITY; 2]);
    let (mut first, mut first_high) = (None, None);
    for (time, gates) in switches {
        let now = [gates.high[leg], gates.low[leg]];
        assert!(now != [true; 2], "leg {leg} shorts the supply at {time} s");
        for side in 0..2 {
            if before[side] && !now[side] {
                ended[side] = *time;
            }
            if !before[side] && now[side] {
                let dead = time - ended[1 - side];
                assert!(dead > DEAD_TIME - 1e-9, "dead time of {dead} s of leg {leg} at {time} s");
                first.get_or_insert(*time);
            }
        }
        if now[0] {
            first_high.get_or_insert(*time);
        }
        before = now;
    }
    let charged = first_high.expect("a duty") - first.expect("a charge");
    assert!((0.02..0.03).contains(&charged), "{charged} s");
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn saved_parameters_outlive_power() {
    let mut board = booted();
    change(&mut board);
    let changed = read_parameters(&mut board);
    ask_within(0.3, &mut board, Request::SaveParameters, done);
    let after = status(&mut board);
    assert_eq!((after.mode, after.faults), (Mode::Ready, Faults::NONE));
    board.power_cut();
    run(&mut board, 1.0);
    board.power_up();
    run(&mut board, READY);
    assert_eq!(read_parameters(&mut board), changed);
}

/// What changing to the paper's controller takes of the stack is the most that was found.
#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn the_stack_has_room_for_the_largest_controller() {
    let mut board = booted();
    let name = Value::Name;
    let number = Value::Number;
    for (path, value) in [
        ("control", name("Paper")),
        ("control.law", name("Qsmdo")),
        ("control.gains.c", number(200.0)),
        ("control.gains.k1", number(13e3)),
        ("control.gains.epsilon1", number(1.0)),
        ("control.gains.k2", number(4e7)),
        ("control.gains.epsilon2", number(1e4)),
        ("control.speed", name("Pll")),
        ("control.speed.bandwidth", number(500.0)),
        ("protection.temperature", number(WARM)),
    ] {
        ask(&mut board, Request::StageParameter { name: path, value }, done);
    }
    ask(&mut board, Request::ApplyParameters, done);
    run(&mut board, 0.05);
    ask_within(0.3, &mut board, Request::SaveParameters, done);
    // The interrupts that may not have come at the deepest place: 852 bytes of the control interrupt's, its frame, the others'.
    let used = board.stack_use() + 1536;
    let there = image().stack().len();
    assert!(used <= there, "{used} of {there} bytes");
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn every_request_is_answered_while_telemetry_fills_the_line() {
    let mut board = booted();
    for decimation in [1, 2, 5] {
        send(&mut board, Request::SetTelemetry(decimation));
        run(&mut board, 0.02);
        for _ in 0..20 {
            send(&mut board, Request::Status);
            run(&mut board, 0.02);
            let (mut decoder, mut answers, mut periods) = (Decoder::new(), 0, 0);
            for byte in board.received() {
                match decoder.feed(byte).map(postcard::from_bytes) {
                    Some(Ok(Message::Answer { .. })) => answers += 1,
                    Some(Ok(Message::Telemetry(_))) => periods += 1,
                    Some(Err(_)) | None => {}
                }
            }
            assert_eq!(answers, 1, "one in {decimation}");
            assert!(periods >= 15, "{periods} periods told in 20 ms, one in {decimation}");
        }
    }
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn power_that_goes_while_saving_leaves_the_old_parameters_or_the_new_ones() {
    let mut found = Vec::new();
    for cut in [1, 10, 23, 26, 40] {
        let mut board = booted();
        let old = read_parameters(&mut board);
        change(&mut board);
        let new = read_parameters(&mut board);
        assert_ne!(old, new);
        send(&mut board, Request::SaveParameters);
        run(&mut board, 1e-3 * f64::from(cut));
        board.power_cut();
        board.power_up();
        run(&mut board, READY);
        let Status { mode, faults, .. } = status(&mut board);
        assert_eq!((mode, faults), (Mode::Ready, Faults::NONE), "{cut} ms");
        let parameters = read_parameters(&mut board);
        assert!(parameters == old || parameters == new, "{cut} ms");
        found.push(parameters == new);
    }
    // The cuts were early enough, and late enough.
    assert!(!found[0] && found[4], "{found:?}");
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn a_turning_encoder_is_measured() {
    let mut board = booted_in(Bench { speed: 100.0, ..Bench::default() });
    ask(&mut board, Request::SetTelemetry(20), done);
    run(&mut board, 0.2);
    let (mut decoder, mut count) = (Decoder::new(), 0);
    for byte in board.received() {
        if let Some(message) = decoder.feed(byte)
            && let Ok(Message::Telemetry(telemetry)) = postcard::from_bytes(message)
        {
            // A count in 16 reads of a period would be 4 rad/s: the reads are where they should be.
            assert!((telemetry.speed - 100.0).abs() < 0.2, "{telemetry:?}");
            assert!((telemetry.bus_voltage - 24.0).abs() < 0.02, "{telemetry:?}");
            count += 1;
        }
    }
    assert!(count > 100);
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn currents_are_sampled_where_their_ripple_crosses_its_mean() {
    let mut board = booted();
    arm(&mut board);
    board.world(|world| {
        world.switches.clear();
        world.looks.clear();
    });
    run(&mut board, 1e-3);
    let (switches, looks) =
        board.world(|world| (world.switches.clone(), std::mem::take(&mut world.looks)));
    // The middle between two voltage pulses: from U's high side off to its low side off.
    let falls = |level: fn(&Gates) -> bool| {
        let pairs = switches.iter().zip(switches.iter().skip(1));
        let fall = pairs.filter(move |(before, after)| level(&before.1) && !level(&after.1));
        fall.map(|(_, after)| after.0).collect::<Vec<_>>()
    };
    let (high, low) = (falls(|gates| gates.high[0]), falls(|gates| gates.low[0]));
    let mut count = 0;
    for off in high {
        if let Some(end) = low.iter().find(|end| **end > off) {
            let middle = (off + end) / 2.0;
            // The firmware reckons with 3.5 cycles of latency, the emulator with 2.125: 32 ns too early.
            assert!(looks.iter().any(|look| (look - middle).abs() < 40e-9), "{middle}");
            count += 1;
        }
    }
    assert!(count > 15);
}

#[test]
#[ignore = "needs the image: cargo xtask firmware"]
fn a_current_beyond_the_comparators_threshold_ends_the_outputs_without_the_core() {
    let mut board = booted();
    arm(&mut board);
    // The core does nothing about it.
    board.force_interrupt(18, Some(false));
    board.world(|world| world.current = -39.5);
    let start = board.time();
    run(&mut board, 50e-6);
    assert!(!board.main_output());
    // The comparator's next look and the filter.
    assert!(board.off_since() - start < 6e-6, "{}", board.off_since() - start);
    board.force_interrupt(18, None);
    run(&mut board, 0.01);
    board.world(|world| world.current = 0.0);
    let Status { mode, faults, .. } = status(&mut board);
    assert_eq!(mode, Mode::Faulted);
    assert!(faults != Faults::NONE);
    run(&mut board, 0.05);
    assert!(!board.main_output(), "until it is cleared");
    assert!(board.off_since() - start < 6e-6);
}
