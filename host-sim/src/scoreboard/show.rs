//! The scoreboard in the terminal, as one self-contained HTML page, and as CSV.

use super::contender::Rule;
use super::fronts::RigFronts;
use super::response::Response;
use super::search::{Family, Measure};
use super::targets::Target;
use super::why::Why;
use super::{CaseFigures, Figure, MATCHED_RIPPLE, Matched, Played, Scoreboard, TARGET_DIP};
use crate::plot::{Line, Plot};
use crate::report::page;
use crate::terminal::{short, table};
use anyhow::Result;
use comfy_table::ContentArrangement;
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
        if self.text_columns == self.columns.len() {
            // Prose is wrapped.
            table.set_content_arrangement(ContentArrangement::Dynamic).set_width(180);
        }
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

fn matched_grid(matched: &[Matched]) -> Grid {
    let row = |at: &Matched| {
        let read = |read: fn(&super::LoadStepFigures) -> f64| short(at.figures.as_ref().map(read));
        vec![
            at.motor.to_owned(),
            at.counts.to_string(),
            at.player.clone(),
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
    columns.extend(CaseFigures::ALL.map(|figure| format!("{} [{}]", figure.name, figure.unit)));
    columns.push("failed".to_owned());
    let mut before = "";
    let row = |at: &'_ Played, first: bool| {
        let mut row = vec![if first { at.case.clone() } else { String::new() }, at.player.clone()];
        let (mut middle, mut worst) = (at.median, at.worst);
        row.extend(CaseFigures::ALL.map(|Figure { scale, field, .. }| {
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
    let mut rows = Vec::new();
    for at in fronts {
        for searched in &at.families {
            let (admissible, stable) =
                (searched.front(measure, true), searched.front(measure, false));
            let mut row = vec![
                at.motor.to_owned(),
                at.counts.to_string(),
                at.reads.label().to_owned(),
                searched.family.name().to_owned(),
            ];
            row.extend(SHOWN_DIPS.map(|dip| {
                match (admissible.ripple_at(dip), stable.ripple_at(dip)) {
                    (Some(ripple), _) => short(Some(1e3 * ripple)),
                    (None, Some(ripple)) => format!("[{}]", short(Some(1e3 * ripple))),
                    (None, None) => "–".to_owned(),
                }
            }));
            row.push(searched.tried.to_string());
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
                let found = admissible.tuning_at(TARGET_DIP).or(stable.tuning_at(TARGET_DIP));
                let Some(tried) = found else { continue };
                rows.push(vec![
                    at.motor.to_owned(),
                    at.counts.to_string(),
                    at.reads.label().to_owned(),
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

/// Targets that are missed, with the reason.
fn missed(targets: &[Target]) -> impl Iterator<Item = (&Target, &Why)> {
    targets.iter().filter_map(|target| Some((target, target.why.as_ref()?)))
}

fn missed_grid(targets: &[Target]) -> Grid {
    // What is missed for one reason stands together.
    let mut rows: Vec<Vec<String>> = Vec::new();
    for (target, why) in missed(targets) {
        match rows.iter_mut().find(|row| row[1] == why.because) {
            Some(row) => row[0] += &format!("\n{}", target.asked),
            None => rows.push(vec![target.asked.clone(), why.because.clone()]),
        }
    }
    Grid {
        heading: "Missed, and why: as measured with the same tunings on other sensors, and with other tunings".to_owned(),
        columns: strings(["missed", "why"]),
        text_columns: 2,
        rows,
    }
}

/// What the reasons were read from.
fn evidence_grid(targets: &[Target]) -> Grid {
    let rows = missed(targets).flat_map(|(target, why)| {
        why.evidence.iter().enumerate().map(move |(index, at)| {
            let missed = if index == 0 { target.asked.clone() } else { String::new() };
            vec![missed, at.what.clone(), short(at.own), short(at.peer)]
        })
    });
    Grid {
        heading: "Measured for these reasons".to_owned(),
        columns: strings(["missed", "measured", "drive form", "peer"]),
        text_columns: 2,
        rows: rows.collect(),
    }
}

fn grids(board: &Scoreboard) -> Vec<Grid> {
    let mut grids = vec![matched_grid(&board.matched), case_grid(&board.cases)];
    if !board.fronts.is_empty() {
        grids.extend(Measure::ALL.map(|measure| front_grid(&board.fronts, measure)));
        grids.push(tuning_grid(&board.fronts));
        grids.push(target_grid(&board.targets, board.quick));
        grids.push(missed_grid(&board.targets));
    }
    grids
}

/// What is to be known of the targets.
const ABOUT_TARGETS: &str = "Ripple is the rms of u about its mean, voltage step that of its change from one period to the \
                             next. A longer search can only make a peer better: what is not met stays so, what is met \
                             holds against the tunings that were found. Tunings at a dip are those of least ripple that \
                             dip by it, give or take a fiftieth; peak currents count as equal within a fiftieth.";

/// The tables, for the terminal.
pub fn text(board: &Scoreboard) -> String {
    let mut parts: Vec<String> = grids(board).iter().map(Grid::text).collect();
    if !board.targets.is_empty() {
        parts.push(format!("{ABOUT_TARGETS}\n"));
    }
    parts.join("\n")
}

/// One row for each motor, case and contender and each of `median` and `worst`, in SI units; a figure that a case or a
/// controller does not have is empty.
pub fn csv(board: &Scoreboard) -> Result<String> {
    let mut rows = csv::Writer::from_writer(Vec::new());
    let names = ["motor", "encoder_counts_per_turn", "case", "contender", "statistic"];
    let columns = CaseFigures::ALL.map(|figure| figure.column);
    rows.write_record(names.into_iter().chain(columns).chain(["failed_seeds", "failure"]))?;
    for at in &board.cases {
        for (statistic, mut figures) in [("median", at.median), ("worst", at.worst)] {
            let counts = at.counts.to_string();
            let values = CaseFigures::ALL.map(|Figure { field, .. }| {
                field(&mut figures).map_or(String::new(), |value| value.to_string())
            });
            let names = [at.motor, &counts, &at.case, &at.player, statistic].map(str::to_owned);
            let failures = [at.failed.to_string(), at.failure.clone().unwrap_or_default()];
            rows.write_record(names.into_iter().chain(values).chain(failures))?;
        }
    }
    Ok(String::from_utf8(rows.into_inner()?)?)
}

fn color(family: Family) -> RGBColor {
    match family {
        Family::Drive => RGBColor(160, 20, 20),
        Family::Pi => RGBColor(30, 140, 60),
        Family::Ladrc => RGBColor(150, 90, 160),
    }
}

const FIXED: &str = ", fixed point";

/// A contender's colour: that of its controller, lighter where its reads are shifted, darker in fixed point.
fn player_color(name: &str) -> RGBColor {
    let controllers = [
        (Rule::DriveQsmdo.name(), RGBColor(160, 20, 20)),
        (Rule::DriveQismc.name(), RGBColor(20, 20, 140)),
        (Rule::PaperQsmdo.name(), RGBColor(235, 130, 30)),
        (Rule::Backstepping.name(), RGBColor(140, 140, 140)),
        (Rule::PiByTheBook.name(), RGBColor(30, 140, 60)),
        (Rule::PiWithObserver.name(), RGBColor(20, 150, 150)),
        (Rule::Ladrc.name(), RGBColor(150, 90, 160)),
        (Family::Pi.name(), RGBColor(120, 160, 20)),
        (Family::Ladrc.name(), RGBColor(210, 60, 170)),
    ];
    let of = |found: &str| controllers.iter().find(|(name, _)| *name == found).map(|at| at.1);
    let lighter = |RGBColor(r, g, b): RGBColor| {
        let [r, g, b] = [r, g, b].map(|part| part + (255 - part) / 2);
        RGBColor(r, g, b)
    };
    let darker = |RGBColor(r, g, b): RGBColor| RGBColor(r / 2, g / 2, b / 2);
    let [shifted, fixed] = [", shifted reads", FIXED].map(|suffix| name.strip_suffix(suffix));
    of(name)
        .or_else(|| of(shifted?).map(lighter))
        .or_else(|| of(fixed?).map(darker))
        .unwrap_or(RGBColor(0, 0, 0))
}

/// A case's view by every contender, whose names stand in the legend beside all of them.
fn response_plot(responses: &[(&str, &Response)]) -> Result<PreEscaped<String>> {
    let [(_, first), ..] = responses else { return Ok(PreEscaped(String::new())) };
    let view = first.view;
    // The contenders that matter most lie on top, and on them, dashed, what nearly hides them.
    let (fixed, others): (Vec<_>, Vec<_>) =
        responses.iter().rev().partition(|(name, _)| name.ends_with(FIXED));
    let lines = others.into_iter().chain(fixed).map(|(name, response)| Line {
        name: String::new(),
        color: player_color(name),
        dashed: name.ends_with(FIXED),
        points: response.signal.points(),
    });
    let reference = view.reference.then(|| Line {
        name: "reference".to_owned(),
        color: RGBColor(0, 0, 0),
        dashed: true,
        points: first.reference.points(),
    });
    let plot = Plot {
        title: view.title.to_owned(),
        x_label: None,
        y_label: view.y_label.to_owned(),
        span: view.span[0]..view.span[1],
        lines: lines.chain(reference).collect(),
    };
    Ok(PreEscaped(plot.svg()?))
}

/// The time responses of every case that has views.
fn response_section(cases: &[Played]) -> Result<Markup> {
    let shown: Vec<&Played> = cases.iter().filter(|at| !at.responses.is_empty()).collect();
    let mut names: Vec<&str> = Vec::new();
    for at in &shown {
        if !names.contains(&at.player.as_str()) {
            names.push(&at.player);
        }
    }
    let mut plots = Vec::new();
    for of_case in shown.chunk_by(|a, b| a.case == b.case) {
        for view in 0..of_case[0].responses.len() {
            let responses: Vec<_> =
                of_case.iter().map(|at| (at.player.as_str(), &at.responses[view])).collect();
            plots.push(response_plot(&responses)?);
        }
    }
    Ok(html! {
        @if !plots.is_empty() {
            h2 { "Time responses, each at the same voltage ripple" }
            p {
                @for name in names {
                    @let RGBColor(r, g, b) = player_color(name);
                    span.key style=(format!("border-color:rgb({r},{g},{b})")) { (name) } " "
                }
            }
            @for plot in plots { (plot) }
        }
    })
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
        title: format!(
            "{}, {} counts, reads: {}",
            fronts.motor,
            fronts.counts,
            fronts.reads.label()
        ),
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
                     border-bottom:1px solid #ddd}.text{text-align:left;white-space:pre-line}.key{border-left:1.6em solid;padding-left:.4em;\
                     margin-right:1em;white-space:nowrap}svg{width:48%;min-width:28em}";

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
        ul { @for rule in Rule::ALL { li { b { (rule.name()) } ": " (rule.in_words()) } } }
        (response_section(&board.cases)?)
        @if !plots.is_empty() {
            h2 { "Fronts of dip over ripple, of the tunings that are stable with every parameter error and recover within 12 ms" }
            @for plot in plots { (plot) }
        }
        @if !board.targets.is_empty() { p { (ABOUT_TARGETS) } }
        @for grid in grids(board).into_iter().rev() { (grid.html()) }
        @if !board.targets.is_empty() { (evidence_grid(&board.targets).html()) }
    };
    Ok(page("quasidrive: scoreboard", STYLE, &body))
}
