//! Messages between a drive and a host that plays its motor, as 32-bit words.
//!
//! The host opens with a [`Setup`]; the drive answers with its [`VERSION`] and a [`Verdict`]. From then on the host asks, each time
//! with one byte for a [`Question`] and the words that belong to it. A period is a sample and a [`Reply`], kept short: an emulated
//! serial port takes its time for every byte. What the period did is in the reply as a digest only; the [`Record`] behind
//! it is told when asked for. Signals travel as the bit patterns of the drive's scalar, a [`Word`], so that both sides can be
//! held to the same bits. Words are little-endian.

use crate::drive::{DriveConfig, Fault, Mode, Telemetry};
use crate::hal::{BridgeCommand, Codes, Exact, READS};
use crate::math::{Q31, Scalar};
use crate::parameters::records;
use crate::schema::Unset;

/// Version of the messages: both sides must have the same.
pub const VERSION: u32 = 4;

/// First word of either side's first message.
pub const MAGIC: u32 = u32::from_le_bytes(*b"qdrv");

/// A scalar that is a word.
pub trait Word: Scalar {
    /// What tells it from the others: the drive's answer to a [`Setup`] ends with it.
    const NAME: u32;

    /// The scalar's bits.
    fn to_word(self) -> u32;

    /// The scalar of these bits.
    fn from_word(word: u32) -> Self;
}

impl Word for f32 {
    const NAME: u32 = u32::from_le_bytes(*b"f32 ");

    fn to_word(self) -> u32 {
        self.to_bits()
    }

    fn from_word(word: u32) -> Self {
        Self::from_bits(word)
    }
}

impl Word for Q31 {
    const NAME: u32 = u32::from_le_bytes(*b"q31 ");

    fn to_word(self) -> u32 {
        self.0 as u32
    }

    fn from_word(word: u32) -> Self {
        Self(word as i32)
    }
}

/// The drive's answer to a [`Setup`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Verdict {
    /// The drive is armed and waits for requests.
    Accepted = 0,
    /// The versions differ.
    WrongVersion = 1,
    /// The configuration was refused, or could not be read.
    Refused = 2,
}

impl Verdict {
    /// The verdict behind a word.
    pub fn from_word(word: u32) -> Option<Self> {
        [Self::Accepted, Self::WrongVersion, Self::Refused]
            .into_iter()
            .find(|verdict| *verdict as u32 == word)
    }
}

/// The host's first message, after [`MAGIC`] and [`VERSION`]: what drive to be.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Setup(pub DriveConfig);

impl Setup {
    /// Words of a setup.
    pub const WORDS: usize = 96;

    /// As [records], padded with zeros; nothing if they do not suffice.
    pub fn to_words(&self) -> Option<[u32; Self::WORDS]> {
        let mut bytes = [0; 4 * Self::WORDS];
        records::write(&mut { self.0 }, &mut bytes)?;
        let mut words = [0; Self::WORDS];
        for (word, bytes) in words.iter_mut().zip(bytes.as_chunks().0) {
            *word = u32::from_le_bytes(*bytes);
        }
        Some(words)
    }

    /// From words; nothing if a value in them does not fit. What is not in them is not set, and refused by the drive that it is for.
    pub fn from_words(words: [u32; Self::WORDS]) -> Option<Self> {
        let mut bytes = [0; 4 * Self::WORDS];
        for (bytes, word) in bytes.as_chunks_mut().0.iter_mut().zip(words) {
            *bytes = word.to_le_bytes();
        }
        let mut config = DriveConfig::UNSET;
        records::read(&mut config, &bytes).then_some(Self(config))
    }
}

/// What the host asks.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Question {
    /// A period: the sample's words follow. Answered by a [`Reply`].
    Sample = 0,
    /// A period with a new commanded speed (rad/s), whose word comes ahead of the sample's. Answered by a [`Reply`].
    TargetAndSample = 1,
    /// What the last period did. Answered by a [`Record`].
    Record = 2,
}

impl Question {
    /// The question behind a byte.
    pub fn from_byte(byte: u8) -> Option<Self> {
        [Self::Sample, Self::TargetAndSample, Self::Record]
            .into_iter()
            .find(|question| *question as u8 == byte)
    }
}

/// Words of an exact sample.
pub const EXACT_WORDS: usize = 4;

/// Words of a sample of codes.
pub const CODES_WORDS: usize = 2 + READS / 2;

/// An exact sample as words.
pub fn exact_to_words<S: Word>(exact: &Exact<S>) -> [u32; EXACT_WORDS] {
    [exact.speed, exact.advance, exact.current, exact.bus_voltage].map(S::to_word)
}

/// An exact sample from words.
pub fn exact_from_words<S: Word>(words: [u32; EXACT_WORDS]) -> Exact<S> {
    let [speed, advance, current, bus_voltage] = words.map(S::from_word);
    Exact { speed, advance, current, bus_voltage }
}

/// A sample of codes as words: the shift, then two codes in each, the first one low.
pub fn codes_to_words(codes: &Codes) -> [u32; CODES_WORDS] {
    let pair = |low: u16, high: u16| u32::from(low) | u32::from(high) << 16;
    let mut words = [codes.shift.into(); CODES_WORDS];
    words[1] = pair(codes.current, codes.bus_voltage);
    for (word, [low, high]) in words[2..].iter_mut().zip(codes.encoder.as_chunks().0) {
        *word = pair(*low, *high);
    }
    words
}

/// A sample of codes from words.
pub fn codes_from_words(words: [u32; CODES_WORDS]) -> Codes {
    let [shift, first, reads @ ..] = words;
    let mut codes = Codes {
        current: first as u16,
        bus_voltage: (first >> 16) as u16,
        encoder: [0; READS],
        shift: shift as u8,
    };
    for (pair, word) in codes.encoder.as_chunks_mut().0.iter_mut().zip(reads) {
        *pair = [word as u16, (word >> 16) as u16];
    }
    codes
}

/// What a period did, in full.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Record<S> {
    /// What the bridge was told.
    pub command: BridgeCommand<S>,
    /// The mode after the period.
    pub mode: Mode,
    /// What the last driven period did.
    pub telemetry: Option<Telemetry<S>>,
}

const MODES: [Mode; 10] = [
    Mode::Off,
    Mode::Running,
    Mode::Faulted(Fault::BadSample),
    Mode::Faulted(Fault::Overspeed),
    Mode::Faulted(Fault::Overcurrent),
    Mode::Faulted(Fault::BusUndervoltage),
    Mode::Faulted(Fault::BusOvervoltage),
    Mode::Faulted(Fault::EncoderJump),
    Mode::Faulted(Fault::BeyondAuthority),
    Mode::Faulted(Fault::ModelMismatch),
];

/// Bit of a record's first word that says that there is a duty.
const DRIVEN: u32 = 1 << 8;

/// Words of a [`Record`].
pub const RECORD_WORDS: usize = 14;

/// What each of them is, in order.
pub const RECORD_NAMES: [&str; RECORD_WORDS] = [
    "mode",
    "duty",
    "reference",
    "reference's acceleration",
    "reference's jerk",
    "speed",
    "z1",
    "z2",
    "disturbance",
    "wanted voltage",
    "voltage",
    "first sliding variable",
    "second sliding variable",
    "load torque",
];

impl<S: Word> Record<S> {
    /// As words: the mode, with a bit for a driven bridge, the duty, and the telemetry (zeros for none).
    pub fn to_words(&self) -> [u32; RECORD_WORDS] {
        let mode = MODES.iter().position(|mode| *mode == self.mode).unwrap_or_default() as u32;
        let (driven, duty) = match self.command {
            BridgeCommand::Off => (0, S::ZERO),
            BridgeCommand::Duty(duty) => (DRIVEN, duty),
        };
        let [r0, r1, r2, s0, s1, s2, s3, s4, voltage, y1, y2, load_torque] =
            match &self.telemetry {
                None => [S::ZERO; 12],
                Some(Telemetry { reference, signals, voltage, sliding_variables, load_torque }) => {
                    [
                        reference.speed,
                        reference.acceleration,
                        reference.jerk,
                        signals.speed,
                        signals.z1,
                        signals.z2,
                        signals.disturbance,
                        signals.voltage,
                        *voltage,
                        sliding_variables[0],
                        sliding_variables[1],
                        *load_torque,
                    ]
                }
            }
            .map(S::to_word);
        let first = mode | driven;
        [first, duty.to_word(), r0, r1, r2, s0, s1, s2, s3, s4, voltage, y1, y2, load_torque]
    }

    /// The drive's answer to a period.
    pub fn reply(&self) -> Reply {
        let words = self.to_words();
        let [mode, duty, ..] = words;
        Reply { mode, duty, digest: digest(&words) }
    }
}

/// The drive's answer to a period: the first words of its record, and a digest of all.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Reply {
    mode: u32,
    duty: u32,
    digest: u32,
}

impl Reply {
    /// Words of a reply.
    pub const WORDS: usize = 3;

    /// As words.
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        [self.mode, self.duty, self.digest]
    }

    /// From words.
    pub fn from_words(words: [u32; Self::WORDS]) -> Self {
        let [mode, duty, digest] = words;
        Self { mode, duty, digest }
    }
}

/// FNV-1a, word by word.
fn digest(words: &[u32]) -> u32 {
    words.iter().fold(0x811c_9dc5, |hash, word| (hash ^ word).wrapping_mul(0x0100_0193))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::drive_form::{DriveFormConfig, Memory};
    use crate::control::paper::{Form, Gains, Law, PaperConfig, Start};
    use crate::control::{ControlConfig, Signals, Timing};
    use crate::drive::{Drive, Limits};
    use crate::estimate::SpeedSource;
    use crate::motor::MotorParameters;
    use crate::sense::{Calibration, Reads, Sensors};
    use crate::trajectory::{Reference, Shape};

    #[test]
    fn setup_survives_the_journey() {
        let drive_form = DriveFormConfig::new(1000.0, 0.3, 2.0).with_memory(Memory::Integral);
        let paper = PaperConfig {
            law: Law::Qismc,
            gains: Gains::PAPER,
            form: Form::Explicit,
            start: Start::Zero,
            speed: SpeedSource::Pll { bandwidth: 1e3, fed: true },
        };
        let calibration = Calibration {
            current_per_code: -0.01,
            current_zero: 2047.5,
            bus_voltage_per_code: 0.0075,
            counts_per_turn: -4096,
            highest_code: 4095,
            reads: Reads::Last,
        };
        for (control, sensors, shape) in [
            (ControlConfig::Paper(paper), Sensors::Exact, Shape::Step),
            (
                ControlConfig::Drive(drive_form),
                Sensors::Codes(calibration),
                Shape::SecondOrder { bandwidth: 50.0 },
            ),
        ] {
            let setup = Setup(DriveConfig {
                motor: MotorParameters { viscous_friction: 1e-5, ..MotorParameters::PAPER },
                sensors,
                control,
                timing: Timing { rate: 16_000.0, delay: true },
                limits: Limits {
                    duty: 0.9,
                    speed: 400.0,
                    current: 30.0,
                    current_command: 20.0,
                    bus_min: 9.0,
                    bus_max: 27.0,
                },
                shape,
            });
            let words = setup.to_words().expect("enough words");
            assert_eq!(Setup::from_words(words), Some(setup));
        }
        // What is not in the words is not set, and so refused.
        let Setup(unset) = Setup::from_words([u32::MAX; Setup::WORDS]).expect("nothing in it");
        assert!(Drive::<f32>::new(&unset).is_err());
    }

    #[test]
    fn sample_and_question_survive_the_journey() {
        let exact = Exact { speed: -1.5, advance: 0.25, current: 2.5, bus_voltage: 24.0 };
        assert_eq!(exact_from_words(exact_to_words::<f32>(&exact)), exact);
        let fixed = Exact {
            speed: Q31(-1),
            advance: Q31(i32::MIN),
            current: Q31(i32::MAX),
            bus_voltage: Q31(7),
        };
        assert_eq!(exact_from_words(exact_to_words(&fixed)), fixed);
        let encoder = core::array::from_fn(|index| 65_530 + index as u16 % 6);
        let codes = Codes { current: 2048, bus_voltage: 3200, encoder, shift: 200 };
        assert_eq!(codes_from_words(codes_to_words(&codes)), codes);
        for question in [Question::Record, Question::Sample, Question::TargetAndSample] {
            assert_eq!(Question::from_byte(question as u8), Some(question));
        }
        assert_eq!(Question::from_byte(3), None);
        for verdict in [Verdict::Accepted, Verdict::WrongVersion, Verdict::Refused] {
            assert_eq!(Verdict::from_word(verdict as u32), Some(verdict));
        }
        assert_eq!(Verdict::from_word(3), None);
    }

    #[test]
    fn every_bit_of_a_record_shows_in_its_reply() {
        let telemetry = Telemetry {
            reference: Reference { speed: 1.0, acceleration: 2.0, jerk: 3.0 },
            signals: Signals { speed: 4.0, z1: 5.0, z2: 6.0, disturbance: 7.0, voltage: 8.0 },
            voltage: 9.0,
            sliding_variables: [10.0, 11.0],
            load_torque: 12.0,
        };
        let record = Record {
            command: BridgeCommand::Duty(-0.25),
            mode: Mode::Running,
            telemetry: Some(telemetry),
        };
        let words = record.to_words();
        let numbers = words.map(f32::from_bits);
        assert_eq!(numbers[1], -0.25);
        assert_eq!(numbers[2..], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0, 12.0]);
        for index in 0..RECORD_WORDS {
            for bit in 0..32 {
                let mut other = words;
                other[index] ^= 1 << bit;
                assert_ne!(digest(&other), digest(&words), "word {index}, bit {bit}");
            }
        }
        let modes = MODES.map(|mode| Record { mode, ..record }.to_words()[0]);
        for (index, mode) in modes.iter().enumerate() {
            assert_eq!(modes.iter().position(|other| other == mode), Some(index), "modes differ");
        }
        let off = Record { command: BridgeCommand::Off, ..record };
        assert_ne!(off.to_words()[0], words[0]);
        assert_eq!(Reply::from_words(record.reply().to_words()), record.reply());
    }
}
