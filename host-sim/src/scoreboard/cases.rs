//! The cases: what every controller has to play.

use super::drive_cycle::DriveCycle;
use super::motors::Machine;
use super::response::View;
use super::rig::{BUS, Errors, Rig};
use crate::profile::{Load, Sine, Step};
use crate::scenario::{Initial, Scenario, ShapeName};
use crate::sensors::ReadsName;
use rand::rngs::StdRng;
use rand::{Rng, SeedableRng};
use std::f64::consts::TAU;

/// A case: a rig and what is played on it.
#[derive(Clone, Debug)]
pub struct Case {
    /// Its name.
    pub name: String,
    /// Motor, encoder and parameter errors.
    pub rig: Rig,
    /// Time of a load step to be measured (s), with 0.1 s of steady running ahead of it.
    pub load_step: Option<f64>,
    /// What the report shows of it.
    pub views: &'static [View],
    play: fn(&Rig, u64) -> Scenario,
}

impl Case {
    /// The scenario, without controller, with the reads of the encoder that count, for a seed of everything random in it.
    pub fn scenario(&self, reads: ReadsName, seed: u64) -> Scenario {
        (self.play)(&Rig { reads, ..self.rig }, seed)
    }

    /// All cases, in the order they are shown.
    pub fn all() -> Vec<Self> {
        let case = |name: &str, play| Self {
            name: name.to_owned(),
            rig: Rig::REFERENCE,
            load_step: None,
            views: &[],
            play,
        };
        let shown = |name: &str, views, play| Self { views, ..case(name, play) };
        let mut cases = vec![
            case("paper's cycle", paper_cycle),
            case("paper's cycle, jumps", paper_cycle_with_jumps),
            shown("ECE-15", View::OF_DRIVE_CYCLE, ece_15),
            case("sinusoidal load", sinusoidal_load),
            case("random load", random_load),
            shown("reversal", View::OF_REVERSAL, reversal),
            case("low speed", low_speed),
            case("start while turning", start_while_turning),
            case("bus sag", bus_sag),
        ];
        let steps = |name: String, rig| Self {
            name,
            rig,
            load_step: Some(LOAD_STEP_AT),
            views: &[],
            play: load_steps,
        };
        cases.push(Self {
            views: View::OF_LOAD_STEP,
            ..steps("load steps".to_owned(), Rig::REFERENCE)
        });
        let wrong = |name: &str, errors| steps(name.to_owned(), Rig { errors, ..Rig::REFERENCE });
        let none = Errors::NONE;
        cases.extend([
            wrong("J ×0.5", Errors { inertia: 0.5, ..none }),
            wrong("J ×3", Errors { inertia: 3.0, ..none }),
            wrong("Ra ×0.7", Errors { resistance: 0.7, ..none }),
            wrong("Ra ×1.5", Errors { resistance: 1.5, ..none }),
            wrong("Kb ×0.85", Errors { back_emf_constant: 0.85, ..none }),
            wrong("Kb ×1.15", Errors { back_emf_constant: 1.15, ..none }),
        ]);
        cases.extend(
            [512, 1024, 16384]
                .map(|counts| steps(format!("{counts} counts"), Rig { counts, ..Rig::REFERENCE })),
        );
        cases.extend(
            Machine::ALL[1..]
                .iter()
                .map(|&machine| steps(machine.name.to_owned(), Rig { machine, ..Rig::REFERENCE })),
        );
        cases
    }
}

/// When the load of `load_steps` jumps (s).
const LOAD_STEP_AT: f64 = 0.6;

fn steps<const N: usize>(steps: [(f64, f64); N]) -> Vec<Step> {
    steps.map(|(time, value)| Step { time, value }).to_vec()
}

/// A quarter of the no-load speed (rad/s): 102 rad/s with the paper's motor.
fn quarter_speed(rig: &Rig) -> f64 {
    0.25 * rig.machine.no_load_speed(BUS)
}

/// The speeds and the load of the paper's experiment.
fn paper_cycle(rig: &Rig, seed: u64) -> Scenario {
    let paper = Scenario::paper();
    let mut scenario = rig.scenario(paper.duration, seed);
    scenario.reference.steps = paper.reference.steps;
    scenario.load = paper.load;
    scenario
}

/// The same without shaping, as the paper has it.
fn paper_cycle_with_jumps(rig: &Rig, seed: u64) -> Scenario {
    let mut scenario = paper_cycle(rig, seed);
    scenario.reference.shape = ShapeName::Step;
    scenario.reference.bandwidth = None;
    scenario
}

fn ece_15(rig: &Rig, seed: u64) -> Scenario {
    let cycle = DriveCycle::ece_15(&rig.machine);
    let mut scenario = rig.scenario(cycle.duration, seed);
    scenario.reference.steps = cycle.speeds;
    scenario.load.steps = cycle.loads;
    scenario
}

/// Constant speed, load on at 0.6 s and off at 0.75 s, then another speed.
fn load_steps(rig: &Rig, seed: u64) -> Scenario {
    let (speed, base) = (quarter_speed(rig), rig.base_load());
    let mut scenario = rig.scenario(1.2, seed);
    scenario.reference.steps = steps([(0.0, speed), (0.9, 0.5 * speed)]);
    scenario.load.constant = base;
    scenario.load.steps = steps([(LOAD_STEP_AT, base + rig.load_step()), (0.75, base)]);
    scenario
}

/// At constant speed a load of 25 Hz.
fn sinusoidal_load(rig: &Rig, seed: u64) -> Scenario {
    let step = rig.load_step();
    let mut scenario = rig.scenario(1.5, seed);
    scenario.reference.steps = steps([(0.0, quarter_speed(rig))]);
    scenario.load = Load {
        constant: step,
        steps: Vec::new(),
        sines: vec![Sine { amplitude: 0.6 * step, frequency: 25.0, phase: 0.0 }],
    };
    scenario
}

/// At constant speed sixteen sinusoids of random frequency, from 0.5 to 80 Hz, and phase.
fn random_load(rig: &Rig, seed: u64) -> Scenario {
    let mut random = StdRng::seed_from_u64(seed);
    let step = rig.load_step();
    let mut scenario = rig.scenario(3.0, seed);
    scenario.reference.steps = steps([(0.0, quarter_speed(rig))]);
    let mut sine = || Sine {
        amplitude: 0.15 * step,
        frequency: 0.5 * 160_f64.powf(random.random()),
        phase: TAU * random.random::<f64>(),
    };
    let sines = (0..16).map(|_| sine()).collect();
    scenario.load = Load { constant: step, steps: Vec::new(), sines };
    scenario
}

/// From a speed to its opposite and back, with Coulomb friction that the controllers know nothing of.
fn reversal(rig: &Rig, seed: u64) -> Scenario {
    let speed = quarter_speed(rig);
    let mut scenario = rig.scenario(2.0, seed);
    scenario.motor.coulomb_friction = 0.4 * rig.load_step();
    scenario.reference.steps = steps([(0.0, speed), (0.7, -speed), (1.4, speed)]);
    scenario
}

/// A fiftieth of the other cases' speed, with Coulomb friction and a load step.
fn low_speed(rig: &Rig, seed: u64) -> Scenario {
    let mut scenario = rig.scenario(2.0, seed);
    scenario.motor.coulomb_friction = 0.2 * rig.load_step();
    scenario.reference.steps = steps([(0.0, 0.02 * quarter_speed(rig))]);
    scenario.load.steps = steps([(1.0, 0.4 * rig.load_step())]);
    scenario
}

/// The motor turns at 0.8 of the commanded speed when the drive is armed.
fn start_while_turning(rig: &Rig, seed: u64) -> Scenario {
    let speed = quarter_speed(rig);
    let mut scenario = rig.scenario(0.6, seed);
    scenario.initial = Initial { speed: 0.8 * speed, current: 0.0, armed_after: 0.05 };
    scenario.reference.steps = steps([(0.0, speed)]);
    scenario.load.steps = steps([(0.05, rig.base_load())]);
    scenario
}

/// The bus, behind 0.1 Ω, sags to a half for 0.3 s while a load comes and goes.
fn bus_sag(rig: &Rig, seed: u64) -> Scenario {
    let mut scenario = rig.scenario(1.3, seed);
    scenario.bus.resistance = 0.1;
    scenario.bus.steps = steps([(0.6, 0.5 * BUS), (0.9, BUS)]);
    scenario.reference.steps = steps([(0.0, 1.2 * quarter_speed(rig))]);
    scenario.load.steps = steps([(0.7, rig.load_step()), (1.0, 0.0)]);
    scenario
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::scoreboard::contender::Rule;
    use std::path::Path;

    #[test]
    fn every_case_is_a_valid_scenario_for_every_rule() {
        let cases = Case::all();
        assert_eq!(cases.len(), 9 + 1 + 6 + 3 + 3);
        for case in &cases {
            for rule in Rule::ALL {
                let mut scenario = case.scenario(ReadsName::All, 1);
                rule.setup(1000.0, &case.rig.machine).put_into(&mut scenario);
                if let Err(error) = scenario.recheck(Path::new(&case.name)) {
                    unreachable!("{}: {error}", rule.name());
                }
            }
        }
    }

    #[test]
    fn the_believed_motor_is_the_right_one_whatever_the_true_one_is() {
        for case in Case::all() {
            let motor = case.rig.machine.motor;
            let believed = case.scenario(ReadsName::All, 1).drive_config().motor;
            assert!((f64::from(believed.inertia) / motor.inertia - 1.0).abs() < 1e-6);
            assert!((f64::from(believed.resistance) / motor.resistance - 1.0).abs() < 1e-6);
            let constant = f64::from(believed.back_emf_constant) / motor.back_emf_constant;
            assert!((constant - 1.0).abs() < 1e-6, "{}", case.name);
        }
    }

    #[test]
    fn seeds_change_the_random_load_and_nothing_else_of_the_load() {
        for case in Case::all() {
            let differs =
                case.scenario(ReadsName::All, 1).load != case.scenario(ReadsName::All, 2).load;
            assert_eq!(differs, case.name == "random load");
            assert_eq!(
                case.scenario(ReadsName::All, 3).load,
                case.scenario(ReadsName::All, 3).load
            );
        }
    }
}
