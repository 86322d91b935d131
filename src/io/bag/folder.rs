//! Which files make up a bag: one .mcap, or a rosbag2 folder with its metadata.yaml.
//!
//! rosbag2_storage, metadata version 9; older versions have the same fields. A folder without
//! metadata (a recorder that was killed) is its .mcap files in the order of their numbers.

use std::{
    fs::{self, File},
    io,
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Why a bag cannot be opened.
#[derive(Debug, Error)]
pub enum BagError {
    /// A file or folder is missing or cannot be read.
    #[error("{}: {source}", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// A file is no MCAP.
    #[error("{}: not an MCAP file ({length} bytes, does not begin with \\x89MCAP0)", path.display())]
    NotMcap {
        /// The file.
        path: PathBuf,
        /// Its length.
        length: u64,
    },
    /// A folder without metadata.yaml and without .mcap files.
    #[error("{}: no metadata.yaml and no .mcap file in this folder", path.display())]
    NoBag {
        /// The folder.
        path: PathBuf,
    },
    /// metadata.yaml is malformed.
    #[error("{}: {reason}", path.display())]
    Metadata {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// metadata.yaml asks for something else than MCAP.
    #[error("{}: {key} is `{found}`, expected {expected}", path.display())]
    Unsupported {
        /// The file.
        path: PathBuf,
        /// The key.
        key: &'static str,
        /// Its value.
        found: String,
        /// What is accepted.
        expected: &'static str,
    },
}

impl BagError {
    pub(super) fn io(path: &Path, source: io::Error) -> Self {
        Self::Io { path: path.to_owned(), source }
    }
}

/// The files of a bag, in order.
#[derive(Debug, PartialEq, Eq)]
pub(super) struct BagFiles {
    pub paths: Vec<PathBuf>,
    /// Every message is compressed on its own.
    pub messages_are_compressed: bool,
}

#[derive(Deserialize)]
struct MetadataFile {
    rosbag2_bagfile_information: Metadata,
}

#[derive(Deserialize)]
struct Metadata {
    #[serde(default)]
    storage_identifier: String,
    #[serde(default)]
    compression_format: String,
    #[serde(default)]
    compression_mode: String,
    #[serde(default)]
    relative_file_paths: Vec<PathBuf>,
}

/// The files behind a path.
pub(super) fn bag_files(path: &Path) -> Result<BagFiles, BagError> {
    let kind = fs::metadata(path).map_err(|source| BagError::io(path, source))?;
    if !kind.is_dir() {
        return Ok(BagFiles { paths: vec![path.to_owned()], messages_are_compressed: false });
    }
    let metadata_path = path.join("metadata.yaml");
    match fs::read_to_string(&metadata_path) {
        Ok(text) => from_metadata(path, &metadata_path, &text),
        Err(error) if error.kind() == io::ErrorKind::NotFound => from_listing(path),
        Err(source) => Err(BagError::Io { path: metadata_path, source }),
    }
}

/// Opens a file; one that is compressed as a whole (.zstd, .zst) is unpacked into a temporary file
/// first, which leaves memory alone and can be read in any order. Says whether unpacking broke off.
pub(super) fn open_file(path: &Path) -> Result<(File, Option<io::Error>), BagError> {
    let fail = |source| BagError::io(path, source);
    let file = File::open(path).map_err(fail)?;
    if !path.extension().is_some_and(|extension| extension == "zstd" || extension == "zst") {
        return Ok((file, None));
    }
    let mut unpacked = tempfile::tempfile().map_err(fail)?;
    let outcome = zstd::stream::copy_decode(file, &mut unpacked);
    Ok((unpacked, outcome.err()))
}

fn from_metadata(folder: &Path, path: &Path, text: &str) -> Result<BagFiles, BagError> {
    let malformed = |reason: String| BagError::Metadata { path: path.to_owned(), reason };
    let unsupported = |key, found: &str, expected| {
        Err(BagError::Unsupported { path: path.to_owned(), key, found: found.to_owned(), expected })
    };
    let metadata: MetadataFile = serde_yaml_ng::from_str(text).map_err(|error| malformed(error.to_string()))?;
    let metadata = metadata.rosbag2_bagfile_information;
    if !matches!(metadata.storage_identifier.as_str(), "mcap" | "") {
        return unsupported("storage_identifier", &metadata.storage_identifier, "mcap");
    }
    if !matches!(metadata.compression_format.as_str(), "zstd" | "") {
        return unsupported("compression_format", &metadata.compression_format, "zstd or nothing");
    }
    let mode = metadata.compression_mode.to_ascii_lowercase();
    if !matches!(mode.as_str(), "" | "none" | "file" | "message") {
        return unsupported("compression_mode", &metadata.compression_mode, "file, message or none");
    }
    if metadata.relative_file_paths.is_empty() {
        return Err(malformed("relative_file_paths is missing or empty".into()));
    }
    let paths = metadata.relative_file_paths.iter().map(|file| existing(folder.join(file))).collect();
    Ok(BagFiles { paths, messages_are_compressed: mode == "message" })
}

/// The path, or that of its compressed or decompressed sibling if only that is there: tools unpack
/// files and leave the metadata as it was, or the other way round.
fn existing(path: PathBuf) -> PathBuf {
    let sibling = match path.extension().is_some_and(|extension| extension == "zstd") {
        true => path.with_extension(""),
        false => PathBuf::from(format!("{}.zstd", path.display())),
    };
    if !path.exists() && sibling.exists() { sibling } else { path }
}

fn from_listing(folder: &Path) -> Result<BagFiles, BagError> {
    let entries = fs::read_dir(folder).map_err(|source| BagError::io(folder, source))?;
    let mut paths = Vec::new();
    for entry in entries {
        let path = entry.map_err(|source| BagError::io(folder, source))?.path();
        let name = path.file_name().map(|name| name.to_string_lossy().into_owned()).unwrap_or_default();
        if [".mcap", ".mcap.zstd", ".mcap.zst"].iter().any(|ending| name.ends_with(ending)) {
            paths.push(path);
        }
    }
    if paths.is_empty() {
        return Err(BagError::NoBag { path: folder.to_owned() });
    }
    // bag_2 before bag_10.
    paths.sort_by_key(|path| (path.as_os_str().len(), path.clone()));
    Ok(BagFiles { paths, messages_are_compressed: false })
}

/// A topic of a file, and how many messages it has there.
pub(super) struct TopicCount {
    pub name: String,
    pub type_name: String,
    pub count: u64,
}

/// What a folder says of its only file.
pub(super) struct FileSummary {
    pub file: String,
    /// Earliest and latest log time \[ns\].
    pub span_ns: (u64, u64),
    pub topics: Vec<TopicCount>,
}

#[derive(Serialize)]
struct Nanoseconds {
    nanoseconds: u64,
}

#[derive(Serialize)]
struct SinceEpoch {
    nanoseconds_since_epoch: u64,
}

#[derive(Serialize)]
struct TopicMetadata<'a> {
    name: &'a str,
    r#type: &'a str,
    serialization_format: &'static str,
    offered_qos_profiles: [(); 0],
    type_description_hash: &'static str,
}

#[derive(Serialize)]
struct TopicEntry<'a> {
    topic_metadata: TopicMetadata<'a>,
    message_count: u64,
}

#[derive(Serialize)]
struct FileEntry<'a> {
    path: &'a str,
    starting_time: SinceEpoch,
    duration: Nanoseconds,
    message_count: u64,
}

#[derive(Serialize)]
struct FolderMetadata<'a> {
    version: u32,
    storage_identifier: &'static str,
    duration: Nanoseconds,
    starting_time: SinceEpoch,
    message_count: u64,
    topics_with_message_count: Vec<TopicEntry<'a>>,
    compression_format: &'static str,
    compression_mode: &'static str,
    relative_file_paths: [&'a str; 1],
    files: [FileEntry<'a>; 1],
    custom_data: Option<()>,
    ros_distro: &'static str,
}

#[derive(Serialize)]
struct FolderFile<'a> {
    rosbag2_bagfile_information: FolderMetadata<'a>,
}

impl<'a> From<&'a TopicCount> for TopicEntry<'a> {
    fn from(topic: &'a TopicCount) -> Self {
        let topic_metadata = TopicMetadata {
            name: &topic.name,
            r#type: &topic.type_name,
            serialization_format: "cdr",
            offered_qos_profiles: [],
            type_description_hash: "",
        };
        Self { topic_metadata, message_count: topic.count }
    }
}

/// Writes a folder's metadata.yaml.
pub(super) fn write_metadata(path: &Path, summary: &FileSummary) -> io::Result<()> {
    let (first, last) = summary.span_ns;
    let duration = || Nanoseconds { nanoseconds: last - first };
    let starting_time = || SinceEpoch { nanoseconds_since_epoch: first };
    let message_count = summary.topics.iter().map(|topic| topic.count).sum();
    let file = FileEntry { path: &summary.file, starting_time: starting_time(), duration: duration(), message_count };
    let metadata = FolderMetadata {
        version: 9,
        storage_identifier: "mcap",
        duration: duration(),
        starting_time: starting_time(),
        message_count,
        topics_with_message_count: summary.topics.iter().map(TopicEntry::from).collect(),
        compression_format: "",
        compression_mode: "",
        relative_file_paths: [&summary.file],
        files: [file],
        custom_data: None,
        ros_distro: "jazzy",
    };
    let text = serde_yaml_ng::to_string(&FolderFile { rosbag2_bagfile_information: metadata });
    fs::write(path, text.map_err(io::Error::other)?)
}
