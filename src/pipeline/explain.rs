//! How every part moved in one window: at rest, carried, along a known joint, or along a new one.
//!
//! Parts are never tracked freely from frame to frame: flat panels slide along themselves, and such
//! tracks drift by centimetres. Each candidate motion has one degree of freedom, its path is found
//! on a grid against the reference model, and the best few are refined. A part whose motion is
//! explained becomes a possible parent for the others.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Matrix6, Vector3, Vector6};
use rayon::prelude::*;
use serde::{Deserialize, Serialize};

use super::frame::Frame;
use crate::math::{Pose, Screw};
use crate::mechanism::JointType;
use crate::model::{
    Axis, Contact, KinematicJoint, KinematicSettings, PoseMeasurement, SharedByFits, WindowObservations, fit_edge,
};
use crate::registration::{
    AlignmentSettings, AxisSeed, JointFrame, JointPath, OUTLIER_COST, PartModel, Quadratic, ScanPoint, fit_circle,
    fit_line, follow, geometric_seeds, motion_cost, outline_quadratic, pose_factor, rays_near, rest_cost, search_path,
    seen_through,
};
use crate::types::Label;

/// Excess of the mean truncated cost over the part's own baseline that counts as explained.
const EXPLAINED: f64 = 0.12;
/// Excess of a scan where a part is seen through.
const SEEN_THROUGH_COST: f64 = 2.0;
/// Share of rays that may seem to go through a part by their labels and flying pixels.
const WRONG_LABELS: f64 = 0.1;
/// Rays of other parts looked at when a motion is judged.
const EVERY_RAY: usize = 3;
/// A tool track explained to this root mean square is explained \[m\].
const TOOL_EXPLAINED: f64 = 0.003;
/// Beyond this many times that a track is not explained; in between it is in part.
const TOOL_FELT: f64 = 1.5;
/// Excess at which a part that was taken for the root is looked at like the others.
const LEFT: f64 = 0.6;
/// Share of the largest eigenvalue of a factor that rough normals may pretend to hold.
pub const FALSE_SHARE: f64 = 0.01;
/// A motion may start this far from where the part was, before it costs \[m\].
const START_JUMP: f64 = 0.006;
/// A linearization is believed about this far \[m\]: weaker directions stay as predicted.
const MEASURED_WITHIN: f64 = 0.010;
/// Excess at which no candidate explains a part, and a free track may.
const UNEXPLAINED: f64 = 0.3;
/// Excess below which a motion is explained well, and above which it is not.
const WELL_EXPLAINED: f64 = 0.6;
const BADLY_EXPLAINED: f64 = 0.8;
/// What is found against a motion that another candidate explains badly, at most.
const MOST_RELUCTANCE: f64 = 0.25;
/// A part explained again must gain this much.
const RECONSIDERED: f64 = 0.03;
/// A free track turned or shifted by less than this shows no axis \[rad, m\].
const LEAST_TURN: f64 = 0.08;
const LEAST_SHIFT: f64 = 0.010;
/// Scans with fewer points say nothing of a pose.
pub const FEWEST_POINTS: usize = 25;

/// What a part's scans cost where its pose is known.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Baseline {
    /// Mean truncated cost per point.
    pub cost: f64,
    /// The same as motions are judged, where other sides may come into view.
    pub motion_cost: f64,
    /// Mean number of points in a scan.
    pub points: f64,
}

/// What a window's motion is explained with.
pub struct Scene<'a> {
    /// The window's frames.
    pub frames: &'a [Frame],
    /// The tool's contacts, on the same frames.
    pub contacts: &'a [Contact],
    /// Reference models; the root has none that matters.
    pub models: &'a BTreeMap<Label, PartModel>,
    /// What each part costs at a known pose.
    pub baselines: &'a BTreeMap<Label, Baseline>,
    /// Displacements before the window.
    pub start: &'a BTreeMap<Label, Pose>,
    /// Joints known so far, parents first.
    pub joints: &'a [KinematicJoint],
    /// Parts that the tool has moved before: their joints are known from their own motion.
    pub touched_before: &'a BTreeSet<Label>,
    /// The part that is fixed to the world, if that is known.
    pub root: Option<Label>,
    /// Whether the tool's position is used as an observation.
    pub use_tool: bool,
    /// Parts that do not rest, followed freely from frame to frame: only a start for what explains them.
    pub free: BTreeMap<Label, Vec<Pose>>,
    /// The same parts as if they had stayed where they were.
    pub still: BTreeMap<Label, Motion>,
}

/// One part's motion through a window.
#[derive(Clone, Debug)]
pub struct Motion {
    /// Displacement per frame.
    pub displacements: Vec<Pose>,
    /// Whether it moved.
    pub moved: bool,
    /// Mean excess of the truncated cost over the baseline.
    pub excess: f64,
    /// The new joint that explains it, with the parent it was found against.
    pub seed: Option<(Option<Label>, AxisSeed)>,
    /// By how much it is explained, 0 to 1: seen or felt to be there, or clearly not; `None`: that is open.
    pub explained: Option<f64>,
    /// The part that it was explained against; `None`: the world.
    pub carrier: Option<Label>,
    /// Excess, misses of the tool and complexity: the least is taken.
    score: f64,
}

impl Motion {
    /// A motion that was measured, and needs no explanation.
    pub fn measured(displacements: Vec<Pose>, moved: bool) -> Self {
        Self { displacements, moved, excess: 0.0, seed: None, explained: Some(1.0), carrier: None, score: 0.0 }
    }
}

/// What was found for parts so far against what moves: a part that is explained does not change.
#[derive(Default)]
struct Offers {
    /// Along the joint that is known.
    along: BTreeMap<Label, Option<Motion>>,
    /// Along new joints, by part and parent.
    refined: BTreeMap<(Label, Option<Label>), Vec<Motion>>,
    /// Carried along, by part and what carries it.
    carried: BTreeMap<(Label, Label), Motion>,
}

/// The motions of all parts with a model but the root, and the contacts by the parts that they explain.
///
/// The part nearest the tool need not be the one it holds, where parts overlap: a part that rests while
/// the tool moves is given up for one that moves, if that explains the window better and the wrench is
/// not bound to a part (`relabel`). `measured` are motions that need no explanation.
pub fn explain_contacts(
    scene: &Scene<'_>,
    measured: &BTreeMap<Label, Motion>,
    relabel: bool,
) -> (BTreeMap<Label, Motion>, Vec<Contact>) {
    let mut motions = explain_window(scene, measured);
    let mut contacts = scene.contacts.to_vec();
    for index in (0..contacts.len()).filter(|_| relabel) {
        let label = contacts[index].label;
        let miss =
            |label: Label| motions.get(&label).map_or(f64::INFINITY, |m| miss_of(&contacts[index], &m.displacements));
        let own = miss(label);
        let rests = motions.get(&label).is_some_and(|m| !m.moved);
        if !rests || own <= 2.0 * TOOL_EXPLAINED {
            continue;
        }
        // One that moved, or that has left and nothing says where to.
        let gone = |other: &Label, m: &Motion| *other != label && (m.moved || m.excess > LEFT);
        let others = motions.iter().filter(|(other, m)| gone(other, m));
        let other = others.map(|(other, _)| (miss(*other), *other)).min_by(|a, b| a.0.total_cmp(&b.0));
        let Some((_, other)) = other else { continue };
        let mut relabelled = contacts.clone();
        relabelled[index].label = other;
        let moved = explain_window(&Scene { contacts: &relabelled, ..scene.bare() }, measured);
        let cost = |motions: &BTreeMap<Label, Motion>, contacts: &[Contact]| {
            let missed = contacts.iter().filter_map(|c| Some((c, motions.get(&c.label)?)));
            let missed: f64 = missed.map(|(c, m)| miss_cost(miss_of(c, &m.displacements))).sum();
            missed + motions.values().map(|m| m.excess).sum::<f64>()
        };
        tracing::debug!(%label, %other, before = cost(&motions, &contacts), after = cost(&moved, &relabelled), "relabel");
        if cost(&moved, &relabelled) < cost(&motions, &contacts) {
            (motions, contacts) = (moved, relabelled);
        }
    }
    let scene = Scene { contacts: &contacts, ..scene.bare() };
    for (label, motion) in motions.iter_mut().filter(|(label, _)| !measured.contains_key(label)) {
        motion.explained = scene.explains(*label, motion);
    }
    (motions, contacts)
}

/// Root mean square by which the tool misses a point that is fixed on a part \[m\].
fn miss_of(contact: &Contact, displacements: &[Pose]) -> f64 {
    let points: Vec<Vector3<f64>> =
        contact.track.iter().map(|(k, x, _)| displacements[*k].inverse().transform_point(x)).collect();
    let count = points.len().max(1) as f64;
    let mean = points.iter().sum::<Vector3<f64>>() / count;
    (points.iter().map(|p| (p - mean).norm_squared()).sum::<f64>() / count).sqrt()
}

/// What a miss of the tool counts beside an excess.
fn miss_cost(miss: f64) -> f64 {
    0.05 * (miss / TOOL_EXPLAINED).min(20.0)
}

/// The motions of all parts with a model, but the root; `measured` are those that need no explanation.
fn explain_window(scene: &Scene<'_>, measured: &BTreeMap<Label, Motion>) -> BTreeMap<Label, Motion> {
    let mut motions = measured.clone();
    let mut open: Vec<Label> = Vec::new();
    let mut at_rest = BTreeMap::new();
    let unknown: Vec<Label> = scene.models.keys().copied().filter(|l| !motions.contains_key(l)).collect();
    for label in unknown.into_iter().filter(|&label| Some(label) != scene.root) {
        let still = scene.rest(label);
        let rests = still.excess < EXPLAINED && scene.tool_miss(label, &still.displacements) < TOOL_EXPLAINED;
        if rests && !scene.pushed_unseen(label) {
            motions.insert(label, still);
        } else {
            open.push(label);
            at_rest.insert(label, still);
        }
    }
    let free = open.par_iter().map(|&label| (label, scene.free_track(label))).collect();
    let scene = &Scene { free, still: at_rest, ..scene.bare() };
    let mut offers = Offers::default();
    let mut order = Vec::new();
    while !open.is_empty() {
        // A part goes along with the one that is known to carry it: that is explained first.
        let waits = |label: &Label| scene.known_parent(*label).is_some_and(|parent| open.contains(&parent));
        let ready: Vec<Label> = open.iter().copied().filter(|label| !waits(label)).collect();
        scene.prepare(&ready, &motions, &mut offers);
        let best = ready
            .iter()
            .filter_map(|&label| Some((label, scene.best_motion(label, &motions, &offers)?)))
            .min_by(|(_, a), (_, b)| a.score.total_cmp(&b.score));
        let Some((label, motion)) = best else { break };
        open.retain(|other| *other != label);
        motions.insert(label, scene.accepted(label, motion));
        order.push(label);
    }
    for label in open {
        motions.insert(label, scene.still(label));
    }
    // What was explained first did not know of what came after it.
    for label in order {
        scene.reconsider(label, &mut motions, &mut offers);
    }
    motions
}

/// Whether a part's motion was explained by way of another's.
fn depends(motions: &BTreeMap<Label, Motion>, label: Label, on: Label) -> bool {
    let mut at = Some(label);
    for _ in 0..=motions.len() {
        match at {
            Some(part) if part == on => return true,
            Some(part) => at = motions.get(&part).and_then(|m| m.carrier),
            None => return false,
        }
    }
    true
}

impl<'a> Scene<'a> {
    /// The same with nothing found out yet.
    fn bare(&self) -> Scene<'a> {
        Scene { free: BTreeMap::new(), still: BTreeMap::new(), ..*self }
    }

    /// A part as if it had stayed where it was.
    fn still(&self, label: Label) -> Motion {
        self.still.get(&label).cloned().unwrap_or_else(|| self.rest(label))
    }

    /// The cost of rest: of what nothing touches, what comes into view of it is no sign of motion.
    fn rest(&self, label: Label) -> Motion {
        let cost = if self.is_touched(label) { motion_cost } else { rest_cost };
        self.evaluate_by(label, |_| self.start_of(label), cost)
    }

    /// A part that keeps its place on another from the start on.
    fn carried(&self, label: Label, carrier: Label, track: &[Pose]) -> Motion {
        let fixed = track[0].inverse() * self.start_of(label);
        Motion { carrier: Some(carrier), ..self.evaluate(label, |k| track[k] * fixed) }
    }

    /// What may carry a part: what moves and does not depend on it.
    fn carriers<'m>(
        &self,
        label: Label,
        known: &'m BTreeMap<Label, Motion>,
    ) -> impl Iterator<Item = (Label, &'m Motion)> {
        let others = known.iter().map(|(other, motion)| (*other, motion));
        others.filter(move |(other, motion)| *other != label && motion.moved && !depends(known, *other, label))
    }

    /// Whether a part cannot have stayed where it was: what comes into view as others move is no sign.
    pub fn has_left(&self, label: Label) -> bool {
        if !self.models.contains_key(&label) {
            return false;
        }
        let still = self.evaluate(label, |_| self.start_of(label));
        tracing::debug!(%label, excess = still.excess, miss = self.tool_miss(label, &still.displacements), "root");
        still.excess > LEFT || self.tool_miss(label, &still.displacements) > TOOL_EXPLAINED
    }

    fn start_of(&self, label: Label) -> Pose {
        self.start.get(&label).copied().unwrap_or_else(Pose::identity)
    }

    fn scan(&self, label: Label, frame: usize) -> &[ScanPoint] {
        self.frames[frame].scans.get(&label).map_or(&[], |scan| if scan.len() < FEWEST_POINTS { &[] } else { scan })
    }

    fn is_touched(&self, label: Label) -> bool {
        self.contacts.iter().any(|contact| contact.label == label)
    }

    fn contact(&self, label: Label) -> Option<&Contact> {
        self.contacts.iter().find(|contact| self.use_tool && contact.label == label)
    }

    /// The cost of a given motion of a part.
    fn evaluate(&self, label: Label, displacement: impl Fn(usize) -> Pose) -> Motion {
        self.evaluate_by(label, displacement, motion_cost)
    }

    fn evaluate_by(
        &self,
        label: Label,
        displacement: impl Fn(usize) -> Pose,
        cost_of: fn(&PartModel, &[ScanPoint], &Pose) -> f64,
    ) -> Motion {
        let displacements: Vec<Pose> = (0..self.frames.len()).map(displacement).collect();
        let model = &self.models[&label];
        let baseline = self.baselines.get(&label).copied().unwrap_or_default();
        let costs: Vec<f64> = displacements
            .par_iter()
            .enumerate()
            .filter(|(k, _)| !self.scan(label, *k).is_empty())
            .map(|(k, d)| {
                let scan = self.scan(label, k);
                let cost = cost_of(model, scan, d);
                // Per point, what is turned away from the sensor does not count; per scan, new faces
                // do not. Either may happen, so the smaller excess is taken.
                let per_point = cost - baseline.motion_cost;
                let matched = (OUTLIER_COST - cost) * scan.len() as f64 / baseline.points.max(1.0);
                let excess = per_point.min(OUTLIER_COST - baseline.motion_cost - matched).max(-0.3);
                excess + SEEN_THROUGH_COST * self.seen_through(label, k, d)
            })
            .collect();
        let mean = costs.iter().sum::<f64>() / costs.len().max(1) as f64;
        // A part that moves late in the window hides in the mean: the worst quarter counts as well.
        let mut sorted = costs;
        sorted.sort_by(f64::total_cmp);
        let worst = sorted.get(sorted.len() * 3 / 4..).unwrap_or(&[]);
        let worst = worst.iter().sum::<f64>() / worst.len().max(1) as f64;
        let start = self.start_of(label);
        let moved = displacements.iter().any(|d| travel(model, &start, d) > 0.002);
        let excess = mean.max(0.6 * worst);
        Motion { displacements, moved, excess, seed: None, explained: None, carrier: None, score: excess }
    }

    /// The share of rays through where the part's faces would be that ended behind them.
    fn seen_through(&self, label: Label, frame: usize, displacement: &Pose) -> f64 {
        let model = &self.models[&label];
        if model.outlines.is_empty() {
            return 0.0;
        }
        let others = self.frames[frame].scans.iter().filter(|(other, _)| **other != label);
        let others = others.flat_map(|(_, scan)| scan).step_by(EVERY_RAY);
        let near = rays_near(others, &displacement.transform_point(&model.centroid), model.reach());
        let share = seen_through(model, self.scan(label, frame), (&near, EVERY_RAY), displacement);
        ((share - WRONG_LABELS) / (1.0 - WRONG_LABELS)).max(0.0)
    }

    /// Whether a part that moved before is touched by a tool whose track tells nothing: a narrow part looks much the
    /// same wherever its joint has it, so rest is no better an account of it than its joint.
    fn pushed_unseen(&self, label: Label) -> bool {
        let known = self.touched_before.contains(&label) && self.joints.iter().any(|joint| joint.child == label);
        known && !self.use_tool && self.is_touched(label)
    }

    /// Root mean square by which the tool misses a contact point that is fixed on the part \[m\].
    fn tool_miss(&self, label: Label, displacements: &[Pose]) -> f64 {
        self.contact(label).map_or(0.0, |contact| miss_of(contact, displacements))
    }

    /// By how much, 0 to 1, a motion explains what was seen and felt of a part: new faces leave a high excess, so
    /// what the tool goes along with counts as well. `None` where that is open.
    fn explains(&self, label: Label, motion: &Motion) -> Option<f64> {
        if motion.excess < WELL_EXPLAINED {
            return Some(1.0);
        }
        let held = self.contact(label).is_some() && motion.moved;
        let miss = self.tool_miss(label, &motion.displacements);
        let felt = if held { (2.0 * (TOOL_FELT - miss / TOOL_EXPLAINED)).clamp(0.0, 1.0) } else { 0.0 };
        // Parts that open next to it change what is seen of a part at rest.
        let most = if motion.moved { BADLY_EXPLAINED } else { 2.0 * BADLY_EXPLAINED };
        (felt == 1.0 || motion.excess > most).then_some(felt)
    }

    /// Whether a motion explains a part clearly better than rest. A cost that stays high either way
    /// is a new face coming into view, not motion.
    fn beats(&self, label: Label, motion: &Motion, still: &Motion) -> bool {
        let gain = still.excess - motion.excess;
        let share = if self.is_touched(label) { 0.3 } else { 0.5 };
        let by_its_joint = motion.seed.is_none() && self.pushed_unseen(label);
        let seen = gain > if by_its_joint { RECONSIDERED } else { EXPLAINED } && gain > share * still.excess;
        let miss = self.tool_miss(label, &still.displacements);
        let felt = miss > TOOL_EXPLAINED
            && self.tool_miss(label, &motion.displacements) < 0.5 * miss
            && gain > -0.2 * (1.0 + still.excess);
        seen || felt
    }

    /// Excess, misses of the tool, a jump at the start, and complexity.
    fn score(&self, label: Label, motion: &Motion, complexity: f64) -> f64 {
        let miss = self.tool_miss(label, &motion.displacements);
        // A motion starts where the part was.
        let model = &self.models[&label];
        let jump = motion.displacements.first().map_or(0.0, |d| travel(model, &self.start_of(label), d));
        motion.excess + complexity + miss_cost(miss) + 0.05 * (jump / START_JUMP).min(20.0)
    }

    /// The part followed by registration alone, each frame from where it would have gone on to.
    fn free_track(&self, label: Label) -> Vec<Pose> {
        let model = &self.models[&label];
        let settings = AlignmentSettings { gate: 0.04, ..AlignmentSettings::default() };
        let mut track: Vec<Pose> = Vec::with_capacity(self.frames.len());
        for k in 0..self.frames.len() {
            let last = track.last().copied().unwrap_or_else(|| self.start_of(label));
            let scan = self.scan(label, k);
            let ahead = match &track[..] {
                [.., before, last] => *last * before.inverse() * *last,
                _ => last,
            };
            let cost = |pose: &Pose| motion_cost(model, scan, pose);
            let start = if cost(&ahead) < cost(&last) { ahead } else { last };
            track.push(if scan.is_empty() { last } else { follow(model, scan, &start, &settings).displacement });
        }
        track
    }

    /// Along the known joint, or carried by what moves; and whether that is enough.
    fn simple_motion(&self, label: Label, known: &BTreeMap<Label, Motion>, offers: &Offers) -> (Option<Motion>, bool) {
        let mut best = Best { motion: None };
        let mut known_joint = false;
        if let Some(Some(motion)) = offers.along.get(&label) {
            known_joint = self.touched_before.contains(&label);
            best.offer(self.score(label, motion, 0.0), motion.clone());
        }
        for (carrier, parent) in self.carriers(label, known) {
            let found = offers.carried.get(&(label, carrier)).cloned();
            let motion = found.unwrap_or_else(|| self.carried(label, carrier, &parent.displacements));
            best.offer(self.score(label, &motion, 0.0), motion);
        }
        let settled = best.motion.as_ref().is_some_and(|motion| {
            let held = self.tool_miss(label, &motion.displacements) < 1.5 * TOOL_EXPLAINED;
            let still = self.still(label);
            held && (known_joint || motion.excess < EXPLAINED || motion.excess < 0.3 * still.excess)
        });
        (best.motion, settled)
    }

    /// The part that carries another by the joints known so far.
    fn known_parent(&self, label: Label) -> Option<Label> {
        let joint = self.joints.iter().find(|joint| joint.child == label)?;
        joint.parent.map(|parent| self.joints[parent].child)
    }

    /// What a part may hang on: the world, what moves, and what was moved before.
    fn possible_parents(&self, label: Label, known: &BTreeMap<Label, Motion>) -> Vec<Option<Label>> {
        let displaced = |l: Label| travel(&self.models[&l], &Pose::identity(), &self.start_of(l)) > 0.005;
        let others = known.iter().filter(|(l, m)| **l != label && (m.moved || displaced(**l)));
        let others = others.map(|(l, _)| *l).filter(|l| !depends(known, *l, label));
        [None].into_iter().chain(others.map(Some)).collect()
    }

    /// Finds what the best motions of these parts are chosen from.
    fn prepare(&self, labels: &[Label], known: &BTreeMap<Label, Motion>, offers: &mut Offers) {
        let missing: Vec<Label> = labels.iter().copied().filter(|l| !offers.along.contains_key(l)).collect();
        let along: Vec<(Label, Option<Motion>)> = missing
            .par_iter()
            .filter_map(|&label| {
                let joint = self.joints.iter().find(|joint| joint.child == label)?;
                let parent = joint.parent.map(|p| self.joints[p].child);
                let parents = self.parent_track(parent, known)?;
                let motion = self.along(label, &joint.screw(), joint.joint_type, &parents);
                Some((label, Some(Motion { carrier: parent, ..motion })))
            })
            .collect();
        offers.along.extend(along);
        let carriers = labels.iter().flat_map(|&label| self.carriers(label, known).map(move |c| (label, c)));
        let missing: Vec<_> = carriers.filter(|(label, (c, _))| !offers.carried.contains_key(&(*label, *c))).collect();
        let carried: Vec<_> = missing
            .par_iter()
            .map(|&(label, (carrier, motion))| ((label, carrier), self.carried(label, carrier, &motion.displacements)))
            .collect();
        offers.carried.extend(carried);
        let mut pairs: Vec<(Label, Option<Label>, usize)> = Vec::new();
        for &label in labels {
            let (best, settled) = self.simple_motion(label, known, offers);
            if !settled {
                let most = if best.is_some_and(|m| m.score < 2.0 * EXPLAINED) { 1 } else { 3 };
                let parents = self.possible_parents(label, known);
                pairs.extend(parents.into_iter().map(|parent| (label, parent, most)));
            }
        }
        pairs.retain(|(label, parent, _)| !offers.refined.contains_key(&(*label, *parent)));
        let refined: Vec<(_, Vec<Motion>)> = pairs
            .par_iter()
            .map(|&(label, parent, most)| {
                let motions = self.parent_track(parent, known).map_or_else(Vec::new, |track| {
                    let seeds = self.seeds(label, &self.models[&label], &track, most);
                    seeds.iter().filter_map(|seed| self.refine(label, parent, seed, &track)).collect()
                });
                ((label, parent), motions)
            })
            .collect();
        offers.refined.extend(refined);
    }

    /// The best of what was found for a part.
    fn best_motion(&self, label: Label, known: &BTreeMap<Label, Motion>, offers: &Offers) -> Option<Motion> {
        let (simple, settled) = self.simple_motion(label, known, offers);
        if settled {
            return simple;
        }
        let still = self.still(label);
        let carried = simple.as_ref().map_or(still.excess, |m| m.excess.min(still.excess));
        // A part that nothing touches needs a better reason for a joint of its own: what it shows anew
        // must not pass for motion.
        let reluctance =
            0.02 + if self.is_touched(label) { 0.0 } else { 0.1 + (0.4 * carried.max(0.0)).min(MOST_RELUCTANCE) };
        let mut best = Best { motion: simple };
        for parent in self.possible_parents(label, known) {
            for motion in offers.refined.get(&(label, parent)).into_iter().flatten() {
                let complexity = reluctance + if parent.is_some() { 0.02 } else { 0.0 };
                tracing::trace!(%label, ?parent, excess = motion.excess, miss = self.tool_miss(label, &motion.displacements), score = self.score(label, motion, complexity), seed = ?motion.seed, "offer");
                best.offer(self.score(label, motion, complexity), motion.clone());
            }
        }
        best.motion
    }

    /// A motion, or rest if it does not explain clearly more, or the free track if nothing else does.
    fn accepted(&self, label: Label, motion: Motion) -> Motion {
        let still = self.still(label);
        tracing::trace!(%label, excess = motion.excess, score = motion.score, seed = ?motion.seed, still = still.excess, still_miss = self.tool_miss(label, &still.displacements), free = self.free.get(&label).map(|t| self.evaluate(label, |k| t[k]).excess), "accept");
        let motion = if self.beats(label, &motion, &still) { motion } else { still };
        if motion.excess > UNEXPLAINED
            && let Some(track) = self.free.get(&label)
        {
            let free = self.evaluate(label, |k| track[k]);
            if free.excess < 0.4 * motion.excess {
                return free;
            }
        }
        motion
    }

    /// Explains a part again where all others are explained.
    fn reconsider(&self, label: Label, motions: &mut BTreeMap<Label, Motion>, offers: &mut Offers) {
        // A free track costs least and tells no joint: it stands only where no joint on any of the others does.
        let free = self.free.get(&label) == Some(&motions[&label].displacements);
        if motions[&label].excess < EXPLAINED && motions[&label].seed.is_none() && !free {
            return;
        }
        self.prepare(&[label], motions, offers);
        let Some(motion) = self.best_motion(label, motions, offers) else { return };
        if free || motion.score < motions[&label].score - RECONSIDERED {
            let motion = self.accepted(label, motion);
            motions.insert(label, motion);
            offers.refined.retain(|(_, parent), _| *parent != Some(label));
            offers.carried.retain(|(_, carrier), _| *carrier != label);
        }
    }

    /// Displacements of a parent through the window, if they are known.
    fn parent_track(&self, parent: Option<Label>, known: &BTreeMap<Label, Motion>) -> Option<Vec<Pose>> {
        match parent {
            None => Some(vec![Pose::identity(); self.frames.len()]),
            Some(label) if Some(label) == self.root => Some(vec![Pose::identity(); self.frames.len()]),
            Some(label) => known.get(&label).map(|motion| motion.displacements.clone()),
        }
    }

    fn joint_frames(&self, label: Label, parents: &[Pose]) -> Vec<JointFrame<'_>> {
        let contact = self.contact(label);
        (0..self.frames.len())
            .map(|k| JointFrame {
                scan: self.scan(label, k),
                parent: parents[k],
                tool: contact.and_then(|c| c.position(k)),
            })
            .collect()
    }

    /// The part's motion along a given screw of its parent.
    fn along(&self, label: Label, screw: &Screw, joint_type: JointType, parents: &[Pose]) -> Motion {
        let path = self.path(label, screw, joint_type, parents, None);
        self.evaluate(label, |k| parents[k] * screw.displacement(path.positions[k]))
    }

    fn path(
        &self,
        label: Label,
        screw: &Screw,
        joint_type: JointType,
        parents: &[Pose],
        contact_point: Option<&Vector3<f64>>,
    ) -> JointPath {
        let model = &self.models[&label];
        let grid = grid_of(model, screw, joint_type);
        search_path(model, &self.joint_frames(label, parents), screw, grid, contact_point)
    }

    /// Axes to try for a part against a parent, most promising first.
    fn seeds(&self, label: Label, model: &PartModel, parents: &[Pose], most: usize) -> Vec<AxisSeed> {
        if let Some(contact) = self.contact(label) {
            let track: Vec<Vector3<f64>> =
                contact.track.iter().map(|(k, x, _)| parents[*k].inverse().transform_point(x)).collect();
            let mut seeds: Vec<(AxisSeed, f64)> =
                [fit_line(&track), fit_circle(&track)].into_iter().flatten().collect();
            seeds.sort_by(|a, b| a.1.total_cmp(&b.1));
            let mut seeds: Vec<AxisSeed> = seeds.into_iter().map(|(seed, _)| seed).collect();
            seeds.extend(self.seeds_of_free_track(label, parents));
            return seeds;
        }
        // Rank the shape's axes by the frames in which the part is furthest from where it started.
        let directions: Vec<Vector3<f64>> = Vec::new();
        let every = (self.frames.len() / 8).max(1);
        let sparse: Vec<usize> = (0..self.frames.len()).step_by(every).collect();
        let mut ranked: Vec<(f64, AxisSeed)> = geometric_seeds(model, &directions)
            .into_iter()
            .map(|seed| {
                let joint_type = seed_type(&seed);
                let frames: Vec<JointFrame<'_>> = sparse
                    .iter()
                    .map(|&k| JointFrame { scan: self.scan(label, k), parent: parents[k], tool: None })
                    .collect();
                let grid = match joint_type {
                    JointType::Prismatic => (-0.4, 0.4, 0.02),
                    _ => (-1.8, 1.8, 0.06),
                };
                (search_path(model, &frames, &seed.screw(), grid, None).cost, seed)
            })
            .collect();
        ranked.sort_by(|a, b| a.0.total_cmp(&b.0));
        let followed = self.seeds_of_free_track(label, parents);
        followed.into_iter().chain(ranked.into_iter().take(most).map(|(_, seed)| seed)).collect()
    }

    /// Axes of the motion that the free track shows relative to a parent.
    fn seeds_of_free_track(&self, label: Label, parents: &[Pose]) -> Vec<AxisSeed> {
        let Some(track) = self.free.get(&label) else { return Vec::new() };
        let model = &self.models[&label];
        let at = |k: usize| parents[k].inverse() * track[k];
        let first = at(0);
        let Some(last) =
            (0..track.len()).map(at).max_by(|a, b| travel(model, &first, a).total_cmp(&travel(model, &first, b)))
        else {
            return Vec::new();
        };
        let twist = (last * first.inverse()).log();
        let angular: Vector3<f64> = twist.fixed_rows::<3>(0).into();
        let linear: Vector3<f64> = twist.fixed_rows::<3>(3).into();
        let angle = angular.norm();
        let shift = last.transform_point(&model.centroid) - first.transform_point(&model.centroid);
        let mut seeds = Vec::new();
        if angle > LEAST_TURN {
            let direction = angular / angle;
            seeds.push(AxisSeed { direction, point: Some(direction.cross(&linear) / angle) });
        }
        if shift.norm() > LEAST_SHIFT {
            seeds.push(AxisSeed { direction: shift.normalize(), point: None });
        }
        seeds
    }

    /// Refines a seed on the points themselves, with the gate closing in.
    fn refine(&self, label: Label, parent: Option<Label>, seed: &AxisSeed, parents: &[Pose]) -> Option<Motion> {
        let model = &self.models[&label];
        let joint_type = seed_type(seed);
        let center = model.centroid;
        let point = seed.point.unwrap_or(center);
        let mut joint = KinematicJoint {
            parent: None,
            child: label,
            joint_type,
            axis: Axis {
                direction: seed.direction,
                point: point + seed.direction * seed.direction.dot(&(center - point)),
            },
            center,
            radius: model.radius,
            suggested: None,
        };
        let contact = self.contact(label);
        let contact_point = contact.and_then(|c| {
            let (k, x, _) = c.track.first()?;
            let start = parents[*k].inverse() * self.start_of(label);
            Some((parents[*k] * start).inverse().transform_point(x))
        });
        let path = self.path(label, &joint.screw(), joint_type, parents, contact_point.as_ref());
        let mut positions = path.positions;
        // Faces that come into view match wrongly at first: where the tool is felt, it leads.
        let shared_error = if contact.is_some() { 0.010 } else { KinematicSettings::default().shared_error };
        let settings = KinematicSettings { steps: 8, shared_error, ..KinematicSettings::default() };
        for (gate, last) in [(0.05, false), (0.03, false), (0.02, true)] {
            let alignment = AlignmentSettings { gate, ..AlignmentSettings::default() };
            let screw = joint.screw();
            let relative: Vec<Pose> = positions.iter().map(|&q| screw.displacement(q)).collect();
            let poses = (0..self.frames.len())
                .map(|k| {
                    let scan = self.scan(label, k);
                    let predicted = parents[k] * relative[k];
                    // Outlines hold what is nearly in place.
                    let past = if last { rays_past(&self.frames[k], label, model, &predicted) } else { Vec::new() };
                    let measured = measure_past(model, scan, &past, &predicted, &alignment)?;
                    Some(PoseMeasurement { displacement: parents[k].inverse() * measured.displacement, ..measured })
                })
                .collect();
            let contacts = contact
                .map(|c| Contact {
                    label,
                    track: c.track.iter().map(|(k, x, s)| (*k, parents[*k].inverse().transform_point(x), *s)).collect(),
                })
                .into_iter()
                .collect();
            let window = WindowObservations {
                times_s: self.frames.iter().map(|f| f.time_s).collect(),
                poses: BTreeMap::from([(label, poses)]),
                contacts,
                ..WindowObservations::default()
            };
            let fit = fit_edge(joint, vec![vec![positions]], &[&window], &settings, &SharedByFits::default());
            joint = fit.joints[0];
            positions = fit.positions.into_iter().next()?.into_iter().next()?;
        }
        let screw = joint.screw();
        let mut motion = self.evaluate(label, |k| parents[k] * screw.displacement(positions[k]));
        let point = (joint_type == JointType::Revolute).then_some(joint.axis.point);
        motion.seed = Some((parent, AxisSeed { direction: joint.axis.direction, point }));
        motion.carrier = parent;
        Some(motion)
    }
}

/// The best of the motions offered so far.
struct Best {
    motion: Option<Motion>,
}

impl Best {
    fn offer(&mut self, score: f64, motion: Motion) {
        if self.motion.as_ref().is_none_or(|best| score < best.score) {
            self.motion = Some(Motion { score, ..motion });
        }
    }
}

/// A scan's pose near `predicted`: the Gauss–Newton optimum of what the scan holds, with its
/// information; directions that nothing holds stay as predicted.
pub fn measure(
    model: &PartModel,
    scan: &[ScanPoint],
    predicted: &Pose,
    settings: &AlignmentSettings,
) -> Option<PoseMeasurement> {
    measure_past(model, scan, &[], predicted, settings)
}

/// As `measure`, with the rays that go past the part: they show where its outline is not.
fn measure_past(
    model: &PartModel,
    scan: &[ScanPoint],
    past: &[ScanPoint],
    predicted: &Pose,
    settings: &AlignmentSettings,
) -> Option<PoseMeasurement> {
    if scan.len() < FEWEST_POINTS {
        return None;
    }
    let factor = pose_factor(model, scan, predicted, settings);
    if factor.matched < FEWEST_POINTS {
        return None;
    }
    let whole = Quadratic { hessian: factor.hessian(), gradient: factor.gradient() };
    Some(measurement_with_outline(model, &whole, scan, past, predicted))
}

/// As `measure_past`, apart for the faces of the first look and for those that came into view later.
pub fn measure_faces(
    model: &PartModel,
    scan: &[ScanPoint],
    past: &[ScanPoint],
    predicted: &Pose,
    settings: &AlignmentSettings,
) -> [Option<PoseMeasurement>; 2] {
    if scan.len() < FEWEST_POINTS {
        return [None; 2];
    }
    let factor = pose_factor(model, scan, predicted, settings);
    if factor.matched < FEWEST_POINTS {
        return [None; 2];
    }
    let [first, later] = factor.faces;
    [
        (first.hessian.trace() > 0.0).then(|| measurement_with_outline(model, &first, scan, past, predicted)),
        (later.hessian.trace() > 0.0).then(|| measurement_of(model, &later, predicted)),
    ]
}

/// The points of a frame whose rays may pass a part.
pub fn rays_past(frame: &Frame, label: Label, model: &PartModel, displacement: &Pose) -> Vec<ScanPoint> {
    if model.outlines.is_empty() {
        return Vec::new();
    }
    let others = frame.scans.iter().filter(|(other, _)| **other != label).flat_map(|(_, scan)| scan);
    rays_near(others, &displacement.transform_point(&model.centroid), model.reach())
}

fn measurement_with_outline(
    model: &PartModel,
    factor: &Quadratic,
    scan: &[ScanPoint],
    past: &[ScanPoint],
    predicted: &Pose,
) -> PoseMeasurement {
    let mut held = factor.cleaned(model.radius, FALSE_SHARE);
    if !past.is_empty() {
        let outline = outline_quadratic(&model.outlines, scan, past, predicted, &model.centroid, model.radius);
        held.hessian += outline.hessian;
        held.gradient += outline.gradient;
    }
    optimum(model, &held, predicted)
}

/// The pose measurement of a factor taken at `predicted`.
pub fn measurement_of(model: &PartModel, factor: &Quadratic, predicted: &Pose) -> PoseMeasurement {
    optimum(model, &factor.cleaned(model.radius, FALSE_SHARE), predicted)
}

fn optimum(model: &PartModel, held: &Quadratic, predicted: &Pose) -> PoseMeasurement {
    let information = held.hessian;
    let weak =
        Vector6::new(model.radius, model.radius, model.radius, 1.0, 1.0, 1.0).map(|s| s * s / MEASURED_WITHIN.powi(2));
    let step = (information + Matrix6::from_diagonal(&weak))
        .cholesky()
        .map_or_else(Vector6::zeros, |c| -c.solve(&held.gradient));
    let length = step.fixed_rows::<3>(0).norm() * model.radius + step.fixed_rows::<3>(3).norm();
    let step = if length > 3.0 * MEASURED_WITHIN { step * (3.0 * MEASURED_WITHIN / length) } else { step };
    let displacement = *predicted
        * Pose::from_translation(model.centroid)
        * Pose::exp(&step)
        * Pose::from_translation(-model.centroid);
    PoseMeasurement { displacement, information }
}

/// Positions of a joint to look at: least, greatest, step.
pub fn grid_of(model: &PartModel, screw: &Screw, joint_type: JointType) -> (f64, f64, f64) {
    match joint_type {
        JointType::Prismatic => (-0.6, 0.6, 0.010),
        _ => {
            let reach = axis_distance(screw, &model.centroid) + model.radius;
            let step = (0.012 / reach).clamp(0.02, 0.08);
            (-2.2, 2.2, step)
        }
    }
}

fn seed_type(seed: &AxisSeed) -> JointType {
    if seed.point.is_some() { JointType::Revolute } else { JointType::Prismatic }
}

/// How far a part's points are apart at two displacements, root mean square \[m\].
pub fn travel(model: &PartModel, from: &Pose, to: &Pose) -> f64 {
    let shift = (to.transform_point(&model.centroid) - from.transform_point(&model.centroid)).norm();
    let turn = (from.rotation.transpose() * to.rotation - nalgebra::Matrix3::identity()).norm() / 2f64.sqrt();
    shift + turn * model.radius
}

/// Distance of a point from a revolute screw's axis \[m\].
fn axis_distance(screw: &Screw, point: &Vector3<f64>) -> f64 {
    let angular: Vector3<f64> = screw.0.fixed_rows::<3>(0).into();
    let linear: Vector3<f64> = screw.0.fixed_rows::<3>(3).into();
    (angular.cross(point) + linear).norm()
}
