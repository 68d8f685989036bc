//! Direct memory access, DMA1, and its request multiplexer DMAMUX1 (RM0440, chapters *Direct memory access controller* and *DMA request
//! multiplexer*). A request is served at once: the few cycles on the bus are not modelled. Not modelled: DMA2, memory to memory, request
//! generators and synchronisation.

use super::block::{Access, Unmodelled, bit, field, only, store};

/// Channels of DMA1 on this microcontroller.
pub const CHANNELS: usize = 6;

const ISR: u32 = 0x00;
const IFCR: u32 = 0x04;
const FIRST: u32 = 0x08;
const STRIDE: u32 = 20;

// CCR
const EN: u32 = 0;
const TCIE: u32 = 1;
const HTIE: u32 = 2;
const DIR: u32 = 4;
const CIRC: u32 = 5;
const PINC: u32 = 6;
const MINC: u32 = 7;
const PSIZE: u32 = 8;
const MSIZE: u32 = 10;

/// Request lines of DMAMUX1 (RM0440, table of its inputs; as in embassy-stm32's tables).
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Request {
    /// TIM1's channel 4.
    Tim1Ch4 = 45,
    /// TIM3's channel 1.
    Tim3Ch1 = 61,
}

#[derive(Clone, Copy, Default)]
struct Channel {
    ccr: u32,
    cndtr: u32,
    cpar: u32,
    cmar: u32,
    /// CNDTR as written, and how far the channel is.
    length: u32,
    request: u32,
}

/// A transfer to be made.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Transfer {
    /// Where from, and how many bytes.
    pub from: (u32, usize),
    /// Where to, and how many bytes.
    pub to: (u32, usize),
}

/// The registers.
#[derive(Default)]
pub struct Dma {
    isr: u32,
    channels: [Channel; CHANNELS],
}

impl Dma {
    /// After a reset.
    pub fn new() -> Self {
        Self::default()
    }

    /// A request comes: what is to be transferred, if a channel listens to it.
    pub fn request(&mut self, request: Request) -> Option<Transfer> {
        let number = self
            .channels
            .iter()
            .position(|channel| channel.request == request as u32 && bit(channel.ccr, EN))?;
        let channel = &mut self.channels[number];
        let done = channel.length - channel.cndtr;
        let size = |lowest| 1 << field(channel.ccr, lowest, 2);
        let side = |address, increment, size: u32| {
            (address + if bit(channel.ccr, increment) { done * size } else { 0 }, size as usize)
        };
        let peripheral = side(channel.cpar, PINC, size(PSIZE));
        let memory = side(channel.cmar, MINC, size(MSIZE));
        let is_from_memory = bit(channel.ccr, DIR);
        if channel.cndtr == 0 {
            return None;
        }
        channel.cndtr -= 1;
        let mut flags = 0;
        if channel.cndtr == channel.length / 2 {
            flags |= 1 << HTIE | 1;
        }
        if channel.cndtr == 0 {
            flags |= 1 << TCIE | 1;
            if bit(channel.ccr, CIRC) {
                channel.cndtr = channel.length;
            }
        }
        self.isr |= flags << (4 * number);
        let (from, to) = if is_from_memory { (memory, peripheral) } else { (peripheral, memory) };
        Some(Transfer { from, to })
    }

    /// Whether a channel (from 0) interrupts.
    pub fn interrupts(&self, channel: usize) -> bool {
        let flags = self.isr >> (4 * channel);
        flags & self.channels[channel].ccr & 0xe != 0
    }

    /// Reads a register of DMA1.
    pub fn read(&self, offset: u32) -> Access<u32> {
        match offset {
            ISR => Ok(self.isr),
            IFCR => Ok(0),
            _ => {
                let (number, register) = channel(offset)?;
                let Channel { ccr, cndtr, cpar, cmar, .. } = self.channels[number];
                [ccr, cndtr, cpar, cmar].get(register).copied().ok_or(Unmodelled)
            }
        }
    }

    /// Writes a register of DMA1.
    pub fn write(&mut self, offset: u32, value: u32) -> Access<()> {
        match offset {
            ISR => Err(Unmodelled),
            IFCR => {
                only(value, 0x00ff_ffff)?;
                // CGIF clears a channel's other flags too.
                let all = (0..CHANNELS).filter(|n| bit(value, 4 * *n as u32));
                self.isr &= !all.fold(value, |mask, n| mask | 0xf << (4 * n));
                Ok(())
            }
            _ => {
                let (number, register) = channel(offset)?;
                let channel = &mut self.channels[number];
                // Protected while the channel is enabled.
                if bit(channel.ccr, EN) && register > 0 {
                    return Err(Unmodelled);
                }
                match register {
                    0 => {
                        // All but MEM2MEM, and sizes that there are.
                        only(value, 0x3fff)?;
                        if field(value, PSIZE, 2) == 3 || field(value, MSIZE, 2) == 3 {
                            return Err(Unmodelled);
                        }
                        if bit(value, EN) && !bit(channel.ccr, EN) {
                            channel.length = channel.cndtr;
                        }
                        channel.ccr = value;
                    }
                    1 => {
                        store(&mut channel.cndtr, value, 0xffff)?;
                        channel.length = value;
                    }
                    2 => channel.cpar = value,
                    3 => channel.cmar = value,
                    _ => return Err(Unmodelled),
                }
                Ok(())
            }
        }
    }

    /// Reads a register of DMAMUX1.
    pub fn read_multiplexer(&self, offset: u32) -> Access<u32> {
        match self.channels.get((offset / 4) as usize) {
            Some(channel) => Ok(channel.request),
            None => Err(Unmodelled),
        }
    }

    /// Writes a register of DMAMUX1.
    pub fn write_multiplexer(&mut self, offset: u32, value: u32) -> Access<()> {
        let channel = self.channels.get_mut((offset / 4) as usize).ok_or(Unmodelled)?;
        store(&mut channel.request, value, 0x7f)
    }
}

/// Which channel's register is at an offset: CCR, CNDTR, CPAR, CMAR.
fn channel(offset: u32) -> Access<(usize, usize)> {
    let offset = offset.checked_sub(FIRST).ok_or(Unmodelled)?;
    let (number, register) = ((offset / STRIDE) as usize, (offset % STRIDE / 4) as usize);
    if number < CHANNELS && register < 4 { Ok((number, register)) } else { Err(Unmodelled) }
}
