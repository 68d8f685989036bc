//! Time responses for the report: signals of a case, thinned to what a plot can show.

use crate::frame::Frame;

/// A signal of a case over a span of time, as the report plots it.
#[derive(Debug)]
pub struct View {
    /// What is shown.
    pub title: &'static str,
    /// The signal, with its unit.
    pub y_label: &'static str,
    /// Start and end (s).
    pub span: [f64; 2],
    /// Reads the signal from a period.
    pub signal: fn(&Frame) -> f64,
    /// Whether the reference is shown beneath it.
    pub reference: bool,
}

impl View {
    /// Of `load steps`.
    pub const OF_LOAD_STEP: &'static [Self] = &[
        Self::of_error("load step: speed error", [0.595, 0.625]),
        Self {
            title: "load step: armature voltage",
            y_label: "u [V]",
            signal: |frame| frame.voltage,
            ..Self::of_error("", [0.595, 0.625])
        },
    ];

    /// Of `reversal`.
    pub const OF_REVERSAL: &'static [Self] = &[
        Self::of_speed("reversal: speed", [0.68, 0.9]),
        Self::of_error("reversal: speed error", [0.68, 0.9]),
    ];

    /// Of `ECE-15`.
    pub const OF_DRIVE_CYCLE: &'static [Self] = &[
        Self::of_speed("ECE-15: speed", [0.0, 19.5]),
        Self::of_error("ECE-15: speed error", [0.0, 19.5]),
        Self {
            signal: |frame| frame.z1.clamp(-0.2, 0.2),
            ..Self::of_error("ECE-15: speed error in the first run, cut off at ±0.2", [1.2, 2.75])
        },
        Self::of_error("ECE-15: speed error at standstill", [0.5, 0.6]),
    ];

    const fn of_error(title: &'static str, span: [f64; 2]) -> Self {
        Self {
            title, y_label: "ω − ω_d [rad/s]", span, signal: |frame| frame.z1, reference: false
        }
    }

    const fn of_speed(title: &'static str, span: [f64; 2]) -> Self {
        Self { title, y_label: "ω [rad/s]", span, signal: |frame| frame.speed, reference: true }
    }
}

/// A signal over a span, thinned: of each of as many slices as a plot resolves the least and the largest value.
#[derive(Clone, Debug)]
pub struct Trace {
    span: [f64; 2],
    slices: Vec<Option<[(f64, f64); 2]>>,
}

impl Trace {
    const SLICES: usize = 250;

    /// Nothing yet, for a span from start to end (s).
    pub fn new(span: [f64; 2]) -> Self {
        Self { span, slices: vec![None; Self::SLICES] }
    }

    /// Adds a value at a time (s); what lies outside the span does not count.
    pub fn add(&mut self, time: f64, value: f64) {
        let [start, end] = self.span;
        let place = (time - start) / (end - start) * Self::SLICES as f64;
        if place < 0.0 {
            return;
        }
        let Some(slice) = self.slices.get_mut(place as usize) else { return };
        let [least, largest] = slice.get_or_insert([(time, value); 2]);
        if value < least.1 {
            *least = (time, value);
        }
        if value > largest.1 {
            *largest = (time, value);
        }
    }

    /// What is left (time in s, value), in the order of time.
    pub fn points(&self) -> Vec<(f64, f64)> {
        let mut points: Vec<(f64, f64)> = self.slices.iter().flatten().flatten().copied().collect();
        points.sort_by(|a, b| a.0.total_cmp(&b.0));
        points.dedup();
        points
    }
}

/// What a run shows in one of its case's views.
#[derive(Clone, Debug)]
pub struct Response {
    /// The view.
    pub view: &'static View,
    /// Its signal.
    pub signal: Trace,
    /// The reference (rad/s).
    pub reference: Trace,
}

impl Response {
    /// Nothing yet.
    pub fn new(view: &'static View) -> Self {
        Self { view, signal: Trace::new(view.span), reference: Trace::new(view.span) }
    }

    /// Adds a period.
    pub fn add(&mut self, frame: &Frame) {
        self.signal.add(frame.time, (self.view.signal)(frame));
        self.reference.add(frame.time, frame.reference);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn thinning_keeps_every_peak_and_the_order() {
        let mut trace = Trace::new([1.0, 2.0]);
        for step in 0..40_000 {
            let time = f64::from(step) * 1e-4;
            let value = match step {
                15_005 => 7.0,
                15_006 => -7.0,
                5_000 | 30_000 => 100.0,
                _ => time,
            };
            trace.add(time, value);
        }
        let points = trace.points();
        assert!((400..=500).contains(&points.len()), "{}", points.len());
        assert!(points.is_sorted_by(|a, b| a.0 < b.0));
        let values = || points.iter().map(|point| point.1);
        assert_eq!(values().fold(f64::INFINITY, f64::min), -7.0);
        assert_eq!(values().fold(0.0, f64::max), 7.0, "and nothing from outside the span");
    }
}
