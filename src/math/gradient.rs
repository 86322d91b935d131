//! The check of every derivative: dual numbers against central finite differences.

use num_dual::DualSVec64;

use super::Real;

/// The value and the gradient of `function` at `point`.
pub fn gradient<const N: usize>(
    function: impl Fn(&[DualSVec64<N>; N]) -> DualSVec64<N>,
    point: &[f64; N],
) -> (f64, [f64; N]) {
    let mut argument = point.map(DualSVec64::constant);
    for (i, x) in argument.iter_mut().enumerate() {
        *x = x.derivative(i);
    }
    let result = function(&argument);
    let mut gradient = [0.0; N];
    if let Some(eps) = result.eps.0 {
        gradient.copy_from_slice(eps.as_slice());
    }
    (result.re, gradient)
}

/// Panics unless the gradient of `function` at `point` matches central differences of step
/// `step · max(1, |x|)` to `tolerance · max(1, |derivative|)`.
pub fn assert_gradient<const N: usize>(
    function: impl Fn(&[DualSVec64<N>; N]) -> DualSVec64<N>,
    point: &[f64; N],
    step: f64,
    tolerance: f64,
) {
    let (_, exact) = gradient(&function, point);
    for i in 0..N {
        let step = step * point[i].abs().max(1.0);
        let at = |x: f64| {
            let mut moved = point.map(DualSVec64::constant);
            moved[i] = DualSVec64::constant(x);
            function(&moved).re
        };
        let numeric = (at(point[i] + step) - at(point[i] - step)) / (2.0 * step);
        assert!(
            (exact[i] - numeric).abs() <= tolerance * exact[i].abs().max(1.0),
            "derivative {i}: dual {}, finite difference {numeric}",
            exact[i],
        );
    }
}
