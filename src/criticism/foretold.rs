//! Windows in which several joints move that clouds see. Hypotheses of those cost seconds a window, so what was
//! learned before foretells them, and only where that leaves too much are they reviewed.

use std::collections::BTreeMap;

use serde::{Deserialize, Serialize};

use super::score::{HORIZON_S, JointScore, row};
use super::selection::MISFIT;
use super::{MOST_WINDOWS, NO_ACCIDENT, SOME, findings, several_by_noise};
use crate::math::median;
use crate::mechanism::JointType;
use crate::model::{DynamicsInput, DynamicsLearner, KinematicFit, WindowInference};
use crate::types::Label;
use crate::types::posterior::{Criticism, Verdict};

/// κ of a window that could not be learned.
const NEVER_LEARNED: f64 = 1e5;

/// The windows, and what they say.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Foretold {
    windows: Vec<ForetoldWindow>,
    findings: Option<Criticism>,
}

/// A window that was foretold, by the joints that move in it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ForetoldWindow {
    /// When it begins \[s\].
    begins_s: f64,
    joints: Vec<Score>,
    /// κ, the greatest that it was learned with: numbers that explain it may have been made of it, and others need
    /// more.
    noise_scale: f64,
}

#[derive(Clone, Debug, Serialize, Deserialize)]
struct Score {
    label: Label,
    joint_type: JointType,
    left: JointScore,
    /// The joint's usual force \[N or N·m\].
    usual: f64,
}

impl ForetoldWindow {
    /// The last window of `input` before it is learned; `None` where poses are measured, where fewer joints move, or
    /// where one moves for the first time.
    pub fn of(
        learner: &DynamicsLearner,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        least_moving: usize,
    ) -> Option<Self> {
        let (moving, residual) = learner.foretold(fit, input, least_moving, HORIZON_S)?;
        let score = |(column, k): (usize, &usize)| {
            let joint = &fit.joints[*k];
            let usual = learner.joint_scales(*k, fit)?.force;
            let left = JointScore::of(&residual, column, None);
            Some(Score { label: joint.child, joint_type: joint.joint_type, left, usual })
        };
        let joints = moving.iter().enumerate().map(score).collect::<Option<Vec<Score>>>()?;
        Some(Self { begins_s: *input.windows.last()?.times_s.first()?, joints, noise_scale: 1.0 })
    }

    /// The same once it is learned.
    #[must_use]
    pub fn learned(mut self, inference: &WindowInference) -> Self {
        self.noise_scale = if inference.failure.is_some() { NEVER_LEARNED } else { inference.noise_scale };
        let log_density = inference.failure.is_none().then_some(inference.log_predictive_density);
        self.joints.iter_mut().for_each(|score| score.left.log_density = log_density);
        self
    }

    fn score_of(&self, label: Label) -> Option<&Score> {
        self.joints.iter().find(|score| score.label == label)
    }
}

impl Foretold {
    /// Takes the newest window in, once it is learned.
    pub fn take(
        &mut self,
        newest: Option<ForetoldWindow>,
        learner: &DynamicsLearner,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
    ) {
        self.windows.extend(newest);
        let is_there = |score: &Score| {
            fit.joints.iter().any(|joint| (joint.child, joint.joint_type) == (score.label, score.joint_type))
        };
        self.windows.retain(|window| window.joints.iter().all(is_there));
        let surplus = self.windows.len().saturating_sub(MOST_WINDOWS.1);
        self.windows.drain(..surplus);
        for window in &mut self.windows {
            let begins = |w: &usize| input.windows[*w].times_s.first() == Some(&window.begins_s);
            let now = (0..input.windows.len()).find(begins).and_then(|w| learner.noise_scale(w));
            window.noise_scale = window.noise_scale.max(now.unwrap_or(0.0));
        }
        self.findings = (!self.windows.is_empty()).then(|| self.judged(fit));
    }

    /// Whether the newest window needs more noise than the sensor explains.
    pub fn newest_misfits(&self) -> bool {
        self.windows.last().is_some_and(|window| window.noise_scale >= MISFIT)
    }

    /// Whether there are enough to judge.
    pub const fn is_judged(&self) -> bool {
        self.windows.len() >= 2
    }

    /// Whether something is missing there.
    pub fn is_unexplained(&self) -> bool {
        self.findings.as_ref().is_some_and(|findings| findings.verdict == Verdict::Unexplained)
    }

    /// The findings of a review together with what these windows say of the joints that it did not look at.
    pub fn joined_to(&self, reviewed: Option<&Criticism>) -> Criticism {
        let mut all = reviewed.cloned().unwrap_or_else(Criticism::insufficient);
        let Some(own) = &self.findings else { return all };
        let new: Vec<_> =
            own.before.iter().filter(|row| all.before.iter().all(|other| other.label != row.label)).cloned().collect();
        all.before.extend(new.iter().cloned());
        all.after.extend(new);
        let named = |label: Option<Label>| all.effects.iter().any(|effect| effect.label == label);
        let unknown: Vec<_> = own.effects.iter().filter(|effect| !named(effect.label)).cloned().collect();
        all.effects.extend(unknown);
        all.verdict = match (all.verdict, own.verdict) {
            (Verdict::EffectFound, _) => Verdict::EffectFound,
            (Verdict::Unexplained, _) | (_, Verdict::Unexplained) => Verdict::Unexplained,
            (Verdict::Insufficient, other) => other,
            (Verdict::Adequate, _) => Verdict::Adequate,
        };
        all
    }

    fn judged(&self, fit: &KinematicFit) -> Criticism {
        let mut findings = Criticism::insufficient();
        let mut by_joint: BTreeMap<usize, Vec<JointScore>> = BTreeMap::new();
        let mut missing = Vec::new();
        for (k, joint) in fit.joints.iter().enumerate() {
            let seen = self.windows.iter().filter_map(|w| Some((w.noise_scale, w.score_of(joint.child)?)));
            let (scales, scores): (Vec<f64>, Vec<&Score>) = seen.unzip();
            if scores.is_empty() {
                continue;
            }
            let usual = median(scores.iter().map(|s| s.usual).collect()).unwrap_or(f64::INFINITY);
            let force = median(scores.iter().map(|s| s.left.force_square().sqrt()).collect()).unwrap_or(0.0);
            tracing::debug!(label = %joint.child, force, usual, ?scales, "foretold");
            let share = if several_by_noise(scales.iter().copied()) { SOME } else { 1.0 };
            if scales.len() >= NO_ACCIDENT && force >= share * usual {
                missing.push(k);
            }
            by_joint.insert(k, scores.into_iter().map(|s| s.left.clone()).collect());
        }
        findings.before = by_joint.iter().map(|(k, scores)| row(&fit.joints[*k], scores)).collect();
        findings.before.sort_by_key(|row| row.label);
        findings.after.clone_from(&findings.before);
        if !self.is_judged() {
            return findings;
        }
        findings.verdict = if missing.is_empty() { Verdict::Adequate } else { Verdict::Unexplained };
        let unknown = |k: &usize| {
            let left: Vec<_> = by_joint[k].iter().map(|score| score.force).collect();
            findings::unknown(&fit.joints[*k], &left)
        };
        findings.effects = missing.iter().map(unknown).collect();
        findings
    }
}
