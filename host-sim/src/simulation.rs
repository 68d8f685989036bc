//! Plays a scenario: the drive against the simulated board, period by period, through the HAL trait.

use crate::board::SimulatedBoard;
use crate::double::SimulatedScalar;
use crate::frame::Frame;
use crate::link::{Link, LinkError, Local};
use crate::metrics::{Meter, Metrics};
use crate::profile::value_at;
use crate::scenario::Scenario;
use quasidrive::drive::{Fault, Mode};
use quasidrive::hal::Board;

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Figures of merit, up to a fault.
    pub metrics: Metrics,
    /// When (s) and why the drive stopped, if it did. The run ends there.
    pub fault: Option<(f64, Fault)>,
}

/// Plays `scenario` with a drive in this process that computes in `S`, and shows every period to `each`.
pub fn simulate<S: SimulatedScalar>(
    scenario: &Scenario,
    each: impl FnMut(&Frame),
) -> Result<Outcome, LinkError> {
    let mut drive = Local::<S>::armed_after(&scenario.drive_config(), scenario.idle_periods())?;
    simulate_on(&mut drive, scenario, each)
}

/// Plays `scenario` with the drive behind a link, which must be at its first period, and armed or about to arm itself.
pub fn simulate_on<S: SimulatedScalar>(
    drive: &mut impl Link<S>,
    scenario: &Scenario,
    mut each: impl FnMut(&Frame),
) -> Result<Outcome, LinkError> {
    let mut board = SimulatedBoard::<S>::new(scenario);
    let mut meter = Meter::default();
    let mut command = None;
    let mut last_jump = 0.0;
    for _ in 0..scenario.periods() {
        let time = board.time();
        let wanted = value_at(&scenario.reference.steps, 0.0, time);
        if command.replace(wanted) != Some(wanted) {
            last_jump = time;
        }
        let state = board.state();
        let load_torque = board.load_torque();
        let period = drive.exchange(S::from_f64(wanted), &board.sample())?;
        board.apply(period.command);
        if let Mode::Faulted(fault) = period.mode {
            return Ok(Outcome { metrics: meter.metrics(), fault: Some((time, fault)) });
        }
        let Some(telemetry) = period.telemetry else { continue };
        let [sliding1, sliding2] = telemetry.sliding_variables;
        let frame = Frame {
            time,
            reference: telemetry.reference.speed.to_f64(),
            speed: state.speed,
            current: state.current,
            voltage: telemetry.voltage.to_f64(),
            z1: state.speed - telemetry.reference.speed.to_f64(),
            z2: telemetry.signals.z2.to_f64(),
            sliding1: sliding1.to_f64(),
            sliding2: sliding2.to_f64(),
            load_torque,
            load_torque_estimate: telemetry.load_torque.to_f64(),
        };
        meter.add(&frame, time - last_jump);
        each(&frame);
    }
    Ok(Outcome { metrics: meter.metrics(), fault: None })
}
