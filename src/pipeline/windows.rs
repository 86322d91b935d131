//! Frames out of clouds, contacts out of wrenches, windows out of both.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use super::explain::Frame;
use super::learner::WindowJob;
use crate::model::Contact;
use crate::registration::ScanPoint;
use crate::types::{AppliedWrench, Label, SegmentedCloud, Stamp};

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

/// One frame from the clouds of a stamp.
pub fn frame_of(time_s: f64, clouds: &[SegmentedCloud]) -> Frame {
    let mut frame = Frame { time_s, ..Frame::default() };
    for cloud in clouds {
        for point in &cloud.points {
            frame
                .scans
                .entry(point.label)
                .or_default()
                .push(ScanPoint { point_in_world: point.point_in_world, viewpoint_in_world: cloud.viewpoint_in_world });
        }
    }
    frame
}

/// Cuts the stream into interaction windows.
#[derive(Debug)]
pub struct WindowCutter {
    settings: WindowSettings,
    zero: Stamp,
    wrenches: VecDeque<AppliedWrench>,
    /// Rest reading of the force, while nothing is touched \[N\].
    pub rest_force: Option<Vector3<f64>>,
    frames: VecDeque<Frame>,
    open_since: Option<f64>,
    last_contact_s: f64,
}

impl WindowCutter {
    /// A cutter for a stream with the given time zero.
    pub fn new(settings: WindowSettings, zero: Stamp) -> Self {
        Self {
            settings,
            zero,
            wrenches: VecDeque::new(),
            rest_force: None,
            frames: VecDeque::new(),
            open_since: None,
            last_contact_s: f64::NEG_INFINITY,
        }
    }

    /// Whether a window is open.
    pub fn is_open(&self) -> bool {
        self.open_since.is_some()
    }

    /// Adds a wrench reading.
    pub fn push_wrench(&mut self, wrench: AppliedWrench) {
        self.wrenches.push_back(wrench);
    }

    fn time(&self, wrench: &AppliedWrench) -> f64 {
        wrench.stamp.seconds_since(self.zero)
    }

    /// Smoothed force beyond the rest reading at a time \[N\].
    fn force_at(&self, time_s: f64) -> Option<f64> {
        let half = 0.5 * self.settings.smoothing_s;
        let (mut sum, mut count) = (Vector3::zeros(), 0.0);
        for wrench in self.wrenches.iter().rev() {
            let t = self.time(wrench);
            if t < time_s - half {
                break;
            }
            if t <= time_s + half {
                sum += wrench.force_in_world;
                count += 1.0;
            }
        }
        (count > 0.0).then(|| (sum / count - self.rest_force.unwrap_or_default()).norm())
    }

    fn track_rest(&mut self, from_s: f64, to_s: f64) {
        let readings: Vec<Vector3<f64>> = self
            .wrenches
            .iter()
            .filter(|w| {
                let t = self.time(w);
                t > from_s && t <= to_s
            })
            .map(|w| w.force_in_world)
            .collect();
        if readings.is_empty() {
            return;
        }
        let mean = readings.iter().sum::<Vector3<f64>>() / readings.len() as f64;
        self.rest_force = Some(self.rest_force.map_or(mean, |rest| rest * 0.9 + mean * 0.1));
    }

    /// Adds a frame; returns a window that closes with it. `moving`: whether a part still moves.
    pub fn push_frame(
        &mut self,
        frame: Frame,
        moving: bool,
        nearest: impl Fn(&Vector3<f64>, &Frame) -> Option<Label>,
    ) -> Option<WindowJob> {
        let now = frame.time_s;
        let previous = self.frames.back().map_or(now - 0.1, |f| f.time_s);
        if self.rest_force.is_none() {
            self.track_rest(now - 10.0, now);
        }
        // The newest reading may be younger than the cloud: look only up to the cloud.
        let steps = 4;
        let active = (1..=steps)
            .map(|i| previous + (now - previous) * f64::from(i) / f64::from(steps) - 0.5 * self.settings.smoothing_s)
            .any(|t| self.force_at(t).is_some_and(|f| f > self.settings.force_threshold_n));
        if active {
            self.last_contact_s = now;
        }
        self.frames.push_back(frame);
        match self.open_since {
            None if active => self.open_since = Some(now),
            None => {
                self.track_rest(previous, now);
                self.forget(now - self.settings.lead_s - 0.2);
            }
            Some(_) => {}
        }
        let opened = self.open_since?;
        let quiet = now - self.last_contact_s >= self.settings.quiet_s && !moving;
        if quiet || now - opened >= self.settings.longest_s {
            return Some(self.close(now, nearest));
        }
        None
    }

    /// The window that is open at the end of the stream.
    pub fn flush(&mut self, nearest: impl Fn(&Vector3<f64>, &Frame) -> Option<Label>) -> Option<WindowJob> {
        self.open_since?;
        let now = self.frames.back()?.time_s;
        Some(self.close(now, nearest))
    }

    fn forget(&mut self, before_s: f64) {
        while self.frames.front().is_some_and(|f| f.time_s < before_s) {
            self.frames.pop_front();
        }
        while self.wrenches.front().is_some_and(|w| w.stamp.seconds_since(self.zero) < before_s - 0.5) {
            self.wrenches.pop_front();
        }
    }

    fn close(&mut self, now: f64, nearest: impl Fn(&Vector3<f64>, &Frame) -> Option<Label>) -> WindowJob {
        self.open_since = None;
        let frames: Vec<Frame> = self.frames.drain(..).collect();
        let contacts = self.contacts(&frames, nearest);
        let wrenches = self.wrenches.iter().copied().collect();
        if let Some(last) = frames.last() {
            self.frames.push_back(last.clone());
        }
        self.forget(now - 1.0);
        WindowJob { frames, contacts, wrenches, zero: self.zero }
    }

    /// The tool's contacts, by the part that the tool was nearest to.
    fn contacts(&self, frames: &[Frame], nearest: impl Fn(&Vector3<f64>, &Frame) -> Option<Label>) -> Vec<Contact> {
        let active: Vec<bool> = frames
            .iter()
            .map(|f| self.force_at(f.time_s).is_some_and(|force| force > self.settings.force_threshold_n))
            .collect();
        let (Some(first), Some(last)) = (active.iter().position(|a| *a), active.iter().rposition(|a| *a)) else {
            return Vec::new();
        };
        let mut track = Vec::new();
        let mut votes: BTreeMap<Label, usize> = BTreeMap::new();
        for k in first..=last {
            if let Some((position, sigma)) = self.tool_at(frames[k].time_s) {
                track.push((k, position, sigma));
                if active[k]
                    && let Some(label) = nearest(&position, &frames[k])
                {
                    *votes.entry(label).or_default() += 1;
                }
            }
        }
        let bound = self.wrenches.iter().find_map(|w| w.part);
        let label = bound.or_else(|| votes.iter().max_by_key(|(_, n)| **n).map(|(l, _)| *l));
        label.map(|label| Contact { label, track }).into_iter().collect()
    }

    /// The tool's position at a time, by a local quadratic fit, with its standard deviation \[m\].
    fn tool_at(&self, time_s: f64) -> Option<(Vector3<f64>, f64)> {
        let mut matrix = nalgebra::Matrix3::zeros();
        let mut right = nalgebra::Matrix3::zeros();
        let mut samples = Vec::new();
        for wrench in &self.wrenches {
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
