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

/// Segments of a table: a wide one, equal ones, and the constant 1 beyond.
const SEGMENTS: usize = 32;
/// Index of the last segment.
const LAST: usize = SEGMENTS - 1;

/// Largest relative error of the tabulated slope of g, where |g| is below 0.97.
pub const SLOPE_ERROR: f32 = 0.015;

/// The injection g(v), tabulated by one quadratic per segment for one β and ε.
///
/// Odd to the bit, rising, and within ±1 (the last two to 1e-6, for rounding). The error is below
/// 4e-5 for β from 1 to 45 (the paper's gains have 1.3 at 20 kHz, and 15.1 over two periods), below 1e-4 up to 151 and below 2e-4 up
/// to [`MAX_BETA`](Self::MAX_BETA): the tests hold it to that. The time to evaluate does not depend on the argument.
///
/// The grid: up to `start` the function is so nearly straight that one quadratic serves; from there to saturation the
/// segments are of equal width. All quadratics are in the position on the grid itself, not in the distance from their
/// segment's start: the function is so smooth that nothing is lost by that.
#[derive(Clone, Debug)]
#[repr(C)]
pub struct Injection<S: Scalar> {
    per_segment: S::Gain,
    origin: S,
    constant: [S; SEGMENTS],
    linear: [S; SEGMENTS],
    quadratic: [S; SEGMENTS],
}

impl<S: Scalar> Injection<S> {
    /// The largest β that a table is made for: beyond it g is a straight line with two corners that a controller with a
    /// slower loop should not be asked to resolve.
    pub const MAX_BETA: f32 = 2000.0;

    /// Tabulates g for `beta` = h·k/ε, from 0 to [`MAX_BETA`](Self::MAX_BETA), and the boundary layer ε (the caller checks).
    pub fn new(beta: f32, layer: f32) -> Self {
        // Where one quadratic from zero starts to err, and where tanh is 1 to within 4e-5; found by the error tests.
        let start = [0.65 * beta - 10.0, 0.85 * beta - 27.0, 0.92 * beta - 70.0]
            .into_iter()
            .fold(0.25 * beta, f32::max);
        let end = beta + 5.5;
        // A position is v/width + origin, in segments.
        let (width, origin) = if start > 0.0 {
            let width = (end - start) / (LAST - 1) as f32;
            (width, 1.0 - start / width)
        } else {
            (end / LAST as f32, 0.0)
        };
        let node = |position: f32| {
            if position >= LAST as f32 {
                1.0
            } else {
                implicit_tanh((position - origin) * width, beta)
            }
        };
        let mut table = Self {
            per_segment: S::gain(S::SEGMENT / (width * layer)),
            origin: S::from_f32(origin * S::SEGMENT),
            constant: [S::ONE; SEGMENTS],
            linear: [S::ZERO; SEGMENTS],
            quadratic: [S::ZERO; SEGMENTS],
        };
        let entries = table.constant.iter_mut().zip(&mut table.linear).zip(&mut table.quadratic);
        for (index, ((constant, linear), quadratic)) in entries.enumerate().take(LAST) {
            let left = index as f32;
            let [c0, c1, c2] = if index == 0 {
                through_zero(origin, 0.5 * (origin + 1.0), 1.0, node)
            } else {
                parabola(left, node(left), node(left + 0.5), node(left + 1.0))
            };
            *constant = S::from_f32(c0);
            *linear = S::from_f32(c1 / S::SEGMENT);
            *quadratic = S::from_f32(c2 / (S::SEGMENT * S::SEGMENT));
        }
        table
    }

    /// g (dimensionless) of the mismatch σ, in the unit of ε; within ±1e20 of that.
    #[inline]
    pub fn value(&self, mismatch: S) -> S {
        let position = S::combine([(self.per_segment, mismatch.abs())]) + self.origin;
        let segment = position.segment();
        let slope = self.linear[segment] + position * self.quadratic[segment];
        (self.constant[segment] + position * slope).with_sign_of(mismatch)
    }
}

/// The g that solves g = tanh(v − β·g), for v ≥ 0: bisection on w = v − β·g, where w + β·tanh(w) = v.
#[inline(never)]
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

/// Coefficients in x of the rising parabola with these values at x = `left`, `left` + ½ and `left` + 1.
///
/// The middle value is moved, where need be, to where the parabola rises all the way: near saturation it would
/// overshoot 1 otherwise.
fn parabola(left: f32, at_left: f32, at_half: f32, at_right: f32) -> [f32; 3] {
    let low = 0.75 * at_left + 0.25 * at_right;
    let high = 0.25 * at_left + 0.75 * at_right;
    // Not `clamp`: the message of its panic is 18 kB of code.
    let middle = at_half.max(low).min(high);
    let slope = 4.0 * middle - 3.0 * at_left - at_right;
    let curvature = 2.0 * (at_left + at_right) - 4.0 * middle;
    [at_left - left * (slope - left * curvature), slope - 2.0 * left * curvature, curvature]
}

/// Coefficients in x of the parabola that is exactly 0 at x = `zero` and meets `node` at `middle` and `end`.
fn through_zero(zero: f32, middle: f32, end: f32, node: impl Fn(f32) -> f32) -> [f32; 3] {
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
        let injection = Injection::<f32>::new(beta, 1.0);
        let points = 200_000;
        (0..=points)
            .map(|point| {
                let v = (beta + 8.0) * point as f32 / points as f32;
                (f64::from(injection.value(v)) - exact(f64::from(v), f64::from(beta))).abs()
            })
            .fold(0.0, f64::max)
    }

    const BETAS: [f32; 16] = [
        0.0, 0.015, 0.3, 1.3, 7.55, 15.1, 30.0, 45.0, 60.0, 100.0, 151.0, 200.0, 300.0, 755.0,
        1510.0, 2000.0,
    ];

    #[test]
    fn error_is_within_the_stated_bounds() {
        for beta in BETAS {
            let error = worst_error(beta);
            let bound = match beta {
                1.0..=45.0 => 4e-5,
                ..=151.0 => 1e-4,
                _ => 2e-4,
            };
            assert!(error < bound, "beta {beta}: {error:e} is not below {bound:e}");
            // A bound that is never approached says nothing: the quadratics do err.
            assert!(error > 1e-6, "beta {beta}: {error:e} is suspiciously small");
        }
    }

    #[test]
    fn slope_is_within_the_stated_error() {
        for beta in BETAS {
            let injection = Injection::<f32>::new(beta, 1.0);
            let mut worst = 0.0_f64;
            // Over a thousandth of the grid's width, for f32 to resolve the differences.
            let step = (beta + 6.0) / 4_000.0;
            let mut v = step;
            while exact(f64::from(v), f64::from(beta)) < 0.97 {
                let [left, right] = [v - step, v + step];
                let rise = f64::from(injection.value(right)) - f64::from(injection.value(left));
                let [low, high] = [left, right].map(|v| exact(f64::from(v), f64::from(beta)));
                worst = worst.max((rise / (high - low) - 1.0).abs());
                v += step;
            }
            assert!(worst < f64::from(SLOPE_ERROR), "beta {beta}: {worst}");
        }
    }

    #[test]
    fn odd_bounded_and_zero_at_zero() {
        for beta in BETAS {
            let injection = Injection::<f32>::new(beta, 1.0);
            assert_eq!(injection.value(0.0), 0.0, "beta {beta}");
            for step in 0..100_000 {
                let v = (beta + 10.0) * step as f32 / 100_000.0;
                let g = injection.value(v);
                assert_eq!(injection.value(-v).to_bits(), (-g).to_bits());
                assert!((0.0..=1.0 + 1e-6).contains(&g), "beta {beta}: g({v}) = {g}");
            }
            for v in [1e6, 1e20] {
                assert_eq!(injection.value(v), 1.0);
                assert_eq!(injection.value(-v), -1.0);
            }
        }
    }

    #[test]
    fn monotone() {
        for beta in BETAS {
            let injection = Injection::<f32>::new(beta, 1.0);
            let mut before = 0.0;
            for step in 0..100_000 {
                let v = (beta + 10.0) * step as f32 / 100_000.0;
                let g = injection.value(v);
                // Coefficients and sums are rounded.
                assert!(g >= before - 1e-6, "beta {beta}: falls from {before} to {g} at {v}");
                before = g;
            }
        }
    }

    #[test]
    fn solves_the_implicit_equation_in_other_words() {
        // The injected value must put the mismatch where its own tanh is that value: y = v - beta g, tanh(y) = g.
        let injection = Injection::<f32>::new(7.55, 1.0);
        for step in -800..800 {
            let v = step as f32 / 100.0;
            let g = f64::from(injection.value(v));
            let y = f64::from(v) - 7.55 * g;
            // An error of 2e-5 in g moves y by 7.55 times that.
            assert!((y.tanh() - g).abs() < 2e-4, "v {v}: tanh({y}) is not {g}");
        }
    }
}
