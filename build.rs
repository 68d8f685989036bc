//! Link arguments of the firmware: kept here and not in `.cargo/config.toml`, where RUSTFLAGS would replace them.

fn main() {
    println!("cargo::rerun-if-changed=build.rs");
    println!("cargo::rerun-if-changed=memory.x");
    let bare_metal = std::env::var("CARGO_CFG_TARGET_OS").is_ok_and(|os| os == "none");
    if bare_metal {
        println!("cargo::rustc-link-arg=--nmagic");
        println!("cargo::rustc-link-arg=-Tlink.x");
    }
}
