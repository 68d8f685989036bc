//! The core's accesses: instructions and data, from memory, bus and the core's own registers.

use super::exception::{Done, Fault};
use super::own::ACTLR;
use super::{Bus, Cpu};
use crate::chip::flash;
use crate::memory::{CCM_SIZE, Ram, SRAM_SIZE};
use rsemu::cpu::arm::v7m::isa::{Insn, decode, is_32bit};
use rsemu::cpu::arm::v7m::sys::{Access, Exception, ccr, fsr, in_ppb, in_vendor_ppb};

/// Offset of the flash's pages that are read through the bus, which knows of broken cells. The core executes from below only.
const DATA_PAGES: usize = 0x1_e000;

const FLASH_END: u32 = flash::BASE + flash::SIZE as u32;
const CODE_SIZE: u32 = DATA_PAGES as u32;
const CODE_END: u32 = flash::BASE + CODE_SIZE;

/// The bus's windows: peripherals, and the debug unit of the microcontroller.
const PERIPHERALS: std::ops::Range<u32> = 0x4000_0000..0x6000_0000;
const DBGMCU: std::ops::Range<u32> = 0xe004_2000..0xe004_2400;

/// The registers of memory protection, and MPU_CTRL's bit that leaves the usual map where there is no region.
const MPU: std::ops::Range<u32> = 0xe000_ed90..0xe000_edbc;
const PRIVDEFENA: u32 = 1 << 2;

/// The program counter's sample, the one register of the debug blocks that only the core knows.
const DWT_PCSR: u32 = 0xe000_101c;

/// An instruction.
#[derive(Clone, Copy)]
pub(super) struct Code {
    pub insn: Insn,
    pub is_wide: bool,
}

impl Code {
    fn new(halves: u32) -> Self {
        let (first, second) = (halves as u16, (halves >> 16) as u16);
        Self { insn: decode(first, second), is_wide: is_32bit(first) }
    }
}

/// The instructions of a memory as they were last decoded, one for each half-word, beside the half-words that they are from. So what is
/// written anew is decoded anew.
struct Cache(Vec<(u32, Code)>);

impl Cache {
    fn new(size: usize) -> Self {
        Self(vec![(0, Code::new(0)); size / 2])
    }

    fn get(&mut self, ram: &Ram, offset: u32) -> Option<Code> {
        let word = ram.word(offset)?;
        let halves = if offset & 2 == 0 {
            word
        } else {
            let after = ram.word(offset + 2);
            if after.is_none() && is_32bit((word >> 16) as u16) {
                return None;
            }
            word >> 16 | after.unwrap_or(0) << 16
        };
        let (source, code) = self.0.get_mut(offset as usize / 2)?;
        if *source != halves {
            *source = halves;
            *code = Code::new(halves);
        }
        Some(*code)
    }
}

/// The instructions of all memories.
pub(super) struct Decoded {
    flash: Cache,
    sram: Cache,
    ccm: Cache,
}

impl Decoded {
    pub fn new() -> Self {
        Self {
            flash: Cache::new(flash::SIZE),
            sram: Cache::new(SRAM_SIZE),
            ccm: Cache::new(CCM_SIZE),
        }
    }
}

impl Cpu {
    /// The instruction at an address.
    pub(super) fn fetch(&mut self, address: u32) -> Done<Code> {
        self.check_protection(address, 4, Access::Fetch)?;
        let code = match address {
            0..CODE_SIZE => self.decoded.flash.get(&self.memory.flash, address),
            flash::BASE..CODE_END => {
                self.decoded.flash.get(&self.memory.flash, address - flash::BASE)
            }
            _ => match self.memory.at(address) {
                Some((ram, offset)) if std::ptr::eq(ram, &self.memory.ccm) => {
                    self.decoded.ccm.get(ram, offset)
                }
                Some((ram, offset)) => self.decoded.sram.get(ram, offset),
                None => None,
            },
        };
        code.ok_or_else(|| self.bus_fault(address, Access::Fetch))
    }

    /// An entry of the vector table, by its offset.
    pub(super) fn vector(&self, offset: u32) -> Option<u32> {
        let address = self.sys.vtor.wrapping_add(offset);
        self.read_flash(address, 4).or_else(|| self.memory.read(address, 4))
    }

    /// What the flash has at an address, where it is read without the bus.
    fn read_flash(&self, address: u32, size: usize) -> Option<u32> {
        let offset = match address {
            flash::BASE..CODE_END => address - flash::BASE,
            _ => address,
        };
        self.memory.flash.read(offset, size)
    }

    /// Reads 1, 2 or 4 bytes.
    pub(super) fn load(&mut self, bus: &mut impl Bus, address: u32, size: usize) -> Done<u32> {
        self.cycles += 1;
        if in_ppb(address) && !in_vendor_ppb(address) {
            return self.load_own(address, size);
        }
        self.check_protection(address, size as u32, Access::Read)?;
        if address.is_multiple_of(size as u32) {
            return self.load_aligned(bus, address, size);
        }
        let mut value = 0;
        for byte in 0..size as u32 {
            value |= self.load_aligned(bus, address.wrapping_add(byte), 1)? << (8 * byte);
        }
        Ok(value)
    }

    /// Writes 1, 2 or 4 bytes.
    pub(super) fn store(
        &mut self,
        bus: &mut impl Bus,
        address: u32,
        size: usize,
        value: u32,
    ) -> Done {
        self.cycles += 1;
        if in_ppb(address) && !in_vendor_ppb(address) {
            return self.store_own(address, size, value);
        }
        self.check_protection(address, size as u32, Access::Write)?;
        if address.is_multiple_of(size as u32) {
            return self.store_aligned(bus, address, size, value);
        }
        for byte in 0..size as u32 {
            self.store_aligned(bus, address.wrapping_add(byte), 1, value >> (8 * byte) & 0xff)?;
        }
        Ok(())
    }

    fn load_aligned(&mut self, bus: &mut impl Bus, address: u32, size: usize) -> Done<u32> {
        if let Some(value) = self.memory.read(address, size) {
            return Ok(value);
        }
        if let Some(value) = self.read_flash(address, size) {
            return Ok(value);
        }
        match address {
            CODE_END..FLASH_END => {}
            _ if PERIPHERALS.contains(&address) || DBGMCU.contains(&address) => {}
            _ => return Err(self.bus_fault(address, Access::Read)),
        }
        self.has_touched = true;
        Ok(bus.read(self.time, address, size))
    }

    fn store_aligned(&mut self, bus: &mut impl Bus, address: u32, size: usize, value: u32) -> Done {
        if self.memory.write(address, size, value) {
            return Ok(());
        }
        match address {
            // What is written to the flash goes to its registers.
            flash::BASE..FLASH_END => {}
            _ if PERIPHERALS.contains(&address) || DBGMCU.contains(&address) => {}
            _ => return Err(self.bus_fault(address, Access::Write)),
        }
        self.has_touched = true;
        let mask = u32::MAX >> (32 - 8 * size);
        bus.write(self.time, address, size, value & mask);
        Ok(())
    }

    /// Reads from the core's own registers, words of which a part may be taken.
    pub(super) fn load_own(&mut self, address: u32, size: usize) -> Done<u32> {
        self.check_modelled(address, 0, None);
        let word = self.own_word(address, false);
        let word = word.ok_or_else(|| self.bus_fault(address, Access::Read))?;
        let value = u64::from(word) >> (8 * (address & 3));
        Ok(value as u32 & u32::MAX >> (32 - 8 * size))
    }

    /// First and last address of all regions of memory protection that are enabled.
    pub(super) fn guarded(&self) -> [u32; 2] {
        let regions = self.sys.mpu_rbar.iter().zip(&self.sys.mpu_rasr);
        let enabled = regions.filter(|(_, attributes)| *attributes & 1 != 0);
        enabled.fold([u32::MAX, 0], |[first, last], (base, attributes)| {
            // 2^(SIZE + 1) bytes.
            let inner = u32::MAX >> (31 - (attributes >> 1 & 31));
            [first.min(base & !inner), last.max(base | inner)]
        })
    }

    /// One of the core's own registers, without the effects of reading if `quietly`.
    fn own_word(&mut self, address: u32, quietly: bool) -> Option<u32> {
        match address & !3 {
            DWT_PCSR => Some(self.address),
            ACTLR => Some(self.actlr),
            word => self.sys.read_word(word, quietly),
        }
    }

    pub(super) fn store_own(&mut self, address: u32, size: usize, value: u32) -> Done {
        self.is_to_arbitrate = true;
        let shift = 8 * (address & 3);
        let mask = (u32::MAX >> (32 - 8 * size)) << shift;
        // Without the effects of reading.
        let old = self.own_word(address, true);
        let word = if size == 4 {
            Some(value)
        } else {
            // The rest is what it was.
            old.map(|old| old & !mask | value << shift & mask)
        };
        if let (Some(old), Some(new)) = (old, word) {
            self.check_modelled(address, old ^ new, Some(value));
        }
        let is_stored = word.is_some_and(|word| match address & !3 {
            ACTLR => {
                self.actlr = word;
                true
            }
            _ => self.sys.write_word(address, word),
        });
        if MPU.contains(&address) {
            self.guarded = self.guarded();
        }
        if is_stored { Ok(()) } else { Err(self.bus_fault(address, Access::Write)) }
    }

    /// Faults if an access is not aligned although it has to be: always, or where CCR says so.
    pub(super) fn check_alignment(&self, address: u32, size: usize, always: bool) -> Done {
        let traps = always || self.sys.ccr & ccr::UNALIGN_TRP != 0;
        if traps && !address.is_multiple_of(size as u32) {
            return Err(Fault::usage(fsr::UF_UNALIGNED));
        }
        Ok(())
    }

    /// Faults if the memory protection unit forbids an access.
    fn check_protection(&self, address: u32, size: u32, access: Access) -> Done {
        self.check_protection_as(self.is_privileged(), address, size, access)
    }

    pub(super) fn check_protection_as(
        &self,
        privileged: bool,
        address: u32,
        size: u32,
        access: Access,
    ) -> Done {
        if self.sys.mpu_ctrl & 1 == 0 {
            return Ok(());
        }
        let last = address.wrapping_add(size - 1);
        // Beyond all regions the usual map allows it, to what has its use: quicker than to ask each region.
        let [first_guarded, last_guarded] = self.guarded;
        let is_beyond = address <= last && (last < first_guarded || address > last_guarded);
        let is_usual = !matches!(access, Access::Fetch) || last < PERIPHERALS.start;
        if is_beyond && is_usual && privileged && self.sys.mpu_ctrl & PRIVDEFENA != 0 {
            return Ok(());
        }
        let priority = self.priority();
        let is_permitted = [address, last]
            .into_iter()
            .all(|address| self.sys.mpu_permits(address, access, privileged, priority));
        match access {
            _ if is_permitted => Ok(()),
            Access::Fetch => Err(Fault {
                exception: Exception::MEM_MANAGE,
                status: fsr::MM_IACCVIOL,
                address: None,
            }),
            _ => Err(Fault {
                exception: Exception::MEM_MANAGE,
                status: fsr::MM_DACCVIOL | fsr::MM_MMARVALID,
                address: Some(address),
            }),
        }
    }

    /// There is nothing at an address.
    fn bus_fault(&mut self, address: u32, access: Access) -> Fault {
        self.fault_address = Some(address);
        let exception = Exception::BUS_FAULT;
        match access {
            Access::Fetch => Fault { exception, status: fsr::BF_IBUSERR, address: None },
            _ => Fault {
                exception,
                status: fsr::BF_PRECISERR | fsr::BF_BFARVALID,
                address: Some(address),
            },
        }
    }
}
