//! Messages between a drive and a host that plays its motor, as 32-bit words.
//!
//! The host opens with a [`Setup`]; the drive answers with its [`VERSION`] and a [`Verdict`]. From then on the host asks, each time
//! with one byte for a [`Question`] and the words that belong to it. A period is a sample and a [`Reply`], kept short: an emulated
//! serial port takes its time for every byte. What the period did is in the reply as a digest only; the [`Record`] behind
//! it is told when asked for. Numbers travel as the bit patterns of their f32, so that both sides can be held to the same
//! bits. Words are little-endian.

use crate::control::{ControlConfig, Form, Gains, Law, Start, Timing};
use crate::drive::{DriveConfig, Fault, Limits, Mode, Telemetry};
use crate::hal::{BridgeCommand, Sample};
use crate::motor::MotorParameters;
use crate::trajectory::Shape;

/// Version of the messages: both sides must have the same.
pub const VERSION: u32 = 1;

/// First word of either side's first message.
pub const MAGIC: u32 = u32::from_le_bytes(*b"qdrv");

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
    pub const WORDS: usize = 22;

    /// As words.
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let DriveConfig { motor, control, timing, limits, shape } = &self.0;
        let law = match control.law {
            Law::Backstepping => 0,
            Law::Qsmdo => 1,
            Law::Qismc => 2,
        };
        let bandwidth = match *shape {
            Shape::Step => 0.0,
            Shape::SecondOrder { bandwidth } => bandwidth,
        };
        [
            motor.inertia.to_bits(),
            motor.inductance.to_bits(),
            motor.resistance.to_bits(),
            motor.viscous_friction.to_bits(),
            motor.back_emf_constant.to_bits(),
            law,
            u32::from(control.form == Form::Explicit),
            u32::from(control.start == Start::Zero),
            control.gains.c.to_bits(),
            control.gains.k1.to_bits(),
            control.gains.epsilon1.to_bits(),
            control.gains.k2.to_bits(),
            control.gains.epsilon2.to_bits(),
            timing.rate.to_bits(),
            u32::from(timing.delay),
            limits.duty.to_bits(),
            limits.speed.to_bits(),
            limits.current.to_bits(),
            limits.bus_min.to_bits(),
            limits.bus_max.to_bits(),
            u32::from(matches!(shape, Shape::SecondOrder { .. })),
            bandwidth.to_bits(),
        ]
    }

    /// From words; nothing if one of them stands for nothing.
    pub fn from_words(words: [u32; Self::WORDS]) -> Option<Self> {
        let [
            inertia,
            inductance,
            resistance,
            viscous_friction,
            back_emf_constant,
            law,
            explicit,
            zero,
            c,
            k1,
            epsilon1,
            k2,
            epsilon2,
            rate,
            delay,
            duty,
            speed,
            current,
            bus_min,
            bus_max,
            second_order,
            bandwidth,
        ] = words;
        let f = f32::from_bits;
        let flag = |word| match word {
            0 => Some(false),
            1 => Some(true),
            _ => None,
        };
        Some(Self(DriveConfig {
            motor: MotorParameters {
                inertia: f(inertia),
                inductance: f(inductance),
                resistance: f(resistance),
                viscous_friction: f(viscous_friction),
                back_emf_constant: f(back_emf_constant),
            },
            control: ControlConfig {
                law: match law {
                    0 => Law::Backstepping,
                    1 => Law::Qsmdo,
                    2 => Law::Qismc,
                    _ => return None,
                },
                gains: Gains {
                    c: f(c),
                    k1: f(k1),
                    epsilon1: f(epsilon1),
                    k2: f(k2),
                    epsilon2: f(epsilon2),
                },
                form: if flag(explicit)? { Form::Explicit } else { Form::Implicit },
                start: if flag(zero)? { Start::Zero } else { Start::Matched },
            },
            timing: Timing { rate: f(rate), delay: flag(delay)? },
            limits: Limits {
                duty: f(duty),
                speed: f(speed),
                current: f(current),
                bus_min: f(bus_min),
                bus_max: f(bus_max),
            },
            shape: if flag(second_order)? {
                Shape::SecondOrder { bandwidth: f(bandwidth) }
            } else {
                Shape::Step
            },
        }))
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

/// Words of a sample.
pub const SAMPLE_WORDS: usize = 3;

/// A sample as words.
pub fn sample_to_words(sample: &Sample<f32>) -> [u32; SAMPLE_WORDS] {
    [sample.speed, sample.current, sample.bus_voltage].map(f32::to_bits)
}

/// A sample from words.
pub fn sample_from_words(words: [u32; SAMPLE_WORDS]) -> Sample<f32> {
    let [speed, current, bus_voltage] = words.map(f32::from_bits);
    Sample { speed, current, bus_voltage }
}

/// What a period did, in full.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Record {
    /// What the bridge was told.
    pub command: BridgeCommand<f32>,
    /// The mode after the period.
    pub mode: Mode,
    /// What the last driven period did.
    pub telemetry: Option<Telemetry<f32>>,
}

const MODES: [Mode; 7] = [
    Mode::Off,
    Mode::Running,
    Mode::Faulted(Fault::SampleNotFinite),
    Mode::Faulted(Fault::Overspeed),
    Mode::Faulted(Fault::Overcurrent),
    Mode::Faulted(Fault::BusUndervoltage),
    Mode::Faulted(Fault::BusOvervoltage),
];

/// Bit of a record's first word that says that there is a duty.
const DRIVEN: u32 = 1 << 8;

impl Record {
    /// Words of a record.
    pub const WORDS: usize = 13;

    /// What each word is, in order.
    pub const NAMES: [&str; Self::WORDS] = [
        "mode",
        "duty",
        "reference",
        "reference's acceleration",
        "reference's jerk",
        "z1",
        "z2",
        "disturbance",
        "wanted voltage",
        "voltage",
        "first sliding variable",
        "second sliding variable",
        "load torque",
    ];

    /// As words: the mode, with a bit for a driven bridge, the duty, and the telemetry (zeros for none).
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let mode = MODES.iter().position(|mode| *mode == self.mode).unwrap_or_default() as u32;
        let (driven, duty) = match self.command {
            BridgeCommand::Off => (0, 0.0),
            BridgeCommand::Duty(duty) => (DRIVEN, duty),
        };
        let [r0, r1, r2, s0, s1, s2, s3, voltage, y1, y2, load_torque] = match &self.telemetry {
            None => [0.0; 11],
            Some(Telemetry { reference, signals, voltage, sliding_variables, load_torque }) => [
                reference.speed,
                reference.acceleration,
                reference.jerk,
                signals.z1,
                signals.z2,
                signals.disturbance,
                signals.voltage,
                *voltage,
                sliding_variables[0],
                sliding_variables[1],
                *load_torque,
            ],
        }
        .map(f32::to_bits);
        let first = mode | driven;
        [first, duty.to_bits(), r0, r1, r2, s0, s1, s2, s3, voltage, y1, y2, load_torque]
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
    use crate::control::Signals;
    use crate::trajectory::Reference;

    fn config(law: Law, form: Form, start: Start, shape: Shape, delay: bool) -> DriveConfig {
        DriveConfig {
            motor: MotorParameters { viscous_friction: 1e-5, ..MotorParameters::PAPER },
            control: ControlConfig { law, gains: Gains::PAPER, form, start },
            timing: Timing { rate: 16_000.0, delay },
            limits: Limits { duty: 0.9, speed: 400.0, current: 30.0, bus_min: 9.0, bus_max: 27.0 },
            shape,
        }
    }

    #[test]
    fn setup_survives_the_journey() {
        let second_order = Shape::SecondOrder { bandwidth: 50.0 };
        for setup in [
            config(Law::Backstepping, Form::Implicit, Start::Zero, Shape::Step, true),
            config(Law::Qsmdo, Form::Explicit, Start::Matched, second_order, false),
            config(Law::Qismc, Form::Implicit, Start::Zero, second_order, true),
        ]
        .map(Setup)
        {
            let words = setup.to_words();
            assert_eq!(Setup::from_words(words), Some(setup));
            for flag in [5, 6, 7, 14, 20] {
                let mut broken = words;
                broken[flag] = 3;
                assert_eq!(Setup::from_words(broken), None, "word {flag}");
            }
        }
    }

    #[test]
    fn sample_and_question_survive_the_journey() {
        let sample = Sample { speed: -1.5, current: 2.5, bus_voltage: 24.0 };
        assert_eq!(sample_from_words(sample_to_words(&sample)), sample);
        for question in [Question::Sample, Question::TargetAndSample, Question::Record] {
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
            signals: Signals { z1: 4.0, z2: 5.0, disturbance: 6.0, voltage: 7.0 },
            voltage: 8.0,
            sliding_variables: [9.0, 10.0],
            load_torque: 11.0,
        };
        let record = Record {
            command: BridgeCommand::Duty(-0.25),
            mode: Mode::Running,
            telemetry: Some(telemetry),
        };
        let words = record.to_words();
        let numbers = words.map(f32::from_bits);
        assert_eq!(numbers[1], -0.25);
        assert_eq!(numbers[2..], [1.0, 2.0, 3.0, 4.0, 5.0, 6.0, 7.0, 8.0, 9.0, 10.0, 11.0]);
        for index in 0..Record::WORDS {
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
