//! The emulated board in real time behind a socket, or slower where this computer is.

use super::{Emulated, setup};
use crate::scenario::Scenario;
use crate::serve::next_host;
use anyhow::{Context, Result};
use std::convert::Infallible;
use std::io::{ErrorKind, Read, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};
use virtual_board::Image;

/// How long the board is played on between two looks at the socket (s).
const TICK: f64 = 1e-3;

/// The most that is made up for after the computer was busy elsewhere.
const MOST_LATE: Duration = Duration::from_millis(100);

/// Bytes that a host may leave unread before it is hung up on.
const MOST_UNREAD: usize = 64 * 1024;

/// A board that is ready, with the scenario's motor, load and parameters. `file` is for messages.
pub fn boot(image: &Image, scenario: &Scenario, file: &Path) -> Result<Emulated> {
    setup::check(scenario, file)?;
    let emulated = Emulated::new(image, scenario);
    let mut client = setup::boot(&emulated)?;
    setup::configure(scenario, file, &mut client)?;
    let now = emulated.time();
    emulated.board().world(|witness| witness.world.start_profiles(now));
    Ok(emulated)
}

/// Carries bytes between the board's serial port and one host at a time, for as long as there is no error.
pub fn serve(emulated: &Emulated, listener: &TcpListener) -> Result<Infallible> {
    listener.set_nonblocking(true)?;
    let tick = Duration::from_secs_f64(TICK);
    let mut due = Instant::now();
    let mut host: Option<Host> = None;
    loop {
        if host.is_none() {
            host = next_host(listener).context("cannot listen")?.map(Host::new).transpose()?;
        }
        emulated.run(TICK)?;
        let sent = emulated.take_sent();
        if host.as_mut().is_some_and(|host| host.talk(emulated, &sent).is_err()) {
            host = None;
        }
        due = (due + tick).max(Instant::now() - MOST_LATE);
        std::thread::sleep(due.saturating_duration_since(Instant::now()));
    }
}

/// The connection of a host.
struct Host {
    stream: TcpStream,
    /// What the socket has not taken yet.
    unsent: Vec<u8>,
}

impl Host {
    fn new(stream: TcpStream) -> std::io::Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, unsent: Vec::new() })
    }

    /// Carries what there is. Fails once the host has gone.
    fn talk(&mut self, emulated: &Emulated, sent: &[u8]) -> std::io::Result<()> {
        // No more at once than the line carries in a tick or two: what comes faster waits in the socket.
        let mut bytes = [0; 128];
        match self.stream.read(&mut bytes) {
            Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
            Ok(count) => emulated.board().send(&bytes[..count]),
            Err(error) if error.kind() == ErrorKind::WouldBlock => {}
            Err(error) => return Err(error),
        }
        self.unsent.extend(sent);
        while !self.unsent.is_empty() {
            match self.stream.write(&self.unsent) {
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                written => drop(self.unsent.drain(..written?)),
            }
        }
        if self.unsent.len() > MOST_UNREAD { Err(ErrorKind::TimedOut.into()) } else { Ok(()) }
    }
}
