//! The quasi-sliding injection: tanh, closed implicitly over one step.
//!
//! A channel with injection strength k and boundary layer ε obeys ẏ = d − k·tanh(y/ε) (paper, Eqs. 17, 25, 41, 52).
//! Explicit Euler on it chatters once h·k/ε exceeds 2. The implicit (backward Euler, proximal) form of Acary and
//! Brogliato ("Implicit Euler numerical scheme and chattering-free implementation of sliding mode systems", Systems &
//! Control Letters 59, 2010) solves, for the mismatch σ measured at the sample,
//!
//! ```text
//! y + h·k·tanh(y/ε) = σ
//! ```
//!
//! and injects k·tanh(y/ε). With v = σ/ε and β = h·k/ε that is k·g(v), where g solves g = tanh(v − β·g): one
//! monotone odd function of v per β, tabulated here when the gains are set. β = 0 gives tanh itself, the explicit form.

use crate::math::{Scalar, tanh};

/// Segments between the wide first one and saturation.
const SEGMENTS: usize = 32;

/// The injection g(v), tabulated by one quadratic per segment for one β.
///
/// Odd to the bit, rising, and within ±1 (to a rounding). The error is below 1e-4 for β up to 151 (4e-5 from 1 to 30, where the paper's
/// gains are at 20 kHz: 1.3, and 15.1 over two periods) and below 2e-4 up to [`Injection::MAX_BETA`]: the tests hold it to that.
/// The time to evaluate does not depend on the argument.
///
/// The grid: up to `start` the function is so nearly straight that one quadratic serves; from there to saturation the
/// segments are of equal width. Position 0…1 is the end of the wide segment, 1…2 the first equal one, and so on; the
/// last entry is the constant 1.
#[derive(Clone, Debug)]
pub struct Injection<S: Scalar> {
    per_width: S::Gain,
    origin: S,
    coefficients: [[S; 3]; SEGMENTS + 2],
}

impl<S: Scalar> Injection<S> {
    /// The largest β that a table is made for: beyond it g is a straight line with two corners that a controller with a
    /// slower loop should not be asked to resolve.
    pub const MAX_BETA: f32 = 2000.0;

    /// Tabulates g for `beta` = h·k/ε, from 0 to [`MAX_BETA`](Self::MAX_BETA) (the caller checks).
    pub fn new(beta: f32) -> Self {
        // Where one quadratic from zero starts to err, and where tanh is 1 to within 2e-5; found by the error tests.
        let start = (0.7 * (beta - 14.0)).max(0.86 * beta - 36.0).max(0.0);
        let end = beta + 5.8;
        let width = (end - start) / SEGMENTS as f32;
        // Position of v on the grid: v/width + origin.
        let origin = 1.0 - start / width;
        let node = |position: f32| {
            if position >= (SEGMENTS + 1) as f32 {
                1.0
            } else {
                implicit_tanh((position - origin) * width, beta)
            }
        };
        let mut coefficients = [[S::ZERO; 3]; SEGMENTS + 2];
        for (index, entry) in coefficients.iter_mut().enumerate() {
            let left = index as f32;
            *entry = match index {
                0 if start > 0.0 => through_origin(origin, 0.5 * (origin + 1.0), 1.0, node),
                0 => [0.0; 3],
                _ if index > SEGMENTS => [1.0, 0.0, 0.0],
                _ => parabola(node(left), node(left + 0.5), node(left + 1.0)),
            }
            .map(S::from_f32);
        }
        Self { per_width: S::gain(1.0 / width), origin: S::from_f32(origin), coefficients }
    }

    /// g(v), dimensionless, of the mismatch `v` = σ/ε. `v` must be finite, within ±1e30.
    #[inline]
    pub fn value(&self, v: S) -> S {
        let position = S::combine([(self.per_width, v.abs())]) + self.origin;
        let (segment, x) = position.segment(SEGMENTS + 1);
        let [c0, c1, c2] = match self.coefficients.get(segment) {
            Some(&coefficients) => coefficients,
            None => [S::ONE, S::ZERO, S::ZERO],
        };
        let magnitude = c0 + x * (c1 + x * c2);
        if v < S::ZERO { -magnitude } else { magnitude }
    }
}

/// The g that solves g = tanh(v − β·g), for v ≥ 0: bisection on w = v − β·g, where w + β·tanh(w) = v.
fn implicit_tanh(v: f32, beta: f32) -> f32 {
    let (mut low, mut high) = (0.0, v);
    for _ in 0..40 {
        let middle = 0.5 * (low + high);
        if middle + beta * tanh(middle) < v {
            low = middle;
        } else {
            high = middle;
        }
    }
    tanh(0.5 * (low + high))
}

/// Coefficients of the rising parabola with these values at x = 0, ½ and 1.
///
/// The middle value is moved, where need be, to where the parabola rises all the way: near saturation it would
/// overshoot 1 otherwise.
fn parabola(at_0: f32, at_half: f32, at_1: f32) -> [f32; 3] {
    let middle = at_half.clamp(0.75 * at_0 + 0.25 * at_1, 0.25 * at_0 + 0.75 * at_1);
    [at_0, 4.0 * middle - 3.0 * at_0 - at_1, 2.0 * (at_0 + at_1) - 4.0 * middle]
}

/// Coefficients in x of the parabola that is exactly 0 at x = `zero` and meets `node` at `middle` and `end`.
fn through_origin(zero: f32, middle: f32, end: f32, node: impl Fn(f32) -> f32) -> [f32; 3] {
    let slope = |x: f32| node(x) / (x - zero);
    let curvature = (slope(end) - slope(middle)) / (end - middle);
    let linear = slope(end) - curvature * (end + zero);
    // Whatever the rounding, x = zero must give 0: the same operations as in `value`.
    let constant = -(zero * (linear + zero * curvature));
    [constant, linear, curvature]
}

#[cfg(test)]
mod tests {
    use super::*;

    /// g by bisection in double precision: the truth that the table is held against.
    fn exact(v: f64, beta: f64) -> f64 {
        let (mut low, mut high) = (0.0, v.abs());
        for _ in 0..100 {
            let middle = 0.5 * (low + high);
            if middle + beta * middle.tanh() < v.abs() {
                low = middle;
            } else {
                high = middle;
            }
        }
        low.tanh().copysign(v)
    }

    fn worst_error(beta: f32) -> f64 {
        let injection = Injection::<f32>::new(beta);
        let points = 200_000;
        (0..=points)
            .map(|point| {
                let v = (beta + 8.0) * point as f32 / points as f32;
                (f64::from(injection.value(v)) - exact(f64::from(v), f64::from(beta))).abs()
            })
            .fold(0.0, f64::max)
    }

    const BETAS: [f32; 14] =
        [0.0, 0.015, 0.3, 1.3, 7.55, 15.1, 30.0, 60.0, 100.0, 151.0, 300.0, 755.0, 1510.0, 2000.0];

    #[test]
    fn error_is_within_the_stated_bounds() {
        for beta in BETAS {
            let error = worst_error(beta);
            let bound = match beta {
                1.0..=30.0 => 4e-5,
                ..=151.0 => 1e-4,
                _ => 2e-4,
            };
            assert!(error < bound, "beta {beta}: {error:e} is not below {bound:e}");
            // A bound that is never approached says nothing: the quadratics do err.
            assert!(error > 1e-6, "beta {beta}: {error:e} is suspiciously small");
        }
    }

    #[test]
    fn odd_bounded_and_zero_at_zero() {
        for beta in BETAS {
            let injection = Injection::<f32>::new(beta);
            assert_eq!(injection.value(0.0), 0.0, "beta {beta}");
            for step in 0..100_000 {
                let v = (beta + 10.0) * step as f32 / 100_000.0;
                let g = injection.value(v);
                assert_eq!(
                    injection.value(-v).to_bits(),
                    (-g).to_bits() & if v == 0.0 { 0 } else { u32::MAX }
                );
                assert!((0.0..=1.0 + f32::EPSILON).contains(&g), "beta {beta}: g({v}) = {g}");
            }
            for v in [1e6, 1e30] {
                assert_eq!(injection.value(v), 1.0);
                assert_eq!(injection.value(-v), -1.0);
            }
        }
    }

    #[test]
    fn monotone() {
        for beta in BETAS {
            let injection = Injection::<f32>::new(beta);
            let mut before = 0.0;
            for step in 0..100_000 {
                let v = (beta + 10.0) * step as f32 / 100_000.0;
                let g = injection.value(v);
                // Two units in the last place for the rounding of two sums near 1.
                assert!(
                    g >= before - 2.0 * f32::EPSILON,
                    "beta {beta}: falls from {before} to {g} at {v}"
                );
                before = g;
            }
        }
    }

    #[test]
    fn solves_the_implicit_equation_in_other_words() {
        // The injected value must put the mismatch where its own tanh is that value: y = v - beta g, tanh(y) = g.
        let injection = Injection::<f32>::new(7.55);
        for step in -800..800 {
            let v = step as f32 / 100.0;
            let g = f64::from(injection.value(v));
            let y = f64::from(v) - 7.55 * g;
            // An error of 2e-5 in g moves y by 7.55 times that.
            assert!((y.tanh() - g).abs() < 2e-4, "v {v}: tanh({y}) is not {g}");
        }
    }
}
