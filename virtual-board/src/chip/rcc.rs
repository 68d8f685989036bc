//! Reset and clock control (RM0440, chapter *Reset and clock control*).
//!
//! Modelled: oscillators and PLL with their start-up times, the system clock's switch and the AHB prescaler, clock enables and resets of
//! blocks, the clock security system, reset flags. HSI48, which feeds nothing. Not: APB prescalers other than 1, LSE and RTC, clock outputs.

use super::block::{Access, Unmodelled, bit, field, only, store};
use crate::time::{MICROSECOND, NEVER, SECOND, Tick};

const CR: u32 = 0x00;
const CFGR: u32 = 0x08;
const PLLCFGR: u32 = 0x0c;
const CIER: u32 = 0x18;
const CIFR: u32 = 0x1c;
const CICR: u32 = 0x20;
const CCIPR: u32 = 0x88;
const BDCR: u32 = 0x90;
const CSR: u32 = 0x94;
const CRRCR: u32 = 0x98;

/// AHB1, AHB2, AHB3, (none), APB1 first and second, APB2, from these on.
const RSTR: u32 = 0x28;
const ENR: u32 = 0x48;
const SMENR: u32 = 0x68;
const BUSES: u32 = 7;

// CR
const HSION: u32 = 8;
const HSIRDY: u32 = 10;
const HSEON: u32 = 16;
const HSERDY: u32 = 17;
const CSSON: u32 = 19;
const PLLON: u32 = 24;
const PLLRDY: u32 = 25;

/// CIFR: the clock security system has found the crystal failed.
const CSSF: u32 = 8;

/// CSR: clears the reset flags.
const RMVF: u32 = 23;

/// Start-up times of the crystal and the PLL: of the size in data sheets, from memory. Nothing depends on them but how long the start takes.
const CRYSTAL_START: Tick = 2000 * MICROSECOND;
const PLL_START: Tick = 40 * MICROSECOND;

/// Frequencies (Hz).
const HSI: u64 = 16_000_000;
const HSE: u64 = 8_000_000;

/// Why the microcontroller was reset; the number is the flag's in RCC_CSR.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Hash)]
pub enum Reset {
    /// Power came.
    Power = 27,
    /// The pin NRST.
    Pin = 26,
    /// The core asked for it.
    Software = 28,
    /// The independent watchdog.
    Watchdog = 29,
}

/// Where a block's clock enable and reset bits are: bus and bit.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Gate(pub u32, pub u32);

impl Gate {
    /// Of DMA1.
    pub const DMA1: Self = Self(0, 0);
    /// Of DMAMUX1.
    pub const DMAMUX1: Self = Self(0, 2);
    /// Of the flash interface.
    pub const FLASH: Self = Self(0, 8);
    /// Of port A.
    pub const GPIOA: Self = Self(1, 0);
    /// Of port B.
    pub const GPIOB: Self = Self(1, 1);
    /// Of port C.
    pub const GPIOC: Self = Self(1, 2);
    /// Of ADC1 and ADC2.
    pub const ADC12: Self = Self(1, 13);
    /// Of DAC3.
    pub const DAC3: Self = Self(1, 18);
    /// Of TIM3.
    pub const TIM3: Self = Self(4, 1);
    /// Of TIM4.
    pub const TIM4: Self = Self(4, 2);
    /// Of USART2.
    pub const USART2: Self = Self(4, 17);
    /// Of PWR.
    pub const PWR: Self = Self(4, 28);
    /// Of SYSCFG, COMP and OPAMP.
    pub const SYSCFG: Self = Self(6, 0);
    /// Of TIM1.
    pub const TIM1: Self = Self(6, 11);
    /// Of TIM15.
    pub const TIM15: Self = Self(6, 16);
}

/// The registers.
pub struct Rcc {
    cr: u32,
    cfgr: u32,
    pllcfgr: u32,
    cier: u32,
    cifr: u32,
    ccipr: u32,
    bdcr: u32,
    csr: u32,
    crrcr: u32,
    rstr: [u32; BUSES as usize],
    enr: [u32; BUSES as usize],
    smenr: [u32; BUSES as usize],
    /// When an oscillator or the PLL will be ready; `NEVER` for one that is off.
    hse_ready: Tick,
    pll_ready: Tick,
    /// Whether the crystal is broken.
    is_crystal_broken: bool,
}

impl Rcc {
    /// After a reset; `flags` are those of earlier ones, as in RCC_CSR.
    pub fn new(flags: u32, reset: Reset, is_crystal_broken: bool) -> Self {
        // Every internal reset pulls the pin.
        let flags = if reset == Reset::Power { 0 } else { flags } | 1 << Reset::Pin as u32;
        Self {
            cr: 0x63 | 1 << HSION,
            cfgr: 0x0000_0005,
            pllcfgr: 0x0000_1000,
            cier: 0,
            cifr: 0,
            ccipr: 0,
            bdcr: 0,
            csr: flags | 1 << reset as u32,
            crrcr: 0,
            rstr: [0; BUSES as usize],
            enr: [0x0000_0100, 0, 0, 0, 0x0000_0400, 0, 0],
            smenr: [!0; BUSES as usize],
            hse_ready: NEVER,
            pll_ready: NEVER,
            is_crystal_broken,
        }
    }

    /// Flags in RCC_CSR of why it was reset.
    pub fn flags(&self) -> u32 {
        self.csr & 0xfe00_0000
    }

    /// Whether a block has its clock.
    pub fn is_on(&self, gate: Gate) -> bool {
        self.enr[gate.0 as usize] & 1 << gate.1 != 0
    }

    /// Whether a block is held in reset.
    pub fn is_in_reset(&self, gate: Gate) -> bool {
        self.rstr[gate.0 as usize] & 1 << gate.1 != 0
    }

    /// Ticks of a cycle of the core's clock, which is also all buses' and timers'. Nothing while it stands still.
    pub fn cycle(&self) -> Option<Tick> {
        let frequency = match field(self.cfgr, 0, 2) {
            1 => HSI,
            2 if bit(self.cr, HSEON) && !self.is_crystal_broken => HSE,
            3 if bit(self.cr, PLLON) => self.pll()?,
            _ => return None,
        };
        let prescaler = match field(self.cfgr, 4, 4) {
            0..=7 => 1,
            code => [2, 4, 8, 16, 64, 128, 256, 512][code as usize - 8],
        };
        Some(SECOND / frequency * prescaler)
    }

    /// Frequency of the PLL's output R (Hz).
    fn pll(&self) -> Option<u64> {
        let source = match field(self.pllcfgr, 0, 2) {
            2 => HSI,
            3 if !self.is_crystal_broken => HSE,
            _ => return None,
        };
        // PLLREN
        if !bit(self.pllcfgr, 24) {
            return None;
        }
        let divisor = u64::from(field(self.pllcfgr, 4, 4) + 1);
        let multiplier = u64::from(field(self.pllcfgr, 8, 7));
        let output = 2 * u64::from(field(self.pllcfgr, 25, 2) + 1);
        Some(source * multiplier / divisor / output)
    }

    /// The crystal breaks, now. Without the clock security system a clock that depends on it stands still.
    pub fn break_crystal(&mut self, now: Tick) {
        self.is_crystal_broken = true;
        let was_running = bit(self.cr, HSEON) && now >= self.hse_ready;
        if was_running && bit(self.cr, CSSON) {
            let feeds_clock = match field(self.cfgr, 0, 2) {
                2 => true,
                3 => field(self.pllcfgr, 0, 2) == 3,
                _ => false,
            };
            self.cr &= !(1 << HSEON | 1 << CSSON);
            self.hse_ready = NEVER;
            if feeds_clock {
                self.cr = self.cr & !(1 << PLLON) | 1 << HSION;
                self.pll_ready = NEVER;
                self.cfgr = self.cfgr & !3 | 1;
            }
            self.cifr |= 1 << CSSF;
        }
    }

    /// Whether the crystal is broken.
    pub fn is_crystal_broken(&self) -> bool {
        self.is_crystal_broken
    }

    /// Whether the clock security system has found a failure: a non-maskable interrupt, and TIM1's break.
    pub fn nmi(&self) -> bool {
        bit(self.cifr, CSSF)
    }

    /// Reads a register.
    pub fn read(&self, offset: u32, now: Tick) -> Access<u32> {
        Ok(match offset {
            CR => {
                let ready = |on, ready: u32, at| u32::from(bit(self.cr, on) && now >= at) << ready;
                self.cr
                    | ready(HSION, HSIRDY, 0)
                    | ready(HSEON, HSERDY, self.hse_ready)
                    | ready(PLLON, PLLRDY, self.pll_ready)
            }
            CFGR => self.cfgr & !0xc | field(self.cfgr, 0, 2) << 2,
            PLLCFGR => self.pllcfgr,
            CIER => self.cier,
            CIFR => self.cifr,
            CCIPR => self.ccipr,
            BDCR => self.bdcr,
            // LSIRDY follows LSION.
            CSR => self.csr | (self.csr & 1) << 1,
            // HSI48RDY follows HSI48ON.
            CRRCR => self.crrcr | (self.crrcr & 1) << 1,
            _ => match bus(offset)? {
                (RSTR, bus) => self.rstr[bus],
                (ENR, bus) => self.enr[bus],
                (_, bus) => self.smenr[bus],
            },
        })
    }

    /// Writes a register.
    pub fn write(&mut self, offset: u32, value: u32, now: Tick) -> Access<()> {
        match offset {
            CR => self.write_cr(value, now),
            CFGR => {
                // Switch, prescaler of the AHB; those of the APBs at 1.
                only(value, 0xff)?;
                let before = core::mem::replace(&mut self.cfgr, value & !0xc);
                if self.cycle().is_some() {
                    Ok(())
                } else {
                    self.cfgr = before;
                    Err(Unmodelled)
                }
            }
            PLLCFGR if bit(self.cr, PLLON) => Err(Unmodelled),
            // Source, divisor, multiplier, output R.
            PLLCFGR => store(&mut self.pllcfgr, value, 0x0700_7ff3),
            CIER => store(&mut self.cier, value, 0),
            CICR => {
                only(value, 1 << CSSF)?;
                self.cifr &= !value;
                Ok(())
            }
            CCIPR => store(&mut self.ccipr, value, 3 << 28),
            // BDRST, RTCSEL, RTCEN: for a clock that is not modelled.
            BDCR => store(&mut self.bdcr, value, 0x0001_8300),
            CSR => {
                // The flags are the hardware's; LSION, for the watchdog, which starts it anyway.
                only(value & 0x00ff_ffff, 1 << RMVF | 3)?;
                let flags = if bit(value, RMVF) { 0 } else { self.flags() };
                self.csr = flags | value & 1;
                Ok(())
            }
            CRRCR => store(&mut self.crrcr, value & !2, 1),
            _ => {
                let (register, bus) = bus(offset)?;
                match register {
                    RSTR => self.rstr[bus] = value,
                    ENR => self.enr[bus] = value,
                    // Clocks go on in sleep, as reset has it.
                    _ => only(value ^ self.smenr[bus], 0)?,
                }
                Ok(())
            }
        }
    }

    fn write_cr(&mut self, value: u32, now: Tick) -> Access<()> {
        let on = 1 << HSION | 1 << HSEON | 1 << CSSON | 1 << PLLON;
        let ready = 1 << HSIRDY | 1 << HSERDY | 1 << PLLRDY;
        only(value, on | ready | 0x63)?;
        let start = |bit: u32, at: Tick, time: Tick| match (value & 1 << bit, self.cr & 1 << bit) {
            (0, _) => NEVER,
            (_, 0) => now + time,
            _ => at,
        };
        let hse_ready = if self.is_crystal_broken {
            NEVER
        } else {
            start(HSEON, self.hse_ready, CRYSTAL_START)
        };
        let pll_ready = start(PLLON, self.pll_ready, PLL_START);
        (self.hse_ready, self.pll_ready) = (hse_ready, pll_ready);
        // The security system is switched off by a reset only.
        let before = self.cr;
        self.cr = value & !ready | before & 1 << CSSON;
        if self.cycle().is_some() {
            Ok(())
        } else {
            self.cr = before;
            Err(Unmodelled)
        }
    }
}

/// Which register of which bus is at an offset.
fn bus(offset: u32) -> Access<(u32, usize)> {
    [RSTR, ENR, SMENR]
        .into_iter()
        .find(|first| (*first..first + 4 * BUSES).contains(&offset) && offset != first + 12)
        .map(|first| (first, ((offset - first) / 4) as usize))
        .ok_or(Unmodelled)
}
