//! A simulated microcontroller's flash, whose power can fail in the middle of a write or an erase.

use embedded_storage::nor_flash::{
    ErrorType, NorFlash, NorFlashError, NorFlashErrorKind, ReadNorFlash, check_erase, check_read,
    check_write,
};
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use std::ops::Range;
use std::path::Path;

/// Bytes of a page, which is erased at once.
const PAGE: usize = 2048;

/// Bytes of a word, which is written at once.
const WORD: usize = 8;

/// A byte that was erased.
const ERASED: u8 = 0xff;

/// The STM32G431's: pages of 2 kB, programmed by double words, and only once after each erase.
#[derive(Clone, Debug)]
pub struct SimulatedFlash {
    memory: Vec<u8>,
    /// Writes of words and erases of pages.
    operations: usize,
    failure: Option<Failure>,
    powered: bool,
    /// A bit that stays as it is, and how.
    worn: Option<(usize, bool)>,
    /// Where what a power failure left does not match its error-correcting code, if reading that is an error.
    broken: Option<Range<usize>>,
    is_checked: bool,
}

/// When and how the power fails.
#[derive(Clone, Debug)]
struct Failure {
    operation: usize,
    tear: Tear,
    random: StdRng,
}

/// What the operation in which the power fails leaves.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Tear {
    /// What was there.
    Nothing,
    /// What was to be there.
    All,
    /// Of the bits that were to change, some.
    Some,
    /// The first half of the bytes as they were to be, the rest as they were.
    Front,
    /// The second half.
    Back,
    /// A page's first and last word as they were, the rest as it was to be.
    Middle,
}

impl Tear {
    /// All of them.
    pub const ALL: [Self; 6] =
        [Self::Nothing, Self::All, Self::Some, Self::Front, Self::Back, Self::Middle];
}

/// Why the flash did not do as it was told.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FlashError {
    /// The power has failed.
    PowerLost,
    /// A word was written that was not erased.
    NotErased,
    /// What was read does not match its error-correcting code.
    Uncorrectable,
    /// Bad arguments.
    Arguments(NorFlashErrorKind),
}

impl NorFlashError for FlashError {
    fn kind(&self) -> NorFlashErrorKind {
        match self {
            Self::Arguments(kind) => *kind,
            Self::PowerLost | Self::NotErased | Self::Uncorrectable => NorFlashErrorKind::Other,
        }
    }
}

impl SimulatedFlash {
    /// Bytes of the whole flash.
    pub const SIZE: usize = 128 * 1024;

    /// Erased.
    pub fn new() -> Self {
        Self::holding(vec![ERASED; Self::SIZE])
    }

    fn holding(memory: Vec<u8>) -> Self {
        Self {
            memory,
            operations: 0,
            failure: None,
            powered: true,
            worn: None,
            broken: None,
            is_checked: false,
        }
    }

    /// With the contents of a file, which must be all of the flash.
    pub fn read(file: &Path) -> std::io::Result<Self> {
        let memory = std::fs::read(file)?;
        if memory.len() != Self::SIZE {
            return Err(std::io::Error::other("it is not the contents of a flash of 128 kB"));
        }
        Ok(Self::holding(memory))
    }

    /// What it holds.
    pub fn memory(&self) -> &[u8] {
        &self.memory
    }

    /// The same flash after the power has come back.
    pub fn powered_again(&self) -> Self {
        let Self { broken, is_checked, .. } = self.clone();
        Self { broken, is_checked, ..Self::holding(self.memory.clone()) }
    }

    /// Lets reading fail where an operation was interrupted, whatever it left there.
    pub fn check_when_reading(&mut self) {
        self.is_checked = true;
    }

    /// Lets the power fail in the operation, a word's write or a page's erase, that follows the next `operations`.
    pub fn fail_after(&mut self, operations: usize, tear: Tear) {
        let operation = self.operations + operations;
        let random = StdRng::seed_from_u64(operation as u64);
        self.failure = Some(Failure { operation, tear, random });
    }

    /// Writes of words and erases of pages until now.
    pub fn operations(&self) -> usize {
        self.operations
    }

    /// Turns one bit over.
    pub fn flip(&mut self, bit: usize) {
        self.memory[bit / 8] ^= 1 << (bit % 8);
    }

    /// Keeps one bit from ever changing again.
    pub fn wear_out(&mut self, bit: usize) {
        self.worn = Some((bit, self.bit(bit)));
    }

    fn bit(&self, bit: usize) -> bool {
        self.memory[bit / 8] & 1 << (bit % 8) != 0
    }

    /// One operation: a word or a page from `start` on becomes `new`, unless the power fails.
    fn change(&mut self, start: usize, new: &[u8]) -> Result<(), FlashError> {
        if !self.powered {
            return Err(FlashError::PowerLost);
        }
        let old = &mut self.memory[start..start + new.len()];
        match &mut self.failure {
            Some(failure) if failure.operation == self.operations => {
                failure.tear(old, new);
                self.powered = false;
                self.broken = Some(start..start + new.len());
                return Err(FlashError::PowerLost);
            }
            _ => old.copy_from_slice(new),
        }
        if self
            .broken
            .as_ref()
            .is_some_and(|broken| (start..start + new.len()).contains(&broken.start))
        {
            self.broken = None;
        }
        self.operations += 1;
        if let Some((bit, state)) = self.worn
            && self.bit(bit) != state
        {
            self.flip(bit);
        }
        Ok(())
    }
}

impl Default for SimulatedFlash {
    fn default() -> Self {
        Self::new()
    }
}

impl Failure {
    fn tear(&mut self, old: &mut [u8], new: &[u8]) {
        let half = old.len() / 2;
        let inner = WORD..old.len().saturating_sub(WORD);
        for (index, (old, new)) in old.iter_mut().zip(new).enumerate() {
            let mask = match self.tear {
                Tear::Nothing => 0,
                Tear::All => u8::MAX,
                Tear::Some => self.random.random(),
                Tear::Front => u8::MAX * u8::from(index < half),
                Tear::Back => u8::MAX * u8::from(index >= half),
                Tear::Middle => u8::MAX * u8::from(inner.contains(&index)),
            };
            *old ^= (*old ^ new) & mask;
        }
    }
}

impl ErrorType for SimulatedFlash {
    type Error = FlashError;
}

impl ReadNorFlash for SimulatedFlash {
    const READ_SIZE: usize = 1;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), FlashError> {
        check_read(self, offset, bytes.len()).map_err(FlashError::Arguments)?;
        if !self.powered {
            return Err(FlashError::PowerLost);
        }
        let (start, end) = (offset as usize, offset as usize + bytes.len());
        let is_broken = |broken: &Range<usize>| start < broken.end && broken.start < end;
        if self.is_checked && self.broken.as_ref().is_some_and(is_broken) {
            return Err(FlashError::Uncorrectable);
        }
        bytes.copy_from_slice(&self.memory[start..end]);
        Ok(())
    }

    fn capacity(&self) -> usize {
        self.memory.len()
    }
}

impl NorFlash for SimulatedFlash {
    const WRITE_SIZE: usize = WORD;
    const ERASE_SIZE: usize = PAGE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), FlashError> {
        check_erase(self, from, to).map_err(FlashError::Arguments)?;
        (from as usize..to as usize)
            .step_by(PAGE)
            .try_for_each(|page| self.change(page, &[ERASED; PAGE]))
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), FlashError> {
        check_write(self, offset, bytes.len()).map_err(FlashError::Arguments)?;
        for (start, word) in (offset as usize..).step_by(WORD).zip(bytes.chunks(WORD)) {
            if self.memory[start..start + WORD].iter().any(|byte| *byte != ERASED) {
                return Err(FlashError::NotErased);
            }
            self.change(start, word)?;
        }
        Ok(())
    }
}
