//! General-purpose I/Os, ports A to C (RM0440, chapter *General-purpose I/Os*). Not modelled: open drain, locking, and interrupts by EXTI.

use super::block::{Access, Unmodelled, bit, field, only, store};

const MODER: u32 = 0x00;
const OTYPER: u32 = 0x04;
const OSPEEDR: u32 = 0x08;
const PUPDR: u32 = 0x0c;
const IDR: u32 = 0x10;
const ODR: u32 = 0x14;
const BSRR: u32 = 0x18;
const AFRL: u32 = 0x20;
const AFRH: u32 = 0x24;
const BRR: u32 = 0x28;

/// What drives a pin.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Drive {
    /// Nothing: what is wired to it, or its pull.
    Input,
    /// The port's output register.
    Output(bool),
    /// The peripheral with this number.
    Alternate(u32),
    /// Nothing: for converters and amplifiers.
    Analogue,
}

/// A port's registers.
pub struct Gpio {
    moder: u32,
    ospeedr: u32,
    pupdr: u32,
    odr: u32,
    afr: [u32; 2],
}

impl Gpio {
    /// After a reset; ports by number from 0 for A.
    pub fn new(port: usize) -> Self {
        // The debug port's pins differ from the others.
        let (moder, ospeedr, pupdr) = match port {
            0 => (0xabff_ffff, 0x0c00_0000, 0x6400_0000),
            1 => (0xffff_febf, 0x0000_00c0, 0x0000_0100),
            _ => (0xffff_ffff, 0, 0),
        };
        Self { moder, ospeedr, pupdr, odr: 0, afr: [0; 2] }
    }

    /// What drives a pin.
    pub fn drive(&self, pin: u32) -> Drive {
        match field(self.moder, 2 * pin, 2) {
            0 => Drive::Input,
            1 => Drive::Output(bit(self.odr, pin)),
            2 => Drive::Alternate(field(self.afr[pin as usize / 8], pin % 8 * 4, 4)),
            _ => Drive::Analogue,
        }
    }

    /// Level of a pin that nothing drives; low if it has no pull either.
    pub fn pull(&self, pin: u32) -> bool {
        field(self.pupdr, 2 * pin, 2) == 1
    }

    /// Reads a register; `inputs` are the levels at the pins.
    pub fn read(&self, offset: u32, inputs: u32) -> Access<u32> {
        Ok(match offset {
            MODER => self.moder,
            OTYPER => 0,
            OSPEEDR => self.ospeedr,
            PUPDR => self.pupdr,
            IDR => inputs,
            ODR => self.odr,
            AFRL => self.afr[0],
            AFRH => self.afr[1],
            BSRR | BRR => 0,
            _ => return Err(Unmodelled),
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            MODER => store(&mut self.moder, value, !0),
            // Push-pull only.
            OTYPER => only(value, 0),
            OSPEEDR => store(&mut self.ospeedr, value, !0),
            PUPDR => store(&mut self.pupdr, value, !0),
            ODR => store(&mut self.odr, value, 0xffff),
            BSRR => {
                self.odr = self.odr & !(value >> 16) | value & 0xffff;
                Ok(())
            }
            BRR => {
                self.odr &= !value;
                Ok(())
            }
            AFRL => store(&mut self.afr[0], value, !0),
            AFRH => store(&mut self.afr[1], value, !0),
            _ => Err(Unmodelled),
        }
    }
}
