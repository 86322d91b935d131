//! The URDF of what a replay learns, loaded by an independent parser (yourdfpy): its forward kinematics
//! put every part where the pipeline predicted it.
//!
//! Needs `BOM_ROS_ENVIRONMENT` (`rosidl_peer/build.sh`).
#![allow(clippy::unwrap_used)]

mod ros;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::Path,
};

use bayesian_object_models::{
    geometry::HullProperties,
    io::{bag::Bag, config::Config, counters::Counters, ingest::Ingest},
    math::Pose,
    pipeline::{Output, Pipeline},
    ros::{
        FixedFrame, LinkJoint, LinkTree, MOST_BYTES, PartPrediction, Picture, UrdfInput, encoded_bytes, joint_name,
        link_name, link_transforms, markers, object_posterior, predicted_part_poses, urdf,
    },
    types::{Label, Stamp, finite::check_finite, posterior::ObjectPosterior},
};
use nalgebra::{Matrix4, Point3, Vector3};
use serde::Deserialize;
use serde_json::{Value, json};

/// The bound \[m\].
const TOLERANCE: f64 = 0.001;

/// A posterior and what was predicted from it.
struct Era {
    /// Windows learned.
    windows: usize,
    posterior: ObjectPosterior,
    hulls: BTreeMap<Label, HullProperties>,
    ranges_seen: BTreeMap<Label, (f64, f64)>,
    /// Parts' displacements by stamp and horizon, as bits of their seconds.
    predicted: BTreeMap<(u64, u64), BTreeMap<Label, PartPrediction>>,
}

impl Era {
    fn of(pipeline: &Pipeline) -> Option<Self> {
        let posterior = pipeline.posterior()?;
        let (hulls, ranges_seen) = (pipeline.hulls(), pipeline.ranges_seen());
        Some(Self { windows: posterior.windows.len(), posterior, hulls, ranges_seen, predicted: BTreeMap::new() })
    }
}

/// Replays a bag of this repository; the prior first.
fn eras(bag: &str) -> Vec<Era> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("bags").join(bag).join(bag).with_extension("mcap");
    let config = Config::default();
    let mut ingest = Ingest::new(&config.input);
    let mut settings = config.pipeline_settings(None);
    settings.predict = true;
    let mut pipeline = Pipeline::new(settings);
    let mut eras: Vec<Era> = Vec::new();
    let mut take = |pipeline: &Pipeline, outputs: Vec<Output>| {
        let learned = outputs.iter().any(|output| matches!(output, Output::Learned { .. }));
        if learned || eras.is_empty() {
            eras.extend(Era::of(pipeline));
        }
        for output in outputs {
            let Output::Prediction { time_s, horizon_s, label, .. } = output else { continue };
            // A prediction is made of what was learned by its stamp, though it comes a second later.
            let at = |era: &&mut Era| era.posterior.windows.last().is_none_or(|w| w.t1_s <= time_s + 1e-9);
            let Some(era) = eras.iter_mut().rev().find(at) else { continue };
            let center = era.posterior.parts.iter().find(|part| part.label == label);
            let center_in_world = center.map_or_else(Vector3::zeros, |part| part.com_in_world_m.into());
            let Some(prediction) = PartPrediction::of(&output, center_in_world) else { continue };
            era.predicted.entry((time_s.to_bits(), horizon_s.to_bits())).or_default().insert(label, prediction);
        }
    };
    for message in &mut Bag::open(&path).unwrap() {
        for input in ingest.push(&message.topic.name, &message.topic.type_name, message.bytes()) {
            let outputs = pipeline.push(input);
            take(&pipeline, outputs);
        }
    }
    for input in ingest.flush() {
        let outputs = pipeline.push(input);
        take(&pipeline, outputs);
    }
    let outputs = pipeline.finish();
    take(&pipeline, outputs);
    eras
}

/// What yourdfpy made of a description.
#[derive(Deserialize)]
struct Loaded {
    joints: Vec<(String, String, Option<f64>, Option<f64>, Option<f64>, Option<f64>)>,
    masses: BTreeMap<String, f64>,
    vertices: BTreeMap<String, usize>,
    poses: Vec<BTreeMap<String, [[f64; 4]; 4]>>,
}

fn frame() -> FixedFrame {
    FixedFrame { name: "world".into(), zero: Stamp(0) }
}

/// Loads the era's description at the given joint positions.
fn load(environment: &Path, era: &Era, tree: &LinkTree, positions: &[BTreeMap<Label, f64>], meshes: bool) -> Loaded {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().to_str().unwrap();
    let mesh_folder = meshes.then_some(path);
    let input = UrdfInput { fixed_frame: "world", hulls: &era.hulls, ranges_seen: &era.ranges_seen, mesh_folder };
    let description = urdf(tree, &era.posterior, &input).unwrap();
    assert_eq!(description.meshes.is_empty(), !meshes);
    assert!(description.text.len() < MOST_BYTES);
    for (name, stl) in &description.meshes {
        fs::write(folder.path().join(name), stl).unwrap();
    }
    let (file, given) = (folder.path().join("object.urdf"), folder.path().join("positions.json"));
    fs::write(&file, &description.text).unwrap();
    let by_name = |q: &BTreeMap<Label, f64>| -> Value { q.iter().map(|(l, q)| (joint_name(*l), json!(q))).collect() };
    fs::write(&given, Value::from_iter(positions.iter().map(by_name)).to_string()).unwrap();
    let arguments = [file.to_str().unwrap(), given.to_str().unwrap()];
    serde_json::from_str(&ros::python(environment, "rosidl_peer/urdf.py", &arguments)).unwrap()
}

fn homogeneous(pose: &Pose) -> Matrix4<f64> {
    let mut matrix = pose.rotation.to_homogeneous();
    matrix.fixed_view_mut::<3, 1>(0, 3).copy_from(&pose.translation);
    matrix
}

/// As the peer gives it.
fn matrix(rows: &[[f64; 4]; 4]) -> Matrix4<f64> {
    Matrix4::from(*rows).transpose()
}

/// Farthest that a point of the part is from where the link puts it \[m\].
fn farthest(hull: &HullProperties, origin: &Vector3<f64>, world_from_link: &Matrix4<f64>, displacement: &Pose) -> f64 {
    let distance = |v: &Vector3<f64>| {
        let in_link = Point3::from(v - origin);
        (world_from_link.transform_point(&in_link).coords - displacement.transform_point(v)).norm()
    };
    hull.vertices.iter().map(distance).fold(0.0, f64::max)
}

fn reproduces(environment: &Path, bag: &str, moving_joints: usize) {
    let eras = eras(bag);
    assert!(eras.len() > 2, "{}", eras.len());
    let (mut travel, mut all, mut floating): (f64, usize, usize) = (0.0, 0, 0);
    for era in eras.iter().filter(|era| !era.predicted.is_empty()) {
        let likeliest = LinkTree::likeliest(&era.posterior);
        let mut by_floating: BTreeMap<BTreeSet<Label>, Vec<BTreeMap<Label, Pose>>> = BTreeMap::new();
        for parts in era.predicted.values() {
            let displacements = parts.iter().map(|(label, p)| (*label, p.displacement)).collect();
            let off = likeliest.off_joint(&displacements);
            let is_last = std::ptr::eq(era, eras.last().unwrap());
            assert!(!is_last || off.is_empty(), "{bag}: {off:?} float when all is learned");
            for link in likeliest.links().iter().filter(|link| off.contains(&link.label)) {
                // What has no joint yet is predicted freely, as nothing says how it would move.
                assert_eq!(link.edge, None, "{bag}: part {} is predicted off its joint", link.label);
            }
            by_floating.entry(off).or_default().push(displacements);
        }
        for (off, predicted) in by_floating {
            let tree = likeliest.floating(&off);
            let positions: Vec<BTreeMap<Label, f64>> =
                predicted.iter().map(|parts| tree.positions(parts, &BTreeMap::new())).collect();
            let loaded = load(environment, era, &tree, &positions, true);
            for (parts, poses) in predicted.iter().zip(&loaded.poses) {
                for link in tree.links() {
                    let (Some(displacement), Some(hull)) = (parts.get(&link.label), era.hulls.get(&link.label)) else {
                        continue;
                    };
                    all += 1;
                    let mut above = std::iter::successors(Some(link), |link| link.parent.map(|p| &tree.links()[p]));
                    let mut pose = matrix(&poses[&link_name(link.label)]);
                    if let Some(base) = above.find(|link| link.joint == LinkJoint::Floating) {
                        // Where that is, tf says; what hangs on it is where the description has it from there.
                        floating += usize::from(base == link);
                        let loaded = matrix(&poses[&link_name(base.label)]);
                        let world_from_base = parts[&base.label] * Pose::from_translation(base.origin);
                        pose = homogeneous(&world_from_base) * loaded.try_inverse().unwrap() * pose;
                    }
                    let error = farthest(hull, &link.origin, &pose, displacement);
                    assert!(error < TOLERANCE, "{bag}, part {}: {error} m", link.label);
                    let center = displacement.transform_point(&hull.center) - hull.center;
                    travel = travel.max(center.norm());
                }
            }
        }
    }
    // What moves before its joint was ever learned; the rest is most.
    assert!(floating * 4 < all, "{bag}: {floating} of {all} predictions are of parts that float");
    assert!(travel > 0.1, "{bag}: parts moved by {travel} m at most");

    let era = eras.last().unwrap();
    let tree = LinkTree::likeliest(&era.posterior);
    let seen: BTreeMap<Label, f64> = era.ranges_seen.iter().map(|(label, (_, greatest))| (*label, *greatest)).collect();
    let loaded = load(environment, era, &tree, std::slice::from_ref(&seen), false);
    let expected = tree.displacements(&seen);
    for link in tree.links() {
        let hull = &era.hulls[&link.label];
        let error =
            farthest(hull, &link.origin, &matrix(&loaded.poses[0][&link_name(link.label)]), &expected[&link.label]);
        assert!(error < TOLERANCE, "{bag}, part {}: {error} m", link.label);
        let part = era.posterior.parts.iter().find(|part| part.label == link.label).unwrap();
        assert!((loaded.masses[&link_name(link.label)] - part.mass_kg.median).abs() < 1e-9);
        assert_eq!(loaded.vertices[&link_name(link.label)], 8, "a box");
    }
    let moving: Vec<_> = loaded.joints.iter().filter(|joint| joint.1 != "fixed").collect();
    assert_eq!(moving.len(), moving_joints, "{:?}", loaded.joints);
    for (name, kind, lower, upper, damping, friction) in moving {
        let (lower, upper) = (lower.unwrap(), upper.unwrap());
        let child = tree.links().iter().find(|link| joint_name(link.label) == *name).unwrap();
        let edge = &era.posterior.edges[child.edge.unwrap()];
        assert_eq!(*kind, edge.joint_type.likeliest().0);
        let near = |found: &Option<f64>, expected: f64| (found.unwrap() / expected - 1.0).abs() < 1e-12;
        assert!(near(damping, edge.damping.median) && near(friction, edge.friction.median), "{name}");
        assert!(lower <= 0.0 && upper >= 0.0 && upper - lower > 0.05, "{name}: {lower} to {upper}");
    }
    messages_are_sound(era, &tree);
}

/// Every message of an era can be sent: finite, and below what gets through.
fn messages_are_sound(era: &Era, tree: &LinkTree) {
    let frame = frame();
    let posterior = object_posterior(&era.posterior, &Counters::default(), &frame, Stamp(3)).unwrap();
    assert_eq!((posterior.edges.len(), posterior.edges_left_out), (era.posterior.edges.len(), 0));
    assert_eq!(posterior.windows_learned as usize, era.windows);
    assert!(encoded_bytes(&posterior) < MOST_BYTES);
    let (_, predicted) = era.predicted.last_key_value().unwrap();
    let predictions: Vec<PartPrediction> = predicted.values().copied().collect();
    let future = bayesian_object_models::ros::FutureWrench::Held;
    assert!(encoded_bytes(&predicted_part_poses(&predictions, future, &frame, Stamp(3)).unwrap()) > 100);
    let displacements = predicted.iter().map(|(label, p)| (*label, p.displacement)).collect();
    let picture = Picture { tree, posterior: &era.posterior, hulls: &era.hulls, displacements: &displacements };
    let shown = markers(&picture, &frame, Stamp(3));
    assert_eq!(shown.len(), 1);
    assert_eq!(check_finite(&shown[0]), Ok(()));
    assert!(encoded_bytes(&shown[0]) < MOST_BYTES);
    assert_eq!(link_transforms(tree, &displacements, &frame, Stamp(3)).transforms.len(), tree.links().len());
}

#[test]
fn forward_kinematics_of_the_cabinet_are_the_predicted_poses() {
    let Some(environment) = ros::environment() else { return };
    reproduces(&environment, "cabinet", 3);
}

#[test]
fn forward_kinematics_of_a_chain_are_the_predicted_poses() {
    let Some(environment) = ros::environment() else { return };
    reproduces(&environment, "chain", 2);
}

#[test]
fn the_prior_is_a_description_too() {
    let Some(environment) = ros::environment() else { return };
    let eras = eras("chain");
    let prior = &eras[0];
    assert_eq!(prior.windows, 0);
    let tree = LinkTree::likeliest(&prior.posterior);
    let loaded = load(&environment, prior, &tree, &[BTreeMap::new()], true);
    assert!(loaded.joints.iter().all(|joint| joint.1 == "fixed"), "{:?}", loaded.joints);
    assert_eq!(loaded.joints.len(), prior.posterior.parts.len());
    for link in tree.links() {
        let still = Pose::identity();
        let error = farthest(
            &prior.hulls[&link.label],
            &link.origin,
            &matrix(&loaded.poses[0][&link_name(link.label)]),
            &still,
        );
        assert!(error < TOLERANCE, "part {}: {error} m", link.label);
    }
}
