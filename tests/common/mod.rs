//! Variations of the paper's scenario that several test files play, and parameters that several test files set.

#![allow(dead_code, reason = "no test file that shares this module uses all of it")]

use host_sim::scenario::{Controller, FormName, Scenario};
use quasidrive::control::drive_form::DriveFormConfig;
use quasidrive::control::ladrc::LadrcConfig;
use quasidrive::control::paper::{Form, Gains, Law, PaperConfig, Start};
use quasidrive::control::pi::PiConfig;
use quasidrive::control::{ControlConfig, Timing};
use quasidrive::drive::{DriveConfig, Limits};
use quasidrive::estimate::SpeedSource;
use quasidrive::motor::MotorParameters;
use quasidrive::parameters::Parameters;
use quasidrive::schema::{self, Value};
use quasidrive::sense::{Calibration, Reads, Sensors};
use quasidrive::supervisor::Protection;
use quasidrive::trajectory::Shape;
use std::collections::BTreeSet;

/// The paper's cycle at 20 kHz with one period of delay.
pub fn at_20_khz(controller: Controller) -> Scenario {
    let mut scenario = Scenario::paper();
    scenario.control.controller = controller;
    scenario
}

/// The paper's cycle at 20 kHz in one form, with or without the delay.
pub fn in_form(form: FormName, delay: bool) -> Scenario {
    let mut scenario = at_20_khz(Controller::BsQsmdo);
    scenario.control.form = form;
    scenario.timing.delay = delay;
    scenario
}

const TIMING: Timing = Timing { rate: 20_000.0, delay: true };
const PLL: SpeedSource = SpeedSource::Pll { bandwidth: 4e3, fed: true };

/// A drive that can be built, with the sensors of a board.
pub fn parameters() -> Parameters {
    let calibration = Calibration {
        current_per_code: -0.029,
        current_zero: 2047.5,
        bus_voltage_per_code: 0.008,
        counts_per_turn: -4096,
        highest_code: 4095,
        reads: Reads::Shifted,
    };
    Parameters {
        drive: DriveConfig {
            motor: MotorParameters::PAPER,
            sensors: Sensors::Codes(calibration),
            control: ControlConfig::Drive(DriveFormConfig::new(1170.0, 0.3, 2.5)),
            timing: TIMING,
            limits: Limits {
                duty: 0.9,
                speed: 400.0,
                current: 30.0,
                current_command: 20.0,
                bus_min: 9.0,
                bus_max: 27.0,
            },
            shape: Shape::SecondOrder { bandwidth: 60.0 },
        },
        protection: Protection {
            continuous_current: 10.0,
            thermal_time: 20.0,
            temperature: 85.0,
            command_timeout: 1.0,
            stop_time: 3.0,
            standstill: 2.0,
        },
    }
}

/// One of each controller for it.
pub fn controls() -> [ControlConfig; 4] {
    let pi = PiConfig::magnitude_and_symmetrical_optimum(&TIMING, PLL);
    let paper = PaperConfig {
        law: Law::Qismc,
        gains: Gains { c: 400.0, k1: 1900.0, epsilon1: 3.8, k2: 1.4e7, epsilon2: 2e4 },
        form: Form::Implicit,
        start: Start::Zero,
        speed: PLL,
    };
    [
        parameters().drive.control,
        ControlConfig::Paper(paper),
        ControlConfig::Pi(PiConfig { disturbance: Some(300.0), ..pi }),
        ControlConfig::Ladrc(LadrcConfig::by_bandwidth(100.0, &TIMING, PLL)),
    ]
}

/// Sets in which each name that any parameter can have is one's value; the numbers beside it may not be set.
pub fn every_name() -> Vec<Parameters> {
    let mut seen = BTreeSet::new();
    let mut waiting: Vec<Parameters> =
        controls().map(|control| with_control(&parameters(), control)).to_vec();
    let mut sets = Vec::new();
    while let Some(mut set) = waiting.pop() {
        sets.push(set);
        let mut choices = Vec::new();
        schema::walk(&mut set, &mut |path, parameter| {
            choices.extend(parameter.names().iter().map(|name| (path.to_owned(), *name)));
            true
        });
        for (path, name) in choices {
            if seen.insert((path.clone(), name)) {
                let mut other = set;
                assert_eq!(schema::set(&mut other, &path, Value::Name(name)), Ok(()));
                waiting.push(other);
            }
        }
    }
    sets
}

pub fn with_control(set: &Parameters, control: ControlConfig) -> Parameters {
    Parameters { drive: DriveConfig { control, ..set.drive }, ..*set }
}

/// The names of a set's values, and of groups of them, in their order.
pub fn names(mut set: Parameters) -> Vec<(String, Option<Value<'static>>)> {
    let mut names = Vec::new();
    schema::walk(&mut set, &mut |path, parameter| {
        names.push((path.to_owned(), parameter.get()));
        true
    });
    names
}
