//! The current's control, from a rough model.

use crate::math::Scalar;

/// What is roughly known of the armature.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Armature {
    /// R (Ω).
    pub resistance: f32,
    /// Λ = 1/Bd (Ω).
    pub inductive: f32,
    /// V0 (V).
    pub lost: f32,
    /// Current within whose ripple V0 changes its sign (A).
    pub ripple: f32,
}

impl Armature {
    /// Voltage that a current takes with the shaft at rest (V).
    pub(super) fn voltage(&self, current: f32) -> f32 {
        self.resistance * current + self.lost * (current / self.ripple).limited(1.0)
    }
}

/// Controls the current: its zero cancels the armature's pole, and the loop closes within some ten periods.
#[derive(Clone, Debug, Default)]
pub(super) struct CurrentLoop {
    pub armature: Armature,
    /// Most that the reference moves in a period (A).
    pub slew: f32,
    reference: f32,
    error: f32,
    /// What it asked for last (V).
    pub voltage: f32,
}

impl CurrentLoop {
    /// The share of an error that a period's voltage takes away. With the delay of a period it is critically damped at 0.25, and
    /// stable with an armature of a third of the inductance.
    const SHARE: f32 = 0.2;

    pub(super) fn error(&self) -> f32 {
        self.error
    }

    pub(super) fn step(&mut self, current: f32, wanted: f32, highest: f32) -> f32 {
        self.reference += (wanted - self.reference).limited(self.slew);
        let error = self.reference - current;
        let Armature { resistance, inductive, .. } = self.armature;
        let change = inductive * (error - self.error) + resistance * self.error;
        self.error = error;
        self.voltage = (self.voltage + Self::SHARE * change).limited(highest);
        self.voltage
    }
}
