//! Quantities that change over time, as scenarios state them.

use serde::Deserialize;
use std::f64::consts::TAU;

/// A value that holds from a time on.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Start of the value [s].
    pub time: f64,
    /// The value, in the unit of its quantity.
    pub value: f64,
}

/// The value that holds at `time`; `before` ahead of the first step. Steps are in order of time.
pub fn value_at(steps: &[Step], before: f64, time: f64) -> f64 {
    (steps.iter().rev().find(|step| step.time <= time)).map_or(before, |step| step.value)
}

/// A sinusoid, amplitude·sin(2π·frequency·t + phase).
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Sine {
    /// Amplitude, in the unit of its quantity.
    pub amplitude: f64,
    /// Frequency [Hz].
    pub frequency: f64,
    /// Phase at t = 0 [rad].
    #[serde(default)]
    pub phase: f64,
}

/// A load torque [N·m], positive when it opposes positive motion: steps plus sinusoids.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Load {
    /// Torque ahead of the first step [N·m].
    #[serde(default)]
    pub constant: f64,
    /// Torques that replace it from their times on.
    #[serde(default)]
    pub steps: Vec<Step>,
    /// Sinusoids that are added.
    #[serde(default)]
    pub sines: Vec<Sine>,
}

impl Load {
    /// The torque at a time [N·m].
    pub fn at(&self, time: f64) -> f64 {
        self.steps_at(time) + self.sines_at(time)
    }

    /// The part that is constant between jumps [N·m].
    pub fn steps_at(&self, time: f64) -> f64 {
        value_at(&self.steps, self.constant, time)
    }

    /// The part that is smooth [N·m].
    pub fn sines_at(&self, time: f64) -> f64 {
        let waves = self.sines.iter().map(|sine| {
            let pulsation = TAU * sine.frequency;
            sine.amplitude * (pulsation * time + sine.phase).sin()
        });
        waves.sum()
    }

    /// The smooth part's rate of change [N·m/s].
    pub fn rate_at(&self, time: f64) -> f64 {
        let waves = self.sines.iter().map(|sine| {
            let pulsation = TAU * sine.frequency;
            sine.amplitude * pulsation * (pulsation * time + sine.phase).cos()
        });
        waves.sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_hold_from_their_time_on() {
        let steps = [Step { time: 1.0, value: 5.0 }, Step { time: 2.0, value: 7.0 }];
        let at = |time| value_at(&steps, -1.0, time);
        assert_eq!([at(0.0), at(0.999), at(1.0), at(1.5), at(2.0), at(9.0)], [-1.0, -1.0, 5.0, 5.0, 7.0, 7.0]);
    }

    #[test]
    fn load_is_steps_plus_sines_and_its_rate_is_its_derivative() {
        let load = Load {
            constant: 0.05,
            steps: vec![Step { time: 3.0, value: 0.1 }],
            sines: vec![
                Sine { amplitude: 0.03, frequency: 0.3, phase: 0.0 },
                Sine { amplitude: 0.02, frequency: 1.0, phase: 1.0 },
            ],
        };
        let expected = 0.05 + 0.03 * (0.6 * std::f64::consts::PI * 0.7).sin() + 0.02 * (TAU * 0.7 + 1.0).sin();
        assert!((load.at(0.7) - expected).abs() < 1e-15);
        assert!((load.at(3.0) - load.at(3.0 - 1e-9) - 0.05).abs() < 1e-8);
        let slope = (load.at(0.7 + 1e-6) - load.at(0.7 - 1e-6)) / 2e-6;
        assert!((load.rate_at(0.7) - slope).abs() < 1e-8);
    }
}
