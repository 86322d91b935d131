//! Rigid transforms and screws: the special Euclidean group SE(3) and its exponential.
//!
//! Murray, Li, Sastry, "A Mathematical Introduction to Robotic Manipulation", 1994, chapter 2,
//! with twists ordered (angular, linear).

use std::ops::Mul;

use std::f64::consts::TAU;

use nalgebra::{Matrix3, Matrix6, Rotation3, UnitQuaternion, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::Real;

/// The matrix of the cross product: `skew(a) * b == a.cross(&b)`.
pub fn skew<T: Real>(a: &Vector3<T>) -> Matrix3<T> {
    Matrix3::new(T::zero(), -a.z, a.y, a.z, T::zero(), -a.x, -a.y, a.x, T::zero())
}

/// Two unit vectors that complete the unit vector `axis` to a right-handed orthonormal triad.
pub fn orthonormal_pair(axis: &Vector3<f64>) -> (Vector3<f64>, Vector3<f64>) {
    let least = axis.iamin();
    let mut helper = Vector3::zeros();
    helper[least] = 1.0;
    let first = axis.cross(&helper).normalize();
    (first, axis.cross(&first))
}

/// A rigid transform x ↦ R x + t.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(bound(serialize = "T: Serialize", deserialize = "T: Deserialize<'de>"))]
pub struct Pose<T: Real = f64> {
    /// R, a rotation matrix.
    pub rotation: Matrix3<T>,
    /// t \[m\].
    pub translation: Vector3<T>,
}

impl<T: Real> Pose<T> {
    /// The transform that moves nothing.
    pub fn identity() -> Self {
        Self { rotation: Matrix3::identity(), translation: Vector3::zeros() }
    }

    /// A pure translation \[m\].
    pub fn from_translation(translation: Vector3<T>) -> Self {
        Self { rotation: Matrix3::identity(), translation }
    }

    /// Where the point goes.
    pub fn transform_point(&self, point: &Vector3<T>) -> Vector3<T> {
        self.rotation * point + self.translation
    }

    /// The transform that undoes this one.
    pub fn inverse(&self) -> Self {
        let rotation = self.rotation.transpose();
        Self { rotation, translation: -(rotation * self.translation) }
    }

    /// Ad(self): carries a twist (angular, linear) from the right frame to the left one.
    pub fn adjoint(&self, twist: &Vector6<T>) -> Vector6<T> {
        let angular = self.rotation * twist.fixed_rows::<3>(0);
        let linear = self.rotation * twist.fixed_rows::<3>(3) + self.translation.cross(&angular);
        stack(&angular, &linear)
    }

    /// The constant transform with the same value, for mixing measured poses into derivatives.
    pub fn constant(pose: &Pose<f64>) -> Self {
        Self { rotation: pose.rotation.map(T::constant), translation: pose.translation.map(T::constant) }
    }

    /// exp of the twist (angular \[rad\], linear \[m\]).
    pub fn exp(twist: &Vector6<T>) -> Self {
        let omega: Vector3<T> = twist.fixed_rows::<3>(0).into();
        let v: Vector3<T> = twist.fixed_rows::<3>(3).into();
        let theta_squared = omega.norm_squared();
        let (a, b, c) = exponential_coefficients(theta_squared);
        let k = skew(&omega);
        let k_squared = k * k;
        Self { rotation: Matrix3::identity() + k * a + k_squared * b, translation: v + k * v * b + k_squared * v * c }
    }
}

impl Pose<f64> {
    /// The twist (angular \[rad\], linear \[m\]) whose exponential this is, |angular| ≤ π.
    pub fn log(&self) -> Vector6<f64> {
        let omega = rotation_vector(&self.rotation);
        let theta = omega.norm();
        let k = skew(&omega);
        let coefficient = if theta < 1e-4 {
            1.0 / 12.0 + theta * theta / 720.0
        } else {
            (1.0 - 0.5 * theta / (0.5 * theta).tan()) / (theta * theta)
        };
        let v = self.translation - 0.5 * (k * self.translation) + coefficient * (k * (k * self.translation));
        stack(&omega, &v)
    }

    /// From a unit quaternion and a translation \[m\].
    pub fn from_quaternion(rotation: &UnitQuaternion<f64>, translation: Vector3<f64>) -> Self {
        Self { rotation: *rotation.to_rotation_matrix().matrix(), translation }
    }

    /// The rotation as a unit quaternion.
    pub fn quaternion(&self) -> UnitQuaternion<f64> {
        UnitQuaternion::from_rotation_matrix(&Rotation3::from_matrix_unchecked(self.rotation))
    }

    /// The angle by which this turns about a unit direction \[rad\]; of the angles that are the same, the
    /// nearest to `near`.
    pub fn turn_about(&self, direction: &Vector3<f64>, near: f64) -> f64 {
        let rotation = self.quaternion();
        let angle = 2.0 * rotation.imag().dot(direction).atan2(rotation.w);
        angle + ((near - angle) / TAU).round() * TAU
    }

    /// Ad(self) as a 6×6 matrix on (angular, linear) twists.
    pub fn adjoint_matrix(&self) -> Matrix6<f64> {
        let mut matrix = Matrix6::zeros();
        matrix.fixed_view_mut::<3, 3>(0, 0).copy_from(&self.rotation);
        matrix.fixed_view_mut::<3, 3>(3, 3).copy_from(&self.rotation);
        matrix.fixed_view_mut::<3, 3>(3, 0).copy_from(&(skew(&self.translation) * self.rotation));
        matrix
    }
}

impl<T: Real> Mul for Pose<T> {
    type Output = Self;
    fn mul(self, right: Self) -> Self {
        Self {
            rotation: self.rotation * right.rotation,
            translation: self.rotation * right.translation + self.translation,
        }
    }
}

/// A joint's screw axis, (angular, linear), world frame at the reference configuration.
///
/// Prismatic: (0, n). Revolute: (n, −n × p) for a point p on the axis. Rigid: zero.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Screw<T: Real = f64>(pub Vector6<T>);

impl<T: Real> Screw<T> {
    /// The screw of a joint that does not move.
    pub fn rigid() -> Self {
        Self(Vector6::zeros())
    }

    /// Translation along the unit vector `direction`.
    pub fn prismatic(direction: &Vector3<T>) -> Self {
        Self(stack(&Vector3::zeros(), direction))
    }

    /// Rotation about the unit vector `direction` through `point` \[m\].
    pub fn revolute(direction: &Vector3<T>, point: &Vector3<T>) -> Self {
        Self(stack(direction, &point.cross(direction)))
    }

    /// exp(S q), with q in m (prismatic) or rad (revolute).
    pub fn displacement(&self, q: T) -> Pose<T> {
        Pose::exp(&(self.0 * q))
    }
}

/// The six-vector (angular, linear).
fn stack<T: Real>(angular: &Vector3<T>, linear: &Vector3<T>) -> Vector6<T> {
    Vector6::new(angular.x, angular.y, angular.z, linear.x, linear.y, linear.z)
}

/// The rotation vector of R, |ω| ≤ π: from the antisymmetric part, which keeps its digits near zero.
fn rotation_vector(rotation: &Matrix3<f64>) -> Vector3<f64> {
    let sine = 0.5
        * Vector3::new(
            rotation[(2, 1)] - rotation[(1, 2)],
            rotation[(0, 2)] - rotation[(2, 0)],
            rotation[(1, 0)] - rotation[(0, 1)],
        );
    let cosine = 0.5 * (rotation.trace() - 1.0);
    let length = sine.norm();
    let angle = length.atan2(cosine);
    if cosine < -0.9 {
        return Rotation3::from_matrix_unchecked(*rotation).scaled_axis();
    }
    if length < 1e-9 { sine } else { sine * (angle / length) }
}

/// sin θ/θ, (1 − cos θ)/θ² and (θ − sin θ)/θ³ from θ², by series near zero.
fn exponential_coefficients<T: Real>(theta_squared: T) -> (T, T, T) {
    if theta_squared.value() < 1e-4 {
        let c = T::constant;
        let t2 = theta_squared;
        (
            c(1.0) - t2 / c(6.0) * (c(1.0) - t2 / c(20.0)),
            c(0.5) - t2 / c(24.0) * (c(1.0) - t2 / c(30.0)),
            c(1.0 / 6.0) - t2 / c(120.0) * (c(1.0) - t2 / c(42.0)),
        )
    } else {
        let theta = theta_squared.sqrt();
        let (sin, cos) = theta.sin_cos();
        (sin / theta, (T::one() - cos) / theta_squared, (theta - sin) / (theta_squared * theta))
    }
}

/// What makes rotations of a body of this radius \[m\] lengths, as its translations are.
pub fn length_scale(radius: f64) -> Vector6<f64> {
    Vector6::new(radius, radius, radius, 1.0, 1.0, 1.0)
}

/// Information of (angular, linear) as that of lengths alone \[m⁻²\].
pub fn in_lengths(information: &Matrix6<f64>, radius: f64) -> Matrix6<f64> {
    let scale = length_scale(radius);
    Matrix6::from_fn(|i, j| information[(i, j)] / (scale[i] * scale[j]))
}

/// The inverse of [`in_lengths`].
pub fn from_lengths(information: &Matrix6<f64>, radius: f64) -> Matrix6<f64> {
    let scale = length_scale(radius);
    Matrix6::from_fn(|i, j| information[(i, j)] * scale[i] * scale[j])
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn twists() -> impl Strategy<Value = Vector6<f64>> {
        prop::array::uniform6(-1.5..1.5).prop_map(|x| Vector6::from_column_slice(&x))
    }

    proptest! {
        #[test]
        fn log_undoes_exp(twist in twists()) {
            prop_assert!((Pose::exp(&twist).log() - twist).norm() < 1e-9);
        }

        #[test]
        fn adjoint_carries_the_exponential(a in twists(), b in twists()) {
            let frame = Pose::exp(&a);
            let left = frame * Pose::exp(&b) * frame.inverse();
            let right = Pose::exp(&frame.adjoint(&b));
            prop_assert!((left.rotation - right.rotation).norm() < 1e-9);
            prop_assert!((left.translation - right.translation).norm() < 1e-9);
            prop_assert!((frame.adjoint_matrix() * b - frame.adjoint(&b)).norm() < 1e-12);
        }
    }

    #[test]
    fn revolute_screw_leaves_its_axis_in_place() {
        let point = Vector3::new(0.3, -0.2, 1.0);
        let screw = Screw::revolute(&Vector3::z(), &point);
        let moved = screw.displacement(0.7).transform_point(&(point + Vector3::z()));
        assert!((moved - point - Vector3::z()).norm() < 1e-14);
    }

    #[test]
    fn log_keeps_its_digits_near_zero() {
        let twist = Vector6::new(1e-7, -2e-7, 3e-7, 1e-3, 0.0, 0.0);
        assert!((Pose::exp(&twist).log() - twist).norm() < 1e-15);
    }

    #[test]
    fn small_and_large_angles_agree_at_the_switch() {
        for theta in [0.009_999, 0.010_001] {
            let pose = Pose::exp(&Vector6::new(theta, 0.0, 0.0, 0.1, 0.2, 0.3));
            assert!((pose.rotation[(2, 1)] - theta.sin()).abs() < 1e-13);
        }
    }
}
