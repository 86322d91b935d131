//! Which additions the windows call for: forward selection by evidence, each refitted.

mod forward;
mod leftover;
mod ranking;
mod stops;
mod trials;

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::numbers::{Addition, Numbers, Workshop};
use super::rest::RestReadings;
use crate::inference::Failure;
use crate::math::median;
use crate::model::{BatchFit, BatchWindow};
use trials::Trial;

/// κ from which on a window is not explained.
pub const MISFIT: f64 = 10.0;
/// κ that fits start from; the base model's from both, as a wrong model has more than one optimum.
const FIRST_SCALES: [f64; 2] = [10.0, 1e3];
/// κ of a model that lacks nothing.
const CALM: f64 = 1.0;
/// A review ends at this many linearizations of all windows beyond the base model's: more windows take longer,
/// and do not leave less time for each candidate.
const BUDGET: usize = 350;
/// A model that was taken is fitted on at most so often, while that gains as much \[nats\].
const SETTLING: (usize, f64) = (3, 1.0);
/// Linearizations of a refit, and how often κ is chosen anew.
const REFIT: (usize, usize) = (8, 2);

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

    /// Goes on as another fit; what was compared on the way stays.
    fn go_on_as(&mut self, fitted: Self) {
        let Self { additions, numbers, components, log_evidence, .. } = fitted;
        (self.additions, self.numbers) = (additions, numbers);
        (self.components, self.log_evidence) = (components, log_evidence);
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

    /// Windows by their places in the batch.
    pub fn windows(&self, places: &[usize]) -> Vec<&BatchWindow> {
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
        let stops = self.workshop.stops();
        let mut numbers = numbers.clone();
        // Where the learner has them, not where an earlier review had.
        numbers.added.retain(|addition, _| !stops.contains(addition));
        let mut bland = numbers.clone();
        bland.joints.clear();
        // The learner's numbers may be what a wrong model made of the windows.
        for (start, scale) in FIRST_SCALES.into_iter().flat_map(|scale| [(&numbers, scale), (&bland, scale)]) {
            let misfit = best.as_ref().is_none_or(|b| {
                let fits = b.components.iter().filter_map(|c| c.fitted.as_ref());
                fits.flat_map(|f| &f.windows).any(|w| w.reduction > 3.0 || w.noise_scale > 50.0)
            });
            if !misfit {
                continue;
            }
            if let Ok(fitted) = self.fitted_from(&stops, start, scale, (10, 2))
                && best.as_ref().is_none_or(|b| fitted.log_evidence > b.log_evidence)
            {
                best = Some(fitted);
            }
        }
        let mut current = best.ok_or(Failure::Diverged)?;
        self.settle(&mut current)?;
        let usual = median(current.noise_scales_of(None));
        if usual.is_some_and(|scale| scale >= MISFIT) {
            self.drop_stops(&mut current)?;
        }
        self.add_stops(&mut current);
        // Noise that a window was given for want of a stop need not be there any more.
        if current.noise_scales_of(None).into_iter().any(|scale| scale >= MISFIT)
            && let Ok(calm) = self.fitted_from(&current.additions, &current.numbers, CALM, (10, 2))
        {
            current.steps += calm.steps;
            if calm.log_evidence > current.log_evidence {
                current.go_on_as(calm);
            }
        }
        Ok(current)
    }

    /// Whether several joints move in a window.
    fn several(&self) -> bool {
        self.batch.iter().any(|window| window.moving.len() > 1)
    }

    /// Every joint that moves with others has candidates of its own.
    fn budget(&self) -> usize {
        let together = self.batch.iter().map(|window| window.moving.len()).max().unwrap_or(1);
        BUDGET * together * self.weight(&(0..self.batch.len()).collect::<Vec<usize>>())
    }

    /// Fits a model on until that gains nothing more: else whatever is added next gains what was left to find
    /// without it.
    pub fn settle(&self, current: &mut Selection) -> Result<(), Failure> {
        let hypothesis = self.workshop.hypothesis(&current.additions)?;
        for component in &mut current.components {
            let windows = self.windows(&component.windows);
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
                let windows = self.windows(&component.windows);
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
            selected.steps += fitted.steps;
            selected.go_on_as(fitted);
            return Ok(selected);
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
        let known = |a: &Addition| a.is_stop() || selected.rivals.contains_key(a);
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
}
