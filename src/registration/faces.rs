//! Flat faces of a part, and the directions that they suggest for a joint's axis.

use nalgebra::Vector3;

use super::surfels::PartModel;

/// A flat face is this many surfels of one plane.
const FACE_SURFELS: usize = 40;
/// A plane is the edge of a face with this many times its surfels, if its normal is between 2° and 15° off.
const EDGE_SHARE: usize = 3;
const SAME_FACE_COSINE: f64 = 0.9994;
const EDGE_COSINE: f64 = 0.966;
/// A suggestion is within 15° of the axis.
const SUGGESTION_COSINE: f64 = 0.966;
/// Directions within 1° of each other are one.
const SAME_DIRECTION_COSINE: f64 = 0.99985;
/// Two normals are perpendicular to within 11°.
const PERPENDICULAR_SINE: f64 = 0.98;

/// A flat face.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Face {
    /// Unit normal, up to sign.
    pub normal: Vector3<f64>,
    /// How many surfels it has: its area.
    pub surfels: usize,
}

/// A direction that the shape suggests for an axis.
#[derive(Clone, Copy, Debug, PartialEq, serde::Serialize, serde::Deserialize)]
pub struct Suggestion {
    /// Unit vector, up to sign.
    pub direction: Vector3<f64>,
    /// Its share of all that is suggested, by the faces' areas.
    pub share: f64,
}

impl PartModel {
    /// The large flat faces seen at the first look.
    ///
    /// Normals are fitted over a radius, so edges grow planes of their own, a few degrees off the face they
    /// belong to: such a plane is no face.
    pub fn faces(&self) -> Vec<Face> {
        let mut faces: Vec<Face> = Vec::new();
        for surfel in self.surfels.iter().filter(|s| !s.grown) {
            match faces.iter_mut().find(|face| face.normal.dot(&surfel.normal).abs() > 1.0 - 1e-9) {
                Some(face) => face.surfels += 1,
                None => faces.push(Face { normal: surfel.normal, surfels: 1 }),
            }
        }
        let is_edge_of = |face: &Face, other: &Face| {
            let cosine = face.normal.dot(&other.normal).abs();
            other.surfels >= EDGE_SHARE * face.surfels && cosine > EDGE_COSINE && cosine < SAME_FACE_COSINE
        };
        let is_face = |face: &&Face| face.surfels >= FACE_SURFELS && !faces.iter().any(|other| is_edge_of(face, other));
        faces.iter().filter(is_face).copied().collect()
    }
}

/// The direction nearest to `axis` among the normals of the faces of `parts` and their common perpendiculars;
/// `None` beyond 15°. Parts count alike, and the directions of a part by the area of their faces.
pub fn suggested_direction<'a>(parts: impl Iterator<Item = &'a [Face]>, axis: &Vector3<f64>) -> Option<Suggestion> {
    let mut candidates: Vec<(Vector3<f64>, f64)> = Vec::new();
    let mut groups = 0;
    for faces in parts {
        let own = candidates.len();
        for (i, face) in faces.iter().enumerate() {
            candidates.push((face.normal, face.surfels as f64));
            candidates.extend(faces[..i].iter().filter_map(|other| {
                let cross = face.normal.cross(&other.normal);
                let area = face.surfels.min(other.surfels) as f64;
                (cross.norm() > PERPENDICULAR_SINE).then(|| (cross.normalize(), area))
            }));
        }
        let total: f64 = candidates[own..].iter().map(|(_, area)| area).sum();
        candidates[own..].iter_mut().for_each(|(_, area)| *area /= total);
        groups += usize::from(candidates.len() > own);
    }
    let (direction, _) = *candidates.iter().max_by(|(a, _), (b, _)| a.dot(axis).abs().total_cmp(&b.dot(axis).abs()))?;
    let same = candidates.iter().filter(|(other, _)| other.dot(&direction).abs() > SAME_DIRECTION_COSINE);
    let share = same.map(|(_, area)| area).sum::<f64>() / groups as f64;
    (direction.dot(axis).abs() > SUGGESTION_COSINE).then_some(Suggestion { direction, share })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::Surfel;

    /// A square of `side` × `side` surfels, its normal so many degrees off the vertical.
    fn square(side: u32, at: f64, tilt_deg: f64) -> impl Iterator<Item = Surfel> {
        let normal = Vector3::new(tilt_deg.to_radians().sin(), 0.0, tilt_deg.to_radians().cos());
        let along = Vector3::new(normal.z, 0.0, -normal.x);
        (0..side * side).map(move |i| {
            let point = along * (at + 0.01 * f64::from(i % side)) + Vector3::y() * (0.01 * f64::from(i / side));
            Surfel { point, normal, sigma: 0.002, sided: true, grown: false }
        })
    }

    #[test]
    fn what_an_edge_makes_of_a_face_is_no_face() {
        let normals = |tilt_deg: f64, side: u32| {
            let surfels: Vec<Surfel> = square(30, 0.0, 0.0).chain(square(side, 0.3, tilt_deg)).collect();
            PartModel::new(&surfels).expect("enough surfels").faces().len()
        };
        assert_eq!(normals(6.7, 8), 1, "a rim of the large face");
        assert_eq!(normals(0.3, 8), 2, "the same face seen from another side");
        assert_eq!(normals(40.0, 8), 2, "a bevel");
        assert_eq!(normals(6.7, 25), 2, "two faces of a size");
    }

    #[test]
    fn what_few_faces_suggest_counts_little() {
        let face = |normal: Vector3<f64>, surfels: usize| Face { normal: normal.normalize(), surfels };
        let body = [face(Vector3::x(), 500), face(Vector3::y(), 500)];
        let small = [face(Vector3::x(), 300), face(Vector3::new(0.06, 0.0, 1.0), 60)];
        let share = |axis: Vector3<f64>| {
            let parts = [&body[..], &small[..]];
            suggested_direction(parts.into_iter(), &axis.normalize()).map(|s| s.share)
        };
        let along = share(Vector3::new(1.0, 0.02, 0.0)).expect("near a normal");
        let odd = share(Vector3::new(0.05, 0.0, 1.0)).expect("near the small face");
        assert!(odd < 0.1 && along > 0.3, "{odd} {along}");
        assert_eq!(share(Vector3::new(1.0, 1.0, 0.0)), None);
    }
}
