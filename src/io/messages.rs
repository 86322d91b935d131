//! The ROS 2 messages that are read, as plain serde structs in the order of their definitions.
//!
//! Field for field as in common_interfaces and geometry2, branch jazzy. The schema text that a
//! bag must carry for each is in `definitions/`.

use std::borrow::Cow;

use nalgebra::{Quaternion, UnitQuaternion, Vector3};
use serde::{Deserialize, Serialize};

use crate::{math::Pose, types::Stamp};

/// The type name of [`PointCloud2`] in a bag.
pub const POINT_CLOUD_TYPE: &str = "sensor_msgs/msg/PointCloud2";
/// The type name of [`WrenchStamped`] in a bag.
pub const WRENCH_TYPE: &str = "geometry_msgs/msg/WrenchStamped";
/// The type name of [`PoseWithCovarianceStamped`] in a bag.
pub const POSE_TYPE: &str = "geometry_msgs/msg/PoseWithCovarianceStamped";
/// The type name of [`TfMessage`] in a bag.
pub const TF_TYPE: &str = "tf2_msgs/msg/TFMessage";

/// builtin_interfaces/Time.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Time {
    /// Whole seconds.
    pub sec: i32,
    /// Nanoseconds, below 10⁹.
    pub nanosec: u32,
}

impl From<Stamp> for Time {
    fn from(stamp: Stamp) -> Self {
        let sec = stamp.0.div_euclid(1_000_000_000);
        let sec = i32::try_from(sec).unwrap_or(if sec < 0 { i32::MIN } else { i32::MAX });
        Self { sec, nanosec: stamp.0.rem_euclid(1_000_000_000) as u32 }
    }
}

impl From<Time> for Stamp {
    fn from(time: Time) -> Self {
        Stamp(i64::from(time.sec) * 1_000_000_000 + i64::from(time.nanosec))
    }
}

/// std_msgs/Header.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Header {
    /// Time of capture.
    pub stamp: Time,
    /// The frame the content is in.
    pub frame_id: String,
}

/// sensor_msgs/PointField.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct PointField {
    /// Name, as `x`.
    pub name: String,
    /// Bytes from the start of the point.
    pub offset: u32,
    /// 1 to 8: int8, uint8, int16, uint16, int32, uint32, float32, float64.
    pub datatype: u8,
    /// Elements in the field.
    pub count: u32,
}

/// sensor_msgs/PointCloud2, its data borrowed from the message's bytes.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PointCloud2<'a> {
    /// Capture time and sensor frame.
    pub header: Header,
    /// Rows; 1 for an unordered cloud.
    pub height: u32,
    /// Points in a row.
    pub width: u32,
    /// The layout of a point.
    pub fields: Vec<PointField>,
    /// Byte order of `data`, whatever that of the message.
    pub is_bigendian: bool,
    /// Bytes of a point.
    pub point_step: u32,
    /// Bytes of a row.
    pub row_step: u32,
    /// The points, `row_step * height` bytes.
    #[serde(borrow, with = "serde_bytes")]
    pub data: Cow<'a, [u8]>,
    /// No invalid points, claims the sender.
    pub is_dense: bool,
}

/// geometry_msgs/Vector3 and geometry_msgs/Point.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Xyz {
    /// First component.
    pub x: f64,
    /// Second component.
    pub y: f64,
    /// Third component.
    pub z: f64,
}

impl From<Xyz> for Vector3<f64> {
    fn from(xyz: Xyz) -> Self {
        Vector3::new(xyz.x, xyz.y, xyz.z)
    }
}

impl From<Vector3<f64>> for Xyz {
    fn from(vector: Vector3<f64>) -> Self {
        Self { x: vector.x, y: vector.y, z: vector.z }
    }
}

/// geometry_msgs/Quaternion, as sent: not yet known to be a rotation.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RawQuaternion {
    /// First imaginary component.
    pub x: f64,
    /// Second imaginary component.
    pub y: f64,
    /// Third imaginary component.
    pub z: f64,
    /// Real component.
    pub w: f64,
}

impl RawQuaternion {
    /// The rotation, if the squared norm is within 0.01 of one (tf2's own tolerance,
    /// `QUATERNION_NORMALIZATION_TOLERANCE`); rounding is then divided out.
    pub fn unit(self) -> Option<UnitQuaternion<f64>> {
        let quaternion = Quaternion::new(self.w, self.x, self.y, self.z);
        ((quaternion.norm_squared() - 1.0).abs() <= 0.01).then(|| UnitQuaternion::from_quaternion(quaternion))
    }

    /// Its norm, for error messages.
    pub fn norm(self) -> f64 {
        Quaternion::new(self.w, self.x, self.y, self.z).norm()
    }
}

impl From<UnitQuaternion<f64>> for RawQuaternion {
    fn from(rotation: UnitQuaternion<f64>) -> Self {
        Self { x: rotation.i, y: rotation.j, z: rotation.k, w: rotation.w }
    }
}

/// geometry_msgs/Wrench.
#[derive(Clone, Copy, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Wrench {
    /// \[N\].
    pub force: Xyz,
    /// \[N·m\], about the frame's origin.
    pub torque: Xyz,
}

/// geometry_msgs/WrenchStamped.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WrenchStamped {
    /// Time of the reading and frame of the sensor.
    pub header: Header,
    /// The reading, in that frame.
    pub wrench: Wrench,
}

/// geometry_msgs/Pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RawPose {
    /// \[m\].
    pub position: Xyz,
    /// Orientation, as sent.
    pub orientation: RawQuaternion,
}

/// geometry_msgs/PoseWithCovariance.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseWithCovariance {
    /// The pose.
    pub pose: RawPose,
    /// 6×6, linear \[m\] first, then rotation about the fixed axes \[rad\]; symmetric, so that
    /// rows and columns are the same.
    pub covariance: [[f64; 6]; 6],
}

/// geometry_msgs/PoseWithCovarianceStamped.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseWithCovarianceStamped {
    /// Time of the measurement and the frame that the pose is in.
    pub header: Header,
    /// The measurement.
    pub pose: PoseWithCovariance,
}

/// geometry_msgs/Transform.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct RawTransform {
    /// \[m\].
    pub translation: Xyz,
    /// Rotation, as sent.
    pub rotation: RawQuaternion,
}

impl From<Pose> for RawTransform {
    fn from(pose: Pose) -> Self {
        Self { translation: pose.translation.into(), rotation: pose.quaternion().into() }
    }
}

/// geometry_msgs/TransformStamped: `header.frame_id` from `child_frame_id`.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct TransformStamped {
    /// Time, and the parent frame.
    pub header: Header,
    /// The child frame.
    pub child_frame_id: String,
    /// Carries points of the child into the parent.
    pub transform: RawTransform,
}

/// tf2_msgs/TFMessage.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct TfMessage {
    /// Any number of transforms.
    pub transforms: Vec<TransformStamped>,
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::cdr::{self, Endianness};

    #[test]
    fn every_message_survives_both_byte_orders() {
        let header = Header { stamp: Time { sec: -3, nanosec: 999_999_999 }, frame_id: "cam".into() };
        let rotation = UnitQuaternion::from_euler_angles(0.1, -0.2, 0.3);
        let cloud = PointCloud2 {
            header: header.clone(),
            height: 1,
            width: 3,
            fields: vec![PointField { name: "x".into(), offset: 0, datatype: 7, count: 1 }],
            is_bigendian: false,
            point_step: 1,
            row_step: 3,
            data: vec![1, 2, 3].into(),
            is_dense: true,
        };
        let wrench = WrenchStamped {
            header: header.clone(),
            wrench: Wrench { force: Xyz { x: 1.0, y: 2.0, z: 3.0 }, torque: Xyz { x: 4.0, y: 5.0, z: 6.0 } },
        };
        let pose = PoseWithCovarianceStamped {
            header: header.clone(),
            pose: PoseWithCovariance {
                pose: RawPose { position: Xyz { x: 1.0, y: 2.0, z: 3.0 }, orientation: rotation.into() },
                covariance: std::array::from_fn(|row| std::array::from_fn(|column| (row + column) as f64)),
            },
        };
        let transform = Pose::from_quaternion(&rotation, Vector3::new(1.0, 2.0, 3.0)).into();
        let tf =
            TfMessage { transforms: vec![TransformStamped { header, child_frame_id: "tool".into(), transform }; 2] };
        for endianness in [Endianness::Big, Endianness::Little] {
            let bytes = cdr::encode(&cloud, endianness).unwrap();
            assert_eq!(cdr::decode::<PointCloud2>(&bytes).unwrap(), cloud);
            assert!(matches!(cdr::decode::<PointCloud2>(&bytes).unwrap().data, Cow::Borrowed(_)));
            let bytes = cdr::encode(&wrench, endianness).unwrap();
            assert_eq!(cdr::decode::<WrenchStamped>(&bytes).unwrap(), wrench);
            let bytes = cdr::encode(&pose, endianness).unwrap();
            assert_eq!(cdr::decode::<PoseWithCovarianceStamped>(&bytes).unwrap(), pose);
            let bytes = cdr::encode(&tf, endianness).unwrap();
            assert_eq!(cdr::decode::<TfMessage>(&bytes).unwrap(), tf);
        }
    }

    #[test]
    fn stamps_before_zero_convert_both_ways() {
        for nanoseconds in [-1, 0, 1, -2_500_000_001, 1_700_000_000_123_456_789] {
            assert_eq!(Stamp::from(Time::from(Stamp(nanoseconds))), Stamp(nanoseconds));
        }
    }
}
