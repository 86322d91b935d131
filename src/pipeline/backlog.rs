//! Predictions beside learning: what the stream brought is kept until a window is learned, and is predicted
//! from on another core meanwhile.
//!
//! What is predicted does not depend on when: everything is taken in its order, with the learner of its time.

use std::collections::VecDeque;
use std::sync::Arc;

use super::forecast::{Forecaster, mechanism_of};
use super::rest::RestReading;
use super::{Frame, Learner, Output};
use crate::types::{AppliedWrench, Stamp};

/// Frames that wait at most: a stream without windows is not kept.
const MOST_FRAMES: usize = 64;

/// What the forecaster is told.
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
}

/// A forecaster and what it was not told yet.
pub(super) struct Backlog {
    /// Knows all but what waits.
    pub forecaster: Forecaster,
    waiting: VecDeque<News>,
    frames: usize,
    may_wait: bool,
}

impl Backlog {
    /// Nothing waits; nothing ever does unless it `may_wait`.
    pub fn new(forecaster: Forecaster, may_wait: bool) -> Self {
        Self { forecaster, waiting: VecDeque::new(), frames: 0, may_wait }
    }

    /// Takes in what came; returns predictions, unless they wait.
    pub fn push(&mut self, news: News) -> Vec<Output> {
        self.frames += usize::from(matches!(news, News::Frame { .. }));
        self.waiting.push_back(news);
        if self.may_wait && self.frames <= MOST_FRAMES { Vec::new() } else { self.catch_up() }
    }

    /// Predictions from all that waits.
    pub fn catch_up(&mut self) -> Vec<Output> {
        self.frames = 0;
        let mut outputs = Vec::new();
        for news in self.waiting.drain(..) {
            match news {
                News::Wrench(wrench) => outputs.extend(self.forecaster.push_wrench(&wrench)),
                News::Frame { frame, learner, zero, rest } => {
                    outputs.extend(self.forecaster.push_frame(frame, learner.as_deref(), zero, rest));
                }
                News::Learned(learner) => self.forecaster.learned(&learner, mechanism_of(&learner), None),
            }
        }
        outputs
    }

    /// The same at the end of the stream, with the rest.
    pub fn finish(&mut self) -> Vec<Output> {
        let mut outputs = self.catch_up();
        outputs.extend(self.forecaster.finish());
        outputs
    }
}
