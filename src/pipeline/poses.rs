//! Parts whose pose a topic measures: thinned out to frames, counted from the first look.
//!
//! Poses may come a thousand times a second. A frame takes what its bin of them says: five or more
//! make a quadratic in time, evaluated at the frame (an average would lag where the part speeds up),
//! with the information of that value; fewer give the one at the frame's own stamp, or what is
//! between the two around it.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{DMatrix, Matrix3, Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::Frame;
use super::explain::Motion;
use crate::math::Pose;
use crate::model::PoseMeasurement;
use crate::types::{Label, MeasuredPose, Stamp};

/// A measured frame is this large \[m\]: what scales its turns, nothing else being known of the part.
pub const POSED_RADIUS: f64 = 0.1;
/// Poses of a bin that make a quadratic.
const FEWEST_TO_SMOOTH: usize = 5;
/// Poses further apart say nothing of the time between \[s\].
const LONGEST_GAP: f64 = 0.2;
/// A part is compared with where it was this long ago \[s\]; it moves if it went this far \[m\], beyond
/// what its noise does: χ² of six degrees of freedom exceeds 30 once in 25,000.
const MOTION_SPAN: f64 = 0.4;
const MOTION_TRAVEL: f64 = 0.003;
const MOTION_SCORE: f64 = 30.0;
/// Frames of the first look that the reference is averaged over, at most.
const MOST_REFERENCES: usize = 250;
/// Frames of the last look before a window that may already see motion \[s\].
const REFERENCE_MARGIN: f64 = 0.5;
/// Poses that stay away this long go on as another record: nothing is known of the time between \[s\].
pub const RECORD_GAP: f64 = 1.0;
/// Travel below this is rest however small the noise is stated to be \[m\].
const RESTS_WITHIN: f64 = 0.0005;

/// How measured poses become observations.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(deny_unknown_fields, default)]
pub struct PoseSettings {
    /// Frames per second that poses are thinned out to, where no clouds set the pace \[Hz\].
    pub rate_hz: f64,
    /// The same in `bom evaluate`, if it is more \[Hz\].
    pub evaluation_rate_hz: f64,
}

impl Default for PoseSettings {
    fn default() -> Self {
        Self { rate_hz: 25.0, evaluation_rate_hz: 25.0 }
    }
}

/// What a topic says of a part's pose in one frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SeenPose {
    /// The measured frame in world.
    pub world_from_frame: Pose,
    /// (angular, linear) about its origin, world axes.
    pub information: Matrix6<f64>,
}

impl SeenPose {
    fn rotation_is_measured(&self) -> bool {
        self.information.fixed_view::<3, 3>(0, 0).amax() > 0.0
    }

    /// δ with self = T(p) exp(δ) T(−p) other to first order: rotation vector, then shift, world axes.
    fn minus(&self, other: &Pose) -> Vector6<f64> {
        let (here, there) = (&self.world_from_frame, other);
        let mut difference = Vector6::zeros();
        if self.rotation_is_measured() {
            let turn = Pose { rotation: here.rotation * there.rotation.transpose(), translation: Vector3::zeros() };
            difference.fixed_rows_mut::<3>(0).copy_from(&turn.log().fixed_rows::<3>(0));
        }
        difference.fixed_rows_mut::<3>(3).copy_from(&(here.translation - there.translation));
        difference
    }
}

/// A pose turned and shifted in world axes about its own origin.
fn plus(pose: &Pose, difference: &Vector6<f64>) -> Pose {
    let mut turn = *difference;
    turn.fixed_rows_mut::<3>(3).fill(0.0);
    let shift: Vector3<f64> = difference.fixed_rows::<3>(3).into();
    Pose { rotation: Pose::exp(&turn).rotation * pose.rotation, translation: pose.translation + shift }
}

/// Poses as they come, and the frames that they make.
#[derive(Debug)]
pub struct PoseBuffer {
    settings: PoseSettings,
    tracks: BTreeMap<Label, VecDeque<MeasuredPose>>,
    first: Option<Stamp>,
    /// Bins up to this one are done.
    bin: i64,
    /// Newest stamp of a cloud: while there are clouds, they set the pace.
    last_cloud: Option<Stamp>,
    last_frame: Option<Stamp>,
    recent: BTreeMap<Label, VecDeque<(f64, SeenPose)>>,
}

impl PoseBuffer {
    /// Nothing seen.
    pub fn new(settings: PoseSettings) -> Self {
        Self {
            settings,
            tracks: BTreeMap::new(),
            first: None,
            bin: 0,
            last_cloud: None,
            last_frame: None,
            recent: BTreeMap::new(),
        }
    }

    /// The earliest stamp.
    pub fn first(&self) -> Option<Stamp> {
        self.first
    }

    /// Whether a topic measures this part.
    pub fn measures(&self, label: Label) -> bool {
        self.tracks.contains_key(&label)
    }

    /// A frame of clouds was made.
    pub fn saw_clouds(&mut self, stamp: Stamp) {
        self.last_cloud = self.last_cloud.max(Some(stamp));
    }

    /// Adds a pose; returns the stamps of frames that are complete now. Stamps of a part ascend.
    pub fn push(&mut self, pose: MeasuredPose) -> Vec<Stamp> {
        let stamp = pose.stamp;
        let first = *self.first.get_or_insert(stamp);
        let track = self.tracks.entry(pose.label).or_default();
        if track.back().is_some_and(|last| last.stamp >= stamp) {
            return Vec::new();
        }
        track.push_back(pose);
        let end = |bin: i64| first.plus_seconds((bin + 1) as f64 / self.settings.rate_hz);
        let slowest = self.tracks.values().filter_map(|track| track.back()).map(|last| last.stamp).min();
        let late = end(self.bin + 1);
        if slowest.is_some_and(|slowest| slowest >= end(self.bin)) || stamp >= late {
            return self.close_bins(stamp);
        }
        Vec::new()
    }

    /// The frames still open at the end of a stream.
    pub fn flush(&mut self) -> Vec<Stamp> {
        let newest = self.tracks.values().filter_map(|track| track.back()).map(|last| last.stamp).max();
        newest.map_or_else(Vec::new, |newest| self.close_bins(newest.plus_seconds(1.0 / self.settings.rate_hz)))
    }

    /// Ends all bins before the one that `stamp` is in; each that holds poses makes a frame at the pose
    /// nearest to its middle.
    fn close_bins(&mut self, stamp: Stamp) -> Vec<Stamp> {
        let Some(first) = self.first else { return Vec::new() };
        let bin_of = |stamp: Stamp| (stamp.seconds_since(first) * self.settings.rate_hz + 1e-6).floor() as i64;
        let now = bin_of(stamp);
        let mut middles: BTreeMap<i64, (f64, Stamp)> = BTreeMap::new();
        for pose in self.tracks.values().flatten() {
            let bin = bin_of(pose.stamp);
            if bin < self.bin || bin >= now {
                continue;
            }
            let middle = first.plus_seconds((bin as f64 + 0.5) / self.settings.rate_hz);
            let off = pose.stamp.seconds_since(middle).abs();
            let best = middles.entry(bin).or_insert((off, pose.stamp));
            if off < best.0 {
                *best = (off, pose.stamp);
            }
        }
        self.bin = now.max(self.bin);
        let by_clouds = self.last_cloud.is_some_and(|cloud| stamp.seconds_since(cloud) < 1.0);
        let frames = middles.into_values().map(|(_, stamp)| stamp).filter(|s| !by_clouds && Some(*s) > self.last_frame);
        frames.collect()
    }

    /// All poses at a frame's stamp; frames come in order.
    pub fn at(&mut self, stamp: Stamp) -> BTreeMap<Label, SeenPose> {
        self.last_frame = self.last_frame.max(Some(stamp));
        let half_s = 0.5 / self.settings.rate_hz;
        let seen =
            self.tracks.iter().filter_map(|(label, track)| Some((*label, pose_at(track, stamp, half_s)?))).collect();
        let old = stamp.plus_seconds(-2.0 * LONGEST_GAP.max(half_s));
        for track in self.tracks.values_mut() {
            while track.front().is_some_and(|pose| pose.stamp < old) {
                track.pop_front();
            }
        }
        seen
    }

    /// What comes is not compared with what was.
    pub fn end_record(&mut self) {
        self.recent.clear();
    }

    /// Whether a part of a frame is away from where it was a short while ago, beyond its noise.
    pub fn something_moves(&mut self, time_s: f64, seen: &BTreeMap<Label, SeenPose>) -> bool {
        let mut moves = false;
        for (label, pose) in seen {
            let recent = self.recent.entry(*label).or_default();
            while recent.get(1).is_some_and(|(then_s, _)| *then_s <= time_s - MOTION_SPAN) {
                recent.pop_front();
            }
            if let Some((_, before)) = recent.front() {
                let difference = pose.minus(&before.world_from_frame);
                // Half the information: both have noise.
                let score = 0.5 * difference.dot(&(pose.information * difference));
                let travel = difference.fixed_rows::<3>(3).norm() + POSED_RADIUS * difference.fixed_rows::<3>(0).norm();
                moves |= travel > MOTION_TRAVEL && score > MOTION_SCORE;
            }
            recent.push_back((time_s, *pose));
        }
        moves
    }
}

/// A part's pose at a stamp, from the poses within half a bin of it or around it.
fn pose_at(track: &VecDeque<MeasuredPose>, stamp: Stamp, half_s: f64) -> Option<SeenPose> {
    let seen =
        |pose: &MeasuredPose| SeenPose { world_from_frame: pose.world_from_frame, information: pose.information };
    let after = track.partition_point(|pose| pose.stamp < stamp);
    let low = track.partition_point(|pose| pose.stamp < stamp.plus_seconds(-half_s));
    let high = track.partition_point(|pose| pose.stamp <= stamp.plus_seconds(half_s));
    if high - low >= FEWEST_TO_SMOOTH {
        let near: Vec<(f64, SeenPose)> =
            track.range(low..high).map(|pose| (pose.stamp.seconds_since(stamp), seen(pose))).collect();
        if let Some(smoothed) = quadratic_at_zero(&near) {
            return Some(smoothed);
        }
    }
    let next = track.get(after)?;
    if next.stamp == stamp {
        return Some(seen(next));
    }
    let before = track.get(after.checked_sub(1)?)?;
    let gap_s = next.stamp.seconds_since(before.stamp);
    if gap_s > LONGEST_GAP {
        return None;
    }
    let weight = stamp.seconds_since(before.stamp) / gap_s;
    let (before, next) = (seen(before), seen(next));
    let world_from_frame = plus(&before.world_from_frame, &(next.minus(&before.world_from_frame) * weight));
    // The noise of both, weighted: between them it is less than that of either.
    let share = (1.0 - weight).powi(2) + weight.powi(2);
    Some(SeenPose { world_from_frame, information: (before.information + next.information) * (0.5 / share) })
}

/// The value at time zero of the quadratic through poses at times \[s\], with its information.
fn quadratic_at_zero(near: &[(f64, SeenPose)]) -> Option<SeenPose> {
    let middle = near.iter().min_by(|a, b| a.0.abs().total_cmp(&b.0.abs()))?.1;
    let scale = near.iter().map(|(t, _)| t.abs()).fold(0.0, f64::max).max(1e-9);
    let mut normal = Matrix3::zeros();
    let mut right = nalgebra::Matrix3x6::zeros();
    let mut information = Matrix6::zeros();
    for (t, pose) in near {
        let row = Vector3::new(1.0, t / scale, (t / scale).powi(2));
        normal += row * row.transpose();
        right += row * pose.minus(&middle.world_from_frame).transpose();
        information += pose.information;
    }
    let inverse = normal.try_inverse()?;
    let value: Vector6<f64> = (inverse * right).row(0).transpose();
    let variance_share = inverse[(0, 0)];
    (variance_share.is_finite() && variance_share > 0.0).then(|| SeenPose {
        world_from_frame: plus(&middle.world_from_frame, &value),
        information: information / (near.len() as f64 * variance_share),
    })
}

/// Where a measured frame was at the reference configuration.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PosedPart {
    /// The measured frame in world.
    pub world_from_frame: Pose,
    /// Of it: (angular, linear) about its origin, world axes.
    pub information: Matrix6<f64>,
}

impl PosedPart {
    /// The part's displacement since then; without a measured rotation, the shift of its origin.
    pub fn measurement(&self, seen: &SeenPose) -> PoseMeasurement {
        if !seen.rotation_is_measured() {
            let shift = seen.world_from_frame.translation - self.world_from_frame.translation;
            return PoseMeasurement { displacement: Pose::from_translation(shift), information: seen.information };
        }
        let displacement = seen.world_from_frame * self.world_from_frame.inverse();
        let mut both = Matrix6::zeros();
        both.fixed_view_mut::<3, 3>(0, 0).copy_from(&displacement.rotation);
        both.fixed_view_mut::<3, 3>(3, 3).copy_from(&displacement.rotation);
        PoseMeasurement { displacement, information: both.transpose() * seen.information * both }
    }
}

/// The reference of every part that the first frames saw at rest: the mean of its poses, but for the
/// newest, which may see the motion that ends the first look.
pub fn references(frames: &[Frame]) -> BTreeMap<Label, PosedPart> {
    let end_s = frames.last().map_or(0.0, |frame| frame.time_s) - REFERENCE_MARGIN;
    let mut found: BTreeMap<Label, (SeenPose, Matrix6<f64>, Vector6<f64>)> = BTreeMap::new();
    for frame in frames.iter().take(MOST_REFERENCES) {
        for (label, pose) in &frame.poses {
            match found.get_mut(label) {
                None => {
                    found.insert(*label, (*pose, pose.information, Vector6::zeros()));
                }
                Some((first, information, weighted)) if frame.time_s <= end_s => {
                    *information += pose.information;
                    *weighted += pose.information * pose.minus(&first.world_from_frame);
                }
                Some(_) => {}
            }
        }
    }
    let mean = |(first, information, weighted): (SeenPose, Matrix6<f64>, Vector6<f64>)| {
        let difference = solve_measured(&information, &weighted);
        PosedPart { world_from_frame: plus(&first.world_from_frame, &difference), information }
    };
    found.into_iter().map(|(label, sums)| (label, mean(sums))).collect()
}

/// Λ⁻¹ x on what was measured, zero elsewhere.
fn solve_measured(information: &Matrix6<f64>, weighted: &Vector6<f64>) -> Vector6<f64> {
    let rows: Vec<usize> = (0..6).filter(|&i| information[(i, i)] > 0.0).collect();
    let block = DMatrix::from_fn(rows.len(), rows.len(), |i, j| information[(rows[i], rows[j])]);
    let right = nalgebra::DVector::from_fn(rows.len(), |i, _| weighted[rows[i]]);
    let mut all = Vector6::zeros();
    if let Some(solution) = block.cholesky().map(|cholesky| cholesky.solve(&right)) {
        for (row, value) in rows.into_iter().zip(solution.iter()) {
            all[row] = *value;
        }
    }
    all
}

/// A part's motion through a window as it was measured: where a frame has no measurement, as in the one
/// before. A part that keeps its place but for noise rests.
pub fn measured_motion(start: &Pose, center: &Vector3<f64>, measured: &[Option<PoseMeasurement>]) -> Motion {
    let away = |from: &Pose, m: &PoseMeasurement| {
        let (r, information) = m.compare(&m.information, center, from);
        (r.fixed_rows::<3>(3).norm() + POSED_RADIUS * r.fixed_rows::<3>(0).norm(), r.dot(&(information * r)))
    };
    let seen: Vec<&PoseMeasurement> = measured.iter().flatten().collect();
    // Rest at the place where the part was, or at that where it is first seen.
    let places = [Some(*start), seen.get(seen.len() / 2).map(|m| m.displacement)];
    for place in places.into_iter().flatten() {
        let misses: Vec<(f64, f64)> = seen.iter().map(|m| away(&place, m)).collect();
        let furthest = misses.iter().map(|(travel, _)| *travel).fold(0.0, f64::max);
        let mean = misses.iter().map(|(_, score)| score).sum::<f64>() / misses.len().max(1) as f64;
        // Six degrees of freedom, and as much again for the place's own noise.
        if furthest < RESTS_WITHIN || (mean < 12.0 && misses.iter().all(|(_, score)| *score < 2.0 * MOTION_SCORE)) {
            let moved = away(start, &PoseMeasurement { displacement: place, information: Matrix6::identity() }).0;
            let displacements = vec![place; measured.len()];
            return Motion::measured(displacements, moved > MOTION_TRAVEL);
        }
    }
    let mut last = seen.first().map_or(*start, |m| m.displacement);
    let displacements = measured.iter().map(|m| {
        last = m.map_or(last, |m| m.displacement);
        last
    });
    Motion::measured(displacements.collect(), true)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn pose(time_s: f64, x: f64, sigma: f64) -> MeasuredPose {
        let variance = [1.0, 1.0, 1.0, sigma * sigma, sigma * sigma, sigma * sigma];
        MeasuredPose {
            stamp: Stamp((time_s * 1e9).round() as i64),
            label: Label(1),
            world_from_frame: Pose::from_translation(Vector3::new(x, 0.0, 0.0)),
            information: Matrix6::from_diagonal(&Vector6::from(variance).map(|v: f64| 1.0 / v)),
        }
    }

    #[test]
    fn a_thousand_poses_a_second_make_25_frames_that_do_not_lag() {
        let mut buffer = PoseBuffer::new(PoseSettings::default());
        let mut frames = Vec::new();
        for i in 0..1000 {
            let t = f64::from(i) * 1e-3;
            for stamp in buffer.push(pose(t, 15.0 * t * t, 0.01)) {
                frames.push((stamp, buffer.at(stamp)[&Label(1)]));
            }
        }
        assert!((23..=25).contains(&frames.len()), "{}", frames.len());
        for (stamp, seen) in &frames[1..frames.len() - 1] {
            let t = stamp.seconds_since(Stamp(0));
            assert!((seen.world_from_frame.translation.x - 15.0 * t * t).abs() < 1e-9);
            // A quadratic's middle has 9/4 of the variance of a mean over as many.
            let deviation = seen.information[(3, 3)].powf(-0.5);
            assert!((deviation / (0.01 * (2.25f64 / 40.0).sqrt()) - 1.0).abs() < 0.1, "{deviation}");
        }
    }

    #[test]
    fn few_poses_are_taken_as_they_are() {
        let mut buffer = PoseBuffer::new(PoseSettings::default());
        let stamps: Vec<Stamp> =
            (0..20).flat_map(|i| buffer.push(pose(f64::from(i) * 0.1, f64::from(i), 0.01))).collect();
        assert_eq!(stamps.len(), 19);
        let seen = buffer.at(Stamp(1_000_000_000));
        assert_eq!(seen[&Label(1)].world_from_frame.translation.x, 10.0);
        assert!((seen[&Label(1)].information[(3, 3)] - 1e4).abs() < 1e-6);
        let between = buffer.at(Stamp(1_050_000_000))[&Label(1)];
        assert!((between.world_from_frame.translation.x - 10.5).abs() < 1e-9);
        assert!((between.information[(3, 3)] - 2e4).abs() < 1e-6);
        assert!(buffer.at(Stamp(9_000_000_000)).is_empty());
    }

    #[test]
    fn noise_is_rest_and_a_shift_is_motion() {
        let noisy = |k: usize, x: f64| PoseMeasurement {
            displacement: Pose::from_translation(Vector3::new(x + 0.001 * (k as f64 * 1.7).sin(), 0.0, 0.0)),
            information: Matrix6::identity() * 1e6,
        };
        let still: Vec<_> = (0..30).map(|k| Some(noisy(k, 0.0))).collect();
        let motion = measured_motion(&Pose::identity(), &Vector3::zeros(), &still);
        assert!(!motion.moved && motion.displacements.iter().all(|d| *d == Pose::identity()));
        let shifted: Vec<_> = (0..30).map(|k| (k % 7 != 3).then(|| noisy(k, 0.002 * k as f64))).collect();
        let motion = measured_motion(&Pose::identity(), &Vector3::zeros(), &shifted);
        assert!(motion.moved && (motion.displacements[29].translation.x - 0.058).abs() < 0.002);
    }
}
