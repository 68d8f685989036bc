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
    let runs: Vec<_> = benches.par_iter().map(|b| (b, b.run())).collect();
    for (b, r) in &runs {
        let m = &b.scenario.motor;
        let f = &r.findings;
        let known = quasidrive::commission::tuning::Known::new(f, &b.config());
        let dip = known.map(|k| { let [i, t] = [k, b.truth(f)].map(|k| b.dip(&k.tuned(&b.config()))); (i, t, i.zip(t).map(|(i,t)| i/t)) });
        let e = |v: Result<quasidrive::commission::Value, quasidrive::commission::Reason>, t: f64| match v {
            Ok(v) => format!("{:+6.2}±{:<5.2}", 100.0*(f64::from(v.value)/t-1.0), 100.0*f64::from(v.uncertainty)/t),
            Err(e) => format!("{e:?}"),
        };
        println!("{:70} t {:5.2} i {:.2} w {:.2} {:?} R {} L {} Kb {} J {} b {} Tc {} V0 {} dip {:?}", b.name, r.time, r.current/f64::from(b.config().limits.current_command), r.speed/b.scenario.limits.speed, f.stopped,
          e(f.resistance, m.resistance), e(f.inductance, m.inductance), e(f.back_emf_constant, m.back_emf_constant), e(f.inertia, m.inertia), e(f.viscous_friction, m.viscous_friction), e(f.coulomb_friction, m.coulomb_friction), e(f.voltage_drop, b.scenario.bridge.brush_drop + 2.0*b.scenario.bridge.dead_time*20000.0*b.scenario.bus.voltage), dip);
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
