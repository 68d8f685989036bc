//! TIM4 as encoder interface (RM0440, chapter *General-purpose timers*, encoder mode 3): all four edges of both inputs. The input filter's
//! delay is not modelled, nor is any other mode.

use super::block::{Access, Unmodelled, bit, only, store};

const CR1: u32 = 0x00;
const SMCR: u32 = 0x08;
const CCMR1: u32 = 0x18;
const CNT: u32 = 0x24;
const ARR: u32 = 0x2c;

/// Encoder mode 3.
const SMS: u32 = 3;

/// The registers.
pub struct Tim4 {
    cr1: u32,
    smcr: u32,
    ccmr1: u32,
    arr: u32,
    count: u32,
    /// Edges as of the last look.
    edges: i64,
}

impl Tim4 {
    /// After a reset.
    pub fn new() -> Self {
        Self { cr1: 0, smcr: 0, ccmr1: 0, arr: 0xffff, count: 0, edges: 0 }
    }

    /// Counts up to the edges that the inputs have had by now.
    pub fn count(&mut self, edges: i64) {
        let new = edges - self.edges;
        self.edges = edges;
        // CC1S = CC2S = 1, whatever the filters.
        let is_counting = bit(self.cr1, 0) && self.smcr == SMS && self.ccmr1 & 0x0303 == 0x0101;
        if is_counting && new != 0 {
            let range = i64::from(self.arr) + 1;
            self.count = (i64::from(self.count) + new).rem_euclid(range) as u32;
            self.cr1 = self.cr1 & !(1 << 4) | u32::from(new < 0) << 4;
        }
    }

    /// Reads a register, after [`count`](Self::count).
    pub fn read(&self, offset: u32) -> Access<u32> {
        Ok(match offset {
            CR1 => self.cr1,
            SMCR => self.smcr,
            CCMR1 => self.ccmr1,
            CNT => self.count,
            ARR => self.arr,
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register, after [`count`](Self::count).
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            // CEN; DIR is the hardware's.
            CR1 => {
                only(value, 0x11)?;
                self.cr1 = value & 1 | self.cr1 & 1 << 4;
                Ok(())
            }
            SMCR if value != 0 && value != SMS => Err(Unmodelled),
            SMCR => store(&mut self.smcr, value, SMS),
            // CC1S, IC1F, CC2S, IC2F
            CCMR1 => store(&mut self.ccmr1, value, 0xf3f3),
            CNT => store(&mut self.count, value, 0xffff),
            ARR => store(&mut self.arr, value, 0xffff),
            _ => Err(Unmodelled),
        }
    }
}
