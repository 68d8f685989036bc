//! The test bench of commissioning: motors that the drive knows nothing of, data sheets' and random ones, with the bridge and the
//! sensors of a board that fits them.

use crate::board::SimulatedBoard;
use crate::plant::Motor;
use crate::profile::{Load, Step};
use crate::scenario::{Bridge, LimitsTable, Scenario};
use crate::scoreboard::motors::Machine;
use crate::sensors::SensorsTable;
use quasidrive::commission::tuning::Known;
use quasidrive::commission::{Commission, CommissionConfig, Findings, Phase};
use quasidrive::drive::{Drive, DriveConfig, Mode};
use quasidrive::hal::{Board, BridgeCommand, Sample};
use quasidrive::per_unit::Bases;
use rand::rngs::StdRng;
use rand::seq::IndexedRandom;
use rand::{Rng, SeedableRng};

/// A motor on a board that fits it.
#[derive(Clone, Debug)]
pub struct Bench {
    /// What a reader calls it.
    pub name: String,
    /// The truth: motor, bridge, bus, sensors and limits. Its command and load are of no use here.
    pub scenario: Scenario,
    /// How far the shaft may turn to either side (rad).
    pub travel: f64,
}

/// What a run showed from outside.
#[derive(Clone, Copy, Debug)]
pub struct Run {
    /// What the drive found.
    pub findings: Findings,
    /// Time that it took (s).
    pub time: f64,
    /// Largest true current (A), speed (rad/s) and angle from the start (rad).
    pub current: f64,
    /// Largest true speed (rad/s).
    pub speed: f64,
    /// Largest true angle from the start (rad).
    pub angle: f64,
    /// Largest duty that was commanded.
    pub duty: f64,
    /// Periods in which the true current was beyond its limit.
    pub beyond: u32,
}

/// Speeds of the load steps over the speed without load, and when (s) the drive is armed, is steady, gets the load, and is done.
const DIP_SPEEDS: [f64; 4] = [0.11, 0.19, 0.27, 0.37];
const DIP_ARMED: f64 = 0.02;
const DIP_STEADY: f64 = 0.1;
const DIP_STEP: f64 = 0.18;
const DIP_END: f64 = 0.23;

/// Time that a shaft is watched after outputs went off (s).
const COASTING: f64 = 0.2;

/// Current limit over the one that a bridge trips at.
const BELOW_TRIP: f64 = 0.8;

impl Bench {
    /// A motor with a bus (V), a current that it may have (A) and the speed without load (rad/s).
    fn new(name: String, motor: Motor, bus: f64, current: f64, no_load: f64, seed: u64) -> Self {
        let mut scenario = Scenario::paper();
        scenario.motor = motor;
        scenario.load = Load::default();
        scenario.bus.voltage = bus;
        let trip = current / BELOW_TRIP;
        scenario.limits = LimitsTable {
            speed: 1.2 * no_load,
            current: trip,
            current_command: Some(current),
            bus_min: 0.6 * bus,
            bus_max: 30.0,
            ..LimitsTable::default()
        };
        // 2048 codes are a fortieth beyond the trip.
        let resolution = 5e-4 * 1.001 * trip;
        scenario.sensors = Some(SensorsTable {
            current_resolution: resolution,
            current_noise: 0.5 * resolution,
            seed,
            ..SensorsTable::default()
        });
        scenario.bridge = Bridge {
            // 170 MHz, up and down.
            duty_steps: 4250,
            dead_time: 0.8e-6,
            // That of a duty of a quarter, half of it to either side.
            ripple: bus / 16.0 / motor.inductance / scenario.timing.rate,
            ..Bridge::default()
        };
        Self { name, scenario, travel: f64::INFINITY }
    }

    /// A motor of a data sheet with 3 % of friction, 0.3 V in its brushes and an encoder of so many counts.
    pub fn machine(machine: &Machine, counts: u32) -> Self {
        let bus = 24.0;
        let friction = 0.03 * machine.continuous_torque;
        let motor = Motor { coulomb_friction: friction, ..machine.motor };
        let name = format!("{}, {counts} counts", machine.name);
        let current = machine.current_command();
        let mut bench = Self::new(name, motor, bus, current, machine.no_load_speed(bus), 1);
        bench.scenario.bridge.brush_drop = 0.3;
        if let Some(sensors) = &mut bench.scenario.sensors {
            sensors.counts_per_turn = counts;
        }
        bench
    }

    /// A random motor of 1 W to 1 kW: evenly in the logarithm of power, time constants and speeds.
    pub fn random(seed: u64) -> Self {
        let mut random = StdRng::seed_from_u64(seed);
        let mut between = |low: f64, high: f64| (random.random_range(low.ln()..high.ln())).exp();
        let power = between(1.0, 1000.0);
        // Small motors are fast, and larger ones have less resistance for their torque.
        let no_load = between(300.0, 900.0) * f64::powf(power, -0.05);
        let stall = between(4.0, 12.0) * f64::powf(power / 30.0, 0.1).max(0.8);
        let mechanical = between(3e-3, 0.1);
        let electrical = between(5e-5, 5e-3_f64.min(0.3 * mechanical).max(6e-5));
        let overload = between(1.0, 3.0);
        let friction = between(0.01, 0.1);
        let viscous = between(0.03, 0.5);
        let brushes = between(0.005, 0.04);
        let dead_time = between(0.2e-6, 1.2e-6);
        let noise = between(0.3, 1.5);
        let voltage = *[12.0, 24.0, 36.0, 48.0].choose(&mut random).unwrap_or(&24.0);
        let counts = *[512, 1024, 2048, 4096, 8192, 16384].choose(&mut random).unwrap_or(&4096);
        let edge_error = random.random_range(0.0..0.08);
        let [offset, load, sag] =
            [-5.0..5.0, -0.2..0.2, 0.0..0.02].map(|range| random.random_range(range));
        let rated = power / (0.8 * voltage);
        let back_emf = 0.95 * voltage / no_load;
        let resistance = voltage / (stall * rated);
        let torque = friction * back_emf * rated;
        let motor = Motor {
            inertia: mechanical * back_emf * back_emf / resistance,
            inductance: electrical * resistance,
            resistance,
            back_emf_constant: back_emf,
            viscous_friction: viscous * torque / no_load,
            coulomb_friction: (1.0 - viscous) * torque,
        };
        let name = format!(
            "{seed}: {power:.1} W, {voltage} V, {:.1} A of {:.1} A, L/R {:.2} ms, τm {:.1} ms, {counts} counts",
            overload * rated,
            stall * rated,
            1e3 * electrical,
            1e3 * mechanical
        );
        let bus = voltage.min(28.0);
        let current = overload * rated;
        let mut bench =
            Self::new(name, motor, bus, current, no_load * bus / voltage, random.random());
        bench.scenario.bridge.dead_time = dead_time;
        bench.scenario.bridge.brush_drop = brushes * voltage;
        bench.scenario.bus.resistance = sag * bus / current;
        // More than friction holds would turn the shaft.
        bench.scenario.load.constant = load * motor.coulomb_friction;
        if let Some(sensors) = &mut bench.scenario.sensors {
            sensors.counts_per_turn = counts;
            sensors.edge_error = edge_error;
            sensors.current_offset = offset * sensors.current_resolution;
            sensors.current_noise = noise * sensors.current_resolution;
        }
        bench
    }

    /// What commissioning is told.
    pub fn config(&self) -> CommissionConfig {
        let drive = self.scenario.drive_config();
        CommissionConfig {
            sensors: drive.sensors,
            timing: drive.timing,
            limits: drive.limits,
            voltage: f32::INFINITY,
            travel: self.travel as f32,
            no_load: None,
        }
    }

    fn board(&self) -> SimulatedBoard<f32> {
        #[expect(clippy::expect_used, reason = "a bench's own scenario")]
        let bases = Bases::new(&self.scenario.drive_config()).expect("valid");
        SimulatedBoard::new(&self.scenario, bases)
    }

    /// Commissions the motor.
    pub fn run(&self) -> Run {
        self.run_with(&self.config(), |_, _| {})
    }

    /// The same with another configuration; `meddle` may change each period's sample, and abort.
    pub fn run_with(
        &self,
        config: &CommissionConfig,
        mut meddle: impl FnMut(&mut Commission, &mut Sample<f32>),
    ) -> Run {
        self.run_on(config, |commission, _, sample| meddle(commission, sample))
    }

    /// The same; `meddle` may do something to the board too.
    pub fn run_on(
        &self,
        config: &CommissionConfig,
        mut meddle: impl FnMut(&mut Commission, &mut SimulatedBoard<f32>, &mut Sample<f32>),
    ) -> Run {
        #[expect(clippy::expect_used, reason = "a bench's own limits")]
        let mut commission = Commission::new(config).expect("valid");
        let mut board = self.board();
        let [mut current, mut speed, mut farthest, mut duty, mut angle] = [0.0_f64; 5];
        let limit = f64::from(config.limits.current_command);
        let mut beyond = 0;
        let mut over = None;
        // What coasts on has to stay within limits too.
        while over.is_none_or(|over| board.time() < over + COASTING) {
            if over.is_none() && commission.phase() == Phase::Over {
                over = Some(board.time());
            }
            let mut sample = board.sample();
            meddle(&mut commission, &mut board, &mut sample);
            let command = commission.step(&sample);
            if let BridgeCommand::Duty(commanded) = command {
                duty = duty.max(f64::from(commanded).abs());
            }
            let before = board.state();
            board.apply(command);
            let state = board.state();
            angle += 0.5 * (before.speed + state.speed) / self.scenario.timing.rate;
            current = current.max(state.current.abs());
            beyond += u32::from(state.current.abs() > limit);
            speed = speed.max(state.speed.abs());
            farthest = farthest.max(angle.abs());
        }
        let findings = commission.findings();
        let time = over.unwrap_or(board.time());
        Run { findings, time, current, speed, angle: farthest, duty, beyond }
    }

    /// What a drive would be tuned from that knew the truth.
    pub fn truth(&self, findings: &Findings) -> Known {
        let drive = self.scenario.drive_config();
        Known {
            motor: drive.motor,
            voltage_drop: self.voltage_drop() as f32,
            current_noise: findings.current_noise,
            bus_voltage: self.scenario.bus.voltage as f32,
            sensors: drive.sensors,
        }
    }

    /// Voltage that brushes and dead time take (V).
    pub fn voltage_drop(&self) -> f64 {
        let Scenario { bridge, bus, timing, .. } = &self.scenario;
        bridge.brush_drop + 2.0 * bridge.dead_time * timing.rate * bus.voltage
    }

    /// How far (rad/s) a drive lets the speed dip after a step of the load by a quarter of its largest torque, over several speeds.
    /// Nothing if the drive is refused or stops.
    pub fn dip(&self, config: &DriveConfig) -> Option<f64> {
        let dips = DIP_SPEEDS.map(|share| self.dip_at(config, share));
        dips.into_iter().try_fold(0.0, |sum, dip| Some(sum + dip? / dips.len() as f64))
    }

    fn dip_at(&self, config: &DriveConfig, share: f64) -> Option<f64> {
        let mut bench = self.clone();
        let motor = bench.scenario.motor;
        let speed = share * bench.scenario.bus.voltage / motor.back_emf_constant;
        let torque = motor.back_emf_constant * f64::from(config.limits.current_command);
        bench.scenario.initial.speed = speed;
        bench.scenario.load.steps = vec![Step { time: DIP_STEP, value: 0.25 * torque }];
        let mut drive = Drive::<f32>::new(config).ok()?;
        let mut board = bench.board();
        drive.set_speed(speed as f32).ok()?;
        let (mut before, mut samples, mut lowest) = (0.0, 0.0, f64::INFINITY);
        while board.time() < DIP_END {
            if board.time() >= DIP_ARMED {
                drive.arm().ok()?;
            }
            drive.run_period(&mut board);
            let speed = board.state().speed;
            match board.time() {
                DIP_STEADY..DIP_STEP => {
                    before += speed;
                    samples += 1.0;
                }
                DIP_STEP.. => lowest = lowest.min(speed),
                _ => {}
            }
        }
        (drive.mode() == Mode::Running).then_some(before / samples - lowest)
    }
}
