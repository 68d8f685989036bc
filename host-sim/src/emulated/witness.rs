//! The wired world, with the truth written down at each instant at which the firmware's currents are sampled.

use crate::scenario::Scenario;
use crate::wired::{Truth, WiredWorld};
use virtual_board::World;
use virtual_board::world::{AnaloguePin, Gates, InputPin};

/// A world and its witness.
pub struct Witness {
    /// The world.
    pub world: WiredWorld,
    /// What was true at the sampling instants while it was watched.
    pub samples: Vec<Truth>,
    /// Whether it is watched.
    pub is_watching: bool,
    /// The last sampling instant (s).
    pub sampled: f64,
}

impl Witness {
    /// Of a scenario's world; it does not watch yet.
    pub fn new(scenario: &Scenario) -> Self {
        let world = WiredWorld::new(scenario);
        Self { world, samples: Vec::new(), is_watching: false, sampled: 0.0 }
    }
}

impl World for Witness {
    fn switch(&mut self, time: f64, gates: Gates) {
        self.world.switch(time, gates);
    }

    fn voltage(&mut self, time: f64, pin: AnaloguePin) -> f64 {
        // V's shunt is at one converter only, and at no comparator: it is looked at once a period, when both converters hold.
        if pin == AnaloguePin::ShuntV {
            self.sampled = time;
            if self.is_watching {
                let truth = self.world.truth(time);
                self.samples.push(truth);
            }
        }
        self.world.voltage(time, pin)
    }

    fn encoder_edges(&mut self, time: f64) -> i64 {
        self.world.encoder_edges(time)
    }

    fn level(&mut self, time: f64, pin: InputPin) -> bool {
        self.world.level(time, pin)
    }
}
