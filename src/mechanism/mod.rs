//! Rigid-body dynamics of an articulated object: joints, tree, friction, limits, effects, rollouts.
//!
//! M(q) q̈ + c(q, q̇) + g(q) = Σ effects − D q̇ + λ + Jᵀ w, with λ from set-valued Coulomb friction
//! and unilateral joint limits. Everything is generic over [`Real`](crate::math::Real), so that one
//! code gives a trajectory and its derivatives by parameters and initial state.
//!
//! Positions, rates and generalized forces are slices with one entry per body of the
//! [`Tree`]; the entry of a rigidly attached body is zero and stays so.

pub mod effects;
mod forcing;
mod friction;
mod inertia;
mod joint;
mod limits;
mod parameters;
mod rollout;
mod single;
mod solve;
mod step;
mod tangent;
#[cfg(test)]
mod tests;
mod tree;
mod workspace;

pub use forcing::{WrenchPoint, WrenchSample, WrenchTrack};
pub use friction::{FrictionBounds, soft_threshold};
pub use inertia::{Spatial, SpatialInertia};
pub use joint::JointType;
pub use limits::{Approach, DEFAULT_LIMIT_SOFTNESS_S, Limit, LimitFlow};
pub use parameters::{JointForces, JointParameters};
pub use rollout::{Reach, RolloutError, Trajectory, advance_single, rollout, rollout_in};
pub use single::{SingleJoint, SingleState};
pub use step::{BodyWrench, State, Step, WrenchOrigin, step};
pub use tangent::{StateSlopes, TangentWorkspace, TreeSlope, advance_with_slopes};
pub use tree::{Body, Tree, TreeError};
pub use workspace::Workspace;
