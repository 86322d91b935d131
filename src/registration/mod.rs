//! From a part's cloud to its pose with 6×6 information.
//!
//! A part's reference model is a set of surfels at the reference configuration, one side per
//! viewing direction, so that the front and the back of a thin panel never mix. Clouds are aligned
//! to it point to plane with robust weights; what the geometry does not hold stays at zero
//! information.

mod align;
mod articulated;
mod faces;
mod factor;
mod field;
mod outline;
mod seeds;
mod surfels;

pub use align::{Alignment, align, follow};
pub use articulated::{JointFrame, JointPath, search_path};
pub use faces::{Face, Suggestion, suggested_direction};
pub use factor::{
    AlignmentSettings, FromBehind, OUTLIER_COST, PoseFactor, Quadratic, motion_cost, pose_factor, rest_cost,
    thinned_cost, truncated_cost,
};
pub use field::NearestField;
pub use outline::{Outline, outline_quadratic, rays_near, seen_through};
pub use seeds::{AxisSeed, fit_circle, fit_line, geometric_seeds};
pub use surfels::{PartModel, Surfel, SurfelAccumulator};

use nalgebra::Vector3;

/// A point of one scan, with the sensor that saw it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ScanPoint {
    /// Position in world \[m\].
    pub point_in_world: Vector3<f64>,
    /// Where the sensor stood, in world \[m\]; `None` for fused clouds.
    pub viewpoint_in_world: Option<Vector3<f64>>,
}
