//! Messages between a drive and a host that plays its motor, as 32-bit words.
//!
//! The host opens with a [`Setup`]; the drive answers with its [`VERSION`] and a [`Verdict`]. From then on each period
//! is one [`Request`] and one [`Reply`]. Numbers travel as the bit patterns of their f32, so that both sides can be held to the same
//! bits. Words are little-endian on a byte stream.

use crate::control::{ControlConfig, Form, Gains, Law, Signals, Start, Timing};
use crate::drive::{DriveConfig, Fault, Limits, Mode, Telemetry};
use crate::hal::{BridgeCommand, Sample};
use crate::motor::MotorParameters;
use crate::trajectory::{Reference, Shape};

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

/// The host's message of a period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Request {
    /// Commanded speed (rad/s).
    pub target: f32,
    /// What the board measured.
    pub sample: Sample<f32>,
}

impl Request {
    /// Words of a request.
    pub const WORDS: usize = 4;

    /// As words.
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let Self { target, sample: Sample { speed, current, bus_voltage } } = *self;
        [target, speed, current, bus_voltage].map(f32::to_bits)
    }

    /// From words.
    pub fn from_words(words: [u32; Self::WORDS]) -> Self {
        let [target, speed, current, bus_voltage] = words.map(f32::from_bits);
        Self { target, sample: Sample { speed, current, bus_voltage } }
    }
}

/// The drive's message of a period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reply {
    /// What the bridge shall do.
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

/// Bit of a reply's first word that says that there is a duty.
const DRIVEN: u32 = 1 << 8;
/// Bit of a reply's first word that says that there is telemetry.
const RECORDED: u32 = 1 << 9;

impl Reply {
    /// Words of a reply.
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

    /// As words.
    pub fn to_words(&self) -> [u32; Self::WORDS] {
        let mode = MODES.iter().position(|mode| *mode == self.mode).unwrap_or_default() as u32;
        let (driven, duty) = match self.command {
            BridgeCommand::Off => (0, 0.0),
            BridgeCommand::Duty(duty) => (DRIVEN, duty),
        };
        let recorded = if self.telemetry.is_some() { RECORDED } else { 0 };
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
        let first = mode | driven | recorded;
        [first, duty.to_bits(), r0, r1, r2, s0, s1, s2, s3, voltage, y1, y2, load_torque]
    }

    /// From words; nothing if the first stands for nothing.
    pub fn from_words(words: [u32; Self::WORDS]) -> Option<Self> {
        let [first, ..] = words;
        let [
            _,
            duty,
            speed,
            acceleration,
            jerk,
            z1,
            z2,
            disturbance,
            wanted,
            voltage,
            y1,
            y2,
            load_torque,
        ] = words.map(f32::from_bits);
        let mode = *MODES.get((first & !(DRIVEN | RECORDED)) as usize)?;
        let telemetry = Telemetry {
            reference: Reference { speed, acceleration, jerk },
            signals: Signals { z1, z2, disturbance, voltage: wanted },
            voltage,
            sliding_variables: [y1, y2],
            load_torque,
        };
        let driven = first & DRIVEN != 0;
        Some(Self {
            command: if driven { BridgeCommand::Duty(duty) } else { BridgeCommand::Off },
            mode,
            telemetry: (first & RECORDED != 0).then_some(telemetry),
        })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

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
    fn request_and_reply_survive_the_journey() {
        let sample = Sample { speed: -1.5, current: 2.5, bus_voltage: 24.0 };
        let request = Request { target: 7.0, sample };
        assert_eq!(Request::from_words(request.to_words()), request);
        let telemetry = Telemetry {
            reference: Reference { speed: 1.0, acceleration: 2.0, jerk: 3.0 },
            signals: Signals { z1: 4.0, z2: 5.0, disturbance: 6.0, voltage: 7.0 },
            voltage: 8.0,
            sliding_variables: [9.0, 10.0],
            load_torque: 11.0,
        };
        for mode in MODES {
            for telemetry in [None, Some(telemetry)] {
                for command in [BridgeCommand::Off, BridgeCommand::Duty(-0.25)] {
                    let reply = Reply { command, mode, telemetry };
                    assert_eq!(Reply::from_words(reply.to_words()), Some(reply));
                }
            }
        }
        let mut broken =
            Reply { command: BridgeCommand::Off, mode: Mode::Off, telemetry: None }.to_words();
        broken[0] = 99;
        assert_eq!(Reply::from_words(broken), None);
    }
}
