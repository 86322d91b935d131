//! Finds what the model lacks: residual, candidates, refit, verdict (DESIGN.md section 7).
//!
//! Every window is in the batch that hypotheses are fitted to. The evidence of a hypothesis is the
//! product of the predictive densities of the windows, each by those before it, so that comparing
//! evidence compares predictions of what was not learned yet.

mod numbers;
mod rest;
mod selection;
mod signature;
mod statistics;

pub use numbers::{Addition, Numbers, Workshop};
pub use selection::{Selection, Selector};

use std::collections::BTreeSet;

use crate::inference::Failure;
use crate::model::{DynamicsInput, DynamicsLearner, KinematicFit};
use rest::RestReadings;

/// Windows of the same joints that are looked at together at most.
const MOST_WINDOWS: usize = 8;

/// Follows a learner and says what it lacks.
#[derive(Clone, Debug, Default)]
pub struct Critic {
    /// The last selection.
    pub selection: Option<Selection>,
}

impl Critic {
    /// Looks at all windows so far.
    pub fn review(&mut self, learner: &DynamicsLearner, fit: &KinematicFit, input: &DynamicsInput<'_>) -> Result<(), Failure> {
        let batch = learner.batch(fit, input, MOST_WINDOWS);
        if batch.is_empty() {
            return Ok(());
        }
        let sensor_scales = [1.0, 0.2, 0.05];
        let rest = RestReadings::of(&batch, input, &sensor_scales);
        let spans = input
            .windows
            .iter()
            .filter_map(|w| Some([*w.times_s.first()?, *w.times_s.last()?]))
            .collect();
        let rest_prior = rest.as_ref().and_then(RestReadings::posterior);
        let workshop = Workshop { learner, fit, input, rest_prior, sensor_scales, spans };
        let selector = Selector { workshop: &workshop, batch: &batch, rest: rest.as_ref() };
        let (joints, sensor) = learner.numbers()?;
        let numbers = Numbers { joints, sensor, added: Default::default() };
        let base = selector.fitted(&BTreeSet::new(), &numbers, (10, 2))?;
        tracing::debug!(evidence = base.log_evidence, scales = ?base.components.iter().map(|c| c.fitted.as_ref().map(|f| f.windows.iter().map(|w| (w.noise_scale, w.reduction)).collect::<Vec<_>>())).collect::<Vec<_>>(), "base");
        let selected = selector.select(base)?;
        let selected = selector.describe_leftover(selected)?;
        tracing::debug!(evidence = selected.log_evidence, steps = selected.steps, additions = ?selected.additions, numbers = ?selected.numbers, "selected");
        self.selection = Some(selected);
        Ok(())
    }
}
