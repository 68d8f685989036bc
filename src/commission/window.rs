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

use super::extremes::Extremes;
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
        self.least = self.least.lesser(sign * start);
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
    #[inline(never)]
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

#[cfg(test)]
mod tests {
    use super::*;

    const PERIOD: f32 = 5e-5;

    fn assert_holds((x, y): ([f32; UNKNOWNS], f32), unknowns: [f32; UNKNOWNS]) {
        let explained: f32 = x.iter().zip(unknowns).map(|(x, unknown)| x * unknown).sum();
        assert!((explained / y - 1.0).abs() < 1e-5, "{explained} is not {y}");
    }

    #[test]
    fn an_armatures_row_is_exact_while_the_current_still_changes() {
        let [resistance, lost, back_emf, speed] = [0.7, 1.2, 0.059, 80.0];
        for kept in [0.3_f32, 0.7, 0.99] {
            let held = (1.0 - kept) / resistance;
            let mut window = Window::default();
            let mut current = 1.0;
            for voltage in [9.0, 20.0, 8.0, 7.0, 12.0, 9.5] {
                let next = kept * current + held * (voltage - lost - back_emf * speed);
                let currents = [current, next];
                window.add(&Period { voltage, currents, turned: speed * PERIOD }, 1.0);
                current = next;
            }
            let row = window.armature(0.5, 1.0, PERIOD).expect("large enough");
            assert_holds(row, [resistance, lost, back_emf, 1.0 / held]);
            assert_eq!(window.armature(30.0, 1.0, PERIOD), None);
        }
    }

    #[test]
    fn a_shafts_row_is_exact_whatever_the_current_does() {
        let [per_inertia, coulomb, load] = [742.0, -30.0, 5.0];
        let mut speed = 60.0;
        let mut windows = [Window::default(); 2];
        for (index, current) in [1.0, 2.0, -1.0, 4.0, 3.0, 0.5, 0.1, 2.0].into_iter().enumerate() {
            let gained = (per_inertia * current + coulomb + load) * PERIOD;
            let turned = (speed + 0.5 * gained) * PERIOD;
            let period = Period { voltage: 0.0, currents: [current; 2], turned };
            windows[index / 4].add(&period, 1.0);
            speed += gained;
        }
        let [before, now] = windows;
        let row = now.shaft(&before, 1.0, PERIOD).expect("as long");
        let explained = per_inertia * row.0[0] + coulomb + load;
        // The angle's second difference is of f32's last places.
        assert!((explained / row.1 - 1.0).abs() < 0.01, "{explained} is not {}", row.1);
        assert_eq!(now.shaft(&Window::default(), 1.0, PERIOD), None);
    }
}
