//! An image's functions and their instructions (Thumb-2 with floating point), decoded by Capstone, and what an instruction
//! means for who follows the code.

use Operand::{Immediate, Memory, Register};
use anyhow::{Context, Result, anyhow, ensure};
use capstone::Capstone;
use capstone::arch::arm::{ArchExtraMode, ArchMode, ArmOperandType};
use capstone::prelude::*;
use object::{Object, ObjectSection, ObjectSymbol, SectionKind, SymbolKind};
use std::collections::BTreeMap;
use std::ops::Range;

/// An image's functions, by address.
pub struct Code {
    pub functions: BTreeMap<u64, Function>,
}

pub struct Function {
    pub name: String,
    /// By address; literal pools left out.
    pub instructions: BTreeMap<u64, Instruction>,
}

pub struct Instruction {
    pub address: u64,
    pub size: u64,
    /// Capstone's: without width or condition.
    pub name: String,
    pub operands: Vec<Operand>,
    pub reads: Vec<String>,
    pub writes: Vec<String>,
    /// Whether a load or store changes its base register.
    pub writes_back: bool,
}

pub enum Operand {
    Register(String),
    Immediate(i64),
    Memory { base: String, index: Option<String>, offset: i64 },
    Other,
}

/// What one instruction means for who follows the code.
#[derive(Debug, PartialEq)]
pub enum Meaning {
    /// Goes on with the next, or returns.
    Plain,
    /// Takes stack (bytes).
    Stack(u64),
    /// May go to an address.
    Branch(u64),
    /// Goes where no address tells, or takes stack that no number tells.
    Unknown,
}

impl Code {
    pub fn read(image: &object::File) -> Result<Self> {
        let decoder = Decoder::new()?;
        let executable = image.sections().filter(|section| section.kind() == SectionKind::Text);
        let sections: Vec<(u64, &[u8])> = executable
            .map(|section| Ok((section.address(), section.data()?)))
            .collect::<Result<_>>()?;
        ensure!(!sections.is_empty(), "no code in the image");
        let spans = code_spans(image);
        ensure!(!spans.is_empty(), "no mapping symbols in the image");
        let mut functions = BTreeMap::new();
        for symbol in image.symbols().filter(|symbol| symbol.kind() == SymbolKind::Text) {
            // The lowest bit of a Thumb function's address says only that it is one.
            let start = symbol.address() & !1;
            let end = start + symbol.size();
            let section = sections
                .iter()
                .find(|(address, bytes)| *address <= start && end <= address + bytes.len() as u64);
            let Some((address, bytes)) = section.filter(|_| symbol.size() > 0) else { continue };
            let name = symbol.name().unwrap_or_default().to_owned();
            let mut instructions = BTreeMap::new();
            for span in &spans {
                let (start, end) = (span.start.max(start), span.end.min(end));
                if start < end {
                    let offset = |place: u64| (place - address) as usize;
                    let decoded = decoder.decode(start, &bytes[offset(start)..offset(end)]);
                    instructions.extend(decoded.with_context(|| format!("in {name}"))?);
                }
            }
            functions.insert(start, Function { name, instructions });
        }
        Ok(Self { functions })
    }

    /// The instruction at an address.
    pub fn at(&self, address: u64) -> Result<&Instruction> {
        let function = self.functions.range(..=address).next_back();
        let instruction = function.and_then(|(_, function)| function.instructions.get(&address));
        instruction.with_context(|| format!("no instruction at {address:#x}"))
    }
}

/// Where code is, and no data: from each mapping symbol $t to the next symbol of that kind.
fn code_spans(image: &object::File) -> Vec<Range<u64>> {
    let mut kinds = BTreeMap::new();
    for symbol in image.symbols() {
        match symbol.name().unwrap_or_default() {
            name if name.starts_with("$t") => kinds.insert(symbol.address(), true),
            name if name.starts_with("$d") => kinds.insert(symbol.address(), false),
            _ => None,
        };
    }
    let ends = kinds.keys().skip(1).copied().chain([u64::MAX]);
    let spans = kinds.iter().zip(ends).filter(|((_, is_code), _)| **is_code);
    spans.map(|((start, _), end)| *start..end).collect()
}

pub struct Decoder(Capstone);

impl Decoder {
    pub fn new() -> Result<Self> {
        let builder = Capstone::new().arm().mode(ArchMode::Thumb);
        let capstone = builder.extra_mode([ArchExtraMode::MClass].into_iter()).detail(true).build();
        Ok(Self(capstone.map_err(|error| anyhow!("Capstone: {error}"))?))
    }

    /// Decodes all of a piece of code.
    pub fn decode(&self, start: u64, bytes: &[u8]) -> Result<BTreeMap<u64, Instruction>> {
        let decoded = self.0.disasm_all(bytes, start).map_err(|error| anyhow!("{error}"))?;
        let decoded = decoded.iter().map(|one| Ok((one.address(), self.instruction(one)?)));
        let instructions: BTreeMap<u64, Instruction> = decoded.collect::<Result<_>>()?;
        let end = instructions.values().next_back().map_or(start, Instruction::end);
        ensure!(end == start + bytes.len() as u64, "no known instruction at {end:#x}");
        Ok(instructions)
    }

    fn instruction(&self, decoded: &capstone::Insn) -> Result<Instruction> {
        let detail = self.0.insn_detail(decoded).map_err(|error| anyhow!("{error}"))?;
        let arch = detail.arch_detail();
        let arm = arch.arm().context("not an Arm instruction")?;
        let register = |id: RegId| self.0.reg_name(id);
        let registers = |ids: &[RegId]| ids.iter().filter_map(|id| register(*id)).collect();
        let operand = |operand: ArmOperandType| match operand {
            ArmOperandType::Reg(id) => register(id).map_or(Operand::Other, Register),
            ArmOperandType::Imm(value) => Immediate(value.into()),
            ArmOperandType::Mem(memory) => Memory {
                base: register(memory.base()).unwrap_or_default(),
                index: register(memory.index()),
                offset: memory.disp().into(),
            },
            _ => Operand::Other,
        };
        // Of the hints, only the mnemonic tells which.
        let name = self.0.insn_name(decoded.id()).filter(|name| name != "hint");
        Ok(Instruction {
            address: decoded.address(),
            size: decoded.len() as u64,
            name: name.or(decoded.mnemonic().map(str::to_owned)).context("no name")?,
            operands: arm.operands().map(|one| operand(one.op_type)).collect(),
            reads: registers(detail.regs_read()),
            writes: registers(detail.regs_write()),
            writes_back: arm.writeback(),
        })
    }
}

impl Instruction {
    /// Where the one behind it begins.
    pub fn end(&self) -> u64 {
        self.address + self.size
    }

    pub fn writes(&self, register: &str) -> bool {
        self.writes.iter().any(|written| written == register)
    }

    /// Whether it may go elsewhere than to the next.
    pub fn may_branch(&self) -> bool {
        // Capstone does not always say that a branch writes the PC.
        let branches = ["b", "bl", "blx", "bx", "cbz", "cbnz", "tbb", "tbh"];
        branches.contains(&&*self.name) || self.writes("pc")
    }

    /// The operands that are registers, but for those in addresses.
    pub fn registers(&self) -> impl Iterator<Item = &String> {
        self.operands.iter().filter_map(|operand| match operand {
            Register(name) => Some(name),
            _ => None,
        })
    }

    /// The registers that make the address of a load or store of one.
    pub fn address_registers(&self) -> Vec<&String> {
        let memory = self.operands.iter().find_map(|operand| match operand {
            Memory { base, index, .. } => Some([Some(base), index.as_ref()]),
            _ => None,
        });
        memory.into_iter().flatten().flatten().collect()
    }

    /// Words that a load or store of several moves.
    pub fn words(&self) -> u64 {
        // LDM, STM and their like name the base first.
        let base = usize::from(self.name.contains("ldm") || self.name.contains("stm"));
        let words = |name: &String| if name.starts_with('d') { 2 } else { 1 };
        self.registers().skip(base).map(words).sum()
    }

    pub fn meaning(&self) -> Meaning {
        let first = match self.operands.first() {
            Some(Register(name)) => name,
            _ => "",
        };
        match (&*self.name, &*self.operands) {
            ("b" | "bl", [Immediate(target)]) | ("cbz" | "cbnz", [_, Immediate(target)]) => {
                Meaning::Branch(*target as u64)
            }
            // Returns: BX LR; POP and LDR to PC from the stack.
            ("bx", _) if first == "lr" => Meaning::Plain,
            ("pop", _) => Meaning::Plain,
            ("ldr", [_, Memory { base, .. }, ..])
                if first == "pc" && base == "sp" && self.writes_back =>
            {
                Meaning::Plain
            }
            // A jump table stays within its function; Cortex-M0, which has no TBB, adds to the PC.
            ("tbb" | "tbh", _) => Meaning::Plain,
            ("add", [_, Register(_)]) if first == "pc" => Meaning::Plain,
            ("b" | "bl" | "blx" | "bx", _) => Meaning::Unknown,
            _ if self.writes("pc") => Meaning::Unknown,
            ("push" | "vpush", _) => Meaning::Stack(4 * self.words()),
            ("sub", [.., Immediate(bytes)]) if first == "sp" => Meaning::Stack(*bytes as u64),
            ("sub" | "add", [.., Register(_)]) if first == "sp" => Meaning::Unknown,
            (_, [.., Memory { base, offset, .. }]) if base == "sp" && self.writes_back => {
                Meaning::Stack(offset.wrapping_neg().max(0) as u64)
            }
            _ => Meaning::Plain,
        }
    }
}

#[cfg(test)]
pub mod tests {
    use super::*;

    /// Decodes half-words.
    pub fn decoded(start: u64, halfwords: &[u16]) -> BTreeMap<u64, Instruction> {
        let bytes: Vec<u8> = halfwords.iter().flat_map(|word| word.to_le_bytes()).collect();
        Decoder::new().and_then(|decoder| decoder.decode(start, &bytes)).expect("known code")
    }

    /// An image of functions: where they begin, names, half-words.
    pub fn code(functions: &[(u64, &str, &[u16])]) -> Code {
        let function = |&(start, name, halfwords): &(u64, &str, &[u16])| {
            let instructions = decoded(start, halfwords);
            (start, Function { name: name.to_owned(), instructions })
        };
        Code { functions: functions.iter().map(function).collect() }
    }

    fn meaning(start: u64, halfwords: &[u16]) -> Meaning {
        decoded(start, halfwords)[&start].meaning()
    }

    #[test]
    fn branches_are_decoded() {
        // bl to itself, b.n +4, beq.n to itself, cbz +2, b.w +0x100, bne.w -0x100
        assert_eq!(meaning(0x100, &[0xf7ff, 0xfffe]), Meaning::Branch(0x100));
        assert_eq!(meaning(0x100, &[0xe002]), Meaning::Branch(0x108));
        assert_eq!(meaning(0x100, &[0xd0fe]), Meaning::Branch(0x100));
        assert_eq!(meaning(0x100, &[0xb108]), Meaning::Branch(0x106));
        assert_eq!(meaning(0x1000, &[0xf000, 0xb87e]), Meaning::Branch(0x1100));
        assert_eq!(meaning(0x1000, &[0xf47f, 0xaf7e]), Meaning::Branch(0xf00));
    }

    #[test]
    fn returns_are_told_from_ways_to_unknown_places() {
        // bx lr; pop {r7, pc}; ldr pc, [sp], #4; tbb [pc, r0]; add pc, r0
        let plain: [&[u16]; 5] =
            [&[0x4770], &[0xbd80], &[0xf85d, 0xfb04], &[0xe8df, 0xf000], &[0x4487]];
        for halfwords in plain {
            assert_eq!(meaning(0x100, halfwords), Meaning::Plain, "{halfwords:x?}");
        }
        // blx r3; bx r3; mov pc, r0; ldr.w pc, [r0]; ldm.w r0, {r1, pc}
        let unknown: [&[u16]; 5] =
            [&[0x4798], &[0x4718], &[0x4687], &[0xf8d0, 0xf000], &[0xe890, 0x8002]];
        for halfwords in unknown {
            assert_eq!(meaning(0x100, halfwords), Meaning::Unknown, "{halfwords:x?}");
        }
    }

    #[test]
    fn stack_is_counted() {
        let cases: [(&[u16], u64); 10] = [
            (&[0xb5f0], 20),           // push {r4-r7, lr}
            (&[0xb08e], 56),           // sub sp, #56
            (&[0xe92d, 0x4ff0], 36),   // push.w {r4-r11, lr}
            (&[0xf84d, 0x8d04], 4),    // str r8, [sp, #-4]!
            (&[0xe96d, 0x2302], 8),    // strd r2, r3, [sp, #-8]!
            (&[0xe92d, 0x0030], 8),    // stmdb sp!, {r4, r5}
            (&[0xed2d, 0x8b02], 8),    // vpush {d8}
            (&[0xed2d, 0x8a03], 12),   // vpush {s16-s18}
            (&[0xf5ad, 0x7d00], 512),  // sub.w sp, sp, #512
            (&[0xf6ad, 0x4d18], 3096), // subw sp, sp, #3096
        ];
        for (halfwords, bytes) in cases {
            assert_eq!(meaning(0, halfwords), Meaning::Stack(bytes), "{halfwords:x?}");
        }
        // sub.w sp, sp, r4; add sp, r6
        for halfwords in [&[0xebad, 0x0d04][..], &[0x44b5]] {
            assert_eq!(meaning(0, halfwords), Meaning::Unknown, "{halfwords:x?}");
        }
    }

    #[test]
    fn what_is_no_instruction_is_refused() {
        let decoder = Decoder::new().expect("Capstone");
        // nop, then what no Cortex-M has
        assert!(decoder.decode(0, &[0x00, 0xbf, 0xff, 0xff, 0xff, 0xff]).is_err());
        assert!(decoder.decode(0, &[0x2d, 0xe9]).is_err(), "half an instruction");
    }
}
