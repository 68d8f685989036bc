//! The firmware's image on the emulated board, with a scenario's motor. What needs the image is ignored here, and run by `cargo xtask test`.

use assert_cmd::Command;
use host_sim::client::{Client, ClientError};
use host_sim::emulated::{Emulated, play, read_image, setup};
use host_sim::profile::{Load, Sine};
use host_sim::scenario::Scenario;
use predicates::str::contains;
use quasidrive::commission::Nameplate;
use quasidrive::link::message::Request;
use quasidrive::supervisor::{Command as DriveCommand, Mode};
use std::io::{BufRead, BufReader};
use std::path::{Path, PathBuf};
use std::process::Stdio;
use std::time::{Duration, Instant};
use virtual_board::Image;

fn host_sim() -> Command {
    Command::new(env!("CARGO_BIN_EXE_host-sim"))
}

fn file() -> PathBuf {
    Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios/esc1.toml")
}

fn scenario(edit: impl FnOnce(&mut Scenario)) -> Scenario {
    let mut scenario = Scenario::read(&file()).expect("shipped");
    edit(&mut scenario);
    scenario
}

fn elf() -> PathBuf {
    let built = concat!(env!("CARGO_MANIFEST_DIR"), "/../target/firmware/b_g431b_esc1.elf");
    std::env::var_os("QUASIDRIVE_ELF").map_or(built.into(), PathBuf::from)
}

fn image() -> Image {
    read_image(&elf()).expect("an image; cargo xtask firmware builds it")
}

#[test]
fn what_the_board_cannot_do_is_refused_with_its_field() {
    type Edit = fn(&mut Scenario);
    let edits: [(&str, Edit); 5] = [
        ("timing.rate", |scenario| scenario.timing.rate = 10e3),
        ("timing.delay", |scenario| scenario.timing.delay = false),
        ("sensors.reads", |scenario| {
            scenario.sensors.as_mut().expect("some").reads = host_sim::sensors::ReadsName::All;
        }),
        ("initial.current", |scenario| scenario.initial.current = 1.0),
        ("initial.armed_after", |scenario| scenario.initial.armed_after = 0.1),
    ];
    for (field, edit) in edits {
        let error = setup::check(&scenario(edit), Path::new("my.toml")).expect_err(field);
        assert!(error.to_string().starts_with(&format!("my.toml: {field} must")), "{error}");
    }
    setup::check(&scenario(|_| {}), Path::new("my.toml")).expect("the shipped one");
    // 20 kHz is near enough; sensors are the board's.
    let near = scenario(|scenario| {
        scenario.timing.rate = 20e3;
        scenario.sensors = None;
    });
    setup::check(&near, Path::new("my.toml")).expect("near enough");
}

#[test]
fn a_file_that_is_no_image_is_told() {
    let board = |elf: &Path| {
        let mut command = host_sim();
        command.arg("board").arg(file()).arg("--elf").arg(elf);
        command
    };
    let nowhere = Path::new("nowhere.elf");
    board(nowhere)
        .assert()
        .code(1)
        .stderr(contains("cannot read nowhere.elf; cargo xtask firmware"));
    board(&file()).assert().code(1).stderr(contains("esc1.toml: no ELF file"));
    let campaign = host_sim().args(["campaign", "--elf", "nowhere.elf"]).assert();
    campaign.code(1).stderr(contains("cannot read nowhere.elf"));
}

#[test]
#[ignore = "needs the image: cargo xtask test"]
fn what_only_the_firmware_refuses_is_told_with_the_file() {
    let wide = scenario(|scenario| scenario.limits.duty = 0.95);
    let error = play::play(&image(), &wide, Path::new("my.toml"), |_| {}).err().expect("refused");
    let error = error.to_string();
    assert!(error.starts_with("my.toml: the board refuses limits.duty"), "{error}");
}

#[test]
#[ignore = "needs the image: cargo xtask test"]
fn telemetry_and_truth_meet_in_the_same_period() {
    // A current that changes by a tenth of an ampere and more from period to period.
    let fast = Sine { amplitude: 0.1, frequency: 300.0, phase: 0.0 };
    let short = scenario(|scenario| {
        scenario.duration = 0.3;
        scenario.load = Load { sines: vec![fast], ..Load::default() };
    });
    let played = play::play(&image(), &short, &file(), |_| {}).expect("plays");
    assert!(played.summary.fault.is_none() && !played.summary.is_misused());
    // Mean and deviation of what is told from what is true so many periods later.
    let apart = |shift: isize| {
        let errors = played.told.iter().filter_map(|(place, telemetry)| {
            let truth = played.truths.get(place.checked_add_signed(shift)?)?;
            Some(f64::from(telemetry.current) - truth.current)
        });
        let errors: Vec<f64> = errors.collect();
        let mean = errors.iter().sum::<f64>() / errors.len() as f64;
        let squares = errors.iter().map(|error| (error - mean).powi(2)).sum::<f64>();
        (mean, (squares / errors.len() as f64).sqrt())
    };
    assert!(played.told.len() > 200);
    // The zero is learnt through a rounding to 29 mA; then 5 mA of noise, and both shunts' rounding.
    let (offset, deviation) = apart(0);
    assert!(offset.abs() < 20e-3 && deviation < 10e-3, "{offset} A, {deviation} A");
    for shift in [-2, -1, 1, 2] {
        let (_, other) = apart(shift);
        assert!(other > 3.0 * deviation, "{shift}: {other} A, {deviation} A");
    }
}

#[test]
#[ignore = "needs the image: cargo xtask test"]
fn served_it_is_commanded_as_a_board_is() {
    let served = Path::new(env!("CARGO_MANIFEST_DIR")).join("scenarios/served.toml");
    let mut process = std::process::Command::new(env!("CARGO_BIN_EXE_host-sim"))
        .arg("serve")
        .arg(served)
        .args(["--port", "0", "--elf"])
        .arg(elf())
        .stdout(Stdio::piped())
        .spawn()
        .expect("runs");
    let mut line = String::new();
    BufReader::new(process.stdout.take().expect("piped")).read_line(&mut line).expect("a line");
    let (_, port) = line.trim().rsplit_once(" at ").expect("where it is");
    let end = || -> Result<f32, ClientError> {
        let mut client = Client::open(port)?;
        assert!(client.identity().starts_with("b-g431b-esc1 board"), "{}", client.identity());
        client.command(DriveCommand::Arm)?;
        let start = Instant::now();
        while client.status()?.mode != Mode::Running {
            assert!(start.elapsed() < Duration::from_secs(60));
        }
        client.command(DriveCommand::Speed(50.0))?;
        client.have_done(quasidrive::link::message::Request::SetTelemetry(100))?;
        let mut speed = 0.0;
        while (speed - 50.0_f32).abs() > 1.0 {
            speed = client.telemetry()?.last().map_or(speed, |telemetry| telemetry.speed);
            client.command(DriveCommand::KeepAlive)?;
            assert!(start.elapsed() < Duration::from_secs(120), "{speed} rad/s");
        }
        client.command(DriveCommand::Off)?;
        Ok(speed)
    }();
    let _ = process.kill();
    let _ = process.wait();
    end.expect("answers");
}

/// The image measures its motor, and what it does in a period meanwhile, with the fits of a phase's end, leaves room in it.
#[test]
#[ignore = "needs the image: cargo xtask test"]
fn it_measures_its_motor_within_its_periods() {
    let free = scenario(|scenario| scenario.load = Load::default());
    let emulated = Emulated::new(&image(), &free);
    let mut client = setup::boot(&emulated).expect("boots");
    setup::configure(&free, &file(), &mut client).expect("takes its parameters");
    setup::wait_for(&emulated, &mut client, Mode::Ready).expect("ready");
    // From now on: to take over parameters takes longer, with outputs off.
    emulated.board().statistics().clear();
    let nameplate = Nameplate { voltage: Some(24.0), current: Some(10.0), ..Nameplate::default() };
    client.have_done(Request::Commission(nameplate)).expect("ready");
    while matches!(client.status().expect("answers").mode, Mode::Armed | Mode::Commissioning) {
        emulated.run(20e-3).expect("runs");
    }
    let findings = client.findings().expect("some");
    assert_eq!((findings.stopped, client.status().expect("answers").mode), (None, Mode::Ready));
    let motor = free.motor;
    for (found, truth) in [
        (findings.resistance, motor.resistance),
        (findings.inductance, motor.inductance),
        (findings.back_emf_constant, motor.back_emf_constant),
        (findings.inertia, motor.inertia),
    ] {
        // As issue and README have it of random motors; the shunts' gain and dead time are the board's.
        let found = f64::from(found.expect("seen").value);
        assert!((found / truth - 1.0).abs() < 0.03, "{found} is not {truth}");
    }
    let mut board = emulated.board();
    let control = &board.statistics().handlers()[&CONTROL];
    let longest = control.cycles.max as f64 / CYCLES_A_PERIOD;
    println!("control interrupt at most {:.1} % of a period, by estimate", 100.0 * longest);
    assert!(longest < 0.6, "{longest} of a period");
}

/// Exception number of the control interrupt, ADC1_2.
const CONTROL: u16 = 18 + 16;

/// 170 MHz, and a counter to 4248 and back.
const CYCLES_A_PERIOD: f64 = 8496.0;
