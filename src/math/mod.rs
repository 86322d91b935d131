//! Scalars that may carry derivatives, rigid transforms, screws.

#[doc(hidden)]
pub mod gradient;
mod numbers;
mod scalar;
mod se3;

pub use numbers::{log_sum_exp, median, softmax};
pub use scalar::Real;
pub use se3::{Pose, Screw, from_lengths, in_lengths, length_scale, orthonormal_pair, skew};
