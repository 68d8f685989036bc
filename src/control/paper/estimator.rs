//! The two estimators, BS-QSMDO's (Eqs. 16–27) and BS-QISMC's (Eqs. 39–53): one algorithm with two kinds of memory.
//!
//! Both run two quasi-sliding channels. The first tells the disturbance d̂, the second the lumped rest ζ̂2 that is left
//! in ż2, which is fed back as u2 = −ζ̂2. Written as what each channel watches and the rate its model gives:
//!
//! ```text
//!            first channel                                 second channel
//! QSMDO      ω,   −a1·ω + a2·i          (x̂1, Eq. 16)       z2,  −c·z2 − z1     (ẑ2, Eq. 24 with u2 = −ζ̂2)
//! QISMC      z1,  −a1·ω + a2·i − ω̇_d    (s1, Eq. 39)       z2,  −c·z2 − z1     (s2, Eq. 50)
//! ```
//!
//! since (ω − x̂1)' = d − d̂ = s1' and (z2 − ẑ2)' = ζ2 + u2 = s2'. So they differ in two things only. *The start:* the
//! paper starts QSMDO with x̂1 = ẑ2 = 0 and QISMC on its surface. *A jump of the reference:* z1 jumps with ω_d and takes
//! s1 along, ω and so x̂1 do not. With a smooth reference and equal starts the two give the same trajectory.
//!
//! Erratum: (53) prints u2 = +kc2·tanh(s2/η2), which diverges.

use super::super::Timing;
use super::channel::{Channel, ChannelConfig, Start};
use super::config::{Law, PaperConfig};
use crate::config::ConfigError;
use crate::control::injection::Injections;
use crate::math::{Base, Scalar};
use crate::per_unit::{ACCELERATION, Bases, JERK};
use crate::trajectory::Reference;

/// Estimator of the disturbance and of the lumped uncertainty of the second backstepping error.
#[derive(Clone, Debug)]
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub(super) struct Estimator<S: Scalar> {
    /// Whether the reference's motion is taken off what the first channel watches: QISMC.
    integral: bool,
    k1: S::Gains<1>,
    /// k1 once more (rad/s²).
    strength: f32,
    acceleration: Base,
    period: S::Time,
    first: Channel<S, { ACCELERATION + 1 }>,
    second: Channel<S, { JERK + 1 }>,
}

impl<S: Scalar> Estimator<S> {
    /// `speed_range` (rad/s) and `z2_range` (rad/s²) bound the mismatch that each channel remembers.
    #[inline(never)]
    pub fn new(
        config: &PaperConfig,
        timing: &Timing,
        (speed_range, z2_range): (f32, f32),
        bases: &Bases,
        injections: &mut Injections<S>,
    ) -> Result<Self, ConfigError> {
        let &Bases { speed, acceleration, .. } = bases;
        let gains = &config.gains;
        let period = timing.period();
        let integral = config.law == Law::Qismc;
        let start = if integral { Start::Matched } else { config.start };
        let first = ChannelConfig {
            strength: gains.k1,
            layer: gains.epsilon1,
            layer_field: "control.gains.epsilon1",
            period,
            horizon: period,
            form: config.form,
            start,
            range: speed_range,
            base: speed,
        };
        let second = ChannelConfig {
            strength: gains.k2,
            layer: gains.epsilon2,
            layer_field: "control.gains.epsilon2",
            horizon: timing.horizon(),
            range: z2_range,
            base: acceleration,
            ..first
        };
        Ok(Self {
            integral,
            k1: S::gains("control.gains.k1", [(gains.k1, Base::RATIO)], acceleration)?,
            strength: gains.k1,
            acceleration,
            period: S::time(period),
            first: Channel::new(&first, &mut injections.first)?,
            second: Channel::new(&second, &mut injections.second)?,
        })
    }

    /// Starts the first channel at a sample; arguments as for [`disturbance`](Self::disturbance).
    pub fn start_disturbance(&mut self, speed: S, modelled: S, reference: &Reference<S>) {
        let (signal, rate) = self.watched(speed, modelled, reference);
        self.first.start(signal, rate);
    }

    /// Starts the second channel at a sample; arguments as for [`lumped`](Self::lumped).
    pub fn start_lumped(&mut self, z2: S, wanted_rate: S) {
        self.second.start(z2, wanted_rate);
    }

    /// Starts the first channel so that the first step gives `disturbance` (rad/s²), as far as k1 allows; tells what it will
    /// be. Other arguments as for [`disturbance`](Self::disturbance).
    pub fn resume_disturbance(
        &mut self,
        speed: S,
        modelled: S,
        reference: &Reference<S>,
        disturbance: S,
    ) -> S {
        let (signal, rate) = self.watched(speed, modelled, reference);
        let value =
            self.first.resume(signal, rate, disturbance.to_f32(self.acceleration) / self.strength);
        S::combine(&self.k1, [value])
    }

    /// Starts the second channel with nothing to tell; arguments as for [`lumped`](Self::lumped).
    pub fn resume_lumped(&mut self, z2: S, wanted_rate: S) {
        self.second.resume(z2, wanted_rate, 0.0);
    }

    /// d̂ (rad/s²), from the speed ω, the acceleration −a1·ω + a2·i and the reference.
    #[inline]
    pub fn disturbance(
        &mut self,
        injections: &Injections<S>,
        speed: S,
        modelled: S,
        reference: &Reference<S>,
    ) -> S {
        let (signal, rate) = self.watched(speed, modelled, reference);
        let value = self.first.step(&injections.first, signal, rate);
        let disturbance = S::combine(&self.k1, [value]);
        self.first.correct(disturbance.over::<ACCELERATION>(self.period));
        disturbance
    }

    /// ζ̂2/k2 = −u2/k2, within ±1, from z2 and the rate −c·z2 − z1 that it is to have.
    #[inline]
    pub fn lumped(&mut self, injections: &Injections<S>, z2: S, wanted_rate: S) -> S {
        self.second.step(&injections.second, z2, wanted_rate)
    }

    /// What the first channel watches, and its modelled rate.
    #[inline]
    fn watched(&self, speed: S, modelled: S, reference: &Reference<S>) -> (S, S) {
        if self.integral {
            (speed - reference.speed, modelled - reference.acceleration)
        } else {
            (speed, modelled)
        }
    }

    /// The sliding variables: ω − x̂1 or s1 (rad/s), z2 − ẑ2 or s2 (rad/s²).
    pub fn sliding_variables(&self) -> [S; 2] {
        [self.first.sliding_variable(), self.second.sliding_variable()]
    }
}
