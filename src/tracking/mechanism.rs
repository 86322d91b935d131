//! The likeliest tree with its posterior, as the filter and the prediction need it.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, Vector3};

use crate::mechanism::Tree;
use crate::model::{DynamicsLearner, KinematicFit, KinematicJoint};
use crate::types::Label;

/// The joints of the likeliest tree with what is believed of them.
#[derive(Clone, Debug)]
pub struct TrackedMechanism {
    /// Parents first; body k of the tree is the child of joint k.
    pub joints: Vec<KinematicJoint>,
    /// The tree at the posterior's mean.
    pub tree: Tree<f64>,
    /// Trees one standard deviation away from it, by joint: directions whose outer products add up to
    /// the covariance of that joint's damping, friction and inertia.
    pub varied: Vec<Vec<Tree<f64>>>,
    /// Root of the covariance of each joint's axis: two directions \[rad\], then two positions \[m\].
    pub axis_roots: Vec<DMatrix<f64>>,
    /// Centre of mass of each child at the reference configuration \[m\].
    pub centers: Vec<Vector3<f64>>,
    /// What the reported tool position is away from the contact \[m\], world axes.
    pub tool_offset: Vector3<f64>,
    /// Process noise in units of what the wrench sensor explains.
    pub noise_scale: f64,
}

impl TrackedMechanism {
    /// From the last kinematic fit and the dynamics learned along with it; `None` where the dynamics
    /// are not known for these joints. `noise_scale` as inferred from the windows.
    pub fn new(fit: &KinematicFit, dynamics: &DynamicsLearner, noise_scale: f64) -> Option<Self> {
        let posterior = dynamics.posterior().ok()?;
        let centers: BTreeMap<Label, Vector3<f64>> =
            posterior.parts.iter().map(|part| (part.label, part.com_in_world)).collect();
        let centers: Vec<Vector3<f64>> =
            fit.joints.iter().map(|joint| centers.get(&joint.child).copied()).collect::<Option<_>>()?;
        let tree = dynamics.tree_at(&posterior.mean)?;
        if tree.body_count() != fit.joints.len() {
            return None;
        }
        let varied = (0..fit.joints.len())
            .map(|joint| {
                let directions = dynamics.force_directions(joint, &posterior);
                directions.iter().filter_map(|direction| dynamics.tree_at(&(&posterior.mean + direction))).collect()
            })
            .collect();
        let axis_roots = (0..fit.joints.len())
            .map(|joint| {
                let (start, count) = (fit.axis_offset(joint), fit.joints[joint].axis_parameters());
                let block = fit.covariance.view((start, start), (count, count)).into_owned();
                block.cholesky().map_or_else(|| DMatrix::zeros(count, count), |root| root.unpack())
            })
            .collect();
        Some(Self {
            joints: fit.joints.clone(),
            tree,
            varied,
            axis_roots,
            centers,
            tool_offset: fit.tool_offset,
            noise_scale: noise_scale.max(1.0),
        })
    }

    /// The same with no more than the declared physics; `None` if that makes no tree.
    pub fn without_effects(&self) -> Option<Self> {
        let mut bodies = self.tree.bodies().to_vec();
        bodies.iter_mut().for_each(|body| body.parameters.effects.clear());
        Some(Self { tree: Tree::new(bodies, self.tree.gravity()).ok()?, ..self.clone() })
    }

    /// The body of a part.
    pub fn body(&self, label: Label) -> Option<usize> {
        self.joints.iter().position(|joint| joint.child == label)
    }

    /// The joints from a body to the world, the body's own first.
    pub fn chain(&self, body: usize) -> Vec<usize> {
        std::iter::successors(Some(body), |&joint| self.joints[joint].parent).collect()
    }
}
