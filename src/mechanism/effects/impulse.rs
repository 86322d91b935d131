//! A finite pulse of undeclared force.

use super::{Dimension, Effect, JointState, Parameter};
use crate::math::Real;

/// force, from start for span; in a step, the mean over it, so that no pulse falls between two steps.
#[derive(Clone, Copy, Debug)]
pub struct Impulse;

impl Effect for Impulse {
    const NAME: &'static str = "impulse";
    const PARAMETERS: &'static [Parameter] = &[
        Parameter::signed("start", Dimension::Time, 0.5, 0.3),
        Parameter::positive("span", Dimension::Time, 0.02, 1.0),
        Parameter::signed("force", Dimension::Force, 0.0, 1.0),
    ];

    fn force<T: Real>(parameters: &[T], joint: &JointState<T>) -> T {
        let [start, span, force] = [parameters[0], parameters[1], parameters[2]];
        let half = 0.5 * joint.step_s;
        let end = start + span;
        let first = T::constant(joint.time_s - half);
        let last = T::constant(joint.time_s + half);
        let from = if start.value() > first.value() { start } else { first };
        let to = if end.value() < last.value() { end } else { last };
        if to.value() <= from.value() {
            return T::zero();
        }
        force * (to - from) / T::constant(joint.step_s)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_whole_impulse_arrives_whatever_the_step() {
        for step_s in [0.001, 0.004, 0.3] {
            let total: f64 = (0..(3.0_f64 / step_s) as usize)
                .map(|i| {
                    let time_s = (i as f64 + 0.5) * step_s;
                    let joint = JointState { position: 0.0, rate: 0.0, acceleration: 0.0, time_s, step_s };
                    Impulse::force(&[1.0003, 0.01, 5.0], &joint) * step_s
                })
                .sum();
            assert!((total - 0.05).abs() < 1e-12);
        }
    }
}
