//! Controllers and gains changed in the middle of a run, on the sensors of a board: without a bump.

use host_sim::board::SimulatedBoard;
use host_sim::scenario::{Controller, Scenario, StartName};
use host_sim::sensors::ReadsName;
use quasidrive::drive::{Drive, Fault, Mode};
use quasidrive::hal::{Board, BridgeCommand, Codes, Sample};
use std::path::Path;

fn scenario(controller: Controller) -> Scenario {
    let file = Path::new(env!("CARGO_MANIFEST_DIR")).join("host-sim/scenarios/encoder.toml");
    let mut scenario = Scenario::read(&file).expect("a shipped scenario");
    scenario.load.sines.clear();
    // Shifted reads suit the drive form; to the others they are noise.
    scenario.sensors.as_mut().expect("some").reads = ReadsName::All;
    scenario.control.controller = controller;
    scenario.control.start = StartName::Matched;
    // Gains of the paper's form that such sensors can feed: a twentieth of the paper's bandwidths, twenty times its authority.
    scenario.gains.c = 400.0;
    scenario.gains.k1 = 1900.0;
    scenario.gains.epsilon1 = 1900.0 / 500.0;
    scenario.gains.k2 = 1.4e7;
    scenario.gains.epsilon2 = 1.4e7 / 700.0;
    scenario
}

/// Plays periods; gives the largest deviation from `speed` (rad/s) and from `voltage` (V).
fn play(
    drive: &mut Drive<f32>,
    board: &mut SimulatedBoard<f32>,
    periods: usize,
    (speed, voltage): (f64, f64),
) -> (f64, f64) {
    let (mut off_speed, mut off_voltage) = (0.0_f64, 0.0_f64);
    for _ in 0..periods {
        let sample = board.sample();
        let command = drive.step(&sample);
        assert!(matches!(command, BridgeCommand::Duty(_)), "{:?}", drive.mode());
        board.apply(command);
        let applied = f64::from(drive.telemetry().expect("driven").voltage);
        off_speed = off_speed.max((board.state().speed - speed).abs());
        off_voltage = off_voltage.max((applied - voltage).abs());
    }
    (off_speed, off_voltage)
}

#[test]
fn controllers_take_over_without_a_bump() {
    // 0.05 N·m at 100 rad/s: Kb·ω + Ra·T/Kb.
    let steady = (100.0, 59e-3 * 100.0 + 0.7 * 0.05 / 59e-3);
    let all = [
        Controller::DriveQsmdo,
        Controller::Pi,
        Controller::DriveQismc,
        Controller::BsQsmdo,
        Controller::DriveQsmdo,
        Controller::Ladrc,
        Controller::BsQismc,
        Controller::DriveQsmdo,
    ];
    let first = scenario(all[0]);
    let mut drive = Drive::<f32>::new(&first.drive_config()).expect("valid");
    let mut board = SimulatedBoard::<f32>::new(&first, *drive.bases());
    drive.arm().expect("no fault");
    drive.set_speed(100.0).expect("in range");
    play(&mut drive, &mut board, 20_000, steady);
    for pair in all.windows(2) {
        let calm = play(&mut drive, &mut board, 4000, steady);
        let next = scenario(pair[1]);
        drive.take_controller(&mut Drive::new(&next.drive_config()).expect("valid"));
        let (speed, voltage) = play(&mut drive, &mut board, 4000, steady);
        let name = format!("{} to {}", pair[0], pair[1]);
        // Each controller has its own ripple; a bump is what exceeds both.
        assert!(
            speed < 0.1 && voltage < 0.15,
            "{name}: {speed} rad/s, {voltage} V, before {calm:?}"
        );
        play(&mut drive, &mut board, 2000, steady);
    }
    assert_eq!(drive.mode(), Mode::Running);
}

#[test]
fn a_change_while_off_waits_for_the_drive_to_be_armed() {
    let first = scenario(Controller::Pi);
    let mut drive = Drive::<f32>::new(&first.drive_config()).expect("valid");
    let mut board = SimulatedBoard::<f32>::new(&first, *drive.bases());
    let next = scenario(Controller::DriveQsmdo);
    drive.take_controller(&mut Drive::new(&next.drive_config()).expect("valid"));
    assert_eq!(drive.step(&board.sample()), BridgeCommand::Off);
    drive.arm().expect("no fault");
    assert!(matches!(drive.step(&board.sample()), BridgeCommand::Duty(_)));
}

/// The drive of a scenario that turns at 100 rad/s, and its board.
fn running(controller: Controller) -> (Drive<f32>, SimulatedBoard<f32>) {
    let first = scenario(controller);
    let mut drive = Drive::<f32>::new(&first.drive_config()).expect("valid");
    let mut board = SimulatedBoard::<f32>::new(&first, *drive.bases());
    drive.arm().expect("no fault");
    drive.set_speed(100.0).expect("in range");
    play(&mut drive, &mut board, 10_000, (0.0, 0.0));
    (drive, board)
}

fn other(controller: Controller) -> Drive<f32> {
    Drive::new(&scenario(controller).drive_config()).expect("valid")
}

#[test]
fn two_changes_in_one_period_are_as_one() {
    let (mut drive, mut board) = running(Controller::DriveQsmdo);
    drive.take_controller(&mut other(Controller::Pi));
    drive.take_controller(&mut other(Controller::DriveQismc));
    let (speed, _) = play(&mut drive, &mut board, 4000, (100.0, 0.0));
    assert!(speed < 0.1, "{speed} rad/s");
}

#[test]
fn a_controller_that_came_while_off_knows_the_speed() {
    for next in [Controller::DriveQsmdo, Controller::Pi, Controller::Ladrc, Controller::BsQsmdo] {
        let (mut drive, mut board) = running(Controller::DriveQsmdo);
        drive.disarm();
        for _ in 0..2 {
            let command = drive.step(&board.sample());
            board.apply(command);
        }
        drive.take_controller(&mut other(next));
        let command = drive.step(&board.sample());
        board.apply(command);
        drive.arm().expect("no fault");
        let (speed, _) = play(&mut drive, &mut board, 2000, (100.0, 0.0));
        // The load of 0.05 N·m pulls the coasting motor down for two periods, and then until its current is there.
        assert!(speed < 3.0, "{next}: {speed} rad/s");
    }
}

#[test]
fn a_fault_on_the_very_first_sample_leaves_the_speed_known() {
    for controller in [Controller::DriveQsmdo, Controller::Pi] {
        let (mut drive, mut board) = running(controller);
        drive.disarm();
        for _ in 0..4 {
            let command = drive.step(&board.sample());
            board.apply(command);
        }
        drive.arm().expect("no fault");
        let Sample::Codes(codes) = board.sample() else { unreachable!("a scenario with sensors") };
        let without_bus = Sample::Codes(Codes { bus_voltage: 0, ..codes });
        assert_eq!(drive.step(&without_bus), BridgeCommand::Off);
        assert_eq!(drive.mode(), Mode::Faulted(Fault::BusUndervoltage));
        board.apply(BridgeCommand::Off);
        drive.clear_fault();
        drive.arm().expect("cleared");
        let (speed, _) = play(&mut drive, &mut board, 2000, (100.0, 0.0));
        assert!(speed < 3.0, "{controller}: {speed} rad/s");
    }
}
