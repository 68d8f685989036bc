//! Double precision as a scalar of the control core.
//!
//! The core knows no f64; this is the simulator's own. It runs the same laws where the rounding of f32 would hide what
//! is looked for: in near-continuous runs and against theoretical bounds. Its gains are still the core's, rounded to f32
//! when the drive is built.

use quasidrive::config::ConfigError;
use quasidrive::math::table::{Curve, Graded, SEGMENTS};
use quasidrive::math::{Base, Q31, Scalar};
use std::ops::{Add, Neg, Sub};

/// A double-precision number.
#[derive(Clone, Copy, Debug, Default, PartialEq, PartialOrd)]
pub struct Double(pub f64);

impl Add for Double {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self(self.0 + other.0)
    }
}

impl Sub for Double {
    type Output = Self;
    fn sub(self, other: Self) -> Self {
        Self(self.0 - other.0)
    }
}

impl Neg for Double {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0)
    }
}

/// A graded table, with its quadratics in the position itself.
#[derive(Clone, Copy, Debug)]
pub struct Table {
    origin: f64,
    per_unit: f64,
    segments: [[f64; 3]; SEGMENTS],
}

impl Scalar for Double {
    type Gains<const N: usize> = [f64; N];
    type Steep<const N: usize> = [f64; N];
    type Time = f64;
    type Table = Table;

    const ZERO: Self = Self(0.0);
    const NO_TABLE: Table = Table { origin: 0.0, per_unit: 0.0, segments: [[0.0; 3]; SEGMENTS] };
    const ANY_TIME: bool = true;

    fn from_f32(value: f32, _base: Base) -> Self {
        Self(value.into())
    }

    fn to_f32(self, _base: Base) -> f32 {
        self.0 as f32
    }

    fn constant(_field: &'static str, value: f32, _base: Base) -> Result<Self, ConfigError> {
        Ok(Self(value.into()))
    }

    fn from_code(code: u16) -> Self {
        Self(code.into())
    }

    fn from_sixteenths(difference: i32) -> Self {
        Self(f64::from(difference) / 16.0)
    }

    fn gains<const N: usize>(
        _field: &'static str,
        gains: [(f32, Base); N],
        _to: Base,
    ) -> Result<[f64; N], ConfigError> {
        Ok(gains.map(|(gain, _)| gain.into()))
    }

    fn combine<const N: usize>(gains: &[f64; N], signals: [Self; N]) -> Self {
        Self(gains.iter().zip(signals).map(|(gain, signal)| gain * signal.0).sum())
    }

    fn accumulate<const N: usize>(gains: &[f64; N], signals: [Self; N]) -> Self {
        Self::combine(gains, signals)
    }

    fn time(seconds: f32) -> f64 {
        seconds.into()
    }

    fn over<const SHIFT: u32>(self, time: f64) -> Self {
        Self(self.0 * time)
    }

    fn steep<const N: usize>(
        field: &'static str,
        gains: [(f32, Base); N],
        to: Base,
    ) -> Result<[f64; N], ConfigError> {
        Self::gains(field, gains, to)
    }

    fn amplify<const N: usize>(gains: &[f64; N], signals: [Self; N]) -> Self {
        Self::combine(gains, signals)
    }

    fn tabulate(
        table: &mut Table,
        _field: &'static str,
        curve: &Curve,
        _base: Base,
    ) -> Result<(), ConfigError> {
        let graded = Graded::new(curve);
        *table = Table {
            origin: graded.origin.into(),
            per_unit: graded.per_unit.into(),
            segments: std::array::from_fn(|index| graded.segment(index).map(f64::from)),
        };
        Ok(())
    }

    fn look_up(table: &Table, signal: Self) -> Self {
        let position = table.per_unit * signal.0.abs() + table.origin;
        // `as` takes what is below 0 to the first segment.
        let [c0, c1, c2] = table.segments[(position as usize).min(SEGMENTS - 1)];
        Self((c0 + position * (c1 + position * c2)).copysign(signal.0))
    }

    fn mean_count(position: Self, step: Self) -> Self {
        Self((0..16).map(|j| (position.0 - f64::from(j) * step.0).floor()).sum::<f64>() / 16.0)
    }

    fn square(self) -> Self {
        Self(self.0 * self.0)
    }

    fn part(self, share: u8) -> Self {
        Self(self.0 * f64::from(share) / 256.0)
    }

    fn fraction(self, numerator: i16, denominator: i16) -> Self {
        Self(self.0 * f64::from(numerator) / f64::from(denominator))
    }

    fn headroom(_field: &'static str, _largest: f32, _base: Base) -> Result<u32, ConfigError> {
        Ok(0)
    }

    fn ratio(self, whole: Self, limit: Self, _headroom: u32) -> Self {
        Self(self.0 / whole.0).limited(limit)
    }

    fn of(self, whole: Self) -> Self {
        Self(self.0 * whole.0)
    }

    fn coarser(self, _by: u32) -> Self {
        self
    }

    fn is_finite(self) -> bool {
        self.0.is_finite()
    }

    fn abs(self) -> Self {
        Self(self.0.abs())
    }

    fn limited(self, bound: Self) -> Self {
        Self(self.0.abs().min(bound.0).copysign(self.0))
    }
}

/// A scalar that the simulator can fill from, and read into, its own double precision.
pub trait SimulatedScalar: Scalar {
    /// The scalar nearest to a value in SI units.
    fn from_f64(value: f64, base: Base) -> Self;
    /// The value in SI units.
    fn to_f64(self, base: Base) -> f64;
}

impl SimulatedScalar for f32 {
    fn from_f64(value: f64, _base: Base) -> Self {
        value as f32
    }

    fn to_f64(self, _base: Base) -> f64 {
        f64::from(self)
    }
}

impl SimulatedScalar for Double {
    fn from_f64(value: f64, _base: Base) -> Self {
        Self(value)
    }

    fn to_f64(self, _base: Base) -> f64 {
        self.0
    }
}

impl SimulatedScalar for Q31 {
    fn from_f64(value: f64, base: Base) -> Self {
        // What measures saturates at a quarter, beyond any limit.
        Self((value / f64::from(base.0) * SCALE).round().clamp(-0.25 * SCALE, 0.25 * SCALE) as i32)
    }

    fn to_f64(self, base: Base) -> f64 {
        f64::from(self.0) / SCALE * f64::from(base.0)
    }
}

/// Full scale of fixed point.
const SCALE: f64 = (1_u64 << 31) as f64;
