//! Frames out of clouds, contacts out of wrenches, windows out of both.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::Frame;
use super::learner::WindowJob;
use super::rest::RestReading;
use crate::model::Contact;
use crate::registration::ScanPoint;
use crate::types::{AppliedWrench, Label, SegmentedCloud, Stamp};

/// Frames of a window are this far apart at least \[s\]: registration's errors are shared by frames that are
/// closer, which cost time and memory all the same.
const FRAME_SPACING: f64 = 0.06;
/// A tool this much farther from a part than at their contact has let go of it \[m\].
const LEAVES: f64 = 0.03;
/// A torque without force counts as the force that makes it at this lever \[m\].
const TORQUE_LEVER: f64 = 0.1;

/// When windows open and close.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct WindowSettings {
    /// Smoothed force beyond the rest reading that means contact \[N\].
    pub force_threshold_n: f64,
    /// Span that forces are smoothed over \[s\].
    pub smoothing_s: f64,
    /// A window starts this long before the first contact \[s\].
    pub lead_s: f64,
    /// It closes after this long without contact and motion \[s\].
    pub quiet_s: f64,
    /// It closes at this length in any case \[s\].
    pub longest_s: f64,
    /// How many windows are kept in full, the most informative ones; the others leave summaries.
    pub kept: usize,
}

impl Default for WindowSettings {
    fn default() -> Self {
        Self { force_threshold_n: 0.3, smoothing_s: 0.064, lead_s: 0.3, quiet_s: 0.35, longest_s: 5.0, kept: 12 }
    }
}

/// Joins the clouds of one stamp into frames.
#[derive(Debug, Default)]
pub struct FrameAssembler {
    pending: BTreeMap<Stamp, (Vec<usize>, Vec<SegmentedCloud>)>,
    sources: Vec<usize>,
    newest: Option<Stamp>,
    frames: usize,
}

impl FrameAssembler {
    /// Adds a cloud; returns the stamps that are complete now, oldest first, with their clouds.
    pub fn push(&mut self, cloud: SegmentedCloud) -> Vec<(Stamp, Vec<SegmentedCloud>)> {
        if !self.sources.contains(&cloud.source) {
            self.sources.push(cloud.source);
        }
        self.newest = self.newest.max(Some(cloud.stamp));
        let (sources, clouds) = self.pending.entry(cloud.stamp).or_default();
        sources.push(cloud.source);
        clouds.push(cloud);
        let mut ready = Vec::new();
        while let Some(entry) = self.pending.first_entry() {
            let all_sources = self.frames > 0 && entry.get().0.len() >= self.sources.len();
            let complete = all_sources || Some(*entry.key()) < self.newest;
            if !complete {
                break;
            }
            let (stamp, (_, clouds)) = entry.remove_entry();
            ready.push((stamp, clouds));
            self.frames += 1;
        }
        ready
    }

    /// What is still waiting, at the end of a stream.
    pub fn flush(&mut self) -> Vec<(Stamp, Vec<SegmentedCloud>)> {
        std::mem::take(&mut self.pending).into_iter().map(|(stamp, (_, clouds))| (stamp, clouds)).collect()
    }
}

/// One frame from the clouds of a stamp, with at most so many points of each part, evenly picked; 0: all.
pub fn frame_of(time_s: f64, clouds: &[SegmentedCloud], most_points: usize) -> Frame {
    let mut scans: BTreeMap<Label, Vec<ScanPoint>> = BTreeMap::new();
    for cloud in clouds {
        for point in &cloud.points {
            scans
                .entry(point.label)
                .or_default()
                .push(ScanPoint { point_in_world: point.point_in_world, viewpoint_in_world: cloud.viewpoint_in_world });
        }
    }
    for scan in scans.values_mut().filter(|scan| most_points > 0 && scan.len() > most_points) {
        *scan = (0..most_points).map(|k| scan[k * scan.len() / most_points]).collect();
    }
    Frame { time_s, scans: scans.into(), ..Frame::default() }
}

/// Readings of the wrenches, and what they read at rest.
#[derive(Clone, Debug)]
struct Readings {
    settings: WindowSettings,
    zero: Stamp,
    wrenches: VecDeque<AppliedWrench>,
    /// Rest readings by source, while nothing is touched or moves.
    rest: BTreeMap<usize, RestReading>,
}

/// A window that closed, as it was cut from the stream: what was touched is still to be found.
#[derive(Clone, Debug)]
pub struct CutWindow {
    frames: Vec<Frame>,
    readings: Readings,
}

/// Cuts the stream into interaction windows.
#[derive(Debug)]
pub struct WindowCutter {
    readings: Readings,
    frames: VecDeque<Frame>,
    open_since: Option<f64>,
    last_contact_s: f64,
    /// The part nearest to the tool then and its distance \[m\], as far as clouds show.
    touched: Option<(Label, f64)>,
    /// Whether the tool has gone from it since.
    left: bool,
}

impl WindowCutter {
    /// A cutter for a stream with the given time zero.
    pub fn new(settings: WindowSettings, zero: Stamp) -> Self {
        Self {
            readings: Readings { settings, zero, wrenches: VecDeque::new(), rest: BTreeMap::new() },
            frames: VecDeque::new(),
            open_since: None,
            last_contact_s: f64::NEG_INFINITY,
            touched: None,
            left: false,
        }
    }

    /// Whether a window is open.
    pub fn is_open(&self) -> bool {
        self.open_since.is_some()
    }

    /// Adds a wrench reading.
    pub fn push_wrench(&mut self, wrench: AppliedWrench) {
        self.readings.wrenches.push_back(wrench);
    }

    /// What a tool's sensor reads at rest.
    pub(super) fn rest_reading(&self) -> Option<RestReading> {
        let tool = self.readings.wrenches.iter().find(|wrench| wrench.tool)?;
        self.readings.rest.get(&tool.source).copied()
    }

    /// Adds a frame; returns a window that closes with it. `moving`: whether a part still moves.
    pub fn push_frame(&mut self, frame: Frame, moving: bool) -> Option<CutWindow> {
        let now = frame.time_s;
        let previous = self.frames.back().map_or(now - 0.1, |f| f.time_s);
        if self.readings.rest.is_empty() {
            self.readings.track_rest(now - 10.0, now);
        }
        let settled = self.readings.is_settled();
        // The newest reading may be younger than the cloud: look only up to the cloud.
        let steps = 4;
        let active = (1..=steps)
            .map(|i| {
                previous + (now - previous) * f64::from(i) / f64::from(steps) - 0.5 * self.readings.settings.smoothing_s
            })
            .any(|t| self.readings.active_at(t, None));
        // What is let go may move on by itself while the tool goes to take hold anew: two contacts, two windows.
        let silent = now - self.last_contact_s > self.readings.settings.quiet_s;
        if !active && let Some((label, distance)) = self.touched {
            let now = self.readings.tool(&frame).and_then(|tool| frame.distance(&tool, label));
            self.left |= now.is_some_and(|now| now > distance + LEAVES);
        }
        let touched = if active { self.readings.tool(&frame).and_then(|tool| frame.nearest(&tool)) } else { None };
        let another = touched.zip(self.touched).is_some_and(|((label, _), (before, _))| label != before);
        let let_go = (active && silent && (another || self.left) && self.is_open()).then(|| self.close(previous));
        if active {
            self.last_contact_s = now;
            self.touched = touched;
            self.left = false;
        }
        // Registration sees motion where there is none; a measured pose does not.
        let opens = active || frame.moves;
        let moving = moving || frame.moves;
        match self.open_since {
            Some(_) => push_spaced(&mut self.frames, frame),
            None => self.frames.push_back(frame),
        }
        match self.open_since {
            None if opens => {
                self.open_since = Some(now);
                let mut thinned = VecDeque::new();
                self.frames.drain(..).for_each(|frame| push_spaced(&mut thinned, frame));
                self.frames = thinned;
            }
            None => {
                self.readings.track_rest(previous, now);
                self.forget(now - self.readings.settings.lead_s - 0.2);
            }
            Some(_) if !settled => self.readings.track_rest(previous, now),
            Some(_) => {}
        }
        let opened = self.open_since?;
        let settings = &self.readings.settings;
        let quiet = now - self.last_contact_s >= settings.quiet_s && !moving;
        let over = quiet || now - opened >= settings.longest_s;
        let_go.or_else(|| over.then(|| self.close(now)))
    }

    /// The window that is open at the end of the stream.
    pub fn flush(&mut self) -> Option<CutWindow> {
        self.open_since?;
        let now = self.frames.back()?.time_s;
        Some(self.close(now))
    }

    /// Ends a record: a window that is open closes, and what comes is not joined to what was.
    pub fn end_record(&mut self) -> Option<CutWindow> {
        let window = self.flush();
        self.frames.clear();
        window
    }

    fn forget(&mut self, before_s: f64) {
        while self.frames.front().is_some_and(|f| f.time_s < before_s) {
            self.frames.pop_front();
        }
        let Readings { wrenches, zero, .. } = &mut self.readings;
        while wrenches.front().is_some_and(|w| w.stamp.seconds_since(*zero) < before_s - 0.5) {
            wrenches.pop_front();
        }
    }

    fn close(&mut self, now: f64) -> CutWindow {
        self.open_since = None;
        let last = self.frames.back().cloned();
        let frames = spaced(self.frames.drain(..));
        self.frames.extend(last);
        let mut readings = self.readings.clone();
        while readings.wrenches.back().is_some_and(|w| readings.time(w) > now) {
            readings.wrenches.pop_back();
        }
        self.forget(now - 1.0);
        CutWindow { frames, readings }
    }
}

/// Whether a frame is far enough from the last one kept.
fn apart(before: &Frame, frame: &Frame) -> bool {
    frame.scans.is_empty() || frame.time_s - before.time_s >= FRAME_SPACING
}

/// Adds a frame; the last one goes if [`spaced`] would not keep it, so that a window's frames do not pile up.
fn push_spaced(frames: &mut VecDeque<Frame>, frame: Frame) {
    if let [.., kept, last] = frames.make_contiguous()
        && !apart(kept, last)
    {
        frames.pop_back();
    }
    frames.push_back(frame);
}

/// Frames that are [`FRAME_SPACING`] apart at least, the first and the last among them; all of those without
/// clouds, as measured poses share no such error.
fn spaced(frames: impl Iterator<Item = Frame>) -> Vec<Frame> {
    let mut kept: Vec<Frame> = Vec::new();
    let mut between = None;
    for frame in frames {
        if kept.last().is_none_or(|before| apart(before, &frame)) {
            kept.push(frame);
            between = None;
        } else {
            between = Some(frame);
        }
    }
    if let Some(last) = between {
        // It stands for the one before it, which it is too near to.
        if kept.len() > 1 {
            kept.pop();
        }
        kept.push(last);
    }
    kept
}

impl CutWindow {
    /// Seconds since time zero of its first and last frame.
    pub fn span_s(&self) -> (f64, f64) {
        let time = |frame: Option<&Frame>| frame.map_or(0.0, |frame| frame.time_s);
        (time(self.frames.first()), time(self.frames.last()))
    }

    /// The window with the tools' contacts, each with the part nearest to it.
    pub fn job(self) -> WindowJob {
        let contacts = self.readings.contacts(&self.frames);
        let Readings { wrenches, zero, .. } = self.readings;
        WindowJob { frames: self.frames, contacts, wrenches: wrenches.into(), zero }
    }
}

impl Readings {
    fn time(&self, wrench: &AppliedWrench) -> f64 {
        wrench.stamp.seconds_since(self.zero)
    }

    /// Whether a source is beyond its rest reading at a time, smoothed; `None`: any source. What no tool
    /// applies may be a torque alone: it counts by its force at [`TORQUE_LEVER`].
    fn active_at(&self, time_s: f64, source: Option<usize>) -> bool {
        let half = 0.5 * self.settings.smoothing_s;
        let mut sums: BTreeMap<usize, ([Vector3<f64>; 2], f64, bool)> = BTreeMap::new();
        for wrench in self.wrenches.iter().rev().filter(|w| source.is_none_or(|source| w.source == source)) {
            let t = self.time(wrench);
            if t < time_s - half {
                break;
            }
            if t <= time_s + half {
                let ([force, torque], count, tool) = sums.entry(wrench.source).or_default();
                *force += wrench.force_in_world;
                *torque += wrench.torque_in_world;
                *count += 1.0;
                *tool = wrench.tool;
            }
        }
        let least_n = self.settings.force_threshold_n;
        sums.into_iter().any(|(source, ([force, torque], count, tool))| {
            let rest = self.rest.get(&source).copied().unwrap_or_default();
            if tool {
                rest.is_push(&(force / count), count, least_n)
            } else {
                rest.is_left(&(force / count), &(torque / count), least_n, least_n * TORQUE_LEVER)
            }
        })
    }

    /// Where the tool is at a frame's stamp, as it was last heard of \[m\].
    fn tool(&self, frame: &Frame) -> Option<Vector3<f64>> {
        let heard = self.wrenches.iter().rev().find(|w| w.tool && self.time(w) <= frame.time_s)?;
        Some(heard.point_in_world)
    }

    /// Whether the noise of every tool's readings is known.
    fn is_settled(&self) -> bool {
        let known = |wrench: &AppliedWrench| self.rest.get(&wrench.source).is_some_and(RestReading::is_settled);
        self.wrenches.iter().filter(|wrench| wrench.tool).all(known)
    }

    fn track_rest(&mut self, from_s: f64, to_s: f64) {
        let zero = self.zero;
        let within = |wrench: &&AppliedWrench| {
            let t = wrench.stamp.seconds_since(zero);
            t > from_s && t <= to_s
        };
        let sources: BTreeSet<usize> = self.wrenches.iter().filter(within).map(|wrench| wrench.source).collect();
        for source in sources {
            let own = self.wrenches.iter().filter(within).filter(|wrench| wrench.source == source);
            self.rest.entry(source).or_default().add(own);
        }
    }

    /// Each tool's contact, by the part that it was nearest to.
    fn contacts(&self, frames: &[Frame]) -> Vec<Contact> {
        let tools: BTreeSet<usize> = self.wrenches.iter().filter(|w| w.tool).map(|w| w.source).collect();
        tools.into_iter().filter_map(|source| self.contact_of(source, frames)).collect()
    }

    fn contact_of(&self, source: usize, frames: &[Frame]) -> Option<Contact> {
        let active: Vec<bool> = frames.iter().map(|f| self.active_at(f.time_s, Some(source))).collect();
        let (first, last) = (active.iter().position(|a| *a)?, active.iter().rposition(|a| *a)?);
        let mut track = Vec::new();
        let mut votes: BTreeMap<Label, usize> = BTreeMap::new();
        for k in first..=last {
            if let Some((position, sigma)) = self.tool_at(source, frames[k].time_s) {
                track.push((k, position, sigma));
                if active[k]
                    && let Some((label, _)) = frames[k].nearest(&position)
                {
                    *votes.entry(label).or_default() += 1;
                }
            }
        }
        let bound = self.wrenches.iter().find(|w| w.source == source).and_then(|w| w.part);
        let label = bound.or_else(|| votes.iter().max_by_key(|(_, n)| **n).map(|(l, _)| *l))?;
        Some(Contact { label, track })
    }

    /// The tool's position at a time, by a local quadratic fit, with its standard deviation \[m\].
    fn tool_at(&self, source: usize, time_s: f64) -> Option<(Vector3<f64>, f64)> {
        let mut matrix = nalgebra::Matrix3::zeros();
        let mut right = nalgebra::Matrix3::zeros();
        let mut samples = Vec::new();
        for wrench in self.wrenches.iter().filter(|w| w.source == source) {
            let t = (self.time(wrench) - time_s) / 0.05;
            if t.abs() <= 1.0 {
                let row = Vector3::new(1.0, t, t * t);
                matrix += row * row.transpose();
                right += row * wrench.point_in_world.transpose();
                samples.push((row, wrench.point_in_world));
            }
        }
        if samples.len() < 4 {
            return None;
        }
        let inverse = matrix.try_inverse()?;
        let solution = inverse * right;
        let residual: f64 = samples.iter().map(|(row, x)| (solution.transpose() * row - x).norm_squared()).sum();
        let variance = residual / (3.0 * (samples.len() as f64 - 3.0).max(1.0));
        let sigma = (variance * inverse[(0, 0)]).sqrt().max(0.0003);
        Some((solution.row(0).transpose(), sigma))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn times(rate_hz: f64, count: usize, scans: &BTreeMap<Label, Vec<ScanPoint>>) -> Vec<f64> {
        let scans = std::sync::Arc::new(scans.clone());
        let frame = |k: usize| Frame { time_s: k as f64 / rate_hz, scans: scans.clone(), ..Frame::default() };
        let mut as_they_come = VecDeque::new();
        (0..count).for_each(|k| push_spaced(&mut as_they_come, frame(k)));
        assert!(scans.is_empty() || as_they_come.len() <= 2 + (count as f64 / rate_hz / FRAME_SPACING) as usize);
        let all = spaced((0..count).map(frame));
        let thinned = spaced(as_they_come.into_iter());
        assert!(all.iter().map(|frame| frame.time_s).eq(thinned.iter().map(|frame| frame.time_s)));
        all.iter().map(|frame| frame.time_s).collect()
    }

    #[test]
    fn frames_that_come_fast_are_thinned_out_from_the_first_to_the_last() {
        let scans = BTreeMap::from([(Label(1), Vec::new())]);
        assert_eq!(times(10.0, 5, &scans).len(), 5);
        assert_eq!(times(15.0, 5, &scans).len(), 5);
        let found = times(30.0, 8, &scans);
        assert_eq!(found.len(), 4, "{found:?}");
        assert!(found[0] == 0.0 && (found[3] - 7.0 / 30.0).abs() < 1e-12, "{found:?}");
        assert_eq!(times(60.0, 2, &scans).len(), 2);
    }

    /// The parts touched, by window, and how far the tool was moved while it is said to have touched the first; it
    /// pushes one part from 1 s to 2 s and again from 2.8 s on what it then has gone to, at a distance \[m\].
    fn touched_in(distance: f64, follows: bool) -> (Vec<Vec<Label>>, f64) {
        let mut cutter = WindowCutter::new(WindowSettings::default(), Stamp(0));
        let mut windows = Vec::new();
        // The tool's track is smoothed over 50 ms either way.
        let place = |time_s: f64| distance * ((time_s - 2.2) / 0.6).clamp(0.0, 1.0);
        for k in 0..400_i64 {
            let time_s = k as f64 * 0.01;
            let pushed = (1.0..2.0).contains(&time_s) || time_s >= 2.8;
            cutter.push_wrench(AppliedWrench {
                stamp: Stamp(k * 10_000_000),
                source: 0,
                part: None,
                tool: true,
                point_in_world: Vector3::new(place(time_s), 0.0, 0.0),
                force_in_world: Vector3::new(if pushed { 5.0 } else { 0.02 * (k % 3) as f64 }, 0.0, 0.0),
                torque_in_world: Vector3::zeros(),
            });
            if k % 10 == 0 {
                // What was pushed has not come to rest by the next push.
                let at = |x: f64| {
                    let point = Vector3::new(x, 0.1, 0.0);
                    vec![ScanPoint { point_in_world: point, viewpoint_in_world: None }]
                };
                let first = if follows { place(time_s) } else { 0.0 };
                let scans = BTreeMap::from([(Label(1), at(first)), (Label(2), at(1.0))]);
                let frame = Frame { time_s, scans: scans.into(), ..Frame::default() };
                windows.extend(cutter.push_frame(frame, time_s > 1.0));
            }
        }
        windows.extend(cutter.flush());
        let jobs: Vec<WindowJob> = windows.into_iter().map(CutWindow::job).collect();
        let touched = jobs.iter().map(|job| job.contacts.iter().map(|c| c.label).collect()).collect();
        let moved = jobs[0].contacts[0].track.iter().map(|(_, tool, _)| tool.x).fold(0.0, f64::max);
        (touched, moved)
    }

    #[test]
    fn a_part_that_moves_on_does_not_join_two_contacts() {
        for (distance, second) in [(1.0, 2), (0.2, 1)] {
            let (touched, moved) = touched_in(distance, false);
            assert_eq!(touched, [vec![Label(1)], vec![Label(second)]]);
            assert!(moved.abs() < 1e-9, "{moved}");
        }
    }

    #[test]
    fn what_is_held_without_force_is_one_contact() {
        let (touched, moved) = touched_in(0.2, true);
        assert_eq!(touched, [vec![Label(1)]]);
        assert!((moved - 0.2).abs() < 1e-9, "{moved}");
    }

    #[test]
    fn measured_poses_are_all_kept() {
        assert_eq!(times(60.0, 8, &BTreeMap::new()).len(), 8);
    }
}
