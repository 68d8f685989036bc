//! What is at which address (RM0440, chapter *Memory organization*), which clock it needs, and what follows from a write.

use super::block::{Access, Unmodelled};
use super::rcc::Gate;
use super::{Cause, Chip, adc, comp, dac, dma, gpio, opamp, pwr, syscfg, tim, tim4, usart};
use crate::world::World;

/// ADC1; ADC2 and what both share are 0x100 and 0x300 above it.
pub const ADC1: u32 = 0x5000_0000;

/// A block.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Block {
    Tim3,
    Tim4,
    Iwdg,
    Usart2,
    Pwr,
    Syscfg,
    Comp,
    Opamp,
    Tim1,
    Tim15,
    Dma1,
    Dmamux1,
    Rcc,
    Flash,
    Gpio(usize),
    Adc(usize),
    AdcCommon,
    Dac3,
    Dbgmcu,
}

/// The block at an address, the gate of its clock, and where it begins.
fn block(address: u32) -> Access<(Block, Option<Gate>, u32)> {
    let page = address & !0x3ff;
    let (block, gate, base) = match (page, address & 0x3ff) {
        (0x4000_0400, _) => (Block::Tim3, Some(Gate::TIM3), page),
        (0x4000_0800, _) => (Block::Tim4, Some(Gate::TIM4), page),
        (0x4000_3000, _) => (Block::Iwdg, None, page),
        (0x4000_4400, _) => (Block::Usart2, Some(Gate::USART2), page),
        (0x4000_7000, _) => (Block::Pwr, Some(Gate::PWR), page),
        (0x4001_0000, 0..0x30) => (Block::Syscfg, Some(Gate::SYSCFG), page),
        (0x4001_0000, 0x200..0x204) => (Block::Comp, Some(Gate::SYSCFG), page + 0x200),
        (0x4001_0000, 0x300..0x30c) => (Block::Opamp, Some(Gate::SYSCFG), page + 0x300),
        (0x4001_2c00, _) => (Block::Tim1, Some(Gate::TIM1), page),
        (0x4001_4000, _) => (Block::Tim15, Some(Gate::TIM15), page),
        (0x4002_0000, _) => (Block::Dma1, Some(Gate::DMA1), page),
        (0x4002_0800, _) => (Block::Dmamux1, Some(Gate::DMAMUX1), page),
        (0x4002_1000, _) => (Block::Rcc, None, page),
        (0x4002_2000, _) => (Block::Flash, Some(Gate::FLASH), page),
        (0x4800_0000, _) => (Block::Gpio(0), Some(Gate::GPIOA), page),
        (0x4800_0400, _) => (Block::Gpio(1), Some(Gate::GPIOB), page),
        (0x4800_0800, _) => (Block::Gpio(2), Some(Gate::GPIOC), page),
        (ADC1, 0..0x100) => (Block::Adc(0), Some(Gate::ADC12), page),
        (ADC1, 0x100..0x200) => (Block::Adc(1), Some(Gate::ADC12), page + 0x100),
        (ADC1, 0x300..) => (Block::AdcCommon, Some(Gate::ADC12), page + 0x300),
        (0x5000_1000, _) => (Block::Dac3, Some(Gate::DAC3), page),
        (0xe004_2000, _) => (Block::Dbgmcu, None, page),
        _ => return Err(Unmodelled),
    };
    Ok((block, gate, base))
}

impl<W: World> Chip<W> {
    /// The block at an address, with the offset in it, if it has its clock.
    fn locate(&self, address: u32) -> Result<(Block, u32), Cause> {
        let (block, gate, base) = block(address)?;
        if gate.is_some_and(|gate| !self.rcc.is_on(gate) || self.rcc.is_in_reset(gate)) {
            return Err(Cause::NoClock);
        }
        Ok((block, address - base))
    }

    /// Reads the register at an address.
    pub(super) fn read_register(&mut self, address: u32) -> Result<u32, Cause> {
        let (block, offset) = self.locate(address)?;
        let (now, cycle) = (self.now, self.cycle.unwrap_or(1));
        let value = match block {
            Block::Tim3 => self.tim3.read(offset, now, cycle),
            Block::Tim4 => {
                let edges = self.encoder_edges();
                self.tim4.count(edges);
                self.tim4.read(offset)
            }
            Block::Iwdg => self.iwdg.read(offset, now),
            Block::Usart2 => self.usart.read(offset),
            Block::Pwr => self.pwr.read(offset),
            Block::Syscfg => self.syscfg.read(offset),
            Block::Comp => {
                self.look_at_comparator(cycle);
                self.comp.read(offset)
            }
            Block::Opamp => self.opamps.read(offset),
            Block::Tim1 => self.tim1.read(offset, now, cycle),
            Block::Tim15 => self.tim15.read(offset, now, cycle),
            Block::Dma1 => self.dma.read(offset),
            Block::Dmamux1 => self.dma.read_multiplexer(offset),
            Block::Rcc => self.rcc.read(offset, now),
            Block::Flash => self.flash.read(offset),
            Block::Gpio(port) => {
                let levels = self.levels(port);
                self.gpio[port].read(offset, levels)
            }
            Block::Adc(number) => self.adc[number].read(offset, now),
            Block::AdcCommon => self.adc_common.read(offset),
            Block::Dac3 => self.dac.read(offset),
            Block::Dbgmcu => self.dbgmcu.read(offset),
        };
        Ok(value?)
    }

    /// Writes the register at an address.
    pub(super) fn write_register(&mut self, address: u32, value: u32) -> Result<(), Cause> {
        let (block, offset) = self.locate(address)?;
        let (now, cycle) = (self.now, self.cycle.unwrap_or(1));
        match block {
            Block::Tim3 => self.tim3.write(offset, value, now, cycle)?,
            Block::Tim4 => {
                let edges = self.encoder_edges();
                self.tim4.count(edges);
                self.tim4.write(offset, value)?;
            }
            Block::Iwdg => self.iwdg.write(offset, value, now)?,
            Block::Usart2 => self.usart.write(offset, value, now, cycle)?,
            Block::Pwr => {
                self.pwr.write(offset, value)?;
                self.follow_clock();
            }
            Block::Syscfg => {
                self.syscfg.write(offset, value)?;
                self.follow();
            }
            Block::Comp => {
                self.comp.write(offset, value)?;
                if self.comp.input().is_some() && self.dac.output().is_none() {
                    return Err(Cause::UnconnectedInput);
                }
                self.look_at_comparator(cycle);
            }
            Block::Opamp => self.opamps.write(offset, value)?,
            Block::Tim1 => {
                let was_on = self.tim1.main_output();
                self.tim1.write(offset, value, now, cycle)?;
                self.follow_tim1();
                self.note_switch(was_on);
            }
            Block::Tim15 => self.tim15.write(offset, value, now, cycle)?,
            Block::Dma1 => self.dma.write(offset, value)?,
            Block::Dmamux1 => self.dma.write_multiplexer(offset, value)?,
            Block::Rcc => {
                self.rcc.write(offset, value, now)?;
                self.reset_blocks();
                self.follow_clock();
                self.follow();
            }
            Block::Flash => {
                self.flash.write(offset, value, now)?;
                self.follow_clock();
                self.follow();
            }
            Block::Gpio(port) => {
                self.gpio[port].write(offset, value)?;
                self.update_gates();
            }
            Block::Adc(number) => {
                let cycle = self.adc_cycle();
                self.adc[number].write(offset, value, now, cycle)?;
            }
            // Not while a converter is on (RM0440, ADC12_CCR's CKMODE).
            Block::AdcCommon if self.adc.iter().any(adc::Adc::is_enabled) => {
                return Err(Cause::Unmodelled);
            }
            Block::AdcCommon => self.adc_common.write(offset, value)?,
            Block::Dac3 => self.dac.write(offset, value)?,
            Block::Dbgmcu => self.dbgmcu.write(offset, value)?,
        }
        Ok(())
    }

    /// Resets the blocks that RCC holds in reset. Of the flash only the registers that a restart sets anyway: nothing here.
    fn reset_blocks(&mut self) {
        let holds = |gate| self.rcc.is_in_reset(gate);
        for (port, gate) in [Gate::GPIOA, Gate::GPIOB, Gate::GPIOC].into_iter().enumerate() {
            if holds(gate) {
                self.gpio[port] = gpio::Gpio::new(port);
            }
        }
        if holds(Gate::DMA1) || holds(Gate::DMAMUX1) {
            self.dma = dma::Dma::new();
        }
        if holds(Gate::ADC12) {
            self.adc = [adc::Adc::new(), adc::Adc::new()];
            self.adc_common = adc::Common::new();
        }
        if holds(Gate::DAC3) {
            self.dac = dac::Dac::new();
        }
        if holds(Gate::TIM3) {
            self.tim3 = tim::Tim::new();
        }
        if holds(Gate::TIM4) {
            self.tim4 = tim4::Tim4::new();
        }
        if holds(Gate::TIM15) {
            self.tim15 = tim::Tim::new();
        }
        if holds(Gate::PWR) {
            self.pwr = pwr::Pwr::new();
        }
        if holds(Gate::SYSCFG) {
            self.syscfg = syscfg::Syscfg::new();
            self.comp = comp::Comp::new();
            self.opamps = opamp::Opamps::new();
        }
        if holds(Gate::USART2) {
            let usart = core::mem::replace(&mut self.usart, usart::Usart::new(usart::Line::new(1)));
            self.usart = usart::Usart::new(usart.into_line());
        }
        if holds(Gate::TIM1) {
            self.tim1.reset();
        }
        self.update_gates();
    }
}
