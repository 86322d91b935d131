//! What is shown of a hull: a coarser one, and a box around it.

use nalgebra::{Matrix3, Vector3};
use parry3d_f64::transformation::try_convex_hull;

use super::HullProperties;

/// Edges shorter than this do not say how a box is turned \[m\].
const SHORT: f64 = 1e-6;

/// A closed surface of triangles, seen from outside counterclockwise.
#[derive(Clone, Debug, PartialEq)]
pub struct Surface {
    /// Corners \[m\].
    pub vertices: Vec<Vector3<f64>>,
    /// Triangles, as indices into `vertices`.
    pub triangles: Vec<[u32; 3]>,
}

/// A box that may be turned.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TurnedBox {
    /// Its middle \[m\].
    pub center: Vector3<f64>,
    /// Its own axes, as columns; a rotation.
    pub axes: Matrix3<f64>,
    /// Lengths along them \[m\].
    pub size: Vector3<f64>,
}

impl HullProperties {
    /// The hull of those vertices that are farthest in some direction, at most `most` of them: it lies
    /// within this one. Fewer than four make no hull, so that four are the least.
    pub fn coarse(&self, most: usize) -> Surface {
        let all = || Surface { vertices: self.vertices.clone(), triangles: self.triangles.clone() };
        let most = most.max(4);
        if self.vertices.len() <= most {
            return all();
        }
        let mut chosen = vec![false; self.vertices.len()];
        for direction in directions(most) {
            let height = |index: &usize| self.vertices[*index].dot(&direction);
            let farthest = (0..self.vertices.len()).max_by(|a, b| height(a).total_cmp(&height(b)));
            farthest.into_iter().for_each(|index| chosen[index] = true);
        }
        let kept: Vec<_> =
            self.vertices.iter().zip(&chosen).filter(|(_, chosen)| **chosen).map(|(v, _)| [v.x, v.y, v.z]).collect();
        let points: Vec<_> = kept.iter().map(|v| (*v).into()).collect();
        match try_convex_hull(&points) {
            Ok((vertices, triangles)) if !triangles.is_empty() => {
                Surface { vertices: vertices.iter().map(|v| Vector3::new(v.x, v.y, v.z)).collect(), triangles }
            }
            // Chosen vertices in one plane: the box has eight.
            _ => self.least_box().surface(),
        }
    }

    /// The smallest box around the hull that has a face on one of its triangles and an edge along one
    /// of that triangle's edges: for a box, itself.
    pub fn least_box(&self) -> TurnedBox {
        let corner = |index: u32| self.vertices.get(index as usize).copied().unwrap_or_default();
        let mut least = self.box_along(&Matrix3::identity());
        for triangle in &self.triangles {
            let [a, b, c] = triangle.map(corner);
            let Some(normal) = (b - a).cross(&(c - a)).try_normalize(SHORT * SHORT) else { continue };
            for edge in [b - a, c - b, a - c] {
                let Some(along) = edge.try_normalize(SHORT) else { continue };
                let other = self.box_along(&Matrix3::from_columns(&[along, normal.cross(&along), normal]));
                if other.size.product() < least.size.product() {
                    least = other;
                }
            }
        }
        least
    }

    fn box_along(&self, axes: &Matrix3<f64>) -> TurnedBox {
        let own = self.vertices.iter().map(|v| axes.transpose() * v);
        let first = own.clone().next().unwrap_or_default();
        let (low, high) = own.fold((first, first), |(low, high), v| (low.inf(&v), high.sup(&v)));
        TurnedBox { center: axes * (low + high) * 0.5, axes: *axes, size: high - low }
    }
}

impl TurnedBox {
    fn surface(&self) -> Surface {
        let corner = |index: usize| {
            let sign = |bit: usize| if index & bit == 0 { -0.5 } else { 0.5 };
            self.center + self.axes * self.size.component_mul(&Vector3::new(sign(1), sign(2), sign(4)))
        };
        let faces = [[0, 2, 3, 1], [4, 5, 7, 6], [0, 1, 5, 4], [2, 6, 7, 3], [0, 4, 6, 2], [1, 3, 7, 5]];
        let triangles = faces.iter().flat_map(|[a, b, c, d]| [[*a, *b, *c], [*a, *c, *d]]).collect();
        Surface { vertices: (0..8).map(corner).collect(), triangles }
    }
}

/// Unit vectors evenly over the sphere: a Fibonacci lattice.
fn directions(count: usize) -> impl Iterator<Item = Vector3<f64>> {
    let golden = std::f64::consts::PI * (3.0 - 5f64.sqrt());
    (0..count).map(move |index| {
        let z = 1.0 - (2 * index + 1) as f64 / count as f64;
        let (sin, cos) = (golden * index as f64).sin_cos();
        let radius = (1.0 - z * z).max(0.0).sqrt();
        Vector3::new(radius * cos, radius * sin, z)
    })
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::hull_properties;
    use nalgebra::Rotation3;

    /// Signed volume by the divergence theorem: positive where triangles face outwards.
    fn volume(surface: &Surface) -> f64 {
        let corner = |index: u32| surface.vertices[index as usize];
        let parts = surface.triangles.iter().map(|t| t.map(corner)).map(|[a, b, c]| a.dot(&b.cross(&c)) / 6.0);
        parts.sum()
    }

    fn turned_box(size: &Vector3<f64>) -> HullProperties {
        let rotation = Rotation3::from_euler_angles(0.3, -0.4, 0.9);
        let mut points = Vec::new();
        for (i, j, k) in (0..1000).map(|n| (n % 10, n / 10 % 10, n / 100)) {
            let unit = Vector3::new(f64::from(i), f64::from(j), f64::from(k)) / 9.0;
            points.push(rotation * unit.component_mul(size) + Vector3::new(1.0, 2.0, 3.0));
        }
        hull_properties(&points, None).unwrap()
    }

    #[test]
    fn the_box_around_a_box_is_itself() {
        let size = Vector3::new(0.4, 0.7, 0.02);
        let hull = turned_box(&size);
        let found = hull.least_box();
        let mut sizes: Vec<f64> = found.size.iter().copied().collect();
        sizes.sort_by(f64::total_cmp);
        for (found, expected) in sizes.iter().zip([0.02, 0.4, 0.7]) {
            assert!((found - expected).abs() < 1e-9, "{sizes:?}");
        }
        assert!((found.center - hull.center).norm() < 1e-9);
        assert!((found.axes.determinant() - 1.0).abs() < 1e-12);
        assert!((volume(&found.surface()) - hull.volume).abs() < 1e-9);
    }

    #[test]
    fn a_coarse_ball_is_inside_and_closed() {
        let points: Vec<_> = directions(2000).map(|d| d * 0.5).collect();
        let hull = hull_properties(&points, None).unwrap();
        let mut last = 0.0;
        for most in [8, 16, 32, 64, 5000] {
            let coarse = hull.coarse(most);
            assert!(coarse.vertices.len() <= most && coarse.triangles.len() <= 2 * most);
            let volume = volume(&coarse);
            assert!(volume > last && volume <= hull.volume + 1e-12, "{volume}");
            last = volume;
        }
        assert!((last - hull.volume).abs() < 1e-9);
    }

    #[test]
    fn a_coarse_box_keeps_its_corners() {
        let hull = turned_box(&Vector3::new(0.4, 0.7, 0.3));
        assert!((volume(&hull.coarse(24)) - hull.volume).abs() < 1e-6 * hull.volume);
    }
}
