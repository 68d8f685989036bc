//! Gate drivers (L6387E) with their bootstrap capacitors: from what they are told to which switches are on.
//!
//! A driver told both switches turns on neither. That is recorded, and so is a dead time too short for the spread of the drivers'
//! delays. The delays themselves, about 0.1 µs and alike, are left out.
//!
//! A high side lives on the charge of its bootstrap capacitor: 100 nF, charged through 125 Ω while the low side is on, drained by the
//! driver and, at each turn-on, by the gate. Once it has run down the high side is off until it is told anew. Values from `BOARD.md`'s
//! sources and, for supply, drain, gate and threshold, from data sheets of such parts; none was measured by us.

use virtual_board::world::Gates;

/// Legs of the bridge: U, V, W.
pub const LEGS: usize = 3;

/// Shortest time from one switch's turning off to the other's turning on: the spread of the drivers' delays (s).
pub const LEAST_DEAD_TIME: f64 = 150e-9;

/// Supply of the drivers (V).
const SUPPLY: f64 = 10.0;
/// Bootstrap capacitor (F), and time constant of its charging through the driver's 125 Ω (s).
const CAPACITANCE: f64 = 100e-9;
const CHARGING: f64 = 125.0 * CAPACITANCE;
/// What the driver drains from it (A).
const DRAIN: f64 = 200e-6;
/// Capacitance of a gate (F): 80 nC at 10 V.
const GATE: f64 = 8e-9;
/// Voltage below which a high side is off (V).
const THRESHOLD: f64 = 5.5;

/// Hazards that are kept: after so many nothing more is to be learnt.
const MOST_HAZARDS: usize = 1000;

/// A leg's switches.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Switches {
    /// Both off.
    #[default]
    Open,
    /// High side on.
    High,
    /// Low side on.
    Low,
}

/// What firmware must never do to a bridge.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Misuse {
    /// Both switches of a leg were told to be on.
    BothOn,
    /// A switch was told to be on within [`LEAST_DEAD_TIME`] of the other's end: both conduct for a moment.
    ShortDeadTime,
    /// A high side was told to be on whose bootstrap capacitor is empty or ran down: it was off.
    EmptyBootstrap,
}

/// A misuse of a leg.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Hazard {
    /// When (s since power came).
    pub time: f64,
    /// Which leg: 0 to 2 for U, V, W.
    pub leg: usize,
    /// What.
    pub misuse: Misuse,
}

/// One leg's driver.
#[derive(Clone, Copy, Debug)]
struct Driver {
    told: [bool; 2],
    on: Switches,
    /// When the high and the low side were last told to be off (s).
    ended: [f64; 2],
    /// Voltage of the bootstrap capacitor (V) at a time (s).
    bootstrap: f64,
    since: f64,
}

impl Driver {
    const POWERED_UP: Self = Self {
        told: [false; 2],
        on: Switches::Open,
        ended: [f64::NEG_INFINITY; 2],
        bootstrap: 0.0,
        since: 0.0,
    };

    /// Brings the bootstrap capacitor's voltage up to a time.
    fn advance(&mut self, time: f64) {
        let passed = time - self.since;
        self.since = time;
        self.bootstrap = if self.on == Switches::Low {
            SUPPLY - (SUPPLY - self.bootstrap) * (-passed / CHARGING).exp()
        } else {
            (self.bootstrap - DRAIN / CAPACITANCE * passed).max(0.0)
        };
    }

    /// When the high side will go off for want of charge.
    fn runs_down(&self) -> f64 {
        match self.on {
            Switches::High => self.since + (self.bootstrap - THRESHOLD) * CAPACITANCE / DRAIN,
            _ => f64::INFINITY,
        }
    }

    /// Takes the levels of the high and the low side; gives what was wrong with them.
    fn tell(&mut self, time: f64, told: [bool; 2]) -> Option<Misuse> {
        if told == self.told {
            return None;
        }
        self.advance(time);
        let before = std::mem::replace(&mut self.told, told);
        let mut is_short = false;
        for side in [0, 1] {
            if before[side] && !told[side] {
                self.ended[side] = time;
            }
        }
        for side in [0, 1] {
            let begins = told[side] && !before[side];
            is_short |= begins && time - self.ended[1 - side] < LEAST_DEAD_TIME;
        }
        let [high, low] = told;
        if high && low {
            self.on = Switches::Open;
            return Some(Misuse::BothOn);
        }
        if high && self.on != Switches::High {
            if self.bootstrap < THRESHOLD {
                self.on = Switches::Open;
                return Some(Misuse::EmptyBootstrap);
            }
            self.bootstrap *= CAPACITANCE / (CAPACITANCE + GATE);
        }
        self.on = match (high, low) {
            (true, _) => Switches::High,
            (_, true) => Switches::Low,
            _ => Switches::Open,
        };
        is_short.then_some(Misuse::ShortDeadTime)
    }
}

/// The drivers of the legs.
#[derive(Clone, Debug)]
pub struct Drivers {
    legs: [Driver; LEGS],
    hazards: Vec<Hazard>,
}

impl Default for Drivers {
    fn default() -> Self {
        Self { legs: [Driver::POWERED_UP; LEGS], hazards: Vec::new() }
    }
}

impl Drivers {
    /// Takes the levels at the drivers' inputs.
    pub fn tell(&mut self, time: f64, gates: Gates) {
        for (leg, driver) in self.legs.iter_mut().enumerate() {
            if let Some(misuse) = driver.tell(time, [gates.high[leg], gates.low[leg]]) {
                record(&mut self.hazards, Hazard { time, leg, misuse });
            }
        }
    }

    /// When the next high side will go off by itself (s).
    pub fn next_change(&self) -> f64 {
        self.legs.iter().map(Driver::runs_down).fold(f64::INFINITY, f64::min)
    }

    /// Switches off what has run down by a time.
    pub fn run_down(&mut self, time: f64) {
        for (leg, driver) in self.legs.iter_mut().enumerate() {
            if driver.runs_down() <= time {
                driver.advance(time);
                driver.on = Switches::Open;
                let misuse = Misuse::EmptyBootstrap;
                record(&mut self.hazards, Hazard { time, leg, misuse });
            }
        }
    }

    /// Which switches of a leg are on.
    pub fn on(&self, leg: usize) -> Switches {
        self.legs[leg].on
    }

    /// What was wrong so far: the first thousand, in order of time.
    pub fn hazards(&self) -> &[Hazard] {
        &self.hazards
    }
}

fn record(hazards: &mut Vec<Hazard>, hazard: Hazard) {
    if hazards.len() < MOST_HAZARDS {
        hazards.push(hazard);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const LOW: Gates = Gates { low: [true, false, false], ..Gates::OFF };
    const HIGH: Gates = Gates { high: [true, false, false], ..Gates::OFF };

    /// Drivers whose U has a full bootstrap capacitor, at 1 ms, with all switches off.
    fn charged() -> Drivers {
        let mut drivers = Drivers::default();
        drivers.tell(0.0, LOW);
        drivers.tell(1e-3, Gates::OFF);
        drivers
    }

    fn misuses(drivers: &Drivers) -> Vec<Misuse> {
        drivers.hazards().iter().map(|hazard| hazard.misuse).collect()
    }

    #[test]
    fn both_switches_at_once_are_recorded_and_neither_is_on() {
        for leg in 0..LEGS {
            let mut drivers = charged();
            let mut gates = Gates::OFF;
            gates.high[leg] = true;
            gates.low[leg] = true;
            drivers.tell(2e-3, gates);
            let hazard = Hazard { time: 2e-3, leg, misuse: Misuse::BothOn };
            assert_eq!(drivers.hazards(), [hazard]);
            assert_eq!(drivers.on(leg), Switches::Open);
            // What remains when the other ends was told by then.
            gates.high[leg] = false;
            drivers.tell(3e-3, gates);
            assert_eq!(drivers.on(leg), Switches::Low);
        }
    }

    #[test]
    fn a_dead_time_is_needed_both_ways() {
        for (dead_time, expected) in [(0.0, 2), (140e-9, 2), (160e-9, 0), (0.8e-6, 0)] {
            let mut drivers = Drivers::default();
            drivers.tell(0.0, LOW);
            let mut time = 1e-3;
            for gates in [HIGH, LOW] {
                if dead_time > 0.0 {
                    drivers.tell(time, Gates::OFF);
                }
                drivers.tell(time + dead_time, gates);
                time += 1e-5;
            }
            assert_eq!(misuses(&drivers), vec![Misuse::ShortDeadTime; expected], "{dead_time}");
            assert_eq!(drivers.on(0), Switches::Low);
        }
    }

    #[test]
    fn the_same_switch_may_come_again_at_once() {
        let mut drivers = charged();
        drivers.tell(2e-3, LOW);
        drivers.tell(2.1e-3, Gates::OFF);
        drivers.tell(2.1e-3 + 1e-8, LOW);
        assert_eq!(drivers.hazards(), []);
    }

    #[test]
    fn a_high_side_needs_its_bootstrap_charged() {
        let mut empty = Drivers::default();
        empty.tell(1e-3, HIGH);
        assert_eq!((empty.on(0), misuses(&empty)), (Switches::Open, vec![Misuse::EmptyBootstrap]));
        // 12.5 µs of charging are a time constant: 5.5 of 10 V take 0.8 of it.
        for (charging, is_on) in [(9e-6, false), (11e-6, true)] {
            let mut drivers = Drivers::default();
            drivers.tell(0.0, LOW);
            drivers.tell(charging, Gates::OFF);
            drivers.tell(charging + 1e-6, HIGH);
            assert_eq!(drivers.on(0) == Switches::High, is_on, "{charging}");
            assert_eq!(drivers.hazards().is_empty(), is_on);
        }
    }

    #[test]
    fn a_high_side_that_is_never_refreshed_goes_off() {
        let mut drivers = charged();
        drivers.tell(1.001e-3, HIGH);
        // (10 V less 2 mV of waiting)·100/108 less 5.5 V, at 2 V/ms.
        let expected = 1.001e-3 + (9.998 * 100.0 / 108.0 - 5.5) / 2e3;
        let end = drivers.next_change();
        assert!((end - expected).abs() < 1e-8, "{end} is not {expected}");
        drivers.run_down(end - 1e-9);
        assert_eq!(drivers.on(0), Switches::High);
        drivers.run_down(end);
        assert_eq!(drivers.on(0), Switches::Open);
        let hazard = Hazard { time: end, leg: 0, misuse: Misuse::EmptyBootstrap };
        assert_eq!(drivers.hazards(), [hazard]);
        assert_eq!(drivers.next_change(), f64::INFINITY);
    }

    #[test]
    fn the_highest_share_of_the_firmware_keeps_the_bootstraps_charged() {
        // 2·(0.8 + 1.3) µs of the period without the high side, of which the dead times are without the low side too.
        let mut drivers = charged();
        let mut time = 1e-3;
        for _ in 0..2000 {
            drivers.tell(time, LOW);
            drivers.tell(time + 2.6e-6, Gates::OFF);
            drivers.tell(time + 3.4e-6, HIGH);
            assert!(drivers.next_change() > time + 5e-5);
            drivers.tell(time + 49.2e-6, Gates::OFF);
            time += 5e-5;
        }
        assert_eq!(drivers.hazards(), []);
        let bootstrap = drivers.legs[0].bootstrap;
        assert!((6.0..8.0).contains(&bootstrap), "{bootstrap} V");
    }

    #[test]
    fn a_flood_of_hazards_ends() {
        let mut drivers = Drivers::default();
        for toggle in 0..4000 {
            drivers.tell(f64::from(toggle) * 1e-6, if toggle % 2 == 0 { LOW } else { HIGH });
        }
        assert_eq!(drivers.hazards().len(), MOST_HAZARDS);
    }
}
