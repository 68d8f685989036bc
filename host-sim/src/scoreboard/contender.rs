//! Who plays: each controller with one knob, so that all can be set to the same voltage ripple.

use super::motors::Machine;
use super::rig::{BUS, Rig};
use crate::scenario::{
    Control, Controller, GainsTable, LadrcTable, PiTable, Scenario, SpeedName, StartName, Tuning,
};
use crate::sensors::ReadsName;
use crate::simulation::ScalarName;

/// A controller with all its numbers: what it writes into a scenario.
#[derive(Clone, Copy, Debug, Default)]
pub struct Setup {
    /// Law and speed estimate.
    pub control: Control,
    /// Of the paper's form.
    pub gains: GainsTable,
    /// Of the drive form.
    pub tuning: Tuning,
    /// Of PI.
    pub pi: PiTable,
    /// Of LADRC.
    pub ladrc: LadrcTable,
}

impl Setup {
    /// Makes a scenario this controller's.
    pub fn put_into(&self, scenario: &mut Scenario) {
        let Self { control, gains, tuning, pi, ladrc } = *self;
        scenario.control = control;
        scenario.gains = gains;
        scenario.tuning = tuning;
        scenario.pi = pi;
        scenario.ladrc = ladrc;
    }
}

/// A rule that sets a controller by one knob, a bandwidth (rad/s).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rule {
    /// The drive form of BS-QSMDO, by its observer's bandwidth.
    DriveQsmdo,
    /// The drive form of BS-QISMC, by the same.
    DriveQismc,
    /// The paper's BS-QSMDO behind a fed angle observer, by that observer's bandwidth.
    PaperQsmdo,
    /// Plain backstepping behind the same.
    Backstepping,
    /// PI, tuned by the book for a speed estimate of this bandwidth.
    PiByTheBook,
    /// The same with a disturbance observer.
    PiWithObserver,
    /// LADRC, tuned by the book for a speed estimate of this bandwidth.
    Ladrc,
}

/// A controller by its rule on an encoder that is read in one of the ways.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Contender {
    /// Its rule.
    pub rule: Rule,
    /// Reads of the encoder that count.
    pub reads: ReadsName,
    /// What it computes in.
    pub scalar: ScalarName,
}

impl Contender {
    /// All, in the order they are shown: every rule with 16 reads; the drive form, PI and LADRC with shifted ones too; and the
    /// drive form, the paper's form and PI in fixed point.
    pub fn all() -> impl Iterator<Item = Self> {
        let plain = |rule| Self { rule, reads: ReadsName::All, scalar: ScalarName::F32 };
        let shifted = [Rule::DriveQsmdo, Rule::PiByTheBook, Rule::Ladrc]
            .map(|rule| Self { reads: ReadsName::Shifted, ..plain(rule) });
        let fixed = [Rule::DriveQsmdo, Rule::PaperQsmdo, Rule::PiByTheBook]
            .map(|rule| Self { scalar: ScalarName::Q31, ..plain(rule) });
        Rule::ALL.map(plain).into_iter().chain(shifted).chain(fixed)
    }

    /// The rig with its reads and its scalar.
    pub fn on(self, rig: &Rig) -> Rig {
        Rig { reads: self.reads, scalar: self.scalar, ..*rig }
    }

    /// Its name.
    pub fn name(self) -> String {
        let shifted = if self.reads == ReadsName::Shifted { ", shifted reads" } else { "" };
        let fixed = if self.scalar == ScalarName::Q31 { ", fixed point" } else { "" };
        format!("{}{shifted}{fixed}", self.rule.name())
    }

    /// The knob's position (rad/s) at which the ripple of the load-step trial is `ripple` (V rms about the mean): the
    /// highest of twelve that stays below, brought closer by bisection. Nothing where none stays below. In fixed point it is set as in
    /// floating point.
    pub fn match_ripple(self, rig: &Rig, ripple: f64) -> Option<f64> {
        let rig = Rig { reads: self.reads, ..*rig };
        let holds = |knob: f64| {
            let figures = rig.trial(&self.rule.setup(knob, &rig.machine), 1);
            figures.is_some_and(|figures| figures.ripple <= ripple)
        };
        let positions: Vec<f64> = (0..12).map(|k| 100.0 * 1.6_f64.powi(k)).collect();
        let mut low = positions.into_iter().rev().find(|&knob| holds(knob))?;
        let mut high = 1.6 * low;
        for _ in 0..7 {
            let middle = (low * high).sqrt();
            if holds(middle) { low = middle } else { high = middle }
        }
        Some(low)
    }
}

impl Rule {
    /// All, in the order they are shown.
    pub const ALL: [Self; 7] = [
        Self::DriveQsmdo,
        Self::DriveQismc,
        Self::PaperQsmdo,
        Self::Backstepping,
        Self::PiByTheBook,
        Self::PiWithObserver,
        Self::Ladrc,
    ];

    /// Its name.
    pub fn name(self) -> &'static str {
        match self {
            Self::DriveQsmdo => "drive BS-QSMDO",
            Self::DriveQismc => "drive BS-QISMC",
            Self::PaperQsmdo => "paper BS-QSMDO",
            Self::Backstepping => "plain BS",
            Self::PiByTheBook => "PI by the book",
            Self::PiWithObserver => "PI with observer",
            Self::Ladrc => "LADRC",
        }
    }

    /// What it sets.
    pub fn in_words(self) -> &'static str {
        match self {
            Self::DriveQsmdo | Self::DriveQismc => {
                "knob wo; the rest by the drive form's rule; torque and voltage reserves as by default"
            }
            Self::PaperQsmdo => {
                "knob p, the fed angle observer's; c = 0.29·p, k1/ε1 = 0.36·p, k2/ε2 = 0.5·p; the drive form's reserves"
            }
            Self::Backstepping => "knob p, the fed angle observer's; c = 0.29·p",
            Self::PiByTheBook => {
                "knob p, the fed angle observer's; magnitude and symmetrical optimum"
            }
            Self::PiWithObserver => "as PI by the book, with a disturbance observer of p/4",
            Self::Ladrc => {
                "knob p, the fed angle observer's; control p/13.5, observer four times that"
            }
        }
    }

    /// Whether it estimates the load torque.
    pub fn estimates_load(self) -> bool {
        !matches!(self, Self::Backstepping | Self::PiByTheBook)
    }

    /// The tuning of a knob's position (rad/s).
    pub fn setup(self, knob: f64, machine: &Machine) -> Setup {
        let controller = match self {
            Self::DriveQsmdo => Controller::DriveQsmdo,
            Self::DriveQismc => Controller::DriveQismc,
            Self::PaperQsmdo => Controller::BsQsmdo,
            Self::Backstepping => Controller::Bs,
            Self::PiByTheBook | Self::PiWithObserver => Controller::Pi,
            Self::Ladrc => Controller::Ladrc,
        };
        let control = Control {
            controller,
            start: StartName::Matched,
            speed: Some(SpeedName::FedPll),
            speed_bandwidth: Some(knob),
            ..Control::default()
        };
        let motor = machine.motor;
        let torque = motor.back_emf_constant * machine.current_command();
        let reserve = 0.1 * BUS;
        match self {
            Self::DriveQsmdo | Self::DriveQismc => Setup {
                control,
                tuning: Tuning {
                    bandwidth: Some(knob),
                    load_torque: Some(torque),
                    voltage_reserve: Some(reserve),
                    ..Tuning::default()
                },
                ..Setup::default()
            },
            Self::PaperQsmdo | Self::Backstepping => {
                let k1 = torque / motor.inertia;
                let a2 = motor.back_emf_constant / motor.inertia;
                let k2 = reserve * a2 / motor.inductance;
                let gains = GainsTable {
                    c: 0.29 * knob,
                    k1,
                    epsilon1: k1 / (0.36 * knob),
                    k2,
                    epsilon2: k2 / (0.5 * knob),
                };
                Setup { control, gains, ..Setup::default() }
            }
            Self::PiByTheBook => Setup { control, ..Setup::default() },
            Self::PiWithObserver => {
                let pi = PiTable { disturbance: Some(0.25 * knob), ..PiTable::default() };
                Setup { control, pi, ..Setup::default() }
            }
            Self::Ladrc => {
                let ladrc =
                    LadrcTable { control_bandwidth: Some(knob / 13.5), ..LadrcTable::default() };
                Setup { control, ladrc, ..Setup::default() }
            }
        }
    }
}
