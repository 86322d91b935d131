//! Friction that changes along the way.

use super::{Dimension, Effect, FrictionBounds, JointState, Parameter};
use crate::math::Real;

/// Friction bound max(0, F + amplitude · sin(2π x / period + phase)), F the declared bound.
#[derive(Clone, Copy, Debug)]
pub struct PositionFriction;

impl Effect for PositionFriction {
    const NAME: &'static str = "position_friction";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("amplitude", Dimension::Force, 0.3, 1.0),
        Parameter::positive("period", Dimension::Position, 0.5, 0.7),
        Parameter::signed("phase", Dimension::Phase, 0.0, 1.8),
    ];

    fn friction_bounds<T: Real>(
        parameters: &[T],
        joint: &JointState<T>,
        declared: FrictionBounds<T>,
    ) -> FrictionBounds<T> {
        let [amplitude, period, phase] = [parameters[0], parameters[1], parameters[2]];
        let change = amplitude * (T::two_pi() * joint.position / period + phase).sin();
        let bound = |declared: T| {
            let bound = declared + change;
            if bound.value() > 0.0 { bound } else { T::zero() }
        };
        FrictionBounds { against_plus: bound(declared.against_plus), against_minus: bound(declared.against_minus) }
    }
}
