//! All that a user may set: one schema for firmware, host and scenario files, by name, with its defaults and its place in flash.
//!
//! | names | what | type |
//! |---|---|---|
//! | `motor.…` | the motor | [`MotorParameters`](crate::motor::MotorParameters) |
//! | `sensors.…` | what codes and counts mean | [`Sensors`](crate::sense::Sensors) |
//! | `control.…` | the controller and its gains | [`ControlConfig`](crate::control::ControlConfig) |
//! | `timing.…` | sampling rate and delay | [`Timing`](crate::control::Timing) |
//! | `limits.…` | what a sample may hold, and what the bridge may be told | [`Limits`](crate::drive::Limits) |
//! | `reference.…` | how commanded speeds become references | [`Shape`](crate::trajectory::Shape) |
//! | `protection.…` | heat, temperature, lost commands | [`Protection`] |
//!
//! Units and ranges stand at the fields of these types, which are the same that a scenario is played with. A set is checked as a
//! whole, by building a [`Supervisor`](crate::supervisor::Supervisor) from it: rules tie fields together.
//!
//! [`named`] turns a set into named values and back, [`store`] keeps it in flash.

pub mod named;
pub mod store;

use crate::drive::DriveConfig;
use crate::supervisor::Protection;
use named::{Error, Sink, Source};
use serde::{Deserialize, Serialize};

/// A set of parameters.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Parameters {
    /// What the drive is built from.
    pub drive: DriveConfig,
    /// What watches over it.
    pub protection: Protection,
}

impl Parameters {
    /// Tells `sink` every parameter by its name.
    pub fn write(&self, sink: &mut Sink) -> Result<(), Error> {
        let Self { drive, protection } = self;
        named::write("", drive, sink)?;
        named::write("protection", protection, sink)
    }

    /// Reads a set from named values.
    pub fn read(source: &Source) -> Result<Self, Error> {
        Ok(Self { drive: named::read("", source)?, protection: named::read("protection", source)? })
    }
}
