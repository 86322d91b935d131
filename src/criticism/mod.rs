//! Finds what the model lacks: residual, candidates, refit, verdict (DESIGN.md section 7).
//!
//! Every window is in the batch that hypotheses are fitted to. The evidence of a hypothesis is the
//! product of the predictive densities of the windows, each by those before it, so that comparing
//! evidence compares predictions of what was not learned yet.

mod findings;
mod foretold;
mod held_out;
mod numbers;
mod rest;
mod score;
mod selection;
mod signature;
mod statistics;

pub use foretold::ForetoldWindow;
pub use numbers::{Addition, Numbers, Workshop};
use selection::components;
pub use selection::{Component, Selection, Selector, Step};

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::inference::Failure;
use crate::mechanism::JointType;
use crate::mechanism::effects::TableKind;
use crate::model::{BatchWindow, DynamicsInput, DynamicsLearner, Hypothesis, KinematicFit};
use crate::types::Label;
use crate::types::posterior::{Criticism, EffectPosterior, Quantity, ResidualScore, Verdict};
use foretold::Foretold;
use rest::RestReadings;
use score::{Scores, scores};

/// Linearizations of a fit in which windows have the process noise of the usual one, which is not chosen anew.
const EVEN: (usize, usize) = (8, 0);
/// κ of a window that keeps its own there, in units of the usual one's.
const APART: f64 = 10.0;
/// Windows of the same joints that are looked at together at most: of one joint and of several, which have more
/// numbers.
const MOST_WINDOWS: (usize, usize) = (8, 12);
/// Standard deviations of the sensor's errors by the prior: force \[N\], torque \[N·m\], delay \[s\].
const SENSOR_SCALES: [f64; 3] = [1.0, 0.2, 0.05];

/// Follows a learner and says what it lacks.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Critic {
    /// The last selection.
    #[serde(skip)]
    pub selection: Option<Selection>,
    findings: Option<Criticism>,
    /// Windows since the last review that were foretold.
    #[serde(default)]
    foretold: Foretold,
    /// Whether the last review found what no window told but those that it was learned of.
    #[serde(default)]
    guesses: bool,
    /// Whether the last review failed.
    #[serde(default)]
    failed: bool,
    /// Whether reviews look at windows of several joints that clouds see: from when such are not explained on, unless
    /// nothing is found then.
    #[serde(default)]
    costly: bool,
    adopted: bool,
    /// The joints that the last selection's numbers are about, and the numbers.
    known: Option<(Vec<Label>, Numbers)>,
    /// The models on the way to the last selection.
    stages: Vec<Step>,
    /// What the last review looked at.
    reviewed: Vec<Reviewed>,
}

/// A window under review, whatever its place among those that are kept: when it begins \[s\], and which joints
/// of which types move in it.
type Reviewed = (f64, Vec<(Label, JointType)>);

/// A model on the way from the declared physics to what was selected, fitted to all windows.
#[derive(Clone, Debug)]
pub struct Stage {
    /// What it has beyond the declared physics, by joint; none for the sensor's.
    pub effects: Vec<(Option<Label>, &'static str)>,
    /// The model.
    pub hypothesis: Hypothesis,
    /// Its numbers.
    pub x: Vec<f64>,
    /// κ of a window, at the median.
    pub noise_scale: f64,
}

impl Critic {
    /// What was found by the last review and by windows that were foretold.
    pub fn findings(&self) -> Criticism {
        let mut all = self.foretold.joined_to(self.findings.as_ref());
        if self.failed && all.verdict == Verdict::Adequate {
            all.verdict = Verdict::Unexplained;
        }
        all
    }

    /// The newest window, not learned yet, as what was learned so far foretells it; `None` where it is reviewed in
    /// any case, or where a joint moves for the first time.
    pub fn foretell(
        &self,
        learner: &DynamicsLearner,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
    ) -> Option<ForetoldWindow> {
        let least = if self.costly { 1 } else { 2 };
        learner.declared().criticism.then(|| ForetoldWindow::of(learner, fit, input, least)).flatten()
    }

    /// The same window once it is learned. Returns whether it calls for a review of windows of several joints.
    fn note_foretold(
        &mut self,
        newest: Option<ForetoldWindow>,
        learner: &DynamicsLearner,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
    ) -> bool {
        let is_foretold = newest.is_some();
        self.foretold.take(newest, learner, fit, input);
        if self.costly {
            !is_foretold || self.foretold.newest_misfits()
        } else {
            self.foretold.is_unexplained() || (is_foretold && self.guesses && self.foretold.is_judged())
        }
    }

    /// After a review that failed: what was found before stands, but not that it was enough.
    pub const fn note_failure(&mut self) {
        self.failed = true;
    }

    /// Looks at all windows so far, of which the newest was `foretold`; effects that they call for are in the
    /// learner's model after it. Returns the linearizations spent.
    ///
    /// # Errors
    /// Where no hypothesis could be fitted: the findings are then as before; see [`Critic::note_failure`].
    pub fn review(
        &mut self,
        learner: &mut DynamicsLearner,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        foretold: Option<ForetoldWindow>,
    ) -> Result<usize, Failure> {
        if !learner.declared().criticism {
            return Ok(0);
        }
        let called = self.note_foretold(foretold, learner, fit, input);
        if self.costly && !called {
            return Ok(0);
        }
        self.costly |= called;
        let batch = learner.batch(fit, input, MOST_WINDOWS, self.costly);
        if batch.is_empty() {
            return Ok(0);
        }
        let joint = |k: &usize| (fit.joints[*k].child, fit.joints[*k].joint_type);
        let looked_at = |w: &BatchWindow| {
            (input.windows[w.index].times_s.first().copied().unwrap_or(0.0), w.moving.iter().map(joint).collect())
        };
        let reviewed: Vec<Reviewed> = batch.iter().map(looked_at).collect();
        if reviewed == self.reviewed {
            return Ok(0);
        }
        let rest = RestReadings::of(&batch, input, &SENSOR_SCALES);
        let spans = spans_of(input);
        let rest_prior = rest.as_ref().and_then(RestReadings::posterior);
        let labels: Vec<Label> = fit.joints.iter().map(|joint| joint.child).collect();
        let (joints, sensor) = learner.numbers()?;
        let known = self.known.as_ref().filter(|(of, _)| *of == labels);
        let known_joints = known.is_some();
        let added = known.map_or_else(BTreeMap::new, |(_, numbers)| numbers.added.clone());
        let numbers = Numbers { joints, sensor, added };
        let (selected, findings, with, seed, guesses) = {
            let workshop =
                Workshop { learner, fit, input, rest_prior: rest_prior.clone(), sensor_scales: SENSOR_SCALES, spans };
            let found = self.stages.last().map(|step| step.additions.clone()).unwrap_or_default();
            let found = Some(&found).filter(|_| known_joints);
            let selector = Selector { workshop: &workshop, batch: &batch, rest: rest.as_ref(), found };
            let base = selector.base(&numbers)?;
            tracing::debug!(evidence = base.log_evidence, additions = ?base.additions, kappa = ?noise_scales(&base, &batch), "base");
            let before = scores(&workshop, &batch, &base).unwrap_or_default();
            let selected = selector.select(base.clone())?;
            // A window that no hypothesis comes near, while the others are explained, is none of the physics'.
            let outlying = outlying(&selected, &batch);
            let rest_of_batch: Vec<BatchWindow> = batch
                .iter()
                .enumerate()
                .filter(|(w, _)| !outlying.contains(w))
                .map(|(_, window)| window.clone())
                .collect();
            let batch = &rest_of_batch[..];
            let selector = Selector { batch, ..selector };
            let (base, before, selected) = if outlying.is_empty() {
                (base, before, selected)
            } else {
                tracing::debug!(?outlying, "windows left out");
                let base = selector.base(&base.numbers)?;
                let before = scores(&workshop, batch, &base).unwrap_or_default();
                (base.clone(), before, selector.select(base)?)
            };
            let (selected, drifting) = selector.describe_leftover(selected)?;
            let (mut selected, mut after) = confirmed(&selector, &base, &before, selected)?;
            // Nor is a last addition there that does not predict better.
            let all: Vec<usize> = (0..batch.len()).collect();
            while let Some(fewer) = selector.before_last(&selected).filter(|_| !after.densities.is_empty())
                && let Ok(found) = scores(&workshop, batch, &fewer)
                && (found.better_on(&all, &after) == Some(true)
                    || (only_timed(&selected, &fewer) && found.simulates_better_than(&after)))
            {
                tracing::debug!(additions = ?selected.additions, "predicts no better than the model before it");
                (selected, after) = (fewer, found);
            }
            let seed = (selected.numbers.clone(), selected.stages.clone());
            // What no window tells but those that it was learned of is a guess, kept to start from.
            let unscored = joints_of(
                parts_with(batch, &selected)
                    .filter(|part| part.windows.iter().all(|w| !before.densities.contains_key(w))),
            );
            let all_found = selected.rivals.len();
            if !unscored.is_empty() {
                selected = selector.restored(selected, &base, &unscored, false)?;
            }
            let scored = selected.rivals.len();
            let mut published = published(&workshop, batch, &selected)?;
            let of_axes = explained_by_axes(&published.1, fit);
            if !of_axes.is_empty() {
                tracing::debug!(?of_axes, "no greater than the error of an axis");
                selected = selector.restored(selected, &base, &of_axes, false)?;
                after = scores(&workshop, batch, &selected)?;
                published = self::published(&workshop, batch, &selected)?;
            }
            tracing::debug!(evidence = selected.log_evidence, steps = selected.steps, additions = ?selected.additions,
                kappa = ?noise_scales(&selected, batch), before = before.log_predictive_density(), after = after.log_predictive_density(), "selected");
            // What weighs most decides: a name beside a stronger unknown explains little.
            let loss = |addition: &Addition| {
                let rivals = selected.rivals.get(addition)?;
                rivals.iter().find(|(rival, _)| rival.is_none()).map(|(_, difference)| -difference)
            };
            let found = selected.additions.iter().filter_map(|a| Some((loss(a)?, a)));
            let named = found.max_by(|a, b| a.0.total_cmp(&b.0)).is_some_and(|(_, a)| a.name() != "unknown");
            let unknown = unknown_joints(&workshop, batch, &selected, &drifting, &after);
            let nothing_found = selected.rivals.is_empty();
            let verdict = match () {
                () if before.densities.len() < 2 => Verdict::Insufficient,
                () if named => Verdict::EffectFound,
                () if !nothing_found || !unknown.is_empty() || leaves_much(&workshop, &selected, &after) => {
                    Verdict::Unexplained
                }
                () => Verdict::Adequate,
            };
            let mut findings = Criticism { verdict, effects: Vec::new(), before: before.rows, after: after.rows };
            if nothing_found && findings.verdict == Verdict::Unexplained {
                let left = |joint: &usize| after.left.get(joint).map_or(&[][..], Vec::as_slice);
                findings.effects =
                    unknown.iter().map(|joint| findings::unknown(&fit.joints[*joint], left(joint))).collect();
            }
            let found = findings.verdict != Verdict::Insufficient && !nothing_found;
            let guesses = scored < all_found || (!nothing_found && !found);
            let with = if found {
                findings.effects = published.1;
                published.0
            } else if self.adopted {
                let stops = selected.additions.iter().filter(|a| a.is_stop()).copied().collect();
                Some(taken_over(&workshop, batch, &selected, &stops)?.0)
            } else {
                None
            };
            self.adopted = found;
            (selected, findings, with, seed, guesses)
        };
        if let Some(with) = with {
            *learner = with;
        }
        let steps = selected.steps;
        (self.guesses, self.failed) = (guesses, false);
        let is_scored = findings.verdict != Verdict::Insufficient;
        self.known = Some((labels, seed.0));
        self.stages = seed.1;
        self.findings = Some(findings);
        self.selection = Some(selected);
        self.reviewed = reviewed;
        if self.costly && is_scored {
            self.foretold = Foretold::default();
            self.costly = self.adopted;
        }
        Ok(steps)
    }
}

impl Critic {
    /// The declared physics, and with it every model on the way to the last selection, each fitted anew to
    /// all windows with the process noise of the usual one, but for windows that need far more.
    ///
    /// # Errors
    /// Where one of them cannot be fitted.
    pub fn stages(
        &self,
        learner: &DynamicsLearner,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
    ) -> Result<Vec<Stage>, Failure> {
        let batch = learner.batch(fit, input, MOST_WINDOWS, self.costly);
        let rest = RestReadings::of(&batch, input, &SENSOR_SCALES);
        let rest_prior = rest.as_ref().and_then(RestReadings::posterior);
        let (joints, sensor) = learner.numbers()?;
        let labels: Vec<Label> = fit.joints.iter().map(|joint| joint.child).collect();
        let known = self.known.as_ref().filter(|(of, _)| *of == labels).map(|(_, numbers)| numbers.clone());
        let numbers = known.unwrap_or_else(|| Numbers { joints, sensor, added: BTreeMap::new() });
        let workshop =
            Workshop { learner, fit, input, rest_prior, sensor_scales: SENSOR_SCALES, spans: spans_of(input) };
        let selector = Selector { workshop: &workshop, batch: &batch, rest: rest.as_ref(), found: None };
        let mut selections = vec![selector.base(&numbers)?];
        for step in &self.stages {
            // From where it was found and from where all ended.
            let fits = [&step.numbers, &numbers].map(|start| selector.fitted(&step.additions, start, (12, 2)));
            let best = fits.into_iter().flatten().max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence));
            let mut best = best.ok_or(Failure::Diverged)?;
            selector.settle(&mut best)?;
            selections.push(best);
        }
        let stage = |selection: Selection| {
            let hypothesis = workshop.hypothesis(&selection.additions)?;
            let named = selection.additions.iter().filter(|a| !a.is_stop());
            let effects = named.map(|a| (a.joint().map(|joint| fit.joints[joint].child), a.name())).collect();
            let mut x = selection.numbers.laid_out(&hypothesis, &selection.additions);
            // A model that lacks something explains some windows by chance, which would then count for all.
            let noise_scale = crate::math::median(selection.noise_scales_of(None)).unwrap_or(1.0);
            let scales = noise_scales_by_place(&selection);
            for component in &selection.components {
                let windows = selector.windows(&component.windows);
                let usual = usual_noise_scale(component, &scales);
                let own = |w: &usize| scales.get(w).copied().filter(|scale| *scale > APART * usual);
                let even: Vec<f64> = component.windows.iter().map(|w| own(w).unwrap_or(usual)).collect();
                x = hypothesis.fit(&windows, &x, &even, EVEN)?.x;
            }
            Ok(Stage { effects, hypothesis, x, noise_scale })
        };
        selections.into_iter().map(stage).collect()
    }
}

/// Residual that is no noise: κ of a joint's windows at the median, and the share of the joint's usual force.
const MUCH: (f64, f64) = (30.0, 0.3);

/// Whether a joint's residual force is large, and explained by process noise alone.
fn leaves_much(workshop: &Workshop<'_>, selection: &Selection, scores: &Scores) -> bool {
    (0..workshop.fit.joints.len()).any(|joint| {
        let scales = selection.noise_scales_of(Some(joint));
        let is_usual = crate::math::median(scales.clone()).is_some_and(|scale| scale >= MUCH.0);
        is_usual && several_by_noise(scales.into_iter()) && leaves(workshop, scores, joint, MUCH.1)
    })
}

/// Whether a joint's residual force is at least such a share of its usual one.
fn leaves(workshop: &Workshop<'_>, scores: &Scores, joint: usize, share: f64) -> bool {
    let row = scores.rows.iter().find(|row| row.label == workshop.fit.joints[joint].child);
    let usual = workshop.learner.joint_scales(joint, workshop.fit);
    row.and_then(ResidualScore::force_rmse).zip(usual).is_some_and(|(force, usual)| force >= share * usual.force)
}

/// Windows that noise alone explains, of one joint: one may be an accident, so many are none.
const NO_ACCIDENT: usize = 2;
/// And the share of the joint's usual force that is left.
const SOME: f64 = 0.05;

/// Whether noise alone explains several windows, by their κ.
fn several_by_noise(scales: impl Iterator<Item = f64>) -> bool {
    scales.filter(|scale| *scale >= MUCH.0).count() >= NO_ACCIDENT
}

/// Joints of which several windows are explained by process noise alone, or that are `drifting`: what acts on
/// those has no name here.
fn unknown_joints(
    workshop: &Workshop<'_>,
    batch: &[BatchWindow],
    selection: &Selection,
    drifting: &BTreeSet<usize>,
    scores: &Scores,
) -> Vec<usize> {
    let scales = noise_scales_by_place(selection);
    let by_noise = |joint: &usize| {
        let own = scales.iter().filter(|(w, _)| batch[**w].moving.contains(joint));
        several_by_noise(own.map(|(_, scale)| *scale))
    };
    let is_felt = |joint: &usize| leaves(workshop, scores, *joint, SOME);
    (0..workshop.fit.joints.len())
        .filter(|joint| drifting.contains(joint) || (by_noise(joint) && is_felt(joint)))
        .collect()
}

/// Beginning and end of each window \[s\].
fn spans_of(input: &DynamicsInput<'_>) -> Vec<[f64; 2]> {
    input.windows.iter().filter_map(|w| Some([*w.times_s.first()?, *w.times_s.last()?])).collect()
}

/// κ by window.
fn noise_scales(selection: &Selection, batch: &[BatchWindow]) -> Vec<(usize, f64)> {
    noise_scales_by_place(selection).into_iter().map(|(w, scale)| (batch[w].index, scale)).collect()
}

/// κ of a window that a model does not come near, at least and in units of the usual one.
const OUTLYING: (f64, f64) = (1e4, 30.0);

/// Windows of some joints, by place in the batch, with κ.
fn noise_scales_by_place(selection: &Selection) -> BTreeMap<usize, f64> {
    let fitted = selection.components.iter().filter_map(|c| Some((&c.windows, c.fitted.as_ref()?)));
    fitted.flat_map(|(places, fit)| places.iter().copied().zip(fit.windows.iter().map(|w| w.noise_scale))).collect()
}

/// κ of the usual window of joints that move together.
fn usual_noise_scale(part: &Component, scales: &BTreeMap<usize, f64>) -> f64 {
    crate::math::median(part.windows.iter().filter_map(|w| scales.get(w).copied()).collect()).unwrap_or(1.0)
}

/// Places in the batch of the windows that the selected model does not come near, where most that move the same
/// joints are explained.
fn outlying(selection: &Selection, batch: &[BatchWindow]) -> Vec<usize> {
    let scales = noise_scales_by_place(selection);
    let mut all = Vec::new();
    for part in components(batch, false) {
        let least = OUTLYING.0.max(OUTLYING.1 * usual_noise_scale(&part, &scales));
        let is_far = |w: &&usize| scales.get(w).is_some_and(|scale| *scale >= least);
        let far: Vec<usize> = part.windows.iter().filter(is_far).copied().collect();
        if 3 * far.len() <= part.windows.len() {
            all.extend(far);
        }
    }
    all
}

/// Share of the windows of joints that clouds see move together which a model has to explain with hardly more noise
/// than the sensor's.
const CLEAR_WINDOWS: f64 = 0.75;

/// Whether clouds see joints move together, and too few of their windows are explained: what one of them lacks shows
/// in the others, so that a name helps without being the right one.
fn is_vague(selector: &Selector<'_>, part: &Component, scales: &BTreeMap<usize, f64>) -> bool {
    let input = selector.workshop.input;
    let costly = |w: &usize| selector.batch[*w].is_costly(input);
    let clear = part.windows.iter().filter(|w| scales.get(w).is_some_and(|scale| *scale < selection::MISFIT)).count();
    part.windows.iter().any(costly) && (clear as f64) < CLEAR_WINDOWS * part.windows.len() as f64
}

fn joints_of(parts: impl Iterator<Item = Component>) -> Vec<usize> {
    parts.flat_map(|part| part.joints).collect()
}

/// Joints that move together, where something was added to one of them.
fn parts_with(batch: &[BatchWindow], selected: &Selection) -> impl Iterator<Item = Component> {
    let joints: BTreeSet<usize> = selected.rivals.keys().filter_map(|addition| addition.joint()).collect();
    components(batch, false).into_iter().filter(move |part| part.joints.iter().any(|joint| joints.contains(joint)))
}

/// A parameter is clearly there whose 90 % interval stays above this share of its median.
const CLEARLY_THERE: f64 = 0.1;

/// The learner with a selected model's numbers, and some of its additions, taken over; and the model.
fn taken_over(
    workshop: &Workshop<'_>,
    batch: &[BatchWindow],
    selected: &Selection,
    additions: &BTreeSet<Addition>,
) -> Result<(DynamicsLearner, Hypothesis), Failure> {
    let hypothesis = workshop.hypothesis(additions)?;
    let x = selected.numbers.laid_out(&hypothesis, additions);
    let prior = workshop.rest_prior.as_ref().filter(|_| additions.contains(&Addition::Bias));
    let mut learner = workshop.learner.clone();
    learner.adopt(&hypothesis, &x, &noise_scales(selected, batch), prior, (workshop.fit, workshop.input))?;
    Ok((learner, hypothesis))
}

/// The learner with a selected model taken over, where it adds anything, and the effects as published.
fn published(
    workshop: &Workshop<'_>,
    batch: &[BatchWindow],
    selected: &Selection,
) -> Result<(Option<DynamicsLearner>, Vec<EffectPosterior>), Failure> {
    if selected.rivals.is_empty() {
        return Ok((None, Vec::new()));
    }
    let (learner, hypothesis) = taken_over(workshop, batch, selected, &selected.additions)?;
    let effects = findings::effects(&learner, &hypothesis, selected, workshop.fit);
    Ok((Some(learner), effects))
}

/// Joints all of whose effects vanish within what the errors of the axes leave open of them: evidence is taken at
/// the axes as they were fitted, published spreads are not.
fn explained_by_axes(effects: &[EffectPosterior], fit: &KinematicFit) -> Vec<usize> {
    let mut clear: BTreeMap<Label, bool> = BTreeMap::new();
    for effect in effects {
        let Some(label) = effect.label else { continue };
        let is_clear = |q: &Quantity| (q.q05 / q.median).min(q.q95 / q.median) > CLEARLY_THERE;
        *clear.entry(label).or_default() |= effect.parameters.values().any(is_clear);
    }
    let vague = clear.into_iter().filter(|(_, clear)| !clear).map(|(label, _)| label);
    vague.filter_map(|label| fit.joints.iter().position(|joint| joint.child == label)).collect()
}

/// Whether all that a model has more than another is a force over time, which says nothing of other windows.
fn only_timed(selected: &Selection, fewer: &Selection) -> bool {
    let mut more = selected.additions.difference(&fewer.additions);
    more.all(|addition| matches!(addition, Addition::Table(_, TableKind::ForceOverTime)))
}

/// The selected model and its scores, without what the windows that it concerns do not bear out, joints that
/// move together apart from the others.
///
/// # Errors
/// Where no joint's windows are explained better than by noise.
fn confirmed(
    selector: &Selector<'_>,
    base: &Selection,
    before: &Scores,
    mut selected: Selection,
) -> Result<(Selection, Scores), Failure> {
    let batch = selector.batch;
    let parts = components(batch, false);
    // What explains most windows no better than noise would says nothing of what they lack.
    let scales = noise_scales_by_place(&selected);
    let by_noise =
        |part: &Component| usual_noise_scale(part, &scales) >= OUTLYING.0 || is_vague(selector, part, &scales);
    if parts.iter().all(by_noise) {
        return Err(Failure::Diverged);
    }
    let hopeless = joints_of(parts.into_iter().filter(by_noise));
    if !hopeless.is_empty() {
        tracing::debug!(?hopeless, "explained by noise alone");
        selected = selector.restored(selected, base, &hopeless, false)?;
    }
    let all: Vec<usize> = (0..batch.len()).collect();
    while !selected.rivals.is_empty() {
        // What does not predict windows not yet learned better is not there.
        let after = scores(selector.workshop, batch, &selected)?;
        let worse = |windows: &[usize]| after.better_on(windows, before) == Some(false);
        let refuted = joints_of(parts_with(batch, &selected).filter(|part| worse(&part.windows)));
        let of_sensor = selected.rivals.keys().any(|addition| addition.joint().is_none());
        let sensor = of_sensor && refuted.is_empty() && worse(&all);
        if refuted.is_empty() && !sensor {
            return Ok((selected, after));
        }
        tracing::debug!(?refuted, sensor, before = ?before.densities, after = ?after.densities, "predicts no better");
        selected = selector.restored(selected, base, &refuted, sensor)?;
    }
    Ok((selected, before.clone()))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_review_that_failed_calls_nothing_adequate() {
        for (before, after) in [
            (Verdict::Adequate, Verdict::Unexplained),
            (Verdict::EffectFound, Verdict::EffectFound),
            (Verdict::Insufficient, Verdict::Insufficient),
        ] {
            let findings = Criticism { verdict: before, ..Criticism::insufficient() };
            let mut critic = Critic { findings: Some(findings), ..Critic::default() };
            critic.note_failure();
            assert_eq!(critic.findings().verdict, after);
        }
    }
}
