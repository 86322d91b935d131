//! One step in time: the midpoint form of Moreau's scheme, of second order while nothing switches.
//!
//! With q̄ = q + h q̇/2 and v̄ = q̇ + (q̇ − q̇₋)/2, the rate at mid-step from the two last ones,
//!
//! (M(q̄) + h Θ D) q̇⁺ = M(q̄) q̇ − h (1 − Θ) D q̇ + h (τ(q̄) − c(q̄, v̄) − g(q̄)) + λ,
//! λ_j ∈ h [−F, F] against q̇⁺_j,  q⁺ = q̄ + h q̇⁺/2
//!
//! (Moreau 1999, "Numerical aspects of the sweeping process"; Acary, Brogliato 2008, chapter 10).
//! Θ = (1 + z)/(2 + z) with z = h d/M_jj makes one damped joint decay by 2/(2 + 2z + z²), the (0, 2)
//! Padé approximant of e⁻ᶻ: second order, and monotone for any damping. Friction and limits see
//! q̇⁺ alone, so a stuck joint stays where it is, exactly.

use super::effects::JointState;
use super::friction::{FrictionBounds, Row};
use super::inertia::Spatial;
use super::limits::Approach;
use super::parameters::{JointForces, JointParameters};
use super::solve::solve;
use super::tree::Tree;
use super::workspace::Workspace;
use crate::math::Real;
use nalgebra::Vector3;

/// Positions and rates of a tree's joints, one per body.
#[derive(Clone, Debug, PartialEq)]
pub struct State<T: Real> {
    /// q \[m or rad\].
    pub positions: Vec<T>,
    /// q̇ \[m/s or rad/s\].
    pub rates: Vec<T>,
    /// q̇ one step earlier, q̇ itself at the start.
    pub(super) rates_before: Vec<T>,
}

impl<T: Real> State<T> {
    /// The start of a motion: one position and one rate per body.
    pub fn new(positions: Vec<T>, rates: Vec<T>) -> Self {
        Self { positions, rates_before: rates.clone(), rates }
    }

    /// At rest in the reference configuration.
    pub fn at_rest(body_count: usize) -> Self {
        Self::new(vec![T::zero(); body_count], vec![T::zero(); body_count])
    }
}

/// What a tool does to one body during a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct BodyWrench<T: Real> {
    /// Index of the body.
    pub body: usize,
    /// Where it is applied.
    pub point: WrenchOrigin<T>,
    /// Force on the object \[N\], world axes.
    pub force: Vector3<T>,
    /// Torque on the object about that point \[N·m\], world axes.
    pub torque: Vector3<T>,
}

/// The point that a wrench's torque is about.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum WrenchOrigin<T: Real> {
    /// A fixed point in world \[m\].
    World(Vector3<T>),
    /// A point of the body, given at the reference configuration \[m\], and moving with it.
    Carried(Vector3<T>),
}

/// Time and length of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Step {
    /// The middle of it \[s\]; wrenches are those of this time.
    pub middle_s: f64,
    /// h \[s\].
    pub length_s: f64,
}

/// Advances `state` by one step under `wrenches`.
pub fn step<T: Real>(
    tree: &Tree<T>,
    state: &mut State<T>,
    wrenches: &[BodyWrench<T>],
    step: Step,
    workspace: &mut Workspace<T>,
) {
    let n = tree.moving.len();
    let half = T::constant(0.5 * step.length_s);
    for (k, &body) in tree.moving.iter().enumerate() {
        let rate = state.rates[body];
        workspace.middle[body] = state.positions[body] + rate * half;
        workspace.middle_rates[k] = middle_rate(rate, state.rates_before[body]);
        workspace.rates[k] = rate;
    }
    let middle = std::mem::take(&mut workspace.middle);
    tree.update_kinematics(&middle, workspace);
    workspace.middle = middle;
    tree.update_mass_matrix(workspace);
    let middle_rates = std::mem::take(&mut workspace.middle_rates);
    tree.update_bias(&middle_rates, workspace);
    workspace.middle_rates = middle_rates;
    apply_wrenches(tree, wrenches, workspace);

    workspace.rows.clear();
    for (k, &body) in tree.moving.iter().enumerate() {
        let rate = workspace.rates[k];
        let momentum = (0..n).fold(T::zero(), |sum, j| sum + workspace.mass_matrix[k * n + j] * workspace.rates[j]);
        let applied = workspace.applied[k] - workspace.bias[k];
        let parameters = &tree.bodies()[body].parameters;
        let forces = parameters.forces(&joint_state(tree, state, workspace, k, step));
        let damping = ImplicitDamping::new(forces.damping, workspace.mass_matrix[k * n + k], step.length_s);
        workspace.applied[k] = momentum - damping.before * rate + (applied + forces.force) * T::constant(step.length_s);
        let approach = Approach {
            position: state.positions[body],
            rate,
            gained: rate - state.rates_before[body],
            step_s: step.length_s,
        };
        workspace.rows.push(row(parameters, &forces, &approach));
        workspace.bias[k] = damping.after;
    }
    for k in 0..n {
        let after = workspace.bias[k];
        workspace.mass_matrix[k * n + k] += after;
    }
    let Workspace { mass_matrix, applied, rows, rates, solve: scratch, .. } = workspace;
    solve(mass_matrix, applied, rows, rates, scratch);
    for (k, &body) in tree.moving.iter().enumerate() {
        let rate = workspace.rates[k];
        state.positions[body] =
            workspace.rows[k].limited_position(rate).unwrap_or_else(|| workspace.middle[body] + rate * half);
        state.rates_before[body] = state.rates[body];
        state.rates[body] = rate;
    }
}

/// What the forces of the k-th moving joint depend on, from the state before the step and the middle of it.
#[inline]
pub(super) fn joint_state<T: Real>(
    tree: &Tree<T>,
    before: &State<T>,
    workspace: &Workspace<T>,
    k: usize,
    step: Step,
) -> JointState<T> {
    let body = tree.moving[k];
    JointState {
        position: workspace.middle[body],
        rate: workspace.middle_rates[k],
        acceleration: (before.rates[body] - before.rates_before[body]) * T::constant(1.0 / step.length_s),
        time_s: step.middle_s,
        step_s: step.length_s,
    }
}

fn apply_wrenches<T: Real>(tree: &Tree<T>, wrenches: &[BodyWrench<T>], workspace: &mut Workspace<T>) {
    workspace.applied.fill(T::zero());
    for wrench in wrenches {
        let point = match wrench.point {
            WrenchOrigin::World(point) => point,
            WrenchOrigin::Carried(point) => tree.displacement(wrench.body, workspace).transform_point(&point),
        };
        let about_origin = Spatial::wrench_at(&point, wrench.force, &wrench.torque);
        let Workspace { screws, applied, .. } = workspace;
        tree.project_wrench(wrench.body, &about_origin, screws, applied);
    }
}

/// The rate at mid-step from the two last ones; never across a change of direction.
#[inline]
pub(super) fn middle_rate<T: Real>(rate: T, before: T) -> T {
    let middle = rate + (rate - before) * T::constant(0.5);
    if middle.value() * rate.value() > 0.0 { middle } else { rate }
}

/// The friction interval and the limits of one joint, as impulses and rates of this step.
#[inline]
pub(super) fn row<T: Real>(parameters: &JointParameters<T>, forces: &JointForces<T>, approach: &Approach<T>) -> Row<T> {
    let h = T::constant(approach.step_s);
    Row {
        friction: FrictionBounds {
            against_plus: forces.friction.against_plus * h,
            against_minus: forces.friction.against_minus * h,
        },
        least: parameters.lower.and_then(|limit| limit.as_lower(approach)),
        greatest: parameters.upper.and_then(|limit| limit.as_upper(approach)),
    }
}

/// The two shares of h d: what acts on the rate to come, and on the rate before.
#[derive(Clone, Copy, Debug)]
pub(super) struct ImplicitDamping<T: Real> {
    /// Θ h d.
    pub after: T,
    /// (1 − Θ) h d.
    pub before: T,
}

impl<T: Real> ImplicitDamping<T> {
    #[inline]
    pub fn new(damping: T, inertia: T, step_s: f64) -> Self {
        let impulse = damping * T::constant(step_s);
        let before = impulse * inertia / (inertia + inertia + impulse);
        Self { after: impulse - before, before }
    }
}
