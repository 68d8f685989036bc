//! An emulated B-G431B-ESC1: the microcontroller STM32G431CB with its registers, running the unmodified firmware image, byte for byte.
//!
//! ```no_run
//! # fn world() -> impl virtual_board::World + Send + 'static { struct W; impl virtual_board::World for W {
//! #     fn switch(&mut self, _: f64, _: virtual_board::world::Gates) {}
//! #     fn voltage(&mut self, _: f64, _: virtual_board::world::AnaloguePin) -> f64 { 0.0 }
//! #     fn encoder_edges(&mut self, _: f64) -> i64 { 0 }
//! #     fn level(&mut self, _: f64, _: virtual_board::world::InputPin) -> bool { true } } W }
//! use virtual_board::{Image, VirtualBoard};
//!
//! let image = Image::from_elf(&std::fs::read("target/firmware/b_g431b_esc1.elf")?)?;
//! let mut board = VirtualBoard::new(&image, world());
//! board.run_until(0.3)?;
//! assert!(!board.main_output());
//! # Ok::<(), Box<dyn std::error::Error>>(())
//! ```
//!
//! | module | what |
//! |---|---|
//! | [`world`] | what is wired to the pins, for others to implement |
//! | [`board`] | core, microcontroller and world, played in time; faults to play |
//! | [`chip`] | the microcontroller's blocks by their registers, one file each, and what connects them |
//! | `cpu` | the core: an interpreter around the decoder and the arithmetic of `rsemu` |
//! | [`image`] | the ELF file |
//! | [`memory`] | flash and SRAMs as the core sees them |
//! | [`statistics`] | what interrupts cost |
//! | [`time`] | ticks of 1/1360 µs, of which all clocks are multiples |
//!
//! Same image, same world, same commands: the same bits, on any machine.
//!
//! # What is modelled
//!
//! What the firmware uses, so that a wrong use shows: RCC, PWR, FLASH, GPIO, TIM1, TIM3, TIM4, TIM15, ADC1, ADC2, OPAMP1 to 3, COMP1, DAC3,
//! DMA1, DMAMUX1, USART2, IWDG, SYSCFG, DBGMCU, and the core's own registers; each file says how far. An access to anything else, to bits that are not modelled, or
//! to a block without a clock [stops](Stop) the emulation with address and program counter. Something that the data sheet forbids
//! but that hardware may go on with is a [`Violation`](chip::Violation).
//!
//! Register behaviour is after the reference manual RM0440 and the data sheet DS12589, in places from memory of them; nothing was
//! compared with a chip.
//!
//! # What is not modelled
//!
//! - **Wait states, caches and bus contention**: cycles are those of the Cortex-M4's manual from memory without wait states. What runs from
//!   core-coupled memory, as the control interrupt does, is nearest to that; code in flash takes longer on a chip. DMA takes no time.
//!   While flash is programmed or erased the core stands still, also where a chip could go on from its caches or SRAM.
//! - **Delays of some nanoseconds**: trigger from timer to timer, comparator, amplifiers (which follow at once between the supplies),
//!   encoder input filter. TIM1's break filter is modelled; the comparator looks every 5 µs, and with each of the filter's samples
//!   while it is above its threshold.
//! - **Inaccuracy**: crystal and oscillators are exact, converters ideal but for rounding. Noise, offsets and drift are the world's to add.
//! - **Gate drivers and power stage**: a pin that nobody drives and nothing pulls counts as low. Interlock and delays are the world's.
//! - Of the core: SysTick, ITM, FPB, and DWT but for the cycle counter, which stands still while the core sleeps, as on the chip.
//! - Debugger, other low-power modes than sleep, option bytes, CAN, and all that the firmware does not use.

pub mod board;
pub mod chip;
mod cpu;
pub mod image;
pub mod memory;
pub mod statistics;
pub mod time;
pub mod world;

pub use board::{Stop, VirtualBoard};
pub use image::Image;
pub use world::World;
