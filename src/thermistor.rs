//! Temperature from a thermistor's code.

/// A thermistor with a negative temperature coefficient, from the converter's reference to its input, and a resistor from there
/// to ground: codes rise with the temperature.
///
/// A table over the converter's 12 bits, straight lines between its points.
#[derive(Clone, Copy, Debug)]
pub struct Thermistor {
    /// Temperatures (°C) at the codes 0, 256, 512 … 4096.
    pub table: [f32; 17],
}

impl Thermistor {
    /// 10 kΩ at 25 °C with β = 3425 K, and 4.7 kΩ to ground: the B-G431B-ESC1's. Below −45 °C it is open, above
    /// 160 °C shorted.
    pub const NTC_10K_WITH_4K7: Self = Self {
        table: [
            -49.3, -18.3, -3.0, 7.6, 16.3, 24.1, 31.5, 38.7, 46.0, 53.6, 61.9, 71.3, 82.4, 96.5,
            116.6, 153.7, 500.0,
        ],
    };

    /// Temperature (°C) for a code from 0 to 4095; larger ones count as 4095.
    #[inline]
    pub fn celsius(&self, code: u16) -> f32 {
        let code = code.min(4095);
        // The mask is the whole index: the compiler sees that it is within the table.
        let segment = usize::from(code >> 8) & 15;
        let (from, to) = (self.table[segment], self.table[segment + 1]);
        from + (to - from) * f32::from(code & 255) / 256.0
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The code at a temperature, by the β formula: R = R25·e^(β·(1/T − 1/T25)).
    fn code(celsius: f64) -> f64 {
        let resistance = 10e3 * libm::exp(3425.0 * (1.0 / (celsius + 273.15) - 1.0 / 298.15));
        4096.0 * 4.7e3 / (4.7e3 + resistance)
    }

    #[test]
    fn temperatures_are_those_of_the_formula() {
        for celsius in -40..=115 {
            let told = Thermistor::NTC_10K_WITH_4K7.celsius(code(celsius.into()) as u16);
            // What a line between two points of the table misses of the curve: most where it is steepest.
            let error = if (-15..105).contains(&celsius) { 1.0 } else { 5.0 };
            assert!((told - celsius as f32).abs() < error, "{celsius} °C told as {told} °C");
        }
    }

    #[test]
    fn a_broken_thermistor_shows_no_temperature_of_a_board() {
        let ntc = Thermistor::NTC_10K_WITH_4K7;
        assert!(ntc.celsius(10) < -45.0, "open");
        assert!(ntc.celsius(4090) > 160.0, "shorted");
        assert_eq!(ntc.celsius(u16::MAX), ntc.celsius(4095));
    }
}
