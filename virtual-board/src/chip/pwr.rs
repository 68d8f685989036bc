//! Power control (RM0440, chapter *Power control*): voltage scaling is always ready at once. No low-power modes.

use super::block::{Access, Unmodelled, bit, field, store};

const CR1: u32 = 0x00;
const CR3: u32 = 0x08;
const SR2: u32 = 0x14;
const CR5: u32 = 0x80;

/// The registers.
pub struct Pwr {
    cr1: u32,
    cr3: u32,
    cr5: u32,
}

impl Pwr {
    /// After a reset.
    pub fn new() -> Self {
        Self { cr1: 0x200, cr3: 0x8000, cr5: 0x100 }
    }

    /// Whether the regulator is in boost mode (R1MODE = 0), without which the core's clock must not be above 150 MHz.
    pub fn is_boosted(&self) -> bool {
        !bit(self.cr5, 8)
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        match offset {
            CR1 => Ok(self.cr1),
            CR3 => Ok(self.cr3),
            // The regulator is ready.
            SR2 => Ok(0x100),
            CR5 => Ok(self.cr5),
            _ => Err(Unmodelled),
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            // VOS, of which only range 1 is for these clocks; DBP
            CR1 if field(value, 9, 2) != 1 => Err(Unmodelled),
            CR1 => store(&mut self.cr1, value, 0x700),
            // EIWUL, UCPD1_DBDIS, UCPD1_STDBY
            CR3 => store(&mut self.cr3, value, 0xe000),
            // R1MODE, and bit 0, which is reserved: stm32-metapac 21 takes it for R1MODE.
            CR5 => store(&mut self.cr5, value & !1, 0x100),
            _ => Err(Unmodelled),
        }
    }
}
