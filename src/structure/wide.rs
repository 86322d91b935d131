//! Non-negative numbers with the precision of `f64` and an exponent that does not run out.
//!
//! Products of edge weights span far more than 1e±308. Their logarithms would do, but a logarithm
//! of size 700 keeps only 13 digits of its number; mantissa and exponent apart keep all 16.

use std::f64::consts::LN_2;
use std::iter::Sum;
use std::ops::{Add, Div, Mul};

/// ln 2 in two parts, the first with 32 trailing zero bits (fdlibm, e_exp.c), so that its product
/// with an exponent below 2^20 is exact.
const LN_2_HIGH: f64 = 6.931_471_803_691_238e-1;
const LN_2_LOW: f64 = 1.908_214_929_270_587_7e-10;

/// Terms 2^120 times smaller than the other cannot be seen in a sum (53 bits).
const NEGLIGIBLE_EXPONENT_GAP: i64 = 120;

/// mantissa · 2^exponent with mantissa ∈ [1, 2), or zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) struct Wide {
    mantissa: f64,
    exponent: i64,
}

impl Wide {
    pub(super) const ZERO: Self = Self { mantissa: 0.0, exponent: 0 };
    pub(super) const ONE: Self = Self { mantissa: 1.0, exponent: 0 };

    /// exp(`logarithm`); −∞ gives zero.
    pub(super) fn exp(logarithm: f64) -> Self {
        if logarithm == f64::NEG_INFINITY {
            return Self::ZERO;
        }
        let exponent = (logarithm / LN_2).floor();
        let rest = (logarithm - exponent * LN_2_HIGH) - exponent * LN_2_LOW;
        Self::normalized(rest.exp(), exponent as i64)
    }

    /// The natural logarithm; −∞ of zero.
    pub(super) fn ln(self) -> f64 {
        if self.is_zero() {
            return f64::NEG_INFINITY;
        }
        self.exponent as f64 * LN_2 + self.mantissa.ln()
    }

    /// The nearest `f64`, zero on underflow and +∞ on overflow.
    pub(super) fn to_f64(self) -> f64 {
        // In two factors, as 2^-1074 · m passes through the subnormals.
        let exponent = self.exponent.clamp(-1200, 1200);
        let half = exponent / 2;
        self.mantissa * power_of_two(half) * power_of_two(exponent - half)
    }

    pub(super) fn is_zero(self) -> bool {
        self.mantissa == 0.0
    }

    /// `mantissa` is zero or within the normal range of `f64`.
    fn normalized(mantissa: f64, exponent: i64) -> Self {
        if mantissa == 0.0 {
            return Self::ZERO;
        }
        let bits = mantissa.to_bits();
        let shift = ((bits >> 52) & 0x7ff) as i64 - 1023;
        let mantissa = f64::from_bits((bits & !(0x7ff << 52)) | (1023 << 52));
        Self { mantissa, exponent: exponent + shift }
    }
}

/// 2^`exponent` for |exponent| ≤ 1022.
fn power_of_two(exponent: i64) -> f64 {
    f64::from_bits(((1023 + exponent) as u64) << 52)
}

impl Add for Wide {
    type Output = Self;

    fn add(self, other: Self) -> Self {
        if self.is_zero() {
            return other;
        }
        if other.is_zero() {
            return self;
        }
        let (large, small) = if self.exponent >= other.exponent { (self, other) } else { (other, self) };
        let gap = large.exponent - small.exponent;
        if gap > NEGLIGIBLE_EXPONENT_GAP {
            return large;
        }
        Self::normalized(large.mantissa + small.mantissa * power_of_two(-gap), large.exponent)
    }
}

impl Mul for Wide {
    type Output = Self;

    fn mul(self, other: Self) -> Self {
        Self::normalized(self.mantissa * other.mantissa, self.exponent + other.exponent)
    }
}

impl Div for Wide {
    type Output = Self;

    /// The divisor must not be zero.
    fn div(self, other: Self) -> Self {
        debug_assert!(!other.is_zero(), "division by zero");
        Self::normalized(self.mantissa / other.mantissa, self.exponent - other.exponent)
    }
}

impl Sum for Wide {
    fn sum<I: Iterator<Item = Self>>(terms: I) -> Self {
        terms.fold(Self::ZERO, Add::add)
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn assert_close(actual: f64, expected: f64) {
        assert!((actual - expected).abs() <= 4e-16 * expected.abs(), "{actual} {expected}");
    }

    proptest! {
        #[test]
        fn arithmetic_agrees_with_f64(a in -300.0..300.0_f64, b in -300.0..300.0_f64) {
            let (x, y) = (Wide::exp(a), Wide::exp(b));
            assert_close(x.to_f64(), a.exp());
            assert_close((x + y).to_f64(), x.to_f64() + y.to_f64());
            assert_close((x * y).to_f64(), x.to_f64() * y.to_f64());
            assert_close((x / y).to_f64(), x.to_f64() / y.to_f64());
            prop_assert!((x.ln() - a).abs() < 1e-13);
        }

        #[test]
        fn products_far_out_of_range_come_back(a in -5000.0..5000.0_f64, b in -300.0..300.0_f64) {
            let there = Wide::exp(a) * Wide::exp(b);
            assert_close((there / Wide::exp(a)).to_f64(), Wide::exp(b).to_f64());
        }
    }

    #[test]
    fn zero_and_the_ends_of_the_range() {
        assert_eq!(Wide::exp(f64::NEG_INFINITY), Wide::ZERO);
        assert_eq!(Wide::ZERO.ln(), f64::NEG_INFINITY);
        assert_eq!((Wide::ZERO + Wide::ONE) * Wide::ONE, Wide::ONE);
        assert_eq!(Wide::exp(-2000.0).to_f64(), 0.0);
        assert_eq!(Wide::exp(2000.0).to_f64(), f64::INFINITY);
        assert_eq!(Wide::exp(-1074.0 * LN_2 + 1e-9).to_f64(), 5e-324);
    }
}
