//! Where the drive under test runs: here, in QEMU, or in both at once.

use crate::double::SimulatedScalar;
use crate::qemu::{Qemu, QemuError};
use quasidrive::config::ConfigError;
use quasidrive::drive::{Drive, DriveConfig, Mode, Refusal, Telemetry};
use quasidrive::hal::{BridgeCommand, Sample};
use quasidrive::protocol::Reply;

/// What a drive did in a period.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Period<S> {
    /// What the bridge shall do.
    pub command: BridgeCommand<S>,
    /// The mode after the period.
    pub mode: Mode,
    /// What the last driven period did.
    pub telemetry: Option<Telemetry<S>>,
}

/// An armed drive, wherever it runs.
pub trait Link<S> {
    /// One period: the commanded speed and the sample go in.
    fn exchange(&mut self, target: S, sample: &Sample<S>) -> Result<Period<S>, LinkError>;
}

/// Why a link gave no answer.
#[derive(Debug, thiserror::Error)]
pub enum LinkError {
    /// The drive's configuration was refused.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// The drive refused a command.
    #[error("the drive refused a command: {0:?}")]
    Refused(Refusal),
    /// QEMU could not be used, or was lost.
    #[error(transparent)]
    Qemu(#[from] QemuError),
    /// Host and target computed different bits.
    #[error(transparent)]
    Differs(#[from] Difference),
}

/// The drive in this process.
pub struct Local<S: SimulatedScalar>(Drive<S>);

impl<S: SimulatedScalar> Local<S> {
    /// Builds and arms a drive.
    pub fn new(config: &DriveConfig) -> Result<Self, LinkError> {
        let mut drive = Drive::new(config)?;
        drive.arm().map_err(LinkError::Refused)?;
        Ok(Self(drive))
    }
}

impl<S: SimulatedScalar> Link<S> for Local<S> {
    fn exchange(&mut self, target: S, sample: &Sample<S>) -> Result<Period<S>, LinkError> {
        self.0.set_speed(target).map_err(LinkError::Refused)?;
        let command = self.0.step(sample);
        Ok(Period { command, mode: self.0.mode(), telemetry: self.0.telemetry() })
    }
}

impl Link<f32> for Qemu {
    fn exchange(&mut self, target: f32, sample: &Sample<f32>) -> Result<Period<f32>, LinkError> {
        let Reply { command, mode, telemetry } = self.period(target, sample)?;
        Ok(Period { command, mode, telemetry })
    }
}

/// The drive here and in QEMU, held to the same bits in every period.
pub struct LockStep {
    host: Local<f32>,
    target: Qemu,
    period: u64,
}

impl LockStep {
    /// Both must have been built from the same configuration.
    pub fn new(host: Local<f32>, target: Qemu) -> Self {
        Self { host, target, period: 0 }
    }
}

impl Link<f32> for LockStep {
    fn exchange(&mut self, target: f32, sample: &Sample<f32>) -> Result<Period<f32>, LinkError> {
        let host = self.host.exchange(target, sample)?;
        let there = self.target.exchange(target, sample)?;
        Difference::find(self.period, &host, &there).map_or(Ok(()), Err)?;
        self.period += 1;
        Ok(host)
    }
}

/// The first bit that differs between host and target.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
#[error("period {period}: {signal} differs: host {host:#010x} ({}), target {target:#010x} ({})", f32::from_bits(*host), f32::from_bits(*target))]
pub struct Difference {
    period: u64,
    signal: &'static str,
    host: u32,
    target: u32,
}

impl Difference {
    fn find(period: u64, host: &Period<f32>, target: &Period<f32>) -> Option<Self> {
        let words = |&Period { command, mode, telemetry }: &Period<f32>| {
            Reply { command, mode, telemetry }.to_words()
        };
        let pairs = words(host).into_iter().zip(words(target)).zip(Reply::NAMES);
        let mut differing = pairs.filter(|((host, target), _)| host != target);
        let ((host, target), signal) = differing.next()?;
        Some(Self { period, signal, host, target })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use quasidrive::protocol::Reply;

    fn period(duty: f32) -> Period<f32> {
        Period { command: BridgeCommand::Duty(duty), mode: Mode::Running, telemetry: None }
    }

    #[test]
    fn equal_bits_are_no_difference_and_one_bit_is() {
        assert_eq!(Difference::find(3, &period(0.5), &period(0.5)), None);
        let next = f32::from_bits(0.5_f32.to_bits() + 1);
        let difference = Difference::find(3, &period(0.5), &period(next)).expect("one bit");
        assert_eq!(
            difference.to_string(),
            "period 3: duty differs: host 0x3f000000 (0.5), target 0x3f000001 (0.50000006)"
        );
        assert!(Difference::find(0, &period(0.0), &period(-0.0)).is_some(), "signs of zero count");
        assert_eq!(Reply::NAMES.len(), Reply::WORDS);
    }
}
