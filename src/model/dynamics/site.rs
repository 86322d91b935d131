//! Fits one window against a cavity and makes its site.
//!
//! The site says what the window says of the dynamic numbers θ at the kinematics η it was learned
//! with, and how that would change if η (axes, tool offset) were off: a factor of θ + S (η − η̂)
//! with S = H⁻¹ Jᵀ J_η (consider parameters; Schmidt 1966). It has no information about η itself,
//! which the kinematic fit took from the same data; errors of η that windows share stay shared.

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::innovations::{Gain, Innovations, WindowModel, normal_equations};
use super::layout::{FRICTION, Mechanism};
use super::track::{JointTrack, TrackKinematics, TrackSource, joint_track};
use crate::inference::{Failure, Gaussian, LeastSquares, Linearization, Solution, SolverSettings, solve};
use crate::math::orthonormal_pair;
use crate::model::{Axis, KinematicJoint};

/// Process noise is at most this many times what the wrench sensor explains.
const NOISE_SCALES: [f64; 6] = [1.0, 3.0, 10.0, 30.0, 100.0, 300.0];
/// A window that needs this much has more than noise in it.
const LACKING: f64 = 10.0;
/// Standard deviation of ln κ: the model is expected to be right within a factor of a few.
const LOG_NOISE_DEVIATION: f64 = 1.5;
/// Weight, in innovations, of the prior that innovations have unit variance.
const VARIANCE_PRIOR: f64 = 10.0;
/// Half a deviation of a kinematic number changes innovations by this much at most, root mean square.
const RUNAWAY: f64 = 30.0;
/// A stuck joint's load is known to this share: friction below the load is unlikelier than that.
const LOAD_DEVIATION: f64 = 0.1;

/// One window, ready to be fitted.
pub struct WindowFit<'a> {
    /// Joints and gravity.
    pub mechanism: &'a Mechanism,
    /// The kinematic fit's view.
    pub source: TrackSource<'a>,
    /// Axes and offset of the kinematic fit.
    pub kinematics: TrackKinematics,
    /// Positions of the joints that rest.
    pub frozen: Vec<Option<f64>>,
    /// The window in joint space.
    pub track: JointTrack,
    /// Entries of the full parameter vector that the window depends on.
    pub active: Vec<usize>,
    /// The full parameter vector to start from.
    pub base: Vec<f64>,
}

/// A fitted window.
#[derive(Clone, Debug)]
pub struct FittedWindow {
    /// The optimum of them.
    pub solution: Solution,
    /// κ.
    pub noise_scale: f64,
    /// Innovations at the optimum.
    pub innovations: Innovations,
    /// By how much the cost there grows with each number for the readings' noise in its derivative.
    pub attenuation: DVector<f64>,
    /// Log density of the window's observations by the cavity (Laplace), up to a constant of the
    /// observations.
    pub log_predictive: f64,
    /// Factor by which the information is reduced for innovations that are larger than their
    /// covariance, or not white.
    pub reduction: f64,
    /// Linearizations spent.
    pub steps: usize,
}

struct Problem<'a> {
    model: WindowModel<'a>,
    active: &'a [usize],
    x: Vec<f64>,
    gains: Vec<Gain>,
    latest: Innovations,
}

impl Problem<'_> {
    fn set(&mut self, x: &DVector<f64>) {
        for (&at, value) in self.active.iter().zip(x.iter()) {
            self.x[at] = *value;
        }
    }
}

impl LeastSquares for Problem<'_> {
    fn linearize(&mut self, x: &DVector<f64>) -> Result<Linearization, Failure> {
        self.set(x);
        let innovations = self.model.linearize(&self.x, self.active)?;
        let (curvature, gradient) = normal_equations(&innovations, self.active.len());
        let cost = innovations.cost();
        self.gains = innovations.gains.clone();
        self.latest = innovations;
        Ok(Linearization { cost, gradient, curvature })
    }

    fn cost(&mut self, x: &DVector<f64>) -> Result<f64, Failure> {
        self.set(x);
        let residuals = self.model.residuals(&self.x, &self.gains)?;
        Ok(0.5 * residuals.iter().map(|e| e * e).sum::<f64>())
    }
}

impl WindowFit<'_> {
    /// The model of the window at a process noise.
    pub fn model(&self, noise_scale: f64) -> WindowModel<'_> {
        WindowModel {
            mechanism: self.mechanism,
            axes: &self.kinematics.axes,
            frozen: &self.frozen,
            moving: self.source.moving,
            track: &self.track,
            noise_scale,
        }
    }

    /// Fits the window from the best of `starts`. κ is chosen anew unless it is given.
    pub fn fit(
        &self,
        prior: &Gaussian,
        starts: &[DVector<f64>],
        noise_scale: Option<f64>,
        steps: usize,
    ) -> Result<FittedWindow, Failure> {
        let mut spent = 0;
        let first_scale = noise_scale.unwrap_or(NOISE_SCALES[1]);
        let mut point = match starts {
            [start] => start.clone(),
            _ => {
                let settings = SolverSettings { steps: (steps / 3).max(3), ..SolverSettings::default() };
                let glance = |start| {
                    let mut problem = self.problem(first_scale);
                    let solution = solve(&mut problem, prior, start, &settings).ok()?;
                    Some((solution.log_evidence - problem.latest.half_log_determinant, solution))
                };
                // In their order, so threads do not show in the result.
                let glances: Vec<Option<(f64, Solution)>> = starts.par_iter().map(glance).collect();
                let seen = glances.into_iter().flatten().inspect(|(_, solution)| spent += solution.steps);
                let best = seen.reduce(|best, other| if other.0 > best.0 { other } else { best });
                best.ok_or(Failure::Diverged)?.1.point
            }
        };
        let mut scale = first_scale;
        let rounds = if noise_scale.is_some() { 1 } else { 2 };
        for round in 0..rounds {
            let mut problem = self.problem(scale);
            let settings = SolverSettings { steps, ..SolverSettings::default() };
            let solution = solve(&mut problem, prior, &point, &settings)?;
            spent += solution.steps;
            if round + 1 < rounds {
                let (best, tried) = self.best_noise_scale(&solution.point, scale, &problem.latest)?;
                spent += tried;
                if best != scale {
                    scale = best;
                    point = solution.point;
                    continue;
                }
            }
            let innovations = problem.latest;
            return Ok(FittedWindow {
                reduction: reduction(&innovations.whitened, self.source.moving.len()),
                noise_scale: scale,
                log_predictive: solution.log_evidence - innovations.half_log_determinant - scale_cost(scale),
                innovations,
                attenuation: DVector::zeros(self.active.len()),
                solution,
                steps: spent,
            });
        }
        Err(Failure::Diverged)
    }

    /// A fit whose linearization is without what the readings' noise pretends. The optimum stays where it is: on the
    /// way from a start that is far off, what noise pretends is far off, too, as it is where the model lacks something.
    pub fn without_noise(&self, mut fitted: FittedWindow, prior: &Gaussian) -> Result<FittedWindow, Failure> {
        if fitted.noise_scale >= LACKING {
            return Ok(fitted);
        }
        let mut x = self.base.clone();
        for (&at, value) in self.active.iter().zip(fitted.solution.point.iter()) {
            x[at] = *value;
        }
        let (_, noise) = self.model(fitted.noise_scale).linearize_with_noise(&x, &self.active)?;
        fitted.attenuation = noise.take_out(&mut fitted.solution.linearization, prior)?;
        Ok(fitted)
    }

    /// κ of the greatest likelihood at given parameters, by ascent over the grid; how many
    /// linearizations that took. `latest` are the innovations there with κ = `from`.
    fn best_noise_scale(&self, point: &DVector<f64>, from: f64, latest: &Innovations) -> Result<(f64, usize), Failure> {
        let mut x = self.base.clone();
        for (&at, value) in self.active.iter().zip(point.iter()) {
            x[at] = *value;
        }
        let mut tried = 0;
        let mut density = |scale: f64| {
            if scale == from {
                return Ok(log_density(latest, scale));
            }
            tried += 1;
            Ok::<_, Failure>(log_density(&self.model(scale).linearize(&x, &[])?, scale))
        };
        let mut at = NOISE_SCALES.iter().position(|s| *s >= from).unwrap_or(0);
        let mut best = density(NOISE_SCALES[at])?;
        for direction in [1, -1_isize] {
            while let Some(next) = at.checked_add_signed(direction).filter(|i| *i < NOISE_SCALES.len()) {
                let trial = density(NOISE_SCALES[next])?;
                if trial <= best {
                    break;
                }
                best = trial;
                at = next;
            }
        }
        Ok((NOISE_SCALES[at], tried / 3))
    }

    fn problem(&self, scale: f64) -> Problem<'_> {
        Problem {
            model: self.model(scale),
            active: &self.active,
            x: self.base.clone(),
            gains: Vec::new(),
            latest: Innovations::default(),
        }
    }

    /// S: by how much the optimum would move per unit of each kinematic number; columns in the order
    /// of [`kinematic_directions`], in units of `deviations`.
    pub fn sensitivity(&self, fitted: &FittedWindow, deviations: &[f64]) -> DMatrix<f64> {
        let p = self.active.len();
        let mut x = self.base.clone();
        for (&at, value) in self.active.iter().zip(fitted.solution.point.iter()) {
            x[at] = *value;
        }
        let jacobian = DMatrix::from_row_slice(fitted.innovations.whitened.len(), p, &fitted.innovations.slopes);
        let mut hessian = jacobian.transpose() * &jacobian;
        let ridge = 1e-9 * hessian.diagonal().max() + 1e-12;
        for i in 0..p {
            hessian[(i, i)] += ridge;
        }
        let cholesky = hessian.cholesky();
        let columns = deviations.len();
        let mut result = DMatrix::zeros(p, columns);
        let Some(cholesky) = cholesky else {
            return result;
        };
        for (column, deviation) in deviations.iter().enumerate().filter(|(_, d)| **d > 0.0) {
            let slope = settled_slope(*deviation, |step| self.change(&x, fitted, column, step));
            let Some(slope) = slope else { continue };
            result.set_column(column, &cholesky.solve(&(jacobian.transpose() * slope)));
        }
        result
    }

    /// By how much the innovations change at the same numbers and gains where one kinematic number is moved.
    fn change(&self, x: &[f64], fitted: &FittedWindow, column: usize, step: f64) -> Option<DVector<f64>> {
        let kinematics = self.moved(column, step);
        let track = joint_track(&self.source, &kinematics)?;
        let model = WindowModel { axes: &kinematics.axes, track: &track, ..self.model(fitted.noise_scale) };
        let residuals = model.residuals(x, &fitted.innovations.gains).ok()?;
        let before = &fitted.innovations.whitened;
        let change = || residuals.iter().zip(before).map(|(after, before)| after - before);
        (residuals.len() == before.len()).then(|| DVector::from_iterator(before.len(), change()))
    }

    /// The kinematics with one number moved: axis parameters joint by joint, then the tool's offset.
    fn moved(&self, column: usize, step: f64) -> TrackKinematics {
        let mut moved = self.kinematics.clone();
        let mut at = column;
        for (k, joint) in self.source.joints.iter().enumerate() {
            let count = joint.axis_parameters();
            if at < count {
                moved.axes[k] = retracted(&KinematicJoint { axis: moved.axes[k], ..*joint }, at, step);
                return moved;
            }
            at -= count;
        }
        moved.tool_offset[at] += step;
        moved
    }
}

/// The slope of a change by the difference over half a deviation. A difference that runs away (with the gains
/// held, on the other side of a stop) is none: then it is taken over less, and `None` where that runs away too.
fn settled_slope(deviation: f64, change: impl Fn(f64) -> Option<DVector<f64>>) -> Option<DVector<f64>> {
    [0.5, 0.05, 0.005].into_iter().find_map(|share| {
        let step = share * deviation;
        let change = change(step)?;
        (change.norm() < RUNAWAY * (change.len() as f64).sqrt()).then(|| change / step)
    })
}

/// An axis moved along one of its four directions; see the kinematic fit.
fn retracted(joint: &KinematicJoint, which: usize, step: f64) -> Axis {
    let Axis { direction, point } = joint.axis;
    let (first, second) = orthonormal_pair(&direction);
    let along = if which.is_multiple_of(2) { first } else { second };
    if which < 2 {
        Axis { direction: (direction + (along * step).cross(&direction)).normalize(), point }
    } else {
        Axis { direction, point: point + along * step }
    }
}

/// Log density of innovations and of κ, up to constants.
pub fn log_density(innovations: &Innovations, scale: f64) -> f64 {
    -innovations.cost() - innovations.half_log_determinant - scale_cost(scale)
}

/// −ln prior of κ.
pub fn scale_cost(scale: f64) -> f64 {
    0.5 * (scale.ln() / LOG_NOISE_DEVIATION).powi(2)
}

/// Variance of the innovations, at least one, times their integrated autocorrelation, at least one.
pub fn reduction(whitened: &[f64], rows: usize) -> f64 {
    let n = whitened.len() as f64;
    let squares: f64 = whitened.iter().map(|e| e * e).sum();
    let variance = ((squares + VARIANCE_PRIOR) / (n + VARIANCE_PRIOR)).max(1.0);
    let correlation: f64 = (1..=6)
        .map(|lag| {
            whitened.iter().zip(whitened.iter().skip(lag * rows)).map(|(a, b)| a * b).sum::<f64>() / squares.max(1e-12)
        })
        .sum();
    variance * (1.0 + 2.0 * correlation).clamp(1.0, 20.0)
}

/// Entries of one joint's numbers among `active`, that only inertia needs.
pub fn inertial_entries(active: &[usize]) -> Vec<usize> {
    use super::layout::{CENTER, INERTIA, MASS};
    active.iter().copied().filter(|i| [INERTIA, MASS, CENTER, CENTER + 1].contains(i)).collect()
}

/// ln F with a greater deviation than this is not known yet.
const UNKNOWN_FRICTION: f64 = 0.7;

/// −ln P(F > load) with the load known to [`LOAD_DEVIATION`], logistic for the normal of that slope.
fn load_cost(log_friction: f64, log_load: f64) -> f64 {
    let z = 1.702 * (log_load - log_friction) / LOAD_DEVIATION;
    if z > 30.0 { z } else { z.exp().ln_1p() }
}

/// What it says of ln F ~ N(mean, deviation²) that friction held a load: the Gaussian factor of
/// matching moments, of a block of `size` numbers.
pub fn load_factor(log_load: f64, mean: f64, deviation: f64, size: usize) -> Gaussian {
    let (mut all, mut total, mut first, mut second) = (0.0, 0.0, 0.0, 0.0);
    for i in 0..=400 {
        let x = mean + deviation * 5.0 * (f64::from(i) / 200.0 - 1.0);
        let before = (-0.5 * ((x - mean) / deviation).powi(2)).exp();
        let weight = before * (-load_cost(x, log_load)).exp();
        all += before;
        total += weight;
        first += weight * x;
        second += weight * x * x;
    }
    let mut gaussian = Gaussian::flat(size);
    // A load that friction, where it is known, could not hold was held by something else: a stop.
    let unknown = deviation > UNKNOWN_FRICTION;
    if total > if unknown { 1e-12 } else { 0.02 } * all {
        let matched = first / total;
        // Never nearly flat: a factor with a slope but no width would run away once the other
        // factors change.
        let variance = (second / total - matched * matched).min(0.75 * deviation * deviation);
        gaussian.precision[(FRICTION, FRICTION)] = 1.0 / variance - 1.0 / (deviation * deviation);
        gaussian.information[FRICTION] = matched / variance - mean / (deviation * deviation);
    }
    gaussian
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_difference_that_runs_away_is_no_slope() {
        let beyond = |limit: f64| {
            move |step: f64| Some(DVector::from_element(4, if step < limit { 3.0 * step } else { f64::INFINITY }))
        };
        let slope = |limit: f64| settled_slope(0.2, beyond(limit)).map(|slope| slope[0]);
        assert!(slope(1.0).is_some_and(|slope| (slope - 3.0).abs() < 1e-12));
        assert!(slope(0.05).is_some_and(|slope| (slope - 3.0).abs() < 1e-12));
        assert_eq!(slope(0.0), None);
    }
}
