//! What lags behind the stream: a window's physics are learned, and predictions made, on another core while the
//! motion of the next window is looked at.
//!
//! What is learned and predicted does not depend on when: everything is taken in its order, each frame with the
//! learner of its time.

use std::collections::VecDeque;
use std::sync::Arc;

use super::forecast::{Forecaster, mechanism_of};
use super::rest::RestReading;
use super::{Clock, Frame, Learner, Output, WindowJob};
use crate::model::Contact;
use crate::types::{AppliedWrench, Stamp};

/// Frames that wait at most: a stream without windows is not kept.
const MOST_FRAMES: usize = 64;

/// What waits.
pub(super) enum News {
    /// A reading.
    Wrench(AppliedWrench),
    /// A frame as it was measured.
    Frame {
        /// The frame.
        frame: Frame,
        /// What it is tracked with.
        learner: Option<Arc<Learner>>,
        /// Time zero.
        zero: Stamp,
        /// What the sensor reads untouched.
        rest: RestReading,
    },
    /// A window was learned in the stream.
    Learned(Arc<Learner>),
    /// A window's motion was; its physics are to be.
    Lesson(Box<Lesson>),
}

/// A window whose physics are not learned yet.
pub(super) struct Lesson {
    /// Knows the window's motion, and keeps every window that its physics are learned with.
    pub learner: Learner,
    /// The window.
    pub job: WindowJob,
    /// What was touched in it.
    pub contacts: Vec<Contact>,
    /// What its motion took \[s\].
    pub wall_s: f64,
    /// By which to time the rest.
    pub clock: Clock,
}

impl Lesson {
    /// Learns the physics on from those of the windows before.
    fn finish(self, before: Option<&Learner>) -> (Arc<Learner>, Output) {
        let Self { mut learner, job, contacts, wall_s, clock } = self;
        let begin = clock();
        if let Some(before) = before {
            learner.take_physics_of(before);
        }
        learner.learn_physics(&job, &contacts);
        learner.retire();
        let wall_s = wall_s + clock() - begin;
        (Arc::new(learner), Output::Learned { span_s: job.span_s(), wall_s })
    }
}

/// What the stream brought and nobody was told yet.
pub(super) struct Backlog {
    /// Knows all but what waits; `None`: nothing is predicted.
    pub forecaster: Option<Forecaster>,
    /// What was learned with the physics of the last window that has them, if they lag.
    learned: Option<Arc<Learner>>,
    waiting: VecDeque<News>,
    frames: usize,
    may_lag: bool,
}

impl Backlog {
    /// Nothing waits; nothing ever does unless it `may_lag`.
    pub fn new(forecaster: Option<Forecaster>, may_lag: bool) -> Self {
        Self { forecaster, learned: None, waiting: VecDeque::new(), frames: 0, may_lag }
    }

    /// Whether physics may be learned later.
    pub fn may_lag(&self) -> bool {
        self.may_lag
    }

    /// What was learned, where physics lag.
    pub fn learned(&self) -> Option<&Arc<Learner>> {
        self.learned.as_ref()
    }

    /// Takes in what came; returns what is said of it, unless it waits.
    pub fn push(&mut self, news: News) -> Vec<Output> {
        if self.forecaster.is_none() && !matches!(news, News::Lesson(_)) {
            return Vec::new();
        }
        self.frames += usize::from(matches!(news, News::Frame { .. }));
        self.waiting.push_back(news);
        if self.may_lag && self.frames <= MOST_FRAMES { Vec::new() } else { self.catch_up() }
    }

    /// Learns and predicts from all that waits.
    pub fn catch_up(&mut self) -> Vec<Output> {
        self.frames = 0;
        let mut outputs = Vec::new();
        for news in std::mem::take(&mut self.waiting) {
            let learned = match news {
                News::Wrench(wrench) => {
                    let forecaster = self.forecaster.iter_mut();
                    outputs.extend(forecaster.flat_map(|forecaster| forecaster.push_wrench(&wrench)));
                    continue;
                }
                News::Frame { frame, learner, zero, rest } => {
                    if let Some(forecaster) = &mut self.forecaster {
                        outputs.extend(forecaster.push_frame(frame, learner.as_deref(), zero, rest));
                    }
                    continue;
                }
                News::Learned(learner) => learner,
                News::Lesson(lesson) => {
                    let (learner, said) = lesson.finish(self.learned.as_deref());
                    self.learned = Some(Arc::clone(&learner));
                    outputs.push(said);
                    learner
                }
            };
            if let Some(forecaster) = &mut self.forecaster {
                forecaster.learned(&learned, mechanism_of(&learned), None);
            }
        }
        outputs
    }

    /// The same at the end of the stream, with the rest.
    pub fn finish(&mut self) -> Vec<Output> {
        let mut outputs = self.catch_up();
        outputs.extend(self.forecaster.iter_mut().flat_map(Forecaster::finish));
        outputs
    }
}
