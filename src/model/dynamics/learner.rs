//! The online learner of dynamics: sites of all windows, learned when they come, and revisited.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{DMatrix, DVector, Matrix2, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::layout::{
    AddedEffect, AddedTable, CenterFrame, INERTIA, JointModel, JointScales, LIMIT_DEVIATION, LOWER, Mechanism,
    SENSOR_SIZE, SIZE, SensorModel, TILT, TiltFrame, UPPER, joint_models,
};
use super::site::{FittedWindow, WindowFit, inertial_entries, load_factor};
use super::track::{Drive, TrackKinematics, TrackSource, driven_labels, joint_track, touched_label};
use crate::geometry::HullProperties;
use crate::inference::{Belief, Factor, Failure, Gaussian, Joint};
use crate::math::orthonormal_pair;
use crate::mechanism::effects::{EffectKind, Scales};
use crate::mechanism::{JointType, WrenchTrack};
use crate::model::{Axis, Contact, KinematicFit, KinematicJoint, WindowObservations};
use crate::types::{Label, Stamp};

/// A joint whose position stays within this all through a window rests \[m or rad\].
const REST: f64 = 0.006;
const REST_ANGLE: f64 = 0.015;
/// Linearizations for one window at most, and for all revisits after a window.
const STEPS: usize = 14;
const REVISIT_STEPS: usize = 12;
/// Linearizations for one window with another end stop than it was just fitted with, at most.
const STOP_STEPS: usize = 6;
/// A window whose noise is as much times what the wrench sensor explains may be fitted wrongly, and then ln
/// friction is tried with these shifts, by so many linearizations until it shows promise.
const DOUBTED: f64 = 100.0;
const RELEASES: [f64; 2] = [-0.4, -1.0];
const RELEASE_STEPS: usize = 5;
/// A joint that stops at an end of its range stays there as long \[s\].
const SHORTEST_HALT: f64 = 0.1;
/// Effects in time are expected within a record of this length \[s\].
const TYPICAL_RECORD_S: f64 = 4.0;
/// A joint that goes farther beyond an end than this has no stop there \[m or rad\].
const PASSED: f64 = 5.0 * LIMIT_DEVIATION;
/// A stop is believed if it raises the log evidence by this.
const STOP_EVIDENCE: f64 = 4.0;

/// Standard deviation of the logarithm of an inertia that was declared.
const DECLARED_INERTIA: f64 = 0.02;
/// A joint whose axis has turned by more than 10° since it was first learned is another: what windows said of it
/// goes by where that axis was.
const SAME_DIRECTION: f64 = 0.985;
/// Directions are not known better than this \[rad\].
const LEAST_TILT: f64 = 1e-4;

/// What a block of numbers is about.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Block {
    /// Damping, friction, inertia, stops of a part's joint.
    Dynamics(Label),
    /// The joint's axis, as an error of the kinematic fit.
    Axis(Label),
    /// The tool's offset, as an error of the kinematic fit.
    ToolOffset,
    /// Bias and delay of the wrench sensor.
    Sensor,
}

/// What a site stands for.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Site {
    /// A window that is kept, by its index: it can be learned again.
    Window(usize),
    /// All windows gone by in which the tool held this part, as one Gaussian.
    Past(Option<Label>),
}

/// What learning one window gave.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct WindowInference {
    /// Linearizations spent, on this window and on older ones.
    pub steps: usize,
    /// Laplace evidence of the window by what was known before, over nats: the ELBO of a Gaussian
    /// posterior at its optimum.
    pub elbo: f64,
    /// Log density of the window's whitened observations by the posterior before it was learned.
    pub log_predictive_density: f64,
    /// How many numbers were observed.
    pub observations: usize,
    /// Process noise in units of what the wrench sensor explains.
    pub noise_scale: f64,
    /// Why the window taught nothing, if so.
    pub failure: Option<Failure>,
}

/// What stays of a joint between windows.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct JointMemory {
    signature: (JointType, Option<Label>, Vec<Label>),
    /// A fit that finds the axis the other way round counts positions the other way.
    direction: Vector3<f64>,
    pub(super) scales: Option<JointScales>,
    pub(super) stops: [bool; 2],
    /// Where the stops are expected, once they are believed.
    pub(super) stop_positions: [f64; 2],
    center: Option<CenterFrame>,
    tilt: Option<TiltFrame>,
    hull: Option<HullProperties>,
    pub(super) friction: bool,
    pub(super) effects: Vec<AddedEffect>,
    pub(super) tables: Vec<AddedTable>,
    /// Least and greatest position in the windows gone by \[m or rad\].
    pub(super) reached: Option<(f64, f64)>,
}

impl JointMemory {
    /// Where the stop of a side is expected \[m or rad\], `None` where there is none.
    pub(super) fn set_stop(&mut self, side: usize, position: Option<f64>) {
        self.stops[side] = position.is_some();
        self.stop_positions[side] = position.unwrap_or(0.0);
    }
}

/// What stays of a window.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub(super) struct WindowMemory {
    pub(super) contacts: Vec<Contact>,
    pub(super) noise_scale: Option<f64>,
    /// Joints and kinematics that the site was made with.
    axes: BTreeMap<Label, Axis>,
    tool_offset: Vector3<f64>,
    pub(super) learned: bool,
    /// When it was last learned, in windows.
    turn: usize,
}

impl WindowMemory {
    /// The site is carried over to this fit.
    fn moved_to(&mut self, fit: &KinematicFit) {
        for (label, axis) in &mut self.axes {
            if let Some(joint) = fit.joints.iter().find(|joint| joint.child == *label) {
                *axis = joint.axis;
            }
        }
        self.tool_offset = fit.tool_offset;
    }

    /// The site was made with the axes and the offset of this fit.
    pub(super) fn made_with(&mut self, fit: &KinematicFit) {
        self.axes = fit.joints.iter().map(|j| (j.child, j.axis)).collect();
        self.tool_offset = fit.tool_offset;
    }
}

/// Where a fit starts: numbers, where they are known, and κ.
pub(super) struct Warm {
    pub(super) x: Vec<Option<f64>>,
    /// `None`: it is chosen anew.
    pub(super) noise_scale: Option<f64>,
}

/// Learns the dynamics from windows, given the kinematic fit of all of them.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct DynamicsLearner {
    gravity: Vector3<f64>,
    pub(super) belief: Belief<Block, Site>,
    pub(super) joints: BTreeMap<Label, JointMemory>,
    pub(super) windows: Vec<WindowMemory>,
    /// Axes and offset that the sites of windows gone by are about.
    past: BTreeMap<Option<Label>, WindowMemory>,
    pub(super) mechanism: Mechanism,
    pub(super) declared: DeclaredPhysics,
    pub(super) sensor: SensorModel,
    /// Of the sensor's numbers, by what it reads at rest.
    pub(super) sensor_prior: Option<Gaussian>,
}

/// What is in the model of every joint from the start, beside rigid bodies, damping and end stops.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct DeclaredPhysics {
    /// Coulomb friction.
    pub friction: bool,
    /// Effects by name.
    pub effects: Vec<EffectKind>,
    /// Inertia about its joint, or mass on its slide, of parts of which it is known \[kg m² or kg\].
    pub inertia: BTreeMap<Label, f64>,
    /// Whether criticism may add others.
    pub criticism: bool,
}

impl Default for DeclaredPhysics {
    fn default() -> Self {
        Self { friction: true, effects: Vec::new(), inertia: BTreeMap::new(), criticism: true }
    }
}

/// A window as it comes.
pub struct DynamicsInput<'a> {
    /// All windows so far, the new one last.
    pub windows: &'a [&'a WindowObservations],
    /// Contacts of the new window, the tool's position used or not.
    pub contacts: &'a [Contact],
    /// Time zero.
    pub zero: Stamp,
    /// Hulls of the parts at the reference configuration.
    pub parts: &'a BTreeMap<Label, HullProperties>,
    /// Whether the tool's position is an observation.
    pub use_tool: bool,
}

impl DynamicsLearner {
    /// Nothing learned, under `gravity` \[m/s²\].
    pub fn new(gravity: Vector3<f64>) -> Self {
        Self {
            gravity,
            belief: Belief::default(),
            joints: BTreeMap::new(),
            windows: Vec::new(),
            past: BTreeMap::new(),
            mechanism: Mechanism { joints: Vec::new(), gravity, sensor: SensorModel::default() },
            declared: DeclaredPhysics::default(),
            sensor: SensorModel::default(),
            sensor_prior: None,
        }
    }

    /// What is in the model from the start.
    pub fn declared(&self) -> &DeclaredPhysics {
        &self.declared
    }

    /// The same with other physics declared; before the first window.
    #[must_use]
    pub fn declaring(mut self, declared: DeclaredPhysics) -> Self {
        self.declared = declared;
        self
    }

    /// Keeps a window in which no joint is known yet: it is learned with the first that follows.
    pub fn keep_window(&mut self, contacts: &[Contact]) {
        self.windows.push(WindowMemory { contacts: contacts.to_vec(), ..WindowMemory::default() });
    }

    /// Learns the newest window, and older ones again as the budget allows.
    pub fn learn_window(&mut self, fit: &KinematicFit, input: &DynamicsInput<'_>) -> WindowInference {
        self.windows.resize_with(input.windows.len(), WindowMemory::default);
        let Some(newest) = input.windows.len().checked_sub(1) else {
            return WindowInference::default();
        };
        self.windows[newest].contacts = input.contacts.to_vec();
        if let Err(failure) = self.follow(fit, input).and_then(|()| self.drop_passed_stops(fit)) {
            return WindowInference { failure: Some(failure), ..WindowInference::default() };
        }
        let mut result = self
            .learn(newest, fit, input, STEPS)
            .unwrap_or_else(|failure| WindowInference { failure: Some(failure), ..WindowInference::default() });
        let mut budget = REVISIT_STEPS;
        for window in self.stale(newest) {
            if budget == 0 {
                break;
            }
            // A warm start needs two or three steps.
            let steps = if self.windows[window].learned { 3 } else { STEPS };
            let spent = self.learn(window, fit, input, steps).map_or(1, |r| r.steps);
            budget = budget.saturating_sub(spent.max(1));
            result.steps += spent;
        }
        result
    }

    /// Takes over the joints, axes and covariance of a kinematic fit.
    pub(super) fn follow(&mut self, fit: &KinematicFit, input: &DynamicsInput<'_>) -> Result<(), Failure> {
        let label_of = |k: usize| fit.joints[k].child;
        let mut present: Vec<Label> = Vec::new();
        for joint in &fit.joints {
            present.push(joint.child);
            let mut above = Vec::new();
            let mut at = joint.parent;
            while let Some(p) = at {
                above.push(label_of(p));
                at = fit.joints[p].parent;
            }
            let signature = (joint.joint_type, joint.parent.map(label_of), above);
            let same = |memory: &JointMemory| {
                memory.signature == signature && memory.direction.dot(&joint.axis.direction) > SAME_DIRECTION
            };
            if !self.joints.get(&joint.child).is_some_and(same) {
                self.forget(joint.child);
                let hull = input.parts.get(&joint.child).cloned();
                let memory = JointMemory {
                    signature,
                    direction: joint.axis.direction,
                    scales: None,
                    stops: [false; 2],
                    stop_positions: [0.0; 2],
                    center: None,
                    tilt: None,
                    hull,
                    friction: self.declared.friction,
                    effects: Vec::new(),
                    tables: Vec::new(),
                    reached: None,
                };
                self.joints.insert(joint.child, memory);
            }
        }
        let gone: Vec<Label> = self.joints.keys().copied().filter(|l| !present.contains(l)).collect();
        for label in gone {
            self.forget(label);
            self.joints.remove(&label);
        }
        for (k, joint) in fit.joints.iter().enumerate() {
            let known = self.joints.get(&joint.child).is_some_and(|m| m.scales.is_some());
            if !known
                && let Some(scales) = self.first_scales(k, fit, input)
                && let Some(memory) = self.joints.get_mut(&joint.child)
            {
                memory.scales = Some(scales);
                memory.effects.extend(self.declared.effects.iter().map(|kind| added_effect(*kind, &scales)));
            }
        }
        self.rebuild(fit)?;
        self.recenter(fit);
        self.set_kinematic_prior(fit)
    }

    /// Lets a window go: its site is multiplied onto those of the windows gone by that the tool held
    /// the same part in, and is not fitted again. Later windows move up one place. `fit` is the fit that
    /// was last learned with.
    pub fn retire(&mut self, window: usize, fit: &KinematicFit) {
        if window >= self.windows.len() {
            return;
        }
        for (joint, path) in fit.joints.iter().zip(fit.positions.get(window).into_iter().flatten()) {
            if let Some(memory) = self.joints.get_mut(&joint.child) {
                let (low, high) = range(path);
                memory.reached = Some(memory.reached.map_or((low, high), |(l, h)| (l.min(low), h.max(high))));
            }
        }
        let memory = self.windows.remove(window);
        if let Some(factor) = self.belief.remove(&Site::Window(window)) {
            let label = touched_label(&memory.contacts);
            self.belief.multiply(Site::Past(label), &factor);
            let past = self.past.entry(label).or_default();
            past.axes.extend(memory.axes);
            past.tool_offset = memory.tool_offset;
        }
        self.belief.rename_sites(|site| match site {
            Site::Window(later) if later > window => Site::Window(later - 1),
            other => other,
        });
    }

    fn forget(&mut self, label: Label) {
        self.forget_sites(label);
        self.belief.remove_prior(&Block::Dynamics(label));
    }

    /// Forgets what windows said of a joint.
    pub(super) fn forget_sites(&mut self, label: Label) {
        for block in [Block::Dynamics(label), Block::Axis(label)] {
            for site in self.belief.drop_sites_of(&block) {
                match site {
                    Site::Window(window) => self.windows[window].learned = false,
                    Site::Past(label) => drop(self.past.remove(&label)),
                }
            }
        }
    }

    /// The mechanism of the current joints, and the priors of new ones.
    pub(super) fn rebuild(&mut self, fit: &KinematicFit) -> Result<(), Failure> {
        let memory = |joint: &KinematicJoint| self.joints.get(&joint.child);
        let default = JointScales { force: 1.0, rate: 0.2, travel: 0.3 };
        let scales: Vec<_> = fit.joints.iter().map(|j| memory(j).and_then(|m| m.scales).unwrap_or(default)).collect();
        let stops: Vec<_> = fit.joints.iter().map(|j| memory(j).map_or([false; 2], |m| m.stops)).collect();
        let hull = |joint: &KinematicJoint| {
            memory(joint)
                .and_then(|m| m.hull.clone())
                .unwrap_or_else(|| HullProperties::guess(joint.center, joint.radius.max(0.05)))
        };
        let mut models = joint_models(&fit.joints, hull, &scales, &stops, &self.gravity);
        for model in &mut models {
            let label = model.joint.child;
            let Some(memory) = self.joints.get_mut(&label) else {
                continue;
            };
            model.center = *memory.center.get_or_insert(model.center);
            model.tilt = *memory.tilt.get_or_insert(model.tilt);
            model.friction = memory.friction;
            model.effects.clone_from(&memory.effects);
            model.tables.clone_from(&memory.tables);
            let block = Block::Dynamics(label);
            // The prior is made once; a stop that comes to be believed changes its own entries only.
            let gaussian = match self.belief.prior(&block) {
                Some(old) if old.gaussian.dimension() == model.size() => with_stops(&old.gaussian, memory),
                Some(old) => extended(&with_stops(&old.gaussian, memory), model)?,
                None => {
                    let mut prior = model.prior(memory.stop_positions)?;
                    if let Some(inertia) = self.declared.inertia.get(&label) {
                        let precision = DECLARED_INERTIA.powi(-2);
                        prior.precision[(INERTIA, INERTIA)] += precision;
                        prior.information[INERTIA] += precision * inertia.ln();
                    }
                    prior
                }
            };
            let gaussian = with_tilt(gaussian, model, fit);
            let size = model.size();
            self.belief.set_prior(block, Factor { blocks: vec![(block, size)], gaussian });
        }
        self.mechanism = Mechanism { joints: models, gravity: self.gravity, sensor: self.sensor };
        let sensor = self.sensor_prior.clone().map_or_else(standard_sensor, Ok)?;
        self.belief.set_prior(Block::Sensor, Factor { blocks: vec![(Block::Sensor, SENSOR_SIZE)], gaussian: sensor });
        Ok(())
    }

    fn set_kinematic_prior(&mut self, fit: &KinematicFit) -> Result<(), Failure> {
        let mut blocks: Vec<(Block, usize)> =
            fit.joints.iter().map(|j| (Block::Axis(j.child), j.axis_parameters())).collect();
        blocks.push((Block::ToolOffset, 3));
        let mut covariance = kinematic_covariance(fit);
        for i in 0..covariance.nrows() {
            covariance[(i, i)] += 1e-12;
        }
        let gaussian = Gaussian::from_moments(&DVector::zeros(covariance.nrows()), &covariance)?;
        self.belief.set_prior(Block::ToolOffset, Factor { blocks, gaussian });
        Ok(())
    }

    /// Carries the sites' kinematic errors over to the new fit: old = turn · new + shift.
    fn recenter(&mut self, fit: &KinematicFit) {
        let (windows, past, models) = (&mut self.windows, &mut self.past, &self.mechanism.joints);
        for (site, factor) in self.belief.sites_mut() {
            let memory = match site {
                Site::Window(window) => windows.get_mut(*window),
                Site::Past(label) => past.get_mut(label),
            };
            let Some(memory) = memory else {
                continue;
            };
            let size = factor.gaussian.dimension();
            let mut map = DMatrix::identity(size, size);
            let mut shift = DVector::zeros(size);
            let mut at = 0;
            let axes_of = |label: &Label| {
                let new = fit.joints.iter().find(|j| j.child == *label).map(|j| j.axis);
                memory.axes.get(label).copied().zip(new)
            };
            for (block, length) in &factor.blocks {
                match block {
                    Block::Axis(label) => {
                        if let Some((old, new)) = axes_of(label) {
                            let (turn, moved) = axis_change(&old, &new);
                            for i in 0..*length {
                                shift[at + i] = moved[i];
                                for j in 0..*length {
                                    map[(at + i, at + j)] = turn[(i, j)];
                                }
                            }
                        }
                    }
                    Block::Dynamics(label) => {
                        let model = models.iter().find(|model| model.joint.child == *label);
                        if let (Some((old, new)), Some(model)) = (axes_of(label), model) {
                            let tilt = model.tilt.numbers(&(new.direction - old.direction));
                            (0..model.tilt.shown).for_each(|i| shift[at + TILT + i] = tilt[i]);
                        }
                    }
                    Block::ToolOffset => {
                        for i in 0..3 {
                            shift[at + i] = fit.tool_offset[i] - memory.tool_offset[i];
                        }
                    }
                    Block::Sensor => {}
                }
                at += length;
            }
            memory.moved_to(fit);
            factor.gaussian = factor.gaussian.pull_back(&map, &shift);
        }
    }

    /// Older windows: unlearned ones first, then those that were looked at longest ago.
    fn stale(&self, newest: usize) -> Vec<usize> {
        let mut windows: Vec<usize> = (0..newest).collect();
        windows.sort_by_key(|&w| (self.windows[w].learned, self.windows[w].turn, w));
        windows
    }

    /// Which joints move in a window, and where the others rest.
    /// Joints in branches that no wrench acts on are left out: nothing known drives them.
    pub(super) fn moving(
        &self,
        window: usize,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
    ) -> (Vec<usize>, Vec<Option<f64>>) {
        let root = |mut k: usize| {
            while let Some(p) = fit.joints[k].parent {
                k = p;
            }
            k
        };
        let driven = driven_labels(&self.windows[window].contacts, input.windows[window]);
        let joint_of = |label| fit.joints.iter().position(|j| j.child == label);
        let branches: Vec<usize> = driven.into_iter().filter_map(joint_of).map(root).collect();
        let mut moving = Vec::new();
        let mut frozen = vec![None; fit.joints.len()];
        for (k, joint) in fit.joints.iter().enumerate() {
            let positions = &fit.positions[window][k];
            let (low, high) = range(positions);
            let rest = if joint.joint_type == JointType::Revolute { REST_ANGLE } else { REST };
            if high - low > rest && branches.contains(&root(k)) {
                moving.push(k);
            } else {
                frozen[k] = Some(positions.iter().sum::<f64>() / positions.len().max(1) as f64);
            }
        }
        (moving, frozen)
    }

    pub(super) fn source<'a>(
        &'a self,
        window: usize,
        moving: &'a [usize],
        fit: &'a KinematicFit,
        input: &'a DynamicsInput<'_>,
    ) -> TrackSource<'a> {
        TrackSource {
            joints: &fit.joints,
            positions: &fit.positions[window],
            window: input.windows[window],
            contacts: &self.windows[window].contacts,
            contact_points: &fit.contact_points[window],
            use_tool: input.use_tool,
            zero: input.zero,
            moving,
        }
    }

    /// Force and rate of a joint in the first window that moved it.
    fn first_scales(&self, joint: usize, fit: &KinematicFit, input: &DynamicsInput<'_>) -> Option<JointScales> {
        let kinematics = kinematics_of(fit);
        (0..input.windows.len()).find_map(|w| {
            let (moving, _) = self.moving(w, fit, input);
            moving.iter().position(|&m| m == joint)?;
            let track = joint_track(&self.source(w, &moving, fit, input), &kinematics)?;
            let times = &input.windows[w].times_s;
            let positions = &fit.positions[w][joint];
            let rates: Vec<f64> = (1..times.len())
                .map(|k| ((positions[k] - positions[k - 1]) / (times[k] - times[k - 1])).abs())
                .collect();
            let rate = quantile(rates, 0.9)?.max(1e-3);
            let forces = self.generalized_forces(joint, fit, &track);
            let force = quantile(forces, 0.9).filter(|f| *f > 1e-3).unwrap_or(1.0);
            Some(JointScales { force, rate, travel: travel_of(positions) })
        })
    }

    /// |Sᵀ w| of the samples on a joint, at the reference configuration of its ancestors.
    fn generalized_forces(&self, joint: usize, fit: &KinematicFit, track: &super::track::JointTrack) -> Vec<f64> {
        let carries =
            |drive: &&Drive| std::iter::successors(Some(drive.joint), |&k| fit.joints[k].parent).any(|k| k == joint);
        let acting: Vec<&Drive> = track.drives.iter().filter(carries).collect();
        let Some(first) = acting.iter().max_by_key(|drive| drive.samples.len()) else { return Vec::new() };
        let screw = fit.joints[joint].screw().0;
        let (angular, linear) = (screw.fixed_rows::<3>(0), screw.fixed_rows::<3>(3));
        let mut cursors = vec![0; acting.len()];
        let mut force = |time_s: f64| -> f64 {
            let at = |(drive, cursor): (&&Drive, &mut usize)| {
                let wrench = WrenchTrack::<f64>::new(drive.joint, &drive.samples).wrench(time_s, cursor);
                angular.dot(&wrench.torque) + linear.dot(&wrench.force)
            };
            acting.iter().zip(&mut cursors).map(at).sum::<f64>().abs()
        };
        first.samples.iter().map(|s| force(s.stamp_s)).filter(|f| *f > 0.0).collect()
    }

    /// Learns one window against its cavity.
    fn learn(
        &mut self,
        window: usize,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        steps: usize,
    ) -> Result<WindowInference, Failure> {
        let (moving, frozen) = self.moving(window, fit, input);
        if moving.is_empty() {
            return self.learn_rest(window, fit, input);
        }
        let mut fitted = self.fit_window(window, fit, input, &moving, &frozen, (steps, None))?;
        let mut spent = fitted.1.steps;
        // Stops where the joint arrived at the end of its range; each then has to stand against all the others.
        let halts = if self.windows[window].learned { Vec::new() } else { self.halts(window, fit, &moving, input) };
        let mut changes: VecDeque<_> = halts.into_iter().map(|(joint, side, at)| (joint, side, Some(at))).collect();
        while let Some((joint, side, stop)) = changes.pop_front() {
            let label = fit.joints[joint].child;
            let before = self.joints.get(&label).cloned();
            if let Some(memory) = self.joints.get_mut(&label) {
                memory.set_stop(side, stop);
            }
            self.rebuild(fit)?;
            // What a stop explains is no noise any more.
            let noise_scale = Some(fitted.1.noise_scale).filter(|scale| *scale < DOUBTED);
            let steps = if noise_scale.is_some() { STOP_STEPS } else { STEPS };
            let warm = Warm { x: fitted.2.clone(), noise_scale };
            let trial = self.fit_window(window, fit, input, &moving, &frozen, (steps, Some(&warm)));
            spent += trial.as_ref().map_or(0, |t| t.1.steps);
            let least = if stop.is_some() { STOP_EVIDENCE } else { -STOP_EVIDENCE };
            match trial {
                Ok(trial) if trial.1.log_predictive > fitted.1.log_predictive + least => {
                    let gain = trial.1.log_predictive - fitted.1.log_predictive;
                    tracing::debug!(window, %label, side, ?stop, gain, noise = trial.1.noise_scale, "end stop");
                    fitted = trial;
                    changes.extend(stop.map(|_| (joint, side, None)));
                }
                _ => {
                    if let Some(before) = before {
                        self.joints.insert(label, before);
                    }
                    self.rebuild(fit)?;
                }
            }
        }
        let (factor, result, _) = fitted;
        self.belief.replace(Site::Window(window), factor);
        let turn = self.windows.len();
        let memory = &mut self.windows[window];
        memory.learned = true;
        memory.turn = turn;
        memory.noise_scale = Some(result.noise_scale);
        memory.made_with(fit);
        let observations = result.innovations.whitened.len();
        let log_predictive = result.log_predictive - 0.5 * observations as f64 * std::f64::consts::TAU.ln();
        Ok(WindowInference {
            steps: spent,
            elbo: log_predictive,
            log_predictive_density: log_predictive,
            observations,
            noise_scale: result.noise_scale,
            failure: None,
        })
    }

    /// A window in which nothing moved: friction held what the tool did.
    fn learn_rest(
        &mut self,
        window: usize,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
    ) -> Result<WindowInference, Failure> {
        let track =
            joint_track(&self.source(window, &[0], fit, input), &kinematics_of(fit)).ok_or(Failure::NoInformation)?;
        let touched = track.drives.first().ok_or(Failure::NoInformation)?.joint;
        let label = fit.joints[touched].child;
        // The load that stood for a tenth of the contact: not a spike of noise.
        let load = quantile(self.generalized_forces(touched, fit, &track), 0.9).ok_or(Failure::NoInformation)?;
        let block = Block::Dynamics(label);
        let (mean, covariance) = self.belief.product(Some(&Site::Window(window))).moments(&[block])?;
        let friction = super::layout::FRICTION;
        let gaussian = load_factor(load.ln(), mean[friction], covariance[(friction, friction)].sqrt(), mean.len());
        self.belief.replace(Site::Window(window), Factor { blocks: vec![(block, mean.len())], gaussian });
        self.windows[window].learned = true;
        Ok(WindowInference { steps: 1, ..WindowInference::default() })
    }

    /// A stop that its joint has gone beyond was none: what windows said of the joint with it is learned anew.
    fn drop_passed_stops(&mut self, fit: &KinematicFit) -> Result<(), Failure> {
        let mut passed = Vec::new();
        for (k, joint) in fit.joints.iter().enumerate() {
            let (low, high) = self.range_of(k, fit);
            let Some(memory) = self.joints.get_mut(&joint.child) else { continue };
            let [lower, upper] = memory.stop_positions;
            for (side, beyond) in [lower - low, high - upper].into_iter().enumerate() {
                if memory.stops[side] && beyond > PASSED {
                    tracing::debug!(label = %joint.child, side, beyond, "end stop passed");
                    memory.set_stop(side, None);
                    passed.push(joint.child);
                }
            }
        }
        if passed.is_empty() {
            return Ok(());
        }
        passed.into_iter().for_each(|label| self.forget_sites(label));
        self.rebuild(fit)
    }

    /// The (joint, side, position) where a joint arrived at an end of all its positions so far.
    fn halts(
        &self,
        window: usize,
        fit: &KinematicFit,
        moving: &[usize],
        input: &DynamicsInput<'_>,
    ) -> Vec<(usize, usize, f64)> {
        let mut halts = Vec::new();
        for &k in moving {
            let joint = &fit.joints[k];
            let Some(memory) = self.joints.get(&joint.child) else {
                continue;
            };
            let near = if joint.joint_type == JointType::Revolute { 0.02 } else { 0.005 };
            let all: Vec<f64> = fit.positions.iter().flat_map(|w| w[k].iter().copied()).collect();
            let (low, high) = range(&all);
            let (low, high) = memory.reached.map_or((low, high), |(l, h)| (low.min(l), high.max(h)));
            for (side, end) in [low, high].into_iter().enumerate() {
                if memory.stops[side] {
                    continue;
                }
                let positions = &fit.positions[window][k];
                let at_end = |i: usize| (positions[i] - end).abs() < near;
                let arrival = (1..positions.len()).find(|&i| at_end(i) && !at_end(i - 1));
                let times_s = &input.windows[window].times_s;
                // A swing turns round in less.
                let stays = |from: usize| {
                    let last = (from..positions.len()).take_while(|&i| at_end(i)).last();
                    last.is_some_and(|last| times_s[last] - times_s[from] > 0.9 * SHORTEST_HALT)
                };
                if arrival.is_some_and(stays) {
                    halts.push((k, side, end));
                }
            }
        }
        halts
    }

    /// Fits a window and makes its site.
    pub(super) fn fit_window(
        &self,
        window: usize,
        fit: &KinematicFit,
        input: &DynamicsInput<'_>,
        moving: &[usize],
        frozen: &[Option<f64>],
        (steps, warm): (usize, Option<&Warm>),
    ) -> Result<(Factor<Block>, FittedWindow, Vec<Option<f64>>), Failure> {
        let involved = self.involved(fit, moving);
        let cavity = self.belief.product(Some(&Site::Window(window)));
        let conditional = given_kinematics(&cavity, &self.blocks())?;
        let window_fit = self.prepare(window, fit, input, (moving, frozen), &conditional)?;
        let active = &window_fit.active;
        let prior = conditional.marginal(active)?;
        let (start, covariance) = prior.moments()?;
        let starts = match warm {
            Some(warm) => {
                vec![DVector::from_fn(active.len(), |i, _| {
                    warm.x.get(active[i]).copied().flatten().unwrap_or(start[i])
                })]
            }
            // What the window itself said last is nearer to what it will say than what the others say of it.
            None if self.windows[window].learned => {
                let (posterior, _) = given_kinematics(&self.belief.product(None), &self.blocks())?.moments()?;
                vec![DVector::from_fn(active.len(), |i, _| posterior[active[i]])]
            }
            None => starts(&start, &covariance, active, &self.mechanism, moving),
        };
        let remembered = self.windows[window].noise_scale.filter(|scale| *scale < DOUBTED);
        let noise_scale = warm.map_or(remembered, |warm| warm.noise_scale);
        let mut fitted = window_fit.fit(&prior, &starts, noise_scale, steps)?;
        if warm.is_none() && fitted.noise_scale >= DOUBTED {
            // Where friction holds a joint that moved, nothing says by how much it is too great.
            let glance = |shift: f64| {
                let other = with_friction(&start, shift, active, &self.mechanism, moving);
                window_fit.fit(&prior, &[other], None, RELEASE_STEPS)
            };
            let glances: Vec<_> = RELEASES.into_par_iter().map(glance).collect();
            let mut spent = fitted.steps;
            for seen in glances {
                let Ok(seen) = seen.inspect(|seen| spent += seen.steps) else { continue };
                if seen.noise_scale >= fitted.noise_scale && seen.log_predictive <= fitted.log_predictive {
                    continue;
                }
                let trial = window_fit.fit(&prior, &[seen.solution.point], None, steps);
                if let Ok(trial) = trial.inspect(|trial| spent += trial.steps)
                    && trial.log_predictive > fitted.log_predictive
                {
                    fitted = trial;
                }
            }
            fitted.steps = spent;
        }
        let fitted = window_fit.without_noise(fitted, &prior)?;
        let deviations = self.deviations(fit, &involved, input.use_tool || !self.windows[window].contacts.is_empty());
        let sensitivity = window_fit.sensitivity(&fitted, &deviations);
        let factor = self.factor(fit, &window_fit, &fitted, &sensitivity);
        let mut x = vec![None; window_fit.base.len()];
        for (&at, value) in window_fit.active.iter().zip(fitted.solution.point.iter()) {
            x[at] = Some(*value);
        }
        Ok((factor, fitted, x))
    }

    /// The blocks of all numbers, in the order of the mechanism's layout.
    pub(super) fn blocks(&self) -> Vec<Block> {
        let joints = self.mechanism.joints.iter().map(|m| Block::Dynamics(m.joint.child));
        joints.chain([Block::Sensor]).collect()
    }

    /// A window as it is fitted, from the mean of `conditional`: all dynamic numbers given the kinematics.
    pub(super) fn prepare<'a>(
        &'a self,
        window: usize,
        fit: &'a KinematicFit,
        input: &'a DynamicsInput<'_>,
        (moving, frozen): (&'a [usize], &[Option<f64>]),
        conditional: &Gaussian,
    ) -> Result<WindowFit<'a>, Failure> {
        let source = self.source(window, moving, fit, input);
        let kinematics = kinematics_of(fit);
        let track = joint_track(&source, &kinematics).ok_or(Failure::NoInformation)?;
        let mut active = Vec::new();
        for (joint, whole) in self.involved(fit, moving) {
            let own = self.mechanism.joints[joint].active();
            let own = if whole { own } else { inertial_entries(&own) };
            active.extend(own.into_iter().map(|i| i + self.mechanism.offset(joint)));
        }
        let sensor = self.mechanism.offset(self.mechanism.joints.len());
        active.extend(self.mechanism.active_sensor().into_iter().map(|i| i + sensor));
        Ok(WindowFit {
            mechanism: &self.mechanism,
            source,
            kinematics,
            frozen: frozen.to_vec(),
            track,
            active,
            base: conditional.moments()?.0.iter().copied().collect(),
        })
    }

    /// Moving joints (all their numbers count), and resting ones that they carry (inertia counts).
    pub(super) fn involved(&self, fit: &KinematicFit, moving: &[usize]) -> Vec<(usize, bool)> {
        (0..fit.joints.len())
            .filter_map(|k| {
                if moving.contains(&k) {
                    return Some((k, true));
                }
                let mut above = fit.joints[k].parent;
                while let Some(p) = above {
                    if moving.contains(&p) {
                        return Some((k, false));
                    }
                    above = fit.joints[p].parent;
                }
                None
            })
            .collect()
    }

    /// Standard deviations of the kinematic numbers that matter to a window; zero for the others.
    pub(super) fn deviations(&self, fit: &KinematicFit, involved: &[(usize, bool)], touched: bool) -> Vec<f64> {
        let covariance = kinematic_covariance(fit);
        let mut deviations = vec![0.0; covariance.nrows()];
        for &(joint, whole) in involved {
            let start = fit.axis_offset(joint);
            // What a slide's direction does is a number of its own.
            let sliding = self.mechanism.joints[joint].joint.joint_type == JointType::Prismatic;
            let own = sliding && self.mechanism.joints[joint].tilt.shown > 0;
            for i in start..start + fit.joints[joint].axis_parameters() {
                deviations[i] = if whole && !own { covariance[(i, i)].max(0.0).sqrt() } else { 0.0 };
            }
        }
        let start = deviations.len() - 3;
        for (i, deviation) in deviations.iter_mut().enumerate().skip(start) {
            *deviation = if touched { covariance[(i, i)].max(0.0).sqrt() } else { 0.0 };
        }
        deviations
    }

    /// The site: [1 S]ᵀ H [1 S] about the data's own optimum.
    fn factor(
        &self,
        fit: &KinematicFit,
        window: &WindowFit<'_>,
        fitted: &FittedWindow,
        sensitivity: &DMatrix<f64>,
    ) -> Factor<Block> {
        let mut blocks: Vec<(Block, usize)> = Vec::new();
        let mut places: Vec<usize> = Vec::new();
        let mut total = 0;
        for (k, model) in self.mechanism.joints.iter().enumerate() {
            let offset = self.mechanism.offset(k);
            let own: Vec<usize> =
                window.active.iter().copied().filter(|i| (offset..offset + model.size()).contains(i)).collect();
            if !own.is_empty() {
                blocks.push((Block::Dynamics(model.joint.child), model.size()));
                places.extend(own.iter().map(|i| total + i - offset));
                total += model.size();
            }
        }
        let sensor = self.mechanism.offset(self.mechanism.joints.len());
        let own: Vec<usize> = window.active.iter().copied().filter(|i| *i >= sensor).collect();
        if !own.is_empty() {
            blocks.push((Block::Sensor, SENSOR_SIZE));
            places.extend(own.iter().map(|i| total + i - sensor));
            total += SENSOR_SIZE;
        }
        // Kinematic numbers that do not matter stay out of the site.
        let mut columns: Vec<usize> = Vec::new();
        let kinematic =
            fit.joints.iter().map(|j| (Block::Axis(j.child), j.axis_parameters())).chain([(Block::ToolOffset, 3)]);
        let mut column = 0;
        for (block, length) in kinematic {
            if (column..column + length).any(|c| sensitivity.column(c).amax() > 0.0) {
                blocks.push((block, length));
                columns.extend(column..column + length);
            }
            column += length;
        }
        let p = window.active.len();
        let map = DMatrix::from_fn(p, p + columns.len(), |i, j| match j.checked_sub(p) {
            None => f64::from(u8::from(i == j)),
            Some(j) => sensitivity[(i, columns[j])],
        });
        places.extend(total..total + columns.len());
        let linear = &fitted.solution.linearization;
        let gaussian = Gaussian {
            precision: &linear.curvature / fitted.reduction,
            information: (&linear.curvature * &fitted.solution.point - &linear.gradient) / fitted.reduction,
        }
        .pull_back(&map, &DVector::zeros(p));
        let mut whole = Gaussian::flat(total + columns.len());
        whole.multiply_at(&gaussian, &places);
        Factor { blocks, gaussian: whole }
    }
}

/// Starting points: what is known, and, while damping is not, friction and damping exchanged.
fn starts(
    mean: &DVector<f64>,
    covariance: &DMatrix<f64>,
    active: &[usize],
    mechanism: &Mechanism,
    moving: &[usize],
) -> Vec<DVector<f64>> {
    use super::layout::{DAMPING, FRICTION};
    let mut starts = vec![mean.clone()];
    for (towards_damping, towards_friction) in [(1.0, -1.5), (-1.5, 1.0)] {
        let mut start = mean.clone();
        let mut open = false;
        for &joint in moving {
            let offset = mechanism.offset(joint);
            for (entry, shift) in [(DAMPING, towards_damping), (FRICTION, towards_friction)] {
                if let Some(i) = active.iter().position(|&a| a == offset + entry)
                    && covariance[(i, i)] > 1.0
                {
                    start[i] += shift;
                    open = true;
                }
            }
        }
        if open {
            starts.push(start);
        }
    }
    starts
}

/// The point with ln friction of all moving joints shifted.
fn with_friction(
    point: &DVector<f64>,
    shift: f64,
    active: &[usize],
    mechanism: &Mechanism,
    moving: &[usize],
) -> DVector<f64> {
    let frictions: Vec<usize> = moving.iter().map(|&joint| mechanism.offset(joint) + super::layout::FRICTION).collect();
    DVector::from_fn(point.len(), |i, _| point[i] + if frictions.contains(&active[i]) { shift } else { 0.0 })
}

/// Distribution of the dynamic numbers for the kinematics as fitted.
pub(super) fn given_kinematics(joint: &Joint<Block>, blocks: &[Block]) -> Result<Gaussian, Failure> {
    let places: Vec<usize> = blocks.iter().flat_map(|b| joint.places(b)).collect();
    let n = places.len();
    let gaussian = Gaussian {
        precision: DMatrix::from_fn(n, n, |i, j| joint.gaussian.precision[(places[i], places[j])]),
        information: DVector::from_fn(n, |i, _| joint.gaussian.information[places[i]]),
    };
    if n == 0 { Err(Failure::NoInformation) } else { Ok(gaussian) }
}

pub(super) fn kinematics_of(fit: &KinematicFit) -> TrackKinematics {
    TrackKinematics { axes: fit.joints.iter().map(|j| j.axis).collect(), tool_offset: fit.tool_offset }
}

/// Covariance of the axes, joint by joint, and the tool's offset, which is last in the fit's.
fn kinematic_covariance(fit: &KinematicFit) -> DMatrix<f64> {
    let axes: usize = fit.joints.iter().map(KinematicJoint::axis_parameters).sum();
    let all = fit.covariance.nrows();
    let places: Vec<usize> = (0..axes).chain(all - 3..all).collect();
    DMatrix::from_fn(places.len(), places.len(), |i, j| fit.covariance[(places[i], places[j])])
}

/// Errors of an axis in the coordinates of `old`, from those in the coordinates of `new`.
fn axis_change(old: &Axis, new: &Axis) -> (DMatrix<f64>, [f64; 4]) {
    let (f0, s0) = orthonormal_pair(&old.direction);
    let (f1, s1) = orthonormal_pair(&new.direction);
    let turn = [[f0.dot(&f1), f0.dot(&s1)], [s0.dot(&f1), s0.dot(&s1)]];
    let map = DMatrix::from_fn(4, 4, |i, j| if i / 2 == j / 2 { turn[i % 2][j % 2] } else { 0.0 });
    // A turn by a f₀ + b s₀ moves the direction by −a s₀ + b f₀.
    let along = old.direction.dot(&(new.point - old.point)) / old.direction.dot(&new.direction);
    let moved = new.point - new.direction * along - old.point;
    (map, [-s0.dot(&new.direction), f0.dot(&new.direction), f0.dot(&moved), s0.dot(&moved)])
}

/// A joint's prior with the error of its axis's direction as the kinematic fit states it.
fn with_tilt(mut prior: Gaussian, model: &JointModel, fit: &KinematicFit) -> Gaussian {
    let mut covariance = Matrix2::identity() * LEAST_TILT.powi(2);
    let fitted = fit.joints.iter().position(|joint| joint.child == model.joint.child);
    if let Some(k) = fitted.filter(|_| model.tilt.shown > 0) {
        let at = fit.axis_offset(k);
        let turns = model.tilt.turns_to_numbers(&fit.joints[k].axis);
        covariance += turns * fit.covariance.fixed_view::<2, 2>(at, at) * turns.transpose();
    }
    let precision = covariance.try_inverse().unwrap_or_else(|| Matrix2::identity() * LEAST_TILT.powi(-2));
    prior.precision.fixed_view_mut::<2, 2>(TILT, TILT).copy_from(&precision);
    prior.information.fixed_rows_mut::<2>(TILT).fill(0.0);
    prior
}

/// A joint's prior with its stops where they are believed.
fn with_stops(prior: &Gaussian, memory: &JointMemory) -> Gaussian {
    let mut gaussian = prior.clone();
    for (side, place) in [LOWER, UPPER].into_iter().enumerate() {
        let deviation = if memory.stops[side] { LIMIT_DEVIATION } else { 1.0 };
        gaussian.precision[(place, place)] = deviation.powi(-2);
        gaussian.information[place] = memory.stop_positions[side] * deviation.powi(-2);
    }
    gaussian
}

/// A joint's prior with those of effects that came to it, or went.
pub(super) fn extended(prior: &Gaussian, model: &JointModel) -> Result<Gaussian, Failure> {
    let own = model.prior([0.0; 2])?;
    let mut gaussian = own.clone();
    for i in 0..SIZE {
        gaussian.information[i] = prior.information[i];
        for j in 0..SIZE {
            gaussian.precision[(i, j)] = prior.precision[(i, j)];
        }
    }
    Ok(gaussian)
}

/// The sensor's numbers, in units of their scales, when nothing was read at rest.
pub(super) fn standard_sensor() -> Result<Gaussian, Failure> {
    Gaussian::from_moments(&DVector::zeros(SENSOR_SIZE), &DMatrix::identity(SENSOR_SIZE, SENSOR_SIZE))
}

/// The way from the reference position to the farther end, with its sign.
pub(super) fn travel_of(positions: &[f64]) -> f64 {
    let (low, high) = range(positions);
    let travel = if -low > high { low } else { high };
    if travel.abs() > 1e-3 { travel } else { 1e-3 }
}

/// An effect as it would be on a joint of these scales.
pub(super) fn added_effect(kind: EffectKind, scales: &JointScales) -> AddedEffect {
    let JointScales { force, rate, travel } = *scales;
    let scales = Scales { force, rate, position: travel.abs(), duration_s: TYPICAL_RECORD_S };
    AddedEffect { kind, scales, reference: 0.0, reversed: travel < 0.0 }
}

pub(super) fn range(values: &[f64]) -> (f64, f64) {
    values.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), &x| (l.min(x), h.max(x)))
}

fn quantile(mut values: Vec<f64>, share: f64) -> Option<f64> {
    if values.is_empty() {
        return None;
    }
    values.sort_by(f64::total_cmp);
    values.get(((values.len() - 1) as f64 * share) as usize).copied()
}
