//! Where every part is, by whichever account the clouds bear out: its joint, rest, or registration.

use std::collections::{BTreeMap, BTreeSet};

use nalgebra::{Vector3, Vector6};

use super::explain::{FEWEST_POINTS, travel};
use super::touch::Toucher;
use super::{Frame, Learner};
use crate::math::Pose;
use crate::registration::{AlignmentSettings, PartModel, ScanPoint, follow, thinned_cost};
use crate::tracking::{Account, Filter, FreePart, Presence};
use crate::types::Label;

/// Excess cost below which a pose explains a scan: it need not be registered.
const WELL_EXPLAINED: f64 = 0.25;
/// Points of a scan that are registered: neighbours say little more.
const SCAN_POINTS: usize = 500;
/// A pose that explains a scan badly may be off by this per unit of excess \[m\].
const DOUBT: f64 = 0.03;
/// Excess beyond which a registered pose does not explain its scan: it is looked for further away.
const BADLY_EXPLAINED: f64 = 0.6;
/// Registered poses further apart than this are not one motion \[m\].
const JUMP: f64 = 0.02;
/// Registered poses are kept for so long \[s\].
const KEPT: f64 = 0.6;
/// A scan's mean goes this far by what of the part is seen \[m\].
const MEAN_WENT: f64 = 0.02;
/// A part found anew this soon after it was where its joint had it, and this far from there, moves \[s, m\].
const FOUND_AGAIN: (f64, f64) = (0.6, 0.015);
/// Excess cost below which a part is where its joint has it.
const IN_PLACE: f64 = 0.05;
/// A scan that is lost is looked for this far turned away from where it was \[rad\].
const TURN: f64 = 0.25;

/// What is said of a part.
#[derive(Clone, Copy, Debug)]
pub(super) struct Told {
    /// It without its joint.
    pub free: FreePart,
    /// The probability that its joint has it right.
    pub by_joint: f64,
    /// Where it is.
    pub now: Pose,
}

/// The accounts of all parts.
#[derive(Default)]
pub(super) struct Whereabouts {
    presences: BTreeMap<Label, Presence>,
    /// Parts as registration follows them where nothing else explains them.
    scan_poses: BTreeMap<Label, Vec<(f64, Pose)>>,
    /// Means of the parts' last scans \[m\].
    means: BTreeMap<Label, Vector3<f64>>,
    /// Where parts were left.
    places: BTreeMap<Label, Pose>,
    /// When and where a part last was on its joint, as seen or as found anew \[s; m or rad\].
    found: BTreeMap<Label, (f64, f64)>,
}

impl Whereabouts {
    /// A new posterior: its joints start anew, and parts are where it left them.
    pub fn restart(&mut self, places: BTreeMap<Label, Pose>) {
        self.places = places;
        self.found.clear();
        for presence in self.presences.values_mut() {
            presence.clear(Account::Joint);
            presence.clear(Account::Place);
        }
    }

    /// A part was let go: it stays where it was last seen.
    pub fn leave(&mut self, label: Label) {
        if let Some((_, pose)) = self.scan_poses.get(&label).and_then(|poses| poses.last()) {
            self.places.insert(label, *pose);
        }
    }

    /// Looks at a frame; what is then known of every part.
    pub fn look(
        &mut self,
        frame: &Frame,
        labels: &BTreeSet<Label>,
        learner: Option<&Learner>,
        filter: Option<&Filter>,
        toucher: &Toucher,
    ) -> BTreeMap<Label, Told> {
        let jointed = filter.map(Filter::trusted_parts).unwrap_or_default();
        let mut told = BTreeMap::new();
        for &label in labels {
            let place = self.places.get(&label).copied().unwrap_or_else(Pose::identity);
            let joint = jointed.get(&label).copied();
            let unseen = Told {
                free: FreePart::resting(joint.unwrap_or(place)),
                by_joint: if joint.is_some() { 1.0 } else { 0.0 },
                now: joint.unwrap_or(place),
            };
            let posed = learner.and_then(|learner| {
                let pose = learner.posed.get(&label)?.measurement(frame.poses.get(&label)?);
                Some((learner.models.get(&label)?, pose.displacement))
            });
            if let Some((model, pose)) = posed {
                let poses = self.scan_poses.entry(label).or_default();
                poses.push((frame.time_s, pose));
                poses.retain(|(t, _)| frame.time_s - t < KEPT);
                let free = FreePart::followed(poses, model.centroid, model.radius, &[]);
                told.insert(label, Told { free, now: joint.unwrap_or(pose), ..unseen });
                continue;
            }
            let seen = learner.and_then(|learner| {
                let (model, scan) = (learner.models.get(&label)?, frame.scans.get(&label)?);
                (label != learner.root && scan.len() >= FEWEST_POINTS).then_some((learner, model, scan))
            });
            let Some((learner, model, scan)) = seen else {
                told.insert(label, unseen);
                continue;
            };
            // A pose that puts the part beyond its own size from its points is none.
            let mean = scan.iter().map(|p| p.point_in_world).sum::<Vector3<f64>>() / scan.len() as f64;
            let joint = joint.filter(|pose| (pose.transform_point(&model.centroid) - mean).norm() < 3.0 * model.radius);
            let tool = toucher.track_of(label).filter(|_| learner.use_tool).unwrap_or(&[]);
            let usual = learner.usual_cost(label);
            let presence = self.presences.entry(label).or_default();
            let poses = self.scan_poses.entry(label).or_default();
            let known = joint.unwrap_or(place);
            let excess = |pose: &Pose| thinned_cost(model, scan, pose) - usual;
            let went = mean - self.means.insert(label, mean).unwrap_or(mean);
            let pose = if excess(&known) < WELL_EXPLAINED {
                known
            } else {
                let clues = Clues { now_s: frame.time_s, known: &known, tool, went, usual };
                register(model, scan, poses, &clues)
            };
            if poses.last().is_some_and(|(_, last)| pose == known && travel(model, last, &pose) > JUMP) {
                poses.clear();
            }
            poses.push((frame.time_s, pose));
            poses.retain(|(t, _)| frame.time_s - t < KEPT);
            let resting = joint.is_none().then_some(place);
            presence.see(model, scan, usual, [joint, resting, Some(pose)]);
            let weights = presence.weights([joint.is_some(), resting.is_some(), true]);
            tracing::debug!(time_s = frame.time_s, %label, ?presence, ?weights, "whereabouts");
            let rests = tool.is_empty() && weights[Account::Place as usize] > weights[Account::Scan as usize];
            let mut free = if rests {
                FreePart::resting(place)
            } else {
                FreePart::followed(poses, model.centroid, model.radius, tool)
            };
            let account = if rests { Account::Place } else { Account::Scan };
            free.doubt_m = DOUBT * presence.excess(account).unwrap_or(0.0);
            let by_joint = weights[Account::Joint as usize];
            let now = joint.filter(|_| by_joint > 0.5).unwrap_or(free.displacement);
            told.insert(label, Told { free, by_joint, now });
        }
        told
    }

    /// Parts that are not where the filter has them are looked for along their joints.
    pub fn relocate(&mut self, frame: &Frame, learner: &Learner, filter: &mut Filter) {
        for body in 0..filter.mechanism().joints.len() {
            let label = filter.mechanism().joints[body].child;
            let (Some(presence), Some(model), Some(scan)) =
                (self.presences.get_mut(&label), learner.models.get(&label), frame.scans.get(&label))
            else {
                continue;
            };
            if presence.excess(Account::Joint).is_some_and(|excess| excess < IN_PLACE) {
                self.found.insert(label, (frame.time_s, filter.positions()[body]));
            }
            if !presence.is_lost(Account::Joint) || scan.len() < FEWEST_POINTS {
                continue;
            }
            let cost = |pose: &Pose| thinned_cost(model, scan, pose);
            let usual = learner.usual_cost(label);
            let found = filter.places_along(body).into_iter().map(|(q, pose)| (cost(&pose), q));
            if let Some((least, q)) = found.min_by(|a, b| a.0.total_cmp(&b.0))
                && least - usual < 0.5 * presence.excess(Account::Joint).unwrap_or(0.0)
            {
                // It may coast on: registration has followed it meanwhile.
                let poses = self.scan_poses.get(&label).map_or(&[][..], Vec::as_slice);
                let free = FreePart::followed(poses, model.centroid, model.radius, &[]);
                filter.place(body, q, 0.0);
                let center = free.displacement.transform_point(&filter.mechanism().centers[body]);
                let mut rate = filter.rate_of(body, &free.velocity_at(&center));
                // Registration may have stayed at where the joint had it.
                if let Some((then_s, there)) = self.found.insert(label, (frame.time_s, q))
                    && frame.time_s - then_s < FOUND_AGAIN.0
                    && (q - there).abs() * filter.mechanism().reach(body) > FOUND_AGAIN.1
                    && rate == 0.0
                {
                    rate = (q - there) / (frame.time_s - then_s).max(1e-3);
                }
                filter.place(body, q, rate);
                presence.clear(Account::Joint);
            }
        }
    }
}

/// What says where a scan's part may have gone.
struct Clues<'a> {
    now_s: f64,
    /// Where it was expected.
    known: &'a Pose,
    /// The tool's positions, if it holds it.
    tool: &'a [(f64, Vector3<f64>)],
    /// How far the mean of its scan went since the last \[m\].
    went: Vector3<f64>,
    /// What its scans cost where its pose is known.
    usual: f64,
}

/// A scan's pose by registration from where it was, from where its motion led, and from where the tool or
/// its scan's mean went; if none of these explains it, from turned ones as well.
fn register(model: &PartModel, scan: &[ScanPoint], poses: &[(f64, Pose)], clues: &Clues<'_>) -> Pose {
    let Clues { now_s, known, tool, went, usual } = clues;
    let points: Vec<ScanPoint> = scan.iter().step_by((scan.len() / SCAN_POINTS).max(1)).copied().collect();
    let cost = |pose: &Pose| thinned_cost(model, &points, pose);
    let fit = |start: &Pose| follow(model, &points, start, &AlignmentSettings::default());
    let Some(&(then_s, last)) = poses.last() else { return fit(known).displacement };
    let mut starts = vec![last];
    let followed = FreePart::followed(poses, model.centroid, model.radius, &[]);
    let ahead = followed.after(*now_s - then_s).0;
    if travel(model, &last, &ahead) > 0.002 {
        starts.push(ahead);
    }
    let before = tool.iter().rev().find(|(t, _)| *t <= then_s);
    if let (Some((_, from)), Some((_, to))) = (before, tool.last()) {
        starts.push(Pose::from_translation(to - from) * last);
    }
    // Between two frames a part can go further than points are matched.
    if went.norm() > MEAN_WENT {
        starts.push(Pose::from_translation(*went) * last);
    }
    let best = |starts: &[Pose]| {
        let fitted = starts.iter().map(|start| fit(start).displacement).map(|pose| (cost(&pose), pose));
        fitted.min_by(|a, b| a.0.total_cmp(&b.0)).unwrap_or((f64::INFINITY, last))
    };
    let (least, pose) = best(&starts);
    if least - usual < BADLY_EXPLAINED {
        return pose;
    }
    let center = Pose::from_translation(model.centroid);
    let mean = points.iter().map(|p| p.point_in_world).sum::<Vector3<f64>>() / points.len().max(1) as f64;
    let last = Pose::from_translation(mean - last.transform_point(&model.centroid)) * last;
    let turned: Vec<Pose> = (0..6)
        .map(|i| {
            let mut turn = Vector6::zeros();
            turn[i / 2] = if i % 2 == 0 { TURN } else { -TURN };
            last * center * Pose::exp(&turn) * Pose::from_translation(-model.centroid)
        })
        .chain([**known, last])
        .collect();
    let (other, far) = best(&turned);
    if other < least { far } else { pose }
}
