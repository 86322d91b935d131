//! Bags written here are read by two independent readers: `mcap-ros2-support` and `rosbags` (PyPI).
//!
//! Needs `BOM_PEER_PYTHON`: a Python that has `bag_peer/requirements.txt`.
#![allow(clippy::unwrap_used, clippy::print_stderr)]

use std::{path::Path, process::Command};

use bayesian_object_models::{
    io::{
        bag::{BagWriter, Compression},
        cdr::{self, Endianness},
        messages::{
            Header, POINT_CLOUD_TYPE, POSE_TYPE, PointCloud2, PointField, PoseWithCovariance,
            PoseWithCovarianceStamped, RawPose, RawQuaternion, RawTransform, TF_TYPE, TfMessage, Time,
            TransformStamped, WRENCH_TYPE, Wrench, WrenchStamped, Xyz,
        },
    },
    math::Pose,
};
use nalgebra::Vector3;
use serde::Serialize;
use serde_json::{Value, json};

fn header(frame: &str) -> Header {
    Header { stamp: Time { sec: 12, nanosec: 345_000_000 }, frame_id: frame.into() }
}

fn xyz(x: f64, y: f64, z: f64) -> Xyz {
    Xyz { x, y, z }
}

fn bytes<T: Serialize>(message: &T) -> Vec<u8> {
    cdr::encode(message, Endianness::Little).unwrap()
}

/// One message of every type, with what a reader must say of it.
fn contents() -> Vec<(&'static str, &'static str, Vec<u8>, Value)> {
    let field = |name: &str, offset, datatype| PointField { name: name.into(), offset, datatype, count: 1 };
    let data: Vec<u8> = (0..32).collect();
    let cloud = PointCloud2 {
        header: header("camera"),
        height: 1,
        width: 2,
        fields: vec![field("x", 0, 7), field("y", 4, 7), field("z", 8, 7), field("label", 12, 6)],
        is_bigendian: false,
        point_step: 16,
        row_step: 32,
        data: data.clone().into(),
        is_dense: true,
    };
    let wrench = Wrench { force: xyz(1.0, -2.5, 3.0), torque: xyz(0.25, 0.0, -1e-9) };
    let wrench = WrenchStamped { header: header("tool"), wrench };
    let covariance: [[f64; 6]; 6] = std::array::from_fn(|i| std::array::from_fn(|j| (6 * i + j) as f64));
    let orientation = RawQuaternion { x: 0.0, y: 0.0, z: 0.0, w: 1.0 };
    let pose = RawPose { position: xyz(1.0, 2.0, 3.0), orientation };
    let pose = PoseWithCovarianceStamped { header: header("world"), pose: PoseWithCovariance { pose, covariance } };
    let transform = RawTransform::from(Pose::from_translation(Vector3::new(0.5, 0.0, -1.0)));
    let transform = TransformStamped { header: header("world"), child_frame_id: "camera".into(), transform };
    let stamp = json!([12, 345_000_000]);
    let fields = json!([["x", 0, 7, 1], ["y", 4, 7, 1], ["z", 8, 7, 1], ["label", 12, 6, 1]]);
    let numbers: Vec<f64> = (0..36).map(f64::from).collect();
    vec![
        (
            "/parts/points",
            POINT_CLOUD_TYPE,
            bytes(&cloud),
            json!({"stamp": stamp, "frame": "camera", "width": 2, "fields": fields, "data": data}),
        ),
        (
            "/wrench",
            WRENCH_TYPE,
            bytes(&wrench),
            json!({"stamp": stamp, "frame": "tool", "wrench": [1.0, -2.5, 3.0, 0.25, 0.0, -1e-9]}),
        ),
        (
            "/parts/3/pose",
            POSE_TYPE,
            bytes(&pose),
            json!({"stamp": stamp, "frame": "world", "position": [1.0, 2.0, 3.0], "covariance": numbers}),
        ),
        (
            "/tf",
            TF_TYPE,
            bytes(&TfMessage { transforms: vec![transform] }),
            json!({"stamp": stamp, "frame": "world", "child": "camera", "pose": [0.5, 0.0, -1.0, 0.0, 0.0, 0.0, 1.0]}),
        ),
    ]
}

/// Writes the bag; returns what a reader must say of it.
fn write(path: &Path, compression: Compression, chunk_size: Option<u64>) -> Value {
    let mut writer = BagWriter::create_with(path, compression, chunk_size).unwrap();
    let mut expected = Vec::new();
    for (index, (topic, type_name, bytes, mut content)) in contents().into_iter().enumerate() {
        let log_time = 20_000_000_000 + index as u64;
        let id = writer.add_topic(topic, type_name).unwrap();
        writer.write(id, log_time, log_time, &bytes).unwrap();
        content["topic"] = topic.into();
        content["log_time"] = log_time.into();
        expected.push(content);
    }
    writer.finish().unwrap();
    expected.into()
}

#[test]
fn independent_readers_see_what_was_written() {
    let Some(python) = std::env::var_os("BOM_PEER_PYTHON") else {
        eprintln!("SKIPPED: BOM_PEER_PYTHON is not set");
        return;
    };
    let folder = tempfile::tempdir().unwrap();
    let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/bag_peer/read.py");
    for (name, compression, chunk_size) in [
        ("zstd", Compression::Zstd, Some(100)),
        ("lz4", Compression::Lz4, Some(1 << 20)),
        ("plain", Compression::None, Some(1 << 20)),
        ("no_chunks", Compression::None, None),
    ] {
        let path = folder.path().join(name).with_extension("mcap");
        let expected = write(&path, compression, chunk_size);
        let output = Command::new(&python).arg(&script).arg(&path).output().unwrap();
        assert!(output.status.success(), "{name}: {}", String::from_utf8_lossy(&output.stderr));
        let found: Value = serde_json::from_slice(&output.stdout).unwrap();
        for reader in ["mcap", "rosbags"] {
            assert_eq!(found[reader], expected, "{name}, {reader}");
        }
    }
}
