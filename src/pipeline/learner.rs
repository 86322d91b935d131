//! What has been learned of the object, window by window: the worker side of the pipeline.

mod weighing;

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;

use nalgebra::Vector3;
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

pub use weighing::ParentEvidence;

use super::Frame;
use super::explain::{Baseline, Motion, Scene, explain_contacts, measure_faces, rays_past, travel};
use super::keyframes::Keyframes;
use super::poses::{POSED_RADIUS, PosedPart, measured_motion};
use crate::criticism::{Critic, ForetoldWindow};
use crate::geometry::{HullProperties, hull_properties};
use crate::inference::SamplingSettings;
use crate::math::Pose;
use crate::model::{
    Axis, Contact, EdgePart, KinematicFit, KinematicJoint, KinematicSettings, PoseMeasurement, WindowObservations,
    fit_kinematics,
};
use crate::model::{DynamicsInput, DynamicsLearner, DynamicsPosterior, WindowInference};
use crate::registration::{
    AlignmentSettings, Face, PartModel, ScanPoint, Suggestion, Surfel, SurfelAccumulator, motion_cost, rays_near,
    suggested_direction, thinned_cost,
};
use crate::types::posterior::WindowRecord;
use crate::types::{AppliedWrench, Label, pairs};

/// A part moved if it ever travelled further than this \[m\].
pub(super) const MOVED: f64 = 0.006;

/// A part that stays within this of its place on its parent rests there \[m\].
const RESTS: f64 = 1e-6;
/// A window that is explained well counts this much against one that is not.
const WELL_AGAINST_BADLY: f64 = 20.0;
/// The least probability that a part's evidence stands on a wrong explanation.
const LEAST_DOUBT: f64 = 1e-3;
/// A part's model stands while its keyframes stay within this of where it has them \[m\].
const REBUILT: f64 = 0.0003;
/// Windows whose frames are kept for measuring again, of at most so many points in all: 84 MB.
const KEPT_FRAMES: usize = 8;
const KEPT_POINTS: usize = 1_500_000;
/// Frames in which a part is measured in a window that it rests through: they share their error.
const RESTING_FRAMES: usize = 20;
/// A part is measured again where a later fit has moved it by more than this \[m\].
const MEASURED_AGAIN: f64 = 0.002;

/// One closed window, ready to be learned.
#[derive(Clone, Debug, Default)]
pub struct WindowJob {
    /// Its frames.
    pub frames: Vec<Frame>,
    /// The tool's contacts on those frames.
    pub contacts: Vec<Contact>,
    /// Wrench readings from before the window to after it.
    pub wrenches: Vec<AppliedWrench>,
    /// Time zero.
    pub zero: crate::types::Stamp,
}

impl WindowJob {
    /// Seconds since time zero of its first and last frame.
    pub fn span_s(&self) -> (f64, f64) {
        let time = |frame: Option<&Frame>| frame.map_or(0.0, |frame| frame.time_s);
        (time(self.frames.first()), time(self.frames.last()))
    }
}

/// In how many windows a part's motion was explained, and in how many it was not; some in part.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
struct Explained {
    well: f64,
    badly: f64,
}

impl Explained {
    /// Probability that the evidence stands on a wrong explanation.
    fn doubt(&self) -> f64 {
        self.share_badly().max(LEAST_DOUBT)
    }

    /// The share of what was explained badly, a window that was explained well weighing more.
    fn share_badly(&self) -> f64 {
        if self.badly > 0.0 { self.badly / (self.badly + WELL_AGAINST_BADLY * self.well) } else { 0.0 }
    }
}

/// Kinematic state of everything learned.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct Learner {
    /// The part fixed to the world.
    pub root: Label,
    /// How the published dynamics are sampled; `None`: they are SVI's own.
    #[serde(skip)]
    pub sampling: Option<SamplingSettings>,
    /// Time zero of the windows, once there is one.
    #[serde(skip)]
    zero: Option<crate::types::Stamp>,
    /// Of how many streams the object had been learned before this one.
    #[serde(default)]
    pub streams: usize,
    /// Whether it was given: else it is what the evidence says, and may change.
    pub root_is_given: bool,
    /// A name for the world, for when it is none of the parts.
    pub world: Option<Label>,
    /// Whether the tool's position is an observation.
    pub use_tool: bool,
    /// Reference models; saved apart.
    #[serde(skip)]
    pub models: BTreeMap<Label, PartModel>,
    /// Models of the first look.
    pub(super) reference: BTreeMap<Label, PartModel>,
    /// How well each part's motions were explained.
    explained: BTreeMap<Label, Explained>,
    /// Scans that the models grow from.
    pub(super) keyframes: BTreeMap<Label, Keyframes>,
    /// Frames by window, measured again where a later fit has a part elsewhere. Empty where forgotten;
    /// not saved.
    #[serde(skip)]
    pub(super) kept: Vec<Arc<Vec<Frame>>>,
    /// Where each part was when each window's scans were measured last.
    #[serde(skip)]
    pub(super) measured_at: BTreeMap<Label, Vec<Vec<Pose>>>,
    /// Where each part was in each window when all its edges were weighed last.
    #[serde(skip)]
    pub(super) weighed_at: BTreeMap<Label, Vec<Vec<Pose>>>,
    /// The faces of each part's first look, once they were asked for.
    #[serde(skip)]
    faces: BTreeMap<Label, Vec<Face>>,
    /// Where each model has its keyframes.
    #[serde(skip)]
    built_at: BTreeMap<Label, Vec<Option<Pose>>>,
    /// What scans cost at known poses.
    pub baselines: BTreeMap<Label, Baseline>,
    /// Parts that the tool has moved.
    pub(super) touched: BTreeSet<Label>,
    /// Parts that moved in windows gone by.
    pub(super) moved_before: BTreeSet<Label>,
    /// How many windows are kept in full.
    pub kept_windows: usize,
    /// Distance between the surfaces of each pair of parts at the first look \[m\], smaller label first.
    #[serde(with = "pairs")]
    gaps: BTreeMap<(Label, Label), f64>,
    /// Displacements after the last window.
    pub displacements: BTreeMap<Label, Pose>,
    /// The measurements of the windows that are kept.
    pub windows: Vec<WindowObservations>,
    /// Displacement of each part in each window's frames, as fitted.
    pub tracks: BTreeMap<Label, Vec<Vec<Pose>>>,
    /// Parts that moved, with the evidence for their parents.
    pub evidence: BTreeMap<Label, Vec<ParentEvidence>>,
    /// The likeliest joints, parents first, with the joint fit of all windows.
    pub fit: Option<KinematicFit>,
    /// Kinematic assumptions.
    pub settings: KinematicSettings,
    /// Friction, damping, inertia and end stops.
    pub dynamics: DynamicsLearner,
    /// What the dynamics lack.
    pub critic: Critic,
    /// What learning each window's dynamics gave.
    pub inferences: Vec<WindowInference>,
    /// Every window that was learned, kept or not.
    pub records: Vec<WindowRecord>,
    /// Hulls of the parts, as first seen.
    pub hulls: BTreeMap<Label, HullProperties>,
    /// Parts whose pose a topic measures, as first seen; they have models without surfels.
    pub posed: BTreeMap<Label, PosedPart>,
}

impl Learner {
    /// Nothing learned yet: models from the scans accumulated at the reference configuration.
    pub fn new(root: Label, use_tool: bool, accumulators: BTreeMap<Label, SurfelAccumulator>) -> Self {
        let reference: BTreeMap<Label, PartModel> =
            accumulators.iter().filter_map(|(label, a)| Some((*label, PartModel::new(&a.surfels())?))).collect();
        let gaps = surface_gaps(&reference);
        Self {
            root,
            sampling: None,
            zero: None,
            streams: 0,
            root_is_given: true,
            world: None,
            use_tool,
            models: reference.clone(),
            reference,
            keyframes: BTreeMap::new(),
            touched: BTreeSet::new(),
            explained: BTreeMap::new(),
            moved_before: BTreeSet::new(),
            kept_windows: usize::MAX,
            kept: Vec::new(),
            measured_at: BTreeMap::new(),
            weighed_at: BTreeMap::new(),
            faces: BTreeMap::new(),
            built_at: BTreeMap::new(),
            gaps,
            baselines: BTreeMap::new(),
            displacements: BTreeMap::new(),
            windows: Vec::new(),
            tracks: BTreeMap::new(),
            evidence: BTreeMap::new(),
            fit: None,
            settings: KinematicSettings::default(),
            dynamics: DynamicsLearner::new(Vector3::new(0.0, 0.0, -9.81)),
            critic: Critic::default(),
            inferences: Vec::new(),
            records: Vec::new(),
            hulls: BTreeMap::new(),
            posed: BTreeMap::new(),
        }
    }

    /// Adds a part whose pose a topic measures, where it was at the reference configuration.
    pub fn add_posed(&mut self, label: Label, part: PosedPart) {
        let origin = part.world_from_frame.translation;
        self.models.insert(label, PartModel::of_frame(origin, POSED_RADIUS));
        self.hulls.insert(label, HullProperties::guess(origin, POSED_RADIUS));
        self.posed.insert(label, part);
    }

    /// Adds the parts whose poses are measured for the first time.
    fn meet_posed(&mut self, job: &WindowJob) {
        for (label, seen) in job.frames.iter().flat_map(|frame| &frame.poses) {
            // A part that was not there at the first look is taken to have been at rest until now.
            if !self.posed.contains_key(label) {
                let part = PosedPart { world_from_frame: seen.world_from_frame, information: seen.information };
                self.add_posed(*label, part);
            }
        }
        for label in self.posed.keys() {
            // Windows before it was seen.
            let rested = |window: &WindowObservations| vec![Pose::identity(); window.times_s.len()];
            self.tracks.entry(*label).or_insert_with(|| self.windows.iter().map(rested).collect());
        }
    }

    /// The motions that pose topics measured in a window, with the measurements.
    pub(super) fn posed_motions(
        &self,
        job: &WindowJob,
    ) -> (BTreeMap<Label, Motion>, BTreeMap<Label, Vec<Option<PoseMeasurement>>>) {
        let (mut motions, mut all) = (BTreeMap::new(), BTreeMap::new());
        let fixed = |label: &Label| self.root_is_given && *label == self.root;
        for (label, part) in self.posed.iter().filter(|(label, _)| !fixed(label)) {
            let measured: Vec<_> =
                job.frames.iter().map(|f| f.poses.get(label).map(|seen| part.measurement(seen))).collect();
            let start = self.displacements.get(label).copied().unwrap_or_else(Pose::identity);
            motions.insert(*label, measured_motion(&start, &part.world_from_frame.translation, &measured));
            all.insert(*label, measured);
        }
        (motions, all)
    }

    /// The likeliest joints so far, parents first.
    pub fn joints(&self) -> &[KinematicJoint] {
        self.fit.as_ref().map_or(&[], |fit| &fit.joints)
    }

    /// Probability that a part's evidence stands on a wrong explanation of its windows.
    pub fn doubt(&self, label: Label) -> f64 {
        self.explained.get(&label).copied().unwrap_or_default().doubt()
    }

    /// The part of that which stands on windows that were explained badly: none where all were explained well.
    pub(super) fn doubt_beyond_least(&self, label: Label) -> f64 {
        self.explained.get(&label).copied().unwrap_or_default().share_badly()
    }

    /// What a part's scan costs at a known pose.
    pub(super) fn usual_cost(&self, label: Label) -> f64 {
        self.baselines.get(&label).map_or(0.0, |baseline| baseline.cost)
    }

    /// Least and greatest position of each joint of the likeliest tree in the windows learned, by child
    /// \[m or rad\].
    pub fn ranges_seen(&self) -> BTreeMap<Label, (f64, f64)> {
        let Some(fit) = &self.fit else { return BTreeMap::new() };
        let range = |joint: usize| {
            let seen = fit.positions.iter().filter_map(|window| window.get(joint)).flatten().copied();
            seen.fold((0.0, 0.0), |(least, greatest): (f64, f64), q| (least.min(q), greatest.max(q)))
        };
        fit.joints.iter().enumerate().map(|(index, joint)| (joint.child, range(index))).collect()
    }

    /// Sets the baselines that are not known yet from frames at the reference configuration.
    pub fn calibrate(&mut self, frames: &[Frame]) {
        for (label, model) in &mut self.reference {
            if self.baselines.contains_key(label) {
                continue;
            }
            let scans: Vec<(&[ScanPoint], Vec<ScanPoint>)> = frames
                .iter()
                .filter_map(|frame| {
                    let others = frame.scans.iter().filter(|(other, _)| *other != label).flat_map(|(_, scan)| scan);
                    Some((frame.scans.get(label)?.as_slice(), rays_near(others, &model.centroid, model.reach())))
                })
                .collect();
            model.calibrate_outlines(&scans);
            self.models.insert(*label, model.clone());
        }
        for (label, model) in &self.models {
            if self.baselines.contains_key(label) {
                continue;
            }
            let scans: Vec<&Vec<ScanPoint>> =
                frames.iter().filter_map(|f| f.scans.get(label)).filter(|scan| !scan.is_empty()).collect();
            if scans.is_empty() {
                continue;
            }
            let count = scans.len() as f64;
            let mean = |cost: fn(&PartModel, &[ScanPoint], &Pose) -> f64| {
                scans.iter().map(|scan| cost(model, scan, &Pose::identity())).sum::<f64>() / count
            };
            self.baselines.insert(
                *label,
                Baseline {
                    cost: mean(thinned_cost),
                    motion_cost: mean(motion_cost),
                    points: scans.iter().map(|scan| scan.len() as f64).sum::<f64>() / count,
                },
            );
        }
    }

    /// What a window's motion is explained with.
    pub(super) fn scene<'a>(&'a self, job: &'a WindowJob) -> Scene<'a> {
        Scene {
            frames: &job.frames,
            contacts: &job.contacts,
            models: &self.models,
            baselines: &self.baselines,
            start: &self.displacements,
            joints: self.joints(),
            touched_before: &self.touched,
            root: Some(self.root),
            use_tool: self.use_tool,
            free: BTreeMap::new(),
            still: BTreeMap::new(),
        }
    }

    /// Learns one window.
    pub fn learn(&mut self, job: &WindowJob) {
        let contacts = self.learn_motion(job);
        self.learn_physics(job, &contacts);
        self.retire();
    }

    /// What a window says of the parts, their motions and the joints between them; returns the contacts. None of
    /// it depends on the physics.
    pub(super) fn learn_motion(&mut self, job: &WindowJob) -> Vec<Contact> {
        self.meet_posed(job);
        let (measured, poses) = self.posed_motions(job);
        let scene = self.scene(job);
        let doubted = !self.root_is_given && !measured.contains_key(&self.root) && scene.has_left(self.root);
        let scene = Scene { root: (!doubted).then_some(self.root), ..scene };
        let bound = job.wrenches.iter().any(|wrench| wrench.tool && wrench.part.is_some());
        let (motions, contacts) = explain_contacts(&scene, &measured, !bound);
        let direct = poses.keys().filter_map(|label| Some((*label, self.posed.get(label)?.information))).collect();
        for (label, motion) in &motions {
            // What goes along with another part says nothing of its own joint.
            let rides = self.rides(*label, motion, &motions);
            let explained = self.explained.entry(*label).or_default();
            let Some(share) = motion.explained else { continue };
            explained.badly += 1.0 - share;
            if motion.moved && !rides {
                explained.well += share;
            }
        }
        let observations = WindowObservations {
            times_s: job.frames.iter().map(|f| f.time_s).collect(),
            contacts: if self.use_tool { contacts.clone() } else { Vec::new() },
            wrenches: job.wrenches.clone(),
            direct,
            poses,
            stream: self.streams,
            ..WindowObservations::default()
        };
        for (label, motion) in &motions {
            tracing::debug!(%label, moved = motion.moved, excess = motion.excess, seed = ?motion.seed, "motion");
        }
        let moved = |label: &Label| motions.get(label).is_some_and(|m| m.moved);
        self.touched.extend(contacts.iter().map(|c| c.label).filter(moved));
        for (label, motion) in &motions {
            self.tracks.entry(*label).or_default().push(motion.displacements.clone());
        }
        // What was taken for the root may turn out to be none: it has a track like the others.
        let rested = self.models.keys().filter(|label| !self.root_is_given && !motions.contains_key(label));
        for label in rested {
            let place = self.displacements.get(label).copied().unwrap_or_else(Pose::identity);
            self.tracks.entry(*label).or_default().push(vec![place; job.frames.len()]);
        }
        self.windows.push(observations);
        self.grow(job, &motions);
        let last = self.windows.len() - 1;
        for label in motions.keys() {
            self.measure(*label, last, &job.frames);
        }
        self.keep(job);
        self.weigh_edges(&motions);
        self.fit_joints();
        self.rebuild_models();
        let labels: Vec<Label> = self.joints().iter().map(|j| j.child).collect();
        for label in labels {
            self.measure(label, last, &job.frames);
            self.measure_again(label);
        }
        self.fit_joints();
        for (label, tracks) in &self.tracks {
            if let Some(end) = tracks.last().and_then(|t| t.last()) {
                self.displacements.insert(*label, *end);
            }
        }
        self.choose_root();
        for (label, model) in &self.models {
            let points: Vec<Vector3<f64>> = model.surfels.iter().map(|s| s.point).collect();
            if let Some(hull) = hull_properties(&points, None) {
                self.hulls.insert(*label, hull);
            }
        }
        contacts
    }

    /// What the same window says of dynamics, and what those lack.
    pub(super) fn learn_physics(&mut self, job: &WindowJob, contacts: &[Contact]) {
        let foretold = self.learn_dynamics(job, contacts);
        self.review(job, contacts, foretold);
    }

    /// Takes over the physics of one that has learned them of all windows but the newest.
    pub(super) fn take_physics_of(&mut self, other: &Self) {
        self.dynamics.clone_from(&other.dynamics);
        self.critic.clone_from(&other.critic);
        self.inferences.clone_from(&other.inferences);
        self.records.clone_from(&other.records);
    }

    /// Whether a part keeps its place on the one that carries it.
    fn rides(&self, label: Label, motion: &Motion, motions: &BTreeMap<Label, Motion>) -> bool {
        let (Some(model), Some(carrier)) = (self.models.get(&label), motion.carrier.and_then(|c| motions.get(&c)))
        else {
            return false;
        };
        let mut relative = carrier.displacements.iter().zip(&motion.displacements).map(|(c, own)| c.inverse() * *own);
        relative.next().is_some_and(|first| relative.all(|place| travel(model, &first, &place) < RESTS))
    }

    /// What a window says of the dynamics by the physics known so far. Returns how it was foretold, for its review.
    pub(super) fn learn_dynamics(&mut self, job: &WindowJob, contacts: &[Contact]) -> Option<ForetoldWindow> {
        let mut foretold = None;
        if let Some(fit) = &self.fit {
            self.zero = Some(job.zero);
            let windows: Vec<&WindowObservations> = self.windows.iter().collect();
            let input = DynamicsInput {
                windows: &windows,
                contacts,
                zero: job.zero,
                parts: &self.hulls,
                use_tool: self.use_tool,
            };
            let before = self.critic.foretell(&self.dynamics, fit, &input);
            let inference = self.dynamics.learn_window(fit, &input);
            foretold = before.map(|window| window.learned(&inference));
            self.inferences.push(inference);
        } else {
            self.inferences.push(WindowInference::default());
            self.dynamics.keep_window(contacts);
        }
        self.record(job);
        foretold
    }

    /// What the dynamics lack, by all windows so far.
    pub(super) fn review(&mut self, job: &WindowJob, contacts: &[Contact], foretold: Option<ForetoldWindow>) {
        let Some(fit) = &self.fit else { return };
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let input =
            DynamicsInput { windows: &windows, contacts, zero: job.zero, parts: &self.hulls, use_tool: self.use_tool };
        let steps = self.critic.review(&mut self.dynamics, fit, &input, foretold).unwrap_or_else(|failure| {
            tracing::info!(%failure, "no physics could be fitted to all windows: they are not called adequate");
            self.critic.note_failure();
            0
        });
        if let Some(inference) = self.inferences.last_mut() {
            inference.steps += steps;
        }
        if let Some(record) = self.records.last_mut() {
            record.steps += steps;
        }
    }

    /// The dynamics as they are published: by the engine that was asked for.
    pub(super) fn published_dynamics(&self) -> Option<DynamicsPosterior> {
        let (Some(settings), Some(fit), Some(zero)) = (&self.sampling, &self.fit, self.zero) else {
            return self.dynamics.posterior().ok();
        };
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let input =
            DynamicsInput { windows: &windows, contacts: &[], zero, parts: &self.hulls, use_tool: self.use_tool };
        match self.dynamics.sampled_posterior(fit, &input, settings) {
            Ok((posterior, report)) => {
                tracing::info!(?report, "dynamics sampled");
                Some(posterior)
            }
            Err(failure) => {
                tracing::warn!(%failure, "dynamics could not be sampled, SVI's stand");
                self.dynamics.posterior().ok()
            }
        }
    }

    /// Measures a part's poses in a window, about its track.
    fn measure(&mut self, label: Label, window: usize, frames: &[Frame]) {
        if self.posed.contains_key(&label) {
            return;
        }
        let settings = AlignmentSettings { gate: 0.02, ..AlignmentSettings::default() };
        let Some(track) = self.tracks.get(&label).and_then(|t| t.get(window)) else { return };
        let rests = track.windows(2).all(|pair| pair[0] == pair[1]);
        let every = if rests { frames.len().div_ceil(RESTING_FRAMES).max(1) } else { 1 };
        let one = |(k, (frame, displacement)): (usize, (&Frame, &Pose))| match (
            self.models.get(&label),
            frame.scans.get(&label),
        ) {
            (Some(model), Some(scan)) if k % every == 0 => {
                let past = rays_past(frame, label, model, displacement);
                measure_faces(model, scan, &past, displacement, &settings)
            }
            _ => [None; 2],
        };
        let faces: Vec<_> = frames.par_iter().zip(track).enumerate().map(one).collect();
        let measured_at = self.measured_at.entry(label).or_default();
        measured_at.resize(measured_at.len().max(window + 1), Vec::new());
        measured_at[window].clone_from(track);
        if let Some(window) = self.windows.get_mut(window) {
            window.poses.insert(label, faces.iter().map(|f| f[0]).collect());
            window.later_faces.insert(label, faces.iter().map(|f| f[1]).collect());
        }
    }

    /// Keeps the window's frames, and forgets those of the oldest window beyond what is kept.
    fn keep(&mut self, job: &WindowJob) {
        // Frames of windows that were saved and loaded are gone.
        self.kept.resize(self.windows.len().saturating_sub(1), Arc::default());
        self.kept.push(Arc::new(job.frames.clone()));
        let mut points = 0;
        for (age, window) in self.kept.iter_mut().rev().enumerate() {
            points += window.iter().flat_map(|frame| frame.scans.values()).map(Vec::len).sum::<usize>();
            if age >= KEPT_FRAMES || (age > 0 && points > KEPT_POINTS) {
                *window = Arc::default();
            }
        }
    }

    /// Measures a part again in the earlier windows where the fit has moved it since.
    fn measure_again(&mut self, label: Label) {
        let Some(model) = self.models.get(&label) else { return };
        let elsewhere: Vec<usize> = (0..self.windows.len() - 1)
            .filter(|&w| self.kept[w].iter().any(|frame| frame.scans.contains_key(&label)))
            .filter(|&w| {
                let Some(before) = self.measured_at.get(&label).and_then(|m| m.get(w)) else { return false };
                is_elsewhere(model, before, &self.tracks[&label][w])
            })
            .collect();
        for w in elsewhere {
            let frames = Arc::clone(&self.kept[w]);
            self.measure(label, w, &frames);
        }
    }

    fn part(&self, label: Label) -> EdgePart {
        let model = &self.models[&label];
        EdgePart { label, center: model.centroid, radius: model.radius }
    }

    fn ever_moved(&self, label: Label) -> bool {
        let model = &self.models[&label];
        self.moved_before.contains(&label)
            || self
                .tracks
                .get(&label)
                .is_some_and(|windows| windows.iter().flatten().any(|d| travel(model, &Pose::identity(), d) > MOVED))
    }

    /// A part that is met later than the others, with its surfels at the reference configuration.
    pub(super) fn add_part(&mut self, label: Label, model: PartModel) {
        let rested = self.windows.iter().map(|window| vec![Pose::identity(); window.times_s.len()]).collect();
        self.tracks.insert(label, rested);
        self.models.insert(label, model.clone());
        self.reference.insert(label, model);
        self.gaps = surface_gaps(&self.reference);
    }

    /// The root, where it was not given: the largest of the parts that never moved in world; if all
    /// did, the one that is seen to have gone least far.
    fn choose_root(&mut self) {
        if self.root_is_given {
            return;
        }
        let world = self.world;
        let farthest = |label: &Label| {
            let model = &self.models[label];
            let all = self.tracks.get(label).into_iter().flatten().flatten();
            all.map(|displacement| travel(model, &Pose::identity(), displacement)).fold(0.0, f64::max)
        };
        let size = |label: &Label| self.reference.get(label).map_or(0, |model| model.surfels.len());
        let still = self.models.keys().filter(|label| !self.ever_moved(**label));
        let largest = still.max_by_key(|label| (size(label), std::cmp::Reverse(**label)));
        let least_far = || self.models.keys().min_by(|a, b| farthest(a).total_cmp(&farthest(b)));
        if let Some(root) = largest.copied().or(world).or_else(|| least_far().copied()) {
            self.root = root;
        }
    }

    /// Fits all joints of the likeliest tree to all windows.
    fn fit_joints(&mut self) {
        let tree = self.likeliest();
        for label in tree.iter().map(|(child, ..)| *child).chain([self.root]) {
            if let (None, Some(model)) = (self.faces.get(&label), self.models.get(&label)) {
                self.faces.insert(label, model.faces());
            }
        }
        let index = |label: Label| tree.iter().position(|(l, ..)| *l == label);
        // An edge is fitted anew after every window and may find its axis the other way round; what
        // was learned of a joint counts along the direction that it had.
        let turned: Vec<bool> = tree
            .iter()
            .map(|(child, parent, joint_type, axis)| {
                self.joints().iter().any(|old| {
                    let old_parent = old.parent.map(|p| self.joints()[p].child);
                    (old.child, old_parent, old.joint_type) == (*child, *parent, *joint_type)
                        && old.axis.direction.dot(&axis.direction) < 0.0
                })
            })
            .collect();
        let sign = |joint: usize| if turned[joint] { -1.0 } else { 1.0 };
        let joints: Vec<KinematicJoint> = tree
            .iter()
            .enumerate()
            .map(|(joint, (child, parent, joint_type, axis))| {
                let part = self.part(*child);
                KinematicJoint {
                    parent: parent.and_then(index),
                    child: *child,
                    joint_type: *joint_type,
                    axis: Axis { direction: axis.direction * sign(joint), ..*axis },
                    center: part.center,
                    radius: part.radius,
                    suggested: self.suggestion(*child, *parent, &axis.direction),
                }
            })
            .collect();
        if joints.is_empty() {
            return;
        }
        let positions = (0..self.windows.len())
            .map(|w| {
                tree.iter()
                    .enumerate()
                    .map(|(joint, (child, parent, joint_type, _))| {
                        self.evidence_of(*child, *parent)
                            .and_then(|o| o.fits[*joint_type as usize].as_ref())
                            .map_or_else(
                                || vec![0.0; self.windows[w].times_s.len()],
                                |f| f.positions[w].iter().map(|q| q * sign(joint)).collect(),
                            )
                    })
                    .collect()
            })
            .collect();
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let fit = fit_kinematics(joints, positions, &windows, &self.settings);
        for (w, window) in self.windows.iter().enumerate() {
            for frame in 0..window.times_s.len() {
                for (joint, displacement) in fit.joints.iter().zip(fit.displacements(w, frame)) {
                    if let Some(track) = self.tracks.get_mut(&joint.child) {
                        track[w][frame] = displacement;
                    }
                }
            }
        }
        self.fit = Some(fit);
    }

    /// What the faces of a part, its parent and the root suggest for the part's axis.
    fn suggestion(&self, child: Label, parent: Option<Label>, axis: &Vector3<f64>) -> Option<Suggestion> {
        let labels: BTreeSet<Label> = [Some(child), parent, Some(self.root)].into_iter().flatten().collect();
        suggested_direction(labels.iter().filter_map(|label| self.faces.get(label).map(Vec::as_slice)), axis)
    }

    /// Keeps scans of the parts that moved, and grows their models.
    fn grow(&mut self, job: &WindowJob, motions: &BTreeMap<Label, Motion>) {
        let window = self.windows.len() - 1;
        for (label, _) in motions.iter().filter(|(_, motion)| motion.moved) {
            let scans = job.frames.iter().map(|frame| frame.scans.get(label));
            self.keyframes.entry(*label).or_default().keep(window, scans);
        }
        self.rebuild_models();
    }

    /// Models of the moving parts, from the first look and the keyframes where the fit has them now.
    fn rebuild_models(&mut self) {
        let rebuilt: Vec<(Label, PartModel, Vec<Option<Pose>>)> = self
            .keyframes
            .par_iter()
            .filter_map(|(label, keyframes)| {
                let first = self.reference.get(label)?;
                let places = keyframes.places(self.tracks.get(label).map_or(&[][..], Vec::as_slice));
                let stands = |built: &Vec<Option<Pose>>| {
                    built.len() == places.len()
                        && built.iter().zip(&places).all(|pair| match pair {
                            (Some(old), Some(new)) => travel(first, old, new) < REBUILT,
                            (old, new) => old.is_some() == new.is_some(),
                        })
                };
                if self.built_at.get(label).is_some_and(stands) {
                    return None;
                }
                let later = keyframes.accumulated(&places);
                Some((*label, first.grown(&later.surfels()), places))
            })
            .collect();
        for (label, model, places) in rebuilt {
            self.models.insert(label, model);
            self.built_at.insert(label, places);
        }
    }
}

/// Whether a part's track is not where it was, far enough for its scans to be measured again.
fn is_elsewhere(model: &PartModel, before: &[Pose], track: &[Pose]) -> bool {
    before.iter().zip(track).any(|(old, new)| travel(model, old, new) > MEASURED_AGAIN)
}

/// Smallest distance between the surfels of each pair of parts \[m\].
fn surface_gaps(parts: &BTreeMap<Label, PartModel>) -> BTreeMap<(Label, Label), f64> {
    let mut gaps = BTreeMap::new();
    for (first, PartModel { surfels, .. }) in parts {
        for (second, PartModel { surfels: others, .. }) in
            parts.range((std::ops::Bound::Excluded(*first), std::ops::Bound::Unbounded))
        {
            let nearest =
                |s: &Surfel| others.iter().map(|o| (o.point - s.point).norm_squared()).fold(f64::INFINITY, f64::min);
            let every = (surfels.len() / 400).max(1);
            let gap = surfels.iter().step_by(every).map(nearest).fold(f64::INFINITY, f64::min).sqrt();
            gaps.insert((*first, *second), gap);
        }
    }
    gaps
}
