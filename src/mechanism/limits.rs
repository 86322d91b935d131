//! Joint limits: unilateral, near-inelastic contact of a given softness.
//!
//! Beyond a limit the joint may not move faster outward than the critically damped
//! ẍ = −2 ẋ/T − x/T² would let it, x the penetration, whatever pushes it: a stop of infinite
//! strength that takes the time T to halt, by the exact solution over each step. This is MuJoCo's constraint model for full impedance
//! (solref = (T, 1), solimp → 1); it gives back e⁻² = 14 % of the speed.

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

    /// What this limit, as a lower one, makes of a step from `approach`; `None` where it does not
    /// act. The joint moves no slower than the flow's rate, and follows the flow if it has that rate.
    pub fn as_lower(&self, approach: &Approach<T>) -> Option<LimitFlow<T>> {
        let gap = approach.position - self.position;
        let flow = flow(gap, approach.rate, approach.gained, self.softness_s, approach.step_s)?;
        Some(LimitFlow { rate: flow.rate, position: self.position + flow.position })
    }

    /// The same as an upper limit: the joint moves no faster than the flow's rate.
    pub fn as_upper(&self, approach: &Approach<T>) -> Option<LimitFlow<T>> {
        let gap = self.position - approach.position;
        let flow = flow(gap, -approach.rate, -approach.gained, self.softness_s, approach.step_s)?;
        Some(LimitFlow { rate: -flow.rate, position: self.position - flow.position })
    }
}

/// A joint at the beginning of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Approach<T: Real> {
    /// q \[m or rad\].
    pub position: T,
    /// q̇ \[m/s or rad/s\].
    pub rate: T,
    /// What q̇ gained in the step before \[m/s or rad/s\].
    pub gained: T,
    /// h \[s\].
    pub step_s: f64,
}

/// Where a limit leads the joint by the end of a step.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct LimitFlow<T: Real> {
    /// q̇ \[m/s or rad/s\].
    pub rate: T,
    /// q \[m or rad\].
    pub position: T,
}

/// x(t) = (x₀ + (ẋ₀ + x₀/T) t) e^(−t/T) over the part of the step spent at x ≤ 0.
fn flow<T: Real>(gap: T, rate: T, gained: T, softness_s: f64, step_s: f64) -> Option<LimitFlow<T>> {
    let softness_s = softness_s.max(2.0 * step_s);
    let time_constant = T::constant(softness_s);
    if gap.value() <= 0.0 {
        let ratio = T::constant(step_s / softness_s);
        let decay = T::constant((-step_s / softness_s).exp());
        let pull = rate + gap / time_constant;
        return Some(LimitFlow {
            rate: (rate - pull * ratio) * decay,
            position: (gap + pull * T::constant(step_s)) * decay,
        });
    }
    // Free until contact, with the acceleration of the step before.
    if rate.value() >= 0.0 || gap.value() + step_s * rate.value() >= 0.0 {
        return None;
    }
    let share_free = -gap / (rate * T::constant(step_s));
    let mean_rate = rate + gained * share_free * T::constant(0.5);
    let rate = rate + gained * share_free;
    if rate.value() >= 0.0 || gap.value() + step_s * mean_rate.value() >= 0.0 {
        return None;
    }
    let inside = T::constant(step_s) + gap / mean_rate;
    let ratio = inside / time_constant;
    let decay = (-ratio).exp();
    Some(LimitFlow { rate: rate * (T::one() - ratio) * decay, position: rate * inside * decay })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn approach(position: f64, rate: f64) -> Approach<f64> {
        Approach { position, rate, gained: 0.0, step_s: 1e-3 }
    }

    #[test]
    fn the_flow_is_continuous_where_contact_begins() {
        let limit = Limit::at(0.0);
        let just_outside = limit.as_lower(&approach(1e-12, -0.5)).unwrap();
        let just_inside = limit.as_lower(&approach(-1e-12, -0.5)).unwrap();
        assert!((just_outside.rate - just_inside.rate).abs() < 1e-9);
        assert!((just_outside.position - just_inside.position).abs() < 1e-9);
        let entering_late = limit.as_lower(&approach(0.5e-3 - 1e-12, -0.5)).unwrap();
        assert!((entering_late.rate + 0.5).abs() < 1e-6);
        assert_eq!(limit.as_lower(&approach(0.5e-3 + 1e-12, -0.5)), None);
    }

    #[test]
    fn the_flow_does_not_depend_on_the_step() {
        let limit = Limit { position: 0.2, softness_s: 0.02 };
        let once = limit.as_lower(&Approach { step_s: 2e-3, ..approach(0.199, -0.4) }).unwrap();
        let half = limit.as_lower(&approach(0.199, -0.4)).unwrap();
        let twice = limit.as_lower(&approach(half.position, half.rate)).unwrap();
        assert!((once.rate - twice.rate).abs() < 1e-15);
        assert!((once.position - twice.position).abs() < 1e-15);
    }

    #[test]
    fn upper_mirrors_lower() {
        let limit = Limit { position: 0.3, softness_s: 0.02 };
        let mirror = Limit { position: -0.3, softness_s: 0.02 };
        let upper = limit.as_upper(&approach(0.301, 0.2)).unwrap();
        let lower = mirror.as_lower(&approach(-0.301, -0.2)).unwrap();
        assert_eq!((upper.rate, upper.position), (-lower.rate, -lower.position));
    }
}
