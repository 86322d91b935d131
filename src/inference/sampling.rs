//! Samples of a log density: chains from a seed, summaries, diagnostics.
//!
//! Chains run side by side, each with random numbers of its own, and are read in their order: the
//! result depends on the seed and on nothing else. Budgets are leapfrog steps.

use nalgebra::DVector;
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use rayon::prelude::*;

use super::density::{LogDensity, Whitened};
use super::gaussian::Gaussian;
use super::hmc::hmc_chain;
use super::nuts::nuts_chain;
use super::solver::Failure;

/// How a posterior is sampled.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Sampler {
    /// Hamiltonian Monte Carlo, trajectories of fixed length (Neal 2011).
    Hmc,
    /// The no-U-turn sampler (Hoffman & Gelman 2014), by `nuts-rs`.
    Nuts,
}

/// How long, and from where.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct SamplingSettings {
    /// The method.
    pub sampler: Sampler,
    /// Chains.
    pub chains: usize,
    /// Draws per chain that only tune the step, and are thrown away.
    pub warmup: usize,
    /// Draws per chain that are kept.
    pub draws: usize,
    /// Of all random numbers.
    pub seed: u64,
    /// Evaluations of the density per draw at most.
    pub leapfrog_steps: usize,
}

/// Draws of all chains.
#[derive(Clone, Debug, PartialEq)]
pub struct Samples {
    /// By chain, in order.
    pub chains: Vec<Vec<DVector<f64>>>,
    /// Trajectories that the integrator lost, after the warm-up.
    pub divergences: usize,
    /// Evaluations of the density.
    pub evaluations: usize,
}

/// What one chain gives.
pub(super) struct Chain {
    pub draws: Vec<DVector<f64>>,
    pub divergences: usize,
    pub evaluations: usize,
}

/// Samples `density`, starting from draws of `approximation` and in its scales.
///
/// # Errors
/// If the approximation is improper, or a chain finds no start of positive density.
pub fn sample<D: LogDensity>(
    density: &D,
    approximation: &Gaussian,
    settings: &SamplingSettings,
) -> Result<Samples, Failure> {
    let whitened = Whitened::new(density, approximation)?;
    let chains = (0..settings.chains).into_par_iter().map(|chain| {
        let mut rng = ChaCha8Rng::seed_from_u64(settings.seed);
        rng.set_stream(chain as u64);
        let start = first_position(&whitened, &mut rng)?;
        match settings.sampler {
            Sampler::Hmc => hmc_chain(&whitened, start, settings, &mut rng),
            Sampler::Nuts => nuts_chain(&whitened, start, settings, chain as u64, &mut rng),
        }
    });
    let chains = chains.collect::<Result<Vec<Chain>, Failure>>()?;
    Ok(Samples {
        divergences: chains.iter().map(|c| c.divergences).sum(),
        evaluations: chains.iter().map(|c| c.evaluations).sum(),
        chains: chains.into_iter().map(|c| c.draws.iter().map(|z| whitened.restore(z)).collect()).collect(),
    })
}

/// A draw of the approximation at which the density is positive, nearer and nearer to its centre.
fn first_position(density: &impl LogDensity, rng: &mut ChaCha8Rng) -> Result<DVector<f64>, Failure> {
    let mut scale = 1.0;
    for _ in 0..8 {
        let z = DVector::from_fn(density.dimension(), |_, _| -> f64 { StandardNormal.sample(rng) }) * scale;
        if density.evaluate(&z).is_ok() {
            return Ok(z);
        }
        scale *= 0.5;
    }
    Err(Failure::Diverged)
}

impl Samples {
    /// All draws, chain after chain.
    pub fn draws(&self) -> impl Iterator<Item = &DVector<f64>> {
        self.chains.iter().flatten()
    }

    /// A function of the draws, by chain.
    pub fn values(&self, of: impl Fn(&DVector<f64>) -> f64) -> Vec<Vec<f64>> {
        self.chains.iter().map(|chain| chain.iter().map(&of).collect()).collect()
    }
}

/// Split R̂: the potential scale reduction over half chains (Gelman et al., "Bayesian Data Analysis",
/// 2013, section 11.4); near one if the chains agree.
pub fn split_r_hat(chains: &[Vec<f64>]) -> f64 {
    let halves: Vec<&[f64]> =
        chains.iter().flat_map(|c| [&c[..c.len() / 2], &c[c.len() / 2..2 * (c.len() / 2)]]).collect();
    let (m, n) = (halves.len() as f64, halves.first().map_or(0, |h| h.len()) as f64);
    if m < 2.0 || n < 2.0 {
        return f64::INFINITY;
    }
    let means: Vec<f64> = halves.iter().map(|h| mean(h)).collect();
    let within = halves.iter().map(|h| variance(h)).sum::<f64>() / m;
    if within <= 0.0 { f64::INFINITY } else { ((n - 1.0) / n + variance(&means) / within).sqrt() }
}

/// Effective sample size by Geyer's initial monotone sequence over all chains.
pub fn effective_size(chains: &[Vec<f64>]) -> f64 {
    let length = chains.iter().map(Vec::len).min().unwrap_or(0);
    let total = (length * chains.len()) as f64;
    let variance = chains.iter().map(|c| variance(c)).sum::<f64>() / chains.len().max(1) as f64;
    if length < 4 || variance <= 0.0 {
        return 0.0;
    }
    let correlation = |lag: usize| {
        let sum: f64 = chains
            .iter()
            .map(|c| {
                let middle = mean(c);
                c.iter().zip(&c[lag..]).map(|(a, b)| (a - middle) * (b - middle)).sum::<f64>() / length as f64
            })
            .sum();
        sum / (chains.len() as f64 * variance)
    };
    let mut spread = -1.0;
    let mut before = f64::INFINITY;
    for pair in 0..length / 2 {
        let both = (correlation(2 * pair) + correlation(2 * pair + 1)).min(before);
        if both <= 0.0 {
            break;
        }
        spread += 2.0 * both;
        before = both;
    }
    total / spread.max(1.0 / total)
}

fn mean(values: &[f64]) -> f64 {
    values.iter().sum::<f64>() / values.len().max(1) as f64
}

fn variance(values: &[f64]) -> f64 {
    let middle = mean(values);
    values.iter().map(|v| (v - middle).powi(2)).sum::<f64>() / (values.len().max(2) as f64 - 1.0)
}

#[cfg(test)]
#[path = "known_posteriors.rs"]
mod known_posteriors;
