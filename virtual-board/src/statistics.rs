//! What interrupts cost, by counting.

use std::collections::BTreeMap;

/// Smallest, largest, sum.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Spread {
    /// Smallest.
    pub min: u64,
    /// Largest.
    pub max: u64,
    sum: u64,
    count: u64,
}

impl Spread {
    const EMPTY: Self = Self { min: u64::MAX, max: 0, sum: 0, count: 0 };

    fn add(&mut self, value: u64) {
        self.min = self.min.min(value);
        self.max = self.max.max(value);
        self.sum += value;
        self.count += 1;
    }

    /// Mean.
    pub fn mean(&self) -> f64 {
        self.sum as f64 / self.count as f64
    }
}

/// What an exception's handler costs, from entry to exit, without what interrupts it.
#[derive(Clone, Debug)]
pub struct Handler {
    /// How often it ran.
    pub count: u64,
    /// Instructions.
    pub instructions: Spread,
    /// Cycles of the core's clock by estimate, without entry.
    pub cycles: Spread,
    /// How often each address was executed, if asked for.
    pub addresses: BTreeMap<u32, u64>,
}

#[derive(Clone, Copy)]
struct Frame {
    exception: u16,
    instructions: u64,
    cycles: u64,
}

/// Counts.
pub struct Statistics {
    /// The exceptions that are being handled, the innermost last.
    frames: Vec<Frame>,
    handlers: BTreeMap<u16, Handler>,
    /// The exception whose addresses are counted.
    pub profiled: Option<u16>,
}

impl Statistics {
    /// Nothing yet.
    pub fn new() -> Self {
        Self { frames: Vec::new(), handlers: BTreeMap::new(), profiled: None }
    }

    /// By exception number, which is that of the interrupt plus 16.
    pub fn handlers(&self) -> &BTreeMap<u16, Handler> {
        &self.handlers
    }

    /// Forgets what was counted.
    pub fn clear(&mut self) {
        self.handlers.clear();
    }

    /// The core was reset.
    pub fn reset(&mut self) {
        self.frames.clear();
    }

    /// Whether an exception is being handled.
    pub fn is_in_handler(&self) -> bool {
        !self.frames.is_empty()
    }

    /// The exception that is being handled.
    pub fn exception(&self) -> u16 {
        self.frames.last().map_or(0, |frame| frame.exception)
    }

    /// A step was made.
    pub fn step(&mut self, cycles: u64) {
        if let Some(frame) = self.frames.last_mut() {
            frame.instructions += 1;
            frame.cycles += cycles;
        }
    }

    /// An instruction of the handler that is counted by address.
    pub fn execute(&mut self, address: u32) {
        let exception = self.exception();
        *self.handler(exception).addresses.entry(address).or_default() += 1;
    }

    /// After a step, the core handles this exception (0: none); `is_active` tells which it has not left yet.
    pub fn follow(&mut self, exception: u16, is_active: impl Fn(u16) -> bool) {
        while let Some(frame) = self.frames.pop_if(|frame| !is_active(frame.exception)) {
            let handler = self.handler(frame.exception);
            handler.count += 1;
            handler.instructions.add(frame.instructions);
            handler.cycles.add(frame.cycles);
        }
        if exception != self.exception() {
            self.frames.push(Frame { exception, instructions: 0, cycles: 0 });
        }
    }

    fn handler(&mut self, exception: u16) -> &mut Handler {
        self.handlers.entry(exception).or_insert_with(|| Handler {
            count: 0,
            instructions: Spread::EMPTY,
            cycles: Spread::EMPTY,
            addresses: BTreeMap::new(),
        })
    }
}

impl Default for Statistics {
    fn default() -> Self {
        Self::new()
    }
}
