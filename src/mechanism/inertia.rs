//! Spatial vectors and rigid-body inertia in world coordinates, about the world origin.
//!
//! Featherstone, "Rigid Body Dynamics Algorithms", 2008, chapter 2; all quantities in one frame, so
//! that no transforms stand between the bodies of a tree.

use std::ops::{Add, AddAssign, Mul};

use nalgebra::{Matrix3, Vector3, Vector6};

use crate::math::{Pose, Real};

/// A twist (rad/s, m/s) or a wrench (N·m, N), (angular, linear), about the world origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Spatial<T: Real> {
    /// Angular velocity, or moment.
    pub angular: Vector3<T>,
    /// Velocity of the body's point at the origin, or force.
    pub linear: Vector3<T>,
}

impl<T: Real> Spatial<T> {
    /// The zero vector.
    pub fn zero() -> Self {
        Self { angular: Vector3::zeros(), linear: Vector3::zeros() }
    }

    /// A force applied at a point, with a torque \[N·m\]: w = (τ + p × f, f).
    pub fn wrench_at(point: &Vector3<T>, force: Vector3<T>, torque: &Vector3<T>) -> Self {
        Self { angular: torque + point.cross(&force), linear: force }
    }

    /// Power: twist · wrench.
    pub fn dot(&self, other: &Self) -> T {
        self.angular.dot(&other.angular) + self.linear.dot(&other.linear)
    }

    /// The rate of change of the motion vector `other` carried by this twist (V ×).
    pub fn cross_motion(&self, other: &Self) -> Self {
        Self {
            angular: self.angular.cross(&other.angular),
            linear: self.angular.cross(&other.linear) + self.linear.cross(&other.angular),
        }
    }

    /// The rate of change of the force vector `other` carried by this twist (V ×*).
    pub fn cross_force(&self, other: &Self) -> Self {
        Self {
            angular: self.angular.cross(&other.angular) + self.linear.cross(&other.linear),
            linear: self.angular.cross(&other.linear),
        }
    }

    /// Ad(pose) of a twist.
    pub fn carried_by(&self, pose: &Pose<T>) -> Self {
        let angular = pose.rotation * self.angular;
        Self { angular, linear: pose.rotation * self.linear + pose.translation.cross(&angular) }
    }
}

impl<T: Real> From<&Vector6<T>> for Spatial<T> {
    fn from(v: &Vector6<T>) -> Self {
        Self { angular: Vector3::new(v[0], v[1], v[2]), linear: Vector3::new(v[3], v[4], v[5]) }
    }
}

impl<T: Real> Add for Spatial<T> {
    type Output = Self;
    fn add(self, other: Self) -> Self {
        Self { angular: self.angular + other.angular, linear: self.linear + other.linear }
    }
}

impl<T: Real> AddAssign for Spatial<T> {
    fn add_assign(&mut self, other: Self) {
        self.angular += other.angular;
        self.linear += other.linear;
    }
}

impl<T: Real> Mul<T> for Spatial<T> {
    type Output = Self;
    fn mul(self, factor: T) -> Self {
        Self { angular: self.angular * factor, linear: self.linear * factor }
    }
}

/// Mass, first moment and rotational inertia of a body about the world origin.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SpatialInertia<T: Real> {
    /// m \[kg\].
    pub mass: T,
    /// m c \[kg·m\].
    pub first_moment: Vector3<T>,
    /// Rotational inertia about the world origin, world axes \[kg·m²\].
    pub about_origin: Matrix3<T>,
}

impl<T: Real> SpatialInertia<T> {
    /// The inertia of nothing.
    pub fn zero() -> Self {
        Self { mass: T::zero(), first_moment: Vector3::zeros(), about_origin: Matrix3::zeros() }
    }

    /// From the mass \[kg\], the centre of mass \[m\] and the inertia about it \[kg·m²\].
    pub fn new(mass: T, com: &Vector3<T>, about_com: &Matrix3<T>) -> Self {
        let first_moment = com * mass;
        Self { mass, first_moment, about_origin: about_com + parallel_axis(com, &first_moment) }
    }

    /// The inertia of the same body after the displacement `pose`.
    pub fn carried_by(&self, pose: &Pose<T>) -> Self {
        let rotation = &pose.rotation;
        let t = &pose.translation;
        let turned = rotation * self.first_moment;
        let cross = turned * t.transpose();
        let mut about_origin = rotation * self.about_origin * rotation.transpose() - cross - cross.transpose()
            + parallel_axis(t, &(t * self.mass));
        let diagonal = T::constant(2.0) * t.dot(&turned);
        for i in 0..3 {
            about_origin[(i, i)] += diagonal;
        }
        Self { mass: self.mass, first_moment: turned + t * self.mass, about_origin }
    }

    /// How it differs from another, per `by`.
    pub(super) fn slope_from(&self, other: &Self, by: T) -> Self {
        Self {
            mass: (self.mass - other.mass) / by,
            first_moment: (self.first_moment - other.first_moment) / by,
            about_origin: (self.about_origin - other.about_origin) / by,
        }
    }

    /// The momentum of the body under a twist: I V.
    pub fn momentum(&self, twist: &Spatial<T>) -> Spatial<T> {
        let Spatial { angular, linear } = twist;
        Spatial {
            angular: self.about_origin * angular + self.first_moment.cross(linear),
            linear: linear * self.mass - self.first_moment.cross(angular),
        }
    }
}

impl<T: Real> AddAssign for SpatialInertia<T> {
    fn add_assign(&mut self, other: Self) {
        self.mass += other.mass;
        self.first_moment += other.first_moment;
        self.about_origin += other.about_origin;
    }
}

/// (a · b) 1 − a bᵀ, for b = m a the inertia of a point mass.
fn parallel_axis<T: Real>(a: &Vector3<T>, b: &Vector3<T>) -> Matrix3<T> {
    Matrix3::from_diagonal_element(a.dot(b)) - a * b.transpose()
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn carrying_the_inertia_is_carrying_the_body() {
        let pose = Pose::exp(&Vector6::new(0.4, -0.3, 0.8, 1.0, 2.0, -0.5));
        let com = Vector3::new(0.2, -0.4, 0.9);
        let about_com = Matrix3::new(0.3, 0.02, 0.0, 0.02, 0.4, 0.01, 0.0, 0.01, 0.2);
        let carried = SpatialInertia::new(2.5, &com, &about_com).carried_by(&pose);
        let turned = pose.rotation * about_com * pose.rotation.transpose();
        let direct = SpatialInertia::new(2.5, &pose.transform_point(&com), &turned);
        assert!((carried.about_origin - direct.about_origin).norm() < 1e-12);
        assert!((carried.first_moment - direct.first_moment).norm() < 1e-12);
    }

    #[test]
    fn crosses_are_dual() {
        let twist = Spatial::from(&Vector6::new(0.1, 0.2, 0.3, 0.4, 0.5, 0.6));
        let motion = Spatial::from(&Vector6::new(-0.5, 0.7, 0.1, 0.3, 0.9, -0.2));
        let wrench = Spatial::from(&Vector6::new(1.0, -2.0, 0.5, 0.8, 0.1, 3.0));
        let sum = twist.cross_motion(&motion).dot(&wrench) + motion.dot(&twist.cross_force(&wrench));
        assert!(sum.abs() < 1e-14);
    }
}
