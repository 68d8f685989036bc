//! Quantities that change over time, as scenarios state them.

use serde::Deserialize;
use std::f64::consts::TAU;

/// A value that holds from a time on.
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Step {
    /// Start of the value (s).
    pub time: f64,
    /// The value, in the unit of its quantity.
    pub value: f64,
}

/// The value that holds at `time`; `before` ahead of the first step. Steps are in order of time.
pub fn value_at(steps: &[Step], before: f64, time: f64) -> f64 {
    let begun = steps.partition_point(|step| step.time <= time);
    steps[..begun].last().map_or(before, |step| step.value)
}

/// A sinusoid, amplitude·sin(2π·frequency·t + phase).
#[derive(Clone, Copy, Debug, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Sine {
    /// Amplitude, in the unit of its quantity.
    pub amplitude: f64,
    /// Frequency (Hz).
    pub frequency: f64,
    /// Phase at t = 0 (rad).
    #[serde(default)]
    pub phase: f64,
}

impl Sine {
    fn angle(&self, time: f64) -> f64 {
        TAU * self.frequency * time + self.phase
    }
}

/// A load torque (N·m), positive when it opposes positive motion: steps plus sinusoids.
#[derive(Clone, Debug, Default, Deserialize, PartialEq)]
#[serde(deny_unknown_fields)]
pub struct Load {
    /// Torque ahead of the first step (N·m).
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
    /// The torque at a time (N·m).
    pub fn at(&self, time: f64) -> f64 {
        let waves = self.sines.iter().map(|sine| sine.amplitude * sine.angle(time).sin());
        self.steps_at(time) + waves.sum::<f64>()
    }

    /// The torque's rate of change between its steps (N·m/s).
    pub fn rate_at(&self, time: f64) -> f64 {
        let rates = self
            .sines
            .iter()
            .map(|sine| sine.amplitude * TAU * sine.frequency * sine.angle(time).cos());
        rates.sum()
    }

    /// The part that is constant between jumps (N·m).
    pub fn steps_at(&self, time: f64) -> f64 {
        value_at(&self.steps, self.constant, time)
    }

    /// The sinusoids, ready to be walked through in steps of `interval` seconds.
    pub fn waves(&self, interval: f64) -> Waves {
        let waves = self.sines.iter().map(|&sine| {
            let (turn_sin, turn_cos) = (TAU * sine.frequency * interval).sin_cos();
            let (sin, cos) = sine.phase.sin_cos();
            Wave { sine, turn_sin, turn_cos, sin, cos }
        });
        Waves { interval, steps: 0, waves: waves.collect() }
    }
}

/// The sum of a load's sinusoids at equal intervals of time: each is turned on by an angle, which costs a tenth of a
/// sine, and set right again every so often.
#[derive(Clone, Debug)]
pub struct Waves {
    interval: f64,
    steps: u64,
    waves: Vec<Wave>,
}

#[derive(Clone, Debug)]
struct Wave {
    sine: Sine,
    turn_sin: f64,
    turn_cos: f64,
    sin: f64,
    cos: f64,
}

impl Waves {
    /// Steps after which each wave is computed anew: rounding adds up to 1e-13 of the amplitude by then.
    const RENEWAL: u64 = 1024;

    /// The sum now.
    #[inline]
    pub fn sum(&self) -> f64 {
        self.waves.iter().map(|wave| wave.sine.amplitude * wave.sin).sum()
    }

    /// Goes on by one interval and gives the sum there.
    #[inline]
    pub fn advance(&mut self) -> f64 {
        self.steps += 1;
        let renew = self.steps.is_multiple_of(Self::RENEWAL);
        for wave in &mut self.waves {
            (wave.sin, wave.cos) = if renew {
                wave.sine.angle(self.steps as f64 * self.interval).sin_cos()
            } else {
                (
                    wave.sin * wave.turn_cos + wave.cos * wave.turn_sin,
                    wave.cos * wave.turn_cos - wave.sin * wave.turn_sin,
                )
            };
        }
        self.sum()
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn steps_hold_from_their_time_on() {
        let steps = [Step { time: 1.0, value: 5.0 }, Step { time: 2.0, value: 7.0 }];
        let at = |time| value_at(&steps, -1.0, time);
        assert_eq!(
            [at(0.0), at(0.999), at(1.0), at(1.5), at(2.0), at(9.0)],
            [-1.0, -1.0, 5.0, 5.0, 7.0, 7.0]
        );
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
        let expected =
            0.05 + 0.03 * (0.6 * std::f64::consts::PI * 0.7).sin() + 0.02 * (TAU * 0.7 + 1.0).sin();
        assert!((load.at(0.7) - expected).abs() < 1e-15);
        assert!((load.at(3.0) - load.at(3.0 - 1e-9) - 0.05).abs() < 1e-8);
        let slope = (load.at(0.7 + 1e-6) - load.at(0.7 - 1e-6)) / 2e-6;
        assert!((load.rate_at(0.7) - slope).abs() < 1e-8);
    }

    #[test]
    fn waves_are_the_sinusoids_at_equal_intervals() {
        let sines = vec![
            Sine { amplitude: 0.03, frequency: 0.3, phase: 0.5 },
            Sine { amplitude: 0.02, frequency: 50.0, phase: 0.0 },
        ];
        let load = Load { sines, ..Load::default() };
        let mut waves = load.waves(2.5e-5);
        assert_eq!(waves.sum(), load.at(0.0));
        for step in 1..=10_000 {
            let error = waves.advance() - load.at(f64::from(step) * 2.5e-5);
            assert!(error.abs() < 1e-14, "step {step} errs by {error:e}");
        }
    }
}
