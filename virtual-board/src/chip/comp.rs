//! Comparator COMP1 (RM0440, chapter *Comparator*): input plus from its pins, input minus from DAC3's channel 1, hysteresis, lock. Its delay
//! (some 20 ns) is not modelled, nor are other references, blanking and the other comparators.

use super::block::{Access, Unmodelled, bit, field, only};

/// DAC3_CH1 as COMP1's input minus.
const INMSEL_DAC3: u32 = 4;

/// The registers.
pub struct Comp {
    csr: u32,
    value: bool,
}

impl Comp {
    /// After a reset.
    pub fn new() -> Self {
        Self { csr: 0, value: false }
    }

    /// Which of its pins is input plus: 0 is PA1, 1 is PB1. Nothing while it is off.
    pub fn input(&self) -> Option<u32> {
        bit(self.csr, 0).then_some(field(self.csr, 8, 1))
    }

    /// Compares (V).
    pub fn compare(&mut self, plus: f64, minus: f64) {
        let hysteresis = 0.01 * f64::from(field(self.csr, 16, 3));
        let threshold = if self.value { minus - hysteresis } else { minus };
        self.value = plus > threshold;
    }

    /// Output.
    pub fn output(&self) -> bool {
        self.input().is_some() && self.value != bit(self.csr, 15)
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        if offset == 0 { Ok(self.csr | u32::from(self.output()) << 30) } else { Err(Unmodelled) }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        // EN, INMSEL, INPSEL, POLARITY, HYST, LOCK
        only(value, 0x8007_8171)?;
        if offset != 0 || bit(value, 0) && field(value, 4, 3) != INMSEL_DAC3 {
            return Err(Unmodelled);
        }
        if !bit(self.csr, 31) {
            self.csr = value;
        }
        Ok(())
    }
}
