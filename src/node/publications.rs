//! What the node says, and how it gets onto the network: everything below 100 KB, or counted.

use std::collections::BTreeMap;
use std::sync::Arc;
use std::time::Instant;

use ros2_client::Publisher;
use ros2_interfaces_jazzy_serde::{
    diagnostic_msgs::msg::DiagnosticArray, lifecycle_msgs::msg::TransitionEvent, rcl_interfaces::msg::ParameterEvent,
    sensor_msgs::msg::JointState, std_msgs::msg::String as Text, tf2_msgs::msg::TFMessage,
    visualization_msgs::msg::MarkerArray,
};
use serde::Serialize;
use tokio::sync::mpsc;

use super::health::{SharedHealth, now};
use super::parameters::Parameters;
use super::participant::{Participant, Quality, publish};
use super::recording::Recording;
use crate::io::counters::Counters;
use crate::ros::{MOST_BYTES, encoded_bytes, messages};

/// Messages that wait for the network at most, of those that cannot wait and of the others.
const MOST_WAITING: usize = 256;

/// Names, as in the code, and types of what is published of the object.
pub mod topics {
    /// A topic's name and type.
    pub type Topic = (&'static str, &'static str);
    /// What is believed.
    pub const OBJECT_POSTERIOR: Topic = ("~/object_posterior", "bayesian_object_models/msg/ObjectPosterior");
    /// Where parts will be.
    pub const PREDICTED_POSES: Topic = ("~/predicted_poses", "bayesian_object_models/msg/PredictedPartPoses");
    /// What the model lacks.
    pub const CRITICISM: Topic = ("~/criticism", "bayesian_object_models/msg/Criticism");
    /// For people.
    pub const MARKERS: Topic = ("~/markers", "visualization_msgs/msg/MarkerArray");
    /// The likeliest model.
    pub const ROBOT_DESCRIPTION: Topic = ("~/robot_description", "std_msgs/msg/String");
    /// Where its joints are.
    pub const JOINT_STATES: Topic = ("~/joint_states", "sensor_msgs/msg/JointState");
    /// Frames of the parts.
    pub const TF: Topic = ("/tf", "tf2_msgs/msg/TFMessage");
    /// How the node does.
    pub const DIAGNOSTICS: Topic = ("/diagnostics", "diagnostic_msgs/msg/DiagnosticArray");
}

/// One message.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "each is the message that it names")]
pub enum Publication {
    Posterior(Box<messages::ObjectPosterior>),
    /// With the arrival of the cloud that it is for.
    Predicted(messages::PredictedPartPoses, Option<Instant>),
    Criticism(messages::Criticism),
    Markers(MarkerArray),
    Description(Text),
    JointStates(JointState),
    Tf(TFMessage),
    Diagnostics(DiagnosticArray),
    Transition(TransitionEvent),
    ParameterEvent(ParameterEvent),
}

impl Publication {
    /// Whether it goes with every cloud: it is small, and does not wait for what is large.
    fn is_urgent(&self) -> bool {
        matches!(self, Self::Predicted(..) | Self::JointStates(_) | Self::Tf(_))
    }
}

/// Hands messages to the tasks that send them; cheap to share.
#[derive(Clone)]
pub struct Outputs {
    urgent: mpsc::Sender<Publication>,
    others: mpsc::Sender<Publication>,
    recording: Option<Recording>,
    health: SharedHealth,
}

impl Outputs {
    /// Hands over a message; where too many wait it is dropped and counted.
    pub fn send(&self, publication: Publication) {
        if let Some(recording) = &self.recording {
            recording.published(publication.clone());
        }
        let sender = if publication.is_urgent() { &self.urgent } else { &self.others };
        if sender.try_send(publication).is_err() {
            Counters::add(&mut self.health.lock().unsent, "the network is behind", 1);
        }
    }
}

/// A publisher for each message.
pub struct Publishers {
    posterior: Publisher<messages::ObjectPosterior>,
    predicted: Publisher<messages::PredictedPartPoses>,
    criticism: Publisher<messages::Criticism>,
    markers: Publisher<MarkerArray>,
    description: Publisher<Text>,
    joint_states: Publisher<JointState>,
    tf: Publisher<TFMessage>,
    diagnostics: Publisher<DiagnosticArray>,
    transitions: Publisher<TransitionEvent>,
    parameter_events: Publisher<ParameterEvent>,
    health: SharedHealth,
    /// Names on the network by the publisher's identity, for what is said of them.
    pub names: BTreeMap<rustdds::GUID, String>,
}

impl Publishers {
    /// Advertises all topics.
    ///
    /// # Errors
    /// A name that is none, or DDS.
    pub fn new(participant: &mut Participant, parameters: &Parameters, health: SharedHealth) -> anyhow::Result<Self> {
        let mut names = BTreeMap::new();
        let quality = |topic: &str, latched| {
            let (reliable, depth) = parameters.qos(topic, false);
            Quality { reliable, latched, depth }
        };
        macro_rules! advertise {
            ($topic:expr, $quality:expr) => {{
                let (name, type_name) = $topic;
                let publisher = participant.advertise(name, type_name, $quality)?;
                names.insert(publisher.guid(), participant.resolve(name));
                publisher
            }};
        }
        let listed = |(topic, _): topics::Topic| quality(topic, false);
        let latched = |(topic, _): topics::Topic| quality(topic, true);
        let fixed = |depth| Quality { reliable: true, latched: false, depth };
        Ok(Self {
            posterior: advertise!(topics::OBJECT_POSTERIOR, latched(topics::OBJECT_POSTERIOR)),
            predicted: advertise!(topics::PREDICTED_POSES, listed(topics::PREDICTED_POSES)),
            criticism: advertise!(topics::CRITICISM, latched(topics::CRITICISM)),
            markers: advertise!(topics::MARKERS, listed(topics::MARKERS)),
            description: advertise!(topics::ROBOT_DESCRIPTION, latched(topics::ROBOT_DESCRIPTION)),
            joint_states: advertise!(topics::JOINT_STATES, listed(topics::JOINT_STATES)),
            tf: advertise!(topics::TF, fixed(100)),
            diagnostics: advertise!(topics::DIAGNOSTICS, listed(topics::DIAGNOSTICS)),
            transitions: advertise!(("~/transition_event", "lifecycle_msgs/msg/TransitionEvent"), fixed(1)),
            parameter_events: advertise!(("/parameter_events", "rcl_interfaces/msg/ParameterEvent"), fixed(1000)),
            health,
            names,
        })
    }

    /// Starts the tasks that send; they end when nothing can be handed over any more.
    pub fn start(self, recording: Option<Recording>) -> Outputs {
        let health = self.health.clone();
        let publishers = Arc::new(self);
        let [urgent, others] = [(), ()].map(|()| {
            let (sender, mut waiting) = mpsc::channel(MOST_WAITING);
            let publishers = Arc::clone(&publishers);
            tokio::spawn(async move {
                while let Some(publication) = waiting.recv().await {
                    publishers.publish(publication).await;
                }
            });
            sender
        });
        Outputs { urgent, others, recording, health }
    }

    async fn publish(&self, publication: Publication) {
        match publication {
            Publication::Posterior(message) => self.one("object_posterior", &self.posterior, *message).await,
            Publication::Predicted(message, arrived) => {
                self.one("predicted_poses", &self.predicted, message).await;
                if let Some(arrived) = arrived {
                    self.health.lock().latency.add(now().duration_since(arrived).as_secs_f64());
                }
            }
            Publication::Criticism(message) => self.one("criticism", &self.criticism, message).await,
            Publication::Markers(message) => self.one("markers", &self.markers, message).await,
            Publication::Description(message) => self.one("robot_description", &self.description, message).await,
            Publication::JointStates(message) => self.one("joint_states", &self.joint_states, message).await,
            Publication::Tf(message) => self.one("tf", &self.tf, message).await,
            Publication::Diagnostics(message) => self.one("diagnostics", &self.diagnostics, message).await,
            Publication::Transition(message) => self.one("transition_event", &self.transitions, message).await,
            Publication::ParameterEvent(message) => {
                self.one("parameter_events", &self.parameter_events, message).await;
            }
        }
    }

    async fn one<M: Serialize>(&self, name: &'static str, publisher: &Publisher<M>, message: M) {
        let bytes = encoded_bytes(&message);
        let unsent = if bytes > MOST_BYTES {
            tracing::warn!("{name}: {bytes} bytes, at most {MOST_BYTES} get through: not sent");
            Some("too large")
        } else {
            publish(publisher, message).await.err()
        };
        let mut health = self.health.lock();
        match unsent {
            Some(reason) => Counters::add(&mut health.unsent, reason, 1),
            None => *health.sent.entry(name).or_default() += 1,
        }
    }
}
