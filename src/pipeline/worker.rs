//! Learning beside the stream: a window that closed goes to a worker, what it learned comes back, all that
//! the stream needs of it made up beforehand.
//!
//! Replay learns in the stream, as time stands still there; a live stream does not wait.

use std::collections::BTreeMap;
use std::sync::Arc;

use super::forecast::mechanism_of;
use super::windows::CutWindow;
use super::working_frame::hulls;
use super::{FirstLook, Learner};
use crate::geometry::HullProperties;
use crate::math::Pose;
use crate::tracking::TrackedMechanism;
use crate::types::Label;
use crate::types::posterior::ObjectPosterior;

/// Where a worker begins that has learned nothing yet.
#[derive(Clone)]
pub(super) enum Begin {
    /// What was adopted when the window closed.
    Learner(Arc<Learner>),
    /// Nothing was; the object as it was first seen.
    FirstLook(Arc<FirstLook>),
}

/// A window that closed, with what a worker needs to learn it.
#[derive(Clone)]
pub struct ClosedWindow {
    /// Counts the windows handed out.
    pub(super) sequence: u64,
    window: CutWindow,
    begin: Begin,
    world_from_work: Pose,
}

impl std::fmt::Debug for ClosedWindow {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("ClosedWindow").field("span_s", &self.span_s()).finish_non_exhaustive()
    }
}

impl ClosedWindow {
    pub(super) fn new(sequence: u64, window: CutWindow, begin: Begin) -> Self {
        Self { sequence, window, begin, world_from_work: Pose::identity() }
    }

    pub(super) fn carried_out(self, world_from_work: &Pose) -> Self {
        Self { world_from_work: *world_from_work, ..self }
    }

    /// Seconds since time zero of its first and last frame.
    pub fn span_s(&self) -> (f64, f64) {
        self.window.span_s()
    }
}

/// What a worker knows after a window.
#[derive(Clone)]
pub struct Learned {
    /// The last window learned.
    pub(super) sequence: u64,
    /// Whether this was told before, without its review: where parts are is then known already.
    pub(super) again: bool,
    /// Everything learned so far, for [`Pipeline::adopt`](super::Pipeline::adopt).
    pub learner: Arc<Learner>,
    /// Its joints, as tracking needs them; `None` without any.
    pub(super) mechanism: Option<Arc<TrackedMechanism>>,
    /// Seconds since time zero of the window's first and last frame.
    pub span_s: (f64, f64),
    /// What is believed now, in world.
    pub posterior: ObjectPosterior,
    /// Hulls of the parts, in world at the first frame.
    pub hulls: BTreeMap<Label, HullProperties>,
    /// Least and greatest position of each joint of the likeliest tree so far, by child \[m or rad\].
    pub ranges_seen: BTreeMap<Label, (f64, f64)>,
}

impl std::fmt::Debug for Learned {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        f.debug_struct("Learned").field("span_s", &self.span_s).finish_non_exhaustive()
    }
}

/// Models of the parts as they were first seen, for [`Pipeline::adopt_models`](super::Pipeline::adopt_models).
#[derive(Clone)]
pub struct Looked {
    pub(super) learner: Arc<Learner>,
    /// Whether of the whole first look.
    pub(super) whole: bool,
}

/// Learns windows one after the other, in the order they closed.
#[derive(Default)]
pub struct Worker {
    learner: Option<Arc<Learner>>,
}

impl Worker {
    /// Makes the models of the parts as they were first seen.
    pub fn look(&mut self, look: &FirstLook) -> Looked {
        let learner = match &self.learner {
            Some(learner) => Arc::clone(learner),
            None => Arc::new(look.learner()),
        };
        if look.whole {
            self.learner = Some(Arc::clone(&learner));
        }
        Looked { learner, whole: look.whole }
    }

    /// Learns one window. `tell` gets what it says by the physics known so far, before these are reviewed.
    pub fn learn(&mut self, window: ClosedWindow, tell: impl FnOnce(Learned)) -> Learned {
        let ClosedWindow { sequence, window, begin, world_from_work } = window;
        let learner = self.learner.get_or_insert_with(|| match begin {
            Begin::Learner(learner) => learner,
            Begin::FirstLook(look) => Arc::new(look.learner()),
        });
        let span_s = window.span_s();
        let known = |learner: &Arc<Learner>, again: bool| Learned {
            sequence,
            again,
            mechanism: mechanism_of(learner),
            learner: Arc::clone(learner),
            span_s,
            posterior: learner.posterior().carried_by(&world_from_work),
            hulls: hulls(&learner.surfaces(), &world_from_work),
            ranges_seen: learner.ranges_seen(),
        };
        let job = window.job();
        // The stream goes on with the one before meanwhile.
        let learning = Arc::make_mut(learner);
        let contacts = learning.learn_motion(&job);
        let foretold = learning.learn_dynamics(&job, &contacts);
        // Samples are drawn once.
        let is_told = learning.sampling.is_none();
        if is_told {
            tell(known(learner, false));
        }
        let learning = Arc::make_mut(learner);
        learning.review(&job, &contacts, foretold);
        learning.retire();
        known(learner, is_told)
    }
}
