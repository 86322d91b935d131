//! A linear spring to a rest position.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// −k (x − rest).
#[derive(Clone, Copy, Debug)]
pub struct Spring;

impl Effect for Spring {
    const NAME: &'static str = "spring";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("stiffness", Dimension::Stiffness, 0.5, 1.5),
        Parameter::signed("rest", Dimension::Position, 0.0, 1.0),
    ];

    fn force<T: Real>(parameters: &[T], joint: &JointState<T>) -> T {
        let [stiffness, rest] = [parameters[0], parameters[1]];
        -stiffness * (joint.position - rest)
    }
}
