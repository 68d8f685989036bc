//! The core's own registers in memory (DDI 0403E, B3.2 to B3.5 and C1): which are modelled, and which of their bits. `rsemu` ignores
//! accesses to all others.

use super::Cpu;
use crate::chip::{Cause, Refused};
use std::ops::RangeInclusive;

/// Auxiliary control register.
pub(super) const ACTLR: u32 = 0xe000_e008;

/// First and last register, and the bits that a write may change in each.
const MODELLED: [(RangeInclusive<u32>, u32); 25] = [
    (0xe000_1000..=0xe000_1000, 1),           // DWT_CTRL: CYCCNTENA
    (0xe000_1004..=0xe000_1004, !0),          // DWT_CYCCNT
    (0xe000_101c..=0xe000_101c, 0),           // DWT_PCSR
    (ACTLR..=ACTLR, 1 << 1),                  // DISDEFWBUF: there is no write buffer
    (0xe000_e100..=0xe000_e29c, !0),          // NVIC_ISER to NVIC_ICPR
    (0xe000_e300..=0xe000_e31c, 0),           // NVIC_IABR
    (0xe000_e400..=0xe000_e4ec, !0),          // NVIC_IPR
    (0xe000_ed00..=0xe000_ed00, 0),           // CPUID
    (0xe000_ed04..=0xe000_ed04, 0x9800_0000), // ICSR: NMIPENDSET, PENDSVSET, PENDSVCLR
    (0xe000_ed08..=0xe000_ed08, 0xffff_ff80), // VTOR
    (0xe000_ed0c..=0xe000_ed0c, 0xffff_0704), // AIRCR: VECTKEY, PRIGROUP, SYSRESETREQ
    (0xe000_ed10..=0xe000_ed10, 0), // SCR: sleep is the only low-power mode, and ends in what slept
    (0xe000_ed14..=0xe000_ed14, 0x0000_0219), // CCR: NONBASETHRDENA, UNALIGN_TRP, DIV_0_TRP, STKALIGN
    (0xe000_ed18..=0xe000_ed20, !0),          // SHPR
    (0xe000_ed24..=0xe000_ed24, 0x0007_0000), // SHCSR: enables
    (0xe000_ed28..=0xe000_ed2c, !0),          // CFSR, HFSR
    (0xe000_ed34..=0xe000_ed38, !0),          // MMFAR, BFAR
    (0xe000_ed88..=0xe000_ed88, 0x00f0_0000), // CPACR: the floating-point unit
    (0xe000_ed90..=0xe000_edb8, !0),          // the memory protection unit
    (0xe000_edf0..=0xe000_edf0, 0),           // DHCSR: no debugger
    (0xe000_edfc..=0xe000_edfc, 1 << 24),     // DEMCR: TRCENA
    (0xe000_ef00..=0xe000_ef00, !0),          // STIR
    (0xe000_ef34..=0xe000_ef34, 0xc000_0000), // FPCCR: ASPEN, LSPEN
    (0xe000_ef38..=0xe000_ef3c, !0),          // FPCAR, FPDSCR
    (0xe000_ef40..=0xe000_ef48, 0),           // MVFR
];

impl Cpu {
    /// Takes down an access to one of these registers that is not modelled: to another one, or that changes other bits.
    pub(super) fn check_modelled(&mut self, address: u32, changed: u32, written: Option<u32>) {
        let register = address & !3;
        let found = MODELLED.iter().find(|(registers, _)| registers.contains(&register));
        if found.is_none_or(|(_, modelled)| changed & !modelled != 0) {
            let refused = Refused { cause: Cause::Unmodelled, address, written };
            self.refused.get_or_insert(refused);
            self.has_touched = true;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::memory::Memory;

    fn refused(access: impl FnOnce(&mut Cpu)) -> Option<(u32, Option<u32>)> {
        let mut cpu = Cpu::new(&Memory::new());
        access(&mut cpu);
        cpu.refused().map(|refused| (refused.address, refused.written))
    }

    #[test]
    fn what_would_have_no_effect_is_taken_down() {
        for (address, value) in [
            (0xe000_ed10, 1 << 1),  // SCR: SLEEPONEXIT
            (0xe000_ed10, 1 << 2),  // SCR: SLEEPDEEP
            (0xe000_ed10, 1 << 4),  // SCR: SEVONPEND
            (0xe000_ed14, 1 << 8),  // CCR: BFHFNMIGN
            (0xe000_ed24, 1 << 14), // SHCSR: BUSFAULTPENDED
            (0xe000_edfc, 1 << 10), // DEMCR: VC_HARDERR
            (0xe000_e010, 1),       // SYST_CSR: ENABLE
            (0xe000_1000, 1 << 16), // DWT_CTRL: EXCTRCENA
            (0xe000_2000, 1),       // FP_CTRL
            (0xe000_0e80, 1),       // ITM_TCR
        ] {
            let store = |cpu: &mut Cpu| {
                let _ = cpu.store_own(address, 4, value);
            };
            assert_eq!(refused(store), Some((address, Some(value))), "{address:#x}");
        }
        let load = |cpu: &mut Cpu| {
            let _ = cpu.load_own(0xe000_0000, 4);
        };
        assert_eq!(refused(load), Some((0xe000_0000, None)));
    }

    #[test]
    fn what_is_written_back_as_it_was_read_is_not() {
        for (registers, _) in MODELLED {
            let register = *registers.start();
            let rewrite = |cpu: &mut Cpu| {
                let value = cpu.load_own(register, 4).expect("there is one");
                let _ = cpu.store_own(register, 4, value);
            };
            assert_eq!(refused(rewrite), None, "{register:#x}");
        }
    }
}
