//! Prediction: the filtered state, simulated on under the wrench to come.
//!
//! cov = Σ Δ Δᵀ over the directions in which state, held point, disturbance and numbers may be wrong
//! together, each simulated one standard deviation to both sides, plus the axes' and the unmodelled
//! force's. Beyond where a joint was ever seen an unknown stop may wait: at distance X, exponential with
//! mean L, so that a way Δ beyond becomes E min(Δ, X) = L (1 − e^(−Δ/L)), with its variance.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3};

use super::filter::{self, FORCE_DENSITY, Filter, LEASH, STEP, Start, limit_deviation};
use super::free::FADE;
use super::mechanism::TrackedMechanism;
use super::simulation::Drive;
use crate::math::{Pose, Screw};
use crate::mechanism::{Workspace, WrenchSample};
use crate::model::{Axis, KinematicJoint};
use crate::types::Label;

/// Steps of the simulations that differ from the prediction \[s\].
const COARSE_STEP: f64 = 0.008;
/// Mean distance to a stop beyond what was seen of a joint \[m\] ...
const STOP_BEYOND: f64 = 0.25;
/// ... and the chance that where it was first seen is itself a stop: things are mostly found closed.
const FOUND_CLOSED: f64 = 0.5;
/// Nothing predicted is faster than this, nor speeds up by more \[m/s\].
const FASTEST: f64 = 1.5;

/// All bodies at one horizon.
#[derive(Clone, Debug, PartialEq)]
pub struct Forecast {
    /// q, by joint \[m or rad\].
    pub positions: Vec<f64>,
    /// Covariance of each body's centre of mass, D·c \[m²\].
    pub covariances_m2: Vec<Matrix3<f64>>,
}

/// Joint positions by time, the first at the filter's own.
type Path = Vec<Vec<f64>>;

impl Filter {
    /// Every body at `horizons_s` after the filter's time, ascending, under the wrenches read.
    pub fn forecast(&self, horizons_s: &[f64], samples: &[WrenchSample]) -> Vec<Forecast> {
        let n = self.mechanism.joints.len();
        let times_s: Vec<f64> =
            std::iter::once(0.0).chain(horizons_s.iter().copied()).map(|h| self.time_s + h).collect();
        let first = samples.partition_point(|s| s.stamp_s < self.time_s - 0.05);
        let last = times_s.last().map_or(0, |end| samples.partition_point(|s| s.stamp_s <= end + 1e-9));
        let samples = &samples[first..last.max(first)];
        let stay = || vec![self.state.positions.clone(); times_s.len()];
        let mut errors: Vec<DMatrix<f64>> = vec![self.covariance.view((0, 0), (n, n)).into_owned(); times_s.len()];
        let mut path = stay();
        if !self.rests() {
            path = self.simulate(&[], &times_s, samples, STEP).unwrap_or_else(stay);
            errors = self.spread(&path, &times_s, samples);
        }
        let forecast = |((positions, mut errors), time_s): ((&Vec<f64>, DMatrix<f64>), &f64)| {
            let (positions, variances) = self.before_unknown_stops(positions);
            for (joint, variance) in variances.iter().enumerate() {
                errors[(joint, joint)] += variance;
                let most = LEASH + 2.0 * filter::FASTEST * (time_s - self.time_s);
                limit_deviation(&mut errors, joint, most / self.mechanism.reach(joint));
            }
            let spread = |body| center_covariance(&self.mechanism, body, &positions, &errors);
            let covariances_m2 = (0..n).map(spread).collect();
            Forecast { positions, covariances_m2 }
        };
        path.iter().zip(errors).zip(&times_s).skip(1).map(forecast).collect()
    }

    /// Where each part is expected at a later time under the wrenches read.
    pub fn expect(&self, time_s: f64, samples: &[WrenchSample]) -> BTreeMap<Label, Pose> {
        let first = samples.partition_point(|s| s.stamp_s < self.time_s - 0.05);
        let path =
            if self.rests() { None } else { self.simulate(&[], &[self.time_s, time_s], &samples[first..], STEP) };
        let positions = path.and_then(|mut path| path.pop()).unwrap_or_else(|| self.state.positions.clone());
        self.placed(&self.before_unknown_stops(&positions).0)
    }

    /// Joint positions after a horizon if the joints keep their rates, fading, and if they stop.
    pub fn steady(&self, horizon_s: f64) -> [Vec<f64>; 2] {
        let lasting = FADE * (1.0 - (-horizon_s / FADE).exp());
        let moved = self.state.positions.iter().zip(&self.state.rates).map(|(q, rate)| q + rate * lasting);
        [moved.collect(), self.state.positions.clone()]
    }

    /// Displacements of all jointed parts at joint positions.
    pub fn placed(&self, positions: &[f64]) -> BTreeMap<Label, Pose> {
        let displacements = self.mechanism.tree.displacements(positions);
        self.mechanism.joints.iter().map(|joint| joint.child).zip(displacements).collect()
    }

    /// The joints' path from the present state, some coordinates changed; `None` if it is not finite.
    pub(super) fn simulate(
        &self,
        changes: &[(usize, f64)],
        times_s: &[f64],
        samples: &[WrenchSample],
        step_s: f64,
    ) -> Option<Path> {
        let Start { mut tree, mut state, mut disturbance, held } = self.start(changes)?;
        let resting = self.resting();
        let drive = Drive { held, samples, sensor: self.mechanism.sensor, resting: &resting, step_s };
        let mut workspace = Workspace::new(&tree);
        let mut cursor = 0;
        let first = self.state.positions.clone();
        let speed = |joint: usize| self.state.rates[joint].abs().min(FASTEST / self.mechanism.reach(joint));
        let speeds: Vec<f64> = (0..first.len()).map(speed).collect();
        let mut path = vec![state.positions.clone()];
        for span in times_s.windows(2) {
            drive.run(&mut tree, &mut state, [span[0], span[1]], &disturbance, (&mut workspace, &mut cursor));
            let faded = (-(span[1] - span[0]) / super::simulation::DISTURBANCE_MEMORY).exp();
            disturbance.iter_mut().for_each(|force| *force *= faded);
            let ahead_s = span[1] - times_s[0];
            let bounded = (0..first.len()).map(|joint| {
                let most = (speeds[joint] + FASTEST / self.mechanism.reach(joint)) * ahead_s;
                state.positions[joint].clamp(first[joint] - most, first[joint] + most)
            });
            path.push(bounded.collect());
        }
        path.iter().flatten().all(|q| q.is_finite()).then_some(path)
    }

    /// How joint positions may be wrong, by time.
    fn spread(&self, path: &Path, times_s: &[f64], samples: &[WrenchSample]) -> Vec<DMatrix<f64>> {
        let n = self.mechanism.joints.len();
        let mut errors: Vec<DMatrix<f64>> = vec![DMatrix::zeros(n, n); times_s.len()];
        let moving = self.moving_joints();
        // What rests stays as it is known.
        for error in &mut errors {
            for joint in (0..n).filter(|joint| !moving.contains(joint)) {
                error[(joint, joint)] += self.covariance[(joint, joint)];
            }
        }
        let mut coordinates = self.coordinates_of(&moving);
        if self.held.is_some() {
            coordinates.extend(2 * n..2 * n + 3);
        }
        coordinates.retain(|&at| self.covariance[(at, at)] > 1e-16);
        let deviations =
            DVector::from_iterator(coordinates.len(), coordinates.iter().map(|&at| self.covariance[(at, at)].sqrt()));
        let correlation = DMatrix::from_fn(coordinates.len(), coordinates.len(), |i, j| {
            self.covariance[(coordinates[i], coordinates[j])] / (deviations[i] * deviations[j])
        });
        let eigen = correlation.symmetric_eigen();
        for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
            if *value < 1e-4 {
                continue;
            }
            let change = |sign: f64| -> Vec<(usize, f64)> {
                let parts = coordinates.iter().zip(deviations.iter()).zip(vector.iter());
                parts.map(|((&at, deviation), along)| (at, sign * value.sqrt() * deviation * along)).collect()
            };
            let [plus, minus] = [1.0, -1.0].map(|sign| self.simulate(&change(sign), times_s, samples, COARSE_STEP));
            let (Some(plus), Some(minus)) = (plus, minus) else { continue };
            for (k, error) in errors.iter_mut().enumerate() {
                let half = DVector::from_iterator(n, plus[k].iter().zip(&minus[k]).map(|(a, b)| 0.5 * (a - b)));
                *error += &half * half.transpose();
            }
        }
        for &joint in &moving {
            let reach = self.mechanism.reach(joint);
            if path.iter().any(|positions| (positions[joint] - path[0][joint]).abs() * reach > 1e-4) {
                for (error, time_s) in errors.iter_mut().zip(times_s) {
                    error[(joint, joint)] += self.unmodelled(joint, time_s - times_s[0]);
                }
            }
        }
        errors
    }

    /// Positions with the stops that may wait beyond what was seen, and the variance that they add.
    fn before_unknown_stops(&self, positions: &[f64]) -> (Vec<f64>, Vec<f64>) {
        let mut expected = positions.to_vec();
        let mut variances = vec![0.0; positions.len()];
        for (joint, seen) in self.explored.iter().enumerate() {
            let reach = self.mechanism.reach(joint);
            let parameters = &self.mechanism.tree.bodies()[joint].parameters;
            let q = positions[joint];
            let (edge, sign, known) = if q < seen[0] {
                (seen[0], -1.0, parameters.lower.is_some())
            } else {
                (seen[1], 1.0, parameters.upper.is_some())
            };
            let beyond = sign * (q - edge) * reach;
            if known || beyond <= 0.0 {
                continue;
            }
            let closed = if edge.abs() * reach < 0.01 { FOUND_CLOSED } else { 0.0 };
            let ratio = beyond / STOP_BEYOND;
            let mean = (1.0 - closed) * STOP_BEYOND * (1.0 - (-ratio).exp());
            let square = (1.0 - closed) * 2.0 * STOP_BEYOND.powi(2) * (1.0 - (-ratio).exp() * (1.0 + ratio));
            expected[joint] = edge + sign * mean / reach;
            variances[joint] = (square - mean * mean).max(0.0) / (reach * reach);
        }
        (expected, variances)
    }

    /// Variance of a joint's position by the unmodelled force over a span: ∫∫ of white acceleration.
    fn unmodelled(&self, joint: usize, span_s: f64) -> f64 {
        let inertia = self.inertia(joint);
        let density = FORCE_DENSITY * self.mechanism.noise_scale * self.unease * self.mechanism.reach(joint).powi(2)
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
