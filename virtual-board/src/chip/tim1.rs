//! Advanced-control timer TIM1 (RM0440, chapter *Advanced-control timers*).
//!
//! Modelled: centre-aligned counting, repetition counter, preloads, PWM modes 1 and 2, complementary outputs with dead time, idle and off
//! states, main output enable with automatic setting, break by the comparator with its filter and by the system, write protection,
//! trigger outputs (update, OC4REF), channel 4's DMA request. Not: edge-aligned counting, captures, channels 5 and 6, other modes and
//! triggers, OCREF clear, break 2, bidirectional break, dithering.

use super::block::{Access, Unmodelled, bit, field, only, store};
use crate::time::{NEVER, Tick};

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const SMCR: u32 = 0x08;
const DIER: u32 = 0x0c;
const SR: u32 = 0x10;
const EGR: u32 = 0x14;
const CCMR1: u32 = 0x18;
const CCMR2: u32 = 0x1c;
const CCER: u32 = 0x20;
const CNT: u32 = 0x24;
const PSC: u32 = 0x28;
const ARR: u32 = 0x2c;
const RCR: u32 = 0x30;
const CCR1: u32 = 0x34;
const CCR4: u32 = 0x40;
const BDTR: u32 = 0x44;
const AF1: u32 = 0x60;

// CR1
const CEN: u32 = 0;
const URS: u32 = 2;
const ARPE: u32 = 7;

// SR
const UIF: u32 = 0;
const CC1IF: u32 = 1;
const BIF: u32 = 7;
const SBIF: u32 = 13;

// BDTR
const OSSI: u32 = 10;
const OSSR: u32 = 11;
const BKE: u32 = 12;
const BKP: u32 = 13;
const AOE: u32 = 14;
const MOE: u32 = 15;

/// Channels; the first three have outputs.
const CHANNELS: usize = 4;
const SAMPLE: usize = 3;

/// Break filter by BDTR's BKF: cycles of the clock (sampling divider times samples).
const BREAK_FILTER: [Tick; 16] = [0, 2, 4, 8, 12, 16, 24, 32, 48, 64, 80, 96, 128, 160, 192, 256];

/// What an event of the timer is for others.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Effects {
    /// An update: TRGO, where CR2 says so.
    pub trgo: bool,
    /// OC4REF has risen: TRGO2, where CR2 says so.
    pub trgo2: bool,
    /// Channel 4 asks for a transfer.
    pub request: bool,
}

/// A channel's reference, and when it last changed.
#[derive(Clone, Copy, Default)]
struct Reference {
    is_active: bool,
    since: Tick,
}

/// The registers.
pub struct Tim1 {
    cr1: u32,
    cr2: u32,
    dier: u32,
    sr: u32,
    ccmr: [u32; 2],
    ccer: u32,
    psc: u32,
    arr: u32,
    rcr: u32,
    ccr: [u32; CHANNELS],
    bdtr: u32,
    af1: u32,
    /// In force.
    active_psc: u32,
    active_arr: u32,
    active_ccr: [u32; CHANNELS],
    /// Updates that are still left out.
    repetitions: u32,
    /// Where the counter turned last, and which way it goes.
    turned: Tick,
    is_down: bool,
    references: [Reference; CHANNELS],
    /// When the outputs ended.
    ended: Tick,
    /// Since when the comparator has asked for a break.
    comparator: Option<Tick>,
    /// Whether the system asks for one.
    system: bool,
    /// Whether a break is in force.
    is_broken: bool,
    /// How far time has come.
    now: Tick,
    effects: Effects,
    /// Whether the counter is broken, and stands still.
    is_stuck: bool,
}

impl Tim1 {
    /// After a reset.
    pub fn new() -> Self {
        Self {
            cr1: 0,
            cr2: 0,
            dier: 0,
            sr: 0,
            ccmr: [0; 2],
            ccer: 0,
            psc: 0,
            arr: 0xffff,
            rcr: 0,
            ccr: [0; CHANNELS],
            bdtr: 0,
            af1: 1,
            active_psc: 0,
            active_arr: 0xffff,
            active_ccr: [0; CHANNELS],
            repetitions: 0,
            turned: 0,
            is_down: false,
            references: [Reference::default(); CHANNELS],
            ended: 0,
            comparator: None,
            system: false,
            is_broken: false,
            now: 0,
            effects: Effects::default(),
            is_stuck: false,
        }
    }

    /// After another one: what is broken stays so.
    pub fn reset(&mut self) {
        *self = Self { is_stuck: self.is_stuck, ..Self::new() };
    }

    /// The counter breaks.
    pub fn get_stuck(&mut self) {
        self.is_stuck = true;
    }

    /// Main output enable.
    pub fn main_output(&self) -> bool {
        bit(self.bdtr, MOE)
    }

    /// Level of its break interrupt.
    pub fn interrupts_on_break(&self) -> bool {
        bit(self.dier, BIF) && self.sr & (1 << BIF | 1 << SBIF) != 0
    }

    /// Level of its update interrupt.
    pub fn interrupts_on_update(&self) -> bool {
        bit(self.dier, UIF) && bit(self.sr, UIF)
    }

    /// What the events since the last call were for others.
    pub fn take_effects(&mut self) -> Effects {
        core::mem::take(&mut self.effects)
    }

    // Time

    /// The clock's cycle changes.
    pub fn rescale(&mut self, now: Tick, before: Tick, after: Tick) {
        self.turned = now.saturating_sub((now - self.turned) / before * after);
    }

    fn tick(&self, cycle: Tick) -> Tick {
        Tick::from(self.active_psc + 1) * cycle
    }

    fn is_running(&self) -> bool {
        bit(self.cr1, CEN) && !self.is_stuck
    }

    fn turn(&self, cycle: Tick) -> Tick {
        self.turned + Tick::from(self.active_arr) * self.tick(cycle)
    }

    fn count(&self, now: Tick, cycle: Tick) -> u32 {
        if !self.is_running() {
            return 0;
        }
        let ticks = ((now - self.turned) / self.tick(cycle)) as u32;
        if self.is_down { self.active_arr.saturating_sub(ticks) } else { ticks }
    }

    /// When the counter comes to a channel's compare value on this way, at or after the way's beginning.
    fn crosses(&self, channel: usize, cycle: Tick) -> Tick {
        let value = self.active_ccr[channel];
        let ticks = match self.is_down {
            false if value < self.active_arr => value,
            true if (1..=self.active_arr).contains(&value) => self.active_arr - value,
            _ => return NEVER,
        };
        self.turned + Tick::from(ticks) * self.tick(cycle)
    }

    fn dead_time(&self, cycle: Tick) -> Tick {
        let code = field(self.bdtr, 0, 8);
        let cycles = match code >> 5 {
            0..=3 => code,
            4 | 5 => (64 + (code & 0x3f)) * 2,
            6 => (32 + (code & 0x1f)) * 8,
            _ => (32 + (code & 0x1f)) * 16,
        };
        Tick::from(cycles) * cycle
    }

    fn break_filter(&self, cycle: Tick) -> Tick {
        BREAK_FILTER[field(self.bdtr, 16, 4) as usize] * cycle
    }

    /// When something happens.
    pub fn next_event(&self, cycle: Tick) -> Tick {
        let mut next = NEVER;
        let mut at = |time: Tick| {
            if time > self.now {
                next = next.min(time);
            }
        };
        if self.is_running() {
            at(self.turn(cycle));
            (0..CHANNELS).for_each(|channel| at(self.crosses(channel, cycle)));
        }
        // Ends of dead times.
        let dead_time = self.dead_time(cycle);
        if self.main_output() {
            self.references[..3].iter().for_each(|reference| at(reference.since + dead_time));
        } else if self.cr2 & 0x3f00 != 0 {
            at(self.ended + dead_time);
        }
        if let Some(since) = self.comparator.filter(|_| self.is_break_enabled()) {
            at(since + self.break_filter(cycle));
        }
        next
    }

    /// Does what is due, at the time of the next event.
    pub fn advance(&mut self, now: Tick, cycle: Tick) {
        self.now = now;
        if self.is_running() {
            if now == self.turn(cycle) {
                self.turned = now;
                self.is_down = !self.is_down;
                self.end_of_count();
            }
            for channel in 0..CHANNELS {
                if self.crosses(channel, cycle) == now {
                    self.cross(channel);
                }
            }
            self.refer(now, cycle);
        }
        self.check_break(cycle);
    }

    /// The counter has turned.
    fn end_of_count(&mut self) {
        if self.repetitions > 0 {
            self.repetitions -= 1;
        } else {
            self.update();
            self.sr |= 1 << UIF;
        }
    }

    /// An update: preloads come into force.
    fn update(&mut self) {
        self.repetitions = self.rcr;
        self.active_psc = self.psc;
        self.active_arr = self.arr;
        self.active_ccr = self.ccr;
        self.effects.trgo |= field(self.cr2, 4, 3) == 2;
        if bit(self.bdtr, AOE) && !self.is_broken {
            self.bdtr |= 1 << MOE;
        }
    }

    /// The counter is at a channel's compare value.
    fn cross(&mut self, channel: usize) {
        // CMS: flags on the way down, up, or on both.
        let flags_here = match field(self.cr1, 5, 2) {
            1 => self.is_down,
            2 => !self.is_down,
            _ => true,
        };
        if flags_here {
            self.sr |= 1 << (CC1IF + channel as u32);
            self.effects.request |= channel == SAMPLE && bit(self.dier, 12);
        }
    }

    /// Brings the channels' references up to date.
    fn refer(&mut self, now: Tick, cycle: Tick) {
        let count = self.count(now, cycle);
        for channel in 0..CHANNELS {
            let value = self.active_ccr[channel];
            // PWM mode 1; mode 2 is its inverse.
            let is_below = if self.is_down { count <= value } else { count < value };
            let is_active = match self.mode(channel) {
                6 => is_below,
                7 => !is_below,
                _ => continue,
            };
            let reference = &mut self.references[channel];
            if reference.is_active != is_active {
                *reference = Reference { is_active, since: now };
                if channel == SAMPLE && is_active {
                    self.effects.trgo2 |= field(self.cr2, 20, 4) == 7;
                }
            }
        }
    }

    fn mode(&self, channel: usize) -> u32 {
        let (ccmr, shift) = (self.ccmr[channel / 2], 8 * (channel as u32 % 2));
        field(ccmr, 4 + shift, 3) | field(ccmr, 16 + shift, 1) << 3
    }

    // Break

    fn is_break_enabled(&self) -> bool {
        bit(self.bdtr, BKE) && bit(self.af1, 1)
    }

    /// The comparator's output is at a level.
    pub fn compare(&mut self, level: bool, now: Tick, cycle: Tick) {
        self.now = now;
        // BKCMP1P
        let asks = level != bit(self.af1, 10);
        self.comparator = asks.then(|| self.comparator.unwrap_or(now));
        self.check_break(cycle);
    }

    /// Whether the comparator asks for a break that the filter still holds back.
    pub fn is_filtering(&self) -> bool {
        self.comparator.is_some() && self.is_break_enabled() && !bit(self.sr, BIF)
    }

    /// The system asks for a break, or no longer.
    pub fn break_by_system(&mut self, level: bool, now: Tick, cycle: Tick) {
        self.now = now;
        self.system = level;
        self.check_break(cycle);
    }

    fn check_break(&mut self, cycle: Tick) {
        let filter = self.break_filter(cycle);
        let by_comparator = self.is_break_enabled()
            && self.comparator.is_some_and(|since| self.now >= since + filter);
        let by_system = bit(self.bdtr, BKE) && self.system;
        self.is_broken = by_comparator || by_system;
        self.sr |= u32::from(by_comparator) << BIF | u32::from(by_system) << SBIF;
        if self.is_broken {
            self.end_outputs();
        }
    }

    fn end_outputs(&mut self) {
        if self.main_output() {
            self.bdtr &= !(1 << MOE);
            self.ended = self.now;
        }
    }

    // Outputs

    /// What drives channel `channel`'s outputs, CHx and CHxN; nothing where the timer leaves them to their pulls (RM0440, table *Output
    /// control bits for complementary OCx and OCxN channels with break feature*).
    pub fn outputs(&self, channel: usize, now: Tick, cycle: Tick) -> [Option<bool>; 2] {
        let enables = field(self.ccer, 4 * channel as u32, 4);
        let [is_enabled, is_inverted, is_n_enabled, is_n_inverted] =
            [0, 1, 2, 3].map(|n| bit(enables, n));
        if !is_enabled && !is_n_enabled {
            return [None; 2];
        }
        let off = [Some(is_inverted), Some(is_n_inverted)];
        let dead_time = self.dead_time(cycle);
        if !self.main_output() {
            let idle = field(self.cr2, 8 + 2 * channel as u32, 2);
            let idle = [bit(idle, 0), bit(idle, 1)];
            let is_over = now >= self.ended + dead_time;
            // Both active would be a short circuit: the timer refuses.
            let are_both_active = idle == [!is_inverted, !is_n_inverted];
            return match bit(self.bdtr, OSSI) {
                false => [None; 2],
                true if is_over && !are_both_active => idle.map(Some),
                true => off,
            };
        }
        let Reference { is_active, since } = self.references[channel];
        let off = if bit(self.bdtr, OSSR) { off } else { [None; 2] };
        match (is_enabled, is_n_enabled) {
            (true, true) => {
                let is_late = now >= since + dead_time;
                let high = is_active && is_late;
                let low = !is_active && is_late;
                [Some(high != is_inverted), Some(low != is_n_inverted)]
            }
            (true, false) => [Some(is_active != is_inverted), off[1]],
            (false, _) => [off[0], Some(is_active != is_n_inverted)],
        }
    }

    // Registers

    /// Reads a register.
    pub fn read(&self, offset: u32, now: Tick, cycle: Tick) -> Access<u32> {
        Ok(match offset {
            CR1 => self.cr1 | u32::from(self.is_down) << 4,
            CR2 => self.cr2,
            SMCR => 0,
            DIER => self.dier,
            SR => self.sr,
            CCMR1 => self.ccmr[0],
            CCMR2 => self.ccmr[1],
            CCER => self.ccer,
            CNT => self.count(now, cycle),
            PSC => self.psc,
            ARR => self.arr,
            RCR => self.rcr,
            CCR1..=CCR4 => self.ccr[(offset - CCR1) as usize / 4],
            BDTR => self.bdtr,
            AF1 => self.af1,
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick, cycle: Tick) -> Access<()> {
        self.now = now;
        match offset {
            CR1 => self.write_cr1(value, now)?,
            CR2 => self.write_cr2(value)?,
            // UIE, BIE, CC4DE
            DIER => store(&mut self.dier, value, 0x1081)?,
            SR => self.sr &= value,
            EGR => {
                // UG
                only(value, 1)?;
                self.turned = now;
                self.is_down = false;
                self.update();
                if !bit(self.cr1, URS) {
                    self.sr |= 1 << UIF;
                }
            }
            CCMR1 => self.write_ccmr(0, value)?,
            CCMR2 => self.write_ccmr(1, value)?,
            CCER => self.write_ccer(value)?,
            PSC => store(&mut self.psc, field(value, 0, 16), 0xffff)?,
            ARR => {
                store(&mut self.arr, value, 0xffff)?;
                if !bit(self.cr1, ARPE) {
                    self.active_arr = value;
                }
            }
            RCR => store(&mut self.rcr, field(value, 0, 16), 0xffff)?,
            CCR1..=CCR4 => {
                let channel = (offset - CCR1) as usize / 4;
                store(&mut self.ccr[channel], value, 0xffff)?;
                // OCxPE
                if !bit(self.ccmr[channel / 2], 3 + 8 * (channel as u32 % 2)) {
                    self.active_ccr[channel] = value;
                }
            }
            BDTR => self.write_bdtr(value)?,
            AF1 => {
                // BKINE, whose pin is not connected; BKCMP1E, BKCMP1P
                only(value, 0x403)?;
                if self.lock() == 0 {
                    self.af1 = value;
                }
            }
            _ => return Err(Unmodelled),
        }
        if self.is_running() {
            self.refer(now, cycle);
        }
        self.check_break(cycle);
        Ok(())
    }

    fn lock(&self) -> u32 {
        field(self.bdtr, 8, 2)
    }

    fn write_cr1(&mut self, value: u32, now: Tick) -> Access<()> {
        // CEN, URS, DIR, CMS, ARPE
        only(value, 0xf5)?;
        let (was_on, is_on) = (self.is_running(), bit(value, CEN));
        if is_on && field(value, 5, 2) == 0 || was_on && !is_on {
            return Err(Unmodelled);
        }
        if is_on && !was_on {
            self.turned = now;
            self.is_down = false;
        }
        // DIR is the hardware's.
        self.cr1 = value & !(1 << 4);
        Ok(())
    }

    fn write_cr2(&mut self, value: u32) -> Access<()> {
        // MMS, OIS1 to OIS3N, MMS2
        only(value, 0x00f0_3f70)?;
        if !matches!(field(value, 4, 3), 0 | 2) || !matches!(field(value, 20, 4), 0 | 7) {
            return Err(Unmodelled);
        }
        let locked = if self.lock() >= 1 { 0x3f00 } else { 0 };
        self.cr2 = self.cr2 & locked | value & !locked;
        Ok(())
    }

    fn write_ccmr(&mut self, index: usize, value: u32) -> Access<()> {
        // OCxPE, OCxM
        only(value, 0x0101_7878)?;
        // OCxM and OCxPE of channels with outputs.
        let locked = if self.lock() >= 3 { [!0, 0x0001_0078][index] } else { 0 };
        let before = self.ccmr[index];
        self.ccmr[index] = before & locked | value & !locked;
        let is_known = |channel| matches!(self.mode(channel), 0 | 6 | 7);
        if is_known(2 * index) && is_known(2 * index + 1) {
            Ok(())
        } else {
            self.ccmr[index] = before;
            Err(Unmodelled)
        }
    }

    fn write_ccer(&mut self, value: u32) -> Access<()> {
        // CC1E to CC3NP: channel 4 has no output that is modelled.
        only(value, 0x0fff)?;
        // CCxP and CCxNP
        let locked = if self.lock() >= 2 { 0x2aaa } else { 0 };
        self.ccer = self.ccer & locked | value & !locked;
        Ok(())
    }

    fn write_bdtr(&mut self, value: u32) -> Access<()> {
        // All but break 2 and bidirectional breaks.
        only(value, 0x000f_ffff)?;
        if bit(value, BKE) && !bit(value, BKP) {
            return Err(Unmodelled);
        }
        let mut locked = 0;
        // DTG, BKE, BKP, AOE, BKF
        if self.lock() >= 1 {
            locked |= 0x000f_70ff;
        }
        if self.lock() >= 2 {
            locked |= 1 << OSSI | 1 << OSSR;
        }
        // LOCK is written once.
        if self.lock() > 0 {
            locked |= 3 << 8;
        }
        let was_on = self.main_output();
        self.bdtr = self.bdtr & locked | value & !locked;
        if self.is_broken {
            self.bdtr &= !(1 << MOE);
        }
        if was_on && !self.main_output() {
            self.ended = self.now;
        }
        Ok(())
    }
}
