//! `~/predict`: a wrench profile → the parts' trajectories with their spread.

use anyhow::{Context as _, bail, ensure};
use nalgebra::Vector3;
use ros2_interfaces_jazzy_serde::geometry_msgs::msg::Vector3 as VectorMessage;

use super::stream::Ground;
use crate::ros::messages::{PredictRequest, PredictResponse};
use crate::ros::{FixedFrame, PartPrediction, place_joints, predicted_poses};
use crate::tracking::Plan;
use crate::types::Label;

/// Samples unless the request says how many, and at most.
const SAMPLES: (u32, u32) = (32, 1000);
/// Time between poses unless the request says \[s\].
const INTERVAL_S: f64 = 0.1;
/// Longest span of an answer \[s\].
const LONGEST_S: f64 = 30.0;
/// Poses in an answer at most: it stays below 100 KB.
const MOST_POSES: usize = 480;

/// The answer to a request.
///
/// # Errors
/// A request that makes no sense, or acts on a part without a joint.
pub fn answer(ground: &Ground, request: &PredictRequest) -> anyhow::Result<PredictResponse> {
    let plan = plan(ground, request)?;
    let part = plan.part;
    let poses = ground.planner.predict(&plan).with_context(|| format!("part {part} has no joint that is known"))?;
    ensure!(
        poses.len() <= MOST_POSES,
        "{} poses, at most {MOST_POSES} fit into an answer: ask for a longer interval",
        poses.len()
    );
    let mut predictions: Vec<PartPrediction> = poses
        .iter()
        .filter_map(|pose| {
            Some(PartPrediction {
                label: pose.label,
                horizon_s: pose.time_s,
                displacement: pose.displacement,
                center_in_world: *ground.centers.get(&pose.label)?,
                covariance_m2: pose.covariance_m2,
                joint_position: None,
            })
        })
        .collect();
    ground.tree.iter().for_each(|tree| place_joints(tree, &mut predictions));
    let frame = FixedFrame { name: ground.fixed_frame.clone(), zero: ground.stamp };
    Ok(PredictResponse {
        success: true,
        message: String::new(),
        header: frame.header(ground.stamp),
        label: part.0,
        trajectory: predicted_poses(&predictions)?,
    })
}

fn plan(ground: &Ground, request: &PredictRequest) -> anyhow::Result<Plan> {
    let direction = |v: &VectorMessage| ground.world_from_frame.rotation * Vector3::new(v.x, v.y, v.z);
    let point = Vector3::new(request.point.x, request.point.y, request.point.z);
    ensure!(point.iter().all(|x| x.is_finite()), "point {:?}: not finite", point.as_slice());
    let point_in_world = ground.world_from_frame.transform_point(&point);
    let mut profile = Vec::with_capacity(request.profile.len() + 1);
    let mut time_s = 0.0;
    for segment in &request.profile {
        let (force, torque) = (direction(&segment.wrench.force), direction(&segment.wrench.torque));
        let finite = force.iter().chain(&torque).all(|x| x.is_finite());
        if !(segment.duration > 0.0 && segment.duration <= LONGEST_S && finite) {
            bail!(
                "a segment of {} s: expected above 0 and at most {LONGEST_S} s, and a finite wrench",
                segment.duration
            );
        }
        profile.push((time_s, force, torque));
        time_s += segment.duration;
    }
    profile.push((time_s, Vector3::zeros(), Vector3::zeros()));
    let span_s = if request.duration == 0.0 { time_s } else { request.duration };
    let interval_s = if request.interval == 0.0 { INTERVAL_S } else { request.interval };
    ensure!(span_s > 0.0 && span_s <= LONGEST_S, "duration {span_s} s: expected above 0 and at most {LONGEST_S} s");
    ensure!(interval_s >= 0.01 && interval_s <= span_s, "interval {interval_s} s: expected .01 s to the duration");
    let count = (span_s / interval_s + 1e-9).floor() as usize;
    let part = match request.label.first() {
        Some(label) => Label(*label),
        None => ground.planner.nearest(&point_in_world).context("no part is seen")?,
    };
    let samples = if request.samples == 0 { SAMPLES.0 } else { request.samples.min(SAMPLES.1) } as usize;
    let times_s = (1..=count).map(|step| step as f64 * interval_s).collect();
    Ok(Plan { part, point_in_world, profile, times_s, samples, seed: request.seed })
}
