//! Speed controllers: pure functions of a sample, a reference and a small state. No hardware, no units but SI.
//!
//! - [`ControlConfig`] is any of them: [`paper`], the paper's own form of BS, BS-QSMDO and BS-QISMC; [`drive_form`], BS-QSMDO
//!   and BS-QISMC as a drive with an encoder needs them; [`pi`] and [`ladrc`], what users would pick instead;
//! - [`injection`] is the quasi-sliding injection, [`bounds`] the ultimate bounds.
//!
//! Not here: shaping of the reference ([`crate::trajectory`]), duty and faults ([`crate::drive`]).

pub mod bounds;
pub mod drive_form;
pub mod injection;
pub mod ladrc;
pub mod paper;
pub mod pi;

use crate::config::{ConfigError, require};
use crate::math::Scalar;
use crate::motor::Coefficients;
use crate::per_unit::Bases;
use crate::schema::{choice, group};
use crate::sense::{Measured, Shaft};
use crate::trajectory::Reference;
use drive_form::DriveForm;
use injection::Injections;
use ladrc::Ladrc;
use paper::Paper;
use pi::CascadedPi;

/// When the loop samples and when its voltage takes effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    /// Sampling rate, which is the PWM rate (Hz). From 100 to 10 million.
    pub rate: f32,
    /// Whether a voltage takes effect one period after the sample it was computed from, as on every real board, or at
    /// once, as in a textbook.
    pub delay: bool,
}

group! { Timing { rate, delay } }

impl Timing {
    /// The sampling period h (s).
    pub fn period(&self) -> f32 {
        1.0 / self.rate
    }

    /// Time from a sample to the end of the period in which the voltage computed from it acts (s).
    pub fn horizon(&self) -> f32 {
        if self.delay { 2.0 * self.period() } else { self.period() }
    }

    pub(crate) fn check(&self) -> Result<(), ConfigError> {
        require(
            (100.0..=1e7).contains(&self.rate),
            "timing.rate",
            "must be from 100 Hz to 10 MHz",
            self.rate,
        )?;
        Ok(())
    }
}

/// Largest magnitudes that a sample and a command may have, and what may be asked for.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ranges {
    /// Speed, measured or commanded (rad/s).
    pub speed: f32,
    /// Current, measured (A).
    pub current: f32,
    /// Current that a controller may ask for (A).
    pub current_command: f32,
}

/// What a controller is built for.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Setting<'a> {
    /// The motor's model.
    pub motor: &'a Coefficients,
    /// Sampling rate and delay.
    pub timing: &'a Timing,
    /// What is known of the shaft's angle.
    pub shaft: &'a Shaft,
    /// What it may see and ask for.
    pub ranges: &'a Ranges,
    /// What full scale is.
    pub bases: &'a Bases,
}

/// Which controller runs, with its gains.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ControlConfig {
    /// The paper's form of BS, BS-QSMDO or BS-QISMC.
    Paper(paper::PaperConfig),
    /// The drive form of BS-QSMDO or BS-QISMC.
    Drive(drive_form::DriveFormConfig),
    /// Cascaded PI controllers of current and speed.
    Pi(pi::PiConfig),
    /// Linear active disturbance rejection control.
    Ladrc(ladrc::LadrcConfig),
}

choice! { ControlConfig { Paper(paper), Drive(drive), Pi(pi), Ladrc(ladrc) } }

/// What a control step saw and decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Signals<S> {
    /// Shaft speed ω, measured or estimated (rad/s).
    pub speed: S,
    /// Speed error z1 = ω − ω_d (rad/s).
    pub z1: S,
    /// Error of the virtual control, z2 = a2·(i − i*) (rad/s²).
    pub z2: S,
    /// Estimated disturbance d̂ = −T̂_l/J (rad/s²); zero where none is estimated.
    pub disturbance: S,
    /// Wanted armature voltage u (V), before any limit.
    pub voltage: S,
}

impl<S: Scalar> Signals<S> {
    /// Nothing seen, nothing decided.
    pub const NONE: Self =
        Self { speed: S::ZERO, z1: S::ZERO, z2: S::ZERO, disturbance: S::ZERO, voltage: S::ZERO };
}

/// What the drive has to know of a step.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Decision<S> {
    /// Wanted armature voltage for the next period, before the duty limit (V).
    pub voltage: S,
    /// Shaft speed, measured or estimated (rad/s).
    pub speed: S,
    /// How many steps in a row load or voltage have been beyond the authority of the observers, where there are any.
    pub exhausted: u32,
}

/// A speed controller: coefficients that are built once, and its state.
#[derive(Clone, Debug)]
pub(crate) enum Controller<S: Scalar> {
    Paper(Paper<S>),
    Drive(DriveForm<S>),
    Pi(CascadedPi<S>),
    Ladrc(Ladrc<S>),
}

impl<S: Scalar> Controller<S> {
    /// Builds a controller and tabulates its injections, if it has any. Refuses gains outside their range, naming the field.
    pub fn new(
        config: &ControlConfig,
        setting: &Setting,
        injections: &mut Injections<S>,
    ) -> Result<Self, ConfigError> {
        setting.timing.check()?;
        match config {
            ControlConfig::Paper(config) => {
                Self::apart(|| Ok(Self::Paper(Paper::new(config, setting, injections)?)))
            }
            ControlConfig::Drive(config) => {
                Self::apart(|| Ok(Self::Drive(DriveForm::new(config, setting, injections)?)))
            }
            ControlConfig::Pi(config) => {
                Self::apart(|| Ok(Self::Pi(CascadedPi::new(config, setting)?)))
            }
            ControlConfig::Ladrc(config) => {
                Self::apart(|| Ok(Self::Ladrc(Ladrc::new(config, setting)?)))
            }
        }
    }

    /// Builds with a stack frame of its own: inlined, that of all four would be taken at once.
    #[inline(never)]
    fn apart(build: impl FnOnce() -> Result<Self, ConfigError>) -> Result<Self, ConfigError> {
        build()
    }

    /// Follows the motor at a sample while the bridge is off. Gives the speed (rad/s).
    pub fn follow(&mut self, injections: &Injections<S>, measured: &Measured<S>) -> S {
        match self {
            Self::Paper(paper) => paper.follow(measured),
            Self::Drive(drive) => drive.follow(injections, measured),
            Self::Pi(pi) => pi.follow(measured),
            Self::Ladrc(ladrc) => ladrc.follow(measured),
        }
    }

    /// Starts at a sample, of which [`step`](Self::step) is to be told next, from what it followed before.
    pub fn start(
        &mut self,
        injections: &Injections<S>,
        measured: &Measured<S>,
        reference: &Reference<S>,
    ) {
        match self {
            Self::Paper(paper) => paper.start(injections, measured, reference),
            Self::Drive(drive) => drive.start(measured, reference),
            Self::Pi(pi) => pi.start(measured, reference),
            Self::Ladrc(ladrc) => ladrc.start(measured, reference),
        }
    }

    /// Is told the speed (rad/s) that the motor has: from there estimates go on.
    pub fn know(&mut self, speed: S) {
        match self {
            Self::Paper(paper) => paper.know(speed),
            Self::Drive(drive) => drive.know(speed),
            Self::Pi(pi) => pi.know(speed),
            Self::Ladrc(ladrc) => ladrc.know(speed),
        }
    }

    /// Takes over from another controller in the middle of a run, at a sample of which [`step`](Self::step) is to be told
    /// next: from the speed that it was told (rad/s) and the voltage that acts (V).
    pub fn resume(
        &mut self,
        injections: &Injections<S>,
        speed: S,
        measured: &Measured<S>,
        reference: &Reference<S>,
        acting: S,
    ) {
        match self {
            Self::Paper(paper) => paper.resume(speed, measured, reference),
            Self::Drive(drive) => drive.resume(injections, measured, reference, acting),
            // They start with the current that they find as what holds the speed.
            Self::Pi(pi) => pi.start(measured, reference),
            Self::Ladrc(ladrc) => ladrc.start(measured, reference),
        }
    }

    /// One step: from a sample, its reference and the armature voltage that acts from this sample on (V).
    #[inline]
    pub fn step(
        &mut self,
        injections: &Injections<S>,
        measured: &Measured<S>,
        reference: &Reference<S>,
        acting: S,
    ) -> Decision<S> {
        let decision = |voltage, signals: &Signals<S>, exhausted| Decision {
            voltage,
            speed: signals.speed,
            exhausted,
        };
        match self {
            Self::Paper(paper) => {
                decision(paper.step(injections, measured, reference), paper.signals(), 0)
            }
            Self::Drive(drive) => {
                let Measured { rotation, current, .. } = measured;
                let voltage = drive.step(injections, rotation, *current, reference, acting);
                decision(voltage, drive.signals(), drive.exhausted())
            }
            Self::Pi(pi) => decision(pi.step(measured, reference, acting), pi.signals(), 0),
            Self::Ladrc(ladrc) => {
                decision(ladrc.step(measured, reference, acting), ladrc.signals(), 0)
            }
        }
    }

    /// What the last step saw and decided; zeros before the first.
    #[inline]
    pub fn signals(&self) -> &Signals<S> {
        match self {
            Self::Paper(paper) => paper.signals(),
            Self::Drive(drive) => drive.signals(),
            Self::Pi(pi) => pi.signals(),
            Self::Ladrc(ladrc) => ladrc.signals(),
        }
    }

    /// The sliding variables of the last step where there are any, else zero: ω − x̂1 (QISMC: s1) (rad/s), and z2 − ẑ2
    /// (QISMC: s2) (rad/s²) or, in the drive form, i − î (A).
    pub fn sliding_variables(&self) -> [S; 2] {
        match self {
            Self::Paper(paper) => paper.sliding_variables(),
            Self::Drive(drive) => drive.sliding_variables(),
            Self::Pi(_) | Self::Ladrc(_) => [S::ZERO; 2],
        }
    }

    /// Whether the motor has not obeyed in these steps. If it has, they are counted anew.
    pub fn stuck(&mut self) -> bool {
        match self {
            Self::Drive(drive) => drive.stuck(),
            Self::Paper(_) | Self::Pi(_) | Self::Ladrc(_) => false,
        }
    }
}
