//! Floating point: signals in SI units, for cores with an FPU.

use super::table::{Curve, Graded, SEGMENTS};
use super::{Base, Scalar, sum_of_floors};
use crate::config::ConfigError;

/// A graded table, with its quadratics in the position itself: the function is so smooth that nothing is lost by that.
#[derive(Clone, Copy, Debug)]
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub struct Table {
    per_unit: f32,
    origin: f32,
    constant: [f32; SEGMENTS],
    linear: [f32; SEGMENTS],
    quadratic: [f32; SEGMENTS],
}

/// Width of a segment, in units of the position: 32 of them fill what a `u32` holds, to which conversion saturates.
const SEGMENT: f32 = (1 << 27) as f32;

/// Index of the segment of a position. Positions below 0 belong to the first, positions beyond the table to the last.
#[inline]
fn segment(position: f32) -> usize {
    (position as u32 >> 27) as usize
}

impl Scalar for f32 {
    type Gains<const N: usize> = [f32; N];
    type Steep<const N: usize> = [f32; N];
    type Time = f32;
    type Table = Table;

    const ZERO: Self = 0.0;
    const NO_TABLE: Table = Table {
        per_unit: 0.0,
        origin: 0.0,
        constant: [0.0; SEGMENTS],
        linear: [0.0; SEGMENTS],
        quadratic: [0.0; SEGMENTS],
    };
    const ANY_TIME: bool = true;

    fn from_f32(value: f32, _base: Base) -> Self {
        value
    }

    fn to_f32(self, _base: Base) -> f32 {
        self
    }

    fn constant(_field: &'static str, value: f32, _base: Base) -> Result<Self, ConfigError> {
        Ok(value)
    }

    #[inline]
    fn from_code(code: u16) -> f32 {
        f32::from(code)
    }

    #[inline]
    fn from_sixteenths(difference: i32) -> f32 {
        difference as f32 * (1.0 / 16.0)
    }

    fn gains<const N: usize>(
        _field: &'static str,
        gains: [(f32, Base); N],
        _to: Base,
    ) -> Result<[f32; N], ConfigError> {
        Ok(gains.map(|(gain, _)| gain))
    }

    #[inline]
    fn combine<const N: usize>(gains: &[f32; N], signals: [f32; N]) -> f32 {
        let mut sum = gains[0] * signals[0];
        for place in 1..N {
            sum += gains[place] * signals[place];
        }
        sum
    }

    #[inline]
    fn accumulate<const N: usize>(gains: &[f32; N], signals: [f32; N]) -> f32 {
        Self::combine(gains, signals)
    }

    fn time(seconds: f32) -> f32 {
        seconds
    }

    #[inline]
    fn over<const SHIFT: u32>(self, time: f32) -> f32 {
        self * time
    }

    fn steep<const N: usize>(
        field: &'static str,
        gains: [(f32, Base); N],
        to: Base,
    ) -> Result<[f32; N], ConfigError> {
        Self::gains(field, gains, to)
    }

    #[inline]
    fn amplify<const N: usize>(gains: &[f32; N], signals: [f32; N]) -> f32 {
        Self::combine(gains, signals)
    }

    fn tabulate(
        table: &mut Table,
        _field: &'static str,
        curve: &Curve,
        _base: Base,
    ) -> Result<(), ConfigError> {
        let graded = Graded::new(curve);
        table.per_unit = SEGMENT * graded.per_unit;
        table.origin = SEGMENT * graded.origin;
        for index in 0..SEGMENTS {
            let [constant, linear, quadratic] = graded.segment(index);
            table.constant[index] = constant;
            table.linear[index] = linear / SEGMENT;
            table.quadratic[index] = quadratic / (SEGMENT * SEGMENT);
        }
        Ok(())
    }

    #[inline]
    fn look_up(table: &Table, signal: f32) -> f32 {
        let position = table.per_unit * signal.abs() + table.origin;
        let segment = segment(position);
        let slope = table.linear[segment] + position * table.quadratic[segment];
        (table.constant[segment] + position * slope).copysign(signal)
    }

    /// In 16.16 fixed point: the sum of rounded-down positions is exact whatever their distance.
    #[inline]
    fn mean_count(position: f32, step: f32) -> f32 {
        let [position, step] = [position, step].map(|value| (value * 65536.0) as i32);
        sum_of_floors(position, step) as f32 * (1.0 / 16.0)
    }

    #[inline]
    fn square(self) -> f32 {
        self * self
    }

    #[inline]
    fn part(self, share: u8) -> f32 {
        self * (f32::from(share) * (1.0 / 256.0))
    }

    fn fraction(self, numerator: i16, denominator: i16) -> f32 {
        f32::from(numerator) * self / f32::from(denominator)
    }

    fn headroom(_field: &'static str, _largest: f32, _base: Base) -> Result<u32, ConfigError> {
        Ok(0)
    }

    #[inline]
    fn ratio(self, whole: f32, limit: f32, _headroom: u32) -> f32 {
        (self / whole).limited(limit)
    }

    #[inline]
    fn of(self, whole: f32) -> f32 {
        self * whole
    }

    #[inline]
    fn coarser(self, _by: u32) -> f32 {
        self
    }

    fn is_finite(self) -> bool {
        f32::is_finite(self)
    }

    #[inline]
    fn abs(self) -> f32 {
        f32::abs(self)
    }

    /// Magnitudes compare as their bits do, without a branch. A NaN becomes the bound.
    #[inline]
    fn limited(self, bound: f32) -> f32 {
        f32::from_bits(self.abs().to_bits().min(bound.to_bits())).copysign(self)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn combine_sums_in_the_given_order() {
        // 1e8 + 1 is not representable: the order decides, and it must be left to right.
        assert_eq!(f32::combine(&[1.0, 1.0, -1.0], [1e8, 1.0, 1e8]), 0.0);
        assert_eq!(f32::combine(&[1.0, -1.0, 1.0], [1e8, 1e8, 1.0]), 1.0);
    }

    #[test]
    fn segment_saturates_at_both_ends() {
        assert_eq!(segment(2.75 * SEGMENT), 2);
        assert_eq!(segment(-3.0 * SEGMENT), 0);
        assert_eq!(segment(31.5 * SEGMENT), 31);
        assert_eq!(segment(1e30), 31);
    }

    #[test]
    fn mean_count_is_the_mean_of_what_a_counter_showed() {
        let sum = |position, step| 16.0 * f32::mean_count(position, step);
        assert_eq!(sum(0.5, 0.0), 0.0);
        assert_eq!(sum(-0.5, 0.0), -16.0);
        // 3.25, 2.75, 2.25 … −4.25.
        assert_eq!(sum(3.25, 0.5), (3 + 2 * (2 + 1 - 1 - 2 - 3 - 4) - 5) as f32);
        assert_eq!(
            sum(-3.25, -0.5),
            -4.0 - 3.0 - 3.0 - 2.0 - 2.0 - 1.0 - 1.0 + 2.0 * (1.0 + 2.0 + 3.0) + 4.0
        );
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
}
