//! "If I applied this wrench": trajectories of all parts under a profile that nobody has applied yet.

use nalgebra::{Matrix3, Vector3};
use thiserror::Error;

use super::Pipeline;
use crate::math::Pose;
use crate::mechanism::WrenchSample;
use crate::types::Label;

/// The point of contact is meant this exactly \[m\].
const POINT_DEVIATION: f64 = 0.001;
/// Longest time ahead \[s\]: the simulation of half a minute costs milliseconds.
const LONGEST: f64 = 30.0;

/// A wrench to come, applied at a point that goes with the part. Between samples it is linear, before
/// the first and after the last constant.
#[derive(Clone, Debug, PartialEq)]
pub struct WrenchProfile {
    /// The part that it acts on.
    pub part: Label,
    /// Where it acts, as the part is now, world frame \[m\].
    pub point_in_world: Vector3<f64>,
    /// Its samples, by time.
    pub samples: Vec<ProfileSample>,
}

/// The wrench at one time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ProfileSample {
    /// After now \[s\].
    pub after_s: f64,
    /// Force on the object \[N\], world axes.
    pub force_in_world: Vector3<f64>,
    /// Torque on the object about the point \[N·m\], world axes.
    pub torque_in_world: Vector3<f64>,
}

/// A part at a time.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct PartForecast {
    /// The part.
    pub label: Label,
    /// After now \[s\].
    pub after_s: f64,
    /// Its displacement since the first frame, world frame.
    pub displacement: Pose,
    /// Covariance of its centre of mass, held fixed in the part \[m²\].
    pub covariance_m2: Matrix3<f64>,
}

/// Why a profile has no answer.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ProfileError {
    /// No window was learned, so no part is known to move.
    #[error("nothing is learned yet: no part is known to move")]
    NothingLearned,
    /// The part has no joint.
    #[error("part {0} has no joint: it was not seen to move")]
    NoJoint(Label),
    /// Times that do not ascend from zero to the longest, or none.
    #[error("{what}: times must ascend, from 0 s to {LONGEST} s at most, and be finite")]
    Times {
        /// Which.
        what: &'static str,
    },
    /// A force, torque or point that is not finite.
    #[error("the profile has a force, torque or point that is not finite")]
    NotFinite,
}

impl Pipeline {
    /// Where all parts would be after each of `horizons_s` \[s\] under a wrench profile that starts now:
    /// the latest tracked state, simulated by the posterior's mean and along the directions in which
    /// state and parameters may be wrong together.
    pub fn predict_profile(
        &self,
        profile: &WrenchProfile,
        horizons_s: &[f64],
    ) -> Result<Vec<PartForecast>, ProfileError> {
        if !ascending(profile.samples.iter().map(|s| s.after_s)) {
            return Err(ProfileError::Times { what: "samples" });
        }
        if !ascending(horizons_s.iter().copied()) {
            return Err(ProfileError::Times { what: "horizons" });
        }
        let vectors = profile.samples.iter().flat_map(|s| [s.force_in_world, s.torque_in_world]);
        if !vectors.chain([profile.point_in_world]).all(|v| v.iter().all(|x| x.is_finite())) {
            return Err(ProfileError::NotFinite);
        }
        let forecaster = self.forecaster.as_ref().ok_or(ProfileError::NothingLearned)?;
        let mut filter = forecaster.filter().ok_or(ProfileError::NothingLearned)?.clone();
        let body = filter.mechanism().body(profile.part).ok_or(ProfileError::NoJoint(profile.part))?;
        let world_from_work = self.world_from_work();
        let work_from_world = world_from_work.inverse();
        let point = work_from_world.transform_point(&profile.point_in_world);
        let held = point + filter.mechanism().tool_offset;
        filter.hold(body, &held, POINT_DEVIATION);
        let samples: Vec<WrenchSample> = profile
            .samples
            .iter()
            .map(|s| WrenchSample {
                stamp_s: filter.time_s() + s.after_s,
                point_in_world: point,
                force_in_world: work_from_world.rotation * s.force_in_world,
                torque_in_world: work_from_world.rotation * s.torque_in_world,
            })
            .collect();
        let carried = |label, after_s, displacement: Pose, covariance_m2: Matrix3<f64>| PartForecast {
            label,
            after_s,
            displacement: world_from_work * displacement * work_from_world,
            covariance_m2: world_from_work.rotation * covariance_m2 * world_from_work.rotation.transpose(),
        };
        let mut forecasts: Vec<PartForecast> = filter
            .forecast(horizons_s, &samples)
            .into_iter()
            .map(|f| carried(f.label, horizons_s[f.horizon], f.displacement, f.covariance_m2))
            .collect();
        for (label, told) in forecaster.told() {
            if forecasts.iter().all(|f| f.label != *label) {
                forecasts.extend(horizons_s.iter().map(|&after_s| {
                    let (displacement, covariance_m2) = told.free.after(after_s);
                    carried(*label, after_s, displacement, covariance_m2)
                }));
            }
        }
        Ok(forecasts)
    }
}

/// Whether there are times, from zero to the longest, each after the one before.
fn ascending(times: impl Iterator<Item = f64> + Clone) -> bool {
    let ordered = times.clone().zip(times.clone().skip(1)).all(|(first, second)| first < second);
    ordered && times.clone().count() > 0 && times.into_iter().all(|t| (0.0..=LONGEST).contains(&t))
}
