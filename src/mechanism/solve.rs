//! Friction and limits of several joints coupled by their inertia.
//!
//! The rates v after a step solve A v = b + λ, each joint under its own set-valued law: the minimum
//! of the strictly convex
//!
//! ½ vᵀ A v − bᵀ v + Σ_j (f⁺_j max(v_j, 0) + f⁻_j max(−v_j, 0)),  l_j ≤ v_j ≤ u_j
//!
//! (Moreau 1988; Acary, Brogliato, "Numerical Methods for Nonsmooth Dynamical Systems", 2008).
//! Gauss–Seidel sweeps on values, and Newton steps cut short where a joint would change its regime,
//! find which joints stick, slip or rest on a limit: each lowers the objective, so they end. The
//! linear system of the slipping joints is then solved exactly, with its derivatives.

use super::friction::{FrictionBounds, Regime, Row, share_before_turning};
use crate::math::Real;

/// Scratch of [`solve`], reused between steps.
#[derive(Clone, Debug)]
pub(super) struct SolveScratch<T: Real> {
    regimes: Vec<Regime>,
    values: Vec<f64>,
    before: Vec<T>,
    slipping: Vec<usize>,
    factor: Vec<T>,
    right: Vec<T>,
    /// Whether a joint turned round.
    turned: bool,
}

impl<T: Real> SolveScratch<T> {
    pub fn new(n: usize) -> Self {
        Self {
            regimes: Vec::with_capacity(n),
            values: vec![0.0; n],
            before: Vec::with_capacity(n),
            slipping: Vec::with_capacity(n),
            factor: vec![T::zero(); n * n],
            right: vec![T::zero(); n],
            turned: false,
        }
    }
}

impl<T: Real> SolveScratch<T> {
    /// Whether the rates were the linear solution for several joints that slip, stick, or both.
    pub fn is_regular(&self) -> bool {
        let limited = |regime: &Regime| matches!(regime, Regime::AtLeast | Regime::AtGreatest);
        !self.regimes.is_empty() && !self.turned && !self.regimes.iter().any(limited)
    }

    /// What each joint did.
    pub fn regimes(&self) -> &[Regime] {
        &self.regimes
    }

    /// Derivatives of the rates, in place, from those of the impulses, after a regular step.
    pub fn carry(&self, impulses: &mut [T]) {
        let m = self.slipping.len();
        // They are in ascending order: those that slip move up to the front, and back again.
        for (i, &j) in self.slipping.iter().enumerate() {
            impulses[i] = impulses[j];
        }
        substitute(&self.factor, impulses, m);
        impulses[m..].fill(T::zero());
        for (i, &j) in self.slipping.iter().enumerate().rev() {
            impulses.swap(i, j);
        }
    }
}

/// Rounds of sweeps and Newton step before the last guess is taken; enough for random problems of
/// six joints and condition number 10⁴ (test `many_joints_meet_the_law`).
const ROUNDS_MAX: usize = 100;
/// Gauss–Seidel sweeps in a round.
const SWEEPS: usize = 4;
/// A proximal residual below this share of the impulses at play is rounding.
const ROUNDING: f64 = 1e-13;

/// Solves for the rates in place; on entry `rates` are those before the step. `a` is symmetric
/// positive definite, row by row. `rows` are used up.
pub(super) fn solve<T: Real>(a: &[T], b: &[T], rows: &mut [Row<T>], rates: &mut [T], scratch: &mut SolveScratch<T>) {
    if let [row] = rows {
        rates[0] = row.proximal(a[0], b[0], rates[0]);
        return;
    }
    scratch.before.clear();
    scratch.before.extend_from_slice(rates);
    scratch.turned = false;
    find_regimes(a, b, rows, rates, scratch);
    share_friction_of_turning(a, b, rows, rates, scratch);
}

fn find_regimes<T: Real>(a: &[T], b: &[T], rows: &[Row<T>], rates: &mut [T], scratch: &mut SolveScratch<T>) {
    let n = rows.len();
    // Joints go on as they did: most steps need no search.
    scratch.regimes.clear();
    scratch.regimes.extend(rows.iter().zip(&*rates).map(|(row, rate)| guess(row, rate.value())));
    solve_regimes(a, b, rows, rates, scratch);
    if is_settled(a, b, rows, rates, scratch) {
        return;
    }
    for ((value, before), row) in scratch.values.iter_mut().zip(&scratch.before).zip(rows) {
        let (least, greatest) = row.range();
        *value = before.value().max(least).min(greatest);
    }
    for _ in 0..ROUNDS_MAX {
        for j in (0..SWEEPS).flat_map(|_| 0..n) {
            let (impulse, _) = impulse_on(j, n, a, b, |k| scratch.values[k]);
            let (value, regime) = rows[j].proximal_value(a[j * n + j].value(), impulse);
            scratch.values[j] = value;
            scratch.regimes[j] = regime;
        }
        solve_regimes(a, b, rows, rates, scratch);
        if is_settled(a, b, rows, rates, scratch) {
            return;
        }
        go_towards(rows, rates, scratch);
    }
}

/// Moves the values towards the solution of the present regimes, as far as all stay in theirs.
fn go_towards<T: Real>(rows: &[Row<T>], target: &[T], scratch: &mut SolveScratch<T>) {
    let SolveScratch { regimes, values, .. } = scratch;
    let mut share = 1.0;
    let mut blocked = None;
    for (j, row) in rows.iter().enumerate() {
        let (least, greatest) = row.range();
        let (low, high) = match regimes[j] {
            Regime::SlipsPlus => (least.max(0.0), greatest),
            Regime::SlipsMinus => (least, greatest.min(0.0)),
            _ => continue,
        };
        let (from, to) = (values[j], target[j].value());
        let edge = if to < low {
            low
        } else if to > high {
            high
        } else {
            continue;
        };
        let here = (edge - from) / (to - from);
        if here < share {
            share = here.max(0.0);
            blocked = Some((j, edge));
        }
    }
    for (value, target) in values.iter_mut().zip(target) {
        *value += share * (target.value() - *value);
    }
    if let Some((j, edge)) = blocked {
        values[j] = edge;
    }
}

/// For joints that turn round: friction of either direction, each for its share of the step. A
/// joint that sticks at the end of a step that it began in motion may have turned round as well.
fn share_friction_of_turning<T: Real>(
    a: &[T],
    b: &[T],
    rows: &mut [Row<T>],
    rates: &mut [T],
    scratch: &mut SolveScratch<T>,
) {
    let n = rows.len();
    let arrives =
        |j: usize, scratch: &SolveScratch<T>| scratch.regimes[j] == Regime::Sticks && scratch.before[j].value() != 0.0;
    let turns = |j: usize, scratch: &SolveScratch<T>| {
        scratch.before[j].value() != 0.0 && scratch.regimes[j] == Regime::turned_from(scratch.before[j].value())
    };
    let mut any_turns = (0..n).any(|j| turns(j, scratch));
    if (0..n).any(|j| arrives(j, scratch)) {
        for j in 0..n {
            if arrives(j, scratch) {
                scratch.regimes[j] = Regime::turned_from(scratch.before[j].value());
                solve_regimes(a, b, rows, rates, scratch);
                let before = scratch.before[j].value();
                if (rates[j].value() - before) * before < 0.0 {
                    any_turns = true;
                } else {
                    scratch.regimes[j] = Regime::Sticks;
                }
            }
        }
        solve_regimes(a, b, rows, rates, scratch);
    }
    if !any_turns {
        return;
    }
    scratch.turned = true;
    for j in 0..n {
        if turns(j, scratch) {
            scratch.regimes[j] = scratch.regimes[j].reversed();
        }
    }
    solve_regimes(a, b, rows, rates, scratch);
    for j in 0..n {
        let before = scratch.before[j];
        if matches!(scratch.regimes[j], Regime::SlipsPlus | Regime::SlipsMinus)
            && rates[j].value() * before.value() < 0.0
        {
            let share = share_before_turning(before, rates[j]);
            let FrictionBounds { against_plus, against_minus } = rows[j].friction;
            let sum = (against_plus + against_minus) * share;
            rows[j].friction = FrictionBounds { against_plus: against_plus - sum, against_minus: against_minus - sum };
            scratch.regimes[j] = scratch.regimes[j].reversed();
        }
    }
    solve_regimes(a, b, rows, rates, scratch);
}

fn guess<T: Real>(row: &Row<T>, rate: f64) -> Regime {
    let (least, greatest) = row.range();
    if rate <= least {
        Regime::AtLeast
    } else if rate >= greatest {
        Regime::AtGreatest
    } else if rate > 0.0 {
        Regime::SlipsPlus
    } else if rate < 0.0 {
        Regime::SlipsMinus
    } else {
        Regime::Sticks
    }
}

/// b_j − Σ_{k ≠ j} A_jk v_k and the size of its terms.
fn impulse_on<T: Real>(j: usize, n: usize, a: &[T], b: &[T], rate: impl Fn(usize) -> f64) -> (f64, f64) {
    let mut impulse = b[j].value();
    let mut size = impulse.abs();
    for k in (0..n).filter(|&k| k != j) {
        let term = a[j * n + k].value() * rate(k);
        impulse -= term;
        size += term.abs();
    }
    (impulse, size)
}

/// Whether every joint's rate is what its own law gives under all the others.
fn is_settled<T: Real>(a: &[T], b: &[T], rows: &[Row<T>], rates: &[T], scratch: &SolveScratch<T>) -> bool {
    let n = rows.len();
    (0..n).all(|j| {
        let diagonal = a[j * n + j].value();
        let (impulse, size) = impulse_on(j, n, a, b, |k| rates[k].value());
        let (value, regime) = rows[j].proximal_value(diagonal, impulse);
        regime == scratch.regimes[j] || (value - rates[j].value()).abs() * diagonal <= ROUNDING * size
    })
}

/// The rates if the regimes are right: fixed for stuck and limited joints, linear for the others.
fn solve_regimes<T: Real>(a: &[T], b: &[T], rows: &[Row<T>], rates: &mut [T], scratch: &mut SolveScratch<T>) {
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
            Regime::AtLeast => rows[j].least.map_or_else(T::zero, |flow| flow.rate),
            Regime::AtGreatest => rows[j].greatest.map_or_else(T::zero, |flow| flow.rate),
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
    substitute(g, r, n);
}

/// Solves L D Lᵀ x = r in place.
fn substitute<T: Real>(g: &[T], r: &mut [T], n: usize) {
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
    use super::super::limits::LimitFlow;
    use super::*;
    use nalgebra::DMatrix;
    use proptest::prelude::*;

    fn row(friction: f64, least: Option<f64>, greatest: Option<f64>) -> Row<f64> {
        let flow = |rate| LimitFlow { rate, position: 0.0 };
        Row { friction: FrictionBounds::symmetric(friction), least: least.map(flow), greatest: greatest.map(flow) }
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
            scratch.before.extend_from_slice(&rates);
            find_regimes(a.as_slice(), &b[..n], &rows, &mut rates, &mut scratch);
            for j in 0..n {
                let (impulse, size) = impulse_on(j, n, a.as_slice(), &b, |k| rates[k]);
                let (wanted, _) = rows[j].proximal_value(a[(j, j)], impulse);
                prop_assert!(((wanted - rates[j]) * a[(j, j)]).abs() <= 1e-12 * (1.0 + size));
            }
        }
    }

    #[test]
    fn a_stuck_joint_holds_still_exactly() {
        let a = [2.0, 0.7, 0.7, 1.0];
        let mut rates = [0.0, 0.1];
        let mut rows = [row(5.0, None, None), row(0.1, None, None)];
        solve(&a, &[0.5, 1.0], &mut rows, &mut rates, &mut SolveScratch::new(2));
        assert_eq!(rates[0], 0.0);
        assert!((rates[1] - 0.9).abs() < 1e-15);
    }
    #[test]
    fn turning_round_splits_the_step_at_rest() {
        // Mass 2, pushed with −6 against friction 1: from .005 to rest at −3.5, then on at −2.5.
        let exact = -2.5 * (0.01 - 0.005 / 3.5);
        let alone = row(0.01, None, None).proximal(2.0, 2.0 * 0.005 - 0.06, 0.005);
        assert!((alone - exact).abs() < 1e-15);
        let mut rates = [0.005, 0.0];
        let mut rows = [row(0.01, None, None), row(0.0, None, None)];
        let a = [2.0, 0.0, 0.0, 1.0];
        solve(&a, &[2.0 * 0.005 - 0.06, 0.0], &mut rows, &mut rates, &mut SolveScratch::new(2));
        assert!((rates[0] - exact).abs() < 1e-15);
    }
}
