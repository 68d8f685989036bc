//! Whether voltage, current and speed agree: a sensor that dies, and a lead that opens, is seen by what it contradicts.
//!
//! What the armature leaves of the voltage is the back-EMF,
//!
//! ```text
//! e = u − R·i − V0·sign(i) − Λ·Δi = Kb·ω
//! ```
//!
//! A current that is wrong by δ makes it wrong by R·δ + Λ·Δδ, so that e − Kb·ω tells how far the true current can be from the one that the sensor
//! shows; an encoder that stands still leaves all of it. Kb is learnt along the way.

use super::current::Armature;
use super::window::Period;

/// Wrong current, over the limit, that is a contradiction where it stays, and where it comes in a period. Rough as R, Λ and V0 are after the
/// pulses, 1800 healthy motors came to 0.5 and 0.2.
const STAYS: f32 = 0.6;
const STAYS_KNOWN: f32 = 0.2;
const ROUGH: f32 = 0.2;
const JUMPS: f32 = 0.15;

/// Back-EMF that is a contradiction whatever the resistance, over the highest voltage.
const HIDDEN: f32 = 0.3;

/// Periods that Kb is averaged over.
const LEARNS: f32 = 4096.0;

/// Periods at one count in the time averaged that show half of it.
const KNOWN: f32 = 32.0;

/// Share that is kept of it where the armature is known better.
const KEPT: f32 = 0.1;

/// Watches over the sensors.
#[derive(Clone, Debug)]
pub(super) struct Watch {
    /// Current limit (A).
    limit: f32,
    /// A count in the time averaged (rad/s).
    count: f32,
    /// Averages over a period's share of it.
    share: f32,
    /// e and ω, averaged alike.
    back_emf: f32,
    speed: f32,
    /// Sums of e·ω and ω².
    product: f32,
    square: f32,
    /// Whether the encoder's sign is known.
    is_directed: bool,
    pub within: bool,
    pub debug: [f32; 2],
}

impl Watch {
    pub(super) fn new(limit: f32, count: f32, averaged: f32) -> Self {
        Self {
            limit,
            count,
            share: 1.0 / averaged,
            back_emf: 0.0,
            speed: 0.0,
            product: 0.0,
            // Until it turns faster than that.
            square: KNOWN * count * count,
            is_directed: false,
            within: false,
            debug: [0.0; 2],
        }
    }

    /// The armature is known better: what it made of Kb until now counts little.
    pub(super) fn relearn(&mut self) {
        self.back_emf = self.constant() * self.speed;
        self.product *= KEPT;
        self.square *= KEPT;
    }

    fn constant(&self) -> f32 {
        if self.square > 0.0 { self.product / self.square } else { 0.0 }
    }

    /// The encoder's sign (±1) was found.
    pub(super) fn direct(&mut self, sign: f32) {
        self.speed *= sign;
        self.product = (sign * self.product).max(0.0);
        self.is_directed = true;
    }

    /// Takes a period, the speed in it (rad/s), and the highest voltage (V). Tells what is contradicted, if anything is.
    pub(super) fn step(
        &mut self,
        period: &Period,
        speed: f32,
        armature: &Armature,
        highest: f32,
    ) -> Agrees {
        let [start, end] = period.currents;
        let change = armature.inductive * (end - start);
        let left = period.voltage - armature.voltage(start) - change;
        self.back_emf += self.share * (left - self.back_emf);
        self.speed += self.share * (speed - self.speed);
        let constant = self.constant();
        let expected = constant * self.speed;
        let count = constant.abs() * self.count;
        let rough = armature.resistance + ROUGH * self.share * armature.inductive;
        let stays = (if self.within { STAYS_KNOWN } else { STAYS } * rough * self.limit).min(HIDDEN * highest);
        let jumps = stays + JUMPS * armature.inductive * self.limit;
        let off = (self.back_emf - expected).abs() - count;
        if (left - expected).abs() > jumps {
            Agrees::NoCurrent
        } else if off > stays {
            // No shaft stops or turns back within a period.
            let is_silent = speed * self.speed <= 0.0 || expected.abs() <= count;
            if is_silent { Agrees::NoCounts } else { Agrees::NoCurrent }
        } else {
            if self.speed.abs() > self.count {
                let kept = 1.0 - 1.0 / LEARNS;
                self.product = kept * self.product + self.back_emf * self.speed;
                self.square = kept * self.square + self.speed * self.speed;
                if self.is_directed {
                    self.product = self.product.max(0.0);
                }
            }
            Agrees::Yes
        }
    }
}

/// Whether it does.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Agrees {
    Yes,
    /// The current is not what the voltage makes.
    NoCurrent,
    /// The speed is not what the back-EMF tells.
    NoCounts,
}
