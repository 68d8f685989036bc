//! Whether voltage, current and speed agree: a sensor that dies, and a lead that opens, is seen by what it contradicts.
//!
//! What the armature leaves of the voltage is the back-EMF,
//!
//! ```text
//! e = u − R·i − V0·sign(i) − Λ·Δi = Kb·ω
//! ```
//!
//! A current that is wrong by δ makes e wrong by R·δ + Λ·Δδ: so e − Kb·ω tells how far the true current is from the one that the sensor
//! shows. An encoder that stands still leaves all of e. Kb is learnt along the way. And the current follows its reference, if its sensor works.
//!
//! Healthy motors came to half of each of the limits below: 2000 random ones, and 600 with tight limits of speed or travel.

use super::current::{Armature, CurrentLoop};
use super::extremes::Extremes;
use super::findings::Reason;
use super::window::Period;

/// Wrong current, over the current limit, that is a contradiction: with an armature that is known from the pulses alone, and from windows.
const ROUGH: f32 = 0.7;
const KNOWN: f32 = 0.2;

/// The same for one that comes within a period, besides.
const JUMP: f32 = 0.15;

/// Share of Λ, over the periods averaged, that may be wrong by as much as R.
const INDUCTIVE: f32 = 0.2;

/// Back-EMF that is a contradiction whatever the resistance, over the highest voltage.
const HIDDEN: f32 = 0.3;

/// Periods that the current's error is averaged over.
const FOLLOWED: f32 = 32.0;

/// Periods that Kb is averaged over, and those at one count in the time averaged that show half of it.
const LEARNT: f32 = 4096.0;
const FIRST: f32 = 32.0;

/// Share that is kept of what was learnt from an armature that is known better now.
const KEPT: f32 = 0.1;

/// Watches over the sensors.
#[derive(Clone, Debug)]
pub(super) struct Watch {
    /// Current limit (A).
    limit: f32,
    /// Speed of a count in the time averaged (rad/s).
    count: f32,
    /// One over the periods averaged.
    share: f32,
    /// Wrong current that is a contradiction, over the limit.
    wrong: f32,
    /// Whether the encoder's sign is known.
    is_directed: bool,
    /// e (V) and ω (rad/s), averaged alike.
    back_emf: f32,
    speed: f32,
    /// Sums of e·ω and ω²: their quotient is Kb.
    product: f32,
    square: f32,
    /// The current's error, averaged (A).
    error: f32,
}

impl Watch {
    /// For a current limit (A), and a count (rad/s) in the periods that speeds are averaged over.
    pub(super) fn new(limit: f32, count: f32, averaged: f32) -> Self {
        Self {
            limit,
            count,
            share: 1.0 / averaged,
            wrong: ROUGH,
            is_directed: false,
            back_emf: 0.0,
            speed: 0.0,
            product: 0.0,
            square: FIRST * count * count,
            error: 0.0,
        }
    }

    /// The armature is known better, from windows if it is `certain`: what it made of e counts little.
    pub(super) fn relearn(&mut self, certain: bool) {
        if certain {
            self.wrong = KNOWN;
        }
        self.back_emf = self.constant() * self.speed;
        self.product *= KEPT;
        self.square *= KEPT;
    }

    /// The encoder's sign (±1) was found.
    pub(super) fn direct(&mut self, sign: f32) {
        self.is_directed = true;
        self.speed *= sign;
        self.product = (sign * self.product).greater(0.0);
    }

    /// Kb, as far as it is known (V·s/rad).
    fn constant(&self) -> f32 {
        if self.square > 0.0 { self.product / self.square } else { 0.0 }
    }

    /// Takes a period, the speed in it (rad/s), the control of the current and how far it may be off (A), and the highest voltage (V).
    pub(super) fn step(
        &mut self,
        period: &Period,
        speed: f32,
        control: &CurrentLoop,
        off: f32,
        highest: f32,
    ) -> Result<(), Reason> {
        let Armature { resistance, inductive, .. } = control.armature;
        let [start, end] = period.currents;
        let left = period.voltage - control.armature.voltage(start) - inductive * (end - start);
        self.back_emf += self.share * (left - self.back_emf);
        self.speed += self.share * (speed - self.speed);
        self.error += (control.error() - self.error) / FOLLOWED;
        let constant = self.constant();
        let expected = constant * self.speed;
        let count = constant.abs() * self.count;
        let impedance = resistance + INDUCTIVE * self.share * inductive;
        let most = (self.wrong * self.limit * impedance).lesser(HIDDEN * highest);
        if (left - expected).abs() > most + JUMP * self.limit * inductive || self.error.abs() > off
        {
            Err(Reason::CurrentLost)
        } else if (self.back_emf - expected).abs() > most + count {
            // No shaft stops or turns back within a period.
            let is_silent = speed * self.speed <= 0.0 || expected.abs() <= count;
            Err(if is_silent { Reason::EncoderLost } else { Reason::CurrentLost })
        } else {
            self.learn();
            Ok(())
        }
    }

    fn learn(&mut self) {
        if self.speed.abs() > self.count {
            let kept = 1.0 - 1.0 / LEARNT;
            self.square = kept * self.square + self.speed * self.speed;
            self.product = kept * self.product + self.back_emf * self.speed;
            // A motor's Kb is positive: else an encoder that turns round would be learnt.
            if self.is_directed {
                self.product = self.product.greater(0.0);
            }
        }
    }
}
