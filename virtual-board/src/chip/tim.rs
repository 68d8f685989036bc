//! General-purpose timers that count up, TIM3 and TIM15 (RM0440, chapters *General-purpose timers*): compare channels without outputs, DMA requests,
//! preloads, and TIM3 started and reset by TIM1's trigger output. The few cycles that a trigger takes from timer to timer are not modelled,
//! nor are captures, outputs and other modes.

use super::block::{Access, Unmodelled, bit, field, only, store};
use crate::time::{NEVER, Tick};

const CR1: u32 = 0x00;
const SMCR: u32 = 0x08;
const DIER: u32 = 0x0c;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CCMR1: u32 = 0x18;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2c;
const CCR1: u32 = 0x34;
const CCR2: u32 = 0x38;

// CR1
const CEN: u32 = 0;
const UDIS: u32 = 1;
const URS: u32 = 2;
const ARPE: u32 = 7;

/// SMCR: SMS = 8, combined reset and trigger mode; TS = 0, ITR0, which is TIM1.
const RESET_AND_TRIGGER_BY_ITR0: u32 = 1 << 16;

/// The registers.
pub struct Tim {
    cr1: u32,
    smcr: u32,
    dier: u32,
    sr: u32,
    ccmr1: u32,
    /// As written.
    psc: u32,
    arr: u32,
    ccr: [u32; 2],
    /// In force.
    active_psc: u32,
    active_arr: u32,
    active_ccr: [u32; 2],
    /// When the counter was zero, while it runs; its value, while it stands.
    zero: Tick,
    count: u32,
    /// How far time has come.
    now: Tick,
    /// Whether channel 1 has asked for a transfer.
    requested: bool,
}

impl Tim {
    /// After a reset.
    pub fn new() -> Self {
        Self {
            cr1: 0,
            smcr: 0,
            dier: 0,
            sr: 0,
            ccmr1: 0,
            psc: 0,
            arr: 0xffff,
            ccr: [0; 2],
            active_psc: 0,
            active_arr: 0xffff,
            active_ccr: [0; 2],
            zero: 0,
            count: 0,
            now: 0,
            requested: false,
        }
    }

    /// Level of its interrupt.
    pub fn interrupts(&self) -> bool {
        self.sr & self.dier & 0x5f != 0
    }

    /// Whether channel 1 has asked for a transfer since the last call.
    pub fn take_request(&mut self) -> bool {
        core::mem::take(&mut self.requested)
    }

    /// The clock's cycle changes.
    pub fn rescale(&mut self, now: Tick, before: Tick, after: Tick) {
        self.zero = now.saturating_sub(now.saturating_sub(self.zero) / before * after);
    }

    fn tick(&self, cycle: Tick) -> Tick {
        Tick::from(self.active_psc + 1) * cycle
    }

    /// When the counter next is at a value.
    fn reaches(&self, value: u32, cycle: Tick) -> Tick {
        let time = self.zero + Tick::from(value) * self.tick(cycle);
        if value <= self.active_arr && time > self.now { time } else { NEVER }
    }

    fn overflow(&self, cycle: Tick) -> Tick {
        self.zero + Tick::from(self.active_arr + 1) * self.tick(cycle)
    }

    /// When something happens.
    pub fn next_event(&self, cycle: Tick) -> Tick {
        if !bit(self.cr1, CEN) {
            return NEVER;
        }
        let [first, second] = self.active_ccr.map(|value| self.reaches(value, cycle));
        self.overflow(cycle).min(first).min(second)
    }

    /// Does what is due, at the time of the next event.
    pub fn advance(&mut self, now: Tick, cycle: Tick) {
        let overflow = self.overflow(cycle);
        let matches = self.active_ccr.map(|value| self.reaches(value, cycle) == now);
        self.now = now;
        if !bit(self.cr1, CEN) {
            return;
        }
        for (channel, matches) in matches.into_iter().enumerate() {
            if matches {
                self.compare(channel);
            }
        }
        if overflow == now {
            self.begin(now);
            self.update(false);
        }
    }

    /// Goes on by so many ticks at once, while nobody looks.
    pub fn skip(&mut self, ticks: u32, now: Tick, cycle: Tick) {
        let time = Tick::from(ticks) * self.tick(cycle);
        loop {
            let next = self.next_event(cycle);
            if next > now + time {
                break;
            }
            self.advance(next, cycle);
        }
        self.zero = self.zero.wrapping_sub(time);
        self.now = now;
    }

    /// TIM1's trigger output.
    pub fn trigger(&mut self, now: Tick) {
        if self.smcr == RESET_AND_TRIGGER_BY_ITR0 {
            self.now = now;
            self.cr1 |= 1 << CEN;
            self.begin(now);
            self.update(true);
            // TIF
            self.sr |= 1 << 6;
        }
    }

    /// The counter is zero.
    fn begin(&mut self, now: Tick) {
        self.zero = now;
        self.count = 0;
    }

    /// An update: by overflow, or by a trigger or software.
    fn update(&mut self, is_asked: bool) {
        if !bit(self.cr1, UDIS) {
            self.active_psc = self.psc;
            self.active_arr = self.arr;
            self.active_ccr = self.ccr;
            if !(is_asked && bit(self.cr1, URS)) {
                self.sr |= 1;
            }
        }
        for channel in [0, 1] {
            if self.active_ccr[channel] == 0 && bit(self.cr1, CEN) {
                self.compare(channel);
            }
        }
    }

    /// A channel's compare value was reached.
    fn compare(&mut self, channel: usize) {
        self.sr |= 2 << channel;
        if channel == 0 && bit(self.dier, 9) {
            self.requested = true;
        }
    }

    /// Reads a register.
    pub fn read(&self, offset: u32, now: Tick, cycle: Tick) -> Access<u32> {
        Ok(match offset {
            CR1 => self.cr1,
            SMCR => self.smcr,
            DIER => self.dier,
            SR => self.sr,
            CCMR1 => self.ccmr1,
            CNT if bit(self.cr1, CEN) => ((now - self.zero) / self.tick(cycle)) as u32,
            CNT => self.count,
            PSC => self.psc,
            ARR => self.arr,
            CCR1 => self.ccr[0],
            CCR2 => self.ccr[1],
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick, cycle: Tick) -> Access<()> {
        self.now = now;
        match offset {
            CR1 => {
                // CEN, UDIS, URS, ARPE
                only(value, 0x87)?;
                match (bit(self.cr1, CEN), bit(value, CEN)) {
                    (false, true) => {
                        self.zero = now.wrapping_sub(Tick::from(self.count) * self.tick(cycle));
                    }
                    (true, false) => self.count = self.read(CNT, now, cycle)?,
                    _ => {}
                }
                self.cr1 = value;
                Ok(())
            }
            SMCR if value != 0 && value != RESET_AND_TRIGGER_BY_ITR0 => Err(Unmodelled),
            SMCR => store(&mut self.smcr, value, !0),
            // UIE, CC1IE, CC2IE, CC1DE
            DIER => store(&mut self.dier, value, 0x207),
            SR => {
                self.sr &= value;
                Ok(())
            }
            EGR => {
                only(value, 1)?;
                self.begin(now);
                self.update(true);
                Ok(())
            }
            // OC1PE, OC2PE; frozen
            CCMR1 => store(&mut self.ccmr1, value, 0x0808),
            CNT if bit(self.cr1, CEN) => Err(Unmodelled),
            CNT => store(&mut self.count, value, 0xffff),
            PSC => store(&mut self.psc, field(value, 0, 16), 0xffff),
            ARR => {
                store(&mut self.arr, value, 0xffff)?;
                if !bit(self.cr1, ARPE) {
                    self.active_arr = value;
                }
                Ok(())
            }
            CCR1 => self.write_ccr(0, value),
            CCR2 => self.write_ccr(1, value),
            _ => Err(Unmodelled),
        }
    }

    fn write_ccr(&mut self, channel: usize, value: u32) -> Access<()> {
        // Without dithering only the lower half is kept.
        let value = field(value, 0, 16);
        self.ccr[channel] = value;
        if !bit(self.ccmr1, 3 + 8 * channel as u32) {
            self.active_ccr[channel] = value;
        }
        Ok(())
    }
}
