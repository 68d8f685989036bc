//! Link arguments and memory maps of the firmware: kept here and not in `.cargo/config.toml`, where RUSTFLAGS would replace them.

use std::path::Path;

fn main() -> std::io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rustc-check-cfg=cfg(short_products)");
    let set = |name: &str| std::env::var_os(name);
    if set("CARGO_CFG_TARGET_OS").is_none_or(|os| os != "none") {
        return Ok(());
    }
    // Cortex-M0 multiplies 32 by 32 bits to 32, not to 64.
    if std::env::var("TARGET").is_ok_and(|target| target.starts_with("thumbv6m")) {
        println!("cargo::rustc-cfg=short_products");
    }
    let (Some(out), Some(root)) = (set("OUT_DIR"), set("CARGO_MANIFEST_DIR")) else {
        return Ok(());
    };
    let (out, boards) = (Path::new(&out), Path::new(&root).join("src/board"));
    let memory = if set("CARGO_FEATURE_B_G431B_ESC1").is_some() {
        boards.join("b_g431b_esc1/memory.x")
    } else {
        // cortex-m-rt includes the names of a device's interrupts. These boards fill their vector tables themselves.
        std::fs::write(out.join("device.x"), "")?;
        let is_microbit = set("CARGO_FEATURE_MICROBIT").is_some();
        boards.join(if is_microbit { "qemu/nrf51.x" } else { "qemu/mps2.x" })
    };
    println!("cargo::rerun-if-changed={}", memory.display());
    std::fs::copy(memory, out.join("memory.x"))?;
    println!("cargo::rustc-link-search={}", out.display());
    println!("cargo::rustc-link-arg=--nmagic");
    println!("cargo::rustc-link-arg=-Tlink.x");
    println!("cargo::rustc-link-arg=-Tdefmt.x");
    Ok(())
}
