//! A step of the speed without load, and whether the response is the expected one.

use super::{Record, TELEMETRY_RATE, TURN, check, record};
use crate::client::Client;
use crate::connect::in_words;
use anyhow::{Result, bail, ensure};
use quasidrive::commission::Findings;
use quasidrive::link::message::{Request, Telemetry};
use quasidrive::parameters::Parameters;
use quasidrive::supervisor::{Command, Mode};
use quasidrive::trajectory::Shape;
use std::sync::atomic::AtomicBool;
use std::time::{Duration, Instant};

/// Share of the highest speed, and of the voltage, that the step takes at most.
const SHARE: f32 = 0.5;

/// Time before the step (s), after it in reference time constants, and at least (s).
const BEFORE: f64 = 0.2;
const TIME_CONSTANTS: f64 = 12.0;
const AFTER: f64 = 0.5;

/// Longest time of any of it, by the clock here: an emulated drive may be slower.
const PATIENCE: Duration = Duration::from_secs(120);

/// Deviation from the expected response that passes, over the step: the largest speed error, the steady one, and that of the accelerating current.
const PEAK: f64 = 0.05;
const STEADY: f64 = 0.01;
const CURRENT: f64 = 0.15;

/// What the step showed.
pub(super) struct Verification {
    /// The step (rad/s).
    pub step: f64,
    /// What the drive did, and when (s); the step is at [`BEFORE`] or a little later.
    pub record: Record,
    /// The current that the model expects for the reference (A), at the same times.
    pub expected_current: Vec<(f64, f64)>,
    /// Largest deviation of the speed from the reference (rad/s), and the mean one at the end.
    pub peak: f64,
    pub steady: f64,
    /// Largest expected current (A), and rms of the deviation from what is expected while the reference changes.
    pub current: f64,
    pub current_error: f64,
}

impl Verification {
    /// Why it is not passed.
    pub fn failure(&self) -> Option<String> {
        let failures = [
            ("the speed was off its reference by", self.peak / self.step, PEAK),
            ("the speed stayed off its reference by", self.steady / self.step, STEADY),
            ("the current was off the expected one by", self.current_error / self.current, CURRENT),
        ];
        let failed =
            failures.into_iter().find(|(_, share, limit)| share.is_nan() || share.abs() > *limit);
        failed.map(|(what, share, limit)| {
            format!("{what} {:.1} % of the step's (limit {:.0} %)", 100.0 * share, 100.0 * limit)
        })
    }
}

/// Steps the speed of a drive with these parameters.
pub(super) fn run(
    client: &mut Client,
    parameters: &Parameters,
    findings: &Findings,
    interrupted: &AtomicBool,
) -> Result<Verification> {
    let drive = &parameters.drive;
    let rate = drive.timing.rate;
    let by_voltage = drive.limits.duty * findings.bus_voltage / drive.motor.back_emf_constant;
    let step = SHARE * drive.limits.speed.min(by_voltage);
    let time_constant = match drive.shape {
        Shape::SecondOrder { bandwidth } => 1.0 / f64::from(bandwidth),
        _ => 0.0,
    };
    let after = (TIME_CONSTANTS * time_constant).max(AFTER);
    // It coasts from commissioning: the step begins at rest.
    wait(client, Mode::Ready, interrupted)?;
    client.command(Command::Arm)?;
    wait(client, Mode::Running, interrupted)?;
    client.have_done(Request::SetTelemetry((rate / TELEMETRY_RATE) as u32))?;
    let mut seen = Record::new();
    let mut play = |client: &mut Client, until: f64| -> Result<f64> {
        let start = Instant::now();
        loop {
            check(interrupted)?;
            ensure!(start.elapsed() < PATIENCE, "no telemetry");
            let status = client.status()?;
            if status.mode != Mode::Running {
                bail!("the tuned drive stopped: {}", in_words(&status));
            }
            let turn = Instant::now();
            while turn.elapsed() < TURN {
                record(&mut seen, client, rate)?;
            }
            let now = seen.last().map_or(0.0, |(time, _)| *time);
            if now >= until {
                return Ok(now);
            }
        }
    };
    // Until it stands still under control.
    let rest = play(client, BEFORE + 6.0 * time_constant)?;
    client.command(Command::Speed(step))?;
    play(client, rest + after)?;
    client.have_done(Request::SetTelemetry(0))?;
    client.command(Command::Stop)?;
    wait(client, Mode::Ready, interrupted)?;
    seen.retain(|(time, _)| *time >= rest - BEFORE);
    Ok(compare(seen, f64::from(step), parameters, findings))
}

fn wait(client: &mut Client, wanted: Mode, interrupted: &AtomicBool) -> Result<()> {
    let start = Instant::now();
    loop {
        check(interrupted)?;
        let status = client.status()?;
        if status.mode == wanted {
            return Ok(());
        }
        let hopeless = status.mode == Mode::Faulted || start.elapsed() > PATIENCE;
        ensure!(!hopeless, "not {wanted:?}: {}", in_words(&status));
        std::thread::sleep(Duration::from_millis(5));
    }
}

fn compare(
    record: Record,
    step: f64,
    parameters: &Parameters,
    findings: &Findings,
) -> Verification {
    let motor = &parameters.drive.motor;
    let torque = |value: Result<quasidrive::commission::Value, _>| {
        value.map_or(0.0, |it: quasidrive::commission::Value| f64::from(it.value))
    };
    let (coulomb, load) = (torque(findings.coulomb_friction), torque(findings.load_torque));
    let expected = |before: &(f64, Telemetry), after: &(f64, Telemetry)| {
        let [first, last] = [before, after].map(|it| f64::from(it.1.reference));
        let (speed, span) = (0.5 * (first + last), after.0 - before.0);
        let friction = f64::from(motor.viscous_friction) * speed
            + if speed.abs() > 1e-3 * step { coulomb * speed.signum() + load } else { 0.0 };
        let acceleration = (last - first) / span;
        (f64::from(motor.inertia) * acceleration + friction) / f64::from(motor.back_emf_constant)
    };
    let mut expected_current = Vec::new();
    let (mut squares, mut count, mut current) = (0.0, 0.0, 0.0_f64);
    for three in record.windows(3) {
        let [before, now, after] = three else { continue };
        let wanted = expected(before, after);
        expected_current.push((now.0, wanted));
        current = current.max(wanted.abs());
        let reference = f64::from(now.1.reference) / step;
        if (0.01..0.99).contains(&reference) {
            squares += (f64::from(now.1.current) - wanted).powi(2);
            count += 1.0;
        }
    }
    let error = |(_, it): &(f64, Telemetry)| f64::from(it.speed) - f64::from(it.reference);
    let peak = record.iter().map(|it| error(it).abs()).fold(0.0, f64::max);
    let last = &record[record.len() - record.len() / 5..];
    let steady = last.iter().map(error).sum::<f64>() / last.len() as f64;
    let current_error = (squares / count).sqrt();
    Verification { step, record, expected_current, peak, steady, current, current_error }
}
