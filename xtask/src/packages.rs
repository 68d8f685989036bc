//! Debian packages.

use crate::shell::{find, program};
use anyhow::{Context, Result, bail};

/// Installs Debian packages, or says what to install by hand.
pub fn install(what: &str, packages: &[&str]) -> Result<()> {
    let list = packages.join(" ");
    println!("Set-up: installing {what} by apt-get: {list}.");
    apt_get(&["update", "--quiet"])
        .and_then(|()| {
            let options = ["install", "--yes", "--quiet", "--no-install-recommends"];
            apt_get(&[&options, packages].concat())
        })
        .with_context(|| {
            format!(
                "cannot install {what}. Install it by hand and run this again: on Debian and Ubuntu \
                 `sudo apt-get install {list}`, elsewhere the packages that hold the same programs"
            )
        })
}

fn apt_get(arguments: &[&str]) -> Result<()> {
    if find("apt-get").is_none() {
        bail!("this system has no apt-get");
    }
    let is_root = program("id").args(&["-u"]).output().is_some_and(|id| id.trim() == "0");
    let command = if is_root {
        program("apt-get")
    } else {
        program("sudo").args(&["--non-interactive", "apt-get"])
    };
    command.args(arguments).env("DEBIAN_FRONTEND", "noninteractive").run()
}
