//! Recorded bags: an .mcap file or a rosbag2 folder, message by message in the order of log times.
//!
//! Opening maps the files (`walk`); reading then holds one chunk at a time, or as many as overlap
//! in time. Damage ends nothing: what is readable is delivered, the rest is reported by place.

mod folder;
mod recorder;
mod records;
mod walk;
mod writer;

use std::{
    cmp::Reverse,
    collections::{BTreeMap, BTreeSet, BinaryHeap, VecDeque},
    fmt,
    fs::File,
    ops::Range,
    path::{Path, PathBuf},
    sync::Arc,
};

use tracing::warn;

pub use folder::BagError;
pub use recorder::{FolderRecorder, RecordError, Recorder};
pub use records::DamageKind;
pub use writer::{BagWriter, Compression, TopicId, WriteError};

use records::{MESSAGE_HEADER, Records, op};
use walk::{Channels, Segment, SegmentKind};

/// A topic of a bag.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct TopicInfo {
    /// Absolute name.
    pub name: String,
    /// As `sensor_msgs/msg/PointCloud2`.
    pub type_name: String,
    /// As `cdr`.
    pub encoding: String,
}

/// What a bag holds.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct BagSummary {
    /// All topics, by name, with their message counts.
    pub topics: Vec<(TopicInfo, u64)>,
    /// Messages in all.
    pub message_count: u64,
    /// Bytes to be read: compare with [`Bag::bytes_read`].
    pub bytes: u64,
}

/// One recorded message.
#[derive(Clone, Debug)]
pub struct BagMessage {
    /// Where it was published.
    pub topic: Arc<TopicInfo>,
    /// When it was logged \[ns\]; says nothing of when it was captured.
    pub log_time_ns: u64,
    chunk: Arc<Vec<u8>>,
    range: Range<usize>,
}

impl BagMessage {
    /// The message, CDR header and all.
    pub fn bytes(&self) -> &[u8] {
        self.chunk.get(self.range.clone()).unwrap_or_default()
    }
}

/// Something unreadable in a bag.
#[derive(Debug)]
pub struct Damage {
    /// The file.
    pub file: PathBuf,
    /// Where in it \[bytes\]; within a file that is compressed as a whole, after decompression.
    pub offset: u64,
    /// What is wrong.
    pub kind: DamageKind,
}

impl fmt::Display for Damage {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}, byte {}: {}", self.file.display(), self.offset, self.kind)
    }
}

/// An open bag: an iterator over its messages in the order of log times.
#[derive(Debug)]
pub struct Bag {
    files: Vec<BagFile>,
    /// What is still to be read, by log time of the first message.
    segments: VecDeque<(usize, Segment)>,
    /// Messages of the segments read, the earliest on top.
    pending: BinaryHeap<Reverse<Pending>>,
    /// Messages read, to keep the order of the file among equal times.
    sequence: u64,
    messages_are_compressed: bool,
    summary: BagSummary,
    bytes_read: u64,
    damage: Vec<Damage>,
    /// Channels already reported, by file.
    reported_channels: BTreeSet<(usize, u16)>,
}

#[derive(Debug)]
struct BagFile {
    path: PathBuf,
    file: File,
    channels: Channels,
}

/// A message that has been read and awaits its turn.
#[derive(Debug)]
struct Pending {
    log_time_ns: u64,
    sequence: u64,
    message: BagMessage,
}

impl PartialEq for Pending {
    fn eq(&self, other: &Self) -> bool {
        self.cmp(other).is_eq()
    }
}

impl Eq for Pending {}

impl PartialOrd for Pending {
    fn partial_cmp(&self, other: &Self) -> Option<std::cmp::Ordering> {
        Some(self.cmp(other))
    }
}

impl Ord for Pending {
    fn cmp(&self, other: &Self) -> std::cmp::Ordering {
        (self.log_time_ns, self.sequence).cmp(&(other.log_time_ns, other.sequence))
    }
}

impl Bag {
    /// Opens an .mcap file or a rosbag2 folder and looks up what it holds. In a folder, a file that
    /// is missing or is no MCAP is damage, as long as there is another one.
    ///
    /// # Errors
    /// A path that does not exist or is no bag, named with the reason.
    pub fn open(path: &Path) -> Result<Self, BagError> {
        let bag_files = folder::bag_files(path)?;
        let mut bag = Self {
            files: Vec::new(),
            segments: VecDeque::new(),
            pending: BinaryHeap::new(),
            sequence: 0,
            messages_are_compressed: bag_files.messages_are_compressed,
            summary: BagSummary::default(),
            bytes_read: 0,
            damage: Vec::new(),
            reported_channels: BTreeSet::new(),
        };
        let mut segments = Vec::new();
        let mut counts = BTreeMap::new();
        let mut first_error = None;
        for path in bag_files.paths {
            match bag.add_file(&path, &mut counts) {
                Ok(found) => segments.extend(found),
                Err(error) => {
                    let kind = DamageKind::Io(std::io::Error::other(error.to_string()));
                    bag.damage.push(Damage { file: path, offset: 0, kind });
                    first_error.get_or_insert(error);
                }
            }
        }
        if let Some(error) = first_error.filter(|_| bag.files.is_empty()) {
            return Err(error);
        }
        segments.sort_by_key(|(file, segment)| (segment.start, *file, segment.offset));
        bag.summary.bytes = segments.iter().map(|(_, segment)| segment.length).sum();
        bag.summary.message_count = counts.values().sum();
        bag.summary.topics = counts.into_iter().collect();
        bag.segments = segments.into();
        for damage in &bag.damage {
            warn!("{damage}");
        }
        Ok(bag)
    }

    /// Topics, counts and size.
    pub fn summary(&self) -> &BagSummary {
        &self.summary
    }

    /// Bytes read so far, of [`BagSummary::bytes`].
    pub fn bytes_read(&self) -> u64 {
        self.bytes_read
    }

    /// What was unreadable so far; complete when the iterator has ended.
    pub fn damage(&self) -> &[Damage] {
        &self.damage
    }

    fn add_file(
        &mut self,
        path: &Path,
        counts: &mut BTreeMap<TopicInfo, u64>,
    ) -> Result<Vec<(usize, Segment)>, BagError> {
        let (file, broken_off) = folder::open_file(path)?;
        let fail = |source| BagError::io(path, source);
        let map = walk::map_file(&file).map_err(fail)?;
        let length = file.metadata().map_err(fail)?.len();
        let Some(map) = map else {
            return Err(match broken_off {
                Some(source) => fail(source),
                None => BagError::NotMcap { path: path.to_owned(), length },
            });
        };
        for topic in map.channels.by_id.values() {
            counts.entry(TopicInfo::clone(topic)).or_default();
        }
        for (channel, count) in &map.counts {
            if let Some(topic) = map.channels.by_id.get(channel) {
                *counts.entry(TopicInfo::clone(topic)).or_default() += count;
            }
        }
        let damage = |(offset, kind)| Damage { file: path.to_owned(), offset, kind };
        self.damage.extend(broken_off.map(|error| damage((length, DamageKind::Io(error)))));
        self.damage.extend(map.damage.into_iter().map(damage));
        let index = self.files.len();
        self.files.push(BagFile { path: path.to_owned(), file, channels: map.channels });
        Ok(map.segments.into_iter().map(|segment| (index, segment)).collect())
    }

    /// Reads segments until the earliest message read comes before all that are not.
    fn read_ahead(&mut self) {
        while let Some((file, segment)) = self.segments.front().copied() {
            if self.pending.peek().is_some_and(|Reverse(earliest)| earliest.log_time_ns < segment.start) {
                return;
            }
            self.segments.pop_front();
            self.bytes_read += segment.length;
            match self.read_segment(file, &segment) {
                // Where the file was cut is reported already.
                Err(_) if segment.kind == SegmentKind::CutChunk => {}
                Err(kind) => self.report(file, segment.offset, kind),
                Ok(()) => {}
            }
        }
    }

    fn read_segment(&mut self, file_index: usize, segment: &Segment) -> Result<(), DamageKind> {
        let Some(file) = self.files.get_mut(file_index) else {
            return Ok(());
        };
        let chunk = Arc::new(walk::read_segment(&mut file.file, segment)?);
        let mut unusable = Vec::new();
        for record in (Records { bytes: &chunk, position: 0 }) {
            let (opcode, range) = record?;
            let body = chunk.get(range.clone()).unwrap_or_default();
            if opcode != op::MESSAGE {
                file.channels.declare(opcode, body)?;
                continue;
            }
            let (channel, log_time_ns) = records::message_header(body).ok_or(DamageKind::BadRecord { opcode })?;
            match file.channels.by_id.get(&channel) {
                Some(topic) if topic.encoding == "cdr" => {
                    let range = range.start + MESSAGE_HEADER..range.end;
                    let message = BagMessage { topic: topic.clone(), log_time_ns, chunk: chunk.clone(), range };
                    self.pending.push(Reverse(Pending { log_time_ns, sequence: self.sequence, message }));
                    self.sequence += 1;
                }
                Some(topic) => unusable.push((
                    channel,
                    DamageKind::Encoding { topic: topic.name.clone(), encoding: topic.encoding.clone() },
                )),
                None => unusable.push((channel, DamageKind::UnknownChannel(channel))),
            }
        }
        for (channel, kind) in unusable {
            if self.reported_channels.insert((file_index, channel)) {
                self.report(file_index, segment.offset, kind);
            }
        }
        Ok(())
    }

    fn report(&mut self, file_index: usize, offset: u64, kind: DamageKind) {
        let file = self.files.get(file_index).map(|file| file.path.clone()).unwrap_or_default();
        let damage = Damage { file, offset, kind };
        warn!("{damage}");
        self.damage.push(damage);
    }

    /// Undoes rosbag2's compression of single messages.
    fn unpack(&mut self, message: BagMessage) -> Option<BagMessage> {
        let mut unpacked = Vec::new();
        let outcome = zstd::stream::read::Decoder::with_buffer(message.bytes())
            .and_then(|decoder| records::read_limited(decoder, records::MAX_CHUNK, &mut unpacked));
        match outcome {
            Ok(()) => {
                let range = 0..unpacked.len();
                Some(BagMessage { chunk: Arc::new(unpacked), range, ..message })
            }
            Err(error) => {
                let topic = message.topic.name.clone();
                self.report(0, 0, DamageKind::Message { topic, reason: error.to_string() });
                None
            }
        }
    }
}

impl Iterator for Bag {
    type Item = BagMessage;

    fn next(&mut self) -> Option<BagMessage> {
        loop {
            self.read_ahead();
            let Reverse(Pending { message, .. }) = self.pending.pop()?;
            if !self.messages_are_compressed {
                return Some(message);
            }
            if let Some(message) = self.unpack(message) {
                return Some(message);
            }
        }
    }
}
