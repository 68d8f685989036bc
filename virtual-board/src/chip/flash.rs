//! Embedded flash memory, 64 pages of 2 kB (RM0440, chapter *Embedded flash memory for category 2 devices*).
//!
//! Modelled: unlocking, programming of double words, erasing of pages, the time both take and that the core, which runs from the same
//! memory, stands still meanwhile; errors of sequence, size, alignment and of writing what is not erased; errors that the
//! error-correcting code cannot correct. Not: fast programming, mass erase, option bytes, protection, interrupts of its own, caches and
//! the time that wait states take.

use super::block::{Access, Unmodelled, bit, field, only, store};
use crate::time::{MICROSECOND, Tick};
use std::collections::BTreeSet;

/// Bytes of the flash.
pub const SIZE: usize = 0x2_0000;

/// Bytes of a page, which is erased at once.
pub const PAGE: usize = 0x800;

/// Bytes that are programmed at once.
const DOUBLE_WORD: usize = 8;

/// Address of its first byte.
pub const BASE: u32 = 0x0800_0000;

/// What programming and erasing take, typically: from memory of a data sheet. Public code for STM32L4, which has such a flash, has some 90 µs and
/// 24.5 ms as the longest.
const PROGRAM_TIME: Tick = 82 * MICROSECOND;
const ERASE_TIME: Tick = 22_020 * MICROSECOND;

const ACR: u32 = 0x00;
const KEYR: u32 = 0x08;
const SR: u32 = 0x10;
const CR: u32 = 0x14;
const ECCR: u32 = 0x18;
const OPTR: u32 = 0x20;

const KEYS: [u32; 2] = [0x4567_0123, 0xcdef_89ab];

// SR
const PROGERR: u32 = 1 << 3;
const PGAERR: u32 = 1 << 5;
const SIZERR: u32 = 1 << 6;
const PGSERR: u32 = 1 << 7;
const ERRORS: u32 = 0xc1fb;
const BSY: u32 = 1 << 16;

// CR
const PG: u32 = 0;
const PER: u32 = 1;
const STRT: u32 = 16;
const LOCK: u32 = 31;

/// ECCR: an error that cannot be corrected.
const ECCD: u32 = 31;

/// The cells, which outlive resets and power.
#[derive(Clone)]
pub struct Cells {
    bytes: Vec<u8>,
    /// Offsets of double words that the error-correcting code cannot mend.
    broken: BTreeSet<usize>,
}

impl Cells {
    /// All erased.
    pub fn new() -> Self {
        Self { bytes: vec![0xff; SIZE], broken: BTreeSet::new() }
    }

    /// Everything that is stored.
    pub fn bytes(&self) -> &[u8] {
        &self.bytes
    }

    /// Stores bytes as a programmer would, from an offset on.
    pub fn store(&mut self, offset: usize, bytes: &[u8]) {
        self.bytes[offset..offset + bytes.len()].copy_from_slice(bytes);
        self.broken.retain(|place| !(offset..offset + bytes.len()).contains(place));
    }

    /// Makes the double word at an offset unreadable: to read it is a non-maskable interrupt.
    pub fn break_at(&mut self, offset: usize) {
        self.broken.insert(offset / DOUBLE_WORD * DOUBLE_WORD);
    }
}

impl Default for Cells {
    fn default() -> Self {
        Self::new()
    }
}

/// What the flash is at.
#[derive(Clone, Copy)]
enum Operation {
    Program { offset: usize, words: [u32; 2] },
    Erase { offset: usize },
}

/// The registers and the cells.
pub struct Flash {
    acr: u32,
    sr: u32,
    cr: u32,
    eccr: u32,
    /// How many keys have come.
    keys: usize,
    /// The first word of a double word, and where it goes.
    first: Option<(usize, u32)>,
    operation: Option<(Tick, Operation)>,
    error: bool,
    cells: Cells,
    /// Which bytes have changed since the core's view of them was brought up to date.
    changed: Option<core::ops::Range<usize>>,
}

impl Flash {
    /// After a reset.
    pub fn new(cells: Cells) -> Self {
        Self {
            acr: 0x600,
            sr: 0,
            cr: 1 << LOCK | 1 << 30,
            eccr: 0,
            keys: 0,
            first: None,
            operation: None,
            error: false,
            cells,
            changed: Some(0..SIZE),
        }
    }

    /// The cells.
    pub fn cells(&self) -> &Cells {
        &self.cells
    }

    /// The cells, to change them.
    pub fn cells_mut(&mut self) -> &mut Cells {
        self.changed = Some(0..SIZE);
        &mut self.cells
    }

    /// The cells after power went or a reset came: what was being written is broken.
    pub fn interrupted(mut self) -> Cells {
        match self.operation {
            Some((_, Operation::Program { offset, words: [first, _] })) => {
                self.cells.bytes[offset..offset + 4].copy_from_slice(&first.to_le_bytes());
                self.cells.break_at(offset);
            }
            Some((_, Operation::Erase { offset })) => {
                let half = offset + PAGE / 2;
                self.cells.bytes[offset..half].fill(0xff);
                self.cells.broken.retain(|place| !(offset..half).contains(place));
                (half..offset + PAGE).step_by(DOUBLE_WORD).for_each(|o| self.cells.break_at(o));
            }
            None => {}
        }
        self.cells
    }

    /// Wait states.
    pub fn latency(&self) -> u32 {
        field(self.acr, 0, 4)
    }

    /// Until when the core stands still.
    pub fn busy_until(&self) -> Option<Tick> {
        self.operation.map(|(end, _)| end)
    }

    /// Level of the core's non-maskable interrupt.
    pub fn nmi(&self) -> bool {
        bit(self.eccr, ECCD)
    }

    /// Whether an error was just read that cannot be corrected: TIM1's break, where SYSCFG connects it.
    pub fn take_error(&mut self) -> bool {
        core::mem::take(&mut self.error)
    }

    /// Bytes that have changed since the last call.
    pub fn take_changed(&mut self) -> Option<core::ops::Range<usize>> {
        self.changed.take()
    }

    /// The core reads data: whether an error was found.
    pub fn read_cells(&mut self, offset: usize, bytes: &mut [u8]) {
        bytes.copy_from_slice(&self.cells.bytes[offset..offset + bytes.len()]);
        let place = offset / DOUBLE_WORD * DOUBLE_WORD;
        if self.cells.broken.contains(&place) && !bit(self.eccr, ECCD) {
            self.eccr = self.eccr & 1 << 24 | 1 << ECCD | place as u32 >> 3;
            self.error = true;
        }
    }

    /// The core writes to the flash itself.
    pub fn write_cells(&mut self, offset: usize, size: usize, value: u32, now: Tick) {
        if !bit(self.cr, PG) || bit(self.cr, LOCK) || self.operation.is_some() {
            self.sr |= PGSERR;
        } else if size != 4 {
            self.sr |= SIZERR;
        } else {
            match self.first.take() {
                None if offset.is_multiple_of(DOUBLE_WORD) => self.first = Some((offset, value)),
                Some((first, word)) if first + 4 == offset => {
                    let cells = &self.cells.bytes[first..first + DOUBLE_WORD];
                    let is_erased = cells.iter().all(|byte| *byte == 0xff);
                    if self.sr & ERRORS != 0 {
                        self.sr |= PGSERR;
                    } else if !is_erased && (word, value) != (0, 0) {
                        self.sr |= PROGERR;
                    } else {
                        let program = Operation::Program { offset: first, words: [word, value] };
                        self.operation = Some((now + PROGRAM_TIME, program));
                    }
                }
                _ => self.sr |= PGAERR,
            }
        }
    }

    /// When something happens.
    pub fn next_event(&self) -> Tick {
        self.busy_until().unwrap_or(crate::time::NEVER)
    }

    /// Does what is due.
    pub fn advance(&mut self, now: Tick) {
        let Some((_, operation)) = self.operation.take_if(|(end, _)| *end <= now) else { return };
        match operation {
            Operation::Program { offset, words: [first, second] } => {
                self.cells.store(offset, &first.to_le_bytes());
                self.cells.store(offset + 4, &second.to_le_bytes());
                self.changed = Some(offset..offset + DOUBLE_WORD);
            }
            Operation::Erase { offset } => {
                self.cells.store(offset, &[0xff; PAGE]);
                self.cr &= !(1 << STRT);
                self.changed = Some(offset..offset + PAGE);
            }
        }
    }

    /// Reads a register.
    pub fn read(&self, offset: u32) -> Access<u32> {
        Ok(match offset {
            ACR => self.acr,
            SR => self.sr | if self.operation.is_some() { BSY } else { 0 },
            CR => self.cr,
            ECCR => self.eccr,
            // Production value, with nSWBOOT0 = 0 and nBOOT0 = 1.
            OPTR => 0xfbef_f8aa,
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick) -> Access<()> {
        match offset {
            // LATENCY, PRFTEN, ICEN, DCEN, ICRST, DCRST, DBG_SWEN
            ACR => store(&mut self.acr, value, 0x0004_1f0f),
            KEYR => {
                // A wrong key faults, and locks until reset.
                only(value ^ KEYS[self.keys], 0)?;
                self.keys = (self.keys + 1) % KEYS.len();
                if self.keys == 0 {
                    self.cr &= !(1 << LOCK);
                }
                Ok(())
            }
            SR => {
                only(value, ERRORS | BSY)?;
                self.sr &= !value;
                Ok(())
            }
            CR => self.write_cr(value, now),
            ECCR => {
                only(value & !0x007f_ffff, 1 << ECCD | 1 << 30)?;
                self.eccr &= !(value & (1 << ECCD | 1 << 30));
                Ok(())
            }
            _ => Err(Unmodelled),
        }
    }

    fn write_cr(&mut self, value: u32, now: Tick) -> Access<()> {
        if bit(self.cr, LOCK) {
            // Ignored by the hardware, but for locking it again.
            return if bit(value, LOCK) { Ok(()) } else { Err(Unmodelled) };
        }
        // PG, PER, PNB, STRT, OPTLOCK, LOCK; interrupts not.
        only(value, 0xc001_03fb)?;
        if self.operation.is_some() {
            return Err(Unmodelled);
        }
        self.cr = value;
        if bit(value, STRT) {
            if !bit(value, PER) || bit(value, PG) || self.sr & ERRORS != 0 {
                self.sr |= PGSERR;
            } else {
                let offset = field(value, 3, 7) as usize * PAGE;
                if offset >= SIZE {
                    return Err(Unmodelled);
                }
                self.operation = Some((now + ERASE_TIME, Operation::Erase { offset }));
            }
        }
        Ok(())
    }
}
