//! The firmware image: what is flashed, from its ELF file.

use crate::chip::flash;
use object::{Object, ObjectSegment, ObjectSymbol, SymbolKind};
use std::fmt;
use std::ops::Range;

/// Why a file is no image for this microcontroller.
#[derive(Debug)]
pub enum ImageError {
    /// It is no ELF file.
    NotElf(object::Error),
    /// Something in it is to be stored where there is no flash.
    OutsideFlash(u64),
    /// It has no symbol of this name.
    NoSymbol(&'static str),
}

impl fmt::Display for ImageError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NotElf(error) => write!(f, "no ELF file: {error}"),
            Self::OutsideFlash(address) => write!(f, "stores at {address:#x}, where no flash is"),
            Self::NoSymbol(name) => write!(f, "no symbol {name}"),
        }
    }
}

impl std::error::Error for ImageError {}

/// A function of the image.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Function {
    /// Where its code is executed.
    pub code: Range<u32>,
    /// Its name, as the linker knows it.
    pub name: String,
}

/// What is flashed, and what is known of it.
#[derive(Clone, Debug)]
pub struct Image {
    segments: Vec<(usize, Vec<u8>)>,
    functions: Vec<Function>,
    stack: Range<u32>,
}

impl Image {
    /// Of half-words from the flash's beginning on.
    #[cfg(test)]
    pub(crate) fn of_code(halves: &[u16]) -> Self {
        let code = halves.iter().flat_map(|half| half.to_le_bytes()).collect();
        Self { segments: vec![(0, code)], functions: Vec::new(), stack: 0..0 }
    }

    /// From the contents of an ELF file.
    pub fn from_elf(data: &[u8]) -> Result<Self, ImageError> {
        let file = object::read::elf::ElfFile32::<object::Endianness>::parse(data)
            .map_err(ImageError::NotElf)?;
        let mut segments = Vec::new();
        for segment in file.segments() {
            let bytes = segment.data().map_err(ImageError::NotElf)?;
            if bytes.is_empty() {
                continue;
            }
            // Where it is stored, not where it is used: .data and code in RAM differ.
            let address: u32 = {
                use object::read::elf::ProgramHeader;
                segment.elf_program_header().p_paddr(file.endian())
            };
            let offset = address.wrapping_sub(flash::BASE) as usize;
            if offset.saturating_add(bytes.len()) > flash::SIZE {
                return Err(ImageError::OutsideFlash(address.into()));
            }
            segments.push((offset, bytes.to_vec()));
        }
        let symbol = |name| {
            let symbol = file.symbol_by_name(name).ok_or(ImageError::NoSymbol(name))?;
            Ok(symbol.address() as u32)
        };
        let stack = symbol("_stack_end")?..symbol("_stack_start")?;
        let mut functions: Vec<_> = file
            .symbols()
            .filter(|symbol| symbol.kind() == SymbolKind::Text && symbol.size() > 0)
            .map(|symbol| {
                let start = symbol.address() as u32 & !1;
                let name = symbol.name().unwrap_or("?").to_owned();
                Function { code: start..start + symbol.size() as u32, name }
            })
            .collect();
        functions.sort_by_key(|function| function.code.start);
        Ok(Self { segments, functions, stack })
    }

    /// What is stored in the flash, by offset.
    pub fn segments(&self) -> impl Iterator<Item = (usize, &[u8])> {
        self.segments.iter().map(|(offset, bytes)| (*offset, &**bytes))
    }

    /// The stack, lowest address first; it grows downward.
    pub fn stack(&self) -> Range<u32> {
        self.stack.clone()
    }

    /// The function at an address.
    pub fn function_at(&self, address: u32) -> Option<&Function> {
        let after = self.functions.partition_point(|function| function.code.start <= address);
        self.functions[..after].iter().rev().find(|function| function.code.contains(&address))
    }

    /// A function by a part of its name.
    pub fn function(&self, part: &str) -> Option<&Function> {
        self.functions.iter().find(|function| function.name.contains(part))
    }
}
