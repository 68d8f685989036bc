//! The fault campaign: what breaks on or around the emulated board, how soon the bridge is off and what the firmware tells of it; and what must
//! change nothing.
//!
//! - `trips.rs`: the bridge is off within a bound, stays off until the fault is cleared, and drives again afterwards;
//! - `stores.rs`: parameters in flash, damaged or cut off while they are saved;
//! - `holds.rs`: the motor runs on as if nothing were.

mod bench;
mod holds;
mod stores;
mod trips;

use super::{PERIOD, setup};
use crate::scenario::Scenario;
use crate::terminal::{short, table};
use anyhow::Result;
use bench::Bench;
use quasidrive::fault::{Fault, Faults};
use quasidrive::supervisor::Mode;
use rayon::prelude::*;
use serde::Serialize;
use std::path::Path;
use virtual_board::Image;

/// What a case found.
#[derive(Clone, Debug, Serialize)]
pub struct Outcome {
    /// Its name.
    pub name: String,
    /// What must be, in words.
    pub demand: String,
    /// Longest time from the fault until the bridge is off (PWM periods), where there is one.
    pub bound: Option<f64>,
    /// The time that it took.
    pub off_after: Option<f64>,
    /// What was found, in words: faults that were told, disturbances.
    pub found: String,
    /// Why the case failed, if it did.
    pub failure: Option<String>,
}

/// What a case measured, whether or not it is what is demanded.
#[derive(Default)]
struct Finding {
    /// Time from the fault until the bridge was off (s).
    off_after: Option<f64>,
    /// What the drive told.
    told: Faults,
    found: String,
    failure: Option<String>,
}

type Play = Box<dyn Fn(&Stand) -> Result<Finding> + Send + Sync>;

/// A case of the campaign.
struct Case {
    name: &'static str,
    demand: String,
    /// Longest time until the bridge is off (s).
    bound: Option<f64>,
    play: Play,
}

impl Case {
    /// Plays it. Gives the faults that the drive told, too.
    fn run(&self, stand: &Stand) -> (Outcome, Faults) {
        let finding = (self.play)(stand).unwrap_or_else(|error| Finding {
            failure: Some(format!("{error:#}")),
            ..Finding::default()
        });
        let outcome = Outcome {
            name: self.name.to_owned(),
            demand: self.demand.clone(),
            bound: self.bound.map(|bound| bound / PERIOD),
            off_after: finding.off_after.map(|time| time / PERIOD),
            found: finding.found,
            failure: finding.failure,
        };
        (outcome, finding.told)
    }
}

/// What a case has other than the campaign.
type Edit = fn(&mut Scenario);

/// What every case starts from: the image, and a flash that holds the scenario's parameters.
struct Stand {
    image: Image,
    scenario: Scenario,
    /// Before and after parameters were saved.
    blank: Vec<u8>,
    saved: Vec<u8>,
}

impl Stand {
    fn new(image: Image) -> Result<Self> {
        let file = Path::new("esc1.toml");
        let mut scenario = Scenario::parse(include_str!("../../../scenarios/esc1.toml"), file)?;
        scenario.load = crate::profile::Load::default();
        // A motor without any load does not mind an open lead, nor does anybody see it.
        scenario.motor.coulomb_friction = 0.02;
        scenario.protection.command_timeout = 0.3;
        scenario.protection.stop_time = 0.5;
        let mut bench = Bench::new(&image, &scenario, None)?;
        let blank = bench.emulated.board().flash();
        setup::configure(&scenario, file, &mut bench.client)?;
        bench.save()?;
        let saved = bench.emulated.board().flash();
        Ok(Self { image, scenario, blank, saved })
    }

    /// A board that is ready.
    fn ready(&self) -> Result<Bench> {
        Bench::new(&self.image, &self.scenario, Some(&self.saved))
    }

    /// A board whose motor turns at a speed (rad/s), and has done so for a while.
    fn running(&self, speed: f32) -> Result<Bench> {
        let mut bench = self.ready()?;
        bench.start(speed)?;
        Ok(bench)
    }

    /// The same with parameters of a scenario that is edited.
    fn running_with(&self, speed: f32, edit: Edit) -> Result<Bench> {
        let mut scenario = self.scenario.clone();
        edit(&mut scenario);
        let mut bench = Bench::new(&self.image, &scenario, Some(&self.saved))?;
        setup::configure(&scenario, Path::new("the campaign's"), &mut bench.client)?;
        setup::wait_for(&bench.emulated, &mut bench.client, Mode::Ready)?;
        bench.start(speed)?;
        Ok(bench)
    }
}

/// Plays every case whose name contains `only`, in parallel. `each` is called when one is done. If all are played, every fault of the list
/// must have been told in one or another.
pub fn run(image: Image, only: Option<&str>, each: impl Fn() + Sync) -> Result<Vec<Outcome>> {
    let stand = Stand::new(image)?;
    let cases: Vec<Case> = cases(only).collect();
    let played = cases.par_iter().map(|case| {
        let played = case.run(&stand);
        each();
        played
    });
    let (mut outcomes, told): (Vec<_>, Vec<_>) = played.collect();
    if only.is_none() {
        outcomes.push(whole_list(&told));
    }
    Ok(outcomes)
}

/// Whether the cases together have made the firmware tell every fault that there is.
fn whole_list(told: &[Faults]) -> Outcome {
    let is_told = |fault: Fault| told.iter().any(|faults| faults.contains(fault));
    let expected = Fault::ALL.into_iter().filter(|fault| *fault != IMPOSSIBLE);
    let missing: Vec<_> = expected.filter(|fault| !is_told(*fault)).map(numbered).collect();
    Outcome {
        name: "the list of faults as a whole".to_owned(),
        demand: format!("each told in some case, but {}: codes are numbers", numbered(IMPOSSIBLE)),
        bound: None,
        off_after: None,
        found: format!("{} told", Fault::ALL.into_iter().filter(|fault| is_told(*fault)).count()),
        failure: (!missing.is_empty()).then(|| format!("never told: {}", missing.join(", "))),
    }
}

/// The fault that no case makes: this board's samples are codes, which always hold a number and are always of the drive's kind.
const IMPOSSIBLE: Fault = Fault::BadSample;

fn numbered(fault: Fault) -> String {
    format!("{} {fault}", fault as u8)
}

/// How many cases there are whose name contains `only`.
pub fn count(only: Option<&str>) -> usize {
    cases(only).count()
}

fn cases(only: Option<&str>) -> impl Iterator<Item = Case> {
    let all = trips::cases().into_iter().chain(stores::cases()).chain(holds::cases());
    all.filter(move |case| only.is_none_or(|part| case.name.contains(part)))
}

/// The outcomes as a table.
pub fn text(outcomes: &[Outcome]) -> String {
    let header = ["", "case", "off after (periods)", "bound", "found", "demanded"];
    let mut table = table(header.map(str::to_owned).to_vec(), 2);
    table.set_content_arrangement(comfy_table::ContentArrangement::Dynamic).set_width(170);
    for column in [4, 5] {
        if let Some(column) = table.column_mut(column) {
            column.set_cell_alignment(comfy_table::CellAlignment::Left);
        }
    }
    for outcome in outcomes {
        let sign = if outcome.failure.is_some() { "FAILED" } else { "ok" };
        let bound = outcome.bound.map_or("–".to_owned(), |bound| short(Some(bound)));
        let off = outcome.off_after.map_or("–".to_owned(), |off| short(Some(off)));
        let found = match &outcome.failure {
            Some(failure) if outcome.found.is_empty() => failure.clone(),
            Some(failure) => format!("{failure}; {}", outcome.found),
            None => outcome.found.clone(),
        };
        table.add_row([sign, &outcome.name, &off, &bound, &found, &outcome.demand]);
    }
    table.to_string()
}
