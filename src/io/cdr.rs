//! CDR, the bytes of a ROS 2 message: a 4-byte encapsulation header, then the plain encoding.
//!
//! OMG DDS-XTypes 1.3, 7.6.2 and table 61: `00 00` big endian, `00 01` little endian, two bytes
//! of options. The alignment of the body counts from after the header.

use byteorder::{BigEndian, ByteOrder, LittleEndian};
use cdr_encoding::CdrDeserializer;
use serde::{Deserialize, Serialize};
use thiserror::Error;

/// Bytes of the encapsulation header.
const HEADER_LENGTH: usize = 4;

/// The byte order of a message's body.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Endianness {
    /// Most significant byte first.
    Big,
    /// Least significant byte first; what every common machine writes.
    Little,
}

/// Why a message could not be decoded or encoded.
#[derive(Debug, Error)]
pub enum CdrError {
    /// Not even a header.
    #[error("{length} bytes, need at least the {HEADER_LENGTH} of the CDR header")]
    TooShort {
        /// Bytes given.
        length: usize,
    },
    /// Parameter lists, XCDR2, or no CDR at all.
    #[error("encapsulation {0:02x} {1:02x}, expected plain CDR: 00 00 or 00 01")]
    Encapsulation(u8, u8),
    /// The body is not what the message type says.
    #[error("byte {offset} of {length}: {source}")]
    Body {
        /// Where decoding stopped, from the start of the message.
        offset: usize,
        /// Bytes given.
        length: usize,
        /// What was wrong there.
        source: cdr_encoding::Error,
    },
    /// The value cannot be encoded.
    #[error("cannot encode: {0}")]
    Encode(cdr_encoding::Error),
}

/// Decodes a message, header and body. Bytes after the message are ignored, as padding is legal.
///
/// # Errors
/// A short, foreign or inconsistent message, with the byte where decoding stopped.
pub fn decode<'de, T: Deserialize<'de>>(message: &'de [u8]) -> Result<T, CdrError> {
    let Some((header, body)) = message.split_first_chunk::<HEADER_LENGTH>() else {
        return Err(CdrError::TooShort { length: message.len() });
    };
    match [header[0], header[1]] {
        [0, 0] => decode_body::<T, BigEndian>(body),
        [0, 1] => decode_body::<T, LittleEndian>(body),
        [first, second] => Err(CdrError::Encapsulation(first, second)),
    }
}

/// Encodes a message, header and body.
///
/// # Errors
/// Only for types that CDR cannot hold.
pub fn encode<T: Serialize>(value: &T, endianness: Endianness) -> Result<Vec<u8>, CdrError> {
    let mut message = vec![0, u8::from(endianness == Endianness::Little), 0, 0];
    let body = match endianness {
        Endianness::Big => cdr_encoding::to_vec::<T, BigEndian>(value),
        Endianness::Little => cdr_encoding::to_vec::<T, LittleEndian>(value),
    };
    message.extend(body.map_err(CdrError::Encode)?);
    Ok(message)
}

fn decode_body<'de, T: Deserialize<'de>, BO: ByteOrder>(body: &'de [u8]) -> Result<T, CdrError> {
    let mut deserializer = CdrDeserializer::<BO>::new(body);
    T::deserialize(&mut deserializer).map_err(|source| CdrError::Body {
        offset: HEADER_LENGTH + deserializer.bytes_consumed(),
        length: HEADER_LENGTH + body.len(),
        source,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn header_decides_the_byte_order() {
        let big: u32 = decode(&[0, 0, 0, 0, 0, 0, 1, 2]).unwrap();
        let little: u32 = decode(&[0, 1, 0, 0, 2, 1, 0, 0]).unwrap();
        assert_eq!((big, little), (258, 258));
    }

    #[test]
    fn errors_say_what_and_where() {
        let error = |bytes: &[u8]| decode::<u32>(bytes).unwrap_err().to_string();
        assert_eq!(error(&[0, 1]), "2 bytes, need at least the 4 of the CDR header");
        assert_eq!(error(&[0, 3, 0, 0]), "encapsulation 00 03, expected plain CDR: 00 00 or 00 01");
        assert_eq!(error(&[0, 1, 0, 0, 7]), "byte 4 of 5: unexpected end of input");
    }
}
