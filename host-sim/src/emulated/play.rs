//! Plays a scenario on the emulated board, and measures it.
//!
//! What is true is written down at each sampling instant; what the drive makes of it comes by telemetry, as often as the line carries it. Both meet
//! by the number of the period: the control interrupts are counted, and each belongs to one sampling instant.

use super::{CONTROL, Emulated, PERIOD, setup};
use crate::client::{Client, ClientError};
use crate::frame::Frame;
use crate::metrics::{Meter, Metrics};
use crate::profile::value_at;
use crate::scenario::Scenario;
use crate::wired::Truth;
use crate::wired::drivers::Hazard;
use anyhow::{Context, Result, bail, ensure};
use quasidrive::link::message::{Request, Telemetry};
use quasidrive::parameters::Parameters;
use quasidrive::supervisor::{Command, Mode};
use serde::Serialize;
use std::path::Path;
use std::time::Instant;
use virtual_board::Image;
use virtual_board::chip::Violated;

/// Periods from one telemetry to the next. The firmware's link looks for one about once a millisecond, or 20 periods; more often some are lost.
pub const DECIMATION: u32 = 25;

/// How long the board is played on at once, between two looks at what it sent (s).
const CHUNK: f64 = 10e-3;

/// Where in a period the control interrupt is over for sure: it has missed its update otherwise.
const AFTER_INTERRUPT: f64 = 0.9;

/// The moment (s) in which the clocks are being set up: violations that are over so soon do not count.
const MOMENT: f64 = 20e-6;

/// A scenario, played.
pub struct Played {
    /// Parameters in force.
    pub parameters: Parameters,
    /// When the profiles started (s since power came).
    pub start: f64,
    /// What was true in each period, the first after the start first.
    pub truths: Vec<Truth>,
    /// What telemetry told of some of them, in order, with their places in `truths`.
    pub told: Vec<(usize, Telemetry)>,
    /// The same as frames of a run, times from the start on.
    pub frames: Vec<Frame>,
    /// What there is to tell.
    pub summary: Summary,
}

/// What a played scenario comes to.
#[derive(Clone, Debug, Serialize)]
pub struct Summary {
    /// Figures of merit over the telemetry's periods. What needs every period's signals is missing.
    pub metrics: Metrics,
    /// When (s) and why the drive stopped, if it did.
    pub fault: Option<Faulted>,
    /// Simulated time (s).
    pub duration: f64,
    /// Periods from one telemetry to the next.
    pub decimation: u32,
    /// Telemetry that found no room on the line.
    pub telemetry_lost: u64,
    /// What interrupts cost, while the motor was driven.
    pub interrupts: Vec<Interrupt>,
    /// The most of the stack that was in use at once since power came (bytes).
    pub stack_bytes: usize,
    /// Instructions in a simulated second.
    pub instructions_per_second: f64,
    /// Seconds of this computer for a simulated second.
    pub wall_per_second: f64,
    /// What the firmware did to the bridge that it must not.
    pub hazards: Vec<String>,
    /// What the firmware did that the data sheet forbids.
    pub violations: Vec<String>,
}

impl Summary {
    /// Whether the firmware did something that it must not.
    pub fn is_misused(&self) -> bool {
        !self.hazards.is_empty() || !self.violations.is_empty()
    }
}

/// How a drive stopped.
#[derive(Clone, Debug, Serialize)]
pub struct Faulted {
    /// When the bridge went off (s).
    pub time: f64,
    /// Why, as its status tells it.
    pub fault: String,
}

/// What an interrupt's handler costs.
#[derive(Clone, Debug, Serialize)]
pub struct Interrupt {
    /// Its number (RM0440, vector table).
    pub number: u16,
    /// What it is.
    pub name: &'static str,
    /// How often it comes (Hz).
    pub rate: f64,
    /// Instructions, at least, in the mean and at most.
    pub instructions: [f64; 3],
    /// The same in cycles, by estimate: without wait states, and without the core's entry and exit.
    pub estimated_cycles: [f64; 3],
    /// Mean share of the core's time, by these cycles.
    pub share: f64,
}

/// Plays a scenario on a board that has just been powered. `file` is for messages; `progress` is told the share that is done.
pub fn play(
    image: &Image,
    scenario: &Scenario,
    file: &Path,
    progress: impl FnMut(f64),
) -> Result<Played> {
    setup::check(scenario, file)?;
    let emulated = Emulated::new(image, scenario);
    let mut client = setup::boot(&emulated)?;
    let parameters = setup::configure(scenario, file, &mut client)?;
    setup::wait_for(&emulated, &mut client, Mode::Ready)?;
    setup::arm(&emulated, &mut client)?;
    client.have_done(Request::SetTelemetry(DECIMATION))?;

    let before = settle(&emulated)?;
    {
        let mut board = emulated.board();
        board.statistics().clear();
        board.world(|witness| witness.is_watching = true);
    }
    let instructions = emulated.board().instructions();
    let (start, wall) = (emulated.time(), Instant::now());
    let (telemetry, fault) = follow(&emulated, &mut client, scenario, progress)?;
    let wall = wall.elapsed().as_secs_f64();
    let instructions = emulated.board().instructions() - instructions;
    let interrupts = settle(&emulated)?;

    let duration = emulated.time() - start;
    let mut board = emulated.board();
    let truths = board.world(|witness| std::mem::take(&mut witness.samples));
    ensure!(
        truths.len() as u64 == interrupts,
        "{interrupts} control interrupts in {} periods",
        truths.len()
    );
    let told = places(&telemetry, before, truths.len());
    let frames = frames(&told, &truths, start);
    let lost = told.windows(2).map(|two| (two[1].0 - two[0].0) as u64 / u64::from(DECIMATION) - 1);
    let summary = Summary {
        metrics: measure(&frames, scenario),
        fault,
        duration,
        decimation: DECIMATION,
        telemetry_lost: lost.sum(),
        interrupts: costs(&mut board, duration),
        stack_bytes: board.stack_use(),
        instructions_per_second: instructions as f64 / duration,
        wall_per_second: wall / duration,
        hazards: board.world(|witness| witness.world.hazards().iter().map(in_words).collect()),
        violations: lasting(&board.violations()),
    };
    drop(board);
    Ok(Played { parameters, start, truths, told, frames, summary })
}

/// Plays on to where the control interrupt of the last sampling instant is over. Gives how many there have been since statistics were
/// cleared last, or since power came.
fn settle(emulated: &Emulated) -> Result<u64> {
    let sampled = || emulated.board().world(|witness| witness.sampled);
    let last = sampled();
    while sampled() == last {
        emulated.run(0.1 * PERIOD)?;
    }
    let end = sampled() + AFTER_INTERRUPT * PERIOD;
    emulated.run_until(end)?;
    let mut board = emulated.board();
    ensure!(
        board.statistics().exception() != CONTROL,
        "the control interrupt takes a whole period"
    );
    let handler = board.statistics().handlers().get(&CONTROL);
    Ok(handler.context("no control interrupt")?.count)
}

/// The scenario's profiles and commands, from now on.
fn follow(
    emulated: &Emulated,
    client: &mut Client,
    scenario: &Scenario,
    mut progress: impl FnMut(f64),
) -> Result<(Vec<Telemetry>, Option<Faulted>)> {
    let start = emulated.time();
    emulated.board().world(|witness| witness.world.start_profiles(start));
    let silence = (scenario.protection.command_timeout / 3.0).min(0.1);
    let end = start + scenario.duration;
    let mut steps = scenario.reference.steps.iter().peekable();
    let mut telemetry = Vec::new();
    let mut look = start;
    loop {
        // The emulator's time is in ticks, and may end a rounding short of what was asked for.
        let now = emulated.time() + 1e-9;
        if now >= end {
            return Ok((telemetry, None));
        }
        let step = steps.peek().map_or(f64::INFINITY, |step| start + step.time);
        emulated.run_until(step.min(look).min(end).min(now + CHUNK))?;
        let now = emulated.time() + 1e-9;
        if emulated.has_sent() {
            telemetry.extend(client.telemetry()?);
        }
        if now >= step
            && let Some(step) = steps.next()
        {
            match client.command(Command::Speed(step.value as f32)) {
                // A fault: the look that follows tells.
                Err(ClientError::Refused(_)) => look = start,
                commanded => commanded?,
            }
        }
        if now >= look {
            progress((emulated.time() - start) / scenario.duration);
            look = emulated.time() + silence;
            let status = client.status()?;
            match status.mode {
                Mode::Running => {}
                Mode::Faulted => {
                    let time = emulated.board().off_since() - start;
                    let fault = crate::connect::in_words(&status);
                    return Ok((telemetry, Some(Faulted { time, fault })));
                }
                mode => bail!("the drive is {mode:?} in the middle of the scenario"),
            }
        }
    }
}

/// Places of telemetry among the periods of which the first comes after so many.
fn places(telemetry: &[Telemetry], before: u64, periods: usize) -> Vec<(usize, Telemetry)> {
    let place = |telemetry: &Telemetry| {
        let place = u64::from(telemetry.period).checked_sub(before + 1)?;
        Some((usize::try_from(place).ok().filter(|place| *place < periods)?, *telemetry))
    };
    telemetry.iter().filter_map(place).collect()
}

fn frames(told: &[(usize, Telemetry)], truths: &[Truth], start: f64) -> Vec<Frame> {
    let frame = |(place, telemetry): &(usize, Telemetry)| {
        let (truth, reference) = (&truths[*place], f64::from(telemetry.reference));
        Frame {
            time: truth.time - start,
            reference,
            speed: truth.speed,
            current: truth.current,
            voltage: telemetry.voltage.into(),
            z1: truth.speed - reference,
            load_torque: truth.load_torque,
            load_torque_estimate: telemetry.load_torque.into(),
            ..Frame::default()
        }
    };
    told.iter().map(frame).collect()
}

/// The figures that these frames allow: z2 is not told, and neither are neighbouring periods.
fn measure(frames: &[Frame], scenario: &Scenario) -> Metrics {
    let steps = &scenario.reference.steps;
    let jumps: Vec<_> = steps
        .iter()
        .map(|step| crate::profile::Step { time: step.time, value: step.time })
        .collect();
    let mut meter = Meter::default();
    for frame in frames {
        meter.add(frame, frame.time - value_at(&jumps, 0.0, frame.time));
    }
    let mut metrics = meter.metrics();
    for figures in [&mut metrics.whole, &mut metrics.steady] {
        figures.rms_z2 = None;
        figures.rms_voltage_step = None;
    }
    metrics
}

/// What the board's interrupts have cost in so many seconds.
fn costs(
    board: &mut virtual_board::VirtualBoard<super::witness::Witness>,
    duration: f64,
) -> Vec<Interrupt> {
    let names =
        [(11, "DMA1 channel 1"), (18, "control"), (24, "clock of the tasks"), (38, "USART2")];
    let mut interrupts = Vec::new();
    for (exception, handler) in board.statistics().handlers() {
        let number = exception.wrapping_sub(16);
        let name = names.iter().find(|(known, _)| *known == number).map_or("", |(_, name)| name);
        let spread = |spread: &virtual_board::statistics::Spread| {
            [spread.min as f64, spread.mean(), spread.max as f64]
        };
        let rate = handler.count as f64 / duration;
        interrupts.push(Interrupt {
            number,
            name,
            rate,
            instructions: spread(&handler.instructions),
            estimated_cycles: spread(&handler.cycles),
            share: rate * handler.cycles.mean() / 170e6,
        });
    }
    interrupts
}

fn in_words(hazard: &Hazard) -> String {
    format!("{:?} on leg {} at {:.6} s", hazard.misuse, hazard.leg, hazard.time)
}

/// Violations that are not over in a moment.
pub fn lasting(violations: &[Violated]) -> Vec<String> {
    let is_lasting =
        |violated: &&Violated| violated.to.is_none_or(|to| to - violated.from > MOMENT);
    let lasting = violations.iter().filter(is_lasting);
    lasting
        .map(|violated| match violated.to {
            Some(to) => {
                format!("{:?} from {:.6} s to {to:.6} s", violated.violation, violated.from)
            }
            None => format!("{:?} from {:.6} s on", violated.violation, violated.from),
        })
        .collect()
}
