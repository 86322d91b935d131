//! The learner's windows and physics as hypotheses see them, and how one of them is taken over.

use std::cmp::Reverse;

use nalgebra::DMatrix;

use super::batch::{BatchWindow, Hypothesis};
use super::layout::{AddedEffect, JointModel, JointScales, LIMIT_DEVIATION, LOWER, Mechanism, SENSOR_SIZE, UPPER};
use super::learner::{
    Block, DynamicsInput, DynamicsLearner, Site, Warm, WindowMemory, added_effect, extended, given_kinematics,
    kinematics_of, standard_sensor, travel_of,
};
use super::residual::WindowResidual;
use super::track::{JointTrack, joint_track};
use crate::inference::{Failure, Gaussian};
use crate::math::median;
use crate::mechanism::effects::EffectKind;
use crate::model::{KinematicFit, KinematicJoint};
use crate::types::Label;

/// A stop of which more than this share of the first spread is left is told of by no window. It is near one as a
/// window that runs into a stop places it only as well as it knows where the tool holds, to centimetres.
const UNTOLD: f64 = 0.97;

impl DynamicsLearner {
    /// The windows in which joints move, in joint space; of those that move the same joint, or the
    /// same joints, `most`, the last ones of every stream; costly ones only if asked for.
    pub fn batch(
        &self,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        most: (usize, usize),
        costly: bool,
    ) -> Vec<BatchWindow> {
        // How many windows of the same joints follow in the same stream, and the window.
        let mut by_age: Vec<(usize, BatchWindow)> = Vec::new();
        for index in (0..input.windows.len().min(self.windows.len())).rev() {
            let Some(window) = self.batch_window(index, fit, input) else { continue };
            if !costly && window.is_costly(input) {
                continue;
            }
            let follows = |(_, w): &&(usize, BatchWindow)| w.moving == window.moving && w.stream == window.stream;
            by_age.push((by_age.iter().filter(follows).count(), window));
        }
        by_age.sort_by_key(|(age, window)| (*age, Reverse(window.index)));
        let mut batch: Vec<BatchWindow> = Vec::new();
        for (_, window) in by_age {
            let most = if window.moving.len() > 1 { most.1 } else { most.0 };
            if batch.iter().filter(|w| w.moving == window.moving).count() < most {
                batch.push(window);
            }
        }
        batch.sort_by_key(|window| window.index);
        batch
    }

    /// A window that is not learned in joint space, the last of `fit` and of `input`; `None` where nothing
    /// moves in it.
    pub fn unlearned_window(&self, fit: &KinematicFit, input: &DynamicsInput<'_>) -> Option<BatchWindow> {
        let last = input.windows.len().checked_sub(1)?;
        self.with_unlearned(last, input).batch_window(last, fit, input)
    }

    /// The same with the last window of `input` kept and not learned.
    fn with_unlearned(&self, last: usize, input: &DynamicsInput<'_>) -> Self {
        let mut learner = self.clone();
        learner.windows.truncate(last);
        learner.windows.resize_with(last, WindowMemory::default);
        learner.keep_window(input.contacts);
        learner
    }

    /// What the numbers learned so far leave of the last window of `input`, which is not learned yet, and which
    /// joints move in it: at least so many, seen by clouds, and none for the first time. Positions are simulated
    /// over `horizon_s`.
    pub fn foretold(
        &self,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        least_moving: usize,
        horizon_s: f64,
    ) -> Option<(Vec<usize>, WindowResidual)> {
        let last = input.windows.len().checked_sub(1)?;
        if !input.windows[last].direct.is_empty() {
            return None;
        }
        let mut learner = self.with_unlearned(last, input);
        let (moving, _) = learner.moving(last, fit, input);
        if moving.len() < least_moving {
            return None;
        }
        learner.follow(fit, input).ok()?;
        let learned = |w: &usize| learner.windows[*w].learned;
        let mut known: Vec<usize> = (0..last).filter(learned).flat_map(|w| learner.moving(w, fit, input).0).collect();
        let reached = |joint: &KinematicJoint| learner.joints.get(&joint.child).is_some_and(|m| m.reached.is_some());
        known.extend((0..fit.joints.len()).filter(|&k| reached(&fit.joints[k])));
        if !moving.iter().all(|joint| known.contains(joint)) {
            return None;
        }
        let window = learner.batch_window(last, fit, input)?;
        let (mean, _) = given_kinematics(&learner.belief.product(None), &learner.blocks()).ok()?.moments().ok()?;
        let noise_scale = median((0..last).filter_map(|w| learner.noise_scale(w)).collect()).unwrap_or(1.0);
        let model = window.model(&learner.mechanism, noise_scale);
        let residual = model.residual(mean.as_slice(), horizon_s, 0.0).ok()?;
        Some((window.moving, residual))
    }

    /// κ of a window as it was last learned.
    pub fn noise_scale(&self, window: usize) -> Option<f64> {
        self.windows.get(window)?.noise_scale
    }

    fn batch_window(&self, index: usize, fit: &KinematicFit, input: &DynamicsInput<'_>) -> Option<BatchWindow> {
        let (moving, frozen) = self.moving(index, fit, input);
        if moving.is_empty() {
            return None;
        }
        let kinematics = kinematics_of(fit);
        let mut track = joint_track(&self.source(index, &moving, fit, input), &kinematics)?;
        drop_spikes(&mut track);
        let involved = self.involved(fit, &moving);
        (track.observations.len() >= 3).then_some(BatchWindow {
            index,
            stream: input.windows[index].stream,
            axes: kinematics.axes,
            frozen,
            moving,
            involved,
            track,
        })
    }

    /// The end stops that are believed: by joint, lower or upper.
    pub fn stops(&self) -> Vec<(usize, bool)> {
        let of = |(joint, model): (usize, &JointModel)| {
            let sides = [false, true].into_iter().zip(model.stops).filter(|(_, there)| *there);
            sides.map(|(upper, _)| (joint, upper)).collect::<Vec<_>>()
        };
        self.mechanism.joints.iter().enumerate().flat_map(of).collect()
    }

    /// The joints with what was declared of them and nothing else: without end stops, which motion has to show.
    pub fn declared_mechanism(&self) -> Mechanism {
        let mut mechanism = self.mechanism.clone();
        mechanism.sensor.bias = false;
        mechanism.sensor.delay = false;
        for model in &mut mechanism.joints {
            model.stops = [false; 2];
            model.friction = self.declared.friction;
            model.effects.truncate(self.declared.effects.len());
            model.tables.clear();
        }
        mechanism
    }

    /// Typical force and rate of a joint, and the farthest that it went.
    pub fn joint_scales(&self, joint: usize, fit: &KinematicFit) -> Option<JointScales> {
        let scales = self.joints.get(&fit.joints.get(joint)?.child)?.scales?;
        let (low, high) = self.range_of(joint, fit);
        Some(JointScales { travel: travel_of(&[low, high]), ..scales })
    }

    /// The least and the greatest position of a joint, a few frames aside: where a tool has let go
    /// too late, they are off.
    pub fn range_of(&self, joint: usize, fit: &KinematicFit) -> (f64, f64) {
        let mut all: Vec<f64> = fit.positions.iter().flat_map(|window| window[joint].iter().copied()).collect();
        all.sort_by(f64::total_cmp);
        let aside = (all.len() / 100).min(4);
        match (all.get(aside), all.len().checked_sub(1 + aside).and_then(|i| all.get(i))) {
            (Some(low), Some(high)) if low <= high => (*low, *high),
            _ => (0.0, 0.0),
        }
    }

    /// An effect as it would be on a joint.
    pub fn effect_on(&self, joint: usize, kind: EffectKind, fit: &KinematicFit) -> Option<AddedEffect> {
        Some(added_effect(kind, &self.joint_scales(joint, fit)?))
    }

    /// A mechanism with the prior of its numbers; the sensor's by what it read at rest, if known.
    pub fn hypothesis(&self, mechanism: Mechanism, sensor_prior: Option<&Gaussian>) -> Result<Hypothesis, Failure> {
        let size = mechanism.size();
        let mut prior = Gaussian::flat(size);
        for (k, model) in mechanism.joints.iter().enumerate() {
            let base = self.belief.prior(&Block::Dynamics(model.joint.child)).ok_or(Failure::NoInformation)?;
            let offset = mechanism.offset(k);
            let places: Vec<usize> = (offset..offset + model.size()).collect();
            prior.multiply_at(&extended(&base.gaussian, model)?, &places);
        }
        let sensor = sensor_prior.cloned().map_or_else(standard_sensor, Ok)?;
        prior.multiply_at(&sensor, &(size - SENSOR_SIZE..size).collect::<Vec<usize>>());
        Ok(Hypothesis { mechanism, prior })
    }

    /// The declared numbers of each joint as they are believed now, and the sensor's.
    pub fn numbers(&self) -> Result<(Vec<Vec<f64>>, Vec<f64>), Failure> {
        let (mean, _) = self.belief.product(None).moments(&self.blocks())?;
        let joints = (0..self.mechanism.joints.len()).map(|k| {
            let (offset, model) = (self.mechanism.offset(k), &self.mechanism.joints[k]);
            let declared = model.effect_offset(self.declared.effects.len().min(model.effects.len()));
            mean.rows(offset, declared).iter().copied().collect()
        });
        Ok((joints.collect(), mean.rows(mean.len() - SENSOR_SIZE, SENSOR_SIZE).iter().copied().collect()))
    }

    /// Takes a fitted hypothesis over: its effects are in the model from now on, and the sites of
    /// the windows are made about `x`. κ by window.
    pub fn adopt(
        &mut self,
        hypothesis: &Hypothesis,
        x: &[f64],
        noise_scales: &[(usize, f64)],
        sensor_prior: Option<&Gaussian>,
        (fit, input): (&KinematicFit, &DynamicsInput<'_>),
    ) -> Result<(), Failure> {
        // Windows gone by keep what they said, as long as numbers mean the same.
        let same_sensor = (self.sensor.bias, self.sensor.delay)
            == (hypothesis.mechanism.sensor.bias, hypothesis.mechanism.sensor.delay);
        self.sensor = hypothesis.mechanism.sensor;
        self.sensor_prior = sensor_prior.cloned();
        let changed = |model: &JointModel| {
            self.joints.get(&model.joint.child).is_none_or(|memory| {
                !same_sensor
                    || memory.friction != model.friction
                    || memory.effects != model.effects
                    || memory.tables != model.tables
            })
        };
        let labels: Vec<Label> =
            hypothesis.mechanism.joints.iter().filter(|m| changed(m)).map(|m| m.joint.child).collect();
        for (k, model) in hypothesis.mechanism.joints.iter().enumerate() {
            if let Some(memory) = self.joints.get_mut(&model.joint.child) {
                memory.friction = model.friction;
                memory.effects.clone_from(&model.effects);
                memory.tables.clone_from(&model.tables);
                for (side, place) in [LOWER, UPPER].into_iter().enumerate() {
                    let place = hypothesis.mechanism.offset(k) + place;
                    let expected = hypothesis.prior.information[place] / hypothesis.prior.precision[(place, place)];
                    memory.set_stop(side, model.stops[side].then_some(expected));
                }
            }
        }
        for label in labels {
            self.forget_sites(label);
        }
        self.rebuild(fit)?;
        for window in 0..self.windows.len() {
            let (moving, frozen) = self.moving(window, fit, input);
            if moving.is_empty() {
                self.windows[window].learned = false;
                continue;
            }
            let known = noise_scales.iter().find(|(index, _)| *index == window).map(|(_, scale)| *scale);
            // The site of a batch's window is its linearization there; others start from it.
            let steps = if known.is_some() { 1 } else { 4 };
            let noise_scale = Some(known.or(self.windows[window].noise_scale).unwrap_or(1.0));
            let warm = Warm { x: x.iter().copied().map(Some).collect(), noise_scale };
            match self.fit_window(window, fit, input, &moving, &frozen, (steps, Some(&warm))) {
                Ok((factor, fitted, _)) => {
                    self.belief.replace(Site::Window(window), factor);
                    let memory = &mut self.windows[window];
                    memory.learned = true;
                    memory.noise_scale = Some(fitted.noise_scale);
                    memory.made_with(fit);
                }
                Err(_) => self.windows[window].learned = false,
            }
        }
        self.drop_untold_stops(fit)
    }

    /// A stop that no window says anything of any more was believed for what the model lacked then.
    fn drop_untold_stops(&mut self, fit: &KinematicFit) -> Result<(), Failure> {
        let (_, covariance) = self.belief.product(None).moments(&self.blocks())?;
        let mut dropped = false;
        for (k, model) in self.mechanism.joints.iter().enumerate() {
            let Some(memory) = self.joints.get_mut(&model.joint.child) else { continue };
            for (side, place) in [LOWER, UPPER].into_iter().enumerate().filter(|(side, _)| model.stops[*side]) {
                let place = self.mechanism.offset(k) + place;
                if covariance[(place, place)].sqrt() > UNTOLD * LIMIT_DEVIATION {
                    tracing::debug!(label = %model.joint.child, side, "nothing tells of an end stop any more");
                    memory.set_stop(side, None);
                    dropped = true;
                }
            }
        }
        if dropped { self.rebuild(fit) } else { Ok(()) }
    }

    /// Covariance of some numbers of the model as it is believed now, kinematic errors included.
    pub fn moments_of(&self, places: &[usize]) -> Result<(Vec<f64>, DMatrix<f64>), Failure> {
        let (mean, covariance) = self.belief.product(None).moments(&self.blocks())?;
        Ok((
            places.iter().map(|&i| mean[i]).collect(),
            DMatrix::from_fn(places.len(), places.len(), |i, j| covariance[(places[i], places[j])]),
        ))
    }

    /// The model as it is now.
    pub fn mechanism(&self) -> &Mechanism {
        &self.mechanism
    }
}

/// Observations farther than this many usual ones, and this far, from the median of those around
/// them are not of the part \[m or rad\]: a tool that let go before its contact was seen to end.
const SPIKE: (f64, f64) = (15.0, 0.004);

/// Leaves out observations that stand alone.
fn drop_spikes(track: &mut JointTrack) {
    let count = track.positions.len();
    let joints = track.positions.first().map_or(0, |q| q.len());
    let mut spikes = vec![false; count];
    for joint in 0..joints {
        let path: Vec<f64> = track.positions.iter().map(|q| q[joint]).collect();
        let distance = |k: usize| {
            let first = k.saturating_sub(2).min(count.saturating_sub(5));
            let around = path[first..(first + 5).min(count)].to_vec();
            median(around).map_or(0.0, |middle| (path[k] - middle).abs())
        };
        let distances: Vec<f64> = (0..count).map(distance).collect();
        let usual = median(distances.clone()).unwrap_or(0.0);
        for (spike, distance) in spikes.iter_mut().zip(distances) {
            *spike |= distance > (SPIKE.0 * usual).max(SPIKE.1);
        }
    }
    let mut keep = spikes.iter().map(|spike| !spike);
    track.observations.retain(|_| keep.next().unwrap_or(true));
    let mut keep = spikes.iter().map(|spike| !spike);
    track.positions.retain(|_| keep.next().unwrap_or(true));
}
