//! An extended Kalman filter over joint positions, rates and the point that the tool holds.
//!
//! Mean by simulation: ẋ = (q̇, M⁻¹(τ − d q̇ + λ + Jᵀ w − c − g)), so that friction sticks: a joint that
//! no force moves stays exactly where it is. Covariance by q̇ ← α q̇ with α = 1/(1 + h d/M_jj), and the
//! white generalized force that the wrench sensor's noise makes, times κ for what the model misses.
//! Corrections: x − o = D(q) p by the tool, log(T(−c) D_obs⁻¹ D(q) T(c)) = 0 by every cloud.

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SMatrix, SVector, Vector3, Vector6};

use super::mechanism::TrackedMechanism;
use crate::math::{Pose, skew};
use crate::mechanism::{BodyWrench, Spatial, State, Step, Workspace, WrenchPoint, WrenchSample, WrenchTrack, step};
use crate::model::PoseMeasurement;
use crate::types::Label;

/// Longest step \[s\].
pub(super) const STEP: f64 = 0.004;
/// Density of the white force that moves a held part beside what was read \[N²·s\]: a sensor of .1 N at
/// 125 Hz.
pub(super) const FORCE_DENSITY: f64 = 0.1 * 0.1 * 0.008;
/// A stuck joint forgets how its rate may be wrong within this \[s\].
const STUCK_MEMORY: f64 = 0.03;
/// Registration error that the frames share \[m\].
const SHARED_ERROR: f64 = 0.004;
/// χ² of three or six numbers that no filter in order sees.
const GATE: f64 = 30.0;
/// Innovations this much larger than expected, on the mean of the last so many, raise the process noise.
const SURPRISED: f64 = 1.5;
const SURPRISE_SHARE: f64 = 0.2;
const MOST_UNEASE: f64 = 3000.0;
/// An innovation beyond the gate is the joints' if their motion explains all but this \[m\] ...
const EXPLAINED: f64 = 0.005;
/// ... and it is not larger than this \[m\]: the tool let go.
const FURTHEST: f64 = 0.05;
/// Softest standard deviation of the point first held, beside the tool's own \[m\].
const HELD_DEVIATION: f64 = 0.0005;

/// What the tool holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Held {
    /// The body.
    pub body: usize,
    /// Where, at the reference configuration \[m\].
    pub point: Vector3<f64>,
}

/// Positions and rates of all joints with their covariance.
#[derive(Clone, Debug)]
pub struct Filter {
    pub(super) mechanism: Arc<TrackedMechanism>,
    pub(super) time_s: f64,
    pub(super) state: State<f64>,
    /// Of (positions, rates, held point).
    pub(super) covariance: DMatrix<f64>,
    pub(super) held: Option<Held>,
    workspace: Workspace<f64>,
    inertias: Vec<f64>,
    /// Factor on the process noise while innovations are larger than expected.
    pub(super) unease: f64,
    /// Running mean of the tool's squared innovations in units of their variance.
    surprise: f64,
    /// Joints that what is held does not follow.
    pub(super) distrusted: Vec<bool>,
    /// Positions at the start.
    start: Vec<f64>,
    cursor: usize,
}

impl Filter {
    /// A filter that starts at `time_s` from positions \[m or rad\] and rates, the positions known to
    /// `deviation` \[m\] of the part's points and the rates to `rate_deviation` \[m/s\].
    pub fn new(
        mechanism: Arc<TrackedMechanism>,
        time_s: f64,
        positions: Vec<f64>,
        rates: Vec<f64>,
        (deviation, rate_deviation): (f64, f64),
    ) -> Self {
        let n = mechanism.joints.len();
        let mut covariance = DMatrix::zeros(2 * n + 3, 2 * n + 3);
        let inertias = mechanism.tree.mass_matrix(&positions).diagonal().iter().map(|m| m.max(1e-9)).collect();
        for joint in 0..n {
            let reach = reach(&mechanism, joint);
            covariance[(joint, joint)] = (deviation / reach).powi(2);
            covariance[(n + joint, n + joint)] =
                if rates[joint] == 0.0 { 0.0 } else { (rate_deviation / reach).powi(2) };
        }
        let workspace = Workspace::new(&mechanism.tree);
        let start = positions.clone();
        let state = State::new(positions, rates);
        Self {
            start,
            distrusted: vec![false; n],
            mechanism,
            time_s,
            state,
            covariance,
            held: None,
            workspace,
            inertias,
            unease: 1.0,
            surprise: 1.0,
            cursor: 0,
        }
    }

    /// What it filters.
    pub fn mechanism(&self) -> &TrackedMechanism {
        &self.mechanism
    }

    /// The time of the state \[s\].
    pub fn time_s(&self) -> f64 {
        self.time_s
    }

    /// q \[m or rad\].
    pub fn positions(&self) -> &[f64] {
        &self.state.positions
    }

    /// q̇ \[m/s or rad/s\].
    pub fn rates(&self) -> &[f64] {
        &self.state.rates
    }

    /// What the tool holds.
    pub fn held(&self) -> Option<Held> {
        self.held
    }

    /// Joints that stay: at rest, and not between the world and what is held. Friction holds them, or
    /// they would not rest; a model that says otherwise is wrong.
    pub(super) fn resting(&self) -> Vec<(usize, f64)> {
        let driven = self.held.map(|held| self.mechanism.chain(held.body)).unwrap_or_default();
        let rests = |joint: &usize| self.state.rates[*joint] == 0.0 && !driven.contains(joint);
        (0..self.mechanism.joints.len()).filter(rests).map(|joint| (joint, self.state.positions[joint])).collect()
    }

    /// A part that is not where it should be, with all that carries it, is where the filter started, at rest.
    pub fn lose(&mut self, label: Label) {
        let Some(body) = self.mechanism.body(label) else { return };
        for joint in self.mechanism.chain(body) {
            self.state.positions[joint] = self.start[joint];
            self.state.rates[joint] = 0.0;
        }
        self.state = State::new(self.state.positions.clone(), self.state.rates.clone());
    }

    /// What moves a body is not as the mechanism says: it stops, and is not forecast.
    pub fn distrust(&mut self, body: usize) {
        for joint in self.mechanism.chain(body) {
            self.distrusted[joint] = true;
            self.state.rates[joint] = 0.0;
        }
        self.state = State::new(self.state.positions.clone(), self.state.rates.clone());
    }

    /// Every joint counts again.
    pub fn trust(&mut self) {
        self.distrusted.fill(false);
    }

    /// Everything that nothing touches is at rest.
    pub fn rest(&mut self) {
        if self.held.is_none() {
            self.state.rates.fill(0.0);
            self.state = State::new(self.state.positions.clone(), self.state.rates.clone());
        }
    }

    /// Whether nothing moves and nothing is held.
    pub fn rests(&self) -> bool {
        self.held.is_none() && self.state.rates.iter().all(|rate| *rate == 0.0)
    }

    /// Parts that may move, with their displacements: those that the tool's hold or a rate reaches.
    pub fn moving_parts(&self) -> Vec<(Label, Pose)> {
        let driven = self.held.map(|held| self.mechanism.chain(held.body)).unwrap_or_default();
        let moves = |joint: usize| driven.contains(&joint) || self.state.rates[joint] != 0.0;
        let displacements = self.mechanism.tree.displacements(&self.state.positions);
        let joints = self.mechanism.joints.iter().zip(displacements).enumerate();
        joints
            .filter(|(body, _)| self.mechanism.chain(*body).into_iter().any(moves))
            .map(|(_, (joint, displacement))| (joint.child, displacement))
            .collect()
    }

    /// The tool takes hold of a part where it is now; its position is reported with `sigma_m`.
    pub fn hold(&mut self, body: usize, tool_in_world: &Vector3<f64>, sigma_m: f64) {
        let displacement = self.mechanism.tree.displacements(&self.state.positions)[body];
        let point = displacement.inverse().transform_point(&(tool_in_world - self.mechanism.tool_offset));
        self.hold_point(body, point, sigma_m);
        // The point is where the joints put it: p = D(q)⁻¹ (x − o), so its error goes with theirs.
        let n = self.mechanism.joints.len();
        let slope = self.point_slopes(&Held { body, point });
        let turn = displacement.rotation.transpose();
        let map = -(turn * slope);
        let joints = self.covariance.view((0, 0), (n, 2 * n)).into_owned();
        let cross = &map * joints;
        let own = &map * self.covariance.view((0, 0), (n, n)) * map.transpose()
            + Matrix3::identity() * (sigma_m.powi(2) + HELD_DEVIATION.powi(2));
        self.covariance.view_mut((2 * n, 0), (3, 2 * n)).copy_from(&cross);
        self.covariance.view_mut((0, 2 * n), (2 * n, 3)).copy_from(&cross.transpose());
        self.covariance.view_mut((2 * n, 2 * n), (3, 3)).copy_from(&own);
    }

    /// The tool holds a known point of a part, at the reference configuration.
    pub fn hold_point(&mut self, body: usize, point: Vector3<f64>, sigma_m: f64) {
        self.release();
        self.held = Some(Held { body, point });
        let n = self.mechanism.joints.len();
        for i in 2 * n..2 * n + 3 {
            self.covariance[(i, i)] = sigma_m.powi(2);
        }
    }

    /// The tool lets go.
    pub fn release(&mut self) {
        self.held = None;
        let n = self.mechanism.joints.len();
        for i in 2 * n..2 * n + 3 {
            self.covariance.row_mut(i).fill(0.0);
            self.covariance.column_mut(i).fill(0.0);
        }
    }

    /// Simulates on to `to_s` under the wrenches read.
    pub fn advance(&mut self, to_s: f64, samples: &[WrenchSample]) {
        let span = to_s - self.time_s;
        if span <= 0.0 {
            return;
        }
        if self.rests() {
            self.time_s = to_s;
            self.forget_rates(span);
            return;
        }
        let mechanism = Arc::clone(&self.mechanism);
        let count = (span / STEP - 1e-6).ceil().max(1.0) as usize;
        let length_s = span / count as f64;
        let track = self.held.map(|held| WrenchTrack {
            point: WrenchPoint::Carried(held.point),
            ..WrenchTrack::new(held.body, samples)
        });
        let resting = self.resting();
        for i in 0..count {
            let middle_s = self.time_s + (i as f64 + 0.5) * length_s;
            let wrench: Option<BodyWrench<f64>> = track.as_ref().map(|track| track.wrench(middle_s, &mut self.cursor));
            let applied = Step { middle_s, length_s };
            step(&mechanism.tree, &mut self.state, wrench.as_slice(), applied, &mut self.workspace);
            keep(&resting, &mut self.state);
        }
        self.time_s = to_s;
        self.grow(span);
    }

    /// The covariance over a span \[s\].
    fn grow(&mut self, span: f64) {
        let n = self.mechanism.joints.len();
        let driven = self.held.map(|held| self.point_slopes(&held));
        for joint in 0..n {
            let stuck = self.state.rates[joint] == 0.0;
            let damping = self.mechanism.tree.bodies()[joint].parameters.damping;
            let decay =
                if stuck { (-span / STUCK_MEMORY).exp() } else { 1.0 / (1.0 + span * damping / self.inertias[joint]) };
            // (q, q̇) ← (q + h q̇, α q̇)
            let shift = self.covariance.row(n + joint) * span;
            let mut row = self.covariance.row_mut(joint);
            row += shift;
            let shift = self.covariance.column(n + joint) * span;
            let mut column = self.covariance.column_mut(joint);
            column += shift;
            self.covariance.row_mut(n + joint).scale_mut(decay);
            self.covariance.column_mut(n + joint).scale_mut(decay);
            let lever = match &driven {
                Some(slopes) => slopes.column(joint).norm_squared(),
                None if stuck => 0.0,
                None => reach(&self.mechanism, joint).powi(2),
            };
            let density =
                FORCE_DENSITY * self.mechanism.noise_scale * self.unease * lever / self.inertias[joint].powi(2);
            self.covariance[(n + joint, n + joint)] += density * span;
            self.covariance[(joint, joint)] += density * span.powi(3) / 3.0;
            self.covariance[(n + joint, joint)] += density * span.powi(2) / 2.0;
            self.covariance[(joint, n + joint)] += density * span.powi(2) / 2.0;
        }
    }

    /// M_jj where the filter started \[kg or kg·m²\].
    pub(super) fn inertia(&self, joint: usize) -> f64 {
        self.inertias[joint]
    }

    fn forget_rates(&mut self, span: f64) {
        let n = self.mechanism.joints.len();
        let decay = (-span / STUCK_MEMORY).exp();
        for joint in n..2 * n {
            self.covariance.row_mut(joint).scale_mut(decay);
            self.covariance.column_mut(joint).scale_mut(decay);
        }
    }

    /// Motion of the held point by each joint's rate \[m/s per its unit\]; columns of joints that do not
    /// carry it are zero.
    fn point_slopes(&mut self, held: &Held) -> DMatrix<f64> {
        let mechanism = Arc::clone(&self.mechanism);
        let screws = mechanism.tree.screws(&self.state.positions);
        let displacement = mechanism.tree.displacements(&self.state.positions)[held.body];
        let point = displacement.transform_point(&held.point);
        let mut slopes = DMatrix::zeros(3, mechanism.joints.len());
        for joint in mechanism.chain(held.body) {
            let Spatial { angular, linear } = screws[joint];
            slopes.column_mut(joint).copy_from(&(angular.cross(&point) + linear));
        }
        slopes
    }

    /// Corrects by the tool's position \[m\] with its noise; false if the held part cannot be there.
    pub fn correct_by_tool(&mut self, tool_in_world: &Vector3<f64>, sigma_m: f64) -> bool {
        let Some(held) = self.held else { return false };
        let n = self.mechanism.joints.len();
        let displacement = self.mechanism.tree.displacements(&self.state.positions)[held.body];
        let innovation = tool_in_world - self.mechanism.tool_offset - displacement.transform_point(&held.point);
        let mut jacobian = DMatrix::zeros(3, 2 * n + 3);
        jacobian.view_mut((0, 0), (3, n)).copy_from(&self.point_slopes(&held));
        jacobian.view_mut((0, 2 * n), (3, 3)).copy_from(&displacement.rotation);
        let noise = Matrix3::identity() * (sigma_m * sigma_m + HELD_DEVIATION.powi(2));
        let spread =
            SMatrix::<f64, 3, 3>::from_iterator((&jacobian * &self.covariance * jacobian.transpose()).iter().copied())
                + noise;
        let Some(inverse) = spread.try_inverse() else { return false };
        let squared = innovation.dot(&(inverse * innovation));
        let slopes = jacobian.view((0, 0), (3, n)).into_owned();
        if squared > GATE && !self.give_way(&slopes, &innovation) {
            return false;
        }
        self.surprise += SURPRISE_SHARE * ((squared / 3.0).min(GATE) - self.surprise);
        self.unease = if self.surprise > SURPRISED {
            (self.unease * 1.5).min(MOST_UNEASE)
        } else {
            (self.unease * 0.97).max(1.0)
        };
        let spread =
            SMatrix::<f64, 3, 3>::from_iterator((&jacobian * &self.covariance * jacobian.transpose()).iter().copied())
                + noise;
        let Some(inverse) = spread.try_inverse() else { return false };
        let inverse = DMatrix::from_column_slice(3, 3, inverse.as_slice());
        self.correct(&jacobian, &inverse, &DVector::from_column_slice(innovation.as_slice()));
        true
    }

    /// Widens the joints' covariance where their motion explains an innovation beyond the gate [m].
    fn give_way(&mut self, slopes: &DMatrix<f64>, innovation: &Vector3<f64>) -> bool {
        let n = self.mechanism.joints.len();
        let normal = slopes.transpose() * slopes + DMatrix::identity(n, n) * 1e-6;
        let Some(cholesky) = normal.cholesky() else { return false };
        let change = cholesky.solve(&(slopes.transpose() * innovation));
        let left = innovation - slopes * &change;
        if left.norm() > EXPLAINED.max(0.3 * innovation.norm()) || innovation.norm() > FURTHEST {
            return false;
        }
        for joint in 0..n {
            self.covariance[(joint, joint)] += change[joint].powi(2);
            self.covariance[(n + joint, n + joint)] += (change[joint] / 0.05).powi(2);
        }
        true
    }

    /// Corrects by a cloud's pose of a part; nothing for a part without a joint.
    pub fn correct_by_pose(&mut self, label: Label, measurement: &PoseMeasurement) {
        let Some(body) = self.mechanism.body(label) else { return };
        let mechanism = Arc::clone(&self.mechanism);
        let n = mechanism.joints.len();
        let center = mechanism.joints[body].center;
        let displacement = mechanism.tree.displacements(&self.state.positions)[body];
        let to_part = Pose::from_translation(-center) * measurement.displacement.inverse();
        let residual = (to_part * displacement * Pose::from_translation(center)).log();
        let screws = mechanism.tree.screws(&self.state.positions);
        let mut jacobian = DMatrix::zeros(6, 2 * n + 3);
        for joint in mechanism.chain(body) {
            let Spatial { angular, linear } = screws[joint];
            let screw = Vector6::new(angular.x, angular.y, angular.z, linear.x, linear.y, linear.z);
            jacobian.column_mut(joint).copy_from(&to_part.adjoint(&screw));
        }
        let radius = mechanism.joints[body].radius.max(0.02);
        let shared = Vector6::new(1.0 / radius, 1.0 / radius, 1.0 / radius, 1.0, 1.0, 1.0) * SHARED_ERROR;
        let unseen = Vector6::new(1.0, 1.0, 1.0, 1.0, 1.0, 1.0);
        let Some(own) = (measurement.information + Matrix6::from_diagonal(&unseen)).try_inverse() else { return };
        let noise = own + Matrix6::from_diagonal(&shared.map(|s| s * s));
        let spread =
            SMatrix::<f64, 6, 6>::from_iterator((&jacobian * &self.covariance * jacobian.transpose()).iter().copied())
                + noise;
        let Some(mut inverse) = spread.try_inverse() else { return };
        let innovation = SVector::<f64, 6>::from(-residual);
        if innovation.dot(&(inverse * innovation)) > GATE {
            for joint in mechanism.chain(body) {
                let reach = reach(&mechanism, joint);
                self.covariance[(joint, joint)] += (0.01 / reach).powi(2);
                self.covariance[(n + joint, n + joint)] += (0.05 / reach).powi(2);
            }
            let spread = SMatrix::<f64, 6, 6>::from_iterator(
                (&jacobian * &self.covariance * jacobian.transpose()).iter().copied(),
            ) + noise;
            let Some(wider) = spread.try_inverse() else { return };
            inverse = wider;
        }
        let inverse = DMatrix::from_column_slice(6, 6, inverse.as_slice());
        self.correct(&jacobian, &inverse, &DVector::from_column_slice(innovation.as_slice()));
    }

    /// x ← x + P Hᵀ S⁻¹ z, P ← P − P Hᵀ S⁻¹ H P.
    fn correct(&mut self, jacobian: &DMatrix<f64>, inverse: &DMatrix<f64>, innovation: &DVector<f64>) {
        let n = self.mechanism.joints.len();
        let cross = &self.covariance * jacobian.transpose();
        let gain = &cross * inverse;
        let change = &gain * innovation;
        for joint in 0..n {
            self.state.positions[joint] += change[joint];
            self.state.rates[joint] += change[n + joint];
        }
        if let Some(held) = &mut self.held {
            held.point += Vector3::new(change[2 * n], change[2 * n + 1], change[2 * n + 2]);
        }
        self.covariance -= &gain * cross.transpose();
        self.covariance = (&self.covariance + self.covariance.transpose()) * 0.5;
        for i in 0..self.covariance.nrows() {
            self.covariance[(i, i)] = self.covariance[(i, i)].max(0.0);
        }
    }
}

/// Puts resting joints back.
pub(super) fn keep(resting: &[(usize, f64)], state: &mut State<f64>) {
    for &(joint, position) in resting {
        state.positions[joint] = position;
        state.rates[joint] = 0.0;
    }
}

/// Motion of a part's points by its joint's unit: 1 on a slide, metres on a hinge.
pub(super) fn reach(mechanism: &TrackedMechanism, joint: usize) -> f64 {
    let KinematicReach { distance, radius } = distance_of(mechanism, joint);
    distance.map_or(1.0, |distance| distance.hypot(radius).max(0.05))
}

struct KinematicReach {
    distance: Option<f64>,
    radius: f64,
}

fn distance_of(mechanism: &TrackedMechanism, joint: usize) -> KinematicReach {
    let kinematic = &mechanism.joints[joint];
    let revolute = kinematic.joint_type == crate::mechanism::JointType::Revolute;
    let across = skew(&kinematic.axis.direction) * (kinematic.center - kinematic.axis.point);
    KinematicReach { distance: revolute.then(|| across.norm()), radius: kinematic.radius }
}
