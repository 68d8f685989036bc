//! The urban drive cycle ECE-15 (UN/ECE Regulation No. 83, Annex 4, Appendix 1, Table 1: "Operating cycle on the chassis
//! dynamometer, Part One"), scaled to a motor, with the load of a scaled vehicle.
//!
//! The shaft turns at 0.8 of the no-load speed at 50 km/h, and time runs ten times as fast. Load torques, over the motor's
//! continuous torque: rolling resistance 0.15 (fading in over the first km/h), air drag 0.25·(v/50 km/h)², and a grade of
//! 0.3 while the vehicle moves in the third of its three runs.

use super::motors::Machine;
use super::rig::BUS;
use crate::profile::Step;

/// The table's operations: duration (s) and speed at the end (km/h); the speed is a ramp in between. Gear changes are
/// pauses at constant speed.
const OPERATIONS: [(f64, f64); 25] = [
    (11.0, 0.0),
    (4.0, 15.0),
    (8.0, 15.0),
    (2.0, 10.0),
    (3.0, 0.0),
    (21.0, 0.0),
    (5.0, 15.0),
    (2.0, 15.0),
    (5.0, 32.0),
    (24.0, 32.0),
    (8.0, 10.0),
    (3.0, 0.0),
    (21.0, 0.0),
    (5.0, 15.0),
    (2.0, 15.0),
    (9.0, 35.0),
    (2.0, 35.0),
    (8.0, 50.0),
    (12.0, 50.0),
    (8.0, 35.0),
    (13.0, 35.0),
    (2.0, 35.0),
    (7.0, 10.0),
    (3.0, 0.0),
    (7.0, 0.0),
];

/// Duration of the cycle (s).
const DURATION: f64 = 195.0;

/// How much faster than the road's the bench's time is.
const HASTE: f64 = 10.0;

/// Start of the third run, on a grade (s).
const GRADE_FROM: f64 = 117.0;

/// Largest speed (km/h), the share of the no-load speed that it is to the motor, and loads over the continuous torque.
const TOP_SPEED: f64 = 50.0;
const TOP_SHARE: f64 = 0.8;
const ROLLING: f64 = 0.15;
const AIR: f64 = 0.25;
const GRADE: f64 = 0.3;

/// Distance of the points at which the cycle is given to the drive (s, the bench's time).
const INTERVAL: f64 = 0.01;

/// The vehicle's speed at a time (s) of the road's (km/h).
fn road_speed(time: f64) -> f64 {
    let (mut begun, mut before) = (0.0, 0.0);
    for (duration, end) in OPERATIONS {
        if time < begun + duration {
            return before + (end - before) * (time - begun) / duration;
        }
        (begun, before) = (begun + duration, end);
    }
    before
}

/// Commanded speeds (rad/s) and load torques (N·m) on the bench.
pub struct DriveCycle {
    /// Its duration (s).
    pub duration: f64,
    /// Commanded speeds: staircases of 10 ms, for a shaper to smooth.
    pub speeds: Vec<Step>,
    /// Load torques, of the same steps.
    pub loads: Vec<Step>,
}

impl DriveCycle {
    /// The cycle for a motor.
    pub fn ece_15(machine: &Machine) -> Self {
        let duration = DURATION / HASTE;
        let per_speed = TOP_SHARE * machine.no_load_speed(BUS) / TOP_SPEED;
        let points = (0..(duration / INTERVAL).round() as u32).map(|point| {
            let time = f64::from(point) * INTERVAL;
            let speed = road_speed(HASTE * time);
            let moving = speed.min(1.0);
            let grade = if HASTE * time >= GRADE_FROM { GRADE } else { 0.0 };
            let load = (ROLLING + grade) * moving + AIR * (speed / TOP_SPEED).powi(2);
            (time, per_speed * speed, machine.continuous_torque * load)
        });
        let (speeds, loads) = points
            .map(|(time, speed, load)| (Step { time, value: speed }, Step { time, value: load }))
            .unzip();
        Self { duration, speeds, loads }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// The Regulation sums its table up: 60 s idling, 36 s accelerating, 57 s steady, 8 s changing gear, 25 s + 9 s slowing
    /// down, and 1.013 km.
    #[test]
    fn the_cycle_is_the_regulations() {
        let [mut idle, mut faster, mut steady, mut slower, mut distance, mut before] = [0.0; 6];
        for (duration, end) in OPERATIONS {
            distance += 0.5 * (before + end) / 3.6 * duration;
            let phase = if end > before {
                &mut faster
            } else if end < before {
                &mut slower
            } else if end == 0.0 {
                &mut idle
            } else {
                &mut steady
            };
            *phase += duration;
            before = end;
        }
        assert_eq!([idle, faster, steady, slower], [60.0, 36.0, 57.0 + 8.0, 25.0 + 9.0]);
        assert_eq!(idle + faster + steady + slower, DURATION);
        assert!((distance / 1013.0 - 1.0).abs() < 0.01, "{distance} m");
    }

    #[test]
    fn speed_and_load_are_scaled_to_the_motor() {
        let cycle = DriveCycle::ece_15(&Machine::PAPER);
        assert_eq!(cycle.duration, 19.5);
        let most = |steps: &[Step]| steps.iter().map(|step| step.value).fold(0.0, f64::max);
        assert!((most(&cycle.speeds) - 0.8 * 24.0 / 59e-3).abs() < 1e-9);
        assert!((most(&cycle.loads) - 0.7 * 0.177).abs() < 1e-9);
        assert_eq!(cycle.loads[0].value, 0.0, "a standing vehicle");
    }
}
