//! What has been learned of the object, window by window: the worker side of the pipeline.

use std::collections::BTreeMap;

use nalgebra::Vector3;

use super::explain::{Frame, Motion, Scene, explain_window, measure, travel};
use crate::math::Pose;
use crate::mechanism::JointType;
use crate::geometry::{HullProperties, hull_properties};
use crate::model::{DynamicsInput, DynamicsLearner, WindowInference};
use crate::model::{
    Axis, Contact, EdgeFit, EdgePart, KinematicFit, KinematicJoint, KinematicSettings, WindowObservations, axes_from_motion,
    fit_kinematics, moving_evidence, relative_windows, rigid_evidence,
};
use crate::registration::{AlignmentSettings, PartModel, SurfelAccumulator, fit_circle, fit_line, truncated_cost};
use crate::types::{AppliedWrench, Label};

/// A part moved if it ever travelled further than this \[m\].
const MOVED: f64 = 0.006;

/// One closed window, ready to be learned.
#[derive(Clone, Debug, Default)]
pub struct WindowJob {
    /// Its frames.
    pub frames: Vec<Frame>,
    /// The tool's contacts on those frames.
    pub contacts: Vec<Contact>,
    /// Wrench readings from before the window to after it.
    pub wrenches: Vec<AppliedWrench>,
    /// Time zero.
    pub zero: crate::types::Stamp,
}

/// Evidence for one parent of a part.
#[derive(Clone, Debug)]
pub struct ParentEvidence {
    /// `None`: whatever never moved.
    pub parent: Option<Label>,
    /// Log evidence of rigid, prismatic, revolute.
    pub log_evidence: [f64; 3],
    /// The fits of the moving types.
    pub fits: [Option<EdgeFit>; 3],
}

/// Kinematic state of everything learned.
pub struct Learner {
    /// The part fixed to the world.
    pub root: Label,
    /// Whether the tool's position is an observation.
    pub use_tool: bool,
    /// Reference models.
    pub models: BTreeMap<Label, PartModel>,
    /// Where the models grow from.
    pub accumulators: BTreeMap<Label, SurfelAccumulator>,
    /// Mean truncated cost per point at known poses.
    pub baselines: BTreeMap<Label, f64>,
    /// Displacements after the last window.
    pub displacements: BTreeMap<Label, Pose>,
    /// Every window's measurements.
    pub windows: Vec<WindowObservations>,
    /// Displacement of each part in each window's frames, as fitted.
    pub tracks: BTreeMap<Label, Vec<Vec<Pose>>>,
    /// Parts that moved, with the evidence for their parents.
    pub evidence: BTreeMap<Label, Vec<ParentEvidence>>,
    /// The likeliest joints, parents first, with the joint fit of all windows.
    pub fit: Option<KinematicFit>,
    /// Kinematic assumptions.
    pub settings: KinematicSettings,
    /// Friction, damping, inertia and end stops.
    pub dynamics: DynamicsLearner,
    /// What learning each window's dynamics gave.
    pub inferences: Vec<WindowInference>,
    /// Temporary: wall time of that \[s\].
    pub dynamics_wall_s: Vec<f64>,
    /// Hulls of the parts, as first seen.
    pub hulls: BTreeMap<Label, HullProperties>,
}

impl Learner {
    /// Nothing learned yet: models from the scans accumulated at the reference configuration.
    pub fn new(root: Label, use_tool: bool, accumulators: BTreeMap<Label, SurfelAccumulator>) -> Self {
        let models = accumulators.iter().filter_map(|(label, a)| Some((*label, a.build()?))).collect();
        Self {
            root,
            use_tool,
            models,
            accumulators,
            baselines: BTreeMap::new(),
            displacements: BTreeMap::new(),
            windows: Vec::new(),
            tracks: BTreeMap::new(),
            evidence: BTreeMap::new(),
            fit: None,
            settings: KinematicSettings::default(),
            dynamics: DynamicsLearner::new(Vector3::new(0.0, 0.0, -9.81)),
            inferences: Vec::new(),
            dynamics_wall_s: Vec::new(),
            hulls: BTreeMap::new(),
        }
    }

    /// The likeliest joints so far, parents first.
    pub fn joints(&self) -> &[KinematicJoint] {
        self.fit.as_ref().map_or(&[], |fit| &fit.joints)
    }

    /// Sets the baselines from frames at the reference configuration.
    pub fn calibrate(&mut self, frames: &[Frame]) {
        for (label, model) in &self.models {
            let costs: Vec<f64> = frames
                .iter()
                .filter_map(|f| f.scans.get(label))
                .filter(|scan| !scan.is_empty())
                .map(|scan| truncated_cost(model, scan, scan.len() / 150, &Pose::identity()))
                .collect();
            if !costs.is_empty() {
                self.baselines.insert(*label, costs.iter().sum::<f64>() / costs.len() as f64);
            }
        }
    }

    /// Learns one window.
    pub fn learn(&mut self, job: &WindowJob) {
        let scene = Scene {
            frames: &job.frames,
            contacts: &job.contacts,
            models: &self.models,
            baselines: &self.baselines,
            start: &self.displacements,
            joints: self.joints(),
            root: self.root,
            use_tool: self.use_tool,
        };
        let motions = explain_window(&scene);
        for (label, motion) in &motions {
            tracing::debug!(%label, moved = motion.moved, excess = motion.excess, seed = ?motion.seed, "motion");
        }
        let mut observations = WindowObservations {
            times_s: job.frames.iter().map(|f| f.time_s).collect(),
            contacts: if self.use_tool { job.contacts.clone() } else { Vec::new() },
            wrenches: job.wrenches.clone(),
            ..WindowObservations::default()
        };
        for (label, motion) in &motions {
            observations.poses.insert(*label, self.measure_along(*label, &motion.displacements, &job.frames));
            self.tracks.entry(*label).or_default().push(motion.displacements.clone());
        }
        self.windows.push(observations);
        for round in 0..2 {
            self.weigh_edges(&motions);
            self.fit_joints();
            self.remeasure(job);
            if round == 1 {
                self.fit_joints();
            }
        }
        self.grow(job);
        self.learn_dynamics(job);
    }

    fn learn_dynamics(&mut self, job: &WindowJob) {
        for label in self.models.keys() {
            if let Some(hull) = self.accumulators.get(label).and_then(|a| hull_properties(&a.voxel_means(3.0), None)) {
                self.hulls.insert(*label, hull);
            }
        }
        let Some(fit) = &self.fit else { return };
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let input = DynamicsInput { windows: &windows, contacts: &job.contacts, zero: job.zero, parts: &self.hulls, use_tool: self.use_tool };
        let begin = std::time::Instant::now();
        self.inferences.push(self.dynamics.learn_window(fit, &input));
        self.dynamics_wall_s.push(begin.elapsed().as_secs_f64());
    }

    fn measure_along(&self, label: Label, track: &[Pose], frames: &[Frame]) -> Vec<Option<crate::model::PoseMeasurement>> {
        let settings = AlignmentSettings { gate: 0.02, ..AlignmentSettings::default() };
        frames
            .iter()
            .zip(track)
            .map(|(frame, displacement)| measure(self.models.get(&label)?, frame.scans.get(&label)?, displacement, &settings))
            .collect()
    }

    fn part(&self, label: Label) -> EdgePart {
        let model = &self.models[&label];
        EdgePart { label, center: model.centroid, radius: model.radius }
    }

    fn ever_moved(&self, label: Label) -> bool {
        let model = &self.models[&label];
        self.tracks
            .get(&label)
            .is_some_and(|windows| windows.iter().flatten().any(|d| travel(model, &Pose::identity(), d) > MOVED))
    }

    /// Evidence for every parent and type of every part that moved.
    fn weigh_edges(&mut self, motions: &BTreeMap<Label, Motion>) {
        let movers: Vec<Label> = self.tracks.keys().copied().filter(|&label| self.ever_moved(label)).collect();
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let mut evidence = BTreeMap::new();
        for &child in &movers {
            let part = self.part(child);
            let mut parents: Vec<Option<Label>> = vec![None];
            parents.extend(movers.iter().filter(|l| **l != child).map(|l| Some(*l)));
            let mut options = Vec::new();
            for parent in parents {
                let track = parent.map(|p| self.tracks[&p].as_slice());
                let relative = relative_windows(child, track, &windows);
                let rigid = rigid_evidence(&part, &relative, &self.settings);
                let mut option = ParentEvidence { parent, log_evidence: [rigid; 3], fits: [None, None, None] };
                for joint_type in [JointType::Prismatic, JointType::Revolute] {
                    let starts = self.start_axes(&part, parent, joint_type, &relative, motions);
                    let fit = moving_evidence(&part, joint_type, &starts, &relative, &self.settings);
                    let slot = joint_type as usize;
                    if let Some(fit) = fit {
                        option.log_evidence[slot] = option.log_evidence[slot].max(fit.log_evidence);
                        option.fits[slot] = Some(fit);
                    }
                }
                tracing::debug!(%child, parent = ?option.parent, evidence = ?option.log_evidence, "edge");
                options.push(option);
            }
            evidence.insert(child, options);
        }
        self.evidence = evidence;
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
        let known = self.evidence.get(&part.label).and_then(|options| {
            options.iter().find(|o| o.parent == parent)?.fits[joint_type as usize].as_ref().map(|f| f.joint.axis)
        });
        starts.extend(known);
        if let Some((seed_parent, seed)) = motions.get(&part.label).and_then(|m| m.seed.as_ref()) {
            let seed_type = if seed.point.is_some() { JointType::Revolute } else { JointType::Prismatic };
            if *seed_parent == parent && seed_type == joint_type {
                starts.push(Axis { direction: seed.direction, point: seed.point.unwrap_or(part.center) });
            }
        }
        if known.is_some() {
            return starts;
        }
        for window in relative {
            for contact in &window.contacts {
                let track: Vec<Vector3<f64>> = contact.track.iter().map(|(_, x, _)| *x).collect();
                let seed = match joint_type {
                    JointType::Prismatic => fit_line(&track),
                    _ => fit_circle(&track),
                };
                if let Some((seed, _)) = seed {
                    starts.push(Axis { direction: seed.direction, point: seed.point.unwrap_or(part.center) });
                }
            }
        }
        starts.extend(axes_from_motion(part, joint_type, relative));
        starts.truncate(4);
        starts
    }

    /// The likeliest parent and type of each mover, as a tree with parents first.
    fn likeliest(&self) -> Vec<(Label, Option<Label>, JointType, Axis)> {
        let mut left: BTreeMap<Label, &Vec<ParentEvidence>> = self.evidence.iter().map(|(l, e)| (*l, e)).collect();
        let mut order: Vec<(Label, Option<Label>, JointType, Axis)> = Vec::new();
        while !left.is_empty() {
            // Attach the part whose best parent is already in place, best evidence first.
            let mut best: Option<(f64, Label, Option<Label>, JointType, Axis)> = None;
            for (&child, options) in &left {
                let top = options.iter().map(|o| o.log_evidence[1].max(o.log_evidence[2])).fold(f64::NEG_INFINITY, f64::max);
                for option in options.iter() {
                    let placed = option.parent.is_none_or(|p| order.iter().any(|(l, ..)| *l == p));
                    if !placed {
                        continue;
                    }
                    for joint_type in [JointType::Prismatic, JointType::Revolute] {
                        let Some(fit) = &option.fits[joint_type as usize] else { continue };
                        let regret = fit.log_evidence - top;
                        if best.as_ref().is_none_or(|(b, ..)| regret > *b) {
                            best = Some((regret, child, option.parent, joint_type, fit.joint.axis));
                        }
                    }
                }
            }
            let Some((_, child, parent, joint_type, axis)) = best else { break };
            order.push((child, parent, joint_type, axis));
            left.remove(&child);
        }
        order
    }

    /// Fits all joints of the likeliest tree to all windows.
    fn fit_joints(&mut self) {
        let tree = self.likeliest();
        let index = |label: Label| tree.iter().position(|(l, ..)| *l == label);
        let joints: Vec<KinematicJoint> = tree
            .iter()
            .map(|(child, parent, joint_type, axis)| {
                let part = self.part(*child);
                KinematicJoint {
                    parent: parent.and_then(index),
                    child: *child,
                    joint_type: *joint_type,
                    axis: *axis,
                    center: part.center,
                    radius: part.radius,
                }
            })
            .collect();
        if joints.is_empty() {
            return;
        }
        let positions = (0..self.windows.len())
            .map(|w| {
                tree.iter()
                    .map(|(child, parent, joint_type, _)| {
                        self.evidence[child]
                            .iter()
                            .find(|o| o.parent == *parent)
                            .and_then(|o| o.fits[*joint_type as usize].as_ref())
                            .map_or_else(|| vec![0.0; self.windows[w].times_s.len()], |f| f.positions[w].clone())
                    })
                    .collect()
            })
            .collect();
        let windows: Vec<&WindowObservations> = self.windows.iter().collect();
        let fit = fit_kinematics(joints, positions, &windows, &self.settings);
        for (w, window) in self.windows.iter().enumerate() {
            for frame in 0..window.times_s.len() {
                for (joint, displacement) in fit.joints.iter().zip(fit.displacements(w, frame)) {
                    if let Some(track) = self.tracks.get_mut(&joint.child) {
                        track[w][frame] = displacement;
                    }
                }
            }
        }
        self.fit = Some(fit);
    }

    /// Takes the window's measurements again, at the fitted poses.
    fn remeasure(&mut self, job: &WindowJob) {
        let last = self.windows.len() - 1;
        let labels: Vec<Label> = self.joints().iter().map(|j| j.child).collect();
        for label in labels {
            let measured = self.measure_along(label, &self.tracks[&label][last], &job.frames);
            self.windows[last].poses.insert(label, measured);
        }
    }

    /// Adds what the window showed of new faces to the models.
    fn grow(&mut self, job: &WindowJob) {
        let last = self.windows.len() - 1;
        for (label, tracks) in &self.tracks {
            let track = &tracks[last];
            if let Some(end) = track.last() {
                self.displacements.insert(*label, *end);
            }
            let Some(accumulator) = self.accumulators.get_mut(label) else { continue };
            let every = (job.frames.len() / 8).max(1);
            for (frame, displacement) in job.frames.iter().zip(track).step_by(every) {
                if let Some(scan) = frame.scans.get(label) {
                    accumulator.add(scan, displacement);
                }
            }
            if let Some(model) = accumulator.build() {
                self.models.insert(*label, model);
            }
        }
    }
}
