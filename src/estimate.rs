//! Shaft speed from the shaft's angle.

use crate::config::{ConfigError, positive, require};
use crate::hal::READS;
use crate::math::{Scalar, exp_m1};
use crate::per_unit::{ACCELERATION, Bases};
use crate::schema::choice;
use crate::sense::{Measured, Rotation, Shaft};

/// Where a controller that wants a speed has it from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum SpeedSource {
    /// As the sensors tell it: exact ones (simulation only), or [the times of edges](crate::sense::Reads::Edges).
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

choice! { SpeedSource { Exact, Difference { bandwidth }, Pll { bandwidth, fed } } }

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
    rate: S::Steep<1>,
    share: S::Steep<1>,
}

impl<S: Scalar> SpeedEstimator<S> {
    /// For an encoder, or exact sensors.
    pub fn new(source: &SpeedSource, shaft: &Shaft, bases: &Bases) -> Result<Self, ConfigError> {
        let period = shaft.period;
        match *source {
            SpeedSource::Exact => {
                let rule = "must not be exact where the sensors tell no speed";
                require(shaft.speed, "control.speed", rule, 0.0)?;
                Ok(Self::Exact)
            }
            SpeedSource::Difference { bandwidth } => {
                let share = -exp_m1(-checked(bandwidth, period)? * period);
                Ok(Self::Difference(Difference {
                    speed: S::ZERO,
                    rate: S::steep(
                        "control.speed",
                        [(shaft.unit / period, bases.angle)],
                        bases.speed,
                    )?,
                    share: S::steep(
                        "control.speed.bandwidth",
                        [(share, bases.speed)],
                        bases.speed,
                    )?,
                }))
            }
            SpeedSource::Pll { bandwidth, fed } => {
                let share = -exp_m1(-checked(bandwidth, period)? * period);
                // Both poles at 1 − share.
                let gains = [share * (2.0 - share), share * share / period];
                Ok(Self::Pll { observer: AngleObserver::new(gains, 0.0, shaft, bases)?, fed })
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
            Self::Difference(Difference { speed, rate, share }) => {
                let difference = S::amplify(rate, [measured.rotation.advance]);
                *speed = *speed + S::amplify(share, [difference - *speed]);
                *speed
            }
            Self::Pll { observer, fed } => {
                let acceleration = if *fed { acceleration } else { S::ZERO };
                let innovation = observer.innovation(&measured.rotation, acceleration);
                observer.correct(innovation);
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
/// It keeps no angle, which would grow until an f32 could not resolve it, but only the *lead* of its angle over the mean of
/// the reads: what the shaft turns is taken off it in every period.
#[derive(Clone, Debug)]
#[repr(C)]
pub(crate) struct AngleObserver<S: Scalar> {
    /// Estimated speed (rad/s).
    pub speed: S,
    /// Estimated angle less that of the reads' mean (in units of the rotation, as all angles here).
    lead: S,
    /// Angle per speed and acceleration over the period.
    turned: S::Steep<2>,
    /// Speed per acceleration over the period (s).
    time: S::Time,
    /// Angle per speed and acceleration over the reads' age.
    aged: S::Steep<2>,
    /// Angle per speed between two reads, and per acceleration that was less then.
    distance: S::Steep<2>,
    /// Share of the mean's innovation in that of the reads.
    share: S::Gains<1>,
    /// Speed below which the mean's counts alone (rad/s).
    slow: S,
    /// From the edge below a counter's reads to where they are in the mean: half a count, or nothing.
    offset: S,
    /// What the lead is limited to: further, the observer is lost.
    farthest: S,
    angle_gain: S::Steep<1>,
    speed_gain: S::Steep<1>,
}

impl<S: Scalar> AngleObserver<S> {
    /// From the gains of the angle (1) and the speed (1/s) for reads of no age, and that of the acceleration (1/s²) of an
    /// observer around this one.
    ///
    /// For reads that are τ old the same poles need the gains shifted by τ along the model: g1 + τ·g2 + τ²/2·g3, g2 + τ·g3, g3.
    pub fn new(
        [g1, g2]: [f32; 2],
        g3: f32,
        shaft: &Shaft,
        bases: &Bases,
    ) -> Result<Self, ConfigError> {
        let &Shaft { period, least_age, age, unit, counts, .. } = shaft;
        let &Bases { angle, speed, acceleration, .. } = bases;
        let offset = S::from_f32(if counts { 0.5 } else { 0.0 }, angle);
        let distance = period / READS as f32;
        let angle_of = |of_speed: f32, of_acceleration: f32| {
            let gains = [(of_speed / unit, speed), (of_acceleration / unit, acceleration)];
            S::steep("sensors", gains, angle)
        };
        let angle_gain = g1 + age * (g2 + 0.5 * age * g3);
        let speed_gain = (g2 + age * g3) * unit;
        Ok(Self {
            speed: S::ZERO,
            lead: offset,
            turned: angle_of(period, 0.5 * period * period)?,
            time: S::time(period),
            aged: angle_of(least_age, -0.5 * age * age)?,
            distance: angle_of(distance, -0.5 * period * distance)?,
            share: S::gains("sensors", [(0.1, angle)], angle)?,
            slow: S::from_f32(0.05 * unit.abs() / period, speed),
            offset,
            farthest: S::from_f32(0.25 * angle.0, angle),
            angle_gain: S::steep("control.observer_bandwidth", [(angle_gain, angle)], angle)?,
            speed_gain: S::steep("control.observer_bandwidth", [(speed_gain, angle)], speed)?,
        })
    }

    /// Goes on from a known speed (rad/s).
    pub fn resume(&mut self, speed: S) {
        self.speed = speed;
        self.lead = S::amplify(&self.aged, [speed, S::ZERO]) + self.offset;
    }

    /// On to the next sample, with the mean acceleration since (rad/s²).
    #[inline]
    fn predict(&mut self, rotation: &Rotation<S>, acceleration: S) {
        let turned = S::amplify(&self.turned, [self.speed, acceleration]);
        self.lead = (self.lead + (turned - rotation.advance)).limited(self.farthest);
        self.speed = self.speed + acceleration.over::<ACCELERATION>(self.time);
    }

    /// On to the next sample: by how much the mean of its reads is ahead of what it should be.
    #[inline]
    pub fn innovation(&mut self, rotation: &Rotation<S>, acceleration: S) -> S {
        self.predict(rotation, acceleration);
        self.innovation_of_mean(self.distance(acceleration), rotation, acceleration)
    }

    /// The same, but what 16 reads should be is what a counter shows at the estimated angles: rounded down as they are. A count
    /// that is where it should be then says nothing, however coarse, and only edges that come early or late correct.
    ///
    /// A tenth of the plain innovation keeps the estimate from wandering within a count; where there is no edge for many
    /// periods, all of it.
    #[inline(always)]
    pub fn innovation_of_counts(&mut self, rotation: &Rotation<S>, acceleration: S) -> S {
        self.predict(rotation, acceleration);
        let distance = self.distance(acceleration);
        let at_last_read = self.lead + rotation.behind - distance.part(rotation.shift);
        let of_counts = rotation.behind - S::mean_count(at_last_read, distance);
        let of_mean = self.innovation_of_mean(distance, rotation, acceleration);
        let blended = of_counts + S::combine(&self.share, [of_mean - of_counts]);
        if self.speed.abs() < self.slow { of_mean } else { blended }
    }

    /// What the shaft turned from one read to the next.
    #[inline]
    fn distance(&self, acceleration: S) -> S {
        S::amplify(&self.distance, [self.speed, acceleration])
    }

    #[inline]
    fn innovation_of_mean(&self, distance: S, rotation: &Rotation<S>, acceleration: S) -> S {
        let expected = S::amplify(&self.aged, [self.speed, acceleration]);
        expected + distance.part(rotation.shift) + self.offset - self.lead
    }

    /// Takes a share of the innovation into the estimates. Gives the correction of the speed (rad/s).
    #[inline]
    pub fn correct(&mut self, innovation: S) -> S {
        self.lead = self.lead + S::amplify(&self.angle_gain, [innovation]);
        let correction = S::amplify(&self.speed_gain, [innovation]);
        self.speed = self.speed + correction;
        correction
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: f32 = 5e-5;

    fn shaft(age: f32) -> Shaft {
        Shaft {
            period: PERIOD,
            least_age: age,
            age,
            unit: 1.0,
            counts: false,
            speed: true,
            grain: 0.0,
        }
    }

    fn measured(advance: f32) -> Measured<f32> {
        let rotation = Rotation { advance, behind: 0.0, shift: 0 };
        Measured { rotation, speed: 0.0, current: 0.0, bus_voltage: 24.0 }
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
                    SpeedEstimator::<f32>::new(&source, &shaft(age), &Bases::NONE).expect("valid");
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
            let mut estimator =
                SpeedEstimator::<f32>::new(&source, &shaft(age), &Bases::NONE).expect("valid");
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
            let error = SpeedEstimator::<f32>::new(&source, &shaft(0.0), &Bases::NONE)
                .expect_err("refused");
            assert_eq!(error.field, "control.speed.bandwidth");
        }
    }
}
