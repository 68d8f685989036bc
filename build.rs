//! Link arguments of the firmware: kept here and not in `.cargo/config.toml`, where RUSTFLAGS would replace them.

use std::path::Path;

fn main() -> std::io::Result<()> {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=memory.x");
    println!("cargo::rustc-check-cfg=cfg(short_products)");
    let set = |name: &str| std::env::var_os(name);
    if set("CARGO_CFG_TARGET_OS").is_none_or(|os| os != "none") {
        return Ok(());
    }
    // Cortex-M0 multiplies 32 by 32 bits to 32, not to 64.
    if std::env::var("TARGET").is_ok_and(|target| target.starts_with("thumbv6m")) {
        println!("cargo::rustc-cfg=short_products");
    }
    println!("cargo::rustc-link-arg=--nmagic");
    println!("cargo::rustc-link-arg=-Tlink.x");
    if set("CARGO_FEATURE_QEMU").is_some() {
        println!("cargo::rustc-link-arg=-Tdefmt.x");
        println!("cargo::rustc-link-arg=--defsym=mps2=1");
    }
    if set("CARGO_FEATURE_MICROBIT").is_some() {
        println!("cargo::rustc-link-arg=--defsym=microbit=1");
    }
    // cortex-m-rt includes the names of a device's interrupts. Boards fill their vector tables themselves.
    if let Some(out) = set("OUT_DIR") {
        std::fs::write(Path::new(&out).join("device.x"), "")?;
        println!("cargo::rustc-link-search={}", Path::new(&out).display());
    }
    Ok(())
}
