//! Parameters by name, as text: to list, and to change.

use quasidrive::parameters::Parameters;
use quasidrive::parameters::named::{Error, Value};
use std::cell::RefCell;
use std::collections::{BTreeMap, BTreeSet};

/// A change that was refused.
#[derive(Debug, PartialEq, Eq, thiserror::Error)]
pub enum AssignmentError {
    /// There is no such parameter, or not beside the others.
    #[error("there is no parameter {0}, or not with the others as they are")]
    Unknown(String),
    /// The text is no value of the parameter, or one that needs others beside it.
    #[error(
        "{0} cannot be so, or not without parameters that are missing (`parameters get` lists those that are there)"
    )]
    Unfit(String),
    /// The parameters cannot be named.
    #[error("the parameters cannot be listed: {0}")]
    Unlisted(#[from] Error),
}

/// All parameters, names and values.
pub fn list(parameters: &Parameters) -> Result<Vec<(String, String)>, Error> {
    let mut lines = Vec::new();
    parameters.write(&mut |path, value| {
        let text = match value {
            Value::Group => return Ok(()),
            Value::Number(number) => format!("{number:?}"),
            Value::Integer(integer) => integer.to_string(),
            Value::Flag(flag) => flag.to_string(),
            Value::Name(name) => name.to_owned(),
        };
        lines.push((path.to_owned(), text));
        Ok(())
    })?;
    Ok(lines)
}

/// Parameters with some changed.
pub fn assign(
    parameters: &Parameters,
    changes: &[(String, String)],
) -> Result<Parameters, AssignmentError> {
    let mut present = BTreeMap::new();
    parameters.write(&mut |path, value| {
        present.insert(path.to_owned(), value);
        Ok(())
    })?;
    // What holds a changed parameter may not be there yet.
    for (name, _) in changes {
        for (end, _) in name.match_indices('.') {
            present.entry(name[..end].to_owned()).or_insert(Value::Group);
        }
    }
    let wanted = RefCell::new(BTreeSet::new());
    let changed = Parameters::read(&|path, accept| {
        let present = present.get(path).copied();
        let text = changes.iter().rev().find(|(name, _)| name == path).map(|(_, text)| text);
        match text {
            // Only what a group holds can change.
            Some(text) if present != Some(Value::Group) => {
                wanted.borrow_mut().insert(path.to_owned());
                readings(text).find(accept)
            }
            _ => present.filter(accept),
        }
    });
    let unknown = changes.iter().find(|(name, _)| !wanted.borrow().contains(name));
    match (changed, unknown) {
        (Ok(changed), None) => Ok(changed),
        (_, Some((name, _))) => Err(AssignmentError::Unknown(name.clone())),
        (Err(_), None) => {
            let names: Vec<&str> = changes.iter().map(|(name, _)| name.as_str()).collect();
            Err(AssignmentError::Unfit(names.join(", ")))
        }
    }
}

/// All values that a text can be.
fn readings(text: &str) -> impl Iterator<Item = Value<'_>> {
    let number = text.parse().ok().filter(|number: &f32| number.is_finite()).map(Value::Number);
    let integer = text.parse().ok().map(Value::Integer);
    let flag = text.parse().ok().map(Value::Flag);
    [number, integer, flag, Some(Value::Name(text))].into_iter().flatten()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scenario::Scenario;
    use quasidrive::control::ControlConfig;
    use quasidrive::control::paper::Law;
    use quasidrive::trajectory::Shape;

    fn change(changes: &[(&str, &str)]) -> Result<Parameters, AssignmentError> {
        let owned: Vec<_> =
            changes.iter().map(|(name, text)| ((*name).to_owned(), (*text).to_owned())).collect();
        assign(&Scenario::paper().parameters(), &owned)
    }

    #[test]
    fn what_is_listed_can_be_assigned() {
        let parameters = Scenario::paper().parameters();
        let lines = list(&parameters).expect("listed");
        assert!(lines.contains(&("motor.resistance".to_owned(), "0.7".to_owned())), "{lines:?}");
        assert!(lines.contains(&("control.Paper.law".to_owned(), "Qsmdo".to_owned())));
        assert_eq!(assign(&parameters, &lines), Ok(parameters));
    }

    #[test]
    fn numbers_names_and_flags_change() {
        let changed = change(&[
            ("limits.speed", "250"),
            ("control.Paper.gains.c", "1e2"),
            ("control.Paper.law", "Backstepping"),
            ("timing.delay", "false"),
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
    fn a_variant_changes_with_all_that_it_holds() {
        let bandwidth = ("reference.SecondOrder.bandwidth", "60");
        let shaped = change(&[("reference", "SecondOrder"), bandwidth]).expect("good");
        assert_eq!(shaped.drive.shape, Shape::SecondOrder { bandwidth: 60.0 });
        let alone = change(&[("reference", "SecondOrder")]).expect_err("no bandwidth");
        assert_eq!(alone, AssignmentError::Unfit("reference".to_owned()));
        let other = change(&[bandwidth]).expect_err("another shape");
        assert_eq!(other, AssignmentError::Unknown(bandwidth.0.to_owned()));
    }

    #[test]
    fn what_does_not_fit_is_refused_by_name() {
        for (name, text) in [
            ("limits.speed", "fast"),
            ("limits.speed", "NaN"),
            ("limits.speed", "true"),
            ("timing.delay", "1"),
            ("control", "Neural"),
            ("control.Paper.law", "qsmdo"),
        ] {
            let error = change(&[(name, text)]).expect_err(text);
            assert_eq!(error, AssignmentError::Unfit(name.to_owned()), "{text}");
        }
        for name in ["limits.sped", "", "limits", "control.Drive.observer_bandwidth"] {
            let error = change(&[(name, "1")]).expect_err(name);
            assert_eq!(error, AssignmentError::Unknown(name.to_owned()));
        }
    }
}
