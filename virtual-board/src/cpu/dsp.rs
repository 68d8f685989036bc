//! Instructions of the DSP extension, saturation and extension (DDI 0403E, A7.7).

use super::Cpu;
use super::alu::shifted;
use rsemu::cpu::arm::v7m::isa::{
    DualMulOp, ExtendOp, HalfMulOp, Insn, SatQOp, SimdMode, SimdShape,
};
use rsemu::cpu::arm::v7m::xpsr;

/// The register number that means no accumulator.
const NONE: u8 = 15;

impl Cpu {
    pub(super) fn process_signal(&mut self, insn: Insn) {
        match insn {
            Insn::HalfMul { op, rd, rn, rm, ra, x, y } => {
                let [n, m] = [self.reg(rn), self.reg(rm)];
                let short = half(n, x) * half(m, y);
                let long = (i64::from(n as i32) * half(m, y)) >> 16;
                match op {
                    HalfMulOp::Smul => self.set_reg(rd, short as u32),
                    HalfMulOp::Smulw => self.set_reg(rd, long as u32),
                    HalfMulOp::Smla => self.accumulate(rd, ra, short),
                    HalfMulOp::Smlaw => self.accumulate(rd, ra, long),
                    HalfMulOp::Smlal => self.accumulate_long(ra, rd, short),
                }
                self.cycles += 1;
            }
            Insn::DualMul { op, rd, rn, rm, ra, x } => self.multiply_dual(op, rd, rn, rm, ra, x),
            Insn::Sat { unsigned, halves, rd, rn, imm, shift } => {
                let value = self.reg(rn);
                let mut saturate = |value: i64| {
                    let bits = u32::from(imm);
                    let range = if unsigned { 0..=(1 << bits) - 1 } else { signed_range(bits) };
                    let saturated = value.clamp(*range.start(), *range.end());
                    self.apsr |= if saturated == value { 0 } else { xpsr::Q };
                    saturated as u32
                };
                let result = if halves {
                    let [low, high] = [false, true].map(|top| saturate(half(value, top)));
                    low & 0xffff | high << 16
                } else {
                    saturate((shifted(shift, value, false).0 as i32).into())
                };
                self.set_reg(rd, result);
            }
            Insn::SatQ { op, rd, rn, rm } => {
                let [n, m] = [rn, rm].map(|register| i64::from(self.reg(register) as i32));
                let result = match op {
                    SatQOp::Qadd => self.saturate(m + n),
                    SatQOp::Qsub => self.saturate(m - n),
                    SatQOp::Qdadd => {
                        let double = self.saturate(2 * n);
                        self.saturate(m + double)
                    }
                    SatQOp::Qdsub => {
                        let double = self.saturate(2 * n);
                        self.saturate(m - double)
                    }
                };
                self.set_reg(rd, result as u32);
            }
            Insn::Simd { mode, shape, rd, rn, rm } => {
                let (value, ge) = parallel(mode, shape, self.reg(rn), self.reg(rm));
                if mode.sets_ge() {
                    self.apsr = self.apsr & !xpsr::GE | ge << 16;
                }
                self.set_reg(rd, value);
            }
            Insn::Sel { rd, rn, rm } => {
                let [n, m] = [self.reg(rn), self.reg(rm)].map(u32::to_le_bytes);
                let ge = self.apsr >> 16;
                let chosen = [0, 1, 2, 3].map(|lane| if ge >> lane & 1 != 0 { n } else { m }[lane]);
                self.set_reg(rd, u32::from_le_bytes(chosen));
            }
            Insn::Usad { rd, rn, rm, ra } => {
                let [n, m] = [self.reg(rn), self.reg(rm)].map(u32::to_le_bytes);
                let differences = n.iter().zip(m).map(|(n, m)| u32::from(n.abs_diff(m)));
                let addend = if ra == NONE { 0 } else { self.reg(ra) };
                self.set_reg(rd, addend.wrapping_add(differences.sum()));
            }
            Insn::Pkh { tb, rd, rn, rm, shift } => {
                let n = self.reg(rn);
                let m = shifted(shift, self.reg(rm), false).0;
                let (high, low) = if tb { (n, m) } else { (m, n) };
                self.set_reg(rd, high & 0xffff_0000 | low & 0xffff);
            }
            Insn::Extend { op, rd, rn, rm, rotate } => {
                let value = self.reg(rm).rotate_right(rotate.into());
                let addend = if rn == NONE { 0 } else { self.reg(rn) };
                let result = match op {
                    ExtendOp::Sxtb => addend.wrapping_add(value as i8 as u32),
                    ExtendOp::Sxth => addend.wrapping_add(value as i16 as u32),
                    ExtendOp::Uxtb => addend.wrapping_add(value & 0xff),
                    ExtendOp::Uxth => addend.wrapping_add(value & 0xffff),
                    ExtendOp::Sxtb16 => {
                        halves(addend, value, |addend, byte| addend + i64::from(byte as i8))
                    }
                    ExtendOp::Uxtb16 => {
                        halves(addend, value, |addend, byte| addend + i64::from(byte as u8))
                    }
                };
                self.set_reg(rd, result);
            }
            _ => {}
        }
    }

    /// A product and an accumulator, which wraps but leaves Q.
    fn accumulate(&mut self, rd: u8, ra: u8, product: i64) {
        let sum = product + i64::from(self.reg(ra) as i32);
        self.note(sum);
        self.set_reg(rd, sum as u32);
    }

    fn accumulate_long(&mut self, low: u8, high: u8, product: i64) {
        let sum = u64::from(self.reg(high)) << 32 | u64::from(self.reg(low));
        self.set_pair(low, high, sum.wrapping_add_signed(product));
    }

    fn multiply_dual(&mut self, op: DualMulOp, rd: u8, rn: u8, rm: u8, ra: u8, x: bool) {
        let [n, m] = [self.reg(rn), self.reg(rm)];
        let low = half(n, false) * half(m, x);
        let high = half(n, true) * half(m, !x);
        // Here the bit says to round.
        let product = i64::from(n as i32) * i64::from(m as i32);
        let half_unit = if x { 0x8000_0000 } else { 0 };
        let most = i64::from(self.reg(ra) as i32) << 32;
        match op {
            DualMulOp::Smuad => {
                self.note(low + high);
                self.set_reg(rd, (low + high) as u32);
            }
            DualMulOp::Smusd => self.set_reg(rd, (low - high) as u32),
            DualMulOp::Smlad => self.accumulate(rd, ra, low + high),
            DualMulOp::Smlsd => self.accumulate(rd, ra, low - high),
            DualMulOp::Smmul => self.set_reg(rd, (product.wrapping_add(half_unit) >> 32) as u32),
            DualMulOp::Smmla => {
                let sum = most.wrapping_add(product).wrapping_add(half_unit);
                self.set_reg(rd, (sum >> 32) as u32);
            }
            DualMulOp::Smmls => {
                let difference = most.wrapping_sub(product).wrapping_add(half_unit);
                self.set_reg(rd, (difference >> 32) as u32);
            }
            DualMulOp::Smlald => self.accumulate_long(ra, rd, low + high),
            DualMulOp::Smlsld => self.accumulate_long(ra, rd, low - high),
        }
        self.cycles += 1;
    }

    /// A value saturated to a word; Q tells if it was.
    fn saturate(&mut self, value: i64) -> i64 {
        self.note(value);
        value.clamp(i32::MIN.into(), i32::MAX.into())
    }

    /// Sets Q if a value is none of a signed word.
    fn note(&mut self, value: i64) {
        if i32::try_from(value).is_err() {
            self.apsr |= xpsr::Q;
        }
    }
}

/// A half, signed.
fn half(value: u32, top: bool) -> i64 {
    (if top { value >> 16 } else { value } as i16).into()
}

/// What signed numbers of so many bits reach.
fn signed_range(bits: u32) -> std::ops::RangeInclusive<i64> {
    let end = 1_i64 << (bits - 1);
    -end..=end - 1
}

/// Halves of one, each with the lower byte of the other's half.
fn halves(addend: u32, value: u32, act: impl Fn(i64, u32) -> i64) -> u32 {
    let [low, high] =
        [0, 16].map(|shift| act((addend >> shift & 0xffff).into(), value >> shift) as u32);
    low & 0xffff | high << 16
}

/// Sums or differences of lanes, and their bits of GE.
fn parallel(mode: SimdMode, shape: SimdShape, n: u32, m: u32) -> (u32, u32) {
    let bits = if matches!(shape, SimdShape::Add8 | SimdShape::Sub8) { 8 } else { 16 };
    let lane = |value: u32, place: u32| {
        let lane = i64::from(value >> place) & ((1 << bits) - 1);
        let sign = 1 << (bits - 1);
        if mode.is_unsigned() { lane } else { (lane ^ sign) - sign }
    };
    let exchanges = matches!(shape, SimdShape::Asx | SimdShape::Sax);
    let (mut value, mut ge) = (0, 0);
    for place in (0..32).step_by(bits as usize) {
        let is_difference = match shape {
            SimdShape::Add8 | SimdShape::Add16 => false,
            SimdShape::Sub8 | SimdShape::Sub16 => true,
            SimdShape::Asx => place == 0,
            SimdShape::Sax => place != 0,
        };
        let (a, b) = (lane(n, place), lane(m, if exchanges { 16 - place } else { place }));
        let result = if is_difference { a - b } else { a + b };
        let end = 1 << bits;
        let is_ge = if mode.is_unsigned() && !is_difference { result >= end } else { result >= 0 };
        let result = match mode {
            SimdMode::Signed | SimdMode::Unsigned => result,
            SimdMode::SignedHalve | SimdMode::UnsignedHalve => result >> 1,
            SimdMode::SignedSat => result.clamp(-end / 2, end / 2 - 1),
            SimdMode::UnsignedSat => result.clamp(0, end - 1),
        };
        value |= (result & (end - 1)) as u32 * (1 << place);
        // A bit for each byte.
        ge |= if is_ge { ((1 << (bits / 8)) - 1) << (place / 8) } else { 0 };
    }
    (value, ge)
}
