//! One pass over a file's record headers: where its messages are and which topics it has.
//!
//! Chunks are passed over, not read, so that even a large file takes a moment. The summary at the
//! end of the file gives topics and counts; without one (a truncated file) the chunks are opened.
//! Where the row of records breaks, the summary's chunk index says where it goes on.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::File,
    io::{self, BufReader, Read, Seek, SeekFrom},
    sync::Arc,
};

use super::{
    TopicInfo,
    records::{self, DamageKind, Fields, MAGIC, MAX_CHUNK, MESSAGE_HEADER, PREFIX, Records, op},
};

/// Messages outside of chunks are gathered into segments of about this many bytes, the usual size
/// of a chunk.
const LOOSE_SEGMENT: u64 = 1 << 20;

/// A stretch of a file that holds messages.
#[derive(Clone, Copy, Debug)]
pub(super) struct Segment {
    pub kind: SegmentKind,
    /// Where it begins, and its bytes.
    pub offset: u64,
    pub length: u64,
    /// Log time of the first message \[ns\], as the file says.
    pub start: u64,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum SegmentKind {
    /// The body of a chunk record.
    Chunk,
    /// As `Chunk`, cut off by the end of the file.
    CutChunk,
    /// A run of whole records.
    Loose,
}

/// The channels declared so far in a file, by id.
#[derive(Clone, Debug, Default)]
pub(super) struct Channels {
    schemas: BTreeMap<u16, String>,
    pub by_id: BTreeMap<u16, Arc<TopicInfo>>,
}

impl Channels {
    /// Takes in a schema or channel record; an id keeps its first meaning.
    pub fn declare(&mut self, opcode: u8, body: &[u8]) -> Result<(), DamageKind> {
        let bad_record = || DamageKind::BadRecord { opcode };
        if opcode == op::SCHEMA {
            let (id, name) = records::schema(body).ok_or_else(bad_record)?;
            self.schemas.entry(id).or_insert_with(|| name.to_owned());
        } else if opcode == op::CHANNEL {
            let record = records::channel(body).ok_or_else(bad_record)?;
            let type_name = self.schemas.get(&record.schema).cloned().unwrap_or_default();
            self.by_id.entry(record.id).or_insert_with(|| {
                Arc::new(TopicInfo { name: record.topic.into(), type_name, encoding: record.encoding.into() })
            });
        }
        Ok(())
    }
}

/// What one file holds.
#[derive(Debug, Default)]
pub(super) struct FileMap {
    pub segments: Vec<Segment>,
    pub channels: Channels,
    /// Messages by channel.
    pub counts: BTreeMap<u16, u64>,
    /// Where the row of records is broken.
    pub damage: Vec<(u64, DamageKind)>,
}

/// Maps a file; `None` if it does not begin as MCAP does.
pub(super) fn map_file(file: &File) -> io::Result<Option<FileMap>> {
    let length = file.metadata()?.len();
    let mut reader = BufReader::new(file);
    reader.seek(SeekFrom::Start(0))?;
    let mut magic = [0; MAGIC.len()];
    if length < MAGIC.len() as u64 || {
        reader.read_exact(&mut magic)?;
        magic != MAGIC
    } {
        return Ok(None);
    }
    let summary = read_summary(&mut reader, length);
    let has_end = summary.is_some();
    let summary = summary.unwrap_or_default();
    let mut map = FileMap { channels: summary.channels, counts: summary.counts, ..FileMap::default() };
    let is_whole = walk(&mut reader, length, has_end, &mut map)?;
    add_indexed_chunks(&mut map.segments, &summary.chunks, length, is_whole);
    if map.counts.is_empty() {
        count_messages(file, &mut map)?;
    }
    Ok(Some(map))
}

/// Adds the chunks that the summary knows of and the walk did not find, as a broken record hides
/// those after it. Where the walk broke off, its last find may be what was broken.
fn add_indexed_chunks(segments: &mut Vec<Segment>, chunks: &[Segment], length: u64, is_whole: bool) {
    let fits = |chunk: &&Segment| chunk.offset.checked_add(chunk.length).is_some_and(|end| end <= length);
    if !is_whole {
        let last_is_indexed = |last: &mut Segment| {
            last.kind != SegmentKind::Loose && chunks.iter().filter(fits).any(|chunk| chunk.offset == last.offset)
        };
        segments.pop_if(last_is_indexed);
    }
    let found: BTreeSet<u64> = segments.iter().map(|segment| segment.offset).collect();
    segments.extend(chunks.iter().filter(fits).filter(|chunk| !found.contains(&chunk.offset)));
}

/// Reads a segment's bytes, decompressed: a row of records.
pub(super) fn read_segment(file: &mut File, segment: &Segment) -> Result<Vec<u8>, DamageKind> {
    if segment.length > MAX_CHUNK {
        return Err(DamageKind::ChunkLength { found: segment.length, expected: MAX_CHUNK });
    }
    file.seek(SeekFrom::Start(segment.offset))?;
    let mut bytes = vec![0; segment.length as usize];
    file.read_exact(&mut bytes)?;
    match segment.kind {
        SegmentKind::Loose => Ok(bytes),
        SegmentKind::Chunk => records::unpack_chunk(&bytes, false),
        SegmentKind::CutChunk => records::unpack_chunk(&bytes, true),
    }
}

/// Goes from record to record up to the end of the data section. `false` if the row of records
/// breaks before, which is then in `map.damage`. `has_end`: the file has its footer, so that a
/// record beyond the end is a wrong length, not a truncated file.
fn walk(reader: &mut BufReader<&File>, length: u64, has_end: bool, map: &mut FileMap) -> io::Result<bool> {
    let mut position = MAGIC.len() as u64;
    let mut extends_loose = false;
    reader.seek(SeekFrom::Start(position))?;
    loop {
        let mut bytes = [0; PREFIX];
        if length - position < PREFIX as u64 {
            map.damage.push((position, DamageKind::Truncated));
            return Ok(false);
        }
        reader.read_exact(&mut bytes)?;
        let (opcode, body_length) = records::prefix(&bytes);
        if matches!(opcode, op::DATA_END | op::FOOTER) {
            return Ok(true);
        }
        let begin = position + PREFIX as u64;
        let available = length - begin;
        let is_cut = body_length > available;
        let is_record = opcode != 0 && (opcode <= op::LAST || opcode >= op::PRIVATE);
        if is_cut || !is_record {
            let kind = match is_record && !has_end {
                true => DamageKind::Truncated,
                false => DamageKind::LostRecords { opcode, length: body_length },
            };
            map.damage.push((position, kind));
            if opcode != op::CHUNK {
                return Ok(false);
            }
        }
        let head_length = body_length.min(available);
        let read = match opcode {
            op::SCHEMA | op::CHANNEL if head_length <= MAX_CHUNK => head_length,
            op::MESSAGE => head_length.min(MESSAGE_HEADER as u64),
            op::CHUNK => head_length.min(8),
            _ => 0,
        };
        let mut head = vec![0; read as usize];
        reader.read_exact(&mut head)?;
        let is_loose_message = opcode == op::MESSAGE;
        match opcode {
            op::SCHEMA | op::CHANNEL => {
                if let Err(kind) = map.channels.declare(opcode, &head) {
                    map.damage.push((position, kind));
                }
            }
            op::MESSAGE => match (records::message_header(&head), map.segments.last_mut()) {
                (Some(_), Some(segment)) if extends_loose && segment.length < LOOSE_SEGMENT => {
                    segment.length += PREFIX as u64 + body_length;
                }
                (Some((_, start)), _) => {
                    let length = PREFIX as u64 + body_length;
                    map.segments.push(Segment { kind: SegmentKind::Loose, offset: position, length, start });
                }
                (None, _) => map.damage.push((position, DamageKind::BadRecord { opcode })),
            },
            op::CHUNK => {
                let kind = if is_cut { SegmentKind::CutChunk } else { SegmentKind::Chunk };
                if let Some(start) = Fields(&head).u64() {
                    map.segments.push(Segment { kind, offset: begin, length: head_length, start });
                }
                if is_cut {
                    return Ok(false);
                }
            }
            _ => {}
        }
        extends_loose = is_loose_message;
        position = begin + body_length;
        reader.seek_relative((body_length - read) as i64)?;
    }
}

#[derive(Default)]
struct Summary {
    channels: Channels,
    counts: BTreeMap<u16, u64>,
    /// The chunk index.
    chunks: Vec<Segment>,
}

/// The summary section, if the file ends as it should and the section is consistent.
fn read_summary(reader: &mut BufReader<&File>, length: u64) -> Option<Summary> {
    /// Bytes of the footer record and the closing magic.
    const TAIL: usize = PREFIX + 20 + MAGIC.len();
    let tail_start = length.checked_sub(TAIL as u64)?;
    reader.seek(SeekFrom::Start(tail_start)).ok()?;
    let mut tail = [0; TAIL];
    reader.read_exact(&mut tail).ok()?;
    let mut fields = Fields(&tail);
    let (opcode, _) = records::prefix(fields.bytes(PREFIX)?.first_chunk()?);
    let summary_start = fields.u64()?;
    if opcode != op::FOOTER || tail[TAIL - MAGIC.len()..] != MAGIC || summary_start == 0 {
        return None;
    }
    let section_length = tail_start.checked_sub(summary_start).filter(|length| *length <= MAX_CHUNK)?;
    reader.seek(SeekFrom::Start(summary_start)).ok()?;
    let mut section = vec![0; section_length as usize];
    reader.read_exact(&mut section).ok()?;

    let mut summary = Summary::default();
    for record in (Records { bytes: &section, position: 0 }) {
        let (opcode, range) = record.ok()?;
        let body = section.get(range)?;
        match opcode {
            op::SCHEMA | op::CHANNEL => summary.channels.declare(opcode, body).ok()?,
            op::CHUNK_INDEX => {
                let mut fields = Fields(body);
                let (start, _end) = (fields.u64()?, fields.u64()?);
                let offset = fields.u64()?.checked_add(PREFIX as u64)?;
                let length = fields.u64()?.checked_sub(PREFIX as u64)?;
                summary.chunks.push(Segment { kind: SegmentKind::Chunk, offset, length, start });
            }
            op::STATISTICS => {
                let mut fields = Fields(body);
                // Message, schema, channel, attachment, metadata and chunk counts, start and end.
                fields.bytes(8 + 2 + 4 + 4 + 4 + 4 + 8 + 8)?;
                let mut counts = Fields(fields.bytes(4).map(|_| fields.0)?);
                while let (Some(channel), Some(count)) = (counts.u16(), counts.u64()) {
                    summary.counts.insert(channel, count);
                }
            }
            _ => {}
        }
    }
    Some(summary)
}

/// Opens every segment to find channels and count messages. Damage is left for the reading proper
/// to report.
fn count_messages(file: &File, map: &mut FileMap) -> io::Result<()> {
    let mut file = file.try_clone()?;
    for segment in &map.segments {
        let Ok(bytes) = read_segment(&mut file, segment) else {
            continue;
        };
        for (opcode, range) in (Records { bytes: &bytes, position: 0 }).flatten() {
            let body = &bytes[range];
            if opcode == op::MESSAGE {
                if let Some((channel, _)) = records::message_header(body) {
                    *map.counts.entry(channel).or_default() += 1;
                }
            } else {
                // A bad declaration is reported when the segment is read.
                let _ = map.channels.declare(opcode, body);
            }
        }
    }
    Ok(())
}
