//! The DDS side of the node: domain, interfaces, topics with their QoS.
//!
//! QoS goes with the topic: only so do resource limits reach a reader, and without them a reader that
//! is behind gets old samples (`KeepLast` alone does not drop them).

use std::net::{IpAddr, Ipv4Addr};
use std::time::Duration;

use anyhow::{Context as _, bail};
use ros2_client::{
    Context, MessageTypeName, Name, Node, NodeName, NodeOptions, Publisher, Server, ServiceMapping, ServiceTypeName,
    Subscription,
    ros2::{QosPolicies, QosPolicyBuilder, QosProfile, policy},
};
use ros2_interfaces_jazzy_serde::rcl_interfaces::msg::Log;
use rustdds::{DomainParticipant, DomainParticipantBuilder, Topic, TopicKind};
use serde::{Deserialize, Serialize, de::DeserializeOwned};

use super::names::Names;

/// The highest domain whose ports exist.
const LAST_DOMAIN: u16 = 232;

/// Messages that a reliable subscriber may be behind before the others wait for it. RustDDS does not overwrite what
/// one has not acknowledged, so a subscriber that stands still would hold up all until its lease ends, 20 s by
/// Fast DDS's default: so many are more than go on any topic until then.
const MOST_UNACKNOWLEDGED: i32 = 2048;
/// What is not taken in by then is given up.
const PUBLISHED_WITHIN: Duration = Duration::from_millis(100);

/// How a topic is kept and sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Quality {
    /// Lost messages are sent again.
    pub reliable: bool,
    /// Those who come later get the last.
    pub latched: bool,
    /// Messages kept.
    pub depth: i32,
}

impl Quality {
    /// With as many samples at most as are kept, or `samples`.
    fn policies(self, samples: i32) -> QosPolicies {
        let durability = if self.latched { policy::Durability::TransientLocal } else { policy::Durability::Volatile };
        let builder = QosPolicyBuilder::new()
            .durability(durability)
            .history(policy::History::KeepLast { depth: self.depth })
            .resource_limits(policy::ResourceLimits {
                max_samples: self.depth.max(samples),
                max_instances: 1,
                max_samples_per_instance: self.depth.max(samples),
            });
        match self.reliable {
            true => builder.reliable(PUBLISHED_WITHIN.into()).build(),
            false => builder.best_effort().build(),
        }
    }
}

/// A message of any type, for services.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(transparent, bound = "T: Serialize + DeserializeOwned")]
pub struct Wire<T>(pub T);

impl<T: Serialize + DeserializeOwned> ros2_client::Message for Wire<T> {}

/// The node on the network.
pub struct Participant {
    /// Its topics and services are created on it; gone with it.
    pub node: Node,
    context: Context,
    names: Names,
    mapping: ServiceMapping,
}

impl Participant {
    /// Joins the network that the environment names: ROS_DOMAIN_ID, ROS_AUTOMATIC_DISCOVERY_RANGE.
    ///
    /// # Errors
    /// A variable that makes no sense, or no network.
    pub fn join(names: &Names) -> anyhow::Result<Self> {
        let mut builder = DomainParticipantBuilder::new(domain()?);
        if on_this_machine_only()? {
            builder = builder.with_only_networks([IpAddr::V4(Ipv4Addr::LOCALHOST)]);
        }
        let participant = builder.build().context("joining the DDS domain")?;
        let context = Context::from_domain_participant(participant).context("creating the ROS context")?;
        let name = NodeName::new(&names.namespace, &names.node).map_err(|error| anyhow::anyhow!("{error}"))?;
        // Parameter services and logs are this node's own: the library's lack descriptions and ranges.
        let options = NodeOptions::new().enable_rosout(false).start_parameter_services(false);
        let node = context.new_node(name, options).map_err(|error| anyhow::anyhow!("creating the node: {error}"))?;
        let cyclone = std::env::var("RMW_IMPLEMENTATION").is_ok_and(|name| name == "rmw_cyclonedds_cpp");
        let mapping = if cyclone { ServiceMapping::Cyclone } else { ServiceMapping::Enhanced };
        Ok(Self { node, context, names: names.clone(), mapping })
    }

    /// For what happens on the network.
    pub fn domain_participant(&self) -> DomainParticipant {
        self.context.domain_participant()
    }

    /// The absolute name of a topic or service.
    pub fn resolve(&self, name: &str) -> String {
        self.names.resolve(name)
    }

    fn topic(&self, name: &str, type_name: &str, policies: &QosPolicies) -> anyhow::Result<Topic> {
        let (package, message) = type_name.split_once("/msg/").unwrap_or(("", type_name));
        Name::parse(name).map_err(|error| anyhow::anyhow!("topic `{name}`: {error}"))?;
        self.domain_participant()
            .create_topic(
                format!("rt{name}"),
                MessageTypeName::new(package, message).dds_msg_type(),
                policies,
                TopicKind::NoKey,
            )
            .with_context(|| format!("topic {name}"))
    }

    /// Listens to an absolute topic of a type `package/msg/Name`.
    ///
    /// # Errors
    /// A name that is none, or DDS.
    pub fn subscribe<M: 'static>(
        &mut self,
        name: &str,
        type_name: &str,
        quality: Quality,
    ) -> anyhow::Result<Subscription<M>> {
        let topic = self.topic(name, type_name, &quality.policies(2))?;
        self.node.create_subscription(&topic, None).with_context(|| format!("subscribing to {name}"))
    }

    /// Speaks on a topic of a type `package/msg/Name`; the name is as in the code.
    ///
    /// # Errors
    /// A name that is none, or DDS.
    pub fn advertise<M: Serialize>(
        &mut self,
        name: &str,
        type_name: &str,
        quality: Quality,
    ) -> anyhow::Result<Publisher<M>> {
        let topic = self.topic(&self.resolve(name), type_name, &quality.policies(MOST_UNACKNOWLEDGED))?;
        self.node.create_publisher(&topic, None).with_context(|| format!("advertising {name}"))
    }

    /// Speaks on /rosout.
    ///
    /// # Errors
    /// DDS.
    pub fn advertise_rosout(&mut self) -> anyhow::Result<Publisher<Log>> {
        let topic = self.context.get_rosout_topic();
        self.node.create_publisher(&topic, None).context("advertising /rosout")
    }

    /// Answers a service of a type `package/srv/Name`; the name is as in the code.
    ///
    /// # Errors
    /// A name that is none, or DDS.
    pub fn serve<Q, A>(&mut self, name: &str, type_name: &str) -> anyhow::Result<Server<Wire<Q>, Wire<A>>>
    where
        Q: Serialize + DeserializeOwned + Clone + 'static,
        A: Serialize + DeserializeOwned + 'static,
    {
        let name = self.resolve(name);
        let (package, service) = type_name.split_once("/srv/").unwrap_or(("", type_name));
        let parsed = Name::parse(&name).map_err(|error| anyhow::anyhow!("service `{name}`: {error}"))?;
        let quality = QosProfile::publisher_default().history(ros2_client::qos::History::KeepLast { depth: 10 });
        self.node
            .create_server(self.mapping, &parsed, &ServiceTypeName::new(package, service), quality.clone(), quality)
            .with_context(|| format!("serving {name}"))
    }
}

/// Publishes a message, unless subscribers are so far behind that it would have to wait.
///
/// # Errors
/// Why it was not sent.
pub async fn publish<M: Serialize>(publisher: &Publisher<M>, message: M) -> Result<(), &'static str> {
    match tokio::time::timeout(PUBLISHED_WITHIN, publisher.async_publish(message)).await {
        Ok(published) => published.map_err(|_| "the network refused it"),
        Err(_) => Err("a subscriber is behind"),
    }
}

fn domain() -> anyhow::Result<u16> {
    let Ok(text) = std::env::var("ROS_DOMAIN_ID") else { return Ok(0) };
    match text.trim().parse::<u16>() {
        _ if text.trim().is_empty() => Ok(0),
        Ok(domain) if domain <= LAST_DOMAIN => Ok(domain),
        _ => bail!("ROS_DOMAIN_ID={text}: expected 0 to {LAST_DOMAIN}"),
    }
}

fn on_this_machine_only() -> anyhow::Result<bool> {
    if std::env::var("ROS_LOCALHOST_ONLY").is_ok_and(|text| text == "1") {
        return Ok(true);
    }
    match std::env::var("ROS_AUTOMATIC_DISCOVERY_RANGE").as_deref() {
        Ok("LOCALHOST") => Ok(true),
        Err(_) | Ok("" | "SUBNET" | "SYSTEM_DEFAULT") => Ok(false),
        Ok(other) => {
            bail!("ROS_AUTOMATIC_DISCOVERY_RANGE={other}: expected LOCALHOST, SUBNET or SYSTEM_DEFAULT")
        }
    }
}
