//! Reference shaping: from a commanded speed to a reference with the two derivatives that the law feeds forward.

use crate::config::{ConfigError, require};
use crate::math::{Scalar, exp_m1};
use serde::{Deserialize, Serialize};

/// The reference at one sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reference<S> {
    /// Wanted speed ω_d (rad/s).
    pub speed: S,
    /// Its first derivative ω̇_d (rad/s²).
    pub acceleration: S,
    /// Its second derivative ω̈_d (rad/s³).
    pub jerk: S,
}

impl<S: Scalar> Reference<S> {
    /// A constant speed (rad/s).
    pub fn constant(speed: S) -> Self {
        Self { speed, acceleration: S::ZERO, jerk: S::ZERO }
    }
}

/// How a commanded speed becomes a reference.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub enum Shape {
    /// The command itself, with zero derivatives: it jumps when the command does (the paper's reference).
    #[default]
    Step,
    /// The command through a critically damped second-order filter, ω_d'' = w²·(command − ω_d) − 2w·ω_d'.
    SecondOrder {
        /// Natural frequency w (rad/s). Positive, at most half the sampling rate.
        bandwidth: f32,
    },
}

/// Shapes a commanded speed, one sample per period.
#[derive(Clone, Debug)]
pub struct Shaper<S: Scalar> {
    filter: Option<Filter<S>>,
    target: S,
    /// The filter's output less the target: small where it settles, so that no small increment is lost to rounding.
    rest: S,
    /// The reference at the last sample.
    reference: Reference<S>,
}

/// Between samples the jerk is constant, so speed and acceleration follow exactly by integration, and each of the three
/// is the derivative of the one before at every sample.
#[derive(Clone, Debug)]
struct Filter<S: Scalar> {
    period: S::Gain,
    half_period_squared: S::Gain,
    stiffness: S::Gain,
    damping: S::Gain,
}

impl<S: Scalar> Shaper<S> {
    /// A shaper at rest at zero speed, for a sampling rate in Hz.
    pub(crate) fn new(shape: Shape, rate: f32) -> Result<Self, ConfigError> {
        let filter = match shape {
            Shape::Step => None,
            Shape::SecondOrder { bandwidth } => {
                require(
                    bandwidth > 0.0 && bandwidth <= 0.5 * rate,
                    "reference.bandwidth",
                    "must be positive and at most half the sampling rate",
                    bandwidth,
                )?;
                let period = 1.0 / rate;
                // A double integrator over a held jerk, with both poles placed where e^(−w·h) puts them.
                let decay = -exp_m1(-bandwidth * period);
                Some(Filter {
                    period: S::gain(period),
                    half_period_squared: S::gain(0.5 * period * period),
                    stiffness: S::gain(-decay * decay / (period * period)),
                    damping: S::gain(-(2.0 * decay - 0.5 * decay * decay) / period),
                })
            }
        };
        let reference = Reference::constant(S::ZERO);
        Ok(Self { filter, target: S::ZERO, rest: S::ZERO, reference })
    }

    /// Sets the commanded speed (rad/s).
    pub fn set_target(&mut self, target: S) {
        self.rest = self.rest + (self.target - target);
        self.target = target;
    }

    /// Starts anew from a speed (rad/s), at rest in its derivatives.
    pub fn reset(&mut self, speed: S) {
        self.rest = speed - self.target;
        self.reference = Reference::constant(speed);
    }

    /// Goes on to the next sample.
    #[inline]
    pub fn advance(&mut self) -> &Reference<S> {
        let reference = &mut self.reference;
        match &self.filter {
            None => reference.speed = self.target,
            Some(filter) => {
                let Reference { acceleration, jerk, .. } = *reference;
                self.rest = self.rest
                    + S::combine([
                        (filter.period, acceleration),
                        (filter.half_period_squared, jerk),
                    ]);
                reference.speed = self.target + self.rest;
                reference.acceleration = acceleration + S::combine([(filter.period, jerk)]);
                reference.jerk = S::combine([
                    (filter.stiffness, self.rest),
                    (filter.damping, reference.acceleration),
                ]);
            }
        }
        reference
    }

    /// The reference at the last sample.
    pub fn reference(&self) -> &Reference<S> {
        &self.reference
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f32 = 20_000.0;

    fn shaped(shape: Shape, samples: usize) -> impl Iterator<Item = Reference<f32>> {
        let mut shaper = Shaper::new(shape, RATE).expect("valid");
        shaper.set_target(100.0);
        (0..samples).map(move |_| *shaper.advance())
    }

    #[test]
    fn a_step_is_the_command_itself() {
        assert!(shaped(Shape::Step, 3).all(|reference| reference == Reference::constant(100.0)));
    }

    #[test]
    fn second_order_follows_the_critically_damped_response() {
        let bandwidth = 50.0;
        for (sample, reference) in shaped(Shape::SecondOrder { bandwidth }, 10_000).enumerate() {
            let t = sample as f64 / f64::from(RATE);
            let wt = f64::from(bandwidth) * t;
            let exact = 100.0 * (1.0 - (1.0 + wt) * (-wt).exp());
            let error = (f64::from(reference.speed) - exact).abs();
            assert!(error < 0.02, "sample {sample}: {} is not {exact}", reference.speed);
        }
    }

    #[test]
    fn second_order_does_not_overshoot_and_settles() {
        for bandwidth in [5.0, 50.0, 500.0, 5_000.0, 10_000.0] {
            let mut last = 0.0;
            for reference in shaped(Shape::SecondOrder { bandwidth }, 100_000) {
                // f32 resolves 8e-6 at 100.
                assert!(reference.speed <= 100.0 + 2e-3, "{bandwidth}: {}", reference.speed);
                last = reference.speed;
            }
            assert!((last - 100.0).abs() < 2e-3, "{bandwidth}: settles at {last}");
        }
    }

    #[test]
    fn each_signal_is_the_derivative_of_the_one_before() {
        let mut before: Option<Reference<f32>> = None;
        for reference in shaped(Shape::SecondOrder { bandwidth: 50.0 }, 5_000) {
            if let Some(before) = before {
                let mean = 0.5 * (before.acceleration + reference.acceleration);
                let slope = (reference.speed - before.speed) * RATE;
                // Speeds near 100 rad/s are rounded to 8e-6, and the slope multiplies that by the rate.
                assert!((slope - mean).abs() < 0.2, "{slope} is not {mean}");
            }
            before = Some(reference);
        }
    }

    #[test]
    fn bandwidth_is_checked() {
        for bandwidth in [0.0, -1.0, f32::NAN, f32::INFINITY, 10_001.0] {
            let error = Shaper::<f32>::new(Shape::SecondOrder { bandwidth }, RATE).err();
            assert_eq!(error.expect("refused").field, "reference.bandwidth");
        }
    }
}
