//! Speed control laws: pure functions of a sample, a reference and a small state. No hardware, no units but SI.
//!
//! - [`Controller`] composes the law and, for BS-QSMDO and BS-QISMC, an estimator;
//! - `config` is what it is built from, `backstepping` the law, `estimator` the two estimators, `channel` what both are
//!   made of;
//! - [`injection`] is the quasi-sliding injection, [`bounds`] the ultimate bounds.
//!
//! Not here: shaping of the reference ([`crate::trajectory`]), limits, duty and faults ([`crate::drive`]).

mod backstepping;
pub mod bounds;
mod channel;
mod config;
mod estimator;
pub mod injection;

use crate::config::{ConfigError, require};
use crate::math::Scalar;
use crate::motor::Coefficients;
use crate::trajectory::Reference;
use backstepping::Backstepping;
pub use channel::{Form, Start};
pub(crate) use config::Ranges;
pub use config::{ControlConfig, Gains, Law, Timing};
use estimator::{Estimator, Memory};

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
    /// Whether the next step is a first one.
    fresh: bool,
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
        require(
            gains.c * timing.horizon() <= 0.4 * (1.0 + f32::EPSILON),
            "gains.c",
            "must be at most 0.4 of 1/horizon, the horizon being a period, or two with the delay",
            gains.c,
        )?;
        let (memory, start) = match config.law {
            Law::Backstepping => (None, Start::Matched),
            Law::Qsmdo => (Some(Memory::Observer), config.start),
            Law::Qismc => (Some(Memory::Integral), Start::Matched),
        };
        let law = Backstepping::new(motor, gains, ranges)?;
        let estimator = match memory {
            Some(memory) => {
                let ranges = (ranges.speed_error(), ranges.z2(motor, gains));
                Some(Estimator::new(memory, gains, timing, config.form, start, ranges)?)
            }
            None => None,
        };
        Ok(Self { law, estimator, fresh: true })
    }

    /// Forgets the past: the next step is a first one.
    pub fn reset(&mut self) {
        self.fresh = true;
    }

    /// One step: from the speed ω (rad/s), the armature current i (A) and the reference to the voltage.
    // Not inlined, for its instructions to be counted apart from its caller's.
    #[inline(never)]
    pub fn step(&mut self, speed: S, current: S, reference: &Reference<S>) -> Signals<S> {
        let z1 = speed - reference.speed;
        let modelled = self.law.modelled_acceleration(speed, current);
        let Some(estimator) = &mut self.estimator else {
            let z2 = self.law.z2(z1, modelled, reference, S::ZERO);
            let none = (S::ZERO, S::ZERO);
            let voltage = self.law.voltage((speed, current), (z1, z2), reference, none);
            return Signals { z1, z2, disturbance: S::ZERO, voltage };
        };
        let fresh = core::mem::replace(&mut self.fresh, false);
        if fresh {
            estimator.start_disturbance(speed, z1, modelled, reference.acceleration);
        }
        let disturbance = estimator.disturbance(speed, z1, modelled, reference.acceleration);
        let z2 = self.law.z2(z1, modelled, reference, disturbance);
        if fresh {
            estimator.start_lumped(z1, z2);
        }
        let estimates = (disturbance, estimator.lumped(z1, z2));
        let voltage = self.law.voltage((speed, current), (z1, z2), reference, estimates);
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
