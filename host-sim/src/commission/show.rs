//! What commissioning came to, in the terminal and as one self-contained HTML page.

use super::verify::Verification;
use super::{Outcome, speed_scale};
use crate::assignment::list;
use crate::plot::{Line, Plot};
use crate::report::page;
use crate::terminal::{short, table};
use anyhow::Result;
use maud::{Markup, PreEscaped, html};
use plotters::style::RGBColor;
use quasidrive::commission::{Findings, Phase, Reason, Value};
use quasidrive::link::message::Telemetry;
use quasidrive::parameters::Parameters;
use quasidrive::sense::Sensors;

const BLUE: RGBColor = RGBColor(31, 119, 180);
const ORANGE: RGBColor = RGBColor(255, 127, 14);
const BLACK: RGBColor = RGBColor(0, 0, 0);

/// Time of the fits' plots (s): the end of what was measured.
const SHOWN: f64 = 0.6;

/// What a phase is about.
pub(super) fn phase(phase: Phase) -> &'static str {
    match phase {
        Phase::Rest => "outputs off: offset and noise of the current",
        Phase::Pulses => "short pulses of voltage: leads, signs, a first look at R and L",
        Phase::Launch => "from rest: direction, and how fast the motor is",
        Phase::Trial => "to and fro: controls currents better",
        Phase::Short => "to and fro: L, R, voltage drop",
        Phase::Long => "to and fro, faster: Kb, J, friction",
        Phase::Over => "over",
    }
}

/// Name, unit, and what was found.
type Row = (&'static str, &'static str, Result<Value, Reason>);

fn rows(findings: &Findings) -> [Row; 8] {
    [
        ("resistance R", "Ω", findings.resistance),
        ("inductance L", "H", findings.inductance),
        ("drop of brushes and dead time", "V", findings.voltage_drop),
        ("back-EMF constant Kb", "V·s/rad", findings.back_emf_constant),
        ("inertia J", "kg·m²", findings.inertia),
        ("viscous friction b", "N·m·s/rad", findings.viscous_friction),
        ("Coulomb friction", "N·m", findings.coulomb_friction),
        ("constant load", "N·m", findings.load_torque),
    ]
}

fn signed(value: f32) -> String {
    let sign = if value < 0.0 { "-" } else { "" };
    format!("{sign}{}", short(Some(f64::from(value.abs()))))
}

fn cells((name, unit, found): Row) -> [String; 4] {
    let (value, uncertainty) = match found {
        Ok(Value { value, uncertainty }) => (signed(value), format!("± {}", signed(uncertainty))),
        Err(reason) => ("not seen".to_owned(), reason.to_string()),
    };
    [name.to_owned(), value, uncertainty, unit.to_owned()]
}

/// What was found beside the motor.
fn notes(findings: &Findings, sensors: &Sensors) -> Vec<String> {
    let mut notes = Vec::new();
    if let Some(reason) = findings.stopped {
        notes.push(format!("ended early: {reason}"));
    }
    notes.push(format!(
        "bus {:.2} V; current sensor: offset {:.4} A, noise {:.4} A rms",
        findings.bus_voltage, findings.current_offset, findings.current_noise
    ));
    if findings.current_reversed {
        notes.push("the current sensor is the other way round: its sign is corrected".to_owned());
    }
    let counts = match sensors {
        Sensors::Codes(calibration) => {
            format!("encoder with {} counts a turn", calibration.counts_per_turn)
        }
        Sensors::Exact => "exact speed".to_owned(),
    };
    notes.push(match findings.encoder_reversed {
        Ok(false) => format!("{counts}: direction right"),
        Ok(true) => format!("{counts}: the other way round, its sign is corrected"),
        Err(reason) => format!("{counts}: direction not seen, {reason}"),
    });
    notes
}

/// What was found, as a table.
pub(super) fn findings(findings: &Findings, sensors: &Sensors) -> String {
    let header = ["", "value", "", "unit"].map(str::to_owned).to_vec();
    let mut table = table(header, 1);
    for row in rows(findings) {
        table.add_row(cells(row));
    }
    format!("{table}\n{}\n", notes(findings, sensors).join("\n"))
}

/// Parameters that change: name, before, after.
fn changed(before: &Parameters, tuned: &Parameters) -> Vec<[String; 3]> {
    let before = list("", &mut { *before });
    let tuned = list("", &mut { *tuned });
    let was = |name: &str| {
        let found = before.iter().find(|(path, _)| path == name);
        found.map_or("–".to_owned(), |(_, setting)| setting.to_string())
    };
    let all = tuned.iter().map(|(name, setting)| [name.clone(), was(name), setting.to_string()]);
    all.filter(|[_, before, after]| before != after).collect()
}

/// What the drive is tuned to, as a table.
pub(super) fn changes(before: &Parameters, tuned: &Parameters) -> String {
    let header = ["parameter", "in force", "tuned"].map(str::to_owned).to_vec();
    let mut table = table(header, 1);
    for row in changed(before, tuned) {
        table.add_row(row);
    }
    format!("{table}\n")
}

/// What the step showed.
pub(super) fn verification(verification: &Verification) -> String {
    let Verification { step, peak, steady, current, current_error, .. } = verification;
    let verdict =
        verification.failure().map_or("passed".to_owned(), |why| format!("failed: {why}"));
    format!(
        "step to {step:.1} rad/s: off the reference by at most {:.2} %, at the end {:.3} %; current off the expected one by {:.1} % of its peak of {current:.2} A\nverification {verdict}",
        100.0 * peak / step,
        100.0 * steady / step,
        100.0 * current_error / current
    )
}

const STYLE: &str = "body{font-family:sans-serif;max-width:75em;margin:2em auto;padding:0 1em}\
                     table{border-collapse:collapse}th,td{text-align:right;padding:.15em .6em;\
                     border-bottom:1px solid #ddd}.text{text-align:left}svg{width:49%;min-width:28em}";

/// The report.
pub(super) fn html(outcome: &Outcome) -> Result<String> {
    let Outcome { identity, config, findings, before, tuned, verification, .. } = outcome;
    let fits = fits(outcome)?;
    let steps = verification.as_ref().map(step_plots).transpose()?;
    let body = html! {
        h1 { "Commissioning" }
        p { (identity) }
        h2 { "What was found" }
        table {
            tr { th.text {} th { "value" } th.text { "uncertainty, or why it was not seen" } th.text { "unit" } }
            @for row in rows(findings) {
                @let [name, value, uncertainty, unit] = cells(row);
                tr { td.text { (name) } td { (value) } td.text { (uncertainty) } td.text { (unit) } }
            }
        }
        ul { @for note in notes(findings, &config.sensors) { li { (note) } } }
        @if let Some(fits) = fits {
            h2 { "What it was found from" }
            p { "The last of the run, and what the motor that was found would have done." }
            (fits)
        }
        @if let Some(tuned) = tuned {
            h2 { "What the drive is tuned to" }
            table {
                tr { th.text { "parameter" } th { "before" } th { "tuned" } }
                @for [name, before, after] in changed(before, tuned) {
                    tr { td.text { (name) } td { (before) } td { (after) } }
                }
            }
        }
        @if let (Some(verification), Some(steps)) = (verification, steps) {
            h2 { "Verification" }
            p { (self::verification(verification)) }
            (steps)
        }
    };
    Ok(page("quasidrive: commissioning", STYLE, &body))
}

fn line(name: &str, color: RGBColor, dashed: bool, points: Vec<(f64, f64)>) -> Line {
    Line { name: name.to_owned(), color, dashed, points }
}

fn plot(title: &str, y_label: &str, lines: Vec<Line>) -> Result<PreEscaped<String>> {
    let points = || lines.iter().flat_map(|line| &line.points);
    let first = points().map(|point| point.0).fold(f64::INFINITY, f64::min);
    let last = points().map(|point| point.0).fold(f64::NEG_INFINITY, f64::max);
    let (title, y_label) = (title.to_owned(), y_label.to_owned());
    let plot = Plot { title, x_label: None, y_label, span: first..last, lines };
    Ok(PreEscaped(plot.svg()?))
}

/// Voltage and speed at the end of the run, as measured and as the motor that was found explains them. Nothing if it was not.
fn fits(outcome: &Outcome) -> Result<Option<Markup>> {
    let Outcome { findings, measured, before, config, .. } = outcome;
    let value = |found: Result<Value, Reason>| found.ok().map(|it| f64::from(it.value));
    let (Some(resistance), Some(inductance), Some(back_emf), Some(inertia)) = (
        value(findings.resistance),
        value(findings.inductance),
        value(findings.back_emf_constant),
        value(findings.inertia),
    ) else {
        return Ok(None);
    };
    let or_none = |found| value(found).unwrap_or(0.0);
    let drop = or_none(findings.voltage_drop);
    let [viscous, coulomb, load] =
        [findings.viscous_friction, findings.coulomb_friction, findings.load_torque].map(or_none);
    let sign = if findings.current_reversed { -1.0 } else { 1.0 };
    let scale = speed_scale(before, config, findings);
    let current = |it: &Telemetry| sign * f64::from(it.current - findings.current_offset);
    let speed = |it: &Telemetry| scale * f64::from(it.speed);
    let driven = measured.iter().rposition(|(_, it)| it.voltage != 0.0).unwrap_or(0);
    let end = measured.get(driven).map_or(0.0, |(time, _)| *time);
    let from = measured.partition_point(|(time, _)| *time < end - SHOWN);
    let shown = measured.get(from..=driven).unwrap_or_default();
    let Some((_, first)) = shown.first() else { return Ok(None) };
    let (mut voltages, mut asked) = (Vec::new(), Vec::new());
    let (mut speeds, mut integrated) = (Vec::new(), Vec::new());
    let mut state = speed(first);
    for pair in shown.windows(2) {
        let [(before, last), (time, now)] = pair else { continue };
        let span = time - before;
        let (i, mean) = (current(now), 0.5 * (current(now) + current(last)));
        let change = (current(now) - current(last)) / span;
        voltages.push((
            *time,
            resistance * i + inductance * change + drop * i.signum() + back_emf * speed(now),
        ));
        asked.push((*time, f64::from(now.voltage)));
        let friction = viscous * state + coulomb * state.signum() + load;
        state += span * (back_emf * mean - friction) / inertia;
        speeds.push((*time, speed(now)));
        integrated.push((*time, state));
    }
    let plots = [
        plot(
            "Armature voltage",
            "u [V]",
            vec![
                line("asked of the bridge", BLUE, false, asked),
                line("explained by R, L, drop, Kb", BLACK, true, voltages),
            ],
        )?,
        plot(
            "Speed",
            "ω [rad/s]",
            vec![
                line("measured", BLUE, false, speeds),
                line("integrated from the current by Kb, J, friction", BLACK, true, integrated),
            ],
        )?,
    ];
    Ok(Some(html! { @for plot in plots { (plot) } }))
}

fn step_plots(verification: &Verification) -> Result<Markup> {
    let points = |read: fn(&Telemetry) -> f32| {
        let all = verification.record.iter();
        all.map(|(time, telemetry)| (*time, f64::from(read(telemetry)))).collect()
    };
    let plots = [
        plot(
            "Speed",
            "ω [rad/s]",
            vec![
                line("measured", BLUE, false, points(|it| it.speed)),
                line("expected: the reference", BLACK, true, points(|it| it.reference)),
            ],
        )?,
        plot(
            "Current",
            "i [A]",
            vec![
                line("measured", ORANGE, false, points(|it| it.current)),
                line(
                    "expected of the motor that was found",
                    BLACK,
                    true,
                    verification.expected_current.clone(),
                ),
            ],
        )?,
    ];
    Ok(html! { @for plot in plots { (plot) } })
}
