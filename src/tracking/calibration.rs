//! How far predictions were off, in units of what they said: learned as the stream goes.
//!
//! s² = (ν + Σ ω z²) / (ν + Σ ω) for z² = eᵀ Σ⁻¹ e / 3 of past predictions, per horizon and kind, ω
//! fading with each new one: the posterior mean of a variance scale with ν prior predictions' worth of
//! belief in 1 (Gelman et al., "Bayesian Data Analysis", 2013, section 2.6). What is published is s² Σ.

use nalgebra::{Matrix3, Vector3};

/// Prior predictions ν.
const PRIOR: f64 = 10.0;
/// A past prediction counts this much less with each new one.
const FADING: f64 = 0.98;
/// One prediction's z² at most: a lost part says nothing of the others.
const MOST: f64 = 25.0;
/// Registration noise of where a part then was \[m\].
const NOISE: f64 = 0.002;
/// Least and greatest scale of the variance.
const BOUNDS: (f64, f64) = (0.25, 25.0);
/// Standard deviation below which agreement shows nothing: registration's error that frames share \[m\].
const SHARED_ERROR: f64 = 0.004;

/// The scales of one object's predictions.
#[derive(Clone, Copy, Debug)]
pub struct Calibration<const HORIZONS: usize> {
    /// Σ ω z² and Σ ω by kind and horizon.
    sums: [[(f64, f64); HORIZONS]; 4],
}

impl<const HORIZONS: usize> Default for Calibration<HORIZONS> {
    fn default() -> Self {
        Self { sums: [[(0.0, 0.0); HORIZONS]; 4] }
    }
}

/// What a prediction was made of: by the joint or without it, of a part said to move or to rest.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Kind {
    /// Whether the joint made it.
    pub by_joint: bool,
    /// Whether it says that the part moves.
    pub moves: bool,
}

impl Kind {
    fn index(self) -> usize {
        usize::from(self.by_joint) + 2 * usize::from(self.moves)
    }
}

impl<const HORIZONS: usize> Calibration<HORIZONS> {
    /// Takes in the error of a prediction \[m\] that was said to have this covariance \[m²\].
    pub fn learn(&mut self, kind: Kind, horizon: usize, error: &Vector3<f64>, covariance: &Matrix3<f64>) {
        let Some(inverse) = (covariance + Matrix3::identity() * (NOISE * NOISE)).try_inverse() else { return };
        let squared = (error.dot(&(inverse * error)) / 3.0).min(MOST);
        let (sum, count) = &mut self.sums[kind.index()][horizon];
        *sum = FADING * *sum + squared;
        *count = FADING * *count + 1.0;
    }

    /// What to scale a covariance \[m²\] by. What a part's places have in error all alike does not show in
    /// how they agree: no spread is lowered below that.
    pub fn scale(&self, kind: Kind, horizon: usize, covariance: &Matrix3<f64>) -> f64 {
        let (sum, count) = self.sums[kind.index()][horizon];
        let shown = ((PRIOR + sum) / (PRIOR + count)).clamp(BOUNDS.0, BOUNDS.1);
        let own = covariance.trace() / 3.0;
        if shown > 1.0 || own <= 0.0 { shown } else { shown.max((SHARED_ERROR.powi(2) / own).min(1.0)) }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn scales_follow_the_errors() {
        let kind = Kind { by_joint: true, moves: true };
        let mut calibration = Calibration::<2>::default();
        let covariance = Matrix3::identity() * 1e-4;
        assert_eq!(calibration.scale(kind, 0, &covariance), 1.0);
        for i in 0..300 {
            let error = Vector3::new(0.02, -0.02, 0.02) * f64::from(i % 2 * 2 - 1);
            calibration.learn(kind, 0, &error, &covariance);
        }
        let scale = calibration.scale(kind, 0, &covariance);
        assert!((2.5..4.5).contains(&scale), "{scale}");
        assert_eq!(calibration.scale(kind, 1, &covariance), 1.0);
        assert_eq!(calibration.scale(Kind { moves: false, ..kind }, 0, &covariance), 1.0);
    }
}
