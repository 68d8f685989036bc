//! The drive form of BS-QSMDO and BS-QISMC: the same backstepping and the same quasi-sliding injections, for what a drive has.
//!
//! A drive has an encoder instead of a speed, a voltage that acts a period late, limits, and parameters that are wrong by
//! a tenth. The paper's form asks more of such sensors than they give. Here
//!
//! - the angle observer and the disturbance observer are one third-order observer on (θ, ω, d), whose poles are placed together, and
//!   which compares the counts that it reads with the counts that it expects, both rounded down;
//! - what is controlled is the state one period ahead, when the voltage that is computed now begins to act;
//! - the poles of z1 and z2 are free, and z2 is closed on the current itself;
//! - the wanted current is limited, and both observers see the voltage and the current that there really were, so that
//!   nothing winds up; nothing else integrates.
//!
//! ```text
//! ā = a2·(i + i₋)/2 − a1·ω̂ + d̂       angle observer on ā; its correction of ω̂ is Δω
//! σ1 += Δω                           d̂ = k1·tanh(σ1/ε1)        since (ω̂ − x̂1) moves by the corrections alone: both carry d̂
//! σ2 += i − î                        v̂ = V·tanh(σ2/ε2)         what the armature's model lacks (V)
//! î⁺ = Ad·i + Bd·(u − Kb·ω̂ + v̂)      ω⁺ = ω̂ + h·(a2·(i + î⁺)/2 − a1·ω̂ + d̂)
//! n  = (ω̇_d − d̂ + a1·ω⁺)/a2          i* = limited(n − (c/a2)·(ω⁺ − ω_d))            the virtual control, at t + h
//! t  = (1 − e^(−wi·h))·(i* − î⁺) [+ h·c·(n − î⁺) + (h/a2)·ω̈_d where i* is not limited]  what the current is to change by
//! w  = t/Bd + Ra·î⁺ + Kb·ω⁺ − v̂    u⁺ = u + (1 − e^(−wf·h))·(w − u)
//! ```
//!
//! with Ad = e^(−h·Ra/La), Bd = (1 − Ad)/Ra, and u the voltage that acts from the sample on. BS-QISMC remembers z1 in place of
//! ω̂: a jump of the reference enters its σ1; with a smooth one the two are the same.

use super::injection::Injections;
use super::{Setting, Signals, Timing};
use crate::config::{ConfigError, positive, require};
use crate::estimate::AngleObserver;
use crate::math::{Base, Scalar, atanh, exp_m1, sqrt};
use crate::motor::{Coefficients, MotorParameters};
use crate::per_unit::{ACCELERATION, Bases, JERK};
use crate::schema::{choice, group};
use crate::sense::{Calibration, Measured, Rotation};
use crate::trajectory::Reference;

/// What σ1 remembers.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Memory {
    /// ω̂ (BS-QSMDO).
    #[default]
    Observer,
    /// z1 (BS-QISMC). For shaped references: a jump throws d̂ to the end of its authority, and the speed overshoots until that is
    /// unlearnt.
    Integral,
}

choice! { Memory { Observer, Integral } }

/// What the drive form is built from. [`DriveFormConfig::new`] derives all from one bandwidth; experts may set each.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct DriveFormConfig {
    /// What σ1 remembers.
    pub memory: Memory,
    /// Bandwidth wo of the observer of angle, speed and disturbance (rad/s). Positive, at most 0.13 of the sampling rate.
    pub observer_bandwidth: f32,
    /// Convergence rate c of z1 (1/s). Positive, at most 0.7·wo: faster, a wrong inertia and resistance make it unstable.
    pub speed_bandwidth: f32,
    /// Convergence rate wi of the current (1/s). Positive.
    pub current_bandwidth: f32,
    /// Bandwidth L2 of the observer of the armature's unmodelled voltage (1/s). Positive.
    pub voltage_bandwidth: f32,
    /// Bandwidth wf of the filter ahead of the bridge (1/s). Positive.
    pub output_bandwidth: f32,
    /// Largest load torque that can be held, k1·J (N·m). Positive; 1.5 to 2 times the largest load that is expected.
    pub load_torque: f32,
    /// Largest voltage that the armature's model may lack (V): |ΔKb|·ω + |ΔRa|·i, brush drop and dead time. Positive.
    pub voltage_reserve: f32,
}

group! {
    DriveFormConfig {
        memory, observer_bandwidth, speed_bandwidth, current_bandwidth, voltage_bandwidth, output_bandwidth,
        load_torque, voltage_reserve,
    }
}

impl DriveFormConfig {
    /// All from the observer's bandwidth (rad/s), with the ratios that a search found best. With them the paper's motor stays
    /// stable in every combination of J ×0.5–3, Ra ×0.7–1.5 and Kb ×0.85–1.15 of what the model has (a test). Not beyond: in the
    /// corner of J ×0.5, Ra ×0.7, Kb ×1.15 an inductance that is wrong by a half as well makes it oscillate.
    ///
    /// After a load step ΔT the speed dips by about 1.9·ΔT/(J·wo) and is back within 10 % of that after 9.5/wo.
    pub fn new(bandwidth: f32, load_torque: f32, voltage_reserve: f32) -> Self {
        Self {
            memory: Memory::Observer,
            observer_bandwidth: bandwidth,
            speed_bandwidth: 0.6 * bandwidth,
            current_bandwidth: 4.0 * bandwidth,
            voltage_bandwidth: 0.7 * bandwidth,
            output_bandwidth: 6.0 * bandwidth,
            load_torque,
            voltage_reserve,
        }
    }

    /// From motor and sensors alone: the bandwidth for a voltage ripple of a thousandth of `bus_voltage` (V), authority over
    /// the torque at the current `current` (A), and a tenth of the bus voltage in reserve.
    pub fn default_for(
        motor: &MotorParameters,
        timing: &Timing,
        calibration: &Calibration,
        bus_voltage: f32,
        current: f32,
    ) -> Self {
        let bandwidth = bandwidth_for_ripple(motor, timing, calibration, 1e-3 * bus_voltage);
        Self::new(bandwidth, motor.back_emf_constant * current, 0.1 * bus_voltage)
    }

    /// The same for BS-QISMC.
    pub fn with_memory(self, memory: Memory) -> Self {
        Self { memory, ..self }
    }
}

/// The observer's bandwidth (rad/s) at which the encoder's counts make a voltage ripple of about `ripple` (V rms), where all of a
/// period's reads count; within 0.03 and 0.1 of the sampling rate.
///
/// Ripple ≈ 0.2·(J·h/(Kb·Bd))·q·wo³·(wo·h), about the mean at a constant speed: fitted to simulations of six motors of 10 W to 250 W
/// at 10 to 40 kHz, to within a third or so (`tests/drive.rs` has the paper's). An encoder whose edges are misplaced by a
/// twentieth of a count makes three to four times that.
pub fn bandwidth_for_ripple(
    motor: &MotorParameters,
    timing: &Timing,
    calibration: &Calibration,
    ripple: f32,
) -> f32 {
    let h = timing.period();
    let held = -exp_m1(-h * motor.resistance / motor.inductance) / motor.resistance;
    let count = calibration.count().abs();
    let fourth = ripple * motor.back_emf_constant * held / (0.2 * motor.inertia * h * h * count);
    // Not `clamp`: the message of its panic is 18 kB of code.
    sqrt(sqrt(fourth)).max(0.03 / h).min(0.1 / h)
}

/// The drive form of a speed controller.
#[derive(Clone, Debug)]
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub(crate) struct DriveForm<S: Scalar> {
    last: Signals<S>,
    observer: AngleObserver<S>,
    /// Whether there are 16 reads of a counter to observe.
    counts: bool,
    /// d̂ (rad/s²).
    disturbance: S,
    /// σ1 (rad/s).
    speed_mismatch: S,
    /// σ2 (A).
    current_mismatch: S,
    /// The current at the last sample (A).
    current: S,
    /// The current predicted for the next one (A).
    predicted_current: S,
    /// The reference speed predicted for the next sample (rad/s).
    predicted_reference: S,
    /// Steps in a row that load or voltage were beyond authority.
    exhausted: u32,
    /// Speed before them (rad/s).
    speed_before: S,
    /// The disturbance that is beyond authority (rad/s²).
    overload: S,
    /// What σ1 remembers.
    memory: Memory,
    /// a2/2·i − a1·ω.
    modelled: S::Gains<2>,
    period: S::Time,
    half_period: S::Time,
    speed_limit: S,
    k1: S::Gains<1>,
    current_limit: S,
    reserve: S::Gains<1>,
    keep: S::Steep<1>,
    held: S::Steep<1>,
    back_emf: S::Gains<1>,
    per_a2: S::Steep<1>,
    a1_per_a2: S::Gains<1>,
    c_per_a2: S::Steep<1>,
    command_limit: S,
    closing: S::Steep<1>,
    c_period: S::Gains<1>,
    period_per_a2: S::Steep<1>,
    per_held: S::Steep<1>,
    /// Ra·i + Kb·ω.
    holding: S::Gains<2>,
    output_share: S::Steep<1>,
    a2: S::Gains<1>,
    resumption: Resumption,
}

/// What a change of controllers needs.
#[derive(Clone, Copy, Debug)]
struct Resumption {
    /// k1 (rad/s²).
    strength: f32,
    /// ε1 (rad/s).
    layer: f32,
    /// V (V).
    reserve: f32,
    /// ε2 (A).
    reserve_layer: f32,
    /// Of speed, acceleration, current and voltage.
    bases: [Base; 4],
}

/// The mismatch at which an injection counts as exhausted, in boundary layers: tanh is 0.995 there.
const EXHAUSTED: f32 = 3.0;

impl<S: Scalar> DriveForm<S> {
    /// Builds the controller and tabulates its injections.
    pub fn new(
        config: &DriveFormConfig,
        setting: &Setting,
        injections: &mut Injections<S>,
    ) -> Result<Self, ConfigError> {
        let &Setting { motor, timing, shaft, ranges, bases } = setting;
        let age = shaft.age;
        let &Coefficients { a1, a2, a3, a4, inductance, inertia } = motor;
        let &DriveFormConfig {
            memory,
            observer_bandwidth: wo,
            speed_bandwidth: c,
            current_bandwidth: wi,
            voltage_bandwidth: l2,
            output_bandwidth: wf,
            load_torque,
            voltage_reserve,
        } = config;
        let h = timing.period();
        let rate = timing.rate;
        require(timing.delay, "timing.delay", "must be there for the drive form", 0.0)?;
        for (field, bandwidth, share, rule) in [
            ("control.observer_bandwidth", wo, 0.13, "must be at most 0.13 of the sampling rate"),
            ("control.speed_bandwidth", c, 0.091, "must be at most 0.091 of the sampling rate"),
            ("control.current_bandwidth", wi, 1.0, "must be at most the sampling rate"),
            ("control.voltage_bandwidth", l2, 0.2, "must be at most a fifth of the sampling rate"),
            ("control.output_bandwidth", wf, 10.0, "must be at most 10 times the sampling rate"),
        ] {
            positive(field, bandwidth)?;
            require(bandwidth <= share * rate * (1.0 + f32::EPSILON), field, rule, bandwidth)?;
        }
        require(
            c <= 0.7 * wo * (1.0 + f32::EPSILON),
            "control.speed_bandwidth",
            "must be at most 0.7 of control.observer_bandwidth",
            c,
        )?;
        positive("control.load_torque", load_torque)?;
        positive("control.voltage_reserve", voltage_reserve)?;

        let [g1, g2, g3] = observer_gains(wo, h);
        let observer = AngleObserver::new([g1, g2], g3, shaft, bases)?;
        let k1 = load_torque / inertia;
        // Where the injection is steepest it is the linear observer's: k1/ε1 = g3/g2, with the gains for the reads' age.
        let epsilon1 = k1 * (g2 + age * g3) / g3;
        let resistance = a4 * inductance;
        let back_emf = a3 * inductance;
        let keep = 1.0 + exp_m1(-a4 * h);
        let held = -exp_m1(-a4 * h) / resistance;
        let epsilon2 = voltage_reserve * held / -exp_m1(-l2 * h);
        let &Bases { speed: w, acceleration: a, jerk: j, current: i, voltage: v, .. } = bases;
        let largest = a2 * ranges.current + a1 * ranges.speed + k1;
        require(
            largest <= 1e9,
            "control.load_torque",
            "must keep accelerations below 1e9 rad/s²",
            load_torque,
        )?;
        let [torque, reserve] = ["control.load_torque", "control.voltage_reserve"];
        injections.first.tabulate(torque, 0.0, epsilon1, w)?;
        injections.second.tabulate(reserve, 0.0, epsilon2, i)?;
        Ok(Self {
            last: Signals::NONE,
            observer,
            counts: shaft.counts,
            disturbance: S::ZERO,
            speed_mismatch: S::ZERO,
            current_mismatch: S::ZERO,
            current: S::ZERO,
            predicted_current: S::ZERO,
            predicted_reference: S::ZERO,
            exhausted: 0,
            speed_before: S::ZERO,
            overload: S::constant(torque, (0.99 * k1).min(0.95 * a2 * ranges.current_command), a)?,
            memory,
            modelled: S::gains("motor", [(0.5 * a2, i), (-a1, w)], a)?,
            period: S::time(h),
            half_period: S::time(0.5 * h),
            speed_limit: S::constant(torque, EXHAUSTED * epsilon1, w)?,
            k1: S::gains(torque, [(k1, Base::RATIO)], a)?,
            current_limit: S::constant(reserve, EXHAUSTED * epsilon2, i)?,
            reserve: S::gains(reserve, [(voltage_reserve, Base::RATIO)], v)?,
            keep: S::steep("motor", [(keep, i)], i)?,
            held: S::steep("motor", [(held, v)], i)?,
            back_emf: S::gains("motor", [(back_emf, w)], v)?,
            per_a2: S::steep("motor", [(1.0 / a2, a)], i)?,
            a1_per_a2: S::gains("motor.viscous_friction", [(a1 / a2, w)], i)?,
            c_per_a2: S::steep("control.speed_bandwidth", [(c / a2, w)], i)?,
            command_limit: S::from_f32(ranges.current_command, i),
            closing: S::steep("control.current_bandwidth", [(-exp_m1(-wi * h), i)], i)?,
            c_period: S::gains("control.speed_bandwidth", [(c * h, i)], i)?,
            period_per_a2: S::steep("motor", [(h / a2, j)], i)?,
            per_held: S::steep("motor", [(1.0 / held, i)], v)?,
            holding: S::gains("motor", [(resistance, i), (back_emf, w)], v)?,
            output_share: S::steep("control.output_bandwidth", [(-exp_m1(-wf * h), v)], v)?,
            a2: S::gains("motor", [(a2, i)], a)?,
            resumption: Resumption {
                strength: k1,
                layer: epsilon1,
                reserve: voltage_reserve,
                reserve_layer: epsilon2,
                bases: [w, a, i, v],
            },
        })
    }

    /// Runs the observer of angle, speed and disturbance.
    #[inline(always)]
    fn observe(&mut self, injections: &Injections<S>, rotation: &Rotation<S>, current: S, jump: S) {
        let both = self.current + current;
        let acceleration =
            S::combine(&self.modelled, [both, self.observer.speed]) + self.disturbance;
        let innovation = if self.counts {
            self.observer.innovation_of_counts(rotation, acceleration)
        } else {
            self.observer.innovation(rotation, acceleration)
        };
        let correction = self.observer.correct(innovation);
        let mismatch = self.speed_mismatch + correction;
        let mismatch = match self.memory {
            Memory::Observer => mismatch,
            Memory::Integral => mismatch - jump,
        };
        self.speed_mismatch = mismatch.limited(self.speed_limit);
        let injection = injections.first.value(self.speed_mismatch);
        self.disturbance = S::combine(&self.k1, [injection]);
        self.current = current;
    }

    /// With the bridge off the observer goes on, so that a start finds speed and load known.
    pub fn follow(&mut self, injections: &Injections<S>, measured: &Measured<S>) -> S {
        self.observe(injections, &measured.rotation, measured.current, S::ZERO);
        self.exhausted = 0;
        self.observer.speed
    }

    pub fn start(&mut self, measured: &Measured<S>, reference: &Reference<S>) {
        self.current_mismatch = S::ZERO;
        self.current = measured.current;
        self.predicted_current = measured.current;
        self.predicted_reference = reference.speed;
        self.speed_before = self.observer.speed;
        self.exhausted = 0;
    }

    pub fn know(&mut self, speed: S) {
        self.observer.resume(speed);
    }

    /// Takes over: the current that it finds is what holds the speed, and the voltage that acts is the right one.
    pub fn resume(
        &mut self,
        injections: &Injections<S>,
        measured: &Measured<S>,
        reference: &Reference<S>,
        acting: S,
    ) {
        let (speed, current) = (self.observer.speed, measured.current);
        self.start(measured, reference);
        let modelled = S::combine(&self.modelled, [current + current, speed]);
        let Resumption { strength, layer, reserve, reserve_layer, bases } = self.resumption;
        let [w, a, i, v] = bases;
        // The mismatch at which the injection is this share.
        let held = |share: f32, layer: f32| layer * atanh(share.clamp(-0.99, 0.99));
        let share = (reference.acceleration - modelled).to_f32(a) / strength;
        self.speed_mismatch = S::from_f32(held(share, layer), w);
        let injection = injections.first.value(self.speed_mismatch);
        self.disturbance = S::combine(&self.k1, [injection]);
        let needed = S::combine(&self.holding, [current, speed]);
        let share = (needed - acting).to_f32(v) / reserve;
        self.current_mismatch = S::from_f32(held(share, reserve_layer), i);
    }

    // Not inlined where its instructions are counted apart from its caller's.
    #[cfg_attr(feature = "qemu", inline(never))]
    pub fn step(
        &mut self,
        injections: &Injections<S>,
        rotation: &Rotation<S>,
        current: S,
        reference: &Reference<S>,
        acting: S,
    ) -> S {
        self.observe(injections, rotation, current, reference.speed - self.predicted_reference);
        let speed = self.observer.speed;
        let disturbance = self.disturbance;

        // What the armature's model lacks.
        let mismatch = self.current_mismatch + (current - self.predicted_current);
        self.current_mismatch = mismatch.limited(self.current_limit);
        let lacking = S::combine(&self.reserve, [injections.second.value(self.current_mismatch)]);

        // The state at the next sample.
        let inner = acting - S::combine(&self.back_emf, [speed]) + lacking;
        let current_ahead = S::amplify(&self.keep, [current]) + S::amplify(&self.held, [inner]);
        let acceleration =
            S::combine(&self.modelled, [current + current_ahead, speed]) + disturbance;
        let speed_ahead = speed + acceleration.over::<ACCELERATION>(self.period);
        let acceleration_ahead = reference.acceleration + reference.jerk.over::<JERK>(self.period);
        let both = reference.acceleration + acceleration_ahead;
        let reference_ahead = reference.speed + both.over::<{ ACCELERATION + 1 }>(self.half_period);

        // The virtual control and the current that it wants a period later.
        let needed = S::amplify(&self.per_a2, [acceleration_ahead - disturbance])
            + S::combine(&self.a1_per_a2, [speed_ahead]);
        let wanted = needed - S::amplify(&self.c_per_a2, [speed_ahead - reference_ahead]);
        let command = wanted.limited(self.command_limit);
        let moving = S::amplify(&self.period_per_a2, [reference.jerk])
            + S::combine(&self.c_period, [needed - current_ahead]);
        let change = S::amplify(&self.closing, [command - current_ahead])
            + if command == wanted { moving } else { S::ZERO };
        let voltage = S::amplify(&self.per_held, [change])
            + S::combine(&self.holding, [current_ahead, speed_ahead])
            - lacking;
        let voltage = acting + S::amplify(&self.output_share, [voltage - acting]);

        // Beyond authority: more load than can be held, or a voltage that the reserve does not cover while less than half
        // of the wanted current flows. (A resistance half off takes the reserve in a jump too, but not half the current.)
        let missing = (current_ahead - command).abs();
        let overloaded = disturbance.abs() >= self.overload;
        let starved =
            self.current_mismatch.abs() >= self.current_limit && missing + missing > command.abs();
        if overloaded || starved {
            self.exhausted = self.exhausted.wrapping_add(1);
        } else {
            self.exhausted = 0;
            self.speed_before = speed;
        }

        self.predicted_current = current_ahead;
        self.predicted_reference = reference_ahead;
        self.last = Signals {
            speed,
            z1: speed - reference.speed,
            z2: S::combine(&self.a2, [current_ahead - command]),
            disturbance,
            voltage,
        };
        voltage
    }

    pub fn signals(&self) -> &Signals<S> {
        &self.last
    }

    pub fn sliding_variables(&self) -> [S; 2] {
        [self.speed_mismatch, self.current_mismatch]
    }

    /// How many steps in a row load or voltage have been beyond authority.
    pub fn exhausted(&self) -> u32 {
        self.exhausted
    }

    /// Whether the speed came nowhere near its reference while load or voltage were beyond authority: neither a tenth of
    /// what is left, nor twice what is left in whatever direction. If it did, counting starts anew: to accelerate more
    /// inertia than the model has is no fault.
    #[cold]
    pub fn stuck(&mut self) -> bool {
        let Signals { speed, z1, .. } = self.last;
        let moved = speed - self.speed_before;
        let nearer = if z1 < S::ZERO { moved } else { -moved };
        let left = z1.abs();
        let [nearer_by, left_by] = [nearer, left].map(|signal| signal.to_f32(Base::RATIO));
        let stuck = nearer_by <= 0.1 * left_by && moved.abs() <= left + left;
        self.exhausted = 0;
        self.speed_before = speed;
        stuck
    }
}

/// Gains of angle (1), speed (1/s) and acceleration (1/s²) that place the observer's poles at those of
/// s³ + 2.7·wo·s² + 2.7·wo²·s + wo³, taken to z = e^(s·h), for reads of no age.
fn observer_gains(wo: f32, h: f32) -> [f32; 3] {
    // Roots −wo and (−0.85 ± 0.526783i)·wo; each difference from 1 as itself, since they are small.
    let x = wo * h;
    let real = -exp_m1(-x);
    let pair = -exp_m1(-0.85 * x);
    // The sine of half their angle, which is below 0.035: its next term is below 1e-9.
    let half_angle = 0.5 * 0.526_783 * x;
    let sine = half_angle * (1.0 - half_angle * half_angle / 6.0);
    // m·(1 − cos φ)
    let turned = (1.0 - pair) * 2.0 * sine * sine;
    let g1 = -exp_m1(-2.7 * x);
    let g3 = real * (pair * pair + 2.0 * turned) / (h * h);
    let g2 = (real + 2.0 * pair + 2.0 * turned - g1 - 0.5 * h * h * g3) / h;
    [g1, g2, g3]
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::Ranges;
    use crate::sense::Shaft;

    #[test]
    fn gains_place_the_observers_poles() {
        // The observer's matrix, corrected by its own prediction of the angle, must have the characteristic polynomial.
        for (wo, h, age) in
            [(1170.0_f64, 5e-5_f64, 0.0), (500.0, 1e-4, 0.0), (2000.0, 5e-5, 2.3e-5)]
        {
            let [g1, g2, g3] = observer_gains(wo as f32, h as f32).map(f64::from);
            let gains = [g1 + age * (g2 + 0.5 * age * g3), g2 + age * g3, g3];
            let model = [[1.0, h, 0.5 * h * h], [0.0, 1.0, h], [0.0, 0.0, 1.0]];
            let seen = [1.0, -age, 0.5 * age * age];
            // (I − G·C)·F
            let closed: [[f64; 3]; 3] = core::array::from_fn(|row| {
                core::array::from_fn(|column| {
                    let passed: f64 = (0..3).map(|k| seen[k] * model[k][column]).sum();
                    model[row][column] - gains[row] * passed
                })
            });
            let determinant = |z: f64| {
                let m = |row: usize, column: usize| {
                    closed[row][column] - if row == column { z } else { 0.0 }
                };
                m(0, 0) * (m(1, 1) * m(2, 2) - m(1, 2) * m(2, 1))
                    - m(0, 1) * (m(1, 0) * m(2, 2) - m(1, 2) * m(2, 0))
                    + m(0, 2) * (m(1, 0) * m(2, 1) - m(1, 1) * m(2, 0))
            };
            let (radius, angle) = ((-0.85 * wo * h).exp(), 0.526783 * wo * h);
            for z in [0.3, 0.8, 0.95, 1.0] {
                let wanted = ((-wo * h).exp() - z)
                    * (radius * radius - 2.0 * radius * angle.cos() * z + z * z);
                let error = (determinant(z) - wanted).abs();
                assert!(error < 1e-6, "wo {wo}, z {z}: {} is not {wanted}", determinant(z));
            }
        }
    }

    const TIMING: Timing = Timing { rate: 20_000.0, delay: true };
    const GOOD: DriveFormConfig = DriveFormConfig {
        memory: Memory::Observer,
        observer_bandwidth: 1170.0,
        speed_bandwidth: 702.0,
        current_bandwidth: 4680.0,
        voltage_bandwidth: 819.0,
        output_bandwidth: 7020.0,
        load_torque: 0.3,
        voltage_reserve: 2.5,
    };

    fn built(
        config: &DriveFormConfig,
        timing: Timing,
    ) -> Result<(DriveForm<f32>, Injections<f32>), ConfigError> {
        let motor = MotorParameters::PAPER.coefficients().expect("valid");
        let ranges = &Ranges { speed: 1000.0, current: 25.0, current_command: 20.0 };
        // In rad, as from exact sensors.
        let shaft = &Shaft {
            period: timing.period(),
            least_age: 0.0,
            age: 0.0,
            unit: 1.0,
            counts: false,
            speed: true,
            grain: 0.0,
        };
        let setting =
            Setting { motor: &motor, timing: &timing, shaft, ranges, bases: &Bases::NONE };
        let mut injections = Injections::NONE;
        let form = DriveForm::new(config, &setting, &mut injections)?;
        Ok((form, injections))
    }

    fn turned(advance: f32) -> Rotation<f32> {
        Rotation { advance, behind: 0.0, shift: 0 }
    }

    fn measured(advance: f32, current: f32) -> Measured<f32> {
        Measured { rotation: turned(advance), speed: 0.0, current, bus_voltage: 24.0 }
    }

    #[test]
    fn one_bandwidth_gives_all() {
        let config = DriveFormConfig::new(1170.0, 0.3, 2.5);
        for (derived, expected) in [
            (config.observer_bandwidth, 1170.0),
            (config.speed_bandwidth, 702.0),
            (config.current_bandwidth, 4680.0),
            (config.voltage_bandwidth, 819.0),
            (config.output_bandwidth, 7020.0),
        ] {
            assert!((derived / expected - 1.0).abs() < 1e-6, "{derived} is not {expected}");
        }
        assert_eq!(config.memory, Memory::Observer);
        assert_eq!(config.with_memory(Memory::Integral).memory, Memory::Integral);
    }

    #[test]
    fn bandwidth_for_a_ripple_follows_the_fourth_root_and_its_limits() {
        let calibration = |counts_per_turn| Calibration {
            highest_code: 4095,
            current_per_code: 0.01,
            current_zero: 2048.0,
            bus_voltage_per_code: 0.0075,
            counts_per_turn,
            reads: crate::sense::Reads::All,
        };
        let of = |ripple: f32, counts: i32| {
            bandwidth_for_ripple(&MotorParameters::PAPER, &TIMING, &calibration(counts), ripple)
        };
        // 0.2·(J·h/(Kb·Bd))·q·wo⁴·h at 1170 rad/s: Bd = (1 − e^(−1/3))/0.7 A/V.
        let held = (1.0 - (-1.0_f64 / 3.0).exp()) / 0.7;
        let ripple = 0.2 * 7.95e-5 * 5e-5 / (59e-3 * held) * core::f64::consts::TAU / 4096.0
            * 1170_f64.powi(4)
            * 5e-5;
        assert!(
            (of(ripple as f32, 4096) / 1170.0 - 1.0).abs() < 1e-4,
            "{}",
            of(ripple as f32, 4096)
        );
        assert_eq!(of(ripple as f32, -4096), of(ripple as f32, 4096));
        let ratio = of(2.0 * ripple as f32, 4096) / of(ripple as f32, 4096);
        assert!((ratio - 2_f32.powf(0.25)).abs() < 1e-4, "{ratio}");
        assert!(
            (of(1e-9, 4096) / 600.0 - 1.0).abs() < 1e-5
                && (of(1e3, 4096) / 2000.0 - 1.0).abs() < 1e-5
        );
    }

    #[test]
    fn estimates_stay_within_their_authority_and_the_command_within_its_limit() {
        // Pulled about for long in every direction, beyond what any motor does.
        for memory in [Memory::Observer, Memory::Integral] {
            let (mut form, injections) = built(&GOOD.with_memory(memory), TIMING).expect("valid");
            let k1 = 0.3 / 7.95e-5;
            let (layer1, layer2) = (form.speed_limit, form.current_limit);
            let mut largest = [0.0_f32; 3];
            for step in 0..40_000_u32 {
                let phase = step / 5000;
                let (advance, current, acting) = match phase % 4 {
                    0 => (0.05, 25.0, -24.0),
                    1 => (-0.05, -25.0, 24.0),
                    2 => (0.05, -25.0, 24.0),
                    _ => (0.0, 25.0, 0.0),
                };
                let reference = Reference::constant(if phase % 2 == 0 { 1000.0 } else { -1000.0 });
                form.step(&injections, &turned(advance), current, &reference, acting);
                let signals = *form.signals();
                assert!(signals.disturbance.abs() <= k1 * 1.000_01, "{signals:?}");
                let [first, second] = form.sliding_variables();
                assert!(first.abs() <= layer1 && second.abs() <= layer2, "{first}, {second}");
                // z2 = a2·(î⁺ − i*), and î⁺ is bounded by what came in: i* is within ±20 A.
                let command = form.predicted_current - signals.z2 / form.a2[0];
                assert!(command.abs() <= 20.001, "{command}");
                let lacking = 2.5 * injections.second.value(second);
                largest[0] = largest[0].max(signals.disturbance.abs() / k1);
                largest[1] = largest[1].max(lacking.abs());
                largest[2] = largest[2].max(command.abs());
            }
            // They get there: tanh 3 is 0.995.
            assert!((0.99..1.001).contains(&largest[0]), "{largest:?}");
            assert!((2.47..2.501).contains(&largest[1]), "{largest:?}");
            assert!((19.99..20.01).contains(&largest[2]), "{largest:?}");
        }
    }

    #[test]
    fn steps_beyond_authority_are_counted_and_forgotten() {
        let (mut form, injections) = built(&GOOD, TIMING).expect("valid");
        let reference = Reference::constant(60.0);
        // 20 A and no motion.
        let stall = |form: &mut DriveForm<f32>| {
            form.step(&injections, &turned(0.0), 20.0, &reference, 14.0)
        };
        for _ in 0..200 {
            stall(&mut form);
        }
        let counted = form.exhausted();
        assert!((100..200).contains(&counted), "{counted}");
        stall(&mut form);
        assert_eq!(form.exhausted(), counted + 1);
        // No nearer to 60 rad/s than before.
        assert!(form.stuck());
        assert_eq!(form.exhausted(), 0);
        for _ in 0..10 {
            stall(&mut form);
        }
        assert_eq!(form.exhausted(), 10);
        // With the bridge off nothing is counted.
        form.follow(&injections, &measured(0.0, 0.0));
        assert_eq!(form.exhausted(), 0);
        // Nor where no current flows and nothing moves.
        for _ in 0..400 {
            form.follow(&injections, &measured(0.0, 0.0));
        }
        form.start(&measured(0.0, 0.0), &Reference::constant(0.0));
        for _ in 0..400 {
            form.step(&injections, &turned(0.0), 0.0, &Reference::constant(0.0), 0.0);
        }
        assert_eq!(form.exhausted(), 0);
    }

    #[test]
    fn a_start_forgets_what_the_armature_lacked() {
        let (mut form, injections) = built(&GOOD, TIMING).expect("valid");
        let reference = Reference::constant(0.0);
        // 10 V more than the model wants for no current.
        for _ in 0..100 {
            form.step(&injections, &turned(0.0), 0.0, &reference, 10.0);
        }
        assert!(form.sliding_variables()[1] < -1.0, "{:?}", form.sliding_variables());
        form.start(&measured(0.0, 0.0), &reference);
        form.step(&injections, &turned(0.0), 0.0, &reference, 0.0);
        assert_eq!(form.sliding_variables()[1], 0.0);
    }

    #[test]
    fn more_inertia_than_the_model_has_is_not_stuck() {
        // 20 A and a fifth of the model's acceleration: beyond authority for 30 ms, and 89 rad/s nearer.
        let (mut form, injections) = built(&GOOD, TIMING).expect("valid");
        let reference = Reference::constant(300.0);
        let acceleration = 0.2 * 742.14 * 20.0;
        for step in 0..600 {
            let advance = acceleration * (step as f32 + 0.5) * 5e-5 * 5e-5;
            form.step(&injections, &turned(advance), 20.0, &reference, 14.0);
        }
        assert!(form.exhausted() > 500, "{}", form.exhausted());
        assert!(!form.stuck());
    }

    #[test]
    fn refusals_name_the_field() {
        let nan = f32::NAN;
        let cases = [
            (DriveFormConfig { observer_bandwidth: 0.0, ..GOOD }, "control.observer_bandwidth"),
            (DriveFormConfig { observer_bandwidth: 2601.0, ..GOOD }, "control.observer_bandwidth"),
            (DriveFormConfig { observer_bandwidth: nan, ..GOOD }, "control.observer_bandwidth"),
            (DriveFormConfig { speed_bandwidth: -1.0, ..GOOD }, "control.speed_bandwidth"),
            (DriveFormConfig { speed_bandwidth: 820.0, ..GOOD }, "control.speed_bandwidth"),
            (
                DriveFormConfig { observer_bandwidth: 2600.0, speed_bandwidth: 1821.0, ..GOOD },
                "control.speed_bandwidth",
            ),
            (DriveFormConfig { current_bandwidth: 0.0, ..GOOD }, "control.current_bandwidth"),
            (DriveFormConfig { current_bandwidth: 20_001.0, ..GOOD }, "control.current_bandwidth"),
            (DriveFormConfig { voltage_bandwidth: nan, ..GOOD }, "control.voltage_bandwidth"),
            (DriveFormConfig { voltage_bandwidth: 4001.0, ..GOOD }, "control.voltage_bandwidth"),
            (DriveFormConfig { output_bandwidth: 0.0, ..GOOD }, "control.output_bandwidth"),
            (DriveFormConfig { output_bandwidth: 2.1e5, ..GOOD }, "control.output_bandwidth"),
            (DriveFormConfig { load_torque: 0.0, ..GOOD }, "control.load_torque"),
            (DriveFormConfig { load_torque: 1e6, ..GOOD }, "control.load_torque"),
            (DriveFormConfig { voltage_reserve: -2.5, ..GOOD }, "control.voltage_reserve"),
            (DriveFormConfig { voltage_reserve: nan, ..GOOD }, "control.voltage_reserve"),
        ];
        for (config, field) in cases {
            let error = built(&config, TIMING).expect_err(field);
            assert_eq!(error.field, field, "{config:?}");
        }
        let at_once = Timing { delay: false, ..TIMING };
        assert_eq!(built(&GOOD, at_once).expect_err("no delay").field, "timing.delay");
        // At the ends of the ranges all is well.
        let fastest = DriveFormConfig {
            observer_bandwidth: 2600.0,
            speed_bandwidth: 1820.0,
            current_bandwidth: 20_000.0,
            voltage_bandwidth: 4000.0,
            output_bandwidth: 2e5,
            ..GOOD
        };
        assert!(built(&fastest, TIMING).is_ok());
    }
}
