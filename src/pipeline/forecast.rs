//! Predictions of the stream: what is known at each cloud's stamp, and nothing later but the wrench.
//!
//! A prediction for t waits until the wrench up to t + 1 s has arrived. What it starts from is fixed at
//! t: the filter's state, the held point, the posterior that counts by then.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use nalgebra::{Matrix3, Vector3, Vector6};

use super::explain::{measure, travel};
use super::grip::Grip;
use super::rest::RestReading;
use super::touch::{Touch, Toucher, first_push};
use super::whereabouts::{Told, Whereabouts};
use super::{Frame, Learner, Output, PipelineSettings};
use crate::math::Pose;
use crate::mechanism::WrenchSample;
use crate::registration::AlignmentSettings;
use crate::tracking::{
    Calibration, Filter, Forecast, FreeAccount, FreePart, JointAccount, Kind, Skill, TrackedMechanism, mixture,
};
use crate::types::{AppliedWrench, Label, Stamp};

/// How far ahead \[s\].
const HORIZONS: [f64; 3] = [0.1, 0.5, 1.0];
/// Readings may be this much coarser than the last horizon before a prediction waits no longer \[s\].
const PATIENCE: f64 = 0.3;
/// Points further from the surface where it is expected say nothing \[m\].
const POSE_GATE: f64 = 0.03;
/// A part that went less from one frame to the next has come to rest \[m\].
const STILL: f64 = 0.002;
/// Tool positions in a row that deny the hold.
const DENIALS: usize = 4;
/// A new posterior's filter starts this long before its window closed \[s\].
const RUN_UP: f64 = 0.5;
/// Positions of a fit are known to this \[m\], their rates to this \[m/s\].
const FIT_DEVIATION: (f64, f64) = (0.0015, 0.03);
/// Slower parts of a fit rest \[m/s\].
const FIT_RESTS: f64 = 0.004;
/// Standard deviation of the root, of which all is said relative to itself \[m\].
const ROOT_DEVIATION: f64 = 0.0005;
/// Predictions that are judged soon after they were made, to weigh the ways to predict: their horizons,
/// and what error is no fault of a way there \[m\].
const JUDGED: [(usize, f64); 2] = [(0, 0.004), (1, 0.015)];
/// Stamps that differ by less than this are the same \[s\].
const SAME_STAMP: f64 = 0.02;
/// A part said to go further than this moves \[m\].
const MOVES: f64 = 0.003;
/// The tool is about to touch what it is near to, this near \[m\] ...
const APPROACH: f64 = 0.25;
/// ... with this probability, at the point nearest to it but for so much \[m\].
const TOUCHES: f64 = 0.85;
const TOUCH_DEVIATION: f64 = 0.04;
/// A part of unknown joint that is about to be pushed goes at this speed, or does not \[m/s\].
const PUSHED: f64 = 0.15;

/// A posterior that does not count yet.
struct Waiting {
    from_s: f64,
    mechanism: Option<Arc<TrackedMechanism>>,
    start_s: f64,
    close_s: f64,
    positions: Vec<f64>,
    rates: Vec<f64>,
    displacements: BTreeMap<Label, Pose>,
}

impl Waiting {
    /// Starts at `time_s` from the displacements that the parts have then, at rest.
    fn start_from(&mut self, time_s: f64, displacements: &BTreeMap<Label, Pose>) {
        self.start_s = time_s;
        self.displacements.extend(displacements.iter().map(|(label, displacement)| (*label, *displacement)));
        self.rates.fill(0.0);
        let Some(mechanism) = &self.mechanism else { return };
        let seen = |label: Label| displacements.get(&label).copied().unwrap_or_else(Pose::identity);
        for (joint, position) in mechanism.joints.iter().zip(&mut self.positions) {
            let parent = joint.parent.map_or_else(Pose::identity, |parent| seen(mechanism.joints[parent].child));
            *position = joint.position_of(&(parent.inverse() * seen(joint.child)), *position);
        }
    }
}

/// What a stamp brought.
struct Seen {
    time_s: f64,
    frame: Frame,
    touches: Vec<Touch>,
    tool_sigma: f64,
}

/// What predictions for a stamp are made from.
struct Pending {
    time_s: f64,
    filter: Option<Filter>,
    told: BTreeMap<Label, Told>,
    root: Option<Label>,
    /// What the tool is near to, and the point of it, if it touches nothing.
    near: Option<(Label, Vector3<f64>)>,
    calibration: Calibration<3>,
    skills: BTreeMap<Label, [Skill; JUDGED.len()]>,
    rest: RestReading,
}

/// A prediction to be judged.
struct Issued {
    target_s: f64,
    horizon: usize,
    label: Label,
    center: Vector3<f64>,
    kind: Kind,
    expected: Vector3<f64>,
    covariance_m2: Matrix3<f64>,
}

/// From the stream as it comes to predictions.
pub(super) struct Forecaster {
    latency_s: f64,
    live: bool,
    early: Vec<AppliedWrench>,
    zero: Option<Stamp>,
    samples: Vec<WrenchSample>,
    source: Option<usize>,
    filter: Option<Filter>,
    denials: usize,
    /// Moving parts as measured in the frame before.
    last: BTreeMap<Label, Pose>,
    toucher: Toucher,
    grip: Option<Grip>,
    whereabouts: Whereabouts,
    told: BTreeMap<Label, Told>,
    /// Where parts were found, by time.
    found: BTreeMap<Label, Vec<(f64, Pose)>>,
    /// Predictions that are not yet judged.
    issued: VecDeque<Issued>,
    calibration: Calibration<3>,
    skills: BTreeMap<Label, [Skill; JUDGED.len()]>,
    waiting: Vec<Waiting>,
    seen: VecDeque<Seen>,
    labels: BTreeSet<Label>,
    pending: VecDeque<Pending>,
    /// What predictions of the last second were made from.
    past: VecDeque<Pending>,
    root: Option<Label>,
}

impl Forecaster {
    /// Nothing seen; a posterior counts from its window's close plus the latency.
    pub fn new(settings: &PipelineSettings) -> Self {
        Self {
            latency_s: settings.posterior_latency_s,
            live: settings.live,
            early: Vec::new(),
            zero: None,
            samples: Vec::new(),
            source: None,
            filter: None,
            denials: 0,
            last: BTreeMap::new(),
            toucher: Toucher::new(settings.windows.force_threshold_n),
            grip: None,
            whereabouts: Whereabouts::default(),
            told: BTreeMap::new(),
            found: BTreeMap::new(),
            issued: VecDeque::new(),
            calibration: Calibration::default(),
            skills: BTreeMap::new(),
            waiting: Vec::new(),
            seen: VecDeque::new(),
            labels: BTreeSet::new(),
            pending: VecDeque::new(),
            past: VecDeque::new(),
            root: settings.root,
        }
    }

    /// Takes in a reading; returns the predictions that it completes.
    pub fn push_wrench(&mut self, wrench: &AppliedWrench) -> Vec<Output> {
        let Some(zero) = self.zero else {
            self.early.push(*wrench);
            return Vec::new();
        };
        if *self.source.get_or_insert(wrench.source) != wrench.source {
            return Vec::new();
        }
        self.toucher.bound = wrench.part.or(self.toucher.bound);
        let sample = WrenchSample {
            stamp_s: wrench.stamp.seconds_since(zero),
            point_in_world: wrench.point_in_world,
            force_in_world: wrench.force_in_world,
            torque_in_world: wrench.torque_in_world,
        };
        if self.samples.last().is_some_and(|last| last.stamp_s >= sample.stamp_s) {
            return Vec::new();
        }
        self.samples.push(sample);
        self.ready(|pending| sample.stamp_s >= pending.time_s + HORIZONS[2])
    }

    /// What a window taught, to count from its close \[s\] plus the latency, with its mechanism. Where the
    /// stream went on meanwhile, `current` is where the parts are by now: the filter starts from there.
    pub fn learned(
        &mut self,
        learner: &Learner,
        mechanism: Option<Arc<TrackedMechanism>>,
        current: Option<&BTreeMap<Label, Pose>>,
    ) {
        let (Some(close_s), Some(window)) =
            (learner.windows.last().and_then(|w| w.times_s.last()).copied(), learner.windows.last())
        else {
            return;
        };
        let start = window.times_s.partition_point(|t| *t < close_s - RUN_UP).min(window.times_s.len() - 1);
        let (before, after) = (start.saturating_sub(1), (start + 1).min(window.times_s.len() - 1));
        let span = window.times_s[after] - window.times_s[before];
        let (mut positions, mut rates) = (Vec::new(), Vec::new());
        if let (Some(fit), Some(mechanism)) = (&learner.fit, &mechanism) {
            let Some(fitted) = fit.positions.last() else { return };
            for (joint, path) in mechanism.joints.iter().zip(fitted) {
                let rate = if span > 0.0 { (path[after] - path[before]) / span } else { 0.0 };
                let reach = if joint.screw().0.fixed_rows::<3>(0).norm() > 0.0 { joint.radius } else { 1.0 };
                positions.push(path[start]);
                rates.push(if (rate * reach).abs() < FIT_RESTS { 0.0 } else { rate });
            }
        }
        self.root = Some(learner.root);
        let mut new = Waiting {
            from_s: close_s + self.latency_s,
            mechanism,
            start_s: window.times_s[start],
            close_s,
            positions,
            rates,
            displacements: learner.displacements.clone(),
        };
        if let (Some(current), Some(last)) = (current, self.seen.back()) {
            new.start_from(last.time_s, current);
        }
        self.waiting.push(new);
    }

    /// Starts from a saved object whose joints are at `positions` now.
    pub fn resumed(&mut self, learner: &Learner, now_s: f64, positions: Vec<f64>) {
        self.root = Some(learner.root);
        self.waiting.push(Waiting {
            from_s: now_s,
            mechanism: mechanism_of(learner),
            start_s: now_s,
            close_s: now_s,
            rates: vec![0.0; positions.len()],
            positions,
            displacements: learner.displacements.clone(),
        });
    }

    /// Takes in a frame as it was measured; `rest` is what the sensor reads untouched.
    pub fn push_frame(
        &mut self,
        frame: Frame,
        learner: Option<&Learner>,
        zero: Stamp,
        rest: RestReading,
    ) -> Vec<Output> {
        self.zero = Some(zero);
        let early = std::mem::take(&mut self.early);
        let mut outputs: Vec<Output> = early.iter().flat_map(|wrench| self.push_wrench(wrench)).collect();
        self.labels.extend(frame.scans.keys().chain(frame.poses.keys()));
        let touches = self.toucher.touches(&self.samples, &frame, &rest);
        let now_s = frame.time_s;
        let tool_sigma = self.toucher.tool_sigma();
        self.seen.push_back(Seen { time_s: now_s, frame, touches, tool_sigma });
        if self.restart(now_s, learner) {
            self.grip = None;
        } else if let (Some(filter), Some(seen)) = (&mut self.filter, self.seen.back()) {
            let positions = filter.positions().to_vec();
            follow(filter, seen, &self.samples, learner, (&mut self.denials, &mut self.last));
            if let Some(learner) = learner.filter(|learner| learner.use_tool && self.toucher.bound.is_none()) {
                let brought = (&seen.frame, seen.touches.as_slice());
                Grip::look(&mut self.grip, brought, &positions, learner, (filter, &mut self.toucher));
            }
        }
        let mut told = BTreeMap::new();
        if let Some(seen) = self.seen.back() {
            let (frame, toucher) = (&seen.frame, &self.toucher);
            told = self.whereabouts.look(frame, &self.labels, learner, self.filter.as_ref(), toucher);
            if let (Some(learner), Some(filter)) = (learner, &mut self.filter) {
                self.whereabouts.relocate(frame, learner, filter);
            }
            for label in self.toucher.let_go() {
                self.whereabouts.leave(label);
            }
        }
        self.told.clone_from(&told);
        self.judge(now_s, &told, learner);
        self.forget(now_s);
        self.pending.push_back(Pending {
            time_s: now_s,
            filter: self.filter.clone(),
            told,
            root: self.root,
            near: self.toucher.near(APPROACH),
            calibration: self.calibration,
            skills: self.skills.clone(),
            rest,
        });
        let state = self.state(&self.told).into_iter();
        outputs.extend(state.map(|(label, (displacement, twist))| Output::Tracked {
            time_s: now_s,
            label,
            displacement,
            twist,
        }));
        if self.live {
            // The last reading stands for those to come.
            outputs.extend(self.ready(|_| true));
            return outputs;
        }
        let newest_s = self.samples.last().map_or(f64::NEG_INFINITY, |s| s.stamp_s);
        outputs.extend(self.ready(|pending| {
            newest_s >= pending.time_s + HORIZONS[2] || now_s > pending.time_s + HORIZONS[2] + PATIENCE
        }));
        outputs
    }

    /// What is known now: the joints, the parts by themselves, the last frame. `None` without a joint.
    pub fn knowledge(&self) -> Option<(Filter, BTreeMap<Label, FreePart>, Frame)> {
        let free = self.told.iter().map(|(label, told)| (*label, told.free)).collect();
        Some((self.filter.clone()?, free, self.seen.back()?.frame.clone()))
    }

    /// The rest, at the end of the stream.
    pub fn finish(&mut self) -> Vec<Output> {
        self.ready(|_| true)
    }

    /// A posterior that counts by now takes over: the filter starts anew from its fit.
    fn restart(&mut self, now_s: f64, learner: Option<&Learner>) -> bool {
        let Some(at) = self.waiting.iter().rposition(|waiting| waiting.from_s <= now_s + 1e-9) else { return false };
        let Some(new) = self.waiting.drain(..=at).next_back() else { return false };
        self.whereabouts.restart(new.displacements);
        self.denials = 0;
        let Some(mechanism) = new.mechanism else {
            self.filter = None;
            return false;
        };
        let mut filter = Filter::new(mechanism, new.start_s, new.positions, new.rates, FIT_DEVIATION);
        for seen in self.seen.iter().filter(|seen| seen.time_s > new.start_s + 1e-9) {
            filter.set_adapting(seen.time_s > new.close_s);
            follow(&mut filter, seen, &self.samples, learner, (&mut self.denials, &mut self.last));
        }
        filter.set_adapting(true);
        self.filter = Some(filter);
        true
    }

    fn forget(&mut self, now_s: f64) {
        // A posterior that waits starts before its window's close.
        let needed = self.waiting.iter().map(|waiting| waiting.start_s).fold(now_s - RUN_UP - 1.0, f64::min);
        while self.seen.front().is_some_and(|seen| seen.time_s < needed) {
            self.seen.pop_front();
        }
        let first = self.pending.front().map_or(now_s, |pending| pending.time_s).min(needed) - 1.0;
        let old = self.samples.partition_point(|s| s.stamp_s < first);
        if old > 1000 {
            self.samples.drain(..old);
        }
    }

    fn ready(&mut self, is_ready: impl Fn(&Pending) -> bool) -> Vec<Output> {
        let mut outputs = Vec::new();
        while let Some(pending) = self.pending.pop_front_if(|pending| is_ready(pending)) {
            self.predict(&pending, &mut outputs);
            while self.past.front().is_some_and(|past| past.time_s < pending.time_s - HORIZONS[1] - SAME_STAMP) {
                self.past.pop_front();
            }
            self.past.push_back(pending);
        }
        outputs
    }

    fn predict(&mut self, pending: &Pending, outputs: &mut Vec<Output>) {
        let jointed = self.by_joints(pending);
        let pushed_s = pending.near.and_then(|_| self.next_push(pending));
        for (label, told) in &pending.told {
            let root = pending.root == Some(*label);
            let center = jointed.get(label).map_or_else(Vector3::zeros, |ways| ways.center);
            let center = told.free.center().unwrap_or(center);
            for (horizon, horizon_s) in HORIZONS.into_iter().enumerate() {
                let mut free = told.free.after(horizon_s);
                if pending.near.is_some_and(|(near, _)| near == *label) {
                    let way = PUSHED * (horizon_s - pushed_s.map_or(horizon_s, |s| s - pending.time_s)).max(0.0);
                    free.1 += Matrix3::identity() * (way * way);
                }
                let joint = jointed.get(label);
                let (displacement, covariance) = match joint {
                    _ if root => (Pose::identity(), Matrix3::from_diagonal_element(ROOT_DEVIATION.powi(2))),
                    Some(ways) => ways.expected[horizon],
                    None => free,
                };
                let expected = displacement.transform_point(&center);
                let moves = (expected - told.now.transform_point(&center)).norm() > MOVES;
                let kind = Kind { by_joint: joint.is_some() && told.by_joint > 0.5, moves };
                let scale = if root { 1.0 } else { pending.calibration.scale(kind, horizon, &covariance) };
                if !root {
                    let target_s = pending.time_s + horizon_s;
                    let label = *label;
                    let covariance_m2 = covariance;
                    self.issued.push_back(Issued { target_s, horizon, label, center, kind, expected, covariance_m2 });
                }
                outputs.push(Output::Prediction {
                    time_s: pending.time_s,
                    horizon_s,
                    label: *label,
                    displacement,
                    covariance_m2: covariance * scale,
                });
            }
        }
    }

    /// Predictions of the parts with joints, as the tree can go: the mechanism's, its rates' and rest's, as
    /// they did of late, with what is said of the parts without their joints.
    fn by_joints(&self, pending: &Pending) -> BTreeMap<Label, Jointed> {
        let Some(filter) = &pending.filter else { return BTreeMap::new() };
        let mechanism = filter.mechanism();
        let plain = filter.forecast(&HORIZONS, &self.samples);
        let touched = pending.near.filter(|_| self.next_push(pending).is_some()).and_then(|(label, point)| {
            let body = mechanism.body(label)?;
            let mut filter = filter.clone();
            filter.hold(body, &(point + mechanism.tool_offset), TOUCH_DEVIATION);
            Some(filter.forecast(&HORIZONS, &self.samples))
        });
        let skills: Vec<_> =
            mechanism.joints.iter().map(|j| pending.skills.get(&j.child).copied().unwrap_or_default()).collect();
        let mut jointed: BTreeMap<Label, Jointed> = BTreeMap::new();
        for (horizon, horizon_s) in HORIZONS.into_iter().enumerate() {
            let Some(simulated) = plain.get(horizon) else { continue };
            let account = |forecast: &Forecast, weights: Vec<f64>| JointAccount {
                weights,
                positions: forecast.positions.clone(),
                covariances_m2: forecast.covariances_m2.clone(),
            };
            let all = |weight: f64| vec![weight; skills.len()];
            let accounts = if let Some(touched) = touched.as_ref().and_then(|touched| touched.get(horizon)) {
                vec![account(touched, all(TOUCHES)), account(simulated, all(1.0 - TOUCHES))]
            } else if pending.near.is_some() {
                vec![account(simulated, all(1.0))]
            } else {
                let judged = horizon.min(JUDGED.len() - 1);
                let shown: Vec<_> = skills.iter().map(|skill| skill[judged].weights(JUDGED[judged].1)).collect();
                let weights = |way: usize| shown.iter().map(|shares| shares[way].0).collect();
                let mut accounts = vec![account(simulated, weights(0))];
                for (way, positions) in (1..).zip(filter.steady(horizon_s)) {
                    let spreads = simulated.covariances_m2.iter().zip(&shown);
                    let spread = spreads.map(|(own, shares)| own + Matrix3::identity() * shares[way].1).collect();
                    accounts.push(JointAccount { weights: weights(way), positions, covariances_m2: spread });
                }
                accounts
            };
            let alone = |label: Label| {
                let told = pending.told.get(&label)?;
                let (displacement, covariance_m2) = told.free.after(horizon_s);
                Some(FreeAccount { weight: 1.0 - told.by_joint, displacement, covariance_m2 })
            };
            let free: Vec<_> = mechanism.joints.iter().map(|joint| alone(joint.child)).collect();
            for (body, mixed) in mixture(mechanism, &accounts, &free).into_iter().enumerate() {
                let center = mechanism.centers[body];
                let nowhere = [(Pose::identity(), Matrix3::zeros()); HORIZONS.len()];
                let entry = jointed.entry(mechanism.joints[body].child);
                let entry = entry.or_insert(Jointed { center, expected: nowhere });
                entry.expected[horizon] = (mixed.displacement, mixed.covariance_m2);
            }
        }
        jointed
    }

    /// Where every part is now, as the tree has it, with its joint's twist against its parent.
    fn state(&self, told: &BTreeMap<Label, Told>) -> BTreeMap<Label, (Pose, Vector6<f64>)> {
        let mut state: BTreeMap<Label, (Pose, Vector6<f64>)> =
            told.iter().map(|(label, told)| (*label, (told.now, Vector6::zeros()))).collect();
        let Some(filter) = &self.filter else { return state };
        let mechanism = filter.mechanism();
        let count = mechanism.joints.len();
        let account = JointAccount {
            weights: vec![1.0; count],
            positions: filter.positions().to_vec(),
            covariances_m2: vec![Matrix3::zeros(); count],
        };
        let by_joint = |label: Label| told.get(&label).map_or(1.0, |told| told.by_joint);
        let alone = |label: Label| {
            let FreePart { displacement, .. } = told.get(&label)?.free;
            Some(FreeAccount { weight: 1.0 - by_joint(label), displacement, covariance_m2: Matrix3::zeros() })
        };
        let free: Vec<_> = mechanism.joints.iter().map(|joint| alone(joint.child)).collect();
        let bodies = mixture(mechanism, &[account], &free);
        for ((joint, mixed), rate) in mechanism.joints.iter().zip(bodies).zip(filter.rates()) {
            state.insert(joint.child, (mixed.displacement, joint.screw().0 * (rate * by_joint(joint.child))));
        }
        state
    }

    /// When the tool first pushes within the horizons after a stamp \[s\].
    fn next_push(&self, pending: &Pending) -> Option<f64> {
        let first = self.samples.partition_point(|s| s.stamp_s <= pending.time_s);
        let end = self.samples.partition_point(|s| s.stamp_s <= pending.time_s + HORIZONS[2] + 1e-9);
        first_push(&self.samples[first..end.max(first)], &pending.rest, self.toucher.threshold_n)
    }

    /// Judges what was predicted for now, by where the parts are found.
    fn judge(&mut self, now_s: f64, told: &BTreeMap<Label, Told>, learner: Option<&Learner>) {
        for (label, told) in told {
            let found = self.found.entry(*label).or_default();
            found.push((now_s, told.now));
            found.retain(|(t, _)| now_s - t < HORIZONS[2] + 1.0);
        }
        while let Some(issued) = self.issued.pop_front_if(|issued| issued.target_s < now_s + SAME_STAMP) {
            let at = self.found.get(&issued.label).and_then(|found| {
                found.iter().find(|(t, _)| (t - issued.target_s).abs() < SAME_STAMP).map(|(_, pose)| *pose)
            });
            if let Some(pose) = at {
                let error = issued.expected - pose.transform_point(&issued.center);
                self.calibration.learn(issued.kind, issued.horizon, &error, &issued.covariance_m2);
            }
        }
        let Some(learner) = learner else { return };
        for (slot, (horizon, _)) in JUDGED.into_iter().enumerate() {
            let then_s = now_s - HORIZONS[horizon];
            let mut made = self.pending.iter().chain(&self.past);
            let Some(pending) = made.find(|p| (p.time_s - then_s).abs() < SAME_STAMP) else { continue };
            let Some(filter) = &pending.filter else { continue };
            let simulated = filter.expect(now_s, &self.samples);
            let [moved, stopped] = filter.steady(now_s - pending.time_s).map(|positions| filter.placed(&positions));
            for (label, told) in told {
                let (Some(simulated), Some(by_rate), Some(at_rest), Some(model)) =
                    (simulated.get(label), moved.get(label), stopped.get(label), learner.models.get(label))
                else {
                    continue;
                };
                let skill = &mut self.skills.entry(*label).or_default()[slot];
                let center = |pose: &Pose| pose.transform_point(&model.centroid);
                let errors = [simulated, by_rate, at_rest].map(|pose| (center(pose) - center(&told.now)).norm());
                if told.by_joint > 0.5 && pending.near.is_none() && errors.iter().any(|error| *error > MOVES) {
                    skill.learn(errors);
                } else {
                    skill.fade();
                }
            }
        }
    }
}

/// The joints that a learner knows, as tracking needs them; `None` without any.
pub(super) fn mechanism_of(learner: &Learner) -> Option<Arc<TrackedMechanism>> {
    let noise_scale = learner.inferences.last().map_or(1.0, |inference| inference.noise_scale);
    let fit = learner.fit.as_ref()?;
    TrackedMechanism::new(fit, &learner.dynamics, noise_scale).map(Arc::new)
}

/// A part's predictions by joints.
struct Jointed {
    center: Vector3<f64>,
    expected: [(Pose, Matrix3<f64>); HORIZONS.len()],
}

/// The filter through what one stamp brought.
fn follow(
    filter: &mut Filter,
    seen: &Seen,
    samples: &[WrenchSample],
    learner: Option<&Learner>,
    (denials, last): (&mut usize, &mut BTreeMap<Label, Pose>),
) {
    let Some(learner) = learner else { return };
    let from_s = filter.time_s();
    for touch in seen.touches.iter().filter(|touch| touch.time_s > from_s) {
        filter.advance(touch.time_s, samples);
        let body = touch.part.and_then(|label| filter.mechanism().body(label));
        let Some(body) = body else {
            filter.release();
            continue;
        };
        if touch.begins {
            filter.trust();
        }
        if touch.begins || (touch.pushes && filter.held().is_none_or(|held| held.body != body)) {
            *denials = 0;
            filter.hold(body, &touch.tool_in_world, seen.tool_sigma);
        } else if learner.use_tool && !touch.pushes {
            filter.correct_by_idle_tool(&touch.tool_in_world, seen.tool_sigma);
        } else if learner.use_tool {
            if filter.correct_by_tool(&touch.tool_in_world, seen.tool_sigma) {
                *denials = 0;
            } else {
                *denials += 1;
                if *denials >= DENIALS {
                    *denials = 0;
                    // It is held, and not where the model has it: for now, it goes as the tool does.
                    filter.distrust(body);
                    filter.hold(body, &touch.tool_in_world, seen.tool_sigma);
                }
            }
        }
    }
    let ended = seen.touches.last().is_none_or(|touch| touch.time_s < seen.time_s - 0.05);
    if ended {
        filter.release();
    }
    filter.advance(seen.time_s, samples);
    // Parts that nothing moves are where they were.
    let (mut measured, mut still) = (BTreeMap::new(), true);
    let settings = AlignmentSettings { gate: POSE_GATE, ..AlignmentSettings::default() };
    for (label, displacement) in filter.moving_parts() {
        let Some(model) = learner.models.get(&label) else { continue };
        let posed = seen.frame.poses.get(&label).zip(learner.posed.get(&label));
        let measurement = if let Some((pose, part)) = posed {
            part.measurement(pose)
        } else {
            let Some(scan) = seen.frame.scans.get(&label) else { continue };
            let Some(measurement) = measure(model, scan, &displacement, &settings) else { continue };
            measurement
        };
        filter.correct_by_pose(label, &measurement);
        let (before, after) = (last.get(&label), measurement.displacement);
        still &= before.is_some_and(|before| travel(model, before, &after) < STILL);
        measured.insert(label, after);
    }
    if filter.held().is_none() && !measured.is_empty() && still {
        filter.rest();
    }
    *last = measured;
}
