//! The likeliest tree of a posterior as links and joints: what URDF, joint states, tf and markers share.
//!
//! A link's frame has the axes of the fixed frame while its joint positions are 0, at the first frame of
//! the stream; its origin is on the joint's axis if that is revolute, else at the part's centre of mass.
//! So `world_from_link = D_link · T(origin)` with `D_child = D_parent · exp(S q)`.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{DMatrix, Vector3, Vector6};

use crate::math::{Pose, Screw};
use crate::structure::TreeDistribution;
use crate::types::Label;
use crate::types::posterior::{EdgePosterior, JointTypeProbabilities, ObjectPosterior};

/// A part whose joint has no type likelier than this is fixed to a parent that is at least as likely as
/// the second, else to the root.
const UNDECIDED: f64 = 0.5;
const DECIDED_PARENT: f64 = 0.9;
/// A part is not where its joint could have it, that far off \[m\] or turned \[rad\].
const OFF_JOINT: f64 = 5e-4;
/// An axis shorter than this has no direction.
const SHORT: f64 = 1e-6;

/// How a link moves on its parent; world at the first frame.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum LinkJoint {
    /// Not at all, or nothing is known.
    Fixed,
    /// Anyhow: it is not where a joint could have it. In the fixed frame, as tf says.
    Floating,
    /// Along a unit vector.
    Prismatic {
        /// The axis.
        direction: Vector3<f64>,
    },
    /// About a unit vector.
    Revolute {
        /// The axis.
        direction: Vector3<f64>,
        /// The point of it nearest the child's centre of mass \[m\].
        point: Vector3<f64>,
    },
}

impl LinkJoint {
    /// Of an edge's likeliest type; fixed where its axis is not known.
    fn of(edge: &EdgePosterior) -> Self {
        let unit = |direction: [f64; 3]| Vector3::from(direction).try_normalize(SHORT);
        let moving = match edge.joint_type.likeliest().0 {
            "prismatic" => {
                edge.prismatic.as_ref().and_then(|axis| Some(Self::Prismatic { direction: unit(axis.axis_direction)? }))
            }
            "revolute" => edge.revolute.as_ref().and_then(|axis| {
                Some(Self::Revolute { direction: unit(axis.axis_direction)?, point: axis.axis_point_m.into() })
            }),
            _ => None,
        };
        moving.unwrap_or(Self::Fixed)
    }

    /// The unit vector of its axis.
    pub fn direction(&self) -> Option<Vector3<f64>> {
        match self {
            Self::Fixed | Self::Floating => None,
            Self::Prismatic { direction } | Self::Revolute { direction, .. } => Some(*direction),
        }
    }

    fn screw(&self) -> Screw {
        match self {
            Self::Fixed | Self::Floating => Screw::rigid(),
            Self::Prismatic { direction } => Screw::prismatic(direction),
            Self::Revolute { direction, point } => Screw::revolute(direction, point),
        }
    }

    /// The position that fits D_parent⁻¹ D_child = exp(S q) best \[m or rad\]; `near`: of the angles that
    /// are the same, the nearest to this. `origin`: whose way along a prismatic axis counts.
    fn position(&self, relative: &Pose, origin: &Vector3<f64>, near: f64) -> Option<f64> {
        match self {
            Self::Fixed | Self::Floating => None,
            Self::Prismatic { direction } => Some(direction.dot(&(relative.transform_point(origin) - origin))),
            Self::Revolute { direction, .. } => Some(relative.turn_about(direction, near)),
        }
    }
}

/// A part and how it hangs on the rest.
#[derive(Clone, Debug, PartialEq)]
pub struct Link {
    /// The part.
    pub label: Label,
    /// Index of its parent in the tree; `None` for the root.
    pub parent: Option<usize>,
    /// How it moves on its parent.
    pub joint: LinkJoint,
    /// Index of the posterior's edge that this is; `None` for the root and for what is fixed for want of
    /// evidence.
    pub edge: Option<usize>,
    /// Where the link's frame was at the first frame \[m\].
    pub origin: Vector3<f64>,
}

/// Links, parents first; the root is the first.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct LinkTree {
    links: Vec<Link>,
}

/// A link's name in URDF and tf.
pub fn link_name(label: Label) -> String {
    format!("part_{label}")
}

/// The name of the joint that carries a part.
pub fn joint_name(child: Label) -> String {
    format!("joint_{child}")
}

impl LinkTree {
    /// The tree of the likeliest edges. What has no joint type likelier than even is fixed: to its parent
    /// if that is known, as it went with it; else to the root, as it was only ever seen at rest.
    pub fn likeliest(posterior: &ObjectPosterior) -> Self {
        let ends = posterior.edges.iter().flat_map(|edge| [edge.parent, edge.child]);
        let mut others: Vec<Label> = ends.chain(posterior.parts.iter().map(|part| part.label)).collect();
        others.sort_unstable();
        others.dedup();
        others.retain(|label| *label != posterior.root_label);
        let nodes: Vec<Label> = std::iter::once(posterior.root_label).chain(others).collect();
        let centers: BTreeMap<Label, Vector3<f64>> =
            posterior.parts.iter().map(|part| (part.label, part.com_in_world_m.into())).collect();
        let center = |label: Label| centers.get(&label).copied().unwrap_or_default();

        let edges = edges_between(&nodes, posterior);
        let parents = likeliest_parents(&edges, posterior);
        let mut links = vec![Link {
            label: posterior.root_label,
            parent: None,
            joint: LinkJoint::Fixed,
            edge: None,
            origin: center(posterior.root_label),
        }];
        // Parents first: a node follows when its parent is there.
        let mut place: BTreeMap<usize, usize> = BTreeMap::from([(0, 0)]);
        while links.len() < nodes.len() {
            let next = (1..nodes.len()).find(|node| !place.contains_key(node) && place.contains_key(&parents[*node]));
            let Some(node) = next else { break };
            let edge = edges[(parents[node], node)].filter(|_| !is_undecided(&edges, node, posterior));
            let joint = edge.map_or(LinkJoint::Fixed, |edge| LinkJoint::of(&posterior.edges[edge]));
            let origin = match joint {
                LinkJoint::Revolute { point, .. } => point,
                LinkJoint::Fixed | LinkJoint::Floating | LinkJoint::Prismatic { .. } => center(nodes[node]),
            };
            let parent = place.get(&parents[node]).copied();
            place.insert(node, links.len());
            links.push(Link { label: nodes[node], parent, joint, edge, origin });
        }
        Self { links }
    }

    /// Parents first; the root is the first.
    pub fn links(&self) -> &[Link] {
        &self.links
    }

    /// The links that move, with their axes.
    pub fn moving(&self) -> impl Iterator<Item = (&Link, Vector3<f64>)> {
        self.links.iter().filter_map(|link| Some((link, link.joint.direction()?)))
    }

    /// Displacement of every part since the first frame at these joint positions \[m or rad\], by child;
    /// 0 for what is not given.
    pub fn displacements(&self, positions: &BTreeMap<Label, f64>) -> BTreeMap<Label, Pose> {
        let mut displacements: Vec<Pose> = Vec::with_capacity(self.links.len());
        for link in &self.links {
            let q = positions.get(&link.label).copied().unwrap_or_default();
            let above = link.parent.map_or_else(Pose::identity, |parent| displacements[parent]);
            displacements.push(above * link.joint.screw().displacement(q));
        }
        self.links.iter().map(|link| link.label).zip(displacements).collect()
    }

    /// Position of every joint that moves \[m or rad\], by child, that fits the parts' displacements best.
    /// `near`: angles are counted from these on, as a joint may turn more than once; 0 for what is not
    /// given. Parts without a displacement stand still.
    pub fn positions(
        &self,
        displacements: &BTreeMap<Label, Pose>,
        near: &BTreeMap<Label, f64>,
    ) -> BTreeMap<Label, f64> {
        let displacement = |label| displacements.get(label).copied().unwrap_or_else(Pose::identity);
        let found = self.links.iter().filter_map(|link| {
            let parent = &self.links[link.parent?];
            let relative = displacement(&parent.label).inverse() * displacement(&link.label);
            let near = near.get(&link.label).copied().unwrap_or_default();
            Some((link.label, link.joint.position(&relative, &link.origin, near)?))
        });
        found.filter(|(_, q)| q.is_finite()).collect()
    }
}

impl LinkTree {
    /// The parts that are not where the tree could have them, of these displacements; what hangs on such a
    /// part is looked at from where that is. Parts without a displacement stand still.
    pub fn off_joint(&self, displacements: &BTreeMap<Label, Pose>) -> BTreeSet<Label> {
        let mut off = BTreeSet::new();
        let mut placed: Vec<Pose> = Vec::with_capacity(self.links.len());
        for link in &self.links {
            let seen = displacements.get(&link.label).copied().unwrap_or_else(Pose::identity);
            let above = link.parent.map_or_else(Pose::identity, |parent| placed[parent]);
            let relative = above.inverse() * seen;
            let q = link.joint.position(&relative, &link.origin, 0.0).unwrap_or_default();
            let by_joint = above * link.joint.screw().displacement(q);
            let apart = (by_joint.transform_point(&link.origin) - seen.transform_point(&link.origin)).norm();
            let turned = (by_joint.inverse() * seen).log().fixed_rows::<3>(0).norm();
            if link.joint == LinkJoint::Floating || apart.max(turned) > OFF_JOINT {
                off.insert(link.label);
                placed.push(seen);
            } else {
                placed.push(by_joint);
            }
        }
        off
    }

    /// This tree with some parts floating.
    pub fn floating(&self, labels: &BTreeSet<Label>) -> Self {
        let mut tree = self.clone();
        for link in tree.links.iter_mut().filter(|link| labels.contains(&link.label)) {
            (link.parent, link.joint, link.edge) = (None, LinkJoint::Floating, None);
        }
        tree
    }

    /// Rate of every joint that moves \[m/s or rad/s\], by child, from twists of the children against their
    /// parents, (angular, linear), at the reference configuration; 0 for what is not given.
    pub fn rates(&self, twists: &BTreeMap<Label, Vector6<f64>>) -> BTreeMap<Label, f64> {
        let rate = |(link, _): (&Link, Vector3<f64>)| {
            let twist = twists.get(&link.label).copied().unwrap_or_default();
            let rate = match link.joint {
                LinkJoint::Fixed | LinkJoint::Floating => 0.0,
                LinkJoint::Prismatic { direction } => direction.dot(&twist.fixed_rows::<3>(3)),
                LinkJoint::Revolute { direction, .. } => direction.dot(&twist.fixed_rows::<3>(0)),
            };
            (link.label, rate)
        };
        self.moving().map(rate).collect()
    }
}

/// Indices of the posterior's edges by parent's and child's node.
fn edges_between(nodes: &[Label], posterior: &ObjectPosterior) -> DMatrix<Option<usize>> {
    let mut between = DMatrix::from_element(nodes.len(), nodes.len(), None);
    let node = |label: Label| nodes.iter().position(|other| *other == label);
    for (index, edge) in posterior.edges.iter().enumerate() {
        if let (Some(parent), Some(child)) = (node(edge.parent), node(edge.child))
            && edge.probability > 0.0
            && parent != child
        {
            between[(parent, child)] = Some(index);
        }
    }
    between
}

/// The joint's type over all parents is not known.
fn is_undecided(edges: &DMatrix<Option<usize>>, node: usize, posterior: &ObjectPosterior) -> bool {
    let mut types = JointTypeProbabilities { rigid: 0.0, prismatic: 0.0, revolute: 0.0 };
    for edge in edges.column(node).iter().flatten().map(|edge| &posterior.edges[*edge]) {
        types.rigid += edge.probability * edge.joint_type.rigid;
        types.prismatic += edge.probability * edge.joint_type.prismatic;
        types.revolute += edge.probability * edge.joint_type.revolute;
    }
    types.likeliest().1 <= UNDECIDED
}

/// Parents by node; all the root where the edges hold no tree.
fn likeliest_parents(edges: &DMatrix<Option<usize>>, posterior: &ObjectPosterior) -> Vec<usize> {
    let count = edges.nrows();
    let mut log_weights = DMatrix::from_element(count, count, f64::NEG_INFINITY);
    for child in 1..count {
        let probability = |edge: usize| posterior.edges[edge].probability;
        let likeliest = edges.column(child).iter().flatten().map(|edge| probability(*edge)).fold(0.0, f64::max);
        if is_undecided(edges, child, posterior) && likeliest < DECIDED_PARENT {
            log_weights[(0, child)] = 0.0;
            continue;
        }
        for parent in 0..count {
            if let Some(edge) = edges[(parent, child)] {
                log_weights[(parent, child)] = probability(edge).ln();
            }
        }
    }
    let tree = TreeDistribution::new(&log_weights).map(|trees| trees.most_likely());
    let parent = |node: usize| tree.as_ref().ok().and_then(|tree| tree.parent(node)).unwrap_or_default();
    (0..count).map(parent).collect()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::ros::examples::{self, door_with_drawer_and_handle};

    #[test]
    fn what_was_never_moved_is_fixed_to_the_root() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        let found: Vec<_> =
            tree.links().iter().map(|l| (l.label.0, l.parent.map(|p| tree.links()[p].label.0), l.joint)).collect();
        let [root, panel, door, drawer, handle] = &found[..] else { panic!("{found:?}") };
        assert_eq!((root.0, root.1, root.2), (4, None, LinkJoint::Fixed));
        assert_eq!((panel.0, panel.1, panel.2), (1, Some(4), LinkJoint::Fixed));
        assert_eq!((door.0, door.1), (2, Some(4)));
        assert!(matches!(door.2, LinkJoint::Revolute { .. }));
        assert_eq!((drawer.0, drawer.1), (3, Some(4)));
        assert!(matches!(drawer.2, LinkJoint::Prismatic { .. }));
        assert_eq!((handle.0, handle.1), (7, Some(2)));
        assert!(matches!(handle.2, LinkJoint::Revolute { .. }));
        assert_eq!(tree.links()[1].edge, None);
    }

    #[test]
    fn what_went_with_its_parent_is_fixed_to_it() {
        let mut posterior = door_with_drawer_and_handle();
        posterior.edges.retain(|edge| (edge.parent, edge.child) != (Label(4), Label(7)));
        let handle = posterior.edges.iter_mut().find(|edge| edge.child == Label(7)).unwrap();
        handle.probability = 1.0;
        handle.joint_type = JointTypeProbabilities::UNIFORM;
        let tree = LinkTree::likeliest(&posterior);
        let handle = tree.links().iter().find(|link| link.label == Label(7)).unwrap();
        assert_eq!((handle.joint, handle.edge), (LinkJoint::Fixed, None));
        assert_eq!(handle.parent.map(|parent| tree.links()[parent].label), Some(Label(2)));
    }

    #[test]
    fn the_prior_is_fixed_altogether() {
        let tree = LinkTree::likeliest(&examples::prior());
        assert_eq!(tree.links().len(), 5);
        assert!(tree.links()[1..].iter().all(|link| link.parent == Some(0) && link.joint == LinkJoint::Fixed));
        assert_eq!(tree.moving().count(), 0);
    }

    #[test]
    fn positions_undo_displacements() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        for angle in [0.0, 1.2, -2.9, 4.0, 9.0] {
            let positions = BTreeMap::from([(Label(2), angle), (Label(3), 0.31), (Label(7), -0.4)]);
            let displacements = tree.displacements(&positions);
            let near = BTreeMap::from([(Label(2), angle + 0.5)]);
            let found = tree.positions(&displacements, &near);
            assert_eq!(found.len(), 3);
            for (label, q) in &positions {
                assert!((found[label] - q).abs() < 1e-12, "{label}: {q} {found:?}");
            }
        }
    }

    #[test]
    fn what_is_off_its_joint_floats() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        let positions = BTreeMap::from([(Label(2), 1.0), (Label(3), 0.25), (Label(7), 0.3)]);
        let mut displacements = tree.displacements(&positions);
        assert_eq!(tree.off_joint(&displacements), BTreeSet::new());
        // The door leaves its hinge with the handle on it.
        let lifted = Pose::from_translation(Vector3::new(0.0, 0.01, 0.01));
        for label in [Label(2), Label(7)] {
            displacements.insert(label, lifted * displacements[&label]);
        }
        let off = tree.off_joint(&displacements);
        assert_eq!(off, BTreeSet::from([Label(2)]));
        let tree = tree.floating(&off);
        assert_eq!(tree.moving().count(), 2);
        let found = tree.positions(&displacements, &BTreeMap::new());
        assert!((found[&Label(7)] - 0.3).abs() < 1e-12 && !found.contains_key(&Label(2)), "{found:?}");
        assert_eq!(tree.off_joint(&displacements), off);
    }

    #[test]
    fn rates_are_along_the_joints_own_axes() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        // The same door, its axis the other way round.
        let LinkJoint::Revolute { direction, point } = tree.links()[2].joint else { panic!("{tree:?}") };
        let twists = BTreeMap::from([(Label(2), Screw::revolute(&-direction, &point).0 * 0.7)]);
        let rates = tree.rates(&twists);
        assert!((rates[&Label(2)] + 0.7).abs() < 1e-12, "{rates:?}");
        assert_eq!((rates.len(), rates[&Label(3)]), (3, 0.0));
    }

    #[test]
    fn edges_without_a_tree_are_a_star() {
        let mut posterior = door_with_drawer_and_handle();
        // The door on the handle and the handle on the door, neither on the wall.
        posterior.edges.retain(|edge| edge.child != Label(2) && (edge.parent, edge.child) != (Label(4), Label(7)));
        let mut back = posterior.edges.iter().find(|edge| edge.child == Label(7)).unwrap().clone();
        (back.parent, back.child) = (Label(7), Label(2));
        posterior.edges.push(back);
        let tree = LinkTree::likeliest(&posterior);
        assert_eq!(tree.links().len(), 5);
        assert!(tree.links()[1..].iter().all(|link| link.parent == Some(0)));
    }
}
