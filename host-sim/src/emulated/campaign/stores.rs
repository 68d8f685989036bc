//! Parameters in flash, damaged or cut off while they are saved.

use super::bench::Bench;
use super::{Case, Finding, Result, Stand};
use crate::assignment::{Assignment, Setting};
use crate::client::Client;
use crate::connect::in_words;
use anyhow::ensure;
use quasidrive::fault::Fault;
use quasidrive::link::message::Request;
use quasidrive::supervisor::{Command, Mode};
use std::ops::Range;

/// A parameter that tells one set from another.
const MARK: &str = "protection.temperature";

/// When power goes, after the request to save (s): through erasing, which takes 22 ms a page, and writing.
const CUTS: [f64; 12] =
    [0.3e-3, 1e-3, 2e-3, 4e-3, 8e-3, 12e-3, 16e-3, 20e-3, 24e-3, 28e-3, 34e-3, 60e-3];

pub fn cases() -> Vec<Case> {
    let damaged = |name, damage: fn(&mut virtual_board::chip::Cells, usize)| Case {
        name,
        demand: format!(
            "off from the start, the built-in parameters in force; {} {}",
            Fault::BadParameters as u8,
            Fault::BadParameters
        ),
        bound: None,
        play: Box::new(move |stand| damaged(stand, damage)),
    };
    vec![
        damaged("bits flipped in saved parameters", |cells, offset| {
            let byte = cells.bytes()[offset];
            cells.store(offset, &[byte ^ 0x10]);
        }),
        damaged("saved parameters unreadable", |cells, offset| {
            let byte = cells.bytes()[offset];
            cells.store(offset, &[byte ^ 0x11]);
            cells.break_at(offset);
        }),
        Case {
            name: "power cut while saving",
            demand: format!(
                "the old parameters or the new ones after each of {} cuts, no fault; some of each",
                CUTS.len()
            ),
            bound: None,
            play: Box::new(power_cuts),
        },
    ]
}

/// Where saving has changed the flash.
fn saved_place(stand: &Stand) -> Option<Range<usize>> {
    let is_changed = |at: &usize| stand.blank[*at] != stand.saved[*at];
    let start = (0..stand.saved.len()).find(is_changed)?;
    Some(start..(0..stand.saved.len()).rfind(is_changed)? + 1)
}

fn mark(client: &mut Client) -> Result<Setting> {
    let parameters = client.parameters()?;
    let found = parameters.into_iter().find(|(name, _)| name == MARK);
    found.map(|(_, setting)| setting).ok_or_else(|| anyhow::anyhow!("no {MARK}"))
}

fn damaged(stand: &Stand, damage: fn(&mut virtual_board::chip::Cells, usize)) -> Result<Finding> {
    let place = saved_place(stand).ok_or_else(|| anyhow::anyhow!("nothing was saved"))?;
    let built_in = {
        let mut bench = Bench::new(&stand.image, &stand.scenario, None)?;
        bench.client.parameters()?
    };
    let mut finding = Finding::default();
    // At the beginning, in the middle and at the end of what was saved.
    for share in [0.3, 0.5, 0.95] {
        let at = place.start + (share * place.len() as f64) as usize;
        let emulated = Bench::powered(&stand.image, &stand.scenario, Some(&stand.saved));
        emulated.board().change_flash(|cells| damage(cells, at));
        emulated.run(0.2)?;
        let mut bench = Bench { client: emulated.client()?, emulated };
        let status = bench.client.status()?;
        finding = Finding { told: status.faults, found: in_words(&status), ..Finding::default() };
        ensure!(
            status.mode == Mode::Faulted && status.faults.iter().eq([Fault::BadParameters]),
            "damage at {at:#x}: {}",
            finding.found
        );
        ensure!(bench.client.parameters()? == built_in, "other parameters are in force");
        bench.is_refused(20e-3)?;
        ensure!(bench.is_off() && bench.off_since() == 0.0, "the bridge was on");
        bench.client.command(Command::Clear)?;
        crate::emulated::setup::wait_for(&bench.emulated, &mut bench.client, Mode::Ready)?;
        let misuse = bench.misuse();
        ensure!(misuse.is_none(), "{misuse:?}");
    }
    Ok(finding)
}

fn power_cuts(stand: &Stand) -> Result<Finding> {
    let new = Setting::Number(61.0);
    let change: Assignment = (MARK.to_owned(), new.clone());
    let (mut olds, mut news) = (0, 0);
    for cut in CUTS {
        let mut bench = stand.ready()?;
        let old = mark(&mut bench.client)?;
        bench.client.change([&change])?;
        crate::emulated::setup::wait_for(&bench.emulated, &mut bench.client, Mode::Ready)?;
        send(&bench, Request::SaveParameters)?;
        bench.emulated.run(cut)?;
        bench.emulated.board().power_cut();
        bench.emulated.run(1.0)?;
        bench.emulated.board().power_up();
        bench.emulated.run(0.2)?;
        let status = bench.reconnect()?;
        ensure!(
            status.mode == Mode::Ready && status.faults.is_empty(),
            "cut after {cut} s: {}",
            in_words(&status)
        );
        let found = mark(&mut bench.client)?;
        ensure!(found == old || found == new, "cut after {cut} s: {MARK} is {found}");
        if found == new {
            news += 1;
        } else {
            olds += 1;
        }
        ensure!(bench.is_off(), "the bridge was on");
    }
    ensure!(olds > 0 && news > 0, "the cuts are too early or too late: {olds} old, {news} new");
    Ok(Finding {
        found: format!("{olds} times the old, {news} times the new"),
        ..Finding::default()
    })
}

/// Sends a request without waiting for its answer.
fn send(bench: &Bench, request: Request) -> Result<()> {
    use quasidrive::link::frame::{LONGEST, encode};
    let mut buffer = [0; LONGEST];
    let numbered = quasidrive::link::message::Numbered { sequence: 1, request };
    let frame = encode(&numbered, &mut buffer).ok_or_else(|| anyhow::anyhow!("too long"))?;
    bench.emulated.board().send(frame);
    Ok(())
}
