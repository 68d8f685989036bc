//! What a controller is built from.

use super::channel::{Form, Start};
use crate::config::{ConfigError, positive, require};
use crate::motor::Coefficients;

/// The paper's design parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Convergence rate c of both backstepping errors (1/s). Positive, and at most 0.4 of the rate at which the loop
    /// can answer, 1/[`Timing::horizon`]: the law is a continuous one, and sampled more slowly it rings (tests play up
    /// to that limit; unstable from about 1).
    pub c: f32,
    /// Strength k1 (QISMC: kc1) of the first injection (rad/s²): the largest |d| = |T_l|/J that can be held. Positive.
    pub k1: f32,
    /// Boundary layer ε1 (QISMC: η1) of the first injection (rad/s). Positive.
    pub epsilon1: f32,
    /// Strength k2 (QISMC: kc2) of the second injection (rad/s³): the largest |ζ2| that can be held. Positive.
    ///
    /// Erratum: the paper asks for k1 > d1 under (26) and kc1 > d2 under (54); k2, kc2 > |ζ2| are meant.
    pub k2: f32,
    /// Boundary layer ε2 (QISMC: η2) of the second injection (rad/s²). Positive.
    pub epsilon2: f32,
}

impl Gains {
    /// The gains of the paper's simulation.
    pub const PAPER: Self =
        Self { c: 200.0, k1: 1300.0, epsilon1: 0.05, k2: 755_000.0, epsilon2: 5.0 };

    pub(super) fn check(&self) -> Result<(), ConfigError> {
        positive("gains.c", self.c)?;
        positive("gains.k1", self.k1)?;
        positive("gains.epsilon1", self.epsilon1)?;
        positive("gains.k2", self.k2)?;
        positive("gains.epsilon2", self.epsilon2)?;
        Ok(())
    }
}

/// When the loop samples and when its voltage takes effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Timing {
    /// Sampling rate, which is the PWM rate (Hz). From 100 to 10 million.
    pub rate: f32,
    /// Whether a voltage takes effect one period after the sample it was computed from, as on every real board, or at
    /// once, as in a textbook.
    pub delay: bool,
}

impl Timing {
    /// The sampling period h (s).
    pub fn period(&self) -> f32 {
        1.0 / self.rate
    }

    /// Time from a sample to the end of the period in which the voltage computed from it acts (s).
    ///
    /// The second channel's injection acts through the plant, so its implicit form is closed over this time. Closed
    /// over one period it stays stable with the delay too, but rings: at the paper's gains and 20 kHz its poles have a
    /// magnitude of 0.94 instead of 0.69.
    pub fn horizon(&self) -> f32 {
        if self.delay { 2.0 * self.period() } else { self.period() }
    }

    pub(super) fn check(&self) -> Result<(), ConfigError> {
        require(
            (100.0..=1e7).contains(&self.rate),
            "timing.rate",
            "must be from 100 Hz to 10 MHz",
            self.rate,
        )?;
        Ok(())
    }
}

/// A speed control law.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Law {
    /// Plain backstepping (section 3.1).
    Backstepping,
    /// Backstepping with the quasi-sliding-mode disturbance observer (section 3.2).
    #[default]
    Qsmdo,
    /// Backstepping with quasi-integral sliding mode control (section 3.3).
    Qismc,
}

/// Which law runs and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ControlConfig {
    /// The law.
    pub law: Law,
    /// Its gains.
    pub gains: Gains,
    /// How its differential equations are stepped.
    pub form: Form,
    /// Where the observer of [`Law::Qsmdo`] starts; [`Law::Qismc`] starts on its surface by definition.
    pub start: Start,
}

/// Largest magnitudes that a sample and a command may have. What follows from them bounds the estimators' memory and
/// shows that nothing overflows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(crate) struct Ranges {
    /// Speed, measured or commanded (rad/s).
    pub speed: f32,
    /// Current (A).
    pub current: f32,
}

impl Ranges {
    /// z1 (rad/s): from one end of the range of speeds to the other.
    pub(super) fn speed_error(&self) -> f32 {
        2.0 * self.speed
    }

    /// z2 (rad/s²), of a reference that holds its speed.
    pub(super) fn z2(&self, motor: &Coefficients, gains: &Gains) -> f32 {
        gains.c * self.speed_error() + motor.a1 * self.speed + motor.a2 * self.current + gains.k1
    }
}
