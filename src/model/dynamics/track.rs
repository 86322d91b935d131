//! What a window measured of its joints' positions, in joint space, and the wrenches that acted.
//!
//! Tool positions x in bins of 40 ms and part poses are linearized about the joint positions that
//! explain them best: each observation is H q with unit noise. Given the axes and the tool's offset
//! o, the contact point p follows from the track itself: the track's circle gives the lever, so that
//! errors of axis and o cancel in it as they should. Where p is on the part only the clouds can say,
//! and they err by their own: its error is one unknown of the window, so that the tool measures
//! motion, and not where zero is.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector, Matrix3, Vector3, Vector6};

use crate::math::{Pose, median};
use crate::mechanism::{JointType, WrenchSample};
use crate::model::window::with_shared_error;
use crate::model::{Axis, Contact, KinematicJoint, WindowObservations};
use crate::types::{AppliedWrench, Label, Stamp};

/// Span of tool positions that make one observation \[s\].
const BIN_S: f64 = 0.04;
/// Registration error that frames at one pose share \[m\], and how near that is \[m\]; see
/// [`crate::model::KinematicSettings`].
const SHARED_ERROR: f64 = 0.0015;
const SHARED_DISTANCE: f64 = 0.010;
/// Degrees of freedom of the weights on part poses.
const STUDENT_FREEDOM: f64 = 6.0;
/// The wrench acts this long before and after the contact's frames \[s\]: half a frame.
const CONTACT_MARGIN_S: f64 = 0.1;
/// Standard deviation of the contact point on its part \[m\]: what the clouds' shared error leaves
/// open; see [`crate::model::KinematicSettings`].
pub const CONTACT_DEVIATION: f64 = 0.020;
/// Standard deviation of where a hinge's measured angles count from, in streams after the first \[rad\].
const ZERO_DEVIATION: f64 = 0.035;
/// Least standard deviation of one tool position \[m\].
const LEAST_TOOL_DEVIATION: f64 = 1e-4;

/// What of the kinematic fit a window's track depends on.
#[derive(Clone, Debug)]
pub struct TrackKinematics {
    /// Axes by joint.
    pub axes: Vec<Axis>,
    /// o \[m\].
    pub tool_offset: Vector3<f64>,
}

/// One window as the kinematic fit sees it.
pub struct TrackSource<'a> {
    /// Joints, parents first.
    pub joints: &'a [KinematicJoint],
    /// Joint positions by joint and frame.
    pub positions: &'a [Vec<f64>],
    /// Measurements.
    pub window: &'a WindowObservations,
    /// Contacts, the tool's position used or not.
    pub contacts: &'a [Contact],
    /// Contact points by contact, if fitted.
    pub contact_points: &'a [Vector3<f64>],
    /// Whether the tool's position is an observation.
    pub use_tool: bool,
    /// Time zero.
    pub zero: Stamp,
    /// Joints that move in the window, by index.
    pub moving: &'a [usize],
}

/// H q + G e with unit noise, e the error of the contact point.
#[derive(Clone, Debug)]
pub struct Observation {
    /// \[s\] since time zero.
    pub time_s: f64,
    /// One column per moving joint.
    pub rows: DMatrix<f64>,
    /// G, three columns; zero for what clouds measured.
    pub contact_rows: DMatrix<f64>,
    /// H q + G e as measured.
    pub value: DVector<f64>,
}

/// A window in joint space.
#[derive(Clone, Debug)]
pub struct JointTrack {
    /// In order of time.
    pub observations: Vec<Observation>,
    /// Smoothed positions of the moving joints at the observations.
    pub positions: Vec<DVector<f64>>,
    /// All wrenches that acted on the joints' children.
    pub drives: Vec<Drive>,
    /// By moving joint, the standard deviation of a constant error of its measured positions \[rad\].
    pub zero_deviations: Vec<f64>,
}

/// One wrench over a window: of a tool, at the true contact x − o and zero without contact, or of what
/// else acts on a part.
#[derive(Clone, Debug)]
pub struct Drive {
    /// The joint whose child it acts on.
    pub joint: usize,
    /// Whether it is a tool's, with zeros about the contact.
    pub tool: bool,
    /// Readings in order of time.
    pub samples: Vec<WrenchSample>,
    /// Standard deviation of one force reading, per axis \[N\].
    pub force_deviation: f64,
    /// Standard deviation of one torque reading, per axis \[N·m\].
    pub torque_deviation: f64,
    /// Span between two readings \[s\].
    pub sample_span_s: f64,
}

impl Drive {
    fn new(joint: usize, samples: Vec<WrenchSample>) -> Self {
        let readings = |of: fn(&WrenchSample) -> Vector3<f64>| -> Vec<(f64, Vector3<f64>)> {
            samples.iter().map(|s| (s.stamp_s, of(s))).collect()
        };
        let span_s = samples.last().map_or(0.0, |l| l.stamp_s - samples[0].stamp_s);
        Self {
            joint,
            tool: false,
            force_deviation: local_deviation(&readings(|s| s.force_in_world)),
            torque_deviation: local_deviation(&readings(|s| s.torque_in_world)),
            sample_span_s: span_s / (samples.len().max(2) - 1) as f64,
            samples,
        }
    }
}

impl TrackSource<'_> {
    fn displacements(&self, axes: &[Axis], q: &[f64]) -> Vec<Pose> {
        let mut all: Vec<Pose> = Vec::with_capacity(self.joints.len());
        for (k, joint) in self.joints.iter().enumerate() {
            let parent = joint.parent.map_or_else(Pose::identity, |p| all[p]);
            all.push(parent * KinematicJoint { axis: axes[k], ..*joint }.screw().displacement(q[k]));
        }
        all
    }

    /// Twist of joint `of`'s child per rate of each moving joint (zero if it is no ancestor).
    fn twists(&self, axes: &[Axis], displacements: &[Pose], of: usize) -> Vec<Vector6<f64>> {
        let mut twists = vec![Vector6::zeros(); self.moving.len()];
        let mut at = Some(of);
        while let Some(k) = at {
            let joint = &self.joints[k];
            if let Some(column) = self.moving.iter().position(|&m| m == k) {
                let parent = joint.parent.map_or_else(Pose::identity, |p| displacements[p]);
                twists[column] = parent.adjoint(&KinematicJoint { axis: axes[k], ..*joint }.screw().0);
            }
            at = joint.parent;
        }
        twists
    }

    /// Positions of all joints at a time, between the frames.
    fn positions_at(&self, time_s: f64) -> Vec<f64> {
        let times = &self.window.times_s;
        let after = times.partition_point(|&t| t < time_s).clamp(1, times.len() - 1);
        let (t0, t1) = (times[after - 1], times[after]);
        let weight = ((time_s - t0) / (t1 - t0)).clamp(0.0, 1.0);
        self.positions.iter().map(|p| p[after - 1] + weight * (p[after] - p[after - 1])).collect()
    }

    /// Encoders count from where they were switched on, which is another place with every stream.
    fn zero_deviation(&self, joint: &KinematicJoint) -> f64 {
        let counted = self.window.stream > 0 && self.window.direct.contains_key(&joint.child);
        if counted && joint.joint_type == JointType::Revolute { ZERO_DEVIATION } else { 0.0 }
    }

    /// The contacts with the joints' children: joint, span \[s\], contact and its point, if fitted.
    fn touches(&self) -> Vec<Touch> {
        let touch = |(index, contact): (usize, &'_ Contact)| {
            let joint = self.joints.iter().position(|j| j.child == contact.label)?;
            let (time, point) =
                (|k: usize| self.window.times_s.get(k).copied(), self.contact_points.get(index).copied());
            let span_s = (time(contact.track.first()?.0)?, time(contact.track.last()?.0)?);
            let mean = contact.track.iter().map(|(_, x, _)| x).sum::<Vector3<f64>>() / contact.track.len() as f64;
            Some(Touch { joint, label: contact.label, span_s, point, mean })
        };
        self.contacts.iter().enumerate().filter_map(touch).collect()
    }
}

/// A tool's contact with a joint's child.
struct Touch {
    joint: usize,
    label: Label,
    span_s: (f64, f64),
    /// The contact point at the reference configuration, if fitted \[m\].
    point: Option<Vector3<f64>>,
    /// Mean place of the tool \[m\].
    mean: Vector3<f64>,
}

/// Which contact a tool's reading belongs to: that of the part it is bound to, else the nearest.
fn contact_of(touches: &[Touch], reading: &AppliedWrench) -> Option<usize> {
    match reading.part {
        Some(part) => touches.iter().position(|touch| touch.label == part),
        None => {
            let away = |touch: &Touch| (touch.mean - reading.point_in_world).norm();
            (0..touches.len()).min_by(|&a, &b| away(&touches[a]).total_cmp(&away(&touches[b])))
        }
    }
}

/// The window in joint space, given the axes and the tool's offset. `None` with fewer than two
/// frames.
pub fn joint_track(source: &TrackSource<'_>, kinematics: &TrackKinematics) -> Option<JointTrack> {
    let times = &source.window.times_s;
    if times.len() < 2 {
        return None;
    }
    let (begin_s, end_s) = (times[0], times[times.len() - 1]);
    let seconds = |w: &AppliedWrench| w.stamp.seconds_since(source.zero);
    let readings: Vec<&AppliedWrench> =
        source.window.wrenches.iter().filter(|w| (begin_s - 0.1..=end_s + 0.1).contains(&seconds(w))).collect();
    let sample = |w: &AppliedWrench, offset: Vector3<f64>| WrenchSample {
        stamp_s: seconds(w),
        point_in_world: w.point_in_world - offset,
        force_in_world: w.force_in_world,
        torque_in_world: w.torque_in_world,
    };
    let touches = source.touches();
    let mut drives = Vec::new();
    let mut located: Vec<(f64, Located)> = frame_information(source, kinematics);
    for (index, touch) in touches.iter().enumerate() {
        let own: Vec<&AppliedWrench> =
            readings.iter().copied().filter(|w| w.tool && contact_of(&touches, w) == Some(index)).collect();
        let (from_s, to_s) = touch.span_s;
        let in_contact =
            |w: &&&AppliedWrench| (from_s - CONTACT_MARGIN_S..=to_s + CONTACT_MARGIN_S).contains(&seconds(w));
        let samples = own.iter().filter(in_contact).map(|w| sample(w, kinematics.tool_offset)).collect();
        let drive = Drive::new(touch.joint, samples);
        // What its torque's noise does to the joints is next to nothing beside what its force's does.
        drives.push(Drive { tool: true, samples: with_ends(drive.samples), torque_deviation: 0.0, ..drive });
        if source.use_tool {
            let tool: Vec<(f64, Vector3<f64>)> = own
                .iter()
                .map(|w| (seconds(w), w.point_in_world))
                .filter(|(t, _)| *t >= from_s && *t <= to_s)
                .collect();
            located.extend(tool_information(source, kinematics, touch.joint, touch.point, &tool));
        }
    }
    for (joint, child) in source.joints.iter().map(|j| j.child).enumerate() {
        let acting = |w: &&&AppliedWrench| !w.tool && w.part == Some(child);
        let samples: Vec<WrenchSample> = readings.iter().filter(acting).map(|w| sample(w, Vector3::zeros())).collect();
        if !samples.is_empty() {
            drives.push(Drive::new(joint, samples));
        }
    }
    located.sort_by(|a, b| a.0.total_cmp(&b.0));
    let mut observations: Vec<Observation> = Vec::with_capacity(located.len());
    let mut positions = Vec::with_capacity(located.len());
    for (time_s, located) in located {
        if let Some((rows, contact_rows, value)) = located.whitened() {
            observations.push(Observation { time_s, rows, contact_rows, value });
            positions.push(located.position);
        }
    }
    let zero_deviation = |&joint: &usize| source.zero_deviation(&source.joints[joint]);
    let zero_deviations = source.moving.iter().map(zero_deviation).collect();
    Some(JointTrack { observations, positions, drives, zero_deviations })
}

/// Lets the force be zero outside of the contact.
fn with_ends(mut samples: Vec<WrenchSample>) -> Vec<WrenchSample> {
    let at_rest = |sample: &WrenchSample, shift_s: f64| WrenchSample {
        stamp_s: sample.stamp_s + shift_s,
        force_in_world: Vector3::zeros(),
        torque_in_world: Vector3::zeros(),
        ..*sample
    };
    if let (Some(first), Some(last)) = (samples.first().copied(), samples.last().copied()) {
        samples.insert(0, at_rest(&first, -0.008));
        samples.push(at_rest(&last, 0.008));
    }
    samples
}

/// Standard deviation, per axis, about quadratics over runs of 9 readings.
fn local_deviation(track: &[(f64, Vector3<f64>)]) -> f64 {
    let usual = median(track.chunks_exact(9).filter_map(run_variance).collect());
    // The median of a χ² of 18 degrees of freedom is .963 of its mean.
    usual.map_or(0.0, |variance| (variance / 0.963).sqrt())
}

fn run_variance(run: &[(f64, Vector3<f64>)]) -> Option<f64> {
    let middle = run[run.len() / 2].0;
    let scale = (run[run.len() - 1].0 - run[0].0).max(1e-6);
    let row = |t: f64| Vector3::new(1.0, (t - middle) / scale, ((t - middle) / scale).powi(2));
    let mut matrix = Matrix3::zeros();
    let mut right = Matrix3::zeros();
    for (t, x) in run {
        matrix += row(*t) * row(*t).transpose();
        right += row(*t) * x.transpose();
    }
    let solution = matrix.try_inverse()? * right;
    let squares: f64 = run.iter().map(|(t, x)| (solution.transpose() * row(*t) - x).norm_squared()).sum();
    Some(squares / (3.0 * (run.len() as f64 - 3.0)))
}

/// Information A and A · q of the moving joints, about `position`.
struct Located {
    information: DMatrix<f64>,
    weighted: DVector<f64>,
    /// By how much A · q is too large per error of the contact point.
    contact: DMatrix<f64>,
    position: DVector<f64>,
}

impl Located {
    /// Lᵀ q + L⁻¹ C e = L⁻¹ (A q) with A = L Lᵀ: smooth in what A is made of.
    fn whitened(&self) -> Option<(DMatrix<f64>, DMatrix<f64>, DVector<f64>)> {
        let ridge = 1e-6 * self.information.diagonal().max() + 1e-9;
        let mut matrix = self.information.clone();
        let mut right = self.weighted.clone();
        for i in 0..matrix.nrows() {
            matrix[(i, i)] += ridge;
            right[i] += ridge * self.position[i];
        }
        if self.information.diagonal().max() <= 0.0 {
            return None;
        }
        let lower = matrix.cholesky()?.unpack();
        let value = lower.solve_lower_triangular(&right)?;
        let contact = lower.solve_lower_triangular(&self.contact)?;
        Some((lower.transpose(), contact, value))
    }
}

/// Bins of the tool's track as information about the moving joints.
fn tool_information(
    source: &TrackSource<'_>,
    kinematics: &TrackKinematics,
    touched: usize,
    point: Option<Vector3<f64>>,
    tool: &[(f64, Vector3<f64>)],
) -> Vec<(f64, Located)> {
    let mut bins: Vec<(f64, Vector3<f64>, f64)> = Vec::new();
    let mut start = 0;
    for i in 0..=tool.len() {
        if i == tool.len() || tool[i].0 - tool[start].0 >= BIN_S {
            let count = (i - start) as f64;
            if i > start {
                let run = &tool[start..i];
                let time_s = run.iter().map(|(t, _)| t).sum::<f64>() / count;
                bins.push((time_s, run.iter().map(|(_, x)| x).sum::<Vector3<f64>>() / count, count));
            }
            start = i;
        }
    }
    let deviation = local_deviation(tool).max(LEAST_TOOL_DEVIATION);
    let mut positions: Vec<Vec<f64>> = bins.iter().map(|(t, _, _)| source.positions_at(*t)).collect();
    let carried = |q: &[f64], x: &Vector3<f64>| {
        source.displacements(&kinematics.axes, q)[touched].inverse().transform_point(&(x - kinematics.tool_offset))
    };
    let mean_point = |positions: &[Vec<f64>]| {
        let sum: Vector3<f64> = bins.iter().zip(positions).map(|((_, x, _), q)| carried(q, x)).sum();
        sum / bins.len().max(1) as f64
    };
    let mut point = point.unwrap_or_else(|| mean_point(&positions));
    let n = source.moving.len();
    // What the clouds said of a joint's position, for directions the tool does not see.
    let anchor = DMatrix::identity(n, n) * 1e-3;
    let mut result = Vec::new();
    for round in 0..4 {
        result.clear();
        for ((time_s, x, count), q) in bins.iter().zip(&mut positions) {
            let variance = deviation * deviation / count;
            let displacements = source.displacements(&kinematics.axes, q);
            let moved = displacements[touched].transform_point(&point);
            let residual = x - kinematics.tool_offset - moved;
            let columns: Vec<Vector3<f64>> = source
                .twists(&kinematics.axes, &displacements, touched)
                .iter()
                .map(|v| Vector3::new(v[0], v[1], v[2]).cross(&moved) + Vector3::new(v[3], v[4], v[5]))
                .collect();
            let information = DMatrix::from_fn(n, n, |i, j| columns[i].dot(&columns[j]) / variance);
            let slope = DVector::from_fn(n, |i, _| columns[i].dot(&residual) / variance);
            let position = DVector::from_fn(n, |i, _| q[source.moving[i]]);
            let regular = &information + &anchor * information.diagonal().max();
            let step = regular.cholesky().map_or_else(|| DVector::zeros(n), |c| c.solve(&slope));
            let weighted = &information * &position + &slope;
            for (i, &joint) in source.moving.iter().enumerate() {
                q[joint] += step[i].clamp(-0.2, 0.2);
            }
            if round == 3 {
                let position = DVector::from_fn(n, |i, _| q[source.moving[i]]);
                let rotation = displacements[touched].rotation;
                let contact = DMatrix::from_fn(n, 3, |i, j| columns[i].dot(&rotation.column(j)) / variance);
                result.push((*time_s, Located { information, weighted, contact, position }));
            }
        }
        point = mean_point(&positions);
    }
    result
}

/// Part poses as information about the moving joints, at every frame.
fn frame_information(source: &TrackSource<'_>, kinematics: &TrackKinematics) -> Vec<(f64, Located)> {
    let n = source.moving.len();
    let frames = source.window.times_s.len();
    let all: Vec<Vec<Pose>> = (0..frames)
        .map(|k| {
            let q: Vec<f64> = source.positions.iter().map(|p| p[k]).collect();
            source.displacements(&kinematics.axes, &q)
        })
        .collect();
    (0..frames)
        .map(|k| {
            let mut located = Located {
                information: DMatrix::zeros(n, n),
                weighted: DVector::zeros(n),
                contact: DMatrix::zeros(n, 3),
                position: DVector::from_fn(n, |i, _| source.positions[source.moving[i]][k]),
            };
            for (j, joint) in source.joints.iter().enumerate() {
                let Some(measured) = source.window.poses.get(&joint.child).and_then(|p| p.get(k).copied().flatten())
                else {
                    continue;
                };
                let twists = source.twists(&kinematics.axes, &all[k], j);
                if twists.iter().all(|t| *t == Vector6::zeros()) {
                    continue;
                }
                let here = place(joint, &all[k][j]);
                let sharing = all.iter().filter(|d| (place(joint, &d[j]) - here).norm() < SHARED_DISTANCE).count();
                let variance = match source.window.direct.contains_key(&joint.child) {
                    true => 0.0,
                    false => sharing as f64 * SHARED_ERROR * SHARED_ERROR,
                };
                let Some(information) = with_shared_error(&measured.information, joint.radius, variance) else {
                    continue;
                };
                let (residual, information) = measured.compare(&information, &joint.center, &all[k][j]);
                let weight = (STUDENT_FREEDOM + measured.dimensions())
                    / (STUDENT_FREEDOM + residual.dot(&(information * residual)));
                let into_body = (Pose::from_translation(-joint.center) * all[k][j].inverse()).adjoint_matrix();
                let columns: Vec<Vector6<f64>> = twists.iter().map(|t| into_body * t).collect();
                for a in 0..n {
                    located.weighted[a] -= weight * columns[a].dot(&(information * residual));
                    for b in 0..n {
                        located.information[(a, b)] += weight * columns[a].dot(&(information * columns[b]));
                    }
                }
            }
            located.weighted += &located.information * &located.position;
            (source.window.times_s[k], located)
        })
        .collect()
}

/// A part's place with its turn made comparable \[m\].
fn place(joint: &KinematicJoint, pose: &Pose) -> Vector6<f64> {
    let turned = pose.rotation * Vector3::repeat(joint.radius / 3f64.sqrt());
    let center = pose.transform_point(&joint.center);
    Vector6::new(center.x, center.y, center.z, turned.x, turned.y, turned.z)
}

/// The touched label of a window's contacts, if any.
pub fn touched_label(contacts: &[Contact]) -> Option<Label> {
    contacts.iter().find(|c| !c.track.is_empty()).map(|c| c.label)
}

/// The parts that a wrench acts on in a window.
pub fn driven_labels(contacts: &[Contact], window: &WindowObservations) -> BTreeSet<Label> {
    let touched = contacts.iter().filter(|c| !c.track.is_empty()).map(|c| c.label);
    touched.chain(window.wrenches.iter().filter(|w| !w.tool).filter_map(|w| w.part)).collect()
}
