//! The stream's thread: what arrived goes through reading and pipeline, what they say goes out.
//!
//! Nothing here waits: windows are learned elsewhere, messages are sent elsewhere.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use nalgebra::{Vector3, Vector6};
use tokio::sync::oneshot;
use tracing::{info, warn};

use super::announce::Announcer;
use super::drawing::Drawing;
use super::health::{SharedHealth, now, processor_s};
use super::inbox::{Arrival, Inbox};
use super::learning::{Learning, Taught};
use super::publications::Outputs;
use super::recording::Recording;
use crate::io::config::InputConfig;
use crate::io::ingest::{Ingest, Message};
use crate::io::model_file::SavedModel;
use crate::math::Pose;
use crate::pipeline::{Output, Pipeline, PipelineSettings, Planner, Snapshot};
use crate::ros::{LinkTree, PartPrediction};
use crate::types::{Input, Label, Stamp};

/// How long the thread sleeps where nothing comes.
const PATIENCE: Duration = Duration::from_millis(200);
/// How often counts are handed to those who report them.
const REPORT_EVERY: Duration = Duration::from_millis(100);
/// A camera whose stamps go back by more than this begins another stream \[s\].
const JUMP_S: f64 = 1.0;

/// What the stream can be told.
pub enum Command {
    /// Begin with nothing learned, by these settings; passing over what comes.
    Configure(Box<(InputConfig, PipelineSettings)>),
    /// Forget what was learned; no more until it is configured.
    CleanUp,
    /// Use what comes.
    Activate,
    /// Pass over what comes; what was learned is kept.
    Deactivate,
    /// Forget what was learned and go on.
    Reset(oneshot::Sender<()>),
    /// What was learned, for saving, with the bags that it knows; `None` where there is nothing yet.
    Snapshot(oneshot::Sender<Option<(Snapshot, Vec<String>)>>),
    /// Go on from what was learned before; whether that is possible.
    Resume(Box<SavedModel>, oneshot::Sender<Result<(), String>>),
    /// What plans are answered from, with the transform from this frame into the fixed one, the stamp of
    /// now and the parts' centres.
    Planner(String, oneshot::Sender<Result<Box<Ground>, String>>),
    /// This was learned in this life of the pipeline.
    Adopt(u64, Taught),
    /// The clock went back.
    BeginAgain,
    /// Parts' frames go on /tf with this before their names, or not at all.
    PublishTf(Option<String>),
    /// The end.
    Stop,
}

/// What a plan is answered from.
pub struct Ground {
    /// The stream's knowledge.
    pub planner: Planner,
    /// From the plan's frame.
    pub world_from_frame: Pose,
    /// Now.
    pub stamp: Stamp,
    /// Name of the fixed frame.
    pub fixed_frame: String,
    /// Centres of mass of the parts at the first frame \[m\].
    pub centers: BTreeMap<Label, Vector3<f64>>,
    /// The tree of the description.
    pub tree: Option<LinkTree>,
}

/// The state of the stream.
pub struct Stream {
    inbox: Arc<Inbox<Command>>,
    learning: Learning,
    recording: Option<Recording>,
    health: SharedHealth,
    ingest: Ingest,
    input: InputConfig,
    settings: Option<PipelineSettings>,
    pipeline: Option<Pipeline>,
    announcer: Announcer,
    /// Bags that a loaded model has learned.
    bags: Vec<String>,
    active: bool,
    /// Counts the pipelines, so that what an older one handed out is not adopted by a newer.
    life: u64,
    /// Added to stamps, so that a stream that begins again goes on after the one before \[ns\].
    shift_ns: i64,
    begin_again: bool,
    newest: Option<Stamp>,
    newest_of_camera: BTreeMap<(Arc<str>, String), Stamp>,
    /// When the clouds of recent stamps came.
    arrivals: BTreeMap<Stamp, Instant>,
    reported: Instant,
}

impl Stream {
    /// Nothing is configured yet; transforms are kept from the start on.
    pub fn new(
        inbox: Arc<Inbox<Command>>,
        learning: Learning,
        (outputs, drawing, recording): (Outputs, Drawing, Option<Recording>),
        health: SharedHealth,
        input: InputConfig,
    ) -> Self {
        Self {
            inbox,
            learning,
            recording,
            announcer: Announcer::new(outputs, drawing, input.fixed_frame.clone()),
            health,
            ingest: Ingest::new(&input),
            input,
            settings: None,
            pipeline: None,
            bags: Vec::new(),
            active: false,
            life: 0,
            shift_ns: 0,
            begin_again: false,
            newest: None,
            newest_of_camera: BTreeMap::new(),
            arrivals: BTreeMap::new(),
            reported: now(),
        }
    }

    /// Runs to its end.
    pub fn run(mut self) {
        loop {
            let batch = self.inbox.take(PATIENCE);
            for command in batch.commands {
                if matches!(command, Command::Stop) {
                    self.learning.close();
                    return;
                }
                self.obey(command);
            }
            for arrival in batch.readings {
                self.read(arrival);
            }
            for arrival in batch.clouds {
                self.read(arrival);
            }
            self.report();
        }
    }

    fn obey(&mut self, command: Command) {
        match command {
            Command::Configure(settings) => {
                let (input, settings) = *settings;
                self.ingest = self.ingest.anew(&input);
                self.input = input;
                self.settings = Some(settings);
                self.begin();
            }
            Command::CleanUp => {
                self.settings = None;
                self.begin();
                self.active = false;
            }
            Command::Activate => self.active = true,
            Command::Deactivate => {
                self.active = false;
                // What comes after the pause is not what came before it.
                self.begin_again = true;
            }
            Command::Reset(done) => {
                self.begin();
                info!("reset: what was learned is forgotten");
                // Whoever asked may be gone.
                let _ = done.send(());
            }
            Command::Snapshot(reply) => {
                let snapshot = self.pipeline.as_ref().and_then(Pipeline::snapshot);
                let _ = reply.send(snapshot.map(|snapshot| (snapshot, self.bags.clone())));
            }
            Command::Planner(frame, reply) => {
                let _ = reply.send(self.ground(&frame));
            }
            Command::Resume(model, reply) => {
                let _ = reply.send(self.resume(*model));
            }
            Command::Adopt(life, taught) if life == self.life => self.adopt(taught),
            Command::Adopt(..) | Command::Stop => {}
            Command::BeginAgain => self.begin_again = true,
            Command::PublishTf(prefix) => self.announcer.publish_tf(prefix),
        }
    }

    fn adopt(&mut self, taught: Taught) {
        let Some(pipeline) = &mut self.pipeline else { return };
        let begin = processor_s();
        match taught {
            Taught::Models(models) => pipeline.adopt_models(&models),
            Taught::Window(learned) => {
                pipeline.adopt(&learned);
                self.announcer.learned(pipeline, *learned, self.ingest.counters(), self.shift_ns);
            }
        }
        self.health.lock().adoption.add(processor_s() - begin);
    }

    fn ground(&self, frame: &str) -> Result<Box<Ground>, String> {
        let pipeline = self.pipeline.as_ref().ok_or("the node is unconfigured")?;
        let planner = pipeline.planner().ok_or("no joint is known yet")?;
        let zero = pipeline.zero().unwrap_or_default();
        let stamp = Stamp(zero.plus_seconds(planner.time_s()).0 - self.shift_ns);
        let fixed_frame = self.input.fixed_frame.clone();
        let frame = if frame.is_empty() { &fixed_frame } else { frame };
        let world_from_frame =
            self.ingest.transforms().lookup(&fixed_frame, frame, stamp).map_err(|error| error.to_string())?;
        let (centers, tree) = (self.announcer.centers(), self.announcer.tree().cloned());
        Ok(Box::new(Ground { planner, world_from_frame, stamp, fixed_frame, centers, tree }))
    }

    /// A pipeline that goes on from a saved model.
    fn resume(&mut self, model: SavedModel) -> Result<(), String> {
        let settings = self.settings.clone().ok_or("the node is unconfigured: configure it first")?;
        let root = model.object.root();
        let pipeline = Pipeline::resume(settings, model.object).map_err(|error| error.to_string())?;
        self.begin();
        self.announcer.prior(Some(root), self.ingest.counters());
        (self.pipeline, self.bags) = (Some(pipeline), model.bags);
        Ok(())
    }

    /// A new pipeline, if there are settings for one.
    fn begin(&mut self) {
        self.life += 1;
        self.learning.clear();
        self.pipeline = self.settings.clone().map(Pipeline::new);
        (self.shift_ns, self.newest, self.begin_again) = (0, None, false);
        self.bags.clear();
        self.newest_of_camera.clear();
        self.arrivals.clear();
        self.ingest.begin_again();
        self.announcer.begin(&self.input.fixed_frame);
        if let Some(settings) = &self.settings {
            self.announcer.prior(settings.root, self.ingest.counters());
        }
    }

    fn read(&mut self, arrival: Arrival) {
        let is_tf = matches!(arrival.message, Message::Tf(_));
        if !is_tf && (!self.active || self.pipeline.is_none()) {
            return;
        }
        if let Message::Cloud(cloud) = &arrival.message {
            let stamp = Stamp::from(cloud.header.stamp);
            let camera = (Arc::clone(&arrival.topic), cloud.header.frame_id.clone());
            let before = self.newest_of_camera.insert(camera, stamp);
            if let Some(back_s) = before.map(|before| before.seconds_since(stamp)).filter(|back| *back > JUMP_S) {
                let line = format!(
                    "{}: stamps went back by {back_s:.3} s: the stream begins again, what was learned is kept",
                    arrival.topic
                );
                self.health.lock().jumped(line);
                self.begin_again = true;
            }
            self.arrivals.insert(stamp, arrival.at);
            while self.arrivals.len() > 100 {
                self.arrivals.pop_first();
            }
        }
        if self.begin_again && !is_tf {
            self.begin_again = false;
            // What waited belongs to the stream before.
            self.ingest.begin_again();
            self.newest_of_camera.clear();
            let first = stamp_of(&arrival.message);
            if let (Some(newest), Some(first)) = (self.newest, first) {
                self.shift_ns = newest.plus_seconds(JUMP_S).0 - first.0;
            }
        }
        let is_cloud = matches!(arrival.message, Message::Cloud(_));
        if let Some(recording) = &self.recording {
            recording.accepted(&arrival.topic, &arrival.message);
        }
        let (begin, begin_on_processor) = (now(), processor_s());
        let inputs = self.ingest.push_message(&arrival.topic, arrival.message);
        let mut outputs = Vec::new();
        if let Some(pipeline) = self.pipeline.as_mut().filter(|_| self.active) {
            for input in inputs {
                let input = shifted(input, self.shift_ns);
                self.newest = self.newest.max(Some(input.stamp()));
                outputs.extend(pipeline.push(input));
            }
        }
        if !outputs.is_empty() {
            self.tell(outputs);
        }
        if is_cloud {
            let took_s = begin.elapsed().as_secs_f64();
            let on_processor_s = processor_s() - begin_on_processor;
            let mut health = self.health.lock();
            health.tracking.add(took_s);
            health.processor.add(on_processor_s);
        }
    }

    /// Hands on what the pipeline said.
    fn tell(&mut self, outputs: Vec<Output>) {
        let Some(zero) = self.pipeline.as_ref().and_then(Pipeline::zero) else { return };
        let mut predictions: BTreeMap<Stamp, Vec<PartPrediction>> = BTreeMap::new();
        let mut observed = None;
        for output in outputs {
            match output {
                Output::Prediction { time_s, label, .. } => {
                    let stamp = Stamp(zero.plus_seconds(time_s).0 - self.shift_ns);
                    let Some(center_in_world) = self.announcer.center(label) else { continue };
                    predictions.entry(stamp).or_default().extend(PartPrediction::of(&output, center_in_world));
                }
                Output::FirstLook(look) => self.learning.look(self.life, look),
                Output::WindowClosed(window) => {
                    let (from, to) = window.span_s();
                    info!("window of {from:.1} s to {to:.1} s closed");
                    if let Some(recording) = &self.recording {
                        recording.window(Stamp(zero.plus_seconds(to).0 - self.shift_ns));
                    }
                    for dropped in self.learning.put(self.life, window) {
                        let (from, to) = dropped.span_s();
                        warn!("window of {from:.1} s to {to:.1} s is dropped: too many wait to be learned");
                    }
                }
                Output::Observation { time_s, label, measurement } => {
                    self.announcer.observed(label, measurement.displacement, Vector6::zeros());
                    observed = Some(Stamp(zero.plus_seconds(time_s).0 - self.shift_ns));
                }
                // It comes after what was observed, and knows more.
                Output::Tracked { label, displacement, twist, .. } => {
                    self.announcer.observed(label, displacement, twist);
                }
                Output::Resumed { root, unexplained, unknown } => {
                    info!(%root, "goes on with a saved object");
                    if let Some(pipeline) = &self.pipeline {
                        let stamp = self.newest.map_or(zero, |newest| Stamp(newest.0 - self.shift_ns));
                        self.announcer.resumed(pipeline, stamp, self.ingest.counters(), self.shift_ns);
                    }
                    for label in unexplained {
                        warn!(%label, "part is not where its joint could have it");
                    }
                    for label in unknown {
                        warn!(%label, "part is not in the saved object: added");
                    }
                }
                Output::Learned { .. } => {}
            }
        }
        for (stamp, predictions) in predictions {
            self.announcer.predicted(stamp, predictions, self.arrivals.get(&stamp).copied());
        }
        if let (Some(stamp), Some(pipeline)) = (observed, &self.pipeline) {
            self.announcer.frame(pipeline, stamp, self.ingest.counters(), self.shift_ns);
        }
    }

    /// Counts, for those who report them.
    fn report(&mut self) {
        let at = now();
        if at.duration_since(self.reported) < REPORT_EVERY {
            return;
        }
        self.reported = at;
        let (readings, clouds, superseded, overflown) = self.inbox.state();
        let missing = self.ingest.waiting();
        let mut health = self.health.lock();
        health.counters = self.ingest.counters().clone();
        health.queued = (readings, clouds);
        health.dropped = (superseded, overflown);
        // A message that waits is looked at as long as it is the same one.
        let is_there = |topic: &String, stamp: Stamp| missing.iter().any(|(t, s, _)| t == topic && *s == stamp);
        health.no_tf.retain(|topic, (_, stamp, _)| is_there(topic, *stamp));
        for (topic, stamp, error) in &missing {
            health.no_tf.entry(topic.clone()).or_insert((at, *stamp, String::new())).2 = error.to_string();
        }
    }
}

fn stamp_of(message: &Message<'_>) -> Option<Stamp> {
    match message {
        Message::Cloud(cloud) => Some(cloud.header.stamp.into()),
        Message::Wrench(wrench) => Some(wrench.header.stamp.into()),
        Message::Pose(pose) => Some(pose.header.stamp.into()),
        Message::Tf(_) => None,
    }
}

fn shifted(input: Input, shift_ns: i64) -> Input {
    let shift = |stamp: Stamp| Stamp(stamp.0.saturating_add(shift_ns));
    match input {
        Input::Cloud(mut cloud) => {
            cloud.stamp = shift(cloud.stamp);
            Input::Cloud(cloud)
        }
        Input::Wrench(wrench) => Input::Wrench(crate::types::AppliedWrench { stamp: shift(wrench.stamp), ..wrench }),
        Input::Pose(mut pose) => {
            pose.stamp = shift(pose.stamp);
            Input::Pose(pose)
        }
    }
}
