//! Parameters in flash: either the set that was saved last or the one before, whenever the power fails; never a mixture.
//!
//! A set is one item of `sequential-storage`, protected by that crate's CRC-32: a format version, a generation that counts
//! saves, and a record for each parameter, which is found by the CRC-32 of its name. So sets are read across versions in both
//! directions: what a firmware does not know it ignores; what it does not find it has from its defaults, also where the value
//! is of another kind or the name of a variant that it does not know. What a variant holds has names of its own, so that no
//! controller ever sees another one's gains.
//!
//! The region has two halves of at least two pages, each a map of its own, and a save goes to the half that the newest set is
//! not in. With one map, what an interrupted write or erase leaves can be in the way of every later save, and to erase the map
//! would take the only copy.
//!
//! After a set, its generation is stored as *committed*. A set that is older than that was damaged, not interrupted: the two
//! would look the same otherwise, since damaged items are skipped.
//!
//! Everything blocks: a microcontroller that erases the flash that it runs from stalls in any case. So save while disarmed only.

use super::{Parameters, records};
use core::cmp::Reverse;
use core::fmt;
use core::ops::Range;
use embassy_futures::block_on;
use embedded_storage::nor_flash::NorFlash;
use embedded_storage_async::nor_flash as nonblocking;
use sequential_storage::cache::{Cache, Uncached};
use sequential_storage::map::{MapConfig, MapStorage};

/// Largest set, in bytes. Today's take up to 333: a later firmware's may have half as many parameters more and still be read.
const LARGEST: usize = 512;

/// Format of a set: what stands ahead of its records, and what a record is.
const FORMAT: u8 = 2;

/// Bytes ahead of the records: the format and the generation.
const HEAD: usize = 5;

/// Keys of a half's map.
const SET: u8 = 0;
const COMMITTED: u8 = 1;

/// Where a flash keeps parameters.
#[derive(Debug)]
pub struct ParameterStore<F> {
    flash: F,
    halves: [Range<u32>; 2],
}

type Map<'a, F> = MapStorage<u8, Blocking<&'a mut F>, Cache<Uncached, Uncached, Uncached, u8>>;

/// A region that cannot be halved into two or more erasable pages each.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct RegionError;

impl fmt::Display for RegionError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("a region for parameters must be of two halves of two or more whole pages each")
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
    /// The flash failed, or did not hold what was written.
    Flash(Option<E>),
}

impl<E> From<sequential_storage::Error<E>> for SaveError<E> {
    fn from(error: sequential_storage::Error<E>) -> Self {
        match error {
            sequential_storage::Error::Storage { value } => Self::Flash(Some(value)),
            sequential_storage::Error::ItemTooBig
            | sequential_storage::Error::BufferTooSmall(_) => Self::TooLarge,
            _ => Self::Flash(None),
        }
    }
}

/// What a half of the region holds.
struct Half {
    range: Range<u32>,
    /// Generation of its newest readable set.
    set: Option<u32>,
    /// Newest generation that is known to have been saved completely.
    committed: Option<u32>,
    /// Whether it could not be read.
    failed: bool,
}

impl<F: NorFlash> ParameterStore<F> {
    /// A store in a region of a flash, given as byte offsets. It must be of two halves of two or more whole pages each.
    pub fn new(flash: F, region: Range<u32>) -> Result<Self, RegionError> {
        let length = region.end.checked_sub(region.start).ok_or(RegionError)?;
        let middle = region.start + length / 2;
        let halves = [region.start..middle, middle..region.end];
        for half in &halves {
            MapConfig::<Blocking<&mut F>>::try_new(half.clone()).map_err(|_| RegionError)?;
        }
        Ok(Self { flash, halves })
    }

    /// The set that was saved last, completed from `defaults`, or else these. Repairs what an interrupted save left.
    pub fn load(&mut self, defaults: &Parameters) -> Loaded {
        let [newest, spare] = self.survey();
        let committed = newest.committed.max(spare.committed);
        if newest.set.is_none() && committed.is_none() && !newest.failed && !spare.failed {
            return Loaded { parameters: *defaults, origin: Origin::NeverSaved };
        }
        let complete = newest.set.is_some() && newest.set >= committed;
        match complete.then(|| self.read(&newest.range, defaults)).flatten() {
            Some(parameters) => Loaded { parameters, origin: Origin::Saved },
            None => Loaded { parameters: *defaults, origin: Origin::Unreadable },
        }
    }

    /// Saves a set. While it is under way, and after any error, [`load`](Self::load) gives this set or the one before.
    pub fn save(&mut self, parameters: &Parameters) -> Result<(), SaveError<F::Error>> {
        let [newest, spare] = self.survey();
        let last = newest.set.max(newest.committed).max(spare.committed);
        let generation = last.map_or(0, |last| last.saturating_add(1));
        let mut set = [0; LARGEST];
        let set = encode(parameters, generation, &mut set).ok_or(SaveError::TooLarge)?;
        if self.write(&spare.range, generation, set).is_err() {
            // Leftovers of an interrupted save or erase are in the way. Nothing in this half is needed any more.
            let Range { start, end } = spare.range;
            self.flash.erase(start, end).map_err(|error| SaveError::Flash(Some(error)))?;
            self.write(&spare.range, generation, set)?;
        }
        Ok(())
    }

    /// Writes a set and, once it has been read back, that it is committed.
    fn write(
        &mut self,
        half: &Range<u32>,
        generation: u32,
        set: &[u8],
    ) -> Result<(), SaveError<F::Error>> {
        let mut buffer = [0; LARGEST];
        self.put(half, SET, set, &mut buffer)?;
        if self.fetch(half, SET, &mut buffer)? != Some(set) {
            return Err(SaveError::Flash(None));
        }
        self.put(half, COMMITTED, &generation.to_le_bytes(), &mut buffer)
    }

    /// Both halves, the one with the newest set first.
    fn survey(&mut self) -> [Half; 2] {
        let mut halves = self.halves.clone().map(|range| self.look(range));
        halves.sort_unstable_by_key(|half| Reverse(half.set));
        halves
    }

    fn look(&mut self, range: Range<u32>) -> Half {
        let mut buffer = [0; LARGEST];
        let mut half = Half { range, set: None, committed: None, failed: false };
        match self.fetch(&half.range, SET, &mut buffer) {
            Ok(set) => half.set = set.and_then(|set| Some(split(set)?.0)),
            Err(_) => half.failed = true,
        }
        match self.fetch(&half.range, COMMITTED, &mut buffer) {
            Ok(generation) => {
                let bytes = generation.and_then(|bytes| bytes.first_chunk().copied());
                half.committed = bytes.map(u32::from_le_bytes);
            }
            Err(_) => half.failed = true,
        }
        half
    }

    /// The newest set of a half.
    fn read(&mut self, half: &Range<u32>, defaults: &Parameters) -> Option<Parameters> {
        let mut buffer = [0; LARGEST];
        decode(self.fetch(half, SET, &mut buffer).ok()??, defaults)
    }

    // These two are not inlined: what they call is larger than all else here.

    #[inline(never)]
    fn fetch<'b>(
        &mut self,
        half: &Range<u32>,
        key: u8,
        buffer: &'b mut [u8; LARGEST],
    ) -> Result<Option<&'b [u8]>, SaveError<F::Error>> {
        let mut map = self.map(half)?;
        Ok(block_on(map.fetch_item(buffer, &key))?)
    }

    #[inline(never)]
    fn put(
        &mut self,
        half: &Range<u32>,
        key: u8,
        value: &[u8],
        buffer: &mut [u8; LARGEST],
    ) -> Result<(), SaveError<F::Error>> {
        let mut map = self.map(half)?;
        Ok(block_on(map.store_item(buffer, &key, &value))?)
    }

    fn map(&mut self, half: &Range<u32>) -> Result<Map<'_, F>, SaveError<F::Error>> {
        let config = MapConfig::try_new(half.clone()).map_err(|_| SaveError::Flash(None))?;
        Ok(MapStorage::new(Blocking(&mut self.flash), config, Cache::new_uncached()))
    }
}

/// A set as it is stored.
fn encode<'b>(
    parameters: &Parameters,
    generation: u32,
    buffer: &'b mut [u8; LARGEST],
) -> Option<&'b [u8]> {
    let (head, records) = buffer.split_first_chunk_mut::<HEAD>()?;
    let [format, count @ ..] = head;
    (*format, *count) = (FORMAT, generation.to_le_bytes());
    let length = records::write(&mut { *parameters }, records)?;
    buffer.get(..HEAD + length)
}

/// A set's generation and records.
fn split(set: &[u8]) -> Option<(u32, &[u8])> {
    let ([FORMAT, generation @ ..], records) = set.split_first_chunk::<HEAD>()? else {
        return None;
    };
    Some((u32::from_le_bytes(*generation), records))
}

/// The parameters of a stored set, completed from `defaults`.
fn decode(set: &[u8], defaults: &Parameters) -> Option<Parameters> {
    let (_, records) = split(set)?;
    let mut parameters = *defaults;
    records::read(&mut parameters, records).then_some(parameters)
}

/// A flash that blocks, for a crate that waits.
struct Blocking<F>(F);

impl<F: NorFlash> nonblocking::ErrorType for Blocking<&mut F> {
    type Error = F::Error;
}

impl<F: NorFlash> nonblocking::ReadNorFlash for Blocking<&mut F> {
    const READ_SIZE: usize = F::READ_SIZE;

    async fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Self::Error> {
        self.0.read(offset, bytes)
    }

    fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl<F: NorFlash> nonblocking::NorFlash for Blocking<&mut F> {
    const WRITE_SIZE: usize = F::WRITE_SIZE;
    const ERASE_SIZE: usize = F::ERASE_SIZE;

    async fn erase(&mut self, from: u32, to: u32) -> Result<(), Self::Error> {
        self.0.erase(from, to)
    }

    async fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Self::Error> {
        self.0.write(offset, bytes)
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
