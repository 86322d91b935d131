//! The replay of a bag: what it writes can be read, and depends on nothing that means nothing.
//!
//! Record A == replay(A): two runs write the same bytes, wall times apart. New numbers for the labels,
//! or a rigid motion of the world with gravity in it, change the posterior's names and axes, not
//! what it says.
#![allow(clippy::unwrap_used)]

mod command;

use std::{
    collections::{BTreeMap, BTreeSet},
    fs,
    path::{Path, PathBuf},
    sync::LazyLock,
};

use bayesian_object_models::{
    io::{
        bag::{Bag, BagWriter},
        cdr::{self, Endianness},
        config::Config,
        document::PosteriorDocument,
        messages::{POINT_CLOUD_TYPE, PointCloud2, RawTransform, TF_TYPE, TfMessage},
    },
    math::Pose,
    types::{
        Label,
        posterior::{EdgePosterior, ObjectPosterior, Quantity},
    },
};
use command::{bom, ours};
use nalgebra::{UnitQuaternion, Vector3};
use tempfile::TempDir;

const ROOT: u32 = 4;
/// Of everything that is compared.
const TOLERANCE: f64 = 1e-6;

/// Replays a bag of the cabinet; returns posterior.json and observations.csv.
fn replay(bag: &Path, root: u32, config: Option<&Path>) -> (String, String) {
    let folder = tempfile::tempdir().unwrap();
    let file = |name: &str| folder.path().join(name).to_str().unwrap().to_owned();
    let (posterior, observations) = (file("posterior.json"), file("observations.csv"));
    let root = root.to_string();
    let mut arguments = vec!["replay", bag.to_str().unwrap(), "--root-label", &root];
    arguments.extend(["--posterior", &posterior, "--observations", &observations]);
    if let Some(config) = config {
        arguments.extend(["--config", config.to_str().unwrap()]);
    }
    let outcome = bom(&arguments);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
    (fs::read_to_string(posterior).unwrap(), fs::read_to_string(observations).unwrap())
}

fn cabinet() -> PathBuf {
    ours("bags/cabinet/cabinet.mcap")
}

/// The cabinet as it was recorded.
static ORIGINAL: LazyLock<(String, String)> = LazyLock::new(|| replay(&cabinet(), ROOT, None));

fn parse(text: &str) -> PosteriorDocument {
    serde_json::from_str(text).unwrap()
}

/// Without the lines of wall times.
fn timeless(text: &str) -> String {
    text.lines().filter(|line| !line.contains("\"inference_wall_s\"")).collect::<Vec<_>>().join("\n")
}

/// The cabinet's bag with every message changed.
fn rewritten(folder: &TempDir, mut change: impl FnMut(&str, &str, &[u8]) -> Vec<u8>) -> PathBuf {
    let path = folder.path().join("changed.mcap");
    let mut writer = BagWriter::create(&path).unwrap();
    let mut topics = BTreeMap::new();
    for message in Bag::open(&cabinet()).unwrap() {
        let (name, type_name) = (&message.topic.name, &message.topic.type_name);
        let topic = *topics.entry(name.clone()).or_insert_with(|| writer.add_topic(name, type_name).unwrap());
        let bytes = change(name, type_name, message.bytes());
        writer.write(topic, message.log_time_ns, message.log_time_ns, &bytes).unwrap();
    }
    writer.finish().unwrap();
    path
}

fn encode<T: serde::Serialize>(message: &T) -> Vec<u8> {
    cdr::encode(message, Endianness::Little).unwrap()
}

/// 1 ↔ 5, 2 → 4 → 3 → 2: no label stays, and their order changes.
fn permuted(label: Label) -> Label {
    Label([0, 5, 4, 2, 3, 1][label.0 as usize])
}

fn with_permuted_labels(cloud: &mut PointCloud2) {
    let field = cloud.fields.iter().find(|field| field.name == "label").unwrap();
    assert_eq!((field.datatype, cloud.is_bigendian), (6, false), "uint32 as the generator writes it");
    let (offset, step) = (field.offset as usize, cloud.point_step as usize);
    for point in cloud.data.to_mut().chunks_exact_mut(step) {
        let label = u32::from_le_bytes(point[offset..offset + 4].try_into().unwrap());
        point[offset..offset + 4].copy_from_slice(&permuted(Label(label)).0.to_le_bytes());
    }
}

/// The new world's frame : what stood at x stands at `moved() · x`.
fn moved() -> Pose {
    let rotation = UnitQuaternion::from_euler_angles(0.3, -0.7, 1.9);
    Pose::from_quaternion(&rotation, Vector3::new(1.7, -2.3, 0.4))
}

fn vector(x: [f64; 3]) -> Vector3<f64> {
    x.into()
}

/// What differs between two posteriors, by name.
#[derive(Default)]
struct Differences(Vec<String>);

impl Differences {
    fn near(&mut self, what: &str, a: f64, b: f64) {
        let is_near = (a - b).abs() <= TOLERANCE * a.abs().max(1.0);
        if !is_near {
            self.0.push(format!("{what}: {a} and {b}"));
        }
    }

    fn zero(&mut self, what: &str, miss: f64) {
        self.near(what, 0.0, miss);
    }

    fn quantities(&mut self, what: &str, a: &Quantity, b: &Quantity) {
        assert_eq!((&a.unit, a.informed_by), (&b.unit, b.informed_by), "{what}");
        let pairs =
            [("median", a.median, b.median), ("std", a.std, b.std), ("q05", a.q05, b.q05), ("q95", a.q95, b.q95)];
        pairs.into_iter().for_each(|(name, a, b)| self.near(&format!("{what}, {name}"), a, b));
    }

    fn limits(&mut self, what: &str, a: Option<&Quantity>, b: Option<&Quantity>) {
        match (a, b) {
            (None, None) => {}
            (Some(a), Some(b)) => self.quantities(what, a, b),
            _ => self.0.push(format!("{what}: known in one")),
        }
    }

    fn edges(&mut self, what: &str, a: &EdgePosterior, b: &EdgePosterior, world: &Pose) {
        self.near(what, a.probability, b.probability);
        let (p, q) = (a.joint_type, b.joint_type);
        let types = [
            ("rigid", p.rigid, q.rigid),
            ("prismatic", p.prismatic, q.prismatic),
            ("revolute", p.revolute, q.revolute),
        ];
        types.into_iter().for_each(|(name, p, q)| self.near(&format!("{what}, {name}"), p, q));
        // The axis of a joint that is as good as excluded means nothing: a hinge far away is a slide.
        let counts = |type_probability: f64| a.probability * type_probability >= ObjectPosterior::LEAST_PROBABILITY;
        if counts(p.revolute)
            && let (Some(p), Some(q)) = (&a.revolute, &b.revolute)
        {
            self.zero(
                &format!("{what}, hinge"),
                (world.rotation * vector(p.axis_direction)).cross(&vector(q.axis_direction)).norm(),
            );
            let miss = world.transform_point(&vector(p.axis_point_m)) - vector(q.axis_point_m);
            self.zero(&format!("{what}, hinge point"), miss.norm());
            for from in [0, 2] {
                let (p, q) = (invariants(&p.covariance, from), invariants(&q.covariance, from));
                (0..2).for_each(|k| self.near(&format!("{what}, hinge covariance"), p[k], q[k]));
            }
        }
        if counts(p.prismatic)
            && let (Some(p), Some(q)) = (&a.prismatic, &b.prismatic)
        {
            self.zero(
                &format!("{what}, slide"),
                (world.rotation * vector(p.axis_direction)).cross(&vector(q.axis_direction)).norm(),
            );
            let (p, q) = (invariants(&p.covariance, 0), invariants(&q.covariance, 0));
            (0..2).for_each(|k| self.near(&format!("{what}, slide covariance"), p[k], q[k]));
        }
        self.quantities(&format!("{what}, damping"), &a.damping, &b.damping);
        self.quantities(&format!("{what}, friction"), &a.friction, &b.friction);
        self.quantities(&format!("{what}, inertia"), &a.joint_inertia, &b.joint_inertia);
        self.limits(&format!("{what}, lower limit"), a.lower_limit.as_ref(), b.lower_limit.as_ref());
        self.limits(&format!("{what}, upper limit"), a.upper_limit.as_ref(), b.upper_limit.as_ref());
    }
}

/// Trace and squared norm of a block on the diagonal: what does not depend on the basis chosen
/// across the axis.
fn invariants<const N: usize>(covariance: &[[f64; N]; N], from: usize) -> [f64; 2] {
    let block = |i: usize, j: usize| covariance[from + i][from + j];
    [block(0, 0) + block(1, 1), (0..4).map(|k| block(k / 2, k % 2).powi(2)).sum()]
}

/// Asserts that `b` is `a` with other labels in another world.
fn assert_same(a: &PosteriorDocument, b: &PosteriorDocument, relabel: fn(Label) -> Label, world: &Pose) {
    assert_eq!(a.counters, b.counters);
    let (a, b) = (&a.posterior, &b.posterior);
    assert_eq!(relabel(a.root_label), b.root_label);
    assert_eq!((a.parts.len(), a.windows.len()), (b.parts.len(), b.windows.len()));
    let mut differences = Differences::default();
    for (one, other, back) in [(a, b, false), (b, a, true)] {
        for edge in &one.edges {
            let same = |e: &&EdgePosterior| match back {
                false => (e.parent, e.child) == (relabel(edge.parent), relabel(edge.child)),
                true => (relabel(e.parent), relabel(e.child)) == (edge.parent, edge.child),
            };
            let what = format!("edge {} → {}", edge.parent, edge.child);
            match other.edges.iter().find(same) {
                Some(found) if !back => differences.edges(&what, edge, found, world),
                Some(_) => {}
                // At the threshold an edge may be in one file only.
                None => differences.near(&what, edge.probability, 0.0),
            }
        }
    }
    for part in &a.parts {
        let what = format!("part {}", part.label);
        let other = b.parts.iter().find(|p| p.label == relabel(part.label)).unwrap();
        let miss = world.transform_point(&vector(part.com_in_world_m)) - vector(other.com_in_world_m);
        differences.zero(&format!("{what}, centre of mass"), miss.norm());
        differences.quantities(&format!("{what}, mass"), &part.mass_kg, &other.mass_kg);
    }
    for (p, q) in a.windows.iter().zip(&b.windows) {
        assert_eq!((p.t0_s, p.t1_s, p.frames), (q.t0_s, q.t1_s, q.frames));
        let relabelled: BTreeSet<Label> = p.labels.iter().map(|label| relabel(*label)).collect();
        assert_eq!(relabelled, q.labels.iter().copied().collect());
    }
    assert!(differences.0.is_empty(), "{} differences:\n{}", differences.0.len(), differences.0.join("\n"));
}

#[test]
fn what_is_written_can_be_read() {
    let (posterior, observations) = &*ORIGINAL;
    let document = parse(posterior);
    assert_eq!(document.schema, "bom.posterior/1");
    let posterior = &document.posterior;
    assert_eq!(posterior.root_label, Label(ROOT));
    assert_eq!(posterior.parts.len(), 5);
    assert!(!posterior.windows.is_empty());
    for child in posterior.parts.iter().map(|part| part.label).filter(|label| label.0 != ROOT) {
        let into = posterior.edges.iter().filter(|edge| edge.child == child);
        let total: f64 = into.map(|edge| edge.probability).sum();
        assert!((total - 1.0).abs() < 1e-4, "edges into {child}: {total}");
    }
    for edge in &posterior.edges {
        let types = edge.joint_type;
        assert!((types.rigid + types.prismatic + types.revolute - 1.0).abs() < 1e-9, "{edge:?}");
    }
    assert!(posterior.windows.iter().all(|window| window.inference_wall_s > 0.0 && window.t1_s > window.t0_s));
    let mut lines = observations.lines();
    assert_eq!(lines.next(), Some("t_s,label,x_m,y_m,z_m,qx,qy,qz,qw,std_x_m,std_y_m,std_z_m"));
    let mut rows = 0;
    for line in lines {
        let numbers: Vec<f64> = line.split(',').map(|cell| cell.parse().unwrap()).collect();
        assert_eq!(numbers.len(), 12, "{line}");
        assert!(numbers.iter().all(|x| x.is_finite()), "{line}");
        let norm: f64 = numbers[5..9].iter().map(|x| x * x).sum();
        assert!((norm - 1.0).abs() < 1e-6, "{line}");
        rows += 1;
    }
    let stamps = document.counters.clouds_in / 2;
    assert!(rows > 4 * stamps, "{rows} rows of 5 parts at {stamps} stamps of two cameras");
}

#[test]
fn two_runs_give_the_same_bytes() {
    let (posterior, observations) = replay(&cabinet(), ROOT, None);
    assert_eq!(timeless(&posterior), timeless(&ORIGINAL.0));
    assert_eq!(observations, ORIGINAL.1);
}

#[test]
fn permuted_labels_give_the_same_posterior() {
    let folder = tempfile::tempdir().unwrap();
    let bag = rewritten(&folder, |_, type_name, bytes| {
        if type_name != POINT_CLOUD_TYPE {
            return bytes.to_vec();
        }
        let mut cloud: PointCloud2 = cdr::decode(bytes).unwrap();
        with_permuted_labels(&mut cloud);
        encode(&cloud)
    });
    let (posterior, _) = replay(&bag, permuted(Label(ROOT)).0, None);
    assert_same(&parse(&ORIGINAL.0), &parse(&posterior), permuted, &Pose::identity());
}

#[test]
fn a_moved_world_gives_the_same_posterior() {
    let folder = tempfile::tempdir().unwrap();
    let moved = moved();
    let bag = rewritten(&folder, |_, type_name, bytes| {
        if type_name != TF_TYPE {
            return bytes.to_vec();
        }
        let mut message: TfMessage = cdr::decode(bytes).unwrap();
        for transform in message.transforms.iter_mut().filter(|t| t.header.frame_id == "world") {
            let q = transform.transform.rotation;
            let rotation = UnitQuaternion::from_quaternion(nalgebra::Quaternion::new(q.w, q.x, q.y, q.z));
            let old = Pose::from_quaternion(&rotation, transform.transform.translation.into());
            transform.transform = RawTransform::from(moved * old);
        }
        encode(&message)
    });
    let gravity = moved.rotation * Vector3::from(Config::default().gravity_m_s2);
    let config = folder.path().join("gravity.yaml");
    fs::write(&config, format!("gravity_m_s2: {:?}\n", gravity.as_slice())).unwrap();
    let (posterior, _) = replay(&bag, ROOT, Some(&config));
    assert_same(&parse(&ORIGINAL.0), &parse(&posterior), |label| label, &moved);
}

#[test]
fn a_root_that_is_not_given_is_found() {
    let outcome = bom(&["replay", cabinet().to_str().unwrap()]);
    assert_eq!(outcome.status, 0, "{outcome:?}");
    assert!(outcome.out.contains(&format!("{ROOT}  root (found)")), "{outcome:?}");
}

#[test]
fn the_largest_part_may_be_none() {
    let folder = tempfile::tempdir().unwrap();
    let mut points = 0;
    let bag = rewritten(&folder, |_, type_name, bytes| {
        if type_name != POINT_CLOUD_TYPE {
            return bytes.to_vec();
        }
        let mut cloud: PointCloud2 = cdr::decode(bytes).unwrap();
        let place = |name: &str| cloud.fields.iter().find(|field| field.name == name).unwrap().offset as usize;
        let (label, x, step) = (place("label"), place("x"), cloud.point_step as usize);
        // Of the body's points every third is left: the door is larger, and moves.
        for point in cloud.data.to_mut().chunks_exact_mut(step) {
            if u32::from_le_bytes(point[label..label + 4].try_into().unwrap()) == ROOT {
                points += 1;
                if points % 3 != 0 {
                    point[x..x + 4].copy_from_slice(&f32::NAN.to_le_bytes());
                }
            }
        }
        encode(&cloud)
    });
    let outcome = bom(&["replay", bag.to_str().unwrap()]);
    assert_eq!(outcome.status, 0, "{outcome:?}");
    assert!(outcome.out.contains(&format!("{ROOT}  root (found)")), "{outcome:?}");
}
