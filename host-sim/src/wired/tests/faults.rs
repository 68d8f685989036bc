//! What is broken, or done wrong.

use super::*;

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
fn what_is_injected_late_acts_from_its_time_on_and_alone() {
    let blocked = Injection { fault: Fault::RotorBlocked, during: 0.01052..0.015 };
    let [early, late] = [true, false].map(|is_early| {
        let mut wired = Modulator::new(world(Vec::new(), |_| {}));
        if is_early {
            wired.world.inject(blocked.clone());
        }
        wired.play(0.5, 200);
        if !is_early {
            wired.world.inject(blocked.clone());
        }
        assert!(wired.play(0.5, 9).speed > 50.0);
        assert_eq!(wired.play(0.5, 1).speed, 0.0);
        wired.play(0.5, 150)
    });
    close(late.speed, early.speed, 1e-6);
    assert!(early.speed > 10.0, "free again");
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
    for leg in [Leg::U, Leg::V] {
        for rail in [Rail::Ground, Rail::Supply] {
            let fault = vec![Injection::from(0.01, Fault::LegShorted(Short { leg, rail }))];
            let mut wired = Modulator::new(world(fault, |_| {}));
            wired.play(0.3, 190);
            let [u, v] = wired.shown();
            close(u + v, 0.0, 0.1);
            wired.play(0.3, 13);
            let [u, v] = wired.shown();
            assert!((u + v).abs() > 20.0, "{leg:?} to {rail:?}: {u} A, {v} A");
            // To ground the leg's low side carries it back, to the supply its own.
            let through = wired.shown()[leg as usize];
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
        let fault = stay(Fault::LegShorted(Short { leg: Leg::U, rail: Rail::Ground }));
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
        Injection::from(0.1, Fault::CurrentSensor(Leg::V, ShuntFault::High)),
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
