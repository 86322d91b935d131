//! Objects of one or two joints with undeclared physics, handled several times at mixed speeds, and
//! what a tool and a registration would report of it. No rendering.

use std::collections::BTreeMap;

use bayesian_object_models::criticism::Critic;
use bayesian_object_models::geometry::HullProperties;
use bayesian_object_models::math::{Pose, Screw};
use bayesian_object_models::mechanism::effects::{AttachedEffect, EffectKind};
use bayesian_object_models::mechanism::{
    Body, JointParameters, JointType, Limit, State, Tree, WrenchSample, WrenchTrack, rollout,
};
use bayesian_object_models::model::{
    Axis, Contact, DeclaredPhysics, DynamicsInput, DynamicsLearner, KinematicFit, KinematicJoint, PoseMeasurement,
    WindowObservations,
};
use bayesian_object_models::types::{AppliedWrench, Label, Stamp};
use nalgebra::{DMatrix, Matrix3, Matrix6, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

const GRAVITY: Vector3<f64> = Vector3::new(0.0, 0.0, -9.81);
/// Noise of the tool's position \[m\], the force \[N\], a registered position \[m\].
const TOOL_NOISE: f64 = 0.001;
const FORCE_NOISE: f64 = 0.1;
const POSE_NOISE: f64 = 0.002;
/// Span of a wrench reading, and of a frame in readings.
const READING_S: f64 = 0.008;
const FRAME: usize = 13;

/// What an object has that its model does not.
#[derive(Clone, Debug, PartialEq)]
pub enum Undeclared {
    /// A named effect on the first joint, by its physical parameters.
    Effect(EffectKind, Vec<f64>),
    /// A constant in the force readings \[N\].
    Bias(Vector3<f64>),
    /// The report is late by this \[s\].
    Delay(f64),
    /// Inertia that grows by this share over the travel.
    PositionDependentInertia(f64),
    /// Friction that falls from `1 + extra` of itself as the joint goes this many travels.
    WarmUp(f64, f64),
    /// Friction of the first joint grows by this share while the second is open.
    Brake(f64),
}

/// An object.
#[derive(Clone, Debug)]
pub struct Object {
    pub revolute: bool,
    pub inertia: f64,
    pub damping: f64,
    pub friction: f64,
    pub travel: f64,
    pub undeclared: Option<Undeclared>,
}

/// Sizes of an effect, as shares of what the bags' generator draws.
pub const SIZES: [f64; 3] = [0.3, 0.6, 1.0];

/// Every effect by the name that it should be given, and what the library has no law for.
pub const EFFECTS: [&str; 13] = [
    "spring",
    "catch",
    "soft_close",
    "detent",
    "self_closing",
    "stribeck",
    "asymmetric_friction",
    "drag",
    "position_friction",
    "gravity_offset",
    "impulse",
    "wrench_bias",
    "wrench_delay",
];
pub const UNLISTED: [&str; 3] = ["inertia over position", "friction that warms up", "a joint that brakes another"];

impl Object {
    /// A door or a drawer.
    pub fn plain(rng: &mut ChaCha8Rng, revolute: bool) -> Self {
        let mut log = |low: f64, high: f64| (low.ln() + (high / low).ln() * rng.random::<f64>()).exp();
        let (inertia, damping, friction, travel) = if revolute {
            (log(0.15, 0.8), log(0.1, 0.6), log(0.1, 0.6), log(1.1, 1.8))
        } else {
            (log(2.0, 6.0), log(4.0, 12.0), log(1.2, 5.0), log(0.22, 0.4))
        };
        Self { revolute, inertia, damping, friction, travel, undeclared: None }
    }

    /// The same kind of object with an effect, of a size.
    pub fn with(rng: &mut ChaCha8Rng, revolute: bool, name: &str, size: f64) -> Self {
        let mut object = Self::plain(rng, revolute);
        let (f, d, reach, slide) = (object.friction, object.damping, object.travel, !revolute);
        let mut u = |low: f64, high: f64| low + (high - low) * rng.random::<f64>();
        let effect = |kind, parameters: Vec<f64>| Undeclared::Effect(kind, parameters);
        let undeclared = match name {
            "spring" => effect(EffectKind::Spring, vec![size * if slide { u(15., 35.) } else { u(0.8, 2.2) }, 0.0]),
            "catch" => {
                let (peak, width) = if slide { (u(5., 9.), u(0.008, 0.016)) } else { (u(1.6, 3.), u(0.03, 0.06)) };
                effect(EffectKind::Catch, vec![size * peak, width])
            }
            "soft_close" => {
                let p = if slide {
                    [u(0.05, 0.09), u(15., 40.), u(3., 6.), u(15., 40.)]
                } else {
                    [u(0.25, 0.45), u(0.5, 1.5), u(0.6, 1.2), u(0.8, 2.)]
                };
                effect(EffectKind::SoftClose, vec![p[0], size * p[1], size * p[2], size * p[3]])
            }
            "detent" => {
                let (peak, period) = if slide { (u(2., 4.), u(0.05, 0.09)) } else { (u(0.6, 1.2), u(0.3, 0.5)) };
                effect(EffectKind::Detent, vec![size * peak, period, 0.0])
            }
            "self_closing" => {
                let peak = if slide { u(4., 8.) } else { u(1., 2.) };
                let shape = [u(0.2, 0.4) * reach, u(0.1, 0.2) * reach, u(0.05, 0.12) * reach];
                effect(EffectKind::SelfClosing, vec![size * peak, shape[0], shape[1], shape[2]])
            }
            "drag" => effect(EffectKind::Drag, vec![size * if slide { u(15., 40.) } else { u(0.4, 1.0) }]),
            "stribeck" => {
                let rate = if slide { u(0.02, 0.05) } else { u(0.05, 0.15) };
                effect(EffectKind::Stribeck, vec![f * (1.0 + size * u(0.8, 1.6)), rate])
            }
            "asymmetric_friction" => {
                let (friction, damping) = (1.0 + size * u(0.8, 1.8), 1.0 + size * u(0., 1.));
                effect(EffectKind::AsymmetricFriction, vec![f, f * friction, d, d * damping])
            }
            "position_friction" => effect(
                EffectKind::PositionFriction,
                vec![size * f * u(0.5, 0.9), u(0.3, 0.8) * reach, u(0., std::f64::consts::TAU)],
            ),
            "gravity_offset" => effect(EffectKind::GravityOffset, vec![-size * u(1., 1.6) * f]),
            "impulse" => {
                let force = if slide { u(6., 12.) } else { u(1.2, 2.5) };
                // Some way into the third window, see `Record::of`.
                effect(EffectKind::Impulse, vec![2.0 * WINDOW_EVERY_S + u(0.8, 1.6), u(0.2, 0.5), size * force])
            }
            "wrench_bias" => {
                let mut axis = || 2.0 * u(0., 1.) - 1.0;
                let direction = Vector3::new(axis(), axis(), axis());
                Undeclared::Bias(direction.normalize() * size * u(0.6, 1.2))
            }
            "wrench_delay" => Undeclared::Delay(size * u(0.06, 0.11)),
            "inertia over position" => Undeclared::PositionDependentInertia(size * u(1.5, 2.5)),
            "friction that warms up" => Undeclared::WarmUp(size * u(1., 2.), u(1., 2.)),
            "a joint that brakes another" => Undeclared::Brake(size * u(1.5, 2.5)),
            _ => unreachable!("no such effect: {name}"),
        };
        object.undeclared = Some(undeclared);
        object
    }

    fn kinematics(&self, label: u32) -> KinematicJoint {
        let (joint_type, direction) =
            if self.revolute { (JointType::Revolute, Vector3::z()) } else { (JointType::Prismatic, Vector3::x()) };
        KinematicJoint {
            parent: None,
            child: Label(label),
            joint_type,
            axis: Axis { direction, point: Vector3::zeros() },
            center: Vector3::new(0.2, 0.0, 0.0),
            radius: 0.2,
            suggested: None,
        }
    }

    fn parameters(&self) -> JointParameters<f64> {
        let mut parameters = JointParameters::new(self.damping, self.friction);
        parameters.lower = Some(Limit::at(0.0));
        parameters.upper = Some(Limit::at(self.travel));
        if let Some(Undeclared::Effect(kind, values)) = &self.undeclared {
            parameters.effects.push(AttachedEffect::new(*kind, values));
        }
        parameters
    }

    fn tree(&self, parameters: JointParameters<f64>) -> Tree<f64> {
        let joint = self.kinematics(1);
        let com = Vector3::new(0.2, 0.0, 0.0);
        let mass = if self.revolute { self.inertia / 0.08 } else { self.inertia };
        let about_com = if self.revolute { self.inertia - mass * 0.04 } else { mass * 0.02 };
        let body = Body {
            parent: None,
            joint: joint.joint_type,
            screw: Screw(joint.screw().0),
            mass,
            com_in_world: com,
            inertia_about_com: Matrix3::identity() * about_com,
            parameters,
        };
        Tree::new(vec![body], GRAVITY).expect("one body is a tree")
    }
}

/// From the beginning of one window to that of the next \[s\].
pub const WINDOW_EVERY_S: f64 = 8.0;

/// What was measured of an object over several windows.
pub struct Record {
    pub joints: Vec<KinematicJoint>,
    pub windows: Vec<WindowObservations>,
    pub contacts: Vec<Contact>,
    /// By window, joint and frame.
    pub positions: Vec<Vec<Vec<f64>>>,
    pub hulls: BTreeMap<Label, HullProperties>,
}

/// How one window goes.
struct Handling {
    start_s: f64,
    span_s: f64,
    /// Turning points of the tool's path, joint positions.
    way: Vec<f64>,
}

fn normal(rng: &mut ChaCha8Rng) -> f64 {
    rng.sample(StandardNormal)
}

fn smooth(share: f64) -> f64 {
    let s = share.clamp(0.0, 1.0);
    s * s * s * (10.0 - 15.0 * s + 6.0 * s * s)
}

impl Record {
    /// The object handled `count` times. A second joint, where one brakes the other, takes every
    /// other window.
    pub fn of(object: &Object, count: usize, rng: &mut ChaCha8Rng) -> Self {
        let brakes = matches!(object.undeclared, Some(Undeclared::Brake(_)));
        let objects: Vec<Object> = if brakes {
            vec![object.clone(), Object { undeclared: None, ..Object::plain(rng, object.revolute) }]
        } else {
            vec![object.clone()]
        };
        let joints: Vec<KinematicJoint> = objects.iter().enumerate().map(|(k, o)| o.kinematics(k as u32 + 1)).collect();
        let mut record = Self {
            hulls: joints.iter().map(|j| (j.child, hull(object.revolute, objects[0].inertia))).collect(),
            joints,
            windows: Vec::new(),
            contacts: Vec::new(),
            positions: Vec::new(),
        };
        let mut places = vec![0.0; objects.len()];
        let mut travelled = 0.0;
        for w in 0..count {
            let joint = if brakes { w % 2 } else { 0 };
            let travel = objects[joint].travel;
            let fast = w % 3 != 1;
            let span_s = if fast { 2.4 + rng.random::<f64>() } else { 3.6 + rng.random::<f64>() };
            let here: f64 = places[joint];
            let far = travel * (0.55 + 0.4 * rng.random::<f64>());
            let middle = travel * (0.1 + 0.35 * rng.random::<f64>());
            let open = [far, middle, travel * (0.3 + 0.6 * rng.random::<f64>())];
            let way = if here < 0.5 * travel {
                vec![here, open[0], open[1], open[2]]
            } else {
                vec![here, -0.02 * travel, open[0], open[1]]
            };
            // The one that brakes is left open, then closed.
            let way = if brakes && joint == 1 {
                vec![here, if w % 4 == 1 { 0.8 * travel } else { 0.02 * travel }]
            } else {
                way
            };
            let handling = Handling { start_s: w as f64 * WINDOW_EVERY_S, span_s, way };
            record.window(&objects, joint, &handling, &mut places, &mut travelled, rng);
        }
        record
    }

    fn window(
        &mut self,
        objects: &[Object],
        joint: usize,
        handling: &Handling,
        places: &mut [f64],
        travelled: &mut f64,
        rng: &mut ChaCha8Rng,
    ) {
        let object = &objects[joint];
        let screw = object.kinematics(1).screw();
        let handle = Vector3::new(0.4, 0.0, 0.1);
        let mut state = State::new(vec![places[joint]], vec![0.0]);
        let mut window = WindowObservations::default();
        let mut track = Vec::new();
        let mut positions: Vec<Vec<f64>> = vec![Vec::new(); objects.len()];
        let lead_s = 0.5;
        let (delay_s, bias) = match &object.undeclared {
            Some(Undeclared::Delay(delay)) => (*delay, Vector3::zeros()),
            Some(Undeclared::Bias(bias)) => (0.0, *bias),
            _ => (0.0, Vector3::zeros()),
        };
        let legs = (handling.way.len() - 1) as f64;
        let mut force_before = Vector3::zeros();
        let mut history: Vec<Vector3<f64>> = Vec::new();
        let mut quiet = 0;
        let mut poses = Vec::new();
        let mut rested: Option<(f64, f64)> = None;
        for i in 0..(7.5 / READING_S) as usize {
            let t = i as f64 * READING_S;
            let stamp_s = handling.start_s + t;
            let q = state.positions[0];
            let at = screw.displacement(q).transform_point(&handle);
            let touching = t >= lead_s && t < lead_s + handling.span_s;
            let share = ((t - lead_s) / handling.span_s).clamp(0.0, 1.0) * legs;
            let leg = (share.floor() as usize).min(handling.way.len() - 2);
            let wanted = handling.way[leg] + (handling.way[leg + 1] - handling.way[leg]) * smooth(share - leg as f64);
            let target = screw.displacement(wanted).transform_point(&handle);
            // The tool eases off in its last 100 ms.
            let ease = ((lead_s + handling.span_s - t) / 0.1).clamp(0.0, 1.0);
            let force = if touching { (target - at) * 180.0 * ease } else { Vector3::zeros() };
            if i % FRAME == 0 {
                window.times_s.push(stamp_s);
                if touching {
                    track.push((window.times_s.len() - 1, at, 3e-4));
                }
                // A joint at rest has one position, as the kinematic fit ties them.
                let noise = 0.3 * POSE_NOISE / if object.revolute { 0.3 } else { 1.0 } * normal(rng);
                let still = rested.filter(|(true_q, _)| (true_q - q).abs() < 1e-6).map(|(_, seen)| seen);
                let seen = still.unwrap_or(q + noise);
                rested = Some((q, seen));
                for (k, path) in positions.iter_mut().enumerate() {
                    path.push(if k == joint { seen } else { places[k] });
                }
                let mut information = Matrix6::identity() / POSE_NOISE.powi(2);
                for axis in 0..3 {
                    information[(axis, axis)] *= 0.04;
                }
                let displacement =
                    screw.displacement(q) * Pose::from_translation(Vector3::from_fn(|_, _| POSE_NOISE * normal(rng)));
                poses.push(Some(PoseMeasurement { displacement, information }));
                let moving = state.rates[0].abs() > 1e-4;
                quiet = if touching || moving { 0 } else { quiet + 1 };
                if quiet > 4 && t > lead_s + handling.span_s {
                    break;
                }
            }
            let noise = |scale: f64, rng: &mut ChaCha8Rng| Vector3::from_fn(|_, _| scale * normal(rng));
            // What is reported now acted a while ago; the tool is where it is.
            history.push(force);
            let late = delay_s / READING_S;
            let (whole, part) = (late.floor() as usize, late.fract());
            let at_lag = |lag: usize| i.checked_sub(lag).map_or_else(Vector3::zeros, |k| history[k]);
            let reported = at_lag(whole) * (1.0 - part) + at_lag(whole + 1) * part;
            window.wrenches.push(AppliedWrench {
                stamp: Stamp((stamp_s * 1e9) as i64),
                source: 0,
                part: None,
                tool: true,
                point_in_world: at + noise(TOOL_NOISE, rng),
                force_in_world: reported + bias + noise(FORCE_NOISE, rng),
                torque_in_world: Vector3::zeros(),
            });
            let mut parameters = object.parameters();
            let inertia = match &object.undeclared {
                Some(Undeclared::PositionDependentInertia(share)) => {
                    let slope = object.inertia * share / object.travel;
                    let rate = state.rates[0];
                    parameters.effects.extend([
                        AttachedEffect::new(EffectKind::ReflectedInertia, &[slope * q.max(0.0)]),
                        AttachedEffect::new(EffectKind::GravityOffset, &[-0.5 * slope * rate * rate]),
                    ]);
                    object
                }
                Some(Undeclared::WarmUp(extra, distance)) => {
                    parameters.friction *= 1.0 + extra * (-*travelled / (distance * object.travel)).exp();
                    object
                }
                Some(Undeclared::Brake(share)) => {
                    if places[1] > 0.4 * objects[1].travel {
                        parameters.friction *= 1.0 + share;
                    }
                    object
                }
                _ => object,
            };
            let sample = |stamp_s: f64, force_in_world: Vector3<f64>| WrenchSample {
                stamp_s,
                point_in_world: at,
                force_in_world,
                torque_in_world: Vector3::zeros(),
            };
            let samples = [sample(stamp_s, force), sample(stamp_s + READING_S, 2.0 * force - force_before)];
            force_before = force;
            let tree = inertia.tree(parameters);
            let run = rollout(&tree, &state, &[WrenchTrack::new(0, &samples)], &[stamp_s, stamp_s + READING_S], 1e-3)
                .expect("finite");
            *travelled += (run.positions(1)[0] - q).abs();
            state = State::new(run.positions(1).to_vec(), run.rates(1).to_vec());
        }
        places[joint] = state.positions[0];
        let label = self.joints[joint].child;
        let contact = Contact { label, track };
        window.contacts = vec![contact.clone()];
        window.poses.insert(label, poses);
        self.windows.push(window);
        self.contacts.push(contact);
        self.positions.push(positions);
    }

    /// The kinematic fit of the first windows, axes known.
    pub fn fit(&self, windows: usize) -> KinematicFit {
        let parameters: usize = self.joints.iter().map(KinematicJoint::axis_parameters).sum();
        KinematicFit {
            joints: self.joints.clone(),
            positions: self.positions[..windows].to_vec(),
            contact_points: vec![vec![Vector3::new(0.4, 0.0, 0.1)]; windows],
            tool_offset: Vector3::zeros(),
            covariance: DMatrix::identity(parameters + 3, parameters + 3) * 1e-10,
            cost: 0.0,
            moves: vec![vec![100; windows]; self.joints.len()],
            window_costs: vec![0.0; windows],
            window_information: vec![0.0; windows],
            converged: true,
        }
    }

    /// The first windows as they come, the last of them new.
    pub fn input<'a>(&'a self, windows: &'a [&'a WindowObservations]) -> DynamicsInput<'a> {
        DynamicsInput {
            windows,
            contacts: std::slice::from_ref(&self.contacts[windows.len() - 1]),
            zero: Stamp(0),
            parts: &self.hulls,
            use_tool: true,
        }
    }

    /// Learns all windows and looks at the whole.
    pub fn criticize(&self, declared: &DeclaredPhysics) -> (DynamicsLearner, Critic) {
        let mut learner = DynamicsLearner::new(GRAVITY).declaring(declared.clone());
        let mut critic = Critic::default();
        for count in 1..=self.windows.len() {
            let windows: Vec<&WindowObservations> = self.windows[..count].iter().collect();
            let input = self.input(&windows);
            let fit = self.fit(count);
            learner.learn_window(&fit, &input);
            if count == self.windows.len() {
                critic.review(&mut learner, &fit, &input, None).expect("a review");
            }
        }
        (learner, critic)
    }
}

fn hull(revolute: bool, inertia: f64) -> HullProperties {
    let _ = (revolute, inertia);
    HullProperties {
        volume: 0.012,
        center: Vector3::new(0.2, 0.0, 0.0),
        inertia_per_density: Matrix3::identity() * (0.012 * 0.03),
        spread: Vector3::repeat(0.12),
        vertices: Vec::new(),
        triangles: Vec::new(),
    }
}

/// An object by its number among those of a name.
pub fn object(name: &str, size: f64, number: u64) -> (Object, ChaCha8Rng) {
    let salt = name.bytes().fold(7_u64, |sum, byte| sum.wrapping_mul(31).wrapping_add(u64::from(byte)));
    let mut rng = ChaCha8Rng::seed_from_u64(salt ^ (number << 32) ^ (size * 1000.0) as u64);
    let revolute = number.is_multiple_of(2);
    let object =
        if name == "plain" { Object::plain(&mut rng, revolute) } else { Object::with(&mut rng, revolute, name, size) };
    (object, rng)
}
