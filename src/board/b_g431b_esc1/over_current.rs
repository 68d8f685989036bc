//! Over-current in hardware, as far as the board allows: comparator 1 ends TIM1's outputs through its break, without the core.
//!
//! The shunts' pads go to comparators too, but carry 1.7 mV/A there: 2 steps of a converter per ampere, below the noise of the switching
//! bridge (others who tried report no usable trip). The amplified voltages of U and V are at no comparator's input. But the amplifier of
//! W, which is not used, can amplify U's shunt a second time, and its output is comparator 1's input PB1.
//!
//! What it covers: a current from U to ground through U's low side above [`TRIP`], which a negative armature current is. What it does not:
//! the other direction, in which the amplifier's output falls; V; a short circuit to the supply, which no low-side shunt sees. For those there is
//! the software trip in each period ([`Fault::Overcurrent`](crate::fault::Fault::Overcurrent)), with half a period to one period of delay.
//!
//! Our own idea from the data sheet; nobody has tried it on a board yet. If it trips without reason, the noise is too much for TIM1's filter
//! of 0.75 µs: raise [`bridge`](super::bridge)'s filter first.

use embassy_stm32::pac::comp::vals::{Hysteresis, Inm};
use embassy_stm32::pac::dac::vals::Mode;
use embassy_stm32::pac::{COMP1, DAC3};
use embassy_stm32::{Peri, peripherals, rcc};

/// Current that trips (A): just below what the amplifier can show.
const TRIP: f32 = 38.0;

/// DAC3's code for it, from the chain in [`analogue`](super::analogue): 2.057 V + 27.43 mV/A of 3.3 V.
const THRESHOLD: u16 = ((2.057 + 0.02743 * TRIP) / 3.3 * 4096.0) as u16;

/// Starts the comparator; the break is connected in [`bridge`](super::bridge).
pub fn start(
    _converter: Peri<'static, peripherals::DAC3>,
    _comparator: Peri<'static, peripherals::COMP1>,
) {
    rcc::enable_and_reset::<peripherals::DAC3>();
    DAC3.mcr().write(|w| {
        w.set_mode(0, Mode::NORMAL_INT_BUFDIS);
        // The bus is faster than 160 MHz.
        w.set_hfsel(2);
    });
    DAC3.dhr12r(0).write(|w| w.set_dhr(THRESHOLD));
    DAC3.cr().write(|w| w.set_en(0, true));
    // Until reset. Input plus: PB1; input minus: DAC3's channel 1.
    COMP1.csr().write(|w| {
        w.set_inpsel(true);
        w.set_inmsel(Inm::DACA);
        w.set_hyst(Hysteresis::HYST20M);
        w.set_en(true);
        w.set_lock(true);
    });
}
