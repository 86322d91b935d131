//! Gaussian beliefs, site factors and nonlinear least squares: sees only mathematics.

mod belief;
mod gaussian;
mod solver;

pub use belief::{Belief, Factor, Joint};
pub use gaussian::Gaussian;
pub use solver::{Failure, LeastSquares, Linearization, Solution, SolverSettings, solve};
