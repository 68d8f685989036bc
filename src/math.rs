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

    /// The gain nearest to `value`. For configuration, not for the loop.
    fn gain(value: f32) -> Self::Gain;

    /// Σ gain·signal, summed in the given order. A scalar with a wide accumulator rounds once, at the end.
    fn combine<const N: usize>(terms: [(Self::Gain, Self); N]) -> Self;

    /// Splits a position on a table into the segment it lies in and the distance from that segment's start.
    ///
    /// Positions below 0 belong to segment 0, positions beyond `last` to segment `last`.
    fn segment(self, last: usize) -> (usize, Self);

    /// Whether this is a number that arithmetic can go on with (neither NaN nor infinite).
    fn is_finite(self) -> bool;

    /// The magnitude.
    fn abs(self) -> Self {
        if self < Self::ZERO { -self } else { self }
    }

    /// The signal, limited to ±`bound` (`bound` must not be negative).
    fn limited(self, bound: Self) -> Self {
        if self > bound {
            bound
        } else if self < -bound {
            -bound
        } else {
            self
        }
    }
}

impl Scalar for f32 {
    type Gain = f32;

    const ZERO: Self = 0.0;
    const ONE: Self = 1.0;

    fn from_f32(value: f32) -> Self {
        value
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

    #[inline]
    fn segment(self, last: usize) -> (usize, f32) {
        let whole = (self as u32).min(last as u32);
        (whole as usize, self - whole as f32)
    }

    fn is_finite(self) -> bool {
        f32::is_finite(self)
    }

    #[inline]
    fn abs(self) -> f32 {
        f32::abs(self)
    }
}

/// Hyperbolic tangent, to within 1.2e-7. For configuration time.
pub fn tanh(x: f32) -> f32 {
    libm::tanhf(x)
}

/// e^x − 1, accurate near zero too. For configuration time.
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
        assert_eq!(2.75.segment(8), (2, 0.75));
        assert_eq!((-3.0).segment(8), (0, -3.0));
        assert_eq!(9.5.segment(8), (8, 1.5));
        assert_eq!(1e30.segment(8).0, 8);
    }

    #[test]
    fn limited_keeps_the_inside_and_saturates_outside() {
        assert_eq!(0.5.limited(1.0), 0.5);
        assert_eq!(2.0.limited(1.0), 1.0);
        assert_eq!((-2.0).limited(1.0), -1.0);
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
