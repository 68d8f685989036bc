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
//! Names and values are by [`schema`](crate::schema). [`records`] turns a set into bytes and back, [`store`] keeps it in flash.

pub mod records;
pub mod store;

use crate::drive::DriveConfig;
use crate::schema::{Group, Visitor};
use crate::supervisor::Protection;

/// A set of parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameters {
    /// What the drive is built from.
    pub drive: DriveConfig,
    /// What watches over it.
    pub protection: Protection,
}

impl Group for Parameters {
    fn fields(&mut self, visitor: &mut Visitor) {
        let Self { drive, protection } = self;
        drive.fields(visitor);
        visitor("protection", protection);
    }
}
