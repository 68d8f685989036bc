//! A model of what instructions cost on a Cortex-M4F: cycles after Arm's *Cortex-M4 Technical Reference Manual*
//! (DDI 0439): its tables 3-1 and 7-1 and what it says of load/store timings. About ±15 %; nothing here was measured.
//!
//! Assumed: memory without wait states; two cycles to refill the pipeline after a branch (the manual: one to three); a
//! floating-point load or store pipelines as an integer one does; one of several registers waits for no address; nothing
//! overlaps a multiply-accumulate, a division or a square root, behind which integer instructions may complete; an IT is not
//! folded; what an IT block skips costs as much as what it runs. Integer division takes 2 to 12 cycles by its data, here
//! always 12; floating-point division takes 14 for all data.

use crate::thumb::{Code, Instruction};
use anyhow::{Result, bail};

/// Refilling the pipeline (the manual's P).
const REFILL: u64 = 2;

/// How an instruction stands to its neighbours.
#[derive(Clone, Copy, PartialEq)]
enum Kind {
    /// Processes data in core registers.
    Integer,
    /// Computes a floating-point number, which is there a cycle later.
    Arithmetic,
    /// Computes one from an addend, which it takes a cycle later.
    Accumulate,
    /// Loads one register.
    Load,
    /// Stores one register.
    Store,
    Other,
}

/// Cycles of each of the executed instructions, whose addresses are given in order.
pub fn cycles(code: &Code, executed: &[u64]) -> Result<Vec<u64>> {
    let nexts = executed.iter().skip(1).copied().map(Some).chain([None]);
    let mut previous = None;
    let mut cycles = Vec::with_capacity(executed.len());
    for (address, next) in executed.iter().zip(nexts) {
        let instruction = code.at(*address)?;
        cycles.push(cost(instruction, previous, next)?);
        previous = Some(instruction);
    }
    Ok(cycles)
}

/// Cycles of an instruction that runs after `previous` and before the one at `next`.
fn cost(
    instruction: &Instruction,
    previous: Option<&Instruction>,
    next: Option<u64>,
) -> Result<u64> {
    let (kind, alone) = timing(instruction)?;
    let branches = instruction.may_branch() && next != Some(instruction.end());
    let refill = if branches { REFILL } else { 0 };
    let Some(previous) = previous else { return Ok(alone + refill) };

    let (kind_before, _) = timing(previous)?;
    let is_fresh = |register: &&String| previous.writes(register);
    let address_is_fresh = instruction.address_registers().iter().any(is_fresh);
    // Nothing is forwarded to where addresses are made.
    let waits_for_address = kind_before == Kind::Integer && address_is_fresh;
    let waits_for_number = matches!(kind_before, Kind::Arithmetic | Kind::Accumulate)
        && match kind {
            Kind::Accumulate => instruction.registers().skip(1).any(|factor| is_fresh(&factor)),
            _ => instruction.reads.iter().any(|register| is_fresh(&register)),
        };
    let is_pipelined = match kind_before {
        Kind::Load => matches!(kind, Kind::Load | Kind::Store) && !address_is_fresh,
        // Integer stores gain nothing; most take but one cycle.
        Kind::Store => kind == Kind::Store && instruction.name == "vstr",
        _ => false,
    };
    let cycles = if is_pipelined { 1 } else { alone };
    Ok(cycles + refill + u64::from(waits_for_address) + u64::from(waits_for_number))
}

/// What an instruction is and costs by itself, without going elsewhere.
fn timing(instruction: &Instruction) -> Result<(Kind, u64)> {
    // SB, SL and SP are core registers.
    let is_single = |name: &String| name.strip_prefix('s').is_some_and(|n| n.parse::<u8>().is_ok());
    let is_double = || instruction.registers().any(|name| name.starts_with('d'));
    Ok(match &*instruction.name {
        // Table 3-1
        "adc" | "add" | "adr" | "and" | "asr" | "bfc" | "bfi" | "bic" | "clz" | "cmn" | "cmp"
        | "eor" | "lsl" | "lsr" | "mla" | "mls" | "mov" | "movs" | "movt" | "mul" | "mvn"
        | "orn" | "orr" | "rbit" | "rev" | "rev16" | "revsh" | "ror" | "rrx" | "rsb" | "sbc"
        | "sbfx" | "smlal" | "smull" | "ssat" | "sub" | "sxtb" | "sxth" | "teq" | "tst"
        | "ubfx" | "umlal" | "umull" | "usat" | "uxtb" | "uxth" => (Kind::Integer, 1),
        "sdiv" | "udiv" => (Kind::Integer, 12),
        "ldr" | "ldrb" | "ldrh" | "ldrsb" | "ldrsh" => (Kind::Load, 2),
        // With an immediate offset it is stored while the next instruction runs.
        "str" | "strb" | "strh" if instruction.address_registers().len() == 1 => (Kind::Store, 1),
        "str" | "strb" | "strh" => (Kind::Store, 2),
        "ldrd" | "strd" | "ldm" | "ldmdb" | "stm" | "stmdb" | "push" | "pop" => {
            (Kind::Other, 1 + instruction.words())
        }
        "b" | "bl" | "blx" | "bx" | "cbz" | "cbnz" | "it" | "nop" => (Kind::Other, 1),
        "tbb" | "tbh" => (Kind::Other, 2),
        // Table 7-1
        "vadd" | "vsub" | "vmul" | "vnmul" | "vcvt" | "vcvtr" => (Kind::Arithmetic, 1),
        "vdiv" | "vsqrt" => (Kind::Arithmetic, 14),
        "vmla" | "vmls" | "vnmla" | "vnmls" | "vfma" | "vfms" | "vfnma" | "vfnms" => {
            (Kind::Accumulate, 3)
        }
        "vldr" | "vstr" if is_double() => (Kind::Other, 3),
        "vldr" => (Kind::Load, 2),
        "vstr" => (Kind::Store, 2),
        "vldmia" | "vldmdb" | "vstmia" | "vstmdb" | "vpush" | "vpop" => {
            (Kind::Other, 1 + instruction.words())
        }
        // FCONSTS is VMOV of a number, FMSTAT is VMRS to the flags.
        "vabs" | "vneg" | "vcmp" | "vcmpe" | "fconsts" | "fmstat" | "vmrs" | "vmsr" => {
            (Kind::Other, 1)
        }
        "vmov" if instruction.registers().all(is_single) => (Kind::Other, 1),
        // To or from core registers.
        "vmov" => (Kind::Other, 2),
        name => bail!("no timing is known for {name}, at {:#x}", instruction.address),
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::thumb::tests::decoded;

    /// What each of the instructions costs when they run one after the other, up to `next`.
    fn costs(halfwords: &[u16], next: u64) -> Vec<u64> {
        let code = decoded(0x100, halfwords);
        let nexts = code.keys().skip(1).copied().chain([next]);
        let mut previous = None;
        let cost = |(instruction, next)| {
            cost(instruction, previous.replace(instruction), Some(next)).expect("a known one")
        };
        code.values().zip(nexts).map(cost).collect()
    }

    #[test]
    fn instructions_alone_cost_what_the_tables_say() {
        let cases: [(&[u16], u64); 24] = [
            (&[0x1888], 1),          // adds r0, r1, r2
            (&[0xf240, 0x0100], 1),  // movw r1, #0
            (&[0xfb82, 0x0103], 1),  // smull r0, r1, r2, r3
            (&[0xfb91, 0xf0f2], 12), // sdiv r0, r1, r2
            (&[0x6808], 2),          // ldr r0, [r1]
            (&[0x6008], 1),          // str r0, [r1]
            (&[0x5088], 2),          // str r0, [r1, r2]
            (&[0xb5f0], 6),          // push {r4-r7, lr}
            (&[0xe890, 0x0006], 3),  // ldm.w r0, {r1, r2}
            (&[0xe9cd, 0x2300], 3),  // strd r2, r3, [sp]
            (&[0xbf18], 1),          // it ne
            (&[0xbf00], 1),          // nop
            (&[0xee30, 0x0a81], 1),  // vadd.f32 s0, s1, s2
            (&[0xee00, 0x0a81], 3),  // vmla.f32 s0, s1, s2
            (&[0xeea0, 0x0a81], 3),  // vfma.f32 s0, s1, s2
            (&[0xee80, 0x0a08], 14), // vdiv.f32 s0, s0, s16
            (&[0xeeb1, 0x0ae0], 14), // vsqrt.f32 s0, s1
            (&[0xeeb7, 0x0a00], 1),  // vmov.f32 s0, #1.0
            (&[0xeeb0, 0x0a60], 1),  // vmov.f32 s0, s1
            (&[0xee00, 0x0a10], 2),  // vmov s0, r0
            (&[0xee10, 0x9a10], 2),  // vmov r9, s0
            (&[0xed90, 0x0a00], 2),  // vldr s0, [r0]
            (&[0xed90, 0x0b00], 3),  // vldr d0, [r0]
            (&[0xed2d, 0x8b02], 3),  // vpush {d8}
        ];
        for (halfwords, cycles) in cases {
            let next = 0x100 + 2 * halfwords.len() as u64;
            assert_eq!(costs(halfwords, next), [cycles], "{halfwords:x?}");
        }
    }

    #[test]
    fn branches_that_are_taken_refill_the_pipeline() {
        assert_eq!(costs(&[0xd0fe], 0x102), [1], "beq, not taken");
        assert_eq!(costs(&[0xd0fe], 0x100), [1 + 2], "beq, taken");
        assert_eq!(costs(&[0xb108], 0x106), [1 + 2], "cbz, taken");
        assert_eq!(costs(&[0xf7ff, 0xfffe], 0x100), [1 + 2], "bl");
        assert_eq!(costs(&[0x4770], 0x800), [1 + 2], "bx lr");
        assert_eq!(costs(&[0xbd80], 0x800), [1 + 2 + 2], "pop {{r7, pc}}");
    }

    #[test]
    fn loads_behind_loads_are_pipelined_unless_they_need_them() {
        // ldr r0, [r1]; ldr r2, [r1, #4]; str r2, [r1, #8]; ldr r0, [r1]
        assert_eq!(costs(&[0x6808, 0x684a, 0x608a, 0x6808], 0x108), [2, 1, 1, 2]);
        // ldr r1, [r1]; ldr r0, [r1]
        assert_eq!(costs(&[0x6809, 0x6808], 0x104), [2, 2]);
        // vldr s0, [r0]; vldr s2, [r0]; vstr s2, [r0]; vstr s0, [r0]
        let floats = [0xed90, 0x0a00, 0xed90, 0x1a00, 0xed80, 0x1a00, 0xed80, 0x0a00];
        assert_eq!(costs(&floats, 0x110), [2, 1, 1, 1]);
        // adds r1, r1, #4; ldr r0, [r1]
        assert_eq!(costs(&[0x1d09, 0x6808], 0x104), [1, 2 + 1]);
    }

    #[test]
    fn a_number_is_there_a_cycle_after_it_is_computed() {
        // vadd.f32 s0, s1, s2; vmul.f32 s3, s0, s1
        assert_eq!(costs(&[0xee30, 0x0a81, 0xee60, 0x1a20], 0x108), [1, 1 + 1]);
        // vadd.f32 s0, s1, s2; vmla.f32 s0, s1, s2: the addend
        assert_eq!(costs(&[0xee30, 0x0a81, 0xee00, 0x0a81], 0x108), [1, 3]);
        // vadd.f32 s0, s1, s2; vmla.f32 s3, s0, s1: a factor
        assert_eq!(costs(&[0xee30, 0x0a81, 0xee40, 0x1a20], 0x108), [1, 3 + 1]);
        // vadd.f32 s0, s1, s2; vadd.f32 s3, s1, s1: neither
        assert_eq!(costs(&[0xee30, 0x0a81, 0xee70, 0x1aa0], 0x108), [1, 1]);
    }

    #[test]
    fn an_instruction_without_a_known_timing_is_an_error() {
        // dsb sy; wfi; cpsid i
        for halfwords in [&[0xf3bf, 0x8f4f][..], &[0xbf30], &[0xb672]] {
            let code = decoded(0, halfwords);
            let error = cost(&code[&0], None, None).expect_err("no timing").to_string();
            assert!(error.contains("no timing"), "{error}");
        }
    }
}
