//! Boards: the only place that touches hardware, and the only one with `unsafe`.

#[cfg(feature = "qemu")]
pub mod qemu;
