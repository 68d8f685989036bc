//! The core: a Cortex-M4 with floating point, by the interpreter of `rsemu`. Nothing else of this crate knows it, but for the stores of
//! [`Memory`].
//!
//! One step is an instruction, or the entry to an exception. Cycles are an estimate: those of the Cortex-M4's reference manual without
//! wait states, as from core-coupled memory, or from flash if its accelerator always had the instruction.

use crate::chip::flash;
use crate::memory::{CCM, CCM_ALIAS, Memory, SRAM};
use rsemu::core::space::{AddressSpace, Mapping, MemAttrs, MemOps, MemResult, Perms, Region};
use rsemu::cpu::arm::v7m::sys::Exception;
use rsemu::cpu::arm::v7m::{ArmV7m, Config, xpsr};
use std::fmt;
use std::sync::atomic::{AtomicBool, AtomicU64, Ordering};
use std::sync::{Arc, Mutex, MutexGuard, PoisonError};

/// What the core reaches beside memory.
pub trait Bus: Send {
    /// Reads so many bytes, at a time.
    fn read(&mut self, time: u64, address: u32, size: usize) -> u32;

    /// Writes so many bytes, at a time.
    fn write(&mut self, time: u64, address: u32, size: usize, value: u32);
}

/// What core and board share.
pub struct Shared<B> {
    bus: Mutex<B>,
    time: AtomicU64,
    is_touched: AtomicBool,
}

impl<B> Shared<B> {
    /// Around a bus.
    pub fn new(bus: B) -> Self {
        let (time, is_touched) = (AtomicU64::new(0), AtomicBool::new(false));
        Self { bus: Mutex::new(bus), time, is_touched }
    }

    /// The bus.
    pub fn bus(&self) -> MutexGuard<'_, B> {
        // Nothing is left half done by a panic of the one thread that there is.
        self.bus.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Sets the time of the core's next accesses.
    pub fn set_time(&self, time: u64) {
        self.time.store(time, Ordering::Relaxed);
    }

    /// Whether the core has reached for the bus since the last call.
    pub fn take_touched(&self) -> bool {
        // Mostly it has not, and reading alone is cheaper.
        self.is_touched.load(Ordering::Relaxed) && self.is_touched.swap(false, Ordering::Relaxed)
    }

    fn touch(&self) -> u64 {
        self.is_touched.store(true, Ordering::Relaxed);
        self.time.load(Ordering::Relaxed)
    }
}

/// A window of the address space that is the bus's.
struct Window<B> {
    base: u32,
    shared: Arc<Shared<B>>,
}

impl<B> fmt::Debug for Window<B> {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "bus at {:#x}", self.base)
    }
}

impl<B: Bus> MemOps for Window<B> {
    fn read(&self, offset: u64, bytes: &mut [u8], attributes: MemAttrs) -> MemResult {
        let size = bytes.len();
        let value = if attributes.debug {
            0
        } else {
            let time = self.shared.touch();
            self.shared.bus().read(time, self.base + offset as u32, size)
        };
        bytes.copy_from_slice(&value.to_le_bytes()[..size]);
        Ok(())
    }

    fn write(&self, offset: u64, bytes: &[u8], attributes: MemAttrs) -> MemResult {
        let mut value = [0; 4];
        value[..bytes.len()].copy_from_slice(bytes);
        if !attributes.debug {
            let time = self.shared.touch();
            let (address, value) = (self.base + offset as u32, u32::from_le_bytes(value));
            self.shared.bus().write(time, address, bytes.len(), value);
        }
        Ok(())
    }
}

/// Offset of the flash's pages that are read through the bus, which knows of broken cells. The core executes from below only.
pub const DATA_PAGES: usize = 0x1_e000;

/// Priority bits of the interrupt controller (PM0214).
const PRIORITY_BITS: u8 = 4;

/// The core.
pub struct Cpu {
    core: ArmV7m,
    space: Arc<AddressSpace>,
    interrupts: u64,
}

impl Cpu {
    /// In reset, with the memories and the bus at their addresses.
    pub fn new<B: Bus + 'static>(memory: &Memory, shared: &Arc<Shared<B>>) -> Self {
        let window = |base: u32, size: u64| {
            let window = Window { base, shared: Arc::clone(shared) };
            Region::io("bus", size, Arc::new(window))
        };
        let ram = |store: &Arc<_>| Region::ram("memory", Arc::clone(store));
        let (cells, data) = (flash::BASE.into(), u64::from(flash::BASE) + DATA_PAGES as u64);
        let data_size = (flash::SIZE - DATA_PAGES) as u64;
        let code = Perms::RX;
        let space = AddressSpace::new("core", 32);
        let mappings = [
            // The flash, where the core boots from and where it is; what is written goes to its registers.
            Mapping::new(ram(&memory.flash), 0).with_perms(code),
            Mapping::new(ram(&memory.flash), cells).with_perms(code),
            Mapping::new(window(flash::BASE, flash::SIZE as u64), cells)
                .with_perms(Perms::WRITE)
                .with_priority(1),
            Mapping::new(window(flash::BASE + DATA_PAGES as u32, data_size), data).with_priority(2),
            Mapping::new(ram(&memory.sram), SRAM.into()),
            Mapping::new(ram(&memory.ccm), CCM.into()),
            Mapping::new(ram(&memory.ccm), CCM_ALIAS.into()),
            Mapping::new(window(0x4000_0000, 0x2000_0000), 0x4000_0000),
            Mapping::new(window(0xe004_2000, 0x400), 0xe004_2000),
        ];
        {
            let mut topology = space.topology();
            for mapping in mappings {
                // Nothing of it depends on what is emulated.
                #[allow(clippy::expect_used, reason = "the map is fixed")]
                topology.map_with(mapping).expect("memory map");
            }
        }
        let space = Arc::new(space);
        let core = start(&space);
        Self { core, space, interrupts: 0 }
    }

    /// Resets the core, with all that is its own: interrupt controller, system control, cycle counter.
    pub fn reset(&mut self) {
        self.core = start(&self.space);
        self.interrupts = 0;
    }

    /// Executes an instruction or enters an exception. Gives its cycles.
    pub fn step(&self) -> u64 {
        self.core.step()
    }

    /// Sets the levels of the interrupts, a bit each, and of the non-maskable one. Tells whether all are set: between the instructions of
    /// an IT block those that rise have to wait, since `rsemu` 0.0.7 loses the block's state when an exception is entered there.
    pub fn set_interrupts(&mut self, levels: u64, nmi: bool) -> bool {
        // What is being handled is not made pending by its level; `rsemu` does not know that of the non-maskable interrupt.
        let nmi = nmi && !self.is_active(Exception::NMI.0);
        let is_rising = levels & !self.interrupts != 0 || nmi && !self.core.nmi_asserted();
        let waits = is_rising && self.core.xpsr() & xpsr::IT_MASK != 0;
        let (levels, nmi) = if waits { (levels & self.interrupts, false) } else { (levels, nmi) };
        let mut changed = levels ^ self.interrupts;
        self.interrupts = levels;
        while changed != 0 {
            let number = changed.trailing_zeros();
            changed &= changed - 1;
            self.core.set_irq(number as u16, levels & 1 << number != 0);
        }
        self.core.set_nmi(nmi);
        !waits
    }

    /// Cycles go by in which the core stands still, but its clock does not.
    pub fn stall(&self, cycles: u64) {
        self.core.with_sys(|sys| {
            sys.tick_cyccnt(cycles);
        });
    }

    /// Whether it sleeps.
    pub fn is_asleep(&self) -> bool {
        self.core.is_asleep()
    }

    /// Whether it has locked up: only a reset helps.
    pub fn is_locked_up(&self) -> bool {
        self.core.is_locked_up()
    }

    /// Whether it has asked for a reset of the microcontroller.
    pub fn asks_for_reset(&self) -> bool {
        self.core.reset_requested()
    }

    /// The exception that it handles; 0 for none.
    pub fn exception(&self) -> u16 {
        self.core.current_exception().0
    }

    /// Whether it has entered an exception's handler and not left it yet.
    pub fn is_active(&self, exception: u16) -> bool {
        self.core.with_sys(|sys| sys.is_active(Exception(exception)))
    }

    /// Address of the next instruction.
    pub fn pc(&self) -> u32 {
        self.core.pc()
    }

    /// Lets it go on elsewhere.
    pub fn jump(&self, address: u32) {
        self.core.set_pc(address & !1);
    }

    /// The last address without memory that it reached for, if it did.
    pub fn fault_address(&self) -> Option<u32> {
        let (count, address) = self.core.bus_faults();
        (count > 0).then_some(address)
    }

    /// Sets the stack's pointer.
    pub fn set_sp(&self, address: u32) {
        self.core.set_reg(13, address);
    }
}

fn start(space: &Arc<AddressSpace>) -> ArmV7m {
    let config = Config::CORTEX_M4F.with_reset_vtor(flash::BASE).with_priority_bits(PRIORITY_BITS);
    let core = ArmV7m::new(config);
    core.attach_space(Arc::clone(space));
    core
}

#[cfg(test)]
mod tests {
    use super::*;

    struct NoBus;

    impl Bus for NoBus {
        fn read(&mut self, _time: u64, _address: u32, _size: usize) -> u32 {
            0
        }

        fn write(&mut self, _time: u64, _address: u32, _size: usize, _value: u32) {}
    }

    /// Enables interrupt 0, then tests r4 for 1 for ever, and changes it only then. The interrupt's handler sets the flag Z.
    fn core() -> Cpu {
        let mut flash = vec![0_u8; 0x200];
        let mut put = |address: usize, halves: &[u16]| {
            for (place, half) in halves.iter().enumerate() {
                flash[address + 2 * place..][..2].copy_from_slice(&half.to_le_bytes());
            }
        };
        put(0, &[0x1000, 0x2000]); // stack
        put(4, &[0x0101, 0x0800]); // reset
        put(64, &[0x0141, 0x0800]); // interrupt 0
        let enable = [
            0x4804, // ldr r0, =0xe000e100
            0x2101, // movs r1, #1
            0x6001, // str r1, [r0]
            0x2400, // movs r4, #0
            0x2c01, // 1: cmp r4, #1
            0xbf04, // itt eq
            0x2407, // moveq r4, #7
            0x3407, // addeq r4, #7
            0xe7fa, // b 1b
            0xbf00, // nop
            0xe100, 0xe000,
        ];
        put(0x100, &enable);
        put(0x140, &[0x2000, 0x4770]); // movs r0, #0; bx lr
        let memory = Memory::new();
        memory.show_flash(0, &flash);
        Cpu::new(&memory, &Arc::new(Shared::new(NoBus)))
    }

    fn steps(cpu: &Cpu, count: u32) {
        for _ in 0..count {
            cpu.step();
        }
    }

    #[test]
    fn an_interrupt_within_an_it_block_does_not_end_it() {
        let mut waited = 0;
        for before in 5..40 {
            let mut cpu = core();
            steps(&cpu, before);
            while !cpu.set_interrupts(1, false) {
                cpu.step();
                waited += 1;
            }
            cpu.step();
            assert_eq!(cpu.exception(), 16);
            cpu.set_interrupts(0, false);
            steps(&cpu, 10);
            assert_eq!(cpu.exception(), 0);
            assert_eq!(cpu.core.reg(4), 0, "after {before} steps");
        }
        assert!(waited > 0);
    }

    #[test]
    fn a_non_maskable_interrupt_that_is_cleared_by_its_handler_comes_once() {
        let mut cpu = core();
        steps(&cpu, 10);
        while !cpu.set_interrupts(0, true) {
            cpu.step();
        }
        cpu.step();
        assert_eq!(cpu.exception(), Exception::NMI.0);
        cpu.set_interrupts(0, true);
        assert!(!cpu.core.nmi_asserted());
    }
}
