//! The host's end of the link: a drive behind a serial port or a socket, asked and answering.

use crate::assignment::Assignment;
use quasidrive::commission::{Findings, Progress};
use quasidrive::link::BAUD_RATE;
use quasidrive::link::frame::{Decoder, LONGEST, encode};
use quasidrive::link::message::{
    Answer, Identity, Message, Numbered, Refusal, Request, Status, Telemetry, VERSION,
};
use quasidrive::supervisor::Command;
use std::collections::VecDeque;
use std::io::{ErrorKind, Read, Write};
use std::net::TcpStream;
use std::time::{Duration, Instant};

/// How long a drive may take to answer: longer than to erase its flash, and for the longest frames both ways.
const PATIENCE: Duration = Duration::from_secs(1);

/// How long a read waits at most.
const READ_TIME: Duration = Duration::from_millis(5);

/// Why there is no answer, or not the wanted one.
#[derive(Debug, thiserror::Error)]
pub enum ClientError {
    /// There is no such port, or it is in use.
    #[error("cannot open {port}: {reason}")]
    NoPort {
        /// What was to be opened.
        port: String,
        /// What the system says.
        reason: String,
    },
    /// The connection is gone.
    #[error("the connection to the drive is lost")]
    Lost(#[from] std::io::Error),
    /// No answer came.
    #[error(
        "no answer from the drive within {PATIENCE:?}: is it a drive, switched on, and not with another host?"
    )]
    Silent,
    /// The drive has other messages.
    #[error("the drive speaks version {0} of the link's messages, this program {VERSION}")]
    WrongVersion(u16),
    /// The drive refused.
    #[error("refused: {0}")]
    Refused(String),
    /// The answer is to another question.
    #[error("the drive's answer does not fit the request")]
    WrongAnswer,
    /// The request is too long for a frame.
    #[error("the request is too long")]
    TooLong,
}

/// A line that carries bytes. A read waits a little where there are none.
pub trait Line: Read + Write {
    /// Time since the line was there, as it passes for the drive at its other end.
    fn time(&self) -> Duration;
}

/// A line to the world outside, where time passes by itself.
struct Outside<T> {
    port: T,
    opened: Instant,
}

impl<T: Read> Read for Outside<T> {
    fn read(&mut self, bytes: &mut [u8]) -> std::io::Result<usize> {
        self.port.read(bytes)
    }
}

impl<T: Write> Write for Outside<T> {
    fn write(&mut self, bytes: &[u8]) -> std::io::Result<usize> {
        self.port.write(bytes)
    }

    fn flush(&mut self) -> std::io::Result<()> {
        self.port.flush()
    }
}

impl<T: Read + Write> Line for Outside<T> {
    fn time(&self) -> Duration {
        self.opened.elapsed()
    }
}

/// A drive, seen from a host.
pub struct Client {
    line: Box<dyn Line>,
    decoder: Decoder,
    sequence: u16,
    telemetry: VecDeque<Telemetry>,
    /// Who the drive is, in words.
    identity: String,
}

impl Client {
    /// Opens `tcp:ADDRESS:PORT` or a serial port, and makes sure that a drive with the same messages is there.
    pub fn open(port: &str) -> Result<Self, ClientError> {
        let no_port = |reason: String| ClientError::NoPort { port: port.to_owned(), reason };
        let opened = Instant::now();
        match port.strip_prefix("tcp:") {
            Some(address) => {
                let stream =
                    TcpStream::connect(address).map_err(|error| no_port(error.to_string()))?;
                stream.set_nodelay(true)?;
                stream.set_read_timeout(Some(READ_TIME))?;
                Self::on(Outside { port: stream, opened })
            }
            None => {
                let serial = serialport::new(port, BAUD_RATE).timeout(READ_TIME).open();
                let port = serial.map_err(|error| no_port(error.to_string()))?;
                Self::on(Outside { port, opened })
            }
        }
    }

    /// Takes a line, and makes sure that a drive with the same messages is at its other end.
    pub fn on(line: impl Line + 'static) -> Result<Self, ClientError> {
        let mut client = Self {
            line: Box::new(line),
            decoder: Decoder::new(),
            sequence: 0,
            telemetry: VecDeque::new(),
            identity: String::new(),
        };
        client.identity = client.ask(Request::Identify, |answer| match answer {
            Answer::Identity(Identity { version, .. }) if version != VERSION => {
                Err(ClientError::WrongVersion(version))
            }
            Answer::Identity(Identity { board, firmware, build, .. }) => {
                Ok(format!("{board} board, firmware {firmware}, build {build}"))
            }
            answer => Err(unwanted(answer)),
        })?;
        Ok(client)
    }

    /// Who the drive is.
    pub fn identity(&self) -> &str {
        &self.identity
    }

    /// What the drive is doing.
    pub fn status(&mut self) -> Result<Status, ClientError> {
        self.ask(Request::Status, |answer| match answer {
            Answer::Status(status) => Ok(status),
            answer => Err(unwanted(answer)),
        })
    }

    /// How far commissioning is.
    pub fn progress(&mut self) -> Result<Progress, ClientError> {
        self.ask(Request::ReadProgress, |answer| match answer {
            Answer::Progress(progress) => Ok(progress),
            answer => Err(unwanted(answer)),
        })
    }

    /// What commissioning found.
    pub fn findings(&mut self) -> Result<Findings, ClientError> {
        self.ask(Request::ReadEvidence, |answer| match answer {
            Answer::Evidence(evidence) => Ok(evidence.findings()),
            answer => Err(unwanted(answer)),
        })
    }

    /// The parameters in force, in the drive's order: what holds others is ahead of them.
    pub fn parameters(&mut self) -> Result<Vec<Assignment>, ClientError> {
        let mut parameters = Vec::new();
        for index in 0..=u16::MAX {
            let next = self.ask(Request::ReadParameter(index), |answer| match answer {
                Answer::Parameter { name, value } => Ok(Some((name.to_owned(), value.into()))),
                Answer::Refused(Refusal::NoParameter) => Ok(None),
                answer => Err(unwanted(answer)),
            })?;
            let Some(parameter) = next else { break };
            parameters.push(parameter);
        }
        Ok(parameters)
    }

    /// Changes parameters in this order, all of them or none.
    pub fn change<'p>(
        &mut self,
        assignments: impl IntoIterator<Item = &'p Assignment>,
    ) -> Result<(), ClientError> {
        for (name, setting) in assignments {
            let request = Request::StageParameter { name, value: setting.value() };
            self.ask(request, |answer| match answer {
                Answer::Done => Ok(()),
                Answer::Refused(refusal) => {
                    Err(ClientError::Refused(format!("{name}={setting}: {refusal}")))
                }
                _ => Err(ClientError::WrongAnswer),
            })?;
        }
        self.have_done(Request::ApplyParameters)
    }

    /// Has a command done.
    pub fn command(&mut self, command: Command) -> Result<(), ClientError> {
        self.have_done(Request::Command(command))
    }

    /// Has something done.
    pub fn have_done(&mut self, request: Request) -> Result<(), ClientError> {
        self.ask(request, |answer| match answer {
            Answer::Done => Ok(()),
            answer => Err(unwanted(answer)),
        })
    }

    /// The telemetry that has come, waiting a little for some.
    pub fn telemetry(&mut self) -> Result<Vec<Telemetry>, ClientError> {
        if self.telemetry.is_empty() {
            self.receive(|_, _| {})?;
        }
        Ok(self.telemetry.drain(..).collect())
    }

    fn ask<T>(
        &mut self,
        request: Request,
        read: impl Fn(Answer) -> Result<T, ClientError>,
    ) -> Result<T, ClientError> {
        self.sequence = self.sequence.wrapping_add(1);
        let wanted = self.sequence;
        let mut buffer = [0; LONGEST];
        let frame = encode(&Numbered { sequence: wanted, request }, &mut buffer);
        self.line.write_all(frame.ok_or(ClientError::TooLong)?)?;
        self.line.flush()?;
        let start = self.line.time();
        let mut result = None;
        while result.is_none() {
            if self.line.time() - start > PATIENCE {
                return Err(ClientError::Silent);
            }
            self.receive(|sequence, answer| {
                if sequence == wanted {
                    result = Some(read(answer));
                }
            })?;
        }
        result.unwrap_or(Err(ClientError::Silent))
    }

    /// Reads what has come, or waits a little for it; shows answers and keeps telemetry.
    fn receive(&mut self, mut show: impl FnMut(u16, Answer)) -> Result<(), ClientError> {
        let mut bytes = [0; 4096];
        let count = match self.line.read(&mut bytes) {
            Ok(0) => return Err(ClientError::Lost(ErrorKind::UnexpectedEof.into())),
            Ok(count) => count,
            Err(error) if is_nothing_yet(&error) => 0,
            Err(error) => return Err(error.into()),
        };
        for byte in &bytes[..count] {
            let message =
                self.decoder.feed(*byte).and_then(|bytes| postcard::from_bytes(bytes).ok());
            match message {
                Some(Message::Answer { sequence, answer }) => show(sequence, answer),
                Some(Message::Telemetry(telemetry)) => self.telemetry.push_back(telemetry),
                None => {}
            }
        }
        Ok(())
    }
}

/// Why an answer is not the wanted one.
fn unwanted(answer: Answer) -> ClientError {
    match answer {
        Answer::Refused(refusal) => ClientError::Refused(refusal.to_string()),
        _ => ClientError::WrongAnswer,
    }
}

fn is_nothing_yet(error: &std::io::Error) -> bool {
    matches!(error.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted)
}
