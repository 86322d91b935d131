//! First guesses of a joint's axis: lines and circles through a point's track, and the part's own
//! geometry.

use nalgebra::{Matrix3, Vector3};

use super::PartModel;
use crate::math::Screw;

/// A direction and, where it turns, a point of the axis.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AxisSeed {
    /// Unit direction.
    pub direction: Vector3<f64>,
    /// A point on the axis \[m\]; `None` for a translation.
    pub point: Option<Vector3<f64>>,
}

impl AxisSeed {
    /// The seed's screw.
    pub fn screw(&self) -> Screw {
        match &self.point {
            Some(point) => Screw::revolute(&self.direction, point),
            None => Screw::prismatic(&self.direction),
        }
    }
}

/// The line through a track, with its root-mean-square residual \[m\]; `None` for fewer than three
/// points or a track shorter than 5 mm.
pub fn fit_line(track: &[Vector3<f64>]) -> Option<(AxisSeed, f64)> {
    let (_, vectors, values) = scatter(track)?;
    let residual = (values[0] + values[1]).max(0.0).sqrt();
    (values[2].sqrt() > 0.0025).then_some((AxisSeed { direction: vectors[2], point: None }, residual))
}

/// The circle through a track (Kåsa's linear fit in the track's plane), with its root-mean-square
/// residual \[m\]; `None` for a track that is straight to its own noise.
pub fn fit_circle(track: &[Vector3<f64>]) -> Option<(AxisSeed, f64)> {
    let (mean, vectors, values) = scatter(track)?;
    if values[2].sqrt() < 0.0025 || values[1] <= 0.0 {
        return None;
    }
    let normal = vectors[0];
    let (u, v) = (vectors[2], vectors[1]);
    let mut matrix = Matrix3::zeros();
    let mut right = Vector3::zeros();
    for point in track {
        let d = point - mean;
        let row = Vector3::new(d.dot(&u), d.dot(&v), 1.0);
        matrix += row * row.transpose();
        right += row * (row.x * row.x + row.y * row.y);
    }
    let solution = matrix.try_inverse()? * right;
    let (a, b) = (0.5 * solution.x, 0.5 * solution.y);
    let radius = (solution.z + a * a + b * b).max(0.0).sqrt();
    if !(radius.is_finite() && radius < 3.0) {
        return None;
    }
    let center = mean + u * a + v * b;
    let sum: f64 = track
        .iter()
        .map(|point| {
            let d = point - center;
            let height = d.dot(&normal);
            ((d - normal * height).norm() - radius).powi(2) + height * height
        })
        .sum();
    Some((AxisSeed { direction: normal, point: Some(center) }, (sum / track.len() as f64).sqrt()))
}

/// Axes that the part's shape suggests: translations along the normals of its large faces, and
/// hinges along the edges of its bounding box in the frame of those faces.
pub fn geometric_seeds(model: &PartModel, world_directions: &[Vector3<f64>]) -> Vec<AxisSeed> {
    let frame = principal_frame(model);
    let mut directions: Vec<Vector3<f64>> = frame.to_vec();
    for direction in world_directions {
        if directions.iter().all(|d| d.dot(direction).abs() < 0.98) {
            directions.push(*direction);
        }
    }
    let mut seeds: Vec<AxisSeed> = directions.iter().map(|&direction| AxisSeed { direction, point: None }).collect();
    let (mut low, mut high) = ([f64::INFINITY; 3], [f64::NEG_INFINITY; 3]);
    for surfel in &model.surfels {
        for axis in 0..3 {
            let height = (surfel.point - model.centroid).dot(&frame[axis]);
            low[axis] = low[axis].min(height);
            high[axis] = high[axis].max(height);
        }
    }
    for axis in 0..3 {
        let (first, second) = ((axis + 1) % 3, (axis + 2) % 3);
        let middle = [0.5 * (low[first] + high[first]), 0.5 * (low[second] + high[second])];
        let corners = [
            [low[first], low[second]],
            [low[first], high[second]],
            [high[first], low[second]],
            [high[first], high[second]],
            middle,
        ];
        for [a, b] in corners {
            let point = model.centroid + frame[first] * a + frame[second] * b;
            seeds.push(AxisSeed { direction: frame[axis], point: Some(point) });
        }
    }
    seeds
}

/// An orthonormal frame aligned with the part's faces: the commonest normal, then the direction
/// across it in which the part is longest.
fn principal_frame(model: &PartModel) -> [Vector3<f64>; 3] {
    let normals = model.surfels.iter().map(|s| s.normal * s.normal.transpose()).sum::<Matrix3<f64>>().symmetric_eigen();
    let normal: Vector3<f64> = normals.eigenvectors.column(normals.eigenvalues.imax()).into();
    let flat = Matrix3::identity() - normal * normal.transpose();
    let spread = model
        .surfels
        .iter()
        .map(|s| {
            let d = flat * (s.point - model.centroid);
            d * d.transpose()
        })
        .sum::<Matrix3<f64>>()
        .symmetric_eigen();
    let long: Vector3<f64> = spread.eigenvectors.column(spread.eigenvalues.imax()).into();
    [normal, long, normal.cross(&long)]
}

/// Mean, eigenvectors and eigenvalues (ascending) of a track's covariance.
type Scatter = (Vector3<f64>, [Vector3<f64>; 3], [f64; 3]);

fn scatter(track: &[Vector3<f64>]) -> Option<Scatter> {
    if track.len() < 3 {
        return None;
    }
    let count = track.len() as f64;
    let mean = track.iter().sum::<Vector3<f64>>() / count;
    let eigen =
        (track.iter().map(|p| (p - mean) * (p - mean).transpose()).sum::<Matrix3<f64>>() / count).symmetric_eigen();
    let mut order = [0, 1, 2];
    order.sort_by(|&a, &b| eigen.eigenvalues[a].total_cmp(&eigen.eigenvalues[b]));
    Some((mean, order.map(|i| eigen.eigenvectors.column(i).into()), order.map(|i| eigen.eigenvalues[i].max(0.0))))
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn circle_and_line_recover_their_axes() {
        let axis = Vector3::new(0.1, -0.2, 1.0).normalize();
        let center = Vector3::new(0.4, 0.5, 0.6);
        let screw = Screw::revolute(&axis, &center);
        let start = center + Vector3::new(0.3, 0.1, -0.2);
        let arc: Vec<_> = (0..30).map(|k| screw.displacement(0.03 * f64::from(k)).transform_point(&start)).collect();
        let (seed, residual) = fit_circle(&arc).expect("an arc");
        assert!(residual < 1e-9);
        assert!((seed.direction.dot(&axis).abs() - 1.0).abs() < 1e-9);
        let point = seed.point.expect("a centre");
        assert!((point - center).cross(&axis).norm() < 1e-9);

        let line: Vec<_> = (0..30).map(|k| start + axis * 0.01 * f64::from(k)).collect();
        let (seed, residual) = fit_line(&line).expect("a line");
        assert!(residual < 1e-9);
        assert!((seed.direction.dot(&axis).abs() - 1.0).abs() < 1e-9);
    }
}
