//! Arm's MPS2 boards. Registers after Arm's *CMSDK Technical Reference Manual* (DDI 0479), addresses after *Application Note
//! AN386*; all have the same. Used here: UART0, TIMER0.

use super::Registers;

/// Clock of the core and of the timers (Hz).
const CLOCK: f32 = 25e6;

/// Interrupts that are used.
#[derive(Clone, Copy)]
pub enum Interrupt {
    /// UART0's receiver.
    Serial = 0,
    /// TIMER0.
    Timer = 8,
}

const UART0: Registers = Registers(0x4000_4000 as *mut u32);
const TIMER0: Registers = Registers(0x4000_0000 as *mut u32);

/// The serial port, UART0.
pub struct Port;

impl Port {
    const DATA: usize = 0x00;
    const STATE: usize = 0x04;
    const CONTROL: usize = 0x08;
    const INTERRUPT: usize = 0x0c;
    const BAUD_DIVISOR: usize = 0x10;

    const STATE_TRANSMIT_FULL: u32 = 1 << 0;
    const STATE_RECEIVE_FULL: u32 = 1 << 1;
    const CONTROL_TRANSMIT: u32 = 1 << 0;
    const CONTROL_RECEIVE: u32 = 1 << 1;
    const CONTROL_RECEIVE_INTERRUPT: u32 = 1 << 3;
    const INTERRUPT_RECEIVE: u32 = 1 << 1;

    /// Switches it on, with its receiver's interrupt.
    pub fn start() {
        // The fastest divisor: QEMU does not model the baud rate.
        UART0.write(Self::BAUD_DIVISOR, 16);
        UART0.write(
            Self::CONTROL,
            Self::CONTROL_TRANSMIT | Self::CONTROL_RECEIVE | Self::CONTROL_RECEIVE_INTERRUPT,
        );
    }

    /// Whether a byte waits to be read.
    pub fn has_byte() -> bool {
        UART0.read(Self::STATE) & Self::STATE_RECEIVE_FULL != 0
    }

    /// Sleeps until there may be one.
    pub fn wait() {
        cortex_m::asm::wfi();
    }

    /// That byte.
    pub fn read_byte() -> u8 {
        let byte = UART0.read(Self::DATA);
        Self::quieten();
        byte as u8
    }

    /// Waits until the port takes a byte.
    pub fn write_byte(byte: u8) {
        while UART0.read(Self::STATE) & Self::STATE_TRANSMIT_FULL != 0 {}
        UART0.write(Self::DATA, byte.into());
    }

    /// Takes the interrupt's request back.
    pub fn quieten() {
        UART0.write(Self::INTERRUPT, Self::INTERRUPT_RECEIVE);
    }
}

/// The timer that stands for the PWM timer.
pub struct Pacer {
    /// Clock cycles in a period.
    cycles: u32,
}

impl Pacer {
    const CONTROL: usize = 0x00;
    const VALUE: usize = 0x04;
    const RELOAD: usize = 0x08;
    const INTERRUPT_CLEAR: usize = 0x0c;
    const ENABLE_WITH_INTERRUPT: u32 = 1 << 0 | 1 << 3;

    /// For a rate (Hz).
    pub fn new(rate: f32) -> Self {
        Self { cycles: (CLOCK / rate) as u32 }
    }

    /// Starts a period. The timer counts it down once: while the host plays the motor, no further periods pass.
    pub fn start(&self) {
        TIMER0.write(Self::INTERRUPT_CLEAR, 1);
        TIMER0.write(Self::RELOAD, u32::MAX);
        TIMER0.write(Self::VALUE, self.cycles);
        TIMER0.write(Self::CONTROL, Self::ENABLE_WITH_INTERRUPT);
    }
}
