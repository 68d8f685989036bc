//! Whatever comes in, what goes out is finite and bounded, or off.

use proptest::prelude::*;
use quasidrive::control::drive_form::{DriveFormConfig, Memory};
use quasidrive::control::ladrc::LadrcConfig;
use quasidrive::control::paper::{Form, Gains, Law, PaperConfig, Start};
use quasidrive::control::pi::PiConfig;
use quasidrive::control::{ControlConfig, Timing};
use quasidrive::drive::{Drive, DriveConfig, Fault, Limits, Mode, Refusal};
use quasidrive::estimate::SpeedSource;
use quasidrive::hal::{BridgeCommand, Codes, Exact, READS, Sample};
use quasidrive::motor::MotorParameters;
use quasidrive::sense::{Calibration, Reads, Sensors};
use quasidrive::trajectory::Shape;

const LIMITS: Limits = Limits {
    duty: 0.92,
    speed: 400.0,
    current: 40.0,
    current_command: 30.0,
    bus_min: 8.0,
    bus_max: 28.0,
};
const GOOD: Exact<f32> = Exact { speed: 100.0, advance: 5e-3, current: 1.0, bus_voltage: 24.0 };
const TIMING: Timing = Timing { rate: 20_000.0, delay: true };
const SENSORS: Calibration = Calibration {
    current_per_code: 0.025,
    current_zero: 2048.0,
    bus_voltage_per_code: 0.0075,
    counts_per_turn: 4096,
    highest_code: 4095,
    reads: Reads::All,
};

const PAPER_FORM: PaperConfig = PaperConfig {
    law: Law::Qsmdo,
    gains: Gains::PAPER,
    form: Form::Implicit,
    start: Start::Zero,
    speed: SpeedSource::Exact,
};

fn config(law: Law) -> DriveConfig {
    DriveConfig {
        motor: MotorParameters::PAPER,
        sensors: Sensors::Exact,
        control: ControlConfig::Paper(PaperConfig { law, ..PAPER_FORM }),
        timing: TIMING,
        limits: LIMITS,
        shape: Shape::Step,
    }
}

/// Every controller that is not the paper's form, by an encoder or by exact sensors.
fn other_controllers(speed: SpeedSource) -> [ControlConfig; 4] {
    let drive_form = DriveFormConfig::new(1170.0, 0.3, 2.5);
    [
        ControlConfig::Drive(drive_form),
        ControlConfig::Drive(drive_form.with_memory(Memory::Integral)),
        ControlConfig::Pi(PiConfig::magnitude_and_symmetrical_optimum(&TIMING, speed)),
        ControlConfig::Ladrc(LadrcConfig::by_bandwidth(150.0, &TIMING, speed)),
    ]
}

fn armed(config: &DriveConfig) -> Drive<f32> {
    let mut drive = Drive::new(config).expect("valid configuration");
    drive.arm().expect("no fault");
    drive
}

fn any_law() -> impl Strategy<Value = Law> {
    prop_oneof![Just(Law::Backstepping), Just(Law::Qsmdo), Just(Law::Qismc)]
}

fn any_shape() -> impl Strategy<Value = Shape> {
    prop_oneof![
        Just(Shape::Step),
        (1.0..10_000.0_f32).prop_map(|bandwidth| Shape::SecondOrder { bandwidth }),
        (10.0..1e5_f32, 1e-3..1.0_f32).prop_map(|(acceleration, share)| Shape::SCurve {
            acceleration,
            jerk: share * acceleration * TIMING.rate,
        })
    ]
}

/// Any finite number, most of them absurd.
fn finite() -> impl Strategy<Value = f32> {
    prop::num::f32::NORMAL | prop::num::f32::SUBNORMAL | prop::num::f32::ZERO
}

/// Plausible samples, one in four with an absurd field.
fn finite_sample() -> impl Strategy<Value = Exact<f32>> {
    (plausible(), finite(), 0..12).prop_map(|(sample, absurd, field)| match field {
        0 => Exact { speed: absurd, ..sample },
        1 => Exact { current: absurd, ..sample },
        2 => Exact { bus_voltage: absurd, ..sample },
        _ => sample,
    })
}

fn exact(speed: f32, current: f32, bus_voltage: f32) -> Exact<f32> {
    Exact { speed, advance: speed * TIMING.period(), current, bus_voltage }
}

fn plausible() -> impl Strategy<Value = Exact<f32>> {
    (-400.0..=400.0_f32, -40.0..=40.0_f32, 8.0..=28.0_f32)
        .prop_map(|(speed, current, bus_voltage)| exact(speed, current, bus_voltage))
}

proptest! {
    #[test]
    fn any_finite_sample_gives_a_finite_bounded_command(
        law in any_law(),
        samples in prop::collection::vec(finite_sample(), 1..50),
    ) {
        let mut drive = armed(&config(law));
        for sample in samples {
            if let BridgeCommand::Duty(duty) = drive.step(&Sample::Exact(sample)) {
                prop_assert!(duty.is_finite() && duty.abs() <= LIMITS.duty, "{duty}");
            } else {
                prop_assert!(matches!(drive.mode(), Mode::Faulted(_)));
            }
        }
    }

    #[test]
    fn plausible_samples_in_any_order_keep_the_drive_running_and_bounded(
        law in any_law(),
        form in prop_oneof![Just(Form::Implicit), Just(Form::Explicit)],
        shape in any_shape(),
        periods in prop::collection::vec((plausible(), -400.0..=400.0_f32), 1..300),
    ) {
        let mut config = config(law);
        config.control = in_form(&config, form);
        config.shape = shape;
        let mut drive = armed(&config);
        for (sample, target) in periods {
            prop_assert_eq!(drive.set_speed(target), Ok(()));
            match drive.step(&Sample::Exact(sample)) {
                BridgeCommand::Duty(duty) => {
                    prop_assert!(duty.is_finite() && duty.abs() <= LIMITS.duty, "{}", duty);
                }
                BridgeCommand::Off => prop_assert!(false, "stopped by {:?}", drive.mode()),
            }
            let telemetry = drive.telemetry().expect("a period was driven");
            // |d̂| ≤ k1, by construction of the injection.
            prop_assert!(telemetry.signals.disturbance.abs() <= 1300.0 * (1.0 + f32::EPSILON));
            prop_assert!(telemetry.sliding_variables.iter().all(|y| y.is_finite()));
        }
    }

    /// Whatever a broken encoder, converter or cable delivers: a finite duty, or off for good.
    #[test]
    fn any_codes_give_a_finite_bounded_command(
        controller in 0..4_usize,
        fed in any::<bool>(),
        periods in prop::collection::vec((0..4096_u16, 1100..3700_u16, any::<[u16; READS]>(), any::<u8>()), 1..50),
        repeat in 1..40_usize,
    ) {
        let speed = SpeedSource::Pll { bandwidth: 4000.0, fed };
        let config = DriveConfig {
            sensors: Sensors::Codes(SENSORS),
            control: other_controllers(speed)[controller],
            ..config(Law::Qsmdo)
        };
        let mut drive = armed(&config);
        drive.set_speed(100.0).expect("in range");
        for (current, bus_voltage, encoder, shift) in periods.iter().copied().cycle().take(periods.len() * repeat) {
            let was = drive.mode();
            match drive.step(&Sample::Codes(Codes { current, bus_voltage, encoder, shift })) {
                BridgeCommand::Duty(duty) => {
                    prop_assert!(was == Mode::Running && duty.is_finite() && duty.abs() <= LIMITS.duty);
                }
                BridgeCommand::Off => prop_assert!(matches!(drive.mode(), Mode::Faulted(_))),
            }
        }
    }

    #[test]
    fn other_controllers_stay_finite_on_plausible_samples(
        controller in 0..4_usize,
        shape in any_shape(),
        periods in prop::collection::vec((plausible(), -400.0..=400.0_f32), 1..1000),
    ) {
        let config = DriveConfig {
            control: other_controllers(SpeedSource::Exact)[controller],
            shape,
            ..config(Law::Qsmdo)
        };
        let mut drive = armed(&config);
        for (sample, target) in periods {
            prop_assert_eq!(drive.set_speed(target), Ok(()));
            match drive.step(&Sample::Exact(sample)) {
                BridgeCommand::Duty(duty) => {
                    prop_assert!(duty.is_finite() && duty.abs() <= LIMITS.duty, "{}", duty);
                }
                BridgeCommand::Off => prop_assert!(matches!(drive.mode(), Mode::Faulted(_))),
            }
        }
    }

    #[test]
    fn nan_or_infinity_anywhere_switches_off_for_good(
        law in any_law(),
        before in prop::collection::vec(plausible(), 0..20),
        broken in plausible(),
        bad in prop_oneof![Just(f32::NAN), Just(f32::INFINITY), Just(f32::NEG_INFINITY)],
        field in 0..4,
        after in prop::collection::vec(plausible(), 1..20),
    ) {
        let mut drive = armed(&config(law));
        for sample in &before {
            drive.step(&Sample::Exact(*sample));
        }
        let broken = match field {
            0 => Exact { speed: bad, ..broken },
            1 => Exact { current: bad, ..broken },
            2 => Exact { advance: bad, ..broken },
            _ => Exact { bus_voltage: bad, ..broken },
        };
        prop_assert_eq!(drive.step(&Sample::Exact(broken)), BridgeCommand::Off);
        prop_assert_eq!(drive.mode(), Mode::Faulted(Fault::BadSample));
        for sample in &after {
            prop_assert_eq!(drive.step(&Sample::Exact(*sample)), BridgeCommand::Off);
        }
        prop_assert_eq!(drive.arm(), Err(Refusal::Faulted(Fault::BadSample)));
    }

    /// Valid values of any size, one in two sets with an absurd one among them.
    #[test]
    fn no_configuration_panics(
        decades in prop::array::uniform16(-12.0..12.0_f32),
        (absurd, place) in (
            prop_oneof![finite(), Just(f32::NAN), Just(f32::INFINITY), Just(-1.0_f32)],
            0..32_usize,
        ),
        valid_limits in any::<bool>(),
        law in any_law(),
    ) {
        let mut values = decades.map(|decade| 10_f32.powf(decade));
        if valid_limits {
            values[10..].copy_from_slice(&[20_000.0, 0.92, 400.0, 40.0, 8.0, 28.0]);
        }
        if let Some(value) = values.get_mut(place) {
            *value = absurd;
        }
        let _ = Drive::<f32>::new(&from_values(law, values));
    }

    /// Over decades around the paper's values. Most sets are accepted: proptest fails when too many are not.
    #[test]
    fn every_accepted_configuration_gives_finite_commands(
        law in any_law(),
        form in prop_oneof![Just(Form::Implicit), Just(Form::Explicit)],
        decades in prop::array::uniform12(-1.5..1.5_f32),
        samples in prop::collection::vec(
            (-1.0..=1.0_f32, -1.0..=1.0_f32, 0.0..=1.0_f32, -1.0..=1.0_f32), 1..200),
    ) {
        let around = [7.95e-5, 105e-6, 0.7, 1e-5, 59e-3, 200.0, 1300.0, 0.05, 755e3, 5.0, 400.0, 40.0];
        let mut scaled = decades;
        for (value, around) in scaled.iter_mut().zip(around) {
            *value = around * 10_f32.powf(*value);
        }
        let [inertia, inductance, resistance, friction, back_emf, c, k1, epsilon1, k2, epsilon2, speed, current] =
            scaled;
        let mut config = from_values(law, [
            inertia, inductance, resistance, friction, back_emf, c, k1, epsilon1, k2, epsilon2,
            20_000.0, 0.92, speed, current, 8.0, 28.0,
        ]);
        config.control = in_form(&config, form);
        let built = Drive::<f32>::new(&config);
        prop_assume!(built.is_ok());
        let mut drive = built.expect("just checked");
        drive.arm().expect("no fault");
        for (speed, current, bus, target) in samples {
            prop_assert_eq!(drive.set_speed(target * config.limits.speed), Ok(()));
            let sample = exact(
                speed * config.limits.speed,
                current * config.limits.current,
                (8.0 + 20.0 * bus).min(28.0),
            );
            match drive.step(&Sample::Exact(sample)) {
                BridgeCommand::Duty(duty) => {
                    prop_assert!(duty.is_finite() && duty.abs() <= config.limits.duty, "{}", duty);
                }
                BridgeCommand::Off => prop_assert!(false, "stopped by {:?}", drive.mode()),
            }
        }
    }
}

fn from_values(law: Law, values: [f32; 16]) -> DriveConfig {
    let [
        inertia,
        inductance,
        resistance,
        viscous_friction,
        back_emf_constant,
        c,
        k1,
        epsilon1,
        k2,
        epsilon2,
        rate,
        duty,
        speed,
        current,
        bus_min,
        bus_max,
    ] = values;
    DriveConfig {
        motor: MotorParameters {
            inertia,
            inductance,
            resistance,
            viscous_friction,
            back_emf_constant,
        },
        timing: Timing { rate, delay: true },
        limits: Limits { duty, speed, current, current_command: 0.75 * current, bus_min, bus_max },
        ..with_gains(config(law), Gains { c, k1, epsilon1, k2, epsilon2 })
    }
}

#[test]
fn outputs_are_off_until_armed_and_after_disarming() {
    let mut drive = Drive::<f32>::new(&config(Law::Qsmdo)).expect("valid configuration");
    assert_eq!(drive.mode(), Mode::Off);
    assert_eq!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Off);
    drive.arm().expect("no fault");
    assert!(matches!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Duty(_)));
    drive.disarm();
    assert_eq!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Off);
    assert_eq!(BridgeCommand::<f32>::default(), BridgeCommand::Off);
}

#[test]
fn each_limit_has_its_fault_and_faults_stay() {
    let cases = [
        (Exact { speed: 401.0, ..GOOD }, Fault::Overspeed),
        (Exact { speed: -401.0, ..GOOD }, Fault::Overspeed),
        (Exact { current: 40.5, ..GOOD }, Fault::Overcurrent),
        (Exact { current: -40.5, ..GOOD }, Fault::Overcurrent),
        (Exact { bus_voltage: 7.9, ..GOOD }, Fault::BusUndervoltage),
        (Exact { bus_voltage: 0.0, ..GOOD }, Fault::BusUndervoltage),
        (Exact { bus_voltage: 28.1, ..GOOD }, Fault::BusOvervoltage),
    ];
    for (sample, fault) in cases {
        let mut drive = armed(&config(Law::Qsmdo));
        assert_eq!(drive.step(&Sample::Exact(sample)), BridgeCommand::Off, "{fault:?}");
        assert_eq!(drive.mode(), Mode::Faulted(fault));
        assert_eq!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Off, "{fault:?} must stay");
        drive.disarm();
        assert_eq!(drive.arm(), Err(Refusal::Faulted(fault)), "disarming clears no fault");
        drive.clear_fault();
        assert_eq!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Off, "clearing does not arm");
        drive.arm().expect("cleared");
        assert!(matches!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Duty(_)));
    }
}

#[test]
fn commands_out_of_range_are_refused_and_the_former_stays() {
    let mut drive = armed(&config(Law::Qsmdo));
    drive.set_speed(100.0).expect("in range");
    for bad in [f32::NAN, f32::INFINITY, 400.1, -400.1] {
        assert_eq!(drive.set_speed(bad), Err(Refusal::SpeedOutOfRange), "{bad}");
    }
    drive.step(&Sample::Exact(GOOD));
    let telemetry = drive.telemetry().expect("a period was driven");
    assert_eq!(telemetry.reference.speed, 100.0);
}

#[test]
fn a_drive_that_ran_starts_anew_when_armed_again() {
    for shape in [Shape::Step, Shape::SecondOrder { bandwidth: 50.0 }] {
        let config = DriveConfig { shape, ..config(Law::Qsmdo) };
        let mut used = armed(&config);
        used.set_speed(100.0).expect("in range");
        for step in 0..1000 {
            used.step(&Sample::Exact(Exact { speed: step as f32 * 0.1, ..GOOD }));
        }
        used.disarm();
        let mut fresh = Drive::new(&config).expect("valid configuration");
        fresh.set_speed(100.0).expect("in range");
        for drive in [&mut used, &mut fresh] {
            assert_eq!(drive.step(&Sample::Exact(GOOD)), BridgeCommand::Off);
            drive.arm().expect("no fault");
        }
        for _ in 0..10 {
            assert_eq!(
                used.step(&Sample::Exact(GOOD)),
                fresh.step(&Sample::Exact(GOOD)),
                "{shape:?}"
            );
        }
    }
}

#[test]
fn the_duty_is_the_voltage_over_the_measured_bus() {
    for bus_voltage in [12.0, 24.0, 28.0] {
        let mut drive = armed(&config(Law::Qsmdo));
        drive.set_speed(104.72).expect("in range");
        let sample = exact(0.0, 0.0, bus_voltage);
        let BridgeCommand::Duty(duty) = drive.step(&Sample::Exact(sample)) else {
            unreachable!("off at {bus_voltage} V")
        };
        let telemetry = drive.telemetry().expect("a period was driven");
        assert_eq!(duty, telemetry.signals.voltage / bus_voltage);
        assert!((telemetry.voltage - 0.6995).abs() < 1e-3, "{} V", telemetry.voltage);
    }
}

#[test]
fn telemetry_tells_the_voltage_after_the_limit() {
    let mut drive = armed(&config(Law::Backstepping));
    drive.set_speed(400.0).expect("in range");
    // At −400 rad/s and −40 A the law wants far more than the bus has.
    let sample = exact(400.0, 40.0, 10.0);
    let BridgeCommand::Duty(duty) = drive.step(&Sample::Exact(sample)) else {
        unreachable!("within the limits")
    };
    // The limit of the voltage, divided by the bus again.
    assert!(duty <= 0.92 && duty > 0.92 * (1.0 - 2.0 * f32::EPSILON), "{duty}");
    let telemetry = drive.telemetry().expect("a period was driven");
    assert!(telemetry.signals.voltage > 20.0, "{}", telemetry.signals.voltage);
    assert_eq!(telemetry.voltage, 9.2);
}

#[test]
fn the_estimators_memory_is_bounded() {
    // Held far from its reference for minutes, the drive must come back within the time that a start takes: the
    // mismatch it remembers is limited to what a start from anywhere needs.
    let mut drive = armed(&config(Law::Qsmdo));
    drive.set_speed(400.0).expect("in range");
    let stuck = exact(-400.0, 0.0, 24.0);
    for _ in 0..2_000_000 {
        drive.step(&Sample::Exact(stuck));
    }
    let [first, second] = drive.telemetry().expect("driven").sliding_variables;
    assert!(first.abs() <= 800.0, "{first}");
    // c·800 rad/s + a2·40 A + k1, and a horizon of k2.
    assert!(second.abs() <= 160_000.0 + 29_700.0 + 1_300.0, "{second}");
}

#[test]
fn refused_configurations_name_the_field() {
    let good = config(Law::Qsmdo);
    let cases: [(DriveConfig, &str); 12] = [
        (
            DriveConfig { motor: MotorParameters { inertia: 0.0, ..good.motor }, ..good },
            "motor.inertia",
        ),
        (DriveConfig { timing: Timing { rate: 0.0, ..good.timing }, ..good }, "timing.rate"),
        (DriveConfig { timing: Timing { rate: f32::NAN, ..good.timing }, ..good }, "timing.rate"),
        (DriveConfig { limits: Limits { duty: 1.01, ..LIMITS }, ..good }, "limits.duty"),
        (DriveConfig { limits: Limits { current: 0.0, ..LIMITS }, ..good }, "limits.current"),
        (DriveConfig { limits: Limits { speed: f32::INFINITY, ..LIMITS }, ..good }, "limits.speed"),
        (DriveConfig { limits: Limits { bus_min: 30.0, ..LIMITS }, ..good }, "limits.bus_max"),
        (
            DriveConfig { shape: Shape::SecondOrder { bandwidth: -1.0 }, ..good },
            "reference.bandwidth",
        ),
        (with_gains(good, Gains { epsilon2: 1e-2, ..Gains::PAPER }), "control.gains.epsilon2"),
        (
            with_gains(good, Gains { k1: 1e-9, epsilon1: 1e-6, ..Gains::PAPER }),
            "control.gains.epsilon1",
        ),
        (with_gains(good, Gains { c: 4001.0, ..Gains::PAPER }), "control.gains.c"),
        (with_gains(good, Gains { k2: 1e30, epsilon2: 1e27, ..Gains::PAPER }), "control.gains"),
    ];
    for (config, field) in cases {
        assert_eq!(Drive::<f32>::new(&config).expect_err(field).field, field);
    }
    for bad in [0.0, -1.0, f32::NAN, f32::INFINITY] {
        let cases = [
            (Gains { c: bad, ..Gains::PAPER }, "control.gains.c"),
            (Gains { k1: bad, ..Gains::PAPER }, "control.gains.k1"),
            (Gains { epsilon1: bad, ..Gains::PAPER }, "control.gains.epsilon1"),
            (Gains { k2: bad, ..Gains::PAPER }, "control.gains.k2"),
            (Gains { epsilon2: bad, ..Gains::PAPER }, "control.gains.epsilon2"),
        ];
        for (gains, field) in cases {
            let refused = Drive::<f32>::new(&with_gains(good, gains)).expect_err(field);
            assert_eq!(refused.field, field, "{bad}");
        }
    }
}

fn paper_form(config: &DriveConfig) -> PaperConfig {
    let ControlConfig::Paper(paper) = config.control else { unreachable!("made by `config`") };
    paper
}

fn in_form(config: &DriveConfig, form: Form) -> ControlConfig {
    ControlConfig::Paper(PaperConfig { form, ..paper_form(config) })
}

fn with_gains(config: DriveConfig, gains: Gains) -> DriveConfig {
    let paper = PaperConfig { gains, ..paper_form(&config) };
    DriveConfig { control: ControlConfig::Paper(paper), ..config }
}
