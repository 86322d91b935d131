//! Coulomb friction and limits of one joint, by their exact proximal step.
//!
//! The rate v after a step solves a v = b + λ, λ in the friction interval and opposed to v, v within
//! the bounds of the limits: the soft threshold of b, clamped (Moreau 1988; Acary, Brogliato,
//! "Numerical Methods for Nonsmooth Dynamical Systems", 2008). A joint that turns round within the
//! step met friction from both sides in turn. Taking only the last would cost an order of accuracy
//! at every reversal, so its friction is shared by time.

use super::limits::LimitFlow;
use crate::math::Real;

/// The friction force is in [−against_plus, against_minus]: motion in the positive direction meets
/// −against_plus, in the negative one +against_minus, and a stuck joint anything between.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FrictionBounds<T: Real> {
    /// Strength against positive motion \[N or N·m\], ≥ 0.
    pub against_plus: T,
    /// Strength against negative motion \[N or N·m\], ≥ 0.
    pub against_minus: T,
}

impl<T: Real> FrictionBounds<T> {
    /// The same strength in both directions.
    pub fn symmetric(friction: T) -> Self {
        Self { against_plus: friction, against_minus: friction }
    }

    /// The bounds of the same joint with its coordinate reversed.
    pub fn reversed(self) -> Self {
        Self { against_plus: self.against_minus, against_minus: self.against_plus }
    }
}

/// What is left of an impulse after friction: zero where friction suffices.
#[inline]
pub fn soft_threshold<T: Real>(impulse: T, friction: &FrictionBounds<T>) -> T {
    if impulse.value() > friction.against_plus.value() {
        impulse - friction.against_plus
    } else if impulse.value() < -friction.against_minus.value() {
        impulse + friction.against_minus
    } else {
        T::zero()
    }
}

/// One row of the problem beside A and b: impulse bounds of friction, bounds of the rate.
#[derive(Clone, Copy, Debug)]
pub(super) struct Row<T: Real> {
    /// Friction impulses h F \[N·s or N·m·s\].
    pub friction: FrictionBounds<T>,
    /// Where the lower limit acts: l, and where the joint then goes.
    pub least: Option<LimitFlow<T>>,
    /// Where the upper limit acts: u, and where the joint then goes.
    pub greatest: Option<LimitFlow<T>>,
}

impl<T: Real> Row<T> {
    /// The rate after the step of one joint alone, A = `a` and b = `impulse`.
    #[inline]
    pub fn proximal(&self, a: T, impulse: T, before: T) -> T {
        let against_plus = (impulse - self.friction.against_plus) / a;
        let against_minus = (impulse + self.friction.against_minus) / a;
        let rate = if before.value() > 0.0 {
            rate_after_turning(before, against_plus, against_minus)
        } else if before.value() < 0.0 {
            -rate_after_turning(-before, -against_minus, -against_plus)
        } else {
            soft_threshold(impulse, &self.friction) / a
        };
        match (self.least, self.greatest) {
            (Some(least), _) if rate.value() < least.rate.value() => least.rate,
            (_, Some(greatest)) if rate.value() > greatest.rate.value() => greatest.rate,
            _ => rate,
        }
    }

    /// Where the joint goes, if it follows a limit at this rate.
    #[inline]
    pub fn limited_position(&self, rate: T) -> Option<T> {
        let follows = |flow: &LimitFlow<T>| flow.rate.value() == rate.value();
        self.least.filter(follows).or(self.greatest.filter(follows)).map(|flow| flow.position)
    }

    /// The minimum of the one-dimensional problem, on values, with the regime that it is in.
    pub fn proximal_value(&self, a: f64, impulse: f64) -> (f64, Regime) {
        let plus = self.friction.against_plus.value();
        let minus = self.friction.against_minus.value();
        let (rate, regime) = if impulse > plus {
            ((impulse - plus) / a, Regime::SlipsPlus)
        } else if impulse < -minus {
            ((impulse + minus) / a, Regime::SlipsMinus)
        } else {
            (0.0, Regime::Sticks)
        };
        let (least, greatest) = self.range();
        if rate < least {
            (least, Regime::AtLeast)
        } else if rate > greatest {
            (greatest, Regime::AtGreatest)
        } else {
            (rate, regime)
        }
    }

    /// l and u, infinite where no limit acts.
    pub fn range(&self) -> (f64, f64) {
        (
            self.least.map_or(f64::NEG_INFINITY, |flow| flow.rate.value()),
            self.greatest.map_or(f64::INFINITY, |flow| flow.rate.value()),
        )
    }
}

/// The rate of one joint after a step from `before` > 0 that would end at `unturned` under the
/// friction of positive motion, at `turned` under that of negative motion: if it comes to rest on
/// the way, it stays there or turns round, as the other forces have it.
#[inline]
fn rate_after_turning<T: Real>(before: T, unturned: T, turned: T) -> T {
    if unturned.value() >= 0.0 {
        unturned
    } else if turned.value() < before.value() {
        turned - share_before_turning(before, unturned) * (turned - unturned)
    } else {
        T::zero()
    }
}

/// The share of a step before a joint comes to rest that would have gone from the rate `before` to
/// `unturned`, of the other sign, had friction not changed direction.
#[inline]
pub(super) fn share_before_turning<T: Real>(before: T, unturned: T) -> T {
    before / (before - unturned)
}

/// Which piece of the set-valued law a joint is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Regime {
    SlipsPlus,
    SlipsMinus,
    Sticks,
    AtLeast,
    AtGreatest,
}

impl Regime {
    /// The slip opposed to a rate; sticking, for none.
    pub fn turned_from(before: f64) -> Self {
        if before > 0.0 {
            Self::SlipsMinus
        } else if before < 0.0 {
            Self::SlipsPlus
        } else {
            Self::Sticks
        }
    }

    pub fn reversed(self) -> Self {
        match self {
            Self::SlipsPlus => Self::SlipsMinus,
            Self::SlipsMinus => Self::SlipsPlus,
            other => other,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn friction_takes_what_it_can() {
        let friction = FrictionBounds { against_plus: 2.0, against_minus: 1.0 };
        assert_eq!(soft_threshold(1.9, &friction), 0.0);
        assert_eq!(soft_threshold(2.5, &friction), 0.5);
        assert_eq!(soft_threshold(-1.5, &friction), -0.5);
        assert_eq!(soft_threshold(-1.5, &friction.reversed()), 0.0);
    }
}
