//! One channel of an estimator: what a measured signal does beyond its model.

use crate::config::{ConfigError, require};
use crate::control::injection::{Injection, MAX_BETA};
use crate::math::{Base, Scalar, atanh};
use crate::schema::choice;

/// How a channel's differential equation is stepped at the PWM rate.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Form {
    /// The injection closed implicitly over the step, the model integrated by the trapezoidal rule. The channel by
    /// itself is stable at every rate.
    #[default]
    Implicit,
    /// Forward Euler throughout, as the continuous equations read when coded term by term. Chatters when h·k/ε is
    /// above about 2. Kept for comparison.
    Explicit,
}

choice! { Form { Implicit, Explicit } }

/// Where an estimator's memory starts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Start {
    /// On the sliding surface: the first mismatch is zero (the paper's QISMC, and "x̃1(0) = 0" below its Eq. 36).
    #[default]
    Matched,
    /// With an observer state of zero, whatever the signal is (the paper's QSMDO in its simulation).
    Zero,
}

choice! { Start { Matched, Zero } }

/// What a [`Channel`] is built from; all in the unit of the watched signal and seconds.
#[derive(Clone, Copy)]
pub(super) struct ChannelConfig {
    /// Injection strength k (signal/s).
    pub strength: f32,
    /// Boundary layer ε (signal).
    pub layer: f32,
    /// The configuration's name for it.
    pub layer_field: &'static str,
    /// Sampling period h (s).
    pub period: f32,
    /// Time that the implicit form closes the injection over (s): until the step's effect can be seen.
    ///
    /// The second channel's injection acts through the plant. Closed over one period it stays stable with the delay too, but
    /// rings: at the paper's gains and 20 kHz its poles have a magnitude of 0.94 instead of 0.69.
    pub horizon: f32,
    pub form: Form,
    pub start: Start,
    /// Largest mismatch that is remembered (signal).
    pub range: f32,
    /// Of the signal.
    pub base: Base,
}

/// Watches a signal whose derivative is a modelled rate plus an unknown one, and tells the unknown one.
///
/// The mismatch σ grows by what the signal moved beyond the integral of its modelled rate; the injection k·g(σ/ε) is
/// the estimate of the unknown rate. In an observer the injection is part of the model, so it is taken [off the
/// mismatch](Self::correct) at the next step; where it acts on the plant, the plant's answer does that.
#[derive(Clone, Debug)]
#[repr(C)] // What every step loads comes first, in reach of short loads.
pub(super) struct Channel<S: Scalar, const SHIFT: u32> {
    /// The signal at the last sample.
    before: S,
    /// What the last sample leaves of the next one's mismatch.
    memory: S,
    /// Mismatch σ ahead of the injection, in the signal's unit.
    mismatch: S,
    /// The injection g, within ±1.
    value: S,
    /// Time that the rate at a sample counts in the mismatch there.
    time_now: S::Time,
    /// Time that the rate at a sample counts in the mismatch at the next.
    time_after: S::Time,
    limit: S,
    reach: S::Gains<1>,
    start: Start,
    layer: f32,
    beta: f32,
    base: Base,
}

impl<S: Scalar, const SHIFT: u32> Channel<S, SHIFT> {
    /// Builds a channel and tabulates its injection.
    pub fn new(config: &ChannelConfig, injection: &mut Injection<S>) -> Result<Self, ConfigError> {
        let ChannelConfig { strength, layer, layer_field, period, horizon, range, base, .. } =
            *config;
        let beta = horizon * strength / layer;
        require(
            beta <= MAX_BETA,
            layer_field,
            "must be larger: strength·horizon/layer may be 2000 at most",
            layer,
        )?;
        // An f32 of seven digits would not see the layer beside such a mismatch.
        require(
            range / layer <= 1e7,
            layer_field,
            "must be at least 1e-7 of the largest mismatch",
            layer,
        )?;
        let (beta, time_now) = match config.form {
            Form::Implicit => (beta, 0.5 * period),
            Form::Explicit => (0.0, 0.0),
        };
        require(
            config.form == Form::Implicit || S::ANY_TIME,
            "control.form",
            "must be implicit in fixed point",
            0.0,
        )?;
        injection.tabulate(layer_field, beta, layer, base)?;
        Ok(Self {
            before: S::ZERO,
            memory: S::ZERO,
            mismatch: S::ZERO,
            value: S::ZERO,
            time_now: S::time(time_now),
            time_after: S::time(period - time_now),
            limit: S::constant(layer_field, range + beta * layer, base)?,
            reach: S::gains(layer_field, [(-beta * layer, Base::RATIO)], base)?,
            start: config.start,
            layer,
            beta,
            base,
        })
    }

    /// Starts at a sample: makes up a memory from which the first step gets the mismatch that it is to have.
    pub fn start(&mut self, signal: S, rate: S) {
        self.before = match self.start {
            Start::Matched => signal,
            Start::Zero => S::ZERO,
        };
        self.memory = rate.over::<SHIFT>(self.time_now);
    }

    /// Starts at a sample so that the first step gives the injection `value`, within ±0.99. Gives that.
    pub fn resume(&mut self, signal: S, rate: S, value: f32) -> S {
        self.before = signal;
        self.memory = rate.over::<SHIFT>(self.time_now);
        let value = value.clamp(-0.99, 0.99);
        // y + β·ε·tanh(y/ε) = σ.
        let mismatch = self.layer * (atanh(value) + self.beta * value);
        self.memory = self.memory + S::from_f32(mismatch, self.base);
        S::from_f32(value, Base::RATIO)
    }

    /// One step: the signal and its modelled rate at this sample → the injection g, within ±1.
    #[inline]
    pub fn step(&mut self, injection: &Injection<S>, signal: S, rate: S) -> S {
        let growth = (signal - self.before) - rate.over::<SHIFT>(self.time_now);
        self.mismatch = (self.memory + growth).limited(self.limit);
        self.value = injection.value(self.mismatch);
        self.before = signal;
        self.memory = self.mismatch - rate.over::<SHIFT>(self.time_after);
        self.value
    }

    /// What the injection made the model move by in the period that follows.
    #[inline]
    pub fn correct(&mut self, moved: S) {
        self.memory = self.memory - moved;
    }

    /// The sliding variable y, for which the injection is k·tanh(y/ε), in the signal's unit.
    pub fn sliding_variable(&self) -> S {
        self.mismatch + S::combine(&self.reach, [self.value])
    }
}
