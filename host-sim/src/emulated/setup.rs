//! A scenario on the board: what it can do of it, and its parameters written by the link.

use super::{Emulated, PERIOD};
use crate::assignment::list;
use crate::client::{Client, ClientError};
use crate::scenario::{Scenario, ScenarioError};
use crate::sensors::ReadsName;
use anyhow::{Result, bail};
use quasidrive::parameters::Parameters;
use quasidrive::schema;
use quasidrive::sense::Sensors;
use quasidrive::supervisor::{Command, Mode};
use std::path::Path;

/// How far a scenario's rate may be from the board's, as a share of it: 20 kHz is 20.009 kHz.
const RATE_TOLERANCE: f64 = 1e-3;

/// The longest that the board may take from power to ready, and from arming to running (s).
const START_TIME: f64 = 1.0;

/// Refuses what the board cannot do of a scenario; `file` is for messages.
pub fn check(scenario: &Scenario, file: &Path) -> Result<(), ScenarioError> {
    let (rate, initial) = (1.0 / PERIOD, scenario.initial);
    let reads = scenario.sensors.map(|sensors| sensors.reads);
    let rules = [
        (
            (scenario.timing.rate / rate - 1.0).abs() <= RATE_TOLERANCE,
            format!("timing.rate must be the board's, {rate:.1} Hz within a thousandth"),
        ),
        (scenario.timing.delay, "timing.delay must be true: the board has it".to_owned()),
        (
            matches!(reads, None | Some(ReadsName::Shifted)),
            "sensors.reads must be \"shifted\", as the board's are".to_owned(),
        ),
        (
            initial.current == 0.0,
            "initial.current must be 0: the board starts with outputs off".to_owned(),
        ),
        (
            initial.armed_after == 0.0,
            "initial.armed_after must be 0: the board is armed when it is ready".to_owned(),
        ),
    ];
    match rules.into_iter().find(|(holds, _)| !holds) {
        Some((_, message)) => Err(ScenarioError::new(file, message)),
        None => Ok(()),
    }
}

/// The scenario's parameters for a board that has these in force: motor, limits, shape and protection are the scenario's, its controller is tuned
/// for the board's sensors, with the scenario's encoder, and timing is the board's.
pub fn parameters(scenario: &Scenario, client: &mut Client) -> Result<Parameters, ClientError> {
    let wanted = scenario.parameters();
    let mut parameters = wanted;
    for (name, setting) in client.parameters()? {
        // Firmware of another version may have parameters that this program does not know.
        let _ = schema::set(&mut parameters, &name, setting.value());
    }
    parameters.protection = wanted.protection;
    let drive = &mut parameters.drive;
    drive.motor = wanted.drive.motor;
    drive.limits = wanted.drive.limits;
    drive.shape = wanted.drive.shape;
    if let (Sensors::Codes(board), Some(sensors)) = (&mut drive.sensors, &scenario.sensors) {
        board.counts_per_turn = sensors.counts_per_turn as i32;
    }
    drive.control =
        scenario.control_for(&drive.motor, &drive.sensors, &drive.timing, &drive.limits);
    Ok(parameters)
}

/// Writes the scenario's parameters and gives them.
pub fn configure(scenario: &Scenario, file: &Path, client: &mut Client) -> Result<Parameters> {
    check(scenario, file)?;
    let mut parameters = parameters(scenario, client)?;
    let assignments = list("", &mut parameters);
    let settable = assignments.iter().filter(|(name, _)| !name.starts_with("timing"));
    match client.change(settable) {
        Err(ClientError::Refused(reason)) => {
            Err(ScenarioError::new(file, format!("the board refuses {reason}")).into())
        }
        changed => Ok(changed.map(|()| parameters)?),
    }
}

/// Waits until the drive is in a mode; on the way it may be in others, but not faulted.
pub fn wait_for(emulated: &Emulated, client: &mut Client, mode: Mode) -> Result<()> {
    let end = emulated.time() + START_TIME;
    loop {
        let status = client.status()?;
        if status.mode == mode {
            return Ok(());
        }
        if status.mode == Mode::Faulted || emulated.time() > end {
            bail!("it does not become {mode:?}: {}", crate::connect::in_words(&status));
        }
        emulated.run(1e-3)?;
    }
}

/// Waits until the drive is ready, from power on.
pub fn boot(emulated: &Emulated) -> Result<Client> {
    // It does not listen in the first milliseconds.
    emulated.run(0.05)?;
    if let [_, reset, ..] = emulated.board().resets() {
        bail!("the image does not come up: {reset:x?}");
    }
    let mut client = emulated.client()?;
    wait_for(emulated, &mut client, Mode::Ready)?;
    Ok(client)
}

/// Arms, and waits until the motor is driven.
pub fn arm(emulated: &Emulated, client: &mut Client) -> Result<()> {
    client.command(Command::Arm)?;
    wait_for(emulated, client, Mode::Running)
}
