//! Integer instructions (DDI 0403E, A7.7).

use super::alu::{self, extend, low_bits, shifted};
use super::exception::{Done, Fault};
use super::{Bus, Cpu, Mode};
use rsemu::cpu::arm::v7m::isa::{BitfieldOp, DpOp, HintOp, Insn, MemOffset, MiscOp, Operand, Size};
use rsemu::cpu::arm::v7m::sys::{Access, ccr, exc_return, fsr};
use rsemu::cpu::arm::v7m::xpsr;

/// Cycles to fill the pipeline anew.
const BRANCH: u64 = 2;

/// The program counter's number.
const PC: u8 = 15;

impl Cpu {
    pub(super) fn execute(&mut self, insn: Insn, bus: &mut impl Bus) -> Done {
        match insn {
            Insn::DataProc { op, s, rd, rn, operand } => self.process(op, s, rd, rn, operand),
            Insn::ShiftReg { ty, s, rd, rn, rm } => {
                let carry = self.flag(xpsr::C);
                let (value, carry) = alu::shift(ty, self.reg(rn), self.reg(rm) & 0xff, carry);
                if s && !self.keeps_flags {
                    self.set_nz(value);
                    self.set_flag(xpsr::C, carry);
                }
                self.set_reg(rd, value);
            }
            Insn::Adr { rd, imm, add } => self.set_reg(rd, self.near(imm, add)),
            Insn::MovImm16 { top: false, rd, imm } => self.set_reg(rd, imm.into()),
            Insn::MovImm16 { top: true, rd, imm } => {
                self.set_reg(rd, self.reg(rd) & 0xffff | u32::from(imm) << 16);
            }
            Insn::Misc { op, rd, rm } => {
                let value = self.reg(rm);
                let halves_swapped = value.swap_bytes().rotate_right(16);
                self.set_reg(
                    rd,
                    match op {
                        MiscOp::Clz => value.leading_zeros(),
                        MiscOp::Rbit => value.reverse_bits(),
                        MiscOp::Rev => value.swap_bytes(),
                        MiscOp::Rev16 => halves_swapped,
                        MiscOp::Revsh => halves_swapped as i16 as u32,
                    },
                );
            }
            Insn::Bitfield { op, rd, rn, lsb, width } => self.bitfield(op, rd, rn, lsb, width),

            Insn::Branch { cond, offset } => {
                if cond.is_none_or(|cond| cond.passes(self.apsr)) {
                    self.branch(self.r[15].wrapping_add_signed(offset));
                }
            }
            Insn::BranchLink { offset } => {
                self.r[14] = self.next | 1;
                self.branch(self.r[15].wrapping_add_signed(offset));
            }
            Insn::Bx { rm } => return self.branch_exchange(self.reg(rm), bus),
            Insn::Blx { rm } => {
                let target = self.reg(rm);
                self.r[14] = self.next | 1;
                return self.branch_exchange(target, bus);
            }
            Insn::Cbz { nonzero, rn, offset } => {
                if (self.reg(rn) != 0) == nonzero {
                    self.branch(self.r[15].wrapping_add(offset));
                }
            }
            Insn::TableBranch { rn, rm, half } => {
                let size = if half { 2 } else { 1 };
                let address = self.reg(rn).wrapping_add(self.reg(rm).wrapping_mul(size));
                self.check_alignment(address, size as usize, true)?;
                let count = self.load(bus, address, size as usize)?;
                self.branch(self.r[15].wrapping_add(2 * count));
            }
            Insn::It { cond, mask } => self.it = cond.0 << 4 | mask,

            Insn::LoadStore { load, size, signed, rt, rn, offset, index, add, wback, unpriv } => {
                let (base, offset) = (self.reg(rn), self.offset(offset));
                let moved = moved(base, offset, add);
                let address = if index { moved } else { base };
                self.check_alignment(address, size.bytes() as usize, false)?;
                if unpriv {
                    let access = if load { Access::Read } else { Access::Write };
                    self.check_protection_as(false, address, size.bytes(), access)?;
                }
                let back = wback.then_some((rn, moved));
                if load {
                    return self.load_register(bus, address, size, signed, rt, back);
                }
                self.store(bus, address, size.bytes() as usize, self.reg(rt))?;
                self.write_back(back);
            }
            Insn::LoadLiteral { size, signed, rt, imm, add } => {
                let address = self.near(imm, add);
                self.check_alignment(address, size.bytes() as usize, false)?;
                return self.load_register(bus, address, size, signed, rt, None);
            }
            Insn::LoadStoreDual { load, rt, rt2, rn, imm, index, add, wback } => {
                let base = if rn == PC { self.r[15] & !3 } else { self.reg(rn) };
                let moved = moved(base, imm, add);
                let address = if index { moved } else { base };
                self.check_alignment(address, 4, true)?;
                let second = address.wrapping_add(4);
                if load {
                    let values = [self.load(bus, address, 4)?, self.load(bus, second, 4)?];
                    self.set_reg(rt, values[0]);
                    self.set_reg(rt2, values[1]);
                } else {
                    self.store(bus, address, 4, self.reg(rt))?;
                    self.store(bus, second, 4, self.reg(rt2))?;
                }
                self.write_back(wback.then_some((rn, moved)));
            }
            Insn::LoadStoreExclusive { load, size, rd, rt, rn, imm } => {
                let (address, size) = (self.reg(rn).wrapping_add(imm), size.bytes() as usize);
                self.check_alignment(address, size, true)?;
                if load {
                    let value = self.load(bus, address, size)?;
                    self.exclusive = Some(address);
                    self.set_reg(rt, value);
                } else {
                    let is_marked = self.exclusive == Some(address);
                    if is_marked {
                        self.store(bus, address, size, self.reg(rt))?;
                    }
                    self.exclusive = None;
                    self.set_reg(rd, (!is_marked).into());
                }
            }
            Insn::ClearExclusive => self.exclusive = None,
            Insn::LoadStoreMultiple { load, rn, list, wback, before } => {
                return self.transfer(bus, load, rn, list, wback, before);
            }

            Insn::Mul { rd, rn, rm, ra, sub, s } => {
                let product = self.reg(rn).wrapping_mul(self.reg(rm));
                let value = match ra {
                    None => product,
                    Some(ra) if sub => self.reg(ra).wrapping_sub(product),
                    Some(ra) => self.reg(ra).wrapping_add(product),
                };
                if s && !self.keeps_flags {
                    self.set_nz(value);
                }
                self.set_reg(rd, value);
            }
            Insn::MulLong { signed, accumulate, rdlo, rdhi, rn, rm, umaal } => {
                let (a, b) = (self.reg(rn), self.reg(rm));
                let product = if signed {
                    i64::from(a as i32).wrapping_mul((b as i32).into()) as u64
                } else {
                    u64::from(a) * u64::from(b)
                };
                let [low, high] = [rdlo, rdhi].map(|register| u64::from(self.reg(register)));
                let addend = if umaal {
                    low + high
                } else if accumulate {
                    high << 32 | low
                } else {
                    0
                };
                self.set_pair(rdlo, rdhi, product.wrapping_add(addend));
                self.cycles += 1;
            }
            Insn::Div { signed, rd, rn, rm } => {
                let (a, b) = (self.reg(rn), self.reg(rm));
                self.cycles += 2;
                let quotient = match b {
                    0 if self.sys.ccr & ccr::DIV_0_TRP != 0 => {
                        return Err(Fault::usage(fsr::UF_DIVBYZERO));
                    }
                    0 => 0,
                    _ if signed => (a as i32).wrapping_div(b as i32) as u32,
                    _ => a / b,
                };
                self.set_reg(rd, quotient);
            }

            Insn::HalfMul { .. }
            | Insn::DualMul { .. }
            | Insn::Sat { .. }
            | Insn::SatQ { .. }
            | Insn::Simd { .. }
            | Insn::Sel { .. }
            | Insn::Usad { .. }
            | Insn::Pkh { .. }
            | Insn::Extend { .. } => self.process_signal(insn),

            Insn::Fp(insn) => return self.float(insn, bus),
            // A coprocessor that is there does not know the instruction; the others are not.
            Insn::Coproc { cp: 10 | 11 } if self.can_float() => return Err(Fault::UNDEFINED),
            Insn::Coproc { .. } => return Err(Fault::NO_COPROCESSOR),

            Insn::Mrs { rd, sysm } => self.set_reg(rd, self.special(sysm)),
            Insn::Msr { rn, sysm, mask } => self.set_special(sysm, mask, self.reg(rn)),
            Insn::Cps { enable, i, f } => self.change_masks(enable, i, f),
            Insn::Hint { op: HintOp::Wfi } => self.sleep(),
            Insn::Hint { op: HintOp::Wfe } => {
                if !core::mem::take(&mut self.event) {
                    self.sleep();
                }
            }
            Insn::Hint { op: HintOp::Sev } => self.event = true,
            // Accesses are in order anyway.
            Insn::Hint { .. } | Insn::Barrier { .. } => {}
            Insn::Svc { .. } => self.call_supervisor(bus),
            Insn::Bkpt { .. } => self.hit_breakpoint(bus),
            _ => return Err(Fault::UNDEFINED),
        }
        Ok(())
    }

    // Registers and flags

    pub(super) fn reg(&self, number: u8) -> u32 {
        self.r[usize::from(number & 15)]
    }

    /// Writes a register. The program counter is none of them: instructions that may write it branch.
    pub(super) fn set_reg(&mut self, number: u8, value: u32) {
        if number != PC {
            self.r[usize::from(number & 15)] = value;
        }
    }

    pub(super) fn set_pair(&mut self, low: u8, high: u8, value: u64) {
        self.set_reg(low, value as u32);
        self.set_reg(high, (value >> 32) as u32);
    }

    pub(super) fn flag(&self, flag: u32) -> bool {
        self.apsr & flag != 0
    }

    pub(super) fn set_flag(&mut self, flag: u32, is_set: bool) {
        self.apsr = self.apsr & !flag | if is_set { flag } else { 0 };
    }

    fn set_nz(&mut self, value: u32) {
        self.set_flag(xpsr::N, value >> 31 != 0);
        self.set_flag(xpsr::Z, value == 0);
    }

    /// An address near the program counter, from the word on that it is in.
    fn near(&self, offset: u32, add: bool) -> u32 {
        moved(self.r[15] & !3, offset, add)
    }

    fn offset(&self, offset: MemOffset) -> u32 {
        match offset {
            MemOffset::Imm(value) => value,
            MemOffset::Reg { rm, lsl } => self.reg(rm) << lsl,
        }
    }

    // Branches

    fn branch(&mut self, target: u32) {
        self.next = target & !1;
        self.cycles += BRANCH;
    }

    /// A branch to an address whose lowest bit says that it is Thumb code; in a handler, some are exception returns (BXWritePC).
    fn branch_exchange(&mut self, target: u32, bus: &mut impl Bus) -> Done {
        if self.exception != 0 && exc_return::is_magic(target) {
            return self.leave(target, bus);
        }
        if target & 1 == 0 {
            return Err(Fault::INVALID_STATE);
        }
        self.branch(target);
        Ok(())
    }

    pub(super) fn sleep(&mut self) {
        self.mode = Mode::Asleep;
        // What is pending already wakes it.
        self.is_to_arbitrate = true;
    }

    // Groups of instructions

    fn process(&mut self, op: DpOp, sets_flags: bool, rd: u8, rn: u8, operand: Operand) {
        let carry = self.flag(xpsr::C);
        let (b, shifted_out) = match operand {
            Operand::Imm { value, carry: shifted_out } => (value, shifted_out.unwrap_or(carry)),
            Operand::Reg { rm, shift } => shifted(shift, self.reg(rm), carry),
        };
        let overflow = self.flag(xpsr::V);
        let result = alu::process(op, self.reg(rn), b, carry, shifted_out, overflow);
        if sets_flags && (!self.keeps_flags || op.is_test()) {
            self.set_nz(result.value);
            self.set_flag(xpsr::C, result.carry);
            self.set_flag(xpsr::V, result.overflow);
        }
        if op.is_test() {
        } else if rd == PC {
            self.branch(result.value);
        } else {
            self.set_reg(rd, result.value);
        }
    }

    fn bitfield(&mut self, op: BitfieldOp, rd: u8, rn: u8, lsb: u8, width: u8) {
        let mask = low_bits(width.into());
        let field = self.reg(rn) >> lsb & mask;
        let kept = self.reg(rd) & !(mask << lsb);
        let value = match op {
            BitfieldOp::Ubfx => field,
            BitfieldOp::Sbfx => {
                let above = 32 - u32::from(width);
                ((field << above) as i32 >> above) as u32
            }
            BitfieldOp::Bfi => kept | (self.reg(rn) & mask) << lsb,
            BitfieldOp::Bfc => kept,
        };
        self.set_reg(rd, value);
    }

    fn load_register(
        &mut self,
        bus: &mut impl Bus,
        address: u32,
        size: Size,
        is_signed: bool,
        rt: u8,
        back: Option<(u8, u32)>,
    ) -> Done {
        let value = extend(self.load(bus, address, size.bytes() as usize)?, size, is_signed);
        self.write_back(back);
        if rt == PC {
            return self.branch_exchange(value, bus);
        }
        self.set_reg(rt, value);
        Ok(())
    }

    fn write_back(&mut self, back: Option<(u8, u32)>) {
        if let Some((rn, value)) = back {
            self.set_reg(rn, value);
        }
    }

    /// LDM, STM, PUSH, POP. The base changes before the loads, one of which may load it, but after the stores.
    fn transfer(
        &mut self,
        bus: &mut impl Bus,
        is_load: bool,
        rn: u8,
        list: u16,
        wback: bool,
        before: bool,
    ) -> Done {
        if list == 0 {
            return Err(Fault::UNDEFINED);
        }
        let base = self.reg(rn);
        let moved = moved(base, 4 * list.count_ones(), !before);
        let mut address = if before { moved } else { base };
        self.check_alignment(address, 4, true)?;
        let back = wback.then_some((rn, moved));
        if is_load {
            self.write_back(back);
        }
        let mut target = None;
        for register in (0..16).filter(|register| list & 1 << register != 0) {
            if !is_load {
                self.store(bus, address, 4, self.reg(register))?;
            } else if register == PC {
                target = Some(self.load(bus, address, 4)?);
            } else {
                let value = self.load(bus, address, 4)?;
                self.set_reg(register, value);
            }
            address = address.wrapping_add(4);
        }
        if !is_load {
            self.write_back(back);
        }
        target.map_or(Ok(()), |target| self.branch_exchange(target, bus))
    }
}

/// An address with an offset added, or subtracted.
fn moved(base: u32, offset: u32, add: bool) -> u32 {
    if add { base.wrapping_add(offset) } else { base.wrapping_sub(offset) }
}
