//! What an image's debug information tells: from which source an instruction is, and the size of a type.

use addr2line::gimli::{self, Dwarf, EndianSlice, LittleEndian};
use anyhow::{Context, Result, ensure};
use object::{Object, ObjectSection};
use std::sync::Arc;

type Slice<'a> = EndianSlice<'a, LittleEndian>;

pub struct DebugInfo<'a> {
    dwarf: Arc<Dwarf<Slice<'a>>>,
    context: addr2line::Context<Slice<'a>>,
}

impl<'a> DebugInfo<'a> {
    pub fn read(image: &object::File<'a>) -> Result<Self> {
        let section = |id: gimli::SectionId| -> Result<Slice<'a>> {
            let section = image.section_by_name(id.name());
            let data = section.map(|section| section.data()).transpose()?;
            Ok(EndianSlice::new(data.unwrap_or_default(), LittleEndian))
        };
        let dwarf = Arc::new(Dwarf::load(section)?);
        Ok(Self { context: addr2line::Context::from_arc_dwarf(dwarf.clone())?, dwarf })
    }

    /// The source files that the instruction at an address is from: of the function, and of those inlined into it there.
    pub fn sources(&self, address: u64) -> Result<Vec<String>> {
        let mut frames = self.context.find_frames(address).skip_all_loads()?;
        let mut sources = Vec::new();
        while let Some(frame) = frames.next()? {
            let file = frame.location.and_then(|location| location.file);
            sources.extend(file.map(str::to_owned));
        }
        ensure!(!sources.is_empty(), "no debug information on {address:#x}");
        Ok(sources)
    }

    /// Bytes of a value of the type with this name.
    pub fn size_of(&self, name: &str) -> Result<u64> {
        let mut headers = self.dwarf.units();
        while let Some(header) = headers.next()? {
            let unit = self.dwarf.unit(header)?;
            let mut entries = unit.entries();
            while let Some(entry) = entries.next_dfs()? {
                let Some(found) = entry.attr_value(gimli::DW_AT_name) else { continue };
                let found = self.dwarf.attr_string(&unit, found)?;
                let is_type = entry.tag() == gimli::DW_TAG_structure_type;
                let size = entry.attr_value(gimli::DW_AT_byte_size);
                let size = size.and_then(|size| size.udata_value());
                if let (true, true, Some(size)) = (is_type, found.to_string()? == name, size) {
                    return Ok(size);
                }
            }
        }
        None.with_context(|| format!("no type {name} in the debug information"))
    }
}
