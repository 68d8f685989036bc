//! Sensors that die, leads that open and buses that jump while commissioning measures: what the true current, speed and angle come to.

use host_sim::commission_bench::{Bench, Run};
use quasidrive::commission::{Phase, Reason};
use quasidrive::hal::{READS, Sample};
use quasidrive::sense::Sensors;
use rayon::prelude::*;

/// What happens.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Failure {
    CurrentFrozen,
    CurrentNone,
    CurrentLowest,
    CurrentHighest,
    CurrentHalf,
    EncoderFrozen,
    EncoderLine,
    EncoderReversed,
    LeadOpens,
    BusFalls,
    BusRises,
}

impl Failure {
    const ALL: [Self; 11] = [
        Self::CurrentFrozen,
        Self::CurrentNone,
        Self::CurrentLowest,
        Self::CurrentHighest,
        Self::CurrentHalf,
        Self::EncoderFrozen,
        Self::EncoderLine,
        Self::EncoderReversed,
        Self::LeadOpens,
        Self::BusFalls,
        Self::BusRises,
    ];
}

const PHASES: [(Phase, u32); 6] = [
    (Phase::Rest, 2048),
    (Phase::Pulses, 3000),
    (Phase::Launch, 6000),
    (Phase::Trial, 6000),
    (Phase::Short, 24_000),
    (Phase::Long, 60_000),
];

/// A number in no order (SplitMix64).
fn shuffled(seed: u64) -> u32 {
    let mut z = seed.wrapping_add(1).wrapping_mul(0x9E37_79B9_7F4A_7C15);
    z = (z ^ (z >> 30)).wrapping_mul(0xBF58_476D_1CE4_E5B9);
    z = (z ^ (z >> 27)).wrapping_mul(0x94D0_49BB_1331_11EB);
    (z >> 32) as u32
}

/// Lets something fail some periods after a phase began.
fn fail(bench: &Bench, failure: Failure, phase: Phase, after: u32) -> (Run, bool) {
    let config = bench.config();
    let Sensors::Codes(calibration) = config.sensors else { unreachable!("codes") };
    let zero = calibration.current_zero as u16;
    let mut periods = None;
    let mut frozen = None;
    let mut failed = false;
    let mut line = 0;
    let run = bench.run_on(&config, |commission, board, sample| {
        if periods.is_none() && commission.phase() == phase {
            periods = Some(0);
        }
        let Some(passed) = &mut periods else { return };
        *passed += 1;
        if *passed < after {
            return;
        }
        failed |= commission.phase() != Phase::Over;
        let Sample::Codes(codes) = sample else { unreachable!("codes") };
        let last = *frozen.get_or_insert(*codes);
        let start = last.encoder[READS - 1];
        match failure {
            Failure::CurrentFrozen => codes.current = last.current,
            Failure::CurrentNone => codes.current = zero,
            Failure::CurrentLowest => codes.current = 0,
            Failure::CurrentHighest => codes.current = calibration.highest_code,
            Failure::CurrentHalf => {
                // Half the gain has twice the range.
                let half = 0.5 * board.state().current as f32 / calibration.current_per_code;
                codes.current = (calibration.current_zero + half).round() as u16 + (codes.encoder[0] ^ codes.bus_voltage) % 2;
            }
            Failure::EncoderFrozen => codes.encoder = [start; READS],
            Failure::EncoderLine => {
                line = codes.encoder[READS - 1] & 1;
                codes.encoder = codes.encoder.map(|count| (start & !1) + (count & 1));
            }
            Failure::EncoderReversed => {
                codes.encoder =
                    codes.encoder.map(|count| start.wrapping_mul(2).wrapping_sub(count));
            }
            Failure::LeadOpens => board.open_lead(),
            Failure::BusFalls => board.set_bus_voltage(0.7 * bench.scenario.bus.voltage),
            Failure::BusRises => {
                board.set_bus_voltage((1.4 * bench.scenario.bus.voltage).min(29.5))
            }
        }
    });
    (run, failed)
}

#[test]
fn study() {
    let count = std::env::var("MOTORS").map_or(100, |it| it.parse().expect("number"));
    let from: u64 = std::env::var("FROM").map_or(1000, |it| it.parse().expect("number"));
    let mut cases = Vec::new();
    for seed in 0..count {
        for failure in Failure::ALL {
            for (phase, periods) in PHASES {
                cases.push((from + seed, failure, phase, periods));
            }
        }
    }
    let runs: Vec<_> = cases
        .into_par_iter()
        .map(|(seed, failure, phase, periods)| {
            let after = shuffled(seed * 1000 + failure as u64 * 10 + phase as u64) % periods;
            let mut bench = Bench::random(seed);
            if std::env::var("TIGHT").is_ok() {
                match after % 4 {
                    0 => bench.scenario.limits.speed *= 0.06,
                    1 => bench.scenario.limits.speed *= 0.2,
                    pick => {
                        let counts = f64::from(bench.scenario.sensors.expect("sensors").counts_per_turn);
                        bench.travel = f64::max([0.3, 3.0][pick as usize - 2], 151.0 / counts * std::f64::consts::TAU);
                    }
                }
            }
            let (run, failed) = fail(&bench, failure, phase, after);
            (bench, failure, phase, after, run, failed)
        })
        .collect();
    for (bench, failure, phase, after, run, _) in runs.iter().filter(|it| it.5 && std::env::var("NAMES").is_ok()) {
        let current = run.current / f64::from(bench.config().limits.current_command);
        let none = run.findings.stopped.is_none() && !matches!(failure, Failure::BusRises | Failure::BusFalls);
        let speed = run.speed / f64::from(bench.config().limits.speed);
        let angle = run.angle / bench.travel;
        let half = matches!(failure, Failure::CurrentHalf) || (none && matches!(failure, Failure::EncoderReversed));
        if !half && (none || current > 1.7 || speed > 1.2 || angle > 1.2) { print!("{speed:.2} {angle:.2}"); println!("* {failure:?} {phase:?} {after} {:?} {current:.2} {}", run.findings.stopped, bench.name); }
    }
    for failure in Failure::ALL {
        let these = || runs.iter().filter(|it| it.1 == failure && it.5);
        let quantiles = |of: &dyn Fn(&Bench, &Run) -> f64| {
            let mut all: Vec<f64> = these().map(|it| of(&it.0, &it.4)).collect();
            all.sort_by(f64::total_cmp);
            let at = |share: f64| all[((share * all.len() as f64) as usize).min(all.len() - 1)];
            format!("{:.2} {:.2} {:.2} {:.2}", at(0.5), at(0.95), at(0.99), at(1.0))
        };
        println!(
            "+ {failure:?}: current {}, beyond {}, speed {}, angle {}, none {}",
            quantiles(&|bench, run| run.current / f64::from(bench.config().limits.current_command)),
            quantiles(&|_, run| f64::from(run.beyond)),
            quantiles(&|bench, run| run.speed / f64::from(bench.config().limits.speed)),
            quantiles(&|bench, run| run.angle / bench.travel),
            these().filter(|it| it.4.findings.stopped.is_none()).count()
        );
    }
}

#[test]
fn healthy() {
    let count: u64 = std::env::var("MOTORS").map_or(100, |it| it.parse().expect("number"));
    let from: u64 = std::env::var("FROM").map_or(1000, |it| it.parse().expect("number"));
    let tight = std::env::var("TIGHT").is_ok();
    let mut benches = Vec::new();
    for seed in from..from + count {
        let bench = Bench::random(seed);
        if !tight {
            benches.push(bench);
            continue;
        }
        for share in [0.06, 0.2] {
            let mut bench = Bench::random(seed);
            bench.scenario.limits.speed *= share;
            benches.push(bench);
        }
        for travel in [0.3, 3.0] {
            let mut bench = Bench::random(seed);
            let counts = f64::from(bench.scenario.sensors.expect("sensors").counts_per_turn);
            bench.travel = f64::max(travel, 151.0 / counts * std::f64::consts::TAU);
            benches.push(bench);
        }
    }
    let all: Vec<_> = benches
        .par_iter()
        .map(|bench| {
            let mut debug = [[0.0; 2]; 4];
            let run = bench.run_on(&bench.config(), |commission, _, _| {
                let at = match commission.phase() {
                    Phase::Rest | Phase::Pulses | Phase::Over => return,
                    Phase::Launch => 0,
                    Phase::Trial => 1,
                    Phase::Short => 2,
                    Phase::Long => 3,
                };
                let now = commission.debug();
                for it in 0..2 {
                    debug[at][it] = now[it].max(debug[at][it]);
                }
            });
            if run.findings.stopped.is_some() && (!tight || run.findings.stopped != Some(Reason::TooQuick)) {
                println!("{}: {:?}", bench.name, run.findings.stopped);
            }
            (bench, run, debug)
        })
        .collect();
    for at in 0..4 {
        for it in 0..2 {
            let mut these: Vec<_> = all.iter().map(|all| (all.2[at][it], all)).collect();
            these.sort_by(|a, b| a.0.total_cmp(&b.0));
            let n = these.len();
            print!("{at} {it}: median {:.3} 95% {:.3}", these[n / 2].0, these[n * 95 / 100].0);
            for (value, (bench, run, _)) in these.iter().rev().take(6) {
                print!("\n      {value:.3} {} {:?}", bench.name, run.findings.stopped,);
            }
            println!();
        }
    }
}
