//! The peers at their best: a search over each one's whole accepted range for the front of load-step dip over voltage ripple.
//!
//! A Latin hypercube over the range first; then batches of variations of tunings that are on a front so far, in steps that
//! become smaller. The range is parametrised such that all of what the controller accepts can be reached, and little else.

use super::contender::{Rule, Setup};
use super::measure::LoadStepFigures;
use super::rig::{RATE, Rig};
use crate::scenario::{Control, Controller, LadrcTable, PiTable, SpeedName};
use crate::sensors::SensorsTable;
use rand::rngs::StdRng;
use rand::seq::SliceRandom;
use rand::{Rng, SeedableRng};
use rand_distr::StandardNormal;
use rayon::prelude::*;
use serde::Serialize;

/// Longest recovery of an admissible tuning (s).
pub const LONGEST_RECOVERY: f64 = 0.012;

/// Largest steady error of an admissible tuning (rad/s).
pub const LARGEST_STEADY_ERROR: f64 = 0.03;

/// Who is searched.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Family {
    /// The drive form of BS-QSMDO: its one knob.
    Drive,
    /// PI: current and speed bandwidth, damping, speed estimate and its bandwidth, disturbance observer.
    Pi,
    /// LADRC: control, observer and current bandwidth, speed estimate and its bandwidth.
    Ladrc,
}

impl Family {
    /// All, the project's own first.
    pub const ALL: [Self; 3] = [Self::Drive, Self::Pi, Self::Ladrc];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Drive => "drive BS-QSMDO",
            Self::Pi => "PI, searched",
            Self::Ladrc => "LADRC, searched",
        }
    }

    fn dimensions(self) -> usize {
        match self {
            Self::Drive => 1,
            Self::Pi => 7,
            Self::Ladrc => 5,
        }
    }

    /// The tuning at a point of the unit cube.
    fn setup(self, point: &[f64], rig: &Rig) -> Setup {
        let logarithmic = |x: f64, low: f64, high: f64| low * (high / low).powf(x);
        // Half the sampling rate is the largest current bandwidth that is accepted, the sampling rate that of an estimate.
        let current = || logarithmic(point[0], 300.0, 0.499 * RATE);
        let estimate = || logarithmic(point[1], 150.0, 0.999 * RATE);
        let share = |x: f64| logarithmic(x, 0.02, 0.999);
        let source = || match (point[2] * 3.0) as u32 {
            0 => SpeedName::Difference,
            1 => SpeedName::Pll,
            _ => SpeedName::FedPll,
        };
        let control = |controller| Control {
            controller,
            speed: Some(source()),
            speed_bandwidth: Some(estimate()),
            ..Control::default()
        };
        // As the controllers count it.
        let calibration =
            SensorsTable { reads: rig.reads, ..SensorsTable::default() }.calibration();
        let age = f64::from(calibration.age((1.0 / RATE) as f32));
        let lag = || match source() {
            SpeedName::Difference => 1.0 / estimate() + 0.5 / RATE + age,
            _ => 2.0 / estimate(),
        };
        let observer = |x: f64| share(x) * (0.5 * RATE).min(0.6 / lag());
        match self {
            Self::Drive => {
                let bandwidth = logarithmic(point[0], 0.02 * RATE, 0.13 * RATE);
                Rule::DriveQsmdo.setup(bandwidth, &rig.machine)
            }
            Self::Pi => {
                let damping = logarithmic(point[3], 0.5, 5.0);
                let fastest = (0.4 / damping).min(0.5) / (1.0 / current() + lag());
                let pi = PiTable {
                    current_bandwidth: Some(current()),
                    speed_bandwidth: Some(share(point[4]) * fastest),
                    speed_damping: Some(damping),
                    disturbance: (point[5] > 0.5).then(|| observer(point[6])),
                };
                Setup { control: control(Controller::Pi), pi, ..Setup::default() }
            }
            Self::Ladrc => {
                let ladrc = LadrcTable {
                    control_bandwidth: Some(share(point[3]) * 0.6 * current()),
                    observer_bandwidth: Some(observer(point[4])),
                    current_bandwidth: Some(current()),
                };
                Setup { control: control(Controller::Ladrc), ladrc, ..Setup::default() }
            }
        }
    }
}

/// A measure of ripple.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Measure {
    /// RMS of u about its mean.
    Ripple,
    /// RMS of the change of u from one period to the next.
    VoltageStep,
}

impl Measure {
    /// Both.
    pub const ALL: [Self; 2] = [Self::Ripple, Self::VoltageStep];

    /// Reads it (V).
    pub fn of(self, figures: &LoadStepFigures) -> f64 {
        match self {
            Self::Ripple => figures.ripple,
            Self::VoltageStep => figures.voltage_step,
        }
    }

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::Ripple => "ripple",
            Self::VoltageStep => "voltage step",
        }
    }
}

/// A requirement of an admissible tuning.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Requirement {
    /// To recover within 12 ms.
    Recovery,
    /// To be stable with every combination of parameter errors.
    ParameterErrors,
    /// To keep the steady error within 0.03 rad/s.
    SteadyError,
}

/// A tuning that was tried.
#[derive(Clone, Debug, Serialize)]
pub struct Tried {
    /// Bandwidths (rad/s), damping, speed estimate: for people.
    pub tuning: String,
    /// Its load-step trial.
    #[serde(flatten)]
    pub figures: LoadStepFigures,
    /// The tuning.
    #[serde(skip)]
    pub setup: Setup,
    /// The first requirement that it misses.
    pub misses: Option<Requirement>,
    #[serde(skip)]
    point: Vec<f64>,
}

impl Tried {
    /// Whether it misses nothing.
    pub fn admissible(&self) -> bool {
        self.misses.is_none()
    }

    /// Whether it misses nothing but, perhaps, the steady error.
    pub fn stable(&self) -> bool {
        matches!(self.misses, None | Some(Requirement::SteadyError))
    }

    /// Whether this one makes figures superfluous: it is on no front with `figures` that they would not fall behind.
    fn supersedes(&self, figures: &LoadStepFigures) -> bool {
        let own = &self.figures;
        self.admissible()
            && own.dip <= figures.dip
            && Measure::ALL.iter().all(|measure| measure.of(own) <= measure.of(figures))
    }
}

fn describe(setup: &Setup) -> String {
    let Setup { control, tuning, pi, ladrc, .. } = setup;
    let numbers = [
        ("wo", tuning.bandwidth),
        ("current", pi.current_bandwidth.or(ladrc.current_bandwidth)),
        ("speed", pi.speed_bandwidth.or(ladrc.control_bandwidth)),
        ("damping", pi.speed_damping),
        ("observer", pi.disturbance.or(ladrc.observer_bandwidth)),
    ];
    let mut parts: Vec<String> = numbers
        .into_iter()
        .filter_map(|(name, value)| {
            Some(format!("{name} {}", crate::terminal::number(Some(value?))))
        })
        .collect();
    if tuning.bandwidth.is_none() {
        let source = match control.speed {
            Some(SpeedName::Difference) => "difference",
            Some(SpeedName::Pll) => "PLL",
            _ => "fed PLL",
        };
        parts.push(format!("{source} {:.0}", control.speed_bandwidth.unwrap_or(0.0)));
    }
    parts.join(", ")
}

/// How long to search.
#[derive(Clone, Copy, Debug)]
pub struct Effort {
    /// Tunings of the hypercube.
    pub first: usize,
    /// Variations after it.
    pub then: usize,
    /// Times that this is done, from other random numbers; the best of all counts.
    pub seeds: u64,
}

/// Variations that are tried at once.
const BATCH: usize = 32;

impl Effort {
    /// Tunings that a family needs.
    pub fn tunings(self, family: Family) -> usize {
        match family {
            Family::Drive => DRIVE_TUNINGS,
            _ => self.seeds as usize * (self.first + self.then),
        }
    }
}

/// Positions of the drive form's knob.
const DRIVE_TUNINGS: usize = 24;

/// Searches a family on a rig, calling `tick` for every tuning. Gives the tunings that were tried, but for those that do not run
/// and those that an admissible one beats in everything.
pub fn search(family: Family, rig: &Rig, effort: Effort, tick: impl Fn() + Sync) -> Vec<Tried> {
    if family == Family::Drive {
        let last = (DRIVE_TUNINGS - 1) as f64;
        let points = (0..DRIVE_TUNINGS).map(|k| vec![k as f64 / last]).collect();
        return attempt(family, rig, points, &[], &tick);
    }
    (1..=effort.seeds).flat_map(|seed| search_once(family, rig, effort, seed, &tick)).collect()
}

fn search_once(
    family: Family,
    rig: &Rig,
    effort: Effort,
    seed: u64,
    tick: &(impl Fn() + Sync),
) -> Vec<Tried> {
    let mut random = StdRng::seed_from_u64(seed);
    let mut tried = Vec::new();
    for points in hypercube(effort.first, family.dimensions(), &mut random).chunks(BATCH) {
        tried.extend(attempt(family, rig, points.to_vec(), &tried, tick));
    }
    let mut left = effort.then;
    while left > 0 {
        let batch = left.min(BATCH);
        let spread = 0.02 + 0.13 * left as f64 / effort.then as f64;
        let parents = parents(&tried);
        let points =
            (0..batch).map(|_| vary(&parents, family.dimensions(), spread, &mut random)).collect();
        tried.extend(attempt(family, rig, points, &tried, tick));
        left -= batch;
    }
    tried
}

/// Tries points of the unit cube, of which those that one of `before` supersedes are dropped: parameter errors, most of the work,
/// are for those that could be on a front.
fn attempt(
    family: Family,
    rig: &Rig,
    points: Vec<Vec<f64>>,
    before: &[Tried],
    tick: &(impl Fn() + Sync),
) -> Vec<Tried> {
    let attempt = |point: Vec<f64>| {
        let setup = family.setup(&point, rig);
        let figures = rig.trial(&setup, 1);
        let misses = |figures: &LoadStepFigures| {
            if figures.recovery > LONGEST_RECOVERY {
                Some(Requirement::Recovery)
            } else if rig.upsetting_errors(&setup, figures).is_some() {
                Some(Requirement::ParameterErrors)
            } else {
                (figures.steady_error > LARGEST_STEADY_ERROR).then_some(Requirement::SteadyError)
            }
        };
        let found = figures
            .filter(|figures| !before.iter().any(|tried| tried.supersedes(figures)))
            .map(|figures| Tried {
                tuning: describe(&setup),
                misses: misses(&figures),
                figures,
                setup,
                point,
            });
        tick();
        found
    };
    points.into_par_iter().filter_map(attempt).collect()
}

/// Points of which each coordinate takes each of `count` equal parts of 0..1 once.
fn hypercube(count: usize, dimensions: usize, random: &mut StdRng) -> Vec<Vec<f64>> {
    let mut points = vec![vec![0.0; dimensions]; count];
    for dimension in 0..dimensions {
        let mut order: Vec<usize> = (0..count).collect();
        order.shuffle(random);
        for (point, part) in points.iter_mut().zip(order) {
            point[dimension] = (part as f64 + random.random::<f64>()) / count as f64;
        }
    }
    points
}

/// The tunings worth varying: those on a front of either measure, of all and of the admissible ones, with dips of interest.
fn parents(tried: &[Tried]) -> Vec<&Tried> {
    let mut parents = Vec::new();
    for measure in Measure::ALL {
        for admissible in [false, true] {
            let front = Front::of(tried, measure, admissible);
            parents.extend(front.tunings.into_iter().filter(|tried| tried.figures.dip < 2.0));
        }
    }
    parents
}

/// A point near a parent's, or anywhere if there is no parent.
fn vary(parents: &[&Tried], dimensions: usize, spread: f64, random: &mut StdRng) -> Vec<f64> {
    if parents.is_empty() {
        return (0..dimensions).map(|_| random.random()).collect();
    }
    let parent = parents[random.random_range(0..parents.len())];
    let mut near = |x: &f64| {
        let step: f64 = random.sample(StandardNormal);
        (x + spread * step).clamp(0.0, 1.0 - 1e-9)
    };
    parent.point.iter().map(&mut near).collect()
}

/// The tunings than which no other has both less dip and less ripple, by growing dip.
pub struct Front<'a> {
    /// The tunings.
    pub tunings: Vec<&'a Tried>,
    measure: Measure,
}

impl<'a> Front<'a> {
    /// Of the stable ones of those tried; where asked, of the admissible ones only.
    pub fn of(tried: &'a [Tried], measure: Measure, admissible: bool) -> Self {
        let mut sorted: Vec<&Tried> = tried
            .iter()
            .filter(|tried| if admissible { tried.admissible() } else { tried.stable() })
            .collect();
        sorted.sort_by(|a, b| a.figures.dip.total_cmp(&b.figures.dip));
        let mut least = f64::INFINITY;
        sorted.retain(|tried| {
            let ripple = measure.of(&tried.figures);
            let better = ripple < least;
            least = least.min(ripple);
            better
        });
        Self { tunings: sorted, measure }
    }

    /// Points (dip in rad/s, ripple in V).
    pub fn points(&self) -> Vec<(f64, f64)> {
        self.tunings.iter().map(|at| (at.figures.dip, self.measure.of(&at.figures))).collect()
    }

    /// The ripple (V) at a dip (rad/s), between tunings by powers; beyond the largest dip that of the last. Nothing where no
    /// tuning dips that little.
    pub fn ripple_at(&self, dip: f64) -> Option<f64> {
        interpolate(&self.points(), dip)
    }

    /// The tuning that ripples least of those that dip by `dip` (rad/s) at most, give or take a fiftieth.
    pub fn tuning_at(&self, dip: f64) -> Option<&'a Tried> {
        self.tunings.iter().rev().find(|tried| tried.figures.dip <= 1.02 * dip).copied()
    }

    /// The tuning that dips least of those that ripple by `ripple` (V) at most.
    pub fn tuning_of_ripple(&self, ripple: f64) -> Option<&'a Tried> {
        self.tunings.iter().find(|tried| self.measure.of(&tried.figures) <= ripple).copied()
    }
}

fn interpolate(points: &[(f64, f64)], dip: f64) -> Option<f64> {
    let above = points.partition_point(|point| point.0 <= dip);
    let &(dip_below, below) = points[..above].last()?;
    let Some(&(dip_above, ripple_above)) = points.get(above) else { return Some(below) };
    let share = (dip / dip_below).ln() / (dip_above / dip_below).ln();
    Some(below * (ripple_above / below).powf(share))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::ReadsName;

    fn tried(dip: f64, ripple: f64, steady_error: f64) -> Tried {
        let figures = LoadStepFigures {
            dip,
            ripple,
            steady_error,
            recovery: 0.01,
            voltage_step: 1.0 / ripple,
            peak_current: 1.0,
        };
        let misses = (steady_error > LARGEST_STEADY_ERROR).then_some(Requirement::SteadyError);
        Tried { tuning: String::new(), figures, setup: Setup::default(), misses, point: vec![0.5] }
    }

    #[test]
    fn a_front_holds_what_nothing_beats() {
        let all = [
            tried(2.0, 1.0, 0.0),
            tried(1.0, 4.0, 0.0),
            tried(1.5, 5.0, 0.0),
            tried(0.9, 9.0, 1.0),
        ];
        let mut unstable = tried(0.1, 0.1, 0.0);
        unstable.misses = Some(Requirement::ParameterErrors);
        let all = all.into_iter().chain([unstable]).collect::<Vec<_>>();
        let points = |measure, admissible| Front::of(&all, measure, admissible).points();
        assert_eq!(points(Measure::Ripple, true), [(1.0, 4.0), (2.0, 1.0)]);
        assert_eq!(points(Measure::Ripple, false), [(0.9, 9.0), (1.0, 4.0), (2.0, 1.0)]);
        assert_eq!(points(Measure::VoltageStep, false), [(0.9, 1.0 / 9.0)]);
        let front = Front::of(&all, Measure::Ripple, true);
        assert_eq!(front.ripple_at(0.95), None);
        assert_eq!(front.ripple_at(1.0), Some(4.0));
        let between = front.ripple_at(2.0_f64.sqrt()).expect("between");
        assert!((between - 2.0).abs() < 1e-12, "{between}");
        assert_eq!(front.ripple_at(3.0), Some(1.0));
        assert_eq!(front.tuning_at(1.9).map(|tried| tried.figures.dip), Some(1.0));
        assert_eq!(front.tuning_of_ripple(3.0).map(|tried| tried.figures.dip), Some(2.0));
    }

    #[test]
    fn only_an_admissible_tuning_that_is_better_in_everything_supersedes() {
        let better = tried(1.0, 1.0, 0.0);
        let mut worse = tried(1.1, 1.1, 0.0).figures;
        assert!(!better.supersedes(&worse), "its voltage step is less");
        worse.voltage_step = 2.0;
        assert!(better.supersedes(&worse));
        assert!(!tried(1.0, 1.0, 1.0).supersedes(&worse));
    }

    #[test]
    fn a_hypercube_takes_every_part_once() {
        let points = hypercube(10, 3, &mut StdRng::seed_from_u64(1));
        for dimension in 0..3 {
            let mut parts: Vec<usize> =
                points.iter().map(|point| (10.0 * point[dimension]) as usize).collect();
            parts.sort_unstable();
            assert_eq!(parts, (0..10).collect::<Vec<_>>());
        }
    }

    #[test]
    fn the_unit_cube_is_what_the_controllers_accept() {
        let mut random = StdRng::seed_from_u64(1);
        for reads in [ReadsName::All, ReadsName::Last] {
            let rig = Rig { reads, ..Rig::REFERENCE };
            for family in [Family::Pi, Family::Ladrc] {
                for point in hypercube(200, family.dimensions(), &mut random) {
                    let mut scenario = rig.scenario(1.0, 1);
                    family.setup(&point, &rig).put_into(&mut scenario);
                    let checked = scenario.recheck(std::path::Path::new(family.name()));
                    assert!(checked.is_ok(), "{:?} at {point:?}", checked.err());
                }
            }
        }
    }
}
