//! Writes bags as rosbag2 does: MCAP, profile ros2, CDR messages, schemas with their dependencies.

use std::{
    collections::BTreeMap,
    fs::File,
    io::BufWriter,
    path::{Path, PathBuf},
};

use mcap::{WriteOptions, Writer, records::MessageHeader};
use thiserror::Error;

use crate::io::definitions;

/// How chunks are compressed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// Not at all.
    None,
    /// LZ4 frames.
    Lz4,
    /// Zstandard, as rosbag2's default presets.
    #[default]
    Zstd,
}

/// Why a bag could not be written.
#[derive(Debug, Error)]
#[error("{}: {source}", path.display())]
pub struct WriteError {
    /// The file.
    pub path: PathBuf,
    /// What went wrong.
    pub source: mcap::McapError,
}

/// A topic of a bag being written.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct TopicId(u16);

/// A bag being written. Call [`BagWriter::finish`]: without it the summary is missing.
pub struct BagWriter {
    path: PathBuf,
    writer: Writer<BufWriter<File>>,
    sequences: BTreeMap<u16, u32>,
}

impl BagWriter {
    /// Creates the file, zstd chunks of .8 MB (rosbag2's size).
    ///
    /// # Errors
    /// If it cannot be created.
    pub fn create(path: &Path) -> Result<Self, WriteError> {
        Self::create_with(path, Compression::Zstd, Some(768 * 1024))
    }

    /// Creates the file; `chunk_size` in bytes, `None` for messages outside of chunks.
    ///
    /// # Errors
    /// If it cannot be created.
    pub fn create_with(path: &Path, compression: Compression, chunk_size: Option<u64>) -> Result<Self, WriteError> {
        let fail = |source| WriteError { path: path.to_owned(), source };
        let file = File::create(path).map_err(|error| fail(error.into()))?;
        let compression = match compression {
            Compression::None => None,
            Compression::Lz4 => Some(mcap::Compression::Lz4),
            Compression::Zstd => Some(mcap::Compression::Zstd),
        };
        let writer = WriteOptions::new()
            .profile("ros2")
            .library(concat!("bom ", env!("CARGO_PKG_VERSION")))
            .compression(compression)
            .use_chunks(chunk_size.is_some())
            .chunk_size(chunk_size)
            .create(BufWriter::new(file))
            .map_err(fail)?;
        Ok(Self { path: path.to_owned(), writer, sequences: BTreeMap::new() })
    }

    /// Declares a topic (absolute name) of a type whose definition is known here (see
    /// [`definitions::full_text`]), or else has an empty one.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn add_topic(&mut self, name: &str, type_name: &str) -> Result<TopicId, WriteError> {
        let definition = definitions::full_text(type_name).unwrap_or_default();
        self.add_topic_with_definition(name, type_name, &definition)
    }

    /// Declares a topic with the full text of its type: the definition, then those it depends on.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn add_topic_with_definition(
        &mut self,
        name: &str,
        type_name: &str,
        definition: &str,
    ) -> Result<TopicId, WriteError> {
        let metadata = BTreeMap::from([("offered_qos_profiles".to_owned(), String::new())]);
        let schema = self.writer.add_schema(type_name, "ros2msg", definition.as_bytes());
        let channel = schema.and_then(|schema| self.writer.add_channel(schema, name, "cdr", &metadata));
        channel.map(TopicId).map_err(|source| self.fail(source))
    }

    /// Writes one CDR message, header and all. Times in ns.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn write(
        &mut self,
        topic: TopicId,
        log_time: u64,
        publish_time: u64,
        message: &[u8],
    ) -> Result<(), WriteError> {
        let next = self.sequences.entry(topic.0).or_default();
        let sequence = *next;
        *next = next.wrapping_add(1);
        let header = MessageHeader { channel_id: topic.0, sequence, log_time, publish_time };
        self.writer.write_to_known_channel(&header, message).map_err(|source| self.fail(source))
    }

    /// Writes the summary and closes the file.
    ///
    /// # Errors
    /// If it cannot be written.
    pub fn finish(mut self) -> Result<(), WriteError> {
        self.writer.finish().map(|_| ()).map_err(|source| self.fail(source))
    }

    fn fail(&self, source: mcap::McapError) -> WriteError {
        WriteError { path: self.path.clone(), source }
    }
}
