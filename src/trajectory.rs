//! Reference shaping: from a commanded speed to a reference with the two derivatives that the law feeds forward.

use crate::config::{ConfigError, positive, require};
use crate::math::{Base, Scalar, ceil, exp_m1, log2_ceil, sqrt};
use crate::per_unit::Bases;
use crate::schema::choice;

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
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Shape {
    /// The command itself, with zero derivatives: it jumps when the command does (the paper's reference).
    #[default]
    Step,
    /// The command through a critically damped second-order filter, ω_d'' = w²·(command − ω_d) − 2w·ω_d'.
    SecondOrder {
        /// Natural frequency w (rad/s). Positive, at most half the sampling rate.
        bandwidth: f32,
    },
    /// The fastest way to the command within limits of acceleration and jerk, and without overshoot: an S-curve.
    SCurve {
        /// Largest acceleration (rad/s²). Positive.
        acceleration: f32,
        /// Largest jerk (rad/s³), exceeded by up to a twentieth to arrive in whole periods, and by more for some
        /// periods where the command changes while it slows down. Positive, at most the
        /// acceleration a sampling period.
        jerk: f32,
    },
}

choice! { Shape { Step, SecondOrder { bandwidth }, SCurve { acceleration, jerk } } }

/// Shapes a commanded speed, one sample per period.
///
/// Between samples the jerk is constant, so speed and acceleration follow exactly by integration, and each of the three
/// is the derivative of the one before at every sample.
#[derive(Clone, Debug)]
#[repr(C)]
pub struct Shaper<S: Scalar> {
    kind: Kind<S>,
    /// The derivatives here are in bases that are 2^`fine` times smaller than those of the reference: their rounding errors add up.
    fine: u32,
    /// What the speed and the acceleration change by in a period.
    moved: S::Gains<2>,
    gained: S::Gains<1>,
    target: S,
    /// The output less the target: small where it settles, so that no small increment is lost to rounding.
    rest: S,
    acceleration: S,
    jerk: S,
    /// The reference at the last sample.
    reference: Reference<S>,
}

#[derive(Clone, Debug)]
enum Kind<S: Scalar> {
    Step,
    SecondOrder { stiffness: S::Steep<1>, damping: S::Steep<1> },
    SCurve(SCurve<S>),
}

/// Refuses a configured value where a signal that it may cause takes more than a quarter of its base.
fn fits<S: Scalar>(
    field: &'static str,
    signal: f32,
    base: Base,
    value: f32,
) -> Result<(), ConfigError> {
    let taken = S::constant(field, 2.0 * signal, base);
    taken.map(drop).map_err(|error| ConfigError { value, ..error })
}

impl<S: Scalar> Shaper<S> {
    /// A shaper at rest at zero speed, for a sampling rate in Hz.
    pub(crate) fn new(shape: Shape, rate: f32, bases: &Bases) -> Result<Self, ConfigError> {
        let period = 1.0 / rate;
        let &Bases { speed, acceleration: of_acceleration, jerk: of_jerk, .. } = bases;
        // A quarter of the finer bases holds this much.
        let fine_for = |acceleration: f32, jerk: f32| {
            let share = (acceleration / of_acceleration.0).max(jerk / of_jerk.0);
            (-log2_ceil(4.0 * share)).clamp(0, 16) as u32
        };
        let (kind, fine) = match shape {
            Shape::Step => (Kind::Step, 0),
            Shape::SecondOrder { bandwidth } => {
                require(
                    bandwidth > 0.0 && bandwidth <= 0.5 * rate,
                    "reference.bandwidth",
                    "must be positive and at most half the sampling rate",
                    bandwidth,
                )?;
                // A double integrator over a held jerk, with both poles placed where e^(−w·h) puts them.
                let decay = -exp_m1(-bandwidth * period);
                let field = "reference.bandwidth";
                let stiffness = -decay * decay / (period * period);
                let damping = -(2.0 * decay - 0.5 * decay * decay) / period;
                // From one end of the speeds to the other, and back before it is there.
                let way = 0.25 * speed.0;
                fits::<S>(field, 0.25 * bandwidth * bandwidth * way, of_jerk, bandwidth)?;
                let fine = fine_for(bandwidth * way, bandwidth * bandwidth * way);
                let (acceleration, jerk) = (of_acceleration.finer(fine), of_jerk.finer(fine));
                let kind = Kind::SecondOrder {
                    stiffness: S::steep(field, [(stiffness, speed)], jerk)?,
                    damping: S::steep(field, [(damping, acceleration)], jerk)?,
                };
                (kind, fine)
            }
            Shape::SCurve { acceleration, jerk } => {
                positive("reference.acceleration", acceleration)?;
                positive("reference.jerk", jerk)?;
                require(
                    jerk * period <= acceleration,
                    "reference.jerk",
                    "must be at most reference.acceleration a sampling period",
                    jerk,
                )?;
                fits::<S>("reference.acceleration", acceleration, of_acceleration, acceleration)?;
                fits::<S>("reference.jerk", 1.1 * jerk, of_jerk, jerk)?;
                let fine = fine_for(acceleration, 1.1 * jerk);
                let bases = [speed, of_acceleration.finer(fine), of_jerk.finer(fine)];
                (Kind::SCurve(SCurve::new(acceleration, jerk, period, bases)), fine)
            }
        };
        let (acceleration, jerk) = (of_acceleration.finer(fine), of_jerk.finer(fine));
        let moved = [(period, acceleration), (0.5 * period * period, jerk)];
        Ok(Self {
            kind,
            fine,
            moved: S::gains("timing.rate", moved, speed)?,
            gained: S::gains("timing.rate", [(period, jerk)], acceleration)?,
            target: S::ZERO,
            rest: S::ZERO,
            acceleration: S::ZERO,
            jerk: S::ZERO,
            reference: Reference::constant(S::ZERO),
        })
    }

    /// Sets the commanded speed (rad/s).
    pub fn set_target(&mut self, target: S) {
        if target == self.target {
            return;
        }
        self.rest = self.rest + (self.target - target);
        self.target = target;
        self.replan();
    }

    /// Starts anew from a speed (rad/s), at rest in its derivatives.
    pub fn reset(&mut self, speed: S) {
        self.rest = speed - self.target;
        self.acceleration = S::ZERO;
        self.jerk = S::ZERO;
        self.reference = Reference::constant(speed);
        self.replan();
    }

    fn replan(&mut self) {
        if let Kind::SCurve(curve) = &mut self.kind {
            curve.planned = false;
        }
    }

    /// Goes on to the next sample.
    #[inline]
    pub fn advance(&mut self) -> &Reference<S> {
        if let Kind::Step = self.kind {
            self.reference.speed = self.target;
            return &self.reference;
        }
        self.rest = self.rest + S::accumulate(&self.moved, [self.acceleration, self.jerk]);
        self.acceleration = self.acceleration + S::accumulate(&self.gained, [self.jerk]);
        match &mut self.kind {
            Kind::Step => {}
            Kind::SecondOrder { stiffness, damping } => {
                self.jerk =
                    S::amplify(stiffness, [self.rest]) + S::amplify(damping, [self.acceleration]);
            }
            Kind::SCurve(curve) => {
                if curve.is_over(self.rest, self.acceleration) {
                    self.rest = S::ZERO;
                    self.acceleration = S::ZERO;
                }
                self.jerk = curve.next();
            }
        }
        self.reference = Reference {
            speed: self.target + self.rest,
            acceleration: self.acceleration.coarser(self.fine),
            jerk: self.jerk.coarser(self.fine),
        };
        &self.reference
    }

    /// The reference at the last sample.
    pub fn reference(&self) -> &Reference<S> {
        &self.reference
    }
}

/// Three stretches of constant jerk: towards the largest acceleration, along it, and back to none.
#[derive(Clone, Debug)]
struct SCurve<S> {
    acceleration: f32,
    jerk: f32,
    period: f32,
    /// Of speed, acceleration and jerk.
    bases: [Base; 3],
    planned: bool,
    stretches: [Stretch<S>; 3],
}

#[derive(Clone, Copy, Debug)]
struct Stretch<S> {
    periods: u32,
    jerk: S,
}

impl<S: Scalar> SCurve<S> {
    const NONE: [Stretch<S>; 3] = [Stretch { periods: 0, jerk: S::ZERO }; 3];

    fn new(acceleration: f32, jerk: f32, period: f32, bases: [Base; 3]) -> Self {
        Self { acceleration, jerk, period, bases, planned: true, stretches: Self::NONE }
    }

    /// Whether the way has been gone; plans one from here after a new command.
    fn is_over(&mut self, rest: S, acceleration: S) -> bool {
        if !self.planned {
            self.stretches =
                self.plan(-rest.to_f32(self.bases[0]), acceleration.to_f32(self.bases[1]));
            self.planned = true;
        }
        self.stretches[2].periods == 0
    }

    fn next(&mut self) -> S {
        let stretch = self.stretches.iter_mut().find(|stretch| stretch.periods > 0);
        stretch.map_or(S::ZERO, |stretch| {
            stretch.periods -= 1;
            stretch.jerk
        })
    }

    /// A way that changes the speed by `way` (rad/s) and ends without acceleration, in whole periods.
    #[cold]
    fn plan(&self, way: f32, acceleration: f32) -> [Stretch<S>; 3] {
        let &Self { acceleration: limit, jerk, period, .. } = self;
        if way == 0.0 && acceleration == 0.0 {
            return Self::NONE;
        }
        // What the speed changes by until the acceleration has gone decides which way to go first.
        let up = way >= 0.5 * acceleration * acceleration.abs() / jerk;
        let sign = if up { 1.0 } else { -1.0 };
        let (way, start) = (sign * way, sign * acceleration);
        let peak = sqrt((jerk * way + 0.5 * start * start).max(0.0)).min(limit);
        let along = way - (peak * peak - 0.5 * start * start) / jerk;
        let periods = |time: f32| ceil(time / period);
        let rising = periods((peak - start).abs() / jerk).max(1.0);
        let cruising = periods((along / peak.max(f32::MIN_POSITIVE)).max(0.0));
        let falling = periods(peak / jerk).max(1.0);
        // The acceleration that makes up for whole periods.
        let peak = (way - 0.5 * start * rising * period)
            / ((0.5 * rising + cruising + 0.5 * falling) * period);
        let stretch = |periods: f32, jerk: f32| Stretch {
            periods: periods as u32,
            jerk: S::from_f32(jerk, self.bases[2]),
        };
        [
            stretch(rising, sign * (peak - start) / (rising * period)),
            stretch(cruising, 0.0),
            stretch(falling, -sign * peak / (falling * period)),
        ]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const RATE: f32 = 20_000.0;

    fn shaped(shape: Shape, samples: usize) -> impl Iterator<Item = Reference<f32>> {
        let mut shaper = Shaper::new(shape, RATE, &Bases::NONE).expect("valid");
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
            let error =
                Shaper::<f32>::new(Shape::SecondOrder { bandwidth }, RATE, &Bases::NONE).err();
            assert_eq!(error.expect("refused").field, "reference.bandwidth");
        }
    }

    const S_CURVE: Shape = Shape::SCurve { acceleration: 2000.0, jerk: 1e5 };

    #[test]
    fn an_s_curve_takes_the_time_that_its_limits_need_and_keeps_them() {
        let mut arrived = None;
        for (sample, reference) in shaped(S_CURVE, 2000).enumerate() {
            assert!(reference.acceleration <= 2000.0 * 1.001, "{reference:?}");
            assert!(reference.jerk.abs() <= 1e5 * 1.001, "{reference:?}");
            assert!(reference.speed <= 100.0 && reference.acceleration >= -0.05, "{reference:?}");
            if reference == Reference::constant(100.0) {
                arrived.get_or_insert(sample);
            }
        }
        // 100/2000 s along the largest acceleration, and 2000/1e5 s to get there and back.
        let expected = (100.0 / 2000.0 + 2000.0 / 1e5) * RATE;
        let arrived = arrived.expect("it arrives") as f32;
        assert!((arrived - expected).abs() <= 3.0, "{arrived} samples, not {expected}");
    }

    #[test]
    fn an_s_curve_goes_anywhere_from_anywhere_without_a_jump() {
        let mut shaper = Shaper::<f32>::new(S_CURVE, RATE, &Bases::NONE).expect("valid");
        let mut before = *shaper.reference();
        for (target, samples) in
            [(100.0, 300), (20.0, 250), (20.1, 700), (-150.0, 1500), (-149.999, 60), (0.0, 3000)]
        {
            shaper.set_target(target);
            for _ in 0..samples {
                let reference = *shaper.advance();
                let speed =
                    before.speed + before.acceleration / RATE + 0.5 * before.jerk / RATE / RATE;
                // An f32 that sums thousands of steps arrives with a rest of a few mrad/s.
                assert!((reference.speed - speed).abs() < 5e-3, "{reference:?} after {before:?}");
                let acceleration = before.acceleration + before.jerk / RATE;
                assert!((reference.acceleration - acceleration).abs() < 5.0, "{reference:?}");
                assert!(reference.acceleration.abs() <= 2000.0 * 1.01, "{reference:?}");
                assert!(reference.jerk.abs() <= 1e5 * 1.05, "{reference:?}");
                before = reference;
            }
        }
        assert_eq!(before, Reference::constant(0.0));
    }

    #[test]
    fn limits_of_an_s_curve_are_checked() {
        for (acceleration, jerk, field) in [
            (0.0, 1e5, "reference.acceleration"),
            (f32::NAN, 1e5, "reference.acceleration"),
            (1e3, 0.0, "reference.jerk"),
            (1e3, f32::INFINITY, "reference.jerk"),
            (1e3, 2.1e7, "reference.jerk"),
        ] {
            let shape = Shape::SCurve { acceleration, jerk };
            let error = Shaper::<f32>::new(shape, RATE, &Bases::NONE).expect_err("refused");
            assert_eq!(error.field, field);
        }
    }
}
