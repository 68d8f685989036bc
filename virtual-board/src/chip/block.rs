//! What the models of the microcontroller's blocks have in common.

/// An access to what is not modelled: a register, bits of one, or a state in which the access means something else.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unmodelled;

/// What becomes of an access.
pub type Access<T> = Result<T, Unmodelled>;

/// A field of a register.
pub const fn field(register: u32, lowest: u32, width: u32) -> u32 {
    (register >> lowest) & ((1 << width) - 1)
}

/// Whether a bit is set.
pub const fn bit(register: u32, number: u32) -> bool {
    register & (1 << number) != 0
}

/// Writes a register that only keeps what is written, of which these bits are modelled.
pub fn store(register: &mut u32, value: u32, modelled: u32) -> Access<()> {
    only(value, modelled)?;
    *register = value;
    Ok(())
}

/// Refuses bits that are not modelled.
pub const fn only(value: u32, modelled: u32) -> Access<()> {
    if value & !modelled == 0 { Ok(()) } else { Err(Unmodelled) }
}
