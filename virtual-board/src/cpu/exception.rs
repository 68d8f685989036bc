//! Exceptions: entry, return, faults, and the floating-point context that goes with them (DDI 0403E, B1.5).

use super::{Bus, Cpu, Mode};
use rsemu::cpu::arm::v7m::fp::fpscr;
use rsemu::cpu::arm::v7m::sys::{Exception, ccr, control, exc_return, fpccr, fsr};
use rsemu::cpu::arm::v7m::xpsr;

/// Cycles to enter an exception or to leave it, without floating-point registers, and from one to the next (Cortex-M4 TRM).
const ENTRY: u64 = 12;
const TAIL_CHAIN: u64 = 6;

/// Stacked xPSR: whether the stack was aligned by a word.
const IS_ALIGNED: u32 = 1 << 9;

/// Why an instruction did not complete.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Fault {
    pub exception: Exception,
    /// Its bits in CFSR.
    pub status: u32,
    /// What BFAR or MMFAR show.
    pub address: Option<u32>,
}

impl Fault {
    pub const UNDEFINED: Self = Self::usage(fsr::UF_UNDEFINSTR);
    pub const INVALID_STATE: Self = Self::usage(fsr::UF_INVSTATE);
    pub const NO_COPROCESSOR: Self = Self::usage(fsr::UF_NOCP);
    const INVALID_RETURN: Self = Self::usage(fsr::UF_INVPC);

    pub const fn usage(status: u32) -> Self {
        Self { exception: Exception::USAGE_FAULT, status, address: None }
    }
}

/// What an instruction gives if it completes.
pub(super) type Done<T = ()> = Result<T, Fault>;

impl Cpu {
    /// Enters the pending exception that is more urgent than what runs, if there is one; at least it wakes the core.
    pub(super) fn take_pending(&mut self, bus: &mut impl Bus) -> bool {
        if matches!(self.mode, Mode::Reset | Mode::LockedUp) {
            return false;
        }
        self.is_to_arbitrate = false;
        self.latch_levels();
        let Some((exception, priority)) = self.sys.highest_pending() else { return false };
        if self.mode == Mode::Asleep {
            self.mode = Mode::Running;
        }
        if priority >= self.priority() {
            return false;
        }
        self.enter(exception, self.r[15], bus);
        true
    }

    /// An interrupt whose level is high is pending, unless it is being handled (B3.4.1).
    fn latch_levels(&mut self) {
        if self.nmi && !self.sys.is_active(Exception::NMI) {
            self.sys.set_pending(Exception::NMI, true);
        }
        let mut levels = self.levels;
        while levels != 0 {
            let interrupt = Exception(16 + levels.trailing_zeros() as u16);
            levels &= levels - 1;
            if !self.sys.is_active(interrupt) {
                self.sys.set_pending(interrupt, true);
            }
        }
    }

    /// Enters the exception of a fault, or what it escalates to (B1.5.4).
    pub(super) fn take_fault(&mut self, fault: Fault, bus: &mut impl Bus) {
        self.sys.cfsr |= fault.status;
        if let Some(address) = fault.address {
            let is_protection = fault.exception == Exception::MEM_MANAGE;
            *if is_protection { &mut self.sys.mmfar } else { &mut self.sys.bfar } = address;
        }
        let (exception, priority) = (fault.exception, self.priority());
        if self.sys.is_enabled(exception) && self.sys.priority_of(exception) < priority {
            self.enter(exception, self.next, bus);
        } else {
            self.take_hard_fault(fsr::HF_FORCED, bus);
        }
    }

    fn take_hard_fault(&mut self, status: u32, bus: &mut impl Bus) {
        self.sys.hfsr |= status;
        if self.priority() <= -1 {
            self.lock_up();
        } else {
            self.enter(Exception::HARD_FAULT, self.next, bus);
        }
    }

    fn lock_up(&mut self) {
        self.mode = Mode::LockedUp;
        self.next = 0xffff_fffe;
    }

    /// SVC.
    pub(super) fn call_supervisor(&mut self, bus: &mut impl Bus) {
        if self.sys.priority_of(Exception::SVCALL) < self.priority() {
            self.enter(Exception::SVCALL, self.next, bus);
        } else {
            self.take_hard_fault(fsr::HF_FORCED, bus);
        }
    }

    /// BKPT, without a debugger.
    pub(super) fn hit_breakpoint(&mut self, bus: &mut impl Bus) {
        self.take_hard_fault(fsr::HF_DEBUGEVT, bus);
    }

    /// Stacks the context and goes to a handler (B1.5.6).
    fn enter(&mut self, exception: Exception, return_address: u32, bus: &mut impl Bus) {
        self.mode = Mode::Running;
        let has_float = self.control & control::FPCA != 0 && self.can_float();
        let size = if has_float { exc_return::EXTENDED_FRAME } else { exc_return::BASIC_FRAME };
        let sp = self.r[13];
        let aligns = (has_float || self.sys.ccr & ccr::STKALIGN != 0) && sp & 4 != 0;
        let frame = (if aligns { sp.wrapping_sub(4) } else { sp }).wrapping_sub(size);
        self.r[13] = frame;
        let [r0, r1, r2, r3] = [0, 1, 2, 3].map(|register| self.r[register]);
        let state = self.xpsr() | if aligns { IS_ALIGNED } else { 0 };
        let stacked = [r0, r1, r2, r3, self.r[12], self.r[14], return_address, state];
        let mut is_stacked = true;
        for (place, value) in words(frame).zip(stacked) {
            is_stacked &= self.store(bus, place, 4, value).is_ok();
        }
        self.cycles = ENTRY;
        if has_float {
            is_stacked &= self.stack_float(bus, frame.wrapping_add(exc_return::FP_OFFSET));
        }
        if !is_stacked {
            // The handler runs all the same, without a way back.
            self.sys.cfsr |= fsr::BF_STKERR;
            self.sys.hfsr |= fsr::HF_FORCED;
        }
        let mut link = match (self.exception, self.is_on_process_stack) {
            (0, false) => exc_return::THREAD_MSP,
            (0, true) => exc_return::THREAD_PSP,
            _ => exc_return::HANDLER_MSP,
        };
        if has_float {
            link &= !exc_return::FP_FRAME;
        }
        self.exclusive = None;
        self.go_to_handler(exception, link);
    }

    /// What entry and tail-chaining share (B1.5.6, ExceptionTaken).
    fn go_to_handler(&mut self, exception: Exception, link: u32) {
        self.is_to_arbitrate = true;
        self.r[14] = link;
        self.it = 0;
        self.exception = exception.0;
        self.select_stack();
        self.sys.set_active(exception, true);
        self.sys.set_pending(exception, false);
        self.control &= !control::FPCA;
        if self.sys.fpccr & fpccr::ASPEN != 0 {
            self.fpu.fpscr = self.sys.fpdscr;
        }
        match self.vector(exception.vector_offset()) {
            Some(entry) => {
                self.next = entry & !1;
                self.is_thumb = entry & 1 != 0;
            }
            None => {
                self.sys.hfsr |= fsr::HF_VECTTBL;
                self.lock_up();
            }
        }
    }

    /// Returns from a handler, to where the link register says (B1.5.8).
    pub(super) fn leave(&mut self, link: u32, bus: &mut impl Bus) -> Done {
        let returning = Exception(self.exception);
        let has_float = link & exc_return::FP_FRAME == 0;
        let (to_handler, to_process_stack) = match link | exc_return::FP_FRAME {
            exc_return::HANDLER_MSP => (true, false),
            exc_return::THREAD_MSP => (false, false),
            exc_return::THREAD_PSP => (false, true),
            _ => return Err(Fault::INVALID_RETURN),
        };
        let is_nested = self.sys.active_count() > 1;
        let may_skip = self.sys.ccr & ccr::NONBASETHRDENA != 0;
        let is_consistent = if to_handler { is_nested } else { !is_nested || may_skip };
        if !is_consistent || !self.sys.is_active(returning) {
            return Err(Fault::INVALID_RETURN);
        }
        if has_float && !self.can_float() {
            return Err(Fault::NO_COPROCESSOR);
        }

        self.is_to_arbitrate = true;
        self.sys.set_active(returning, false);
        if returning != Exception::NMI {
            self.faultmask = false;
        }
        self.latch_levels();
        if let Some((exception, priority)) = self.sys.highest_pending()
            && priority < self.priority()
        {
            self.go_to_handler(exception, link);
            self.cycles = (self.cycles + TAIL_CHAIN).min(ENTRY);
            return Ok(());
        }

        if !to_handler {
            self.exception = 0;
        }
        self.control &= !(control::SPSEL | control::FPCA);
        if to_process_stack {
            self.control |= control::SPSEL;
        }
        self.select_stack();
        self.unstack(bus, has_float);
        self.exclusive = None;
        Ok(())
    }

    fn unstack(&mut self, bus: &mut impl Bus, has_float: bool) {
        let frame = self.r[13];
        let mut is_read = true;
        let mut context = [0; 8];
        for (place, value) in words(frame).zip(&mut context) {
            match self.load(bus, place, 4) {
                Ok(word) => *value = word,
                Err(_) => is_read = false,
            }
        }
        let [r0, r1, r2, r3, r12, lr, pc, state] = context;
        self.cycles = ENTRY;
        if has_float {
            self.control |= control::FPCA;
            is_read &= self.unstack_float(bus, frame.wrapping_add(exc_return::FP_OFFSET));
        }
        if !is_read {
            self.sys.cfsr |= fsr::BF_UNSTKERR;
            self.sys.hfsr |= fsr::HF_FORCED;
        }
        self.r[..4].copy_from_slice(&[r0, r1, r2, r3]);
        self.r[12] = r12;
        self.r[14] = lr;
        self.next = pc & !1;
        let size = if has_float { exc_return::EXTENDED_FRAME } else { exc_return::BASIC_FRAME };
        let aligns = has_float || self.sys.ccr & ccr::STKALIGN != 0;
        let gap = if aligns && state & IS_ALIGNED != 0 { 4 } else { 0 };
        self.r[13] = frame.wrapping_add(size + gap);
        self.set_xpsr(state & (xpsr::WRITABLE | xpsr::EXCEPTION));
        self.select_stack();
    }

    // The floating-point context

    /// Whether instructions may use the floating-point unit.
    pub(super) fn can_float(&self) -> bool {
        self.sys.fp_enabled(self.is_privileged())
    }

    /// Stacks the floating-point context, or, as reset leaves it, the room for it alone. Tells whether it could.
    fn stack_float(&mut self, bus: &mut impl Bus, address: u32) -> bool {
        if self.sys.fpccr & fpccr::LSPEN == 0 {
            return self.store_float(bus, address).is_ok();
        }
        self.sys.fpcar = address;
        // What was ready then decides on what a fault while it is stored at last would be.
        let ready = [
            (fpccr::USER, !self.is_privileged()),
            (fpccr::THREAD, self.exception == 0),
            (fpccr::HFRDY, !self.faultmask),
            (fpccr::MMRDY, self.sys.is_enabled(Exception::MEM_MANAGE)),
            (fpccr::BFRDY, self.sys.is_enabled(Exception::BUS_FAULT)),
            (fpccr::MONRDY, false),
            (fpccr::LSPACT, true),
        ];
        for (bit, is_set) in ready {
            self.sys.fpccr = self.sys.fpccr & !bit | if is_set { bit } else { 0 };
        }
        true
    }

    /// Before a floating-point instruction: stores the context for which there is room only, and makes one of its own (ExecuteFPCheck).
    pub(super) fn claim_float(&mut self, bus: &mut impl Bus) -> Done {
        if !self.can_float() {
            return Err(Fault::NO_COPROCESSOR);
        }
        if self.sys.fpccr & fpccr::LSPACT != 0 {
            // Not again, whether it succeeds or not.
            self.sys.fpccr &= !fpccr::LSPACT;
            self.store_float(bus, self.sys.fpcar)?;
        }
        if self.sys.fpccr & fpccr::ASPEN != 0 {
            self.control |= control::FPCA;
        }
        Ok(())
    }

    fn store_float(&mut self, bus: &mut impl Bus, address: u32) -> Done {
        for (register, place) in (0..16).zip(words(address)) {
            self.store(bus, place, 4, self.fpu.s[register])?;
        }
        self.store(bus, address.wrapping_add(64), 4, self.fpu.fpscr)
    }

    /// Loads the floating-point context, if it was stored at all. Tells whether it could.
    fn unstack_float(&mut self, bus: &mut impl Bus, address: u32) -> bool {
        if self.sys.fpccr & fpccr::LSPACT != 0 {
            self.sys.fpccr &= !fpccr::LSPACT;
            return true;
        }
        let mut context = [0; 17];
        for (place, value) in words(address).zip(&mut context) {
            match self.load(bus, place, 4) {
                Ok(word) => *value = word,
                Err(_) => return false,
            }
        }
        self.fpu.s[..16].copy_from_slice(&context[..16]);
        self.fpu.fpscr = context[16] & fpscr::WRITABLE;
        true
    }
}

/// Addresses of words, from one on.
fn words(first: u32) -> impl Iterator<Item = u32> {
    (0..).map(move |index: u32| first.wrapping_add(4 * index))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::chip::flash;
    use crate::memory::Memory;

    struct NoBus;

    impl Bus for NoBus {
        fn read(&mut self, _: u64, _: u32, _: usize) -> u32 {
            0
        }

        fn write(&mut self, _: u64, _: u32, _: usize, _: u32) {}
    }

    /// Enables interrupt 0, then tests r4 for 1 for ever, and changes it only then. The handlers of interrupts set the flag Z; there are
    /// none of faults.
    fn core() -> Cpu {
        let mut code = vec![0_u8; 0x200];
        let mut put = |address: usize, halves: &[u16]| {
            for (place, half) in halves.iter().enumerate() {
                code[address + 2 * place..][..2].copy_from_slice(&half.to_le_bytes());
            }
        };
        put(0, &[0x1000, 0x2000]); // stack
        put(4, &[0x0101, 0x0800]); // reset
        put(8, &[0x0141, 0x0800]); // non-maskable interrupt
        put(12, &[0x0151, 0x0800]); // hard fault
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
        put(0x150, &[0xde00]); // udf
        let memory = Memory::new();
        memory.show_flash(0, &code);
        Cpu::new(&memory)
    }

    fn steps(cpu: &mut Cpu, count: u32) {
        for _ in 0..count {
            cpu.step(&mut NoBus, 0);
        }
    }

    #[test]
    fn an_it_block_goes_on_after_an_interrupt() {
        let mut interrupted = 0;
        for before in 5..40 {
            let mut cpu = core();
            steps(&mut cpu, before);
            interrupted += u32::from(cpu.it != 0);
            cpu.set_interrupts(1, false);
            assert_eq!(cpu.step(&mut NoBus, 0), ENTRY);
            assert_eq!(cpu.exception(), 16);
            cpu.set_interrupts(0, false);
            steps(&mut cpu, 10);
            assert_eq!(cpu.exception(), 0);
            assert_eq!(cpu.r[4], 0, "after {before} steps");
        }
        assert!(interrupted > 0);
    }

    #[test]
    fn a_non_maskable_interrupt_that_stays_comes_again_after_its_handler_only() {
        let mut cpu = core();
        steps(&mut cpu, 10);
        cpu.set_interrupts(0, true);
        steps(&mut cpu, 2);
        assert_eq!(cpu.exception(), Exception::NMI.0);
        cpu.set_interrupts(0, false);
        steps(&mut cpu, 1);
        assert_eq!(cpu.exception(), 0);
        assert!(!cpu.sys.is_pending(Exception::NMI));
    }

    #[test]
    fn an_interrupt_that_stays_is_chained_to_itself() {
        let mut cpu = core();
        steps(&mut cpu, 10);
        cpu.set_interrupts(1, false);
        steps(&mut cpu, 2);
        assert_eq!(cpu.step(&mut NoBus, 0), 1 + TAIL_CHAIN);
        assert_eq!((cpu.exception(), cpu.pc()), (16, flash::BASE + 0x140));
    }

    #[test]
    fn what_is_no_instruction_is_a_hard_fault_and_another_one_locks_up() {
        let mut cpu = core();
        steps(&mut cpu, 5);
        cpu.jump(flash::BASE + 0x150);
        steps(&mut cpu, 1);
        assert_eq!(cpu.exception(), Exception::HARD_FAULT.0);
        assert_eq!((cpu.sys.hfsr, cpu.sys.cfsr), (fsr::HF_FORCED, fsr::UF_UNDEFINSTR));
        assert!(!cpu.is_locked_up());
        steps(&mut cpu, 1);
        assert!(cpu.is_locked_up());
        assert_eq!(cpu.step(&mut NoBus, 0), 1);
    }

    #[test]
    fn a_masked_interrupt_wakes_but_is_not_taken() {
        let mut cpu = core();
        steps(&mut cpu, 10);
        cpu.primask = true;
        cpu.sleep();
        steps(&mut cpu, 3);
        assert!(cpu.is_asleep());
        cpu.set_interrupts(1, false);
        steps(&mut cpu, 1);
        assert!(!cpu.is_asleep());
        assert_eq!(cpu.exception(), 0);
    }
}
