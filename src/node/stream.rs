//! The stream's thread: what arrived goes through reading and pipeline, what they say goes out.
//!
//! Nothing here waits: windows are learned elsewhere, messages are sent elsewhere.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::{Duration, Instant};

use tokio::sync::oneshot;
use tracing::{info, warn};

use super::announce::Announcer;
use super::health::{SharedHealth, now};
use super::inbox::{Arrival, Inbox};
use super::learning::Learning;
use super::publications::Outputs;
use crate::io::config::InputConfig;
use crate::io::ingest::{Ingest, Message};
use crate::pipeline::{Learned, Output, Pipeline, PipelineSettings};
use crate::ros::PartPrediction;
use crate::types::{Input, Stamp};

/// How long the thread sleeps where nothing comes.
const PATIENCE: Duration = Duration::from_millis(200);
/// How often counts are handed to those who report them.
const REPORT_EVERY: Duration = Duration::from_millis(100);
/// A camera whose stamps go back by more than this begins another stream \[s\].
const JUMP_S: f64 = 1.0;

/// What the stream can be told.
#[derive(Debug)]
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
    /// A window was learned in this life of the pipeline.
    Adopt(u64, Box<Learned>),
    /// The clock went back.
    BeginAgain,
    /// Parts' frames go on /tf, or not.
    PublishTf(bool),
    /// The end.
    Stop,
}

/// The state of the stream.
pub struct Stream {
    inbox: Arc<Inbox<Command>>,
    learning: Learning,
    outputs: Outputs,
    health: SharedHealth,
    ingest: Ingest,
    input: InputConfig,
    settings: Option<PipelineSettings>,
    pipeline: Option<Pipeline>,
    announcer: Announcer,
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
        outputs: Outputs,
        health: SharedHealth,
        input: InputConfig,
    ) -> Self {
        Self {
            inbox,
            learning,
            announcer: Announcer::new(outputs.clone(), input.fixed_frame.clone()),
            outputs,
            health,
            ingest: Ingest::new(&input),
            input,
            settings: None,
            pipeline: None,
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
                self.announcer = Announcer::new(self.outputs.clone(), input.fixed_frame.clone());
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
            Command::Adopt(life, learned) if life == self.life => {
                if let Some(pipeline) = &mut self.pipeline {
                    pipeline.adopt(&learned);
                    let counters = self.ingest.counters();
                    self.announcer.learned(pipeline, &learned, counters, self.shift_ns);
                }
            }
            Command::Adopt(..) | Command::Stop => {}
            Command::BeginAgain => self.begin_again = true,
            Command::PublishTf(on) => self.announcer.publish_tf(on),
        }
    }

    /// A new pipeline, if there are settings for one.
    fn begin(&mut self) {
        self.life += 1;
        self.learning.clear();
        self.pipeline = self.settings.clone().map(Pipeline::new);
        (self.shift_ns, self.newest, self.begin_again) = (0, None, false);
        self.newest_of_camera.clear();
        self.arrivals.clear();
        self.ingest.begin_again();
        self.announcer.begin();
        if let Some(settings) = &self.settings {
            self.announcer.prior(None, settings.root, self.ingest.counters());
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
        let begin = now();
        let is_cloud = matches!(arrival.message, Message::Cloud(_));
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
            self.health.lock().tracking.add(begin.elapsed().as_secs_f64());
        }
    }

    /// Hands on what the pipeline said.
    fn tell(&mut self, outputs: Vec<Output>) {
        let Some(zero) = self.pipeline.as_ref().and_then(Pipeline::zero) else { return };
        let mut predictions: BTreeMap<Stamp, Vec<PartPrediction>> = BTreeMap::new();
        let mut observed = None;
        for output in outputs {
            match output {
                Output::Prediction { time_s, horizon_s, label, displacement, covariance_m2 } => {
                    let stamp = Stamp(zero.plus_seconds(time_s).0 - self.shift_ns);
                    let Some(center_in_world) = self.announcer.center(label) else { continue };
                    predictions.entry(stamp).or_default().push(PartPrediction {
                        label,
                        horizon_s,
                        displacement,
                        center_in_world,
                        covariance_m2,
                    });
                }
                Output::WindowClosed(window) => {
                    let (from, to) = window.span_s();
                    info!("window of {from:.1} s to {to:.1} s closed");
                    for dropped in self.learning.put(self.life, window) {
                        let (from, to) = dropped.span_s();
                        warn!("window of {from:.1} s to {to:.1} s is dropped: too many wait to be learned");
                    }
                }
                Output::Observation { time_s, label, measurement } => {
                    self.announcer.observed(label, measurement.displacement);
                    observed = Some(Stamp(zero.plus_seconds(time_s).0 - self.shift_ns));
                }
                Output::Resumed { root, unexplained, unknown } => {
                    info!(%root, "goes on with a saved object");
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
            self.announcer.predicted(stamp, &predictions, self.arrivals.get(&stamp).copied());
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
        let missing: BTreeMap<String, String> =
            self.ingest.waiting().into_iter().map(|(topic, error)| (topic, error.to_string())).collect();
        let mut health = self.health.lock();
        health.counters = self.ingest.counters().clone();
        health.queued = (readings, clouds);
        health.dropped = (superseded, overflown);
        health.no_tf.retain(|topic, _| missing.contains_key(topic));
        for (topic, text) in missing {
            health.no_tf.entry(topic).or_insert((at, String::new())).1 = text;
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
