//! Weighs every parent and joint type of every part that moved, and reads the likeliest tree off them.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{DMatrix, Vector3};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::{Learner, RESTS, is_elsewhere};
use crate::math::{Pose, log_sum_exp};
use crate::mechanism::JointType;
use crate::model::{
    Axis, EdgeFit, EdgePart, SharedByFits, WindowObservations, axes_from_motion, moving_evidence, relative_windows,
    rigid_evidence,
};
use crate::pipeline::explain::{Motion, travel};
use crate::registration::{fit_circle, fit_line};
use crate::structure::TreeDistribution;
use crate::types::Label;

/// Visible surfaces of parts that are joined are this close \[m\]; the joint itself is mostly hidden.
const CONTACT_GAP: f64 = 0.03;
/// Standard deviation of what occlusion adds to that \[m\].
const CONTACT_GAP_SIGMA: f64 = 0.02;
/// Log prior lost at most by parts that are far apart \[nats\].
const FARTHEST_PENALTY: f64 = 40.0;
/// Hypotheses this far behind are not sought from new starts \[nats\].
const HOPELESS: f64 = 100.0;
/// A hypothesis that trails by more is left as it is \[nats\].
const OUT_OF_REACH: f64 = 300.0;
const MOVING_TYPES: [JointType; 2] = [JointType::Prismatic, JointType::Revolute];

/// Evidence for one parent of a part.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub struct ParentEvidence {
    /// `None`: whatever never moved.
    pub parent: Option<Label>,
    /// Log evidence of rigid, prismatic, revolute, given how the windows were explained.
    pub log_evidence: [f64; 3],
    /// The fits of the moving types.
    pub fits: [Option<EdgeFit>; 3],
    /// What each kept window adds to the evidence of no motion.
    pub rigid_by_window: Vec<f64>,
    /// What the windows gone by added to the evidence of each type; in `log_evidence`.
    pub past: [f64; 3],
}

impl ParentEvidence {
    /// What a kept window adds to the evidence of each type.
    pub fn of_window(&self, window: usize) -> [f64; 3] {
        let rigid = self.rigid_by_window.get(window).copied().unwrap_or(0.0);
        // A type that fits worse than rest counts as rest.
        std::array::from_fn(|slot| match &self.fits[slot] {
            Some(fit) if self.past[slot] + fit.log_evidence >= self.log_evidence[slot] => {
                fit.by_window.get(window).copied().unwrap_or(0.0)
            }
            _ => rigid,
        })
    }

    /// The fit of the likelier moving type, by the windows gone by too.
    fn likeliest_fit(&self) -> Option<&EdgeFit> {
        let evidence = |fit: &EdgeFit| self.past[fit.joint.joint_type as usize] + fit.log_evidence;
        self.fits.iter().flatten().max_by(|a, b| evidence(a).total_cmp(&evidence(b)))
    }
}

impl Learner {
    /// Evidence for every parent and type of every part that moved.
    pub(super) fn weigh_edges(&mut self, motions: &BTreeMap<Label, Motion>) {
        let movers: Vec<Label> = self.tracks.keys().copied().filter(|&label| self.ever_moved(label)).collect();
        let mut edges: Vec<(Label, Option<Label>)> = Vec::new();
        for &child in &movers {
            edges.push((child, None));
            edges.extend(movers.iter().filter(|l| **l != child).map(|l| (child, Some(*l))));
        }
        let stirred = self.stirred(&movers);
        let is_stirred = |child: Label, parent: Option<Label>| {
            stirred.contains(&child) || parent.is_some_and(|parent| stirred.contains(&parent))
        };
        // Collected in the order of `edges`, so threads do not show in the result.
        let mut options: Vec<ParentEvidence> = edges
            .par_iter()
            .map(|&(child, parent)| {
                let old = self.unaffected(child, parent, motions);
                old.unwrap_or_else(|| self.weigh_edge(child, parent, motions, !is_stirred(child, parent)))
            })
            .collect();
        // More windows only take away from evidence, where the parts still are where they were in those before: what
        // was left as it was is weighed after all where the best has come down to it.
        let mut best: BTreeMap<Label, f64> = BTreeMap::new();
        for ((child, _), option) in edges.iter().zip(&options) {
            let best = best.entry(*child).or_insert(f64::NEG_INFINITY);
            *best = option.log_evidence.into_iter().fold(*best, f64::max);
        }
        for (&(child, parent), option) in edges.iter().zip(&mut options) {
            let near = |t: &JointType| option.log_evidence[*t as usize] > best[&child] - HOPELESS;
            let left = MOVING_TYPES.iter().filter(|t| self.trails(child, parent, **t, OUT_OF_REACH));
            if !is_stirred(child, parent)
                && left.into_iter().any(near)
                && self.unaffected(child, parent, motions).is_none()
            {
                *option = self.weigh_edge(child, parent, motions, false);
            }
        }
        let mut evidence: BTreeMap<Label, Vec<ParentEvidence>> = BTreeMap::new();
        for ((child, _), option) in edges.into_iter().zip(options) {
            tracing::debug!(%child, parent = ?option.parent, evidence = ?option.log_evidence, "edge");
            evidence.entry(child).or_default().push(option);
        }
        self.evidence = evidence;
    }

    /// The parts that are not where they were in a window when their edges were weighed, or that were never weighed.
    fn stirred(&mut self, movers: &[Label]) -> BTreeSet<Label> {
        let mut stirred = BTreeSet::new();
        for &label in movers {
            let (model, tracks) = (&self.models[&label], &self.tracks[&label]);
            let weighed = self.weighed_at.entry(label).or_default();
            let stands = !weighed.is_empty()
                && weighed.iter().zip(tracks).all(|(before, track)| !is_elsewhere(model, before, track));
            if stands {
                weighed.extend_from_slice(&tracks[weighed.len().min(tracks.len())..]);
            } else {
                weighed.clone_from(tracks);
                stirred.insert(label);
            }
        }
        stirred
    }

    /// Evidence of one parent. `lazy`: what is out of reach stays as it was, which is more than it would come to.
    fn weigh_edge(
        &self,
        child: Label,
        parent: Option<Label>,
        motions: &BTreeMap<Label, Motion>,
        lazy: bool,
    ) -> ParentEvidence {
        let left = |joint_type: JointType| lazy && self.trails(child, parent, joint_type, OUT_OF_REACH);
        let old = self.evidence_of(child, parent);
        if let Some(old) = old.filter(|_| MOVING_TYPES.into_iter().all(left)) {
            return self.prolonged(old);
        }
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let part = self.part(child);
        let carrier = parent.map(|p| self.part(p));
        let carrier = carrier.as_ref().map(|part| (part, self.tracks[&part.label].as_slice()));
        let relative = relative_windows(&part, &self.tracks[&child], carrier, &windows);
        let resting = self.resting_windows(child, parent);
        let shared = SharedByFits::default();
        let (rigid, rigid_by_window) = rigid_evidence(&part, &relative, &self.settings, &shared);
        let past = self.past_evidence(child, parent);
        let log_evidence = past.map(|past| past + rigid);
        let mut option = ParentEvidence { parent, log_evidence, fits: [None, None, None], rigid_by_window, past };
        for joint_type in MOVING_TYPES {
            let slot = joint_type as usize;
            let fit = if left(joint_type) {
                old.and_then(|old| self.prolonged(old).fits[slot].take())
            } else {
                let mut starts = self.start_axes(&part, parent, joint_type, &relative, motions);
                if self.trails(child, parent, joint_type, HOPELESS) {
                    starts.truncate(1);
                }
                moving_evidence(&part, joint_type, &starts, (&relative, &resting), &self.settings, &shared)
            };
            if let Some(mut fit) = fit {
                self.keep_sign(&mut fit, child, parent);
                option.log_evidence[slot] = option.log_evidence[slot].max(past[slot] + fit.log_evidence);
                option.fits[slot] = Some(fit);
            }
        }
        option
    }

    /// What is known of an edge: until all are weighed, before this window.
    pub(super) fn evidence_of(&self, child: Label, parent: Option<Label>) -> Option<&ParentEvidence> {
        self.evidence.get(&child)?.iter().find(|option| option.parent == parent)
    }

    /// Whether a hypothesis that was fitted trailed the child's best by more than so much.
    fn trails(&self, child: Label, parent: Option<Label>, joint_type: JointType, by: f64) -> bool {
        let options = self.evidence.get(&child).map_or(&[][..], Vec::as_slice);
        let best = options.iter().flat_map(|option| option.log_evidence).fold(f64::NEG_INFINITY, f64::max);
        let slot = joint_type as usize;
        self.evidence_of(child, parent)
            .is_some_and(|option| option.fits[slot].is_some() && option.log_evidence[slot] < best - by)
    }

    /// Turns a fit the way the one before counted: an axis's sign is free, but what was learned goes by it.
    fn keep_sign(&self, fit: &mut EdgeFit, child: Label, parent: Option<Label>) {
        let before = self.evidence_of(child, parent);
        let before = before.and_then(|option| option.fits[fit.joint.joint_type as usize].as_ref());
        if before.is_some_and(|before| before.joint.axis.direction.dot(&fit.joint.axis.direction) < 0.0) {
            fit.joint.axis.direction = -fit.joint.axis.direction;
            fit.positions.iter_mut().flatten().for_each(|position| *position = -*position);
        }
    }

    /// The windows in which a part keeps its place on a parent, by their tracks.
    fn resting_windows(&self, child: Label, parent: Option<Label>) -> Vec<bool> {
        let model = &self.models[&child];
        (0..self.windows.len())
            .map(|w| {
                let relative = |k: usize| {
                    let reference = parent.map_or_else(Pose::identity, |p| self.tracks[&p][w][k].inverse());
                    reference * self.tracks[&child][w][k]
                };
                (1..self.windows[w].times_s.len()).all(|k| travel(model, &relative(0), &relative(k)) < RESTS)
            })
            .collect()
    }

    /// The evidence so far, where neither part moved in the window: it adds the same to every type.
    fn unaffected(
        &self,
        child: Label,
        parent: Option<Label>,
        motions: &BTreeMap<Label, Motion>,
    ) -> Option<ParentEvidence> {
        let moved = |label: Label| motions.get(&label).is_some_and(|m| m.moved);
        if moved(child) || parent.is_some_and(moved) {
            return None;
        }
        self.evidence_of(child, parent).map(|old| self.prolonged(old))
    }

    /// Evidence to which the newest window adds nothing.
    fn prolonged(&self, old: &ParentEvidence) -> ParentEvidence {
        let mut old = old.clone();
        old.rigid_by_window.push(0.0);
        for fit in old.fits.iter_mut().flatten() {
            fit.by_window.push(0.0);
            let last = fit.positions.last().and_then(|w| w.last()).copied().unwrap_or(0.0);
            fit.positions.push(vec![last; self.windows.last().map_or(0, |w| w.times_s.len())]);
        }
        old
    }

    fn start_axes(
        &self,
        part: &EdgePart,
        parent: Option<Label>,
        joint_type: JointType,
        relative: &[WindowObservations],
        motions: &BTreeMap<Label, Motion>,
    ) -> Vec<Axis> {
        let mut starts = Vec::new();
        let known = self.evidence_of(part.label, parent).and_then(|o| o.fits[joint_type as usize].as_ref());
        starts.extend(known.map(|fit| fit.joint.axis));
        if let Some((seed_parent, seed)) = motions.get(&part.label).and_then(|m| m.seed.as_ref()) {
            let seed_type = if seed.point.is_some() { JointType::Revolute } else { JointType::Prismatic };
            if *seed_parent == parent && seed_type == joint_type {
                starts.push(Axis { direction: seed.direction, point: seed.point.unwrap_or(part.center) });
            }
        }
        // The two longest tracks of the tool, seen from the parent.
        let mut tracks: Vec<Vec<Vector3<f64>>> = relative
            .iter()
            .flat_map(|window| &window.contacts)
            .map(|contact| contact.track.iter().map(|(_, x, _)| *x).collect())
            .collect();
        tracks.sort_by(|a, b| extent(b).total_cmp(&extent(a)));
        for track in tracks.iter().take(2) {
            let seed = match joint_type {
                JointType::Prismatic => fit_line(track),
                _ => fit_circle(track),
            };
            if let Some((seed, _)) = seed {
                starts.push(Axis { direction: seed.direction, point: seed.point.unwrap_or(part.center) });
            }
        }
        starts.extend(axes_from_motion(part, joint_type, relative));
        let mut distinct: Vec<Axis> = Vec::new();
        for axis in starts {
            if distinct.iter().all(|other| !same_axis(&axis, other, &part.center, joint_type)) {
                distinct.push(axis);
            }
        }
        distinct.truncate(3);
        distinct
    }

    /// Log weight of a joint between a part that moved and a parent (`None`: what never moved): the evidence
    /// summed over joint types, and what the gap between them says beforehand; −∞ where there is none.
    pub(in crate::pipeline) fn log_edge_weight(&self, child: Label, parent: Option<Label>) -> f64 {
        let option = self.evidence_of(child, parent);
        option.map_or(f64::NEG_INFINITY, |o| log_sum_exp(&o.log_evidence) + self.log_contact_prior(child, parent))
    }

    /// Log weights of the edges between what never moved (node 0) and the parts that did, in the
    /// order of `evidence`.
    fn edge_weights(&self) -> DMatrix<f64> {
        let nodes: Vec<Option<Label>> = std::iter::once(None).chain(self.evidence.keys().copied().map(Some)).collect();
        DMatrix::from_fn(nodes.len(), nodes.len(), |row, column| {
            nodes[column].map_or(f64::NEG_INFINITY, |child| self.log_edge_weight(child, nodes[row]))
        })
    }

    /// Log prior of a joint between two parts by the gap between their surfaces: what is joined
    /// touches. `None`: the nearest of the parts that never moved.
    fn log_contact_prior(&self, child: Label, parent: Option<Label>) -> f64 {
        if self.posed.contains_key(&child) || parent.is_some_and(|parent| self.posed.contains_key(&parent)) {
            return 0.0;
        }
        let gap = |other: Label| self.gaps.get(&(child.min(other), child.max(other))).copied().unwrap_or(0.0);
        let gap = match parent {
            Some(parent) => gap(parent),
            None => {
                let still = self.models.keys().filter(|l| **l != child && !self.evidence.contains_key(l));
                still.map(|l| gap(*l)).fold(f64::INFINITY, f64::min)
            }
        };
        -(0.5 * ((gap - CONTACT_GAP).max(0.0) / CONTACT_GAP_SIGMA).powi(2)).min(FARTHEST_PENALTY)
    }

    /// The likeliest parent and type of each mover, as a tree with parents first.
    pub(super) fn likeliest(&self) -> Vec<(Label, Option<Label>, JointType, Axis)> {
        let movers: Vec<Label> = self.evidence.keys().copied().collect();
        let tree = match TreeDistribution::new(&self.edge_weights()) {
            Ok(distribution) => distribution.most_likely(),
            Err(error) => {
                tracing::warn!(%error, "no tree explains the parts");
                return Vec::new();
            }
        };
        tree.topological_order()
            .into_iter()
            .filter(|node| *node > 0)
            .filter_map(|node| {
                let child = movers[node - 1];
                let parent = tree.parent(node).and_then(|p| p.checked_sub(1)).map(|p| movers[p]);
                let fit = self.evidence_of(child, parent)?.likeliest_fit()?;
                Some((child, parent, fit.joint.joint_type, fit.joint.axis))
            })
            .collect()
    }
}

/// Diagonal of a track's bounding box \[m\].
fn extent(track: &[Vector3<f64>]) -> f64 {
    let low = track.iter().fold(Vector3::repeat(f64::INFINITY), |low, x| low.inf(x));
    let high = track.iter().fold(Vector3::repeat(f64::NEG_INFINITY), |high, x| high.sup(x));
    if track.is_empty() { 0.0 } else { (high - low).norm() }
}

/// Whether a fit from either axis would end at the same place: 3° and 15 mm abreast of the part.
fn same_axis(first: &Axis, second: &Axis, center: &Vector3<f64>, joint_type: JointType) -> bool {
    let abreast = |axis: &Axis| axis.point + axis.direction * axis.direction.dot(&(center - axis.point));
    let near = joint_type == JointType::Prismatic || (abreast(first) - abreast(second)).norm() < 0.015;
    near && first.direction.cross(&second.direction).norm() < 0.05
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::model::KinematicJoint;

    #[test]
    fn windows_gone_by_decide_between_types_too() {
        let axis = Axis { direction: Vector3::z(), point: Vector3::zeros() };
        let fit = |joint_type, log_evidence| {
            let center = Vector3::zeros();
            let joint = KinematicJoint {
                parent: None,
                child: Label(1),
                joint_type,
                axis,
                center,
                radius: 0.1,
                suggested: None,
            };
            Some(EdgeFit { log_evidence, joint, positions: Vec::new(), by_window: Vec::new() })
        };
        let option = |past| ParentEvidence {
            parent: None,
            log_evidence: [-900.0, -50.0, -170.0],
            fits: [None, fit(JointType::Prismatic, -50.0), fit(JointType::Revolute, -170.0)],
            rigid_by_window: Vec::new(),
            past,
        };
        let likeliest = |past| option(past).likeliest_fit().map(|fit| fit.joint.joint_type);
        assert_eq!(likeliest([0.0; 3]), Some(JointType::Prismatic));
        assert_eq!(likeliest([-1100.0, -1000.0, -80.0]), Some(JointType::Revolute));
    }
}
