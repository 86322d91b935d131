//! Joint limits: unilateral, near-inelastic contact of a given softness.
//!
//! Beyond a limit the joint may not move faster outward than the critically damped
//! ẍ = −2 ẋ/T − x/T² would let it, x the penetration, whatever pushes it: a stop of infinite
//! strength that takes the time T to halt. This is MuJoCo's constraint model for full impedance
//! (solref = (T, 1), solimp → 1); it gives back e⁻² = 14 % of the speed. The closed-form flow over a
//! step bounds the next rate, so the force needs no stiff integration.

use crate::math::Real;

/// Softness T of a limit when nothing else is known \[s\]: the time constant in which a stop halts
/// the joint. A choice, not a measurement: half of MuJoCo's default of .02 s, and well above a step.
pub const DEFAULT_LIMIT_SOFTNESS_S: f64 = 0.01;

/// One end of a joint's range.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Limit<T: Real> {
    /// Where it begins \[m or rad\].
    pub position: T,
    /// T \[s\]; a step h uses at least 2 h, so zero is the hardest a step can carry.
    pub softness_s: f64,
}

impl<T: Real> Limit<T> {
    /// A limit of the default softness at `position` \[m or rad\].
    pub fn at(position: T) -> Self {
        Self { position, softness_s: DEFAULT_LIMIT_SOFTNESS_S }
    }

    /// The least rate allowed at the end of a step of `step_s` that starts at `position` with
    /// `rate`, if this is a lower limit; `None` where it does not act.
    pub fn least_rate(&self, position: T, rate: T, step_s: f64) -> Option<T> {
        least_rate(position - self.position, rate, self.softness_s, step_s)
    }

    /// The greatest rate allowed, if this is an upper limit.
    pub fn greatest_rate(&self, position: T, rate: T, step_s: f64) -> Option<T> {
        least_rate(self.position - position, -rate, self.softness_s, step_s).map(|rate| -rate)
    }
}

/// x(t) = (x₀ + (ẋ₀ + x₀/T) t) e^(−t/T): its rate after the part of the step spent at x ≤ 0.
fn least_rate<T: Real>(gap: T, rate: T, softness_s: f64, step_s: f64) -> Option<T> {
    let softness_s = softness_s.max(2.0 * step_s);
    let time_constant = T::constant(softness_s);
    if gap.value() <= 0.0 {
        let ratio = T::constant(step_s / softness_s);
        let decay = T::constant((-step_s / softness_s).exp());
        return Some((rate - (rate + gap / time_constant) * ratio) * decay);
    }
    if gap.value() + step_s * rate.value() >= 0.0 {
        return None;
    }
    let ratio = (T::constant(step_s) + gap / rate) / time_constant;
    Some(rate * (T::one() - ratio) * (-ratio).exp())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn the_bound_is_continuous_where_contact_begins() {
        let limit = Limit::at(0.0);
        let just_outside = limit.least_rate(1e-12, -0.5, 1e-3).unwrap();
        let just_inside = limit.least_rate(-1e-12, -0.5, 1e-3).unwrap();
        assert!((just_outside - just_inside).abs() < 1e-9);
        let entering_late = limit.least_rate(0.5e-3 - 1e-12, -0.5, 1e-3).unwrap();
        assert!((entering_late + 0.5).abs() < 1e-6);
        assert_eq!(limit.least_rate(0.5e-3 + 1e-12, -0.5, 1e-3), None);
    }

    #[test]
    fn upper_mirrors_lower() {
        let limit = Limit { position: 0.3, softness_s: 0.02 };
        let mirror = Limit { position: -0.3, softness_s: 0.02 };
        let upper = limit.greatest_rate(0.301, 0.2, 1e-3).unwrap();
        assert_eq!(upper, -mirror.least_rate(-0.301, -0.2, 1e-3).unwrap());
    }
}
