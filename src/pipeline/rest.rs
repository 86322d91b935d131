//! What a wrench sensor reads while nothing is touched, and how far from that means a push.

use nalgebra::Vector3;

use crate::types::AppliedWrench;

/// Older readings count this much less with every span that is added.
const FADING: f64 = 0.9;
/// Differences of readings that tell their noise, at least.
const SETTLED: f64 = 8.0;
/// A push is beyond the rest reading by this many standard deviations of the difference: of its norm,
/// over three axes, noise goes beyond that once in 10⁷.
const SURE: f64 = 6.0;

/// Mean and noise of a sensor's readings at rest, the latest weighing most.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub(super) struct RestReading {
    force: Vector3<f64>,
    torque: Vector3<f64>,
    /// Readings in the means.
    weight: f64,
    /// Squares of the differences of successive forces \[N²\], all axes together, and their number.
    squares: f64,
    differences: f64,
}

impl RestReading {
    /// Takes in the readings of a span at rest, in order of time.
    pub fn add<'a>(&mut self, readings: impl Iterator<Item = &'a AppliedWrench>) {
        let faded = FADING * self.weight;
        let (mut force, mut torque, mut weight) = (self.force * faded, self.torque * faded, faded);
        self.squares *= FADING;
        self.differences *= FADING;
        let mut before: Option<&AppliedWrench> = None;
        for reading in readings {
            force += reading.force_in_world;
            torque += reading.torque_in_world;
            weight += 1.0;
            if let Some(before) = before.replace(reading) {
                self.squares += (reading.force_in_world - before.force_in_world).norm_squared();
                self.differences += 1.0;
            }
        }
        if weight > 0.0 {
            (self.force, self.torque, self.weight) = (force / weight, torque / weight, weight);
        }
    }

    /// Whether the noise is known.
    pub fn is_settled(&self) -> bool {
        self.differences >= SETTLED
    }

    /// Whether a force \[N\], the mean of so many readings, is a push: further from rest than `least_n`, and
    /// than noise goes. Nothing is one before the noise is known.
    pub fn is_push(&self, force: &Vector3<f64>, readings: f64, least_n: f64) -> bool {
        let noise = (self.squares / (6.0 * self.differences) * (1.0 / readings + 1.0 / self.weight)).sqrt();
        self.is_settled() && (force - self.force).norm() > least_n.max(SURE * noise)
    }

    /// Whether either, the mean of some readings, is beyond what was read at rest by more than `force_n` \[N\] or
    /// `torque_nm` \[N·m\].
    pub fn is_left(&self, force: &Vector3<f64>, torque: &Vector3<f64>, force_n: f64, torque_nm: f64) -> bool {
        (force - self.force).norm() > force_n || (torque - self.torque).norm() > torque_nm
    }
}

#[cfg(test)]
mod tests {
    use rand::{RngExt, SeedableRng};
    use rand_distr::StandardNormal;

    use super::*;
    use crate::types::Stamp;

    #[test]
    fn noise_is_no_push_and_a_push_is() {
        let mut random = rand_chacha::ChaCha8Rng::seed_from_u64(4);
        for deviation in [0.02, 0.1, 0.5] {
            for _ in 0..200 {
                let mut noise = || deviation * random.sample::<f64, _>(StandardNormal);
                let mut noisy = |at: f64| AppliedWrench {
                    stamp: Stamp(0),
                    source: 0,
                    part: None,
                    tool: true,
                    point_in_world: Vector3::zeros(),
                    force_in_world: Vector3::from_fn(|_, _| at + noise()),
                    torque_in_world: Vector3::zeros(),
                };
                let mut rest = RestReading::default();
                // The first reading comes alone.
                rest.add([noisy(0.0)].iter());
                assert!(!rest.is_push(&noisy(0.0).force_in_world, 1.0, 0.3));
                for _ in 0..5 {
                    let readings: Vec<AppliedWrench> = (0..12).map(|_| noisy(0.0)).collect();
                    let mean = readings.iter().map(|r| r.force_in_world).sum::<Vector3<f64>>() / 12.0;
                    assert!(!rest.is_push(&mean, 12.0, 0.3), "{rest:?} {mean}");
                    rest.add(readings.iter());
                }
                assert!(rest.is_settled() && rest.is_push(&noisy(6.0 * deviation + 0.3).force_in_world, 8.0, 0.3));
            }
        }
    }
}
