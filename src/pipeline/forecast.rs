//! Predictions of the stream: what is known at each cloud's stamp, and nothing later but the wrench.
//!
//! A prediction for t waits until the wrench up to t + 1 s has arrived. What it starts from is fixed at
//! t: the filter's state, the held point, the posterior that counts by then.

use std::collections::{BTreeMap, BTreeSet, VecDeque};
use std::sync::Arc;

use nalgebra::{Matrix3, Vector3};

use super::explain::{FEWEST_POINTS, measure, travel};
use super::{Frame, Learner, Output, PipelineSettings, nearest_label};
use crate::math::Pose;
use crate::mechanism::WrenchSample;
use crate::registration::AlignmentSettings;
use crate::tracking::{Filter, FreePart, TrackedMechanism};
use crate::types::{AppliedWrench, Label, Stamp};

/// How far ahead \[s\].
const HORIZONS: [f64; 3] = [0.1, 0.5, 1.0];
/// Readings may be this much coarser than the last horizon before a prediction waits no longer \[s\].
const PATIENCE: f64 = 0.3;
/// Half the readings that a force is smoothed over.
const SMOOTHING: usize = 4;
/// Contact outlives the force by this \[s\].
const RELEASE: f64 = 0.2;
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
/// Least and first standard deviation of the tool's reported position \[m\].
const TOOL_SIGMA: (f64, f64) = (0.0002, 0.001);

/// A posterior that does not count yet.
struct Waiting {
    from_s: f64,
    mechanism: Option<Arc<TrackedMechanism>>,
    start_s: f64,
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

/// One reading in contact.
#[derive(Clone, Copy, Debug)]
struct Touch {
    time_s: f64,
    tool_in_world: Vector3<f64>,
    /// The part, and whether contact with it begins here.
    part: Option<Label>,
    begins: bool,
    pushes: bool,
}

/// What a stamp brought.
struct Seen {
    time_s: f64,
    frame: Frame,
    touches: Vec<Touch>,
    tool_sigma: f64,
}

/// A contact under way.
struct ContactNow {
    label: Option<Label>,
    votes: BTreeMap<Label, usize>,
    last_push_s: f64,
    track: Vec<(f64, Vector3<f64>)>,
    from: Pose,
}

/// What predictions for a stamp are made from.
struct Pending {
    time_s: f64,
    filter: Option<Filter>,
    free: BTreeMap<Label, FreePart>,
    root: Option<Label>,
}

/// From the stream as it comes to predictions.
pub(super) struct Forecaster {
    latency_s: f64,
    live: bool,
    use_tool: bool,
    early: Vec<AppliedWrench>,
    zero: Option<Stamp>,
    samples: Vec<WrenchSample>,
    bound: Option<Label>,
    source: Option<usize>,
    filter: Option<Filter>,
    denials: usize,
    /// Moving parts as measured in the frame before.
    last: BTreeMap<Label, Pose>,
    contact: Option<ContactNow>,
    /// Readings looked at for contact, in time.
    looked_s: f64,
    tool_variance: f64,
    waiting: Vec<Waiting>,
    seen: VecDeque<Seen>,
    labels: BTreeSet<Label>,
    places: BTreeMap<Label, FreePart>,
    pending: VecDeque<Pending>,
    root: Option<Label>,
}

impl Forecaster {
    /// Nothing seen; a posterior counts from its window's close plus the latency.
    pub fn new(settings: &PipelineSettings) -> Self {
        Self {
            latency_s: settings.posterior_latency_s,
            live: settings.live,
            use_tool: settings.use_tool,
            early: Vec::new(),
            zero: None,
            samples: Vec::new(),
            bound: None,
            source: None,
            filter: None,
            denials: 0,
            last: BTreeMap::new(),
            contact: None,
            looked_s: f64::NEG_INFINITY,
            tool_variance: TOOL_SIGMA.1.powi(2),
            waiting: Vec::new(),
            seen: VecDeque::new(),
            labels: BTreeSet::new(),
            places: BTreeMap::new(),
            pending: VecDeque::new(),
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
        self.bound = wrench.part.or(self.bound);
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

    /// What a window taught, to count from its close \[s\] plus the latency. Where the stream went
    /// on meanwhile, `current` is where the parts are by now: the filter starts from there.
    pub fn learned(&mut self, learner: &Learner, current: Option<&BTreeMap<Label, Pose>>) {
        let (Some(close_s), Some(window)) =
            (learner.windows.last().and_then(|w| w.times_s.last()).copied(), learner.windows.last())
        else {
            return;
        };
        let noise_scale = learner.inferences.last().map_or(1.0, |inference| inference.noise_scale);
        let mechanism = learner.fit.as_ref().and_then(|fit| TrackedMechanism::new(fit, &learner.dynamics, noise_scale));
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
            mechanism: mechanism.map(Arc::new),
            start_s: window.times_s[start],
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
        let noise_scale = learner.inferences.last().map_or(1.0, |inference| inference.noise_scale);
        let mechanism = learner.fit.as_ref().and_then(|fit| TrackedMechanism::new(fit, &learner.dynamics, noise_scale));
        self.root = Some(learner.root);
        self.waiting.push(Waiting {
            from_s: now_s,
            mechanism: mechanism.map(Arc::new),
            start_s: now_s,
            rates: vec![0.0; positions.len()],
            positions,
            displacements: learner.displacements.clone(),
        });
    }

    /// Takes in a frame as it was measured; `rest_force` is what the sensor reads untouched \[N\].
    pub fn push_frame(
        &mut self,
        frame: Frame,
        learner: Option<&Learner>,
        zero: Stamp,
        rest_force: Vector3<f64>,
    ) -> Vec<Output> {
        self.zero = Some(zero);
        let early = std::mem::take(&mut self.early);
        let mut outputs: Vec<Output> = early.iter().flat_map(|wrench| self.push_wrench(wrench)).collect();
        self.labels.extend(frame.scans.keys());
        let touches = self.touches(&frame, &rest_force);
        let now_s = frame.time_s;
        let seen = Seen { time_s: now_s, frame, touches, tool_sigma: self.tool_variance.sqrt().max(TOOL_SIGMA.0) };
        self.seen.push_back(seen);
        if !self.restart(now_s, learner)
            && let (Some(filter), Some(seen)) = (&mut self.filter, self.seen.back())
        {
            follow(filter, seen, &self.samples, learner, (&mut self.denials, &mut self.last));
        }
        self.forget(now_s);
        let free = self.free_parts();
        self.pending.push_back(Pending { time_s: now_s, filter: self.filter.clone(), free, root: self.root });
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

    /// The rest, at the end of the stream.
    pub fn finish(&mut self) -> Vec<Output> {
        self.ready(|_| true)
    }

    /// A posterior that counts by now takes over: the filter starts anew from its fit.
    fn restart(&mut self, now_s: f64, learner: Option<&Learner>) -> bool {
        let Some(at) = self.waiting.iter().rposition(|waiting| waiting.from_s <= now_s + 1e-9) else { return false };
        let Some(new) = self.waiting.drain(..=at).next_back() else { return false };
        self.places = new.displacements.into_iter().map(|(label, place)| (label, FreePart::resting(place))).collect();
        self.denials = 0;
        let Some(mechanism) = new.mechanism else {
            self.filter = None;
            return false;
        };
        let mut filter = Filter::new(mechanism, new.start_s, new.positions, new.rates, FIT_DEVIATION);
        for seen in self.seen.iter().filter(|seen| seen.time_s > new.start_s + 1e-9) {
            follow(&mut filter, seen, &self.samples, learner, (&mut self.denials, &mut self.last));
        }
        self.filter = Some(filter);
        true
    }

    /// Readings since the last frame that are in contact, by part.
    fn touches(&mut self, frame: &Frame, rest_force: &Vector3<f64>) -> Vec<Touch> {
        let first = self.samples.partition_point(|s| s.stamp_s <= self.looked_s);
        let end = self.samples.partition_point(|s| s.stamp_s <= frame.time_s + 1e-9);
        self.looked_s = frame.time_s;
        let mut touches = Vec::new();
        let tool_now = (end > first).then(|| self.samples[end - 1].point_in_world);
        let nearest = self.bound.or_else(|| nearest_label(&tool_now?, frame));
        let mut voted = false;
        for i in first..end {
            let around = &self.samples[i.saturating_sub(SMOOTHING)..(i + SMOOTHING + 1).min(end)];
            let mean = around.iter().map(|s| s.force_in_world).sum::<Vector3<f64>>() / around.len() as f64;
            let pushes = (mean - rest_force).norm() > 0.3;
            let sample = self.samples[i];
            if i >= 3 {
                // Third differences of white noise have 20 times its variance; of a motion, next to none.
                let x = |k: usize| self.samples[i - k].point_in_world;
                let third = (x(0) - x(1) * 3.0 + x(2) * 3.0 - x(3)).norm_squared() / 60.0;
                self.tool_variance += 0.005 * (third.min(4.0 * self.tool_variance) - self.tool_variance);
            }
            if self.contact.as_ref().is_some_and(|c| !pushes && sample.stamp_s - c.last_push_s > RELEASE) {
                self.end_contact();
            }
            if self.contact.is_none() && !pushes {
                continue;
            }
            let mut begins = self.contact.is_none();
            let contact = self.contact.get_or_insert_with(|| ContactNow {
                label: None,
                votes: BTreeMap::new(),
                last_push_s: sample.stamp_s,
                track: Vec::new(),
                from: Pose::identity(),
            });
            if pushes {
                contact.last_push_s = sample.stamp_s;
            }
            if !std::mem::replace(&mut voted, true)
                && let Some(label) = nearest
            {
                *contact.votes.entry(label).or_default() += 1;
                let most = contact.votes.iter().max_by_key(|(_, votes)| **votes).map(|(label, _)| *label);
                tracing::debug!(time_s = frame.time_s, ?nearest, ?most, "touch");
                if contact.label != most {
                    begins = true;
                    contact.label = most;
                    contact.track.clear();
                    contact.from =
                        most.and_then(|l| self.places.get(&l)).map_or_else(Pose::identity, |place| place.displacement);
                }
            }
            contact.track.push((sample.stamp_s, sample.point_in_world));
            touches.push(Touch {
                time_s: sample.stamp_s,
                tool_in_world: sample.point_in_world,
                part: contact.label,
                begins,
                pushes,
            });
        }
        touches
    }

    fn end_contact(&mut self) {
        let Some(contact) = self.contact.take() else { return };
        if let Some(label) = contact.label {
            let end = FreePart::carried(contact.from, &contact.track);
            self.places.insert(label, FreePart { velocity: None, ..end });
        }
    }

    /// The parts that have no joint yet.
    fn free_parts(&self) -> BTreeMap<Label, FreePart> {
        self.labels
            .iter()
            .map(|label| {
                let place = || self.places.get(label).cloned().unwrap_or_else(|| FreePart::resting(Pose::identity()));
                let held = self.contact.as_ref().filter(|contact| self.use_tool && contact.label == Some(*label));
                let part = held.map_or_else(place, |contact| FreePart::carried(contact.from, &contact.track));
                (*label, part)
            })
            .collect()
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
        }
        outputs
    }

    fn predict(&self, pending: &Pending, outputs: &mut Vec<Output>) {
        let forecasts =
            pending.filter.as_ref().map(|filter| filter.forecast(&HORIZONS, &self.samples)).unwrap_or_default();
        for label in pending.free.keys() {
            for (horizon, horizon_s) in HORIZONS.into_iter().enumerate() {
                let jointed = forecasts.iter().find(|f| f.label == *label && f.horizon == horizon);
                let (displacement, covariance_m2) = match jointed {
                    _ if pending.root == Some(*label) => {
                        (Pose::identity(), Matrix3::from_diagonal_element(ROOT_DEVIATION.powi(2)))
                    }
                    Some(forecast) => (forecast.displacement, forecast.covariance_m2),
                    None => pending.free[label].after(horizon_s),
                };
                outputs.push(Output::Prediction {
                    time_s: pending.time_s,
                    horizon_s,
                    label: *label,
                    displacement,
                    covariance_m2,
                });
            }
        }
    }
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
        if touch.begins || filter.held().is_none_or(|held| held.body != body) {
            *denials = 0;
            filter.hold(body, &touch.tool_in_world, seen.tool_sigma);
        } else if learner.use_tool {
            if filter.correct_by_tool(&touch.tool_in_world, seen.tool_sigma) {
                *denials = 0;
            } else {
                *denials += 1;
                if *denials >= DENIALS {
                    *denials = 0;
                    if touch.pushes {
                        // It is held, and not where the model has it: for now, it goes as the tool does.
                        filter.distrust(body);
                        filter.hold(body, &touch.tool_in_world, seen.tool_sigma);
                    }
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
        let (Some(model), Some(scan)) = (learner.models.get(&label), seen.frame.scans.get(&label)) else { continue };
        let Some(measurement) = measure(model, scan, &displacement, &settings) else {
            if scan.len() >= FEWEST_POINTS {
                filter.lose(label);
            }
            continue;
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
