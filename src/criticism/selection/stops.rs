//! End stops that the windows show, and those that they show no more.

use super::{REFIT, Selection, Selector};
use crate::criticism::numbers::Addition;
use crate::criticism::signature::Ranked;
use crate::inference::Failure;
use crate::mechanism::effects::EffectKind;

/// A stop is believed from this gain on.
const STOP_GAIN: f64 = 4.0;
/// A joint that goes less than a fifth of its usual way in this span has halted \[s\].
const HALT_S: f64 = 0.2;

impl Selector<'_> {
    /// Adds the end stops that the windows show by a model: what it lacks may hide them.
    pub(super) fn add_stops(&self, current: &mut Selection) {
        for component in current.components.clone() {
            for &joint in &component.joints {
                let moved = component.windows.iter().any(|&w| self.batch[w].moving.contains(&joint));
                for upper in [false, true].into_iter().filter(|_| moved) {
                    let stop = Addition::Stop(joint, upper);
                    if current.additions.contains(&stop) || !self.may_halt(joint, upper) {
                        continue;
                    }
                    let (low, high) = self.workshop.range(joint);
                    let start = vec![if upper { high } else { low }];
                    let ranked = Ranked { addition: stop, gain: 0.0, start, also: Vec::new() };
                    if let Some(trial) = self.calm_trial(current, &ranked, (5, 1)) {
                        current.steps += trial.spent;
                        if trial.gain > STOP_GAIN {
                            self.take(current, &trial);
                        }
                    }
                }
            }
        }
    }

    /// Looks at the end stops anew, by a model that lacks less; returns what that cost, which is no candidate's.
    pub(super) fn look_for_stops(&self, current: &mut Selection) -> Result<usize, Failure> {
        let before = current.steps;
        self.drop_stops(current)?;
        self.add_stops(current);
        Ok(current.steps - before)
    }

    /// Drops the end stops that the windows call for no more: what was lacking may have looked like one.
    pub(super) fn drop_stops(&self, current: &mut Selection) -> Result<(), Failure> {
        let stops: Vec<Addition> = current.additions.iter().filter(|a| a.is_stop()).copied().collect();
        for stop in stops {
            let mut fewer = current.additions.clone();
            fewer.remove(&stop);
            let without = self.fitted(&fewer, &current.numbers, REFIT)?;
            current.steps += without.steps;
            tracing::debug!(?stop, loss = current.log_evidence - without.log_evidence, "without");
            if without.log_evidence > current.log_evidence - STOP_GAIN {
                current.go_on_as(without);
            }
        }
        Ok(())
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

    /// The stop at the closed end, if the effect pulls there or holds, and the joint was there.
    pub(super) fn closed_stop(&self, addition: Addition) -> Option<Addition> {
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
        (end.abs() < 0.05 * scales.travel.abs()).then_some(Addition::Stop(joint, upper))
    }
}
