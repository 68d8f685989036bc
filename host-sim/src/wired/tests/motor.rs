//! What is well.

use super::*;

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
        let mut wired = Modulator::new(world_of(&scenario, PERIOD));
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
            let before = wired.truth();
            let speed = before.speed;
            close(speed - averaged.speed, expected / KB, 0.03);
            assert!(speed.abs() > 80.0 && expected.abs() > 0.05, "{speed} rad/s, {expected} V");
            let after = wired.play(duty, 100);
            let mean = (after.volt_seconds - before.volt_seconds) / (100.0 * PERIOD);
            close(outward * mean, mean_voltage(outward * duty, averaged.current), 6e-3);
            for _ in 0..100 {
                board.apply(BridgeCommand::Duty(Double(duty)));
            }
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
    let edges = (later.angle / std::f64::consts::TAU * 4096.0 + 0.5).floor() as i64;
    assert_eq!(wired.world.encoder_edges(later.time), edges);
}

#[test]
fn a_motor_spun_beyond_the_bus_generates_through_the_diodes() {
    for sign in [1.0, -1.0] {
        let scenario = scenario(|scenario| scenario.initial.speed = sign * 600.0);
        let mut world = world_of(&scenario, 0.0);
        let truth = world.truth(1e-3);
        let back_emf = KB * truth.speed.abs();
        let expected =
            (back_emf - 24.0 - 2.0 * DIODE_DROP) / (RA + 2.0 * DIODE_SLOPE + SHUNT) * -sign;
        // The speed falls by 60 rad/s in a millisecond; the current follows 0.15 ms late.
        close(truth.current, expected, 1.0);
        assert!(truth.current * sign < -5.0 && truth.energy.drawn < 0.0, "{truth:?}");
    }
    let scenario = scenario(|scenario| scenario.initial.speed = 400.0);
    let mut world = world_of(&scenario, 0.0);
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
        let before = world.truth(start);
        assert_eq!(before.current, 0.0, "not ended in period {period}");
        world.switch(start, low);
        world.switch(start + 2.5e-6, Gates::OFF);
        let current = world.truth(start + 2.5e-6).current;
        let built_up = KB * before.speed * 2.5e-6 / LA;
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
    let play = |share: u32| {
        let mut scenario = scenario(|scenario| {
            scenario.motor.coulomb_friction = 0.01;
            scenario.motor.viscous_friction = 1e-5;
            scenario.bus.resistance = 0.2;
            scenario.load.constant = 0.02;
        });
        if share > 1 {
            // Steps of the bus that change nothing but the integration's.
            let h = 10e-6 / f64::from(share);
            let steps =
                (1..3000 * share).map(|step| Step { time: f64::from(step) * h, value: 24.0 });
            scenario.bus.steps = steps.collect();
        }
        let mut wired = Modulator::new(world_of(&scenario, 0.0));
        for duty in [0.5, -0.7, 0.1] {
            wired.play(duty, 200);
        }
        wired.truth()
    };
    let [coarse, fine, finest] = [1, 4, 8].map(play);
    close(coarse.speed, finest.speed, 3e-3);
    close(coarse.current, finest.current, 1e-3);
    close(coarse.bus_voltage, finest.bus_voltage, 1e-3);
    // Second order: a quarter of the step errs by a sixteenth, give or take what zero crossings add.
    let [coarse, fine] = [coarse, fine].map(|truth| (truth.speed - finest.speed).abs());
    assert!(fine < 0.2 * coarse && coarse > 1e-9, "{coarse} rad/s, {fine} rad/s");
}

#[test]
fn looking_does_not_change_the_world() {
    let scenario = scenario(|scenario| {
        scenario.load.constant = 0.03;
        scenario.bus.resistance = 0.1;
    });
    let play = |looks: u32| {
        let mut wired = Modulator::new(world_of(&scenario, 0.0));
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
        let mut wired = Modulator::new(world_of(&scenario, 0.0));
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
    let mut world = WiredWorld::new(&scenario);
    assert_eq!(world.truth(0.05).speed, 0.0);
    world.start_profiles(0.1);
    assert_eq!(world.truth(0.1).speed, 0.0);
    close(world.truth(0.11).speed, -0.05 / INERTIA * 0.01, 1e-9);
    close(world.truth(0.115).speed, (-0.05 * 0.01 + 0.02 * 0.005) / INERTIA, 1e-9);
    assert_eq!(world.truth(0.1199).bus_voltage, 24.0);
    assert_eq!(world.truth(0.1201).bus_voltage, 12.0);
}
