//! The point-to-plane factor of one scan: cost, gradient and curvature in the part's pose.
//!
//! For a scan point x and the displacement D, y = D⁻¹ x is compared with its nearest surfel (m, n):
//! e = n · (y − m), with Student-t weights. The pose is perturbed on the right about the model's
//! centroid c: D(ξ) = D · T(c) · exp(ξ) · T(−c), so ∂e/∂ξ = −((y − c) × n, n), ξ = (angular, linear).

use nalgebra::{Matrix6, Vector3, Vector6};

use super::outline::height_over_unseen;
use super::{PartModel, ScanPoint};
use crate::math::{Pose, from_lengths, in_lengths, length_scale};

/// Cost of a point that matches nothing: the squared residual of three standard deviations, halved.
pub const OUTLIER_COST: f64 = 4.5;
/// Surfels are this far apart \[m\]: a point further off along the surface lies beyond a boundary.
const BOUNDARY_SLACK: f64 = 0.012;

/// Of a point that costs more no known surface is an account.
const UNMATCHED_COST: f64 = 1.0;
/// Standard deviation of a face about its plane beyond what was seen of it \[m\].
const UNSEEN_SIGMA: f64 = 0.004;

/// A part's other side is at most this far behind a face \[m\].
const THICKNESS: f64 = 0.040;

/// How scans are matched.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AlignmentSettings {
    /// Matches further apart than this are outliers \[m\].
    pub gate: f64,
    /// Degrees of freedom of the Student-t weights.
    pub student_freedom: f64,
    /// Standard deviation of a scan's boundary along the surface \[m\]; infinite: boundaries hold nothing.
    pub boundary_sigma: f64,
}

impl Default for AlignmentSettings {
    fn default() -> Self {
        Self { gate: 0.030, student_freedom: 3.0, boundary_sigma: 0.010 }
    }
}

/// A quadratic in ξ: curvature and gradient, (angular, linear).
#[derive(Clone, Copy, Debug)]
pub struct Quadratic {
    /// Curvature.
    pub hessian: Matrix6<f64>,
    /// Gradient.
    pub gradient: Vector6<f64>,
}

/// Quadratic model of a scan's cost about one pose.
#[derive(Clone, Debug)]
pub struct PoseFactor {
    /// By faces: those of the first look, and those that came into view later.
    pub faces: [Quadratic; 2],
    /// Robust cost: negative log likelihood up to a constant.
    pub cost: f64,
    /// Points that matched.
    pub matched: usize,
    /// Points in the scan.
    pub points: usize,
}

impl PoseFactor {
    /// Curvature over all faces.
    pub fn hessian(&self) -> Matrix6<f64> {
        self.faces[0].hessian + self.faces[1].hessian
    }

    /// Gradient over all faces.
    pub fn gradient(&self) -> Vector6<f64> {
        self.faces[0].gradient + self.faces[1].gradient
    }
}

impl Quadratic {
    /// What is left once what rough normals pretend to hold is taken off: each eigenvalue λ becomes
    /// max(λ − `false_share` · λ_max, 0), rotations scaled by the model's `radius` \[m\].
    pub fn cleaned(&self, radius: f64, false_share: f64) -> Self {
        self.reshaped(radius, |value, most| (value - false_share * most).max(0.0))
    }

    /// This with an error of its own that all points share \[m\].
    pub fn bounded(&self, radius: f64, shared_error: f64) -> Self {
        self.reshaped(radius, |value, _| if value > 0.0 { 1.0 / (1.0 / value + shared_error.powi(2)) } else { 0.0 })
    }

    /// Gives every eigenvalue a new value by itself and the largest; where the optimum is stays.
    fn reshaped(&self, radius: f64, value: impl Fn(f64, f64) -> f64) -> Self {
        let scale = length_scale(radius);
        let mut eigen = in_lengths(&self.hessian, radius).symmetric_eigen();
        let most = eigen.eigenvalues.max();
        let mut pull = eigen.eigenvectors.transpose() * self.gradient.component_div(&scale);
        for i in 0..6 {
            let before = eigen.eigenvalues[i];
            let after = value(before, most);
            pull[i] *= if before > 0.0 { after / before } else { 0.0 };
            eigen.eigenvalues[i] = after;
        }
        let gradient = (eigen.eigenvectors * pull).component_mul(&scale);
        Self { hessian: from_lengths(&eigen.recompose(), radius), gradient }
    }
}

/// The factor of a scan at a pose.
pub fn pose_factor(
    model: &PartModel,
    scan: &[ScanPoint],
    displacement: &Pose,
    settings: &AlignmentSettings,
) -> PoseFactor {
    let mut factor = PoseFactor {
        faces: [Quadratic { hessian: Matrix6::zeros(), gradient: Vector6::zeros() }; 2],
        cost: 0.0,
        matched: 0,
        points: scan.len(),
    };
    let reference_from_world = displacement.inverse();
    for scan_point in scan {
        let y = reference_from_world.transform_point(&scan_point.point_in_world);
        let Some(index) = matching_surfel(model, scan_point, &y, &reference_from_world) else {
            factor.cost += OUTLIER_COST;
            continue;
        };
        let surfel = &model.surfels[index];
        let offset = y - surfel.point;
        let e = surfel.normal.dot(&offset);
        if e.abs() > settings.gate {
            factor.cost += OUTLIER_COST;
            continue;
        }
        factor.matched += 1;
        let arm = y - model.centroid;
        factor.cost += add_residual(
            &mut factor.faces[usize::from(surfel.grown)],
            e,
            surfel.sigma,
            &surfel.normal,
            &arm,
            settings.student_freedom,
        );
        let along = offset - surfel.normal * e;
        let distance = along.norm();
        if distance > BOUNDARY_SLACK && settings.boundary_sigma.is_finite() {
            let direction = along / distance;
            let face = &mut factor.faces[usize::from(surfel.grown)];
            factor.cost += add_residual(
                face,
                distance - BOUNDARY_SLACK,
                settings.boundary_sigma,
                &direction,
                &arm,
                settings.student_freedom,
            );
        }
    }
    factor
}

/// Points of a scan that [`thinned_cost`] looks at, about.
const COST_POINTS: usize = 150;

/// What a point is that is seen from behind the face nearest to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FromBehind {
    /// It matches nothing: a pose that is free to move might pass all points for such.
    Outlier,
    /// It lies on the part's other side, which was not seen before: for motions of one degree of freedom.
    OtherSide,
}

/// [`truncated_cost`] by a few points of a scan: poses are compared with it all the time.
pub fn thinned_cost(model: &PartModel, scan: &[ScanPoint], displacement: &Pose) -> f64 {
    truncated_cost(model, scan, scan.len() / COST_POINTS, displacement, FromBehind::Outlier)
}

/// [`thinned_cost`] on a motion whose other poses show the same: the part's other side may come into view.
pub fn motion_cost(model: &PartModel, scan: &[ScanPoint], displacement: &Pose) -> f64 {
    truncated_cost(model, scan, scan.len() / COST_POINTS, displacement, FromBehind::OtherSide)
}

/// [`motion_cost`] of a part that nothing moves: where a face may go on beyond what was seen of it before, what comes
/// into view is no sign that the part moved.
pub fn rest_cost(model: &PartModel, scan: &[ScanPoint], displacement: &Pose) -> f64 {
    let reference_from_world = displacement.inverse();
    let cost = |scan_point: &ScanPoint, y: &Vector3<f64>| {
        let known = point_cost(model, scan_point, y, &reference_from_world, FromBehind::OtherSide);
        let eye = scan_point.viewpoint_in_world.filter(|_| known > UNMATCHED_COST);
        let view = eye.map(|eye| reference_from_world.transform_point(&eye) - y);
        let height = view.and_then(|view| height_over_unseen(model, y, &view));
        height.map_or(known, |height| (0.5 * (height / UNSEEN_SIGMA).powi(2)).min(known))
    };
    mean_cost(scan, scan.len() / COST_POINTS, &reference_from_world, cost)
}

/// Mean truncated cost per point, between 0 and `OUTLIER_COST`: for comparing far-apart poses.
pub fn truncated_cost(
    model: &PartModel,
    scan: &[ScanPoint],
    stride: usize,
    displacement: &Pose,
    from_behind: FromBehind,
) -> f64 {
    let reference_from_world = displacement.inverse();
    let cost =
        |scan_point: &ScanPoint, y: &Vector3<f64>| point_cost(model, scan_point, y, &reference_from_world, from_behind);
    mean_cost(scan, stride, &reference_from_world, cost)
}

/// The mean over every so many points, by the point and its place at the reference configuration.
fn mean_cost(
    scan: &[ScanPoint],
    stride: usize,
    reference_from_world: &Pose,
    cost: impl Fn(&ScanPoint, &Vector3<f64>) -> f64,
) -> f64 {
    let (mut sum, mut count) = (0.0, 0.0);
    for scan_point in scan.iter().step_by(stride.max(1)) {
        count += 1.0;
        sum += cost(scan_point, &reference_from_world.transform_point(&scan_point.point_in_world));
    }
    if count > 0.0 { sum / count } else { 0.0 }
}

fn point_cost(
    model: &PartModel,
    scan_point: &ScanPoint,
    y: &Vector3<f64>,
    reference_from_world: &Pose,
    from_behind: FromBehind,
) -> f64 {
    let facing = matching_surfel(model, scan_point, y, reference_from_world);
    let behind = || model.field.nearest(y)[0].filter(|_| from_behind == FromBehind::OtherSide);
    let Some(index) = facing.or_else(|| behind().map(|index| index as usize)) else { return OUTLIER_COST };
    let surfel = &model.surfels[index];
    let offset = y - surfel.point;
    let e = surfel.normal.dot(&offset);
    let along = ((offset - surfel.normal * e).norm() - BOUNDARY_SLACK).max(0.0);
    let height = if facing.is_some() { 0.5 * (e / surfel.sigma).powi(2) } else { back_cost(e, surfel.sigma) };
    (height + 0.5 * (along / 0.010).powi(2)).min(OUTLIER_COST)
}

/// Cost of a point seen from behind a face at a height over it \[m\]: on the part's other side, which was
/// not seen yet, anywhere within its thickness; nothing is seen through a face.
fn back_cost(height: f64, sigma: f64) -> f64 {
    let anywhere = (THICKNESS / (sigma * std::f64::consts::TAU.sqrt())).ln().max(0.0);
    anywhere + 0.5 * (height.max(-THICKNESS - height).max(0.0) / sigma).powi(2)
}

/// The nearest surfel that faces the sensor, if any is in reach.
fn matching_surfel(
    model: &PartModel,
    scan_point: &ScanPoint,
    y: &Vector3<f64>,
    reference_from_world: &Pose,
) -> Option<usize> {
    let [first, second] = model.field.nearest(y);
    let first = first? as usize;
    let Some(viewpoint) = scan_point.viewpoint_in_world else { return Some(first) };
    let view = reference_from_world.transform_point(&viewpoint) - y;
    let faces = |index: usize| !model.surfels[index].sided || model.surfels[index].normal.dot(&view) > 0.0;
    if faces(first) {
        return Some(first);
    }
    second.map(|index| index as usize).filter(|&index| faces(index))
}

/// Adds a residual along a direction at an arm from the centroid; returns its cost.
fn add_residual(
    face: &mut Quadratic,
    e: f64,
    sigma: f64,
    direction: &Vector3<f64>,
    arm: &Vector3<f64>,
    freedom: f64,
) -> f64 {
    let normalized = e / sigma;
    let weight = (freedom + 1.0) / (freedom + normalized * normalized) / (sigma * sigma);
    let moment = arm.cross(direction);
    let jacobian = -Vector6::new(moment.x, moment.y, moment.z, direction.x, direction.y, direction.z);
    face.hessian += jacobian * (jacobian * weight).transpose();
    face.gradient += jacobian * (weight * e);
    0.5 * (freedom + 1.0) * (normalized * normalized / freedom).ln_1p()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::Screw;
    use crate::registration::SurfelAccumulator;

    /// A lid of 30 cm × 30 cm × 12 mm hinged at x = 0, as a sensor in front of it and above sees it at an angle.
    fn scan_of_lid(screw: &Screw, angle: f64) -> Vec<ScanPoint> {
        let eye = Vector3::new(1.2, 0.0, 0.4);
        let lid = screw.displacement(angle);
        let eye_at_lid = lid.inverse().transform_point(&eye);
        let height = if eye_at_lid.z > 0.0 { 0.006 } else { -0.006 };
        let cell = |i: i32| (f64::from(i % 31) * 0.01, f64::from(i / 31) * 0.01 - 0.15);
        (0..31 * 31)
            .map(|i| ScanPoint {
                point_in_world: lid.transform_point(&Vector3::new(cell(i).0, cell(i).1, height)),
                viewpoint_in_world: Some(eye),
            })
            .collect()
    }

    #[test]
    fn a_lid_that_shows_its_underside_is_found_open() {
        let hinge = Screw::revolute(&-Vector3::y(), &Vector3::zeros());
        let mut accumulator = SurfelAccumulator::default();
        for _ in 0..3 {
            accumulator.add(&scan_of_lid(&hinge, 0.0), &Pose::identity());
        }
        let model = PartModel::new(&accumulator.surfels()).expect("enough surfels");
        let scan = scan_of_lid(&hinge, 1.0);
        assert!(thinned_cost(&model, &scan, &hinge.displacement(1.0)) > 0.9 * OUTLIER_COST, "nothing known is seen");
        let open = motion_cost(&model, &scan, &hinge.displacement(1.0));
        assert!(open < 0.8 * OUTLIER_COST, "{open}");
        let slide = Screw::prismatic(&Vector3::z());
        for elsewhere in [Pose::identity(), hinge.displacement(0.5), hinge.displacement(1.4), slide.displacement(0.12)]
        {
            let cost = motion_cost(&model, &scan, &elsewhere);
            assert!(cost > open + 0.3, "{cost} against {open}");
        }
    }

    #[test]
    fn nothing_is_seen_through_a_face() {
        assert!(back_cost(0.010, 0.002) > OUTLIER_COST);
        assert!(back_cost(-THICKNESS - 0.010, 0.002) > OUTLIER_COST);
        assert!(back_cost(-0.012, 0.002) < OUTLIER_COST);
    }
}
