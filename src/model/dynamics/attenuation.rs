//! What the wrench sensor's noise pretends of inertia and damping.
//!
//! Readings drive the simulation as they are, so that innovations and their derivatives hold the same noise: what
//! moved the state by w moved its derivative by a number of the mass matrix by − M⁻¹ ∂M w, and what the rates are
//! off by, ε, moved that by − M⁻¹ (∂D − ∂M M⁻¹ D) ε a second, D the damping. Least squares takes what the two share
//! for too much inertia and damping (errors in variables; Carroll, Ruppert, Stefanski, Crainiceanu, "Measurement
//! Error in Nonlinear Models", 2006, chapter 3), by half on a light lever. How much that is on average follows from
//! the filter: with C the covariance of − the derivative's noise with the state's, Σ tr(S⁻¹ H C Hᵀ) over the
//! observations is missing from the gradient.

use nalgebra::{DMatrix, DVector};

use super::innovations::{Advance, Gain, Passed, WindowModel, gathered};
use super::layout::{CENTER, DAMPING, INERTIA, MASS};
use crate::inference::{Failure, Gaussian, Linearization};
use crate::mechanism::{Tree, Workspace};

/// Of no direction is more than this share of what the innovations say taken for noise.
const MOST: f64 = 0.8;
/// A number is moved by this at most.
const FARTHEST: f64 = 0.7;
/// Step of a difference by a number.
const DIFFERENCE: f64 = 1e-6;

/// What innovations and their derivatives have in common of the readings' noise.
#[derive(Clone, Debug)]
pub(super) struct SharedNoise {
    /// What the gradient of the cost lacks for it.
    gradient: DVector<f64>,
    /// What the curvature has too much.
    information: DMatrix<f64>,
}

/// The noise of the tool's readings between two observations, of `n` moving joints.
pub(super) struct SensedNoise {
    /// Positions of all joints.
    pub(super) positions: Vec<f64>,
    /// Density of the generalized force, `n` × `n` \[N² s or (N·m)² s\].
    pub(super) density: DMatrix<f64>,
    /// Time in between \[s\].
    pub(super) span_s: f64,
    /// Which of the moving joints do not stick.
    pub(super) free: Vec<usize>,
}

impl SharedNoise {
    /// That of a window, by the `active` entries of `x`.
    pub(super) fn of(
        passed: &[Passed],
        model: &WindowModel<'_>,
        (x, active): (&[f64], &[usize]),
    ) -> Result<Self, Failure> {
        let n = model.moving.len();
        let Some(size) = passed.first().map(|first| first.rows.ncols()) else { return Ok(Self::none(active.len())) };
        let numbers = Numbers::new(model, x, active)?;
        let p = numbers.places.len();
        let mut covariance = DMatrix::zeros(size, size);
        let mut shared = vec![DMatrix::zeros(size, size); p];
        let mut result = Self::none(active.len());
        for Passed { advance, rows, gain: Gain { gain, deviation } } in passed {
            let seen = deviation.solve_lower_triangular(rows).ok_or(Failure::Diverged)?;
            if let Some(Advance { transition, sensed, .. }) = advance {
                let by_rate = covariance.rows(n, n) * transition.transpose();
                covariance = transition * covariance * transition.transpose();
                let noise = numbers.noise(sensed, model)?;
                let mut own = covariance.view_mut((0, 0), (2 * n, 2 * n));
                own += &noise.gathered;
                let weight = seen.columns(0, n).transpose() * seen.columns(0, n);
                let spread = covariance.view((0, 0), (n, n)).into_owned();
                for (i, shared) in shared.iter_mut().enumerate() {
                    *shared = transition * &*shared * transition.transpose();
                    for (half, share) in [0.5 * sensed.span_s.powi(2), sensed.span_s].into_iter().enumerate() {
                        let mut rows = shared.rows_mut(half * n, n);
                        rows += &noise.by_rate[i] * &by_rate * share;
                        let mut own = rows.columns_mut(0, 2 * n);
                        own += &noise.by_force[i] * noise.gathered.rows(half * n, n);
                    }
                    for (j, other) in noise.by_force.iter().enumerate() {
                        let both = &weight * &noise.by_force[i] * &spread * other.transpose();
                        result.information[(numbers.places[i], numbers.places[j])] += both.trace();
                    }
                }
            }
            for (&place, shared) in numbers.places.iter().zip(&shared) {
                result.gradient[place] += (&seen * shared * seen.transpose()).trace();
            }
            let left = DMatrix::identity(size, size) - gain * rows;
            let step = |of: &DMatrix<f64>| &left * of * left.transpose();
            covariance = step(&covariance);
            shared.iter_mut().for_each(|shared| *shared = step(shared));
        }
        Ok(result)
    }

    fn none(numbers: usize) -> Self {
        Self { gradient: DVector::zeros(numbers), information: DMatrix::zeros(numbers, numbers) }
    }

    /// Takes it out of a linearization, and says by how much the cost grows with each number for it. Where that would
    /// move a number, with the `prior`, by more than [`FARTHEST`], the linearization says nothing of how far.
    pub(super) fn take_out(
        &self,
        linearization: &mut Linearization,
        prior: &Gaussian,
    ) -> Result<DVector<f64>, Failure> {
        let mut share = self.bounded_share(&linearization.curvature)?;
        let left = &linearization.curvature - &self.information * share + &prior.precision;
        let moved = left.cholesky().ok_or(Failure::Singular)?.solve(&(&self.gradient * share));
        share *= (FARTHEST / moved.amax().max(FARTHEST)).min(1.0);
        let gradient = &self.gradient * share;
        linearization.gradient += &gradient;
        linearization.curvature -= &self.information * share;
        Ok(gradient)
    }

    /// The share that leaves of the `curvature` at least 1 − [`MOST`] in every direction.
    fn bounded_share(&self, curvature: &DMatrix<f64>) -> Result<f64, Failure> {
        let p = curvature.nrows();
        let ridge = 1e-9 * curvature.diagonal().max() + 1e-12;
        let whole = curvature + DMatrix::identity(p, p) * ridge;
        let factor = whole.cholesky().ok_or(Failure::Singular)?.unpack();
        let half = factor.solve_lower_triangular(&self.information).ok_or(Failure::Singular)?;
        let relative = factor.solve_lower_triangular(&half.transpose()).ok_or(Failure::Singular)?;
        let most = ((&relative + relative.transpose()) * 0.5).symmetric_eigenvalues().max();
        Ok((MOST / most.max(MOST)).min(1.0))
    }
}

/// The numbers whose derivatives hold the noise.
struct Numbers {
    tree: Tree<f64>,
    /// Damping of the moving joints \[N·s/m or N·m·s/rad\].
    damping: DVector<f64>,
    /// Their places among the active entries, and what each is.
    places: Vec<usize>,
    kinds: Vec<Number>,
}

enum Number {
    /// The tree with it moved by [`DIFFERENCE`].
    OfMass(Tree<f64>),
    /// ln damping of one of the moving joints.
    Damping(usize),
}

/// A span's noise, by number where a list.
struct Noise {
    /// Covariance that (q, q̇) gather.
    gathered: DMatrix<f64>,
    /// M⁻¹ ∂M.
    by_force: Vec<DMatrix<f64>>,
    /// M⁻¹ (∂D − ∂M M⁻¹ D).
    by_rate: Vec<DMatrix<f64>>,
}

impl Numbers {
    fn new(model: &WindowModel<'_>, x: &[f64], active: &[usize]) -> Result<Self, Failure> {
        let mechanism = model.mechanism;
        let tree = |x: &[f64]| mechanism.tree(x, model.axes, model.frozen);
        let n = model.moving.len();
        let mut result = Self { tree: tree(x)?, damping: DVector::zeros(n), places: Vec::new(), kinds: Vec::new() };
        for (place, &at) in active.iter().enumerate() {
            let is = |joint: usize, entry: usize| mechanism.offset(joint) + entry == at;
            let damped = model.moving.iter().position(|&joint| is(joint, DAMPING));
            let of_mass = |joint| [INERTIA, MASS, CENTER, CENTER + 1].iter().any(|&entry| is(joint, entry));
            if let Some(i) = damped {
                result.damping[i] = x[at].exp();
                result.kinds.push(Number::Damping(i));
            } else if (0..mechanism.joints.len()).any(of_mass) {
                let mut moved = x.to_vec();
                moved[at] += DIFFERENCE;
                result.kinds.push(Number::OfMass(tree(&moved)?));
            } else {
                continue;
            }
            result.places.push(place);
        }
        Ok(result)
    }

    /// The noise over a span; joints that stick have none.
    fn noise(&self, sensed: &SensedNoise, model: &WindowModel<'_>) -> Result<Noise, Failure> {
        let n = model.moving.len();
        let SensedNoise { positions, density, span_s, free } = sensed;
        let none = || DMatrix::zeros(n, n);
        if free.is_empty() {
            let all = || self.kinds.iter().map(|_| none()).collect();
            return Ok(Noise { gathered: DMatrix::zeros(2 * n, 2 * n), by_force: all(), by_rate: all() });
        }
        let mass = |tree: &Tree<f64>| {
            let (_, mass) = tree.screws_and_mass_matrix(positions, &mut Workspace::new(tree));
            let joint = |i: usize| model.moving[free[i]];
            DMatrix::from_fn(free.len(), free.len(), |i, j| mass[(joint(i), joint(j))])
        };
        let of_all = |of_free: &DMatrix<f64>| {
            let mut all = none();
            for (i, &row) in free.iter().enumerate() {
                for (j, &column) in free.iter().enumerate() {
                    all[(row, column)] = of_free[(i, j)];
                }
            }
            all
        };
        let here = mass(&self.tree);
        let inverse = here.clone().cholesky().ok_or(Failure::Diverged)?.inverse();
        let sensed = inverse.clone() * density.select_rows(free).select_columns(free) * &inverse;
        let inverse_of_all = of_all(&inverse);
        let damping = DMatrix::from_diagonal(&self.damping);
        let (mut by_force, mut by_rate) = (Vec::new(), Vec::new());
        for kind in &self.kinds {
            let (force, rate) = match kind {
                Number::OfMass(moved) => {
                    let force = of_all(&(&inverse * (mass(moved) - &here) / DIFFERENCE));
                    let rate = -(&force * &inverse_of_all * &damping);
                    (force, rate)
                }
                &Number::Damping(i) => {
                    let mut rate = none();
                    rate.set_column(i, &(inverse_of_all.column(i) * self.damping[i]));
                    (none(), rate)
                }
            };
            by_force.push(force);
            by_rate.push(rate);
        }
        Ok(Noise { gathered: gathered(&of_all(&sensed), *span_s), by_force, by_rate })
    }
}
