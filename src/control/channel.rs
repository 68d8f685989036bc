//! One channel of an estimator: what a measured signal does beyond its model.

use super::injection::Injection;
use crate::config::{ConfigError, require};
use crate::math::Scalar;

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

/// Where an estimator's memory starts.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Start {
    /// On the sliding surface: the first mismatch is zero (the paper's QISMC, and "x̃1(0) = 0" below its Eq. 36).
    #[default]
    Matched,
    /// With an observer state of zero, whatever the signal is (the paper's QSMDO in its simulation).
    Zero,
}

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
    pub horizon: f32,
    /// Whether the injection corrects a model that runs here (an observer) or acts on the plant (a control).
    pub observer: bool,
    pub form: Form,
    pub start: Start,
    /// Largest mismatch that is remembered (signal).
    pub range: f32,
}

/// Watches a signal whose derivative is a modelled rate plus an unknown one, and tells the unknown one.
///
/// The mismatch σ grows by what the signal moved beyond the integral of its modelled rate; the injection k·g(σ/ε) is
/// the estimate of the unknown rate. In an observer the injection is part of the model, so it is taken off the
/// mismatch at the next step; where it acts on the plant, the plant's answer does that.
#[derive(Clone, Debug)]
pub(super) struct Channel<S: Scalar> {
    per_layer: S::Gain,
    rate_now: S::Gain,
    rate_before: S::Gain,
    correction: S::Gain,
    limit: S,
    before: Sampled<S>,
    injection: Injection<S>,
    layer: S::Gain,
    beta: S::Gain,
    form: Form,
    start: Start,
}

/// A channel at a sample.
#[derive(Clone, Copy, Debug)]
struct Sampled<S> {
    signal: S,
    rate: S,
    /// Mismatch ahead of the injection, σ/ε.
    mismatch: S,
    /// The injection g, within ±1.
    injection: S,
}

impl<S: Scalar> Channel<S> {
    pub fn new(config: &ChannelConfig) -> Result<Self, ConfigError> {
        let ChannelConfig { strength, layer, layer_field, period, horizon, range, .. } = *config;
        require(
            horizon * strength / layer <= Injection::<S>::MAX_BETA,
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
        let (beta, weight_now) = match config.form {
            Form::Implicit => (horizon * strength / layer, 0.5),
            Form::Explicit => (0.0, 0.0),
        };
        let correction = if config.observer { period * strength / layer } else { 0.0 };
        Ok(Self {
            per_layer: S::gain(1.0 / layer),
            rate_now: S::gain(-weight_now * period / layer),
            rate_before: S::gain((weight_now - 1.0) * period / layer),
            correction: S::gain(-correction),
            limit: S::from_f32(range / layer + beta),
            before: Sampled {
                signal: S::ZERO,
                rate: S::ZERO,
                mismatch: S::ZERO,
                injection: S::ZERO,
            },
            injection: Injection::new(beta),
            layer: S::gain(layer),
            beta: S::gain(-beta),
            form: config.form,
            start: config.start,
        })
    }

    /// Starts at a sample: makes up a sample before it, from which the first step gets the mismatch that it is to have.
    pub fn start(&mut self, signal: S, rate: S) {
        self.before = Sampled {
            signal: match self.start {
                Start::Matched => signal,
                Start::Zero => S::ZERO,
            },
            // Either way the two rates add up to nothing.
            rate: match self.form {
                Form::Implicit => -rate,
                Form::Explicit => S::ZERO,
            },
            mismatch: S::ZERO,
            injection: S::ZERO,
        };
    }

    /// One step: the signal and its modelled rate at this sample → the injection g, within ±1.
    #[inline]
    pub fn advance(&mut self, signal: S, rate: S) -> S {
        let before = &self.before;
        let growth = S::combine([
            (self.per_layer, signal - before.signal),
            (self.rate_now, rate),
            (self.rate_before, before.rate),
            (self.correction, before.injection),
        ]);
        let mismatch = (before.mismatch + growth).limited(self.limit);
        let injection = self.injection.value(mismatch);
        self.before = Sampled { signal, rate, mismatch, injection };
        injection
    }

    /// The sliding variable y, for which the injection is k·tanh(y/ε), in the signal's unit.
    pub fn sliding_variable(&self) -> S {
        let Sampled { mismatch, injection, .. } = self.before;
        S::combine([(self.layer, mismatch + S::combine([(self.beta, injection)]))])
    }
}
