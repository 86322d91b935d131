//! The evidence for every (parent, type) of a part: one joint fitted to the part's motion relative
//! to the parent's.
//!
//! Relative displacements D_i⁻¹ D_j must lie on {exp(S q)}. With the parent's track given, the
//! evidence splits by edge: −(robust cost) − (moves) + (Laplace volume of the axis against its prior).
//! A move is a change of joint position from one frame to the next: joints rest unless driven, so a
//! hypothesis that needs one joint to undo another's motion pays for every frame of it.

use std::collections::BTreeMap;

use nalgebra::{Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::kinematics::{Axis, KinematicJoint, KinematicSettings, SharedByFits, fit_edge};
use super::window::{Contact, PoseMeasurement, WindowObservations};
use crate::math::{Pose, Screw, median, orthonormal_pair};
use crate::mechanism::JointType;
use crate::registration::{fit_circle, fit_line};
use crate::types::Label;

/// Cost of one move \[nats\].
pub const MOVE_COST: f64 = 3.0;
/// Standard deviation of a direction's prior \[rad\].
const AXIS_DIRECTION_PRIOR: f64 = 1.0;
/// Frames of one scene are not independent looks: their evidence is raised to this power.
const TEMPERATURE: f64 = 0.5;

/// How loosely a part is held to its own track where scans leave it free \[m\].
const TRACK_SIGMA: f64 = 0.02;
/// What a moving parent's own track adds to the tool's position seen from it \[m\].
const PARENT_SIGMA: f64 = 0.002;

/// A part as edges see it.
#[derive(Clone, Copy, Debug)]
pub struct EdgePart {
    /// Its label.
    pub label: Label,
    /// Reference point \[m\].
    pub center: Vector3<f64>,
    /// Length that scales rotations \[m\].
    pub radius: f64,
}

/// One joint type of one edge.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct EdgeFit {
    /// Log evidence, tempered \[nats\].
    pub log_evidence: f64,
    /// The fitted joint (its `parent` is `None`: relative to the parent's track).
    pub joint: KinematicJoint,
    /// Joint positions by window and frame.
    pub positions: Vec<Vec<f64>>,
    /// What each window adds to the evidence \[nats\].
    pub by_window: Vec<f64>,
}

/// The windows seen from a parent that moves along a track, as the child does along its `own` (by
/// window and frame).
///
/// What the scans leave free is held loosely to the child's own track: the evidence of other edges
/// stands on it, so that a part that is hardly seen cannot carry others and rest at the same time.
pub fn relative_windows(
    part: &EdgePart,
    own: &[Vec<Pose>],
    parent: Option<(&EdgePart, &[Vec<Pose>])>,
    windows: &[&WindowObservations],
) -> Vec<WindowObservations> {
    let (track, center) = (parent.map(|(_, track)| track), part.center);
    let child = part.label;
    let r = part.radius;
    let loose = Matrix6::from_diagonal(&(Vector6::new(r * r, r * r, r * r, 1.0, 1.0, 1.0) / TRACK_SIGMA.powi(2)));
    windows
        .iter()
        .enumerate()
        .map(|(w, window)| {
            let reference = |k: usize| track.map_or_else(Pose::identity, |t| t[w][k].inverse());
            let moves = track.is_some_and(|t| t[w].windows(2).any(|pair| pair[0] != pair[1]));
            let blur = if moves { PARENT_SIGMA } else { 0.0 };
            let relative = |poses: &BTreeMap<Label, Vec<Option<PoseMeasurement>>>| {
                poses
                    .get(&child)
                    .map(|poses| {
                        let seen = |(k, m): (usize, &Option<PoseMeasurement>)| {
                            let m = m.as_ref()?;
                            let relative = PoseMeasurement { displacement: reference(k) * m.displacement, ..*m };
                            let own = parent.and_then(|(part, track)| {
                                Some((part.center, window.own_measurement(part.label, k, &track[w][k])?))
                            });
                            Some(own.map_or(relative, |(about, own)| blurred(&relative, &center, own, &about)))
                        };
                        (child, poses.iter().enumerate().map(seen).collect())
                    })
                    .into_iter()
                    .collect()
            };
            let mut poses: BTreeMap<Label, Vec<Option<PoseMeasurement>>> = relative(&window.poses);
            // What is measured directly is all there.
            if let Some(poses) = poses.get_mut(&child).filter(|_| !window.direct.contains_key(&child)) {
                for (k, measured) in poses.iter_mut().enumerate() {
                    let unseen =
                        PoseMeasurement { displacement: reference(k) * own[w][k], information: Matrix6::zeros() };
                    measured.get_or_insert(unseen).information += loose;
                }
            }
            WindowObservations {
                times_s: window.times_s.clone(),
                poses,
                later_faces: relative(&window.later_faces),
                direct: window.direct.clone(),
                contacts: window
                    .contacts
                    .iter()
                    .filter(|c| c.label == child)
                    .map(|c| Contact {
                        label: child,
                        track: c
                            .track
                            .iter()
                            .map(|(k, x, s)| (*k, reference(*k).transform_point(x), s.hypot(blur)))
                            .collect(),
                    })
                    .collect(),
                ..WindowObservations::default()
            }
        })
        .collect()
}

/// A relative measurement with the noise of the parent's own, `about` the parent's reference point:
/// (Λ⁻¹ + A Σ Aᵀ)⁻¹ with A = Ad of parent's reference point from the child's. The parent's own rotation
/// must be measured.
fn blurred(
    relative: &PoseMeasurement,
    center: &Vector3<f64>,
    parent: &PoseMeasurement,
    about: &Vector3<f64>,
) -> PoseMeasurement {
    let between = Pose::from_translation(-about) * relative.displacement * Pose::from_translation(*center);
    let carried = between.adjoint_matrix();
    // The parent's information in the child's axes is the inverse of A Σ Aᵀ.
    let noise = carried.transpose() * parent.information * carried;
    let own = relative.information;
    let information = (own + noise).cholesky().map_or(own, |sum| own - own * sum.solve(&own));
    PoseMeasurement { information: (information + information.transpose()) * 0.5, ..*relative }
}

/// Evidence of no motion at all relative to the parent \[nats\], and what each window adds to it. `shared` is
/// that of other fits of the part to these windows.
pub fn rigid_evidence(
    part: &EdgePart,
    windows: &[WindowObservations],
    settings: &KinematicSettings,
    shared: &SharedByFits,
) -> (f64, Vec<f64>) {
    let still = KinematicJoint {
        parent: None,
        child: part.label,
        joint_type: JointType::Rigid,
        axis: Axis { direction: Vector3::z(), point: part.center },
        center: part.center,
        radius: part.radius,
        suggested: None,
    };
    let references: Vec<&WindowObservations> = windows.iter().collect();
    let positions = windows.iter().map(|w| vec![vec![0.0; w.times_s.len()]]).collect();
    let frozen = KinematicSettings { steps: 2, ..*settings };
    let fit = fit_edge(still, positions, &references, &frozen, shared);
    (-TEMPERATURE * fit.cost, fit.window_costs.iter().map(|cost| -TEMPERATURE * cost).collect())
}

/// Fits one moving type from each start axis and keeps the best; `resting`: the windows in which the
/// part keeps its place on the parent. `shared` is that of other fits of the part to these windows.
pub fn moving_evidence(
    part: &EdgePart,
    joint_type: JointType,
    starts: &[Axis],
    (windows, resting): (&[WindowObservations], &[bool]),
    settings: &KinematicSettings,
    shared: &SharedByFits,
) -> Option<EdgeFit> {
    let references: Vec<&WindowObservations> = windows.iter().collect();
    starts
        .iter()
        .map(|axis| {
            let along = axis.direction.dot(&(part.center - axis.point));
            let joint = KinematicJoint {
                parent: None,
                child: part.label,
                joint_type,
                axis: Axis { direction: axis.direction, point: axis.point + axis.direction * along },
                center: part.center,
                radius: part.radius,
                suggested: None,
            };
            let positions =
                windows.iter().zip(resting).map(|(w, rests)| vec![start_positions(&joint, w, *rests)]).collect();
            let fit = fit_edge(joint, positions, &references, settings, shared);
            let parameters = joint.axis_parameters();
            let width = joint.axis_point_prior();
            let priors = [AXIS_DIRECTION_PRIOR, AXIS_DIRECTION_PRIOR, width, width];
            let volume: f64 = (0..parameters)
                .map(|i| 0.5 * fit.covariance[(i, i)].max(1e-16).ln() - priors[i].ln())
                .map(|x: f64| x.min(0.0))
                .sum();
            let move_cost = |moves: usize| MOVE_COST * TEMPERATURE * moves as f64;
            let log_evidence = -TEMPERATURE * fit.cost - move_cost(fit.moves[0].iter().sum()) + volume;
            let by_window = fit.window_costs.iter().zip(&fit.moves[0]);
            EdgeFit {
                log_evidence,
                by_window: by_window.map(|(cost, moves)| -TEMPERATURE * cost - move_cost(*moves)).collect(),
                joint: fit.joints[0],
                positions: fit.positions.into_iter().map(|mut w| w.swap_remove(0)).collect(),
            }
        })
        .filter(|fit| fit.log_evidence.is_finite())
        .max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence))
}

/// Start axes from the motion itself: the relative displacement between the two frames furthest apart.
pub fn axes_from_motion(part: &EdgePart, joint_type: JointType, windows: &[WindowObservations]) -> Vec<Axis> {
    let place = |d: &Pose| (d.transform_point(&part.center), d.rotation);
    let mut best: Option<(f64, Pose, Pose)> = None;
    for window in windows {
        let measured: Vec<Pose> =
            window.poses.get(&part.label).into_iter().flatten().flatten().map(|m| m.displacement).collect();
        for first in measured.iter().step_by((measured.len() / 6).max(1)) {
            for second in &measured {
                let ((p, r), (q, s)) = (place(first), place(second));
                let apart = (p - q).norm() + part.radius * (r - s).norm();
                if best.as_ref().is_none_or(|(b, _, _)| apart > *b) {
                    best = Some((apart, *first, *second));
                }
            }
        }
    }
    let Some((_, first, second)) = best else { return Vec::new() };
    let points = measured_points(part, windows);
    if !points.is_empty() {
        let seed = match joint_type {
            JointType::Prismatic => fit_line(&points),
            _ => fit_circle(&points),
        };
        let seed = seed.map(|(seed, _)| seed);
        return seed
            .map(|s| Axis { direction: s.direction, point: s.point.unwrap_or(part.center) })
            .into_iter()
            .collect();
    }
    let shift = second.transform_point(&part.center) - first.transform_point(&part.center);
    match joint_type {
        JointType::Prismatic => {
            shift.try_normalize(1e-6).map(|direction| Axis { direction, point: part.center }).into_iter().collect()
        }
        JointType::Revolute => {
            // Screw of the motion between the two frames, in the parent's frame at reference.
            let twist = (second * first.inverse()).log();
            let angular: Vector3<f64> = twist.fixed_rows::<3>(0).into();
            let linear: Vector3<f64> = twist.fixed_rows::<3>(3).into();
            let angle = angular.norm();
            if angle < 0.02 {
                return far_axes(&shift, &part.center);
            }
            let direction = angular / angle;
            vec![Axis { direction, point: direction.cross(&linear) / angle }]
        }
        JointType::Rigid => Vec::new(),
    }
}

/// Where a part's point was measured to be, where that is all that was measured.
fn measured_points(part: &EdgePart, windows: &[WindowObservations]) -> Vec<Vector3<f64>> {
    let poses = windows.iter().filter_map(|window| window.poses.get(&part.label)).flatten().flatten();
    poses.filter(|m| !m.rotation_is_measured()).map(|m| m.point(&part.center)).collect()
}

/// Far axes that turn a nearly straight motion.
fn far_axes(shift: &Vector3<f64>, center: &Vector3<f64>) -> Vec<Axis> {
    let Some(along) = shift.try_normalize(1e-6) else { return Vec::new() };
    let (first, second) = orthonormal_pair(&along);
    [(first, second), (first, -second), (second, first), (second, -first)]
        .into_iter()
        .map(|(direction, away)| Axis { direction, point: center + away })
        .collect()
}

/// Joint positions nearest the measured poses: Gauss–Newton on each frame alone, or their median
/// where the joint rests.
fn start_positions(joint: &KinematicJoint, window: &WindowObservations, rests: bool) -> Vec<f64> {
    let screw = joint.screw();
    let mut last = 0.0;
    let poses = window.poses.get(&joint.child);
    let mut positions: Vec<f64> = (0..window.times_s.len())
        .map(|k| {
            if let Some(m) = poses.and_then(|p| p[k]) {
                last = nearest_position(joint, &screw, &m, last);
            }
            last
        })
        .collect();
    if rests && let Some(place) = median(positions.clone()) {
        positions.fill(place);
    }
    positions
}

/// The joint position whose displacement is nearest a measured one, from `start`.
pub fn nearest_position(joint: &KinematicJoint, screw: &Screw, measured: &PoseMeasurement, start: f64) -> f64 {
    let compare = |q: f64| measured.compare(&measured.information, &joint.center, &screw.displacement(q));
    let residual = |q: f64| compare(q).0;
    let guesses = match joint.joint_type {
        JointType::Revolute if !measured.rotation_is_measured() => {
            let from = joint.center - joint.axis.point;
            let to = measured.point(&joint.center) - joint.axis.point;
            [start, joint.axis.direction.dot(&from.cross(&to)).atan2(from.dot(&to) - axial(joint, &from, &to))]
        }
        JointType::Revolute => [start, measured.displacement.turn_about(&joint.axis.direction, 0.0)],
        _ => {
            let shift = measured.displacement.transform_point(&joint.center) - joint.center;
            [start, shift.dot(&joint.axis.direction)]
        }
    };
    let mut best = (f64::INFINITY, start);
    for mut q in guesses {
        for _ in 0..4 {
            let h = 1e-5;
            let slope = (residual(q + h) - residual(q - h)) / (2.0 * h);
            let weighted = compare(q).1 * slope;
            let curvature = weighted.dot(&slope);
            if curvature < 1e-6 {
                break;
            }
            q -= (weighted.dot(&residual(q)) / curvature).clamp(-0.3, 0.3);
        }
        let (r, information) = compare(q);
        let cost = r.dot(&(information * r));
        if cost < best.0 {
            best = (cost, q);
        }
    }
    best.1
}

/// Product of two vectors' components along a joint's axis \[m²\].
fn axial(joint: &KinematicJoint, from: &Vector3<f64>, to: &Vector3<f64>) -> f64 {
    joint.axis.direction.dot(from) * joint.axis.direction.dot(to)
}
