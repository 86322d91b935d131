//! The no-U-turn sampler of `nuts-rs`, on a [`LogDensity`].

use nalgebra::DVector;
use nuts_rs::{Chain as _, CpuLogpFunc, CpuMath, CpuMathError, DiagNutsSettings, HasDims, LogpError, Settings};
use rand::Rng;
use rand_chacha::ChaCha8Rng;

use super::density::LogDensity;
use super::sampling::{Chain, SamplingSettings};
use super::solver::Failure;

/// A density as the library wants it.
struct Target<'a, D>(&'a D);

impl LogpError for Failure {
    /// No density here is a trajectory that ends, not the end of sampling.
    fn is_recoverable(&self) -> bool {
        true
    }
}

impl<D> HasDims for Target<'_, D> {
    #[expect(clippy::disallowed_types, reason = "the library's type; it is empty, and nobody iterates over it")]
    fn dim_sizes(&self) -> std::collections::HashMap<String, u64> {
        std::collections::HashMap::new()
    }
}

impl<D: LogDensity> CpuLogpFunc for Target<'_, D> {
    type LogpError = Failure;
    type FlowParameters = ();
    type ExpandedVector = Vec<f64>;

    fn dim(&self) -> usize {
        self.0.dimension()
    }

    fn logp(&mut self, position: &[f64], gradient: &mut [f64]) -> Result<f64, Failure> {
        let (value, slope) = self.0.evaluate(&DVector::from_column_slice(position))?;
        gradient.copy_from_slice(slope.as_slice());
        Ok(value)
    }

    fn expand_vector<R: Rng + ?Sized>(&mut self, _: &mut R, position: &[f64]) -> Result<Vec<f64>, CpuMathError> {
        Ok(position.to_vec())
    }
}

/// One chain from `start`, in whitened coordinates.
pub(super) fn nuts_chain(
    density: &impl LogDensity,
    start: DVector<f64>,
    settings: &SamplingSettings,
    index: u64,
    rng: &mut ChaCha8Rng,
) -> Result<Chain, Failure> {
    let options = DiagNutsSettings {
        num_tune: settings.warmup as u64,
        num_draws: settings.draws as u64,
        // A trajectory of depth k has 2ᵏ − 1 steps.
        maxdepth: u64::from((settings.leapfrog_steps + 1).ilog2().max(1)),
        ..DiagNutsSettings::default()
    };
    let mut sampler = options.new_chain(index, CpuMath::new(Target(density)), rng).map_err(|_| Failure::Diverged)?;
    sampler.set_position(start.as_slice()).map_err(|_| Failure::Diverged)?;
    let mut chain = Chain { draws: Vec::with_capacity(settings.draws), divergences: 0, evaluations: 1 };
    for draw in 0..settings.warmup + settings.draws {
        let (position, progress) = sampler.draw().map_err(|_| Failure::Diverged)?;
        chain.evaluations += progress.num_gradients as usize;
        if draw >= settings.warmup {
            chain.divergences += usize::from(progress.diverging);
            chain.draws.push(DVector::from_column_slice(&position));
        }
    }
    Ok(chain)
}
