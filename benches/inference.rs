//! How long the three steps take that everything else waits for: registration, simulation, learning.
//!
//! `cargo bench --bench inference`; results in docs/benchmarks.md.
#![allow(clippy::unwrap_used, missing_docs)]

use std::path::Path;

use bayesian_object_models::{
    io::{bag::Bag, config::Config, ingest::Ingest},
    math::Pose,
    mechanism::{Body, JointParameters, State, Tree, WrenchSample, WrenchTrack, rollout},
    pipeline::{ClosedWindow, Output, Pipeline, Worker},
    registration::{AlignmentSettings, PartModel, ScanPoint, SurfelAccumulator, align},
    types::Label,
};
use divan::{Bencher, black_box};
use nalgebra::{Matrix6, Vector3};

fn main() {
    divan::main();
}

/// A drawer of .5 m × .4 m × .15 m seen from the front and above, as one camera would.
fn drawer(points: usize) -> Vec<ScanPoint> {
    let viewpoint = Vector3::new(1.6, -1.2, 1.4);
    let place = |i: usize| {
        // Low-discrepancy places on the front, the side and the bottom seen from above.
        let (u, v) = ((i as f64 * 0.754_877_666).fract(), (i as f64 * 0.569_840_291).fract());
        match i % 3 {
            0 => Vector3::new(0.0, 0.5 * u, 0.15 * v),
            1 => Vector3::new(-0.4 * u, 0.0, 0.15 * v),
            _ => Vector3::new(-0.4 * u, 0.5 * v, 0.02),
        }
    };
    let noise = |i: usize| 0.0015 * ((i as f64 * 12.9898).sin() * 43758.547).sin();
    (0..points)
        .map(|i| ScanPoint {
            point_in_world: place(i) + Vector3::repeat(noise(i)),
            viewpoint_in_world: Some(viewpoint),
        })
        .collect()
}

/// Registration of one part's cloud from 8 mm and 1° off.
#[divan::bench(args = [1000, 10_000])]
fn registration(bencher: Bencher, points: usize) {
    let scan = drawer(points);
    let mut accumulator = SurfelAccumulator::default();
    for _ in 0..5 {
        accumulator.add(&drawer(10_000), &Pose::identity());
    }
    let model = PartModel::new(&accumulator.surfels()).unwrap();
    let start = Pose::exp(&nalgebra::Vector6::new(0.01, -0.005, 0.01, 0.006, 0.004, -0.004));
    let settings = AlignmentSettings::default();
    bencher.bench_local(|| align(&model, black_box(&scan), &start, &Matrix6::identity(), &settings, 6));
}

/// Five seconds of simulation in steps of 1 ms, of a chain of slides and hinges.
#[divan::bench(args = [1, 2, 3])]
fn simulation_5000_steps(bencher: Bencher, joints: usize) {
    let parameters = JointParameters::new(2.0, 1.5);
    let bodies = (0..joints).map(|k| {
        let parent = k.checked_sub(1);
        let body = Body::prismatic(parent, &Vector3::new(1.0, 0.3 * k as f64, 0.0).normalize(), 2.0);
        Body { parameters: parameters.clone(), ..body }
    });
    let tree = Tree::new(bodies.collect(), Vector3::new(0.0, 0.0, -9.81)).unwrap();
    let samples: Vec<WrenchSample> = (0..625)
        .map(|i| WrenchSample {
            stamp_s: 0.008 * f64::from(i),
            point_in_world: Vector3::zeros(),
            force_in_world: Vector3::x() * (6.0 * (0.02 * f64::from(i)).sin()),
            torque_in_world: Vector3::zeros(),
        })
        .collect();
    let track = WrenchTrack::new(joints - 1, &samples);
    let times = [0.0, 5.0];
    bencher.bench_local(|| {
        rollout(black_box(&tree), &State::at_rest(joints), std::slice::from_ref(&track), &times, 0.001).unwrap()
    });
}

/// The windows of the cabinet, each with what was learned before it.
fn windows() -> Vec<ClosedWindow> {
    let config = Config::default();
    let mut settings = config.pipeline_settings(Some(Label(4)));
    settings.live = true;
    let mut pipeline = Pipeline::new(settings);
    let mut ingest = Ingest::new(&config.input);
    let bag = Path::new(env!("CARGO_MANIFEST_DIR")).join("bags/cabinet/cabinet.mcap");
    let mut closed = Vec::new();
    for message in Bag::open(&bag).unwrap() {
        for input in ingest.push(&message.topic.name, &message.topic.type_name, message.bytes()) {
            for output in pipeline.push(input) {
                if let Output::WindowClosed(window) = output {
                    pipeline.adopt(&Worker::default().learn((*window).clone(), |_| ()));
                    closed.push(*window);
                }
            }
        }
    }
    closed
}

/// Learning one window of the cabinet, by how many were learned before it.
#[divan::bench(args = [0, 2, 4], sample_count = 5, sample_size = 1)]
fn window_inference(bencher: Bencher, learned_before: usize) {
    let windows = windows();
    bencher.bench_local(|| Worker::default().learn(black_box(windows[learned_before].clone()), |_| ()));
}
