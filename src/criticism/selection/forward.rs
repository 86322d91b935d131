//! Forward selection: what gains most is added, refitted and tried on windows left out, until nothing gains enough.

use std::collections::BTreeSet;

use super::trials::Trial;
use super::{MISFIT, REFIT, Selection, Selector, components};
use crate::criticism::held_out::HeldOut;
use crate::criticism::numbers::Addition;
use crate::inference::Failure;
use crate::mechanism::effects::EffectKind;

/// An addition is accepted if it raises the log evidence by this, and by the logarithm of how many
/// were tried: see docs/criticism.md for the false alarms that it leaves.
const LEAST_GAIN: f64 = 6.0;
/// What gains this from where it was found before is not tried anew as well.
const CLEAR_GAIN: f64 = 50.0;
/// Additions at most.
const MOST: usize = 4;
/// Candidates that gain enough are tried on windows left out until one holds, at most so many.
const HELD_OUT_TRIES: usize = 3;
/// A pulse may be anywhere: it counts as this many candidates.
const PLACES: f64 = 150.0;
/// Of candidates that were glanced at, the best few are refitted.
const REFITTED_OF_CHAINS: usize = 3;
/// What is part of something richer is added first if it explains this share of what that does.
const SIMPLER_SHARE: f64 = 0.3;

impl Selector<'_> {
    /// Adds what the windows call for, until nothing gains enough.
    pub fn select(&self, mut current: Selection) -> Result<Selection, Failure> {
        let declared = self.workshop.learner.declared_mechanism();
        let friction_declared = declared.joints.iter().all(|joint| joint.friction);
        let mut budget = current.steps + self.budget();
        let mut held_out = HeldOut::of(self.workshop, self.batch, &current).unwrap_or_default();
        let mut richer: Option<(f64, Trial)> = None;
        while current.rivals.len() < MOST * declared.joints.len().max(1) {
            let (ranked, leftover) = self.ranked(&current, friction_declared)?;
            current.leftover = leftover;
            let candidates = ranked.len().max(1) as f64;
            let mut trials: Vec<Trial> = Vec::new();
            for candidate in self.shortlist(&ranked) {
                if current.steps > budget {
                    break;
                }
                let same = |trial: &Trial| trial.addition == candidate.addition && trial.also.is_empty();
                if candidate.also.is_empty() && trials.iter().any(|trial| same(trial) && trial.gain > CLEAR_GAIN) {
                    continue;
                }
                if let Ok(trial) = self.best_trial(&current, &candidate) {
                    current.steps += trial.spent;
                    tracing::debug!(addition = ?trial.addition, first_order = candidate.gain, gain = trial.gain, reduction = trial.reduction(), "trial");
                    trials.push(trial);
                }
            }
            let by_gain = |a: &Trial, b: &Trial| b.gain.total_cmp(&a.gain).then(a.addition.cmp(&b.addition));
            // What had all of the part that was taken, and more, need not be found again.
            if let Some((log_evidence, trial)) = richer.take()
                && trial.additions.is_superset(&current.additions)
                && trial.additions.len() == current.additions.len() + 1
            {
                let gain = log_evidence - current.log_evidence;
                trials.push(Trial { gain, also: Vec::new(), ..trial });
            }
            trials.sort_by(by_gain);
            if self.several() {
                for trial in trials.iter_mut().take(REFITTED_OF_CHAINS) {
                    let spent = self.refine(trial)?;
                    current.steps += spent;
                }
                trials.sort_by(by_gain);
            }
            current.declined = trials.iter().map(|trial| (trial.addition, trial.gain)).collect();
            let least = LEAST_GAIN + candidates.ln();
            let needs_of = |addition: Addition| match addition {
                Addition::Effect(_, EffectKind::Impulse) => least + PLACES.ln(),
                _ => least,
            };
            // Of a chain what is left is seldom white: where innovations are not, fewer of them count.
            let reduction = |trial: &Trial| if self.several() { trial.reduction() } else { 1.0 };
            let needs = |trial: &Trial| match trial.addition {
                // It acts in one window: where others are not explained either, something acts in them all.
                Addition::Effect(_, EffectKind::Impulse) if trial.usual_noise_scale() >= MISFIT => f64::INFINITY,
                addition => needs_of(addition) * reduction(trial),
            };
            let Some(best) = trials.iter().find(|trial| trial.gain > needs(trial)).or(trials.first()) else { break };
            let part_of_it =
                |trial: &&Trial| trial.gain > needs(trial).max(SIMPLER_SHARE * best.gain) && is_part_of(trial, best);
            let simple = trials.iter().find(part_of_it);
            // On a chain what one joint lacks shows in the others: of those that evidence hardly tells apart the one
            // with the fewest numbers.
            let apart = if self.several() { LEAST_GAIN * best.reduction() } else { 0.0 };
            let near = trials.iter().filter(|trial| trial.gain > needs(trial).max(best.gain - apart));
            let best = simple.or_else(|| near.min_by_key(|trial| trial.numbers())).unwrap_or(best);
            if best.gain < needs(best) {
                // A right effect can gain nothing until its partner is in.
                match self.pair(&current, best, friction_declared, least)? {
                    Some(pair) => {
                        let had = (&current.additions, current.log_evidence);
                        let Some(after) = self.holding(&pair, &held_out, had, &mut current.steps) else { break };
                        held_out = after;
                        current = Selection { steps: current.steps, ..pair };
                        self.settle(&mut current)?;
                        budget += self.look_for_stops(&mut current)?;
                        current.note_step();
                    }
                    None => break,
                }
                continue;
            }
            // The next best stands in where an addition does not hold on windows left out.
            let others = trials.iter().filter(|trial| trial.gain > needs(trial) && !std::ptr::eq(*trial, best));
            let mut taken = None;
            for trial in std::iter::once(best).chain(others).take(HELD_OUT_TRIES) {
                let mut next = current.clone();
                self.take(&mut next, trial);
                let had = (&current.additions, current.log_evidence);
                if let Some(after) = self.holding(&next, &held_out, had, &mut current.steps) {
                    taken = Some((trial, next, after));
                    break;
                }
            }
            let Some((best, next, after)) = taken else { break };
            held_out = after;
            let whole = trials.iter().find(|trial| trial.gain > best.gain && is_part_of(best, trial));
            let whole = whole.map(|trial| (current.log_evidence + trial.gain, trial.clone()));
            let mut rivals: Vec<(Option<Addition>, f64)> = trials
                .iter()
                // What has it, too, is none.
                .filter(|t| !t.additions.contains(&best.addition) && same_place(t.addition, best.addition))
                .map(|t| (Some(t.addition), t.gain - best.gain))
                .collect();
            rivals.push((None, -best.gain));
            let addition = best.addition;
            let had = current.clone();
            current =
                Selection { steps: current.steps, declined: current.declined, leftover: current.leftover, ..next };
            current.rivals.extend(best.also.iter().map(|other| (*other, vec![(None, -best.gain)])));
            current.rivals.insert(addition, rivals);
            self.settle(&mut current)?;
            budget += self.look_for_stops(&mut current)?;
            // What gained by leading to a better optimum of the model before it is not needed itself.
            if let Some(without) = self.as_good_without(&current, &had, needs_of(addition))? {
                tracing::debug!(?addition, evidence = without.log_evidence, "a better optimum without");
                held_out = HeldOut::of(self.workshop, self.batch, &without).unwrap_or_default();
                current = Selection { rivals: had.rivals, stages: had.stages, ..without };
                continue;
            }
            self.drop_what_is_not_needed(&mut current, addition)?;
            current.note_step();
            richer = whole;
        }
        Ok(current)
    }

    /// What windows left out lack by a model; none where it does not hold there against the one before it, with
    /// the additions `had` and its evidence, as far as the joints go that move with those in which the two differ.
    pub(super) fn holding(
        &self,
        next: &Selection,
        before: &HeldOut,
        (had, log_evidence): (&BTreeSet<Addition>, f64),
        steps: &mut usize,
    ) -> Option<HeldOut> {
        let after = HeldOut::of(self.workshop, self.batch, next).ok()?;
        *steps += after.steps;
        let joints = self.concerned(had.symmetric_difference(&next.additions));
        let ratios = after.ratios_to(before, &joints);
        tracing::debug!(additions = ?next.additions, ?ratios, kappa = ?next.noise_scales_of(None), "left out");
        after.holds_against(before, &joints, next.log_evidence - log_evidence).then_some(after)
    }

    /// The joints that move in the windows that additions concern.
    fn concerned<'b>(&self, additions: impl Iterator<Item = &'b Addition>) -> Vec<usize> {
        let mut parts = components(self.batch, false);
        let joints: Vec<Option<usize>> = additions.map(|addition| addition.joint()).collect();
        parts.retain(|part| joints.iter().any(|joint| joint.is_none_or(|joint| part.joints.contains(&joint))));
        parts.into_iter().flat_map(|part| part.joints).collect()
    }

    /// The model with the best candidate and the best partner of it, if the two gain enough.
    fn pair(
        &self,
        current: &Selection,
        first: &Trial,
        friction_declared: bool,
        least: f64,
    ) -> Result<Option<Selection>, Failure> {
        if first.gain < 0.0 {
            return Ok(None);
        }
        let mut with_first = current.clone();
        self.take(&mut with_first, first);
        let (ranked, _) = self.ranked(&with_first, friction_declared)?;
        let candidates = ranked.len().max(1) as f64;
        for candidate in self.shortlist(&ranked).into_iter().take(2) {
            let Ok(second) = self.best_trial(&with_first, &candidate) else { continue };
            if first.gain + second.gain > least + candidates.ln() {
                self.take(&mut with_first, &second);
                with_first.rivals.insert(first.addition, vec![(None, -first.gain - second.gain)]);
                with_first.rivals.insert(second.addition, vec![(None, -second.gain)]);
                return Ok(Some(with_first));
            }
        }
        Ok(None)
    }

    /// The model `had` before the newest addition, fitted anew from where that led, if it does as well but for
    /// this much evidence.
    fn as_good_without(&self, current: &Selection, had: &Selection, least: f64) -> Result<Option<Selection>, Failure> {
        let stops = current.additions.iter().filter(|a| a.is_stop());
        let additions: BTreeSet<Addition> = had.additions.iter().chain(stops).copied().collect();
        let mut numbers = current.numbers.clone();
        // What the newest took the place of is as it was.
        numbers.added.extend(
            had.numbers.added.iter().filter(|(a, _)| !current.additions.contains(a)).map(|(a, own)| (*a, own.clone())),
        );
        let mut without = self.fitted(&additions, &numbers, REFIT)?;
        without.steps += current.steps;
        let same = (without.log_evidence > current.log_evidence - least).then_some(without);
        Ok(same.map(|without| Selection {
            declined: current.declined.clone(),
            leftover: current.leftover.clone(),
            ..without
        }))
    }

    /// After a right effect is in, one that stood in for it may go.
    pub(super) fn drop_what_is_not_needed(&self, current: &mut Selection, newest: Addition) -> Result<(), Failure> {
        let others: Vec<Addition> =
            current.additions.iter().copied().filter(|a| *a != newest && !a.is_stop()).collect();
        for addition in others
            .into_iter()
            .filter(|a| a.joint().is_none() || newest.joint().is_none() || a.joint() == newest.joint())
        {
            let mut fewer = current.additions.clone();
            fewer.remove(&addition);
            let without = self.fitted(&fewer, &current.numbers, (6, 1))?;
            current.steps += without.steps;
            tracing::debug!(?addition, loss = current.log_evidence - without.log_evidence, "without");
            // A name that a table made nearly needless was a wrong one.
            let of_newest = current.rivals.get(&newest).and_then(|r| r.iter().find(|(rival, _)| rival.is_none()));
            let least = match (newest, of_newest) {
                (Addition::Table(..), Some((_, loss))) => LEAST_GAIN.max(-0.5 * loss),
                _ => LEAST_GAIN,
            };
            if without.log_evidence > current.log_evidence - least {
                current.rivals.remove(&addition);
                current.go_on_as(without);
            }
        }
        Ok(())
    }
}

/// Whether a trial is the simpler one of two of which the other has all that it has: friction in all that
/// resists motion, an offset in friction by direction.
fn is_part_of(simple: &Trial, rich: &Trial) -> bool {
    match (simple.addition, rich.addition) {
        (Addition::Friction(_), Addition::Friction(_)) => false,
        (Addition::Friction(joint), other) => other.joint() == Some(joint) || !simple.also.is_empty(),
        (Addition::Effect(joint, EffectKind::GravityOffset), Addition::Effect(other, kind)) => {
            joint == other && kind == EffectKind::AsymmetricFriction
        }
        _ => false,
    }
}

/// Whether two additions compete to explain the same.
fn same_place(a: Addition, b: Addition) -> bool {
    a.joint() == b.joint() || a.joint().is_none() || b.joint().is_none()
}
