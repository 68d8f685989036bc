//! `host-sim connect`: commands to a drive, on a board or served.

use crate::assignment::{self, Assignment, in_order, list};
use crate::client::Client;
use crate::commission::{self, Commission};
use crate::scenario::{Controller, Scenario};
use crate::watch::{self, Watch};
use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use quasidrive::drive::DriveConfig;
use quasidrive::link::message::{Request, Status, Telemetry};
use quasidrive::schema;
use quasidrive::supervisor::Command;
use std::fmt::Display;
use std::io::{Write, stdout};
use std::path::PathBuf;
use std::time::{Duration, Instant};

/// Where the drive is, and what it shall do.
#[derive(Args)]
pub struct Connect {
    /// A serial port, as /dev/ttyACM0 or COM3, or tcp:ADDRESS:PORT of `host-sim serve`.
    port: String,
    #[command(subcommand)]
    action: Action,
}

#[derive(Subcommand)]
enum Action {
    /// Tell who the drive is and what it is doing.
    Status,
    /// Turn outputs on, at a commanded speed of zero. A drive that hears nothing for protection.command_timeout stops again.
    Arm,
    /// Take the speed to zero, then turn outputs off.
    Stop,
    /// Turn outputs off at once: the motor coasts.
    Disarm,
    /// Command a speed of an armed drive. A drive that hears nothing for protection.command_timeout stops.
    Speed {
        /// Speed (rad/s).
        #[arg(value_name = "RAD_S", allow_negative_numbers = true)]
        speed: f32,
    },
    /// Let another controller take over, also while the motor turns.
    Controller {
        /// Scenario whose controller and gains these are.
        scenario: PathBuf,
        /// Another controller than the scenario's.
        #[arg(long)]
        controller: Option<Controller>,
    },
    /// Clear the latched faults.
    Clear,
    /// Show speed, current and voltage as they change, and keep the drive alive. On a terminal, with keys that command it.
    Watch(Watch),
    /// Have the drive measure its motor, tune it from what was found, and verify. The shaft turns to and fro, up to the limits; Ctrl-C ends it.
    Commission(Commission),
    /// Show, change or save parameters.
    Parameters {
        #[command(subcommand)]
        action: ParametersAction,
    },
}

#[derive(Subcommand)]
enum ParametersAction {
    /// Print the parameters in force, all or those whose names begin so.
    Get {
        /// Beginnings of names: limits, motor.resistance.
        names: Vec<String>,
    },
    /// Change parameters, all at once or none. Outputs must be off, but for the controller and its gains (control and all under it).
    Set {
        /// Names and values: limits.speed=400 reference=SecondOrder reference.bandwidth=60.
        #[arg(required = true, value_name = "NAME=VALUE", value_parser = assignment::parse)]
        assignments: Vec<Assignment>,
    },
    /// Keep the parameters in force when the power is off. Outputs must be off.
    Save,
}

/// Does what was asked. Gives what the drive is doing then, but for parameters.
pub fn run(connect: &Connect) -> Result<Option<Status>> {
    let mut client = Client::open(&connect.port)?;
    match &connect.action {
        Action::Status => status(&mut client)?,
        Action::Arm => client.command(Command::Arm)?,
        Action::Stop => client.command(Command::Stop)?,
        Action::Disarm => client.command(Command::Off)?,
        Action::Speed { speed } => client.command(Command::Speed(*speed))?,
        Action::Controller { scenario: file, controller } => {
            let mut scenario = Scenario::read(file)?;
            if let Some(controller) = controller {
                scenario.control.controller = *controller;
            }
            change_controller(&mut client, &scenario)?;
        }
        Action::Clear => client.command(Command::Clear)?,
        Action::Watch(watch) => return Ok(Some(watch::run(&mut client, watch)?)),
        Action::Commission(commission) => {
            return Ok(Some(commission::run(&mut client, commission)?));
        }
        Action::Parameters { action } => {
            parameters(&mut client, action)?;
            return Ok(None);
        }
    }
    let status = client.status()?;
    writeln!(stdout(), "{}", in_words(&status))?;
    Ok(Some(status))
}

/// How long a drive may take to tell of a period.
const PATIENCE: Duration = Duration::from_secs(1);

/// Telemetry that is not too much for a serial port (1 in so many periods).
const DECIMATION: u32 = 200;

/// Who the drive is, and a period of it.
fn status(client: &mut Client) -> Result<()> {
    writeln!(stdout(), "{}", client.identity())?;
    client.have_done(Request::SetTelemetry(DECIMATION))?;
    let start = Instant::now();
    let mut last = None;
    while last.is_none() && start.elapsed() < PATIENCE {
        last = client.telemetry()?.pop();
    }
    client.have_done(Request::SetTelemetry(0))?;
    match last {
        Some(Telemetry { temperature, bus_voltage, current, speed, .. }) => writeln!(
            stdout(),
            "board {temperature:.1} °C, bus {bus_voltage:.2} V, current {current:.2} A, speed {speed:.2} rad/s"
        )?,
        None => writeln!(stdout(), "no telemetry: its control loop does not run")?,
    }
    Ok(())
}

/// The scenario's controller, tuned for the drive's own motor and sensors: those in force, not the scenario's.
fn change_controller(client: &mut Client, scenario: &Scenario) -> Result<()> {
    let mut drive = scenario.drive_config();
    for (name, setting) in client.parameters()? {
        // A drive of another version may have parameters that this program does not know.
        let _ = schema::set(&mut drive, &name, setting.value());
    }
    let DriveConfig { motor, sensors, timing, limits, .. } = &drive;
    let mut control = scenario.control_for(motor, sensors, timing, limits);
    client.change(&list("control", &mut control))?;
    Ok(())
}

fn parameters(client: &mut Client, action: &ParametersAction) -> Result<()> {
    match action {
        ParametersAction::Get { names } => {
            let parameters = client.parameters()?;
            for name in names {
                if !parameters.iter().any(|(path, _)| path.starts_with(name.as_str())) {
                    bail!("there is no parameter {name}");
                }
            }
            let is_wanted = |path: &str| {
                names.is_empty() || names.iter().any(|name| path.starts_with(name.as_str()))
            };
            for (path, setting) in parameters.iter().filter(|(path, _)| is_wanted(path)) {
                writeln!(stdout(), "{path}={setting}")?;
            }
        }
        ParametersAction::Set { assignments } => client.change(in_order(assignments))?,
        ParametersAction::Save => client.have_done(Request::SaveParameters)?,
    }
    Ok(())
}

/// A status as a line: mode, faults and limits with their numbers.
pub fn in_words(status: &Status) -> String {
    let Status { mode, faults, limits } = status;
    let faults =
        numbered(faults.iter().map(|fault| fault.entry()).map(|entry| (entry.number, entry.name)));
    let limits =
        numbered(limits.iter().map(|limit| limit.entry()).map(|entry| (entry.number, entry.name)));
    format!("mode {mode:?}, faults: {faults}, limits: {limits}")
}

fn numbered(entries: impl Iterator<Item = (u8, impl Display)>) -> String {
    let entries: Vec<String> = entries.map(|(number, name)| format!("{number} {name}")).collect();
    if entries.is_empty() { "none".to_owned() } else { entries.join(", ") }
}
