//! Commissioning on simulated motors: what it finds of motors of data sheets and of random ones, that it stays within limits at
//! every instant, and what it says where something is wrong.

use host_sim::commission_bench::{Bench, Run};
use host_sim::scoreboard::motors::Machine;
use quasidrive::commission::tuning::Known;
use quasidrive::commission::{
    Commission, CommissionConfig, Findings, NoLoad, Phase, Reason, Value,
};
use quasidrive::drive::Drive;
use quasidrive::hal::{BridgeCommand, Codes, Exact, READS, Sample};
use quasidrive::sense::Sensors;
use rayon::prelude::*;

/// Random motors.
const MOTORS: u64 = 200;

/// Those of R, L, Kb and J, b and T_c.
type Found = [(Result<Value, Reason>, f64); 6];

/// What was found, with the truth.
fn found(bench: &Bench, findings: &Findings) -> Found {
    let motor = &bench.scenario.motor;
    [
        (findings.resistance, motor.resistance),
        (findings.inductance, motor.inductance),
        (findings.back_emf_constant, motor.back_emf_constant),
        (findings.inertia, motor.inertia),
        (findings.viscous_friction, motor.viscous_friction),
        (findings.coulomb_friction, motor.coulomb_friction),
    ]
}

const NAMES: [&str; 6] = ["R", "L", "Kb", "J", "b", "T_c"];

/// Errors over the truth, in order; what was not seen is infinitely wrong.
struct Errors(Vec<f64>);

impl Errors {
    fn of(found: impl Iterator<Item = (Result<Value, Reason>, f64)>) -> Self {
        let error = |(value, truth): (Result<Value, Reason>, f64)| {
            value.map_or(f64::INFINITY, |it| (f64::from(it.value) / truth - 1.0).abs())
        };
        let mut errors: Vec<f64> = found.map(error).collect();
        errors.sort_by(f64::total_cmp);
        Self(errors)
    }

    fn quantile(&self, share: f64) -> f64 {
        self.0[(share * self.0.len() as f64) as usize]
    }
}

/// Whether the stated interval holds the truth.
fn holds((value, truth): (Result<Value, Reason>, f64)) -> bool {
    value.is_ok_and(|it| (f64::from(it.value) - truth).abs() <= f64::from(it.uncertainty))
}

#[track_caller]
fn assert_within_limits(bench: &Bench, run: &Run) {
    let limits = bench.config().limits;
    for (what, reached, limit) in [
        ("current", run.current, f64::from(limits.current_command)),
        ("speed", run.speed, f64::from(limits.speed)),
        ("angle", run.angle, bench.travel),
        ("duty", run.duty, f64::from(limits.duty)),
    ] {
        assert!(reached <= limit, "{}: {what} {reached} of {limit}", bench.name);
    }
    assert!(run.time < 20.0, "{}: {} s", bench.name, run.time);
}

fn run_all(benches: Vec<Bench>) -> Vec<(Bench, Run)> {
    let run = |bench: Bench| {
        let run = bench.run();
        (bench, run)
    };
    benches.into_par_iter().map(run).collect()
}

#[test]
fn random_motors_from_1_w_to_1_kw() {
    let runs = run_all((0..MOTORS).map(Bench::random).collect());
    for (bench, run) in &runs {
        assert_within_limits(bench, run);
        assert_eq!(run.findings.stopped, None, "{}", bench.name);
    }
    // The targets, and what was measured, which a change must not lose: the median, and what 95 % are within.
    let expected = [(0.001, 0.01), (0.003, 0.08), (0.0005, 0.003), (0.001, 0.01)];
    for (unknown, (median, most)) in expected.into_iter().enumerate() {
        let all = || runs.iter().map(|(bench, run)| found(bench, &run.findings)[unknown]);
        let errors = Errors::of(all());
        let held = all().filter(|it| holds(*it)).count();
        let name = NAMES[unknown];
        println!(
            "{name}: median {:.3} %, 95 % within {:.2} %, interval holds in {held} of {MOTORS}",
            1e2 * errors.quantile(0.5),
            1e2 * errors.quantile(0.95)
        );
        let target = [0.03, 0.05, 0.01, 0.05][unknown];
        assert!(median <= target && most <= 3.0 * target);
        assert!(errors.quantile(0.5) <= median, "{name}: {}", errors.quantile(0.5));
        assert!(errors.quantile(0.95) <= most, "{name}: {}", errors.quantile(0.95));
        assert!(held * 10 >= runs.len() * 9, "{name}: held in {held}");
        // An interval as wide as the target would hold it too.
        let narrow = all().filter(|(value, _)| {
            value.is_ok_and(|it| f64::from(it.uncertainty / it.value) <= target)
        });
        assert!(narrow.count() * 2 >= runs.len(), "{name}: intervals are wide");
    }
    // Frictions are small: no target but that the interval is honest.
    for unknown in [4, 5] {
        let all = runs.iter().map(|(bench, run)| found(bench, &run.findings)[unknown]);
        let held = all.filter(|it| holds(*it)).count();
        println!("{}: interval holds in {held} of {MOTORS}", NAMES[unknown]);
        assert!(held * 10 >= runs.len() * 9, "{}: held in {held}", NAMES[unknown]);
    }
    assert_dips(&runs);
    let longest = runs.iter().map(|(_, run)| run.time).fold(0.0, f64::max);
    println!("longest {longest:.1} s");
}

/// A drive that is tuned from what was found dips as one that is tuned from the truth.
fn assert_dips(runs: &[(Bench, Run)]) {
    let ratio = |(bench, run): &(Bench, Run)| -> Option<f64> {
        let config = bench.config();
        let dip = |known: Known| bench.dip(&known.tuned(&config)).expect(bench.name.as_str());
        let known = Known::new(&run.findings, &config).ok()?;
        Some(dip(known) / dip(bench.truth(&run.findings)))
    };
    let ratios: Vec<f64> = runs.par_iter().filter_map(ratio).collect();
    let (low, high) = ratios
        .iter()
        .fold((1.0, 1.0), |(low, high): (f64, f64), &ratio| (low.min(ratio), high.max(ratio)));
    println!("dips of {}: {low:.3} to {high:.3} times that with the truth", ratios.len());
    assert!(ratios.len() * 50 >= runs.len() * 49, "tuned: {} of {}", ratios.len(), runs.len());
    assert!(low > 0.9 && high < 1.1, "{low} to {high}");
}

#[test]
fn motors_of_data_sheets() {
    let machines = Machine::ALL.iter();
    let benches =
        machines.flat_map(|it| [512, 4096, 16384].map(|counts| Bench::machine(it, counts)));
    let runs = run_all(benches.collect());
    for (bench, run) in &runs {
        assert_within_limits(bench, run);
        let found = found(bench, &run.findings);
        for (unknown, most) in [0.01, 0.05, 0.002, 0.01].into_iter().enumerate() {
            let (value, truth) = found[unknown];
            let value = value.expect(bench.name.as_str());
            let error = (f64::from(value.value) / truth - 1.0).abs();
            assert!(error <= most, "{}: {} errs by {error}", bench.name, NAMES[unknown]);
        }
        let (value, truth) = (run.findings.voltage_drop, bench.voltage_drop());
        let drop = value.expect("seen").value;
        assert!((f64::from(drop) / truth - 1.0).abs() < 0.05, "{}: {drop} V", bench.name);
    }
    assert_dips(&runs);
}

#[test]
fn tight_limits_of_speed_and_travel_are_never_left_even_coasting() {
    let tight = |seed: u64| {
        let mut benches = Vec::new();
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
        benches
    };
    let runs = run_all((0..40).flat_map(tight).collect());
    let mut seen = 0;
    let mut held = 0;
    for (bench, run) in &runs {
        assert_within_limits(bench, run);
        let allowed = [None, Some(Reason::TooQuick), Some(Reason::NoisyCurrent)];
        assert!(allowed.contains(&run.findings.stopped), "{}: {:?}", bench.name, run.findings);
        for (value, truth) in &found(bench, &run.findings)[..4] {
            match value {
                Ok(_) => {
                    seen += 1;
                    held += usize::from(holds((*value, *truth)));
                }
                Err(reason) => assert!(
                    matches!(
                        reason,
                        Reason::Imprecise
                            | Reason::Ripple
                            | Reason::TooQuick
                            | Reason::NoisyCurrent
                    ),
                    "{}: {reason:?}",
                    bench.name
                ),
            }
        }
    }
    println!("{seen} of {} values, interval holds in {held}", 4 * runs.len());
    assert!(seen * 10 >= 4 * runs.len() * 8 && held * 10 >= seen * 9, "{seen}, {held}");
}

fn paper() -> Bench {
    Bench::machine(&Machine::PAPER, 4096)
}

#[track_caller]
fn assert_right(bench: &Bench, findings: &Findings) {
    assert_eq!(findings.stopped, None);
    for (value, truth) in &found(bench, findings)[..4] {
        let error = value.expect("seen").value as f64 / truth - 1.0;
        assert!(error.abs() < 0.02, "{findings:?}");
    }
}

#[test]
fn wrong_signs_are_found_and_corrected() {
    for encoder_reversed in [false, true] {
        for leads_reversed in [false, true] {
            for current_reversed in [false, true] {
                let mut bench = paper();
                bench.scenario.sensors.as_mut().expect("sensors").encoder_reversed =
                    encoder_reversed;
                bench.scenario.bridge.leads_reversed = leads_reversed;
                let mut config = bench.config();
                let Sensors::Codes(calibration) = &mut config.sensors else { unreachable!() };
                if current_reversed {
                    calibration.current_per_code = -calibration.current_per_code;
                }
                let Run { findings, .. } = bench.run_with(&config, |_, _| {});
                assert_right(&bench, &findings);
                assert_eq!(findings.current_reversed, current_reversed);
                assert_eq!(findings.encoder_reversed, Ok(encoder_reversed != leads_reversed));
                let known = Known::new(&findings, &config).expect("all seen");
                // With the signs wrong it stops with a fault. (Exchanged leads turn the bench's own idea of a positive speed.)
                if !leads_reversed {
                    bench.dip(&known.tuned(&config)).expect("drives");
                }
            }
        }
    }
}

#[test]
fn a_blocked_shaft_shows_its_armature() {
    let mut bench = paper();
    bench.scenario.motor.inertia *= 1e5;
    let run = bench.run();
    assert_within_limits(&bench, &run);
    let findings = run.findings;
    for (value, truth) in &found(&bench, &findings)[..2] {
        assert!(holds((*value, *truth)), "{findings:?}");
    }
    for (value, _) in &found(&bench, &findings)[2..] {
        assert_eq!(*value, Err(Reason::Blocked));
    }
    assert_eq!(findings.encoder_reversed, Err(Reason::Blocked));
    assert_eq!(Known::new(&findings, &bench.config()), Err(Reason::Blocked));
}

/// Plays with falsified codes.
fn falsified(bench: &Bench, falsify: impl Fn(&mut Codes)) -> Run {
    bench.run_with(&bench.config(), |_, sample| {
        if let Sample::Codes(codes) = sample {
            falsify(codes);
        }
    })
}

#[test]
fn a_missing_encoder_an_open_lead_and_a_spinning_shaft_are_named() {
    let bench = paper();
    for stuck in [0, 1] {
        // One line alone counts to and fro.
        let run = falsified(&bench, |codes| {
            let toggling = stuck * (codes.encoder[READS - 1] & 1);
            codes.encoder = [toggling; READS];
        });
        assert_eq!(run.findings.stopped, Some(Reason::EncoderMissing));
        assert_eq!(run.findings.resistance, Err(Reason::EncoderMissing));
        // What it cannot see stays slow: 15 % of the bus, and what comes until it is noticed.
        let no_load = bench.scenario.bus.voltage / bench.scenario.motor.back_emf_constant;
        assert!(run.speed < 0.25 * no_load, "{} of {no_load}", run.speed);
    }
    let run = bench.run_on(&bench.config(), |_, board, _| board.open_lead());
    assert_eq!(run.findings.stopped, Some(Reason::LeadOpen));
    let mut spinning = paper();
    spinning.scenario.initial.speed = 5.0;
    assert_eq!(spinning.run().findings.stopped, Some(Reason::Turning));
}

#[test]
fn a_current_limit_within_the_noise_is_refused_and_above_it_is_not() {
    // ST's B-G431B-ESC1: 29 mA a code.
    let esc1 = |limit: f64| {
        let mut bench = paper();
        let sensors = bench.scenario.sensors.as_mut().expect("sensors");
        sensors.current_resolution = 0.029;
        sensors.current_noise = 0.01;
        bench.scenario.limits.current = 20.0;
        bench.scenario.limits.current_command = Some(limit);
        bench
    };
    assert_eq!(esc1(0.5).run().findings.stopped, Some(Reason::NoisyCurrent));
    // 70 codes show L to within a tenth.
    for (limit, most) in [(2.0, [0.03, 0.1, 0.01, 0.05]), (6.0, [0.02, 0.03, 0.005, 0.02])] {
        let bench = esc1(limit);
        let run = bench.run();
        assert_within_limits(&bench, &run);
        for (unknown, most) in most.into_iter().enumerate() {
            let (value, truth) = found(&bench, &run.findings)[unknown];
            let error = f64::from(value.expect("seen").value) / truth - 1.0;
            println!("ESC1, {limit} A: {} errs by {:.2} %", NAMES[unknown], 1e2 * error);
            assert!(error.abs() <= most, "{limit} A: {} errs by {error}", NAMES[unknown]);
            assert!(holds((value, truth)), "{limit} A: {}, {value:?}", NAMES[unknown]);
        }
    }
}

#[test]
fn samples_that_are_not_within_limits_end_it_with_outputs_off_at_once() {
    type Falsify = fn(&mut Sample<f32>);
    let cases: [(Falsify, Reason); 5] = [
        (|sample| codes_of(sample).current = 4095, Reason::Overcurrent),
        (|sample| codes_of(sample).bus_voltage = 100, Reason::BusVoltage),
        (|sample| codes_of(sample).bus_voltage = 4095, Reason::BusVoltage),
        (|sample| codes_of(sample).encoder = [20_000; READS], Reason::EncoderJump),
        (|sample| *sample = Sample::Exact(EXACT), Reason::BadSample),
    ];
    let bench = paper();
    for (falsify, reason) in cases {
        for after in [3000, 8000, 20_000, 40_000] {
            let mut period = 0;
            let run = bench.run_with(&bench.config(), |commission, sample| {
                period += 1;
                if period > after {
                    assert!(period == after + 1 || commission.phase() == Phase::Over);
                    falsify(sample);
                }
            });
            assert_eq!(run.findings.stopped, Some(reason), "after {after}");
            assert!((run.time - f64::from(after + 1) / 20e3).abs() < 1e-3, "{}", run.time);
        }
    }
    let exact = CommissionConfig { sensors: Sensors::Exact, ..bench.config() };
    for bad in [f32::NAN, f32::INFINITY, f32::NEG_INFINITY] {
        for sample in [
            Exact { current: bad, ..EXACT },
            Exact { advance: bad, ..EXACT },
            Exact { bus_voltage: bad, ..EXACT },
        ] {
            let mut commission = Commission::new(&exact).expect("valid");
            for _ in 0..10 {
                commission.step(&Sample::Exact(EXACT));
            }
            assert_eq!(commission.step(&Sample::Exact(sample)), BridgeCommand::Off);
            assert_eq!(commission.findings().stopped, Some(Reason::BadSample));
        }
    }
}

const EXACT: Exact<f32> = Exact { speed: 0.0, advance: 0.0, current: 0.0, bus_voltage: 24.0 };

fn codes_of(sample: &mut Sample<f32>) -> &mut Codes {
    match sample {
        Sample::Codes(codes) => codes,
        Sample::Exact(_) => unreachable!("a bench has codes"),
    }
}

#[test]
fn aborted_at_any_time_it_is_off_and_keeps_what_it_has() {
    let bench = paper();
    for after in [1, 2000, 2100, 5000, 7000, 12_000, 20_000, 30_000, 60_000, 90_000] {
        let mut period = 0;
        let run = bench.run_with(&bench.config(), |commission, sample| {
            period += 1;
            if period == after {
                commission.abort();
                assert_eq!(commission.step(sample), BridgeCommand::Off);
                assert_eq!(commission.phase(), Phase::Over);
            }
        });
        assert_eq!(run.findings.stopped, Some(Reason::Aborted), "after {after}");
        assert_eq!(run.findings.inertia, Err(Reason::Aborted), "after {after}");
        let has_armature = after > 50_000;
        assert_eq!(run.findings.resistance.is_ok(), has_armature, "after {after}");
    }
}

#[test]
fn the_nameplate_shows_wrong_counts() {
    let bench = paper();
    let no_load = Some(NoLoad { speed: 24.0 / 59e-3 * 0.95, voltage: 24.0 });
    let right = CommissionConfig { no_load, ..bench.config() };
    assert_right(&bench, &bench.run_with(&right, |_, _| {}).findings);
    // Lines in place of counts.
    let mut lines = right;
    let Sensors::Codes(calibration) = &mut lines.sensors else { unreachable!() };
    calibration.counts_per_turn /= 4;
    lines.limits.speed *= 4.0;
    let findings = bench.run_with(&lines, |_, _| {}).findings;
    assert_eq!(findings.back_emf_constant, Err(Reason::NoLoadSpeed));
    // Without the nameplate Kb and J are both a quarter, and nothing shows it.
    let blind = CommissionConfig { no_load: None, ..lines };
    let findings = bench.run_with(&blind, |_, _| {}).findings;
    let back_emf = findings.back_emf_constant.expect("seen").value;
    assert!((back_emf / (59e-3 / 4.0) - 1.0).abs() < 0.01, "{back_emf}");
}

#[test]
fn sensors_without_error_will_do() {
    let mut bench = paper();
    bench.scenario.sensors = None;
    let run = bench.run();
    assert_within_limits(&bench, &run);
    assert_right(&bench, &run.findings);
    let config = bench.config();
    let known = Known::new(&run.findings, &config).expect("all seen");
    Drive::<f32>::new(&known.tuned(&config)).expect("valid");
}

#[test]
fn other_rates_will_do() {
    for rate in [10e3, 40e3] {
        let mut bench = paper();
        bench.scenario.timing.rate = rate;
        let run = bench.run();
        assert_within_limits(&bench, &run);
        assert_right(&bench, &run.findings);
    }
}

#[test]
fn configurations_out_of_range_are_refused_by_name() {
    let right = paper().config();
    type Edit = fn(&mut CommissionConfig);
    let cases: [(Edit, &str); 7] = [
        (|config| config.timing.delay = false, "timing.delay"),
        (|config| config.travel = 0.0, "travel"),
        (|config| config.travel = f32::NAN, "travel"),
        (|config| config.travel = 0.1, "travel"),
        (|config| config.limits.speed = 0.5, "limits.speed"),
        (|config| config.limits.current_command = f32::NAN, "limits.current_command"),
        (|config| config.no_load = Some(NoLoad { speed: 0.0, voltage: 24.0 }), "no_load.speed"),
    ];
    for (edit, field) in cases {
        let mut config = right;
        edit(&mut config);
        assert_eq!(Commission::new(&config).expect_err(field).field, field);
    }
}
