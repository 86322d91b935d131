//! Memory of the dynamics, kept between steps so that no step allocates.

use super::friction::Row;
use super::inertia::{Spatial, SpatialInertia};
use super::solve::SolveScratch;
use super::tree::Tree;
use crate::math::{Pose, Real};

/// Intermediate results for one tree; vectors have one entry per moving joint.
#[derive(Clone, Debug)]
pub struct Workspace<T: Real> {
    pub(super) poses: Vec<Pose<T>>,
    pub(super) screws: Vec<Spatial<T>>,
    pub(super) inertias: Vec<SpatialInertia<T>>,
    pub(super) composites: Vec<SpatialInertia<T>>,
    pub(super) twists: Vec<Spatial<T>>,
    pub(super) accelerations: Vec<Spatial<T>>,
    pub(super) forces: Vec<Spatial<T>>,
    pub(super) mass_matrix: Vec<T>,
    pub(super) bias: Vec<T>,
    pub(super) applied: Vec<T>,
    pub(super) rates: Vec<T>,
    pub(super) middle_rates: Vec<T>,
    pub(super) rows: Vec<Row<T>>,
    pub(super) solve: SolveScratch<T>,
    /// One entry per body.
    pub(super) middle: Vec<T>,
}

impl<T: Real> Workspace<T> {
    /// A workspace for `tree`, or for any with as many bodies and moving joints.
    pub fn new(tree: &Tree<T>) -> Self {
        let n = tree.moving_bodies().len();
        Self {
            poses: vec![Pose::identity(); n],
            screws: vec![Spatial::zero(); n],
            inertias: vec![SpatialInertia::zero(); n],
            composites: vec![SpatialInertia::zero(); n],
            twists: vec![Spatial::zero(); n],
            accelerations: vec![Spatial::zero(); n],
            forces: vec![Spatial::zero(); n],
            mass_matrix: vec![T::zero(); n * n],
            bias: vec![T::zero(); n],
            applied: vec![T::zero(); n],
            rates: vec![T::zero(); n],
            middle_rates: vec![T::zero(); n],
            rows: Vec::with_capacity(n),
            solve: SolveScratch::new(n),
            middle: vec![T::zero(); tree.body_count()],
        }
    }
}
