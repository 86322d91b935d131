//! What if: where the parts would be under a planned wrench, by samples of what the filter believes.
//!
//! A sample is the filter's mean plus Σ √λ v z over the eigenvectors v of its covariance, z standard
//! normal: positions, rates, unexplained forces and the dynamics' numbers of the joints that move. Each is
//! simulated on under the plan; the spread is about the mean's own path.

use std::sync::Arc;

use nalgebra::{DMatrix, Matrix3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};

use super::filter::{Filter, Held};
use crate::math::Pose;
use crate::mechanism::WrenchSample;
use crate::model::SensorError;
use crate::types::Label;

/// Longest step of a sample's simulation \[s\].
const STEP: f64 = 0.005;
/// Coordinates known better than this do not vary.
const CERTAIN: f64 = 1e-16;

/// A wrench to come, and what is asked of it.
#[derive(Clone, Debug, PartialEq)]
pub struct Plan {
    /// The part that it acts on.
    pub part: Label,
    /// Where it acts now, in world \[m\]; the point goes with the part.
    pub point_in_world: Vector3<f64>,
    /// Force and torque about that point from each time on \[s\], counted from now, to the next.
    pub profile: Vec<(f64, Vector3<f64>, Vector3<f64>)>,
    /// Times that are asked for \[s\], counted from now, ascending.
    pub times_s: Vec<f64>,
    /// Samples.
    pub samples: usize,
    /// Seed of the samples.
    pub seed: u64,
}

/// A part at a time of a plan.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PlannedPose {
    /// The part.
    pub label: Label,
    /// From now \[s\].
    pub time_s: f64,
    /// D.
    pub displacement: Pose,
    /// Covariance of D·c, c its centre of mass \[m²\].
    pub covariance_m2: Matrix3<f64>,
}

impl Filter {
    /// Every jointed part at the times of a plan; `None` if it acts on a part without a joint.
    pub fn under(&self, plan: &Plan) -> Option<Vec<PlannedPose>> {
        let mut filter = self.clone();
        filter.trust();
        filter.release();
        let body = filter.mechanism.body(plan.part)?;
        let displacements = filter.mechanism.tree.displacements(&filter.state.positions);
        let point = displacements[body].inverse().transform_point(&plan.point_in_world);
        filter.held = Some(Held { body, point });
        // The planned wrench is what acts, not what is reported.
        Arc::make_mut(&mut filter.mechanism).sensor = SensorError::none();
        let times_s: Vec<f64> =
            std::iter::once(0.0).chain(plan.times_s.iter().copied()).map(|t| filter.time_s + t).collect();
        let samples = held_readings(&plan.profile, filter.time_s);
        let mean = filter.simulate(&[], &times_s, &samples, STEP)?;
        let coordinates: Vec<usize> = filter
            .coordinates_of(&filter.moving_joints())
            .into_iter()
            .filter(|&at| filter.covariance[(at, at)] > CERTAIN)
            .collect();
        let count = coordinates.len();
        let own = DMatrix::from_fn(count, count, |i, j| filter.covariance[(coordinates[i], coordinates[j])]);
        let eigen = own.symmetric_eigen();
        let mut random = ChaCha8Rng::seed_from_u64(plan.seed);
        let mut paths = Vec::with_capacity(plan.samples);
        for _ in 0..plan.samples {
            let mut changes: Vec<(usize, f64)> = coordinates.iter().map(|&at| (at, 0.0)).collect();
            for (value, vector) in eigen.eigenvalues.iter().zip(eigen.eigenvectors.column_iter()) {
                let z: f64 = StandardNormal.sample(&mut random);
                let length = value.max(0.0).sqrt() * z;
                changes.iter_mut().zip(vector.iter()).for_each(|((_, change), along)| *change += length * along);
            }
            paths.extend(filter.simulate(&changes, &times_s, &samples, STEP));
        }
        let tree = &filter.mechanism.tree;
        let mut poses = Vec::new();
        for (step, time_s) in plan.times_s.iter().enumerate() {
            let displacements = tree.displacements(&mean[step + 1]);
            let of_samples: Vec<Vec<Pose>> = paths.iter().map(|path| tree.displacements(&path[step + 1])).collect();
            for (index, joint) in filter.mechanism.joints.iter().enumerate() {
                let center = &filter.mechanism.centers[index];
                let expected = displacements[index].transform_point(center);
                let mut covariance_m2 = Matrix3::zeros();
                for sample in &of_samples {
                    let off = sample[index].transform_point(center) - expected;
                    covariance_m2 += off * off.transpose() / of_samples.len() as f64;
                }
                poses.push(PlannedPose {
                    label: joint.child,
                    time_s: *time_s,
                    displacement: displacements[index],
                    covariance_m2,
                });
            }
        }
        Some(poses)
    }
}

/// A profile of constant pieces as readings, which are joined by lines: two at each change.
fn held_readings(profile: &[(f64, Vector3<f64>, Vector3<f64>)], now_s: f64) -> Vec<WrenchSample> {
    let mut samples: Vec<WrenchSample> = Vec::with_capacity(2 * profile.len() + 1);
    for &(from_s, force_in_world, torque_in_world) in profile {
        if let Some(last) = samples.last().copied() {
            samples.push(WrenchSample { stamp_s: (now_s + from_s - 1e-6).max(last.stamp_s), ..last });
        }
        let point_in_world = Vector3::zeros();
        samples.push(WrenchSample { stamp_s: now_s + from_s, point_in_world, force_in_world, torque_in_world });
    }
    samples
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use super::super::tests::drawer;
    use super::*;

    fn planned(force_n: f64, samples: usize) -> Vec<PlannedPose> {
        let filter = Filter::new(Arc::new(drawer(20.0)), 3.0, vec![0.0], vec![0.0], (1e-4, 1e-3));
        let pull = Vector3::new(force_n, 0.0, 0.0);
        let profile = vec![(0.0, pull, Vector3::zeros()), (1.0, Vector3::zeros(), Vector3::zeros())];
        let times_s = vec![0.5, 1.0, 3.0];
        let point_in_world = Vector3::new(0.1, 0.0, 0.0);
        filter.under(&Plan { part: Label(4), point_in_world, profile, times_s, samples, seed: 7 }).unwrap()
    }

    #[test]
    fn a_pull_moves_the_drawer_as_its_equation_says_and_not_when_it_sticks() {
        // 3 kg, 20 N·s/m, 3 N of friction, 10 N: v∞ = 7/20, τ = 3/20 s; x(t) = v∞ (t − τ (1 − e^(−t/τ))).
        let expected = |t: f64| 0.35 * (t - 0.15 * (1.0 - (-t / 0.15).exp()));
        let poses = planned(10.0, 40);
        for (pose, t) in poses.iter().zip([0.5, 1.0]) {
            assert!((pose.displacement.translation.x - expected(t)).abs() < 0.003, "{t}: {pose:?}");
            let deviation = pose.covariance_m2[(0, 0)].sqrt();
            assert!(deviation > 0.002 && deviation < 0.05, "{deviation}");
        }
        assert!(poses[2].displacement.translation.x > poses[1].displacement.translation.x);
        assert_eq!(poses, planned(10.0, 40), "the seed decides");
        let stuck = planned(2.0, 5);
        assert!(stuck.iter().all(|pose| pose.displacement.translation.norm() < 1e-3), "{stuck:?}");
    }
}
