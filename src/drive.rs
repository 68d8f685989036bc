//! The drive: the only place where reference, law, limits and bridge meet.
//!
//! Outputs are off until [`Drive::arm`], and off for good after a fault, until [`Drive::clear_fault`] and
//! [`Drive::arm`]. All checks of the configuration happen in [`Drive::new`]; [`Drive::step`] cannot fail: whatever a
//! sample holds, it returns a finite duty within the limit, or [`BridgeCommand::Off`].

use crate::config::ConfigError;
use crate::control::injection::Injections;
use crate::control::{ControlConfig, Controller, Decision, Ranges, Setting, Signals, Timing};
pub use crate::fault::Fault;
use crate::hal::{Board, BridgeCommand, Sample};
pub use crate::limits::Limits;
use crate::math::{Base, Scalar};
use crate::motor::MotorParameters;
use crate::per_unit::Bases;
use crate::schema::{Group, Unset, Visitor};
use crate::sense::{Measured, Sensing, Sensors};
use crate::trajectory::{Reference, Shape, Shaper};

/// Everything that a drive is built from.
#[derive(Clone, Copy, Debug, PartialEq)]
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

impl Unset for DriveConfig {
    const UNSET: Self = Self {
        motor: Unset::UNSET,
        sensors: Unset::UNSET,
        control: Unset::UNSET,
        timing: Unset::UNSET,
        limits: Unset::UNSET,
        shape: Unset::UNSET,
    };
}

impl Group for DriveConfig {
    fn fields(&mut self, visitor: &mut Visitor) {
        let Self { motor, sensors, control, timing, limits, shape } = self;
        visitor("motor", motor);
        visitor("sensors", sensors);
        visitor("control", control);
        visitor("timing", timing);
        visitor("limits", limits);
        visitor("reference", shape);
    }
}

/// The voltage u − Ra·i − Kb·ω that is taken for a wrong parameter, as a share of [`Limits::bus_max`]: more is a wrong
/// connection. Half the resistance wrong at the current that stalls the motor takes a half of the bus, but not for long.
pub const MODEL_SHARE: f32 = 0.3;

/// How long load, voltage or model may be beyond what is covered (s).
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
    /// Whether the drive is armed and its controller has started.
    driving: bool,
    /// Whether another controller is to take over in the middle of a run.
    changed: bool,
    /// Whether there was a sample.
    seen: bool,
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
    /// Steps beyond the model that are one.
    mismatch_steps: u32,
    /// Steps in a row beyond the model.
    mismatched: u32,
    mismatch_limit: S,
    back_emf: S::Gains<1>,
    /// Ra·i + Kb·ω.
    modelled: S::Gains<2>,
    minus_inertia: S::Gains<1>,
    /// The last sample's current and bus voltage.
    measured: [S; 2],
    /// The highest bus is 2⁻`headroom` of the base of voltages.
    headroom: u32,
    bases: Bases,
    /// Of the controller. Last, being large.
    injections: Injections<S>,
}

/// Builds the controller of a configuration and tabulates its injections.
fn build<S: Scalar>(
    config: &DriveConfig,
    injections: &mut Injections<S>,
) -> Result<Controller<S>, ConfigError> {
    let motor = config.motor.coefficients()?;
    let DriveConfig { limits, timing, .. } = config;
    limits.check()?;
    let setting = Setting {
        motor: &motor,
        timing,
        shaft: &config.sensors.shaft(timing.period()),
        ranges: &Ranges {
            speed: limits.speed,
            current: limits.current,
            current_command: limits.current_command,
        },
        bases: &Bases::new(config)?,
    };
    Controller::new(&config.control, &setting, injections)
}

impl<S: Scalar> Drive<S> {
    /// Builds a drive, not armed, commanded to stand still. Refuses a configuration outside its range, naming the field.
    // In one frame with the supervisor's: each would take the stack of a whole drive.
    #[inline(always)]
    pub fn new(config: &DriveConfig) -> Result<Self, ConfigError> {
        let DriveConfig { limits, timing, .. } = config;
        let shaft = config.sensors.shaft(timing.period());
        let bases = Bases::new(config)?;
        let Bases { speed, acceleration, angle, current, voltage, torque, .. } = bases;
        let MotorParameters { resistance, back_emf_constant, inertia, .. } = config.motor;
        let modelled = [(resistance, current), (back_emf_constant, speed)];
        // However slow the shaft, an edge between two samples' reads is a whole count, and noise may be another.
        let mut injections = Injections::NONE;
        let controller = build(config, &mut injections)?;
        let advance = 2.0 * (limits.speed * timing.period() / shaft.unit.abs() + shaft.grain);
        Ok(Self {
            mode: Mode::Off,
            driving: false,
            seen: false,
            driven: false,
            changed: false,
            sensing: Sensing::new(&config.sensors, limits, timing.rate, &bases)?,
            shaper: Shaper::new(config.shape, timing.rate, &bases)?,
            duty_limit: S::from_f32(limits.duty, Base::RATIO),
            speed_limit: S::from_f32(limits.speed, speed),
            advance_limit: S::from_f32(advance, angle),
            current_limit: S::from_f32(limits.current, current),
            bus_min: S::from_f32(limits.bus_min, voltage),
            bus_max: S::from_f32(limits.bus_max, voltage),
            voltage: S::ZERO,
            idle_speed: S::ZERO,
            authority_steps: (AUTHORITY_TIME * timing.rate) as u32,
            // While a current builds up the inductance takes its share of the voltage.
            mismatch_steps: (AUTHORITY_TIME
                .max(3.0 * config.motor.inductance / config.motor.resistance)
                * timing.rate) as u32,
            mismatched: 0,
            mismatch_limit: S::from_f32(MODEL_SHARE * limits.bus_max, voltage),
            back_emf: S::gains("motor.back_emf_constant", [(back_emf_constant, speed)], voltage)?,
            modelled: S::gains("motor", modelled, voltage)?,
            minus_inertia: S::gains("motor.inertia", [(-inertia, acceleration)], torque)?,
            measured: [S::ZERO; 2],
            headroom: S::headroom("limits.bus_max", limits.bus_max, voltage)?,
            bases,
            controller,
            injections,
        })
    }

    /// Turns the outputs on from the next step. The controller starts anew, and a shaped reference at the speed that the
    /// motor has. The commanded speed stays.
    pub fn arm(&mut self) -> Result<(), Refusal> {
        match self.mode {
            Mode::Faulted(fault) => Err(Refusal::Faulted(fault)),
            Mode::Running => Ok(()),
            Mode::Off => {
                self.mode = Mode::Running;
                Ok(())
            }
        }
    }

    /// Another controller, or the same with other gains, from the next step on: that of a drive which is built from the same
    /// configuration in everything but [`DriveConfig::control`]. In the middle of a run it takes over without a jump: it starts from the
    /// speed that was known, the current that there is, and the voltage that acts. What `other` has then is of no use.
    pub fn take_controller(&mut self, other: &mut Self) {
        self.changed |= self.driving;
        if self.driving {
            self.idle_speed = self.controller.signals().speed;
            self.driving = false;
        }
        // To exchange the tables too would take three times as long, in one period.
        core::mem::swap(&mut self.controller, &mut other.controller);
        self.injections = other.injections;
        self.controller.know(self.idle_speed);
    }

    /// Turns the outputs off from the next step. A fault stays latched.
    pub fn disarm(&mut self) {
        if self.mode == Mode::Running {
            self.mode = Mode::Off;
            self.stop();
        }
    }

    /// Clears a latched fault. The drive stays off until armed.
    pub fn clear_fault(&mut self) {
        if let Mode::Faulted(_) = self.mode {
            self.mode = Mode::Off;
        }
    }

    /// Commands a speed (rad/s).
    pub fn set_speed(&mut self, speed: f32) -> Result<(), Refusal> {
        let target = S::from_f32(speed, self.bases.speed);
        if !speed.is_finite() || target.abs() > self.speed_limit {
            return Err(Refusal::SpeedOutOfRange);
        }
        self.shaper.set_target(target);
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
    // Not inlined where its instructions are counted apart from its caller's.
    #[cfg_attr(feature = "qemu", inline(never))]
    pub fn step(&mut self, sample: &Sample<S>) -> BridgeCommand<S> {
        let Some(mut measured) = self.sensing.read(sample) else {
            return self.refuse(Fault::BadSample);
        };
        self.measured = [measured.current, measured.bus_voltage];
        if !self.driving {
            let Some(first) = self.start(measured) else { return BridgeCommand::Off };
            measured = first;
        }
        if !self.limits_hold(&measured) {
            return self.refuse(self.fault_in(measured));
        }
        let reference = self.shaper.advance();
        let Decision { voltage, speed, exhausted } =
            self.controller.step(&self.injections, &measured, reference, self.voltage);
        // Not the other way round: a NaN is no speed within the limit.
        let plausible = speed.abs() <= self.speed_limit;
        if !plausible {
            return self.refuse(if speed.is_finite() {
                Fault::Overspeed
            } else {
                Fault::BadSample
            });
        }
        if exhausted > self.authority_steps && self.controller.stuck() {
            return self.refuse(Fault::BeyondAuthority);
        }
        let modelled = S::combine(&self.modelled, [measured.current, speed]);
        let is_mismatched = (self.voltage - modelled).abs() > self.mismatch_limit;
        self.mismatched = if is_mismatched { self.mismatched.wrapping_add(1) } else { 0 };
        if self.mismatched > self.mismatch_steps {
            return self.refuse(Fault::ModelMismatch);
        }
        self.voltage = voltage.limited(self.duty_limit.of(measured.bus_voltage));
        let duty = self.voltage.ratio(measured.bus_voltage, self.duty_limit, self.headroom);
        BridgeCommand::Duty(duty)
    }

    /// Follows the motor with the bridge off or, once armed, starts from what was followed: without a jump of reference,
    /// voltage or estimates. Gives the sample to drive on if it started.
    #[cold]
    fn start(&mut self, mut measured: Measured<S>) -> Option<Measured<S>> {
        // The first difference of counts is one to nothing.
        if !self.seen && measured.rotation.advance.is_finite() {
            measured.rotation.advance = S::ZERO;
        }
        self.seen = true;
        if self.mode != Mode::Running {
            if self.can_follow(&measured) {
                self.idle_speed = self.controller.follow(&self.injections, &measured);
                // What no shaft does is unlearnt at once.
                let plausible = self.idle_speed.abs() <= self.speed_limit + self.speed_limit;
                if !plausible {
                    self.idle_speed = S::ZERO;
                    self.controller.know(S::ZERO);
                }
            }
            return None;
        }
        if !self.limits_hold(&measured) {
            self.refuse(self.fault_in(measured));
            return None;
        }
        self.driving = true;
        self.driven = true;
        self.mismatched = 0;
        if core::mem::replace(&mut self.changed, false) {
            let reference = *self.shaper.clone().advance();
            let (speed, acting) = (self.idle_speed, self.voltage);
            self.controller.resume(&self.injections, speed, &measured, &reference, acting);
            return Some(measured);
        }
        self.shaper.reset(self.idle_speed);
        self.voltage = S::combine(&self.back_emf, [self.idle_speed]);
        let reference = *self.shaper.clone().advance();
        self.controller.start(&self.injections, &measured, &reference);
        Some(measured)
    }

    /// Outputs off; while running, for a fault.
    #[cold]
    fn refuse(&mut self, fault: Fault) -> BridgeCommand<S> {
        if self.mode == Mode::Running {
            self.mode = Mode::Faulted(fault);
            self.stop();
        }
        BridgeCommand::Off
    }

    /// Goes idle, with the speed that was last known.
    fn stop(&mut self) {
        let speed = self.controller.signals().speed;
        if self.driving && speed.abs() <= self.speed_limit {
            self.idle_speed = speed;
        }
        self.driving = false;
        self.changed = false;
    }

    /// Whether a sample is within the limits, but for the speed, which the controller tells.
    #[inline]
    fn limits_hold(&self, measured: &Measured<S>) -> bool {
        measured.rotation.advance.abs() <= self.advance_limit
            && measured.current.abs() <= self.current_limit
            && measured.bus_voltage >= self.bus_min
            && measured.bus_voltage <= self.bus_max
    }

    /// Whether a sample is good to follow the motor by. Without a bus too: what matters is where the motor is when the drive is
    /// armed.
    fn can_follow(&self, measured: &Measured<S>) -> bool {
        measured.rotation.advance.abs() <= self.advance_limit
            && measured.current.abs() <= self.current_limit
            && measured.speed.abs() <= self.speed_limit
    }

    /// What is wrong with a sample that is not within the limits.
    #[cold]
    fn fault_in(&self, measured: Measured<S>) -> Fault {
        if !measured.rotation.advance.is_finite() {
            return Fault::BadSample;
        }
        self.electrical_fault().unwrap_or(Fault::EncoderJump)
    }

    /// What is wrong with the last sample's current or bus voltage, whether the drive drives or not.
    pub fn electrical_fault(&self) -> Option<Fault> {
        let [current, bus_voltage] = self.measured;
        if !(current.is_finite() && bus_voltage.is_finite()) {
            Some(Fault::BadSample)
        } else if current.abs() > self.current_limit {
            Some(Fault::Overcurrent)
        } else if bus_voltage < self.bus_min {
            Some(Fault::BusUndervoltage)
        } else if bus_voltage > self.bus_max {
            Some(Fault::BusOvervoltage)
        } else {
            None
        }
    }

    /// What full scale is, for signals in fixed point.
    pub fn bases(&self) -> &Bases {
        &self.bases
    }

    /// Whether the drive drives, and if not, why.
    pub fn mode(&self) -> Mode {
        self.mode
    }

    /// Armature current (A) and bus voltage (V) of the last sample, whatever they are; zeros before the first.
    #[inline]
    pub fn current_and_bus(&self) -> [S; 2] {
        self.measured
    }

    /// Shaft speed (rad/s) as last known, whether the drive drives or follows.
    pub fn speed(&self) -> S {
        if self.driving { self.controller.signals().speed } else { self.idle_speed }
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
            load_torque: S::combine(&self.minus_inertia, [signals.disturbance]),
        })
    }
}
