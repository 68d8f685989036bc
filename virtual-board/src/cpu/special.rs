//! The special registers (DDI 0403E, B5.2). Without privilege, of most nothing is read, and nothing is written.

use super::Cpu;
use rsemu::cpu::arm::v7m::sys::control::{FPCA, NPRIV, SPSEL};
use rsemu::cpu::arm::v7m::xpsr;

// Numbers of the registers (SYSm).
const MSP: u8 = 8;
const PSP: u8 = 9;
const PRIMASK: u8 = 16;
const BASEPRI: u8 = 17;
const BASEPRI_MAX: u8 = 18;
const FAULTMASK: u8 = 19;
const CONTROL: u8 = 20;

impl Cpu {
    /// MRS.
    pub(super) fn special(&self, register: u8) -> u32 {
        let privileged = self.is_privileged();
        match register {
            // EPSR reads as zero.
            0..=7 => {
                let exception = if register & 1 != 0 { u32::from(self.exception) } else { 0 };
                exception | if register & 4 == 0 { self.apsr } else { 0 }
            }
            CONTROL => self.control,
            MSP if privileged => *self.stack_pointer(false),
            PSP if privileged => *self.stack_pointer(true),
            PRIMASK if privileged => self.primask.into(),
            BASEPRI | BASEPRI_MAX if privileged => self.basepri.into(),
            FAULTMASK if privileged => self.faultmask.into(),
            _ => 0,
        }
    }

    /// MSR. Of the flags' register, the mask says which half.
    pub(super) fn set_special(&mut self, register: u8, mask: u8, value: u32) {
        self.is_to_arbitrate = true;
        let privileged = self.is_privileged();
        match register {
            0..=3 => {
                let flags = if mask & 2 != 0 { xpsr::FLAGS } else { 0 };
                let written = flags | if mask & 1 != 0 { xpsr::GE } else { 0 };
                self.apsr = self.apsr & !written | value & written;
            }
            MSP if privileged => *self.stack_pointer_mut(false) = value & !3,
            PSP if privileged => *self.stack_pointer_mut(true) = value & !3,
            PRIMASK if privileged => self.primask = value & 1 != 0,
            BASEPRI if privileged => self.basepri = self.sys.quantize_priority(value as u8),
            BASEPRI_MAX if privileged => {
                let value = self.sys.quantize_priority(value as u8);
                if value != 0 && (self.basepri == 0 || value < self.basepri) {
                    self.basepri = value;
                }
            }
            FAULTMASK if privileged => self.set_faultmask(value & 1 != 0),
            CONTROL if privileged => {
                let stack = if self.exception == 0 { SPSEL } else { 0 };
                let written = NPRIV | FPCA | stack;
                self.control = self.control & !written | value & written;
                self.select_stack();
            }
            _ => {}
        }
    }

    /// CPS.
    pub(super) fn change_masks(&mut self, enable: bool, primask: bool, faultmask: bool) {
        self.is_to_arbitrate = true;
        if !self.is_privileged() {
            return;
        }
        if primask {
            self.primask = !enable;
        }
        if faultmask {
            self.set_faultmask(!enable);
        }
    }

    fn set_faultmask(&mut self, is_set: bool) {
        if !is_set || self.priority() > -1 {
            self.faultmask = is_set;
        }
    }

    fn stack_pointer(&self, process: bool) -> &u32 {
        if process == self.is_on_process_stack { &self.r[13] } else { &self.other_sp }
    }

    fn stack_pointer_mut(&mut self, process: bool) -> &mut u32 {
        if process == self.is_on_process_stack { &mut self.r[13] } else { &mut self.other_sp }
    }
}
