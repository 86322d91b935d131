//! What a window leaves unexplained, in the units of forces and positions.
//!
//! The motion is smoothed (Rauch, Tung, Striebel, AIAA Journal 3, 1965) with process noise so wide
//! that it hardly depends on the model; what the model's simulation lacks from one smoothed state to
//! the next is the residual force, by what a small force on each joint would have changed.

use nalgebra::{DMatrix, DVector};

use super::innovations::{Plant, WindowModel};
use crate::inference::Failure;
use crate::mechanism::effects::{AttachedEffect, EffectKind};

/// κ of the smoothing at least, and in units of the model's own.
const SMOOTHING: (f64, f64) = (300.0, 10.0);

/// Forces that tell how a joint answers, in units of its inertia \[m/s² or rad/s²\], and the share of a
/// free joint's answer below which it is held.
const PUSH: f64 = 1e-4;
const HELD: f64 = 1e-3;

/// Residuals of one window, by moving joint.
#[derive(Clone, Debug)]
pub struct WindowResidual {
    /// Middle of each span, its length \[s\], and the mean residual force over it \[N or N·m\].
    pub forces: Vec<(f64, f64, DVector<f64>)>,
    /// Position and rate at the middle of each span.
    pub states: Vec<(DVector<f64>, DVector<f64>)>,
    /// Squares of what positions are off after open simulation, with their count \[m² or rad²\].
    pub squares: Vec<(f64, usize)>,
    /// Whitened innovations with the model's own κ.
    pub whitened: Vec<Vec<f64>>,
}

/// A residual force over a span.
struct Piece {
    middle_s: f64,
    length_s: f64,
    force: DVector<f64>,
    /// Positions and rates.
    state: (DVector<f64>, DVector<f64>),
}

impl Piece {
    /// The mean of this one and the next.
    fn join(&mut self, next: &Self) {
        let share = next.length_s / (self.length_s + next.length_s);
        self.middle_s += share * (next.middle_s - self.middle_s);
        self.length_s += next.length_s;
        self.force += (&next.force - &self.force) * share;
        self.state.0 += (&next.state.0 - &self.state.0) * share;
        self.state.1 += (&next.state.1 - &self.state.1) * share;
    }
}

impl WindowModel<'_> {
    /// The residuals at `x`; positions are simulated over `horizon_s` from smoothed states, which follow each
    /// other in half of it, and forces are means over `span_s`, or from one observation to the next.
    pub fn residual(&self, x: &[f64], horizon_s: f64, span_s: f64) -> Result<WindowResidual, Failure> {
        let n = self.moving.len();
        let own = self.linearize(x, &[])?;
        let whitened = (0..n).map(|i| own.whitened.iter().skip(i).step_by(n).copied().collect()).collect();
        let smoothing = WindowModel { noise_scale: SMOOTHING.0.max(SMOOTHING.1 * self.noise_scale), ..self.clone() };
        let steps = smoothing.filtered(x)?;
        let observations = &self.track.observations;
        let mut smoothed: Vec<DVector<f64>> = steps.iter().map(|s| s.updated.clone()).collect();
        for k in (0..steps.len() - 1).rev() {
            let next = &steps[k + 1];
            let inverse = next.predicted_covariance.clone().cholesky().ok_or(Failure::Singular)?;
            let gain = &steps[k].updated_covariance * next.transition.transpose() * inverse.inverse();
            smoothed[k] = &steps[k].updated + gain * (&smoothed[k + 1] - &next.predicted);
        }
        let plant = self.plant(x)?;
        let mut pieces: Vec<Piece> = Vec::new();
        for k in 0..steps.len() - 1 {
            let span = [observations[k].time_s, observations[k + 1].time_s];
            let length = span[1] - span[0];
            if length < 1e-4 {
                continue;
            }
            let lacks = &smoothed[k + 1]
                - &steps[k + 1].predicted
                - &steps[k + 1].transition * (&smoothed[k] - &steps[k].updated);
            let middle = (&smoothed[k] + &smoothed[k + 1]) * 0.5;
            let mass = self.moving_mass(&plant, middle.rows(0, n).as_slice());
            let inertial = &mass * lacks.rows(n, n) / length;
            let force = self.force_behind(&plant, &smoothed[k], span, &lacks, &mass).unwrap_or(inertial);
            let state = (middle.rows(0, n).into_owned(), middle.rows(n, n).into_owned());
            let piece = Piece { middle_s: 0.5 * (span[0] + span[1]), length_s: length, force, state };
            match pieces.last_mut().filter(|last| last.length_s + 0.5 * length < span_s) {
                Some(last) => last.join(&piece),
                None => pieces.push(piece),
            }
        }
        let mut squares = vec![(0.0, 0); n];
        let mut first = 0;
        while first + 1 < steps.len() {
            let start_s = observations[first].time_s;
            let mut state = smoothed[first].as_slice()[..2 * n].to_vec();
            let zeros = self.zeros(&smoothed[first]);
            for k in first + 1..steps.len() {
                if observations[k].time_s > start_s + horizon_s {
                    break;
                }
                state = self.advance(&plant, &state, [observations[k - 1].time_s, observations[k].time_s])?;
                for (i, (sum, count)) in squares.iter_mut().enumerate() {
                    let zero = zeros.get(i).copied().unwrap_or(0.0);
                    *sum += (state[i] + zero - self.track.positions[k][i]).powi(2);
                    *count += 1;
                }
            }
            let next = observations.iter().position(|o| o.time_s >= start_s + 0.5 * horizon_s);
            first = next.unwrap_or(steps.len()).max(first + 1);
        }
        if squares.iter().any(|(sum, _)| !sum.is_finite()) {
            return Err(Failure::Diverged);
        }
        let (forces, states) = pieces.into_iter().map(|p| ((p.middle_s, p.length_s, p.force), p.state)).unzip();
        Ok(WindowResidual { forces, states, squares, whitened })
    }

    /// The constant forces on the moving joints that would have changed a span's end by `lacks`, by the
    /// rates; `None` where friction or a stop holds a joint, which says nothing of forces.
    fn force_behind(
        &self,
        plant: &Plant<f64>,
        from: &DVector<f64>,
        span: [f64; 2],
        lacks: &DVector<f64>,
        mass: &DMatrix<f64>,
    ) -> Option<DVector<f64>> {
        let n = self.moving.len();
        let start = &from.as_slice()[..2 * n];
        let end = self.advance(plant, start, span).ok()?;
        let mut responses = DMatrix::zeros(n, n);
        for (column, &joint) in self.moving.iter().enumerate() {
            let mut pushed = plant.clone();
            let force = PUSH * mass[(column, column)];
            pushed.tree.parameters_mut(joint).effects.push(AttachedEffect::new(EffectKind::GravityOffset, &[force]));
            let other = self.advance(&pushed, start, span).ok()?;
            for row in 0..n {
                responses[(row, column)] = (other[n + row] - end[n + row]) / force;
            }
        }
        // A joint that hardly answers is held.
        let free = |i: usize| responses[(i, i)] * mass[(i, i)] > HELD * (span[1] - span[0]);
        if !(0..n).all(free) {
            return None;
        }
        responses.lu().solve(&lacks.rows(n, n).into_owned())
    }

    fn moving_mass(&self, plant: &Plant<f64>, q: &[f64]) -> DMatrix<f64> {
        let n = self.moving.len();
        let mass = plant.tree.mass_matrix(&self.all_positions(q));
        DMatrix::from_fn(n, n, |i, j| mass[(self.moving[i], self.moving[j])])
    }
}
