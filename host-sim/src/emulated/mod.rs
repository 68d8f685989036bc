//! The firmware's own image on an emulated board, with a scenario's motor wired to it.
//!
//! [`Emulated`] is the board; [`Emulated::client`] speaks the link with it, and lets time pass while it waits. Nothing here looks at the
//! computer's clock: the same image and the same scenario give the same bits.
//!
//! - [`witness`]: the truth at each sampling instant;
//! - [`setup`]: a scenario's parameters on the board;
//! - [`play`]: a scenario, and what is measured of it; [`page`] draws it;
//! - [`agreement`]: the same scenario on the averaged board;
//! - [`campaign`]: faults, and what must not be one;
//! - [`serve`]: the board behind a socket.

pub mod agreement;
pub mod campaign;
pub mod page;
pub mod play;
pub mod serve;
pub mod setup;
pub mod witness;

use crate::client::{Client, ClientError, Line};
use crate::scenario::Scenario;
use anyhow::{Context, Result};
use std::cell::{RefCell, RefMut};
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::path::Path;
use std::rc::Rc;
use std::time::Duration;
use virtual_board::{Image, VirtualBoard};
use witness::Witness;

/// How long a read of the line waits for bytes (s).
const STEP: f64 = 1e-3;

/// A PWM period of the B-G431B-ESC1 (s): 2·4248 cycles of 170 MHz.
pub const PERIOD: f64 = 8496.0 / 170e6;

/// Exception number of the control interrupt, ADC1_2.
pub const CONTROL: u16 = 18 + 16;

/// Reads an image.
pub fn read_image(file: &Path) -> Result<Image> {
    let data = std::fs::read(file).with_context(|| {
        format!("cannot read {}; cargo xtask firmware builds it", file.display())
    })?;
    Image::from_elf(&data).with_context(|| file.display().to_string())
}

/// An emulated board. A clone is the same board.
#[derive(Clone)]
pub struct Emulated(Rc<RefCell<Powered>>);

struct Powered {
    board: VirtualBoard<Witness>,
    /// What the board has sent and nobody has read.
    unread: VecDeque<u8>,
}

impl Emulated {
    /// A board with an image and a scenario's motor, just powered.
    pub fn new(image: &Image, scenario: &Scenario) -> Self {
        let board = VirtualBoard::new(image, Witness::new(scenario));
        Self(Rc::new(RefCell::new(Powered { board, unread: VecDeque::new() })))
    }

    /// The board itself. Nothing else may be asked of it meanwhile.
    pub fn board(&self) -> RefMut<'_, VirtualBoard<Witness>> {
        RefMut::map(self.0.borrow_mut(), |powered| &mut powered.board)
    }

    /// Seconds since power first came.
    pub fn time(&self) -> f64 {
        self.0.borrow().board.time()
    }

    /// Plays on until so many seconds after power first came.
    pub fn run_until(&self, time: f64) -> Result<()> {
        self.0.borrow_mut().run_until(time)
    }

    /// Plays on for so many seconds.
    pub fn run(&self, time: f64) -> Result<()> {
        self.run_until(self.time() + time)
    }

    /// Whether the board has sent something that was not read.
    pub fn has_sent(&self) -> bool {
        !self.0.borrow().unread.is_empty()
    }

    /// What the board has sent and nobody has read.
    pub fn take_sent(&self) -> Vec<u8> {
        self.0.borrow_mut().unread.drain(..).collect()
    }

    /// The host's end of the link.
    pub fn client(&self) -> Result<Client, ClientError> {
        Client::on(self.clone())
    }
}

impl Powered {
    fn run_until(&mut self, time: f64) -> Result<()> {
        let played = self.board.run_until(time);
        self.unread.extend(self.board.received());
        played.with_context(|| {
            let (_, function) = self.board.place();
            format!("the emulation stopped in {}", function.unwrap_or("no function"))
        })
    }
}

impl Read for Emulated {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        let mut powered = self.0.borrow_mut();
        if powered.unread.is_empty() {
            let end = powered.board.time() + STEP;
            powered.run_until(end).map_err(|error| std::io::Error::other(format!("{error:#}")))?;
        }
        match powered.unread.read(bytes)? {
            0 => Err(ErrorKind::WouldBlock.into()),
            count => Ok(count),
        }
    }
}

impl Write for Emulated {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.board().send(bytes);
        Ok(bytes.len())
    }

    fn flush(&mut self) -> std::io::Result<()> {
        Ok(())
    }
}

impl Line for Emulated {
    fn time(&self) -> Duration {
        Duration::from_secs_f64(Emulated::time(self))
    }
}
