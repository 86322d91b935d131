//! A checked message in its own frame, and its passage into world.

use nalgebra::Vector3;

use super::{
    config::InputConfig,
    messages::{PoseWithCovariance, Wrench},
    point_cloud::SensorPoint,
    pose_information::information_in_world,
};
use crate::{
    math::Pose,
    types::{AppliedWrench, Input, Label, LabelledPoint, MeasuredPose, SegmentedCloud, Stamp},
};

/// Why a message is dropped: a short name for counting, and the line that says it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Rejection {
    pub stamp: Option<Stamp>,
    pub kind: &'static str,
    pub reason: String,
}

impl Rejection {
    pub fn new(stamp: Option<Stamp>, kind: &'static str, reason: String) -> Self {
        Self { stamp, kind, reason }
    }
}

/// A message that waits for the transform of its frame.
#[derive(Debug)]
pub(super) struct WaitingMessage {
    pub stamp: Stamp,
    pub frame: String,
    pub content: Content,
}

/// What a message says, in its own frame.
#[derive(Debug)]
pub(super) enum Content {
    Cloud { source: usize, points: Vec<SensorPoint> },
    Wrench { source: usize, part: Option<Label>, tool: bool, force: Vector3<f64>, torque: Vector3<f64> },
    Pose { label: Label, header_from_frame: Pose, covariance: Box<[[f64; 6]; 6]> },
}

impl Content {
    /// What a tool does to the object, by the wrench topic of this index, whatever the sensor's sign.
    pub fn wrench(wrench: &Wrench, source: usize, config: &InputConfig, stamp: Stamp) -> Result<Self, Rejection> {
        let topic = config.wrenches.get(source);
        let sign = if topic.is_some_and(|topic| topic.reaction) { -1.0 } else { 1.0 };
        let part = topic.and_then(|topic| topic.part.label());
        Self::signed_wrench(wrench, sign, (source, part, true), stamp)
    }

    /// What acts on a part, by its own topic.
    pub fn part_wrench(wrench: &Wrench, label: Label, config: &InputConfig, stamp: Stamp) -> Result<Self, Rejection> {
        let source = config.wrenches.len() + label.0 as usize;
        Self::signed_wrench(wrench, 1.0, (source, Some(label), false), stamp)
    }

    fn signed_wrench(
        wrench: &Wrench,
        sign: f64,
        (source, part, tool): (usize, Option<Label>, bool),
        stamp: Stamp,
    ) -> Result<Self, Rejection> {
        let force = Vector3::from(wrench.force) * sign;
        let torque = Vector3::from(wrench.torque) * sign;
        if !force.iter().chain(&torque).all(|component| component.is_finite()) {
            let reason = format!("force {:?}, torque {:?}: not finite", force.as_slice(), torque.as_slice());
            return Err(Rejection::new(Some(stamp), "not_finite", reason));
        }
        Ok(Self::Wrench { source, part, tool, force, torque })
    }

    /// A pose; without a rotation if its covariance says that none was measured.
    pub fn pose(
        message: &PoseWithCovariance,
        label: Label,
        config: &InputConfig,
        stamp: Stamp,
    ) -> Result<Self, Rejection> {
        let position = Vector3::from(message.pose.position);
        if !position.iter().all(|coordinate| coordinate.is_finite()) {
            let reason = format!("position {:?}: not finite", position.as_slice());
            return Err(Rejection::new(Some(stamp), "not_finite", reason));
        }
        let information = information(&message.covariance, &Pose::identity(), config, stamp)?;
        let rotation_is_measured = information.fixed_view::<3, 3>(0, 0).amax() > 0.0;
        let raw = message.pose.orientation;
        let header_from_frame = match raw.unit() {
            Some(rotation) => Pose::from_quaternion(&rotation, position),
            None if !rotation_is_measured => Pose::from_translation(position),
            None => {
                let reason = format!("quaternion of norm {}, need 1", raw.norm());
                return Err(Rejection::new(Some(stamp), "bad_quaternion", reason));
            }
        };
        Ok(Self::Pose { label, header_from_frame, covariance: Box::new(message.covariance) })
    }
}

impl WaitingMessage {
    /// The message in world. `is_fixed`: its frame is the fixed frame itself, so that for a cloud
    /// it is not known where the sensor stood.
    pub fn placed(self, world_from_frame: &Pose, is_fixed: bool, config: &InputConfig) -> Result<Input, Rejection> {
        let stamp = self.stamp;
        Ok(match self.content {
            Content::Cloud { source, points } => Input::Cloud(SegmentedCloud {
                stamp,
                source,
                viewpoint_in_world: (!is_fixed).then_some(world_from_frame.translation),
                points: points.iter().map(|point| in_world(point, world_from_frame)).collect(),
            }),
            Content::Wrench { source, part, tool, force, torque } => Input::Wrench(AppliedWrench {
                stamp,
                source,
                part,
                tool,
                point_in_world: world_from_frame.translation,
                force_in_world: world_from_frame.rotation * force,
                torque_in_world: world_from_frame.rotation * torque,
            }),
            Content::Pose { label, header_from_frame, covariance } => Input::Pose(Box::new(MeasuredPose {
                stamp,
                label,
                world_from_frame: *world_from_frame * header_from_frame,
                information: information(&covariance, world_from_frame, config, stamp)?,
            })),
        })
    }
}

fn in_world(point: &SensorPoint, world_from_sensor: &Pose) -> LabelledPoint {
    LabelledPoint { point_in_world: world_from_sensor.transform_point(&point.point_in_sensor), label: point.label }
}

fn information(
    covariance: &[[f64; 6]; 6],
    world_from_header: &Pose,
    config: &InputConfig,
    stamp: Stamp,
) -> Result<nalgebra::Matrix6<f64>, Rejection> {
    let default_std = (config.default_pose_std.rotation_rad, config.default_pose_std.position_m);
    information_in_world(covariance, &world_from_header.rotation, default_std)
        .map_err(|error| Rejection::new(Some(stamp), "bad_covariance", error.to_string()))
}
