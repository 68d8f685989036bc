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
//! `sequential-storage` was here before, with a map for each slot: its wear levelling is nothing that sets saved by hand need, and
//! with it the B-G431B-ESC1's image took 71.0 kB, and with this 62.7.
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
    /// The newest readable set: its generation and slot.
    newest: Option<(u32, usize)>,
    /// The newest set that is known to have been saved completely.
    committed: Option<(u32, usize)>,
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
            Some((_, slot)) if newest >= committed => {
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
        // Of a set that was damaged, what tells so stays until there is another.
        let last = newest.max(committed);
        let (generation, slot) =
            last.map_or((0, 0), |(generation, slot)| (generation.saturating_add(1), 1 - slot));
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
                    let found = is_whole.then_some((generation, slot));
                    survey.committed = survey.committed.max(found);
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
