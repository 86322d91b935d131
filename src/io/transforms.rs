//! The tree of coordinate frames over time: `world_from_frame` at a stamp, by interpolation.
//!
//! As tf2 has it: a static link holds at all times; a dynamic one between its oldest and newest
//! stamp, translations by lerp and rotations by slerp. Nothing is extrapolated, and an unknown
//! frame is never taken for the identity.

use std::collections::{BTreeMap, VecDeque};

use nalgebra::{UnitQuaternion, Vector3};
use thiserror::Error;

use super::messages::TransformStamped;
use crate::{math::Pose, types::Stamp};

/// Why a transform was not taken in.
#[derive(Clone, Debug, PartialEq, Error)]
pub enum TransformError {
    /// One of the names is empty.
    #[error("empty frame name: parent `{parent}`, child `{child}`")]
    EmptyName {
        /// Parent.
        parent: String,
        /// Child.
        child: String,
    },
    /// The link would close a ring.
    #[error("frame `{child}` under `{parent}` would close a ring")]
    Ring {
        /// Parent.
        parent: String,
        /// Child.
        child: String,
    },
    /// NaN or infinity.
    #[error("frame `{child}`: translation is not finite")]
    NotFinite {
        /// Child.
        child: String,
    },
    /// The quaternion is no rotation.
    #[error("frame `{child}`: quaternion of norm {norm}, need 1")]
    NotARotation {
        /// Child.
        child: String,
        /// As sent.
        norm: f64,
    },
    /// The same stamp again, or one older than the history kept.
    #[error("frame `{child}`: a transform of this stamp is already there, or newer ones by more than the history")]
    Stale {
        /// Child.
        child: String,
    },
}

impl TransformError {
    /// A short name for counting.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::EmptyName { .. } => "empty_frame_name",
            Self::Ring { .. } => "ring",
            Self::NotFinite { .. } => "not_finite",
            Self::NotARotation { .. } => "bad_quaternion",
            Self::Stale { .. } => "repeated_or_old",
        }
    }
}

/// Why there is no transform at a stamp.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum LookupError {
    /// No transform ever named the frame. It may still come.
    #[error("frame `{frame}` is unknown")]
    UnknownFrame {
        /// The frame.
        frame: String,
    },
    /// Both frames are known, but lie in different trees. A link may still come.
    #[error("frame `{frame}` is not connected to `{fixed_frame}` (it hangs from `{root}`)")]
    NotConnected {
        /// The frame asked for.
        frame: String,
        /// The frame to express it in.
        fixed_frame: String,
        /// The top of the tree that `frame` is in.
        root: String,
    },
    /// The newest transform of a link is older than the stamp: wait.
    #[error("frame `{frame}`: newest transform is {by_s:.3} s older", by_s = *by_ns as f64 * 1e-9)]
    NotYet {
        /// The link's child.
        frame: String,
        /// How much older \[ns\].
        by_ns: i64,
    },
    /// The oldest transform of a link is newer than the stamp: it will never come.
    #[error("frame `{frame}`: oldest transform kept is {by_s:.3} s newer", by_s = *by_ns as f64 * 1e-9)]
    TooOld {
        /// The link's child.
        frame: String,
        /// How much newer \[ns\].
        by_ns: i64,
    },
}

impl LookupError {
    /// A short name for counting.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::UnknownFrame { .. } => "unknown_frame",
            Self::NotConnected { .. } => "frame_not_connected",
            Self::NotYet { .. } => "no_recent_tf",
            Self::TooOld { .. } => "older_than_tf",
        }
    }

    /// Whether a later transform can still answer.
    pub fn may_still_come(&self) -> bool {
        !matches!(self, Self::TooOld { .. })
    }
}

/// All links, with the recent past of the dynamic ones.
#[derive(Clone, Debug)]
pub struct TransformBuffer {
    history_ns: i64,
    links: BTreeMap<String, Link>,
}

#[derive(Clone, Debug)]
struct Link {
    parent: String,
    motion: Motion,
}

#[derive(Clone, Debug)]
enum Motion {
    Static(Pose),
    /// In order of stamps, never empty.
    Dynamic(VecDeque<Sample>),
}

#[derive(Clone, Copy, Debug)]
struct Sample {
    stamp: Stamp,
    translation: Vector3<f64>,
    rotation: UnitQuaternion<f64>,
}

impl TransformBuffer {
    /// Keeps `history_s` seconds of every dynamic link, counted back from its newest stamp.
    pub fn new(history_s: f64) -> Self {
        Self { history_ns: (history_s * 1e9) as i64, links: BTreeMap::new() }
    }

    /// Takes in one transform; `is_static` says that it holds at all times. A frame that changes
    /// its parent starts anew.
    ///
    /// # Errors
    /// What is no transform, would close a ring, or is already there; the buffer is then unchanged.
    pub fn insert(&mut self, transform: &TransformStamped, is_static: bool) -> Result<(), TransformError> {
        let parent = bare(&transform.header.frame_id).to_owned();
        let child = bare(&transform.child_frame_id).to_owned();
        if parent.is_empty() || child.is_empty() {
            return Err(TransformError::EmptyName { parent, child });
        }
        if parent == child || self.path_to_root(&parent).any(|frame| frame == child) {
            return Err(TransformError::Ring { parent, child });
        }
        let translation = Vector3::from(transform.transform.translation);
        if !translation.iter().all(|coordinate| coordinate.is_finite()) {
            return Err(TransformError::NotFinite { child });
        }
        let raw = transform.transform.rotation;
        let Some(rotation) = raw.unit() else {
            return Err(TransformError::NotARotation { child, norm: raw.norm() });
        };
        let sample = Sample { stamp: transform.header.stamp.into(), translation, rotation };
        if is_static {
            let motion = Motion::Static(sample.pose());
            self.links.insert(child, Link { parent, motion });
            return Ok(());
        }
        match self.links.get_mut(&child) {
            Some(Link { parent: known, motion: Motion::Dynamic(samples) }) if *known == parent => {
                let newest = samples.back().map_or(sample.stamp, |last| last.stamp);
                let index = samples.partition_point(|other| other.stamp < sample.stamp);
                let repeated = samples.get(index).is_some_and(|other| other.stamp == sample.stamp);
                if repeated || newest.0.saturating_sub(sample.stamp.0) > self.history_ns {
                    return Err(TransformError::Stale { child });
                }
                samples.insert(index, sample);
                let newest = newest.max(sample.stamp);
                while samples.front().is_some_and(|oldest| newest.0.saturating_sub(oldest.stamp.0) > self.history_ns) {
                    samples.pop_front();
                }
            }
            _ => {
                let motion = Motion::Dynamic(VecDeque::from([sample]));
                self.links.insert(child, Link { parent, motion });
            }
        }
        Ok(())
    }

    /// Drops all links that move, as when their clock starts anew.
    pub fn forget_moving(&mut self) {
        self.links.retain(|_, link| matches!(link.motion, Motion::Static(_)));
    }

    /// `fixed_from_frame` at a stamp: carries points of `frame` into `fixed_frame`. The identity
    /// if both are the same.
    ///
    /// # Errors
    /// What is missing; [`LookupError::may_still_come`] says whether waiting can help.
    pub fn lookup(&self, fixed_frame: &str, frame: &str, stamp: Stamp) -> Result<Pose, LookupError> {
        let (fixed_frame, frame) = (bare(fixed_frame), bare(frame));
        if fixed_frame == frame {
            return Ok(Pose::identity());
        }
        let from_frame: Vec<&str> = self.path_to_root(frame).collect();
        let from_fixed: Vec<&str> = self.path_to_root(fixed_frame).collect();
        let Some(common) = from_frame.iter().copied().find(|ancestor| from_fixed.contains(ancestor)) else {
            let known = self.links.contains_key(frame) || self.links.values().any(|link| link.parent == frame);
            let root = from_frame.last().copied().unwrap_or(frame).to_owned();
            return Err(match known {
                false => LookupError::UnknownFrame { frame: frame.to_owned() },
                true => {
                    LookupError::NotConnected { frame: frame.to_owned(), fixed_frame: fixed_frame.to_owned(), root }
                }
            });
        };
        let common_from_frame = self.chain(&from_frame, common, stamp)?;
        let common_from_fixed = self.chain(&from_fixed, common, stamp)?;
        Ok(common_from_fixed.inverse() * common_from_frame)
    }

    /// The frame itself, its parent, and so on up; ends, as `insert` admits no ring.
    fn path_to_root<'a>(&'a self, frame: &'a str) -> impl Iterator<Item = &'a str> {
        std::iter::successors(Some(frame), |frame| self.links.get(*frame).map(|link| link.parent.as_str()))
    }

    /// `ancestor_from_frame` for the first frame of `path`.
    fn chain(&self, path: &[&str], ancestor: &str, stamp: Stamp) -> Result<Pose, LookupError> {
        let mut ancestor_from_frame = Pose::identity();
        for frame in path.iter().take_while(|frame| **frame != ancestor) {
            if let Some(link) = self.links.get(*frame) {
                ancestor_from_frame = link.parent_from_child(frame, stamp)? * ancestor_from_frame;
            }
        }
        Ok(ancestor_from_frame)
    }
}

impl Link {
    fn parent_from_child(&self, child: &str, stamp: Stamp) -> Result<Pose, LookupError> {
        let samples = match &self.motion {
            Motion::Static(pose) => return Ok(*pose),
            Motion::Dynamic(samples) => samples,
        };
        let index = samples.partition_point(|sample| sample.stamp < stamp);
        let after = samples.get(index);
        let before = index.checked_sub(1).and_then(|index| samples.get(index));
        match (before, after) {
            (_, Some(after)) if after.stamp == stamp => Ok(after.pose()),
            (Some(before), Some(after)) => Ok(before.interpolate(after, stamp).pose()),
            (None, Some(after)) => {
                Err(LookupError::TooOld { frame: child.to_owned(), by_ns: after.stamp.0.saturating_sub(stamp.0) })
            }
            (Some(before), None) => {
                Err(LookupError::NotYet { frame: child.to_owned(), by_ns: stamp.0.saturating_sub(before.stamp.0) })
            }
            (None, None) => Err(LookupError::UnknownFrame { frame: child.to_owned() }),
        }
    }
}

impl Sample {
    fn pose(&self) -> Pose {
        Pose::from_quaternion(&self.rotation, self.translation)
    }

    /// Linear in the translation, along the shorter great arc in the rotation.
    fn interpolate(&self, after: &Sample, stamp: Stamp) -> Sample {
        let span_s = after.stamp.seconds_since(self.stamp);
        let fraction = stamp.seconds_since(self.stamp) / span_s;
        let rotation_between = self.rotation.rotation_to(&after.rotation);
        Sample {
            stamp,
            translation: self.translation.lerp(&after.translation, fraction),
            rotation: rotation_between.powf(fraction) * self.rotation,
        }
    }
}

/// Without the leading slash that ROS 1 put before frame names.
pub(super) fn bare(frame: &str) -> &str {
    frame.strip_prefix('/').unwrap_or(frame)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::messages::{Header, RawTransform};
    use nalgebra::Vector6;

    fn link(parent: &str, child: &str, stamp_s: f64, pose: Pose) -> TransformStamped {
        TransformStamped {
            header: Header { stamp: Stamp::default().plus_seconds(stamp_s).into(), frame_id: parent.into() },
            child_frame_id: child.into(),
            transform: RawTransform::from(pose),
        }
    }

    fn at(stamp_s: f64) -> Stamp {
        Stamp::default().plus_seconds(stamp_s)
    }

    fn distance(a: &Pose, b: &Pose) -> f64 {
        (a.rotation - b.rotation).norm() + (a.translation - b.translation).norm()
    }

    #[test]
    fn chains_read_world_from_camera() {
        let world_from_base = Pose::exp(&Vector6::new(0.1, 0.2, 0.3, 1.0, 2.0, 3.0));
        let base_from_camera = Pose::exp(&Vector6::new(-0.3, 0.1, 0.0, 0.0, 0.5, 1.0));
        let map_from_world = Pose::exp(&Vector6::new(0.0, 0.0, 1.0, 5.0, 0.0, 0.0));
        let mut buffer = TransformBuffer::new(10.0);
        buffer.insert(&link("world", "base", 0.0, world_from_base), true).unwrap();
        buffer.insert(&link("/base", "/camera", 0.0, base_from_camera), true).unwrap();
        buffer.insert(&link("map", "world", 0.0, map_from_world), true).unwrap();
        let found = buffer.lookup("world", "camera", at(99.0)).unwrap();
        assert!(distance(&found, &(world_from_base * base_from_camera)) < 1e-12);
        let found = buffer.lookup("world", "map", at(99.0)).unwrap();
        assert!(distance(&found, &map_from_world.inverse()) < 1e-12);
        let found = buffer.lookup("camera", "map", at(99.0)).unwrap();
        let camera_from_map = (map_from_world * world_from_base * base_from_camera).inverse();
        assert!(distance(&found, &camera_from_map) < 1e-12);
    }

    #[test]
    fn a_constant_twist_is_interpolated_in_rotation_and_position() {
        let pose = |t: f64| {
            let rotation = UnitQuaternion::from_scaled_axis(Vector3::new(0.3, -0.4, 1.2) * t);
            Pose::from_quaternion(&rotation, Vector3::new(1.0, -2.0, 0.5) * t)
        };
        let mut buffer = TransformBuffer::new(10.0);
        for stamp_s in [0.0, 2.0, 1.0] {
            buffer.insert(&link("world", "tool", stamp_s, pose(stamp_s)), false).unwrap();
        }
        for stamp_s in [0.0, 0.25, 1.0, 1.9, 2.0] {
            let found = buffer.lookup("world", "tool", at(stamp_s)).unwrap();
            assert!(distance(&found, &pose(stamp_s)) < 1e-9, "{stamp_s}");
        }
    }

    #[test]
    fn nothing_is_extrapolated_and_nothing_is_assumed() {
        let mut buffer = TransformBuffer::new(10.0);
        let lookup = |buffer: &TransformBuffer, frame: &str, stamp_s| {
            buffer.lookup("world", frame, at(stamp_s)).map_err(|error| (error.kind(), error.may_still_come()))
        };
        assert_eq!(lookup(&buffer, "world", 1.0), Ok(Pose::identity()));
        assert_eq!(lookup(&buffer, "tool", 1.0), Err(("unknown_frame", true)));
        buffer.insert(&link("base", "tool", 1.0, Pose::identity()), false).unwrap();
        assert_eq!(lookup(&buffer, "tool", 1.0), Err(("frame_not_connected", true)));
        assert_eq!(lookup(&buffer, "base", 1.0), Err(("frame_not_connected", true)));
        buffer.insert(&link("world", "base", 0.0, Pose::identity()), true).unwrap();
        assert_eq!(lookup(&buffer, "tool", 1.0), Ok(Pose::identity()));
        assert_eq!(lookup(&buffer, "tool", 1.1), Err(("no_recent_tf", true)));
        assert_eq!(lookup(&buffer, "tool", 0.9), Err(("older_than_tf", false)));
        buffer.insert(&link("base", "tool", 11.5, Pose::identity()), false).unwrap();
        assert_eq!(lookup(&buffer, "tool", 1.1), Err(("older_than_tf", false)), "history is 10 s");
    }

    #[test]
    fn what_is_no_transform_leaves_the_buffer_as_it_was() {
        let mut buffer = TransformBuffer::new(10.0);
        buffer.insert(&link("world", "a", 20.0, Pose::identity()), false).unwrap();
        buffer.insert(&link("a", "b", 0.0, Pose::identity()), true).unwrap();
        let mut refused = |transform: TransformStamped| buffer.insert(&transform, false).unwrap_err().kind();
        assert_eq!(refused(link("b", "world", 0.0, Pose::identity())), "ring");
        assert_eq!(refused(link("a", "a", 0.0, Pose::identity())), "ring");
        assert_eq!(refused(link("", "a", 0.0, Pose::identity())), "empty_frame_name");
        assert_eq!(refused(link("world", "a", 20.0, Pose::identity())), "repeated_or_old");
        assert_eq!(refused(link("world", "a", 9.9, Pose::identity())), "repeated_or_old");
        let mut bad = link("world", "a", 21.0, Pose::identity());
        bad.transform.rotation.w = 0.0;
        assert_eq!(refused(bad.clone()), "bad_quaternion");
        bad.transform.translation.y = f64::NAN;
        assert_eq!(refused(bad), "not_finite");
        assert_eq!(buffer.lookup("world", "b", at(20.0)), Ok(Pose::identity()));
    }
}
