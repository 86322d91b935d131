//! The likeliest tree with its posterior, as the filter and the prediction need it.

use std::collections::BTreeMap;
use std::fmt;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Vector3};

use crate::math::{Pose, skew};
use crate::mechanism::effects::{AttachedEffect, EffectKind};
use crate::mechanism::{JointType, Tree};
use crate::model::{DynamicsLearner, KinematicFit, KinematicJoint, SensorError};
use crate::types::Label;

/// A number of the dynamics that the filter may move.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct ActiveNumber {
    /// Whose joint it is of.
    pub joint: usize,
    /// Its place among all numbers.
    pub place: usize,
}

/// Trees by their dynamic numbers.
#[derive(Clone)]
pub struct TreeFamily(Arc<dyn Fn(&DVector<f64>) -> Option<Tree<f64>> + Send + Sync>);

impl TreeFamily {
    /// The trees that `tree` makes.
    pub fn new(tree: impl Fn(&DVector<f64>) -> Option<Tree<f64>> + Send + Sync + 'static) -> Self {
        Self(Arc::new(tree))
    }

    /// The tree of these numbers, each joint with a disturbance of zero; see [`set_disturbance`].
    pub(super) fn tree(&self, numbers: &DVector<f64>) -> Option<Tree<f64>> {
        let mut tree = (self.0)(numbers)?;
        for body in 0..tree.body_count() {
            tree.parameters_mut(body).effects.push(AttachedEffect::new(EffectKind::GravityOffset, &[0.0]));
        }
        Some(tree)
    }
}

/// Sets the unexplained force on each joint \[N or N·m\], of a tree of a [`TreeFamily`].
pub(super) fn set_disturbance(tree: &mut Tree<f64>, forces: &[f64]) {
    for (body, force) in forces.iter().enumerate() {
        if let Some(effect) = tree.parameters_mut(body).effects.last_mut() {
            effect.parameters[0] = *force;
        }
    }
}

impl fmt::Debug for TreeFamily {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("TreeFamily")
    }
}

/// The joints of the likeliest tree with what is believed of them.
#[derive(Clone, Debug)]
pub struct TrackedMechanism {
    /// Parents first; body k of the tree is the child of joint k.
    pub joints: Vec<KinematicJoint>,
    /// The trees by their numbers.
    pub trees: TreeFamily,
    /// The posterior's mean of all numbers.
    pub numbers: DVector<f64>,
    /// Those that the equations of motion hold ...
    pub active: Vec<ActiveNumber>,
    /// ... and their covariance.
    pub covariance: DMatrix<f64>,
    /// The tree at the posterior's mean.
    pub tree: Tree<f64>,
    /// Root of the covariance of each joint's axis: two directions \[rad\], then two positions \[m\].
    pub axis_roots: Vec<DMatrix<f64>>,
    /// Centre of mass of each child at the reference configuration \[m\].
    pub centers: Vec<Vector3<f64>>,
    /// Least and greatest position that each joint was seen at \[m or rad\].
    pub explored: Vec<[f64; 2]>,
    /// What the reported tool position is away from the contact \[m\], world axes.
    pub tool_offset: Vector3<f64>,
    /// Process noise in units of what the wrench sensor explains.
    pub noise_scale: f64,
    /// What is wrong with the reported wrench.
    pub sensor: SensorError<f64>,
    /// By joint, how large a force may be that was seen and has no name \[N or N·m\].
    pub unexplained: Vec<f64>,
}

/// A body as the tool would have carried it along its joint.
#[derive(Clone, Copy, Debug)]
pub struct Carried {
    /// Of its joint \[m or rad\].
    pub position: f64,
    /// The body's, in world.
    pub displacement: Pose,
    /// How far from the tool the point that it held is even so \[m\].
    pub miss_m: f64,
}

/// Newton steps along a joint.
const CARRY_STEPS: usize = 4;

impl TrackedMechanism {
    /// From the last kinematic fit and the dynamics learned along with it; `None` where the dynamics
    /// are not known for these joints. `noise_scale` as inferred from the windows.
    pub fn new(fit: &KinematicFit, dynamics: &DynamicsLearner, noise_scale: f64) -> Option<Self> {
        let posterior = dynamics.posterior().ok()?;
        let centers: BTreeMap<Label, Vector3<f64>> =
            posterior.parts.iter().map(|part| (part.label, part.com_in_world)).collect();
        let centers: Vec<Vector3<f64>> =
            fit.joints.iter().map(|joint| centers.get(&joint.child).copied()).collect::<Option<_>>()?;
        let trees = TreeFamily::new(dynamics.trees());
        let numbers = dynamics.along_published_axes(posterior.mean);
        let tree = trees.tree(&numbers)?;
        if tree.body_count() != fit.joints.len() {
            return None;
        }
        // As they are published.
        let turn_of = |label: Label| posterior.joints.iter().find(|joint| joint.label == label)?.turn;
        let joints = fit.joints.iter().map(|joint| match turn_of(joint.child) {
            Some((turn, _)) => KinematicJoint { axis: joint.axis.turned(&turn), ..*joint },
            None => *joint,
        });
        let joints: Vec<KinematicJoint> = joints.collect();
        let active: Vec<ActiveNumber> =
            dynamics.active_numbers().into_iter().map(|(joint, place)| ActiveNumber { joint, place }).collect();
        let covariance = DMatrix::from_fn(active.len(), active.len(), |i, j| {
            posterior.covariance[(active[i].place, active[j].place)]
        });
        let axis_roots = (0..fit.joints.len())
            .map(|joint| {
                let (start, count) = (fit.axis_offset(joint), fit.joints[joint].axis_parameters());
                let block = fit.covariance.view((start, start), (count, count)).into_owned();
                block.cholesky().map_or_else(|| DMatrix::zeros(count, count), |root| root.unpack())
            })
            .collect();
        let explored = (0..fit.joints.len())
            .map(|joint| {
                let seen = fit.positions.iter().flat_map(|window| window.get(joint).into_iter().flatten());
                seen.fold([0.0, 0.0], |[low, high]: [f64; 2], &q| [low.min(q), high.max(q)])
            })
            .collect();
        Some(Self {
            joints,
            trees,
            sensor: dynamics.sensor_error(&numbers),
            unexplained: dynamics.unexplained_forces(&numbers),
            numbers,
            active,
            covariance,
            tree,
            axis_roots,
            centers,
            explored,
            tool_offset: fit.tool_offset,
            noise_scale: noise_scale.max(1.0),
        })
    }

    /// The body of a part.
    pub fn body(&self, label: Label) -> Option<usize> {
        self.joints.iter().position(|joint| joint.child == label)
    }

    /// The joints from a body to the world, the body's own first.
    pub fn chain(&self, body: usize) -> Vec<usize> {
        std::iter::successors(Some(body), |&joint| self.joints[joint].parent).collect()
    }

    /// Where a body's own joint goes, from `positions`, if it carries the tool from one position to another in
    /// world \[m\].
    pub fn carry(&self, positions: &[f64], body: usize, from: &Vector3<f64>, to: &Vector3<f64>) -> Carried {
        let start = self.tree.displacements(positions)[body];
        let joint = &self.joints[body];
        let above = start * joint.screw().displacement(positions[body]).inverse();
        let point = start.inverse().transform_point(&(from - self.tool_offset));
        let place = |q: f64| above * joint.screw().displacement(q);
        let miss = |q: f64| to - self.tool_offset - place(q).transform_point(&point);
        let mut position = positions[body];
        // By Newton's method, on a slide in one step.
        for _ in 0..CARRY_STEPS {
            let lacks = miss(position);
            let step = 1e-5 / self.reach(body);
            let slope = (lacks - miss(position + step)) / step;
            position += slope.dot(&lacks) / slope.norm_squared().max(1e-9);
        }
        Carried { position, displacement: place(position), miss_m: miss(position).norm() }
    }

    /// Motion of a part's points by its joint's unit: 1 on a slide, metres on a hinge.
    pub fn reach(&self, joint: usize) -> f64 {
        let joint = &self.joints[joint];
        match joint.joint_type {
            JointType::Revolute => {
                let across = skew(&joint.axis.direction) * (joint.center - joint.axis.point);
                across.norm().hypot(joint.radius).max(0.05)
            }
            _ => 1.0,
        }
    }
}
