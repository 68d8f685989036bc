//! The motor as nature has it: the model of the paper's Eqs. (1), (2) with friction, integrated by RK4.
//!
//! ```text
//! J·ω̇  = Kb·i − b·ω − T_c(ω) − T_l
//! La·i̇ = u − Ra·i − Kb·ω
//! ```
//!
//! Coulomb friction is T_c(ω) = T_c·ω/√(ω² + ω_c²) with the creep speed ω_c = 0.1 rad/s: smooth, so that the integrator
//! keeps its order through standstill. A motor that Coulomb friction would hold creeps instead, below ω_c while the
//! load is under 0.7·T_c.

use serde::Deserialize;

/// Speed below which Coulomb friction fades out (rad/s).
const CREEP_SPEED: f64 = 0.1;

/// Largest share of the fastest time constant that one integration step may span. RK4 errs by its fifth power / 120:
/// 4e-5 of a transient per step.
const STEP_PER_TIME_CONSTANT: f64 = 0.35;

/// Most integration steps that a PWM period may take: beyond it a simulation would seem to hang.
pub const MOST_STEPS: usize = 1000;

/// Parameters of the simulated motor with what turns with it, in SI units.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Motor {
    /// Moment of inertia J (kg·m²).
    pub inertia: f64,
    /// Armature inductance La (H).
    pub inductance: f64,
    /// Armature resistance Ra (Ω).
    pub resistance: f64,
    /// Back-EMF and torque constant Kb (V·s/rad, N·m/A).
    pub back_emf_constant: f64,
    /// Viscous friction b (N·m·s/rad).
    #[serde(default)]
    pub viscous_friction: f64,
    /// Coulomb friction T_c (N·m). The controllers know nothing of it: to them it is load torque.
    #[serde(default)]
    pub coulomb_friction: f64,
}

/// The motor's state.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct State {
    /// Shaft speed ω (rad/s).
    pub speed: f64,
    /// Armature current i (A).
    pub current: f64,
}

/// What drives the armature.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Armature {
    /// A voltage (V).
    Driven(f64),
    /// Open switches: the current freewheels through the diodes against the bus voltage (V) until it has died down.
    Open(f64),
}

/// The motor as a differential equation.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Plant {
    motor: Motor,
    per_inertia: f64,
    per_inductance: f64,
}

impl Plant {
    /// The differential equation of a motor; all parameters but the frictions must be positive.
    pub fn new(motor: Motor) -> Self {
        Self { motor, per_inertia: 1.0 / motor.inertia, per_inductance: 1.0 / motor.inductance }
    }

    /// Coulomb friction torque at a speed (N·m).
    pub fn coulomb_torque(&self, speed: f64) -> f64 {
        if self.motor.coulomb_friction == 0.0 {
            return 0.0;
        }
        self.motor.coulomb_friction * speed / (speed * speed + CREEP_SPEED * CREEP_SPEED).sqrt()
    }

    /// The motor's parameters.
    pub fn motor(&self) -> &Motor {
        &self.motor
    }

    /// The shaft's acceleration ω̇ (rad/s²) under a load torque (N·m).
    #[inline]
    pub fn acceleration(&self, state: State, load: f64) -> f64 {
        let State { speed, current } = state;
        let Motor { back_emf_constant, viscous_friction, .. } = self.motor;
        let torque = back_emf_constant * current
            - viscous_friction * speed
            - self.coulomb_torque(speed)
            - load;
        torque * self.per_inertia
    }

    fn derivative(&self, state: State, voltage: f64, load: f64) -> State {
        let State { speed, current } = state;
        let Motor { resistance, back_emf_constant, .. } = self.motor;
        let inductive_voltage = voltage - resistance * current - back_emf_constant * speed;
        State {
            speed: self.acceleration(state, load),
            current: inductive_voltage * self.per_inductance,
        }
    }

    /// Integration steps that a time of `duration` (s) needs.
    pub fn steps_for(&self, duration: f64) -> usize {
        let Motor { resistance, back_emf_constant, viscous_friction, coulomb_friction, .. } =
            self.motor;
        let electrical = resistance * self.per_inductance;
        let mechanical = (viscous_friction + coulomb_friction / CREEP_SPEED) * self.per_inertia;
        let oscillation = back_emf_constant * (self.per_inertia * self.per_inductance).sqrt();
        let fastest = electrical.max(mechanical).max(oscillation);
        (duration * fastest / STEP_PER_TIME_CONSTANT).ceil().max(1.0) as usize
    }

    /// One classical Runge-Kutta step of `h` seconds, with the load torque (N·m) at its start, middle and end.
    #[inline]
    pub fn step(&self, state: State, armature: Armature, load: [f64; 3], h: f64) -> State {
        match armature {
            Armature::Driven(voltage) => self.rk4(state, |_| voltage, load, h),
            Armature::Open(bus) => self.freewheel(state, bus, load, h),
        }
    }

    /// With a voltage that may depend on the speed.
    fn rk4(&self, state: State, voltage: impl Fn(f64) -> f64, load: [f64; 3], h: f64) -> State {
        let along = |slope: State, h: f64| State {
            speed: state.speed + h * slope.speed,
            current: state.current + h * slope.current,
        };
        let slope = |at: State, load: f64| self.derivative(at, voltage(at.speed), load);
        let k1 = slope(state, load[0]);
        let k2 = slope(along(k1, 0.5 * h), load[1]);
        let k3 = slope(along(k2, 0.5 * h), load[1]);
        let k4 = slope(along(k3, h), load[2]);
        let sum = |k1: f64, k2: f64, k3: f64, k4: f64| k1 + 2.0 * (k2 + k3) + k4;
        along(
            State {
                speed: sum(k1.speed, k2.speed, k3.speed, k4.speed),
                current: sum(k1.current, k2.current, k3.current, k4.current),
            },
            h / 6.0,
        )
    }

    /// The diodes put the bus against the current. Where the current would change its sign it stays at zero, unless
    /// the back-EMF exceeds the bus.
    fn freewheel(&self, state: State, bus: f64, load: [f64; 3], h: f64) -> State {
        let direction = if state.current != 0.0 {
            state.current.signum()
        } else if self.motor.back_emf_constant * state.speed.abs() > bus {
            -state.speed.signum()
        } else {
            // No current flows: the voltage is the back-EMF, and only the mechanics go on.
            return self.rk4(state, |speed| self.motor.back_emf_constant * speed, load, h);
        };
        let next = self.rk4(state, |_| -direction * bus, load, h);
        let died_down = next.current * direction < 0.0;
        State { current: if died_down { 0.0 } else { next.current }, ..next }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const PAPER: Motor = Motor {
        inertia: 7.95e-5,
        inductance: 105e-6,
        resistance: 0.7,
        back_emf_constant: 59e-3,
        viscous_friction: 0.0,
        coulomb_friction: 0.0,
    };

    fn load(t: f64) -> f64 {
        0.05 + 0.03 * (2_000.0 * t).sin()
    }

    /// State after 10 ms of 12 V in `steps` steps.
    fn integrate(motor: Motor, armature: Armature, start: State, steps: usize) -> State {
        let plant = Plant::new(motor);
        let h = 0.01 / steps as f64;
        (0..steps).fold(start, |state, step| {
            let t = step as f64 * h;
            plant.step(state, armature, [load(t), load(t + 0.5 * h), load(t + h)], h)
        })
    }

    fn distance(a: State, b: State) -> f64 {
        (a.speed - b.speed).hypot(a.current - b.current)
    }

    #[test]
    fn order_of_accuracy_is_four() {
        let with_friction = Motor { viscous_friction: 1e-5, coulomb_friction: 5e-3, ..PAPER };
        for motor in [PAPER, with_friction] {
            let run = |steps| integrate(motor, Armature::Driven(12.0), State::default(), steps);
            let truth = run(64_000);
            let errors: Vec<f64> =
                [500, 1000, 2000, 4000].map(|steps| distance(run(steps), truth)).to_vec();
            for pair in errors.windows(2) {
                let order = (pair[0] / pair[1]).log2();
                assert!((3.8..4.3).contains(&order), "order {order} from {errors:?}");
            }
        }
    }

    #[test]
    fn one_step_per_pwm_period_is_accurate_enough() {
        // The paper's motor at 20 kHz: 200 periods, one step each.
        let period = 5e-5;
        assert_eq!(Plant::new(PAPER).steps_for(period), 1);
        let coarse = integrate(PAPER, Armature::Driven(12.0), State::default(), 200);
        let truth = integrate(PAPER, Armature::Driven(12.0), State::default(), 64_000);
        assert!(distance(coarse, truth) < 1e-3, "{coarse:?} is not {truth:?}");
        assert!(distance(coarse, truth) > 1e-9, "RK4 with one step cannot be that good");
    }

    #[test]
    fn friction_brings_a_light_motor_to_rest() {
        // Coulomb friction is steep at standstill for so light a rotor: without steps for it, RK4 would be unstable.
        let motor = Motor {
            inertia: 1e-6,
            inductance: 1e-3,
            resistance: 5.0,
            back_emf_constant: 0.02,
            viscous_friction: 0.0,
            coulomb_friction: 0.02,
        };
        let plant = Plant::new(motor);
        let steps = plant.steps_for(5e-5);
        assert!((20..40).contains(&steps), "{steps}");
        let mut state = State { speed: 50.0, current: 0.0 };
        for _ in 0..20_000 * steps {
            state = plant.step(state, Armature::Driven(0.0), [0.0; 3], 5e-5 / steps as f64);
        }
        assert!(state.speed.abs() < 1e-6 && state.current.abs() < 1e-6, "{state:?}");
    }

    #[test]
    fn settles_where_algebra_says() {
        let plant = Plant::new(Motor { viscous_friction: 1e-4, coulomb_friction: 0.01, ..PAPER });
        let mut state = State::default();
        for _ in 0..40_000 {
            state = plant.step(state, Armature::Driven(12.0), [0.05; 3], 5e-5);
        }
        // u = R i + Kb w, Kb i = b w + T_c + T_l; creeping takes 1e-6 off T_c at this speed.
        let torque = |speed: f64| 1e-4 * speed + 0.06;
        let speed = (12.0 * 59e-3 - 0.7 * 0.06) / (59e-3 * 59e-3 + 0.7 * 1e-4);
        assert!((state.speed - speed).abs() < 1e-3, "{} is not {speed}", state.speed);
        let current = torque(speed) / 59e-3;
        assert!((state.current - current).abs() < 1e-4, "{} is not {current}", state.current);
    }

    #[test]
    fn open_switches_let_the_current_die_and_the_motor_coast() {
        let start = State { speed: 100.0, current: 10.0 };
        let coast = integrate(PAPER, Armature::Open(24.0), start, 1000);
        assert_eq!(coast.current, 0.0);
        // Only the load brakes, after the current has died within 10 A * 105 uH / 24 V = 44 us.
        let braked_by = |torque: f64| start.speed - torque * 0.01 / PAPER.inertia;
        assert!((braked_by(0.055)..braked_by(0.045)).contains(&coast.speed), "{coast:?}");
        // Spun beyond the bus, the motor generates into it.
        let fast = State { speed: 1000.0, current: 0.0 };
        let generating = integrate(PAPER, Armature::Open(24.0), fast, 1000);
        assert!(generating.current < 0.0, "{generating:?}");
    }
}
