//! Evenly spaced resting places.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// −peak · sin(2π x / period + phase).
#[derive(Clone, Copy, Debug)]
pub struct Detent;

impl Effect for Detent {
    const NAME: &'static str = "detent";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("peak", Dimension::Force, 0.5, 1.0),
        Parameter::positive("period", Dimension::Position, 0.2, 0.7),
        Parameter::signed("phase", Dimension::Phase, 0.0, 1.8),
    ];

    fn force<T: Real>(parameters: &[T], joint: &JointState<T>) -> T {
        let [peak, period, phase] = [parameters[0], parameters[1], parameters[2]];
        -peak * (T::two_pi() * joint.position / period + phase).sin()
    }
}
