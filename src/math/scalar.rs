//! The scalar that the mechanism is generic over: `f64`, or a dual number that carries a gradient.

use num_dual::DualSVec64;

/// A real number, possibly with derivatives attached.
///
/// One code path then gives both the value and its forward-mode Jacobian.
pub trait Real: nalgebra::RealField + Copy {
    /// The constant `value`, with zero derivatives.
    fn constant(value: f64) -> Self;
    /// The value without derivatives.
    fn value(self) -> f64;
}

impl Real for f64 {
    fn constant(value: f64) -> Self {
        value
    }
    fn value(self) -> f64 {
        self
    }
}

impl<const N: usize> Real for DualSVec64<N> {
    fn constant(value: f64) -> Self {
        Self::from_re(value)
    }
    fn value(self) -> f64 {
        self.re
    }
}
