//! Voltages at the analogue pins: networks of the B-G431B-ESC1 with tolerances of nobody's parts, noise and faults.
//!
//! Values from `BOARD.md`'s sources; the amplification by 16 is the microcontroller's.

use crate::sensors::noise;
use rand::rngs::StdRng;
use rand_distr::{Distribution, Normal};

/// Supply of the networks (V).
const SUPPLY: f64 = 3.3;

/// Most that a pin's clamping diodes let it leave the supply by (V).
const CLAMP: f64 = 0.3;

/// Conductances at a shunt's pad (S): to the supply, to ground, from the shunt.
const TO_SUPPLY: f64 = 1.0 / 22e3;
const TO_GROUND: f64 = 1.0 / 2.2e3;
const TO_SHUNT: f64 = 1.0 / 1.5e3;

/// The bus voltage's divider: 169 kΩ, 18 kΩ.
const BUS_SHARE: f64 = 18.0 / (169.0 + 18.0);

/// The thermistor: 10 kΩ at 25 °C, β = 3425 K, from the supply; 4.7 kΩ to ground.
const THERMISTOR: f64 = 10e3;
const BETA: f64 = 3425.0;
const BELOW_THERMISTOR: f64 = 4.7e3;
const KELVIN: f64 = 273.15;

/// What is wrong with a current sensor.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum ShuntFault {
    /// It shows this current (A), from the leg to ground, whatever flows.
    Stuck(f64),
    /// Its pad is at the supply, which drives the amplifier to its upper end.
    High,
    /// Its pad is at ground, which drives the amplifier to its lower end.
    Low,
    /// Its offset drifts at this rate (A/s).
    Drift(f64),
    /// It shows this share of the current.
    Gain(f64),
}

/// What is wrong with the thermistor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ThermistorFault {
    /// It is off.
    Open,
    /// It is bridged.
    Shorted,
}

/// How the sensors err.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Errors {
    /// Offsets of the shunts' amplifiers, of U and V (A).
    pub shunt_offsets: [f64; 2],
    /// Noise of each (A rms).
    pub shunt_noise: f64,
    /// Noise of the bus voltage (V rms).
    pub bus_noise: f64,
}

/// The networks ahead of the pins.
#[derive(Clone, Debug)]
pub struct Pads {
    errors: Errors,
    random: StdRng,
    shunt_noise: Normal<f64>,
    bus_noise: Normal<f64>,
    /// What is wrong with the sensors of U and V, and since when (s).
    pub shunt_faults: [Option<(f64, ShuntFault)>; 2],
    /// What is wrong with the thermistor.
    pub thermistor_fault: Option<ThermistorFault>,
}

impl Pads {
    /// All well; deviations must be finite and not negative.
    pub fn new(errors: Errors, random: StdRng) -> Self {
        Self {
            errors,
            random,
            shunt_noise: noise(errors.shunt_noise),
            bus_noise: noise(errors.bus_noise),
            shunt_faults: [None; 2],
            thermistor_fault: None,
        }
    }

    /// Of a leg's shunt, ahead of its amplifier (V), for a current from the leg to ground (A).
    pub fn shunt(&mut self, time: f64, leg: usize, current: f64) -> f64 {
        let shown = current + self.errors.shunt_offsets[leg];
        let noise = self.shunt_noise.sample(&mut self.random);
        match self.shunt_faults[leg] {
            None => shunt_pad(shown + noise),
            Some((since, ShuntFault::Drift(rate))) => {
                shunt_pad(shown + noise + rate * (time - since))
            }
            Some((_, ShuntFault::Gain(share))) => shunt_pad(share * shown + noise),
            Some((_, ShuntFault::Stuck(stuck))) => shunt_pad(stuck),
            Some((_, ShuntFault::High)) => SUPPLY,
            Some((_, ShuntFault::Low)) => 0.0,
        }
    }

    /// Of the divided bus voltage (V).
    pub fn bus(&mut self, voltage: f64) -> f64 {
        let noise = self.bus_noise.sample(&mut self.random);
        ((voltage + noise) * BUS_SHARE).clamp(-CLAMP, SUPPLY + CLAMP)
    }

    /// Of the thermistor's divider (V), at a temperature (°C).
    pub fn temperature(&self, celsius: f64) -> f64 {
        match self.thermistor_fault {
            Some(ThermistorFault::Open) => 0.0,
            Some(ThermistorFault::Shorted) => SUPPLY,
            None => {
                let inverse = 1.0 / (celsius + KELVIN) - 1.0 / (25.0 + KELVIN);
                let thermistor = THERMISTOR * (BETA * inverse).exp();
                SUPPLY * BELOW_THERMISTOR / (BELOW_THERMISTOR + thermistor)
            }
        }
    }

    /// Of the potentiometer (V), at a share of its way.
    pub fn potentiometer(&self, share: f64) -> f64 {
        SUPPLY * share
    }
}

/// Of a shunt without current in it, that of W, and of what the others' amplifiers show as a current (A).
pub fn shunt_pad(current: f64) -> f64 {
    let shunt = current * super::circuit::SHUNT;
    (SUPPLY * TO_SUPPLY + shunt * TO_SHUNT) / (TO_SUPPLY + TO_GROUND + TO_SHUNT)
}

#[cfg(test)]
mod tests {
    use super::*;
    use quasidrive::thermistor::Thermistor;
    use rand::SeedableRng;

    fn pads(errors: Errors) -> Pads {
        Pads::new(errors, StdRng::seed_from_u64(7))
    }

    #[test]
    fn a_shunt_after_the_amplifier_is_as_the_firmware_takes_it() {
        // 2.057 V + 27.43 mV/A.
        assert!((16.0 * shunt_pad(0.0) - 2.057).abs() < 5e-4);
        let slope = 16.0 * (shunt_pad(1.0) - shunt_pad(0.0));
        assert!((slope - 27.43e-3).abs() < 5e-6, "{slope}");
        // And ends at +41 A and −71 A or beyond, as the converters' range does.
        assert!(16.0 * shunt_pad(45.5) > 3.3 && 16.0 * shunt_pad(-75.1) < 0.0);
        assert!(16.0 * shunt_pad(45.0) < 3.3 && 16.0 * shunt_pad(-74.9) > 0.0);
    }

    #[test]
    fn the_bus_is_divided_and_clamped() {
        let mut pads = pads(Errors::default());
        assert!((pads.bus(24.0) - 2.31016).abs() < 1e-5);
        assert!((pads.bus(60.0) - 3.6).abs() < 1e-12);
    }

    #[test]
    fn the_firmware_reads_the_board_s_temperature() {
        let mut pads = pads(Errors::default());
        let read = |pads: &Pads, celsius| {
            Thermistor::NTC_10K_WITH_4K7.celsius((pads.temperature(celsius) / 3.3 * 4096.0) as u16)
        };
        for celsius in [-10.0, 25.0, 60.0, 85.0, 100.0] {
            let told = read(&pads, celsius);
            assert!((f64::from(told) - celsius).abs() < 1.0, "{celsius} °C told as {told} °C");
        }
        pads.thermistor_fault = Some(ThermistorFault::Open);
        assert!(read(&pads, 25.0) < -45.0);
        pads.thermistor_fault = Some(ThermistorFault::Shorted);
        assert!(read(&pads, 25.0) > 160.0);
    }

    #[test]
    fn noise_has_its_deviation_and_comes_again_with_its_seed() {
        let errors = Errors { shunt_offsets: [0.5, -0.25], shunt_noise: 0.1, bus_noise: 0.02 };
        let [mut one, mut other] = [pads(errors), pads(errors)];
        let zero = shunt_pad(0.0);
        let per_ampere = shunt_pad(1.0) - zero;
        let shown: Vec<f64> =
            (0..10_000).map(|_| (one.shunt(0.0, 0, 2.0) - zero) / per_ampere).collect();
        let mean = shown.iter().sum::<f64>() / 1e4;
        let deviation =
            (shown.iter().map(|current| (current - mean).powi(2)).sum::<f64>() / 1e4).sqrt();
        // Four standard errors of each.
        assert!((mean - 2.5).abs() < 4e-3, "{mean} A");
        assert!((deviation - 0.1).abs() < 3e-3, "{deviation} A");
        for current in shown {
            assert_eq!((other.shunt(0.0, 0, 2.0) - zero) / per_ampere, current);
        }
        assert_eq!(one.shunt(0.0, 1, 0.0), other.shunt(0.0, 1, 0.0));
    }

    #[test]
    fn faulty_current_sensors_show_what_they_are_to() {
        let mut pads = pads(Errors::default());
        let mut shown = |fault, time| {
            pads.shunt_faults = [None, Some((1.0, fault))];
            assert_eq!(pads.shunt(time, 0, 3.0), shunt_pad(3.0), "the other leg's is well");
            pads.shunt(time, 1, 3.0)
        };
        assert_eq!(shown(ShuntFault::Stuck(-2.0), 4.0), shunt_pad(-2.0));
        assert_eq!(shown(ShuntFault::High, 4.0), 3.3);
        assert_eq!(shown(ShuntFault::Low, 4.0), 0.0);
        assert_eq!(shown(ShuntFault::Gain(0.5), 4.0), shunt_pad(1.5));
        assert_eq!(shown(ShuntFault::Drift(0.5), 1.0), shunt_pad(3.0));
        assert_eq!(shown(ShuntFault::Drift(0.5), 4.0), shunt_pad(4.5));
    }
}
