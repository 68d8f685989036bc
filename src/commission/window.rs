//! A window of some periods, and the rows that it gives to the fits.
//!
//! Armature, exact for voltages that are constant over a period, whatever the current does within: summed over the n periods of a
//! window, with R = (1 − Ad)/Bd and Λ = 1/Bd (Ad and Bd as in [`crate::control::drive_form`]),
//!
//! ```text
//! Σu = R·Σi + V0·Σsign(i) + Kb·(Δθ/h) + Λ·(i_n − i_0)
//! ```
//!
//! Shaft: the second difference of the angle over two windows of the same length is the acceleration, weighted by a triangle,
//!
//! ```text
//! (Δθ₂ − Δθ₁)/(n·h)² = (Kb/J)·ī − (b/J)·ω̄ − (T_c/J)·sign(ω) − T_l/J
//! ```
//!
//! with ī and ω̄ weighted by the same triangle. Both hold for any run of the current: nothing has to settle first.

use super::fit::UNKNOWNS;

/// A period between two samples.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Period {
    /// Armature voltage that acted (V).
    pub voltage: f32,
    /// Current at its start and end (A).
    pub currents: [f32; 2],
    /// What the shaft turned (rad).
    pub turned: f32,
}

/// A sum, and the same with weights that fall from n − ½ to ½ over a window.
#[derive(Clone, Copy, Debug, Default)]
struct Weighted {
    plain: f32,
    falling: f32,
}

impl Weighted {
    fn add(&mut self, term: f32) {
        self.falling += self.plain + 0.5 * term;
        self.plain += term;
    }

    fn rising(&self, periods: f32) -> f32 {
        periods * self.plain - self.falling
    }
}

/// Sums over a window.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Window {
    pub periods: f32,
    voltage: f32,
    /// Of the currents at the periods' starts.
    current: f32,
    /// Of their means.
    mean_current: Weighted,
    turned: Weighted,
    /// The first and the last current (A).
    ends: [f32; 2],
    /// The smallest current in the direction that was asked for (A).
    least: f32,
}

impl Window {
    /// Takes a period in which a current of this sign (±1) was asked for.
    pub(super) fn add(&mut self, period: &Period, sign: f32) {
        let [start, end] = period.currents;
        if self.periods == 0.0 {
            self.ends[0] = start;
            self.least = f32::INFINITY;
        }
        self.ends[1] = end;
        self.least = self.least.min(sign * start);
        self.periods += 1.0;
        self.voltage += period.voltage;
        self.current += start;
        self.mean_current.add(0.5 * (start + end));
        self.turned.add(period.turned);
    }

    /// What the shaft turned (rad).
    pub(super) fn turned(&self) -> f32 {
        self.turned.plain
    }

    /// The armature's row for R, V0, Kb and Λ, as means over the window. Nothing if the current was less than `least` at some
    /// time, where the voltage lost is not that of the sign.
    pub(super) fn armature(
        &self,
        least: f32,
        sign: f32,
        period: f32,
    ) -> Option<([f32; UNKNOWNS], f32)> {
        if self.least < least || self.periods == 0.0 {
            return None;
        }
        let per = 1.0 / self.periods;
        let [first, last] = self.ends;
        let speed = self.turned.plain * per / period;
        Some(([self.current * per, sign, speed, (last - first) * per], self.voltage * per))
    }

    /// The shaft's row for Kb/J, −b/J, −T_c/J and −T_l/J, with the window before, which must be as long, where the shaft turned in the
    /// direction of `sign` (±1) all the time.
    pub(super) fn shaft(
        &self,
        before: &Self,
        sign: f32,
        period: f32,
    ) -> Option<([f32; UNKNOWNS], f32)> {
        if before.periods != self.periods || self.periods == 0.0 {
            return None;
        }
        let per = 1.0 / (self.periods * self.periods);
        let tip =
            |before: &Weighted, now: &Weighted| per * (before.rising(self.periods) + now.falling);
        let current = tip(&before.mean_current, &self.mean_current);
        let speed = tip(&before.turned, &self.turned) / period;
        let gained = self.turned.plain - before.turned.plain;
        Some(([current, speed, sign, 1.0], per * gained / (period * period)))
    }
}
