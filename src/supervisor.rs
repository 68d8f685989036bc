//! The supervisor: when outputs may be on, and what takes them off.
//!
//! It wraps a [`Drive`], which controls the motor and finds what is wrong with a period's sample, and adds what is not in a
//! sample: commands and their loss, heat, the board's own sensors, and the modes between reset and a turning motor. It is the
//! only one to arm a drive.
//!
//! ```text
//!         first period             zero learnt          Arm               charged
//!  Boot ───────────────▶ Calibrating ────────▶ Ready ─────────▶ Armed ───────────────▶ Running
//!                             ▲                 ▲ ▲               │ Stop, Off             │ │ Off
//!                       Clear │                 │ └───────────────┴───────────────────────┼─┘
//!                             │                 │    at rest, time over, Off              │
//!       any fault ───────▶ Faulted              └──────────── Stopping ◀──────────────────┘ Stop, no commands
//!
//!                                   Commission                charged
//!                            Ready ────────────▶ Armed ────────────────▶ Commissioning ─┐
//!                              ▲                       all measured, Stop, Off          │
//!                              └────────────────────────────────────────────────────────┘
//! ```
//!
//! [`TRANSITIONS`] is that as a table. Outputs can be on in `Armed`, `Running`, `Stopping` and `Commissioning` only. A fault is latched, and
//! cleared by [`Command::Clear`] alone.

use crate::commission::{Commission, Phase};
use crate::config::{ConfigError, positive, require};
use crate::drive::{self, Drive, DriveConfig};
use crate::fault::{ActiveLimit, ActiveLimits, Fault, Faults};
use crate::hal::{BridgeCommand, Sample};
use crate::math::{Base, Scalar};
use crate::per_unit::Bases;
use crate::schema::group;
use crate::shunts::CurrentSensors;
use serde::{Deserialize, Serialize};

/// Protections beyond those of [`Limits`](crate::drive::Limits).
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Protection {
    /// Current that the motor can carry for ever (A), in the root of its mean square. Positive.
    pub continuous_current: f32,
    /// Thermal time constant of the winding (s): a constant current I trips after thermal_time·ln(I²/(I² −
    /// continuous_current²)) from cold. Positive, and at least 64 periods.
    pub thermal_time: f32,
    /// Highest temperature of the board (°C). From 0 to 120.
    pub temperature: f32,
    /// Longest time between two commands with outputs on (s). From 0.01 to 60.
    pub command_timeout: f32,
    /// Longest time that stopping may take (s); then outputs go off whatever the speed. From 0.01 to 60.
    pub stop_time: f32,
    /// Speed below which the motor counts as stopped (rad/s). Positive.
    pub standstill: f32,
}

group! {
    Protection {
        continuous_current, thermal_time, temperature, command_timeout, stop_time, standstill,
    }
}

impl Protection {
    fn check(&self, config: &DriveConfig) -> Result<(), ConfigError> {
        positive("protection.continuous_current", self.continuous_current)?;
        require(
            self.continuous_current <= config.limits.current,
            "protection.continuous_current",
            "must be at most limits.current",
            self.continuous_current,
        )?;
        require(
            self.thermal_time >= PERIODS as f32 * config.timing.period()
                && self.thermal_time.is_finite(),
            "protection.thermal_time",
            "must be at least 64 periods, and finite",
            self.thermal_time,
        )?;
        require(
            (0.0..=120.0).contains(&self.temperature),
            "protection.temperature",
            "must be from 0 to 120 °C",
            self.temperature,
        )?;
        for (field, value) in [
            ("protection.command_timeout", self.command_timeout),
            ("protection.stop_time", self.stop_time),
        ] {
            require((0.01..=60.0).contains(&value), field, "must be from 0.01 to 60 s", value)?;
        }
        positive("protection.standstill", self.standstill)?;
        Ok(())
    }
}

/// What a board knows beside the sample.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Conditions {
    /// Temperature of the board (°C).
    pub temperature: f32,
    /// Whether the current sensors work.
    pub current_sensors: CurrentSensors,
    /// Whether the hardware has switched the bridge off although it was told to be on.
    pub tripped: bool,
    /// Whether the control interrupt has started or ended too late since the last period.
    pub overrun: bool,
}

/// Whether the drive drives.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[repr(u8)]
pub enum Mode {
    /// Nothing was sampled yet.
    Boot = 0,
    /// Learns the current sensors' zero, with outputs off.
    Calibrating = 1,
    /// Outputs are off; can be armed.
    Ready = 2,
    /// The bootstrap capacitors are charged; the motor is not driven yet.
    Armed = 3,
    /// Outputs follow the commanded speed.
    Running = 4,
    /// Outputs take the speed to zero.
    Stopping = 5,
    /// A fault is latched: outputs are off until it is cleared and the drive armed again.
    Faulted = 6,
    /// The motor is measured, with what [`Commission`] asks of the bridge.
    Commissioning = 7,
}

/// What changes the mode.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Event {
    /// A period began.
    Period,
    /// The current sensors' zero is known.
    ZeroLearnt,
    /// [`Command::Arm`].
    Arm,
    /// [`Supervisor::start_commissioning`].
    Commission,
    /// The bootstrap capacitors are charged.
    Charged,
    /// They are, for the motor to be measured.
    ChargedToMeasure,
    /// The motor is measured, or what measures it has given up.
    Measured,
    /// [`Command::Stop`], or no command for too long.
    Stop,
    /// [`Command::Off`].
    Off,
    /// The motor stands still, or stopping took too long.
    Stopped,
    /// A fault was latched.
    Fault,
    /// [`Command::Clear`].
    Clear,
}

/// Every change of mode that there is: from, by, to.
pub const TRANSITIONS: [(Mode, Event, Mode); 23] = {
    use Mode::{Armed, Boot, Calibrating, Commissioning, Faulted, Ready, Running, Stopping};
    [
        (Boot, Event::Period, Calibrating),
        (Calibrating, Event::ZeroLearnt, Ready),
        (Ready, Event::Arm, Armed),
        (Ready, Event::Commission, Armed),
        (Armed, Event::Charged, Running),
        (Armed, Event::ChargedToMeasure, Commissioning),
        (Commissioning, Event::Measured, Ready),
        (Commissioning, Event::Stop, Ready),
        (Armed, Event::Stop, Ready),
        (Running, Event::Stop, Stopping),
        (Stopping, Event::Stopped, Ready),
        (Armed, Event::Off, Ready),
        (Running, Event::Off, Ready),
        (Stopping, Event::Off, Ready),
        (Commissioning, Event::Off, Ready),
        (Boot, Event::Fault, Faulted),
        (Calibrating, Event::Fault, Faulted),
        (Ready, Event::Fault, Faulted),
        (Armed, Event::Fault, Faulted),
        (Running, Event::Fault, Faulted),
        (Stopping, Event::Fault, Faulted),
        (Commissioning, Event::Fault, Faulted),
        (Faulted, Event::Clear, Calibrating),
    ]
};

/// A command to the drive.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Command {
    /// Turn outputs on, at a commanded speed of zero.
    Arm,
    /// Follow this speed (rad/s).
    Speed(f32),
    /// Nothing new: the commander is there.
    KeepAlive,
    /// Take the speed to zero, then outputs off. While the motor is measured: outputs off at once.
    Stop,
    /// Outputs off at once: the motor coasts.
    Off,
    /// Clear the latched faults.
    Clear,
}

/// Why a command was not taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// The speed is a NaN, or beyond [`Limits::speed`](crate::drive::Limits::speed).
    SpeedOutOfRange,
    /// It means nothing in this mode.
    Mode(Mode),
}

/// What the bridge shall do, from the next update of the PWM timer on.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub enum Output<S> {
    /// All switches open.
    #[default]
    Off,
    /// Only the low sides are on, for a small share of the period: it charges the bootstrap capacitors and moves no motor.
    Charge,
    /// The mean armature voltage as a share of the bus voltage, within ±1.
    Duty(S),
}

/// Periods of a turn of the slow checks.
const PERIODS: u32 = 64;

/// How long bootstrap capacitors are charged (s). A hundred times their time constant at a twentieth of the period.
const CHARGE_TIME: f32 = 0.025;

/// Share of the thermal limit from which [`ActiveLimit::Heat`] is shown.
const WARM: f32 = 0.8;

/// Distance from the highest temperature from which [`ActiveLimit::Temperature`] is shown (°C).
const NEAR_HOT: f32 = 10.0;

/// Share of the current command's limit from which [`ActiveLimit::Current`] is shown.
const NEAR_LIMIT: f32 = 0.95;

/// Share of the duty's limit from which [`ActiveLimit::Duty`] is shown: a quotient may be rounded down.
const NEARLY: f32 = 0.999;

/// A drive and what watches over it.
#[derive(Clone, Debug)]
pub struct Supervisor<S: Scalar> {
    mode: Mode,
    faults: Faults,
    drive: Drive<S>,
    output: Output<S>,
    /// Mean square of the current (A²) over the slow checks' turn so far.
    mean_square: S,
    per_turn: S::Gains<1>,
    /// Periods until the next slow check.
    countdown: u32,
    /// Turns since the last command.
    silence: u32,
    /// Turns in this mode.
    turns: u32,
    /// Whether stopping is because no commands came.
    is_lost: bool,
    /// Whether it was armed to measure the motor.
    measures: bool,
    slow: Slow<S>,
}

/// What is checked once in [`PERIODS`].
#[derive(Clone, Debug)]
struct Slow<S: Scalar> {
    /// Mean square of the current (A²), averaged over the thermal time.
    heat: S,
    limits: ActiveLimits,
    heating: S::Gains<1>,
    heat_limit: S,
    warm: S,
    near_current: S,
    duty_limit: S,
    standstill: S,
    temperature: f32,
    command_turns: u32,
    stop_turns: u32,
    charge_turns: u32,
}

impl<S: Scalar> Slow<S> {
    fn new(
        protection: &Protection,
        config: &DriveConfig,
        bases: &Bases,
    ) -> Result<Self, ConfigError> {
        protection.check(config)?;
        let turn = PERIODS as f32 * config.timing.period();
        let turns = |time: f32| (time / turn) as u32 + 1;
        let square = protection.continuous_current * protection.continuous_current;
        let &Bases { current, speed, .. } = bases;
        let squares = current.squared();
        let heating = turn / protection.thermal_time;
        Ok(Self {
            heat: S::ZERO,
            limits: ActiveLimits::NONE,
            heating: S::gains("protection.thermal_time", [(heating, squares)], squares)?,
            heat_limit: S::constant("protection.continuous_current", square, squares)?,
            warm: S::from_f32(WARM * square, squares),
            near_current: S::from_f32(NEAR_LIMIT * config.limits.current_command, current),
            duty_limit: S::from_f32(NEARLY * config.limits.duty, Base::RATIO),
            standstill: S::from_f32(protection.standstill, speed),
            temperature: protection.temperature,
            command_turns: turns(protection.command_timeout),
            stop_turns: turns(protection.stop_time),
            charge_turns: turns(CHARGE_TIME),
        })
    }
}

impl<S: Scalar> Supervisor<S> {
    /// Builds a drive and its supervisor. Refuses a configuration outside its range, naming the field.
    pub fn new(config: &DriveConfig, protection: &Protection) -> Result<Self, ConfigError> {
        let bases = Bases::new(config)?;
        let squares = bases.current.squared();
        let slow = Slow::new(protection, config, &bases)?;
        Ok(Self {
            mode: Mode::Boot,
            faults: Faults::NONE,
            output: Output::Off,
            mean_square: S::ZERO,
            per_turn: S::gains("protection", [(1.0 / PERIODS as f32, squares)], squares)?,
            countdown: PERIODS,
            silence: 0,
            turns: 0,
            is_lost: false,
            measures: false,
            slow,
            // Last, and so straight to its place: it is large.
            drive: Drive::new(config)?,
        })
    }

    /// Takes the place of another supervisor, with outputs off: the motor is as hot as it was, and its faults are still there.
    pub fn succeed(&mut self, before: &Self) {
        self.slow.heat = before.slow.heat;
        for fault in before.faults.iter() {
            self.latch(fault);
        }
    }

    /// Takes a command, from the next step on.
    pub fn command(&mut self, command: Command) -> Result<(), Refusal> {
        let refused = Err(Refusal::Mode(self.mode));
        self.silence = 0;
        match command {
            Command::KeepAlive => Ok(()),
            Command::Speed(speed) if matches!(self.mode, Mode::Armed | Mode::Running) => {
                self.drive.set_speed(speed).map_err(|_| Refusal::SpeedOutOfRange)
            }
            Command::Arm if self.happens(Event::Arm) => Ok(()),
            Command::Stop if self.happens(Event::Stop) => Ok(()),
            Command::Off if self.happens(Event::Off) => Ok(()),
            Command::Clear if self.happens(Event::Clear) => Ok(()),
            _ => refused,
        }
    }

    /// Another controller, or the same with other gains; see [`Drive::take_controller`].
    pub fn take_controller(&mut self, other: &mut Self) {
        self.drive.take_controller(&mut other.drive);
    }

    /// Latches a fault: outputs are off from the next step.
    #[cold]
    pub fn latch(&mut self, fault: Fault) {
        self.faults.latch(fault);
        self.happens(Event::Fault);
    }

    /// One PWM period: from this period's sample to the bridge's output.
    // Not inlined where its instructions are counted apart from its caller's.
    #[cfg_attr(feature = "qemu", inline(never))]
    pub fn step(&mut self, sample: &Sample<S>, conditions: &Conditions) -> Output<S> {
        if conditions.tripped {
            self.latch(Fault::HardwareTrip);
        }
        // With outputs off nothing depends on time, and the flash may be busy.
        if conditions.overrun && self.output != Output::Off {
            self.latch(Fault::Overrun);
        }
        if conditions.current_sensors == CurrentSensors::Disagree {
            self.latch(Fault::CurrentSensors);
        }
        // Ahead of the drive: what it arms drives in this period.
        self.countdown -= 1;
        if self.countdown == 0 {
            self.countdown = PERIODS;
            self.check(conditions);
        }
        let command = self.drive.step(sample);
        if let drive::Mode::Faulted(fault) = self.drive.mode() {
            self.latch(fault);
        }
        self.output = match (self.mode, command) {
            (Mode::Running | Mode::Stopping, BridgeCommand::Duty(duty)) => {
                let [current, _] = self.drive.current_and_bus();
                let square = S::combine(&self.per_turn, [current.square()]);
                self.mean_square = self.mean_square + square;
                Output::Duty(duty)
            }
            (Mode::Armed, _) => self.charge(),
            _ => Output::Off,
        };
        self.output
    }

    /// The drive does not look at its sample yet.
    #[cold]
    fn charge(&mut self) -> Output<S> {
        match self.drive.electrical_fault() {
            Some(fault) => {
                self.latch(fault);
                Output::Off
            }
            None => Output::Charge,
        }
    }

    /// The checks that need not be made in every period.
    #[cold]
    #[inline(never)]
    fn check(&mut self, conditions: &Conditions) {
        self.turns = self.turns.saturating_add(1);
        self.silence = self.silence.saturating_add(1);
        self.happens(Event::Period);
        self.check_board(conditions);
        self.check_heat();
        self.go_on();
        self.note_limits(conditions);
    }

    fn check_board(&mut self, conditions: &Conditions) {
        match conditions.current_sensors {
            CurrentSensors::Learning | CurrentSensors::Disagree => {}
            CurrentSensors::Good => {
                self.happens(Event::ZeroLearnt);
            }
            CurrentSensors::BadZero => self.latch(Fault::CurrentZero),
        }
        let Conditions { temperature, .. } = *conditions;
        // Not the other way round: a NaN is no temperature.
        let is_one = (-45.0..=160.0).contains(&temperature);
        if !is_one {
            self.latch(Fault::TemperatureSensor);
        } else if temperature > self.slow.temperature {
            self.latch(Fault::Overtemperature);
        }
    }

    fn check_heat(&mut self) {
        let mean_square = core::mem::replace(&mut self.mean_square, S::ZERO);
        let slow = &mut self.slow;
        let difference = mean_square - slow.heat;
        slow.heat = slow.heat + S::accumulate(&slow.heating, [difference]);
        let is_within = slow.heat <= slow.heat_limit;
        if !is_within {
            self.latch(Fault::Overload);
        }
    }

    /// What time and speed bring about.
    fn go_on(&mut self) {
        match self.mode {
            Mode::Armed | Mode::Running | Mode::Commissioning
                if self.silence >= self.slow.command_turns =>
            {
                self.is_lost = self.happens(Event::Stop);
            }
            Mode::Armed if self.turns >= self.slow.charge_turns => {
                self.happens(if self.measures { Event::ChargedToMeasure } else { Event::Charged });
            }
            Mode::Stopping
                if self.drive.speed().abs() <= self.slow.standstill
                    || self.turns >= self.slow.stop_turns =>
            {
                self.happens(Event::Stopped);
            }
            _ => {}
        }
        // Whether it stopped or was not yet turning.
        if self.is_lost && self.mode == Mode::Ready {
            self.latch(Fault::CommandLost);
        }
    }

    fn note_limits(&mut self, conditions: &Conditions) {
        let slow = &mut self.slow;
        let [current, _] = self.drive.current_and_bus();
        let duty = match self.output {
            Output::Duty(duty) => duty.abs(),
            Output::Off | Output::Charge => S::ZERO,
        };
        let mut limits = ActiveLimits::NONE;
        limits.set(ActiveLimit::Duty, duty >= slow.duty_limit);
        limits.set(ActiveLimit::Current, current.abs() >= slow.near_current);
        limits.set(ActiveLimit::Heat, slow.heat >= slow.warm);
        limits.set(ActiveLimit::Temperature, conditions.temperature >= slow.temperature - NEAR_HOT);
        limits.set(ActiveLimit::Stopping, self.mode == Mode::Stopping);
        slow.limits = limits;
    }

    /// Changes the mode as [`TRANSITIONS`] has it; tells whether there was such a transition.
    fn happens(&mut self, event: Event) -> bool {
        let Some(to) = next(self.mode, event) else { return false };
        self.mode = to;
        self.turns = 0;
        self.measures = event == Event::Commission;
        // Neither is ever refused: zero is within the limits, and a drive's fault would have been latched here.
        match to {
            Mode::Armed | Mode::Stopping => drop(self.drive.set_speed(0.0)),
            Mode::Running => drop(self.drive.arm()),
            Mode::Ready | Mode::Faulted => self.drive.disarm(),
            Mode::Calibrating => {
                self.faults = Faults::NONE;
                self.is_lost = false;
                self.drive.clear_fault();
            }
            Mode::Boot | Mode::Commissioning => {}
        }
        true
    }

    /// Whether the drive drives.
    #[inline]
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// The latched faults.
    #[inline]
    pub fn faults(&self) -> Faults {
        self.faults
    }

    /// What the drive held back at the last slow check.
    #[inline]
    pub fn limits(&self) -> ActiveLimits {
        self.slow.limits
    }

    /// What the bridge was last told.
    #[inline]
    pub fn output(&self) -> Output<S> {
        self.output
    }

    /// The drive.
    #[inline]
    pub fn drive(&self) -> &Drive<S> {
        &self.drive
    }
}

/// Measuring needs floating point.
impl Supervisor<f32> {
    /// Arms the drive to measure its motor, from the mode `Ready`: as soon as the bootstrap capacitors are charged, the mode is `Commissioning`, and
    /// [`measure`](Self::measure) is to be called after [`step`](Self::step). Ended by [`Command::Off`]
    /// or [`Command::Stop`] at any time.
    pub fn start_commissioning(&mut self) -> Result<(), Refusal> {
        self.silence = 0;
        if self.happens(Event::Commission) { Ok(()) } else { Err(Refusal::Mode(self.mode)) }
    }

    /// What follows [`step`](Self::step) of the same sample in mode `Commissioning`: `commission` takes the place of the drive. Gives the bridge's
    /// output, which `step` alone keeps off in that mode; in others it stays as it is. All protections hold but those by the motor's
    /// model, of which nothing is known yet: speed and travel are held by the limits that `commission` has.
    #[cold]
    #[inline(never)]
    pub fn measure(&mut self, sample: &Sample<f32>, commission: &mut Commission) -> Output<f32> {
        if self.mode != Mode::Commissioning {
            return self.output;
        }
        if let Some(fault) = self.drive.electrical_fault() {
            self.latch(fault);
            return self.output;
        }
        let command = commission.step(sample);
        if commission.phase() == Phase::Over {
            self.happens(Event::Measured);
        } else if let BridgeCommand::Duty(duty) = command {
            let [current, _] = self.drive.current_and_bus();
            self.mean_square += f32::combine(&self.per_turn, [current.square()]);
            self.output = Output::Duty(duty);
        }
        self.output
    }
}

/// The mode after an event, if there is such a transition.
fn next(mode: Mode, event: Event) -> Option<Mode> {
    let found = TRANSITIONS.iter().find(|(from, by, _)| (*from, *by) == (mode, event));
    found.map(|(_, _, to)| *to)
}
