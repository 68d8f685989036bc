//! What must change nothing.

use super::bench::Bench;
use super::{Case, Finding, PERIOD, Result, Stand};
use crate::connect::in_words;
use crate::emulated::play;
use crate::scenario::ShapeName;
use crate::wired::encoder::EncoderFault;
use crate::wired::faults::Fault as Change;
use anyhow::ensure;
use quasidrive::fault::ActiveLimit;
use quasidrive::link::frame::{LONGEST, encode};
use quasidrive::link::message::{Numbered, Request};
use quasidrive::supervisor::Command;
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use std::num::NonZeroU32;
use std::path::Path;

/// Speed of the motor (rad/s).
const SPEED: f32 = 100.0;

/// How long the speed is looked at, before and while something happens (s).
const WINDOW: f64 = 0.3;

/// By how much what is not to disturb may raise the rms speed error: two samples of the same noise, some 20 independent values each, differ by
/// a third and more.
const RATIO: f64 = 1.6;

/// Bytes that the line carries in a millisecond.
const LINE: usize = 93;

pub fn cases() -> Vec<Case> {
    let quiet = |name, act: fn(&mut Bench, &mut StdRng) -> Result<()>| Case {
        name,
        demand: "no fault, rms speed error as before".to_owned(),
        bound: None,
        play: Box::new(move |stand| undisturbed(stand, act)),
    };
    let rough = |name, demand: &str, play: fn(&Stand) -> Result<Finding>| Case {
        name,
        demand: demand.to_owned(),
        bound: None,
        play: Box::new(play),
    };
    vec![
        quiet("serial garbage while running", |bench, random| {
            let bytes: Vec<u8> = (0..LINE).map(|_| random.random()).collect();
            bench.emulated.board().send(&bytes);
            bench.emulated.run(1e-3)
        }),
        quiet("serial flood of zeros while running", |bench, _| {
            bench.emulated.board().send(&[0; LINE]);
            bench.emulated.run(1e-3)
        }),
        quiet("serial flood of requests while running", |bench, _| {
            let mut buffer = [0; LONGEST];
            let request = Request::Command(Command::KeepAlive);
            if let Some(frame) = encode(&Numbered { sequence: 0, request }, &mut buffer) {
                let frames = frame.repeat(LINE / frame.len());
                bench.emulated.board().send(&frames);
            }
            bench.emulated.run(1e-3)
        }),
        quiet("host reconnects while running", |bench, _| {
            bench.client = bench.emulated.client()?;
            bench.emulated.run(1e-3)
        }),
        quiet("parameters read while running", |bench, _| {
            let parameters = bench.client.parameters()?;
            ensure!(parameters.len() > 30, "{} parameters", parameters.len());
            Ok(())
        }),
        quiet("telemetry at its fastest", |bench, _| {
            bench.client.have_done(Request::SetTelemetry(1))?;
            bench.emulated.run(5e-3)?;
            ensure!(!bench.client.telemetry()?.is_empty(), "no telemetry");
            Ok(())
        }),
        quiet("control interrupt late by a third of a period", |bench, random| {
            bench.emulated.run(random.random_range(0.0..PERIOD))?;
            bench.emulated.board().force_interrupt(18, Some(false));
            bench.emulated.run(PERIOD / 3.0)?;
            bench.emulated.board().force_interrupt(18, None);
            bench.emulated.run(1e-3)
        }),
        rough(
            "load step of four fifths of the largest configured torque",
            "no fault; the speed is back within 1 rad/s after 50 ms",
            load_step,
        ),
        rough(
            "speed reversal at the full current limit",
            "no fault; the current within limits.current, reversed within 40 ms",
            reversal,
        ),
        rough(
            "bus sags within its limits",
            "no fault; the speed within 2 rad/s throughout",
            bus_sag,
        ),
        rough(
            "encoder loses five counts",
            "no fault; the speed is back within 1 rad/s after 50 ms",
            lost_counts,
        ),
        rough("speed just below its limit", "no fault", nearly_too_fast),
        rough(
            "load of nine tenths of the continuous current",
            "no fault over eight thermal times; the limit *heat* is told",
            nearly_too_much,
        ),
        rough(
            "board 5 °C below its highest temperature",
            "no fault; the limit *temperature* is told",
            nearly_too_hot,
        ),
        rough(
            "the same twice",
            "the same image and scenario: the same telemetry, byte by byte",
            twice,
        ),
    ]
}

/// Runs, and then runs on while something happens again and again.
fn undisturbed(stand: &Stand, act: fn(&mut Bench, &mut StdRng) -> Result<()>) -> Result<Finding> {
    let mut bench = stand.running(SPEED)?;
    let mut random = StdRng::seed_from_u64(1);
    watch(&bench);
    bench.watch(WINDOW)?;
    let before = rms(&bench, SPEED.into());
    watch(&bench);
    let (end, mut look) = (bench.emulated.time() + WINDOW, 0.0);
    while bench.emulated.time() < end {
        act(&mut bench, &mut random)?;
        // The host lives, and asks now and then.
        if bench.emulated.time() > look {
            look = bench.emulated.time() + 0.1;
            bench.client.status()?;
        }
    }
    let during = rms(&bench, SPEED.into());
    // What is on the line goes by.
    bench.emulated.run(20e-3)?;
    bench.check_running()?;
    let found = format!("{before:.4} rad/s rms before, {during:.4} meanwhile");
    let is_quiet = during <= RATIO * before;
    let failure = (!is_quiet).then(|| "the speed is disturbed".to_owned()).or(bench.misuse());
    Ok(Finding { found, failure, ..Finding::default() })
}

/// Watches the truth from here on.
fn watch(bench: &Bench) {
    bench.emulated.board().world(|witness| {
        witness.is_watching = true;
        witness.samples.clear();
    });
}

/// Rms of the true speed's distance from a speed (rad/s), since it is watched.
fn rms(bench: &Bench, speed: f64) -> f64 {
    bench.emulated.board().world(|witness| {
        let squares: f64 = witness.samples.iter().map(|truth| (truth.speed - speed).powi(2)).sum();
        (squares / witness.samples.len() as f64).sqrt()
    })
}

fn load_step(stand: &Stand) -> Result<Finding> {
    let torque = 0.8 * stand.scenario.tuning.load_torque.unwrap_or_default();
    bump(stand, Change::Load(torque), &format!("{torque:.2} N·m"))
}

fn lost_counts(stand: &Stand) -> Result<Finding> {
    let counts = NonZeroU32::MIN.saturating_add(4);
    bump(stand, Change::Encoder(EncoderFault::Lost(counts)), "half a degree")
}

/// Something that the speed must be back from soon.
fn bump(stand: &Stand, change: Change, what: &str) -> Result<Finding> {
    let mut bench = stand.running(SPEED)?;
    watch(&bench);
    let start = bench.inject(change, 0.3);
    bench.watch(0.2)?;
    bench.check_running()?;
    let error = |truth: &crate::wired::Truth| (truth.speed - f64::from(SPEED)).abs();
    let (most, late) = bench.emulated.board().world(|witness| {
        let late = witness.samples.iter().filter(|truth| truth.time > start + 50e-3);
        (witness.samples.iter().map(error).fold(0.0, f64::max), late.map(error).fold(0.0, f64::max))
    });
    ensure!(late < 1.0, "{late:.2} rad/s off after 50 ms");
    finish(&bench, format!("{what}: {most:.2} rad/s at most, {late:.3} rad/s after 50 ms"))
}

fn nearly_too_fast(stand: &Stand) -> Result<Finding> {
    // Ten times the speed's noise below the limit.
    let speed = stand.scenario.limits.speed - 0.2;
    let mut bench = stand.running(speed as f32)?;
    bench.watch(0.2)?;
    bench.check_running()?;
    finish(&bench, format!("{speed:.1} rad/s"))
}

fn nearly_too_much(stand: &Stand) -> Result<Finding> {
    // With the friction 2.37 A: 83 % of what trips, in squares.
    let mut bench = stand.running_with(SPEED, |scenario| {
        scenario.protection.continuous_current = Some(2.6);
        scenario.protection.thermal_time = 0.05;
    })?;
    bench.inject(Change::Load(0.12), f64::INFINITY);
    tells(&mut bench, 0.4, ActiveLimit::Heat)
}

fn nearly_too_hot(stand: &Stand) -> Result<Finding> {
    let mut bench = stand.running(SPEED)?;
    let temperature = stand.scenario.protection.temperature - 5.0;
    bench.inject(Change::BoardTemperature(temperature), f64::INFINITY);
    tells(&mut bench, 0.1, ActiveLimit::Temperature)
}

/// It runs on, but tells of a limit.
fn tells(bench: &mut Bench, time: f64, limit: ActiveLimit) -> Result<Finding> {
    let status = bench.watch(time)?;
    bench.check_running()?;
    ensure!(status.limits.contains(limit), "{}", in_words(&status));
    finish(bench, in_words(&status))
}

fn reversal(stand: &Stand) -> Result<Finding> {
    let mut bench =
        stand.running_with(SPEED, |scenario| scenario.reference.shape = ShapeName::Step)?;
    watch(&bench);
    let start = bench.emulated.time();
    bench.client.command(Command::Speed(-SPEED))?;
    bench.watch(0.15)?;
    bench.check_running()?;
    let (current, arrived) = bench.emulated.board().world(|witness| {
        let current = witness.samples.iter().map(|truth| truth.current.abs()).fold(0.0, f64::max);
        let there = witness.samples.iter().find(|truth| truth.speed < -0.95 * f64::from(SPEED));
        (current, there.map(|truth| truth.time - start))
    });
    let limits = stand.scenario.limits;
    let asked = limits.current_command.unwrap_or_default();
    ensure!(current > 0.9 * asked, "{current:.1} A is not the full current");
    ensure!(current < limits.current, "{current:.1} A");
    ensure!(arrived.is_some_and(|time| time < 40e-3), "reversed after {arrived:?} s");
    let milliseconds = 1e3 * arrived.unwrap_or_default();
    finish(&bench, format!("{current:.1} A at most, reversed in {milliseconds:.1} ms"))
}

fn bus_sag(stand: &Stand) -> Result<Finding> {
    let mut bench = stand.running(SPEED)?;
    watch(&bench);
    bench.inject(Change::Supply(14.0), 0.1);
    bench.watch(0.2)?;
    bench.check_running()?;
    let error = bench.emulated.board().world(|witness| {
        let errors = witness.samples.iter().map(|truth| (truth.speed - f64::from(SPEED)).abs());
        errors.fold(0.0, f64::max)
    });
    ensure!(error < 2.0, "{error:.2} rad/s off");
    finish(&bench, format!("24 V to 14 V and back: {error:.2} rad/s at most"))
}

fn finish(bench: &Bench, found: String) -> Result<Finding> {
    Ok(Finding { found, failure: bench.misuse(), ..Finding::default() })
}

fn twice(stand: &Stand) -> Result<Finding> {
    let mut scenario = stand.scenario.clone();
    scenario.duration = 0.3;
    let file = Path::new("esc1.toml");
    let play = || play::play(&stand.image, &scenario, file, |_| {});
    let (first, second) = (play()?, play()?);
    let bytes = |played: &play::Played| {
        let message = |telemetry| {
            postcard::to_slice(telemetry, &mut [0; LONGEST]).map(|bytes| bytes.to_vec())
        };
        played.told.iter().map(|(_, telemetry)| message(telemetry)).collect::<Result<Vec<_>, _>>()
    };
    let (first, second) = (bytes(&first)?, bytes(&second)?);
    let expected = 0.9 * scenario.duration / (f64::from(play::DECIMATION) * PERIOD);
    ensure!(first.len() as f64 > expected, "{} periods told", first.len());
    ensure!(first == second, "they differ");
    Ok(Finding { found: format!("{} periods told", first.len()), ..Finding::default() })
}
