//! QEMU's Arm MPS2 boards (mps2-an386: Cortex-M4F, mps2-an500: Cortex-M7) as a drive's board.
//!
//! There is no motor: the sample of each period comes in over the serial port from a host that plays it, and the command
//! goes out the same way ([`crate::protocol`]). A timer's interrupt paces the loop as a PWM timer would.
//!
//! Registers after Arm's *CMSDK Technical Reference Manual* (DDI 0479), addresses after *Application Note AN386*; both
//! boards have the same. Used here: UART0, TIMER0, the NVIC.
#![allow(unsafe_code, reason = "memory-mapped registers")]

use super::handed_over::HandedOver;
use crate::drive::{Drive, DriveConfig};
use crate::hal::{Board, BridgeCommand, Sample};
use crate::protocol::{
    MAGIC, Question, Record, Setup, VERSION, Verdict, codes_from_words, exact_from_words,
};
use crate::sense::Sensors;
use cortex_m::peripheral::NVIC;
use cortex_m_rt::exception;

/// Clock of the core and of the timers (Hz).
const CLOCK: f32 = 25e6;

/// Interrupts that are used.
#[derive(Clone, Copy)]
enum Interrupt {
    Uart0Receive = 0,
    Timer0 = 8,
}

// SAFETY: the numbers are those of AN386, below the 32 that the boards have.
unsafe impl cortex_m::interrupt::InterruptNumber for Interrupt {
    fn number(self) -> u16 {
        self as u16
    }
}

/// A peripheral's registers, by index.
struct Registers(*mut u32);

impl Registers {
    fn read(&self, index: usize) -> u32 {
        // SAFETY: the addresses and indices in this file are those of readable registers.
        unsafe { self.0.add(index).read_volatile() }
    }

    fn write(&self, index: usize, value: u32) {
        // SAFETY: the addresses and indices in this file are those of writable registers.
        unsafe { self.0.add(index).write_volatile(value) }
    }
}

const UART0: Registers = Registers(0x4000_4000 as *mut u32);
const TIMER0: Registers = Registers(0x4000_0000 as *mut u32);

/// Words over UART0, one byte at a time.
struct Serial;

impl Serial {
    const DATA: usize = 0;
    const STATE: usize = 1;
    const CONTROL: usize = 2;
    const INTERRUPT: usize = 3;
    const BAUD_DIVISOR: usize = 4;

    const STATE_TRANSMIT_FULL: u32 = 1 << 0;
    const STATE_RECEIVE_FULL: u32 = 1 << 1;
    const CONTROL_TRANSMIT: u32 = 1 << 0;
    const CONTROL_RECEIVE: u32 = 1 << 1;
    const CONTROL_RECEIVE_INTERRUPT: u32 = 1 << 3;
    const INTERRUPT_RECEIVE: u32 = 1 << 1;

    /// Switches the port on. Its interrupt is there to wake the core from its wait for a byte.
    fn start() -> Self {
        // The fastest divisor: QEMU does not model the baud rate.
        UART0.write(Self::BAUD_DIVISOR, 16);
        UART0.write(
            Self::CONTROL,
            Self::CONTROL_TRANSMIT | Self::CONTROL_RECEIVE | Self::CONTROL_RECEIVE_INTERRUPT,
        );
        // SAFETY: its handler shares nothing with anyone but a flag of the port that it clears.
        unsafe { NVIC::unmask(Interrupt::Uart0Receive) };
        Self
    }

    fn read_byte(&mut self) -> u8 {
        // Asleep rather than polling, which would keep QEMU from delivering the byte.
        cortex_m::interrupt::free(|_| {
            while UART0.read(Self::STATE) & Self::STATE_RECEIVE_FULL == 0 {
                cortex_m::asm::wfi();
            }
            let byte = UART0.read(Self::DATA);
            UART0.write(Self::INTERRUPT, Self::INTERRUPT_RECEIVE);
            NVIC::unpend(Interrupt::Uart0Receive);
            byte as u8
        })
    }

    fn write_byte(&mut self, byte: u8) {
        while UART0.read(Self::STATE) & Self::STATE_TRANSMIT_FULL != 0 {}
        UART0.write(Self::DATA, byte.into());
    }

    fn read<const N: usize>(&mut self) -> [u32; N] {
        [(); N].map(|()| u32::from_le_bytes([(); 4].map(|()| self.read_byte())))
    }

    fn write<const N: usize>(&mut self, words: [u32; N]) {
        for byte in words.into_iter().flat_map(u32::to_le_bytes) {
            self.write_byte(byte);
        }
    }
}

/// The board, seen from the drive: this period's sample, and where its command goes.
struct Exchange {
    sample: Sample<f32>,
    command: BridgeCommand<f32>,
}

impl Board<f32> for Exchange {
    fn sample(&mut self) -> Sample<f32> {
        self.sample
    }

    fn apply(&mut self, command: BridgeCommand<f32>) {
        self.command = command;
    }
}

/// What the timer's interrupt works on.
struct Loop {
    drive: Drive<f32>,
    /// What the host's samples are.
    sensors: Sensors,
    serial: Serial,
    pacer: Pacer,
    record: Record,
}

impl Loop {
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
    let (drive, config) = loop {
        if let Some(accepted) = set_up(&mut serial) {
            break accepted;
        }
    };
    let record = Record { command: BridgeCommand::Off, mode: drive.mode(), telemetry: None };
    let pacer = Pacer::new(config.timing.rate);
    pacer.start();
    // SAFETY: the timer's interrupt, the only other user, is still masked.
    unsafe { LOOP.hand_over(Loop { drive, sensors: config.sensors, serial, pacer, record }) };
    enable_interrupt();
    loop {
        cortex_m::asm::wfi();
    }
}

/// Answers a setup; gives the armed drive and its configuration if it is accepted.
fn set_up(serial: &mut Serial) -> Option<(Drive<f32>, DriveConfig)> {
    let [magic, version] = serial.read();
    let answer = |serial: &mut Serial, verdict: Verdict| {
        serial.write([MAGIC, VERSION, verdict as u32]);
    };
    if magic != MAGIC || version != VERSION {
        defmt::error!("host speaks protocol {=u32}, this is {=u32}", version, VERSION);
        answer(serial, Verdict::WrongVersion);
        return None;
    }
    let built = Setup::from_words(serial.read()).and_then(|Setup(config)| {
        let mut drive = Drive::new(&config).ok()?;
        drive.arm().ok()?;
        Some((drive, config))
    });
    answer(serial, if built.is_some() { Verdict::Accepted } else { Verdict::Refused });
    match &built {
        Some((_, config)) => defmt::info!("drive armed, {=f32} Hz", config.timing.rate),
        None => defmt::error!("setup refused"),
    }
    built
}

/// The timer that stands for the PWM timer.
struct Pacer {
    /// Clock cycles in a period.
    cycles: u32,
}

impl Pacer {
    const CONTROL: usize = 0;
    const VALUE: usize = 1;
    const RELOAD: usize = 2;
    const INTERRUPT_CLEAR: usize = 3;
    const ENABLE_WITH_INTERRUPT: u32 = 1 << 0 | 1 << 3;

    /// For a rate (Hz).
    fn new(rate: f32) -> Self {
        Self { cycles: (CLOCK / rate) as u32 }
    }

    /// Starts a period. The timer counts it down once: while the host plays the motor, no further periods pass.
    fn start(&self) {
        TIMER0.write(Self::INTERRUPT_CLEAR, 1);
        TIMER0.write(Self::RELOAD, u32::MAX);
        TIMER0.write(Self::VALUE, self.cycles);
        TIMER0.write(Self::CONTROL, Self::ENABLE_WITH_INTERRUPT);
    }
}

/// Enables the timer's interrupt.
fn enable_interrupt() {
    // SAFETY: all that the handler uses is in place. The timer's priority is lowered below the serial port's, whose
    // interrupt must be able to wake the handler's wait for a byte.
    unsafe {
        let mut nvic = cortex_m::Peripherals::steal().NVIC;
        nvic.set_priority(Interrupt::Timer0, 0x40);
        NVIC::unmask(Interrupt::Timer0);
    }
}

/// The PWM-rate interrupt.
extern "C" fn timer0() {
    // SAFETY: this is the interrupt's handler.
    if let Some(control_loop) = unsafe { LOOP.state() } {
        control_loop.pacer.start();
        control_loop.period();
    }
}

/// A byte came while nobody waited: it stays in the port until it is read.
extern "C" fn uart0_receive() {
    UART0.write(Serial::INTERRUPT, Serial::INTERRUPT_RECEIVE);
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
    vectors[Interrupt::Uart0Receive as usize] = Vector { handler: uart0_receive };
    vectors[Interrupt::Timer0 as usize] = Vector { handler: timer0 };
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
