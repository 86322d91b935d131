//! Learning beside the stream: a window that closed goes to a worker, what it learned comes back.
//!
//! Replay learns in the stream, as time stands still there; a live stream does not wait.

use std::sync::Arc;

use super::{Learner, WindowJob};
use crate::math::Pose;
use crate::types::posterior::ObjectPosterior;

/// A window that closed, with what a worker needs to learn it.
#[derive(Clone)]
pub struct ClosedWindow {
    /// Counts the windows handed out.
    pub(super) sequence: u64,
    job: WindowJob,
    /// What was adopted when it closed: where a worker begins that has learned nothing yet.
    learner: Arc<Learner>,
    world_from_work: Pose,
}

impl std::fmt::Debug for ClosedWindow {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClosedWindow").field("span_s", &self.span_s()).finish_non_exhaustive()
    }
}

impl ClosedWindow {
    pub(super) fn new(sequence: u64, job: WindowJob, learner: Arc<Learner>) -> Self {
        Self { sequence, job, learner, world_from_work: Pose::identity() }
    }

    pub(super) fn carried_out(self, world_from_work: &Pose) -> Self {
        Self { world_from_work: *world_from_work, ..self }
    }

    /// Seconds since time zero of its first and last frame.
    pub fn span_s(&self) -> (f64, f64) {
        self.job.span_s()
    }
}

impl std::fmt::Debug for Learned {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Learned").field("span_s", &self.span_s).finish_non_exhaustive()
    }
}

/// What a worker knows after a window.
#[derive(Clone)]
pub struct Learned {
    /// The last window learned.
    pub(super) sequence: u64,
    /// Everything learned so far, for [`Pipeline::adopt`](super::Pipeline::adopt).
    pub learner: Arc<Learner>,
    /// Seconds since time zero of the window's first and last frame.
    pub span_s: (f64, f64),
    /// What is believed now, in world.
    pub posterior: ObjectPosterior,
}

/// Learns windows one after the other, in the order they closed.
#[derive(Default)]
pub struct Worker {
    learner: Option<Arc<Learner>>,
}

impl Worker {
    /// Learns one window.
    pub fn learn(&mut self, window: &ClosedWindow) -> Learned {
        let learner = self.learner.get_or_insert_with(|| Arc::clone(&window.learner));
        // The stream goes on with the one before meanwhile.
        Arc::make_mut(learner).learn(&window.job);
        Learned {
            sequence: window.sequence,
            learner: Arc::clone(learner),
            span_s: window.span_s(),
            posterior: learner.posterior().carried_by(&window.world_from_work),
        }
    }
}
