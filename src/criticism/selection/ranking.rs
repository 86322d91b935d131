//! What might be added, by what its signature in the residual promises.

use std::collections::{BTreeMap, BTreeSet};

use super::trials::{FAR_OFF, GLANCE};
use super::{FIRST_SCALES, Selection, Selector};
use crate::criticism::numbers::Addition;
use crate::criticism::signature::{Ranked, probes};
use crate::inference::Failure;
use crate::math::median;
use crate::mechanism::effects::EffectKind;
use crate::model::{BatchFit, BatchWindow, Hypothesis};

/// How many of the ranked are refitted, and from how much first-order gain on \[nats\].
const REFITTED: usize = 5;
const WORTH_A_REFIT: f64 = 3.0;
/// Rank of what was found before.
pub(super) const KNOWN: f64 = 1e9;

impl Selector<'_> {
    /// Everything that might be added, by joint, and what tables would gain.
    pub(super) fn ranked(
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
            let calm = self.with_little_noise(&hypothesis, fitted, &windows);
            let fitted = calm.as_ref().unwrap_or(fitted);
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
            let named = |a: &&Addition| !a.is_stop() && !matches!(a, Addition::Table(..));
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

    /// A fit of windows that noise explains as a whole, with little of it: else no residual is left to show a
    /// signature.
    fn with_little_noise(
        &self,
        hypothesis: &Hypothesis,
        fitted: &BatchFit,
        windows: &[&BatchWindow],
    ) -> Option<BatchFit> {
        let usual = median(fitted.windows.iter().map(|window| window.noise_scale).collect())?;
        if self.several() || usual < FAR_OFF {
            return None;
        }
        hypothesis.fit(windows, &fitted.x, &vec![FIRST_SCALES[0]; windows.len()], (GLANCE.0, 0)).ok()
    }

    /// The best few of every joint, and the sensor's.
    pub(super) fn shortlist(&self, ranked: &[Ranked]) -> Vec<Ranked> {
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
}
