//! Gaussians in information form: products and quotients are sums and differences.

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::solver::Failure;

/// exp(−½ xᵀ Λ x + hᵀ x): a density if Λ is positive definite, else only a factor of one.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Gaussian {
    /// Λ.
    pub precision: DMatrix<f64>,
    /// h = Λ · mean.
    pub information: DVector<f64>,
}

impl Gaussian {
    /// The factor that says nothing of `dimension` numbers.
    pub fn flat(dimension: usize) -> Self {
        Self { precision: DMatrix::zeros(dimension, dimension), information: DVector::zeros(dimension) }
    }

    /// From mean and covariance.
    pub fn from_moments(mean: &DVector<f64>, covariance: &DMatrix<f64>) -> Result<Self, Failure> {
        let precision = covariance.clone().cholesky().ok_or(Failure::Singular)?.inverse();
        Ok(Self { information: &precision * mean, precision })
    }

    /// How many numbers it is about.
    pub fn dimension(&self) -> usize {
        self.information.len()
    }

    /// Mean and covariance.
    pub fn moments(&self) -> Result<(DVector<f64>, DMatrix<f64>), Failure> {
        let cholesky = self.precision.clone().cholesky().ok_or(Failure::Singular)?;
        let mean = cholesky.solve(&self.information);
        if !mean.iter().all(|x| x.is_finite()) {
            return Err(Failure::Singular);
        }
        Ok((mean, cholesky.inverse()))
    }

    /// Multiplies by a factor of some of the numbers: its i-th is `places[i]` here.
    pub fn multiply_at(&mut self, factor: &Gaussian, places: &[usize]) {
        for (i, &row) in places.iter().enumerate() {
            self.information[row] += factor.information[i];
            for (j, &column) in places.iter().enumerate() {
                self.precision[(row, column)] += factor.precision[(i, j)];
            }
        }
    }

    /// The marginal of some of the numbers.
    pub fn marginal(&self, places: &[usize]) -> Result<Self, Failure> {
        let (mean, covariance) = self.moments()?;
        Self::from_moments(
            &DVector::from_fn(places.len(), |i, _| mean[places[i]]),
            &DMatrix::from_fn(places.len(), places.len(), |i, j| covariance[(places[i], places[j])]),
        )
    }

    /// The factor of y that this one of x = map · y + shift is.
    pub fn pull_back(&self, map: &DMatrix<f64>, shift: &DVector<f64>) -> Self {
        let information = map.transpose() * (&self.information - &self.precision * shift);
        Self { precision: map.transpose() * &self.precision * map, information }
    }

    /// −½ (x − m)ᵀ Λ (x − m) at x, for a proper Gaussian; up to its value at the mean else.
    pub fn quadratic(&self, x: &DVector<f64>) -> f64 {
        -0.5 * x.dot(&(&self.precision * x)) + self.information.dot(x)
    }
}
