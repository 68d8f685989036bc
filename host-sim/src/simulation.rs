//! Plays a scenario: the drive against the simulated board, period by period, through the HAL trait.

use crate::board::SimulatedBoard;
use crate::double::{Double, SimulatedScalar};
use crate::frame::Frame;
use crate::link::{Link, LinkError, Local};
use crate::metrics::{Meter, Metrics};
use crate::profile::value_at;
use crate::scenario::Scenario;
use clap::ValueEnum;
use quasidrive::control::ControlConfig;
use quasidrive::drive::{Fault, Mode, Telemetry};
use quasidrive::hal::Board;
use quasidrive::math::Q31;
use quasidrive::per_unit::Bases;
use serde::Serialize;

/// How a run ended.
#[derive(Clone, Debug)]
pub struct Outcome {
    /// Figures of merit, up to a fault.
    pub metrics: Metrics,
    /// When (s) and why the drive stopped, if it did. The run ends there.
    pub fault: Option<(f64, Fault)>,
}

/// What a drive computes in.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum ScalarName {
    /// Single precision, for cores with an FPU.
    #[default]
    F32,
    /// Fixed point, for cores without.
    Q31,
    /// Double precision, on a PC only.
    F64,
}

/// Plays `scenario` with a drive in this process that computes in a scalar of this name.
pub fn simulate_in(
    scalar: ScalarName,
    scenario: &Scenario,
    each: impl FnMut(&Frame),
) -> Result<Outcome, LinkError> {
    match scalar {
        ScalarName::F32 => simulate::<f32>(scenario, each),
        ScalarName::Q31 => simulate::<Q31>(scenario, each),
        ScalarName::F64 => simulate::<Double>(scenario, each),
    }
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
    let config = scenario.drive_config();
    let bases = Bases::new(&config)?;
    // The second sliding variable is a z2, or a current.
    let second = match config.control {
        ControlConfig::Drive(_) => bases.current,
        _ => bases.acceleration,
    };
    let mut board = SimulatedBoard::<S>::new(scenario, bases);
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
        let period = drive.exchange(wanted as f32, &board.sample())?;
        board.apply(period.command);
        if let Mode::Faulted(fault) = period.mode {
            return Ok(Outcome { metrics: meter.metrics(), fault: Some((time, fault)) });
        }
        let Some(telemetry) = period.telemetry else { continue };
        let Telemetry { reference, signals, voltage, load_torque: estimate, .. } = telemetry;
        let reference = reference.speed.to_f64(bases.speed);
        let [sliding1, sliding2] = telemetry.sliding_variables;
        let frame = Frame {
            time,
            reference,
            speed: state.speed,
            current: state.current,
            voltage: voltage.to_f64(bases.voltage),
            z1: state.speed - reference,
            z2: signals.z2.to_f64(bases.acceleration),
            sliding1: sliding1.to_f64(bases.speed),
            sliding2: sliding2.to_f64(second),
            load_torque,
            load_torque_estimate: estimate.to_f64(bases.torque),
        };
        meter.add(&frame, time - last_jump);
        each(&frame);
    }
    Ok(Outcome { metrics: meter.metrics(), fault: None })
}
