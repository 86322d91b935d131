//! Message bytes → [`Input`]: decoded, checked, and carried into world as soon as tf allows.
//!
//! The node and the replayer share it. Stamps of the messages are the only clock. A message whose
//! transform is not there yet waits, with all later ones of its topic behind it, until the stream's
//! newest stamp has passed it by the timeout.

use std::collections::{BTreeMap, BTreeSet, VecDeque};

use serde::Deserialize;
use tracing::warn;

use super::{
    cdr,
    config::InputConfig,
    counters::{ByReason, Counters, Diagnostic},
    messages::{
        Header, POINT_CLOUD_TYPE, POSE_TYPE, PointCloud2, PoseWithCovarianceStamped, TF_TYPE, TfMessage, WRENCH_TYPE,
        WrenchStamped,
    },
    point_cloud,
    resolve::{Content, Rejection, WaitingMessage},
    topics::Role,
    transforms::{LookupError, TransformBuffer, bare},
};
use crate::types::{Input, Stamp};

/// The state of reading: transforms, what waits for them, and what was counted.
#[derive(Debug)]
pub struct Ingest {
    config: InputConfig,
    transforms: TransformBuffer,
    topics: BTreeMap<String, Topic>,
    /// The pairs of cloud topic and frame seen, and their index.
    sources: BTreeMap<(String, String), usize>,
    newest: Option<Stamp>,
    counters: Counters,
    diagnostics: Vec<Diagnostic>,
    reported: BTreeSet<(String, &'static str)>,
}

#[derive(Debug)]
struct Topic {
    role: Option<Role>,
    waiting: VecDeque<WaitingMessage>,
    /// Newest stamp by frame, so that several cameras can share a topic.
    newest_in_frame: BTreeMap<String, Stamp>,
}

impl Ingest {
    /// Nothing read yet.
    pub fn new(config: &InputConfig) -> Self {
        Self {
            config: config.clone(),
            transforms: TransformBuffer::new(config.tf_history_s),
            topics: BTreeMap::new(),
            sources: BTreeMap::new(),
            newest: None,
            counters: Counters::default(),
            diagnostics: Vec::new(),
            reported: BTreeSet::new(),
        }
    }

    /// Nothing read yet, by another configuration, but for the transforms that are known.
    pub fn anew(&self, config: &InputConfig) -> Self {
        Self { transforms: self.transforms.clone(), ..Self::new(config) }
    }

    /// What was counted so far.
    pub fn counters(&self) -> &Counters {
        &self.counters
    }

    /// The first dropped message of every cause and topic, in the order of arrival.
    pub fn diagnostics(&self) -> &[Diagnostic] {
        &self.diagnostics
    }

    /// The transforms, for `world_from_frame` of frames other than those of the messages.
    pub fn transforms(&self) -> &TransformBuffer {
        &self.transforms
    }

    /// Takes in one message: its absolute topic, type (`package/msg/Name`) and CDR bytes. Returns
    /// what can now be placed in world, in order of stamps within a topic but not across topics.
    /// Topics without a role are passed over.
    pub fn push(&mut self, topic: &str, type_name: &str, message: &[u8]) -> Vec<Input> {
        let Some(role) = self.role(topic) else {
            return Vec::new();
        };
        let decoded = match type_name == role.type_name() {
            true => Message::decode(role, message),
            false => Err(wrong_type(type_name, role)),
        };
        self.take(topic, role, decoded);
        self.release(false)
    }

    /// The same for a message that is decoded already.
    pub fn push_message(&mut self, topic: &str, message: Message<'_>) -> Vec<Input> {
        let Some(role) = self.role(topic) else {
            return Vec::new();
        };
        self.take(topic, role, Ok(message));
        self.release(false)
    }

    /// Another stream begins, as when a clock jumps back: what waits is dropped, moving transforms are
    /// forgotten, fixed ones and counts are kept.
    pub fn begin_again(&mut self) -> Vec<Input> {
        let inputs = self.release(true);
        self.topics.values_mut().for_each(|topic| topic.newest_in_frame.clear());
        self.transforms.forget_moving();
        self.newest = None;
        inputs
    }

    /// The messages that wait for a transform: of each topic the first one's frame and what is missing.
    pub fn waiting(&self) -> Vec<(String, LookupError)> {
        let first = |(name, topic): (&String, &Topic)| {
            let waiting = topic.waiting.front()?;
            let looked_up = self.transforms.lookup(&self.config.fixed_frame, &waiting.frame, waiting.stamp);
            Some((name.clone(), looked_up.err()?))
        };
        self.topics.iter().filter_map(first).collect()
    }

    fn take(&mut self, topic: &str, role: Role, decoded: Result<Message<'_>, Rejection>) {
        let tf = matches!(role, Role::Tf | Role::TfStatic);
        if !tf {
            self.count_arrival(role);
        }
        match decoded {
            Ok(Message::Tf(message)) if tf => self.take_transforms(topic, role, &message),
            Ok(message) => match self.read(topic, role, &message) {
                Ok(waiting) => self.enqueue(topic, role, waiting),
                Err(rejection) => self.reject(topic, role, rejection),
            },
            Err(rejection) => {
                if tf {
                    self.count_arrival(role);
                }
                self.reject(topic, role, rejection);
            }
        }
    }

    /// The end of the stream: no further transform will come, so that what still waits is dropped.
    pub fn flush(&mut self) -> Vec<Input> {
        self.release(true)
    }

    fn role(&mut self, topic: &str) -> Option<Role> {
        if let Some(known) = self.topics.get(topic) {
            return known.role;
        }
        let role = Role::of(topic, &self.config);
        let entry = Topic { role, waiting: VecDeque::new(), newest_in_frame: BTreeMap::new() };
        self.topics.insert(topic.to_owned(), entry);
        role
    }

    /// Checks one message, all but its place in world.
    fn read(&mut self, topic: &str, role: Role, message: &Message<'_>) -> Result<WaitingMessage, Rejection> {
        match (role, message) {
            (Role::Cloud, Message::Cloud(cloud)) => {
                let stamp = checked_stamp(&cloud.header)?;
                let (points, dropped) =
                    point_cloud::read_points(cloud, &self.config.label_field, &self.config.ignored_labels).map_err(
                        |error| {
                            if let point_cloud::PointCloudError::NoUsablePoint { dropped, .. } = &error {
                                count_points(&mut self.counters.points_dropped, dropped);
                            }
                            Rejection::new(Some(stamp), error.kind(), error.to_string())
                        },
                    )?;
                count_points(&mut self.counters.points_dropped, &dropped);
                self.counters.points_in += points.len() as u64;
                let frame = cloud.header.frame_id.clone();
                let next = self.sources.len();
                let source = *self.sources.entry((topic.to_owned(), frame.clone())).or_insert(next);
                Ok(WaitingMessage { stamp, frame, content: Content::Cloud { source, points } })
            }
            (Role::Wrench(source), Message::Wrench(message)) => {
                let stamp = checked_stamp(&message.header)?;
                let content = Content::wrench(&message.wrench, source, &self.config, stamp)?;
                Ok(WaitingMessage { stamp, frame: message.header.frame_id.clone(), content })
            }
            (Role::Pose(label), Message::Pose(message)) => {
                let stamp = checked_stamp(&message.header)?;
                let content = Content::pose(&message.pose, label, &self.config, stamp)?;
                Ok(WaitingMessage { stamp, frame: message.header.frame_id.clone(), content })
            }
            (role, message) => Err(wrong_type(message.type_name(), role)),
        }
    }

    fn enqueue(&mut self, topic: &str, role: Role, waiting: WaitingMessage) {
        let Some(state) = self.topics.get_mut(topic) else {
            return;
        };
        if let Some(newest) = state.newest_in_frame.get(&waiting.frame).copied()
            && waiting.stamp <= newest
        {
            let (kind, reason) = if waiting.stamp == newest {
                ("duplicate_stamp", format!("frame `{}`: the stamp came before", waiting.frame))
            } else {
                let by_s = newest.seconds_since(waiting.stamp);
                ("backward_stamp", format!("frame `{}`: stamp goes back by {by_s:.3} s", waiting.frame))
            };
            self.reject(topic, role, Rejection::new(Some(waiting.stamp), kind, reason));
            return;
        }
        state.newest_in_frame.insert(waiting.frame.clone(), waiting.stamp);
        self.newest = self.newest.max(Some(waiting.stamp));
        state.waiting.push_back(waiting);
    }

    fn take_transforms(&mut self, topic: &str, role: Role, message: &TfMessage) {
        for transform in &message.transforms {
            self.counters.tf_in += 1;
            let taken = checked_stamp(&transform.header).and_then(|stamp| {
                self.transforms
                    .insert(transform, role == Role::TfStatic)
                    .map(|()| stamp)
                    .map_err(|error| Rejection::new(Some(stamp), error.kind(), error.to_string()))
            });
            match taken {
                Ok(stamp) if role == Role::Tf => self.newest = self.newest.max(Some(stamp)),
                Ok(_) => {}
                Err(rejection) => self.reject(topic, role, rejection),
            }
        }
    }

    /// Everything at the head of its topic that can be placed in world, or will never be.
    fn release(&mut self, at_end: bool) -> Vec<Input> {
        let mut inputs = Vec::new();
        let mut rejections = Vec::new();
        for (name, topic) in &mut self.topics {
            let Some(role) = topic.role else {
                continue;
            };
            while let Some(waiting) = topic.waiting.pop_front() {
                let looked_up = self.transforms.lookup(&self.config.fixed_frame, &waiting.frame, waiting.stamp);
                let waited_s = self.newest.map_or(0.0, |newest| newest.seconds_since(waiting.stamp));
                let give_up = at_end || waited_s > self.config.tf_timeout_s;
                match looked_up {
                    Ok(world_from_frame) => {
                        let is_fixed = bare(&waiting.frame) == bare(&self.config.fixed_frame);
                        match waiting.placed(&world_from_frame, is_fixed, &self.config) {
                            Ok(input) => inputs.push(input),
                            Err(rejection) => rejections.push((name.clone(), role, rejection)),
                        }
                    }
                    Err(error) if error.may_still_come() && !give_up => {
                        topic.waiting.push_front(waiting);
                        break;
                    }
                    Err(error) => {
                        let rejection = Rejection::new(Some(waiting.stamp), error.kind(), error.to_string());
                        rejections.push((name.clone(), role, rejection));
                    }
                }
            }
        }
        for (topic, role, rejection) in rejections {
            self.reject(&topic, role, rejection);
        }
        inputs
    }

    fn count_arrival(&mut self, role: Role) {
        match role {
            Role::Cloud => self.counters.clouds_in += 1,
            Role::Wrench(_) => self.counters.wrenches_in += 1,
            Role::Pose(_) => self.counters.poses_in += 1,
            Role::Tf | Role::TfStatic => self.counters.tf_in += 1,
        }
    }

    fn reject(&mut self, topic: &str, role: Role, rejection: Rejection) {
        let reasons = match role {
            Role::Cloud => &mut self.counters.clouds_dropped,
            Role::Wrench(_) => &mut self.counters.wrenches_dropped,
            Role::Pose(_) => &mut self.counters.poses_dropped,
            Role::Tf | Role::TfStatic => &mut self.counters.tf_dropped,
        };
        Counters::add(reasons, rejection.kind, 1);
        if self.reported.insert((topic.to_owned(), rejection.kind)) {
            let Rejection { stamp, kind, reason } = rejection;
            let diagnostic = Diagnostic { topic: topic.to_owned(), stamp, kind, reason };
            warn!("{diagnostic}; further ones are only counted");
            self.diagnostics.push(diagnostic);
        }
    }
}

/// A message of one of the types that are read.
#[derive(Clone, Debug)]
pub enum Message<'a> {
    /// Segmented points.
    Cloud(PointCloud2<'a>),
    /// A wrench reading.
    Wrench(WrenchStamped),
    /// A part's pose.
    Pose(Box<PoseWithCovarianceStamped>),
    /// Transforms.
    Tf(TfMessage),
}

impl<'a> Message<'a> {
    fn decode(role: Role, message: &'a [u8]) -> Result<Self, Rejection> {
        Ok(match role {
            Role::Cloud => Self::Cloud(decode(message)?),
            Role::Wrench(_) => Self::Wrench(decode(message)?),
            Role::Pose(_) => Self::Pose(Box::new(decode(message)?)),
            Role::Tf | Role::TfStatic => Self::Tf(decode(message)?),
        })
    }

    /// Its type, as `package/msg/Name`.
    pub fn type_name(&self) -> &'static str {
        match self {
            Self::Cloud(_) => POINT_CLOUD_TYPE,
            Self::Wrench(_) => WRENCH_TYPE,
            Self::Pose(_) => POSE_TYPE,
            Self::Tf(_) => TF_TYPE,
        }
    }
}

fn wrong_type(type_name: &str, role: Role) -> Rejection {
    Rejection::new(None, "wrong_type", format!("type {type_name}, expected {}", role.type_name()))
}

fn decode<'de, T: Deserialize<'de>>(message: &'de [u8]) -> Result<T, Rejection> {
    cdr::decode(message).map_err(|error| Rejection::new(None, "undecodable", error.to_string()))
}

fn checked_stamp(header: &Header) -> Result<Stamp, Rejection> {
    let stamp = header.stamp;
    if stamp.nanosec >= 1_000_000_000 {
        let reason = format!("stamp has {} nanoseconds, expected below 10⁹", stamp.nanosec);
        return Err(Rejection::new(None, "bad_stamp", reason));
    }
    Ok(stamp.into())
}

fn count_points(reasons: &mut ByReason, dropped: &point_cloud::DroppedPoints) {
    Counters::add(reasons, "not_finite", dropped.not_finite);
    Counters::add(reasons, "out_of_range", dropped.out_of_range);
    Counters::add(reasons, "bad_label", dropped.bad_label);
    Counters::add(reasons, "ignored_label", dropped.ignored_label);
}
