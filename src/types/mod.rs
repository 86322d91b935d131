//! What flows between the layers: stamps, labels, clouds, wrenches, poses with information.

pub mod finite;
pub mod pairs;
pub mod posterior;

use std::fmt;

use nalgebra::{Matrix6, Vector3};
use serde::{Deserialize, Serialize};

use crate::math::Pose;

/// Nanoseconds of the stream's own clock (message header stamps).
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Stamp(pub i64);

impl Stamp {
    /// Seconds from `earlier` to this stamp, negative if this one is before it.
    pub fn seconds_since(self, earlier: Stamp) -> f64 {
        (self.0 - earlier.0) as f64 * 1e-9
    }

    /// This stamp, moved by a number of seconds.
    pub fn plus_seconds(self, seconds: f64) -> Stamp {
        Stamp(self.0 + (seconds * 1e9).round() as i64)
    }
}

/// A part's segmentation label.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Label(pub u32);

impl fmt::Display for Label {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        self.0.fmt(f)
    }
}

/// A point with the part it was segmented as.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LabelledPoint {
    /// Position in world \[m\].
    pub point_in_world: Vector3<f64>,
    /// The part.
    pub label: Label,
}

/// One segmented cloud: what one message of one camera (or of a fused stream) saw.
#[derive(Clone, Debug, PartialEq)]
pub struct SegmentedCloud {
    /// Capture time.
    pub stamp: Stamp,
    /// The stream it came from: distinct for every pair of topic and sensor frame, from 0.
    pub source: usize,
    /// Where the sensor stood, in world \[m\]; `None` for a fused cloud, given in the fixed frame.
    pub viewpoint_in_world: Option<Vector3<f64>>,
    /// The finite, labelled points.
    pub points: Vec<LabelledPoint>,
}

/// What the tool does to the object at one instant, in world.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AppliedWrench {
    /// Time of the reading.
    pub stamp: Stamp,
    /// Which wrench topic it came from, from 0.
    pub source: usize,
    /// The part it acts on, where the topic is bound to one; otherwise found by contact.
    pub part: Option<Label>,
    /// Whether a tool applies it, which moves with what it holds. If not, it acts on `part` whenever it
    /// is reported, as the torque of a motor does, and its point says nothing of the part's motion.
    pub tool: bool,
    /// Origin of the sensor's frame, in world \[m\].
    pub point_in_world: Vector3<f64>,
    /// Force on the object, in world \[N\].
    pub force_in_world: Vector3<f64>,
    /// Torque on the object about `point_in_world`, in world \[N·m\].
    pub torque_in_world: Vector3<f64>,
}

/// A part's pose from a topic that measures it directly, instead of clouds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MeasuredPose {
    /// When it was measured.
    pub stamp: Stamp,
    /// The part.
    pub label: Label,
    /// The measured frame in world.
    pub world_from_frame: Pose,
    /// Information (angular, linear), about the frame's origin, world axes; zero rows where a
    /// covariance is infinite (a position without orientation).
    pub information: Matrix6<f64>,
}

/// One message of the stream after reading: decoded, in world, in SI units.
#[derive(Clone, Debug, PartialEq)]
pub enum Input {
    /// What one camera saw.
    Cloud(SegmentedCloud),
    /// What a tool did.
    Wrench(AppliedWrench),
    /// Where a part was measured to be.
    Pose(Box<MeasuredPose>),
}

impl Input {
    /// When it was captured or measured, by the stream's own clock.
    pub fn stamp(&self) -> Stamp {
        match self {
            Input::Cloud(cloud) => cloud.stamp,
            Input::Wrench(wrench) => wrench.stamp,
            Input::Pose(pose) => pose.stamp,
        }
    }
}
