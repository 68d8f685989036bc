//! Parameters by name, as text: to list, and to change.

use quasidrive::schema::{Parameter, Value, walk};
use std::fmt;

/// What a parameter is.
#[derive(Clone, Debug, PartialEq)]
pub enum Setting {
    /// A number, in its SI unit.
    Number(f32),
    /// A name.
    Name(String),
}

impl Setting {
    /// As the link tells it.
    pub fn value(&self) -> Value<'_> {
        match self {
            Self::Number(number) => Value::Number(*number),
            Self::Name(name) => Value::Name(name),
        }
    }

    /// What a text means.
    pub fn parse(text: &str) -> Self {
        // A name may look like NaN or infinity to a parser of numbers; neither is a parameter.
        let number = text.parse().ok().filter(|number: &f32| number.is_finite());
        number.map_or_else(|| Self::Name(text.to_owned()), Self::Number)
    }
}

impl From<Value<'_>> for Setting {
    fn from(value: Value) -> Self {
        match value {
            Value::Number(number) => Self::Number(number),
            Value::Name(name) => Self::Name(name.to_owned()),
        }
    }
}

impl fmt::Display for Setting {
    fn fmt(&self, f: &mut fmt::Formatter) -> fmt::Result {
        match self {
            Self::Number(number) => write!(f, "{number:?}"),
            Self::Name(name) => f.write_str(name),
        }
    }
}

/// A parameter's name and what it is.
pub type Assignment = (String, Setting);

/// `NAME=VALUE`.
pub fn parse(text: &str) -> Result<Assignment, String> {
    let (name, value) = text.split_once('=').ok_or("must be NAME=VALUE")?;
    Ok((name.trim().to_owned(), Setting::parse(value.trim())))
}

/// All that is under a parameter, which is called `root`.
pub fn list(root: &str, parameter: &mut dyn Parameter) -> Vec<Assignment> {
    let mut assignments = Vec::new();
    walk(parameter, &mut |path, parameter| {
        let dot = if root.is_empty() || path.is_empty() { "" } else { "." };
        if let Some(value) = parameter.get() {
            assignments.push((format!("{root}{dot}{path}"), value.into()));
        }
        true
    });
    assignments
}

/// The same, what is held behind what holds it.
pub fn in_order(assignments: &[Assignment]) -> Vec<&Assignment> {
    let mut ordered: Vec<_> = assignments.iter().collect();
    ordered.sort_by_key(|(name, _)| name.matches('.').count());
    ordered
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Scenario;
    use quasidrive::control::ControlConfig;
    use quasidrive::control::paper::Law;
    use quasidrive::parameters::Parameters;
    use quasidrive::schema::{SetError, set};
    use quasidrive::trajectory::Shape;

    fn change(changes: &[&str]) -> Result<Parameters, SetError> {
        let changes: Vec<_> =
            changes.iter().map(|text| parse(text).expect("an assignment")).collect();
        let mut parameters = Scenario::paper().parameters();
        for (name, setting) in in_order(&changes) {
            set(&mut parameters, name, setting.value())?;
        }
        Ok(parameters)
    }

    #[test]
    fn what_is_listed_can_be_assigned() {
        let mut parameters = Scenario::paper().parameters();
        let lines: Vec<String> = list("", &mut parameters)
            .iter()
            .map(|(name, setting)| format!("{name}={setting}"))
            .collect();
        assert!(lines.contains(&"motor.resistance=0.7".to_owned()), "{lines:?}");
        assert!(lines.contains(&"control.law=Qsmdo".to_owned()));
        let lines: Vec<&str> = lines.iter().map(String::as_str).collect();
        assert_eq!(change(&lines), Ok(parameters));
        let control = list("control", &mut parameters.drive.control);
        assert_eq!(control[0], ("control".to_owned(), Setting::Name("Paper".to_owned())));
        assert_eq!(control[2].0, "control.gains.c");
    }

    #[test]
    fn numbers_names_and_flags_change() {
        let changed = change(&[
            "limits.speed=250",
            "control.gains.c = 1e2",
            "control.law=Backstepping",
            "timing.delay=false",
        ])
        .expect("good");
        assert_eq!(changed.drive.limits.speed, 250.0);
        assert!(!changed.drive.timing.delay);
        let ControlConfig::Paper(paper) = changed.drive.control else {
            unreachable!("the paper's")
        };
        assert_eq!(paper.gains.c, 100.0);
        assert_eq!(paper.law, Law::Backstepping);
    }

    #[test]
    fn what_holds_others_is_set_ahead_of_them() {
        let shaped = change(&["reference.bandwidth=60", "reference=SecondOrder"]).expect("good");
        assert_eq!(shaped.drive.shape, Shape::SecondOrder { bandwidth: 60.0 });
        assert_eq!(change(&["reference.bandwidth=60"]), Err(SetError::Unknown), "another shape");
    }

    #[test]
    fn what_does_not_fit_is_refused() {
        for text in [
            "limits.speed=fast",
            "limits.speed=NaN",
            "limits.speed=true",
            "timing.delay=1",
            "control=Neural",
            "control.law=qsmdo",
        ] {
            assert_eq!(change(&[text]), Err(SetError::Unfit), "{text}");
        }
        for text in ["limits.sped=1", "=1", "limits=1", "control.observer_bandwidth=1"] {
            assert_eq!(change(&[text]), Err(SetError::Unknown), "{text}");
        }
        assert!(parse("limits.speed").is_err());
    }
}
