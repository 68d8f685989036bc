//! QEMU's boards as a drive's board: Arm's MPS2 (mps2-an386: Cortex-M4F, mps2-an500: Cortex-M7, mps2-an385: Cortex-M3) and the BBC
//! micro:bit (Cortex-M0). Cores without an FPU compute in fixed point.
//!
//! There is no motor: the sample of each period comes in over the serial port from a host that plays it, and the command
//! goes out the same way ([`crate::protocol`]). A timer's interrupt paces the loop as a PWM timer would.
#![allow(unsafe_code, reason = "memory-mapped registers")]

#[cfg(feature = "microbit")]
#[path = "nrf51.rs"]
mod machine;
#[cfg(not(feature = "microbit"))]
#[path = "mps2.rs"]
mod machine;

use super::handed_over::HandedOver;
use crate::drive::{Drive, DriveConfig};
use crate::hal::{Board, BridgeCommand, Sample};
use crate::protocol::{
    MAGIC, Question, Record, Setup, VERSION, Verdict, Word, codes_from_words, exact_from_words,
};
use crate::sense::Sensors;
use cortex_m::peripheral::NVIC;
use cortex_m_rt::exception;
use machine::{Interrupt, Pacer, Port};

/// What the drive computes in.
#[cfg(target_abi = "eabihf")]
type Signal = f32;
#[cfg(not(target_abi = "eabihf"))]
type Signal = crate::math::Q31;

// SAFETY: the numbers are below the 32 that every machine here has.
unsafe impl cortex_m::interrupt::InterruptNumber for Interrupt {
    fn number(self) -> u16 {
        self as u16
    }
}

/// A peripheral's registers, by their offset in bytes.
struct Registers(*mut u32);

impl Registers {
    fn read(&self, offset: usize) -> u32 {
        // SAFETY: the addresses and offsets in this module are those of readable registers.
        unsafe { self.0.byte_add(offset).read_volatile() }
    }

    fn write(&self, offset: usize, value: u32) {
        // SAFETY: the addresses and offsets in this module are those of writable registers.
        unsafe { self.0.byte_add(offset).write_volatile(value) }
    }
}

/// Words over the serial port, one byte at a time.
struct Serial;

impl Serial {
    /// Switches the port on. Its interrupt is there to wake the core from its wait for a byte.
    fn start() -> Self {
        Port::start();
        // SAFETY: its handler shares nothing with anyone but a flag of the port that it clears.
        unsafe { NVIC::unmask(Interrupt::Serial) };
        Self
    }

    fn read_byte(&mut self) -> u8 {
        // Asleep rather than polling, which would keep QEMU from delivering the byte.
        cortex_m::interrupt::free(|_| {
            while !Port::has_byte() {
                Port::wait();
            }
            let byte = Port::read_byte();
            NVIC::unpend(Interrupt::Serial);
            byte
        })
    }

    fn read<const N: usize>(&mut self) -> [u32; N] {
        [(); N].map(|()| u32::from_le_bytes([(); 4].map(|()| self.read_byte())))
    }

    fn write<const N: usize>(&mut self, words: [u32; N]) {
        for byte in words.into_iter().flat_map(u32::to_le_bytes) {
            Port::write_byte(byte);
        }
    }
}

/// The board, seen from the drive: this period's sample, and where its command goes.
struct Exchange {
    sample: Sample<Signal>,
    command: BridgeCommand<Signal>,
}

impl Board<Signal> for Exchange {
    fn sample(&mut self) -> Sample<Signal> {
        self.sample
    }

    fn apply(&mut self, command: BridgeCommand<Signal>) {
        self.command = command;
    }
}

/// What the timer's interrupt works on.
struct Loop {
    drive: Drive<Signal>,
    /// What the host's samples are.
    sensors: Sensors,
    serial: Serial,
    pacer: Pacer,
    record: Record<Signal>,
}

impl Loop {
    /// An armed drive.
    fn new(config: &DriveConfig) -> Option<Self> {
        let mut drive = Drive::new(config).ok()?;
        drive.arm().ok()?;
        let record = Record { command: BridgeCommand::Off, mode: drive.mode(), telemetry: None };
        let pacer = Pacer::new(config.timing.rate);
        Some(Self { drive, sensors: config.sensors, serial: Serial, pacer, record })
    }

    /// One period: answers the host's questions up to and including its sample.
    fn period(&mut self) {
        loop {
            match Question::from_byte(self.serial.read_byte()) {
                Some(Question::Record) => self.serial.write(self.record.to_words()),
                Some(Question::Sample) => break,
                Some(Question::TargetAndSample) => {
                    let [target] = self.serial.read().map(f32::from_bits);
                    // A refused command leaves the former one; the host sees the reference in the record.
                    let _ = self.drive.set_speed(target);
                    break;
                }
                None => stop(),
            }
        }
        let sample = match self.sensors {
            Sensors::Exact => Sample::Exact(exact_from_words(self.serial.read())),
            Sensors::Codes(_) => Sample::Codes(codes_from_words(self.serial.read())),
        };
        let mut board = Exchange { sample, command: BridgeCommand::Off };
        self.drive.run_period(&mut board);
        self.record = Record {
            command: board.command,
            mode: self.drive.mode(),
            telemetry: self.drive.telemetry(),
        };
        self.serial.write(self.record.reply().to_words());
    }
}

static LOOP: HandedOver<Loop> = HandedOver::new();

/// A hundred instructions in a straight line, to show that a count of instructions misses none.
#[inline(never)]
fn calibration() {
    // SAFETY: does nothing.
    unsafe { core::arch::asm!(".rept 100", "nop", ".endr", options(nomem, nostack)) }
}

/// Waits for a host's [`Setup`], then runs the drive that it describes from the timer's interrupt.
pub fn run() -> ! {
    calibration();
    let mut serial = Serial::start();
    while !set_up(&mut serial) {}
    enable_interrupt();
    loop {
        cortex_m::asm::wfi();
    }
}

/// Answers a setup; tells whether it was accepted, and the loop is ready.
// Not inlined: where RAM is short, a drive has no room on the stack while another one is built.
#[inline(never)]
fn set_up(serial: &mut Serial) -> bool {
    let [magic, version] = serial.read();
    let answer = |serial: &mut Serial, verdict: Verdict| {
        serial.write([MAGIC, VERSION, verdict as u32, Signal::NAME]);
    };
    if magic != MAGIC || version != VERSION {
        defmt::error!("host speaks protocol {=u32}, this is {=u32}", version, VERSION);
        answer(serial, Verdict::WrongVersion);
        return false;
    }
    let Some(config) = Setup::from_words(serial.read()).and_then(|Setup(config)| {
        // SAFETY: the timer's interrupt, the only other user, is still masked.
        unsafe { LOOP.hand_over(Loop::new(&config)?) };
        Some(config)
    }) else {
        defmt::error!("setup refused");
        answer(serial, Verdict::Refused);
        return false;
    };
    Pacer::new(config.timing.rate).start();
    answer(serial, Verdict::Accepted);
    defmt::info!("drive armed, {=f32} Hz", config.timing.rate);
    true
}

/// Enables the timer's interrupt.
fn enable_interrupt() {
    // SAFETY: all that the handler uses is in place. The timer's priority is lowered below the serial port's, whose
    // interrupt must be able to wake the handler's wait for a byte.
    unsafe {
        let mut nvic = cortex_m::Peripherals::steal().NVIC;
        nvic.set_priority(Interrupt::Timer, 0x40);
        NVIC::unmask(Interrupt::Timer);
    }
}

/// The PWM-rate interrupt.
extern "C" fn timer() {
    // SAFETY: this is the interrupt's handler.
    if let Some(control_loop) = unsafe { LOOP.state() } {
        control_loop.pacer.start();
        control_loop.period();
    }
}

/// A byte came while nobody waited: it stays in the port until it is read.
extern "C" fn serial() {
    Port::quieten();
}

/// An entry of the vector table.
#[repr(C)]
pub union Vector {
    handler: extern "C" fn(),
    reserved: usize,
}

extern "C" fn unused() {
    stop();
}

/// The interrupts' part of the vector table.
#[unsafe(link_section = ".vector_table.interrupts")]
#[unsafe(no_mangle)]
pub static __INTERRUPTS: [Vector; 32] = {
    let mut vectors = [const { Vector { handler: unused } }; 32];
    vectors[Interrupt::Serial as usize] = Vector { handler: serial };
    vectors[Interrupt::Timer as usize] = Vector { handler: timer };
    vectors
};

/// Stops for good: there is no bridge to switch off, and the host sees that no reply comes. Without a log: logging may
/// panic, and this is where a panic ends.
fn stop() -> ! {
    cortex_m::interrupt::disable();
    loop {
        cortex_m::asm::wfi();
    }
}

#[exception]
unsafe fn HardFault(_frame: &cortex_m_rt::ExceptionFrame) -> ! {
    stop()
}

#[panic_handler]
fn panic(_info: &core::panic::PanicInfo) -> ! {
    stop()
}
