//! Which frames of a joint are one position: friction holds what is not pushed.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector};

use super::carriers;
use super::equations::WindowSystem;
use super::problem::Problem;

/// A window is tested for motion in this many blocks of frames.
const REST_BLOCKS: usize = 6;
/// Twice the nats by which a fit must promise to be better without a rest: far beyond χ² with `REST_BLOCKS`
/// degrees of freedom, as frames are not independent.
const REST_SCORE: f64 = 40.0;

impl Problem<'_> {
    /// Frees joints that were taken to rest through a window in which what they carry moves, where the data
    /// object: by what one step of the whole fit promises with the joint in blocks of frames. Whether any was.
    ///
    /// What moves pulls at what carries it. Taken to rest, a link that gave way by half a degree turned the
    /// direction of what slid on it by two, and nothing told: the fit was sure of it.
    pub(super) fn free_movers(&mut self) -> bool {
        let (matrix, gradient, _) = self.reduced(&[], 0.0);
        let shares: Option<Vec<Share>> = self.linearize().iter().map(Share::of).collect();
        let Some(shares) = shares else { return false };
        let all = shares.iter().fold(Share { matrix, gradient, gain: 0.0 }, |sum, share| sum.plus(share, 1.0));
        let before = all.promise();
        let mut freed = Vec::new();
        for (w, share) in shares.iter().enumerate() {
            let rests = |j: usize| self.slots[w][j].windows(2).all(|pair| pair[0] == pair[1]);
            let frames = self.windows[w].times_s.len();
            let moved = (0..self.joints.len()).filter(|&j| !rests(j));
            let loaded: BTreeSet<usize> = moved.flat_map(|j| carriers(&self.joints, j)).filter(|&j| rests(j)).collect();
            for j in loaded {
                let mut trial = self.clone();
                let block = frames.div_ceil(REST_BLOCKS);
                trial.slots[w][j] = (0..frames).map(|k| self.slot_counts[w] + k / block).collect();
                trial.slot_counts[w] += frames.div_ceil(block);
                let system = trial.linearize_window(w).without_stays();
                let promise = Share::of(&system).map(|own| all.clone().plus(share, -1.0).plus(&own, 1.0).promise());
                if promise.is_some_and(|promise| 2.0 * (promise - before) > REST_SCORE) {
                    freed.push((w, j, frames));
                }
            }
        }
        for &(w, j, frames) in &freed {
            let next = self.slot_counts[w];
            self.slots[w][j] = (next..next + frames).collect();
            self.slot_counts[w] += frames;
        }
        !freed.is_empty()
    }

    /// Makes frames in which a joint rests one unknown: friction holds what is not pushed.
    pub(super) fn tie_rests(&mut self) {
        let systems: Vec<WindowSystem> = (0..self.windows.len()).map(|w| self.linearize_window(w)).collect();
        for (w, window) in self.windows.iter().enumerate() {
            let deviations = systems[w].local.clone().cholesky().map(|c| c.inverse().diagonal());
            let mut next_slot = 0;
            for j in 0..self.joints.len() {
                let sigma =
                    |frame: usize| deviations.as_ref().map_or(0.0, |d| d[self.slots[w][j][frame]].max(0.0).sqrt());
                let runs = rest_runs(&self.positions[w][j], sigma, self.settings.rest_deviations);
                for run in runs {
                    let mean = run.clone().map(|k| self.positions[w][j][k]).sum::<f64>() / run.len() as f64;
                    for k in run {
                        self.positions[w][j][k] = mean;
                        self.slots[w][j][k] = next_slot;
                    }
                    next_slot += 1;
                }
            }
            debug_assert!(next_slot <= self.joints.len() * window.times_s.len());
            self.slot_counts[w] = next_slot;
        }
    }
}

/// What a window adds to the system in the unknowns that all windows share.
#[derive(Clone)]
struct Share {
    matrix: DMatrix<f64>,
    gradient: DVector<f64>,
    /// By how much a step in the window's own unknowns lowers the cost.
    gain: f64,
}

impl Share {
    /// `None` where the window's own unknowns are not determined.
    fn of(system: &WindowSystem) -> Option<Self> {
        let local = system.local.clone().cholesky()?;
        let (coupling, gradient) = (local.solve(&system.coupling), local.solve(&system.local_gradient));
        Some(Self {
            matrix: &system.global - system.coupling.transpose() * coupling,
            gradient: &system.global_gradient - system.coupling.transpose() * &gradient,
            gain: 0.5 * system.local_gradient.dot(&gradient),
        })
    }

    fn plus(mut self, other: &Self, times: f64) -> Self {
        self.matrix += &other.matrix * times;
        self.gradient += &other.gradient * times;
        self.gain += other.gain * times;
        self
    }

    /// By how much a step in all unknowns lowers the cost.
    fn promise(&self) -> f64 {
        let step = self.matrix.clone().cholesky().map(|matrix| matrix.solve(&self.gradient));
        self.gain + step.map_or(0.0, |step| 0.5 * step.dot(&self.gradient))
    }
}

/// Splits frames into runs within which a position stays inside its own uncertainty.
fn rest_runs(positions: &[f64], sigma: impl Fn(usize) -> f64, deviations: f64) -> Vec<std::ops::Range<usize>> {
    let mut runs = Vec::new();
    let mut start = 0;
    let mut sum = 0.0;
    for (k, &position) in positions.iter().enumerate() {
        let count = (k - start) as f64;
        if k > start && (position - sum / count).abs() > deviations * sigma(k) {
            runs.push(start..k);
            start = k;
            sum = 0.0;
        }
        sum += position;
    }
    if start < positions.len() {
        runs.push(start..positions.len());
    }
    runs
}
