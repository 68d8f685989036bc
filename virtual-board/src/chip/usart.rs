//! USART2 (RM0440, chapter *Universal synchronous/asynchronous receiver transmitter*): asynchronous, eight bits without parity, by
//! oversampling by 16, with or without FIFOs. A byte takes the time that it takes at the line's rate, in both directions.
//!
//! Not modelled: DMA, other frames, flow control, wake-up, and errors but of framing and overrun.

use super::block::{Access, Unmodelled, bit, field, only, store};
use crate::time::{NEVER, SECOND, Tick};
use std::collections::VecDeque;

const CR1: u32 = 0x00;
const CR2: u32 = 0x04;
const CR3: u32 = 0x08;
const BRR: u32 = 0x0c;
const ISR: u32 = 0x1c;
const ICR: u32 = 0x20;
const RDR: u32 = 0x24;
const TDR: u32 = 0x28;
const PRESC: u32 = 0x2c;

// CR1
const UE: u32 = 0;
const RE: u32 = 2;
const TE: u32 = 3;
const FIFOEN: u32 = 29;

// ISR, and the interrupt enables of the same number in CR1
const FE: u32 = 1;
const ORE: u32 = 3;
const IDLE: u32 = 4;
const RXNE: u32 = 5;
const TC: u32 = 6;
const TXE: u32 = 7;

/// Bits of a frame: start, eight, stop.
const FRAME: Tick = 10;

/// How deep its FIFOs are.
const DEPTH: usize = 8;

/// The registers, and the line's other end.
pub struct Usart {
    cr1: u32,
    cr2: u32,
    cr3: u32,
    brr: u32,
    presc: u32,
    flags: u32,
    receiving: VecDeque<u8>,
    transmitting: VecDeque<u8>,
    /// The byte that leaves, and when it has left.
    leaving: Option<(Tick, u8)>,
    /// When the line, after a byte, has been quiet for a frame.
    quiet: Tick,
    line: Line,
}

/// The other end of the line.
pub struct Line {
    /// Bytes that wait to be sent to the microcontroller.
    waiting: VecDeque<u8>,
    /// When the first of them will have arrived.
    arrives: Tick,
    /// Bytes that have come from it.
    received: Vec<u8>,
    /// A frame's length at the other end's rate.
    frame: Tick,
}

impl Line {
    /// At so many bits per second.
    pub fn new(rate: u32) -> Self {
        let frame = (FRAME * SECOND).div_ceil(rate.into());
        Self { waiting: VecDeque::new(), arrives: NEVER, received: Vec::new(), frame }
    }

    /// Sends bytes, one after the other.
    pub fn send(&mut self, bytes: &[u8], now: Tick) {
        if self.waiting.is_empty() && !bytes.is_empty() {
            self.arrives = now + self.frame;
        }
        self.waiting.extend(bytes);
    }

    /// Bytes that have come since the last call.
    pub fn received(&mut self) -> Vec<u8> {
        core::mem::take(&mut self.received)
    }
}

impl Usart {
    /// After a reset.
    pub fn new(line: Line) -> Self {
        Self {
            cr1: 0,
            cr2: 0,
            cr3: 0,
            brr: 0,
            presc: 0,
            flags: 0,
            receiving: VecDeque::new(),
            transmitting: VecDeque::new(),
            leaving: None,
            quiet: NEVER,
            line,
        }
    }

    /// The other end of the line.
    pub fn line(&mut self) -> &mut Line {
        &mut self.line
    }

    /// Gives up the line, at a reset.
    pub fn into_line(self) -> Line {
        self.line
    }

    /// Level of its interrupt.
    pub fn interrupts(&self) -> bool {
        let isr = self.isr();
        let by_number = isr & self.cr1 & (1 << IDLE | 1 << RXNE | 1 << TC | 1 << TXE);
        let overrun = bit(isr, ORE) && bit(self.cr1, RXNE);
        let error = isr & (1 << FE | 1 << ORE) != 0 && bit(self.cr3, 0);
        by_number != 0 || overrun || error
    }

    /// When something happens.
    pub fn next_event(&self) -> Tick {
        self.line.arrives.min(self.quiet).min(self.leaving.map_or(NEVER, |(end, _)| end))
    }

    /// Does what is due. `cycle` is the clock's; `tx`, `rx` tell whether the pins are connected.
    pub fn advance(&mut self, now: Tick, cycle: Tick, [tx, rx]: [bool; 2]) {
        if let Some((_, byte)) = self.leaving.take_if(|(end, _)| *end <= now) {
            if tx {
                self.line.received.push(byte);
            }
            self.leave(now, cycle);
            if self.leaving.is_none() {
                self.flags |= 1 << TC;
            }
        }
        if self.line.arrives <= now {
            let byte = self.line.waiting.pop_front();
            let next = self.line.arrives + self.line.frame;
            self.line.arrives = if self.line.waiting.is_empty() { NEVER } else { next };
            let is_listening = bit(self.cr1, UE) && bit(self.cr1, RE) && rx;
            if let Some(byte) = byte.filter(|_| is_listening) {
                self.arrive(byte, cycle);
                self.quiet = now + self.frame(cycle);
            }
        }
        if self.quiet <= now {
            self.quiet = NEVER;
            self.flags |= 1 << IDLE;
        }
    }

    fn arrive(&mut self, byte: u8, cycle: Tick) {
        let (ours, theirs) = (self.frame(cycle), self.line.frame);
        // What the receiver tolerates: some 3 % (RM0440, tolerance of the receiver).
        if ours.abs_diff(theirs) * 100 > 3 * ours {
            self.flags |= 1 << FE;
        }
        if self.receiving.len() < self.depth() {
            self.receiving.push_back(byte);
        } else {
            self.flags |= 1 << ORE;
        }
    }

    fn depth(&self) -> usize {
        if bit(self.cr1, FIFOEN) { DEPTH } else { 1 }
    }

    fn frame(&self, cycle: Tick) -> Tick {
        let prescaler = [1, 2, 4, 6, 8, 10, 12, 16, 32, 64, 128, 256][self.presc as usize];
        FRAME * Tick::from(self.brr) * prescaler * cycle
    }

    /// The next byte begins to leave.
    fn leave(&mut self, now: Tick, cycle: Tick) {
        self.leaving = self.transmitting.pop_front().map(|byte| (now + self.frame(cycle), byte));
    }

    fn isr(&self) -> u32 {
        let is_on = bit(self.cr1, UE);
        let when = |condition: bool, number: u32| u32::from(condition) << number;
        self.flags
            | when(!self.receiving.is_empty(), RXNE)
            | when(self.transmitting.len() < self.depth(), TXE)
            | when(is_on && bit(self.cr1, TE), 21)
            | when(is_on && bit(self.cr1, RE), 22)
            | when(self.transmitting.is_empty(), 23)
            | when(self.receiving.len() == DEPTH, 24)
    }

    /// Reads a register.
    pub fn read(&mut self, offset: u32) -> Access<u32> {
        Ok(match offset {
            CR1 => self.cr1,
            CR2 => self.cr2,
            CR3 => self.cr3,
            BRR => self.brr,
            ISR => self.isr(),
            ICR => 0,
            RDR => self.receiving.pop_front().unwrap_or(0).into(),
            PRESC => self.presc,
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick, cycle: Tick) -> Access<()> {
        let is_on = bit(self.cr1, UE);
        match offset {
            // UE, RE, TE, IDLEIE, RXNEIE, TCIE, TXEIE, FIFOEN
            CR1 => {
                only(value, 0x2000_00fd)?;
                // Switching it off discards what it is at.
                if is_on && !bit(value, UE) {
                    return Err(Unmodelled);
                }
                if bit(value, TE) && !bit(self.cr1, TE) {
                    self.flags |= 1 << TC;
                }
                self.cr1 = value;
                Ok(())
            }
            CR2 => store(&mut self.cr2, value, 0),
            // EIE; thresholds are not modelled, and have no effect with their interrupts off.
            CR3 => store(&mut self.cr3, value, 1),
            BRR if is_on => Err(Unmodelled),
            BRR if value < 16 => Err(Unmodelled),
            BRR => store(&mut self.brr, value, 0xffff),
            PRESC => store(&mut self.presc, field(value, 0, 4).min(11), !0),
            ICR => {
                self.flags &= !value;
                Ok(())
            }
            // What finds no room is lost, and never meant to be.
            TDR if is_on && bit(self.cr1, TE) && self.transmitting.len() < self.depth() => {
                self.transmitting.push_back(value as u8);
                self.flags &= !(1 << TC);
                if self.leaving.is_none() {
                    self.leave(now, cycle);
                }
                Ok(())
            }
            _ => Err(Unmodelled),
        }
    }
}
