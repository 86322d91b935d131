//! Models with one addition more, refitted from several starts.

use std::collections::BTreeSet;

use super::ranking::KNOWN;
use super::{CALM, Component, FIRST_SCALES, REFIT, Selection, Selector};
use crate::criticism::numbers::Addition;
use crate::criticism::signature::{Ranked, start_by_direction};
use crate::inference::Failure;
use crate::math::median;
use crate::mechanism::effects::EffectKind;
use crate::model::{BatchFit, Hypothesis};

/// κ from which on a model is far off.
pub(super) const FAR_OFF: f64 = 1e3;
/// κ of a window that needs more than the usual one, in units of that.
const NOISY: f64 = 3.0;
/// Some candidates start with κ larger by this, too.
const WIDENED: f64 = 30.0;
/// A delay is tried from these \[scales\] and from what its signature says: the motion's dependence on it is far
/// from linear.
const DELAYS: [f64; 4] = [-0.8, 0.3, 1.0, 2.0];
/// That of motors' torques is tried from either side of none [scales].
const NEAR_DELAYS: [f64; 2] = [-0.1, 0.1];
/// Linearizations where several joints move and candidates are only glanced at.
pub(super) const GLANCE: (usize, usize) = (4, 1);
/// Friction that was not declared starts from these shares of a joint's usual force, near what is known and far
/// from it.
const FRICTION_STARTS: [f64; 2] = [0.3, 0.1];
/// The same of starts far from it with much process noise, and their κ.
const WIDE_FRICTION: f64 = 0.03;
const WIDE_SCALES: [f64; 2] = [1e3, 1e5];

/// A refitted candidate.
#[derive(Clone)]
pub(super) struct Trial {
    pub(super) addition: Addition,
    pub(super) also: Vec<Addition>,
    /// All of its model.
    pub(super) additions: BTreeSet<Addition>,
    pub(super) gain: f64,
    /// Linearizations spent, those from other starts too.
    pub(super) spent: usize,
    pub(super) hypothesis: Hypothesis,
    pub(super) fits: Vec<(Vec<usize>, BatchFit)>,
}

impl Trial {
    /// Variance and correlation of its innovations beyond what they should be, of the usual window.
    pub(super) fn reduction(&self) -> f64 {
        let windows = self.fits.iter().flat_map(|(_, fitted)| &fitted.windows);
        median(windows.map(|window| window.reduction).collect()).unwrap_or(1.0)
    }

    /// κ of the usual window.
    pub(super) fn usual_noise_scale(&self) -> f64 {
        let windows = self.fits.iter().flat_map(|(_, fitted)| &fitted.windows);
        median(windows.map(|window| window.noise_scale).collect()).unwrap_or(1.0)
    }

    /// How many numbers it adds.
    pub(super) fn numbers(&self) -> usize {
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
    /// The best of a candidate's starts, refitted.
    pub(super) fn best_trial(&self, current: &Selection, candidate: &Ranked) -> Result<Trial, Failure> {
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
            // Motors' torques are late by little.
            Addition::Delay if candidate.also.is_empty() && self.several() => {
                let delays = NEAR_DELAYS.into_iter().chain(candidate.start.first().copied());
                alone(delays.map(|delay| (current, delay)).collect())
            }
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
                let calm = current.with_noise_scales(|_| CALM);
                [current.clone(), anew, calm].map(|from| (from, candidate.clone())).into()
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

    /// The best of trials from the process noise that windows have and from what the usual window has: noise that a
    /// window was given for want of an addition holds that down.
    pub(super) fn calm_trial(&self, current: &Selection, candidate: &Ranked, effort: (usize, usize)) -> Option<Trial> {
        let scales = current.noise_scales_of(candidate.addition.joint());
        let usual = median(scales.clone()).unwrap_or(1.0);
        let noisy = scales.into_iter().any(|scale| scale > NOISY * usual);
        let calm = noisy.then(|| current.with_noise_scales(|scale| scale.min(usual)));
        let starts = [current].into_iter().chain(&calm);
        let trials: Vec<Trial> = starts.filter_map(|from| self.trial(from, candidate, effort).ok()).collect();
        let spent = trials.iter().map(|trial| trial.spent).sum();
        let best = trials.into_iter().max_by(|a, b| a.gain.total_cmp(&b.gain))?;
        Some(Trial { spent, ..best })
    }

    /// Fits a trial on from where it is; returns what that cost.
    pub(super) fn refine(&self, trial: &mut Trial) -> Result<usize, Failure> {
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

    /// The model with one addition more, refitted where it matters.
    pub(super) fn trial(
        &self,
        current: &Selection,
        candidate: &Ranked,
        effort: (usize, usize),
    ) -> Result<Trial, Failure> {
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
}

/// Whether the windows that an addition concerns are usually explained by noise.
fn far_off(current: &Selection, addition: Addition) -> bool {
    median(current.noise_scales_of(addition.joint())).is_some_and(|scale| scale >= FAR_OFF)
}
