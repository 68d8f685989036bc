//! The same scenario on the emulated board and on the averaged one ([`SimulatedBoard`](crate::board::SimulatedBoard)): how far they are apart.
//!
//! Both are compared period by period. A command reaches the emulated drive by the link, some periods after it was sent; by how many, the
//! reference tells that comes by telemetry, and the averaged board is commanded as much later.
//!
//! What is left, and the tolerances for it:
//!
//! - **Noise.** Both drives see the same encoder, at other random shifts, and other noise of the current. Each speed error is as on the averaged
//!   board in steady running, so the rms of their difference is √2 times that: `NOISE_RATIO` allows twice.
//! - **Dead time.** The averaged board loses 2·f·t·V = 0.77 V against the current's mean, less in proportion where that is below `bridge.ripple`;
//!   the switches lose it against the sign that the current has at each edge. Where the mean is small these differ by up to 0.77 V: at the start, where the
//!   load comes on at no current. There the averaged drive is armed, too, while the emulated one has been holding the shaft for some
//!   milliseconds. To the drive it is a step of the voltage, as large as one of the load by Kb·0.77 V/Ra = 0.065 N·m, of
//!   which this tuning makes a dip of 0.84 rad/s per 0.05 N·m (README): `DEAD_TIME_DIP`, for the largest difference. It has decayed
//!   `SETTLING` after a jump.
//! - **Drops** of switches, shunts and diodes, 0.1 V and 1 % of the resistance: constant, and so nothing after the observers have found them.

use super::PERIOD;
use super::play::Played;
use crate::frame::Frame;
use crate::scenario::Scenario;
use crate::simulation::simulate;
use anyhow::{Result, ensure};
use serde::Serialize;

/// Longest that a command may take from host to drive (periods): its frame and the answer's.
const LONGEST_DELAY: usize = 60;

/// How long after a command its reference is looked at (s).
const LOOK: f64 = 0.05;

/// Allowed rms of the difference, by the rms speed error of the averaged board in steady running.
const NOISE_RATIO: f64 = 2.0;

/// Allowed difference (rad/s) at any time.
const DEAD_TIME_DIP: f64 = 0.84 * 0.065 / 0.05;

/// How long after a jump of the command a difference that dead time has made may last (s).
const SETTLING: f64 = 0.2;

/// How far they are apart.
#[derive(Clone, Debug, Serialize)]
pub struct Agreement {
    /// Periods that each command took to the drive.
    pub delays: Vec<usize>,
    /// Largest difference of the references (rad/s): rounding.
    pub reference: f64,
    /// Rms of the speeds' difference over all periods (rad/s).
    pub rms: f64,
    /// The same but for the time after jumps, and what it may be.
    pub steady_rms: [f64; 2],
    /// Largest difference of the speeds (rad/s), and what it may be.
    pub largest: [f64; 2],
    /// When they were apart the most (s).
    pub largest_at: f64,
    /// Rms speed errors in steady running (rad/s): of the emulated board, and of the averaged one.
    pub errors: [f64; 2],
}

impl Agreement {
    /// Holds a played scenario against the averaged board.
    pub fn new(scenario: &Scenario, played: &Played) -> Result<Self> {
        let mut scenario = scenario.clone();
        scenario.timing.rate = 1.0 / PERIOD;
        let (delays, reference) = delays(played, &run(&scenario)?, &scenario)?;
        let starts: Vec<_> = scenario.reference.steps.iter().map(|step| step.time).collect();
        for (step, delay) in scenario.reference.steps.iter_mut().zip(&delays) {
            // In the middle between two samples.
            step.time = ((step.time / PERIOD).ceil() + *delay as f64 - 0.5) * PERIOD;
        }
        let frames = run(&scenario)?;
        let is_steady = |place: usize| {
            let time = place as f64 * PERIOD;
            starts.iter().all(|start| !(*start..start + SETTLING).contains(&time))
        };
        let periods = played.truths.iter().zip(&frames).enumerate();
        let difference = |truth: &crate::wired::Truth, frame: &Frame| truth.speed - frame.speed;
        let (mut whole, mut steady, mut model) =
            (Mean::default(), Mean::default(), Mean::default());
        let (mut largest, mut largest_at) = (0.0, 0.0);
        for (place, (truth, frame)) in periods {
            let apart = difference(truth, frame);
            whole.add(apart);
            if apart.abs() > largest {
                (largest, largest_at) = (apart.abs(), place as f64 * PERIOD);
            }
            if is_steady(place) {
                steady.add(apart);
                model.add(frame.z1);
            }
        }
        let mut board = Mean::default();
        let told = played.told.iter().zip(&played.frames);
        told.filter(|((place, _), _)| is_steady(*place)).for_each(|(_, frame)| board.add(frame.z1));
        Ok(Self {
            delays,
            reference,
            rms: whole.root(),
            steady_rms: [steady.root(), NOISE_RATIO * model.root()],
            largest: [largest, DEAD_TIME_DIP],
            largest_at,
            errors: [board.root(), model.root()],
        })
    }

    /// Whether they agree.
    pub fn holds(&self) -> bool {
        [self.steady_rms, self.largest].iter().all(|[found, allowed]| found <= allowed)
    }

    /// In words.
    pub fn text(&self) -> String {
        let Self { delays, reference, rms, steady_rms, largest, largest_at, errors } = self;
        format!(
            "against the averaged board: commands {delays:?} periods later, references within {reference:.1e} rad/s\n\
             speeds apart by {rms:.4} rad/s rms; steady {:.4} (allowed {:.4}); {:.3} at most (allowed {:.3}), at {largest_at:.4} s\n\
             steady speed error {:.4} rad/s rms, on the averaged board {:.4}",
            steady_rms[0], steady_rms[1], largest[0], largest[1], errors[0], errors[1]
        )
    }
}

/// Mean of squares.
#[derive(Default)]
struct Mean {
    sum: f64,
    count: u32,
}

impl Mean {
    fn add(&mut self, value: f64) {
        self.sum += value * value;
        self.count += 1;
    }

    fn root(&self) -> f64 {
        (self.sum / f64::from(self.count)).sqrt()
    }
}

fn run(scenario: &Scenario) -> Result<Vec<Frame>> {
    let mut frames = Vec::new();
    let outcome = simulate::<f32>(scenario, |frame| frames.push(*frame))?;
    ensure!(outcome.fault.is_none(), "the averaged board stops: {:?}", outcome.fault);
    Ok(frames)
}

/// How many periods later the emulated drive has taken each command, by its reference, and how well that fits (rad/s).
fn delays(played: &Played, frames: &[Frame], scenario: &Scenario) -> Result<(Vec<usize>, f64)> {
    let (mut delays, mut worst) = (Vec::new(), 0.0_f64);
    for step in &scenario.reference.steps {
        let start = (step.time / PERIOD).ceil() as usize;
        let looked = start + LONGEST_DELAY..start + (LOOK / PERIOD) as usize;
        let told: Vec<_> = played.told.iter().filter(|(place, _)| looked.contains(place)).collect();
        let apart = |delay: usize| {
            let one = told.iter().filter_map(|(place, telemetry)| {
                let frame = frames.get(place - delay)?;
                Some((frame.reference - f64::from(telemetry.reference)).abs())
            });
            one.fold(0.0, f64::max)
        };
        let fits = (0..LONGEST_DELAY).map(|delay| (apart(delay), delay));
        let best = fits.min_by(|one, other| one.0.total_cmp(&other.0));
        let Some((apart, delay)) = best.filter(|_| !told.is_empty()) else { continue };
        worst = worst.max(apart);
        delays.push(delay);
    }
    ensure!(worst < 1e-2, "the references do not fit: {worst} rad/s apart");
    Ok((delays, worst))
}
