//! The whole world, driven by hand-made pulse-width modulation.

mod faults;
mod motor;

use super::circuit::{
    BUS_CAPACITANCE, DIODE_DROP, DIODE_SLOPE, Leg, Rail, SHORT_INDUCTANCE, SHORT_RESISTANCE, SHUNT,
    SWITCH, Short,
};
use super::drivers::Misuse;
use super::encoder::EncoderFault;
use super::pads::{ShuntFault, ThermistorFault, shunt_pad};
use super::*;
use crate::board::SimulatedBoard;
use crate::double::Double;
use crate::profile::{Load, Step};
use quasidrive::hal::{Board, BridgeCommand};
use quasidrive::modulation;
use quasidrive::per_unit::Bases;

const PERIOD: f64 = 5e-5;
const DEAD_TIME: f64 = 0.8e-6;
/// Highest share of the firmware's modulation.
const HIGHEST: f32 = 0.916;
const KB: f64 = 59e-3;
const RA: f64 = 0.7;
const LA: f64 = 105e-6;
const INERTIA: f64 = 7.95e-5;

/// The paper's motor, without load, sensors exact.
fn scenario(edit: impl FnOnce(&mut Scenario)) -> Scenario {
    let mut scenario = Scenario::paper();
    scenario.load = Load::default();
    edit(&mut scenario);
    scenario
}

/// With profiles that start at a time.
fn world_of(scenario: &Scenario, start: f64) -> WiredWorld {
    let mut world = WiredWorld::new(scenario);
    world.start_profiles(start);
    world
}

fn world(injections: Vec<Injection>, edit: impl FnOnce(&mut Scenario)) -> WiredWorld {
    let mut world = world_of(&scenario(edit), 0.0);
    for injection in injections {
        world.inject(injection);
    }
    world
}

/// Modulates as the firmware's timer does: centre-aligned, a dead time before each turning on.
struct Modulator {
    world: WiredWorld,
    gates: Gates,
    period: u32,
}

impl Modulator {
    /// Charges the bootstrap capacitors for a period: 4 time constants.
    fn new(mut world: WiredWorld) -> Self {
        let gates = Gates { low: [true, true, false], ..Gates::OFF };
        world.switch(0.0, gates);
        Self { world, gates, period: 1 }
    }

    /// Time of the trough that is next (s).
    fn time(&self) -> f64 {
        f64::from(self.period) * PERIOD
    }

    /// A period with a duty; `look` sees the world after each edge.
    fn play_and(&mut self, duty: f64, mut look: impl FnMut(&mut WiredWorld, f64)) {
        let start = self.time();
        let shares = modulation::legs(duty as f32, HIGHEST).map(f64::from);
        let mut edges = Vec::new();
        for (leg, share) in shares.into_iter().enumerate() {
            let (rise, fall) = (0.5 * (1.0 - share) * PERIOD, 0.5 * (1.0 + share) * PERIOD);
            edges.push((rise, leg, false, false));
            if fall - rise > DEAD_TIME {
                edges.push((rise + DEAD_TIME, leg, true, true));
                edges.push((fall, leg, true, false));
            }
            edges.push((fall + DEAD_TIME, leg, false, true));
        }
        edges.sort_by(|one, other| one.0.total_cmp(&other.0));
        for (time, leg, is_high, level) in edges {
            let side = if is_high { &mut self.gates.high } else { &mut self.gates.low };
            side[leg] = level;
            self.world.switch(start + time, self.gates);
            look(&mut self.world, start + time);
        }
        self.period += 1;
    }

    fn play(&mut self, duty: f64, periods: u32) -> Truth {
        for _ in 0..periods {
            self.play_and(duty, |_, _| {});
        }
        self.truth()
    }

    fn off(&mut self) {
        self.gates = Gates::OFF;
        self.world.switch(self.time(), Gates::OFF);
    }

    fn truth(&mut self) -> Truth {
        self.world.truth(self.time())
    }

    /// What the shunts of U and V show in the middle of the window in which both low sides are on (A).
    fn shown(&mut self) -> [f64; 2] {
        let time = self.time();
        let pads = [AnaloguePin::ShuntU, AnaloguePin::ShuntV];
        pads.map(|pin| (self.world.voltage(time, pin) - shunt_pad(0.0)) / (SHUNT / 1.75))
    }
}

fn stay(fault: Fault) -> Vec<Injection> {
    vec![Injection::from(0.0, fault)]
}

#[track_caller]
fn close(value: f64, expected: f64, tolerance: f64) {
    assert!((value - expected).abs() <= tolerance, "{value} is not {expected} ± {tolerance}");
}

/// The mean voltage between the leads that theory has, for a mean current that never changes its sign.
fn mean_voltage(duty: f64, current: f64) -> f64 {
    let dead = DEAD_TIME / PERIOD;
    let lost = 2.0 * dead * 24.0 + 4.0 * dead * DIODE_DROP;
    let [u, v] = modulation::legs(duty as f32, HIGHEST).map(f64::from);
    // Shares of the period: of high sides, of low sides, of diodes down and up.
    let high = u + v - 2.0 * dead;
    let low = 2.0 - u - v - 2.0 * dead;
    let resistance = high * SWITCH
        + low * (SWITCH + SHUNT)
        + 2.0 * dead * (DIODE_SLOPE + SHUNT)
        + 2.0 * dead * DIODE_SLOPE;
    duty * 24.0 - lost * current.signum() - resistance * current
}
