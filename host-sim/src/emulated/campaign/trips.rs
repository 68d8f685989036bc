//! What must take the bridge off.
//!
//! Bounds are from `docs/faults.md` and the code, in periods of 50 µs, which begin with a sample:
//!
//! - *in the same period*: something is seen by the next sample, at most a period later, and the interrupt that it starts ends the outputs less
//!   than a period later: [`SAMPLED`];
//! - *within 64 periods*: the slow checks' turn, and as before; *within 96* what they take from a slower look;
//! - *after 3 periods*: the third sample in a row, and as before;
//! - *after 25 ms*: [`AUTHORITY_TIME`], from when an observer is at its limit; until then it has to get there, which took up to 40 ms in
//!   `tests/drive.rs`;
//! - by the watchdog: 50 ms after it was last fed, which the main loop may do once more within its turn of 10 ms;
//! - by an exception: a core that sleeps gets there by the next interrupt, a period later at most;
//! - by heat: as [`Protection::thermal_time`](quasidrive::supervisor::Protection::thermal_time) has it.

use super::bench::Bench;
use super::{Case, Edit, Finding, PERIOD, Result, Stand, numbered};
use crate::connect::in_words;
use crate::scenario::{Controller, ShapeName};
use crate::wired::circuit::{Leg, Rail, Short};
use crate::wired::encoder::EncoderFault;
use crate::wired::faults::Fault as Broken;
use crate::wired::pads::{ShuntFault, ThermistorFault};
use anyhow::ensure;
use quasidrive::drive::AUTHORITY_TIME;
use quasidrive::fault::Fault;
use quasidrive::supervisor::{Command, Mode};
use std::num::NonZeroU32;
use virtual_board::chip::Reset;

/// Seen by the next sample, off by its interrupt.
const SAMPLED: f64 = 2.0 * PERIOD;

/// The slow checks' turn.
const SLOW: f64 = 64.0 * PERIOD + SAMPLED;

/// The same of a temperature, which is looked at every 32 periods.
const HOT: f64 = 32.0 * PERIOD + SLOW;

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

/// A command's way by the link, as in [`agreement`](crate::emulated::agreement).
const TRAVEL: f64 = 60.0 * PERIOD;

/// What drives the motor beyond its highest speed (N·m, negative), and from which speed (rad/s). Against the drive's highest current, 1.06 N·m,
/// it takes 0.9 ms to the limit of 300 rad/s; the observer, of 1170 rad/s, is settled three of its time constants later.
const PULL: f64 = -2.0;
const NEARLY_TOO_FAST: f32 = 290.0;
const OVERSPEED: f64 = 0.9e-3 + 3.0 / 1170.0 + SAMPLED;

/// An overload (N·m), with the friction 4.4 A, on a motor that carries 3 A for ever and has a thermal time of 0.1 s: it trips 62 ms after the current is
/// there, for which a load step takes 7 ms (README).
const OVERLOAD: f64 = 0.24;
const HEATED: f64 = 62e-3 + 7e-3 + SLOW;

/// How long a cause stays beyond its bound (s), and how long the bridge is watched to stay off then: two of the averages in which shunts are
/// learnt anew, of which the first may have begun with the cause.
const LONGER: f64 = 20e-3;
const STAYING: f64 = 0.12;

/// What breaks.
#[derive(Clone, Copy)]
enum Cause {
    /// Something around the board.
    World(Broken),
    /// Something in it, or several things; the interrupts are let go afterwards.
    Board(fn(&mut Bench) -> Result<()>),
    /// The host says nothing more.
    Silence,
    /// The host says nothing but this.
    Garbage,
}

struct Trip {
    name: &'static str,
    speed: f32,
    /// What is other than the campaign's scenario.
    edit: Option<Edit>,
    cause: Cause,
    bound: f64,
    /// How long the cause stays beyond the bound (s).
    longer: f64,
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
        Self::by(name, Cause::World(fault), bound, told, why)
    }

    const fn board(
        name: &'static str,
        act: fn(&mut Bench) -> Result<()>,
        bound: f64,
        told: &'static [Fault],
        why: &'static str,
    ) -> Self {
        Self::by(name, Cause::Board(act), bound, told, why)
    }

    const fn by(
        name: &'static str,
        cause: Cause,
        bound: f64,
        told: &'static [Fault],
        why: &'static str,
    ) -> Self {
        let (speed, edit, longer) = (SPEED, None, LONGER);
        Self { name, speed, edit, cause, bound, longer, told, why }
    }
}

const SAME: &str = "the period of the sample that shows it";
const BEYOND: &str = "25 ms beyond an observer's authority, which it reaches within 40 ms";
const STUCK: &[Fault] = &[Fault::BeyondAuthority, Fault::ModelMismatch];
/// A high current through one shunt shows in several ways at once.
const SHORTED: &[Fault] = &[Fault::Overcurrent, Fault::CurrentSensors, Fault::HardwareTrip];
const DISAGREE: &[Fault] = &[Fault::CurrentSensors, Fault::Overcurrent];
const RESET: &[Fault] = &[Fault::WatchdogReset];
const BY_SHUNTS: &str = "the third sample in a row, or an over-current before";

const fn short_of(leg: Leg, rail: Rail) -> Broken {
    Broken::LegShorted(Short { leg, rail })
}

fn trips() -> Vec<Trip> {
    use Broken::{BoardTemperature, CurrentSensor, Encoder, Load, Supply, Thermistor};
    let two = NonZeroU32::MIN.saturating_add(1);
    vec![
        Trip::world("over-voltage", Supply(30.0), SAMPLED, &[Fault::BusOvervoltage], SAME),
        Trip::world("under-voltage", Supply(7.0), SAMPLED, &[Fault::BusUndervoltage], SAME),
        Trip {
            speed: NEARLY_TOO_FAST,
            // Without the drive the motor would be far too fast soon.
            longer: 0.0,
            ..Trip::world(
                "overspeed: driven on by its load",
                Load(PULL),
                OVERSPEED,
                &[Fault::Overspeed],
                "the observer's settling beyond the limit",
            )
        },
        Trip {
            edit: Some(|scenario| {
                scenario.protection.continuous_current = Some(3.0);
                scenario.protection.thermal_time = 0.1;
            }),
            ..Trip::world(
                "overload",
                Load(OVERLOAD),
                HEATED,
                &[Fault::Overload],
                "the thermal time, a load step's recovery and a turn of the slow checks",
            )
        },
        Trip {
            // Without the drive the load would turn the motor back.
            longer: 0.0,
            ..Trip::world(
                "twice the largest configured load",
                Load(0.6),
                EXHAUSTED,
                &[Fault::BeyondAuthority],
                BEYOND,
            )
        },
        Trip::world(
            "over-current, by software: motor shorted, driven forward",
            Broken::MotorShorted,
            PULSE,
            SHORTED,
            "a pulse within a period, then the sample that shows it",
        ),
        Trip {
            speed: -SPEED,
            ..Trip::board(
                "over-current, by the comparator: motor shorted, driven backward, the control interrupt held off",
                |bench| {
                    bench.emulated.board().force_interrupt(18, Some(false));
                    bench.inject(Broken::MotorShorted, 1e-3);
                    Ok(())
                },
                SAMPLED,
                &[Fault::HardwareTrip, Fault::Overrun, Fault::Overcurrent, Fault::CurrentSensors],
                "a pulse within a period, and no software",
            )
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
        Trip {
            edit: Some(|scenario| scenario.control.controller = Controller::Pi),
            ..Trip::world(
                "encoder frozen, under PI",
                Encoder(EncoderFault::Frozen),
                EXHAUSTED,
                &[Fault::ModelMismatch],
                "25 ms beyond what the armature's model covers, which full current does within 40 ms",
            )
        },
        Trip::world("encoder reversed", Encoder(EncoderFault::Reversed), EXHAUSTED, STUCK, BEYOND),
        Trip::world(
            "encoder loses every other count",
            Encoder(EncoderFault::EachLost(two)),
            EXHAUSTED,
            STUCK,
            BEYOND,
        ),
        Trip::world(
            "encoder: a burst of 100 counts",
            Encoder(EncoderFault::Burst(100)),
            SAMPLED,
            &[Fault::EncoderJump],
            SAME,
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
        Trip {
            edit: Some(|scenario| scenario.reference.shape = ShapeName::Step),
            ..Trip::board(
                "U's current sensor shows half, the speed is reversed",
                |bench| {
                    let half = CurrentSensor(Leg::U, ShuntFault::Gain(0.5));
                    bench.inject(half, TRAVEL + PULSE + DISAGREEING + LONGER);
                    Ok(bench.client.command(Command::Speed(-SPEED))?)
                },
                TRAVEL + PULSE + DISAGREEING,
                DISAGREE,
                "the command's way, a period until 18 A flow, the third sample in a row",
            )
        },
        Trip::world(
            "over-temperature",
            BoardTemperature(95.0),
            HOT,
            &[Fault::Overtemperature],
            "a turn of the slow checks after the next look",
        ),
        Trip::world(
            "thermistor open",
            Thermistor(ThermistorFault::Open),
            HOT,
            &[Fault::TemperatureSensor],
            "a turn of the slow checks after the next look",
        ),
        Trip::world(
            "thermistor shorted",
            Thermistor(ThermistorFault::Shorted),
            HOT,
            &[Fault::TemperatureSensor],
            "a turn of the slow checks after the next look",
        ),
        Trip::by(
            "commands lost",
            Cause::Silence,
            COMMAND_LOST,
            &[Fault::CommandLost],
            "command_timeout, stop_time and three turns of the slow checks",
        ),
        Trip::by(
            "nothing but garbage on the line",
            Cause::Garbage,
            COMMAND_LOST,
            &[Fault::CommandLost],
            "garbage is no sign of life: as commands lost",
        ),
        Trip::board(
            "panic",
            |bench| {
                let is_there = bench.emulated.board().jump_to("rust_begin_unwind");
                ensure!(is_there, "no panic handler");
                Ok(())
            },
            EXCEPTION,
            RESET,
            "the handler's first instruction",
        ),
        Trip::board(
            "hard fault",
            |bench| {
                bench.emulated.board().jump(0x1fff_fff0);
                Ok(())
            },
            EXCEPTION,
            RESET,
            "the handler's first instruction",
        ),
        Trip::board(
            "stack overflow",
            |bench| {
                bench.emulated.board().exhaust_stack(16);
                Ok(())
            },
            EXCEPTION,
            RESET,
            "lock-up, which is a break",
        ),
        Trip::board(
            "control interrupt stuck on",
            |bench| {
                bench.emulated.board().force_interrupt(18, Some(true));
                Ok(())
            },
            WATCHDOG,
            RESET,
            "the watchdog, fed once more at most",
        ),
        Trip::board(
            "control interrupt stuck off",
            |bench| {
                bench.emulated.board().force_interrupt(18, Some(false));
                Ok(())
            },
            WATCHDOG,
            RESET,
            "the watchdog, fed once more at most",
        ),
        Trip::board(
            "control interrupt left out once",
            |bench| {
                bench.emulated.board().force_interrupt(18, Some(false));
                bench.emulated.run(HELD_OFF)?;
                bench.emulated.board().force_interrupt(18, None);
                Ok(())
            },
            HELD_OFF + SAMPLED,
            &[Fault::Overrun],
            "the next one's period",
        ),
        // An even number: the encoder's reads are in the half of their buffer in which they are expected.
        Trip::board(
            "control interrupt left out twice",
            |bench| {
                bench.emulated.board().force_interrupt(18, Some(false));
                bench.emulated.run(HELD_OFF + PERIOD)?;
                bench.emulated.board().force_interrupt(18, None);
                Ok(())
            },
            HELD_OFF + PERIOD + SAMPLED,
            &[Fault::Overrun],
            "the next one's period",
        ),
        Trip::board(
            "halted by a debugger for a moment",
            |bench| {
                bench.emulated.board().halt(HALT);
                Ok(())
            },
            32.0 * PERIOD + SAMPLED,
            &[Fault::Overrun],
            "the next look at a clock that went on",
        ),
    ]
}

/// Half a millisecond (ticks of 1/32768 s).
const HALT: u32 = 16;

/// Long enough for two control interrupts to come, of which one is lost.
const HELD_OFF: f64 = 2.0 * PERIOD;

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
    trips.chain([button(), clock(), current_zero(), stuck_timer()]).collect()
}

fn names(faults: &[Fault]) -> String {
    let names: Vec<_> = faults.iter().copied().map(numbered).collect();
    names.join(" or ")
}

impl Trip {
    /// Plays it; it happens at a share of the PWM period.
    fn play(&self, stand: &Stand, share: f64) -> Result<Finding> {
        let mut bench = match self.edit {
            None => stand.running(self.speed)?,
            Some(edit) => stand.running_with(self.speed, edit)?,
        };
        bench.emulated.run(share * PERIOD)?;
        let injected = self.strike(&mut bench)?;
        bench.emulated.board().force_interrupt(18, None);
        let mut finding =
            Finding { off_after: Some(bench.off_since() - injected), ..Finding::default() };
        let judged = self.judge(&mut bench, injected, &mut finding);
        finding.failure = judged.err().map(|error| format!("{error:#}"));
        Ok(finding)
    }

    /// Breaks it, and plays on a little beyond the bound. Gives when it broke.
    fn strike(&self, bench: &mut Bench) -> Result<f64> {
        let lasts = self.bound + self.longer;
        let end = bench.emulated.time() + lasts;
        let injected = match self.cause {
            Cause::World(fault) => bench.inject(fault, lasts),
            Cause::Board(act) => {
                let now = bench.emulated.time();
                act(bench)?;
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

    fn judge(&self, bench: &mut Bench, injected: f64, finding: &mut Finding) -> Result<()> {
        let off = bench.off_since();
        ensure!(bench.is_off(), "the bridge is on");
        ensure!(off - injected <= self.bound, "off too late");
        let is_by_watchdog = self.told == RESET;
        if is_by_watchdog {
            bench.emulated.run(WATCHDOG)?;
        }
        let resets: Vec<_> = bench.emulated.board().resets()[1..].to_vec();
        let status = if resets.is_empty() { bench.client.status()? } else { bench.reconnect()? };
        finding.found = in_words(&status);
        finding.told = status.faults;
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
        // What was driven on must have coasted down to be armed.
        while bench.speed().abs() > self.speed.abs().into() {
            bench.is_refused(STAYING)?;
        }
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
            Ok(Finding {
                off_after: Some(off - injected),
                found: in_words(&status),
                ..Finding::default()
            })
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
            Ok(Finding { off_after: Some(off_after), found, ..Finding::default() })
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
            Ok(Finding { told: status.faults, found: in_words(&status), ..Finding::default() })
        }),
    }
}

/// A timer that does not count when power comes.
fn stuck_timer() -> Case {
    Case {
        name: "TIM1 stands still from the start",
        demand: format!("off for good, even when cleared; {}", names(&[Fault::SelfTest])),
        bound: None,
        play: Box::new(|stand| {
            let emulated = Bench::powered(&stand.image, &stand.scenario, Some(&stand.saved));
            emulated.board().stop_bridge_timer();
            emulated.run(0.05)?;
            let mut bench = Bench { client: emulated.client()?, emulated };
            let status = bench.watch(STAYING)?;
            ensure!(
                status.mode == Mode::Faulted && status.faults.contains(Fault::SelfTest),
                "{}",
                in_words(&status)
            );
            bench.is_refused(STAYING)?;
            // There is nobody to clear it.
            let _ = bench.client.command(Command::Clear);
            bench.is_refused(STAYING)?;
            ensure!(bench.off_since() == 0.0 && bench.is_off(), "the bridge was on");
            Ok(Finding { told: status.faults, found: in_words(&status), ..Finding::default() })
        }),
    }
}
