//! What the node listens to: a task for each topic, always draining into the inbox.

use std::collections::{BTreeMap, BTreeSet};
use std::fmt;
use std::sync::Arc;

use futures::{StreamExt, pin_mut};
use ros2_client::Subscription;
use ros2_interfaces_jazzy_serde::rosgraph_msgs::msg::Clock;
use serde::{Deserialize, Deserializer, de::DeserializeSeed};
use std::marker::PhantomData;
use tracing::{info, warn};

use super::health::{Kind, SharedHealth, now};
use super::inbox::{Arrival, Inbox};
use super::parameters::Parameters;
use super::participant::{Participant, Quality};
use crate::io::config::InputConfig;
use crate::io::ingest::Message;
use crate::io::messages::{
    POINT_CLOUD_TYPE, POSE_TYPE, PointCloud2, PoseWithCovarianceStamped, TF_TYPE, TfMessage, WRENCH_TYPE, WrenchStamped,
};

/// A message as the inbox takes it.
trait Receive: Sized + Send + Sync + 'static {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error>;
    fn message(self) -> Message<'static>;
}

impl Receive for PointCloud2<'static> {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        let cloud = PointCloud2::deserialize(deserializer)?;
        Ok(PointCloud2 { data: cloud.data.into_owned().into(), ..cloud })
    }

    fn message(self) -> Message<'static> {
        Message::Cloud(self)
    }
}

impl Receive for WrenchStamped {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::deserialize(deserializer)
    }

    fn message(self) -> Message<'static> {
        Message::Wrench(self)
    }
}

impl Receive for PoseWithCovarianceStamped {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::deserialize(deserializer)
    }

    fn message(self) -> Message<'static> {
        Message::Pose(Box::new(self))
    }
}

impl Receive for TfMessage {
    fn read<'de, D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        Self::deserialize(deserializer)
    }

    fn message(self) -> Message<'static> {
        Message::Tf(self)
    }
}

/// Reads a message that owns what it holds.
struct Owned<T>(PhantomData<T>);

impl<T> Clone for Owned<T> {
    fn clone(&self) -> Self {
        Self(PhantomData)
    }
}

impl<'de, T: Receive> DeserializeSeed<'de> for Owned<T> {
    type Value = T;

    fn deserialize<D: Deserializer<'de>>(self, deserializer: D) -> Result<T, D::Error> {
        T::read(deserializer)
    }
}

/// All that is listened to.
pub struct Subscriptions<C> {
    inbox: Arc<Inbox<C>>,
    health: SharedHealth,
    input: InputConfig,
    poses: Quality,
    known: BTreeSet<String>,
    /// Names on the network by the reader's identity, for what is said of them.
    pub names: BTreeMap<rustdds::GUID, String>,
}

impl<C: fmt::Debug + Send + 'static> Subscriptions<C> {
    /// Listens to the topics of the configuration, absolute names; poses as they appear.
    ///
    /// # Errors
    /// A name that is none, or DDS.
    pub fn new(
        participant: &mut Participant,
        parameters: &Parameters,
        input: &InputConfig,
        inbox: Arc<Inbox<C>>,
        health: SharedHealth,
    ) -> anyhow::Result<Self> {
        let quality = |topic: &str| {
            let (reliable, depth) = parameters.qos(topic, true);
            Quality { reliable, latched: false, depth }
        };
        let poses = quality("parts/poses");
        let mut all =
            Self { inbox, health, input: input.clone(), poses, known: BTreeSet::new(), names: BTreeMap::new() };
        for topic in &input.clouds {
            all.listen::<PointCloud2<'static>>(
                participant,
                topic,
                POINT_CLOUD_TYPE,
                Kind::Cloud,
                quality("parts/points"),
            )?;
        }
        for wrench in &input.wrenches {
            all.listen::<WrenchStamped>(participant, &wrench.topic, WRENCH_TYPE, Kind::Wrench, quality("wrench"))?;
        }
        let tf = Quality { reliable: true, latched: false, depth: 1000 };
        all.listen::<TfMessage>(participant, &input.tf, TF_TYPE, Kind::Tf, tf)?;
        let tf_static = Quality { reliable: true, latched: true, depth: 100 };
        all.listen::<TfMessage>(participant, &input.tf_static, TF_TYPE, Kind::Tf, tf_static)?;
        Ok(all)
    }

    /// A topic appeared on the network: one of part poses is listened to from now on.
    ///
    /// # Errors
    /// DDS.
    pub fn appeared(&mut self, participant: &mut Participant, topic: &str) -> anyhow::Result<()> {
        if self.known.contains(topic) || self.input.pose_label(topic).is_none() {
            return Ok(());
        }
        info!("poses on {topic}");
        let quality = self.poses;
        self.listen::<PoseWithCovarianceStamped>(participant, topic, POSE_TYPE, Kind::Pose, quality)
    }

    fn listen<M: Receive>(
        &mut self,
        participant: &mut Participant,
        topic: &str,
        type_name: &str,
        kind: Kind,
        quality: Quality,
    ) -> anyhow::Result<()> {
        let subscription = participant.subscribe::<M>(topic, type_name, quality)?;
        self.known.insert(topic.to_owned());
        self.names.insert(subscription.guid(), topic.to_owned());
        self.health.lock().listen(topic, kind);
        tokio::spawn(drain(subscription, Arc::from(topic), Arc::clone(&self.inbox), self.health.clone()));
        Ok(())
    }
}

async fn drain<M: Receive, C>(
    subscription: Subscription<M>,
    topic: Arc<str>,
    inbox: Arc<Inbox<C>>,
    health: SharedHealth,
) {
    let stream = subscription.async_stream_seed(Owned(PhantomData::<M>));
    pin_mut!(stream);
    while let Some(received) = stream.next().await {
        let at = now();
        match received {
            Ok((message, _)) => {
                health.lock().received(&topic, at);
                inbox.put(Arrival { topic: Arc::clone(&topic), at, message: message.message() });
            }
            Err(error) => {
                let mut health = health.lock();
                if let Some(topic) = health.topics.get_mut(&*topic) {
                    topic.undecodable += 1;
                    if topic.undecodable == 1 {
                        drop(health);
                        warn!("a message cannot be decoded: {error}");
                    }
                }
            }
        }
    }
}

/// Listens to sim time: whether it advances, and whether it jumps. `jumped` is called where it goes back.
///
/// # Errors
/// DDS.
pub fn watch_clock(
    participant: &mut Participant,
    health: SharedHealth,
    jumped: impl Fn() + Send + 'static,
) -> anyhow::Result<()> {
    let quality = Quality { reliable: false, latched: false, depth: 1 };
    let subscription = participant.subscribe::<Clock>("/clock", "rosgraph_msgs/msg/Clock", quality)?;
    health.lock().listen("/clock", Kind::Clock);
    health.lock().clock = Some(now());
    tokio::spawn(async move {
        let stream = subscription.async_stream();
        pin_mut!(stream);
        let mut last_s: Option<f64> = None;
        while let Some(received) = stream.next().await {
            let Ok((Clock { clock }, _)) = received else { continue };
            let time_s = f64::from(clock.sec) + f64::from(clock.nanosec) * 1e-9;
            let step_s = last_s.map_or(0.0, |last| time_s - last);
            let mut health = health.lock();
            health.received("/clock", now());
            if step_s != 0.0 || last_s.is_none() {
                health.clock = Some(now());
            }
            last_s = Some(time_s);
            if step_s < 0.0 {
                health.jumped(format!(
                    "/clock went back by {:.3} s: the stream begins again, what was learned is kept",
                    -step_s
                ));
                drop(health);
                jumped();
            } else if step_s > 1.0 {
                health.jumped(format!("/clock went on by {step_s:.3} s at once"));
            }
        }
    });
    Ok(())
}
