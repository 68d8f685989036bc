//! What to play: read from TOML, checked, refused with file, line and field.
//!
//! The schema is documented for users in `scenarios/README.md`.

use crate::plant::{MOST_STEPS, Motor, Plant, State};
use crate::profile::{Load, Step};
use crate::rule::{Broken, finite, non_negative, positive, rule};
use crate::sensors::SensorsTable;
use clap::ValueEnum;
use quasidrive::control::drive_form::{DriveFormConfig, Memory, bandwidth_for_ripple};
use quasidrive::control::ladrc::LadrcConfig;
use quasidrive::control::paper::{Form, Gains, Law, PaperConfig, Start};
use quasidrive::control::pi::PiConfig;
use quasidrive::control::{ControlConfig, Timing};
use quasidrive::drive::{DriveConfig, Limits};
use quasidrive::estimate::SpeedSource;
use quasidrive::motor::MotorParameters;
use quasidrive::parameters::Parameters;
use quasidrive::sense::{Reads, Sensors};
use quasidrive::supervisor::{Protection, Supervisor};
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
    /// The motor; the controller is built for the same one, less Coulomb friction, unless `model` says otherwise.
    pub motor: Motor,
    /// What the controller believes of the motor.
    #[serde(default)]
    pub model: Model,
    /// Sampling.
    #[serde(default)]
    pub timing: TimingTable,
    /// Supply.
    #[serde(default)]
    pub bus: Bus,
    /// How the bridge fails to be ideal.
    #[serde(default)]
    pub bridge: Bridge,
    /// What stands between the truth and the drive; without it sensors are exact.
    pub sensors: Option<SensorsTable>,
    /// Which law runs, and how.
    #[serde(default)]
    pub control: Control,
    /// Gains of the paper's form; by default the paper's.
    #[serde(default)]
    pub gains: GainsTable,
    /// Tuning of the drive form.
    #[serde(default)]
    pub tuning: Tuning,
    /// Tuning of the cascaded PI controllers.
    #[serde(default)]
    pub pi: PiTable,
    /// Tuning of LADRC.
    #[serde(default)]
    pub ladrc: LadrcTable,
    /// Limits of the drive.
    #[serde(default)]
    pub limits: LimitsTable,
    /// What watches over a drive that is served.
    #[serde(default)]
    pub protection: ProtectionTable,
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

/// `[model]`: what the controller believes, as multiples of the truth.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "as in `[motor]`")]
pub struct Model {
    pub inertia: f64,
    pub inductance: f64,
    pub resistance: f64,
    pub back_emf_constant: f64,
}

impl Default for Model {
    fn default() -> Self {
        Self { inertia: 1.0, inductance: 1.0, resistance: 1.0, back_emf_constant: 1.0 }
    }
}

/// `[bridge]`, with the motor's brushes.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Bridge {
    /// Steps of the duty from 0 to 1; none: any duty.
    pub duty_steps: u32,
    /// Dead time of each half-bridge (s).
    pub dead_time: f64,
    /// Voltage that the motor's brushes take, against the current (V).
    pub brush_drop: f64,
    /// Current (A) up to which its ripple lets both change their sign within a period, so that they grow with the current. A motor
    /// whose current they reverse within a period needs more.
    pub ripple: f64,
    /// Whether the motor is connected the wrong way round, which the drive does not know.
    pub leads_reversed: bool,
}

impl Default for Bridge {
    fn default() -> Self {
        Self { duty_steps: 0, dead_time: 0.0, brush_drop: 0.0, ripple: 0.05, leads_reversed: false }
    }
}

impl Bridge {
    /// The mean armature voltage (V) of a duty.
    pub fn voltage(&self, duty: f64, bus: f64, current: f64, rate: f64) -> f64 {
        let duty = if self.duty_steps > 0 {
            let steps = f64::from(self.duty_steps);
            (duty * steps).round() / steps
        } else {
            duty
        };
        let duty = if self.leads_reversed { -duty } else { duty };
        // Both half-bridges lose the dead time once a period.
        let lost = 2.0 * self.dead_time * rate * bus + self.brush_drop;
        duty * bus - lost * (current / self.ripple).clamp(-1.0, 1.0)
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
    /// Resistance of the supply (Ω).
    pub resistance: f64,
}

impl Default for Bus {
    fn default() -> Self {
        Self { voltage: 24.0, steps: Vec::new(), resistance: 0.0 }
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
    /// Where the speed comes from, for all but the drive form; by default exact, or a fed loop if there are sensors.
    pub speed: Option<SpeedName>,
    /// Bandwidth of that (rad/s).
    pub speed_bandwidth: Option<f64>,
}

/// Where a controller that wants a speed has it from.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum SpeedName {
    /// As the sensors tell it: exact ones, or the times of edges.
    Exact,
    /// The angle's difference, low-passed.
    Difference,
    /// A phase-locked loop.
    Pll,
    /// One that is fed with the acceleration that the controller knows of.
    FedPll,
}

/// `[tuning]` of the drive form; see [`DriveFormConfig`].
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct Tuning {
    /// Bandwidth of the observer (rad/s), from which the others follow.
    pub bandwidth: Option<f64>,
    /// In its place, the voltage ripple that it is to make (V rms).
    pub ripple: Option<f64>,
    /// Largest load torque (N·m).
    pub load_torque: Option<f64>,
    /// Voltage reserve (V).
    pub voltage_reserve: Option<f64>,
    /// Convergence rate of z1 (1/s).
    pub speed_bandwidth: Option<f64>,
    /// Convergence rate of the current (1/s).
    pub current_bandwidth: Option<f64>,
    /// Bandwidth of the observer of the armature's unmodelled voltage (1/s).
    pub voltage_bandwidth: Option<f64>,
    /// Bandwidth of the filter ahead of the bridge (1/s).
    pub output_bandwidth: Option<f64>,
}

/// `[pi]`: what is to differ from a tuning by the book; see [`PiConfig`].
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "documented where they are used, in quasidrive")]
pub struct PiTable {
    pub current_bandwidth: Option<f64>,
    pub speed_bandwidth: Option<f64>,
    pub speed_damping: Option<f64>,
    pub disturbance: Option<f64>,
}

/// `[ladrc]`: by default a speed loop of 150 rad/s and the rest by the book; see [`LadrcConfig`].
#[derive(Clone, Copy, Debug, Default, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "documented where they are used, in quasidrive")]
pub struct LadrcTable {
    pub control_bandwidth: Option<f64>,
    pub observer_bandwidth: Option<f64>,
    pub current_bandwidth: Option<f64>,
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
    /// The drive form of BS-QSMDO.
    DriveQsmdo,
    /// The drive form of BS-QISMC.
    DriveQismc,
    /// Cascaded PI controllers, tuned by the book.
    Pi,
    /// Linear active disturbance rejection control.
    Ladrc,
}

impl Controller {
    /// The paper's, in its order.
    pub const PAPER: [Self; 3] = [Self::Bs, Self::BsQsmdo, Self::BsQismc];
}

impl fmt::Display for Controller {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Bs => "BS",
            Self::BsQsmdo => "BS-QSMDO",
            Self::BsQismc => "BS-QISMC",
            Self::DriveQsmdo => "drive BS-QSMDO",
            Self::DriveQismc => "drive BS-QISMC",
            Self::Pi => "PI",
            Self::Ladrc => "LADRC",
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

impl Default for GainsTable {
    fn default() -> Self {
        Self { c: 200.0, k1: 1300.0, epsilon1: 0.05, k2: 755e3, epsilon2: 5.0 }
    }
}

/// `[limits]`; see [`Limits`].
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "documented where they are used, in quasidrive")]
pub struct LimitsTable {
    pub duty: f64,
    pub speed: f64,
    pub current: f64,
    /// By default half of `current`.
    pub current_command: Option<f64>,
    pub bus_min: f64,
    pub bus_max: f64,
}

impl Default for LimitsTable {
    fn default() -> Self {
        Self {
            duty: 0.92,
            speed: 1000.0,
            current: 40.0,
            current_command: None,
            bus_min: 8.0,
            bus_max: 28.0,
        }
    }
}

/// `[protection]`; see [`Protection`].
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields, default)]
#[expect(missing_docs, reason = "documented where they are used, in quasidrive")]
pub struct ProtectionTable {
    /// By default `limits.current_command`.
    pub continuous_current: Option<f64>,
    pub thermal_time: f64,
    pub temperature: f64,
    pub command_timeout: f64,
    pub stop_time: f64,
    pub standstill: f64,
}

impl Default for ProtectionTable {
    fn default() -> Self {
        Self {
            continuous_current: None,
            thermal_time: 20.0,
            temperature: 85.0,
            command_timeout: 1.0,
            stop_time: 3.0,
            standstill: 2.0,
        }
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
    /// When the drive is armed (s). Until then the bridge is off and the drive follows the motor.
    pub armed_after: f64,
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
    /// Largest acceleration of the S-curve (rad/s²).
    pub acceleration: Option<f64>,
    /// Largest jerk of the S-curve (rad/s³).
    pub jerk: Option<f64>,
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
    /// Along an S-curve.
    SCurve,
}

impl ReferenceTable {
    /// How the drive is to shape; what a shape needs must be there, and nothing else.
    fn shape(&self) -> Result<Shape, Broken> {
        let broken = |field: &str, rule: &str| {
            Err(Broken { field: field.to_owned(), rule: rule.to_owned() })
        };
        match (self.shape, self.bandwidth, self.acceleration, self.jerk) {
            (ShapeName::Step, None, None, None) => Ok(Shape::Step),
            (ShapeName::SecondOrder, Some(bandwidth), None, None) => {
                Ok(Shape::SecondOrder { bandwidth: bandwidth as f32 })
            }
            (ShapeName::SCurve, None, Some(acceleration), Some(jerk)) => {
                Ok(Shape::SCurve { acceleration: acceleration as f32, jerk: jerk as f32 })
            }
            (ShapeName::SecondOrder, None, _, _) => {
                broken("reference.shape", "= \"second-order\" needs a bandwidth beside it")
            }
            (ShapeName::SCurve, _, None, _) | (ShapeName::SCurve, _, _, None) => {
                broken("reference.shape", "= \"s-curve\" needs acceleration and jerk beside it")
            }
            (ShapeName::Step | ShapeName::SCurve, Some(_), _, _) => {
                broken("reference.bandwidth", "is for shape = \"second-order\" only")
            }
            _ => broken("reference.shape", "has no use for acceleration or jerk"),
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

impl ScenarioError {
    /// Refuses a file for a reason beyond the file itself.
    pub(crate) fn new(file: &Path, message: String) -> Self {
        Self { file: file.to_owned(), line: None, message }
    }
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

/// Sets what the scenario sets.
fn replace(field: &mut f32, value: Option<f64>) {
    if let Some(value) = value {
        *field = value as f32;
    }
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
        non_negative("bus.resistance", self.bus.resistance)?;
        for (field, value) in [
            ("model.inertia", self.model.inertia),
            ("model.inductance", self.model.inductance),
            ("model.resistance", self.model.resistance),
            ("model.back_emf_constant", self.model.back_emf_constant),
        ] {
            positive(field, value)?;
        }
        let dead_time = self.bridge.dead_time;
        non_negative("bridge.dead_time", dead_time)?;
        let short = dead_time * self.timing.rate <= 0.1;
        rule(short, "bridge.dead_time", "must be at most a tenth of a period", dead_time)?;
        non_negative("bridge.brush_drop", self.bridge.brush_drop)?;
        positive("bridge.ripple", self.bridge.ripple)?;
        if let Some(sensors) = &self.sensors {
            sensors.check()?;
        }
        for (field, value, limit) in [
            ("initial.speed", self.initial.speed, self.limits.speed),
            ("initial.current", self.initial.current, self.limits.current),
        ] {
            rule(value.abs() <= limit, field, "must be within the drive's limits", value)?;
        }
        non_negative("initial.armed_after", self.initial.armed_after)?;
        check_steps("reference.steps", &self.reference.steps, |field, speed| {
            let holds = speed.abs() <= self.limits.speed;
            rule(holds, field, "must be within ±limits.speed", speed)
        })?;
        self.reference.shape()?;
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
        // Then the drive's own rules.
        let Parameters { drive, protection } = self.parameters();
        Supervisor::<f32>::new(&drive, &protection)
            .map_err(|error| Broken { field: self.name_in_file(error.field), ..error.into() })?;
        let steps = Plant::new(self.motor).steps_for(1.0 / self.timing.rate);
        let playable = steps <= MOST_STEPS;
        rule(playable, "motor.inductance", TOO_FAST, self.motor.inductance)?;
        Ok(())
    }

    /// What a drive's parameter is called in a scenario.
    fn name_in_file(&self, parameter: &str) -> String {
        let table = match self.control.controller {
            Controller::Bs | Controller::BsQsmdo | Controller::BsQismc => "control",
            Controller::DriveQsmdo | Controller::DriveQismc => "tuning",
            Controller::Pi => "pi",
            Controller::Ladrc => "ladrc",
        };
        let (group, name) = parameter.rsplit_once('.').unwrap_or(("", parameter));
        match (group, name) {
            ("control.speed", "bandwidth") => "control.speed_bandwidth".to_owned(),
            ("control.gains", gain) => format!("gains.{gain}"),
            ("control", "observer_bandwidth") if table == "tuning" => "tuning.bandwidth".to_owned(),
            ("control", name) if name != "speed" => format!("{table}.{name}"),
            _ => parameter.to_owned(),
        }
    }

    /// The configuration of the drive that this scenario tests.
    pub fn drive_config(&self) -> DriveConfig {
        let limits = &self.limits;
        let current_command = limits.current_command.unwrap_or(0.5 * limits.current);
        let (motor, timing) = (self.believed_motor(), self.believed_timing());
        let sensors = match &self.sensors {
            Some(sensors) => Sensors::Codes(sensors.calibration()),
            None => Sensors::Exact,
        };
        let limits = Limits {
            duty: limits.duty as f32,
            speed: limits.speed as f32,
            current: limits.current as f32,
            current_command: current_command as f32,
            bus_min: limits.bus_min as f32,
            bus_max: limits.bus_max as f32,
        };
        DriveConfig {
            motor,
            sensors,
            control: self.control_for(&motor, &sensors, &timing, &limits),
            timing,
            limits,
            // A broken one is refused before this matters.
            shape: self.reference.shape().unwrap_or_default(),
        }
    }

    /// The parameters of the drive that is served.
    pub fn parameters(&self) -> Parameters {
        let drive = self.drive_config();
        let table = &self.protection;
        let continuous_current = table.continuous_current.map(|current| current as f32);
        Parameters {
            drive,
            protection: Protection {
                continuous_current: continuous_current.unwrap_or(drive.limits.current_command),
                thermal_time: table.thermal_time as f32,
                temperature: table.temperature as f32,
                command_timeout: table.command_timeout as f32,
                stop_time: table.stop_time as f32,
                standstill: table.standstill as f32,
            },
        }
    }

    fn believed_timing(&self) -> Timing {
        Timing { rate: self.timing.rate as f32, delay: self.timing.delay }
    }

    fn believed_motor(&self) -> MotorParameters {
        let Self { motor, model, .. } = self;
        MotorParameters {
            inertia: (motor.inertia * model.inertia) as f32,
            inductance: (motor.inductance * model.inductance) as f32,
            resistance: (motor.resistance * model.resistance) as f32,
            viscous_friction: motor.viscous_friction as f32,
            back_emf_constant: (motor.back_emf_constant * model.back_emf_constant) as f32,
        }
    }

    /// The scenario's controller for a drive that has this motor, these sensors, timing and limits.
    pub fn control_for(
        &self,
        motor: &MotorParameters,
        sensors: &Sensors,
        timing: &Timing,
        limits: &Limits,
    ) -> ControlConfig {
        let speed = self.speed_source(sensors);
        let paper = |law| ControlConfig::Paper(self.paper_config(law, speed));
        let drive_form = || self.drive_form(motor, sensors, timing, limits);
        match self.control.controller {
            Controller::Bs => paper(Law::Backstepping),
            Controller::BsQsmdo => paper(Law::Qsmdo),
            Controller::BsQismc => paper(Law::Qismc),
            Controller::DriveQsmdo => ControlConfig::Drive(drive_form()),
            Controller::DriveQismc => {
                ControlConfig::Drive(drive_form().with_memory(Memory::Integral))
            }
            Controller::Pi => ControlConfig::Pi(self.pi_config(timing, speed)),
            Controller::Ladrc => ControlConfig::Ladrc(self.ladrc_config(timing, speed)),
        }
    }

    fn pi_config(&self, timing: &Timing, speed: SpeedSource) -> PiConfig {
        let PiTable { current_bandwidth, speed_bandwidth, speed_damping, disturbance } = self.pi;
        let mut config = PiConfig::magnitude_and_symmetrical_optimum(timing, speed);
        replace(&mut config.current_bandwidth, current_bandwidth);
        replace(&mut config.speed_bandwidth, speed_bandwidth);
        replace(&mut config.speed_damping, speed_damping);
        config.disturbance = disturbance.map(|bandwidth| bandwidth as f32);
        config
    }

    fn ladrc_config(&self, timing: &Timing, speed: SpeedSource) -> LadrcConfig {
        let LadrcTable { control_bandwidth, observer_bandwidth, current_bandwidth } = self.ladrc;
        let mut config =
            LadrcConfig::by_bandwidth(control_bandwidth.unwrap_or(150.0) as f32, timing, speed);
        replace(&mut config.observer_bandwidth, observer_bandwidth);
        replace(&mut config.current_bandwidth, current_bandwidth);
        config
    }

    fn speed_source(&self, sensors: &Sensors) -> SpeedSource {
        let default = match sensors {
            Sensors::Codes(calibration) if calibration.reads != Reads::Edges => SpeedName::FedPll,
            _ => SpeedName::Exact,
        };
        let default_bandwidth = match self.control.controller {
            // Slow enough for the estimators of the paper's form to build on; the others want little lag.
            Controller::Bs | Controller::BsQsmdo | Controller::BsQismc => 1400.0,
            _ => 4000.0,
        };
        let bandwidth = self.control.speed_bandwidth.unwrap_or(default_bandwidth) as f32;
        match self.control.speed.unwrap_or(default) {
            SpeedName::Exact => SpeedSource::Exact,
            SpeedName::Difference => SpeedSource::Difference { bandwidth },
            SpeedName::Pll => SpeedSource::Pll { bandwidth, fed: false },
            SpeedName::FedPll => SpeedSource::Pll { bandwidth, fed: true },
        }
    }

    /// Gains of the paper's form.
    pub fn gains(&self) -> Gains {
        let GainsTable { c, k1, epsilon1, k2, epsilon2 } = self.gains;
        Gains {
            c: c as f32,
            k1: k1 as f32,
            epsilon1: epsilon1 as f32,
            k2: k2 as f32,
            epsilon2: epsilon2 as f32,
        }
    }

    fn paper_config(&self, law: Law, speed: SpeedSource) -> PaperConfig {
        PaperConfig {
            law,
            gains: self.gains(),
            form: match self.control.form {
                FormName::Implicit => Form::Implicit,
                FormName::Explicit => Form::Explicit,
            },
            start: match self.control.start {
                StartName::Zero => Start::Zero,
                StartName::Matched => Start::Matched,
            },
            speed,
        }
    }

    fn drive_form(
        &self,
        motor: &MotorParameters,
        sensors: &Sensors,
        timing: &Timing,
        limits: &Limits,
    ) -> DriveFormConfig {
        let &Tuning { bandwidth, ripple, load_torque, voltage_reserve, .. } = &self.tuning;
        let calibration = match sensors {
            Sensors::Codes(calibration) => *calibration,
            Sensors::Exact => SensorsTable::default().calibration(),
        };
        let default = DriveFormConfig::default_for(
            motor,
            timing,
            &calibration,
            self.bus.voltage as f32,
            limits.current_command,
        );
        let mut knob = default.observer_bandwidth;
        if let Some(ripple) = ripple {
            knob = bandwidth_for_ripple(motor, timing, &calibration, ripple as f32);
        }
        replace(&mut knob, bandwidth);
        let mut config = DriveFormConfig::new(knob, default.load_torque, default.voltage_reserve);
        replace(&mut config.load_torque, load_torque);
        replace(&mut config.voltage_reserve, voltage_reserve);
        replace(&mut config.speed_bandwidth, self.tuning.speed_bandwidth);
        replace(&mut config.current_bandwidth, self.tuning.current_bandwidth);
        replace(&mut config.voltage_bandwidth, self.tuning.voltage_bandwidth);
        replace(&mut config.output_bandwidth, self.tuning.output_bandwidth);
        config
    }

    /// Number of PWM periods before the drive is armed.
    pub fn idle_periods(&self) -> u64 {
        (self.initial.armed_after * self.timing.rate).round() as u64
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
