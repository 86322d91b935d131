//! Windows simulated by what was learned of all the others: an addition has to hold there.

use std::collections::BTreeMap;

use super::numbers::Workshop;
use super::selection::{Component, Selection};
use crate::inference::Failure;
use crate::math::median;
use crate::model::{BatchWindow, Hypothesis};

/// Parts that the windows of a component are left out in, at most.
const FOLDS: usize = 4;
/// Of so many streams whole ones are left out, as what is the same within one may be another in the next; of two the
/// one that is kept says too little.
const SEVERAL: usize = 3;
/// Linearizations of a fit to the windows that are kept: it starts where all windows have it.
const STEPS: usize = 3;
/// Positions are simulated this far \[s\].
const HORIZON_S: f64 = 0.5;
/// By how much ln(force · position) may rise, the mean of all windows together, of which the worst weighs most, and
/// of the usual one: an addition that acts in one window only changes the others by chance.
const SLACK: f64 = 0.05;
/// By how much it has to fall where streams are left out: what is of the object is there in every stream.
const OF_STREAMS: f64 = 0.1;
/// Of a joint that others carry, and whose readings hold their errors, it has to fall by that, too, unless the
/// evidence is this great \[nats\].
const CLEAR_GAIN: f64 = 20.0;

/// Squares of what windows left out lack.
#[derive(Clone, Debug, Default)]
pub struct HeldOut {
    /// By joint and window.
    lacks: BTreeMap<usize, BTreeMap<usize, Lack>>,
    /// Whether whole streams were left out.
    streams: bool,
    /// Joints that others carry.
    carried: Vec<usize>,
    /// Linearizations of all windows spent.
    pub steps: usize,
}

#[derive(Clone, Copy, Debug, Default)]
struct Lack {
    /// \[N² s or (N·m)² s\].
    force: f64,
    /// \[m² or rad²\].
    position: f64,
}

impl HeldOut {
    /// Leaves windows out of the selected model's fit in turn.
    pub fn of(workshop: &Workshop<'_>, batch: &[BatchWindow], selection: &Selection) -> Result<Self, Failure> {
        let hypothesis = workshop.hypothesis(&selection.additions)?;
        let is_carried = |joint: &usize| workshop.fit.joints[*joint].parent.is_some();
        let carried = (0..workshop.fit.joints.len()).filter(is_carried).collect();
        let mut all = Self { carried, ..Self::default() };
        for component in &selection.components {
            let x = selection.numbers.laid_out(&hypothesis, &selection.additions);
            all.add(&hypothesis, &x, component, batch)?;
        }
        Ok(all)
    }

    fn add(
        &mut self,
        hypothesis: &Hypothesis,
        x: &[f64],
        component: &Component,
        batch: &[BatchWindow],
    ) -> Result<(), Failure> {
        let whole = component.fitted.as_ref().ok_or(Failure::NoInformation)?;
        let mut streams: Vec<usize> = component.windows.iter().map(|&w| batch[w].stream).collect();
        streams.sort_unstable();
        streams.dedup();
        let whole_streams = streams.len() >= SEVERAL;
        self.streams |= whole_streams;
        let folds = if whole_streams { streams.len() } else { component.windows.len() }.min(FOLDS);
        let fold_of = |k: usize, w: usize| match whole_streams {
            true => streams.partition_point(|stream| *stream < batch[w].stream) % folds,
            false => k % folds,
        };
        for fold in (0..folds).filter(|_| folds > 1) {
            let (mut kept, mut scales, mut left_out) = (Vec::new(), Vec::new(), Vec::new());
            for (k, &w) in component.windows.iter().enumerate() {
                if fold_of(k, w) == fold {
                    left_out.push(&batch[w]);
                } else {
                    kept.push(&batch[w]);
                    scales.push(whole.windows[k].noise_scale);
                }
            }
            let seen = |window: &&BatchWindow| {
                window.moving.iter().all(|joint| kept.iter().any(|other| other.moving.contains(joint)))
            };
            left_out.retain(seen);
            if left_out.is_empty() {
                continue;
            }
            let learned = hypothesis.fit(&kept, x, &scales, (STEPS, 0))?;
            self.steps += learned.steps * kept.len() + left_out.len();
            let usual = median(scales).ok_or(Failure::NoInformation)?;
            for window in left_out {
                let residual = hypothesis.window(window, usual).residual(&learned.x, HORIZON_S, 0.0)?;
                for (column, joint) in window.moving.iter().enumerate() {
                    let squares = residual.forces.iter().map(|(_, span, force)| span * force[column].powi(2));
                    let lack = Lack { force: squares.sum(), position: residual.squares[column].0 };
                    self.lacks.entry(*joint).or_default().insert(window.index, lack);
                }
            }
        }
        Ok(())
    }

    /// ln(force · position) in units of what another model leaves, of all windows and of the usual one, means of
    /// the `joints` that the difference concerns, so that the others do not stand up for it; none where nothing
    /// could be left out.
    pub fn ratios_to(&self, before: &Self, joints: &[usize]) -> Option<[f64; 2]> {
        let mut ratios = Vec::new();
        for (joint, own) in self.lacks.iter().filter(|(joint, _)| joints.contains(joint)) {
            let others = before.lacks.get(joint);
            let pairs: Vec<(Lack, Lack)> =
                own.iter().filter_map(|(window, lack)| Some((*lack, *others?.get(window)?))).collect();
            let sum = |side: fn(&(Lack, Lack)) -> Lack| {
                pairs.iter().map(side).fold(Lack::default(), |sum, lack| Lack {
                    force: sum.force + lack.force,
                    position: sum.position + lack.position,
                })
            };
            if let Some(usual) = median(pairs.iter().map(|(own, other)| own.ln_over(other)).collect()) {
                ratios.push([sum(|pair| pair.0).ln_over(&sum(|pair| pair.1)), usual]);
            }
        }
        let mean = |i: usize| ratios.iter().map(|ratio| ratio[i]).sum::<f64>() / ratios.len() as f64;
        (!ratios.is_empty()).then(|| [mean(0), mean(1)])
    }

    /// Whether windows left out are simulated no worse than by another model with less evidence by `gain` \[nats\], as
    /// far as these joints go.
    pub fn holds_against(&self, before: &Self, joints: &[usize], gain: f64) -> bool {
        let is_doubtful = || gain < CLEAR_GAIN && joints.iter().any(|joint| self.carried.contains(joint));
        let slack = if self.streams || is_doubtful() { -OF_STREAMS } else { SLACK };
        self.ratios_to(before, joints).is_none_or(|[all, usual]| 0.5 * (all + usual) < slack)
    }
}

impl Lack {
    /// ln(force · position) in units of another's.
    fn ln_over(&self, other: &Self) -> f64 {
        let log = |own: f64, other: f64| 0.5 * (own.max(1e-30) / other.max(1e-30)).ln();
        log(self.force, other.force) + log(self.position, other.position)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const GAIN: f64 = 10.0;

    /// Lacks of force and position by joint, one for each window.
    fn held_out(of_joints: &[(usize, &[f64])]) -> HeldOut {
        let windows = |own: &[f64]| {
            own.iter().map(|lack| Lack { force: lack * lack, position: lack * lack }).enumerate().collect()
        };
        let lacks = of_joints.iter().map(|(joint, own)| (*joint, windows(own))).collect();
        HeldOut { lacks, ..HeldOut::default() }
    }

    #[test]
    fn one_joint_does_not_stand_up_for_another() {
        let before = held_out(&[(0, &[1.0; 4]), (1, &[1.0; 4])]);
        let after = held_out(&[(0, &[0.2; 4]), (1, &[1.1; 4])]);
        assert!(after.holds_against(&before, &[0, 1], GAIN), "a sensor's error concerns both");
        assert!(after.holds_against(&before, &[0], GAIN));
        assert!(!after.holds_against(&before, &[1], GAIN));
    }

    #[test]
    fn what_helps_one_window_and_harms_the_others_does_not_hold() {
        let before = held_out(&[(0, &[1.0, 1.0, 1.0, 1.0])]);
        assert!(!held_out(&[(0, &[0.9, 1.15, 1.15, 1.15])]).holds_against(&before, &[0], GAIN));
        assert!(held_out(&[(0, &[0.5, 1.01, 1.01, 1.01])]).holds_against(&before, &[0], GAIN));
    }

    #[test]
    fn what_helps_no_window_left_out_of_a_joint_that_others_carry_needs_more_evidence() {
        let before = held_out(&[(0, &[1.0; 4])]);
        let [same, better] = [1.0, 0.8].map(|lack| HeldOut { carried: vec![0], ..held_out(&[(0, &[lack; 4])]) });
        assert!(!same.holds_against(&before, &[0], GAIN) && same.holds_against(&before, &[0], 2.0 * CLEAR_GAIN));
        assert!(better.holds_against(&before, &[0], GAIN));
    }

    #[test]
    fn nothing_left_out_says_nothing() {
        let none = HeldOut::default();
        assert_eq!(none.ratios_to(&held_out(&[(0, &[1.0])]), &[0]), None);
        assert!(none.holds_against(&HeldOut::default(), &[0], GAIN));
    }
}
