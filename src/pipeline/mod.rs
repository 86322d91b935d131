//! The one state machine that the node and the replay share.

mod backlog;
mod evaluate;
mod explain;
mod first_look;
mod forecast;
mod frame;
mod grip;
mod keyframes;
mod learner;
mod planning;
mod poses;
mod posterior;
mod rest;
mod retention;
mod saved;
mod touch;
mod whereabouts;
mod windows;
mod worker;
mod working_frame;

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

pub use evaluate::{PartScore, ResidualSample, Scores, StageScore};
pub use first_look::FirstLook;
pub use frame::Frame;
pub use learner::{Learner, ParentEvidence, WindowJob};
pub use planning::Planner;
pub use poses::PoseSettings;
pub use saved::{ResumeError, SavedObject, SavedObjectRef, Snapshot};
pub use windows::{FrameAssembler, WindowCutter, WindowSettings};
pub use worker::{ClosedWindow, Learned, Looked, Worker};

use crate::inference::SamplingSettings;
use crate::math::Pose;
use crate::model::{DeclaredPhysics, KinematicSettings, PoseMeasurement};
use crate::registration::{AlignmentSettings, Quadratic, follow, thinned_cost};
use crate::types::{Input, Label, Stamp};
use backlog::{Backlog, Lesson, News};
use evaluate::Scoring;
use explain::{FEWEST_POINTS, measurement_of, travel};
use first_look::REFERENCE_FRAMES;
use forecast::Forecaster;
use poses::{PoseBuffer, PosedPart, RECORD_GAP};
use saved::Resumed;
use windows::{CutWindow, frame_of};
use worker::Begin;
use working_frame::WorkingFrame;

/// Frames at rest after which a live stream has models made, to track with until the first contact's are
/// there.
const PREVIEW_FRAMES: usize = 10;
/// Rise of the mean truncated cost at an older pose that shows motion.
const MOVING_COST: f64 = 0.15;

/// How the pipeline is set up.
#[derive(Clone, Debug)]
pub struct PipelineSettings {
    /// The part fixed to the world; `None`: found out.
    pub root: Option<Label>,
    /// Whether the tool's position is an observation of the part it holds.
    pub use_tool: bool,
    /// Points of a part that are used of a frame at most; 0: all.
    pub points_per_part: usize,
    /// When windows open and close.
    pub windows: WindowSettings,
    /// How poses that a topic measures become observations.
    pub poses: PoseSettings,
    /// What is assumed of the pose measurements.
    pub kinematics: KinematicSettings,
    /// Gravity in world \[m/s²\].
    pub gravity_in_world: Vector3<f64>,
    /// How the published dynamics are sampled; `None`: they are SVI's own.
    pub sampling: Option<SamplingSettings>,
    /// What is in the model of every joint from the start.
    pub declared: DeclaredPhysics,
    /// Whether to predict.
    pub predict: bool,
    /// Predictions, and what windows teach of physics, may be said late, in their order: they are made while the
    /// motion of the next window is looked at.
    pub may_lag: bool,
    /// For prediction, a posterior counts from its window's close plus this \[s\].
    pub posterior_latency_s: f64,
    /// The stream does not wait: closed windows are handed out for a [`Worker`] to learn, and
    /// predictions hold the last wrench instead of waiting for the next.
    pub live: bool,
}

/// What the pipeline says.
#[derive(Clone, Debug)]
#[expect(clippy::large_enum_variant, reason = "an output is moved once, to whoever writes it; most are the large ones")]
pub enum Output {
    /// A part as registration measured it in one frame.
    Observation {
        /// Seconds since time zero.
        time_s: f64,
        /// The part.
        label: Label,
        /// Its displacement and information.
        measurement: PoseMeasurement,
    },
    /// Where a part was expected, of what was known at a stamp and the wrench after it.
    Prediction {
        /// The stamp, in seconds since time zero.
        time_s: f64,
        /// How far ahead of it \[s\].
        horizon_s: f64,
        /// The part.
        label: Label,
        /// Its displacement since the first frame.
        displacement: Pose,
        /// Covariance of its centre of mass, held fixed in the part \[m²\].
        covariance_m2: Matrix3<f64>,
    },
    /// Where tracking has a part, by its joint if it has one; with predictions.
    Tracked {
        /// Seconds since time zero.
        time_s: f64,
        /// The part.
        label: Label,
        /// Its displacement since the first frame.
        displacement: Pose,
        /// Its joint's screw at the reference configuration times its rate, (angular \[rad/s\], linear \[m/s\]).
        twist: Vector6<f64>,
    },
    /// A saved object was taken up at the stream's first frame.
    Resumed {
        /// Its root.
        root: Label,
        /// Parts that are not where the object has them, nor along their known joint.
        unexplained: Vec<Label>,
        /// Parts that the object did not have; they are added.
        unknown: Vec<Label>,
    },
    /// The object at rest has been seen, for a [`Worker`] to make its models; only if live.
    FirstLook(Arc<FirstLook>),
    /// A window closed, for a [`Worker`] to learn; only if live.
    WindowClosed(Box<ClosedWindow>),
    /// A window was learned.
    Learned {
        /// Seconds since time zero of its first and last frame.
        span_s: (f64, f64),
        /// What it took by the pipeline's clock \[s\].
        wall_s: f64,
    },
}

/// Seconds since an arbitrary zero.
pub type Clock = fn() -> f64;

/// From inputs to outputs; the same for a recorded and a live stream.
pub struct Pipeline {
    settings: PipelineSettings,
    working_frame: WorkingFrame,
    zero: Option<Stamp>,
    assembler: FrameAssembler,
    poses: PoseBuffer,
    last_frame_s: Option<f64>,
    early: Vec<Input>,
    cutter: Option<WindowCutter>,
    reference: Vec<Frame>,
    /// The first look, from the first contact until its models are there.
    first_look: Option<Arc<FirstLook>>,
    /// Models of less than the first look, to track with until its own are there.
    preview: Option<Arc<Learner>>,
    learner: Option<Arc<Learner>>,
    current: BTreeMap<Label, Pose>,
    recent: Vec<BTreeMap<Label, Pose>>,
    moving: bool,
    /// Where the parts were when each window closed that was handed out and is not adopted yet, with
    /// the window's number.
    handed_out: VecDeque<(u64, BTreeMap<Label, Pose>)>,
    closed_windows: u64,
    backlog: Option<Backlog>,
    clock: Clock,
    /// Frames with which windows end where all is quiet, if that was decided before.
    window_ends: Option<BTreeSet<Stamp>>,
    /// The latest stamp of a frame.
    newest: Option<Stamp>,
    /// Windows are scored, not learned.
    scoring: Option<Scoring>,
    /// A saved object that waits for the stream's first frame.
    resumed: Option<Box<Resumed>>,
    /// Where the stream's own time zero is on the object's clock \[s\].
    begin_s: f64,
    /// Frames at rest that show parts which the saved object does not have.
    newcomers: Option<Vec<Frame>>,
}

impl Pipeline {
    /// A pipeline that has seen nothing.
    pub fn new(settings: PipelineSettings) -> Self {
        let may_lag = settings.may_lag && !settings.live;
        let forecaster = settings.predict.then(|| Forecaster::new(&settings));
        let backlog = (settings.predict || may_lag).then(|| Backlog::new(forecaster, may_lag));
        Self {
            backlog,
            clock: || 0.0,
            window_ends: None,
            poses: PoseBuffer::new(settings.poses),
            last_frame_s: None,
            settings,
            working_frame: WorkingFrame::Open(Vec::new()),
            zero: None,
            assembler: FrameAssembler::default(),
            early: Vec::new(),
            cutter: None,
            reference: Vec::new(),
            first_look: None,
            preview: None,
            learner: None,
            current: BTreeMap::new(),
            recent: Vec::new(),
            moving: false,
            newest: None,
            scoring: None,
            resumed: None,
            begin_s: 0.0,
            newcomers: None,
            handed_out: VecDeque::new(),
            closed_windows: 0,
        }
    }

    /// Time zero: the earliest stamp of a cloud, a pose or a wrench; `None` before the first cloud.
    pub fn zero(&self) -> Option<Stamp> {
        self.zero
    }

    /// The stamp that outputs count their times from, and what the learner's clock says then \[s\]; `None`
    /// before the first frame.
    pub fn stream_zero(&self) -> Option<(Stamp, f64)> {
        self.zero.map(|zero| (zero.plus_seconds(self.begin_s), self.begin_s))
    }

    /// The same with a clock by which learning is timed; nothing else depends on it.
    #[must_use]
    pub fn timed_by(self, clock: Clock) -> Self {
        Self { clock, ..self }
    }

    /// The same with windows that end, where all is quiet, with the frames of these stamps: whether a part still
    /// moves is not asked.
    #[must_use]
    pub fn with_window_ends(self, window_ends: Option<BTreeSet<Stamp>>) -> Self {
        Self { window_ends, ..self }
    }

    /// What has been learned; `None` before the first window.
    pub fn learner(&self) -> Option<&Learner> {
        self.known().map(Arc::as_ref)
    }

    /// The same, without windows whose physics are still to be learned.
    fn known(&self) -> Option<&Arc<Learner>> {
        self.backlog.as_ref().and_then(Backlog::learned).or(self.learner.as_ref())
    }

    /// One input, in the working frame.
    fn push_carried(&mut self, input: Input) -> Vec<Output> {
        match input {
            Input::Cloud(cloud) => {
                let ready = self.assembler.push(cloud);
                ready.into_iter().flat_map(|(stamp, clouds)| self.push_frame(stamp, &clouds)).collect()
            }
            Input::Pose(pose) => {
                let ready = self.poses.push(*pose);
                ready.into_iter().flat_map(|stamp| self.push_frame(stamp, &[])).collect()
            }
            other => {
                let predictions = match (&mut self.backlog, &other) {
                    (Some(backlog), Input::Wrench(wrench)) => backlog.push(News::Wrench(*wrench)),
                    _ => Vec::new(),
                };
                match (&mut self.cutter, other) {
                    (Some(cutter), Input::Wrench(wrench)) => cutter.push_wrench(wrench),
                    (_, other) => self.early.push(other),
                }
                predictions
            }
        }
    }

    /// The end of the stream, in the working frame.
    fn finish_carried(&mut self) -> Vec<Output> {
        let mut outputs = Vec::new();
        for (stamp, clouds) in self.assembler.flush() {
            outputs.extend(self.push_frame(stamp, &clouds));
        }
        for stamp in self.poses.flush() {
            outputs.extend(self.push_frame(stamp, &[]));
        }
        let window = self.cutter.as_mut().and_then(WindowCutter::flush);
        outputs.extend(window.into_iter().flat_map(|window| self.close(window)));
        outputs.extend(self.backlog.iter_mut().flat_map(Backlog::finish));
        outputs
    }

    fn push_frame(&mut self, stamp: Stamp, clouds: &[crate::types::SegmentedCloud]) -> Vec<Output> {
        let zero = self.zero.unwrap_or_else(|| {
            let first = self.early.iter().map(Input::stamp).chain(self.poses.first()).chain([stamp]).min();
            self.time_zero(first.unwrap_or(stamp))
        });
        self.zero = Some(zero);
        self.newest = self.newest.max(Some(stamp));
        if !clouds.is_empty() {
            self.poses.saw_clouds(stamp);
        }
        let cutter = self.cutter.get_or_insert_with(|| WindowCutter::new(self.settings.windows, zero));
        for input in self.early.drain(..) {
            if let Input::Wrench(wrench) = input {
                cutter.push_wrench(wrench);
            }
        }
        let mut frame = frame_of(stamp.seconds_since(zero), clouds, self.settings.points_per_part);
        let mut outputs = Vec::new();
        if clouds.is_empty() && self.last_frame_s.is_some_and(|last_s| frame.time_s - last_s > RECORD_GAP) {
            outputs.extend(self.end_record());
        }
        self.last_frame_s = Some(frame.time_s);
        if frame.scans.keys().any(|label| self.poses.measures(*label)) {
            Arc::make_mut(&mut frame.scans).retain(|label, _| !self.poses.measures(*label));
        }
        frame.poses = self.poses.at(stamp);
        frame.moves = self.poses.something_moves(frame.time_s, &frame.poses);
        outputs.extend(self.take_up(&frame, zero));
        outputs.extend(self.observe(&frame));
        let moving = self.window_ends.as_ref().map_or(self.moving, |ends| !ends.contains(&stamp));
        let seen = self.backlog.is_some().then(|| frame.clone());
        if !self.is_open() && self.learner.is_none() && self.first_look.is_none() {
            self.reference.push(frame.clone());
            if self.settings.live && self.reference.len() == PREVIEW_FRAMES && self.preview.is_none() {
                outputs.push(Output::FirstLook(Arc::new(self.look(self.reference.clone(), false))));
            }
            // A long look at an object at rest is thinned out, not kept.
            if self.reference.len() > 4 * REFERENCE_FRAMES {
                let mut index = 0;
                self.reference.retain(|_| {
                    index += 1;
                    index % 2 == 0
                });
            }
        }
        if let Some(frames) = self.newcomers.as_mut().filter(|frames| frames.len() < REFERENCE_FRAMES) {
            frames.push(frame.clone());
        }
        let window = self.cutter.as_mut().and_then(|c| c.push_frame(frame, moving));
        if self.is_open()
            && let Some(frames) = self.newcomers.take()
            && let Some(learner) = &mut self.learner
        {
            Arc::make_mut(learner).add_parts(&frames);
        }
        if self.learner.is_none() && self.first_look.is_none() && (self.is_open() || window.is_some()) {
            outputs.extend(self.open_reference());
        }
        outputs.extend(window.into_iter().flat_map(|window| self.close(window)));
        if let (Some(backlog), Some(frame)) = (&mut self.backlog, seen) {
            let rest = self.cutter.as_ref().and_then(WindowCutter::rest_reading).unwrap_or_default();
            let preview = self.preview.as_ref().filter(|_| self.first_look.is_some());
            let learner = self.learner.as_ref().or(preview).cloned();
            outputs.extend(backlog.push(News::Frame { frame, learner, zero, rest }));
        }
        outputs
    }

    /// Poses stayed away: the window that is open ends with the last of them.
    fn end_record(&mut self) -> Vec<Output> {
        self.poses.end_record();
        let Some(window) = self.cutter.as_mut().and_then(WindowCutter::end_record) else { return Vec::new() };
        self.close(window)
    }

    /// The frames of the first look, until something was learned of them.
    fn frames_at_rest(&self) -> &[Frame] {
        self.first_look.as_ref().map_or(&self.reference, |look| &look.frames)
    }

    fn is_open(&self) -> bool {
        self.cutter.as_ref().is_some_and(WindowCutter::is_open)
    }

    /// What a frame is tracked with.
    fn tracked_with(&self) -> Option<&Arc<Learner>> {
        self.learner.as_ref().or(self.preview.as_ref().filter(|_| self.first_look.is_some()))
    }

    fn look(&self, frames: Vec<Frame>, whole: bool) -> FirstLook {
        FirstLook { frames, settings: self.settings.clone(), gravity: self.gravity_in_work(), whole }
    }

    /// The object at rest has been seen: its models are made, just before the first window; beside the
    /// stream if live.
    fn open_reference(&mut self) -> Option<Output> {
        if self.reference.len() > 1 {
            self.reference.pop();
        }
        let frames = std::mem::take(&mut self.reference);
        let look = self.look(frames, true);
        if self.settings.live {
            let look = Arc::new(look);
            self.first_look = Some(Arc::clone(&look));
            return Some(Output::FirstLook(look));
        }
        self.learner = Some(Arc::new(look.learner()));
        None
    }

    /// Takes over the models that a worker made of a first look.
    pub fn adopt_models(&mut self, looked: &Looked) {
        if self.learner.is_none() {
            if looked.whole {
                (self.learner, self.preview) = (Some(Arc::clone(&looked.learner)), None);
            } else {
                self.preview = Some(Arc::clone(&looked.learner));
            }
        }
    }

    /// A window that closed is learned here, or handed out if live.
    fn close(&mut self, window: CutWindow) -> Vec<Output> {
        if self.settings.live && self.scoring.is_none() {
            let begin = match (&self.learner, &self.first_look) {
                (Some(learner), _) => Begin::Learner(Arc::clone(learner)),
                (None, Some(look)) => Begin::FirstLook(Arc::clone(look)),
                (None, None) => return Vec::new(),
            };
            self.closed_windows += 1;
            self.handed_out.push_back((self.closed_windows, self.current.clone()));
            return vec![Output::WindowClosed(Box::new(ClosedWindow::new(self.closed_windows, window, begin)))];
        }
        let Some(learner) = self.learner.as_mut() else { return Vec::new() };
        let job = window.job();
        if let Some(scoring) = &mut self.scoring {
            let learner = Arc::make_mut(learner);
            scoring.score(learner, &job);
            self.current.extend(learner.displacements.iter().map(|(l, d)| (*l, *d)));
            return Vec::new();
        }
        let learning = Arc::make_mut(learner);
        let (clock, backlog) = (self.clock, &mut self.backlog);
        let learn = || {
            let begin = clock();
            let contacts = learning.learn_motion(&job);
            (contacts, clock() - begin)
        };
        let catch_up = || backlog.as_mut().map_or_else(Vec::new, Backlog::catch_up);
        let ((contacts, wall_s), mut outputs) = rayon::join(learn, catch_up);
        self.current.extend(learning.displacements.iter().map(|(l, d)| (*l, *d)));
        if let Some(backlog) = backlog.as_mut().filter(|backlog| backlog.may_lag()) {
            let lesson = Lesson { learner: learning.clone(), job, contacts, wall_s, clock };
            learning.retire();
            outputs.extend(backlog.push(News::Lesson(Box::new(lesson))));
            return outputs;
        }
        let begin = clock();
        learning.learn_physics(&job, &contacts);
        learning.retire();
        outputs.push(Output::Learned { span_s: job.span_s(), wall_s: wall_s + clock() - begin });
        if let Some(backlog) = backlog {
            outputs.extend(backlog.push(News::Learned(Arc::clone(learner))));
        }
        outputs
    }

    /// Takes over what a worker learned from a window handed out; older ones are not waited for any
    /// more. Parts go on from where learning has them at the window's close, as far as they were seen
    /// to go since.
    pub fn adopt(&mut self, learned: &Learned) -> Output {
        let mut at_close = BTreeMap::new();
        while let Some((_, poses)) = self.handed_out.pop_front_if(|(number, _)| *number <= learned.sequence) {
            at_close = poses;
        }
        let displacements = (!learned.again).then_some(&learned.learner.displacements);
        for (label, learned_pose) in displacements.into_iter().flatten() {
            let since = match (at_close.get(label), self.current.get(label)) {
                (Some(before), Some(now)) if before != now => *now * before.inverse(),
                _ => Pose::identity(),
            };
            self.current.insert(*label, since * *learned_pose);
        }
        self.learner = Some(Arc::clone(&learned.learner));
        (self.first_look, self.preview) = (None, None);
        if let Some(forecaster) = self.backlog.as_mut().and_then(|backlog| backlog.forecaster.as_mut()) {
            forecaster.learned(&learned.learner, learned.mechanism.clone(), Some(&self.current));
        }
        Output::Learned { span_s: learned.span_s, wall_s: 0.0 }
    }

    /// Registers every part of a frame, from where it was.
    fn observe(&mut self, frame: &Frame) -> Vec<Output> {
        let mut outputs = self.observe_poses(frame);
        let Some(learner) = self.tracked_with().cloned() else {
            outputs.extend(frame.scans.keys().map(|label| Output::Observation {
                time_s: frame.time_s,
                label: *label,
                measurement: PoseMeasurement { displacement: Pose::identity(), information: Matrix6::zeros() },
            }));
            return outputs;
        };
        let settings = AlignmentSettings::default();
        for (label, scan) in frame.scans.iter() {
            let last = self.current.get(label).copied().unwrap_or_else(Pose::identity);
            let mut measurement = PoseMeasurement { displacement: last, information: Matrix6::zeros() };
            if *label != learner.root
                && scan.len() >= FEWEST_POINTS
                && let Some(model) = learner.models.get(label)
            {
                let aligned = follow(model, scan, &last, &settings);
                let whole = Quadratic { hessian: aligned.factor.hessian(), gradient: aligned.factor.gradient() };
                measurement = measurement_of(model, &whole, &aligned.displacement);
                self.current.insert(*label, measurement.displacement);
            }
            outputs.push(Output::Observation { time_s: frame.time_s, label: *label, measurement });
        }
        self.moving = self.something_moves(frame);
        self.recent.push(self.current.clone());
        if self.recent.len() > 3 {
            self.recent.remove(0);
        }
        outputs
    }

    /// What pose topics measured in a frame; until the first window opens, since the first frame.
    fn observe_poses(&self, frame: &Frame) -> Vec<Output> {
        let learned = |label| self.learner.as_ref().and_then(|learner| learner.posed.get(label)).copied();
        let first = self.frames_at_rest().first().unwrap_or(frame);
        let outputs = frame.poses.iter().map(|(label, seen)| {
            let seen_first = || first.poses.get(label).unwrap_or(seen);
            let part = learned(label).unwrap_or_else(|| {
                let seen = seen_first();
                PosedPart { world_from_frame: seen.world_from_frame, information: seen.information }
            });
            Output::Observation { time_s: frame.time_s, label: *label, measurement: part.measurement(seen) }
        });
        outputs.collect()
    }

    /// Whether a part is seen away from where it was a few frames ago: the older pose must explain
    /// the cloud clearly worse, so that a panel that slides along itself unseen does not count.
    fn something_moves(&self, frame: &Frame) -> bool {
        let (Some(learner), Some(before)) = (self.tracked_with(), self.recent.first()) else { return false };
        frame.scans.iter().any(|(label, scan)| {
            let (Some(model), Some(old), Some(new)) =
                (learner.models.get(label), before.get(label), self.current.get(label))
            else {
                return false;
            };
            let cost = |pose| thinned_cost(model, scan, pose);
            travel(model, old, new) > 0.006 && cost(old) - cost(new) > MOVING_COST
        })
    }
}
