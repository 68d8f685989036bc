//! What is connected between the bus and the shaft: supply, bridge, leads, motor; how they are stepped is in
//! [`integration`](super::integration).
//!
//! Conventions: the lead current flows out of leg U, through what is between the leads, and into leg V. With the leads reversed the
//! armature's current is its negative. A current of a leg is positive out of it, one of a shunt from the leg to ground.

use super::drivers::Switches;
use crate::plant::{Plant, State as Motion};
use crate::profile::{Load, Step, value_at};
use crate::scenario::Scenario;

/// A leg that the motor is connected to.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Leg {
    /// The one that a positive lead current flows out of.
    U,
    /// The one that it flows into.
    V,
}

/// The legs, as indices.
pub(super) const U: usize = Leg::U as usize;
pub(super) const V: usize = Leg::V as usize;
pub(super) const LEGS: [usize; 2] = [U, V];

/// Signs of their currents by the lead current's.
pub(super) const OUTWARD: [f64; 2] = [1.0, -1.0];

/// Shunt of a leg (Ω).
pub const SHUNT: f64 = 3e-3;
/// A switch that is on (Ω), in either direction: STL180N6F7, about its data sheet's typical value.
pub const SWITCH: f64 = 2e-3;
/// Drop of its body diode (V), which has [`DIODE_SLOPE`] besides: of that size in data sheets of such parts.
pub const DIODE_DROP: f64 = 0.7;
/// Slope of the body diode (Ω).
pub const DIODE_SLOPE: f64 = 5e-3;
/// Capacitance of the bus (F): what `docs/b-g431b-esc1.md` asks for.
pub const BUS_CAPACITANCE: f64 = 470e-6;
/// Inductance of a short circuit's wires (H): half a metre and back.
pub const SHORT_INDUCTANCE: f64 = 1e-6;
/// Resistance of a short circuit's wires and contact (Ω).
pub const SHORT_RESISTANCE: f64 = 20e-3;

/// Longest integration step (s).
const LONGEST: f64 = 10e-6;
/// The same with a short circuit: a fiftieth of its time constant.
const LONGEST_WITH_SHORT: f64 = 1e-6;

/// A rail of the bus.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Rail {
    /// Minus, beyond the shunts.
    Ground,
    /// Plus.
    Supply,
}

/// What is between the leads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Leads {
    /// The motor.
    #[default]
    Motor,
    /// Nothing: a lead is off.
    Open,
    /// A short circuit, and the motor behind it.
    Shorted,
}

/// A leg's output that touches a rail.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Short {
    /// The leg.
    pub leg: Leg,
    /// What it touches.
    pub rail: Rail,
}

/// What the supply's voltage is from a time on, instead of the scenario's.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Ramp {
    /// When (s).
    pub from: f64,
    /// Voltage then (V); none: the scenario's.
    pub voltage: Option<f64>,
    /// Rate of change (V/s); never below 0 V.
    pub rate: f64,
}

/// What is connected, and how.
#[derive(Clone, Debug)]
pub struct Circuit {
    /// The motor.
    pub plant: Plant,
    load: Load,
    /// Voltage of the supply ahead of its first step (V).
    supply: f64,
    supply_steps: Vec<Step>,
    /// Resistance of the supply (Ω).
    pub(super) supply_resistance: f64,
    /// Time at which the profiles of load and supply start (s); there is no load before.
    pub(super) start: f64,
    /// 1, or −1 if the motor's leads are reversed.
    pub(super) polarity: f64,
    /// Which switches of U and V are on.
    pub switches: [Switches; 2],
    /// What is between the leads.
    pub leads: Leads,
    /// A leg's output that touches a rail.
    pub short: Option<Short>,
    /// Whether the shaft is held.
    pub is_blocked: bool,
    /// What loads the shaft beside the scenario's load (N·m).
    pub extra_load: f64,
    /// What overrides the supply.
    pub ramp: Option<Ramp>,
}

/// Where energy went since the start (J).
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct Energy {
    /// Drawn from the bus by the bridge; what was fed back counts negative.
    pub drawn: f64,
    /// Turned into heat by winding, switches, diodes and shunts.
    pub heat: f64,
    /// Handed to the rotor by the air gap: ∫Kb·i·ω.
    pub rotor: f64,
}

/// The state at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct State {
    /// Seconds since power came.
    pub time: f64,
    /// Speed and armature current.
    pub motion: Motion,
    /// The shaft's angle (rad).
    pub angle: f64,
    /// Lead current (A).
    pub lead_current: f64,
    /// What a leg's short circuit takes (A), from the leg to the rail.
    pub short_current: f64,
    /// Bus voltage (V).
    pub bus_voltage: f64,
    /// What the amplifiers show of the shunts of U and V: currents from the leg to ground (A).
    pub sensed: [f64; 2],
    /// ∫ of the voltage from lead U to lead V (V·s); with a lead off, of the motor's.
    pub volt_seconds: f64,
    /// Energies; right as long as nothing is shorted.
    pub energy: Energy,
}

/// What the output of a leg sees: voltage = top·bus + offset − resistance·(the lead's part of the current out of the leg).
#[derive(Clone, Copy, Debug)]
pub(super) struct Source {
    pub top: f64,
    pub offset: f64,
    pub resistance: f64,
    through_shunt: bool,
}

const HIGH: Source = Source { top: 1.0, offset: 0.0, resistance: SWITCH, through_shunt: false };
const LOW: Source =
    Source { top: 0.0, offset: 0.0, resistance: SWITCH + SHUNT, through_shunt: true };
const HIGH_DIODE: Source =
    Source { top: 1.0, offset: DIODE_DROP, resistance: DIODE_SLOPE, through_shunt: false };
const LOW_DIODE: Source =
    Source { top: 0.0, offset: -DIODE_DROP, resistance: DIODE_SLOPE + SHUNT, through_shunt: true };

/// Those of both legs, for a direction of the lead current.
#[derive(Clone, Copy, Debug)]
pub(super) struct Sources(pub [Source; 2]);

impl Sources {
    /// Share of the bus voltage between the leads; what the lead current draws from the bus by its size.
    pub fn top(&self) -> f64 {
        self.0[U].top - self.0[V].top
    }

    /// What else is between the leads at no current (V).
    pub fn offset(&self) -> f64 {
        self.0[U].offset - self.0[V].offset
    }

    /// Of both (Ω).
    pub fn resistance(&self) -> f64 {
        self.0[U].resistance + self.0[V].resistance
    }
}

impl Rail {
    /// As a share of the bus voltage.
    pub(super) fn top(self) -> f64 {
        match self {
            Self::Ground => 0.0,
            Self::Supply => 1.0,
        }
    }
}

impl Circuit {
    /// That of a scenario whose profiles have not started, all well, with open switches.
    pub fn new(scenario: &Scenario) -> Self {
        Self {
            plant: Plant::new(scenario.motor),
            load: scenario.load.clone(),
            supply: scenario.bus.voltage,
            supply_steps: scenario.bus.steps.clone(),
            supply_resistance: scenario.bus.resistance,
            start: f64::INFINITY,
            polarity: if scenario.bridge.leads_reversed { -1.0 } else { 1.0 },
            switches: [Switches::Open; 2],
            leads: Leads::Motor,
            short: None,
            is_blocked: false,
            extra_load: 0.0,
            ramp: None,
        }
    }

    /// The state when power comes: at a speed (rad/s), with no current and the bus at its supply.
    pub fn rest(&self, speed: f64) -> State {
        State {
            time: 0.0,
            motion: Motion { speed, current: 0.0 },
            angle: 0.0,
            lead_current: 0.0,
            short_current: 0.0,
            bus_voltage: self.supply_at(0.0),
            sensed: [0.0; 2],
            volt_seconds: 0.0,
            energy: Energy::default(),
        }
    }

    /// Times at which its profiles jump (s).
    pub fn jumps(&self) -> impl Iterator<Item = f64> {
        let steps = self.load.steps.iter().chain(&self.supply_steps);
        steps.map(|step| self.start + step.time).chain([self.start])
    }

    /// Voltage of the supply, ahead of its resistance, at a time (V).
    pub fn supply_at(&self, time: f64) -> f64 {
        let scheduled = value_at(&self.supply_steps, self.supply, time - self.start);
        match self.ramp {
            Some(Ramp { from, voltage, rate }) => {
                (voltage.unwrap_or(scheduled) + rate * (time - from)).max(0.0)
            }
            None => scheduled,
        }
    }

    /// Load torque at a time (N·m).
    pub fn load_at(&self, time: f64) -> f64 {
        let scheduled = if time < self.start { 0.0 } else { self.load.at(time - self.start) };
        scheduled + self.extra_load
    }

    /// The longest integration step (s): a sixth of the motor's fastest time constant at most.
    pub fn longest_step(&self) -> f64 {
        let is_shorted = self.short.is_some() || self.leads == Leads::Shorted;
        let longest = if is_shorted { LONGEST_WITH_SHORT } else { LONGEST };
        longest.min(0.5 / self.plant.steps_for(1.0) as f64)
    }

    /// Lets what a change of the circuit makes jump jump: to be called after one.
    pub fn settle(&self, state: &mut State) {
        match self.leads {
            // When a short circuit ends, the current in its wires is gone, and the winding's is in the leads.
            Leads::Motor => state.lead_current = self.polarity * state.motion.current,
            Leads::Open => {
                state.lead_current = 0.0;
                state.motion.current = 0.0;
            }
            Leads::Shorted => {}
        }
        if self.short.is_none() {
            state.short_current = 0.0;
        }
        if self.is_blocked {
            state.motion.speed = 0.0;
        }
    }

    /// What the outputs of the legs see, where the lead current is of a sign.
    pub(super) fn sources(&self, sign: f64, state: &State) -> Sources {
        Sources(LEGS.map(|leg| match self.short {
            Some(short) if short.leg as usize == leg => self.shorted_leg(short, state),
            _ => path(self.switches[leg], OUTWARD[leg] * sign),
        }))
    }

    /// The one that touches a rail.
    fn shorted_leg(&self, short: Short, state: &State) -> Source {
        let leg = short.leg as usize;
        let current = self.leg_currents(state)[leg];
        if self.switches[leg] == Switches::Open && current == 0.0 {
            // No diode conducts: the lead's current comes through the short circuit.
            let (top, resistance) = (short.rail.top(), SHORT_RESISTANCE);
            return Source { top, offset: 0.0, resistance, through_shunt: false };
        }
        let path = path(self.switches[leg], current);
        Source { offset: path.offset - path.resistance * state.short_current, ..path }
    }

    /// Whether the lead current ends where it would change its sign, for a diode that nothing else goes through.
    pub(super) fn is_rectified(&self) -> bool {
        LEGS.into_iter().any(|leg| {
            let is_shorted = self.short.is_some_and(|short| short.leg as usize == leg);
            self.switches[leg] == Switches::Open && !is_shorted
        })
    }

    /// Currents out of the legs U and V (A).
    pub fn leg_currents(&self, state: &State) -> [f64; 2] {
        let mut currents = OUTWARD.map(|sign| sign * state.lead_current);
        if let Some(Short { leg, .. }) = self.short {
            currents[leg as usize] += state.short_current;
        }
        currents
    }

    /// Currents through the shunts of U and V, from the leg to ground (A).
    pub(super) fn shunt_currents(&self, sources: &Sources, state: &State) -> [f64; 2] {
        let currents = self.leg_currents(state);
        LEGS.map(|leg| if sources.0[leg].through_shunt { -currents[leg] } else { 0.0 })
    }

    /// What a leg's short circuit draws from the bus (A).
    pub(super) fn drawn_by_short(&self, sources: &Sources, state: &State) -> f64 {
        self.short.map_or(0.0, |Short { leg, rail }| {
            (sources.0[leg as usize].top - rail.top()) * state.short_current
        })
    }
}

/// Where a leg's current flows.
fn path(switches: Switches, current: f64) -> Source {
    match switches {
        Switches::High => HIGH,
        Switches::Low => LOW,
        Switches::Open if current > 0.0 => LOW_DIODE,
        Switches::Open => HIGH_DIODE,
    }
}
