//! The bridge: TIM1 drives the legs U (channel 1) and V (channel 2); the motor is between them, a positive duty drives current
//! out of U. Registers and their behaviour after RM0440, chapter *Advanced-control timers*.
//!
//! # The PWM period
//!
//! Centre-aligned: the counter runs from 0 up to [`TOP`] and back, and a period goes from one trough to the next. In PWM mode 2 a
//! leg's high side is on around the peak, while the counter is at or above its compare value, and its low side for the rest.
//!
//! ```text
//!   counter  TOP ┈┈┈╱╲┈┈┈┈┈┈┈┈╱╲┈┈┈        U, V high sides: around the peaks
//!                  ╱  ╲      ╱  ╲          both low sides: around the troughs
//!              0 ╱┈┈┈┈┈╲┈┈╱┈┈┈┈┈┈╲┈        ▲ sample, then update of the compare values
//!                       ▲          ▲
//! ```
//!
//! - **Sampling instant.** The currents are sampled in the middle of the window in which both low sides are on, half a period
//!   from the middle of the voltage pulses: there the ripple crosses its mean. OC4REF rises [`SAMPLE_BEFORE`] ticks before the
//!   trough; the converters then need that long until they hold.
//! - **Update.** Compare values are preloaded and take effect at the trough, once a period: a command that is computed after one
//!   trough acts from the next one on, a whole period later, as [`Timing::delay`](crate::control::Timing::delay) has it.
//! - **Window, and the highest duty.** The high sides' drivers are bootstrapped: their capacitors charge only while the low
//!   sides are on. And a current must have settled in its amplifier before it is sampled. So a high side is on for at most
//!   [`HIGHEST_SHARE`] of the period: what is left is twice the dead time and 1.3 µs. The scheme that keeps both low sides on
//!   together is [`modulation`].
//! - **Before the motor is driven** the bootstrap capacitors are empty: [`Output::Charge`] turns on only the low sides, for a
//!   twentieth of the period around the peak, where nobody samples.

use super::pins;
use crate::modulation;
use crate::supervisor::Output;
use embassy_stm32::Peri;
use embassy_stm32::pac::timer::regs::CcerAdv;
use embassy_stm32::pac::timer::vals::{
    Bkinp, Bkp, Cms, Dir, FilterValue, Lock, Mms, Mms2, Ocm, Ossi, Ossr,
};
use embassy_stm32::pac::{DBGMCU, SYSCFG, TIM1};
use embassy_stm32::{peripherals, rcc};

/// Clock of the core and of all timers (Hz).
pub const CLOCK: u32 = 170_000_000;

/// The counter's highest value. Twice this is a period, and divisible by 16: the encoder's reads.
pub const TOP: u16 = 4248;

/// Ticks of a period.
pub const PERIOD: u32 = 2 * TOP as u32;

/// PWM and sampling rate (Hz): 20.009 kHz.
pub const RATE: f32 = CLOCK as f32 / PERIOD as f32;

/// Ticks from the trigger of the converters to the trough: 2.125 cycles of latency, with a clock that is a quarter of the timers' (data sheet,
/// ADC characteristics), and 12.5 of sampling, of 4 ticks each: 58.5.
pub const SAMPLE_BEFORE: u16 = 59;

/// Dead time (ticks): 0.8 µs. Boards run with 0.25 to 1 µs; the drivers (L6387E) interlock their inputs but delay by up to 0.15 µs.
const DEAD_TIME: u16 = 136;

/// Time for the current to settle in the amplifier, before and after the sample (ticks): 1.3 µs.
const SETTLING: u16 = 221;

/// Largest share of a period that a high side is on for: 0.916.
pub const HIGHEST_SHARE: f32 = 1.0 - (2 * (DEAD_TIME + SETTLING)) as f32 / PERIOD as f32;

/// Compare value for a twentieth of the period.
const CHARGE: u16 = TOP - TOP / 20;

/// TIM1_CCER: CC1NE and CC2NE, and with them CC1E and CC2E.
const LOW_SIDES: CcerAdv = CcerAdv(1 << 2 | 1 << 6);
const BOTH_SIDES: CcerAdv = CcerAdv(LOW_SIDES.0 | 1 << 0 | 1 << 4);

const U: usize = 0;
const V: usize = 1;
/// The channel that triggers the converters.
const SAMPLE: usize = 3;

/// The bridge's outputs.
pub struct Bridge {
    is_on: bool,
    /// Which outputs are enabled.
    enabled: CcerAdv,
}

/// The share that [`Bridge::apply`] gives a leg, in ticks of the counter.
fn compare(share: f32) -> u32 {
    // From the top down. `as` takes what rounding left below zero for zero.
    u32::from(TOP) - (share * f32::from(TOP) + 0.5) as u32
}

/// Ends every output now: the main output enable is cleared, and the pins are low without the core.
#[inline]
pub fn off() {
    TIM1.bdtr().modify(|w| w.set_moe(false));
}

/// Whether the main output enable is set.
pub fn is_enabled() -> bool {
    TIM1.bdtr().read().moe()
}

impl Bridge {
    /// Starts TIM1 with its outputs off. Nothing if it does not count as it should.
    pub fn start(_timer: Peri<'static, peripherals::TIM1>) -> Option<Self> {
        rcc::enable_and_reset::<peripherals::TIM1>();
        // OIS and OISN are 0: with outputs off every pin is low.
        TIM1.cr2().write(|w| {
            w.set_mms(Mms::UPDATE); // TRGO: the encoder's reads
            w.set_mms2(Mms2::COMPARE_OC4); // TRGO2: the converters
        });
        // Break: the comparator, filtered over 0.75 µs; no pin. And, without a filter, what `lock_system_breaks` connects.
        TIM1.af1().write(|w| {
            w.set_bkine(false);
            w.set_bkcmpe(0, true);
            w.set_bkcmpp(0, Bkinp::NOT_INVERTED);
        });
        TIM1.bdtr().write(|w| {
            w.set_dtg(dead_time_code(DEAD_TIME));
            w.set_ossi(Ossi::IDLE_LEVEL);
            w.set_ossr(Ossr::IDLE_LEVEL);
            w.set_bke(0, true);
            w.set_bkp(0, Bkp::ACTIVE_HIGH);
            w.set_bkf(0, FilterValue::FDTS_DIV16_N8);
            // Until reset: dead time, break, polarities and idle states.
            w.set_lock(Lock::LEVEL2);
        });
        lock_system_breaks();
        // In a debugger's halt the counter stops, and the outputs are off; `Pauses` tells when it goes on.
        DBGMCU.apb2fzr().modify(|w| w.set_tim1(true));

        TIM1.cr1().write(|w| {
            // Compare flags, and the request that goes with channel 4's, on the way down only.
            w.set_cms(Cms::CENTER_ALIGNED1);
            w.set_arpe(true);
        });
        TIM1.arr().write(|w| w.set_arr(TOP));
        for leg in [U, V] {
            TIM1.ccmr_output(0).modify(|w| {
                w.set_ocm(leg, Ocm::PWM_MODE2);
                w.set_ocpe(leg, true);
            });
            TIM1.ccr(leg).write(|w| w.set_ccr(CHARGE));
        }
        TIM1.ccmr_output(1).modify(|w| w.set_ocm(SAMPLE - 2, Ocm::PWM_MODE1));
        TIM1.ccr(SAMPLE).write(|w| w.set_ccr(SAMPLE_BEFORE));
        TIM1.dier().write(|w| w.set_ccde(SAMPLE, true));
        TIM1.ccer().write_value(LOW_SIDES);
        TIM1.rcr().write(|w| w.set_rep(1));
        TIM1.egr().write(|w| w.set_ug(true));
        TIM1.cr1().modify(|w| w.set_cen(true));
        if !update_at_trough() {
            return None;
        }
        pins::start_bridge();
        Some(Self { is_on: false, enabled: LOW_SIDES })
    }

    /// Whether the hardware has ended the outputs although they were to be on.
    #[inline]
    pub fn has_tripped(&self) -> bool {
        self.is_on && !is_enabled()
    }

    /// Whether outputs are to be on.
    #[inline]
    pub fn is_on(&self) -> bool {
        self.is_on
    }

    /// Takes a command; it acts from the next trough on. Off acts at once.
    #[inline]
    pub fn apply(&mut self, output: Output<f32>) {
        let ((u, v), enabled) = match output {
            Output::Off | Output::Charge => ((CHARGE.into(), CHARGE.into()), LOW_SIDES),
            Output::Duty(duty) => {
                let [u, v] = modulation::legs(duty, HIGHEST_SHARE);
                ((compare(u), compare(v)), BOTH_SIDES)
            }
        };
        TIM1.ccr(U).write(|w| w.set_ccr(u as u16));
        TIM1.ccr(V).write(|w| w.set_ccr(v as u16));
        // A low side alone follows the compare values as a high side does: where both were enabled with that one on, the leg would turn over
        // without dead time. So what is enabled changes with outputs off, and the first duty's period begins with them off.
        if output == Output::Off || enabled != self.enabled {
            off();
            self.is_on = false;
            TIM1.ccer().write_value(enabled);
            self.enabled = enabled;
        } else if !self.is_on {
            self.is_on = true;
            TIM1.sr().write(|w| {
                w.0 = !0;
                w.set_bif(0, false);
                w.set_sbif(false);
            });
            TIM1.bdtr().modify(|w| w.set_moe(true));
        }
    }
}

/// Whether an update has happened since the last call.
#[inline]
pub fn take_update() -> bool {
    let happened = TIM1.sr().read().uif();
    TIM1.sr().write(|w| {
        w.0 = !0;
        w.set_uif(false);
    });
    happened
}

/// Sees to it that updates happen at the trough. With a repetition counter of 1 they happen at every other end of the count; the
/// manuals of ST's families differ on which, so it is looked at, and moved on by half a period if need be.
fn update_at_trough() -> bool {
    for _ in 0..3 {
        match update_goes() {
            // Just turned up.
            Some(Dir::UP) => return true,
            Some(Dir::DOWN) => {
                TIM1.rcr().write(|w| w.set_rep(0));
                update_goes();
                TIM1.rcr().write(|w| w.set_rep(1));
                update_goes();
            }
            None => return false,
        }
    }
    false
}

/// Waits for an update; tells where the counter goes from there.
fn update_goes() -> Option<Dir> {
    take_update();
    super::wait_for(take_update).then(|| TIM1.cr1().read().dir())
}

/// What ends the outputs without the core (SYSCFG_CFGR2), until reset: the core's lock-up, an uncorrectable error in flash and
/// a parity error in SRAM. A clock that fails is always connected.
fn lock_system_breaks() {
    SYSCFG.cfgr2().modify(|w| {
        w.set_cll(true);
        w.set_eccl(true);
        w.set_spl(true);
    });
}

/// TIM1_BDTR's DTG for a dead time: ticks up to 127, else (64 + n)·2 ticks.
const fn dead_time_code(ticks: u16) -> u8 {
    if ticks < 128 {
        ticks as u8
    } else {
        // 64 to 127 pairs of ticks.
        0x80 | (ticks / 2 - 64) as u8
    }
}

const _: () = assert!(DEAD_TIME < 254 && PERIOD.is_multiple_of(16));
