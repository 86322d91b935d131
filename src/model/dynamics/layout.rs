//! Dynamic parameters of the joints: what each number means, its prior, and the tree made of them.
//!
//! Inertial numbers are those that a joint's own motion shows (base parameters, Khalil & Dombre,
//! "Modeling, Identification and Control of Robots", 2002, chapter 9): a body's inertia about its
//! own joint, and where gravity or an ancestor shows them its mass and its centre of mass across the
//! axis. The first moment itself would be linear in the equations, but its prior is not Gaussian:
//! a mass within a factor of three times a centre within a few centimetres. In logs their product is a
//! sum: what gravity shows of a hinge is one straight line for all windows.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Vector3};
use serde::{Deserialize, Serialize};

use crate::geometry::HullProperties;
use crate::inference::{Failure, Gaussian};
use crate::math::{Pose, Real, Screw, orthonormal_pair};
use crate::mechanism::effects::{AttachedEffect, AttachedTable, EffectKind, Scales, TableKind};
use crate::mechanism::{Body, JointParameters, JointType, Limit, Tree};
use crate::model::{Axis, KinematicJoint};

/// ln damping \[N·s/m or N·m·s/rad\].
pub const DAMPING: usize = 0;
/// ln Coulomb friction \[N or N·m\].
pub const FRICTION: usize = 1;
/// ln of the body's own inertia on its joint: mass \[kg\], or inertia about the axis \[kg·m²\].
pub const INERTIA: usize = 2;
/// Lower end stop \[m or rad\], where there is one.
pub const LOWER: usize = 3;
/// Upper end stop \[m or rad\], where there is one.
pub const UPPER: usize = 4;
/// ln mass \[kg\] of a body on a hinge.
pub const MASS: usize = 5;
/// First of two numbers of the centre of mass across the axis, see [`CenterFrame`]: from the axis of a hinge,
/// from the hull's centre on a slide.
pub const CENTER: usize = 6;
/// First of two components of the error of the axis's direction, see [`TiltFrame`] \[rad\].
pub const TILT: usize = 8;
/// Numbers of a joint without effects; those of its effects follow.
pub const SIZE: usize = 10;

/// Density of a hull \[kg/m³\], and how far off it may be (standard deviation of its logarithm):
/// measured 97 for hollow drawers and 300 for doors (DESIGN.md section 9).
const DENSITY: f64 = 200.0;
const LOG_DENSITY_DEVIATION: f64 = 1.2;
/// Standard deviation of ln(inertia / mass) where the centre of mass is known: shapes are better known than
/// densities. On 23 hinges of this project's generator .07, without the centre .15; furniture is less even.
const LOG_SHAPE_DEVIATION: f64 = 0.15;
/// A centre of mass this many standard deviations off the axis is written by its distance and angle.
const CLEARLY_OFF: f64 = 1.5;
/// An axis within 30° of gravity is that of a door; further than that a slide's.
const UPRIGHT: f64 = 0.87;
/// Standard deviation of the centre of mass, in spreads of the part's points: a uniform panel's
/// spread is .29 of its extent, so this is 15 % of the extent.
const CENTER_DEVIATION: f64 = 0.5;
/// The same of a part whose surface nobody saw: anything from grams to hundreds of kilograms, of any
/// shape, its centre a link's length from the measured frame \[m\].
const GUESS_DEVIATIONS: (f64, f64, f64) = (2.5, 1.5, 0.1);
/// Standard deviation of ln damping and ln friction about the scales of the first window.
const LOG_FORCE_DEVIATION: f64 = 1.5;
/// Standard deviation of an end stop about where the joint was seen to halt \[m or rad\].
pub const LIMIT_DEVIATION: f64 = 0.01;
/// Standard deviation of the mean of a table whose constant part is a number of the joint already.
const TABLE_MEAN_DEVIATION: f64 = 0.05;

/// Covariance of entries of which the mean is next to nothing, and what they differ from it as it was.
fn with_small_mean(covariance: &DMatrix<f64>) -> DMatrix<f64> {
    let n = covariance.nrows();
    let center = DMatrix::identity(n, n) - DMatrix::repeat(n, n, 1.0 / n as f64);
    &center * covariance * &center + DMatrix::repeat(n, n, TABLE_MEAN_DEVIATION.powi(2))
}

/// Typical force and rate of a joint, and how far it goes, from the first window in which it moved.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct JointScales {
    /// \[N or N·m\].
    pub force: f64,
    /// \[m/s or rad/s\].
    pub rate: f64,
    /// From the reference position towards the opened one, negative where q falls \[m or rad\].
    pub travel: f64,
}

/// A named effect beyond the declared model.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct AddedEffect {
    /// Which.
    pub kind: EffectKind,
    /// What its prior is scaled by.
    pub scales: Scales,
    /// The joint position where x = 0 \[m or rad\].
    pub reference: f64,
    /// Whether the joint opens as q falls.
    pub reversed: bool,
}

/// A tabulated effect: what has no name, or what names are compared with.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct AddedTable {
    /// What is tabulated over what.
    pub kind: TableKind,
    /// Arguments, ascending.
    pub nodes: Vec<f64>,
    /// Standard deviation of an entry by the prior, in the units of the entries.
    pub scale: f64,
    /// Over this distance entries are alike, in the units of the nodes.
    pub correlation: f64,
    /// Whether the joint opens as q falls.
    pub reversed: bool,
}

/// Which errors of the wrench sensor the model has.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct SensorModel {
    /// A constant added to force and torque.
    pub bias: bool,
    /// The report acts earlier or later than it says.
    pub delay: bool,
    /// Standard deviations by the prior: force \[N\], torque \[N·m\], delay \[s\].
    pub scales: [f64; 3],
}

impl Default for SensorModel {
    fn default() -> Self {
        Self { bias: false, delay: false, scales: [1.0, 0.2, 0.05] }
    }
}

/// Numbers of the sensor: force bias, torque bias, delay, in units of their scales.
pub const SENSOR_SIZE: usize = 7;

/// What the sensor's numbers mean.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorError<T: Real> {
    /// What it adds to the force \[N\].
    pub force_bias: Vector3<T>,
    /// What it adds to the torque \[N·m\].
    pub torque_bias: Vector3<T>,
    /// δ: the wrench acting at t is the one reported at t + δ \[s\].
    pub delay_s: T,
}

impl<T: Real> SensorError<T> {
    /// A sensor without errors.
    pub fn none() -> Self {
        Self { force_bias: Vector3::zeros(), torque_bias: Vector3::zeros(), delay_s: T::zero() }
    }
}

/// How a centre of mass across an axis is written.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct CenterFrame {
    /// Two directions across the axis.
    pub basis: [Vector3<f64>; 2],
    /// By ln distance \[m\] from the axis and angle \[rad\] from the first direction, that of the hull's
    /// centre; else by its components \[m\].
    pub polar: bool,
}

impl CenterFrame {
    /// The frame of a joint's child; `across`: the axis that its centre shows about.
    fn new(joint: &KinematicJoint, hull: &HullProperties, across: &Vector3<f64>) -> Self {
        let arm = hull.center - joint.axis.point;
        let offset = arm - joint.axis.direction * joint.axis.direction.dot(&arm);
        if let (JointType::Revolute, Some(out)) = (joint.joint_type, offset.try_normalize(1e-6))
            && offset.norm() > CLEARLY_OFF * center_deviation(hull, &out)
        {
            return Self { basis: [out, joint.axis.direction.cross(&out)], polar: true };
        }
        let (first, second) = orthonormal_pair(across);
        Self { basis: [first, second], polar: false }
    }

    /// From the axis, or the hull's centre, to the centre of mass \[m\].
    fn arm<T: Real>(&self, x: &[T]) -> Vector3<T> {
        let [first, second] = self.basis.map(|direction| direction.map(T::constant));
        if self.polar {
            (first * x[CENTER + 1].cos() + second * x[CENTER + 1].sin()) * x[CENTER].exp()
        } else {
            first * x[CENTER] + second * x[CENTER + 1]
        }
    }

    /// Both numbers of an arm \[m\], and by how much they change per metre along either direction.
    fn numbers(&self, arm: &Vector3<f64>) -> ([f64; 2], f64) {
        let [along, aside] = self.basis.map(|direction| direction.dot(arm));
        if self.polar {
            ([0.5 * (along * along + aside * aside).ln(), aside.atan2(along)], along.hypot(aside).recip())
        } else {
            ([along, aside], 1.0)
        }
    }
}

/// In which directions an axis may be off by more than gravity would let pass: what pulls along a slide
/// that is not quite level, or turns a door that is not quite upright, is weight and no force of its own.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct TiltFrame {
    /// Two directions across the axis, on a slide the first as upright as can be.
    pub basis: [Vector3<f64>; 2],
    /// How many of them gravity shows.
    pub shown: usize,
}

impl TiltFrame {
    fn new(joint: &KinematicJoint, gravity: &Vector3<f64>) -> Self {
        let n = joint.axis.direction;
        let (first, second) = orthonormal_pair(&n);
        let Some(down) = gravity.try_normalize(1e-6) else { return Self { basis: [first, second], shown: 0 } };
        let upright = n.dot(&down).abs() > UPRIGHT;
        match ((down - n * n.dot(&down)).try_normalize(1e-6), joint.joint_type) {
            (_, JointType::Revolute) if upright => Self { basis: [first, second], shown: 2 },
            (Some(steepest), JointType::Prismatic) if !upright => {
                Self { basis: [steepest, n.cross(&steepest)], shown: 1 }
            }
            _ => Self { basis: [first, second], shown: 0 },
        }
    }

    /// What the numbers add to the direction.
    fn tilt<T: Real>(&self, x: &[T]) -> Vector3<T> {
        let shown = self.basis.iter().enumerate().take(self.shown);
        shown.fold(Vector3::zeros(), |sum, (i, basis)| sum + basis.map(T::constant) * x[TILT + i])
    }

    /// The numbers of a small change of the direction.
    pub fn numbers(&self, change: &Vector3<f64>) -> [f64; 2] {
        self.basis.map(|basis| basis.dot(change))
    }

    /// Takes the axis's own two turns \[rad\] to the numbers: a turn by a f + b s adds b f − a s.
    pub fn turns_to_numbers(&self, axis: &Axis) -> Matrix2<f64> {
        let (first, second) = orthonormal_pair(&axis.direction);
        Matrix2::from_fn(|i, j| if j == 0 { -self.basis[i].dot(&second) } else { self.basis[i].dot(&first) })
    }
}

/// Standard deviation of a centre of mass about its hull's along a direction \[m\].
fn center_deviation(hull: &HullProperties, direction: &Vector3<f64>) -> f64 {
    let spread = hull.spread.dot(&direction.abs()).max(0.01);
    if hull.is_guess() { GUESS_DEVIATIONS.2 } else { CENTER_DEVIATION * spread }
}

/// All that is fixed of one joint and its body.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct JointModel {
    /// Parent, child, type, axis.
    pub joint: KinematicJoint,
    /// The child's hull.
    pub hull: HullProperties,
    /// Scales of its forces and rates.
    pub scales: JointScales,
    /// End stops that it was found to have.
    pub stops: [bool; 2],
    /// Whether its centre of mass shows: on a hinge that gravity loads, or that is carried.
    pub center_shows: bool,
    /// How its centre of mass is written.
    pub center: CenterFrame,
    /// How its axis may be tilted.
    pub tilt: TiltFrame,
    /// Whether Coulomb friction is in the model.
    pub friction: bool,
    /// Effects beyond that, whose numbers follow.
    pub effects: Vec<AddedEffect>,
    /// Tables, whose entries follow those, in units of their scales.
    pub tables: Vec<AddedTable>,
}

impl JointModel {
    /// How many numbers the joint has.
    pub fn size(&self) -> usize {
        let effects: usize = self.effects.iter().map(|effect| effect.kind.parameters().len()).sum();
        SIZE + effects + self.tables.iter().map(|table| table.nodes.len()).sum::<usize>()
    }

    /// First number of an effect.
    pub fn effect_offset(&self, effect: usize) -> usize {
        SIZE + self.effects[..effect].iter().map(|effect| effect.kind.parameters().len()).sum::<usize>()
    }

    /// First number of a table.
    pub fn table_offset(&self, table: usize) -> usize {
        let before: usize = self.tables[..table].iter().map(|table| table.nodes.len()).sum();
        self.effect_offset(self.effects.len()) + before
    }

    /// Whether friction and damping by direction stand in the place of the declared ones.
    fn resists_by_direction(&self) -> bool {
        self.effects.iter().any(|effect| effect.kind == EffectKind::AsymmetricFriction)
    }

    /// The numbers that the equations of motion hold.
    pub fn active(&self) -> Vec<usize> {
        let by_direction = self.resists_by_direction();
        let mut active = vec![INERTIA];
        if !by_direction {
            active.push(DAMPING);
        }
        if !by_direction && self.friction {
            active.push(FRICTION);
        }
        active.sort_unstable();
        active.extend([LOWER, UPPER].into_iter().zip(self.stops).filter(|(_, there)| *there).map(|(i, _)| i));
        if self.center_shows && self.joint.joint_type == JointType::Revolute {
            active.push(MASS);
        }
        if self.center_shows {
            active.extend([CENTER, CENTER + 1]);
        }
        active.extend(TILT..TILT + self.tilt.shown);
        active.extend(SIZE..self.size());
        active
    }

    /// The foot of the hull's centre on the axis (of a hinge), or the centre itself.
    fn foot(&self, axis: &Axis) -> Vector3<f64> {
        match self.joint.joint_type {
            JointType::Revolute => axis.point + axis.direction * axis.direction.dot(&(self.hull.center - axis.point)),
            _ => self.hull.center,
        }
    }

    /// Second moment of the hull per volume \[m²\].
    fn shape(&self) -> Matrix3<f64> {
        self.hull.inertia_per_density / self.hull.volume
    }

    /// Inertia on the joint per mass, of the hull (1 or m²).
    fn inertia_per_mass(&self) -> f64 {
        let n = self.joint.axis.direction;
        match self.joint.joint_type {
            JointType::Revolute => {
                let arm = self.hull.center - self.foot(&self.joint.axis);
                n.dot(&(self.shape() * n)) + arm.norm_squared()
            }
            _ => 1.0,
        }
    }

    /// The prior of the joint's numbers.
    pub fn prior(&self, seen: [f64; 2]) -> Result<Gaussian, Failure> {
        let mut mean = DVector::zeros(self.size());
        // x = mean + map · z with z standard normal.
        let mut map = DMatrix::identity(self.size(), self.size());
        mean[DAMPING] = (0.3 * self.scales.force / self.scales.rate).ln();
        mean[FRICTION] = (0.3 * self.scales.force).ln();
        map[(DAMPING, DAMPING)] = LOG_FORCE_DEVIATION;
        map[(FRICTION, FRICTION)] = LOG_FORCE_DEVIATION;
        let mass = DENSITY * self.hull.volume;
        let guess = self.hull.is_guess().then_some(GUESS_DEVIATIONS);
        let (density, shape, _) = guess.unwrap_or((LOG_DENSITY_DEVIATION, LOG_SHAPE_DEVIATION, 0.0));
        mean[MASS] = mass.ln();
        map[(MASS, MASS)] = density;
        mean[INERTIA] = (mass * self.inertia_per_mass()).ln();
        map[(INERTIA, MASS)] = density;
        map[(INERTIA, INERTIA)] = shape;
        for (i, (place, position)) in [LOWER, UPPER].into_iter().zip(seen).enumerate() {
            mean[place] = position;
            map[(place, place)] = if self.stops[i] { LIMIT_DEVIATION } else { 1.0 };
        }
        let offset = match self.joint.joint_type {
            JointType::Revolute => self.hull.center - self.foot(&self.joint.axis),
            _ => Vector3::zeros(),
        };
        let (numbers, per_metre) = self.center.numbers(&offset);
        for (i, (basis, number)) in self.center.basis.iter().zip(numbers).enumerate() {
            let deviation = center_deviation(&self.hull, basis);
            mean[CENTER + i] = number;
            map[(CENTER + i, CENTER + i)] = deviation * per_metre;
            // Inertia goes with the distance: d ln (k² + |c|²) = 2 c·dc / (k² + |c|²).
            if self.joint.joint_type == JointType::Revolute {
                map[(INERTIA, CENTER + i)] = 2.0 * offset.dot(basis) * deviation / self.inertia_per_mass();
            }
        }
        let mut covariance = &map * map.transpose();
        for (i, table) in self.tables.iter().enumerate() {
            let first = self.table_offset(i);
            for (a, node) in table.nodes.iter().enumerate() {
                for (b, other) in table.nodes.iter().enumerate().filter(|(b, _)| *b != a) {
                    covariance[(first + a, first + b)] = (-(node - other).abs() / table.correlation).exp();
                }
            }
            if table.kind == TableKind::InertiaOverPosition {
                let n = table.nodes.len();
                let mut own = covariance.view_mut((first, first), (n, n));
                own.copy_from(&with_small_mean(&own.clone_owned()));
            }
        }
        Gaussian::from_moments(&mean, &covariance)
    }

    /// The body's inertial properties at the reference configuration from the joint's numbers.
    fn inertia<T: Real>(&self, x: &[T], axis: &Axis) -> (T, Vector3<T>, Matrix3<T>) {
        let shape = self.shape();
        let arm = self.center.arm(x);
        match self.joint.joint_type {
            JointType::Revolute => {
                let mass = x[MASS].exp();
                let n = axis.direction;
                let com = self.foot(axis).map(T::constant) + arm;
                let along = T::constant(n.dot(&(shape * n)));
                let about_axis = x[INERTIA].exp() - (arm.norm_squared() + along) * mass;
                let about_com = shape.map(T::constant) * mass + (n * n.transpose()).map(T::constant) * about_axis;
                (mass, com, about_com)
            }
            _ => {
                let mass = x[INERTIA].exp();
                (mass, self.hull.center.map(T::constant) + arm, shape.map(T::constant) * mass)
            }
        }
    }

    fn parameters<T: Real>(&self, x: &[T]) -> JointParameters<T> {
        let friction = if self.friction { x[FRICTION].exp() } else { T::zero() };
        let mut parameters = JointParameters::new(x[DAMPING].exp(), friction);
        parameters.lower = self.stops[0].then(|| Limit::at(x[LOWER]));
        parameters.upper = self.stops[1].then(|| Limit::at(x[UPPER]));
        let mut at = SIZE;
        for effect in &self.effects {
            let laws = effect.kind.parameters().iter().enumerate();
            let values: Vec<T> = laws.map(|(i, p)| p.physical(x[at + i], &effect.scales)).collect();
            at += values.len();
            parameters.effects.push(AttachedEffect {
                reference: T::constant(effect.reference),
                reversed: effect.reversed,
                ..AttachedEffect::new(effect.kind, &values)
            });
        }
        for table in &self.tables {
            let entries = &x[at..at + table.nodes.len()];
            at += entries.len();
            parameters.tables.push(AttachedTable {
                kind: table.kind,
                nodes: table.nodes.as_slice().into(),
                values: entries.iter().map(|&entry| entry * T::constant(table.scale)).collect(),
                reversed: table.reversed,
            });
        }
        parameters
    }
}

/// The joints with their numbers one joint after the other.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Mechanism {
    /// Parents first.
    pub joints: Vec<JointModel>,
    /// \[m/s²\].
    pub gravity: Vector3<f64>,
    /// Errors of the wrench sensor, whose numbers follow those of the joints.
    pub sensor: SensorModel,
}

impl Mechanism {
    /// First number of a joint.
    pub fn offset(&self, joint: usize) -> usize {
        self.joints[..joint].iter().map(JointModel::size).sum()
    }

    /// How many numbers there are.
    pub fn size(&self) -> usize {
        self.offset(self.joints.len()) + SENSOR_SIZE
    }

    /// What numbers say of a joint: `inertia` about it, or mass on it, of its own body, `damping`, `friction` where
    /// the model has it, and the parameters of effects as `effect.parameter`; SI units.
    pub fn values(&self, joint: usize, x: &[f64]) -> BTreeMap<String, f64> {
        let (model, first) = (&self.joints[joint], self.offset(joint));
        let mut values = BTreeMap::from([("inertia".to_owned(), x[first + INERTIA].exp())]);
        let by_direction = model.resists_by_direction();
        if !by_direction {
            values.insert("damping".to_owned(), x[first + DAMPING].exp());
        }
        if model.friction && !by_direction {
            values.insert("friction".to_owned(), x[first + FRICTION].exp());
        }
        for (i, effect) in model.effects.iter().enumerate() {
            let at = first + model.effect_offset(i);
            for (k, parameter) in effect.kind.parameters().iter().enumerate() {
                let name = format!("{}.{}", effect.kind.name(), parameter.name);
                values.insert(name, parameter.physical(x[at + k], &effect.scales));
            }
        }
        values
    }

    /// The sensor's numbers that the model has, counted from the sensor's first.
    pub fn active_sensor(&self) -> Vec<usize> {
        let bias = (0..6).filter(|_| self.sensor.bias);
        bias.chain((6..7).filter(|_| self.sensor.delay)).collect()
    }

    /// The sensor's errors; none where the model has none.
    pub fn sensor_error<T: Real>(&self, x: &[T]) -> SensorError<T> {
        let first = self.offset(self.joints.len());
        let [force, torque, delay] = self.sensor.scales;
        let entry = |i: usize, scale: f64, there: bool| {
            let value = x.get(first + i).filter(|_| there);
            value.map_or_else(T::zero, |&value| value * T::constant(scale))
        };
        SensorError {
            force_bias: Vector3::from_fn(|i, _| entry(i, force, self.sensor.bias)),
            torque_bias: Vector3::from_fn(|i, _| entry(3 + i, torque, self.sensor.bias)),
            delay_s: entry(6, delay, self.sensor.delay),
        }
    }

    /// The tree of one body per joint, at the configuration where the `frozen` joints are at their
    /// positions, and fixed, and the others at zero.
    pub fn tree<T: Real>(&self, x: &[T], axes: &[Axis], frozen: &[Option<f64>]) -> Result<Tree<T>, Failure> {
        let mut carried: Vec<Pose> = Vec::with_capacity(self.joints.len());
        let mut bodies: Vec<Body<T>> = Vec::with_capacity(self.joints.len());
        let mut at = 0;
        for (k, model) in self.joints.iter().enumerate() {
            let own = &x[at..at + model.size()];
            at += model.size();
            let parent = model.joint.parent.map_or_else(Pose::identity, |p| carried[p]);
            let screw = KinematicJoint { axis: axes[k], ..model.joint }.screw();
            let (mass, com, about_com) = model.inertia(own, &axes[k]);
            let here = frozen[k].map_or(parent, |q| parent * screw.displacement(q));
            let pose = Pose::constant(&here);
            let tilt = model.tilt.tilt(own);
            let turned = match model.joint.joint_type {
                JointType::Prismatic => Screw::prismatic(&tilt),
                _ => Screw::revolute(&tilt, &axes[k].point.map(T::constant)),
            };
            let body = Body {
                parent: model.joint.parent,
                joint: if frozen[k].is_some() { JointType::Rigid } else { model.joint.joint_type },
                screw: Screw(Pose::constant(&parent).adjoint(&(screw.0.map(T::constant) + turned.0))),
                mass,
                com_in_world: pose.transform_point(&com),
                inertia_about_com: pose.rotation * about_com * pose.rotation.transpose(),
                parameters: if frozen[k].is_some() { JointParameters::default() } else { model.parameters(own) },
            };
            bodies.push(body);
            carried.push(here);
        }
        Tree::new(bodies, self.gravity).map_err(|_| Failure::Singular)
    }

    /// The centre of mass of a joint's child at the reference configuration \[m\].
    pub fn center_of_mass(&self, joint: usize, x: &[f64]) -> Vector3<f64> {
        let model = &self.joints[joint];
        model.inertia(&x[self.offset(joint)..], &model.joint.axis).1
    }
}

/// The joint models of a kinematic fit; `scales` and `stops` by joint.
pub fn joint_models(
    joints: &[KinematicJoint],
    hull: impl Fn(&KinematicJoint) -> HullProperties,
    scales: &[JointScales],
    stops: &[[bool; 2]],
    gravity: &Vector3<f64>,
) -> Vec<JointModel> {
    let hinge_above = |k: usize| {
        let mut above = joints[k].parent;
        while let Some(p) = above {
            if joints[p].joint_type == JointType::Revolute {
                return Some(joints[p].axis.direction);
            }
            above = joints[p].parent;
        }
        None
    };
    joints
        .iter()
        .enumerate()
        .map(|(k, joint)| {
            let carried = joint.parent.is_some();
            let revolute = joint.joint_type == JointType::Revolute;
            // A hinge within .5° of gravity is loaded by less than a hundredth of the weight.
            let loaded = revolute && joint.axis.direction.cross(gravity).norm() > 0.01 * gravity.norm();
            let (center_shows, across) = if revolute {
                (loaded || carried, joint.axis.direction)
            } else {
                (hinge_above(k).is_some(), hinge_above(k).unwrap_or(joint.axis.direction))
            };
            let hull = hull(joint);
            JointModel {
                joint: *joint,
                center: CenterFrame::new(joint, &hull, &across),
                tilt: TiltFrame::new(joint, gravity),
                hull,
                scales: scales[k],
                stops: stops[k],
                center_shows,
                friction: true,
                effects: Vec::new(),
                tables: Vec::new(),
            }
        })
        .collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_centre_of_mass_is_what_its_numbers_say() {
        for polar in [true, false] {
            let frame = CenterFrame { basis: [Vector3::x(), Vector3::y()], polar };
            let arm = Vector3::new(0.2, -0.05, 0.0);
            let (numbers, per_metre) = frame.numbers(&arm);
            let mut x = [0.0; SIZE];
            x[CENTER..CENTER + 2].copy_from_slice(&numbers);
            assert!((frame.arm(&x) - arm).norm() < 1e-12);
            let expected = if polar { 1.0 / arm.norm() } else { 1.0 };
            assert!((per_metre - expected).abs() < 1e-9);
        }
    }
}
