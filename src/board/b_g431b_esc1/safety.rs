//! What ends outputs when the firmware cannot: exceptions, panics, the watchdog; and why the board was reset.
//!
//! Everything here ends the outputs first, in the timer's hardware, and then waits for the watchdog. After it the fault is
//! [`Fault::WatchdogReset`](crate::fault::Fault::WatchdogReset). A core that locks up, a clock that fails and memory errors end the outputs
//! without any code, by TIM1's break ([`bridge`](super::bridge)).

use super::interrupt::SLOW_PERIODS;
use super::{bridge, parameter_flash};
use core::panic::PanicInfo;
use cortex_m::peripheral::{DCB, ICB, MPU};
use cortex_m_rt::{ExceptionFrame, exception};
use embassy_stm32::pac::iwdg::vals::Key;
use embassy_stm32::pac::{DBGMCU, FLASH, IWDG, RCC, TIM15};
use embassy_stm32::wdg::IndependentWatchdog;
use embassy_stm32::{Peri, peripherals};

/// The watchdog's time (µs). More than the 25 ms for which erasing a page of flash stops the core.
const WATCHDOG_TIME: u32 = 50_000;

/// Starts the watchdog: from here on it wants to be fed. In a debugger's halt it waits.
pub(super) fn start_watchdog(watchdog: Peri<'static, peripherals::IWDG>) {
    DBGMCU.apb1lfzr().modify(|w| w.set_iwdg(true));
    IndependentWatchdog::new(watchdog, WATCHDOG_TIME).unleash();
}

/// Holds the watchdog off for another [`WATCHDOG_TIME`].
pub(super) fn feed_watchdog() {
    IWDG.kr().write(|w| w.set_key(Key::RESET));
}

/// Whether the watchdog was what reset the board. Forgotten with the call.
pub(super) fn take_watchdog_reset() -> bool {
    let was_it = RCC.csr().read().iwdgrstf();
    RCC.csr().modify(|w| w.set_rmvf(true));
    was_it
}

/// Ends the outputs if the clock fails: it goes to TIM1's break, and to the exception below.
pub(super) fn watch_clock() {
    RCC.cr().modify(|w| w.set_csson(true));
}

/// A stack that overflows must not go on below the SRAM, where the flash's own registers and memories answer: no access to the 32 kB there.
/// It is a hard fault, whose own frame has no room either: the core locks up, which is wired to TIM1's break.
pub(super) fn guard_stack() {
    const BELOW_SRAM: u32 = 0x1FFF_8000;
    // A region of 2^(14 + 1) bytes without access, and not to be executed (Armv7-M, B3.5).
    const NOBODY: u32 = 1 << 28 | 14 << 1 | 1;
    // SAFETY: nobody else uses it, and what has no region is as without it.
    unsafe {
        let mpu = &*MPU::PTR;
        mpu.rnr.write(0);
        mpu.rbar.write(BELOW_SRAM);
        mpu.rasr.write(NOBODY);
        // On, with the usual map for the rest.
        mpu.ctrl.write(1 << 2 | 1);
    }
    cortex_m::asm::dsb();
    cortex_m::asm::isb();
}

/// Stores wait for each other: else one at the end of an interrupt's handler can make the core take the wrong vector for the next (Arm's erratum
/// 838869 of the Cortex-M4).
pub(super) fn order_writes() {
    const NO_WRITE_BUFFER: u32 = 1 << 1;
    // SAFETY: nobody else uses it.
    unsafe { (*ICB::PTR).actlr.modify(|value| value | NO_WRITE_BUFFER) };
}

/// Tells a debugger's halt from how far the clock of embassy's tasks has come, which goes on meanwhile: the timers that stand still with the
/// core tell nothing, and debuggers clear the core's own note of it.
pub(super) struct Pauses {
    /// The clock when last looked at.
    ticks: u16,
}

impl Pauses {
    /// Nothing looked at yet.
    pub(super) const fn new() -> Self {
        Self { ticks: 0 }
    }

    /// Whether there was one of a quarter of a millisecond or more since the last look, [`SLOW_PERIODS`] ago.
    #[inline]
    pub(super) fn was_one(&mut self) -> bool {
        // Of 1/32768 s: 52, and 8 more.
        const USUAL: u32 = SLOW_PERIODS * bridge::PERIOD / (bridge::CLOCK / 32_768);
        let ticks = TIM15.cnt().read().cnt();
        let passed = ticks.wrapping_sub(core::mem::replace(&mut self.ticks, ticks));
        u32::from(passed) > USUAL + 8
    }
}

fn wait_for_watchdog() -> ! {
    cortex_m::interrupt::disable();
    loop {
        cortex_m::asm::nop();
    }
}

#[exception]
unsafe fn HardFault(_frame: &ExceptionFrame) -> ! {
    bridge::off();
    defmt::error!("hard fault");
    wait_for_watchdog()
}

/// A clock that failed, or an error in flash that cannot be corrected.
#[exception]
unsafe fn NonMaskableInt() {
    if FLASH.eccr().read().eccd() && parameter_flash::is_reading() {
        FLASH.eccr().modify(|w| w.set_eccd(true));
        return;
    }
    bridge::off();
    defmt::error!("clock failure, or an error in flash");
    wait_for_watchdog()
}

/// Every other exception, and interrupts that nobody handles.
#[exception]
unsafe fn DefaultHandler(number: i16) -> ! {
    // First: the control interrupt could enable outputs.
    cortex_m::interrupt::disable();
    bridge::off();
    defmt::error!("unexpected exception {=i16}", number);
    wait_for_watchdog()
}

/// What panicked is not told: the texts and places of all panics would be a tenth of the image. A debugger halts here and shows the way.
#[panic_handler]
fn panic(_: &PanicInfo) -> ! {
    // First: the control interrupt could enable outputs.
    cortex_m::interrupt::disable();
    bridge::off();
    defmt::error!("panic");
    if DCB::is_debugger_attached() {
        cortex_m::asm::bkpt();
    }
    wait_for_watchdog()
}
