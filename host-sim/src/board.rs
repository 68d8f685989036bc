//! The simulated board: motor, bridge, bus and sensors behind the HAL trait.
//!
//! One [`Board::apply`] moves the motor on by one PWM period, with the mean voltage of the bridge. What sensors make of the
//! truth is in [`crate::sensors`].

use crate::double::SimulatedScalar;
use crate::plant::{Armature, Plant, State};
use crate::profile::{Load, Step, Waves, value_at};
use crate::scenario::{Bridge, Scenario};
use crate::sensors::Sensors;
use quasidrive::hal::{Board, BridgeCommand, Exact, READS, Sample};
use quasidrive::math::Base;
use quasidrive::per_unit::Bases;
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
    /// The shaft's angle (rad).
    angle: f64,
    /// What it turned in the last period (rad).
    advance: f64,
    sensors: Option<Sensors>,
    bridge: Bridge,
    bus_resistance: f64,
    /// The smooth part of the load, at half integration steps.
    waves: Waves,
    period: u64,
    /// Time of the next sample (s).
    time: f64,
    /// Bus voltage at that time (V).
    bus_now: f64,
    /// What the bridge does until a delayed command takes effect.
    acting: BridgeCommand<f64>,
    /// Whether a motor lead is open.
    lead_open: bool,
    bases: Bases,
    scalar: PhantomData<S>,
}

impl<S: SimulatedScalar> SimulatedBoard<S> {
    /// The board of a scenario, at its start, with open switches, for a drive with these bases.
    pub fn new(scenario: &Scenario, bases: Bases) -> Self {
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
            angle: 0.0,
            advance: 0.0,
            sensors: scenario.sensors.map(Sensors::new),
            bridge: scenario.bridge,
            bus_resistance: scenario.bus.resistance,
            waves: scenario.load.waves(0.5 / (rate * substeps as f64)),
            period: 0,
            time: 0.0,
            bus_now,
            acting: BridgeCommand::Off,
            lead_open: false,
            bases,
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

    /// Opens a motor lead, from now on.
    pub fn open_lead(&mut self) {
        self.lead_open = true;
        self.state.current = 0.0;
    }

    /// Another voltage of the bus without load (V), from now on.
    pub fn set_bus_voltage(&mut self, voltage: f64) {
        self.bus_voltage = voltage;
        self.bus_steps.clear();
    }

    /// Torque that opposes the motor beyond viscous friction [N·m]: what a disturbance observer is to find.
    #[inline]
    pub fn load_torque(&self) -> f64 {
        let friction = self.plant.coulomb_torque(self.state.speed);
        self.load.steps_at(self.time) + self.waves.sum() + friction
    }

    /// What flows out of the bridge (A), where the current's sensor is.
    fn bridge_current(&self) -> f64 {
        if self.bridge.leads_reversed { -self.state.current } else { self.state.current }
    }

    /// One period with the bridge doing `acting`: a duty is a share of the bus voltage that is there as it acts.
    #[inline]
    fn advance(&mut self, acting: BridgeCommand<f64>) {
        let armature = match acting {
            _ if self.lead_open => Armature::Open(f64::INFINITY),
            BridgeCommand::Off => Armature::Open(self.bus_now),
            BridgeCommand::Duty(duty) => Armature::Driven(self.bridge.voltage(
                duty,
                self.bus_now,
                self.state.current,
                self.rate,
            )),
        };
        let h = 1.0 / (self.rate * self.substeps as f64);
        let start = self.angle;
        if let Some(sensors) = &mut self.sensors {
            sensors.begin();
        }
        for substep in 0..self.substeps {
            // A jump belongs between integration steps: what holds in the middle holds throughout.
            let constant = self.load.steps_at(self.time + (substep as f64 + 0.5) * h);
            let load = [self.waves.sum(), self.waves.advance(), self.waves.advance()];
            let before = self.state.speed;
            self.state = self.plant.step(self.state, armature, load.map(|wave| constant + wave), h);
            let gain = self.state.speed - before;
            if let Some(sensors) = &mut self.sensors {
                // The reads that fall into this integration step, the period's end included.
                let read_at = |step: usize| step * READS / self.substeps;
                for read in read_at(substep)..read_at(substep + 1) {
                    let time = (read + 1) as f64 / READS as f64 - sensors.shift();
                    let share = time * self.substeps as f64 - substep as f64;
                    let turned = share * h * (before + 0.5 * share * gain);
                    sensors.read_encoder(read, self.angle + turned);
                }
            }
            self.angle += h * (before + 0.5 * gain);
        }
        self.advance = self.angle - start;
        self.period += 1;
        self.time = self.period as f64 / self.rate;
        let drawn = match acting {
            BridgeCommand::Off => 0.0,
            BridgeCommand::Duty(duty) => duty * self.bridge_current(),
        };
        self.bus_now =
            value_at(&self.bus_steps, self.bus_voltage, self.time) - self.bus_resistance * drawn;
    }
}

impl<S: SimulatedScalar> Board<S> for SimulatedBoard<S> {
    fn sample(&mut self) -> Sample<S> {
        let current = self.bridge_current();
        match &mut self.sensors {
            Some(sensors) => Sample::Codes(sensors.sample(current, self.bus_now)),
            None => Sample::Exact(Exact {
                speed: S::from_f64(self.state.speed, self.bases.speed),
                advance: S::from_f64(self.advance, self.bases.angle),
                current: S::from_f64(current, self.bases.current),
                bus_voltage: S::from_f64(self.bus_now, self.bases.voltage),
            }),
        }
    }

    fn apply(&mut self, command: BridgeCommand<S>) {
        let commanded = match command {
            BridgeCommand::Off => BridgeCommand::Off,
            BridgeCommand::Duty(duty) => BridgeCommand::Duty(duty.to_f64(Base::RATIO)),
        };
        let before = std::mem::replace(&mut self.acting, commanded);
        // A duty waits for the timer's next update where there is a delay; switching off never waits.
        let waits = self.delay && commanded != BridgeCommand::Off;
        self.advance(if waits { before } else { commanded });
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::double::Double;

    const PERIOD: f64 = 5e-5;

    fn board(edit: impl FnOnce(&mut Scenario)) -> SimulatedBoard<Double> {
        let mut scenario = Scenario::paper();
        scenario.load = Load::default();
        edit(&mut scenario);
        let bases = Bases::new(&scenario.drive_config()).expect("valid");
        SimulatedBoard::new(&scenario, bases)
    }

    /// Change of the current over a period that starts with none, at standstill (A).
    fn kick(board: &mut SimulatedBoard<Double>, command: BridgeCommand<Double>) -> f64 {
        let before = board.state().current;
        board.apply(command);
        board.state().current - before
    }

    #[test]
    fn a_duty_acts_one_period_late_or_at_once() {
        let duty = BridgeCommand::Duty(Double(0.5));
        let mut late = board(|_| {});
        assert_eq!(kick(&mut late, duty), 0.0);
        // (1 − e^(−h·Ra/La))/Ra·12 V, less a little back-EMF.
        let expected = (1.0 - (-PERIOD * 0.7 / 105e-6_f64).exp()) / 0.7 * 12.0;
        let second = kick(&mut late, duty);
        assert!((second / expected - 1.0).abs() < 0.01, "{second} A is not {expected} A");
        let mut at_once = board(|scenario| scenario.timing.delay = false);
        let first = kick(&mut at_once, duty);
        assert!((first / expected - 1.0).abs() < 0.01, "{first} A is not {expected} A");
    }

    #[test]
    fn off_never_waits() {
        let mut board = board(|_| {});
        for _ in 0..10 {
            board.apply(BridgeCommand::Duty(Double(0.1)));
        }
        let driven = board.state().current;
        board.apply(BridgeCommand::Off);
        // Driven on, the current would have changed little; open, 24 V against it kill it within the period.
        assert!(driven > 1.0 && board.state().current == 0.0, "{driven} A");
    }

    #[test]
    fn a_duty_is_a_share_of_the_bus_as_it_acts() {
        let step = Step { time: PERIOD, value: 12.0 };
        let mut sagging = board(|scenario| scenario.bus.steps = vec![step]);
        let mut stiff = board(|_| {});
        let duty = BridgeCommand::Duty(Double(0.5));
        for board in [&mut sagging, &mut stiff] {
            board.apply(duty);
            board.apply(duty);
        }
        // The duty was commanded at 24 V and acts at 12 V.
        let ratio = sagging.state().current / stiff.state().current;
        assert!((ratio - 0.5).abs() < 1e-3, "{ratio}");
    }

    #[test]
    fn brushes_and_dead_time_take_voltage_against_the_current() {
        let mut board = board(|scenario| {
            scenario.bridge.dead_time = 1e-6;
            scenario.bridge.brush_drop = 0.5;
        });
        // 2·1 µs of 50 µs of 24 V, and the brushes: 1.46 V.
        for (current, lost) in [(0.0, 0.0), (0.025, 0.73), (3.0, 1.46), (-3.0, -1.46)] {
            let voltage = board.bridge.voltage(0.5, 24.0, current, 20_000.0);
            assert!((voltage - (12.0 - lost)).abs() < 1e-12, "{current} A: {voltage} V");
        }
        // Held long enough, the current is what is left over the resistance, less what turns by then.
        for _ in 0..20 {
            board.apply(BridgeCommand::Duty(Double(0.2)));
        }
        let expected = (4.8 - 1.46 - 59e-3 * board.state().speed) / 0.7;
        assert!((board.state().current / expected - 1.0).abs() < 0.02, "{:?}", board.state());
    }

    #[test]
    fn reversed_leads_turn_the_motor_but_not_the_sensor_of_the_current() {
        // What the board sees is a motor that turns backwards: its own current is still that of its own voltage.
        let mut board = board(|scenario| {
            scenario.bridge.leads_reversed = true;
            scenario.bus.resistance = 0.1;
        });
        for _ in 0..3 {
            board.apply(BridgeCommand::Duty(Double(0.5)));
        }
        let Sample::Exact(sample) = board.sample() else { unreachable!("exact sensors") };
        assert!(sample.current.0 > 3.0 && board.state().current == -sample.current.0, "{sample:?}");
        assert!(sample.speed.0 < -0.1, "{sample:?}");
        // It draws from the bus.
        let expected = 24.0 - 0.1 * 0.5 * sample.current.0;
        assert!((sample.bus_voltage.0 - expected).abs() < 1e-9, "{sample:?}");
    }

    #[test]
    fn a_load_step_between_periods_acts_from_there_on() {
        let step = Step { time: 2.0 * PERIOD, value: 0.1 };
        let mut board = board(|scenario| scenario.load.steps = vec![step]);
        let mut speeds = Vec::new();
        for _ in 0..3 {
            board.apply(BridgeCommand::Off);
            speeds.push(board.state().speed);
        }
        assert_eq!(speeds[..2], [0.0, 0.0]);
        let expected = -0.1 / 7.95e-5 * PERIOD;
        assert!((speeds[2] / expected - 1.0).abs() < 1e-9, "{speeds:?}");
        assert_eq!(board.load_torque(), 0.1);
    }
}
