//! The scans that a part's model grows from: a bounded number of them, of a bounded number of points.

use std::sync::Arc;

use nalgebra::Vector3;
use serde::{Deserialize, Serialize};

use crate::math::Pose;
use crate::registration::{ScanPoint, SurfelAccumulator};

/// Scans kept of each window, and in all.
const PER_WINDOW: usize = 10;
const MOST: usize = 40;
/// Points kept of a scan. Voxels average them over all scans: more of one add little.
const MOST_POINTS: usize = 1200;

/// Where a part was when a scan was taken.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub enum Place {
    /// In this frame of this kept window: where the fit has it now.
    Frame {
        /// Index of the window.
        window: usize,
        /// Index of the frame in it.
        frame: usize,
    },
    /// The window is gone; the last fit that knew it had the part here.
    Fixed(Pose),
}

/// One scan.
#[derive(Clone, Debug, PartialEq)]
struct Keyframe {
    place: Place,
    /// Shared by copies.
    scan: Arc<Vec<ScanPoint>>,
}

/// The scans of one part.
#[derive(Clone, Debug, Default, PartialEq, Serialize, Deserialize)]
pub struct Keyframes(Vec<Keyframe>);

impl Keyframes {
    /// Keeps some of a window's scans (by frame, `None` where there is none).
    pub fn keep<'a>(&mut self, window: usize, scans: impl ExactSizeIterator<Item = Option<&'a Vec<ScanPoint>>>) {
        let every = scans.len().div_ceil(PER_WINDOW).max(1);
        for (frame, scan) in scans.enumerate().step_by(every) {
            let Some(scan) = scan else { continue };
            let thin = scan.len().div_ceil(MOST_POINTS).max(1);
            let scan = Arc::new(scan.iter().step_by(thin).copied().collect());
            self.0.push(Keyframe { place: Place::Frame { window, frame }, scan });
        }
        while self.0.len() > MOST {
            // Thin out the older half.
            let mut index = 0;
            let half = self.0.len() / 2;
            self.0.retain(|_| {
                index += 1;
                index > half || index % 2 == 0
            });
        }
    }

    /// A window goes, in which the part went along `track`; later ones move up one place.
    pub fn retire(&mut self, window: usize, track: &[Pose]) {
        for keyframe in &mut self.0 {
            keyframe.place = match keyframe.place {
                Place::Frame { window: of, frame } if of == window => {
                    Place::Fixed(track.get(frame).copied().unwrap_or_else(Pose::identity))
                }
                Place::Frame { window: of, frame } if of > window => Place::Frame { window: of - 1, frame },
                place => place,
            };
        }
    }

    /// Where each scan belongs, `None` where that is not known; `tracks` by window and frame.
    pub fn places(&self, tracks: &[Vec<Pose>]) -> Vec<Option<Pose>> {
        let place = |keyframe: &Keyframe| match keyframe.place {
            Place::Frame { window, frame } => tracks.get(window).and_then(|track| track.get(frame)).copied(),
            Place::Fixed(displacement) => Some(displacement),
        };
        self.0.iter().map(place).collect()
    }

    /// All scans, each at its place.
    pub fn accumulated(&self, places: &[Option<Pose>]) -> SurfelAccumulator {
        let mut accumulator = SurfelAccumulator::default();
        for (keyframe, place) in self.0.iter().zip(places) {
            if let Some(displacement) = place {
                accumulator.add(&keyframe.scan, displacement);
            }
        }
        accumulator
    }
}

/// A scan without repeating its few viewpoints at every point.
#[derive(Serialize, Deserialize)]
struct StoredKeyframe {
    place: Place,
    viewpoints: Vec<Option<Vector3<f64>>>,
    /// x, y, z and the index of the viewpoint, point after point.
    points: Vec<(f64, f64, f64, usize)>,
}

impl Serialize for Keyframe {
    fn serialize<S: serde::Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        let mut viewpoints: Vec<Option<Vector3<f64>>> = Vec::new();
        let mut points = Vec::with_capacity(self.scan.len());
        for ScanPoint { point_in_world: p, viewpoint_in_world } in self.scan.iter() {
            let known = viewpoints.iter().position(|viewpoint| viewpoint == viewpoint_in_world);
            points.push((p.x, p.y, p.z, known.unwrap_or(viewpoints.len())));
            if known.is_none() {
                viewpoints.push(*viewpoint_in_world);
            }
        }
        StoredKeyframe { place: self.place, viewpoints, points }.serialize(serializer)
    }
}

impl<'de> Deserialize<'de> for Keyframe {
    fn deserialize<D: serde::Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let stored = StoredKeyframe::deserialize(deserializer)?;
        let point = |&(x, y, z, viewpoint): &(f64, f64, f64, usize)| {
            let viewpoint_in_world = *stored.viewpoints.get(viewpoint)?;
            Some(ScanPoint { point_in_world: Vector3::new(x, y, z), viewpoint_in_world })
        };
        let scan: Option<Vec<ScanPoint>> = stored.points.iter().map(point).collect();
        let scan = scan.ok_or_else(|| serde::de::Error::custom("a point of a viewpoint that is not there"))?;
        Ok(Self { place: stored.place, scan: Arc::new(scan) })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn scan(points: usize) -> Vec<ScanPoint> {
        let viewpoint = |i: usize| (!i.is_multiple_of(3)).then(|| Vector3::repeat(0.1 * (i % 3) as f64));
        (0..points)
            .map(|i| ScanPoint {
                point_in_world: Vector3::new(0.01 * i as f64, (i as f64).sin(), 1.0 / (i as f64 + 3.0)),
                viewpoint_in_world: viewpoint(i),
            })
            .collect()
    }

    #[test]
    fn a_long_stream_does_not_grow_them() {
        let mut keyframes = Keyframes::default();
        let scan = scan(5000);
        for window in 0..50 {
            keyframes.keep(window, (0..30).map(|_| Some(&scan)));
        }
        assert!(keyframes.0.len() <= MOST);
        assert!(keyframes.0.iter().all(|keyframe| keyframe.scan.len() <= MOST_POINTS));
    }

    #[test]
    fn a_window_that_goes_leaves_its_scans_where_they_were() {
        let mut keyframes = Keyframes::default();
        let scan = scan(40);
        for window in 0..3 {
            keyframes.keep(window, [Some(&scan), None].into_iter());
        }
        let place = |x: f64| Pose::from_translation(Vector3::x() * x);
        let mut tracks = vec![vec![place(0.0); 2], vec![place(1.0); 2], vec![place(2.0); 2]];
        let before = keyframes.accumulated(&keyframes.places(&tracks)).surfels();
        keyframes.retire(1, &tracks.remove(1));
        let places: Vec<Place> = keyframes.0.iter().map(|keyframe| keyframe.place).collect();
        let frame = |window| Place::Frame { window, frame: 0 };
        assert_eq!(places, [frame(0), Place::Fixed(place(1.0)), frame(1)]);
        assert_eq!(keyframes.accumulated(&keyframes.places(&tracks)).surfels(), before);
    }

    #[test]
    fn what_is_saved_reads_back_bit_by_bit() {
        let mut keyframes = Keyframes::default();
        keyframes.keep(0, [Some(&scan(7))].into_iter());
        let text = serde_json::to_string(&keyframes).unwrap();
        assert_eq!(serde_json::from_str::<Keyframes>(&text).unwrap(), keyframes);
        let broken = text.replace(",2]", ",9]");
        assert!(broken != text && serde_json::from_str::<Keyframes>(&broken).is_err());
    }
}
