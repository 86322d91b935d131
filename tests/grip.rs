//! Which part the tool has hold of, where the nearest is another: a board that hangs in front of a drawer.
#![allow(clippy::unwrap_used)]

use bayesian_object_models::{
    io::config::Config,
    pipeline::{Output, Pipeline},
    types::{AppliedWrench, Input, Label, LabelledPoint, SegmentedCloud, Stamp},
};
use nalgebra::Vector3;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

const BODY: Label = Label(1);
const BOARD: Label = Label(2);
const DRAWER: Label = Label(3);
/// Clouds and readings \[Hz\].
const RATES: (f64, f64) = (10.0, 125.0);
/// Every pull begins this long after the one before, and takes so long \[s\].
const PULLS: (f64, f64) = (4.0, 2.5);
/// Noise of points \[m\] and of the force \[N\].
const NOISE: (f64, f64) = (0.0005, 0.05);

/// A pull: of which part, where at first \[m\], along what.
struct Pull {
    label: Label,
    tool: Vector3<f64>,
    along: Vector3<f64>,
}

fn pulls() -> [Pull; 3] {
    let drawer = |tool| Pull { label: DRAWER, tool, along: Vector3::x() };
    [
        Pull { label: BOARD, tool: Vector3::new(0.335, -0.1, 0.2), along: Vector3::y() },
        // Where it stands clear of the board.
        drawer(Vector3::new(0.285, 0.25, 0.3)),
        // Through the gap beside the board: that is 1 cm away, the drawer 6 cm.
        drawer(Vector3::new(0.34, 0.06, 0.3)),
    ]
}

/// How far out what is pulled is \[m\], its rate and acceleration.
fn motion(since_s: f64) -> (f64, f64, f64) {
    let rate = 2.0 * std::f64::consts::PI / PULLS.1;
    let (sine, cosine) = (rate * since_s).sin_cos();
    (0.08 * (1.0 - cosine), 0.08 * rate * sine, 0.08 * rate * rate * cosine)
}

/// The pull at a time, if there is one, and for how long it has been \[s\].
fn pull_at(time_s: f64) -> Option<(Pull, f64)> {
    let since_s = time_s % PULLS.0 - 1.0;
    let pull = pulls().into_iter().nth((time_s / PULLS.0) as usize)?;
    (0.0..PULLS.1).contains(&since_s).then_some((pull, since_s))
}

/// Where a part is out of where it was first \[m\].
fn displacement(label: Label, time_s: f64) -> Vector3<f64> {
    let Some((pull, since_s)) = pull_at(time_s).filter(|(pull, _)| pull.label == label) else {
        return Vector3::zeros();
    };
    pull.along * motion(since_s).0
}

fn on_a_box(random: &mut ChaCha8Rng, center: Vector3<f64>, size: Vector3<f64>) -> Vector3<f64> {
    let areas = [size.y * size.z, size.x * size.z, size.x * size.y];
    let mut left = random.random::<f64>() * areas.iter().sum::<f64>();
    let axis = (0..2).find(|&axis| {
        left -= areas[axis];
        left < 0.0
    });
    let mut point = Vector3::from_fn(|_, _| random.random::<f64>() - 0.5);
    point[axis.unwrap_or(2)] = if random.random::<bool>() { 0.5 } else { -0.5 };
    let noise = Vector3::from_fn(|_, _| NOISE.0 * random.sample::<f64, _>(StandardNormal));
    center + point.component_mul(&size) + noise
}

fn cloud(random: &mut ChaCha8Rng, time_s: f64) -> Input {
    let boxes = [
        (BODY, Vector3::new(0.0, 0.0, 0.3), Vector3::new(0.5, 0.8, 0.6), 1500),
        (BOARD, Vector3::new(0.32, -0.1, 0.3), Vector3::new(0.02, 0.3, 0.3), 700),
        (DRAWER, Vector3::new(0.27, 0.1, 0.3), Vector3::new(0.02, 0.4, 0.3), 900),
    ];
    let mut points = Vec::new();
    for (label, center, size, count) in boxes {
        let out = displacement(label, time_s);
        let point = |_| LabelledPoint { point_in_world: on_a_box(random, center + out, size), label };
        points.extend((0..count).map(point));
    }
    let stamp = Stamp(1_000_000_000).plus_seconds(time_s);
    Input::Cloud(SegmentedCloud { stamp, source: 0, viewpoint_in_world: None, points })
}

fn reading(random: &mut ChaCha8Rng, time_s: f64) -> Input {
    let mut force_in_world = Vector3::from_fn(|_, _| NOISE.1 * random.sample::<f64, _>(StandardNormal));
    let mut point_in_world = Vector3::new(0.9, 0.0, 0.3);
    if let Some((pull, since_s)) = pull_at(time_s) {
        let (x, v, a) = motion(since_s);
        point_in_world = pull.tool + pull.along * x;
        force_in_world += pull.along * (3.0 * a + 8.0 * v + 2.0 * (v / 0.005).tanh());
    }
    Input::Wrench(AppliedWrench {
        stamp: Stamp(1_000_000_000).plus_seconds(time_s),
        source: 0,
        part: None,
        tool: true,
        point_in_world,
        force_in_world,
        torque_in_world: Vector3::zeros(),
    })
}

#[test]
fn what_goes_along_is_held_and_not_what_is_nearest() {
    let mut settings = Config::default().pipeline_settings(Some(BODY));
    settings.predict = true;
    let mut pipeline = Pipeline::new(settings);
    let mut random = ChaCha8Rng::seed_from_u64(7);
    let (end_s, mut read) = (PULLS.0 * 3.0, 0);
    let mut said = Vec::new();
    let mut take = |outputs: Vec<Output>| {
        said.extend(outputs.into_iter().filter_map(|output| match output {
            Output::Prediction { time_s, horizon_s, label, displacement, .. } => {
                Some((time_s, horizon_s, label, displacement.translation))
            }
            _ => None,
        }));
    };
    for frame in 0..(end_s * RATES.0) as usize {
        let time_s = frame as f64 / RATES.0;
        while f64::from(read) / RATES.1 <= time_s {
            take(pipeline.push(reading(&mut random, f64::from(read) / RATES.1)));
            read += 1;
        }
        take(pipeline.push(cloud(&mut random, time_s)));
    }
    take(pipeline.finish());
    // The last pull, from when the tool has gone far enough to tell until shortly before it lets go.
    let begins_s = 2.0 * PULLS.0 + 1.0;
    let (mut judged, mut moving) = (0, 0);
    for (time_s, horizon_s, label, place) in said {
        let ahead_s = time_s + horizon_s;
        if time_s < begins_s + 0.6 || ahead_s > begins_s + PULLS.1 || horizon_s > 0.6 {
            continue;
        }
        let truth = displacement(label, ahead_s);
        let error = (place - truth).norm();
        assert!(error < 0.01, "{label} by {error:.3} m off at {time_s} s, {horizon_s} s ahead: {place:?}, {truth:?}");
        judged += 1;
        moving += usize::from(label == DRAWER && (truth - displacement(label, time_s)).norm() > 0.03);
    }
    assert!(judged > 60 && moving > 5, "{judged} predictions, {moving} of motion");
}
