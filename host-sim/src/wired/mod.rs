//! A scenario's motor behind the pins of an emulated B-G431B-ESC1: what drives it is the switches' state.
//!
//! - [`drivers`]: from gate signals to switches, with dead time and bootstrap capacitors watched;
//! - [`circuit`]: what is connected between bus and shaft; [`integration`] steps it;
//! - [`pads`]: voltages at the analogue pins; [`encoder`]: the encoder's signals;
//! - [`faults`]: what breaks, and when.
//!
//! Looking does not change the world: its state is kept at the last change and at whole integration steps from there, and a look
//! integrates a copy. So what an emulator reads, and how often, is nothing to the motor.

pub mod circuit;
pub mod drivers;
pub mod encoder;
pub mod faults;
pub mod integration;
pub mod pads;
#[cfg(test)]
mod tests;

use crate::scenario::Scenario;
use crate::sensors::{Disc, SensorsTable};
use circuit::{Circuit, Energy, LEGS, Leads, Ramp, State, U, V};
use drivers::{Drivers, Hazard};
use encoder::Encoder;
use faults::{Fault, Injection};
use pads::{Errors, Pads};
use rand::SeedableRng;
use rand::rngs::StdRng;
use virtual_board::world::{AnaloguePin, Gates, InputPin, World};

/// Temperature of a board that nothing heats (°C).
const ROOM: f64 = 25.0;

/// What is true at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Truth {
    /// Seconds since power came.
    pub time: f64,
    /// Shaft speed (rad/s).
    pub speed: f64,
    /// Shaft angle since then (rad).
    pub angle: f64,
    /// Armature current (A), positive for a torque in positive direction.
    pub current: f64,
    /// Currents out of the legs U and V (A).
    pub leg_currents: [f64; 2],
    /// Bus voltage (V).
    pub bus_voltage: f64,
    /// Load torque, with Coulomb friction (N·m): what a disturbance observer is to find.
    pub load_torque: f64,
    /// ∫ of the voltage from lead U to lead V (V·s).
    pub volt_seconds: f64,
    /// Where energy went (J).
    pub energy: Energy,
}

/// A scenario's motor, bus and sensors, wired to the board.
#[derive(Clone, Debug)]
pub struct WiredWorld {
    circuit: Circuit,
    state: State,
    /// Time of the last change (s), steps taken since, and how long they are (s).
    changed: f64,
    steps: u32,
    longest_step: f64,
    drivers: Drivers,
    pads: Pads,
    encoder: Encoder,
    potentiometer: f64,
    temperature: f64,
    button_is_pressed: bool,
    injections: Vec<Injection>,
    /// Times at which a profile jumps or a fault starts or ends, in order, and how many of them are past.
    jumps: Vec<f64>,
    jumped: usize,
}

impl WiredWorld {
    /// The world of a scenario, as power comes. Motor, load, bus and sensors are the scenario's, and whether leads and encoder are the
    /// wrong way round. The shaft turns at its initial speed from the first; no current flows. There is no load and no step of the bus
    /// before [`start_profiles`](Self::start_profiles). What the scenario says of timing, dead time and converters' resolution is the firmware's and the
    /// emulated board's to say.
    ///
    /// Without a table of sensors they are exact, with the default encoder. An offset of the current sits in both shunts with
    /// opposite signs; their noise adds up to the table's in the half of their difference.
    pub fn new(scenario: &Scenario) -> Self {
        let exact =
            SensorsTable { current_noise: 0.0, bus_voltage_noise: 0.0, ..SensorsTable::default() };
        let sensors = scenario.sensors.unwrap_or(exact);
        let mut random = StdRng::seed_from_u64(sensors.seed);
        let disc = Disc::new(&sensors, &mut random);
        let errors = Errors {
            shunt_offsets: [-sensors.current_offset, sensors.current_offset],
            shunt_noise: std::f64::consts::SQRT_2 * sensors.current_noise,
            bus_noise: sensors.bus_voltage_noise,
        };
        let circuit = Circuit::new(scenario);
        Self {
            state: circuit.rest(scenario.initial.speed),
            changed: 0.0,
            steps: 0,
            longest_step: circuit.longest_step(),
            circuit,
            drivers: Drivers::default(),
            pads: Pads::new(errors, random),
            encoder: Encoder::new(disc, sensors.counts_per_turn),
            potentiometer: 0.0,
            temperature: ROOM,
            button_is_pressed: false,
            injections: Vec::new(),
            jumps: Vec::new(),
            jumped: 0,
        }
    }

    /// The profiles of load and bus start at a time (s), as when the firmware has been armed: that is the scenario's time zero.
    pub fn start_profiles(&mut self, time: f64) {
        self.circuit.start = time;
        self.schedule();
    }

    /// Something breaks, from a time on that must not be before what the world was last asked for.
    pub fn inject(&mut self, injection: Injection) {
        self.injections.push(injection);
        self.schedule();
    }

    /// Turns the potentiometer to a share of its way, 0 to 1.
    pub fn set_potentiometer(&mut self, share: f64) {
        self.potentiometer = share;
    }

    /// What is true at a time, which must not be before the last change.
    pub fn truth(&mut self, time: f64) -> Truth {
        let state = self.at(time);
        let friction = self.circuit.plant.coulomb_torque(state.motion.speed);
        Truth {
            time: state.time,
            speed: state.motion.speed,
            angle: state.angle,
            current: state.motion.current,
            leg_currents: self.circuit.leg_currents(&state),
            bus_voltage: state.bus_voltage,
            load_torque: self.circuit.load_at(time) + friction,
            volt_seconds: state.volt_seconds,
            energy: state.energy,
        }
    }

    /// What firmware did to the bridge that it must not: the first thousand, in order of time. A test that is not about these asserts that
    /// there are none.
    pub fn hazards(&self) -> &[Hazard] {
        self.drivers.hazards()
    }

    /// Lists what is to come.
    fn schedule(&mut self) {
        let faults = self.injections.iter();
        self.jumps = self.circuit.jumps().collect();
        self.jumps.extend(faults.flat_map(|one| [one.during.start, one.during.end]));
        self.jumps.sort_by(f64::total_cmp);
        self.jumped = self.jumps.partition_point(|jump| *jump <= self.state.time);
        self.apply_faults();
    }

    /// The state at a time.
    fn at(&mut self, time: f64) -> State {
        self.pass(time);
        let mut state = self.state;
        self.circuit.advance(&mut state, time, self.longest_step);
        state
    }

    /// Goes on to the last change up to a time, and by whole steps from there.
    fn pass(&mut self, time: f64) {
        assert!(time >= self.state.time, "time went back to {time} s from {} s", self.state.time);
        loop {
            let jump = self.jumps.get(self.jumped).copied().unwrap_or(f64::INFINITY);
            let change = jump.min(self.drivers.next_change());
            if change > time {
                break;
            }
            self.circuit.advance(&mut self.state, change, self.longest_step);
            if change == jump {
                self.jumped += 1;
                self.apply_faults();
            } else {
                self.drivers.run_down(change);
                self.connect();
            }
        }
        loop {
            let until = self.changed + f64::from(self.steps + 1) * self.longest_step;
            if until > time {
                break;
            }
            self.circuit.advance(&mut self.state, until, self.longest_step);
            self.steps += 1;
        }
    }

    /// Brings the switches to where the drivers have them.
    fn connect(&mut self) {
        self.circuit.switches = LEGS.map(|leg| self.drivers.on(leg));
        self.restart_steps();
    }

    /// Counts steps from here, where something has changed.
    fn restart_steps(&mut self) {
        self.changed = self.state.time;
        self.steps = 0;
        self.longest_step = self.circuit.longest_step();
    }

    /// Brings everything to where the faults of this time have it.
    fn apply_faults(&mut self) {
        let time = self.state.time;
        let circuit = &mut self.circuit;
        circuit.leads = Leads::Motor;
        circuit.short = None;
        circuit.is_blocked = false;
        circuit.extra_load = 0.0;
        circuit.ramp = None;
        self.pads.shunt_faults = [None; 2];
        self.pads.thermistor_fault = None;
        self.temperature = ROOM;
        self.button_is_pressed = false;
        let mut encoder = None;
        for Injection { fault, during } in &self.injections {
            if !during.contains(&time) {
                continue;
            }
            let from = during.start;
            match *fault {
                Fault::Encoder(fault) => encoder = Some(fault),
                Fault::CurrentSensor(leg, fault) => {
                    self.pads.shunt_faults[leg as usize] = Some((from, fault));
                }
                Fault::MotorShorted => circuit.leads = Leads::Shorted,
                Fault::LeadOpen => circuit.leads = Leads::Open,
                Fault::LegShorted(short) => circuit.short = Some(short),
                Fault::RotorBlocked => circuit.is_blocked = true,
                Fault::Load(torque) => circuit.extra_load = torque,
                Fault::Supply(voltage) => {
                    circuit.ramp = Some(Ramp { from, voltage: Some(voltage), rate: 0.0 });
                }
                Fault::SupplyRamp(rate) => circuit.ramp = Some(Ramp { from, voltage: None, rate }),
                Fault::BoardTemperature(celsius) => self.temperature = celsius,
                Fault::Thermistor(fault) => self.pads.thermistor_fault = Some(fault),
                Fault::ButtonPressed => self.button_is_pressed = true,
            }
        }
        circuit.settle(&mut self.state);
        self.encoder.set_fault(self.state.angle, encoder);
        self.restart_steps();
    }
}

impl World for WiredWorld {
    fn switch(&mut self, time: f64, gates: Gates) {
        self.state = self.at(time);
        self.drivers.tell(time, gates);
        self.connect();
    }

    fn voltage(&mut self, time: f64, pin: AnaloguePin) -> f64 {
        let state = self.at(time);
        match pin {
            AnaloguePin::ShuntU => self.pads.shunt(time, U, state.sensed[U]),
            AnaloguePin::ShuntV => self.pads.shunt(time, V, state.sensed[V]),
            AnaloguePin::ShuntW => pads::shunt_pad(0.0),
            AnaloguePin::BusVoltage => self.pads.bus(state.bus_voltage),
            AnaloguePin::Temperature => self.pads.temperature(self.temperature),
            AnaloguePin::Potentiometer => self.pads.potentiometer(self.potentiometer),
        }
    }

    fn encoder_edges(&mut self, time: f64) -> i64 {
        self.pass(time);
        self.encoder.edges(self.circuit.angle_at(&self.state, time))
    }

    fn level(&mut self, time: f64, pin: InputPin) -> bool {
        self.pass(time);
        match pin {
            InputPin::Button => !self.button_is_pressed,
        }
    }
}
