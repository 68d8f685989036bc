//! What was found: values with their uncertainty, or why they were not seen.

use super::NoLoad;
use super::fit::Solution;
use crate::math::{atanh, sqrt};
use core::fmt;
use serde::{Deserialize, Serialize};

/// A measured value.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Value {
    /// The value, in its SI unit.
    pub value: f32,
    /// Half the interval about it that holds the truth in at least nine of ten motors (same unit): twice the standard deviation that the
    /// fit's residuals tell (three times for torques), and half a percent for what they do not (two of torques and voltages). The sensors' own gains are taken as right.
    pub uncertainty: f32,
}

impl Value {
    /// Share of the value that residuals do not tell.
    const FLOOR: f32 = 0.005;

    /// Refuses what is not known to within half of it.
    fn positive(value: f32, deviation: f32) -> Result<Self, Reason> {
        let uncertainty = 2.0 * deviation + Self::FLOOR * value.abs();
        // Not the other way round: a NaN is nothing known.
        let known = value > 0.0 && uncertainty < 0.5 * value;
        if known { Ok(Self { value, uncertainty }) } else { Err(Reason::Imprecise) }
    }

    /// Of a value that may be zero, with the uncertainty of something of which it is a part.
    fn any(value: f32, deviation: f32, share: f32) -> Result<Self, Reason> {
        let uncertainty = 3.0 * deviation + share * value.abs();
        let known = uncertainty.is_finite() && value.is_finite();
        if known { Ok(Self { value, uncertainty }) } else { Err(Reason::Imprecise) }
    }
}

/// Why something was not seen, or commissioning ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum Reason {
    /// [`Commission::abort`](super::Commission::abort).
    Aborted,
    /// It has not come to that yet.
    NotReached,
    /// A sample held a NaN or an infinity, or was of another kind than the sensors.
    BadSample,
    /// The bus voltage was outside its limits.
    BusVoltage,
    /// The current was beyond its limit.
    Overcurrent,
    /// The speed was beyond its limit.
    Overspeed,
    /// The shaft turned further than its travel.
    Travel,
    /// The encoder moved further in a period than twice what the limit of the speed and a count allow.
    EncoderJump,
    /// The shaft turned with outputs off.
    Turning,
    /// With outputs off the current's sensor showed more than a quarter of the current limit.
    CurrentZero,
    /// The current limit (or the current that the voltage can make) is less than 60 times the noise of the current.
    NoisyCurrent,
    /// No current was seen at the highest voltage, and neither did the shaft move nor was the sensor's noise missing.
    LeadOpen,
    /// Pulses of voltage made a current that no armature makes.
    Unexplained,
    /// The shaft did not turn, nor was there a back-EMF.
    Blocked,
    /// There was a back-EMF, but the encoder did not count.
    EncoderMissing,
    /// At the least current that its sensor shows the shaft would be beyond the limits of speed or travel before it could be turned back.
    TooQuick,
    /// The currents that limits allow are within their own ripple, where what brushes and dead time take looks like resistance.
    Ripple,
    /// The interval is wider than half the value: too short a travel, too low a speed or current limit, too coarse an encoder.
    Imprecise,
    /// Kb is not within a third of what the nameplate says: wrong counts per turn, or another motor.
    NoLoadSpeed,
    /// While it was measured the current was not what the voltage makes, or stood still.
    CurrentLost,
    /// While it was measured the speed was not what the back-EMF tells.
    EncoderLost,
    /// The resistance changed from the short to the long windows.
    Unsteady,
}

impl fmt::Display for Reason {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::Aborted => "aborted",
            Self::NotReached => "it has not come to that",
            Self::BadSample => "a sample held no number",
            Self::BusVoltage => "the bus voltage was outside its limits",
            Self::Overcurrent => "the current was beyond its limit",
            Self::Overspeed => "the speed was beyond its limit",
            Self::Travel => "the shaft turned further than its travel",
            Self::EncoderJump => {
                "the encoder moved further in a period than the speed limit allows"
            }
            Self::Turning => "the shaft turned with outputs off",
            Self::CurrentZero => "the current sensor showed a current with outputs off",
            Self::NoisyCurrent => "the current limit is too low for the noise of the current",
            Self::LeadOpen => {
                "no current was seen: a motor lead is open, or the current sensor is dead"
            }
            Self::Unexplained => "pulses of voltage made a current that no armature makes",
            Self::Blocked => "the shaft did not turn: it is blocked",
            Self::EncoderMissing => "the motor turned, and the encoder did not count",
            Self::TooQuick => "the limits of speed or travel leave no time to turn the shaft back",
            Self::Ripple => "the currents that the limits allow are within their own ripple",
            Self::Imprecise => "not known to within half of it: the limits leave too little to see",
            Self::NoLoadSpeed => {
                "the nameplate says otherwise: wrong counts per turn, or another motor"
            }
            Self::CurrentLost => {
                "the current is not what the voltage makes: its sensor died, or a motor lead opened"
            }
            Self::EncoderLost => {
                "the speed is not what the back-EMF tells: the encoder died, or the current sensor"
            }
            Self::Unsteady => {
                "the resistance changed while it was measured: the current sensor, or a loose lead"
            }
        })
    }
}

/// All that commissioning finds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Findings {
    /// Why it ended early, if it did.
    pub stopped: Option<Reason>,
    /// Bus voltage with outputs off (V).
    pub bus_voltage: f32,
    /// Current that the sensor shows at none (A), beyond what its calibration has.
    pub current_offset: f32,
    /// Noise of the current with outputs off, rounding included (A rms).
    pub current_noise: f32,
    /// Whether the current's sensor is the other way round from the calibration: then its gain changes its sign.
    pub current_reversed: bool,
    /// Whether the encoder is the other way round from the calibration: then its counts per turn change their sign. (A motor with its leads
    /// exchanged is the same to the drive.)
    pub encoder_reversed: Result<bool, Reason>,
    /// Armature resistance Ra, with leads and bridge (Ω).
    pub resistance: Result<Value, Reason>,
    /// Armature inductance La (H).
    pub inductance: Result<Value, Reason>,
    /// Voltage that brushes and dead time take at any current (V).
    pub voltage_drop: Result<Value, Reason>,
    /// Back-EMF constant Kb (V·s/rad).
    pub back_emf_constant: Result<Value, Reason>,
    /// Moment of inertia J (kg·m²).
    pub inertia: Result<Value, Reason>,
    /// Viscous friction b (N·m·s/rad); its estimate may be below zero by less than its uncertainty.
    pub viscous_friction: Result<Value, Reason>,
    /// Coulomb friction T_c (N·m).
    pub coulomb_friction: Result<Value, Reason>,
    /// Load torque that was there all the time, of one sign in both directions (N·m), positive when it opposes positive motion.
    pub load_torque: Result<Value, Reason>,
}

/// What a drive has measured. [`findings`](Self::findings) is what it says, which a drive leaves to its host: it takes over 1 kB of
/// code.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Evidence {
    pub(super) stopped: Option<Reason>,
    pub(super) bus_voltage: f32,
    pub(super) current_offset: f32,
    pub(super) current_noise: f32,
    pub(super) current_reversed: bool,
    /// Sampling period (s).
    pub(super) period: f32,
    pub(super) no_load: Option<NoLoad>,
    pub(super) fits: Fits,
}

impl Evidence {
    /// What was found until then.
    pub fn findings(&self) -> Findings {
        let &Self { stopped, fits, .. } = self;
        let not_seen = stopped.or(fits.unseen).unwrap_or(Reason::NotReached);
        let values = fits.values(self.period, not_seen);
        let [viscous_friction, coulomb_friction, load_torque] = values.torques;
        Findings {
            stopped,
            bus_voltage: self.bus_voltage,
            current_offset: self.current_offset,
            current_noise: self.current_noise,
            current_reversed: self.current_reversed,
            encoder_reversed: fits.direction.map(|sign| sign < 0.0).ok_or(not_seen),
            resistance: values.resistance,
            inductance: values.inductance,
            voltage_drop: values.voltage_drop,
            back_emf_constant: values.back_emf_constant.and_then(|value| self.plausible(value)),
            inertia: values.inertia,
            viscous_friction,
            coulomb_friction,
            load_torque,
        }
    }

    /// Refuses a Kb that the nameplate contradicts.
    fn plausible(&self, back_emf: Value) -> Result<Value, Reason> {
        let Some(NoLoad { speed, voltage }) = self.no_load else { return Ok(back_emf) };
        let ratio = back_emf.value * speed / voltage;
        if (1.0 / NAMEPLATE..=NAMEPLATE).contains(&ratio) {
            Ok(back_emf)
        } else {
            Err(Reason::NoLoadSpeed)
        }
    }
}

/// How far Kb may be from the nameplate's voltage over its speed, either way. Friction and tolerances take up to a fifth; counts in place of lines
/// are a factor of four.
const NAMEPLATE: f32 = 1.5;

/// What the phases' fits came to.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub(super) struct Fits {
    /// Why what is to be seen of a turning shaft cannot be.
    pub unseen: Option<Reason>,
    /// The encoder's sign, once it is known.
    pub direction: Option<f32>,
    /// Whether the currents were within their ripple.
    pub within_ripple: bool,
    /// Speed at which the long windows turn (rad/s).
    pub turn_speed: f32,
    /// R, V0, Kb and Λ by the short and the long windows.
    pub short: Option<Solution>,
    pub long: Option<Solution>,
    /// Kb/J, −b/J, −T_c/J and −T_l/J.
    pub shaft: Option<Solution>,
}

/// The values that the fits give.
pub(super) struct Values {
    pub resistance: Result<Value, Reason>,
    pub inductance: Result<Value, Reason>,
    pub voltage_drop: Result<Value, Reason>,
    pub back_emf_constant: Result<Value, Reason>,
    pub inertia: Result<Value, Reason>,
    /// b, T_c and T_l.
    pub torques: [Result<Value, Reason>; 3],
}

impl Fits {
    /// With a sampling period (s), and why what was not fitted was not seen.
    pub fn values(&self, period: f32, not_seen: Reason) -> Values {
        let beyond_ripple = if self.within_ripple { Err(Reason::Ripple) } else { Ok(()) };
        let short = self.short.ok_or(not_seen);
        // The long windows show all but the inductance better, and are not there where the shaft is blocked.
        let best = self.long.or(self.short).ok_or(not_seen);
        let long = self.long.ok_or(not_seen);
        let of = |solution: Solution, unknown: usize| {
            (solution.values[unknown], solution.deviations[unknown])
        };
        let best = best.and_then(|best| beyond_ripple.map(|()| best));
        let short = short.and_then(|short| beyond_ripple.map(|()| short));
        Values {
            resistance: best.and_then(|best| {
                let (value, deviation) = of(best, 0);
                Value::positive(value, deviation)
            }),
            inductance: short.and_then(|short| inductance(&short, period)),
            voltage_drop: best.and_then(|best| {
                let (value, deviation) = of(best, 1);
                Value::any(value, deviation, 0.02)
            }),
            back_emf_constant: long.and_then(|long| {
                let (value, deviation) = of(long, 2);
                Value::positive(value, deviation)
            }),
            inertia: long.and_then(|long| self.inertia(&long)),
            torques: [1, 2, 3].map(|unknown| long.and_then(|long| self.torque(&long, unknown))),
        }
    }

    fn inertia(&self, long: &Solution) -> Result<Value, Reason> {
        let Solution { values, deviations } = self.shaft.ok_or(Reason::NotReached)?;
        let [per_inertia, back_emf] = [values[0], long.values[2]];
        let [first, second] = [deviations[0] / per_inertia, long.deviations[2] / back_emf];
        let inertia = back_emf / per_inertia;
        Value::positive(inertia, inertia * sqrt(first * first + second * second))
    }

    fn torque(&self, long: &Solution, unknown: usize) -> Result<Value, Reason> {
        let Solution { values, deviations } = self.shaft.ok_or(Reason::NotReached)?;
        let inertia = long.values[2] / values[0];
        Value::any(-values[unknown] * inertia, deviations[unknown] * inertia, 0.02)
    }
}

/// La = −h·R/ln(1 − R/Λ), which for a current that hardly decays in a period is h·Λ.
fn inductance(short: &Solution, period: f32) -> Result<Value, Reason> {
    let of = |resistance: f32, inductive: f32| {
        let share = resistance / inductive;
        // −ln(1 − x) = 2·atanh(x/(2 − x)).
        period * resistance / (2.0 * atanh(share / (2.0 - share)))
    };
    let [resistance, _, _, inductive] = short.values;
    let [deviation_of_resistance, _, _, deviation] = short.deviations;
    let value = of(resistance, inductive);
    let by_resistance = of(resistance + deviation_of_resistance, inductive) - value;
    let by_inductive = of(resistance, inductive + deviation) - value;
    let both = sqrt(by_resistance * by_resistance + by_inductive * by_inductive);
    Value::positive(value, both)
}
