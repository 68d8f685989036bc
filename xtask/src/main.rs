//! `cargo xtask`: the project's chores.

mod cross;
mod packages;
mod setup;
mod shell;

use anyhow::Result;
use clap::{Parser, Subcommand};
use cross::ToolchainChoice;
use shell::{cargo, root};

/// The project's chores.
#[derive(Parser)]
struct Cli {
    #[command(subcommand)]
    task: Task,
}

#[derive(Subcommand)]
enum Task {
    /// Install what the tests need: cross toolchain and QEMU. Does nothing twice.
    Setup {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// The main job: reproduce the paper against the simulated motor and write the report.
    Demo,
    /// Everything: formatting, lints, host tests, cross build, docs.
    Test {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// Redraw the README's plots.
    Plots,
}

fn main() -> Result<()> {
    match Cli::parse().task {
        Task::Setup { toolchain } => setup::everything(toolchain).map(drop),
        Task::Demo => demo(),
        Task::Test { toolchain } => test(toolchain),
        Task::Plots => host_sim(&["paper", "--plots", "docs"]),
    }
}

fn demo() -> Result<()> {
    setup::host()?;
    host_sim(&["paper"])?;
    println!("Next: cargo run --release -p host-sim -- run host-sim/scenarios/load-step.toml");
    Ok(())
}

fn host_sim(arguments: &[&str]) -> Result<()> {
    cargo(&["run", "--release", "--package", "host-sim", "--"]).args(arguments).run()
}

fn test(toolchain: ToolchainChoice) -> Result<()> {
    let cross = setup::everything(toolchain)?;
    cargo(&["fmt", "--all", "--check"]).run()?;
    cargo(&["clippy", "--workspace", "--all-targets", "--", "--deny", "warnings"]).run()?;
    cargo(&["test", "--workspace"]).run()?;
    cross.build(&["--package", "quasidrive", "--lib", "--release"])?;
    cargo(&["doc", "--workspace", "--no-deps"]).env("RUSTDOCFLAGS", "--deny warnings").run()?;
    println!("All checks passed in {}.", root().display());
    Ok(())
}
