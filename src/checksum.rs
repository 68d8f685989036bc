//! The checksum of frames and of names: one table for both.

use crc::{CRC_32_ISO_HDLC, Crc};

/// CRC-32, as in Ethernet.
pub(crate) static CRC_32: Crc<u32> = Crc::<u32>::new(&CRC_32_ISO_HDLC);
