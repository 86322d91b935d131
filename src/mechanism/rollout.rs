//! Simulation from an initial state over a grid of times.

use thiserror::Error;

use super::forcing::{WrenchPoint, WrenchTrack};
use super::inertia::Spatial;
use super::single::{SingleJoint, SingleState};
use super::step::{BodyWrench, State, Step, step};
use super::tree::Tree;
use super::workspace::Workspace;
use crate::math::Real;

/// States of all joints at the requested times.
#[derive(Clone, Debug, PartialEq)]
pub struct Trajectory<T: Real> {
    body_count: usize,
    positions: Vec<T>,
    rates: Vec<T>,
}

impl<T: Real> Trajectory<T> {
    /// How many times it has.
    pub fn len(&self) -> usize {
        self.positions.len() / self.body_count.max(1)
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.positions.is_empty()
    }

    /// q at the i-th time, one per body \[m or rad\].
    pub fn positions(&self, i: usize) -> &[T] {
        &self.positions[i * self.body_count..(i + 1) * self.body_count]
    }

    /// q̇ at the i-th time, one per body \[m/s or rad/s\].
    pub fn rates(&self, i: usize) -> &[T] {
        &self.rates[i * self.body_count..(i + 1) * self.body_count]
    }

    fn push(&mut self, positions: &[T], rates: &[T]) {
        self.positions.extend_from_slice(positions);
        self.rates.extend_from_slice(rates);
    }
}

/// Why a simulation gave no trajectory.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum RolloutError {
    /// A position or rate that is not finite: parameters beyond what a step can carry.
    #[error("simulation diverged before {time_s} s")]
    Diverged {
        /// The first requested time without a finite state \[s\].
        time_s: f64,
    },
}

/// Simulates `tree` from `initial` at `times_s[0]` through all of `times_s`, ascending, in equal
/// steps of at most `step_max_s` between two of them.
pub fn rollout<T: Real>(
    tree: &Tree<T>,
    initial: &State<T>,
    tracks: &[WrenchTrack<'_, T>],
    times_s: &[f64],
    step_max_s: f64,
) -> Result<Trajectory<T>, RolloutError> {
    rollout_in(&mut Workspace::new(tree), tree, initial, tracks, times_s, step_max_s)
}

/// [`rollout`] in a workspace of this tree's size, for many short ones.
pub fn rollout_in<T: Real>(
    workspace: &mut Workspace<T>,
    tree: &Tree<T>,
    initial: &State<T>,
    tracks: &[WrenchTrack<'_, T>],
    times_s: &[f64],
    step_max_s: f64,
) -> Result<Trajectory<T>, RolloutError> {
    let carried = tracks.iter().any(|track| track.point != WrenchPoint::Recorded);
    if let Some(joint) = SingleJoint::of(tree)
        && !carried
    {
        return rollout_single(tree, &joint, initial, tracks, times_s, step_max_s);
    }
    let mut state = initial.clone();
    let mut cursors = vec![0; tracks.len()];
    let mut wrenches: Vec<BodyWrench<T>> = Vec::with_capacity(tracks.len());
    let mut trajectory = empty_trajectory(tree.body_count(), times_s.len());
    for (i, &end_s) in times_s.iter().enumerate() {
        for Step { middle_s, length_s } in steps(times_s, i, step_max_s) {
            wrenches.clear();
            for (track, cursor) in tracks.iter().zip(&mut cursors) {
                wrenches.push(track.wrench(middle_s, cursor));
            }
            step(tree, &mut state, &wrenches, Step { middle_s, length_s }, workspace);
        }
        if !state.positions.iter().chain(&state.rates).all(|x| x.value().is_finite()) {
            return Err(RolloutError::Diverged { time_s: end_s });
        }
        trajectory.push(&state.positions, &state.rates);
    }
    Ok(trajectory)
}

fn rollout_single<T: Real>(
    tree: &Tree<T>,
    joint: &SingleJoint<T>,
    initial: &State<T>,
    tracks: &[WrenchTrack<'_, T>],
    times_s: &[f64],
    step_max_s: f64,
) -> Result<Trajectory<T>, RolloutError> {
    let mut drives = drives(tree, joint, tracks);
    let mut positions = initial.positions.clone();
    let mut rates = initial.rates.clone();
    let mut state = SingleState::new(positions[joint.body], rates[joint.body]);
    let mut trajectory = empty_trajectory(tree.body_count(), times_s.len());
    for i in 0..times_s.len() {
        let parameters = &tree.bodies()[joint.body].parameters;
        for step in steps(times_s, i, step_max_s) {
            let applied = drives.iter_mut().fold(T::zero(), |sum, drive| sum + drive.force(step.middle_s));
            joint.step(parameters, &mut state, applied, step);
        }
        check(&state, times_s[i])?;
        positions[joint.body] = state.position;
        rates[joint.body] = state.rate;
        trajectory.push(&positions, &rates);
    }
    Ok(trajectory)
}

/// Least and greatest position \[m or rad\] and rate \[m/s or rad/s\] at which a joint's forces were taken.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Reach {
    /// q.
    pub position: [f64; 2],
    /// q̇.
    pub rate: [f64; 2],
}

impl Default for Reach {
    fn default() -> Self {
        let nowhere = [f64::INFINITY, f64::NEG_INFINITY];
        Self { position: nowhere, rate: nowhere }
    }
}

impl Reach {
    fn include(&mut self, (position, rate): (f64, f64)) {
        for (range, value) in [(&mut self.position, position), (&mut self.rate, rate)] {
            *range = [range[0].min(value), range[1].max(value)];
        }
    }
}

/// As [`rollout`] over one span, for `joint`, the only one of `tree` that moves, from its position and rate
/// to those at the end; `tracks` are applied where they were recorded. `reach` takes in where it went.
pub fn advance_single<T: Real>(
    (tree, joint): (&Tree<T>, &SingleJoint<T>),
    (position, rate): (T, T),
    tracks: &[WrenchTrack<'_, T>],
    span_s: [f64; 2],
    step_max_s: f64,
    mut reach: Option<&mut Reach>,
) -> Result<(T, T), RolloutError> {
    let mut drives = drives(tree, joint, tracks);
    let parameters = &tree.bodies()[joint.body].parameters;
    let mut state = SingleState::new(position, rate);
    for step in steps(&span_s, 1, step_max_s) {
        if let Some(reach) = &mut reach {
            reach.include(state.middle(step.length_s));
        }
        let applied = drives.iter_mut().fold(T::zero(), |sum, drive| sum + drive.force(step.middle_s));
        joint.step(parameters, &mut state, applied, step);
    }
    check(&state, span_s[1])?;
    Ok((state.position, state.rate))
}

/// What drives a single joint.
fn drives<'t, 'a, T: Real>(
    tree: &Tree<T>,
    joint: &SingleJoint<T>,
    tracks: &'t [WrenchTrack<'a, T>],
) -> Vec<Drive<'t, 'a, T>> {
    let acting = tracks.iter().filter(|track| tree.carriers[track.body].is_some());
    acting.map(|track| Drive::new(joint.screw, track)).collect()
}

fn check<T: Real>(state: &SingleState<T>, time_s: f64) -> Result<(), RolloutError> {
    let finite = state.position.value().is_finite() && state.rate.value().is_finite();
    if finite { Ok(()) } else { Err(RolloutError::Diverged { time_s }) }
}

fn empty_trajectory<T: Real>(body_count: usize, times: usize) -> Trajectory<T> {
    Trajectory {
        body_count,
        positions: Vec::with_capacity(body_count * times),
        rates: Vec::with_capacity(body_count * times),
    }
}

/// The steps that lead to the i-th time.
pub(super) fn steps(times_s: &[f64], i: usize, step_max_s: f64) -> impl Iterator<Item = Step> {
    let start_s = times_s[i.saturating_sub(1)];
    let span_s = times_s[i] - start_s;
    // A span that is a whole number of steps but for rounding takes that number.
    let count = (span_s / step_max_s - 1e-9).ceil().max(0.0) as usize;
    let length_s = span_s / count.max(1) as f64;
    (0..count).map(move |k| Step { middle_s: start_s + (k as f64 + 0.5) * length_s, length_s })
}

/// Sᵀ w over a track, for a joint whose S never changes: one linear function between two samples.
struct Drive<'t, 'a, T: Real> {
    screw: Spatial<T>,
    track: &'t WrenchTrack<'a, T>,
    cursor: usize,
    /// Index of the sample that the next two belong to.
    first: Option<usize>,
    at_first: T,
    at_next: T,
}

impl<'t, 'a, T: Real> Drive<'t, 'a, T> {
    fn new(screw: Spatial<T>, track: &'t WrenchTrack<'a, T>) -> Self {
        Self { screw, track, cursor: 0, first: None, at_first: T::zero(), at_next: T::zero() }
    }

    #[inline]
    fn force(&mut self, time_s: f64) -> T {
        let place = self.track.locate(time_s, &mut self.cursor);
        if self.first != Some(place.first) {
            let follows = place.first > 0 && self.first == Some(place.first - 1);
            self.at_first = if follows { self.at_next } else { self.at_sample(place.first) };
            self.first = Some(place.first);
            self.at_next = self.at_sample(place.first + 1);
        }
        match place.weight {
            Some(weight) => self.at_first + (self.at_next - self.at_first) * weight,
            None => self.at_first,
        }
    }

    fn at_sample(&self, i: usize) -> T {
        let reading = self.track.samples.get(i).map(|sample| self.track.reading(sample));
        reading.map_or_else(T::zero, |wrench| self.screw.dot(&wrench))
    }
}
