//! Every pin that the firmware uses.
//!
//! Sources: *UM* is ST's UM2516 (user manual of the board, Rev 4), *MC* ST's motor control project for the board (MCSDK 6.2), *SF* the
//! Arduino-FOC driver for it, *DS* the microcontroller's data sheet DS12589. None was measured by us. Each was found in at least two
//! of UM, MC and SF; alternate functions are from DS, table 13.

use Function::{Alternate, Analog, High, Low};
use embassy_stm32::pac;
use embassy_stm32::pac::gpio::vals::{Moder, Ospeedr, Pupdr};

/// What a pin is.
#[derive(Clone, Copy)]
enum Function {
    /// Driven or read by the peripheral with this number.
    Alternate(u8),
    /// For converters, amplifiers and comparators.
    Analog,
    /// Driven low.
    Low,
    /// Driven high.
    High,
}

struct Pin {
    port: pac::gpio::Gpio,
    number: usize,
    function: Function,
    pull: Pupdr,
}

const fn pin(port: pac::gpio::Gpio, number: usize, function: Function) -> Pin {
    Pin { port, number, function, pull: Pupdr::FLOATING }
}

/// To the gate drivers: low, also while nobody drives it.
const fn gate(port: pac::gpio::Gpio, number: usize, function: Function) -> Pin {
    Pin { port, number, function, pull: Pupdr::PULL_DOWN }
}

use pac::{GPIOA, GPIOB, GPIOC};

/// To be set up first: the third half-bridge, which is not used, is off.
const UNUSED_LEG: [Pin; 2] = [
    gate(GPIOA, 10, Low), // W high side (UM, MC, SF)
    gate(GPIOB, 15, Low), // W low side (UM, MC, SF)
];

/// To be set up once TIM1 drives its outputs low.
const BRIDGE: [Pin; 4] = [
    gate(GPIOA, 8, Alternate(6)),  // TIM1_CH1: U high side (UM, MC, SF)
    gate(GPIOC, 13, Alternate(4)), // TIM1_CH1N: U low side (UM, MC, SF)
    gate(GPIOA, 9, Alternate(6)),  // TIM1_CH2: V high side (UM, MC, SF)
    gate(GPIOA, 12, Alternate(6)), // TIM1_CH2N: V low side (UM, MC, SF)
];

const SENSORS: [Pin; 14] = [
    pin(GPIOA, 1, Analog),  // OPAMP1_VINP0, and OPAMP3_VINP2: U shunt + (UM, MC)
    pin(GPIOA, 3, Analog),  // OPAMP1_VINM0: U shunt − (UM, MC)
    pin(GPIOA, 2, Analog),  // OPAMP1_VOUT, ADC1_IN3: U current (UM, MC, SF)
    pin(GPIOA, 7, Analog),  // OPAMP2_VINP0: V shunt + (UM, MC)
    pin(GPIOA, 5, Analog),  // OPAMP2_VINM0: V shunt − (UM, MC)
    pin(GPIOA, 6, Analog),  // OPAMP2_VOUT, ADC2_IN3: V current (UM, MC, SF)
    pin(GPIOB, 2, Analog), // OPAMP3_VINM0: W shunt −, which is ground: W carries no current (UM, MC)
    pin(GPIOB, 1, Analog), // OPAMP3_VOUT, COMP1_INP1: U current again, for the comparator (DS; our own use, not tried)
    pin(GPIOA, 0, Analog), // ADC1_IN1: bus voltage, 169 kΩ to 18 kΩ (UM, MC, SF)
    pin(GPIOB, 14, Analog), // ADC1_IN5: thermistor (UM, MC, SF)
    pin(GPIOB, 6, Alternate(2)), // TIM4_CH1: encoder A, pulled up on the board (UM, MC)
    pin(GPIOB, 7, Alternate(2)), // TIM4_CH2: encoder B (UM, MC)
    pin(GPIOB, 5, High), // no supply for the dividers of the terminals' voltages, which are not used (MC)
    pin(GPIOC, 14, Low), // CAN's termination off (UM)
];

/// Switches the leg that is not used off.
pub(super) fn start_unused_leg() {
    UNUSED_LEG.iter().for_each(Pin::start);
}

/// Connects the bridge to TIM1.
pub(super) fn start_bridge() {
    BRIDGE.iter().for_each(Pin::start);
}

/// Connects all sensors.
pub(super) fn start_sensors() {
    SENSORS.iter().for_each(Pin::start);
}

impl Pin {
    fn start(&self) {
        let &Self { port, number, function, pull } = self;
        port.pupdr().modify(|w| w.set_pupdr(number, pull));
        port.ospeedr().modify(|w| w.set_ospeedr(number, Ospeedr::MEDIUM_SPEED));
        // The level before the direction: no pulse.
        let mode = match function {
            Analog => Moder::ANALOG,
            Alternate(peripheral) => {
                port.afr(number / 8).modify(|w| w.set_afr(number % 8, peripheral));
                Moder::ALTERNATE
            }
            Low => {
                port.bsrr().write(|w| w.set_br(number, true));
                Moder::OUTPUT
            }
            High => {
                port.bsrr().write(|w| w.set_bs(number, true));
                Moder::OUTPUT
            }
        };
        port.moder().modify(|w| w.set_moder(number, mode));
    }
}
