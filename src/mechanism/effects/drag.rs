//! Resistance that grows with the square of the rate.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// −c v |v|, as a damping c |v|.
#[derive(Clone, Copy, Debug)]
pub struct Drag;

impl Effect for Drag {
    const NAME: &'static str = "drag";
    const PARAMETERS: &'static [Parameter] = &[Parameter::positive("coefficient", Dimension::Drag, 0.3, 1.5)];

    fn damping<T: Real>(parameters: &[T], joint: &JointState<T>, declared: T) -> T {
        let rate = joint.rate;
        let speed = if rate.value() < 0.0 { -rate } else { rate };
        declared + parameters[0] * speed
    }
}
