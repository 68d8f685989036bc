//! Debug support (RM0440, chapter *Debug support*): the registers only. There is no debugger that halts the core.

use super::block::{Access, Unmodelled, store};

const IDCODE: u32 = 0x00;
const CR: u32 = 0x04;
const APB1FZR1: u32 = 0x08;
const APB2FZR: u32 = 0x10;

/// The registers.
pub struct Dbgmcu {
    cr: u32,
    apb1fzr1: u32,
    apb2fzr: u32,
}

impl Dbgmcu {
    /// After a reset.
    pub fn new() -> Self {
        Self { cr: 0, apb1fzr1: 0, apb2fzr: 0 }
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        match offset {
            // STM32G431, revision Z.
            IDCODE => Ok(0x2001_6468),
            CR => Ok(self.cr),
            APB1FZR1 => Ok(self.apb1fzr1),
            APB2FZR => Ok(self.apb2fzr),
            _ => Err(Unmodelled),
        }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            CR => store(&mut self.cr, value, 0x7),
            APB1FZR1 => store(&mut self.apb1fzr1, value, 0x1006),
            APB2FZR => store(&mut self.apb2fzr, value, 0x800),
            _ => Err(Unmodelled),
        }
    }
}
