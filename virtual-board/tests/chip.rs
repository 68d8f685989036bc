//! The blocks' registers, by what they do to pins, interrupts and each other. Clock: the internal oscillator, 85 ticks a cycle, where nothing
//! else is said.
#![allow(clippy::panic, reason = "a test's way to fail with the reason")]

use virtual_board::World;
use virtual_board::chip::{Cause, Cells, Chip, Line, Reset};
use virtual_board::memory::{Memory, SRAM};
use virtual_board::time::{MICROSECOND, NEVER, SECOND, Tick, seconds, ticks};
use virtual_board::world::{AnaloguePin, Gates, InputPin};

const RCC: u32 = 0x4002_1000;
const FLASH: u32 = 0x4002_2000;
const TIM1: u32 = 0x4001_2c00;
const TIM3: u32 = 0x4000_0400;
const TIM4: u32 = 0x4000_0800;
const TIM15: u32 = 0x4001_4000;
const ADC1: u32 = 0x5000_0000;
const ADC2: u32 = 0x5000_0100;
const SYSCFG: u32 = 0x4001_0000;
const COMP1: u32 = 0x4001_0200;
const OPAMP1: u32 = 0x4001_0300;
const OPAMP3: u32 = 0x4001_0308;
const DAC3: u32 = 0x5000_1000;
const DMA1: u32 = 0x4002_0000;
const DMAMUX1: u32 = 0x4002_0800;
const USART2: u32 = 0x4000_4400;
const IWDG: u32 = 0x4000_3000;
const PWR: u32 = 0x4000_7000;
const GPIOA: u32 = 0x4800_0000;
const GPIOB: u32 = 0x4800_0400;
const GPIOC: u32 = 0x4800_0800;

/// A cycle of the internal oscillator.
const CYCLE: Tick = 85;

/// Writes down what is asked of it.
struct Recorder {
    switches: Vec<(Tick, Gates)>,
    looks: Vec<(Tick, AnaloguePin)>,
    shunt: f64,
    edges: i64,
}

impl World for Recorder {
    fn switch(&mut self, time: f64, gates: Gates) {
        self.switches.push((ticks(time), gates));
    }

    fn voltage(&mut self, time: f64, pin: AnaloguePin) -> f64 {
        self.looks.push((ticks(time), pin));
        match pin {
            AnaloguePin::ShuntU => self.shunt,
            AnaloguePin::BusVoltage => 1.65,
            _ => 0.1,
        }
    }

    fn encoder_edges(&mut self, _time: f64) -> i64 {
        self.edges
    }

    fn level(&mut self, _time: f64, _pin: InputPin) -> bool {
        true
    }
}

/// A chip of which each access must be one that is modelled.
struct Bench {
    chip: Chip<Recorder>,
    memory: Memory,
    now: Tick,
}

impl Bench {
    /// Powered, with every block's clock on.
    fn new() -> Self {
        let world = Recorder { switches: Vec::new(), looks: Vec::new(), shunt: 0.1286, edges: 0 };
        let memory = Memory::new();
        let mut chip = Chip::new(memory.clone(), Cells::new(), Line::new(921_600), world);
        chip.reset(Reset::Power);
        let mut bench = Self { chip, memory, now: 0 };
        bench.switch_clocks_on();
        bench
    }

    fn switch_clocks_on(&mut self) {
        for (register, value) in
            [(0x48, 0x105), (0x4c, 0x42007), (0x58, 0x1002_0006), (0x60, 0x0001_0801)]
        {
            self.write(RCC + register, value);
        }
    }

    fn write(&mut self, address: u32, value: u32) {
        self.chip.write(address, 4, value);
        assert_eq!(self.chip.refused(), None);
    }

    fn read(&mut self, address: u32) -> u32 {
        let value = self.chip.read(address, 4);
        assert_eq!(self.chip.refused(), None);
        value
    }

    fn modify(&mut self, address: u32, change: impl FnOnce(u32) -> u32) {
        let value = self.read(address);
        self.write(address, change(value));
    }

    /// Why a write is refused.
    fn refuses(mut self, address: u32, value: u32) -> Cause {
        self.chip.write(address, 4, value);
        let refused = self.chip.refused().expect("an access to be refused");
        assert_eq!((refused.address, refused.written), (address, Some(value)));
        refused.cause
    }

    fn run(&mut self, time: Tick) {
        self.now += time;
        self.chip.advance(self.now);
        assert_eq!(self.chip.refused(), None);
    }

    /// Mode and, for an alternate function, its number.
    fn pin(&mut self, port: u32, number: u32, mode: u32, function: u32) {
        let afr = port + 0x20 + number / 8 * 4;
        self.modify(afr, |afr| afr & !(0xf << (number % 8 * 4)) | function << (number % 8 * 4));
        self.modify(port, |moder| moder & !(3 << (2 * number)) | mode << (2 * number));
    }

    /// TIM1 on U and V as the firmware has it, but shorter: up to 100 and back in 200 cycles, dead time 10 cycles, compare value 60.
    fn start_bridge(&mut self) {
        self.write(TIM1 + 0x60, 2); // AF1: BKCMP1E
        self.write(TIM1 + 0x44, 10 | 3 << 10 | 3 << 12); // BDTR: DTG, OSSI, OSSR, BKE, BKP
        self.write(TIM1, 0xa0); // CR1: ARPE, CMS = 1
        self.write(TIM1 + 0x04, 2 << 4 | 7 << 20); // CR2: MMS, MMS2
        self.write(TIM1 + 0x2c, 100);
        self.write(TIM1 + 0x18, 0x7878); // PWM mode 2, preload
        self.write(TIM1 + 0x1c, 0x6000); // channel 4: PWM mode 1
        self.write(TIM1 + 0x34, 60);
        self.write(TIM1 + 0x38, 60);
        self.write(TIM1 + 0x40, 20);
        self.write(TIM1 + 0x20, 0x55); // CCER: both sides
        self.write(TIM1 + 0x30, 1);
        self.write(TIM1 + 0x14, 1);
        self.write(TIM1, 0xa1);
        self.pin(GPIOA, 8, 2, 6);
        self.pin(GPIOC, 13, 2, 4);
        self.pin(GPIOA, 9, 2, 6);
        self.pin(GPIOA, 12, 2, 6);
    }

    fn switch_on(&mut self) {
        self.modify(TIM1 + 0x44, |bdtr| bdtr | 1 << 15);
    }

    fn main_output(&mut self) -> bool {
        self.read(TIM1 + 0x44) & 1 << 15 != 0
    }

    /// When U's gates changed, in cycles from a time on: high side, low side.
    fn edges_of_u(&self, from: Tick) -> Vec<(Tick, bool, bool)> {
        let after = self.chip.world.switches.iter().filter(|(time, _)| *time >= from);
        after.map(|(time, gates)| ((time - from) / CYCLE, gates.high[0], gates.low[0])).collect()
    }

    fn start_amplifiers(&mut self) {
        let biased_by_16 = 1 | 2 << 5 | 0b01011 << 14;
        self.write(OPAMP1, biased_by_16);
        self.write(OPAMP1 + 4, biased_by_16);
        self.write(OPAMP3, biased_by_16 | 2 << 2);
    }

    fn start_converter(&mut self, converter: u32) {
        self.write(converter + 0x08, 0);
        self.write(converter + 0x08, 1 << 28);
        self.run(20 * MICROSECOND);
        self.modify(converter + 0x08, |cr| cr | 1 << 31);
        while self.read(converter + 0x08) & 1 << 31 != 0 {
            self.run(MICROSECOND);
        }
        self.modify(converter + 0x08, |cr| cr | 1);
        self.run(MICROSECOND);
        assert_eq!(self.read(converter) & 1, 1, "ADRDY");
    }

    fn unlock_flash(&mut self) {
        self.write(FLASH + 0x08, 0x4567_0123);
        self.write(FLASH + 0x08, 0xcdef_89ab);
    }

    fn program(&mut self, address: u32, words: [u32; 2]) -> u32 {
        self.write(FLASH + 0x14, 1);
        self.write(address, words[0]);
        self.write(address + 4, words[1]);
        self.run(100 * MICROSECOND);
        self.read(FLASH + 0x10)
    }
}

#[test]
fn dead_time_delays_the_switch_that_turns_on_at_both_edges() {
    let mut bench = Bench::new();
    bench.start_bridge();
    // Two periods to come into step.
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.run(200 * CYCLE);
    let from = bench.now;
    bench.run(200 * CYCLE);
    let edges = bench.edges_of_u(from);
    // Up through 60: low side off, high side after the dead time. Down through 60 the counter is at 60 after 40 cycles of 100: there the
    // high side goes off.
    let expected = [(60, false, false), (70, true, false), (140, false, false), (150, false, true)];
    assert_eq!(edges, expected);
}

#[test]
fn a_pulse_shorter_than_the_dead_time_is_swallowed() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.write(TIM1 + 0x34, 96);
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.run(200 * CYCLE);
    let from = bench.now;
    bench.run(200 * CYCLE);
    let edges = bench.edges_of_u(from);
    assert!(edges.iter().all(|(_, high, _)| !high), "{edges:?}");
}

#[test]
fn compare_values_wait_for_the_update_at_the_trough() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.run(250 * CYCLE);
    // In the middle of a period: from the next one on.
    let from = bench.now - 50 * CYCLE;
    bench.write(TIM1 + 0x34, 80);
    bench.run(400 * CYCLE);
    let on: Vec<_> = bench.edges_of_u(from).into_iter().filter(|edge| edge.1).collect();
    let times: Vec<_> = on.iter().map(|edge| edge.0).filter(|time| *time < 400).collect();
    // Other legs' edges are among them.
    assert!(times.contains(&70) && times.contains(&290) && !times.contains(&270), "{times:?}");
}

#[test]
fn a_repetition_counter_of_one_updates_at_the_trough_only() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.write(TIM1 + 0x10, 0);
    for half in 1..=6 {
        bench.run(100 * CYCLE);
        let is_at_trough = half % 2 == 0;
        assert_eq!(bench.read(TIM1 + 0x10) & 1 == 1, is_at_trough);
        assert_eq!(bench.read(TIM1) & 1 << 4 == 0, is_at_trough, "DIR");
        bench.write(TIM1 + 0x10, 0);
    }
}

#[test]
fn the_low_side_alone_follows_the_reference_itself() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.write(TIM1 + 0x20, 0x44);
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.run(200 * CYCLE);
    let from = bench.now;
    bench.run(200 * CYCLE);
    assert_eq!(bench.edges_of_u(from), [(60, false, true), (140, false, false)]);
}

#[test]
fn disabled_outputs_are_low_if_driven_and_as_pulled_if_not() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.modify(GPIOA + 0x0c, |pupdr| pupdr | 1 << 16);
    bench.run(1000 * CYCLE);
    assert_eq!(bench.chip.gates(), Gates::OFF, "OSSI = 1");
    bench.modify(TIM1 + 0x44, |bdtr| bdtr & !(1 << 10));
    assert!(bench.chip.gates().high[0], "OSSI = 0, and a pull-up");
}

#[test]
fn idle_states_come_after_the_dead_time() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.modify(TIM1 + 0x04, |cr2| cr2 | 2 << 8); // OIS1N
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.run(200 * CYCLE + 100 * CYCLE);
    assert!(bench.chip.gates().high[0]);
    let from = bench.now;
    bench.modify(TIM1 + 0x44, |bdtr| bdtr & !(1 << 15));
    bench.run(50 * CYCLE);
    assert_eq!(bench.edges_of_u(from), [(0, false, false), (10, false, true)]);
}

#[test]
fn the_comparator_ends_the_outputs_and_holds_them_until_it_is_gone() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.start_amplifiers();
    bench.modify(TIM1 + 0x44, |bdtr| bdtr | 12 << 16); // BKF: 128 cycles
    bench.write(DAC3 + 0x3c, 3);
    bench.write(DAC3 + 0x08, 3800);
    bench.write(DAC3, 1);
    bench.write(COMP1, 1 | 4 << 4 | 1 << 8);
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.run(2000 * CYCLE);
    assert!(bench.main_output());
    // Threshold 3.06 V: 0.1914 V at the shunt.
    bench.chip.world.shunt = 0.195;
    let from = bench.now;
    while bench.main_output() {
        bench.run(CYCLE);
        assert!(
            bench.now - from < 5 * MICROSECOND + 150 * CYCLE,
            "the comparator's look and the filter"
        );
    }
    assert!(bench.now - from >= 128 * CYCLE);
    assert_eq!(bench.chip.gates(), Gates::OFF);
    assert_eq!(bench.read(TIM1 + 0x10) & 1 << 7, 1 << 7, "BIF");
    bench.switch_on();
    assert!(!bench.main_output(), "as long as the break is active");
    bench.chip.world.shunt = 0.1286;
    bench.run(10 * MICROSECOND);
    bench.switch_on();
    assert!(bench.main_output());
}

#[test]
fn a_glitch_shorter_than_the_filter_is_no_break() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.start_amplifiers();
    bench.modify(TIM1 + 0x44, |bdtr| bdtr | 12 << 16);
    bench.write(DAC3 + 0x3c, 3);
    bench.write(DAC3 + 0x08, 3800);
    bench.write(DAC3, 1);
    bench.write(COMP1, 1 | 4 << 4 | 1 << 8);
    bench.run(400 * CYCLE);
    bench.switch_on();
    bench.chip.world.shunt = 0.195;
    bench.run(5 * MICROSECOND + 30 * CYCLE);
    bench.chip.world.shunt = 0.1286;
    bench.run(100 * MICROSECOND);
    assert!(bench.main_output());
}

#[test]
fn locks_hold_what_they_are_to_hold() {
    let mut bench = Bench::new();
    bench.start_bridge();
    bench.modify(TIM1 + 0x44, |bdtr| bdtr | 2 << 8);
    let locked = bench.read(TIM1 + 0x44);
    bench.write(TIM1 + 0x44, 1 << 15);
    assert_eq!(bench.read(TIM1 + 0x44), locked | 1 << 15, "all but MOE");
    bench.modify(TIM1 + 0x04, |cr2| cr2 | 3 << 8);
    assert_eq!(bench.read(TIM1 + 0x04) & 3 << 8, 0, "idle states");
    bench.write(TIM1 + 0x20, 0xff);
    assert_eq!(bench.read(TIM1 + 0x20), 0x55, "polarities");
    bench.write(TIM1 + 0x60, 0);
    assert_eq!(bench.read(TIM1 + 0x60), 2, "break inputs");
}

#[test]
fn a_core_that_locks_up_ends_the_outputs_where_it_is_connected() {
    for is_connected in [false, true] {
        let mut bench = Bench::new();
        bench.start_bridge();
        bench.write(SYSCFG + 0x1c, u32::from(is_connected));
        bench.write(SYSCFG + 0x1c, 0);
        assert_eq!(bench.read(SYSCFG + 0x1c), u32::from(is_connected), "until reset");
        bench.switch_on();
        bench.chip.lock_up();
        assert_eq!(bench.main_output(), !is_connected);
    }
}

#[test]
fn both_converters_hold_at_the_end_of_their_sampling_time() {
    let mut bench = Bench::new();
    bench.start_amplifiers();
    bench.write(ADC1 + 0x308, 3 << 16); // a cycle of theirs is four
    for converter in [ADC1, ADC2] {
        bench.start_converter(converter);
        bench.write(converter + 0x14, 2 << 9 | 5 << 3); // channel 3: 12.5, 1: 92.5 cycles
    }
    let by_trgo2 = 8 << 2 | 1 << 7;
    bench.write(ADC1 + 0x4c, by_trgo2 | 1 | 3 << 9 | 1 << 15);
    bench.write(ADC2 + 0x4c, by_trgo2 | 3 << 9);
    bench.write(ADC1 + 0x04, 1 << 6);
    let begin = bench.now;
    // Which begins with OC4REF active: a trigger, for which nobody waits yet.
    bench.start_bridge();
    for converter in [ADC1, ADC2] {
        bench.modify(converter + 0x08, |cr| cr | 1 << 3);
    }
    // OC4REF rises 20 cycles before the trough.
    let trigger = begin + 180 * CYCLE;
    let cycle = 4 * CYCLE;
    let hold = trigger + 17 * cycle / 8 + 25 * cycle / 2;
    bench.run(hold - bench.now - 1);
    let looks = |bench: &Bench| {
        let after = bench.chip.world.looks.iter();
        after.filter(|(time, _)| *time > trigger).copied().collect::<Vec<_>>()
    };
    assert_eq!(looks(&bench), []);
    bench.chip.world.shunt = 0.15;
    bench.run(1);
    // What comes later is not in the sample.
    bench.chip.world.shunt = 0.05;
    bench.run(25 * cycle / 2 + 185 * cycle / 2 + 25 * cycle / 2);
    let bus_hold = hold + 25 * cycle / 2 + 185 * cycle / 2;
    let (u, v, bus) = (AnaloguePin::ShuntU, AnaloguePin::ShuntV, AnaloguePin::BusVoltage);
    // ADC2 has begun anew by then.
    let (first, later) = (&looks(&bench)[..2], looks(&bench)[2..].to_vec());
    assert_eq!(first, [(hold, u), (hold, v)]);
    let of_adc1: Vec<_> = later.into_iter().filter(|(_, pin)| *pin != v).collect();
    assert_eq!(of_adc1, [(bus_hold, bus)]);
    let code = |voltage: f64| (voltage / 3.3 * 4096.0).round() as u32;
    assert_eq!(bench.read(ADC1 + 0x80), code(16.0 * 0.15));
    assert_eq!(bench.read(ADC1 + 0x84), 2048);
    assert_eq!(bench.read(ADC2 + 0x80), code(1.6));
    assert_eq!(bench.chip.interrupts() & 1 << 18, 1 << 18);
    bench.write(ADC1, 1 << 5 | 1 << 6);
    assert_eq!(bench.chip.interrupts(), 0);
}

#[test]
fn amplifiers_saturate() {
    let mut bench = Bench::new();
    bench.start_amplifiers();
    bench.write(ADC1 + 0x308, 3 << 16);
    bench.start_converter(ADC1);
    bench.write(ADC1 + 0x4c, 8 << 2 | 1 << 7 | 3 << 9);
    bench.modify(ADC1 + 0x08, |cr| cr | 1 << 3);
    bench.chip.world.shunt = 0.5;
    bench.start_bridge();
    bench.run(300 * CYCLE);
    assert_eq!(bench.read(ADC1 + 0x80), 4095);
}

#[test]
fn converters_want_their_order_of_start() {
    assert_eq!(Bench::new().refuses(ADC1 + 0x08, 1 << 28 | 1 << 29), Cause::Unmodelled);
    let mut bench = Bench::new();
    bench.write(ADC1 + 0x308, 3 << 16);
    bench.write(ADC1 + 0x08, 0);
    bench.write(ADC1 + 0x08, 1 << 28);
    bench.run(19 * MICROSECOND);
    // Calibration before the regulator is up.
    assert_eq!(bench.refuses(ADC1 + 0x08, 1 << 28 | 1 << 31), Cause::Unmodelled);
}

#[test]
fn timers_ask_for_transfers_and_circular_channels_start_anew() {
    let mut bench = Bench::new();
    for pin in [6, 7] {
        bench.pin(GPIOB, pin, 2, 2);
    }
    bench.write(TIM4 + 0x18, 0x0101);
    bench.write(TIM4 + 0x08, 3);
    bench.write(TIM4, 1);
    bench.write(DMAMUX1, 61);
    bench.write(DMA1 + 0x10, TIM4 + 0x24);
    bench.write(DMA1 + 0x14, SRAM + 0x100);
    bench.write(DMA1 + 0x0c, 4);
    bench.write(DMA1 + 0x08, 1 | 1 << 5 | 1 << 7 | 1 << 8 | 1 << 10);
    bench.write(TIM3 + 0x2c, 49);
    bench.write(TIM3 + 0x18, 8);
    bench.write(TIM3 + 0x34, 30);
    bench.write(TIM3 + 0x14, 1);
    bench.write(TIM3 + 0x0c, 1 << 9);
    bench.write(TIM3 + 0x08, 1 << 16);
    bench.start_bridge();
    // TIM3 starts with TIM1's software update, and asks at 30, 80, 130, ...
    for (read, edges) in [5, -3, 70_000, 7, 11].into_iter().enumerate() {
        bench.chip.world.edges = edges;
        bench.run(50 * CYCLE);
        let place = SRAM + 0x100 + 2 * (read as u32 % 4);
        assert_eq!(bench.memory.read(place, 2), Some(edges as u32 & 0xffff));
    }
    assert_eq!(bench.read(DMA1 + 0x0c), 3);
    assert_eq!(bench.read(DMA1) & 7, 7, "half and complete");
    bench.write(DMA1 + 0x04, 1);
    assert_eq!(bench.read(DMA1), 0);
}

#[test]
fn the_encoder_counts_only_with_both_pins_connected() {
    let mut bench = Bench::new();
    bench.write(TIM4 + 0x18, 0x0101);
    bench.write(TIM4 + 0x08, 3);
    bench.write(TIM4, 1);
    bench.chip.world.edges = 9;
    assert_eq!(bench.read(TIM4 + 0x24), 0);
    for pin in [6, 7] {
        bench.pin(GPIOB, pin, 2, 2);
    }
    assert_eq!(bench.read(TIM4 + 0x24), 9);
    bench.chip.world.edges = -1;
    assert_eq!(bench.read(TIM4 + 0x24), 0xffff);
    assert_eq!(bench.read(TIM4) & 1 << 4, 1 << 4, "DIR");
}

#[test]
fn half_words_are_repeated_on_the_peripheral_bus() {
    let mut bench = Bench::new();
    bench.chip.write(TIM15 + 0x34, 2, 0x1234);
    assert_eq!(bench.chip.refused(), None);
    assert_eq!(bench.read(TIM15 + 0x34), 0x1234);
}

#[test]
fn the_time_drivers_timer_sets_flags_that_zeros_clear() {
    let mut bench = Bench::new();
    bench.write(TIM15 + 0x28, 9);
    bench.write(TIM15 + 0x2c, 99);
    bench.write(TIM15 + 0x14, 1);
    bench.write(TIM15 + 0x34, 50);
    bench.write(TIM15 + 0x38, 70);
    bench.write(TIM15 + 0x10, 0);
    bench.write(TIM15 + 0x0c, 0b011);
    bench.write(TIM15, 1);
    bench.run(499 * CYCLE);
    assert_eq!(bench.read(TIM15 + 0x10) & 7, 0);
    bench.run(CYCLE);
    assert_eq!(bench.read(TIM15 + 0x10) & 7, 0b010);
    assert_eq!(bench.chip.interrupts(), 1 << 24);
    bench.write(TIM15 + 0x10, !0b010);
    assert_eq!(bench.chip.interrupts(), 0);
    bench.run(200 * CYCLE);
    assert_eq!(bench.chip.interrupts(), 0, "channel 2 does not interrupt");
    bench.run(300 * CYCLE);
    assert_eq!(bench.read(TIM15 + 0x10) & 7, 0b101);
    assert_eq!(bench.read(TIM15 + 0x24), 0);
}

#[test]
fn flash_programs_erased_cells_only() {
    let mut bench = Bench::new();
    let address = 0x0801_f000;
    bench.chip.write(address, 4, 1);
    assert_eq!(bench.read(FLASH + 0x10) & 1 << 7, 1 << 7, "PGSERR: locked");
    bench.write(FLASH + 0x10, 0xfb);
    bench.unlock_flash();
    assert_eq!(bench.program(address, [0x1234_5678, 0x9abc_def0]), 0);
    assert_eq!(bench.read(address + 4), 0x9abc_def0);
    assert_eq!(bench.program(address, [0, 1]) & 1 << 3, 1 << 3, "PROGERR");
    assert_eq!(bench.read(address), 0x1234_5678);
    bench.write(FLASH + 0x10, 0xfb);
    assert_eq!(bench.program(address, [0, 0]), 0, "all zeros may go over anything");
    // A page is erased, and only that.
    assert_eq!(bench.program(address + 0x800, [7, 7]), 0);
    bench.write(FLASH + 0x14, 1 << 1 | 62 << 3 | 1 << 16);
    assert_eq!(bench.read(FLASH + 0x10) & 1 << 16, 1 << 16, "BSY");
    assert!(bench.chip.stalled_until().is_some());
    bench.run(23_000 * MICROSECOND);
    assert_eq!(bench.read(FLASH + 0x10), 0);
    assert_eq!([bench.read(address), bench.read(address + 0x800)], [!0, 7]);
    // What it holds outlives a reset.
    bench.chip.reset(Reset::Software);
    assert_eq!(bench.chip.read(address + 0x800, 4), 7);
}

#[test]
fn power_that_goes_while_a_double_word_is_written_breaks_it() {
    let mut bench = Bench::new();
    bench.unlock_flash();
    bench.write(FLASH + 0x14, 1);
    bench.write(0x0801_e000, 1);
    bench.write(0x0801_e004, 2);
    bench.run(40 * MICROSECOND);
    bench.chip.reset(Reset::Power);
    bench.switch_clocks_on();
    bench.start_bridge();
    bench.write(SYSCFG + 0x1c, 1 << 3);
    bench.switch_on();
    assert!(!bench.chip.nmi());
    bench.chip.read(0x0801_e000, 4);
    assert!(bench.chip.nmi());
    assert!(!bench.main_output(), "ECCL");
    bench.modify(FLASH + 0x18, |eccr| eccr | 1 << 31);
    assert!(!bench.chip.nmi());
}

#[test]
fn the_watchdog_expires_when_it_is_not_fed() {
    let mut bench = Bench::new();
    bench.write(IWDG, 0x5555);
    bench.write(IWDG + 0x04, 1);
    bench.write(IWDG + 0x08, 199);
    assert_eq!(bench.read(IWDG + 0x0c), 3, "PVU, RVU");
    bench.write(IWDG, 0xcccc);
    // 200 cycles of 32 kHz / 8.
    assert_eq!(bench.chip.watchdog(), SECOND / 20);
    bench.run(SECOND / 40);
    bench.write(IWDG, 0xaaaa);
    assert_eq!(bench.chip.watchdog(), SECOND * 3 / 40);
    assert_eq!(bench.refuses(IWDG + 0x08, 100), Cause::Unmodelled, "protected again");
    assert_eq!(Chip::watchdog(&Bench::new().chip), NEVER);
}

#[test]
fn bytes_take_their_time_on_the_line() {
    let mut bench = Bench::new();
    bench.pin(GPIOB, 3, 2, 7);
    bench.pin(GPIOB, 4, 2, 7);
    bench.write(USART2 + 0x0c, 17); // 941 kbit/s
    bench.write(USART2, 1 | 1 << 2 | 1 << 3 | 1 << 5 | 1 << 29);
    for byte in [0x55, 0xaa] {
        bench.write(USART2 + 0x28, byte);
    }
    bench.run(170 * CYCLE - 1);
    assert_eq!(bench.chip.line().received(), []);
    bench.run(1);
    assert_eq!(bench.chip.line().received(), [0x55]);
    assert_eq!(bench.read(USART2 + 0x1c) & 1 << 6, 0, "TC");
    bench.run(170 * CYCLE);
    assert_eq!(bench.chip.line().received(), [0xaa]);
    assert_eq!(bench.read(USART2 + 0x1c) & 1 << 6, 1 << 6, "TC");
    // The other way. Eight fit, the ninth does not.
    let now = bench.now;
    bench.chip.line().send(&[1, 2, 3, 4, 5, 6, 7, 8, 9], now);
    bench.run(SECOND * 10 / 921_600);
    assert_eq!(bench.read(USART2 + 0x1c) & 1 << 5, 0, "RXNE");
    bench.run(MICROSECOND);
    assert_eq!(bench.chip.interrupts(), 1 << 38);
    bench.run(SECOND / 10_000);
    assert_eq!(bench.read(USART2 + 0x1c) & 1 << 3, 1 << 3, "ORE");
    let read: Vec<_> = (0..8).map(|_| bench.read(USART2 + 0x24)).collect();
    assert_eq!(read, [1, 2, 3, 4, 5, 6, 7, 8]);
    assert_eq!(bench.read(USART2 + 0x1c) & 1 << 5, 0);
}

#[test]
fn a_line_of_another_rate_gives_framing_errors() {
    let mut bench = Bench::new();
    bench.pin(GPIOB, 4, 2, 7);
    bench.write(USART2 + 0x0c, 139); // 115 kbit/s
    bench.write(USART2, 1 | 1 << 2);
    bench.chip.line().send(&[1], 0);
    bench.run(SECOND / 10_000);
    assert_eq!(bench.read(USART2 + 0x1c) & 1 << 1, 1 << 1);
}

/// Crystal and PLL, 170 MHz.
fn start_pll(bench: &mut Bench) {
    bench.modify(RCC, |cr| cr | 1 << 16);
    bench.run(1999 * MICROSECOND);
    assert_eq!(bench.read(RCC) & 1 << 17, 0, "HSERDY");
    bench.run(MICROSECOND);
    assert_eq!(bench.read(RCC) & 1 << 17, 1 << 17);
    bench.write(RCC + 0x0c, 3 | 1 << 4 | 85 << 8 | 1 << 24);
    bench.modify(RCC, |cr| cr | 1 << 24);
    bench.run(40 * MICROSECOND);
    assert_eq!(bench.read(RCC) & 1 << 25, 1 << 25, "PLLRDY");
    bench.modify(FLASH, |acr| acr & !0xf | 4);
    bench.write(RCC + 0x08, 3);
    assert_eq!(bench.read(RCC + 0x08) & 0xf, 0xf, "SWS follows SW");
    assert_eq!(bench.chip.cycle(), Some(8));
}

#[test]
fn a_crystal_that_breaks_ends_the_outputs_by_the_security_system() {
    let mut bench = Bench::new();
    start_pll(&mut bench);
    bench.modify(RCC, |cr| cr | 1 << 19);
    bench.start_bridge();
    bench.run(MICROSECOND);
    bench.switch_on();
    bench.chip.break_crystal();
    assert!(!bench.main_output());
    assert!(bench.chip.nmi());
    assert_eq!(bench.chip.cycle(), Some(85), "the internal oscillator");
    bench.write(RCC + 0x20, 1 << 8);
    assert!(!bench.chip.nmi());
}

#[test]
fn a_crystal_that_breaks_stops_everything_without_the_security_system() {
    let mut bench = Bench::new();
    start_pll(&mut bench);
    bench.start_bridge();
    bench.switch_on();
    bench.chip.break_crystal();
    assert_eq!(bench.chip.cycle(), None);
    assert!(bench.chip.main_output(), "outputs stay as they are");
}

#[test]
fn high_clocks_want_boost_and_wait_states() {
    use virtual_board::chip::Violation;
    let mut bench = Bench::new();
    bench.write(0x4000_7080, 0);
    start_pll(&mut bench);
    assert_eq!(bench.chip.violations(), []);
    bench.modify(FLASH, |acr| acr & !0xf | 3);
    bench.run(SECOND);
    bench.write(0x4000_7080, 0x100);
    let [first, second] = bench.chip.violations() else { panic!("two violations") };
    assert_eq!((first.violation, second.violation), (Violation::WaitStates, Violation::NoBoost));
    assert_eq!(first.to, Some(second.from));
    assert!((second.from - first.from - 1.0).abs() < 1e-9);
    assert_eq!(second.to, None);
}

#[test]
fn reset_flags_tell_why_until_they_are_removed() {
    let mut bench = Bench::new();
    assert_eq!(bench.read(RCC + 0x94) >> 24, 0x0c, "power and pin");
    bench.write(RCC + 0x94, 1 << 23);
    bench.chip.reset(Reset::Watchdog);
    assert_eq!(bench.read(RCC + 0x94) >> 24, 0x24, "watchdog and pin");
}

#[test]
fn what_is_not_modelled_or_has_no_clock_is_refused() {
    for (address, value, what) in [
        (0x4000_5400, 1, "I2C1"),
        (TIM1, 1 << 1, "CR1: UDIS"),
        (TIM1, 1 << 8, "CR1: CKD"),
        (TIM1 + 0x04, 1, "CR2: CCPC"),
        (TIM1 + 0x04, 3 << 4, "CR2: MMS, compare pulse"),
        (TIM1 + 0x08, 4, "SMCR: SMS"),
        (TIM1 + 0x0c, 1 << 9, "DIER: CC1DE"),
        (TIM1 + 0x18, 1 << 7, "CCMR1: OC1CE"),
        (TIM1 + 0x18, 1, "CCMR1: CC1S"),
        (TIM1 + 0x18, 3 << 4, "CCMR1: OC1M, toggle"),
        (TIM1 + 0x20, 1 << 12, "CCER: CC4E"),
        (TIM1 + 0x44, 1 << 24, "BDTR: BK2E"),
        (TIM1 + 0x44, 1 << 12, "BDTR: BKE, active low"),
        (TIM1 + 0x48, 1, "CCR5"),
        (TIM1 + 0x60, 1 << 2, "AF1: BKCMP2E"),
        (TIM3, 1 << 4, "CR1: DIR"),
        (TIM3 + 0x08, 1, "SMCR: SMS"),
        (TIM4 + 0x08, 1, "SMCR: encoder mode 1"),
        (TIM15 + 0x0c, 1 << 14, "DIER: TDE"),
        (ADC1 + 0x08, 1 << 2, "CR: ADSTART"),
        (ADC1 + 0x0c, 1 << 31 | 1 << 13, "CFGR: CONT"),
        (ADC1 + 0x10, 1, "CFGR2: ROVSE"),
        (ADC1 + 0x14, 1 << 31, "SMPR1: SMPPLUS"),
        (ADC1 + 0x4c, 1 << 7, "JSQR: TRGO"),
        (ADC1 + 0x308, 1, "CCR: DUAL"),
        (OPAMP1, 1 << 4, "CSR: USERTRIM"),
        (COMP1, 1 << 19, "CSR: BLANKSEL"),
        (DAC3, 1 << 1, "CR: TEN1"),
        (DAC3 + 0x3c, 1, "MCR: to the pin, too"),
        (DMA1 + 0x08, 1 << 14, "CCR1: MEM2MEM"),
        (DMA1 + 0x08, 3 << 8, "CCR1: PSIZE, reserved"),
        (DMAMUX1, 1 << 16, "C0CR: SE"),
        (USART2, 1 << 12, "CR1: M0"),
        (USART2 + 0x08, 1 << 6, "CR3: DMAR"),
        (USART2 + 0x28, 0x55, "TDR while it is off"),
        (IWDG + 0x10, 1, "WINR"),
        (GPIOA + 0x04, 1, "OTYPER: open drain"),
        (GPIOA + 0x1c, 1, "LCKR"),
        (FLASH, 1 << 16, "ACR: reserved"),
        (FLASH + 0x08, 1, "KEYR: a wrong key"),
        (FLASH + 0x14, 1, "CR while it is locked"),
        (RCC + 0x08, 4 << 8, "CFGR: PPRE1"),
        (RCC + 0x68, 0, "AHB1SMENR: no clocks in sleep"),
        (PWR, 2 << 9, "CR1: VOS, range 2"),
        (PWR, 1 << 9 | 1 << 14, "CR1: LPR"),
        (SYSCFG + 0x1c, 1 << 2, "CFGR2: PVDL"),
    ] {
        assert_eq!(Bench::new().refuses(address, value), Cause::Unmodelled, "{what}");
    }
    assert_eq!(Bench::new().refuses(COMP1, 0x41), Cause::UnconnectedInput, "no threshold");
    let mut bench = Bench::new();
    bench.write(RCC + 0x60, 1);
    assert_eq!(bench.refuses(TIM1, 0), Cause::NoClock);
}

#[test]
fn pins_say_what_the_gates_are_told() {
    let mut bench = Bench::new();
    bench.pin(GPIOA, 10, 1, 0);
    bench.write(GPIOA + 0x18, 1 << 10);
    assert_eq!(bench.chip.gates(), Gates { high: [false, false, true], low: [false; 3] });
    bench.write(GPIOA + 0x28, 1 << 10);
    assert_eq!(bench.chip.gates(), Gates::OFF);
    assert_eq!(bench.read(GPIOC + 0x10) & 1 << 10, 0, "PC10 is analogue after a reset");
    bench.pin(GPIOC, 10, 0, 0);
    assert_eq!(bench.read(GPIOC + 0x10) & 1 << 10, 1 << 10);
    let switches: Vec<_> = bench.chip.world.switches.iter().map(|(time, _)| *time).collect();
    assert_eq!(switches.len(), 2);
    assert!(seconds(switches[1]) < 1e-6);
}
