//! The launch: a current that grows, from rest. It shows the direction, that the encoder counts, and how fast the motor is.

use super::current::Armature;
use super::extremes::Extremes;
use super::{
    Commission, LOW_MOST, Phase, Reason, SETTLE, SIGNAL, TURN_TRAVEL, TURN_VOLTAGE, WINDOW_COUNTS,
    WINDOWS, Wanted,
};
use crate::math::sqrt;

/// Time in which the launch's current grows to the higher level, and its longest time (s).
const RAMP: f32 = 0.4;
pub(super) const LAUNCH: f32 = 1.5;

/// A ramp to turning speed must take this many times what it takes to see it and to turn.
const QUICK: f32 = 2.5;

/// Periods that a current takes to turn.
const TURN: f32 = 20.0;

/// A back-EMF (as a share of the highest voltage) after this time (s) without counts is a missing encoder.
const BLIND: (f32, f32) = (0.15, 0.02);

impl Commission {
    pub(super) fn launch(&mut self, highest: f32) -> Wanted {
        let time = self.elapsed as f32 * self.period - SETTLE;
        if time <= 0.0 {
            self.start = self.angle;
            self.late_angle = self.angle;
            return Wanted::Voltage(0.0);
        }
        let moved = (self.angle - self.start).abs();
        let is_moving = moved > self.moved();
        let is_fast = self.speed.abs() >= self.turn_speed
            || self.control.voltage >= TURN_VOLTAGE * highest
            || 2.0 * moved + self.start.abs() >= TURN_TRAVEL * self.travel;
        let back_emf = self.control.voltage - self.control.armature.voltage(self.current);
        if !is_moving && time > BLIND.1 && back_emf > BLIND.0 * highest {
            self.stop(Reason::EncoderMissing);
        } else if (is_fast && is_moving) || time > LAUNCH {
            let is_turning = is_moving && self.speed.abs() * time > 0.5 * moved;
            if is_turning {
                self.launched(time, highest);
            } else {
                self.fits.unseen = Some(Reason::Blocked);
            }
            if self.phase == Phase::Launch {
                self.turn();
                self.enter(Phase::Trial);
            }
        }
        Wanted::Current((time / RAMP).lesser(1.0) * self.high)
    }

    /// Direction, and from how fast the shaft got how long it takes to turning speed at the higher level; a lower one where that is
    /// too short to turn in time.
    fn launched(&mut self, time: f32, highest: f32) {
        if self.angle < self.start {
            self.turn_sign = -1.0;
            self.angle = -self.angle;
            self.start = -self.start;
            self.late_angle = -self.late_angle;
            self.speed = -self.speed;
            self.last.turned = -self.last.turned;
        }
        self.watch.direct(self.turn_sign);
        self.fits.direction = Some(self.turn_sign);
        // As fast as the voltage allows at the higher level.
        let back_emf = self.control.voltage - self.control.armature.voltage(self.current);
        let room = (TURN_VOLTAGE * highest - self.control.armature.voltage(self.high)) / back_emf;
        let reached = self.speed.lesser(self.turn_speed);
        let speed = if room > 0.0 { reached.lesser(room * self.speed) } else { reached };
        let acceleration = self.acceleration(time);
        // Not the other way round: a NaN is nothing seen.
        let is_seen = acceleration > 0.0;
        if !is_seen {
            self.stop(Reason::TooQuick);
            return;
        }
        let least = QUICK * (self.averaged + self.window_periods + TURN);
        let by_speed = speed / acceleration * self.rate;
        let by_travel = sqrt(TURN_TRAVEL * self.travel / acceleration) * self.rate;
        let slowed = by_travel / least;
        let share = (by_speed / least).lesser(slowed * slowed).lesser(1.0);
        let Armature { resistance, inductive, lost, .. } = self.control.armature;
        self.most = share * self.high;
        self.tune(resistance, lost, inductive, LOW_MOST, highest);
        self.ramp = by_speed.lesser(by_travel) / share;
        let near = speed * (WINDOWS * self.window_periods / self.ramp).lesser(1.0);
        let resolved = 0.5 * WINDOW_COUNTS * self.grain * self.rate / self.averaged;
        self.turn_speed = near.greater(resolved).lesser(speed);
        self.fits.turn_speed = speed;
        let is_seen = self.high >= 0.25 * SIGNAL * self.noise;
        if !is_seen {
            self.stop(Reason::TooQuick);
        }
    }

    /// At the higher level (rad/s²), from a launch of this time (s). Where friction holds the shaft until some time, and the current goes on
    /// to grow, the angle is a·τ³/6 and the speed a·τ²/2 after it: together they tell a without that time. Friction helps to turn.
    fn acceleration(&self, time: f32) -> f32 {
        let [speed, angle] = [self.speed, self.late_angle - self.start];
        if time < RAMP {
            RAMP * 2.0 * speed * speed * speed / (9.0 * angle * angle)
        } else {
            speed * speed / (2.0 * angle)
        }
    }
}
