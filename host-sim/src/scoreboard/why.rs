//! Why a target is missed, measured: the same tunings with other sensors, and other tunings with the same sensors.

use super::fronts::RigFronts;
use super::measure::LoadStepFigures;
use super::rig::{Rig, Sensing};
use super::search::{Family, LARGEST_STEADY_ERROR, Measure, Requirement, Tried};
use crate::sensors::ReadsName;
use crate::terminal::short;
use rayon::prelude::*;
use serde::Serialize;

/// The reason, and what it was read from.
#[derive(Clone, Debug, Default, Serialize)]
pub struct Why {
    /// The reason, in numbers that were measured.
    pub because: String,
    /// The measurements.
    pub evidence: Vec<Evidence>,
}

/// A measurement of the drive form, and of a peer where it is compared with one.
#[derive(Clone, Debug, Serialize)]
pub struct Evidence {
    /// What was measured, with its unit.
    pub what: String,
    /// The drive form's.
    pub own: Option<f64>,
    /// The peer's.
    pub peer: Option<f64>,
}

impl Why {
    /// Two reasons for one thing; nothing if there is neither.
    pub fn both(first: Option<Self>, second: Option<Self>) -> Option<Self> {
        match (first, second) {
            (Some(mut first), Some(second)) => {
                first.because = format!("{}; {}", first.because, second.because);
                first.evidence.extend(second.evidence);
                Some(first)
            }
            (first, second) => first.or(second),
        }
    }
}

/// A tuning on a rig.
#[derive(Clone, Copy, Debug)]
pub struct Tuned<'a> {
    /// The rig.
    pub rig: Rig,
    /// The tuning.
    pub tried: &'a Tried,
}

impl<'a> Tuned<'a> {
    /// A tuning on the rig where it was found.
    pub fn of(fronts: &RigFronts, tried: &'a Tried) -> Self {
        Self { rig: fronts.rig, tried }
    }

    /// Its load-step trial.
    pub fn trial(&self) -> Option<LoadStepFigures> {
        self.rig.trial(&self.tried.setup, 1)
    }
}

/// What is changed about the sensors to see what is left without it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum OtherSensors {
    Same,
    ShiftedReads,
    FinestEncoder,
    MisplacedEdges,
    Exact,
}

impl OtherSensors {
    const ALL: [Self; 5] =
        [Self::Same, Self::ShiftedReads, Self::FinestEncoder, Self::MisplacedEdges, Self::Exact];

    fn name(self) -> &'static str {
        match self {
            Self::Same => "as searched",
            Self::ShiftedReads => "16 shifted reads",
            Self::FinestEncoder => "65536 counts",
            Self::MisplacedEdges => "edges misplaced by 0.05 counts rms",
            Self::Exact => "exact sensors",
        }
    }

    fn on(self, rig: Rig) -> Rig {
        match self {
            Self::Same => rig,
            Self::ShiftedReads => Rig { reads: ReadsName::Shifted, ..rig },
            Self::FinestEncoder => Rig { counts: 65536, ..rig },
            Self::MisplacedEdges => Rig { sensing: Sensing::MisplacedEdges, ..rig },
            Self::Exact => Rig { sensing: Sensing::Exact, ..rig },
        }
    }
}

/// A tuning's trials with each of the sensors, in their order.
struct WithSensors(Vec<Option<LoadStepFigures>>);

impl WithSensors {
    fn of(tuned: Tuned<'_>) -> Self {
        let trial = |sensors: OtherSensors| Tuned { rig: sensors.on(tuned.rig), ..tuned }.trial();
        Self(OtherSensors::ALL.into_par_iter().map(trial).collect())
    }

    fn with(&self, sensors: OtherSensors) -> Option<&LoadStepFigures> {
        self.0.get(sensors as usize)?.as_ref()
    }

    /// The share of the ripple's power that is left with other sensors (%), in words.
    fn left(&self, sensors: OtherSensors) -> String {
        let power = |sensors| Some(self.with(sensors)?.ripple.powi(2));
        let both = power(OtherSensors::Same).zip(power(sensors));
        both.map_or("?".to_owned(), |(same, left)| format!("{:.0} %", 100.0 * left / same))
    }
}

/// A figure with each of the sensors.
fn evidence(
    what: &str,
    own: &WithSensors,
    peer: Option<&WithSensors>,
    read: fn(&LoadStepFigures) -> f64,
) -> Vec<Evidence> {
    let row = |sensors: OtherSensors| Evidence {
        what: format!("{what}, {}", sensors.name()),
        own: own.with(sensors).map(read),
        peer: peer.and_then(|peer| peer.with(sensors)).map(read),
    };
    OtherSensors::ALL.map(row).to_vec()
}

/// Ripple in parts: noise from period to period and what is slower, and what is left of them with other sensors.
pub fn ripple(own: Tuned<'_>, peer: Tuned<'_>) -> Why {
    let (own, peer) = (WithSensors::of(own), WithSensors::of(peer));
    let evidence = [
        evidence("noise from period to period [mV]", &own, Some(&peer), |at| 1e3 * at.noise()),
        evidence("slower ripple [mV]", &own, Some(&peer), |at| 1e3 * at.slow_ripple()),
    ]
    .concat();
    let same = own.with(OtherSensors::Same).zip(peer.with(OtherSensors::Same));
    let because = same.map_or("one of them does not run".to_owned(), |(a, b)| {
        let both = |sensors| format!("{} (peer: {})", own.left(sensors), peer.left(sensors));
        format!(
            "from period to period {} against {} mV, slower {} against {} mV. Of the ripple's power 65536 counts leave {}, \
             shifted reads {}, misplaced edges {}, exact sensors {}",
            short(Some(1e3 * a.noise())),
            short(Some(1e3 * b.noise())),
            short(Some(1e3 * a.slow_ripple())),
            short(Some(1e3 * b.slow_ripple())),
            both(OtherSensors::FinestEncoder),
            both(OtherSensors::ShiftedReads),
            both(OtherSensors::MisplacedEdges),
            both(OtherSensors::Exact),
        )
    });
    Why { because, evidence }
}

/// Why the drive form has no admissible tuning that dips by `dip` (rad/s) or less: what the calmest of those misses.
pub fn no_tuning(fronts: &RigFronts, dip: f64) -> Option<Why> {
    let found = &fronts.family(Family::Drive)?.found;
    let quick = found.iter().filter(|tried| tried.figures.dip <= dip);
    let Some(tried) = quick.min_by(|a, b| a.figures.ripple.total_cmp(&b.figures.ripple)) else {
        let because = format!("no position of the knob that runs dips by {dip:.1} rad/s or less");
        return Some(Why { because, ..Why::default() });
    };
    missing(fronts, tried)
}

/// Why the drive form's calmest admissible tuning dips by less than `dip` (rad/s): what the next calmer one misses.
pub fn no_calmer(fronts: &RigFronts, dip: f64) -> Option<Why> {
    let searched = fronts.family(Family::Drive)?;
    let last = searched.front(Measure::Ripple, true).tunings.last()?.figures.dip;
    let calmer = searched.found.iter().filter(|tried| (last..=dip).contains(&tried.figures.dip));
    let inadmissible = calmer.filter(|tried| !tried.admissible());
    let next = inadmissible.min_by(|a, b| a.figures.dip.total_cmp(&b.figures.dip))?;
    missing(fronts, next)
}

/// What an inadmissible tuning of the drive form misses.
fn missing(fronts: &RigFronts, tried: &Tried) -> Option<Why> {
    let tuned = Tuned::of(fronts, tried);
    let at = format!("at dip {:.2} ({})", tried.figures.dip, tried.tuning);
    match tried.misses? {
        Requirement::Recovery => Some(Why {
            because: format!("{at} it recovers in {:.2} ms, not 12", 1e3 * tried.figures.recovery),
            ..Why::default()
        }),
        Requirement::ParameterErrors => {
            let errors = fronts.rig.upsetting_errors(&tried.setup, &tried.figures);
            let errors = errors.map_or(String::new(), |errors| format!(": {errors}"));
            let because = format!("{at} it is not stable with every parameter error{errors}");
            Some(Why { because, ..Why::default() })
        }
        Requirement::SteadyError => {
            let mut speeds = fronts.rig.trial_by_speed(&tried.setup, 1)?;
            speeds.sort_by(|a, b| b.1.steady_error.total_cmp(&a.1.steady_error));
            let [(speed, worst), (_, second), ..] = speeds[..] else { return None };
            let all = WithSensors::of(tuned);
            let left = |sensors| short(all.with(sensors).map(|at| at.steady_error));
            let because = format!(
                "{at} its steady error is {} rad/s, {LARGEST_STEADY_ERROR} allowed: {} at {speed:.0} rad/s, {} or less at \
                 the other speeds. With shifted reads {}, 65536 counts {}, exact sensors {} rad/s",
                short(Some(tried.figures.steady_error)),
                short(Some(worst.steady_error)),
                short(Some(second.steady_error)),
                left(OtherSensors::ShiftedReads),
                left(OtherSensors::FinestEncoder),
                left(OtherSensors::Exact),
            );
            let evidence = evidence("steady error [rad/s]", &all, None, |at| at.steady_error);
            Some(Why { because, evidence })
        }
    }
}

/// A figure that must be no worse than a peer's at the same dip.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Side {
    /// Peak current, give or take a fiftieth.
    PeakCurrent,
    /// Recovery time.
    Recovery,
    /// Steady error.
    SteadyError,
}

impl Side {
    const ALL: [Self; 3] = [Self::PeakCurrent, Self::Recovery, Self::SteadyError];

    fn name(self) -> &'static str {
        match self {
            Self::PeakCurrent => "peak current",
            Self::Recovery => "recovery",
            Self::SteadyError => "steady error",
        }
    }

    fn held(self, own: &LoadStepFigures, peer: &LoadStepFigures) -> bool {
        match self {
            Self::PeakCurrent => own.peak_current <= 1.02 * peer.peak_current,
            Self::Recovery => own.recovery <= peer.recovery,
            Self::SteadyError => own.steady_error <= peer.steady_error,
        }
    }

    /// Those that are worse.
    pub fn missed(own: &LoadStepFigures, peer: &LoadStepFigures) -> Vec<Self> {
        Self::ALL.into_iter().filter(|side| !side.held(own, peer)).collect()
    }
}

fn all_figures(what: &str, own: &LoadStepFigures, peer: &LoadStepFigures) -> Vec<Evidence> {
    let row = |figure: &str, read: fn(&LoadStepFigures) -> f64| Evidence {
        what: format!("{figure}, {what}"),
        own: Some(read(own)),
        peer: Some(read(peer)),
    };
    vec![
        row("dip [rad/s]", |at| at.dip),
        row("recovery [ms]", |at| 1e3 * at.recovery),
        row("ripple [mV]", |at| 1e3 * at.ripple),
        row("steady error [rad/s]", |at| at.steady_error),
        row("peak current [A]", |at| at.peak_current),
    ]
}

/// What the drive form trades for the sides that it misses: its tuning at the peer's ripple, and for each side the tuning of
/// least ripple that does not miss it.
pub fn sides(fronts: &RigFronts, missed: &[Side], own: Tuned<'_>, peer: Tuned<'_>) -> Option<Why> {
    if missed.is_empty() {
        return None;
    }
    let front = fronts.family(Family::Drive)?.front(Measure::Ripple, true);
    let figures = &peer.tried.figures;
    let mut rows = all_figures("at the same dip", &own.tried.figures, figures);
    let mut parts = Vec::new();
    if let Some(equal) = front.tuning_of_ripple(figures.ripple) {
        rows.extend(all_figures("at the peer's ripple or less", &equal.figures, figures));
        let still = Side::missed(&equal.figures, figures);
        let still: Vec<&str> = still.iter().map(|side| side.name()).collect();
        parts.push(format!(
            "at the peer's ripple it dips by {:.2} against {:.2} rad/s and is worse in {}",
            equal.figures.dip,
            figures.dip,
            if still.is_empty() { "nothing".to_owned() } else { still.join(" and ") },
        ));
    }
    for side in missed {
        let name = side.name();
        let held = front.tunings.iter().rev().find(|tried| side.held(&tried.figures, figures));
        let Some(tried) = held else {
            parts.push(format!("no worse {name} at no dip"));
            continue;
        };
        rows.extend(all_figures(&format!("with no worse {name}"), &tried.figures, figures));
        parts.push(format!(
            "no worse {name} at dip {:.2} ({}), where the ripple is {} against {} mV",
            tried.figures.dip,
            tried.tuning,
            short(Some(1e3 * tried.figures.ripple)),
            short(Some(1e3 * figures.ripple)),
        ));
    }
    if missed.contains(&Side::SteadyError) {
        let (own, peer) = (WithSensors::of(own), WithSensors::of(peer));
        let read = |at: &LoadStepFigures| at.steady_error;
        let both = |sensors| {
            let [own, peer] = [&own, &peer].map(|all| short(all.with(sensors).map(read)));
            format!("{own} against {peer}")
        };
        parts.push(format!(
            "steady error with shifted reads {}, 65536 counts {}, exact sensors {} rad/s",
            both(OtherSensors::ShiftedReads),
            both(OtherSensors::FinestEncoder),
            both(OtherSensors::Exact)
        ));
        rows.extend(evidence("steady error [rad/s]", &own, Some(&peer), read));
    }
    Some(Why { because: parts.join("; "), evidence: rows })
}

/// With wrong parameters: the drive form's tuning of least ripple that dips no more than the peer, where both were tuned to
/// equal dips on the right motor.
pub fn dip(fronts: &RigFronts, own: Tuned<'_>, peer: Tuned<'_>) -> Option<Why> {
    let (with_own, with_peer) = (own.trial()?, peer.trial()?);
    let front = fronts.family(Family::Drive)?.front(Measure::Ripple, true);
    let growth = [(own, &with_own), (peer, &with_peer)]
        .map(|(tuned, with)| with.dip / tuned.tried.figures.dip);
    let mut evidence = all_figures("as tuned", &with_own, &with_peer);
    let equal = front.tunings.iter().rev().find_map(|tried| {
        let figures = Tuned { tried, ..own }.trial()?;
        (figures.dip <= with_peer.dip).then_some((tried, figures))
    });
    let equal = match equal {
        Some((tried, figures)) => {
            evidence.extend(all_figures("at the peer's dip", &figures, &with_peer));
            format!(
                "{} dips by {:.2} there, no more than the peer, and ripples by {} against {} mV",
                tried.tuning,
                figures.dip,
                short(Some(1e3 * figures.ripple)),
                short(Some(1e3 * with_peer.ripple)),
            )
        }
        None => "no tuning dips as little there".to_owned(),
    };
    let because = format!(
        "the error makes the dip {:.2} times what it was, the peer's {:.2} times; {equal}",
        growth[0], growth[1]
    );
    Some(Why { because, evidence })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn every_sensor_is_in_its_place() {
        for (index, sensors) in OtherSensors::ALL.into_iter().enumerate() {
            assert_eq!(sensors as usize, index, "{}", sensors.name());
        }
    }

    #[test]
    fn reasons_are_joined() {
        let why = |because: &str| Some(Why { because: because.to_owned(), ..Why::default() });
        let joined = |first, second| Why::both(first, second).map(|why| why.because);
        assert_eq!(joined(why("a"), why("b")).as_deref(), Some("a; b"));
        assert_eq!(joined(None, why("b")).as_deref(), Some("b"));
        assert_eq!(joined(None, None), None);
    }

    #[test]
    fn a_side_is_missed_where_it_is_worse() {
        let peer = LoadStepFigures {
            dip: 1.0,
            recovery: 6e-3,
            ripple: 5e-3,
            voltage_step: 1e-3,
            steady_error: 5e-3,
            peak_current: 1.5,
        };
        assert_eq!(Side::missed(&peer, &peer), []);
        let own = LoadStepFigures { recovery: 7e-3, peak_current: 1.52, ..peer };
        assert_eq!(
            Side::missed(&own, &peer),
            [Side::Recovery],
            "1.3 % more current counts as equal"
        );
        let own = LoadStepFigures { peak_current: 1.54, steady_error: 6e-3, ..peer };
        assert_eq!(Side::missed(&own, &peer), [Side::PeakCurrent, Side::SteadyError]);
    }
}
