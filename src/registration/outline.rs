//! The outline of a flat face: what holds a panel against sliding along itself.
//!
//! A ray that meets the face's plane at y either ends on the part (a hit) or ends on another part
//! behind the plane (a pass: the face is not there). With s the distance of y outside an edge,
//! P(hit) = ε + (1 − 2ε) Φ((s₀ − s)/σ): information from both sides, and none where neither is seen.
//! s₀ comes from the scans at the reference configuration, and an edge counts only if both hits and
//! passes were seen there: an edge of what happened to be visible is no edge of the part.

use nalgebra::{Matrix6, Vector3, Vector6};
use serde::{Deserialize, Serialize};

use super::{PartModel, Quadratic, ScanPoint, Surfel};
use crate::math::Pose;

/// Standard deviation of where a silhouette is seen: labels bleed and pixels have a size \[m\].
const EDGE_SIGMA: f64 = 0.006;
/// Share of rays near an edge with a wrong label.
const WRONG_SHARE: f64 = 0.05;
/// Labels are wrong up to this far from a silhouette \[m\], so that so many passes are needed farther off.
const BLEED: f64 = 0.010;
const FEWEST_CLEAR_RAYS: usize = 6;
/// Rays further than this from an edge say nothing of it \[m\].
const EDGE_REACH: f64 = 0.030;
/// A hit lies this close to the face's plane \[m\].
const HIT_HEIGHT: f64 = 0.015;
/// A pass may end this much in front of the plane \[m\].
const PASS_HEIGHT: f64 = 0.004;
/// Rays steeper to the plane than this see the face: cosine to its normal.
const STEEP: f64 = 0.25;
/// Hits and passes near an edge at the reference configuration, at least.
const FEWEST_RAYS: usize = 12;
/// An edge explains all but this share of the rays near it, or it is none.
const MOST_WRONG: f64 = 0.2;
/// A face has this many surfels in one plane.
const OUTLINE_SURFELS: usize = 20;
/// A ray surely meets a face this far inside its outline, and surely ends behind it beyond this depth \[m\].
const SURELY_INSIDE: f64 = 0.015;
const SURELY_BEHIND: f64 = 0.030;
/// A frame's outline is no better than this \[m\].
const FRAME_ERROR: f64 = 0.006;

/// One straight edge of a face.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
struct Edge {
    /// Unit vector in the plane, away from the face.
    outward: Vector3<f64>,
    /// s₀ + outward · centre \[m\].
    offset: f64,
}

/// A flat face with the edges that are trusted.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Outline {
    center: Vector3<f64>,
    /// Unit normal, towards the sensors.
    normal: Vector3<f64>,
    edges: Vec<Edge>,
    /// Half extents along the first two edges' directions, untrusted ones too \[m\].
    half: [f64; 2],
    axes: [Vector3<f64>; 2],
}

/// Where a ray meets the plane, and whether it ended on the part.
struct Crossing {
    place: Vector3<f64>,
    /// How far behind the plane it ended \[m\].
    depth: f64,
    hit: bool,
}

impl Outline {
    /// Outlines of the large faces of a part, rectangles until `calibrate` has seen their edges.
    pub fn of(surfels: &[Surfel]) -> Vec<Self> {
        let mut faces: Vec<Vec<&Surfel>> = Vec::new();
        for surfel in surfels.iter().filter(|s| s.sided && !s.grown) {
            let same = |face: &&mut Vec<&Surfel>| {
                let first = face[0];
                first.normal.dot(&surfel.normal) > 1.0 - 1e-9
                    && first.normal.dot(&(first.point - surfel.point)).abs() < 1e-6
            };
            match faces.iter_mut().find(same) {
                Some(face) => face.push(surfel),
                None => faces.push(vec![surfel]),
            }
        }
        faces.iter().filter(|face| face.len() >= OUTLINE_SURFELS).map(|face| Self::rectangle(face)).collect()
    }

    /// The smallest rectangle around most of the surfels.
    fn rectangle(face: &[&Surfel]) -> Self {
        let normal = face[0].normal;
        let (first, second) = crate::math::orthonormal_pair(&normal);
        let extent = |axis: &Vector3<f64>| {
            let mut along: Vec<f64> = face.iter().map(|s| axis.dot(&s.point)).collect();
            along.sort_by(f64::total_cmp);
            let trim = along.len() / 50;
            (along[trim], along[along.len() - 1 - trim])
        };
        let steps = 45;
        let best = (0..steps)
            .map(|i| {
                let angle = f64::from(i) * std::f64::consts::FRAC_PI_2 / f64::from(steps);
                let axes = [first * angle.cos() + second * angle.sin(), second * angle.cos() - first * angle.sin()];
                let [a, b] = [extent(&axes[0]), extent(&axes[1])];
                ((a.1 - a.0 + 0.01) * (b.1 - b.0 + 0.01), axes, a, b)
            })
            .min_by(|x, y| x.0.total_cmp(&y.0));
        let (axes, a, b) = best.map_or(([first, second], (0.0, 0.0), (0.0, 0.0)), |(_, axes, a, b)| (axes, a, b));
        let height = normal.dot(&face[0].point);
        let center = axes[0] * (0.5 * (a.0 + a.1)) + axes[1] * (0.5 * (b.0 + b.1)) + normal * height;
        let edges = [axes[0], -axes[0], axes[1], -axes[1]]
            .into_iter()
            .zip([a.1, -a.0, b.1, -b.0])
            .map(|(outward, offset)| Edge { outward, offset })
            .collect();
        Self { center, normal, edges, half: [0.5 * (a.1 - a.0), 0.5 * (b.1 - b.0)], axes }
    }

    /// Sets the edges by what was seen at the reference configuration, and drops those of which not
    /// both sides were. `scans`: the part's points and those of all others, by frame.
    pub fn calibrate(&mut self, scans: &[(&[ScanPoint], Vec<ScanPoint>)]) {
        let crossings: Vec<Crossing> = scans
            .iter()
            .flat_map(|(own, others)| self.crossings(own, others, &Pose::identity()).collect::<Vec<_>>())
            .collect();
        let edges = std::mem::take(&mut self.edges);
        let set = |edge: &Edge| {
            let near: Vec<(f64, bool)> = crossings
                .iter()
                .filter(|c| self.abreast(&c.place, edge))
                .map(|c| (edge.outward.dot(&c.place) - edge.offset, c.hit))
                .filter(|(s, _)| s.abs() < EDGE_REACH)
                .collect();
            let hits = near.iter().filter(|(_, hit)| *hit).count();
            if hits < FEWEST_RAYS || near.len() - hits < FEWEST_RAYS {
                return None;
            }
            let cost = |shift: f64| near.iter().map(|(s, hit)| edge_terms(s - shift, *hit).0).sum::<f64>();
            let shift = (-15..=15).map(|i| f64::from(i) * 0.001).min_by(|a, b| cost(*a).total_cmp(&cost(*b)))?;
            // Where another part stands in front nothing is seen beyond but its wrong labels.
            let clear = near.iter().filter(|(s, hit)| !hit && s - shift > BLEED).count();
            if clear < FEWEST_CLEAR_RAYS {
                return None;
            }
            let wrong = near.iter().filter(|(s, hit)| *hit != (*s < shift) && (s - shift).abs() > EDGE_SIGMA).count();
            ((wrong as f64) < MOST_WRONG * near.len() as f64).then_some(Edge { offset: edge.offset + shift, ..*edge })
        };
        self.edges = edges.iter().filter_map(set).collect();
    }

    /// How far a place is from the plane \[m\], where the face may go on there: past no edge that is trusted, and
    /// no farther than what was seen of it is long.
    fn height_where_it_goes_on(&self, place: &Vector3<f64>) -> Option<f64> {
        let from = place - self.center;
        let height = self.normal.dot(&from).abs();
        let past = |edge: &Edge| edge.outward.dot(place) > edge.offset + EDGE_SIGMA;
        let near = (0..2).all(|i| self.axes[i].dot(&from).abs() < 3.0 * self.half[i]);
        (height < HIT_HEIGHT && near && !self.edges.iter().any(past)).then_some(height)
    }

    /// Whether a place is beside an edge, not round a corner of the face.
    fn abreast(&self, place: &Vector3<f64>, edge: &Edge) -> bool {
        let across = usize::from(edge.outward.dot(&self.axes[0]).abs() > 0.5);
        self.axes[across].dot(&(place - self.center)).abs() < self.half[across] - EDGE_SIGMA
    }

    /// The rays of a scan that meet the face's plane where it is seen.
    fn crossings<'a>(
        &'a self,
        own: &'a [ScanPoint],
        others: &'a [ScanPoint],
        reference_from_world: &'a Pose,
    ) -> impl Iterator<Item = Crossing> + 'a {
        let rays = own.iter().map(|p| (p, true)).chain(others.iter().map(|p| (p, false)));
        let reach = self.half[0].hypot(self.half[1]) + EDGE_REACH;
        // The plane is carried to the many rays: few of them meet it.
        let center = reference_from_world.inverse().transform_point(&self.center);
        let normal = reference_from_world.rotation.tr_mul(&self.normal);
        rays.filter_map(move |(scan_point, hit)| {
            let end = scan_point.point_in_world;
            let height = normal.dot(&(end - center));
            if height > if hit { HIT_HEIGHT } else { PASS_HEIGHT } || (hit && height < -HIT_HEIGHT) {
                return None;
            }
            let ray = end - scan_point.viewpoint_in_world?;
            let fall = -normal.dot(&ray);
            if fall < STEEP * ray.norm() {
                return None;
            }
            let place = end + ray * (height / fall);
            let near = (place - center).norm_squared() < reach * reach;
            near.then(|| Crossing { place: reference_from_world.transform_point(&place), depth: -height, hit })
        })
    }

    /// Adds what a scan says of the face's edges to a quadratic in ξ about `centroid`.
    fn add(
        &self,
        own: &[ScanPoint],
        others: &[ScanPoint],
        reference_from_world: &Pose,
        centroid: &Vector3<f64>,
        into: &mut Quadratic,
    ) {
        for crossing in self.crossings(own, others, reference_from_world) {
            for edge in self.edges.iter().filter(|edge| self.abreast(&crossing.place, edge)) {
                let s = edge.outward.dot(&crossing.place) - edge.offset;
                if s.abs() > EDGE_REACH {
                    continue;
                }
                let (_, slope, curvature) = edge_terms(s, crossing.hit);
                let moment = (crossing.place - centroid).cross(&edge.outward);
                let out = edge.outward;
                let jacobian = -Vector6::new(moment.x, moment.y, moment.z, out.x, out.y, out.z);
                into.hessian += jacobian * (jacobian * curvature).transpose();
                into.gradient += jacobian * slope;
            }
        }
    }
}

/// The least distance of a place from the plane of a face that is seen along `view`, towards the sensor, and may go
/// on there \[m\].
pub fn height_over_unseen(model: &PartModel, place: &Vector3<f64>, view: &Vector3<f64>) -> Option<f64> {
    let facing = model.outlines.iter().filter(|outline| outline.normal.dot(view) > 0.0);
    facing.filter_map(|outline| outline.height_where_it_goes_on(place)).min_by(f64::total_cmp)
}

/// The share of rays that end behind a face where it has surface, of all that meet it there: what is
/// seen through is somewhere else. `others`: every so many points of the other parts.
pub fn seen_through(
    model: &PartModel,
    own: &[ScanPoint],
    (others, every): (&[ScanPoint], usize),
    displacement: &Pose,
) -> f64 {
    let reference_from_world = displacement.inverse();
    let (mut passes, mut hits) = (0.0, 0.0);
    for outline in &model.outlines {
        for crossing in outline.crossings(own, others, &reference_from_world) {
            let place = crossing.place - outline.center;
            let inside = (0..2).all(|i| outline.axes[i].dot(&place).abs() < outline.half[i] - SURELY_INSIDE);
            if !inside || !model.has_surface_at(&crossing.place) {
                continue;
            }
            match crossing.hit {
                true => hits += 1.0,
                false if crossing.depth > SURELY_BEHIND => passes += every as f64,
                false => {}
            }
        }
    }
    if passes < FEWEST_RAYS as f64 { 0.0 } else { passes / (passes + hits) }
}

/// What a scan says of where a part's outlines are, as a quadratic in ξ about the centroid \[m\].
/// `others`: the points of all other parts in the frame.
pub fn outline_quadratic(
    outlines: &[Outline],
    own: &[ScanPoint],
    others: &[ScanPoint],
    displacement: &Pose,
    centroid: &Vector3<f64>,
    radius: f64,
) -> Quadratic {
    let mut quadratic = Quadratic { hessian: Matrix6::zeros(), gradient: Vector6::zeros() };
    let reference_from_world = displacement.inverse();
    for outline in outlines.iter().filter(|outline| !outline.edges.is_empty()) {
        outline.add(own, others, &reference_from_world, centroid, &mut quadratic);
    }
    quadratic.bounded(radius, FRAME_ERROR)
}

/// The points of a frame's other parts whose rays come near a part at `center` \[m\].
pub fn rays_near<'a>(others: impl Iterator<Item = &'a ScanPoint>, center: &Vector3<f64>, reach: f64) -> Vec<ScanPoint> {
    let near = |p: &&ScanPoint| {
        p.viewpoint_in_world.is_some_and(|eye| {
            let (ray, there) = (p.point_in_world - eye, center - eye);
            let (along, length) = (ray.dot(&there), ray.norm_squared());
            // The square of the distance to the ray, times `length` where its nearest point is between the ends.
            if along <= 0.0 {
                there.norm_squared() < reach * reach
            } else if along >= length {
                (p.point_in_world - center).norm_squared() < reach * reach
            } else {
                there.norm_squared() * length - along * along < reach * reach * length
            }
        })
    };
    others.filter(near).copied().collect()
}

/// −ln P of a hit or a pass at a distance outside an edge, its slope, and its expected curvature.
fn edge_terms(s: f64, hit: bool) -> (f64, f64, f64) {
    let z = s / EDGE_SIGMA;
    let below = 0.5 * (1.0 + error_function(-z / std::f64::consts::SQRT_2));
    let density = (-0.5 * z * z).exp() / std::f64::consts::TAU.sqrt() * (1.0 - 2.0 * WRONG_SHARE) / EDGE_SIGMA;
    let p = WRONG_SHARE + (1.0 - 2.0 * WRONG_SHARE) * below;
    let (probability, slope) = if hit { (p, density / p) } else { (1.0 - p, -density / (1.0 - p)) };
    (-probability.ln(), slope, density * density / (p * (1.0 - p)))
}

/// The error function to 1.5e-7 (Abramowitz and Stegun 7.1.26).
fn error_function(x: f64) -> f64 {
    let t = 1.0 / (1.0 + 0.327_591_1 * x.abs());
    let series = [1.061_405_429, -1.453_152_027, 1.421_413_741, -0.284_496_736, 0.254_829_592];
    let polynomial = series.iter().fold(0.0, |sum, c| (sum + c) * t);
    (1.0 - polynomial * (-x * x).exp()).copysign(x)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::registration::{SurfelAccumulator, motion_cost, rest_cost};

    /// A board of 30 cm × 20 cm, 40 cm in front of a wall, as a sensor at the origin sees them.
    fn rays(shift: f64) -> (Vec<ScanPoint>, Vec<ScanPoint>) {
        let (mut board, mut wall) = (Vec::new(), Vec::new());
        for i in -40..=40 {
            for j in -40..=40 {
                let direction = Vector3::new(f64::from(i) * 0.0083, f64::from(j) * 0.0083, 1.0);
                let on_board = direction - Vector3::new(shift, 0.0, 0.0);
                let hit = on_board.x.abs() < 0.15 && on_board.y.abs() < 0.10;
                let point_in_world = if hit { direction } else { direction * 1.4 };
                let scan_point = ScanPoint { point_in_world, viewpoint_in_world: Some(Vector3::zeros()) };
                if hit { board.push(scan_point) } else { wall.push(scan_point) }
            }
        }
        (board, wall)
    }

    fn board() -> PartModel {
        let mut accumulator = SurfelAccumulator::default();
        let (own, others) = rays(0.0);
        accumulator.add(&own, &Pose::identity());
        let mut model = PartModel::new(&accumulator.surfels()).expect("enough surfels");
        model.calibrate_outlines(&[(&own, others)]);
        model
    }

    #[test]
    fn a_board_is_held_along_itself() {
        let model = board();
        assert_eq!(model.outlines.len(), 1);
        assert_eq!(model.outlines[0].edges.len(), 4);
        for shift in [-0.008, 0.004, 0.010] {
            let (own, others) = rays(shift);
            let q = outline_quadratic(&model.outlines, &own, &others, &Pose::identity(), &model.centroid, model.radius);
            let step = -q.gradient[3] / q.hessian[(3, 3)];
            assert!((step - shift).abs() < 0.003, "{shift}: {step}");
        }
    }

    #[test]
    fn a_board_that_has_gone_is_seen_through() {
        let model = board();
        let (own, others) = rays(0.0);
        assert!(seen_through(&model, &own, (&others, 1), &Pose::identity()) < 0.05);
        let (own, others) = rays(0.40);
        assert!(seen_through(&model, &own, (&others, 1), &Pose::identity()) > 0.9);
        let there = Pose::from_translation(Vector3::new(0.40, 0.0, 0.0));
        assert!(seen_through(&model, &own, (&others, 1), &there) < 0.05);
    }

    /// The left half of the board, the right one behind another part, of which `bleed` metres beside the gap look like
    /// parts of it in the board's plane; and the whole board.
    fn half_hidden(bleed: f64) -> (PartModel, Vec<ScanPoint>) {
        let (board, wall) = rays(0.0);
        let own: Vec<ScanPoint> = board.iter().filter(|p| p.point_in_world.x < 0.0).copied().collect();
        let wrong = board.iter().filter(|p| (0.0..bleed).contains(&p.point_in_world.x)).copied();
        let others = wall.into_iter().chain(wrong).collect();
        let mut accumulator = SurfelAccumulator::default();
        accumulator.add(&own, &Pose::identity());
        let mut model = PartModel::new(&accumulator.surfels()).expect("enough surfels");
        model.calibrate_outlines(&[(&own, others)]);
        (model, board)
    }

    #[test]
    fn what_stands_in_front_makes_no_edge() {
        let rightwards = |model: &PartModel| model.outlines[0].edges.iter().any(|edge| edge.outward.x > 0.9);
        assert!(!rightwards(&half_hidden(0.004).0));
        // A part beside it in the same plane does.
        assert!(rightwards(&half_hidden(0.030).0));
    }

    #[test]
    fn what_comes_into_view_beyond_a_hidden_edge_is_no_motion() {
        let (model, board) = half_hidden(0.004);
        assert!(motion_cost(&model, &board, &Pose::identity()) > 1.5);
        assert!(rest_cost(&model, &board, &Pose::identity()) < 0.5);
        let (model, board) = half_hidden(0.030);
        assert!(rest_cost(&model, &board, &Pose::identity()) > 1.5);
    }

    #[test]
    fn an_edge_that_was_hidden_holds_nothing() {
        let mut model = board();
        let (own, _) = rays(0.0);
        model.calibrate_outlines(&[(&own, Vec::new())]);
        assert!(model.outlines.iter().all(|outline| outline.edges.is_empty()));
    }
}
