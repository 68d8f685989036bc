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
//! Errata mended: (4) prints −a·x1 for +a1·x1; z2 is a2·x2 − x2* throughout; (11) and (21) print a2·(a4 − a1) and +a1²
//! with inconsistent signs; (47) lacks a2 on a3·x1 and a4·x2; (21) and (47) print +c·d̂, which would leave c·d in ζ2.

use super::config::{Gains, Ranges};
use crate::config::{ConfigError, require};
use crate::math::Scalar;
use crate::motor::Coefficients;
use crate::trajectory::Reference;

/// The law's linear parts, collapsed into one gain per signal.
#[derive(Clone, Debug)]
pub(super) struct Backstepping<S: Scalar> {
    a1: S::Gain,
    a2: S::Gain,
    c: S::Gain,
    voltage: VoltageGains<S>,
}

/// Armature voltage (V) per signal.
#[derive(Clone, Debug)]
struct VoltageGains<S: Scalar> {
    speed: S::Gain,
    current: S::Gain,
    z1: S::Gain,
    z2: S::Gain,
    jerk: S::Gain,
    disturbance: S::Gain,
    lumped: S::Gain,
}

impl<S: Scalar> Backstepping<S> {
    /// `ranges` bound what the law will see; gains with which its arithmetic could overflow are refused.
    pub fn new(motor: &Coefficients, gains: &Gains, ranges: &Ranges) -> Result<Self, ConfigError> {
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
        let largest_voltage = speed.abs() * ranges.speed
            + current * ranges.current
            + z1.abs() * ranges.speed_error()
            + z2.abs() * ranges.z2(motor, gains)
            + disturbance * k1
            + lumped.abs();
        require(
            largest_voltage <= 1e15,
            "gains",
            "must keep the voltage that the law can ask for below 1e15 V",
            largest_voltage,
        )?;
        Ok(Self {
            a1: S::gain(-a1),
            a2: S::gain(a2),
            c: S::gain(c),
            voltage: VoltageGains {
                speed: S::gain(speed),
                current: S::gain(current),
                z1: S::gain(z1),
                z2: S::gain(z2),
                jerk: S::gain(volts),
                disturbance: S::gain(disturbance),
                lumped: S::gain(lumped),
            },
        })
    }

    /// The acceleration that the motor's model gives without load, −a1·ω + a2·i (rad/s²).
    #[inline]
    pub fn modelled_acceleration(&self, speed: S, current: S) -> S {
        S::combine([(self.a2, current), (self.a1, speed)])
    }

    /// The second error z2 (rad/s²).
    #[inline]
    pub fn z2(&self, z1: S, modelled: S, reference: &Reference<S>, disturbance: S) -> S {
        S::combine([(self.c, z1)]) + (modelled - reference.acceleration) + disturbance
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
        S::combine([
            (self.voltage.speed, speed),
            (self.voltage.current, current),
            (self.voltage.z1, z1),
            (self.voltage.z2, z2),
            (self.voltage.jerk, reference.jerk),
            (self.voltage.disturbance, disturbance),
            (self.voltage.lumped, lumped),
        ])
    }
}
