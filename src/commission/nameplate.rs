//! What a user knows of a motor, and what commissioning makes of it for a drive.

use super::{CommissionConfig, NoLoad};
use crate::config::{ConfigError, require};
use crate::drive::DriveConfig;
use crate::sense::Sensors;
use serde::{Deserialize, Serialize};

/// What a user knows of a motor. What is not known is taken from the drive's parameters in force.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Nameplate {
    /// Rated voltage, which the motor may get at most (V). Not known: what the duty's limit leaves of the bus.
    pub voltage: Option<f32>,
    /// Speed without load at that voltage (rad/s): checks the counts.
    pub no_load_speed: Option<f32>,
    /// Counts of the encoder a turn, all four edges counted.
    pub counts_per_turn: Option<i32>,
    /// Highest current (A), at most [`Limits::current`](crate::drive::Limits::current).
    pub current: Option<f32>,
    /// Highest speed (rad/s).
    pub speed: Option<f32>,
    /// How far the shaft may turn to either side (rad). Not known: as far as it likes.
    pub travel: Option<f32>,
}

impl Nameplate {
    /// What to commission with, on a drive with these parameters. [`Commission::new`](super::Commission::new) checks the values.
    pub fn config(&self, drive: &DriveConfig) -> Result<CommissionConfig, ConfigError> {
        let &DriveConfig { mut sensors, timing, mut limits, .. } = drive;
        if let (Sensors::Codes(calibration), Some(counts)) = (&mut sensors, self.counts_per_turn) {
            calibration.counts_per_turn = counts;
        }
        limits.current_command = self.current.unwrap_or(limits.current_command);
        limits.speed = self.speed.unwrap_or(limits.speed);
        let no_load = match (self.no_load_speed, self.voltage) {
            (Some(speed), Some(voltage)) => Some(NoLoad { speed, voltage }),
            (Some(speed), None) => {
                require(false, "no_load.voltage", "must be known with its speed", speed)?;
                None
            }
            (None, _) => None,
        };
        Ok(CommissionConfig {
            sensors,
            timing,
            limits,
            voltage: self.voltage.unwrap_or(f32::INFINITY),
            travel: self.travel.unwrap_or(f32::INFINITY),
            no_load,
        })
    }
}
