//! Frames: a message with its CRC-32, stuffed by COBS so that it holds no zero, between two zeros.
//!
//! Whatever the line loses or adds, a zero begins anew: no garbage ahead of a frame harms it. A frame that was changed on its
//! way or cut short is dropped, and so is one that is longer than any message.

use crate::checksum::CRC_32;
use serde::Serialize;

/// Longest frame, in bytes, with its zeros.
pub const LONGEST: usize = 192;

/// Bytes of the CRC.
const CRC_LENGTH: usize = 4;

/// A message's frame; nothing if the buffer does not hold it.
pub fn encode<'b>(message: &impl Serialize, buffer: &'b mut [u8; LONGEST]) -> Option<&'b [u8]> {
    let mut plain = [0; LONGEST];
    let length = postcard::to_slice(message, &mut plain).ok()?.len();
    stuff(&mut plain, length, buffer)
}

/// Adds the CRC to a message of `length` bytes, stuffs both and puts them between zeros.
fn stuff<'b>(
    plain: &mut [u8; LONGEST],
    length: usize,
    buffer: &'b mut [u8; LONGEST],
) -> Option<&'b [u8]> {
    let (message, rest) = plain.split_at_mut_checked(length)?;
    *rest.first_chunk_mut::<CRC_LENGTH>()? = CRC_32.checksum(message).to_le_bytes();
    let plain = plain.get(..length + CRC_LENGTH)?;
    buffer.fill(0);
    let inner = buffer.get_mut(1..LONGEST - 1)?;
    let stuffed = cobs::try_encode(plain, inner).ok()?;
    buffer.get(..stuffed + 2)
}

/// Finds frames in a stream of bytes.
///
/// A byte costs the same few instructions whatever came before, and a zero at most one pass over [`LONGEST`] bytes.
#[derive(Clone, Debug)]
pub struct Decoder {
    buffer: [u8; LONGEST],
    /// Bytes of the frame so far; more than the buffer holds if the frame is too long.
    length: usize,
}

impl Decoder {
    /// At the beginning of a stream.
    pub const fn new() -> Self {
        Self { buffer: [0; LONGEST], length: 0 }
    }

    /// Takes a byte. At the end of a frame that arrived as it was sent, gives its message.
    pub fn feed(&mut self, byte: u8) -> Option<&[u8]> {
        if byte != 0 {
            if let Some(place) = self.buffer.get_mut(self.length) {
                *place = byte;
                self.length += 1;
            } else {
                self.length = LONGEST + 1;
            }
            return None;
        }
        let length = core::mem::take(&mut self.length);
        let frame = self.buffer.get_mut(..length)?;
        let length = cobs::decode_in_place(frame).ok()?;
        let (message, crc) = self.buffer.get(..length)?.split_last_chunk::<CRC_LENGTH>()?;
        // Nothing at all has a checksum of zero, which garbage of a few ones happens to hold.
        let is_whole = !message.is_empty() && CRC_32.checksum(message) == u32::from_le_bytes(*crc);
        is_whole.then_some(message)
    }
}

impl Default for Decoder {
    fn default() -> Self {
        Self::new()
    }
}
