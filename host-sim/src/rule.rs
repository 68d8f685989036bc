//! Rules that a scenario's fields obey.

use quasidrive::config::ConfigError;

/// A field that breaks a rule.
pub(crate) struct Broken {
    /// Its path in the file.
    pub field: String,
    /// What it must satisfy, and what it was.
    pub rule: String,
}

impl From<ConfigError> for Broken {
    fn from(error: ConfigError) -> Self {
        Self {
            field: error.field.to_owned(),
            rule: format!("{}, but is {:?}", error.rule, error.value),
        }
    }
}

pub(crate) fn rule(holds: bool, field: &str, rule: &str, value: f64) -> Result<(), Broken> {
    if holds {
        return Ok(());
    }
    Err(Broken { field: field.to_owned(), rule: format!("{rule}, but is {value:?}") })
}

pub(crate) fn finite(field: &str, value: f64) -> Result<(), Broken> {
    rule(value.is_finite(), field, "must be finite", value)
}

pub(crate) fn positive(field: &str, value: f64) -> Result<(), Broken> {
    rule(value > 0.0 && value.is_finite(), field, "must be positive and finite", value)
}

pub(crate) fn non_negative(field: &str, value: f64) -> Result<(), Broken> {
    rule(value >= 0.0 && value.is_finite(), field, "must be zero or positive, and finite", value)
}
