//! The boards that firmware is built for.

/// A board: its name is that of its binary and of its feature.
pub struct Board {
    pub name: &'static str,
    /// Cargo's profile that it is built with.
    pub profile: &'static str,
    /// Part of the name of the control interrupt's handler, as the image has it.
    pub handler: &'static str,
    /// Parts of the names of what the interrupt calls in slower memory than its own, because it is not for every period.
    pub cold: &'static [&'static str],
    /// The most that the image may take.
    pub budget: Budget,
}

/// Bytes.
pub struct Budget {
    pub flash: u64,
    /// With the stack.
    pub ram: u64,
}

pub const QEMU: Board = Board {
    name: "qemu",
    profile: "firmware",
    handler: "5board4qemu6timer0",
    cold: &[],
    budget: Budget { flash: 128 * 1024, ram: 32 * 1024 },
};

pub const B_G431B_ESC1: Board = Board {
    name: "b_g431b_esc1",
    profile: "firmware-small",
    handler: "ADC1_2",
    cold: &[
        // The first period after arming, and those with outputs off.
        "5drive14Drive$LT$S$GT$5start",
        // Switching off, and faults.
        "5drive14Drive$LT$S$GT$4stop",
        "5drive14Drive$LT$S$GT$6refuse",
        "5drive14Drive$LT$S$GT$8fault_in",
        // A new command.
        "10trajectory15SCurve$LT$S$GT$4plan",
        "9interrupt7Control6change",
        "9interrupt7Control11tell_period",
    ],
    // The aim is 64 kB; what keeps the image above it is in docs/b-g431b-esc1.md.
    budget: Budget { flash: 90 * 1024, ram: 12 * 1024 },
};

pub const BOARDS: [Board; 2] = [QEMU, B_G431B_ESC1];
