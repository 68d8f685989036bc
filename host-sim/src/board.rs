//! The simulated board: motor, bridge, bus and sensors behind the HAL trait.
//!
//! One [`Board::apply`] moves the motor on by one PWM period, with the mean voltage of the bridge. Sensors are ideal:
//! what they add to the truth enters in [`SimulatedBoard::sample`] and nowhere else.

use crate::double::SimulatedScalar;
use crate::plant::{Armature, Plant, State};
use crate::profile::{Load, Step, Waves, value_at};
use crate::scenario::Scenario;
use quasidrive::hal::{Board, BridgeCommand, Sample};
use std::marker::PhantomData;

/// A simulated motor board that speaks to a drive in the scalar `S`.
#[derive(Clone, Debug)]
pub struct SimulatedBoard<S> {
    plant: Plant,
    load: Load,
    bus_voltage: f64,
    bus_steps: Vec<Step>,
    rate: f64,
    substeps: usize,
    delay: bool,
    state: State,
    /// The smooth part of the load, at half integration steps.
    waves: Waves,
    period: u64,
    /// Time of the next sample (s).
    time: f64,
    /// Bus voltage at that time (V).
    bus_now: f64,
    acting: Armature,
    scalar: PhantomData<S>,
}

impl<S: SimulatedScalar> SimulatedBoard<S> {
    /// The board of a scenario, at its start, with open switches.
    pub fn new(scenario: &Scenario) -> Self {
        let rate = scenario.timing.rate;
        let plant = Plant::new(scenario.motor);
        let substeps = plant.steps_for(1.0 / rate);
        let bus_now = value_at(&scenario.bus.steps, scenario.bus.voltage, 0.0);
        Self {
            plant,
            load: scenario.load.clone(),
            bus_voltage: scenario.bus.voltage,
            bus_steps: scenario.bus.steps.clone(),
            rate,
            substeps,
            delay: scenario.timing.delay,
            state: scenario.initial.state(),
            waves: scenario.load.waves(0.5 / (rate * substeps as f64)),
            period: 0,
            time: 0.0,
            bus_now,
            acting: Armature::Open(bus_now),
            scalar: PhantomData,
        }
    }

    /// Time of the next sample (s).
    pub fn time(&self) -> f64 {
        self.time
    }

    /// The motor's state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Torque that opposes the motor beyond viscous friction [N·m]: what a disturbance observer is to find.
    pub fn load_torque(&self) -> f64 {
        let friction = self.plant.coulomb_torque(self.state.speed);
        self.load.steps_at(self.time) + self.waves.sum() + friction
    }

    fn advance(&mut self, armature: Armature) {
        let h = 1.0 / (self.rate * self.substeps as f64);
        for substep in 0..self.substeps {
            // A jump belongs between integration steps: what holds in the middle holds throughout.
            let constant = self.load.steps_at(self.time + (substep as f64 + 0.5) * h);
            let load = [self.waves.sum(), self.waves.advance(), self.waves.advance()];
            self.state = self.plant.step(self.state, armature, load.map(|wave| constant + wave), h);
        }
        self.period += 1;
        self.time = self.period as f64 / self.rate;
        self.bus_now = value_at(&self.bus_steps, self.bus_voltage, self.time);
    }
}

impl<S: SimulatedScalar> Board<S> for SimulatedBoard<S> {
    fn sample(&mut self) -> Sample<S> {
        Sample {
            speed: S::from_f64(self.state.speed),
            current: S::from_f64(self.state.current),
            bus_voltage: S::from_f64(self.bus_now),
        }
    }

    fn apply(&mut self, command: BridgeCommand<S>) {
        let commanded = match command {
            BridgeCommand::Off => Armature::Open(self.bus_now),
            BridgeCommand::Duty(duty) => Armature::Driven(duty.to_f64() * self.bus_now),
        };
        let before = std::mem::replace(&mut self.acting, commanded);
        // A duty waits for the timer's next update where there is a delay; switching off never waits.
        let waits = self.delay && matches!(commanded, Armature::Driven(_));
        self.advance(if waits { before } else { commanded });
    }
}
