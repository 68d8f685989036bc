//! The simulated board: motor, bridge, bus and sensors behind the HAL trait.
//!
//! One [`Board::apply`] moves the motor on by one PWM period, with the mean voltage of the bridge. Sensors are ideal:
//! what they add to the truth enters in [`SimulatedBoard::sample`] and nowhere else.

use crate::double::SimulatedScalar;
use crate::plant::{Armature, Plant, State};
use crate::profile::{Load, Step, value_at};
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
    /// Smooth part of the load torque now: the end of one integration step is the start of the next.
    smooth_load: f64,
    period: u64,
    acting: Armature,
    scalar: PhantomData<S>,
}

impl<S: SimulatedScalar> SimulatedBoard<S> {
    /// The board of a scenario, at its start, with open switches.
    pub fn new(scenario: &Scenario) -> Self {
        let rate = scenario.timing.rate;
        Self {
            plant: scenario.motor,
            load: scenario.load.clone(),
            bus_voltage: scenario.bus.voltage,
            bus_steps: scenario.bus.steps.clone(),
            rate,
            substeps: scenario.motor.steps_for(1.0 / rate),
            delay: scenario.timing.delay,
            state: scenario.initial.state(),
            smooth_load: scenario.load.sines_at(0.0),
            period: 0,
            acting: Armature::Open(scenario.bus.voltage),
            scalar: PhantomData,
        }
    }

    /// Time of the next sample [s].
    pub fn time(&self) -> f64 {
        self.period as f64 / self.rate
    }

    /// The motor's state.
    pub fn state(&self) -> State {
        self.state
    }

    /// Torque that opposes the motor beyond viscous friction [N·m]: what a disturbance observer is to find.
    pub fn load_torque(&self) -> f64 {
        self.load.steps_at(self.time()) + self.smooth_load + self.plant.coulomb_torque(self.state.speed)
    }

    /// Bus voltage [V].
    pub fn bus_voltage(&self) -> f64 {
        value_at(&self.bus_steps, self.bus_voltage, self.time())
    }

    fn advance(&mut self, armature: Armature) {
        let start = self.time();
        let h = 1.0 / (self.rate * self.substeps as f64);
        for substep in 0..self.substeps {
            let t = start + substep as f64 * h;
            // A jump belongs between integration steps: what holds in the middle holds throughout.
            let constant = self.load.steps_at(t + 0.5 * h);
            let end = self.load.sines_at(t + h);
            let load = [self.smooth_load, self.load.sines_at(t + 0.5 * h), end];
            self.state = (self.plant).step(self.state, armature, load.map(|smooth| constant + smooth), h);
            self.smooth_load = end;
        }
        self.period += 1;
    }
}

impl<S: SimulatedScalar> Board<S> for SimulatedBoard<S> {
    fn sample(&mut self) -> Sample<S> {
        Sample {
            speed: S::from_f64(self.state.speed),
            current: S::from_f64(self.state.current),
            bus_voltage: S::from_f64(self.bus_voltage()),
        }
    }

    fn apply(&mut self, command: BridgeCommand<S>) {
        let bus_voltage = self.bus_voltage();
        let commanded = match command {
            BridgeCommand::Off => Armature::Open(bus_voltage),
            BridgeCommand::Duty(duty) => Armature::Driven(duty.to_f64() * bus_voltage),
        };
        let before = std::mem::replace(&mut self.acting, commanded);
        // A duty waits for the timer's next update where there is a delay; switching off never waits.
        let waits = self.delay && matches!(commanded, Armature::Driven(_));
        self.advance(if waits { before } else { commanded });
    }
}
