//! A single moving joint: constant inertia, no bias but gravity, a step in closed form.
//!
//! The scheme is that of [`super::step()`]; J q̈ = τ − d q̇ + λ + Sᵀ w + a cos q + b sin q + e, with
//! S fixed, as nothing moves before it.

use super::effects::JointState;
use super::inertia::Spatial;
use super::joint::JointType;
use super::limits::Approach;
use super::parameters::JointParameters;
use super::step::{ImplicitDamping, Step, middle_rate, row};
use super::tree::Tree;
use crate::math::Real;
use nalgebra::Vector3;

/// One joint and all that moves with it.
#[derive(Clone, Copy, Debug)]
pub struct SingleJoint<T: Real> {
    /// Index of the body in its tree.
    pub body: usize,
    /// S, so that a world wrench w drives the joint with Sᵀ w.
    pub screw: Spatial<T>,
    /// Effective inertia, armature included \[kg or kg·m²\].
    pub inertia: T,
    gravity: Gravity<T>,
}

/// The generalized force of gravity.
#[derive(Clone, Copy, Debug)]
enum Gravity<T: Real> {
    Constant(T),
    /// cos q · first + sin q · second.
    Turning(T, T),
}

/// State of a single joint.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SingleState<T: Real> {
    /// q \[m or rad\].
    pub position: T,
    /// q̇ \[m/s or rad/s\].
    pub rate: T,
    rate_before: T,
}

impl<T: Real> SingleState<T> {
    /// The start of a motion.
    pub fn new(position: T, rate: T) -> Self {
        Self { position, rate, rate_before: rate }
    }

    /// Position and rate that a step's forces are taken at.
    pub(super) fn middle(&self, step_s: f64) -> (f64, f64) {
        let (rate, before) = (self.rate.value(), self.rate_before.value());
        (self.position.value() + 0.5 * step_s * rate, middle_rate(rate, before))
    }
}

impl<T: Real> SingleJoint<T> {
    /// The only moving joint of a tree; `None` if there are more, or none.
    pub fn of(tree: &Tree<T>) -> Option<Self> {
        let [body] = *tree.moving_bodies() else { return None };
        let lumped = &tree.lumped[0];
        let joint = &tree.bodies()[body];
        let screw = Spatial::from(&joint.screw.0);
        let momentum = lumped.momentum(&screw);
        let g = tree.gravity().map(T::constant);
        let gravity = if tree.gravity() == Vector3::zeros() {
            Gravity::Constant(T::zero())
        } else if joint.joint == JointType::Revolute {
            // d/dq of g · R(q) m (c − p): n × r at q = 0, and its derivative n × (n × r).
            let axis = screw.angular;
            let point = axis.cross(&screw.linear);
            let tangent = axis.cross(&(lumped.first_moment - point * lumped.mass));
            Gravity::Turning(tangent.dot(&g), axis.cross(&tangent).dot(&g))
        } else {
            Gravity::Constant(screw.linear.dot(&g) * lumped.mass)
        };
        Some(Self { body, screw, inertia: screw.dot(&momentum) + joint.parameters.armature(), gravity })
    }

    /// The generalized force of gravity at q \[N or N·m\].
    #[inline]
    pub fn gravity_force(&self, position: T) -> T {
        match self.gravity {
            Gravity::Constant(force) => force,
            Gravity::Turning(first, second) => {
                let (sin, cos) = position.sin_cos();
                first * cos + second * sin
            }
        }
    }

    /// Advances `state` by a step under the generalized force `applied` \[N or N·m\] of mid-step,
    /// gravity not in it; `parameters` is what the joint does by itself.
    #[inline]
    pub fn step(&self, parameters: &JointParameters<T>, state: &mut SingleState<T>, applied: T, step: Step) {
        let Step { middle_s, length_s: step_s } = step;
        let h = T::constant(step_s);
        let half = T::constant(0.5 * step_s);
        let rate = state.rate;
        let middle = state.position + rate * half;
        let joint = JointState {
            position: middle,
            rate: middle_rate(rate, state.rate_before),
            acceleration: (rate - state.rate_before) * T::constant(1.0 / step_s),
            time_s: middle_s,
            step_s,
        };
        let forces = parameters.forces(&joint);
        let damping = ImplicitDamping::new(forces.damping, self.inertia, step_s);
        let impulse =
            (self.inertia - damping.before) * rate + (applied + self.gravity_force(middle) + forces.force) * h;
        let approach = Approach { position: state.position, rate, gained: rate - state.rate_before, step_s };
        let row = row(parameters, &forces, &approach);
        state.rate_before = rate;
        state.rate = row.proximal(self.inertia + damping.after, impulse, rate);
        state.position = row.limited_position(state.rate).unwrap_or_else(|| middle + state.rate * half);
    }
}
