//! The scoreboard: every controller on the same sensors, delay, limits and shaping, at the same voltage ripple.
//!
//! - [`cases`] are played by [`contender`]s that have one knob each, set so that all make the same ripple in the load-step
//!   trial of [`rig`], and by the peers that [`search`] found at that ripple;
//! - [`search`] finds the front of load-step dip over ripple of each peer, on the rigs of [`fronts`];
//! - [`targets`] judges, and [`why`] measures the reason where a target is missed;
//! - [`measure`] tells what is measured; [`motors`] and [`drive_cycle`] hold the published data; [`show`] shows it all, with the
//!   time responses of [`response`].

pub mod cases;
pub mod contender;
pub mod drive_cycle;
pub mod fronts;
pub mod measure;
pub mod motors;
pub mod response;
pub mod rig;
pub mod search;
pub mod show;
pub mod targets;
pub mod why;

use crate::profile::value_at;
use crate::scenario::Scenario;
use crate::sensors::ReadsName;
use crate::simulation::{ScalarName, simulate_in};
use anyhow::{Result, bail};
use cases::Case;
use contender::{Contender, Setup};
use fronts::{RigFronts, search_all};
use indicatif::ProgressBar;
use measure::{LoadStepFigures, LoadStepMeter, Overshoot, WindowedSteps, median};
use rayon::prelude::*;
use response::Response;
use rig::{Errors, Rig};
use search::{Family, Measure};
use serde::Serialize;
use targets::{Target, judge};

/// What to do.
#[derive(Clone, Debug)]
pub struct Options {
    /// In half a minute rather than some eight: shorter searches, on the paper's motor with 4096 and 1024 counts only.
    pub quick: bool,
    /// Seeds that every case is played with.
    pub seeds: u64,
    /// Play only cases whose name contains this, and search no fronts.
    pub case: Option<String>,
}

/// The voltage ripple that all are set to in the load-step trial (V rms about the mean). At half of it PI and LADRC by the book
/// have no position of their knob with the paper's motor.
pub const MATCHED_RIPPLE: f64 = 10e-3;

/// The dip at which the targets ask for ratios (rad/s).
pub const TARGET_DIP: f64 = 1.0;

/// Everything measured.
#[derive(Clone, Debug, Serialize)]
pub struct Scoreboard {
    /// Whether searches were short: then peers are not at their best, and a target that is met tells nothing.
    pub quick: bool,
    /// How each contender was set on each rig.
    pub matched: Vec<Matched>,
    /// Each case by each contender.
    pub cases: Vec<Played>,
    /// The fronts.
    pub fronts: Vec<RigFronts>,
    /// What became of the targets.
    pub targets: Vec<Target>,
}

/// A contender set to the common ripple on a motor with an encoder.
#[derive(Clone, Debug, Serialize)]
pub struct Matched {
    /// Motor.
    pub motor: &'static str,
    /// Counts of the encoder.
    pub counts: u32,
    /// Who.
    pub player: String,
    #[serde(skip)]
    contender: Contender,
    #[serde(skip)]
    setup: Option<Setup>,
    /// Its knob (rad/s); nothing where no position ripples that little.
    pub knob: Option<f64>,
    /// Its load-step trial.
    pub figures: Option<LoadStepFigures>,
}

/// Medians and worst cases over the seeds.
#[derive(Clone, Debug, Serialize)]
pub struct Played {
    /// Motor.
    pub motor: &'static str,
    /// Counts of the encoder.
    pub counts: u32,
    /// The case.
    pub case: String,
    /// Who.
    pub player: String,
    /// Medians over the seeds that ended without a fault.
    pub median: CaseFigures,
    /// The largest.
    pub worst: CaseFigures,
    /// Seeds that ended with a fault, or were refused, and the first reason.
    pub failed: u64,
    /// The first reason.
    pub failure: Option<String>,
    /// Time responses to the first seed, for the report.
    #[serde(skip)]
    pub responses: Vec<Response>,
}

/// Figures of a case; nothing where a case or a controller has none.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize)]
pub struct CaseFigures {
    /// RMS of ω − ω_d (rad/s).
    pub rms_error: Option<f64>,
    /// Largest |ω − ω_d| (rad/s).
    pub peak_error: Option<f64>,
    /// Largest ω_d − ω after the load step (rad/s).
    pub dip: Option<f64>,
    /// Time until a tenth of it (s).
    pub recovery: Option<f64>,
    /// Beyond the commanded speed, over the command's jump.
    pub overshoot: Option<f64>,
    /// Largest |i| (A).
    pub peak_current: Option<f64>,
    /// Median over windows of 10 ms of the RMS change of u from period to period (V).
    pub voltage_step: Option<f64>,
    /// RMS error of the load torque estimate (N·m).
    pub estimation_error: Option<f64>,
}

/// A figure: how it is shown, and how it is read and written.
pub struct Figure {
    /// Its name.
    pub name: &'static str,
    /// The unit that it is shown in.
    pub unit: &'static str,
    /// How much of that unit the SI unit is.
    pub scale: f64,
    /// Its column in a CSV file, which is in SI units.
    pub column: &'static str,
    /// Where it is.
    pub field: Field,
}

type Field = fn(&mut CaseFigures) -> &mut Option<f64>;

const fn figure(
    name: &'static str,
    unit: &'static str,
    scale: f64,
    column: &'static str,
    field: Field,
) -> Figure {
    Figure { name, unit, scale, column, field }
}

impl CaseFigures {
    /// Every figure, in the order they are shown.
    pub const ALL: [Figure; 8] = [
        figure("rms error", "rad/s", 1.0, "rms_error_rad_per_s", |at| &mut at.rms_error),
        figure("peak error", "rad/s", 1.0, "peak_error_rad_per_s", |at| &mut at.peak_error),
        figure("dip", "rad/s", 1.0, "dip_rad_per_s", |at| &mut at.dip),
        figure("recovery", "ms", 1e3, "recovery_s", |at| &mut at.recovery),
        figure("overshoot", "%", 1e2, "overshoot_per_unit", |at| &mut at.overshoot),
        figure("peak current", "A", 1.0, "peak_current_a", |at| &mut at.peak_current),
        figure("voltage step", "mV", 1e3, "voltage_step_v", |at| &mut at.voltage_step),
        figure("torque error", "N·m", 1.0, "load_torque_error_n_m", |at| &mut at.estimation_error),
    ];

    /// The medians and the largest of several.
    fn of(all: &mut [Self]) -> [Self; 2] {
        let mut results = [Self::default(); 2];
        for Figure { field, .. } in Self::ALL {
            let mut values: Vec<f64> = all.iter_mut().filter_map(|at| *field(at)).collect();
            let middle = median(&mut values);
            *field(&mut results[0]) = middle;
            *field(&mut results[1]) = values.last().copied();
        }
        results
    }
}

/// Who plays the cases: a contender, or a searched peer.
#[derive(Clone, Debug)]
struct Player {
    name: String,
    reads: ReadsName,
    scalar: ScalarName,
    estimates_load: bool,
    /// Its setups by motor and counts.
    setups: Vec<(&'static str, u32, Option<Setup>)>,
}

impl Player {
    fn setup(&self, rig: &Rig) -> Option<&Setup> {
        let mut setups = self.setups.iter();
        let found =
            setups.find(|(motor, counts, _)| (*motor, *counts) == (rig.machine.name, rig.counts));
        found.and_then(|(_, _, setup)| setup.as_ref())
    }
}

/// Plays one case once, with its time responses where they are wanted.
fn play(
    case: &Case,
    player: &Player,
    seed: u64,
    responses: &mut [Response],
) -> Result<CaseFigures> {
    let Some(setup) = player.setup(&case.rig) else { bail!("no tuning ripples that little") };
    let mut scenario = case.scenario(player.reads, seed);
    setup.put_into(&mut scenario);
    let mut overshoot = Overshoot::default();
    let mut voltage_steps = WindowedSteps::default();
    let mut load_step = case.load_step.map(|at| LoadStepMeter::new(at - 0.1, at));
    let least = 0.1 * largest_command(&scenario);
    let outcome = simulate_in(player.scalar, &scenario, |frame| {
        let command = value_at(&scenario.reference.steps, 0.0, frame.time);
        overshoot.add(frame, command, least);
        voltage_steps.add(frame);
        for response in &mut *responses {
            response.add(frame);
        }
        // The load goes off again later: that is no part of the step.
        if let Some(meter) = &mut load_step
            && case.load_step.is_some_and(|at| frame.time < at + 0.1)
        {
            meter.add(frame);
        }
    })?;
    if let Some((time, fault)) = outcome.fault {
        bail!("{fault:?} at {time:.3} s");
    }
    let load_step = load_step.and_then(|meter| meter.figures());
    let whole = outcome.metrics.whole;
    Ok(CaseFigures {
        rms_error: whole.rms_z1,
        peak_error: whole.peak_z1,
        dip: load_step.map(|figures| figures.dip),
        recovery: load_step.map(|figures| figures.recovery),
        overshoot: overshoot.largest(),
        peak_current: whole.peak_current,
        voltage_step: voltage_steps.median(),
        estimation_error: whole.rms_load_torque_error.filter(|_| player.estimates_load),
    })
}

fn largest_command(scenario: &Scenario) -> f64 {
    scenario.reference.steps.iter().map(|step| step.value.abs()).fold(0.0, f64::max)
}

fn play_seeds(case: &Case, player: &Player, seeds: u64) -> Played {
    let mut figures = Vec::new();
    let mut failures = Vec::new();
    let mut responses: Vec<Response> = case.views.iter().map(Response::new).collect();
    for seed in 1..=seeds {
        let shown = if seed == 1 { &mut responses[..] } else { &mut [] };
        match play(case, player, seed, shown) {
            Ok(played) => figures.push(played),
            Err(error) => failures.push(error.to_string()),
        }
    }
    let [median, worst] = CaseFigures::of(&mut figures);
    Played {
        motor: case.rig.machine.name,
        counts: case.rig.counts,
        case: case.name.clone(),
        player: player.name.clone(),
        median,
        worst,
        failed: failures.len() as u64,
        failure: failures.into_iter().next(),
        responses,
    }
}

/// Plays and searches everything.
pub fn run(options: &Options, progress: &dyn Fn(u64) -> ProgressBar) -> Result<Scoreboard> {
    let cases: Vec<Case> = Case::all()
        .into_iter()
        .filter(|case| options.case.as_ref().is_none_or(|part| case.name.contains(part)))
        .collect();
    if cases.is_empty() {
        let names: Vec<String> = Case::all().into_iter().map(|case| case.name).collect();
        bail!("no case is called that; there are: {}", names.join(", "));
    }
    let fronts =
        if options.case.is_none() { search_all(options.quick, progress) } else { Vec::new() };

    let mut rigs: Vec<Rig> = Vec::new();
    for case in &cases {
        let rig = Rig { errors: Errors::NONE, ..case.rig };
        if !rigs.contains(&rig) {
            rigs.push(rig);
        }
    }
    let matched = match_all(&rigs, progress);
    let mut players: Vec<Player> = Contender::all()
        .map(|contender| Player {
            name: contender.name(),
            reads: contender.reads,
            scalar: contender.scalar,
            estimates_load: contender.rule.estimates_load(),
            setups: (matched.iter())
                .filter(|matched| matched.contender == contender)
                .map(|matched| (matched.motor, matched.counts, matched.setup))
                .collect(),
        })
        .collect();
    players.extend([Family::Pi, Family::Ladrc].into_iter().filter_map(|family| {
        let setups: Vec<_> = fronts
            .iter()
            .filter(|fronts| fronts.reads == ReadsName::All)
            .map(|fronts| {
                let searched = fronts.family(family);
                let tuning = searched.and_then(|found| {
                    found.front(Measure::Ripple, true).tuning_of_ripple(MATCHED_RIPPLE)
                });
                (fronts.motor, fronts.counts, tuning.map(|tried| tried.setup))
            })
            .collect();
        // Without a search there is nobody to play.
        (!setups.is_empty()).then(|| Player {
            name: family.name().to_owned(),
            reads: ReadsName::All,
            scalar: ScalarName::F32,
            estimates_load: family == Family::Ladrc,
            setups,
        })
    }));

    let pairs: Vec<(&Case, &Player)> = cases
        .iter()
        .flat_map(|case| players.iter().map(move |player| (case, player)))
        // Searched peers play where there was a search.
        .filter(|(case, player)| {
            let rig = &case.rig;
            player
                .setups
                .iter()
                .any(|(motor, counts, _)| (*motor, *counts) == (rig.machine.name, rig.counts))
        })
        .collect();
    let bar = progress(pairs.len() as u64);
    let played = pairs
        .into_par_iter()
        .map(|(case, player)| {
            let played = play_seeds(case, player, options.seeds);
            bar.inc(1);
            played
        })
        .collect();
    bar.finish_and_clear();
    let targets = judge(&fronts);
    Ok(Scoreboard { quick: options.quick, matched, cases: played, fronts, targets })
}

fn match_all(rigs: &[Rig], progress: &dyn Fn(u64) -> ProgressBar) -> Vec<Matched> {
    let pairs: Vec<(&Rig, Contender)> = rigs
        .iter()
        .flat_map(|rig| Contender::all().map(move |contender| (rig, contender)))
        .collect();
    let bar = progress(pairs.len() as u64);
    let matched = pairs
        .into_par_iter()
        .map(|(rig, contender)| {
            let knob = contender.match_ripple(rig, MATCHED_RIPPLE);
            let rig = contender.on(rig);
            let setup = knob.map(|knob| contender.rule.setup(knob, &rig.machine));
            let figures = setup.and_then(|setup| rig.trial(&setup, 1));
            bar.inc(1);
            Matched {
                motor: rig.machine.name,
                counts: rig.counts,
                player: contender.name(),
                contender,
                setup,
                knob,
                figures,
            }
        })
        .collect();
    bar.finish_and_clear();
    matched
}
