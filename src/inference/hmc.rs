//! Hamiltonian Monte Carlo: leapfrog trajectories of a fixed length, accepted by Metropolis.
//!
//! Neal, "MCMC using Hamiltonian dynamics", 2011; the step is tuned by dual averaging (Hoffman &
//! Gelman, JMLR 15, 2014, algorithm 5). Coordinates are whitened, so that a quarter of an
//! oscillation, π/2, forgets the start; its length is jittered against resonance.

use nalgebra::DVector;
use rand::RngExt;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::density::LogDensity;
use super::sampling::{Chain, SamplingSettings};
use super::solver::Failure;

/// Share of trajectories to accept.
const TARGET: f64 = 0.95;
/// An energy error beyond this is a lost trajectory.
const DIVERGED: f64 = 1000.0;
/// Length of a trajectory.
const LENGTH: f64 = std::f64::consts::FRAC_PI_2;
const FIRST_STEP: f64 = 0.5;
/// γ, t₀ and κ of dual averaging.
const SHRINKAGE: f64 = 0.05;
const DELAY: f64 = 10.0;
const FORGETTING: f64 = 0.75;

/// One chain from `start`, in whitened coordinates.
pub(super) fn hmc_chain(
    density: &impl LogDensity,
    start: DVector<f64>,
    settings: &SamplingSettings,
    rng: &mut ChaCha8Rng,
) -> Result<Chain, Failure> {
    let (value, slope) = density.evaluate(&start)?;
    let mut here = Place { position: start, value, slope };
    let mut chain = Chain { draws: Vec::with_capacity(settings.draws), divergences: 0, evaluations: 1 };
    let mut tuning = DualAveraging::default();
    for draw in 0..settings.warmup + settings.draws {
        let warming = draw < settings.warmup;
        let step = if warming { tuning.step } else { tuning.averaged_step() };
        let length = LENGTH * rng.random_range(0.6..1.4);
        let steps = ((length / step).ceil() as usize).clamp(1, settings.leapfrog_steps.max(1));
        let momentum = DVector::from_fn(here.position.len(), |_, _| -> f64 { StandardNormal.sample(rng) });
        let energy = 0.5 * momentum.norm_squared() - here.value;
        let (end, spent) = leapfrog(density, &here, momentum, step, steps);
        chain.evaluations += spent;
        let gained = end
            .as_ref()
            .map_or(f64::NEG_INFINITY, |(place, momentum)| energy - (0.5 * momentum.norm_squared() - place.value));
        chain.divergences += usize::from(!warming && gained < -DIVERGED);
        if let Some((place, _)) = end
            && rng.random::<f64>().ln() < gained
        {
            here = place;
        }
        if warming {
            tuning.learn(gained.min(0.0).exp());
        } else {
            chain.draws.push(here.position.clone());
        }
    }
    Ok(chain)
}

#[derive(Clone)]
struct Place {
    position: DVector<f64>,
    value: f64,
    slope: DVector<f64>,
}

/// The end of a trajectory, if the density is positive all the way, and the evaluations it took.
fn leapfrog(
    density: &impl LogDensity,
    start: &Place,
    momentum: DVector<f64>,
    step: f64,
    steps: usize,
) -> (Option<(Place, DVector<f64>)>, usize) {
    let mut place = start.clone();
    let mut momentum = momentum;
    for spent in 1..=steps {
        momentum += &place.slope * (0.5 * step);
        place.position += &momentum * step;
        let Ok((value, slope)) = density.evaluate(&place.position) else { return (None, spent) };
        momentum += &slope * (0.5 * step);
        place = Place { value, slope, ..place };
    }
    (Some((place, momentum)), steps)
}

/// The step that [`TARGET`] of the trajectories accept.
struct DualAveraging {
    step: f64,
    log_averaged: f64,
    error: f64,
    count: f64,
}

impl Default for DualAveraging {
    fn default() -> Self {
        Self { step: FIRST_STEP, log_averaged: FIRST_STEP.ln(), error: 0.0, count: 0.0 }
    }
}

impl DualAveraging {
    fn learn(&mut self, accepted: f64) {
        self.count += 1.0;
        let weight = 1.0 / (self.count + DELAY);
        self.error += weight * (TARGET - accepted - self.error);
        let log_step = (10.0 * FIRST_STEP).ln() - self.count.sqrt() / SHRINKAGE * self.error;
        let weight = self.count.powf(-FORGETTING);
        self.log_averaged += weight * (log_step - self.log_averaged);
        self.step = log_step.exp().clamp(1e-4, LENGTH);
    }

    fn averaged_step(&self) -> f64 {
        self.log_averaged.exp().clamp(1e-4, LENGTH)
    }
}
