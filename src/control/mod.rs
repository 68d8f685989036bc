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
use estimator::Estimator;

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
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub struct Controller<S: Scalar> {
    last: Signals<S>,
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
        require(
            gains.c * timing.horizon() <= 0.4 * (1.0 + f32::EPSILON),
            "gains.c",
            "must be at most 0.4 of 1/horizon, the horizon being a period, or two with the delay",
            gains.c,
        )?;
        let law = Backstepping::new(motor, gains, ranges)?;
        let estimator = match config.law {
            Law::Backstepping => None,
            Law::Qsmdo | Law::Qismc => {
                let ranges = (ranges.speed_error(), ranges.z2(motor, gains));
                Some(Estimator::new(config, timing, ranges)?)
            }
        };
        let last = Signals { z1: S::ZERO, z2: S::ZERO, disturbance: S::ZERO, voltage: S::ZERO };
        Ok(Self { last, law, estimator })
    }

    /// Forgets the past and starts at a sample, of which [`step`](Self::step) is to be told next.
    pub fn start(&mut self, speed: S, current: S, reference: &Reference<S>) {
        let Some(estimator) = &mut self.estimator else { return };
        let modelled = self.law.modelled_acceleration(speed, current);
        let z1 = speed - reference.speed;
        estimator.start_disturbance(speed, modelled, reference);
        // The second channel starts from the z2 that the step is going to have.
        let disturbance = estimator.disturbance(speed, modelled, reference);
        let z2 = self.law.z2(z1, modelled, reference, disturbance);
        estimator.start_lumped(z2, self.law.z2_rate(z1, z2));
        estimator.start_disturbance(speed, modelled, reference);
    }

    /// One step: from the speed ω (rad/s), the armature current i (A) and the reference to the wanted armature voltage u
    /// (V), before any limit.
    // Not inlined, for its instructions to be counted apart from its caller's.
    #[inline(never)]
    pub fn step(&mut self, speed: S, current: S, reference: &Reference<S>) -> S {
        let z1 = speed - reference.speed;
        let modelled = self.law.modelled_acceleration(speed, current);
        let (z2, disturbance, lumped) = match &mut self.estimator {
            Some(estimator) => {
                let disturbance = estimator.disturbance(speed, modelled, reference);
                let z2 = self.law.z2(z1, modelled, reference, disturbance);
                (z2, disturbance, estimator.lumped(z2, self.law.z2_rate(z1, z2)))
            }
            None => (self.law.z2(z1, modelled, reference, S::ZERO), S::ZERO, S::ZERO),
        };
        let estimates = (disturbance, lumped);
        let voltage = self.law.voltage((speed, current), (z1, z2), reference, estimates);
        self.last = Signals { z1, z2, disturbance, voltage };
        voltage
    }

    /// What the last step saw and decided; zeros before the first.
    pub fn signals(&self) -> &Signals<S> {
        &self.last
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
