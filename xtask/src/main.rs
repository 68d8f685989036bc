//! `cargo xtask`: the project's chores.

mod boards;
mod count;
mod cross;
mod cycles;
mod debug_info;
mod interrupt;
mod packages;
mod setup;
mod shell;
mod size;
mod thumb;

use anyhow::{Context, Result};
use boards::{BOARDS, Board};
use clap::{Parser, Subcommand};
use cross::{Cross, ToolchainChoice};
use shell::{Shell, cargo, program, root, run_all};
use std::process::ExitCode;

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
    /// The main job: reproduce the paper against the simulated motor and write the report; then build the flash image, and let it hold the
    /// paper's speed cycle on the emulated board.
    Demo {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// Everything: formatting, lints, host tests, the flash image on the emulated board with the fault campaign, the loop on Cortex-M in
    /// QEMU, docs.
    Test {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// Lint and build the firmware of every board, to target/firmware/, and check its control interrupt.
    Firmware {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// Count the control step's instructions in QEMU, model its cycles, measure the image; compare with xtask/counts.txt.
    Count {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
        /// Replace xtask/counts.txt by what is counted.
        #[arg(long)]
        rewrite: bool,
    },
    /// Print what every board's image takes of its flash and RAM; fail beyond the budget.
    Size {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// Build the B-G431B-ESC1's firmware, flash it by its ST-LINK with probe-rs, and show its log.
    FlashEsc1 {
        /// Where the standard library for Cortex-M comes from.
        #[arg(long, default_value = "auto")]
        toolchain: ToolchainChoice,
    },
    /// Redraw the README's plots.
    Plots,
}

fn main() -> ExitCode {
    match execute(Cli::parse().task) {
        Ok(()) => ExitCode::SUCCESS,
        Err(error) => {
            eprintln!("error: {error:#}");
            ExitCode::FAILURE
        }
    }
}

fn execute(task: Task) -> Result<()> {
    match task {
        Task::Setup { toolchain } => setup::everything(toolchain).map(drop),
        Task::Demo { toolchain } => demo(toolchain),
        Task::Test { toolchain } => test(toolchain),
        Task::Firmware { toolchain } => {
            let cross = Cross::set_up(toolchain)?;
            BOARDS.iter().try_for_each(|board| firmware(&cross, board))
        }
        Task::Count { toolchain, rewrite } => count::count(&setup::everything(toolchain)?, rewrite),
        Task::FlashEsc1 { toolchain } => {
            let elf = Cross::set_up(toolchain)?.firmware(&boards::B_G431B_ESC1)?;
            program("probe-rs").args(&["run", "--chip", "STM32G431CB"]).args(&[elf]).run()
        }
        Task::Size { toolchain } => size::size(&Cross::set_up(toolchain)?),
        Task::Plots => host_sim(&["paper", "--plots", "docs"]),
    }
}

/// Lints and builds a board's firmware, and checks its control interrupt.
fn firmware(cross: &Cross, board: &Board) -> Result<()> {
    cross.lint(board)?;
    interrupt::check(board, &cross.firmware(board)?)
}

fn demo(toolchain: ToolchainChoice) -> Result<()> {
    println!("Set-up: the paper needs nothing beyond the toolchain that runs this.");
    host_sim(&["paper"])?;
    println!("Next: cargo run --release -p host-sim -- run host-sim/scenarios/load-step.toml");
    println!("The image that is flashed, on the emulated board:");
    Cross::set_up(toolchain)
        .and_then(|cross| cross.firmware(&boards::B_G431B_ESC1))
        .context(
            "the paper is reproduced and its report written, but the flash image could not be built, so it has not run on the emulated board",
        )?;
    host_sim(&[
        "board",
        "host-sim/scenarios/esc1.toml",
        "--agreement",
        "--report",
        "target/board.html",
    ])
}

fn host_sim(arguments: &[&str]) -> Result<()> {
    cargo(&["run", "--release", "--package", "host-sim", "--"]).args(arguments).run()
}

/// The same as `cargo test` builds it, which the tests have done already: the same bits, with checks of overflow.
fn tested_host_sim(arguments: &[&str]) -> Shell {
    cargo(&["run", "--quiet", "--package", "host-sim", "--"]).args(arguments)
}

/// The drive in QEMU, held to the host's bits: the paper's whole cycle for each of its controllers; a second of it on a board's
/// sensors for every other; the other core, which runs the same image; and all controllers on the cores without an FPU.
fn processor_in_the_loop() -> Result<()> {
    let mut plays = Vec::new();
    let mut play = |scenario: &str, controller: &str, machine: &str, more: &[&str]| {
        let file = format!("host-sim/scenarios/{scenario}.toml");
        let on_qemu = ["run", &file, "--controller-on", "qemu", "--machine", machine];
        let all = [&on_qemu[..], &["--controller", controller], more].concat();
        plays.push(tested_host_sim(&all));
    };
    for controller in ["bs", "bs-qsmdo", "bs-qismc"] {
        play("paper", controller, "mps2-an386", &[]);
    }
    for controller in ["drive-qsmdo", "drive-qismc", "pi", "ladrc"] {
        play("encoder", controller, "mps2-an386", &["--duration", "1"]);
    }
    play("load-step", "bs-qsmdo", "mps2-an500", &["--duration", "2"]);
    for machine in ["mps2-an385", "microbit"] {
        play("paper", "bs-qsmdo", machine, &["--duration", "2"]);
        for controller in ["bs", "bs-qismc"] {
            play("paper", controller, machine, &["--duration", "0.5"]);
        }
        for controller in ["drive-qsmdo", "drive-qismc", "pi", "ladrc"] {
            play("encoder", controller, machine, &["--duration", "0.5"]);
        }
    }
    run_all(plays)
}

/// The board's image, byte for byte, on the emulated board: what it does by itself, the paper's cycle held against the averaged board, and the
/// fault campaign. In `cargo test` these are ignored, for there is no image without a cross toolchain.
fn virtual_board() -> Result<()> {
    cargo(&["test", "--workspace", "--", "--ignored"]).run()?;
    tested_host_sim(&["board", "host-sim/scenarios/esc1.toml", "--agreement"]).run()?;
    tested_host_sim(&["campaign"]).run()
}

fn test(toolchain: ToolchainChoice) -> Result<()> {
    let cross = setup::everything(toolchain)?;
    cargo(&["fmt", "--all", "--check"]).run()?;
    cargo(&["clippy", "--workspace", "--all-targets", "--", "--deny", "warnings"]).run()?;
    cargo(&["test", "--workspace"]).run()?;
    for board in &BOARDS {
        firmware(&cross, board)?;
    }
    size::size(&cross)?;
    virtual_board()?;
    processor_in_the_loop()?;
    count::count(&cross, false)?;
    cargo(&["doc", "--workspace", "--no-deps"]).env("RUSTDOCFLAGS", "--deny warnings").run()?;
    println!("All checks passed in {}.", root().display());
    Ok(())
}
