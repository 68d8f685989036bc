//! An emulated B-G431B-ESC1: the microcontroller with its registers, running the unmodified firmware image.
//!
//! - [`world`]: what is wired to its pins, for others to implement.

pub mod world;
