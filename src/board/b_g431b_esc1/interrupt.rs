//! The control interrupt: once a PWM period, from the converters' end of sequence to the bridge's compare values.
//!
//! It has the highest priority, and its code is in CCM SRAM (`memory.x`). Its state is its own. Tasks reach it by slots of one value each:
//! [`command`], [`commission`] and [`change`] go in, what became of it, [`status`] and [`telemetry`] come out. What does not fit waits or is dropped; a
//! period never is.

use super::analogue::{self, Conversions};
use super::bridge::{self, Bridge};
use super::encoder::Encoder;
use super::safety::Pauses;
use crate::board::handed_over::HandedOver;
use crate::board::slot::Slot;
use crate::commission::{Commission, Evidence, Progress};
use crate::config::ConfigError;
use crate::fault::{ActiveLimits, Fault, Faults};
use crate::hal::{Codes, Sample};
use crate::link::message::{Refusal, Status, Telemetry};
use crate::parameters::Parameters;
use crate::shunts::Shunts;
use crate::supervisor::{self, Command, Conditions, Mode, Output, Supervisor};
use core::sync::atomic::{AtomicU32, Ordering};
use cortex_m::peripheral::{DWT, NVIC};
use embassy_stm32::interrupt;
use embassy_stm32::interrupt::InterruptExt;

/// What became of a command.
#[derive(Clone, Copy, Debug)]
pub struct Answer {
    /// Whether it was taken.
    pub result: Result<(), supervisor::Refusal>,
    /// What the drive is doing since.
    pub status: Status,
    /// How far commissioning is.
    pub progress: Progress,
}

/// What the drive is told.
enum Order {
    Command(Command),
    /// Measure the motor with what is [prepared](Prepared::Commission).
    Commission,
}

/// What is to be taken of the next supervisor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Its controller, at any time.
    Controller,
    /// All of it, with outputs off. Heat and faults go on.
    Supervisor,
}

/// What a task has prepared for the interrupt. Never both, which saves the memory of one.
#[allow(clippy::large_enum_variant, reason = "both are large")]
enum Prepared {
    /// What the next change takes from.
    Supervisor(Supervisor<f32>),
    /// What measures the motor: the interrupt's in mode `Commissioning`, tasks' in all others.
    Commission(Commission),
}

static CONTROL: HandedOver<Control> = HandedOver::new();

static ORDER: Slot<Order> = Slot::new();
static ANSWER: Slot<Answer> = Slot::new();
static CHANGE: Slot<Change> = Slot::new();
static PREPARED: Slot<Prepared> = Slot::new();
static STATUS: Slot<Status> = Slot::new();
static TELEMETRY: Slot<Telemetry> = Slot::new();

/// Counts periods; stands still when the interrupt does.
static PERIODS: AtomicU32 = AtomicU32::new(0);

/// Periods from one telemetry to the next; zero: none.
static DECIMATION: AtomicU32 = AtomicU32::new(0);

/// Gives the drive a command and waits for the answer, which takes a period. Nothing if none comes in four.
pub fn command(command: Command) -> Option<Answer> {
    give(Order::Command(command))
}

/// Measures the motor. The drive is ready. Nothing if there is no answer.
pub fn commission(commission: Commission) -> Option<Answer> {
    PREPARED.discard();
    if PREPARED.put(Prepared::Commission(commission)) { give(Order::Commission) } else { None }
}

/// What was measured, if anything and if no change came since. Nothing is being measured.
pub fn evidence() -> Option<Evidence> {
    lend_commission(|commission| {
        // Whatever ended it.
        commission.abort();
        commission.evidence()
    })
}

fn lend_commission<R>(user: impl FnOnce(&mut Commission) -> R) -> Option<R> {
    let lent = PREPARED.lend(|prepared| match prepared {
        Prepared::Commission(commission) => Some(user(commission)),
        Prepared::Supervisor(_) => None,
    });
    lent.flatten()
}

fn give(order: Order) -> Option<Answer> {
    // One that came too late for its asker.
    ANSWER.take();
    if !ORDER.put(order) {
        return None;
    }
    let answer = wait_for(|| ANSWER.take());
    // One that was not taken in time must not be taken later.
    ORDER.discard();
    answer.or_else(|| ANSWER.take())
}

/// Looks for what the interrupt does, for four periods.
fn wait_for<R>(mut look: impl FnMut() -> Option<R>) -> Option<R> {
    (0..64).find_map(|_| {
        cortex_m::asm::delay(bridge::PERIOD / 16);
        look()
    })
}

/// Builds the next supervisor, which [`start`] or [`change`] take. Not before the last change was made, nor while the motor is measured.
// Not inlined: a caller would keep the stack of a supervisor while it calls on.
#[inline(never)]
pub(super) fn prepare(parameters: &Parameters) -> Result<(), ConfigError> {
    PREPARED.discard();
    PREPARED.fill(|| super::build(parameters).map(Prepared::Supervisor))
}

/// Changes controller or supervisor to those of parameters, which takes a period.
pub fn change(change: Change, parameters: &Parameters) -> Result<(), Refusal<'static>> {
    if CHANGE.is_full() {
        return Err(Refusal::Busy);
    }
    prepare(parameters)?;
    CHANGE.put(change);
    let is_made = wait_for(|| (!CHANGE.is_full()).then_some(())).is_some();
    // As for an order.
    CHANGE.discard();
    if is_made { Ok(()) } else { Err(Refusal::Busy) }
}

/// What the drive is doing, if that has changed.
pub fn status() -> Option<Status> {
    STATUS.take()
}

/// A period, if one is due.
pub fn telemetry() -> Option<Telemetry> {
    TELEMETRY.take()
}

/// Periods since the start; wraps.
pub fn periods() -> u32 {
    PERIODS.load(Ordering::Relaxed)
}

/// Sets how many periods lie between two of [`telemetry`]; zero: there is none.
pub fn set_telemetry(decimation: u32) {
    DECIMATION.store(decimation, Ordering::Relaxed);
}

/// Periods from one look at what is slow to the next: the temperature, pauses, and what is told of the status.
pub(super) const SLOW_PERIODS: u32 = 32;

/// What the interrupt works on.
struct Control {
    supervisor: Supervisor<f32>,
    bridge: Bridge,
    encoder: Encoder,
    shunts: Shunts,
    /// What was last told.
    status: Status,
    /// What the interrupt took (clock cycles), without the core's own entry and exit: the last one, and the longest.
    cycles: [u32; 2],
    /// Periods since the last telemetry.
    since_telemetry: u32,
    /// Whether the last command came too late for its update.
    is_late: bool,
    /// Of the board, as last looked at (°C).
    temperature: f32,
    /// When the last period began (clock cycles).
    started: u32,
    pauses: Pauses,
}

/// Hands everything and the supervisor that was [prepared](prepare) to the interrupt, with faults that there have been, and enables it.
/// Tells whether it runs.
#[inline(never)]
pub(super) fn start(faults: [Option<Fault>; 3], bridge: Bridge, encoder: Encoder) -> bool {
    let Some(Prepared::Supervisor(supervisor)) = PREPARED.take() else { return false };
    let control = Control {
        bridge,
        encoder,
        shunts: Shunts::new(analogue::SHUNTS),
        status: Status { mode: Mode::Boot, faults: Faults::NONE, limits: ActiveLimits::NONE },
        cycles: [0; 2],
        since_telemetry: 0,
        is_late: false,
        temperature: f32::NAN,
        started: 0,
        pauses: Pauses::new(),
        supervisor,
    };
    // SAFETY: the interrupt is still masked.
    let control = unsafe { CONTROL.hand_over(control) };
    for fault in faults.into_iter().flatten() {
        control.supervisor.latch(fault);
    }
    interrupt::ADC1_2.set_priority(interrupt::Priority::P0);
    NVIC::unpend(interrupt::ADC1_2);
    // SAFETY: all that the handler uses is in place.
    unsafe { interrupt::ADC1_2.enable() };
    super::wait_for(|| periods() > 0)
}

#[interrupt]
fn ADC1_2() {
    let start = DWT::cycle_count();
    // SAFETY: this is the interrupt's handler.
    if let Some(control) = unsafe { CONTROL.state() } {
        control.period(start);
    }
    // See `safety::order_writes`.
    cortex_m::asm::dsb();
}

impl Control {
    /// One PWM period, which began at a count of cycles.
    // Not inlined, for the linker to find it by its name.
    #[inline(never)]
    fn period(&mut self, start: u32) {
        bridge::take_update();
        let Conversions { legs, bus_voltage, temperature } = analogue::read();
        let counts = self.encoder.read();
        let is_next = start.wrapping_sub(self.started) < bridge::PERIOD + bridge::PERIOD / 2;
        self.started = start;
        if ORDER.is_full() {
            self.obey();
        }
        if CHANGE.is_full() {
            self.change();
        }
        let current = self.shunts.read(legs, self.bridge.is_on());
        let period = PERIODS.load(Ordering::Relaxed).wrapping_add(1);
        PERIODS.store(period, Ordering::Relaxed);
        let mut was_paused = false;
        if period % SLOW_PERIODS == 1 {
            was_paused = self.pauses.was_one();
            self.temperature = analogue::celsius(temperature);
            self.tell_status();
        }
        let conditions = Conditions {
            temperature: self.temperature,
            current_sensors: self.shunts.state(),
            tripped: self.bridge.has_tripped(),
            overrun: self.is_late || !counts.are_in_time || !is_next || was_paused,
        };
        let sample = Sample::Codes(Codes {
            encoder: *counts.reads,
            current,
            bus_voltage,
            shift: counts.shift,
        });
        let mut output = self.supervisor.step(&sample, &conditions);
        if self.supervisor.mode() == Mode::Commissioning {
            output = self.commission(&sample);
        }
        self.bridge.apply(output);
        // The update that these compare values were for has passed.
        self.is_late = bridge::take_update();

        self.since_telemetry = self.since_telemetry.wrapping_add(1);
        let decimation = DECIMATION.load(Ordering::Relaxed);
        if decimation > 0 && self.since_telemetry >= decimation {
            self.since_telemetry = 0;
            self.tell_period(period, output);
        }
        let [last, longest] = &mut self.cycles;
        *last = DWT::cycle_count().wrapping_sub(start);
        *longest = (*longest).max(*last);
    }

    /// Does what a task orders.
    #[cold]
    #[inline(never)]
    fn obey(&mut self) {
        let Some(order) = ORDER.take() else { return };
        let result = match order {
            Order::Command(command) => self.supervisor.command(command),
            Order::Commission => self.supervisor.start_commissioning(),
        };
        let progress = match self.supervisor.mode() {
            Mode::Commissioning => progress(),
            _ => Progress::OVER,
        };
        // There is room: who gave the order has emptied it.
        ANSWER.put(Answer { result, status: status_of(&self.supervisor), progress });
    }

    /// A period of commissioning, out of slower memory: it has the time. Without what measures it is over.
    #[cold]
    #[inline(never)]
    fn commission(&mut self, sample: &Sample<f32>) -> Output<f32> {
        let supervisor = &mut self.supervisor;
        lend_commission(|commission| supervisor.measure(sample, commission)).unwrap_or_else(|| {
            // Never refused: it measures.
            let _ = self.supervisor.command(Command::Off);
            Output::Off
        })
    }

    #[cold]
    #[inline(never)]
    fn change(&mut self) {
        let Some(change) = CHANGE.take() else { return };
        PREPARED.lend(|prepared| match (change, prepared) {
            (Change::Controller, Prepared::Supervisor(next)) => {
                self.supervisor.take_controller(next);
            }
            (Change::Supervisor, Prepared::Supervisor(next))
                if self.supervisor.output() == Output::Off =>
            {
                next.succeed(&self.supervisor);
                core::mem::swap(&mut self.supervisor, next);
            }
            // Nobody arms in the meantime, since the same task does both.
            _ => {}
        });
    }

    fn tell_status(&mut self) {
        let status = status_of(&self.supervisor);
        if status != self.status && STATUS.put(status) {
            self.status = status;
        }
    }

    #[cold]
    #[inline(never)]
    fn tell_period(&mut self, period: u32, output: Output<f32>) {
        let drive = self.supervisor.drive();
        let [current, bus_voltage] = drive.current_and_bus();
        let [reference, voltage, load_torque] = match (drive.telemetry(), output) {
            // The drive does not drive.
            (_, Output::Duty(duty)) if self.supervisor.mode() == Mode::Commissioning => {
                [0.0, duty * bus_voltage, 0.0]
            }
            (Some(law), Output::Duty(_)) => [law.reference.speed, law.voltage, law.load_torque],
            _ => [0.0; 3],
        };
        let [interrupt_time, longest_interrupt_time] =
            self.cycles.map(|cycles| cycles * 100 / (super::CYCLES_PER_MICROSECOND / 10));
        // If the last one was not taken yet, this one is dropped.
        TELEMETRY.put(Telemetry {
            period,
            reference,
            speed: drive.speed(),
            current,
            voltage,
            bus_voltage,
            load_torque,
            temperature: self.temperature,
            interrupt_time,
            longest_interrupt_time,
        });
    }
}

/// How far commissioning is.
#[cold]
#[inline(never)]
fn progress() -> Progress {
    lend_commission(|commission| commission.progress()).unwrap_or(Progress::OVER)
}

fn status_of(supervisor: &Supervisor<f32>) -> Status {
    Status { mode: supervisor.mode(), faults: supervisor.faults(), limits: supervisor.limits() }
}
