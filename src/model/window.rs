//! All that inference keeps of one interaction window.

use std::collections::BTreeMap;

use nalgebra::{Matrix6, Vector3};
use serde::{Deserialize, Serialize};

use crate::math::Pose;
use crate::types::{AppliedWrench, Label};

/// A part's displacement in one frame, as registration measured it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseMeasurement {
    /// D, world frame, since the first frame.
    pub displacement: Pose,
    /// Information of ξ in `truth = D · T(c) · exp(ξ) · T(−c)`, ξ = (angular, linear).
    pub information: Matrix6<f64>,
}

/// The tool holding a part: its origin is a fixed point of the part plus a constant offset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Contact {
    /// The touched part.
    pub label: Label,
    /// Frames in contact with the tool's position in world \[m\] and its standard deviation \[m\].
    pub track: Vec<(usize, Vector3<f64>, f64)>,
}

/// One window's measurements, on the grid of its cloud stamps.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct WindowObservations {
    /// Seconds since time zero of each frame.
    pub times_s: Vec<f64>,
    /// Per part and frame, against the faces of the first look.
    pub poses: BTreeMap<Label, Vec<Option<PoseMeasurement>>>,
    /// Per part and frame, against the faces that came into view later: they stand where a fit put
    /// them, so these measure the displacement up to one unknown rigid error per part.
    pub later_faces: BTreeMap<Label, Vec<Option<PoseMeasurement>>>,
    /// Tool tracks.
    pub contacts: Vec<Contact>,
    /// Every wrench reading, from before the window to after it.
    pub wrenches: Vec<AppliedWrench>,
}
