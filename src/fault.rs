//! Everything that stops or limits a drive, in one numbered list: with its cause, what the drive does, and what to do about it.
//!
//! Numbers are those of the bits in [`Faults`] and [`Limits`](ActiveLimits), the same on every board and in every message. They
//! never change; a new entry takes a new number. `docs/faults.md` is this list as a table.

use core::fmt;
use serde::{Deserialize, Serialize};

/// Why a drive stopped. A fault is latched and outputs are off until it is cleared.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum Fault {
    /// A sample held a NaN or an infinity, or was of another kind than the drive's sensors.
    BadSample = 0,
    /// The speed was beyond [`Limits::speed`](crate::drive::Limits::speed).
    Overspeed = 1,
    /// The current was beyond [`Limits::current`](crate::drive::Limits::current).
    Overcurrent = 2,
    /// The bus voltage was below [`Limits::bus_min`](crate::drive::Limits::bus_min).
    BusUndervoltage = 3,
    /// The bus voltage was above [`Limits::bus_max`](crate::drive::Limits::bus_max).
    BusOvervoltage = 4,
    /// The encoder moved further in a period than twice what [`Limits::speed`](crate::drive::Limits::speed) and a count allow.
    EncoderJump = 5,
    /// Load or voltage were beyond the authority of their observers for [`AUTHORITY_TIME`](crate::drive::AUTHORITY_TIME), and
    /// the speed came no nearer to its reference.
    BeyondAuthority = 6,
    /// The voltage that acted was further from the armature's model than [`MODEL_SHARE`](crate::drive::MODEL_SHARE) of
    /// [`Limits::bus_max`](crate::drive::Limits::bus_max) for [`AUTHORITY_TIME`](crate::drive::AUTHORITY_TIME), or three
    /// electrical time constants if that is longer. Seen under every controller.
    ModelMismatch = 7,
    /// The hardware switched the bridge off by itself.
    HardwareTrip = 8,
    /// The square of the current, averaged over the winding's thermal time, reached that of the continuous current.
    Overload = 9,
    /// The board was hotter than [`Protection::temperature`](crate::supervisor::Protection::temperature).
    Overtemperature = 10,
    /// The board's temperature is one that its sensor does not show when it works.
    TemperatureSensor = 11,
    /// The two legs' shunts did not show the same current.
    CurrentSensors = 12,
    /// The current sensors' zero is not where it should be.
    CurrentZero = 13,
    /// No command came for [`Protection::command_timeout`](crate::supervisor::Protection::command_timeout).
    CommandLost = 14,
    /// The control interrupt came too late or took too long, with outputs on.
    Overrun = 15,
    /// The watchdog reset the board.
    WatchdogReset = 16,
    /// The stored parameters could not be read, or a drive cannot be built from them.
    BadParameters = 17,
    /// A peripheral did not start as it should.
    SelfTest = 18,
}

/// What a drive holds back at present. Outputs stay on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[repr(u8)]
pub enum ActiveLimit {
    /// The duty is at [`Limits::duty`](crate::drive::Limits::duty).
    Duty = 24,
    /// The current is near [`Limits::current_command`](crate::drive::Limits::current_command).
    Current = 25,
    /// The load has used most of the winding's thermal reserve.
    Heat = 26,
    /// The board is near its highest temperature.
    Temperature = 27,
    /// The drive is stopping: commanded speeds are not followed.
    Stopping = 28,
}

/// An entry of the list.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    /// The bit's number.
    pub number: u8,
    /// What it is called.
    pub name: &'static str,
    /// What makes it.
    pub cause: &'static str,
    /// What the drive does.
    pub reaction: &'static str,
    /// What to do about it.
    pub remedy: &'static str,
}

impl Fault {
    /// All faults, in the order of their numbers.
    pub const ALL: [Self; 19] = [
        Self::BadSample,
        Self::Overspeed,
        Self::Overcurrent,
        Self::BusUndervoltage,
        Self::BusOvervoltage,
        Self::EncoderJump,
        Self::BeyondAuthority,
        Self::ModelMismatch,
        Self::HardwareTrip,
        Self::Overload,
        Self::Overtemperature,
        Self::TemperatureSensor,
        Self::CurrentSensors,
        Self::CurrentZero,
        Self::CommandLost,
        Self::Overrun,
        Self::WatchdogReset,
        Self::BadParameters,
        Self::SelfTest,
    ];

    /// Name, cause, reaction and remedy.
    pub fn entry(self) -> Entry {
        let off_at_once = "outputs off in the same period";
        let stays_off = "outputs stay off from start";
        let (name, cause, reaction, remedy) = match self {
            Self::BadSample => (
                "bad sample",
                "a sample held no number, or was of another kind than the drive's sensors",
                off_at_once,
                "report it: a board's codes cannot do this",
            ),
            Self::Overspeed => (
                "overspeed",
                "the speed was beyond limits.speed",
                off_at_once,
                "raise limits.speed if the motor may turn so fast; less overshoot by a slower shape of the reference",
            ),
            Self::Overcurrent => (
                "over-current",
                "a sampled current was beyond limits.current",
                off_at_once,
                "look for a short circuit; check motor.resistance and motor.inductance; leave more room above limits.current_command",
            ),
            Self::BusUndervoltage => (
                "under-voltage",
                "the bus voltage was below limits.bus_min",
                off_at_once,
                "check supply and wires for their drop under load",
            ),
            Self::BusOvervoltage => (
                "over-voltage",
                "the bus voltage was above limits.bus_max, as when braking into a supply that takes nothing back",
                off_at_once,
                "brake more slowly, or give the bus a battery, a capacitor or a brake chopper",
            ),
            Self::EncoderJump => (
                "encoder jump",
                "the encoder moved further in a period than twice the speed limit allows",
                off_at_once,
                "check the encoder's wires and supply, and sensors.counts_per_turn",
            ),
            Self::BeyondAuthority => (
                "beyond authority",
                "the load was more than configured or than the current command can hold, the rotor is blocked, the encoder does not count, or it or the motor is connected the wrong way round",
                "outputs off after 25 ms",
                "free the shaft; check the encoder and the sign of sensors.counts_per_turn; raise the configured load or the current command",
            ),
            Self::ModelMismatch => (
                "model mismatch",
                "voltage, current and speed do not fit the motor: a wrong sign of encoder or motor, an open lead, an encoder that does not count, or parameters far from the truth",
                "outputs off after 25 ms or three electrical time constants",
                "check leads and encoder and the sign of sensors.counts_per_turn; measure the motor's parameters",
            ),
            Self::HardwareTrip => (
                "hardware trip",
                "the comparator saw an over-current, or the core locked up, or the clock failed",
                "outputs off at once, without software",
                "look for a short circuit between the motor's leads or to the supply",
            ),
            Self::Overload => (
                "overload (I²t)",
                "the current's mean square over protection.thermal_time reached that of protection.continuous_current",
                "outputs off within 64 periods",
                "let the motor cool down; less load, or a motor that can carry it",
            ),
            Self::Overtemperature => (
                "over-temperature",
                "the board was hotter than protection.temperature",
                "outputs off within 96 periods",
                "let the board cool down; more air, or less current",
            ),
            Self::TemperatureSensor => (
                "temperature sensor",
                "the board's temperature was below -45 °C or above 160 °C: its sensor is broken or not connected",
                "outputs off within 96 periods",
                "repair the board",
            ),
            Self::CurrentSensors => (
                "current sensors",
                "the shunts of the two legs did not show the same current",
                "outputs off after 3 periods",
                "look for a motor lead that touches ground or supply; else repair the board",
            ),
            Self::CurrentZero => (
                "current zero",
                "with outputs off, the code of a current sensor was far from where it shows no current, or took too long to settle",
                stays_off,
                "hold the shaft still and clear; if it comes again, repair the board",
            ),
            Self::CommandLost => (
                "command lost",
                "no command came for protection.command_timeout",
                "the drive stops the motor, then outputs off",
                "check the host and its cable; repeat the command or send keep-alives more often",
            ),
            Self::Overrun => (
                "overrun",
                "the control interrupt was left out, started or ended too late for its period, or a debugger halted the core, with outputs on",
                off_at_once,
                "report it, with what else ran",
            ),
            Self::WatchdogReset => (
                "watchdog reset",
                "the firmware hung, panicked or met a processor fault, and the watchdog reset the board",
                stays_off,
                "report it, with the log; clear to go on",
            ),
            Self::BadParameters => (
                "bad parameters",
                "the stored parameters are not readable or are refused; the built-in ones are in force, with low limits",
                stays_off,
                "store parameters anew",
            ),
            Self::SelfTest => (
                "self-test",
                "a clock, timer, converter or amplifier did not start as it should",
                stays_off,
                "switch off and on; if it comes again, report it or repair the board",
            ),
        };
        Entry { number: self as u8, name, cause, reaction, remedy }
    }
}

impl ActiveLimit {
    /// All limits, in the order of their numbers.
    pub const ALL: [Self; 5] =
        [Self::Duty, Self::Current, Self::Heat, Self::Temperature, Self::Stopping];

    /// Name, cause, reaction and remedy.
    pub fn entry(self) -> Entry {
        let (name, cause, reaction, remedy) = match self {
            Self::Duty => (
                "duty limit",
                "the duty is at limits.duty: the supply has no more voltage for this speed and load",
                "the speed falls behind its reference",
                "a higher supply, or a lower speed",
            ),
            Self::Current => (
                "current limit",
                "the current is within 5 % of limits.current_command, or beyond",
                "the controller asks for no more; the speed falls behind its reference",
                "slower references, less load, or a higher limits.current_command",
            ),
            Self::Heat => (
                "heat",
                "the current's mean square is above 80 % of what trips fault 9",
                "none yet",
                "less load, or pauses",
            ),
            Self::Temperature => (
                "temperature",
                "the board is within 10 °C of protection.temperature",
                "none yet",
                "more air, or less current",
            ),
            Self::Stopping => (
                "stopping",
                "a stop was commanded, or no command came for protection.command_timeout",
                "the speed goes to zero whatever is commanded, then outputs off",
                "wait; arm again when outputs are off",
            ),
        };
        Entry { number: self as u8, name, cause, reaction, remedy }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.entry().name)
    }
}

impl fmt::Display for ActiveLimit {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.entry().name)
    }
}

/// Latched faults: bit n is the fault of number n.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Faults(pub u32);

impl Faults {
    /// No fault.
    pub const NONE: Self = Self(0);

    /// Adds a fault.
    pub fn latch(&mut self, fault: Fault) {
        self.0 |= 1 << fault as u8;
    }

    /// Whether there is none.
    pub fn is_empty(self) -> bool {
        self == Self::NONE
    }

    /// Whether this fault is latched.
    pub fn contains(self, fault: Fault) -> bool {
        self.0 & 1 << fault as u8 != 0
    }

    /// The latched faults, in the order of their numbers.
    pub fn iter(self) -> impl Iterator<Item = Fault> {
        Fault::ALL.into_iter().filter(move |fault| self.contains(*fault))
    }
}

/// Active limits: bit n is the limit of number n.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct ActiveLimits(pub u32);

impl ActiveLimits {
    /// No limit.
    pub const NONE: Self = Self(0);

    /// Adds a limit if it is active.
    pub fn set(&mut self, limit: ActiveLimit, is_active: bool) {
        self.0 |= u32::from(is_active) << limit as u8;
    }

    /// Whether this limit is active.
    pub fn contains(self, limit: ActiveLimit) -> bool {
        self.0 & 1 << limit as u8 != 0
    }

    /// The active limits, in the order of their numbers.
    pub fn iter(self) -> impl Iterator<Item = ActiveLimit> {
        ActiveLimit::ALL.into_iter().filter(move |limit| self.contains(*limit))
    }
}

#[cfg(test)]
mod tests {
    extern crate std;

    use super::*;
    use std::string::String;
    use std::vec::Vec;

    fn entries() -> Vec<Entry> {
        let faults = Fault::ALL.into_iter().map(Fault::entry);
        faults.chain(ActiveLimit::ALL.into_iter().map(ActiveLimit::entry)).collect()
    }

    #[test]
    fn numbers_are_bits_of_one_word_each_once_and_nothing_is_left_unsaid() {
        let entries = entries();
        for pair in entries.windows(2) {
            assert!(pair[0].number < pair[1].number, "{pair:?}");
        }
        for entry in entries {
            assert!(entry.number < 32, "{entry:?}");
            for text in [entry.name, entry.cause, entry.reaction, entry.remedy] {
                assert!(!text.is_empty() && !text.contains('|'), "{entry:?}");
            }
        }
    }

    #[test]
    fn sets_hold_what_was_put_in() {
        let mut faults = Faults::NONE;
        faults.latch(Fault::Overcurrent);
        faults.latch(Fault::SelfTest);
        faults.latch(Fault::Overcurrent);
        assert_eq!(faults.iter().collect::<Vec<_>>(), [Fault::Overcurrent, Fault::SelfTest]);
        assert!(!faults.is_empty() && !faults.contains(Fault::BadSample));
        let mut limits = ActiveLimits::NONE;
        limits.set(ActiveLimit::Heat, true);
        limits.set(ActiveLimit::Duty, false);
        assert_eq!(limits.iter().collect::<Vec<_>>(), [ActiveLimit::Heat]);
    }

    #[test]
    fn the_documents_table_is_this_list() {
        let mut table = String::from("| number | name | cause | reaction | remedy |\n");
        table.push_str("|---|---|---|---|---|\n");
        for Entry { number, name, cause, reaction, remedy } in entries() {
            table.push_str(&std::format!(
                "| {number} | {name} | {cause} | {reaction} | {remedy} |\n"
            ));
        }
        let document = include_str!("../docs/faults.md");
        assert!(document.contains(&table), "docs/faults.md should hold:\n{table}");
    }
}
