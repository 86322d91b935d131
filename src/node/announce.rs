//! What the stream says, as messages: posterior, predictions, criticism, and what planners draw on.

use std::collections::{BTreeMap, BTreeSet};
use std::sync::Arc;
use std::time::{Duration, Instant};

use nalgebra::{Vector3, Vector6};
use ros2_interfaces_jazzy_serde::tf2_msgs::msg::TFMessage;
use tracing::warn;

use super::drawing::{Drawing, Model, Scene};
use super::health::now;
use super::publications::{Outputs, Publication};
use crate::geometry::HullProperties;
use crate::io::counters::Counters;
use crate::math::Pose;
use crate::pipeline::{Learned, Pipeline};
use crate::ros::{
    self, FixedFrame, FutureWrench, LinkTree, PartPrediction, joint_states, link_transforms, place_joints,
    predicted_transforms,
};
use crate::types::finite::NotFinite;
use crate::types::posterior::{Criticism, ObjectPosterior};
use crate::types::{Label, Stamp};

/// How often the scene is drawn, if it does not change.
const DRAW_EVERY: Duration = Duration::from_millis(400);

/// A part that floats gets its joint back after so long on it \[s\].
const BACK_ON_JOINT_S: f64 = 1.0;

/// Keeps what messages are made of.
pub struct Announcer {
    outputs: Outputs,
    drawing: Drawing,
    frame: FixedFrame,
    model: Option<Arc<Model>>,
    /// The posterior's tree; that of the description has parts that float.
    likeliest: LinkTree,
    /// Parts that were off their joints lately, and when last.
    off_joint: BTreeMap<Label, Stamp>,
    displacements: BTreeMap<Label, Pose>,
    /// Twists of the parts' joints against their parents.
    twists: BTreeMap<Label, Vector6<f64>>,
    /// Joint positions, to count turns.
    positions: BTreeMap<Label, f64>,
    /// Whether a window was learned.
    learned: bool,
    /// What frames on /tf begin with; `None`: they are not sent.
    tf_prefix: Option<String>,
    drawn: Option<Instant>,
}

impl Announcer {
    /// Nothing is known; all is said in `fixed_frame`.
    pub fn new(outputs: Outputs, drawing: Drawing, fixed_frame: String) -> Self {
        Self {
            outputs,
            drawing,
            frame: FixedFrame { name: fixed_frame, zero: Stamp::default() },
            model: None,
            likeliest: LinkTree::default(),
            off_joint: BTreeMap::new(),
            displacements: BTreeMap::new(),
            twists: BTreeMap::new(),
            positions: BTreeMap::new(),
            learned: false,
            tf_prefix: None,
            drawn: None,
        }
    }

    /// Forgets what was said; all is said in `fixed_frame` from now on.
    pub fn begin(&mut self, fixed_frame: &str) {
        self.frame = FixedFrame { name: fixed_frame.to_owned(), zero: Stamp::default() };
        (self.model, self.learned, self.drawn) = (None, false, None);
        self.displacements.clear();
        self.twists.clear();
        self.positions.clear();
    }

    /// Parts' frames go on /tf with this before their names, or not at all.
    pub fn publish_tf(&mut self, prefix: Option<String>) {
        self.tf_prefix = prefix;
    }

    fn send_tf(&self, mut transforms: TFMessage) {
        let Some(prefix) = &self.tf_prefix else { return };
        transforms.transforms.iter_mut().for_each(|transform| transform.child_frame_id.insert_str(0, prefix));
        self.outputs.send(Publication::Tf(transforms));
    }

    /// Centres of mass of all parts at the first frame \[m\].
    pub fn centers(&self) -> BTreeMap<Label, Vector3<f64>> {
        let parts = self.model.iter().flat_map(|model| &model.posterior.parts);
        parts.map(|part| (part.label, part.com_in_world_m.into())).collect()
    }

    /// A part's centre of mass at the first frame \[m\].
    pub fn center(&self, label: Label) -> Option<Vector3<f64>> {
        let parts = &self.model.as_ref()?.posterior.parts;
        parts.iter().find(|part| part.label == label).map(|part| part.com_in_world_m.into())
    }

    /// Where a part is, and the twist of its joint against its parent, (angular \[rad/s\], linear \[m/s\]).
    pub fn observed(&mut self, label: Label, displacement: Pose, twist: Vector6<f64>) {
        self.displacements.insert(label, displacement);
        self.twists.insert(label, twist);
    }

    /// A frame was seen: where the joints are by now. Until something is learned, the prior goes with
    /// the parts that are seen.
    pub fn frame(&mut self, pipeline: &Pipeline, stamp: Stamp, counters: &Counters, shift_ns: i64) {
        let known = self.model.as_ref().map_or(0, |model| model.posterior.parts.len());
        if !self.learned && known < self.displacements.len() {
            if let Some(zero) = pipeline.zero() {
                self.frame.zero = Stamp(zero.0 - shift_ns);
            }
            if let Some(posterior) = pipeline.posterior() {
                self.believe(posterior, pipeline.hulls(), BTreeMap::new(), counters, stamp);
            }
        }
        self.say_state(stamp);
        let at = now();
        if self.drawn.is_none_or(|drawn| at.duration_since(drawn) > DRAW_EVERY) {
            self.draw(stamp);
        }
    }

    /// Where the joints and links are.
    fn say_state(&mut self, stamp: Stamp) {
        let Some(model) = &self.model else { return };
        self.positions = model.tree.positions(&self.displacements, &self.positions);
        let rates = model.tree.rates(&self.twists);
        let states = joint_states(&model.tree, &self.positions, &rates, &self.frame, stamp);
        self.outputs.send(Publication::JointStates(states));
        if self.tf_prefix.is_some() {
            self.send_tf(link_transforms(&model.tree, &self.displacements, &self.frame, stamp));
        }
    }

    /// Nothing was seen nor learned yet.
    pub fn prior(&mut self, root: Option<Label>, counters: &Counters) {
        let nothing = ObjectPosterior {
            root_label: root.unwrap_or_default(),
            parts: Vec::new(),
            edges: Vec::new(),
            windows: Vec::new(),
            criticism: Criticism::insufficient(),
        };
        self.believe(nothing, BTreeMap::new(), BTreeMap::new(), counters, Stamp::default());
    }

    /// A saved object was taken up.
    pub fn resumed(&mut self, pipeline: &Pipeline, stamp: Stamp, counters: &Counters, shift_ns: i64) {
        let Some(posterior) = pipeline.posterior() else { return };
        self.learned = true;
        self.frame.zero = Stamp(pipeline.zero().unwrap_or_default().0 - shift_ns);
        self.believe(posterior, pipeline.hulls(), pipeline.ranges_seen(), counters, stamp);
    }

    /// A window was learned.
    pub fn learned(&mut self, pipeline: &Pipeline, learned: Learned, counters: &Counters, shift_ns: i64) {
        self.learned = true;
        let zero = pipeline.zero().unwrap_or_default();
        self.frame.zero = Stamp(zero.0 - shift_ns);
        let stamp = self.frame.zero.plus_seconds(learned.span_s.1);
        let Learned { posterior, hulls, ranges_seen, .. } = learned;
        self.believe(posterior, hulls, ranges_seen, counters, stamp);
    }

    fn believe(
        &mut self,
        posterior: ObjectPosterior,
        hulls: BTreeMap<Label, HullProperties>,
        ranges_seen: BTreeMap<Label, (f64, f64)>,
        counters: &Counters,
        stamp: Stamp,
    ) {
        let message = ros::object_posterior(&posterior, counters, &self.frame, stamp);
        self.say(message.map(|message| Publication::Posterior(Box::new(message))));
        let message = ros::criticism(&posterior.criticism, posterior.windows.len(), &self.frame, stamp);
        self.say(message.map(Publication::Criticism));
        self.likeliest = LinkTree::likeliest(&posterior);
        self.off_joint.clear();
        let (tree, floating) = (self.likeliest.clone(), BTreeSet::new());
        self.model = Some(Arc::new(Model { posterior, tree, floating, hulls, ranges_seen }));
        self.draw(stamp);
        // The description has joints that no state was said of yet.
        self.say_state(stamp);
    }

    fn draw(&mut self, stamp: Stamp) {
        let Some(model) = &self.model else { return };
        self.drawn = Some(now());
        self.drawing.draw(Scene {
            model: Arc::clone(model),
            displacements: self.displacements.clone(),
            frame: self.frame.clone(),
            stamp,
        });
    }

    /// Where parts will be, for the cloud that came at `arrived`.
    pub fn predicted(&mut self, stamp: Stamp, mut predictions: Vec<PartPrediction>, arrived: Option<Instant>) {
        self.float(stamp, &predictions);
        if let Some(model) = &self.model {
            place_joints(&model.tree, &mut predictions);
        }
        let predictions = predictions.as_slice();
        let message = ros::predicted_part_poses(predictions, FutureWrench::Held, &self.frame, stamp);
        self.say(message.map(|message| Publication::Predicted(message, arrived)));
        if let Some(model) = self.model.as_ref().filter(|_| self.tf_prefix.is_some()) {
            self.send_tf(predicted_transforms(&model.tree, predictions, &self.frame, stamp));
        }
    }

    /// Parts that are not where a joint could have them float in the description, until they are back on it
    /// for a while.
    fn float(&mut self, stamp: Stamp, predictions: &[PartPrediction]) {
        let Some(model) = &self.model else { return };
        let mut times: BTreeMap<u64, BTreeMap<Label, Pose>> = BTreeMap::from([(0, self.displacements.clone())]);
        for prediction in predictions {
            let parts = times.entry(prediction.horizon_s.to_bits()).or_default();
            parts.insert(prediction.label, prediction.displacement);
        }
        for label in times.values().flat_map(|parts| self.likeliest.off_joint(parts)) {
            self.off_joint.insert(label, stamp);
        }
        self.off_joint.retain(|_, last| stamp.seconds_since(*last) < BACK_ON_JOINT_S);
        let off: BTreeSet<Label> = self.off_joint.keys().copied().collect();
        if off != model.floating {
            let model = Model {
                tree: self.likeliest.floating(&off),
                floating: off,
                posterior: model.posterior.clone(),
                hulls: model.hulls.clone(),
                ranges_seen: model.ranges_seen.clone(),
            };
            self.model = Some(Arc::new(model));
            self.draw(stamp);
        }
    }

    /// The tree of the description.
    pub fn tree(&self) -> Option<&LinkTree> {
        self.model.as_ref().map(|model| &model.tree)
    }

    fn say(&self, publication: Result<Publication, NotFinite>) {
        match publication {
            Ok(publication) => self.outputs.send(publication),
            Err(error) => warn!("not sent: {error}"),
        }
    }
}
