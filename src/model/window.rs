//! All that inference keeps of one interaction window.

use std::collections::BTreeMap;

use nalgebra::{Matrix3, Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use crate::math::{Pose, from_lengths, in_lengths};
use crate::types::{AppliedWrench, Label};

/// A part's displacement in one frame, as registration measured it.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct PoseMeasurement {
    /// D, world frame, since the first frame.
    pub displacement: Pose,
    /// Information of ξ in `truth = D · T(c) · exp(ξ) · T(−c)`, ξ = (angular, linear).
    pub information: Matrix6<f64>,
}

impl PoseMeasurement {
    /// Whether it says anything of the rotation; if not, `displacement` only carries the measured point.
    pub fn rotation_is_measured(&self) -> bool {
        self.information.fixed_view::<3, 3>(0, 0).amax() > 0.0
    }

    /// How many numbers were measured.
    pub fn dimensions(&self) -> f64 {
        if self.rotation_is_measured() { 6.0 } else { 3.0 }
    }

    /// Where the measured point, which is `center` at the reference configuration, is now \[m\].
    pub fn point(&self, center: &Vector3<f64>) -> Vector3<f64> {
        self.displacement.transform_point(center)
    }

    /// What is left of the measurement at a predicted displacement, ξ = (angular, linear) as in
    /// `information`, and `information` (the measurement's own, or a weaker one) in its axes.
    ///
    /// log(T(−c) D_measured⁻¹ D_predicted T(c)). A point alone has no rotation to compare with: what
    /// it misses is Rᵀ (D_predicted c − x).
    pub fn compare(
        &self,
        information: &Matrix6<f64>,
        center: &Vector3<f64>,
        predicted: &Pose,
    ) -> (Vector6<f64>, Matrix6<f64>) {
        if self.rotation_is_measured() {
            let inverse = self.displacement.rotation.transpose();
            let miss = Pose {
                rotation: inverse * predicted.rotation,
                translation: inverse * (predicted.transform_point(center) - self.displacement.translation) - center,
            };
            return (miss.log(), *information);
        }
        let linear = predicted.rotation.transpose() * (predicted.transform_point(center) - self.point(center));
        let turn = self.displacement.rotation.transpose() * predicted.rotation;
        let block: Matrix3<f64> = information.fixed_view::<3, 3>(3, 3).into();
        let mut turned = Matrix6::zeros();
        turned.fixed_view_mut::<3, 3>(3, 3).copy_from(&(turn.transpose() * block * turn));
        (Vector6::new(0.0, 0.0, 0.0, linear.x, linear.y, linear.z), turned)
    }
}

/// The tool holding a part: its origin is a fixed point of the part plus a constant offset.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Contact {
    /// The touched part.
    pub label: Label,
    /// Frames in contact with the tool's position in world \[m\] and its standard deviation \[m\].
    pub track: Vec<(usize, Vector3<f64>, f64)>,
}

impl Contact {
    /// The tool's position in a frame \[m\].
    pub fn position(&self, frame: usize) -> Option<Vector3<f64>> {
        self.track.iter().find(|(k, _, _)| *k == frame).map(|(_, x, _)| *x)
    }
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
    /// Parts whose `poses` come from a pose topic, not from registration: their errors are what they are
    /// stated to be, from frame to frame independent, about one error of the pose that displacements are
    /// counted from. Its information is given here, ξ as in [`PoseMeasurement`].
    pub direct: BTreeMap<Label, Matrix6<f64>>,
    /// Tool tracks.
    pub contacts: Vec<Contact>,
    /// Every wrench reading, from before the window to after it.
    pub wrenches: Vec<AppliedWrench>,
    /// Of how many streams the object had been learned before this window's.
    #[serde(default)]
    pub stream: usize,
}

impl WindowObservations {
    /// The measurement that a part's place in a frame was taken from, noise and all; `None` where the
    /// place comes from a fit, or the rotation was not measured.
    pub fn own_measurement(&self, label: Label, frame: usize, place: &Pose) -> Option<&PoseMeasurement> {
        self.direct.get(&label)?;
        let own = self.poses.get(&label)?.get(frame)?.as_ref()?;
        (own.displacement == *place && own.rotation_is_measured()).then_some(own)
    }
}

/// Information of a pose with an error of this variance \[m²\] that other measurements have too; rotations
/// count by `radius` \[m\]. `None` where it is not positive semidefinite.
pub fn with_shared_error(information: &Matrix6<f64>, radius: f64, variance: f64) -> Option<Matrix6<f64>> {
    let scaled = in_lengths(information, radius);
    // (Λ⁻¹ + s I)⁻¹ = (I + s Λ)⁻¹ Λ, which stands where Λ is singular.
    let shared = (Matrix6::identity() + scaled * variance).cholesky()?.solve(&scaled);
    Some(from_lengths(&((shared + shared.transpose()) * 0.5), radius))
}
