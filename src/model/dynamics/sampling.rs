//! The dynamics of the likeliest structure as a log density of all windows, sampled instead of
//! approximated.
//!
//! log p(θ, η) = rest + Σ_w ℓ_w(θ + S_w (η − η̂)) / r_w. ℓ_w is the innovations' log likelihood of a
//! kept window with its gains computed anew at every θ; κ_w, the reduction r_w for what is not white,
//! and S_w, how the window would change with the kinematic errors η, are those at the Gaussian
//! posterior's mean. The rest is Gaussian: the priors of θ and η, windows gone by, and windows in
//! which nothing moved. The gradient is for fixed gains: samples are of the density all the same.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::innovations::normal_equations;
use super::layout::{DAMPING, FRICTION, INERTIA, LOWER, MASS, UPPER};
use super::learner::{Block, DynamicsInput, DynamicsLearner, Site, given_kinematics};
use super::posterior::{DynamicsPosterior, MODEL_FLOOR};
use super::site::WindowFit;
use crate::inference::{Failure, Gaussian, LogDensity, Samples, SamplingSettings, effective_size, sample, split_r_hat};
use crate::mechanism::JointType;
use crate::model::KinematicFit;
use crate::types::posterior::Quantity;

/// How the sampling went.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SamplingReport {
    /// Windows whose likelihood was evaluated as it is.
    pub windows: usize,
    /// Evaluations of the density, over all chains.
    pub evaluations: usize,
    /// Trajectories lost.
    pub divergences: usize,
    /// The largest split R̂ of the joints' numbers.
    pub worst_r_hat: f64,
    /// The least effective sample size of them.
    pub least_effective_size: f64,
}

/// A window whose likelihood is evaluated.
struct ExactWindow<'a> {
    window: WindowFit<'a>,
    noise_scale: f64,
    reduction: f64,
    /// By how much the cost grows with each number for the readings' noise in its derivative, at the mean.
    attenuation: DVector<f64>,
    /// Where its dynamic numbers are among all, and the kinematic ones.
    places: Vec<usize>,
    kinematic: Vec<usize>,
    sensitivity: DMatrix<f64>,
}

impl ExactWindow<'_> {
    /// ℓ / r, and its derivatives by the numbers at `places` and at `kinematic`.
    fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, DVector<f64>, DVector<f64>), Failure> {
        let errors = DVector::from_fn(self.kinematic.len(), |i, _| x[self.kinematic[i]]);
        let shift = &self.sensitivity * errors;
        let mut numbers = self.window.base.clone();
        for (i, (&at, &place)) in self.window.active.iter().zip(&self.places).enumerate() {
            numbers[at] = x[place] + shift[i];
        }
        let innovations = self.window.model(self.noise_scale).linearize(&numbers, &self.window.active)?;
        let off = DVector::from_iterator(shift.len(), self.window.active.iter().map(|&at| numbers[at]));
        let cost = innovations.cost() + innovations.half_log_determinant + self.attenuation.dot(&off);
        let value = -cost / self.reduction;
        let gradient = normal_equations(&innovations, self.window.active.len()).1 + &self.attenuation;
        let slope = gradient / -self.reduction;
        let kinematic = self.sensitivity.transpose() * &slope;
        Ok((value, slope, kinematic))
    }
}

struct DynamicsDensity<'a> {
    rest: Gaussian,
    windows: Vec<ExactWindow<'a>>,
}

impl LogDensity for DynamicsDensity<'_> {
    fn dimension(&self) -> usize {
        self.rest.dimension()
    }

    fn evaluate(&self, x: &DVector<f64>) -> Result<(f64, DVector<f64>), Failure> {
        // Collected in order, so that threads do not show in the sum.
        let parts: Vec<_> = self.windows.par_iter().map(|w| w.evaluate(x)).collect();
        let mut value = self.rest.quadratic(x);
        let mut slope = &self.rest.information - &self.rest.precision * x;
        for (window, part) in self.windows.iter().zip(parts) {
            let (more, own, kinematic) = part?;
            value += more;
            window.places.iter().zip(own.iter()).for_each(|(&place, s)| slope[place] += s);
            window.kinematic.iter().zip(kinematic.iter()).for_each(|(&place, s)| slope[place] += s);
        }
        Ok((value, slope))
    }
}

impl DynamicsLearner {
    /// The posterior as [`Self::posterior`] has it, its numbers from samples.
    ///
    /// # Errors
    /// If nothing was learned, or the chains find no start.
    pub fn sampled_posterior(
        &self,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        settings: &SamplingSettings,
    ) -> Result<(DynamicsPosterior, SamplingReport), Failure> {
        let mut posterior = self.posterior()?;
        let joint = self.belief.product(None);
        let blocks = self.blocks();
        let conditional = given_kinematics(&joint, &blocks)?;
        let moving: Vec<_> =
            (0..input.windows.len().min(self.windows.len())).map(|w| self.moving(w, fit, input)).collect();
        let mut density = DynamicsDensity { rest: joint.gaussian.clone(), windows: Vec::new() };
        for (index, (moving, frozen)) in moving.iter().enumerate() {
            let memory = &self.windows[index];
            let (Some(noise_scale), Some(site)) = (memory.noise_scale, self.belief.site(&Site::Window(index))) else {
                continue;
            };
            if moving.is_empty() || !memory.learned {
                continue;
            }
            let window = self.prepare(index, fit, input, (moving, frozen), &conditional)?;
            let prior = conditional.marginal(&window.active)?;
            // One step: the model at the mean, for what is taken as fixed.
            let fitted = window.fit(&prior, &[prior.moments()?.0], Some(noise_scale), 1)?;
            let fitted = window.without_noise(fitted, &prior)?;
            let touched = input.use_tool || !memory.contacts.is_empty();
            let deviations = self.deviations(fit, &self.involved(fit, moving), touched);
            let whole = window.sensitivity(&fitted, &deviations);
            let dynamic: Vec<usize> = blocks.iter().flat_map(|b| joint.places(b)).collect();
            let errors: Vec<usize> = fit
                .joints
                .iter()
                .map(|j| Block::Axis(j.child))
                .chain([Block::ToolOffset])
                .flat_map(|b| joint.places(&b))
                .collect();
            let columns: Vec<usize> = (0..errors.len()).filter(|&c| whole.column(c).amax() > 0.0).collect();
            let places: Vec<usize> = site.blocks.iter().flat_map(|(block, _)| joint.places(block)).collect();
            let inverse = Gaussian { precision: -&site.gaussian.precision, information: -&site.gaussian.information };
            density.rest.multiply_at(&inverse, &places);
            density.windows.push(ExactWindow {
                places: window.active.iter().map(|&i| dynamic[i]).collect(),
                kinematic: columns.iter().map(|&c| errors[c]).collect(),
                sensitivity: whole.select_columns(&columns),
                noise_scale,
                attenuation: fitted.attenuation,
                reduction: fitted.reduction,
                window,
            });
        }
        let samples = sample(&density, &joint.gaussian, settings)?;
        let dynamic: Vec<usize> = blocks.iter().flat_map(|b| joint.places(b)).collect();
        self.take_samples(&mut posterior, &samples, &dynamic)?;
        let mut report = SamplingReport {
            windows: density.windows.len(),
            evaluations: samples.evaluations,
            divergences: samples.divergences,
            worst_r_hat: 0.0,
            least_effective_size: f64::INFINITY,
        };
        for window in &density.windows {
            for &place in &window.places {
                let chains = samples.values(|x| x[place]);
                report.worst_r_hat = report.worst_r_hat.max(split_r_hat(&chains));
                report.least_effective_size = report.least_effective_size.min(effective_size(&chains));
            }
        }
        Ok((posterior, report))
    }

    /// Puts what the samples say in the place of what the Gaussian says.
    fn take_samples(
        &self,
        posterior: &mut DynamicsPosterior,
        samples: &Samples,
        dynamic: &[usize],
    ) -> Result<(), Failure> {
        let draws: Vec<DVector<f64>> =
            samples.draws().map(|x| DVector::from_fn(dynamic.len(), |i, _| x[dynamic[i]])).collect();
        if draws.len() < 2 {
            return Err(Failure::NoInformation);
        }
        let count = draws.len() as f64;
        posterior.mean = draws.iter().sum::<DVector<f64>>() / count;
        posterior.covariance =
            draws.iter().map(|x| (x - &posterior.mean) * (x - &posterior.mean).transpose()).sum::<DMatrix<f64>>()
                / (count - 1.0);
        let axes: Vec<_> = self.mechanism.joints.iter().map(|m| m.joint.axis).collect();
        let free = vec![None; axes.len()];
        let trees = draws.iter().map(|x| self.mechanism.tree(x.as_slice(), &axes, &free));
        let trees = trees.collect::<Result<Vec<_>, Failure>>()?;
        for (k, model) in self.mechanism.joints.iter().enumerate() {
            let at = self.mechanism.offset(k);
            let logarithms = |entry: usize| draws.iter().map(|x| x[at + entry]).collect::<Vec<f64>>();
            let positions =
                |q: &Quantity, entry: usize| Quantity::from_samples(&q.unit, logarithms(entry), q.informed_by);
            let positive = |q: &Quantity, logarithms: Vec<f64>| {
                Quantity::from_samples(&q.unit, floored(&logarithms), q.informed_by)
            };
            if let Some(joint) = posterior.joints.iter_mut().find(|j| j.label == model.joint.child) {
                joint.damping = positive(&joint.damping, logarithms(DAMPING));
                joint.friction = positive(&joint.friction, logarithms(FRICTION));
                let inertia = trees.iter().map(|tree| tree.joint_inertia(k).max(1e-300).ln()).collect();
                joint.joint_inertia = positive(&joint.joint_inertia, inertia);
                joint.lower_limit = joint.lower_limit.as_ref().map(|q| positions(q, LOWER));
                joint.upper_limit = joint.upper_limit.as_ref().map(|q| positions(q, UPPER));
            }
            if let Some(part) = posterior.parts.iter_mut().find(|p| p.label == model.joint.child) {
                let entry = if model.joint.joint_type == JointType::Revolute { MASS } else { INERTIA };
                part.mass = positive(&part.mass, logarithms(entry));
                part.com_in_world = self.mechanism.center_of_mass(k, posterior.mean.as_slice());
            }
        }
        Ok(())
    }
}

/// exp of the logarithms, spread about their mean as the floor of model error wants it.
fn floored(logarithms: &[f64]) -> Vec<f64> {
    let count = logarithms.len() as f64;
    let mean = logarithms.iter().sum::<f64>() / count;
    let variance = logarithms.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0);
    let widening = (1.0 + MODEL_FLOOR.powi(2) / variance.max(1e-12)).sqrt();
    logarithms.iter().map(|x| (mean + (x - mean) * widening).exp()).collect()
}
