//! The posterior as it is published: what the learner knows, over all trees.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{DMatrix, Matrix3, Vector3};

use super::poses::POSED_RADIUS;
use super::{Learner, ParentEvidence, Pipeline};
use crate::geometry::{HullProperties, hull_properties};
use crate::math::log_sum_exp;
use crate::mechanism::JointType;
use crate::model::{Axis, DynamicsPosterior, JointDynamics, KinematicFit};
use crate::registration::PartModel;
use crate::structure::TreeDistribution;
use crate::types::Label;
use crate::types::posterior::{
    Criticism, EdgePosterior, InformedBy, JointTypeProbabilities, ObjectPosterior, PartPosterior, PrismaticAxis,
    Quantity, RevoluteAxis,
};

/// Density of furniture parts over their hull, median \[kg/m³\] and standard deviation of its log:
/// hollow drawers weigh 100, boards 600.
const HULL_DENSITY: (f64, f64) = (250.0, 0.9);
/// How far off an axis is whose part's motion was explained wrongly: directions \[rad\], positions \[m\].
const WRONG_AXIS: [f64; 4] = [0.1, 0.1, 0.03, 0.03];
/// The centre of mass of a part lies this share of its spread away from its hull's, per axis.
const CENTER_SHARE: f64 = 0.3;

impl Pipeline {
    /// What is believed now, in the working frame.
    pub(super) fn posterior_in_work(&self) -> Option<ObjectPosterior> {
        if let Some(learner) = self.known() {
            return Some(learner.posterior());
        }
        let mut parts = Parts { surfaces: self.surfaces_in_work(), origins: BTreeMap::new() };
        let posed = self.frames_at_rest().iter().rev().flat_map(|frame| &frame.poses);
        parts.origins = posed.map(|(label, seen)| (*label, seen.world_from_frame.translation)).collect();
        let likeliest = || parts.surfaces.iter().max_by_key(|(_, points)| points.len()).map(|(label, _)| *label);
        let root = self.settings.root.or_else(likeliest).or_else(|| parts.origins.keys().next().copied())?;
        (!parts.surfaces.is_empty() || !parts.origins.is_empty()).then(|| posterior(root, &parts, None))
    }

    /// Points of each part's surface at the reference configuration, in the working frame \[m\].
    pub(super) fn surfaces_in_work(&self) -> BTreeMap<Label, Vec<Vector3<f64>>> {
        if let Some(learner) = self.known() {
            return learner.surfaces();
        }
        let last = self.frames_at_rest().last().into_iter().flat_map(|frame| frame.scans.iter());
        last.map(|(label, scan)| (*label, scan.iter().map(|p| p.point_in_world).collect())).collect()
    }
}

impl Learner {
    /// What is believed by what was learned.
    pub(super) fn posterior(&self) -> ObjectPosterior {
        let origins = self.posed.iter().map(|(label, part)| (*label, part.world_from_frame.translation)).collect();
        posterior(self.root, &Parts { surfaces: self.surfaces(), origins }, Some(self))
    }

    pub(super) fn surfaces(&self) -> BTreeMap<Label, Vec<Vector3<f64>>> {
        let seen = self.models.iter().filter(|(label, _)| !self.posed.contains_key(label));
        let surface = |model: &PartModel| model.surfels.iter().map(|s| s.point).collect();
        seen.map(|(label, model)| (*label, surface(model))).collect()
    }
}

/// All parts at the reference configuration \[m\].
#[derive(Default)]
struct Parts {
    /// Points of the surface of those that clouds show.
    surfaces: BTreeMap<Label, Vec<Vector3<f64>>>,
    /// Origins of the frames of those that a topic measures.
    origins: BTreeMap<Label, Vector3<f64>>,
}

fn posterior(root_label: Label, seen: &Parts, learner: Option<&Learner>) -> ObjectPosterior {
    let labels: BTreeSet<Label> = seen.surfaces.keys().chain(seen.origins.keys()).copied().collect();
    let labels: Vec<Label> = labels.into_iter().collect();
    let mut parts: Vec<PartPosterior> =
        seen.surfaces.iter().filter_map(|(label, points)| part(*label, points)).collect();
    parts.extend(seen.origins.iter().map(|(label, origin)| posed_part(*label, origin)));
    parts.sort_by_key(|part| part.label);
    let dynamics = learner.and_then(Learner::published_dynamics);
    for learned in dynamics.iter().flat_map(|dynamics| &dynamics.parts) {
        if let Some(part) = parts.iter_mut().find(|part| part.label == learned.label) {
            part.com_in_world_m = learned.com_in_world.into();
            part.com_covariance_m2 = learned.com_covariance.into();
            part.mass_kg = learned.mass.clone();
        }
    }
    let known = learner.map(|learner| Known { learner, dynamics: dynamics.as_ref() });
    ObjectPosterior {
        root_label,
        parts,
        edges: edges(root_label, &labels, known),
        windows: learner.map(|learner| learner.records.clone()).unwrap_or_default(),
        criticism: learner.map_or_else(Criticism::insufficient, |learner| learner.critic.findings()),
    }
}

/// A part of which only a frame is known: its mass and its centre may be anything about it.
fn posed_part(label: Label, origin: &Vector3<f64>) -> PartPosterior {
    let (log_sd, center_sd) = (2.5, POSED_RADIUS);
    let volume = HullProperties::guess(*origin, POSED_RADIUS).volume;
    PartPosterior {
        label,
        com_in_world_m: (*origin).into(),
        com_covariance_m2: Matrix3::from_diagonal_element(center_sd * center_sd).into(),
        mass_kg: Quantity::from_log_normal("kg", (HULL_DENSITY.0 * volume).ln(), log_sd, InformedBy::Prior),
    }
}

fn part(label: Label, points: &[Vector3<f64>]) -> Option<PartPosterior> {
    let hull = hull_properties(points, None)?;
    // The same in all directions: the hull's spread is along the world's axes, which mean nothing to the part.
    let variance = CENTER_SHARE.powi(2) * hull.spread.norm_squared() / 3.0;
    let covariance = Matrix3::from_diagonal_element(variance);
    let (density, log_sd) = HULL_DENSITY;
    Some(PartPosterior {
        label,
        com_in_world_m: hull.center.into(),
        com_covariance_m2: covariance.into(),
        mass_kg: Quantity::from_log_normal("kg", (density * hull.volume).ln(), log_sd, InformedBy::Prior),
    })
}

/// What the edges are made of.
#[derive(Clone, Copy)]
struct Known<'a> {
    learner: &'a Learner,
    dynamics: Option<&'a DynamicsPosterior>,
}

fn edges(root: Label, labels: &[Label], known: Option<Known<'_>>) -> Vec<EdgePosterior> {
    let nodes: Vec<Label> = [root].into_iter().chain(labels.iter().copied().filter(|l| *l != root)).collect();
    let evidence = |child: Label| known.and_then(|known| known.learner.evidence.get(&child));
    // All parts that never moved are as good as the world; a part that never moved may hang on any.
    let log_weights = DMatrix::from_fn(nodes.len(), nodes.len(), |i, j| match known {
        Some(known) if j > 0 && evidence(nodes[j]).is_some() => {
            known.learner.log_edge_weight(nodes[j], evidence(nodes[i]).map(|_| nodes[i]))
        }
        _ => 0.0,
    });
    let Ok(trees) = TreeDistribution::new(&log_weights) else { return Vec::new() };
    let mut found = Vec::new();
    for (j, child) in nodes.iter().enumerate().skip(1) {
        let doubt = evidence(*child).map_or(0.0, |_| known.map_or(0.0, |known| known.learner.doubt(*child)));
        for (i, parent) in nodes.iter().enumerate() {
            let open = doubt / (nodes.len() - 1) as f64;
            let probability = (1.0 - doubt) * trees.edge_marginals()[(i, j)] + open;
            if i == j || probability < ObjectPosterior::LEAST_PROBABILITY {
                continue;
            }
            let option = evidence(*child).and_then(|options| option_for(options, *parent, evidence(*parent).is_some()));
            found.push(edge(*parent, *child, probability, option, known));
        }
    }
    found.sort_by_key(|e| (e.child, e.parent));
    found
}

/// The evidence for a parent: all parts that never moved share that of the world.
fn option_for(options: &[ParentEvidence], parent: Label, parent_moved: bool) -> Option<&ParentEvidence> {
    options.iter().find(|o| o.parent == parent_moved.then_some(parent))
}

fn edge(
    parent: Label,
    child: Label,
    probability: f64,
    option: Option<&ParentEvidence>,
    known: Option<Known<'_>>,
) -> EdgePosterior {
    let mut joint_type = JointTypeProbabilities::UNIFORM;
    if let Some(option) = option {
        let total = log_sum_exp(&option.log_evidence);
        let [rigid, prismatic, revolute] = option.log_evidence.map(|e| (e - total).exp());
        let doubt = known.map_or(0.0, |known| known.learner.doubt(child));
        let mixed = |p: f64| (1.0 - doubt) * p + doubt / 3.0;
        joint_type =
            JointTypeProbabilities { rigid: mixed(rigid), prismatic: mixed(prismatic), revolute: mixed(revolute) };
    }
    let fitted = |joint_type| fitted_axis(option?, known?, child, joint_type);
    let revolute = fitted(JointType::Revolute).map(|(axis, covariance)| RevoluteAxis {
        axis_direction: axis.direction.into(),
        axis_point_m: axis.point.into(),
        covariance: std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)])),
    });
    let prismatic = fitted(JointType::Prismatic).map(|(axis, covariance)| PrismaticAxis {
        axis_direction: axis.direction.into(),
        covariance: std::array::from_fn(|i| std::array::from_fn(|j| covariance[(i, j)])),
    });
    let prior = |unit: [&str; 2], median: f64| {
        let unit = unit[usize::from(joint_type.revolute >= joint_type.prismatic)];
        Quantity::from_log_normal(unit, median.ln(), 1.5, InformedBy::Prior)
    };
    let likelier = if joint_type.revolute >= joint_type.prismatic { JointType::Revolute } else { JointType::Prismatic };
    let learned = option.and_then(|option| learned_dynamics(option, known?, child, likelier));
    let from = |of: fn(&JointDynamics) -> &Quantity, unit, median| {
        learned.map_or_else(|| prior(unit, median), |d| of(d).clone())
    };
    EdgePosterior {
        parent,
        child,
        probability,
        joint_type,
        revolute,
        prismatic,
        damping: from(|d| &d.damping, ["N·s/m", "N·m·s/rad"], 2.0),
        friction: from(|d| &d.friction, ["N", "N·m"], 1.0),
        joint_inertia: from(|d| &d.joint_inertia, ["kg", "kg·m²"], 1.0),
        lower_limit: learned.and_then(|d| d.lower_limit.clone()),
        upper_limit: learned.and_then(|d| d.upper_limit.clone()),
    }
}

/// The dynamics of the joint, if inference was run for this parent and type.
fn learned_dynamics<'a>(
    option: &ParentEvidence,
    known: Known<'a>,
    child: Label,
    joint_type: JointType,
) -> Option<&'a JointDynamics> {
    index_in_fit(option, known.learner.fit.as_ref()?, child, joint_type)?;
    known.dynamics?.joints.iter().find(|joint| joint.label == child)
}

/// Where the joint of this parent and type is in the joint fit.
fn index_in_fit(option: &ParentEvidence, fit: &KinematicFit, child: Label, joint_type: JointType) -> Option<usize> {
    fit.joints.iter().position(|joint| {
        let parent = joint.parent.map(|p| fit.joints[p].child);
        joint.child == child && joint.joint_type == joint_type && parent == option.parent
    })
}

/// The axis by the joint fit where the edge is in it, else by its own.
fn fitted_axis(
    option: &ParentEvidence,
    known: Known<'_>,
    child: Label,
    joint_type: JointType,
) -> Option<(Axis, DMatrix<f64>)> {
    let learner = known.learner;
    let own = option.fits[joint_type as usize].as_ref()?;
    let wide = DMatrix::from_diagonal_element(4, 4, 1.0);
    let Some(fit) = &learner.fit else { return Some((own.joint.axis, wide)) };
    let Some(index) = index_in_fit(option, fit, child, joint_type) else { return Some((own.joint.axis, wide)) };
    let joint = &fit.joints[index];
    let (offset, count) = (fit.axis_offset(index), joint.axis_parameters());
    let mut covariance = fit.covariance.view((offset, offset), (count, count)).into_owned();
    let mut axis = joint.axis;
    let dynamics = learned_dynamics(option, known, child, joint_type);
    if let Some((turn, spread)) = dynamics.and_then(|dynamics| dynamics.turn) {
        axis = axis.turned(&turn);
        covariance.fixed_view_mut::<2, 2>(0, 0).copy_from(&spread);
    }
    let doubt = learner.doubt_beyond_least(child);
    for (i, deviation) in WRONG_AXIS.into_iter().enumerate().take(count) {
        covariance[(i, i)] += doubt * deviation.powi(2);
    }
    Some((axis, covariance))
}
