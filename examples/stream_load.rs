//! What a camera's stream costs while windows are learned beside it: time on the processor by stage, and memory.
//!
//! `cargo run --release --example stream_load -- SECONDS [RATE_HZ] [POINTS_PER_PART] [REST_S] [live]`
//!
//! A body and three drawers, one pulled after the other with `REST_S` between. `live`: at the stream's own
//! pace, learning in a thread beside it, as in the node. Without: as fast as it goes, a window being learned
//! by the time the next but one frame comes; so an hour's stream takes minutes. The results are in `docs/node.md`.
#![allow(clippy::print_stdout, reason = "the table is what this program is for")]
#![allow(clippy::disallowed_methods, reason = "it times what it runs")]

use std::collections::BTreeMap;
use std::sync::mpsc;
use std::time::{Duration, Instant};

use anyhow::Result;
use bayesian_object_models::{
    io::{
        config::Config,
        ingest::{Ingest, Message},
        messages::{Header, PointCloud2, PointField, TfMessage, Time, TransformStamped, Wrench, WrenchStamped},
    },
    math::Pose,
    node::{
        health::{Times, processor_s},
        learning::{Taught, give_way},
    },
    pipeline::{Output, Pipeline, Worker},
    types::{Input, Label, Stamp},
};
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

/// Realizations of the noise that frames take turns with.
const NOISES: usize = 5;
/// Standard deviation of points \[m\] and of the force \[N\].
const NOISE: (f64, f64) = (0.001, 0.1);
/// Readings of the wrench \[Hz\].
const WRENCH_HZ: f64 = 125.0;
/// A drawer goes out and back in this \[s\].
const PULL_S: f64 = 3.0;
/// How often memory is said \[s of the stream\].
const MEMORY_EVERY_S: f64 = 300.0;

fn main() -> Result<()> {
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |index: usize, otherwise: f64| -> f64 {
        arguments.get(index).and_then(|text| text.parse().ok()).unwrap_or(otherwise)
    };
    let live = arguments.iter().any(|argument| argument == "live");
    let scene = Scene::new(number(2, 10_000.0) as usize, number(3, 1.0));
    run(&scene, number(0, 60.0), number(1, 30.0), live);
    Ok(())
}

/// Times by stage.
#[derive(Default)]
struct Stages(BTreeMap<&'static str, Times>);

impl Stages {
    fn timed<T>(&mut self, stage: &'static str, work: impl FnOnce() -> T) -> T {
        let begin = processor_s();
        let result = work();
        self.0.entry(stage).or_default().add(processor_s() - begin);
        result
    }
}

fn run(scene: &Scene, seconds: f64, rate_hz: f64, live: bool) {
    let config = Config::default();
    let mut settings = config.pipeline_settings(Some(Label(1)));
    (settings.live, settings.predict) = (true, true);
    let mut pipeline = Pipeline::new(settings);
    let mut ingest = Ingest::new(&config.input);
    let (jobs, closed) = mpsc::channel::<Output>();
    let (results, learned) = mpsc::channel();
    let learning = std::thread::spawn(move || {
        give_way();
        let mut worker = Worker::default();
        for work in closed {
            let taught = match work {
                Output::FirstLook(look) => Taught::Models(worker.look(&look)),
                Output::WindowClosed(window) => Taught::Window(Box::new(worker.learn(*window, |_| ()))),
                _ => continue,
            };
            if results.send(taught).is_err() {
                break;
            }
        }
    });
    let (mut stages, mut windows, mut waiting) = (Stages::default(), 0, 0);
    let (begin, mut said_s, mut readings) = (Instant::now(), 0.0, 0);
    let frames = (seconds * rate_hz) as usize;
    println!("{:>8} {:>8} {:>8} {:>8}", "stream s", "wall s", "windows", "MB");
    for frame in 0..frames {
        let time_s = frame as f64 / rate_hz;
        if live {
            std::thread::sleep((begin + Duration::from_secs_f64(time_s)).saturating_duration_since(Instant::now()));
        }
        while waiting > 0 {
            // Without a pace the stream would be over before a window is learned.
            let result = if live { learned.try_recv().ok() } else { learned.recv().ok() };
            let Some(result) = result else { break };
            waiting -= 1;
            windows += usize::from(matches!(result, Taught::Window(_)));
            stages.timed("adoption", || adopt(&mut pipeline, result));
        }
        let mut closed = Vec::new();
        let mut take = |outputs: Vec<Output>| {
            let works = |output: &Output| matches!(output, Output::FirstLook(_) | Output::WindowClosed(_));
            closed.extend(outputs.into_iter().filter(works));
        };
        while f64::from(readings) / WRENCH_HZ <= time_s {
            for (topic, message) in scene.reading(f64::from(readings) / WRENCH_HZ) {
                for input in ingest.push_message(topic, message) {
                    take(pipeline.push(input));
                }
            }
            readings += 1;
        }
        let message = Message::Cloud(scene.cloud(time_s, frame));
        let whole = processor_s();
        let inputs: Vec<Input> = stages.timed("reading", || ingest.push_message("/parts/points", message));
        for input in inputs {
            take(stages.timed("pipeline", || pipeline.push(input)));
        }
        let whole = processor_s() - whole;
        stages.0.entry("cloud in all").or_default().add(whole);
        if !closed.is_empty() {
            stages.0.entry("cloud with work for learning").or_default().add(whole);
        }
        for work in closed {
            waiting += 1;
            if jobs.send(work).is_err() {
                break;
            }
        }
        if time_s >= said_s {
            said_s += MEMORY_EVERY_S;
            println!("{time_s:8.0} {:8.1} {windows:8} {:8}", begin.elapsed().as_secs_f64(), resident_mb());
        }
    }
    drop(jobs);
    while let Ok(result) = learned.recv() {
        windows += usize::from(matches!(result, Taught::Window(_)));
        adopt(&mut pipeline, result);
    }
    // It ended with its jobs.
    let _ = learning.join();
    println!("{seconds:8.0} {:8.1} {windows:8} {:8}", begin.elapsed().as_secs_f64(), resident_mb());
    println!("\n{:>28} {:>8} {:>8} {:>8} {:>8}", "on the processor, ms", "count", "p50", "p99", "max");
    for (stage, times) in &stages.0 {
        let [median, most, longest] = times.quantiles([0.5, 0.99, 1.0]).map(|time_s| time_s * 1e3);
        println!("{stage:>28} {:8} {median:8.2} {most:8.2} {longest:8.2}", times.count());
    }
    for edge in pipeline.posterior().iter().flat_map(|posterior| &posterior.edges) {
        if edge.probability > 0.5 {
            let likeliest = edge.joint_type.likeliest();
            println!("part {} on {}: {} {:.3}", edge.child, edge.parent, likeliest.0, likeliest.1);
        }
    }
}

fn adopt(pipeline: &mut Pipeline, taught: Taught) {
    match taught {
        Taught::Models(models) => pipeline.adopt_models(&models),
        Taught::Window(learned) => drop(pipeline.adopt(&learned)),
    }
}

/// What the cameras and the tool see.
struct Scene {
    /// Points of every part at rest, by realization of the noise.
    points: Vec<Vec<(u32, Vec<Vector3<f64>>)>>,
    rest_s: f64,
    forces: Vec<f64>,
}

impl Scene {
    fn new(count: usize, rest_s: f64) -> Self {
        let mut random = ChaCha8Rng::seed_from_u64(2);
        let drawer = |k: u32| (Vector3::new(0.26, 0.0, 0.25 + 0.3 * f64::from(k)), Vector3::new(0.03, 0.5, 0.25));
        let boxes = [(1, (Vector3::new(0.0, 0.0, 0.5), Vector3::new(0.5, 0.6, 1.0)))];
        let boxes: Vec<_> = boxes.into_iter().chain((0..3).map(|k| (2 + k, drawer(k)))).collect();
        let mut noisy = || {
            let part = |&(label, (center, size)): &(u32, (Vector3<f64>, Vector3<f64>))| {
                (label, (0..count).map(|_| on_a_box(&mut random, &center, &size)).collect())
            };
            boxes.iter().map(part).collect()
        };
        let points = (0..NOISES).map(|_| noisy()).collect();
        let forces = (0..997).map(|_| NOISE.1 * random.sample::<f64, _>(StandardNormal)).collect();
        Self { points, rest_s, forces }
    }

    /// Which drawer is held, how far out it is \[m\] and the force on it \[N\]; `None` where none is held.
    fn pull(&self, time_s: f64) -> (u32, Option<(f64, f64)>) {
        let period_s = PULL_S + self.rest_s;
        let (turn, phase_s) = ((time_s / period_s) as u32, time_s % period_s);
        let label = 2 + turn % 3;
        if phase_s > PULL_S || time_s < 2.0 {
            return (label, None);
        }
        let rate = 2.0 * std::f64::consts::PI / PULL_S;
        let (sine, cosine) = (rate * phase_s).sin_cos();
        let (x, v, a) = (0.1 * (1.0 - cosine), 0.1 * rate * sine, 0.1 * rate * rate * cosine);
        (label, Some((x, 2.0 * a + 5.0 * v + 2.0 * (v / 0.01).tanh())))
    }

    fn cloud(&self, time_s: f64, frame: usize) -> PointCloud2<'static> {
        let (held, state) = self.pull(time_s);
        let mut data = Vec::new();
        for (label, points) in &self.points[frame % NOISES] {
            let x = state.filter(|_| *label == held).map_or(0.0, |(x, _)| x);
            for point in points {
                for value in [point.x + x, point.y, point.z] {
                    data.extend_from_slice(&(value as f32).to_le_bytes());
                }
                data.extend_from_slice(&label.to_le_bytes());
            }
        }
        let field = |(index, name): (u32, &str)| PointField {
            name: name.to_owned(),
            offset: 4 * index,
            datatype: if name == "label" { 6 } else { 7 },
            count: 1,
        };
        let width = data.len() as u32 / 16;
        PointCloud2 {
            header: header("world", time_s),
            height: 1,
            width,
            fields: (0..).zip(["x", "y", "z", "label"]).map(field).collect(),
            is_bigendian: false,
            point_step: 16,
            row_step: 16 * width,
            data: data.into(),
            is_dense: true,
        }
    }

    /// The tool's transform and the wrench.
    fn reading(&self, time_s: f64) -> [(&'static str, Message<'static>); 2] {
        let (held, state) = self.pull(time_s);
        let place = Vector3::new(state.map_or(0.6, |(x, _)| 0.29 + x), 0.0, 0.25 + 0.3 * f64::from(held - 2));
        let transform = TransformStamped {
            header: header("world", time_s),
            child_frame_id: "tool".into(),
            transform: Pose::from_translation(place).into(),
        };
        let noise = self.forces[(time_s * WRENCH_HZ).round() as usize % self.forces.len()];
        let force = Vector3::new(state.map_or(0.0, |(_, force)| force) + noise, 0.0, 0.0);
        let wrench = Wrench { force: force.into(), ..Wrench::default() };
        let wrench = WrenchStamped { header: header("tool", time_s), wrench };
        [("/tf", Message::Tf(TfMessage { transforms: vec![transform] })), ("/wrench", Message::Wrench(wrench))]
    }
}

fn header(frame: &str, time_s: f64) -> Header {
    // Stamps as they are today: what is counted from the epoch must not lose digits.
    Header { stamp: Time::from(Stamp(1_700_000_000_000_000_000).plus_seconds(time_s)), frame_id: frame.to_owned() }
}

fn on_a_box(random: &mut ChaCha8Rng, center: &Vector3<f64>, size: &Vector3<f64>) -> Vector3<f64> {
    let areas = [size.y * size.z, size.x * size.z, size.x * size.y];
    let mut left = random.random::<f64>() * areas.iter().sum::<f64>();
    let mut axis = 0;
    while axis < 2 && left > areas[axis] {
        left -= areas[axis];
        axis += 1;
    }
    let mut point = Vector3::from_fn(|_, _| random.random::<f64>() - 0.5);
    point[axis] = if random.random::<bool>() { 0.5 } else { -0.5 };
    let noise = Vector3::from_fn(|_, _| NOISE.0 * random.sample::<f64, _>(StandardNormal));
    center + point.component_mul(size) + noise
}

/// Memory that is held \[MB\].
fn resident_mb() -> u64 {
    let statm = std::fs::read_to_string("/proc/self/statm").unwrap_or_default();
    let pages: u64 = statm.split_whitespace().nth(1).and_then(|pages| pages.parse().ok()).unwrap_or_default();
    pages * rustix::param::page_size() as u64 / 1_000_000
}
