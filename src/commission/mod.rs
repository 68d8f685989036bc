//! The drive measures its own motor: one command takes an unknown motor to a model with stated errors, and to a drive that is tuned
//! for it.
//!
//! [`Commission`] is given each period's sample and gives the bridge's command in place of a [`Drive`](crate::drive::Drive). It goes
//! through the [phases](Phase) below, each of which ends after a bounded time if the bus is steady.
//!
//! Its limits hold at every instant while the sensors work. A sensor that dies, and a lead that opens, contradicts the others and ends it
//! (`watch.rs`), after some current, speed or travel beyond the limits: `tests/commission_sensors.rs` says how much.
//!
//! | phase | the bridge | shows |
//! |---|---|---|
//! | `Rest` | off | offset and noise of the current; that the shaft rests |
//! | `Pulses` | short pulses that grow until a current flows | open leads, the current's sign, R and L roughly: enough to control currents by |
//! | `Launch` | a current that grows, from rest | direction and counts of the encoder, a blocked shaft, how fast the motor is: what current its limits allow |
//! | `Trial` | currents of two levels and both signs in turn, short windows, slow | the same as `Short`, to control currents better |
//! | `Short` | again | L; R, and the voltage lost in brushes and dead time |
//! | `Long` | the same to higher speeds and in longer windows | R, Kb; J, b, Coulomb friction, a constant load |
//!
//! `pulses.rs`, `launch.rs` and, for the rest, `swing.rs` have them; what all of them share is here.
//!
//! In the last three the sign of the current changes where the shaft has reached a speed, most of the voltage, or the end of its
//! travel: it swings to and fro. Each sign holds with both levels, so that R is the difference that the level makes to the voltage, what is lost the
//! difference that the sign makes, and Kb what the speed makes, all of one least-squares fit of sums over windows (`window.rs`). So neither
//! has the current to settle nor the shaft to stand still, and what brushes and dead time take is no resistance.
//!
//! What cannot be told from a drive's own sensors: whether the current's gain and the encoder's counts are what the calibration says.
//! R, L, Kb and J follow the current's gain. Wrong counts scale Kb and J alike: only the nameplate shows them.
//!
//! # In the supervisor
//!
//! [`Supervisor::start_commissioning`](crate::supervisor::Supervisor::start_commissioning) begins it, and
//! [`Supervisor::measure`](crate::supervisor::Supervisor::measure) lets [`Commission::step`] take the place of the
//! drive's. `Off`, `Stop`, lost commands and every fault take outputs off at once. The [evidence](Commission::evidence) is there to be read
//! until it is tried to start again or, on a board, to change parameters. A host makes findings and a configuration of it ([`tuning::Known::tuned`]), which is applied and saved like any other.
//! For drives in `f32` only: measuring needs floating point, and a chip without it has not the room.

mod current;
mod extremes;
mod findings;
mod fit;
mod launch;
mod nameplate;
mod pulses;
mod swing;
pub mod tuning;
mod watch;
mod window;

pub use findings::{Evidence, Findings, Reason, Value};
pub use nameplate::Nameplate;

use crate::config::{ConfigError, positive, require};
use crate::control::Timing;
use crate::hal::{BridgeCommand, Sample};
use crate::limits::Limits;
use crate::math::{Scalar, sqrt};
use crate::per_unit::Bases;
use crate::sense::{Measured, Sensing, Sensors};
use current::{Armature, CurrentLoop};
use extremes::Extremes;
use findings::Fits;
use fit::Fit;
use launch::LAUNCH;
use pulses::{Pulsed, Pulses};
use serde::{Deserialize, Serialize};
use swing::{Closing, SHORT, TRIAL};
use watch::Watch;
use window::{Period, Window};

/// What is known before the motor is measured.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct CommissionConfig {
    /// What the board's samples are. Signs of current and counts may be wrong, and are found.
    pub sensors: Sensors,
    /// Sampling rate; a voltage must act a period late.
    pub timing: Timing,
    /// Limits that hold at every instant while the sensors work: `duty`, `speed`, `bus_min`, `bus_max`, and `current_command` for the current. (The trip
    /// `current` is the drive's.)
    pub limits: Limits,
    /// Highest voltage that the motor may get (V). Positive; infinite for what the duty's limit leaves of the bus.
    pub voltage: f32,
    /// How far the shaft may turn to either side of where it stands (rad). Positive; infinite for a shaft that may turn freely.
    pub travel: f32,
    /// Speed (rad/s) without load at a voltage (V), from the nameplate, if it is known: checks counts.
    pub no_load: Option<NoLoad>,
}

/// A speed without load at a voltage.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct NoLoad {
    /// Speed (rad/s). Positive.
    pub speed: f32,
    /// Voltage (V). Positive.
    pub voltage: f32,
}

/// What is being done.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Phase {
    /// Outputs are off: offset and noise.
    Rest,
    /// Short pulses of voltage.
    Pulses,
    /// One current from rest.
    Launch,
    /// To and fro in short windows, to control currents better.
    Trial,
    /// To and fro in short windows.
    Short,
    /// To and fro in long windows.
    Long,
    /// Over: outputs are off.
    Over,
}

/// How far it is.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Progress {
    /// What is being done.
    pub phase: Phase,
    /// Share of that phase's longest time that is over, from 0 to 1.
    pub share: f32,
}

impl Progress {
    /// Before the first period.
    pub const BEGINNING: Self = Self { phase: Phase::Rest, share: 0.0 };
    /// At the end.
    pub const OVER: Self = Self { phase: Phase::Over, share: 1.0 };
}

/// Periods that outputs are off at first.
const REST: u32 = 2048;

/// In pulses the current's code must not stand still for more than so many times as long as it did at rest, and for so many periods more, which
/// it may take from code to code. So noise tells whether its sensor is alive.
const STILL: (u32, u32) = (4, 128);

/// Periods of the first pulse after which a shaft that moves without any current is a dead sensor.
const MOVES: u32 = 64;

/// The current limit must be this many times the noise's deviation.
const SIGNAL: f32 = 60.0;

/// Noise over the current limit, at least: what sensors without any are taken for.
const LEAST_NOISE: f32 = 1e-4;

/// Share of the current limit in pulses. They may go to three times that.
const PULSE: f32 = 0.25;

/// Shares of the limits of speed and travel above which pulses do not grow.
const QUIET: f32 = 0.1;
const QUIET_TRAVEL: f32 = 0.03;

/// Counts of the travel, at least.
const TRAVEL: f32 = 150.0;

/// Share of the current limit that is the higher level, and share of the highest voltage that it may take at rest.
const HIGH: f32 = 0.75;
const HIGH_VOLTAGE: f32 = 0.4;

/// The lower level over the higher one.
const LOW: f32 = 0.45;
const LOW_MOST: f32 = 0.75;

/// The ripple's amplitude over the highest voltage by Λ, at most: V/(16·L·rate) at a duty of a half, where Λ is up to 1.6 times L·rate, and
/// some room. Within it the sign of the current says nothing.
const RIPPLE: f32 = 0.12;

/// Share of the lower level that the current must not leave for a window to count.
const WITHIN: f32 = 0.5;

/// Λ/R at least: where the pulses show less, this is stable with any armature.
const LEAST_INDUCTIVE: f32 = 2.5;

/// Share of the speed limit at which the current turns.
const TURN_SPEED: f32 = 0.4;

/// Share of the highest voltage at which it turns, and share of the travel that a turn at once may need.
const TURN_VOLTAGE: f32 = 0.8;
const TURN_TRAVEL: f32 = 0.6;

/// Share of the highest voltage that may go into the inductance.
const SLEW: f32 = 0.2;

/// Time without voltage before it (s).
const SETTLE: f32 = 0.1;

/// Counts that the shaft must turn in it.
const MOVED: f32 = 4.0;

/// Periods of a window, at least and at most; counts that pass in one at turning speed, at least.
const WINDOW: (f32, f32) = (16.0, 512.0);
const WINDOW_COUNTS: f32 = 6.0;

/// Windows from rest to turning speed.
const WINDOWS: f32 = 8.0;

/// Error of the current, averaged, over its limit: while it grows slowly, and where it turns. Healthy motors come to half of it.
const RAMPED: f32 = 0.04;
const TURNED: f32 = 0.5;

/// Measures a motor.
#[derive(Clone, Debug)]
pub struct Commission {
    phase: Phase,
    /// Why it ended before all was seen.
    stopped: Option<Reason>,
    /// Periods in this phase.
    elapsed: u32,
    sensing: Sensing<f32>,
    limits: Limits,
    voltage: f32,
    travel: f32,
    no_load: Option<NoLoad>,
    period: f32,
    rate: f32,
    /// Angle of a unit of the sensors' rotation, and of its grain (rad).
    unit: f32,
    grain: f32,
    /// Periods that the encoder's reads lie behind the current's.
    lag: f32,
    /// Resolution of the current (A).
    resolution: f32,
    /// Whether there was a sample.
    seen: bool,
    /// ±1: what makes positive duties flow and turn positively.
    current_sign: f32,
    turn_sign: f32,
    offset: f32,
    /// Sums at rest: of the current, its square, and the bus voltage; then the noise of the current (A).
    sums: [f32; 3],
    first_current: f32,
    noise: f32,
    bus_voltage: f32,
    current: f32,
    /// The period that ended with the last sample.
    last: Period,
    speed: f32,
    /// Whether the current was against the speed in the last period of a swing.
    is_slowing: bool,
    /// Speeds at the start and the end of the window before (rad/s).
    speeds: [f32; 2],
    /// Periods that the speed is averaged over.
    averaged: f32,
    angle: f32,
    /// Where the launch starts (rad).
    start: f32,
    /// The angle, averaged like the speed (rad).
    late_angle: f32,
    /// The last command, and the voltage that acts until the next sample (V).
    duty: f32,
    acting: f32,
    pulses: Pulses,
    control: CurrentLoop,
    watch: Watch,
    /// Periods that the current has stood still, and the most at rest.
    still: u32,
    stillest: u32,
    /// The levels of the current (A), and what the higher one is at most.
    most: f32,
    high: f32,
    low: f32,
    /// Least current in windows that count (A).
    least: f32,
    sign: f32,
    /// Angle where it turned last, in the direction of the current (rad).
    back: f32,
    turn_speed: f32,
    window: Window,
    before: Window,
    window_periods: f32,
    /// Windows since the current turned, and in this phase.
    windows: u32,
    all_windows: u32,
    /// Periods from rest to turning.
    ramp: f32,
    armature: Fit,
    shaft: Fit,
    closing: Closing,
    fits: Fits,
}

impl Commission {
    /// Refuses a configuration outside its range, naming the field.
    pub fn new(config: &CommissionConfig) -> Result<Self, ConfigError> {
        let CommissionConfig { sensors, timing, limits, voltage, travel, no_load } = *config;
        timing.check()?;
        limits.check()?;
        require(timing.delay, "timing.delay", "must be there for commissioning", 0.0)?;
        require(voltage > 0.0, "voltage", "must be positive, or infinite", voltage)?;
        require(travel > 0.0, "travel", "must be positive, or infinite", travel)?;
        if let Some(NoLoad { speed, voltage }) = no_load {
            positive("no_load.speed", speed)?;
            positive("no_load.voltage", voltage)?;
        }
        let period = timing.period();
        let sensing = Sensing::new(&sensors, &limits, timing.rate, &Bases::NONE)?;
        let shaft = sensors.shaft(period);
        let turn_speed = TURN_SPEED * limits.speed;
        let grain = shaft.unit.abs() * shaft.grain;
        let counted = WINDOW_COUNTS * grain * timing.rate / turn_speed;
        require(
            travel >= TRAVEL * grain,
            "travel",
            "must be at least 150 counts of the encoder",
            travel,
        )?;
        require(
            counted <= WINDOW.1,
            "limits.speed",
            "must be at least 15 counts in 512 periods, for commissioning",
            limits.speed,
        )?;
        let resolution = match sensors {
            Sensors::Exact => 0.0,
            Sensors::Codes(calibration) => calibration.current_per_code.abs(),
        };
        let averaged = counted.greater(WINDOW.0).lesser(4.0 * WINDOW.0);
        Ok(Self {
            phase: Phase::Rest,
            stopped: None,
            elapsed: 0,
            sensing,
            limits,
            voltage,
            travel,
            no_load,
            period,
            rate: timing.rate,
            unit: shaft.unit,
            grain,
            lag: shaft.age * timing.rate,
            resolution,
            seen: false,
            current_sign: 1.0,
            turn_sign: 1.0,
            offset: 0.0,
            sums: [0.0; 3],
            first_current: 0.0,
            noise: 0.0,
            bus_voltage: 0.0,
            current: 0.0,
            last: Period::default(),
            speed: 0.0,
            is_slowing: false,
            speeds: [0.0; 2],
            averaged,
            angle: 0.0,
            late_angle: 0.0,
            start: 0.0,
            duty: 0.0,
            acting: 0.0,
            pulses: Pulses::new(PULSE * limits.current_command),
            control: CurrentLoop::default(),
            watch: Watch::new(limits.current_command, grain * timing.rate / averaged, averaged),
            still: 0,
            stillest: 0,
            most: HIGH * limits.current_command,
            high: 0.0,
            low: 0.0,
            least: 0.0,
            sign: 1.0,
            back: 0.0,
            turn_speed,
            window: Window::default(),
            before: Window::default(),
            window_periods: 0.0,
            windows: 0,
            all_windows: 0,
            ramp: 0.0,
            armature: Fit::default(),
            shaft: Fit::default(),
            closing: Closing::Not,
            fits: Fits::default(),
        })
    }

    /// What is being done.
    pub fn phase(&self) -> Phase {
        self.phase
    }

    /// How far it is.
    pub fn progress(&self) -> Progress {
        let longest = match self.phase {
            Phase::Rest => REST as f32 * self.period,
            Phase::Pulses => {
                return Progress { phase: Phase::Pulses, share: self.pulses.share() };
            }
            Phase::Launch => SETTLE + LAUNCH,
            Phase::Trial => TRIAL,
            Phase::Short => SHORT,
            Phase::Long => self.long_time(),
            Phase::Over => return Progress::OVER,
        };
        let share = self.elapsed as f32 * self.period / longest;
        Progress { phase: self.phase, share: share.lesser(1.0) }
    }

    /// Turns outputs off for good. What was found until then stays.
    pub fn abort(&mut self) {
        self.stop(Reason::Aborted);
    }

    /// One PWM period: from its sample to the bridge's command. It cannot fail: whatever a sample holds, the duty is finite and
    /// within its limit, or outputs are off.
    pub fn step(&mut self, sample: &Sample<f32>) -> BridgeCommand<f32> {
        let measured = self.sensing.read(sample);
        if self.phase == Phase::Over {
            return BridgeCommand::Off;
        }
        let Some(measured) = measured else {
            return self.stop(Reason::BadSample);
        };
        let period = self.take(&measured);
        if let Err(reason) = self.limits_hold(&measured) {
            return self.stop(reason);
        }
        let highest = (self.limits.duty * measured.bus_voltage).lesser(self.voltage);
        if let Err(reason) = self.sensors_agree(&period, highest) {
            return self.stop(reason);
        }
        self.elapsed += 1;
        let wanted = match self.phase {
            Phase::Rest => self.rest(measured.bus_voltage),
            Phase::Pulses => self.pulse(&period, highest),
            Phase::Launch => self.launch(highest),
            Phase::Trial | Phase::Short | Phase::Long => self.swing(&period, highest),
            Phase::Over => Wanted::Off,
        };
        // What ended it may have wanted something yet.
        if self.phase == Phase::Over {
            self.duty = 0.0;
            return BridgeCommand::Off;
        }
        // What was asked for before begins to act now.
        self.acting = self.duty * measured.bus_voltage;
        let voltage = match wanted {
            Wanted::Off => {
                self.duty = 0.0;
                return BridgeCommand::Off;
            }
            Wanted::Voltage(voltage) => voltage,
            Wanted::Current(current) => self.control.step(self.current, current, highest),
        };
        self.duty = (voltage.limited(highest) / measured.bus_voltage).limited(self.limits.duty);
        BridgeCommand::Duty(self.duty)
    }

    /// Takes a sample in: gives the period before the one that ends with it.
    fn take(&mut self, measured: &Measured<f32>) -> Period {
        let current = self.current_sign * (measured.current - self.offset);
        // The first difference of counts is one to nothing.
        let advance = if self.seen { measured.rotation.advance } else { 0.0 };
        self.seen = true;
        self.still = if current.to_bits() == self.current.to_bits() { self.still + 1 } else { 0 };
        let turned = self.turn_sign * self.unit * advance;
        let currents = [self.current, current];
        let last = Period { voltage: self.acting, currents, turned };
        let before = core::mem::replace(&mut self.last, last);
        self.current = current;
        self.angle += turned;
        self.late_angle += (self.angle - self.late_angle) / self.averaged;
        self.back = self.back.lesser(self.sign * self.angle);
        self.speed += (turned * self.rate - self.speed) / self.averaged;
        // The encoder's reads lie before the current's: where it was then, this sample and the last one tell.
        Period { turned: before.turned + self.lag * (turned - before.turned), ..before }
    }

    fn limits_hold(&self, measured: &Measured<f32>) -> Result<(), Reason> {
        let Limits { speed, current_command, bus_min, bus_max, .. } = self.limits;
        // Not the other way round: a NaN holds no limit.
        let finite = [measured.current, measured.bus_voltage, measured.rotation.advance];
        if !finite.iter().all(|value| value.is_finite()) {
            Err(Reason::BadSample)
        } else if !(bus_min..=bus_max).contains(&measured.bus_voltage) {
            Err(Reason::BusVoltage)
        } else if self.current.abs() > current_command {
            Err(Reason::Overcurrent)
        } else if self.last.turned.abs() > 2.0 * (speed * self.period + self.grain) {
            Err(Reason::EncoderJump)
        } else if self.speed.abs() > speed {
            Err(Reason::Overspeed)
        } else if self.angle.abs() > self.travel {
            Err(Reason::Travel)
        } else {
            Ok(())
        }
    }

    /// Whether voltage, current and speed agree, as soon as enough of the armature is known.
    fn sensors_agree(&mut self, period: &Period, highest: f32) -> Result<(), Reason> {
        match self.phase {
            Phase::Rest => {
                self.stillest = self.stillest.max(self.still);
                return Ok(());
            }
            Phase::Pulses => {
                let is_dead = self.still > STILL.0 * self.stillest + STILL.1;
                return if is_dead { Err(Reason::CurrentLost) } else { Ok(()) };
            }
            _ => {}
        }
        let follows = if self.phase == Phase::Launch { RAMPED } else { TURNED };
        let off = follows * self.limits.current_command + 2.0 * self.noise;
        self.watch.step(period, period.turned * self.rate, &self.control, off, highest)
    }

    #[cold]
    #[inline(never)]
    fn stop(&mut self, reason: Reason) -> BridgeCommand<f32> {
        if self.phase != Phase::Over {
            self.stopped = Some(reason);
            self.phase = Phase::Over;
        }
        BridgeCommand::Off
    }

    #[inline(never)]
    fn enter(&mut self, phase: Phase) {
        self.phase = phase;
        self.elapsed = 0;
        self.windows = 0;
        self.all_windows = 0;
        self.window = Window::default();
        self.before = Window::default();
        self.speeds = [0.0; 2];
        self.armature = Fit::default();
        self.shaft = Fit::default();
        self.closing = Closing::Not;
    }

    /// Angle from which the shaft has moved (rad).
    fn moved(&self) -> f32 {
        MOVED * self.grain.greater(1e-3)
    }

    /// Outputs off: what the sensors show of nothing.
    fn rest(&mut self, bus_voltage: f32) -> Wanted {
        let current = self.current;
        if self.elapsed == 1 {
            self.first_current = current;
        }
        let difference = current - self.first_current;
        self.sums[0] += difference;
        self.sums[1] += difference * difference;
        self.sums[2] += bus_voltage;
        if self.angle.abs() > self.moved() {
            self.stop(Reason::Turning);
        }
        if self.elapsed < REST {
            return Wanted::Off;
        }
        let [mean, square, bus_voltage] = self.sums.map(|sum| sum / REST as f32);
        self.bus_voltage = bus_voltage;
        self.offset = self.first_current + mean;
        // What noise there is within a code does not show.
        let rounding = self.resolution * self.resolution / 12.0;
        let limit = self.limits.current_command;
        let noise = sqrt((square - mean * mean).greater(0.0) + rounding);
        self.noise = noise.greater(LEAST_NOISE * limit);
        if self.offset.abs() > PULSE * limit {
            self.stop(Reason::CurrentZero);
        } else if limit < SIGNAL * self.noise {
            self.stop(Reason::NoisyCurrent);
        } else {
            self.angle = 0.0;
            self.enter(Phase::Pulses);
        }
        Wanted::Off
    }

    fn pulse(&mut self, period: &Period, highest: f32) -> Wanted {
        let least = PULSE * SIGNAL * self.noise;
        let is_quick = self.speed.abs() > QUIET * self.limits.speed
            || self.angle.abs() > QUIET_TRAVEL * self.travel;
        let has_moved = self.angle.abs() > self.moved();
        let is_dead = |periods| periods > MOVES && self.still >= periods;
        if has_moved && self.pulses.probing().is_some_and(is_dead) {
            self.stop(Reason::CurrentLost);
            return Wanted::Off;
        }
        match self.pulses.step(period, self.current, highest, least, is_quick) {
            Pulsed::Voltage(voltage) => {
                if core::mem::take(&mut self.pulses.is_reversed) {
                    self.current_sign = -self.current_sign;
                    self.current = -self.current;
                    self.last.currents = self.last.currents.map(|current| -current);
                }
                Wanted::Voltage(voltage)
            }
            Pulsed::NoCurrent => {
                self.stop(Reason::LeadOpen);
                Wanted::Off
            }
            Pulsed::LessCurrent => {
                self.stop(Reason::CurrentLost);
                Wanted::Off
            }
            Pulsed::Done => {
                self.plan(highest);
                Wanted::Voltage(0.0)
            }
        }
    }

    /// Levels and windows, from what the pulses showed.
    fn plan(&mut self, highest: f32) {
        let [resistance, lost, _, inductive] = self.pulses.fit.solve([0.0; 4]).values;
        let known = resistance.greater(inductive);
        if !(known > 0.0 && known.is_finite()) {
            self.stop(Reason::Unexplained);
            return;
        }
        // Rough as they are, R below Λ/1000 or above what leaves an inductance would be too much.
        let inductive = inductive.greater(LEAST_INDUCTIVE * resistance);
        self.tune(resistance.greater(1e-3 * inductive), lost, inductive, LOW_MOST, highest);
        self.back = 0.0;
        if self.high < 0.5 * SIGNAL * self.noise {
            self.stop(Reason::NoisyCurrent);
        } else {
            self.enter(Phase::Launch);
        }
    }

    /// The current's control, its levels and short windows for an armature.
    fn tune(&mut self, resistance: f32, lost: f32, inductive: f32, low: f32, highest: f32) {
        self.high = self.most.lesser((HIGH_VOLTAGE * highest - lost) / resistance);
        let ripple = RIPPLE * highest / inductive;
        self.low = (low * self.high).greater(1.3 * ripple).lesser(LOW_MOST * self.high);
        self.least = (WITHIN * self.low).greater(ripple).lesser(0.8 * self.low);
        self.fits.within_ripple = ripple > self.low;
        self.control.armature = Armature { resistance, inductive, lost, ripple };
        self.watch.relearn(false);
        self.control.slew = (self.high / 12.0).lesser(SLEW * highest / inductive);
        let electrical = 0.6 * inductive / resistance;
        self.window_periods = electrical.greater(WINDOW.0).lesser(0.25 * WINDOW.1);
    }

    /// What was measured until now.
    pub fn evidence(&self) -> Evidence {
        Evidence {
            stopped: self.stopped,
            bus_voltage: self.bus_voltage,
            current_offset: self.offset,
            current_noise: self.noise,
            current_reversed: self.current_sign < 0.0,
            period: self.period,
            no_load: self.no_load,
            fits: self.fits,
        }
    }

    /// What was found until now.
    pub fn findings(&self) -> Findings {
        self.evidence().findings()
    }
}

/// What the bridge is to do.
enum Wanted {
    Off,
    Voltage(f32),
    Current(f32),
}
