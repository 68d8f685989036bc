//! What runs when no parameters are stored: made for a first spin of a small 12 to 24 V motor with little current, not for any
//! motor in particular.

use super::{analogue, bridge};
use crate::control::drive_form::DriveFormConfig;
use crate::control::{ControlConfig, Timing};
use crate::drive::{DriveConfig, Limits};
use crate::motor::MotorParameters;
use crate::parameters::Parameters;
use crate::sense::{Calibration, Reads, Sensors};
use crate::supervisor::Protection;
use crate::trajectory::Shape;

/// The board's loop.
pub const TIMING: Timing = Timing { rate: bridge::RATE, delay: true };

/// The board's sensors, with an encoder of so many counts a turn (all four edges counted; negative if it counts the other way round).
pub const fn calibration(counts_per_turn: i32) -> Calibration {
    let current_zero = analogue::SHUNTS.zero();
    Calibration {
        current_per_code: analogue::CURRENT_PER_CODE,
        current_zero: current_zero as f32,
        bus_voltage_per_code: analogue::BUS_PER_CODE,
        counts_per_turn,
        highest_code: 2 * current_zero,
        reads: Reads::Shifted,
    }
}

/// Low limits.
pub const LIMITS: Limits = Limits {
    duty: 0.5,
    speed: 200.0,
    current: 6.0,
    current_command: 2.0,
    bus_min: 8.0,
    bus_max: 28.0,
};

/// What goes with them.
pub const PROTECTION: Protection = Protection {
    continuous_current: 2.0,
    thermal_time: 10.0,
    temperature: 70.0,
    command_timeout: 0.5,
    stop_time: 2.0,
    standstill: 2.0,
};

/// The paper's motor with an encoder of 1024 lines, under the drive form.
pub fn parameters() -> Parameters {
    let motor = MotorParameters::PAPER;
    let calibration = calibration(4096);
    // The tenth of the bus that this leaves in reserve covers the dead time, which takes up to 0.4 V at 24 V.
    let current = LIMITS.current_command;
    let control = DriveFormConfig::default_for(&motor, &TIMING, &calibration, 24.0, current);
    let drive = DriveConfig {
        motor,
        sensors: Sensors::Codes(calibration),
        control: ControlConfig::Drive(control),
        timing: TIMING,
        limits: LIMITS,
        shape: Shape::SecondOrder { bandwidth: 20.0 },
    };
    Parameters { drive, protection: PROTECTION }
}
