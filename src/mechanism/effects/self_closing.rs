//! A closer that acts around one place, such as a cam or a tilted hinge.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// −peak · exp(−½ ((x − centre)/width)²), width by side: before where x < centre, after beyond.
#[derive(Clone, Copy, Debug)]
pub struct SelfClosing;

impl Effect for SelfClosing {
    const NAME: &'static str = "self_closing";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("peak", Dimension::Force, 0.5, 1.0),
        Parameter::signed("centre", Dimension::Position, 0.3, 0.3),
        Parameter::positive("width_before", Dimension::Position, 0.2, 0.7),
        Parameter::positive("width_after", Dimension::Position, 0.2, 0.7),
    ];

    fn force<T: Real>(parameters: &[T], joint: &JointState<T>) -> T {
        let [peak, centre] = [parameters[0], parameters[1]];
        let beyond = joint.position - centre;
        let width = if beyond.value() < 0.0 { parameters[2] } else { parameters[3] };
        let ratio = beyond / width;
        -peak * (-(ratio * ratio) * T::constant(0.5)).exp()
    }
}
