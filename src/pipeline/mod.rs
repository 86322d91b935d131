//! The one state machine that the node and the replay share.

mod explain;
mod forecast;
mod learner;
mod posterior;
mod windows;
mod working_frame;

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};

pub use explain::Frame;
pub use learner::{Learner, ParentEvidence, WindowJob};
pub use windows::{FrameAssembler, WindowCutter, WindowSettings};

use crate::math::Pose;
use crate::model::{DeclaredPhysics, DynamicsLearner, KinematicSettings, PoseMeasurement};
use crate::registration::{AlignmentSettings, Quadratic, SurfelAccumulator, align, truncated_cost};
use crate::types::{Input, Label, Stamp};
use explain::{FEWEST_POINTS, measurement_of, travel};
use forecast::Forecaster;
use windows::frame_of;
use working_frame::WorkingFrame;

/// Frames of the first look that the reference models are made of.
const REFERENCE_FRAMES: usize = 20;
/// Rise of the mean truncated cost at an older pose that shows motion.
const MOVING_COST: f64 = 0.15;

/// How the pipeline is set up.
#[derive(Clone, Debug)]
pub struct PipelineSettings {
    /// The part fixed to the world; `None`: found out.
    pub root: Option<Label>,
    /// Whether the tool's position is an observation of the part it holds.
    pub use_tool: bool,
    /// When windows open and close.
    pub windows: WindowSettings,
    /// What is assumed of the pose measurements.
    pub kinematics: KinematicSettings,
    /// Gravity in world \[m/s²\].
    pub gravity_in_world: Vector3<f64>,
    /// What is in the model of every joint from the start.
    pub declared: DeclaredPhysics,
    /// Whether to predict.
    pub predict: bool,
    /// For prediction, a posterior counts from its window's close plus this \[s\].
    pub posterior_latency_s: f64,
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
    /// A window was learned.
    Learned {
        /// Seconds since time zero of its first and last frame.
        span_s: (f64, f64),
    },
}

/// From inputs to outputs; the same for a recorded and a live stream.
pub struct Pipeline {
    settings: PipelineSettings,
    working_frame: WorkingFrame,
    zero: Option<Stamp>,
    assembler: FrameAssembler,
    early: Vec<Input>,
    cutter: Option<WindowCutter>,
    accumulators: BTreeMap<Label, SurfelAccumulator>,
    reference: Vec<Frame>,
    learner: Option<Learner>,
    current: BTreeMap<Label, Pose>,
    recent: Vec<BTreeMap<Label, Pose>>,
    moving: bool,
    forecaster: Option<Forecaster>,
}

impl Pipeline {
    /// A pipeline that has seen nothing.
    pub fn new(settings: PipelineSettings) -> Self {
        let forecaster =
            settings.predict.then(|| Forecaster::new(settings.root, settings.use_tool, settings.posterior_latency_s));
        Self {
            forecaster,
            settings,
            working_frame: WorkingFrame::Open(Vec::new()),
            zero: None,
            assembler: FrameAssembler::default(),
            early: Vec::new(),
            cutter: None,
            accumulators: BTreeMap::new(),
            reference: Vec::new(),
            learner: None,
            current: BTreeMap::new(),
            recent: Vec::new(),
            moving: false,
        }
    }

    /// What has been learned; `None` before the first window.
    pub fn learner(&self) -> Option<&Learner> {
        self.learner.as_ref()
    }

    /// One input, in the working frame.
    fn push_carried(&mut self, input: Input) -> Vec<Output> {
        match input {
            Input::Cloud(cloud) => {
                let ready = self.assembler.push(cloud);
                ready.into_iter().flat_map(|(stamp, clouds)| self.push_frame(stamp, &clouds)).collect()
            }
            other => {
                let predictions = match (&mut self.forecaster, &other) {
                    (Some(forecaster), Input::Wrench(wrench)) => forecaster.push_wrench(wrench),
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
        let job = self.cutter.as_mut().and_then(|c| c.flush(nearest_label));
        outputs.extend(job.map(|job| self.learn(&job)));
        outputs.extend(self.forecaster.iter_mut().flat_map(Forecaster::finish));
        outputs
    }

    fn push_frame(&mut self, stamp: Stamp, clouds: &[crate::types::SegmentedCloud]) -> Vec<Output> {
        let zero =
            *self.zero.get_or_insert_with(|| self.early.iter().map(Input::stamp).chain([stamp]).min().unwrap_or(stamp));
        let cutter = self.cutter.get_or_insert_with(|| WindowCutter::new(self.settings.windows, zero));
        for input in self.early.drain(..) {
            if let Input::Wrench(wrench) = input {
                cutter.push_wrench(wrench);
            }
        }
        let frame = frame_of(stamp.seconds_since(zero), clouds);
        let mut outputs = self.observe(&frame);
        let moving = self.moving;
        let seen = self.forecaster.is_some().then(|| frame.clone());
        if !self.cutter.as_ref().is_some_and(WindowCutter::is_open) && self.learner.is_none() {
            self.reference.push(frame.clone());
            // A long look at an object at rest is thinned out, not kept.
            if self.reference.len() > 4 * REFERENCE_FRAMES {
                let mut index = 0;
                self.reference.retain(|_| {
                    index += 1;
                    index % 2 == 0
                });
            }
        }
        let job = self.cutter.as_mut().and_then(|c| c.push_frame(frame, moving, nearest_label));
        if self.learner.is_none() && self.cutter.as_ref().is_some_and(WindowCutter::is_open) {
            self.open_reference();
        }
        let closed = job.is_some();
        outputs.extend(job.map(|job| self.learn(&job)));
        if let (Some(forecaster), Some(frame)) = (&mut self.forecaster, seen) {
            if let Some(learner) = self.learner.as_ref().filter(|_| closed) {
                forecaster.learned(learner);
            }
            let rest_force = self.cutter.as_ref().and_then(|cutter| cutter.rest_force).unwrap_or_default();
            outputs.extend(forecaster.push_frame(frame, self.learner.as_ref(), zero, rest_force));
        }
        outputs
    }

    /// The object at rest has been seen: its models are made, just before the first window.
    fn open_reference(&mut self) {
        if self.reference.len() > 1 {
            self.reference.pop();
        }
        let every = self.reference.len().div_ceil(REFERENCE_FRAMES).max(1);
        for frame in self.reference.iter().step_by(every) {
            for (label, scan) in &frame.scans {
                self.accumulators.entry(*label).or_default().add(scan, &Pose::identity());
            }
        }
        let accumulators = std::mem::take(&mut self.accumulators);
        let root = self.settings.root.unwrap_or_else(|| {
            accumulators.iter().max_by_key(|(_, a)| a.voxel_means(1.0).len()).map_or(Label(0), |(l, _)| *l)
        });
        let mut learner = Learner::new(root, self.settings.use_tool, accumulators);
        learner.settings = self.settings.kinematics;
        learner.dynamics = DynamicsLearner::new(self.gravity_in_work()).declaring(self.settings.declared.clone());
        learner.calibrate(&self.reference);
        self.reference.clear();
        self.learner = Some(learner);
    }

    fn learn(&mut self, job: &WindowJob) -> Output {
        let ends = |f: Option<&Frame>| f.map_or(0.0, |f| f.time_s);
        let span_s = (ends(job.frames.first()), ends(job.frames.last()));
        if let Some(learner) = &mut self.learner {
            learner.learn(job);
            self.current.extend(learner.displacements.iter().map(|(l, d)| (*l, *d)));
        }
        Output::Learned { span_s }
    }

    /// Registers every part of a frame, from where it was.
    fn observe(&mut self, frame: &Frame) -> Vec<Output> {
        let Some(learner) = &self.learner else {
            return frame
                .scans
                .keys()
                .map(|label| Output::Observation {
                    time_s: frame.time_s,
                    label: *label,
                    measurement: PoseMeasurement { displacement: Pose::identity(), information: Matrix6::zeros() },
                })
                .collect();
        };
        let settings = AlignmentSettings::default();
        let mut outputs = Vec::new();
        for (label, scan) in &frame.scans {
            let last = self.current.get(label).copied().unwrap_or_else(Pose::identity);
            let mut measurement = PoseMeasurement { displacement: last, information: Matrix6::zeros() };
            if *label != learner.root
                && scan.len() >= FEWEST_POINTS
                && let Some(model) = learner.models.get(label)
            {
                let r = model.radius;
                let prior = Matrix6::from_diagonal(&(Vector6::new(r * r, r * r, r * r, 1.0, 1.0, 1.0) * 2.5e3));
                let aligned = align(model, scan, &last, &prior, &settings, 6);
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

    /// Whether a part is seen away from where it was a few frames ago: the older pose must explain
    /// the cloud clearly worse, so that a panel that slides along itself unseen does not count.
    fn something_moves(&self, frame: &Frame) -> bool {
        let (Some(learner), Some(before)) = (&self.learner, self.recent.first()) else { return false };
        frame.scans.iter().any(|(label, scan)| {
            let (Some(model), Some(old), Some(new)) =
                (learner.models.get(label), before.get(label), self.current.get(label))
            else {
                return false;
            };
            let cost = |pose| truncated_cost(model, scan, scan.len() / 150, pose);
            travel(model, old, new) > 0.006 && cost(old) - cost(new) > MOVING_COST
        })
    }
}

/// The part whose points are nearest to a place, by majority of the nearest few.
fn nearest_label(place: &Vector3<f64>, frame: &Frame) -> Option<Label> {
    frame
        .scans
        .iter()
        .filter_map(|(label, scan)| {
            let mut distances: Vec<f64> = scan.iter().map(|p| (p.point_in_world - place).norm()).collect();
            let rank = 3.min(distances.len().checked_sub(1)?);
            distances.select_nth_unstable_by(rank, f64::total_cmp);
            Some((distances[rank], *label))
        })
        .min_by(|a, b| a.0.total_cmp(&b.0))
        .map(|(_, label)| label)
}
