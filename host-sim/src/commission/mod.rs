//! `connect … commission`: has a drive measure its motor, tunes it from what was found, and verifies that.
//!
//! The drive measures ([`quasidrive::commission`]); what is made of it is computed here and goes to the drive as parameters do. `verify`
//! plays a step of the speed and holds the response against the expected one; `show` is the report.

mod show;
mod verify;

use crate::assignment::{Assignment, list};
use crate::client::{Client, ClientError};
use crate::connect::in_words;
use crate::interruption::interruption;
use crate::scenario::Scenario;
use anyhow::{Context, Result, bail, ensure};
use clap::Args;
use indicatif::{ProgressBar, ProgressStyle};
use quasidrive::commission::tuning::Known;
use quasidrive::commission::{CommissionConfig, Findings, Nameplate, Phase, Progress};
use quasidrive::link::message::{Request, Status, Telemetry};
use quasidrive::parameters::Parameters;
use quasidrive::schema;
use quasidrive::sense::Sensors;
use quasidrive::supervisor::{Command, Mode};
use std::collections::HashSet;
use std::io::{Write, stdout};
use std::path::PathBuf;
use std::sync::atomic::AtomicBool;
use std::sync::atomic::Ordering::Relaxed;
use std::time::{Duration, Instant};
use verify::Verification;

/// What is known of the motor, and what to do with what is found. What is not given is as in the drive's parameters.
#[derive(Args)]
pub struct Commission {
    /// Rated voltage of the motor, which it gets at most (V).
    #[arg(long, value_name = "V")]
    voltage: Option<f32>,
    /// Its speed without load at that voltage (rad/s): shows wrong counts.
    #[arg(long, value_name = "RAD_S", requires = "voltage")]
    no_load: Option<f32>,
    /// Counts of the encoder a turn: four times its lines.
    #[arg(long, value_name = "N", allow_negative_numbers = true)]
    counts: Option<i32>,
    /// Highest current, at most limits.current (A).
    #[arg(long, value_name = "A")]
    current: Option<f32>,
    /// Highest speed (rad/s).
    #[arg(long, value_name = "RAD_S")]
    speed: Option<f32>,
    /// How far the shaft may turn to either side of where it stands (rad). Leaves no room for the verification.
    #[arg(long, value_name = "RAD")]
    travel: Option<f32>,
    /// Go on with what it is tuned to, and verify that by a step of the speed.
    #[arg(long)]
    apply: bool,
    /// Keep that when the power is off, if the verification is passed.
    #[arg(long, requires = "apply")]
    save: bool,
    /// Write an HTML report.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
}

impl Commission {
    fn nameplate(&self) -> Nameplate {
        Nameplate {
            voltage: self.voltage,
            no_load_speed: self.no_load,
            counts_per_turn: self.counts,
            current: self.current,
            speed: self.speed,
            travel: self.travel,
        }
    }
}

/// How often is asked how far it is, which keeps the drive alive.
const TURN: Duration = Duration::from_millis(40);

/// Telemetry a second.
const TELEMETRY_RATE: f32 = 1000.0;

/// Longest time that commissioning takes, by the drive's own clock, and by this one (s): an emulated drive may be slower.
const LONGEST: Duration = Duration::from_secs(600);

/// What commissioning came to.
struct Outcome {
    identity: String,
    config: CommissionConfig,
    findings: Findings,
    /// What the drive did, and when (s).
    measured: Record,
    /// The parameters before, and those that the findings make.
    before: Parameters,
    tuned: Option<Parameters>,
    verification: Option<Verification>,
}

/// Does it all. Gives what the drive is doing then.
pub fn run(client: &mut Client, options: &Commission) -> Result<Status> {
    let interrupted = interruption()?;
    let done = commission(client, options, interrupted);
    // However it ended.
    let off = match client.command(Command::Off) {
        Ok(()) | Err(ClientError::Refused(_)) => Ok(()),
        Err(error) => Err(error),
    };
    done.and_then(|()| Ok(off?))?;
    Ok(client.status()?)
}

fn commission(client: &mut Client, options: &Commission, interrupted: &AtomicBool) -> Result<()> {
    let before = parameters(client)?;
    let nameplate = options.nameplate();
    let config = nameplate.config(&before.drive)?;
    let measured = measure(client, &nameplate, before.drive.timing.rate, interrupted)?;
    let findings = client.findings()?;
    writeln!(stdout(), "{}", show::findings(&findings, &config.sensors))?;
    let mut outcome = Outcome {
        identity: client.identity().to_owned(),
        config,
        findings,
        measured,
        before,
        tuned: None,
        verification: None,
    };
    let known = match Known::new(&findings, &config) {
        Ok(known) => known,
        Err(reason) => {
            report(options, &outcome)?;
            let status = client.status()?;
            let faults = if status.faults.is_empty() {
                String::new()
            } else {
                format!(" ({})", in_words(&status))
            };
            bail!("not enough was seen to tune the drive, nothing is changed: {reason}{faults}");
        }
    };
    let tuned = Parameters { drive: known.tuned(&config), ..before };
    outcome.tuned = Some(tuned);
    writeln!(stdout(), "{}", show::changes(&before, &tuned))?;
    if options.apply {
        client.change(&list("", &mut { tuned }))?;
        writeln!(stdout(), "applied")?;
        if options.travel.is_some() {
            writeln!(stdout(), "not verified: the travel leaves no room for a run at speed")?;
        } else {
            let verification = verify::run(client, &tuned, &findings, interrupted)?;
            writeln!(stdout(), "{}", show::verification(&verification))?;
            outcome.verification = Some(verification);
        }
    }
    report(options, &outcome)?;
    if let Some(failure) = outcome.verification.as_ref().and_then(Verification::failure) {
        bail!("the verification failed, nothing is saved: {failure}");
    }
    if options.save {
        client.have_done(Request::SaveParameters)?;
        writeln!(stdout(), "saved")?;
    }
    Ok(())
}

fn report(options: &Commission, outcome: &Outcome) -> Result<()> {
    let Some(file) = &options.report else { return Ok(()) };
    let cannot = || format!("cannot write {}", file.display());
    std::fs::write(file, show::html(outcome)?).with_context(cannot)?;
    writeln!(stdout(), "Report: {}", file.display())?;
    Ok(())
}

/// The drive's parameters in force, all of them.
fn parameters(client: &mut Client) -> Result<Parameters> {
    let told: Vec<Assignment> = client.parameters()?;
    let mut parameters = Scenario::paper().parameters();
    for (name, setting) in &told {
        // A drive of another version may have parameters that this program does not know.
        let _ = schema::set(&mut parameters, name, setting.value());
    }
    let names: HashSet<&str> = told.iter().map(|(name, _)| name.as_str()).collect();
    for (name, _) in list("", &mut parameters) {
        ensure!(names.contains(name.as_str()), "the drive does not tell its {name}");
    }
    Ok(parameters)
}

/// Telemetry with the time since its first (s).
type Record = Vec<(f64, Telemetry)>;

/// Adds telemetry to a record.
fn record(record: &mut Record, client: &mut Client, rate: f32) -> Result<(), ClientError> {
    for telemetry in client.telemetry()? {
        let time = record.last().map_or(0.0, |(time, before)| {
            time + f64::from(telemetry.period.wrapping_sub(before.period)) / f64::from(rate)
        });
        record.push((time, telemetry));
    }
    Ok(())
}

fn check(interrupted: &AtomicBool) -> Result<()> {
    ensure!(!interrupted.load(Relaxed), "interrupted: outputs are off, nothing is saved");
    Ok(())
}

/// Has the motor measured; gives what the drive did meanwhile. It ends by itself, whatever it finds.
fn measure(
    client: &mut Client,
    nameplate: &Nameplate,
    rate: f32,
    interrupted: &AtomicBool,
) -> Result<Record> {
    client.have_done(Request::SetTelemetry((rate / TELEMETRY_RATE) as u32))?;
    client.have_done(Request::Commission(*nameplate))?;
    let start = Instant::now();
    let bar = bar()?;
    let mut told = None;
    let mut measured = Record::new();
    loop {
        check(interrupted)?;
        ensure!(start.elapsed() < LONGEST, "commissioning does not end");
        if !matches!(client.status()?.mode, Mode::Armed | Mode::Commissioning) {
            break;
        }
        let Progress { phase, share } = client.progress()?;
        let phase = (phase != Phase::Over).then_some(phase);
        bar.set_position((100.0 * share) as u64);
        if let Some(phase) = phase
            && told != Some(phase)
        {
            told = Some(phase);
            bar.set_message(show::phase(phase));
            if bar.is_hidden() {
                writeln!(stdout(), "{}", show::phase(phase))?;
            }
        }
        let turn = Instant::now();
        while turn.elapsed() < TURN {
            record(&mut measured, client, rate)?;
        }
    }
    bar.finish_and_clear();
    client.have_done(Request::SetTelemetry(0))?;
    Ok(measured)
}

fn bar() -> Result<ProgressBar> {
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} % {msg}")?;
    Ok(ProgressBar::new(100).with_style(style))
}

/// What a speed by the parameters before is by those of commissioning.
fn speed_scale(before: &Parameters, config: &CommissionConfig, findings: &Findings) -> f64 {
    match (before.drive.sensors, config.sensors) {
        (Sensors::Codes(before), Sensors::Codes(now)) => {
            let sign = if findings.encoder_reversed == Ok(true) { -1.0 } else { 1.0 };
            sign * f64::from(before.counts_per_turn) / f64::from(now.counts_per_turn)
        }
        _ => 1.0,
    }
}
