//! What the control interrupt can reach, from the release image: no panic, no allocator, nothing unknown; and its stack.
//!
//! Follows every call from the interrupt's handler through the machine code (Thumb-2, encodings after the ARMv7-M
//! Architecture Reference Manual, A5–A7). A call whose target is no known function, or is not in the code, is an error: what
//! cannot be followed is not passed.

use anyhow::{Context, Result, bail, ensure};
use object::{Object, ObjectSection, ObjectSymbol};
use std::collections::BTreeMap;
use std::path::Path;

/// The handler, as its mangled name has it.
const HANDLER: &str = "5board4qemu6timer0";

/// Parts of names that the interrupt must not reach.
const FORBIDDEN: [&str; 6] =
    ["panicking", "panic_", "rust_begin_unwind", "unwrap_failed", "rust_alloc", "5alloc"];

/// Stack that the core itself takes for an exception, with the floating-point registers (ARMv7-M, B1.5.7): 26 words, and one
/// more to align it.
const EXCEPTION_FRAME: u64 = 4 * 27;

/// Checks an image; says what the interrupt reaches and how much stack it needs.
pub fn check(elf: &Path) -> Result<()> {
    let data = std::fs::read(elf).with_context(|| format!("cannot read {}", elf.display()))?;
    let code = Code::read(&object::File::parse(&*data)?)?;
    let handler = code.named(HANDLER)?;
    let mut reached = BTreeMap::new();
    let stack = code.visit(handler, &mut Vec::new(), &mut reached)?;
    println!(
        "The control interrupt reaches {} functions, none of which panics or allocates; it needs {} bytes of stack.",
        reached.len(),
        stack + EXCEPTION_FRAME
    );
    Ok(())
}

/// An image's functions.
struct Code {
    functions: BTreeMap<u64, Function>,
}

struct Function {
    name: String,
    /// Half-words of code, by address; literal pools left out.
    halfwords: BTreeMap<u64, u16>,
}

/// What one instruction means here.
#[derive(Debug, PartialEq)]
enum Meaning {
    /// Goes on with the next.
    Plain,
    /// Takes stack (bytes).
    Stack(u64),
    /// May go to an address.
    Branch(u64),
    /// Goes where no address tells.
    Indirect,
}

impl Code {
    fn read(image: &object::File) -> Result<Self> {
        let text = image.section_by_name(".text").context("no .text in the image")?;
        let bytes = text.data()?;
        // Where code ($t) and data ($d) begin.
        let mut kinds = BTreeMap::new();
        for symbol in image.symbols() {
            match symbol.name().unwrap_or_default() {
                name if name.starts_with("$t") => kinds.insert(symbol.address(), true),
                name if name.starts_with("$d") => kinds.insert(symbol.address(), false),
                _ => None,
            };
        }
        ensure!(!kinds.is_empty(), "no mapping symbols in the image");
        let is_code =
            |address: u64| kinds.range(..=address).next_back().is_some_and(|(_, code)| *code);
        let mut functions = BTreeMap::new();
        for symbol in image.symbols().filter(|symbol| symbol.kind() == object::SymbolKind::Text) {
            let start = symbol.address() & !1;
            if symbol.size() == 0 || start < text.address() {
                continue;
            }
            let halfword = |address: u64| -> Option<(u64, u16)> {
                let offset = (address - text.address()) as usize;
                let pair = bytes.get(offset..offset + 2)?;
                Some((address, u16::from_le_bytes([pair[0], pair[1]])))
            };
            let addresses = (start..start + symbol.size()).step_by(2).filter(|a| is_code(*a));
            let halfwords = addresses.filter_map(halfword).collect();
            let name = symbol.name().unwrap_or_default().to_owned();
            functions.insert(start, Function { name, halfwords });
        }
        Ok(Self { functions })
    }

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
        for (at, meaning) in function.instructions()? {
            match meaning {
                Meaning::Plain => {}
                Meaning::Stack(bytes) => own += bytes,
                Meaning::Branch(target) if function.halfwords.contains_key(&target) => {}
                Meaning::Branch(target) => {
                    deepest = deepest.max(self.visit(target, path, reached)?)
                }
                Meaning::Indirect => {
                    bail!("{name} goes to an unknown place at {at:#x}{}", self.way(path))
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

impl Function {
    fn instructions(&self) -> Result<Vec<(u64, Meaning)>> {
        let mut instructions = Vec::new();
        let mut next = 0;
        for (&at, &first) in &self.halfwords {
            if at < next {
                continue;
            }
            // 0b11101, 0b11110 and 0b11111 begin an instruction of two half-words.
            if first >= 0xe800 {
                let second = self.halfwords.get(&(at + 2));
                let second = *second.with_context(|| format!("half an instruction at {at:#x}"))?;
                instructions.push((at, wide(at, first, second)));
                next = at + 4;
            } else {
                instructions.push((at, narrow(at, first)));
                next = at + 2;
            }
        }
        Ok(instructions)
    }
}

/// Sign-extends the lowest `bits` bits.
fn signed(value: u32, bits: u32) -> i64 {
    i64::from((value << (32 - bits)) as i32 >> (32 - bits))
}

fn target(at: u64, offset: i64) -> Meaning {
    Meaning::Branch(at.wrapping_add(4).wrapping_add_signed(offset))
}

fn narrow(at: u64, code: u16) -> Meaning {
    let code = u32::from(code);
    match code {
        // BX LR returns; BX, BLX and MOV to PC of anything else go somewhere.
        0x4770 => Meaning::Plain,
        0x4700..=0x47ff => Meaning::Indirect,
        _ if code & 0xff87 == 0x4687 || code & 0xff87 == 0x4487 => Meaning::Indirect,
        // PUSH
        0xb400..=0xb5ff => Meaning::Stack(4 * u64::from((code & 0x1ff).count_ones())),
        // SUB SP
        0xb080..=0xb0ff => Meaning::Stack(4 * u64::from(code & 0x7f)),
        // CBZ, CBNZ
        _ if code & 0xf500 == 0xb100 => {
            target(at, i64::from((code >> 9 & 1) << 6 | (code >> 3 & 0x1f) << 1))
        }
        // B with a condition, and without
        0xd000..=0xddff => target(at, signed((code & 0xff) << 1, 9)),
        0xe000..=0xe7ff => target(at, signed((code & 0x7ff) << 1, 12)),
        _ => Meaning::Plain,
    }
}

fn wide(at: u64, first: u16, second: u16) -> Meaning {
    let (first, second) = (u32::from(first), u32::from(second));
    if first & 0xf800 == 0xf000 && second & 0x8000 != 0 {
        let s = first >> 10 & 1;
        let (j1, j2) = (second >> 13 & 1, second >> 11 & 1);
        if second & 0x1000 != 0 {
            // B.W (T4) and BL (T1)
            let (i1, i2) = (1 ^ j1 ^ s, 1 ^ j2 ^ s);
            let offset =
                s << 24 | i1 << 23 | i2 << 22 | (first & 0x3ff) << 12 | (second & 0x7ff) << 1;
            return target(at, signed(offset, 25));
        }
        if second & 0x4000 != 0 {
            // BLX (T2) to code of another instruction set, which these cores do not have
            return Meaning::Indirect;
        }
        if first >> 7 & 7 != 7 {
            // B.W with a condition (T3)
            let offset =
                s << 20 | j2 << 19 | j1 << 18 | (first & 0x3f) << 12 | (second & 0x7ff) << 1;
            return target(at, signed(offset, 21));
        }
        return Meaning::Plain;
    }
    let loads_pc = second >> 12 == 15;
    match (first, second) {
        // PUSH.W; one register
        (0xe92d, _) => Meaning::Stack(4 * u64::from(second.count_ones())),
        (0xf84d, _) if second & 0x0fff == 0x0d04 => Meaning::Stack(4),
        // VPUSH
        (0xed2d | 0xed6d, _) if second & 0x0e00 == 0x0a00 => {
            Meaning::Stack(4 * u64::from(second & 0xff))
        }
        // SUB.W SP, SP of an immediate: small ones only are plain numbers
        (0xf1ad, _) if second & 0x7f00 == 0x0d00 => Meaning::Stack(u64::from(second & 0xff)),
        (0xf1ad | 0xf5ad | 0xf2ad | 0xf6ad, _) if second & 0x0f00 == 0x0d00 => Meaning::Indirect,
        // LDR PC; a table branch stays within its function, but its targets are not read here
        (0xf850..=0xf85f | 0xf8d0..=0xf8df, _) if loads_pc && second != 0xfb04 => Meaning::Indirect,
        (0xe8d0..=0xe8df, _) if second & 0xffe0 == 0xf000 => Meaning::Plain,
        _ => Meaning::Plain,
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn branches_are_decoded() {
        // As disassembled: bl -4 (to itself), b.n +4, beq.n -2, cbz +2, b.w +0x100, bne.w -0x100.
        assert_eq!(wide(0x100, 0xf7ff, 0xfffe), Meaning::Branch(0x100));
        assert_eq!(narrow(0x100, 0xe002), Meaning::Branch(0x108));
        assert_eq!(narrow(0x100, 0xd0fe), Meaning::Branch(0x100));
        assert_eq!(narrow(0x100, 0xb108), Meaning::Branch(0x106));
        assert_eq!(wide(0x1000, 0xf000, 0xb87e), Meaning::Branch(0x1100));
        assert_eq!(wide(0x1000, 0xf47f, 0xaf7e), Meaning::Branch(0xf00));
        assert_eq!(narrow(0x100, 0x4770), Meaning::Plain);
        assert_eq!(narrow(0x100, 0x4798), Meaning::Indirect);
    }

    #[test]
    fn stack_is_counted() {
        assert_eq!(narrow(0, 0xb5f0), Meaning::Stack(20));
        assert_eq!(narrow(0, 0xb08e), Meaning::Stack(56));
        assert_eq!(wide(0, 0xe92d, 0x4ff0), Meaning::Stack(36));
        assert_eq!(wide(0, 0xf84d, 0x8d04), Meaning::Stack(4));
        assert_eq!(wide(0, 0xed2d, 0x8b02), Meaning::Stack(8));
    }

    fn code(functions: &[(u64, &str, &[u16])]) -> Code {
        let function = |&(start, name, words): &(u64, &str, &[u16])| {
            let halfwords = words.iter().zip((start..).step_by(2)).map(|(&word, at)| (at, word));
            (start, Function { name: name.to_owned(), halfwords: halfwords.collect() })
        };
        Code { functions: functions.iter().map(function).collect() }
    }

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
