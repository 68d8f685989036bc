//! The BBC micro:bit, an nRF51822. Registers after Nordic's *nRF51 Series Reference Manual* 3.0. Used here: UART0, TIMER0.

use super::Registers;

/// Clock of the timer (Hz).
const CLOCK: f32 = 16e6;

/// Interrupts that are used.
#[derive(Clone, Copy)]
pub enum Interrupt {
    /// UART0.
    Serial = 2,
    /// TIMER0.
    Timer = 8,
}

const UART0: Registers = Registers(0x4000_2000 as *mut u32);
const TIMER0: Registers = Registers(0x4000_8000 as *mut u32);

/// The serial port, UART0.
pub struct Port;

impl Port {
    const START_RECEIVER: usize = 0x000;
    const START_TRANSMITTER: usize = 0x008;
    const RECEIVED: usize = 0x108;
    const TRANSMITTED: usize = 0x11c;
    const INTERRUPT_SET: usize = 0x304;
    const INTERRUPT_CLEAR: usize = 0x308;
    const ENABLE: usize = 0x500;
    const RECEIVE_DATA: usize = 0x518;
    const TRANSMIT_DATA: usize = 0x51c;

    const ENABLED: u32 = 4;
    const INTERRUPT_RECEIVED: u32 = 1 << 2;

    /// Switches it on.
    pub fn start() {
        UART0.write(Self::ENABLE, Self::ENABLED);
        UART0.write(Self::START_RECEIVER, 1);
        UART0.write(Self::START_TRANSMITTER, 1);
    }

    /// Whether a byte waits to be read.
    pub fn has_byte() -> bool {
        UART0.read(Self::RECEIVED) != 0
    }

    /// Sleeps until there may be one.
    pub fn wait() {
        UART0.write(Self::INTERRUPT_SET, Self::INTERRUPT_RECEIVED);
        cortex_m::asm::wfi();
    }

    /// That byte.
    pub fn read_byte() -> u8 {
        // Before the byte is taken: the next one tells of itself at once.
        UART0.write(Self::RECEIVED, 0);
        UART0.read(Self::RECEIVE_DATA) as u8
    }

    /// Waits until the byte has gone.
    pub fn write_byte(byte: u8) {
        UART0.write(Self::TRANSMITTED, 0);
        UART0.write(Self::TRANSMIT_DATA, byte.into());
        while UART0.read(Self::TRANSMITTED) == 0 {}
    }

    /// Takes the interrupt's request back, until somebody waits: the event itself is all that tells of the byte.
    pub fn quieten() {
        UART0.write(Self::INTERRUPT_CLEAR, Self::INTERRUPT_RECEIVED);
    }
}

/// The timer that stands for the PWM timer.
pub struct Pacer {
    /// Clock cycles in a period.
    cycles: u32,
}

impl Pacer {
    const START: usize = 0x000;
    const CLEAR: usize = 0x00c;
    const COMPARED: usize = 0x140;
    const SHORTCUTS: usize = 0x200;
    const INTERRUPT_SET: usize = 0x304;
    const BIT_MODE: usize = 0x508;
    const PRESCALER: usize = 0x510;
    const COMPARE: usize = 0x540;

    const STOP_WHEN_COMPARED: u32 = 1 << 8;
    const INTERRUPT_COMPARED: u32 = 1 << 16;
    const BITS_32: u32 = 3;

    /// For a rate (Hz).
    pub fn new(rate: f32) -> Self {
        Self { cycles: (CLOCK / rate) as u32 }
    }

    /// Starts a period. The timer counts it once: while the host plays the motor, no further periods pass.
    pub fn start(&self) {
        TIMER0.write(Self::COMPARED, 0);
        TIMER0.write(Self::BIT_MODE, Self::BITS_32);
        TIMER0.write(Self::PRESCALER, 0);
        TIMER0.write(Self::SHORTCUTS, Self::STOP_WHEN_COMPARED);
        TIMER0.write(Self::INTERRUPT_SET, Self::INTERRUPT_COMPARED);
        TIMER0.write(Self::CLEAR, 1);
        TIMER0.write(Self::COMPARE, self.cycles);
        TIMER0.write(Self::START, 1);
    }
}
