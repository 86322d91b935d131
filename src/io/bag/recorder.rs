//! A bag in the making: messages of any topics as they come, each topic declared with its first.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use serde::Serialize;
use thiserror::Error;

use super::folder::{FileSummary, TopicCount, write_metadata};
use super::writer::{BagWriter, TopicId, WriteError};
use crate::io::cdr::{self, CdrError, Endianness};

/// Why a message could not be recorded.
#[derive(Debug, Error)]
pub enum RecordError {
    /// It cannot be encoded.
    #[error("{topic}: {source}")]
    Encode {
        /// Its topic.
        topic: String,
        /// What is wrong with it.
        source: CdrError,
    },
    /// It cannot be written.
    #[error(transparent)]
    Write(#[from] WriteError),
    /// A folder's description cannot be written.
    #[error("{}: {source}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: std::io::Error,
    },
}

/// One file being recorded.
pub struct Recorder {
    writer: BagWriter,
    topics: BTreeMap<(String, String), (TopicId, u64)>,
    /// Earliest and latest log time \[ns\].
    span_ns: Option<(u64, u64)>,
}

impl Recorder {
    /// Creates the file.
    ///
    /// # Errors
    /// If it cannot be created.
    pub fn create(path: &Path) -> Result<Self, RecordError> {
        Ok(Self { writer: BagWriter::create(path)?, topics: BTreeMap::new(), span_ns: None })
    }

    /// Writes a message of an absolute topic and a type `package/msg/Name`, encapsulation header and all,
    /// at its log time \[ns\].
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn bytes(&mut self, topic: &str, type_name: &str, log_ns: u64, message: &[u8]) -> Result<(), RecordError> {
        let key = (topic.to_owned(), type_name.to_owned());
        let id = match self.topics.get_mut(&key) {
            Some((id, count)) => {
                *count += 1;
                *id
            }
            None => {
                let id = self.writer.add_topic(topic, type_name)?;
                self.topics.insert(key, (id, 1));
                id
            }
        };
        let (first, last) = self.span_ns.unwrap_or((log_ns, log_ns));
        self.span_ns = Some((first.min(log_ns), last.max(log_ns)));
        Ok(self.writer.write(id, log_ns, log_ns, message)?)
    }

    /// Encodes and writes a message.
    ///
    /// # Errors
    /// If it cannot be encoded or written.
    pub fn message<M: Serialize>(
        &mut self,
        topic: &str,
        type_name: &str,
        log_ns: u64,
        message: &M,
    ) -> Result<(), RecordError> {
        let encoded = cdr::encode(message, Endianness::Little);
        let encoded = encoded.map_err(|source| RecordError::Encode { topic: topic.to_owned(), source })?;
        self.bytes(topic, type_name, log_ns, &encoded)
    }

    /// Completes the file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(self) -> Result<(), RecordError> {
        Ok(self.writer.finish()?)
    }

    fn summary(&self, file: String) -> FileSummary {
        let count = |((name, type_name), (_, count)): (&(String, String), &(TopicId, u64))| TopicCount {
            name: name.clone(),
            type_name: type_name.clone(),
            count: *count,
        };
        FileSummary { file, span_ns: self.span_ns.unwrap_or_default(), topics: self.topics.iter().map(count).collect() }
    }
}

/// A rosbag2 folder being recorded: its file can be read even if the recording is never finished.
pub struct FolderRecorder {
    folder: PathBuf,
    file: String,
    recorder: Recorder,
}

impl FolderRecorder {
    /// Creates the folder with its file, named as rosbag2 names it.
    ///
    /// # Errors
    /// If it exists or cannot be created.
    pub fn create(folder: &Path) -> Result<Self, RecordError> {
        let failed = |source| RecordError::Metadata { path: folder.to_owned(), source };
        std::fs::create_dir(folder).map_err(failed)?;
        let name = folder.file_name().map_or_else(|| "recording".into(), |name| name.to_string_lossy());
        let file = format!("{name}_0.mcap");
        let recorder = Recorder::create(&folder.join(&file))?;
        Ok(Self { folder: folder.to_owned(), file, recorder })
    }

    /// What writes to its file.
    pub fn recorder(&mut self) -> &mut Recorder {
        &mut self.recorder
    }

    /// Completes file and folder.
    ///
    /// # Errors
    /// If they cannot be written.
    pub fn finish(self) -> Result<(), RecordError> {
        let summary = self.recorder.summary(self.file);
        self.recorder.finish()?;
        let path = self.folder.join("metadata.yaml");
        write_metadata(&path, &summary).map_err(|source| RecordError::Metadata { path, source })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::bag::Bag;
    use crate::io::messages::{TF_TYPE, TfMessage};

    #[test]
    fn a_folder_reads_back_finished_or_not() {
        let here = tempfile::tempdir().unwrap();
        let folder = here.path().join("run");
        let mut recording = FolderRecorder::create(&folder).unwrap();
        for log_ns in [5_000_000_001, 5_000_000_004] {
            recording.recorder().message("/tf", TF_TYPE, log_ns, &TfMessage::default()).unwrap();
        }
        recording.finish().unwrap();
        let metadata = std::fs::read_to_string(folder.join("metadata.yaml")).unwrap();
        for line in ["version: 9", "message_count: 2", "nanoseconds_since_epoch: 5000000001", "- run_0.mcap"] {
            assert!(metadata.contains(line), "{line} in\n{metadata}");
        }
        let times: Vec<u64> = Bag::open(&folder).unwrap().map(|message| message.log_time_ns).collect();
        assert_eq!(times, [5_000_000_001, 5_000_000_004]);
        assert!(FolderRecorder::create(&folder).is_err(), "nothing is written over");
    }
}
