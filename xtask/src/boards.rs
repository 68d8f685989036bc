//! The boards that firmware is built for.

use crate::shell::root;
use std::path::PathBuf;

/// Cortex-M4F and M7, M3, M0.
pub const TARGETS: [&str; 3] =
    ["thumbv7em-none-eabihf", "thumbv7m-none-eabi", "thumbv6m-none-eabi"];

/// A board.
pub struct Board {
    pub name: &'static str,
    pub binary: &'static str,
    pub features: &'static str,
    pub target: &'static str,
    /// Cargo's profile that it is built with.
    pub profile: &'static str,
    /// Part of the name of the control interrupt's handler, as the image has it.
    pub handler: &'static str,
    /// Parts of the names of what the interrupt calls in slower memory than its own, because it is not for every period.
    pub cold: &'static [&'static str],
    /// The most that the image may take.
    pub budget: Budget,
}

impl Board {
    /// Where its image is put.
    pub fn image(&self) -> PathBuf {
        root().join(format!("target/firmware/{}.elf", self.name))
    }
}

/// Bytes.
pub struct Budget {
    pub flash: u64,
    /// With the stack.
    pub ram: u64,
}

/// QEMU's MPS2 boards with Cortex-M4F and M7.
pub const QEMU: Board = Board {
    name: "qemu",
    binary: "qemu",
    features: "qemu",
    target: TARGETS[0],
    profile: "firmware",
    handler: "5board4qemu5timer",
    cold: &[],
    budget: Budget { flash: 128 * 1024, ram: 32 * 1024 },
};

/// That with Cortex-M3.
pub const QEMU_M3: Board = Board { name: "qemu-m3", target: TARGETS[1], ..QEMU };

/// QEMU's micro:bit, with Cortex-M0.
pub const QEMU_M0: Board = Board {
    name: "qemu-m0",
    features: "microbit",
    target: TARGETS[2],
    budget: Budget { flash: 128 * 1024, ram: 16 * 1024 },
    ..QEMU
};

/// ST's B-G431B-ESC1.
pub const B_G431B_ESC1: Board = Board {
    name: "b_g431b_esc1",
    binary: "b_g431b_esc1",
    features: "b_g431b_esc1",
    target: TARGETS[0],
    profile: "firmware-small",
    handler: "ADC1_2",
    cold: &[
        // The first period after arming, and those with outputs off.
        "5drive14Drive$LT$S$GT$5start",
        // 25 ms of it, between arming and driving.
        "10supervisor19Supervisor$LT$S$GT$6charge",
        // Switching off, and faults.
        "5drive14Drive$LT$S$GT$4stop",
        "5drive14Drive$LT$S$GT$6refuse",
        "5drive14Drive$LT$S$GT$8fault_in",
        "5drive14Drive$LT$S$GT$16electrical_fault",
        // A new command.
        "10trajectory15SCurve$LT$S$GT$4plan",
        "9interrupt7Control4obey",
        "9interrupt7Control6change",
        "9interrupt7Control11tell_period",
        // Commissioning, which has the time: the drive's law does not run beside it.
        "9interrupt7Control10commission",
        "9interrupt8progress",
    ],
    // 64 kB for everything but commissioning, which may take 12 kB.
    budget: Budget { flash: 76 * 1024, ram: 12 * 1024 },
};

pub const BOARDS: [Board; 4] = [QEMU, QEMU_M3, QEMU_M0, B_G431B_ESC1];
