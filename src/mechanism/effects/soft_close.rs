//! A damped closer near the closed position.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// −(k x + pull · tanh(x/.003) + c v if v < 0) for x < range.
#[derive(Clone, Copy, Debug)]
pub struct SoftClose;

impl Effect for SoftClose {
    const NAME: &'static str = "soft_close";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::positive("range", Dimension::Position, 0.2, 0.7),
        Parameter::positive("stiffness", Dimension::Stiffness, 0.5, 1.5),
        Parameter::positive("pull", Dimension::Force, 0.5, 1.0),
        Parameter::positive("damping", Dimension::Damping, 1.0, 1.5),
    ];

    fn force<T: Real>(parameters: &[T], joint: &JointState<T>) -> T {
        let [range, stiffness, pull] = [parameters[0], parameters[1], parameters[2]];
        let x = joint.position;
        let pull = pull * tanh(x / T::constant(PULL_WIDTH));
        -(stiffness * x + pull) * engaged(x, range)
    }

    fn damping<T: Real>(parameters: &[T], joint: &JointState<T>, declared: T) -> T {
        if joint.rate.value() < 0.0 {
            declared + parameters[3] * engaged(joint.position, parameters[0])
        } else {
            declared
        }
    }
}

/// Where the pull changes sign, of the law itself \[m or rad\].
const PULL_WIDTH: f64 = 0.003;
/// The end of the range is smoothed over this distance, so that it has a derivative; about the
/// travel in one step of a few milliseconds \[m or rad\].
const EDGE_WIDTH: f64 = 0.001;

/// One where x < range, zero beyond.
fn engaged<T: Real>(x: T, range: T) -> T {
    (T::one() + tanh((range - x) / T::constant(EDGE_WIDTH))) * T::constant(0.5)
}

/// tanh, exactly ±1 beyond 20 (where it is within 1e-17): dual numbers take sinh/cosh and overflow.
fn tanh<T: Real>(x: T) -> T {
    if x.value().abs() > 20.0 { T::constant(x.value().signum()) } else { x.tanh() }
}
