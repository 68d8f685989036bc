//! Motor, bridge and bus between two changes of the switches.
//!
//! The armature's current follows from a voltage, a resistance and a back-EMF that are held over a step: it is an exponential, in closed
//! form, and so is the instant at which diodes end it. Speed and bus voltage are those in the middle of the step, predicted from its
//! start; the mechanics then take the current's exact mean. That is of second order, and exact where nothing but the current changes.
//! What errs is the back-EMF: by h²/8 of its second derivative, less than 0.2 mV with the paper's motor in a step of 10 µs.
//!
//! Conventions: the lead current flows out of leg U, through what is between the leads, and into leg V. With the leads reversed the armature's
//! current is its negative.

use super::drivers::Switches;
use crate::plant::{Plant, State as Motion};
use crate::profile::{Load, Step, value_at};

/// The legs that the motor is connected to, and the signs of their currents, positive out of the leg, by the lead current's.
pub const U: usize = 0;
/// See [`U`].
pub const V: usize = 1;
const OUTWARD: [f64; 2] = [1.0, -1.0];

/// Shunt of a leg (Ω).
pub const SHUNT: f64 = 3e-3;
/// A switch that is on (Ω), in either direction: STL180N6F7, data sheet, typical.
pub const SWITCH: f64 = 2e-3;
/// Its body diode's drop (V) and slope (Ω): data sheet's curve, read by eye.
pub const DIODE_DROP: f64 = 0.7;
/// See [`DIODE_DROP`].
pub const DIODE_SLOPE: f64 = 5e-3;
/// Capacitance of the bus (F): what `docs/b-g431b-esc1.md` asks for.
pub const BUS_CAPACITANCE: f64 = 470e-6;
/// A short circuit: its wires (H) and its contact with them (Ω).
pub const SHORT_INDUCTANCE: f64 = 1e-6;
/// See [`SHORT_INDUCTANCE`].
pub const SHORT_RESISTANCE: f64 = 20e-3;
/// Time constant of the amplifiers that look at the shunts (s): 13 MHz of gain and bandwidth at a gain of 16.
pub const SETTLING: f64 = 0.2e-6;

/// Longest integration step (s), and with a short circuit.
const LONGEST: f64 = 10e-6;
const LONGEST_WITH_SHORT: f64 = 0.5e-6;

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
    /// Torque on its shaft.
    pub load: Load,
    /// Voltage of the supply ahead of its first step (V).
    pub supply: f64,
    /// Its steps.
    pub supply_steps: Vec<Step>,
    /// Its resistance (Ω).
    pub supply_resistance: f64,
    /// Time at which the profiles of load and supply start (s); there is no load before.
    pub start: f64,
    /// 1, or −1 if the motor's leads are reversed.
    pub polarity: f64,
    /// Which switches of U and V are on.
    pub switches: [Switches; 2],
    /// What is between the leads.
    pub leads: Leads,
    /// A leg's output that touches a rail.
    pub short: Option<(usize, Rail)>,
    /// Whether the shaft is held.
    pub is_blocked: bool,
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
    /// Lead current (A).
    pub lead_current: f64,
    /// What a leg's short circuit takes (A), from the leg to the rail.
    pub short_current: f64,
    /// The shaft's angle (rad).
    pub angle: f64,
    /// Bus voltage (V).
    pub bus_voltage: f64,
    /// What the amplifiers show of the shunts of U and V: currents from the leg to ground (A).
    pub sensed: [f64; 2],
    /// ∫ of the voltage from lead U to lead V (V·s).
    pub volt_seconds: f64,
    /// Energies; right as long as nothing is shorted.
    pub energy: Energy,
}

/// A leg as its output sees it: voltage = top·bus + offset − resistance·(current out of the leg).
#[derive(Clone, Copy, Debug)]
struct Leg {
    top: f64,
    offset: f64,
    resistance: f64,
    through_shunt: bool,
}

const HIGH: Leg = Leg { top: 1.0, offset: 0.0, resistance: SWITCH, through_shunt: false };
const LOW: Leg = Leg { top: 0.0, offset: 0.0, resistance: SWITCH + SHUNT, through_shunt: true };
const HIGH_DIODE: Leg =
    Leg { top: 1.0, offset: DIODE_DROP, resistance: DIODE_SLOPE, through_shunt: false };
const LOW_DIODE: Leg =
    Leg { top: 0.0, offset: -DIODE_DROP, resistance: DIODE_SLOPE + SHUNT, through_shunt: true };

/// A branch's current over a step, x(t) = end + (start − end)·e^(−rate·t).
#[derive(Clone, Copy)]
struct Exponential {
    start: f64,
    end: f64,
    rate: f64,
}

impl Exponential {
    /// Under a constant voltage.
    fn new(start: f64, voltage: f64, resistance: f64, inductance: f64) -> Self {
        Self { start, end: voltage / resistance, rate: resistance / inductance }
    }

    /// Share of the way to its end that it goes in a time.
    fn share(&self, time: f64) -> f64 {
        -(-self.rate * time).exp_m1()
    }

    fn at(&self, share: f64) -> f64 {
        self.start + (self.end - self.start) * share
    }

    /// When it is zero, which it must become.
    fn zero(&self) -> f64 {
        -(self.start / (self.end - self.start)).ln_1p() / self.rate
    }

    /// ∫x dt and ∫x² dt over a time.
    fn integrals(&self, time: f64, share: f64) -> [f64; 2] {
        let fading = self.start - self.end;
        let first = fading * share / self.rate;
        // (1 − e^(−2kt))/2k, from 1 − e^(−kt).
        let second = fading * fading * share * (2.0 - share) / (2.0 * self.rate);
        [self.end * time + first, self.end * (self.end * time + 2.0 * first) + second]
    }
}

impl Circuit {
    /// At a time, with no current and the bus at its supply.
    pub fn rest(&self, speed: f64) -> State {
        State {
            time: 0.0,
            motion: Motion { speed, current: 0.0 },
            lead_current: 0.0,
            short_current: 0.0,
            angle: 0.0,
            bus_voltage: self.supply_at(0.0),
            sensed: [0.0; 2],
            volt_seconds: 0.0,
            energy: Energy::default(),
        }
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
        if time < self.start { 0.0 } else { self.load.at(time - self.start) }
    }

    /// The longest integration step (s): a sixth of the motor's fastest time constant at most.
    pub fn longest_step(&self) -> f64 {
        let is_shorted = self.short.is_some() || self.leads == Leads::Shorted;
        let longest = if is_shorted { LONGEST_WITH_SHORT } else { LONGEST };
        longest.min(0.5 / self.plant.steps_for(1.0) as f64)
    }

    /// Brings what a change of the circuit makes jump to where it jumps: to be called after one.
    pub fn settle(&self, state: &mut State) {
        if self.leads == Leads::Open {
            state.lead_current = 0.0;
            state.motion.current = 0.0;
        } else if self.leads == Leads::Motor {
            // When a short circuit ends its wires' current is gone, not the winding's.
            state.lead_current = self.polarity * state.motion.current;
        }
        if self.short.is_none() {
            state.short_current = 0.0;
        }
        if self.is_blocked {
            state.motion.speed = 0.0;
        }
    }

    /// Integrates up to a time, in steps of at most `longest`; the switches and all that is scheduled must not change before.
    pub fn advance(&self, state: &mut State, until: f64, longest: f64) {
        while state.time < until {
            let left = until - state.time;
            let is_last = left <= longest;
            let aimed = left.min(longest);
            let taken = self.step(state, aimed);
            state.time = if is_last && taken == aimed { until } else { state.time + taken };
        }
    }

    /// What a leg's output sees, where the lead current is of a sign.
    fn leg(&self, leg: usize, sign: f64, state: &State) -> Leg {
        let [short, current] = match self.short {
            Some((shorted, _)) if shorted == leg => {
                [state.short_current, OUTWARD[leg] * state.lead_current + state.short_current]
            }
            _ => [0.0, OUTWARD[leg] * sign],
        };
        let path = match (self.switches[leg], self.short) {
            (Switches::High, _) => HIGH,
            (Switches::Low, _) => LOW,
            (Switches::Open, _) if current > 0.0 => LOW_DIODE,
            (Switches::Open, Some((shorted, rail))) if shorted == leg && current == 0.0 => {
                // No diode conducts: the lead's current comes through the short circuit.
                let top = f64::from(u8::from(rail == Rail::Supply));
                let resistance = SHORT_RESISTANCE;
                return Leg { top, offset: 0.0, resistance, through_shunt: false };
            }
            (Switches::Open, _) => HIGH_DIODE,
        };
        Leg { offset: path.offset - path.resistance * short, ..path }
    }

    /// The bus after a time in which the bridge draws a current.
    fn bus_after(&self, state: &State, drawn: f64, time: f64) -> f64 {
        let supply = self.supply_at(state.time + time);
        if self.supply_resistance == 0.0 {
            return supply;
        }
        let end = supply - self.supply_resistance * drawn;
        let left = (-time / (self.supply_resistance * BUS_CAPACITANCE)).exp();
        end + (state.bus_voltage - end) * left
    }

    /// One step of at most `limit` seconds; gives what it took. It ends where the diodes end the lead current.
    fn step(&self, state: &mut State, limit: f64) -> f64 {
        let motor = self.plant.motor();
        let half = 0.5 * limit;
        let torque = self.load_at(state.time + half);
        let speed = if self.is_blocked {
            0.0
        } else {
            state.motion.speed + half * self.plant.acceleration(state.motion, torque)
        };
        let back_emf = self.polarity * motor.back_emf_constant * speed;
        let [inductance, resistance, emf] = match self.leads {
            Leads::Shorted => [SHORT_INDUCTANCE, SHORT_RESISTANCE, 0.0],
            Leads::Motor | Leads::Open => [motor.inductance, motor.resistance, back_emf],
        };

        let before = state.lead_current;
        let legs_for = |sign: f64| [self.leg(U, sign, state), self.leg(V, sign, state)];
        let drive = |legs: &[Leg; 2], bus: f64| {
            (legs[U].top - legs[V].top) * bus + legs[U].offset - legs[V].offset - emf
        };
        // The bus as half the step will leave it, and the way that the lead current takes, if any.
        let (legs, bus, conducts) = if before == 0.0 {
            let bus = self.bus_after(state, self.drawn_by_short(&legs_for(1.0), state), half);
            let starts = |sign: &f64| drive(&legs_for(*sign), bus) * sign > 0.0;
            let sign = [1.0, -1.0].into_iter().find(starts).unwrap_or(0.0);
            (legs_for(sign), bus, sign != 0.0 && self.leads != Leads::Open)
        } else {
            let legs = legs_for(before);
            let drawn = (legs[U].top - legs[V].top) * before + self.drawn_by_short(&legs, state);
            (legs, self.bus_after(state, drawn, half), true)
        };

        let mut taken = limit;
        let mut after = 0.0;
        let mut charge = 0.0;
        if conducts {
            let loop_resistance = resistance + legs[U].resistance + legs[V].resistance;
            let voltage = drive(&legs, bus);
            let current = Exponential::new(before, voltage, loop_resistance, inductance);
            let mut share = current.share(taken);
            after = current.at(share);
            let ends = [U, V].iter().any(|leg| self.is_diode_of_lead(*leg));
            if ends && after * before < 0.0 {
                taken = current.zero().min(limit);
                share = current.share(taken);
                after = 0.0;
            }
            let square;
            [charge, square] = current.integrals(taken, share);
            let drops = -(legs[U].offset - legs[V].offset) * charge;
            state.energy.heat += loop_resistance * square + drops;
            state.energy.drawn += (legs[U].top - legs[V].top) * bus * charge;
        }
        state.volt_seconds += emf * taken + resistance * charge + inductance * (after - before);

        let started = self.shunt_currents(&legs, state);
        state.bus_voltage = {
            let lead = (legs[U].top - legs[V].top) * charge / taken;
            let drawn = if taken > 0.0 { lead + self.drawn_by_short(&legs, state) } else { 0.0 };
            self.bus_after(state, drawn, taken)
        };
        self.step_short(&legs, bus, state, after, taken);
        state.lead_current = after;
        let ended = self.shunt_currents(&legs, state);
        for leg in [U, V] {
            state.sensed[leg] = settle(state.sensed[leg], started[leg], ended[leg], taken);
        }

        let turned = match self.leads {
            Leads::Motor => {
                state.motion.current = self.polarity * after;
                self.polarity * charge
            }
            Leads::Open => 0.0,
            Leads::Shorted => {
                let voltage = -motor.back_emf_constant * speed;
                let start = state.motion.current;
                let own = Exponential::new(start, voltage, motor.resistance, motor.inductance);
                let share = own.share(taken);
                state.motion.current = own.at(share);
                own.integrals(taken, share)[0]
            }
        };
        state.energy.rotor += motor.back_emf_constant * speed * turned;
        if !self.is_blocked && taken > 0.0 {
            let mean = Motion { speed, current: turned / taken };
            let gain = taken * self.plant.acceleration(mean, torque);
            state.angle += taken * (state.motion.speed + 0.5 * gain);
            state.motion.speed += gain;
        }
        taken
    }

    /// Whether a leg conducts by a diode that the lead current alone goes through.
    fn is_diode_of_lead(&self, leg: usize) -> bool {
        let is_shorted = self.short.is_some_and(|(shorted, _)| shorted == leg);
        self.switches[leg] == Switches::Open && !is_shorted
    }

    /// Currents through the shunts of U and V, from the leg to ground (A).
    fn shunt_currents(&self, legs: &[Leg; 2], state: &State) -> [f64; 2] {
        let currents = self.leg_currents(state);
        [U, V].map(|leg| if legs[leg].through_shunt { -currents[leg] } else { 0.0 })
    }

    /// Currents out of the legs U and V (A).
    pub fn leg_currents(&self, state: &State) -> [f64; 2] {
        let mut currents = OUTWARD.map(|sign| sign * state.lead_current);
        if let Some((leg, _)) = self.short {
            currents[leg] += state.short_current;
        }
        currents
    }

    /// What a leg's short circuit draws from the bus (A).
    fn drawn_by_short(&self, legs: &[Leg; 2], state: &State) -> f64 {
        let Some((leg, rail)) = self.short else { return 0.0 };
        let end = f64::from(u8::from(rail == Rail::Supply));
        (legs[leg].top - end) * state.short_current
    }

    /// The current of a leg's short circuit over a step, the lead current being `lead` after it.
    fn step_short(&self, legs: &[Leg; 2], bus: f64, state: &mut State, lead: f64, time: f64) {
        let Some((shorted, rail)) = self.short else { return };
        let outward = OUTWARD[shorted];
        let before = outward * state.lead_current + state.short_current;
        let is_open = self.switches[shorted] == Switches::Open;
        if is_open && before == 0.0 {
            state.short_current = -outward * lead;
            return;
        }
        let Leg { top, offset, resistance, .. } = legs[shorted];
        let end = f64::from(u8::from(rail == Rail::Supply));
        // Its own part of the leg's drop is in the leg's offset: here it belongs to the branch.
        let offset = offset + resistance * state.short_current;
        let voltage = (top - end) * bus + offset - resistance * outward * state.lead_current;
        let total = resistance + SHORT_RESISTANCE;
        let branch = Exponential::new(state.short_current, voltage, total, SHORT_INDUCTANCE);
        state.short_current = branch.at(branch.share(time));
        let after = outward * lead + state.short_current;
        if is_open && after * before < 0.0 {
            state.short_current = -outward * lead;
        }
    }
}

/// An amplifier after a time in which its input went from `start` to `end` along a line.
fn settle(shown: f64, start: f64, end: f64, time: f64) -> f64 {
    if time <= 0.0 {
        return shown;
    }
    let lag = (end - start) / time * SETTLING;
    end - lag + (shown - start + lag) * (-time / SETTLING).exp()
}
