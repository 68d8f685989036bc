//! What a sample may hold, and what may be asked for.

use crate::config::{ConfigError, positive, require};
use crate::schema::group;

/// Limits. A sample outside them is a fault; a duty outside them is limited.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limits {
    /// Largest magnitude of the duty, from above 0 to 1. A bridge with bootstrapped high sides needs less than 1.
    pub duty: f32,
    /// Largest plausible speed, and largest speed that can be commanded (rad/s). Positive.
    pub speed: f32,
    /// Over-current trip (A). Positive.
    pub current: f32,
    /// Largest current that a controller asks for (A), where it has a current to ask for: all but the paper's form. Positive,
    /// at most `current`.
    pub current_command: f32,
    /// Under-voltage trip of the bus (V). Positive.
    pub bus_min: f32,
    /// Over-voltage trip of the bus (V). Above `bus_min`.
    pub bus_max: f32,
}

group! { Limits { duty, speed, current, current_command, bus_min, bus_max } }

impl Limits {
    pub(crate) fn check(&self) -> Result<(), ConfigError> {
        require(
            self.duty > 0.0 && self.duty <= 1.0,
            "limits.duty",
            "must be above 0 and at most 1",
            self.duty,
        )?;
        // Squares and products of these appear in the law: far from overflow.
        for (field, value) in [
            ("limits.speed", self.speed),
            ("limits.current", self.current),
            ("limits.current_command", self.current_command),
            ("limits.bus_min", self.bus_min),
            ("limits.bus_max", self.bus_max),
        ] {
            positive(field, value)?;
            require(value <= 1e6, field, "must be at most 1e6", value)?;
        }
        require(
            self.current_command <= self.current,
            "limits.current_command",
            "must be at most limits.current",
            self.current_command,
        )?;
        require(
            self.bus_max > self.bus_min,
            "limits.bus_max",
            "must be above limits.bus_min",
            self.bus_max,
        )?;
        Ok(())
    }
}
