//! The backstepping law, with or without a disturbance estimate (Eqs. 4, 11, 20, 21, 37, 46, 47).
//!
//! ```text
//! z1  = ω − ω_d
//! x2* = −c·z1 + a1·ω + ω̇_d − d̂                     the virtual control: the wanted a2·i
//! z2  = a2·i − x2*
//! u   = (La/a2)·( (a2·a3 − a1²)·ω + a2·(a4 + a1)·i − (1 − c²)·z1 − 2c·z2 + ω̈_d + a1·d̂ + u2 )
//! ```
//!
//! leave ż1 = −c·z1 + z2 + d̃ and ż2 = −z1 − c·z2 + u2 + ζ2, with d̃ = d − d̂ and ζ2 = (c − a1)·d̃ + d̂̇. Plain
//! backstepping is the same law with d̂ = 0 and u2 = 0.
//!
//! Errata mended: (4) prints −a·x1 for +a1·x1, and its sign runs on into a2·(a4 − a1) and +a1² of (8), (11), (21), (45) and
//! (47); (8), (45) and (47) lack a2 on a3·x1, a4·x2 and u/La; z2 is a2·x2 − x2* throughout; (21) and (47) print +c·d̂,
//! which would leave c·d in ζ2.

use super::super::Ranges;
use super::config::{Gains, speed_error_range, z2_range};
use crate::config::{ConfigError, require};
use crate::math::{Base, Scalar};
use crate::motor::Coefficients;
use crate::per_unit::Bases;
use crate::trajectory::Reference;

/// The law's linear parts, collapsed into one gain per signal.
#[derive(Clone, Debug)]
pub(super) struct Backstepping<S: Scalar> {
    /// −a1·ω + a2·i, of the current and the speed.
    modelled: S::Gains<2>,
    /// c·z1.
    closing: S::Steep<1>,
    /// −c·z2 − z1.
    z2_rate: S::Gains<2>,
    /// Armature voltage of the speed and the current, of the errors z1 and z2, of the reference's jerk and d̂, and of ζ̂2/k2.
    held: S::Gains<2>,
    errors: S::Gains<2>,
    feed: S::Steep<2>,
    lumped: S::Gains<1>,
}

impl<S: Scalar> Backstepping<S> {
    /// `ranges` bound what the law will see; gains with which its arithmetic could overflow are refused.
    pub fn new(
        motor: &Coefficients,
        gains: &Gains,
        ranges: &Ranges,
        bases: &Bases,
    ) -> Result<Self, ConfigError> {
        let &Coefficients { a1, a2, a3, a4, inductance, .. } = motor;
        let &Gains { c, k1, k2, .. } = gains;
        // La/a2: the voltage that changes a2·i by 1 rad/s² in a second.
        let volts = inductance / a2;
        let speed = volts * (a2 * a3 - a1 * a1);
        let current = volts * a2 * (a4 + a1);
        let z1 = -volts * (1.0 - c * c);
        let z2 = -volts * 2.0 * c;
        let disturbance = volts * a1;
        let lumped = -volts * k2;
        let z2_range = z2_range(ranges, motor, gains);
        require(z2_range <= 1e12, "control.gains.c", "must keep z2 within 1e12 rad/s²", c)?;
        let largest_voltage = speed.abs() * ranges.speed
            + current * ranges.current
            + z1.abs() * speed_error_range(ranges)
            + z2.abs() * z2_range
            + disturbance * k1
            + lumped.abs();
        require(
            largest_voltage <= 1e15,
            "control.gains",
            "must keep the voltage that the law can ask for below 1e15 V",
            largest_voltage,
        )?;
        let &Bases { speed: w, acceleration: a, jerk: j, current: i, voltage: v, .. } = bases;
        let field = "control.gains.c";
        // What fixed point can hold of z2.
        S::constant(field, z2_range, a)?;
        Ok(Self {
            modelled: S::gains("motor", [(a2, i), (-a1, w)], a)?,
            closing: S::steep(field, [(c, w)], a)?,
            z2_rate: S::gains(field, [(-c, a), (-1.0, w)], j)?,
            held: S::gains("motor", [(speed, w), (current, i)], v)?,
            errors: S::gains(field, [(z1, w), (z2, a)], v)?,
            feed: S::steep("motor", [(volts, j), (disturbance, a)], v)?,
            lumped: S::gains("control.gains.k2", [(lumped, Base::RATIO)], v)?,
        })
    }

    /// The acceleration that the motor's model gives without load, −a1·ω + a2·i (rad/s²).
    #[inline]
    pub fn modelled_acceleration(&self, speed: S, current: S) -> S {
        S::combine(&self.modelled, [current, speed])
    }

    /// The second error z2 (rad/s²).
    #[inline]
    pub fn z2(&self, z1: S, modelled: S, reference: &Reference<S>, disturbance: S) -> S {
        S::amplify(&self.closing, [z1]) + (modelled - reference.acceleration) + disturbance
    }

    /// The rate that z2 is to have, −c·z2 − z1 (rad/s³).
    #[inline]
    pub fn z2_rate(&self, z1: S, z2: S) -> S {
        S::combine(&self.z2_rate, [z2, z1])
    }

    /// The armature voltage u (V); `lumped` is ζ̂2/k2 = −u2/k2.
    #[inline]
    pub fn voltage(
        &self,
        (speed, current): (S, S),
        (z1, z2): (S, S),
        reference: &Reference<S>,
        (disturbance, lumped): (S, S),
    ) -> S {
        S::combine(&self.held, [speed, current])
            + S::combine(&self.errors, [z1, z2])
            + S::amplify(&self.feed, [reference.jerk, disturbance])
            + S::combine(&self.lumped, [lumped])
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::motor::MotorParameters;
    use proptest::prelude::*;

    proptest! {
        /// The law, put into the model, must leave the error dynamics that this module states, whatever the motor and
        /// the state. In f64 beside the law's f32.
        #[test]
        fn leaves_the_stated_error_dynamics(
            [friction, speed, current, wanted, acceleration, jerk, estimate, rest, load, drift] in
                prop::array::uniform10(-1.0..1.0_f32),
            c in 10.0..2000.0_f32,
        ) {
            let motor = MotorParameters {
                // a1 up to 2·c: no term may hide.
                viscous_friction: friction.abs() * 2.0 * c * MotorParameters::PAPER.inertia,
                ..MotorParameters::PAPER
            }
            .coefficients()
            .expect("valid");
            let gains = Gains { c, ..Gains::PAPER };
            let ranges = Ranges { speed: 400.0, current: 40.0, current_command: 30.0 };
            let law = Backstepping::<f32>::new(&motor, &gains, &ranges, &Bases::NONE).expect("valid");
            let (speed, current) = (100.0 * speed, 10.0 * current);
            let reference = Reference {
                speed: 100.0 * wanted,
                acceleration: 1e3 * acceleration,
                jerk: 1e5 * jerk,
            };
            let disturbance = 1e3 * estimate;
            let z1 = speed - reference.speed;
            let z2 = law.z2(z1, law.modelled_acceleration(speed, current), &reference, disturbance);
            let voltage = law.voltage((speed, current), (z1, z2), &reference, (disturbance, rest));

            let f = f64::from;
            let (a1, a2, a3, a4, c) = (f(motor.a1), f(motor.a2), f(motor.a3), f(motor.a4), f(c));
            let (z1, z2, d) = (f(z1), f(z2), 1e3 * f(load));
            let (estimate, estimate_rate) = (f(disturbance), 1e5 * f(drift));
            let acceleration = -a1 * f(speed) + a2 * f(current) + d;
            let current_rate = -a3 * f(speed) - a4 * f(current) + f(voltage) / f(motor.inductance);
            let z1_rate = acceleration - f(reference.acceleration);
            let wanted_rate =
                -c * z1_rate + a1 * acceleration + f(reference.jerk) - estimate_rate;
            let z2_rate = a2 * current_rate - wanted_rate;
            let stated_z1_rate = -c * z1 + z2 + (d - estimate);
            let lumped = (c - a1) * (d - estimate) + estimate_rate;
            let stated_z2_rate = -z1 - c * z2 - f(gains.k2) * f(rest) + lumped;
            // Every product and sum rounds by 6e-8 of its size, some sixteen in a row: 1e-6 of all sizes together.
            let parts = a2 * f(current).abs()
                + a1 * f(speed).abs()
                + f(reference.acceleration).abs()
                + estimate.abs();
            let z1_size = c * z1.abs() + parts + d.abs();
            let z2_size = (a2 * a3 + a1 * a1) * f(speed).abs()
                + a2 * (a4 + a1) * f(current).abs()
                + (1.0 + c * c) * z1.abs()
                + 2.0 * c * (c * z1.abs() + parts + d.abs())
                + f(reference.jerk).abs()
                + f(gains.k2)
                + estimate_rate.abs();
            prop_assert!(
                (z1_rate - stated_z1_rate).abs() < 1e-6 * z1_size,
                "{z1_rate} is not {stated_z1_rate}, of {z1_size}"
            );
            prop_assert!(
                (z2_rate - stated_z2_rate).abs() < 1e-6 * z2_size,
                "{z2_rate} is not {stated_z2_rate}, of {z2_size}"
            );
        }
    }
}
