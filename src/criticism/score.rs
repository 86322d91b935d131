//! Every window scored by what was learned of those before it.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use super::numbers::{Addition, Numbers, Workshop};
use super::selection::{Component, Selection};
use super::statistics::whiteness;
use crate::inference::Failure;
use crate::math::median;
use crate::mechanism::JointType;
use crate::model::{BatchWindow, Hypothesis, KinematicJoint, WindowResidual};
use crate::types::posterior::ResidualScore;

/// Positions are simulated this far \[s\].
pub const HORIZON_S: f64 = 1.0;
/// Linearizations of a fit to some of the windows; κ is as all of them have it.
const STEPS: (usize, usize) = (5, 0);
/// Lags that whiteness is tested over.
const LAGS: usize = 10;

/// Scores by part, and the sum of the log predictive densities.
#[derive(Clone, Debug, Default)]
pub struct Scores {
    /// As published.
    pub rows: Vec<ResidualScore>,
    /// By place in the batch of the windows that could be scored \[nats\].
    pub densities: BTreeMap<usize, f64>,
    /// By joint, what force was left of each of its windows that could be scored.
    pub left: BTreeMap<usize, Vec<ForceLeft>>,
}

/// The force on a joint that a model leaves unexplained in a window.
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct ForceLeft {
    /// The middle of the window \[s\].
    pub time_s: f64,
    /// Its mean \[N or N·m\].
    pub mean: f64,
    /// Its standard deviation about that.
    pub deviation: f64,
}

/// What a model leaves of one joint in one window.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct JointScore {
    /// The force.
    pub force: ForceLeft,
    /// How long it was looked at \[s\].
    length_s: f64,
    /// Sum of the squares of what positions are off, with their count \[m² or rad²\].
    squares: (f64, usize),
    /// Whitened innovations.
    whitened: Vec<f64>,
    /// Of the whole window, where it is known \[nats\].
    pub log_density: Option<f64>,
}

impl JointScore {
    /// Of one of the joints that move in a window, by its place among them.
    pub fn of(residual: &WindowResidual, column: usize, log_density: Option<f64>) -> Self {
        let length_s: f64 = residual.forces.iter().map(|(_, length, _)| length).sum();
        let mean_of = |of: &dyn Fn(f64, f64) -> f64| {
            let forces = residual.forces.iter();
            forces.map(|(time_s, length, force)| length * of(*time_s, force[column])).sum::<f64>() / length_s.max(1e-9)
        };
        let mean = mean_of(&|_, force| force);
        let deviation = mean_of(&|_, force| (force - mean).powi(2)).sqrt();
        Self {
            force: ForceLeft { time_s: mean_of(&|time_s, _| time_s), mean, deviation },
            length_s,
            squares: residual.squares[column],
            whitened: residual.whitened[column].clone(),
            log_density,
        }
    }

    /// Mean square of the force \[N² or (N·m)²\].
    pub fn force_square(&self) -> f64 {
        self.force.mean.powi(2) + self.force.deviation.powi(2)
    }
}

impl Scores {
    /// Over all scored windows \[nats\].
    pub fn log_predictive_density(&self) -> f64 {
        self.densities.values().sum()
    }

    /// Whether force and position together are simulated better, over all parts.
    pub fn simulates_better_than(&self, other: &Self) -> bool {
        let lack = |row: &ResidualScore| {
            let force = row.force_rmse().unwrap_or(0.0).max(1e-30);
            force.ln() + (row.position_rmse_m.hypot(row.rotation_rmse_rad)).max(1e-30).ln()
        };
        let sum = |scores: &Self| scores.rows.iter().map(lack).sum::<f64>();
        self.rows.len() == other.rows.len() && sum(self) < sum(other)
    }

    /// Whether some windows, those that could be scored `before`, are predicted better than there; none where
    /// none could be.
    pub fn better_on(&self, windows: &[usize], before: &Self) -> Option<bool> {
        let pairs = windows.iter().filter_map(|w| Some((self.densities.get(w), before.densities.get(w)?)));
        let gains: Vec<Option<f64>> = pairs.map(|(own, other)| Some(own? - other)).collect();
        // What cannot be scored any more is not predicted better.
        (!gains.is_empty()).then(|| gains.into_iter().sum::<Option<f64>>().is_some_and(|gain| gain > 0.0))
    }
}

/// One scored window.
struct Scored {
    window: usize,
    log_density: f64,
    residual: WindowResidual,
}

/// Scores a selected model on its windows; what cannot be scored of one component is no matter of the others.
pub fn scores(workshop: &Workshop<'_>, batch: &[BatchWindow], selection: &Selection) -> Result<Scores, Failure> {
    let hypothesis = workshop.hypothesis(&selection.additions)?;
    let mut scored: Vec<Scored> = Vec::new();
    for component in &selection.components {
        match sequence(&hypothesis, &selection.additions, &selection.numbers, component, batch) {
            Ok(own) => scored.extend(own),
            Err(failure) => tracing::debug!(joints = ?component.joints, %failure, "not scored"),
        }
    }
    let densities = scored.iter().map(|s| (s.window, s.log_density)).collect();
    let mut scores = Scores { rows: Vec::new(), densities, left: BTreeMap::new() };
    let mut by_joint: BTreeMap<usize, Vec<JointScore>> = BTreeMap::new();
    for one in &scored {
        for (column, joint) in batch[one.window].moving.iter().enumerate() {
            by_joint.entry(*joint).or_default().push(JointScore::of(&one.residual, column, Some(one.log_density)));
        }
    }
    for (joint, windows) in by_joint {
        scores.rows.push(row(&workshop.fit.joints[joint], &windows));
        scores.left.insert(joint, windows.iter().map(|one| one.force).collect());
    }
    scores.rows.sort_by_key(|row| row.label);
    Ok(scores)
}

/// The windows of a component but the first of each set of joints, each by those before it.
///
/// P(window | those before it) is the evidence of all up to it over that of those before it: each at an optimum of
/// its own, as what a few windows leave open may be curved, and no Gaussian stands for it.
fn sequence(
    hypothesis: &Hypothesis,
    additions: &BTreeSet<Addition>,
    numbers: &Numbers,
    component: &Component,
    batch: &[BatchWindow],
) -> Result<Vec<Scored>, Failure> {
    let mut scored = Vec::new();
    let whole = component.fitted.as_ref().ok_or(Failure::NoInformation)?;
    let windows: Vec<&BatchWindow> = component.windows.iter().map(|&w| &batch[w]).collect();
    let scales: Vec<f64> = whole.windows.iter().map(|w| w.noise_scale).collect();
    let now = numbers.laid_out(hypothesis, additions);
    let mut learned = hypothesis.fit(&windows[..1], &now, &scales[..1], STEPS)?;
    for (k, window) in windows.iter().enumerate().skip(1) {
        // The last of them ends at what was fitted to all, which need not be found again.
        let with = if k + 1 == windows.len() {
            whole.clone()
        } else {
            let fits = [&learned.x, &now].map(|x| hypothesis.fit(&windows[..=k], x, &scales[..=k], STEPS));
            let best = fits.into_iter().flatten().max_by(|a, b| a.log_evidence.total_cmp(&b.log_evidence));
            best.ok_or(Failure::Diverged)?
        };
        let known = &windows[..k];
        if window.moving.iter().all(|joint| known.iter().any(|other| other.moving.contains(joint))) {
            let constant = 0.5 * with.windows[k].observations as f64 * std::f64::consts::TAU.ln();
            let log_density = with.log_evidence - learned.log_evidence - constant;
            let usual = median(scales[..k].to_vec()).ok_or(Failure::NoInformation)?;
            let residual = hypothesis.window(window, usual).residual(&learned.x, HORIZON_S, 0.0)?;
            scored.push(Scored { window: component.windows[k], log_density, residual });
        }
        learned = with;
    }
    Ok(scored)
}

/// A joint's scores over its windows, as published.
pub fn row(joint: &KinematicJoint, windows: &[JointScore]) -> ResidualScore {
    let revolute = joint.joint_type == JointType::Revolute;
    let time: f64 = windows.iter().map(|one| one.length_s).sum();
    let squares: f64 = windows.iter().map(|one| one.length_s * one.force_square()).sum();
    let force = (squares / time.max(1e-9)).sqrt();
    let (position_squares, count) =
        windows.iter().fold((0.0, 0), |sum, one| (sum.0 + one.squares.0, sum.1 + one.squares.1));
    let position = (position_squares / count.max(1) as f64).sqrt();
    let series: Vec<Vec<f64>> = windows.iter().map(|one| one.whitened.clone()).collect();
    let densities: Vec<f64> = windows.iter().filter_map(|one| one.log_density).collect();
    ResidualScore {
        label: joint.child,
        scored_windows: windows.len(),
        force_rmse_n: (!revolute).then_some(force),
        torque_rmse_nm: revolute.then_some(force),
        position_rmse_m: if revolute { position * joint.radius } else { position },
        rotation_rmse_rad: if revolute { position } else { 0.0 },
        log_predictive_density: densities.iter().sum::<f64>() / densities.len().max(1) as f64,
        residual_whiteness_p: whiteness(&series, LAGS),
    }
}
