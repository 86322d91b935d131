//! Normal equations of a window and of all windows, with what is of a window alone eliminated.

use nalgebra::{DMatrix, DVector, Matrix3, Matrix6, Vector3, Vector6};

use super::forward;
use super::problem::Problem;
use crate::math::{Pose, orthonormal_pair};

/// A stay's error before it is eliminated: minus its columns with the window's unknowns, its information, its
/// gradient.
pub(super) struct StaySystem {
    pub(super) columns: Vec<(Slot, Vector6<f64>)>,
    pub(super) information: Matrix6<f64>,
    pub(super) gradient: Vector6<f64>,
}

/// One window's normal equations with its local unknowns still in.
pub(super) struct WindowSystem {
    /// Of every stay what its error was eliminated by: the inverse of its information.
    pub(super) stays: Vec<(StaySystem, Matrix6<f64>)>,
    pub(super) local: DMatrix<f64>,
    pub(super) local_gradient: DVector<f64>,
    pub(super) coupling: DMatrix<f64>,
    pub(super) global: DMatrix<f64>,
    pub(super) global_gradient: DVector<f64>,
}

pub(super) struct LocalSolve {
    pub(super) coupling: DMatrix<f64>,
    pub(super) gradient: DVector<f64>,
}

/// A pose measurement, linearized.
pub(super) struct PoseRow {
    pub(super) joint: usize,
    pub(super) face: usize,
    pub(super) jacobian: Vec<(Slot, Vector6<f64>)>,
    /// The first of the six global unknowns that are its rigid error: it goes with −1 of each.
    pub(super) error: Option<usize>,
    pub(super) stay: Option<usize>,
    pub(super) information: Matrix6<f64>,
    pub(super) residual: Vector6<f64>,
}

#[derive(Clone, Copy, PartialEq)]
pub(super) enum Slot {
    Local(usize),
    Global(usize),
}

impl Problem<'_> {
    pub(super) fn linearize(&self) -> Vec<WindowSystem> {
        (0..self.windows.len()).map(|w| self.linearize_window(w).without_stays()).collect()
    }

    /// With the errors of stays as they are.
    pub(super) fn linearize_window(&self, w: usize) -> WindowSystem {
        let window = self.windows[w];
        let globals = self.global_count();
        let locals = self.slot_counts[w] + 3 * window.contacts.len();
        let stays = self.stays[w].iter().map(|stay| {
            let gradient = stay.error.component_mul(&stay.information);
            let system =
                StaySystem { columns: Vec::new(), information: Matrix6::from_diagonal(&stay.information), gradient };
            (system, Matrix6::zeros())
        });
        let mut system = WindowSystem {
            stays: stays.collect(),
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
    pub(super) fn pose_rows(
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
                rows.push(PoseRow {
                    joint: j,
                    face: r.face,
                    jacobian,
                    error,
                    stay: r.stay,
                    information,
                    residual: r.value,
                });
            }
        }
        rows
    }

    /// For each joint's child, the unknowns that move it and the left twists they move it by.
    pub(super) fn twist_columns(
        &self,
        w: usize,
        frame: usize,
        displacements: &[Pose],
    ) -> Vec<Vec<(Slot, Vector6<f64>)>> {
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
    pub(super) fn reduced(
        &self,
        systems: &[WindowSystem],
        damping: f64,
    ) -> (DMatrix<f64>, DVector<f64>, Vec<Option<LocalSolve>>) {
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
}

impl StaySystem {
    fn add_pose(&mut self, row: &PoseRow, pull: &Vector6<f64>) {
        self.information += row.information;
        self.gradient -= pull;
        let own = row.error.into_iter().flat_map(|error| {
            (0..6).map(move |k| (Slot::Global(error + k), -Matrix6::identity().column(k).into_owned()))
        });
        for (at, column) in row.jacobian.iter().copied().chain(own) {
            let value = row.information * column;
            match self.columns.iter_mut().find(|(slot, _)| *slot == at) {
                Some((_, sum)) => *sum += value,
                None => self.columns.push((at, value)),
            }
        }
    }
}

impl WindowSystem {
    /// Adds a pose's share: Jᵀ Λ J and Jᵀ Λ r.
    fn add_pose(&mut self, row: &PoseRow) {
        let pull = row.information * row.residual;
        if let Some(stay) = row.stay {
            self.stays[stay].0.add_pose(row, &pull);
        }
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

    /// With the errors of stays eliminated.
    pub(super) fn without_stays(mut self) -> Self {
        let mut stays = std::mem::take(&mut self.stays);
        for (stay, inverse) in &mut stays {
            let Some(inverted) = stay.information.try_inverse() else { continue };
            *inverse = inverted;
            let pull = inverted * stay.gradient;
            for (i, (at, column)) in stay.columns.iter().enumerate() {
                let slope = column.dot(&pull);
                match *at {
                    Slot::Local(at) => self.local_gradient[at] += slope,
                    Slot::Global(at) => self.global_gradient[at] += slope,
                }
                let weighted = inverted * column;
                for (other, other_column) in &stay.columns[..=i] {
                    let value = weighted.dot(other_column);
                    match (*at, *other) {
                        (Slot::Local(a), Slot::Local(b)) => {
                            self.local[(a, b)] -= value;
                            if a != b {
                                self.local[(b, a)] -= value;
                            }
                        }
                        (Slot::Global(a), Slot::Global(b)) => {
                            self.global[(a, b)] -= value;
                            if a != b {
                                self.global[(b, a)] -= value;
                            }
                        }
                        (Slot::Local(local), Slot::Global(global)) | (Slot::Global(global), Slot::Local(local)) => {
                            self.coupling[(local, global)] -= value;
                        }
                    }
                }
            }
        }
        self.stays = stays;
        self
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

/// By how much ln |matrix| falls without each window's share of it; greatest where nothing else holds.
pub(super) fn window_information(
    matrix: &DMatrix<f64>,
    systems: &[WindowSystem],
    solves: &[Option<LocalSolve>],
) -> Vec<f64> {
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
