//! Prediction: the filtered state, simulated on under the wrench to come.
//!
//! cov = Σ Δ Δᵀ over the directions in which state and parameters may be wrong, each simulated one
//! standard deviation away, plus the axes', the unmodelled force's and a floor.

use nalgebra::{DMatrix, Matrix3, Vector3};

use super::filter::{FORCE_DENSITY, Filter, STEP, keep, reach};
use super::mechanism::TrackedMechanism;
use crate::math::{Pose, Screw};
use crate::mechanism::{State, Step, Tree, Workspace, WrenchPoint, WrenchSample, WrenchTrack, step};
use crate::model::{Axis, KinematicJoint};
use crate::types::Label;

/// Standard deviation that nothing lowers: of a part where it is \[m\] by joint of its chain, and by the
/// way it is to go. Fits and filters are off by this on ../shared/bags beyond what they say.
const FLOOR: f64 = 0.0012;
const FLOOR_BY_WAY: f64 = 0.05;
/// Steps of the simulations that differ from the prediction \[s\].
const COARSE_STEP: f64 = 0.008;

/// The filter at the time that predictions start from.
pub type Snapshot = Filter;

/// One part at one horizon.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Forecast {
    /// The part.
    pub label: Label,
    /// Index of the horizon.
    pub horizon: usize,
    /// D.
    pub displacement: Pose,
    /// Covariance of D·c, c its centre of mass \[m²\].
    pub covariance_m2: Matrix3<f64>,
}

impl Filter {
    /// Every jointed part at `horizons_s` after the filter's time, ascending, under the wrenches read.
    pub fn forecast(&self, horizons_s: &[f64], samples: &[WrenchSample]) -> Vec<Forecast> {
        let n = self.mechanism.joints.len();
        let times_s: Vec<f64> =
            std::iter::once(0.0).chain(horizons_s.iter().copied()).map(|h| self.time_s + h).collect();
        let first = samples.partition_point(|s| s.stamp_s < self.time_s - 0.05);
        let last = times_s.last().map_or(0, |end| samples.partition_point(|s| s.stamp_s <= end + 1e-9));
        let samples = &samples[first..last.max(first)];
        let resting = self.resting();
        let simulate = |tree: &Tree<f64>, state: &State<f64>, step_s: f64| -> Option<Vec<Vec<f64>>> {
            if self.rests() {
                return Some(vec![state.positions.clone(); times_s.len()]);
            }
            let track = self.held.map(|held| WrenchTrack {
                point: WrenchPoint::Carried(held.point),
                ..WrenchTrack::new(held.body, samples)
            });
            let mut workspace = Workspace::new(tree);
            let mut state = state.clone();
            let mut cursor = 0;
            let mut path = vec![state.positions.clone()];
            for span in times_s.windows(2) {
                let count = ((span[1] - span[0]) / step_s - 1e-6).ceil().max(1.0) as usize;
                let length_s = (span[1] - span[0]) / count as f64;
                for i in 0..count {
                    let middle_s = span[0] + (i as f64 + 0.5) * length_s;
                    let wrench = track.as_ref().map(|track| track.wrench(middle_s, &mut cursor));
                    step(tree, &mut state, wrench.as_slice(), Step { middle_s, length_s }, &mut workspace);
                    keep(&resting, &mut state);
                }
                path.push(state.positions.clone());
            }
            path.iter().flatten().all(|q| q.is_finite()).then_some(path)
        };
        let tree = &self.mechanism.tree;
        let stay = || vec![self.state.positions.clone(); times_s.len()];
        let path = simulate(tree, &self.state, STEP).unwrap_or_else(stay);
        // How each joint's position may be wrong, by horizon.
        let mut errors: Vec<DMatrix<f64>> = vec![DMatrix::zeros(n, n); times_s.len()];
        if self.rests() {
            let own = self.covariance.view((0, 0), (n, n)).into_owned();
            errors.iter_mut().for_each(|error| error.copy_from(&own));
        } else {
            let coarse = simulate(tree, &self.state, COARSE_STEP).unwrap_or_else(stay);
            let add = |errors: &mut Vec<DMatrix<f64>>, other: Option<Vec<Vec<f64>>>| {
                let Some(other) = other else { return };
                for ((error, a), b) in errors.iter_mut().zip(&coarse).zip(&other) {
                    let change = nalgebra::DVector::from_iterator(n, a.iter().zip(b).map(|(a, b)| b - a));
                    *error += &change * change.transpose();
                }
            };
            let own = self.covariance.view((0, 0), (2 * n, 2 * n)).into_owned();
            let eigen = own.symmetric_eigen();
            for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
                let root = value.max(0.0).sqrt();
                if root < 1e-5 {
                    continue;
                }
                let mut positions = self.state.positions.clone();
                let mut rates = self.state.rates.clone();
                for joint in 0..n {
                    positions[joint] += root * vector[joint];
                    rates[joint] += root * vector[n + joint];
                }
                add(&mut errors, simulate(tree, &State::new(positions, rates), COARSE_STEP));
            }
            for joint in 0..n {
                let moves = path
                    .iter()
                    .any(|positions| (positions[joint] - path[0][joint]).abs() * reach(&self.mechanism, joint) > 1e-4);
                if moves {
                    for varied in &self.mechanism.varied[joint] {
                        add(&mut errors, simulate(varied, &self.state, COARSE_STEP));
                    }
                    for (error, time_s) in errors.iter_mut().zip(&times_s) {
                        error[(joint, joint)] += self.unmodelled(joint, time_s - self.time_s);
                    }
                }
            }
        }
        let mut forecasts = Vec::with_capacity(n * horizons_s.len());
        for horizon in 0..horizons_s.len() {
            let positions = &path[horizon + 1];
            let displacements = tree.displacements(positions);
            for (body, joint) in self.mechanism.joints.iter().enumerate() {
                if self.mechanism.chain(body).iter().any(|&joint| self.distrusted[joint]) {
                    continue;
                }
                let displacement = displacements[body];
                let way = (displacement.transform_point(&self.mechanism.centers[body])
                    - tree.displacements(&path[0])[body].transform_point(&self.mechanism.centers[body]))
                .norm();
                let mut covariance = center_covariance(&self.mechanism, body, positions, &errors[horizon + 1]);
                let floor = FLOOR * self.mechanism.chain(body).len() as f64;
                let floor_by_way = FLOOR_BY_WAY * way;
                covariance += Matrix3::identity() * (floor * floor);
                let direction = displacement.transform_point(&self.mechanism.centers[body])
                    - tree.displacements(&path[0])[body].transform_point(&self.mechanism.centers[body]);
                if let Some(direction) = direction.try_normalize(1e-6) {
                    covariance += direction * direction.transpose() * (floor_by_way * floor_by_way);
                }
                forecasts.push(Forecast { label: joint.child, horizon, displacement, covariance_m2: covariance });
            }
        }
        forecasts
    }

    /// Variance of a joint's position by the unmodelled force over a span: ∫∫ of white acceleration.
    fn unmodelled(&self, joint: usize, span_s: f64) -> f64 {
        let inertia = self.inertia(joint);
        let density = FORCE_DENSITY * self.mechanism.noise_scale * self.unease * reach(&self.mechanism, joint).powi(2)
            / inertia.powi(2);
        density * span_s.powi(3) / 3.0
    }
}

/// Covariance of a part's centre by its joints' positions and axes.
fn center_covariance(
    mechanism: &TrackedMechanism,
    body: usize,
    positions: &[f64],
    errors: &DMatrix<f64>,
) -> Matrix3<f64> {
    let screws = mechanism.tree.screws(positions);
    let displacements = mechanism.tree.displacements(positions);
    let center = displacements[body].transform_point(&mechanism.centers[body]);
    let chain = mechanism.chain(body);
    let slope = |joint: usize| screws[joint].angular.cross(&center) + screws[joint].linear;
    let mut covariance = Matrix3::zeros();
    for &i in &chain {
        for &j in &chain {
            covariance += slope(i) * slope(j).transpose() * errors[(i, j)];
        }
        // D = D_π A exp(S q) A⁻¹ …: the axis moved by δ moves what follows by (1 − Ad exp(S q)) δ.
        let above = mechanism.joints[i].parent.map_or_else(Pose::identity, |parent| displacements[parent]);
        let own = mechanism.joints[i].screw().displacement(positions[i]);
        let basis = axis_basis(&mechanism.joints[i]);
        for column in mechanism.axis_roots[i].column_iter() {
            let twist = basis.iter().zip(column.iter()).fold(nalgebra::Vector6::zeros(), |sum, (b, c)| sum + b * *c);
            let moved = above.adjoint(&(twist - own.adjoint(&twist)));
            let change =
                Vector3::new(moved[0], moved[1], moved[2]).cross(&center) + Vector3::new(moved[3], moved[4], moved[5]);
            covariance += change * change.transpose();
        }
    }
    covariance
}

/// The axis's tangent twists: two rotations about its point, then two translations across it.
fn axis_basis(joint: &KinematicJoint) -> [nalgebra::Vector6<f64>; 4] {
    let Axis { direction, point } = joint.axis;
    let (first, second) = crate::math::orthonormal_pair(&direction);
    [
        Screw::revolute(&first, &point).0,
        Screw::revolute(&second, &point).0,
        Screw::prismatic(&first).0,
        Screw::prismatic(&second).0,
    ]
}
