//! Building for Cortex-M, with the standard library from rustup or from Debian.

use crate::boards::{Board, TARGETS};
use crate::packages::install;
use crate::shell::{Shell, cargo, program, root};
use anyhow::{Context, Result, bail};
use clap::ValueEnum;
use std::fs;
use std::hash::{DefaultHasher, Hash, Hasher};
use std::path::{Path, PathBuf};

const DEBIAN_PACKAGES: [&str; 4] = ["rustc-web", "cargo-web", "rust-web-src", "rust-web-clippy"];
const DEBIAN_RUSTC: &str = "/usr/bin/rustc";
const DEBIAN_RUSTDOC: &str = "/usr/bin/rustdoc";
const DEBIAN_CARGO: &str = "/usr/bin/cargo";

/// Where the standard library for Cortex-M comes from.
#[derive(Clone, Copy, PartialEq, Eq, ValueEnum)]
pub enum ToolchainChoice {
    /// From rustup, or from Debian where rustup cannot.
    Auto,
    /// `rustup target add`.
    Rustup,
    /// Debian's packaged Rust, its core built from the packaged source.
    Debian,
}

/// A toolchain that builds for Cortex-M.
pub enum Cross {
    Rustup,
    Debian {
        /// Holds core and alloc for the target.
        sysroot: PathBuf,
        linker: PathBuf,
    },
}

impl Cross {
    /// Makes the toolchain ready.
    pub fn set_up(choice: ToolchainChoice) -> Result<Self> {
        match choice {
            ToolchainChoice::Rustup => rustup(),
            ToolchainChoice::Debian => debian(),
            ToolchainChoice::Auto => rustup().or_else(|rustup_error| {
                println!("Set-up: {rustup_error:#}; trying Debian's packages.");
                debian().map_err(|debian_error| {
                    debian_error.context(format!(
                        "no standard library for Cortex-M. rustup: {rustup_error:#}. Debian"
                    ))
                })
            }),
        }
    }

    /// Builds a board's firmware; gives its ELF, at `target/firmware/<board>.elf`.
    pub fn firmware(&self, board: &Board) -> Result<PathBuf> {
        let Board { binary, target, profile, .. } = board;
        self.cargo("build", board)
            .args(&["--bin", binary])
            // Without it all but errors are compiled out.
            .env("DEFMT_LOG", "info")
            // A quarter of what it is by default: the stack has better use for it.
            .env("DEFMT_RTT_BUFFER_SIZE", "256")
            // What the image tells of itself over the link.
            .env("QUASIDRIVE_BUILD", build())
            .run()?;
        let built = self.target_dir().join(target).join(profile).join(binary);
        let elf = board.image();
        fs::create_dir_all(elf.with_file_name(""))?;
        fs::copy(&built, &elf).with_context(|| format!("no {}", built.display()))?;
        Ok(elf)
    }

    /// Lints what only a board's target compiles, and checks its documentation.
    pub fn lint(&self, board: &Board) -> Result<()> {
        self.cargo("clippy", board).args(&["--lib", "--bins", "--", "--deny", "warnings"]).run()?;
        self.cargo("doc", board)
            .args(&["--lib", "--no-deps"])
            // Debian's has flags of its own.
            .env("RUSTDOCFLAGS", "--deny warnings")
            .run()
    }

    /// The compiler's version.
    pub fn compiler(&self) -> Result<String> {
        let rustc = match self {
            Self::Rustup => "rustc",
            Self::Debian { .. } => DEBIAN_RUSTC,
        };
        let version = program(rustc).args(&["--version"]).output();
        Ok(version.with_context(|| format!("{rustc} does not run"))?.trim().to_owned())
    }

    /// A command of cargo's on the firmware of a board, as it is flashed.
    fn cargo(&self, command: &str, board: &Board) -> Shell {
        let Board { features, target, profile, .. } = board;
        let cargo = match self {
            Self::Rustup => cargo(&[]),
            Self::Debian { sysroot, linker } => {
                let flags = format!("--sysroot\u{1f}{}", sysroot.display());
                TARGETS.iter().fold(debian_cargo(&flags), |cargo, target| {
                    let target = target.to_uppercase().replace('-', "_");
                    cargo.env(&format!("CARGO_TARGET_{target}_LINKER"), linker)
                })
            }
        };
        cargo
            .args(&[command, "--target", target, "--profile", profile])
            .args(&["--package", "quasidrive", "--features", features])
            .env("CARGO_TARGET_DIR", self.target_dir())
    }

    /// Each toolchain has a folder of its own: cargo rebuilds everything when the compiler changes.
    fn target_dir(&self) -> PathBuf {
        root().join(match self {
            Self::Rustup => "target",
            Self::Debian { .. } => "target/debian",
        })
    }
}

/// The commit that is built, and whether anything was changed since.
fn build() -> String {
    let describe = program("git").args(&["describe", "--always", "--dirty", "--exclude=*"]);
    // An archive without its history has no commit.
    describe.output().map_or("unknown".to_owned(), |commit| commit.trim().to_owned())
}

fn rustup() -> Result<Cross> {
    let installed = || {
        let installed = program("rustup").args(&["target", "list", "--installed"]).output()?;
        Some(TARGETS.iter().all(|target| installed.lines().any(|line| line == *target)))
    };
    let list = TARGETS.join(", ");
    match installed() {
        Some(true) => println!("Set-up: {list} are there, by rustup."),
        Some(false) => {
            println!("Set-up: adding {list} by rustup.");
            program("rustup").args(&["target", "add"]).args(&TARGETS).run().with_context(|| {
                format!("rustup cannot add {list}: add them by hand, or take Debian's packages (--toolchain debian)")
            })?;
        }
        None => bail!("rustup cannot be run: install it from rustup.rs"),
    }
    Ok(Cross::Rustup)
}

fn debian() -> Result<Cross> {
    let status = |package: &str| {
        program("dpkg-query")
            .args(&["--show", "--showformat=${db:Status-Status}", package])
            .output()
    };
    if DEBIAN_PACKAGES.iter().all(|package| status(package).as_deref() == Some("installed")) {
        println!("Set-up: Debian's Rust is there.");
    } else {
        install("Debian's Rust", &DEBIAN_PACKAGES)?;
    }
    let version = program(DEBIAN_RUSTC)
        .args(&["--version", "--verbose"])
        .output()
        .with_context(|| format!("{DEBIAN_RUSTC} does not run"))?;
    let mut hasher = DefaultHasher::new();
    version.hash(&mut hasher);
    let sysroot = root().join(format!("target/sysroot-{:016x}", hasher.finish()));
    for target in TARGETS {
        let libraries = sysroot.join("lib/rustlib").join(target).join("lib");
        if libraries.is_dir() {
            println!("Set-up: core for {target} is built.");
        } else {
            println!("Set-up: building core for {target} from Debian's source, once.");
            build_sysroot(&sysroot, target, &libraries)?;
        }
    }
    Ok(Cross::Debian { sysroot, linker: rust_lld()? })
}

/// The linker that comes with the host's toolchain.
fn rust_lld() -> Result<PathBuf> {
    let sysroot = program("rustc").args(&["--print", "sysroot"]).output();
    let libraries = Path::new(sysroot.as_deref().unwrap_or_default().trim()).join("lib/rustlib");
    let linkers = fs::read_dir(&libraries)
        .with_context(|| format!("cannot read {}", libraries.display()))?
        .filter_map(|host| Some(host.ok()?.path().join("bin/rust-lld")));
    linkers.into_iter().find(|linker| linker.is_file()).with_context(|| {
        format!("no rust-lld in {}: a toolchain that rustup installs has one", libraries.display())
    })
}

/// Builds core and alloc as a dependency of an empty crate, and lays them out as a sysroot.
fn build_sysroot(sysroot: &Path, target: &str, libraries: &Path) -> Result<()> {
    let seed = sysroot.join("seed");
    fs::create_dir_all(seed.join("src"))?;
    fs::write(
        seed.join("Cargo.toml"),
        "[package]\nname = \"seed\"\nedition = \"2024\"\n\n[workspace]\n",
    )?;
    fs::write(seed.join("src/lib.rs"), "#![no_std]\n")?;
    debian_cargo("-Cembed-bitcode=yes\u{1f}-Zforce-unstable-if-unmarked")
        .args(&["build", "--release", "-Zbuild-std=core,alloc", "--target", target])
        .env("RUSTC_BOOTSTRAP", "1")
        .env("CARGO_TARGET_DIR", seed.join("target"))
        .current_dir(&seed)
        .run()?;
    // Filled aside and moved in whole: a folder that is there is complete.
    let aside = libraries.with_extension("partial");
    fs::create_dir_all(&aside)?;
    let built = seed.join("target").join(target).join("release/deps");
    for entry in fs::read_dir(&built)? {
        let file = entry?.path();
        let name = file.file_name().unwrap_or_default();
        let is_library = file.extension().is_some_and(|extension| extension == "rlib");
        if is_library && !name.to_string_lossy().starts_with("libseed-") {
            fs::copy(&file, aside.join(name))?;
        }
    }
    fs::rename(&aside, libraries)?;
    fs::remove_dir_all(&seed)?;
    Ok(())
}

/// Debian's cargo, rustc and rustdoc, with flags for the target and none of the host's.
fn debian_cargo(encoded_flags: &str) -> Shell {
    let path = format!("/usr/bin:{}", std::env::var("PATH").unwrap_or_default());
    program(DEBIAN_CARGO)
        .env("RUSTC", DEBIAN_RUSTC)
        .env("RUSTDOC", DEBIAN_RUSTDOC)
        .env("CARGO_ENCODED_RUSTFLAGS", encoded_flags)
        .env("CARGO_ENCODED_RUSTDOCFLAGS", format!("{encoded_flags}\u{1f}--deny\u{1f}warnings"))
        .env_remove("RUSTFLAGS")
        .env_remove("CARGO")
        // Clippy, and what it calls in turn, are looked for here: not in rustup's folder, which often comes first.
        .env("PATH", path)
}
