//! The number that the loop computes in, and the only door to transcendental functions.
//!
//! The loop itself needs no more than [`Scalar`]: plain additions and products in a fixed order, so that a PC and a
//! Cortex-M4F compute the same bits. [`tanh`] is for configuration time; it comes from `libm`, not from micromath,
//! whose approximations are coarser than the tables that are built with it.

use core::fmt::Debug;
use core::ops::{Add, Div, Mul, Neg, Sub};

/// A number that the control loop can be computed in.
///
/// A *signal* is a `Scalar`. A factor that takes a signal in one unit to a signal in another is a [`Gain`](Self::Gain),
/// a type of its own: in per-unit fixed point signals stay within ±1 while gains span decades and carry the
/// ratio of two base values and an exponent. In floating point both are the same and all bases are 1 (SI).
pub trait Scalar:
    Copy
    + Debug
    + PartialOrd
    + Add<Output = Self>
    + Sub<Output = Self>
    + Mul<Output = Self>
    + Div<Output = Self>
    + Neg<Output = Self>
{
    /// A precomputed factor between signals.
    type Gain: Copy + Debug;

    /// The signal 0.
    const ZERO: Self;
    /// The signal 1.
    const ONE: Self;

    /// The signal nearest to `value`. For configuration, not for the loop.
    fn from_f32(value: f32) -> Self;

    /// The number nearest to this. For new commands, not for the loop.
    fn to_f32(self) -> f32;

    /// A converter's code.
    fn from_code(code: u16) -> Self;

    /// A difference of counts.
    fn from_difference(difference: i16) -> Self;

    /// The gain nearest to `value`. For configuration, not for the loop.
    fn gain(value: f32) -> Self::Gain;

    /// Σ gain·signal, summed in the given order. A scalar with a wide accumulator rounds once, at the end.
    fn combine<const N: usize>(terms: [(Self::Gain, Self); N]) -> Self;

    /// Width of a segment of a table, in units of the position on it.
    const SEGMENT: f32;

    /// Index, from 0 to 31, of a table's segment in which this position lies. Positions below 0 belong to the first,
    /// positions beyond the table to the last.
    fn segment(self) -> usize;

    /// Whether this is a number that arithmetic can go on with (neither NaN nor infinite).
    fn is_finite(self) -> bool;

    /// The magnitude.
    fn abs(self) -> Self;

    /// The magnitude of this with the sign of `other`.
    fn with_sign_of(self, other: Self) -> Self;

    /// The signal, limited to ±`bound` (`bound` must not be negative).
    fn limited(self, bound: Self) -> Self;
}

impl Scalar for f32 {
    type Gain = f32;

    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    fn from_f32(value: f32) -> Self {
        value
    }

    fn to_f32(self) -> f32 {
        self
    }

    #[inline]
    fn from_code(code: u16) -> f32 {
        f32::from(code)
    }

    #[inline]
    fn from_difference(difference: i16) -> f32 {
        f32::from(difference)
    }

    fn gain(value: f32) -> f32 {
        value
    }

    #[inline]
    fn combine<const N: usize>(terms: [(f32, f32); N]) -> f32 {
        match terms.split_first() {
            Some((&(gain, signal), rest)) => {
                (rest.iter()).fold(gain * signal, |sum, &(gain, signal)| sum + gain * signal)
            }
            None => 0.0,
        }
    }

    /// 32 segments fill what a `u32` holds, to which conversion saturates.
    const SEGMENT: f32 = (1 << 27) as f32;

    #[inline]
    fn segment(self) -> usize {
        (self as u32 >> 27) as usize
    }

    fn is_finite(self) -> bool {
        f32::is_finite(self)
    }

    #[inline]
    fn abs(self) -> f32 {
        f32::abs(self)
    }

    #[inline]
    fn with_sign_of(self, other: f32) -> f32 {
        self.copysign(other)
    }

    /// Magnitudes compare as their bits do, without a branch. A NaN becomes the bound.
    #[inline]
    fn limited(self, bound: f32) -> f32 {
        f32::from_bits(self.abs().to_bits().min(bound.to_bits())).copysign(self)
    }
}

/// Hyperbolic tangent, to within 1.2e-7. For configuration time.
#[inline(never)]
pub fn tanh(x: f32) -> f32 {
    libm::tanhf(x)
}

/// Inverse hyperbolic tangent. For configuration time and a change of controllers.
pub fn atanh(x: f32) -> f32 {
    libm::atanhf(x)
}

/// Square root. For configuration time and new commands.
pub fn sqrt(x: f32) -> f32 {
    libm::sqrtf(x)
}

/// The integer not below. For configuration time and new commands.
pub fn ceil(x: f32) -> f32 {
    libm::ceilf(x)
}

/// e^x − 1, accurate near zero too. For configuration time.
#[inline(never)]
pub fn exp_m1(x: f32) -> f32 {
    libm::expm1f(x)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn combine_sums_in_the_given_order() {
        // 1e8 + 1 is not representable: the order decides, and it must be left to right.
        assert_eq!(f32::combine([(1.0, 1e8), (1.0, 1.0), (-1.0, 1e8)]), 0.0);
        assert_eq!(f32::combine([(1.0, 1e8), (-1.0, 1e8), (1.0, 1.0)]), 1.0);
        assert_eq!(f32::combine::<0>([]), 0.0);
    }

    #[test]
    fn segment_saturates_at_both_ends() {
        assert_eq!((2.75 * f32::SEGMENT).segment(), 2);
        assert_eq!((-3.0 * f32::SEGMENT).segment(), 0);
        assert_eq!((31.5 * f32::SEGMENT).segment(), 31);
        assert_eq!(1e30.segment(), 31);
    }

    #[test]
    fn limited_keeps_the_inside_and_saturates_outside() {
        for (value, limited) in
            [(0.5, 0.5), (-0.5, -0.5), (2.0, 1.0), (-2.0, -1.0), (f32::NEG_INFINITY, -1.0)]
        {
            assert_eq!(value.limited(1.0), limited);
        }
        assert_eq!((-2.0).limited(0.0), 0.0);
        assert_eq!(f32::NAN.limited(1.0).abs(), 1.0);
    }

    #[test]
    fn tanh_is_within_its_stated_error() {
        for step in -2000..=2000 {
            let x = step as f32 / 200.0;
            let error = f64::from(tanh(x)) - f64::from(x).tanh();
            assert!(error.abs() <= 1.2e-7, "tanh({x}) errs by {error}");
        }
    }
}
