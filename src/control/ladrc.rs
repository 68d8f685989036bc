//! Linear active disturbance rejection control of the speed, over the current loop of [`super::pi`].
//!
//! Whatever the speed does beyond what the current makes it do is one *total disturbance* f = d − a1·ω; an extended state
//! observer tells it and the law takes it off (Z. Gao, *Scaling and bandwidth-parameterization based controller tuning*,
//! *Proc. ACC* 2003, 4989–4996):
//!
//! ```text
//! ω̇  = b0·i + f                                          b0 = a2
//! ω̂' = b0·i + f̂ + 2wo·(ω − ω̂)        f̂' = wo²·(ω − ω̂)
//! i* = (wc·(ω_d − ω̂) + ω̇_d − f̂)/b0,  limited
//! ```
//!
//! The observer is in its discrete current-estimator form with both poles at r = e^(−wo·h), gains 1 − r² and (1 − r)²/h (R.
//! Miklosovic, A. Radke, Z. Gao, *Proc. ACC* 2006, 2209–2214). It sees the measured current, the mean over the period,
//! rather than the command, so that it is right at every limit and nothing winds up. The law has no integrator: f̂ is it.

use super::pi::{CurrentLoop, lag, magnitude_optimum};
use super::{Setting, Signals, Timing};
use crate::config::{ConfigError, positive, require};
use crate::estimate::{SpeedEstimator, SpeedSource};
use crate::math::{Scalar, exp_m1};
use crate::per_unit::Bases;
use crate::schema::group;
use crate::sense::Measured;
use crate::trajectory::Reference;

/// What LADRC is built from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LadrcConfig {
    /// Bandwidth wc of the speed loop (rad/s). Positive, and at most 0.6 of the current loop's.
    pub control_bandwidth: f32,
    /// Bandwidth wo of the extended state observer, its double pole (rad/s). Positive, and at most half the sampling rate
    /// and 0.6/(the speed estimate's lag).
    pub observer_bandwidth: f32,
    /// Bandwidth of the current loop (rad/s); as [`PiConfig::current_bandwidth`](super::pi::PiConfig::current_bandwidth).
    pub current_bandwidth: f32,
    /// Where the speed that the observer sees comes from.
    pub speed: SpeedSource,
}

group! { LadrcConfig { control_bandwidth, observer_bandwidth, current_bandwidth, speed } }

impl LadrcConfig {
    /// From the bandwidth of the speed loop (rad/s) alone: an observer four times as fast (three to five times is
    /// usual) and a current loop by the magnitude optimum.
    pub fn by_bandwidth(control_bandwidth: f32, timing: &Timing, speed: SpeedSource) -> Self {
        Self {
            control_bandwidth,
            observer_bandwidth: 4.0 * control_bandwidth,
            current_bandwidth: magnitude_optimum(timing),
            speed,
        }
    }
}

/// Linear active disturbance rejection control.
#[derive(Clone, Debug)]
pub(crate) struct Ladrc<S: Scalar> {
    estimator: SpeedEstimator<S>,
    /// What is known of the acceleration since the last sample (rad/s²).
    acceleration: S,
    observer: ExtendedStateObserver<S>,
    current_limit: S,
    /// wc/b0 (A per rad/s), negative.
    proportional: S::Steep<1>,
    /// 1/b0.
    per_torque: S::Steep<1>,
    a1: S::Gains<1>,
    a2: S::Gains<1>,
    current: CurrentLoop<S>,
    signals: Signals<S>,
}

/// Observer of the speed and the total disturbance.
#[derive(Clone, Debug)]
struct ExtendedStateObserver<S: Scalar> {
    /// ω̂ − ω (rad/s): small, so that no small increment is lost to rounding.
    lead: S,
    /// f̂ (rad/s²).
    disturbance: S,
    /// The speed and the acceleration b0·i at the last sample, if there was one.
    before: Option<(S, S)>,
    /// Per mean acceleration, and per disturbance, over the period.
    moved: S::Gains<2>,
    /// What a correction leaves of the lead.
    keep: S::Steep<1>,
    disturbance_gain: S::Steep<1>,
}

impl<S: Scalar> ExtendedStateObserver<S> {
    fn new(bandwidth: f32, period: f32, bases: &Bases) -> Result<Self, ConfigError> {
        let share = -exp_m1(-bandwidth * period);
        let &Bases { speed: w, acceleration: a, .. } = bases;
        let field = "control.observer_bandwidth";
        let moved = [(0.5 * period, a), (period, a)];
        Ok(Self {
            lead: S::ZERO,
            disturbance: S::ZERO,
            before: None,
            moved: S::gains("timing.rate", moved, w)?,
            keep: S::steep(field, [((1.0 - share) * (1.0 - share), w)], w)?,
            disturbance_gain: S::steep(field, [(share * share / period, w)], a)?,
        })
    }

    fn start(&mut self) {
        self.before = None;
    }

    /// ω̂ (rad/s) at a sample, from the speed and the acceleration b0·i there. At first the speed is taken for constant.
    #[inline]
    fn step(&mut self, speed: S, driven: S) -> S {
        match self.before {
            None => {
                self.lead = S::ZERO;
                self.disturbance = -driven;
            }
            Some((speed_before, driven_before)) => {
                let moved = S::combine(&self.moved, [driven_before + driven, self.disturbance]);
                let lead = self.lead + (moved - (speed - speed_before));
                self.lead = S::amplify(&self.keep, [lead]);
                self.disturbance = self.disturbance - S::amplify(&self.disturbance_gain, [lead]);
            }
        }
        self.before = Some((speed, driven));
        speed + self.lead
    }
}

impl<S: Scalar> Ladrc<S> {
    pub fn new(config: &LadrcConfig, setting: &Setting) -> Result<Self, ConfigError> {
        let &LadrcConfig { control_bandwidth, observer_bandwidth, current_bandwidth, speed } =
            config;
        let &Setting { motor, timing, shaft, ranges, bases } = setting;
        let period = timing.period();
        let current = CurrentLoop::new("control.current_bandwidth", current_bandwidth, setting)?;
        let estimator = SpeedEstimator::new(&speed, shaft, bases)?;
        positive("control.control_bandwidth", control_bandwidth)?;
        require(
            control_bandwidth <= 0.6 * current_bandwidth,
            "control.control_bandwidth",
            "must be at most 0.6 of the current loop's",
            control_bandwidth,
        )?;
        let proportional = control_bandwidth / motor.a2;
        require(
            proportional.is_normal(),
            "control.control_bandwidth",
            "must leave a current to ask for that is a number",
            control_bandwidth,
        )?;
        require(
            proportional * ranges.speed <= 1e12,
            "control.control_bandwidth",
            "must keep the current that the law can want below 1e12 A",
            control_bandwidth,
        )?;
        positive("control.observer_bandwidth", observer_bandwidth)?;
        require(
            observer_bandwidth * period <= 0.5
                && observer_bandwidth * lag(&speed, period, shaft.age) <= 0.6,
            "control.observer_bandwidth",
            "must be at most half the sampling rate and 0.6/(the speed estimate's lag)",
            observer_bandwidth,
        )?;
        let &Bases { speed: w, acceleration: a, current: i, .. } = bases;
        Ok(Self {
            estimator,
            acceleration: S::ZERO,
            observer: ExtendedStateObserver::new(observer_bandwidth, period, bases)?,
            current_limit: S::from_f32(ranges.current_command, i),
            proportional: S::steep("control.control_bandwidth", [(-proportional, w)], i)?,
            per_torque: S::steep("motor", [(1.0 / motor.a2, a)], i)?,
            a1: S::gains("motor", [(motor.a1, w)], a)?,
            a2: S::gains("motor", [(motor.a2, i)], a)?,
            current,
            signals: Signals::NONE,
        })
    }

    /// Follows the motor while the bridge is off. Gives the speed (rad/s).
    pub fn follow(&mut self, measured: &Measured<S>) -> S {
        let speed = self.estimator.step(measured, self.acceleration);
        self.acceleration =
            S::combine(&self.a2, [measured.current]) - S::combine(&self.a1, [speed]);
        speed
    }

    /// Starts with the current that it finds, and so with the back-EMF's voltage, whatever the motor's speed. (The observer
    /// takes the first step's.)
    pub fn start(&mut self, measured: &Measured<S>, _reference: &Reference<S>) {
        self.observer.start();
        self.current.start(measured.current);
        self.signals = Signals::NONE;
    }

    pub fn know(&mut self, speed: S) {
        self.estimator.resume(speed);
    }

    /// One step; see [`Controller::step`](super::Controller::step).
    #[inline]
    pub fn step(&mut self, measured: &Measured<S>, reference: &Reference<S>, acting: S) -> S {
        let current = measured.current;
        let driven = S::combine(&self.a2, [current]);
        let seen = self.estimator.step(measured, self.acceleration);
        let speed = self.observer.step(seen, driven);
        let total = self.observer.disturbance;
        self.acceleration = driven + total;
        let z1 = speed - reference.speed;
        let wanted = S::amplify(&self.proportional, [z1])
            + S::amplify(&self.per_torque, [reference.acceleration - total]);
        let command = wanted.limited(self.current_limit);
        let voltage = self.current.step(command, current, speed, acting);
        self.signals = Signals {
            speed,
            z1,
            z2: S::combine(&self.a2, [current - command]),
            // The model's friction is no disturbance elsewhere.
            disturbance: total + S::combine(&self.a1, [speed]),
            voltage,
        };
        voltage
    }

    pub fn signals(&self) -> &Signals<S> {
        &self.signals
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::ControlConfig;
    use crate::control::pi::rig::*;
    use crate::motor::MotorParameters;
    use proptest::prelude::*;

    const MOTOR: MotorParameters = MotorParameters::PAPER;
    const PLL: SpeedSource = SpeedSource::Pll { bandwidth: 8000.0, fed: false };
    const FED: SpeedSource = SpeedSource::Pll { bandwidth: 8000.0, fed: true };
    const DIFFERENCE: SpeedSource = SpeedSource::Difference { bandwidth: 5000.0 };

    fn config(control_bandwidth: f32, speed: SpeedSource) -> LadrcConfig {
        LadrcConfig::by_bandwidth(control_bandwidth, &TIMING, speed)
    }

    fn rig(config: LadrcConfig, motor: MotorParameters) -> Rig {
        let mut rig = Rig::new(&ControlConfig::Ladrc(config), motor);
        rig.start();
        rig
    }

    #[test]
    fn settles_on_steps_and_recovers_from_loads_without_error() {
        // (configuration, dip after 0.05 N·m (rad/s))
        for (config, dip) in [
            (config(100.0, SpeedSource::Exact), [1.95, 2.15]),
            (config(400.0, SpeedSource::Exact), [0.53, 0.59]),
            (config(400.0, PLL), [0.62, 0.69]),
            (config(400.0, FED), [0.63, 0.69]),
            (config(400.0, DIFFERENCE), [0.61, 0.67]),
        ] {
            let mut rig = rig(config, MOTOR);
            // No overshoot, small or large, and none of the current either but its loop's 4 %.
            assert_within("peak", rig.run(1.0, 2000, 0)[1], [0.9999, 1.0005]);
            assert_within("overshoot", rig.run(100.0, 5000, 0)[1], [99.9995, 100.005]);
            assert_within("settled", rig.speed(), [99.9998, 100.0002]);
            rig.set_load(0.05);
            assert_within("dip", 100.0 - rig.run(100.0, 4000, 0)[0], dip);
            assert_within("settled loaded", rig.speed(), [99.9998, 100.0002]);
            // −T_l/J = −628.93.
            let disturbance = f64::from(rig.controller.signals().disturbance);
            assert_within("disturbance", disturbance, [-629.1, -628.8]);
        }
    }

    #[test]
    fn a_step_has_the_control_bandwidth() {
        let mut rig = rig(config(400.0, SpeedSource::Exact), MOTOR);
        // After 1/wc and the current loop's 150 µs a first-order lag has 63 % of its way behind it.
        rig.run(1.0, 53, 0);
        assert_within("speed", rig.speed(), [0.61, 0.66]);
    }

    #[test]
    fn friction_is_no_disturbance_but_is_taken_off() {
        let motor = MotorParameters { viscous_friction: 1e-4, ..MOTOR };
        let known = motor.coefficients().expect("valid");
        let setting = Setting {
            motor: &known,
            timing: &TIMING,
            shaft: &SHAFT,
            ranges: &RANGES,
            bases: &Bases::NONE,
        };
        let ladrc = Ladrc::new(&config(400.0, SpeedSource::Exact), &setting).expect("valid");
        let mut rig = rig(config(400.0, SpeedSource::Exact), motor);
        rig.controller = crate::control::Controller::Ladrc(ladrc);
        rig.run(100.0, 5000, 0);
        assert_within("settled", rig.speed(), [99.9998, 100.0002]);
        let disturbance = f64::from(rig.controller.signals().disturbance);
        // The friction is worth 126 rad/s².
        assert_within("disturbance", disturbance, [-0.1, 0.1]);
    }

    #[test]
    fn the_current_command_is_kept_at_a_large_step() {
        let mut rig = rig(config(400.0, SpeedSource::Exact), MOTOR);
        let mut most = 0.0_f64;
        for _ in 0..2000 {
            rig.period(&Reference::constant(100.0));
            most = most.max(rig.current());
        }
        // 15 A and the current loop's overshoot of 4 %.
        assert_within("current", most, [15.0, 15.65]);
    }

    #[test]
    fn nothing_winds_up_at_the_voltage_limit() {
        for source in [SpeedSource::Exact, FED] {
            let mut rig = rig(config(400.0, source), MOTOR);
            rig.run(50.0, 4000, 0);
            // 0.2 s and 2 s at 4 V, which are worth 67.8 rad/s.
            for periods in [4_000, 40_000] {
                rig.bus = 4.0;
                let held = rig.run(100.0, periods, 3500);
                assert_within("held", held[0], [67.79, 67.81]);
                assert_within("held", held[1], [67.79, 67.81]);
                rig.bus = 22.0;
                let free = rig.run(100.0, 4000, 0);
                assert_within("overshoot", free[1], [99.9995, 100.01]);
                assert_within("settled", rig.speed(), [99.9998, 100.0002]);
            }
        }
    }

    #[test]
    fn starts_on_a_turning_motor_without_a_bump() {
        for source in [SpeedSource::Exact, PLL, FED, DIFFERENCE] {
            for speed in [-200.0, 100.0] {
                assert_starts_turning_without_a_bump(
                    &ControlConfig::Ladrc(config(400.0, source)),
                    speed,
                );
            }
        }
    }

    #[test]
    fn all_that_is_accepted_is_stable() {
        for current_bandwidth in [500.0, 2000.0, 9999.0] {
            for speed in [
                SpeedSource::Exact,
                SpeedSource::Difference { bandwidth: 1000.0 },
                SpeedSource::Difference { bandwidth: 10_000.0 },
                SpeedSource::Pll { bandwidth: 1000.0, fed: false },
                SpeedSource::Pll { bandwidth: 1000.0, fed: true },
                SpeedSource::Pll { bandwidth: 10_000.0, fed: false },
            ] {
                for control in [0.1, 0.3, 0.599] {
                    for observer in [0.1, 1.0] {
                        let period = TIMING.period();
                        let largest = (0.599 / lag(&speed, period, 0.0)).min(0.499 / period);
                        let config = LadrcConfig {
                            control_bandwidth: control * current_bandwidth,
                            observer_bandwidth: observer * largest,
                            current_bandwidth,
                            speed,
                        };
                        let slowest = config.control_bandwidth.min(config.observer_bandwidth);
                        let periods = (16.0 / (slowest * period)) as usize;
                        let mut rig = rig(config, MOTOR);
                        let width = |[low, high]: [f64; 2]| high - low;
                        rig.run(1.0, periods / 2, 0);
                        let (first, second) =
                            (width(rig.run(1.0, periods, 0)), width(rig.run(1.0, periods, 0)));
                        assert!(
                            second < 1e-4_f64.max(0.5 * first),
                            "{config:?}: {first} to {second}"
                        );
                    }
                }
            }
        }
    }

    #[test]
    fn refusals_name_the_field() {
        let good = config(400.0, PLL);
        let cases = [
            (LadrcConfig { current_bandwidth: 0.0, ..good }, "control.current_bandwidth"),
            (LadrcConfig { current_bandwidth: 2e4, ..good }, "control.current_bandwidth"),
            (LadrcConfig { control_bandwidth: f32::NAN, ..good }, "control.control_bandwidth"),
            (LadrcConfig { control_bandwidth: 4100.0, ..good }, "control.control_bandwidth"),
            (LadrcConfig { observer_bandwidth: 0.0, ..good }, "control.observer_bandwidth"),
            (LadrcConfig { observer_bandwidth: 2500.0, ..good }, "control.observer_bandwidth"),
            (
                LadrcConfig { speed: SpeedSource::Difference { bandwidth: 0.0 }, ..good },
                "control.speed.bandwidth",
            ),
        ];
        for (config, field) in cases {
            assert_eq!(refused(&ControlConfig::Ladrc(config)), Some(field), "{config:?}");
        }
        assert_eq!(refused(&ControlConfig::Ladrc(good)), None);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// Samples and voltages that no motor gives, and a motor after them.
        #[test]
        fn stays_finite_and_recovers(
            samples in prop::collection::vec(prop::array::uniform4(-1.0..1.0_f32), 1..300),
        ) {
            let mut rig = rig(config(400.0, SpeedSource::Exact), MOTOR);
            samples.into_iter().for_each(|sample| rig.mislead(sample));
            rig.run(100.0, 8000, 0);
            assert_within("recovered", rig.speed(), [99.999, 100.001]);
        }
    }
}
