//! The boundary between the drive and a board: one exchange per PWM period.

use crate::math::Scalar;

/// How often a board reads the encoder's counter in a PWM period.
pub const READS: usize = 16;

/// What the board measured in a PWM period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sample<S> {
    /// As converters and counters have it.
    Codes(Codes),
    /// In SI units, from sensors without error: for simulation.
    Exact(Exact<S>),
}

/// A period's sample as converters and counters have it. [`crate::sense`] turns it into SI units.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[repr(C, align(4))] // The reads are copied by words.
pub struct Codes {
    /// The encoder's counter, read at equal distances over the period, the last time together with the current. It wraps
    /// at 2¹⁶.
    pub encoder: [u16; READS],
    /// Code of the armature current's converter, sampled at the end of the period.
    pub current: u16,
    /// Code of the bus voltage's converter.
    pub bus_voltage: u16,
    /// How much earlier than that all of them were read, in 1/256 of the distance of two reads. Different in each period, it
    /// keeps any speed from beating with the reads; see [`Reads::Shifted`](crate::sense::Reads::Shifted).
    pub shift: u8,
}

/// A period's sample from sensors without error. In fixed point within a quarter of full scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Exact<S> {
    /// Shaft speed ω (rad/s), positive in the direction in which a positive duty accelerates.
    pub speed: S,
    /// Angle that the shaft turned since the last sample (rad).
    pub advance: S,
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
