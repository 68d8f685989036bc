//! Operational amplifiers (RM0440, chapter *Operational amplifiers*): programmable gain with bias at VINM0. The output follows at once,
//! between the supplies; there is no offset but what the world adds. Not modelled: other modes, timer-controlled inputs, calibration.

use super::block::{Access, Unmodelled, bit, field, store};

/// The registers.
pub struct Opamps {
    csr: [u32; 3],
}

impl Opamps {
    /// After a reset.
    pub fn new() -> Self {
        Self { csr: [0; 3] }
    }

    /// What an amplifier (from 0) amplifies: its input VINP by number, and the gain. Nothing while it is off.
    pub fn stage(&self, amplifier: usize) -> Option<(u32, f64)> {
        let csr = self.csr[amplifier];
        // Gains of 2 to 64 with VINM0 for the bias: PGA_GAIN 8 to 13.
        let gain = f64::from(2 << (field(csr, 14, 5) & 7));
        bit(csr, 0).then_some((field(csr, 2, 2), gain))
    }

    /// Whether an amplifier's output goes to a converter, not to its pin (OPAINTOEN).
    pub fn is_internal(&self, amplifier: usize) -> bool {
        bit(self.csr[amplifier], 8)
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        self.csr.get((offset / 4) as usize).copied().ok_or(Unmodelled)
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        let csr = self.csr.get_mut((offset / 4) as usize).ok_or(Unmodelled)?;
        let is_biased_pga = field(value, 5, 2) == 2 && (8..14).contains(&field(value, 14, 5));
        if value != 0 && !is_biased_pga {
            return Err(Unmodelled);
        }
        // OPAMPEN, VP_SEL, VM_SEL, OPAHSM, OPAINTOEN, PGA_GAIN
        store(csr, value, 0x0007_c1ed)
    }
}
