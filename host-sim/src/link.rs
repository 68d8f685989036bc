//! Where the drive under test runs: here, in QEMU, or in both at once.

use crate::double::SimulatedScalar;
use crate::qemu::{Qemu, QemuError};
use quasidrive::config::ConfigError;
use quasidrive::drive::{Drive, DriveConfig, Mode, Refusal, Telemetry};
use quasidrive::hal::{BridgeCommand, Sample};
use quasidrive::protocol::{RECORD_NAMES, RECORD_WORDS, Record, Word};

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

/// A drive that is armed or arms itself, wherever it runs.
pub trait Link<S> {
    /// One period: the commanded speed (rad/s) and the sample go in.
    fn exchange(&mut self, target: f32, sample: &Sample<S>) -> Result<Period<S>, LinkError>;
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
pub struct Local<S: SimulatedScalar> {
    drive: Drive<S>,
    commanded: Option<f32>,
    /// Periods until the drive is armed; none once it is.
    armed_in: Option<u64>,
}

impl<S: SimulatedScalar> Local<S> {
    /// Builds a drive that is armed from its first period on.
    pub fn new(config: &DriveConfig) -> Result<Self, LinkError> {
        Self::armed_after(config, 0)
    }

    /// Builds a drive that is armed after `idle` periods, in which it follows the motor with the bridge off.
    pub fn armed_after(config: &DriveConfig, idle: u64) -> Result<Self, LinkError> {
        Ok(Self { drive: Drive::new(config)?, commanded: None, armed_in: Some(idle) })
    }

    /// Counts down to the period that arms.
    fn arm_in_time(&mut self) -> Result<(), LinkError> {
        self.armed_in = match self.armed_in {
            None => None,
            Some(0) => {
                self.drive.arm().map_err(LinkError::Refused)?;
                None
            }
            Some(periods) => Some(periods - 1),
        };
        Ok(())
    }
}

impl<S: SimulatedScalar> Link<S> for Local<S> {
    #[inline]
    fn exchange(&mut self, target: f32, sample: &Sample<S>) -> Result<Period<S>, LinkError> {
        if self.commanded.replace(target) != Some(target) {
            self.drive.set_speed(target).map_err(LinkError::Refused)?;
        }
        self.arm_in_time()?;
        let command = self.drive.step(sample);
        Ok(Period { command, mode: self.drive.mode(), telemetry: self.drive.telemetry() })
    }
}

/// The drive here and in QEMU, held to the same bits in every period.
pub struct LockStep<'a, S: SimulatedScalar + Word> {
    host: Local<S>,
    target: Qemu<'a>,
    commanded: Option<f32>,
    period: u64,
}

impl<'a, S: SimulatedScalar + Word> LockStep<'a, S> {
    /// Both must have been built from the same configuration.
    pub fn new(host: Local<S>, target: Qemu<'a>) -> Self {
        Self { host, target, commanded: None, period: 0 }
    }
}

impl<S: SimulatedScalar + Word> Link<S> for LockStep<'_, S> {
    fn exchange(&mut self, target: f32, sample: &Sample<S>) -> Result<Period<S>, LinkError> {
        let new = self.commanded.replace(target) != Some(target);
        let reply = self.target.period(new.then_some(target), sample)?;
        let period = self.host.exchange(target, sample)?;
        let Period { command, mode, telemetry } = period;
        let record = Record { command, mode, telemetry };
        if reply != record.reply() {
            let there = self.target.record()?;
            return Err(Difference::find(self.period, record.to_words(), there).into());
        }
        self.period += 1;
        Ok(period)
    }
}

/// The first signal that differs between host and target.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum Difference {
    /// A signal.
    #[error("period {period}: {signal} differs: host {host:#010x}, target {target:#010x}")]
    Signal {
        /// Periods before.
        period: u64,
        /// Its name.
        signal: &'static str,
        /// Its bits here.
        host: u32,
        /// Its bits there.
        target: u32,
    },
    /// None: the digests differ, the records do not.
    #[error("period {0}: the target's reply does not fit its record")]
    Reply(u64),
}

impl Difference {
    fn find(period: u64, host: [u32; RECORD_WORDS], target: [u32; RECORD_WORDS]) -> Self {
        let mut pairs = host.into_iter().zip(target).zip(RECORD_NAMES);
        match pairs.find(|((host, target), _)| host != target) {
            Some(((host, target), signal)) => Self::Signal { period, signal, host, target },
            None => Self::Reply(period),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn one_wrong_bit_on_the_target_ends_the_run() {
        use crate::qemu::tests::{accepted, against};
        use crate::scenario::Scenario;
        use quasidrive::hal::Exact;

        let config = Scenario::paper().drive_config();
        let sample =
            Sample::Exact(Exact { speed: 1.0, advance: 5e-5, current: 2.0, bus_voltage: 24.0 });
        // What a right target answers, from a second drive here.
        let mut twin = Local::<f32>::new(&config).expect("valid");
        let record = |period: Period<f32>| {
            let Period { command, mode, telemetry } = period;
            Record { command, mode, telemetry }
        };
        let first = record(twin.exchange(100.0, &sample).expect("runs"));
        let second = record(twin.exchange(100.0, &sample).expect("runs"));
        let mut wrong = second.to_words();
        wrong[7] ^= 1;
        let mut reply = second.reply().to_words();
        reply[2] ^= 1;
        let answers =
            vec![accepted(), first.reply().to_words().to_vec(), reply.to_vec(), wrong.to_vec()];
        let target = against(answers, true).expect("set up");
        let mut both = LockStep::new(Local::new(&config).expect("valid"), target);
        both.exchange(100.0, &sample).expect("equal");
        let error = both.exchange(100.0, &sample).expect_err("a wrong bit").to_string();
        assert!(error.starts_with("period 1: z2 differs: host 0x"), "{error}");
    }

    #[test]
    fn the_first_differing_signal_is_told_with_its_bits() {
        let words =
            Record { command: BridgeCommand::Duty(0.5_f32), mode: Mode::Running, telemetry: None }
                .to_words();
        let mut other = words;
        other[1] += 1;
        other[5] = 7;
        assert_eq!(
            Difference::find(3, words, other).to_string(),
            "period 3: duty differs: host 0x3f000000, target 0x3f000001"
        );
        assert_eq!(Difference::find(3, words, words), Difference::Reply(3));
    }
}
