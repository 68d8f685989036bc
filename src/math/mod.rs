//! The number that the loop computes in, and the only door to transcendental functions.
//!
//! The loop itself needs no more than [`Scalar`]: additions, products with gains and a table, in a fixed order, so that a PC and a
//! microcontroller compute the same bits, in floating point (`f32`) as in fixed point ([`Q31`]). [`tanh`] is
//! for configuration time; it comes from `libm`, not from micromath, whose approximations are coarser than the tables
//! that are built with it.

mod fixed;
mod float;
pub mod table;

use crate::config::ConfigError;
use core::fmt::Debug;
use core::ops::{Add, Neg, Sub};
pub use fixed::Q31;
use table::Curve;

/// The value of a signal's full scale in fixed point, in the signal's SI unit: what 2³¹ stands for. Positive. Floating point
/// has no full scale and ignores it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Base(pub f32);

impl Base {
    /// Of ratios, within ±1.
    pub const RATIO: Self = Self(2.0);
    /// Of converters' codes.
    pub const CODE: Self = Self(65_536.0);
    /// Of an encoder's counts.
    pub const COUNT: Self = Self(32_768.0);

    /// That of the squares of signals that stay within a sixteenth of it.
    pub fn squared(self) -> Self {
        Self(self.0 * self.0 / 128.0)
    }

    /// One that is 2^`by` times smaller, for a signal that stays so much smaller.
    pub fn finer(self, by: u32) -> Self {
        Self(self.0 / (1_u64 << by) as f32)
    }
}

/// A number that the control loop can be computed in.
///
/// A *signal* is a `Scalar`. In fixed point it counts in 2⁻³¹ of its [`Base`], so that a factor that takes signals to another one
/// carries the ratio of their bases; such factors are types of their own, made once when a drive is built. In floating point
/// signals are in SI units.
pub trait Scalar:
    Copy + Debug + PartialOrd + Add<Output = Self> + Sub<Output = Self> + Neg<Output = Self>
{
    /// Gains of a sum, which in fixed point come to a half at most together: it cannot leave the range.
    type Gains<const N: usize>: Copy + Debug;

    /// Gains of any size, of a sum that fixed point saturates at a quarter of its base.
    type Steep<const N: usize>: Copy + Debug;

    /// A time over which a rate acts.
    type Time: Copy + Debug;

    /// An odd function by a table.
    type Table: Copy + Debug;

    /// The signal 0.
    const ZERO: Self;

    /// A table that was not [filled](Self::tabulate).
    const NO_TABLE: Self::Table;

    /// Whether [`over`](Self::over) takes any time: in fixed point only the one that the bases were chosen for.
    const ANY_TIME: bool;

    /// The signal nearest to a value; fixed point saturates. For configuration and commands, not for the loop.
    fn from_f32(value: f32, base: Base) -> Self;

    /// The value of a signal. For telemetry and commands, not for the loop.
    fn to_f32(self, base: Base) -> f32;

    /// A configured value, which fixed point refuses beyond half its base.
    fn constant(field: &'static str, value: f32, base: Base) -> Result<Self, ConfigError>;

    /// A converter's code, in [`Base::CODE`].
    fn from_code(code: u16) -> Self;

    /// A difference of counts in sixteenths, within ±2²⁰, in [`Base::COUNT`]; fixed point saturates at a half of that.
    fn from_sixteenths(difference: i32) -> Self;

    /// The gains of [`combine`](Self::combine), each with the base of its signal. Fixed point rounds them to 2⁻¹⁶ of their sum or
    /// so, and refuses more than a half in all.
    fn gains<const N: usize>(
        field: &'static str,
        gains: [(f32, Base); N],
        to: Base,
    ) -> Result<Self::Gains<N>, ConfigError>;

    /// Σ gain·signal. Floating point sums in the given order, fixed point rounds once, down.
    fn combine<const N: usize>(gains: &Self::Gains<N>, signals: [Self; N]) -> Self;

    /// The same rounded to the nearest, for what adds up over many periods.
    fn accumulate<const N: usize>(gains: &Self::Gains<N>, signals: [Self; N]) -> Self;

    /// A time (s).
    fn time(seconds: f32) -> Self::Time;

    /// What this rate makes in a time. In fixed point that is 2^−`SHIFT` of it, by the choice of bases.
    fn over<const SHIFT: u32>(self, time: Self::Time) -> Self;

    /// The gains of [`amplify`](Self::amplify), each with the base of its signal. Fixed point refuses 2¹⁴ and more.
    fn steep<const N: usize>(
        field: &'static str,
        gains: [(f32, Base); N],
        to: Base,
    ) -> Result<Self::Steep<N>, ConfigError>;

    /// Σ gain·signal as by [`combine`](Self::combine), but saturating.
    fn amplify<const N: usize>(gains: &Self::Steep<N>, signals: [Self; N]) -> Self;

    /// Fills a table, where it is, with a curve of a signal; its values are in [`Base::RATIO`].
    fn tabulate(
        table: &mut Self::Table,
        field: &'static str,
        curve: &Curve,
        base: Base,
    ) -> Result<(), ConfigError>;

    /// The curve's value at a signal. The time does not depend on the signal.
    fn look_up(table: &Self::Table, signal: Self) -> Self;

    /// Mean of ⌊position − j·step⌋ for j = 0 … 15, in [`Base::COUNT`]: what a counter showed at 16 equal distances back. Both
    /// within ±2¹⁵ over all.
    fn mean_count(position: Self, step: Self) -> Self;

    /// This signal's square, in its base [squared](Base::squared).
    fn square(self) -> Self;

    /// share/256 of a signal. In fixed point within ±2⁻⁸ of its base.
    fn part(self, share: u8) -> Self;

    /// numerator/denominator of a signal; fixed point saturates at a quarter of its base. For comparison: it divides.
    fn fraction(self, numerator: i16, denominator: i16) -> Self;

    /// The headroom for [`ratio`](Self::ratio) of a largest whole; fixed point refuses a base 2¹⁴ times as large.
    fn headroom(field: &'static str, largest: f32, base: Base) -> Result<u32, ConfigError>;

    /// This as a share of `whole`, a positive signal of the same base of which it is not more than `limit`; nor is the share, however
    /// it is rounded. Fixed point resolves 2⁻¹⁵ of 1 and rounds towards 0; `whole` must stay within 2⁻`headroom` of the
    /// base, from 1 to 16.
    fn ratio(self, whole: Self, limit: Self, headroom: u32) -> Self;

    /// This ratio's share of `whole`, of which fixed point expects a quarter of the base at most.
    fn of(self, whole: Self) -> Self;

    /// The same signal in a base that is 2^`by` times as large.
    fn coarser(self, by: u32) -> Self;

    /// Whether this is a number that arithmetic can go on with (neither NaN nor infinite).
    fn is_finite(self) -> bool;

    /// The magnitude.
    fn abs(self) -> Self;

    /// The signal, limited to ±`bound` (`bound` must not be negative).
    fn limited(self, bound: Self) -> Self;
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

/// The exponent of the power of two not below a positive number. For configuration time.
pub fn log2_ceil(x: f32) -> i32 {
    let (mantissa, exponent) = libm::frexpf(x);
    if mantissa == 0.5 { exponent - 1 } else { exponent }
}

/// 2^`exponent`. For configuration time.
pub fn power_of_two(exponent: i32) -> f32 {
    libm::scalbnf(1.0, exponent)
}

/// Σ ⌊position − j·step⌋ for j = 0 … 15, in 16.16 fixed point: exact whatever the step.
#[inline]
fn sum_of_floors(position: i32, step: i32) -> i32 {
    let mut position = position;
    let mut four = || {
        let mut floor = || {
            let floor = position >> 16;
            position = position.wrapping_sub(step);
            floor
        };
        floor().wrapping_add(floor()).wrapping_add(floor()).wrapping_add(floor())
    };
    // Written out: where code is made small no loop is unrolled.
    four().wrapping_add(four()).wrapping_add(four()).wrapping_add(four())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn tanh_is_within_its_stated_error() {
        for step in -2000..=2000 {
            let x = step as f32 / 200.0;
            let error = f64::from(tanh(x)) - f64::from(x).tanh();
            assert!(error.abs() <= 1.2e-7, "tanh({x}) errs by {error}");
        }
    }

    #[test]
    fn powers_of_two() {
        for (x, exponent) in
            [(1.0, 0), (1.001, 1), (0.5, -1), (0.51, 0), (1024.0, 10), (1025.0, 11)]
        {
            assert_eq!(log2_ceil(x), exponent, "{x}");
        }
        assert_eq!([power_of_two(10), power_of_two(-3)], [1024.0, 0.125]);
    }
}
