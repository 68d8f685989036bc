//! Motor, bridge and bus between two changes of the switches.
//!
//! Over a step the voltages that drive the lead current are held, its resistances are constant, and so it is an exponential, in closed
//! form; so is the instant at which diodes end it. Speed and bus voltage are held at what they are in the middle of the step, predicted from
//! its start; the mechanics then take the current's exact mean. That is of second order, and exact where nothing but the current
//! changes. What errs is the back-EMF: by h²/8 of its second derivative, less than 0.2 mV with the paper's motor in a step of 10 µs.

use super::circuit::{
    BUS_CAPACITANCE, Circuit, LEGS, Leads, OUTWARD, SHORT_INDUCTANCE, SHORT_RESISTANCE, Sources,
    State,
};
use super::drivers::Switches;
use crate::plant::State as Motion;

/// Time constant of the amplifiers that look at the shunts (s): 13 MHz of gain times bandwidth at a gain of 16.
pub const SETTLING: f64 = 0.2e-6;

/// A current under a constant voltage: x(t) = end + (start − end)·e^(−rate·t).
#[derive(Clone, Copy, Debug)]
struct Exponential {
    start: f64,
    end: f64,
    rate: f64,
}

impl Exponential {
    /// From a current (A) on, by a voltage (V) through a resistance (Ω) and an inductance (H).
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

    /// When it is zero, on its way to an end of the other sign.
    fn zero(&self) -> f64 {
        -(self.start / (self.end - self.start)).ln_1p() / self.rate
    }

    /// ∫x dt over a time.
    fn integral(&self, time: f64, share: f64) -> f64 {
        self.end * time + (self.start - self.end) * share / self.rate
    }

    /// ∫x² dt over a time: that of (end + fading)².
    fn square_integral(&self, time: f64, share: f64) -> f64 {
        let fading = self.start - self.end;
        let first = fading * share / self.rate;
        let second = fading * fading * share * (2.0 - share) / (2.0 * self.rate);
        self.end * (self.end * time + 2.0 * first) + second
    }
}

/// What is held over a step.
struct Held {
    /// Load torque (N·m).
    torque: f64,
    speed: f64,
    /// What is between the leads.
    inductance: f64,
    resistance: f64,
    back_emf: f64,
    bus: f64,
    sources: Sources,
    /// Whether the lead current flows at all.
    conducts: bool,
}

impl Held {
    /// What drives the lead current (V).
    fn drive(&self, sources: &Sources) -> f64 {
        sources.top() * self.bus + sources.offset() - self.back_emf
    }
}

/// What the lead current does in a step: its duration (s), the current after it (A), the charge in it (C).
struct Flow {
    time: f64,
    current: f64,
    charge: f64,
}

impl Circuit {
    /// Integrates up to a time, in steps of at most `longest`; the switches and all that is scheduled must not change before.
    pub fn advance(&self, state: &mut State, until: f64, longest: f64) {
        while state.time < until {
            let left = until - state.time;
            let aimed = left.min(longest);
            let taken = self.step(state, aimed);
            state.time = if taken == left { until } else { state.time + taken };
        }
    }

    /// The shaft's angle (rad) at a time within a step from the state, to the third power of the time in between: a motor whose
    /// current changes by 0.2 A/µs errs by 3e-8 rad after 10 µs, and an encoder is looked at too often for more.
    pub fn angle_at(&self, state: &State, time: f64) -> f64 {
        if self.is_blocked {
            return state.angle;
        }
        let passed = time - state.time;
        let acceleration = self.plant.acceleration(state.motion, self.load_at(state.time));
        state.angle + passed * (state.motion.speed + 0.5 * passed * acceleration)
    }

    /// One step of at most `limit` seconds; gives what it took. It ends where diodes end the lead current.
    fn step(&self, state: &mut State, limit: f64) -> f64 {
        let held = self.hold(state, limit);
        let shunts_before = self.shunt_currents(&held.sources, state);
        let flow = self.lead_flow(&held, state, limit);
        let drawn = held.sources.top() * flow.charge / flow.time;
        let drawn = drawn + self.drawn_by_short(&held.sources, state);
        state.bus_voltage = self.bus_after(state, drawn, flow.time);
        if self.short.is_some() {
            state.short_current = self.short_current_after(&held, state, &flow);
        }
        state.lead_current = flow.current;
        let shunts_after = self.shunt_currents(&held.sources, state);
        for leg in LEGS {
            let input = [shunts_before[leg], shunts_after[leg]];
            state.sensed[leg] = amplifier_after(state.sensed[leg], input, flow.time);
        }
        self.turn(&held, state, &flow);
        flow.time
    }

    /// Speed and bus as half the step will leave them, and the way that the lead current takes.
    fn hold(&self, state: &State, limit: f64) -> Held {
        let motor = self.plant.motor();
        let half = 0.5 * limit;
        let torque = self.load_at(state.time + half);
        let gain = half * self.plant.acceleration(state.motion, torque);
        let speed = if self.is_blocked { 0.0 } else { state.motion.speed + gain };
        let [inductance, resistance, back_emf] = match self.leads {
            Leads::Shorted => [SHORT_INDUCTANCE, SHORT_RESISTANCE, 0.0],
            Leads::Motor | Leads::Open => {
                let back_emf = self.polarity * motor.back_emf_constant * speed;
                [motor.inductance, motor.resistance, back_emf]
            }
        };
        let sources = self.sources(state.lead_current, state);
        let drawn = sources.top() * state.lead_current + self.drawn_by_short(&sources, state);
        let bus = self.bus_after(state, drawn, half);
        let conducts = state.lead_current != 0.0;
        let mut held =
            Held { torque, speed, inductance, resistance, back_emf, bus, sources, conducts };
        if !conducts && self.leads != Leads::Open {
            for sign in [1.0, -1.0] {
                let sources = self.sources(sign, state);
                if held.drive(&sources) * sign > 0.0 {
                    held.sources = sources;
                    held.conducts = true;
                    break;
                }
            }
        }
        held
    }

    /// The lead current over a step, with what goes with it: energy and the voltage between the leads.
    fn lead_flow(&self, held: &Held, state: &mut State, limit: f64) -> Flow {
        let Held { inductance, resistance, back_emf, .. } = *held;
        if !held.conducts {
            state.volt_seconds += back_emf * limit;
            return Flow { time: limit, current: 0.0, charge: 0.0 };
        }
        let start = state.lead_current;
        let whole = resistance + held.sources.resistance();
        let current = Exponential::new(start, held.drive(&held.sources), whole, inductance);
        let mut time = limit;
        let mut share = current.share(time);
        let mut end = current.at(share);
        if end * start < 0.0 && self.is_rectified() {
            time = current.zero().clamp(f64::MIN_POSITIVE, limit);
            share = current.share(time);
            end = 0.0;
        }
        let charge = current.integral(time, share);
        let square = current.square_integral(time, share);
        state.energy.drawn += held.sources.top() * held.bus * charge;
        state.energy.heat += whole * square - held.sources.offset() * charge;
        state.volt_seconds += back_emf * time + resistance * charge + inductance * (end - start);
        Flow { time, current: end, charge }
    }

    /// The bus voltage (V) after a time in which the bridge draws a current (A).
    fn bus_after(&self, state: &State, drawn: f64, time: f64) -> f64 {
        let supply = self.supply_at(state.time + time);
        if self.supply_resistance == 0.0 {
            return supply;
        }
        let end = supply - self.supply_resistance * drawn;
        let left = (-time / (self.supply_resistance * BUS_CAPACITANCE)).exp();
        end + (state.bus_voltage - end) * left
    }

    /// The current of a leg's short circuit after a step (A); the lead current that shares the leg's resistance is held.
    fn short_current_after(&self, held: &Held, state: &State, flow: &Flow) -> f64 {
        let Some(short) = self.short else { return 0.0 };
        let leg = short.leg as usize;
        let outward = OUTWARD[leg];
        let is_open = self.switches[leg] == Switches::Open;
        let before = self.leg_currents(state)[leg];
        // With the leg open and its diodes blocking, what the lead takes comes through the short circuit.
        let floating = -outward * flow.current;
        if is_open && before == 0.0 {
            return floating;
        }
        let source = &held.sources.0[leg];
        // The source's offset holds the short circuit's own drop in it: here that belongs to the branch.
        let offset = source.offset + source.resistance * state.short_current;
        let lead_drop = source.resistance * outward * state.lead_current;
        let voltage = (source.top - short.rail.top()) * held.bus + offset - lead_drop;
        let resistance = source.resistance + SHORT_RESISTANCE;
        let branch = Exponential::new(state.short_current, voltage, resistance, SHORT_INDUCTANCE);
        let current = branch.at(branch.share(flow.time));
        let after = outward * flow.current + current;
        if is_open && after * before < 0.0 { floating } else { current }
    }

    /// The armature's current and what it makes of the shaft.
    fn turn(&self, held: &Held, state: &mut State, flow: &Flow) {
        let motor = self.plant.motor();
        let charge = match self.leads {
            Leads::Motor => {
                state.motion.current = self.polarity * flow.current;
                self.polarity * flow.charge
            }
            Leads::Open => 0.0,
            Leads::Shorted => {
                let back_emf = motor.back_emf_constant * held.speed;
                let start = state.motion.current;
                let current =
                    Exponential::new(start, -back_emf, motor.resistance, motor.inductance);
                let share = current.share(flow.time);
                state.motion.current = current.at(share);
                current.integral(flow.time, share)
            }
        };
        state.energy.rotor += motor.back_emf_constant * held.speed * charge;
        if !self.is_blocked {
            let mean = Motion { speed: held.speed, current: charge / flow.time };
            let gain = flow.time * self.plant.acceleration(mean, held.torque);
            state.angle += flow.time * (state.motion.speed + 0.5 * gain);
            state.motion.speed += gain;
        }
    }
}

/// What an amplifier shows after a time in which its input went along a line.
fn amplifier_after(shown: f64, [start, end]: [f64; 2], time: f64) -> f64 {
    let lag = (end - start) / time * SETTLING;
    end - lag + (shown - start + lag) * (-time / SETTLING).exp()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn an_exponential_is_what_small_steps_make_of_it() {
        // 5 A driven by −8 V through 0.7 Ω and 0.1 mH.
        let current = Exponential::new(5.0, -8.0, 0.7, 1e-4);
        let duration = 120e-6;
        let steps = 100_000;
        let h = duration / f64::from(steps);
        let [mut x, mut first, mut second] = [5.0_f64, 0.0, 0.0];
        let mut zero = None;
        for step in 0..steps {
            // The midpoint rule.
            let middle = x + 0.5 * h * (-8.0 - 0.7 * x) / 1e-4;
            let next = x + h * (-8.0 - 0.7 * middle) / 1e-4;
            first += h * middle;
            second += h * middle * middle;
            if x > 0.0 && next <= 0.0 {
                zero = Some((f64::from(step) + x / (x - next)) * h);
            }
            x = next;
        }
        let share = current.share(duration);
        assert!((current.at(share) - x).abs() < 1e-6);
        assert!((current.integral(duration, share) - first).abs() < 1e-10);
        assert!((current.square_integral(duration, share) - second).abs() < 1e-9);
        assert!((current.zero() - zero.expect("it crosses")).abs() < 1e-12);
    }

    #[test]
    fn an_amplifier_lags_and_settles() {
        let step = amplifier_after(0.0, [1.0, 1.0], SETTLING);
        assert!((step - (1.0 - (-1.0_f64).exp())).abs() < 1e-15);
        assert!((amplifier_after(0.0, [1.0, 1.0], 1.3e-6) - 1.0).abs() < 2e-3);
        // Behind a ramp by its time constant.
        let ramp = amplifier_after(0.0, [0.0, 10.0], 50.0 * SETTLING);
        assert!((ramp - (10.0 - 10.0 / 50.0)).abs() < 1e-9);
        // Two halves make a whole.
        let halfway = amplifier_after(0.3, [1.0, 1.5], 0.1e-6);
        let whole = amplifier_after(0.3, [1.0, 2.0], 0.2e-6);
        assert!((amplifier_after(halfway, [1.5, 2.0], 0.1e-6) - whole).abs() < 1e-15);
    }
}
