//! What an image takes of its board's memories.

use crate::boards::BOARDS;
use crate::cross::Cross;
use anyhow::{Context, Result, ensure};
use object::{Object, ObjectSection, ObjectSymbol, SectionKind};
use std::fs;

/// Bytes of an image.
pub struct Size {
    /// In flash, with what is copied from there to RAM.
    pub flash: u64,
    /// Static data in RAM.
    pub data: u64,
}

impl Size {
    pub fn of(image: &object::File) -> Self {
        let sum = |kinds: &[SectionKind]| {
            let sections = image.sections().filter(|section| kinds.contains(&section.kind()));
            sections.map(|section| section.size()).sum()
        };
        use SectionKind::{Data, ReadOnlyData, ReadOnlyString, Text, UninitializedData};
        Self {
            flash: sum(&[Text, ReadOnlyData, ReadOnlyString, Data]),
            data: sum(&[Data, UninitializedData]),
        }
    }
}

/// Builds the firmware of every board and prints what it takes; fails beyond a budget.
pub fn size(cross: &Cross) -> Result<()> {
    println!("{:<16} {:>7} {:>7}   of budget (bytes)", "board", "flash", "RAM");
    for board in &BOARDS {
        let elf = cross.firmware(board)?;
        let data = fs::read(&elf).with_context(|| format!("cannot read {}", elf.display()))?;
        let image = object::File::parse(&*data)?;
        let Size { flash, data } = Size::of(&image);
        let ram = data + stack(&image)?;
        let budget = &board.budget;
        println!("{:<16} {flash:>7} {ram:>7}   {}, {}", board.name, budget.flash, budget.ram);
        ensure!(flash <= budget.flash, "{} takes more flash than its budget", board.name);
        ensure!(ram <= budget.ram, "{} takes more RAM than its budget", board.name);
    }
    Ok(())
}

/// What is kept for the stack: the linker script's, if it says.
fn stack(image: &object::File) -> Result<u64> {
    let symbol = |name: &str| {
        let mut symbols = image.symbols();
        let found = symbols.find(|symbol| symbol.name() == Ok(name));
        found.map(|symbol| symbol.address()).with_context(|| format!("no {name} in the image"))
    };
    Ok(symbol("_stack_start")?.saturating_sub(symbol("_stack_end")?))
}
