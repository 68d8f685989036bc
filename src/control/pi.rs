//! Cascaded PI controllers of current and speed, as the textbooks have them and most drives run them.
//!
//! ```text
//! i* = kp·(ω_d − ω) + I + (ω̇_d − d̂)/a2,  limited        kp = 2ζ·w/a2     I' = (w²/a2)·(ω_d − ω)
//! u  = kc·(i* − i) + V + Kb·ω                           kc ≈ wc·La       V' = kc·a4·(i* − i)
//! ```
//!
//! With an ideal current loop the speed has the poles of s² + 2ζ·w·s + w². The zero of the current controller cancels
//! the armature's pole −a4 = −Ra/La, exactly so in discrete time: with Ad = e^(−a4·h) the voltage that a period adds to
//! the current is (1 − Ad)/Ra, so that kc = wc·h·Ra/(1 − Ad) leaves the loop wc·h/(z − 1) and its delay.
//!
//! *Tuning by the book.* The magnitude optimum puts wc to 1/(2·TΣ), where TΣ = 1.5·h is the delay of a period and half a
//! period of hold. The symmetrical optimum of factor a puts kp·a2 to 1/(a·TΣ) and the integral time to a²·TΣ, where TΣ is
//! the lag of current loop and speed estimate: w = 1/(a^1.5·TΣ), ζ = √a/2. (W. Leonhard, *Control of Electrical Drives*,
//! 3rd ed., Springer 2001; J. W. Umland, M. Safiuddin, *IEEE Trans. Ind. Appl.* 26(3), 1990, 489–497.)
//!
//! *Windup.* What the limits take is taken back from the integrators (K. J. Åström, L. Rundqwist, *Proc. ACC* 1989,
//! 1693–1698). For the current this is total: a controller whose zero cancels the armature's pole and that integrates
//! e + (u_applied − u)/kc has the state V' = a4·(u_applied − Kb·ω − V), the model's Ra·i. It forgets whatever it held in
//! La/Ra. The speed's integrator gives back at most what it would gather: it rests at a limit, and stays what it is in
//! the steady state, the current that holds the speed.
//!
//! *Disturbance observer* (K. Ohishi, K. Ohnishi, K. Miyachi, *Proc. IPEC Tokyo* 1983, vol. 2, from p. 1209):
//! d̂' = L·(ω̇ + a1·ω − a2·i − d̂) without a derivative, as d̂ = L·(ω − x), x' = a2·i − a1·ω + d̂. It sees the measured
//! current, so that no limit winds it up, and the poles of speed and observer are those of each by itself:
//! (s + L)·(s² + 2ζ·w·s + w²).

use super::{Setting, Signals, Timing};
use crate::config::{ConfigError, positive, require};
use crate::estimate::{SpeedEstimator, SpeedSource};
use crate::math::{Scalar, exp_m1};
use crate::per_unit::Bases;
use crate::schema::group;
use crate::sense::Measured;
use crate::trajectory::Reference;

/// What cascaded PI controllers are built from.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PiConfig {
    /// Bandwidth wc of the current loop (rad/s). Positive, and at most 0.75/TΣ, where TΣ is 1.5 periods, or half a
    /// period if the voltage takes effect at once.
    pub current_bandwidth: f32,
    /// Natural frequency w of the speed loop (rad/s). Positive; with T the lag of the current loop and the speed
    /// estimate, w·T may be 0.5 at most, and 2ζ·w·T 0.8.
    pub speed_bandwidth: f32,
    /// Damping ζ of the speed loop. From 0.5 to 5.
    pub speed_damping: f32,
    /// Bandwidth L of the disturbance observer (rad/s), if there is to be one. Positive, and at most half the sampling
    /// rate and 0.6/(the speed estimate's lag).
    pub disturbance: Option<f32>,
    /// Where the speed comes from.
    pub speed: SpeedSource,
}

group! { PiConfig { current_bandwidth, speed_bandwidth, speed_damping, disturbance, speed } }

impl PiConfig {
    /// The current loop by the magnitude optimum, the speed loop by the symmetrical optimum of the standard factor 2.
    /// Without disturbance observer.
    pub fn magnitude_and_symmetrical_optimum(timing: &Timing, speed: SpeedSource) -> Self {
        let current_bandwidth = magnitude_optimum(timing);
        let lag = 1.0 / current_bandwidth + lag(&speed, timing.period(), 0.0);
        Self {
            current_bandwidth,
            // 2^−1.5, and √2/2.
            speed_bandwidth: 0.5 * core::f32::consts::FRAC_1_SQRT_2 / lag,
            speed_damping: core::f32::consts::FRAC_1_SQRT_2,
            disturbance: None,
            speed,
        }
    }
}

/// Bandwidth of a current loop by the magnitude optimum (rad/s).
pub(super) fn magnitude_optimum(timing: &Timing) -> f32 {
    0.5 / small_times(timing)
}

/// Sum TΣ of the current loop's small time constants (s): what the voltage is late, and half a period of hold.
fn small_times(timing: &Timing) -> f32 {
    timing.horizon() - 0.5 * timing.period()
}

/// What a speed estimate lags behind a ramp (s). A loop that is fed lags less, as far as what it is fed with is right.
pub(super) fn lag(source: &SpeedSource, period: f32, age: f32) -> f32 {
    match *source {
        SpeedSource::Exact => 0.0,
        SpeedSource::Difference { bandwidth } => 1.0 / bandwidth + 0.5 * period + age,
        SpeedSource::Pll { bandwidth, .. } => 2.0 / bandwidth,
    }
}

/// Cascaded PI controllers of current and speed.
#[derive(Clone, Debug)]
pub(crate) struct CascadedPi<S: Scalar> {
    estimator: SpeedEstimator<S>,
    /// What is known of the acceleration since the last sample (rad/s²).
    acceleration: S,
    /// The current that holds the speed, I (A).
    integral: S,
    /// Wanted current less the current command (A).
    excess: S,
    current_limit: S,
    /// kp (A per rad/s), negative.
    proportional: S::Steep<1>,
    /// What a period of speed error adds to the integral (A per rad/s), negative.
    integration: S::Steep<1>,
    /// 1/a2.
    per_torque: S::Steep<1>,
    /// a2·i − a1·ω.
    modelled: S::Gains<2>,
    a2: S::Gains<1>,
    observer: Option<DisturbanceObserver<S>>,
    current: CurrentLoop<S>,
    signals: Signals<S>,
}

impl<S: Scalar> CascadedPi<S> {
    pub fn new(config: &PiConfig, setting: &Setting) -> Result<Self, ConfigError> {
        let &PiConfig { current_bandwidth, speed_bandwidth, speed_damping, disturbance, speed } =
            config;
        let &Setting { motor, timing, shaft, ranges, bases } = setting;
        let period = timing.period();
        let current = CurrentLoop::new("control.current_bandwidth", current_bandwidth, setting)?;
        let estimator = SpeedEstimator::new(&speed, shaft, bases)?;
        let estimate_lag = lag(&speed, period, shaft.age);
        let lag = 1.0 / current_bandwidth + estimate_lag;
        require(
            (0.5..=5.0).contains(&speed_damping),
            "control.speed_damping",
            "must be from 0.5 to 5",
            speed_damping,
        )?;
        positive("control.speed_bandwidth", speed_bandwidth)?;
        require(
            speed_bandwidth * lag <= 0.5 && 2.0 * speed_damping * speed_bandwidth * lag <= 0.8,
            "control.speed_bandwidth",
            "must be slower than the current loop and the speed estimate: at most 0.5, and 0.4/damping, of 1/(their lag)",
            speed_bandwidth,
        )?;
        let proportional = 2.0 * speed_damping * speed_bandwidth / motor.a2;
        let integration = speed_bandwidth * speed_bandwidth * period / motor.a2;
        require(
            integration.is_normal(),
            "control.speed_bandwidth",
            "must leave a current to integrate that is a number",
            speed_bandwidth,
        )?;
        require(
            proportional * ranges.speed <= 1e12,
            "control.speed_bandwidth",
            "must keep the current that the law can want below 1e12 A",
            speed_bandwidth,
        )?;
        let observer = match disturbance {
            None => None,
            Some(bandwidth) => {
                positive("control.disturbance", bandwidth)?;
                require(
                    bandwidth * period <= 0.5 && bandwidth * estimate_lag <= 0.6,
                    "control.disturbance",
                    "must be at most half the sampling rate and 0.6/(the speed estimate's lag)",
                    bandwidth,
                )?;
                Some(DisturbanceObserver::new(bandwidth, period, bases)?)
            }
        };
        let &Bases { speed: w, acceleration: a, current: i, .. } = bases;
        let field = "control.speed_bandwidth";
        Ok(Self {
            estimator,
            acceleration: S::ZERO,
            integral: S::ZERO,
            excess: S::ZERO,
            current_limit: S::from_f32(ranges.current_command, i),
            proportional: S::steep(field, [(-proportional, w)], i)?,
            integration: S::steep(field, [(-integration, w)], i)?,
            per_torque: S::steep("motor", [(1.0 / motor.a2, a)], i)?,
            modelled: S::gains("motor", [(motor.a2, i), (-motor.a1, w)], a)?,
            a2: S::gains("motor", [(motor.a2, i)], a)?,
            observer,
            current,
            signals: Signals::NONE,
        })
    }

    /// Follows the motor while the bridge is off. Gives the speed (rad/s).
    pub fn follow(&mut self, measured: &Measured<S>) -> S {
        let speed = self.estimator.step(measured, self.acceleration);
        self.acceleration = self.modelled_acceleration(speed, measured.current);
        speed
    }

    /// Starts with the current that it finds, and so with the back-EMF's voltage, whatever the motor's speed. (What holds
    /// a speed is taken from the first step's.)
    pub fn start(&mut self, measured: &Measured<S>, _reference: &Reference<S>) {
        self.integral = measured.current.limited(self.current_limit);
        self.excess = S::ZERO;
        self.signals = Signals::NONE;
        self.current.start(measured.current);
        if let Some(observer) = &mut self.observer {
            observer.start();
        }
    }

    pub fn know(&mut self, speed: S) {
        self.estimator.resume(speed);
    }

    /// One step; see [`Controller::step`](super::Controller::step).
    #[inline]
    pub fn step(&mut self, measured: &Measured<S>, reference: &Reference<S>, acting: S) -> S {
        let current = measured.current;
        let speed = self.estimator.step(measured, self.acceleration);

        // The period that is over: what was wanted less what that voltage was worth.
        let missing = self.excess + self.current.missing(acting);
        let growth = S::amplify(&self.integration, [self.signals.z1]);
        self.integral =
            (self.integral + (growth - missing.limited(growth.abs()))).limited(self.current_limit);

        let disturbance = match &mut self.observer {
            Some(observer) => {
                let modelled = S::combine(&self.modelled, [current, speed]);
                let disturbance = observer.step(speed, modelled);
                self.acceleration = modelled + disturbance;
                disturbance
            }
            // In the steady state this is no acceleration: a speed estimate that is fed with it has no offset there.
            None => {
                self.acceleration = S::combine(&self.a2, [current - self.integral]);
                S::ZERO
            }
        };
        let z1 = speed - reference.speed;
        let wanted = self.integral
            + S::amplify(&self.proportional, [z1])
            + S::amplify(&self.per_torque, [reference.acceleration - disturbance]);
        let command = wanted.limited(self.current_limit);
        self.excess = wanted - command;
        let voltage = self.current.step(command, current, speed, acting);
        let z2 = S::combine(&self.a2, [current - command]);
        self.signals = Signals { speed, z1, z2, disturbance, voltage };
        voltage
    }

    pub fn signals(&self) -> &Signals<S> {
        &self.signals
    }

    /// −a1·ω + a2·i (rad/s²).
    #[inline]
    fn modelled_acceleration(&self, speed: S, current: S) -> S {
        S::combine(&self.modelled, [current, speed])
    }
}

/// First-order observer of the disturbance.
#[derive(Clone, Debug)]
struct DisturbanceObserver<S: Scalar> {
    /// ω − x (rad/s): small, so that no small increment is lost to rounding.
    rest: S,
    disturbance: S,
    /// The speed and the modelled acceleration at the last sample, if there was one.
    before: Option<(S, S)>,
    /// Per mean acceleration, and per disturbance, over the period; negative.
    moved: S::Gains<2>,
    gain: S::Steep<1>,
}

impl<S: Scalar> DisturbanceObserver<S> {
    fn new(bandwidth: f32, period: f32, bases: &Bases) -> Result<Self, ConfigError> {
        let &Bases { speed, acceleration, .. } = bases;
        let gain = -exp_m1(-bandwidth * period) / period;
        let moved = [(-0.5 * period, acceleration), (-period, acceleration)];
        Ok(Self {
            rest: S::ZERO,
            disturbance: S::ZERO,
            before: None,
            moved: S::gains("timing.rate", moved, speed)?,
            gain: S::steep("control.disturbance", [(gain, speed)], acceleration)?,
        })
    }

    fn start(&mut self) {
        self.rest = S::ZERO;
        self.disturbance = S::ZERO;
        self.before = None;
    }

    /// d̂ (rad/s²) at a sample, from the speed and the acceleration −a1·ω + a2·i there.
    #[inline]
    fn step(&mut self, speed: S, modelled: S) -> S {
        if let Some((speed_before, modelled_before)) = self.before {
            let moved = S::combine(&self.moved, [modelled_before + modelled, self.disturbance]);
            self.rest = self.rest + ((speed - speed_before) + moved);
        }
        self.before = Some((speed, modelled));
        self.disturbance = S::amplify(&self.gain, [self.rest]);
        self.disturbance
    }
}

/// PI controller of the current with feed-forward of the back-EMF.
#[derive(Clone, Debug)]
pub(super) struct CurrentLoop<S: Scalar> {
    /// V, what the resistance takes (V).
    drop: S,
    /// The last period's, if the bridge was on.
    before: Option<Before<S>>,
    /// kc (V/A).
    gain: S::Steep<1>,
    /// 1/kc.
    per_gain: S::Steep<1>,
    resistance: S::Gains<1>,
    back_emf: S::Gains<1>,
    /// 1 − e^(−a4·h).
    share: S::Steep<1>,
}

#[derive(Clone, Copy, Debug)]
struct Before<S> {
    /// Kb·ω (V).
    back_emf: S,
    /// The wanted voltage (V).
    voltage: S,
}

impl<S: Scalar> CurrentLoop<S> {
    /// With a bandwidth (rad/s), and the configuration's name for it.
    pub fn new(
        field: &'static str,
        bandwidth: f32,
        setting: &Setting,
    ) -> Result<Self, ConfigError> {
        let &Setting { motor, timing, ranges, bases, .. } = setting;
        let &Bases { speed: w, current: i, voltage: v, .. } = bases;
        positive(field, bandwidth)?;
        require(
            bandwidth * small_times(timing) <= 0.75,
            field,
            "must be at most 0.5 of the sampling rate (1.5 if the voltage takes effect at once)",
            bandwidth,
        )?;
        let share = -exp_m1(-motor.a4 * timing.period());
        let resistance = motor.a4 * motor.inductance;
        let back_emf = motor.a3 * motor.inductance;
        let gain = bandwidth * timing.period() * resistance / share;
        positive(field, gain)?;
        let largest_voltage = gain * (ranges.current + ranges.current_command)
            + resistance * ranges.current
            + back_emf * ranges.speed;
        require(
            largest_voltage <= 1e15 && motor.a2 * ranges.current_command <= 1e15,
            field,
            "must keep the voltage that the law can ask for below 1e15 V",
            bandwidth,
        )?;
        Ok(Self {
            drop: S::ZERO,
            before: None,
            gain: S::steep(field, [(gain, i)], v)?,
            per_gain: S::steep(field, [(1.0 / gain, v)], i)?,
            resistance: S::gains("motor.resistance", [(resistance, i)], v)?,
            back_emf: S::gains("motor.back_emf_constant", [(back_emf, w)], v)?,
            share: S::steep("motor", [(share, v)], v)?,
        })
    }

    /// Starts with a current (A): as if that had flowed for long.
    pub fn start(&mut self, current: S) {
        self.drop = S::combine(&self.resistance, [current]);
        self.before = None;
    }

    /// By how much the last command was larger than one that would have asked for the acting voltage (A).
    #[inline]
    pub fn missing(&self, acting: S) -> S {
        match &self.before {
            Some(before) => S::amplify(&self.per_gain, [before.voltage - acting]),
            None => S::ZERO,
        }
    }

    /// The wanted voltage (V), from the command, the current, the speed and the acting voltage.
    #[inline]
    pub fn step(&mut self, command: S, current: S, speed: S, acting: S) -> S {
        if let Some(before) = &self.before {
            self.drop = self.drop + S::amplify(&self.share, [acting - before.back_emf - self.drop]);
        }
        let back_emf = S::combine(&self.back_emf, [speed]);
        let voltage = S::amplify(&self.gain, [command - current]) + self.drop + back_emf;
        self.before = Some(Before { back_emf, voltage });
        voltage
    }
}

/// A motor, discretised exactly in f64, that plays with a controller at 20 kHz.
#[cfg(test)]
pub(super) mod rig {
    use crate::control::injection::Injections;
    use crate::control::{ControlConfig, Controller, Ranges, Setting, Timing};
    use crate::motor::{Coefficients, MotorParameters};
    use crate::per_unit::Bases;
    use crate::sense::{Measured, Rotation, Shaft};
    use crate::trajectory::Reference;

    pub const TIMING: Timing = Timing { rate: 20_000.0, delay: true };
    pub const SHAFT: Shaft = Shaft {
        period: 1.0 / TIMING.rate,
        least_age: 0.0,
        age: 0.0,
        unit: 1.0,
        counts: false,
        speed: true,
        grain: 0.0,
    };
    pub const RANGES: Ranges = Ranges { speed: 400.0, current: 40.0, current_command: 15.0 };

    /// A field's refusal, if there is one, of a controller for the paper's motor.
    pub fn refused(config: &ControlConfig) -> Option<&'static str> {
        Rig::try_new(config, MotorParameters::PAPER).err()
    }

    pub fn assert_starts_turning_without_a_bump(config: &ControlConfig, speed: f64) {
        let mut rig = Rig::new(config, MotorParameters::PAPER);
        // What an earlier run left must not show.
        rig.start();
        rig.set_load(0.05);
        rig.run(-100.0, 1000, 0);
        rig.set_load(0.0);
        rig.turn(speed);
        (0..1000).for_each(|_| rig.coast());
        rig.start();
        let back_emf = speed * 59e-3;
        for _ in 0..100 {
            rig.period(&Reference::constant(speed as f32));
            let voltage = f64::from(rig.controller.signals().voltage);
            assert_within("voltage", voltage - back_emf, [-1e-2, 1e-2]);
            assert_within("current", rig.current(), [-1e-2, 1e-2]);
        }
    }

    pub fn assert_within(what: &str, value: f64, [low, high]: [f64; 2]) {
        assert!((low..=high).contains(&value), "{what}: {value} is not in {low}..={high}");
    }

    pub struct Rig {
        pub controller: Controller<f32>,
        /// θ (rad), ω (rad/s), i (A), u (V), d (rad/s²).
        pub state: [f64; 5],
        /// What the bridge can give (V).
        pub bus: f64,
        inertia: f64,
        transition: [[f64; 5]; 5],
        angle: f64,
        wanted: f32,
    }

    /// These controllers have none.
    const NONE: &Injections<f32> = &Injections::NONE;

    impl Rig {
        /// A controller that knows the paper's motor, on one with these parameters.
        pub fn new(config: &ControlConfig, motor: MotorParameters) -> Self {
            Self::try_new(config, motor).expect("valid")
        }

        fn try_new(config: &ControlConfig, motor: MotorParameters) -> Result<Self, &'static str> {
            let known = MotorParameters::PAPER.coefficients().expect("valid");
            let setting = Setting {
                motor: &known,
                timing: &TIMING,
                shaft: &SHAFT,
                ranges: &RANGES,
                bases: &Bases::NONE,
            };
            let controller = Controller::new(config, &setting, &mut { *NONE });
            Ok(Self {
                controller: controller.map_err(|error| error.field)?,
                state: [0.0; 5],
                bus: 22.0,
                inertia: f64::from(motor.inertia),
                transition: transition(&motor.coefficients().expect("valid")),
                angle: 0.0,
                wanted: 0.0,
            })
        }

        pub fn set_load(&mut self, torque: f64) {
            self.state[4] = -torque / self.inertia;
        }

        /// The motor is found turning (rad/s), without current.
        pub fn turn(&mut self, speed: f64) {
            self.state[1] = speed;
            self.state[2] = 0.0;
        }

        pub fn speed(&self) -> f64 {
            self.state[1]
        }

        pub fn current(&self) -> f64 {
            self.state[2]
        }

        pub fn measured(&self) -> Measured<f32> {
            Measured {
                rotation: Rotation {
                    advance: (self.state[0] - self.angle) as f32,
                    behind: 0.0,
                    shift: 0,
                },
                speed: self.speed() as f32,
                current: self.current() as f32,
                bus_voltage: 24.0,
            }
        }

        /// A period of a motor that turns freely: the bridge is off.
        pub fn coast(&mut self) {
            self.controller.follow(NONE, &self.measured());
            self.state[3] = self.speed() * f64::from(MotorParameters::PAPER.back_emf_constant);
            self.advance();
            self.state[2] = 0.0;
        }

        /// A period of a sample and an acting voltage that have nothing to do with the motor, each from −1 to 1.
        pub fn mislead(&mut self, [speed, current, acting, advance]: [f32; 4]) {
            let measured = Measured {
                rotation: Rotation { advance: 0.02 * advance, behind: 0.0, shift: 0 },
                speed: 400.0 * speed,
                current: 40.0 * current,
                bus_voltage: 24.0,
            };
            let reference = Reference::constant(-measured.speed);
            let decision = self.controller.step(NONE, &measured, &reference, 28.0 * acting);
            assert!(decision.voltage.is_finite());
        }

        pub fn start(&mut self) {
            let reference = Reference::constant(self.speed() as f32);
            self.controller.start(NONE, &self.measured(), &reference);
            // As the drive tells it.
            self.wanted = self.speed() as f32 * MotorParameters::PAPER.back_emf_constant;
        }

        /// A period of control.
        pub fn period(&mut self, reference: &Reference<f32>) {
            self.state[3] = f64::from(self.wanted).clamp(-self.bus, self.bus);
            self.wanted = self
                .controller
                .step(NONE, &self.measured(), reference, self.state[3] as f32)
                .voltage;
            assert!(self.wanted.is_finite());
            self.advance();
        }

        /// Periods of control at a constant reference (rad/s); gives the range of the speed after `skip` of them.
        pub fn run(&mut self, target: f32, periods: usize, skip: usize) -> [f64; 2] {
            let mut range = [f64::INFINITY, f64::NEG_INFINITY];
            for period in 0..periods {
                self.period(&Reference::constant(target));
                if period >= skip {
                    range = [range[0].min(self.speed()), range[1].max(self.speed())];
                }
            }
            range
        }

        fn advance(&mut self) {
            self.angle = self.state[0];
            let state = self.state;
            for (value, row) in self.state.iter_mut().zip(&self.transition) {
                *value = row.iter().zip(&state).map(|(gain, state)| gain * state).sum();
            }
        }
    }

    /// e^(A·h), by its series.
    fn transition(motor: &Coefficients) -> [[f64; 5]; 5] {
        let &Coefficients { a1, a2, a3, a4, inductance, .. } = motor;
        let [a1, a2, a3, a4] = [a1, a2, a3, a4].map(f64::from);
        let h = 1.0 / f64::from(TIMING.rate);
        let mut rate = [[0.0; 5]; 5];
        rate[0][1] = h;
        rate[1] = [0.0, -a1 * h, a2 * h, 0.0, h];
        rate[2] = [0.0, -a3 * h, -a4 * h, h / f64::from(inductance), 0.0];
        let mut term = [[0.0; 5]; 5];
        (0..5).for_each(|row| term[row][row] = 1.0);
        let mut sum = term;
        for order in 1..30 {
            let last = term;
            for (row, values) in term.iter_mut().enumerate() {
                for (column, value) in values.iter_mut().enumerate() {
                    *value = (0..5).map(|k| last[row][k] * rate[k][column]).sum::<f64>()
                        / f64::from(order);
                    sum[row][column] += *value;
                }
            }
        }
        sum
    }
}

#[cfg(test)]
mod tests {
    use super::rig::*;
    use super::*;
    use crate::control::ControlConfig;
    use crate::motor::MotorParameters;
    use proptest::prelude::*;

    const MOTOR: MotorParameters = MotorParameters::PAPER;
    const PLL: SpeedSource = SpeedSource::Pll { bandwidth: 4000.0, fed: false };
    const FED: SpeedSource = SpeedSource::Pll { bandwidth: 4000.0, fed: true };
    const DIFFERENCE: SpeedSource = SpeedSource::Difference { bandwidth: 3000.0 };

    fn book(speed: SpeedSource) -> PiConfig {
        PiConfig::magnitude_and_symmetrical_optimum(&TIMING, speed)
    }

    /// Slower than by the book, and critically damped.
    fn calm(disturbance: Option<f32>) -> PiConfig {
        let exact = book(SpeedSource::Exact);
        PiConfig { speed_bandwidth: 400.0, speed_damping: 1.0, disturbance, ..exact }
    }

    fn rig(config: PiConfig) -> Rig {
        let mut rig = Rig::new(&ControlConfig::Pi(config), MOTOR);
        rig.start();
        rig
    }

    #[test]
    fn the_book_at_20_khz() {
        let PiConfig { current_bandwidth, speed_bandwidth, speed_damping, .. } = book(PLL);
        // 1/(2·75 µs); 1/(2^1.5·(150 µs + 2/4000 s)).
        assert!((current_bandwidth - 6666.667).abs() < 0.01, "{current_bandwidth}");
        assert!((speed_bandwidth - 543.928).abs() < 0.01, "{speed_bandwidth}");
        assert!((speed_damping * speed_damping - 0.5).abs() < 1e-6, "{speed_damping}");
    }

    #[test]
    fn the_current_loop_has_the_magnitude_optimums_step_response() {
        let known = MOTOR.coefficients().expect("valid");
        let setting = Setting {
            motor: &known,
            timing: &TIMING,
            shaft: &SHAFT,
            ranges: &RANGES,
            bases: &Bases::NONE,
        };
        let bandwidth = magnitude_optimum(&TIMING);
        let mut current = CurrentLoop::<f32>::new("current", bandwidth, &setting).expect("valid");
        // An armature that does not turn, one period late, by its difference equation.
        let keep = (-f64::from(known.a4) / f64::from(TIMING.rate)).exp();
        let (mut i, mut late) = (0.0_f64, 0.0_f32);
        let mut responses = [0.0; 40];
        for response in &mut responses {
            *response = i;
            let acting = late;
            late = current.step(1.0, i as f32, 0.0, acting);
            i = keep * i + (1.0 - keep) / 0.7 * f64::from(acting);
        }
        // What wc·h/(z·(z − 1)) with wc·h = 1/3 makes of a step, by hand.
        let exact = [0.0, 0.0, 1.0 / 3.0, 2.0 / 3.0, 8.0 / 9.0, 1.0];
        for (response, exact) in responses.iter().zip(exact) {
            assert!((response - exact).abs() < 1e-5, "{response} is not {exact}");
        }
        let peak = responses.iter().copied().fold(0.0, f64::max);
        assert_within("overshoot of 4 %", peak, [1.030, 1.045]);
        assert_within("the end", responses[39], [0.999_99, 1.000_01]);
    }

    #[test]
    fn settles_on_steps_and_recovers_from_loads_without_error() {
        // (configuration, peak of a step of 1 rad/s, dip after 0.05 N·m (rad/s))
        let cases = [
            (book(SpeedSource::Exact), [1.48, 1.53], [0.17, 0.20]),
            (book(PLL), [1.46, 1.51], [0.72, 0.78]),
            (book(FED), [1.36, 1.42], [0.79, 0.86]),
            (book(DIFFERENCE), [1.45, 1.50], [0.55, 0.60]),
            (calm(None), [1.13, 1.17], [0.58, 0.63]),
            (calm(Some(600.0)), [1.13, 1.17], [0.35, 0.39]),
            (PiConfig { disturbance: Some(600.0), ..book(FED) }, [1.20, 1.27], [0.55, 0.61]),
        ];
        for (config, peak, dip) in cases {
            let mut rig = rig(config);
            assert_within("peak", rig.run(1.0, 2000, 0)[1], peak);
            rig.run(100.0, 4000, 0);
            let rest = rig.run(100.0, 1000, 0);
            assert_within("rest", rest[1] - rest[0], [0.0, 5e-4]);
            assert_within("settled", rig.speed(), [99.9998, 100.0002]);
            rig.set_load(0.05);
            assert_within("dip", 100.0 - rig.run(100.0, 4000, 0)[0], dip);
            assert_within("settled loaded", rig.speed(), [99.9998, 100.0002]);
            let disturbance = f64::from(rig.controller.signals().disturbance);
            // −T_l/J = −628.93.
            let expected = if config.disturbance.is_some() { [-629.1, -628.8] } else { [0.0, 0.0] };
            assert_within("disturbance", disturbance, expected);
        }
    }

    #[test]
    fn the_current_command_is_kept_at_a_large_step() {
        for config in [book(SpeedSource::Exact), book(FED), calm(Some(600.0))] {
            let mut rig = rig(config);
            let (mut most, mut speed) = (0.0_f64, 0.0_f64);
            for _ in 0..2000 {
                rig.period(&Reference::constant(100.0));
                most = most.max(rig.current());
                speed = speed.max(rig.speed());
            }
            // 15 A and the current loop's overshoot of 4 %.
            assert_within("current", most, [15.0, 15.65]);
            assert_within("overshoot", speed - 100.0, [0.5, 5.5]);
            assert_within("settled", rig.speed(), [99.999, 100.001]);
        }
    }

    #[test]
    fn follows_a_ramp_without_error() {
        for (source, error) in [(SpeedSource::Exact, 0.05), (FED, 0.3)] {
            let mut rig = rig(book(source));
            let acceleration = 5000.0;
            let mut late = 0.0_f64;
            for period in 0..600 {
                let speed = acceleration * period as f32 / TIMING.rate;
                let before = rig.speed();
                rig.period(&Reference { speed, acceleration, jerk: 0.0 });
                late = f64::from(speed) - before;
            }
            assert!(late.abs() < error, "{source:?}: {late}");
        }
    }

    #[test]
    fn nothing_winds_up_at_the_voltage_limit() {
        for (config, overshoot) in [
            (book(SpeedSource::Exact), [0.5, 1.5]),
            (book(PLL), [3.0, 5.0]),
            (calm(None), [1.0, 2.5]),
            (calm(Some(600.0)), [1.0, 2.5]),
        ] {
            let mut rig = rig(config);
            rig.run(100.0, 4000, 0);
            let usual = rig.run(50.0, 4000, 0);
            assert_within("undershoot", 50.0 - usual[0], overshoot);
            // 0.2 s and 2 s at 4 V, which are worth 67.8 rad/s.
            for periods in [4_000, 40_000] {
                rig.bus = 4.0;
                let held = rig.run(100.0, periods, 3500);
                assert_within("held", held[0], [67.79, 67.81]);
                assert_within("held", held[1], [67.79, 67.81]);
                rig.bus = 22.0;
                let free = rig.run(100.0, 4000, 0);
                assert_within("overshoot", free[1] - 100.0, overshoot);
                assert_within("settled", rig.speed(), [99.999, 100.001]);
            }
        }
    }

    #[test]
    fn starts_on_a_turning_motor_without_a_bump() {
        for config in [book(SpeedSource::Exact), book(PLL), book(FED), calm(Some(600.0))] {
            for speed in [-200.0, 100.0] {
                assert_starts_turning_without_a_bump(&ControlConfig::Pi(config), speed);
            }
        }
    }

    #[test]
    fn all_that_is_accepted_is_stable() {
        for current_bandwidth in [500.0, 2000.0, 9999.0] {
            for speed in [
                SpeedSource::Exact,
                SpeedSource::Difference { bandwidth: 1000.0 },
                SpeedSource::Pll { bandwidth: 1000.0, fed: false },
                SpeedSource::Pll { bandwidth: 1000.0, fed: true },
                SpeedSource::Pll { bandwidth: 20_000.0, fed: true },
            ] {
                for speed_damping in [0.5, 0.8, 5.0] {
                    for share in [None, Some(0.1), Some(0.999)] {
                        let period = TIMING.period();
                        let estimate = lag(&speed, period, 0.0);
                        let largest = (0.599 / estimate).min(0.499 / period);
                        let config = PiConfig {
                            current_bandwidth,
                            speed_bandwidth: 0.999 * f32::min(0.5, 0.4 / speed_damping)
                                / (1.0 / current_bandwidth + estimate),
                            speed_damping,
                            disturbance: share.map(|share| share * largest),
                            speed,
                        };
                        let slowest = config.speed_bandwidth / (2.0 * speed_damping);
                        let periods = (16.0 / (slowest * period)) as usize;
                        let mut rig = rig(config);
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
        let book = book(PLL);
        let cases = [
            (PiConfig { current_bandwidth: 0.0, ..book }, "control.current_bandwidth"),
            (PiConfig { current_bandwidth: 10_100.0, ..book }, "control.current_bandwidth"),
            (PiConfig { current_bandwidth: f32::NAN, ..book }, "control.current_bandwidth"),
            (PiConfig { speed_bandwidth: -1.0, ..book }, "control.speed_bandwidth"),
            (PiConfig { speed_bandwidth: 900.0, ..book }, "control.speed_bandwidth"),
            (PiConfig { current_bandwidth: 500.0, ..book }, "control.speed_bandwidth"),
            (PiConfig { speed_damping: 0.4, ..book }, "control.speed_damping"),
            (PiConfig { speed_damping: f32::INFINITY, ..book }, "control.speed_damping"),
            (PiConfig { disturbance: Some(0.0), ..book }, "control.disturbance"),
            (PiConfig { disturbance: Some(1300.0), ..book }, "control.disturbance"),
            (
                PiConfig { speed: SpeedSource::Pll { bandwidth: f32::NAN, fed: false }, ..book },
                "control.speed.bandwidth",
            ),
        ];
        for (config, field) in cases {
            assert_eq!(refused(&ControlConfig::Pi(config)), Some(field), "{config:?}");
        }
        assert_eq!(refused(&ControlConfig::Pi(book)), None);
        assert_eq!(refused(&ControlConfig::Pi(calm(Some(9_999.0)))), None);
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(32))]

        /// Samples and voltages that no motor gives, and a motor after them.
        #[test]
        fn stays_finite_and_recovers(
            samples in prop::collection::vec(prop::array::uniform4(-1.0..1.0_f32), 1..300),
            observer in any::<bool>(),
        ) {
            let mut rig = rig(calm(observer.then_some(600.0)));
            samples.into_iter().for_each(|sample| rig.mislead(sample));
            rig.run(100.0, 8000, 0);
            assert_within("recovered", rig.speed(), [99.999, 100.001]);
        }
    }
}
