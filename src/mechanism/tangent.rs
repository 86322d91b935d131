//! Steps with their derivatives, by the structure of the equations instead of numbers that carry them.
//!
//! With a = (q̇⁺ − q̇)/h, a step says h ID(q̄, v̄, a) + damping = h (forces + Jᵀ w) + λ, ID the inverse dynamics. Its
//! derivatives by q̄ and v̄ are those of recursive Newton–Euler (Carpentier, Mansard, "Analytical derivatives of
//! rigid body dynamics algorithms", RSS 2018), by inertias ID is linear, and the system of the slipping joints is
//! factored already. One pass of each kind then serves all columns: for a chain of three joints and twenty
//! parameters a step with its derivatives costs as much as five without, where differences cost 27. Steps in which
//! a joint turns round or meets a limit are differenced. Left out is how Θ of a step depends on the inertia, some
//! 10⁻³ of the derivative by the inertia.

use nalgebra::DMatrix;

use super::effects::JointState;
use super::forcing::WrenchTrack;
use super::friction::Regime;
use super::inertia::{Spatial, SpatialInertia};
use super::parameters::JointForces;
use super::rollout::{RolloutError, steps};
use super::step::{BodyWrench, State, Step, WrenchOrigin, joint_state, middle_rate, step};
use super::tree::{Tree, joint_displacement};
use super::workspace::Workspace;

/// Step of the differences that are left, of states and of joint forces.
const DIFFERENCE: f64 = 1e-6;

/// How a tree depends on one parameter.
#[derive(Clone, Debug)]
pub struct TreeSlope {
    /// The tree with the parameter moved by `by`.
    moved: Tree<f64>,
    by: f64,
    /// Per unit, of the lumped inertias that change, by joint.
    inertias: Vec<(usize, SpatialInertia<f64>)>,
    /// The same of the screws at the reference configuration.
    screws: Vec<(usize, Spatial<f64>)>,
    /// Joints whose own parameters change.
    joints: Vec<usize>,
}

impl TreeSlope {
    /// From the tree and the same with the parameter moved by `by`, of any unit.
    pub fn new(tree: &Tree<f64>, moved: Tree<f64>, by: f64) -> Self {
        let mut slope = Self { by, inertias: Vec::new(), screws: Vec::new(), joints: Vec::new(), moved };
        for (k, &body) in tree.moving.iter().enumerate() {
            let (old, new) = (&tree.bodies()[body], &slope.moved.bodies()[body]);
            if tree.lumped[k] != slope.moved.lumped[k] {
                slope.inertias.push((k, slope.moved.lumped[k].slope_from(&tree.lumped[k], by)));
            }
            if old.screw != new.screw {
                slope.screws.push((k, Spatial::from(&((new.screw.0 - old.screw.0) / by))));
            }
            if old.parameters != new.parameters {
                slope.joints.push(k);
            }
        }
        slope
    }
}

/// Derivatives of a state along columns, one row per moving joint.
#[derive(Clone, Debug)]
pub struct StateSlopes {
    /// Of q.
    pub positions: DMatrix<f64>,
    /// Of q̇.
    pub rates: DMatrix<f64>,
    before: DMatrix<f64>,
}

impl StateSlopes {
    /// Of a state at which a motion starts.
    pub fn new(positions: DMatrix<f64>, rates: DMatrix<f64>) -> Self {
        Self { positions, before: rates.clone(), rates }
    }
}

/// Memory of steps with derivatives for one tree.
#[derive(Clone, Debug)]
pub struct TangentWorkspace {
    plain: Workspace<f64>,
    moved: Workspace<f64>,
    dynamics: InverseDynamics,
    /// Derivatives of the inverse dynamics, less the wrenches: by q̄, by v̄, by the parameters.
    by_position: DMatrix<f64>,
    by_rate: DMatrix<f64>,
    by_parameter: DMatrix<f64>,
    middle: StateSlopes,
}

impl TangentWorkspace {
    /// For `tree`, or for any with as many bodies and moving joints.
    pub fn new(tree: &Tree<f64>) -> Self {
        let n = tree.moving_bodies().len();
        let none = DMatrix::zeros(n, 0);
        Self {
            plain: Workspace::new(tree),
            moved: Workspace::new(tree),
            dynamics: InverseDynamics::default(),
            by_position: DMatrix::zeros(n, n),
            by_rate: DMatrix::zeros(n, n),
            by_parameter: none.clone(),
            middle: StateSlopes::new(none.clone(), none),
        }
    }
}

/// Simulates over a span from `start`, whose derivatives are in `slopes`: along one column for each of
/// `parameters`, then along any others.
pub fn advance_with_slopes(
    tree: &Tree<f64>,
    start: &State<f64>,
    tracks: &[WrenchTrack<'_, f64>],
    (span_s, step_max_s): ([f64; 2], f64),
    (parameters, slopes): (&[TreeSlope], &mut StateSlopes),
    workspace: &mut TangentWorkspace,
) -> Result<State<f64>, RolloutError> {
    let mut state = start.clone();
    let mut cursors = vec![0; tracks.len()];
    let mut wrenches = Vec::with_capacity(tracks.len());
    for at in steps(&span_s, 1, step_max_s) {
        wrenches.clear();
        wrenches.extend(tracks.iter().zip(&mut cursors).map(|(track, cursor)| track.wrench(at.middle_s, cursor)));
        step_with_slopes(tree, &mut state, &wrenches, at, (parameters, slopes), workspace);
    }
    let finite = state.positions.iter().chain(&state.rates).all(|x| x.is_finite());
    if finite { Ok(state) } else { Err(RolloutError::Diverged { time_s: span_s[1] }) }
}

/// [`step`], which also carries `slopes` along.
fn step_with_slopes(
    tree: &Tree<f64>,
    state: &mut State<f64>,
    wrenches: &[BodyWrench<f64>],
    at: Step,
    (parameters, slopes): (&[TreeSlope], &mut StateSlopes),
    workspace: &mut TangentWorkspace,
) {
    let before = state.clone();
    step(tree, state, wrenches, at, &mut workspace.plain);
    let carried = wrenches.iter().any(|wrench| matches!(wrench.point, WrenchOrigin::Carried(_)));
    if carried || !workspace.plain.solve.is_regular() {
        difference(tree, (&before, state), wrenches, at, (parameters, slopes), &mut workspace.moved);
        return;
    }
    let (n, h) = (tree.moving.len(), at.length_s);
    let plain = &workspace.plain;
    middle_slopes(tree, &before, h, slopes, &mut workspace.middle);
    let accelerations = (0..n).map(|k| (plain.rates[k] - before.rates[tree.moving[k]]) / h);
    workspace.dynamics.run(tree, wrenches, accelerations, plain);
    for j in 0..n {
        let moved = Change { displacement: Some((j, plain.screws[j])), ..Change::default() };
        workspace.dynamics.slope(tree, plain, &moved, workspace.by_position.column_mut(j).as_mut_slice());
        let faster = Change { rate: Some(j), ..Change::default() };
        workspace.dynamics.slope(tree, plain, &faster, workspace.by_rate.column_mut(j).as_mut_slice());
    }
    workspace.by_parameter.resize_mut(n, parameters.len(), 0.0);
    workspace.by_parameter.fill(0.0);
    let mut own = vec![0.0; n];
    for (parameter, mut column) in parameters.iter().zip(workspace.by_parameter.column_iter_mut()) {
        let column = column.as_mut_slice();
        for &(k, inertia) in &parameter.inertias {
            workspace.dynamics.inertia_slope(tree, plain, (k, &inertia), column);
        }
        for &(k, screw) in &parameter.screws {
            let turned = screw_change(tree, plain, (k, screw), parameter.by);
            workspace.dynamics.slope(tree, plain, &turned, &mut own);
            column.iter_mut().zip(&own).for_each(|(sum, own)| *sum += own);
        }
    }
    let middle = &workspace.middle;
    let mut right = &workspace.by_position * &middle.positions + &workspace.by_rate * &middle.rates;
    let mut own = right.columns_mut(0, parameters.len());
    own += &workspace.by_parameter;
    right *= -h;
    for (k, &body) in tree.moving.iter().enumerate() {
        let joint = joint_state(tree, &before, plain, k, at);
        let own = &tree.bodies()[body].parameters;
        let forces = own.forces(&joint);
        let law = Law {
            regime: plain.solve.regimes()[k],
            rates: [before.rates[body], plain.rates[k]],
            impulse: forces.damping * h,
            inertia: plain.mass_matrix[k * n + k] - plain.bias[k],
            step_s: h,
        };
        for c in 0..right.ncols() {
            let momentum: f64 = (0..n).map(|j| plain.mass_matrix[k * n + j] * slopes.rates[(j, c)]).sum();
            right[(k, c)] += momentum - law.impulse * slopes.rates[(k, c)];
        }
        if !own.effects.is_empty() || !own.tables.is_empty() {
            let by = |moved: JointState<f64>| law.gained(&own.forces(&moved), &forces, DIFFERENCE);
            let by_position = by(JointState { position: joint.position + DIFFERENCE, ..joint });
            let by_rate = by(JointState { rate: joint.rate + DIFFERENCE, ..joint });
            let by_acceleration = by(JointState { acceleration: joint.acceleration + DIFFERENCE, ..joint });
            for c in 0..right.ncols() {
                let faster = (slopes.rates[(k, c)] - slopes.before[(k, c)]) / h;
                right[(k, c)] +=
                    by_position * middle.positions[(k, c)] + by_rate * middle.rates[(k, c)] + by_acceleration * faster;
            }
        }
        for (c, parameter) in parameters.iter().enumerate().filter(|(_, parameter)| parameter.joints.contains(&k)) {
            let moved = &parameter.moved.bodies()[body].parameters;
            right[(k, c)] += law.gained(&moved.forces(&joint), &forces, parameter.by);
            // Inertia of the joint's own, as of a gear.
            let acceleration = (law.rates[1] - law.rates[0]) / h;
            right[(k, c)] -= h * acceleration * (moved.armature() - own.armature()) / parameter.by;
        }
    }
    let half = 0.5 * h;
    for (c, mut column) in right.column_iter_mut().enumerate() {
        plain.solve.carry(column.as_mut_slice());
        for k in 0..n {
            slopes.positions[(k, c)] = middle.positions[(k, c)] + half * column[k];
        }
    }
    std::mem::swap(&mut slopes.before, &mut slopes.rates);
    slopes.rates = right;
}

/// What a step does with the forces of one joint.
struct Law {
    regime: Regime,
    /// q̇ before and after.
    rates: [f64; 2],
    /// h d.
    impulse: f64,
    /// M_kk.
    inertia: f64,
    step_s: f64,
}

impl Law {
    /// Derivative of the impulse on the joint where `moved` are its forces for something moved by `by`.
    fn gained(&self, moved: &JointForces<f64>, forces: &JointForces<f64>, by: f64) -> f64 {
        let damping = self.step_s * (moved.damping - forces.damping);
        let [before, after] = self.rates;
        let share = 2.0 * (self.inertia / (2.0 * self.inertia + self.impulse)).powi(2);
        let friction = match self.regime {
            Regime::SlipsPlus => forces.friction.against_plus - moved.friction.against_plus,
            Regime::SlipsMinus => moved.friction.against_minus - forces.friction.against_minus,
            _ => 0.0,
        };
        let driven = self.step_s * (moved.force - forces.force + friction);
        (driven - damping * after + damping * share * (after - before)) / by
    }
}

/// Derivatives of q̄ and v̄.
fn middle_slopes(tree: &Tree<f64>, before: &State<f64>, h: f64, slopes: &StateSlopes, middle: &mut StateSlopes) {
    middle.positions = &slopes.positions + &slopes.rates * (0.5 * h);
    middle.rates.clone_from(&slopes.rates);
    for (k, &body) in tree.moving.iter().enumerate() {
        let (rate, earlier) = (before.rates[body], before.rates_before[body]);
        if middle_rate(rate, earlier) != rate {
            let faster = (slopes.rates.row(k) - slopes.before.row(k)) * 0.5;
            let mut row = middle.rates.row_mut(k);
            row += faster;
        }
    }
}

/// What a parameter's change of a screw does: it displaces the joint's child, and turns the screw.
fn screw_change(tree: &Tree<f64>, plain: &Workspace<f64>, (k, slope): (usize, Spatial<f64>), by: f64) -> Change {
    let body = &tree.bodies()[tree.moving[k]];
    let (screw, q) = (Spatial::from(&body.screw.0), plain.middle[tree.moving[k]]);
    let here = joint_displacement(body.joint, &screw, q);
    let there = joint_displacement(body.joint, &(screw + slope * by), q);
    let turned = (there.rotation - here.rotation) * here.rotation.transpose() / by;
    let angular = nalgebra::Vector3::new(
        turned[(2, 1)] - turned[(1, 2)],
        turned[(0, 2)] - turned[(2, 0)],
        turned[(1, 0)] - turned[(0, 1)],
    ) * 0.5;
    let linear = (there.translation - here.translation) / by - angular.cross(&here.translation);
    let own = Spatial { angular, linear };
    let above = tree.parents[k].map(|parent| plain.poses[parent]);
    let carried = |twist: Spatial<f64>| above.map_or(twist, |pose| twist.carried_by(&pose));
    Change { displacement: Some((k, carried(own))), screw: Some((k, carried(slope))), rate: None }
}

/// Derivatives of a step by running it from moved states and with moved trees.
fn difference(
    tree: &Tree<f64>,
    (before, after): (&State<f64>, &State<f64>),
    wrenches: &[BodyWrench<f64>],
    at: Step,
    (parameters, slopes): (&[TreeSlope], &mut StateSlopes),
    workspace: &mut Workspace<f64>,
) {
    for c in 0..slopes.positions.ncols() {
        let (tree, by) = parameters.get(c).map_or((tree, DIFFERENCE), |parameter| (&parameter.moved, parameter.by));
        let mut state = before.clone();
        for (k, &body) in tree.moving.iter().enumerate() {
            state.positions[body] += by * slopes.positions[(k, c)];
            state.rates[body] += by * slopes.rates[(k, c)];
            state.rates_before[body] += by * slopes.before[(k, c)];
        }
        step(tree, &mut state, wrenches, at, workspace);
        for (k, &body) in tree.moving.iter().enumerate() {
            slopes.before[(k, c)] = slopes.rates[(k, c)];
            slopes.positions[(k, c)] = (state.positions[body] - after.positions[body]) / by;
            slopes.rates[(k, c)] = (state.rates[body] - after.rates[body]) / by;
        }
    }
}

/// What is moved, per unit; all in world at the present configuration.
#[derive(Clone, Copy, Debug, Default)]
struct Change {
    /// A joint whose child, with all that it carries, goes along a twist.
    displacement: Option<(usize, Spatial<f64>)>,
    /// A joint whose screw changes, beyond going along with its parent.
    screw: Option<(usize, Spatial<f64>)>,
    /// A joint that is faster.
    rate: Option<usize>,
}

/// ID(q̄, v̄, a) − Jᵀ w of a step, kept for its derivatives; one entry per moving joint.
#[derive(Clone, Debug, Default)]
struct InverseDynamics {
    accelerations: Vec<f64>,
    /// Of the bodies, gravity's included.
    spatial: Vec<Spatial<f64>>,
    /// Momenta of the bodies, and their I a.
    momenta: Vec<[Spatial<f64>; 2]>,
    /// What each joint transmits.
    totals: Vec<Spatial<f64>>,
    moved: Vec<MovedBody>,
}

/// Derivatives of one body's motion.
#[derive(Clone, Copy, Debug)]
struct MovedBody {
    displacement: Spatial<f64>,
    screw: Spatial<f64>,
    twist: Spatial<f64>,
    acceleration: Spatial<f64>,
    force: Spatial<f64>,
}

impl MovedBody {
    fn still() -> Self {
        let zero = Spatial::zero();
        Self { displacement: zero, screw: zero, twist: zero, acceleration: zero, force: zero }
    }
}

impl InverseDynamics {
    /// At the configuration, and with the twists, of the step that `plain` is left from.
    fn run(
        &mut self,
        tree: &Tree<f64>,
        wrenches: &[BodyWrench<f64>],
        accelerations: impl Iterator<Item = f64>,
        plain: &Workspace<f64>,
    ) {
        let Self { accelerations: own, spatial, momenta, totals, .. } = self;
        own.clear();
        own.extend(accelerations);
        spatial.clear();
        momenta.clear();
        totals.clear();
        for (k, &parent) in tree.parents.iter().enumerate() {
            let (twist, acceleration) = motion_above(tree, parent, spatial, plain);
            let driven = plain.screws[k] * own[k] + twist.cross_motion(&(plain.screws[k] * plain.middle_rates[k]));
            spatial.push(acceleration + driven);
            let inertia = &plain.inertias[k];
            momenta.push([inertia.momentum(&plain.twists[k]), inertia.momentum(&spatial[k])]);
            totals.push(momenta[k][1] + plain.twists[k].cross_force(&momenta[k][0]));
        }
        for wrench in wrenches {
            if let (Some(k), WrenchOrigin::World(point)) = (tree.carriers[wrench.body], wrench.point) {
                totals[k] += Spatial::wrench_at(&point, wrench.force, &wrench.torque) * -1.0;
            }
        }
        for k in (0..tree.parents.len()).rev() {
            if let Some(parent) = tree.parents[k] {
                let total = totals[k];
                totals[parent] += total;
            }
        }
    }

    /// The derivative by a change, one entry per moving joint.
    fn slope(&mut self, tree: &Tree<f64>, plain: &Workspace<f64>, change: &Change, result: &mut [f64]) {
        let Self { accelerations, spatial, momenta, totals, moved } = self;
        moved.clear();
        for (k, &parent) in tree.parents.iter().enumerate() {
            let (twist, _) = motion_above(tree, parent, spatial, plain);
            let mut own = parent.map_or_else(MovedBody::still, |parent| moved[parent]);
            let (screw, rate) = (plain.screws[k], plain.middle_rates[k]);
            let mut screw_slope = own.displacement.cross_motion(&screw);
            if let Some((_, more)) = change.screw.filter(|(joint, _)| *joint == k) {
                screw_slope += more;
            }
            let mut driven = screw_slope * rate;
            if change.rate == Some(k) {
                driven += screw;
            }
            own.acceleration +=
                screw_slope * accelerations[k] + twist.cross_motion(&driven) + own.twist.cross_motion(&(screw * rate));
            own.screw = screw_slope;
            own.twist += driven;
            if let Some((_, more)) = change.displacement.filter(|(joint, _)| *joint == k) {
                own.displacement += more;
            }
            let ([momentum, driving], along) = (momenta[k], own.displacement);
            let seen = |of: &Spatial<f64>, value: Spatial<f64>| value + along.cross_motion(of) * -1.0;
            let inertia = &plain.inertias[k];
            let momentum_slope = inertia.momentum(&seen(&plain.twists[k], own.twist)) + along.cross_force(&momentum);
            own.force = inertia.momentum(&seen(&spatial[k], own.acceleration))
                + along.cross_force(&driving)
                + own.twist.cross_force(&momentum)
                + plain.twists[k].cross_force(&momentum_slope);
            moved.push(own);
        }
        for k in (0..moved.len()).rev() {
            result[k] = moved[k].screw.dot(&totals[k]) + plain.screws[k].dot(&moved[k].force);
            if let Some(parent) = tree.parents[k] {
                let force = moved[k].force;
                moved[parent].force += force;
            }
        }
    }

    /// Adds the derivative by an inertia at the reference configuration.
    fn inertia_slope(
        &self,
        tree: &Tree<f64>,
        plain: &Workspace<f64>,
        (body, slope): (usize, &SpatialInertia<f64>),
        result: &mut [f64],
    ) {
        let inertia = slope.carried_by(&plain.poses[body]);
        let momentum = inertia.momentum(&plain.twists[body]);
        let force = inertia.momentum(&self.spatial[body]) + plain.twists[body].cross_force(&momentum);
        let mut joint = Some(body);
        while let Some(k) = joint {
            result[k] += plain.screws[k].dot(&force);
            joint = tree.parents[k];
        }
    }
}

/// Twist and acceleration of what carries a joint.
fn motion_above(
    tree: &Tree<f64>,
    parent: Option<usize>,
    spatial: &[Spatial<f64>],
    plain: &Workspace<f64>,
) -> (Spatial<f64>, Spatial<f64>) {
    match parent {
        Some(parent) => (plain.twists[parent], spatial[parent]),
        None => (Spatial::zero(), tree.upward()),
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};
    use proptest::prelude::*;

    use super::*;
    use crate::math::{Screw, orthonormal_pair};
    use crate::mechanism::effects::{AttachedEffect, EffectKind};
    use crate::mechanism::{Body, JointParameters, JointType, Limit, WrenchSample, rollout};

    const PARAMETERS: usize = 8;
    const SPAN_S: [f64; 2] = [0.0, 0.06];
    const STEP_S: f64 = 0.008;

    /// Three joints from plain numbers and from what is differenced by.
    fn tree(x: &[f64], by: &[f64; PARAMETERS], stop: Option<f64>, fork: bool) -> Tree<f64> {
        let bodies = (0..3).map(|k| {
            let x = &x[6 * k..];
            let axis = Vector3::new(x[0], x[1], x[2] + 1.5).normalize();
            let (first, second) = orthonormal_pair(&axis);
            let axis = if k == 1 { axis + first * by[0] + second * by[1] } else { axis };
            let point = Vector3::new(x[3], 0.4, 0.2 * k as f64);
            let turns = x[4] > 0.0;
            let mut parameters = JointParameters::new(0.6 + by[2], 0.3 + by[3] * k as f64);
            parameters.lower = stop.filter(|_| k == 0).map(|stop| Limit::at(stop + by[4]));
            match k {
                1 => parameters.effects.push(AttachedEffect::new(EffectKind::ReflectedInertia, &[0.2 + by[7]])),
                2 => parameters.effects.push(AttachedEffect::new(EffectKind::Spring, &[3.0 + by[4], 0.2])),
                _ => {}
            }
            Body {
                joint: if turns { JointType::Revolute } else { JointType::Prismatic },
                screw: if turns { Screw::revolute(&axis, &point) } else { Screw::prismatic(&axis) },
                mass: 1.5 + x[5] + if k == 2 { by[5] } else { 0.0 },
                com_in_world: point + Vector3::new(x[5], 0.3 + if k == 0 { by[6] } else { 0.0 }, 0.1),
                inertia_about_com: Matrix3::from_diagonal(&Vector3::new(0.2, 0.3, 0.25)),
                parameters,
                ..Body::rigid(if fork { k.checked_sub(1).map(|_| 0) } else { k.checked_sub(1) })
            }
        });
        Tree::new(bodies.collect(), Vector3::new(0.0, 0.0, -9.81)).unwrap()
    }

    fn push() -> [WrenchSample; 2] {
        [0.0, 0.1].map(|stamp_s| WrenchSample {
            stamp_s,
            point_in_world: Vector3::new(0.3, 0.1, 0.2),
            force_in_world: Vector3::new(4.0 - 20.0 * stamp_s, 3.0, 9.0),
            torque_in_world: Vector3::new(0.1, 0.0, -0.3),
        })
    }

    /// Central differences of whole runs, by the parameters, then by q and q̇; and the slopes.
    fn both(x: &[f64], start: &State<f64>, stop: Option<f64>, fork: bool) -> [DMatrix<f64>; 2] {
        let by = |c: usize, by: f64| {
            let mut parameters = [0.0; PARAMETERS];
            let mut start = start.clone();
            match c.checked_sub(PARAMETERS) {
                None => parameters[c] = by,
                Some(k @ 0..3) => start.positions[k] += by,
                Some(k) => {
                    start.rates[k - 3] += by;
                    start.rates_before[k - 3] += by;
                }
            }
            (tree(x, &parameters, stop, fork), start)
        };
        let samples = push();
        let tracks = [WrenchTrack::new(2, &samples)];
        let run = |c: usize, step: f64| {
            let (tree, start) = by(c, step);
            let run = rollout(&tree, &start, &tracks, &SPAN_S, STEP_S).unwrap();
            [run.positions(1), run.rates(1)].concat()
        };
        let step = 1e-6;
        let numeric = DMatrix::from_fn(6, PARAMETERS + 6, |i, c| (run(c, step)[i] - run(c, -step)[i]) / (2.0 * step));
        let plain = tree(x, &[0.0; PARAMETERS], stop, fork);
        let parameters: Vec<TreeSlope> = (0..PARAMETERS).map(|c| TreeSlope::new(&plain, by(c, step).0, step)).collect();
        let first = |at: usize| DMatrix::from_fn(3, PARAMETERS + 6, |k, c| f64::from(c == at + k));
        let mut slopes = StateSlopes::new(first(PARAMETERS), first(PARAMETERS + 3));
        let mut workspace = TangentWorkspace::new(&plain);
        let span = (SPAN_S, STEP_S);
        let end = advance_with_slopes(&plain, start, &tracks, span, (&parameters, &mut slopes), &mut workspace);
        assert_eq!([end.as_ref().unwrap().positions.clone(), end.unwrap().rates].concat(), run(0, 0.0));
        let exact = DMatrix::from_fn(6, PARAMETERS + 6, |i, c| {
            if i < 3 { slopes.positions[(i, c)] } else { slopes.rates[(i - 3, c)] }
        });
        [numeric, exact]
    }

    /// In so many columns, to this share.
    fn agree([numeric, exact]: &[DMatrix<f64>; 2], columns: usize, share: f64) -> bool {
        (0..columns).all(|c| {
            // Θ depends on the inertia, and a little on the axes that it is about.
            let share = match c {
                5 | 6 => share.max(3e-3),
                0 | 1 => share.max(1e-3),
                _ => share,
            };
            (numeric.column(c) - exact.column(c)).amax() < share * (1e-2 + numeric.column(c).amax())
        })
    }

    proptest! {
        #![proptest_config(ProptestConfig::with_cases(48))]

        #[test]
        fn slopes_are_the_differences_of_whole_runs(
            x in prop::collection::vec(-1.0..1.0_f64, 18),
            rates in prop::array::uniform3(1.0..2.0_f64),
            fork in any::<bool>(),
        ) {
            let start = State::new(vec![0.1, -0.2, 0.3], rates.to_vec());
            let both = both(&x, &start, None, fork);
            prop_assert!(agree(&both, PARAMETERS + 6, 1e-4), "{}{}", both[0], both[1]);
        }
    }

    #[test]
    fn starting_turning_and_stopped_joints_have_their_slopes() {
        let x: Vec<f64> = (0..18).map(|i| (f64::from(i) * 1.7).sin()).collect();
        for (rates, stop) in [([0.0; 3], None), ([-0.05, 0.02, 0.03], None), ([-1.0, 0.5, 0.3], Some(0.09))] {
            let start = State::new(vec![0.1, -0.2, 0.3], rates.to_vec());
            let both = both(&x, &start, stop, false);
            // Of a joint at rest there is none by its rate.
            let columns = PARAMETERS + if rates == [0.0; 3] { 3 } else { 6 };
            // One-sided differences, about a stop.
            let share = if stop.is_some() { 1e-3 } else { 1e-4 };
            assert!(agree(&both, columns, share), "{rates:?} {}{}", both[0], both[1]);
        }
    }
}
