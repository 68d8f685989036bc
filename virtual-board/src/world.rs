//! What is wired to the microcontroller's pins.

/// Levels at the inputs of the gate drivers: which switches are told to be on.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Gates {
    /// High sides of U, V, W.
    pub high: [bool; 3],
    /// Low sides of U, V, W.
    pub low: [bool; 3],
}

impl Gates {
    /// Every switch open.
    pub const OFF: Self = Self { high: [false; 3], low: [false; 3] };
}

/// An analogue pin.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum AnaloguePin {
    /// PA1: shunt of U with its bias, unamplified.
    ShuntU,
    /// PA7: shunt of V.
    ShuntV,
    /// PB0: shunt of W.
    ShuntW,
    /// PA0: divided bus voltage.
    BusVoltage,
    /// PB14: the thermistor's divider.
    Temperature,
    /// PB12: the potentiometer.
    Potentiometer,
}

/// A digital input pin that is not the encoder's.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum InputPin {
    /// PC10: the button, active low.
    Button,
}

/// What is wired to the pins. Times are in seconds since power came; from call to call they never go back.
pub trait World {
    /// The gates change.
    fn switch(&mut self, time: f64, gates: Gates);

    /// Voltage at an analogue pin (V).
    fn voltage(&mut self, time: f64, pin: AnaloguePin) -> f64;

    /// Edges that the encoder's signals A and B have made, four to a line, positive where A leads B.
    fn encoder_edges(&mut self, time: f64) -> i64;

    /// Level of a digital pin.
    fn level(&mut self, time: f64, pin: InputPin) -> bool;
}
