//! A board at work, and its host.

use super::{Mode, Result};
use crate::client::{Client, ClientError};
use crate::connect::in_words;
use crate::emulated::play::lasting;
use crate::emulated::{Emulated, setup};
use crate::scenario::Scenario;
use crate::wired::faults::{Fault, Injection};
use anyhow::{bail, ensure};
use quasidrive::link::message::{Request, Status};
use quasidrive::supervisor::Command;
use virtual_board::Image;
use virtual_board::world::Gates;

/// The longest that the host is silent while it only watches (s).
const SILENCE: f64 = 20e-3;

/// How long the motor runs before something happens (s): a second-order reference of 60 rad/s is there after 0.15 s.
const SETTLING: f64 = 0.25;

/// How long a board may take from a watchdog's reset to answering (s).
const REBOOT: f64 = 0.3;

/// A board at work.
pub struct Bench {
    pub emulated: Emulated,
    pub client: Client,
}

impl Bench {
    /// Powers a board with what its flash holds beside the image, and waits until it is ready.
    pub fn new(image: &Image, scenario: &Scenario, flash: Option<&[u8]>) -> Result<Self> {
        let emulated = Self::powered(image, scenario, flash);
        let client = setup::boot(&emulated)?;
        Ok(Self { emulated, client })
    }

    /// Powers a board.
    pub fn powered(image: &Image, scenario: &Scenario, flash: Option<&[u8]>) -> Emulated {
        let emulated = Emulated::new(image, scenario);
        if let Some(flash) = flash {
            emulated.board().change_flash(|cells| cells.store(0, flash));
        }
        emulated
    }

    /// Arms, and runs at a speed (rad/s) until it has settled.
    pub fn start(&mut self, speed: f32) -> Result<()> {
        setup::arm(&self.emulated, &mut self.client)?;
        self.client.command(Command::Speed(speed))?;
        self.watch(SETTLING)?;
        let actual = self.speed();
        ensure!(
            (actual - f64::from(speed)).abs() < 2.0,
            "it turns at {actual:.2} rad/s, not {speed}"
        );
        Ok(())
    }

    /// True speed (rad/s).
    pub fn speed(&self) -> f64 {
        let time = self.emulated.time();
        self.emulated.board().world(|witness| witness.world.truth(time).speed)
    }

    /// Plays on for so many seconds; the host asks now and then.
    pub fn watch(&mut self, time: f64) -> Result<Status> {
        let end = self.emulated.time() + time;
        loop {
            let now = self.emulated.time();
            if now + 1e-9 >= end {
                return Ok(self.client.status()?);
            }
            self.emulated.run_until(end.min(now + SILENCE))?;
            self.client.status()?;
        }
    }

    /// Breaks something from now on, for so many seconds. Gives the time of it.
    pub fn inject(&self, fault: Fault, lasts: f64) -> f64 {
        let now = self.emulated.time();
        let injection = Injection { fault, during: now..now + lasts };
        self.emulated.board().world(|witness| witness.world.inject(injection));
        now
    }

    /// Whether the bridge is off: every gate, and the timer's main output.
    pub fn is_off(&self) -> bool {
        let board = self.emulated.board();
        !board.main_output() && board.gates() == Gates::OFF
    }

    /// Since when (s).
    pub fn off_since(&self) -> f64 {
        self.emulated.board().off_since()
    }

    /// Tries to arm again and again for so many seconds, which must be refused.
    pub fn is_refused(&mut self, time: f64) -> Result<()> {
        let end = self.emulated.time() + time;
        while self.emulated.time() < end {
            match self.client.command(Command::Arm) {
                Err(ClientError::Refused(_)) => self.emulated.run(5e-3)?,
                Ok(()) => bail!("it can be armed before the fault is cleared"),
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    /// Clears the faults, and runs again at a speed (rad/s).
    pub fn recover(&mut self, speed: f32) -> Result<()> {
        self.client.command(Command::Clear)?;
        setup::wait_for(&self.emulated, &mut self.client, Mode::Ready)?;
        self.start(speed)
    }

    /// Waits for a board that was reset to answer.
    pub fn reconnect(&mut self) -> Result<Status> {
        let end = self.emulated.time() + REBOOT;
        self.emulated.run_until(end)?;
        // What it sent before is not for the new host.
        self.emulated.take_sent();
        self.client = self.emulated.client()?;
        Ok(self.client.status()?)
    }

    /// Saves the parameters in force.
    pub fn save(&mut self) -> Result<()> {
        setup::wait_for(&self.emulated, &mut self.client, Mode::Ready)?;
        Ok(self.client.have_done(Request::SaveParameters)?)
    }

    /// What the firmware did to bridge and microcontroller that it must not.
    pub fn misuse(&self) -> Option<String> {
        let mut board = self.emulated.board();
        let mut misuse = lasting(&board.violations());
        misuse.extend(
            board.world(|witness| {
                witness.world.hazards().first().map(|hazard| format!("{hazard:?}"))
            }),
        );
        (!misuse.is_empty()).then(|| misuse.join("; "))
    }

    /// It still drives, without a fault.
    pub fn check_running(&mut self) -> Result<()> {
        let status = self.client.status()?;
        let is_well = status.mode == Mode::Running && status.faults.is_empty();
        ensure!(is_well, "{}", in_words(&status));
        Ok(())
    }
}
