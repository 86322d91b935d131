//! Which additions the windows call for: forward selection by evidence, each refitted.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::held_out::HeldOut;
use super::numbers::{Addition, Numbers, Workshop};
use super::rest::RestReadings;
use super::signature::{Probes, Ranked, probes, start_by_direction};
use crate::inference::Failure;
use crate::math::median;
use crate::mechanism::effects::{EffectKind, TableKind};
use crate::model::{BatchFit, BatchWindow, Hypothesis};

/// An addition is accepted if it raises the log evidence by this, and by the logarithm of how many
/// were tried: see docs/criticism.md for the false alarms that it leaves.
const LEAST_GAIN: f64 = 6.0;
/// The same for a table, which fits much.
const LEAST_TABLE_GAIN: f64 = 10.0;
/// What gains this from where it was found before is not tried anew as well.
const CLEAR_GAIN: f64 = 50.0;
/// How many of the ranked are refitted, and from how much first-order gain on \[nats\].
const REFITTED: usize = 5;
const WORTH_A_REFIT: f64 = 3.0;
/// Additions at most.
const MOST: usize = 4;
/// Candidates that gain enough are tried on windows left out until one holds, at most so many.
const HELD_OUT_TRIES: usize = 3;
/// A stop is believed from this gain on.
const STOP_GAIN: f64 = 4.0;
/// A pulse may be anywhere: it counts as this many candidates.
const PLACES: f64 = 150.0;
/// κ from which on a model is far off.
const FAR_OFF: f64 = 1e3;
/// κ from which on a window is not explained, and how many tables are then tried in any case.
const MISFIT: f64 = 10.0;
const TABLES_TRIED: usize = 4;
/// A joint that goes less than a fifth of its usual way in this span has halted \[s\].
const HALT_S: f64 = 0.2;
/// Rank of what was found before.
const KNOWN: f64 = 1e9;
/// κ that fits start from; the base model's from both, as a wrong model has more than one optimum.
const FIRST_SCALES: [f64; 2] = [10.0, 1e3];
/// Some candidates start with κ larger by this, too.
const WIDENED: f64 = 30.0;
/// A delay is tried from these \[scales\] and from what its signature says: the motion's dependence on it is far
/// from linear.
const DELAYS: [f64; 4] = [-0.8, 0.3, 1.0, 2.0];
/// Beside friction that is not known yet a signature says little of it: it is tried from either side of none.
const NEAR_DELAYS: [f64; 2] = [-0.1, 0.1];
/// A review ends at this many linearizations of all windows beyond the base model's: more windows take longer,
/// and do not leave less time for each candidate.
const BUDGET: usize = 350;
/// A model that was taken is fitted on at most so often, while that gains as much \[nats\].
const SETTLING: (usize, f64) = (3, 1.0);
/// Linearizations of a refit, and how often κ is chosen anew.
const REFIT: (usize, usize) = (8, 2);
/// Where several joints move, candidates are first fitted as little as this, and the best few refitted.
const GLANCE: (usize, usize) = (4, 1);
const REFITTED_OF_CHAINS: usize = 3;
/// Friction that was not declared starts from these shares of a joint's usual force, near what is known and far
/// from it.
const FRICTION_STARTS: [f64; 2] = [0.3, 0.1];
/// The same of starts far from it with much process noise, and their κ.
const WIDE_FRICTION: f64 = 0.03;
const WIDE_SCALES: [f64; 2] = [1e3, 1e5];
/// What is part of something richer is added first if it explains this share of what that does.
const SIMPLER_SHARE: f64 = 0.3;

/// The model selected, with all that was compared on the way.
#[derive(Clone, Debug)]
pub struct Selection {
    /// What it has beyond the declared physics.
    pub additions: BTreeSet<Addition>,
    /// Its numbers.
    pub numbers: Numbers,
    /// By component of joints that move together: its joints, its windows, and the fit.
    pub components: Vec<Component>,
    /// Log evidence \[nats\].
    pub log_evidence: f64,
    /// For every addition accepted: the log evidence of the model without it, and of those with
    /// another in its place.
    pub rivals: BTreeMap<Addition, Vec<(Option<Addition>, f64)>>,
    /// The models on the way.
    pub stages: Vec<Step>,
    /// What was refitted last and gained too little, with its gain \[nats\].
    pub declined: Vec<(Addition, f64)>,
    /// What tables would gain over the model at first order \[nats\], most first.
    pub leftover: Vec<(Addition, f64)>,
    /// Linearizations of all windows spent.
    pub steps: usize,
}

/// A model on the way to the one selected.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Step {
    /// What it has beyond the declared physics.
    pub additions: BTreeSet<Addition>,
    /// Its numbers.
    pub numbers: Numbers,
}

/// Joints whose windows hang together.
#[derive(Clone, Debug)]
pub struct Component {
    /// Joints by index.
    pub joints: Vec<usize>,
    /// Places of its windows in the batch.
    pub windows: Vec<usize>,
    /// The fit of those.
    pub fitted: Option<BatchFit>,
}

impl Selection {
    /// κ of the windows that move a joint, or of all.
    pub fn noise_scales_of(&self, joint: Option<usize>) -> Vec<f64> {
        let concerned = self.components.iter().filter(|c| joint.is_none_or(|joint| c.joints.contains(&joint)));
        let fits = concerned.filter_map(|component| component.fitted.as_ref());
        fits.flat_map(|fitted| &fitted.windows).map(|window| window.noise_scale).collect()
    }

    /// The same with κ changed.
    fn with_noise_scales(&self, change: impl Fn(f64) -> f64) -> Self {
        let mut other = self.clone();
        let fits = other.components.iter_mut().filter_map(|component| component.fitted.as_mut());
        fits.flat_map(|fitted| &mut fitted.windows).for_each(|window| window.noise_scale = change(window.noise_scale));
        other
    }

    fn note_step(&mut self) {
        self.stages.push(Step { additions: self.additions.clone(), numbers: self.numbers.clone() });
    }
}

/// Joints that move in the same windows, or all that move if `together`.
pub fn components(batch: &[BatchWindow], together: bool) -> Vec<Component> {
    let mut components: Vec<Component> = Vec::new();
    for (w, window) in batch.iter().enumerate() {
        let joints: Vec<usize> = window.involved.iter().map(|(joint, _)| *joint).collect();
        let mut merged = Component { joints, windows: vec![w], fitted: None };
        components.retain(|component| {
            let shares = together || component.joints.iter().any(|joint| merged.joints.contains(joint));
            if shares {
                merged.joints.extend(&component.joints);
                merged.windows.extend(&component.windows);
            }
            !shares
        });
        merged.joints.sort_unstable();
        merged.joints.dedup();
        merged.windows.sort_unstable();
        components.push(merged);
    }
    components.sort_by_key(|component| component.joints.clone());
    components
}

/// What candidates are tried on.
pub struct Selector<'a> {
    /// What models are made from.
    pub workshop: &'a Workshop<'a>,
    /// The windows.
    pub batch: &'a [BatchWindow],
    /// What the sensor read at rest.
    pub rest: Option<&'a RestReadings>,
    /// What the last review found: joints that the newest window does not concern are only asked for it. None
    /// where there was no review of these joints: all are asked.
    pub found: Option<&'a BTreeSet<Addition>>,
}

/// A refitted candidate.
#[derive(Clone)]
struct Trial {
    addition: Addition,
    also: Vec<Addition>,
    /// All of its model.
    additions: BTreeSet<Addition>,
    gain: f64,
    /// Linearizations spent, those from other starts too.
    spent: usize,
    hypothesis: Hypothesis,
    fits: Vec<(Vec<usize>, BatchFit)>,
}

impl Trial {
    /// Variance and correlation of its innovations beyond what they should be, of the usual window.
    fn reduction(&self) -> f64 {
        let windows = self.fits.iter().flat_map(|(_, fitted)| &fitted.windows);
        median(windows.map(|window| window.reduction).collect()).unwrap_or(1.0)
    }

    /// κ of the usual window.
    fn usual_noise_scale(&self) -> f64 {
        let windows = self.fits.iter().flat_map(|(_, fitted)| &fitted.windows);
        median(windows.map(|window| window.noise_scale).collect()).unwrap_or(1.0)
    }

    /// How many numbers it adds.
    fn numbers(&self) -> usize {
        let of = |addition: &Addition| match *addition {
            Addition::Effect(_, kind) => kind.parameters().len(),
            Addition::Bias => 6,
            Addition::Table(..) => usize::MAX / 2,
            Addition::Stop(..) | Addition::Friction(_) | Addition::Delay => 1,
        };
        of(&self.addition) + self.also.iter().map(of).sum::<usize>()
    }
}

impl Selector<'_> {
    /// What a linearization of these windows costs, in those of windows of one joint; one in which several joints
    /// move counts for the square of their number and as much again.
    fn weight(&self, windows: &[usize]) -> usize {
        let one = |w: &usize| match self.batch[*w].moving.len() {
            1 => 1,
            several => 2 * several * several,
        };
        windows.iter().map(one).sum()
    }

    fn windows(&self, places: &[usize]) -> Vec<&BatchWindow> {
        places.iter().map(|&w| &self.batch[w]).collect()
    }

    /// The model with these additions and no others.
    pub fn fitted(
        &self,
        additions: &BTreeSet<Addition>,
        numbers: &Numbers,
        effort: (usize, usize),
    ) -> Result<Selection, Failure> {
        self.fitted_from(additions, numbers, FIRST_SCALES[0], effort)
    }

    /// The same with κ of all windows to start from.
    fn fitted_from(
        &self,
        additions: &BTreeSet<Addition>,
        numbers: &Numbers,
        scale: f64,
        effort: (usize, usize),
    ) -> Result<Selection, Failure> {
        let together = additions.iter().any(|a| a.joint().is_none());
        let hypothesis = self.workshop.hypothesis(additions)?;
        let mut selection = Selection {
            additions: additions.clone(),
            numbers: numbers.clone(),
            components: components(self.batch, together),
            log_evidence: self.sensor_evidence(additions),
            rivals: BTreeMap::new(),
            stages: Vec::new(),
            declined: Vec::new(),
            leftover: Vec::new(),
            steps: 0,
        };
        for component in &mut selection.components {
            let windows = self.windows(&component.windows);
            let x = selection.numbers.laid_out(&hypothesis, additions);
            let scales = vec![scale; windows.len()];
            let fitted = hypothesis.fit(&windows, &x, &scales, effort)?;
            selection.numbers.take(&hypothesis, additions, &fitted.x, &component.joints);
            selection.log_evidence += fitted.log_evidence;
            selection.steps += fitted.steps * self.weight(&component.windows);
            component.fitted = Some(fitted);
        }
        Ok(selection)
    }

    /// What the readings at rest say of the additions.
    fn sensor_evidence(&self, additions: &BTreeSet<Addition>) -> f64 {
        let biased = additions.contains(&Addition::Bias);
        self.rest.filter(|_| biased).map_or(0.0, RestReadings::evidence_of_bias)
    }

    /// The declared physics with the end stops that the windows show.
    pub fn base(&self, numbers: &Numbers) -> Result<Selection, Failure> {
        let mut best: Option<Selection> = None;
        let mut bland = numbers.clone();
        bland.joints.clear();
        // The learner's numbers may be what a wrong model made of the windows.
        for (start, scale) in FIRST_SCALES.into_iter().flat_map(|scale| [(numbers, scale), (&bland, scale)]) {
            let misfit = best.as_ref().is_none_or(|b| {
                let fits = b.components.iter().filter_map(|c| c.fitted.as_ref());
                fits.flat_map(|f| &f.windows).any(|w| w.reduction > 3.0 || w.noise_scale > 50.0)
            });
            if !misfit {
                continue;
            }
            if let Ok(fitted) = self.fitted_from(&BTreeSet::new(), start, scale, (10, 2))
                && best.as_ref().is_none_or(|b| fitted.log_evidence > b.log_evidence)
            {
                best = Some(fitted);
            }
        }
        let mut current = best.ok_or(Failure::Diverged)?;
        self.settle(&mut current)?;
        self.add_stops(&mut current);
        Ok(current)
    }

    /// Adds the end stops that the windows show by a model: what it lacks may hide them.
    fn add_stops(&self, current: &mut Selection) {
        let declared = self.workshop.learner.declared_mechanism();
        for component in current.components.clone() {
            for &joint in &component.joints {
                let moved = component.windows.iter().any(|&w| self.batch[w].moving.contains(&joint));
                for upper in [false, true].into_iter().filter(|_| moved) {
                    let stop = Addition::Stop(joint, upper);
                    let known = declared.joints[joint].stops[usize::from(upper)] || current.additions.contains(&stop);
                    if known || !self.may_halt(joint, upper) {
                        continue;
                    }
                    let (low, high) = self.workshop.range(joint);
                    let start = vec![if upper { high } else { low }];
                    if let Ok(trial) =
                        self.trial(current, &Ranked { addition: stop, gain: 0.0, start, also: Vec::new() }, (5, 1))
                    {
                        current.steps += trial.spent;
                        if trial.gain > STOP_GAIN {
                            self.take(current, &trial);
                        }
                    }
                }
            }
        }
    }

    /// Adds what the windows call for, until nothing gains enough.
    pub fn select(&self, mut current: Selection) -> Result<Selection, Failure> {
        let declared = self.workshop.learner.declared_mechanism();
        let friction_declared = declared.joints.iter().all(|joint| joint.friction);
        let budget = current.steps + self.budget();
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
                    tracing::debug!(addition = ?trial.addition, first_order = candidate.gain, gain = trial.gain, "trial");
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
            let needs = |trial: &Trial| match trial.addition {
                // It acts in one window: where others are not explained either, something acts in them all.
                Addition::Effect(_, EffectKind::Impulse) if trial.usual_noise_scale() >= MISFIT => f64::INFINITY,
                addition => needs_of(addition),
            };
            let Some(best) = trials.iter().find(|trial| trial.gain > needs(trial)).or(trials.first()) else { break };
            let part_of_it =
                |trial: &&Trial| trial.gain > needs(trial).max(SIMPLER_SHARE * best.gain) && is_part_of(trial, best);
            let simple = trials.iter().find(part_of_it);
            // On a chain what one joint lacks shows in the others: of those that evidence hardly tells apart the one
            // with the fewest numbers; where innovations are not white, fewer of them count.
            let apart = if self.several() { LEAST_GAIN * best.reduction() } else { 0.0 };
            let near = trials.iter().filter(|trial| trial.gain > needs(trial).max(best.gain - apart));
            let best = simple.or_else(|| near.min_by_key(|trial| trial.numbers())).unwrap_or(best);
            if best.gain < needs(best) {
                // A right effect can gain nothing until its partner is in.
                match self.pair(&current, best, friction_declared, least)? {
                    Some(pair) => {
                        let Some(after) = self.holding(&pair, &held_out, &current.additions, &mut current.steps) else {
                            break;
                        };
                        held_out = after;
                        current = Selection { steps: current.steps, ..pair };
                        self.settle(&mut current)?;
                        self.add_stops(&mut current);
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
                if let Some(after) = self.holding(&next, &held_out, &current.additions, &mut current.steps) {
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
                .filter(|t| t.addition != best.addition && same_place(t.addition, best.addition))
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
            self.add_stops(&mut current);
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
    /// the additions `had`, as far as the joints go that move with those in which the two differ.
    fn holding(
        &self,
        next: &Selection,
        before: &HeldOut,
        had: &BTreeSet<Addition>,
        steps: &mut usize,
    ) -> Option<HeldOut> {
        let after = HeldOut::of(self.workshop, self.batch, next).ok()?;
        *steps += after.steps;
        let joints = self.concerned(had.symmetric_difference(&next.additions));
        let ratios = after.ratios_to(before, &joints);
        tracing::debug!(additions = ?next.additions, ?ratios, kappa = ?next.noise_scales_of(None), "left out");
        after.holds_against(before, &joints).then_some(after)
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

    /// The best of a candidate's starts, refitted.
    fn best_trial(&self, current: &Selection, candidate: &Ranked) -> Result<Trial, Failure> {
        // The numbers of a model without it stand in for it, and hold it down: it starts from the prior's, too.
        let mut bland = current.clone();
        bland.numbers.joints.clear();
        let alone = |starts: Vec<(&'_ Selection, f64)>| -> Vec<_> {
            starts
                .into_iter()
                .map(|(from, start)| (from.clone(), Ranked { start: vec![start], ..candidate.clone() }))
                .collect()
        };
        // Friction on several joints, each by its own force, and a delay with it or none.
        let friction = |joint: usize, share: f64| {
            let force = self.workshop.learner.joint_scales(joint, self.workshop.fit).map_or(1.0, |s| s.force);
            vec![(share * force).ln()]
        };
        let together = |from: Selection, share: f64, start: Vec<f64>| {
            let also = candidate.also.iter().map(|(other, _)| match other {
                Addition::Friction(joint) => (*other, friction(*joint, share)),
                _ => (*other, Vec::new()),
            });
            (from, Ranked { start, also: also.collect(), ..candidate.clone() })
        };
        let from_both = || [current, &bland].into_iter().cloned().zip(FRICTION_STARTS);
        // On several joints far from what is known the way is rough; with wide process noise it is smoother.
        let from_all = || {
            let wide = WIDE_SCALES.into_iter().map(|scale| (bland.with_noise_scales(|_| scale), WIDE_FRICTION));
            from_both().chain(wide)
        };
        let starts: Vec<(Selection, Ranked)> = match candidate.addition {
            Addition::Delay if candidate.also.is_empty() => {
                let delays = || DELAYS.into_iter().chain(candidate.start.first().copied());
                alone([current, &bland].into_iter().flat_map(|from| delays().map(move |d| (from, d))).collect())
            }
            Addition::Delay => from_all()
                .flat_map(|(from, share)| NEAR_DELAYS.map(|delay| together(from.clone(), share, vec![delay])))
                .collect(),
            Addition::Friction(joint) if !candidate.also.is_empty() => {
                from_all().map(|(from, share)| together(from, share, friction(joint, share))).collect()
            }
            Addition::Friction(joint) => {
                from_both().map(|(from, share)| together(from, share, friction(joint, share))).collect()
            }
            // Far from where friction and an offset are: with wide process noise the way there is smoother.
            Addition::Effect(_, EffectKind::AsymmetricFriction) if !self.several() => {
                [current.clone(), current.with_noise_scales(|scale| scale * WIDENED)]
                    .into_iter()
                    .map(|from| (from, candidate.clone()))
                    .collect()
            }
            // The numbers of a model that is far off mislead.
            addition if !self.several() && far_off(current, addition) => {
                let anew = bland.with_noise_scales(|_| FIRST_SCALES[0]);
                [current.clone(), anew].map(|from| (from, candidate.clone())).into()
            }
            _ => return self.trial(current, candidate, if self.several() { GLANCE } else { REFIT }),
        };
        let mut best: Option<Trial> = None;
        let mut spent = 0;
        for (from, start) in &starts {
            let Ok(trial) = self.trial(from, start, GLANCE) else { continue };
            spent += trial.spent;
            if best.as_ref().is_none_or(|other| trial.gain > other.gain) {
                best = Some(trial);
            }
        }
        let mut best = best.ok_or(Failure::Diverged)?;
        if !self.several() {
            spent += self.refine(&mut best)?;
        }
        Ok(Trial { spent, ..best })
    }

    /// Whether several joints move in a window.
    fn several(&self) -> bool {
        self.batch.iter().any(|window| window.moving.len() > 1)
    }

    fn budget(&self) -> usize {
        BUDGET * self.weight(&(0..self.batch.len()).collect::<Vec<usize>>())
    }

    /// Fits a trial on from where it is; returns what that cost.
    fn refine(&self, trial: &mut Trial) -> Result<usize, Failure> {
        let mut spent = 0;
        for (places, fitted) in &mut trial.fits {
            let scales: Vec<f64> = fitted.windows.iter().map(|window| window.noise_scale).collect();
            let refined = trial.hypothesis.fit(&self.windows(places), &fitted.x, &scales, REFIT)?;
            spent += refined.steps * self.weight(places);
            if refined.log_evidence > fitted.log_evidence {
                trial.gain += refined.log_evidence - fitted.log_evidence;
                *fitted = refined;
            }
        }
        Ok(spent)
    }

    /// Whether a joint was seen to stay at an end of its range: not if a record begins or ends there while
    /// it moves.
    fn may_halt(&self, joint: usize, upper: bool) -> bool {
        let sign = if upper { 1.0 } else { -1.0 };
        let fit = self.workshop.fit;
        let near = 0.2 * self.workshop.learner.joint_scales(joint, fit).map_or(0.1, |scales| scales.rate) * HALT_S;
        let mut farthest: Option<(f64, bool)> = None;
        for (positions, window) in fit.positions.iter().zip(self.workshop.input.windows) {
            let Some(path) = positions.get(joint) else { continue };
            for (k, q) in path.iter().enumerate() {
                if farthest.is_none_or(|(other, _)| sign * q > other) {
                    let time_s = window.times_s[k];
                    let near_to = |other: f64| (other - time_s).abs() <= HALT_S;
                    let about = |i: &usize| near_to(window.times_s[*i]);
                    // Noise makes any of the last samples the farthest.
                    let ends = near_to(window.times_s[0]) || near_to(window.times_s[path.len() - 1]);
                    let moves = (0..path.len()).filter(about).any(|i| (path[i] - q).abs() > near);
                    farthest = Some((sign * q, !(ends && moves)));
                }
            }
        }
        farthest.is_none_or(|(_, halts)| halts)
    }

    /// Everything that might be added, by joint, and what tables would gain.
    fn ranked(
        &self,
        current: &Selection,
        friction_declared: bool,
    ) -> Result<(Vec<Ranked>, Vec<(Addition, f64)>), Failure> {
        let hypothesis = self.workshop.hypothesis(&current.additions)?;
        let mut ranked: Vec<Ranked> = Vec::new();
        let mut leftover: Vec<(Addition, f64)> = Vec::new();
        let newest = self.batch.iter().map(|w| w.index).max();
        let mut of_sensor: BTreeMap<Addition, Ranked> = BTreeMap::new();
        for component in &current.components {
            let Some(fitted) = &component.fitted else { continue };
            let windows = self.windows(&component.windows);
            let moved: Vec<usize> = component
                .joints
                .iter()
                .copied()
                .filter(|joint| windows.iter().any(|w| w.moving.contains(joint)))
                .collect();
            let concerned = self.found.is_none() || windows.iter().any(|w| Some(w.index) == newest);
            let known =
                self.found.into_iter().flatten().filter(|a| a.joint().is_none_or(|joint| moved.contains(&joint)));
            // A table may stand for anything: it describes what is left where nothing with a name does.
            let named = |a: &&Addition| !matches!(a, Addition::Stop(..) | Addition::Table(..));
            let known = known.filter(|a| !current.additions.contains(a)).filter(named);
            for addition in known.copied() {
                let start = current.numbers.added.get(&addition).cloned().unwrap_or_default();
                ranked.push(Ranked { addition, gain: KNOWN, start, also: Vec::new() });
            }
            for (k, &joint) in moved.iter().filter(|_| concerned).enumerate() {
                let [own, sensor] = probes(self.workshop, &hypothesis, fitted, &windows, joint)?;
                leftover.extend(self.leftover(&own, joint));
                ranked.extend(own.rank(&current.additions, friction_declared));
                if k > 0 {
                    continue;
                }
                for candidate in sensor.rank(&current.additions, friction_declared) {
                    let entry = of_sensor
                        .entry(candidate.addition)
                        .or_insert_with(|| Ranked { gain: 0.0, ..candidate.clone() });
                    entry.gain += candidate.gain;
                }
            }
        }
        ranked.extend(of_sensor.into_values());
        let joint_of = |candidate: &&Ranked| matches!(candidate.addition, Addition::Friction(_));
        let mut frictions: Vec<Addition> = ranked.iter().filter(joint_of).map(|c| c.addition).collect();
        frictions.sort_unstable();
        frictions.dedup();
        if let Some((addition, others)) = frictions.split_first().filter(|(_, others)| !others.is_empty()) {
            let with = |others: &[Addition]| others.iter().map(|other| (*other, Vec::new())).collect::<Vec<_>>();
            ranked.push(Ranked { addition: *addition, gain: KNOWN, start: Vec::new(), also: with(others) });
            // Motors' torques that act late hide the friction of a chain.
            if self.several() && !current.additions.contains(&Addition::Delay) {
                let also = with(&frictions);
                ranked.push(Ranked { addition: Addition::Delay, gain: KNOWN, start: Vec::new(), also });
            }
        }
        // What was found before is tried from where it was, and anew.
        leftover.sort_by(|a, b| b.1.total_cmp(&a.1).then(a.0.cmp(&b.0)));
        Ok((ranked, leftover))
    }

    /// The best few of every joint, and the sensor's.
    fn shortlist(&self, ranked: &[Ranked]) -> Vec<Ranked> {
        let mut by_place: BTreeMap<(bool, Option<usize>), Vec<&Ranked>> = BTreeMap::new();
        for candidate in ranked {
            // The sensor's last: they cost most.
            let joint = candidate.addition.joint();
            by_place.entry((joint.is_none(), joint)).or_default().push(candidate);
        }
        let mut shortlist: Vec<Ranked> = Vec::new();
        for mut candidates in by_place.into_values() {
            candidates.sort_by(|a, b| b.gain.total_cmp(&a.gain).then(a.addition.cmp(&b.addition)));
            let rest = |c: &Ranked| {
                c.addition == Addition::Bias && self.sensor_evidence(&BTreeSet::from([Addition::Bias])) > 0.0
            };
            let worth = candidates.iter().filter(|c| c.gain > WORTH_A_REFIT || rest(c)).take(REFITTED);
            let mut worth: Vec<Ranked> = worth.map(|c| (*c).clone()).collect();
            // What has more numbers ranks higher, but friction or an offset may be all that it finds.
            let friction = |c: &Ranked| matches!(c.addition, Addition::Friction(_));
            let by_direction = |c: &Ranked| matches!(c.addition, Addition::Effect(_, EffectKind::AsymmetricFriction));
            let offset = |c: &Ranked| matches!(c.addition, Addition::Effect(_, EffectKind::GravityOffset));
            if !worth.iter().any(|c| friction(c) && c.also.is_empty()) {
                worth.extend(candidates.iter().find(|c| friction(c) && c.also.is_empty()).map(|c| (*c).clone()));
            }
            if worth.iter().any(by_direction) && !worth.iter().any(offset) {
                worth.extend(candidates.iter().find(|c| offset(c)).map(|c| (*c).clone()));
            }
            shortlist.append(&mut worth);
        }
        shortlist
    }

    /// The model with one addition more, refitted where it matters.
    fn trial(&self, current: &Selection, candidate: &Ranked, effort: (usize, usize)) -> Result<Trial, Failure> {
        let addition = candidate.addition;
        let mut additions = current.additions.clone();
        additions.insert(addition);
        additions.extend(candidate.also.iter().map(|(other, _)| *other));
        // What differs by direction has friction and an offset in it, and stands in their place.
        let mut replaced_offset = None;
        if let Addition::Effect(joint, EffectKind::AsymmetricFriction) = addition {
            additions.remove(&Addition::Friction(joint));
            let offset = Addition::Effect(joint, EffectKind::GravityOffset);
            if additions.remove(&offset) {
                replaced_offset = current.numbers.added.get(&offset).and_then(|theta| theta.first().copied());
            }
        }
        // What pulls towards the closed position leans on its stop, which shows only now.
        let stop = self.closed_stop(addition).filter(|stop| additions.insert(*stop));
        let hypothesis = self.workshop.hypothesis(&additions)?;
        let mut numbers = current.numbers.clone();
        let mut start = candidate.start.clone();
        if let Addition::Effect(joint, kind @ EffectKind::AsymmetricFriction) = addition
            && let Some(effect) = hypothesis.mechanism.joints[joint].effects.last()
            && !numbers.joints.is_empty()
            && !start.is_empty()
            && candidate.gain < KNOWN
        {
            let offset = replaced_offset.map(|theta| {
                let law = &EffectKind::GravityOffset.parameters()[0];
                law.physical(theta, &effect.scales)
            });
            start = start_by_direction(&numbers.joints[joint], &start, offset, kind, &effect.scales);
        }
        numbers.added.extend(candidate.also.iter().cloned());
        numbers.added.insert(addition, start);
        if let Some(Addition::Stop(joint, upper)) = stop {
            let (low, high) = self.workshop.range(joint);
            numbers.added.insert(Addition::Stop(joint, upper), vec![if upper { high } else { low }]);
        }
        let x = numbers.laid_out(&hypothesis, &additions);
        let of_also = candidate.also.iter().filter_map(|(other, _)| other.joint());
        let touched: Vec<usize> = addition.joint().into_iter().chain(of_also).collect();
        let concerned: Vec<&Component> = match addition.joint() {
            Some(_) => {
                let touches = |c: &&Component| c.joints.iter().any(|joint| touched.contains(joint));
                current.components.iter().filter(touches).collect()
            }
            None => current.components.iter().collect(),
        };
        let mut places: Vec<usize> = concerned.iter().flat_map(|c| c.windows.iter().copied()).collect();
        places.sort_unstable();
        let before: f64 = concerned.iter().filter_map(|c| c.fitted.as_ref()).map(|f| f.log_evidence).sum();
        let scale = |w: &usize| {
            concerned.iter().find_map(|c| {
                let at = c.windows.iter().position(|own| own == w)?;
                c.fitted.as_ref().map(|f| f.windows[at].noise_scale)
            })
        };
        let scales: Vec<f64> = places.iter().map(|w| scale(w).unwrap_or(10.0)).collect();
        let fitted = hypothesis.fit(&self.windows(&places), &x, &scales, effort)?;
        let rest = self.sensor_evidence(&additions) - self.sensor_evidence(&current.additions);
        let gain = fitted.log_evidence - before + rest;
        let also = candidate.also.iter().map(|(other, _)| *other).collect();
        let spent = fitted.steps * self.weight(&places);
        Ok(Trial { addition, also, additions, gain, spent, hypothesis, fits: vec![(places, fitted)] })
    }

    /// The stop at the closed end, if the effect pulls there or holds, and the joint was there.
    fn closed_stop(&self, addition: Addition) -> Option<Addition> {
        let joint = match addition {
            // Else what differs by direction would have the stop as an argument for it.
            Addition::Friction(joint) => joint,
            Addition::Effect(
                joint,
                EffectKind::Catch
                | EffectKind::SoftClose
                | EffectKind::Spring
                | EffectKind::SelfClosing
                | EffectKind::GravityOffset
                | EffectKind::AsymmetricFriction,
            ) => joint,
            _ => return None,
        };
        let scales = self.workshop.learner.joint_scales(joint, self.workshop.fit)?;
        let (low, high) = self.workshop.range(joint);
        let upper = scales.travel < 0.0;
        let end = if upper { high } else { low };
        let declared = self.workshop.learner.declared_mechanism();
        let new = !declared.joints[joint].stops[usize::from(upper)] && end.abs() < 0.05 * scales.travel.abs();
        new.then_some(Addition::Stop(joint, upper))
    }

    /// Fits a model on until that gains nothing more: else whatever is added next gains what was left to find
    /// without it.
    fn settle(&self, current: &mut Selection) -> Result<(), Failure> {
        let hypothesis = self.workshop.hypothesis(&current.additions)?;
        for component in &mut current.components {
            let windows: Vec<&BatchWindow> = component.windows.iter().map(|&w| &self.batch[w]).collect();
            for _ in 0..SETTLING.0 {
                let Some(fitted) = &component.fitted else { break };
                let scales: Vec<f64> = fitted.windows.iter().map(|window| window.noise_scale).collect();
                let refitted = hypothesis.fit(&windows, &fitted.x, &scales, REFIT)?;
                current.steps += refitted.steps * self.weight(&component.windows);
                let gain = refitted.log_evidence - fitted.log_evidence;
                if gain > 0.0 {
                    current.numbers.take(&hypothesis, &current.additions, &refitted.x, &component.joints);
                    current.log_evidence += gain;
                    component.fitted = Some(refitted);
                }
                if gain < SETTLING.1 {
                    break;
                }
            }
        }
        Ok(())
    }

    fn take(&self, current: &mut Selection, trial: &Trial) {
        current.additions.clone_from(&trial.additions);
        current.rivals.retain(|addition, _| trial.additions.contains(addition));
        for (places, fitted) in &trial.fits {
            let together = current.additions.iter().any(|a| a.joint().is_none());
            if together {
                current.components = components(self.batch, true);
            }
            for component in &mut current.components {
                if component.windows == *places {
                    current.numbers.take(&trial.hypothesis, &current.additions, &fitted.x, &component.joints);
                    component.fitted = Some(fitted.clone());
                }
            }
        }
        current.log_evidence += trial.gain;
        self.lay_out(current);
    }

    /// Layouts have changed: fits are carried over by name.
    fn lay_out(&self, current: &mut Selection) {
        if let Ok(hypothesis) = self.workshop.hypothesis(&current.additions) {
            let x = current.numbers.laid_out(&hypothesis, &current.additions);
            for component in &mut current.components {
                let windows: Vec<&BatchWindow> = component.windows.iter().map(|&w| &self.batch[w]).collect();
                let Some(fitted) = &mut component.fitted else { continue };
                fitted.x.clone_from(&x);
                for (own, window) in fitted.windows.iter_mut().zip(&windows) {
                    own.active = hypothesis.active(window);
                }
                let mut active: Vec<usize> = fitted.windows.iter().flat_map(|w| w.active.iter().copied()).collect();
                active.sort_unstable();
                active.dedup();
                fitted.active = active;
            }
        }
    }

    /// The model `had` before the newest addition, fitted anew from where that led, if it does as well but for
    /// this much evidence.
    fn as_good_without(&self, current: &Selection, had: &Selection, least: f64) -> Result<Option<Selection>, Failure> {
        let stops = current.additions.iter().filter(|a| matches!(a, Addition::Stop(..)));
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
    fn drop_what_is_not_needed(&self, current: &mut Selection, newest: Addition) -> Result<(), Failure> {
        let is_stop = |a: &Addition| matches!(a, Addition::Stop(..));
        let others: Vec<Addition> = current.additions.iter().copied().filter(|a| *a != newest && !is_stop(a)).collect();
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
                let mut rivals = std::mem::take(&mut current.rivals);
                rivals.remove(&addition);
                let (stages, declined) = (std::mem::take(&mut current.stages), std::mem::take(&mut current.declined));
                let leftover = std::mem::take(&mut current.leftover);
                *current = Selection { rivals, stages, declined, leftover, steps: current.steps, ..without };
            }
        }
        Ok(())
    }

    /// What each table would gain over the model on a joint.
    fn leftover(&self, own: &Probes, joint: usize) -> Vec<(Addition, f64)> {
        const KINDS: [(TableKind, f64, f64); 6] = [
            (TableKind::ForceOverPosition, 0.3, 0.3),
            (TableKind::ForceOverRate, 0.3, 1.0),
            (TableKind::FrictionOverPosition, 0.3, 0.3),
            (TableKind::FrictionOverTime, 0.3, 10.0),
            (TableKind::InertiaOverPosition, 0.2, 0.3),
            (TableKind::ForceOverTime, 0.3, 0.5),
        ];
        let Some(scales) = self.workshop.learner.joint_scales(joint, self.workshop.fit) else { return Vec::new() };
        let gains = KINDS.iter().filter_map(|&(kind, deviation, correlation)| {
            let length = match kind {
                TableKind::ForceOverRate => correlation * scales.rate,
                TableKind::FrictionOverTime | TableKind::ForceOverTime => correlation,
                _ => correlation * scales.travel.abs(),
            };
            Some((Addition::Table(joint, kind), own.table_gain(kind, deviation, length)?))
        });
        gains.collect()
    }

    /// A model without its additions to some joints, or to the sensor, which are as in the `base` again.
    pub fn restored(
        &self,
        mut selected: Selection,
        base: &Selection,
        joints: &[usize],
        sensor: bool,
    ) -> Result<Selection, Failure> {
        let goes = |a: &Addition| a.joint().map_or(sensor, |joint| joints.contains(&joint));
        let together = selected.additions.iter().any(|a| a.joint().is_none());
        let without = |additions: &BTreeSet<Addition>| -> BTreeSet<Addition> {
            let kept = additions.iter().filter(|a| !goes(a));
            kept.chain(base.additions.iter().filter(|a| goes(a))).copied().collect()
        };
        selected.additions = without(&selected.additions);
        selected.rivals.retain(|addition, _| !goes(addition));
        selected.declined.retain(|(addition, _)| !goes(addition));
        for step in &mut selected.stages {
            step.additions = without(&step.additions);
        }
        let bare: BTreeSet<Addition> = base.additions.clone();
        selected.stages.dedup_by(|a, b| a.additions == b.additions);
        selected.stages.retain(|step| step.additions != bare);
        for &joint in joints {
            if let (Some(own), Some(other)) = (selected.numbers.joints.get_mut(joint), base.numbers.joints.get(joint)) {
                own.clone_from(other);
            }
        }
        let of_base = base.numbers.added.iter().filter(|(a, _)| base.additions.contains(a) && goes(a));
        selected.numbers.added.extend(of_base.map(|(addition, own)| (*addition, own.clone())));
        if together {
            let fitted = self.fitted(&selected.additions, &selected.numbers, REFIT)?;
            let Selection { rivals, stages, declined, leftover, steps, .. } = selected;
            return Ok(Selection { rivals, stages, declined, leftover, steps: steps + fitted.steps, ..fitted });
        }
        for component in &mut selected.components {
            let other = base.components.iter().find(|other| other.joints == component.joints);
            let Some(other) = other.filter(|_| component.joints.iter().any(|joint| joints.contains(joint))) else {
                continue;
            };
            let evidence = |component: &Component| component.fitted.as_ref().map_or(0.0, |fit| fit.log_evidence);
            selected.log_evidence += evidence(other) - evidence(component);
            component.fitted.clone_from(&other.fitted);
        }
        self.lay_out(&mut selected);
        Ok(selected)
    }

    /// The model before the last addition, fitted anew; none where what was added took the place of something.
    pub fn before_last(&self, selected: &Selection) -> Option<Selection> {
        let [earlier @ .., before, _] = &selected.stages[..] else { return None };
        let known = |a: &Addition| matches!(a, Addition::Stop(..)) || selected.rivals.contains_key(a);
        if !before.additions.iter().all(known) {
            return None;
        }
        let starts = [&before.numbers, &selected.numbers];
        let fits = starts.into_iter().filter_map(|start| self.fitted(&before.additions, start, REFIT).ok());
        let fitted = fits.max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence))?;
        let mut rivals = selected.rivals.clone();
        rivals.retain(|addition, _| before.additions.contains(addition));
        Some(Selection {
            rivals,
            stages: earlier.iter().chain([before]).cloned().collect(),
            declined: selected.declined.clone(),
            leftover: selected.leftover.clone(),
            steps: selected.steps + fitted.steps,
            ..fitted
        })
    }

    /// Adds the tables that what is left calls for; the named ones that then gain nothing go.
    pub fn describe_leftover(&self, mut current: Selection) -> Result<Selection, Failure> {
        let leftover = current.leftover.clone();
        tracing::debug!(?leftover, "leftover");
        let budget = current.steps + self.budget() / 2;
        let mut best: BTreeMap<usize, (f64, Trial)> = BTreeMap::new();
        let mut tried: BTreeMap<usize, usize> = BTreeMap::new();
        for (addition, gain) in leftover {
            let Some(joint) = addition.joint() else { continue };
            // Where κ is large nothing gains much at first order.
            let count = tried.entry(joint).or_default();
            if current.steps > budget
                || *count >= TABLES_TRIED
                || (gain < LEAST_TABLE_GAIN && !misfits(&current, joint))
            {
                continue;
            }
            *count += 1;
            let trial = self.trial(&current, &Ranked { addition, gain, start: Vec::new(), also: Vec::new() }, REFIT);
            let Ok(trial) = trial else { continue };
            current.steps += trial.spent;
            tracing::debug!(?addition, gain, refitted = trial.gain, "table");
            if trial.gain > LEAST_TABLE_GAIN && best.get(&joint).is_none_or(|(other, _)| trial.gain > *other) {
                best.insert(joint, (trial.gain, trial));
            }
        }
        let mut held_out = match best.is_empty() {
            true => HeldOut::default(),
            false => HeldOut::of(self.workshop, self.batch, &current).unwrap_or_default(),
        };
        for (gain, trial) in best.into_values() {
            // The layout may have changed since.
            let addition = trial.addition;
            let trial = self.trial(&current, &Ranked { addition, gain, start: Vec::new(), also: Vec::new() }, REFIT)?;
            let mut next = current.clone();
            self.take(&mut next, &trial);
            let Some(after) = self.holding(&next, &held_out, &current.additions, &mut current.steps) else { continue };
            held_out = after;
            current = Selection { steps: current.steps, ..next };
            current.rivals.insert(addition, vec![(None, -trial.gain)]);
            self.drop_what_is_not_needed(&mut current, addition)?;
            current.note_step();
        }
        Ok(current)
    }
}

/// Whether the windows that an addition concerns are usually explained by noise.
fn far_off(current: &Selection, addition: Addition) -> bool {
    median(current.noise_scales_of(addition.joint())).is_some_and(|scale| scale >= FAR_OFF)
}

/// Whether a window that moves a joint needs far more process noise than the sensor explains.
fn misfits(current: &Selection, joint: usize) -> bool {
    current.noise_scales_of(Some(joint)).into_iter().any(|scale| scale >= MISFIT)
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
