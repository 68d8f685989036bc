//! The control interrupt: once a PWM period, from the converters' end of sequence to the bridge's compare values.
//!
//! It has the highest priority, and its code is in CCM SRAM (`memory.x`). Its state is its own. Tasks reach it by [`send`], a command a
//! period, and [`report`]; a report that nobody takes delays the next one, never a period.

use super::analogue::{self, Conversions};
use super::bridge::{self, Bridge};
use super::encoder::{Counts, Encoder};
use crate::board::handed_over::HandedOver;
use crate::board::slot::Slot;
use crate::fault::{ActiveLimits, Faults};
use crate::hal::{Codes, Sample};
use crate::shunts::Shunts;
use crate::supervisor::{Command, Conditions, Mode, Refusal, Supervisor};
use core::sync::atomic::{AtomicU32, Ordering};
use cortex_m::peripheral::{DWT, NVIC};
use embassy_stm32::interrupt;
use embassy_stm32::interrupt::InterruptExt;

/// Periods from one report to the next, as long as nobody sets another number.
const REPORT_EVERY: u32 = 2000;

/// What the interrupt tells.
#[derive(Clone, Copy, Debug)]
pub struct Report {
    /// Periods since the start; wraps.
    pub period: u32,
    /// Whether the drive drives.
    pub mode: Mode,
    /// Latched faults.
    pub faults: Faults,
    /// What is held back.
    pub limits: ActiveLimits,
    /// The reference's speed (rad/s); zero before the first driven period, as all that the law tells.
    pub reference: f32,
    /// Shaft speed (rad/s).
    pub speed: f32,
    /// Armature current (A).
    pub current: f32,
    /// Armature voltage asked of the bridge (V).
    pub voltage: f32,
    /// Estimated load torque (N·m).
    pub load_torque: f32,
    /// Bus voltage (V).
    pub bus_voltage: f32,
    /// Board temperature (°C).
    pub temperature: f32,
    /// The command that was refused last, and why.
    pub refused: Option<Refusal>,
    /// What the interrupt took (clock cycles): the last one before this report, and the longest.
    pub cycles: Cycles,
}

/// Time of the interrupt (clock cycles), without the core's own entry and exit.
#[derive(Clone, Copy, Debug, Default)]
pub struct Cycles {
    /// Of the last one.
    pub last: u32,
    /// Of the longest one.
    pub longest: u32,
}

static CONTROL: HandedOver<Control> = HandedOver::new();

static COMMAND: Slot<Command<f32>> = Slot::new();

static REPORT: Slot<Report> = Slot::new();

/// Counts periods; stands still when the interrupt does.
static PERIODS: AtomicU32 = AtomicU32::new(0);

static REPORT_PERIODS: AtomicU32 = AtomicU32::new(REPORT_EVERY);

/// Gives the drive a command. Gives it back if the last one was not taken yet, which takes a period.
pub fn send(command: Command<f32>) -> Result<(), Command<f32>> {
    COMMAND.put(command)
}

/// What the drive reports, if there is something new.
pub fn report() -> Option<Report> {
    REPORT.take()
}

/// Periods since the start; wraps.
pub fn periods() -> u32 {
    PERIODS.load(Ordering::Relaxed)
}

/// Sets how many periods lie between two reports.
pub fn report_every(periods: u32) {
    REPORT_PERIODS.store(periods.max(1), Ordering::Relaxed);
}

/// What the interrupt works on.
struct Control {
    supervisor: Supervisor<f32>,
    bridge: Bridge,
    encoder: Encoder,
    shunts: Shunts,
    refused: Option<Refusal>,
    cycles: Cycles,
    until_report: u32,
    /// Whether the last command came too late for its update.
    is_late: bool,
}

/// Hands everything to the interrupt and enables it.
pub(super) fn start(supervisor: Supervisor<f32>, bridge: Bridge, encoder: Encoder) {
    // SAFETY: the interrupt is still masked.
    unsafe {
        CONTROL.hand_over(Control {
            supervisor,
            bridge,
            encoder,
            shunts: Shunts::new(analogue::SHUNTS),
            refused: None,
            cycles: Cycles::default(),
            until_report: 1,
            is_late: false,
        });
    }
    interrupt::ADC1_2.set_priority(interrupt::Priority::P0);
    NVIC::unpend(interrupt::ADC1_2);
    // SAFETY: all that the handler uses is in place.
    unsafe { interrupt::ADC1_2.enable() };
}

#[interrupt]
fn ADC1_2() {
    let start = DWT::cycle_count();
    // SAFETY: this is the interrupt's handler.
    if let Some(control) = unsafe { CONTROL.state() } {
        control.period(start);
    }
}

impl Control {
    /// One PWM period, which began at a count of cycles.
    // Not inlined, for the linker to find it by its name.
    #[inline(never)]
    fn period(&mut self, start: u32) {
        bridge::take_update();
        let Conversions { legs, bus_voltage, temperature } = analogue::read();
        let Counts { reads, shift, is_in_time } = self.encoder.read();
        if let Some(command) = COMMAND.take() {
            self.refused = self.supervisor.command(command).err().or(self.refused);
        }
        let current = self.shunts.read(legs, self.bridge.is_on());
        let conditions = Conditions {
            temperature,
            current_sensors: self.shunts.state(),
            tripped: self.bridge.has_tripped(),
            overrun: self.is_late || !is_in_time,
        };
        let codes = Codes { current, bus_voltage, encoder: reads, shift };
        let output = self.supervisor.step(&Sample::Codes(codes), &conditions);
        self.bridge.apply(output);
        // The update that these compare values were for has passed.
        self.is_late = bridge::take_update();

        let period = PERIODS.load(Ordering::Relaxed).wrapping_add(1);
        PERIODS.store(period, Ordering::Relaxed);
        self.until_report = self.until_report.saturating_sub(1);
        if self.until_report == 0 {
            self.report(period, temperature);
        }
        self.cycles.last = DWT::cycle_count().wrapping_sub(start);
        self.cycles.longest = self.cycles.longest.max(self.cycles.last);
    }

    #[cold]
    #[inline(never)]
    fn report(&mut self, period: u32, temperature: f32) {
        let drive = self.supervisor.drive();
        let [current, bus_voltage] = drive.current_and_bus();
        let [reference, speed, voltage, load_torque] = drive.telemetry().map_or([0.0; 4], |law| {
            [law.reference.speed, law.signals.speed, law.voltage, law.load_torque]
        });
        let report = Report {
            period,
            mode: self.supervisor.mode(),
            faults: self.supervisor.faults(),
            limits: self.supervisor.limits(),
            reference,
            speed,
            current,
            voltage,
            load_torque,
            bus_voltage,
            temperature,
            refused: self.refused,
            cycles: self.cycles,
        };
        if REPORT.put(report).is_ok() {
            self.refused = None;
            self.until_report = REPORT_PERIODS.load(Ordering::Relaxed);
        }
    }
}
