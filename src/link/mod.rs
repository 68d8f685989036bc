//! The link between a drive and a host that commands and watches it, over a serial port or a socket.
//!
//! ```text
//! host ── Numbered { sequence, request } ──▶ drive ── Message::Answer { sequence, answer } ──▶ host
//!                                                  ── Message::Telemetry(…) ──────────────▶
//! ```
//!
//! - [`message`]: what they say. [`message::VERSION`] must be the same on both sides.
//! - [`frame`]: how it travels: `postcard`, with a CRC-32, stuffed by COBS between zeros.
//! - [`session`]: the drive's end, which turns a [`Device`](session::Device) into one that answers requests. The host's is
//!   `host-sim connect`.
//!
//! Each request that arrives whole has exactly one answer, in order; a frame that does not arrive whole has none, and the host
//! asks again. A host has at most one request under way. One that is silent for longer than
//! [`Protection::command_timeout`](crate::supervisor::Protection::command_timeout) is lost, and the drive stops: any request is a
//! sign of life, [`Command::KeepAlive`](crate::supervisor::Command::KeepAlive) one that does nothing else. Garbage is none.
//!
//! Parameters travel one by one, by name ([`schema`](crate::schema)): no message is long, and host and drive of different versions
//! understand what both know. What is to change is staged and then applied, all of it or none.
//!
//! `postcard-rpc` would give typed endpoints for this, but: its host brings an asynchronous runtime, and its frames on a serial port have
//! no CRC. Eleven requests are less than that.

pub mod frame;
pub mod message;
pub mod session;

/// Bits per second on a serial port, with eight data bits, no parity, one stop bit.
pub const BAUD_RATE: u32 = 921_600;

/// What this was built from: a commit, where the build told by the variable `QUASIDRIVE_BUILD`.
pub const BUILD: &str = match option_env!("QUASIDRIVE_BUILD") {
    Some(build) => build,
    None => "unknown",
};
