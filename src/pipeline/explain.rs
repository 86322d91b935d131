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

use crate::math::{Pose, Screw};
use crate::mechanism::JointType;
use crate::model::{
    Axis, Contact, KinematicJoint, KinematicSettings, PoseMeasurement, WindowObservations, fit_kinematics,
};
use crate::registration::{
    AlignmentSettings, AxisSeed, JointFrame, JointPath, OUTLIER_COST, PartModel, Quadratic, ScanPoint, fit_circle,
    fit_line, geometric_seeds, pose_factor, search_path, truncated_cost,
};
use crate::types::Label;

/// Excess of the mean truncated cost over the part's own baseline that counts as explained.
const EXPLAINED: f64 = 0.12;
/// A tool track explained to this root mean square is explained \[m\].
const TOOL_EXPLAINED: f64 = 0.003;
/// Excess at which a part that was taken for the root is looked at like the others.
const LEFT: f64 = 0.6;
/// Share of the largest eigenvalue of a factor that rough normals may pretend to hold.
pub const FALSE_SHARE: f64 = 0.01;
/// A motion may start this far from where the part was, before it costs \[m\].
const START_JUMP: f64 = 0.006;
/// A linearization is believed about this far \[m\]: weaker directions stay as predicted.
const MEASURED_WITHIN: f64 = 0.010;
/// Scans with fewer points say nothing of a pose.
pub const FEWEST_POINTS: usize = 25;

/// The clouds of one stamp, by part.
#[derive(Clone, Debug, Default)]
pub struct Frame {
    /// Seconds since time zero.
    pub time_s: f64,
    /// Each part's points.
    pub scans: BTreeMap<Label, Vec<ScanPoint>>,
}

/// What a part's scans cost where its pose is known.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct Baseline {
    /// Mean truncated cost per point.
    pub cost: f64,
    /// Mean number of points in a scan.
    pub points: f64,
}

/// What a window's motion is explained with.
#[derive(Clone, Copy)]
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
}

/// The motions of all parts with a model, but the root.
pub fn explain_window(scene: &Scene<'_>) -> BTreeMap<Label, Motion> {
    let mut motions: BTreeMap<Label, Motion> = BTreeMap::new();
    let mut open: Vec<Label> = Vec::new();
    for &label in scene.models.keys().filter(|&&label| Some(label) != scene.root) {
        let still = scene.evaluate(label, |_| scene.start_of(label));
        if still.excess < EXPLAINED && scene.tool_miss(label, &still.displacements) < TOOL_EXPLAINED {
            motions.insert(label, still);
        } else {
            open.push(label);
        }
    }
    while !open.is_empty() {
        let mut best: Option<(f64, usize, Motion)> = None;
        let offers: Vec<Option<Motion>> = open.par_iter().map(|&label| scene.best_motion(label, &motions)).collect();
        for (index, (&label, offer)) in open.iter().zip(offers).enumerate() {
            let Some(motion) = offer else { continue };
            let score =
                motion.excess + 0.05 * (scene.tool_miss(label, &motion.displacements) / TOOL_EXPLAINED).min(20.0);
            if best.as_ref().is_none_or(|(other, _, _)| score < *other) {
                best = Some((score, index, motion));
            }
        }
        let Some((_, index, motion)) = best else { break };
        let label = open.remove(index);
        let still = scene.evaluate(label, |_| scene.start_of(label));
        motions.insert(label, if scene.beats(label, &motion, &still) { motion } else { still });
    }
    for label in open {
        motions.insert(label, scene.evaluate(label, |_| scene.start_of(label)));
    }
    motions
}

impl Scene<'_> {
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

    fn contact(&self, label: Label) -> Option<&Contact> {
        self.contacts.iter().find(|contact| self.use_tool && contact.label == label)
    }

    /// The cost of a given motion of a part.
    fn evaluate(&self, label: Label, displacement: impl Fn(usize) -> Pose) -> Motion {
        let displacements: Vec<Pose> = (0..self.frames.len()).map(displacement).collect();
        let model = &self.models[&label];
        let baseline = self.baselines.get(&label).copied().unwrap_or_default();
        let costs: Vec<f64> = displacements
            .iter()
            .enumerate()
            .filter(|(k, _)| !self.scan(label, *k).is_empty())
            .map(|(k, d)| {
                let scan = self.scan(label, k);
                let cost = truncated_cost(model, scan, scan.len() / 150, d);
                // Per point, what is turned away from the sensor does not count; per scan, new faces
                // do not. Either may happen, so the smaller excess is taken.
                let per_point = cost - baseline.cost;
                let matched = (OUTLIER_COST - cost) * scan.len() as f64 / baseline.points.max(1.0);
                per_point.min(OUTLIER_COST - baseline.cost - matched).max(-0.3)
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
        Motion { displacements, moved, excess: mean.max(0.6 * worst), seed: None }
    }

    /// Root mean square by which the tool misses a contact point that is fixed on the part \[m\].
    fn tool_miss(&self, label: Label, displacements: &[Pose]) -> f64 {
        let Some(contact) = self.contact(label) else { return 0.0 };
        let points: Vec<Vector3<f64>> =
            contact.track.iter().map(|(k, x, _)| displacements[*k].inverse().transform_point(x)).collect();
        let count = points.len().max(1) as f64;
        let mean = points.iter().sum::<Vector3<f64>>() / count;
        (points.iter().map(|p| (p - mean).norm_squared()).sum::<f64>() / count).sqrt()
    }

    /// Whether a motion explains a part clearly better than rest. A cost that stays high either way
    /// is a new face coming into view, not motion.
    fn beats(&self, label: Label, motion: &Motion, still: &Motion) -> bool {
        let gain = still.excess - motion.excess;
        let share = if self.contacts.iter().any(|c| c.label == label) { 0.3 } else { 0.5 };
        let seen = gain > EXPLAINED && gain > share * still.excess;
        let miss = self.tool_miss(label, &still.displacements);
        let felt = miss > TOOL_EXPLAINED && self.tool_miss(label, &motion.displacements) < 0.5 * miss && gain > -0.2;
        seen || felt
    }

    fn best_motion(&self, label: Label, known: &BTreeMap<Label, Motion>) -> Option<Motion> {
        let model = &self.models[&label];
        let mut best = Best { motion: None, score: f64::INFINITY };
        let mut known_joint = false;
        let score = |motion: &Motion, complexity: f64| {
            let miss = self.tool_miss(label, &motion.displacements);
            // A motion starts where the part was.
            let jump = motion.displacements.first().map_or(0.0, |d| travel(model, &self.start_of(label), d));
            motion.excess + complexity + 0.05 * (miss / TOOL_EXPLAINED).min(20.0) + 0.05 * (jump / START_JUMP).min(20.0)
        };
        // Along the joint that is known.
        if let Some(joint) = self.joints.iter().find(|joint| joint.child == label) {
            let parent = joint.parent.map(|p| self.joints[p].child);
            if let Some(parents) = self.parent_track(parent, known) {
                let motion = self.along(label, &joint.screw(), joint.joint_type, &parents);
                known_joint = self.touched_before.contains(&label);
                best.offer(score(&motion, 0.0), motion);
            }
        }
        let movers: Vec<Label> = known.iter().filter(|(_, m)| m.moved).map(|(l, _)| *l).collect();
        for &carrier in &movers {
            let track = &known[&carrier].displacements;
            let fixed = track[0].inverse() * self.start_of(label);
            let motion = self.evaluate(label, |k| track[k] * fixed);
            best.offer(score(&motion, 0.0), motion);
        }
        let still = self.evaluate(label, |_| self.start_of(label));
        if let Some(motion) = &best.motion {
            let held = self.tool_miss(label, &motion.displacements) < 1.5 * TOOL_EXPLAINED;
            if held && (known_joint || motion.excess < EXPLAINED || motion.excess < 0.3 * still.excess) {
                return best.motion;
            }
        }
        let mut parents: Vec<Option<Label>> = vec![None];
        parents.extend(movers.iter().map(|l| Some(*l)));
        parents.extend(
            known
                .iter()
                .filter(|(l, m)| !m.moved && travel(&self.models[*l], &Pose::identity(), &self.start_of(**l)) > 0.005)
                .map(|(l, _)| Some(*l)),
        );
        // A part that nothing touches needs a better reason for a joint of its own: what it shows anew
        // must not pass for motion.
        let touched = self.contacts.iter().any(|c| c.label == label);
        let carried = best.motion.as_ref().map_or(still.excess, |m| m.excess.min(still.excess));
        let reluctance = 0.02 + if touched { 0.0 } else { 0.1 + 0.4 * carried.max(0.0) };
        let most = if best.score < 2.0 * EXPLAINED { 2 } else { 4 };
        for (rank, parent) in parents.iter().enumerate() {
            let Some(track) = self.parent_track(*parent, known) else { continue };
            for seed in self.seeds(label, model, &track, most) {
                let Some(motion) = self.refine(label, *parent, &seed, &track) else { continue };
                best.offer(score(&motion, reluctance + if rank > 0 { 0.02 } else { 0.0 }), motion);
            }
        }
        best.motion
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
            return seeds.into_iter().map(|(seed, _)| seed).collect();
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
        ranked.into_iter().take(most).map(|(_, seed)| seed).collect()
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
        for gate in [0.05, 0.03, 0.02] {
            let alignment = AlignmentSettings { gate, ..AlignmentSettings::default() };
            let screw = joint.screw();
            let relative: Vec<Pose> = positions.iter().map(|&q| screw.displacement(q)).collect();
            let poses = (0..self.frames.len())
                .map(|k| {
                    let scan = self.scan(label, k);
                    let measured = measure(model, scan, &(parents[k] * relative[k]), &alignment)?;
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
            let fit = fit_kinematics(vec![joint], vec![vec![positions]], &[&window], &settings);
            joint = fit.joints[0];
            positions = fit.positions.into_iter().next()?.into_iter().next()?;
        }
        let screw = joint.screw();
        let mut motion = self.evaluate(label, |k| parents[k] * screw.displacement(positions[k]));
        let point = (joint_type == JointType::Revolute).then_some(joint.axis.point);
        motion.seed = Some((parent, AxisSeed { direction: joint.axis.direction, point }));
        Some(motion)
    }
}

/// The best of the motions offered so far.
struct Best {
    motion: Option<Motion>,
    score: f64,
}

impl Best {
    fn offer(&mut self, score: f64, motion: Motion) {
        if score < self.score {
            (self.score, self.motion) = (score, Some(motion));
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
    if scan.len() < FEWEST_POINTS {
        return None;
    }
    let factor = pose_factor(model, scan, predicted, settings);
    if factor.matched < FEWEST_POINTS {
        return None;
    }
    let whole = Quadratic { hessian: factor.hessian(), gradient: factor.gradient() };
    Some(measurement_of(model, &whole, predicted))
}

/// As `measure`, apart for the faces of the first look and for those that came into view later.
pub fn measure_faces(
    model: &PartModel,
    scan: &[ScanPoint],
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
    factor.faces.map(|face| (face.hessian.trace() > 0.0).then(|| measurement_of(model, &face, predicted)))
}

/// The pose measurement of a factor taken at `predicted`.
pub fn measurement_of(model: &PartModel, factor: &Quadratic, predicted: &Pose) -> PoseMeasurement {
    let information = factor.information(model.radius, FALSE_SHARE);
    let weak =
        Vector6::new(model.radius, model.radius, model.radius, 1.0, 1.0, 1.0).map(|s| s * s / MEASURED_WITHIN.powi(2));
    let step = (information + Matrix6::from_diagonal(&weak))
        .cholesky()
        .map_or_else(Vector6::zeros, |c| -c.solve(&factor.gradient));
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
