//! The paper's own form of plain backstepping, BS-QSMDO and BS-QISMC, for a measured or well estimated speed.
//!
//! `backstepping` is the law, `estimator` the two estimators, `channel` what both are made of, `config` what it is built
//! from.

mod backstepping;
mod channel;
mod config;
mod estimator;

use super::injection::Injections;
use super::{Setting, Signals};
use crate::config::{ConfigError, require};
use crate::estimate::SpeedEstimator;
use crate::math::Scalar;
use crate::sense::Measured;
use crate::trajectory::Reference;
use backstepping::Backstepping;
pub use channel::{Form, Start};
pub use config::{Gains, Law, PaperConfig};
use config::{speed_error_range, z2_range};
use estimator::Estimator;

/// The paper's form of a speed controller.
#[derive(Clone, Debug)]
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub(crate) struct Paper<S: Scalar> {
    last: Signals<S>,
    speed: SpeedEstimator<S>,
    /// Acceleration that the model and the estimate gave at the last sample (rad/s²).
    acceleration: S,
    law: Backstepping<S>,
    estimator: Option<Estimator<S>>,
}

impl<S: Scalar> Paper<S> {
    /// Builds the controller and tabulates its injections.
    pub fn new(
        config: &PaperConfig,
        setting: &Setting,
        injections: &mut Injections<S>,
    ) -> Result<Self, ConfigError> {
        let &Setting { motor, timing, shaft, ranges, bases } = setting;
        let gains = &config.gains;
        gains.check()?;
        require(
            gains.c * timing.horizon() <= 0.4 * (1.0 + f32::EPSILON),
            "control.gains.c",
            "must be at most 0.4 of 1/horizon, the horizon being a period, or two with the delay",
            gains.c,
        )?;
        let law = Backstepping::new(motor, gains, ranges, bases)?;
        let ranges = (speed_error_range(ranges), z2_range(ranges, motor, gains));
        Ok(Self {
            last: Signals::NONE,
            speed: SpeedEstimator::new(&config.speed, shaft, bases)?,
            acceleration: S::ZERO,
            law,
            estimator: match config.law {
                Law::Backstepping => None,
                Law::Qsmdo | Law::Qismc => {
                    Some(Estimator::new(config, timing, ranges, bases, injections)?)
                }
            },
        })
    }

    pub fn follow(&mut self, measured: &Measured<S>) -> S {
        self.acceleration = S::ZERO;
        self.last.speed = self.speed.step(measured, S::ZERO);
        self.last.speed
    }

    /// The estimators start at the sample, with the speed that was last known.
    pub fn start(
        &mut self,
        injections: &Injections<S>,
        measured: &Measured<S>,
        reference: &Reference<S>,
    ) {
        let Some(estimator) = &mut self.estimator else { return };
        let speed = match self.speed {
            SpeedEstimator::Exact => measured.speed,
            _ => self.last.speed,
        };
        let modelled = self.law.modelled_acceleration(speed, measured.current);
        let z1 = speed - reference.speed;
        estimator.start_disturbance(speed, modelled, reference);
        // The second channel starts from the z2 that the step is going to have.
        let disturbance = estimator.disturbance(injections, speed, modelled, reference);
        let z2 = self.law.z2(z1, modelled, reference, disturbance);
        estimator.start_lumped(z2, self.law.z2_rate(z1, z2));
        estimator.start_disturbance(speed, modelled, reference);
    }

    pub fn know(&mut self, speed: S) {
        self.speed.resume(speed);
        self.last.speed = speed;
    }

    /// Takes over: the current that it finds is what holds the speed.
    pub fn resume(&mut self, speed: S, measured: &Measured<S>, reference: &Reference<S>) {
        let modelled = self.law.modelled_acceleration(speed, measured.current);
        self.acceleration = reference.acceleration;
        let Some(estimator) = &mut self.estimator else { return };
        let held = reference.acceleration - modelled;
        let disturbance = estimator.resume_disturbance(speed, modelled, reference, held);
        let z1 = speed - reference.speed;
        let z2 = self.law.z2(z1, modelled, reference, disturbance);
        estimator.resume_lumped(z2, self.law.z2_rate(z1, z2));
    }

    #[inline]
    pub fn step(
        &mut self,
        injections: &Injections<S>,
        measured: &Measured<S>,
        reference: &Reference<S>,
    ) -> S {
        let speed = self.speed.step(measured, self.acceleration);
        self.control(injections, speed, measured.current, reference)
    }

    // Not inlined where its instructions are counted apart from its caller's.
    #[cfg_attr(feature = "qemu", inline(never))]
    fn control(
        &mut self,
        injections: &Injections<S>,
        speed: S,
        current: S,
        reference: &Reference<S>,
    ) -> S {
        let z1 = speed - reference.speed;
        let modelled = self.law.modelled_acceleration(speed, current);
        let (z2, disturbance, lumped) = match &mut self.estimator {
            Some(estimator) => {
                let disturbance = estimator.disturbance(injections, speed, modelled, reference);
                let z2 = self.law.z2(z1, modelled, reference, disturbance);
                let lumped = estimator.lumped(injections, z2, self.law.z2_rate(z1, z2));
                (z2, disturbance, lumped)
            }
            None => (self.law.z2(z1, modelled, reference, S::ZERO), S::ZERO, S::ZERO),
        };
        let estimates = (disturbance, lumped);
        let voltage = self.law.voltage((speed, current), (z1, z2), reference, estimates);
        self.acceleration = modelled + disturbance;
        self.last = Signals { speed, z1, z2, disturbance, voltage };
        voltage
    }

    pub fn signals(&self) -> &Signals<S> {
        &self.last
    }

    pub fn sliding_variables(&self) -> [S; 2] {
        match &self.estimator {
            Some(estimator) => estimator.sliding_variables(),
            None => [S::ZERO; 2],
        }
    }
}
