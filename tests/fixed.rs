//! Fixed point against floating point, in closed loop, and against samples of any kind: overflow checks are on here.

use host_sim::scenario::{Controller, FormName, Scenario};
use host_sim::simulation::simulate;
use proptest::prelude::*;
use quasidrive::drive::{Drive, DriveConfig, Mode};
use quasidrive::hal::{BridgeCommand, Codes, Exact, READS, Sample};
use quasidrive::math::{Base, Q31, Scalar};
use std::path::Path;

fn scenario(name: &str, controller: Controller) -> Scenario {
    let file = Path::new("host-sim/scenarios").join(name).with_extension("toml");
    let mut scenario = Scenario::read(&file).expect("valid");
    scenario.control.controller = controller;
    scenario
}

/// RMS of z1 (rad/s) in floating point, and by how much that of fixed point is larger.
fn compared(scenario: &Scenario) -> (f64, f64) {
    let rms = |outcome: host_sim::simulation::Outcome| {
        assert_eq!(outcome.fault, None);
        outcome.metrics.whole.rms_z1.expect("counted")
    };
    let float = rms(simulate::<f32>(scenario, |_| {}).expect("valid"));
    let fixed = rms(simulate::<Q31>(scenario, |_| {}).expect("valid"));
    (float, fixed / float - 1.0)
}

fn assert_within(what: &str, value: f64, [low, high]: [f64; 2]) {
    assert!((low..=high).contains(&value), "{what}: {value} is not within {low} to {high}");
}

#[test]
fn errors_are_those_of_floating_point() {
    for controller in [Controller::Bs, Controller::BsQsmdo, Controller::BsQismc] {
        let (float, more) = compared(&scenario("paper", controller));
        assert_within(&format!("{controller:?}, ideal sensors, {float}"), more, [-0.01, 0.01]);
        // A bound that is never approached says nothing: the bits do differ.
        assert!(more != 0.0, "{controller:?}: the very same");
    }
    for controller in
        [Controller::DriveQsmdo, Controller::DriveQismc, Controller::Pi, Controller::Ladrc]
    {
        let (float, more) = compared(&scenario("encoder", controller));
        assert_within(&format!("{controller:?}, encoder, {float}"), more, [-0.02, 0.02]);
        assert!(more != 0.0, "{controller:?}: the very same");
    }
    // The last one's error is a few millionths of its speed.
    for (name, most) in [("load-step", 0.01), ("smooth", 0.01), ("reversal", 0.03)] {
        let file = Path::new("host-sim/scenarios").join(name).with_extension("toml");
        let (float, more) = compared(&Scenario::read(&file).expect("valid"));
        assert_within(&format!("{name}, {float}"), more, [-most, most]);
    }
}

#[test]
fn what_fixed_point_cannot_represent_is_refused_with_its_field() {
    let refused = |edit: &dyn Fn(&mut Scenario), name, controller| {
        let mut scenario = scenario(name, controller);
        edit(&mut scenario);
        Drive::<f32>::new(&scenario.drive_config()).expect("valid in floating point");
        Drive::<Q31>::new(&scenario.drive_config()).expect_err("refused").field
    };
    let explicit = |scenario: &mut Scenario| scenario.control.form = FormName::Explicit;
    assert_eq!(refused(&explicit, "paper", Controller::BsQsmdo), "control.form");
    let fast = |scenario: &mut Scenario| scenario.gains.c = 3_900.0;
    assert_eq!(refused(&fast, "paper", Controller::Bs), "control.gains.c");
    let reserve = |scenario: &mut Scenario| scenario.tuning.voltage_reserve = Some(25.0);
    assert_eq!(refused(&reserve, "encoder", Controller::DriveQsmdo), "control.voltage_reserve");
}

const CONTROLLERS: [Controller; 7] = [
    Controller::Bs,
    Controller::BsQsmdo,
    Controller::BsQismc,
    Controller::DriveQsmdo,
    Controller::DriveQismc,
    Controller::Pi,
    Controller::Ladrc,
];

fn check(drive: &Drive<Q31>, config: &DriveConfig, command: BridgeCommand<Q31>) {
    match command {
        BridgeCommand::Off => {}
        BridgeCommand::Duty(duty) => {
            assert!(duty.to_f32(Base::RATIO).abs() <= config.limits.duty, "{duty:?}");
            assert_eq!(drive.mode(), Mode::Running);
        }
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(400))]

    /// From one corner to another in every period, with bits in between: nothing overflows, and the duty stays limited.
    #[test]
    fn no_sequence_of_codes_overflows(
        controller in 0..CONTROLLERS.len(),
        shaped in any::<bool>(),
        samples in prop::collection::vec((0_u8..8, any::<[u16; 4]>(), -1.0_f32..1.0), 1..60),
    ) {
        let mut scenario = scenario("encoder", CONTROLLERS[controller]);
        if !shaped {
            scenario.reference.shape = host_sim::scenario::ShapeName::Step;
            scenario.reference.bandwidth = None;
        }
        let config = scenario.drive_config();
        let mut drive = Drive::<Q31>::new(&config).expect("valid");
        let zero = 2048;
        let mut counter = 0_u16;
        for (kind, [a, b, c, d], share) in samples {
            if kind == 7 {
                let speed = config.limits.speed * if a % 3 == 0 { share.signum() } else { share };
                drive.set_speed(speed).expect("within the limits");
            }
            if kind == 6 {
                drive.clear_fault();
            }
            drive.arm().ok();
            // The furthest that is not a jump, either way, or anything.
            let step: u16 = match kind {
                0 => 33,
                1 => 33_u16.wrapping_neg(),
                2 => b,
                _ => (b % 40).wrapping_sub(20),
            };
            let current = match a % 5 {
                0 => zero + 2039,
                1 => zero - 2039,
                2 => a % 4096,
                _ => zero + (a % 200),
            };
            let encoder = core::array::from_fn(|read| {
                let wanders = if kind == 3 { c.wrapping_mul(read as u16) } else { 0 };
                counter.wrapping_add((u32::from(step) * (read as u32 + 1) / 16) as u16).wrapping_add(wanders)
            });
            counter = counter.wrapping_add(step);
            let bus_voltage = if kind == 4 { d % 4096 } else { 1100 + d % 2600 };
            let sample = Sample::Codes(Codes { current, bus_voltage, encoder, shift: c as u8 });
            for _ in 0..=d % 4 {
                let command = drive.step(&sample);
                check(&drive, &config, command);
            }
        }
        prop_assert_eq!(READS, 16);
    }

    /// The same from exact sensors, with any bits up to a quarter of full scale, where they saturate.
    #[test]
    fn no_sequence_of_exact_samples_overflows(
        controller in 0..CONTROLLERS.len(),
        samples in prop::collection::vec((0_u8..6, -1.0_f32..1.0, -1.0_f32..1.0, any::<[i32; 3]>()), 1..60),
    ) {
        let mut scenario = scenario("paper", CONTROLLERS[controller]);
        if matches!(CONTROLLERS[controller], Controller::Ladrc | Controller::Pi) {
            scenario.reference.steps.clear();
        }
        let config = scenario.drive_config();
        let mut drive = Drive::<Q31>::new(&config).expect("valid");
        let bases = *drive.bases();
        for (kind, speed, current, raw) in samples {
            drive.clear_fault();
            drive.arm().ok();
            let target = config.limits.speed * if raw[0] & 1 == 0 { speed.signum() } else { current };
            drive.set_speed(target).expect("within the limits");
            // At the limits, within, or anything.
            let [speed, current] = match kind {
                0 | 1 => [speed.signum(), current.signum()],
                _ => [speed, current],
            };
            let speed = config.limits.speed * speed;
            let mut sample = Exact {
                speed: Q31::from_f32(speed, bases.speed),
                advance: Q31::from_f32(speed * config.timing.period(), bases.angle),
                current: Q31::from_f32(config.limits.current * current, bases.current),
                bus_voltage: Q31::from_f32(config.limits.bus_max, bases.voltage),
            };
            if kind == 5 {
                let [a, b, c] = raw.map(|bits| Q31(bits >> 2));
                sample = Exact { speed: a, advance: b, current: c, ..sample };
            }
            for _ in 0..=raw[1].rem_euclid(5) {
                let command = drive.step(&Sample::Exact(sample));
                check(&drive, &config, command);
            }
        }
    }
}
