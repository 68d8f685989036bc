//! Boards: the only place that touches hardware, and the only one with `unsafe`.

#[cfg(feature = "b_g431b_esc1")]
pub mod b_g431b_esc1;
mod handed_over;
#[cfg(feature = "qemu")]
pub mod qemu;
#[cfg(feature = "b_g431b_esc1")]
mod slot;
