//! A tree of bodies: forward kinematics, mass matrix, bias forces, wrenches, in world coordinates.
//!
//! D_j = D_π(j) exp(S_j q_j), S_j(q) = Ad(D_π(j)) S_j (product of exponentials). M by the
//! composite-rigid-body algorithm, c + g by recursive Newton–Euler (Featherstone, "Rigid Body
//! Dynamics Algorithms", 2008, tables 6.2 and 5.1), all in world, so that no transforms are needed.
//! Bodies attached rigidly are lumped into what carries them when the tree is built.

use nalgebra::{DMatrix, Matrix3, Vector3};
use thiserror::Error;

use super::inertia::{Spatial, SpatialInertia};
use super::joint::JointType;
use super::parameters::JointParameters;
use super::workspace::Workspace;
use crate::math::{Pose, Real, Screw};

/// One part, at the reference configuration, with the joint to its parent.
#[derive(Clone, Debug, PartialEq)]
pub struct Body<T: Real> {
    /// Index of the parent body; `None` for the world.
    pub parent: Option<usize>,
    /// How it is joined to it.
    pub joint: JointType,
    /// World-frame screw at the reference configuration; of unit length, zero pitch.
    pub screw: Screw<T>,
    /// Mass \[kg\].
    pub mass: T,
    /// Centre of mass in world \[m\].
    pub com_in_world: Vector3<T>,
    /// Rotational inertia about the centre of mass, world axes \[kg·m²\].
    pub inertia_about_com: Matrix3<T>,
    /// What the joint does by itself.
    pub parameters: JointParameters<T>,
}

impl<T: Real> Body<T> {
    /// A body fixed to its parent, of no mass.
    pub fn rigid(parent: Option<usize>) -> Self {
        Self {
            parent,
            joint: JointType::Rigid,
            screw: Screw::rigid(),
            mass: T::zero(),
            com_in_world: Vector3::zeros(),
            inertia_about_com: Matrix3::zeros(),
            parameters: JointParameters::default(),
        }
    }

    /// A body that slides along the unit vector `direction`, with its mass \[kg\] at the origin.
    pub fn prismatic(parent: Option<usize>, direction: &Vector3<T>, mass: T) -> Self {
        let screw = Screw::prismatic(direction);
        Self { joint: JointType::Prismatic, screw, mass, ..Self::rigid(parent) }
    }

    /// A body that turns about the unit vector `direction` through `point`, with `joint_inertia`
    /// \[kg·m²\] about that axis: a mass \[kg\] at `com_in_world` that gravity pulls at, and the
    /// rest as rotational inertia about the axis. All that a leaf's own joint can tell.
    pub fn revolute(
        parent: Option<usize>,
        direction: &Vector3<T>,
        point: &Vector3<T>,
        joint_inertia: T,
        mass: T,
        com_in_world: Vector3<T>,
    ) -> Self {
        let arm = direction.cross(&(com_in_world - point));
        let about_com = joint_inertia - mass * arm.norm_squared();
        Self {
            joint: JointType::Revolute,
            screw: Screw::revolute(direction, point),
            mass,
            com_in_world,
            inertia_about_com: direction * direction.transpose() * about_com,
            ..Self::rigid(parent)
        }
    }
}

/// Why bodies do not make a tree.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum TreeError {
    /// A parent index beyond the bodies.
    #[error("body {body}: parent {parent}, but there are {count} bodies")]
    NoSuchParent {
        /// The body.
        body: usize,
        /// Its parent.
        parent: usize,
        /// How many bodies there are.
        count: usize,
    },
    /// A body that is its own ancestor.
    #[error("body {body} is its own ancestor")]
    Cycle {
        /// The body.
        body: usize,
    },
}

/// Bodies and gravity, ready for dynamics.
#[derive(Clone, Debug)]
pub struct Tree<T: Real> {
    bodies: Vec<Body<T>>,
    gravity: Vector3<f64>,
    /// Bodies with a moving joint, parents first. "Joint k" below is `moving[k]`'s.
    pub(super) moving: Vec<usize>,
    /// Per joint, the next joint towards the root.
    pub(super) parents: Vec<Option<usize>>,
    /// Per body, the joint that it moves with.
    pub(super) carriers: Vec<Option<usize>>,
    /// Per joint, what moves with it and with no later one, at the reference configuration.
    pub(super) lumped: Vec<SpatialInertia<T>>,
}

impl<T: Real> Tree<T> {
    /// Puts the bodies in order under `gravity` \[m/s²\], world frame.
    pub fn new(bodies: Vec<Body<T>>, gravity: Vector3<f64>) -> Result<Self, TreeError> {
        let count = bodies.len();
        let mut tree = Self {
            gravity,
            moving: Vec::with_capacity(count),
            parents: Vec::with_capacity(count),
            carriers: vec![None; count],
            lumped: Vec::with_capacity(count),
            bodies,
        };
        let mut placed = vec![false; count];
        let mut left = count;
        while left > 0 {
            let before = left;
            for body in 0..count {
                let parent = tree.bodies[body].parent;
                if let Some(parent) = parent.filter(|&parent| parent >= count) {
                    return Err(TreeError::NoSuchParent { body, parent, count });
                }
                if !placed[body] && parent.is_none_or(|parent| placed[parent]) {
                    tree.place_body(body);
                    placed[body] = true;
                    left -= 1;
                }
            }
            if left == before {
                let body = placed.iter().position(|placed| !placed).unwrap_or_default();
                return Err(TreeError::Cycle { body });
            }
        }
        Ok(tree)
    }

    fn place_body(&mut self, body: usize) {
        let Body { parent, joint, mass, com_in_world, inertia_about_com, .. } = &self.bodies[body];
        let above = parent.and_then(|parent| self.carriers[parent]);
        let inertia = SpatialInertia::new(*mass, com_in_world, inertia_about_com);
        if joint.moves() {
            self.carriers[body] = Some(self.moving.len());
            self.moving.push(body);
            self.parents.push(above);
            self.lumped.push(inertia);
        } else {
            self.carriers[body] = above;
            if let Some(above) = above {
                self.lumped[above] += inertia;
            }
        }
    }

    /// The bodies, as given.
    pub fn bodies(&self) -> &[Body<T>] {
        &self.bodies
    }

    /// What the joint of a body does by itself, to change it.
    pub fn parameters_mut(&mut self, body: usize) -> &mut JointParameters<T> {
        &mut self.bodies[body].parameters
    }

    /// How many bodies there are: the length of every slice of positions or rates.
    pub fn body_count(&self) -> usize {
        self.bodies.len()
    }

    /// The bodies whose joint moves, parents first.
    pub fn moving_bodies(&self) -> &[usize] {
        &self.moving
    }

    /// Gravity \[m/s²\], world frame.
    pub fn gravity(&self) -> Vector3<f64> {
        self.gravity
    }

    /// Computes every displacement D and every S(q) at `positions`, into the workspace.
    pub fn update_kinematics(&self, positions: &[T], workspace: &mut Workspace<T>) {
        for (k, &body) in self.moving.iter().enumerate() {
            let Body { joint, screw, .. } = &self.bodies[body];
            let screw = Spatial::from(&screw.0);
            let own = joint_displacement(*joint, &screw, positions[body]);
            let (pose, screw) = match self.parents[k] {
                Some(parent) => {
                    let above = workspace.poses[parent];
                    (above * own, screw.carried_by(&above))
                }
                None => (own, screw),
            };
            workspace.poses[k] = pose;
            workspace.screws[k] = screw;
            workspace.inertias[k] = self.lumped[k].carried_by(&pose);
        }
    }

    /// M(q), among the moving joints, from the kinematics in the workspace.
    pub fn update_mass_matrix(&self, workspace: &mut Workspace<T>) {
        let n = self.moving.len();
        let Workspace { screws, inertias, composites, mass_matrix, .. } = workspace;
        composites.copy_from_slice(inertias);
        mass_matrix.fill(T::zero());
        for k in (0..n).rev() {
            let momentum = composites[k].momentum(&screws[k]);
            mass_matrix[k * n + k] = screws[k].dot(&momentum) + self.bodies[self.moving[k]].parameters.armature();
            let mut ancestor = self.parents[k];
            if let Some(parent) = ancestor {
                let composite = composites[k];
                composites[parent] += composite;
            }
            while let Some(i) = ancestor {
                let entry = screws[i].dot(&momentum);
                mass_matrix[i * n + k] = entry;
                mass_matrix[k * n + i] = entry;
                ancestor = self.parents[i];
            }
        }
    }

    /// c(q, q̇) + g(q) among the moving joints, from the kinematics in the workspace; `rates` one
    /// per moving joint.
    pub(super) fn update_bias(&self, rates: &[T], workspace: &mut Workspace<T>) {
        let Workspace { screws, inertias, twists, accelerations, forces, bias, .. } = workspace;
        let upward = self.upward();
        for k in 0..self.moving.len() {
            let (twist, acceleration) = match self.parents[k] {
                Some(parent) => (twists[parent], accelerations[parent]),
                None => (Spatial::zero(), upward),
            };
            let own = screws[k] * rates[k];
            twists[k] = twist + own;
            accelerations[k] = acceleration + twist.cross_motion(&own);
            forces[k] =
                inertias[k].momentum(&accelerations[k]) + twists[k].cross_force(&inertias[k].momentum(&twists[k]));
        }
        for k in (0..self.moving.len()).rev() {
            bias[k] = screws[k].dot(&forces[k]);
            if let Some(parent) = self.parents[k] {
                let force = forces[k];
                forces[parent] += force;
            }
        }
    }

    /// The acceleration that stands for gravity.
    pub(super) fn upward(&self) -> Spatial<T> {
        Spatial { angular: Vector3::zeros(), linear: self.gravity.map(|g| T::constant(-g)) }
    }

    /// Adds a world wrench on `body` to the generalized forces: τ_j += S_j(q)ᵀ w for every moving
    /// ancestor j, from the kinematics in the workspace; `forces` one per moving joint.
    pub(super) fn project_wrench(&self, body: usize, wrench: &Spatial<T>, screws: &[Spatial<T>], forces: &mut [T]) {
        let mut joint = self.carriers[body];
        while let Some(k) = joint {
            forces[k] += screws[k].dot(wrench);
            joint = self.parents[k];
        }
    }

    /// D of a body, from the kinematics in the workspace.
    pub fn displacement(&self, body: usize, workspace: &Workspace<T>) -> Pose<T> {
        self.carriers[body].map_or_else(Pose::identity, |k| workspace.poses[k])
    }

    /// D of every body at `positions`.
    pub fn displacements(&self, positions: &[T]) -> Vec<Pose<T>> {
        let mut workspace = Workspace::new(self);
        self.update_kinematics(positions, &mut workspace);
        (0..self.body_count()).map(|body| self.displacement(body, &workspace)).collect()
    }

    /// S(q) of every body's joint at `positions`; zero for a rigid one.
    pub fn screws(&self, positions: &[T]) -> Vec<Spatial<T>> {
        let mut workspace = Workspace::new(self);
        self.update_kinematics(positions, &mut workspace);
        self.screws_in(&workspace)
    }

    fn screws_in(&self, workspace: &Workspace<T>) -> Vec<Spatial<T>> {
        let mut screws = vec![Spatial::zero(); self.body_count()];
        for (k, &body) in self.moving.iter().enumerate() {
            screws[body] = workspace.screws[k];
        }
        screws
    }

    /// M(q), one row per body; rows of rigid joints are zero.
    pub fn mass_matrix(&self, positions: &[T]) -> DMatrix<T> {
        self.screws_and_mass_matrix(positions, &mut Workspace::new(self)).1
    }

    /// [`Self::screws`] and [`Self::mass_matrix`] in a workspace of this tree's size.
    pub fn screws_and_mass_matrix(
        &self,
        positions: &[T],
        workspace: &mut Workspace<T>,
    ) -> (Vec<Spatial<T>>, DMatrix<T>) {
        self.update_kinematics(positions, workspace);
        self.update_mass_matrix(workspace);
        let n = self.moving.len();
        let mut matrix = DMatrix::zeros(self.body_count(), self.body_count());
        for (i, &row) in self.moving.iter().enumerate() {
            for (j, &column) in self.moving.iter().enumerate() {
                matrix[(row, column)] = workspace.mass_matrix[i * n + j];
            }
        }
        (self.screws_in(workspace), matrix)
    }

    /// c(q, q̇) + g(q), one per body: the generalized forces that keep the rates as they are.
    pub fn bias_forces(&self, positions: &[T], rates: &[T]) -> Vec<T> {
        let mut workspace = Workspace::new(self);
        self.update_kinematics(positions, &mut workspace);
        let rates: Vec<T> = self.moving.iter().map(|&body| rates[body]).collect();
        self.update_bias(&rates, &mut workspace);
        let mut bias = vec![T::zero(); self.body_count()];
        for (k, &body) in self.moving.iter().enumerate() {
            bias[body] = workspace.bias[k];
        }
        bias
    }

    /// The diagonal entry of M at the reference configuration, the whole subtree carried
    /// \[kg or kg·m²\].
    pub fn joint_inertia(&self, body: usize) -> T {
        self.mass_matrix(&vec![T::zero(); self.body_count()])[(body, body)]
    }

    /// Potential energy in gravity of all that moves \[J\].
    pub fn potential_energy(&self, positions: &[T]) -> T {
        let mut workspace = Workspace::new(self);
        self.update_kinematics(positions, &mut workspace);
        let gravity = self.gravity.map(T::constant);
        workspace.inertias.iter().fold(T::zero(), |sum, body| sum - body.first_moment.dot(&gravity))
    }
}

/// exp(S q), cheaper for the two zero-pitch screws than the general exponential.
pub(super) fn joint_displacement<T: Real>(joint: JointType, screw: &Spatial<T>, q: T) -> Pose<T> {
    match joint {
        JointType::Rigid => Pose::identity(),
        JointType::Prismatic => Pose::from_translation(screw.linear * q),
        JointType::Revolute => {
            let axis = screw.angular;
            let (sin, cos) = q.sin_cos();
            let turned = axis * axis.transpose() * (T::one() - cos);
            let s = axis * sin;
            let rotation = Matrix3::new(
                turned[(0, 0)] + cos,
                turned[(0, 1)] - s.z,
                turned[(0, 2)] + s.y,
                turned[(1, 0)] + s.z,
                turned[(1, 1)] + cos,
                turned[(1, 2)] - s.x,
                turned[(2, 0)] - s.y,
                turned[(2, 1)] + s.x,
                turned[(2, 2)] + cos,
            );
            let point = axis.cross(&screw.linear);
            Pose { rotation, translation: point - rotation * point }
        }
    }
}
