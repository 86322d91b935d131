//! A part of which no joint is known: constant velocity, shrunk to rest where nothing touches it.

use nalgebra::{Matrix3, Vector3};

use crate::math::Pose;

/// Tool positions of the last so many seconds give the rate of the part that it holds \[s\].
const TOOL_SPAN: f64 = 0.1;
/// Standard deviation of a part at rest, now \[m\] and by horizon \[m/s\].
const RESTING: (f64, f64) = (0.003, 0.005);
/// Standard deviation of a moving part, now \[m\] and of its acceleration \[m/s²\].
const MOVING: (f64, f64) = (0.010, 0.4);

/// What is known of the part.
#[derive(Clone, Debug)]
pub struct FreePart {
    /// Its displacement.
    pub displacement: Pose,
    /// Velocity of its points \[m/s\]; `None` at rest.
    pub velocity: Option<Vector3<f64>>,
    /// How far the displacement may be off, where only the tool tells \[m\].
    pub doubt_m: f64,
}

impl FreePart {
    /// Where it stays.
    pub fn resting(displacement: Pose) -> Self {
        Self { displacement, velocity: None, doubt_m: 0.0 }
    }

    /// Where the tool carries it, by the tool's positions since it took hold: (time \[s\], point \[m\]).
    pub fn carried(held_from: Pose, track: &[(f64, Vector3<f64>)]) -> Self {
        let (Some(first), Some(last)) = (track.first(), track.last()) else { return Self::resting(held_from) };
        let recent: Vec<_> = track.iter().filter(|(t, _)| last.0 - t <= TOOL_SPAN).collect();
        let count = recent.len() as f64;
        let mean_t = recent.iter().map(|(t, _)| t - last.0).sum::<f64>() / count;
        let mean_x = recent.iter().map(|(_, x)| x).sum::<Vector3<f64>>() / count;
        let square: f64 = recent.iter().map(|(t, _)| (t - last.0 - mean_t).powi(2)).sum();
        if square < 1e-6 {
            return Self::resting(held_from);
        }
        let slope = recent.iter().map(|(t, x)| (x - mean_x) * (t - last.0 - mean_t)).sum::<Vector3<f64>>() / square;
        let went = mean_x - slope * mean_t - first.1;
        // Its centre goes less than where it is held, if it turns.
        Self {
            displacement: Pose::from_translation(went) * held_from,
            velocity: Some(slope),
            doubt_m: 0.5 * went.norm(),
        }
    }

    /// Its displacement after a horizon \[s\], and the covariance of its points \[m²\].
    pub fn after(&self, horizon_s: f64) -> (Pose, Matrix3<f64>) {
        match self.velocity {
            None => (
                self.displacement,
                Matrix3::from_diagonal_element((RESTING.0 + RESTING.1 * horizon_s + self.doubt_m).powi(2)),
            ),
            Some(velocity) => {
                let half_speed = 0.5 * velocity.norm() * horizon_s;
                let std = MOVING.0 + self.doubt_m + half_speed + 0.5 * MOVING.1 * horizon_s * horizon_s;
                (
                    Pose::from_translation(velocity * horizon_s) * self.displacement,
                    Matrix3::from_diagonal_element(std * std),
                )
            }
        }
    }
}
