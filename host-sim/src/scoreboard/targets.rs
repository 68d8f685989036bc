//! What is asked of the drive form, and what became of it.

use super::TARGET_DIP;
use super::cases::Case;
use super::fronts::{RigFronts, Searched};
use super::motors::Machine;
use super::rig::{Errors, Rig};
use super::search::{Family, Measure, Tried};
use super::why::{self, Side, Tuned, Why};
use crate::sensors::ReadsName;
use rayon::prelude::*;
use serde::Serialize;

/// A target and what was measured.
#[derive(Clone, Debug, Serialize)]
pub struct Target {
    /// What is asked.
    pub asked: String,
    /// What was measured.
    pub measured: String,
    /// Whether it is met; nothing where it cannot be told.
    pub met: Option<bool>,
    /// Why it is missed, where it is.
    pub why: Option<Why>,
}

/// Ratios that the targets ask for: counts, reads of the drive form and of the peer, and what the drive form's ripple over PI's
/// may be. The targets name no shifted reads; they are held against a PI without, to which shifting does harm.
const RATIOS: [(u32, ReadsName, ReadsName, f64); 6] = {
    use ReadsName::{All, Last, Shifted};
    [
        (4096, All, Last, 1.0 / 15.0),
        (4096, All, All, 1.0 / 3.0),
        (4096, Shifted, All, 1.0 / 3.0),
        (1024, All, Last, 1.0 / 10.0),
        (1024, All, All, 1.0 / 2.5),
        (1024, Shifted, All, 1.0 / 2.5),
    ]
};

/// Searched peers, in the order they are shown.
const PEERS: [Family; 2] = [Family::Pi, Family::Ladrc];

/// Judges every target on what was searched.
pub fn judge(fronts: &[RigFronts]) -> Vec<Target> {
    let find = |counts, reads| {
        fronts
            .iter()
            .find(|at| (at.motor, at.counts, at.reads) == (Machine::PAPER.name, counts, reads))
    };
    let mut targets = Vec::new();
    for (counts, own, peers, asked) in RATIOS {
        if let (Some(own), Some(peers)) = (find(counts, own), find(counts, peers)) {
            targets.extend(Measure::ALL.map(|measure| ratio_target(own, peers, measure, asked)));
        }
    }
    for own in fronts.iter().filter(|at| at.reads != ReadsName::Last) {
        let beside = (own.motor, own.counts, ReadsName::All);
        let Some(peers) = fronts.iter().find(|at| (at.motor, at.counts, at.reads) == beside) else {
            continue;
        };
        for family in PEERS {
            targets.extend(Measure::ALL.map(|measure| front_target(own, peers, family, measure)));
            targets.push(side_target(own, peers, family));
        }
    }
    let targeted = |at: &&RigFronts| (at.counts, at.reads) == (4096, ReadsName::All);
    targets.extend(fronts.iter().filter(targeted).flat_map(error_targets));
    targets
}

/// The admissible tuning of least ripple at the dip of the targets; where there is none, the stable one.
fn at_target(fronts: &RigFronts, family: Family, measure: Measure) -> Option<&Tried> {
    let searched = fronts.family(family)?;
    let at = |admissible| searched.front(measure, admissible).tuning_at(TARGET_DIP);
    at(true).or_else(|| at(false))
}

/// The ripple of the drive form over that of the best PI.
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
    let why = || match drive {
        None => why::no_tuning(own, TARGET_DIP),
        Some(_) => Some(why::ripple(
            Tuned::of(own, at_target(own, Family::Drive, measure)?),
            Tuned::of(peers, at_target(peers, Family::Pi, measure)?),
        )),
    };
    Target {
        asked: format!(
            "{} counts, {} reads, PI with {}, {}: 1/{:.1}",
            own.counts,
            own.reads.label(),
            peers.reads.label(),
            measure.name(),
            1.0 / asked
        ),
        measured,
        met,
        why: (met == Some(false)).then(why).flatten(),
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
fn front_target(own: &RigFronts, peers: &RigFronts, family: Family, measure: Measure) -> Target {
    let front_of = |searched: Option<_>| searched.map(|at: &Searched| at.front(measure, true));
    let fronts_of_both = front_of(own.family(Family::Drive)).zip(front_of(peers.family(family)));
    let (mut compared, mut below) = (0, 0);
    let mut ratios: Vec<(f64, f64)> = Vec::new();
    let mut missing = None;
    if let Some((drive, peer)) = &fronts_of_both {
        for dip in dips() {
            let Some(peer) = peer.ripple_at(dip) else { continue };
            compared += 1;
            match drive.ripple_at(dip) {
                Some(drive) => {
                    below += u32::from(drive < peer);
                    ratios.push((peer / drive, dip));
                }
                None => missing = Some(dip),
            }
        }
    }
    ratios.sort_by(|a, b| a.0.total_cmp(&b.0));
    let measured = match ratios[..] {
        _ if compared == 0 => "the peer has no admissible tuning".to_owned(),
        [] => format!("at none of {compared} dips: the drive form has no admissible tuning"),
        [(least, dip), .., (most, _)] => {
            format!("at {below} of {compared} dips; 1/{least:.2} (at {dip:.1}) to 1/{most:.2}")
        }
        [(only, dip)] => format!("at {below} of {compared} dips; 1/{only:.2} (at {dip:.1})"),
    };
    let why = || {
        let above = || {
            let &(_, dip) = ratios.first().filter(|(ratio, _)| *ratio <= 1.0)?;
            let (drive, peer) = fronts_of_both.as_ref()?;
            let (drive, peer) = (drive.tuning_at(dip)?, peer.tuning_at(dip)?);
            let ripple = why::ripple(Tuned::of(own, drive), Tuned::of(peers, peer));
            Why::both(why::no_calmer(own, dip), Some(ripple))
        };
        Why::both(missing.and_then(|dip| why::no_tuning(own, dip)), above())
    };
    let met = (compared > 0).then_some(below == compared);
    Target {
        asked: format!("{}: front below that of {} in {}", on(own), family.name(), measure.name()),
        measured,
        met,
        why: (met == Some(false)).then(why).flatten(),
    }
}

fn on(own: &RigFronts) -> String {
    format!("{}, {} counts, {} reads", own.motor, own.counts, own.reads.label())
}

/// The admissible tuning of least ripple at the dip of the targets.
fn of_least_ripple(fronts: &RigFronts, family: Family) -> Option<&Tried> {
    fronts.family(family)?.front(Measure::Ripple, true).tuning_at(TARGET_DIP)
}

/// Peak current, recovery and steady error at the dip of the targets, beside the peer's tuning of least ripple.
fn side_target(own: &RigFronts, peers: &RigFronts, family: Family) -> Target {
    let asked = format!(
        "{}: no more peak current, recovery and steady error than {} at dip {TARGET_DIP:.1}",
        on(own),
        family.name()
    );
    let (measured, met, why) =
        match (of_least_ripple(own, Family::Drive), of_least_ripple(peers, family)) {
            (Some(drive), Some(peer)) => {
                let missed = Side::missed(&drive.figures, &peer.figures);
                let (own_figures, peer_figures) = (&drive.figures, &peer.figures);
                let measured = format!(
                    "{:.3} against {:.3} A, {:.2} against {:.2} ms, {:.4} against {:.4} rad/s",
                    own_figures.peak_current,
                    peer_figures.peak_current,
                    1e3 * own_figures.recovery,
                    1e3 * peer_figures.recovery,
                    own_figures.steady_error,
                    peer_figures.steady_error
                );
                let why = why::sides(own, &missed, Tuned::of(own, drive), Tuned::of(peers, peer));
                (measured, Some(missed.is_empty()), why)
            }
            (None, _) => (
                "the drive form has no admissible tuning there".to_owned(),
                Some(false),
                why::no_tuning(own, TARGET_DIP),
            ),
            (_, None) => ("the peer has no admissible tuning there".to_owned(), None, None),
        };
    Target { asked, measured, met, why }
}

/// With each parameter wrong by itself: the drive form's ripple below, and its dip not above, that of PI, both as tuned for
/// the dip of the targets on the right motor.
fn error_targets(fronts: &RigFronts) -> Vec<Target> {
    let Some(own) = of_least_ripple(fronts, Family::Drive) else {
        return vec![Target {
            asked: format!(
                "{}, every parameter error: below PI's ripple and voltage step, dip no larger",
                fronts.motor
            ),
            measured: "the drive form has no admissible tuning there".to_owned(),
            met: Some(false),
            why: why::no_tuning(fronts, TARGET_DIP),
        }];
    };
    let Some(peer) = of_least_ripple(fronts, Family::Pi) else { return Vec::new() };
    let wrong = Case::all().into_iter().filter(|case| case.rig.errors != Errors::NONE);
    let judge = |case: Case| {
        let rig = Rig { errors: case.rig.errors, ..fronts.rig };
        let [own, peer] = [own, peer].map(|tried| Tuned { rig, tried });
        let (measured, met, why) = match (own.trial(), peer.trial()) {
            (Some(a), Some(b)) => {
                let quieter = a.ripple < b.ripple && a.voltage_step < b.voltage_step;
                let met = quieter && a.dip <= 1.02 * b.dip;
                let measured = format!(
                    "ripple {}, voltage step {}, dip {:.2} against {:.2} rad/s",
                    ratio_in_words(a.ripple, b.ripple),
                    ratio_in_words(a.voltage_step, b.voltage_step),
                    a.dip,
                    b.dip
                );
                let why = || {
                    let dip = (a.dip > 1.02 * b.dip).then(|| why::dip(fronts, own, peer));
                    Why::both(dip.flatten(), (!quieter).then(|| why::ripple(own, peer)))
                };
                (measured, Some(met), (!met).then(why).flatten())
            }
            _ => ("one of them does not run".to_owned(), None, None),
        };
        Target {
            asked: format!(
                "{}, {}: below PI's ripple and voltage step, dip no larger",
                fronts.motor, case.name
            ),
            measured,
            met,
            why,
        }
    };
    wrong.collect::<Vec<_>>().into_par_iter().map(judge).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scoreboard::search::{Effort, search};

    /// The drive form against itself under PI's name: no ratio, and at every dip no less ripple.
    #[test]
    fn what_is_missed_has_a_measured_reason() {
        let effort = Effort { first: 0, then: 0, seeds: 0 };
        let found = search(Family::Drive, &Rig::REFERENCE, effort, || ());
        let searched =
            |family| Searched { family, tried: 0, found: found.clone(), fronts: Vec::new() };
        let fronts = RigFronts {
            motor: Rig::REFERENCE.machine.name,
            counts: Rig::REFERENCE.counts,
            reads: Rig::REFERENCE.reads,
            families: [Family::Drive, Family::Pi].map(searched).to_vec(),
            rig: Rig::REFERENCE,
        };
        let ratio = ratio_target(&fronts, &fronts, Measure::Ripple, 1.0 / 3.0);
        assert_eq!(ratio.met, Some(false), "{ratio:?}");
        let why = ratio.why.expect("missed");
        assert!(why.because.contains("65536 counts leave"), "{}", why.because);
        let measured = |what: &str| {
            let evidence = why.evidence.iter().find(|at| at.what == what).expect("measured");
            assert_eq!(evidence.own, evidence.peer, "{what}");
            evidence.own.expect("measured")
        };
        // The slow part is the encoder's: 5 mV as it is, a fifth with 16 times the counts, nothing without it.
        let slow = measured("slower ripple [mV], as searched");
        assert!((4.0..6.0).contains(&slow), "{slow} mV");
        assert!(measured("slower ripple [mV], 65536 counts") < 0.3 * slow);
        assert!(measured("slower ripple [mV], exact sensors") < 0.05 * slow);
        assert!(measured("slower ripple [mV], edges misplaced by 0.05 counts rms") > 2.0 * slow);
        let front = front_target(&fronts, &fronts, Family::Pi, Measure::Ripple);
        assert_eq!(front.met, Some(false), "{front:?}");
        assert!(front.measured.starts_with("at 0 of") && front.why.is_some(), "{front:?}");
        let side = side_target(&fronts, &fronts, Family::Pi);
        assert!(side.met == Some(true) && side.why.is_none(), "{side:?}");
        let end = why::no_tuning(&fronts, 0.1).expect("none there").because;
        assert!(end.contains("no position of the knob"), "{end}");
    }

    #[test]
    fn a_missing_tuning_is_put_down_to_the_requirement_that_it_misses() {
        let rig = Rig { counts: 1024, ..Rig::REFERENCE };
        let effort = Effort { first: 0, then: 0, seeds: 0 };
        let found = search(Family::Drive, &rig, effort, || ());
        let drive = Searched { family: Family::Drive, tried: 0, found, fronts: Vec::new() };
        let first = drive.front(Measure::Ripple, true).tunings[0].figures.dip;
        assert!((0.8..0.95).contains(&first), "{first} rad/s");
        let fronts = RigFronts {
            motor: rig.machine.name,
            counts: rig.counts,
            reads: rig.reads,
            families: vec![drive],
            rig,
        };
        let why = why::no_tuning(&fronts, 0.8).expect("none there");
        assert!(why.because.contains("its steady error is"), "{}", why.because);
        let steady = |sensors: &str| {
            let what = format!("steady error [rad/s], {sensors}");
            let evidence = why.evidence.iter().find(|at| at.what == what).expect("measured");
            evidence.own.expect("measured")
        };
        assert!(steady("as searched") > 0.03);
        assert!(steady("65536 counts") < 0.003);
    }
}
