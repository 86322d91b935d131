//! What is seen at one stamp.

use std::collections::BTreeMap;
use std::sync::Arc;

use nalgebra::Vector3;

use super::poses::{POSED_RADIUS, SeenPose};
use crate::registration::ScanPoint;
use crate::types::Label;

/// So many of a part's points may be nearer to a place than the part is said to be: wrong labels and flying pixels.
const STRAY_POINTS: usize = 3;

/// The clouds of one stamp, by part.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    /// Seconds since time zero.
    pub time_s: f64,
    /// Each part's points, shared by all who keep the frame.
    pub scans: Arc<BTreeMap<Label, Vec<ScanPoint>>>,
    /// The parts whose pose a topic measures; they have no scans.
    pub poses: BTreeMap<Label, SeenPose>,
    /// Whether one of these moves.
    pub moves: bool,
}

impl Frame {
    /// From a place to a part as it is seen, by all but its few nearest points \[m\]; `None` where it is not seen.
    pub(super) fn distance(&self, place: &Vector3<f64>, label: Label) -> Option<f64> {
        if let Some(seen) = self.poses.get(&label) {
            return Some(((seen.world_from_frame.translation - place).norm() - POSED_RADIUS).max(0.0));
        }
        let mut distances: Vec<f64> =
            self.scans.get(&label)?.iter().map(|p| (p.point_in_world - place).norm()).collect();
        let rank = STRAY_POINTS.min(distances.len().checked_sub(1)?);
        distances.select_nth_unstable_by(rank, f64::total_cmp);
        Some(distances[rank])
    }

    /// The part nearest to a place, and how near \[m\].
    pub(super) fn nearest(&self, place: &Vector3<f64>) -> Option<(Label, f64)> {
        let labels = self.scans.keys().chain(self.poses.keys());
        labels.filter_map(|label| Some((*label, self.distance(place, *label)?))).min_by(|a, b| a.1.total_cmp(&b.1))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_few_wrong_labels_near_a_place_decide_nothing() {
        let point = |x: f64| ScanPoint { point_in_world: Vector3::new(x, 0.0, 0.0), viewpoint_in_world: None };
        let scan = |near: &[f64], far: f64| near.iter().copied().chain([far; 20]).map(point).collect();
        let scans = BTreeMap::from([(Label(1), scan(&[0.0, 0.001, 0.002], 0.5)), (Label(2), scan(&[], 0.03))]);
        let frame = Frame { scans: Arc::new(scans), ..Frame::default() };
        assert_eq!(frame.nearest(&Vector3::zeros()).map(|(label, _)| label), Some(Label(2)));
        assert_eq!(frame.distance(&Vector3::zeros(), Label(3)), None);
    }
}
