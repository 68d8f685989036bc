//! Arithmetic on the operands of integer instructions (DDI 0403E, A2.2 and A7.4.2).

use rsemu::cpu::arm::v7m::isa::{DpOp, Shift, ShiftType, Size};

/// A result, with the flags C and V.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Sum {
    pub value: u32,
    pub carry: bool,
    pub overflow: bool,
}

/// `a + b + carry` (AddWithCarry). To subtract is to add the complement with carry.
pub(super) fn add(a: u32, b: u32, carry: bool) -> Sum {
    let (sum, first) = a.overflowing_add(b);
    let (value, second) = sum.overflowing_add(carry.into());
    Sum { value, carry: first || second, overflow: (a ^ value) & (b ^ value) >> 31 << 31 != 0 }
}

/// A value shifted, and the last bit that went out (Shift_C).
pub(super) fn shift(kind: ShiftType, value: u32, amount: u32, carry: bool) -> (u32, bool) {
    let wide = u64::from(value);
    match (kind, amount) {
        (ShiftType::Rrx, _) => (u32::from(carry) << 31 | value >> 1, value & 1 != 0),
        (_, 0) => (value, carry),
        (ShiftType::Lsl, 1..=32) => ((wide << amount) as u32, wide << amount >> 32 & 1 != 0),
        (ShiftType::Lsr, 1..=32) => ((wide >> amount) as u32, wide >> (amount - 1) & 1 != 0),
        (ShiftType::Lsl | ShiftType::Lsr, _) => (0, false),
        (ShiftType::Asr, _) => {
            let wide = i64::from(value as i32);
            let amount = amount.min(32);
            ((wide >> amount) as u32, wide >> (amount - 1) & 1 != 0)
        }
        (ShiftType::Ror, _) => {
            let value = value.rotate_right(amount % 32);
            (value, value >> 31 != 0)
        }
    }
}

/// An operand shifted by a constant.
pub(super) fn shifted(by: Shift, value: u32, carry: bool) -> (u32, bool) {
    shift(by.ty, value, by.amount.into(), carry)
}

/// What a data-processing instruction computes. `carry` is the flag, `shifted_out` what the operand's shift leaves of it, `overflow` the flag.
pub(super) fn process(
    operation: DpOp,
    a: u32,
    b: u32,
    carry: bool,
    shifted_out: bool,
    overflow: bool,
) -> Sum {
    let logical = |value| Sum { value, carry: shifted_out, overflow };
    match operation {
        DpOp::And | DpOp::Tst => logical(a & b),
        DpOp::Bic => logical(a & !b),
        DpOp::Orr => logical(a | b),
        DpOp::Orn => logical(a | !b),
        DpOp::Eor | DpOp::Teq => logical(a ^ b),
        DpOp::Mov => logical(b),
        DpOp::Mvn => logical(!b),
        DpOp::Add | DpOp::Cmn => add(a, b, false),
        DpOp::Adc => add(a, b, carry),
        DpOp::Sub | DpOp::Cmp => add(a, !b, true),
        DpOp::Sbc => add(a, !b, carry),
        DpOp::Rsb => add(!a, b, true),
    }
}

/// A loaded value, extended to a word.
pub(super) fn extend(value: u32, size: Size, is_signed: bool) -> u32 {
    match (size, is_signed) {
        (Size::Byte, true) => value as i8 as u32,
        (Size::Half, true) => value as i16 as u32,
        _ => value,
    }
}

/// A mask of so many of the lowest bits.
pub(super) fn low_bits(count: u32) -> u32 {
    u32::MAX.checked_shr(32 - count).unwrap_or(0)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn sums_carry_and_overflow() {
        let sum = |value, carry, overflow| Sum { value, carry, overflow };
        assert_eq!(add(0x7fff_ffff, 0, true), sum(0x8000_0000, false, true));
        assert_eq!(add(0xffff_ffff, 0, true), sum(0, true, false));
        assert_eq!(add(0x8000_0000, 0x8000_0000, false), sum(0, true, true));
        // 5 - 5: no borrow is carry.
        assert_eq!(add(5, !5, true), sum(0, true, false));
        assert_eq!(add(4, !5, true), sum(u32::MAX, false, false));
        assert_eq!(add(0x8000_0000, !1, true), sum(0x7fff_ffff, true, true));
    }

    #[test]
    fn shifts_of_32_and_more_have_their_own_carry() {
        let value = 0x8000_0001;
        assert_eq!(shift(ShiftType::Lsl, value, 32, false), (0, true));
        assert_eq!(shift(ShiftType::Lsl, value, 33, true), (0, false));
        assert_eq!(shift(ShiftType::Lsl, value, 1, false), (2, true));
        assert_eq!(shift(ShiftType::Lsr, value, 32, false), (0, true));
        assert_eq!(shift(ShiftType::Lsr, value, 255, true), (0, false));
        assert_eq!(shift(ShiftType::Asr, value, 200, false), (u32::MAX, true));
        assert_eq!(shift(ShiftType::Ror, value, 32, false), (value, true));
        assert_eq!(shift(ShiftType::Ror, value, 33, false), (0xc000_0000, true));
        assert_eq!(shift(ShiftType::Rrx, value, 1, false), (0x4000_0000, true));
        assert_eq!(shift(ShiftType::Lsr, value, 0, true), (value, true));
    }
}
