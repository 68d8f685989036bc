//! `serve` and `connect` as a user meets them: a drive behind a socket, commanded by hand.

use assert_cmd::Command;
use host_sim::client::{Client, ClientError};
use predicates::prelude::*;
use predicates::str::contains;
use quasidrive::commission::Reason;
use quasidrive::fault::Fault;
use quasidrive::link::message::{Request, Telemetry};
use quasidrive::supervisor::{Command as DriveCommand, Mode};
use std::io::{BufRead, BufReader, ErrorKind, Read, Write};
use std::net::TcpStream;
use std::path::{Path, PathBuf};
use std::process::{Child, Stdio};
use std::thread::sleep;
use std::time::{Duration, Instant};
use tempfile::TempDir;

fn scenario() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios/served.toml")
}

/// Longer than anything takes on a computer that is busy with other things.
const PATIENCE: Duration = Duration::from_secs(60);

/// A command timeout (s) that is the drive's shortest here, and one that no test outlasts, busy as the computer may be.
const SHORT: f64 = 1.0;
const LONG: f64 = 30.0;

/// What is said when something did not come within [`PATIENCE`]; the drive's time is its own, which may pass more slowly than the computer's.
fn within(start: Instant, what: &str) {
    assert!(start.elapsed() < PATIENCE, "not within {PATIENCE:?}: {what}");
}

/// A served drive, which ends with its test.
struct Served {
    process: Child,
    port: String,
    /// Holds its scenario.
    _folder: TempDir,
}

impl Drop for Served {
    fn drop(&mut self) {
        let _ = self.process.kill();
        let _ = self.process.wait();
    }
}

impl Served {
    fn start(arguments: &[&str]) -> Self {
        Self::start_with(LONG, arguments)
    }

    /// With a command timeout (s) in place of the scenario's.
    fn start_with(timeout: f64, arguments: &[&str]) -> Self {
        let folder = tempfile::tempdir().expect("a temporary folder");
        let file = folder.path().join("served.toml");
        let text = std::fs::read_to_string(scenario()).expect("shipped");
        let [before, after] = ["command_timeout = 1.0", &format!("command_timeout = {timeout}")];
        assert!(text.contains(before));
        std::fs::write(&file, text.replace(before, after)).expect("written");
        let mut process = std::process::Command::new(env!("CARGO_BIN_EXE_host-sim"))
            .arg("serve")
            .arg(file)
            .args(["--port", "0"])
            .args(arguments)
            .stdout(Stdio::piped())
            .spawn()
            .expect("runs");
        let mut line = String::new();
        let stdout = process.stdout.take().expect("piped");
        BufReader::new(stdout).read_line(&mut line).expect("a line");
        let (_, port) = line.trim().rsplit_once(" at ").expect("where it is");
        let served = Self { process, port: port.to_owned(), _folder: folder };
        let mut client = served.client();
        let start = Instant::now();
        while matches!(client.status().expect("answers").mode, Mode::Boot | Mode::Calibrating) {
            within(start, "it starts");
        }
        drop(client);
        served
    }

    fn connect(&self, arguments: &[&str]) -> Command {
        let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
        command.arg("connect").arg(&self.port).args(arguments);
        command
    }

    fn client(&self) -> Client {
        Client::open(&self.port).expect("a drive")
    }

    /// A socket that is not bound to speak the link.
    fn socket(&self) -> TcpStream {
        TcpStream::connect(self.port.trim_start_matches("tcp:")).expect("listens")
    }

    /// A drive that follows a speed (rad/s).
    fn running(&self, speed: f32) -> Client {
        let mut client = self.client();
        client.command(DriveCommand::Arm).expect("ready");
        wait_for(&mut client, Mode::Running);
        client.command(DriveCommand::Speed(speed)).expect("within the limits");
        client
    }

    /// A drive that has reached a speed (rad/s).
    fn settled(&self, speed: f32) -> Client {
        let mut client = self.running(speed);
        let start = Instant::now();
        while (told(&mut client).speed - speed).abs() > 1.0 {
            within(start, "the speed");
            client.command(DriveCommand::KeepAlive).expect("answers");
        }
        client
    }

    /// Whether the drive has lost its host after some attempts at something that is no sign of life, each a little longer than [`SHORT`]: to ask is one.
    fn is_lost_after(&self, attempt: impl Fn()) -> bool {
        (0..20).any(|_| {
            attempt();
            self.client().status().expect("answers").faults.contains(Fault::CommandLost)
        })
    }
}

/// Silence.
fn be_silent() {
    sleep(Duration::from_secs_f64(1.7 * SHORT));
}

fn wait_for(client: &mut Client, mode: Mode) {
    let start = Instant::now();
    while client.status().expect("answers").mode != mode {
        within(start, &format!("{mode:?}"));
        sleep(Duration::from_millis(5));
    }
}

/// A period that the drive tells.
fn told(client: &mut Client) -> Telemetry {
    client.have_done(Request::SetTelemetry(200)).expect("done");
    let start = Instant::now();
    loop {
        if let Some(telemetry) = client.telemetry().expect("answers").pop() {
            client.have_done(Request::SetTelemetry(0)).expect("done");
            return telemetry;
        }
        within(start, "telemetry");
    }
}

/// The last line of telemetry in a plain watch: time, speed, reference, …
fn last_telemetry(output: &[u8]) -> Vec<f64> {
    let text = String::from_utf8(output.to_vec()).expect("text");
    let line = text.lines().rfind(|line| !line.starts_with('#')).expect("telemetry");
    line.split_whitespace().map(|number| number.parse().expect("a number")).collect()
}

#[test]
fn a_motor_is_spun_from_the_command_line() {
    // Shorter than the watching below.
    let served = Served::start_with(2.0, &[]);
    served.connect(&["status"]).assert().success().stdout(
        contains("simulated board, firmware")
            .and(contains("mode Ready, faults: none"))
            .and(contains("board 25.0 °C, bus 2")),
    );
    served
        .connect(&["speed", "100"])
        .assert()
        .code(1)
        .stderr(contains("refused: not while the drive is in mode Ready"));
    served.connect(&["arm"]).assert().success().stdout(contains("mode"));
    // At once: whether it is armed still or running already.
    served.connect(&["speed", "100"]).assert().success().stdout(contains("faults: none"));
    wait_for(&mut served.client(), Mode::Running);
    // Longer than the timeout: watching keeps the drive alive.
    let watched =
        served.connect(&["watch", "--plain", "--seconds", "3", "--rate", "20"]).assert().success();
    let output = &watched.get_output().stdout;
    let [_, speed, reference, _, voltage, bus, load, _, temperature] = last_telemetry(output)[..]
    else {
        unreachable!("nine columns")
    };
    assert!((speed - 100.0).abs() < 1.0 && (reference - 100.0).abs() < 0.1, "{speed}, {reference}");
    assert!((6.0..8.0).contains(&voltage) && (bus - 24.0).abs() < 0.1, "{voltage} V of {bus} V");
    assert!((0.0..0.05).contains(&load), "{load} N·m");
    assert_eq!(temperature, 25.0);
    // One in so many periods: the drive's time goes on by a twentieth of a second from line to line, where none is lost.
    let text = String::from_utf8_lossy(output);
    let lines = text.lines().filter(|line| !line.starts_with('#'));
    let times: Vec<f64> =
        lines.filter_map(|line| line.split_whitespace().next()?.parse().ok()).collect();
    let steps = times.windows(2).map(|two| two[1] - two[0]);
    let usual = steps.filter(|step| (step - 0.05).abs() < 1.5e-3).count();
    assert!(times.len() <= 62 && 2 * usual > times.len(), "{times:?}");
    served
        .connect(&["speed", "-301"])
        .assert()
        .code(1)
        .stderr(contains("the speed is beyond limits.speed"));
    served.connect(&["disarm"]).assert().success().stdout(contains("mode Ready"));
    let start = Instant::now();
    loop {
        let watched = served.connect(&["watch", "--plain", "--seconds", "1"]).assert().success();
        let [_, speed, reference, _, voltage, ..] =
            last_telemetry(&watched.get_output().stdout)[..]
        else {
            unreachable!("nine columns")
        };
        assert_eq!([reference, voltage], [0.0, 0.0]);
        if speed.abs() < 5.0 {
            break;
        }
        within(start, "friction stops it");
    }
}

#[test]
fn a_silent_host_is_lost() {
    let served = Served::start_with(SHORT, &[]);
    let mut client = served.running(50.0);
    // A tenth of a timeout at a time is no silence.
    for _ in 0..20 {
        sleep(Duration::from_secs_f64(0.1 * SHORT));
        client.command(DriveCommand::KeepAlive).expect("answers");
    }
    assert_eq!(client.status().expect("answers").mode, Mode::Running);
    drop(client);
    assert!(served.is_lost_after(be_silent));
    served
        .connect(&["status"])
        .assert()
        .code(3)
        .stdout(contains("mode Faulted, faults: 14 command lost"));
    served.connect(&["arm"]).assert().code(1).stderr(contains("in mode Faulted"));
    served.connect(&["clear"]).assert().success();
    served.connect(&["status"]).assert().success().stdout(contains("mode Ready, faults: none"));
}

#[test]
fn garbage_does_not_disturb_and_is_no_sign_of_life() {
    let served = Served::start(&[]);
    drop(served.settled(100.0));
    let mut garbage = served.socket();
    let flood: Vec<u8> =
        (0_u32..200_000).map(|n| (n.wrapping_mul(2_654_435_761) >> 13) as u8).collect();
    garbage.write_all(&flood).expect("taken");
    drop(garbage);
    let mut client = served.client();
    assert_eq!(client.status().expect("answers").mode, Mode::Running);
    let speed = told(&mut client).speed;
    assert!((speed - 100.0).abs() < 2.0, "{speed}");
    // A command cut short, and the whole one after it.
    drop(client);
    let mut cut = served.socket();
    cut.write_all(&[0, 3, 1, 2]).expect("taken");
    drop(cut);
    assert_eq!(served.client().status().expect("answers").mode, Mode::Running);
    drop(served);
    let served = Served::start_with(SHORT, &[]);
    drop(served.running(100.0));
    assert!(served.is_lost_after(|| {
        let mut garbage = served.socket();
        let start = Instant::now();
        while start.elapsed() < Duration::from_secs_f64(1.8 * SHORT) {
            garbage.write_all(&flood[..100]).expect("taken");
            sleep(Duration::from_millis(50));
        }
    }));
}

#[test]
fn one_host_at_a_time() {
    let served = Served::start(&[]);
    let mut first = served.running(10.0);
    // Others wait; who waits too long is told why.
    served.connect(&["status"]).assert().code(1).stderr(contains("not with another host?"));
    let mut second = served.socket();
    assert_eq!(first.status().expect("still answered").mode, Mode::Running);
    second.set_nonblocking(true).expect("a socket");
    assert!(
        matches!(second.read(&mut [0; 1]), Err(error) if error.kind() == ErrorKind::WouldBlock)
    );
    drop(second);
    let port = served.port.clone();
    let third = std::thread::spawn(move || Client::open(&port)?.status());
    assert_eq!(first.status().expect("still answered").mode, Mode::Running);
    drop(first);
    assert_eq!(third.join().expect("ends").expect("its turn").mode, Mode::Running);
}

#[test]
fn hosts_that_follow_each_other_at_once_are_all_answered() {
    let served = Served::start(&[]);
    for _ in 0..100 {
        assert_eq!(served.client().status().expect("answers").mode, Mode::Ready);
    }
}

#[test]
fn parameters_are_shown_changed_and_saved() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let flash = folder.path().join("flash.bin");
    let arguments = ["--flash", flash.to_str().expect("text")];
    let served = Served::start(&arguments);
    served
        .connect(&["parameters", "get", "limits.duty", "reference"])
        .assert()
        .success()
        .stdout("limits.duty=0.9\nreference=SecondOrder\nreference.bandwidth=40.0\n");
    served
        .connect(&["parameters", "get"])
        .assert()
        .success()
        .stdout(contains("motor.inertia=7.95e-5\n"));
    for (arguments, reason) in [
        (&["limits.duty=2"][..], "refused: limits.duty must be above 0 and at most 1, but is 2.0"),
        (
            &["timing.rate=10000"],
            "refused: timing.rate and timing.delay must be as in the scenario",
        ),
        (&["limits.dutty=0.5"], "limits.dutty=0.5: there is no such parameter"),
        (&["limits.duty=half"], "limits.duty=half: the parameter cannot have this value"),
        (&["limits.duty=NaN"], "limits.duty=NaN: the parameter cannot have this value"),
        (&["control.memory=1"], "control.memory=1.0: the parameter cannot have this value"),
        // Gains that are not given are not guessed.
        (&["control=Ladrc"], "refused: control.current_bandwidth must be"),
        (&["limits.duty=0.5", "protection.temperature=200"], "must be from 0 to 120 °C"),
    ] {
        let mut set = served.connect(&["parameters", "set"]);
        set.args(arguments).assert().code(1).stderr(contains(reason));
    }
    served.connect(&["parameters", "set", "limits.duty"]).assert().code(2);
    served
        .connect(&["parameters", "get", "brake"])
        .assert()
        .code(1)
        .stderr(contains("no parameter brake"));
    let duty = |served: &Served, value: &str| {
        let wanted = format!("limits.duty={value}\n");
        served.connect(&["parameters", "get", "limits.duty"]).assert().success().stdout(wanted);
    };
    duty(&served, "0.9");
    let set = [
        "parameters",
        "set",
        "limits.duty=0.5",
        "reference.acceleration=2000",
        "reference.jerk=1e5",
        "reference=SCurve",
    ];
    served.connect(&set).assert().success();
    duty(&served, "0.5");
    served.connect(&["parameters", "save"]).assert().success();
    served.connect(&["parameters", "set", "limits.duty=0.6"]).assert().success();
    duty(&served, "0.6");
    drop(served);
    // Switched off and on: what was saved, not what was in force.
    let served = Served::start(&arguments);
    duty(&served, "0.5");
    let client = served.running(10.0);
    drop(client);
    // Gains change while it runs.
    served.connect(&["parameters", "set", "control.load_torque=0.25"]).assert().success();
    for action in [&["set", "limits.duty=0.7"][..], &["save"]] {
        let mut refused = served.connect(&["parameters"]);
        refused
            .args(action)
            .assert()
            .code(1)
            .stderr(contains("not while the drive is in mode Running"));
    }
    drop(served);
    // A flash that is damaged where the set is: a fault, and safe defaults.
    let mut memory = std::fs::read(&flash).expect("written");
    let jerk = 1e5_f32.to_le_bytes();
    let place = memory.windows(4).rposition(|bytes| bytes == jerk).expect("reference.jerk");
    memory[place] ^= 1;
    std::fs::write(&flash, memory).expect("written");
    let served = Served::start(&arguments);
    served.connect(&["status"]).assert().code(3).stdout(contains("17 bad parameters"));
    duty(&served, "0.9");
    served.connect(&["parameters", "save"]).assert().success();
    served.connect(&["clear"]).assert().success();
    served.connect(&["status"]).assert().success().stdout(contains("faults: none"));
    drop(served);
    let served = Served::start(&arguments);
    served.connect(&["status"]).assert().success();
}

#[test]
fn another_controller_takes_over_while_the_motor_turns() {
    let served = Served::start(&[]);
    drop(served.settled(100.0));
    let file = scenario();
    let file = file.to_str().expect("text");
    for name in ["pi", "ladrc", "drive-qismc", "bs-qsmdo"] {
        served.connect(&["controller", file, "--controller", name]).assert().success();
        let watched = served.connect(&["watch", "--plain", "--seconds", "1"]).assert().success();
        let [_, speed, ..] = last_telemetry(&watched.get_output().stdout)[..] else {
            unreachable!("nine columns")
        };
        assert!((speed - 100.0).abs() < 3.0, "{name}: {speed}");
    }
    served
        .connect(&["parameters", "get", "control"])
        .assert()
        .success()
        .stdout(contains("control=Paper\n"));
}

#[test]
fn a_controller_is_tuned_for_the_drives_own_motor() {
    let served = Served::start(&[]);
    let folder = tempfile::tempdir().expect("a temporary folder");
    let untuned = folder.path().join("untuned.toml");
    let text = std::fs::read_to_string(scenario()).expect("shipped");
    let text: Vec<&str> =
        text.lines().filter(|line| !line.starts_with("bandwidth = 1170")).collect();
    std::fs::write(&untuned, text.join("\n")).expect("written");
    let tuned = |inertia: &str| {
        let inertia = format!("motor.inertia={inertia}");
        served.connect(&["parameters", "set", &inertia]).assert().success();
        served.connect(&["controller", untuned.to_str().expect("text")]).assert().success();
        let mut client = served.client();
        let parameters = client.parameters().expect("listed");
        let told = |name: &str| {
            let (_, setting) = parameters.iter().find(|(path, _)| path == name).expect(name);
            setting.to_string().parse::<f64>().expect("a number")
        };
        assert_eq!(format!("motor.inertia={:?}", told("motor.inertia")), inertia, "stays");
        told("control.observer_bandwidth")
    };
    let (light, heavy) = (tuned("0.0001"), tuned("0.0016"));
    // The ripple rises with the inertia and the fourth power of the bandwidth.
    assert!((light / heavy - 2.0).abs() < 1e-3, "{light}, {heavy}");
}

/// A parameter of the drive.
fn parameter(served: &Served, name: &str) -> f64 {
    let parameters = served.client().parameters().expect("listed");
    let (_, setting) = parameters.iter().find(|(path, _)| path == name).expect(name);
    setting.to_string().parse().expect("a number")
}

/// What commissioning is to correct.
const WRONG: [&str; 5] = [
    "motor.inertia=0.0003",
    "motor.resistance=2",
    "motor.inductance=0.0005",
    "motor.back_emf_constant=0.03",
    "sensors.counts_per_turn=-4096",
];

#[test]
fn a_wrong_model_is_corrected_verified_and_saved() {
    let folder = tempfile::tempdir().expect("a temporary folder");
    let path = |name: &str| folder.path().join(name).to_str().expect("text").to_owned();
    let (flash, report) = (path("flash"), path("report.html"));
    let served = Served::start(&["--flash", &flash]);
    served.connect(&["parameters", "set"]).args(WRONG).assert().success();
    served
        .connect(&["commission", "--voltage", "24", "--no-load", "390", "--current", "10"])
        .args(["--apply", "--save", "--report", &report])
        .assert()
        .success()
        .stdout(
            contains("to and fro, faster: Kb, J, friction")
                .and(contains("the other way round, its sign is corrected"))
                .and(contains("inertia J"))
                .and(contains("verification passed"))
                .and(contains("saved")),
        );
    let html = std::fs::read_to_string(&report).expect("written");
    assert!(html.matches("<svg").count() == 4 && html.contains("verification passed"));
    assert!(!html.contains("http://") || !html.contains("src="), "nothing from elsewhere");
    let check = |served: &Served| {
        for (name, truth, most) in [
            ("motor.resistance", 0.7, 0.02),
            ("motor.inductance", 105e-6, 0.03),
            ("motor.back_emf_constant", 59e-3, 0.01),
            // The load of this scenario goes up and down.
            ("motor.inertia", 7.95e-5, 0.03),
            ("sensors.counts_per_turn", 4096.0, 0.0),
            ("limits.current_command", 10.0, 0.0),
        ] {
            let value = parameter(served, name);
            assert!((value / truth - 1.0).abs() <= most, "{name} is {value}");
        }
    };
    check(&served);
    assert_eq!(served.client().status().expect("answers").mode, Mode::Ready);
    drop(served);
    check(&Served::start(&["--flash", &flash]));
}

#[test]
fn without_being_asked_nothing_is_applied() {
    let served = Served::start(&[]);
    served.connect(&["parameters", "set"]).args(WRONG).assert().success();
    served
        .connect(&["commission", "--speed", "150", "--current", "8"])
        .assert()
        .success()
        .stdout(contains("tuned").and(contains("applied").not()));
    assert_eq!(parameter(&served, "motor.resistance"), 2.0);
}

#[test]
fn what_contradicts_the_nameplate_is_not_applied() {
    let served = Served::start(&[]);
    // Lines for counts.
    served
        .connect(&["commission", "--voltage", "24", "--no-load", "390", "--counts", "1024"])
        .args(["--speed", "1000", "--current", "10", "--apply", "--save"])
        .assert()
        .code(1)
        .stdout(contains("the nameplate says otherwise").and(contains("applied").not()))
        .stderr(contains("nothing is changed"));
    assert_eq!(parameter(&served, "sensors.counts_per_turn"), 4096.0);
    assert_eq!(served.client().status().expect("answers").mode, Mode::Ready);
}

#[test]
fn commissioning_is_refused_where_it_cannot_be() {
    let served = Served::start(&[]);
    served
        .connect(&["commission", "--current", "21"])
        .assert()
        .code(1)
        .stderr(contains("limits.current_command must be at most limits.current"));
    served.connect(&["commission", "--no-load", "390"]).assert().code(2);
    served.connect(&["commission", "--save"]).assert().code(2);
    let mut client = served.running(50.0);
    let started = client.have_done(Request::Commission(Default::default()));
    assert!(matches!(started, Err(ClientError::Refused(_))), "{started:?}");
    assert_eq!(client.status().expect("answers").mode, Mode::Running);
    let none = client.findings();
    assert!(matches!(none, Err(ClientError::Refused(_))), "{none:?}");
}

#[test]
fn a_host_that_goes_away_ends_commissioning() {
    let served = Served::start_with(SHORT, &[]);
    let mut client = served.client();
    client.have_done(Request::Commission(Default::default())).expect("ready");
    wait_for(&mut client, Mode::Commissioning);
    drop(client);
    assert!(served.is_lost_after(be_silent));
    let mut client = served.client();
    let status = client.status().expect("answers");
    assert_eq!(status.mode, Mode::Faulted);
    assert!(status.faults.contains(Fault::CommandLost));
    let findings = client.findings().expect("what there is");
    assert_eq!(findings.stopped, Some(Reason::Aborted));
}

/// As Ctrl-C does.
#[cfg(unix)]
#[test]
fn an_interrupted_commissioning_leaves_outputs_off() {
    let served = Served::start(&[]);
    let mut commissioning = std::process::Command::new(env!("CARGO_BIN_EXE_host-sim"))
        .args(["connect", &served.port, "commission", "--apply", "--save"])
        .stdout(Stdio::piped())
        .stderr(Stdio::piped())
        .spawn()
        .expect("runs");
    let mut lines = BufReader::new(commissioning.stdout.take().expect("piped")).lines();
    // It is swinging by then.
    assert!(lines.any(|line| line.expect("text").starts_with("to and fro: L")));
    let id = commissioning.id().to_string();
    assert!(
        std::process::Command::new("kill").args(["-INT", &id]).status().expect("runs").success()
    );
    assert_eq!(commissioning.wait().expect("ends").code(), Some(1));
    let mut error = String::new();
    let _ = commissioning.stderr.take().expect("piped").read_to_string(&mut error);
    assert!(error.contains("interrupted: outputs are off, nothing is saved"), "{error}");
    assert_eq!(served.client().status().expect("answers").mode, Mode::Ready);
}

#[test]
fn what_is_no_drive_is_an_error() {
    let connect = |port: &str| {
        let mut command = Command::new(env!("CARGO_BIN_EXE_host-sim"));
        command.args(["connect", port, "status"]);
        command
    };
    connect("/dev/no-such-port").assert().code(1).stderr(contains("cannot open /dev/no-such-port"));
    connect("tcp:127.0.0.1:1").assert().code(1).stderr(contains("cannot open tcp:127.0.0.1:1"));
    let listener = std::net::TcpListener::bind("127.0.0.1:0").expect("a port");
    let port = format!("tcp:{}", listener.local_addr().expect("bound"));
    connect(&port).assert().code(1).stderr(contains("no answer from the drive within 1s"));
    let talker = std::thread::spawn(move || {
        // The first is the one that was left without an answer.
        for stream in listener.incoming().take(3) {
            let _ = stream.expect("a host").write_all(&[0, 1, 2, 3, 0, 0x55, 0]);
        }
    });
    for _ in 0..2 {
        let error = Client::open(&port).err().expect("no drive");
        assert!(matches!(error, ClientError::Silent | ClientError::Lost(_)), "{error}");
    }
    talker.join().expect("ended");
}

/// A pair of pseudo-terminals is a serial cable with both ends on this computer.
#[cfg(unix)]
#[test]
fn a_serial_port_carries_the_same() {
    use host_sim::flash::SimulatedFlash;
    use host_sim::scenario::Scenario;
    use host_sim::virtual_drive::VirtualDrive;
    use quasidrive::link::session::Session;
    use serialport::{SerialPort, TTYPort};

    let (mut drives_end, hosts_end) = TTYPort::pair().expect("pseudo-terminals");
    let name = hosts_end.name().expect("a name");
    // The host opens it anew.
    drop(hosts_end);
    drives_end.set_timeout(Duration::from_millis(1)).expect("a timeout");
    let scenario = Scenario::read(&scenario()).expect("shipped");
    let mut drive = VirtualDrive::new(&scenario, SimulatedFlash::new()).expect("valid");
    let host = std::thread::spawn(move || {
        let mut client = Client::open(&name).expect("a drive");
        wait_for(&mut client, Mode::Ready);
        client.command(DriveCommand::Arm).expect("ready");
        wait_for(&mut client, Mode::Running);
        client.have_done(Request::SetTelemetry(20)).expect("done");
        client.command(DriveCommand::Speed(50.0)).expect("within the limits");
        let start = Instant::now();
        while client.telemetry().expect("some").iter().all(|telemetry| telemetry.speed < 49.0) {
            client.command(DriveCommand::KeepAlive).expect("answers");
            within(start, "it turns");
        }
    });
    let mut session = Session::default();
    let mut byte = [0];
    while !host.is_finished() {
        (0..20).for_each(|_| drive.run_period());
        // Either fails while the host's end is closed.
        while drives_end.read(&mut byte).is_ok_and(|count| count > 0) {
            if let Some(answer) = session.receive(byte[0], &mut drive) {
                let _ = drives_end.write_all(answer);
            }
        }
        while let Some(telemetry) = session.telemetry(&mut drive) {
            let _ = drives_end.write_all(telemetry);
        }
    }
    host.join().expect("a host that was content");
}
