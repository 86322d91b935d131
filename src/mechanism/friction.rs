//! Coulomb friction and limits by their exact proximal step.
//!
//! The rates v after a step solve A v = b + λ with λ_j in the friction interval, opposed to the
//! motion, and v_j within its bounds. They are the minimum of the strictly convex
//!
//! ½ vᵀ A v − bᵀ v + Σ_j (f⁺_j max(v_j, 0) + f⁻_j max(−v_j, 0)),  l_j ≤ v_j ≤ u_j
//!
//! (Moreau 1988; Acary, Brogliato, "Numerical Methods for Nonsmooth Dynamical Systems", 2008).
//! Gauss–Seidel sweeps on values find which joints stick, slip or rest on a limit; the linear system
//! of the slipping joints is then solved exactly, with its derivatives.

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
    /// l, the least rate, if bounded.
    pub least: Option<T>,
    /// u, the greatest rate, if bounded.
    pub greatest: Option<T>,
}

impl<T: Real> Row<T> {
    /// The minimum of the one-dimensional problem with A = `a`, b = `impulse`.
    #[inline]
    pub fn proximal(&self, a: T, impulse: T) -> T {
        let rate = soft_threshold(impulse, &self.friction) / a;
        match (self.least, self.greatest) {
            (Some(least), _) if rate.value() < least.value() => least,
            (_, Some(greatest)) if rate.value() > greatest.value() => greatest,
            _ => rate,
        }
    }

    /// The same on values, with the regime that the minimum is in.
    fn proximal_value(&self, a: f64, impulse: f64) -> (f64, Regime) {
        let plus = self.friction.against_plus.value();
        let minus = self.friction.against_minus.value();
        let (rate, regime) = if impulse > plus {
            ((impulse - plus) / a, Regime::SlipsPlus)
        } else if impulse < -minus {
            ((impulse + minus) / a, Regime::SlipsMinus)
        } else {
            (0.0, Regime::Sticks)
        };
        match (self.least, self.greatest) {
            (Some(least), _) if rate < least.value() => (least.value(), Regime::AtLeast),
            (_, Some(greatest)) if rate > greatest.value() => (greatest.value(), Regime::AtGreatest),
            _ => (rate, regime),
        }
    }
}

/// Which piece of the set-valued law a joint is on.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Regime {
    SlipsPlus,
    SlipsMinus,
    Sticks,
    AtLeast,
    AtGreatest,
}

/// Scratch of [`solve`], reused between steps.
#[derive(Clone, Debug)]
pub(super) struct SolveScratch<T: Real> {
    regimes: Vec<Regime>,
    values: Vec<f64>,
    slipping: Vec<usize>,
    factor: Vec<T>,
    right: Vec<T>,
}

impl<T: Real> SolveScratch<T> {
    pub fn new(n: usize) -> Self {
        Self {
            regimes: Vec::with_capacity(n),
            values: vec![0.0; n],
            slipping: Vec::with_capacity(n),
            factor: vec![T::zero(); n * n],
            right: vec![T::zero(); n],
        }
    }
}

/// Rounds of sweeps and exact solve before the last guess is taken. Random problems of six joints
/// need at most 4 (test `many_joints_meet_the_law`).
const ROUNDS_MAX: usize = 40;
/// Gauss–Seidel sweeps in the first round; each round makes that many more than the one before.
const SWEEPS: usize = 4;
/// A proximal residual below this share of the impulses at play is rounding.
const ROUNDING: f64 = 1e-13;

/// Solves for the rates in place; on entry `rates` are those before the step, which only start the
/// search. `a` is symmetric positive definite, row by row.
pub(super) fn solve<T: Real>(
    a: &[T],
    b: &[T],
    rows: &[Row<T>],
    rates: &mut [T],
    scratch: &mut SolveScratch<T>,
) {
    let n = rows.len();
    if n == 1 {
        rates[0] = rows[0].proximal(a[0], b[0]);
        return;
    }
    scratch.regimes.clear();
    scratch.regimes.extend(rows.iter().zip(&*rates).map(|(row, rate)| guess(row, rate.value())));
    for round in 0..ROUNDS_MAX {
        solve_regimes(a, b, rows, rates, scratch);
        for (value, rate) in scratch.values.iter_mut().zip(&*rates) {
            *value = rate.value();
        }
        if is_settled(a, b, rows, scratch) {
            return;
        }
        for _ in 0..SWEEPS * (round + 1) {
            for j in 0..n {
                let (impulse, _) = impulse_on(j, n, a, b, &scratch.values);
                let (value, regime) = rows[j].proximal_value(a[j * n + j].value(), impulse);
                scratch.values[j] = value;
                scratch.regimes[j] = regime;
            }
        }
    }
    solve_regimes(a, b, rows, rates, scratch);
}

/// Joints go on as they did: most steps need no search.
fn guess<T: Real>(row: &Row<T>, rate: f64) -> Regime {
    match (row.least, row.greatest) {
        (Some(least), _) if rate <= least.value() => Regime::AtLeast,
        (_, Some(greatest)) if rate >= greatest.value() => Regime::AtGreatest,
        _ if rate > 0.0 => Regime::SlipsPlus,
        _ if rate < 0.0 => Regime::SlipsMinus,
        _ => Regime::Sticks,
    }
}

/// b_j − Σ_{k ≠ j} A_jk v_k and the size of its terms.
fn impulse_on<T: Real>(j: usize, n: usize, a: &[T], b: &[T], values: &[f64]) -> (f64, f64) {
    let mut impulse = b[j].value();
    let mut size = impulse.abs();
    for k in (0..n).filter(|&k| k != j) {
        let term = a[j * n + k].value() * values[k];
        impulse -= term;
        size += term.abs();
    }
    (impulse, size)
}

/// Whether every joint's rate is what its own law gives under all the others.
fn is_settled<T: Real>(a: &[T], b: &[T], rows: &[Row<T>], scratch: &SolveScratch<T>) -> bool {
    let n = rows.len();
    (0..n).all(|j| {
        let diagonal = a[j * n + j].value();
        let (impulse, size) = impulse_on(j, n, a, b, &scratch.values);
        let (value, regime) = rows[j].proximal_value(diagonal, impulse);
        regime == scratch.regimes[j]
            || (value - scratch.values[j]).abs() * diagonal <= ROUNDING * size
    })
}

/// The rates if the regimes are right: fixed for stuck and limited joints, linear for the others.
fn solve_regimes<T: Real>(
    a: &[T],
    b: &[T],
    rows: &[Row<T>],
    rates: &mut [T],
    scratch: &mut SolveScratch<T>,
) {
    let n = rows.len();
    let SolveScratch { regimes, slipping, factor, right, .. } = scratch;
    slipping.clear();
    for j in 0..n {
        rates[j] = match regimes[j] {
            Regime::SlipsPlus | Regime::SlipsMinus => {
                slipping.push(j);
                T::zero()
            }
            Regime::Sticks => T::zero(),
            Regime::AtLeast => rows[j].least.unwrap_or_else(T::zero),
            Regime::AtGreatest => rows[j].greatest.unwrap_or_else(T::zero),
        };
    }
    let m = slipping.len();
    for (i, &j) in slipping.iter().enumerate() {
        let friction = match regimes[j] {
            Regime::SlipsPlus => -rows[j].friction.against_plus,
            _ => rows[j].friction.against_minus,
        };
        right[i] = b[j] + friction;
        for k in (0..n).filter(|&k| matches!(regimes[k], Regime::AtLeast | Regime::AtGreatest)) {
            right[i] -= a[j * n + k] * rates[k];
        }
        for (l, &k) in slipping.iter().enumerate().take(i + 1) {
            factor[i * m + l] = a[j * n + k];
        }
    }
    solve_symmetric(factor, right, m);
    for (i, &j) in slipping.iter().enumerate() {
        rates[j] = right[i];
    }
}

/// Solves G x = r in place by L D Lᵀ; the lower triangle of G, row by row, is overwritten.
fn solve_symmetric<T: Real>(g: &mut [T], r: &mut [T], n: usize) {
    for i in 0..n {
        for j in 0..i {
            let mut sum = g[i * n + j];
            for k in 0..j {
                sum -= g[i * n + k] * g[j * n + k] * g[k * n + k];
            }
            g[i * n + j] = sum / g[j * n + j];
        }
        let mut pivot = g[i * n + i];
        for k in 0..i {
            pivot -= g[i * n + k] * g[i * n + k] * g[k * n + k];
        }
        g[i * n + i] = pivot;
    }
    for i in 0..n {
        for k in 0..i {
            let term = g[i * n + k] * r[k];
            r[i] -= term;
        }
    }
    for i in (0..n).rev() {
        r[i] /= g[i * n + i];
        for k in i + 1..n {
            let term = g[k * n + i] * r[k];
            r[i] -= term;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::DMatrix;
    use proptest::prelude::*;

    fn row(friction: f64, least: Option<f64>, greatest: Option<f64>) -> Row<f64> {
        Row { friction: FrictionBounds::symmetric(friction), least, greatest }
    }

    proptest! {
        #[test]
        fn many_joints_meet_the_law(
            n in 1_usize..=6,
            entries in prop::collection::vec(-1.0..1.0_f64, 36),
            b in prop::collection::vec(-3.0..3.0_f64, 6),
            friction in prop::collection::vec(0.0..2.0_f64, 6),
            start in prop::collection::vec(-1.0..1.0_f64, 6),
            limited in prop::collection::vec(any::<bool>(), 6),
        ) {
            let square = DMatrix::from_fn(n, n, |i, j| entries[6 * i + j]);
            let a = &square * square.transpose() + DMatrix::identity(n, n) * 1e-3;
            let rows: Vec<_> = (0..n)
                .map(|j| row(friction[j], limited[j].then_some(-0.2), limited[5 - j].then_some(0.3)))
                .collect();
            let mut rates = start[..n].to_vec();
            let mut scratch = SolveScratch::new(n);
            solve(a.as_slice(), &b[..n], &rows, &mut rates, &mut scratch);
            for j in 0..n {
                let (impulse, size) = impulse_on(j, n, a.as_slice(), &b, &rates);
                let wanted = rows[j].proximal(a[(j, j)], impulse);
                prop_assert!(((wanted - rates[j]) * a[(j, j)]).abs() <= 1e-12 * (1.0 + size));
            }
        }
    }

    #[test]
    fn friction_takes_what_it_can() {
        let friction = FrictionBounds { against_plus: 2.0, against_minus: 1.0 };
        assert_eq!(soft_threshold(1.9, &friction), 0.0);
        assert_eq!(soft_threshold(2.5, &friction), 0.5);
        assert_eq!(soft_threshold(-1.5, &friction), -0.5);
        assert_eq!(soft_threshold(-1.5, &friction.reversed()), 0.0);
    }

    #[test]
    fn a_stuck_joint_holds_still_exactly() {
        let a = [2.0, 0.7, 0.7, 1.0];
        let mut rates = [0.0, 0.1];
        let rows = [row(5.0, None, None), row(0.1, None, None)];
        solve(&a, &[0.5, 1.0], &rows, &mut rates, &mut SolveScratch::new(2));
        assert_eq!(rates[0], 0.0);
        assert!((rates[1] - 0.9).abs() < 1e-15);
    }
}
