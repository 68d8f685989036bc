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

use crate::config::ConfigError;
use crate::math::table::Curve;
use crate::math::{Base, Scalar, tanh};

/// Largest relative error of the tabulated slope of g, where |g| is below 0.97.
pub const SLOPE_ERROR: f32 = 0.015;

/// The injection g(v), tabulated by one quadratic per segment for one β and ε.
///
/// Odd to the bit, rising, and within ±1 (the last two to 1e-6, for rounding). The error is below
/// 4e-5 for β from 1 to 45 (the paper's gains have 1.3 at 20 kHz, and 15.1 over two periods), below 1e-4 up to 151 and below 2e-4 up
/// to [`MAX_BETA`]: the tests hold it to that. The time to evaluate does not depend on the argument.
///
/// In fixed point, on a grid of equal segments, it is below 6e-5 for β up to 45, and 3e-3 at most, beside
/// what rounding of the mismatch does.
#[derive(Clone, Copy, Debug)]
pub struct Injection<S: Scalar>(S::Table);

/// The largest β that a table is made for: beyond it g is a straight line with two corners that a controller with a slower loop
/// should not be asked to resolve.
pub const MAX_BETA: f32 = 2000.0;

/// The injections of a controller's first and second channel.
///
/// They are large, and so apart from the controllers, which are passed on while they are built; these are filled where they are.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Injections<S: Scalar> {
    /// Of the disturbance.
    pub first: Injection<S>,
    /// Of what the armature's model lacks.
    pub second: Injection<S>,
}

impl<S: Scalar> Injections<S> {
    /// Of a controller that has none.
    pub const NONE: Self = Self { first: Injection::NONE, second: Injection::NONE };
}

impl<S: Scalar> Injection<S> {
    /// Nothing tabulated yet.
    pub const NONE: Self = Self(S::NO_TABLE);

    /// Tabulates g for `beta` = h·k/ε, from 0 to [`MAX_BETA`] (the caller checks), and the boundary layer ε, named `field`, of a
    /// signal with this base.
    pub fn tabulate(
        &mut self,
        field: &'static str,
        beta: f32,
        layer: f32,
        base: Base,
    ) -> Result<(), ConfigError> {
        // Where one quadratic from zero starts to err, and where tanh is 1 to within 4e-5; found by the error tests.
        let start = [0.65 * beta - 10.0, 0.85 * beta - 27.0, 0.92 * beta - 70.0]
            .into_iter()
            .fold(0.25 * beta, f32::max);
        let value = |v| implicit_tanh(v, beta);
        let curve = Curve { start, end: beta + 5.5, unit: layer, value: &value };
        S::tabulate(&mut self.0, field, &curve, base)
    }

    /// g (a ratio) of the mismatch σ, in the unit of ε; within ±1e20 of that.
    #[inline]
    pub fn value(&self, mismatch: S) -> S {
        S::look_up(&self.0, mismatch)
    }
}

/// The g that solves g = tanh(v − β·g), for v ≥ 0: with w = v − β·g, w + β·tanh(w) = v. The left side is concave, so that Newton's
/// steps from 0 come up to the root from below, until rounding ends them.
#[inline(never)]
fn implicit_tanh(v: f32, beta: f32) -> f32 {
    let mut w = 0.0;
    for _ in 0..MOST_STEPS {
        let g = tanh(w);
        let better = w + (v - w - beta * g) / (1.0 + beta * (1.0 - g * g));
        if better <= w {
            return g;
        }
        w = better;
    }
    tanh(w)
}

/// Newton's steps at most; far fewer are taken.
const MOST_STEPS: usize = 40;

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Q31;

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

    /// Of a signal whose full scale is many layers, as in a drive.
    const BASE: Base = Base(20_000.0);

    fn injection<S: Scalar>(beta: f32) -> Injection<S> {
        let mut injection = Injection::NONE;
        injection.tabulate("layer", beta, 1.0, BASE).expect("valid");
        injection
    }

    fn worst_error<S: Scalar>(beta: f32) -> f64 {
        let injection = injection::<S>(beta);
        let points = 200_000;
        (0..=points)
            .map(|point| {
                let v = (beta + 8.0) * point as f32 / points as f32;
                let g = injection.value(S::from_f32(v, BASE)).to_f32(Base::RATIO);
                (f64::from(g) - exact(f64::from(v), f64::from(beta))).abs()
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
            let error = worst_error::<f32>(beta);
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
    fn fixed_point_is_within_its_bounds() {
        for beta in BETAS {
            let error = worst_error::<Q31>(beta);
            let bound = match beta {
                ..=45.0 => 6e-5,
                ..=151.0 => 4e-4,
                _ => 3e-3,
            };
            assert!(error < bound, "beta {beta}: {error:e} is not below {bound:e}");
            // Odd, rising and bounded to the bit.
            let injection = injection::<Q31>(beta);
            assert_eq!(injection.value(Q31::ZERO), Q31::ZERO);
            let mut before = Q31::ZERO;
            for step in 0..20_000 {
                let v = Q31::from_f32((beta + 10.0) * step as f32 / 20_000.0, BASE);
                let g = injection.value(v);
                assert_eq!(injection.value(-v), -g);
                assert!(g.0 >= before.0 - 4096 && g.0 <= (1 << 30) + 1024, "beta {beta}: {g:?}");
                before = g;
            }
            assert_eq!(injection.value(Q31(i32::MAX)).0, 1 << 30);
            assert_eq!(injection.value(Q31(-i32::MAX)).0, -(1 << 30));
        }
    }

    #[test]
    fn slope_is_within_the_stated_error() {
        for beta in BETAS {
            let injection = injection::<f32>(beta);
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
            let injection = injection::<f32>(beta);
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
            let injection = injection::<f32>(beta);
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
        let injection = injection::<f32>(7.55);
        for step in -800..800 {
            let v = step as f32 / 100.0;
            let g = f64::from(injection.value(v));
            let y = f64::from(v) - 7.55 * g;
            // An error of 2e-5 in g moves y by 7.55 times that.
            assert!((y.tanh() - g).abs() < 2e-4, "v {v}: tanh({y}) is not {g}");
        }
    }
}
