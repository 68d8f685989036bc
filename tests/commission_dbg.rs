//! x
use host_sim::commission_bench::Bench;
#[test]
fn dbg() {
    for (seed, travel) in [(0u64, 1.0), (0, 0.3), (36, 0.3), (56, 0.3), (4, 0.3)] {
        let mut b = Bench::random(seed); b.travel = travel;
        let mut last = None;
        let r = b.run_with(&b.config(), |c, _| { if Some(c.phase()) != last { last = Some(c.phase()); println!("{seed} W, {:?} {:?}", c.phase(), c.dbg()); } });
        println!("{} W, {:?} angle {:.3} speed {}", b.name, r.findings.stopped, r.angle, r.speed);
    }
}
