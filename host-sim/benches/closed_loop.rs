//! Simulated seconds per wall second of the paper's scenario, on one core: read `thrpt` as simulated milliseconds. And what
//! a PWM period costs the world that is wired to an emulated board.

use criterion::{Criterion, Throughput, criterion_group, criterion_main};
use host_sim::scenario::{Controller, Scenario};
use host_sim::simulation::simulate;
use host_sim::wired::WiredWorld;
use std::hint::black_box;
use virtual_board::world::{AnaloguePin, Gates, World};

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

/// Eight edges, 16 looks at the encoder, four conversions: what the firmware makes of a period at a duty of a half.
fn wired_period(criterion: &mut Criterion) {
    const PERIOD: f64 = 5e-5;
    const EDGES: [(f64, [bool; 2], [bool; 2]); 8] = [
        (6.25e-6, [false, false], [false, true]),
        (7.05e-6, [true, false], [false, true]),
        (18.75e-6, [true, false], [false, false]),
        (19.55e-6, [true, true], [false, false]),
        (31.25e-6, [true, false], [false, false]),
        (32.05e-6, [true, false], [false, true]),
        (43.75e-6, [false, false], [false, true]),
        (44.55e-6, [false, false], [true, true]),
    ];
    let mut world = WiredWorld::new(&Scenario::paper());
    world.start_profiles(0.0);
    world.switch(0.0, Gates { low: [true, true, false], ..Gates::OFF });
    let mut start = PERIOD;
    criterion.bench_function("wired world, a period", |bencher| {
        bencher.iter(|| {
            let mut edges = EDGES.into_iter().peekable();
            for read in 1..=16 {
                let time = f64::from(read) / 16.0 * PERIOD;
                while let Some((edge, [u, v], [low_u, low_v])) = edges.next_if(|edge| edge.0 < time)
                {
                    let gates = Gates { high: [u, v, false], low: [low_u, low_v, false] };
                    world.switch(start + edge, gates);
                }
                black_box(world.encoder_edges(start + time));
            }
            start += PERIOD;
            for pin in [
                AnaloguePin::ShuntU,
                AnaloguePin::ShuntV,
                AnaloguePin::BusVoltage,
                AnaloguePin::Temperature,
            ] {
                black_box(world.voltage(start, pin));
            }
        })
    });
    assert!(world.hazards().is_empty(), "{:?}", world.hazards());
}

criterion_group!(benches, paper_cycle, wired_period);
criterion_main!(benches);
