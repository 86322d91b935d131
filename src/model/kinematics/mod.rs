//! Screw axes, joint positions, contact points and the tool's offset, jointly, from measured poses.
//!
//! For part j with parent i: D_j = D_i · exp(S_j q_j). A pose measurement contributes
//! r = log(T(−c) D_obs⁻¹ D_j T(c)) with its information; a contact contributes x − o − D_j p with the
//! contact point p free per contact and the tool's offset o shared by all. Moving the axis by a
//! small rigid motion δ moves exp(S q) by the left twist (I − Ad(exp(S q))) δ.
//!
//! Gauss–Newton with Student-t weights; each window's joint positions and contact points are
//! eliminated, so the cost is linear in the number of windows.

mod equations;
mod problem;
mod rests;
mod views;

use std::cell::OnceCell;
use std::rc::Rc;

use nalgebra::{DMatrix, Vector2, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use self::problem::{FaceInformation, Problem};
use super::window::WindowObservations;
use crate::math::{Pose, Screw, orthonormal_pair};
use crate::mechanism::JointType;
use crate::registration::Suggestion;
use crate::types::Label;

/// How closely axes follow the faces they are aligned with \[rad\].
const ALIGNED_SIGMA: f64 = 0.007;

/// Steps with freed joints before rests are looked for.
const FREE_STEPS: usize = 3;

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
    /// Registration error of a frame of its own, beside what its measurement states \[m\].
    pub own_error: f64,
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
            own_error: 0.001,
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

/// The joints that carry a joint, its own not among them.
pub fn carriers(joints: &[KinematicJoint], joint: usize) -> impl Iterator<Item = usize> {
    std::iter::successors(joints[joint].parent, |&j| joints[j].parent)
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
    let mut problem = Problem::new(joints, positions, windows, settings, &shared);
    problem.stays_apart = true;
    let (problem, cost, converged) = solved(problem);
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
    // When rests are looked for at the latest, once frames share their errors.
    let mut tie_at = None;
    for step in 0..problem.settings.steps {
        if !tied && (converged || step == tie_at.unwrap_or(problem.settings.steps / 2)) {
            let first = tie_at.is_none();
            if first {
                problem.share_errors();
                tie_at = Some(step + FREE_STEPS);
            }
            tied = !(first && problem.stays_apart && problem.free_movers());
            if tied {
                problem.tie_rests();
            }
            of_windows = problem.windows_cost();
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

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use nalgebra::{Matrix6, Vector6};

    use super::*;
    use crate::model::window::{Contact, PoseMeasurement};

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

    /// A slide on a link that turns by so many radians while the slide is pulled out; it is
    /// taken to rest at the start.
    fn slide_on_a_link(turned: f64) -> KinematicFit {
        let joint = |parent, child, joint_type, direction, center: Vector3<f64>| KinematicJoint {
            parent,
            child: Label(child),
            joint_type,
            axis: Axis { direction, point: Vector3::zeros() },
            center,
            radius: 0.15,
            suggested: None,
        };
        let joints = vec![
            joint(None, 1, JointType::Revolute, Vector3::z(), Vector3::x() * 0.2),
            joint(Some(0), 2, JointType::Prismatic, Vector3::x(), Vector3::x() * 0.4),
        ];
        let positions = [0.0; 10].into_iter().chain((0..20).map(|k| 0.15 * f64::from(k) / 19.0));
        let slide: Vec<f64> = positions.chain([0.15; 10]).collect();
        let link: Vec<f64> = slide.iter().map(|q| turned * q / 0.15).collect();
        let information = Matrix6::from_diagonal(&Vector6::new(1e5, 1e5, 1e5, 1e6, 1e6, 1e6));
        let seen = |joint: usize| {
            let place = |k: usize| forward(&joints, |j| [link[k], slide[k]][j])[joint];
            (0..slide.len()).map(|k| Some(PoseMeasurement { displacement: place(k), information })).collect()
        };
        let tip = |k: usize| forward(&joints, |j| [link[k], slide[k]][j])[1].transform_point(&(Vector3::x() * 0.5));
        let window = WindowObservations {
            times_s: (0..slide.len()).map(|k| 0.1 * k as f64).collect(),
            poses: BTreeMap::from([(Label(1), seen(0)), (Label(2), seen(1))]),
            contacts: vec![Contact { label: Label(2), track: (0..slide.len()).map(|k| (k, tip(k), 0.002)).collect() }],
            ..WindowObservations::default()
        };
        let start = vec![vec![vec![0.0; slide.len()], slide.clone()]];
        fit_kinematics(joints, start, &[&window], &KinematicSettings::default())
    }

    #[test]
    fn a_link_that_gives_way_does_not_turn_what_slides_on_it() {
        let fit = slide_on_a_link(0.015);
        let off = fit.joints[1].axis.direction.angle(&Vector3::x()).to_degrees();
        let spread = fit.covariance[(4, 4)].max(fit.covariance[(5, 5)]).sqrt().to_degrees();
        assert!(off < 0.5, "{off} degrees, stated {spread}");
        let turned = fit.positions[0][0][39] - fit.positions[0][0][0];
        assert!((turned - 0.015).abs() < 0.003, "{turned}");
    }

    #[test]
    fn a_link_that_rests_is_one_position() {
        let fit = slide_on_a_link(0.0);
        assert!(fit.positions[0][0].windows(2).all(|pair| pair[0] == pair[1]), "{:?}", fit.positions[0][0]);
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
