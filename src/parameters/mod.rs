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
//! | `link.…` | the link to a host | [`LinkParameters`] |
//!
//! Units and ranges stand at the fields of these types, which are the same that a scenario is played with. A set is checked as a
//! whole, by [`LinkParameters::check`] and by building a [`Drive`](crate::drive::Drive) from it: rules tie fields together.
//!
//! [`named`] turns a set into named values and back, [`store`] keeps it in flash.

pub mod named;
pub mod store;

use crate::config::{ConfigError, require};
use crate::drive::DriveConfig;
use named::{Error, Sink, Source};
use serde::{Deserialize, Serialize};

/// A set of parameters.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Parameters {
    /// What the drive is built from.
    pub drive: DriveConfig,
    /// The link to a host.
    pub link: LinkParameters,
}

impl Parameters {
    /// Tells `sink` every parameter by its name.
    pub fn write(&self, sink: &mut Sink) -> Result<(), Error> {
        let Self { drive, link } = self;
        named::write("", drive, sink)?;
        named::write("link", link, sink)
    }

    /// Reads a set from named values.
    pub fn read(source: &Source) -> Result<Self, Error> {
        Ok(Self { drive: named::read("", source)?, link: named::read("link", source)? })
    }
}

/// What a drive makes of the link to its host.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct LinkParameters {
    /// How long an armed drive goes on without a request from its host (s). From 0.01 to 60.
    pub command_timeout: f32,
}

impl LinkParameters {
    /// A second: long for a program, short for a person who has pulled the plug.
    pub const DEFAULT: Self = Self { command_timeout: 1.0 };

    /// Refuses values outside their range, naming the field.
    pub fn check(&self) -> Result<(), ConfigError> {
        require(
            (0.01..=60.0).contains(&self.command_timeout),
            "link.command_timeout",
            "must be from 0.01 to 60 s",
            self.command_timeout,
        )?;
        Ok(())
    }
}
