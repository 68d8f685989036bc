//! From a board's sample to SI units: the only place that knows codes and counts.

use crate::config::{ConfigError, positive, require};
use crate::hal::{Codes, Exact, READS, Sample};
use crate::math::Scalar;
use serde::{Deserialize, Serialize};

/// What a board's samples are.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Sensors {
    /// [`Sample::Exact`].
    Exact,
    /// [`Sample::Codes`] with this calibration.
    Codes(Calibration),
}

/// What codes and counts mean.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Calibration {
    /// Armature current per code (A); negative if the sensor is mounted the other way round. Not zero.
    pub current_per_code: f32,
    /// Code at no current, a fraction where it was averaged.
    pub current_zero: f32,
    /// Bus voltage per code (V). Positive.
    pub bus_voltage_per_code: f32,
    /// Counts of the encoder per turn, all four edges of its lines counted; negative if it counts the other way round.
    /// From ±16 to ±65536.
    pub counts_per_turn: i32,
    /// Highest code of the converters. At the ends of its range a converter saturates: the over-current trip must lie within.
    pub highest_code: u16,
    /// Which of a period's reads of the encoder's counter count.
    pub reads: Reads,
}

/// Which of a period's reads of the encoder's counter count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reads {
    /// The mean of all: far finer than a count, since the reads see the edges pass.
    #[default]
    All,
    /// The mean of all, which the board reads earlier by a random [`shift`](Codes::shift) in each period. Near speeds at which
    /// the counts beat with the reads the others' error grows tenfold; with this it does not, at the price of somewhat more
    /// ripple elsewhere.
    Shifted,
    /// The last one, for comparison.
    Last,
}

impl Calibration {
    /// The angle of a count (rad).
    pub fn count(&self) -> f32 {
        core::f32::consts::TAU / self.counts_per_turn as f32
    }

    /// How long before the sample the encoder's reads lie in the mean (s), for a sampling period (s).
    pub fn age(&self, period: f32) -> f32 {
        match self.reads {
            Reads::All => period * (READS - 1) as f32 / (2 * READS) as f32,
            // Half a read's distance earlier in the mean.
            Reads::Shifted => 0.5 * period,
            Reads::Last => 0.0,
        }
    }
}

impl Sensors {
    /// How long before the sample the angle lies (s), for a sampling period (s).
    pub fn age(&self, period: f32) -> f32 {
        match self {
            Self::Exact => 0.0,
            Self::Codes(calibration) => calibration.age(period),
        }
    }

    /// The smallest angle that they tell (rad).
    pub(crate) fn resolution(&self) -> f32 {
        match self {
            Self::Exact => 0.0,
            Self::Codes(calibration) => calibration.count().abs(),
        }
    }
}

/// A sample in SI units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured<S> {
    /// Angle turned from the last sample's reads to this one's (rad).
    pub advance: S,
    /// How much more than their mean age this sample's reads lie back (s).
    pub extra_age: S,
    /// Shaft speed ω (rad/s), from exact sensors; zero from an encoder.
    pub speed: S,
    /// Armature current i (A).
    pub current: S,
    /// Bus voltage (V).
    pub bus_voltage: S,
}

/// Turns samples into SI units.
#[derive(Clone, Debug)]
#[repr(C)]
pub struct Sensing<S: Scalar> {
    encoder: Option<Encoder<S>>,
    current: S::Gain,
    current_zero: S,
    bus_voltage: S::Gain,
}

#[derive(Clone, Debug)]
struct Encoder<S: Scalar> {
    /// Sum of the last sample's reads that count.
    before: u16,
    reads: Reads,
    /// Angle per unit of that sum (rad).
    angle: S::Gain,
    /// Time per unit of the shift (s).
    shift: S::Gain,
    /// Mean of what the shift adds to the age (s).
    mean_shift: S,
}

impl<S: Scalar> Sensing<S> {
    /// For a drive's largest speed (rad/s), over-current trip (A) and sampling rate (Hz).
    pub(crate) fn new(
        sensors: &Sensors,
        speed: f32,
        over_current: f32,
        rate: f32,
    ) -> Result<Self, ConfigError> {
        let &Sensors::Codes(calibration) = sensors else {
            return Ok(Self {
                encoder: None,
                current: S::gain(1.0),
                current_zero: S::ZERO,
                bus_voltage: S::gain(1.0),
            });
        };
        let Calibration { current_per_code, current_zero, bus_voltage_per_code, .. } = calibration;
        positive("sensors.current_per_code", current_per_code.abs())?;
        let highest = f32::from(calibration.highest_code);
        require(
            (0.0..=highest).contains(&current_zero),
            "sensors.current_zero",
            "must be a code, from 0 to the highest",
            current_zero,
        )?;
        let range = current_per_code.abs() * current_zero.min(highest - current_zero);
        require(
            over_current < range,
            "limits.current",
            "must be within the range of the current's converter",
            over_current,
        )?;
        positive("sensors.bus_voltage_per_code", bus_voltage_per_code)?;
        let counts = calibration.counts_per_turn;
        require(
            (16..=65536).contains(&counts.unsigned_abs()),
            "sensors.counts_per_turn",
            "must be from 16 to 65536, or negative",
            counts as f32,
        )?;
        // The sum of 16 reads moves by 16 counts a count, and must not move by half its range in a period.
        require(
            speed <= 1000.0 * calibration.count().abs() * rate,
            "limits.speed",
            "must be at most 1000 counts a period",
            speed,
        )?;
        let distance = 1.0 / (rate * READS as f32);
        let (reads, shift) = match calibration.reads {
            Reads::All => (READS as f32, 0.0),
            Reads::Shifted => (READS as f32, distance),
            Reads::Last => (1.0, 0.0),
        };
        Ok(Self {
            encoder: Some(Encoder {
                before: 0,
                reads: calibration.reads,
                angle: S::gain(calibration.count() / reads),
                shift: S::gain(shift / 256.0),
                mean_shift: S::from_f32(0.5 * shift),
            }),
            current: S::gain(current_per_code),
            current_zero: S::from_f32(current_zero),
            bus_voltage: S::gain(bus_voltage_per_code),
        })
    }

    /// A sample in SI units; nothing for one of the other kind. The advance of the first sample means nothing.
    #[inline]
    pub fn read(&mut self, sample: &Sample<S>) -> Option<Measured<S>> {
        match (sample, &mut self.encoder) {
            (Sample::Codes(codes), Some(encoder)) => {
                let current = S::from_code(codes.current) - self.current_zero;
                let bus_voltage = S::from_code(codes.bus_voltage);
                Some(Measured {
                    advance: encoder.advance(codes),
                    extra_age: encoder.extra_age(codes),
                    speed: S::ZERO,
                    current: S::combine([(self.current, current)]),
                    bus_voltage: S::combine([(self.bus_voltage, bus_voltage)]),
                })
            }
            (&Sample::Exact(Exact { speed, advance, current, bus_voltage }), None) => {
                Some(Measured { advance, extra_age: S::ZERO, speed, current, bus_voltage })
            }
            _ => None,
        }
    }
}

impl<S: Scalar> Encoder<S> {
    /// Sums modulo 2¹⁶ differ by the true difference as long as that is below 2¹⁵, whatever has wrapped: no angle is kept.
    #[inline]
    fn advance(&mut self, codes: &Codes) -> S {
        let sum = match self.reads {
            Reads::All | Reads::Shifted => sum(&codes.encoder),
            Reads::Last => codes.encoder[READS - 1],
        };
        let difference = sum.wrapping_sub(self.before) as i16;
        self.before = sum;
        S::combine([(self.angle, S::from_difference(difference))])
    }

    #[inline]
    fn extra_age(&self, codes: &Codes) -> S {
        S::combine([(self.shift, S::from_code(codes.shift.into()))]) - self.mean_shift
    }
}

/// Sum modulo 2¹⁶, two reads at a time.
#[inline]
fn sum(reads: &[u16; READS]) -> u16 {
    let pairs =
        reads.as_chunks().0.iter().map(|[low, high]| u32::from(*low) | u32::from(*high) << 16);
    pairs.fold(0, |sum: u32, pair| sum.wrapping_add(pair).wrapping_add(pair >> 16)) as u16
}
