//! The drive on ST's B-G431B-ESC1.
//!
//! The control interrupt does the work ([`quasidrive::board::b_g431b_esc1`]). Here is what runs beside it: the serial link, the watchdog,
//! log, LED and button.
#![no_std]
#![no_main]

use defmt_rtt as _;
use embassy_executor::Spawner;
use embassy_stm32::gpio::{Input, Level, Output, Pull, Speed};
use embassy_time::{Duration, Ticker};
use quasidrive::board::b_g431b_esc1::link::{Link, Port};
use quasidrive::board::b_g431b_esc1::{Board, feed_watchdog, interrupt, start};
use quasidrive::link::message::Status;
use quasidrive::supervisor::{Command, Mode};

/// A turn of the main loop (ms); a fifth of the watchdog's time.
const TURN: u64 = 10;

#[embassy_executor::main]
async fn main(spawner: Spawner) {
    let Board { link, port, led, button, is_running } = start();
    match serve(link, port) {
        Ok(task) => spawner.spawn(task),
        Err(_) => defmt::error!("no room for the link"),
    }
    if is_running {
        defmt::info!("started, outputs off");
    } else {
        defmt::error!("the hardware did not start: outputs stay off");
    }
    let mut led = Output::new(led, Level::Low, Speed::Low);
    let button = Input::new(button, Pull::Up);
    let mut ticker = Ticker::every(Duration::from_millis(TURN));
    let mut last = interrupt::periods();
    loop {
        ticker.next().await;
        // Fed only if both go on: this loop and the interrupt. Without an interrupt outputs are off for good, and there is nothing to watch.
        let periods = interrupt::periods();
        if periods != last || !is_running {
            feed_watchdog();
        }
        last = periods;
        if button.is_low() {
            // Refused if they are off already.
            interrupt::command(Command::Off);
        }
        if let Some(status) = interrupt::status() {
            led.set_level(Level::from(status.mode != Mode::Faulted));
            log(&status);
        }
    }
}

#[embassy_executor::task]
async fn serve(link: Link, port: Port) {
    link.serve(port).await;
}

fn log(status: &Status) {
    let mode = match status.mode {
        Mode::Boot => "boot",
        Mode::Calibrating => "calibrating",
        Mode::Ready => "ready",
        Mode::Armed => "armed",
        Mode::Running => "running",
        Mode::Stopping => "stopping",
        Mode::Faulted => "faulted",
        Mode::Commissioning => "commissioning",
    };
    defmt::info!("{=str}", mode);
    for fault in status.faults.iter() {
        defmt::error!("fault {=u8}: {=str}", fault as u8, fault.entry().name);
    }
    for limit in status.limits.iter() {
        defmt::info!("limit {=u8}: {=str}", limit as u8, limit.entry().name);
    }
}
