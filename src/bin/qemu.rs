//! The drive on QEMU's MPS2 boards, its motor played by a host over the serial port.
#![no_std]
#![no_main]

use defmt_semihosting as _;

#[cortex_m_rt::entry]
fn main() -> ! {
    quasidrive::board::qemu::run()
}
