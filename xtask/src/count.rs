//! Executed instructions of the control step on an emulated Cortex-M, counted one by one in QEMU's log, and the image's
//! size.
//!
//! QEMU runs one instruction at a time and logs the address of each one in the counted functions, while the drive runs the
//! start of the paper's cycle in closed loop. The numbers are exact and repeatable. They are instructions, not cycles;
//! one that is skipped inside an IT block counts as one. A function of known length shows that none is missed.

use crate::cross::Cross;
use crate::shell::{cargo, root};
use anyhow::{Context, Result, bail, ensure};
use object::{Object, ObjectSection, ObjectSymbol, SectionKind};
use std::fmt::Write;
use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::ops::Range;
use std::path::Path;

/// Simulated time that is counted (s): 1000 periods with the steepest transient.
const DURATION: &str = "0.05";

/// Largest deviation from the golden table that is not looked into, either way.
const TOLERANCE: f64 = 0.05;

const GOLDEN: &str = "xtask/counts.txt";

/// Builds the firmware, counts and prints; compares with the golden table, or rewrites it.
pub fn count(cross: &Cross, rewrite: bool) -> Result<()> {
    let compiler = cross.compiler()?;
    let table = format!("{compiler}\n\n{}", table(&cross.firmware("qemu")?)?);
    println!("{table}");
    let golden = root().join(GOLDEN);
    if rewrite {
        return fs::write(&golden, table).with_context(|| format!("cannot write {GOLDEN}"));
    }
    let expected = fs::read_to_string(&golden).with_context(|| format!("cannot read {GOLDEN}"))?;
    if expected.lines().next() != Some(&compiler) {
        // Another compiler may well need other instructions.
        println!("Not compared: {GOLDEN} is of another compiler.");
        return Ok(());
    }
    let deviations = deviations(&table, &expected)?;
    if !deviations.is_empty() {
        bail!(
            "not as in {GOLDEN} to {} %:\n{deviations}If that is meant: cargo xtask count --rewrite",
            TOLERANCE * 100.0
        );
    }
    Ok(())
}

fn table(elf: &Path) -> Result<String> {
    let data = fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))?;
    let image = object::File::parse(&*data)?;
    let step = function(&image, "5drive", "Drive$LT$S$GT$4step")?;
    let law = function(&image, "7control", "Controller$LT$S$GT$4step")?;
    let calibration = function(&image, "5board4qemu", "11calibration")?;

    // A straight line of a hundred and a few instructions of two bytes each.
    let known = (calibration.end - calibration.start) / 2;
    ensure!((100..110).contains(&known), "the calibration has {known} instructions");

    let mut table = String::from("executed instructions             min    mean     max\n");
    for (core, machine) in [("Cortex-M4F", "mps2-an386"), ("Cortex-M7", "mps2-an500")] {
        for controller in ["bs", "bs-qsmdo", "bs-qismc"] {
            let trace = Trace::record(controller, machine, &[&step, &law, &calibration])?;
            let calls = trace.calls(&calibration, &[&calibration]);
            ensure!(
                calls == [known],
                "the calibration ran {calls:?} instructions, not {known} once"
            );
            let mut row = |what: &str, calls: Vec<u64>| -> Result<()> {
                let (min, max) = (calls.iter().min(), calls.iter().max());
                let (min, max) = min.zip(max).context("no call was counted")?;
                let mean = calls.iter().sum::<u64>() as f64 / calls.len() as f64;
                let name = format!("{core} {controller} {what}");
                writeln!(table, "{name:<32} {min:>5} {mean:>7.1} {max:>7}")?;
                Ok(())
            };
            row("law", trace.calls(&law, &[&law]))?;
            row("Drive::step", trace.calls(&step, &[&step, &law]))?;
        }
    }
    writeln!(table, "\nbytes")?;
    for (name, bytes) in sizes(&image) {
        writeln!(table, "{name:<32} {bytes:>5}")?;
    }
    Ok(table)
}

/// Addresses of the one function whose mangled name holds both parts.
fn function(image: &object::File, part: &str, name: &str) -> Result<Range<u64>> {
    let matches = |symbol: &object::Symbol| {
        let symbol = symbol.name().unwrap_or_default();
        symbol.contains(part) && symbol.contains(name)
    };
    let mut found = image.symbols().filter(|symbol| symbol.size() > 0 && matches(symbol));
    let symbol = found.next().with_context(|| format!("no {name} of {part} in the image"))?;
    ensure!(found.next().is_none(), "several {name} of {part} in the image");
    // The lowest bit of a Thumb function's address says only that it is one.
    let start = symbol.address() & !1;
    Ok(start..start + symbol.size())
}

/// Flash and RAM of the image, and the code of the control core in it.
fn sizes(image: &object::File) -> [(&'static str, u64); 3] {
    let sum = |kinds: &[SectionKind]| {
        let sections = image.sections().filter(|section| kinds.contains(&section.kind()));
        sections.map(|section| section.size()).sum()
    };
    use SectionKind::{Data, ReadOnlyData, ReadOnlyString, Text, UninitializedData};
    let is_core = |symbol: &object::Symbol| {
        let name = symbol.name().unwrap_or_default();
        let is_ours = name.starts_with("_ZN10quasidrive");
        symbol.is_definition() && is_ours && !name.contains("5board") && symbol.size() > 0
    };
    let core = image.symbols().filter(|symbol| is_core(symbol)).map(|symbol| symbol.size()).sum();
    [
        ("image, flash", sum(&[Text, ReadOnlyData, ReadOnlyString, Data])),
        ("image, RAM without stack", sum(&[Data, UninitializedData])),
        ("control core, code", core),
    ]
}

/// The addresses of executed instructions, in order.
struct Trace(Vec<u64>);

impl Trace {
    /// Plays the start of the paper's cycle on a machine and records what runs in `functions`.
    fn record(controller: &str, machine: &str, functions: &[&Range<u64>]) -> Result<Self> {
        let log = root().join("target/firmware/trace.log");
        let filter: Vec<String> = functions
            .iter()
            .map(|range| format!("{:#x}+{:#x}", range.start, range.end - range.start))
            .collect();
        let qemu = ["-singlestep", "-d", "exec,nochain", "-dfilter", &filter.join(","), "-D"];
        let qemu = qemu.map(|argument| format!("--qemu-argument={argument}"));
        cargo(&["run", "--quiet", "--release", "--package", "host-sim", "--"])
            .args(&["run", "host-sim/scenarios/paper.toml", "--duration", DURATION, "--json"])
            .args(&["--controller", controller, "--controller-on", "qemu", "--machine", machine])
            .args(&qemu)
            .args(&[format!("--qemu-argument={}", log.display())])
            .silent()
            .run()?;
        let mut addresses = Vec::new();
        for line in BufReader::new(File::open(&log)?).lines() {
            // Trace 0: 0x7f725c0bfe40 [00800401/00000fb4/00000010/ff000201] name
            let line = line?;
            let address = line.split('/').nth(1).and_then(|hex| u64::from_str_radix(hex, 16).ok());
            addresses.push(address.with_context(|| format!("not a line of a trace: {line}"))?);
        }
        fs::remove_file(&log)?;
        Ok(Self(addresses))
    }

    /// Instructions of each call of `function`, with those of the functions `within` that it calls.
    fn calls(&self, function: &Range<u64>, within: &[&Range<u64>]) -> Vec<u64> {
        let mut calls = Vec::new();
        for address in &self.0 {
            if *address == function.start {
                calls.push(0);
            }
            let counts = within.iter().any(|range| range.contains(address));
            if let (true, Some(call)) = (counts, calls.last_mut()) {
                *call += 1;
            }
        }
        calls
    }
}

/// What differs between two tables by more than the tolerance, a line each.
fn deviations(table: &str, golden: &str) -> Result<String> {
    let rows = |text: &str| -> Vec<(String, Vec<f64>)> {
        text.lines()
            .map(|line| {
                let words: Vec<&str> = line.split_whitespace().collect();
                let numbers = words.iter().rev().map_while(|word| word.parse().ok()).collect();
                let names = words.iter().filter(|word| word.parse::<f64>().is_err());
                (names.copied().collect::<Vec<_>>().join(" "), numbers)
            })
            .collect()
    };
    let (now, then) = (rows(table), rows(golden));
    let names = |rows: &[(String, Vec<f64>)]| -> Vec<String> {
        rows.iter().map(|(name, _)| name.clone()).collect()
    };
    ensure!(names(&now) == names(&then), "{GOLDEN} has other rows: cargo xtask count --rewrite");
    let mut text = String::new();
    for ((name, now), (_, then)) in now.iter().zip(&then) {
        let far = |(now, then): (&f64, &f64)| (now - then).abs() > TOLERANCE * then;
        if now.len() != then.len() || now.iter().zip(then).any(far) {
            writeln!(text, "  {name}: {now:?}, golden {then:?} (last column first)")?;
        }
    }
    Ok(text)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn calls_are_told_apart_and_counted_with_their_callees() {
        let (outer, inner) = (100..120, 200..210);
        let trace = Trace(vec![100, 102, 200, 202, 104, 100, 110, 104]);
        assert_eq!(trace.calls(&outer, &[&outer, &inner]), [5, 3]);
        assert_eq!(trace.calls(&inner, &[&inner]), [2]);
    }

    #[test]
    fn gains_and_losses_beyond_the_tolerance_are_told() {
        let golden = "law  100 100.0 100\nsize 4000\n";
        assert_eq!(deviations("law  102 101.0 104\nsize 3900\n", golden).expect("rows"), "");
        for worse in ["law  100 100.0 106\nsize 4000\n", "law  100 100.0 100\nsize 3700\n"] {
            assert!(!deviations(worse, golden).expect("rows").is_empty(), "{worse}");
        }
        assert!(deviations("law 100 100.0 100\n", golden).is_err(), "a row is missing");
    }
}
