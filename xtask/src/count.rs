//! Executed instructions of the control step on an emulated Cortex-M, counted one by one in QEMU's log; those of the B-G431B-ESC1's whole
//! control interrupt, counted by the emulated board as it runs the image that is flashed; and the images' size.
//!
//! QEMU runs one instruction at a time and logs the address of each one in the counted functions, while the drive runs the
//! start of the paper's cycle in closed loop. The numbers are exact and repeatable; one that is skipped inside an IT block
//! counts as one. A function of known length shows that none is missed. Cycles are a model's ([`crate::cycles`]), for the
//! Cortex-M4F only: a Cortex-M7 runs two instructions at a time, which no table tells.

use crate::boards::{self, Board};
use crate::cross::Cross;
use crate::cycles::cycles;
use crate::debug_info::DebugInfo;
use crate::interrupt;
use crate::shell::{cargo, joined, root};
use crate::size::Size;
use crate::thumb::{Code, Meaning};
use anyhow::{Context, Result, bail, ensure};
use object::{Object, ObjectSymbol, SymbolKind};
use serde_json::Value;
use std::collections::BTreeSet;
use std::fmt::Write;
use std::fs::{self, File};
use std::io::{BufRead, BufReader};
use std::ops::Range;
use std::path::Path;
use std::thread;

/// Simulated time that is counted (s): 1000 periods with the steepest transient.
const DURATION: &str = "0.05";

/// Largest deviation from the golden table that is not looked into, either way.
const TOLERANCE: f64 = 0.05;

/// The same on the emulated board (s): 20 000 periods, through the start of the motor and its first speed.
const BOARD_DURATION: &str = "1";

/// Number of the B-G431B-ESC1's control interrupt, ADC1_2, and cycles of the core in its PWM period.
const CONTROL: u64 = 18;
const PERIOD: f64 = 8496.0;

const GOLDEN: &str = "xtask/counts.txt";

/// The sources of what the two estimators are made of.
const ESTIMATORS: [&str; 3] =
    ["src/control/paper/estimator.rs", "src/control/paper/channel.rs", "src/control/injection.rs"];

/// Parts of the names of functions for floating point and long integers, on cores that have no instructions for them.
const RUNTIME: [&str; 10] = [
    "5float",
    "__aeabi_f",
    "__aeabi_cf",
    "__aeabi_i2f",
    "__aeabi_l",
    "libm",
    "fmaximum",
    "fminimum",
    "__divmoddi4",
    "u64_div_rem",
];

/// Fixed point, as the debug information has it.
const FIXED: &str = "quasidrive::math::fixed::Q31";

/// A core that is counted on.
struct Core {
    name: &'static str,
    machine: &'static str,
    board: &'static Board,
    has_cycles: bool,
}

const CORES: [Core; 4] = [
    Core { name: "Cortex-M4F", machine: "mps2-an386", board: &boards::QEMU, has_cycles: true },
    Core { name: "Cortex-M7", machine: "mps2-an500", board: &boards::QEMU, has_cycles: false },
    Core { name: "Cortex-M3", machine: "mps2-an385", board: &boards::QEMU_M3, has_cycles: false },
    Core { name: "Cortex-M0", machine: "microbit", board: &boards::QEMU_M0, has_cycles: false },
];

/// The law that is counted apart of the rest of its controller's step.
#[derive(Clone, Copy, PartialEq)]
enum LawCounted {
    Paper,
    DriveForm,
}

/// Controllers, the scenarios that they play, and their laws.
const CONTROLLERS: [(&str, &str, Option<LawCounted>); 7] = [
    ("bs", "paper", Some(LawCounted::Paper)),
    ("bs-qsmdo", "paper", Some(LawCounted::Paper)),
    ("bs-qismc", "paper", Some(LawCounted::Paper)),
    ("drive-qsmdo", "encoder", Some(LawCounted::DriveForm)),
    ("drive-qismc", "encoder", Some(LawCounted::DriveForm)),
    ("pi", "encoder", None),
    ("ladrc", "encoder", None),
];

/// Builds the firmware, counts and prints; compares with the golden table, or rewrites it.
pub fn count(cross: &Cross, rewrite: bool) -> Result<()> {
    let compiler = cross.compiler()?;
    let table = format!("{compiler}\n\n{}", table(cross)?);
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

fn table(cross: &Cross) -> Result<String> {
    let mut table = String::from(
        "executed instructions, and cycles of the dearest call (a model, about ±15 %)\n",
    );
    writeln!(table, "{:<43} {:>5} {:>7} {:>7} {:>7}", "", "min", "mean", "max", "cycles")?;
    for core in &CORES {
        cross.firmware(core.board)?;
    }
    thread::scope(|scope| {
        let cores = CORES.each_ref().map(|core| scope.spawn(|| instructions(core)));
        for rows in cores {
            table.push_str(&joined(rows.join())?);
        }
        anyhow::Ok(())
    })?;
    cross.firmware(&boards::B_G431B_ESC1)?;
    control_interrupt(&mut table)?;
    for (board, scalar) in
        [(&boards::QEMU, "f32"), (&boards::QEMU_M3, FIXED), (&boards::QEMU_M0, FIXED)]
    {
        writeln!(table, "\nbytes, {}", board.name)?;
        let data = read(&cross.firmware(board)?)?;
        let elf = object::File::parse(&*data)?;
        let code = Code::read(&elf)?;
        let name = format!("Drive<{scalar}>");
        let size = DebugInfo::read(&elf)?.size_of(&name)?;
        let state = ("control core, state: Drive", size);
        let stack = ("control interrupt, stack", interrupt::reach(&code, board)?.stack);
        for (name, bytes) in sizes(&elf).into_iter().chain([state, stack]) {
            writeln!(table, "{name:<43} {bytes:>5}")?;
        }
    }
    Ok(table)
}

fn read(elf: &Path) -> Result<Vec<u8>> {
    fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))
}

/// The rows of a core, whose firmware is built.
fn instructions(core: &Core) -> Result<String> {
    let mut table = String::new();
    let data = read(&core.board.image())?;
    let image = &object::File::parse(&*data)?;
    let calibration = function(image, "5board4qemu", "11calibration")?;
    let step = function(image, "5drive", "Drive$LT$S$GT$4step")?;
    let paper = function(image, "7control5paper", "Paper$LT$S$GT$7control")?;
    let drive_form = function(image, "7control10drive_form", "DriveForm$LT$S$GT$4step")?;

    // A straight line of a hundred and a few instructions of two bytes each.
    let known = (calibration.end - calibration.start) / 2;
    ensure!((100..110).contains(&known), "the calibration has {known} instructions");

    let code = Code::read(image)?;
    let estimators = estimators(&code, &DebugInfo::read(image)?, &paper)?;
    // They are for configuration, where they would fill the log; one that the step called would be missed and refused.
    let is_runtime = |range: &Range<u64>| {
        let function = code.functions.get(&range.start);
        function.is_some_and(|function| RUNTIME.iter().any(|part| function.name.contains(part)))
    };
    let mut in_step = interrupt::called(&code, step.start)?;
    in_step.retain(|range| !is_runtime(range));
    for (controller, scenario, law) in CONTROLLERS {
        let counted: Vec<&Range<u64>> = in_step.iter().chain([&calibration]).collect();
        let trace = Trace::record(controller, scenario, core, &counted, &code)?;
        let calls = trace.calls(&calibration, |address| calibration.contains(&address));
        ensure!(
            matches!(calls[..], [Cost { instructions, .. }] if instructions == known),
            "the calibration ran {calls:?}, not {known} instructions once"
        );
        let mut row = |what: &str, calls: Vec<Cost>| -> Result<()> {
            let row = row(&calls, core.has_cycles)?;
            writeln!(table, "{:<43} {row}", format!("{} {controller} {what}", core.name))?;
            Ok(())
        };
        if let Some(law) = law {
            let start = match law {
                LawCounted::Paper => &paper,
                LawCounted::DriveForm => &drive_form,
            };
            // With what it calls: products and quotients where the core has none.
            let in_law = interrupt::called(&code, start.start)?;
            let is_in_law = |address| in_law.iter().any(|range| range.contains(&address));
            row("law", trace.calls(start, is_in_law))?;
        }
        if law == Some(LawCounted::Paper) {
            let share = trace.calls(&paper, |address| estimators.contains(&address));
            row("estimators in it", share)?;
        }
        let is_in_step = |address| in_step.iter().any(|range| range.contains(&address));
        row("Drive::step", trace.calls(&step, is_in_step))?;
    }
    Ok(table)
}

/// The numbers of a row of the table.
fn row(calls: &[Cost], has_cycles: bool) -> Result<String> {
    let instructions = || calls.iter().map(|call| call.instructions);
    let (min, max) = (instructions().min(), instructions().max());
    let (min, max) = min.zip(max).context("no call was counted")?;
    let mean = instructions().sum::<u64>() as f64 / calls.len() as f64;
    let dearest = calls.iter().map(|call| call.cycles).max().filter(|_| has_cycles);
    let cycles = dearest.map(|cycles| format!(" {cycles:>7}")).unwrap_or_default();
    Ok(format!("{min:>5} {mean:>7.1} {max:>7}{cycles}"))
}

/// The control interrupt of the image that is flashed, with the motor driven: what `host-sim board` counts and estimates.
fn control_interrupt(table: &mut String) -> Result<()> {
    let played = cargo(&["run", "--quiet", "--package", "host-sim", "--"])
        .args(&["board", "host-sim/scenarios/esc1.toml", "--duration", BOARD_DURATION, "--json"])
        .read()?;
    let played: Value = serde_json::from_str(&played)?;
    let interrupts = played["summary"]["interrupts"].as_array().context("no interrupts")?;
    let control = interrupts.iter().find(|one| one["number"] == CONTROL);
    let control = control.context("the control interrupt never came")?;
    let spread = |what: &str| -> Result<[f64; 3]> {
        let spread = serde_json::from_value(control[what].clone());
        spread.with_context(|| format!("no {what} of the control interrupt"))
    };
    let cycles = spread("estimated_cycles")?;
    writeln!(
        table,
        "\nB-G431B-ESC1's control interrupt, as flashed, on the emulated board; cycles are estimates"
    )?;
    writeln!(table, "{:<43} {:>5} {:>7} {:>7}", "", "min", "mean", "max")?;
    let share = cycles.map(|cycles| 100.0 * cycles / PERIOD);
    for (what, [min, mean, max], digits) in [
        ("instructions", spread("instructions")?, 0),
        ("cycles, estimated", cycles, 0),
        ("share of a period (%), estimated", share, 1),
    ] {
        writeln!(table, "{what:<43} {min:>5.digits$} {mean:>7.1} {max:>7.digits$}")?;
    }
    Ok(())
}

/// Addresses of the instructions in a function and what it calls that are from the estimators, as the compiler attributes them: one that serves
/// two places is attributed to one.
fn estimators(code: &Code, debug_info: &DebugInfo, function: &Range<u64>) -> Result<BTreeSet<u64>> {
    let mut estimators = BTreeSet::new();
    let mut missing = BTreeSet::from(ESTIMATORS);
    let law = interrupt::called(code, function.start)?;
    let functions = law.iter().filter_map(|range| code.functions.get(&range.start));
    for address in functions.flat_map(|function| function.instructions.keys()) {
        for source in debug_info.sources(*address)? {
            if let Some(file) = ESTIMATORS.iter().find(|file| source.ends_with(*file)) {
                estimators.insert(*address);
                missing.remove(file);
            }
        }
    }
    ensure!(missing.is_empty(), "no instruction of the law is from {missing:?}");
    Ok(estimators)
}

/// Addresses of the one function whose mangled name holds both parts.
fn function(image: &object::File, part: &str, name: &str) -> Result<Range<u64>> {
    let matches = |symbol: &object::Symbol| {
        let symbol = symbol.name().unwrap_or_default();
        symbol.contains(part) && symbol.contains(name)
    };
    let mut found =
        image.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text && matches(symbol));
    let symbol = found.next().with_context(|| format!("no {name} of {part} in the image"))?;
    ensure!(found.next().is_none(), "several {name} of {part} in the image");
    // The lowest bit of a Thumb function's address says only that it is one.
    let start = symbol.address() & !1;
    Ok(start..start + symbol.size())
}

/// Flash and RAM of the image, and the code of the control core in it.
fn sizes(image: &object::File) -> [(&'static str, u64); 3] {
    let Size { flash, data } = Size::of(image);
    let is_core = |symbol: &object::Symbol| {
        let name = symbol.name().unwrap_or_default();
        let is_ours = name.starts_with("_ZN10quasidrive");
        symbol.is_definition() && is_ours && !name.contains("5board") && symbol.size() > 0
    };
    let core = image.symbols().filter(|symbol| is_core(symbol)).map(|symbol| symbol.size()).sum();
    [("image, flash", flash), ("image, RAM without stack", data), ("control core, code", core)]
}

/// What a call or an instruction costs.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
struct Cost {
    instructions: u64,
    /// Modelled.
    cycles: u64,
}

/// The addresses of executed instructions, in order, and their modelled cycles.
struct Trace(Vec<(u64, u64)>);

impl Trace {
    /// Plays the start of a scenario on a machine and records what runs in `functions`.
    fn record(
        controller: &str,
        scenario: &str,
        core: &Core,
        functions: &[&Range<u64>],
        code: &Code,
    ) -> Result<Self> {
        let log = root().join(format!("target/firmware/trace-{}.log", core.machine));
        let filter: Vec<String> = functions
            .iter()
            .map(|range| format!("{:#x}+{:#x}", range.start, range.end - range.start))
            .collect();
        let qemu = ["-singlestep", "-d", "exec,nochain", "-dfilter", &filter.join(","), "-D"];
        let qemu = qemu.map(|argument| format!("--qemu-argument={argument}"));
        cargo(&["run", "--quiet", "--package", "host-sim", "--"])
            .args(&["run", &format!("host-sim/scenarios/{scenario}.toml")])
            .args(&["--duration", DURATION, "--json"])
            .args(&["--controller", controller, "--controller-on", "qemu"])
            .args(&["--machine", core.machine])
            .args(&qemu)
            .args(&[format!("--qemu-argument={}", log.display())])
            .silent()
            .run()?;
        let mut addresses = Vec::new();
        for line in BufReader::new(File::open(&log)?).lines() {
            addresses.push(address(&line?)?);
        }
        fs::remove_file(&log)?;
        all_is_counted(&addresses, functions, code)?;
        let cycles = match core.has_cycles {
            true => cycles(code, &addresses)?,
            false => vec![0; addresses.len()],
        };
        Ok(Self(addresses.into_iter().zip(cycles).collect()))
    }

    /// What each call of `function` costs, as far as `is_counted`.
    fn calls(&self, function: &Range<u64>, is_counted: impl Fn(u64) -> bool) -> Vec<Cost> {
        let mut calls = Vec::new();
        for (address, cycles) in &self.0 {
            if *address == function.start {
                calls.push(Cost::default());
            }
            if let (true, Some(call)) = (is_counted(*address), calls.last_mut()) {
                call.instructions += 1;
                call.cycles += cycles;
            }
        }
        calls
    }
}

/// The address in a line of QEMU's log: `Trace 0: 0x7f725c0bfe40 [00800401/00000fb4/00000010/ff000201] name`.
fn address(line: &str) -> Result<u64> {
    let address = line.split('/').nth(1).and_then(|hex| u64::from_str_radix(hex, 16).ok());
    address.with_context(|| format!("not a line of a trace: {line}"))
}

/// Fails if what was executed called a function that is not counted.
fn all_is_counted(executed: &[u64], functions: &[&Range<u64>], code: &Code) -> Result<()> {
    for (address, next) in executed.iter().zip(executed.iter().skip(1)) {
        let instruction = code.at(*address)?;
        let leaves = match instruction.meaning() {
            Meaning::Branch(target) => !functions.iter().any(|range| range.contains(&target)),
            Meaning::Unknown => true,
            Meaning::Plain | Meaning::Stack(_) => false,
        };
        // A branch that is not taken goes nowhere; a call comes back to the next.
        let is_taken = instruction.name.starts_with("bl") || *next != instruction.end();
        ensure!(!(leaves && is_taken), "what {address:#x} calls is not counted");
    }
    Ok(())
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
    use crate::thumb::tests::code;

    #[test]
    fn lines_of_a_trace_are_read() {
        let line = "Trace 0: 0x7f725c0bfe40 [00800401/00000fb4/00000010/ff000201] step";
        assert_eq!(address(line).expect("an address"), 0xfb4);
        assert!(address("Stopped execution of TB chain before 0x7f725c0bfe40").is_err());
    }

    #[test]
    fn a_call_that_is_not_counted_is_refused() {
        // beq.w to 0x100; bl to 0x200; bx lr
        let code = code(&[(0, "caller", &[0xf000, 0x807e, 0xf000, 0xf8fc, 0x4770])]);
        let counted =
            |executed: &[u64]| all_is_counted(executed, &[&(0..10), &(0x200..0x210)], &code);
        assert!(counted(&[0, 4]).is_ok(), "not taken");
        assert!(counted(&[0, 8]).is_err(), "taken, not counted, back at 8");
        assert!(counted(&[4, 0x200]).is_ok(), "counted");
        let only_caller = all_is_counted(&[4, 8], &[&(0..10)], &code);
        assert!(only_caller.is_err(), "a call that comes back");
    }

    #[test]
    fn calls_are_told_apart_and_counted_with_their_callees() {
        let (outer, inner) = (100..120, 200..210);
        let trace = [100, 102, 200, 202, 104, 100, 110, 104].map(|address| (address, 2));
        let trace = Trace(trace.into());
        let cost = |instructions| Cost { instructions, cycles: 2 * instructions };
        let both = |address| outer.contains(&address) || inner.contains(&address);
        assert_eq!(trace.calls(&outer, both), [cost(5), cost(3)]);
        assert_eq!(trace.calls(&inner, |address| inner.contains(&address)), [cost(2)]);
        assert_eq!(trace.calls(&outer, |address| address == 202), [cost(1), cost(0)]);
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
