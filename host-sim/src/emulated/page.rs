//! A scenario on the emulated board, as text and as one HTML page.

use super::play::{Played, Summary};
use crate::frame::Frame;
use crate::plot::{Line, Plot};
use crate::report::{STYLE, page};
use crate::terminal::{metrics_table, short, table};
use anyhow::Result;
use maud::{PreEscaped, html};
use plotters::style::RGBColor;

const TRUTH: RGBColor = RGBColor(160, 20, 20);
const TOLD: RGBColor = RGBColor(20, 90, 180);
const GREY: RGBColor = RGBColor(90, 90, 90);

/// What a played scenario comes to, for the terminal.
pub fn text(name: &str, summary: &Summary) -> String {
    let figures = metrics_table(&[(name.to_owned(), summary.metrics.clone())]);
    format!("{figures}\n\n{}\n\n{}\n", interrupts(summary), rest(summary).join("\n"))
}

fn header() -> Vec<String> {
    let columns = [
        "interrupt",
        "what",
        "rate (Hz)",
        "instructions: least",
        "mean",
        "most",
        "estimated cycles: least",
        "mean",
        "most",
        "share",
    ];
    columns.map(str::to_owned).to_vec()
}

fn rows(summary: &Summary) -> Vec<Vec<String>> {
    let row = |interrupt: &super::play::Interrupt| {
        let [least, mean, most] = interrupt.instructions;
        let [quickest, cycles, longest] = interrupt.estimated_cycles;
        vec![
            interrupt.number.to_string(),
            interrupt.name.to_owned(),
            format!("{:.1}", interrupt.rate),
            format!("{least}"),
            format!("{mean:.1}"),
            format!("{most}"),
            format!("{quickest}"),
            format!("{cycles:.1}"),
            format!("{longest}"),
            format!("{:.2} %", 100.0 * interrupt.share),
        ]
    };
    summary.interrupts.iter().map(row).collect()
}

fn interrupts(summary: &Summary) -> String {
    let mut table = table(header(), 2);
    for row in rows(summary) {
        table.add_row(row);
    }
    table.to_string()
}

/// The rest, a line each.
fn rest(summary: &Summary) -> Vec<String> {
    let mut lines = vec![
        format!("stack: {} bytes at most since power came", summary.stack_bytes),
        format!(
            "telemetry of 1 in {} periods, {} lost on the way",
            summary.decimation, summary.telemetry_lost
        ),
        format!(
            "{:.1} million instructions and {} s of this computer a simulated second",
            summary.instructions_per_second / 1e6,
            short(Some(summary.wall_per_second))
        ),
    ];
    for (what, list) in [
        ("hazards of the bridge", &summary.hazards),
        ("violations of the data sheet", &summary.violations),
    ] {
        lines.push(match &list[..] {
            [] => format!("{what}: none"),
            list => format!("{what}: {}", list.join("; ")),
        });
    }
    if let Some(faulted) = &summary.fault {
        lines.push(format!("outputs off at {:.6} s: {}", faulted.time, faulted.fault));
    }
    lines
}

/// A picture: its label, what is drawn in it, and how each line is read.
type Picture = (&'static str, Vec<(&'static str, RGBColor, bool, fn(&Frame) -> f64)>);

fn pictures() -> [Picture; 5] {
    [
        (
            "speed [rad/s]",
            vec![
                ("true", TRUTH, false, |frame| frame.speed),
                ("reference", GREY, true, |frame| frame.reference),
            ],
        ),
        ("speed error [rad/s]", vec![("true", TRUTH, false, |frame| frame.z1)]),
        ("current [A]", vec![("true", TRUTH, false, |frame| frame.current)]),
        ("voltage [V]", vec![("commanded", TOLD, false, |frame| frame.voltage)]),
        (
            "load torque [N·m]",
            vec![
                ("estimated", TOLD, false, |frame| frame.load_torque_estimate),
                ("true", GREY, true, |frame| frame.load_torque),
            ],
        ),
    ]
}

/// The page of a played scenario.
pub fn html(title: &str, played: &Played) -> Result<String> {
    let Played { frames, summary, .. } = played;
    let span = frames.first().map_or(0.0, |frame| frame.time)
        ..frames.last().map_or(1.0, |frame| frame.time);
    let mut plots = Vec::new();
    for (label, lines) in pictures() {
        let lines = lines.into_iter().map(|(name, color, dashed, read)| Line {
            name: name.to_owned(),
            color,
            dashed,
            points: frames.iter().map(|frame| (frame.time, read(frame))).collect(),
        });
        let plot = Plot {
            title: String::new(),
            x_label: None,
            y_label: label.to_owned(),
            span: span.clone(),
            lines: lines.collect(),
        };
        plots.push(PreEscaped(plot.svg()?));
    }
    let body = html! {
        h1 { (title) }
        p {
            "Played by the firmware's image on an emulated B-G431B-ESC1, with the motor behind its pins. What is true is the world's, at the \
             instants at which the currents are sampled; what is estimated or commanded is telemetry's."
        }
        div class="plots" { @for plot in plots { div { (plot) } } }
        h2 { "Figures" }
        pre { (metrics_table(&[("board".to_owned(), summary.metrics.clone())])) }
        h2 { "Interrupts" }
        p { "Cycles are estimates: without wait states, and without the core's entry and exit." }
        table {
            tr { @for cell in header() { th { (cell) } } }
            @for row in rows(summary) { tr { @for cell in row { td { (cell) } } } }
        }
        ul { @for line in rest(summary) { li { (line) } } }
    };
    Ok(page(title, STYLE, &body))
}
