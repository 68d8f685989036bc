//! Figures of merit of a run, in SI units.

use crate::frame::Frame;
use serde::Serialize;

/// Time after each jump of the commanded speed, the start included, that does not count as steady (s).
pub const SETTLING_TIME: f64 = 1.5;

/// Figures of a whole run, and of its steady parts.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Metrics {
    /// Over all periods.
    #[serde(flatten)]
    pub whole: Figures,
    /// Without the 1.5 s after each jump of the commanded speed, the start included.
    pub steady: Figures,
}

/// RMS values and peaks over the periods that counted; null where none did.
#[derive(Clone, Debug, Default, Serialize, PartialEq)]
pub struct Figures {
    /// Periods that counted.
    pub periods: u64,
    /// RMS of z1 = ω − ω_d (rad/s).
    pub rms_z1: Option<f64>,
    /// RMS of z2 = a2·i − x2* (rad/s²).
    pub rms_z2: Option<f64>,
    /// RMS of the commanded armature voltage u (V).
    pub rms_voltage: Option<f64>,
    /// RMS of the change of u from one period to the next (V).
    pub rms_voltage_step: Option<f64>,
    /// RMS of T_l − T̂_l (N·m); in plain backstepping, which estimates none, T̂_l is zero.
    pub rms_load_torque_error: Option<f64>,
    /// Largest |z1| (rad/s).
    pub peak_z1: Option<f64>,
    /// Largest |ω| (rad/s).
    pub peak_speed: Option<f64>,
    /// Largest |i| at a sampling instant (A).
    pub peak_current: Option<f64>,
    /// Largest |u| (V).
    pub peak_voltage: Option<f64>,
    /// Largest |T_l − T̂_l| (N·m).
    pub peak_load_torque_error: Option<f64>,
    /// The first u (V).
    pub first_voltage: Option<f64>,
}

/// Gathers the figures of a run.
#[derive(Clone, Debug, Default)]
pub struct Meter {
    whole: Sums,
    steady: Sums,
    last_voltage: Option<f64>,
}

#[derive(Clone, Debug, Default)]
struct Sums {
    periods: u64,
    voltage_steps: u64,
    z1: f64,
    z2: f64,
    voltage: f64,
    voltage_step: f64,
    load_torque_error: f64,
    peak_z1: f64,
    peak_speed: f64,
    peak_current: f64,
    peak_voltage: f64,
    peak_load_torque_error: f64,
    first_voltage: Option<f64>,
}

impl Meter {
    /// Counts a period; `since_jump` is the time since the last jump of the command (s).
    #[inline]
    pub fn add(&mut self, frame: &Frame, since_jump: f64) {
        let step = self.last_voltage.map(|last| frame.voltage - last);
        self.whole.add(frame, step);
        // Slack for the rounding of times.
        if since_jump >= SETTLING_TIME - 1e-9 {
            self.steady.add(frame, step);
        }
        self.last_voltage = Some(frame.voltage);
    }

    /// The figures so far.
    pub fn metrics(&self) -> Metrics {
        Metrics { whole: self.whole.figures(), steady: self.steady.figures() }
    }
}

impl Sums {
    fn add(&mut self, frame: &Frame, voltage_step: Option<f64>) {
        let square = |x: f64| x * x;
        let load_torque_error = frame.load_torque - frame.load_torque_estimate;
        self.periods += 1;
        self.z1 += square(frame.z1);
        self.z2 += square(frame.z2);
        self.voltage += square(frame.voltage);
        self.load_torque_error += square(load_torque_error);
        if let Some(step) = voltage_step {
            self.voltage_steps += 1;
            self.voltage_step += square(step);
        }
        self.peak_z1 = self.peak_z1.max(frame.z1.abs());
        self.peak_speed = self.peak_speed.max(frame.speed.abs());
        self.peak_current = self.peak_current.max(frame.current.abs());
        self.peak_voltage = self.peak_voltage.max(frame.voltage.abs());
        self.peak_load_torque_error = self.peak_load_torque_error.max(load_torque_error.abs());
        self.first_voltage.get_or_insert(frame.voltage);
    }

    fn figures(&self) -> Figures {
        let some = |value: f64| (self.periods > 0).then_some(value);
        let rms = |sum: f64, count: u64| (count > 0).then(|| (sum / count as f64).sqrt());
        Figures {
            periods: self.periods,
            rms_z1: rms(self.z1, self.periods),
            rms_z2: rms(self.z2, self.periods),
            rms_voltage: rms(self.voltage, self.periods),
            rms_voltage_step: rms(self.voltage_step, self.voltage_steps),
            rms_load_torque_error: rms(self.load_torque_error, self.periods),
            peak_z1: some(self.peak_z1),
            peak_speed: some(self.peak_speed),
            peak_current: some(self.peak_current),
            peak_voltage: some(self.peak_voltage),
            peak_load_torque_error: some(self.peak_load_torque_error),
            first_voltage: self.first_voltage,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn frame(voltage: f64) -> Frame {
        Frame {
            voltage,
            z1: -2.0,
            speed: -3.0,
            current: 4.0,
            load_torque: 0.5,
            load_torque_estimate: 0.2,
            ..Frame::default()
        }
    }

    #[test]
    fn figures_of_a_run_worked_by_hand() {
        let mut meter = Meter::default();
        for (voltage, since_jump) in [(1.0, 0.0), (-3.0, 1.0), (-3.5, 1.5), (-3.5, 2.0)] {
            meter.add(&frame(voltage), since_jump);
        }
        let Metrics { whole, steady } = meter.metrics();
        let near = |value: Option<f64>, expected: f64| {
            assert!(
                (value.expect("counted") - expected).abs() < 1e-12,
                "{value:?} is not {expected}"
            );
        };
        assert_eq!((whole.periods, steady.periods), (4, 2));
        near(whole.rms_z1, 2.0);
        near(whole.rms_voltage, ((1.0 + 9.0 + 2.0 * 12.25) / 4.0_f64).sqrt());
        near(whole.rms_voltage_step, ((16.0 + 0.25) / 3.0_f64).sqrt());
        near(whole.rms_load_torque_error, 0.3);
        near(whole.first_voltage, 1.0);
        near(whole.peak_voltage, 3.5);
        near(whole.peak_speed, 3.0);
        near(whole.peak_current, 4.0);
        near(steady.rms_voltage_step, (0.25 / 2.0_f64).sqrt());
        near(steady.first_voltage, -3.5);
    }

    #[test]
    fn nothing_counted_is_null_not_zero() {
        let figures = Meter::default().metrics().steady;
        assert_eq!(figures, Figures::default());
        assert_eq!(figures.rms_z1, None);
    }
}
