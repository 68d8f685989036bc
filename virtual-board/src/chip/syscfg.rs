//! System configuration controller (RM0440, chapter *System configuration controller*).
//!
//! Modelled: which errors end TIM1's outputs (CFGR2). Parity errors of SRAM never happen.

use super::block::{Access, Unmodelled, bit, only};

const CFGR2: u32 = 0x1c;

/// The registers.
pub struct Syscfg {
    cfgr2: u32,
}

impl Syscfg {
    /// After a reset.
    pub fn new() -> Self {
        Self { cfgr2: 0 }
    }

    /// CLL: whether the core's lock-up is a break.
    pub fn breaks_on_lock_up(&self) -> bool {
        bit(self.cfgr2, 0)
    }

    /// ECCL: whether an error in flash that cannot be corrected is a break.
    pub fn breaks_on_flash_error(&self) -> bool {
        bit(self.cfgr2, 3)
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        if offset == CFGR2 { Ok(self.cfgr2) } else { Err(Unmodelled) }
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            CFGR2 => {
                // CLL, SPL, ECCL: set until reset. SPF, which is never set, is cleared by writing it.
                only(value, 0x10b)?;
                self.cfgr2 |= value & 0xb;
                Ok(())
            }
            _ => Err(Unmodelled),
        }
    }
}
