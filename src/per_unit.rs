//! The bases of fixed point: what full scale is for each kind of signal.
//!
//! They follow from the motor's limits, the clock and the encoder alone, not from the controller, so that a controller can be
//! changed in the middle of a run.
//!
//! **Headroom.** A measured speed or current is within its limit, or the sample is a fault before anything is computed from it; an
//! estimated speed ends in a fault in the period in which it leaves the limit, and cannot have moved further than the encoder,
//! which is within twice the limit. A sixteenth of full scale for the limit of the speed leaves the difference of two
//! speeds, which jump from one end to the other, below a quarter. Currents have 32 times their limit, since what the
//! voltage observer remembers is a current too. The base of accelerations takes 2.5 times that current's, that of voltages four
//! times what full scales of speed and current take together, and sixteen times the highest bus.
//!
//! **Time.** Full scale of the speed is a power of two in counts per period, and each derivative's is [a power of
//! two](ACCELERATION) times the sampling rate of the one before: what the clock and the encoder multiply by is a power of two,
//! without rounding. (A gain that is 2⁻¹⁶ wrong there would be a steady error of the speed.)

use crate::config::{ConfigError, positive};
use crate::drive::DriveConfig;
use crate::math::{Base, log2_ceil, power_of_two};
use crate::motor::Coefficients;
use crate::sense::Sensors;

/// In a sampling period an acceleration makes 2^−`ACCELERATION` of its share of full scale as a speed.
pub const ACCELERATION: u32 = 6;

/// And the rate of an acceleration 2^−`JERK` as an acceleration.
pub const JERK: u32 = 3;

/// The base of each kind of signal.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Bases {
    /// Speeds (rad/s).
    pub speed: Base,
    /// Accelerations (rad/s²).
    pub acceleration: Base,
    /// Their rates (rad/s³).
    pub jerk: Base,
    /// What the shaft turns, in counts of the encoder, or in rad from exact sensors.
    pub angle: Base,
    /// Currents (A).
    pub current: Base,
    /// Voltages (V).
    pub voltage: Base,
    /// Torques (N·m).
    pub torque: Base,
}

impl Bases {
    /// Those of a drive. Refuses a configuration that the drive refuses for the same field.
    pub fn new(config: &DriveConfig) -> Result<Self, ConfigError> {
        let DriveConfig { motor, sensors, timing, limits, .. } = config;
        timing.check()?;
        limits.check()?;
        let Coefficients { a2, a3, a4, inductance, inertia, .. } = motor.coefficients()?;
        let rate = timing.rate;
        // In rad.
        let unit = sensors.shaft(timing.period()).unit.abs();
        positive("sensors.counts_per_turn", unit)?;
        let current = 32.0 * limits.current;
        let [per_acceleration, per_jerk] = [ACCELERATION, JERK].map(|by| rate / (1 << by) as f32);
        // A coarse encoder's count between two reads is a high speed.
        let count = match sensors {
            Sensors::Exact => 0.0,
            Sensors::Codes(_) => 64.0 * unit * rate,
        };
        let needed = (16.0 * limits.speed).max(2.5 * a2 * current / per_acceleration).max(count);
        let speed = unit * rate * above(needed / (unit * rate));
        let acceleration = per_acceleration * speed;
        let jerk = per_jerk * acceleration;
        // Full scale of what holds a speed and a current, at once and four times.
        let largest = inductance * (a3 * speed + a4 * current);
        let headroom = above((4.0 * largest / limits.bus_max).max(16.0));
        Ok(Self {
            speed: Base(speed),
            acceleration: Base(acceleration),
            jerk: Base(jerk),
            angle: match sensors {
                Sensors::Exact => Base(4.0 * speed / rate),
                Sensors::Codes(_) => Base::COUNT,
            },
            current: Base(current),
            voltage: Base(headroom * limits.bus_max),
            torque: Base(4.0 * inertia * acceleration),
        })
    }
}

/// The power of two not below.
fn above(x: f32) -> f32 {
    power_of_two(log2_ceil(x))
}

impl Bases {
    /// For floating point, which has none.
    pub(crate) const NONE: Self = Self {
        speed: Base(1.0),
        acceleration: Base(1.0),
        jerk: Base(1.0),
        angle: Base(1.0),
        current: Base(1.0),
        voltage: Base(1.0),
        torque: Base(1.0),
    };
}
