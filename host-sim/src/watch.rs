//! `connect … watch`: what a drive is doing, live: as a plot with keys on a terminal, as lines elsewhere.

use crate::assignment::{Assignment, Setting};
use crate::client::{Client, ClientError};
use crate::connect::in_words;
use anyhow::{Result, bail};
use clap::Args;
use crossterm::event::{self, Event, KeyCode, KeyEventKind};
use quasidrive::link::message::{Request, Status, Telemetry};
use quasidrive::supervisor::Command;
use ratatui::Frame;
use ratatui::layout::{Constraint, Layout, Rect};
use ratatui::style::{Color, Style};
use ratatui::symbols::Marker;
use ratatui::text::Line;
use ratatui::widgets::{Axis, Block, Chart, Dataset, GraphType, Paragraph};
use std::collections::VecDeque;
use std::io::{IsTerminal, Write, stdout};
use std::time::{Duration, Instant};

/// How often the status is asked for. That keeps the drive alive too.
const STATUS_TIME: Duration = Duration::from_millis(200);

/// How often the screen is drawn.
const FRAME_TIME: Duration = Duration::from_millis(40);

/// How much of the past a plot shows (s).
const SHOWN: f64 = 5.0;

/// What an arrow key changes of the commanded speed, as a share of limits.speed.
const SPEED_STEP: f32 = 0.05;

const KEYS: &str =
    "a arm   ↑ ↓ speed   0 zero   s stop   d disarm   c clear faults   q stop and quit";

/// How to watch.
#[derive(Args)]
pub struct Watch {
    /// Print lines even on a terminal.
    #[arg(long)]
    plain: bool,
    /// End after so many seconds.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..))]
    seconds: Option<u64>,
    /// Telemetry a second [default: 10 in lines, 200 in a plot].
    #[arg(long, value_name = "HZ", value_parser = clap::value_parser!(u32).range(1..=1000))]
    rate: Option<u32>,
}

/// Watches until the time is over or the user has seen enough. Gives the last status.
pub fn run(client: &mut Client, watch: &Watch) -> Result<Status> {
    let end = watch.seconds.map(|seconds| Instant::now() + Duration::from_secs(seconds));
    let is_plain = watch.plain || !stdout().is_terminal();
    let wanted = watch.rate.unwrap_or(if is_plain { 10 } else { 200 });
    let parameters = client.parameters()?;
    let [rate, fastest] = ["timing.rate", "limits.speed"].map(|name| number(&parameters, name));
    let (rate, fastest) = (rate?, fastest?);
    let decimation = (rate / wanted as f32).round().max(1.0) as u32;
    client.have_done(Request::SetTelemetry(decimation))?;
    let mut view = View::new(client, f64::from(rate), fastest)?;
    let watched = if is_plain {
        print(client, &mut view, end)
    } else {
        let mut terminal = ratatui::try_init()?;
        let watched = show(client, &mut view, end, &mut terminal);
        ratatui::try_restore()?;
        watched
    };
    watched?;
    client.have_done(Request::SetTelemetry(0))?;
    Ok(view.status)
}

fn number(parameters: &[Assignment], name: &str) -> Result<f32> {
    let found = parameters.iter().find(|(path, _)| path == name);
    match found {
        Some((_, Setting::Number(number))) => Ok(*number),
        _ => bail!("the drive does not tell its {name}"),
    }
}

/// What is shown.
struct View {
    identity: String,
    status: Status,
    /// Periods a second.
    rate: f64,
    /// Largest speed that can be commanded (rad/s).
    fastest: f32,
    /// The commanded speed (rad/s), as far as it was commanded here.
    target: f32,
    /// What the last key led to, if it was refused.
    refusal: String,
    /// When, since the beginning (s), and what.
    past: VecDeque<(f64, Telemetry)>,
    /// Periods since the first telemetry.
    periods: u64,
}

impl View {
    fn new(client: &mut Client, rate: f64, fastest: f32) -> Result<Self, ClientError> {
        Ok(Self {
            identity: client.identity().to_owned(),
            status: client.status()?,
            rate,
            fastest,
            target: 0.0,
            refusal: String::new(),
            past: VecDeque::new(),
            periods: 0,
        })
    }

    /// Adds telemetry, and forgets what is no longer shown.
    fn add(&mut self, telemetry: Telemetry) -> f64 {
        if let Some((_, before)) = self.past.back() {
            self.periods += u64::from(telemetry.period.wrapping_sub(before.period));
        }
        let time = self.periods as f64 / self.rate;
        self.past.push_back((time, telemetry));
        while self.past.front().is_some_and(|(first, _)| *first < time - SHOWN) {
            self.past.pop_front();
        }
        time
    }
}

/// As lines: a header, then one for each telemetry, and one for each change of the status.
fn print(client: &mut Client, view: &mut View, end: Option<Instant>) -> Result<()> {
    let mut out = stdout();
    writeln!(out, "# {}", view.identity)?;
    writeln!(out, "# {}", in_words(&view.status))?;
    writeln!(
        out,
        "# {:>8} {:>10} {:>10} {:>8} {:>8} {:>8} {:>10} {:>12} {:>8}",
        "time/s",
        "speed",
        "reference",
        "current",
        "voltage",
        "bus",
        "load",
        "interrupt/ns",
        "board/°C"
    )?;
    let mut asked = Instant::now();
    while end.is_none_or(|end| Instant::now() < end) {
        if asked.elapsed() > STATUS_TIME {
            asked = Instant::now();
            let status = client.status()?;
            if status != view.status {
                view.status = status;
                writeln!(out, "# {}", in_words(&status))?;
            }
        }
        for telemetry in client.telemetry()? {
            let time = view.add(telemetry);
            let Telemetry {
                speed,
                reference,
                current,
                voltage,
                bus_voltage,
                load_torque,
                temperature,
                interrupt_time,
                ..
            } = telemetry;
            writeln!(
                out,
                "{time:>10.3} {speed:>10.3} {reference:>10.3} {current:>8.3} {voltage:>8.3} {bus_voltage:>8.3} {load_torque:>10.5} {interrupt_time:>12} {temperature:>8.1}"
            )?;
        }
        out.flush()?;
    }
    Ok(())
}

/// As a plot, with keys.
fn show(
    client: &mut Client,
    view: &mut View,
    end: Option<Instant>,
    terminal: &mut ratatui::DefaultTerminal,
) -> Result<()> {
    let mut asked = Instant::now();
    let mut drawn = Instant::now();
    while end.is_none_or(|end| Instant::now() < end) {
        for telemetry in client.telemetry()? {
            view.add(telemetry);
        }
        if asked.elapsed() > STATUS_TIME {
            asked = Instant::now();
            view.status = client.status()?;
        }
        if drawn.elapsed() > FRAME_TIME {
            drawn = Instant::now();
            terminal.draw(|frame| draw(frame, view))?;
        }
        while event::poll(Duration::ZERO)? {
            if let Event::Key(key) = event::read()?
                && key.kind != KeyEventKind::Release
            {
                let Some(command) = command(key.code, view) else { return stop(client) };
                match client.command(command) {
                    Err(ClientError::Refused(reason)) => view.refusal = reason,
                    done => {
                        done?;
                        view.refusal.clear();
                    }
                }
            }
        }
    }
    Ok(())
}

/// Stops the motor, if it is driven.
fn stop(client: &mut Client) -> Result<()> {
    match client.command(Command::Stop) {
        Ok(()) | Err(ClientError::Refused(_)) => Ok(()),
        Err(error) => Err(error.into()),
    }
}

/// The command of a key; none to quit.
fn command(key: KeyCode, view: &mut View) -> Option<Command> {
    let step = SPEED_STEP * view.fastest;
    Some(match key {
        KeyCode::Char('q') | KeyCode::Esc => return None,
        // An armed drive begins with a commanded speed of zero.
        KeyCode::Char('a') => {
            view.target = 0.0;
            Command::Arm
        }
        KeyCode::Char('s') => Command::Stop,
        KeyCode::Char('d' | ' ') => Command::Off,
        KeyCode::Char('c') => Command::Clear,
        KeyCode::Char('0') => speed(view, 0.0),
        KeyCode::Up => speed(view, view.target + step),
        KeyCode::Down => speed(view, view.target - step),
        _ => Command::KeepAlive,
    })
}

fn speed(view: &mut View, target: f32) -> Command {
    view.target = target.clamp(-view.fastest, view.fastest);
    Command::Speed(view.target)
}

/// A curve: name, colour, and what it shows.
type Curve = (&'static str, Color, fn(&Telemetry) -> f32);

fn draw(frame: &mut Frame, view: &View) {
    let [head, speeds, currents, voltages, foot] = Layout::vertical([
        Constraint::Length(3),
        Constraint::Fill(2),
        Constraint::Fill(1),
        Constraint::Fill(1),
        Constraint::Length(2),
    ])
    .areas(frame.area());
    let last = view.past.back().map(|(_, telemetry)| *telemetry).unwrap_or_default();
    let numbers = format!(
        "speed {:.2} rad/s   current {:.2} A   voltage {:.2} of {:.2} V   load {:.4} N·m   board {:.1} °C   interrupt {} ns, at most {} ns",
        last.speed,
        last.current,
        last.voltage,
        last.bus_voltage,
        last.load_torque,
        last.temperature,
        last.interrupt_time,
        last.longest_interrupt_time
    );
    let lines = [view.identity.clone(), in_words(&view.status), numbers];
    frame.render_widget(Paragraph::new(lines.map(Line::from).to_vec()), head);
    let reference: Curve = ("reference", Color::DarkGray, |telemetry| telemetry.reference);
    plot(
        frame,
        speeds,
        view,
        "rad/s",
        &[reference, ("speed", Color::Cyan, |telemetry| telemetry.speed)],
    );
    plot(frame, currents, view, "A", &[("current", Color::Yellow, |telemetry| telemetry.current)]);
    plot(frame, voltages, view, "V", &[("voltage", Color::Green, |telemetry| telemetry.voltage)]);
    let keys = [view.refusal.clone(), KEYS.to_owned()];
    frame.render_widget(Paragraph::new(keys.map(Line::from).to_vec()), foot);
}

fn plot(frame: &mut Frame, area: Rect, view: &View, unit: &'static str, curves: &[Curve]) {
    let end = view.past.back().map_or(0.0, |(time, _)| *time).max(SHOWN);
    let points: Vec<Vec<(f64, f64)>> = curves
        .iter()
        .map(|(_, _, read)| {
            view.past.iter().map(|(time, telemetry)| (*time, f64::from(read(telemetry)))).collect()
        })
        .collect();
    let values = || points.iter().flatten().map(|(_, value)| *value);
    let (low, high) = (values().fold(0.0, f64::min), values().fold(0.0, f64::max));
    // Noise about nothing is not to fill the plot.
    let margin = (0.05 * (high - low)).max(0.5);
    let bounds = [low - margin, high + margin];
    let datasets = curves
        .iter()
        .zip(&points)
        .map(|((name, colour, _), points)| {
            Dataset::default()
                .name(*name)
                .marker(Marker::Braille)
                .graph_type(GraphType::Line)
                .style(Style::new().fg(*colour))
                .data(points)
        })
        .collect();
    let label = |value: f64| Line::from(format!("{value:.1}"));
    let chart = Chart::new(datasets)
        .block(Block::bordered().title(unit))
        .x_axis(Axis::default().bounds([end - SHOWN, end]))
        .y_axis(Axis::default().bounds(bounds).labels(bounds.map(label)));
    frame.render_widget(chart, area);
}

#[cfg(test)]
mod tests {
    use super::*;
    use quasidrive::fault::{ActiveLimits, Fault, Faults};
    use quasidrive::supervisor::Mode;
    use ratatui::Terminal;
    use ratatui::backend::TestBackend;

    fn view(mode: Mode) -> View {
        View {
            identity: "a board".to_owned(),
            status: Status { mode, faults: Faults::NONE, limits: ActiveLimits::NONE },
            rate: 20_000.0,
            fastest: 300.0,
            target: 0.0,
            refusal: String::new(),
            past: VecDeque::new(),
            periods: 0,
        }
    }

    fn screen(view: &View) -> String {
        let mut terminal = Terminal::new(TestBackend::new(120, 40)).expect("a terminal");
        terminal.draw(|frame| draw(frame, view)).expect("drawn");
        terminal.backend().to_string()
    }

    #[test]
    fn the_screen_shows_status_numbers_and_curves() {
        let mut running = view(Mode::Running);
        let empty = screen(&running);
        assert!(empty.contains("mode Running, faults: none") && empty.contains("rad/s"), "{empty}");
        let dots =
            |screen: &str| screen.chars().filter(|c| ('\u{2801}'..='\u{28ff}').contains(c)).count();
        assert_eq!(dots(&empty), 0);
        for period in 0..=200 {
            let speed = period as f32;
            running.add(Telemetry {
                period: 100 * period,
                speed,
                current: -1.25,
                ..Default::default()
            });
        }
        let full = screen(&running);
        assert!(full.contains("speed 200.00 rad/s   current -1.25 A"), "{full}");
        assert!(full.contains("210.0"), "the axis has room for the speed: {full}");
        assert!(dots(&full) > 50, "{full}");
        let mut faulted = view(Mode::Faulted);
        faulted.status.faults.latch(Fault::Overcurrent);
        faulted.refusal = "not while the drive is in mode Faulted".to_owned();
        let screen = screen(&faulted);
        assert!(screen.contains("mode Faulted, faults: 2 over-current"), "{screen}");
        assert!(screen.contains("not while the drive is in mode Faulted"), "{screen}");
    }

    #[test]
    fn time_goes_on_where_the_count_of_periods_wraps() {
        let mut view = view(Mode::Running);
        let at = |period| Telemetry { period, ..Default::default() };
        assert_eq!(view.add(at(u32::MAX - 9_999)), 0.0);
        assert_eq!(view.add(at(10_000)), 1.0);
        assert_eq!(view.add(at(110_000)), 6.0);
        assert_eq!(view.past.len(), 2, "what is older than the plot is forgotten");
    }

    #[test]
    fn keys_command_within_the_limits() {
        let mut view = view(Mode::Running);
        assert_eq!(command(KeyCode::Up, &mut view), Some(Command::Speed(15.0)));
        assert_eq!(command(KeyCode::Down, &mut view), Some(Command::Speed(0.0)));
        for _ in 0..30 {
            command(KeyCode::Down, &mut view);
        }
        assert_eq!(command(KeyCode::Down, &mut view), Some(Command::Speed(-300.0)));
        assert_eq!(command(KeyCode::Char('a'), &mut view), Some(Command::Arm));
        assert_eq!(command(KeyCode::Up, &mut view), Some(Command::Speed(15.0)), "from zero again");
        assert_eq!(command(KeyCode::Char('0'), &mut view), Some(Command::Speed(0.0)));
        assert_eq!(command(KeyCode::Char(' '), &mut view), Some(Command::Off));
        assert_eq!(command(KeyCode::Char('q'), &mut view), None);
    }
}
