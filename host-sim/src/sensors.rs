//! The simulated board's sensors: what converters and counters make of the truth.

use crate::rule::{Broken, finite, non_negative, positive, rule};
use quasidrive::hal::{Codes, READS};
use quasidrive::sense::{Calibration, Reads};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use rand_distr::{Distribution, Normal};
use serde::{Deserialize, Serialize};

/// `[sensors]`: what stands between the truth and the drive. Without the table sensors are exact.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields, default)]
pub struct SensorsTable {
    /// Counts of the encoder per turn, all four edges of its lines counted.
    pub counts_per_turn: u32,
    /// Which of a period's 16 reads of the encoder's counter count.
    pub reads: ReadsName,
    /// Misplacement of each of the encoder's edges (rms, in counts). Drawn once for a run.
    pub edge_error: f64,
    /// Whether the encoder is connected the wrong way round, which the drive does not know.
    pub encoder_reversed: bool,
    /// Codes of each converter: 4096 for 12 bits, up to 65536 for one that oversamples.
    pub codes: u32,
    /// Resolution of the current's converter (A); `codes` of it are its range, half on either side of zero.
    pub current_resolution: f64,
    /// Noise of the current (A rms).
    pub current_noise: f64,
    /// Error of the current that the drive has not calibrated away (A).
    pub current_offset: f64,
    /// Resolution of the bus voltage's converter (V); `codes` of it are its range.
    pub bus_voltage_resolution: f64,
    /// Noise of the bus voltage (V rms).
    pub bus_voltage_noise: f64,
    /// Of all that is random here.
    pub seed: u64,
}

impl Default for SensorsTable {
    fn default() -> Self {
        Self {
            counts_per_turn: 4096,
            reads: ReadsName::All,
            edge_error: 0.0,
            encoder_reversed: false,
            codes: 4096,
            current_resolution: 0.01,
            current_noise: 0.005,
            current_offset: 0.0,
            bus_voltage_resolution: 0.0075,
            bus_voltage_noise: 0.005,
            seed: 1,
        }
    }
}

/// Which reads of the encoder's counter count.
#[derive(Clone, Copy, Debug, Default, Deserialize, Serialize, PartialEq, Eq)]
#[serde(rename_all = "kebab-case")]
pub enum ReadsName {
    /// All 16.
    #[default]
    All,
    /// All 16, earlier by a random shift in each period.
    Shifted,
    /// The last.
    Last,
    /// The last, and the speed from the times of edges.
    Edges,
}

impl ReadsName {
    /// What a table shows.
    pub fn label(self) -> &'static str {
        match self {
            Self::All => "16",
            Self::Shifted => "16 shifted",
            Self::Last => "1",
            Self::Edges => "edges",
        }
    }
}

impl SensorsTable {
    /// What the drive does not check of its calibration.
    pub(crate) fn check(&self) -> Result<(), Broken> {
        let codes = f64::from(self.codes);
        rule((2..=65536).contains(&self.codes), "sensors.codes", "must be from 2 to 65536", codes)?;
        let counts = f64::from(self.counts_per_turn);
        let playable = (16..=65536).contains(&self.counts_per_turn);
        rule(playable, "sensors.counts_per_turn", "must be from 16 to 65536", counts)?;
        let resolution = self.current_resolution;
        positive("sensors.current_resolution", resolution)?;
        positive("sensors.bus_voltage_resolution", self.bus_voltage_resolution)?;
        non_negative("sensors.current_noise", self.current_noise)?;
        non_negative("sensors.bus_voltage_noise", self.bus_voltage_noise)?;
        finite("sensors.current_offset", self.current_offset)?;
        non_negative("sensors.edge_error", self.edge_error)?;
        let placed = self.edge_error <= 0.2;
        rule(placed, "sensors.edge_error", "must be at most 0.2 counts", self.edge_error)
    }

    /// What the drive is told of them.
    pub fn calibration(&self) -> Calibration {
        Calibration {
            current_per_code: self.current_resolution as f32,
            current_zero: 0.5 * self.codes as f32,
            bus_voltage_per_code: self.bus_voltage_resolution as f32,
            counts_per_turn: self.counts_per_turn as i32,
            highest_code: (self.codes - 1) as u16,
            reads: match self.reads {
                ReadsName::All => Reads::All,
                ReadsName::Shifted => Reads::Shifted,
                ReadsName::Last => Reads::Last,
                ReadsName::Edges => Reads::Edges,
            },
        }
    }
}

/// Noise of a deviation that was checked.
pub(crate) fn noise(deviation: f64) -> Normal<f64> {
    #[expect(clippy::expect_used, reason = "checked: finite and not negative")]
    Normal::new(0.0, deviation).expect("a deviation")
}

/// The encoder's disc.
#[derive(Clone, Debug)]
pub(crate) struct Disc {
    counts_per_turn: u32,
    reversed: bool,
    /// Misplacement of each edge (counts); empty if all are in their places.
    edges: Vec<f64>,
}

impl Disc {
    /// The disc of a table that was checked, its edges placed at random.
    pub fn new(table: &SensorsTable, random: &mut StdRng) -> Self {
        let placing = noise(table.edge_error);
        // Beyond half a count neighbouring edges would change places.
        let edges =
            (0..table.counts_per_turn).map(|_| placing.sample(random).clamp(-0.45, 0.45)).collect();
        Self {
            counts_per_turn: table.counts_per_turn,
            reversed: table.encoder_reversed,
            edges: if table.edge_error > 0.0 { edges } else { Vec::new() },
        }
    }

    /// Counts from angle zero to an angle (rad).
    #[inline]
    pub fn count(&self, angle: f64) -> i64 {
        let turned = if self.reversed { -angle } else { angle };
        let position = turned / std::f64::consts::TAU * f64::from(self.counts_per_turn);
        let towards_zero = position as i64;
        let below = towards_zero - i64::from(position < towards_zero as f64);
        // Edges that are all in their places need not be looked up, 16 times a period.
        below + if self.edges.is_empty() { 0 } else { self.misplaced(position, below) }
    }

    /// How much a position (counts) reads beyond the count below it for the misplacement of the edges next to it.
    fn misplaced(&self, position: f64, below: i64) -> i64 {
        let edge = |count: i64| {
            count as f64 + self.edges[count.rem_euclid(self.edges.len() as i64) as usize]
        };
        i64::from(position >= edge(below + 1)) - i64::from(position < edge(below))
    }
}

/// Sensors at work.
#[derive(Clone, Debug)]
pub struct Sensors {
    table: SensorsTable,
    random: StdRng,
    current_noise: Normal<f64>,
    bus_voltage_noise: Normal<f64>,
    disc: Disc,
    encoder: [u16; READS],
    /// How much earlier the encoder is read in this period, in 1/256 of the distance of two reads.
    shift: u8,
}

impl Sensors {
    /// Sensors of a table that was checked, with the shaft at angle zero.
    pub fn new(table: SensorsTable) -> Self {
        let mut random = StdRng::seed_from_u64(table.seed);
        let disc = Disc::new(&table, &mut random);
        Self {
            table,
            random,
            current_noise: noise(table.current_noise),
            bus_voltage_noise: noise(table.bus_voltage_noise),
            disc,
            encoder: [0; READS],
            shift: 0,
        }
    }

    /// How much earlier the encoder is read in this period, as a share of the period.
    pub fn shift(&self) -> f64 {
        f64::from(self.shift) / (256 * READS) as f64
    }

    /// Reads the encoder's counter for the `read`th time in a period, at an angle (rad).
    #[inline]
    pub fn read_encoder(&mut self, read: usize, angle: f64) {
        self.encoder[read] = self.disc.count(angle) as u16;
    }

    /// A period's sample, of the current (A) and the bus voltage (V) at its end and the counter's reads.
    pub fn sample(&mut self, current: f64, bus_voltage: f64) -> Codes {
        let SensorsTable {
            codes, current_resolution, current_offset, bus_voltage_resolution, ..
        } = self.table;
        let codes = f64::from(codes);
        let current = current + current_offset + self.current_noise.sample(&mut self.random);
        let bus_voltage = bus_voltage + self.bus_voltage_noise.sample(&mut self.random);
        // Converters saturate at the ends of their range.
        let code = |value: f64| value.round().clamp(0.0, codes - 1.0) as u16;
        Codes {
            current: code(current / current_resolution + 0.5 * codes),
            bus_voltage: code(bus_voltage / bus_voltage_resolution),
            encoder: self.encoder,
            shift: self.shift,
        }
    }

    /// Begins the next period.
    pub fn begin(&mut self) {
        if self.table.reads == ReadsName::Shifted {
            self.shift = self.random.random();
        }
    }
}
