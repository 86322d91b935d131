//! What a joint does by itself: damping, Coulomb friction, limits, effects.

use super::effects::{AttachedEffect, AttachedTable, JointState};
use super::friction::FrictionBounds;
use super::limits::Limit;
use crate::math::Real;

/// Parameters of one joint; units of a prismatic joint first, of a revolute one second.
#[derive(Clone, Debug, PartialEq)]
pub struct JointParameters<T: Real> {
    /// Viscous damping d: τ = −d q̇ \[N·s/m or N·m·s/rad\].
    pub damping: T,
    /// Coulomb friction F: λ ∈ [−F, F] against the motion \[N or N·m\].
    pub friction: T,
    /// The least position, if there is one \[m or rad\].
    pub lower: Option<Limit<T>>,
    /// The greatest position, if there is one \[m or rad\].
    pub upper: Option<Limit<T>>,
    /// Undeclared effects that act here.
    pub effects: Vec<AttachedEffect<T>>,
    /// What acts here and has no formula.
    pub tables: Vec<AttachedTable<T>>,
}

impl<T: Real> Default for JointParameters<T> {
    fn default() -> Self {
        Self::new(T::zero(), T::zero())
    }
}

/// The generalized forces of a joint in one state.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointForces<T: Real> {
    /// The force that does not depend on the rate to come \[N or N·m\].
    pub force: T,
    /// d in the force −d q̇, taken implicitly \[N·s/m or N·m·s/rad\].
    pub damping: T,
    /// The set that the friction force is in.
    pub friction: FrictionBounds<T>,
}

impl<T: Real> JointParameters<T> {
    /// Damping \[N·s/m or N·m·s/rad\] and Coulomb friction \[N or N·m\], and nothing else.
    pub fn new(damping: T, friction: T) -> Self {
        Self { damping, friction, lower: None, upper: None, effects: Vec::new(), tables: Vec::new() }
    }

    /// Inertia added to the diagonal of M, of nothing that the tree carries \[kg or kg·m²\].
    pub fn armature(&self) -> T {
        self.effects.iter().fold(T::zero(), |inertia, effect| inertia + effect.armature())
    }

    /// All that the joint does at this state.
    pub fn forces(&self, joint: &JointState<T>) -> JointForces<T> {
        let declared =
            JointForces { force: T::zero(), damping: self.damping, friction: FrictionBounds::symmetric(self.friction) };
        let named = self.effects.iter().fold(declared, |forces, effect| effect.apply(joint, forces));
        self.tables.iter().fold(named, |forces, table| table.apply(joint, forces))
    }
}
