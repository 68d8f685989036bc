//! The core: a Cortex-M4 with floating point (ARMv7-M Architecture Reference Manual, DDI 0403E), an interpreter.
//!
//! Instructions are decoded, floating-point numbers computed, and the registers of interrupt controller and system control kept by
//! `rsemu`; this executes them, from memories without locks, where `rsemu`'s own core takes some nine locked accesses an instruction. The
//! tests play both in lockstep.
//!
//! | module | what |
//! |---|---|
//! | `access` | instructions and data, from memory, bus and the core's own registers |
//! | `exception` | entry, return, faults, the floating-point context |
//! | `execute` | integer instructions |
//! | `alu` | arithmetic on their operands |
//! | `dsp` | those of the DSP extension |
//! | `float` | floating-point instructions |
//! | `special` | the special registers |
//! | `own` | which of the core's registers in memory are modelled |
//!
//! One step is an instruction, or the entry to an exception. Cycles are an estimate: those of the Cortex-M4's reference manual without
//! wait states, as from core-coupled memory, or from flash if its accelerator always had the instruction.
//!
//! Not modelled: bit-band aliases, which are no memory here; what beside SEV sets the event register, so that WFE sleeps at
//! once where a chip that has handled an interrupt meanwhile goes through it one time more; the debugger.

mod access;
mod alu;
mod dsp;
mod exception;
mod execute;
mod float;
#[cfg(test)]
mod lockstep;
mod own;
mod special;

use crate::chip::{Refused, flash};
use crate::memory::Memory;
use access::Decoded;
use exception::Fault;
use rsemu::cpu::arm::v7m::fp::Fpu;
use rsemu::cpu::arm::v7m::isa::{Cond, Insn};
use rsemu::cpu::arm::v7m::sys::{CPUID_CORTEX_M4, Exception, MPU_REGIONS, Sys};
use rsemu::cpu::arm::v7m::{FpUnit, xpsr};

/// What the core reaches beside memory.
pub trait Bus {
    /// Reads so many bytes, at a time.
    fn read(&mut self, time: u64, address: u32, size: usize) -> u32;

    /// Writes so many bytes, at a time.
    fn write(&mut self, time: u64, address: u32, size: usize, value: u32);
}

/// Priority bits of the interrupt controller (PM0214).
const PRIORITY_BITS: u8 = 4;

/// What the core is at.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Mode {
    /// It takes stack pointer and start from the vector table next.
    Reset,
    Running,
    /// In WFI or WFE.
    Asleep,
    LockedUp,
}

/// The core.
pub struct Cpu {
    memory: Memory,
    decoded: Decoded,
    mode: Mode,
    /// The registers; of the program counter, between steps the next instruction's address, during one what reading it gives.
    r: [u32; 16],
    /// The stack pointer of main and process that is not in use.
    other_sp: u32,
    is_on_process_stack: bool,
    /// Flags, as in xPSR.
    apsr: u32,
    /// ITSTATE.
    it: u8,
    is_thumb: bool,
    /// The exception that is handled; 0 for none.
    exception: u16,
    primask: bool,
    faultmask: bool,
    basepri: u8,
    control: u32,
    sys: Sys,
    actlr: u32,
    /// First and last address that a region of memory protection has.
    guarded: [u32; 2],
    fpu: Fpu,
    /// What LDREX has marked.
    exclusive: Option<u32>,
    /// What SEV has left for WFE.
    event: bool,
    /// Levels of the interrupts, a bit each, and of the non-maskable one.
    levels: u64,
    nmi: bool,
    /// Whether something has changed that decides on which exception is taken.
    is_to_arbitrate: bool,
    /// The last address without memory that it reached for.
    fault_address: Option<u32>,
    /// The first access to its own registers that is not modelled.
    refused: Option<Refused>,

    // Of the step.
    time: u64,
    cycles: u64,
    /// The instruction's address.
    address: u32,
    /// The next one's.
    next: u32,
    /// Whether the instruction leaves the flags because it is a short one in an IT block.
    keeps_flags: bool,
    has_touched: bool,
}

impl Cpu {
    /// In reset.
    pub fn new(memory: &Memory) -> Self {
        let mut sys = Sys::new(CPUID_CORTEX_M4, PRIORITY_BITS, MPU_REGIONS as u8)
            .with_fp(FpUnit::V4Sp.mvfr());
        sys.vtor = flash::BASE;
        Self {
            memory: memory.clone(),
            decoded: Decoded::new(),
            mode: Mode::Reset,
            r: [0; 16],
            other_sp: 0,
            is_on_process_stack: false,
            apsr: 0,
            it: 0,
            is_thumb: true,
            exception: 0,
            primask: false,
            faultmask: false,
            basepri: 0,
            control: 0,
            sys,
            actlr: 0,
            guarded: [u32::MAX, 0],
            fpu: Fpu::new(),
            exclusive: None,
            event: false,
            levels: 0,
            nmi: false,
            is_to_arbitrate: false,
            fault_address: None,
            refused: None,
            time: 0,
            cycles: 0,
            address: 0,
            next: 0,
            keeps_flags: false,
            has_touched: false,
        }
    }

    /// Resets the core, with all that is its own: interrupt controller, system control, cycle counter.
    pub fn reset(&mut self) {
        *self = Self::new(&self.memory);
    }

    /// Executes an instruction or enters an exception, at a time. Gives its cycles.
    pub fn step(&mut self, bus: &mut impl Bus, time: u64) -> u64 {
        self.time = time;
        self.cycles = 1;
        if self.is_to_arbitrate && self.take_pending(bus) {
            self.r[15] = self.next;
        } else if self.mode == Mode::Running {
            self.execute_next(bus);
        } else if self.mode == Mode::Reset {
            self.start();
        }
        self.count();
        self.cycles
    }

    /// Takes stack pointer and start from the vector table.
    fn start(&mut self) {
        self.mode = Mode::Running;
        self.r[13] = self.vector(0).unwrap_or(0) & !3;
        let entry = self.vector(4).unwrap_or(0);
        self.r[15] = entry & !1;
        self.is_thumb = entry & 1 != 0;
        self.cycles = 2;
    }

    fn execute_next(&mut self, bus: &mut impl Bus) {
        let address = self.r[15];
        let it = self.it;
        self.address = address;
        if let Err(fault) = self.fetch_and_execute(bus) {
            self.r[15] = address;
            self.it = it;
            self.next = address;
            self.take_fault(fault, bus);
        }
        self.r[15] = self.next;
    }

    fn fetch_and_execute(&mut self, bus: &mut impl Bus) -> Result<(), Fault> {
        if !self.is_thumb {
            return Err(Fault::INVALID_STATE);
        }
        let code = self.fetch(self.address)?;
        self.next = self.address.wrapping_add(if code.is_wide { 4 } else { 2 });
        self.r[15] = self.address.wrapping_add(4);
        self.keeps_flags = false;
        if self.it != 0 {
            let condition = Cond(self.it >> 4);
            self.keeps_flags = !code.is_wide;
            if !matches!(code.insn, Insn::It { .. }) {
                self.it =
                    if self.it & 0b111 == 0 { 0 } else { self.it & 0xe0 | self.it << 1 & 0x1f };
            }
            if !condition.passes(self.apsr) {
                return Ok(());
            }
        }
        self.execute(code.insn, bus)
    }

    /// Lets the core's cycle counter go on.
    fn count(&mut self) {
        if self.sys.cyccnt_enabled() {
            self.sys.tick_cyccnt(self.cycles);
        }
    }

    /// Sets the levels of the interrupts, a bit each, and of the non-maskable one.
    pub fn set_interrupts(&mut self, levels: u64, nmi: bool) {
        self.is_to_arbitrate |= levels != self.levels || nmi != self.nmi;
        (self.levels, self.nmi) = (levels, nmi);
    }

    /// Cycles go by in which the core stands still, but its clock does not.
    pub fn stall(&mut self, cycles: u64) {
        self.sys.tick_cyccnt(cycles);
    }

    /// An access to its own registers that is not modelled, if there was one. The core itself goes on.
    pub fn refused(&self) -> Option<Refused> {
        self.refused
    }

    /// Whether it has reached for the bus since the last call, or has something refused.
    pub fn take_touched(&mut self) -> bool {
        core::mem::take(&mut self.has_touched)
    }

    /// Whether it sleeps.
    pub fn is_asleep(&self) -> bool {
        self.mode == Mode::Asleep
    }

    /// Whether it has locked up: only a reset helps.
    pub fn is_locked_up(&self) -> bool {
        self.mode == Mode::LockedUp
    }

    /// Whether it has asked for a reset of the microcontroller.
    pub fn asks_for_reset(&self) -> bool {
        self.sys.reset_requested
    }

    /// The exception that it handles; 0 for none.
    pub fn exception(&self) -> u16 {
        self.exception
    }

    /// Whether it has entered an exception's handler and not left it yet.
    pub fn is_active(&self, exception: u16) -> bool {
        self.sys.is_active(Exception(exception))
    }

    /// Address of the next instruction.
    pub fn pc(&self) -> u32 {
        self.r[15]
    }

    /// Address of the last instruction.
    pub fn last_pc(&self) -> u32 {
        self.address
    }

    /// Lets it go on elsewhere.
    pub fn jump(&mut self, address: u32) {
        self.r[15] = address & !1;
    }

    /// The last address without memory that it reached for, if it did.
    pub fn fault_address(&self) -> Option<u32> {
        self.fault_address
    }

    /// Sets the stack's pointer.
    pub fn set_sp(&mut self, address: u32) {
        self.r[13] = address;
    }

    // The state in the words of the manual

    fn xpsr(&self) -> u32 {
        let it = u32::from(self.it >> 2) << 10 | u32::from(self.it & 3) << 25;
        let thumb = if self.is_thumb { xpsr::T } else { 0 };
        self.apsr | it | thumb | u32::from(self.exception)
    }

    fn set_xpsr(&mut self, value: u32) {
        self.apsr = value & (xpsr::FLAGS | xpsr::GE);
        self.it = (value >> 8 & 0xfc | value >> 25 & 3) as u8;
        self.is_thumb = value & xpsr::T != 0;
        self.exception = (value & xpsr::EXCEPTION) as u16;
    }

    fn is_privileged(&self) -> bool {
        use rsemu::cpu::arm::v7m::sys::control::NPRIV;
        self.exception != 0 || self.control & NPRIV == 0
    }

    /// Priority of what runs (B1.5.4, ExecutionPriority).
    fn priority(&self) -> i32 {
        let mut priority = self.sys.active_priority();
        if self.basepri != 0 {
            priority = priority.min((self.basepri & self.sys.group_mask()).into());
        }
        if self.primask {
            priority = priority.min(0);
        }
        if self.faultmask {
            priority = priority.min(-1);
        }
        priority
    }

    /// Takes the stack pointer that mode and CONTROL select.
    fn select_stack(&mut self) {
        use rsemu::cpu::arm::v7m::sys::control::SPSEL;
        let is_on_process_stack = self.exception == 0 && self.control & SPSEL != 0;
        if is_on_process_stack != self.is_on_process_stack {
            core::mem::swap(&mut self.r[13], &mut self.other_sp);
            self.is_on_process_stack = is_on_process_stack;
        }
    }
}
