//! What the reproduction shows: a summary for the terminal, and one self-contained HTML page.

use crate::frame::Frame;
use crate::metrics::{Figures, Metrics};
use crate::plot::{Line, Plot};
use crate::reproduction::{Reproduction, Run, SETTLED, Window};
use crate::scenario::Controller;
use crate::terminal::{number, table};
use anyhow::{Context, Result};
use maud::{DOCTYPE, Markup, PreEscaped, html};
use plotters::style::RGBColor;

const GREY: RGBColor = RGBColor(90, 90, 90);

fn color(controller: Controller) -> RGBColor {
    match controller {
        Controller::Bs => RGBColor(140, 140, 140),
        Controller::BsQsmdo => RGBColor(200, 60, 20),
        Controller::BsQismc => RGBColor(20, 90, 180),
        Controller::DriveQsmdo => RGBColor(160, 20, 20),
        Controller::DriveQismc => RGBColor(20, 20, 140),
        Controller::Pi => RGBColor(30, 140, 60),
        Controller::Ladrc => RGBColor(150, 90, 160),
    }
}

/// The columns of the paper's Table 2, and what belongs beside them.
const COLUMNS: [&str; 9] = [
    "setting",
    "controller",
    "rms z1 [rad/s]",
    "rms z2 [rad/s²]",
    "rms u [V]",
    "rms T̃_l [N·m]",
    "steady rms z1 [rad/s]",
    "first u [V]",
    "overshoot [%]",
];

fn cycle_rows(results: &Reproduction) -> Vec<Vec<String>> {
    let near = results.near_continuous.iter().map(|run| ("near-continuous", run));
    let drive = results.drive.iter().map(|run| ("20 kHz, delay", run));
    let row = |(setting, run): (&'static str, &Run)| {
        let Metrics { whole, steady } = &run.metrics;
        let figures = [
            whole.rms_z1,
            whole.rms_z2,
            whole.rms_voltage,
            whole.rms_load_torque_error,
            steady.rms_z1,
            whole.first_voltage,
        ];
        let names = [setting.to_owned(), run.controller.to_string()];
        let overshoot = format!("{:.2}", run.overshoot);
        names.into_iter().chain(figures.map(number)).chain([overshoot]).collect()
    };
    near.chain(drive).map(row).collect()
}

/// Ratios of a figure between two runs.
struct Comparison {
    what: &'static str,
    explicit: Option<f64>,
    implicit: Option<f64>,
}

impl Comparison {
    fn ratio(&self) -> Option<f64> {
        Some(self.explicit? / self.implicit?)
    }
}

fn forms(results: &Reproduction) -> [Comparison; 3] {
    let read = |what, figure: fn(&Figures) -> Option<f64>| Comparison {
        what,
        explicit: figure(&results.explicit.metrics.steady),
        implicit: figure(&results.drive[1].metrics.steady),
    };
    [
        read("rms change of u from sample to sample [V]", |figures| figures.rms_voltage_step),
        read("rms load torque error [N·m]", |figures| figures.rms_load_torque_error),
        read("rms z1 [rad/s]", |figures| figures.rms_z1),
    ]
}

/// How a figure of BS-QSMDO compares with BS-QISMC's, in words.
fn against_qismc(runs: &[Run], figure: fn(&Figures) -> Option<f64>) -> String {
    let [_, qsmdo, qismc] = runs else { return "not played".to_owned() };
    match (figure(&qsmdo.metrics.whole), figure(&qismc.metrics.whole)) {
        (Some(qsmdo), Some(qismc)) => {
            let excess = (qsmdo / qismc - 1.0) * 100.0;
            let direction = if excess < 0.0 { "lower" } else { "higher" };
            format!("{} % {direction}", number(Some(excess.abs())))
        }
        _ => "unknown".to_owned(),
    }
}

/// One line a bound: name, near-continuous, 20 kHz.
fn bound_rows(results: &Reproduction) -> [(&'static str, f64, f64); 7] {
    let (near, drive) = (&results.near_continuous_bounds, &results.drive_bounds);
    [
        ("|d̃|: the paper's bound (32) [rad/s²]", near.paper, drive.paper),
        ("|d̃|: reached in simulation", near.reached, drive.reached),
        ("|d̃|: corrected bound, pointwise", near.corrected, drive.corrected),
        ("|d̃|: corrected bound, from suprema", near.from_suprema, drive.from_suprema),
        ("‖z‖: the paper's bound (36)", near.paper_norm, drive.paper_norm),
        ("‖z‖: reached in simulation", near.reached_norm, drive.reached_norm),
        ("‖z‖: corrected bound", near.corrected_norm, drive.corrected_norm),
    ]
}

/// The tables, for the terminal.
pub fn summary(results: &Reproduction) -> String {
    let mut cycle = table(COLUMNS.map(str::to_owned).to_vec(), 2);
    for row in cycle_rows(results) {
        cycle.add_row(row);
    }
    let header = ["BS-QSMDO at 20 kHz with delay, steady", "explicit", "implicit", "ratio"];
    let mut comparison = table(header.map(str::to_owned).to_vec(), 1);
    for row in forms(results) {
        let cells = [row.explicit, row.implicit, row.ratio()].map(number);
        comparison.add_row([row.what.to_owned()].into_iter().chain(cells));
    }
    let header =
        ["ultimate bounds, BS-QSMDO in double precision", "near-continuous", "20 kHz, delay"];
    let mut bounds = table(header.map(str::to_owned).to_vec(), 1);
    for (name, near, drive) in bound_rows(results) {
        bounds.add_row([name.to_owned(), number(Some(near)), number(Some(drive))]);
    }
    let coincidence = &results.coincidence;
    format!(
        "The paper's drive cycle (its Table 2 holds the four rms columns)\n{cycle}\n\n{comparison}\n\n{bounds}\n\n\
         BS-QSMDO and BS-QISMC with equal starts and a smooth reference differ by {} V at most, of {} V.\n",
        number(Some(coincidence.voltage)),
        number(Some(coincidence.largest_voltage)),
    )
}

/// A signal of a run over a window.
fn line(run: &Run, window: Window, read: Signal) -> Line {
    Line {
        name: run.controller.to_string(),
        color: color(run.controller),
        dashed: false,
        points: run.frames(window).iter().map(|frame| (frame.time, read(frame))).collect(),
    }
}

/// How a signal is read from a period.
type Signal = fn(&Frame) -> f64;

/// The same signal of several runs in one plot.
struct Panel {
    window: Window,
    y_label: &'static str,
    controllers: &'static [Controller],
    signal: Signal,
    /// What the signal is to follow, drawn dashed, and its name.
    target: Option<(&'static str, Signal)>,
}

impl Panel {
    fn svg(&self, runs: &[Run], setting: &str) -> Result<PreEscaped<String>> {
        let shown = runs.iter().filter(|run| self.controllers.contains(&run.controller));
        let mut lines: Vec<Line> =
            shown.clone().map(|run| line(run, self.window, self.signal)).collect();
        if let (Some((name, read)), Some(run)) = (self.target, shown.clone().next()) {
            let target = line(run, self.window, read);
            lines.push(Line { name: name.to_owned(), color: GREY, dashed: true, ..target });
        }
        let title = format!(
            "{setting}{}",
            match self.window {
                Window::Cycle => "",
                Window::Start => " — start",
                Window::Jump => " — jump at 3 s",
                Window::Steady => " — steady",
                Window::Periods => " — 40 periods",
            }
        );
        let span = self.window.span();
        let plot = Plot { title, x_label: None, y_label: self.y_label.to_owned(), span, lines };
        Ok(PreEscaped(plot.svg()?))
    }
}

/// A figure of the paper, redrawn.
struct Figure {
    number: u32,
    title: &'static str,
    caption: &'static str,
    panels: Vec<Panel>,
}

fn figures() -> Vec<Figure> {
    use Controller::{Bs, BsQismc, BsQsmdo};
    const ALL: &[Controller] = &[Bs, BsQsmdo, BsQismc];
    const BOTH: &[Controller] = &[BsQsmdo, BsQismc];
    const QSMDO: &[Controller] = &[BsQsmdo];
    let panel = |window, y_label, controllers, signal, target| Panel {
        window,
        y_label,
        controllers,
        signal,
        target,
    };
    let reference: Option<(&'static str, Signal)> = Some(("reference", |frame| frame.reference));
    let torque: Option<(&'static str, Signal)> = Some(("load torque", |frame| frame.load_torque));
    let speed: Signal = |frame| frame.speed;
    let z1: Signal = |frame| frame.z1;
    let voltage: Signal = |frame| frame.voltage;
    let z2: Signal = |frame| frame.z2;
    let current: Signal = |frame| frame.current;
    let speed_estimate: Signal = |frame| frame.speed - frame.sliding1;
    let estimation_error: Signal = |frame| frame.sliding1;
    let torque_estimate: Signal = |frame| frame.load_torque_estimate;
    let torque_error: Signal = |frame| frame.load_torque - frame.load_torque_estimate;
    vec![
        Figure {
            number: 3,
            title: "Rotor speed",
            caption: "BS-QSMDO starts with its observer off its surface: it is faster and overshoots the first \
                      step, BS-QISMC does not. At the jump of the reference it is the other way round: the jump throws \
                      s1 off its surface, but not x̂1. The paper's text tells of the first, not of the second. Plain BS \
                      is pulled away by the load.",
            panels: vec![
                panel(Window::Cycle, "ω [rad/s]", ALL, speed, reference),
                panel(Window::Start, "ω [rad/s]", ALL, speed, reference),
                panel(Window::Jump, "ω [rad/s]", ALL, speed, reference),
            ],
        },
        Figure {
            number: 4,
            title: "Tracking error z1",
            caption: "Once settled, BS-QSMDO and BS-QISMC have the same error, a ten-thousandth of plain BS's. The \
                      20 kHz loop with its delay errs by half as much again.",
            panels: vec![
                panel(Window::Cycle, "z1 [rad/s]", ALL, z1, None),
                panel(Window::Steady, "z1 [rad/s]", BOTH, z1, None),
            ],
        },
        Figure {
            number: 5,
            title: "Armature voltage u",
            caption: "BS-QSMDO's first voltage is higher by La·k2/a2 = 0.107 V: its second injection is saturated, \
                      with ẑ2 = 0 far from z2.",
            panels: vec![
                panel(Window::Cycle, "u [V]", ALL, voltage, None),
                panel(Window::Start, "u [V]", ALL, voltage, None),
            ],
        },
        Figure {
            number: 6,
            title: "Error of the virtual control z2",
            caption: "The current follows the virtual control. What is left in the steady part at 20 kHz is \
                      rounding: an f32 holds a speed of 136 rad/s to 1.5e-5 rad/s, and the paper's gains differentiate \
                      that twice.",
            panels: vec![
                panel(Window::Start, "z2 [rad/s²]", ALL, z2, None),
                panel(Window::Steady, "z2 [rad/s²]", BOTH, z2, None),
            ],
        },
        Figure {
            number: 7,
            title: "Armature current",
            caption: "Near-continuous the highest initial current is BS-QSMDO's, as in the paper. With the delay the \
                      voltage of the steep start comes late by more than the second injection can make up (0.107 V), \
                      which saturates in both, and both draw the same current.",
            panels: vec![
                panel(Window::Cycle, "i [A]", ALL, current, None),
                panel(Window::Start, "i [A]", ALL, current, None),
            ],
        },
        Figure {
            number: 8,
            title: "Speed and its estimate in QSMDO",
            caption: "The observer's x̂1 lies on the speed: the mismatch of Figure 9 is not to be seen here.",
            panels: vec![panel(
                Window::Start,
                "x̂1 [rad/s]",
                QSMDO,
                speed_estimate,
                Some(("speed", speed)),
            )],
        },
        Figure {
            number: 9,
            title: "Estimation error ω − x̂1 in QSMDO",
            caption: "It holds the disturbance: d̂ = k1·tanh((ω − x̂1)/ε1). With |d| near k1 it reaches 2·ε1.",
            panels: vec![panel(Window::Cycle, "ω − x̂1 [rad/s]", QSMDO, estimation_error, None)],
        },
        Figure {
            number: 10,
            title: "Load torque and its estimates",
            caption: "Both estimates lie on the load but for BS-QISMC's at the jumps of the reference, which are no \
                      load.",
            panels: vec![
                panel(Window::Cycle, "T̂_l [N·m]", BOTH, torque_estimate, torque),
                panel(Window::Start, "T̂_l [N·m]", BOTH, torque_estimate, torque),
            ],
        },
        Figure {
            number: 11,
            title: "Error of the load torque estimate",
            caption: "The steady error is the same for both. Figure 12 holds it against the bounds.",
            panels: vec![
                panel(Window::Cycle, "T̃_l [N·m]", BOTH, torque_error, None),
                panel(Window::Steady, "T̃_l [N·m]", BOTH, torque_error, None),
            ],
        },
    ]
}

/// |d̃| of the near-continuous BS-QSMDO between the paper's bound and the corrected one, over the cycle.
fn bounds_plot(results: &Reproduction) -> Result<PreEscaped<String>> {
    let run = &results.near_continuous[1];
    let inertia = results.scenario.motor.inertia;
    let bounds = &results.near_continuous_bounds;
    let settled = |frame: &&Frame| frame.time > SETTLED;
    let error = |frame: &Frame| {
        let torque_error = frame.load_torque - frame.load_torque_estimate;
        (frame.time, torque_error.abs() / inertia)
    };
    let level = |name: &str, color, value| Line {
        name: name.to_owned(),
        color,
        dashed: true,
        points: vec![(0.0, value), (10.0, value)],
    };
    let plot = Plot {
        title: "BS-QSMDO, near-continuous".to_owned(),
        x_label: None,
        y_label: "|d̃| [rad/s²]".to_owned(),
        span: Window::Cycle.span(),
        lines: vec![
            Line {
                name: "simulated".to_owned(),
                color: color(Controller::BsQsmdo),
                dashed: false,
                points: run.frames(Window::Cycle).iter().filter(settled).map(error).collect(),
            },
            level("the paper's bound (32)", RGBColor(120, 20, 140), bounds.paper),
            level("corrected bound", RGBColor(20, 120, 60), bounds.corrected),
        ],
    };
    Ok(PreEscaped(plot.svg()?))
}

/// Explicit and implicit form of BS-QSMDO at 20 kHz.
fn forms_plot(
    results: &Reproduction,
    window: Window,
    y_label: &str,
    read: Signal,
) -> Result<PreEscaped<String>> {
    let named =
        |name: &str, color, run| Line { name: name.to_owned(), color, ..line(run, window, read) };
    let title = match window {
        Window::Periods => "20 kHz, delay — 40 periods",
        _ => "20 kHz, delay — steady",
    };
    let plot = Plot {
        title: title.to_owned(),
        x_label: None,
        y_label: y_label.to_owned(),
        span: window.span(),
        lines: vec![
            named("explicit", RGBColor(150, 150, 150), &results.explicit),
            named("implicit", color(Controller::BsQsmdo), &results.drive[1]),
        ],
    };
    Ok(PreEscaped(plot.svg()?))
}

/// The plots of the README, by file name.
pub fn readme_plots(results: &Reproduction) -> Result<Vec<(&'static str, String)>> {
    let figures = figures();
    let speed = figures.iter().find(|figure| figure.number == 3);
    let start = speed.and_then(|figure| figure.panels.get(1)).context("Figure 3 has no start")?;
    Ok(vec![
        ("start.svg", start.svg(&results.drive, "20 kHz, delay")?.0),
        ("forms.svg", forms_plot(results, Window::Periods, "u [V]", |frame| frame.voltage)?.0),
    ])
}

pub(crate) const STYLE: &str = "
body { font: 16px/1.5 system-ui, sans-serif; color: #222; max-width: 1320px; margin: 2em auto; padding: 0 1.5em; }
h1 { line-height: 1.2; } h2 { margin-top: 2.2em; border-bottom: 1px solid #ccc; }
table { border-collapse: collapse; margin: 1em 0; font-variant-numeric: tabular-nums; }
th, td { padding: .25em .8em; border-bottom: 1px solid #ddd; text-align: right; }
th { border-bottom: 2px solid #888; vertical-align: bottom; }
.text { text-align: left; }
figure { margin: 2em 0; } figcaption { max-width: 60em; }
.plots { display: grid; grid-template-columns: 1fr 1fr; gap: .5em; }
@media (max-width: 800px) { .plots { grid-template-columns: 1fr; } }
svg { width: 100%; height: auto; } p, li { max-width: 60em; } code { background: #f3f3f3; padding: 0 .2em; }
";

/// The whole report.
pub fn html(results: &Reproduction) -> Result<String> {
    let body = html! {
        h1 { "The paper reproduced" }
        (introduction())
        (cycle_section(results))
        @for figure in figures() { (figure_section(results, &figure)?) }
        (forms_section(results)?)
        (disagreements(results)?)
    };
    Ok(page("quasidrive: the paper reproduced", STYLE, &body))
}

/// A page that needs nothing but itself.
pub(crate) fn page(title: &str, style: &str, body: &Markup) -> String {
    let page = html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                title { (title) }
                style { (PreEscaped(style)) }
            }
            body { (body) }
        }
    };
    page.into_string()
}

fn introduction() -> Markup {
    html! {
        p {
            "Backstepping with a quasi-sliding-mode disturbance observer (BS-QSMDO) and with quasi-integral sliding \
             mode control (BS-QISMC), after Hameed, Al-Samarraie, Humaidi and Saeed, World Electr. Veh. J. 2024, 15, 419, \
             played by quasidrive's control core against its simulated motor. Plain backstepping (BS) is the baseline. \
             Every figure stands twice:"
        }
        ul {
            li { b { "near-continuous" } ": the paper's setting. A step of 1 µs, no delay, double precision." }
            li {
                b { "20 kHz, delay" } ": as the drive runs it. One step a PWM period, the injections closed \
                implicitly, the voltage one period late, in f32: the code that is flashed."
            }
        }
        p {
            "Sensors are ideal in both. The figures have the paper's numbers. Its text does not tell where its figures \
             zoom in; the zooms here are chosen for what the captions say."
        }
    }
}

fn cycle_section(results: &Reproduction) -> Markup {
    let compared = |runs: &[Run]| {
        let z1 = against_qismc(runs, |figures| figures.rms_z1);
        let u = against_qismc(runs, |figures| figures.rms_voltage);
        format!("rms z1 {z1}, rms u {u}")
    };
    html! {
        h2 { "Table 2: figures over the whole cycle" }
        table {
            tr { @for (index, column) in COLUMNS.iter().enumerate() { th.text[index < 2] { (column) } } }
            @for row in &cycle_rows(results) {
                tr { @for (index, cell) in row.iter().enumerate() { td.text[index < 2] { (cell) } } }
            }
        }
        p {
            "T̃_l is the error of the load torque estimate; plain BS estimates none, so its whole load counts. Steady \
             leaves out the 1.5 s after each jump of the reference."
        }
        p {
            "The paper concludes that BS-QSMDO's ultimate bound is 0.36 % lower and its control effort 0.0853 % higher \
             than BS-QISMC's. Here, near-continuous: " (compared(&results.near_continuous)) "; at 20 kHz: "
            (compared(&results.drive)) ". These amounts come from the starts and from the jumps of the reference alone, and \
             the paper does not say how its simulation treats ω̇_d there (here it is zero). In the steady parts the two do \
             not differ."
        }
    }
}

fn figure_section(results: &Reproduction, figure: &Figure) -> Result<Markup> {
    let mut plots = Vec::new();
    for panel in &figure.panels {
        plots.push(panel.svg(&results.near_continuous, "near-continuous")?);
        plots.push(panel.svg(&results.drive, "20 kHz, delay")?);
    }
    Ok(html! {
        figure id={ "figure-" (figure.number) } {
            h2 { "Figure " (figure.number) ": " (figure.title) }
            figcaption { (figure.caption) }
            div.plots { @for plot in &plots { (plot) } }
        }
    })
}

fn forms_section(results: &Reproduction) -> Result<Markup> {
    let comparisons = forms(results);
    Ok(html! {
        h2 { "Why not explicit Euler: the two forms at 20 kHz" }
        p {
            "With the paper's gains the second injection moves z2 by h·k2/ε2 = 7.55 times its mismatch in one period; \
             forward Euler overshoots from 2 on, with the delay from 1 on, and lives in a limit cycle. The implicit form \
             solves for the injection \
             that is right at the end of the step, and costs one table look-up as well. Both run the same states and the \
             same gains here."
        }
        table {
            tr { th.text { "BS-QSMDO, steady" } th { "explicit" } th { "implicit" } th { "ratio" } }
            @for row in &comparisons {
                tr {
                    td.text { (row.what) }
                    td { (number(row.explicit)) }
                    td { (number(row.implicit)) }
                    td { (number(row.ratio())) }
                }
            }
        }
        div.plots {
            (forms_plot(results, Window::Periods, "u [V]", |frame| frame.voltage)?)
            (forms_plot(results, Window::Steady, "T̃_l [N·m]", |frame| {
                frame.load_torque - frame.load_torque_estimate
            })?)
        }
    })
}

fn disagreements(results: &Reproduction) -> Result<Markup> {
    let coincidence = &results.coincidence;
    Ok(html! {
        h2 { "Where the paper and its own equations disagree" }
        h3 { "The bound on the estimation error" }
        p {
            "Equations (32) and (56) bound |d̃| by ε·|ḋ|/k, with the slope of tanh at zero, where it is steepest. But the \
             estimate k·tanh(x̃/ε) must equal d, and there the slope is less by the factor 1 − (d/k)². The paper's own \
             load brings d to 0.96·k1, and the simulation exceeds the bound; it stays below the corrected one, \
             sup ε·|ḋ|/(k·(1 − (d/k)²)), and comes close to it."
        }
        table {
            tr { th.text { "BS-QSMDO, double precision" } th { "near-continuous" } th { "20 kHz, delay" } }
            @for (name, near, drive) in bound_rows(results) {
                tr { td.text { (name) } td { (number(Some(near))) } td { (number(Some(drive))) } }
            }
        }
        p {
            "Reached: outside the 0.2 s after each jump of the reference. At 20 kHz the corrected bound includes h·sup|ḋ|, \
             since an implicit estimate is one period old at worst, and that on ‖z‖ a term for the voltage that comes late."
        }
        figure {
            h3 { "Figure 12: the simulated error between the two bounds" }
            div.plots { (bounds_plot(results)?) }
        }
        h3 { "Two controllers, one algorithm" }
        p {
            "By the paper's own equations (ω − x̂1)' = d − d̂ = s1' and (z2 − ẑ2)' = ζ2 + u2 = s2': observer and integral \
             sliding mode obey the same differential equations. They differ in where they start, and in that s1 jumps with \
             the reference while x̂1 does not. Started alike and given a smooth reference (second order, 50 rad/s), their \
             voltages differ by " (number(Some(coincidence.voltage))) " V at most over the whole cycle, of "
            (number(Some(coincidence.largest_voltage))) " V, and their speeds by " (number(Some(coincidence.speed)))
            " rad/s. What the paper finds between them is the difference of the starts."
        }
        h3 { "Errata" }
        ul {
            li { "(2) prints +a4·x2, and a4 = Kb/Ra below it; Kirchhoff's law gives −a4·x2 and a4 = Ra/La." }
            li {
                "(4) prints −a·x1 in the virtual control; cancelling −a1·x1 takes +a1·x1. The sign runs on: a2·(a4 − a1) and \
                 +a1² in (8), (11), (21), (45) and (47) become a2·(a4 + a1) and −a1², and ζ1 = (a1 + c)·d above (11) becomes \
                 (c − a1)·d."
            }
            li { "z2 is x2 − x2* above (7), but a2·x2 − x2* from (7) on; the latter is meant." }
            li { "(8) and (45) lack a2 on −a3·x1 − a4·x2 + u/La, (47) on a3·x1 and a4·x2." }
            li { "(21), (47) print +c·d̂ in u1, which would leave c·d instead of c·d̃ in ζ2: it is left out." }
            li { "(26), (54) are followed by conditions on k1 and kc1; k2, kc2 > |ζ2| are meant." }
            li { "(53) prints u2 = +kc2·tanh(s2/η2), which diverges: u2 = −kc2·tanh(s2/η2)." }
        }
    })
}
