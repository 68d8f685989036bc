//! Shaft speed from the shaft's angle.

use crate::config::{ConfigError, positive, require};
use crate::math::{Scalar, exp_m1};
use crate::sense::Measured;
use serde::{Deserialize, Serialize};

/// Where a controller that wants a speed has it from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum SpeedSource {
    /// From exact sensors: simulation only.
    Exact,
    /// The angle's difference over a period through a first-order low-pass.
    Difference {
        /// Corner of the low-pass (rad/s).
        bandwidth: f32,
    },
    /// A phase-locked loop: a second-order angle observer with a double pole.
    Pll {
        /// Its poles' magnitude (rad/s).
        bandwidth: f32,
        /// Whether it is fed with the acceleration that the controller knows of; it does not lag then.
        fed: bool,
    },
}

/// Speed by a [`SpeedSource`].
#[derive(Clone, Debug)]
pub(crate) enum SpeedEstimator<S: Scalar> {
    Exact,
    Difference(Difference<S>),
    Pll { observer: AngleObserver<S>, fed: bool },
}

#[derive(Clone, Debug)]
pub(crate) struct Difference<S: Scalar> {
    speed: S,
    rate: S::Gain,
    keep: S::Gain,
}

impl<S: Scalar> SpeedEstimator<S> {
    /// For a sampling period (s) and angles that are `age` old (s).
    pub fn new(source: &SpeedSource, period: f32, age: f32) -> Result<Self, ConfigError> {
        match *source {
            SpeedSource::Exact => Ok(Self::Exact),
            SpeedSource::Difference { bandwidth } => {
                let share = -exp_m1(-checked(bandwidth, period)? * period);
                Ok(Self::Difference(Difference {
                    speed: S::ZERO,
                    rate: S::gain(share / period),
                    keep: S::gain(1.0 - share),
                }))
            }
            SpeedSource::Pll { bandwidth, fed } => {
                let share = -exp_m1(-checked(bandwidth, period)? * period);
                // Both poles at 1 − share.
                let gains = [share * (2.0 - share), share * share / period];
                Ok(Self::Pll { observer: AngleObserver::new(gains, 0.0, period, age), fed })
            }
        }
    }

    /// Goes on from a known speed (rad/s).
    pub fn resume(&mut self, known: S) {
        match self {
            Self::Exact => {}
            Self::Difference(Difference { speed, .. }) => *speed = known,
            Self::Pll { observer, .. } => observer.resume(known),
        }
    }

    /// The speed (rad/s) at a sample; `acceleration` is what the controller knew of at the last one (rad/s²).
    #[inline]
    pub fn step(&mut self, measured: &Measured<S>, acceleration: S) -> S {
        match self {
            Self::Exact => measured.speed,
            Self::Difference(Difference { speed, rate, keep }) => {
                *speed = S::combine([(*rate, measured.advance), (*keep, *speed)]);
                *speed
            }
            Self::Pll { observer, fed } => {
                let acceleration = if *fed { acceleration } else { S::ZERO };
                observer.step(measured.advance, measured.extra_age, acceleration);
                observer.speed
            }
        }
    }
}

fn checked(bandwidth: f32, period: f32) -> Result<f32, ConfigError> {
    positive("control.speed.bandwidth", bandwidth)?;
    require(
        bandwidth * period <= 1.0,
        "control.speed.bandwidth",
        "must be at most the sampling rate",
        bandwidth,
    )
}

/// Observer of the angle and the speed, for encoder reads that are a known time old.
///
/// It keeps no angle, which would grow until an f32 could not resolve it, but only the *lead* of its angle over the
/// reads': what the shaft turns is taken off it in every period.
#[derive(Clone, Debug)]
#[repr(C)]
pub(crate) struct AngleObserver<S: Scalar> {
    /// Estimated speed (rad/s).
    pub speed: S,
    /// Estimated angle less that of the reads (rad).
    lead: S,
    period: S::Gain,
    half_period_squared: S::Gain,
    age: S::Gain,
    half_age_squared: S::Gain,
    angle_gain: S::Gain,
    speed_gain: S::Gain,
}

impl<S: Scalar> AngleObserver<S> {
    /// From the gains of the angle (1) and the speed (1/s) for reads of no age, and that of the acceleration (1/s²) of an
    /// observer around this one; the period and the reads' true age (s).
    ///
    /// For reads that are τ old the same poles need the gains shifted by τ along the model: g1 + τ·g2 + τ²/2·g3, g2 + τ·g3, g3.
    pub fn new([g1, g2]: [f32; 2], g3: f32, period: f32, age: f32) -> Self {
        Self {
            speed: S::ZERO,
            lead: S::ZERO,
            period: S::gain(period),
            half_period_squared: S::gain(0.5 * period * period),
            age: S::gain(age),
            half_age_squared: S::gain(-0.5 * age * age),
            angle_gain: S::gain(g1 + age * (g2 + 0.5 * age * g3)),
            speed_gain: S::gain(g2 + age * g3),
        }
    }

    /// Goes on from a known speed (rad/s).
    pub fn resume(&mut self, speed: S) {
        self.speed = speed;
        self.lead = S::combine([(self.age, speed)]);
    }

    /// On to the next sample, with the angle that the reads advanced (rad), how much more than usual they lie back (s), and the
    /// mean acceleration since (rad/s²). Gives the correction of the speed (rad/s).
    #[inline]
    pub fn step(&mut self, advance: S, extra_age: S, acceleration: S) -> S {
        let turned =
            S::combine([(self.period, self.speed), (self.half_period_squared, acceleration)]);
        self.lead = self.lead + (turned - advance);
        self.speed = self.speed + S::combine([(self.period, acceleration)]);
        let expected = S::combine([(self.age, self.speed), (self.half_age_squared, acceleration)]);
        let innovation = expected + extra_age * self.speed - self.lead;
        self.lead = self.lead + S::combine([(self.angle_gain, innovation)]);
        let correction = S::combine([(self.speed_gain, innovation)]);
        self.speed = self.speed + correction;
        correction
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: f32 = 5e-5;

    fn measured(advance: f32) -> Measured<f32> {
        Measured { advance, extra_age: 0.0, speed: 0.0, current: 0.0, bus_voltage: 24.0 }
    }

    #[test]
    fn every_source_settles_on_a_constant_speed() {
        for source in [
            SpeedSource::Difference { bandwidth: 500.0 },
            SpeedSource::Pll { bandwidth: 500.0, fed: false },
            SpeedSource::Pll { bandwidth: 500.0, fed: true },
        ] {
            for age in [0.0, 15.0 / 32.0 * PERIOD] {
                let mut estimator =
                    SpeedEstimator::<f32>::new(&source, PERIOD, age).expect("valid");
                let mut speed = 0.0;
                for _ in 0..2000 {
                    speed = estimator.step(&measured(100.0 * PERIOD), 0.0);
                }
                assert!((speed - 100.0).abs() < 1e-3, "{source:?}: {speed}");
            }
        }
    }

    #[test]
    fn only_a_fed_loop_does_not_lag_in_acceleration() {
        let acceleration = 1000.0;
        // (fed, lag): a loop with a double pole p lags by 2·acceleration/p.
        for (fed, lag) in [(false, 2.0 * acceleration / 500.0), (true, 0.0)] {
            let age = 15.0 / 32.0 * PERIOD;
            let source = SpeedSource::Pll { bandwidth: 500.0, fed };
            let mut estimator = SpeedEstimator::<f32>::new(&source, PERIOD, age).expect("valid");
            let angle = |time: f64| 0.5 * f64::from(acceleration) * time * time;
            let mut error = 0.0;
            for period in 1..2000 {
                let time = |period: i32| f64::from(period) * f64::from(PERIOD) - f64::from(age);
                let advance = angle(time(period)) - angle(time(period - 1));
                let speed = estimator.step(&measured(advance as f32), acceleration);
                error = acceleration * period as f32 * PERIOD - speed;
            }
            assert!((error - lag).abs() < 0.05, "fed {fed}: lags by {error}, not {lag}");
        }
    }

    #[test]
    fn bandwidths_are_checked() {
        for bandwidth in [0.0, f32::NAN, 30_000.0] {
            let source = SpeedSource::Pll { bandwidth, fed: true };
            let error = SpeedEstimator::<f32>::new(&source, PERIOD, 0.0).expect_err("refused");
            assert_eq!(error.field, "control.speed.bandwidth");
        }
    }
}
