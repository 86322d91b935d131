//! PointCloud2 of any layout → labelled points in the sensor's frame.
//!
//! sensor_msgs/PointCloud2 (jazzy): point (row, column) starts at byte `row * row_step + column *
//! point_step` of `data`; a field at its `offset` from there, in the cloud's own byte order.

use nalgebra::Vector3;
use thiserror::Error;

use super::messages::{PointCloud2, PointField};
use crate::types::Label;

/// Coordinates beyond this \[m\] are no measurement but garbage bytes; squares of smaller ones
/// stay far from overflow and keep a nanometre of resolution.
const MAX_COORDINATE_M: f64 = 1e6;

/// A point as the sensor gave it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct SensorPoint {
    /// Position in the sensor's frame \[m\].
    pub point_in_sensor: Vector3<f64>,
    /// The part.
    pub label: Label,
}

/// How many points were left out, by reason.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct DroppedPoints {
    /// NaN or infinite coordinates: what a depth camera sends where it saw nothing.
    pub not_finite: u64,
    /// A coordinate beyond 10⁶ m.
    pub out_of_range: u64,
    /// A label that is negative, fractional, not finite or above 2³² − 1.
    pub bad_label: u64,
    /// A label that configuration says to ignore.
    pub ignored_label: u64,
}

/// Why a cloud cannot be used at all.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum PointCloudError {
    /// A field that must be there is not.
    #[error("no field `{field}` (fields: {present})")]
    MissingField {
        /// The field.
        field: String,
        /// The fields there are.
        present: String,
    },
    /// A coordinate that is not float32 or float64, an unknown datatype, or no element.
    #[error("field `{field}` has datatype {datatype} and count {count}, expected {expected}")]
    FieldType {
        /// The field.
        field: String,
        /// As sent.
        datatype: u8,
        /// As sent.
        count: u32,
        /// What is accepted.
        expected: &'static str,
    },
    /// No points.
    #[error("no points: height {height}, width {width}")]
    Empty {
        /// Rows.
        height: u32,
        /// Points in a row.
        width: u32,
    },
    /// A field reaches beyond the point (so too if point_step is 0).
    #[error("point_step is {point_step} bytes, field `{field}` ends at byte {end}")]
    PointStep {
        /// As sent.
        point_step: u32,
        /// The first field that does not fit.
        field: String,
        /// Where it ends.
        end: u64,
    },
    /// Rows overlap.
    #[error("row_step is {row_step} bytes, {width} points of {point_step} bytes need {need}")]
    RowStep {
        /// As sent.
        row_step: u32,
        /// Points in a row.
        width: u32,
        /// Bytes of a point.
        point_step: u32,
        /// Least possible row_step.
        need: u64,
    },
    /// Fewer bytes than the header says.
    #[error("{length} bytes of data, {height} rows of {row_step} bytes need {need}")]
    DataLength {
        /// Bytes given.
        length: usize,
        /// Rows.
        height: u32,
        /// Bytes of a row.
        row_step: u32,
        /// Bytes needed.
        need: u64,
    },
    /// Every point was left out.
    #[error("no usable point of {total}: {} not finite, {} out of range, {} with a bad label, {} ignored", dropped.not_finite, dropped.out_of_range, dropped.bad_label, dropped.ignored_label)]
    NoUsablePoint {
        /// Points in the cloud.
        total: u64,
        /// Why each was left out.
        dropped: DroppedPoints,
    },
}

impl PointCloudError {
    /// A short name for counting.
    pub fn kind(&self) -> &'static str {
        match self {
            Self::MissingField { field, .. } if matches!(field.as_str(), "x" | "y" | "z") => {
                "no_coordinate_field"
            }
            Self::MissingField { .. } => "no_label_field",
            Self::FieldType { .. } => "bad_field_type",
            Self::Empty { .. } => "empty",
            Self::PointStep { .. } => "bad_point_step",
            Self::RowStep { .. } => "bad_row_step",
            Self::DataLength { .. } => "short_data",
            Self::NoUsablePoint { .. } => "no_usable_point",
        }
    }
}

/// The labelled points of a cloud, row by row, and how many were left out.
///
/// `label_field` names the field with the part's label, of any integer or float type; points whose
/// label is in `ignored` are left out.
///
/// # Errors
/// Each way in which the layout and the bytes can disagree, and a cloud without a usable point.
pub fn read_points(
    cloud: &PointCloud2,
    label_field: &str,
    ignored: &[Label],
) -> Result<(Vec<SensorPoint>, DroppedPoints), PointCloudError> {
    if cloud.height == 0 || cloud.width == 0 {
        return Err(PointCloudError::Empty {
            height: cloud.height,
            width: cloud.width,
        });
    }
    let x = coordinate_field(cloud, "x")?;
    let y = coordinate_field(cloud, "y")?;
    let z = coordinate_field(cloud, "z")?;
    let label = find_field(cloud, label_field)?;
    check_steps(cloud)?;

    let mut dropped = DroppedPoints::default();
    let mut points = Vec::with_capacity(cloud.height as usize * cloud.width as usize);
    let rows = cloud
        .data
        .chunks_exact(cloud.row_step as usize)
        .take(cloud.height as usize);
    for bytes in rows.flat_map(|row| {
        row.chunks_exact(cloud.point_step as usize)
            .take(cloud.width as usize)
    }) {
        let point_in_sensor = Vector3::new(x.value(bytes), y.value(bytes), z.value(bytes));
        if !point_in_sensor
            .iter()
            .all(|coordinate| coordinate.is_finite())
        {
            dropped.not_finite += 1;
        } else if point_in_sensor.amax() > MAX_COORDINATE_M {
            dropped.out_of_range += 1;
        } else {
            match as_label(label.value(bytes)) {
                None => dropped.bad_label += 1,
                Some(label) if ignored.contains(&label) => dropped.ignored_label += 1,
                Some(label) => points.push(SensorPoint {
                    point_in_sensor,
                    label,
                }),
            }
        }
    }
    if points.is_empty() {
        let total = u64::from(cloud.height) * u64::from(cloud.width);
        return Err(PointCloudError::NoUsablePoint { total, dropped });
    }
    Ok((points, dropped))
}

/// The number types of a point field, with their ROS codes.
#[derive(Clone, Copy)]
enum Datatype {
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
    fn from_code(code: u8) -> Option<Self> {
        use Datatype::{F32, F64, I8, I16, I32, U8, U16, U32};
        [I8, U8, I16, U16, I32, U32, F32, F64]
            .get(usize::from(code).wrapping_sub(1))
            .copied()
    }

    fn size(self) -> usize {
        match self {
            Self::I8 | Self::U8 => 1,
            Self::I16 | Self::U16 => 2,
            Self::I32 | Self::U32 | Self::F32 => 4,
            Self::F64 => 8,
        }
    }
}

/// Where in a point a number is, and how it is written.
struct FieldReader {
    offset: usize,
    datatype: Datatype,
    big_endian: bool,
}

impl FieldReader {
    /// The field's first element; every type of up to 32 bits is exact as f64. The field lies
    /// within the point, which `check_steps` has seen to; were it not so, NaN.
    fn value(&self, point: &[u8]) -> f64 {
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

fn find_field(cloud: &PointCloud2, name: &str) -> Result<FieldReader, PointCloudError> {
    let Some(field) = cloud.fields.iter().find(|field| field.name == name) else {
        let names: Vec<&str> = cloud
            .fields
            .iter()
            .map(|field| field.name.as_str())
            .collect();
        return Err(PointCloudError::MissingField {
            field: name.to_owned(),
            present: names.join(", "),
        });
    };
    let Some(datatype) = Datatype::from_code(field.datatype).filter(|_| field.count > 0) else {
        return Err(field_type_error(
            field,
            "a datatype of 1 to 8 and at least one element",
        ));
    };
    let end = u64::from(field.offset) + datatype.size() as u64;
    if end > u64::from(cloud.point_step) {
        return Err(PointCloudError::PointStep {
            point_step: cloud.point_step,
            field: name.to_owned(),
            end,
        });
    }
    Ok(FieldReader {
        offset: field.offset as usize,
        datatype,
        big_endian: cloud.is_bigendian,
    })
}

fn coordinate_field(cloud: &PointCloud2, name: &str) -> Result<FieldReader, PointCloudError> {
    let reader = find_field(cloud, name)?;
    match (
        reader.datatype,
        cloud.fields.iter().find(|field| field.name == name),
    ) {
        (Datatype::F32 | Datatype::F64, _) | (_, None) => Ok(reader),
        (_, Some(field)) => Err(field_type_error(field, "float32 (7) or float64 (8)")),
    }
}

fn field_type_error(field: &PointField, expected: &'static str) -> PointCloudError {
    let (datatype, count) = (field.datatype, field.count);
    PointCloudError::FieldType {
        field: field.name.clone(),
        datatype,
        count,
        expected,
    }
}

/// After this, rows and points can be sliced: both steps are positive and all bytes are there.
fn check_steps(cloud: &PointCloud2) -> Result<(), PointCloudError> {
    let need = u64::from(cloud.width) * u64::from(cloud.point_step);
    let (row_step, point_step) = (cloud.row_step, cloud.point_step);
    if u64::from(row_step) < need {
        return Err(PointCloudError::RowStep {
            row_step,
            width: cloud.width,
            point_step,
            need,
        });
    }
    let need = u64::from(cloud.height) * u64::from(row_step);
    if (cloud.data.len() as u64) < need {
        return Err(PointCloudError::DataLength {
            length: cloud.data.len(),
            height: cloud.height,
            row_step,
            need,
        });
    }
    Ok(())
}

fn as_label(value: f64) -> Option<Label> {
    (value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value))
        .then_some(Label(value as u32))
}
