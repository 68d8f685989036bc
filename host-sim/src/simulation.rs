//! Plays a scenario: the drive against the simulated board, period by period, through the HAL trait.

use crate::board::SimulatedBoard;
use crate::double::SimulatedScalar;
use crate::frame::Frame;
use crate::metrics::{Meter, Metrics};
use crate::profile::value_at;
use crate::scenario::Scenario;
use quasidrive::config::ConfigError;
use quasidrive::drive::{Drive, Fault, Mode, Refusal};

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Figures of merit, up to a fault.
    pub metrics: Metrics,
    /// When (s) and why the drive stopped, if it did. The run ends there.
    pub fault: Option<(f64, Fault)>,
}

/// Why a run could not be played.
#[derive(Clone, Copy, Debug, PartialEq, thiserror::Error)]
pub enum SimulationError {
    /// The drive's configuration was refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The drive refused a command.
    #[error("the drive refused a command: {0:?}")]
    Refused(Refusal),
}

/// Plays `scenario` with a drive that computes in `S`, and shows every period to `each`.
pub fn simulate<S: SimulatedScalar>(
    scenario: &Scenario,
    mut each: impl FnMut(&Frame),
) -> Result<Outcome, SimulationError> {
    let mut drive = Drive::<S>::new(&scenario.drive_config())?;
    let mut board = SimulatedBoard::<S>::new(scenario);
    drive.arm().map_err(SimulationError::Refused)?;
    let mut meter = Meter::default();
    let mut command = None;
    let mut last_jump = 0.0;
    for _ in 0..scenario.periods() {
        let time = board.time();
        let wanted = value_at(&scenario.reference.steps, 0.0, time);
        if command.replace(wanted) != Some(wanted) {
            last_jump = time;
            drive.set_speed(S::from_f64(wanted)).map_err(SimulationError::Refused)?;
        }
        let state = board.state();
        let load_torque = board.load_torque();
        drive.run_period(&mut board);
        if let Mode::Faulted(fault) = drive.mode() {
            return Ok(Outcome { metrics: meter.metrics(), fault: Some((time, fault)) });
        }
        let Some(telemetry) = drive.telemetry() else { continue };
        let [sliding1, sliding2] = drive.sliding_variables();
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
            load_torque_estimate: drive.load_torque().to_f64(),
        };
        meter.add(&frame, time - last_jump);
        each(&frame);
    }
    Ok(Outcome { metrics: meter.metrics(), fault: None })
}
