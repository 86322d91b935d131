//! Maximum of a nonlinear least-squares log density under a Gaussian prior.
//!
//! Gauss–Newton with Levenberg–Marquardt damping in the prior's own scales: minimizes
//! ½ |r(x)|² + ½ (x − m)ᵀ Λ (x − m). The Laplace log evidence is −cost − ½ ln |H| + ½ ln |Λ|.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::gaussian::Gaussian;

/// Why an inference gave no result.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error, Serialize, Deserialize)]
pub enum Failure {
    /// The model gives no finite prediction here.
    #[error("the model diverges")]
    Diverged,
    /// A matrix that should be positive definite is not.
    #[error("singular information")]
    Singular,
    /// Nothing was observed.
    #[error("no information")]
    NoInformation,
}

/// The log density near a point.
#[derive(Clone, Debug, PartialEq)]
pub struct Linearization {
    /// ½ |r|².
    pub cost: f64,
    /// Jᵀ r.
    pub gradient: DVector<f64>,
    /// Jᵀ J.
    pub curvature: DMatrix<f64>,
}

/// A log density −½ |r(x)|².
pub trait LeastSquares {
    /// Value and derivatives; may fix weights that [`Self::cost`] then uses.
    fn linearize(&mut self, x: &DVector<f64>) -> Result<Linearization, Failure>;
    /// ½ |r|² with the weights of the last linearization.
    fn cost(&mut self, x: &DVector<f64>) -> Result<f64, Failure>;
    /// What the weights of the last linearization add to its cost; `None` where steps need not be held
    /// against it.
    fn cost_of_weights(&self) -> Option<f64> {
        None
    }
    /// Keeps the last linearization's weights aside.
    fn keep(&mut self) {}
    /// Takes them back.
    fn restore(&mut self) {}
}

/// Steps that new weights speak against, one after the other, before the solver stops.
const REJECTED: usize = 4;

/// When the solver stops.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SolverSettings {
    /// Linearizations at most.
    pub steps: usize,
    /// A step shorter than this, in posterior standard deviations, is the last.
    pub tolerance: f64,
    /// Longest step of any number.
    pub longest: f64,
    /// The last step, short as it is, is taken by the linearization before it: half of the work of a fit that
    /// starts near its optimum.
    pub keeps_last_linearization: bool,
}

impl Default for SolverSettings {
    fn default() -> Self {
        Self { steps: 15, tolerance: 0.05, longest: 1.0, keeps_last_linearization: false }
    }
}

/// Where the solver ended.
#[derive(Clone, Debug, PartialEq)]
pub struct Solution {
    /// x.
    pub point: DVector<f64>,
    /// The log density there, without the prior.
    pub linearization: Linearization,
    /// Data and prior cost.
    pub cost: f64,
    /// −cost − ½ ln |H| + ½ ln |Λ|.
    pub log_evidence: f64,
    /// Linearizations spent.
    pub steps: usize,
}

/// Minimizes from `start`.
pub fn solve(
    problem: &mut impl LeastSquares,
    prior: &Gaussian,
    start: &DVector<f64>,
    settings: &SolverSettings,
) -> Result<Solution, Failure> {
    let prior_cholesky = prior.precision.clone().cholesky().ok_or(Failure::Singular)?;
    let mean = prior_cholesky.solve(&prior.information);
    let prior_cost = |x: &DVector<f64>| 0.5 * (x - &mean).dot(&(&prior.precision * (x - &mean)));
    let mut point = start.clone();
    let mut here = problem.linearize(&point)?;
    let mut steps = 1;
    let mut damping = 1e-3;
    let mut converged = false;
    let mut rejected = 0;
    while steps < settings.steps && !converged {
        let hessian = &here.curvature + &prior.precision;
        let gradient = &here.gradient + &prior.precision * (&point - &mean);
        let cost = here.cost + prior_cost(&point);
        let mut accepted = None;
        for _ in 0..8 {
            let mut damped = hessian.clone();
            for i in 0..damped.nrows() {
                damped[(i, i)] *= 1.0 + damping;
            }
            let Some(cholesky) = damped.cholesky() else {
                return Err(Failure::Singular);
            };
            let mut step = -cholesky.solve(&gradient);
            let longest = step.amax();
            if longest > settings.longest {
                step *= settings.longest / longest;
            }
            let trial = &point + &step;
            let trial_cost = problem.cost(&trial).map(|c| c + prior_cost(&trial)).unwrap_or(f64::INFINITY);
            let gained = trial_cost.is_finite() && trial_cost <= cost;
            let length = step.dot(&(&hessian * &step)).sqrt();
            if length < settings.tolerance && damping < 1.0 {
                converged = true;
            }
            if gained && converged && settings.keeps_last_linearization {
                here.cost = trial_cost - prior_cost(&trial);
                here.gradient += &here.curvature * &step;
                point = trial;
                break;
            }
            if gained {
                accepted = Some(trial);
                break;
            }
            if converged {
                break;
            }
            damping *= 10.0;
        }
        let Some(trial) = accepted else { break };
        let before = problem.cost_of_weights().map(|weights| cost + weights);
        problem.keep();
        let there = problem.linearize(&trial);
        steps += 1;
        // Where the weights change fast, less by the old ones may be more by the new.
        let after = there.as_ref().ok().and_then(|l| Some(l.cost + prior_cost(&trial) + problem.cost_of_weights()?));
        let worse = before.is_some_and(|before| after.is_none_or(|after| after > before));
        if worse && (!converged || there.is_err()) {
            problem.restore();
            rejected += 1;
            damping = (damping * 10.0).max(1e-2);
            if rejected >= REJECTED {
                break;
            }
        } else {
            here = there?;
            point = trial;
            rejected = 0;
            damping = (damping * 0.1_f64).max(1e-7);
        }
    }
    let hessian = (&here.curvature + &prior.precision).cholesky().ok_or(Failure::Singular)?;
    let cost = here.cost + prior_cost(&point);
    let log_evidence = -cost - half_log_determinant(&hessian) + half_log_determinant(&prior_cholesky);
    Ok(Solution { point, linearization: here, cost, log_evidence, steps })
}

fn half_log_determinant(cholesky: &nalgebra::Cholesky<f64, nalgebra::Dyn>) -> f64 {
    cholesky.l_dirty().diagonal().iter().map(|x| x.ln()).sum()
}

#[cfg(test)]
mod tests {
    use super::*;

    /// y = exp(x) with noise of standard deviation .1, observed as 2.
    struct Exponential;

    impl LeastSquares for Exponential {
        fn linearize(&mut self, x: &DVector<f64>) -> Result<Linearization, Failure> {
            let (r, j) = ((x[0].exp() - 2.0) / 0.1, x[0].exp() / 0.1);
            Ok(Linearization {
                cost: 0.5 * r * r,
                gradient: DVector::from_element(1, j * r),
                curvature: DMatrix::from_element(1, 1, j * j),
            })
        }
        fn cost(&mut self, x: &DVector<f64>) -> Result<f64, Failure> {
            Ok(self.linearize(x)?.cost)
        }
    }

    #[test]
    fn finds_the_maximum_from_afar() {
        let prior = Gaussian::from_moments(&DVector::zeros(1), &DMatrix::from_element(1, 1, 100.0)).expect("proper");
        let solution = solve(&mut Exponential, &prior, &DVector::from_element(1, -3.0), &SolverSettings::default())
            .expect("regular");
        let converged = solution.steps < SolverSettings::default().steps;
        assert!(converged && (solution.point[0] - 2f64.ln()).abs() < 1e-3, "{solution:?}");
        let settings = SolverSettings { keeps_last_linearization: true, ..SolverSettings::default() };
        let kept = solve(&mut Exponential, &prior, &DVector::from_element(1, -3.0), &settings).expect("regular");
        assert!((&kept.point - &solution.point).amax() < 1e-3, "{kept:?}");
        assert!(
            (kept.log_evidence - solution.log_evidence).abs() < 0.01,
            "{} for {}",
            kept.log_evidence,
            solution.log_evidence
        );
    }
}
