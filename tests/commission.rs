//! scratch
use host_sim::commission_bench::Bench;
use host_sim::scoreboard::motors::Machine;
use rayon::prelude::*;

#[test]
fn look() {
    let mut benches: Vec<Bench> = Vec::new();
    for machine in Machine::ALL { for counts in [512, 4096, 16384] { benches.push(Bench::machine(&machine, counts)); } }
    let n: u64 = std::env::var("N").map_or(40, |n| n.parse().expect("n"));
    for seed in 0..n { benches.push(Bench::random(seed)); }
    let start = std::time::Instant::now();
    let runs: Vec<_> = benches.par_iter().map(|b| (b, b.run(|_, _| {}))).collect();
    for (b, r) in &runs {
        let m = &b.scenario.motor;
        let f = &r.findings;
        let e = |v: Result<quasidrive::commission::Value, quasidrive::commission::Reason>, t: f64| match v {
            Ok(v) => format!("{:+6.2}±{:<5.2}", 100.0*(f64::from(v.value)/t-1.0), 100.0*f64::from(v.uncertainty)/t),
            Err(e) => format!("{e:?}"),
        };
        println!("{:70} t {:5.2} i {:.2} w {:.2} {:?} R {} L {} Kb {} J {} b {} Tc {} V0 {} launch {:.0} speed {:.2} u {:.2} counts {:.0} R {:.2} L {:.2} low {:.2} win {:.0} {:?}", b.name, r.time, r.current/f64::from(b.config().limits.current_command), r.speed/b.scenario.limits.speed, f.stopped,
          e(f.resistance, m.resistance), e(f.inductance, m.inductance), e(f.back_emf_constant, m.back_emf_constant), e(f.inertia, m.inertia), e(f.viscous_friction, m.viscous_friction), e(f.coulomb_friction, m.coulomb_friction), e(f.voltage_drop, b.scenario.bridge.brush_drop + 2.0*b.scenario.bridge.dead_time*20000.0*b.scenario.bus.voltage), r.debug[0], r.debug[1] as f64/b.scenario.limits.speed, r.debug[2] as f64/b.scenario.bus.voltage, r.debug[3], r.debug[4] as f64/m.resistance, r.debug[5] as f64/(m.resistance/(1.0-(-m.resistance/m.inductance*5e-5).exp())), r.debug[6], r.debug[7], r.debug);
    }
    println!("{:?}", start.elapsed());
    for (name, limit, of) in [("R", 3.0, 0), ("L", 5.0, 1), ("Kb", 1.0, 2), ("J", 5.0, 3), ("b", 10.0, 4), ("Tc", 10.0, 5)] {
        let mut errors: Vec<f64> = vec![]; let (mut held, mut seen) = (0, 0);
        for (b, r) in &runs[12..] {
            let m = &b.scenario.motor; let f = &r.findings;
            let (v, t) = [(f.resistance, m.resistance), (f.inductance, m.inductance), (f.back_emf_constant, m.back_emf_constant), (f.inertia, m.inertia), (f.viscous_friction, m.viscous_friction), (f.coulomb_friction, m.coulomb_friction)][of];
            if let Ok(v) = v { seen += 1; let d = (f64::from(v.value) - t).abs(); if d <= f64::from(v.uncertainty) { held += 1; } errors.push(100.0*d/t); } else { errors.push(f64::INFINITY); }
        }
        errors.sort_by(f64::total_cmp);
        let n = errors.len();
        println!("{name}: median {:.2} p95 {:.2} max {:.2} (target {limit}) seen {seen} held {held}/{n}", errors[n/2], errors[n*95/100], errors[n-1]);
    }
}
