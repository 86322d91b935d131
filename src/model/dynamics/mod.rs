//! Friction, damping, inertia and end stops of the joints, window by window.
//!
//! posterior = prior × Π sites, one site per window ([`crate::inference::Belief`]); the kinematic
//! numbers are part of the same Gaussian with the kinematic fit's covariance as their prior, so that
//! an error of an axis moves all windows' results alike.

mod innovations;
mod layout;
mod learner;
mod posterior;
mod sampling;
mod site;
#[cfg(test)]
mod tests;
mod track;

pub use learner::{DynamicsInput, DynamicsLearner, WindowInference};
pub use posterior::{DynamicsPosterior, JointDynamics, PartDynamics};
pub use sampling::SamplingReport;
