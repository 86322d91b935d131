//! Friction, damping, inertia and end stops of the joints, window by window.
//!
//! posterior = prior × Π sites, one site per window ([`crate::inference::Belief`]); the kinematic
//! numbers are part of the same Gaussian with the kinematic fit's covariance as their prior, so that
//! an error of an axis moves all windows' results alike.

mod attenuation;
mod batch;
mod innovations;
mod layout;
mod learner;
mod physics;
mod posterior;
mod residual;
mod sampling;
mod site;
#[cfg(test)]
mod tests;
mod track;

pub use batch::{BatchFit, BatchWindow, BatchedWindow, Hypothesis};
pub use innovations::WindowModel;
pub use layout::{
    AddedEffect, AddedTable, DAMPING, FRICTION, INERTIA, JointModel, JointScales, LIMIT_DEVIATION, LOWER, Mechanism,
    SENSOR_SIZE, SIZE, SensorError, SensorModel, UPPER,
};
pub use learner::{DeclaredPhysics, DynamicsInput, DynamicsLearner, WindowInference};
pub use posterior::{DynamicsPosterior, JointDynamics, PartDynamics};
pub use residual::WindowResidual;
pub use sampling::SamplingReport;
