//! The motor: nameplate parameters, and the coefficients of its model.
//!
//! The model is the paper's Eqs. (1), (2) with two misprints mended (it prints +a4·i and a4 = Kb/Ra):
//!
//! ```text
//! ω̇ = −a1·ω + a2·i + d             a1 = b/J    a2 = Kb/J
//! i̇ = −a3·ω − a4·i + u/La          a3 = Kb/La  a4 = Ra/La
//! ```
//!
//! with the speed ω (rad/s), the armature current i (A), the armature voltage u (V), and the disturbance
//! d = −T_l/J (rad/s²) of a load torque T_l (N·m) that opposes positive motion.

use crate::config::{ConfigError, non_negative, positive, require};
use crate::schema::group;

/// Parameters of a brushed, permanent-magnet or separately excited DC motor with what turns with it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MotorParameters {
    /// Moment of inertia J of rotor and load (kg·m²). Positive.
    pub inertia: f32,
    /// Armature inductance La (H). Positive.
    pub inductance: f32,
    /// Armature resistance Ra, with leads and bridge (Ω). Positive.
    pub resistance: f32,
    /// Viscous friction b (N·m·s/rad). Zero or positive.
    pub viscous_friction: f32,
    /// Back-EMF constant Kb (V·s/rad), which is the torque constant (N·m/A) too. Positive.
    pub back_emf_constant: f32,
}

group! { MotorParameters { inertia, inductance, resistance, viscous_friction, back_emf_constant } }

impl MotorParameters {
    /// The motor of the paper's Table 1.
    pub const PAPER: Self = Self {
        inertia: 7.95e-5,
        inductance: 105e-6,
        resistance: 0.7,
        viscous_friction: 0.0,
        back_emf_constant: 59e-3,
    };

    /// The model's coefficients. Refuses parameters outside their range, naming the field.
    pub fn coefficients(&self) -> Result<Coefficients, ConfigError> {
        let inertia = positive("motor.inertia", self.inertia)?;
        let inductance = positive("motor.inductance", self.inductance)?;
        let resistance = positive("motor.resistance", self.resistance)?;
        let friction = non_negative("motor.viscous_friction", self.viscous_friction)?;
        let back_emf = positive("motor.back_emf_constant", self.back_emf_constant)?;
        // Each is fine by itself, their ratios may not be.
        let [a1, a2] = [friction / inertia, back_emf / inertia];
        let [a3, a4] = [back_emf / inductance, resistance / inductance];
        let rule = "must go with the other parameters: the model's coefficients overflow or vanish";
        require(a1.is_finite() && a2.is_normal(), "motor.inertia", rule, inertia)?;
        require(a3.is_normal() && a4.is_normal(), "motor.inductance", rule, inductance)?;
        Ok(Coefficients { a1, a2, a3, a4, inductance, inertia })
    }
}

/// Coefficients of the motor's model, checked: all finite, all but `a1` positive.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Coefficients {
    /// b/J (1/s).
    pub a1: f32,
    /// Kb/J (rad/s² per A).
    pub a2: f32,
    /// Kb/La (A/s per rad/s).
    pub a3: f32,
    /// Ra/La (1/s).
    pub a4: f32,
    /// La (H).
    pub inductance: f32,
    /// J (kg·m²).
    pub inertia: f32,
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn coefficients_of_the_papers_motor() {
        let a = MotorParameters::PAPER.coefficients().expect("valid");
        // By hand from Table 1, to f32 precision.
        assert_eq!(a.a1, 0.0);
        assert!((a.a2 - 742.138_4).abs() < 1e-3, "{}", a.a2);
        assert!((a.a3 - 561.904_8).abs() < 1e-3, "{}", a.a3);
        assert!((a.a4 - 6_666.667).abs() < 1e-2, "{}", a.a4);
    }

    #[test]
    fn refusals_name_the_field() {
        let paper = MotorParameters::PAPER;
        for bad in [0.0, -1.0, f32::NAN, f32::INFINITY, 1e-42] {
            let cases = [
                (MotorParameters { inertia: bad, ..paper }, "motor.inertia"),
                (MotorParameters { inductance: bad, ..paper }, "motor.inductance"),
                (MotorParameters { resistance: bad, ..paper }, "motor.resistance"),
                (MotorParameters { back_emf_constant: bad, ..paper }, "motor.back_emf_constant"),
            ];
            for (motor, field) in cases {
                let error = motor.coefficients().expect_err(field);
                assert_eq!(error.field, field, "{bad}");
            }
        }
        let negative = MotorParameters { viscous_friction: -1e-9, ..paper };
        assert_eq!(
            negative.coefficients().expect_err("negative friction").field,
            "motor.viscous_friction"
        );
        let overflow = MotorParameters { inertia: 2e-38, back_emf_constant: 59.0, ..paper };
        assert_eq!(overflow.coefficients().expect_err("overflow").field, "motor.inertia");
    }
}
