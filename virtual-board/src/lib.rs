//! An emulated B-G431B-ESC1: the microcontroller with its registers, running the unmodified firmware image.
//!
//! - [`world`]: what is wired to its pins, for others to implement.
#![warn(missing_docs)]

pub mod board;
pub mod chip;
mod cpu;
pub mod image;
mod memory;
pub mod statistics;
pub mod time;
pub mod world;

pub use board::{Stop, VirtualBoard};
pub use image::Image;
pub use world::World;
