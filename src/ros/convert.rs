//! From what the core says to messages. Nothing that is not finite gets into one.

use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use ros2_interfaces_jazzy_serde::{
    builtin_interfaces::msg::Time,
    geometry_msgs::msg::{
        Point, Pose as PoseMessage, Quaternion as QuaternionMessage, Transform, Vector3 as Vector3Message,
    },
    std_msgs::msg::Header,
};
use serde::Serialize;

use super::messages;
use crate::{
    io::{
        cdr::{self, Endianness},
        counters::{ByReason, Counters},
        messages::Time as StampMessage,
    },
    math::{Pose, orthonormal_pair},
    pipeline::Output,
    types::{
        Label, Stamp,
        finite::{NotFinite, check_finite},
        posterior::{
            Criticism, EdgePosterior, EffectPosterior, InformedBy, ObjectPosterior, PartPosterior, Quantity,
            ResidualScore, Verdict, WindowRecord,
        },
    },
};

/// Every message stays below this \[bytes\]: Fast DDS as it comes loses larger ones.
pub const MOST_BYTES: usize = 100_000;
/// Alignment that an element's place in a sequence may add \[bytes\].
const PADDING: usize = 8;

/// What messages are about: the frame that all is in, and when the stream began.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct FixedFrame {
    /// Its name, as `world`.
    pub name: String,
    /// Time zero.
    pub zero: Stamp,
}

impl FixedFrame {
    /// A header in this frame.
    pub fn header(&self, stamp: Stamp) -> Header {
        Header { stamp: time(stamp), frame_id: self.name.clone() }
    }

    /// The stamp of a time since zero \[s\].
    fn time_at(&self, time_s: f64) -> Time {
        time(self.zero.plus_seconds(time_s))
    }
}

/// One part at one time ahead.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartPrediction {
    /// The part.
    pub label: Label,
    /// How far ahead \[s\].
    pub horizon_s: f64,
    /// D, since the first frame.
    pub displacement: Pose,
    /// The part's centre of mass c at the first frame \[m\].
    pub center_in_world: Vector3<f64>,
    /// Covariance of D·c \[m²\].
    pub covariance_m2: Matrix3<f64>,
    /// Position of its joint in the description \[m or rad\]; `None` where it has none that moves, or floats.
    pub joint_position: Option<f64>,
}

impl PartPrediction {
    /// What the pipeline predicts of a part, with its centre of mass \[m\]; of its joint nothing is said yet.
    /// `None` of any other output.
    pub fn of(output: &Output, center_in_world: Vector3<f64>) -> Option<Self> {
        let Output::Prediction { horizon_s, label, displacement, covariance_m2, .. } = *output else { return None };
        Some(Self { label, horizon_s, displacement, center_in_world, covariance_m2, joint_position: None })
    }
}

/// Where the wrench to come is from.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FutureWrench {
    /// The last reading goes on.
    Held,
    /// It was planned.
    Planned,
}

/// A stamp as ROS has it.
pub fn time(stamp: Stamp) -> Time {
    let StampMessage { sec, nanosec } = stamp.into();
    Time { sec, nanosec }
}

/// A point \[m\].
pub fn point(p: &Vector3<f64>) -> Point {
    Point { x: p.x, y: p.y, z: p.z }
}

/// A vector.
pub fn vector(v: &Vector3<f64>) -> Vector3Message {
    Vector3Message { x: v.x, y: v.y, z: v.z }
}

fn quaternion(pose: &Pose) -> QuaternionMessage {
    let unit: UnitQuaternion<f64> = pose.quaternion();
    let Quaternion { coords } = *unit.quaternion();
    QuaternionMessage { x: coords.x, y: coords.y, z: coords.z, w: coords.w }
}

/// A rigid transform.
pub fn transform(pose: &Pose) -> Transform {
    Transform { translation: vector(&pose.translation), rotation: quaternion(pose) }
}

/// The same as a pose.
pub fn pose(pose: &Pose) -> PoseMessage {
    PoseMessage { position: point(&pose.translation), orientation: quaternion(pose) }
}

/// Bytes of a message on the wire; 0 for what cannot be encoded.
pub fn encoded_bytes<T: Serialize>(message: &T) -> usize {
    cdr::encode(message, Endianness::Little).map_or(0, |bytes| bytes.len())
}

/// `~/object_posterior`. Where it would be too large, the least probable edges are left out.
///
/// # Errors
/// A number that is not finite, by name.
pub fn object_posterior(
    posterior: &ObjectPosterior,
    counters: &Counters,
    frame: &FixedFrame,
    stamp: Stamp,
) -> Result<messages::ObjectPosterior, NotFinite> {
    let recent = posterior.windows.len().saturating_sub(messages::ObjectPosterior::MOST_RECENT_WINDOWS);
    let mut message = messages::ObjectPosterior {
        header: frame.header(stamp),
        time_zero: time(frame.zero),
        root_label: posterior.root_label.0,
        parts: posterior.parts.iter().map(part).collect(),
        edges: Vec::new(),
        edges_left_out: 0,
        windows_learned: posterior.windows.len() as u32,
        recent_windows: posterior.windows[recent..].iter().map(|window| window_record(window, frame)).collect(),
        counters: counter_list(counters),
    };
    let edges: Vec<messages::EdgePosterior> = posterior.edges.iter().map(edge).collect();
    let left = MOST_BYTES.saturating_sub(encoded_bytes(&message) + PADDING);
    message.edges = likeliest_that_fit(edges, left);
    message.edges_left_out = (posterior.edges.len() - message.edges.len()) as u32;
    check_finite(&message)?;
    Ok(message)
}

/// The likeliest edges that fit into so many bytes, in their old order.
fn likeliest_that_fit(edges: Vec<messages::EdgePosterior>, bytes: usize) -> Vec<messages::EdgePosterior> {
    let mut order: Vec<usize> = (0..edges.len()).collect();
    order.sort_by(|a, b| edges[*b].probability.total_cmp(&edges[*a].probability));
    let mut left = bytes;
    let mut keep = vec![false; edges.len()];
    for index in order {
        let Some(rest) = left.checked_sub(encoded_bytes(&edges[index]) + PADDING) else { break };
        left = rest;
        keep[index] = true;
    }
    edges.into_iter().zip(keep).filter_map(|(edge, keep)| keep.then_some(edge)).collect()
}

/// `~/criticism`.
///
/// # Errors
/// A number that is not finite, by name.
pub fn criticism(
    criticism: &Criticism,
    windows_learned: usize,
    frame: &FixedFrame,
    stamp: Stamp,
) -> Result<messages::Criticism, NotFinite> {
    let message = messages::Criticism {
        header: frame.header(stamp),
        verdict: match criticism.verdict {
            Verdict::Insufficient => messages::Criticism::VERDICT_INSUFFICIENT,
            Verdict::Adequate => messages::Criticism::VERDICT_ADEQUATE,
            Verdict::EffectFound => messages::Criticism::VERDICT_EFFECT_FOUND,
            Verdict::Unexplained => messages::Criticism::VERDICT_UNEXPLAINED,
        },
        windows_learned: windows_learned as u32,
        effects: criticism.effects.iter().map(effect).collect(),
        before: criticism.before.iter().map(residual_score).collect(),
        after: criticism.after.iter().map(residual_score).collect(),
    };
    check_finite(&message)?;
    Ok(message)
}

/// `~/predicted_poses`.
///
/// # Errors
/// A number that is not finite, by name.
pub fn predicted_part_poses(
    predictions: &[PartPrediction],
    future_wrench: FutureWrench,
    frame: &FixedFrame,
    stamp: Stamp,
) -> Result<messages::PredictedPartPoses, NotFinite> {
    let message = messages::PredictedPartPoses {
        header: frame.header(stamp),
        future_wrench: match future_wrench {
            FutureWrench::Held => messages::PredictedPartPoses::WRENCH_HELD,
            FutureWrench::Planned => messages::PredictedPartPoses::WRENCH_PLANNED,
        },
        poses: predicted_poses(predictions)?,
    };
    Ok(message)
}

/// Predictions by label, then time ahead; also for the answer of `~/predict`.
///
/// # Errors
/// A number that is not finite, by name.
pub fn predicted_poses(predictions: &[PartPrediction]) -> Result<Vec<messages::PredictedPartPose>, NotFinite> {
    let mut ordered: Vec<&PartPrediction> = predictions.iter().collect();
    ordered.sort_by(|a, b| a.label.cmp(&b.label).then(a.horizon_s.total_cmp(&b.horizon_s)));
    let poses: Vec<_> = ordered.into_iter().map(predicted_pose).collect();
    check_finite(&poses)?;
    Ok(poses)
}

fn predicted_pose(prediction: &PartPrediction) -> messages::PredictedPartPose {
    messages::PredictedPartPose {
        label: prediction.label.0,
        horizon: prediction.horizon_s,
        displacement: transform(&prediction.displacement),
        center: point(&prediction.displacement.transform_point(&prediction.center_in_world)),
        // Symmetric, so that rows and columns are the same.
        center_covariance: std::array::from_fn(|i| prediction.covariance_m2[i]),
        joint_position: prediction.joint_position.into_iter().collect(),
    }
}

fn quantity(quantity: &Quantity) -> messages::Quantity {
    messages::Quantity {
        unit: quantity.unit.clone(),
        median: quantity.median,
        mean: quantity.mean,
        std: quantity.std,
        q05: quantity.q05,
        q95: quantity.q95,
        informed_by: match quantity.informed_by {
            InformedBy::Prior => messages::Quantity::INFORMED_BY_PRIOR,
            InformedBy::Dynamics => messages::Quantity::INFORMED_BY_DYNAMICS,
        },
    }
}

fn part(part: &PartPosterior) -> messages::PartPosterior {
    messages::PartPosterior {
        label: part.label.0,
        com: point(&part.com_in_world_m.into()),
        com_covariance: std::array::from_fn(|i| part.com_covariance_m2[i / 3][i % 3]),
        mass: quantity(&part.mass_kg),
    }
}

fn edge(edge: &EdgePosterior) -> messages::EdgePosterior {
    let across = |direction: &[f64; 3]| {
        let (first, second) = orthonormal_pair(&Vector3::from(*direction));
        [vector(&first), vector(&second)]
    };
    let revolute = edge.revolute.iter().map(|axis| messages::RevoluteAxis {
        axis_direction: vector(&axis.axis_direction.into()),
        axis_point: point(&axis.axis_point_m.into()),
        across: across(&axis.axis_direction),
        covariance: std::array::from_fn(|i| axis.covariance[i / 4][i % 4]),
    });
    let prismatic = edge.prismatic.iter().map(|axis| messages::PrismaticAxis {
        axis_direction: vector(&axis.axis_direction.into()),
        across: across(&axis.axis_direction),
        covariance: std::array::from_fn(|i| axis.covariance[i / 2][i % 2]),
    });
    messages::EdgePosterior {
        parent: edge.parent.0,
        child: edge.child.0,
        probability: edge.probability,
        rigid_probability: edge.joint_type.rigid,
        prismatic_probability: edge.joint_type.prismatic,
        revolute_probability: edge.joint_type.revolute,
        revolute: revolute.collect(),
        prismatic: prismatic.collect(),
        damping: quantity(&edge.damping),
        friction: quantity(&edge.friction),
        joint_inertia: quantity(&edge.joint_inertia),
        lower_limit: edge.lower_limit.iter().map(quantity).collect(),
        upper_limit: edge.upper_limit.iter().map(quantity).collect(),
    }
}

fn window_record(window: &WindowRecord, frame: &FixedFrame) -> messages::WindowRecord {
    messages::WindowRecord {
        start: frame.time_at(window.t0_s),
        end: frame.time_at(window.t1_s),
        labels: window.labels.iter().map(|label| label.0).collect(),
        frames: window.frames as u32,
        steps: window.steps as u32,
        inference_wall: window.inference_wall_s,
        elbo: window.elbo.into_iter().collect(),
        log_predictive_density: window.log_predictive_density.into_iter().collect(),
    }
}

fn counter_list(counters: &Counters) -> Vec<messages::Counter> {
    let groups: [(&str, Option<u64>, &str, &ByReason); 6] = [
        ("clouds_in", Some(counters.clouds_in), "clouds_dropped", &counters.clouds_dropped),
        ("points_in", Some(counters.points_in), "points_dropped", &counters.points_dropped),
        ("wrenches_in", Some(counters.wrenches_in), "wrenches_dropped", &counters.wrenches_dropped),
        ("poses_in", Some(counters.poses_in), "poses_dropped", &counters.poses_dropped),
        ("tf_in", Some(counters.tf_in), "tf_dropped", &counters.tf_dropped),
        ("", None, "bag_damage", &counters.bag_damage),
    ];
    let mut list = Vec::new();
    for (name, total, dropped, reasons) in groups {
        list.extend(total.map(|count| messages::Counter { name: name.to_owned(), count }));
        let by_reason =
            |(reason, count): (&String, &u64)| messages::Counter { name: format!("{dropped}/{reason}"), count: *count };
        list.extend(reasons.iter().map(by_reason));
    }
    list
}

fn effect(effect: &EffectPosterior) -> messages::Effect {
    let parameter =
        |(name, value): (&String, &Quantity)| messages::EffectParameter { name: name.clone(), value: quantity(value) };
    messages::Effect {
        name: effect.name.clone(),
        label: effect.label.iter().map(|label| label.0).collect(),
        probability: effect.probability,
        indistinguishable_from: effect.indistinguishable_from.clone(),
        parameters: effect.parameters.iter().map(parameter).collect(),
    }
}

fn residual_score(score: &ResidualScore) -> messages::ResidualScore {
    messages::ResidualScore {
        label: score.label.0,
        scored_windows: score.scored_windows as u32,
        force_rmse: score.force_rmse_n.into_iter().collect(),
        torque_rmse: score.torque_rmse_nm.into_iter().collect(),
        position_rmse: score.position_rmse_m,
        rotation_rmse: score.rotation_rmse_rad,
        log_predictive_density: score.log_predictive_density,
        residual_whiteness_p: score.residual_whiteness_p,
    }
}
