//! A constant generalized force.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// offset.
#[derive(Clone, Copy, Debug)]
pub struct GravityOffset;

impl Effect for GravityOffset {
    const NAME: &'static str = "gravity_offset";
    const PARAMETERS: &'static [Parameter] = &[Parameter::signed("offset", Dimension::Force, 0.0, 0.5)];

    fn force<T: Real>(parameters: &[T], _joint: &JointState<T>) -> T {
        parameters[0]
    }
}
