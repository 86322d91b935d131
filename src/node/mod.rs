//! The live node: the pipeline between ROS 2 topics, on ros2-client.
//!
//! Tasks drain the network into an inbox ([`inbox`]); one thread takes what is newest through reading
//! and pipeline ([`stream`]); another learns windows ([`learning`]); a task sends what they say
//! ([`publications`]). Services, parameters and the lifecycle are beside them ([`services`]).

pub mod announce;
pub mod arguments;
pub mod bond;
pub mod diagnostics;
pub mod drawing;
pub mod health;
pub mod inbox;
pub mod learning;
pub mod lifecycle;
pub mod names;
pub mod parameters;
pub mod participant;
pub mod planning;
pub mod publications;
pub mod recording;
pub mod rosout;
pub mod services;
pub mod stream;
pub mod subscriptions;
pub mod value;

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};
use std::sync::{Arc, Mutex};

use anyhow::Context as _;
use futures::{StreamExt, pin_mut};
use ros2_interfaces_jazzy_serde::lifecycle_msgs::msg::Transition;
use rustdds::{GUID, StatusEvented, dds::statusevents::DomainParticipantStatusEvent};
use tokio::signal::unix::{SignalKind, signal};
use tokio::sync::Notify;
use tracing::{info, warn};

use arguments::RosArguments;
use drawing::Drawing;
use health::SharedHealth;
use inbox::Inbox;
use learning::Learning;
use lifecycle::State;
use names::Names;
use parameters::Parameters;
use participant::Participant;
use publications::Publishers;
use recording::Recording;
use services::Managed;
use stream::{Command, Stream};
use subscriptions::Subscriptions;

use crate::io::config::InputConfig;

/// The node's name unless it is remapped.
pub const NAME: &str = "bom";
/// Readings that wait for the stream at most: several seconds of them.
const MOST_READINGS: usize = 20_000;

/// Runs the node until it is shut down or told to stop; records what it takes and says in a folder `record`.
///
/// # Errors
/// Names or parameters that make no node, a folder that cannot be created, or no network.
pub fn run(arguments: &RosArguments, record: Option<&Path>) -> anyhow::Result<()> {
    let names = Names::new(NAME, arguments)?;
    let mut parameters = Parameters::declared();
    let unusable = parameters.start_with(&arguments.overrides, &names);
    if parameters.is("realtime") {
        learning::go_first();
    }
    let runtime =
        tokio::runtime::Builder::new_multi_thread().worker_threads(2).enable_all().build().context("tokio")?;
    runtime.block_on(live(&names, parameters, unusable, (!arguments.rosout_disabled, record)))
}

/// The topics of the configuration as they are on the network.
fn resolved(input: &InputConfig, names: &Names) -> InputConfig {
    let mut input = input.clone();
    let resolve = |name: &mut String| *name = names.resolve(name);
    input.clouds.iter_mut().for_each(resolve);
    input.wrenches.iter_mut().for_each(|wrench| resolve(&mut wrench.topic));
    [&mut input.tf, &mut input.tf_static].into_iter().for_each(resolve);
    input.poses = names.expand(&input.poses);
    input
}

async fn live(
    names: &Names,
    parameters: Parameters,
    unusable: Vec<String>,
    (rosout, record): (bool, Option<&Path>),
) -> anyhow::Result<()> {
    let config = parameters.config().map_err(anyhow::Error::msg)?;
    let input = resolved(&config.input, names);
    let health = SharedHealth::new(unusable);
    let inbox: Arc<Inbox<Command>> = Arc::new(Inbox::new(MOST_READINGS));
    let mut participant = Participant::join(names)?;
    if rosout {
        tokio::spawn(rosout::send(participant.advertise_rosout()?, names.full().trim_matches('/').replace('/', ".")));
    }
    let publishers = Publishers::new(&mut participant, &parameters, health.clone())?;
    let mut endpoints = publishers.names.clone();
    let recording = record.map(|folder| Recording::start(folder, names, health.clone())).transpose()?;
    let recording_to = recording.as_ref().map(|(recording, _)| recording.clone());
    let outputs = publishers.start(recording_to.clone());
    let adopt = Arc::clone(&inbox);
    let threads = parameters.number("worker_threads") as usize;
    let learning =
        Learning::start(threads, health.clone(), move |life, learned| adopt.tell(Command::Adopt(life, learned)))?;
    let meshes = parameters.get("mesh_folder").and_then(value::Value::as_text).filter(|folder| !folder.is_empty());
    let drawing = Drawing::start(outputs.clone(), meshes.map(PathBuf::from))?;
    let said_to = (outputs.clone(), drawing, recording_to);
    let stream = Stream::new(Arc::clone(&inbox), learning, said_to, health.clone(), input.clone());
    let thread =
        std::thread::Builder::new().name("stream".into()).spawn(|| stream.run()).context("the stream's thread")?;
    let mut subscriptions =
        Subscriptions::new(&mut participant, &parameters, &input, Arc::clone(&inbox), health.clone())?;
    endpoints.extend(subscriptions.names.clone());
    if parameters.is("use_sim_time") {
        let inbox = Arc::clone(&inbox);
        subscriptions::watch_clock(&mut participant, health.clone(), move || inbox.tell(Command::BeginAgain))?;
    }
    let autostart = parameters.is("autostart");
    let ended = Arc::new(Notify::new());
    let managed = Managed {
        name: names.full(),
        parameters: Arc::new(Mutex::new(parameters)),
        input,
        inbox: Arc::clone(&inbox),
        outputs,
        health: health.clone(),
        ended: Arc::clone(&ended),
    };
    services::serve(&mut participant, &managed)?;
    let bond = tokio::spawn(bond::keep(&mut participant, names.node.clone(), health.clone())?);
    tokio::spawn(diagnostics::watch(managed.clone()));
    info!("{} is there, domain {}", names.full(), participant.node.domain_id());
    if autostart {
        for label in ["configure", "activate"] {
            managed.change(&Transition { id: 0, label: label.to_owned() }).map_err(anyhow::Error::msg)?;
        }
    }
    let (mut interrupted, mut terminated) = (signal(SignalKind::interrupt())?, signal(SignalKind::terminate())?);
    tokio::select! {
        () = watch_network(&mut participant, &mut subscriptions, &mut endpoints, &health) => {}
        () = ended.notified() => info!("shut down"),
        _ = interrupted.recv() => info!("interrupted"),
        _ = terminated.recv() => info!("terminated"),
    }
    inbox.tell(Command::Stop);
    health.lock().state = State::Finalized;
    // It is at a cloud at most.
    let _ = tokio::task::spawn_blocking(move || {
        let ended = thread.join();
        if let Some((recording, thread)) = recording {
            recording.end(thread);
        }
        ended
    })
    .await;
    // It says farewell.
    let _ = bond.await;
    Ok(())
}

/// What happens on the network: topics of poses that appear, and those whose QoS does not fit.
async fn watch_network(
    participant: &mut Participant,
    subscriptions: &mut Subscriptions<Command>,
    endpoints: &mut BTreeMap<GUID, String>,
    health: &SharedHealth,
) {
    let listener = participant.domain_participant().status_listener();
    let events = listener.as_async_status_stream();
    pin_mut!(events);
    while let Some(event) = events.next().await {
        match event {
            DomainParticipantStatusEvent::WriterDetected { writer } => {
                let Some(topic) = writer.topic_name.strip_prefix("rt") else { continue };
                if let Err(error) = subscriptions.appeared(participant, topic) {
                    warn!("{error:#}");
                }
                endpoints.extend(subscriptions.names.clone());
            }
            DomainParticipantStatusEvent::RemoteWriterQosIncompatible {
                local_reader,
                requested_qos,
                offered_qos,
                ..
            } => {
                if let Some(topic) = endpoints.get(&local_reader) {
                    let line = mismatch("a publisher's QoS does not fit", &requested_qos, &offered_qos);
                    health.lock().incompatible.insert(topic.clone(), line);
                }
            }
            DomainParticipantStatusEvent::RemoteReaderQosIncompatible {
                local_writer,
                requested_qos,
                offered_qos,
                ..
            } => {
                if let Some(topic) = endpoints.get(&local_writer) {
                    let line = mismatch("a subscriber's QoS does not fit", &requested_qos, &offered_qos);
                    health.lock().incompatible.insert(topic.clone(), line);
                }
            }
            _ => {}
        }
    }
}

fn mismatch(what: &str, requested: &rustdds::QosPolicies, offered: &rustdds::QosPolicies) -> String {
    let mut differences = Vec::new();
    let mut compare = |name: &str, requested: String, offered: String| {
        if requested != offered {
            differences.push(format!("{name}: requested {requested}, offered {offered}"));
        }
    };
    compare("reliability", format!("{:?}", requested.reliability()), format!("{:?}", offered.reliability()));
    compare("durability", format!("{:?}", requested.durability()), format!("{:?}", offered.durability()));
    compare("deadline", format!("{:?}", requested.deadline()), format!("{:?}", offered.deadline()));
    compare("liveliness", format!("{:?}", requested.liveliness()), format!("{:?}", offered.liveliness()));
    format!("{what}: {}", differences.join(", "))
}
