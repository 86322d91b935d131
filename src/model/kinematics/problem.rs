//! One fit: its unknowns, what they cost, and its steps.

use std::collections::BTreeMap;
use std::rc::Rc;

use nalgebra::{DMatrix, Matrix3, Matrix6, Vector3, Vector6};

use super::equations::{Slot, WindowSystem, window_information};
use super::views::Stay;
use super::{KinematicFit, KinematicJoint, KinematicSettings, SharedByFits, forward};
use crate::math::Pose;
use crate::mechanism::JointType;
use crate::model::window::{PoseMeasurement, WindowObservations, with_shared_error};
use crate::types::Label;

/// Standard deviations \[m\] of the rigid error that the first look's faces share once the part has
/// turned (seen from another side, its silhouette and noise differ), and of the pose at which later faces
/// were added to a model.
const FACE_ERROR_SIGMA: [f64; 2] = [0.0015, 0.020];
/// A hinged part is seen from another side once it has turned; a sliding one keeps its side: √2 times the angle \[rad\].
const TURNED: f64 = 0.1;
/// A reference pose's rotation that was not measured may be off by any angle: it does not matter \[rad⁻²\].
const UNMEASURED_INFORMATION: f64 = 1.0;

/// By window, joint, frame and faces: the information of a measurement.
pub(super) type FaceInformation = Vec<Vec<Vec<[Option<Matrix6<f64>>; 2]>>>;

#[derive(Clone)]
pub(super) struct Problem<'a> {
    pub(super) joints: Vec<KinematicJoint>,
    pub(super) windows: &'a [&'a WindowObservations],
    pub(super) settings: &'a KinematicSettings,
    pub(super) positions: Vec<Vec<Vec<f64>>>,
    /// By window, joint, frame: which local unknown its position is.
    pub(super) slots: Vec<Vec<Vec<usize>>>,
    /// By window: how many local position unknowns.
    pub(super) slot_counts: Vec<usize>,
    /// By window, joint, frame: information after the error that frames at one pose share, but for frames of a
    /// stay, whose shared error is an unknown.
    pub(super) information: Rc<FaceInformation>,
    /// Whether frames of a stay have one unknown error, which leaves what they say of changes within it.
    pub(super) stays_apart: bool,
    /// By window.
    pub(super) stays: Vec<Vec<Stay>>,
    /// By window, joint, frame and faces: the stay it belongs to.
    pub(super) stay_of: Rc<Vec<Vec<Vec<[Option<usize>; 2]>>>>,
    /// By joint, as ξ about the center: the rigid error of the first look's faces away from where they
    /// were first seen, and that of the faces that came into view later.
    pub(super) face_errors: Vec<[Vector6<f64>; 2]>,
    /// By joint: information of the suggested direction \[rad⁻²\].
    pub(super) alignments: Vec<f64>,
    pub(super) contact_points: Vec<Vec<Vector3<f64>>>,
    pub(super) tool_offset: Vector3<f64>,
    pub(super) by_label: BTreeMap<Label, usize>,
    /// By joint: the information of the pose that its child's displacements are counted from, where a
    /// pose topic measures them.
    pub(super) references: Vec<Option<Matrix6<f64>>>,
    pub(super) shared: &'a SharedByFits,
}

impl<'a> Problem<'a> {
    pub(super) fn new(
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
            stays_apart: false,
            stays: vec![Vec::new(); windows.len()],
            stay_of: Rc::default(),
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
    pub(super) fn informations(&self, sharing: impl Fn(usize, usize, usize) -> f64) -> FaceInformation {
        self.by_measurement(|w, j, frame, face| {
            let joint = &self.joints[j];
            let raw = self.measured(w, j, frame, face)?.information;
            if self.references[j].is_some() {
                return Some(raw);
            }
            let own = if self.stays_apart { self.settings.own_error.powi(2) } else { 0.0 };
            let variance = sharing(w, j, frame) * self.settings.shared_error.powi(2) + own;
            with_shared_error(&raw, joint.radius, variance)
        })
    }

    pub(super) fn by_measurement(
        &self,
        one: impl Fn(usize, usize, usize, usize) -> Option<Matrix6<f64>>,
    ) -> FaceInformation {
        (0..self.windows.len())
            .map(|w| {
                let frames = self.windows[w].times_s.len();
                (0..self.joints.len())
                    .map(|j| (0..frames).map(|k| [0, 1].map(|face| one(w, j, k, face))).collect())
                    .collect()
            })
            .collect()
    }

    pub(super) fn measured(&self, w: usize, j: usize, frame: usize, face: usize) -> Option<&PoseMeasurement> {
        let window = self.windows[w];
        let poses = if face == 0 { &window.poses } else { &window.later_faces };
        poses.get(&self.joints[j].child)?[frame].as_ref()
    }

    /// Residual and information of each measurement of a joint's child in a frame, by faces.
    pub(super) fn residuals(
        &self,
        w: usize,
        j: usize,
        frame: usize,
        predicted: &Pose,
    ) -> impl Iterator<Item = Residual> {
        let turned = self.joints[j].joint_type == JointType::Revolute
            && (predicted.rotation - Matrix3::identity()).norm() > TURNED;
        let one = |face: usize| {
            let information = self.information[w][j][frame][face].as_ref()?;
            let measured = self.measured(w, j, frame, face)?;
            let (r, information) = measured.compare(information, &self.joints[j].center, predicted);
            let error = (face == 1 || turned || self.references[j].is_some()).then_some(face);
            let stay = self.stay_of.get(w).and_then(|window| window[j][frame][face]);
            let shared = stay.map_or_else(Vector6::zeros, |stay| self.stays[w][stay].error);
            let value = error.map_or(r, |e| r - self.face_errors[j][e]) - shared;
            Some(Residual { face, error, stay, value, information, dimensions: measured.dimensions() })
        };
        [one(0), one(1)].into_iter().flatten()
    }

    fn student_cost(&self, chi_squared: f64, dimensions: f64) -> f64 {
        let freedom = self.settings.student_freedom;
        0.5 * (freedom + dimensions) * (chi_squared / freedom).ln_1p()
    }

    pub(super) fn student_weight(&self, chi_squared: f64, dimensions: f64) -> f64 {
        let freedom = self.settings.student_freedom;
        (freedom + dimensions) / (freedom + chi_squared)
    }

    /// The cost but for what the windows add.
    pub(super) fn prior_cost(&self) -> f64 {
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

    pub(super) fn windows_cost(&self) -> f64 {
        (0..self.windows.len()).map(|w| self.window_cost(w)).sum()
    }

    /// What a window adds to the cost.
    fn window_cost(&self, w: usize) -> f64 {
        let window = self.windows[w];
        let of_stay = |stay: &Stay| 0.5 * stay.error.component_mul(&stay.error).dot(&stay.information);
        let mut cost = self.stays[w].iter().map(of_stay).sum::<f64>();
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

    pub(super) fn contact_residual(
        &self,
        displacement: &Pose,
        x: &Vector3<f64>,
        window: usize,
        contact: usize,
    ) -> Vector3<f64> {
        x - self.tool_offset - displacement.transform_point(&self.contact_points[window][contact])
    }

    pub(super) fn axis_count(&self) -> usize {
        self.joints.iter().map(KinematicJoint::axis_parameters).sum()
    }

    /// Axis parameters, then twelve face errors a joint, then the tool's offset.
    pub(super) fn global_count(&self) -> usize {
        self.axis_count() + 12 * self.joints.len() + 3
    }

    /// Prior information of a joint's face error, per component. Where a pose topic measures the part,
    /// the first is the error of the pose that its displacements are counted from.
    pub(super) fn face_error_information(&self, joint: usize, error: usize) -> Vector6<f64> {
        if let Some(reference) = self.references[joint].filter(|_| error == 0) {
            return reference.diagonal().map(|information| information.max(UNMEASURED_INFORMATION));
        }
        let length = FACE_ERROR_SIGMA[error].powi(-2);
        let angle = length * self.joints[joint].radius.powi(2);
        Vector6::new(angle, angle, angle, length, length, length)
    }

    /// Weighs the suggested directions against what the data alone say of each axis.
    pub(super) fn weigh_alignments(&mut self, systems: &[WindowSystem]) {
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

    pub(super) fn stepped(&self, systems: &[WindowSystem], damping: f64) -> Self {
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
            for ((stay, inverse), next) in systems[w].stays.iter().zip(&mut next.stays[w]) {
                let pulled = stay.columns.iter().map(|(at, column)| match *at {
                    Slot::Local(at) => column * step[at],
                    Slot::Global(at) => column * global_step[at],
                });
                next.error += inverse * (pulled.sum::<Vector6<f64>>() - stay.gradient);
            }
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

    pub(super) fn finish(self, cost: f64, converged: bool, weigh_windows: bool) -> KinematicFit {
        let systems = self.linearize();
        let (matrix, _, solves) = self.reduced(&systems, 0.0);
        let globals = matrix.nrows();
        let window_information =
            if weigh_windows { window_information(&matrix, &systems, &solves) } else { Vec::new() };
        let drift = self.drift_of_views(&systems, &solves);
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

/// What a fit leaves of a measurement.
pub(super) struct Residual {
    /// Which faces were measured: those of the first look, or later ones.
    pub(super) face: usize,
    /// Which rigid error it shares, if any.
    pub(super) error: Option<usize>,
    /// Which stay it belongs to, if any.
    pub(super) stay: Option<usize>,
    pub(super) value: Vector6<f64>,
    pub(super) information: Matrix6<f64>,
    pub(super) dimensions: f64,
}

impl Residual {
    pub(super) fn chi_squared(&self) -> f64 {
        self.value.dot(&(self.information * self.value))
    }
}
