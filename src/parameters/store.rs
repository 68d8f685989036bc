//! Parameters in flash: either the set that was saved last or the one before, whenever the power fails; never a mixture.
//!
//! The region has two slots of whole pages. A save goes to the slot that the newest set is not in: it is erased, the set is written and
//! read back, and then its generation, which counts saves, is written as *committed*.
//!
//! ```text
//! slot   committed: generation, its complement    set: CRC-32, generation, format, length, records
//! bytes  0          4                             8    12          16      20      24
//! ```
//!
//! A set that was interrupted does not match its checksum, and the other slot has the newest. A set that was committed and does not
//! match was damaged, not interrupted, and that is told. What flash cannot read is no set, or not committed. Sets are read across
//! versions of the firmware in both directions: see [`records`].
//!
//! A crate for flash could do the same (`sequential-storage`, one map for each slot, was here before), with wear levelling that no
//! one needs who saves by hand; it took 7 kB more of the 64 that firmware may have.
//!
//! Everything blocks: a microcontroller that erases the flash that it runs from stalls in any case. So save while disarmed only.

use super::{Parameters, records};
use crate::checksum::CRC_32;
use core::fmt;
use core::ops::Range;
use embedded_storage::nor_flash::NorFlash;

/// Largest set, in bytes. Today's take up to 344: a later firmware's may have half as many parameters more and still be read.
const LARGEST: usize = 512;

/// Format of a set: what stands ahead of its records, and what a record is.
const FORMAT: u32 = 2;

/// Bytes ahead of a set's records.
const HEAD: usize = 16;

/// Bytes ahead of a set: its generation as committed. What a flash writes at once must divide it.
const COMMITTED: usize = 8;

/// Where a flash keeps parameters.
#[derive(Debug)]
pub struct ParameterStore<F> {
    flash: F,
    slots: [Range<u32>; 2],
}

/// A region that cannot be halved into erasable pages.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RegionError;

impl fmt::Display for RegionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a region for parameters must be of two halves of whole pages each")
    }
}

impl core::error::Error for RegionError {}

/// What a flash held.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Loaded {
    /// The set to go on with. Its values have not been checked.
    pub parameters: Parameters,
    /// Where it comes from.
    pub origin: Origin,
}

/// Where a set of parameters comes from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Origin {
    /// From flash, saved last.
    Saved,
    /// From the defaults: no set was ever saved completely.
    NeverSaved,
    /// From the defaults: what was saved last is damaged, or cannot be read by this firmware. A fault.
    Unreadable,
}

/// Why a set was not saved. The one before is still there.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum SaveError<E> {
    /// The set does not fit.
    TooLarge,
    /// The flash failed.
    Flash(E),
    /// The flash does not hold what was written.
    Worn,
}

impl<E> From<E> for SaveError<E> {
    fn from(error: E) -> Self {
        Self::Flash(error)
    }
}

/// What the slots hold.
#[derive(Clone, Copy, Default)]
struct Survey {
    /// The newest readable set's generation, and its slot.
    newest: Option<(u32, usize)>,
    /// Newest generation that is known to have been saved completely.
    committed: Option<u32>,
    /// Whether something could not be read.
    failed: bool,
}

impl<F: NorFlash> ParameterStore<F> {
    /// A store in a region of a flash, given as byte offsets. It must be of two halves of whole pages each.
    pub fn new(flash: F, region: Range<u32>) -> Result<Self, RegionError> {
        let length = region.end.checked_sub(region.start).ok_or(RegionError)?;
        let (page, middle) = (F::ERASE_SIZE as u32, region.start + length / 2);
        let has_room = length as usize / 2 >= COMMITTED + LARGEST;
        let fits = [region.start, middle, region.end].iter().all(|bound| bound % page == 0);
        if !fits || !has_room || !COMMITTED.is_multiple_of(F::WRITE_SIZE) {
            return Err(RegionError);
        }
        Ok(Self { flash, slots: [region.start..middle, middle..region.end] })
    }

    /// The set that was saved last, completed from `defaults`, or else these.
    pub fn load(&mut self, defaults: &Parameters) -> Loaded {
        let mut set = [0; LARGEST];
        let Survey { newest, committed, failed } = self.survey(&mut set);
        let mut loaded = Loaded { parameters: *defaults, origin: Origin::Unreadable };
        match newest {
            None if committed.is_none() && !failed => loaded.origin = Origin::NeverSaved,
            Some((generation, slot)) if Some(generation) >= committed => {
                let is_whole = self.read(slot, &mut set).is_ok_and(|set| {
                    set.is_some_and(|(_, records)| records::read(&mut loaded.parameters, records))
                });
                if is_whole {
                    loaded.origin = Origin::Saved;
                } else {
                    loaded.parameters = *defaults;
                }
            }
            _ => {}
        }
        loaded
    }

    /// Saves a set. While it is under way, and after any error, [`load`](Self::load) gives this set or the one before.
    pub fn save(&mut self, parameters: &Parameters) -> Result<(), SaveError<F::Error>> {
        let mut buffer = [0; LARGEST];
        let Survey { newest, committed, .. } = self.survey(&mut buffer);
        let last = newest.map(|(generation, _)| generation).max(committed);
        let generation = last.map_or(0, |last| last.saturating_add(1));
        let slot = newest.map_or(0, |(_, slot)| 1 - slot);
        let Range { start, end } = self.slots[slot];
        let set = encode(parameters, generation, &mut buffer).ok_or(SaveError::TooLarge)?;
        self.flash.erase(start, end)?;
        self.flash.write(start + COMMITTED as u32, set)?;
        if self.read(slot, &mut buffer)?.is_none() {
            return Err(SaveError::Worn);
        }
        self.flash.write(start, &commitment(generation))?;
        Ok(())
    }

    /// Both slots; what they hold goes through `buffer`.
    fn survey(&mut self, buffer: &mut [u8; LARGEST]) -> Survey {
        let mut survey = Survey::default();
        for slot in 0..self.slots.len() {
            match self.read(slot, buffer) {
                Ok(set) => {
                    let found = set.map(|(generation, _)| (generation, slot));
                    survey.newest = survey.newest.max(found);
                }
                Err(_) => survey.failed = true,
            }
            let mut bytes = [0; COMMITTED];
            match self.flash.read(self.slots[slot].start, &mut bytes) {
                Ok(()) => {
                    let [generation @ .., _, _, _, _] = bytes;
                    let generation = u32::from_le_bytes(generation);
                    let is_whole = bytes == commitment(generation);
                    survey.committed = survey.committed.max(is_whole.then_some(generation));
                }
                Err(_) => survey.failed = true,
            }
        }
        survey
    }

    /// A slot's set, if it is whole: its generation and records.
    fn read<'b>(
        &mut self,
        slot: usize,
        buffer: &'b mut [u8; LARGEST],
    ) -> Result<Option<(u32, &'b [u8])>, F::Error> {
        let start = self.slots[slot].start + COMMITTED as u32;
        let (head, rest) = buffer.split_at_mut(HEAD);
        self.flash.read(start, head)?;
        let records = rest.get_mut(..word(head, 3) as usize);
        if let Some(records) = records {
            self.flash.read(start + HEAD as u32, records)?;
        }
        Ok(decode(buffer))
    }
}

/// What tells that a set was saved completely.
fn commitment(generation: u32) -> [u8; COMMITTED] {
    (u64::from(!generation) << 32 | u64::from(generation)).to_le_bytes()
}

/// A set as it is stored.
fn encode<'b>(
    parameters: &Parameters,
    generation: u32,
    buffer: &'b mut [u8; LARGEST],
) -> Option<&'b [u8]> {
    let length = records::write(&mut { *parameters }, &mut buffer[HEAD..])?;
    let set = buffer.get_mut(..HEAD + length)?;
    for (index, value) in [(1, generation), (2, FORMAT), (3, length as u32)] {
        set_word(set, index, value);
    }
    let checksum = CRC_32.checksum(&set[4..]);
    set_word(set, 0, checksum);
    Some(set)
}

/// A stored set's generation and records, if it is whole.
fn decode(set: &[u8]) -> Option<(u32, &[u8])> {
    let (head, records) = set.split_at_checked(HEAD)?;
    let records = records.get(..word(head, 3) as usize)?;
    let checksum = CRC_32.checksum(&set[4..HEAD + records.len()]);
    let is_whole = word(head, 0) == checksum && word(head, 2) == FORMAT;
    is_whole.then_some((word(head, 1), records))
}

fn word(bytes: &[u8], index: usize) -> u32 {
    bytes.as_chunks().0.get(index).map_or(0, |word| u32::from_le_bytes(*word))
}

fn set_word(bytes: &mut [u8], index: usize, value: u32) {
    if let Some(word) = bytes.as_chunks_mut().0.get_mut(index) {
        *word = value.to_le_bytes();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::control::drive_form::{DriveFormConfig, Memory};
    use crate::control::ladrc::LadrcConfig;
    use crate::control::{ControlConfig, Timing};
    use crate::drive::{DriveConfig, Limits};
    use crate::estimate::SpeedSource;
    use crate::motor::MotorParameters;
    use crate::sense::{Calibration, Reads, Sensors};
    use crate::supervisor::Protection;
    use crate::trajectory::Shape;

    const DEFAULTS: Parameters = Parameters {
        drive: DriveConfig {
            motor: MotorParameters::PAPER,
            sensors: Sensors::Exact,
            control: ControlConfig::Drive(DriveFormConfig {
                memory: Memory::Observer,
                observer_bandwidth: 1000.0,
                speed_bandwidth: 500.0,
                current_bandwidth: 3000.0,
                voltage_bandwidth: 1000.0,
                output_bandwidth: 3000.0,
                load_torque: 0.3,
                voltage_reserve: 2.5,
            }),
            timing: Timing { rate: 20_000.0, delay: true },
            limits: Limits {
                duty: 0.9,
                speed: 400.0,
                current: 30.0,
                current_command: 20.0,
                bus_min: 9.0,
                bus_max: 27.0,
            },
            shape: Shape::Step,
        },
        protection: Protection {
            continuous_current: 10.0,
            thermal_time: 20.0,
            temperature: 85.0,
            command_timeout: 1.0,
            stop_time: 3.0,
            standstill: 2.0,
        },
    };

    /// What is saved: different from the defaults in one number of each kind.
    fn saved() -> Parameters {
        let mut saved = DEFAULTS;
        saved.drive.motor.inertia = 1e-4;
        saved.drive.limits.duty = 0.5;
        saved.drive.shape = Shape::SecondOrder { bandwidth: 60.0 };
        saved
    }

    /// `saved` as another version would have saved it: without the paths that `dropped` tells, and with other records.
    fn decoded(
        saved: &Parameters,
        dropped: impl Fn(&str) -> bool,
        others: &[(&str, Value)],
    ) -> Option<Parameters> {
        let mut buffer = [0; LARGEST];
        let mut length = 0;
        append(&mut buffer, &mut length, &[FORMAT, 0, 0, 0, 0]).expect("room");
        for (path, value) in others {
            append_record(&mut buffer, &mut length, path, value).expect("room");
        }
        // A kind of value that does not exist yet.
        append(&mut buffer, &mut length, &[1, 2, 3, 4, 2, 99, 0]).expect("room");
        saved
            .write(&mut |path, value| match dropped(path) {
                true => Ok(()),
                false => append_record(&mut buffer, &mut length, path, &value),
            })
            .expect("room");
        decode(&buffer[..length], &DEFAULTS)
    }

    #[test]
    fn what_is_unknown_is_ignored() {
        let others = [
            ("limits.temperature", Value::Number(80.0)),
            ("brake", Value::Group),
            ("brake.kind", Value::Name("Chopper")),
        ];
        assert_eq!(decoded(&saved(), |_| false, &others), Some(saved()));
    }

    #[test]
    fn what_is_missing_keeps_its_default() {
        let without = |dropped: &str| decoded(&saved(), |path| path == dropped, &[]);
        let duty = DEFAULTS.drive.limits.duty;
        let mut expected = saved();
        expected.drive.limits.duty = duty;
        assert_eq!(without("limits.duty"), Some(expected));
        assert_eq!(decoded(&saved(), |path| path.starts_with("limits"), &[]), Some(expected));
        let mut expected = saved();
        expected.drive.shape = DEFAULTS.drive.shape;
        assert_eq!(without("reference"), Some(expected));
        assert_eq!(decoded(&saved(), |_| true, &[]), Some(DEFAULTS), "nothing but the head");
    }

    #[test]
    fn what_has_another_kind_or_variant_keeps_its_default() {
        let instead =
            |path: &str, value| decoded(&saved(), |other| other == path, &[(path, value)]);
        let mut expected = saved();
        expected.drive.limits.duty = DEFAULTS.drive.limits.duty;
        assert_eq!(instead("limits.duty", Value::Flag(true)), Some(expected));
        let mut expected = saved();
        expected.drive.shape = DEFAULTS.drive.shape;
        assert_eq!(instead("reference", Value::Name("Splines")), Some(expected));
        assert_eq!(instead("reference", Value::Number(1.0)), Some(expected));
    }

    #[test]
    fn a_variants_gains_are_never_completed_from_another_variant() {
        // The default has a bandwidth of the same name, for another controller.
        let mut ladrc = saved();
        ladrc.drive.control = ControlConfig::Ladrc(LadrcConfig::by_bandwidth(
            150.0,
            &DEFAULTS.drive.timing,
            SpeedSource::Exact,
        ));
        assert_eq!(decoded(&ladrc, |_| false, &[]), Some(ladrc));
        let missing = |path: &str| path == "control.Ladrc.observer_bandwidth";
        assert_eq!(decoded(&ladrc, missing, &[]), None);
    }

    #[test]
    fn numbers_out_of_a_types_range_are_unreadable() {
        let mut codes = DEFAULTS;
        codes.drive.sensors = Sensors::Codes(Calibration {
            current_per_code: 0.01,
            current_zero: 2048.0,
            bus_voltage_per_code: 0.0075,
            counts_per_turn: 4096,
            highest_code: 4095,
            reads: Reads::All,
        });
        let path = "sensors.Codes.highest_code";
        let with = |code| decoded(&codes, |other| other == path, &[(path, Value::Integer(code))]);
        assert_eq!(with(4095), Some(codes));
        assert_eq!(with(65_536), None);
        assert_eq!(with(-1), None);
    }

    #[test]
    fn other_formats_are_unreadable() {
        let mut buffer = [0; LARGEST];
        let length = encode(&saved(), 7, &mut buffer).expect("room").len();
        assert_eq!(split(&buffer[..length]).map(|(generation, _)| generation), Some(7));
        assert_eq!(decode(&buffer[..length], &DEFAULTS), Some(saved()));
        buffer[0] = FORMAT + 1;
        assert_eq!(decode(&buffer[..length], &DEFAULTS), None);
        assert_eq!(decode(&[], &DEFAULTS), None);
    }

    #[test]
    fn no_two_names_have_the_same_key() {
        let mut keys = heapless::Vec::<u32, 256>::new();
        for set in [DEFAULTS, saved()] {
            set.write(&mut |path, _| keys.push(key(path)).map_err(|_| Error::Full)).expect("room");
            keys.sort_unstable();
            assert!(keys.windows(2).all(|pair| pair[0] != pair[1]));
            keys.clear();
        }
    }
}
