//! Robust alignment of one scan to a part's model, from a predicted pose.

use nalgebra::{Matrix6, Vector6};

use super::{AlignmentSettings, PartModel, PoseFactor, ScanPoint, pose_factor};
use crate::math::{Pose, length_scale};

/// The outcome of an alignment.
#[derive(Clone, Debug)]
pub struct Alignment {
    /// D, the part's displacement since the first frame.
    pub displacement: Pose,
    /// The factor at `displacement`.
    pub factor: PoseFactor,
    /// Whether the last step was below a tenth of a millimetre.
    pub converged: bool,
}

/// Information that holds a followed scan's pose where it was expected \[m⁻²\], and steps of its alignment.
const FOLLOWED: (f64, usize) = (2.5e3, 6);

/// Aligns a scan from where it is expected, held there only loosely (20 mm) where the geometry leaves it free.
pub fn follow(model: &PartModel, scan: &[ScanPoint], start: &Pose, settings: &AlignmentSettings) -> Alignment {
    let scale = length_scale(model.radius);
    let prior = Matrix6::from_diagonal(&(scale.component_mul(&scale) * FOLLOWED.0));
    align(model, scan, start, &prior, settings, FOLLOWED.1)
}

/// Aligns a scan by Gauss–Newton with a line search, at most `steps` steps.
///
/// `prior` is the information of the predicted pose `start` in ξ, (angular, linear), about the
/// model's centroid: it holds what the geometry leaves free.
pub fn align(
    model: &PartModel,
    scan: &[ScanPoint],
    start: &Pose,
    prior: &Matrix6<f64>,
    settings: &AlignmentSettings,
    steps: usize,
) -> Alignment {
    let centered = |xi: &Vector6<f64>| {
        *start * Pose::from_translation(model.centroid) * Pose::exp(xi) * Pose::from_translation(-model.centroid)
    };
    let mut xi = Vector6::zeros();
    let mut factor = pose_factor(model, scan, start, settings);
    let mut cost = factor.cost;
    let mut converged = false;
    for _ in 0..steps {
        let Some(cholesky) = (factor.hessian() + prior).cholesky() else { break };
        let step = -cholesky.solve(&(factor.gradient() + prior * xi));
        let mut fraction = 1.0;
        let mut improved = false;
        for _ in 0..4 {
            let trial = xi + step * fraction;
            let trial_factor = pose_factor(model, scan, &centered(&trial), settings);
            let trial_cost = trial_factor.cost + 0.5 * trial.dot(&(prior * trial));
            if trial_cost < cost {
                (xi, factor, cost, improved) = (trial, trial_factor, trial_cost, true);
                break;
            }
            fraction *= 0.4;
        }
        let length = step.fixed_rows::<3>(0).norm() * model.radius + step.fixed_rows::<3>(3).norm();
        converged = length < 1e-4;
        if !improved || converged {
            converged = true;
            break;
        }
    }
    Alignment { displacement: centered(&xi), factor, converged }
}
