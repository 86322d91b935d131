//! Gaussian beliefs, site factors, nonlinear least squares and samplers: sees only mathematics.

mod belief;
mod density;
mod gaussian;
mod hmc;
mod nuts;
mod sampling;
mod solver;

pub use belief::{Belief, Factor, Joint};
pub use density::{LeastSquaresDensity, LogDensity, Whitened};
pub use gaussian::Gaussian;
pub use sampling::{Sampler, Samples, SamplingSettings, effective_size, sample, split_r_hat};
pub use solver::{Failure, LeastSquares, Linearization, Solution, SolverSettings, solve};
