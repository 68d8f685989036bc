//! To and fro: currents of two levels and both signs in windows, and what each phase of them comes to.

use super::extremes::Extremes;
use super::fit::Solution;
use super::window::Period;
use super::{Commission, LOW, Phase, Reason, TURN_TRAVEL, TURN_VOLTAGE, WINDOW, WINDOWS, Wanted};

/// Share of R that it may change by from the short to the long windows: a winding that warms up by 40 °C.
const STEADY: f32 = 0.15;

/// Time of the trial, of the short windows, and longest and least of the long ones (s).
pub(super) const TRIAL: f32 = 0.3;
pub(super) const SHORT: f32 = 1.2;
const LONG: f32 = 10.0;
const LONG_LEAST: f32 = 3.0;

/// Ramps to turning speed in the long windows.
const RAMPS: f32 = 50.0;

/// Share of the turning speed from which the shaft does not turn back within two windows.
const ONWARD: f32 = 0.15;

/// Change of speed from window to window over what the launch showed, and counts besides, that no shaft makes. Healthy motors come to half of
/// it: friction helps to turn.
const LIVELY: f32 = 3.0;
const COUNTS: f32 = 2.5;

/// Windows after which a current turns whose shaft is blocked.
const BLOCKED_WINDOWS: u32 = 16;

impl Commission {
    /// The current the other way.
    pub(super) fn turn(&mut self) {
        self.sign = -self.sign;
        self.back = self.sign * self.angle;
        self.windows = 0;
    }

    pub(super) fn swing(&mut self, period: &Period, highest: f32) -> Wanted {
        self.window.add(period, self.sign);
        match self.closing {
            Closing::Not if self.window.periods < self.window_periods => {}
            Closing::Not => self.end_window(highest),
            Closing::Pulled => self.closing = Closing::Armature(self.armature.solve([0.0; 4])),
            Closing::Armature(pulled) => self.closing = Closing::Solved(self.solved(&pulled)),
            Closing::Solved(solved) => {
                self.closing = Closing::Not;
                match self.phase {
                    Phase::Trial => self.end_trial(&solved, highest),
                    Phase::Short => self.end_short(solved),
                    _ => self.end_long(solved),
                }
            }
            Closing::Shaft => {
                self.fits.shaft = Some(self.shaft.solve([0.0; 4]));
                self.closing = Closing::Not;
            }
        }
        // All was seen. It swings on to where the shaft turns back, from where it does not coast far.
        let is_slowing = self.sign * self.speed < 0.0;
        let turns_back = core::mem::replace(&mut self.is_slowing, is_slowing) && !is_slowing;
        let is_late = self.elapsed as f32 * self.period >= LONG;
        if self.fits.shaft.is_some() && (turns_back || is_late) {
            self.phase = Phase::Over;
        }
        // Two windows at each level: one has the step in it, the other has not.
        let level = if self.windows & 2 == 0 { self.high } else { self.low };
        if self.phase == Phase::Over { Wanted::Off } else { Wanted::Current(self.sign * level) }
    }

    fn end_window(&mut self, highest: f32) {
        let row = self.window.armature(self.least, self.sign, self.period);
        if let Some((x, y)) = row {
            self.armature.add(x, y);
        }
        // Friction changes its sign where the shaft turns back. It is told by the speed, whose noise is not that of the row.
        let [start, middle] = self.speeds;
        self.speeds = [middle, self.speed];
        let direction = if self.speed > 0.0 { 1.0 } else { -1.0 };
        let least = (direction * start).lesser(direction * self.speed);
        if least > ONWARD * self.turn_speed {
            let row = self.window.shaft(&self.before, direction, self.period);
            if let Some((x, y)) = row {
                self.shaft.add(x, y);
            }
        }
        if self.jumps() {
            self.stop(Reason::EncoderLost);
            return;
        }
        self.before = core::mem::take(&mut self.window);
        self.windows += 1;
        self.all_windows += 1;
        let is_far = self.sign * self.speed >= self.turn_speed
            || self.sign * self.control.voltage >= TURN_VOLTAGE * highest
            || 2.0 * self.sign * self.angle - self.back >= TURN_TRAVEL * self.travel
            || (self.is_blocked() && self.windows >= BLOCKED_WINDOWS);
        if is_far {
            self.turn();
        }
        let time = self.elapsed as f32 * self.period;
        let is_over = match self.phase {
            Phase::Trial => time >= TRIAL,
            Phase::Short => time >= SHORT,
            _ => time >= self.long_time(),
        };
        if is_over && self.fits.shaft.is_none() {
            self.closing = Closing::Pulled;
        }
    }

    /// Whether the shaft turned more or less than in the window before by more than a motor can make.
    fn jumps(&self) -> bool {
        let periods = self.window.periods;
        let acceleration = self.fits.turn_speed / self.ramp;
        let most = LIVELY * acceleration * periods * periods * self.period + COUNTS * self.grain;
        let gained = (self.window.turned() - self.before.turned()).abs();
        self.before.periods == periods && !self.is_blocked() && gained > most
    }

    pub(super) fn is_blocked(&self) -> bool {
        self.fits.unseen == Some(Reason::Blocked)
    }

    pub(super) fn long_time(&self) -> f32 {
        (RAMPS * self.ramp * self.period).clamp(LONG_LEAST, 0.95 * LONG)
    }

    fn end_trial(&mut self, solved: &Solution, highest: f32) {
        let &Solution { values, deviations } = solved;
        let [resistance, lost, _, inductive] = values;
        if deviations[0] < 0.2 * resistance
            && deviations[3] < 0.2 * inductive
            && inductive > resistance
        {
            self.tune(resistance, lost, inductive, LOW, highest);
            self.watch.relearn(true);
        }
        self.enter(Phase::Short);
    }

    fn end_short(&mut self, solved: Solution) {
        self.fits.short = Some(solved);
        if self.is_blocked() {
            self.phase = Phase::Over;
            return;
        }
        self.window_periods = (self.ramp / WINDOWS)
            .greater(self.window_periods)
            .greater(self.averaged)
            .lesser(WINDOW.1);
        self.turn_speed = self.fits.turn_speed;
        self.enter(Phase::Long);
    }

    /// What the short windows showed must still be so.
    fn end_long(&mut self, solved: Solution) {
        let resistance = solved.values[0];
        let agrees = |short: &Solution| {
            let uncertain = 3.0 * (solved.deviations[0] + short.deviations[0]);
            (resistance - short.values[0]).abs() <= STEADY * resistance.abs() + uncertain
        };
        if self.fits.within_ripple || self.fits.short.as_ref().is_some_and(agrees) {
            self.fits.long = Some(solved);
            self.closing = Closing::Shaft;
        } else {
            self.stop(Reason::Unsteady);
        }
    }

    /// The armature. Noise in current and angle pulls their unknowns; how much, its variance tells at most: half of it is taken back, and
    /// the other half is uncertain.
    fn solved(&self, pulled: &Solution) -> Solution {
        let per = 1.0 / self.window_periods;
        let speed = self.grain * self.rate * per;
        let current = self.noise * per;
        let noise = [0.0, 0.0, speed * speed / 6.0, 2.0 * current * current];
        let mut solution = self.armature.solve(noise);
        for (unknown, pulled) in pulled.values.iter().enumerate() {
            let pull = 0.5 * (solution.values[unknown] - pulled);
            solution.values[unknown] -= pull;
            solution.deviations[unknown] += 0.5 * pull.abs();
        }
        solution
    }
}

/// What is to be solved next in a phase whose time is over: one solution a period and nothing else, for a microcontroller to have time.
#[derive(Clone, Copy, Debug)]
pub(super) enum Closing {
    /// Its time is not over.
    Not,
    /// The armature, noise left in.
    Pulled,
    /// The armature, with that.
    Armature(Solution),
    /// Nothing: this is what the phase came to.
    Solved(Solution),
    Shaft,
}
