//! The whole world, driven by hand-made pulse-width modulation.

use super::circuit::{
    BUS_CAPACITANCE, DIODE_DROP, DIODE_SLOPE, Rail, SHORT_INDUCTANCE, SHORT_RESISTANCE, SHUNT,
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

fn world(injections: Vec<Injection>, edit: impl FnOnce(&mut Scenario)) -> WiredWorld {
    WiredWorld::new(&scenario(edit), 0.0, injections)
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

#[test]
fn the_motor_runs_as_on_the_averaged_board() {
    for is_reversed in [false, true] {
        let scenario = scenario(|scenario| {
            scenario.load.constant = 0.1;
            scenario.timing.delay = false;
            scenario.bridge.dead_time = DEAD_TIME;
            scenario.bridge.leads_reversed = is_reversed;
        });
        let bases = Bases::new(&scenario.drive_config()).expect("valid");
        let mut board = SimulatedBoard::<Double>::new(&scenario, bases);
        let mut wired = Modulator::new(WiredWorld::new(&scenario, PERIOD, Vec::new()));
        for duty in [0.5, -0.3, 0.85] {
            for _ in 0..4000 {
                board.apply(BridgeCommand::Duty(Double(duty)));
                let truth = wired.play(duty, 1);
                // Where a current crosses zero its ripple of up to 0.75 A does not lose all of the dead times' 0.77 V, which the
                // averaged board takes off: 1.1 A, and 0.8 rad/s for each of the few milliseconds that it takes.
                close(truth.current, board.state().current, 1.1);
                close(truth.speed, board.state().speed, 4.0);
            }
            // At rest only what the averaged board leaves out is between them: diodes, switches, shunts.
            let averaged = board.state();
            let [outward, sign] = [if is_reversed { -1.0 } else { 1.0 }, averaged.current.signum()];
            let voltage = (outward * duty - sign * 2.0 * DEAD_TIME / PERIOD) * 24.0;
            let expected = mean_voltage(outward * duty, averaged.current) - voltage;
            let speed = wired.truth().speed;
            close(speed - averaged.speed, expected / KB, 0.03);
            assert!(speed.abs() > 80.0 && expected.abs() > 0.05, "{speed} rad/s, {expected} V");
        }
        assert_eq!(wired.world.hazards(), []);
    }
}

#[test]
fn the_mean_voltage_lacks_what_dead_time_diodes_and_switches_take() {
    // Blocked: the current is the voltage's alone.
    for duty in [0.15, 0.4, 0.9, -0.15, -0.4] {
        let mut wired = Modulator::new(world(stay(Fault::RotorBlocked), |_| {}));
        let before = wired.play(duty, 200);
        let after = wired.play(duty, 100);
        let mean = (after.volt_seconds - before.volt_seconds) / (100.0 * PERIOD);
        // The ripple, up to 0.75 A to either side, meets resistances that differ by 8 mΩ.
        close(mean, mean_voltage(duty, mean / RA), 6e-3);
        // The current sampled at the trough is the mean, but for the ripple's being no triangle: its 0.75 A bend by half of
        // what half a period is of La/Ra.
        close(after.current, mean / RA, 0.75 * 0.25 * PERIOD * RA / LA);
    }
}

#[test]
fn the_ripple_is_that_of_its_formula() {
    let duty = 0.4;
    let mut wired = Modulator::new(world(stay(Fault::RotorBlocked), |_| {}));
    let mean = wired.play(duty, 200).current;
    let [mut lowest, mut highest] = [f64::INFINITY, f64::NEG_INFINITY];
    wired.play_and(duty, |world, time| {
        let current = world.truth(time).current;
        lowest = lowest.min(current);
        highest = highest.max(current);
    });
    // Two pulses a period, each shorter by a dead time; the current rises along the voltage that is left over.
    let pulse = 0.5 * duty * PERIOD - DEAD_TIME;
    let expected = (24.0 - (RA + 0.007) * mean) * pulse / LA;
    close(highest - lowest, expected, 0.01 * expected);
    assert!(expected > 1.2, "{expected}");
}

#[test]
fn energy_is_kept() {
    let mut wired = Modulator::new(world(Vec::new(), |scenario| scenario.initial.speed = 100.0));
    let [mut most_drawn, mut most_fed_back] = [0.0_f64; 2];
    for (duty, periods) in [(0.5, 400), (-0.6, 400), (0.02, 1000), (0.9, 200)] {
        let before = wired.truth();
        let after = wired.play(duty, periods);
        let stored = |truth: &Truth| 0.5 * LA * truth.current.powi(2);
        let [drawn, heat, rotor] = [
            after.energy.drawn - before.energy.drawn,
            after.energy.heat - before.energy.heat,
            after.energy.rotor - before.energy.rotor,
        ];
        most_drawn = most_drawn.max(drawn);
        most_fed_back = most_fed_back.min(rotor);
        close(drawn, heat + rotor + stored(&after) - stored(&before), 1e-9);
        // What the rotor got it has: no friction, no load. Second order in the step.
        let kinetic = 0.5 * INERTIA * (after.speed.powi(2) - before.speed.powi(2));
        close(rotor, kinetic, 1e-5 * (1.0 + kinetic.abs()));
    }
    assert!(most_drawn > 1.0 && most_fed_back < -0.3, "{most_drawn} J, {most_fed_back} J");
}

#[test]
fn open_switches_end_the_current_through_the_diodes_and_the_motor_coasts() {
    let mut wired = Modulator::new(world(Vec::new(), |_| {}));
    let driven = wired.play(0.4, 10);
    wired.off();
    let resistance = RA + 2.0 * DIODE_SLOPE + SHUNT;
    let against = 24.0 + 2.0 * DIODE_DROP + KB * driven.speed;
    let dies = LA / resistance * (1.0 + driven.current * resistance / against).ln();
    let mut current_after = |time: f64| wired.world.truth(driven.time + time).current;
    assert!(driven.current > 4.0 && dies > 1e-5, "{driven:?}");
    assert!(current_after(0.99 * dies) > 0.005 * driven.current);
    assert_eq!(current_after(1.01 * dies), 0.0);
    let coasting = wired.world.truth(driven.time + 0.1);
    assert_eq!(coasting.current, 0.0);
    let later = wired.world.truth(driven.time + 0.2);
    assert_eq!(later.speed, coasting.speed);
    close(later.angle - coasting.angle, 0.1 * later.speed, 1e-9);
    assert_eq!(wired.world.encoder_edges(0.2), {
        let angle = wired.world.truth(0.2).angle;
        (angle / std::f64::consts::TAU * 4096.0 + 0.5).floor() as i64
    });
}

#[test]
fn a_motor_spun_beyond_the_bus_generates_through_the_diodes() {
    for sign in [1.0, -1.0] {
        let scenario = scenario(|scenario| scenario.initial.speed = sign * 600.0);
        let mut world = WiredWorld::new(&scenario, 0.0, Vec::new());
        let truth = world.truth(1e-3);
        let back_emf = KB * truth.speed.abs();
        let expected =
            (back_emf - 24.0 - 2.0 * DIODE_DROP) / (RA + 2.0 * DIODE_SLOPE + SHUNT) * -sign;
        // The speed falls by 60 rad/s in a millisecond; the current follows 0.15 ms late.
        close(truth.current, expected, 1.0);
        assert!(truth.current * sign < -5.0 && truth.energy.drawn < 0.0, "{truth:?}");
    }
    let scenario = scenario(|scenario| scenario.initial.speed = 400.0);
    let mut world = WiredWorld::new(&scenario, 0.0, Vec::new());
    assert_eq!(world.truth(1e-2).energy, Energy::default());
    assert_eq!(world.truth(1e-2).speed, 400.0);
}

#[test]
fn low_sides_pulsed_alone_brake_in_pulses_of_current_that_end() {
    // As the firmware charges its bootstraps with the motor turning: the diodes pump what the short pulses built up into the bus.
    let mut world = world(Vec::new(), |scenario| scenario.initial.speed = 200.0);
    let low = Gates { low: [true, true, false], ..Gates::OFF };
    let mut fastest_current: f64 = 0.0;
    for period in 0..400 {
        let start = f64::from(period) * PERIOD;
        assert_eq!(world.truth(start).current, 0.0, "not ended in period {period}");
        world.switch(start, low);
        world.switch(start + 2.5e-6, Gates::OFF);
        let current = world.truth(start + 2.5e-6).current;
        let built_up = KB * world.truth(start).speed * 2.5e-6 / LA;
        close(current, -built_up, 0.02 * built_up);
        fastest_current = fastest_current.max(current.abs());
        for tenth in 1..10 {
            let current = world.truth(start + 0.1 * PERIOD * f64::from(tenth)).current;
            assert!(current <= 0.0, "chopped, not reversed: {current} A");
        }
    }
    assert!(fastest_current > 0.25, "{fastest_current}");
    let truth = world.truth(400.0 * PERIOD);
    assert!(truth.speed < 200.0 && truth.energy.drawn < 0.0, "{truth:?}");
}

#[test]
fn steps_are_short_enough() {
    let scenario = scenario(|scenario| {
        scenario.motor.coulomb_friction = 0.01;
        scenario.motor.viscous_friction = 1e-5;
        scenario.bus.resistance = 0.2;
        scenario.load.constant = 0.02;
    });
    let play = |shares: u32| {
        let mut wired = Modulator::new(WiredWorld::new(&scenario, 0.0, Vec::new()));
        for duty in [0.5, -0.7, 0.1] {
            for _ in 0..200 {
                // Looks integrate a copy: shorter steps need changes that change nothing.
                let start = wired.time();
                wired.play_and(duty, |world, time| {
                    let jumps: Vec<f64> = (1..shares)
                        .map(|share| time + f64::from(share) * 10e-6 / f64::from(shares))
                        .collect();
                    world.jumps.retain(|jump| *jump < start);
                    world.jumped = world.jumps.len();
                    world.jumps.extend(jumps);
                });
            }
        }
        wired.truth()
    };
    let [coarse, fine] = [play(1), play(8)];
    close(coarse.speed, fine.speed, 1e-3);
    close(coarse.current, fine.current, 2e-3);
    close(coarse.bus_voltage, fine.bus_voltage, 2e-3);
    assert_ne!(coarse.speed, fine.speed, "second order cannot be that good");
}

#[test]
fn looking_does_not_change_the_world() {
    let scenario = scenario(|scenario| {
        scenario.load.constant = 0.03;
        scenario.bus.resistance = 0.1;
    });
    let play = |looks: u32| {
        let mut wired = Modulator::new(WiredWorld::new(&scenario, 0.0, Vec::new()));
        for period in 0..100 {
            wired.play_and(0.3, |world, time| {
                for look in 0..looks {
                    let time = time + 1e-7 * f64::from(look);
                    world.encoder_edges(time);
                    world.voltage(time, AnaloguePin::ShuntU);
                }
            });
            if period == 50 {
                wired.off();
                wired.period += 20;
                for look in 0..10 * looks {
                    let time = wired.time() - PERIOD * f64::from(10 * looks - look) / 7.0;
                    wired.world.truth(time);
                }
                wired.gates = Gates { low: [true, true, false], ..Gates::OFF };
                wired.world.switch(wired.time(), wired.gates);
                wired.period += 1;
            }
        }
        wired.truth()
    };
    assert_eq!(play(0), play(5));
}

#[test]
fn the_same_seed_makes_the_same_world() {
    let scenario = scenario(|scenario| scenario.sensors = Some(SensorsTable::default()));
    let play = || {
        let mut wired = Modulator::new(WiredWorld::new(&scenario, 0.0, Vec::new()));
        let shown: Vec<_> = (0..100)
            .map(|_| {
                wired.play(0.3, 1);
                (wired.shown(), wired.world.encoder_edges(wired.time()))
            })
            .collect();
        (shown, wired.truth())
    };
    assert_eq!(play(), play());
}

#[test]
fn both_shunts_show_the_current_at_the_trough_once_it_has_settled() {
    let mut wired = Modulator::new(world(stay(Fault::RotorBlocked), |_| {}));
    let truth = wired.play(0.4, 100);
    let [u, v] = wired.shown();
    close(u, -truth.current, 0.02);
    close(v, truth.current, 0.02);
    // A low side that has just come on, at the end of a dead time in which its diode was already the way through the shunt; one
    // whose high side has just gone off. A time constant of 0.2 µs later 1/e of the step is left.
    let mut seen = Vec::new();
    wired.play_and(0.4, |world, time| {
        let gates = world.truth(time).leg_currents;
        seen.push((time, gates, world.voltage(time + 0.2e-6, AnaloguePin::ShuntU)));
    });
    // U's high side falls sixth of the eight edges: of V first, then of U, each followed by its low side's rise.
    let (time, [current, _], shown) = seen[6];
    let shown = (shown - shunt_pad(0.0)) / (SHUNT / 1.75);
    close(shown / -current, 1.0 - (-1.0_f64).exp(), 0.03);
    assert!(time > wired.time() - 0.2 * PERIOD, "that was the falling edge");
}

#[test]
fn offset_and_noise_are_those_of_the_scenario() {
    let mut wired = Modulator::new(world(stay(Fault::LeadOpen), |scenario| {
        scenario.sensors = Some(SensorsTable {
            current_offset: 0.4,
            current_noise: 0.05,
            ..SensorsTable::default()
        });
    }));
    let shown: Vec<f64> = (0..4000)
        .map(|_| {
            wired.play(0.1, 1);
            let [u, v] = wired.shown();
            0.5 * (v - u)
        })
        .collect();
    let mean = shown.iter().sum::<f64>() / 4e3;
    let deviation = (shown.iter().map(|one| (one - mean).powi(2)).sum::<f64>() / 4e3).sqrt();
    close(mean, 0.4, 4e-3);
    close(deviation, 0.05, 3e-3);
}

#[test]
fn braking_raises_a_bus_with_a_resistance() {
    let mut wired = Modulator::new(world(Vec::new(), |scenario| {
        scenario.initial.speed = 300.0;
        scenario.bus.resistance = 0.5;
    }));
    let highest = (0..40).map(|_| wired.play(0.4, 1)).fold(0.0_f64, |highest, truth| {
        // The scenario's own model, at the mean of the bus current; the dead time lengthens what flows back by its share.
        highest.max(truth.bus_voltage - 24.0)
    });
    let truth = wired.truth();
    let share = 0.4 + 2.0 * DEAD_TIME / PERIOD;
    let expected = -0.5 * share * truth.current;
    assert!(expected > 0.5 && highest < 3.0, "{expected} V, {highest} V");
    // The capacitor lags by RC = 0.24 ms while the current changes by less than 1 A, and its ripple is i·T/8C.
    let ripple = truth.current.abs() * PERIOD / 8.0 / BUS_CAPACITANCE;
    close(truth.bus_voltage - 24.0, expected, 0.5 * share * 1.0 + ripple);
}

#[test]
fn profiles_start_when_the_world_is_told() {
    let scenario = scenario(|scenario| {
        scenario.load.constant = 0.05;
        scenario.load.steps = vec![Step { time: 0.01, value: -0.02 }];
        scenario.bus.steps = vec![Step { time: 0.02, value: 12.0 }];
    });
    let mut world = WiredWorld::new(&scenario, 0.1, Vec::new());
    assert_eq!(world.truth(0.1).speed, 0.0);
    close(world.truth(0.11).speed, -0.05 / INERTIA * 0.01, 1e-9);
    close(world.truth(0.115).speed, (-0.05 * 0.01 + 0.02 * 0.005) / INERTIA, 1e-9);
    assert_eq!(world.truth(0.1199).bus_voltage, 24.0);
    assert_eq!(world.truth(0.1201).bus_voltage, 12.0);
}

#[test]
fn misuse_of_the_bridge_is_recorded_and_does_not_drive() {
    let mut world = world(Vec::new(), |_| {});
    // Not charged: U's high side stays off.
    let forward = Gates { high: [true, false, false], low: [false, true, false] };
    world.switch(1e-3, forward);
    assert_eq!(world.truth(2e-3).current, 0.0);
    assert_eq!(world.hazards()[0].misuse, Misuse::EmptyBootstrap);
    world.switch(2e-3, Gates::OFF);
    // Charged for long enough it drives, until the charge is gone.
    world.switch(3e-3, Gates { low: [true, true, false], ..Gates::OFF });
    world.switch(4e-3, Gates { low: [false, true, false], ..Gates::OFF });
    world.switch(4.001e-3, forward);
    assert!(world.truth(4.1e-3).current > 5.0);
    let ran_down = world.truth(10e-3);
    assert_eq!(ran_down.leg_currents[U], ran_down.current);
    assert_eq!(world.hazards().len(), 2);
    let end = world.hazards()[1].time;
    assert!((5e-3..7e-3).contains(&end), "{end}");
    world.switch(20e-3, Gates { high: [true, false, false], low: [true, true, false] });
    assert_eq!(world.hazards()[2], Hazard { time: 20e-3, leg: 0, misuse: Misuse::BothOn });
}

#[test]
fn an_open_lead_carries_no_current() {
    let open = Injection { fault: Fault::LeadOpen, during: 0.01..0.02 };
    let mut wired = Modulator::new(world(vec![open], |_| {}));
    assert!(wired.play(0.3, 180).current.abs() > 0.1);
    while wired.time() < 0.0199 {
        let truth = wired.play(0.8, 1);
        if truth.time > 0.0101 {
            assert_eq!((truth.current, truth.leg_currents), (0.0, [0.0; 2]));
            assert_eq!(wired.shown().map(|current| current.abs() < 1e-9), [true; 2]);
        }
    }
    assert!(wired.play(0.8, 20).current > 5.0, "reconnected");
}

#[test]
fn a_blocked_rotor_does_not_turn() {
    let block = vec![Injection::from(0.01, Fault::RotorBlocked)];
    let mut wired = Modulator::new(world(block, |_| {}));
    let turning = wired.play(0.5, 190);
    let blocked = wired.play(0.5, 100);
    let later = wired.play(0.5, 100);
    assert!(turning.speed > 50.0, "{turning:?}");
    assert_eq!((blocked.speed, later.speed), (0.0, 0.0));
    assert_eq!(blocked.angle, later.angle);
    close(later.current, mean_voltage(0.5, later.current) / RA, 0.05);
}

#[test]
fn a_shorted_motor_draws_what_the_wires_let_through_and_is_braked() {
    let short = vec![Injection::from(0.01, Fault::MotorShorted)];
    let mut wired = Modulator::new(world(short, |scenario| scenario.initial.speed = 150.0));
    let before = wired.play(0.4, 199);
    assert!(before.current.abs() < 10.0);
    // A pulse in the first period, 9.2 µs long: 24 V at 1 µH, less what wires and switches take.
    let mut highest: f64 = 0.0;
    wired.play_and(0.4, |world, time| {
        highest = highest.max(world.truth(time).leg_currents[0]);
    });
    let pulse = 0.2 * PERIOD - DEAD_TIME;
    let resistance = SHORT_RESISTANCE + 2.0 * SWITCH + SHUNT;
    let first = 24.0 / resistance * (1.0 - (-pulse * resistance / SHORT_INDUCTANCE).exp());
    assert!(highest > 0.95 * first && highest < 2.5 * first, "{highest} A, {first} A");
    // The sample at the trough shows it on both shunts.
    let [u, v] = wired.shown();
    assert!(v > 41.0 && u < -41.0, "{u} A, {v} A");
    // The motor's own short circuit brakes it with J·Ra/Kb² = 16 ms; the bridge no longer drives it.
    wired.off();
    let start = wired.truth();
    let braked = wired.world.truth(start.time + 16e-3);
    close(braked.speed / start.speed, (-16e-3 * KB * KB / RA / INERTIA).exp(), 0.02);
    assert_eq!(braked.leg_currents, [0.0; 2]);
}

#[test]
fn a_leg_that_touches_a_rail_makes_the_shunts_disagree() {
    for leg in [U, V] {
        for rail in [Rail::Ground, Rail::Supply] {
            let fault = vec![Injection::from(0.01, Fault::LegShorted(Short { leg, rail }))];
            let mut wired = Modulator::new(world(fault, |_| {}));
            wired.play(0.3, 190);
            let [u, v] = wired.shown();
            close(u + v, 0.0, 0.1);
            wired.play(0.3, 13);
            let [u, v] = wired.shown();
            assert!((u + v).abs() > 20.0, "{leg} to {rail:?}: {u} A, {v} A");
            // To ground the leg's low side carries it back, to the supply its own.
            let through = wired.shown()[leg];
            assert_eq!(through > 0.0, rail == Rail::Supply, "{through} A");
            wired.off();
            let dead = wired.world.truth(wired.time() + 0.5);
            assert!(dead.leg_currents.iter().all(|current| current.abs() < 1e-6), "{dead:?}");
        }
    }
}

#[test]
fn a_leg_that_touches_ground_closes_the_turning_motor_s_circuit() {
    for (speed, conducts) in [(200.0, true), (-200.0, false)] {
        let fault = stay(Fault::LegShorted(Short { leg: U, rail: Rail::Ground }));
        let mut world = world(fault, |scenario| scenario.initial.speed = speed);
        let truth = world.truth(1e-3);
        // Out of U through the short circuit, back through V's low diode.
        let expected = if conducts {
            -(KB * truth.speed - DIODE_DROP) / (RA + SHORT_RESISTANCE + DIODE_SLOPE + SHUNT)
        } else {
            0.0
        };
        close(truth.current, expected, 0.05 * expected.abs());
        close(truth.leg_currents[U], 0.0, 1e-9);
        assert_eq!(truth.leg_currents[V], -truth.current);
        assert_eq!(truth.current < -10.0, conducts);
    }
}

#[test]
fn the_supply_fails_as_told() {
    let faults = vec![
        Injection { fault: Fault::Supply(35.0), during: 0.01..0.02 },
        Injection { fault: Fault::Supply(0.0), during: 0.02..0.03 },
        Injection { fault: Fault::SupplyRamp(-100.0), during: 0.04..0.4 },
    ];
    let mut world = world(faults, |_| {});
    let mut at = |time: f64| world.truth(time).bus_voltage;
    assert_eq!([at(0.0099), at(0.0101), at(0.0201), at(0.0301)], [24.0, 35.0, 0.0, 24.0]);
    close(at(0.14), 14.0, 1e-6);
    assert_eq!([at(0.39), at(0.41)], [0.0, 24.0]);
    let pad = world.voltage(0.5, AnaloguePin::BusVoltage);
    close(pad, 24.0 * 18.0 / 187.0, 1e-12);
}

#[test]
fn pins_that_are_not_the_motor_s_show_their_faults() {
    let faults = vec![
        Injection { fault: Fault::ButtonPressed, during: 1.0..2.0 },
        Injection { fault: Fault::BoardTemperature(95.0), during: 1.0..2.0 },
        Injection::from(3.0, Fault::Thermistor(ThermistorFault::Shorted)),
        Injection::from(4.0, Fault::Thermistor(ThermistorFault::Open)),
    ];
    let mut world = world(faults, |_| {});
    world.set_potentiometer(0.25);
    assert_eq!(world.voltage(0.0, AnaloguePin::Potentiometer), 0.825);
    assert_eq!(world.voltage(0.0, AnaloguePin::ShuntW), shunt_pad(0.0));
    let mut seen = |time: f64| {
        let level = world.level(time, InputPin::Button);
        (level, world.voltage(time, AnaloguePin::Temperature))
    };
    let (released, room) = seen(0.5);
    // 10 kΩ and 4.7 kΩ.
    assert!(released && (room - 3.3 * 4.7 / 14.7).abs() < 1e-12);
    let (pressed, hot) = seen(1.0);
    assert!(!pressed && hot > 2.6, "{hot} V");
    assert_eq!([seen(2.5), seen(3.5), seen(4.5)], [(true, room), (true, 3.3), (true, 0.0)]);
}

#[test]
fn the_encoder_and_the_current_sensors_fail_as_told() {
    let faults = vec![
        Injection { fault: Fault::Encoder(EncoderFault::Frozen), during: 0.1..0.2 },
        Injection::from(0.3, Fault::Encoder(EncoderFault::Reversed)),
        Injection::from(0.1, Fault::CurrentSensor(V, ShuntFault::High)),
    ];
    let mut world = world(faults, |scenario| scenario.initial.speed = 100.0);
    let per_radian = 4096.0 / std::f64::consts::TAU;
    // Only some looks: the faults must start and end in between, where they are to.
    for (time, angle) in [(0.09, 9.0), (0.15, 10.0), (0.25, 15.0), (0.35, 15.0), (0.45, 5.0)] {
        let edges = world.encoder_edges(time);
        close(edges as f64, angle * per_radian, 2.0);
    }
    assert_eq!(world.voltage(0.45, AnaloguePin::ShuntU), shunt_pad(0.0));
    assert_eq!(world.voltage(0.45, AnaloguePin::ShuntV), 3.3);
}
