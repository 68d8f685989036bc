//! The scoreboard: every controller on the same sensors, delay, limits and shaping, at the same voltage ripple.
//!
//! - [`cases`] are played by [`contender`]s that have one knob each, set so that all make the same ripple in the load-step
//!   trial of [`rig`], and by the peers that [`search`] found at that ripple;
//! - [`search`] finds the front of load-step dip over ripple of each peer, which the targets are about;
//! - [`measure`] tells what is measured; [`motors`] and [`drive_cycle`] hold the published data; [`show`] shows it all.

pub mod cases;
pub mod contender;
pub mod drive_cycle;
pub mod measure;
pub mod motors;
pub mod rig;
pub mod search;
pub mod show;

use crate::profile::value_at;
use crate::scenario::Scenario;
use crate::sensors::ReadsName;
use crate::simulation::simulate;
use anyhow::{Result, bail};
use cases::Case;
use contender::{Contender, Setup};
use indicatif::ProgressBar;
use measure::{LoadStepFigures, LoadStepMeter, Overshoot, WindowedSteps, median};
use motors::Machine;
use rayon::prelude::*;
use rig::{Errors, Rig};
use search::{Effort, Family, Front, Measure, Tried};
use serde::Serialize;

/// What to do.
#[derive(Clone, Debug)]
pub struct Options {
    /// In a minute rather than some five: shorter searches, and none for other motors.
    pub quick: bool,
    /// Seeds that every case is played with.
    pub seeds: u64,
    /// Play only cases whose name contains this, and search no fronts.
    pub case: Option<String>,
}

/// The voltage ripple that all are set to in the load-step trial (V rms about the mean). By the book PI and LADRC do not come below
/// some 6 mV with the paper's motor, of which noise of the current makes most.
pub const MATCHED_RIPPLE: f64 = 10e-3;

/// The dip at which the targets ask for ratios (rad/s).
pub const TARGET_DIP: f64 = 1.0;

/// Everything measured.
#[derive(Clone, Debug, Serialize)]
pub struct Scoreboard {
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
    pub contender: Contender,
    /// Its knob (rad/s); nothing where no position ripples that little.
    pub knob: Option<f64>,
    /// Its load-step trial.
    pub figures: Option<LoadStepFigures>,
}

/// Medians and worst cases over the seeds.
#[derive(Clone, Debug, Serialize)]
pub struct Played {
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

/// How a figure is read and written.
pub type Field = fn(&mut CaseFigures) -> &mut Option<f64>;

impl CaseFigures {
    /// Every figure: its name, unit, the unit over the SI unit, and itself.
    pub const FIELDS: [(&'static str, &'static str, f64, Field); 8] = [
        ("rms error", "rad/s", 1.0, |figures| &mut figures.rms_error),
        ("peak error", "rad/s", 1.0, |figures| &mut figures.peak_error),
        ("dip", "rad/s", 1.0, |figures| &mut figures.dip),
        ("recovery", "ms", 1e3, |figures| &mut figures.recovery),
        ("overshoot", "%", 1e2, |figures| &mut figures.overshoot),
        ("peak current", "A", 1.0, |figures| &mut figures.peak_current),
        ("voltage step", "mV", 1e3, |figures| &mut figures.voltage_step),
        ("torque error", "N·m", 1.0, |figures| &mut figures.estimation_error),
    ];

    /// The medians and the largest of several.
    fn of(all: &mut [Self]) -> [Self; 2] {
        let mut results = [Self::default(); 2];
        for (_, _, _, field) in Self::FIELDS {
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

/// Plays one case once.
fn play(case: &Case, player: &Player, seed: u64) -> Result<CaseFigures> {
    let Some(setup) = player.setup(&case.rig) else { bail!("no tuning ripples that little") };
    let mut scenario = case.scenario(seed);
    setup.put_into(&mut scenario);
    let mut overshoot = Overshoot::default();
    let mut voltage_steps = WindowedSteps::default();
    let mut load_step = case.load_step.map(|at| LoadStepMeter::new(at - 0.1, at));
    let least = 0.1 * largest_command(&scenario);
    let outcome = simulate::<f32>(&scenario, |frame| {
        let command = value_at(&scenario.reference.steps, 0.0, frame.time);
        overshoot.add(frame, command, least);
        voltage_steps.add(frame);
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
    for seed in 1..=seeds {
        match play(case, player, seed) {
            Ok(played) => figures.push(played),
            Err(error) => failures.push(error.to_string()),
        }
    }
    let [median, worst] = CaseFigures::of(&mut figures);
    Played {
        case: case.name.clone(),
        player: player.name.clone(),
        median,
        worst,
        failed: failures.len() as u64,
        failure: failures.into_iter().next(),
    }
}

/// The fronts on one rig.
#[derive(Clone, Debug, Serialize)]
pub struct RigFronts {
    /// Motor.
    pub motor: &'static str,
    /// Counts of the encoder.
    pub counts: u32,
    /// Reads of it in a period.
    pub reads: u32,
    /// What was found.
    pub families: Vec<Searched>,
    #[serde(skip)]
    rig: Rig,
}

/// What a search found.
#[derive(Clone, Debug, Serialize)]
pub struct Searched {
    /// Who.
    pub family: Family,
    /// Tunings that were tried.
    pub tried: usize,
    /// Those of them that are stable with all parameter errors and recover within 12 ms.
    #[serde(skip)]
    pub stable: Vec<Tried>,
    /// The fronts over both measures, of the admissible tunings.
    pub fronts: Vec<MeasuredFront>,
}

/// A front.
#[derive(Clone, Debug, Serialize)]
pub struct MeasuredFront {
    /// Over which measure.
    pub measure: Measure,
    /// Its tunings by growing dip.
    pub tunings: Vec<Tried>,
}

impl Searched {
    /// The front over a measure; where asked, of tunings with an admissible steady error only.
    pub fn front(&self, measure: Measure, admissible: bool) -> Front<'_> {
        Front::of(&self.stable, measure, admissible)
    }
}

impl RigFronts {
    fn family(&self, family: Family) -> Option<&Searched> {
        self.families.iter().find(|searched| searched.family == family)
    }
}

fn search_rig(rig: Rig, effort: Effort, bar: &ProgressBar) -> RigFronts {
    let families = Family::ALL.map(|family| {
        let stable = search::search(family, &rig, effort, 1, || bar.inc(1));
        let fronts = Measure::ALL.map(|measure| {
            let front = Front::of(&stable, measure, true);
            MeasuredFront { measure, tunings: front.tunings.into_iter().cloned().collect() }
        });
        Searched { family, tried: effort.tunings(family), stable, fronts: fronts.to_vec() }
    });
    RigFronts {
        motor: rig.machine.name,
        counts: rig.counts,
        reads: if rig.reads == ReadsName::All { 16 } else { 1 },
        families: families.to_vec(),
        rig,
    }
}

/// A target and what was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Target {
    /// What is asked.
    pub asked: String,
    /// What was measured.
    pub measured: String,
    /// Whether it is met; nothing where it cannot be told.
    pub met: Option<bool>,
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
    let mut players: Vec<Player> = Contender::ALL
        .into_iter()
        .map(|contender| Player {
            name: contender.name().to_owned(),
            estimates_load: contender.estimates_load(),
            setups: (rigs.iter().zip(matched.chunks(Contender::ALL.len())))
                .flat_map(|(rig, matched)| {
                    let own = matched.iter().filter(move |matched| matched.contender == contender);
                    own.map(|matched| {
                        let setup = matched.knob.map(|knob| contender.setup(knob, &rig.machine));
                        (rig.machine.name, rig.counts, setup)
                    })
                })
                .collect(),
        })
        .collect();
    players.extend([Family::Pi, Family::Ladrc].into_iter().filter_map(|family| {
        let setups: Vec<_> = fronts
            .iter()
            .filter(|fronts| fronts.reads == 16)
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
    let targets = targets(&fronts);
    Ok(Scoreboard { matched, cases: played, fronts, targets })
}

fn match_all(rigs: &[Rig], progress: &dyn Fn(u64) -> ProgressBar) -> Vec<Matched> {
    let pairs: Vec<(&Rig, Contender)> =
        rigs.iter().flat_map(|rig| Contender::ALL.map(|contender| (rig, contender))).collect();
    let bar = progress(pairs.len() as u64);
    let matched = pairs
        .into_par_iter()
        .map(|(rig, contender)| {
            let knob = contender.match_ripple(rig, MATCHED_RIPPLE);
            let figures = knob.and_then(|knob| rig.trial(&contender.setup(knob, &rig.machine), 1));
            bar.inc(1);
            Matched { motor: rig.machine.name, counts: rig.counts, contender, knob, figures }
        })
        .collect();
    bar.finish_and_clear();
    matched
}

fn search_all(quick: bool, progress: &dyn Fn(u64) -> ProgressBar) -> Vec<RigFronts> {
    let (effort, on_motors) = if quick {
        (Effort { first: 64, then: 96 }, &Machine::ALL[..1])
    } else {
        (Effort { first: 240, then: 560 }, &Machine::ALL[..])
    };
    let reference = [4096, 1024].into_iter().flat_map(|counts| {
        [ReadsName::All, ReadsName::Last].map(|reads| Rig { counts, reads, ..Rig::REFERENCE })
    });
    let motors = on_motors[1..].iter().map(|&machine| Rig { machine, ..Rig::REFERENCE });
    let rigs: Vec<Rig> = reference.chain(motors).collect();
    let each: usize = Family::ALL.iter().map(|&family| effort.tunings(family)).sum();
    let bar = progress((rigs.len() * each) as u64);
    let fronts = rigs.into_iter().map(|rig| search_rig(rig, effort, &bar)).collect();
    bar.finish_and_clear();
    fronts
}

/// Ratios that the targets ask for: counts, reads of the peer, and what the drive's ripple over PI's may be.
const RATIOS: [(u32, u32, f64); 4] =
    [(4096, 1, 1.0 / 15.0), (4096, 16, 1.0 / 3.0), (1024, 1, 1.0 / 10.0), (1024, 16, 1.0 / 2.5)];

fn targets(fronts: &[RigFronts]) -> Vec<Target> {
    let find = |counts, reads| {
        fronts
            .iter()
            .find(|at| (at.motor, at.counts, at.reads) == (Machine::PAPER.name, counts, reads))
    };
    let mut targets = Vec::new();
    for (counts, reads, asked) in RATIOS {
        if let (Some(own), Some(peers)) = (find(counts, 16), find(counts, reads)) {
            for measure in Measure::ALL {
                targets.push(ratio_target(own, peers, measure, asked));
            }
        }
    }
    for own in fronts.iter().filter(|at| at.reads == 16) {
        for family in [Family::Pi, Family::Ladrc] {
            targets.extend(Measure::ALL.map(|measure| front_target(own, family, measure)));
            targets.push(side_target(own, family));
        }
    }
    targets.extend(find(4096, 16).into_iter().flat_map(error_targets));
    targets
}

/// The ripple of the drive form with 16 reads over that of the best PI.
fn ratio_target(own: &RigFronts, peers: &RigFronts, measure: Measure, asked: f64) -> Target {
    let at = |fronts: &RigFronts, family, admissible| {
        fronts.family(family)?.front(measure, admissible).ripple_at(TARGET_DIP)
    };
    let drive = at(own, Family::Drive, true);
    let admissible = at(peers, Family::Pi, true);
    let stable = at(peers, Family::Pi, false);
    let (measured, met) = match (drive, admissible, stable) {
        (None, ..) => ("the drive form has no admissible tuning there".to_owned(), Some(false)),
        (Some(drive), Some(peer), _) => (ratio_in_words(drive, peer), Some(drive <= asked * peer)),
        (Some(drive), None, Some(peer)) => (
            format!(
                "{}; but no PI there keeps the steady error within 0.03 rad/s",
                ratio_in_words(drive, peer)
            ),
            Some(drive <= asked * peer),
        ),
        (Some(drive), None, None) => (
            format!("no PI dips that little; the drive form ripples by {:.3} mV", 1e3 * drive),
            None,
        ),
    };
    Target {
        asked: format!(
            "{} counts, PI with {} read{}, {}: 1/{:.1}",
            peers.counts,
            peers.reads,
            if peers.reads == 1 { "" } else { "s" },
            measure.name(),
            1.0 / asked
        ),
        measured,
        met,
    }
}

fn ratio_in_words(drive: f64, peer: f64) -> String {
    format!("1/{:.2} ({:.3} mV against {:.3} mV)", peer / drive, 1e3 * drive, 1e3 * peer)
}

/// Dips at which fronts are compared (rad/s).
fn dips() -> impl Iterator<Item = f64> {
    (0..15).map(|k| 0.6 + 0.1 * f64::from(k))
}

/// Whether the drive form's front lies below a peer's wherever there is one.
fn front_target(fronts: &RigFronts, family: Family, measure: Measure) -> Target {
    let front = |family| fronts.family(family).map(|searched| searched.front(measure, true));
    let (mut compared, mut below) = (0, 0);
    let mut ratios = Vec::new();
    if let (Some(own), Some(peer)) = (front(Family::Drive), front(family)) {
        for dip in dips() {
            let Some(peer) = peer.ripple_at(dip) else { continue };
            compared += 1;
            if let Some(own) = own.ripple_at(dip) {
                below += u32::from(own < peer);
                ratios.push(peer / own);
            }
        }
    }
    let range = ratios
        .iter()
        .copied()
        .fold((f64::INFINITY, 0.0_f64), |(least, most), ratio| (least.min(ratio), most.max(ratio)));
    Target {
        asked: format!(
            "{}, {} counts, 16 reads: front below that of {} in {}",
            fronts.motor,
            fronts.counts,
            family.name(),
            measure.name()
        ),
        measured: if compared == 0 {
            "the peer has no admissible tuning".to_owned()
        } else {
            format!("at {below} of {compared} dips; 1/{:.2} to 1/{:.2}", range.0, range.1)
        },
        met: (compared > 0).then_some(below == compared),
    }
}

/// Peak current, recovery and steady error at the dip of the targets, beside the peer's tuning of least ripple.
fn side_target(fronts: &RigFronts, family: Family) -> Target {
    let at = |family| {
        let searched: &Searched = fronts.family(family)?;
        Some(searched.front(Measure::Ripple, true).tuning_at(TARGET_DIP)?.figures)
    };
    let asked = format!(
        "{}, {} counts, 16 reads: no more peak current, recovery and steady error than {} at dip {TARGET_DIP:.1}",
        fronts.motor,
        fronts.counts,
        family.name()
    );
    let (measured, met) = match (at(Family::Drive), at(family)) {
        (Some(own), Some(peer)) => (
            format!(
                "{:.3} against {:.3} A, {:.2} against {:.2} ms, {:.4} against {:.4} rad/s",
                own.peak_current,
                peer.peak_current,
                1e3 * own.recovery,
                1e3 * peer.recovery,
                own.steady_error,
                peer.steady_error
            ),
            Some(
                own.peak_current <= 1.02 * peer.peak_current
                    && own.recovery <= peer.recovery
                    && own.steady_error <= peer.steady_error,
            ),
        ),
        (None, _) => ("the drive form has no admissible tuning there".to_owned(), Some(false)),
        (_, None) => ("the peer has no admissible tuning there".to_owned(), None),
    };
    Target { asked, measured, met }
}

/// With each parameter wrong by itself: the drive form's ripple below, and its dip not above, that of PI, both as tuned for
/// the dip of the targets on the right motor.
fn error_targets(fronts: &RigFronts) -> Vec<Target> {
    let setup = |family| {
        let searched: &Searched = fronts.family(family)?;
        Some(searched.front(Measure::Ripple, true).tuning_at(TARGET_DIP)?.setup)
    };
    let Some(own) = setup(Family::Drive) else { return Vec::new() };
    let Some(peer) = setup(Family::Pi) else { return Vec::new() };
    let wrong = Case::all().into_iter().filter(|case| case.rig.errors != Errors::NONE);
    let judge = |case: Case| {
        let rig = Rig { errors: case.rig.errors, ..fronts.rig };
        let (measured, met) = match (rig.trial(&own, 1), rig.trial(&peer, 1)) {
            (Some(own), Some(peer)) => (
                format!(
                    "ripple {}, voltage step {}, dip {:.2} against {:.2} rad/s",
                    ratio_in_words(own.ripple, peer.ripple),
                    ratio_in_words(own.voltage_step, peer.voltage_step),
                    own.dip,
                    peer.dip
                ),
                Some(
                    own.ripple < peer.ripple
                        && own.voltage_step < peer.voltage_step
                        && own.dip <= 1.02 * peer.dip,
                ),
            ),
            _ => ("one of them does not run".to_owned(), None),
        };
        Target {
            asked: format!("{}: below PI's ripple and voltage step, dip no larger", case.name),
            measured,
            met,
        }
    };
    wrong.map(judge).collect()
}
