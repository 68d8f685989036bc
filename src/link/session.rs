//! The drive's end of the link.

use super::frame::{Decoder, LONGEST, encode};
use super::message::{Answer, Identity, Message, Refusal, Request, Status, Telemetry};
use crate::commission::{Evidence, Nameplate, Progress};
use crate::control::ControlConfig;
use crate::parameters::Parameters;
use crate::schema::{self, Path, Value};
use crate::supervisor::{Command, Mode};

/// What a session needs of the drive that it speaks for.
///
/// On a board the control interrupt owns the supervisor, and this is a task's side of the queues to it: [`command`](Self::command)
/// sends a command and waits for what the supervisor made of it, a period at most; the rest is from the last snapshot, or
/// prepared here and handed over.
pub trait Device {
    /// Who the drive is.
    fn identity(&self) -> Identity<'static>;

    /// What it is doing.
    fn status(&self) -> Status;

    /// The parameters in force.
    fn parameters(&self) -> &Parameters;

    /// Gives the supervisor a command.
    fn command(&mut self, command: Command) -> Result<(), Refusal<'static>>;

    /// Lets another controller take over.
    fn change_controller(&mut self, control: &ControlConfig) -> Result<(), Refusal<'static>>;

    /// Goes on with other parameters. Outputs are off.
    fn change_parameters(&mut self, parameters: &Parameters) -> Result<(), Refusal<'static>>;

    /// Saves the parameters in force. Outputs are off.
    fn save_parameters(&mut self) -> Result<(), Refusal<'static>>;

    /// Begins to measure the motor. The drive is ready.
    fn commission(&mut self, nameplate: &Nameplate) -> Result<(), Refusal<'static>>;

    /// How far that is; [`Progress::OVER`] where there is nothing of it.
    fn progress(&self) -> Progress;

    /// What was measured, if anything. Nothing is being measured.
    fn evidence(&mut self) -> Option<Evidence>;

    /// Makes telemetry of one in so many periods; of none, for zero.
    fn set_telemetry(&mut self, decimation: u32);

    /// The telemetry that has waited longest, if there is any. What finds no room to wait is dropped.
    fn next_telemetry(&mut self) -> Option<Telemetry>;
}

/// A conversation with a host, over any line that carries bytes.
///
/// Whoever owns the line calls [`receive`](Self::receive) for each byte that came and sends the answer, if there is one; with no
/// byte waiting, it calls [`telemetry`](Self::telemetry) and sends that. So telemetry never keeps an answer waiting for longer
/// than one frame.
#[derive(Clone, Debug, Default)]
pub struct Session {
    decoder: Decoder,
    staged: Option<Staged>,
    frame: Frame,
}

/// Parameters that are to be applied together.
#[derive(Clone, Debug)]
struct Staged {
    parameters: Parameters,
    /// Whether they differ from those in force in more than the controller.
    beyond_control: bool,
}

/// A frame to be sent.
#[derive(Clone, Debug)]
struct Frame([u8; LONGEST]);

impl Default for Frame {
    fn default() -> Self {
        Self([0; LONGEST])
    }
}

impl Session {
    /// Takes a byte from the host. Gives the frame of the answer, if the byte ends a request.
    pub fn receive(&mut self, byte: u8, device: &mut impl Device) -> Option<&[u8]> {
        let message = self.decoder.feed(byte)?;
        // Number and request apart, as in `Numbered`: a request that is not understood has an answer too.
        let (sequence, request) = postcard::take_from_bytes::<u16>(message).ok()?;
        let mut name = Path::new();
        let answer = match postcard::take_from_bytes(request) {
            Ok((request, [])) => answer(&request, device, &mut self.staged, &mut name),
            _ => Err(Refusal::NotUnderstood),
        };
        let answer = answer.unwrap_or_else(Answer::Refused);
        encode(&Message::Answer { sequence, answer }, &mut self.frame.0)
    }

    /// The frame of the next telemetry, if there is any.
    pub fn telemetry(&mut self, device: &mut impl Device) -> Option<&[u8]> {
        let telemetry = device.next_telemetry()?;
        encode(&Message::Telemetry(telemetry), &mut self.frame.0)
    }
}

/// The answer to a request, which may borrow a parameter's name.
fn answer<'n>(
    request: &Request,
    device: &mut impl Device,
    staged: &mut Option<Staged>,
    name_of: &'n mut Path,
) -> Result<Answer<'n>, Refusal<'static>> {
    // Refused only by a device that cannot take commands at all, whose drive then stops as it should.
    let _ = device.command(Command::KeepAlive);
    match *request {
        Request::Identify => {
            *staged = None;
            return Ok(Answer::Identity(device.identity()));
        }
        Request::Status => return Ok(Answer::Status(device.status())),
        Request::ReadParameter(index) => {
            let found = schema::nth(&mut { *device.parameters() }, index.into());
            let (name, value) = found.ok_or(Refusal::NoParameter)?;
            *name_of = name;
            return Ok(Answer::Parameter { name: name_of, value });
        }
        Request::Command(Command::KeepAlive) => {}
        Request::Command(command) => device.command(command)?,
        Request::SetTelemetry(decimation) => device.set_telemetry(decimation),
        Request::StageParameter { name, value } => {
            let before = staged.take();
            *staged = Some(stage(before, name, value, device)?);
        }
        Request::ApplyParameters => {
            let Staged { parameters, beyond_control } =
                staged.take().ok_or(Refusal::NothingStaged)?;
            if beyond_control {
                check_off(device)?;
                device.change_parameters(&parameters)?;
            } else {
                match device.status().mode {
                    // Measured, or about to be.
                    mode @ (Mode::Armed | Mode::Commissioning) => return Err(Refusal::Mode(mode)),
                    _ => device.change_controller(&parameters.drive.control)?,
                }
            }
        }
        Request::SaveParameters => {
            check_off(device)?;
            device.save_parameters()?;
        }
        Request::Commission(nameplate) => match device.status().mode {
            Mode::Ready => device.commission(&nameplate)?,
            mode => return Err(Refusal::Mode(mode)),
        },
        Request::ReadProgress => return Ok(Answer::Progress(device.progress())),
        Request::ReadEvidence => {
            check_off(device)?;
            let evidence = device.evidence().ok_or(Refusal::NotCommissioned)?;
            return Ok(Answer::Evidence(evidence));
        }
    }
    Ok(Answer::Done)
}

/// What is staged, and another value with it.
fn stage(
    before: Option<Staged>,
    name: &str,
    value: Value,
    device: &impl Device,
) -> Result<Staged, Refusal<'static>> {
    let in_force = || Staged { parameters: *device.parameters(), beyond_control: false };
    let mut staged = before.unwrap_or_else(in_force);
    schema::set(&mut staged.parameters, name, value)?;
    staged.beyond_control |= name != "control" && !name.starts_with("control.");
    Ok(staged)
}

/// Refuses what would disturb a motor that turns.
fn check_off(device: &impl Device) -> Result<(), Refusal<'static>> {
    match device.status().mode {
        Mode::Ready | Mode::Faulted => Ok(()),
        mode => Err(Refusal::Mode(mode)),
    }
}
