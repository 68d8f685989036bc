//! Refusal of a configuration: which field, what it must satisfy, what it was.

use core::fmt;

/// A configuration value that was refused. Values are checked once, when a drive is built; the loop has no errors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ConfigError {
    /// Name of the parameter, `motor.inertia`, or of the group, `motor`, where no single one is to blame: as in
    /// [`parameters`](crate::parameters).
    pub field: &'static str,
    /// The rule that the value breaks, as it reads after the field's name: `must be positive and finite`.
    pub rule: &'static str,
    /// The refused value, in the field's SI unit.
    pub value: f32,
}

impl fmt::Display for ConfigError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} {}, but is {:?}", self.field, self.rule, self.value)
    }
}

impl core::error::Error for ConfigError {}

/// Passes `value` on if `holds`, else names the field and the rule.
pub(crate) fn require(
    holds: bool,
    field: &'static str,
    rule: &'static str,
    value: f32,
) -> Result<f32, ConfigError> {
    if holds { Ok(value) } else { Err(ConfigError { field, rule, value }) }
}

/// Passes on a positive, normal number: zero, negative, subnormal, infinite and NaN values are refused.
pub(crate) fn positive(field: &'static str, value: f32) -> Result<f32, ConfigError> {
    require(value > 0.0 && value.is_normal(), field, "must be positive and finite", value)
}

/// Passes on zero or a positive finite number.
pub(crate) fn non_negative(field: &'static str, value: f32) -> Result<f32, ConfigError> {
    require(value >= 0.0 && value.is_finite(), field, "must be zero or positive, and finite", value)
}
