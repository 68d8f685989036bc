//! Short pulses of voltage that grow until a current flows: what they show is enough to control currents by.
//!
//! A voltage that grows by the same share each period is safe with any armature: the current grows by no larger share, but for the
//! first of it, where the bridge's and the brushes' losses end. So it is known, whatever R and L, how far it goes on after it was seen to be enough.
//! What is enough grows from pulse to pulse, as long as the shaft does not turn too much.
//! Rise, hold and fall differ in how much of the voltage goes into R, L and the losses, which separates them.

use super::extremes::Extremes;
use super::fit::Fit;
use super::window::{Period, Window};

/// Pulses of the last size, of both signs in turn.
const PULSES: u32 = 6;

/// The first voltage, as a share of the highest.
const FIRST: f32 = 0.002;

/// What the voltage grows by in a period. The current comes 2 periods later, and with losses of ten times R·i grows ten times as
/// much: to less than twice.
const GROWTH: f32 = 1.03;

/// The same in the first pulse, where nothing is known yet: slow enough for the shaft, if it is free, or for noise that is missing to show
/// a sensor that is dead. An inductance takes a third of the voltage then.
const PROBE: f32 = 1.01;
const PROBED: f32 = 3.0;

/// Voltage that the same share of current takes at most, over that of the pulse before: a fifth for noise and a warmer winding.
const MORE: f32 = 1.2;

/// What it falls by.
const FALL: f32 = 0.9;

/// Periods that the voltage is held: a current that is only limited by inductance grows by 0.6.
const HOLD: u32 = 20;

/// Most periods at the highest voltage, and of a fall.
const LONGEST: u32 = 400;

/// Most periods of a rise whatever the bus does, and at the highest voltage without a current.
const RISE: u32 = 1100;
const OPEN: u32 = 100;

/// Periods without voltage after a pulse.
const PAUSE: u32 = 100;

/// Share of a pulse's current from which it counts.
const COUNTS_FROM: f32 = 0.25;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Stage {
    Rise,
    Hold,
    Fall,
    Pause,
}

/// What a step of the pulses comes to.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Pulsed {
    /// The voltage that is to act next (V).
    Voltage(f32),
    /// No current flows at the highest voltage.
    NoCurrent,
    /// The current is less than the pulse before says.
    LessCurrent,
    /// All are done.
    Done,
}

/// The pulses.
#[derive(Clone, Debug)]
pub(super) struct Pulses {
    stage: Stage,
    /// Periods in this stage, and at the highest voltage.
    periods: u32,
    at_highest: u32,
    /// Voltage over current of the last pulse (Ω), at most; zero before the first.
    ratio: f32,
    done: u32,
    sign: f32,
    magnitude: f32,
    /// Current at which the voltage stops growing (A), now and at most.
    enough: f32,
    most: f32,
    /// Whether this pulse turned the shaft too much for a larger one.
    is_quick: bool,
    window: Window,
    /// Current times periods since the first pulse (A).
    charge: f32,
    /// For R, V0, h·Kb²/J and Λ.
    pub fit: Fit,
    /// Whether the current was seen to flow against the voltage.
    pub is_reversed: bool,
}

impl Pulses {
    /// Pulses up to a current (A).
    pub(super) fn new(most: f32) -> Self {
        Self {
            stage: Stage::Rise,
            periods: 0,
            at_highest: 0,
            ratio: 0.0,
            done: 0,
            sign: 1.0,
            magnitude: 0.0,
            enough: 0.0,
            most,
            is_quick: false,
            window: Window::default(),
            charge: 0.0,
            fit: Fit::default(),
            is_reversed: false,
        }
    }

    /// A period, and the current since (A). Less than `least` is taken for none. `is_quick` tells whether the shaft turns too much for
    /// a larger pulse.
    pub(super) fn step(
        &mut self,
        period: &Period,
        now: f32,
        highest: f32,
        least: f32,
        is_quick: bool,
    ) -> Pulsed {
        let current = now.abs();
        self.enough = self.enough.greater(least);
        self.is_quick |= is_quick;
        // A shaft that is free turns as much, and an encoder's few counts would be too coarse.
        self.charge += 0.5 * (period.currents[0] + period.currents[1]);
        let counts = self.sign * period.currents[0] >= COUNTS_FROM * self.enough;
        if counts && self.stage != Stage::Pause {
            self.window.add(&Period { turned: self.charge, ..*period }, self.sign);
        }
        self.periods += 1;
        match self.stage {
            Stage::Rise => {
                let growth = if self.ratio > 0.0 { GROWTH } else { PROBE };
                self.magnitude = (self.magnitude * growth).greater(FIRST * highest).lesser(highest);
                self.at_highest += u32::from(self.magnitude >= highest);
                let is_long = self.at_highest > LONGEST || self.periods > RISE;
                if current < least && (is_long || self.at_highest > OPEN) {
                    return Pulsed::NoCurrent;
                }
                if is_long {
                    // As much as the voltage makes.
                    self.enough = current;
                    self.most = current;
                }
                if current >= self.enough {
                    self.is_reversed = self.sign * now < 0.0;
                    let slowly = if self.ratio > 0.0 { 1.0 } else { PROBED };
                    self.ratio = slowly * self.magnitude / self.enough;
                    self.enter(Stage::Hold);
                } else if self.ratio > 0.0 && self.magnitude > MORE * self.ratio * self.enough {
                    return Pulsed::LessCurrent;
                }
            }
            Stage::Hold => {
                if self.periods >= HOLD {
                    self.enter(Stage::Fall);
                }
            }
            Stage::Fall => {
                self.magnitude *= FALL;
                if current < COUNTS_FROM * self.enough || self.periods > LONGEST {
                    self.enter(Stage::Pause);
                    self.magnitude = 0.0;
                }
            }
            Stage::Pause => {
                if self.periods >= PAUSE {
                    self.done += 1;
                    self.sign = -self.sign;
                    self.enter(Stage::Rise);
                    if !core::mem::take(&mut self.is_quick) && self.enough < self.most {
                        self.enough = (2.0 * self.enough).lesser(self.most);
                        self.fit = Fit::default();
                        self.done = 0;
                    }
                }
            }
        }
        if self.done < PULSES { Pulsed::Voltage(self.sign * self.magnitude) } else { Pulsed::Done }
    }

    /// Periods of the first pulse, until its current is seen.
    pub(super) fn probing(&self) -> Option<u32> {
        (self.ratio == 0.0).then_some(self.periods)
    }

    /// Share of them that is done.
    pub(super) fn share(&self) -> f32 {
        self.done as f32 / PULSES as f32
    }

    fn enter(&mut self, stage: Stage) {
        let least = 0.5 * COUNTS_FROM * self.enough;
        let row = self.window.armature(least, self.sign, 1.0);
        if let Some((x, y)) = row {
            self.fit.add(x, y);
        }
        self.window = Window::default();
        self.stage = stage;
        self.periods = 0;
        self.at_highest = 0;
    }
}
