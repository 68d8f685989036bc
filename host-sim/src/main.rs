//! `host-sim`: plays scenarios against the simulated motor.

use anyhow::{Context, Result, bail};
use clap::{Args, Parser, Subcommand, ValueEnum};
use host_sim::connect::{self, Connect};
use host_sim::double::SimulatedScalar;
use host_sim::emulated::agreement::Agreement;
use host_sim::flash::SimulatedFlash;
use host_sim::frame::Frame;
use host_sim::interruption::interruption;
use host_sim::link::{LinkError, Local, LockStep};
use host_sim::metrics::Metrics;
use host_sim::qemu::{Emulator, PATIENCE, Qemu};
use host_sim::reproduction::PERIODS_PER_TICK;
use host_sim::scenario::{Controller, FormName, Scenario, ScenarioError};
use host_sim::simulation::{Outcome, ScalarName, simulate_in, simulate_on};
use host_sim::virtual_drive::VirtualDrive;
use host_sim::{emulated, report, reproduction, scoreboard, terminal};
use indicatif::{ProgressBar, ProgressStyle};
use quasidrive::drive::Fault;
use quasidrive::math::Q31;
use quasidrive::protocol::Word;
use quasidrive::supervisor::Mode;
use serde::Serialize;
use std::io::{ErrorKind, Write, stdout};
use std::net::{Ipv4Addr, TcpListener};
use std::path::{Path, PathBuf};
use std::process::ExitCode;

/// Plays scenarios: quasidrive's speed loop against a simulated brushed DC motor.
///
/// Exit codes: 0 done; 1 could not be done; 2 wrong usage or a refused scenario; 3 the drive stopped with a fault, or has one.
#[derive(Parser)]
#[command(version)]
struct Cli {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand)]
enum Command {
    /// Play one scenario and print its figures.
    Run {
        /// Scenario file (TOML); host-sim/scenarios/README.md documents the format.
        file: PathBuf,
        /// Print one JSON object instead of a table.
        #[arg(long)]
        json: bool,
        /// Write every period to a CSV file.
        #[arg(long, value_name = "OUT")]
        csv: Option<PathBuf>,
        #[command(flatten)]
        overrides: Overrides,
    },
    /// Play one scenario with the firmware's image on an emulated B-G431B-ESC1, with the scenario's motor wired to it.
    ///
    /// Exit code 1 also if the firmware misused bridge or microcontroller.
    Board {
        /// Scenario file (TOML).
        file: PathBuf,
        /// The image.
        #[arg(long, value_name = "FILE", default_value = ESC1)]
        elf: PathBuf,
        /// Simulated time (s).
        #[arg(long, value_name = "S")]
        duration: Option<f64>,
        /// Controller.
        #[arg(long)]
        controller: Option<Controller>,
        /// Play it on the averaged board too, and hold both speeds against each other; exit code 1 if they do not agree.
        #[arg(long)]
        agreement: bool,
        /// Print one JSON object instead of tables.
        #[arg(long)]
        json: bool,
        /// Write what telemetry told, with the truth beside it, to a CSV file.
        #[arg(long, value_name = "OUT")]
        csv: Option<PathBuf>,
        /// Write an HTML report.
        #[arg(long, value_name = "OUT")]
        report: Option<PathBuf>,
    },
    /// Break everything on and around the emulated board, one after the other, and see that the bridge goes off in time; and see that what
    /// must not stop it does not. Exit code 1 if a case fails.
    Campaign {
        /// The image.
        #[arg(long, value_name = "FILE", default_value = ESC1)]
        elf: PathBuf,
        /// Play only the cases whose name contains this.
        #[arg(long, value_name = "NAME")]
        only: Option<String>,
        /// Print one JSON array instead of a table.
        #[arg(long)]
        json: bool,
    },
    /// Reproduce the paper's figures and its Table 2, and write an HTML report.
    Paper {
        /// Where the report goes.
        #[arg(long, value_name = "OUT", default_value = "target/paper.html")]
        report: PathBuf,
        /// Write the README's plots to this folder instead.
        #[arg(long, value_name = "FOLDER", conflicts_with = "report")]
        plots: Option<PathBuf>,
    },
    /// Play every controller in every case at the same voltage ripple, search the peers' best tunings, and measure why targets
    /// are missed where they are. Some eight minutes on two cores.
    Bench {
        /// Shorter searches, only on the paper's motor with 4096 and 1024 counts, and one seed: half a minute.
        #[arg(long)]
        quick: bool,
        /// Print one JSON object instead of tables.
        #[arg(long)]
        json: bool,
        /// Write an HTML report.
        #[arg(long, value_name = "OUT")]
        report: Option<PathBuf>,
        /// Write every contender's figures in every case to a CSV file, a row for the median over the seeds and one for the
        /// worst.
        ///
        /// Columns, in SI units: motor, encoder_counts_per_turn, case, contender, statistic (median or worst),
        /// rms_error_rad_per_s, peak_error_rad_per_s, dip_rad_per_s, recovery_s, overshoot_per_unit (of the command's jump),
        /// peak_current_a, voltage_step_v, load_torque_error_n_m, failed_seeds, failure (the first one's reason). What a case or
        /// a contender does not have is empty.
        #[arg(long, value_name = "OUT")]
        csv: Option<PathBuf>,
        /// Seeds that every case is played with [default: 5, with --quick 1].
        #[arg(long, value_name = "N", value_parser = clap::value_parser!(u64).range(1..=1000))]
        seeds: Option<u64>,
        /// Play only the cases whose name contains this, and search nothing.
        #[arg(long, value_name = "NAME")]
        case: Option<String>,
    },
    /// Run the drive of a scenario in real time behind a socket, for `connect`.
    ///
    /// The drive is the firmware's, on the simulated motor, with the scenario's load; speeds are commanded by `connect`.
    Serve {
        /// Scenario file (TOML).
        file: PathBuf,
        /// Port at 127.0.0.1; 0 for a free one.
        #[arg(long, default_value_t = 4711)]
        port: u16,
        /// File for the drive's flash, so that saved parameters outlive it.
        #[arg(long, value_name = "FILE")]
        flash: Option<PathBuf>,
        /// Instead of the drive in this program, the firmware's image on an emulated B-G431B-ESC1.
        #[arg(long, value_name = "FILE", conflicts_with = "flash")]
        elf: Option<PathBuf>,
    },
    /// Command and watch a drive, on a board or served.
    Connect(Connect),
    /// Play several scenarios and print their figures side by side.
    Compare {
        /// Scenario files (TOML).
        #[arg(required = true)]
        files: Vec<PathBuf>,
        /// Print one JSON array instead of a table.
        #[arg(long)]
        json: bool,
        #[command(flatten)]
        overrides: Overrides,
    },
}

/// Where `cargo xtask firmware` puts the board's image.
const ESC1: &str = "target/firmware/b_g431b_esc1.elf";

/// What replaces a scenario's own settings.
#[derive(Args)]
struct Overrides {
    /// Controller.
    #[arg(long)]
    controller: Option<Controller>,
    /// Sampling rate (Hz).
    #[arg(long, value_name = "HZ", allow_negative_numbers = true)]
    rate: Option<f64>,
    /// Simulated time (s).
    #[arg(long, value_name = "S", allow_negative_numbers = true)]
    duration: Option<f64>,
    /// How the estimators are stepped.
    #[arg(long)]
    form: Option<FormName>,
    /// What the drive computes in: f32 as on a target with an FPU, q31 as on one without, or f64 to see it without
    /// rounding. Default: f32 here, in QEMU what the machine's firmware computes in.
    #[arg(long)]
    scalar: Option<ScalarName>,
    /// Where the drive runs: here, or as firmware in QEMU, which is held against a drive here, bit for bit.
    #[arg(long, value_name = "WHERE", default_value = "host")]
    controller_on: Place,
    /// Firmware for QEMU, built by `cargo xtask firmware`. Default: that for the machine.
    #[arg(long, value_name = "ELF")]
    image: Option<PathBuf>,
    /// QEMU.
    #[arg(long, value_name = "PROGRAM", default_value = "qemu-system-arm")]
    qemu: PathBuf,
    /// File for the firmware's log in QEMU, in defmt's encoding.
    #[arg(long, value_name = "FILE")]
    log: Option<PathBuf>,
    /// A further argument for QEMU.
    #[arg(long, value_name = "ARGUMENT", allow_hyphen_values = true)]
    qemu_argument: Vec<String>,
    /// QEMU's machine.
    #[arg(long, default_value = "mps2-an386")]
    machine: Machine,
}

impl Overrides {
    fn scalar(&self) -> ScalarName {
        self.scalar.unwrap_or(match self.controller_on {
            Place::Host => ScalarName::F32,
            Place::Qemu => self.machine.scalar(),
        })
    }
}

#[derive(Clone, Copy, PartialEq, Eq, Serialize, ValueEnum)]
#[serde(rename_all = "kebab-case")]
enum Place {
    Host,
    Qemu,
}

#[derive(Clone, Copy, ValueEnum)]
enum Machine {
    /// Cortex-M4F.
    #[value(name = "mps2-an386")]
    Mps2An386,
    /// Cortex-M7.
    #[value(name = "mps2-an500")]
    Mps2An500,
    /// Cortex-M3, in fixed point.
    #[value(name = "mps2-an385")]
    Mps2An385,
    /// Cortex-M0, in fixed point.
    Microbit,
}

impl Machine {
    fn name(self) -> &'static str {
        match self {
            Self::Mps2An386 => "mps2-an386",
            Self::Mps2An500 => "mps2-an500",
            Self::Mps2An385 => "mps2-an385",
            Self::Microbit => "microbit",
        }
    }

    /// Where `cargo xtask firmware` puts its image.
    fn image(self) -> &'static Path {
        Path::new(match self {
            Self::Mps2An386 | Self::Mps2An500 => "target/firmware/qemu.elf",
            Self::Mps2An385 => "target/firmware/qemu-m3.elf",
            Self::Microbit => "target/firmware/qemu-m0.elf",
        })
    }

    /// What that computes in.
    fn scalar(self) -> ScalarName {
        match self {
            Self::Mps2An386 | Self::Mps2An500 => ScalarName::F32,
            Self::Mps2An385 | Self::Microbit => ScalarName::Q31,
        }
    }
}

/// A run, as `--json` prints it.
#[derive(Serialize)]
struct RunReport {
    scenario: PathBuf,
    title: String,
    controller: Controller,
    form: FormName,
    scalar: ScalarName,
    controller_on: Place,
    rate: f64,
    delay: bool,
    duration: f64,
    metrics: Metrics,
    fault: Option<FaultReport>,
}

#[derive(Serialize)]
struct FaultReport {
    time: f64,
    fault: String,
}

impl RunReport {
    fn new(file: &Path, scenario: &Scenario, overrides: &Overrides, outcome: Outcome) -> Self {
        Self {
            scenario: file.to_owned(),
            title: scenario.title.clone(),
            controller: scenario.control.controller,
            form: scenario.control.form,
            scalar: overrides.scalar(),
            controller_on: overrides.controller_on,
            rate: scenario.timing.rate,
            delay: scenario.timing.delay,
            duration: scenario.duration,
            metrics: outcome.metrics,
            fault: outcome.fault.map(|(time, fault)| FaultReport { time, fault: name(fault) }),
        }
    }
}

fn name(fault: Fault) -> String {
    format!("{fault:?}")
}

fn main() -> ExitCode {
    match execute(Cli::parse().command) {
        Ok(code) => code,
        // Whoever read the output has seen enough.
        Err(error) if is_broken_pipe(&error) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            let refused = error.is::<ScenarioError>()
                || matches!(error.downcast_ref(), Some(LinkError::Config(_)));
            ExitCode::from(if refused { 2 } else { 1 })
        }
    }
}

fn is_broken_pipe(error: &anyhow::Error) -> bool {
    let error = error.downcast_ref::<std::io::Error>();
    error.is_some_and(|error| error.kind() == ErrorKind::BrokenPipe)
}

fn execute(command: Command) -> Result<ExitCode> {
    match command {
        Command::Run { file, json, csv, overrides } => {
            let run = play(&file, &overrides, csv.as_deref())?;
            if json {
                writeln!(stdout(), "{}", serde_json::to_string_pretty(&run)?)?;
            } else {
                writeln!(stdout(), "{}: {}", file.display(), run.title)?;
                print_table(std::slice::from_ref(&run))?;
            }
            Ok(exit_code(&[run]))
        }
        Command::Compare { files, json, overrides } => {
            let runs: Vec<RunReport> =
                files.iter().map(|file| play(file, &overrides, None)).collect::<Result<_>>()?;
            if json {
                writeln!(stdout(), "{}", serde_json::to_string_pretty(&runs)?)?;
            } else {
                print_table(&runs)?;
            }
            Ok(exit_code(&runs))
        }
        Command::Board { file, elf, duration, controller, agreement, json, csv, report } => {
            let mut scenario = Scenario::read(&file)?;
            scenario.duration = duration.unwrap_or(scenario.duration);
            scenario.control.controller = controller.unwrap_or(scenario.control.controller);
            scenario.recheck(&file)?;
            let bar = progress_bar(1000);
            let progress = |share: f64| bar.set_position((share * 1e3) as u64);
            let image = emulated::read_image(&elf)?;
            let played = emulated::play::play(&image, &scenario, &file, progress)?;
            bar.finish_and_clear();
            let summary = &played.summary;
            let agreement = match agreement && summary.fault.is_none() {
                true => Some(Agreement::new(&scenario, &played)?),
                false => None,
            };
            if json {
                let report = serde_json::json!({ "summary": summary, "agreement": agreement });
                writeln!(stdout(), "{report:#}")?;
            } else {
                let name = file.file_stem().unwrap_or_default().to_string_lossy();
                writeln!(stdout(), "{}: {}", file.display(), scenario.title)?;
                writeln!(stdout(), "{}", emulated::page::text(&name, summary))?;
                if let Some(agreement) = &agreement {
                    writeln!(stdout(), "{}", agreement.text())?;
                }
            }
            if let Some(out) = csv {
                let mut rows = csv::Writer::from_path(&out)
                    .with_context(|| format!("cannot write {}", out.display()))?;
                played.frames.iter().try_for_each(|frame| rows.serialize(frame))?;
                rows.flush().context("cannot write the CSV file")?;
            }
            if let Some(out) = report {
                write(&out, &emulated::page::html(&scenario.title, &played)?)?;
                eprintln!("Report: {}", out.display());
            }
            Ok(match &summary.fault {
                _ if summary.is_misused() => ExitCode::FAILURE,
                None if agreement.is_some_and(|agreement| !agreement.holds()) => ExitCode::FAILURE,
                Some(_) => ExitCode::from(3),
                None => ExitCode::SUCCESS,
            })
        }
        Command::Campaign { elf, only, json } => {
            let image = emulated::read_image(&elf)?;
            let bar = progress_bar(emulated::campaign::count(only.as_deref()) as u64);
            let outcomes = emulated::campaign::run(image, only.as_deref(), || bar.inc(1))?;
            bar.finish_and_clear();
            if json {
                writeln!(stdout(), "{}", serde_json::to_string_pretty(&outcomes)?)?;
            } else {
                writeln!(stdout(), "{}", emulated::campaign::text(&outcomes))?;
            }
            if outcomes.is_empty() {
                bail!("no case has that in its name");
            }
            let failed = outcomes.iter().filter(|outcome| outcome.failure.is_some()).count();
            if failed > 0 {
                bail!("{failed} of {} cases failed", outcomes.len());
            }
            Ok(ExitCode::SUCCESS)
        }
        Command::Serve { file, port, flash: _, elf: Some(elf) } => {
            let scenario = Scenario::read(&file)?;
            let image = emulated::read_image(&elf)?;
            let board = emulated::serve::boot(&image, &scenario, &file)?;
            let listener = listen(port, &scenario)?;
            match emulated::serve::serve(&board, &listener) {
                Ok(never) => match never {},
                Err(error) => Err(error).context("cannot go on serving"),
            }
        }
        Command::Serve { file, port, flash, elf: None } => serve(&file, port, flash.as_deref()),
        Command::Connect(connect) => Ok(match connect::run(&connect)? {
            Some(status) if status.mode == Mode::Faulted => ExitCode::from(3),
            _ => ExitCode::SUCCESS,
        }),
        Command::Bench { quick, json, report, csv, seeds, case } => {
            let seeds = seeds.unwrap_or(if quick { 1 } else { 5 });
            let board =
                scoreboard::run(&scoreboard::Options { quick, seeds, case }, &progress_bar)?;
            if json {
                writeln!(stdout(), "{}", serde_json::to_string_pretty(&board)?)?;
            } else {
                writeln!(stdout(), "{}", scoreboard::show::text(&board))?;
            }
            if let Some(out) = csv {
                write(&out, &scoreboard::show::csv(&board)?)?;
            }
            if let Some(out) = report {
                write(&out, &scoreboard::show::html(&board)?)?;
                eprintln!("Report: {}", out.display());
            }
            Ok(ExitCode::SUCCESS)
        }
        Command::Paper { report: out, plots } => {
            let results = reproduction::run(&progress_bar)?;
            if let Some(folder) = plots {
                for (name, svg) in report::readme_plots(&results)? {
                    write(&folder.join(name), &svg)?;
                }
            } else {
                writeln!(stdout(), "{}", report::summary(&results))?;
                write(&out, &report::html(&results)?)?;
                writeln!(stdout(), "Report: {}", out.display())?;
            }
            Ok(ExitCode::SUCCESS)
        }
    }
}

/// Serves the drive of a scenario until the process is ended.
fn serve(file: &Path, port: u16, flash_file: Option<&Path>) -> Result<ExitCode> {
    let scenario = Scenario::read(file)?;
    let flash = match flash_file {
        Some(flash) if flash.exists() => SimulatedFlash::read(flash)
            .with_context(|| format!("cannot read {}", flash.display()))?,
        _ => SimulatedFlash::new(),
    };
    let mut drive = VirtualDrive::new(&scenario, flash)?;
    let listener = listen(port, &scenario)?;
    match host_sim::serve::serve(&mut drive, scenario.timing.rate, &listener, flash_file) {
        Ok(never) => match never {},
        Err(error) => Err(error).context("cannot go on serving"),
    }
}

/// Listens at a port, and tells where.
fn listen(port: u16, scenario: &Scenario) -> Result<TcpListener> {
    let listener = TcpListener::bind((Ipv4Addr::LOCALHOST, port))
        .with_context(|| format!("cannot listen at port {port}"))?;
    writeln!(stdout(), "{} at tcp:{}", scenario.title, listener.local_addr()?)?;
    stdout().flush()?;
    Ok(listener)
}

/// Writes a file, and the folders it lies in.
fn write(file: &Path, text: &str) -> Result<()> {
    if let Some(folder) = file.parent() {
        std::fs::create_dir_all(folder)
            .with_context(|| format!("cannot make {}", folder.display()))?;
    }
    std::fs::write(file, text).with_context(|| format!("cannot write {}", file.display()))
}

/// Plays one file, with every period to `csv` if wanted.
fn play(file: &Path, overrides: &Overrides, csv: Option<&Path>) -> Result<RunReport> {
    let mut scenario = Scenario::read(file)?;
    if let Some(controller) = overrides.controller {
        scenario.control.controller = controller;
    }
    if let Some(form) = overrides.form {
        scenario.control.form = form;
    }
    if let Some(rate) = overrides.rate {
        scenario.timing.rate = rate;
    }
    if let Some(duration) = overrides.duration {
        scenario.duration = duration;
    }
    scenario.recheck(file)?;
    let mut rows = match csv {
        Some(out) => Some(
            csv::Writer::from_path(out)
                .with_context(|| format!("cannot write {}", out.display()))?,
        ),
        None => None,
    };
    let mut written = Ok(());
    let bar = progress_bar(scenario.periods());
    let mut period: u64 = 0;
    let each = |frame: &Frame| {
        period += 1;
        if period.is_multiple_of(PERIODS_PER_TICK) {
            bar.inc(PERIODS_PER_TICK);
        }
        if let (Some(rows), Ok(())) = (&mut rows, &written) {
            written = rows.serialize(frame);
        }
    };
    let outcome = match (overrides.controller_on, overrides.scalar()) {
        (Place::Qemu, _) if scenario.idle_periods() > 0 => {
            bail!(
                "the firmware in QEMU is armed from the first period on: initial.armed_after must be 0"
            )
        }
        (Place::Host, scalar) => simulate_in(scalar, &scenario, each)?,
        (Place::Qemu, ScalarName::F32) => in_lock_step::<f32>(&scenario, overrides, each)?,
        (Place::Qemu, ScalarName::Q31) => in_lock_step::<Q31>(&scenario, overrides, each)?,
        (Place::Qemu, ScalarName::F64) => bail!("no firmware in QEMU computes in f64"),
    };
    bar.finish_and_clear();
    if overrides.controller_on == Place::Qemu {
        let (periods, machine) = (outcome.metrics.whole.periods, overrides.machine.name());
        eprintln!(
            "{}: {periods} periods, host and {machine} identical bit for bit",
            file.display()
        );
    }
    written.context("cannot write the CSV file")?;
    if let Some(rows) = &mut rows {
        rows.flush().context("cannot write the CSV file")?;
    }
    Ok(RunReport::new(file, &scenario, overrides, outcome))
}

/// Plays a scenario with a drive here and one in QEMU, held to the same bits.
fn in_lock_step<S: SimulatedScalar + Word>(
    scenario: &Scenario,
    overrides: &Overrides,
    each: impl FnMut(&Frame),
) -> anyhow::Result<Outcome> {
    let config = scenario.drive_config();
    let host = Local::<S>::new(&config)?;
    let emulator = Emulator {
        program: &overrides.qemu,
        arguments: &overrides.qemu_argument,
        log: overrides.log.as_deref(),
        machine: overrides.machine.name(),
        image: overrides.image.as_deref().unwrap_or(overrides.machine.image()),
        patience: PATIENCE,
        interrupted: interruption()?,
    };
    let target = Qemu::start::<S>(&emulator, &config).map_err(LinkError::from)?;
    Ok(simulate_on(&mut LockStep::new(host, target), scenario, each)?)
}

/// A progress bar on a terminal; nothing in a pipe.
fn progress_bar(periods: u64) -> ProgressBar {
    let style = ProgressStyle::with_template("{bar:40} {percent:>3} % {eta} left");
    match style {
        Ok(style) => ProgressBar::new(periods).with_style(style),
        Err(_) => ProgressBar::new(periods),
    }
}

fn print_table(runs: &[RunReport]) -> Result<()> {
    let columns: Vec<(String, Metrics)> = runs
        .iter()
        .map(|run| {
            let name = run.scenario.file_stem().unwrap_or_default().to_string_lossy();
            (format!("{name}\n{}", run.controller), run.metrics.clone())
        })
        .collect();
    writeln!(stdout(), "{}", terminal::metrics_table(&columns))?;
    Ok(())
}

/// Success, or 3 with a message for every run that ended in a fault.
fn exit_code(runs: &[RunReport]) -> ExitCode {
    let mut code = ExitCode::SUCCESS;
    for run in runs {
        if let Some(FaultReport { time, fault }) = &run.fault {
            eprintln!("{}: the drive stopped at {time:.6} s: {fault}", run.scenario.display());
            code = ExitCode::from(3);
        }
    }
    code
}
