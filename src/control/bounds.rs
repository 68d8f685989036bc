//! Ultimate bounds of the estimation and tracking errors (Eqs. 15, 32, 33, 36, 56, 57, 61), the paper's and corrected.
//!
//! The paper bounds the estimation error by ε·|ḋ|/k (32, 56), taking the slope of the tanh at zero, where it is
//! steepest; simulation exceeds that. Quasi-statically d̂ = k·tanh(x̃/ε) must equal d, where the slope is only
//! (k/ε)·(1 − (d/k)²), so that
//!
//! ```text
//! |d̃| ≤ sup over t of ε·|ḋ(t)| / (k·(1 − (d(t)/k)²))
//! ```
//!
//! and likewise for ζ2 with k2, ε2. Only with |d| < k does any bound hold: the functions give infinity otherwise.
//! These are for studies and for choosing gains; nothing here runs in the loop.

/// The paper's bound on |d̃| (Eqs. 32, 56; for |ζ̃2| with k2, ε2: Eqs. 33, 57), from the boundary layer ε, the injection
/// strength k, and the largest rate |ḋ|. Too small: simulation exceeds it.
pub fn estimation_paper(layer: f32, strength: f32, rate: f32) -> f32 {
    layer * rate.abs() / strength
}

/// The corrected bound at one instant, from d and ḋ there; its supremum over time bounds |d̃|.
///
/// With the suprema of |d| and |ḋ| put in at once it is safe without knowing the time course, but several times larger.
pub fn estimation(layer: f32, strength: f32, value: f32, rate: f32) -> f32 {
    let share = value / strength;
    if share.abs() < 1.0 {
        estimation_paper(layer, strength, rate) / (1.0 - share * share)
    } else {
        f32::INFINITY
    }
}

/// What sampling adds to the bound: with the implicit form the estimate is one period `period` old at worst, half a
/// period on average.
pub fn sampling(period: f32, rate: f32) -> f32 {
    period * rate.abs()
}

/// Bound on ‖(z1, z2)‖ with an estimator (Eqs. 36, 61), from the suprema of |d̃| and |ζ̃2| and the convergence rate c.
pub fn tracking(disturbance_error: f32, lumped_error: f32, c: f32) -> f32 {
    libm::hypotf(disturbance_error, lumped_error) / c
}

/// Bound on ‖(z1, z2)‖ in plain backstepping (Eq. 15, ϑ → 1), from the supremum of |d|, with ζ1 = (c − a1)·d.
///
/// Erratum: the paper has ζ1 = (a1 + c)·d, from the sign of a1·ω in (4).
pub fn tracking_backstepping(disturbance: f32, c: f32, a1: f32) -> f32 {
    tracking(disturbance, (c - a1) * disturbance, c)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn corrected_bound_is_the_papers_over_the_remaining_slope() {
        assert_eq!(estimation_paper(0.05, 1300.0, -2600.0), 0.1);
        assert_eq!(estimation(0.05, 1300.0, 0.0, 2600.0), 0.1);
        let half = estimation(0.05, 1300.0, -650.0, 2600.0);
        assert!((half - 0.1 / 0.75).abs() < 1e-7, "{half}");
    }

    #[test]
    fn no_bound_without_authority() {
        assert_eq!(estimation(0.05, 1300.0, 1300.0, 1.0), f32::INFINITY);
        assert_eq!(estimation(0.05, 1300.0, -2000.0, 0.0), f32::INFINITY);
    }

    #[test]
    fn tracking_bounds() {
        assert_eq!(tracking(3.0, 4.0, 200.0), 0.025);
        assert_eq!(tracking_backstepping(3.0, 4.0 / 3.0, 0.0), 5.0 / (4.0 / 3.0));
    }
}
