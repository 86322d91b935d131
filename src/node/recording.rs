//! `--record`: what the stream took and what was published of it, as a rosbag2 folder, written beside them.
//!
//! Messages are in the order in which the stream took them, so that a replay takes them in the same. Frames
//! of parts on /tf are as they are heard, like all of /tf.

use std::path::Path;
use std::sync::Arc;
use std::sync::mpsc::{Receiver, SyncSender, sync_channel};
use std::thread::JoinHandle;

use anyhow::Context as _;
use serde::Serialize;
use tracing::{info, warn};

use super::health::{SharedHealth, since_epoch};
use super::learning::give_way;
use super::names::Names;
use super::publications::{Publication, topics};
use crate::io::bag::{FolderRecorder, RecordError, Recorder};
use crate::io::counters::Counters;
use crate::io::ingest::Message;
use crate::io::messages::Header;
use crate::io::recorded_windows::WINDOWS;
use crate::types::Stamp;

/// Messages that wait to be written at most: two seconds of a camera and a wrench.
const MOST_WAITING: usize = 512;

enum Entry {
    Accepted(Arc<str>, Message<'static>),
    Published(Publication),
    /// The last frame of a window.
    Window(Stamp),
    /// No more will come.
    End,
}

/// Hands messages to the thread that writes them; cheap to share.
#[derive(Clone)]
pub struct Recording {
    sender: SyncSender<(u64, Entry)>,
    health: SharedHealth,
}

/// The thread that writes.
pub struct RecordingThread(JoinHandle<()>);

impl Recording {
    /// Creates the folder and starts the thread.
    ///
    /// # Errors
    /// A folder that exists or cannot be created, or no thread.
    pub fn start(folder: &Path, names: &Names, health: SharedHealth) -> anyhow::Result<(Self, RecordingThread)> {
        let recorder = FolderRecorder::create(folder).context("--record")?;
        let (sender, entries) = sync_channel(MOST_WAITING);
        let (names, shown) = (names.clone(), folder.display().to_string());
        let write = move || match write_all(recorder, &entries, &names) {
            Ok(count) => info!("{shown}: {count} messages recorded"),
            Err(error) => warn!("{shown}: the recording ended: {error}"),
        };
        let thread = std::thread::Builder::new().name("recording".into()).spawn(write);
        Ok((Self { sender, health }, RecordingThread(thread.context("the thread that records")?)))
    }

    /// The stream takes a message of an absolute topic.
    pub fn accepted(&self, topic: &Arc<str>, message: &Message<'static>) {
        self.put(Entry::Accepted(Arc::clone(topic), message.clone()));
    }

    /// Something is published.
    pub fn published(&self, publication: Publication) {
        self.put(Entry::Published(publication));
    }

    /// A window ended with the frame of this stamp.
    pub fn window(&self, last: Stamp) {
        self.put(Entry::Window(last));
    }

    fn put(&self, entry: Entry) {
        if self.sender.try_send((wall_ns(), entry)).is_err() {
            Counters::add(&mut self.health.lock().unsent, "the recording is behind", 1);
        }
    }

    /// Completes the recording.
    pub fn end(self, thread: RecordingThread) {
        // Where the thread has ended there is nothing to complete.
        let _ = self.sender.send((wall_ns(), Entry::End));
        let _ = thread.0.join();
    }
}

/// Bags are logged by the wall clock.
fn wall_ns() -> u64 {
    u64::try_from(since_epoch().as_nanos()).unwrap_or(u64::MAX)
}

/// Writes what was published under the name that it has on the network.
struct Say<'a> {
    recorder: &'a mut Recorder,
    names: &'a Names,
    log_ns: u64,
}

impl Say<'_> {
    fn message<M: Serialize>(&mut self, (name, type_name): topics::Topic, message: &M) -> Result<(), RecordError> {
        self.recorder.message(&self.names.resolve(name), type_name, self.log_ns, message)
    }

    fn window(&mut self, last: Stamp) -> Result<(), RecordError> {
        self.message(WINDOWS, &Header { stamp: last.into(), ..Header::default() })
    }
}

fn write_all(mut folder: FolderRecorder, entries: &Receiver<(u64, Entry)>, names: &Names) -> Result<u64, RecordError> {
    give_way();
    let (mut log_ns, mut count) = (wall_ns(), 0);
    // Of no window: those that end are told from now on.
    Say { recorder: folder.recorder(), names, log_ns }.window(Stamp(0))?;
    while let Ok((at_ns, entry)) = entries.recv() {
        // Readers go by log times: no two are the same.
        log_ns = at_ns.max(log_ns + 1);
        let recorder = folder.recorder();
        count += 1;
        match entry {
            Entry::End => break,
            Entry::Accepted(topic, message) => {
                let type_name = message.type_name();
                match message {
                    Message::Cloud(message) => recorder.message(&topic, type_name, log_ns, &message)?,
                    Message::Wrench(message) => recorder.message(&topic, type_name, log_ns, &message)?,
                    Message::Pose(message) => recorder.message(&topic, type_name, log_ns, &message)?,
                    Message::Tf(message) => recorder.message(&topic, type_name, log_ns, &message)?,
                }
            }
            Entry::Window(last) => Say { recorder, names, log_ns }.window(last)?,
            Entry::Published(publication) => {
                let mut say = Say { recorder, names, log_ns };
                match &publication {
                    Publication::Posterior(message) => say.message(topics::OBJECT_POSTERIOR, &**message)?,
                    Publication::Predicted(message, _) => say.message(topics::PREDICTED_POSES, message)?,
                    Publication::Criticism(message) => say.message(topics::CRITICISM, message)?,
                    Publication::Markers(message) => say.message(topics::MARKERS, message)?,
                    Publication::Description(message) => say.message(topics::ROBOT_DESCRIPTION, message)?,
                    Publication::JointStates(message) => say.message(topics::JOINT_STATES, message)?,
                    Publication::Diagnostics(message) => say.message(topics::DIAGNOSTICS, message)?,
                    Publication::Tf(_) | Publication::Transition(_) | Publication::ParameterEvent(_) => count -= 1,
                }
            }
        }
    }
    folder.finish()?;
    Ok(count - 1)
}
