//! This package's own messages and services, and `bond`'s, as serde structs whose CDR is that of the ROS types.
//!
//! Field for field as in `msg/` and `srv/`, which say what each means, in which unit and frame;
//! `tests/messages.rs` holds the two together. A bounded sequence of at most one stands for what may
//! be missing.
#![allow(missing_docs, reason = "the fields are documented where they are defined: msg/ and srv/")]

use ros2_interfaces_jazzy_serde::{
    builtin_interfaces::msg::Time,
    geometry_msgs::msg::{Point, Transform, Vector3, Wrench},
    std_msgs::msg::Header,
};
use serde::{Deserialize, Serialize};

/// The ROS package that these are defined in.
pub const PACKAGE: &str = "bayesian_object_models";

/// bond/msg/Status.msg of bond_core: whether one side of a bond is there.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct BondStatus {
    pub header: Header,
    pub id: String,
    pub instance_id: String,
    pub active: bool,
    pub heartbeat_timeout: f32,
    pub heartbeat_period: f32,
}

/// msg/Quantity.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Quantity {
    pub unit: String,
    pub median: f64,
    pub mean: f64,
    pub std: f64,
    pub q05: f64,
    pub q95: f64,
    pub informed_by: u8,
}

impl Quantity {
    pub const INFORMED_BY_PRIOR: u8 = 0;
    pub const INFORMED_BY_DYNAMICS: u8 = 1;
}

/// msg/RevoluteAxis.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct RevoluteAxis {
    pub axis_direction: Vector3,
    pub axis_point: Point,
    pub across: [Vector3; 2],
    pub covariance: [f64; 16],
}

/// msg/PrismaticAxis.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PrismaticAxis {
    pub axis_direction: Vector3,
    pub across: [Vector3; 2],
    pub covariance: [f64; 4],
}

/// msg/EdgePosterior.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EdgePosterior {
    pub parent: u32,
    pub child: u32,
    pub probability: f64,
    pub rigid_probability: f64,
    pub prismatic_probability: f64,
    pub revolute_probability: f64,
    pub revolute: Vec<RevoluteAxis>,
    pub prismatic: Vec<PrismaticAxis>,
    pub damping: Quantity,
    pub friction: Quantity,
    pub joint_inertia: Quantity,
    pub lower_limit: Vec<Quantity>,
    pub upper_limit: Vec<Quantity>,
}

/// msg/PartPosterior.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PartPosterior {
    pub label: u32,
    pub com: Point,
    pub com_covariance: [f64; 9],
    pub mass: Quantity,
}

/// msg/WindowRecord.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WindowRecord {
    pub start: Time,
    pub end: Time,
    pub labels: Vec<u32>,
    pub frames: u32,
    pub steps: u32,
    pub inference_wall: f64,
    pub elbo: Vec<f64>,
    pub log_predictive_density: Vec<f64>,
}

/// msg/Counter.msg
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counter {
    pub name: String,
    pub count: u64,
}

/// msg/ObjectPosterior.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ObjectPosterior {
    pub header: Header,
    pub time_zero: Time,
    pub root_label: u32,
    pub parts: Vec<PartPosterior>,
    pub edges: Vec<EdgePosterior>,
    pub edges_left_out: u32,
    pub windows_learned: u32,
    pub recent_windows: Vec<WindowRecord>,
    pub counters: Vec<Counter>,
}

impl ObjectPosterior {
    /// The bound of `recent_windows`.
    pub const MOST_RECENT_WINDOWS: usize = 16;
}

/// msg/EffectParameter.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct EffectParameter {
    pub name: String,
    pub value: Quantity,
}

/// msg/Effect.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Effect {
    pub name: String,
    pub label: Vec<u32>,
    pub probability: f64,
    pub indistinguishable_from: Vec<String>,
    pub parameters: Vec<EffectParameter>,
}

/// msg/ResidualScore.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct ResidualScore {
    pub label: u32,
    pub scored_windows: u32,
    pub force_rmse: Vec<f64>,
    pub torque_rmse: Vec<f64>,
    pub position_rmse: f64,
    pub rotation_rmse: f64,
    pub log_predictive_density: f64,
    pub residual_whiteness_p: f64,
}

/// msg/Criticism.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Criticism {
    pub header: Header,
    pub verdict: u8,
    pub windows_learned: u32,
    pub effects: Vec<Effect>,
    pub before: Vec<ResidualScore>,
    pub after: Vec<ResidualScore>,
}

impl Criticism {
    pub const VERDICT_INSUFFICIENT: u8 = 0;
    pub const VERDICT_ADEQUATE: u8 = 1;
    pub const VERDICT_EFFECT_FOUND: u8 = 2;
    pub const VERDICT_UNEXPLAINED: u8 = 3;
}

/// msg/PredictedPartPose.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PredictedPartPose {
    pub label: u32,
    pub horizon: f64,
    pub displacement: Transform,
    pub center: Point,
    pub center_covariance: [f64; 9],
    pub joint_position: Vec<f64>,
}

/// msg/PredictedPartPoses.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PredictedPartPoses {
    pub header: Header,
    pub future_wrench: u8,
    pub poses: Vec<PredictedPartPose>,
}

impl PredictedPartPoses {
    pub const WRENCH_HELD: u8 = 0;
    pub const WRENCH_PLANNED: u8 = 1;
}

/// msg/WrenchSegment.msg
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WrenchSegment {
    pub duration: f64,
    pub wrench: Wrench,
}

/// srv/Predict.srv, what is asked
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PredictRequest {
    pub header: Header,
    pub label: Vec<u32>,
    pub point: Point,
    pub profile: Vec<WrenchSegment>,
    pub duration: f64,
    pub interval: f64,
    pub samples: u32,
    pub seed: u64,
}

/// srv/Predict.srv, what is answered
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct PredictResponse {
    pub success: bool,
    pub message: String,
    pub header: Header,
    pub label: u32,
    pub trajectory: Vec<PredictedPartPose>,
}

/// srv/SaveModel.srv, what is asked
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SaveModelRequest {
    pub path: String,
}

/// srv/SaveModel.srv, what is answered
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct SaveModelResponse {
    pub success: bool,
    pub message: String,
}

/// srv/LoadModel.srv, what is asked
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadModelRequest {
    pub path: String,
}

/// srv/LoadModel.srv, what is answered
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct LoadModelResponse {
    pub success: bool,
    pub message: String,
}
