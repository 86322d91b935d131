//! Likelihood of a window by its innovations: e_k = y_k − H_k q(t_k | y_1 … y_{k−1}; θ).
//!
//! Between two observations the joints are simulated; at an observation the state is corrected with
//! the extended Kalman gain: shooting segments as short as the spacing of observations, whose weak
//! continuity is the process noise. That noise is not a tuning: it is what the wrench sensor's own
//! noise does to the joints, times κ ≥ 1 for what the model misses. The innovations are then white
//! with covariance S, and −½ Σ (eᵀ S⁻¹ e + ln |S|) is the log likelihood (Ljung, "System
//! Identification", 1999, section 7.4; Kristensen, Madsen, Jørgensen, Automatica 40, 2004).
//! Derivatives by forward mode, for fixed gains.

use nalgebra::{DMatrix, DVector};
use num_dual::DualSVec64;

use super::layout::Mechanism;
use super::track::JointTrack;
use crate::inference::Failure;
use crate::math::Real;
use crate::mechanism::{State, WrenchSample, WrenchTrack, rollout};
use crate::model::Axis;

/// Longest step of the simulation \[s\]: half a wrench sample; trajectories of the midpoint step
/// change by less than .1 mm when it is halved.
const STEP_S: f64 = 0.004;
/// The same where several joints move: as long as a wrench sample, for speed.
const CHAIN_STEP_S: f64 = 0.008;
/// Friction varies by this share of itself over `FRICTION_SPAN_S` for reasons outside the model:
/// a floor of the process noise, for the time when no wrench acts.
const FRICTION_SHARE: f64 = 0.02;
const FRICTION_SPAN_S: f64 = 0.02;
/// Standard deviation of the first position \[m or rad\] and rate \[m/s or rad/s\].
const FIRST_POSITION: f64 = 0.02;
const FIRST_RATE: f64 = 0.1;

/// A scalar that carries derivatives along up to `WIDTH` directions.
pub trait Directional: Real {
    /// How many directions.
    const WIDTH: usize;
    /// A value with its derivatives.
    fn with_slopes(value: f64, slopes: impl Fn(usize) -> f64) -> Self;
    /// The derivative along a direction.
    fn slope(&self, direction: usize) -> f64;
}

impl Directional for f64 {
    const WIDTH: usize = 0;
    fn with_slopes(value: f64, _: impl Fn(usize) -> f64) -> Self {
        value
    }
    fn slope(&self, _: usize) -> f64 {
        0.0
    }
}

impl<const N: usize> Directional for DualSVec64<N> {
    const WIDTH: usize = N;
    fn with_slopes(value: f64, slopes: impl Fn(usize) -> f64) -> Self {
        let eps = nalgebra::SVector::<f64, N>::from_fn(|i, _| slopes(i));
        Self::new(value, num_dual::Derivative::some(eps))
    }
    fn slope(&self, direction: usize) -> f64 {
        self.eps.0.as_ref().map_or(0.0, |eps| eps[direction])
    }
}

/// The model of one window.
#[derive(Clone, Debug)]
pub struct WindowModel<'a> {
    /// Joints and gravity.
    pub mechanism: &'a Mechanism,
    /// Axes by joint.
    pub axes: &'a [Axis],
    /// Positions of the joints that rest in the window.
    pub frozen: &'a [Option<f64>],
    /// The others, by index.
    pub moving: &'a [usize],
    /// Observations and wrench.
    pub track: &'a JointTrack,
    /// κ, the process noise in units of what the wrench sensor explains.
    pub noise_scale: f64,
}

/// Gain and whitening of one observation.
#[derive(Clone, Debug)]
pub struct Gain {
    gain: DMatrix<f64>,
    /// L with S = L Lᵀ.
    deviation: DMatrix<f64>,
}

/// Innovations of a window.
#[derive(Clone, Debug, Default)]
pub struct Innovations {
    /// L⁻¹ e, one observation after the other.
    pub whitened: Vec<f64>,
    /// Their derivatives, row by row.
    pub slopes: Vec<f64>,
    /// Σ ½ ln |S|.
    pub half_log_determinant: f64,
    /// For [`WindowModel::residuals`].
    pub gains: Vec<Gain>,
}

impl Innovations {
    /// ½ Σ e² / S.
    pub fn cost(&self) -> f64 {
        0.5 * self.whitened.iter().map(|e| e * e).sum::<f64>()
    }
}

impl WindowModel<'_> {
    /// Innovations, their derivatives by the `active` entries of `x`, and the gains, at `x`.
    pub fn linearize(&self, x: &[f64], active: &[usize]) -> Result<Innovations, Failure> {
        match active.len() + 2 * self.moving.len() {
            0..=2 => self.pass::<DualSVec64<2>>(x, active, None),
            3..=4 => self.pass::<DualSVec64<4>>(x, active, None),
            5 => self.pass::<DualSVec64<5>>(x, active, None),
            6..=7 => self.pass::<DualSVec64<7>>(x, active, None),
            8..=10 => self.pass::<DualSVec64<10>>(x, active, None),
            11..=16 => self.pass::<DualSVec64<16>>(x, active, None),
            17..=24 => self.pass::<DualSVec64<24>>(x, active, None),
            25..=32 => self.pass::<DualSVec64<32>>(x, active, None),
            _ => self.pass::<DualSVec64<48>>(x, active, None),
        }
    }

    /// Whitened innovations at `x` with gains from elsewhere.
    pub fn residuals(&self, x: &[f64], gains: &[Gain]) -> Result<Vec<f64>, Failure> {
        self.pass::<f64>(x, &[], Some(gains)).map(|i| i.whitened)
    }

    fn pass<T: Directional>(&self, x: &[f64], active: &[usize], gains: Option<&[Gain]>) -> Result<Innovations, Failure> {
        let n = self.moving.len();
        let p = active.len();
        if self.track.observations.len() < 3 {
            return Err(Failure::NoInformation);
        }
        if gains.is_none() && T::WIDTH < p + 2 * n {
            return Err(Failure::NoInformation);
        }
        let mut parameters: Vec<T> = x.iter().map(|&v| T::constant(v)).collect();
        for (i, &at) in active.iter().enumerate() {
            parameters[at] = T::with_slopes(x[at], |k| if k == i { 1.0 } else { 0.0 });
        }
        let tree = self.mechanism.tree(&parameters, self.axes, self.frozen)?;
        let noise = gains.is_none().then(|| ProcessNoise::new(self, x)).transpose()?;
        let mut state = State::<T>::at_rest(self.mechanism.joints.len());
        let (positions, rates) = self.first_state();
        for (i, &joint) in self.moving.iter().enumerate() {
            state.positions[joint] = T::constant(positions[i]);
            state.rates[joint] = T::constant(rates[i]);
        }
        let mut covariance = DMatrix::from_fn(2 * n, 2 * n, |i, j| match (i == j, i < n) {
            (false, _) => 0.0,
            (true, true) => FIRST_POSITION.powi(2),
            (true, false) => FIRST_RATE.powi(2),
        });
        let mut result = Innovations::default();
        let observations = &self.track.observations;
        for (k, observation) in observations.iter().enumerate() {
            if k > 0 {
                let span = [observations[k - 1].time_s, observation.time_s];
                if gains.is_none() {
                    for (i, &joint) in self.moving.iter().enumerate() {
                        seed(&mut state.positions[joint], p, p + i);
                        seed(&mut state.rates[joint], p, p + n + i);
                    }
                }
                state = self.advance(&tree, &state, span)?;
                if let Some(noise) = &noise {
                    let of = |i: usize| {
                        let joint = self.moving[i % n];
                        if i < n { state.positions[joint] } else { state.rates[joint] }
                    };
                    let transition = DMatrix::from_fn(2 * n, 2 * n, |i, j| of(i).slope(p + j));
                    covariance = &transition * covariance * transition.transpose();
                    let q: Vec<f64> = state.positions.iter().map(|q| q.value()).collect();
                    covariance += noise.over(span, &q, self)?;
                }
            }
            let innovation: Vec<T> = (0..n)
                .map(|row| {
                    self.moving.iter().enumerate().fold(T::constant(observation.value[row]), |sum, (i, &joint)| {
                        sum - state.positions[joint] * T::constant(observation.rows[(row, i)])
                    })
                })
                .collect();
            let fresh;
            let gain = match gains {
                Some(gains) => &gains[k],
                None => {
                    let spread = covariance.columns(0, n) * observation.rows.transpose();
                    let total = &observation.rows * spread.rows(0, n) + DMatrix::identity(n, n);
                    let cholesky = total.cholesky().ok_or(Failure::Diverged)?;
                    let gain = cholesky.solve(&spread.transpose()).transpose();
                    covariance -= &gain * spread.transpose();
                    covariance = (&covariance + covariance.transpose()) * 0.5;
                    fresh = Gain { gain, deviation: cholesky.unpack() };
                    &fresh
                }
            };
            let lower = &gain.deviation;
            let mut whitened: Vec<T> = Vec::with_capacity(n);
            for row in 0..n {
                let sum = (0..row).fold(innovation[row], |sum, j| sum - whitened[j] * T::constant(lower[(row, j)]));
                whitened.push(sum * T::constant(1.0 / lower[(row, row)]));
                result.half_log_determinant += lower[(row, row)].ln();
            }
            for e in &whitened {
                result.whitened.push(e.value());
                result.slopes.extend((0..p).map(|i| e.slope(i)));
            }
            for (i, &joint) in self.moving.iter().enumerate() {
                for (row, e) in innovation.iter().enumerate() {
                    state.positions[joint] += *e * T::constant(gain.gain[(i, row)]);
                    state.rates[joint] += *e * T::constant(gain.gain[(n + i, row)]);
                }
            }
            if gains.is_none() {
                result.gains.push(gain.clone());
            }
        }
        if result.whitened.iter().chain(&result.slopes).all(|e| e.is_finite()) { Ok(result) } else { Err(Failure::Diverged) }
    }

    fn advance<T: Real>(&self, tree: &crate::mechanism::Tree<T>, state: &State<T>, span: [f64; 2]) -> Result<State<T>, Failure> {
        let samples = within(&self.track.samples, span);
        let track = self.track.touched.map(|body| WrenchTrack::new(body, samples));
        let tracks = track.as_slice();
        let start = State::new(state.positions.clone(), state.rates.clone());
        let run = rollout(tree, &start, tracks, &span, if self.moving.len() > 1 { CHAIN_STEP_S } else { STEP_S }).map_err(|_| Failure::Diverged)?;
        Ok(State::new(run.positions(1).to_vec(), run.rates(1).to_vec()))
    }

    /// Positions at the first observation, and rates if the window opens in motion.
    fn first_state(&self) -> (Vec<f64>, Vec<f64>) {
        let n = self.moving.len();
        let first = &self.track.positions[0];
        let ahead = 3.min(self.track.positions.len() - 1);
        let span_s = self.track.observations[ahead].time_s - self.track.observations[0].time_s;
        let rates = (0..n).map(|i| {
            let step = self.track.positions[ahead][i] - first[i];
            // Positions of a joint at rest are equal, as the kinematic fit ties them.
            if step.abs() > 0.02 && span_s > 0.0 { step / span_s } else { 0.0 }
        });
        (first.iter().copied().collect(), rates.collect())
    }
}

/// Leaves the derivatives along the first `keep` directions, and marks one more.
fn seed<T: Directional>(x: &mut T, keep: usize, mark: usize) {
    let old = *x;
    *x = T::with_slopes(old.value(), |i| {
        if i < keep {
            old.slope(i)
        } else if i == mark {
            1.0
        } else {
            0.0
        }
    });
}

/// The samples needed between two times.
fn within(samples: &[WrenchSample], span: [f64; 2]) -> &[WrenchSample] {
    let from = samples.partition_point(|s| s.stamp_s <= span[0]).saturating_sub(1);
    let to = (samples.partition_point(|s| s.stamp_s < span[1]) + 1).min(samples.len());
    &samples[from.min(to)..to]
}

/// White generalized force: what the wrench sensor's noise and the unevenness of friction do.
struct ProcessNoise {
    tree: crate::mechanism::Tree<f64>,
    /// Density of the friction's unevenness per moving joint \[N² s or (N·m)² s\].
    floor: Vec<f64>,
}

impl ProcessNoise {
    fn new(model: &WindowModel<'_>, x: &[f64]) -> Result<Self, Failure> {
        let tree = model.mechanism.tree(x, model.axes, model.frozen)?;
        let floor = model
            .moving
            .iter()
            .map(|&joint| {
                let friction = x[model.mechanism.offset(joint) + super::layout::FRICTION].exp();
                (FRICTION_SHARE * friction).powi(2) * FRICTION_SPAN_S
            })
            .collect();
        Ok(Self { tree, floor })
    }

    /// Covariance that (q, q̇) gather over a span.
    fn over(&self, span: [f64; 2], q: &[f64], model: &WindowModel<'_>) -> Result<DMatrix<f64>, Failure> {
        let n = model.moving.len();
        let track = model.track;
        let mut density = DMatrix::from_fn(n, n, |i, j| if i == j { self.floor[i] } else { 0.0 });
        let sample = within(&track.samples, span).first();
        if let (Some(sample), Some(touched)) = (sample, track.touched) {
            let screws = self.tree.screws(q);
            let mut levers = vec![nalgebra::Vector3::zeros(); n];
            let mut at = Some(touched);
            while let Some(joint) = at {
                if let Some(i) = model.moving.iter().position(|&m| m == joint) {
                    levers[i] = screws[joint].angular.cross(&sample.point_in_world) + screws[joint].linear;
                }
                at = model.mechanism.joints[joint].joint.parent;
            }
            let variance = track.force_deviation.powi(2) * track.sample_span_s;
            for i in 0..n {
                for j in 0..n {
                    density[(i, j)] += variance * levers[i].dot(&levers[j]);
                }
            }
        }
        let mass = self.tree.mass_matrix(q);
        let mass = DMatrix::from_fn(n, n, |i, j| mass[(model.moving[i], model.moving[j])]);
        let inverse = mass.cholesky().ok_or(Failure::Diverged)?.inverse();
        let density = &inverse * density * inverse * model.noise_scale;
        let h = span[1] - span[0];
        let share = [[h * h * h / 3.0, h * h / 2.0], [h * h / 2.0, h]];
        Ok(DMatrix::from_fn(2 * n, 2 * n, |i, j| share[i / n][j / n] * density[(i % n, j % n)]))
    }
}

/// Jᵀ J and Jᵀ r of innovations with `width` derivatives each.
pub fn normal_equations(innovations: &Innovations, width: usize) -> (DMatrix<f64>, DVector<f64>) {
    let jacobian = DMatrix::from_row_slice(innovations.whitened.len(), width, &innovations.slopes);
    let residual = DVector::from_column_slice(&innovations.whitened);
    (jacobian.transpose() * &jacobian, jacobian.transpose() * residual)
}
