//! Digital-to-analogue converter DAC3 (RM0440, chapter *Digital-to-analog converter*): channel 1, without trigger, to the comparators.

use super::block::{Access, Unmodelled, bit, field, store};

const CR: u32 = 0x00;
const DHR12R1: u32 = 0x08;
const DOR1: u32 = 0x2c;
const MCR: u32 = 0x3c;

/// The registers.
pub struct Dac {
    cr: u32,
    dhr1: u32,
    mcr: u32,
}

impl Dac {
    /// After a reset.
    pub fn new() -> Self {
        Self { cr: 0, dhr1: 0, mcr: 0 }
    }

    /// Channel 1's output to on-chip peripherals (V), if there is one.
    pub fn output(&self) -> Option<f64> {
        // Mode 3: to on-chip peripherals, without buffer.
        let is_internal = field(self.mcr, 0, 3) == 3;
        (bit(self.cr, 0) && is_internal).then(|| f64::from(self.dhr1) / 4096.0 * super::SUPPLY)
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        match offset {
            CR => Ok(self.cr),
            DHR12R1 | DOR1 => Ok(self.dhr1),
            MCR => Ok(self.mcr),
            _ => Err(Unmodelled),
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            // EN1
            CR => store(&mut self.cr, value, 1),
            DHR12R1 => store(&mut self.dhr1, value, 0xfff),
            // MODE1, of which all but 0 and 3 go elsewhere; HFSEL
            MCR if !matches!(field(value, 0, 3), 0 | 3) => Err(Unmodelled),
            MCR => store(&mut self.mcr, value, 0xc007),
            _ => Err(Unmodelled),
        }
    }
}
