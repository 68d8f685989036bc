//! The motors of the scoreboard: the paper's, and three from data sheets.

use crate::plant::Motor;

/// A motor with what its bridge allows.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Machine {
    /// Its name.
    pub name: &'static str,
    /// Its parameters, without friction.
    pub motor: Motor,
    /// Current at which the bridge trips (A); controllers ask for 0.8 of it at most. The current's converter reaches a
    /// fortieth further.
    pub trip: f64,
    /// Torque that it gives for ever (N·m).
    pub continuous_torque: f64,
}

const fn motor(inertia: f64, inductance: f64, resistance: f64, back_emf_constant: f64) -> Motor {
    Motor {
        inertia,
        inductance,
        resistance,
        back_emf_constant,
        viscous_friction: 0.0,
        coulomb_friction: 0.0,
    }
}

impl Machine {
    /// The paper's motor. It gives no continuous torque; that of 3 A is assumed.
    pub const PAPER: Self = Self {
        name: "paper",
        motor: motor(7.95e-5, 105e-6, 0.7, 59e-3),
        trip: 25.0,
        continuous_torque: 0.177,
    };

    /// maxon RE 40, order number 148867, 150 W, 24 V: 0.299 Ω, 0.0823 mH, 30.2 mN·m/A, 142 g·cm², 170 mN·m (maxon motor
    /// catalogue, "RE 40 ∅40 mm, graphite brushes, 150 Watt"). Bare rotor.
    pub const RE_40: Self = Self {
        name: "RE 40",
        motor: motor(142e-7, 82.3e-6, 0.299, 30.2e-3),
        trip: 30.0,
        continuous_torque: 0.170,
    };

    /// maxon RE 30, order number 310007, 60 W, 24 V: 0.611 Ω, 0.119 mH, 25.9 mN·m/A, 34.5 g·cm², 85.6 mN·m (maxon motor
    /// catalogue, "RE 30 ∅30 mm, graphite brushes, 60 Watt"). Bare rotor. Inductance, inertia and torque were not looked
    /// up again; editions of the catalogue differ by some percent.
    pub const RE_30: Self = Self {
        name: "RE 30",
        motor: motor(34.5e-7, 119e-6, 0.611, 25.9e-3),
        trip: 17.5,
        continuous_torque: 0.0856,
    };

    /// maxon RE 25, order number 118752, 20 W, 24 V: 2.32 Ω, 0.24 mH, 23.4 mN·m/A, 10.8 g·cm², 28.8 mN·m (maxon motor
    /// catalogue, "RE 25 ∅25 mm, graphite brushes, 20 Watt"). Bare rotor. Inertia and torque were not looked up again.
    pub const RE_25: Self = Self {
        name: "RE 25",
        motor: motor(10.8e-7, 240e-6, 2.32, 23.4e-3),
        trip: 7.5,
        continuous_torque: 0.0288,
    };

    /// All of them, the paper's first.
    pub const ALL: [Self; 4] = [Self::PAPER, Self::RE_40, Self::RE_30, Self::RE_25];

    /// Speed at which the back-EMF is `voltage` (rad/s).
    pub fn no_load_speed(&self, voltage: f64) -> f64 {
        voltage / self.motor.back_emf_constant
    }

    /// Largest current that a controller may ask for (A).
    pub fn current_command(&self) -> f64 {
        0.8 * self.trip
    }
}
