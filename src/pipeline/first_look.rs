//! The object at rest, as it was seen before anything touched it: what the reference models are made of.

use std::collections::BTreeMap;
use std::fmt;

use nalgebra::Vector3;

use super::poses::{PosedPart, references};
use super::{Frame, Learner, PipelineSettings};
use crate::math::Pose;
use crate::model::DynamicsLearner;
use crate::registration::SurfelAccumulator;
use crate::types::Label;

/// Frames of the first look that the reference models are made of.
pub(super) const REFERENCE_FRAMES: usize = 20;

/// Frames at rest, with what a learner begins with beside them.
pub struct FirstLook {
    pub(super) frames: Vec<Frame>,
    pub(super) settings: PipelineSettings,
    /// In the working frame \[m/s²\].
    pub(super) gravity: Vector3<f64>,
    /// Whether it lasted until the first contact: else more frames are to come.
    pub(super) whole: bool,
}

impl fmt::Debug for FirstLook {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let mut shown = f.debug_struct("FirstLook");
        shown.field("frames", &self.frames.len()).field("whole", &self.whole).finish_non_exhaustive()
    }
}

impl FirstLook {
    /// A learner that knows the parts as they stand, and nothing of how they move.
    pub(super) fn learner(&self) -> Learner {
        let mut accumulators: BTreeMap<Label, SurfelAccumulator> = BTreeMap::new();
        let every = self.frames.len().div_ceil(REFERENCE_FRAMES).max(1);
        for frame in self.frames.iter().step_by(every) {
            for (label, scan) in frame.scans.iter() {
                accumulators.entry(*label).or_default().add(scan, &Pose::identity());
            }
        }
        let settings = &self.settings;
        let posed = references(&self.frames);
        let largest = accumulators.iter().max_by_key(|(_, a)| a.voxel_means(1.0).len()).map(|(label, _)| *label);
        let root = settings.root.or(largest).unwrap_or_else(|| unused_label(&posed));
        let mut learner = Learner::new(root, settings.use_tool, accumulators);
        learner.settings = settings.kinematics;
        learner.sampling = settings.sampling;
        learner.kept_windows = settings.windows.kept;
        learner.root_is_given = settings.root.is_some();
        learner.dynamics = DynamicsLearner::new(self.gravity).declaring(settings.declared.clone());
        learner.calibrate(&self.frames);
        learner.world = (settings.root.is_none() && largest.is_none()).then_some(root);
        for (label, part) in posed {
            learner.add_posed(label, part);
        }
        learner
    }
}

/// A name for the world, where it is none of the parts.
fn unused_label(parts: &BTreeMap<Label, PosedPart>) -> Label {
    (0..).map(Label).find(|label| !parts.contains_key(label)).unwrap_or_default()
}
