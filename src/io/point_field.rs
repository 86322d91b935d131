//! One number of a point in a PointCloud2: where it is and how it is written.

/// The number types of a point field, with their ROS codes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Datatype {
    I8,
    U8,
    I16,
    U16,
    I32,
    U32,
    F32,
    F64,
}

impl Datatype {
    pub fn from_code(code: u8) -> Option<Self> {
        use Datatype::{F32, F64, I8, I16, I32, U8, U16, U32};
        [I8, U8, I16, U16, I32, U32, F32, F64].get(usize::from(code).wrapping_sub(1)).copied()
    }

    pub fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// Where in a point a number is, and how it is written.
pub(super) struct FieldReader {
    pub offset: usize,
    pub datatype: Datatype,
    pub big_endian: bool,
}

impl FieldReader {
    /// The field's first element; every type is exact as f64. NaN if the field reaches beyond the
    /// point.
    pub fn value(&self, point: &[u8]) -> f64 {
        match self.datatype {
            Datatype::I8 => self.bytes(point).map(|b| f64::from(i8::from_le_bytes(b))),
            Datatype::U8 => self.bytes(point).map(|b| f64::from(u8::from_le_bytes(b))),
            Datatype::I16 => self.bytes(point).map(|b| f64::from(i16::from_le_bytes(b))),
            Datatype::U16 => self.bytes(point).map(|b| f64::from(u16::from_le_bytes(b))),
            Datatype::I32 => self.bytes(point).map(|b| f64::from(i32::from_le_bytes(b))),
            Datatype::U32 => self.bytes(point).map(|b| f64::from(u32::from_le_bytes(b))),
            Datatype::F32 => self.bytes(point).map(|b| f64::from(f32::from_le_bytes(b))),
            Datatype::F64 => self.bytes(point).map(f64::from_le_bytes),
        }
        .unwrap_or(f64::NAN)
    }

    /// The number's bytes, least significant first.
    fn bytes<const N: usize>(&self, point: &[u8]) -> Option<[u8; N]> {
        let mut bytes: [u8; N] = point.get(self.offset..)?.first_chunk().copied()?;
        if self.big_endian {
            bytes.reverse();
        }
        Some(bytes)
    }
}
