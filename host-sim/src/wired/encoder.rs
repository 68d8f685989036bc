//! The encoder's two signals, and what goes wrong with them.

use crate::sensors::Disc;
use std::num::NonZeroU32;

/// Where the shaft's angle zero is between two edges (counts): a motor at rest there is not on an edge.
const PHASE: f64 = 0.5;

/// What is wrong with an encoder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum EncoderFault {
    /// Its plug is off: both signals are high by the board's pull-ups.
    Unplugged,
    /// Its signals stay as they are.
    Frozen,
    /// A and B have changed places.
    Reversed,
    /// So many counts are lost, whichever way it turns, and no more.
    Lost(NonZeroU32),
    /// The disc is dirty: each so many-th count is lost.
    EachLost(NonZeroU32),
    /// A disturbance on its wires has made so many counts at once.
    Burst(i64),
}

/// An encoder on a shaft.
#[derive(Clone, Debug)]
pub struct Encoder {
    disc: Disc,
    /// Angle of a count (rad).
    count: f64,
    fault: Option<EncoderFault>,
    /// The disc's count at the last look.
    seen: i64,
    edges: i64,
    /// Counts that are still to be lost.
    to_lose: i64,
}

impl Encoder {
    /// With the shaft at angle zero.
    pub(crate) fn new(disc: Disc, counts_per_turn: u32) -> Self {
        let count = std::f64::consts::TAU / f64::from(counts_per_turn);
        let seen = disc.count(PHASE * count);
        Self { disc, count, fault: None, seen, edges: 0, to_lose: 0 }
    }

    /// Edges of both signals up to now, the shaft being at an angle (rad); positive where A led B.
    pub fn edges(&mut self, angle: f64) -> i64 {
        let seen = self.disc.count(angle + PHASE * self.count);
        let before = std::mem::replace(&mut self.seen, seen);
        let moved = seen - before;
        self.edges += match self.fault {
            None | Some(EncoderFault::Burst(_)) => moved,
            Some(EncoderFault::Unplugged | EncoderFault::Frozen) => 0,
            Some(EncoderFault::Reversed) => -moved,
            Some(EncoderFault::Lost(_)) => {
                let lost = moved.clamp(-self.to_lose, self.to_lose);
                self.to_lose -= lost.abs();
                moved - lost
            }
            Some(EncoderFault::EachLost(each)) => {
                let each = i64::from(each.get());
                moved - (seen.div_euclid(each) - before.div_euclid(each))
            }
        };
        self.edges
    }

    /// From here on, at an angle (rad), this is wrong with it.
    pub fn set_fault(&mut self, angle: f64, fault: Option<EncoderFault>) {
        let edges = self.edges(angle);
        if fault == self.fault {
            return;
        }
        if fault == Some(EncoderFault::Unplugged) {
            // Signals at rest are low at count 0; A rises first. Both are pulled up: where one was low, that is an edge; where both
            // were they rise together, and that counts neither way.
            self.edges += match edges.rem_euclid(4) {
                1 => 1,
                3 => -1,
                _ => 0,
            };
        }
        if let Some(EncoderFault::Burst(counts)) = fault {
            self.edges += counts;
        }
        self.to_lose = match fault {
            Some(EncoderFault::Lost(counts)) => i64::from(counts.get()),
            _ => 0,
        };
        self.fault = fault;
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::sensors::SensorsTable;
    use rand::SeedableRng;
    use rand::rngs::StdRng;
    use std::f64::consts::TAU;

    /// 400 counts a turn.
    fn encoder(reversed: bool) -> Encoder {
        let table = SensorsTable {
            counts_per_turn: 400,
            encoder_reversed: reversed,
            ..SensorsTable::default()
        };
        Encoder::new(Disc::new(&table, &mut StdRng::seed_from_u64(1)), 400)
    }

    /// Edges after the shaft went to a place (counts), in steps of a third of a count.
    fn turn(encoder: &mut Encoder, from: i32, to: i32) -> i64 {
        let sign = (to - from).signum();
        for third in 0..=3 * (to - from).abs() {
            encoder.edges(f64::from(3 * from + sign * third) / 3.0 * TAU / 400.0);
        }
        encoder.edges(f64::from(to) * TAU / 400.0)
    }

    fn few(counts: u32) -> NonZeroU32 {
        NonZeroU32::new(counts).expect("not zero")
    }

    #[test]
    fn edges_are_the_floor_of_the_angle() {
        let mut encoder = encoder(false);
        let mut at = |counts: f64| encoder.edges(counts * TAU / 400.0);
        // Angle zero is half a count beyond an edge.
        assert_eq!([at(0.0), at(0.49), at(0.51), at(1.49), at(1.51)], [0, 0, 1, 1, 2]);
        assert_eq!([at(400.0), at(0.0), at(-0.49), at(-0.51)], [400, 0, 0, -1]);
    }

    #[test]
    fn a_reversed_encoder_counts_down() {
        assert_eq!(turn(&mut encoder(true), 0, 100), -100);
    }

    #[test]
    fn faults_act_from_where_they_start_to_where_they_end() {
        use EncoderFault::{Burst, EachLost, Frozen, Lost, Reversed, Unplugged};
        let cases = [
            (Unplugged, 100),
            (Frozen, 100),
            (Reversed, 0),
            (Lost(few(7)), 193),
            (EachLost(few(5)), 180),
            (Burst(50), 250),
        ];
        for (fault, expected) in cases {
            let mut encoder = encoder(false);
            turn(&mut encoder, 0, 100);
            encoder.set_fault(100.0 * TAU / 400.0, Some(fault));
            assert_eq!(turn(&mut encoder, 100, 200), expected, "{fault:?}");
            encoder.set_fault(200.0 * TAU / 400.0, None);
            assert_eq!(turn(&mut encoder, 200, 210), expected + 10, "{fault:?}");
        }
    }

    #[test]
    fn lost_counts_are_lost_either_way_and_once() {
        let mut encoder = encoder(false);
        encoder.set_fault(0.0, Some(EncoderFault::Lost(few(10))));
        assert_eq!(turn(&mut encoder, 0, -30), -20);
        encoder.set_fault(-30.0 * TAU / 400.0, Some(EncoderFault::Lost(few(10))));
        assert_eq!(turn(&mut encoder, -30, 0), 10);
    }

    #[test]
    fn unplugging_lifts_the_signals_that_were_low() {
        for (place, expected) in [(0, 0), (1, 2), (2, 2), (3, 2), (4, 4)] {
            let mut encoder = encoder(false);
            turn(&mut encoder, 0, place);
            let angle = f64::from(place) * TAU / 400.0;
            encoder.set_fault(angle, Some(EncoderFault::Unplugged));
            assert_eq!(encoder.edges(angle), expected, "{place}");
        }
    }
}
