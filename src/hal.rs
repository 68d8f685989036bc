//! The boundary between the drive and a board: one exchange per PWM period.

use crate::math::Scalar;

/// What the board measured, all at one instant of the PWM period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Sample<S> {
    /// Shaft speed ω (rad/s), positive in the direction in which a positive duty accelerates.
    pub speed: S,
    /// Armature current i (A), positive when it accelerates in the positive direction.
    pub current: S,
    /// Bus voltage (V).
    pub bus_voltage: S,
}

/// What the bridge shall do, from the next update of the PWM timer on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum BridgeCommand<S> {
    /// All switches open: the motor is not driven.
    #[default]
    Off,
    /// The mean armature voltage as a share of the bus voltage, within ±1.
    Duty(S),
}

/// A motor board, real or simulated.
pub trait Board<S: Scalar> {
    /// The sample of this period.
    fn sample(&mut self) -> Sample<S>;

    /// Takes the command that was computed from this period's sample.
    fn apply(&mut self, command: BridgeCommand<S>);
}
