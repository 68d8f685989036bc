//! The board: core, microcontroller and world, played in time.

use crate::chip::{Cells, Chip, Line, Refused, Reset, Switched, Violated};
use crate::cpu::{Bus, Cpu};
use crate::image::Image;
use crate::memory::Memory;
use crate::statistics::Statistics;
use crate::time::{NEVER, Tick, seconds, ticks};
use crate::world::{Gates, World};
use std::fmt;

/// Rate at which the other end of the serial line sends (bit/s).
pub const LINE_RATE: u32 = 921_600;

/// Why the emulation stopped. It says nothing about the hardware: what the hardware does is played on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stop {
    /// What was refused.
    pub refused: Refused,
    /// Address of the instruction that did it, or that ran when a peripheral did.
    pub pc: u32,
    /// When.
    pub time: Tick,
}

impl fmt::Display for Stop {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { refused, pc, time } = self;
        write!(f, "{refused}, at {pc:#010x}, {:.6} s after power came", seconds(*time))
    }
}

impl std::error::Error for Stop {}

/// A reset that was.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResetEvent {
    /// When (s).
    pub time: f64,
    /// Why.
    pub reset: Reset,
    /// The last address without memory that the core reached for since the reset before: what a lock-up is from.
    pub fault_address: Option<u32>,
}

/// An emulated board with a world around it.
pub struct VirtualBoard<W> {
    chip: Chip<W>,
    memory: Memory,
    cpu: Cpu,
    image: Image,
    statistics: Statistics,
    now: Tick,
    /// When the microcontroller's blocks next do something by themselves.
    next: Tick,
    /// Ticks of a cycle of the core's clock; nothing while it stands still.
    cycle: Option<Tick>,
    is_powered: bool,
    is_locked_up: bool,
    /// Interrupts whose level is forced, and what to.
    forced: [u64; 2],
    instructions: u64,
    resets: Vec<ResetEvent>,
}

impl<W: World> Bus for Chip<W> {
    fn read(&mut self, time: u64, address: u32, size: usize) -> u32 {
        self.advance(time);
        Chip::read(self, address, size)
    }

    fn write(&mut self, time: u64, address: u32, size: usize, value: u32) {
        self.advance(time);
        Chip::write(self, address, size, value);
    }
}

impl<W: World> VirtualBoard<W> {
    /// A board with an image in its flash and nothing else, just powered.
    pub fn new(image: &Image, world: W) -> Self {
        let mut cells = Cells::new();
        for (offset, bytes) in image.segments() {
            cells.store(offset, bytes);
        }
        let memory = Memory::new();
        let chip = Chip::new(memory.clone(), cells, Line::new(LINE_RATE), world);
        let cpu = Cpu::new(&memory);
        let mut board = Self {
            chip,
            memory,
            cpu,
            image: image.clone(),
            statistics: Statistics::new(),
            now: 0,
            next: NEVER,
            cycle: None,
            is_powered: true,
            is_locked_up: false,
            forced: [0; 2],
            instructions: 0,
            resets: Vec::new(),
        };
        board.reset(Reset::Power);
        board
    }

    // Time

    /// Seconds since power first came.
    pub fn time(&self) -> f64 {
        seconds(self.now)
    }

    /// Plays on until so many seconds after power first came.
    pub fn run_until(&mut self, time: f64) -> Result<(), Stop> {
        let end = ticks(time);
        while self.now < end {
            if self.now >= self.next {
                self.follow(end)?;
                continue;
            }
            let Some(cycle) = self.cycle.filter(|_| self.is_powered && !self.is_locked_up) else {
                self.now = self.next.min(end);
                continue;
            };
            let cycles = self.step();
            self.now += cycles * cycle;
            if self.cpu.take_touched() {
                self.follow(end)?;
            }
            // A step of a sleeping core is one cycle; handlers do not sleep.
            if cycles == 1 && !self.statistics.is_in_handler() && self.cpu.is_asleep() {
                self.now = self.now.max(self.next.min(end));
            }
        }
        self.follow(end)
    }

    /// An instruction, or the entry to an exception. Gives its cycles.
    fn step(&mut self) -> u64 {
        if self.statistics.profiled.is_some_and(|e| e == self.statistics.exception()) {
            self.statistics.execute(self.cpu.pc());
        }
        let cycles = self.cpu.step(&mut self.chip, self.now);
        self.instructions += 1;
        self.statistics.step(cycles);
        let exception = self.cpu.exception();
        if exception != self.statistics.exception() {
            self.statistics.follow(exception, |number| self.cpu.is_active(number));
        }
        cycles
    }

    /// Plays what has happened beside the core, and looks at what follows for it.
    fn follow(&mut self, end: Tick) -> Result<(), Stop> {
        let chip = &mut self.chip;
        if !self.is_powered {
            self.next = NEVER;
            return Ok(());
        }
        chip.advance(self.now);
        if let Some(refused) = chip.refused().or(self.cpu.refused()) {
            return Err(Stop { refused, pc: self.cpu.last_pc(), time: self.now });
        }
        if self.now >= chip.watchdog() {
            self.reset(Reset::Watchdog);
            return Ok(());
        }
        if self.cpu.asks_for_reset() {
            self.reset(Reset::Software);
            return Ok(());
        }
        if !self.is_locked_up && self.cpu.is_locked_up() {
            self.is_locked_up = true;
            chip.lock_up();
        }
        self.cycle = chip.cycle();
        if let (Some(until), Some(cycle)) = (chip.stalled_until(), self.cycle) {
            // The core waits for the flash, but blocks go on.
            let until = until.min(chip.watchdog()).min(end).max(self.now);
            self.cpu.stall((until - self.now) / cycle);
            self.now = until;
            chip.advance(until);
        }
        let [high, low] = self.forced;
        let levels = (chip.interrupts() | high) & !low;
        self.cpu.set_interrupts(levels, chip.nmi());
        self.next = chip.next_event();
        Ok(())
    }

    // Power and reset

    /// Resets the microcontroller now, as the pin or the core would.
    pub fn reset(&mut self, reset: Reset) {
        let chip = &mut self.chip;
        chip.advance(self.now);
        chip.reset(reset);
        let fault_address = self.cpu.fault_address();
        self.cpu.reset();
        self.statistics.reset();
        self.is_locked_up = false;
        self.cycle = chip.cycle();
        self.next = chip.next_event();
        self.memory.paint(self.image.stack());
        self.resets.push(ResetEvent { time: seconds(self.now), reset, fault_address });
    }

    /// Power goes: what the flash is at stays half done, and the memories lose their contents.
    pub fn power_cut(&mut self) {
        self.reset(Reset::Power);
        self.resets.pop();
        self.is_powered = false;
        self.memory.lose();
    }

    /// Power comes again.
    pub fn power_up(&mut self) {
        self.is_powered = true;
        self.reset(Reset::Power);
    }

    /// All resets, from the first power-up on.
    pub fn resets(&self) -> &[ResetEvent] {
        &self.resets
    }

    // The world and the serial line

    /// Looks at the world, or changes it.
    pub fn world<R>(&mut self, act: impl FnOnce(&mut W) -> R) -> R {
        act(&mut self.chip.world)
    }

    /// Sends bytes to the board, one after the other from now on.
    pub fn send(&mut self, bytes: &[u8]) {
        self.chip.line().send(bytes, self.now);
        self.next = self.next.min(self.chip.next_event());
    }

    /// Bytes that the board has sent since the last call.
    pub fn received(&mut self) -> Vec<u8> {
        self.chip.line().received()
    }

    // Outputs

    /// What the gate drivers are told.
    pub fn gates(&self) -> Gates {
        self.chip.gates()
    }

    /// Whether the bridge's timer has its main output enabled.
    pub fn main_output(&self) -> bool {
        self.chip.main_output()
    }

    /// Since when no gate has been on (s); now, if one is.
    pub fn off_since(&self) -> f64 {
        seconds(self.chip.last_active())
    }

    /// When the main output enable changed.
    pub fn switched(&self) -> Vec<Switched> {
        self.chip.switched().to_vec()
    }

    // Counts

    /// What interrupts cost.
    pub fn statistics(&mut self) -> &mut Statistics {
        &mut self.statistics
    }

    /// Instructions and entries to exceptions so far.
    pub fn instructions(&self) -> u64 {
        self.instructions
    }

    /// The most of the stack that was in use at once since the last reset (bytes).
    pub fn stack_use(&self) -> usize {
        let stack = self.image.stack();
        stack.len() - self.memory.unused(stack)
    }

    /// What the firmware did that the data sheet forbids.
    pub fn violations(&self) -> Vec<Violated> {
        self.chip.violations().to_vec()
    }

    /// Whether the core has locked up.
    pub fn is_locked_up(&self) -> bool {
        self.is_locked_up
    }

    /// Address of the next instruction, and the function that it is in.
    pub fn place(&self) -> (u32, Option<&str>) {
        let pc = self.cpu.pc();
        (pc, self.image.function_at(pc).map(|function| &*function.name))
    }

    // The flash

    /// What the flash holds.
    pub fn flash(&self) -> Vec<u8> {
        self.chip.cells().bytes().to_vec()
    }

    /// Changes what the flash holds, as a programmer or age would.
    pub fn change_flash(&mut self, change: impl FnOnce(&mut Cells)) {
        self.chip.change_cells(change);
    }

    // Faults to play

    /// The crystal stops for good.
    pub fn break_crystal(&mut self) {
        let chip = &mut self.chip;
        chip.advance(self.now);
        chip.break_crystal();
        self.next = self.now;
    }

    /// The counter of TIM1 stands still from now on, for good.
    pub fn stop_bridge_timer(&mut self) {
        self.chip.stop_bridge_timer();
    }

    /// Holds an interrupt's level, or releases it.
    pub fn force_interrupt(&mut self, number: u32, level: Option<bool>) {
        let bit = 1 << number;
        let [high, low] = &mut self.forced;
        *high = *high & !bit | if level == Some(true) { bit } else { 0 };
        *low = *low & !bit | if level == Some(false) { bit } else { 0 };
        self.next = self.now;
    }

    /// A debugger's halt of this many ticks of TIM15, which goes on meanwhile, for a firmware that has all other timers stand still with the core:
    /// to them it takes no time, and so it does here.
    pub fn halt(&mut self, ticks: u32) {
        self.chip.skip_tim15(ticks);
        self.next = self.now;
    }

    /// Lets the core go on at a function, by a part of its name; if it sleeps, when it wakes. Tells whether there is one.
    pub fn jump_to(&mut self, function: &str) -> bool {
        let address = self.image.function(function).map(|function| function.code.start);
        address.inspect(|address| self.cpu.jump(*address)).is_some()
    }

    /// Lets the core go on at an address; if it sleeps, when it wakes.
    pub fn jump(&mut self, address: u32) {
        self.cpu.jump(address);
    }

    /// Moves the stack's pointer to so many bytes above the stack's end: what is pushed next overflows it.
    pub fn exhaust_stack(&mut self, left: u32) {
        self.cpu.set_sp(self.image.stack().start + left);
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chip::Cause;
    use crate::world::{AnaloguePin, InputPin};

    struct Nothing;

    impl World for Nothing {
        fn switch(&mut self, _: f64, _: Gates) {}

        fn voltage(&mut self, _: f64, _: AnaloguePin) -> f64 {
            0.0
        }

        fn encoder_edges(&mut self, _: f64) -> i64 {
            0
        }

        fn level(&mut self, _: f64, _: InputPin) -> bool {
            false
        }
    }

    #[test]
    fn what_is_not_modelled_stops_with_address_and_program_counter() {
        // Sleep on exit of the core's, CAN of the microcontroller's.
        for register in [0xe000_ed10_u32, 0x4000_6400] {
            let [low, high] = [register as u16, (register >> 16) as u16];
            let image = Image::of_code(&[
                0x1000, 0x2000, // stack
                0x0009, 0x0800, // reset
                0x4801, // ldr r0, =register
                0x2102, // movs r1, #2
                0x6001, // str r1, [r0]
                0xe7fe, // b .
                low, high,
            ]);
            let stop = VirtualBoard::new(&image, Nothing).run_until(1e-3).expect_err("a stop");
            let refused = Refused { cause: Cause::Unmodelled, address: register, written: Some(2) };
            assert_eq!((stop.refused, stop.pc), (refused, crate::chip::flash::BASE + 12));
        }
    }
}
