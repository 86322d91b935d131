//! `--record`: the messages that were read, as a bag that appears when it is complete.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use bayesian_object_models::io::{
    bag::{BagMessage, BagWriter, TopicId},
    config::InputConfig,
    topics::Role,
};
use tempfile::TempDir;

/// A bag being written.
pub struct Recording {
    path: PathBuf,
    folder: TempDir,
    writer: BagWriter,
    /// By name and type; `None` for topics that are not read.
    topics: BTreeMap<(String, String), Option<TopicId>>,
}

impl Recording {
    /// Opens it, aside.
    pub fn create(path: &Path) -> anyhow::Result<Self> {
        let beside = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let folder = tempfile::Builder::new().prefix(".bom-").tempdir_in(beside);
        let folder = folder.with_context(|| path.display().to_string())?;
        let writer = BagWriter::create(&folder.path().join("recording.mcap"))?;
        Ok(Self { path: path.to_owned(), folder, writer, topics: BTreeMap::new() })
    }

    /// Writes a message as it came, if its topic is read.
    pub fn take(&mut self, message: &BagMessage, config: &InputConfig) -> anyhow::Result<()> {
        let key = (message.topic.name.clone(), message.topic.type_name.clone());
        let topic = match self.topics.get(&key) {
            Some(topic) => *topic,
            None => {
                let is_read = Role::of(&key.0, config).is_some();
                let topic = is_read.then(|| self.writer.add_topic(&key.0, &key.1)).transpose()?;
                self.topics.insert(key, topic);
                topic
            }
        };
        if let Some(topic) = topic {
            self.writer.write(topic, message.log_time_ns, message.log_time_ns, message.bytes())?;
        }
        Ok(())
    }

    /// Completes it.
    pub fn finish(self) -> anyhow::Result<()> {
        self.writer.finish()?;
        let written = self.folder.path().join("recording.mcap");
        std::fs::rename(written, &self.path).with_context(|| self.path.display().to_string())
    }
}
