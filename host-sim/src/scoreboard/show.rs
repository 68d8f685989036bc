//! The scoreboard in the terminal, and as one self-contained HTML page.

use super::contender::Contender;
use super::search::{Family, Measure};
use super::{CaseFigures, MATCHED_RIPPLE, Matched, Played, RigFronts, Scoreboard, Target};
use crate::plot::{Line, Plot};
use crate::report::page;
use crate::terminal::{number, table};
use anyhow::Result;
use maud::{Markup, PreEscaped, html};
use plotters::style::RGBColor;

/// A table: its heading, its columns, how many of them are text, and its rows.
struct Grid {
    heading: String,
    columns: Vec<String>,
    text_columns: usize,
    rows: Vec<Vec<String>>,
}

impl Grid {
    fn text(&self) -> String {
        let mut table = table(self.columns.clone(), self.text_columns);
        for row in &self.rows {
            table.add_row(row.clone());
        }
        format!("{}\n{table}\n", self.heading)
    }

    fn html(&self) -> Markup {
        html! {
            h2 { (self.heading) }
            table {
                tr { @for (index, column) in self.columns.iter().enumerate() { th.text[index < self.text_columns] { (column) } } }
                @for row in &self.rows {
                    tr { @for (index, cell) in row.iter().enumerate() { td.text[index < self.text_columns] { (cell) } } }
                }
            }
        }
    }
}

fn strings<const N: usize>(texts: [&str; N]) -> Vec<String> {
    texts.map(str::to_owned).to_vec()
}

/// A number with three significant digits.
fn short(value: Option<f64>) -> String {
    let Some(value) = value else { return "–".to_owned() };
    if value == 0.0 || !(1e-4..1e5).contains(&value.abs()) {
        return number(Some(value));
    }
    let decimals = (2 - value.abs().log10().floor() as i32).max(0) as usize;
    format!("{value:.decimals$}")
}

fn matched_grid(matched: &[Matched]) -> Grid {
    let row = |at: &Matched| {
        let read = |read: fn(&super::LoadStepFigures) -> f64| short(at.figures.as_ref().map(read));
        vec![
            at.motor.to_owned(),
            at.counts.to_string(),
            at.contender.name().to_owned(),
            short(at.knob),
            read(|figures| 1e3 * figures.ripple),
            read(|figures| 1e3 * figures.voltage_step),
            read(|figures| figures.dip),
            read(|figures| 1e3 * figures.recovery),
            read(|figures| figures.steady_error),
            read(|figures| figures.peak_current),
        ]
    };
    Grid {
        heading: format!(
            "Each by its one knob at a voltage ripple of {} mV rms: the load-step trial, mean over eight speeds",
            1e3 * MATCHED_RIPPLE
        ),
        columns: strings([
            "motor",
            "counts",
            "controller",
            "knob [rad/s]",
            "ripple [mV]",
            "voltage step [mV]",
            "dip [rad/s]",
            "recovery [ms]",
            "steady [rad/s]",
            "peak [A]",
        ]),
        text_columns: 3,
        rows: matched.iter().map(row).collect(),
    }
}

fn case_grid(cases: &[Played]) -> Grid {
    let mut columns = strings(["case", "controller"]);
    columns.extend(CaseFigures::FIELDS.map(|(name, unit, _, _)| format!("{name} [{unit}]")));
    columns.push("failed".to_owned());
    let mut before = "";
    let row = |at: &'_ Played, first: bool| {
        let mut row = vec![if first { at.case.clone() } else { String::new() }, at.player.clone()];
        let (mut middle, mut worst) = (at.median, at.worst);
        row.extend(CaseFigures::FIELDS.map(|(_, _, scale, field)| {
            let [middle, worst] = [field(&mut middle), field(&mut worst)]
                .map(|value| short(value.map(|value| scale * value)));
            if middle == worst { middle } else { format!("{middle} ({worst})") }
        }));
        row.push(at.failure.as_ref().map_or(String::new(), |why| format!("{}: {why}", at.failed)));
        row
    };
    let mut rows = Vec::new();
    for at in cases {
        rows.push(row(at, at.case != before));
        before = &at.case;
    }
    Grid {
        heading: "Cases: medians over the seeds, and the worst in brackets where it differs"
            .to_owned(),
        columns,
        text_columns: 2,
        rows,
    }
}

/// Dips (rad/s) whose ripple is shown.
const SHOWN_DIPS: [f64; 6] = [0.7, 0.8, 1.0, 1.3, 1.6, 2.0];

fn front_grid(fronts: &[RigFronts], measure: Measure) -> Grid {
    let mut columns = strings(["motor", "counts", "reads", "controller"]);
    columns.extend(SHOWN_DIPS.map(|dip| format!("{dip:.1} rad/s")));
    columns.push("tried".to_owned());
    columns.push("stable".to_owned());
    let mut rows = Vec::new();
    for at in fronts {
        for searched in &at.families {
            let (admissible, stable) =
                (searched.front(measure, true), searched.front(measure, false));
            let mut row = vec![
                at.motor.to_owned(),
                at.counts.to_string(),
                at.reads.to_string(),
                searched.family.name().to_owned(),
            ];
            row.extend(SHOWN_DIPS.map(|dip| {
                match (admissible.ripple_at(dip), stable.ripple_at(dip)) {
                    (Some(ripple), _) => short(Some(1e3 * ripple)),
                    (None, Some(ripple)) => format!("[{}]", short(Some(1e3 * ripple))),
                    (None, None) => "–".to_owned(),
                }
            }));
            row.extend([searched.tried.to_string(), searched.stable.len().to_string()]);
            rows.push(row);
        }
    }
    Grid {
        heading: format!(
            "Fronts: least {} in mV at a dip; in square brackets where none keeps the steady error within 0.03 rad/s",
            measure.name()
        ),
        columns,
        text_columns: 4,
        rows,
    }
}

/// The tunings of the searched peers next to the dip of the targets.
fn tuning_grid(fronts: &[RigFronts]) -> Grid {
    let mut rows = Vec::new();
    for at in fronts {
        for searched in &at.families {
            for measure in Measure::ALL {
                let (admissible, stable) =
                    (searched.front(measure, true), searched.front(measure, false));
                let found =
                    admissible.tuning_at(super::TARGET_DIP).or(stable.tuning_at(super::TARGET_DIP));
                let Some(tried) = found else { continue };
                rows.push(vec![
                    at.motor.to_owned(),
                    at.counts.to_string(),
                    at.reads.to_string(),
                    searched.family.name().to_owned(),
                    tried.tuning.clone(),
                    short(Some(tried.figures.dip)),
                    short(Some(1e3 * tried.figures.ripple)),
                    short(Some(1e3 * tried.figures.voltage_step)),
                    short(Some(1e3 * tried.figures.recovery)),
                    short(Some(tried.figures.steady_error)),
                ]);
            }
        }
    }
    Grid {
        heading: "Tunings at a dip of 1.0 rad/s: of least ripple, then of least voltage step"
            .to_owned(),
        columns: strings([
            "motor",
            "counts",
            "reads",
            "controller",
            "tuning [rad/s]",
            "dip [rad/s]",
            "ripple [mV]",
            "voltage step [mV]",
            "recovery [ms]",
            "steady [rad/s]",
        ]),
        text_columns: 5,
        rows,
    }
}

fn target_grid(targets: &[Target], quick: bool) -> Grid {
    let row = |target: &Target| {
        let verdict = match target.met {
            Some(true) if quick => "met, but the search was short",
            Some(true) => "met",
            Some(false) => "NOT met",
            None => "cannot be told",
        };
        vec![target.asked.clone(), verdict.to_owned(), target.measured.clone()]
    };
    Grid {
        heading: "Targets".to_owned(),
        columns: strings(["asked", "", "measured"]),
        text_columns: 3,
        rows: targets.iter().map(row).collect(),
    }
}

fn grids(board: &Scoreboard) -> Vec<Grid> {
    let mut grids = vec![matched_grid(&board.matched), case_grid(&board.cases)];
    if !board.fronts.is_empty() {
        grids.extend(Measure::ALL.map(|measure| front_grid(&board.fronts, measure)));
        grids.push(tuning_grid(&board.fronts));
        grids.push(target_grid(&board.targets, board.quick));
    }
    grids
}

/// What is to be known of the targets that are not met.
const WHY: &str = "A longer search can only make a peer better: what is not met stays so, what is met holds against the tunings \
                   that were found. One seed was searched. Tunings at a dip are those of least ripple that dip by it, give or \
                   take a fiftieth; peak currents count as equal within a fiftieth. Why a target is missed is not measured here.";

/// The tables, for the terminal.
pub fn text(board: &Scoreboard) -> String {
    let mut parts: Vec<String> = grids(board).iter().map(Grid::text).collect();
    if !board.targets.is_empty() {
        parts.push(format!("{WHY}\n"));
    }
    parts.join("\n")
}

fn color(family: Family) -> RGBColor {
    match family {
        Family::Drive => RGBColor(160, 20, 20),
        Family::Pi => RGBColor(30, 140, 60),
        Family::Ladrc => RGBColor(150, 90, 160),
    }
}

/// The fronts of one rig, ripple in powers of ten.
fn front_plot(fronts: &RigFronts, measure: Measure) -> Result<PreEscaped<String>> {
    let lines = fronts.families.iter().map(|searched| {
        let points = searched.front(measure, false).points().into_iter();
        Line {
            name: searched.family.name().to_owned(),
            color: color(searched.family),
            dashed: false,
            points: points
                .filter(|(dip, _)| (0.5..2.2).contains(dip))
                .map(|(dip, ripple)| (dip, (1e3 * ripple).log10()))
                .collect(),
        }
    });
    let plot = Plot {
        title: format!("{}, {} counts, {} read(s)", fronts.motor, fronts.counts, fronts.reads),
        x_label: Some("dip [rad/s]".to_owned()),
        y_label: match measure {
            Measure::Ripple => "lg(ripple / mV)",
            Measure::VoltageStep => "lg(voltage step / mV)",
        }
        .to_owned(),
        span: 0.5..2.2,
        lines: lines.filter(|line| !line.points.is_empty()).collect(),
    };
    Ok(PreEscaped(plot.svg()?))
}

const STYLE: &str = "body{font-family:sans-serif;max-width:90em;margin:2em auto;padding:0 1em}\
                     table{border-collapse:collapse;font-size:85%}th,td{text-align:right;padding:.15em .6em;\
                     border-bottom:1px solid #ddd}.text{text-align:left}svg{width:48%;min-width:28em}";

/// The report.
pub fn html(board: &Scoreboard) -> Result<String> {
    let mut plots = Vec::new();
    for fronts in &board.fronts {
        for measure in Measure::ALL {
            plots.push(front_plot(fronts, measure)?);
        }
    }
    let body = html! {
        h1 { "Scoreboard" }
        p {
            "Every controller on the same sensors, one period of delay, the same limits and the same shaping of \
             the reference, at 20 kHz. Ripple is the rms of u about its mean at constant speed, voltage step the \
             rms of its change from one period to the next; both are geometric means over eight speeds."
        }
        ul { @for contender in Contender::ALL { li { b { (contender.name()) } ": " (contender.rule()) } } }
        @if !board.targets.is_empty() { p { (WHY) } }
        @for grid in grids(board).into_iter().rev() { (grid.html()) }
        @if !plots.is_empty() {
            h2 { "Fronts of dip over ripple, of the tunings that are stable with every parameter error and recover within 12 ms" }
            @for plot in plots { (plot) }
        }
    };
    Ok(page("quasidrive: scoreboard", STYLE, &body))
}
