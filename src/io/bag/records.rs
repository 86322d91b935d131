//! The MCAP format: records, chunks, and the fields within them; bytes in, values or damage out.
//!
//! <https://mcap.dev/spec>: a record is an opcode, a 64-bit length and that many bytes; all
//! integers are little endian. Lengths are checked against what is there before they are used.

use std::io::{self, Read};

use thiserror::Error;

/// The first and the last bytes of a file.
pub(super) const MAGIC: [u8; 8] = [0x89, b'M', b'C', b'A', b'P', 0x30, b'\r', b'\n'];
/// Bytes of a record before its body.
pub(super) const PREFIX: usize = 9;
/// A chunk above this \[bytes\] is taken for a corrupt length: writers use .8 to 16 MB.
pub(super) const MAX_CHUNK: u64 = 1 << 30;

/// Opcodes that matter here.
pub(super) mod op {
    pub const FOOTER: u8 = 0x02;
    pub const SCHEMA: u8 = 0x03;
    pub const CHANNEL: u8 = 0x04;
    pub const MESSAGE: u8 = 0x05;
    pub const CHUNK: u8 = 0x06;
    pub const CHUNK_INDEX: u8 = 0x08;
    pub const STATISTICS: u8 = 0x0B;
    pub const DATA_END: u8 = 0x0F;
    /// The highest opcode that the format defines.
    pub const LAST: u8 = DATA_END;
    /// Opcodes from here are private extensions.
    pub const PRIVATE: u8 = 0x80;
}

/// What was found wrong in a bag, at one place.
#[derive(Debug, Error)]
pub enum DamageKind {
    /// The file ends inside a record, or before its footer.
    #[error("the file ends here, in the middle of the recording")]
    Truncated,
    /// No record begins here.
    #[error("no record begins here: opcode {opcode:#04x}, length {length}")]
    LostRecords {
        /// As found.
        opcode: u8,
        /// As found.
        length: u64,
    },
    /// A record's fields exceed its length.
    #[error("the fields of a record with opcode {opcode:#04x} exceed its length")]
    BadRecord {
        /// The record's.
        opcode: u8,
    },
    /// The checksum of a chunk is wrong; none of it is used.
    #[error("chunk CRC {calculated:08x}, expected {saved:08x}: chunk left out")]
    ChunkCrc {
        /// In the file.
        saved: u32,
        /// Of the bytes there.
        calculated: u32,
    },
    /// A chunk does not decompress; none of it is used.
    #[error("{compression} chunk does not decompress: {reason}: chunk left out")]
    Decompression {
        /// zstd or lz4.
        compression: String,
        /// The decoder's words.
        reason: String,
    },
    /// A chunk is longer or shorter than it says.
    #[error("chunk of {found} bytes, expected {expected}: chunk left out")]
    ChunkLength {
        /// As found.
        found: u64,
        /// As declared, or the largest that is accepted.
        expected: u64,
    },
    /// A compression other than none, lz4 and zstd.
    #[error("chunk compression `{0}` is not supported: chunk left out")]
    UnknownCompression(String),
    /// A message of a channel that is nowhere declared.
    #[error("messages of channel {0}, which is nowhere declared")]
    UnknownChannel(u16),
    /// Messages that are no CDR.
    #[error("topic {topic}: messages encoded as `{encoding}`, expected cdr")]
    Encoding {
        /// The topic.
        topic: String,
        /// As declared.
        encoding: String,
    },
    /// A message that was compressed on its own does not decompress.
    #[error("topic {topic}: message does not decompress: {reason}")]
    Message {
        /// The topic.
        topic: String,
        /// The decoder's words.
        reason: String,
    },
    /// The disk would not give it.
    #[error("cannot be read: {0}")]
    Io(#[from] io::Error),
}

impl DamageKind {
    /// A short name for counting.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::Truncated => "truncated",
            Self::LostRecords { .. } => "lost_records",
            Self::BadRecord { .. } => "bad_record",
            Self::ChunkCrc { .. } => "chunk_crc",
            Self::Decompression { .. } => "chunk_decompression",
            Self::ChunkLength { .. } => "chunk_length",
            Self::UnknownCompression(_) => "unknown_compression",
            Self::UnknownChannel(_) => "unknown_channel",
            Self::Encoding { .. } => "not_cdr",
            Self::Message { .. } => "message_decompression",
            Self::Io(_) => "io",
        }
    }
}

/// Reads fields one after the other; `None` once there are too few bytes.
pub(super) struct Fields<'a>(pub &'a [u8]);

impl<'a> Fields<'a> {
    pub fn bytes(&mut self, count: usize) -> Option<&'a [u8]> {
        let (head, tail) = self.0.split_at_checked(count)?;
        self.0 = tail;
        Some(head)
    }

    fn array<const N: usize>(&mut self) -> Option<[u8; N]> {
        let (head, tail) = self.0.split_first_chunk()?;
        self.0 = tail;
        Some(*head)
    }

    pub fn u16(&mut self) -> Option<u16> {
        self.array().map(u16::from_le_bytes)
    }

    pub fn u32(&mut self) -> Option<u32> {
        self.array().map(u32::from_le_bytes)
    }

    pub fn u64(&mut self) -> Option<u64> {
        self.array().map(u64::from_le_bytes)
    }

    pub fn string(&mut self) -> Option<&'a str> {
        let length = self.u32()?;
        std::str::from_utf8(self.bytes(length as usize)?).ok()
    }
}

/// A record's opcode and length.
pub(super) fn prefix(bytes: &[u8; PREFIX]) -> (u8, u64) {
    let [opcode, length @ ..] = *bytes;
    (opcode, u64::from_le_bytes(length))
}

/// The records in a buffer, as (opcode, range of the body); the last one may be cut off, which is
/// then an error.
pub(super) struct Records<'a> {
    pub bytes: &'a [u8],
    pub position: usize,
}

impl Iterator for Records<'_> {
    type Item = Result<(u8, std::ops::Range<usize>), DamageKind>;

    fn next(&mut self) -> Option<Self::Item> {
        let rest = self.bytes.get(self.position..).filter(|rest| !rest.is_empty())?;
        let begin = self.position + PREFIX;
        self.position = self.bytes.len();
        let (opcode, length) = match rest.first_chunk() {
            Some(bytes) => prefix(bytes),
            None => return Some(Err(DamageKind::Truncated)),
        };
        if length > (self.bytes.len() - begin) as u64 {
            return Some(Err(DamageKind::LostRecords { opcode, length }));
        }
        self.position = begin + length as usize;
        Some(Ok((opcode, begin..self.position)))
    }
}

/// A schema record: id and name (the message type).
pub(super) fn schema(body: &[u8]) -> Option<(u16, &str)> {
    let mut fields = Fields(body);
    Some((fields.u16()?, fields.string()?))
}

/// A channel record.
pub(super) struct ChannelRecord<'a> {
    pub id: u16,
    pub schema: u16,
    pub topic: &'a str,
    pub encoding: &'a str,
}

pub(super) fn channel(body: &[u8]) -> Option<ChannelRecord<'_>> {
    let mut fields = Fields(body);
    Some(ChannelRecord {
        id: fields.u16()?,
        schema: fields.u16()?,
        topic: fields.string()?,
        encoding: fields.string()?,
    })
}

/// Bytes of a message record before its data.
pub(super) const MESSAGE_HEADER: usize = 22;

/// A message record: channel and log time \[ns\]. Its data follows [`MESSAGE_HEADER`].
pub(super) fn message_header(body: &[u8]) -> Option<(u16, u64)> {
    let mut fields = Fields(body.get(..MESSAGE_HEADER)?);
    let channel = fields.u16()?;
    fields.u32()?;
    Some((channel, fields.u64()?))
}

/// The records in a chunk, decompressed and checked. `is_cut`: the file ends within this chunk, so
/// that what can still be decompressed is used, without its checksum.
pub(super) fn unpack_chunk(body: &[u8], is_cut: bool) -> Result<Vec<u8>, DamageKind> {
    let bad_record = || DamageKind::BadRecord { opcode: op::CHUNK };
    let mut fields = Fields(body);
    let mut header = || {
        fields.bytes(16)?;
        Some((fields.u64()?, fields.u32()?, fields.string()?, fields.u64()?))
    };
    let (expected, saved, compression, length) = header().ok_or_else(bad_record)?;
    let packed = match fields.0.get(..usize::try_from(length).unwrap_or(usize::MAX)) {
        Some(packed) => packed,
        None if is_cut => fields.0,
        None => return Err(bad_record()),
    };
    if expected > MAX_CHUNK {
        return Err(DamageKind::ChunkLength { found: expected, expected: MAX_CHUNK });
    }
    let mut unpacked = Vec::new();
    let outcome = match compression {
        "" => read_limited(packed, expected, &mut unpacked),
        "zstd" => zstd::stream::read::Decoder::with_buffer(packed)
            .and_then(|decoder| read_limited(decoder, expected, &mut unpacked)),
        "lz4" => read_limited(lz4_flex::frame::FrameDecoder::new(packed), expected, &mut unpacked),
        other => return Err(DamageKind::UnknownCompression(other.to_owned())),
    };
    if is_cut {
        return Ok(unpacked);
    }
    outcome
        .map_err(|error| DamageKind::Decompression { compression: compression.into(), reason: error.to_string() })?;
    let found = unpacked.len() as u64;
    if found != expected {
        return Err(DamageKind::ChunkLength { found, expected });
    }
    // Zero means that the writer calculated none.
    let calculated = if saved == 0 { 0 } else { crc32fast::hash(&unpacked) };
    if calculated != saved {
        return Err(DamageKind::ChunkCrc { saved, calculated });
    }
    Ok(unpacked)
}

/// Reads to the end, but at most a byte more than expected, however much would come out.
pub(super) fn read_limited(source: impl Read, expected: u64, into: &mut Vec<u8>) -> io::Result<()> {
    source.take(expected.saturating_add(1)).read_to_end(into).map(|_| ())
}
