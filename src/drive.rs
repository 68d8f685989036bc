//! The drive: the only place where reference, law, limits and bridge meet.
//!
//! Outputs are off until [`Drive::arm`], and off for good after a fault, until [`Drive::clear_fault`] and
//! [`Drive::arm`]. All checks of the configuration happen in [`Drive::new`]; [`Drive::step`] cannot fail: whatever a
//! sample holds, it returns a finite duty within the limit, or [`BridgeCommand::Off`].

use crate::config::{ConfigError, positive, require};
use crate::control::{ControlConfig, Controller, Ranges, Setting, Signals, Timing};
use crate::hal::{Board, BridgeCommand, Sample};
use crate::math::Scalar;
use crate::motor::MotorParameters;
use crate::sense::{Measured, Sensing, Sensors};
use crate::trajectory::{Reference, Shape, Shaper};
use serde::{Deserialize, Serialize};

/// Everything that a drive is built from.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct DriveConfig {
    /// The motor.
    pub motor: MotorParameters,
    /// What the board's samples are.
    pub sensors: Sensors,
    /// The controller and its gains.
    pub control: ControlConfig,
    /// Sampling rate and delay.
    pub timing: Timing,
    /// What a sample may hold, and what the bridge may be told.
    pub limits: Limits,
    /// How commanded speeds become references.
    pub shape: Shape,
}

/// Limits. A sample outside them is a fault; a duty outside them is limited.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Limits {
    /// Largest magnitude of the duty, from above 0 to 1. A bridge with bootstrapped high sides needs less than 1.
    pub duty: f32,
    /// Largest plausible speed, and largest speed that can be commanded (rad/s). Positive.
    pub speed: f32,
    /// Over-current trip (A). Positive.
    pub current: f32,
    /// Largest current that a controller asks for (A), where it has a current to ask for: all but the paper's form. Positive,
    /// at most `current`.
    pub current_command: f32,
    /// Under-voltage trip of the bus (V). Positive.
    pub bus_min: f32,
    /// Over-voltage trip of the bus (V). Above `bus_min`.
    pub bus_max: f32,
}

impl Limits {
    fn check(&self) -> Result<(), ConfigError> {
        require(
            self.duty > 0.0 && self.duty <= 1.0,
            "limits.duty",
            "must be above 0 and at most 1",
            self.duty,
        )?;
        // Squares and products of these appear in the law: far from overflow.
        for (field, value) in [
            ("limits.speed", self.speed),
            ("limits.current", self.current),
            ("limits.current_command", self.current_command),
            ("limits.bus_min", self.bus_min),
            ("limits.bus_max", self.bus_max),
        ] {
            positive(field, value)?;
            require(value <= 1e6, field, "must be at most 1e6", value)?;
        }
        require(
            self.current_command <= self.current,
            "limits.current_command",
            "must be at most limits.current",
            self.current_command,
        )?;
        require(
            self.bus_max > self.bus_min,
            "limits.bus_max",
            "must be above limits.bus_min",
            self.bus_max,
        )?;
        Ok(())
    }
}

/// Why a drive stopped.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Fault {
    /// A sample held a NaN or an infinity, or was of another kind than the drive's sensors.
    BadSample,
    /// The speed was beyond [`Limits::speed`].
    Overspeed,
    /// The current was beyond [`Limits::current`].
    Overcurrent,
    /// The bus voltage was below [`Limits::bus_min`].
    BusUndervoltage,
    /// The bus voltage was above [`Limits::bus_max`].
    BusOvervoltage,
    /// The encoder moved further in a period than twice what [`Limits::speed`] and a count allow.
    EncoderJump,
    /// Load or voltage were beyond the authority of their observers for [`AUTHORITY_TIME`], and the speed came no nearer to its
    /// reference: a load beyond what was configured or what the current command can hold, a blocked rotor, an encoder that does
    /// not count, or an encoder or motor lead connected the wrong way round.
    BeyondAuthority,
}

/// How long load or voltage may be beyond the observers' authority (s).
pub const AUTHORITY_TIME: f32 = 0.025;

/// Whether the drive drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Mode {
    /// Not armed: outputs are off.
    Off,
    /// Armed: outputs follow the law.
    Running,
    /// Stopped by a fault: outputs are off until the fault is cleared and the drive armed again.
    Faulted(Fault),
}

/// A command that was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The commanded speed is a NaN, or beyond [`Limits::speed`]. The former command stays.
    SpeedOutOfRange,
    /// There is a fault to clear first.
    Faulted(Fault),
}

/// What a period did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Telemetry<S> {
    /// The reference.
    pub reference: Reference<S>,
    /// What the law saw and decided.
    pub signals: Signals<S>,
    /// The armature voltage that was asked of the bridge, after the duty limit (V).
    pub voltage: S,
    /// The estimator's sliding variables; ω − x̂1 (BS-QISMC: s1) (rad/s), and z2 − ẑ2 (BS-QISMC: s2) (rad/s²) or, in the
    /// drive form, the memory of i − î (A); zero where there are none.
    pub sliding_variables: [S; 2],
    /// The estimated load torque T̂_l = −J·d̂ (N·m), positive when it opposes positive motion.
    pub load_torque: S,
}

/// A speed drive for one motor.
#[derive(Clone, Debug)]
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub struct Drive<S: Scalar> {
    mode: Mode,
    /// Whether the controller has started since the drive was armed.
    started: bool,
    /// Whether there was a driven period.
    driven: bool,
    speed_limit: S,
    advance_limit: S,
    current_limit: S,
    bus_min: S,
    bus_max: S,
    duty_limit: S,
    /// Armature voltage that acts from the next sample on (V): what was asked of the bridge, or the back-EMF with it off.
    voltage: S,
    sensing: Sensing<S>,
    shaper: Shaper<S>,
    controller: Controller<S>,
    /// Speed when the bridge was last off, or went off (rad/s).
    idle_speed: S,
    /// Steps beyond authority that are a fault.
    authority_steps: u32,
    back_emf: S::Gain,
    minus_inertia: S::Gain,
}

impl<S: Scalar> Drive<S> {
    /// Builds a drive, not armed, commanded to stand still. Refuses a configuration outside its range, naming the field.
    pub fn new(config: &DriveConfig) -> Result<Self, ConfigError> {
        let motor = config.motor.coefficients()?;
        let limits = &config.limits;
        limits.check()?;
        let timing = &config.timing;
        let setting = Setting {
            motor: &motor,
            timing,
            age: config.sensors.age(timing.period()),
            ranges: &Ranges {
                speed: limits.speed,
                current: limits.current,
                current_command: limits.current_command,
            },
        };
        Ok(Self {
            mode: Mode::Off,
            started: false,
            driven: false,
            controller: Controller::new(&config.control, &setting)?,
            sensing: Sensing::new(&config.sensors, limits.speed, timing.rate)?,
            shaper: Shaper::new(config.shape, timing.rate)?,
            duty_limit: S::from_f32(limits.duty),
            speed_limit: S::from_f32(limits.speed),
            // However slow the shaft, an edge between two samples' reads is a whole count, and noise may be another.
            advance_limit: S::from_f32(
                2.0 * (limits.speed * timing.period() + config.sensors.resolution()),
            ),
            current_limit: S::from_f32(limits.current),
            bus_min: S::from_f32(limits.bus_min),
            bus_max: S::from_f32(limits.bus_max),
            voltage: S::ZERO,
            idle_speed: S::ZERO,
            authority_steps: (AUTHORITY_TIME * timing.rate) as u32,
            back_emf: S::gain(config.motor.back_emf_constant),
            minus_inertia: S::gain(-motor.inertia),
        })
    }

    /// Turns the outputs on from the next step. The controller starts anew, and the reference at the speed that the motor
    /// has.
    pub fn arm(&mut self) -> Result<(), Refusal> {
        match self.mode {
            Mode::Faulted(fault) => Err(Refusal::Faulted(fault)),
            Mode::Running => Ok(()),
            Mode::Off => {
                self.started = false;
                self.mode = Mode::Running;
                Ok(())
            }
        }
    }

    /// Turns the outputs off from the next step. A fault stays latched.
    pub fn disarm(&mut self) {
        if self.mode == Mode::Running {
            self.mode = Mode::Off;
            self.idle_speed = self.controller.signals().speed;
        }
    }

    /// Clears a latched fault. The drive stays off until armed.
    pub fn clear_fault(&mut self) {
        if let Mode::Faulted(_) = self.mode {
            self.mode = Mode::Off;
        }
    }

    /// Commands a speed (rad/s).
    pub fn set_speed(&mut self, speed: S) -> Result<(), Refusal> {
        if !speed.is_finite() || speed.abs() > self.speed_limit {
            return Err(Refusal::SpeedOutOfRange);
        }
        self.shaper.set_target(speed);
        Ok(())
    }

    /// One PWM period with a board: sample, step, apply.
    #[inline]
    pub fn run_period(&mut self, board: &mut impl Board<S>) {
        let sample = board.sample();
        let command = self.step(&sample);
        board.apply(command);
    }

    /// One PWM period: from this period's sample to the bridge's command.
    // Not inlined, for its instructions to be counted apart from its caller's.
    #[inline(never)]
    pub fn step(&mut self, sample: &Sample<S>) -> BridgeCommand<S> {
        let Some(measured) = self.sensing.read(sample) else {
            return self.refuse(Fault::BadSample);
        };
        if self.mode != Mode::Running {
            // Without a bus too: what matters is where the motor is when it is armed.
            if self.motor_limits_hold(&measured) {
                self.idle_speed = self.controller.follow(&measured);
            }
            return BridgeCommand::Off;
        }
        if !self.limits_hold(&measured) {
            return self.refuse(self.fault_in(&measured));
        }
        if !self.started {
            self.start(&measured);
        }
        let wanted = self.controller.step(&measured, self.shaper.advance(), self.voltage);
        if self.controller.signals().speed.abs() > self.speed_limit {
            return self.refuse(Fault::Overspeed);
        }
        if self.controller.exhausted() > self.authority_steps && self.controller.stuck() {
            return self.refuse(Fault::BeyondAuthority);
        }
        let duty = (wanted / measured.bus_voltage).limited(self.duty_limit);
        self.voltage = duty * measured.bus_voltage;
        self.driven = true;
        BridgeCommand::Duty(duty)
    }

    /// Starts from what was followed with the bridge off: without a jump of reference, voltage or estimates.
    #[cold]
    fn start(&mut self, measured: &Measured<S>) {
        self.shaper.reset(self.idle_speed);
        self.voltage = S::combine([(self.back_emf, self.idle_speed)]);
        self.controller.start(measured, self.shaper.clone().advance());
        self.started = true;
    }

    /// Outputs off; while running, for a fault.
    #[cold]
    fn refuse(&mut self, fault: Fault) -> BridgeCommand<S> {
        if self.mode == Mode::Running {
            self.mode = Mode::Faulted(fault);
            self.idle_speed = self.controller.signals().speed;
        }
        BridgeCommand::Off
    }

    /// Whether a sample is within the limits.
    #[inline]
    fn limits_hold(&self, measured: &Measured<S>) -> bool {
        self.motor_limits_hold(measured)
            && measured.bus_voltage >= self.bus_min
            && measured.bus_voltage <= self.bus_max
    }

    /// Whether what a sample says of the motor is within the limits.
    #[inline]
    fn motor_limits_hold(&self, measured: &Measured<S>) -> bool {
        measured.speed.abs() <= self.speed_limit
            && measured.advance.abs() <= self.advance_limit
            && measured.current.abs() <= self.current_limit
    }

    /// What is wrong with a sample that is not within the limits.
    #[cold]
    fn fault_in(&self, measured: &Measured<S>) -> Fault {
        if measured.current.abs() > self.current_limit {
            Fault::Overcurrent
        } else if measured.bus_voltage < self.bus_min {
            Fault::BusUndervoltage
        } else if measured.bus_voltage > self.bus_max {
            Fault::BusOvervoltage
        } else if measured.speed.abs() > self.speed_limit {
            Fault::Overspeed
        } else {
            Fault::EncoderJump
        }
    }

    /// Whether the drive drives, and if not, why.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// What the last driven period did; nothing before the first.
    #[inline]
    pub fn telemetry(&self) -> Option<Telemetry<S>> {
        let signals = *self.controller.signals();
        self.driven.then(|| Telemetry {
            reference: *self.shaper.reference(),
            signals,
            voltage: self.voltage,
            sliding_variables: self.controller.sliding_variables(),
            load_torque: S::combine([(self.minus_inertia, signals.disturbance)]),
        })
    }
}
