//! A virtual drive in real time behind a socket.

use crate::virtual_drive::VirtualDrive;
use quasidrive::link::session::{Device, Session};
use std::convert::Infallible;
use std::io::{ErrorKind, Read, Result, Write};
use std::net::{TcpListener, TcpStream};
use std::path::Path;
use std::time::{Duration, Instant};

/// How often the socket is looked after. The periods of that time pass at once in between.
const TICK: Duration = Duration::from_millis(1);

/// The most that is made up for after the computer was busy elsewhere. What is beyond that did not happen.
const MOST_LATE: Duration = Duration::from_millis(100);

/// Reads of the socket in a tick, for a flood not to stop the drive.
const MOST_READS: usize = 16;

/// Answers (bytes) that a host may leave unread before it is hung up on.
const MOST_UNREAD: usize = 64 * 1024;

/// Runs a drive, `rate` periods a second, and talks to one host at a time. Keeps its flash in `file`, if there is one.
pub fn serve(
    drive: &mut VirtualDrive,
    rate: f64,
    listener: &TcpListener,
    file: Option<&Path>,
) -> Result<Infallible> {
    listener.set_nonblocking(true)?;
    let period = Duration::from_secs_f64(1.0 / rate);
    let mut due = Instant::now();
    let mut host: Option<Host> = None;
    let mut kept = drive.flash().operations();
    loop {
        due = due.max(Instant::now() - MOST_LATE);
        while due <= Instant::now() {
            drive.run_period();
            due += period;
        }
        if host.as_mut().is_some_and(|host| host.talk(drive).is_err()) {
            host = None;
            drive.set_telemetry(0);
        }
        if host.is_none() {
            host = next_host(listener)?.map(Host::new).transpose()?;
        }
        if let Some(file) = file
            && kept != drive.flash().operations()
        {
            std::fs::write(file, drive.flash().memory())?;
            kept = drive.flash().operations();
        }
        std::thread::sleep(TICK);
    }
}

/// The host that has waited longest, if one does. One host at a time, as on a cable: others wait until it leaves, for whoever took over would cut
/// off the one that keeps the drive alive. One that gave up meanwhile has sent no more than who it asks for.
pub(crate) fn next_host(listener: &TcpListener) -> Result<Option<TcpStream>> {
    match listener.accept() {
        Ok((stream, _)) => Ok(Some(stream)),
        Err(error) if error.kind() == ErrorKind::WouldBlock => Ok(None),
        Err(error) => Err(error),
    }
}

/// The connection of a host.
struct Host {
    stream: TcpStream,
    session: Session,
    /// What the socket has not taken yet.
    unsent: Vec<u8>,
}

impl Host {
    fn new(stream: TcpStream) -> Result<Self> {
        stream.set_nonblocking(true)?;
        stream.set_nodelay(true)?;
        Ok(Self { stream, session: Session::default(), unsent: Vec::new() })
    }

    /// Answers what came, then sends telemetry while nothing else waits. Fails once the host has gone.
    fn talk(&mut self, drive: &mut VirtualDrive) -> Result<()> {
        let mut bytes = [0; 4096];
        for _ in 0..MOST_READS {
            let count = match self.stream.read(&mut bytes) {
                Ok(0) => return Err(ErrorKind::UnexpectedEof.into()),
                Err(error) if error.kind() == ErrorKind::WouldBlock => break,
                read => read?,
            };
            for byte in &bytes[..count] {
                if let Some(answer) = self.session.receive(*byte, drive) {
                    self.unsent.extend(answer);
                }
            }
        }
        self.send()?;
        while self.unsent.is_empty()
            && let Some(telemetry) = self.session.telemetry(drive)
        {
            self.unsent.extend(telemetry);
            self.send()?;
        }
        if self.unsent.len() > MOST_UNREAD { Err(ErrorKind::TimedOut.into()) } else { Ok(()) }
    }

    /// Sends what the socket takes.
    fn send(&mut self) -> Result<()> {
        while !self.unsent.is_empty() {
            match self.stream.write(&self.unsent) {
                Err(error) if error.kind() == ErrorKind::WouldBlock => return Ok(()),
                written => drop(self.unsent.drain(..written?)),
            }
        }
        Ok(())
    }
}
