//! What a run was like over time, gathered for the report.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::found::{Found, Joint};
use crate::math::Pose;
use crate::pipeline::{Learner, Output};
use crate::types::posterior::ObjectPosterior;
use crate::types::{AppliedWrench, Label, Stamp};

/// A series of (time \[s\], value).
pub type Series = Vec<(f64, f64)>;

/// Gathers while the stream goes by.
#[derive(Clone, Debug, Default)]
pub struct Gatherer {
    observed: BTreeMap<Label, Vec<(f64, Pose)>>,
    /// By part and horizon \[ms\]: the time meant, where the part was expected, the spread \[m\].
    predicted: BTreeMap<(Label, i64), Vec<(f64, Pose, f64)>>,
    wrenches: Vec<AppliedWrench>,
}

/// One joint over time.
#[derive(Clone, Debug, Default)]
pub struct JointSeries {
    /// As registration saw it, frame by frame \[m or rad\].
    pub observed: Series,
    /// As fitted, window by window \[m or rad\].
    pub fitted: Vec<Series>,
    /// What the tool's wrench does to it while the tool holds its part \[N or N·m\].
    pub applied: Vec<Series>,
    /// Spans in which the tool held its part \[s\].
    pub held: Vec<(f64, f64)>,
}

/// How far predictions of a part were off.
#[derive(Clone, Debug, Default)]
pub struct ErrorSeries {
    /// Horizon \[s\].
    pub horizon_s: f64,
    /// Of its centre, by the time meant \[mm\].
    pub errors: Series,
    /// The spread that was stated, root of the summed variances \[mm\].
    pub stated: Series,
}

impl ErrorSeries {
    /// The errors from a time on \[mm\], of what was predicted from then on.
    pub fn since(&self, from_s: f64) -> impl Iterator<Item = f64> {
        self.errors.iter().filter(move |(t, _)| *t >= from_s + self.horizon_s).map(|(_, error)| *error)
    }

    /// Root mean square from a time on \[mm\].
    pub fn rms(&self, from_s: f64) -> f64 {
        let (sum, count) = self.since(from_s).fold((0.0, 0.0), |(sum, count), e| (sum + e * e, count + 1.0));
        (sum / f64::max(count, 1.0)).sqrt()
    }
}

impl Gatherer {
    /// Takes in a reading of the wrench.
    pub fn wrench(&mut self, wrench: &AppliedWrench) {
        self.wrenches.push(*wrench);
    }

    /// Takes in what the pipeline said.
    pub fn output(&mut self, output: &Output) {
        match output {
            Output::Observation { time_s, label, measurement } if measurement.information.trace() > 0.0 => {
                self.observed.entry(*label).or_default().push((*time_s, measurement.displacement));
            }
            Output::Prediction { time_s, horizon_s, label, displacement, covariance_m2 } => {
                let key = (*label, (horizon_s * 1e3).round() as i64);
                let spread = covariance_m2.trace().max(0.0).sqrt();
                self.predicted.entry(key).or_default().push((time_s + horizon_s, *displacement, spread));
            }
            _ => {}
        }
    }

    /// A joint over time; `zero` is the stream's time zero, and `begin_s` what the learner's clock says then.
    pub fn joint(
        &self,
        joint: &Joint<'_>,
        posterior: &ObjectPosterior,
        learner: &Learner,
        (zero, begin_s): (Stamp, f64),
    ) -> JointSeries {
        let child = joint.edge.child;
        let windows: Vec<(f64, f64)> = posterior
            .windows
            .iter()
            .filter(|window| window.labels.contains(&child) && window.t0_s >= begin_s)
            .map(|window| (window.t0_s - begin_s, window.t1_s - begin_s))
            .collect();
        let mut series = JointSeries { held: windows, ..JointSeries::default() };
        let Some(axis) = JointAxis::of(joint) else { return series };
        let center = center_of(posterior, child);
        let parents = self.observed.get(&joint.edge.parent).map_or(&[][..], Vec::as_slice);
        let mut last = 0.0;
        for (time_s, displacement) in self.observed.get(&child).into_iter().flatten() {
            let parent = parents
                .binary_search_by(|(t, _)| t.total_cmp(time_s))
                .map_or_else(|_| Pose::identity(), |index| parents[index].1);
            last = axis.position(&(parent.inverse() * *displacement), &center, last);
            series.observed.push((*time_s, last));
        }
        if let Some(fit) = &learner.fit
            && let Some(index) = fit.joints.iter().position(|fitted| fitted.child == child)
        {
            for (window, positions) in learner.windows.iter().zip(&fit.positions) {
                let times = window.times_s.iter().map(|t| t - begin_s);
                series.fitted.push(times.zip(positions[index].iter().copied()).filter(|(t, _)| *t >= 0.0).collect());
            }
        }
        for (from_s, to_s) in &series.held {
            let readings = self.wrenches.iter().map(|wrench| (wrench.stamp.seconds_since(zero), wrench));
            let within = readings.filter(|(t, _)| (*from_s..=*to_s).contains(t));
            series.applied.push(within.map(|(t, wrench)| (t, axis.force(wrench))).collect());
        }
        series
    }

    /// Errors of the predictions of a part, by horizon.
    pub fn errors(&self, label: Label, posterior: &ObjectPosterior) -> Vec<ErrorSeries> {
        let center = center_of(posterior, label);
        let Some(observed) = self.observed.get(&label) else { return Vec::new() };
        let of = |((_, horizon_ms), predicted): (&(Label, i64), &Vec<(f64, Pose, f64)>)| {
            let mut series = ErrorSeries { horizon_s: *horizon_ms as f64 * 1e-3, ..ErrorSeries::default() };
            for (time_s, expected, spread) in predicted {
                // Cloud stamps jitter: the nearest within 20 ms.
                let at = observed.partition_point(|(t, _)| *t < time_s - 0.02);
                let Some((t, seen)) = observed.get(at).filter(|(t, _)| (t - time_s).abs() <= 0.02) else { continue };
                let miss = expected.transform_point(&center) - seen.transform_point(&center);
                series.errors.push((*t, 1e3 * miss.norm()));
                series.stated.push((*t, 1e3 * spread));
            }
            series
        };
        self.predicted.iter().filter(|((of, _), _)| *of == label).map(of).collect()
    }

    /// The joints that are shown, parents first by label.
    pub fn joints_of<'a>(posterior: &'a ObjectPosterior, found: &'a Found<'a>) -> Vec<Joint<'a>> {
        let labels = posterior.parts.iter().map(|part| part.label);
        labels.filter_map(|label| found.joint(label)).filter(|joint| JointAxis::of(joint).is_some()).collect()
    }
}

fn center_of(posterior: &ObjectPosterior, label: Label) -> Vector3<f64> {
    let part = posterior.parts.iter().find(|part| part.label == label);
    part.map_or_else(Vector3::zeros, |part| part.com_in_world_m.into())
}

/// A joint's axis in world.
enum JointAxis {
    Slide { direction: Vector3<f64> },
    Hinge { direction: Vector3<f64>, point: Vector3<f64> },
}

impl JointAxis {
    /// `None` where the joint is rigid or its type open.
    fn of(joint: &Joint<'_>) -> Option<Self> {
        match joint.settled()? {
            "prismatic" => Some(Self::Slide { direction: joint.edge.prismatic.as_ref()?.axis_direction.into() }),
            "revolute" => {
                let axis = joint.edge.revolute.as_ref()?;
                Some(Self::Hinge { direction: axis.axis_direction.into(), point: axis.axis_point_m.into() })
            }
            _ => None,
        }
    }

    /// q of a displacement relative to the parent; turns go on from `last`.
    fn position(&self, relative: &Pose, center: &Vector3<f64>, last: f64) -> f64 {
        match self {
            Self::Slide { direction } => (relative.transform_point(center) - center).dot(direction),
            Self::Hinge { direction, .. } => relative.turn_about(direction, last),
        }
    }

    /// The generalized force of a wrench, the axis where it was at the first frame.
    fn force(&self, wrench: &AppliedWrench) -> f64 {
        match self {
            Self::Slide { direction } => direction.dot(&wrench.force_in_world),
            Self::Hinge { direction, point } => {
                let moment = wrench.torque_in_world + (wrench.point_in_world - point).cross(&wrench.force_in_world);
                direction.dot(&moment)
            }
        }
    }
}
