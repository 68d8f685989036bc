//! The microcontroller around its core: blocks by their registers, what connects them, and the pins.
//!
//! One file per block of the reference manual RM0440. Times of events are exact; [`Chip::advance`] plays them in their order.

mod adc;
mod block;
mod comp;
mod dac;
mod dbgmcu;
mod dma;
pub(crate) mod flash;
mod gpio;
mod iwdg;
mod map;
mod opamp;
mod pwr;
mod rcc;
mod syscfg;
mod tim;
mod tim1;
mod tim4;
mod usart;

pub use flash::Cells;
pub use rcc::Reset;
pub use usart::Line;

use crate::memory::Memory;
use crate::time::{MICROSECOND, NEVER, Tick, seconds};
use crate::world::{AnaloguePin, Gates, World};
use adc::Adc;
use block::Unmodelled;
use dma::{Request, Transfer};
use gpio::{Drive, Gpio};
use rcc::Rcc;
use std::fmt;
use tim::Tim;

/// Supply, and the converters' reference (V).
pub const SUPPLY: f64 = 3.3;

/// How often the comparator looks at its inputs while it is far from a trip.
const COMPARATOR_LOOK: Tick = 5 * MICROSECOND;

/// Why the emulation cannot go on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Cause {
    /// Nothing is modelled at the address, or not what the access does there.
    Unmodelled,
    /// The block at the address has no clock, or is held in reset: the hardware would read zero and ignore writes.
    NoClock,
    /// A converter samples an input to which nothing modelled is connected.
    UnconnectedInput,
}

/// An access that stops the emulation.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Refused {
    /// What is wrong with it.
    pub cause: Cause,
    /// Where.
    pub address: u32,
    /// What was written; nothing for a read.
    pub written: Option<u32>,
}

impl fmt::Display for Refused {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { cause, address, written } = self;
        match written {
            Some(value) => write!(f, "write of {value:#010x} to {address:#010x}: {cause:?}"),
            None => write!(f, "read of {address:#010x}: {cause:?}"),
        }
    }
}

/// What the firmware does that the data sheet forbids, but that the emulation can go on with.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Violation {
    /// The core's clock is above 150 MHz without the regulator's boost mode (DS12589, general operating conditions).
    NoBoost,
    /// The flash has too few wait states for the clock (RM0440, number of wait states).
    WaitStates,
}

/// A violation, and for how long.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Violated {
    /// What was violated.
    pub violation: Violation,
    /// From when on (s).
    pub from: f64,
    /// Until when (s); nothing if it goes on.
    pub to: Option<f64>,
}

/// The bridge's main output enable changed.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Switched {
    /// When (s).
    pub time: f64,
    /// Whether it is on since.
    pub is_on: bool,
}

/// The microcontroller's blocks, and what is wired to its pins.
pub struct Chip<W> {
    now: Tick,
    /// The core's clock; nothing while it stands still.
    cycle: Option<Tick>,
    rcc: Rcc,
    pwr: pwr::Pwr,
    flash: flash::Flash,
    gpio: [Gpio; 3],
    tim1: tim1::Tim1,
    tim3: Tim,
    tim4: tim4::Tim4,
    tim15: Tim,
    adc: [Adc; 2],
    adc_common: adc::Common,
    opamps: opamp::Opamps,
    comp: comp::Comp,
    comparator_look: Tick,
    dac: dac::Dac,
    dma: dma::Dma,
    usart: usart::Usart,
    iwdg: iwdg::Iwdg,
    syscfg: syscfg::Syscfg,
    dbgmcu: dbgmcu::Dbgmcu,
    is_locked_up: bool,
    has_flash_error: bool,
    gates: Gates,
    last_active: Tick,
    switched: Vec<Switched>,
    violations: Vec<Violated>,
    refused: Option<Refused>,
    /// For DMA.
    memory: Memory,
    /// What is wired to its pins.
    pub world: W,
}

/// Interrupts (RM0440, vector table), from the blocks that are modelled.
mod interrupt {
    pub const DMA1_CH1: usize = 11;
    pub const ADC1_2: usize = 18;
    pub const TIM1_BRK_TIM15: usize = 24;
    pub const TIM1_UP_TIM16: usize = 25;
    pub const TIM3: usize = 29;
    pub const USART2: usize = 38;
}

impl<W: World> Chip<W> {
    /// Without power.
    pub fn new(memory: Memory, cells: Cells, line: Line, world: W) -> Self {
        Self {
            now: 0,
            cycle: None,
            rcc: Rcc::new(0, Reset::Power, false),
            pwr: pwr::Pwr::new(),
            flash: flash::Flash::new(cells),
            gpio: [0, 1, 2].map(Gpio::new),
            tim1: tim1::Tim1::new(),
            tim3: Tim::new(),
            tim4: tim4::Tim4::new(),
            tim15: Tim::new(),
            adc: [Adc::new(), Adc::new()],
            adc_common: adc::Common::new(),
            opamps: opamp::Opamps::new(),
            comp: comp::Comp::new(),
            comparator_look: NEVER,
            dac: dac::Dac::new(),
            dma: dma::Dma::new(),
            usart: usart::Usart::new(line),
            iwdg: iwdg::Iwdg::new(),
            syscfg: syscfg::Syscfg::new(),
            dbgmcu: dbgmcu::Dbgmcu::new(),
            is_locked_up: false,
            has_flash_error: false,
            gates: Gates::OFF,
            last_active: 0,
            switched: Vec::new(),
            violations: Vec::new(),
            refused: None,
            memory,
            world,
        }
    }

    /// Resets everything but flash and line.
    pub fn reset(&mut self, reset: Reset) {
        let was_on = self.tim1.main_output();
        self.rcc = Rcc::new(self.rcc.flags(), reset, self.rcc.is_crystal_broken());
        let flash = core::mem::replace(&mut self.flash, flash::Flash::new(Cells::new()));
        self.flash = flash::Flash::new(flash.interrupted());
        let usart = core::mem::replace(&mut self.usart, usart::Usart::new(Line::new(1)));
        self.usart = usart::Usart::new(usart.into_line());
        self.pwr = pwr::Pwr::new();
        self.gpio = [0, 1, 2].map(Gpio::new);
        self.tim1.reset();
        self.tim3 = Tim::new();
        self.tim4 = tim4::Tim4::new();
        self.tim15 = Tim::new();
        self.adc = [Adc::new(), Adc::new()];
        self.adc_common = adc::Common::new();
        self.opamps = opamp::Opamps::new();
        self.comp = comp::Comp::new();
        self.comparator_look = NEVER;
        self.dac = dac::Dac::new();
        self.dma = dma::Dma::new();
        self.iwdg = iwdg::Iwdg::new();
        self.syscfg = syscfg::Syscfg::new();
        self.dbgmcu = dbgmcu::Dbgmcu::new();
        self.is_locked_up = false;
        self.has_flash_error = false;
        self.cycle = self.rcc.cycle();
        self.show_flash();
        self.update_gates();
        self.note_switch(was_on);
    }

    // For the board

    /// Ticks of a cycle of the core's clock; nothing while it stands still.
    pub fn cycle(&self) -> Option<Tick> {
        self.cycle
    }

    /// Until when the core stands still because the flash it runs from is busy.
    pub fn stalled_until(&self) -> Option<Tick> {
        self.flash.busy_until()
    }

    /// Levels of the interrupts, a bit each.
    pub fn interrupts(&self) -> u64 {
        let level = |number: usize, is_high: bool| u64::from(is_high) << number;
        let dma = (0..dma::CHANNELS)
            .map(|channel| level(interrupt::DMA1_CH1 + channel, self.dma.interrupts(channel)))
            .fold(0, |all, one| all | one);
        let break_or_tim15 = self.tim1.interrupts_on_break() || self.tim15.interrupts();
        dma | level(interrupt::ADC1_2, self.adc.iter().any(Adc::interrupts))
            | level(interrupt::TIM1_BRK_TIM15, break_or_tim15)
            | level(interrupt::TIM1_UP_TIM16, self.tim1.interrupts_on_update())
            | level(interrupt::TIM3, self.tim3.interrupts())
            | level(interrupt::USART2, self.usart.interrupts())
    }

    /// Level of the non-maskable interrupt.
    pub fn nmi(&self) -> bool {
        self.rcc.nmi() || self.flash.nmi()
    }

    /// When the watchdog resets the microcontroller.
    pub fn watchdog(&self) -> Tick {
        self.iwdg.expires()
    }

    /// An access that could not be made, if there was one.
    pub fn refused(&self) -> Option<Refused> {
        self.refused
    }

    /// What the firmware did that the data sheet forbids.
    pub fn violations(&self) -> &[Violated] {
        &self.violations
    }

    /// What the gates are told.
    pub fn gates(&self) -> Gates {
        self.gates
    }

    /// Main output enable of the bridge's timer.
    pub fn main_output(&self) -> bool {
        self.tim1.main_output()
    }

    /// When a gate last was on.
    pub fn last_active(&self) -> Tick {
        if self.gates == Gates::OFF { self.last_active } else { self.now }
    }

    /// When the main output enable changed.
    pub fn switched(&self) -> &[Switched] {
        &self.switched
    }

    /// The other end of the serial line.
    pub fn line(&mut self) -> &mut Line {
        self.usart.line()
    }

    /// The flash's cells.
    pub fn cells(&self) -> &Cells {
        self.flash.cells()
    }

    /// Changes the flash's cells.
    pub fn change_cells(&mut self, change: impl FnOnce(&mut Cells)) {
        change(self.flash.cells_mut());
        self.show_flash();
    }

    /// The core locks up: a break, where SYSCFG connects it.
    pub fn lock_up(&mut self) {
        self.is_locked_up = true;
        self.follow();
    }

    /// The crystal breaks.
    pub fn break_crystal(&mut self) {
        self.rcc.break_crystal(self.now);
        self.follow_clock();
        self.follow();
    }

    /// TIM15 goes on by so many ticks at once.
    pub fn skip_tim15(&mut self, ticks: u32) {
        if let Some(cycle) = self.cycle {
            self.tim15.skip(ticks, self.now, cycle);
        }
    }

    /// The counter of the bridge's timer breaks.
    pub fn stop_bridge_timer(&mut self) {
        self.tim1.get_stuck();
    }

    // Time

    /// When something happens next.
    pub fn next_event(&self) -> Tick {
        let watchdog = self.iwdg.expires();
        let Some(cycle) = self.cycle else { return watchdog };
        watchdog
            .min(self.tim1.next_event(cycle))
            .min(self.tim3.next_event(cycle))
            .min(self.tim15.next_event(cycle))
            .min(self.adc[0].next_event())
            .min(self.adc[1].next_event())
            .min(self.usart.next_event())
            .min(self.flash.next_event())
            .min(self.comparator_look)
    }

    /// Plays everything that happens up to a time.
    pub fn advance(&mut self, to: Tick) {
        if let Some(cycle) = self.cycle {
            loop {
                let next = self.next_event();
                // The watchdog's reset is the board's business.
                if next > to || next >= self.iwdg.expires() {
                    break;
                }
                self.now = self.now.max(next);
                self.play(cycle);
            }
        }
        self.now = self.now.max(to);
    }

    fn play(&mut self, cycle: Tick) {
        let now = self.now;
        let is_due = |next: Tick| next <= now;
        // Before TIM1, which may write to TIM3 by DMA in the very cycle in which that reaches its compare value.
        if is_due(self.tim3.next_event(cycle)) {
            self.tim3.advance(now, cycle);
            if self.tim3.take_request() {
                self.serve(Request::Tim3Ch1);
            }
        }
        if is_due(self.tim1.next_event(cycle)) {
            let was_on = self.tim1.main_output();
            self.tim1.advance(now, cycle);
            self.follow_tim1();
            self.note_switch(was_on);
        }
        if is_due(self.tim15.next_event(cycle)) {
            self.tim15.advance(now, cycle);
        }
        for number in [0, 1] {
            if is_due(self.adc[number].next_event()) {
                self.convert(number, cycle);
            }
        }
        if is_due(self.usart.next_event()) {
            let connected = [self.is_alternate(1, 3, 7), self.is_alternate(1, 4, 7)];
            self.usart.advance(now, cycle, connected);
        }
        if is_due(self.flash.next_event()) {
            self.flash.advance(now);
            self.show_flash();
        }
        if is_due(self.comparator_look) {
            self.look_at_comparator(cycle);
        }
    }

    /// What TIM1 does for others.
    fn follow_tim1(&mut self) {
        let effects = self.tim1.take_effects();
        if effects.request {
            self.serve(Request::Tim1Ch4);
        }
        if effects.trgo {
            self.tim3.trigger(self.now);
            if self.tim3.take_request() {
                self.serve(Request::Tim3Ch1);
            }
        }
        if let Some(cycle) = self.adc_cycle().filter(|_| effects.trgo2) {
            self.adc.iter_mut().for_each(|adc| adc.trigger(self.now, cycle));
        }
        self.update_gates();
    }

    fn adc_cycle(&self) -> Option<Tick> {
        self.adc_common.cycle(self.cycle?)
    }

    fn convert(&mut self, number: usize, cycle: Tick) {
        let cycle = self.adc_common.cycle(cycle).unwrap_or(cycle);
        if let Some(channel) = self.adc[number].advance(self.now, cycle) {
            match self.input(number, channel) {
                Some(voltage) => self.adc[number].hold(voltage),
                None => {
                    let address = map::ADC1 + 0x100 * number as u32;
                    self.refuse(Cause::UnconnectedInput, address, Some(channel));
                }
            }
        }
    }

    /// Voltage at a converter's input.
    fn input(&mut self, number: usize, channel: u32) -> Option<f64> {
        match (number, channel) {
            (_, 1) => Some(self.pin(AnaloguePin::BusVoltage)),
            (0, 5) => Some(self.pin(AnaloguePin::Temperature)),
            (0, 11) => Some(self.pin(AnaloguePin::Potentiometer)),
            (0, 3) if !self.opamps.is_internal(0) => self.amplified(0),
            (0, 12) if !self.opamps.is_internal(2) => self.amplified(2),
            (0, 13) if self.opamps.is_internal(0) => self.amplified(0),
            (1, 3) if !self.opamps.is_internal(1) => self.amplified(1),
            (1, 16) if self.opamps.is_internal(1) => self.amplified(1),
            (1, 18) if self.opamps.is_internal(2) => self.amplified(2),
            _ => None,
        }
    }

    fn pin(&mut self, pin: AnaloguePin) -> f64 {
        self.world.voltage(seconds(self.now), pin)
    }

    /// Output of an operational amplifier (V). Its bias, at VINM0, is a shunt's grounded end.
    fn amplified(&mut self, amplifier: usize) -> Option<f64> {
        use AnaloguePin::{ShuntU, ShuntV, ShuntW};
        let (input, gain) = self.opamps.stage(amplifier)?;
        let pin = match (amplifier, input) {
            (0, 0) | (2, 2) => ShuntU,
            (1, 0) | (0, 2) => ShuntV,
            (2, 0) | (1, 2) => ShuntW,
            _ => return None,
        };
        Some((gain * self.pin(pin)).clamp(0.0, SUPPLY))
    }

    fn look_at_comparator(&mut self, cycle: Tick) {
        let plus = match self.comp.input() {
            Some(0) => Some(self.pin(AnaloguePin::ShuntU)),
            // PB1, which OPAMP3 drives.
            Some(_) if !self.opamps.is_internal(2) => self.amplified(2),
            _ => None,
        };
        if let (Some(plus), Some(minus)) = (plus, self.dac.output()) {
            self.comp.compare(plus, minus);
        }
        self.tim1.compare(self.comp.output(), self.now, cycle);
        // While TIM1's filter samples, as often as it does.
        let look = if self.tim1.is_filtering() { 16 * cycle } else { COMPARATOR_LOOK };
        self.comparator_look = if self.comp.input().is_some() { self.now + look } else { NEVER };
    }

    // DMA

    fn serve(&mut self, request: Request) {
        let is_on = [rcc::Gate::DMA1, rcc::Gate::DMAMUX1].iter().all(|gate| self.rcc.is_on(*gate));
        let Some(Transfer { from, to }) = is_on.then(|| self.dma.request(request)).flatten() else {
            return;
        };
        let value = match self.memory.read(from.0, from.1) {
            Some(value) => value,
            None => self.read(from.0, from.1),
        };
        if !self.memory.write(to.0, to.1, value) {
            self.write(to.0, to.1, value);
        }
    }

    // Pins

    fn is_alternate(&self, port: usize, pin: u32, function: u32) -> bool {
        self.gpio[port].drive(pin) == Drive::Alternate(function)
    }

    fn encoder_edges(&mut self) -> i64 {
        let is_connected = self.is_alternate(1, 6, 2) && self.is_alternate(1, 7, 2);
        if is_connected { self.world.encoder_edges(seconds(self.now)) } else { 0 }
    }

    /// Levels at a port's pins.
    fn levels(&mut self, port: usize) -> u32 {
        (0..16).fold(0, |levels, pin| {
            let level = match (self.gpio[port].drive(pin), port, pin) {
                (Drive::Analogue, ..) => false,
                (Drive::Output(level), ..) => level,
                (Drive::Input, 2, 10) => {
                    self.world.level(seconds(self.now), crate::world::InputPin::Button)
                }
                _ => self.gpio[port].pull(pin),
            };
            levels | u32::from(level) << pin
        })
    }

    /// Level at the input of a gate driver; drivers pull what nobody drives low.
    fn gate(&self, port: usize, pin: u32, function: u32, timer: Option<bool>) -> bool {
        let gpio = &self.gpio[port];
        match gpio.drive(pin) {
            Drive::Output(level) => level,
            Drive::Alternate(alternate) if alternate == function => {
                timer.unwrap_or_else(|| gpio.pull(pin))
            }
            Drive::Input => gpio.pull(pin),
            Drive::Alternate(_) | Drive::Analogue => false,
        }
    }

    fn update_gates(&mut self) {
        let now = self.now;
        let outputs = |channel| match self.cycle {
            Some(cycle) => self.tim1.outputs(channel, now, cycle),
            None => [None; 2],
        };
        // Port, pin and alternate function of TIM1_CHx and TIM1_CHxN (DS12589, table 13).
        let [u, v, w] = [
            (0, [(0, 8, 6), (2, 13, 4)]),
            (1, [(0, 9, 6), (0, 12, 6)]),
            (2, [(0, 10, 6), (1, 15, 4)]),
        ]
        .map(|(channel, [high, low])| {
            let [timer_high, timer_low] = outputs(channel);
            let level = |(port, pin, function), timer| self.gate(port, pin, function, timer);
            [level(high, timer_high), level(low, timer_low)]
        });
        let gates = Gates { high: [u[0], v[0], w[0]], low: [u[1], v[1], w[1]] };
        if gates != self.gates {
            if self.gates != Gates::OFF {
                self.last_active = now;
            }
            self.gates = gates;
            self.world.switch(seconds(now), gates);
        }
    }

    fn note_switch(&mut self, was_on: bool) {
        let is_on = self.tim1.main_output();
        if is_on != was_on {
            self.switched.push(Switched { time: seconds(self.now), is_on });
        }
    }

    // What connects blocks

    /// Breaks, which the system asks TIM1 for.
    fn follow(&mut self) {
        let Some(cycle) = self.cycle else { return };
        let was_on = self.tim1.main_output();
        self.has_flash_error |= self.flash.take_error();
        let asks = self.rcc.nmi()
            || self.is_locked_up && self.syscfg.breaks_on_lock_up()
            || self.has_flash_error && self.syscfg.breaks_on_flash_error();
        self.has_flash_error &= self.flash.nmi();
        self.tim1.break_by_system(asks, self.now, cycle);
        self.update_gates();
        self.note_switch(was_on);
    }

    /// The clock may have changed.
    fn follow_clock(&mut self) {
        let before = core::mem::replace(&mut self.cycle, self.rcc.cycle());
        if let (Some(before), Some(after)) = (before, self.cycle)
            && before != after
        {
            self.tim1.rescale(self.now, before, after);
            self.tim3.rescale(self.now, before, after);
            self.tim15.rescale(self.now, before, after);
        }
        let Some(cycle) = self.cycle else { return };
        let megahertz = MICROSECOND as f64 / cycle as f64;
        // 30 MHz a wait state without boost, 34 MHz with it.
        let limit = if self.pwr.is_boosted() { 34.0 } else { 30.0 };
        let violation = if megahertz > 150.0 && !self.pwr.is_boosted() {
            Some(Violation::NoBoost)
        } else if megahertz > limit * f64::from(self.flash.latency() + 1) {
            Some(Violation::WaitStates)
        } else {
            None
        };
        let open = self.violations.last_mut().filter(|violated| violated.to.is_none());
        if open.as_ref().map(|violated| violated.violation) != violation {
            if let Some(violated) = open {
                violated.to = Some(seconds(self.now));
            }
            let from = seconds(self.now);
            self.violations.extend(violation.map(|violation| Violated {
                violation,
                from,
                to: None,
            }));
        }
    }

    /// Brings the core's view of the flash up to date.
    fn show_flash(&mut self) {
        if let Some(range) = self.flash.take_changed() {
            let bytes = &self.flash.cells().bytes()[range.clone()];
            self.memory.show_flash(range.start, bytes);
        }
    }

    // The core's accesses

    fn refuse(&mut self, cause: Cause, address: u32, written: Option<u32>) {
        self.refused.get_or_insert(Refused { cause, address, written });
    }

    /// Reads so many bytes.
    pub fn read(&mut self, address: u32, size: usize) -> u32 {
        if let Some(offset) = flash_offset(address) {
            let mut bytes = [0; 4];
            self.flash.read_cells(offset, &mut bytes[..size]);
            self.follow();
            return u32::from_le_bytes(bytes);
        }
        let word = match self.read_register(address & !3) {
            Ok(word) => word,
            Err(cause) => {
                self.refuse(cause, address, None);
                0
            }
        };
        let value = word >> (8 * (address & 3));
        if size == 4 { value } else { value & ((1 << (8 * size)) - 1) }
    }

    /// Writes so many bytes. The bridges to the APBs make words of less by repetition (RM0440, chapter *Direct memory access controller*).
    pub fn write(&mut self, address: u32, size: usize, value: u32) {
        if let Some(offset) = flash_offset(address) {
            self.flash.write_cells(offset, size, value, self.now);
            return;
        }
        let value = match size {
            4 => value,
            2 => value & 0xffff | value << 16,
            _ => value & 0xff | (value & 0xff) << 8 | (value & 0xff) << 16 | value << 24,
        };
        let is_apb = address < 0x4002_0000;
        let written = if size < 4 && !is_apb {
            Err(Cause::Unmodelled)
        } else {
            self.write_register(address & !3, value)
        };
        if let Err(cause) = written {
            self.refuse(cause, address, Some(value));
        }
    }
}

/// Offset of an address in the flash.
fn flash_offset(address: u32) -> Option<usize> {
    let offset = address.wrapping_sub(flash::BASE) as usize;
    (offset < flash::SIZE).then_some(offset)
}

impl From<Unmodelled> for Cause {
    fn from(Unmodelled: Unmodelled) -> Self {
        Self::Unmodelled
    }
}
