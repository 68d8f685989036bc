//! What to play: read from TOML, checked, refused with file, line and field.
//!
//! The schema is documented for users in `scenarios/README.md`.

use crate::plant::{MOST_STEPS, Motor, Plant, State};
use crate::profile::{Load, Step};
use clap::ValueEnum;
use quasidrive::config::ConfigError;
use quasidrive::control::{ControlConfig, Form, Gains, Law, Start, Timing};
use quasidrive::drive::{DriveConfig, Limits};
use quasidrive::motor::MotorParameters;
use quasidrive::trajectory::Shape;
use serde::{Deserialize, Serialize};
use std::fmt;
use std::path::{Path, PathBuf};
use toml::de::{DeTable, DeValue};

/// One experiment on the simulated motor.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct Scenario {
    /// A line for people.
    pub title: String,
    /// Simulated time (s).
    pub duration: f64,
    /// The motor; the controller is built for the same one, less Coulomb friction.
    pub motor: Motor,
    /// Sampling.
    #[serde(default)]
    pub timing: TimingTable,
    /// Supply.
    #[serde(default)]
    pub bus: Bus,
    /// Which law runs, and how.
    #[serde(default)]
    pub control: Control,
    /// The law's gains.
    pub gains: GainsTable,
    /// Limits of the drive.
    #[serde(default)]
    pub limits: LimitsTable,
    /// State at t = 0.
    #[serde(default)]
    pub initial: Initial,
    /// Commanded speed.
    pub reference: ReferenceTable,
    /// Load torque.
    #[serde(default)]
    pub load: Load,
}

/// `[timing]`
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct TimingTable {
    /// Sampling rate (Hz).
    pub rate: f64,
    /// Whether voltages take effect one period late.
    pub delay: bool,
}

impl Default for TimingTable {
    fn default() -> Self {
        Self { rate: 20_000.0, delay: true }
    }
}

/// `[bus]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Bus {
    /// Voltage ahead of the first step (V).
    pub voltage: f64,
    /// Voltages that replace it from their times on.
    pub steps: Vec<Step>,
}

impl Default for Bus {
    fn default() -> Self {
        Self { voltage: 24.0, steps: Vec::new() }
    }
}

/// `[control]`
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Control {
    /// The law.
    pub controller: Controller,
    /// How its equations are stepped.
    pub form: FormName,
    /// Where BS-QSMDO's observer starts.
    pub start: StartName,
}

/// A law, by the paper's name for it.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize, PartialEq, Eq, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum Controller {
    /// Plain backstepping.
    Bs,
    /// With the quasi-sliding-mode disturbance observer.
    #[default]
    BsQsmdo,
    /// With quasi-integral sliding mode control.
    BsQismc,
}

impl Controller {
    /// All of them, in the paper's order.
    pub const ALL: [Self; 3] = [Self::Bs, Self::BsQsmdo, Self::BsQismc];

    fn law(self) -> Law {
        match self {
            Self::Bs => Law::Backstepping,
            Self::BsQsmdo => Law::Qsmdo,
            Self::BsQismc => Law::Qismc,
        }
    }
}

impl fmt::Display for Controller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bs => "BS",
            Self::BsQsmdo => "BS-QSMDO",
            Self::BsQismc => "BS-QISMC",
        })
    }
}

/// How the estimators' equations are stepped.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize, PartialEq, Eq, ValueEnum)]
#[serde(rename_all = "kebab-case")]
pub enum FormName {
    /// Injection closed implicitly over the step.
    #[default]
    Implicit,
    /// Forward Euler.
    Explicit,
}

/// Where BS-QSMDO's observer starts.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum StartName {
    /// With x̂1 = ẑ2 = 0, as the paper's simulation does.
    #[default]
    Zero,
    /// With its states equal to what they observe.
    Matched,
}

/// `[gains]`; see [`Gains`].
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
#[expect(missing_docs, reason = "documented where they are used, in quasidrive")]
pub struct GainsTable {
    pub c: f64,
    pub k1: f64,
    pub epsilon1: f64,
    pub k2: f64,
    pub epsilon2: f64,
}

/// `[limits]`; see [`Limits`].
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "documented where they are used, in quasidrive")]
pub struct LimitsTable {
    pub duty: f64,
    pub speed: f64,
    pub current: f64,
    pub bus_min: f64,
    pub bus_max: f64,
}

impl Default for LimitsTable {
    fn default() -> Self {
        Self { duty: 0.92, speed: 1000.0, current: 40.0, bus_min: 8.0, bus_max: 28.0 }
    }
}

/// `[initial]`
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Initial {
    /// Shaft speed (rad/s).
    pub speed: f64,
    /// Armature current (A).
    pub current: f64,
}

impl Initial {
    /// As the plant's state.
    pub fn state(&self) -> State {
        State { speed: self.speed, current: self.current }
    }
}

/// `[reference]`
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ReferenceTable {
    /// Commanded speeds (rad/s); zero ahead of the first.
    pub steps: Vec<Step>,
    /// How they are shaped.
    #[serde(default)]
    pub shape: ShapeName,
    /// Natural frequency of the second-order shape (rad/s).
    pub bandwidth: Option<f64>,
}

/// How commanded speeds become references.
#[derive(Clone, Copy, Debug, Default, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum ShapeName {
    /// Not at all.
    #[default]
    Step,
    /// Through a critically damped second-order filter.
    SecondOrder,
}

impl ReferenceTable {
    fn check_shape(&self) -> Result<(), Broken> {
        let broken = |field: &str, rule: &str| {
            Err(Broken { field: field.to_owned(), rule: rule.to_owned() })
        };
        match (self.shape, self.bandwidth) {
            (ShapeName::Step, Some(_)) => {
                broken("reference.bandwidth", "is for shape = \"second-order\" only")
            }
            (ShapeName::SecondOrder, None) => {
                broken("reference.shape", "= \"second-order\" needs a bandwidth beside it")
            }
            _ => Ok(()),
        }
    }
}

/// A scenario that was refused: file, line, and what is wrong with which field.
#[derive(Debug, thiserror::Error)]
pub struct ScenarioError {
    file: PathBuf,
    line: Option<usize>,
    message: String,
}

impl fmt::Display for ScenarioError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}", self.file.display())?;
        if let Some(line) = self.line {
            write!(f, ":{line}")?;
        }
        write!(f, ": {}", self.message)
    }
}

const TOO_FAST: &str = "must not give, with the other parameters, a motor that takes more than 1000 integration steps \
                        a period";

/// A field that breaks a rule.
struct Broken {
    field: String,
    rule: String,
}

impl From<ConfigError> for Broken {
    fn from(error: ConfigError) -> Self {
        Self {
            field: error.field.to_owned(),
            rule: format!("{}, but is {:?}", error.rule, error.value),
        }
    }
}

fn rule(holds: bool, field: &str, rule: &str, value: f64) -> Result<(), Broken> {
    if holds {
        return Ok(());
    }
    Err(Broken { field: field.to_owned(), rule: format!("{rule}, but is {value:?}") })
}

fn finite(field: &str, value: f64) -> Result<(), Broken> {
    rule(value.is_finite(), field, "must be finite", value)
}

fn positive(field: &str, value: f64) -> Result<(), Broken> {
    rule(value > 0.0 && value.is_finite(), field, "must be positive and finite", value)
}

fn non_negative(field: &str, value: f64) -> Result<(), Broken> {
    rule(value >= 0.0 && value.is_finite(), field, "must be zero or positive, and finite", value)
}

/// Checks the order of the times, and each value by `check_value`.
fn check_steps(
    field: &str,
    steps: &[Step],
    check_value: impl Fn(&str, f64) -> Result<(), Broken>,
) -> Result<(), Broken> {
    let mut before = 0.0;
    for (index, step) in steps.iter().enumerate() {
        let time = format!("{field}[{index}].time");
        non_negative(&time, step.time)?;
        rule(step.time >= before, &time, "must not be before the step above it", step.time)?;
        before = step.time;
        check_value(&format!("{field}[{index}].value"), step.value)?;
    }
    Ok(())
}

impl Scenario {
    /// The paper's experiment, as shipped in `scenarios/paper.toml`.
    pub fn paper() -> Self {
        let text = include_str!("../scenarios/paper.toml");
        #[expect(clippy::expect_used, reason = "a shipped file, held by a test")]
        Self::parse(text, Path::new("paper.toml")).expect("the shipped scenario is valid")
    }

    /// Reads and checks a scenario file.
    pub fn read(file: &Path) -> Result<Self, ScenarioError> {
        let text = std::fs::read_to_string(file).map_err(|error| ScenarioError {
            file: file.to_owned(),
            line: None,
            message: error.to_string(),
        })?;
        Self::parse(&text, file)
    }

    /// Parses and checks a scenario; `file` is for messages only.
    pub fn parse(text: &str, file: &Path) -> Result<Self, ScenarioError> {
        let refuse = |line, message| ScenarioError { file: file.to_owned(), line, message };
        let line_at = |offset: usize| text[..offset].matches('\n').count() + 1;
        let document = toml::Deserializer::parse(text).map_err(|error| {
            refuse(error.span().map(|span| line_at(span.start)), error.message().to_owned())
        })?;
        let scenario: Self = serde_path_to_error::deserialize(document).map_err(|error| {
            let field = error.path().to_string();
            let inner = error.inner();
            let line = inner.span().map(|span| line_at(span.start));
            let message = match field.as_str() {
                "." => inner.message().to_owned(),
                field => format!("{field}: {}", inner.message()),
            };
            refuse(line, message)
        })?;
        scenario.check().map_err(|Broken { field, rule }| {
            let line = offset_of(text, &field).map(line_at);
            refuse(line, format!("{field} {rule}"))
        })?;
        Ok(scenario)
    }

    /// Checks a scenario that was changed after it was read from `file`.
    pub fn recheck(&self, file: &Path) -> Result<(), ScenarioError> {
        self.check().map_err(|Broken { field, rule }| ScenarioError {
            file: file.to_owned(),
            line: None,
            message: format!("with the command line's changes, {field} {rule}"),
        })
    }

    /// Every rule that the types do not hold already. A field is named by its path in the file.
    fn check(&self) -> Result<(), Broken> {
        positive("duration", self.duration)?;
        rule(self.duration <= 1e5, "duration", "must be at most 1e5 s", self.duration)?;
        positive("timing.rate", self.timing.rate)?;
        rule(self.periods() > 0, "duration", "must be at least a period", self.duration)?;
        positive("motor.inertia", self.motor.inertia)?;
        positive("motor.inductance", self.motor.inductance)?;
        positive("motor.resistance", self.motor.resistance)?;
        positive("motor.back_emf_constant", self.motor.back_emf_constant)?;
        non_negative("motor.viscous_friction", self.motor.viscous_friction)?;
        non_negative("motor.coulomb_friction", self.motor.coulomb_friction)?;
        positive("bus.voltage", self.bus.voltage)?;
        check_steps("bus.steps", &self.bus.steps, positive)?;
        for (field, value, limit) in [
            ("initial.speed", self.initial.speed, self.limits.speed),
            ("initial.current", self.initial.current, self.limits.current),
        ] {
            rule(value.abs() <= limit, field, "must be within the drive's limits", value)?;
        }
        check_steps("reference.steps", &self.reference.steps, |field, speed| {
            let holds = speed.abs() <= self.limits.speed;
            rule(holds, field, "must be within ±limits.speed", speed)
        })?;
        self.reference.check_shape()?;
        finite("load.constant", self.load.constant)?;
        check_steps("load.steps", &self.load.steps, finite)?;
        for (index, sine) in self.load.sines.iter().enumerate() {
            finite(&format!("load.sines[{index}].amplitude"), sine.amplitude)?;
            let frequency = format!("load.sines[{index}].frequency");
            non_negative(&frequency, sine.frequency)?;
            let resolved = sine.frequency <= 0.1 * self.timing.rate;
            rule(resolved, &frequency, "must be at most a tenth of timing.rate", sine.frequency)?;
            finite(&format!("load.sines[{index}].phase"), sine.phase)?;
        }
        // Then the drive's own rules, with its own names for the same fields.
        quasidrive::drive::Drive::<f32>::new(&self.drive_config())?;
        let steps = Plant::new(self.motor).steps_for(1.0 / self.timing.rate);
        let playable = steps <= MOST_STEPS;
        rule(playable, "motor.inductance", TOO_FAST, self.motor.inductance)?;
        Ok(())
    }

    /// The configuration of the drive that this scenario tests.
    pub fn drive_config(&self) -> DriveConfig {
        let gains = &self.gains;
        let limits = &self.limits;
        DriveConfig {
            motor: MotorParameters {
                inertia: self.motor.inertia as f32,
                inductance: self.motor.inductance as f32,
                resistance: self.motor.resistance as f32,
                viscous_friction: self.motor.viscous_friction as f32,
                back_emf_constant: self.motor.back_emf_constant as f32,
            },
            control: ControlConfig {
                law: self.control.controller.law(),
                gains: Gains {
                    c: gains.c as f32,
                    k1: gains.k1 as f32,
                    epsilon1: gains.epsilon1 as f32,
                    k2: gains.k2 as f32,
                    epsilon2: gains.epsilon2 as f32,
                },
                form: match self.control.form {
                    FormName::Implicit => Form::Implicit,
                    FormName::Explicit => Form::Explicit,
                },
                start: match self.control.start {
                    StartName::Zero => Start::Zero,
                    StartName::Matched => Start::Matched,
                },
            },
            timing: Timing { rate: self.timing.rate as f32, delay: self.timing.delay },
            limits: Limits {
                duty: limits.duty as f32,
                speed: limits.speed as f32,
                current: limits.current as f32,
                bus_min: limits.bus_min as f32,
                bus_max: limits.bus_max as f32,
            },
            shape: match (self.reference.shape, self.reference.bandwidth) {
                (ShapeName::SecondOrder, Some(bandwidth)) => {
                    Shape::SecondOrder { bandwidth: bandwidth as f32 }
                }
                _ => Shape::Step,
            },
        }
    }

    /// Number of PWM periods that are played.
    pub fn periods(&self) -> u64 {
        (self.duration * self.timing.rate).round() as u64
    }
}

/// Byte offset of a field's value, or of the innermost table on its path that is there.
fn offset_of(text: &str, field: &str) -> Option<usize> {
    let document = DeTable::parse(text).ok()?;
    let mut keys = field.split(['.', '[']).map(|key| key.trim_end_matches(']'));
    let first = document.get_ref().get(keys.next()?)?;
    let mut place = first;
    for key in keys {
        let inner = match place.get_ref() {
            DeValue::Table(table) => table.get(key),
            DeValue::Array(array) => key.parse().ok().and_then(|index: usize| array.get(index)),
            _ => None,
        };
        match inner {
            Some(inner) => place = inner,
            None => break,
        }
    }
    Some(place.span().start)
}
