//! Fixed point: signals in 2⁻³¹ of their base, for cores without an FPU.
//!
//! **No overflow.** Bases ([`crate::per_unit`]) leave every signal that a sample or a command can cause below a quarter of full
//! scale. Gains of a sum come to a half at most, so the sum stays within its largest signal; sums with larger gains saturate at a
//! quarter. No more than four such are added before a limit or the next gain. What is remembered is limited. Additions are the
//! plain ones: tests, where they are checked, would panic.
//!
//! **Rounding.** A gain is rounded to 16 bits with its sum's largest: a core without long products (Cortex-M0) takes two
//! multiplications for one. The bases make gains that must be exact — of the clock, of counts — powers of two. A sum of
//! products is exact, and then rounded once: down, or to the nearest where errors would add up ([`accumulate`](Scalar::accumulate)).

use super::table::{Curve, rising_parabola};
use super::{Base, Scalar, log2_ceil, power_of_two, sum_of_floors};
use crate::config::{ConfigError, require};
use core::ops::{Add, Neg, Sub};

/// A signal in 2⁻³¹ of its [`Base`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord)]
pub struct Q31(pub i32);

/// Full scale.
const SCALE: f32 = (1_u64 << 31) as f32;

/// Where what has large gains saturates.
const QUARTER: i32 = 1 << 29;

/// Most that the mantissas of a sum may come to: the sum then stays within half its largest signal.
const MOST: u32 = (1 << 15) - 1;

/// Where a mantissa is in its word: on top for a long product, of which the upper word counts.
const PLACE: u32 = if cfg!(short_products) { 0 } else { 16 };

/// Gains of a sum: mantissa/2¹⁶/2^shift.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Gains<const N: usize> {
    mantissas: [i32; N],
    shift: u32,
    /// Half of what `shift` takes.
    half: i32,
}

/// Gains of any size: mantissa/2¹⁶·2^up/2^down, where one of both is 0.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Steep<const N: usize> {
    mantissas: [i32; N],
    down: u32,
    /// [`QUARTER`]/2^up.
    limit: i32,
    up: u32,
}

/// A table of equal segments, each 2¹⁶ wide in the position.
#[derive(Clone, Copy, Debug)]
#[repr(C)]
pub struct Table {
    per_unit: Steep<1>,
    segments: [Segment; SEGMENTS],
}

#[derive(Clone, Copy, Debug)]
#[repr(C)]
struct Segment {
    /// Value at the left end, in 2⁻³⁰.
    value: i32,
    /// Slope there, in 2⁻¹⁹ per segment.
    slope: u16,
    /// And what it changes.
    curvature: i16,
}

/// Segments of a table; the last is the constant 1.
const SEGMENTS: usize = 64;

/// The base of positions.
const POSITION: Base = Base(32_768.0);

/// Counts of half a revolution of a counter, in sixteenths.
const MOST_SIXTEENTHS: i32 = 1 << 18;

/// 1 as a [ratio](Base::RATIO).
const ONE: i32 = 1 << 30;

/// ⌊Σ mantissa·signal/2¹⁶⌋, by long products.
#[inline]
#[cfg_attr(short_products, allow(dead_code, reason = "the other one is for this core"))]
fn long<const N: usize>(mantissas: &[i32; N], signals: [Q31; N]) -> i32 {
    let mut sum = 0;
    for place in 0..N {
        sum += i64::from(mantissas[place]) * i64::from(signals[place].0);
    }
    (sum >> (16 + PLACE)) as i32
}

/// The same by products of 32 bits.
#[inline]
#[cfg_attr(not(short_products), allow(dead_code, reason = "for cores without long products"))]
fn short<const N: usize>(mantissas: &[i32; N], signals: [Q31; N]) -> i32 {
    let (mut high, mut low) = (0_i32, 0_i32);
    for place in 0..N {
        let (mantissa, signal) = (mantissas[place] >> PLACE, signals[place].0);
        high = high.wrapping_add((signal >> 16).wrapping_mul(mantissa));
        low = low.wrapping_add((signal & 0xffff).wrapping_mul(mantissa));
    }
    high.wrapping_add(low >> 16)
}

#[cfg(not(short_products))]
use long as sum_of_products;
#[cfg(short_products)]
use short as sum_of_products;

/// Mantissas of gains in 2^(exponent − 16), with the least exponent; refuses more than `most` and what is no number, naming the
/// first of those, or the largest gain.
#[inline(never)]
fn normalised<const N: usize>(
    field: &'static str,
    rule: &'static str,
    gains: [(f32, Base); N],
    to: Base,
    most: i32,
) -> Result<([i32; N], i32), ConfigError> {
    let larger = |a: f32, b: f32| if b.is_finite() && b.abs() < a.abs() { a } else { b };
    let largest = gains.iter().map(|(gain, _)| *gain).fold(0.0, larger);
    require(gains.iter().all(|(gain, _)| gain.is_finite()), field, rule, largest)?;
    let gains = gains.map(|(gain, base)| gain * (base.0 / to.0));
    let total: f32 = gains.iter().map(|gain| gain.abs()).sum();
    if total == 0.0 {
        return Ok(([0; N], 0));
    }
    let mut exponent = log2_ceil(total).max(-30);
    loop {
        require(exponent <= most, field, rule, largest)?;
        let scale = power_of_two(16 - exponent);
        let mantissas = gains.map(|gain| libm::roundf(gain * scale) as i32);
        // Rounded up, they may come to more than their sum.
        if mantissas.iter().map(|mantissa| mantissa.unsigned_abs()).sum::<u32>() <= MOST {
            return Ok((mantissas.map(|mantissa| mantissa << PLACE), exponent));
        }
        exponent += 1;
    }
}

/// Half of what a shift to the right takes: added before, it rounds to the nearest.
fn half(shift: u32) -> i32 {
    if shift == 0 { 0 } else { 1 << (shift - 1) }
}

impl Add for Q31 {
    type Output = Self;
    #[inline]
    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

impl Sub for Q31 {
    type Output = Self;
    #[inline]
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0)
    }
}

impl Neg for Q31 {
    type Output = Self;
    #[inline]
    fn neg(self) -> Self {
        Self(-self.0)
    }
}

impl Scalar for Q31 {
    type Gains<const N: usize> = Gains<N>;
    type Steep<const N: usize> = Steep<N>;
    type Time = ();
    type Table = Table;

    const ZERO: Self = Self(0);
    const NO_TABLE: Table = Table {
        per_unit: Steep { mantissas: [0], down: 0, limit: 0, up: 0 },
        segments: [Segment { value: 0, slope: 0, curvature: 0 }; SEGMENTS],
    };
    const ANY_TIME: bool = false;

    fn from_f32(value: f32, base: Base) -> Self {
        // Symmetric, for its magnitude to be one too.
        Self((libm::roundf(value / base.0 * SCALE) as i32).max(-i32::MAX))
    }

    fn to_f32(self, base: Base) -> f32 {
        self.0 as f32 * (base.0 / SCALE)
    }

    fn constant(field: &'static str, value: f32, base: Base) -> Result<Self, ConfigError> {
        let rule = "must be within the range of fixed point";
        require(value.abs() <= 0.5 * base.0, field, rule, value)?;
        Ok(Self::from_f32(value, base))
    }

    #[inline]
    fn from_code(code: u16) -> Self {
        Self(i32::from(code) << 15)
    }

    #[inline]
    fn from_sixteenths(difference: i32) -> Self {
        Self(difference.clamp(-MOST_SIXTEENTHS, MOST_SIXTEENTHS) << 12)
    }

    fn gains<const N: usize>(
        field: &'static str,
        gains: [(f32, Base); N],
        to: Base,
    ) -> Result<Gains<N>, ConfigError> {
        let rule = "must keep the gains of fixed point below a half";
        let (mantissas, exponent) = normalised(field, rule, gains, to, 0)?;
        let shift = exponent.unsigned_abs();
        Ok(Gains { mantissas, shift, half: half(shift) })
    }

    #[inline]
    fn combine<const N: usize>(gains: &Gains<N>, signals: [Self; N]) -> Self {
        Self(sum_of_products(&gains.mantissas, signals) >> (gains.shift & 31))
    }

    #[inline]
    fn accumulate<const N: usize>(gains: &Gains<N>, signals: [Self; N]) -> Self {
        Self((sum_of_products(&gains.mantissas, signals) + gains.half) >> (gains.shift & 31))
    }

    fn time(_seconds: f32) {}

    #[inline]
    fn over<const SHIFT: u32>(self, (): ()) -> Self {
        Self((self.0 + (1 << (SHIFT - 1))) >> SHIFT)
    }

    fn steep<const N: usize>(
        field: &'static str,
        gains: [(f32, Base); N],
        to: Base,
    ) -> Result<Steep<N>, ConfigError> {
        let rule = "must keep the gains of fixed point below 16384";
        let (mantissas, exponent) = normalised(field, rule, gains, to, 15)?;
        let up = exponent.max(0) as u32;
        Ok(Steep { mantissas, down: (-exponent).max(0) as u32, limit: QUARTER >> up, up })
    }

    #[inline]
    fn amplify<const N: usize>(gains: &Steep<N>, signals: [Self; N]) -> Self {
        let sum = sum_of_products(&gains.mantissas, signals) >> (gains.down & 31);
        Self(Self(sum).limited(Self(gains.limit)).0 << (gains.up & 31))
    }

    fn tabulate(
        table: &mut Table,
        field: &'static str,
        curve: &Curve,
        base: Base,
    ) -> Result<(), ConfigError> {
        let width = curve.end / (SEGMENTS - 1) as f32;
        table.per_unit = Self::steep(field, [(1.0 / (width * curve.unit), base)], POSITION)?;
        table.segments[SEGMENTS - 1] = Segment { value: ONE, slope: 0, curvature: 0 };
        for (index, segment) in table.segments.iter_mut().enumerate().take(SEGMENTS - 1) {
            let node = |position: f32| {
                if position >= (SEGMENTS - 1) as f32 {
                    1.0
                } else {
                    (curve.value)(position * width)
                }
            };
            let left = index as f32;
            let [value, slope, curvature] =
                rising_parabola([node(left), node(left + 0.5), node(left + 1.0)]);
            let [slope, curvature] = [slope, curvature].map(|x| libm::roundf(x * 524_288.0) as i32);
            // Rounded, too, no slope must fall below zero.
            let curvature = curvature.max(1 - slope) as i16;
            *segment = Segment {
                value: Self::from_f32(value, Base::RATIO).0,
                slope: slope as u16,
                curvature,
            };
        }
        Ok(())
    }

    #[inline]
    fn look_up(table: &Table, signal: Self) -> Self {
        let Steep { mantissas, down, limit, up } = &table.per_unit;
        let position = sum_of_products(mantissas, [signal.abs()]) >> (down & 31);
        // Negative only where it wrapped, far beyond the table.
        let position = (position as u32).min(*limit as u32) << (up & 31);
        let segment = &table.segments[((position >> 16) as usize).min(SEGMENTS - 1)];
        let place = position & 0xffff;
        let slope =
            i32::from(segment.slope) + ((place as i32 * i32::from(segment.curvature)) >> 16);
        let value = segment.value + ((slope as u32).wrapping_mul(place) >> 5) as i32;
        let sign = signal.0 >> 31;
        Self((value ^ sign) - sign)
    }

    #[inline]
    fn mean_count(position: Self, step: Self) -> Self {
        Self(sum_of_floors(position.0, step.0).wrapping_shl(12))
    }

    #[inline]
    fn square(self) -> Self {
        let upper = self.0 >> 12;
        Self(upper.wrapping_mul(upper))
    }

    #[inline]
    fn part(self, share: u8) -> Self {
        Self(self.0.wrapping_mul(share.into()) >> 8)
    }

    fn fraction(self, numerator: i16, denominator: i16) -> Self {
        let product = i64::from(self.0) * i64::from(numerator);
        let quotient = product / i64::from(denominator).max(1);
        Self(quotient.clamp((-QUARTER).into(), QUARTER.into()) as i32)
    }

    fn headroom(field: &'static str, largest: f32, base: Base) -> Result<u32, ConfigError> {
        let headroom = log2_ceil(base.0 / largest);
        let rule = "must be higher for this motor in fixed point";
        require((1..=14).contains(&headroom), field, rule, largest)?;
        Ok(headroom as u32)
    }

    #[inline]
    fn ratio(self, whole: Self, _limit: Self, headroom: u32) -> Self {
        let dividend = self.0.wrapping_shl(headroom - 1);
        // Rounded up, so that the quotient is no larger than it should be.
        let divisor = (whole.0.wrapping_shr(16 - headroom) + 1).max(1);
        Self((dividend / divisor) << 15)
    }

    #[inline]
    fn of(self, whole: Self) -> Self {
        Self(sum_of_products(&[(self.0 >> 15) << PLACE], [whole]) << 1)
    }

    #[inline]
    fn coarser(self, by: u32) -> Self {
        Self(self.0 >> (by & 31))
    }

    fn is_finite(self) -> bool {
        true
    }

    #[inline]
    fn abs(self) -> Self {
        Self(self.0.wrapping_abs())
    }

    #[inline]
    fn limited(self, bound: Self) -> Self {
        Self(self.0.max(-bound.0).min(bound.0))
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    const UNIT: Base = Base(1.0);

    fn gains<const N: usize>(gains: [f32; N]) -> Gains<N> {
        Q31::gains("gain", gains.map(|gain| (gain, UNIT)), UNIT).expect("below a half")
    }

    fn steep(gain: f32) -> Steep<1> {
        Q31::steep("gain", [(gain, UNIT)], UNIT).expect("valid")
    }

    proptest! {
        #[test]
        fn long_and_short_products_make_the_same_bits(
            raw in prop::array::uniform3(any::<i32>()),
            shares in prop::array::uniform3(-1.0_f32..1.0),
            size in 1e-9_f32..0.49,
        ) {
            let total: f32 = shares.iter().map(|share| share.abs()).sum();
            let Gains { mantissas, .. } = gains(shares.map(|share| size * share / total));
            let signals = raw.map(Q31);
            let sum = long(&mantissas, signals);
            prop_assert_eq!(sum, short(&mantissas, signals));
            // It cannot leave the range: half the largest signal bounds it.
            prop_assert!(sum.unsigned_abs() <= 1 << 30);
        }

        #[test]
        fn a_sum_is_right_to_the_mantissas_and_a_rounding(
            raw in prop::array::uniform2(-(1 << 30)..1 << 30),
            shares in prop::array::uniform2(-1.0_f32..1.0),
            size in 1e-6_f32..0.49,
        ) {
            let total: f32 = shares.iter().map(|share| share.abs()).sum();
            let values = shares.map(|share| size * share / total);
            let gains = gains(values);
            let exact: f64 =
                raw.iter().zip(values).map(|(raw, gain)| f64::from(*raw) * f64::from(gain)).sum();
            // Two mantissas, each wrong by half of 2⁻¹⁴ of all gains at most.
            let allowed = 6.2e-5 * f64::from(size) * f64::from(1 << 30);
            let [down, nearest] = [Q31::combine(&gains, raw.map(Q31)), Q31::accumulate(&gains, raw.map(Q31))];
            prop_assert!((f64::from(down.0) - exact).abs() <= allowed + 1.0, "{down:?}, {exact}");
            prop_assert!((f64::from(nearest.0) - exact).abs() <= allowed + 1.0, "{nearest:?}, {exact}");
            prop_assert!((0..=1).contains(&(nearest.0 - down.0)));
        }

        #[test]
        fn a_steep_gain_saturates_at_a_quarter(raw in any::<i32>(), gain in -16_000.0_f32..16_000.0) {
            let exact = f64::from(raw) * f64::from(gain);
            let quarter = f64::from(QUARTER);
            let told = f64::from(Q31::amplify(&steep(gain), [Q31(raw)]).0);
            let allowed = 6.2e-5 * exact.abs() + 4.0 * f64::from(gain).abs() + 1.0;
            prop_assert!((told - exact.clamp(-quarter, quarter)).abs() <= allowed, "{told}, {exact}");
        }

        #[test]
        fn a_ratio_is_never_larger_than_it_should_be(bus in 1 << 19..=1 << 21, share in -1.0_f64..1.0) {
            // A bus of up to 2⁻¹⁰ of its base.
            let part = Q31((f64::from(bus) * share) as i32);
            let told = f64::from(part.ratio(Q31(bus), Q31(ONE), 10).0) / f64::from(ONE);
            let exact = f64::from(part.0) / f64::from(bus);
            prop_assert!(told.abs() <= exact.abs(), "{told} exceeds {exact}");
            prop_assert!((told - exact).abs() < 2e-4, "{told} is not {exact}");
        }
    }

    #[test]
    fn powers_of_two_are_exact() {
        let quarter = gains([0.25, -0.125]);
        for raw in [8, -8, 1 << 20, -(1 << 29)] {
            assert_eq!(Q31::combine(&quarter, [Q31(raw), Q31(raw)]).0, raw / 8);
        }
        assert_eq!(Q31(1000 << 6).over::<6>(()), Q31(1000));
        assert_eq!([31, 32, -32, -33].map(|raw| Q31(raw).over::<6>(()).0), [0, 1, 0, -1]);
    }

    #[test]
    fn what_cannot_be_represented_is_refused_with_its_name() {
        for gain in [0.5, -0.6, 1e9, f32::NAN, f32::INFINITY] {
            let error =
                Q31::gains("a.gain", [(0.1, UNIT), (gain, UNIT)], UNIT).expect_err("refused");
            assert_eq!(error.field, "a.gain");
            assert!(error.value == gain || error.value.is_nan(), "{error}");
        }
        for gain in [40_000.0, f32::NAN] {
            assert!(Q31::steep("a.gain", [(gain, UNIT)], UNIT).is_err(), "{gain}");
        }
        assert!(Q31::constant("a.value", 0.51, UNIT).is_err());
        assert_eq!(Q31::constant("a.value", -0.5, UNIT), Ok(Q31(-(1 << 30))));
        assert!(Q31::constant("a.value", f32::NAN, UNIT).is_err());
    }

    #[test]
    fn values_saturate_on_both_sides_alike() {
        for value in [1.0, 7.0, f32::INFINITY] {
            assert_eq!(Q31::from_f32(value, UNIT), Q31(i32::MAX));
            assert_eq!(Q31::from_f32(-value, UNIT), Q31(-i32::MAX));
        }
        assert_eq!(Q31::from_f32(f32::NAN, UNIT), Q31::ZERO);
        assert_eq!(Q31::from_f32(0.25, UNIT).to_f32(UNIT), 0.25);
    }

    #[test]
    fn counts_are_told_as_by_floating_point() {
        for (position, step) in [(0.5, 0.0), (-0.5, 0.0), (3.25, 0.5), (-3.25, -0.5), (900.0, 61.7)]
        {
            let fixed = Q31::mean_count(
                Q31::from_f32(position, Base::COUNT),
                Q31::from_f32(step, Base::COUNT),
            );
            assert_eq!(fixed.to_f32(Base::COUNT), f32::mean_count(position, step));
        }
        assert_eq!(Q31::from_sixteenths(-40).to_f32(Base::COUNT), -2.5);
        assert_eq!(Q31::from_code(4095).to_f32(Base::CODE), 4095.0);
        assert_eq!(Q31(1 << 20).part(64), Q31(1 << 18));
        // (−1/16)² and (1/1024)², times 2⁷.
        assert_eq!(
            [-(1 << 27), 1 << 21].map(|raw| Q31(raw).square()),
            [Q31(1 << 30), Q31(1 << 18)]
        );
        assert_eq!(Q31(3000).fraction(-7, 3), Q31(-7000));
        assert_eq!(Q31(1 << 28).fraction(1000, 1), Q31(QUARTER));
    }
}
