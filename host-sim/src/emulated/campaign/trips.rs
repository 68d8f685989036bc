//! What must take the bridge off.
//!
//! Bounds are from `docs/faults.md` and the code, in periods of 50 µs, which begin with a sample:
//!
//! - *in the same period*: something is seen by the next sample, at most a period later, and the interrupt that it starts ends the outputs less
//!   than a period later: [`SAMPLED`];
//! - *within 64 periods*: the slow checks' turn, and as before;
//! - *after 3 periods*: the third sample in a row, and as before;
//! - *after 25 ms*: [`AUTHORITY_TIME`], from when an observer is at its limit; until then it has to get there, which took up to 40 ms in
//!   `tests/drive.rs`;
//! - by the watchdog: 50 ms after it was last fed, which the main loop may do once more within its turn of 10 ms;
//! - by an exception: a core that sleeps gets there by the next interrupt, a period later at most.

use super::bench::Bench;
use super::{Case, Finding, PERIOD, Result, Stand};
use crate::connect::in_words;
use crate::wired::circuit::{Leg, Rail, Short};
use crate::wired::encoder::EncoderFault;
use crate::wired::faults::Fault as Broken;
use crate::wired::pads::{ShuntFault, ThermistorFault};
use anyhow::ensure;
use quasidrive::drive::AUTHORITY_TIME;
use quasidrive::fault::Fault;
use quasidrive::supervisor::Mode;
use std::num::NonZeroU32;
use virtual_board::chip::Reset;

/// Seen by the next sample, off by its interrupt.
const SAMPLED: f64 = 2.0 * PERIOD;

/// The slow checks' turn.
const SLOW: f64 = 64.0 * PERIOD + SAMPLED;

/// Shunts that disagree.
const DISAGREEING: f64 = 2.0 * PERIOD + SAMPLED;

/// A short circuit is only seen once a pulse has driven a current through it.
const PULSE: f64 = PERIOD + SAMPLED;

/// An observer at its limit.
const EXHAUSTED: f64 = AUTHORITY_TIME as f64 + 40e-3;

/// The watchdog's time, and a turn of the main loop.
const WATCHDOG: f64 = 50e-3 + 10e-3 + 1e-3;

/// An exception, entered from sleep.
const EXCEPTION: f64 = 1.4 * PERIOD;

/// Speed of the motor (rad/s).
const SPEED: f32 = 100.0;

/// How long a cause stays beyond its bound (s), and how long the bridge is watched to stay off then: two of the averages in which shunts are
/// learnt anew, of which the first may have begun with the cause.
const LONGER: f64 = 20e-3;
const STAYING: f64 = 0.12;

/// What breaks.
#[derive(Clone, Copy)]
enum Cause {
    /// Something around the board.
    World(Broken),
    /// Something in it; the interrupts are let go afterwards.
    Board(fn(&Bench)),
    /// The host says nothing more.
    Silence,
    /// The host says nothing but this.
    Garbage,
}

struct Trip {
    name: &'static str,
    speed: f32,
    cause: Cause,
    bound: f64,
    /// One of these must be told, and nothing else.
    told: &'static [Fault],
    why: &'static str,
}

impl Trip {
    const fn world(
        name: &'static str,
        fault: Broken,
        bound: f64,
        told: &'static [Fault],
        why: &'static str,
    ) -> Self {
        Self { name, speed: SPEED, cause: Cause::World(fault), bound, told, why }
    }

    const fn board(name: &'static str, act: fn(&Bench), bound: f64, why: &'static str) -> Self {
        let told = &[Fault::WatchdogReset];
        Self { name, speed: SPEED, cause: Cause::Board(act), bound, told, why }
    }
}

const SAME: &str = "the period of the sample that shows it";
const BEYOND: &str = "25 ms beyond an observer's authority, which it reaches within 40 ms";
const STUCK: &[Fault] = &[Fault::BeyondAuthority, Fault::ModelMismatch];
/// A high current through one shunt shows in several ways at once.
const SHORTED: &[Fault] = &[Fault::Overcurrent, Fault::CurrentSensors, Fault::HardwareTrip];
const DISAGREE: &[Fault] = &[Fault::CurrentSensors, Fault::Overcurrent];
const BY_SHUNTS: &str = "the third sample in a row, or an over-current before";

const fn short_of(leg: Leg, rail: Rail) -> Broken {
    Broken::LegShorted(Short { leg, rail })
}

fn trips() -> Vec<Trip> {
    use Broken::{BoardTemperature, CurrentSensor, Encoder, Supply, Thermistor};
    let two = NonZeroU32::MIN.saturating_add(1);
    vec![
        Trip::world("over-voltage", Supply(30.0), SAMPLED, &[Fault::BusOvervoltage], SAME),
        Trip::world("under-voltage", Supply(7.0), SAMPLED, &[Fault::BusUndervoltage], SAME),
        Trip::world(
            "over-current, by software: motor shorted, driven forward",
            Broken::MotorShorted,
            PULSE,
            SHORTED,
            "a pulse within a period, then the sample that shows it",
        ),
        Trip {
            name: "over-current, by the comparator: motor shorted, driven backward, the control interrupt held off",
            speed: -SPEED,
            cause: Cause::Board(|bench| {
                bench.emulated.board().force_interrupt(18, Some(false));
                bench.inject(Broken::MotorShorted, 1e-3);
            }),
            bound: SAMPLED,
            told: &[Fault::HardwareTrip, Fault::Overrun, Fault::Overcurrent, Fault::CurrentSensors],
            why: "a pulse within a period, and no software",
        },
        Trip::world(
            "U touches ground",
            short_of(Leg::U, Rail::Ground),
            DISAGREEING + PERIOD,
            SHORTED,
            BY_SHUNTS,
        ),
        Trip::world(
            "U touches the supply",
            short_of(Leg::U, Rail::Supply),
            DISAGREEING + PERIOD,
            SHORTED,
            BY_SHUNTS,
        ),
        Trip::world(
            "V touches ground",
            short_of(Leg::V, Rail::Ground),
            DISAGREEING + PERIOD,
            SHORTED,
            BY_SHUNTS,
        ),
        Trip::world(
            "V touches the supply",
            short_of(Leg::V, Rail::Supply),
            DISAGREEING + PERIOD,
            SHORTED,
            BY_SHUNTS,
        ),
        Trip::world("motor lead open", Broken::LeadOpen, EXHAUSTED, STUCK, BEYOND),
        Trip::world("rotor blocked", Broken::RotorBlocked, EXHAUSTED, STUCK, BEYOND),
        Trip::world(
            "encoder unplugged",
            Encoder(EncoderFault::Unplugged),
            EXHAUSTED,
            STUCK,
            BEYOND,
        ),
        Trip::world("encoder frozen", Encoder(EncoderFault::Frozen), EXHAUSTED, STUCK, BEYOND),
        Trip::world("encoder reversed", Encoder(EncoderFault::Reversed), EXHAUSTED, STUCK, BEYOND),
        Trip::world(
            "encoder loses every other count",
            Encoder(EncoderFault::EachLost(two)),
            EXHAUSTED,
            STUCK,
            BEYOND,
        ),
        Trip::world(
            "U's current stuck at 8 A",
            CurrentSensor(Leg::U, ShuntFault::Stuck(8.0)),
            DISAGREEING,
            DISAGREE,
            BY_SHUNTS,
        ),
        Trip::world(
            "V's current stuck at -8 A",
            CurrentSensor(Leg::V, ShuntFault::Stuck(-8.0)),
            DISAGREEING,
            DISAGREE,
            BY_SHUNTS,
        ),
        Trip::world(
            "U's current at its upper end",
            CurrentSensor(Leg::U, ShuntFault::High),
            DISAGREEING,
            SHORTED,
            BY_SHUNTS,
        ),
        Trip::world(
            "U's current at its lower end",
            CurrentSensor(Leg::U, ShuntFault::Low),
            DISAGREEING,
            DISAGREE,
            BY_SHUNTS,
        ),
        Trip::world(
            "V's current at its upper end",
            CurrentSensor(Leg::V, ShuntFault::High),
            DISAGREEING,
            DISAGREE,
            BY_SHUNTS,
        ),
        Trip::world(
            "V's current at its lower end",
            CurrentSensor(Leg::V, ShuntFault::Low),
            DISAGREEING,
            DISAGREE,
            BY_SHUNTS,
        ),
        Trip::world(
            "V's current drifts by 100 A/s",
            CurrentSensor(Leg::V, ShuntFault::Drift(100.0)),
            4.2 / 100.0 + DISAGREEING,
            DISAGREE,
            "the shunts differ by 4 A and noise, three samples in a row",
        ),
        Trip::world(
            "over-temperature",
            BoardTemperature(95.0),
            SLOW,
            &[Fault::Overtemperature],
            "a turn of the slow checks",
        ),
        Trip::world(
            "thermistor open",
            Thermistor(ThermistorFault::Open),
            SLOW,
            &[Fault::TemperatureSensor],
            "a turn of the slow checks",
        ),
        Trip::world(
            "thermistor shorted",
            Thermistor(ThermistorFault::Shorted),
            SLOW,
            &[Fault::TemperatureSensor],
            "a turn of the slow checks",
        ),
        Trip {
            name: "commands lost",
            speed: SPEED,
            cause: Cause::Silence,
            bound: COMMAND_LOST,
            told: &[Fault::CommandLost],
            why: "command_timeout, stop_time and three turns of the slow checks",
        },
        Trip {
            name: "nothing but garbage on the line",
            speed: SPEED,
            cause: Cause::Garbage,
            bound: COMMAND_LOST,
            told: &[Fault::CommandLost],
            why: "garbage is no sign of life: as commands lost",
        },
        Trip::board(
            "panic",
            |bench| {
                assert!(bench.emulated.board().jump_to("rust_begin_unwind"), "no panic handler")
            },
            EXCEPTION,
            "the handler's first instruction",
        ),
        Trip::board(
            "hard fault",
            |bench| bench.emulated.board().jump(0x1fff_fff0),
            EXCEPTION,
            "the handler's first instruction",
        ),
        Trip::board(
            "stack overflow",
            |bench| bench.emulated.board().exhaust_stack(16),
            EXCEPTION,
            "lock-up, which is a break",
        ),
        Trip::board(
            "control interrupt stuck on",
            |bench| bench.emulated.board().force_interrupt(18, Some(true)),
            WATCHDOG,
            "the watchdog, fed once more at most",
        ),
        Trip::board(
            "control interrupt stuck off",
            |bench| bench.emulated.board().force_interrupt(18, Some(false)),
            WATCHDOG,
            "the watchdog, fed once more at most",
        ),
    ]
}

/// Silence, then a stop that takes its longest, as the campaign's parameters have it.
const COMMAND_LOST: f64 = 0.3 + 0.5 + 3.0 * 64.0 * PERIOD;

pub fn cases() -> Vec<Case> {
    let trips = trips().into_iter().enumerate().map(|(index, trip)| Case {
        name: trip.name,
        demand: format!("off by {}; {}", trip.why, names(trip.told)),
        bound: Some(trip.bound),
        // Multiples of the golden ratio: the faults are spread over the period.
        play: Box::new(move |stand| trip.play(stand, (0.618 * index as f64).fract())),
    });
    trips.chain([button(), clock(), current_zero()]).collect()
}

fn names(faults: &[Fault]) -> String {
    let names: Vec<_> = faults.iter().map(|fault| format!("{} {fault}", *fault as u8)).collect();
    names.join(" or ")
}

impl Trip {
    /// Plays it; it happens at a share of the PWM period.
    fn play(&self, stand: &Stand, share: f64) -> Result<Finding> {
        let mut bench = stand.running(self.speed)?;
        bench.emulated.run(share * PERIOD)?;
        let injected = self.strike(&bench)?;
        bench.emulated.board().force_interrupt(18, None);
        let mut finding =
            Finding { off_after: Some(bench.off_since() - injected), ..Finding::default() };
        finding.failure = self
            .judge(&mut bench, injected, &mut finding.found)
            .err()
            .map(|error| format!("{error:#}"));
        Ok(finding)
    }

    /// Breaks it, and plays on a little beyond the bound. Gives when it broke.
    fn strike(&self, bench: &Bench) -> Result<f64> {
        let lasts = self.bound + LONGER;
        let end = bench.emulated.time() + lasts;
        let injected = match self.cause {
            Cause::World(fault) => bench.inject(fault, lasts),
            Cause::Board(act) => {
                let now = bench.emulated.time();
                act(bench);
                now
            }
            Cause::Silence => bench.emulated.time(),
            Cause::Garbage => {
                let now = bench.emulated.time();
                while bench.emulated.time() < end - LONGER {
                    bench.emulated.board().send(&[0x55, 0, 0xaa, 3, 0, 0, 7, 9]);
                    bench.emulated.run(1e-3)?;
                }
                now
            }
        };
        // What holds an interrupt lets it go when the board has been reset for it, or after a millisecond.
        while bench.emulated.time() + 1e-9 < end {
            bench.emulated.run(1e-3)?;
            let is_over = bench.emulated.board().resets().len() > 1;
            if is_over || self.bound < 1e-3 {
                bench.emulated.board().force_interrupt(18, None);
            }
        }
        Ok(injected)
    }

    fn judge(&self, bench: &mut Bench, injected: f64, found: &mut String) -> Result<()> {
        let off = bench.off_since();
        ensure!(bench.is_off(), "the bridge is on");
        ensure!(off - injected <= self.bound, "off too late");
        let is_by_watchdog = self.told == [Fault::WatchdogReset];
        if is_by_watchdog {
            bench.emulated.run(WATCHDOG)?;
        }
        let resets: Vec<_> = bench.emulated.board().resets()[1..].to_vec();
        let status = if resets.is_empty() { bench.client.status()? } else { bench.reconnect()? };
        *found = in_words(&status);
        ensure!(status.mode == Mode::Faulted, "the drive is not faulted");
        let told: Vec<_> = status.faults.iter().collect();
        ensure!(told.iter().any(|fault| self.told.contains(fault)), "the right fault is not told");
        ensure!(told.iter().all(|fault| self.told.contains(fault)), "other faults are told");
        ensure!(
            if is_by_watchdog {
                resets.iter().all(|one| one.reset == Reset::Watchdog) && resets.len() == 1
            } else {
                resets.is_empty()
            },
            "resets: {resets:?}"
        );
        bench.is_refused(STAYING)?;
        ensure!(bench.is_off() && bench.off_since() == off, "the bridge does not stay off");
        bench.recover(self.speed)?;
        let misuse = bench.misuse();
        ensure!(misuse.is_none(), "{}", misuse.unwrap_or_default());
        Ok(())
    }
}

/// A turn of the main loop, which looks at the button, and the command's period.
const BUTTON: f64 = 10e-3 + SAMPLED;

/// The button is no fault: it takes the outputs off.
fn button() -> Case {
    Case {
        name: "button",
        demand: "off by the main loop's next turn; ready".to_owned(),
        bound: Some(BUTTON),
        play: Box::new(|stand| {
            let mut bench = stand.running(SPEED)?;
            let injected = bench.inject(Broken::ButtonPressed, BUTTON + LONGER);
            bench.emulated.run(BUTTON)?;
            let off = bench.off_since();
            ensure!(bench.is_off(), "the bridge is on");
            let status = bench.watch(STAYING)?;
            ensure!(bench.off_since() == off, "the bridge does not stay off");
            ensure!(
                status.mode == Mode::Ready && status.faults.is_empty(),
                "{}",
                in_words(&status)
            );
            bench.start(SPEED)?;
            Ok(Finding { off_after: Some(off - injected), found: in_words(&status), failure: None })
        }),
    }
}

/// The crystal stops for good: the clock security system ends the outputs, and the board does not come up again.
fn clock() -> Case {
    let bound = 1e-6;
    Case {
        name: "crystal broken",
        demand: "off by the clock security system, without software; then reset by the watchdog"
            .to_owned(),
        bound: Some(bound),
        play: Box::new(move |stand| {
            let bench = stand.running(SPEED)?;
            let injected = bench.emulated.time();
            bench.emulated.board().break_crystal();
            bench.emulated.run(WATCHDOG + STAYING)?;
            let off_after = bench.off_since() - injected;
            ensure!(bench.is_off() && off_after <= bound, "off after {off_after} s");
            let resets = bench.emulated.board().resets()[1..].to_vec();
            ensure!(
                resets.iter().all(|one| one.reset == Reset::Watchdog) && !resets.is_empty(),
                "resets: {resets:?}"
            );
            let found = format!("{} resets by the watchdog, outputs off", resets.len());
            Ok(Finding { off_after: Some(off_after), found, failure: None })
        }),
    }
}

/// A current sensor that is broken when power comes.
fn current_zero() -> Case {
    Case {
        name: "current sensor stuck at 8 A from the start",
        demand: format!("off from the start; {}", names(&[Fault::CurrentZero])),
        bound: None,
        play: Box::new(|stand| {
            let emulated = Bench::powered(&stand.image, &stand.scenario, Some(&stand.saved));
            let mut bench = Bench {
                client: {
                    emulated.run(0.05)?;
                    emulated.client()?
                },
                emulated,
            };
            bench.inject(Broken::CurrentSensor(Leg::U, ShuntFault::Stuck(8.0)), f64::INFINITY);
            // Eight averages of 1024 periods, 0.41 s; the first may have begun without the fault.
            let status = bench.watch(0.55)?;
            ensure!(
                status.mode == Mode::Faulted && status.faults.contains(Fault::CurrentZero),
                "{}",
                in_words(&status)
            );
            bench.is_refused(STAYING)?;
            ensure!(bench.off_since() == 0.0 && bench.is_off(), "the bridge was on");
            Ok(Finding { found: in_words(&status), ..Finding::default() })
        }),
    }
}
