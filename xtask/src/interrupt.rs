//! What the control interrupt can reach, from the release image: no panic, no allocator, nothing unknown; and its stack.
//!
//! Follows every call from the interrupt's handler through the machine code. A call whose target is no known function, or is
//! not in the code, is an error: what cannot be followed is not passed.

use crate::thumb::{Code, Meaning};
use anyhow::{Context, Result, bail, ensure};
use std::collections::BTreeMap;
use std::ops::Range;
use std::path::Path;

/// The handler, as its mangled name has it.
const HANDLER: &str = "5board4qemu5timer";

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

/// Checks an image; says what the interrupt reaches and how much stack it needs.
pub fn check(elf: &Path) -> Result<()> {
    let data = std::fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))?;
    let Reach { functions, stack } = reach(&Code::read(&object::File::parse(&*data)?)?)?;
    println!(
        "The control interrupt reaches {functions} functions, none of which panics or allocates; it needs {stack} bytes of stack."
    );
    Ok(())
}

/// Follows the interrupt; fails where it must not go.
pub fn reach(code: &Code) -> Result<Reach> {
    let handler = code.named(HANDLER)?;
    let mut reached = BTreeMap::new();
    let stack = code.visit(handler, &mut Vec::new(), &mut reached)?;
    Ok(Reach { functions: reached.len(), stack: stack + EXCEPTION_FRAME })
}

/// A function and all that it calls: where each starts and ends.
pub fn called(code: &Code, start: u64) -> Result<Vec<Range<u64>>> {
    let mut reached = BTreeMap::new();
    code.visit(start, &mut Vec::new(), &mut reached)?;
    let function = |start: u64| {
        let (_, last) = code.functions.get(&start)?.instructions.last_key_value()?;
        Some(start..last.address + last.size)
    };
    reached.into_keys().map(|start| function(start).context("an empty function")).collect()
}

impl Code {
    fn named(&self, part: &str) -> Result<u64> {
        let mut found = self.functions.iter().filter(|(_, function)| function.name.contains(part));
        let (&address, _) = found.next().with_context(|| format!("no {part} in the image"))?;
        Ok(address)
    }

    /// Follows a function and what it calls; gives the stack that it needs.
    fn visit(
        &self,
        address: u64,
        path: &mut Vec<u64>,
        reached: &mut BTreeMap<u64, u64>,
    ) -> Result<u64> {
        if let Some(stack) = reached.get(&address) {
            return Ok(*stack);
        }
        let function = self
            .functions
            .get(&address)
            .with_context(|| format!("the interrupt calls {address:#x}, which is no function"))?;
        let name = &function.name;
        if let Some(part) = FORBIDDEN.iter().find(|part| name.contains(*part)) {
            bail!("the interrupt reaches {name} ({part}){}", self.way(path));
        }
        ensure!(!path.contains(&address), "{name} calls itself{}", self.way(path));
        path.push(address);
        let (mut own, mut deepest) = (0, 0);
        for (at, instruction) in &function.instructions {
            match instruction.meaning() {
                Meaning::Plain => {}
                Meaning::Stack(bytes) => own += bytes,
                Meaning::Branch(target) if function.instructions.contains_key(&target) => {}
                Meaning::Branch(target) => {
                    deepest = deepest.max(self.visit(target, path, reached)?)
                }
                Meaning::Unknown => {
                    let way = self.way(path);
                    bail!("{name} goes to an unknown place or takes unknown stack at {at:#x}{way}")
                }
            }
        }
        path.pop();
        let stack = own + deepest;
        reached.insert(address, stack);
        Ok(stack)
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
        let visit = |code: &Code| code.visit(0, &mut Vec::new(), &mut BTreeMap::new());
        let fine = code(&[(0, "handler", caller), (0x100, "leaf", &[0xb082, 0xb002, 0x4770])]);
        assert_eq!(visit(&fine).expect("fine"), 8 + 8);
        let panics = code(&[(0, "handler", caller), (0x100, "core9panicking", &[0x4770])]);
        let error = visit(&panics).expect_err("a panic").to_string();
        assert!(error.contains("core9panicking") && error.contains("from handler"), "{error}");
        assert!(visit(&code(&[(0, "handler", caller)])).is_err(), "no function there");
        let indirect = code(&[(0, "handler", caller), (0x100, "leaf", &[0x4798, 0x4770])]);
        assert!(visit(&indirect).is_err(), "an indirect call");
        // bl to itself
        let recursive = code(&[(0, "handler", &[0xf7ff, 0xfffe])]);
        assert!(visit(&recursive).is_ok(), "a loop within a function is none");
    }
}
