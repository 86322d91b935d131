//! Several accounts of where the bodies are, as one: a place that the tree can take.
//!
//! q_j = Σ_k w_jk q_jk over the accounts, the one without joints carried onto its joint, so that what is
//! said of parts together is what their joints allow. The covariance of a centre c is that about where it
//! is put, Σ_k w_k (C_k + (c_k − c)(c_k − c)ᵀ): what a joint cannot follow widens it.

use nalgebra::{Matrix3, Vector3};

use super::TrackedMechanism;
use crate::math::Pose;

/// An account of all bodies by their joints.
#[derive(Clone, Debug)]
pub struct JointAccount {
    /// Probability, by body, among the accounts by joints.
    pub weights: Vec<f64>,
    /// q, by joint \[m or rad\].
    pub positions: Vec<f64>,
    /// Covariance of each body's centre \[m²\].
    pub covariances_m2: Vec<Matrix3<f64>>,
}

/// An account of one body without its joint.
#[derive(Clone, Copy, Debug)]
pub struct FreeAccount {
    /// Its probability against all accounts by joints.
    pub weight: f64,
    /// D.
    pub displacement: Pose,
    /// Covariance of the centre \[m²\].
    pub covariance_m2: Matrix3<f64>,
}

/// A body as all accounts together have it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Mixed {
    /// q of its joint \[m or rad\].
    pub position: f64,
    /// D.
    pub displacement: Pose,
    /// Covariance of D·c \[m²\].
    pub covariance_m2: Matrix3<f64>,
}

/// The mixture of accounts, by body.
pub fn mixture(mechanism: &TrackedMechanism, accounts: &[JointAccount], free: &[Option<FreeAccount>]) -> Vec<Mixed> {
    let placed: Vec<Vec<Pose>> =
        accounts.iter().map(|account| mechanism.tree.displacements(&account.positions)).collect();
    let mut bodies: Vec<Mixed> = Vec::with_capacity(mechanism.joints.len());
    for (body, joint) in mechanism.joints.iter().enumerate() {
        let above = joint.parent.map_or_else(Pose::identity, |parent| bodies[parent].displacement);
        let by_joint: f64 = accounts.iter().map(|account| account.weights[body] * account.positions[body]).sum();
        let alone = free.get(body).copied().flatten().filter(|alone| alone.weight > 0.0);
        let position = alone.map_or(by_joint, |alone| {
            let there = joint.position_of(&(above.inverse() * alone.displacement), by_joint);
            by_joint + alone.weight * (there - by_joint)
        });
        let displacement = above * joint.screw().displacement(position);
        let place = displacement.transform_point(&mechanism.centers[body]);
        let about = |other: &Pose, covariance: &Matrix3<f64>| {
            let apart: Vector3<f64> = other.transform_point(&mechanism.centers[body]) - place;
            covariance + apart * apart.transpose()
        };
        let mut covariance_m2 = Matrix3::zeros();
        for (account, placed) in accounts.iter().zip(&placed) {
            let share = account.weights[body] * alone.map_or(1.0, |alone| 1.0 - alone.weight);
            if share > 0.0 {
                covariance_m2 += about(&placed[body], &account.covariances_m2[body]) * share;
            }
        }
        if let Some(alone) = alone {
            covariance_m2 += about(&alone.displacement, &alone.covariance_m2) * alone.weight;
        }
        bodies.push(Mixed { position, displacement, covariance_m2 });
    }
    bodies
}

#[cfg(test)]
mod tests {
    use super::super::tests::drawer;
    use super::*;

    fn account(weight: f64, position: f64) -> JointAccount {
        let covariances_m2 = vec![Matrix3::identity() * 1e-6];
        JointAccount { weights: vec![weight], positions: vec![position], covariances_m2 }
    }

    #[test]
    fn accounts_meet_on_the_joint_and_what_it_cannot_follow_widens() {
        let drawer = drawer(8.0);
        let accounts = [account(0.75, 0.1), account(0.25, 0.3)];
        let by_joint = mixture(&drawer, &accounts, &[None])[0];
        assert!((by_joint.position - 0.15).abs() < 1e-12);
        assert!((by_joint.displacement.translation - Vector3::x() * 0.15).norm() < 1e-12);
        // The variance of the two positions.
        assert!((by_joint.covariance_m2[(0, 0)] - (1e-6 + 0.75 * 0.05 * 0.05 + 0.25 * 0.15 * 0.15)).abs() < 1e-12);
        // Registration has it off the joint by 2 cm to the side.
        let aside = Pose::from_translation(Vector3::new(0.15, 0.02, 0.0));
        let alone = FreeAccount { weight: 0.5, displacement: aside, covariance_m2: Matrix3::identity() * 1e-6 };
        let mixed = mixture(&drawer, &accounts, &[Some(alone)])[0];
        assert!((mixed.displacement.translation - Vector3::x() * 0.15).norm() < 1e-12, "{mixed:?}");
        assert!((mixed.covariance_m2[(1, 1)] - (1e-6 + 0.5 * 0.02 * 0.02)).abs() < 1e-12, "{mixed:?}");
        let certain = FreeAccount { weight: 1.0, displacement: Pose::from_translation(Vector3::x() * 0.4), ..alone };
        let mixed = mixture(&drawer, &accounts, &[Some(certain)])[0];
        assert!((mixed.position - 0.4).abs() < 1e-12 && (mixed.covariance_m2[(0, 0)] - 1e-6).abs() < 1e-12);
    }
}
