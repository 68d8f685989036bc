//! Currents, bus voltage and temperature: the operational amplifiers and both converters. Registers after RM0440.
//!
//! # The current chain
//!
//! Each low side has a shunt of [`SHUNT`]. Resistors (22 kΩ to 3.3 V, 2.2 kΩ to ground, 1.5 kΩ
//! from the shunt) lift its voltage, and the leg's amplifier multiplies by 16: 2.057 V + 27.43 mV/A for a current from the leg to
//! ground, 2553 codes and 29.37 mA a code. It ends at about +41 A and −71 A. An amplifier's offset of 3 mV is 1.75 A: what no current
//! looks like is learnt whenever outputs are off ([`shunts`](crate::shunts)). Values from MCSDK's project for the board and two open
//! firmwares for it; not measured by us. Some boards are marked R005: read yours, and change [`SHUNT`].
//!
//! # Conversions
//!
//! ADC1 and ADC2 start together at TIM1's TRGO2 and hold U's and V's current in the same clock cycle; ADC1 then converts bus voltage and
//! temperature, and its end of sequence is the control interrupt. Only injected conversions: one that interrupts a regular
//! conversion may convert the wrong channel (errata ES0431).

use super::{pins, wait_for};
use crate::shunts::ShuntConfig;
use crate::thermistor::Thermistor;
use embassy_stm32::pac::adc::Adc;
use embassy_stm32::pac::adc::vals::{Exten, SampleTime};
use embassy_stm32::pac::adccommon::vals::Ckmode;
use embassy_stm32::pac::opamp::vals::{PgaGain, VmSel, VpSel};
use embassy_stm32::pac::{ADC1, ADC2, ADC12_COMMON, OPAMP1, OPAMP2, OPAMP3};
use embassy_stm32::{Peri, peripherals, rcc};

/// Shunt of a leg (Ω).
pub const SHUNT: f32 = 3e-3;

/// What the amplifier's output moves per voltage at the shunt: gain 16 after the network's (22 kΩ ∥ 2.2 kΩ) / (that + 1.5 kΩ).
const GAIN: f32 = 16.0 * 2.0 / 3.5;

/// Converters' reference, which is the supply (V), and the codes that it is.
const REFERENCE: f32 = 3.3;
const CODES: f32 = 4096.0;

/// Highest code of the converters.
pub const HIGHEST_CODE: u16 = 4095;

/// What the legs' converters are like: their zero may be off by what 3 mV of offset are three times over, and they may differ by 4 A.
pub const SHUNTS: ShuntConfig = ShuntConfig {
    nominal_zero: 2553,
    zero_tolerance: 180,
    disagreement: 136,
    highest_code: HIGHEST_CODE,
};

/// Armature current (A) per code of [`Codes::current`](crate::hal::Codes::current).
pub const CURRENT_PER_CODE: f32 =
    REFERENCE / CODES / GAIN / SHUNT / ShuntConfig::CODES_PER_CODE as f32;

/// Bus voltage (V) per code, through 169 kΩ and 18 kΩ.
pub const BUS_PER_CODE: f32 = REFERENCE / CODES * (169.0 + 18.0) / 18.0;

const U_CHANNEL: u8 = 3;
const V_CHANNEL: u8 = 3;
const BUS_CHANNEL: u8 = 1;
const TEMPERATURE_CHANNEL: u8 = 5;

/// JEXTSEL of TIM1's TRGO2, on both converters.
const TRIGGER: u8 = 8;

/// A period's conversions.
pub struct Conversions {
    /// Of the legs U and V.
    pub legs: [u16; 2],
    /// Of the bus voltage.
    pub bus_voltage: u16,
    /// Of the board's temperature; [`celsius`] tells it.
    pub temperature: u16,
}

/// Gives the converters their clock: 42.5 MHz from the timers', so that a trigger's latency is always the same.
pub fn enable_clock() {
    rcc::enable_and_reset::<peripherals::ADC1>();
    ADC12_COMMON.ccr().modify(|w| w.set_ckmode(Ckmode::SYNC_DIV4));
}

/// Starts amplifiers and converters, which have their [clock](enable_clock); the latter wait for their trigger. Tells whether all came
/// up.
pub fn start(
    _converters: (Peri<'static, peripherals::ADC1>, Peri<'static, peripherals::ADC2>),
) -> bool {
    pins::start_sensors();
    // U and V, and U once more for the comparator: W's amplifier has U's shunt as its third input.
    for (amplifier, input) in
        [(OPAMP1, VpSel::VINP0), (OPAMP2, VpSel::VINP0), (OPAMP3, VpSel::VINP2)]
    {
        amplifier.csr().write(|w| {
            w.set_vp_sel(input);
            w.set_vm_sel(VmSel::PGA);
            w.set_pga_gain(PgaGain::GAIN16_INPUT_VINM0);
            w.set_opahsm(true);
            w.set_opampen(true);
        });
    }
    // 0.29 µs for an amplifier, 2.2 µs for the bus voltage's 16 kΩ, 1.1 µs for the thermistor's 3 kΩ.
    ADC1.smpr().write(|w| {
        w.set_smp(U_CHANNEL.into(), SampleTime::CYCLES12_5);
        w.set_smp(BUS_CHANNEL.into(), SampleTime::CYCLES92_5);
        w.set_smp(TEMPERATURE_CHANNEL.into(), SampleTime::CYCLES47_5);
    });
    ADC2.smpr().write(|w| w.set_smp(V_CHANNEL.into(), SampleTime::CYCLES12_5));
    let are_up = power_up(ADC1) && power_up(ADC2);
    // Before it waits for triggers: RM0440, 21.4.10.
    ADC1.ier().write(|w| w.set_jeosie(true));
    sequence(ADC1, &[U_CHANNEL, BUS_CHANNEL, TEMPERATURE_CHANNEL]);
    sequence(ADC2, &[V_CHANNEL]);
    are_up
}

/// Regulator, calibration, enable.
fn power_up(converter: Adc) -> bool {
    converter.cr().write(|w| w.set_deeppwd(false));
    converter.cr().write(|w| w.set_advregen(true));
    // The regulator's start-up time is 20 µs.
    cortex_m::asm::delay(40 * super::CYCLES_PER_MICROSECOND);
    converter.cr().modify(|w| w.set_adcal(true));
    let is_calibrated = wait_for(|| !converter.cr().read().adcal());
    // Not sooner than 4 cycles of the converter's clock after that.
    cortex_m::asm::delay(super::CYCLES_PER_MICROSECOND);
    converter.isr().write(|w| w.set_adrdy(true));
    converter.cr().modify(|w| w.set_aden(true));
    is_calibrated && wait_for(|| converter.isr().read().adrdy())
}

/// Channels to convert at each trigger.
fn sequence(converter: Adc, channels: &[u8]) {
    converter.jsqr().write(|w| {
        w.set_jextsel(TRIGGER);
        w.set_jexten(Exten::RISING_EDGE);
        w.set_jl(channels.len() as u8 - 1);
        for (rank, channel) in channels.iter().enumerate() {
            w.set_jsq(rank, *channel);
        }
    });
    converter.cr().modify(|w| w.set_jadstart(true));
}

/// This period's conversions, and no interrupt until the next ones.
#[inline]
pub fn read() -> Conversions {
    let clear = |converter: Adc| {
        converter.isr().write(|w| {
            w.set_jeoc(true);
            w.set_jeos(true);
        });
    };
    clear(ADC1);
    clear(ADC2);
    let code = |converter: Adc, rank| converter.jdr(rank).read().jdata();
    Conversions {
        legs: [code(ADC1, 0), code(ADC2, 0)],
        bus_voltage: code(ADC1, 1),
        temperature: code(ADC1, 2),
    }
}

/// Temperature of the board (°C).
#[inline]
pub fn celsius(code: u16) -> f32 {
    Thermistor::NTC_10K_WITH_4K7.celsius(code)
}
