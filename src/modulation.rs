//! From a duty to the two legs of the bridge.
//!
//! Both legs are pulse-width modulated about the same centre, each with its high side on for a share of the period and with its
//! low side on for the rest. The motor sees the difference of the shares. Their mean is free, and chosen so that
//!
//! - both low sides are on together around the centre of every period: low-side shunts show the motor's current only then, and
//!   a bootstrap capacitor is charged only while its low side is on;
//! - near zero both edges move about the middle, so that the bridge's dead time weighs on both signs alike, and the ripple has
//!   twice the PWM frequency.
//!
//! Locked antiphase (shares d and 1 − d) would never have both low sides on.

/// The shares of the period, from 0 to `highest`, for which the high sides of the first and second leg are on.
///
/// `duty` is the mean armature voltage as a share of the bus voltage, positive from the first leg to the second, within
/// ±`highest`; `highest` is below 1: the rest of the period is the window for sampling and bootstraps.
#[inline]
pub fn legs(duty: f32, highest: f32) -> [f32; 2] {
    let half = 0.5 * duty;
    let left = highest - half.abs();
    let common = if left < 0.5 { left } else { 0.5 };
    [common + half, common - half]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_difference_is_the_duty_and_the_window_stays_open() {
        const HIGHEST: f32 = 0.92;
        for step in -920..=920 {
            let duty = step as f32 / 1000.0;
            let shares = legs(duty, HIGHEST);
            assert!((shares[0] - shares[1] - duty).abs() < 2e-7, "{duty}: {shares:?}");
            for share in shares {
                // A rounding error below zero is cut by the comparison registers.
                assert!((-2e-7..=HIGHEST + 2e-7).contains(&share), "{duty}: {shares:?}");
            }
        }
        // About the middle as long as there is room.
        assert_eq!(legs(0.5, HIGHEST), [0.75, 0.25]);
        assert_eq!(legs(0.0, HIGHEST), [0.5, 0.5]);
        assert_eq!(legs(-0.92, HIGHEST), [0.0, 0.92]);
    }
}
