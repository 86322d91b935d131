//! `~/markers`: hulls, axes with their uncertainty, edge probabilities.
//!
//! Everything is given where it was at the first frame and carried by the marker's pose, the part's
//! displacement since. Ids are labels, so that a later message replaces an earlier one.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Matrix4, Vector2, Vector3};
use ros2_interfaces_jazzy_serde::{
    geometry_msgs::msg::{Point, Vector3 as Vector3Message},
    std_msgs::msg::ColorRGBA,
    visualization_msgs::msg::{Marker, MarkerArray},
};

use super::convert::{FixedFrame, MOST_BYTES, encoded_bytes, point, pose};
use super::link_tree::{Link, LinkJoint, LinkTree};
use crate::geometry::{HullProperties, Surface};
use crate::math::{Pose, orthonormal_pair};
use crate::types::posterior::{EdgePosterior, ObjectPosterior};
use crate::types::{Label, Stamp};

/// Bytes that all hulls together may take; the rest is for axes and texts.
const HULL_BYTES: usize = 50_000;
/// Bytes of a triangle, and of what a hull's marker has besides.
const TRIANGLE_BYTES: usize = 72;
const MARKER_BYTES: usize = 300;
/// Vertices of a shown hull.
const HULL_VERTICES: (usize, usize) = (8, 64);
/// Half an axis's length at least \[m\].
const LEAST_REACH: f64 = 0.15;
/// An axis's shaft and head \[m\].
const ARROW: (f64, f64, f64) = (0.01, 0.02, 0.04);
/// Points around an uncertainty's rim.
const RIM: usize = 16;
/// √ of the 90 % quantile of χ² with two degrees of freedom.
const TWO_DIMENSIONAL_90: f64 = 2.145_966_026_289_347;
/// A cone is drawn no wider than this many times its length: beyond, nothing is known of the direction.
const WIDEST: f64 = 1.0;
/// Height of the texts \[m\].
const TEXT_HEIGHT: f64 = 0.04;
/// Edges less likely are not told.
const TOLD: f64 = 0.05;

const PRISMATIC: ColorRGBA = ColorRGBA { r: 1.0, g: 1.0, b: 0.0, a: 1.0 };
const REVOLUTE: ColorRGBA = ColorRGBA { r: 1.0, g: 0.0, b: 1.0, a: 1.0 };
const WHITE: ColorRGBA = ColorRGBA { r: 1.0, g: 1.0, b: 1.0, a: 1.0 };

/// What is shown.
#[derive(Clone, Copy, Debug)]
pub struct Picture<'a> {
    /// The likeliest tree.
    pub tree: &'a LinkTree,
    /// The posterior it is of.
    pub posterior: &'a ObjectPosterior,
    /// Hulls of the parts, world at the first frame.
    pub hulls: &'a BTreeMap<Label, HullProperties>,
    /// Where the parts are since then; what is not given stands still.
    pub displacements: &'a BTreeMap<Label, Pose>,
}

/// The picture as messages, each below [`MOST_BYTES`]; one unless there are very many parts. What cannot
/// be shown with finite numbers is left out.
pub fn markers(picture: &Picture<'_>, frame: &FixedFrame, stamp: Stamp) -> Vec<MarkerArray> {
    let links = picture.tree.links();
    let of_each = HULL_BYTES / links.len().max(1);
    let triangles = of_each.saturating_sub(MARKER_BYTES) / TRIANGLE_BYTES;
    let vertices = (triangles / 2 + 2).clamp(HULL_VERTICES.0, HULL_VERTICES.1);
    let mut all = Vec::new();
    for link in links {
        let displacement = picture.displacements.get(&link.label).copied().unwrap_or_else(Pose::identity);
        let marker = |namespace: &str| Marker {
            header: frame.header(stamp),
            ns: namespace.to_owned(),
            id: link.label.0 as i32,
            pose: pose(&displacement),
            scale: Vector3Message { x: 1.0, y: 1.0, z: 1.0 },
            ..Marker::default()
        };
        let hull = picture.hulls.get(&link.label);
        if let Some(hull) = hull {
            all.push(surface_marker(marker("parts"), &hull.coarse(vertices), part_color(link.label)));
        }
        let axis = axis_markers(link, picture.posterior, hull, marker("axes"), marker("uncertainty"));
        all.extend(axis.unwrap_or_else(|| ["axes", "uncertainty"].map(|name| deleted(marker(name)))));
        all.push(text_marker(marker("edges"), link, picture.posterior, &displacement));
    }
    all.retain(is_finite);
    split(all)
}

/// What removes everything shown before, as after a reset.
pub fn no_markers(frame: &FixedFrame, stamp: Stamp) -> MarkerArray {
    let marker = Marker { header: frame.header(stamp), action: Marker::DELETEALL, ..Marker::default() };
    MarkerArray { markers: vec![marker] }
}

/// Messages below [`MOST_BYTES`], in order.
fn split(markers: Vec<Marker>) -> Vec<MarkerArray> {
    let mut messages = vec![MarkerArray { markers: Vec::new() }];
    let mut bytes = 0;
    for marker in markers {
        // In a sequence an element may be moved by its alignment.
        let own = encoded_bytes(&marker) + 8;
        if bytes + own > MOST_BYTES - 16 {
            messages.push(MarkerArray { markers: Vec::new() });
            bytes = 0;
        }
        bytes += own;
        if let Some(last) = messages.last_mut() {
            last.markers.push(marker);
        }
    }
    messages
}

fn is_finite(marker: &Marker) -> bool {
    let (p, q) = (&marker.pose.position, &marker.pose.orientation);
    let pose = [p.x, p.y, p.z, q.x, q.y, q.z, q.w].into_iter().all(f64::is_finite);
    pose && marker.points.iter().all(|p| p.x.is_finite() && p.y.is_finite() && p.z.is_finite())
}

fn deleted(marker: Marker) -> Marker {
    Marker { action: Marker::DELETE, ..marker }
}

fn surface_marker(marker: Marker, surface: &Surface, color: ColorRGBA) -> Marker {
    let corner = |index: &u32| surface.vertices.get(*index as usize).map_or_else(Point::default, point);
    Marker {
        type_: Marker::TRIANGLE_LIST,
        color,
        points: surface.triangles.iter().flatten().map(corner).collect(),
        ..marker
    }
}

/// Hues by the golden angle: neighbouring labels differ.
fn part_color(label: Label) -> ColorRGBA {
    let hue = f64::from(label.0) * 0.618_033_988_749_895;
    let channel = |shift: f64| {
        let wave = ((hue + shift) * std::f64::consts::TAU).cos();
        (0.55 + 0.3 * wave) as f32
    };
    ColorRGBA { r: channel(0.0), g: channel(1.0 / 3.0), b: channel(2.0 / 3.0), a: 0.6 }
}

/// The axis of a joint that moves and how well it is known.
fn axis_markers(
    link: &Link,
    posterior: &ObjectPosterior,
    hull: Option<&HullProperties>,
    axis: Marker,
    uncertainty: Marker,
) -> Option<[Marker; 2]> {
    let edge = posterior.edges.get(link.edge?)?;
    let direction = link.joint.direction()?;
    let (color, covariance) = match link.joint {
        LinkJoint::Fixed | LinkJoint::Floating => return None,
        LinkJoint::Prismatic { .. } => (PRISMATIC, prismatic_covariance(edge)?),
        LinkJoint::Revolute { .. } => (REVOLUTE, Matrix4::from(edge.revolute.as_ref()?.covariance)),
    };
    let reach = hull.map_or(LEAST_REACH, |hull| reach(hull, &link.origin, &direction));
    let (shaft, head, head_length) = ARROW;
    let arrow = Marker {
        type_: Marker::ARROW,
        scale: Vector3Message { x: shaft, y: head, z: head_length },
        color: color.clone(),
        points: [-reach, reach].map(|along| point(&(link.origin + direction * along))).to_vec(),
        ..axis
    };
    let tube = tube(&link.origin, &direction, &covariance, reach);
    Some([arrow, surface_marker(uncertainty, &tube, ColorRGBA { a: 0.25, ..color })])
}

/// Directions as they are; the place of a slide's axis means nothing.
fn prismatic_covariance(edge: &EdgePosterior) -> Option<Matrix4<f64>> {
    let mut covariance = Matrix4::zeros();
    covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&Matrix2::from(edge.prismatic.as_ref()?.covariance));
    Some(covariance)
}

/// Half the length that an axis is shown with: as far as the part goes along it, and a little more.
fn reach(hull: &HullProperties, origin: &Vector3<f64>, direction: &Vector3<f64>) -> f64 {
    let farthest = hull.vertices.iter().map(|v| (v - origin).dot(direction).abs()).fold(0.0, f64::max);
    (1.1 * farthest).max(LEAST_REACH)
}

/// Where the axis runs with 90 %: an ellipse at each place along it, wider towards the ends.
///
/// The axis's point at s is p + x₁ e₁ + x₂ e₂ + s (δ₁ e₁ × n + δ₂ e₂ × n), with e₁ × n = −e₂ and
/// e₂ × n = e₁ for a right-handed (n, e₁, e₂).
fn tube(origin: &Vector3<f64>, direction: &Vector3<f64>, covariance: &Matrix4<f64>, reach: f64) -> Surface {
    let (first, second) = orthonormal_pair(direction);
    let mut surface = Surface { vertices: Vec::new(), triangles: Vec::new() };
    let rings = [-reach, 0.0, reach];
    for along in rings {
        let across = nalgebra::Matrix2x4::new(0.0, along, 1.0, 0.0, -along, 0.0, 0.0, 1.0);
        let eigen = (across * covariance * across.transpose()).symmetric_eigen();
        let widest = WIDEST * reach;
        let radii = eigen.eigenvalues.map(|variance| (TWO_DIMENSIONAL_90 * variance.max(0.0).sqrt()).min(widest));
        for step in 0..RIM {
            let (sin, cos) = (std::f64::consts::TAU * step as f64 / RIM as f64).sin_cos();
            let ellipse: Vector2<f64> = eigen.eigenvectors * Vector2::new(radii[0] * cos, radii[1] * sin);
            surface.vertices.push(origin + direction * along + first * ellipse.x + second * ellipse.y);
        }
    }
    for ring in 0..rings.len() - 1 {
        for step in 0..RIM {
            let at = |ring: usize, step: usize| (ring * RIM + step % RIM) as u32;
            let (a, b) = (at(ring, step), at(ring, step + 1));
            let (c, d) = (at(ring + 1, step), at(ring + 1, step + 1));
            surface.triangles.extend([[a, b, d], [a, d, c]]);
        }
    }
    surface
}

/// A part's parents with their probabilities and types, above it.
fn text_marker(marker: Marker, link: &Link, posterior: &ObjectPosterior, displacement: &Pose) -> Marker {
    let part = posterior.parts.iter().find(|part| part.label == link.label);
    let place = part.map_or(link.origin, |part| part.com_in_world_m.into());
    let mut edges: Vec<&EdgePosterior> =
        posterior.edges.iter().filter(|edge| edge.child == link.label && edge.probability >= TOLD).collect();
    edges.sort_by(|a, b| b.probability.total_cmp(&a.probability));
    let mut text = format!("part {}", link.label);
    if link.parent.is_none() {
        text.push_str(", root");
    }
    for edge in edges {
        let (name, probability) = edge.joint_type.likeliest();
        text.push_str(&format!("\non {} {:.2}: {name} {probability:.2}", edge.parent, edge.probability));
    }
    Marker {
        type_: Marker::TEXT_VIEW_FACING,
        pose: pose(&Pose::from_translation(displacement.transform_point(&place))),
        scale: Vector3Message { x: 0.0, y: 0.0, z: TEXT_HEIGHT },
        color: WHITE,
        text,
        ..marker
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::geometry::hull_properties;
    use crate::ros::examples;
    use crate::types::finite::check_finite;

    fn frame() -> FixedFrame {
        FixedFrame { name: "world".into(), zero: Stamp(0) }
    }

    fn shown(posterior: &ObjectPosterior, hulls: &BTreeMap<Label, HullProperties>) -> Vec<MarkerArray> {
        let tree = LinkTree::likeliest(posterior);
        let displacements = tree.displacements(&BTreeMap::from([(Label(2), 0.4)]));
        let picture = Picture { tree: &tree, posterior, hulls, displacements: &displacements };
        markers(&picture, &frame(), Stamp(7))
    }

    fn find<'a>(messages: &'a [MarkerArray], namespace: &str, id: i32) -> &'a Marker {
        let found = messages.iter().flat_map(|m| &m.markers).find(|m| m.ns == namespace && m.id == id);
        found.unwrap_or_else(|| panic!("{namespace} {id}"))
    }

    #[test]
    fn axes_are_coloured_by_type() {
        let messages = shown(&examples::door_with_drawer_and_handle(), &examples::hulls());
        assert_eq!(messages.len(), 1);
        assert_eq!(check_finite(&messages[0]), Ok(()));
        assert_eq!(find(&messages, "axes", 2).color, REVOLUTE);
        assert_eq!(find(&messages, "axes", 3).color, PRISMATIC);
        assert_eq!(find(&messages, "axes", 1).action, Marker::DELETE);
        assert_eq!(find(&messages, "parts", 1).points.len(), 36);
        let told = &find(&messages, "edges", 3).text;
        assert_eq!(told, "part 3\non 4 0.70: prismatic 1.00\non 1 0.30: prismatic 1.00");
        // The handle goes with the door.
        let door = find(&messages, "parts", 2).pose.clone();
        assert_eq!(find(&messages, "axes", 7).pose, door);
        assert!(door.orientation.w < 0.99);
    }

    #[test]
    fn nothing_is_larger_than_what_gets_through() {
        let ball = |index: u32| {
            let point = |k: usize| {
                let (sin, cos) = (k as f64 * 2.4).sin_cos();
                let z = 1.0 - (2 * k + 1) as f64 / 900.0;
                let radius = (1.0 - z * z).sqrt();
                Vector3::new(radius * cos + f64::from(index), radius * sin, z)
            };
            hull_properties(&(0..900).map(point).collect::<Vec<_>>(), None).unwrap()
        };
        for count in [5, 40, 200] {
            let mut posterior = examples::door_with_drawer_and_handle();
            let (edge, part) = (posterior.edges[3].clone(), posterior.parts[0].clone());
            let mut hulls = BTreeMap::new();
            for index in 100..100 + count {
                let label = Label(index);
                posterior.edges.push(EdgePosterior { child: label, ..edge.clone() });
                posterior.parts.push(crate::types::posterior::PartPosterior { label, ..part.clone() });
                hulls.insert(label, ball(index));
            }
            let messages = shown(&posterior, &hulls);
            let sizes: Vec<usize> = messages.iter().map(encoded_bytes).collect();
            assert!(sizes.iter().all(|size| (1000..MOST_BYTES).contains(size)), "{count}: {sizes:?}");
            let total: usize = messages.iter().map(|m| m.markers.len()).sum();
            // The five others have no hull here.
            assert_eq!(total, 4 * count as usize + 15, "{sizes:?}");
            assert_eq!(messages.len() == 1, count == 5, "{sizes:?}");
        }
    }

    #[test]
    fn the_tube_is_as_wide_as_the_axis_is_unsure() {
        // 10 mm of position, .02 rad of direction, about one axis only.
        let mut covariance = Matrix4::zeros();
        covariance[(0, 0)] = 4e-4;
        covariance[(2, 2)] = 1e-4;
        let direction = Vector3::z();
        let (first, second) = orthonormal_pair(&direction);
        let tube = tube(&Vector3::zeros(), &direction, &covariance, 0.5);
        let widest = |ring: usize, along: Vector3<f64>| {
            tube.vertices[ring * RIM..(ring + 1) * RIM].iter().map(|v| v.dot(&along)).fold(0.0, f64::max)
        };
        assert!((widest(1, first) - TWO_DIMENSIONAL_90 * 0.01).abs() < 1e-9);
        assert!(widest(1, second) < 1e-9);
        // Turned about `first` the end goes along `second`.
        assert!((widest(2, second) - TWO_DIMENSIONAL_90 * 0.02 * 0.5).abs() < 1e-9);
        assert!((widest(2, first) - TWO_DIMENSIONAL_90 * 0.01).abs() < 1e-9);
        let unknown = super::tube(&Vector3::zeros(), &direction, &Matrix4::identity(), 0.5);
        assert!(unknown.vertices.iter().all(|v| v.norm() < 1.0));
    }

    #[test]
    fn what_is_not_finite_is_not_shown() {
        let mut hulls = examples::hulls();
        hulls.get_mut(&Label(3)).unwrap().vertices[0].x = f64::NAN;
        let messages = shown(&examples::door_with_drawer_and_handle(), &hulls);
        assert!(messages[0].markers.iter().all(|m| m.ns != "parts" || m.id != 3));
        assert_eq!(check_finite(&messages[0]), Ok(()));
    }
}
