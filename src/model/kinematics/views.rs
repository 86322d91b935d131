//! Errors of registration that go with how a part is seen: what looks at one place share, and what axes may be
//! off by as views change.

use std::rc::Rc;

use nalgebra::{DMatrix, Matrix6, Vector3, Vector6};

use super::equations::{LocalSolve, PoseRow, Slot, WindowSystem};
use super::problem::Problem;
use super::{KinematicJoint, forward};
use crate::math::{Pose, in_lengths, length_scale};

/// Information below this holds nothing, and pulls at nothing \[m⁻²\].
const SAYS_NOTHING: f64 = 100.0;
/// Of the variance that a measurement states, this much is alike in all frames of a view; the rest averages out.
const ALIKE_SHARE: f64 = 0.25;
/// Of the variance that looks share, at least this much is left where the model was made.
const LEAST_SHARE: f64 = 0.01;

/// Frames of a window in which a part, as its faces are seen, stays where it is, and what they share.
#[derive(Clone)]
pub(super) struct Stay {
    /// ξ of the registration error that its frames share.
    pub(super) error: Vector6<f64>,
    /// Prior information of each component.
    pub(super) information: Vector6<f64>,
}

/// Where a part is seen \[m\]: looks at one pose share their registration error.
#[derive(PartialEq)]
pub(super) struct Look {
    pub(super) place: Vector3<f64>,
    pub(super) rotated: Vector3<f64>,
}

impl Look {
    pub(super) fn at(joint: &KinematicJoint, displacement: &Pose) -> Self {
        Self {
            place: displacement.transform_point(&joint.center),
            rotated: displacement.rotation * Vector3::repeat(joint.radius / 3f64.sqrt()),
        }
    }

    pub(super) fn distance(&self, other: &Self) -> f64 {
        (self.place - other.place).norm() + (self.rotated - other.rotated).norm()
    }
}

impl Problem<'_> {
    /// Finds, of every part, the stays and the lone frames within `shared_distance` of each other, which share a
    /// registration error: a stay's is one unknown, a lone frame's weakens its information. Where stays are not kept
    /// apart, all frames are alone.
    pub(super) fn share_errors(&mut self) {
        let windows = self.windows.iter();
        let mut sharing: Vec<Vec<Vec<f64>>> =
            windows.clone().map(|window| vec![vec![1.0; window.times_s.len()]; self.joints.len()]).collect();
        let mut stay_of: Vec<Vec<Vec<[Option<usize>; 2]>>> =
            windows.map(|window| vec![vec![[None; 2]; window.times_s.len()]; self.joints.len()]).collect();
        let mut stays: Vec<Vec<Stay>> = vec![Vec::new(); self.windows.len()];
        let reach = self.settings.shared_distance;
        // What a pose topic measures shares no registration error.
        for j in (0..self.joints.len()).filter(|&j| self.references[j].is_none()) {
            // Frames that follow each other at one place count together.
            let mut looks: Vec<(Look, usize, Vec<usize>)> = Vec::new();
            for (w, window) in self.windows.iter().enumerate() {
                for frame in 0..window.times_s.len() {
                    let displacement = forward(&self.joints, |i| self.positions[w][i][frame])[j];
                    let look = Look::at(&self.joints[j], &displacement);
                    match looks.last_mut() {
                        Some((first, at, frames))
                            if *at == w && (*first == look || self.stays_apart && first.distance(&look) < reach) =>
                        {
                            frames.push(frame);
                        }
                        _ => looks.push((look, w, vec![frame])),
                    }
                }
            }
            for (look, w, frames) in &looks {
                let near = looks.iter().filter(|(other, ..)| look.distance(other) < reach);
                let count: usize = near.map(|(.., frames)| if self.stays_apart { 1 } else { frames.len() }).sum();
                let together = self.stays_apart && frames.len() > 1;
                let start = Look::at(&self.joints[j], &Pose::identity());
                // The model is made there, and so without error.
                let grown = 1.0 - (-2.0 * look.distance(&start) / reach).exp();
                for &frame in frames {
                    sharing[*w][j][frame] = if together { 0.0 } else { count as f64 };
                }
                for face in (0..2).filter(|_| together) {
                    for &frame in frames {
                        stay_of[*w][j][frame][face] = Some(stays[*w].len());
                    }
                    let share = if face == 0 { grown.max(LEAST_SHARE) } else { 1.0 };
                    let length = (count as f64 * share * self.settings.shared_error.powi(2)).recip();
                    let angle = length * self.joints[j].radius.powi(2);
                    let information = Vector6::new(angle, angle, angle, length, length, length);
                    stays[*w].push(Stay { error: Vector6::zeros(), information });
                }
            }
        }
        self.stays = stays;
        self.stay_of = Rc::new(stay_of);
        self.information = Rc::new(self.informations(|w, j, frame| sharing[w][j][frame]));
    }

    /// Covariance of the gradient in the global unknowns by registration errors that go with the view: of each
    /// part and its faces a Gaussian process over where the part is, none at the reference configuration.
    pub(super) fn drift_of_views(&self, systems: &[WindowSystem], solves: &[Option<LocalSolve>]) -> DMatrix<f64> {
        let globals = self.global_count();
        let mut drift = DMatrix::zeros(globals, globals);
        for (j, views) in self.views(systems, solves).iter().enumerate() {
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
    /// in every direction, and [`ALIKE_SHARE`] of what the measurement states, as outlines err alike in all frames.
    fn view_error(&self, information: &Matrix6<f64>, radius: f64) -> Matrix6<f64> {
        let scale = length_scale(radius);
        let mut eigen = in_lengths(information, radius).symmetric_eigen();
        let least = self.settings.view_error.powi(2);
        eigen.eigenvalues.apply(|x| *x = if *x > SAYS_NOTHING { (least + ALIKE_SHARE / *x).sqrt() } else { 0.0 });
        let root = eigen.recompose();
        Matrix6::from_fn(|i, j| root[(i, j)] / scale[j])
    }

    /// By joint and faces: the views of its child, with the gradient in the global unknowns (columns) that one
    /// `view_error` in each of six directions causes. Looks within `shared_distance` are one view.
    /// `solves` are those of the undamped systems.
    fn views(&self, systems: &[WindowSystem], solves: &[Option<LocalSolve>]) -> Vec<[Vec<(Look, DMatrix<f64>)>; 2]> {
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
            // What all frames of a stay miss by is taken up by its error, as far as its prior lets it.
            let left: Vec<Matrix6<f64>> = self.stays[w]
                .iter()
                .zip(&systems[w].stays)
                .map(|(stay, (_, inverse))| Matrix6::from_diagonal(&stay.information) * inverse)
                .collect();
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
                    let weighted = match row.stay {
                        Some(stay) => error * left[stay] * row.information,
                        None => error * row.information,
                    };
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
}
