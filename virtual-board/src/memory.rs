//! The microcontroller's memories (DS12589, memory mapping), as core and DMA see them.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering::Relaxed};

/// SRAM1 and SRAM2, which follow each other.
pub const SRAM: u32 = 0x2000_0000;

/// Core-coupled memory.
pub const CCM: u32 = 0x1000_0000;

/// Its second address, behind SRAM2.
pub const CCM_ALIAS: u32 = 0x2000_5800;

pub(crate) const SRAM_SIZE: usize = 22 * 1024;
pub(crate) const CCM_SIZE: usize = 10 * 1024;

/// What fills memory where nothing was written since power came.
const FILL: u8 = 0xa5;

/// A memory, of words, that several can hold. Only one thread uses it, so that nothing needs an order.
#[derive(Clone)]
pub(crate) struct Ram(Arc<[AtomicU32]>);

impl Ram {
    fn new(size: usize) -> Self {
        Self((0..size / 4).map(|_| AtomicU32::new(0)).collect())
    }

    /// The word that an offset is in, if it is one of this memory.
    pub fn word(&self, offset: u32) -> Option<u32> {
        self.0.get(offset as usize / 4).map(|word| word.load(Relaxed))
    }

    /// Reads 1, 2 or 4 bytes at a multiple of as many; what an offset has beside is ignored, as on the bus.
    pub fn read(&self, offset: u32, size: usize) -> Option<u32> {
        let (shift, mask) = lanes(offset, size);
        Some(self.word(offset)? >> shift & mask)
    }

    /// Writes 1, 2 or 4 bytes at a multiple of as many. Tells whether it is an offset of this memory.
    pub fn write(&self, offset: u32, size: usize, value: u32) -> bool {
        let Some(word) = self.0.get(offset as usize / 4) else { return false };
        let (shift, mask) = lanes(offset, size);
        word.store(word.load(Relaxed) & !(mask << shift) | (value & mask) << shift, Relaxed);
        true
    }
}

/// Where in its word an access is: the lowest bit's place, and the bits of so many bytes.
fn lanes(offset: u32, size: usize) -> (u32, u32) {
    (8 * (offset & (4 - size as u32)), u32::MAX >> (32 - 8 * size))
}

/// The memories. A clone is another handle on the same ones.
#[derive(Clone)]
pub struct Memory {
    pub(crate) sram: Ram,
    pub(crate) ccm: Ram,
    /// A copy of the flash's cells, which the core executes from.
    pub(crate) flash: Ram,
}

impl Memory {
    /// As power finds them.
    pub fn new() -> Self {
        let memory = Self {
            sram: Ram::new(SRAM_SIZE),
            ccm: Ram::new(CCM_SIZE),
            flash: Ram::new(crate::chip::flash::SIZE),
        };
        memory.lose();
        memory
    }

    /// Power goes: their contents are lost.
    pub fn lose(&self) {
        for (address, size) in [(SRAM, SRAM_SIZE), (CCM, CCM_SIZE)] {
            self.paint(address..address + size as u32);
        }
    }

    /// Fills a range with what an unused memory holds.
    pub fn paint(&self, range: core::ops::Range<u32>) {
        for address in range {
            self.write(address, 1, FILL.into());
        }
    }

    /// How much of a range, from its lowest address on, was never written since it was painted.
    pub fn unused(&self, range: core::ops::Range<u32>) -> usize {
        range.take_while(|address| self.read(*address, 1) == Some(FILL.into())).count()
    }

    /// The memory at an address, and the offset in it. The flash is none that is written to.
    pub(crate) fn at(&self, address: u32) -> Option<(&Ram, u32)> {
        const SRAM_END: u32 = SRAM + SRAM_SIZE as u32;
        const CCM_END: u32 = CCM + CCM_SIZE as u32;
        const ALIAS_END: u32 = CCM_ALIAS + CCM_SIZE as u32;
        match address {
            SRAM..SRAM_END => Some((&self.sram, address - SRAM)),
            CCM..CCM_END => Some((&self.ccm, address - CCM)),
            CCM_ALIAS..ALIAS_END => Some((&self.ccm, address - CCM_ALIAS)),
            _ => None,
        }
    }

    /// Reads 1, 2 or 4 bytes at a multiple of as many, if there is memory.
    pub fn read(&self, address: u32, size: usize) -> Option<u32> {
        let (ram, offset) = self.at(address)?;
        ram.read(offset, size)
    }

    /// Writes 1, 2 or 4 bytes at a multiple of as many. Tells whether there is memory.
    pub fn write(&self, address: u32, size: usize, value: u32) -> bool {
        self.at(address).is_some_and(|(ram, offset)| ram.write(offset, size, value))
    }

    /// The flash's cells have changed.
    pub fn show_flash(&self, offset: usize, bytes: &[u8]) {
        for (offset, byte) in (offset as u32..).zip(bytes) {
            self.flash.write(offset, 1, (*byte).into());
        }
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}
