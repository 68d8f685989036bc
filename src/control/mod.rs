//! Speed control laws: pure functions of a sample, a reference and a small state. No hardware, no units but SI.
//!
//! - [`Controller`] composes the law and, for BS-QSMDO and BS-QISMC, an estimator;
//! - `backstepping` is the law, `estimator` the two estimators, `channel` what both are made of;
//! - [`injection`] is the quasi-sliding injection, [`bounds`] the ultimate bounds.
//!
//! Not here: shaping of the reference ([`crate::trajectory`]), limits, duty and faults ([`crate::drive`]).

mod backstepping;
pub mod bounds;
mod channel;
mod estimator;
pub mod injection;

use crate::config::{ConfigError, positive, require};
use crate::math::Scalar;
use crate::motor::Coefficients;
use crate::trajectory::Reference;
use backstepping::Backstepping;
pub use channel::{Form, Start};
use estimator::Estimator;
pub use estimator::Memory;
use injection::Injection;

/// The paper's design parameters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Gains {
    /// Convergence rate c of both backstepping errors (1/s). Positive.
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

    fn check(&self) -> Result<(), ConfigError> {
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

    fn check(&self) -> Result<(), ConfigError> {
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
    fn speed_error(&self) -> f32 {
        2.0 * self.speed
    }

    /// z2 (rad/s²), of a reference that holds its speed.
    fn z2(&self, motor: &Coefficients, gains: &Gains) -> f32 {
        gains.c * self.speed_error() + motor.a1 * self.speed + motor.a2 * self.current + gains.k1
    }
}

/// What a control step saw and decided.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Signals<S> {
    /// Speed error z1 = ω − ω_d (rad/s).
    pub z1: S,
    /// Error of the virtual control, z2 = a2·i − x2* (rad/s²).
    pub z2: S,
    /// Estimated disturbance d̂ = −T̂_l/J (rad/s²); zero in plain backstepping.
    pub disturbance: S,
    /// Wanted armature voltage u (V), before any limit.
    pub voltage: S,
}

/// A speed controller: coefficients that are built once, and the state of its estimator.
#[derive(Clone, Debug)]
pub struct Controller<S: Scalar> {
    law: Backstepping<S>,
    estimator: Option<Estimator<S>>,
}

impl<S: Scalar> Controller<S> {
    /// Builds the law for a motor. Refuses gains outside their range, naming the field.
    pub(crate) fn new(
        motor: &Coefficients,
        config: &ControlConfig,
        timing: &Timing,
        ranges: &Ranges,
    ) -> Result<Self, ConfigError> {
        timing.check()?;
        let gains = &config.gains;
        gains.check()?;
        let z2 = ranges.z2(motor, gains);
        require(z2 <= 1e12, "gains.c", "must keep z2 within 1e12 rad/s²", gains.c)?;
        for (strength, layer, layer_field, range) in [
            (gains.k1, gains.epsilon1, "gains.epsilon1", ranges.speed_error()),
            (gains.k2, gains.epsilon2, "gains.epsilon2", z2),
        ] {
            require(
                timing.horizon() * strength / layer <= Injection::<S>::MAX_BETA,
                layer_field,
                "must be larger: strength·horizon/layer may be 2000 at most",
                layer,
            )?;
            // An f32 of seven digits would not see the layer beside such a mismatch.
            require(
                range / layer <= 1e7,
                layer_field,
                "must be at least 1e-7 of the largest mismatch",
                layer,
            )?;
        }
        let (memory, start) = match config.law {
            Law::Backstepping => (None, Start::Matched),
            Law::Qsmdo => (Some(Memory::Observer), config.start),
            Law::Qismc => (Some(Memory::Integral), Start::Matched),
        };
        Ok(Self {
            law: Backstepping::new(motor, gains, ranges)?,
            estimator: memory.map(|memory| {
                let ranges = (ranges.speed_error(), z2);
                Estimator::new(memory, gains, timing, config.form, start, ranges)
            }),
        })
    }

    /// Forgets the past: the next step is a first one.
    pub fn reset(&mut self) {
        if let Some(estimator) = &mut self.estimator {
            estimator.reset();
        }
    }

    /// One step: from the speed ω (rad/s), the armature current i (A) and the reference to the voltage.
    #[inline]
    pub fn step(&mut self, speed: S, current: S, reference: &Reference<S>) -> Signals<S> {
        let z1 = speed - reference.speed;
        let modelled = self.law.modelled_acceleration(speed, current);
        let disturbance = match &mut self.estimator {
            Some(estimator) => estimator.disturbance(speed, z1, modelled, reference.acceleration),
            None => S::ZERO,
        };
        let z2 = self.law.z2(z1, modelled, reference, disturbance);
        let lumped = match &mut self.estimator {
            Some(estimator) => estimator.lumped(z1, z2),
            None => S::ZERO,
        };
        let voltage =
            self.law.voltage((speed, current), (z1, z2), reference, (disturbance, lumped));
        Signals { z1, z2, disturbance, voltage }
    }

    /// The sliding variables of the last step, zero in plain backstepping: ω − x̂1 (QISMC: s1) (rad/s) and
    /// z2 − ẑ2 (QISMC: s2) (rad/s²).
    pub fn sliding_variables(&self) -> [S; 2] {
        match &self.estimator {
            Some(estimator) => estimator.sliding_variables(),
            None => [S::ZERO; 2],
        }
    }
}
