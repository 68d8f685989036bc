//! The checksum of frames, sets and names.

use crc::{CRC_32_ISO_HDLC, Crc, NoTable};

/// CRC-32, as in Ethernet. Bit by bit: a frame's takes some 50 µs, a table a kilobyte.
pub(crate) static CRC_32: Crc<u32, NoTable> = Crc::<u32, NoTable>::new(&CRC_32_ISO_HDLC);
