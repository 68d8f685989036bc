//! The microcontroller's memories (DS12589, memory mapping), as core and DMA see them.

use rsemu::core::space::RamStore;
use std::sync::Arc;

/// SRAM1 and SRAM2, which follow each other.
pub const SRAM: u32 = 0x2000_0000;

/// Core-coupled memory.
pub const CCM: u32 = 0x1000_0000;

/// Its second address, behind SRAM2.
pub const CCM_ALIAS: u32 = 0x2000_5800;

const SRAM_SIZE: u64 = 22 * 1024;
const CCM_SIZE: u64 = 10 * 1024;

/// What fills memory where nothing was written since power came.
const FILL: u8 = 0xa5;

/// The memories. A clone is another handle on the same ones.
#[derive(Clone)]
pub struct Memory {
    pub(crate) sram: Arc<RamStore>,
    pub(crate) ccm: Arc<RamStore>,
    /// A copy of the flash's cells, which the core executes from.
    pub(crate) flash: Arc<RamStore>,
}

impl Memory {
    /// As power finds them.
    pub fn new() -> Self {
        let memory = Self {
            sram: Arc::new(RamStore::new(SRAM_SIZE)),
            ccm: Arc::new(RamStore::new(CCM_SIZE)),
            flash: Arc::new(RamStore::new(crate::chip::flash::SIZE as u64)),
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

    /// The store at an address, and the offset in it. The flash is none that is written to.
    fn store(&self, address: u32) -> Option<(&RamStore, u64)> {
        [(&self.sram, SRAM), (&self.ccm, CCM), (&self.ccm, CCM_ALIAS)]
            .into_iter()
            .map(|(store, base)| (&**store, u64::from(address.wrapping_sub(base))))
            .find(|(store, offset)| *offset < store.len())
    }

    /// Reads so many bytes, if there is memory.
    pub fn read(&self, address: u32, size: usize) -> Option<u32> {
        let (store, offset) = self.store(address)?;
        let mut bytes = [0; 4];
        store.read_at(offset, bytes.get_mut(..size)?).ok()?;
        Some(u32::from_le_bytes(bytes))
    }

    /// Writes so many bytes. Tells whether there is memory.
    pub fn write(&self, address: u32, size: usize, value: u32) -> bool {
        let bytes = value.to_le_bytes();
        match (self.store(address), bytes.get(..size)) {
            (Some((store, offset)), Some(bytes)) => store.write_at(offset, bytes).is_ok(),
            _ => false,
        }
    }

    /// The flash's cells have changed.
    pub fn show_flash(&self, offset: usize, bytes: &[u8]) {
        // Both are of the flash's size.
        let _ = self.flash.write_at(offset as u64, bytes);
    }
}

impl Default for Memory {
    fn default() -> Self {
        Self::new()
    }
}
