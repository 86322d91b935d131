//! What has no name: tables that describe what a model leaves.

use std::collections::{BTreeMap, BTreeSet};

use super::trials::Trial;
use super::{MISFIT, REFIT, Selection, Selector};
use crate::criticism::held_out::HeldOut;
use crate::criticism::numbers::Addition;
use crate::criticism::signature::{Probes, Ranked};
use crate::inference::Failure;
use crate::mechanism::effects::TableKind;

/// A table, which fits much, is accepted if it raises the log evidence by this.
const LEAST_TABLE_GAIN: f64 = 10.0;
/// Where a window is not explained so many tables are tried in any case.
const TABLES_TRIED: usize = 4;

impl Selector<'_> {
    /// What each table would gain over the model on a joint.
    pub(super) fn leftover(&self, own: &Probes, joint: usize) -> Vec<(Addition, f64)> {
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

    /// Adds the tables that what is left calls for; the named ones that then gain nothing go. And the joints of
    /// which one window resists otherwise than another, whether or not that tells anything of windows left out.
    pub fn describe_leftover(&self, mut current: Selection) -> Result<(Selection, BTreeSet<usize>), Failure> {
        let mut drifting = BTreeSet::new();
        let leftover = current.leftover.clone();
        tracing::debug!(?leftover, "leftover");
        let budget = current.steps + self.budget() / 2;
        let mut best: BTreeMap<usize, Trial> = BTreeMap::new();
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
            let ranked = Ranked { addition, gain, start: Vec::new(), also: Vec::new() };
            let Some(trial) = self.calm_trial(&current, &ranked, REFIT) else { continue };
            current.steps += trial.spent;
            tracing::debug!(?addition, gain, refitted = trial.gain, "table");
            if matches!(addition, Addition::Table(_, TableKind::FrictionOverTime)) && trial.gain > LEAST_TABLE_GAIN {
                drifting.insert(joint);
            }
            let least = if self.several() { LEAST_TABLE_GAIN * trial.reduction() } else { LEAST_TABLE_GAIN };
            if trial.gain > least && best.get(&joint).is_none_or(|other| trial.gain > other.gain) {
                best.insert(joint, trial);
            }
        }
        let mut held_out = match best.is_empty() {
            true => HeldOut::default(),
            false => HeldOut::of(self.workshop, self.batch, &current).unwrap_or_default(),
        };
        for mut trial in best.into_values() {
            let addition = trial.addition;
            // Another table has been added since it was tried.
            if !trial.additions.is_superset(&current.additions) {
                let ranked = Ranked { addition, gain: trial.gain, start: Vec::new(), also: Vec::new() };
                let Some(anew) = self.calm_trial(&current, &ranked, REFIT) else { continue };
                trial = anew;
            }
            let mut next = current.clone();
            self.take(&mut next, &trial);
            let had = (&current.additions, current.log_evidence);
            let Some(after) = self.holding(&next, &held_out, had, &mut current.steps) else { continue };
            held_out = after;
            current = Selection { steps: current.steps, ..next };
            current.rivals.insert(addition, vec![(None, -trial.gain)]);
            self.drop_what_is_not_needed(&mut current, addition)?;
            current.note_step();
        }
        Ok((current, drifting))
    }
}

/// Whether a window that moves a joint needs far more process noise than the sensor explains.
fn misfits(current: &Selection, joint: usize) -> bool {
    current.noise_scales_of(Some(joint)).into_iter().any(|scale| scale >= MISFIT)
}
