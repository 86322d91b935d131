//! A log density with its gradient, and how the solver's problems become one.

use nalgebra::{DMatrix, DVector};

use super::gaussian::Gaussian;
use super::solver::{Failure, LeastSquares};

/// What a sampler knows of its target.
pub trait LogDensity: Sync {
    /// How many numbers it is of.
    fn dimension(&self) -> usize;

    /// log p at x up to a constant, and its gradient. The gradient only proposes: where it is
    /// approximate samples are as right, and rejected more often.
    ///
    /// # Errors
    /// Where the density is zero or cannot be computed.
    fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, DVector<f64>), Failure>;
}

/// exp(−½ |r(x)|²) × a Gaussian prior: what [`super::solve`] finds the maximum of.
pub struct LeastSquaresDensity<'a, P> {
    problem: P,
    prior: &'a Gaussian,
}

impl<'a, P: LeastSquares + Clone + Sync> LeastSquaresDensity<'a, P> {
    /// The posterior of `problem` under `prior`.
    pub fn new(problem: P, prior: &'a Gaussian) -> Self {
        Self { problem, prior }
    }
}

impl<P: LeastSquares + Clone + Sync> LogDensity for LeastSquaresDensity<'_, P> {
    fn dimension(&self) -> usize {
        self.prior.dimension()
    }

    fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, DVector<f64>), Failure> {
        let here = self.problem.clone().linearize(x)?;
        let slope = &self.prior.information - &self.prior.precision * x - here.gradient;
        Ok((self.prior.quadratic(x) - here.cost, slope))
    }
}

/// A density in coordinates z with x = center + L z, in which `approximation` is N(0, I): the samplers'
/// steps then fit all numbers alike.
pub struct Whitened<'a, D> {
    density: &'a D,
    center: DVector<f64>,
    root: DMatrix<f64>,
}

impl<'a, D: LogDensity> Whitened<'a, D> {
    /// Whitens by an approximation of the density.
    ///
    /// # Errors
    /// If the approximation is no proper Gaussian of the same numbers.
    pub fn new(density: &'a D, approximation: &Gaussian) -> Result<Self, Failure> {
        if approximation.dimension() != density.dimension() {
            return Err(Failure::Singular);
        }
        let (center, covariance) = approximation.moments()?;
        let root = covariance.cholesky().ok_or(Failure::Singular)?.unpack();
        Ok(Self { density, center, root })
    }

    /// x of z.
    pub fn restore(&self, z: &DVector<f64>) -> DVector<f64> {
        &self.center + &self.root * z
    }
}

impl<D: LogDensity> LogDensity for Whitened<'_, D> {
    fn dimension(&self) -> usize {
        self.density.dimension()
    }

    fn evaluate(&self, z: &DVector<f64>) -> Result<(f64, DVector<f64>), Failure> {
        let (value, slope) = self.density.evaluate(&self.restore(z))?;
        let slope = self.root.transpose() * slope;
        // A sampler must never see a number that is none.
        if value.is_finite() && slope.iter().all(|s| s.is_finite()) {
            Ok((value, slope))
        } else {
            Err(Failure::Diverged)
        }
    }
}
