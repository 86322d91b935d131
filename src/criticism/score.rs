//! Every window scored by what was learned of those before it.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::DVector;

use super::numbers::{Addition, Numbers, Workshop};
use super::selection::{Component, Selection};
use super::statistics::whiteness;
use crate::inference::{Failure, Gaussian};
use crate::math::median;
use crate::mechanism::JointType;
use crate::model::{BatchWindow, Hypothesis, WindowResidual};
use crate::types::Label;
use crate::types::posterior::ResidualScore;

/// Positions are simulated this far \[s\].
const HORIZON_S: f64 = 1.0;
/// Lags that whiteness is tested over.
const LAGS: usize = 10;

/// Scores by part, and the sum of the log predictive densities.
#[derive(Clone, Debug, Default)]
pub struct Scores {
    /// As published.
    pub rows: Vec<ResidualScore>,
    /// Over all scored windows \[nats\].
    pub log_predictive_density: f64,
    /// How many windows were scored.
    pub windows: usize,
}

/// One scored window.
struct Scored {
    window: usize,
    log_density: f64,
    residual: WindowResidual,
}

/// Scores a selected model on its windows.
pub fn scores(workshop: &Workshop<'_>, batch: &[BatchWindow], selection: &Selection) -> Result<Scores, Failure> {
    let hypothesis = workshop.hypothesis(&selection.additions)?;
    let mut scored: Vec<Scored> = Vec::new();
    for component in &selection.components {
        scored.extend(sequence(&hypothesis, &selection.additions, &selection.numbers, component, batch)?);
    }
    let mut scores = Scores {
        rows: Vec::new(),
        log_predictive_density: scored.iter().map(|s| s.log_density).sum(),
        windows: scored.len(),
    };
    let mut by_joint: BTreeMap<usize, Vec<(usize, &Scored)>> = BTreeMap::new();
    for one in &scored {
        for (column, joint) in batch[one.window].moving.iter().enumerate() {
            by_joint.entry(*joint).or_default().push((column, one));
        }
    }
    for (joint, windows) in by_joint {
        scores.rows.push(row(workshop, joint, &windows));
    }
    scores.rows.sort_by_key(|row| row.label);
    Ok(scores)
}

/// The windows of a component but the first of each set of joints, each by those before it.
fn sequence(
    hypothesis: &Hypothesis,
    additions: &BTreeSet<Addition>,
    numbers: &Numbers,
    component: &Component,
    batch: &[BatchWindow],
) -> Result<Vec<Scored>, Failure> {
    let mut scored = Vec::new();
    let whole = component.fitted.as_ref().ok_or(Failure::NoInformation)?;
    let mut x = numbers.laid_out(hypothesis, additions);
    for (k, &w) in component.windows.iter().enumerate().skip(1) {
        let window = &batch[w];
        let known: Vec<&BatchWindow> = component.windows[..k].iter().map(|&w| &batch[w]).collect();
        if !window.moving.iter().all(|joint| known.iter().any(|other| other.moving.contains(joint))) {
            continue;
        }
        let scales: Vec<f64> = whole.windows[..k].iter().map(|w| w.noise_scale).collect();
        let learned = hypothesis.fit(&known, &x, &scales, (5, 0))?;
        x.clone_from(&learned.x);
        let usual = median(scales).ok_or(Failure::NoInformation)?;
        let mut posterior = hypothesis.clone();
        posterior.prior = learned_prior(hypothesis, &learned)?;
        // The mode of what the window says is sought from what was known and from what is known now.
        let now = numbers.laid_out(hypothesis, additions);
        let fits = [(&x, usual), (&now, whole.windows[k].noise_scale)]
            .map(|(start, scale)| posterior.fit(&[window], start, &[scale], (4, 1)));
        let best = fits.into_iter().flatten().max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence));
        let fresh = best.ok_or(Failure::Diverged)?;
        let log_density = fresh.log_evidence - 0.5 * fresh.windows[0].observations as f64 * std::f64::consts::TAU.ln();
        let residual = hypothesis.window(window, usual).residual(&x, HORIZON_S)?;
        scored.push(Scored { window: w, log_density, residual });
    }
    Ok(scored)
}

/// The prior with what was learned in the place of what it said of the same numbers.
fn learned_prior(hypothesis: &Hypothesis, learned: &crate::model::BatchFit) -> Result<Gaussian, Failure> {
    let mean = DVector::from_iterator(learned.active.len(), learned.active.iter().map(|&i| learned.x[i]));
    let own = Gaussian::from_moments(&mean, &learned.covariance)?;
    let all = hypothesis.prior.dimension();
    let others: Vec<usize> = (0..all).filter(|i| learned.active.binary_search(i).is_err()).collect();
    let rest = hypothesis.prior.marginal(&others)?;
    let mut prior = Gaussian::flat(all);
    prior.multiply_at(&own, &learned.active);
    prior.multiply_at(&rest, &others);
    Ok(prior)
}

fn row(workshop: &Workshop<'_>, joint: usize, windows: &[(usize, &Scored)]) -> ResidualScore {
    let kinematic = &workshop.fit.joints[joint];
    let revolute = kinematic.joint_type == JointType::Revolute;
    let (mut squares, mut time) = (0.0, 0.0);
    let (mut position_squares, mut count) = (0.0, 0);
    for (column, one) in windows {
        for (_, length, force) in &one.residual.forces {
            squares += length * force[*column].powi(2);
            time += length;
        }
        position_squares += one.residual.squares[*column].0;
        count += one.residual.squares[*column].1;
    }
    let force = (squares / f64::max(time, 1e-9)).sqrt();
    let position = (position_squares / count.max(1) as f64).sqrt();
    let series: Vec<Vec<f64>> = windows.iter().map(|(column, one)| one.residual.whitened[*column].clone()).collect();
    let density: f64 = windows.iter().map(|(_, one)| one.log_density).sum();
    ResidualScore {
        label: Label(kinematic.child.0),
        scored_windows: windows.len(),
        force_rmse_n: (!revolute).then_some(force),
        torque_rmse_nm: revolute.then_some(force),
        position_rmse_m: if revolute { position * kinematic.radius } else { position },
        rotation_rmse_rad: if revolute { position } else { 0.0 },
        log_predictive_density: density / windows.len().max(1) as f64,
        residual_whiteness_p: whiteness(&series, LAGS),
    }
}
