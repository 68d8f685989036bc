//! ST's B-G431B-ESC1 (STM32G431CB) with a brushed motor on U and V, and an incremental encoder.
//!
//! | file | what |
//! |---|---|
//! | `pins.rs` | every pin, with its source |
//! | `bridge.rs` | TIM1: PWM, dead time, break; when is sampled, what duty is left |
//! | `analogue.rs` | currents, bus voltage, temperature |
//! | `over_current.rs` | comparator to break |
//! | `encoder.rs` | 16 reads a period by DMA |
//! | `interrupt.rs` | the control interrupt, and how tasks reach it |
//! | `link.rs` | the serial port, and who answers there |
//! | `parameter_flash.rs` | where parameters are saved |
//! | `safety.rs` | exceptions, panic, watchdog |
//! | `defaults.rs` | what runs when no parameters are stored |
//! | `memory.x` | what lies where |
//!
//! Peripherals by their registers where embassy-stm32's drivers would switch outputs on before dead time and break are set, or
//! have no such use. Nothing of this has run on a board yet: see `docs/b-g431b-esc1.md`.
//!
//! [`start`] brings everything up with outputs off. Peripherals that the control interrupt uses are not handed out.
#![allow(unsafe_code, reason = "exceptions, and what is handed to an interrupt")]

pub mod analogue;
pub mod bridge;
pub mod defaults;
pub mod encoder;
pub mod interrupt;
pub mod link;
mod over_current;
mod parameter_flash;
mod pins;
mod safety;

use crate::config::{ConfigError, require};
use crate::drive::DriveConfig;
use crate::fault::Fault;
use crate::parameters::Parameters;
use crate::sense::Sensors;
use crate::supervisor::Supervisor;
use bridge::Bridge;
use embassy_stm32::interrupt::{InterruptExt, Priority};
use embassy_stm32::pac::pwr::regs::Cr5;
use embassy_stm32::pac::rcc::vals::Hpre;
use embassy_stm32::pac::{PWR, RCC};
use embassy_stm32::rcc::{self, Hse, HseMode, Pll, PllMul, PllPreDiv, PllRDiv, PllSource, Sysclk};
use embassy_stm32::time::Hertz;
use embassy_stm32::{Config, Peri, peripherals};
use encoder::Encoder;
use link::{Link, Port};

/// Clock cycles in a microsecond.
const CYCLES_PER_MICROSECOND: u32 = bridge::CLOCK / 1_000_000;

/// What the tasks get.
pub struct Board {
    /// Serves the port.
    pub link: Link,
    /// The serial port.
    pub port: Port,
    /// The status LED's pin.
    pub led: Peri<'static, peripherals::PC6>,
    /// The button's pin: low while it is pressed.
    pub button: Peri<'static, peripherals::PC10>,
    /// Whether the control interrupt runs. If not, the hardware did not start, and outputs stay off for good.
    pub is_running: bool,
}

/// Starts the board, with outputs off, and the control interrupt.
// Not inlined: a task would keep the stack that this takes for good.
#[inline(never)]
pub fn start() -> Board {
    let p = embassy_stm32::init(config());
    boost();
    pins::start_unused_leg();
    safety::watch_clock();
    safety::guard_stack();
    safety::order_writes();
    let watchdog_reset = safety::take_watchdog_reset().then_some(Fault::WatchdogReset);
    safety::start_watchdog(p.IWDG);
    start_cycle_counter();
    over_current::start(p.DAC3, p.COMP1);
    // Before the bridge's timer sends its triggers: who receives them must have a clock (RM0440, 29.3.30).
    analogue::enable_clock();
    encoder::enable_clocks();
    let bridge = Bridge::start(p.TIM1);
    let is_converting = analogue::start((p.ADC1, p.ADC2));
    let encoder = Encoder::start((p.TIM3, p.TIM4, p.DMA1_CH1, p.DMA1_CH2));
    // The clock of embassy's tasks gives way to the control interrupt.
    embassy_stm32::interrupt::TIM1_BRK_TIM15.set_priority(Priority::P8);

    let (mut link, unreadable) = Link::load(p.FLASH);
    let faults = [watchdog_reset, unreadable, link.prepare()];
    let is_running =
        is_converting && bridge.is_some_and(|bridge| interrupt::start(faults, bridge, encoder));
    if !is_running {
        link.is_dead(Fault::SelfTest);
    }
    let port = Port { usart: p.USART2, rx: p.PB4, tx: p.PB3 };
    Board { link, port, led: p.PC6, button: p.PC10, is_running }
}

/// Holds the watchdog off. It wants to be fed every 50 ms.
pub fn feed_watchdog() {
    safety::feed_watchdog();
}

/// The supervisor of a set of parameters, for this board. Refuses what the board cannot do.
fn build(parameters: &Parameters) -> Result<Supervisor<f32>, ConfigError> {
    let Parameters { drive, protection } = parameters;
    let DriveConfig { timing, limits, .. } = drive;
    let is_ours = *timing == defaults::TIMING;
    require(is_ours, "timing", "must be the board's", timing.rate)?;
    let has_window = limits.duty <= bridge::HIGHEST_SHARE;
    require(has_window, "limits.duty", "must leave the low sides' window open", limits.duty)?;
    let Sensors::Codes(calibration) = drive.sensors else {
        return Err(ConfigError { field: "sensors", rule: "must be Codes", value: 0.0 });
    };
    let zero = f32::from(analogue::SHUNTS.zero());
    let is_ours =
        calibration.current_zero == zero && f32::from(calibration.highest_code) == 2.0 * zero;
    let (field, rule) = ("sensors.current_zero", "and the highest code must be the board's");
    require(is_ours, field, rule, calibration.current_zero)?;
    Supervisor::new(drive, protection)
}

/// 170 MHz from the board's crystal of 8 MHz.
fn config() -> Config {
    let mut config = Config::default();
    config.rcc.hse = Some(Hse { freq: Hertz::mhz(8), mode: HseMode::Oscillator });
    config.rcc.pll = Some(Pll {
        source: PllSource::HSE,
        prediv: PllPreDiv::DIV2,
        mul: PllMul::MUL85,
        divp: None,
        divq: None,
        divr: Some(PllRDiv::DIV2),
    });
    config.rcc.sys = Sysclk::PLL1_R;
    config.rcc.boost = true;
    config.rcc.mux.adc12sel = rcc::mux::Adcsel::SYS;
    config.bdma_interrupt_priority = Priority::P8;
    config
}

/// Boost mode, without which the core's clock must not be above 150 MHz (RM0440, dynamic voltage scaling management). embassy-stm32 means
/// to set it, but stm32-metapac 21 has R1MODE of PWR_CR5 at bit 0, not 8.
fn boost() {
    RCC.cfgr().modify(|w| w.set_hpre(Hpre::DIV2));
    PWR.cr5().write_value(Cr5(0));
    cortex_m::asm::delay(CYCLES_PER_MICROSECOND);
    RCC.cfgr().modify(|w| w.set_hpre(Hpre::DIV1));
}

fn start_cycle_counter() {
    // SAFETY: nobody else uses these two, and both only count.
    let mut core = unsafe { cortex_m::Peripherals::steal() };
    core.DCB.enable_trace();
    core.DWT.enable_cycle_counter();
}

/// Waits for what hardware does within microseconds; gives up after a millisecond. Tells whether it was done.
fn wait_for(mut is_done: impl FnMut() -> bool) -> bool {
    (0..1000).any(|_| {
        cortex_m::asm::delay(CYCLES_PER_MICROSECOND);
        is_done()
    })
}

// Reads each SRAM once, before anything is written: a reset at a bad instant can make the first access to one a read, whatever it is (errata
// ES0431, 2.2.7). Then moves the control interrupt's code to CCM SRAM, before anything is called that might be in it. In assembly, since no
// Rust may run before memory is initialised. The linker script gives the three addresses, aligned to 8.
core::arch::global_asm!(
    ".section .text.__pre_init, \"ax\"",
    ".global __pre_init",
    ".type __pre_init, %function",
    ".thumb_func",
    "__pre_init:",
    "ldr r0, =0x10000000",
    "ldr r0, [r0]",
    "ldr r0, =0x20000000",
    "ldr r0, [r0]",
    "ldr r0, =0x20004000",
    "ldr r0, [r0]",
    "ldr r0, =__control_start",
    "ldr r1, =__control_end",
    "ldr r2, =__control_load",
    "1: cmp r0, r1",
    "beq 2f",
    "ldm r2!, {{r3}}",
    "stm r0!, {{r3}}",
    "b 1b",
    "2: bx lr",
    ".pool",
    ".size __pre_init, . - __pre_init",
);
