//! A saved object on a stream that it does not learn from: what its models leave unexplained.
//!
//! Each window is measured with the axes as they were learned, and scored by the declared physics and by
//! every model on criticism's way from there, all fitted to the same windows of the saved object: the
//! residual force, and what simulation over one horizon from smoothed states is off by.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::explain::{explain_contacts, measure};
use super::{Learner, Pipeline, PipelineSettings, ResumeError, SavedObject, WindowJob};
use crate::criticism::Stage;
use crate::math::Pose;
use crate::mechanism::JointType;
use crate::model::{BatchWindow, DynamicsInput, PoseMeasurement, WindowObservations, WindowResidual, nearest_position};
use crate::registration::AlignmentSettings;
use crate::types::{Label, Stamp};

/// Points further from the surface where it is expected say nothing \[m\].
const GATE: f64 = 0.02;

/// Residual forces are means over this \[s\].
const FORCE_SPAN_S: f64 = 0.04;

/// Squares of one part's residuals under one model, summed over windows in which it moved.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct PartScore {
    /// Windows in which it moved.
    pub windows: usize,
    /// Whether its joint turns: forces are in N·m then.
    pub turns: bool,
    /// The part's radius about its axis \[m\]: what turns are counted by as positions.
    pub radius_m: f64,
    /// Squared forces by time \[N² s or (N·m)² s\], and the time \[s\].
    pub force: (f64, f64),
    /// Squared joint positions \[m² or rad²\], and how many.
    pub position: (f64, usize),
    /// The residual force by time, position and rate.
    pub residuals: Vec<ResidualSample>,
}

/// A residual force at a moment.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct ResidualSample {
    /// Since time zero \[s\].
    pub time_s: f64,
    /// Joint position \[m or rad\].
    pub position: f64,
    /// Joint rate \[m/s or rad/s\].
    pub rate: f64,
    /// What the model lacks \[N or N·m\].
    pub force: f64,
}

/// The scores of one model.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct StageScore {
    /// What the model has beyond the declared physics: part (none for the sensor) and name.
    pub effects: Vec<(Option<Label>, &'static str)>,
    /// By part, those that moved.
    pub parts: BTreeMap<Label, PartScore>,
    /// What it says of their joints, by name; see [`crate::model::Mechanism::values`].
    pub values: BTreeMap<Label, BTreeMap<String, f64>>,
}

/// The scores of a stream.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct Scores {
    /// Windows that closed.
    pub windows: usize,
    /// The declared physics first, what was selected last.
    pub stages: Vec<StageScore>,
}

/// Scoring under way.
#[derive(Debug)]
pub(super) struct Scoring {
    horizon_s: f64,
    scores: Scores,
    models: Option<Vec<Stage>>,
}

impl Pipeline {
    /// A pipeline that scores a saved object over spans of `horizon_s` and does not learn.
    ///
    /// # Errors
    /// If the settings contradict what was saved.
    pub fn evaluate(mut settings: PipelineSettings, saved: SavedObject, horizon_s: f64) -> Result<Self, ResumeError> {
        settings.poses.rate_hz = settings.poses.rate_hz.max(settings.poses.evaluation_rate_hz);
        let mut pipeline = Self::resume(settings, saved)?;
        pipeline.scoring = Some(Scoring { horizon_s, scores: Scores::default(), models: None });
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
        let models = self.models.get_or_insert_with(|| learner.stages(job.zero));
        if let Some(window) = learner.unlearned_window(job) {
            self.scores.add(models, &window, learner, self.horizon_s);
        }
    }
}

impl Scores {
    fn add(&mut self, models: &[Stage], window: &BatchWindow, learner: &Learner, horizon_s: f64) {
        self.stages.resize_with(models.len(), StageScore::default);
        for (model, stage) in models.iter().zip(&mut self.stages) {
            stage.effects.clone_from(&model.effects);
            let residual =
                model.hypothesis.window(window, model.noise_scale).residual(&model.x, horizon_s, FORCE_SPAN_S);
            match residual {
                Ok(residual) => stage.add(model, &residual, window, learner),
                Err(failure) => tracing::warn!(%failure, effects = ?model.effects, "a window is not scored"),
            }
        }
    }
}

impl StageScore {
    fn add(&mut self, model: &Stage, residual: &WindowResidual, window: &BatchWindow, learner: &Learner) {
        for (column, &index) in window.moving.iter().enumerate() {
            let Some(joint) = learner.joints().get(index) else { continue };
            let values = || model.hypothesis.mechanism.values(index, &model.x);
            self.values.entry(joint.child).or_insert_with(values);
            let part = self.parts.entry(joint.child).or_default();
            part.windows += 1;
            part.turns = joint.joint_type == JointType::Revolute;
            part.radius_m = joint.radius;
            for ((time_s, length_s, force), (position, rate)) in residual.forces.iter().zip(&residual.states) {
                let force = force[column];
                part.force.0 += length_s * force.powi(2);
                part.force.1 += length_s;
                let (position, rate) = (position[column], rate[column]);
                part.residuals.push(ResidualSample { time_s: *time_s, position, rate, force });
            }
            part.position.0 += residual.squares[column].0;
            part.position.1 += residual.squares[column].1;
        }
    }
}

impl Learner {
    /// Scores the models on criticism's way on the windows that they were fitted to. `zero`: what times
    /// count from.
    pub fn fitted_scores(&self, zero: Stamp, horizon_s: f64) -> Scores {
        let mut scores = Scores { windows: self.windows.len(), stages: Vec::new() };
        let Some(fit) = &self.fit else { return scores };
        let models = self.stages(zero);
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        for window in self.dynamics.batch(fit, &self.input(&windows, zero), (usize::MAX, usize::MAX), true) {
            scores.add(&models, &window, self, horizon_s);
        }
        scores
    }

    fn input<'a>(&'a self, windows: &'a [&'a WindowObservations], zero: Stamp) -> DynamicsInput<'a> {
        DynamicsInput { windows, contacts: &[], zero, parts: &self.hulls, use_tool: self.use_tool }
    }

    /// The models on criticism's way; none where nothing could be fitted. `zero`: what times count from.
    fn stages(&self, zero: Stamp) -> Vec<Stage> {
        let Some(fit) = &self.fit else { return Vec::new() };
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let input = self.input(&windows, zero);
        self.critic.stages(&self.dynamics, fit, &input).unwrap_or_else(|failure| {
            tracing::warn!(%failure, "the saved model cannot be fitted to its windows");
            Vec::new()
        })
    }

    /// A window in joint space, measured with the joints as they are known; `None` where none moves.
    fn unlearned_window(&mut self, job: &WindowJob) -> Option<BatchWindow> {
        let (posed, mut poses) = self.posed_motions(job);
        let bound = job.wrenches.iter().any(|wrench| wrench.part.is_some());
        let (motions, contacts) = explain_contacts(&self.scene(job), &posed, !bound);
        let direct = poses.keys().filter_map(|label| Some((*label, self.posed.get(label)?.information))).collect();
        for (label, motion) in &motions {
            if let Some(end) = motion.displacements.last() {
                self.displacements.insert(*label, *end);
            }
        }
        let settings = AlignmentSettings { gate: GATE, ..AlignmentSettings::default() };
        let joints = self.joints().to_vec();
        let mut tracks: Vec<Vec<Pose>> = Vec::new();
        let mut positions: Vec<Vec<f64>> = Vec::new();
        for joint in &joints {
            let start = self.displacements.get(&joint.child).copied().unwrap_or_else(Pose::identity);
            let seen = poses.entry(joint.child).or_insert_with(|| {
                let measured = |(k, frame): (usize, &super::Frame)| {
                    let expected = motions.get(&joint.child).map_or(start, |motion| motion.displacements[k]);
                    measure(self.models.get(&joint.child)?, frame.scans.get(&joint.child)?, &expected, &settings)
                };
                job.frames.iter().enumerate().map(measured).collect()
            });
            let parent = |k: usize| joint.parent.map_or_else(Pose::identity, |p| tracks[p][k]);
            let screw = joint.screw();
            let mut last = None;
            let mut path: Vec<f64> = Vec::with_capacity(job.frames.len());
            for (k, measured) in seen.iter().enumerate() {
                if let Some(measured) = measured {
                    let displacement = parent(k).inverse() * measured.displacement;
                    let measured = PoseMeasurement { displacement, ..*measured };
                    let near = last.unwrap_or_else(|| nearest_position(joint, &screw, &measured, 0.0));
                    last = Some(nearest_position(joint, &screw, &measured, near));
                }
                path.push(last.unwrap_or(0.0));
            }
            let track: Vec<Pose> = path.iter().enumerate().map(|(k, q)| parent(k) * screw.displacement(*q)).collect();
            if let Some(end) = track.last() {
                self.displacements.insert(joint.child, *end);
            }
            tracks.push(track);
            positions.push(path);
        }
        let mut fit = self.fit.clone()?;
        let point_of = |contact: &crate::model::Contact| {
            let joint = joints.iter().position(|joint| joint.child == contact.label);
            let at = |(frame, x, _): &(usize, Vector3<f64>, f64)| {
                let displacement = joint.map_or_else(Pose::identity, |joint| tracks[joint][*frame]);
                displacement.inverse().transform_point(&(x - fit.tool_offset))
            };
            contact.track.iter().map(at).sum::<Vector3<f64>>() / contact.track.len().max(1) as f64
        };
        let points: Vec<Vector3<f64>> = contacts.iter().map(point_of).collect();
        fit.contact_points.push(points);
        fit.positions.push(positions);
        let observations = WindowObservations {
            times_s: job.frames.iter().map(|frame| frame.time_s).collect(),
            contacts: if self.use_tool { contacts.clone() } else { Vec::new() },
            wrenches: job.wrenches.clone(),
            direct,
            poses,
            ..WindowObservations::default()
        };
        let windows: Vec<&WindowObservations> = self.windows.iter().chain([&observations]).collect();
        let input = DynamicsInput {
            windows: &windows,
            contacts: &contacts,
            zero: job.zero,
            parts: &self.hulls,
            use_tool: self.use_tool,
        };
        self.dynamics.unlearned_window(&fit, &input)
    }
}
