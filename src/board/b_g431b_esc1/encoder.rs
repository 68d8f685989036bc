//! The encoder: TIM4 counts all four edges; its counter is read 16 times a PWM period, without the core.
//!
//! TIM3 runs from trough to trough of the bridge's counter, 16 turns of [`DISTANCE`] ticks, and at its compare value in each turn DMA channel
//! 1 copies TIM4's counter. The compare value shifts all reads of a period: earlier by a random part of their distance, so that no speed
//! beats with them ([`Reads::Shifted`](crate::sense::Reads::Shifted)). A shift must change between the last read of a period and the first of the
//! next, when the core has other things to do: DMA channel 2 brings it to the compare value's preload together with the converters' trigger,
//! [just before](super::bridge::SAMPLE_BEFORE) the trough, and the trough makes it take effect.
//!
//! The core takes the counter as it is: 16 bits that wrap. No position is kept.

use crate::hal::READS;
use core::cell::UnsafeCell;
use core::sync::atomic::{AtomicU16, Ordering, compiler_fence};
use embassy_stm32::pac::bdma::vals::{Dir, Pl, Size};
use embassy_stm32::pac::timer::vals::{CcmrInputCcs, FilterValue, Ocm, Sms, Ts, Urs};
use embassy_stm32::pac::{DBGMCU, DMA1, DMAMUX1, TIM3, TIM4};
use embassy_stm32::{Peri, peripherals, rcc};

/// Ticks from one read to the next.
pub const DISTANCE: u16 = (super::bridge::PERIOD / READS as u32) as u16;

/// Compare value without shift: the last read of a period is at its end.
const LATEST: u16 = DISTANCE - 1;

/// DMAMUX requests (RM0440, table of DMAMUX1's inputs).
const TIM3_CH1: u8 = 61;
const TIM1_CH4: u8 = 45;

/// DMA1's channels, counted from 0.
const READ_CHANNEL: usize = 0;
const SHIFT_CHANNEL: usize = 1;

/// Two periods' reads: one that is complete and one that is being filled.
static COUNTS: Halves = Halves([const { UnsafeCell::new([0; READS]) }; 2]);

#[repr(align(4))] // To be copied by words.
struct Halves([UnsafeCell<[u16; READS]>; 2]);

// SAFETY: DMA writes it, and only the control interrupt reads it.
unsafe impl Sync for Halves {}

/// Reads of the next period that may have been made when those of the last one are looked at: half of them. One or two, usually.
const MOST_BEGUN: usize = READS / 2;

/// Compare value of the period after the one that has begun.
static NEXT_COMPARE: AtomicU16 = AtomicU16::new(LATEST);

/// What the encoder's driver owns.
pub type Owned = (
    Peri<'static, peripherals::TIM3>,
    Peri<'static, peripherals::TIM4>,
    Peri<'static, peripherals::DMA1_CH1>,
    Peri<'static, peripherals::DMA1_CH2>,
);

/// The encoder's reads.
pub struct Encoder {
    /// Of the reads that will be complete at the next call, and at the one after it.
    shifts: [u8; 2],
    random: u32,
    /// The half of [`COUNTS`] that was read last.
    last: Option<usize>,
}

/// A period's reads.
pub struct Counts {
    /// The counter.
    pub reads: &'static [u16; READS],
    /// How much earlier they were made, as [`Codes::shift`](crate::hal::Codes::shift) has it.
    pub shift: u8,
    /// Whether they are of the period just ended, next to those before, and DMA has gone on from there by a few reads at most.
    pub are_in_time: bool,
}

/// Compare value for a shift: 530 to 2.
fn compare(shift: u8) -> u16 {
    LATEST - ((u32::from(shift) * u32::from(DISTANCE)) >> 8) as u16
}

/// Gives both timers their clocks. In a debugger's halt they stand still with the bridge's timer, so that reads stay where they belong.
pub fn enable_clocks() {
    rcc::enable_and_reset::<peripherals::TIM3>();
    rcc::enable_and_reset::<peripherals::TIM4>();
    DBGMCU.apb1lfzr().modify(|w| {
        w.set_tim3(true);
        w.set_tim4(true);
    });
}

impl Encoder {
    /// Starts counting, and reading at the next trough. Both timers have their [clocks](enable_clocks).
    pub fn start(_owned: Owned) -> Self {
        // Both inputs, filtered over 0.19 µs, count up and down on all edges.
        TIM4.ccmr_input(0).write(|w| {
            for input in [0, 1] {
                w.set_ccs(input, CcmrInputCcs::TI4);
                w.set_icf(input, FilterValue::FDTS_DIV4_N8);
            }
        });
        TIM4.smcr().write(|w| w.set_sms(Sms::ENCODER_MODE_3));
        TIM4.arr().write(|w| w.set_arr(u16::MAX));
        TIM4.cr1().write(|w| w.set_cen(true));

        let from_timer = TIM4.cnt().as_ptr() as u32;
        let to_timer = TIM3.ccr(0).as_ptr() as u32;
        // Highest priority: nothing else may come between a request and its read.
        let channel = |number: usize, request, timer, memory, length, direction, increment| {
            DMAMUX1.ccr(number).write(|w| w.set_dmareq_id(request));
            let channel = DMA1.ch(number);
            channel.par().write_value(timer);
            channel.mar().write_value(memory);
            channel.ndtr().write(|w| w.set_ndt(length));
            channel.cr().write(|w| {
                w.set_dir(direction);
                w.set_circ(true);
                w.set_minc(increment);
                // A half-word that is written to a register stands in its other half too (RM0440, 2.1.5); as a word it is extended by zeros.
                w.set_psize(Size::BITS32);
                w.set_msize(Size::BITS16);
                w.set_pl(Pl::VERY_HIGH);
                w.set_en(true);
            });
        };
        let counts = COUNTS.0.as_ptr() as u32;
        let length = 2 * READS as u16;
        channel(READ_CHANNEL, TIM3_CH1, from_timer, counts, length, Dir::FROM_PERIPHERAL, true);
        let next = NEXT_COMPARE.as_ptr() as u32;
        channel(SHIFT_CHANNEL, TIM1_CH4, to_timer, next, 1, Dir::FROM_MEMORY, false);

        TIM3.arr().write(|w| w.set_arr(DISTANCE - 1));
        TIM3.ccmr_output(0).write(|w| {
            w.set_ocm(0, Ocm::FROZEN);
            w.set_ocpe(0, true);
        });
        TIM3.ccr(0).write(|w| w.set_ccr(LATEST));
        TIM3.cr1().write(|w| w.set_urs(Urs::ANY_EVENT));
        // The compare value into force, before requests are enabled.
        TIM3.egr().write(|w| w.set_ug(true));
        TIM3.dier().write(|w| w.set_ccde(0, true));
        // TIM1's TRGO, its update at the trough, starts it, and starts it anew in each period.
        TIM3.smcr().write(|w| {
            w.set_ts(Ts::ITR0);
            w.set_sms(Sms::COMBINED_RESET_TRIGGER);
        });
        Self { shifts: [0; 2], random: 1, last: None }
    }

    /// The reads of the period that has just ended. DMA writes over them in the one after the next.
    #[inline]
    pub fn read(&mut self) -> Counts {
        // What DMA still has to fill: more than a half while it is in the first.
        let left = usize::from(DMA1.ch(READ_CHANNEL).ndtr().read().ndt());
        let complete = usize::from(left > READS);
        let begun = left.wrapping_neg() % READS;
        // What is read below is as DMA left it.
        compiler_fence(Ordering::Acquire);
        // SAFETY: DMA has left this half, and comes back to it in a period, when this has long been read.
        let reads = unsafe { &*COUNTS.0[complete].get() };
        let are_in_time = self.last != Some(complete) && begun <= MOST_BEGUN;
        self.last = Some(complete);

        // Numerical Recipes' linear congruential generator: its high bits are random enough for this.
        self.random = self.random.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        let [shift, next] = self.shifts;
        let new = (self.random >> 24) as u8;
        NEXT_COMPARE.store(compare(new), Ordering::Relaxed);
        self.shifts = [next, new];
        Counts { reads, shift, are_in_time }
    }
}
