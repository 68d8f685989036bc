//! What a host and a drive say to each other.
//!
//! Numbers are in SI units. New requests and answers go at the end of their lists, so that the others keep their codes; a change
//! of what is there needs another [`VERSION`].

use crate::commission::{Evidence, Nameplate, Progress};
use crate::config::ConfigError;
use crate::fault::{ActiveLimits, Faults};
use crate::schema::{SetError, Value};
use crate::supervisor::{self, Command, Mode};
use core::fmt;
use serde::{Deserialize, Serialize};

/// Version of the messages: host and drive must have the same. Every version has [`Request::Identify`] and its answer.
pub const VERSION: u16 = 2;

/// A request with its number.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Numbered<'a> {
    /// Chosen by the host; its answer has the same. Consecutive numbers tell a late answer from a wanted one.
    pub sequence: u16,
    /// What was asked.
    #[serde(borrow)]
    pub request: Request<'a>,
}

/// What a host asks. Each request has exactly one answer, and each counts as a sign of life for
/// [`Protection::command_timeout`](crate::supervisor::Protection::command_timeout).
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Request<'a> {
    /// Who are you? Answered by [`Answer::Identity`]. Forgets what is staged: the first request of a new host.
    Identify,
    /// What are you doing? Answered by [`Answer::Status`].
    Status,
    /// A command; [`Command::KeepAlive`] if there is nothing else to ask.
    Command(Command),
    /// Send [`Telemetry`] once in so many periods; zero: never. As from start.
    SetTelemetry(u32),
    /// Which parameter in force has so many others ahead of it? Answered by [`Answer::Parameter`], or by
    /// [`Refusal::NoParameter`] behind the last one.
    ReadParameter(u16),
    /// Stage a value: beside those in force and those staged before, for [`ApplyParameters`](Self::ApplyParameters). What a name holds comes after
    /// it. If this is refused, nothing stays staged.
    StageParameter {
        /// Its name.
        name: &'a str,
        /// What it is to be.
        #[serde(borrow)]
        value: Value<'a>,
    },
    /// Go on with what is staged, all of it or none; nothing stays staged. With outputs off only, but for another controller or
    /// other gains, `control` and all under it, at any time but in the modes `Armed` and `Commissioning`.
    ApplyParameters,
    /// Keep the parameters that are in force when the power is off. With outputs off only.
    SaveParameters,
    /// Measure the motor, within the limits in force and those of the nameplate. In mode `Ready` only; it ends in the same.
    /// [`Command::Off`] aborts it.
    Commission(Nameplate),
    /// How far is that? Answered by [`Answer::Progress`].
    ReadProgress,
    /// What was measured? Answered by [`Answer::Evidence`], once outputs are off and until it is tried to
    /// change parameters.
    ReadEvidence,
}

/// What a drive answers.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Answer<'a> {
    /// Who it is.
    #[serde(borrow)]
    Identity(Identity<'a>),
    /// It was done.
    Done,
    /// It was not done.
    #[serde(borrow)]
    Refused(Refusal<'a>),
    /// What it is doing.
    Status(Status),
    /// A parameter in force.
    Parameter {
        /// Its name.
        name: &'a str,
        /// What it is.
        #[serde(borrow)]
        value: Value<'a>,
    },
    /// How far commissioning is; over, where there is none.
    Progress(Progress),
    /// What commissioning measured.
    Evidence(Evidence),
}

/// What a drive sends.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Message<'a> {
    /// An answer.
    Answer {
        /// Number of the request.
        sequence: u16,
        /// What became of it.
        #[serde(borrow)]
        answer: Answer<'a>,
    },
    /// A period, without being asked each time.
    Telemetry(Telemetry),
}

/// Who a drive is.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Identity<'a> {
    /// [`VERSION`] of its messages.
    pub version: u16,
    /// The board.
    pub board: &'a str,
    /// Version of its firmware.
    pub firmware: &'a str,
    /// What the firmware was built from: a commit, if the build knew it.
    pub build: &'a str,
}

/// What a drive is doing.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct Status {
    /// Whether it drives.
    pub mode: Mode,
    /// Why it stopped.
    pub faults: Faults,
    /// What it holds back.
    pub limits: ActiveLimits,
}

/// A period.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Telemetry {
    /// Periods since the start; wraps at 2³². A gap tells of telemetry that found no room on the line.
    pub period: u32,
    /// Reference speed ω_d (rad/s).
    pub reference: f32,
    /// Shaft speed ω, measured or estimated (rad/s).
    pub speed: f32,
    /// Armature current i (A), positive when it accelerates in the positive direction.
    pub current: f32,
    /// Armature voltage that was asked of the bridge (V); zero with outputs off.
    pub voltage: f32,
    /// Bus voltage (V).
    pub bus_voltage: f32,
    /// Estimated load torque (N·m), positive when it opposes positive motion.
    pub load_torque: f32,
    /// Temperature of the board (°C).
    pub temperature: f32,
    /// Time that the last control interrupt took (ns).
    pub interrupt_time: u32,
    /// Longest time that a control interrupt took since the start (ns).
    pub longest_interrupt_time: u32,
}

/// Why a request was refused.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Refusal<'a> {
    /// It is none that this firmware knows.
    NotUnderstood,
    /// It means nothing, or is not allowed, in the mode that the drive is in.
    Mode(Mode),
    /// The commanded speed is beyond [`Limits::speed`](crate::drive::Limits::speed), or none.
    SpeedOutOfRange,
    /// A value of the configuration; see [`ConfigError`].
    Config {
        /// Its name.
        field: &'a str,
        /// What it must satisfy.
        rule: &'a str,
        /// What it was, in the field's SI unit.
        value: f32,
    },
    /// There is no such parameter, or not with the values that others have.
    NoParameter,
    /// The parameter cannot have this value.
    UnfitValue,
    /// Nothing is staged.
    NothingStaged,
    /// The one before has not been carried out yet.
    Busy,
    /// The flash did not take the parameters. Those that were saved before are still there.
    NotSaved,
    /// The motor was not measured since the drive started.
    NotCommissioned,
}

impl From<ConfigError> for Refusal<'static> {
    fn from(ConfigError { field, rule, value }: ConfigError) -> Self {
        Self::Config { field, rule, value }
    }
}

impl From<SetError> for Refusal<'static> {
    fn from(error: SetError) -> Self {
        match error {
            SetError::Unknown => Self::NoParameter,
            SetError::Unfit => Self::UnfitValue,
        }
    }
}

impl From<supervisor::Refusal> for Refusal<'static> {
    fn from(refusal: supervisor::Refusal) -> Self {
        match refusal {
            supervisor::Refusal::SpeedOutOfRange => Self::SpeedOutOfRange,
            supervisor::Refusal::Mode(mode) => Self::Mode(mode),
        }
    }
}

impl fmt::Display for Refusal<'_> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotUnderstood => f.write_str("the drive's firmware does not know this request"),
            Self::Mode(mode) => write!(f, "not while the drive is in mode {mode:?}"),
            Self::SpeedOutOfRange => f.write_str("the speed is beyond limits.speed"),
            Self::Config { field, rule, value } => write!(f, "{field} {rule}, but is {value:?}"),
            Self::NoParameter => {
                f.write_str("there is no such parameter, or not with the others as they are")
            }
            Self::UnfitValue => f.write_str("the parameter cannot have this value"),
            Self::NothingStaged => f.write_str("no parameters were staged"),
            Self::Busy => f.write_str("the drive is still busy with the request before"),
            Self::NotSaved => f.write_str(
                "the flash did not take the parameters; those saved before are still there",
            ),
            Self::NotCommissioned => {
                f.write_str("the motor was not measured since the drive started")
            }
        }
    }
}
