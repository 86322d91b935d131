//! What the data say of a mechanism: observations of windows, and their log density.

mod dynamics;
mod edges;
mod kinematics;
mod window;

pub use dynamics::{
    AddedEffect, AddedTable, BatchFit, BatchWindow, BatchedWindow, DAMPING, DeclaredPhysics, DynamicsInput,
    DynamicsLearner, DynamicsPosterior, FRICTION, Hypothesis, INERTIA, JointDynamics, JointModel, JointScales,
    LIMIT_DEVIATION, LOWER, Mechanism, PartDynamics, SENSOR_SIZE, SIZE, SamplingReport, SensorError, SensorModel,
    UPPER, WindowInference, WindowModel, WindowResidual,
};
pub use edges::{
    EdgeFit, EdgePart, axes_from_motion, moving_evidence, nearest_position, relative_windows, rigid_evidence,
};
pub use kinematics::{
    Axis, KinematicFit, KinematicJoint, KinematicSettings, SharedByFits, carriers, fit_edge, fit_kinematics,
};
pub use window::{Contact, PoseMeasurement, WindowObservations};
