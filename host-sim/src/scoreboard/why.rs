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
        let (Some(mut first), Some(second)) = (first.clone(), second.clone()) else {
            return first.or(second);
        };
        first.because = format!("{}; {}", first.because, second.because);
        first.evidence.extend(second.evidence);
        Some(first)
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

    /// The share of the ripple's power that other sensors take away (%), in words: powers add up where parts are independent.
    fn taken_away(&self, sensors: OtherSensors) -> String {
        let power = |sensors| Some(self.with(sensors)?.ripple.powi(2));
        let both = power(OtherSensors::Same).zip(power(sensors));
        both.map_or("?".to_owned(), |(same, left)| format!("{:.0} %", 100.0 * (1.0 - left / same)))
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

/// Ripple in parts: what is slower than 1 ms and what is not, and what is left of each with other sensors.
pub fn ripple(own: Tuned<'_>, peer: Tuned<'_>) -> Why {
    let (own, peer) = (WithSensors::of(own), WithSensors::of(peer));
    let evidence = [
        evidence("slow ripple [mV]", &own, Some(&peer), |at| 1e3 * at.slow_ripple),
        evidence("fast ripple [mV]", &own, Some(&peer), |at| 1e3 * at.fast_ripple),
    ]
    .concat();
    let same = own.with(OtherSensors::Same).zip(peer.with(OtherSensors::Same));
    let because = same.map_or("one of them does not run".to_owned(), |(a, b)| {
        let slow = |at: &LoadStepFigures| {
            let [slow, fast] = [at.slow_ripple, at.fast_ripple].map(|part| part * part);
            100.0 * slow / (slow + fast)
        };
        let both = |sensors| {
            format!("{} (peer: {})", own.taken_away(sensors), peer.taken_away(sensors))
        };
        format!(
            "{:.0} % of the ripple's power (peer: {:.0} %) is slower than 1 ms, and there it is 1/{:.2} of the peer's; in the rest 1/{:.2}. \
             Of the power 65536 counts take away {}, shifted reads {}, exact sensors {}",
            slow(a),
            slow(b),
            b.slow_ripple / a.slow_ripple,
            b.fast_ripple / a.fast_ripple,
            both(OtherSensors::FinestEncoder),
            both(OtherSensors::ShiftedReads),
            both(OtherSensors::Exact),
        )
    });
    Why { because, evidence }
}

/// Why the drive form has no admissible tuning at a dip (rad/s): what the calmest of those that dip so little misses.
pub fn no_tuning(fronts: &RigFronts, dip: f64) -> Option<Why> {
    let searched = fronts.family(Family::Drive)?;
    let quick = searched.found.iter().filter(|tried| tried.figures.dip <= 1.02 * dip);
    let Some(tried) = quick.max_by(|a, b| a.figures.dip.total_cmp(&b.figures.dip)) else {
        let because = format!("no position of the knob that runs dips by {dip:.1} rad/s or less");
        return Some(Why { because, ..Why::default() });
    };
    let tuned = Tuned::of(fronts, tried);
    let at = format!("at dip {:.2} ({})", tried.figures.dip, tried.tuning);
    match tried.misses? {
        Requirement::Recovery => Some(Why {
            because: format!("{at} it recovers in {:.1} ms, not 12", 1e3 * tried.figures.recovery),
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
                "{at} its steady error is {} rad/s, {LARGEST_STEADY_ERROR} allowed: {} at {speed:.0} rad/s, {} or less at the other \
                 speeds. With shifted reads {}, 65536 counts {}, exact sensors {} rad/s",
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

fn dip_and_ripple(what: &str, own: &LoadStepFigures, peer: &LoadStepFigures) -> Vec<Evidence> {
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

/// What the drive form trades for the sides that it misses: its tuning at the peer's ripple, and the one of least ripple that misses
/// none of them.
pub fn sides(fronts: &RigFronts, missed: &[Side], own: Tuned<'_>, peer: Tuned<'_>) -> Option<Why> {
    if missed.is_empty() {
        return None;
    }
    let front = fronts.family(Family::Drive)?.front(Measure::Ripple, true);
    let figures = &peer.tried.figures;
    let mut rows = dip_and_ripple("at the same dip", &own.tried.figures, figures);
    let mut parts = Vec::new();
    if let Some(equal) = front.tuning_of_ripple(figures.ripple) {
        rows.extend(dip_and_ripple("at the peer's ripple or less", &equal.figures, figures));
        let still = Side::missed(&equal.figures, figures);
        parts.push(format!(
            "at the peer's ripple it dips by {:.2} against {:.2} rad/s, recovers in {:.1} against {:.1} ms and {}",
            equal.figures.dip,
            figures.dip,
            1e3 * equal.figures.recovery,
            1e3 * figures.recovery,
            if still.is_empty() { "is worse in nothing".to_owned() } else { format!("is worse in {}", names(&still)) },
        ));
    }
    let none_missed = front
        .tunings
        .iter()
        .rev()
        .find(|tried| missed.iter().all(|side| side.held(&tried.figures, figures)));
    parts.push(match none_missed {
        Some(tried) => {
            rows.extend(dip_and_ripple("where nothing is missed", &tried.figures, figures));
            format!(
                "no worse in {} from dip {:.2} on ({}), where the ripple is {} against {} mV",
                names(missed),
                tried.figures.dip,
                tried.tuning,
                short(Some(1e3 * tried.figures.ripple)),
                short(Some(1e3 * figures.ripple)),
            )
        }
        None => format!("at no dip is it as good in {}", names(missed)),
    });
    if missed.contains(&Side::SteadyError) {
        let (own, peer) = (WithSensors::of(own), WithSensors::of(peer));
        let read = |at: &LoadStepFigures| at.steady_error;
        rows.extend(evidence("steady error [rad/s]", &own, Some(&peer), read));
    }
    Some(Why { because: parts.join("; "), evidence: rows })
}

fn names(sides: &[Side]) -> String {
    sides.iter().map(|side| side.name()).collect::<Vec<_>>().join(" and ")
}

/// With wrong parameters: the drive form's tuning of least ripple that dips no more than the peer, where both were tuned to equal dips
/// on the right motor.
pub fn dip(fronts: &RigFronts, own: Tuned<'_>, peer: Tuned<'_>) -> Option<Why> {
    let (with_own, with_peer) = (own.trial()?, peer.trial()?);
    let front = fronts.family(Family::Drive)?.front(Measure::Ripple, true);
    let growth = [(own, &with_own), (peer, &with_peer)]
        .map(|(tuned, with)| with.dip / tuned.tried.figures.dip);
    let mut evidence = dip_and_ripple("as tuned", &with_own, &with_peer);
    let equal = front.tunings.iter().rev().find_map(|tried| {
        let figures = Tuned { tried, ..own }.trial()?;
        (figures.dip <= with_peer.dip).then_some((tried, figures))
    });
    let equal = match equal {
        Some((tried, figures)) => {
            evidence.extend(dip_and_ripple("at the peer's dip", &figures, &with_peer));
            format!(
                "{} dips by {:.2} there and ripples by {} against {} mV",
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
