//! Independent watchdog (RM0440, chapter *Independent watchdog*), at exactly 32 kHz. No window.

use super::block::{Access, Unmodelled, store};
use crate::time::{NEVER, SECOND, Tick};

const KR: u32 = 0x00;
const PR: u32 = 0x04;
const RLR: u32 = 0x08;
const SR: u32 = 0x0c;
const WINR: u32 = 0x10;

/// A cycle of the low-speed internal oscillator.
const CYCLE: Tick = SECOND / 32_000;

/// Cycles of its clock after prescaler 4 that a write to PR or RLR takes (five, by the manual).
const UPDATE: Tick = 5 * 4 * CYCLE;

/// The registers.
pub struct Iwdg {
    pr: u32,
    rlr: u32,
    is_unlocked: bool,
    is_running: bool,
    /// When PR's and RLR's updates are done.
    updated: [Tick; 2],
    expires: Tick,
}

impl Iwdg {
    /// After a reset.
    pub fn new() -> Self {
        Self {
            pr: 0,
            rlr: 0xfff,
            is_unlocked: false,
            is_running: false,
            updated: [0; 2],
            expires: NEVER,
        }
    }

    /// When it resets the microcontroller.
    pub fn expires(&self) -> Tick {
        self.expires
    }

    fn reload(&mut self, now: Tick) {
        if self.is_running {
            let prescaler = 4 << self.pr.min(6);
            self.expires = now + Tick::from(self.rlr + 1) * prescaler * CYCLE;
        }
    }

    /// Reads a register.
    pub fn read(&self, offset: u32, now: Tick) -> Access<u32> {
        Ok(match offset {
            KR => 0,
            PR => self.pr,
            RLR => self.rlr,
            SR => u32::from(now < self.updated[0]) | u32::from(now < self.updated[1]) << 1,
            WINR => 0xfff,
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick) -> Access<()> {
        match (offset, value) {
            (KR, 0xaaaa) => {
                self.reload(now);
                self.is_unlocked = false;
            }
            (KR, 0xcccc) => {
                self.is_running = true;
                self.reload(now);
                self.is_unlocked = false;
            }
            (KR, 0x5555) => self.is_unlocked = true,
            (KR, _) => self.is_unlocked = false,
            // Protected, or still at the last update: without effect on the hardware, and never meant.
            (PR, _) if !self.is_unlocked || now < self.updated[0] => return Err(Unmodelled),
            (RLR, _) if !self.is_unlocked || now < self.updated[1] => return Err(Unmodelled),
            (PR, _) => {
                store(&mut self.pr, value, 7)?;
                self.updated[0] = now + UPDATE;
            }
            (RLR, _) => {
                store(&mut self.rlr, value, 0xfff)?;
                self.updated[1] = now + UPDATE;
            }
            _ => return Err(Unmodelled),
        }
        Ok(())
    }
}
