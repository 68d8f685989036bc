//! Time as an integer, so that it is the same on every machine.
//!
//! A tick is 1/1360 µs. It divides the periods of all clocks: 85 ticks of the internal oscillator's 16 MHz, 170 of the crystal's 8 MHz, 8 of the
//! core's 170 MHz, 42500 of the watchdog's 32 kHz.

/// A point in time, or a length of it.
pub type Tick = u64;

/// Ticks in a second.
pub const SECOND: Tick = 1_360_000_000;

/// Ticks in a microsecond.
pub const MICROSECOND: Tick = SECOND / 1_000_000;

/// After everything.
pub const NEVER: Tick = Tick::MAX;

/// In seconds.
pub fn seconds(ticks: Tick) -> f64 {
    ticks as f64 / SECOND as f64
}

/// From seconds, to the nearest tick.
pub fn ticks(seconds: f64) -> Tick {
    (seconds * SECOND as f64).round() as Tick
}
