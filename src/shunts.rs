//! The armature current from low-side shunts in both legs of the bridge.
//!
//! While both low sides are on, the current that leaves one leg enters the other: two converters show it with opposite signs.
//! Their difference is the current, with half the noise power of one; their sum is no current at all, and so tells whether both
//! work. What they show at no current is learnt whenever the bridge is off.

/// Fractions of a code that are kept: codes times 8.
const SCALE: u16 = 8;

/// Periods that a zero is averaged over. With outputs off for that long the next one replaces it.
const AVERAGED: u16 = 1024;

/// Averages that may be implausible in a row before that is a fault: an amplifier settles, a motor stops.
const ATTEMPTS: u8 = 8;

/// Periods in a row in which the shunts may disagree.
const DISAGREEMENTS: u8 = 3;

/// What the two converters are like.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ShuntConfig {
    /// Code at no current, by the circuit's nominal values.
    pub nominal_zero: u16,
    /// How far from that (codes) the learnt one may be.
    pub zero_tolerance: u16,
    /// By how many codes the two converters may disagree about a current.
    pub disagreement: u16,
    /// Highest code of the converters.
    pub highest_code: u16,
}

impl ShuntConfig {
    /// The code of [`Codes::current`](crate::hal::Codes::current) at no current: as much as the smaller side of the converters'
    /// range, of both legs together, so that no code stands for a current beyond it.
    pub const fn zero(&self) -> u16 {
        let above = self.highest_code - self.nominal_zero;
        let smaller = if above < self.nominal_zero { above } else { self.nominal_zero };
        2 * SCALE * smaller
    }

    /// Codes of [`Codes::current`](crate::hal::Codes::current) per code of one converter.
    pub const CODES_PER_CODE: u16 = 2 * SCALE;
}

/// What is known of the current sensors.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum CurrentSensors {
    /// Their zero is not known yet.
    Learning,
    /// They work.
    Good,
    /// Their zero is out of its range, or does not settle.
    BadZero,
    /// They disagree.
    Disagree,
}

/// The two shunts.
#[derive(Clone, Debug)]
pub struct Shunts {
    config: ShuntConfig,
    /// Code at no current, and the largest sum of both legs' (scaled codes).
    zero: i32,
    disagreement: u32,
    /// Scaled codes at no current.
    zeros: [u16; 2],
    sums: [u32; 2],
    summed: u16,
    failures: u8,
    disagreements: u8,
    state: CurrentSensors,
}

impl Shunts {
    /// With nothing learnt.
    pub const fn new(config: ShuntConfig) -> Self {
        Self {
            config,
            zero: config.zero() as i32,
            disagreement: config.disagreement as u32 * SCALE as u32,
            zeros: [config.nominal_zero * SCALE; 2],
            sums: [0; 2],
            summed: 0,
            failures: 0,
            disagreements: 0,
            state: CurrentSensors::Learning,
        }
    }

    /// A period's codes: of the first leg, whose shunt shows the armature current with a minus, and of the second. Gives the
    /// code for [`Codes::current`](crate::hal::Codes::current). `is_on` tells whether the bridge was on when they were sampled.
    #[inline]
    pub fn read(&mut self, codes: [u16; 2], is_on: bool) -> u16 {
        if is_on {
            self.compare(codes);
        } else {
            self.learn(codes);
        }
        let [first, second] = self.differences(codes);
        // Not `clamp`, which panics where it cannot see that its bounds are in order.
        (self.zero + second - first).max(0).min(2 * self.zero) as u16
    }

    /// Whether the sensors work.
    #[inline]
    pub fn state(&self) -> CurrentSensors {
        self.state
    }

    fn differences(&self, codes: [u16; 2]) -> [i32; 2] {
        let difference = |leg: usize| i32::from(codes[leg] * SCALE) - i32::from(self.zeros[leg]);
        [difference(0), difference(1)]
    }

    fn compare(&mut self, codes: [u16; 2]) {
        // An average must not span a time with outputs on.
        self.sums = [0; 2];
        self.summed = 0;
        let [first, second] = self.differences(codes);
        let disagree = (first + second).unsigned_abs() > self.disagreement;
        self.disagreements = if disagree { self.disagreements.saturating_add(1) } else { 0 };
        if self.disagreements >= DISAGREEMENTS {
            self.state = CurrentSensors::Disagree;
        }
    }

    fn learn(&mut self, codes: [u16; 2]) {
        self.disagreements = 0;
        for (sum, code) in self.sums.iter_mut().zip(codes) {
            *sum += u32::from(code);
        }
        self.summed += 1;
        if self.summed < AVERAGED {
            return;
        }
        let zeros = self.sums.map(|sum| (sum / u32::from(AVERAGED / SCALE)) as u16);
        self.sums = [0; 2];
        self.summed = 0;
        let ShuntConfig { nominal_zero, zero_tolerance, .. } = self.config;
        let is_plausible =
            |zero: &u16| zero.abs_diff(nominal_zero * SCALE) <= zero_tolerance * SCALE;
        if zeros.iter().all(is_plausible) {
            self.zeros = zeros;
            self.failures = 0;
            self.state = CurrentSensors::Good;
        } else {
            self.failures = self.failures.saturating_add(1);
            if self.failures >= ATTEMPTS {
                self.state = CurrentSensors::BadZero;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const CONFIG: ShuntConfig = ShuntConfig {
        nominal_zero: 2553,
        zero_tolerance: 150,
        disagreement: 100,
        highest_code: 4095,
    };

    /// Shunts that have learnt zeros of 2600 and 2500.
    fn learnt() -> Shunts {
        let mut shunts = Shunts::new(CONFIG);
        for _ in 0..AVERAGED {
            assert_eq!(shunts.state(), CurrentSensors::Learning);
            shunts.read([2600, 2500], false);
        }
        assert_eq!(shunts.state(), CurrentSensors::Good);
        shunts
    }

    #[test]
    fn the_current_is_half_the_difference_from_the_learnt_zeros() {
        let mut shunts = learnt();
        let zero = i32::from(CONFIG.zero());
        for current in [-1500, -100, 0, 1, 100, 1500] {
            let codes = [2600 - current, 2500 + current].map(|code| code.clamp(0, 4095) as u16);
            let code = i32::from(shunts.read(codes, true)) - zero;
            // Both legs moved by `current` codes.
            let expected = current * i32::from(ShuntConfig::CODES_PER_CODE);
            if current.abs() < 1495 {
                assert_eq!(code, expected, "{current}");
            }
        }
        assert_eq!(shunts.state(), CurrentSensors::Good);
    }

    #[test]
    fn a_zero_between_two_codes_is_kept() {
        let mut shunts = Shunts::new(CONFIG);
        for period in 0..AVERAGED {
            shunts.read([2553 + u16::from(period % 4 == 0), 2553], false);
        }
        // A quarter of a code of one leg: two of eight.
        assert_eq!(shunts.read([2553, 2553], true), CONFIG.zero() + 2);
    }

    #[test]
    fn codes_stay_in_range_at_the_converters_ends() {
        let mut shunts = learnt();
        assert_eq!(shunts.read([0, 4095], true), 2 * CONFIG.zero());
        assert_eq!(shunts.read([4095, 0], true), 0);
        assert_eq!(CONFIG.zero(), 2 * 8 * 1542);
    }

    #[test]
    fn zeros_out_of_range_are_refused_after_some_attempts() {
        let mut shunts = Shunts::new(CONFIG);
        for _ in 0..u32::from(AVERAGED) * (u32::from(ATTEMPTS) - 1) {
            shunts.read([2553, 2704], false);
        }
        assert_eq!(shunts.state(), CurrentSensors::Learning);
        for _ in 0..AVERAGED {
            shunts.read([2553, 2704], false);
        }
        assert_eq!(shunts.state(), CurrentSensors::BadZero);
        // Just within, they are taken, even then.
        for _ in 0..AVERAGED {
            shunts.read([2403, 2703], false);
        }
        assert_eq!(shunts.state(), CurrentSensors::Good);
    }

    #[test]
    fn shunts_that_disagree_are_told_and_a_spike_is_not() {
        let mut shunts = learnt();
        let (agree, disagree) = ([2500, 2600], [2500, 2701]);
        for _ in 0..10 {
            shunts.read(disagree, true);
            shunts.read(disagree, true);
            shunts.read(agree, true);
        }
        assert_eq!(shunts.state(), CurrentSensors::Good);
        for _ in 0..DISAGREEMENTS {
            shunts.read(disagree, true);
        }
        assert_eq!(shunts.state(), CurrentSensors::Disagree);
    }

    #[test]
    fn nothing_is_learnt_while_the_bridge_is_on() {
        let mut shunts = learnt();
        for period in 0..4 * AVERAGED {
            shunts.read([2650, 2450], period % 1000 != 0);
        }
        assert_eq!(shunts.read([2600, 2500], true), CONFIG.zero());
    }
}
