//! Learned objects outlive a stream: what is saved, and how a new stream takes up from it.
//!
//! The saved object's frame, its reference configuration and its time go on. The first frame of the new
//! stream tells where the joints are now; parts that the object did not have are added as they stand.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::Frame;
use super::explain::{FEWEST_POINTS, grid_of};
use super::poses::{POSED_RADIUS, PosedPart};
use super::working_frame::WorkingFrame;
use super::{Learner, Output, Pipeline, PipelineSettings};
use crate::math::Pose;
use crate::model::KinematicJoint;
use crate::registration::{
    FromBehind, JointFrame, OUTLIER_COST, PartModel, ScanPoint, Surfel, SurfelAccumulator, search_path, thinned_cost,
    truncated_cost,
};
use crate::types::{Label, Stamp};

/// A part whose first scan costs this much more than it should is not where the object has it.
const UNEXPLAINED: f64 = 1.5;
/// Points that a joint's position is refined on.
const REFINING_POINTS: usize = 400;
/// A joint leaves where it was if that lowers the mean cost by this.
const LEAVES: f64 = 0.02;
/// A second.
const SECOND_NS: i64 = 1_000_000_000;

/// What was learned by a time, to be saved while the stream goes on.
#[derive(Clone)]
pub struct Snapshot {
    world_from_work: Pose,
    gravity_in_world: Vector3<f64>,
    zero: Stamp,
    newest: Stamp,
    learner: Arc<Learner>,
}

impl Snapshot {
    /// What is written of it.
    pub fn saved(&self) -> SavedObjectRef<'_> {
        let grown = |model: &PartModel| model.surfels.iter().filter(|surfel| surfel.grown).copied().collect();
        SavedObjectRef {
            world_from_work: self.world_from_work,
            gravity_in_world: self.gravity_in_world,
            zero: self.zero,
            newest: self.newest,
            grown: self.learner.models.iter().map(|(label, model)| (*label, grown(model))).collect(),
            learner: &self.learner,
        }
    }
}

/// What is saved, as it is written.
#[derive(Debug, Serialize)]
pub struct SavedObjectRef<'a> {
    world_from_work: Pose,
    gravity_in_world: Vector3<f64>,
    zero: Stamp,
    newest: Stamp,
    /// Surfels of each part that came into view later.
    grown: BTreeMap<Label, Vec<Surfel>>,
    learner: &'a Learner,
}

/// A learned object as it was saved.
#[derive(Debug, Deserialize)]
pub struct SavedObject {
    world_from_work: Pose,
    gravity_in_world: Vector3<f64>,
    zero: Stamp,
    newest: Stamp,
    grown: BTreeMap<Label, Vec<Surfel>>,
    learner: Learner,
}

/// Why a stream cannot go on from a saved object.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum ResumeError {
    /// Another root is asked for.
    #[error("its root is part {saved}, not {asked}")]
    Root {
        /// The saved object's.
        saved: Label,
        /// What the settings say.
        asked: Label,
    },
    /// Gravity points elsewhere: the world is another one.
    #[error("it was learned under gravity {saved:?} m/s², not {asked:?}")]
    Gravity {
        /// The saved object's.
        saved: [f64; 3],
        /// What the settings say.
        asked: [f64; 3],
    },
}

/// A saved object that waits for the first frame.
pub(super) struct Resumed {
    learner: Learner,
    zero: Stamp,
    offset_ns: i64,
}

impl SavedObject {
    /// The part fixed to the world.
    pub fn root(&self) -> Label {
        self.learner.root
    }

    /// What was learned.
    pub fn learner(&self) -> &Learner {
        &self.learner
    }
}

impl Pipeline {
    /// What was learned, for saving; `None` before the first window.
    pub fn snapshot(&self) -> Option<Snapshot> {
        let WorkingFrame::Known(world_from_work) = self.working_frame else { return None };
        Some(Snapshot {
            world_from_work,
            gravity_in_world: self.settings.gravity_in_world,
            zero: self.zero?,
            newest: self.newest?,
            learner: Arc::clone(self.known()?),
        })
    }

    /// A pipeline that goes on learning a saved object.
    ///
    /// # Errors
    /// If the settings contradict what was saved.
    pub fn resume(settings: PipelineSettings, saved: SavedObject) -> Result<Self, ResumeError> {
        let SavedObject { world_from_work, gravity_in_world, zero, newest, grown, mut learner } = saved;
        learner.restore_models(&grown);
        if let Some(asked) = settings.root.filter(|root| *root != learner.root) {
            return Err(ResumeError::Root { saved: learner.root, asked });
        }
        if (gravity_in_world - settings.gravity_in_world).norm() > 1e-9 {
            let (saved, asked) = (gravity_in_world.into(), settings.gravity_in_world.into());
            return Err(ResumeError::Gravity { saved, asked });
        }
        learner.settings = settings.kinematics;
        learner.use_tool = settings.use_tool;
        learner.kept_windows = settings.windows.kept;
        learner.sampling = settings.sampling;
        learner.root_is_given |= settings.root.is_some();
        // The new stream begins at the next full second but one.
        let offset_ns = ((newest.0 - zero.0) / SECOND_NS + 2) * SECOND_NS;
        let mut pipeline = Self::new(settings);
        pipeline.working_frame = WorkingFrame::Known(world_from_work);
        pipeline.begin_s = offset_ns as f64 * 1e-9;
        pipeline.resumed = Some(Box::new(Resumed { learner, zero, offset_ns }));
        Ok(pipeline)
    }

    /// The stamp that times count from, of a stream whose earliest is `first`.
    pub(super) fn time_zero(&self, first: Stamp) -> Stamp {
        Stamp(first.0 - self.resumed.as_ref().map_or(0, |resumed| resumed.offset_ns))
    }

    /// Takes up the saved object at its first frame; `zero` is what times count from now on.
    pub(super) fn take_up(&mut self, frame: &Frame, zero: Stamp) -> Option<Output> {
        let Resumed { mut learner, zero: old_zero, .. } = *self.resumed.take()?;
        for wrench in learner.windows.iter_mut().flat_map(|window| &mut window.wrenches) {
            wrench.stamp = Stamp(wrench.stamp.0 - old_zero.0 + zero.0);
        }
        learner.streams += 1;
        let positions = learner.locate(frame);
        let unexplained = learner.unexplained(frame);
        let unknown = frame.scans.keys().filter(|label| !learner.models.contains_key(label));
        let unknown: Vec<Label> = unknown.copied().collect();
        self.current = learner.displacements.clone();
        self.newcomers = (!unknown.is_empty()).then(Vec::new);
        if let Some(forecaster) = self.backlog.as_mut().and_then(|backlog| backlog.forecaster.as_mut()) {
            forecaster.resumed(&learner, frame.time_s, positions);
        }
        let root = learner.root;
        self.learner = Some(Arc::new(learner));
        Some(Output::Resumed { root, unexplained, unknown })
    }
}

impl Learner {
    /// The models, which are not saved: their faces of the first look are, and those of later.
    fn restore_models(&mut self, grown: &BTreeMap<Label, Vec<Surfel>>) {
        let model = |(label, first): (&Label, &PartModel)| match grown.get(label) {
            Some(grown) if !grown.is_empty() => (*label, first.with(grown)),
            _ => (*label, first.clone()),
        };
        self.models = self.reference.iter().map(model).collect();
        let frame = |part: &PosedPart| PartModel::of_frame(part.world_from_frame.translation, POSED_RADIUS);
        self.models.extend(self.posed.iter().map(|(label, part)| (*label, frame(part))));
    }

    /// Finds where the known joints are in a frame, parents first, and with them every part; returns
    /// their positions. What has no known joint stays where it was.
    fn locate(&mut self, frame: &Frame) -> Vec<f64> {
        let joints: Vec<KinematicJoint> = self.joints().to_vec();
        let last: Vec<f64> = (0..joints.len())
            .map(|joint| {
                self.fit.as_ref().and_then(|fit| fit.positions.last()?.get(joint)?.last().copied()).unwrap_or(0.0)
            })
            .collect();
        let mut positions = last;
        for (index, joint) in joints.iter().enumerate() {
            let parent = joint.parent.and_then(|p| self.displacements.get(&joints[p].child)).copied();
            let parent = parent.unwrap_or_else(Pose::identity);
            let scan = frame.scans.get(&joint.child).filter(|scan| scan.len() >= FEWEST_POINTS);
            if let (Some(model), Some(scan)) = (self.models.get(&joint.child), scan) {
                positions[index] = located(model, scan, joint, &parent, positions[index]);
            }
            self.displacements.insert(joint.child, parent * joint.screw().displacement(positions[index]));
        }
        positions
    }

    /// Parts of a frame that are not where they should be; the root, if it is not in the frame at all.
    fn unexplained(&self, frame: &Frame) -> Vec<Label> {
        let off = |(label, scan): (&Label, &Vec<ScanPoint>)| {
            let model = self.models.get(label).filter(|_| scan.len() >= FEWEST_POINTS)?;
            let displacement = self.displacements.get(label).copied().unwrap_or_else(Pose::identity);
            let usual = self.usual_cost(*label);
            // New faces match nothing, and that is no contradiction: what counts is where the points would
            // match if the part were where it should be.
            let cost = thinned_cost(model, scan, &displacement);
            (cost - usual > UNEXPLAINED.min(0.5 * (OUTLIER_COST - usual))).then_some(*label)
        };
        // A name for the world is nothing to be seen.
        let known = self.reference.contains_key(&self.root);
        let unseen = Some(self.root).filter(|root| known && !frame.scans.contains_key(root));
        frame.scans.iter().filter_map(off).chain(unseen).collect()
    }

    /// Adds parts that are not known yet, as they stand in these frames.
    pub(super) fn add_parts(&mut self, frames: &[Frame]) {
        let mut accumulators: BTreeMap<Label, SurfelAccumulator> = BTreeMap::new();
        for frame in frames {
            for (label, scan) in frame.scans.iter().filter(|(label, _)| !self.models.contains_key(label)) {
                accumulators.entry(*label).or_default().add(scan, &Pose::identity());
            }
        }
        for (label, accumulator) in accumulators {
            if let Some(model) = PartModel::new(&accumulator.surfels()) {
                self.add_part(label, model);
            }
        }
        self.calibrate(frames);
    }
}

/// The joint's position at which a scan costs least, near or far from where it was.
fn located(model: &PartModel, scan: &[ScanPoint], joint: &KinematicJoint, parent: &Pose, last: f64) -> f64 {
    let screw = joint.screw();
    let grid = grid_of(model, &screw, joint.joint_type);
    let frame = JointFrame { scan, parent: *parent, tool: None };
    let stride = scan.len() / REFINING_POINTS;
    let place = |q: f64| *parent * screw.displacement(q);
    let cost = |q: f64| truncated_cost(model, scan, stride, &place(q), FromBehind::OtherSide);
    let refined = |start: f64| {
        let (mut best, mut step) = ((cost(start), start), 0.5 * grid.2);
        for _ in 0..5 {
            let around = [-1.0, -0.5, 0.5, 1.0].map(|k| best.1 + k * step);
            best = around.into_iter().map(|q| (cost(q), q)).fold(best, |a, b| if b.0 < a.0 { b } else { a });
            step *= 0.5;
        }
        best
    };
    let path = search_path(model, &[frame], &screw, grid, None);
    let found = refined(path.positions.first().copied().unwrap_or(last));
    let near = refined(last);
    let best = if found.0 < near.0 - LEAVES { found } else { near };
    if best.0 < cost(last) - LEAVES { best.1 } else { last }
}
