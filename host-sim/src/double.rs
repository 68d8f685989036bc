//! Double precision as a scalar of the control core.
//!
//! The core knows no f64; this is the simulator's own. It runs the same laws where the rounding of f32 would hide what
//! is looked for: in near-continuous runs and against theoretical bounds. Its gains are still the core's, rounded to f32
//! when the drive is built.

use quasidrive::math::Scalar;
use std::ops::{Add, Div, Mul, Neg, Sub};

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

impl Mul for Double {
    type Output = Self;
    fn mul(self, other: Self) -> Self {
        Self(self.0 * other.0)
    }
}

impl Div for Double {
    type Output = Self;
    fn div(self, other: Self) -> Self {
        Self(self.0 / other.0)
    }
}

impl Neg for Double {
    type Output = Self;
    fn neg(self) -> Self {
        Self(-self.0)
    }
}

impl Scalar for Double {
    type Gain = f64;

    const ZERO: Self = Self(0.0);
    const ONE: Self = Self(1.0);

    fn from_f32(value: f32) -> Self {
        Self(f64::from(value))
    }

    fn to_f32(self) -> f32 {
        self.0 as f32
    }

    fn from_code(code: u16) -> Self {
        Self(code.into())
    }

    fn from_difference(difference: i16) -> Self {
        Self(difference.into())
    }

    fn gain(value: f32) -> f64 {
        f64::from(value)
    }

    fn combine<const N: usize>(terms: [(f64, Self); N]) -> Self {
        Self(terms.iter().map(|(gain, signal)| gain * signal.0).sum())
    }

    const SEGMENT: f32 = f32::SEGMENT;

    fn segment(self) -> usize {
        (self.0 as u32 >> 27) as usize
    }

    fn is_finite(self) -> bool {
        self.0.is_finite()
    }

    fn abs(self) -> Self {
        Self(self.0.abs())
    }

    fn with_sign_of(self, other: Self) -> Self {
        Self(self.0.copysign(other.0))
    }

    fn limited(self, bound: Self) -> Self {
        Self(self.0.abs().min(bound.0)).with_sign_of(self)
    }
}

/// A scalar that the simulator can fill from, and read into, its own double precision.
pub trait SimulatedScalar: Scalar {
    /// The scalar nearest to a value in SI units.
    fn from_f64(value: f64) -> Self;
    /// The value in SI units.
    fn to_f64(self) -> f64;
}

impl SimulatedScalar for f32 {
    fn from_f64(value: f64) -> Self {
        value as f32
    }

    fn to_f64(self) -> f64 {
        f64::from(self)
    }
}

impl SimulatedScalar for Double {
    fn from_f64(value: f64) -> Self {
        Self(value)
    }

    fn to_f64(self) -> f64 {
        self.0
    }
}
