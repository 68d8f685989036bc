//! The fronts of the drive form and its searched peers, rig by rig.

use super::motors::Machine;
use super::rig::Rig;
use super::search::{Effort, Family, Front, Measure, Tried, search};
use crate::sensors::ReadsName;
use indicatif::ProgressBar;
use serde::Serialize;

/// The fronts on one rig.
#[derive(Clone, Debug, Serialize)]
pub struct RigFronts {
    /// Motor.
    pub motor: &'static str,
    /// Counts of the encoder.
    pub counts: u32,
    /// Reads of it that count.
    pub reads: ReadsName,
    /// What was found.
    pub families: Vec<Searched>,
    /// Both, and the motor's parameters.
    #[serde(skip)]
    pub rig: Rig,
}

/// What a search found.
#[derive(Clone, Debug, Serialize)]
pub struct Searched {
    /// Who.
    pub family: Family,
    /// Tunings that were tried.
    pub tried: usize,
    /// Those of them that run, and that no admissible one beats in everything.
    #[serde(skip)]
    pub found: Vec<Tried>,
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
        Front::of(&self.found, measure, admissible)
    }
}

impl RigFronts {
    /// A family's.
    pub fn family(&self, family: Family) -> Option<&Searched> {
        self.families.iter().find(|searched| searched.family == family)
    }
}

fn search_rig(rig: Rig, effort: Effort, bar: &ProgressBar) -> RigFronts {
    let families = Family::ALL.map(|family| {
        let found = search(family, &rig, effort, || bar.inc(1));
        let fronts = Measure::ALL.map(|measure| {
            let front = Front::of(&found, measure, true);
            MeasuredFront { measure, tunings: front.tunings.into_iter().cloned().collect() }
        });
        Searched { family, tried: effort.tunings(family), found, fronts: fronts.to_vec() }
    });
    RigFronts {
        motor: rig.machine.name,
        counts: rig.counts,
        reads: rig.reads,
        families: families.to_vec(),
        rig,
    }
}

/// The rigs that are searched: every encoder with 16 reads, at their times and shifted, and two of them with one read, which is
/// what the targets compare with; then every other motor.
fn rigs(quick: bool) -> Vec<Rig> {
    use ReadsName::{All, Last, Shifted};
    let with = |machine, counts, reads: &'static [ReadsName]| {
        reads.iter().map(move |&reads| Rig { machine, counts, reads, ..Rig::REFERENCE })
    };
    let paper = |counts, reads| with(Machine::PAPER, counts, reads);
    let mut rigs: Vec<Rig> =
        [4096, 1024].into_iter().flat_map(|counts| paper(counts, &[All, Shifted, Last])).collect();
    if !quick {
        rigs.extend([512, 16384].into_iter().flat_map(|counts| paper(counts, &[All, Shifted])));
        let motors = Machine::ALL[1..].iter();
        rigs.extend(motors.flat_map(|&machine| with(machine, 4096, &[All, Shifted])));
    }
    rigs
}

/// Searches every family on every rig.
pub fn search_all(quick: bool, progress: &dyn Fn(u64) -> ProgressBar) -> Vec<RigFronts> {
    let effort = if quick {
        Effort { first: 64, then: 96, seeds: 1 }
    } else {
        Effort { first: 160, then: 400, seeds: 3 }
    };
    let rigs = rigs(quick);
    let each: usize = Family::ALL.iter().map(|&family| effort.tunings(family)).sum();
    let bar = progress((rigs.len() * each) as u64);
    let fronts = rigs.into_iter().map(|rig| search_rig(rig, effort, &bar)).collect();
    bar.finish_and_clear();
    fronts
}
