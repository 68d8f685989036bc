//! What the paper's form is built from.

use super::super::Ranges;
use super::channel::{Form, Start};
use crate::config::{ConfigError, positive};
use crate::estimate::SpeedSource;
use crate::motor::Coefficients;
use crate::schema::{choice, group};

/// The paper's design parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Convergence rate c of both backstepping errors (1/s). Positive, and at most 0.4 of the rate at which the loop
    /// can answer, 1/[`Timing::horizon`](crate::control::Timing::horizon): the law is a continuous one, and sampled more slowly it rings (tests play up
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

group! { Gains { c, k1, epsilon1, k2, epsilon2 } }

impl Gains {
    /// The gains of the paper's simulation.
    pub const PAPER: Self =
        Self { c: 200.0, k1: 1300.0, epsilon1: 0.05, k2: 755_000.0, epsilon2: 5.0 };

    pub(super) fn check(&self) -> Result<(), ConfigError> {
        positive("control.gains.c", self.c)?;
        positive("control.gains.k1", self.k1)?;
        positive("control.gains.epsilon1", self.epsilon1)?;
        positive("control.gains.k2", self.k2)?;
        positive("control.gains.epsilon2", self.epsilon2)?;
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

choice! { Law { Backstepping, Qsmdo, Qismc } }

/// Which law runs and how.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PaperConfig {
    /// The law.
    pub law: Law,
    /// Its gains.
    pub gains: Gains,
    /// How its differential equations are stepped.
    pub form: Form,
    /// Where the observer of [`Law::Qsmdo`] starts; [`Law::Qismc`] starts on its surface by definition.
    pub start: Start,
    /// Where the speed comes from.
    pub speed: SpeedSource,
}

group! { PaperConfig { law, gains, form, start, speed } }

/// z1 (rad/s) at most: from one end of the range of speeds to the other.
pub(super) fn speed_error_range(ranges: &Ranges) -> f32 {
    2.0 * ranges.speed
}

/// z2 (rad/s²) at most, of a reference that holds its speed.
pub(super) fn z2_range(ranges: &Ranges, motor: &Coefficients, gains: &Gains) -> f32 {
    gains.c * speed_error_range(ranges)
        + motor.a1 * ranges.speed
        + motor.a2 * ranges.current
        + gains.k1
}
