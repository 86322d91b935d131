//! Friction and damping that differ by direction.

use super::{Dimension, Effect, FrictionBounds, JointState, Parameter};
use crate::math::Real;

/// Friction bound and damping by direction of motion, in place of the declared ones.
#[derive(Clone, Copy, Debug)]
pub struct AsymmetricFriction;

impl Effect for AsymmetricFriction {
    const NAME: &'static str = "asymmetric_friction";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("friction_plus", Dimension::Force, 0.3, 1.0),
        Parameter::positive("friction_minus", Dimension::Force, 0.3, 1.0),
        Parameter::positive("damping_plus", Dimension::Damping, 0.3, 1.0),
        Parameter::positive("damping_minus", Dimension::Damping, 0.3, 1.0),
    ];

    fn damping<T: Real>(parameters: &[T], joint: &JointState<T>, _declared: T) -> T {
        let [plus, minus] = [parameters[2], parameters[3]];
        let rate = joint.rate.value();
        if rate > 0.0 {
            plus
        } else if rate < 0.0 {
            minus
        } else {
            (plus + minus) * T::constant(0.5)
        }
    }

    fn friction_bounds<T: Real>(
        parameters: &[T],
        _joint: &JointState<T>,
        _declared: FrictionBounds<T>,
    ) -> FrictionBounds<T> {
        FrictionBounds { against_plus: parameters[0], against_minus: parameters[1] }
    }
}
