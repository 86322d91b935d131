//! Part poses by topic, instead of clouds and beside them: the cabinet's bag with its parts' true motion
//! as noisy poses.
#![allow(clippy::unwrap_used)]

mod command;

use std::{collections::BTreeMap, fs, path::Path};

use bayesian_object_models::{
    io::{
        bag::{Bag, BagWriter},
        cdr::{self, Endianness},
        document::PosteriorDocument,
        messages::{Header, POINT_CLOUD_TYPE, POSE_TYPE, PoseWithCovariance, PoseWithCovarianceStamped, RawPose, Time},
    },
    math::{Pose, Screw},
    types::{
        Label, Stamp,
        posterior::{EdgePosterior, ObjectPosterior},
    },
};
use command::{bom, ours};
use nalgebra::{Vector3, Vector6};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use serde_json::Value;

const ROOT: u32 = 4;
/// Standard deviations of the poses \[rad, m\].
const NOISE: (f64, f64) = (0.002, 0.0005);

/// A moving part of the cabinet.
struct Mover {
    label: u32,
    revolute: bool,
    axis: Vector3<f64>,
    point: Vector3<f64>,
    /// Where its measured frame is at first \[m\].
    frame: Vector3<f64>,
    friction: f64,
    inertia: f64,
}

impl Mover {
    fn screw(&self) -> Screw {
        if self.revolute { Screw::revolute(&self.axis, &self.point) } else { Screw::prismatic(&self.axis) }
    }
}

fn vector(value: &Value) -> Vector3<f64> {
    Vector3::from_fn(|i, _| value[i].as_f64().unwrap())
}

fn truth() -> (Vec<Mover>, i64) {
    let truth: Value = serde_json::from_str(&fs::read_to_string(ours("bags/cabinet/truth.json")).unwrap()).unwrap();
    let moving = truth["parts"].as_array().unwrap().iter().filter(|part| part["damping"].is_number());
    let movers = moving.map(|part| {
        let revolute = part["joint"] == "revolute";
        let point = vector(&part["axis_point_world_m"]);
        Mover {
            label: part["label"].as_u64().unwrap() as u32,
            revolute,
            axis: vector(&part["axis_direction_world"]),
            point,
            frame: if revolute { vector(&part["com_world_m"]) } else { point },
            friction: part["friction"].as_f64().unwrap(),
            inertia: part["joint_inertia"].as_f64().unwrap(),
        }
    });
    (movers.collect(), truth["stamp_offset_ns"].as_i64().unwrap())
}

/// Rows of truth.csv: time, and position by label.
fn positions() -> Vec<(f64, BTreeMap<u32, f64>)> {
    let text = fs::read_to_string(ours("bags/cabinet/truth.csv")).unwrap();
    let mut lines = text.lines();
    let names: Vec<&str> = lines.next().unwrap().split(',').collect();
    let rows = lines.map(|line| {
        let cells: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        let label = |name: &str| name.strip_prefix("q_").and_then(|label| label.parse().ok());
        let of = names.iter().zip(&cells).filter_map(|(name, value)| Some((label(name)?, *value)));
        (cells[0], of.collect())
    });
    rows.collect()
}

/// The cabinet's bag with the poses of some parts, with or without its clouds; `turns`: with orientation.
fn with_poses(path: &Path, labels: &[u32], clouds: bool, turns: bool) {
    let (movers, offset_ns) = truth();
    let mut rng = ChaCha8Rng::seed_from_u64(17);
    let mut draw = |deviation: f64| -> f64 {
        let x: f64 = StandardNormal.sample(&mut rng);
        deviation * x
    };
    let mut messages: Vec<(u64, String, String, Vec<u8>)> = Bag::open(&ours("bags/cabinet/cabinet.mcap"))
        .unwrap()
        .filter(|message| clouds || message.topic.type_name != POINT_CLOUD_TYPE)
        .map(|m| (m.log_time_ns, m.topic.name.clone(), m.topic.type_name.clone(), m.bytes().to_vec()))
        .collect();
    for (time_s, positions) in positions() {
        let stamp = Stamp(offset_ns).plus_seconds(time_s);
        for mover in movers.iter().filter(|mover| labels.contains(&mover.label)) {
            let displacement = mover.screw().displacement(positions[&mover.label]);
            let error = Vector6::from_fn(|i, _| if i < 3 { draw(NOISE.0) } else { draw(NOISE.1) });
            let pose = displacement * Pose::from_translation(mover.frame) * Pose::exp(&error);
            let angular = if turns { NOISE.0.powi(2) } else { f64::INFINITY };
            let mut covariance = [[0.0; 6]; 6];
            for (i, row) in covariance.iter_mut().enumerate() {
                row[i] = if i < 3 { NOISE.1.powi(2) } else { angular };
            }
            let raw = RawPose { position: pose.translation.into(), orientation: pose.quaternion().into() };
            let message = PoseWithCovarianceStamped {
                header: Header { stamp: Time::from(stamp), frame_id: "world".into() },
                pose: PoseWithCovariance { pose: raw, covariance },
            };
            let bytes = cdr::encode(&message, Endianness::Little).unwrap();
            messages.push((stamp.0 as u64, format!("/parts/{}/pose", mover.label), POSE_TYPE.to_owned(), bytes));
        }
    }
    messages.sort_by_key(|message| message.0);
    let mut writer = BagWriter::create(path).unwrap();
    let mut topics = BTreeMap::new();
    for (log_time, name, type_name, bytes) in messages {
        let topic = *topics.entry(name.clone()).or_insert_with(|| writer.add_topic(&name, &type_name).unwrap());
        writer.write(topic, log_time, log_time, &bytes).unwrap();
    }
    writer.finish().unwrap();
}

fn learned(labels: &[u32], clouds: bool, turns: bool) -> ObjectPosterior {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (bag, posterior, observations) = (file("poses.mcap"), file("posterior.json"), file("observations.csv"));
    with_poses(Path::new(&bag), labels, clouds, turns);
    let root = ROOT.to_string();
    let arguments = ["replay", &bag, "--root-label", &root, "--posterior", &posterior, "--observations", &observations];
    let outcome = bom(&arguments);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
    let seen = fs::read_to_string(observations).unwrap();
    for label in labels {
        assert!(seen.lines().filter(|line| line.split(',').nth(1) == Some(&label.to_string())).count() > 200);
    }
    let document: PosteriorDocument = serde_json::from_str(&fs::read_to_string(posterior).unwrap()).unwrap();
    document.posterior
}

fn edge(posterior: &ObjectPosterior, child: u32) -> &EdgePosterior {
    let edges = posterior.edges.iter().filter(|edge| edge.child == Label(child));
    edges.max_by(|a, b| a.probability.total_cmp(&b.probability)).unwrap()
}

/// Type, parent and axis of a part that was measured; its axis within `degrees` and `metres`.
fn check(posterior: &ObjectPosterior, mover: &Mover, degrees: f64, metres: f64) {
    let edge = edge(posterior, mover.label);
    // Parts that never moved are one group with the root: which of them carries a joint is beyond the data.
    let moving: Vec<Label> = truth().0.iter().map(|mover| Label(mover.label)).collect();
    let into = posterior.edges.iter().filter(|e| e.child == edge.child && !moving.contains(&e.parent));
    assert!(into.map(|e| e.probability).sum::<f64>() > 0.95, "{edge:?}");
    let (found, direction) = if mover.revolute {
        let axis = edge.revolute.as_ref().unwrap();
        let miss = Vector3::from(axis.axis_direction).cross(&(mover.point - Vector3::from(axis.axis_point_m))).norm();
        assert!(miss < metres, "{miss}: {edge:?}");
        (edge.joint_type.revolute, axis.axis_direction)
    } else {
        (edge.joint_type.prismatic, edge.prismatic.as_ref().unwrap().axis_direction)
    };
    assert!(found > 0.95, "{edge:?}");
    let off = Vector3::from(direction).cross(&mover.axis).norm().asin().to_degrees();
    assert!(off < degrees, "{off}: {edge:?}");
}

#[test]
fn poses_alone_tell_the_cabinet() {
    let movers = truth().0;
    let labels: Vec<u32> = movers.iter().map(|mover| mover.label).collect();
    let posterior = learned(&labels, false, true);
    for mover in &movers {
        check(&posterior, mover, 0.2, 0.001);
        let edge = edge(&posterior, mover.label);
        for (quantity, truth) in [(&edge.friction, mover.friction), (&edge.joint_inertia, mover.inertia)] {
            assert!((quantity.median / truth - 1.0).abs() < 0.2, "{quantity:?}, truth {truth}");
        }
    }
}

#[test]
fn positions_alone_tell_the_cabinet() {
    let movers = truth().0;
    let labels: Vec<u32> = movers.iter().map(|mover| mover.label).collect();
    let posterior = learned(&labels, false, false);
    movers.iter().for_each(|mover| check(&posterior, mover, 0.5, 0.003));
}

#[test]
fn a_pose_stands_in_for_one_parts_clouds() {
    let movers = truth().0;
    let door = movers.iter().find(|mover| mover.revolute).unwrap();
    let posterior = learned(&[door.label], true, true);
    check(&posterior, door, 0.2, 0.001);
    movers.iter().filter(|mover| !mover.revolute).for_each(|drawer| check(&posterior, drawer, 2.0, 0.0));
}
