//! The runs that reproduce the paper: near-continuous as in its simulation, at 20 kHz as a drive runs it, and what they
//! are held against: explicit Euler, the ultimate bounds, and each other.

use crate::double::{Double, SimulatedScalar};
use crate::frame::Frame;
use crate::link::LinkError;
use crate::metrics::Metrics;
use crate::profile::Load;
use crate::scenario::{Controller, FormName, Scenario, ShapeName, StartName};
use crate::simulation::simulate;
use indicatif::ProgressBar;
use quasidrive::control::bounds;
use quasidrive::control::injection::SLOPE_ERROR;
use rayon::prelude::*;
use std::ops::Range;

/// Rate of the near-continuous runs (Hz).
pub const NEAR_CONTINUOUS_RATE: f64 = 1e6;

/// Time after a jump of the command from which the ultimate bounds are held against a run (s): some 30 ms to reach the
/// sliding surface, and 30 time constants 1/c of the errors from there.
pub const SETTLED: f64 = 0.2;

/// Periods between two moves of a progress bar: asking the clock for every one would cost as much as playing it.
pub const PERIODS_PER_TICK: u64 = 1024;

/// Points that a window of a run is drawn with.
const POINTS: usize = 1000;

/// A span of time that is drawn.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Window {
    /// The whole cycle.
    Cycle,
    /// The start.
    Start,
    /// The jump of the reference at 3 s.
    Jump,
    /// A steady part.
    Steady,
    /// Forty periods of 20 kHz in a steady part.
    Periods,
}

impl Window {
    const ALL: [Self; 5] = [Self::Cycle, Self::Start, Self::Jump, Self::Steady, Self::Periods];

    /// Its times (s).
    pub fn span(self) -> Range<f64> {
        match self {
            Self::Cycle => 0.0..10.0,
            Self::Start => 0.0..0.06,
            Self::Jump => 2.99..3.08,
            Self::Steady => 5.0..7.0,
            Self::Periods => 5.0..5.002,
        }
    }

    /// Periods between two that are drawn, at a sampling rate (Hz). Odd, so as not to fall into step with a limit cycle.
    fn stride(self, rate: f64) -> u64 {
        let span = self.span();
        ((span.end - span.start) * rate / POINTS as f64).ceil().max(1.0) as u64 | 1
    }
}

/// A played run of the paper's cycle.
#[derive(Clone, Debug)]
pub struct Run {
    /// The law.
    pub controller: Controller,
    /// Its figures.
    pub metrics: Metrics,
    /// Overshoot over the first commanded speed, before the second (% of it).
    pub overshoot: f64,
    /// Largest |d̃| outside the 0.2 s after each jump of the reference (rad/s²).
    pub peak_disturbance_error: f64,
    /// Largest ‖(z1, z2)‖ outside the same.
    pub peak_error_norm: f64,
    windows: Vec<Vec<Frame>>,
}

impl Run {
    /// The periods to draw in a window.
    pub fn frames(&self, window: Window) -> &[Frame] {
        let index = Window::ALL.iter().position(|&other| other == window);
        index.and_then(|index| self.windows.get(index)).map_or(&[], Vec::as_slice)
    }
}

/// Ultimate bounds beside what a run reached.
#[derive(Clone, Copy, Debug)]
pub struct Bounds {
    /// The paper's bound on |d̃| (rad/s²) (Eqs. 32, 56).
    pub paper: f64,
    /// The corrected one, pointwise in time, with what sampling adds.
    pub corrected: f64,
    /// The corrected one from the suprema of |d| and |ḋ| alone, with what sampling adds.
    pub from_suprema: f64,
    /// The largest |d̃| of the run.
    pub reached: f64,
    /// The paper's bound on ‖(z1, z2)‖ (Eqs. 36, 61).
    pub paper_norm: f64,
    /// The corrected one.
    pub corrected_norm: f64,
    /// The largest ‖(z1, z2)‖ of the run.
    pub reached_norm: f64,
}

/// How far BS-QSMDO and BS-QISMC are apart with equal starts and a smooth reference.
#[derive(Clone, Copy, Debug)]
pub struct Coincidence {
    /// Largest difference of the two voltages (V), in double precision.
    pub voltage: f64,
    /// Largest difference of the two speeds (rad/s), in double precision.
    pub speed: f64,
    /// Largest voltage of either (V).
    pub largest_voltage: f64,
}

/// Everything that the report shows.
#[derive(Clone, Debug)]
pub struct Reproduction {
    /// The scenario that all runs vary.
    pub scenario: Scenario,
    /// The paper's setting: a small step, no delay, double precision. BS, BS-QSMDO, BS-QISMC.
    pub near_continuous: Vec<Run>,
    /// The drive's setting: 20 kHz, one period of delay, f32. BS, BS-QSMDO, BS-QISMC.
    pub drive: Vec<Run>,
    /// BS-QSMDO in the drive's setting, stepped explicitly.
    pub explicit: Run,
    /// Bounds of the near-continuous BS-QSMDO.
    pub near_continuous_bounds: Bounds,
    /// Bounds of BS-QSMDO in the drive's setting, run in double precision.
    pub drive_bounds: Bounds,
    /// The two controllers as one algorithm.
    pub coincidence: Coincidence,
}

/// Plays everything, two or more runs at a time. `progress` makes a bar for a number of periods.
pub fn run(progress: &dyn Fn(u64) -> ProgressBar) -> Result<Reproduction, LinkError> {
    let scenario = Scenario::paper();
    let vary = |controller, form, near_continuous| {
        let mut scenario = scenario.clone();
        scenario.control.controller = controller;
        scenario.control.form = form;
        if near_continuous {
            scenario.timing.rate = NEAR_CONTINUOUS_RATE;
            scenario.timing.delay = false;
        }
        scenario
    };
    let (implicit, explicit) = (FormName::Implicit, FormName::Explicit);
    let doubles = Controller::PAPER.map(|controller| vary(controller, implicit, true)).into_iter();
    let doubles: Vec<Scenario> =
        doubles.chain([vary(Controller::BsQsmdo, implicit, false)]).collect();
    let singles = Controller::PAPER.map(|controller| vary(controller, implicit, false)).into_iter();
    let singles: Vec<Scenario> =
        singles.chain([vary(Controller::BsQsmdo, explicit, false)]).collect();

    let bar = progress(doubles.iter().chain(&singles).map(Scenario::periods).sum());
    let mut near_continuous: Vec<Run> = doubles
        .par_iter()
        .map(|scenario| play::<Double>(scenario, &bar))
        .collect::<Result<_, _>>()?;
    let mut drive: Vec<Run> =
        singles.par_iter().map(|scenario| play::<f32>(scenario, &bar)).collect::<Result<_, _>>()?;
    bar.finish_and_clear();
    let (exact_drive, explicit) = (near_continuous.remove(3), drive.remove(3));
    Ok(Reproduction {
        near_continuous_bounds: Bounds::of(&near_continuous[1], &doubles[1]),
        drive_bounds: Bounds::of(&exact_drive, &doubles[3]),
        coincidence: Coincidence::measure(&scenario)?,
        scenario,
        near_continuous,
        drive,
        explicit,
    })
}

/// Plays the paper's cycle in `S` and keeps what is drawn.
pub fn play<S: SimulatedScalar>(scenario: &Scenario, bar: &ProgressBar) -> Result<Run, LinkError> {
    let rate = scenario.timing.rate;
    let inertia = scenario.motor.inertia;
    let jumps: Vec<f64> = scenario.reference.steps.iter().map(|step| step.time).collect();
    let first_speed = scenario.reference.steps.first().map_or(0.0, |step| step.value);
    let second_jump = jumps.get(1).copied().unwrap_or(f64::INFINITY);
    let strides = Window::ALL.map(|window| window.stride(rate));
    let mut windows = vec![Vec::new(); Window::ALL.len()];
    let mut peak_speed: f64 = 0.0;
    let mut peak_disturbance_error: f64 = 0.0;
    let mut peak_error_norm: f64 = 0.0;
    let mut period: u64 = 0;
    let outcome = simulate::<S>(scenario, |frame| {
        for ((window, stride), frames) in Window::ALL.iter().zip(strides).zip(&mut windows) {
            if period.is_multiple_of(stride) && window.span().contains(&frame.time) {
                frames.push(*frame);
            }
        }
        if frame.time < second_jump {
            peak_speed = peak_speed.max(frame.speed);
        }
        if jumps.iter().all(|jump| !(*jump..jump + SETTLED).contains(&frame.time)) {
            let error = (frame.load_torque - frame.load_torque_estimate) / inertia;
            peak_disturbance_error = peak_disturbance_error.max(error.abs());
            peak_error_norm = peak_error_norm.max(frame.z1.hypot(frame.z2));
        }
        period += 1;
        if period.is_multiple_of(PERIODS_PER_TICK) {
            bar.inc(PERIODS_PER_TICK);
        }
    })?;
    Ok(Run {
        controller: scenario.control.controller,
        metrics: outcome.metrics,
        overshoot: (peak_speed / first_speed - 1.0) * 100.0,
        peak_disturbance_error,
        peak_error_norm,
        windows,
    })
}

impl Bounds {
    /// The bounds for BS-QSMDO or BS-QISMC on a scenario, and what its run reached. For loads without steps and motors
    /// without Coulomb friction: where the disturbance jumps there is no bound on its rate.
    pub fn of(run: &Run, scenario: &Scenario) -> Self {
        let gains = scenario.gains();
        let timing = scenario.drive_config().timing;
        let disturbance = Disturbance { load: &scenario.load, inertia: scenario.motor.inertia };
        let estimation_error = |time: f64| {
            let (value, rate) = disturbance.at(time);
            // The bound is one on the slope of the tanh, which the drive has from a table.
            bounds::estimation(gains.epsilon1, gains.k1, value, rate) / (1.0 - SLOPE_ERROR)
        };
        // A voltage that is up to a horizon old acts as a further part of ζ2, −(a2/La)·horizon·u̇, where quasi-statically
        // u follows the load with Ra·T_l/Kb.
        let motor = &scenario.motor;
        let volts_per_torque = motor.resistance / motor.back_emf_constant;
        let per_volt = motor.back_emf_constant / (motor.inertia * motor.inductance);
        let a1 = (motor.viscous_friction / motor.inertia) as f32;
        let stale = (per_volt * volts_per_torque) as f32 * timing.horizon();
        // ζ2 = (c − a1)·d̃ + d̂̇ and that part, along the quasi-static solution, and its rate, by central differences.
        let step = 1e-3;
        let lumped = |time: f64| {
            let signed = |time: f64| {
                let (_, rate) = disturbance.at(time);
                estimation_error(time).copysign(rate)
            };
            let (_, rate) = disturbance.at(time);
            let drift = (signed(time + step) - signed(time - step)) / (2.0 * step as f32);
            (gains.c - a1) * signed(time) + rate
                - drift
                - stale * scenario.load.rate_at(time) as f32
        };
        let lumped_rate =
            |time: f64| (lumped(time + step) - lumped(time - step)) / (2.0 * step as f32);
        let supremum = |f: &dyn Fn(f64) -> f32| {
            let times = (0..=(scenario.duration / step) as u64).map(|index| index as f64 * step);
            times.map(|time| f(time).abs()).fold(0.0, f32::max)
        };

        let rate = supremum(&|time| disturbance.at(time).1);
        let value = supremum(&|time| disturbance.at(time).0);
        let sampling = bounds::sampling(timing.period(), rate);
        let corrected = supremum(&estimation_error) + sampling;
        let paper = bounds::estimation_paper(gains.epsilon1, gains.k1, rate);
        let sup_lumped_rate = supremum(&lumped_rate);
        let lumped_error = supremum(&|time| {
            bounds::estimation(gains.epsilon2, gains.k2, lumped(time), lumped_rate(time))
        }) + bounds::sampling(timing.horizon(), sup_lumped_rate);
        let paper_lumped = bounds::estimation_paper(gains.epsilon2, gains.k2, sup_lumped_rate);
        Self {
            paper: paper.into(),
            corrected: corrected.into(),
            from_suprema: (bounds::estimation(gains.epsilon1, gains.k1, value, rate) + sampling)
                .into(),
            reached: run.peak_disturbance_error,
            paper_norm: bounds::tracking(paper, paper_lumped, gains.c).into(),
            corrected_norm: bounds::tracking(corrected, lumped_error, gains.c).into(),
            reached_norm: run.peak_error_norm,
        }
    }
}

/// The disturbance d = −T_l/J of a load.
struct Disturbance<'a> {
    load: &'a Load,
    inertia: f64,
}

impl Disturbance<'_> {
    /// d (rad/s²) and ḋ (rad/s³).
    fn at(&self, time: f64) -> (f32, f32) {
        let per_inertia = -1.0 / self.inertia;
        ((self.load.at(time) * per_inertia) as f32, (self.load.rate_at(time) * per_inertia) as f32)
    }
}

impl Coincidence {
    /// Plays both on the scenario with its reference smoothed and their starts matched.
    pub fn measure(scenario: &Scenario) -> Result<Self, LinkError> {
        let mut scenario = scenario.clone();
        scenario.reference.shape = ShapeName::SecondOrder;
        scenario.reference.bandwidth = Some(50.0);
        scenario.control.start = StartName::Matched;
        let mut traces = Vec::new();
        for controller in [Controller::BsQsmdo, Controller::BsQismc] {
            scenario.control.controller = controller;
            let mut trace = Vec::new();
            simulate::<Double>(&scenario, |frame| trace.push((frame.voltage, frame.speed)))?;
            traces.push(trace);
        }
        let mut coincidence = Self { voltage: 0.0, speed: 0.0, largest_voltage: 0.0 };
        for (one, other) in traces[0].iter().zip(&traces[1]) {
            coincidence.voltage = coincidence.voltage.max((one.0 - other.0).abs());
            coincidence.speed = coincidence.speed.max((one.1 - other.1).abs());
            coincidence.largest_voltage = coincidence.largest_voltage.max(one.0.abs());
        }
        Ok(coincidence)
    }
}
