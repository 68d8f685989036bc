//! Fixed point over random configurations: whatever `Drive::<Q31>::new` accepts must neither overflow nor differ from `f32`.
//! Overflow checks are on here.

use host_sim::plant::{Armature, Motor, Plant, State};
use proptest::prelude::*;
use quasidrive::control::ControlConfig;
use quasidrive::control::Timing;
use quasidrive::control::drive_form::{DriveFormConfig, Memory};
use quasidrive::control::ladrc::LadrcConfig;
use quasidrive::control::paper::{Form, Gains, Law, PaperConfig, Start};
use quasidrive::control::pi::PiConfig;
use quasidrive::drive::{Drive, DriveConfig, Fault, Limits, Mode};
use quasidrive::estimate::SpeedSource;
use quasidrive::hal::{BridgeCommand, Codes, Exact, READS, Sample};
use quasidrive::math::{Base, Q31, Scalar};
use quasidrive::motor::MotorParameters;
use quasidrive::sense::{Calibration, Reads, Sensors};
use quasidrive::shunts::CurrentSensors;
use quasidrive::supervisor::{Command, Conditions, Protection, Supervisor};
use quasidrive::trajectory::Shape;

/// From `low` to `high`, evenly in the logarithm; the ends themselves often.
fn log(share: f32, [low, high]: [f32; 2]) -> f32 {
    let share = (1.2 * share - 0.1).clamp(0.0, 1.0);
    low * (high / low).powf(share)
}

fn source(x: &[f32], rate: f32) -> SpeedSource {
    let bandwidth = log(x[1], [1e-3 * rate, 0.999 * rate]);
    match (x[0] * 4.0) as u32 {
        0 => SpeedSource::Difference { bandwidth },
        1 => SpeedSource::Pll { bandwidth, fed: false },
        2 => SpeedSource::Pll { bandwidth, fed: true },
        _ => SpeedSource::Exact,
    }
}

fn lag(source: &SpeedSource, rate: f32) -> f32 {
    match *source {
        SpeedSource::Exact => 0.0,
        SpeedSource::Difference { bandwidth } => 1.0 / bandwidth + 1.0 / rate,
        SpeedSource::Pll { bandwidth, .. } => 2.0 / bandwidth,
    }
}

fn control(x: &[f32], motor: &MotorParameters, timing: &Timing, limits: &Limits) -> ControlConfig {
    let rate = timing.rate;
    let a2 = motor.back_emf_constant / motor.inertia;
    let speed = source(&x[6..], rate);
    let current_bandwidth = log(x[1], [1e-3, 1.0]) * 0.5 * rate;
    let torque = motor.back_emf_constant * limits.current;
    match (x[0] * 6.0) as u32 {
        0 | 1 => {
            let bandwidth = log(x[1], [1e-3, 0.13]) * rate;
            let base = DriveFormConfig::new(
                bandwidth,
                torque * log(x[2], [1e-2, 3.0]),
                limits.bus_max * log(x[3], [1e-3, 1.0]),
            );
            ControlConfig::Drive(DriveFormConfig {
                memory: if x[0] < 1.0 / 6.0 { Memory::Observer } else { Memory::Integral },
                speed_bandwidth: bandwidth * log(x[4], [0.01, 0.7]),
                current_bandwidth: rate * log(x[5], [1e-3, 1.0]),
                voltage_bandwidth: rate * log(x[6], [1e-4, 0.2]),
                output_bandwidth: rate * log(x[7], [1e-3, 10.0]),
                ..base
            })
        }
        2 | 3 => {
            let lag = 1.0 / current_bandwidth + lag(&speed, rate);
            let speed_damping = log(x[2], [0.5, 5.0]);
            ControlConfig::Pi(PiConfig {
                current_bandwidth,
                speed_bandwidth: (0.49f32).min(0.39 / speed_damping) / lag * log(x[3], [1e-3, 1.0]),
                speed_damping,
                disturbance: (x[0] < 0.5).then_some(
                    log(x[4], [1e-3, 0.99])
                        * (0.5 * rate).min(0.6 / self::lag(&speed, rate).max(1e-6)),
                ),
                speed,
            })
        }
        4 => ControlConfig::Ladrc(LadrcConfig {
            control_bandwidth: 0.6 * current_bandwidth * log(x[2], [1e-3, 1.0]),
            observer_bandwidth: log(x[3], [1e-3, 0.99])
                * (0.5 * rate).min(0.6 / lag(&speed, rate).max(1e-6)),
            current_bandwidth,
            speed,
        }),
        _ => ControlConfig::Paper(PaperConfig {
            law: [Law::Backstepping, Law::Qsmdo, Law::Qismc][(x[1] * 2.99) as usize],
            gains: Gains {
                c: 0.4 / timing.horizon() * log(x[2], [1e-3, 1.0]),
                k1: a2 * limits.current * log(x[3], [1e-3, 2.0]),
                epsilon1: log(x[4], [1e-3, 1.0]) * limits.speed * 0.01,
                k2: log(x[5], [1e3, 1e8]),
                epsilon2: log(x[9], [1e-1, 1e3]),
            },
            form: Form::Implicit,
            start: if x[8] < 0.5 { Start::Zero } else { Start::Matched },
            speed,
        }),
    }
}

const NUMBERS: usize = 40;

fn configuration(x: &[f32]) -> DriveConfig {
    let timing = Timing { rate: log(x[0], [2e3, 1e5]), delay: x[1] < 0.9 };
    let bus_max = log(x[2], [6.0, 400.0]);
    let current = log(x[3], [0.2, 100.0]);
    let resistance = bus_max / current * log(x[4], [0.05, 2.0]);
    let inductance = resistance * log(x[5], [2e-5, 2e-2]);
    let counts = log(x[6], [16.0, 65536.0]) as i32;
    let count = core::f32::consts::TAU / counts as f32;
    let speed = log(x[7], [20.0, 3000.0]).min(990.0 * count * timing.rate);
    let back_emf_constant = bus_max / speed * log(x[8], [0.2, 1.5]);
    // Time constant of the shaft.
    let inertia = back_emf_constant * back_emf_constant / resistance * log(x[9], [1e-3, 3.0]);
    let viscous_friction = if x[10] < 0.4 { 0.0 } else { inertia * log(x[10], [1e-2, 50.0]) };
    let limits = Limits {
        duty: log(x[11], [0.3, 1.0]),
        speed,
        current,
        current_command: current * log(x[12], [0.2, 1.0]),
        bus_min: 0.3 * bus_max,
        bus_max,
    };
    let motor =
        MotorParameters { inertia, inductance, resistance, viscous_friction, back_emf_constant };
    let reads = [Reads::All, Reads::Shifted, Reads::Last, Reads::Edges][(x[13] * 3.99) as usize];
    let sensors = if x[14] < 0.1 {
        Sensors::Exact
    } else {
        Sensors::Codes(Calibration {
            current_per_code: 1.05 * current / 2048.0 * if x[14] < 0.4 { -1.0 } else { 1.0 },
            current_zero: 2048.0,
            bus_voltage_per_code: 1.1 * bus_max / 4095.0,
            counts_per_turn: if x[15] < 0.3 { -counts } else { counts },
            highest_code: 4095,
            reads,
        })
    };
    let acceleration = speed * log(x[17], [0.5, 1e4]);
    let shape = match (x[16] * 3.0) as u32 {
        0 => Shape::Step,
        1 => Shape::SecondOrder { bandwidth: timing.rate * log(x[17], [1e-5, 0.5]) },
        _ => Shape::SCurve {
            acceleration,
            jerk: acceleration * timing.rate * log(x[18], [1e-4, 1.0]),
        },
    };
    let control = control(&x[20..], &motor, &timing, &limits);
    DriveConfig { motor, sensors, control, timing, limits, shape }
}

/// The motor, its encoder and converters, without noise.
struct Rig {
    plant: Plant,
    state: State,
    angle: f64,
    load: f64,
    reads: [f64; READS],
    advance: f64,
    config: DriveConfig,
    pending: Option<f64>,
}

impl Rig {
    fn new(config: &DriveConfig) -> Self {
        let m = config.motor;
        let plant = Plant::new(Motor {
            inertia: m.inertia.into(),
            inductance: m.inductance.into(),
            resistance: m.resistance.into(),
            back_emf_constant: m.back_emf_constant.into(),
            viscous_friction: m.viscous_friction.into(),
            coulomb_friction: 0.0,
        });
        Self {
            plant,
            state: State::default(),
            angle: 0.3,
            load: 0.0,
            reads: [0.3; READS],
            advance: 0.0,
            config: *config,
            pending: None,
        }
    }

    fn bus(&self) -> f64 {
        0.8 * f64::from(self.config.limits.bus_max)
    }

    fn sample<S: Scalar>(&self, drive: &Drive<S>) -> Sample<S> {
        let bases = drive.bases();
        match self.config.sensors {
            Sensors::Exact => Sample::Exact(Exact {
                speed: S::from_f32(self.state.speed as f32, bases.speed),
                advance: S::from_f32(self.advance as f32, bases.angle),
                current: S::from_f32(self.state.current as f32, bases.current),
                bus_voltage: S::from_f32(self.bus() as f32, bases.voltage),
            }),
            Sensors::Codes(c) => {
                let current = (self.state.current / f64::from(c.current_per_code) + 2048.0).round();
                Sample::Codes(Codes {
                    current: current.clamp(0.0, 4095.0) as u16,
                    bus_voltage: (self.bus() / f64::from(c.bus_voltage_per_code)) as u16,
                    encoder: self
                        .reads
                        .map(|angle| (angle / f64::from(c.count())).floor() as i64 as u16),
                    shift: 0,
                })
            }
        }
    }

    fn advance(&mut self, command: Option<f64>) {
        let acting = if self.config.timing.delay {
            core::mem::replace(&mut self.pending, command)
        } else {
            command
        };
        let armature = match acting {
            Some(duty) => Armature::Driven(duty * self.bus()),
            None => Armature::Open(self.bus()),
        };
        let h = f64::from(self.config.timing.period());
        let steps = self.plant.steps_for(h / READS as f64);
        let before = self.angle;
        for read in 0..READS {
            for _ in 0..steps {
                let h = h / (READS * steps) as f64;
                let speed = self.state.speed;
                self.state = self.plant.step(self.state, armature, [self.load; 3], h);
                self.angle += 0.5 * h * (speed + self.state.speed);
            }
            self.reads[read] = self.angle;
        }
        self.advance = self.angle - before;
    }
}

struct Played {
    /// Of true speed less command, each sixteenth of the run.
    speeds: Vec<f64>,
    fault: Option<Fault>,
}

fn play<S: Scalar>(config: &DriveConfig, periods: usize, steps: &[(f32, f64)]) -> Option<Played> {
    let mut drive = Drive::<S>::new(config).ok()?;
    let mut rig = Rig::new(config);
    drive.arm().ok();
    let mut speeds = Vec::new();
    for &(target, load) in steps {
        drive.set_speed(target).ok();
        rig.load = load;
        for _ in 0..periods {
            let command = match drive.step(&rig.sample(&drive)) {
                BridgeCommand::Off => None,
                BridgeCommand::Duty(duty) => Some(f64::from(duty.to_f32(Base::RATIO))),
            };
            if let Mode::Faulted(fault) = drive.mode() {
                return Some(Played { speeds, fault: Some(fault) });
            }
            rig.advance(command);
            speeds.push(rig.state.speed);
        }
    }
    Some(Played { speeds, fault: None })
}

fn numbers() -> impl Strategy<Value = Vec<f32>> {
    prop::collection::vec(0.0_f32..1.0, NUMBERS)
}

fn cases(default: u32) -> ProptestConfig {
    let cases = std::env::var("CASES").ok().and_then(|n| n.parse().ok()).unwrap_or(default);
    ProptestConfig {
        max_global_rejects: 1_000_000,
        failure_persistence: None,
        max_shrink_iters: 300,
        ..ProptestConfig::with_cases(cases)
    }
}

fn check(config: &DriveConfig, command: BridgeCommand<Q31>) {
    if let BridgeCommand::Duty(duty) = command {
        assert!(duty.to_f32(Base::RATIO).abs() <= config.limits.duty * 1.0001, "{duty:?}");
    }
}

proptest! {
    #![proptest_config(cases(2000))]

    #[test]
    fn no_codes_overflow_whatever_the_configuration(
        x in numbers(),
        other in numbers(),
        samples in prop::collection::vec((0_u8..10, any::<[u16; 4]>(), -1.0_f32..1.0), 1..80),
    ) {
        let mut x = x;
        if std::env::var_os("CODES").is_some() { x[14] = 0.1 + 0.9 * x[14]; }
        let config = configuration(&x);
        let built = Drive::<Q31>::new(&config);
        prop_assume!(built.is_ok());
        let mut drive = built.expect("ok");
        let bases = *drive.bases();
        let second = DriveConfig {
            control: control(&other, &config.motor, &config.timing, &config.limits),
            ..config
        };
        let second = Drive::<Q31>::new(&second).ok();
        let first = Drive::<Q31>::new(&config).ok();
        let mut counter = 0_u16;
        for (kind, [a, b, c, d], share) in samples {
            if kind >= 7 {
                let speed = config.limits.speed * if a % 3 == 0 { share.signum() } else { share };
                drive.set_speed(0.999 * speed).expect("within");
            }
            match d % 16 { 0 | 1 => drive.clear_fault(), 2 => drive.disarm(), _ => {} }
            if d % 5 != 0 { drive.clear_fault(); drive.arm().ok(); }
            if c % 16 == 0 && let Some(second) = &second { drive.take_controller(&mut second.clone()); }
            if c % 16 == 1 && let Some(first) = &first { drive.take_controller(&mut first.clone()); }
            let fastest = match config.sensors {
                Sensors::Codes(k) => (config.limits.speed * config.timing.period() / k.count().abs()) as u16,
                Sensors::Exact => 0,
            };
            let step: u16 = match kind {
                0 | 4 => fastest.max(1),
                1 | 5 => fastest.max(1).wrapping_neg(),
                2 => b,
                3 => 2 * fastest + 2,
                6 => (2 * fastest + 2).wrapping_neg(),
                _ => (b % (2 * fastest + 2)).wrapping_sub(fastest),
            };
            let current = match a % 5 { 0 => 2048 + 1950, 1 => 2048 - 1950, 2 => a % 4096, _ => 2048 + (a % 100) };
            for _ in 0..=d % 6 {
                let encoder = core::array::from_fn(|read| {
                    let wanders = if kind == 3 { c.wrapping_mul(read as u16) } else { 0 };
                    counter.wrapping_add((i32::from(step as i16) * (read as i32 + 1) / 16) as u16).wrapping_add(wanders)
                });
                counter = counter.wrapping_add(step);
                let bus_voltage = if kind == 4 { d % 4096 } else { 1300 + d % 2400 };
                let sample = match config.sensors {
                    Sensors::Codes(_) => Sample::Codes(Codes { current, bus_voltage, encoder, shift: c as u8 }),
                    Sensors::Exact => Sample::Exact(Exact {
                        speed: Q31(if kind == 2 { (i32::from(b as i16) << 16) >> 2 } else { Q31::from_f32(share.signum() * config.limits.speed, bases.speed).0 }),
                        advance: Q31(if kind == 2 { (i32::from(c as i16) << 16) >> 2 } else { Q31::from_f32(share.signum() * config.limits.speed * config.timing.period(), bases.angle).0 }),
                        current: Q31::from_f32(config.limits.current * share, bases.current),
                        bus_voltage: Q31::from_f32(config.limits.bus_max * 0.9, bases.voltage),
                    }),
                };
                let command = drive.step(&sample);
                drive.telemetry();
                check(&config, command);
            }
        }
    }
}

proptest! {
    #![proptest_config(cases(300))]

    /// In closed loop at saturation, from end to end, with a change of controllers and a coast between.
    #[test]
    fn no_closed_loop_overflows(x in numbers(), other in numbers(), targets in prop::collection::vec((-1.0_f32..1.0, -1.0_f64..1.0), 5)) {
        let config = configuration(&x);
        let built = Drive::<Q31>::new(&config);
        prop_assume!(built.is_ok());
        let mut drive = built.expect("ok");
        let mut rig = Rig::new(&config);
        prop_assume!(rig.plant.steps_for(f64::from(config.timing.period()) / 16.0) < 50);
        let second = Drive::<Q31>::new(&DriveConfig { control: control(&other, &config.motor, &config.timing, &config.limits), ..config });
        for (number, (target, load)) in targets.iter().enumerate() {
            drive.set_speed(0.99 * target * config.limits.speed).expect("within");
            rig.load = load * f64::from(config.motor.back_emf_constant * config.limits.current);
            if number == 3 && let Ok(second) = &second { drive.take_controller(&mut second.clone()); }
            for period in 0..400 {
                if number == 2 && period < 100 { drive.disarm(); } else { drive.clear_fault(); drive.arm().ok(); }
                let command = drive.step(&rig.sample(&drive));
                check(&config, command);
                rig.advance(match command { BridgeCommand::Off => None, BridgeCommand::Duty(d) => Some(d.to_f32(Base::RATIO).into()) });
            }
        }
    }
}

const PAPER_LIMITS: Limits = Limits {
    duty: 0.92,
    speed: 400.0,
    current: 20.0,
    current_command: 15.0,
    bus_min: 8.0,
    bus_max: 28.0,
};

fn paper(counts: i32, reads: Reads, rate: f32, speed: f32, control: ControlConfig) -> DriveConfig {
    DriveConfig {
        motor: MotorParameters::PAPER,
        sensors: Sensors::Codes(Calibration {
            current_per_code: 0.01,
            current_zero: 2048.0,
            bus_voltage_per_code: 0.0075,
            counts_per_turn: counts,
            highest_code: 4095,
            reads,
        }),
        control,
        timing: Timing { rate, delay: true },
        limits: Limits { speed, ..PAPER_LIMITS },
        shape: Shape::SecondOrder { bandwidth: 60.0 },
    }
}

fn slow_pi(speed: SpeedSource) -> ControlConfig {
    ControlConfig::Pi(PiConfig {
        current_bandwidth: 2000.0,
        speed_bandwidth: 20.0,
        speed_damping: 1.0,
        disturbance: None,
        speed,
    })
}

/// The mean speed over the last quarter, in both.
fn settled(config: &DriveConfig, target: f32) -> [f64; 2] {
    let periods = (2.0 * config.timing.rate) as usize;
    [play::<f32>(config, periods, &[(target, 0.0)]), play::<Q31>(config, periods, &[(target, 0.0)])]
        .map(|played| {
            let played = played.unwrap_or_else(|| {
                unreachable!(
                    "refused: {:?} {:?}",
                    Drive::<f32>::new(config).err(),
                    Drive::<Q31>::new(config).err()
                )
            });
            if let Some(fault) = played.fault {
                println!("{fault:?} after {}", played.speeds.len());
            }
            let last = &played.speeds[played.speeds.len() * 3 / 4..];
            last.iter().sum::<f64>() / last.len() as f64
        })
}

#[test]
fn a_coarse_encoders_edges_tell_the_same_speed() {
    let config = paper(64, Reads::Edges, 20_000.0, 400.0, slow_pi(SpeedSource::Exact));
    let [float, fixed] = settled(&config, 150.0);
    assert!((fixed / float - 1.0).abs() < 0.02, "{fixed} is not {float}");
}

#[test]
fn a_coarse_encoders_difference_tells_the_same_speed() {
    let config = paper(
        64,
        Reads::Last,
        40_000.0,
        200.0,
        slow_pi(SpeedSource::Difference { bandwidth: 500.0 }),
    );
    let [float, fixed] = settled(&config, 100.0);
    assert!((fixed / float - 1.0).abs() < 0.02, "{fixed} is not {float}");
}

#[test]
fn heat_trips_with_a_long_thermal_time() {
    fn trips<S: Scalar>(rate: f32, thermal_time: f32) -> bool {
        let mut config = paper(
            4096,
            Reads::All,
            rate,
            400.0,
            slow_pi(SpeedSource::Pll { bandwidth: 1000.0, fed: false }),
        );
        config.sensors = Sensors::Exact;
        if let ControlConfig::Pi(pi) = &mut config.control {
            pi.speed = SpeedSource::Exact;
        }
        let protection = Protection {
            continuous_current: 3.0,
            thermal_time,
            temperature: 85.0,
            command_timeout: 60.0,
            stop_time: 3.0,
            standstill: 2.0,
        };
        let mut supervisor = Supervisor::<S>::new(&config, &protection).expect("valid");
        let bases = *supervisor.drive().bases();
        let conditions = Conditions {
            temperature: 20.0,
            current_sensors: CurrentSensors::Good,
            tripped: false,
            overrun: false,
        };
        // A quarter more current than the motor carries: trips after thermal_time·1.02.
        for period in 0..(1.5 * thermal_time * rate) as u64 {
            let sample = Sample::Exact(Exact {
                speed: S::ZERO,
                advance: S::ZERO,
                current: S::from_f32(3.75, bases.current),
                bus_voltage: S::from_f32(24.0, bases.voltage),
            });
            supervisor.step(&sample, &conditions);
            if period % 1000 == 0 {
                supervisor.command(Command::KeepAlive).ok();
                supervisor.command(Command::Arm).ok();
            }
            let faults = supervisor.faults();
            if faults.iter().any(|fault| fault == quasidrive::fault::Fault::Overload) {
                return true;
            }
            // Anything else is of this test's making.
            if faults.iter().next().is_some() {
                supervisor.command(Command::Clear).ok();
            }
        }
        false
    }
    for (rate, time) in [(20_000.0, 20.0), (20_000.0, 100.0), (100_000.0, 60.0)] {
        assert!(trips::<f32>(rate, time));
        assert!(trips::<Q31>(rate, time), "{rate} Hz, {time} s");
    }
}

/// A flywheel on the paper's motor at 100 kHz: the bus is less than 2^-16 of its base.
#[test]
fn a_high_headroom_is_refused_or_driven() {
    let motor = MotorParameters {
        inertia: 100.0 * MotorParameters::PAPER.inertia,
        ..MotorParameters::PAPER
    };
    let mut config = paper(
        4096,
        Reads::All,
        100_000.0,
        400.0,
        ControlConfig::Drive(DriveFormConfig::new(3000.0, 1.0, 2.4)),
    );
    config.motor = motor;
    let Some(fixed) = play::<Q31>(&config, 5_000, &[(100.0, 0.0)]) else {
        println!("refused: {:?}", Drive::<Q31>::new(&config).err());
        return;
    };
    let float = play::<f32>(&config, 5_000, &[(100.0, 0.0)]).expect("accepted");
    assert_eq!((fixed.fault, fixed.speeds.len()), (float.fault, float.speeds.len()));
    let last = [&fixed, &float].map(|played| played.speeds[4_999]);
    assert!((last[0] / last[1] - 1.0).abs() < 0.02, "{last:?}");
}

/// The jerk of a steep S-curve saturates at full scale, and rounding it up (`over`) overflows.
#[test]
fn a_steep_s_curve_is_refused_or_played() {
    let mut config = paper(
        4096,
        Reads::All,
        20_000.0,
        400.0,
        ControlConfig::Drive(DriveFormConfig::new(1170.0, 0.3, 2.5)),
    );
    config.shape = Shape::SCurve { acceleration: 4e6, jerk: 8e10 };
    play::<Q31>(&config, 2_000, &[(100.0, 0.0), (-100.0, 0.0)]);
}

/// A slow loop lags by many turns' worth of counts: its lead leaves the range.
#[test]
fn a_slow_loop_does_not_overflow() {
    for control in [
        slow_pi(SpeedSource::Pll { bandwidth: 81.0, fed: false }),
        ControlConfig::Drive(DriveFormConfig::new(20.0, 0.3, 2.5)),
    ] {
        for sensors in [true, false] {
            let mut config = paper(65_536, Reads::All, 20_000.0, 400.0, control);
            config.shape = Shape::Step;
            if let ControlConfig::Pi(pi) = &mut config.control {
                pi.speed_bandwidth = 10.0;
            }
            if sensors {
                config.sensors = Sensors::Exact;
            }
            play::<Q31>(&config, 4_000, &[(390.0, 0.0), (-390.0, 0.0), (390.0, 0.0)]);
        }
    }
}
