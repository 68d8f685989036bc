//! What the project needs on a machine that has rustup and nothing else.

use crate::cross::{Cross, ToolchainChoice};
use crate::packages::install;
use crate::shell::program;
use anyhow::Result;

/// What the host commands need: nothing but the toolchain that runs this, which rustup has fetched by now.
pub fn host() -> Result<()> {
    println!("Set-up: the host's toolchain is all that is needed.");
    Ok(())
}

/// What the tests need.
pub fn everything(toolchain: ToolchainChoice) -> Result<Cross> {
    host()?;
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
