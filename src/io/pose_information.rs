//! A ROS pose covariance → the information of the measured frame, in world.
//!
//! REP 103 and geometry_msgs/PoseWithCovariance: rows (x, y, z, rotation about X, Y, Z), fixed axes
//! of the header's frame. What was not measured is infinite, 10⁶ or more, or −1 (REP 145 writes −1
//! for "no estimate"); it carries no information, and the rest keeps its marginal covariance.

use nalgebra::{DMatrix, Matrix3, Matrix6};
use thiserror::Error;

/// A variance at or above this \[m² or rad²\] means "not measured".
const UNKNOWN_VARIANCE: f64 = 1e6;

/// Why a covariance cannot be used.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum CovarianceError {
    /// NaN, or infinite off the diagonal of measured rows.
    #[error("covariance entry ({row}, {column}) is {value}")]
    NotFinite {
        /// From 0, as sent.
        row: usize,
        /// From 0, as sent.
        column: usize,
        /// As sent.
        value: f64,
    },
    /// Neither a covariance nor a mark for "not measured".
    #[error("covariance of the measured rows {rows:?} is not symmetric and positive definite")]
    NotPositive {
        /// From 0, as sent.
        rows: Vec<usize>,
    },
}

/// The information (angular, linear), axes of world, of a pose covariance (linear, angular) whose
/// axes are those of a frame with the rotation `world_from_header`.
///
/// An all-zero covariance says nothing about the precision; then `default_std` (rotation \[rad\],
/// position \[m\]) is meant.
///
/// # Errors
/// A matrix that is no covariance on the rows it calls measured.
pub fn information_in_world(
    covariance: &[[f64; 6]; 6],
    world_from_header: &Matrix3<f64>,
    default_std: (f64, f64),
) -> Result<Matrix6<f64>, CovarianceError> {
    let mut in_header = Matrix6::zeros();
    if covariance.iter().flatten().all(|entry| *entry == 0.0) {
        let (rotation_rad, position_m) = default_std;
        for row in 0..3 {
            in_header[(row, row)] = rotation_rad.powi(-2);
            in_header[(row + 3, row + 3)] = position_m.powi(-2);
        }
    } else {
        let measured: Vec<usize> = (0..6).filter(|row| is_measured(covariance[*row][*row])).collect();
        let block = DMatrix::from_fn(measured.len(), measured.len(), |i, j| covariance[measured[i]][measured[j]]);
        let information = invert(&block, &measured)?;
        for (i, row) in measured.iter().enumerate() {
            for (j, column) in measured.iter().enumerate() {
                in_header[((row + 3) % 6, (column + 3) % 6)] = information[(i, j)];
            }
        }
    }
    let mut rotation = Matrix6::zeros();
    rotation.fixed_view_mut::<3, 3>(0, 0).copy_from(world_from_header);
    rotation.fixed_view_mut::<3, 3>(3, 3).copy_from(world_from_header);
    let in_world = rotation * in_header * rotation.transpose();
    Ok((in_world + in_world.transpose()) * 0.5)
}

/// NaN counts as measured, so that it is refused and not passed over.
fn is_measured(variance: f64) -> bool {
    variance.is_nan() || (variance != -1.0 && variance < UNKNOWN_VARIANCE)
}

fn invert(block: &DMatrix<f64>, rows: &[usize]) -> Result<DMatrix<f64>, CovarianceError> {
    for (i, row) in rows.iter().enumerate() {
        for (j, column) in rows.iter().enumerate() {
            let value = block[(i, j)];
            if !value.is_finite() {
                return Err(CovarianceError::NotFinite { row: *row, column: *column, value });
            }
        }
    }
    let symmetric = (block - block.transpose()).amax() <= 1e-6 * block.amax();
    let inverse = block.clone().cholesky().filter(|_| symmetric).map(|factor| factor.inverse());
    inverse
        .filter(|inverse| inverse.iter().all(|entry| entry.is_finite()))
        .ok_or_else(|| CovarianceError::NotPositive { rows: rows.to_vec() })
}

#[cfg(test)]
mod tests {
    use super::*;
    use nalgebra::Rotation3;

    const DEFAULT_STD: (f64, f64) = (0.01, 0.002);

    fn diagonal(variances: [f64; 6]) -> [[f64; 6]; 6] {
        std::array::from_fn(|row| std::array::from_fn(|column| if row == column { variances[row] } else { 0.0 }))
    }

    #[test]
    fn linear_first_becomes_angular_first() {
        let covariance = diagonal([1.0, 4.0, 9.0, 0.25, 0.0625, 0.01]);
        let information = information_in_world(&covariance, &Matrix3::identity(), DEFAULT_STD).unwrap();
        let expected = [4.0, 16.0, 100.0, 1.0, 0.25, 1.0 / 9.0];
        assert!((information.diagonal() - nalgebra::Vector6::from(expected)).norm() < 1e-12);
    }

    #[test]
    fn unmeasured_rows_are_zero_however_they_are_marked() {
        for mark in [f64::INFINITY, 1e6, 1e9, -1.0] {
            let covariance = diagonal([1e-6, 1e-6, 1e-6, mark, mark, mark]);
            let rotation = Rotation3::from_euler_angles(0.3, 0.2, 0.1).into_inner();
            let information = information_in_world(&covariance, &rotation, DEFAULT_STD).unwrap();
            assert_eq!(information.fixed_view::<3, 6>(0, 0).norm(), 0.0);
            let linear = information.fixed_view::<3, 3>(3, 3) - Matrix3::identity() * 1e6;
            assert!(linear.norm() < 1e-6, "{linear}");
        }
    }

    #[test]
    fn all_zero_means_the_default() {
        let information = information_in_world(&[[0.0; 6]; 6], &Matrix3::identity(), DEFAULT_STD).unwrap();
        assert!((information[(0, 0)] - 1e4).abs() < 1e-6);
        assert!((information[(3, 3)] - 2.5e5).abs() < 1e-6);
    }

    #[test]
    fn what_is_no_covariance_is_refused() {
        let mut asymmetric = diagonal([1.0; 6]);
        asymmetric[0][1] = 0.5;
        for bad in [
            diagonal([1.0, 1.0, 1.0, f64::NAN, 1.0, 1.0]),
            diagonal([-2.0, 1.0, 1.0, 1.0, 1.0, 1.0]),
            diagonal([1.0, 1.0, 1.0, 0.0, 0.0, 0.0]),
            asymmetric,
        ] {
            assert!(information_in_world(&bad, &Matrix3::identity(), DEFAULT_STD).is_err());
        }
    }

    #[test]
    fn turning_the_header_frame_turns_the_information() {
        let covariance = diagonal([1.0, 4.0, 9.0, 0.25, 0.0625, 0.01]);
        let rotation = Rotation3::from_axis_angle(&nalgebra::Vector3::z_axis(), std::f64::consts::FRAC_PI_2);
        let information = information_in_world(&covariance, rotation.matrix(), DEFAULT_STD).unwrap();
        assert!((information[(0, 0)] - 16.0).abs() < 1e-12, "x of world is y of the header's frame");
        assert!((information[(4, 4)] - 1.0).abs() < 1e-12);
    }
}
