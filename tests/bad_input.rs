//! Every way in which messages can be bad: dropped, counted by reason, named once; the rest is used.
#![allow(clippy::unwrap_used)]

use bayesian_object_models::{
    io::{
        bag::{Bag, BagWriter},
        cdr::{self, Endianness},
        config::{InputConfig, PartBinding, WrenchTopic},
        ingest::Ingest,
        messages::{
            Header, POINT_CLOUD_TYPE, POSE_TYPE, PointCloud2, PointField, PoseWithCovariance,
            PoseWithCovarianceStamped, RawPose, RawQuaternion, RawTransform, TF_TYPE, TfMessage, TransformStamped,
            WRENCH_TYPE, Wrench, WrenchStamped, Xyz,
        },
        topics::MissingTopics,
    },
    math::Pose,
    types::{Input, Label, Stamp},
};
use nalgebra::{UnitQuaternion, Vector3};
use proptest::prelude::*;
use serde::Serialize;

/// A way to spoil a cloud, and the reason it is then dropped for.
type Spoiled = (&'static str, fn(&mut PointCloud2));

fn bytes<T: Serialize>(message: &T) -> Vec<u8> {
    cdr::encode(message, Endianness::Little).unwrap()
}

fn header(frame: &str, stamp_s: f64) -> Header {
    Header { stamp: Stamp::default().plus_seconds(stamp_s).into(), frame_id: frame.into() }
}

fn cloud_of(frame: &str, stamp_s: f64, points: &[([f32; 3], u32)]) -> PointCloud2<'static> {
    let field = |name: &str, offset, datatype| PointField { name: name.into(), offset, datatype, count: 1 };
    let mut data = Vec::new();
    for (point, label) in points {
        point.iter().for_each(|x| data.extend(x.to_le_bytes()));
        data.extend(label.to_le_bytes());
    }
    PointCloud2 {
        header: header(frame, stamp_s),
        height: 1,
        width: points.len() as u32,
        fields: vec![field("x", 0, 7), field("y", 4, 7), field("z", 8, 7), field("label", 12, 6)],
        is_bigendian: false,
        point_step: 16,
        row_step: data.len() as u32,
        data: data.into(),
        is_dense: true,
    }
}

fn cloud(frame: &str, stamp_s: f64) -> PointCloud2<'static> {
    cloud_of(frame, stamp_s, &[([1.0, 0.0, 0.0], 4), ([0.0, 1.0, 0.0], 5)])
}

fn wrench(frame: &str, stamp_s: f64) -> WrenchStamped {
    let force = Xyz { x: 1.0, y: 0.0, z: 0.0 };
    let torque = Xyz { x: 0.0, y: 0.0, z: 2.0 };
    WrenchStamped { header: header(frame, stamp_s), wrench: Wrench { force, torque } }
}

fn pose(stamp_s: f64, orientation: RawQuaternion, variances: [f64; 6]) -> PoseWithCovarianceStamped {
    let covariance = std::array::from_fn(|i| std::array::from_fn(|j| if i == j { variances[i] } else { 0.0 }));
    let position = Xyz { x: 1.0, y: 2.0, z: 3.0 };
    PoseWithCovarianceStamped {
        header: header("world", stamp_s),
        pose: PoseWithCovariance { pose: RawPose { position, orientation }, covariance },
    }
}

/// `child` stands at (0, 0, 1) in `parent`, turned by a quarter about z.
fn tf(parent: &str, child: &str, stamp_s: f64) -> TfMessage {
    let rotation = UnitQuaternion::from_axis_angle(&Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
    let transform = RawTransform::from(Pose::from_quaternion(&rotation, Vector3::z()));
    TfMessage {
        transforms: vec![TransformStamped { header: header(parent, stamp_s), child_frame_id: child.into(), transform }],
    }
}

const IDENTITY: RawQuaternion = RawQuaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };

/// An `Ingest` with a shorthand for each kind of message.
struct Feed(Ingest);

impl Feed {
    fn new() -> Self {
        Self(Ingest::new(&InputConfig::default()))
    }
    fn cloud(&mut self, message: &PointCloud2) -> Vec<Input> {
        self.0.push("/parts/points", POINT_CLOUD_TYPE, &bytes(message))
    }
    fn wrench(&mut self, message: &WrenchStamped) -> Vec<Input> {
        self.0.push("/wrench", WRENCH_TYPE, &bytes(message))
    }
    fn pose(&mut self, message: &PoseWithCovarianceStamped) -> Vec<Input> {
        self.0.push("/parts/7/pose", POSE_TYPE, &bytes(message))
    }
    fn tf(&mut self, message: &TfMessage) -> Vec<Input> {
        self.0.push("/tf", TF_TYPE, &bytes(message))
    }
    fn lines(&self) -> Vec<String> {
        self.0.diagnostics().iter().map(ToString::to_string).collect()
    }
}

#[test]
fn good_messages_arrive_in_world() {
    let mut feed = Feed::new();
    feed.tf(&tf("world", "tool", 0.0));
    feed.tf(&tf("world", "tool", 2.0));
    let inputs = feed.cloud(&cloud("tool", 1.0));
    let [Input::Cloud(found)] = &inputs[..] else { panic!("{inputs:?}") };
    assert_eq!(found.viewpoint_in_world, Some(Vector3::z()));
    assert!((found.points[0].point_in_world - Vector3::new(0.0, 1.0, 1.0)).norm() < 1e-12);
    assert_eq!(found.points[1].label, Label(5));
    let inputs = feed.wrench(&wrench("tool", 1.0));
    let [Input::Wrench(found)] = &inputs[..] else { panic!("{inputs:?}") };
    assert!((found.force_in_world - Vector3::y()).norm() < 1e-12);
    assert!((found.torque_in_world - Vector3::z() * 2.0).norm() < 1e-12);
    assert_eq!((found.point_in_world, found.part), (Vector3::z(), None));
    let inputs = feed.pose(&pose(1.0, IDENTITY, [0.0; 6]));
    let [Input::Pose(found)] = &inputs[..] else { panic!("{inputs:?}") };
    assert_eq!((found.label, found.world_from_frame.translation), (Label(7), Vector3::new(1.0, 2.0, 3.0)));
    assert!((found.information[(3, 3)] - 250_000.0).abs() < 1e-6, "an all-zero covariance means the default");
    assert!(feed.lines().is_empty());
}

#[test]
fn a_reaction_sensor_is_turned_and_a_bound_topic_names_its_part() {
    let topic = |topic: &str, part, reaction| WrenchTopic { topic: topic.into(), part, reaction };
    let config = InputConfig {
        wrenches: vec![
            topic("wrench", PartBinding::Auto, false),
            topic("/left/wrench", PartBinding::Part(Label(3)), true),
        ],
        ..InputConfig::default()
    };
    let mut ingest = Ingest::new(&config);
    let inputs = ingest.push("/left/wrench", WRENCH_TYPE, &bytes(&wrench("world", 1.0)));
    let [Input::Wrench(found)] = &inputs[..] else { panic!("{inputs:?}") };
    assert_eq!((found.source, found.part), (1, Some(Label(3))));
    assert_eq!((found.force_in_world, found.torque_in_world), (-Vector3::x(), Vector3::z() * -2.0));
}

#[test]
fn messages_wait_for_their_transform_in_order() {
    let mut feed = Feed::new();
    assert!(feed.cloud(&cloud("camera", 1.0)).is_empty());
    assert!(feed.cloud(&cloud("world", 1.1)).is_empty(), "behind the first");
    assert_eq!(feed.wrench(&wrench("world", 1.2)).len(), 1, "another topic goes on");
    feed.tf(&tf("world", "camera", 0.9));
    let stamps: Vec<Stamp> = feed.tf(&tf("world", "camera", 1.05)).iter().map(Input::stamp).collect();
    assert_eq!(stamps, [Stamp(1_000_000_000), Stamp(1_100_000_000)]);
    assert!(feed.0.flush().is_empty());
    assert!(feed.lines().is_empty());
}

#[test]
fn a_message_without_transform_is_dropped_after_the_timeout() {
    let mut feed = Feed::new();
    feed.cloud(&cloud("nowhere", 1.0));
    feed.wrench(&wrench("nobody", 1.0));
    feed.wrench(&wrench("nobody", 1.1));
    assert!(feed.wrench(&wrench("world", 2.05)).is_empty(), "waits behind the one of 1.1 s");
    assert_eq!(feed.cloud(&cloud("world", 2.2)).len(), 2);
    feed.cloud(&cloud("nowhere", 2.3));
    assert!(feed.0.flush().is_empty());
    assert_eq!(feed.0.counters().clouds_dropped["unknown_frame"], 2);
    assert_eq!(feed.0.counters().wrenches_dropped["unknown_frame"], 2);
    let mut lines = feed.lines();
    lines.sort();
    let expected = [
        "/parts/points, stamp 1.000 s: frame `nowhere` is unknown",
        "/wrench, stamp 1.000 s: frame `nobody` is unknown",
    ];
    assert_eq!(lines, expected, "once per cause");
}

#[test]
fn duplicate_and_backward_stamps_are_dropped_frame_by_frame() {
    let mut feed = Feed::new();
    feed.tf(&tf("world", "camera", 0.0));
    feed.tf(&tf("world", "camera", 9.0));
    assert_eq!(feed.cloud(&cloud("world", 1.0)).len(), 1);
    let second = feed.cloud(&cloud("camera", 1.0));
    assert!(matches!(&second[..], [Input::Cloud(cloud)] if cloud.source == 1), "another camera");
    assert!(feed.cloud(&cloud("world", 1.0)).is_empty());
    assert!(feed.cloud(&cloud("world", 0.5)).is_empty());
    assert_eq!(feed.cloud(&cloud("world", 1.5)).len(), 1);
    let dropped = &feed.0.counters().clouds_dropped;
    assert_eq!((dropped["duplicate_stamp"], dropped["backward_stamp"]), (1, 1));
    assert_eq!(feed.lines()[1], "/parts/points, stamp 0.500 s: frame `world`: stamp goes back by 0.500 s");
}

#[test]
fn bad_clouds_are_named_and_good_ones_still_used() {
    let mut feed = Feed::new();
    let changes: [Spoiled; 7] = [
        ("no_label_field", |c| c.fields.truncate(3)),
        ("no_coordinate_field", |c| {
            c.fields.remove(0);
        }),
        ("empty", |c| c.width = 0),
        ("bad_point_step", |c| c.point_step = 0),
        ("bad_row_step", |c| c.row_step = 1),
        ("short_data", |c| c.height = 1000),
        ("no_usable_point", |c| c.data.to_mut().fill(0xFF)),
    ];
    for (index, (kind, change)) in changes.into_iter().enumerate() {
        let mut message = cloud("world", index as f64);
        change(&mut message);
        assert!(feed.cloud(&message).is_empty());
        assert_eq!(feed.0.counters().clouds_dropped[kind], 1, "{kind}");
        assert_eq!(feed.lines().len(), index + 1);
    }
    assert_eq!(feed.0.counters().points_dropped["not_finite"], 2);
    let partly = cloud_of("world", 10.0, &[([f32::NAN; 3], 1), ([1.0; 3], 1)]);
    assert_eq!(feed.cloud(&partly).len(), 1);
    assert_eq!(feed.0.counters().points_dropped["not_finite"], 3);
    assert_eq!((feed.0.counters().clouds_in, feed.0.counters().points_in), (8, 1));
}

#[test]
fn bad_wrenches_poses_and_transforms_are_dropped() {
    let mut feed = Feed::new();
    let mut message = wrench("world", 1.0);
    message.wrench.torque.y = f64::NAN;
    assert!(feed.wrench(&message).is_empty());
    message = wrench("world", 2.0);
    message.header.stamp.nanosec = 2_000_000_000;
    assert!(feed.wrench(&message).is_empty());
    assert_eq!(feed.0.counters().wrenches_dropped.values().sum::<u64>(), 2);

    let zero = RawQuaternion { w: 0.0, ..IDENTITY };
    assert!(feed.pose(&pose(1.0, zero, [0.1; 6])).is_empty());
    assert!(feed.pose(&pose(2.0, IDENTITY, [f64::NAN; 6])).is_empty());
    let dropped = &feed.0.counters().poses_dropped;
    assert_eq!((dropped["bad_quaternion"], dropped["bad_covariance"]), (1, 1));
    let position_only = [0.01, 0.01, 0.01, f64::INFINITY, f64::INFINITY, f64::INFINITY];
    let inputs = feed.pose(&pose(3.0, zero, position_only));
    let [Input::Pose(found)] = &inputs[..] else { panic!("{inputs:?}") };
    assert_eq!(found.information.fixed_view::<3, 6>(0, 0).norm(), 0.0, "no orientation, no information");

    feed.tf(&tf("tool", "tool", 0.0));
    assert_eq!((feed.0.counters().tf_in, feed.0.counters().tf_dropped["ring"]), (1, 1));
}

#[test]
fn wrong_types_and_undecodable_bytes_are_named() {
    let mut feed = Feed::new();
    feed.0.push("/wrench", "geometry_msgs/msg/Wrench", &bytes(&wrench("world", 1.0)));
    feed.0.push("/wrench", WRENCH_TYPE, &[0, 1, 0, 0, 9]);
    feed.0.push("/other", "std_msgs/msg/String", &[]);
    let expected = [
        "/wrench: type geometry_msgs/msg/Wrench, expected geometry_msgs/msg/WrenchStamped",
        "/wrench: byte 4 of 5: unexpected end of input",
    ];
    assert_eq!(feed.lines(), expected);
    assert_eq!(feed.0.counters().wrenches_in, 2);
}

#[test]
fn missing_topics_are_named_with_those_that_exist() {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("bag.mcap");
    let report = |topics: &[(&str, &str)]| {
        let mut writer = BagWriter::create(&path).unwrap();
        for (name, type_name) in topics {
            let topic = writer.add_topic(name, type_name).unwrap();
            writer.write(topic, 0, 0, &bytes(&wrench("world", 0.0))).unwrap();
        }
        writer.finish().unwrap();
        MissingTopics::of(&InputConfig::default(), Bag::open(&path).unwrap().summary())
    };
    assert_eq!(report(&[("/parts/points", POINT_CLOUD_TYPE), ("/wrench", WRENCH_TYPE)]), None);
    assert_eq!(report(&[("/parts/3/pose", POSE_TYPE), ("/wrench", WRENCH_TYPE)]), None);
    let missing = report(&[("/camera/points", POINT_CLOUD_TYPE), ("/wrench", WRENCH_TYPE)]).unwrap();
    assert!(missing.nothing_to_see);
    assert_eq!(
        missing.to_string(),
        "no messages on /parts/points (sensor_msgs/msg/PointCloud2); the bag has: \
         /camera/points (sensor_msgs/msg/PointCloud2), /wrench (geometry_msgs/msg/WrenchStamped)"
    );
    let missing = report(&[("/parts/points", POINT_CLOUD_TYPE)]).unwrap();
    assert!(!missing.nothing_to_see && missing.missing.len() == 1);
}

fn is_finite(input: &Input) -> bool {
    match input {
        Input::Cloud(cloud) => cloud.points.iter().all(|point| point.point_in_world.iter().all(|x| x.is_finite())),
        Input::Wrench(w) => w.force_in_world.iter().chain(&w.torque_in_world).all(|x| x.is_finite()),
        Input::Pose(pose) => pose.information.iter().all(|x| x.is_finite()),
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(2000))]

    #[test]
    fn no_bytes_make_ingest_panic_or_give_a_nan(
        which in 0..4_usize,
        changes in prop::collection::vec((any::<prop::sample::Index>(), any::<u8>()), 0..6),
        cut in prop::option::of(any::<prop::sample::Index>()),
        noise in prop::option::of(prop::collection::vec(any::<u8>(), 0..300)),
    ) {
        let (topic, type_name, mut message) = [
            ("/parts/points", POINT_CLOUD_TYPE, bytes(&cloud("tool", 1.0))),
            ("/wrench", WRENCH_TYPE, bytes(&wrench("tool", 1.0))),
            ("/parts/7/pose", POSE_TYPE, bytes(&pose(1.0, IDENTITY, [0.1; 6]))),
            ("/tf", TF_TYPE, bytes(&tf("world", "tool", 1.0))),
        ][which].clone();
        for (index, value) in changes {
            let position = index.index(message.len());
            message[position] = value;
        }
        if let Some(index) = cut {
            message.truncate(index.index(message.len()));
        }
        let message = noise.unwrap_or(message);
        let mut feed = Feed::new();
        feed.tf(&tf("world", "tool", 0.0));
        let mut inputs = feed.0.push(topic, type_name, &message);
        inputs.extend(feed.tf(&tf("world", "tool", 2.0)));
        inputs.extend(feed.wrench(&wrench("tool", 1.5)));
        inputs.extend(feed.0.flush());
        prop_assert!(inputs.iter().all(is_finite));
    }
}
