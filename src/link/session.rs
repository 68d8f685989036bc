//! The drive's end of the link.

use super::frame::{Decoder, LONGEST, encode};
use super::message::{Answer, Identity, Message, Refusal, Request, Status, Telemetry};
use crate::control::ControlConfig;
use crate::parameters::Parameters;
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
    fn parameters(&self) -> Parameters;

    /// Gives the supervisor a command.
    fn command(&mut self, command: Command) -> Result<(), Refusal<'static>>;

    /// Lets another controller take over.
    fn change_controller(&mut self, control: &ControlConfig) -> Result<(), Refusal<'static>>;

    /// Goes on with other parameters. Outputs are off.
    fn write_parameters(&mut self, parameters: &Parameters) -> Result<(), Refusal<'static>>;

    /// Saves the parameters in force. Outputs are off.
    fn save_parameters(&mut self) -> Result<(), Refusal<'static>>;

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
    frame: Frame,
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
        let answer = match postcard::take_from_bytes(request) {
            Ok((request, [])) => answer(&request, device),
            _ => Answer::Refused(Refusal::NotUnderstood),
        };
        encode(&Message::Answer { sequence, answer }, &mut self.frame.0)
    }

    /// The frame of the next telemetry, if there is any.
    pub fn telemetry(&mut self, device: &mut impl Device) -> Option<&[u8]> {
        let telemetry = device.next_telemetry()?;
        encode(&Message::Telemetry(telemetry), &mut self.frame.0)
    }
}

fn answer(request: &Request, device: &mut impl Device) -> Answer<'static> {
    // Refused only by a device that cannot take commands at all, whose drive then stops as it should.
    let _ = device.command(Command::KeepAlive);
    let done = match request {
        Request::Identify => return Answer::Identity(device.identity()),
        Request::Status => return Answer::Status(device.status()),
        Request::ReadParameters => return Answer::Parameters(device.parameters()),
        Request::Command(Command::KeepAlive) => Ok(()),
        Request::Command(command) => device.command(*command),
        Request::ChangeController(control) => device.change_controller(control),
        Request::SetTelemetry(decimation) => {
            device.set_telemetry(*decimation);
            Ok(())
        }
        Request::WriteParameters(parameters) => {
            with_outputs_off(device, |device| device.write_parameters(parameters))
        }
        Request::SaveParameters => with_outputs_off(device, Device::save_parameters),
    };
    match done {
        Ok(()) => Answer::Done,
        Err(refusal) => Answer::Refused(refusal),
    }
}

/// Does what would disturb a motor that turns, or refuses to.
fn with_outputs_off<D: Device>(
    device: &mut D,
    act: impl FnOnce(&mut D) -> Result<(), Refusal<'static>>,
) -> Result<(), Refusal<'static>> {
    match device.status().mode {
        Mode::Ready | Mode::Faulted => act(device),
        mode => Err(Refusal::Mode(mode)),
    }
}
