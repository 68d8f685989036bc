//! From a board's sample to SI units: the only place that knows codes and counts.

use crate::config::{ConfigError, positive, require};
use crate::hal::{Codes, Exact, READS, Sample};
use crate::limits::Limits;
use crate::math::{Base, Scalar};
use crate::per_unit::Bases;
use crate::schema::{choice, group};

/// What a board's samples are.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sensors {
    /// [`Sample::Exact`].
    Exact,
    /// [`Sample::Codes`] with this calibration.
    Codes(Calibration),
}

choice! { Sensors { Exact, Codes(calibration) } }

/// What codes and counts mean.
#[derive(Clone, Copy, Debug, PartialEq)]
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

group! {
    Calibration {
        current_per_code, current_zero, bus_voltage_per_code, counts_per_turn, highest_code, reads,
    }
}

/// Which of a period's reads of the encoder's counter count.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
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
    /// The last one for the angle; and the speed itself from the times of edges (M/T method), for comparison: counts from the
    /// last edge of one period to the last edge of a later one, over the time between, to within the distance of two reads.
    Edges,
}

choice! { Reads { All, Shifted, Last, Edges } }

impl Calibration {
    /// The angle of a count (rad).
    pub fn count(&self) -> f32 {
        core::f32::consts::TAU / self.counts_per_turn as f32
    }

    /// How long before the sample the encoder's reads lie in the mean (s), for a sampling period (s).
    pub fn age(&self, period: f32) -> f32 {
        match self.reads {
            // Half a read's distance earlier in the mean.
            Reads::Shifted => 0.5 * period,
            _ => self.least_age(period),
        }
    }

    /// The same without a shift.
    fn least_age(&self, period: f32) -> f32 {
        match self.reads {
            Reads::All | Reads::Shifted => period * (READS - 1) as f32 / (2 * READS) as f32,
            Reads::Last | Reads::Edges => 0.0,
        }
    }
}

impl Sensors {
    /// What is known of the shaft's angle, for a sampling period (s).
    pub(crate) fn shaft(&self, period: f32) -> Shaft {
        let exact = Shaft {
            period,
            least_age: 0.0,
            age: 0.0,
            unit: 1.0,
            counts: false,
            speed: true,
            grain: 0.0,
        };
        match self {
            Self::Exact => exact,
            Self::Codes(calibration) => Shaft {
                least_age: calibration.least_age(period),
                age: calibration.age(period),
                unit: calibration.count(),
                counts: matches!(calibration.reads, Reads::All | Reads::Shifted),
                speed: calibration.reads == Reads::Edges,
                grain: 1.0,
                ..exact
            },
        }
    }
}

/// How the shaft turned, in counts of the encoder, or in rad from exact sensors.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rotation<S> {
    /// From the mean of the last sample's reads to the mean of this one's.
    pub advance: S,
    /// From this sample's last read to the mean of its reads.
    pub behind: S,
    /// How much earlier than usual the reads were, in 1/256 of the distance of two reads.
    pub shift: u8,
}

/// What is known of a shaft's angle.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Shaft {
    /// Sampling period (s).
    pub period: f32,
    /// How long before a sample the mean of its reads lies when they are not shifted (s).
    pub least_age: f32,
    /// How long it lies before it in the mean (s).
    pub age: f32,
    /// The angle of a unit of [`Rotation`] (rad).
    pub unit: f32,
    /// Whether a sample holds 16 reads of a counter that count.
    pub counts: bool,
    /// Whether a sample tells the speed.
    pub speed: bool,
    /// The smallest rotation that is told (in those units).
    pub grain: f32,
}

/// A sample in SI units.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Measured<S> {
    /// How the shaft turned.
    pub rotation: Rotation<S>,
    /// Shaft speed ω (rad/s), from exact sensors or the times of edges; else zero.
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
    current: S::Steep<1>,
    current_zero: S,
    bus_voltage: S::Steep<1>,
}

#[derive(Clone, Debug)]
struct Encoder<S: Scalar> {
    /// The last sample's last read.
    last: u16,
    /// How far the mean of its reads lay behind (sixteenths of a count).
    behind: i16,
    reads: Reads,
    edges: Edges<S>,
}

/// Speed by the M/T method.
#[derive(Clone, Debug)]
struct Edges<S> {
    /// The last read.
    before: Option<u16>,
    /// The count behind the last edge, if there was one.
    last: Option<u16>,
    /// Whether the last edge was one up.
    up: bool,
    /// Reads since then.
    reads_since: i16,
    /// Speed (rad/s).
    speed: S,
    /// Speed of a count from one read to the next (rad/s).
    count_per_read: S,
}

impl<S: Scalar> Edges<S> {
    fn step(&mut self, reads: &[u16; READS]) -> S {
        let mut edge = None;
        for (index, &read) in reads.iter().enumerate() {
            if self.before.replace(read).is_some_and(|before| before != read) {
                edge = Some((index as i16 + 1, read));
            }
        }
        match edge {
            Some((index, count)) => {
                if let Some(last) = self.last.replace(count) {
                    let reads = self.reads_since.saturating_add(index);
                    let counts = count.wrapping_sub(last) as i16;
                    // Back across the same edge says nothing of how fast.
                    let turned = core::mem::replace(&mut self.up, counts > 0) != (counts > 0);
                    self.speed =
                        self.count_per_read.fraction(if turned { 0 } else { counts }, reads);
                }
                self.reads_since = READS as i16 - index;
            }
            None => {
                // As long as no edge comes the speed is at most a count in the time since the last one.
                self.reads_since = self.reads_since.saturating_add(READS as i16);
                let most = self.count_per_read.fraction(1, self.reads_since);
                self.speed = match self.reads_since {
                    i16::MAX => S::ZERO,
                    _ => self.speed.limited(most.abs()),
                };
            }
        }
        self.speed
    }
}

impl<S: Scalar> Sensing<S> {
    /// For a drive's limits, all of which must lie within what the sensors tell, and its sampling rate (Hz).
    pub(crate) fn new(
        sensors: &Sensors,
        limits: &Limits,
        rate: f32,
        bases: &Bases,
    ) -> Result<Self, ConfigError> {
        let &Limits { speed, current: over_current, bus_max, .. } = limits;
        let &Sensors::Codes(calibration) = sensors else {
            return Ok(Self {
                encoder: None,
                current: S::steep("sensors", [(1.0, Base::CODE)], Base::CODE)?,
                current_zero: S::ZERO,
                bus_voltage: S::steep("sensors", [(1.0, Base::CODE)], Base::CODE)?,
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
        require(
            bus_max < highest * bus_voltage_per_code,
            "limits.bus_max",
            "must be within the range of the bus voltage's converter",
            bus_max,
        )?;
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
        let count_per_read = calibration.count() * rate * READS as f32;
        Ok(Self {
            encoder: Some(Encoder {
                last: 0,
                behind: 0,
                reads: calibration.reads,
                edges: Edges {
                    before: None,
                    last: None,
                    up: true,
                    reads_since: 0,
                    speed: S::ZERO,
                    count_per_read: S::from_f32(count_per_read, bases.speed),
                },
            }),
            current: S::steep(
                "sensors.current_per_code",
                [(current_per_code, Base::CODE)],
                bases.current,
            )?,
            current_zero: S::from_f32(current_zero, Base::CODE),
            bus_voltage: S::steep(
                "sensors.bus_voltage_per_code",
                [(bus_voltage_per_code, Base::CODE)],
                bases.voltage,
            )?,
        })
    }

    /// A sample in SI units; nothing for one of the other kind. The advance of the first sample means nothing.
    #[inline(always)]
    pub fn read(&mut self, sample: &Sample<S>) -> Option<Measured<S>> {
        match (sample, &mut self.encoder) {
            (Sample::Codes(codes), Some(encoder)) => {
                let current = S::from_code(codes.current) - self.current_zero;
                let bus_voltage = S::from_code(codes.bus_voltage);
                let rotation = encoder.read(codes);
                let speed = match encoder.reads {
                    Reads::Edges => encoder.edges.step(&codes.encoder),
                    _ => S::ZERO,
                };
                Some(Measured {
                    rotation,
                    speed,
                    current: S::amplify(&self.current, [current]),
                    bus_voltage: S::amplify(&self.bus_voltage, [bus_voltage]),
                })
            }
            (&Sample::Exact(Exact { speed, advance, current, bus_voltage }), None) => {
                let rotation = Rotation { advance, behind: S::ZERO, shift: 0 };
                Some(Measured { rotation, speed, current, bus_voltage })
            }
            _ => None,
        }
    }
}

/// Of reads, modulo 2¹⁶. Written out: where code is made small no loop is unrolled.
#[inline]
fn sum(reads: &[u16; READS]) -> u16 {
    let four = |first: usize| {
        let pair = reads[first].wrapping_add(reads[first + 1]);
        pair.wrapping_add(reads[first + 2]).wrapping_add(reads[first + 3])
    };
    four(0).wrapping_add(four(4)).wrapping_add(four(8)).wrapping_add(four(12))
}

impl<S: Scalar> Encoder<S> {
    /// No angle is kept: from one sample to the next the last read moves by less than 2¹⁵ counts, whatever has wrapped, and the mean
    /// of the reads lies behind it by less than 2¹¹.
    #[inline]
    fn read(&mut self, codes: &Codes) -> Rotation<S> {
        let last = codes.encoder[READS - 1];
        let behind = match self.reads {
            Reads::All | Reads::Shifted => {
                sum(&codes.encoder).wrapping_sub(last.wrapping_mul(READS as u16)) as i16
            }
            Reads::Last | Reads::Edges => 0,
        };
        let moved = i32::from(last.wrapping_sub(self.last) as i16) * READS as i32;
        let rotation = Rotation {
            advance: S::from_sixteenths(moved + i32::from(behind) - i32::from(self.behind)),
            behind: S::from_sixteenths(behind.into()),
            shift: if self.reads == Reads::Shifted { codes.shift } else { 0 },
        };
        self.last = last;
        self.behind = behind;
        rotation
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::estimate::{SpeedEstimator, SpeedSource};

    const GOOD: Calibration = Calibration {
        current_per_code: 0.01,
        current_zero: 2048.0,
        bus_voltage_per_code: 0.0075,
        counts_per_turn: 4096,
        highest_code: 4095,
        reads: Reads::All,
    };
    fn limits(speed: f32) -> Limits {
        Limits {
            duty: 0.9,
            speed,
            current: 20.0,
            current_command: 15.0,
            bus_min: 8.0,
            bus_max: 28.0,
        }
    }

    const COUNT: f32 = core::f32::consts::TAU / 4096.0;

    fn built(sensors: &Sensors, limits: &Limits) -> Result<Sensing<f32>, ConfigError> {
        Sensing::new(sensors, limits, 20_000.0, &Bases::NONE)
    }

    fn sensing(calibration: Calibration) -> Sensing<f32> {
        built(&Sensors::Codes(calibration), &limits(1000.0)).expect("valid")
    }

    fn codes(encoder: [u16; READS]) -> Sample<f32> {
        Sample::Codes(Codes { current: 2048, bus_voltage: 3200, encoder, shift: 0 })
    }

    /// Reads of a counter that moves by `per_read` from read to read and starts at `from`.
    fn moving(from: u16, per_read: i32) -> [u16; READS] {
        core::array::from_fn(|read| from.wrapping_add((per_read * read as i32) as u16))
    }

    fn advance(sensing: &mut Sensing<f32>, encoder: [u16; READS]) -> f32 {
        sensing.read(&codes(encoder)).expect("codes").rotation.advance * COUNT
    }

    #[test]
    fn codes_in_si_units() {
        let sample = Sample::Codes(Codes {
            current: 2148,
            bus_voltage: 3200,
            encoder: [7; READS],
            shift: 0,
        });
        let measured = sensing(GOOD).read(&sample).expect("codes");
        assert!((measured.current - 1.0).abs() < 1e-6, "{measured:?}");
        assert!((measured.bus_voltage - 24.0).abs() < 1e-5, "{measured:?}");
        assert_eq!(measured.speed, 0.0);
        // The other way round, and with a zero between two codes.
        let mounted = Calibration { current_per_code: -0.01, current_zero: 2048.5, ..GOOD };
        let measured = sensing(mounted).read(&sample).expect("codes");
        assert!((measured.current + 0.995).abs() < 1e-6, "{measured:?}");
    }

    #[test]
    fn advance_is_that_of_the_reads_mean_across_wraps_in_both_directions() {
        for (per_read, start) in
            [(1, 65_500_u16), (-1, 40), (3, 65_535), (-3, 0), (50, 1), (-50, 1)]
        {
            let mut sensing = sensing(GOOD);
            advance(&mut sensing, moving(start, per_read));
            for period in 1..2000_i32 {
                let from = start.wrapping_add((period * 16 * per_read) as u16);
                let turned = advance(&mut sensing, moving(from, per_read));
                let expected = 16.0 * per_read as f32 * COUNT;
                let error = (turned / expected - 1.0).abs();
                assert!(error < 1e-6, "{per_read} a read, period {period}: {turned}");
            }
        }
    }

    #[test]
    fn a_jump_by_any_number_of_counts_is_told() {
        for reads in [Reads::All, Reads::Shifted, Reads::Last] {
            for jump in [2048, 4096, -4096, 8192, 12_288, -20_480] {
                let mut sensing = sensing(Calibration { reads, ..GOOD });
                advance(&mut sensing, [123; READS]);
                let to = 123_u16.wrapping_add(jump as u16);
                let turned = advance(&mut sensing, [to; READS]);
                assert!((turned / (jump as f32 * COUNT) - 1.0).abs() < 1e-6, "{reads:?}, {jump}");
                assert_eq!(advance(&mut sensing, [to; READS]), 0.0);
            }
        }
    }

    #[test]
    fn a_single_edge_shows_in_sixteenths_and_adds_up_to_a_count() {
        for seen_by in 1..=READS {
            let mut sensing = sensing(GOOD);
            advance(&mut sensing, [65_535; READS]);
            let passing =
                core::array::from_fn(|read| if read >= READS - seen_by { 0 } else { 65_535 });
            let first = advance(&mut sensing, passing);
            assert!((first - seen_by as f32 / 16.0 * COUNT).abs() < 1e-9, "{seen_by}: {first}");
            let second = advance(&mut sensing, [0; READS]);
            assert!((first + second - COUNT).abs() < 1e-9, "{seen_by}: {second}");
        }
    }

    #[test]
    fn the_last_read_alone_where_asked_for() {
        let mut sensing = sensing(Calibration { reads: Reads::Last, ..GOOD });
        advance(&mut sensing, moving(65_530, 1));
        let mut next = [12_345; READS];
        next[READS - 1] = 65_530_u16.wrapping_add(15 + 20);
        assert!((advance(&mut sensing, next) - 20.0 * COUNT).abs() < 1e-7);
    }

    #[test]
    fn reversed_counts_turn_the_other_way() {
        let reversed = Calibration { counts_per_turn: -4096, ..GOOD };
        // In counts as they are; what a count is worth has the sign.
        assert_eq!(Sensors::Codes(GOOD).shaft(5e-5).unit, COUNT);
        assert_eq!(Sensors::Codes(reversed).shaft(5e-5).unit, -COUNT);
        for calibration in [GOOD, reversed] {
            let source = SpeedSource::Difference { bandwidth: 2e4 };
            let shaft = Sensors::Codes(calibration).shaft(5e-5);
            let mut estimator =
                SpeedEstimator::<f32>::new(&source, &shaft, &Bases::NONE).expect("valid");
            let mut sensing = sensing(calibration);
            let mut speed = 0.0;
            for period in 0..100 {
                let sample = codes([(10 * period) as u16; READS]);
                speed = estimator.step(&sensing.read(&sample).expect("codes"), 0.0);
            }
            let expected = 10.0 * shaft.unit / 5e-5;
            assert!((speed / expected - 1.0).abs() < 1e-3, "{speed} is not {expected}");
        }
    }

    #[test]
    fn edges_tell_the_speed_by_counts_and_times() {
        for speed in [2.0_f64, 30.0, -30.0, 140.0] {
            let mut sensing = sensing(Calibration { reads: Reads::Edges, ..GOOD });
            let (period, count) = (5e-5, f64::from(COUNT));
            let mut told = 0.0;
            for number in 0..4000_u32 {
                let encoder = core::array::from_fn(|read| {
                    let time = (f64::from(number) + (read as f64 + 1.0) / 16.0) * period;
                    // `as` rounds towards zero: kept positive.
                    (speed * time / count + 30_000.3) as u16
                });
                told = f64::from(sensing.read(&codes(encoder)).expect("codes").speed);
            }
            // Two distances of reads in the time between the edges: a period, or a count if that takes longer.
            let error = 2.0 / 16.0_f64.max(16.0 * count / (speed.abs() * period));
            assert!((told / speed - 1.0).abs() < error, "{told} is not {speed}");
            for _ in 0..2000 {
                told = sensing.read(&codes([30_000; READS])).expect("codes").speed.into();
            }
            // Nothing for 0.1 s: a count in that time at most.
            assert!(told.abs() <= count / 0.099, "{told} at rest");
        }
    }

    #[test]
    fn an_edge_that_is_crossed_back_and_forth_is_no_speed() {
        let mut sensing = sensing(Calibration { reads: Reads::Edges, ..GOOD });
        let mut fastest = 0.0_f32;
        for period in 0..100 {
            let encoder = [if period % 2 == 0 { 100 } else { 101 }; READS];
            let speed = sensing.read(&codes(encoder)).expect("codes").speed;
            fastest = fastest.max(speed.abs());
        }
        // At most a count a period, where the first one back was not known for one.
        assert!(fastest <= COUNT / 5e-5, "{fastest}");
    }

    #[test]
    fn only_sensors_that_tell_a_speed_are_a_source_of_it() {
        for (reads, tells) in [
            (Reads::All, false),
            (Reads::Shifted, false),
            (Reads::Last, false),
            (Reads::Edges, true),
        ] {
            let shaft = Sensors::Codes(Calibration { reads, ..GOOD }).shaft(5e-5);
            let built = SpeedEstimator::<f32>::new(&SpeedSource::Exact, &shaft, &Bases::NONE);
            assert_eq!(
                built.map_err(|error| error.field).err(),
                (!tells).then_some("control.speed")
            );
        }
    }

    #[test]
    fn the_largest_accepted_speed_is_told_right_and_a_larger_one_is_refused() {
        // 1000 counts a period are 16,000 of the sum: within ±32,768, the double still is.
        let fastest = 1000.0 * COUNT * 20_000.0;
        let new = |speed| built(&Sensors::Codes(GOOD), &limits(speed));
        assert_eq!(new(1.001 * fastest).expect_err("too fast").field, "limits.speed");
        let mut sensing = new(0.999 * fastest).expect("valid");
        for counts in [1000_i32, -1000, 2000, -2000] {
            advance(&mut sensing, [30_000; READS]);
            let to = (30_000 + counts) as u16;
            let turned = advance(&mut sensing, [to; READS]);
            assert!((turned - counts as f32 * COUNT).abs() < 1e-4, "{counts}: {turned}");
        }
    }

    #[test]
    fn the_reads_age_is_that_of_their_mean() {
        // Reads at 1/16, 2/16 … 16/16 of the period lie 7.5/16 of it back in the mean.
        assert!((GOOD.age(1.0) - 7.5 / 16.0).abs() < 1e-7);
        assert_eq!(Calibration { reads: Reads::Last, ..GOOD }.age(1.0), 0.0);
        assert_eq!(Sensors::Exact.shaft(1.0).age, 0.0);
    }

    #[test]
    fn samples_of_the_other_kind_and_without_numbers_are_none() {
        let exact = Exact { speed: 1.0, advance: 1e-4, current: 2.0, bus_voltage: 24.0 };
        assert!(sensing(GOOD).read(&Sample::Exact(exact)).is_none());
        let mut ideal = built(&Sensors::Exact, &limits(1000.0)).expect("valid");
        assert!(ideal.read(&codes([0; READS])).is_none());
        let measured = ideal.read(&Sample::Exact(exact)).expect("exact");
        assert_eq!((measured.speed, measured.rotation.advance, measured.current), (1.0, 1e-4, 2.0));
    }

    #[test]
    fn refusals_name_the_field() {
        let nan = f32::NAN;
        let cases = [
            (Calibration { current_per_code: 0.0, ..GOOD }, "sensors.current_per_code"),
            (Calibration { current_per_code: nan, ..GOOD }, "sensors.current_per_code"),
            (Calibration { current_zero: -1.0, ..GOOD }, "sensors.current_zero"),
            (Calibration { current_zero: 65_536.0, ..GOOD }, "sensors.current_zero"),
            (Calibration { current_zero: nan, ..GOOD }, "sensors.current_zero"),
            (Calibration { bus_voltage_per_code: -0.01, ..GOOD }, "sensors.bus_voltage_per_code"),
            (Calibration { bus_voltage_per_code: nan, ..GOOD }, "sensors.bus_voltage_per_code"),
            (Calibration { counts_per_turn: 0, ..GOOD }, "sensors.counts_per_turn"),
            (Calibration { counts_per_turn: 15, ..GOOD }, "sensors.counts_per_turn"),
            (Calibration { counts_per_turn: -65_537, ..GOOD }, "sensors.counts_per_turn"),
            (Calibration { counts_per_turn: i32::MIN, ..GOOD }, "sensors.counts_per_turn"),
            (Calibration { highest_code: 3700, ..GOOD }, "limits.current"),
            (Calibration { bus_voltage_per_code: 0.006, ..GOOD }, "limits.bus_max"),
        ];
        for (calibration, field) in cases {
            let error = built(&Sensors::Codes(calibration), &limits(1000.0));
            assert_eq!(error.expect_err(field).field, field, "{calibration:?}");
        }
        for counts_per_turn in [16, -16, 65_536, -65_536] {
            let calibration = Calibration { counts_per_turn, ..GOOD };
            assert!(built(&Sensors::Codes(calibration), &limits(100.0)).is_ok());
        }
    }
}
