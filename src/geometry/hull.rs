//! Volume, centre of mass and inertia of a part from the convex hull of its points.
//!
//! A hull sees only the visible faces, and a part may be hollow: what it says is a prior with a
//! width, not a measurement.

use nalgebra::{Matrix3, Vector3};
use parry3d_f64::mass_properties::MassProperties;
use parry3d_f64::transformation::try_convex_hull;
use serde::{Deserialize, Serialize};

/// Thinnest plate that a flat cloud is taken for \[m\]: panels and doors of furniture are 15 mm to
/// 25 mm, and a camera that sees one face cannot tell.
const PLATE_THICKNESS: f64 = 0.018;

/// Mass properties at unit density, uniform, of a part's convex hull.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct HullProperties {
    /// Volume \[m³\].
    pub volume: f64,
    /// Centre of the volume \[m\], in the frame of the points.
    pub center: Vector3<f64>,
    /// Second moment of volume about the centre \[m⁵\]: times density, the rotational inertia.
    pub inertia_per_density: Matrix3<f64>,
    /// Standard deviation of the points along each coordinate axis \[m\].
    pub spread: Vector3<f64>,
    /// The hull's vertices \[m\].
    pub vertices: Vec<Vector3<f64>>,
    /// The hull's triangles, as indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
}

/// The mass properties of the convex hull of `points` \[m\].
///
/// A flat cloud is given the thickness of a plate, away from `viewpoint` where one is known (the
/// face that is seen is the near one). `None` where fewer than four points, or points along a line,
/// span no volume.
pub fn hull_properties(points: &[Vector3<f64>], viewpoint: Option<&Vector3<f64>>) -> Option<HullProperties> {
    if points.len() < 4 {
        return None;
    }
    let count = points.len() as f64;
    let mean = points.iter().sum::<Vector3<f64>>() / count;
    let covariance = points.iter().map(|p| (p - mean) * (p - mean).transpose()).sum::<Matrix3<f64>>() / count;
    let eigen = covariance.symmetric_eigen();
    let thin = eigen.eigenvalues.imin();
    let normal: Vector3<f64> = eigen.eigenvectors.column(thin).into();
    let heights = points.iter().map(|p| (p - mean).dot(&normal));
    let (low, high) = heights.fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), x| (l.min(x), h.max(x)));
    let mut solid: Vec<_> = points.iter().map(|p| [p.x, p.y, p.z].into()).collect();
    if high - low < PLATE_THICKNESS {
        let side = viewpoint.map_or(0.0, |v| (v - mean).dot(&normal).signum());
        let shift = -normal * PLATE_THICKNESS;
        let (front, back) = match side {
            0.0 => (-0.5 * shift, 0.5 * shift),
            s => (Vector3::zeros(), s * shift),
        };
        solid = points.iter().flat_map(|p| [p + front, p + back]).map(|p| [p.x, p.y, p.z].into()).collect();
    }
    let (vertices, triangles) = try_convex_hull(&solid).ok()?;
    let properties = MassProperties::from_convex_polyhedron(1.0, &vertices, &triangles);
    let volume = properties.mass();
    if !(volume.is_finite() && volume > 1e-9) {
        return None;
    }
    let com = properties.local_com;
    let tensor = properties.reconstruct_inertia_matrix().to_cols_array_2d();
    let inertia = Matrix3::from_fn(|row, column| 0.5 * (tensor[column][row] + tensor[row][column]));
    Some(HullProperties {
        volume,
        center: Vector3::new(com.x, com.y, com.z),
        inertia_per_density: inertia,
        spread: covariance.diagonal().map(f64::sqrt),
        vertices: vertices.iter().map(|v| Vector3::new(v.x, v.y, v.z)).collect(),
        triangles,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn box_corners(size: Vector3<f64>, center: Vector3<f64>) -> Vec<Vector3<f64>> {
        (0..8)
            .map(|i| {
                let sign = |bit: i32| if i & bit == 0 { -0.5 } else { 0.5 };
                center + Vector3::new(sign(1) * size.x, sign(2) * size.y, sign(4) * size.z)
            })
            .collect()
    }

    #[test]
    fn a_box_has_the_textbook_inertia() {
        let size = Vector3::new(0.2, 0.4, 0.6);
        let center = Vector3::new(1.0, 2.0, 3.0);
        let hull = hull_properties(&box_corners(size, center), None).expect("a box has volume");
        let volume = 0.2 * 0.4 * 0.6;
        assert!((hull.volume - volume).abs() < 1e-12);
        assert!((hull.center - center).norm() < 1e-12);
        let expected = volume / 12.0 * Vector3::new(0.16 + 0.36, 0.04 + 0.36, 0.04 + 0.16);
        assert!((hull.inertia_per_density - Matrix3::from_diagonal(&expected)).norm() < 1e-12);
    }

    #[test]
    fn a_flat_cloud_becomes_a_plate_behind_the_seen_face() {
        let mut points = box_corners(Vector3::new(0.4, 0.6, 0.0), Vector3::zeros());
        points.dedup();
        let hull = hull_properties(&points, Some(&Vector3::new(0.0, 0.0, 2.0))).expect("a plate has volume");
        assert!((hull.center.z + 0.5 * PLATE_THICKNESS).abs() < 1e-9);
        assert!((hull.volume - 0.4 * 0.6 * PLATE_THICKNESS).abs() < 1e-9);
    }

    #[test]
    fn points_on_a_line_have_no_volume() {
        let line: Vec<_> = (0..10).map(|i| Vector3::new(f64::from(i), 0.0, 0.0)).collect();
        assert!(
            hull_properties(&line, None).is_none() || hull_properties(&line, None).is_some_and(|h| h.volume < 1e-6)
        );
    }
}
