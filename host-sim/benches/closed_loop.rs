//! Simulated seconds per wall second of the paper's scenario, on one core: read `thrpt` as simulated milliseconds.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use host_sim::scenario::{Controller, Scenario};
use host_sim::simulation::simulate;
use std::hint::black_box;

fn paper_cycle(criterion: &mut Criterion) {
    let mut group = criterion.benchmark_group("paper at 20 kHz");
    group.sample_size(20);
    for controller in Controller::PAPER {
        let mut scenario = Scenario::paper();
        scenario.control.controller = controller;
        group.throughput(Throughput::Elements((scenario.duration * 1e3) as u64));
        group.bench_function(controller.to_string(), |bencher| {
            bencher.iter(|| {
                simulate::<f32>(black_box(&scenario), |frame| {
                    black_box(frame);
                })
            });
        });
    }
    group.finish();
}

criterion_group!(benches, paper_cycle);
criterion_main!(benches);
