//! Friction that falls once the joint moves.

use super::{Dimension, Effect, FrictionBounds, JointState, Parameter};
use crate::math::Real;

/// Friction bound F + (static − F) exp(−(v/v_s)²), F the declared bound; in each direction.
#[derive(Clone, Copy, Debug)]
pub struct Stribeck;

impl Effect for Stribeck {
    const NAME: &'static str = "stribeck";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("static", Dimension::Force, 0.5, 1.0),
        Parameter::positive("stribeck_rate", Dimension::Rate, 0.1, 1.0),
    ];

    fn friction_bounds<T: Real>(
        parameters: &[T],
        joint: &JointState<T>,
        declared: FrictionBounds<T>,
    ) -> FrictionBounds<T> {
        let ratio = joint.rate / parameters[1];
        let share = (-(ratio * ratio)).exp();
        let bound = |moving: T| moving + (parameters[0] - moving) * share;
        FrictionBounds { against_plus: bound(declared.against_plus), against_minus: bound(declared.against_minus) }
    }
}
