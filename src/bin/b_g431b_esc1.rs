//! The drive on ST's B-G431B-ESC1.
//!
//! The control interrupt does the work ([`quasidrive::board::b_g431b_esc1`]). Here is what runs beside it: watchdog, log, LED, button.
#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::gpio::{Input, Level, Output, Pull, Speed};
use embassy_time::{Duration, Ticker};
use quasidrive::board::b_g431b_esc1::interrupt::{self, Report};
use quasidrive::board::b_g431b_esc1::{Board, start};
use quasidrive::supervisor::{Command, Mode};

/// A turn of the main loop (ms); a fifth of the watchdog's time.
const TURN: u64 = 10;

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let Board { mut watchdog, led, button, fault, is_running } = start();
    let mut led = Output::new(led, Level::Low, Speed::Low);
    let button = Input::new(button, Pull::Up);
    if let Some(fault) = fault {
        defmt::error!("fault {=u8} from the start", fault as u8);
    }
    let mut ticker = Ticker::every(Duration::from_millis(TURN));
    let mut last = interrupt::periods();
    let mut mode = Mode::Boot;
    loop {
        ticker.next().await;
        // Fed only if both go on: this loop and the interrupt. Without an interrupt outputs are off for good, and there is nothing to watch.
        let periods = interrupt::periods();
        if periods != last || !is_running {
            watchdog.pet();
        }
        last = periods;
        if button.is_low() {
            // If there was no room for it, the next turn tries again.
            let _ = interrupt::send(Command::Off);
        }
        if let Some(report) = interrupt::report() {
            log(&report, mode);
            mode = report.mode;
            led.set_level(Level::from(mode != Mode::Faulted));
        }
    }
}

/// A line for a report.
fn log(report: &Report, mode_before: Mode) {
    if report.mode != mode_before {
        defmt::info!("mode {=u8}, faults {=u32:#x}", report.mode as u8, report.faults.0);
    }
    if report.refused.is_some() {
        defmt::warn!("a command was refused");
    }
    defmt::info!(
        "{=f32} rad/s of {=f32}, {=f32} A, {=f32} V of {=f32}, {=f32} °C, interrupt {=u32} cycles, at most {=u32}",
        report.speed,
        report.reference,
        report.current,
        report.voltage,
        report.bus_voltage,
        report.temperature,
        report.cycles.last,
        report.cycles.longest
    );
}
