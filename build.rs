//! Link arguments and memory maps of the firmware: kept here and not in `.cargo/config.toml`, where RUSTFLAGS would replace them.

use std::path::Path;

fn main() -> std::io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    let set = |name: &str| std::env::var_os(name);
    if set("CARGO_CFG_TARGET_OS").is_none_or(|os| os != "none") {
        return Ok(());
    }
    let (Some(out), Some(root)) = (set("OUT_DIR"), set("CARGO_MANIFEST_DIR")) else {
        return Ok(());
    };
    let (out, boards) = (Path::new(&out), Path::new(&root).join("src/board"));
    let memory = if set("CARGO_FEATURE_B_G431B_ESC1").is_some() {
        boards.join("b_g431b_esc1/memory.x")
    } else {
        // cortex-m-rt includes the names of a device's interrupts. This board fills its vector table itself.
        std::fs::write(out.join("device.x"), "")?;
        boards.join("qemu.x")
    };
    println!("cargo::rerun-if-changed={}", memory.display());
    std::fs::copy(memory, out.join("memory.x"))?;
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg=--nmagic");
    println!("cargo::rustc-link-arg=-Tlink.x");
    println!("cargo::rustc-link-arg=-Tdefmt.x");
    Ok(())
}
