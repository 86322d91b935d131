//! A magnet or latch that holds the joint closed.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// −peak · exp(−x / width); at x ≤ 0, behind the closed position, −peak.
#[derive(Clone, Copy, Debug)]
pub struct Catch;

impl Effect for Catch {
    const NAME: &'static str = "catch";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("peak", Dimension::Force, 1.0, 1.0),
        Parameter::positive("width", Dimension::Position, 0.03, 1.0),
    ];

    fn force<T: Real>(parameters: &[T], joint: &JointState<T>) -> T {
        let [peak, width] = [parameters[0], parameters[1]];
        if joint.position.value() <= 0.0 {
            // Bounded: an exponential behind the stop would grow without end.
            return -peak;
        }
        -peak * (-joint.position / width).exp()
    }
}
