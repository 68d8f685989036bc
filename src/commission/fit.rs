//! Weighted least squares for up to four unknowns, in closed form from running sums.

use super::extremes::Extremes;
use crate::math::sqrt;
use serde::{Deserialize, Serialize};

/// Unknowns that a fit has room for. A column that stays zero is none.
pub(super) const UNKNOWNS: usize = 4;

/// Share of a column that must be independent of those before it for its unknown to be seen (squared). Rounding of `f32` is a
/// hundred times less.
const INDEPENDENT: f32 = 1e-5;

/// Least mean square of the residuals, as a share of that of what is explained: below it rounding is all that is left.
const ROUNDING: f32 = 1e-6;

/// A sum that keeps what rounding takes from it (Kahan): exact to a last place, however many terms it has.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Sum {
    value: f32,
    lost: f32,
}

impl Sum {
    pub(super) fn add(&mut self, term: f32) {
        let term = term - self.lost;
        let sum = self.value + term;
        self.lost = (sum - self.value) - term;
        self.value = sum;
    }

    pub(super) fn value(&self) -> f32 {
        self.value
    }
}

/// The normal equations of y = Σ x·unknown.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Fit {
    /// Σ xᵢ·xⱼ for j ≤ i.
    products: [[Sum; UNKNOWNS]; UNKNOWNS],
    /// Σ xᵢ·y.
    moments: [Sum; UNKNOWNS],
    /// Σ y².
    squares: Sum,
    rows: f32,
}

/// Unknowns with their standard deviations; of one that the rows do not show the value is 0 and the deviation infinite.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub(super) struct Solution {
    pub values: [f32; UNKNOWNS],
    pub deviations: [f32; UNKNOWNS],
}

impl Fit {
    /// Takes a row.
    pub(super) fn add(&mut self, x: [f32; UNKNOWNS], y: f32) {
        for i in 0..UNKNOWNS {
            for j in 0..=i {
                self.products[i][j].add(x[i] * x[j]);
            }
            self.moments[i].add(x[i] * y);
        }
        self.squares.add(y * y);
        self.rows += 1.0;
    }

    /// Solves for the unknowns. `noise` is the variance of the noise in each column, which else would pull its unknown towards
    /// zero.
    pub(super) fn solve(&self, noise: [f32; UNKNOWNS]) -> Solution {
        let factors = self.factors(noise);
        let values = factors.solve(self.moments.map(|sum| sum.value()));
        let mut explained = 0.0;
        let mut seen = 0.0;
        for i in 0..UNKNOWNS {
            explained += values[i] * (self.moments[i].value() - values[i] * noise[i] * self.rows);
            seen += if factors.per_pivot[i] > 0.0 { 1.0 } else { 0.0 };
        }
        let squares = self.squares.value();
        let freedom = (self.rows - seen).greater(1.0);
        let variance =
            ((squares - explained) / freedom).greater(ROUNDING * squares / self.rows.greater(1.0));
        let mut deviations = [f32::INFINITY; UNKNOWNS];
        for (i, deviation) in deviations.iter_mut().enumerate() {
            if factors.per_pivot[i] > 0.0 {
                *deviation = sqrt(variance * factors.inverse(i));
            }
        }
        Solution { values, deviations }
    }

    #[expect(clippy::needless_range_loop, reason = "rows and columns of matrices")]
    fn factors(&self, noise: [f32; UNKNOWNS]) -> Factors {
        let mut factors = Factors::default();
        for i in 0..UNKNOWNS {
            // Row i of the unit lower triangle, times the pivots first.
            let mut scaled = [0.0; UNKNOWNS];
            for j in 0..i {
                let mut rest = self.products[i][j].value();
                for k in 0..j {
                    rest -= scaled[k] * factors.lower[j][k];
                }
                scaled[j] = rest;
                factors.lower[i][j] = rest * factors.per_pivot[j];
            }
            let whole = self.products[i][i].value();
            let mut pivot = whole - noise[i] * self.rows;
            for k in 0..i {
                pivot -= scaled[k] * factors.lower[i][k];
            }
            factors.per_pivot[i] = if pivot > INDEPENDENT * whole { 1.0 / pivot } else { 0.0 };
        }
        factors
    }
}

/// L and D⁻¹ of a symmetric matrix L·D·Lᵀ; a zero in D⁻¹ leaves that unknown out.
#[derive(Clone, Copy, Debug, Default)]
struct Factors {
    lower: [[f32; UNKNOWNS]; UNKNOWNS],
    per_pivot: [f32; UNKNOWNS],
}

impl Factors {
    /// The inverse's element i in the diagonal: (L⁻¹)ᵀ·D⁻¹·L⁻¹, of which it takes column i of L⁻¹.
    fn inverse(&self, i: usize) -> f32 {
        let mut column = [0.0; UNKNOWNS];
        column[i] = 1.0;
        let mut sum = self.per_pivot[i];
        for row in i + 1..UNKNOWNS {
            for j in i..row {
                column[row] -= self.lower[row][j] * column[j];
            }
            sum += column[row] * column[row] * self.per_pivot[row];
        }
        sum
    }

    fn solve(&self, mut x: [f32; UNKNOWNS]) -> [f32; UNKNOWNS] {
        for i in 0..UNKNOWNS {
            for j in 0..i {
                x[i] -= self.lower[i][j] * x[j];
            }
        }
        for i in (0..UNKNOWNS).rev() {
            x[i] *= self.per_pivot[i];
            // An unknown that is left out must not be told by the others.
            if self.per_pivot[i] > 0.0 {
                for j in i + 1..UNKNOWNS {
                    x[i] -= self.lower[j][i] * x[j];
                }
            }
        }
        x
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const NO_NOISE: [f32; UNKNOWNS] = [0.0; UNKNOWNS];

    /// Numbers from −1 to 1 in no order.
    fn shuffled(seed: &mut u32) -> f32 {
        *seed = seed.wrapping_mul(1_664_525).wrapping_add(1_013_904_223);
        (*seed >> 8) as f32 / (1 << 23) as f32 - 1.0
    }

    #[test]
    fn a_sum_loses_nothing() {
        let mut sum = Sum::default();
        for _ in 0..10_000_000 {
            sum.add(0.1);
        }
        // A plain one ends 9 % wrong.
        assert!((sum.value() - 1e6).abs() < 0.1, "{sum:?}");
    }

    #[test]
    fn four_unknowns_of_very_different_size() {
        let truth = [0.7, 1.2, 0.059, 2.5];
        let mut fit = Fit::default();
        let mut seed = 1;
        for _ in 0..20_000 {
            let x = [3.0, 1.0, 200.0, 0.01].map(|scale: f32| scale * shuffled(&mut seed));
            let y: f32 = x.iter().zip(truth).map(|(x, unknown)| x * unknown).sum();
            fit.add(x, y + 0.05 * shuffled(&mut seed));
        }
        let Solution { values, deviations } = fit.solve(NO_NOISE);
        for (unknown, truth) in truth.into_iter().enumerate() {
            let error = (values[unknown] - truth).abs();
            assert!(error < 3.0 * deviations[unknown], "{unknown}: {error}, {deviations:?}");
        }
        // 0.05/√3 of noise, over √20000 rows of 3/√3.
        let expected = 0.05 / 3.0 / 20_000_f32.sqrt();
        assert!((deviations[0] / expected - 1.0).abs() < 0.03, "{deviations:?}");
    }

    #[test]
    fn what_rows_do_not_show_is_left_out() {
        let mut fit = Fit::default();
        let mut seed = 1;
        for _ in 0..100 {
            let [a, b] = [shuffled(&mut seed), shuffled(&mut seed)];
            // The second column is the first again, the third is empty.
            fit.add([a, 2.0 * a, 0.0, b], 3.0 * a + 5.0 * b);
        }
        let Solution { values, deviations } = fit.solve(NO_NOISE);
        assert!((values[0] - 3.0).abs() < 1e-4 && (values[3] - 5.0).abs() < 1e-4, "{values:?}");
        assert_eq!(values[1..3], [0.0, 0.0]);
        assert!(deviations[1].is_infinite() && deviations[2].is_infinite(), "{deviations:?}");
        let Solution { values, deviations } = Fit::default().solve(NO_NOISE);
        assert_eq!((values, deviations), ([0.0; 4], [f32::INFINITY; 4]));
    }

    #[test]
    fn noise_in_a_column_does_not_pull_its_unknown() {
        let mut fit = Fit::default();
        let mut seed = 1;
        for _ in 0..50_000 {
            let x = shuffled(&mut seed);
            fit.add([x + 0.5 * shuffled(&mut seed), 0.0, 0.0, 0.0], 2.0 * x);
        }
        // Pulled to 2·(1/3)/(1/3 + 1/12).
        let pulled = fit.solve(NO_NOISE).values[0];
        assert!((pulled - 1.6).abs() < 0.02, "{pulled}");
        let right = fit.solve([0.25 / 3.0, 0.0, 0.0, 0.0]).values[0];
        assert!((right - 2.0).abs() < 0.02, "{right}");
    }
}
