//! A part of which no joint is known: constant velocity, turning included, that fades to rest.
//!
//! Twist by least squares over its last registered poses, shrunk by what noise alone would show
//! (James–Stein, positive part); where the tool holds it, the held point goes as the tool does.

use nalgebra::{Matrix3, Vector3, Vector6};

use crate::math::Pose;

/// Registered poses of the last so many seconds give the twist \[s\].
const POSE_SPAN: f64 = 0.45;
/// Tool positions of the last so many seconds give the velocity of the point that it holds \[s\].
const TOOL_SPAN: f64 = 0.1;
/// Standard deviation of a registered pose's points \[m\].
const POSE_NOISE: f64 = 0.006;
/// Faster registered motion is a wrong match \[m/s\].
const FASTEST: f64 = 2.0;
/// A velocity fades within this \[s\]: v e^(−t/T).
pub(super) const FADE: f64 = 0.6;
/// Standard deviation of a part at rest, now \[m\] and by horizon \[m/s\].
const RESTING: (f64, f64) = (0.003, 0.005);
/// Standard deviation of a moving part, now \[m\] and of its acceleration \[m/s²\].
const MOVING: (f64, f64) = (0.006, 0.6);

/// What is known of the part.
#[derive(Clone, Copy, Debug)]
pub struct FreePart {
    /// Its displacement.
    pub displacement: Pose,
    /// Its twist about `center`, in the part's axes, (angular, linear); zero at rest.
    twist: Vector6<f64>,
    /// Its centroid at the reference configuration \[m\].
    center: Vector3<f64>,
    /// Whether something holds it.
    held: bool,
    /// How far the displacement may be off \[m\].
    pub doubt_m: f64,
}

impl FreePart {
    /// Where it stays.
    pub fn resting(displacement: Pose) -> Self {
        let (twist, center) = (Vector6::zeros(), Vector3::zeros());
        Self { displacement, twist, center, held: false, doubt_m: 0.0 }
    }

    /// By registered poses (time \[s\], displacement), the newest last, of a part with its centroid at
    /// `center` and points about `radius` from it \[m\]; `tool` has the positions of what holds it.
    pub fn followed(poses: &[(f64, Pose)], center: Vector3<f64>, radius: f64, tool: &[(f64, Vector3<f64>)]) -> Self {
        let Some(&(now_s, newest)) = poses.last() else { return Self::resting(Pose::identity()) };
        let to_center = Pose::from_translation(center);
        let from_newest = (newest * to_center).inverse();
        let recent = poses.iter().filter(|(t, _)| now_s - t <= POSE_SPAN);
        let points: Vec<(f64, Vector6<f64>)> =
            recent.map(|(t, pose)| (t - now_s, (from_newest * *pose * to_center).log())).collect();
        let count = points.len() as f64;
        let mean_t = points.iter().map(|(t, _)| t).sum::<f64>() / count;
        let mean = points.iter().map(|(_, xi)| xi).sum::<Vector6<f64>>() / count;
        let square: f64 = points.iter().map(|(t, _)| (t - mean_t).powi(2)).sum();
        let mut twist = Vector6::zeros();
        if square > 1e-6 {
            twist = points.iter().map(|(t, xi)| (xi - mean) * (t - mean_t)).sum::<Vector6<f64>>() / square;
            let turn = twist.fixed_rows::<3>(0).norm() * radius;
            let speed = turn.hypot(twist.fixed_rows::<3>(3).norm());
            // Without a hold rest is likelier: the noise of six numbers, three deviations of it.
            let doubtful = if tool.is_empty() { 9.0 } else { 1.0 } * 6.0 * POSE_NOISE.powi(2) / square;
            twist *= (1.0 - doubtful / speed.powi(2).max(1e-12)).max(0.0);
        }
        let still = twist == Vector6::zeros();
        let here = if still { mean } else { mean - twist * mean_t };
        let displacement = newest * to_center * Pose::exp(&here) * Pose::from_translation(-center);
        if twist.fixed_rows::<3>(3).norm().hypot(twist.fixed_rows::<3>(0).norm() * radius) > FASTEST {
            twist = Vector6::zeros();
        }
        let mut part = Self { displacement, twist, center, held: !tool.is_empty(), doubt_m: 0.0 };
        if let Some((velocity, point)) = tool_velocity(tool) {
            // The held point's velocity is the tool's, whatever the turn.
            let turned = displacement.rotation * twist.fixed_rows::<3>(0);
            let arm = point - displacement.transform_point(&center);
            let linear = displacement.rotation.transpose() * (velocity - turned.cross(&arm));
            part.twist.fixed_rows_mut::<3>(3).copy_from(&linear);
        }
        part
    }

    /// Its centroid at the reference configuration \[m\], where it is known.
    pub fn center(&self) -> Option<Vector3<f64>> {
        (self.center != Vector3::zeros()).then_some(self.center)
    }

    /// Velocity of a point of it that is at `place` now \[m/s\].
    pub fn velocity_at(&self, place: &Vector3<f64>) -> Vector3<f64> {
        let turn = self.displacement.rotation * self.twist.fixed_rows::<3>(0);
        let arm = place - self.displacement.transform_point(&self.center);
        self.displacement.rotation * self.twist.fixed_rows::<3>(3) + turn.cross(&arm)
    }

    /// Its displacement after a horizon \[s\], and the covariance of its points \[m²\].
    pub fn after(&self, horizon_s: f64) -> (Pose, Matrix3<f64>) {
        let speed = self.twist.fixed_rows::<3>(3).norm();
        if self.twist == Vector6::zeros() && !self.held {
            let std = RESTING.0 + RESTING.1 * horizon_s + self.doubt_m;
            return (self.displacement, Matrix3::from_diagonal_element(std.powi(2)));
        }
        let lasting = FADE * (1.0 - (-horizon_s / FADE).exp());
        let center = Pose::from_translation(self.center);
        let displacement =
            self.displacement * center * Pose::exp(&(self.twist * lasting)) * Pose::from_translation(-self.center);
        let std = MOVING.0 + self.doubt_m + 0.4 * speed * horizon_s + 0.5 * MOVING.1 * horizon_s * horizon_s;
        (displacement, Matrix3::from_diagonal_element(std * std))
    }
}

/// Velocity \[m/s\] and place \[m\] of the tool, by its last positions.
fn tool_velocity(track: &[(f64, Vector3<f64>)]) -> Option<(Vector3<f64>, Vector3<f64>)> {
    let last = track.last()?;
    let recent: Vec<_> = track.iter().filter(|(t, _)| last.0 - t <= TOOL_SPAN).collect();
    let count = recent.len() as f64;
    let mean_t = recent.iter().map(|(t, _)| t - last.0).sum::<f64>() / count;
    let mean_x = recent.iter().map(|(_, x)| x).sum::<Vector3<f64>>() / count;
    let square: f64 = recent.iter().map(|(t, _)| (t - last.0 - mean_t).powi(2)).sum();
    if square < 1e-6 {
        return None;
    }
    let slope = recent.iter().map(|(t, x)| (x - mean_x) * (t - last.0 - mean_t)).sum::<Vector3<f64>>() / square;
    Some((slope, mean_x - slope * mean_t))
}
