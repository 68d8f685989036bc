//! Analogue-to-digital converters ADC1 and ADC2 (RM0440, chapter *Analog-to-digital converters*): start-up, and injected sequences by
//! TIM1's TRGO2, from the synchronous clock. An input is held at the end of its sampling time, to the tick.
//!
//! Not modelled: regular conversions, other triggers, offsets, watchdogs, oversampling, dual modes, differential inputs; that sampling
//! takes the time that its source's resistance wants.

use super::block::{Access, Unmodelled, bit, field, only, store};
use crate::time::{MICROSECOND, NEVER, Tick};

const ISR: u32 = 0x00;
const IER: u32 = 0x04;
const CR: u32 = 0x08;
const CFGR: u32 = 0x0c;
const SMPR1: u32 = 0x14;
const SMPR2: u32 = 0x18;
const JSQR: u32 = 0x4c;
const JDR1: u32 = 0x80;
const JDR4: u32 = 0x8c;

// CR
const ADEN: u32 = 0;
const JADSTART: u32 = 3;
const ADVREGEN: u32 = 28;
const DEEPPWD: u32 = 29;
const ADCAL: u32 = 31;

// ISR
const ADRDY: u32 = 0;
const JEOC: u32 = 5;
const JEOS: u32 = 6;

/// JSQR: JEXTSEL = 8, TIM1_TRGO2 (as in embassy-stm32's tables of triggers); JEXTEN = 1, rising edge.
const BY_TRGO2: u32 = 8 << 2 | 1 << 7;

/// Sampling times by SMPx, in half cycles of the converter's clock.
const SAMPLING: [Tick; 8] = [5, 13, 25, 49, 95, 185, 495, 1281];
/// Conversion of 12 bits, in half cycles.
const CONVERSION: Tick = 25;
/// From trigger to start, in eighths of a cycle: 2.125 cycles at HCLK / 4 (t_LATR in the data sheet of the STM32G474, DS12288, table 66, as a
/// public design review quotes it; 3.125 cycles, t_LATRINJ, are for an injected conversion that aborts a regular one).
const LATENCY: Tick = 17;
/// Calibration, in cycles, and from ADEN to ADRDY (of a data sheet, from memory: not found again).
const CALIBRATION: Tick = 116;
/// Start-up of the regulator: at most 20 µs (embassy-stm32's driver waits as long).
const REGULATOR: Tick = 20 * MICROSECOND;
const READY: Tick = MICROSECOND;

/// What a converter does next in its sequence.
#[derive(Clone, Copy)]
enum Step {
    Hold { rank: usize },
    Done { rank: usize },
}

/// A converter's registers.
pub struct Adc {
    isr: u32,
    ier: u32,
    cr: u32,
    cfgr: u32,
    smpr: [u32; 2],
    jsqr: u32,
    jdr: [u32; 4],
    /// Since when the regulator is on.
    regulator: Tick,
    calibrated: Tick,
    ready: Tick,
    /// Whether ADRDY was cleared since.
    is_ready_cleared: bool,
    step: Option<(Tick, Step)>,
    held: u32,
}

impl Adc {
    /// After a reset.
    pub fn new() -> Self {
        Self {
            isr: 0,
            ier: 0,
            cr: 1 << DEEPPWD,
            cfgr: 1 << 31,
            smpr: [0; 2],
            jsqr: 0,
            jdr: [0; 4],
            regulator: NEVER,
            calibrated: NEVER,
            ready: NEVER,
            is_ready_cleared: false,
            step: None,
            held: 0,
        }
    }

    /// Level of its interrupt.
    pub fn interrupts(&self) -> bool {
        self.isr & self.ier != 0
    }

    /// When something happens.
    pub fn next_event(&self) -> Tick {
        self.step.map_or(NEVER, |(at, _)| at)
    }

    /// TIM1's TRGO2 rises. `cycle` is the converters' clock's.
    pub fn trigger(&mut self, now: Tick, cycle: Tick) {
        if bit(self.cr, JADSTART) && self.jsqr & 0x1fc == BY_TRGO2 && self.step.is_none() {
            self.sample(0, now + LATENCY * cycle / 8, cycle);
        }
    }

    /// Whether it is enabled.
    pub fn is_enabled(&self) -> bool {
        bit(self.cr, ADEN)
    }

    fn channel(&self, rank: usize) -> u32 {
        field(self.jsqr, 9 + 6 * rank as u32, 5)
    }

    fn sample(&mut self, rank: usize, from: Tick, cycle: Tick) {
        let channel = self.channel(rank);
        let code = field(self.smpr[channel as usize / 10], channel % 10 * 3, 3);
        let hold = from + SAMPLING[code as usize] * cycle / 2;
        self.step = Some((hold, Step::Hold { rank }));
    }

    /// Does what is due. Gives the channel that is to be held now: [`hold`](Self::hold) takes its voltage.
    pub fn advance(&mut self, now: Tick, cycle: Tick) -> Option<u32> {
        let (_, step) = self.step.take_if(|(at, _)| *at <= now)?;
        match step {
            Step::Hold { rank } => {
                self.step = Some((now + CONVERSION * cycle / 2, Step::Done { rank }));
                Some(self.channel(rank))
            }
            Step::Done { rank } => {
                self.jdr[rank] = self.held;
                self.isr |= 1 << JEOC;
                if rank as u32 == field(self.jsqr, 0, 2) {
                    self.isr |= 1 << JEOS;
                } else {
                    self.sample(rank + 1, now, cycle);
                }
                None
            }
        }
    }

    /// Holds a voltage.
    pub fn hold(&mut self, voltage: f64) {
        self.held = (voltage / super::SUPPLY * 4096.0).round().clamp(0.0, 4095.0) as u32;
    }

    /// Reads a register.
    pub fn read(&self, offset: u32, now: Tick) -> Access<u32> {
        let is_ready = now >= self.ready && !self.is_ready_cleared;
        Ok(match offset {
            ISR => self.isr | u32::from(is_ready) << ADRDY,
            IER => self.ier,
            CR if now >= self.calibrated => self.cr & !(1 << ADCAL),
            CR => self.cr,
            CFGR => self.cfgr,
            SMPR1 => self.smpr[0],
            SMPR2 => self.smpr[1],
            JSQR => self.jsqr,
            JDR1..=JDR4 => self.jdr[(offset - JDR1) as usize / 4],
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register. `cycle` is the converters' clock's, if it has one.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick, cycle: Option<Tick>) -> Access<()> {
        let is_started = bit(self.cr, JADSTART);
        match offset {
            ISR => {
                // JQOVF is never set.
                only(value, 0x7ff)?;
                self.isr &= !value;
                self.is_ready_cleared |= bit(value, ADRDY) && now >= self.ready;
                Ok(())
            }
            // JEOCIE, JEOSIE
            IER => store(&mut self.ier, value, 0x60),
            CR => self.write_cr(value, now, cycle),
            // JQDIS only.
            CFGR if value != 1 << 31 => Err(Unmodelled),
            CFGR => Ok(()),
            // Not while conversions may run.
            SMPR1 | SMPR2 | JSQR if is_started => Err(Unmodelled),
            SMPR1 => store(&mut self.smpr[0], value, 0x3fff_ffff),
            SMPR2 => store(&mut self.smpr[1], value, 0x07ff_ffff),
            JSQR if value & 0x1fc != BY_TRGO2 => Err(Unmodelled),
            // JL, JEXTSEL, JEXTEN, JSQ1 to JSQ4
            JSQR => store(&mut self.jsqr, value, 0xfbef_bfff),
            _ => Err(Unmodelled),
        }
    }

    /// Bits that software sets and hardware clears keep their value when zero is written. The manual's order is asked for: out of deep power
    /// down, regulator, calibration, enable, start.
    fn write_cr(&mut self, value: u32, now: Tick, cycle: Option<Tick>) -> Access<()> {
        only(value, 1 << ADEN | 1 << JADSTART | 1 << ADVREGEN | 1 << DEEPPWD | 1 << ADCAL)?;
        let was = self.read(CR, now)?;
        let rises = |number| bit(value, number) && !bit(was, number);
        let is_regulated = bit(was, ADVREGEN) && now >= self.regulator;
        let is_calibrating = bit(was, ADCAL);
        if rises(ADVREGEN) {
            if bit(was, DEEPPWD) {
                return Err(Unmodelled);
            }
            self.regulator = now + REGULATOR;
        }
        if rises(ADCAL) {
            let cycle = cycle.ok_or(Unmodelled)?;
            if !is_regulated || bit(was, ADEN) {
                return Err(Unmodelled);
            }
            self.calibrated = now + CALIBRATION * cycle;
        }
        if rises(ADEN) {
            if !is_regulated || is_calibrating {
                return Err(Unmodelled);
            }
            self.ready = now + READY;
            self.is_ready_cleared = false;
        }
        // Without a synchronous clock nothing would follow the trigger.
        if rises(JADSTART) && (!bit(was, ADEN) || now < self.ready || cycle.is_none()) {
            return Err(Unmodelled);
        }
        let stays = bit(value, ADVREGEN) && !bit(value, DEEPPWD);
        if self.is_enabled() && !stays {
            return Err(Unmodelled);
        }
        let kept = was & (1 << ADEN | 1 << JADSTART | 1 << ADCAL);
        self.cr = value | kept;
        Ok(())
    }
}

/// What both converters share.
pub struct Common {
    ccr: u32,
}

impl Common {
    /// After a reset.
    pub fn new() -> Self {
        Self { ccr: 0 }
    }

    /// Ticks of a cycle of the converters' clock, from the core's; nothing if it is asynchronous.
    pub fn cycle(&self, core: Tick) -> Option<Tick> {
        Some(core * [1, 2, 4].get(field(self.ccr, 16, 2).checked_sub(1)? as usize)?)
    }

    /// Reads a register, from the common ones' beginning.
    pub fn read(&self, offset: u32) -> Access<u32> {
        if offset == 8 { Ok(self.ccr) } else { Err(Unmodelled) }
    }

    /// Writes a register, from the common ones' beginning.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        // CKMODE
        if offset == 8 { store(&mut self.ccr, value, 3 << 16) } else { Err(Unmodelled) }
    }
}
