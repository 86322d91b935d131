//! Recovery, gradients and calibration on windows made with the project's own simulator.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, Matrix3, Matrix6, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::innovations::WindowModel;
use super::layout::{DAMPING, FRICTION, INERTIA, LIMIT_DEVIATION, UPPER};
use super::layout::{JointScales, Mechanism, SIZE, SensorModel, joint_models};
use super::learner::{DynamicsInput, DynamicsLearner};
use super::posterior::DynamicsPosterior;
use super::track::{TrackKinematics, TrackSource, joint_track};
use crate::geometry::HullProperties;
use crate::inference::{Sampler, SamplingSettings};
use crate::math::{Pose, Screw, orthonormal_pair};
use crate::mechanism::{Body, JointParameters, JointType, Limit, State, Tree, WrenchSample, WrenchTrack, rollout};
use crate::model::{Axis, Contact, KinematicFit, KinematicJoint, WindowObservations};
use crate::types::{AppliedWrench, Label, Stamp};

const GRAVITY: Vector3<f64> = Vector3::new(0.0, 0.0, -9.81);
const TOOL_NOISE: f64 = 0.001;
const FORCE_NOISE: f64 = 0.1;

struct Truth {
    joints: Vec<KinematicJoint>,
    tree: Tree<f64>,
    hulls: BTreeMap<Label, HullProperties>,
    touched: usize,
    contact: Vector3<f64>,
}

fn hull(center: Vector3<f64>) -> HullProperties {
    HullProperties {
        volume: 0.012,
        center,
        inertia_per_density: Matrix3::identity() * (0.012 * 0.03),
        spread: Vector3::repeat(0.12),
        vertices: Vec::new(),
        triangles: Vec::new(),
    }
}

fn joint(
    parent: Option<usize>,
    label: u32,
    axis: Option<(Vector3<f64>, Vector3<f64>)>,
    slide: Vector3<f64>,
) -> KinematicJoint {
    let (joint_type, axis) = match axis {
        Some((direction, point)) => (JointType::Revolute, Axis { direction, point }),
        None => (JointType::Prismatic, Axis { direction: slide, point: Vector3::zeros() }),
    };
    KinematicJoint {
        parent,
        child: Label(label),
        joint_type,
        axis,
        center: Vector3::new(0.2, 0.0, 0.0),
        radius: 0.2,
        suggested: None,
    }
}

fn body(joint: &KinematicJoint, mass: f64, com: Vector3<f64>, damping: f64, friction: f64) -> Body<f64> {
    Body {
        parent: joint.parent,
        joint: joint.joint_type,
        screw: Screw(joint.screw().0),
        mass,
        com_in_world: com,
        inertia_about_com: Matrix3::identity() * (mass * 0.02),
        parameters: JointParameters::new(damping, friction),
    }
}

impl Truth {
    fn single(revolute: bool, damping: f64, friction: f64, mass: f64) -> Self {
        let joint = joint(None, 1, revolute.then(|| (Vector3::z(), Vector3::zeros())), Vector3::x());
        let com = Vector3::new(0.2, 0.0, 0.0);
        let tree = Tree::new(vec![body(&joint, mass, com, damping, friction)], GRAVITY).unwrap();
        let hulls = BTreeMap::from([(Label(1), hull(com))]);
        Self { joints: vec![joint], tree, hulls, touched: 0, contact: Vector3::new(0.4, 0.0, 0.1) }
    }

    /// A flap on a turning post: gravity loads the second joint.
    fn chain() -> Self {
        let first = joint(None, 1, Some((Vector3::z(), Vector3::zeros())), Vector3::zeros());
        let second = joint(Some(0), 2, Some((Vector3::y(), Vector3::new(0.3, 0.0, 0.0))), Vector3::zeros());
        let (com1, com2) = (Vector3::new(0.15, 0.0, 0.0), Vector3::new(0.5, 0.02, 0.0));
        let bodies = vec![body(&first, 3.0, com1, 0.4, 0.5), body(&second, 1.0, com2, 0.15, 0.3)];
        let tree = Tree::new(bodies, GRAVITY).unwrap();
        let hulls = BTreeMap::from([(Label(1), hull(com1)), (Label(2), hull(Vector3::new(0.49, 0.0, 0.0)))]);
        Self { joints: vec![first, second], tree, hulls, touched: 1, contact: Vector3::new(0.65, 0.1, 0.0) }
    }

    fn displacements(&self, q: &[f64]) -> Vec<Pose> {
        self.tree.displacements(q)
    }

    /// A window of `span_s` in which the tool pulls the contact by a spring along a smooth path.
    fn window(
        &self,
        span_s: f64,
        amplitude: f64,
        rate: f64,
        rng: &mut ChaCha8Rng,
    ) -> (WindowObservations, Contact, Vec<Vec<f64>>) {
        let mut state = State::at_rest(self.joints.len());
        let mut wrenches = Vec::new();
        let mut positions = Vec::new();
        let mut times_s = Vec::new();
        let mut track = Vec::new();
        let dt = 0.008;
        let mut noise = |scale: f64| -> Vector3<f64> {
            Vector3::from_fn(|_, _| {
                let x: f64 = StandardNormal.sample(rng);
                scale * x
            })
        };
        let mut force_before = Vector3::zeros();
        let hold = self.contact_force(&vec![0.0; self.joints.len()]);
        for i in 0..(span_s / dt) as usize {
            let t = i as f64 * dt;
            let at = self.displacements(&state.positions)[self.touched].transform_point(&self.contact);
            if i % 13 == 0 {
                times_s.push(t);
                positions.push(state.positions.clone());
                track.push((times_s.len() - 1, at, 3e-4));
            }
            // The path: forth and back twice as fast, along the joints' own motion.
            let phase = rate * t + 0.8 * (0.7 * rate * t).sin();
            let wanted: Vec<f64> = (0..self.joints.len())
                .map(|k| amplitude * (0.5 - 0.5 * (phase * (1.0 + 0.37 * k as f64)).cos()))
                .collect();
            let target = self.displacements(&wanted)[self.touched].transform_point(&self.contact);
            let force = (target - at) * 150.0 + hold;
            wrenches.push(AppliedWrench {
                tool: true,
                stamp: Stamp((t * 1e9) as i64),
                source: 0,
                part: None,
                point_in_world: at + noise(TOOL_NOISE),
                force_in_world: force + noise(FORCE_NOISE),
                torque_in_world: Vector3::zeros(),
            });
            let sample = |stamp_s: f64, force_in_world: Vector3<f64>| WrenchSample {
                stamp_s,
                point_in_world: at,
                force_in_world,
                torque_in_world: Vector3::zeros(),
            };
            let samples = [sample(t, force), sample(t + dt, 2.0 * force - force_before)];
            force_before = force;
            let run =
                rollout(&self.tree, &state, &[WrenchTrack::new(self.touched, &samples)], &[t, t + dt], 1e-3).unwrap();
            state = State::new(run.positions(1).to_vec(), run.rates(1).to_vec());
        }
        let contact = Contact { label: self.joints[self.touched].child, track };
        let window =
            WindowObservations { times_s, contacts: vec![contact.clone()], wrenches, ..WindowObservations::default() };
        let by_joint = (0..self.joints.len()).map(|k| positions.iter().map(|q| q[k]).collect()).collect();
        (window, contact, by_joint)
    }

    /// The force that carries the weight at rest, roughly.
    fn contact_force(&self, q: &[f64]) -> Vector3<f64> {
        if self.joints.len() < 2 {
            return Vector3::zeros();
        }
        let bias = self.tree.bias_forces(q, &vec![0.0; q.len()]);
        Vector3::new(0.0, 0.0, -bias[1] / (self.contact.x - 0.3))
    }

    fn fit(&self, windows: &[Vec<Vec<f64>>]) -> KinematicFit {
        let parameters: usize = self.joints.iter().map(KinematicJoint::axis_parameters).sum();
        KinematicFit {
            joints: self.joints.clone(),
            positions: windows.to_vec(),
            contact_points: vec![vec![self.contact]; windows.len()],
            tool_offset: Vector3::zeros(),
            covariance: DMatrix::identity(parameters + 3, parameters + 3) * 1e-10,
            cost: 0.0,
            moves: vec![vec![100; windows.len()]; self.joints.len()],
            window_costs: vec![0.0; windows.len()],
            window_information: vec![0.0; windows.len()],
            converged: true,
        }
    }

    fn learn(&self, count: usize, rng: &mut ChaCha8Rng) -> DynamicsPosterior {
        self.learn_by(count, rng, |positions| self.fit(positions))
    }

    fn learn_by(
        &self,
        count: usize,
        rng: &mut ChaCha8Rng,
        fit: impl Fn(&[Vec<Vec<f64>>]) -> KinematicFit,
    ) -> DynamicsPosterior {
        let mut learner = DynamicsLearner::new(GRAVITY);
        let mut windows = Vec::new();
        let mut positions = Vec::new();
        for i in 0..count {
            let amplitude = if self.joints[0].joint_type == JointType::Prismatic { 0.2 } else { 0.7 };
            let (window, contact, q) = self.window(2.5, amplitude, 2.0 + 2.5 * (i % 2) as f64, rng);
            windows.push(window);
            positions.push(q);
            let all: Vec<&WindowObservations> = windows.iter().collect();
            let input = DynamicsInput {
                windows: &all,
                contacts: &[contact],
                zero: Stamp(0),
                parts: &self.hulls,
                use_tool: true,
            };
            let result = learner.learn_window(&fit(&positions), &input);
            assert_eq!(result.failure, None);
        }
        learner.posterior().unwrap()
    }
}

#[test]
fn single_joints_are_recovered() {
    for revolute in [true, false] {
        let (damping, friction) = if revolute { (0.3, 0.4) } else { (8.0, 3.0) };
        let truth = Truth::single(revolute, damping, friction, 2.5);
        let found = &truth.learn(2, &mut ChaCha8Rng::seed_from_u64(3)).joints[0];
        let inertia = truth.tree.joint_inertia(0);
        for (quantity, truth) in
            [(&found.damping, damping), (&found.friction, friction), (&found.joint_inertia, inertia)]
        {
            assert!((quantity.median / truth - 1.0).abs() < 0.05, "{quantity:?}, truth {truth}");
        }
    }
}

/// A light lever is driven by the sensor's noise as much as by the hand.
#[test]
fn the_readings_noise_is_not_taken_for_inertia() {
    let truth = Truth::single(true, 0.05, 0.1, 0.1);
    let inertia = truth.tree.joint_inertia(0);
    let found: Vec<_> = (0..8)
        .map(|seed| truth.learn(3, &mut ChaCha8Rng::seed_from_u64(seed)).joints[0].joint_inertia.clone())
        .collect();
    let held = found.iter().filter(|quantity| quantity.q05 < inertia && inertia < quantity.q95).count();
    let error = found.iter().map(|quantity| (quantity.median / inertia).ln()).sum::<f64>() / found.len() as f64;
    assert!(held >= 6 && error.abs() < 0.1, "{held} of {} hold, {error:+.2} in all: {found:?}", found.len());
}

/// While other windows were wrong, a window may have been taken for noise.
#[test]
fn a_window_taken_for_noise_is_looked_at_again() {
    let truth = Truth::single(true, 0.3, 0.4, 2.5);
    let mut learner = DynamicsLearner::new(GRAVITY);
    let (window, contact, q) = truth.window(2.5, 0.7, 2.0, &mut ChaCha8Rng::seed_from_u64(5));
    let (contacts, positions, windows) = (&[contact], [q], &[&window]);
    let input = DynamicsInput { windows, contacts, zero: Stamp(0), parts: &truth.hulls, use_tool: true };
    let first = learner.learn_window(&truth.fit(&positions), &input);
    learner.windows[0].noise_scale = Some(300.0);
    let again = learner.learn_window(&truth.fit(&positions), &input);
    assert!(first.noise_scale < 10.0 && again.noise_scale == first.noise_scale, "{first:?} {again:?}");
}

/// A hinge, and the same with a stop at .45 rad.
fn free_and_stopped() -> (Truth, Truth) {
    let free = Truth::single(true, 0.3, 0.4, 2.5);
    let mut bodies = vec![body(&free.joints[0], 2.5, Vector3::new(0.2, 0.0, 0.0), 0.3, 0.4)];
    bodies[0].parameters.upper = Some(Limit::at(0.45));
    (free, Truth { tree: Tree::new(bodies, GRAVITY).unwrap(), ..Truth::single(true, 0.3, 0.4, 2.5) })
}

/// Where a joint turns round, it stays a little: that is the end of its range only where something holds it.
#[test]
fn an_end_that_a_joint_runs_into_is_a_stop_and_one_where_it_turns_round_is_none() {
    let (free, stopped) = free_and_stopped();
    for (truth, stops) in [(free, [false, false]), (stopped, [false, true])] {
        let mut learner = DynamicsLearner::new(GRAVITY);
        let (window, contact, q) = truth.window(2.5, 0.7, 2.0, &mut ChaCha8Rng::seed_from_u64(5));
        let (contacts, positions, windows) = (&[contact], [q], &[&window]);
        let input = DynamicsInput { windows, contacts, zero: Stamp(0), parts: &truth.hulls, use_tool: true };
        let result = learner.learn_window(&truth.fit(&positions), &input);
        assert_eq!(learner.mechanism().joints[0].stops, stops, "{result:?}");
    }
}

#[test]
fn a_stop_that_a_joint_goes_beyond_was_none() {
    let (free, stopped) = free_and_stopped();
    let mut learner = DynamicsLearner::new(GRAVITY);
    let (mut windows, mut positions, mut stops) = (Vec::new(), Vec::new(), Vec::new());
    for truth in [&stopped, &free] {
        let (window, contact, q) = truth.window(2.5, 0.7, 2.0, &mut ChaCha8Rng::seed_from_u64(5));
        windows.push(window);
        positions.push(q);
        let all: Vec<&WindowObservations> = windows.iter().collect();
        let contacts = &[contact];
        let input = DynamicsInput { windows: &all, contacts, zero: Stamp(0), parts: &truth.hulls, use_tool: true };
        learner.learn_window(&truth.fit(&positions), &input);
        stops.push(learner.mechanism().joints[0].stops);
    }
    assert_eq!(stops, [[false, true], [false, false]]);
}

#[test]
fn a_stop_of_which_no_window_tells_is_dropped_when_a_model_is_taken_over() {
    let (free, stopped) = free_and_stopped();
    for (truth, stops) in [(&stopped, [false, true]), (&free, [false, false])] {
        let mut learner = DynamicsLearner::new(GRAVITY);
        let (window, contact, q) = truth.window(2.5, 0.7, 2.0, &mut ChaCha8Rng::seed_from_u64(5));
        let (contacts, positions, windows) = (&[contact], [q], &[&window]);
        let input = DynamicsInput { windows, contacts, zero: Stamp(0), parts: &truth.hulls, use_tool: true };
        let fit = truth.fit(&positions);
        learner.learn_window(&fit, &input);
        // A stop at .45 rad, or beyond all that the joint did.
        let mut mechanism = learner.declared_mechanism();
        mechanism.joints[0].stops = [false, true];
        let mut hypothesis = learner.hypothesis(mechanism, None).unwrap();
        let end = if stops[1] { 0.45 } else { 3.0 };
        hypothesis.prior.precision[(UPPER, UPPER)] = LIMIT_DEVIATION.powi(-2);
        hypothesis.prior.information[UPPER] = end * LIMIT_DEVIATION.powi(-2);
        let x: Vec<f64> = hypothesis.prior.moments().unwrap().0.iter().copied().collect();
        learner.adopt(&hypothesis, &x, &[], None, (&fit, &input)).unwrap();
        assert_eq!(learner.mechanism().joints[0].stops, stops);
    }
}

#[test]
fn gravity_shows_how_a_slide_lies() {
    let (damping, friction, tilt) = (8.0, 3.0, 0.03);
    let truth = Truth::single(false, damping, friction, 2.5);
    let tilted = |positions: &[Vec<Vec<f64>>]| {
        let mut fit = truth.fit(positions);
        fit.joints[0].axis.direction = Vector3::new(1.0, 0.0, tilt).normalize();
        fit.covariance.view_mut((0, 0), (2, 2)).fill_diagonal(0.02 * 0.02);
        fit
    };
    let found = truth.learn_by(3, &mut ChaCha8Rng::seed_from_u64(3), tilted);
    let joint = &found.joints[0];
    let (turn, covariance) = joint.turn.unwrap();
    let axis = Vector3::new(1.0, 0.0, tilt).normalize();
    let (first, second) = orthonormal_pair(&axis);
    let level = axis + (first * turn.x + second * turn.y).cross(&axis);
    let steepest = Vector3::z();
    let spread = {
        let along = nalgebra::Vector2::new(first.cross(&axis).dot(&steepest), second.cross(&axis).dot(&steepest));
        along.dot(&(covariance * along)).sqrt()
    };
    assert!(level.z.abs() < 0.003 && spread < 0.005, "{level:?} ± {spread}");
    for (quantity, truth) in [(&joint.damping, damping), (&joint.friction, friction)] {
        assert!((quantity.median / truth - 1.0).abs() < 0.05, "{quantity:?}, truth {truth}");
    }
}

#[test]
fn a_chain_under_gravity_is_recovered() {
    let truth = Truth::chain();
    let found = truth.learn(2, &mut ChaCha8Rng::seed_from_u64(5));
    for (k, (damping, friction)) in [(0.4, 0.5), (0.15, 0.3)].into_iter().enumerate() {
        let joint = &found.joints[k];
        let inertia = truth.tree.joint_inertia(k);
        for (quantity, truth, within) in
            [(&joint.damping, damping, 0.15), (&joint.friction, friction, 0.1), (&joint.joint_inertia, inertia, 0.1)]
        {
            assert!((quantity.median / truth - 1.0).abs() < within, "joint {k}: {quantity:?}, truth {truth}");
        }
    }
}

/// Simulation-based calibration (Talts et al., arXiv 1804.06788): where the truth ranks in the posterior
/// would be uniform over draws of truths. Its central 90 % hold it as often as they should; the ranks
/// themselves are not quite uniform, which docs/calibration.md reports. The learner's prior is scaled by the data, so that truths are drawn
/// from a fixed broad distribution over which it is flat. BOM_CALIBRATION_DRAWS asks for more draws.
#[test]
#[expect(clippy::print_stderr, reason = "the table of docs/calibration.md")]
fn ninety_percent_intervals_hold_the_truth() {
    let asked = std::env::var("BOM_CALIBRATION_DRAWS").ok().and_then(|n| n.parse().ok());
    let draws: usize = asked.unwrap_or(100);
    let mut rng = ChaCha8Rng::seed_from_u64(11);
    let mut ranks: [Vec<f64>; 3] = Default::default();
    for i in 0..draws {
        let mut log = |low: f64, high: f64| (low.ln() + (high / low).ln() * rng.random::<f64>()).exp();
        let revolute = i % 2 == 0;
        let (damping, friction, mass) = if revolute {
            (log(0.1, 1.0), log(0.1, 1.0), log(1.0, 6.0))
        } else {
            (log(3.0, 20.0), log(1.0, 6.0), log(1.0, 6.0))
        };
        let truth = Truth::single(revolute, damping, friction, mass);
        // The model's own draws have no model error: the inference is looked at before its floor.
        let found = truth.learn(1, &mut rng);
        let inertia = truth.tree.joint_inertia(0);
        for (k, (entry, truth)) in
            [(DAMPING, damping), (FRICTION, friction), (INERTIA, inertia)].into_iter().enumerate()
        {
            let z = (truth.ln() - found.mean[entry]) / found.covariance[(entry, entry)].sqrt();
            ranks[k].push(0.5 * libm::erfc(-z / std::f64::consts::SQRT_2));
        }
    }
    let all: Vec<f64> = ranks.concat();
    for (name, ranks) in ["damping", "friction", "inertia"].iter().zip(&ranks).chain([(&"all", &all)]) {
        let bins = histogram(ranks);
        eprintln!(
            "{name}: in 90 % {:.3}, ranks by tenths {bins:?}, chi-square {:.1} of 9",
            inside(ranks),
            chi_square(&bins)
        );
    }
    assert!((0.80..=0.97).contains(&inside(&all)), "{}", inside(&all));
}

/// Share of ranks within the central 90 %.
fn inside(ranks: &[f64]) -> f64 {
    ranks.iter().filter(|r| (0.05..=0.95).contains(*r)).count() as f64 / ranks.len() as f64
}

fn histogram(ranks: &[f64]) -> [usize; 10] {
    let mut bins = [0; 10];
    for rank in ranks {
        bins[((rank * 10.0) as usize).min(9)] += 1;
    }
    bins
}

fn chi_square(bins: &[usize; 10]) -> f64 {
    let expected = bins.iter().sum::<usize>() as f64 / 10.0;
    bins.iter().map(|&count| (count as f64 - expected).powi(2) / expected).sum()
}

/// NUTS and HMC on the density itself say what SVI's Gaussian says, where a joint is well excited.
#[test]
fn samplers_agree_with_svi() {
    let truth = Truth::single(true, 0.3, 0.4, 2.5);
    let (window, contact, q) = truth.window(2.5, 0.7, 3.0, &mut ChaCha8Rng::seed_from_u64(7));
    let mut learner = DynamicsLearner::new(GRAVITY);
    let (windows, contacts, fit) = ([&window], [contact], truth.fit(&[q]));
    let input =
        DynamicsInput { windows: &windows, contacts: &contacts, zero: Stamp(0), parts: &truth.hulls, use_tool: true };
    assert_eq!(learner.learn_window(&fit, &input).failure, None);
    let gaussian = learner.posterior().unwrap();
    for sampler in [Sampler::Nuts, Sampler::Hmc] {
        let settings = SamplingSettings { sampler, chains: 2, warmup: 100, draws: 400, seed: 3, leapfrog_steps: 15 };
        let (sampled, report) = learner.sampled_posterior(&fit, &input, &settings).unwrap();
        assert!(report.windows == 1 && report.worst_r_hat < 1.1, "{sampler:?} {report:?}");
        for entry in [DAMPING, FRICTION, INERTIA] {
            let deviation = gaussian.covariance[(entry, entry)].sqrt();
            let shift = (sampled.mean[entry] - gaussian.mean[entry]) / deviation;
            let ratio = sampled.covariance[(entry, entry)].sqrt() / deviation;
            assert!(shift.abs() < 0.5 && (0.7..1.4).contains(&ratio), "{sampler:?} {entry}: {shift} {ratio}");
        }
    }
}

#[test]
fn replaying_windows_never_narrows() {
    let truth = Truth::single(true, 0.3, 0.4, 2.5);
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let (window, contact, q) = truth.window(2.5, 0.7, 3.0, &mut rng);
    let mut learner = DynamicsLearner::new(GRAVITY);
    let windows = [&window];
    let contacts = [contact];
    let input =
        DynamicsInput { windows: &windows, contacts: &contacts, zero: Stamp(0), parts: &truth.hulls, use_tool: true };
    let fit = truth.fit(&[q]);
    learner.learn_window(&fit, &input);
    let once = learner.posterior().unwrap();
    for _ in 0..4 {
        learner.learn_window(&fit, &input);
    }
    let again = learner.posterior().unwrap();
    for i in 0..3 {
        assert!(again.covariance[(i, i)] > 0.95 * once.covariance[(i, i)]);
        assert!((again.mean[i] - once.mean[i]).abs() < 0.2 * once.covariance[(i, i)].sqrt());
    }
}

#[test]
fn a_stuck_joint_bounds_friction_from_below() {
    let truth = Truth::single(true, 0.3, 50.0, 2.5);
    let mut rng = ChaCha8Rng::seed_from_u64(9);
    let (window, contact, q) = truth.window(2.0, 0.7, 3.0, &mut rng);
    let load = window.wrenches.iter().map(|w| w.force_in_world.norm() * 0.4).fold(0.0, f64::max);
    let mut learner = DynamicsLearner::new(GRAVITY);
    let input = DynamicsInput {
        windows: &[&window],
        contacts: &[contact],
        zero: Stamp(0),
        parts: &truth.hulls,
        use_tool: true,
    };
    assert_eq!(learner.learn_window(&truth.fit(&[q]), &input).failure, None);
    let friction = &learner.posterior().unwrap().joints[0].friction;
    assert!(friction.q05 > 0.4 * load && friction.q95 > 2.0 * load, "{friction:?}, load {load}");
}

#[test]
fn innovations_have_their_gradient() {
    for (truth, stream) in [(Truth::single(true, 0.3, 0.4, 2.5), 0), (Truth::chain(), 0), (Truth::chain(), 1)] {
        let mut rng = ChaCha8Rng::seed_from_u64(13);
        let (mut window, contact, q) = truth.window(1.5, 0.7, 3.0, &mut rng);
        // Angles that count from somewhere else.
        window.stream = stream;
        window.direct = truth.joints.iter().map(|joint| (joint.child, Matrix6::identity())).collect();
        let n = truth.joints.len();
        let moving: Vec<usize> = (0..n).collect();
        let kinematics =
            TrackKinematics { axes: truth.joints.iter().map(|j| j.axis).collect(), tool_offset: Vector3::zeros() };
        let source = TrackSource {
            joints: &truth.joints,
            positions: &q,
            window: &window,
            contacts: &[contact],
            contact_points: &[truth.contact],
            use_tool: true,
            zero: Stamp(0),
            moving: &moving,
        };
        let track = joint_track(&source, &kinematics).unwrap();
        let scales = vec![JointScales { force: 1.0, rate: 0.5, travel: 0.3 }; n];
        let models =
            joint_models(&truth.joints, |j| truth.hulls[&j.child].clone(), &scales, &vec![[false; 2]; n], &GRAVITY);
        let active: Vec<usize> =
            models.iter().enumerate().flat_map(|(k, m)| m.active().into_iter().map(move |i| k * SIZE + i)).collect();
        let mut x: Vec<f64> = models
            .iter()
            .flat_map(|m| m.prior([0.0; 2]).unwrap().moments().unwrap().0.iter().copied().collect::<Vec<_>>())
            .collect();
        for k in 0..n {
            x[k * SIZE + 1] = -1.2;
        }
        let mechanism = Mechanism { joints: models, gravity: GRAVITY, sensor: SensorModel::default() };
        let frozen = vec![None; n];
        let model = WindowModel {
            mechanism: &mechanism,
            axes: &kinematics.axes,
            frozen: &frozen,
            moving: &moving,
            track: &track,
            noise_scale: 3.0,
        };
        let here = model.linearize(&x, &active).unwrap();
        assert_eq!(here.whitened.len(), here.slopes.len() / active.len());
        let p = active.len();
        for (i, &at) in active.iter().enumerate() {
            let side = |step: f64| {
                let mut moved = x.clone();
                moved[at] += step;
                model.residuals(&moved, &here.gains).unwrap()
            };
            let (plus, minus) = (side(1e-5), side(-1e-5));
            let numeric: Vec<f64> = plus.iter().zip(&minus).map(|(a, b)| (a - b) / 2e-5).collect();
            let size = numeric.iter().map(|s| s.abs()).fold(1e-3, f64::max);
            // Switches between stick and slip fall on a few observations.
            let wrong =
                (0..numeric.len()).filter(|&k| (numeric[k] - here.slopes[k * p + i]).abs() > 2e-3 * size).count();
            assert!(wrong * 20 <= numeric.len(), "parameter {at}: {wrong} of {}", numeric.len());
        }
    }
}
