//! The drive on ST's B-G431B-ESC1.
//!
//! The control interrupt does the work ([`quasidrive::board::b_g431b_esc1`]). Here is what runs beside it: watchdog, log, LED, button.
#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::gpio::{Input, Level, Output, Pull, Speed};
use embassy_time::{Duration, Ticker};
use quasidrive::board::b_g431b_esc1::{Board, Report, Tasks, interrupt, start};
use quasidrive::supervisor::{Command, Mode};

/// A turn of the main loop (ms); a fifth of the watchdog's time.
const TURN: u64 = 10;

#[embassy_executor::main]
async fn main(_spawner: Spawner) {
    let Board { mut tasks, mut watchdog, led, button, fault } = start();
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
        if periods != last || tasks.is_none() {
            watchdog.pet();
        }
        last = periods;
        let Some(Tasks { commands, reports }) = &mut tasks else { continue };
        if button.is_low() {
            // Full of commands that were not taken yet: the next turn tries again.
            let _ = commands.enqueue(Command::Off);
        }
        while let Some(report) = reports.dequeue() {
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
