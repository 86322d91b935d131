//! Screw axes, joint positions, contact points and the tool's offset, jointly, from measured poses.
//!
//! For part j with parent i: D_j = D_i · exp(S_j q_j). A pose measurement contributes
//! r = log(T(−c) D_obs⁻¹ D_j T(c)) with its information; a contact contributes x − o − D_j p with the
//! contact point p free per contact and the tool's offset o shared by all. Moving the axis by a
//! small rigid motion δ moves exp(S q) by the left twist (I − Ad(exp(S q))) δ.
//!
//! Gauss–Newton with Student-t weights; each window's joint positions and contact points are
//! eliminated, so the cost is linear in the number of windows.

use std::cell::OnceCell;
use std::collections::BTreeMap;
use std::rc::Rc;

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector2, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::window::{Contact, PoseMeasurement, WindowObservations, with_shared_error};
use crate::math::{Pose, Screw, in_lengths, length_scale, orthonormal_pair};
use crate::mechanism::JointType;
use crate::registration::Suggestion;
use crate::types::Label;

/// Standard deviations \[m\] of the rigid error that the first look's faces share once the part has
/// turned (seen from another side, its silhouette and noise differ), and of the pose at which later faces
/// were added to a model.
const FACE_ERROR_SIGMA: [f64; 2] = [0.0015, 0.020];
/// A hinged part is seen from another side once it has turned; a sliding one keeps its side: √2 times the angle \[rad\].
const TURNED: f64 = 0.1;

/// How closely axes follow the faces they are aligned with \[rad\].
const ALIGNED_SIGMA: f64 = 0.007;
/// A reference pose's rotation that was not measured may be off by any angle: it does not matter \[rad⁻²\].
const UNMEASURED_INFORMATION: f64 = 1.0;
/// Information below this holds nothing, and pulls at nothing \[m⁻²\].
const SAYS_NOTHING: f64 = 100.0;
/// A window is tested for motion in this many blocks of frames.
const REST_BLOCKS: usize = 6;
/// Score at which rest is given up: far beyond χ² with `REST_BLOCKS` degrees of freedom, as frames
/// are not independent.
const REST_SCORE: f64 = 40.0;

/// A joint axis in world at the reference configuration.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Axis {
    /// Unit direction.
    pub direction: Vector3<f64>,
    /// The point of the axis nearest the child's reference point \[m\].
    pub point: Vector3<f64>,
}

impl Axis {
    /// This after small turns \[rad\] about the two directions across it, in the order of the fit's covariance.
    pub fn turned(&self, turn: &Vector2<f64>) -> Self {
        let (first, second) = orthonormal_pair(&self.direction);
        let direction = (self.direction + (first * turn.x + second * turn.y).cross(&self.direction)).normalize();
        Self { direction, ..*self }
    }
}

/// One joint of a hypothesis.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct KinematicJoint {
    /// Index of the parent's joint in the list, `None` where the parent never moves.
    pub parent: Option<usize>,
    /// The part it carries.
    pub child: Label,
    /// Prismatic or revolute.
    pub joint_type: JointType,
    /// Start value of the axis.
    pub axis: Axis,
    /// The child's reference point: poses are compared and rotations taken about it \[m\].
    pub center: Vector3<f64>,
    /// Length that makes rotations of the child comparable with translations \[m\].
    pub radius: f64,
    /// The nearest direction that the shape suggests for the axis (a face's normal), if any.
    pub suggested: Option<Suggestion>,
}

impl KinematicJoint {
    /// The screw of the joint's axis.
    pub fn screw(&self) -> Screw {
        match self.joint_type {
            JointType::Rigid => Screw::rigid(),
            JointType::Prismatic => Screw::prismatic(&self.axis.direction),
            JointType::Revolute => Screw::revolute(&self.axis.direction, &self.axis.point),
        }
    }

    /// The position \[m or rad\] at which the joint comes nearest to a displacement of the child
    /// against its parent; of a hinge's turns, the one nearest to `near`.
    pub fn position_of(&self, displacement: &Pose, near: f64) -> f64 {
        let direction = &self.axis.direction;
        match self.joint_type {
            JointType::Rigid => 0.0,
            JointType::Prismatic => direction.dot(&(displacement.transform_point(&self.center) - self.center)),
            JointType::Revolute => displacement.turn_about(direction, near),
        }
    }

    /// How many numbers its axis has.
    pub fn axis_parameters(&self) -> usize {
        match self.joint_type {
            JointType::Rigid => 0,
            JointType::Prismatic => 2,
            JointType::Revolute => 4,
        }
    }

    /// Standard deviation of the axis's distance from the reference point, per direction \[m\]: a
    /// hinge touches the part it carries.
    pub fn axis_point_prior(&self) -> f64 {
        2.0 * self.radius + 0.05
    }

    /// Rotation that takes the axis to the suggested direction, in the axis's own tangent
    /// coordinates \[rad\], with the information of that suggestion.
    ///
    /// Mechanisms are mostly built along faces, but not always: with even odds the axis is within
    /// `ALIGNED_SIGMA` of one of all suggestions, or anywhere. `spread` is the variance of the direction by
    /// the data alone \[rad²\].
    fn alignment(&self, spread: f64) -> Option<([f64; 2], f64)> {
        let Suggestion { direction, share } = self.suggested?;
        let suggested = direction * direction.dot(&self.axis.direction).signum();
        let turn = self.axis.direction.cross(&suggested);
        let (first, second) = orthonormal_pair(&self.axis.direction);
        let angle_squared = turn.norm_squared();
        let variance = ALIGNED_SIGMA.powi(2) + spread;
        let log_odds = share.ln() - 0.5 * angle_squared / variance - variance.ln();
        let share = 1.0 / (1.0 + (-log_odds).exp());
        Some(([turn.dot(&first), turn.dot(&second)], share / ALIGNED_SIGMA.powi(2)))
    }

    /// The axis's tangent twists: two rotations about its point, then two translations across it.
    fn axis_basis(&self) -> [Vector6<f64>; 4] {
        let (first, second) = orthonormal_pair(&self.axis.direction);
        [
            Screw::revolute(&first, &self.axis.point).0,
            Screw::revolute(&second, &self.axis.point).0,
            Screw::prismatic(&first).0,
            Screw::prismatic(&second).0,
        ]
    }

    /// Moves the axis along its tangent.
    fn retract(&mut self, step: &[f64]) {
        let (first, second) = orthonormal_pair(&self.axis.direction);
        let at = |i: usize| step.get(i).copied().unwrap_or(0.0);
        // A rotation by ω turns n into n + ω × n.
        let turn = first * at(0) + second * at(1);
        let direction = (self.axis.direction + turn.cross(&self.axis.direction)).normalize();
        let point = self.axis.point + first * at(2) + second * at(3);
        let along = direction.dot(&(self.center - point));
        self.axis = Axis { direction, point: point + direction * along };
    }
}

/// What is assumed of the measurements.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct KinematicSettings {
    /// Standard deviation of the tool's constant offset, per axis \[m\].
    pub tool_offset_sigma: f64,
    /// Registration error that frames at the same pose share \[m\].
    pub shared_error: f64,
    /// Frames within this distance share their registration error \[m\].
    pub shared_distance: f64,
    /// Registration error that goes with how a part is seen \[m\].
    pub view_error: f64,
    /// Over this distance views, and their errors, become others \[m\].
    pub view_distance: f64,
    /// Joint positions closer than this many standard deviations are one rest.
    pub rest_deviations: f64,
    /// Gauss–Newton steps at most.
    pub steps: usize,
    /// Degrees of freedom of the Student-t weights on whole pose measurements.
    pub student_freedom: f64,
}

impl Default for KinematicSettings {
    fn default() -> Self {
        Self {
            tool_offset_sigma: 0.003,
            shared_error: 0.003,
            shared_distance: 0.010,
            view_error: 0.004,
            view_distance: 0.1,
            rest_deviations: 2.0,
            steps: 15,
            student_freedom: 6.0,
        }
    }
}

/// The fitted kinematics.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct KinematicFit {
    /// The joints with their fitted axes.
    pub joints: Vec<KinematicJoint>,
    /// Joint positions by window, joint, frame.
    pub positions: Vec<Vec<Vec<f64>>>,
    /// Contact points at the reference configuration by window and contact \[m\].
    pub contact_points: Vec<Vec<Vector3<f64>>>,
    /// The tool's offset in world \[m\].
    pub tool_offset: Vector3<f64>,
    /// Covariance of all axis parameters, joint by joint, then twelve face errors a joint, then
    /// the tool's offset.
    pub covariance: DMatrix<f64>,
    /// Negative log density at the solution, up to constants of the data.
    pub cost: f64,
    /// Joint positions that moved from one frame to the next, by joint and window.
    pub moves: Vec<Vec<usize>>,
    /// What each window adds to the cost, priors apart.
    pub window_costs: Vec<f64>,
    /// By how much ln |information| of all that windows share would fall without each; none of an edge.
    pub window_information: Vec<f64>,
    /// Whether the last step was small.
    pub converged: bool,
}

impl KinematicFit {
    /// Displacement of every joint's child in a frame.
    pub fn displacements(&self, window: usize, frame: usize) -> Vec<Pose> {
        forward(&self.joints, |joint| self.positions[window][joint][frame])
    }

    /// First row of a joint's axis in the covariance.
    pub fn axis_offset(&self, joint: usize) -> usize {
        self.joints[..joint].iter().map(KinematicJoint::axis_parameters).sum()
    }
}

/// Displacements of all children, parents first in the list.
fn forward(joints: &[KinematicJoint], position: impl Fn(usize) -> f64) -> Vec<Pose> {
    let mut displacements: Vec<Pose> = Vec::with_capacity(joints.len());
    for (index, joint) in joints.iter().enumerate() {
        let parent = joint.parent.map_or_else(Pose::identity, |p| displacements[p]);
        displacements.push(parent * joint.screw().displacement(position(index)));
    }
    displacements
}

/// Fits axes and joint positions to the windows, from the joints' start axes and start positions
/// (by window, joint, frame). Parents come before their children in `joints`. A joint whose start
/// positions are all the same in a window rests in it: friction holds what is not pushed.
pub fn fit_kinematics(
    joints: Vec<KinematicJoint>,
    positions: Vec<Vec<Vec<f64>>>,
    windows: &[&WindowObservations],
    settings: &KinematicSettings,
) -> KinematicFit {
    let shared = SharedByFits::default();
    let (problem, cost, converged) = solved(Problem::new(joints, positions, windows, settings, &shared));
    problem.finish(cost, converged, true)
}

/// As [`fit_kinematics`] for one joint, without the windows' information; `shared` is that of other fits of
/// the same part to the same windows.
pub fn fit_edge(
    joint: KinematicJoint,
    positions: Vec<Vec<Vec<f64>>>,
    windows: &[&WindowObservations],
    settings: &KinematicSettings,
    shared: &SharedByFits,
) -> KinematicFit {
    let (problem, cost, converged) = solved(Problem::new(vec![joint], positions, windows, settings, shared));
    problem.finish(cost, converged, false)
}

/// What fits of the same parts to the same windows have in common, made by the first.
#[derive(Default)]
pub struct SharedByFits {
    /// Information of every measurement by itself.
    information: OnceCell<Rc<FaceInformation>>,
    /// [`Problem::view_error`] of every measurement.
    view_errors: OnceCell<FaceInformation>,
}

/// The optimum of a problem, its cost, and whether the last step was small.
fn solved(mut problem: Problem<'_>) -> (Problem<'_>, f64, bool) {
    let mut of_windows = problem.windows_cost();
    let mut damping = 1e-6;
    let mut converged = false;
    let mut tied = false;
    for step in 0..problem.settings.steps {
        if step == problem.settings.steps / 2 || (converged && !tied) {
            problem.share_errors();
            problem.free_movers();
            problem.tie_rests();
            of_windows = problem.windows_cost();
            tied = true;
            converged = false;
        }
        let systems = problem.linearize();
        problem.weigh_alignments(&systems);
        let cost_before = problem.prior_cost() + of_windows;
        let mut accepted = false;
        for _ in 0..6 {
            let trial = problem.stepped(&systems, damping);
            let trial_of_windows = trial.windows_cost();
            let trial_cost = trial.prior_cost() + trial_of_windows;
            if trial_cost.is_finite() && trial_cost <= cost_before + 1e-9 {
                converged = cost_before - trial_cost < 1e-6 * (1.0 + cost_before.abs());
                problem = trial;
                of_windows = trial_of_windows;
                damping = (damping * 0.2_f64).max(1e-9);
                accepted = true;
                break;
            }
            damping *= 20.0;
        }
        if !accepted {
            converged = true;
        }
        if converged && tied {
            break;
        }
    }
    let cost = problem.prior_cost() + of_windows;
    (problem, cost, converged)
}

/// One window's normal equations with its local unknowns still in.
struct WindowSystem {
    local: DMatrix<f64>,
    local_gradient: DVector<f64>,
    coupling: DMatrix<f64>,
    global: DMatrix<f64>,
    global_gradient: DVector<f64>,
}

/// By window, joint, frame and faces: the information of a measurement.
type FaceInformation = Vec<Vec<Vec<[Option<Matrix6<f64>>; 2]>>>;

#[derive(Clone)]
struct Problem<'a> {
    joints: Vec<KinematicJoint>,
    windows: &'a [&'a WindowObservations],
    settings: &'a KinematicSettings,
    positions: Vec<Vec<Vec<f64>>>,
    /// By window, joint, frame: which local unknown its position is.
    slots: Vec<Vec<Vec<usize>>>,
    /// By window: how many local position unknowns.
    slot_counts: Vec<usize>,
    /// By window, joint, frame: information after the error that frames at one pose share.
    information: Rc<FaceInformation>,
    /// By joint, as ξ about the center: the rigid error of the first look's faces away from where they
    /// were first seen, and that of the faces that came into view later.
    face_errors: Vec<[Vector6<f64>; 2]>,
    /// By joint: information of the suggested direction \[rad⁻²\].
    alignments: Vec<f64>,
    contact_points: Vec<Vec<Vector3<f64>>>,
    tool_offset: Vector3<f64>,
    by_label: BTreeMap<Label, usize>,
    /// By joint: the information of the pose that its child's displacements are counted from, where a
    /// pose topic measures them.
    references: Vec<Option<Matrix6<f64>>>,
    shared: &'a SharedByFits,
}

impl<'a> Problem<'a> {
    fn new(
        joints: Vec<KinematicJoint>,
        positions: Vec<Vec<Vec<f64>>>,
        windows: &'a [&'a WindowObservations],
        settings: &'a KinematicSettings,
        shared: &'a SharedByFits,
    ) -> Self {
        let by_label = joints.iter().enumerate().map(|(i, j)| (j.child, i)).collect();
        let reference = |j: &KinematicJoint| windows.iter().find_map(|w| w.direct.get(&j.child)).copied();
        let references = joints.iter().map(reference).collect();
        let mut problem = Self {
            joints,
            windows,
            settings,
            positions,
            slots: Vec::new(),
            slot_counts: Vec::new(),
            information: Rc::default(),
            face_errors: Vec::new(),
            alignments: Vec::new(),
            contact_points: Vec::new(),
            tool_offset: Vector3::zeros(),
            by_label,
            references,
            shared,
        };
        problem.alignments = vec![0.0; problem.joints.len()];
        problem.face_errors = vec![[Vector6::zeros(); 2]; problem.joints.len()];
        problem.separate_frames();
        let alone = || Rc::new(problem.informations(|_, _, _| 1.0));
        problem.information = Rc::clone(shared.information.get_or_init(alone));
        problem.contact_points = (0..windows.len()).map(|w| problem.initial_contact_points(w)).collect();
        problem
    }

    /// Every frame its own unknown, or one for a whole window where a joint rests.
    fn separate_frames(&mut self) {
        self.slots.clear();
        self.slot_counts.clear();
        for window in &self.positions {
            let mut next = 0;
            let mut slots = Vec::with_capacity(window.len());
            for positions in window {
                let resting = positions.windows(2).all(|pair| pair[0] == pair[1]);
                let count = if resting { 1 } else { positions.len() };
                slots.push((0..positions.len()).map(|k| next + k.min(count - 1)).collect());
                next += count;
            }
            self.slots.push(slots);
            self.slot_counts.push(next);
        }
    }

    fn initial_contact_points(&self, window: usize) -> Vec<Vector3<f64>> {
        self.windows[window]
            .contacts
            .iter()
            .map(|contact| {
                let mut sum = Vector3::zeros();
                for (frame, x, _) in &contact.track {
                    let displacements = forward(&self.joints, |j| self.positions[window][j][*frame]);
                    let pose = self.by_label.get(&contact.label).map_or_else(Pose::identity, |&j| displacements[j]);
                    sum += pose.inverse().transform_point(&(x - self.tool_offset));
                }
                sum / contact.track.len().max(1) as f64
            })
            .collect()
    }

    /// Information of every measurement, given how many frames share its registration error.
    fn informations(&self, sharing: impl Fn(usize, usize, usize) -> f64) -> FaceInformation {
        self.by_measurement(|w, j, frame, face| {
            let joint = &self.joints[j];
            let raw = self.measured(w, j, frame, face)?.information;
            if self.references[j].is_some() {
                return Some(raw);
            }
            with_shared_error(&raw, joint.radius, sharing(w, j, frame) * self.settings.shared_error.powi(2))
        })
    }

    fn by_measurement(&self, one: impl Fn(usize, usize, usize, usize) -> Option<Matrix6<f64>>) -> FaceInformation {
        (0..self.windows.len())
            .map(|w| {
                let frames = self.windows[w].times_s.len();
                (0..self.joints.len())
                    .map(|j| (0..frames).map(|k| [0, 1].map(|face| one(w, j, k, face))).collect())
                    .collect()
            })
            .collect()
    }

    fn measured(&self, w: usize, j: usize, frame: usize, face: usize) -> Option<&PoseMeasurement> {
        let window = self.windows[w];
        let poses = if face == 0 { &window.poses } else { &window.later_faces };
        poses.get(&self.joints[j].child)?[frame].as_ref()
    }

    /// Residual and information of each measurement of a joint's child in a frame, by faces.
    fn residuals(&self, w: usize, j: usize, frame: usize, predicted: &Pose) -> impl Iterator<Item = Residual> {
        let turned = self.joints[j].joint_type == JointType::Revolute
            && (predicted.rotation - Matrix3::identity()).norm() > TURNED;
        let one = |face: usize| {
            let information = self.information[w][j][frame][face].as_ref()?;
            let measured = self.measured(w, j, frame, face)?;
            let (r, information) = measured.compare(information, &self.joints[j].center, predicted);
            let error = (face == 1 || turned || self.references[j].is_some()).then_some(face);
            let value = error.map_or(r, |e| r - self.face_errors[j][e]);
            Some(Residual { face, error, value, information, dimensions: measured.dimensions() })
        };
        [one(0), one(1)].into_iter().flatten()
    }

    fn student_cost(&self, chi_squared: f64, dimensions: f64) -> f64 {
        let freedom = self.settings.student_freedom;
        0.5 * (freedom + dimensions) * (chi_squared / freedom).ln_1p()
    }

    fn student_weight(&self, chi_squared: f64, dimensions: f64) -> f64 {
        let freedom = self.settings.student_freedom;
        (freedom + dimensions) / (freedom + chi_squared)
    }

    /// The cost but for what the windows add.
    fn prior_cost(&self) -> f64 {
        let mut cost = 0.5 * self.tool_offset.norm_squared() / self.settings.tool_offset_sigma.powi(2);
        for (joint, information) in self.joints.iter().zip(&self.alignments) {
            let turn = joint.alignment(0.0).map_or([0.0; 2], |(turn, _)| turn);
            cost += 0.5 * information * (turn[0] * turn[0] + turn[1] * turn[1]);
        }
        for (j, errors) in self.face_errors.iter().enumerate() {
            for (e, error) in errors.iter().enumerate() {
                cost += 0.5 * error.component_mul(error).dot(&self.face_error_information(j, e));
            }
        }
        for joint in self.joints.iter().filter(|j| j.joint_type == JointType::Revolute) {
            cost += 0.5 * (joint.axis.point - joint.center).norm_squared() / joint.axis_point_prior().powi(2);
        }
        cost
    }

    fn windows_cost(&self) -> f64 {
        (0..self.windows.len()).map(|w| self.window_cost(w)).sum()
    }

    /// What a window adds to the cost.
    fn window_cost(&self, w: usize) -> f64 {
        let window = self.windows[w];
        let mut cost = 0.0;
        for frame in 0..window.times_s.len() {
            let displacements = forward(&self.joints, |j| self.positions[w][j][frame]);
            for (j, displacement) in displacements.iter().enumerate() {
                for r in self.residuals(w, j, frame, displacement) {
                    cost += self.student_cost(r.chi_squared(), r.dimensions);
                }
            }
        }
        for (c, contact) in window.contacts.iter().enumerate() {
            let Some(&j) = self.by_label.get(&contact.label) else { continue };
            for (frame, x, sigma) in &contact.track {
                let displacements = forward(&self.joints, |i| self.positions[w][i][*frame]);
                let e = self.contact_residual(&displacements[j], x, w, c);
                cost += self.student_cost(e.norm_squared() / (sigma * sigma), 3.0);
            }
        }
        cost
    }

    fn contact_residual(&self, displacement: &Pose, x: &Vector3<f64>, window: usize, contact: usize) -> Vector3<f64> {
        x - self.tool_offset - displacement.transform_point(&self.contact_points[window][contact])
    }

    fn axis_count(&self) -> usize {
        self.joints.iter().map(KinematicJoint::axis_parameters).sum()
    }

    /// Axis parameters, then twelve face errors a joint, then the tool's offset.
    fn global_count(&self) -> usize {
        self.axis_count() + 12 * self.joints.len() + 3
    }

    /// Prior information of a joint's face error, per component. Where a pose topic measures the part,
    /// the first is the error of the pose that its displacements are counted from.
    fn face_error_information(&self, joint: usize, error: usize) -> Vector6<f64> {
        if let Some(reference) = self.references[joint].filter(|_| error == 0) {
            return reference.diagonal().map(|information| information.max(UNMEASURED_INFORMATION));
        }
        let length = FACE_ERROR_SIGMA[error].powi(-2);
        let angle = length * self.joints[joint].radius.powi(2);
        Vector6::new(angle, angle, angle, length, length, length)
    }

    fn linearize(&self) -> Vec<WindowSystem> {
        (0..self.windows.len()).map(|w| self.linearize_window(w)).collect()
    }

    fn linearize_window(&self, w: usize) -> WindowSystem {
        let window = self.windows[w];
        let globals = self.global_count();
        let locals = self.slot_counts[w] + 3 * window.contacts.len();
        let mut system = WindowSystem {
            local: DMatrix::identity(locals, locals) * 1e-2,
            local_gradient: DVector::zeros(locals),
            coupling: DMatrix::zeros(locals, globals),
            global: DMatrix::zeros(globals, globals),
            global_gradient: DVector::zeros(globals),
        };
        let mut touching: Vec<Vec<(usize, Vector3<f64>, f64)>> = vec![Vec::new(); window.times_s.len()];
        for (c, contact) in window.contacts.iter().enumerate() {
            for (frame, x, sigma) in &contact.track {
                touching[*frame].push((c, *x, *sigma));
            }
        }
        for (frame, touches) in touching.iter().enumerate() {
            let displacements = forward(&self.joints, |j| self.positions[w][j][frame]);
            let columns = self.twist_columns(w, frame, &displacements);
            for row in self.pose_rows(w, frame, &displacements, &columns) {
                system.add_pose(&row);
            }
            for (c, x, sigma) in touches {
                let Some(&j) = self.by_label.get(&window.contacts[*c].label) else { continue };
                let e = self.contact_residual(&displacements[j], x, w, *c);
                let weight = self.student_weight(e.norm_squared() / (sigma * sigma), 3.0) / (sigma * sigma);
                let moved = displacements[j].transform_point(&self.contact_points[w][*c]);
                let mut jacobian: Vec<(Slot, Vector3<f64>)> = columns[j]
                    .iter()
                    .map(|(at, v)| {
                        let angular: Vector3<f64> = v.fixed_rows::<3>(0).into();
                        let linear: Vector3<f64> = v.fixed_rows::<3>(3).into();
                        (*at, -(angular.cross(&moved) + linear))
                    })
                    .collect();
                for axis in 0..3 {
                    let column: Vector3<f64> = displacements[j].rotation.column(axis).into();
                    jacobian.push((Slot::Local(self.slot_counts[w] + 3 * c + axis), -column));
                    jacobian.push((Slot::Global(globals - 3 + axis), -Matrix3::identity().column(axis)));
                }
                accumulate(&mut system, &jacobian, &(Matrix3::identity() * weight), &e);
            }
        }
        system
    }

    /// What a frame's poses say, linearized at their weights.
    fn pose_rows(
        &self,
        w: usize,
        frame: usize,
        displacements: &[Pose],
        columns: &[Vec<(Slot, Vector6<f64>)>],
    ) -> Vec<PoseRow> {
        let axes = self.axis_count();
        let mut rows = Vec::new();
        for (j, joint) in self.joints.iter().enumerate() {
            let into_body = (Pose::from_translation(-joint.center) * displacements[j].inverse()).adjoint_matrix();
            for r in self.residuals(w, j, frame, &displacements[j]) {
                let weight = self.student_weight(r.chi_squared(), r.dimensions);
                let jacobian = columns[j].iter().map(|(at, v)| (*at, into_body * v)).collect();
                let error = r.error.map(|error| axes + 12 * j + 6 * error);
                let information = r.information * weight;
                rows.push(PoseRow { joint: j, face: r.face, jacobian, error, information, residual: r.value });
            }
        }
        rows
    }

    /// For each joint's child, the unknowns that move it and the left twists they move it by.
    fn twist_columns(&self, w: usize, frame: usize, displacements: &[Pose]) -> Vec<Vec<(Slot, Vector6<f64>)>> {
        let mut columns: Vec<Vec<(Slot, Vector6<f64>)>> = Vec::with_capacity(self.joints.len());
        let mut offset = 0;
        for (j, joint) in self.joints.iter().enumerate() {
            let mut own = joint.parent.map_or_else(Vec::new, |p| columns[p].clone());
            let parent = joint.parent.map_or_else(Pose::identity, |p| displacements[p]);
            let screw = joint.screw();
            own.push((Slot::Local(self.slots[w][j][frame]), parent.adjoint(&screw.0)));
            let motion = screw.displacement(self.positions[w][j][frame]);
            for (index, basis) in joint.axis_basis().iter().take(joint.axis_parameters()).enumerate() {
                own.push((Slot::Global(offset + index), parent.adjoint(&(basis - motion.adjoint(basis)))));
            }
            offset += joint.axis_parameters();
            columns.push(own);
        }
        columns
    }

    /// The reduced system in the global unknowns: Σ (global − couplingᵀ local⁻¹ coupling) plus priors.
    fn reduced(&self, systems: &[WindowSystem], damping: f64) -> (DMatrix<f64>, DVector<f64>, Vec<Option<LocalSolve>>) {
        let globals = self.global_count();
        let mut matrix = DMatrix::zeros(globals, globals);
        let mut gradient = DVector::zeros(globals);
        let mut at = 0;
        for (j, joint) in self.joints.iter().enumerate() {
            let arm = joint.axis.point - joint.center;
            let (first, second) = orthonormal_pair(&joint.axis.direction);
            for (i, pull) in
                [0.0, 0.0, arm.dot(&first), arm.dot(&second)].into_iter().take(joint.axis_parameters()).enumerate()
            {
                let information = if i < 2 { 1.0 } else { joint.axis_point_prior().powi(-2) };
                matrix[(at + i, at + i)] += information;
                gradient[at + i] += information * pull;
            }
            if let Some((turn, _)) = joint.alignment(0.0) {
                let information = self.alignments[j];
                for (i, turn) in turn.into_iter().enumerate().take(joint.axis_parameters()) {
                    matrix[(at + i, at + i)] += information;
                    gradient[at + i] -= information * turn;
                }
            }
            at += joint.axis_parameters();
        }
        for (j, errors) in self.face_errors.iter().enumerate() {
            for (e, error) in errors.iter().enumerate() {
                let information = self.face_error_information(j, e);
                for i in 0..6 {
                    matrix[(at + i, at + i)] += information[i];
                    gradient[at + i] += information[i] * error[i];
                }
                at += 6;
            }
        }
        let offset_information = 1.0 / self.settings.tool_offset_sigma.powi(2);
        for i in 0..3 {
            matrix[(globals - 3 + i, globals - 3 + i)] += offset_information;
            gradient[globals - 3 + i] += offset_information * self.tool_offset[i];
        }
        let mut solves = Vec::with_capacity(systems.len());
        for system in systems {
            matrix += &system.global;
            gradient += &system.global_gradient;
            let mut local = system.local.clone();
            for i in 0..local.nrows() {
                local[(i, i)] *= 1.0 + damping;
            }
            let solve = local.cholesky().map(|cholesky| LocalSolve {
                coupling: cholesky.solve(&system.coupling),
                gradient: cholesky.solve(&system.local_gradient),
            });
            if let Some(solve) = &solve {
                matrix -= system.coupling.transpose() * &solve.coupling;
                gradient -= system.coupling.transpose() * &solve.gradient;
            }
            solves.push(solve);
        }
        (matrix, gradient, solves)
    }

    /// Weighs the suggested directions against what the data alone say of each axis.
    fn weigh_alignments(&mut self, systems: &[WindowSystem]) {
        self.alignments.fill(0.0);
        if self.joints.iter().all(|joint| joint.suggested.is_none()) {
            return;
        }
        let (matrix, _, _) = self.reduced(systems, 0.0);
        let Some(covariance) = matrix.cholesky().map(|c| c.inverse()) else { return };
        let mut at = 0;
        for (j, joint) in self.joints.iter().enumerate() {
            if joint.axis_parameters() > 0 {
                let spread = 0.5 * (covariance[(at, at)] + covariance[(at + 1, at + 1)]);
                self.alignments[j] = joint.alignment(spread).map_or(0.0, |(_, information)| information);
            }
            at += joint.axis_parameters();
        }
    }

    fn stepped(&self, systems: &[WindowSystem], damping: f64) -> Self {
        let (mut matrix, gradient, solves) = self.reduced(systems, damping);
        for i in 0..matrix.nrows() {
            matrix[(i, i)] *= 1.0 + damping;
        }
        let mut next = self.clone();
        let Some(cholesky) = matrix.cholesky() else { return next };
        let global_step = -cholesky.solve(&gradient);
        let mut offset = 0;
        for joint in &mut next.joints {
            let count = joint.axis_parameters();
            joint.retract(&global_step.as_slice()[offset..offset + count]);
            offset += count;
        }
        for error in next.face_errors.iter_mut().flatten() {
            *error += global_step.fixed_rows::<6>(offset);
            offset += 6;
        }
        next.tool_offset += global_step.fixed_rows::<3>(offset);
        for (w, solve) in solves.iter().enumerate() {
            let Some(solve) = solve else { continue };
            let step = -(&solve.gradient + &solve.coupling * &global_step);
            for j in 0..self.joints.len() {
                for (frame, position) in next.positions[w][j].iter_mut().enumerate() {
                    *position += step[self.slots[w][j][frame]];
                }
            }
            for (c, point) in next.contact_points[w].iter_mut().enumerate() {
                *point += step.fixed_rows::<3>(self.slot_counts[w] + 3 * c);
            }
        }
        next
    }

    /// Counts, for every frame, the frames of its part within `shared_distance` of it.
    fn share_errors(&mut self) {
        let mut sharing: Vec<Vec<Vec<f64>>> =
            self.windows.iter().map(|window| vec![vec![1.0; window.times_s.len()]; self.joints.len()]).collect();
        // What a pose topic measures shares no registration error.
        for j in (0..self.joints.len()).filter(|&j| self.references[j].is_none()) {
            // Frames that follow each other at one place count together.
            let mut looks: Vec<(Look, Vec<(usize, usize)>)> = Vec::new();
            for (w, window) in self.windows.iter().enumerate() {
                for frame in 0..window.times_s.len() {
                    let displacement = forward(&self.joints, |i| self.positions[w][i][frame])[j];
                    let look = Look::at(&self.joints[j], &displacement);
                    match looks.last_mut() {
                        Some((last, frames)) if *last == look => frames.push((w, frame)),
                        _ => looks.push((look, vec![(w, frame)])),
                    }
                }
            }
            for (look, frames) in &looks {
                let near = looks.iter().filter(|(other, _)| look.distance(other) < self.settings.shared_distance);
                let count: usize = near.map(|(_, frames)| frames.len()).sum();
                for &(w, frame) in frames {
                    sharing[w][j][frame] = count as f64;
                }
            }
        }
        self.information = Rc::new(self.informations(|w, j, frame| sharing[w][j][frame]));
    }

    /// Frees joints that were taken to rest through a window where the data object: a score test on
    /// blocks of frames, Σ g²/h against χ².
    fn free_movers(&mut self) {
        for w in 0..self.windows.len() {
            let frames = self.windows[w].times_s.len();
            let tied: Vec<usize> = (0..self.joints.len())
                .filter(|&j| frames > 1 && self.slots[w][j].windows(2).all(|pair| pair[0] == pair[1]))
                .collect();
            if tied.is_empty() {
                continue;
            }
            let mut freed = self.clone();
            let mut next = freed.slot_counts[w];
            for &j in &tied {
                for slot in &mut freed.slots[w][j] {
                    *slot = next;
                    next += 1;
                }
            }
            freed.slot_counts[w] = next;
            let system = freed.linearize_window(w);
            let moves = |j: usize| {
                let block = frames.div_ceil(REST_BLOCKS);
                let score: f64 = freed.slots[w][j]
                    .chunks(block)
                    .map(|slots| {
                        let g: f64 = slots.iter().map(|&s| system.local_gradient[s]).sum();
                        let h: f64 = slots.iter().map(|&s| system.local[(s, s)]).sum();
                        g * g / h
                    })
                    .sum();
                score > REST_SCORE
            };
            for &j in &tied {
                if moves(j) {
                    let next = self.slot_counts[w];
                    self.slots[w][j] = (next..next + frames).collect();
                    self.slot_counts[w] += frames;
                }
            }
        }
    }

    /// Makes frames in which a joint rests one unknown: friction holds what is not pushed.
    fn tie_rests(&mut self) {
        let systems = self.linearize();
        for (w, window) in self.windows.iter().enumerate() {
            let deviations = systems[w].local.clone().cholesky().map(|c| c.inverse().diagonal());
            let mut next_slot = 0;
            for j in 0..self.joints.len() {
                let sigma =
                    |frame: usize| deviations.as_ref().map_or(0.0, |d| d[self.slots[w][j][frame]].max(0.0).sqrt());
                let runs = rest_runs(&self.positions[w][j], sigma, self.settings.rest_deviations);
                for run in runs {
                    let mean = run.clone().map(|k| self.positions[w][j][k]).sum::<f64>() / run.len() as f64;
                    for k in run {
                        self.positions[w][j][k] = mean;
                        self.slots[w][j][k] = next_slot;
                    }
                    next_slot += 1;
                }
            }
            debug_assert!(next_slot <= self.joints.len() * window.times_s.len());
            self.slot_counts[w] = next_slot;
        }
    }

    /// Covariance of the gradient in the global unknowns by registration errors that go with the view: of each
    /// part and its faces a Gaussian process over where the part is, none at the reference configuration.
    fn drift_of_views(&self, solves: &[Option<LocalSolve>]) -> DMatrix<f64> {
        let globals = self.global_count();
        let mut drift = DMatrix::zeros(globals, globals);
        for (j, views) in self.views(solves).iter().enumerate() {
            let joint = &self.joints[j];
            let start = Look::at(joint, &Pose::identity());
            let likeness = |a: &Look, b: &Look| (-a.distance(b) / self.settings.view_distance).exp();
            for views in views {
                for (a, pull) in views {
                    let mut total = DMatrix::zeros(globals, 6);
                    for (b, other) in views {
                        total += other * (likeness(a, b) - likeness(a, &start) * likeness(&start, b));
                    }
                    drift += pull * total.transpose();
                }
            }
        }
        drift
    }

    /// Eᵀ, with E Eᵀ the covariance of the error that goes with a view, ξ as in [`PoseMeasurement`]: `view_error`
    /// in every direction, and what the measurement states, as outlines err alike in all frames.
    fn view_error(&self, information: &Matrix6<f64>, radius: f64) -> Matrix6<f64> {
        let scale = length_scale(radius);
        let mut eigen = in_lengths(information, radius).symmetric_eigen();
        let least = self.settings.view_error.powi(2);
        eigen.eigenvalues.apply(|x| *x = if *x > SAYS_NOTHING { (least + 1.0 / *x).sqrt() } else { 0.0 });
        let root = eigen.recompose();
        Matrix6::from_fn(|i, j| root[(i, j)] / scale[j])
    }

    /// By joint and faces: the views of its child, with the gradient in the global unknowns (columns) that one
    /// `view_error` in each of six directions causes. Looks within `shared_distance` are one view.
    /// `solves` are those of the undamped systems.
    fn views(&self, solves: &[Option<LocalSolve>]) -> Vec<[Vec<(Look, DMatrix<f64>)>; 2]> {
        let errors = self.shared.view_errors.get_or_init(|| {
            self.by_measurement(|w, j, frame, face| {
                let raw = self.measured(w, j, frame, face).filter(|_| self.references[j].is_none())?;
                Some(self.view_error(&raw.information, self.joints[j].radius))
            })
        });
        let globals = self.global_count();
        let mut views: Vec<[Vec<(Look, DMatrix<f64>)>; 2]> = self.joints.iter().map(|_| Default::default()).collect();
        for (w, (window, solve)) in self.windows.iter().zip(solves).enumerate() {
            let Some(LocalSolve { coupling, .. }) = solve else { continue };
            let error_of = |row: &PoseRow, frame: usize| errors[w][row.joint][frame][row.face].as_ref();
            for frame in 0..window.times_s.len() {
                let displacements = forward(&self.joints, |j| self.positions[w][j][frame]);
                let columns = self.twist_columns(w, frame, &displacements);
                for row in self.pose_rows(w, frame, &displacements, &columns) {
                    let joint = &self.joints[row.joint];
                    if self.references[row.joint].is_some() {
                        continue;
                    }
                    let look = Look::at(joint, &displacements[row.joint]);
                    let views = &mut views[row.joint][row.face];
                    let known =
                        views.iter().position(|(other, _)| other.distance(&look) < self.settings.shared_distance);
                    let index = known.unwrap_or(views.len());
                    if known.is_none() {
                        views.push((look, DMatrix::zeros(globals, 6)));
                    }
                    let pull = &mut views[index].1;
                    let Some(error) = error_of(&row, frame) else { continue };
                    let weighted = error * row.information;
                    if let Some(at) = row.error {
                        let mut own = pull.fixed_rows_mut::<6>(at);
                        own -= weighted.transpose();
                    }
                    for (at, column) in &row.jacobian {
                        let value = (weighted * column).transpose();
                        match *at {
                            Slot::Global(row) => pull.row_mut(row).zip_apply(&value, |p, v| *p += v),
                            Slot::Local(row) => pull.ger(-1.0, &coupling.row(row).transpose(), &value.transpose(), 1.0),
                        }
                    }
                }
            }
        }
        views
    }

    fn finish(self, cost: f64, converged: bool, weigh_windows: bool) -> KinematicFit {
        let systems = self.linearize();
        let (matrix, _, solves) = self.reduced(&systems, 0.0);
        let globals = matrix.nrows();
        let window_information =
            if weigh_windows { window_information(&matrix, &systems, &solves) } else { Vec::new() };
        let drift = self.drift_of_views(&solves);
        let mut covariance = matrix.cholesky().map_or_else(|| DMatrix::identity(globals, globals), |c| c.inverse());
        covariance += &covariance * drift * &covariance;
        let covariance = (&covariance + covariance.transpose()) * 0.5;
        let moves = (0..self.joints.len())
            .map(|j| self.slots.iter().map(|w| w[j].windows(2).filter(|pair| pair[0] != pair[1]).count()).collect())
            .collect();
        let window_costs = (0..self.windows.len()).map(|w| self.window_cost(w)).collect();
        KinematicFit {
            joints: self.joints,
            positions: self.positions,
            contact_points: self.contact_points,
            tool_offset: self.tool_offset,
            covariance,
            cost,
            moves,
            window_costs,
            window_information,
            converged,
        }
    }
}

struct LocalSolve {
    coupling: DMatrix<f64>,
    gradient: DVector<f64>,
}

/// By how much ln |matrix| falls without each window's share of it; greatest where nothing else holds.
fn window_information(matrix: &DMatrix<f64>, systems: &[WindowSystem], solves: &[Option<LocalSolve>]) -> Vec<f64> {
    let log_determinant = |matrix: DMatrix<f64>| {
        matrix.cholesky().map_or(f64::NEG_INFINITY, |c| 2.0 * c.l_dirty().diagonal().map(f64::ln).sum())
    };
    let whole = log_determinant(matrix.clone());
    systems
        .iter()
        .zip(solves)
        .map(|(system, solve)| {
            let coupled = solve.as_ref().map(|solve| system.coupling.transpose() * &solve.coupling);
            let own = coupled.map_or_else(|| system.global.clone(), |coupled| &system.global - coupled);
            (whole - log_determinant(matrix - own)).clamp(0.0, f64::MAX)
        })
        .collect()
}

/// Where a part is seen \[m\]: looks at one pose share their registration error.
#[derive(PartialEq)]
struct Look {
    place: Vector3<f64>,
    rotated: Vector3<f64>,
}

impl Look {
    fn at(joint: &KinematicJoint, displacement: &Pose) -> Self {
        Self {
            place: displacement.transform_point(&joint.center),
            rotated: displacement.rotation * Vector3::repeat(joint.radius / 3f64.sqrt()),
        }
    }

    fn distance(&self, other: &Self) -> f64 {
        (self.place - other.place).norm() + (self.rotated - other.rotated).norm()
    }
}

/// A pose measurement, linearized.
struct PoseRow {
    joint: usize,
    face: usize,
    jacobian: Vec<(Slot, Vector6<f64>)>,
    /// The first of the six global unknowns that are its rigid error: it goes with −1 of each.
    error: Option<usize>,
    information: Matrix6<f64>,
    residual: Vector6<f64>,
}

#[derive(Clone, Copy)]
enum Slot {
    Local(usize),
    Global(usize),
}

impl WindowSystem {
    /// Adds a pose's share: Jᵀ Λ J and Jᵀ Λ r.
    fn add_pose(&mut self, row: &PoseRow) {
        let pull = row.information * row.residual;
        for (i, (at, column)) in row.jacobian.iter().enumerate() {
            let weighted = row.information * column;
            let slope = column.dot(&pull);
            match *at {
                Slot::Local(at) => self.local_gradient[at] += slope,
                Slot::Global(at) => self.global_gradient[at] += slope,
            }
            for (k, (other, other_column)) in row.jacobian[..=i].iter().enumerate() {
                let value = weighted.dot(other_column);
                match (*at, *other) {
                    (Slot::Local(a), Slot::Local(b)) => {
                        self.local[(a, b)] += value;
                        if k < i {
                            self.local[(b, a)] += value;
                        }
                    }
                    (Slot::Global(a), Slot::Global(b)) => {
                        self.global[(a, b)] += value;
                        if k < i {
                            self.global[(b, a)] += value;
                        }
                    }
                    (Slot::Local(local), Slot::Global(global)) | (Slot::Global(global), Slot::Local(local)) => {
                        self.coupling[(local, global)] += value;
                    }
                }
            }
            let Some(error) = row.error else { continue };
            for (k, value) in weighted.iter().enumerate() {
                match *at {
                    Slot::Local(local) => self.coupling[(local, error + k)] -= value,
                    Slot::Global(global) => {
                        self.global[(global, error + k)] -= value;
                        self.global[(error + k, global)] -= value;
                    }
                }
            }
        }
        if let Some(error) = row.error {
            let mut gradient = self.global_gradient.fixed_rows_mut::<6>(error);
            gradient -= pull;
            let mut own = self.global.fixed_view_mut::<6, 6>(error, error);
            own += row.information;
        }
    }
}

fn accumulate<const R: usize>(
    system: &mut WindowSystem,
    jacobian: &[(Slot, nalgebra::SVector<f64, R>)],
    information: &nalgebra::SMatrix<f64, R, R>,
    residual: &nalgebra::SVector<f64, R>,
) {
    for (at, column) in jacobian {
        let weighted = information * column;
        let slope = weighted.dot(residual);
        match *at {
            Slot::Local(row) => system.local_gradient[row] += slope,
            Slot::Global(row) => system.global_gradient[row] += slope,
        }
        for (other, other_column) in jacobian {
            let value = weighted.dot(other_column);
            match (*at, *other) {
                (Slot::Local(row), Slot::Local(column)) => system.local[(row, column)] += value,
                (Slot::Local(row), Slot::Global(column)) => system.coupling[(row, column)] += value,
                (Slot::Global(row), Slot::Global(column)) => system.global[(row, column)] += value,
                (Slot::Global(_), Slot::Local(_)) => {}
            }
        }
    }
}

/// What a fit leaves of a measurement.
struct Residual {
    /// Which faces were measured: those of the first look, or later ones.
    face: usize,
    /// Which rigid error it shares, if any.
    error: Option<usize>,
    value: Vector6<f64>,
    information: Matrix6<f64>,
    dimensions: f64,
}

impl Residual {
    fn chi_squared(&self) -> f64 {
        self.value.dot(&(self.information * self.value))
    }
}

/// Splits frames into runs within which a position stays inside its own uncertainty.
fn rest_runs(positions: &[f64], sigma: impl Fn(usize) -> f64, deviations: f64) -> Vec<std::ops::Range<usize>> {
    let mut runs = Vec::new();
    let mut start = 0;
    let mut sum = 0.0;
    for (k, &position) in positions.iter().enumerate() {
        let count = (k - start) as f64;
        if k > start && (position - sum / count).abs() > deviations * sigma(k) {
            runs.push(start..k);
            start = k;
            sum = 0.0;
        }
        sum += position;
    }
    if start < positions.len() {
        runs.push(start..positions.len());
    }
    runs
}

/// The contact's label, for callers that look a track up.
impl Contact {
    /// The tool's position in a frame \[m\].
    pub fn position(&self, frame: usize) -> Option<Vector3<f64>> {
        self.track.iter().find(|(k, _, _)| *k == frame).map(|(_, x, _)| *x)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// A drawer that is pulled out by 20 cm, seen in so many frames.
    fn drawer(frames: usize) -> KinematicFit {
        let joint = KinematicJoint {
            parent: None,
            child: Label(1),
            joint_type: JointType::Prismatic,
            axis: Axis { direction: Vector3::x(), point: Vector3::zeros() },
            center: Vector3::zeros(),
            radius: 0.2,
            suggested: None,
        };
        let positions: Vec<f64> = (0..frames).map(|k| 0.2 * k as f64 / (frames - 1) as f64).collect();
        let seen = |q: &f64| {
            let displacement = Pose::from_translation(Vector3::x() * *q);
            Some(PoseMeasurement { displacement, information: Matrix6::identity() * 1e6 })
        };
        let window = WindowObservations {
            times_s: (0..frames).map(|k| 0.1 * k as f64).collect(),
            poses: BTreeMap::from([(Label(1), positions.iter().map(seen).collect())]),
            ..WindowObservations::default()
        };
        fit_kinematics(vec![joint], vec![vec![positions]], &[&window], &KinematicSettings::default())
    }

    #[test]
    fn frames_do_not_average_away_what_goes_with_the_view() {
        let spread = |frames: usize| drawer(frames).covariance[(0, 0)].sqrt();
        let (few, many) = (spread(12), spread(120));
        assert!(many > 0.7 * few, "{few} with 12 frames, {many} with 120");
        // 4.5 mm over 20 cm and less, as views are forgotten on the way.
        assert!((0.008..0.03).contains(&many), "{many}");
    }
}
