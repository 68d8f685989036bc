//! What a board's control interrupt can reach, from the release image: no panic, no allocator, nothing unknown; its stack; and that
//! what runs in every period lies in fast memory, where there is some.
//!
//! Follows every call from the interrupt's handler through the machine code. A call whose target is no known function, or is
//! not in the code, is an error: what cannot be followed is not passed.

use crate::boards::Board;
use crate::thumb::{Code, Meaning};
use anyhow::{Context, Result, bail, ensure};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// Parts of names that the interrupt must not reach.
const FORBIDDEN: [&str; 6] =
    ["panicking", "panic_", "rust_begin_unwind", "unwrap_failed", "rust_alloc", "5alloc"];

/// Stack that the core itself takes for an exception, with the floating-point registers (ARMv7-M, B1.5.7): 26 words, and one
/// more to align it.
const EXCEPTION_FRAME: u64 = 4 * 27;

/// What the interrupt reaches.
pub struct Reach {
    functions: usize,
    /// All the stack that it needs (bytes).
    pub stack: u64,
}

/// What the linker puts before the name of a function that is too far for a branch.
const VENEER: &str = "__Thumbv7ABSLongThunk_";

/// Checks an image; says what the interrupt reaches and how much stack it needs.
pub fn check(board: &Board, elf: &Path) -> Result<()> {
    let data = std::fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))?;
    let code = Code::read(&object::File::parse(&*data)?)?;
    let Reach { functions, stack } = reach(&code, board)?;
    println!(
        "{}: the control interrupt reaches {functions} functions, none of which panics or allocates; it needs {stack} bytes of stack.",
        elf.display()
    );
    Ok(())
}

/// Follows the interrupt; fails where it must not go.
pub fn reach(code: &Code, board: &Board) -> Result<Reach> {
    let handler = code.named(board.handler)?;
    let mut walk = Walk { fast: Some(memory(handler)), ..Walk::new(code, board.cold) };
    let stack = walk.visit(handler)?;
    Ok(Reach { functions: walk.reached.len(), stack: stack + EXCEPTION_FRAME })
}

/// A function and all that it calls: where each starts and ends.
pub fn called(code: &Code, start: u64) -> Result<Vec<Range<u64>>> {
    let mut walk = Walk::new(code, &[]);
    walk.visit(start)?;
    let function = |start: u64| {
        let (_, last) = code.functions.get(&start)?.instructions.last_key_value()?;
        Some(start..last.address + last.size)
    };
    walk.reached.into_keys().map(|start| function(start).context("an empty function")).collect()
}

/// Which of a microcontroller's memories an address is in.
fn memory(address: u64) -> u64 {
    address >> 24
}

/// A way through the code.
struct Walk<'a> {
    code: &'a Code,
    /// The memory that must not be left, but for what is cold.
    fast: Option<u64>,
    /// Parts of the names of what is.
    cold: &'a [&'a str],
    path: Vec<u64>,
    /// The functions that were visited, and the stack that each needs.
    reached: BTreeMap<u64, u64>,
}

impl<'a> Walk<'a> {
    fn new(code: &'a Code, cold: &'a [&'a str]) -> Self {
        Self { code, fast: None, cold, path: Vec::new(), reached: BTreeMap::new() }
    }

    /// Follows a function and what it calls; gives the stack that it needs.
    fn visit(&mut self, address: u64) -> Result<u64> {
        if let Some(stack) = self.reached.get(&address) {
            return Ok(*stack);
        }
        let (path, code) = (&self.path, self.code);
        let function = code
            .functions
            .get(&address)
            .with_context(|| format!("the interrupt calls {address:#x}, which is no function"))?;
        let name = &function.name;
        if let Some(part) = FORBIDDEN.iter().find(|part| name.contains(*part)) {
            bail!("the interrupt reaches {name} ({part}){}", code.way(path));
        }
        ensure!(!path.contains(&address), "{name} calls itself{}", code.way(path));
        if let Some(far) = name.strip_prefix(VENEER) {
            let target = code.named(far)?;
            let leaves = Some(memory(address)) == self.fast && Some(memory(target)) != self.fast;
            let is_cold = self.cold.iter().any(|part| far.contains(part));
            ensure!(!leaves || is_cold, "{far} is not in the interrupt's memory{}", code.way(path));
            return self.visit(target);
        }
        self.path.push(address);
        let (mut own, mut deepest) = (0, 0);
        for (at, instruction) in &function.instructions {
            match instruction.meaning() {
                Meaning::Plain => {}
                Meaning::Stack(bytes) => own += bytes,
                Meaning::Branch(target) if function.instructions.contains_key(&target) => {}
                Meaning::Branch(target) => deepest = deepest.max(self.visit(target)?),
                Meaning::Unknown => {
                    let way = code.way(&self.path);
                    bail!("{name} goes to an unknown place or takes unknown stack at {at:#x}{way}")
                }
            }
        }
        self.path.pop();
        let stack = own + deepest;
        self.reached.insert(address, stack);
        Ok(stack)
    }
}

impl Code {
    /// The function with this in its name, and not in a veneer's.
    fn named(&self, part: &str) -> Result<u64> {
        let is_it = |name: &str| name.contains(part) && !name.starts_with(VENEER);
        let mut found = self.functions.iter().filter(|(_, function)| is_it(&function.name));
        let (&address, _) = found.next().with_context(|| format!("no {part} in the image"))?;
        Ok(address)
    }

    fn way(&self, path: &[u64]) -> String {
        let names = path.iter().filter_map(|address| self.functions.get(address));
        names.rev().map(|function| format!("\n  from {}", function.name)).collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::thumb::tests::code;

    #[test]
    fn a_panic_an_unknown_target_and_an_unknown_way_are_refused() {
        // push {r7, lr}; bl +0xfa (to 0x100); pop {r7, pc}
        let caller: &[u16] = &[0xb580, 0xf000, 0xf87d, 0xbd80];
        let visit = |code: &Code| Walk::new(code, &[]).visit(0);
        let fine = code(&[(0, "handler", caller), (0x100, "leaf", &[0xb082, 0xb002, 0x4770])]);
        assert_eq!(visit(&fine).expect("fine"), 8 + 8);
        let panics = code(&[(0, "handler", caller), (0x100, "core9panicking", &[0x4770])]);
        let error = visit(&panics).expect_err("a panic").to_string();
        assert!(error.contains("core9panicking") && error.contains("from handler"), "{error}");
        assert!(visit(&code(&[(0, "handler", caller)])).is_err(), "no function there");
        let indirect = code(&[(0, "handler", caller), (0x100, "leaf", &[0x4798, 0x4770])]);
        assert!(visit(&indirect).is_err(), "an indirect call");
        // A veneer to a function in another memory.
        for (far, passes) in [("cold_one", true), ("another", false)] {
            let veneer = format!("{VENEER}{far}");
            let functions: [(u64, &str, &[u16]); 3] = [
                (0, "handler", caller),
                (0x100, &veneer, &[0x4760]),
                (0x0800_0000, far, &[0xb082, 0xb002, 0x4770]),
            ];
            let code = code(&functions);
            let stack = Walk { fast: Some(0), ..Walk::new(&code, &["cold"]) }.visit(0);
            assert_eq!(stack.ok(), passes.then_some(8 + 8), "{far}");
        }
        // bl to itself
        let recursive = code(&[(0, "handler", &[0xf7ff, 0xfffe])]);
        assert!(visit(&recursive).is_ok(), "a loop within a function is none");
    }
}
