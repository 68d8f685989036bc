//! The flash pages that hold parameters (`PARAMETERS` in `memory.x`).
//!
//! The microcontroller runs from the flash that it erases, and so stands still for about 22 ms a page: only with outputs off, or it is an
//! error. The watchdog is fed before each page.
//!
//! A power failure while a double word is written can leave it with an error that its error-correcting code cannot mend: to read it
//! is a non-maskable interrupt (RM0440, *Error code correction*). While parameters are read, that is bad data and no more.

use super::{bridge, safety};
use core::ops::Range;
use core::sync::atomic::{AtomicBool, Ordering};
use embassy_stm32::flash::{Blocking, Error, Flash};
use embedded_storage::nor_flash::{ErrorType, NorFlash, ReadNorFlash};

/// Offsets of the pages from the beginning of the flash.
pub const REGION: Range<u32> = 0x1_f000..0x2_0000;

/// Whether parameters are being read.
static IS_READING: AtomicBool = AtomicBool::new(false);

/// Whether an error in flash that cannot be corrected may be one in the parameters.
pub(super) fn is_reading() -> bool {
    IS_READING.load(Ordering::Relaxed)
}

/// The microcontroller's flash, for parameters.
pub struct ParameterFlash(pub(super) Flash<'static, Blocking>);

impl ErrorType for ParameterFlash {
    type Error = Error;
}

impl ReadNorFlash for ParameterFlash {
    const READ_SIZE: usize = <Flash<'static, Blocking> as ReadNorFlash>::READ_SIZE;

    fn read(&mut self, offset: u32, bytes: &mut [u8]) -> Result<(), Error> {
        IS_READING.store(true, Ordering::SeqCst);
        let read = self.0.read(offset, bytes);
        // An exception that it was to raise comes before it is over.
        cortex_m::asm::dsb();
        cortex_m::asm::isb();
        IS_READING.store(false, Ordering::SeqCst);
        read
    }

    fn capacity(&self) -> usize {
        self.0.capacity()
    }
}

impl NorFlash for ParameterFlash {
    const WRITE_SIZE: usize = <Flash<'static, Blocking> as NorFlash>::WRITE_SIZE;
    const ERASE_SIZE: usize = <Flash<'static, Blocking> as NorFlash>::ERASE_SIZE;

    fn erase(&mut self, from: u32, to: u32) -> Result<(), Error> {
        (from..to).step_by(Self::ERASE_SIZE).try_for_each(|page| {
            prepare()?;
            self.0.erase(page, page + Self::ERASE_SIZE as u32)
        })
    }

    fn write(&mut self, offset: u32, bytes: &[u8]) -> Result<(), Error> {
        prepare()?;
        self.0.write(offset, bytes)
    }
}

/// Refuses to go on with outputs enabled; else there is time for a page.
fn prepare() -> Result<(), Error> {
    if bridge::is_enabled() {
        return Err(Error::Protected);
    }
    safety::feed_watchdog();
    Ok(())
}
