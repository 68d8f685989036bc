//! `host-sim connect`: commands to a drive, on a board or served.

use crate::assignment::{assign, list};
use crate::client::Client;
use crate::scenario::{Controller, Scenario};
use crate::watch::{self, Watch};
use anyhow::{Result, bail};
use clap::{Args, Subcommand};
use quasidrive::link::message::{Request, Status};
use quasidrive::supervisor::Command;
use std::fmt::Display;
use std::io::{Write, stdout};
use std::path::PathBuf;

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
    /// Change parameters, all at once or none. Outputs must be off.
    Set {
        /// Names and values: limits.speed=400 reference=SecondOrder reference.SecondOrder.bandwidth=60.
        #[arg(required = true, value_name = "NAME=VALUE", value_parser = parse_assignment)]
        assignments: Vec<(String, String)>,
    },
    /// Keep the parameters in force when the power is off. Outputs must be off.
    Save,
}

fn parse_assignment(text: &str) -> Result<(String, String), String> {
    let (name, value) = text.split_once('=').ok_or("must be NAME=VALUE")?;
    Ok((name.trim().to_owned(), value.trim().to_owned()))
}

/// Does what was asked. Gives what the drive is doing then, but for parameters.
pub fn run(connect: &Connect) -> Result<Option<Status>> {
    let mut client = Client::open(&connect.port)?;
    match &connect.action {
        Action::Status => writeln!(stdout(), "{}", client.identity())?,
        Action::Arm => client.command(Command::Arm)?,
        Action::Stop => client.command(Command::Stop)?,
        Action::Disarm => client.command(Command::Off)?,
        Action::Speed { speed } => client.command(Command::Speed(*speed))?,
        Action::Controller { scenario: file, controller } => {
            let mut scenario = Scenario::read(file)?;
            if let Some(controller) = controller {
                scenario.control.controller = *controller;
            }
            client.have_done(Request::ChangeController(scenario.drive_config().control))?;
        }
        Action::Clear => client.command(Command::Clear)?,
        Action::Watch(watch) => return Ok(Some(watch::run(&mut client, watch)?)),
        Action::Parameters { action } => {
            parameters(&mut client, action)?;
            return Ok(None);
        }
    }
    let status = client.status()?;
    writeln!(stdout(), "{}", in_words(&status))?;
    Ok(Some(status))
}

fn parameters(client: &mut Client, action: &ParametersAction) -> Result<()> {
    match action {
        ParametersAction::Get { names } => {
            let lines = list(&client.parameters()?)?;
            for name in names {
                if !lines.iter().any(|(path, _)| path.starts_with(name.as_str())) {
                    bail!("there is no parameter {name}");
                }
            }
            let is_wanted = |path: &str| {
                names.is_empty() || names.iter().any(|name| path.starts_with(name.as_str()))
            };
            for (path, text) in lines.iter().filter(|(path, _)| is_wanted(path)) {
                writeln!(stdout(), "{path}={text}")?;
            }
        }
        ParametersAction::Set { assignments } => {
            let changed = assign(&client.parameters()?, assignments)?;
            client.have_done(Request::WriteParameters(changed))?;
        }
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
