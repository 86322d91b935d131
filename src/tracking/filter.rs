//! An extended Kalman filter over joint positions, rates, the point that the tool holds, an unexplained
//! force on each joint, and the numbers of the dynamics.
//!
//! Mean by simulation: ẋ = (q̇, M⁻¹(τ + u − d q̇ + λ + Jᵀ w − c − g)), so that friction sticks: a joint that
//! no force moves stays exactly where it is. u fades as e^(−t/T) and is driven by white noise
//! (Ornstein–Uhlenbeck); friction, damping, inertia and the rest start from the posterior and move with
//! what the tool shows. Covariance by statistical linearization: central differences of the simulation,
//! one standard deviation to both sides, so that stick and slip are seen from either side (Gelb,
//! "Applied Optimal Estimation", 1974, section 6.2). Process noise: the white generalized force that the
//! wrench sensor's noise makes, times κ for what the model misses.
//! Corrections: x − o = D(q) p by the tool, log(T(−c) D_obs⁻¹ D(q) T(c)) = 0 by every cloud.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, SMatrix, SVector, Vector3, Vector6};

use super::mechanism::TrackedMechanism;
use super::simulation::{DISTURBANCE_MEMORY, Drive};
use crate::math::Pose;
use crate::mechanism::{Spatial, State, Tree, Workspace, WrenchSample};
use crate::model::PoseMeasurement;
use crate::types::Label;

/// Longest step \[s\].
pub(super) const STEP: f64 = 0.004;
/// Longest span that is linearized at once \[s\].
const LINEAR: f64 = 0.1;
/// Density of the white force that moves a held part beside what was read \[N²·s\]: a sensor of .1 N at
/// 125 Hz.
pub(super) const FORCE_DENSITY: f64 = 0.1 * 0.1 * 0.008;
/// Standard deviation of the unexplained force in units of the joint's friction ...
const DISTURBANCE: f64 = 0.1;
/// ... and how much of the unease raises its variance. No more than the friction itself goes unexplained:
/// what it holds, it goes on holding.
const MOST_DISTURBED: f64 = 9.0;
/// Logarithms of friction, damping and inertia wander by this in a second.
const NUMBER_DRIFT: f64 = 0.02;
/// The posterior's logarithms are not trusted beyond this, nor carry a linearization further than that.
const NUMBER_DEVIATION: (f64, f64) = (0.03, 0.7);
/// A stuck joint forgets how its rate may be wrong within this \[s\].
const STUCK_MEMORY: f64 = 0.03;
/// Registration error that the frames share \[m\].
const SHARED_ERROR: f64 = 0.004;
/// A lost part is looked for along its joint in steps of this \[m\], this far beyond where it was seen
/// \[m\], at no more places than so many.
const SEARCH_STEP: f64 = 0.01;
const SEARCH_BEYOND: f64 = 0.1;
const MOST_PLACES: usize = 120;
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
/// χ² of three numbers beyond which a tool that does not push says nothing of the part, which may have left
/// it: one in a hundred.
const LET_GO: f64 = 11.3;
/// No part of an object that arms move is faster than this \[m/s\]: it is what falls by one metre.
pub(super) const FASTEST: f64 = 4.4;
/// A joint is no further than this beyond where measurements have had it \[m\], nor a held point from
/// where it was taken hold of: what is left of doubt is looked for, not integrated.
pub(super) const LEASH: f64 = 0.5;
/// The tool's track moves no number of the dynamics further than this from its posterior.
const NUMBER_FURTHEST: f64 = 2.0;

/// What the tool holds.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Held {
    /// The body.
    pub body: usize,
    /// Where, at the reference configuration \[m\].
    pub point: Vector3<f64>,
}

/// What a simulation starts from.
pub(super) struct Start {
    pub tree: Tree<f64>,
    pub state: State<f64>,
    pub disturbance: Vec<f64>,
    pub held: Option<Held>,
}

/// Positions and rates of all joints with their covariance.
#[derive(Clone, Debug)]
pub struct Filter {
    pub(super) mechanism: Arc<TrackedMechanism>,
    pub(super) time_s: f64,
    pub(super) state: State<f64>,
    /// Unexplained force on each joint \[N or N·m\].
    pub(super) disturbance: Vec<f64>,
    /// The dynamics' numbers ...
    pub(super) numbers: DVector<f64>,
    /// ... and their tree.
    pub(super) tree: Tree<f64>,
    /// Whether the tool's track moves the numbers.
    adapts: bool,
    /// Of (positions, rates, held point, disturbance, active numbers).
    pub(super) covariance: DMatrix<f64>,
    pub(super) held: Option<Held>,
    /// The held point as it was when the tool took hold of it.
    first_held: Vector3<f64>,
    workspace: Workspace<f64>,
    inertias: Vec<f64>,
    /// Factor on the process noise while innovations are larger than expected.
    pub(super) unease: f64,
    /// Running mean of the tool's squared innovations in units of their variance.
    surprise: f64,
    /// Joints that what is held does not follow.
    pub(super) distrusted: Vec<bool>,
    /// Least and greatest position of each joint so far.
    pub(super) explored: Vec<[f64; 2]>,
    /// Rate of each joint when clouds or the tool last corrected it: what nothing drives goes no faster.
    corrected_rates: Vec<f64>,
    cursor: usize,
}

/// Standard deviation of the unexplained force on a joint \[N or N·m\].
fn disturbance_deviation(mechanism: &TrackedMechanism, tree: &Tree<f64>, joint: usize) -> f64 {
    (DISTURBANCE * tree.bodies()[joint].parameters.friction).hypot(mechanism.unexplained[joint])
}

/// Lowers the standard deviation of one coordinate to `most` where it is larger, its correlations as they
/// are; one that is no number becomes `most` and correlates with nothing.
pub(super) fn limit_deviation(covariance: &mut DMatrix<f64>, at: usize, most: f64) {
    if !covariance.row(at).iter().chain(covariance.column(at).iter()).all(|x| x.is_finite()) {
        covariance.row_mut(at).fill(0.0);
        covariance.column_mut(at).fill(0.0);
        covariance[(at, at)] = most * most;
        return;
    }
    let deviation = covariance[(at, at)].max(0.0).sqrt();
    if deviation > most {
        covariance.row_mut(at).scale_mut(most / deviation);
        covariance.column_mut(at).scale_mut(most / deviation);
    }
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
        let count = mechanism.active.len();
        let mut covariance = DMatrix::zeros(3 * n + 3 + count, 3 * n + 3 + count);
        let inertias = mechanism.tree.mass_matrix(&positions).diagonal().iter().map(|m| m.max(1e-9)).collect();
        for joint in 0..n {
            let reach = mechanism.reach(joint);
            covariance[(joint, joint)] = (deviation / reach).powi(2);
            covariance[(n + joint, n + joint)] =
                if rates[joint] == 0.0 { 0.0 } else { (rate_deviation / reach).powi(2) };
            covariance[(2 * n + 3 + joint, 2 * n + 3 + joint)] =
                disturbance_deviation(&mechanism, &mechanism.tree, joint).powi(2);
        }
        let start_of_numbers = 3 * n + 3;
        covariance.view_mut((start_of_numbers, start_of_numbers), (count, count)).copy_from(&mechanism.covariance);
        for i in start_of_numbers..start_of_numbers + count {
            covariance[(i, i)] += NUMBER_DEVIATION.0.powi(2);
        }
        let workspace = Workspace::new(&mechanism.tree);
        let corrected_rates = rates.iter().map(|rate| rate.abs()).collect();
        let state = State::new(positions, rates);
        Self {
            explored: mechanism.explored.clone(),
            corrected_rates,
            distrusted: vec![false; n],
            disturbance: vec![0.0; n],
            numbers: mechanism.numbers.clone(),
            tree: mechanism.tree.clone(),
            adapts: true,
            mechanism,
            time_s,
            state,
            covariance,
            held: None,
            first_held: Vector3::zeros(),
            workspace,
            inertias,
            unease: 1.0,
            surprise: 1.0,
            cursor: 0,
        }
    }

    /// Whether the tool's track may move the numbers of the dynamics: not where the posterior has seen it.
    pub fn set_adapting(&mut self, adapts: bool) {
        self.adapts = adapts;
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

    /// The dynamics' numbers as the tool's track has moved them.
    pub fn numbers(&self) -> &DVector<f64> {
        &self.numbers
    }

    /// What the tool holds.
    pub fn held(&self) -> Option<Held> {
        self.held
    }

    /// Joints that stay: at rest, not between the world and what is held, and carried by nothing that moves,
    /// whose jerks they would feel. Friction holds them, or they would not rest; a model that says otherwise
    /// is wrong.
    pub(super) fn resting(&self) -> Vec<(usize, f64)> {
        let moving = self.moving_joints();
        let joints = (0..self.mechanism.joints.len()).filter(|joint| !moving.contains(joint));
        joints.map(|joint| (joint, self.state.positions[joint])).collect()
    }

    /// Displacements of the parts whose joints are trusted.
    pub fn trusted_parts(&self) -> BTreeMap<Label, Pose> {
        let displacements = self.mechanism.tree.displacements(&self.state.positions);
        let joints = self.mechanism.joints.iter().zip(displacements).enumerate();
        joints
            .filter(|(body, _)| !self.mechanism.chain(*body).iter().any(|joint| self.distrusted[*joint]))
            .map(|(_, (joint, displacement))| (joint.child, displacement))
            .collect()
    }

    /// The rate of a body's joint at which its centre of mass would go at a velocity in world \[m/s\], as far
    /// as it can.
    pub fn rate_of(&self, body: usize, velocity: &Vector3<f64>) -> f64 {
        let tree = &self.mechanism.tree;
        let center = tree.displacements(&self.state.positions)[body].transform_point(&self.mechanism.centers[body]);
        let Spatial { angular, linear } = tree.screws(&self.state.positions)[body];
        let slope = angular.cross(&center) + linear;
        slope.dot(velocity) / slope.norm_squared().max(1e-6)
    }

    /// Positions of a body's joint all through where it was seen and somewhat beyond, with the body's
    /// displacement there.
    pub fn places_along(&self, body: usize) -> Vec<(f64, Pose)> {
        let [low, high] = self.explored[body];
        let step = SEARCH_STEP / self.mechanism.reach(body);
        let beyond = SEARCH_BEYOND / self.mechanism.reach(body);
        let count = (((high - low + 2.0 * beyond) / step).ceil().max(1.0) as usize).min(MOST_PLACES);
        let joint = &self.mechanism.joints[body];
        let displacements = self.mechanism.tree.displacements(&self.state.positions);
        let above = joint.parent.map_or_else(Pose::identity, |parent| displacements[parent]);
        (0..=count)
            .map(|i| low - beyond + (high - low + 2.0 * beyond) * i as f64 / count as f64)
            .map(|q| (q, above * joint.screw().displacement(q)))
            .collect()
    }

    /// Puts a body's joint at a position where it was found, with the rate that it was found to have; what
    /// holds it must take hold anew.
    pub fn place(&mut self, body: usize, position: f64, rate: f64) {
        let n = self.mechanism.joints.len();
        if self.held.is_some_and(|held| self.mechanism.chain(held.body).contains(&body)) {
            self.release();
        }
        self.state.positions[body] = position;
        self.state.rates[body] = rate;
        self.corrected_rates[body] = rate.abs();
        self.state = State::new(self.state.positions.clone(), self.state.rates.clone());
        for at in [body, n + body] {
            self.covariance.row_mut(at).fill(0.0);
            self.covariance.column_mut(at).fill(0.0);
        }
        self.covariance[(body, body)] = (SEARCH_STEP / self.mechanism.reach(body)).powi(2);
        self.covariance[(n + body, n + body)] = (0.5 * rate).powi(2);
        self.bound();
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
        let displacements = self.mechanism.tree.displacements(&self.state.positions);
        let moving = self.moving_joints().into_iter();
        moving.map(|body| (self.mechanism.joints[body].child, displacements[body])).collect()
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
        let cross = &map * self.covariance.rows(0, n);
        let own = &map * self.covariance.view((0, 0), (n, n)) * map.transpose()
            + Matrix3::identity() * (sigma_m.powi(2) + HELD_DEVIATION.powi(2));
        self.covariance.rows_mut(2 * n, 3).copy_from(&cross);
        self.covariance.columns_mut(2 * n, 3).copy_from(&cross.transpose());
        self.covariance.view_mut((2 * n, 2 * n), (3, 3)).copy_from(&own);
    }

    /// The tool holds a known point of a part, at the reference configuration.
    pub fn hold_point(&mut self, body: usize, point: Vector3<f64>, sigma_m: f64) {
        self.release();
        self.held = Some(Held { body, point });
        self.first_held = point;
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
        if to_s <= self.time_s {
            return;
        }
        if self.rests() {
            let span = to_s - self.time_s;
            self.time_s = to_s;
            self.forget_rates(span);
            self.fade(span);
            return;
        }
        let delay_s = self.mechanism.sensor.delay_s;
        let first = samples.partition_point(|s| s.stamp_s < self.time_s - 0.05 + delay_s.min(0.0));
        let last = samples.partition_point(|s| s.stamp_s <= to_s + 0.02 + delay_s.max(0.0));
        let samples = &samples[first..last.max(first)];
        self.cursor = 0;
        let pieces = ((to_s - self.time_s) / LINEAR - 1e-6).ceil().max(1.0) as usize;
        let from_s = self.time_s;
        for piece in 1..=pieces {
            let end_s = if piece == pieces { to_s } else { from_s + (to_s - from_s) * piece as f64 / pieces as f64 };
            self.advance_piece(end_s, samples);
        }
    }

    fn advance_piece(&mut self, to_s: f64, samples: &[WrenchSample]) {
        let n = self.mechanism.joints.len();
        let span = [self.time_s, to_s];
        let joints = self.moving_joints();
        let resting = self.resting();
        let sensor = self.mechanism.sensor;
        let drive = Drive { held: self.held, samples, sensor, resting: &resting, step_s: STEP };
        let coordinates = self.coordinates_of(&joints);
        // (q, q̇) of the moving joints by each of their coordinates.
        let mut slopes = DMatrix::zeros(2 * joints.len(), coordinates.len());
        for (column, &at) in coordinates.iter().enumerate() {
            let deviation = self.covariance[(at, at)].max(0.0).sqrt();
            let size = deviation.min(self.largest_step(at));
            if size < 1e-9 {
                if at < 2 * n {
                    let own = joints.iter().position(|&joint| joint == at % n).map(|k| k + (at / n) * joints.len());
                    own.into_iter().for_each(|row| slopes[(row, column)] = 1.0);
                }
                continue;
            }
            let ends = [size, -size].map(|change| self.run_changed(at, change, &drive, span));
            let [Some(plus), Some(minus)] = ends else { continue };
            for (k, &joint) in joints.iter().enumerate() {
                slopes[(k, column)] = (plus.positions[joint] - minus.positions[joint]) / (2.0 * size);
                slopes[(joints.len() + k, column)] = (plus.rates[joint] - minus.rates[joint]) / (2.0 * size);
            }
        }
        let mut cursor = self.cursor;
        let before = self.state.positions.clone();
        let disturbance = self.disturbance.clone();
        let scratch = (&mut self.workspace, &mut cursor);
        drive.run(&mut self.tree, &mut self.state, span, &disturbance, scratch);
        self.cursor = cursor;
        self.time_s = to_s;
        if !self.state.positions.iter().chain(&self.state.rates).all(|x| x.is_finite()) {
            let count = before.len();
            self.state = State::new(before, vec![0.0; count]);
        }
        self.grow(&joints, &coordinates, &slopes, span[1] - span[0]);
        self.fade(span[1] - span[0]);
        self.bound();
    }

    /// Keeps the state to what parts can do, and its spread to what may be doubted: a simulation of numbers
    /// that no part has, or a correction by a covariance that is nearly singular, leads anywhere.
    fn bound(&mut self) {
        let n = self.mechanism.joints.len();
        let (mut positions, mut rates) = (self.state.positions.clone(), self.state.rates.clone());
        for joint in 0..n {
            let (least, most) = self.farthest(joint);
            let fastest = FASTEST / self.mechanism.reach(joint);
            positions[joint] = positions[joint].clamp(least, most);
            rates[joint] = rates[joint].clamp(-fastest, fastest);
            // What has come to its leash goes no further.
            let outward =
                (positions[joint] <= least && rates[joint] < 0.0) || (positions[joint] >= most && rates[joint] > 0.0);
            if outward {
                rates[joint] = 0.0;
            }
        }
        if positions != self.state.positions || rates != self.state.rates {
            self.state = State::new(positions, rates);
        }
        if let Some(held) = &mut self.held {
            let way = held.point - self.first_held;
            let size = way.norm();
            if size > LEASH {
                held.point = self.first_held + way * (LEASH / size);
            }
        }
        for at in 0..self.covariance.nrows() {
            let most = if at < n {
                LEASH / self.mechanism.reach(at)
            } else if at < 2 * n {
                FASTEST / self.mechanism.reach(at - n)
            } else if at < 2 * n + 3 {
                LEASH
            } else if at < 3 * n + 3 {
                continue;
            } else {
                NUMBER_FURTHEST
            };
            limit_deviation(&mut self.covariance, at, most);
        }
    }

    /// Least and greatest position that a joint can be at, by where measurements have had it.
    pub(super) fn farthest(&self, joint: usize) -> (f64, f64) {
        let leash = LEASH / self.mechanism.reach(joint);
        let [low, high] = self.explored[joint];
        (low - leash, high + leash)
    }

    /// A measurement had these joints where they are.
    fn confirm(&mut self, joints: &[usize]) {
        for &joint in joints {
            let q = self.state.positions[joint];
            let seen = &mut self.explored[joint];
            *seen = [seen[0].min(q), seen[1].max(q)];
        }
    }

    /// Joints between the world and what is held, those with a rate, and those that either carries.
    pub(super) fn moving_joints(&self) -> Vec<usize> {
        let driven = self.held.map(|held| self.mechanism.chain(held.body)).unwrap_or_default();
        let moves = |joint: usize| driven.contains(&joint) || self.state.rates[joint] != 0.0;
        let chain = |joint: &usize| self.mechanism.chain(*joint);
        (0..self.mechanism.joints.len()).filter(|joint| chain(joint).into_iter().any(moves)).collect()
    }

    /// Places of positions, rates, disturbances and numbers of some joints.
    pub(super) fn coordinates_of(&self, joints: &[usize]) -> Vec<usize> {
        let n = self.mechanism.joints.len();
        let of_numbers = self.mechanism.active.iter().enumerate().filter(|(_, number)| joints.contains(&number.joint));
        let states = [0, n, 2 * n + 3].into_iter().flat_map(|first| joints.iter().map(move |joint| first + joint));
        states.chain(of_numbers.map(|(i, _)| 3 * n + 3 + i)).collect()
    }

    /// How far a coordinate may be moved in one linearization.
    pub(super) fn largest_step(&self, at: usize) -> f64 {
        let n = self.mechanism.joints.len();
        if at < 2 * n {
            let reach = self.mechanism.reach(at % n);
            if at < n { 0.02 / reach } else { 0.3 / reach }
        } else if at < 3 * n + 3 {
            f64::INFINITY
        } else {
            NUMBER_DEVIATION.1
        }
    }

    /// The state after a span if one coordinate were other by `change`; `None` if no tree is so.
    fn run_changed(&self, at: usize, change: f64, drive: &Drive<'_>, span: [f64; 2]) -> Option<State<f64>> {
        let Start { mut tree, mut state, disturbance, .. } = self.start(&[(at, change)])?;
        let mut workspace = Workspace::new(&tree);
        let mut cursor = 0;
        drive.run(&mut tree, &mut state, span, &disturbance, (&mut workspace, &mut cursor));
        state.positions.iter().chain(&state.rates).all(|x| x.is_finite()).then_some(state)
    }

    /// What a simulation starts from, some coordinates changed; `None` if no tree is so.
    pub(super) fn start(&self, changes: &[(usize, f64)]) -> Option<Start> {
        let n = self.mechanism.joints.len();
        let (mut positions, mut rates) = (self.state.positions.clone(), self.state.rates.clone());
        let mut disturbance = self.disturbance.clone();
        let mut held = self.held;
        let mut numbers: Option<DVector<f64>> = None;
        for &(at, change) in changes {
            if at < n {
                positions[at] += change;
            } else if at < 2 * n {
                rates[at - n] += change;
            } else if at < 2 * n + 3 {
                held.iter_mut().for_each(|held| held.point[at - 2 * n] += change);
            } else if at < 3 * n + 3 {
                disturbance[at - 2 * n - 3] += change;
            } else {
                let place = self.mechanism.active[at - 3 * n - 3].place;
                numbers.get_or_insert_with(|| self.numbers.clone())[place] += change;
            }
        }
        let tree = match numbers {
            Some(numbers) => self.mechanism.trees.tree(&numbers)?,
            None => self.tree.clone(),
        };
        Some(Start { tree, state: State::new(positions, rates), disturbance, held })
    }

    /// The covariance over a span \[s\]: P ← F P Fᵀ + Q.
    fn grow(&mut self, joints: &[usize], coordinates: &[usize], slopes: &DMatrix<f64>, span: f64) {
        let n = self.mechanism.joints.len();
        let rows: Vec<usize> = joints.iter().copied().chain(joints.iter().map(|joint| n + joint)).collect();
        let moved = slopes * self.covariance.select_rows(coordinates);
        for (k, &row) in rows.iter().enumerate() {
            self.covariance.row_mut(row).copy_from(&moved.row(k));
        }
        let moved = self.covariance.select_columns(coordinates) * slopes.transpose();
        for (k, &row) in rows.iter().enumerate() {
            self.covariance.column_mut(row).copy_from(&moved.column(k));
        }
        let driven = self.held.map(|held| self.point_slopes(&held));
        for &joint in joints {
            let stuck = self.state.rates[joint] == 0.0;
            if stuck {
                let decay = (-span / STUCK_MEMORY).exp();
                self.covariance.row_mut(n + joint).scale_mut(decay);
                self.covariance.column_mut(n + joint).scale_mut(decay);
            }
            let lever = match &driven {
                Some(slopes) => slopes.column(joint).norm_squared(),
                None if stuck => 0.0,
                None => self.mechanism.reach(joint).powi(2),
            };
            let density =
                FORCE_DENSITY * self.mechanism.noise_scale * self.unease * lever / self.inertias[joint].powi(2);
            self.covariance[(n + joint, n + joint)] += density * span;
            self.covariance[(joint, joint)] += density * span.powi(3) / 3.0;
            self.covariance[(n + joint, joint)] += density * span.powi(2) / 2.0;
            self.covariance[(joint, n + joint)] += density * span.powi(2) / 2.0;
        }
        for (i, number) in self.mechanism.active.iter().enumerate() {
            if joints.contains(&number.joint) {
                self.covariance[(3 * n + 3 + i, 3 * n + 3 + i)] += NUMBER_DRIFT.powi(2) * span;
            }
        }
    }

    /// Disturbances over a span \[s\]: u ← α u, with the noise that keeps their spread.
    fn fade(&mut self, span: f64) {
        let n = self.mechanism.joints.len();
        let faded = (-span / DISTURBANCE_MEMORY).exp();
        for joint in 0..n {
            let at = 2 * n + 3 + joint;
            self.disturbance[joint] *= faded;
            self.covariance.row_mut(at).scale_mut(faded);
            self.covariance.column_mut(at).scale_mut(faded);
            let stationary =
                disturbance_deviation(&self.mechanism, &self.tree, joint).powi(2) * self.unease.min(MOST_DISTURBED);
            self.covariance[(at, at)] += stationary * (1.0 - faded * faded);
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
        self.correct_by_point(tool_in_world, sigma_m, true)
    }

    /// The same by a tool that does not push: the part may have left it, and then it says nothing.
    pub fn correct_by_idle_tool(&mut self, tool_in_world: &Vector3<f64>, sigma_m: f64) -> bool {
        self.correct_by_point(tool_in_world, sigma_m, false)
    }

    fn correct_by_point(&mut self, tool_in_world: &Vector3<f64>, sigma_m: f64, pushes: bool) -> bool {
        let Some(held) = self.held else { return false };
        let n = self.mechanism.joints.len();
        let displacement = self.mechanism.tree.displacements(&self.state.positions)[held.body];
        let innovation = tool_in_world - self.mechanism.tool_offset - displacement.transform_point(&held.point);
        let mut jacobian = DMatrix::zeros(3, self.covariance.nrows());
        jacobian.view_mut((0, 0), (3, n)).copy_from(&self.point_slopes(&held));
        jacobian.view_mut((0, 2 * n), (3, 3)).copy_from(&displacement.rotation);
        let noise = Matrix3::identity() * (sigma_m * sigma_m + HELD_DEVIATION.powi(2));
        let spread =
            SMatrix::<f64, 3, 3>::from_iterator((&jacobian * &self.covariance * jacobian.transpose()).iter().copied())
                + noise;
        let Some(inverse) = spread.try_inverse() else { return false };
        let squared = innovation.dot(&(inverse * innovation));
        let slopes = jacobian.view((0, 0), (3, n)).into_owned();
        if !pushes && squared > LET_GO {
            return false;
        }
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
        // Of several joints it does not tell which has moved.
        if let [joint] = self.mechanism.chain(held.body)[..] {
            self.confirm(&[joint]);
        }
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
        let mut jacobian = DMatrix::zeros(6, self.covariance.nrows());
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
        let surprising = innovation.dot(&(inverse * innovation)) > GATE;
        if surprising {
            for joint in mechanism.chain(body) {
                let reach = mechanism.reach(joint);
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
        let before = self.state.rates.clone();
        self.correct(&jacobian, &inverse, &DVector::from_column_slice(innovation.as_slice()));
        // What nothing drives does not speed up because a scan was matched elsewhere; but it may coast
        // further than the model's friction lets it.
        let driven = self.held.map(|held| self.mechanism.chain(held.body)).unwrap_or_default();
        for joint in (0..n).filter(|joint| !driven.contains(joint)) {
            let most = self.corrected_rates[joint].max(before[joint].abs());
            self.state.rates[joint] = self.state.rates[joint].clamp(-most, most);
        }
        self.state = State::new(self.state.positions.clone(), self.state.rates.clone());
        for joint in 0..n {
            self.corrected_rates[joint] = self.state.rates[joint].abs();
        }
        if !surprising {
            self.confirm(&mechanism.chain(body));
        }
    }

    /// x ← x + K z, K = P Hᵀ S⁻¹; where the numbers are only considered their rows of K are zero
    /// (Schmidt 1966), so P ← P − K H P − (K H P)ᵀ + K S Kᵀ.
    fn correct(&mut self, jacobian: &DMatrix<f64>, inverse: &DMatrix<f64>, innovation: &DVector<f64>) {
        let n = self.mechanism.joints.len();
        let cross = &self.covariance * jacobian.transpose();
        let mut gain = &cross * inverse;
        let numbers = 3 * n + 3;
        if !self.adapts {
            gain.rows_mut(numbers, self.mechanism.active.len()).fill(0.0);
        }
        let change = &gain * innovation;
        if !change.iter().all(|x| x.is_finite()) {
            return;
        }
        for joint in 0..n {
            self.state.positions[joint] += change[joint];
            self.state.rates[joint] += change[n + joint];
            let most = self.tree.bodies()[joint].parameters.friction + 3.0 * self.mechanism.unexplained[joint];
            let disturbance = self.disturbance[joint] + change[2 * n + 3 + joint];
            self.disturbance[joint] = disturbance.clamp(-most, most);
        }
        self.state = State::new(self.state.positions.clone(), self.state.rates.clone());
        if let Some(held) = &mut self.held {
            held.point += Vector3::new(change[2 * n], change[2 * n + 1], change[2 * n + 2]);
        }
        let Some(spread) = inverse.clone().try_inverse() else { return };
        let shown = &gain * cross.transpose();
        self.covariance += &gain * spread * gain.transpose() - &shown - shown.transpose();
        self.covariance = (&self.covariance + self.covariance.transpose()) * 0.5;
        for i in 0..self.covariance.nrows() {
            self.covariance[(i, i)] = self.covariance[(i, i)].max(0.0);
        }
        self.change_numbers(&change);
        self.bound();
    }

    fn change_numbers(&mut self, change: &DVector<f64>) {
        let first = 3 * self.mechanism.joints.len() + 3;
        let mut numbers = self.numbers.clone();
        for (i, number) in self.mechanism.active.iter().enumerate() {
            let moved = numbers[number.place] + change[first + i].clamp(-NUMBER_DEVIATION.1, NUMBER_DEVIATION.1);
            let mean = self.mechanism.numbers[number.place];
            numbers[number.place] = moved.clamp(mean - NUMBER_FURTHEST, mean + NUMBER_FURTHEST);
        }
        if numbers == self.numbers {
            return;
        }
        if let Some(tree) = self.mechanism.trees.tree(&numbers) {
            self.numbers = numbers;
            self.tree = tree;
        }
    }
}
