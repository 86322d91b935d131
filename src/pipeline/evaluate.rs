//! A saved object on a stream that it does not learn from: how far its predictions are off.

use std::collections::BTreeMap;

use super::explain::{explain_window, measure};
use super::{Learner, Pipeline, PipelineSettings, ResumeError, SavedObject, WindowJob};
use crate::math::Pose;
use crate::mechanism::{JointType, WrenchSample};
use crate::model::{PoseMeasurement, nearest_position};
use crate::registration::AlignmentSettings;
use crate::tracking::{MeasuredPath, ResidualSum, TrackedMechanism};
use crate::types::Label;

/// Points further from the surface where it is expected say nothing \[m\].
const GATE: f64 = 0.02;
/// The wrench acts this long before and after the contact's frames \[s\]: half a frame.
const CONTACT_MARGIN_S: f64 = 0.1;
/// Readings around the contact between which the force comes and goes \[s\].
const CONTACT_EDGE_S: f64 = 0.008;

/// How far one part was off.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct PartScore {
    /// Windows in which it moved or should have.
    pub windows: usize,
    /// Whether its joint turns: forces are in N·m then.
    pub turns: bool,
    /// By the model as first declared, and with the effects that criticism added.
    pub residuals: [ResidualSum; 2],
}

/// The scores of a stream.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Windows that closed.
    pub windows: usize,
    /// By part, those that were scored.
    pub parts: BTreeMap<Label, PartScore>,
}

/// Scoring under way.
#[derive(Debug)]
pub(super) struct Scoring {
    horizon_s: f64,
    scores: Scores,
}

impl Pipeline {
    /// A pipeline that scores a saved object over spans of `horizon_s` and does not learn.
    ///
    /// # Errors
    /// If the settings contradict what was saved.
    pub fn evaluate(settings: PipelineSettings, saved: SavedObject, horizon_s: f64) -> Result<Self, ResumeError> {
        let mut pipeline = Self::resume(settings, saved)?;
        pipeline.scoring = Some(Scoring { horizon_s, scores: Scores::default() });
        Ok(pipeline)
    }

    /// The scores so far; `None` if it learns.
    pub fn scores(&self) -> Option<&Scores> {
        self.scoring.as_ref().map(|scoring| &scoring.scores)
    }
}

impl Scoring {
    /// Scores a window; where its parts ended is all that the object takes from it.
    pub(super) fn score(&mut self, learner: &mut Learner, job: &WindowJob) {
        self.scores.windows += 1;
        let path = learner.measured_path(job);
        let Some(fit) = &learner.fit else { return };
        let Some(full) = TrackedMechanism::new(fit, &learner.dynamics, 1.0) else { return };
        let Some(declared) = full.without_effects() else { return };
        let residuals = [&declared, &full].map(|mechanism| path.residuals(mechanism, self.horizon_s));
        for (index, joint) in full.joints.iter().enumerate() {
            let [Some(before), Some(after)] = [residuals[0][index], residuals[1][index]] else { continue };
            let part = self.scores.parts.entry(joint.child).or_default();
            part.windows += 1;
            part.turns = joint.joint_type == JointType::Revolute;
            part.residuals[0].add(&before);
            part.residuals[1].add(&after);
        }
    }
}

impl Learner {
    /// Where the known joints were in a window's frames, each part measured against its model.
    fn measured_path(&mut self, job: &WindowJob) -> MeasuredPath {
        let motions = explain_window(&self.scene(job));
        let settings = AlignmentSettings { gate: GATE, ..AlignmentSettings::default() };
        for (label, motion) in &motions {
            if let Some(end) = motion.displacements.last() {
                self.displacements.insert(*label, *end);
            }
        }
        let joints = self.joints().to_vec();
        let mut tracks: Vec<Vec<Pose>> = Vec::new();
        let mut positions: Vec<Vec<f64>> = Vec::new();
        for joint in &joints {
            let start = self.displacements.get(&joint.child).copied().unwrap_or_else(Pose::identity);
            let parent = |k: usize| joint.parent.map_or_else(Pose::identity, |p| tracks[p][k]);
            let screw = joint.screw();
            let mut last = 0.0;
            let path: Vec<f64> = (0..job.frames.len())
                .map(|k| {
                    let expected = motions.get(&joint.child).map_or(start, |motion| motion.displacements[k]);
                    let scan = job.frames[k].scans.get(&joint.child);
                    let seen = self.models.get(&joint.child).zip(scan);
                    let seen = seen.and_then(|(model, scan)| measure(model, scan, &expected, &settings));
                    if let Some(measured) = seen {
                        let displacement = parent(k).inverse() * measured.displacement;
                        last = nearest_position(joint, &screw, &PoseMeasurement { displacement, ..measured }, last);
                    }
                    last
                })
                .collect();
            let track: Vec<Pose> = path.iter().enumerate().map(|(k, q)| parent(k) * screw.displacement(*q)).collect();
            if let Some(end) = track.last() {
                self.displacements.insert(joint.child, *end);
            }
            tracks.push(track);
            positions.push(path);
        }
        let touched = job.contacts.iter().find(|contact| !contact.track.is_empty());
        let touched = touched.and_then(|contact| joints.iter().position(|joint| joint.child == contact.label));
        MeasuredPath {
            times_s: job.frames.iter().map(|frame| frame.time_s).collect(),
            positions,
            samples: self.contact_wrench(job),
            touched,
        }
    }

    /// The readings while the tool holds a part, zero before and after.
    fn contact_wrench(&self, job: &WindowJob) -> Vec<WrenchSample> {
        let Some(contact) = job.contacts.iter().find(|contact| !contact.track.is_empty()) else { return Vec::new() };
        let time = |entry: Option<&(usize, nalgebra::Vector3<f64>, f64)>| {
            entry.and_then(|(k, _, _)| job.frames.get(*k)).map_or(0.0, |frame| frame.time_s)
        };
        let span = time(contact.track.first()) - CONTACT_MARGIN_S..=time(contact.track.last()) + CONTACT_MARGIN_S;
        let offset = self.fit.as_ref().map_or_else(nalgebra::Vector3::zeros, |fit| fit.tool_offset);
        let reading = |wrench: &crate::types::AppliedWrench| WrenchSample {
            stamp_s: wrench.stamp.seconds_since(job.zero),
            point_in_world: wrench.point_in_world - offset,
            force_in_world: wrench.force_in_world,
            torque_in_world: wrench.torque_in_world,
        };
        let mut samples: Vec<WrenchSample> =
            job.wrenches.iter().map(reading).filter(|sample| span.contains(&sample.stamp_s)).collect();
        let none = |sample: &WrenchSample, shift_s: f64| WrenchSample {
            stamp_s: sample.stamp_s + shift_s,
            force_in_world: nalgebra::Vector3::zeros(),
            torque_in_world: nalgebra::Vector3::zeros(),
            ..*sample
        };
        if let (Some(first), Some(last)) = (samples.first().copied(), samples.last().copied()) {
            samples.insert(0, none(&first, -CONTACT_EDGE_S));
            samples.push(none(&last, CONTACT_EDGE_S));
        }
        samples
    }
}
