//! Posteriors for the tests of this folder.

use nalgebra::{Matrix2, Matrix4, Vector3};

use crate::geometry::{HullProperties, hull_properties};
use crate::types::Label;
use crate::types::posterior::{
    Criticism, EdgePosterior, InformedBy, JointTypeProbabilities, ObjectPosterior, PartPosterior, PrismaticAxis,
    Quantity, RevoluteAxis,
};

const HINGE: JointTypeProbabilities = JointTypeProbabilities { rigid: 0.0, prismatic: 0.02, revolute: 0.98 };
const SLIDE: JointTypeProbabilities = JointTypeProbabilities { rigid: 0.0, prismatic: 1.0, revolute: 0.0 };

/// Where the parts are: wall 4, panel 1, door 2, drawer 3, the door's handle 7.
fn centers() -> [(u32, Vector3<f64>); 5] {
    [
        (1, Vector3::new(0.5, 0.4, 0.2)),
        (2, Vector3::new(0.3, 0.0, 0.6)),
        (3, Vector3::new(0.8, 0.0, 0.3)),
        (4, Vector3::new(0.4, 0.5, 0.5)),
        (7, Vector3::new(0.5, -0.05, 0.6)),
    ]
}

/// Boxes of different sizes.
pub fn hulls() -> std::collections::BTreeMap<Label, HullProperties> {
    let hull = |(index, (label, center)): (usize, (u32, Vector3<f64>))| {
        let size = Vector3::new(0.1, 0.2 + 0.05 * index as f64, 0.3);
        let corner = |bits: usize| {
            let sign = |bit: usize| if bits & bit == 0 { -0.5 } else { 0.5 };
            center + size.component_mul(&Vector3::new(sign(1), sign(2), sign(4)))
        };
        let corners: Vec<_> = (0..8).map(corner).collect();
        (Label(label), hull_properties(&corners, None).unwrap())
    };
    centers().into_iter().enumerate().map(hull).collect()
}

fn edge(parent: u32, child: u32, probability: f64, joint_type: JointTypeProbabilities) -> EdgePosterior {
    let learned = joint_type != JointTypeProbabilities::UNIFORM;
    let revolute = joint_type.revolute > joint_type.prismatic;
    let unit = |units: [&'static str; 2]| units[usize::from(revolute)];
    let informed_by = if learned { InformedBy::Dynamics } else { InformedBy::Prior };
    let quantity = |units, median: f64| Quantity::from_log_normal(unit(units), median.ln(), 0.2, informed_by);
    EdgePosterior {
        parent: Label(parent),
        child: Label(child),
        probability,
        joint_type,
        revolute: learned.then(|| RevoluteAxis {
            axis_direction: [0.0, 0.6, 0.8],
            axis_point_m: [0.1, f64::from(child) * 0.01, 0.5],
            covariance: (Matrix4::identity() * 1e-4).into(),
        }),
        prismatic: learned.then(|| PrismaticAxis {
            axis_direction: [0.8, -0.6, 0.0],
            covariance: (Matrix2::identity() * 1e-3).into(),
        }),
        damping: quantity(["N·s/m", "N·m·s/rad"], 2.0),
        friction: quantity(["N", "N·m"], 1.5),
        joint_inertia: quantity(["kg", "kg·m²"], 0.7),
        lower_limit: None,
        upper_limit: learned.then(|| Quantity::from_normal(unit(["m", "rad"]), 1.25, 0.01, informed_by)),
    }
}

fn posterior(edges: Vec<EdgePosterior>) -> ObjectPosterior {
    let part = |(label, center): (u32, Vector3<f64>)| PartPosterior {
        label: Label(label),
        com_in_world_m: center.into(),
        com_covariance_m2: [[1e-4, 0.0, 0.0], [0.0, 1e-4, 0.0], [0.0, 0.0, 1e-4]],
        mass_kg: Quantity::from_log_normal("kg", 2f64.ln(), 0.5, InformedBy::Prior),
    };
    ObjectPosterior {
        root_label: Label(4),
        parts: centers().into_iter().map(part).collect(),
        edges,
        windows: Vec::new(),
        criticism: Criticism::insufficient(),
    }
}

/// Nothing is known: every pair, every type.
pub fn prior() -> ObjectPosterior {
    let labels = centers().map(|(label, _)| label);
    let pairs = labels.into_iter().flat_map(|parent| labels.map(|child| (parent, child)));
    let pairs = pairs.filter(|(parent, child)| parent != child && *child != 4);
    posterior(pairs.map(|(parent, child)| edge(parent, child, 0.25, JointTypeProbabilities::UNIFORM)).collect())
}

/// A door and a drawer on the wall, a handle on the door, a panel that never moved.
pub fn door_with_drawer_and_handle() -> ObjectPosterior {
    posterior(vec![
        edge(2, 1, 0.4, JointTypeProbabilities::UNIFORM),
        edge(3, 1, 0.4, JointTypeProbabilities::UNIFORM),
        edge(4, 1, 0.2, JointTypeProbabilities::UNIFORM),
        edge(4, 2, 0.9, HINGE),
        edge(7, 2, 0.1, HINGE),
        edge(1, 3, 0.3, SLIDE),
        edge(4, 3, 0.7, SLIDE),
        edge(2, 7, 0.8, HINGE),
        edge(4, 7, 0.2, HINGE),
    ])
}
