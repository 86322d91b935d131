//! What is asked before it is done: plans in world, answered beside the stream by what it knows now.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::{Frame, Pipeline};
use crate::math::Pose;
use crate::tracking::{Filter, FreePart, Plan, PlannedPose};
use crate::types::Label;

/// The stream's knowledge at one time, for any number of plans.
pub struct Planner {
    pub(super) filter: Filter,
    /// Parts, where they are by what is known without joints.
    pub(super) places: BTreeMap<Label, FreePart>,
    /// The last frame.
    pub(super) frame: Frame,
    pub(super) world_from_work: Pose,
}

impl Pipeline {
    /// What plans are answered from; `None` until a joint is learned, or without predictions.
    pub fn planner(&self) -> Option<Planner> {
        let (filter, places, frame) = self.backlog.as_ref()?.forecaster.as_ref()?.knowledge()?;
        Some(Planner { filter, places, frame, world_from_work: self.world_from_work() })
    }
}

impl Planner {
    /// Now, in seconds since time zero.
    pub fn time_s(&self) -> f64 {
        self.filter.time_s()
    }

    /// The part whose surface is nearest to a point in world.
    pub fn nearest(&self, point_in_world: &Vector3<f64>) -> Option<Label> {
        Some(self.frame.nearest(&self.world_from_work.inverse().transform_point(point_in_world))?.0)
    }

    /// Every part at the times of a plan, all in world; `None` if it acts on a part without a joint.
    pub fn predict(&self, plan: &Plan) -> Option<Vec<PlannedPose>> {
        let work_from_world = self.world_from_work.inverse();
        let turned = |v: &Vector3<f64>| work_from_world.rotation * v;
        let carried = Plan {
            point_in_world: work_from_world.transform_point(&plan.point_in_world),
            profile: plan.profile.iter().map(|(t, force, torque)| (*t, turned(force), turned(torque))).collect(),
            ..plan.clone()
        };
        let mut poses = self.filter.under(&carried)?;
        let jointed: Vec<Label> = poses.iter().map(|pose| pose.label).collect();
        for (label, place) in self.places.iter().filter(|(label, _)| !jointed.contains(label)) {
            let stays = FreePart::resting(place.displacement);
            poses.extend(plan.times_s.iter().map(|&time_s| {
                let (displacement, covariance_m2) = stays.after(time_s);
                PlannedPose { label: *label, time_s, displacement, covariance_m2 }
            }));
        }
        let rotation = self.world_from_work.rotation;
        for pose in &mut poses {
            pose.displacement = self.world_from_work * pose.displacement * work_from_world;
            pose.covariance_m2 = rotation * pose.covariance_m2 * rotation.transpose();
        }
        Some(poses)
    }
}
