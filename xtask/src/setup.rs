//! What the tests need on a machine that has rustup and nothing else. The demo needs no more than rustup.

use crate::cross::{Cross, ToolchainChoice};
use crate::packages::install;
use crate::shell::program;
use anyhow::Result;

/// Cross toolchain and QEMU.
pub fn everything(toolchain: ToolchainChoice) -> Result<Cross> {
    let cross = Cross::set_up(toolchain)?;
    qemu()?;
    Ok(cross)
}

fn qemu() -> Result<()> {
    match program("qemu-system-arm").args(&["--version"]).output() {
        Some(version) => {
            println!("Set-up: QEMU is there: {}", version.lines().next().unwrap_or_default());
            Ok(())
        }
        None => install("QEMU", &["qemu-system-arm"]),
    }
}
