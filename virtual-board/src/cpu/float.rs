//! Floating-point instructions of FPv4-SP (DDI 0403E, A7.7). Their arithmetic, with NaNs, roundings and flags, is `rsemu`'s.

use super::exception::{Done, Fault};
use super::{Bus, Cpu};
use rsemu::cpu::arm::v7m::fp::{self, fpscr};
use rsemu::cpu::arm::v7m::fpisa::{DataOp, FpInsn, UnaryOp};
use rsemu::cpu::arm::v7m::xpsr;
use rsemu::float::{Env, Flags, Round};

/// Cycles beside the first (Cortex-M4 TRM).
const DIVIDE: u64 = 13;
const ACCUMULATE: u64 = 2;

/// Numbers of the system registers.
const FPSCR: u8 = 1;
const MVFR: [u8; 3] = [7, 6, 5];

impl Cpu {
    pub(super) fn float(&mut self, insn: FpInsn, bus: &mut impl Bus) -> Done {
        if insn.needs_v5() && self.can_float() {
            return Err(Fault::UNDEFINED);
        }
        self.claim_float(bus)?;
        let env = self.fpu.env();
        match insn {
            FpInsn::Data { op, d, n, m } => {
                let [a, n, m] = [d, n, m].map(|register| self.fpu.s(register));
                let (value, flags) = compute(op, a, n, m, env).ok_or(Fault::UNDEFINED)?;
                self.fpu.finish(d, value, flags);
                self.cycles += match op {
                    DataOp::Div => DIVIDE,
                    DataOp::Add | DataOp::Sub | DataOp::Mul | DataOp::Nmul => 0,
                    _ => ACCUMULATE,
                };
            }
            FpInsn::Unary { op, d, m } => {
                let value = self.fpu.s(m);
                let (value, flags) = match op {
                    UnaryOp::Mov => (value, Flags::NONE),
                    UnaryOp::Abs => (fp::abs(value), Flags::NONE),
                    UnaryOp::Neg => (fp::neg(value), Flags::NONE),
                    UnaryOp::Sqrt => {
                        self.cycles += DIVIDE;
                        fp::sqrt(value, env)
                    }
                    UnaryOp::RintR | UnaryOp::RintX | UnaryOp::RintZ => {
                        return Err(Fault::UNDEFINED);
                    }
                };
                self.fpu.finish(d, value, flags);
            }
            FpInsn::MovImm { d, imm } => self.fpu.set_s(d, imm),
            FpInsn::Cmp { d, m, with_zero, signal_all } => {
                let b = if with_zero { 0 } else { self.fpu.s(m) };
                let (order, flags) = fp::compare(self.fpu.s(d), b, signal_all, env);
                self.fpu.fpscr = self.fpu.fpscr & !fpscr::FLAGS | order;
                fp::accumulate(&mut self.fpu.fpscr, flags);
            }
            FpInsn::CvtInt { d, m, to_int, signed, round_zero } => {
                let value = self.fpu.s(m);
                let (value, flags) = if to_int {
                    let env = if round_zero { env.round(Round::TowardZero) } else { env };
                    fp::to_fixed(value, 32, !signed, 0, env)
                } else {
                    fp::from_fixed(value, 32, !signed, 0, env)
                };
                self.fpu.finish(d, value, flags);
            }
            FpInsn::CvtFixed { d, to_fixed, unsigned, wide, frac } => {
                let (value, bits) = (self.fpu.s(d), if wide { 32 } else { 16 });
                let (value, flags) = if to_fixed {
                    let env = env.round(Round::TowardZero);
                    let (value, flags) = fp::to_fixed(value, bits, unsigned, frac.into(), env);
                    (value, flags)
                } else {
                    fp::from_fixed(value, bits, unsigned, frac.into(), env)
                };
                self.fpu.finish(d, value, flags);
            }
            FpInsn::CvtHalf { d, m, to_half, top } => {
                let (value, shift) = (self.fpu.s(m), if top { 16 } else { 0 });
                let (value, flags) = if to_half {
                    let (half, flags) = fp::single_to_half(value, env);
                    let kept = self.fpu.s(d) & !(0xffff << shift);
                    (kept | u32::from(half) << shift, flags)
                } else {
                    fp::half_to_single((value >> shift) as u16, env)
                };
                self.fpu.finish(d, value, flags);
            }
            FpInsn::MovCore { to_fp: true, rt, n } => self.fpu.set_s(n, self.reg(rt)),
            FpInsn::MovCore { to_fp: false, rt, n } => self.set_reg(rt, self.fpu.s(n)),
            FpInsn::MovCore2 { to_fp, rt, rt2, m, .. } => {
                for (core, float) in [(rt, m), (rt2, m.wrapping_add(1))] {
                    if to_fp {
                        self.fpu.set_s(float, self.reg(core));
                    } else {
                        self.set_reg(core, self.fpu.s(float));
                    }
                }
                self.cycles += 1;
            }
            FpInsn::Sys { to_core, rt, reg } => return self.move_system(to_core, rt, reg),
            FpInsn::Mem { load, d, rn, imm, add, double } => {
                let base = if rn == 15 { self.r[15] & !3 } else { self.reg(rn) };
                let address = if add { base.wrapping_add(imm) } else { base.wrapping_sub(imm) };
                let count = if double { 2 } else { 1 };
                return self.transfer_float(bus, load, address, d, count);
            }
            FpInsn::Multi { load, d, rn, count, add, writeback, .. } => {
                let (base, size) = (self.reg(rn), 4 * u32::from(count));
                let moved = if add { base.wrapping_add(size) } else { base.wrapping_sub(size) };
                self.transfer_float(bus, load, if add { base } else { moved }, d, count)?;
                if writeback {
                    self.set_reg(rn, moved);
                }
            }
            FpInsn::CvtMode { .. } | FpInsn::RintMode { .. } | FpInsn::Sel { .. } => {
                return Err(Fault::UNDEFINED);
            }
        }
        Ok(())
    }

    /// VLDR, VSTR, VLDM, VSTM: registers that follow each other.
    fn transfer_float(
        &mut self,
        bus: &mut impl Bus,
        is_load: bool,
        address: u32,
        first: u8,
        count: u8,
    ) -> Done {
        self.check_alignment(address, 4, true)?;
        for index in 0..count {
            let register = first.wrapping_add(index);
            let address = address.wrapping_add(4 * u32::from(index));
            if is_load {
                let value = self.load(bus, address, 4)?;
                self.fpu.set_s(register, value);
            } else {
                self.store(bus, address, 4, self.fpu.s(register))?;
            }
        }
        Ok(())
    }

    /// VMRS and VMSR.
    fn move_system(&mut self, to_core: bool, rt: u8, register: u8) -> Done {
        match (to_core, register) {
            (false, FPSCR) => self.fpu.fpscr = self.reg(rt) & fpscr::WRITABLE,
            (true, FPSCR) if rt == 15 => {
                let order = self.fpu.fpscr & fpscr::FLAGS;
                self.apsr = self.apsr & (xpsr::Q | xpsr::GE) | order;
            }
            (true, FPSCR) => self.set_reg(rt, self.fpu.fpscr),
            (true, _) => {
                let index = MVFR.iter().position(|number| *number == register);
                let index = index.ok_or(Fault::UNDEFINED)?;
                self.set_reg(rt, self.sys.mvfr[index]);
            }
            (false, _) => return Err(Fault::UNDEFINED),
        }
        Ok(())
    }
}

/// An operation with two operands and, if it accumulates, a third, `a`; nothing if FPv4-SP does not have it. What is chained rounds twice,
/// what is fused once.
fn compute(op: DataOp, a: u32, n: u32, m: u32, env: Env) -> Option<(u32, Flags)> {
    let neg = fp::neg;
    let chained = |a: u32, negates: bool| {
        let (product, first) = fp::mul(n, m, env);
        let (sum, second) = fp::add(a, if negates { neg(product) } else { product }, env);
        (sum, first | second)
    };
    Some(match op {
        DataOp::Add => fp::add(n, m, env),
        DataOp::Sub => fp::sub(n, m, env),
        DataOp::Mul => fp::mul(n, m, env),
        DataOp::Nmul => {
            let (product, flags) = fp::mul(n, m, env);
            (neg(product), flags)
        }
        DataOp::Div => fp::div(n, m, env),
        DataOp::Mla => chained(a, false),
        DataOp::Mls => chained(a, true),
        DataOp::Nmla => chained(neg(a), true),
        DataOp::Nmls => chained(neg(a), false),
        DataOp::Fma => fp::mul_add(a, n, m, env),
        DataOp::Fms => fp::mul_add(a, neg(n), m, env),
        DataOp::Fnma => fp::mul_add(neg(a), neg(n), m, env),
        DataOp::Fnms => fp::mul_add(neg(a), n, m, env),
        DataOp::Maxnm | DataOp::Minnm => return None,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Numbers of all magnitudes, subnormal ones and infinities among them.
    fn numbers() -> impl Iterator<Item = f32> {
        (0..2000_u32).map(|index| f32::from_bits(index.wrapping_mul(0x9e37_79b9) ^ index >> 3))
    }

    #[test]
    fn arithmetic_is_that_of_ieee_754() {
        let numbers: Vec<f32> = numbers().filter(|number| !number.is_nan()).collect();
        let check = |op, [a, n, m]: [f32; 3], expected: f32| {
            let (value, _) =
                compute(op, a.to_bits(), n.to_bits(), m.to_bits(), Env::ARM).expect("an operation");
            if expected.is_nan() {
                assert_eq!(value, 0x7fc0_0000, "{op:?} {a} {n} {m}");
            } else {
                assert_eq!(value, expected.to_bits(), "{op:?} {a} {n} {m}");
            }
        };
        for operands in numbers.windows(3) {
            let [a, n, m] = [operands[0], operands[1], operands[2]];
            check(DataOp::Add, [a, n, m], n + m);
            check(DataOp::Sub, [a, n, m], n - m);
            check(DataOp::Mul, [a, n, m], n * m);
            check(DataOp::Nmul, [a, n, m], -(n * m));
            check(DataOp::Div, [a, n, m], n / m);
            let is_number = !(n * m).is_nan();
            if is_number {
                check(DataOp::Mla, [a, n, m], a + n * m);
                check(DataOp::Mls, [a, n, m], a - n * m);
                check(DataOp::Nmla, [a, n, m], -a - n * m);
                check(DataOp::Nmls, [a, n, m], -a + n * m);
                check(DataOp::Fma, [a, n, m], n.mul_add(m, a));
                check(DataOp::Fms, [a, n, m], (-n).mul_add(m, a));
                check(DataOp::Fnma, [a, n, m], (-n).mul_add(m, -a));
                check(DataOp::Fnms, [a, n, m], n.mul_add(m, -a));
            }
            let (root, _) = fp::sqrt(n.abs().to_bits(), Env::ARM);
            assert_eq!(root, n.abs().sqrt().to_bits());
        }
        // Chained and fused differ: (1 + 2^-12)^2 - (1 + 2^-11).
        let n = (1.0 + 2.0_f32.powi(-12)).to_bits();
        let a = (-1.0 - 2.0_f32.powi(-11)).to_bits();
        assert_eq!(compute(DataOp::Mla, a, n, n, Env::ARM).map(|(value, _)| value), Some(0));
        let fused = compute(DataOp::Fma, a, n, n, Env::ARM).map(|(value, _)| value);
        assert_eq!(fused, Some(2.0_f32.powi(-24).to_bits()));
    }

    #[test]
    fn conversions_saturate_and_make_zero_of_what_is_no_number() {
        let env = Env::ARM.round(Round::TowardZero);
        let edges =
            [2.147_483_6e9, -2.147_483_6e9, 4.294_967_3e9, 3e9, 1.999, -0.5, -7.9, f32::NAN];
        for value in numbers().chain(edges) {
            let [signed, unsigned] =
                [false, true].map(|unsigned| fp::to_fixed(value.to_bits(), 32, unsigned, 0, env).0);
            assert_eq!((signed as i32, unsigned), (value as i32, value as u32), "{value}");
        }
        for value in (0..2000_u32).map(|index| index.wrapping_mul(0x9e37_79b9)) {
            assert_eq!(fp::from_fixed(value, 32, true, 0, Env::ARM).0, (value as f32).to_bits());
            let signed = value as i32 as f32;
            assert_eq!(fp::from_fixed(value, 32, false, 0, Env::ARM).0, signed.to_bits());
        }
    }

    #[test]
    fn what_is_no_number_stays_what_it_was_but_quiet() {
        let one = 1.0_f32.to_bits();
        let (quiet, signalling) = (0xffc1_2345, 0x7f81_2345);
        let add = |n, m| compute(DataOp::Add, 0, n, m, Env::ARM);
        assert_eq!(add(one, quiet), Some((quiet, Flags::NONE)));
        // A signalling one goes before a quiet one, and is noted.
        assert_eq!(add(quiet, signalling), Some((signalling | 1 << 22, Flags::INVALID)));
        let (infinity, zero) = (f32::INFINITY.to_bits(), 0);
        let product = compute(DataOp::Mul, 0, infinity, zero, Env::ARM);
        assert_eq!(product, Some((0x7fc0_0000, Flags::INVALID)));
        let (order, _) = fp::compare(one, quiet, false, Env::ARM);
        assert_eq!(order, fpscr::C | fpscr::V);
    }
}
