//! One hypothesis of the physics fitted to many windows at once.
//!
//! −log p(θ | windows) = Σ_w [½ |e_w(θ)|² + ½ ln |S_w|] + ½ (θ − m)ᵀ Λ (θ − m), e the whitened
//! innovations of [`super::innovations`]; its Laplace evidence is the sum of the log predictive
//! densities of the windows, each by the posterior of those before it. κ, the process noise, is
//! chosen per window.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::innovations::{Gain, Innovations, WindowModel, normal_equations};
use super::layout::Mechanism;
use super::learner::DynamicsInput;
use super::site::{inertial_entries, log_density, reduction, scale_cost};
use super::track::JointTrack;
use crate::inference::{Failure, Gaussian, LeastSquares, Linearization, SolverSettings, solve};
use crate::model::Axis;

/// κ to choose from: up to what a wrong model needs.
const NOISE_SCALES: [f64; 10] = [1.0, 3.0, 10.0, 30.0, 100.0, 300.0, 1e3, 3e3, 1e4, 1e5];

/// One window in joint space with all that a fit of it needs.
#[derive(Clone, Debug)]
pub struct BatchWindow {
    /// Which of all windows.
    pub index: usize,
    /// Of which stream.
    pub stream: usize,
    /// Axes by joint.
    pub axes: Vec<Axis>,
    /// Positions of the joints that rest in it.
    pub frozen: Vec<Option<f64>>,
    /// The joints that move.
    pub moving: Vec<usize>,
    /// Joints whose numbers matter, and whether all of them do or only the inertial ones.
    pub involved: Vec<(usize, bool)>,
    /// Observations and wrench.
    pub track: JointTrack,
}

impl BatchWindow {
    /// The window under a mechanism at a process noise.
    pub fn model<'a>(&'a self, mechanism: &'a Mechanism, noise_scale: f64) -> WindowModel<'a> {
        WindowModel {
            mechanism,
            axes: &self.axes,
            frozen: &self.frozen,
            moving: &self.moving,
            track: &self.track,
            noise_scale,
        }
    }

    /// Whether several joints move that clouds see: a hypothesis of such a window costs seconds.
    pub fn is_costly(&self, input: &DynamicsInput<'_>) -> bool {
        self.moving.len() > 1 && input.windows[self.index].direct.is_empty()
    }
}

/// A model of the physics with its prior over all of its numbers.
#[derive(Clone, Debug)]
pub struct Hypothesis {
    /// Joints with their effects, and the sensor.
    pub mechanism: Mechanism,
    /// Of all numbers.
    pub prior: Gaussian,
}

/// One window at the optimum of a batch.
#[derive(Clone, Debug)]
pub struct BatchedWindow {
    /// κ.
    pub noise_scale: f64,
    /// Log likelihood, up to 2π.
    pub log_likelihood: f64,
    /// How many numbers were observed.
    pub observations: usize,
    /// Entries of all numbers that it depends on.
    pub active: Vec<usize>,
    /// Variance and correlation of the innovations beyond what they should be.
    pub reduction: f64,
}

/// A fitted batch.
#[derive(Clone, Debug)]
pub struct BatchFit {
    /// All numbers.
    pub x: Vec<f64>,
    /// The entries that were fitted.
    pub active: Vec<usize>,
    /// Covariance of those.
    pub covariance: DMatrix<f64>,
    /// Laplace log evidence of all windows, up to 2π \[nats\].
    pub log_evidence: f64,
    /// By window.
    pub windows: Vec<BatchedWindow>,
    /// Linearizations of all windows spent.
    pub steps: usize,
}

impl Hypothesis {
    /// The entries that a window depends on.
    pub fn active(&self, window: &BatchWindow) -> Vec<usize> {
        let mechanism = &self.mechanism;
        let mut active = Vec::new();
        for &(joint, whole) in &window.involved {
            let own = mechanism.joints[joint].active();
            let own = if whole { own } else { inertial_entries(&own) };
            active.extend(own.into_iter().map(|i| i + mechanism.offset(joint)));
        }
        if !window.track.drives.is_empty() {
            let sensor = mechanism.offset(mechanism.joints.len());
            active.extend(mechanism.active_sensor().into_iter().map(|i| i + sensor));
        }
        active
    }

    /// The model of one window.
    pub fn window<'a>(&'a self, window: &'a BatchWindow, noise_scale: f64) -> WindowModel<'a> {
        window.model(&self.mechanism, noise_scale)
    }

    /// Fits all windows from `x`, with κ by window to start from; `rounds` times κ is chosen anew.
    pub fn fit(
        &self,
        windows: &[&BatchWindow],
        x: &[f64],
        scales: &[f64],
        (steps, rounds): (usize, usize),
    ) -> Result<BatchFit, Failure> {
        let by_window: Vec<Vec<usize>> = windows.iter().map(|w| self.active(w)).collect();
        let mut active: Vec<usize> = by_window.iter().flatten().copied().collect();
        active.sort_unstable();
        active.dedup();
        if active.is_empty() || windows.is_empty() {
            return Err(Failure::NoInformation);
        }
        let places = by_window
            .iter()
            .map(|own| own.iter().filter_map(|i| active.binary_search(i).ok()).collect::<Vec<usize>>())
            .collect();
        let prior = self.prior.marginal(&active)?;
        let mut scales = scales.to_vec();
        let mut x = x.to_vec();
        let mut spent = 0;
        let mut problem = Problem {
            hypothesis: self,
            windows,
            by_window,
            places,
            active,
            x,
            scales,
            latest: Vec::new(),
            kept: Vec::new(),
        };
        for round in 0..=rounds {
            let start = DVector::from_iterator(problem.active.len(), problem.active.iter().map(|&i| problem.x[i]));
            let settings = SolverSettings { steps, keeps_last_linearization: true, ..SolverSettings::default() };
            let solution = solve(&mut problem, &prior, &start, &settings)?;
            spent += solution.steps;
            problem.set(&solution.point);
            x = problem.x.clone();
            scales = problem.scales.clone();
            if round < rounds {
                let chosen = problem.choose_scales()?;
                if chosen != scales {
                    problem.scales = chosen;
                    continue;
                }
            }
            let half_determinants: f64 = problem.latest.iter().map(|i| i.half_log_determinant).sum();
            let scale_costs: f64 = scales.iter().map(|s| scale_cost(*s)).sum();
            let hessian = &solution.linearization.curvature + &prior.precision;
            let covariance = hessian.cholesky().ok_or(Failure::Singular)?.inverse();
            let batched = problem.latest.iter().enumerate().map(|(w, innovations)| {
                let own = &problem.by_window[w];
                BatchedWindow {
                    noise_scale: scales[w],
                    log_likelihood: log_density(innovations, scales[w]),
                    observations: innovations.whitened.len(),
                    active: own.clone(),
                    reduction: reduction(&innovations.whitened, windows[w].moving.len()),
                }
            });
            return Ok(BatchFit {
                windows: batched.collect(),
                x,
                active: problem.active.clone(),
                covariance,
                log_evidence: solution.log_evidence - half_determinants - scale_costs,
                steps: spent,
            });
        }
        Err(Failure::Diverged)
    }
}

struct Problem<'a> {
    hypothesis: &'a Hypothesis,
    windows: &'a [&'a BatchWindow],
    by_window: Vec<Vec<usize>>,
    /// Places of each window's entries among the fitted ones.
    places: Vec<Vec<usize>>,
    active: Vec<usize>,
    x: Vec<f64>,
    scales: Vec<f64>,
    latest: Vec<Innovations>,
    kept: Vec<Innovations>,
}

impl Problem<'_> {
    fn set(&mut self, x: &DVector<f64>) {
        for (&at, value) in self.active.iter().zip(x.iter()) {
            self.x[at] = *value;
        }
    }

    /// κ of the greatest likelihood by window; far off it may have several tops.
    fn choose_scales(&self) -> Result<Vec<f64>, Failure> {
        let choose = |w: usize| {
            let density = |scale: f64| {
                // What was fitted last was fitted with this one.
                if let Some(latest) = self.latest.get(w).filter(|_| scale == self.scales[w]) {
                    return Ok(log_density(latest, scale));
                }
                let model = self.hypothesis.window(self.windows[w], scale);
                Ok::<_, Failure>(log_density(&model.linearize(&self.x, &[])?, scale))
            };
            let densities = NOISE_SCALES.into_iter().filter_map(|scale| Some((scale, density(scale).ok()?)));
            let best = densities.max_by(|a, b| a.1.total_cmp(&b.1).then(b.0.total_cmp(&a.0)));
            best.map(|(scale, _)| scale).ok_or(Failure::Diverged)
        };
        (0..self.windows.len()).into_par_iter().map(choose).collect()
    }
}

impl LeastSquares for Problem<'_> {
    fn linearize(&mut self, x: &DVector<f64>) -> Result<Linearization, Failure> {
        self.set(x);
        let one =
            |w: usize| self.hypothesis.window(self.windows[w], self.scales[w]).linearize(&self.x, &self.by_window[w]);
        // Collected in the order of the windows, so that threads do not show in the sum.
        let all: Vec<Innovations> = (0..self.windows.len()).into_par_iter().map(one).collect::<Result<_, _>>()?;
        let n = self.active.len();
        let mut sum = Linearization { cost: 0.0, gradient: DVector::zeros(n), curvature: DMatrix::zeros(n, n) };
        for (innovations, places) in all.iter().zip(&self.places) {
            let (curvature, gradient) = normal_equations(innovations, places.len());
            sum.cost += innovations.cost();
            for (i, &row) in places.iter().enumerate() {
                sum.gradient[row] += gradient[i];
                for (j, &column) in places.iter().enumerate() {
                    sum.curvature[(row, column)] += curvature[(i, j)];
                }
            }
        }
        self.latest = all;
        Ok(sum)
    }

    fn cost(&mut self, x: &DVector<f64>) -> Result<f64, Failure> {
        self.set(x);
        let one = |w: usize| {
            let gains: &[Gain] = &self.latest[w].gains;
            let residuals = self.hypothesis.window(self.windows[w], self.scales[w]).residuals(&self.x, gains)?;
            Ok(0.5 * residuals.iter().map(|e| e * e).sum::<f64>())
        };
        let all: Vec<f64> = (0..self.windows.len()).into_par_iter().map(one).collect::<Result<_, Failure>>()?;
        Ok(all.iter().sum())
    }

    fn cost_of_weights(&self) -> Option<f64> {
        Some(self.latest.iter().map(|innovations| innovations.half_log_determinant).sum())
    }

    fn keep(&mut self) {
        self.kept.clone_from(&self.latest);
    }

    fn restore(&mut self) {
        std::mem::swap(&mut self.latest, &mut self.kept);
    }
}
