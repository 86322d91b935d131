//! What the stream says, as messages: posterior, predictions, criticism, and what planners draw on.

use std::collections::BTreeMap;
use std::time::Instant;

use nalgebra::Vector3;
use tracing::warn;

use super::publications::{Outputs, Publication};
use crate::io::counters::Counters;
use crate::math::Pose;
use crate::pipeline::{Learned, Pipeline};
use crate::ros::{self, FixedFrame, FutureWrench, PartPrediction};
use crate::types::finite::NotFinite;
use crate::types::posterior::{Criticism, ObjectPosterior};
use crate::types::{Label, Stamp};

/// Keeps what messages are made of.
pub struct Announcer {
    outputs: Outputs,
    frame: FixedFrame,
    posterior: Option<ObjectPosterior>,
    displacements: BTreeMap<Label, Pose>,
    /// Whether a window was learned.
    learned: bool,
    tf: bool,
}

impl Announcer {
    /// Nothing is known; all is said in `fixed_frame`.
    pub fn new(outputs: Outputs, fixed_frame: String) -> Self {
        Self {
            outputs,
            frame: FixedFrame { name: fixed_frame, zero: Stamp::default() },
            posterior: None,
            displacements: BTreeMap::new(),
            learned: false,
            tf: false,
        }
    }

    /// Forgets what was said.
    pub fn begin(&mut self) {
        (self.posterior, self.learned) = (None, false);
        self.displacements.clear();
    }

    /// Whether parts' frames go on /tf.
    pub fn publish_tf(&mut self, on: bool) {
        self.tf = on;
    }

    /// A part's centre of mass at the first frame \[m\].
    pub fn center(&self, label: Label) -> Option<Vector3<f64>> {
        let parts = &self.posterior.as_ref()?.parts;
        parts.iter().find(|part| part.label == label).map(|part| part.com_in_world_m.into())
    }

    /// Where a part is.
    pub fn observed(&mut self, label: Label, displacement: Pose) {
        self.displacements.insert(label, displacement);
    }

    /// A frame was seen: until something is learned, the prior goes with the parts that are seen.
    pub fn frame(&mut self, pipeline: &Pipeline, stamp: Stamp, counters: &Counters, shift_ns: i64) {
        let known = self.posterior.as_ref().map_or(0, |posterior| posterior.parts.len());
        if !self.learned && known < self.displacements.len() {
            if let Some(zero) = pipeline.zero() {
                self.frame.zero = Stamp(zero.0 - shift_ns);
            }
            let root = self.posterior.as_ref().map(|posterior| posterior.root_label);
            self.say_posterior(pipeline.posterior(), root, counters, stamp);
        }
    }

    /// What is believed before anything was seen or learned.
    pub fn prior(&mut self, posterior: Option<ObjectPosterior>, root: Option<Label>, counters: &Counters) {
        self.say_posterior(posterior, root, counters, Stamp::default());
    }

    /// A window was learned.
    pub fn learned(&mut self, pipeline: &Pipeline, learned: &Learned, counters: &Counters, shift_ns: i64) {
        self.learned = true;
        let zero = pipeline.zero().unwrap_or_default();
        self.frame.zero = Stamp(zero.0 - shift_ns);
        let stamp = self.frame.zero.plus_seconds(learned.span_s.1);
        self.say_posterior(Some(learned.posterior.clone()), None, counters, stamp);
    }

    fn say_posterior(
        &mut self,
        posterior: Option<ObjectPosterior>,
        root: Option<Label>,
        counters: &Counters,
        stamp: Stamp,
    ) {
        let posterior = posterior.unwrap_or_else(|| ObjectPosterior {
            root_label: root.unwrap_or_default(),
            parts: Vec::new(),
            edges: Vec::new(),
            windows: Vec::new(),
            criticism: Criticism::insufficient(),
        });
        let message = ros::object_posterior(&posterior, counters, &self.frame, stamp);
        self.say(message.map(|message| Publication::Posterior(Box::new(message))));
        let message = ros::criticism(&posterior.criticism, posterior.windows.len(), &self.frame, stamp);
        self.say(message.map(Publication::Criticism));
        self.posterior = Some(posterior);
    }

    /// Where parts will be, for the cloud that came at `arrived`.
    pub fn predicted(&self, stamp: Stamp, predictions: &[PartPrediction], arrived: Option<Instant>) {
        let message = ros::predicted_part_poses(predictions, FutureWrench::Held, &self.frame, stamp);
        self.say(message.map(|message| Publication::Predicted(message, arrived)));
    }

    fn say(&self, publication: Result<Publication, NotFinite>) {
        match publication {
            Ok(publication) => self.outputs.send(publication),
            Err(error) => warn!("not sent: {error}"),
        }
    }
}
