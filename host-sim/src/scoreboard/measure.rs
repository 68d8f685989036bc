//! What is measured in a run, from its periods.

use crate::frame::Frame;
use serde::Serialize;

/// Figures of a load step at constant speed.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
pub struct LoadStepFigures {
    /// Largest ω_d − ω after the step (rad/s).
    pub dip: f64,
    /// Time after the step from which on |ω − ω_d| stays within a tenth of the dip and three times `steady_error` (s).
    pub recovery: f64,
    /// RMS of u about its mean, before the step (V).
    pub ripple: f64,
    /// RMS of the change of u from one period to the next, before the step (V).
    pub voltage_step: f64,
    /// RMS of ω − ω_d before the step (rad/s).
    pub steady_error: f64,
    /// Largest |i| (A), before and after the step.
    pub peak_current: f64,
}

impl LoadStepFigures {
    /// The part of the ripple that is noise from period to period (V rms): half the mean square successive difference is its
    /// power, whatever is slower (von Neumann).
    pub fn noise(&self) -> f64 {
        self.voltage_step / 2.0_f64.sqrt()
    }

    /// The slower rest of the ripple (V rms).
    pub fn slow_ripple(&self) -> f64 {
        (self.ripple * self.ripple - self.noise() * self.noise()).max(0.0).sqrt()
    }
}

/// Measures a load step: what is steady in `steady_from..step_at`, the dip from `step_at` on (s).
#[derive(Clone, Debug)]
pub struct LoadStepMeter {
    steady_from: f64,
    step_at: f64,
    voltages: Vec<f64>,
    steady_square: f64,
    after: Vec<(f64, f64)>,
    peak_current: f64,
}

impl LoadStepMeter {
    /// For steady periods from `steady_from` on and a load step at `step_at` (s).
    pub fn new(steady_from: f64, step_at: f64) -> Self {
        let (voltages, after) = (Vec::new(), Vec::new());
        Self { steady_from, step_at, voltages, steady_square: 0.0, after, peak_current: 0.0 }
    }

    /// Counts a period.
    pub fn add(&mut self, frame: &Frame) {
        if frame.time < self.steady_from {
            return;
        }
        self.peak_current = self.peak_current.max(frame.current.abs());
        if frame.time < self.step_at {
            self.voltages.push(frame.voltage);
            self.steady_square += frame.z1 * frame.z1;
        } else {
            self.after.push((frame.time, frame.z1));
        }
    }

    /// The figures, if there were periods on both sides of the step.
    pub fn figures(&self) -> Option<LoadStepFigures> {
        let count = self.voltages.len() as f64;
        if count < 2.0 || self.after.is_empty() {
            return None;
        }
        let mean = self.voltages.iter().sum::<f64>() / count;
        let about_mean: f64 = self.voltages.iter().map(|u| (u - mean) * (u - mean)).sum();
        let steps = self.voltages.windows(2).map(|pair| pair[1] - pair[0]);
        let step_square: f64 = steps.map(|step| step * step).sum();
        let steady_error = (self.steady_square / count).sqrt();
        let dip = self.after.iter().map(|(_, z1)| -z1).fold(0.0, f64::max);
        let band = 0.1 * dip + 3.0 * steady_error;
        let last_outside = self.after.iter().rev().find(|(_, z1)| z1.abs() > band);
        Some(LoadStepFigures {
            dip,
            recovery: last_outside.map_or(0.0, |(time, _)| time - self.step_at),
            ripple: (about_mean / count).sqrt(),
            voltage_step: (step_square / (count - 1.0)).sqrt(),
            steady_error,
            peak_current: self.peak_current,
        })
    }
}

/// The means over several speeds.
///
/// Ripple depends on the speed through the encoder's counts and is of different orders at different speeds: its mean, and
/// that of the voltage step, is geometric. The steady error's is quadratic, dip's and recovery's arithmetic; of the peak
/// current it is the largest.
pub fn over_speeds(figures: &[LoadStepFigures]) -> LoadStepFigures {
    let count = figures.len() as f64;
    let mean =
        |read: &dyn Fn(&LoadStepFigures) -> f64| figures.iter().map(read).sum::<f64>() / count;
    LoadStepFigures {
        dip: mean(&|at| at.dip),
        recovery: mean(&|at| at.recovery),
        ripple: mean(&|at| at.ripple.ln()).exp(),
        voltage_step: mean(&|at| at.voltage_step.ln()).exp(),
        steady_error: mean(&|at| at.steady_error * at.steady_error).sqrt(),
        peak_current: figures.iter().map(|at| at.peak_current).fold(0.0, f64::max),
    }
}

/// The ripple of a run that is not steady: the RMS of the change of u from one period to the next in each window of
/// 10 ms, and of these the median (V). Jumps and starts, which are few, do not count.
#[derive(Clone, Debug, Default)]
pub struct WindowedSteps {
    last: Option<f64>,
    window: u64,
    square: f64,
    count: u32,
    windows: Vec<f64>,
}

impl WindowedSteps {
    /// Windows a second.
    const RATE: f64 = 100.0;

    /// Counts a period.
    pub fn add(&mut self, frame: &Frame) {
        let window = (frame.time * Self::RATE + 1e-6) as u64;
        if window != self.window {
            self.close();
            self.window = window;
        }
        if let Some(last) = self.last.replace(frame.voltage) {
            self.square += (frame.voltage - last) * (frame.voltage - last);
            self.count += 1;
        }
    }

    fn close(&mut self) {
        if self.count > 0 {
            self.windows.push((self.square / f64::from(self.count)).sqrt());
        }
        (self.square, self.count) = (0.0, 0);
    }

    /// The median so far; nothing without periods.
    pub fn median(mut self) -> Option<f64> {
        self.close();
        median(&mut self.windows)
    }
}

/// The median; of an even number of values the upper one. Nothing of none.
pub fn median(values: &mut [f64]) -> Option<f64> {
    values.sort_by(f64::total_cmp);
    values.get(values.len() / 2).copied()
}

/// Overshoot over jumps of the commanded speed, as a share of the jump.
#[derive(Clone, Debug, Default)]
pub struct Overshoot {
    command: f64,
    jump: f64,
    jumped_at: f64,
    largest: Option<f64>,
}

impl Overshoot {
    /// Time after a jump that counts (s): later ones are the load's doing.
    const WINDOW: f64 = 0.25;

    /// Counts a period, with the commanded speed (rad/s). Commands that change by less than `least` are no jumps.
    pub fn add(&mut self, frame: &Frame, command: f64, least: f64) {
        let change = command - self.command;
        self.command = command;
        if change != 0.0 {
            self.jump = if change.abs() >= least { change } else { 0.0 };
            self.jumped_at = frame.time;
        }
        if self.jump != 0.0 && frame.time - self.jumped_at <= Self::WINDOW {
            let beyond = (frame.speed - command) / self.jump;
            self.largest = Some(self.largest.unwrap_or(0.0).max(beyond));
        }
    }

    /// The largest so far; nothing where nothing jumped.
    pub fn largest(&self) -> Option<f64> {
        self.largest
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_load_step_worked_by_hand() {
        let mut meter = LoadStepMeter::new(1.0, 1.4);
        // Steady: u = 1, 3, 3, 1 with z1 = ±0.01; ahead of it what must not count.
        let steady = [
            (0.9, 9.0, 9.0),
            (1.0, 1.0, 0.01),
            (1.1, 3.0, -0.01),
            (1.2, 3.0, 0.01),
            (1.3, 1.0, -0.01),
        ];
        // A dip to −2, and back: outside ±(0.2 + 0.03) last at 1.7.
        let after = [
            (1.4, 1.0, -0.5),
            (1.5, 4.0, -2.0),
            (1.6, 4.0, 0.1),
            (1.7, 3.0, 0.24),
            (1.8, 3.0, 0.22),
        ];
        for (time, voltage, z1) in steady.into_iter().chain(after) {
            meter.add(&Frame { time, voltage, z1, current: -voltage, ..Frame::default() });
        }
        let figures = meter.figures().expect("measured");
        let near = |value: f64, expected: f64| {
            assert!((value - expected).abs() < 1e-12, "{value} is not {expected}: {figures:?}");
        };
        near(figures.dip, 2.0);
        near(figures.recovery, 0.3);
        near(figures.ripple, 1.0);
        near(figures.voltage_step, (8.0_f64 / 3.0).sqrt());
        near(figures.noise(), (4.0_f64 / 3.0).sqrt());
        near(figures.slow_ripple(), 0.0);
        near(figures.steady_error, 0.01);
        near(figures.peak_current, 4.0);
    }

    #[test]
    fn noise_and_slow_ripple_are_told_apart() {
        let mut meter = LoadStepMeter::new(0.0, 1.0);
        // ±0.5 V from period to period in a pattern without memory, on a slow sine of 2 V.
        let mut bits: u32 = 1;
        for period in 0..20_000 {
            bits = bits.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
            let noise = if bits >> 31 == 0 { 0.5 } else { -0.5 };
            let time = f64::from(period) * 5e-5;
            let voltage = noise + 2.0 * (20.0 * time).sin();
            meter.add(&Frame { time, voltage, ..Frame::default() });
        }
        meter.add(&Frame { time: 1.0, ..Frame::default() });
        let figures = meter.figures().expect("measured");
        assert!((figures.noise() / 0.5 - 1.0).abs() < 0.02, "{figures:?}");
        assert!((figures.slow_ripple() / 2.0_f64.sqrt() - 1.0).abs() < 0.05, "{figures:?}");
    }

    #[test]
    fn without_periods_on_both_sides_there_are_no_figures() {
        let mut meter = LoadStepMeter::new(0.0, 1.0);
        assert!(meter.figures().is_none());
        for time in [0.0, 0.5] {
            meter.add(&Frame { time, ..Frame::default() });
        }
        assert!(meter.figures().is_none());
        meter.add(&Frame { time: 1.0, ..Frame::default() });
        assert!(meter.figures().is_some());
    }

    #[test]
    fn means_over_speeds_are_of_their_kinds() {
        let at = |value: f64| LoadStepFigures {
            dip: value,
            recovery: value,
            ripple: value,
            voltage_step: value,
            steady_error: value,
            peak_current: value,
        };
        let means = over_speeds(&[at(1.0), at(4.0)]);
        let expected = [2.5, 2.5, 2.0, 2.0, 8.5_f64.sqrt(), 4.0];
        let LoadStepFigures { dip, recovery, ripple, voltage_step, steady_error, peak_current } =
            means;
        for (value, expected) in [dip, recovery, ripple, voltage_step, steady_error, peak_current]
            .into_iter()
            .zip(expected)
        {
            assert!((value - expected).abs() < 1e-12, "{means:?}");
        }
    }

    #[test]
    fn the_median_window_does_not_see_a_jump() {
        let mut steps = WindowedSteps::default();
        for period in 0..1000 {
            // ±0.5 V from period to period, and one jump of 100 V.
            let jump = if period > 500 { 100.0 } else { 0.0 };
            let voltage = jump + 0.5 * f64::from(period % 2);
            steps.add(&Frame { time: f64::from(period) * 1e-3, voltage, ..Frame::default() });
        }
        assert!((steps.median().expect("measured") - 0.5).abs() < 1e-12);
        assert_eq!(WindowedSteps::default().median(), None);
    }

    #[test]
    fn overshoot_is_beyond_the_jumps_end_in_its_direction_and_in_time() {
        let mut overshoot = Overshoot::default();
        assert_eq!(overshoot.largest(), None);
        let mut add = |time, speed, command| {
            overshoot.add(&Frame { time, speed, ..Frame::default() }, command, 1.0);
            overshoot.largest()
        };
        assert_eq!(add(0.0, 5.0, 0.5), None, "too small a jump");
        assert_eq!(add(1.0, 0.0, 10.5), Some(0.0));
        assert_eq!(add(1.1, 11.5, 10.5), Some(0.1));
        assert_eq!(add(1.3, 20.0, 10.5), Some(0.1), "too late");
        assert_eq!(add(2.0, 10.5, -9.5), Some(0.1));
        assert_eq!(add(2.1, -15.5, -9.5), Some(0.3));
    }
}
