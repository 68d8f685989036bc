use host_sim::commission_bench::Bench;
use rayon::prelude::*;
#[test]
fn travel() {
    for travel in [0.3, 1.0, 3.0, 10.0] {
        let runs: Vec<_> = (0..100u64).into_par_iter().map(|s| { let mut b = Bench::random(s); b.travel = travel.max(151.0 * 6.2832 / b.scenario.sensors.unwrap().counts_per_turn as f64); let r = b.run(); (b, r) }).collect();
        let mut reasons = std::collections::BTreeMap::new();
        let (mut beyond, mut fast, mut cur) = (0, 0, 0);
        for (b, r) in &runs { if r.angle > b.travel || r.speed > b.scenario.limits.speed || r.current > b.config().limits.current_command as f64 { println!("BEYOND {} {} {:?} angle {} speed {}", b.name, r.current, r.findings.stopped, r.angle, r.speed/b.scenario.limits.speed); } }
        let mut held = [0; 4]; let mut errs: Vec<Vec<f64>> = vec![vec![]; 4];
        for (b, r) in &runs {
            let f = r.findings; let m = &b.scenario.motor;
            *reasons.entry(format!("{:?} {:?}", f.stopped, f.inertia.err())).or_insert(0) += 1;
            if r.angle > b.travel { beyond += 1; } if r.speed > b.scenario.limits.speed { fast += 1; } if r.current > b.config().limits.current_command as f64 { cur += 1; }
            for (k, (v, t)) in [(f.resistance, m.resistance), (f.inductance, m.inductance), (f.back_emf_constant, m.back_emf_constant), (f.inertia, m.inertia)].into_iter().enumerate() {
                if let Ok(v) = v { let d = (v.value as f64 - t).abs(); errs[k].push(100.0*d/t); if d <= v.uncertainty as f64 { held[k] += 1; } }
            }
        }
        print!("travel {travel}: beyond {beyond} {fast} {cur} {reasons:?}");
        for k in 0..4 { errs[k].sort_by(f64::total_cmp); let n = errs[k].len(); if n > 0 { print!(" | {n} held {} med {:.2} p95 {:.2}", held[k], errs[k][n/2], errs[k][n*95/100]); } }
        println!();
    }
}
#[test]
fn rates() {
    for rate in [10e3, 40e3] {
        let runs: Vec<_> = (0..60u64).into_par_iter().map(|s| { let mut b = Bench::random(s); b.scenario.timing.rate = rate; b.scenario.bridge.ripple *= 20e3/rate; let r = b.run(); (b, r) }).collect();
        for (b, r) in &runs { if r.angle > b.travel || r.speed > b.scenario.limits.speed || r.current > b.config().limits.current_command as f64 { println!("BEYOND {} {} {:?} angle {} speed {}", b.name, r.current, r.findings.stopped, r.angle, r.speed/b.scenario.limits.speed); } }
        let mut held = [0; 4]; let mut errs: Vec<Vec<f64>> = vec![vec![]; 4];
        let mut reasons = std::collections::BTreeMap::new(); let mut t: f64 = 0.0; let mut i: f64 = 0.0; let mut w: f64 = 0.0;
        for (b, r) in &runs {
            let f = r.findings; let m = &b.scenario.motor;
            t = t.max(r.time); i = i.max(r.current/b.config().limits.current_command as f64); w = w.max(r.speed/b.scenario.limits.speed);
            *reasons.entry(format!("{:?} {:?}", f.stopped, f.inertia.err())).or_insert(0) += 1;
            for (k, (v, t)) in [(f.resistance, m.resistance), (f.inductance, m.inductance), (f.back_emf_constant, m.back_emf_constant), (f.inertia, m.inertia)].into_iter().enumerate() {
                if let Ok(v) = v { let d = (v.value as f64 - t).abs(); errs[k].push(100.0*d/t); if d <= v.uncertainty as f64 { held[k] += 1; } }
            }
        }
        print!("rate {rate}: t {t} i {i} w {w} {reasons:?}");
        for k in 0..4 { errs[k].sort_by(f64::total_cmp); let n = errs[k].len(); if n > 0 { print!(" | {n} held {} med {:.2} p95 {:.2}", held[k], errs[k][n/2], errs[k][n*95/100]); } }
        println!();
    }
}
#[test]
fn slow_limits() {
    for share in [0.04, 0.07, 0.15, 0.4] {
        let runs: Vec<_> = (0..60u64).into_par_iter().map(|s| { let mut b = Bench::random(s); b.scenario.limits.speed *= share; let r = b.run(); (b, r) }).collect();
        for (b, r) in &runs { if r.angle > b.travel || r.speed > b.scenario.limits.speed || r.current > b.config().limits.current_command as f64 { println!("BEYOND {} {} {:?} angle {} speed {}", b.name, r.current, r.findings.stopped, r.angle, r.speed/b.scenario.limits.speed); } }
        let mut held = [0; 4]; let mut errs: Vec<Vec<f64>> = vec![vec![]; 4];
        let mut reasons = std::collections::BTreeMap::new(); let mut t: f64 = 0.0; let mut i: f64 = 0.0; let mut w: f64 = 0.0;
        for (b, r) in &runs {
            let f = r.findings; let m = &b.scenario.motor;
            t = t.max(r.time); i = i.max(r.current/b.config().limits.current_command as f64); w = w.max(r.speed/b.scenario.limits.speed);
            *reasons.entry(format!("{:?} {:?}", f.stopped, f.inertia.err())).or_insert(0) += 1;
            for (k, (v, t)) in [(f.resistance, m.resistance), (f.inductance, m.inductance), (f.back_emf_constant, m.back_emf_constant), (f.inertia, m.inertia)].into_iter().enumerate() {
                if let Ok(v) = v { let d = (v.value as f64 - t).abs(); errs[k].push(100.0*d/t); if d <= v.uncertainty as f64 { held[k] += 1; } }
            }
        }
        print!("speed {share}: t {t} i {i} w {w} {reasons:?}");
        for k in 0..4 { errs[k].sort_by(f64::total_cmp); let n = errs[k].len(); if n > 0 { print!(" | {n} held {} med {:.2} p95 {:.2}", held[k], errs[k][n/2], errs[k][n*95/100]); } }
        println!();
    }
}
