//! Faults for a campaign: what breaks, and when.

use super::circuit::{Leg, Short};
use super::encoder::EncoderFault;
use super::pads::{ShuntFault, ThermistorFault};
use std::ops::Range;

/// Something that breaks, or is done to the board.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Fault {
    /// The encoder.
    Encoder(EncoderFault),
    /// The current sensor of a leg.
    CurrentSensor(Leg, ShuntFault),
    /// A short circuit between the motor's terminals.
    MotorShorted,
    /// A motor lead is off. Its current ends at once.
    LeadOpen,
    /// A leg's output touches a rail.
    LegShorted(Short),
    /// The shaft is held.
    RotorBlocked,
    /// This torque loads the shaft (N·m), beside the scenario's; one below zero drives it on.
    Load(f64),
    /// The supply is this (V).
    Supply(f64),
    /// The supply, from what the scenario has it at, rises at this rate (V/s); down to 0 V if negative.
    SupplyRamp(f64),
    /// The board is at this temperature (°C).
    BoardTemperature(f64),
    /// The thermistor.
    Thermistor(ThermistorFault),
    /// The button is pressed.
    ButtonPressed,
}

/// A fault, and the time (s since power came) that it is there for. Of two that exclude each other the later in the list counts.
#[derive(Clone, Debug, PartialEq)]
pub struct Injection {
    /// What.
    pub fault: Fault,
    /// When.
    pub during: Range<f64>,
}

impl Injection {
    /// A fault that stays.
    pub fn from(time: f64, fault: Fault) -> Self {
        Self { fault, during: time..f64::INFINITY }
    }
}
