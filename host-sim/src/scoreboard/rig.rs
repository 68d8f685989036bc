//! The test bench: a motor with an encoder, limits and parameter errors, and the standard load-step trial on it.

use super::contender::Setup;
use super::measure::{LoadStepFigures, LoadStepMeter, over_speeds};
use super::motors::Machine;
use crate::profile::{Load, Step};
use crate::scenario::{
    Bridge, Bus, Initial, LimitsTable, Model, ReferenceTable, Scenario, ShapeName, TimingTable,
};
use crate::sensors::{ReadsName, SensorsTable};
use crate::simulation::{ScalarName, simulate_in};
use std::fmt::{self, Display, Formatter};

/// Bus voltage (V).
pub const BUS: f64 = 24.0;

/// Sampling rate (Hz).
pub const RATE: f64 = 20_000.0;

/// How wrong the controllers' model is: the true parameter over the believed one.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Errors {
    /// Of J.
    pub inertia: f64,
    /// Of Ra.
    pub resistance: f64,
    /// Of Kb.
    pub back_emf_constant: f64,
}

impl Display for Errors {
    fn fmt(&self, f: &mut Formatter<'_>) -> fmt::Result {
        let Self { inertia, resistance, back_emf_constant } = self;
        write!(f, "J ×{inertia}, Ra ×{resistance}, Kb ×{back_emf_constant}")
    }
}

impl Errors {
    /// A model that is right.
    pub const NONE: Self = Self { inertia: 1.0, resistance: 1.0, back_emf_constant: 1.0 };

    /// All combinations: J ×0.5, 1, 2, 3 with Ra ×0.7, 1, 1.5 and Kb ×0.85, 1, 1.15.
    pub fn all() -> impl Iterator<Item = Self> {
        [0.5, 1.0, 2.0, 3.0].into_iter().flat_map(|inertia| {
            [0.7, 1.0, 1.5].into_iter().flat_map(move |resistance| {
                [0.85, 1.0, 1.15].into_iter().map(move |back_emf_constant| Self {
                    inertia,
                    resistance,
                    back_emf_constant,
                })
            })
        })
    }
}

/// What stands between motor and controllers.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Sensing {
    /// A board's converters, and an encoder whose edges are where they should be.
    Board,
    /// The same with edges misplaced by a twentieth of a count (rms).
    MisplacedEdges,
    /// Nothing: sensors are exact.
    Exact,
}

/// A motor on the bench.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Rig {
    /// The motor as the controllers know it.
    pub machine: Machine,
    /// How the true one differs.
    pub errors: Errors,
    /// Counts of its encoder.
    pub counts: u32,
    /// Which reads of a period count.
    pub reads: ReadsName,
    /// How good the sensors are.
    pub sensing: Sensing,
    /// What drives compute in.
    pub scalar: ScalarName,
}

/// Accelerations that the trial's loads mean to the motor (rad/s²): 0.02 N·m and a step of 0.05 N·m on the paper's motor.
/// Other motors get loads that accelerate them as much.
const BASE_LOAD: f64 = 0.02 / 7.95e-5;
const LOAD_STEP: f64 = 0.05 / 7.95e-5;

/// The trial's speeds over the no-load speed: 11 to 136 rad/s with the paper's motor, evenly but for a little that keeps
/// them off whole fractions of one another.
const TRIAL_SPEEDS: [f64; 8] = [0.0277, 0.0713, 0.1149, 0.1601, 0.2033, 0.2471, 0.2929, 0.3346];

/// Times of the trial (s): armed, steady, load step, end.
const ARMED: f64 = 0.02;
const STEADY: f64 = 0.10;
const STEP: f64 = 0.18;
const END: f64 = 0.23;

impl Rig {
    /// The paper's motor with the encoder of the targets.
    pub const REFERENCE: Self = Self {
        machine: Machine::PAPER,
        errors: Errors::NONE,
        counts: 4096,
        reads: ReadsName::All,
        sensing: Sensing::Board,
        scalar: ScalarName::F32,
    };

    /// The load torque (N·m) of an acceleration that it means to the believed motor (rad/s²).
    fn torque(&self, acceleration: f64) -> f64 {
        self.machine.motor.inertia * acceleration
    }

    /// Load ahead of steps (N·m).
    pub fn base_load(&self) -> f64 {
        self.torque(BASE_LOAD)
    }

    /// The step of the load (N·m).
    pub fn load_step(&self) -> f64 {
        self.torque(LOAD_STEP)
    }

    /// A scenario without command and load.
    pub fn scenario(&self, duration: f64, seed: u64) -> Scenario {
        let Self { machine, errors, counts, reads, sensing, scalar: _ } = *self;
        let mut motor = machine.motor;
        motor.inertia *= errors.inertia;
        motor.resistance *= errors.resistance;
        motor.back_emf_constant *= errors.back_emf_constant;
        Scenario {
            title: String::new(),
            duration,
            motor,
            model: Model {
                inertia: 1.0 / errors.inertia,
                inductance: 1.0,
                resistance: 1.0 / errors.resistance,
                back_emf_constant: 1.0 / errors.back_emf_constant,
            },
            timing: TimingTable { rate: RATE, delay: true },
            bus: Bus { voltage: BUS, ..Bus::default() },
            bridge: Bridge::default(),
            sensors: (sensing != Sensing::Exact).then(|| SensorsTable {
                counts_per_turn: counts,
                reads,
                edge_error: if sensing == Sensing::MisplacedEdges { 0.05 } else { 0.0 },
                // 2048 codes are a fortieth beyond the trip: 12.5 mA, and noise of 5 mA, with the paper's motor.
                current_resolution: 5e-4 * machine.trip,
                current_noise: 2e-4 * machine.trip,
                seed,
                ..SensorsTable::default()
            }),
            control: Default::default(),
            gains: Default::default(),
            tuning: Default::default(),
            pi: Default::default(),
            ladrc: Default::default(),
            limits: LimitsTable {
                speed: 1.5 * machine.no_load_speed(BUS),
                current: machine.trip,
                current_command: Some(machine.current_command()),
                ..LimitsTable::default()
            },
            protection: Default::default(),
            initial: Initial::default(),
            reference: ReferenceTable {
                steps: Vec::new(),
                shape: ShapeName::SecondOrder,
                bandwidth: Some(60.0),
                acceleration: None,
                jerk: None,
            },
            load: Load::default(),
        }
    }

    /// Load steps at one constant speed, given over the no-load speed, where the motor turns already when the drive is armed.
    fn trial_scenario(&self, share: f64, seed: u64) -> Scenario {
        let speed = share * self.machine.no_load_speed(BUS);
        let (base, step) = (self.base_load(), self.load_step());
        let mut scenario = self.scenario(END, seed);
        scenario.initial = Initial { speed, current: 0.0, armed_after: ARMED };
        scenario.reference.steps = vec![Step { time: 0.0, value: speed }];
        scenario.load.steps =
            vec![Step { time: ARMED, value: base }, Step { time: STEP, value: base + step }];
        scenario
    }

    fn load_step_at(&self, setup: &Setup, share: f64, seed: u64) -> Option<LoadStepFigures> {
        let mut scenario = self.trial_scenario(share, seed);
        setup.put_into(&mut scenario);
        let mut meter = LoadStepMeter::new(STEADY, STEP);
        let outcome = simulate_in(self.scalar, &scenario, |frame| meter.add(frame)).ok()?;
        outcome.fault.is_none().then(|| meter.figures())?
    }

    /// The load-step trial at each of eight speeds (rad/s), for a seed of the sensors' noise. Nothing where the configuration
    /// is refused or the drive stops with a fault.
    pub fn trial_by_speed(&self, setup: &Setup, seed: u64) -> Option<Vec<(f64, LoadStepFigures)>> {
        let no_load = self.machine.no_load_speed(BUS);
        let at = |share| Some((share * no_load, self.load_step_at(setup, share, seed)?));
        TRIAL_SPEEDS.into_iter().map(at).collect()
    }

    /// The mean over these speeds.
    pub fn trial(&self, setup: &Setup, seed: u64) -> Option<LoadStepFigures> {
        let trials = self.trial_by_speed(setup, seed)?;
        let figures: Vec<_> = trials.into_iter().map(|(_, figures)| figures).collect();
        Some(over_speeds(&figures))
    }

    /// A combination of parameter errors with which a tuning, whose trial on the right motor gave `nominal`, is not stable. It is
    /// stable if 50 ms after the load step the speed is back, and until then neither it nor the voltage shook by more
    /// than four times what they did on the right motor.
    pub fn upsetting_errors(&self, setup: &Setup, nominal: &LoadStepFigures) -> Option<Errors> {
        let steady_error = (4.0 * nominal.steady_error).max(0.3);
        let ripple = (4.0 * nominal.ripple).max(0.4);
        Errors::all().find(|&errors| {
            let rig = Self { errors, ..*self };
            let mut scenario = rig.trial_scenario(TRIAL_SPEEDS[4], 1);
            setup.put_into(&mut scenario);
            // Seen from after the load step on: what it excites must have died down.
            scenario.load.steps[1].time = STEADY;
            let mut meter = LoadStepMeter::new(END - 0.05, END - 0.01);
            let outcome = simulate_in(self.scalar, &scenario, |frame| meter.add(frame));
            let settled = outcome.is_ok_and(|outcome| outcome.fault.is_none());
            let calm = meter.figures().is_some_and(|figures| {
                figures.steady_error <= steady_error && figures.ripple <= ripple
            });
            !(settled && calm)
        })
    }
}
