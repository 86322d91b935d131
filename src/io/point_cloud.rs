//! PointCloud2 of any layout → labelled points in the sensor's frame.
//!
//! sensor_msgs/PointCloud2 (jazzy): point (row, column) starts at byte `row * row_step + column *
//! point_step` of `data`; a field at its `offset` from there, in the cloud's own byte order.

use nalgebra::Vector3;
use thiserror::Error;

use super::{
    messages::{PointCloud2, PointField},
    point_field::{Datatype, FieldReader},
};
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
            Self::MissingField { field, .. } if matches!(field.as_str(), "x" | "y" | "z") => "no_coordinate_field",
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
        return Err(PointCloudError::Empty { height: cloud.height, width: cloud.width });
    }
    let x = coordinate_field(cloud, "x")?;
    let y = coordinate_field(cloud, "y")?;
    let z = coordinate_field(cloud, "z")?;
    let (_, label) = find_field(cloud, label_field)?;
    check_steps(cloud)?;

    let mut dropped = DroppedPoints::default();
    let mut points = Vec::with_capacity(cloud.height as usize * cloud.width as usize);
    let rows = cloud.data.chunks_exact(cloud.row_step as usize).take(cloud.height as usize);
    for bytes in rows.flat_map(|row| row.chunks_exact(cloud.point_step as usize).take(cloud.width as usize)) {
        let point_in_sensor = Vector3::new(x.value(bytes), y.value(bytes), z.value(bytes));
        if !point_in_sensor.iter().all(|coordinate| coordinate.is_finite()) {
            dropped.not_finite += 1;
        } else if point_in_sensor.amax() > MAX_COORDINATE_M {
            dropped.out_of_range += 1;
        } else {
            match as_label(label.value(bytes)) {
                None => dropped.bad_label += 1,
                Some(label) if ignored.contains(&label) => dropped.ignored_label += 1,
                Some(label) => points.push(SensorPoint { point_in_sensor, label }),
            }
        }
    }
    if points.is_empty() {
        let total = u64::from(cloud.height) * u64::from(cloud.width);
        return Err(PointCloudError::NoUsablePoint { total, dropped });
    }
    Ok((points, dropped))
}

fn find_field<'a>(cloud: &'a PointCloud2, name: &str) -> Result<(&'a PointField, FieldReader), PointCloudError> {
    let Some(field) = cloud.fields.iter().find(|field| field.name == name) else {
        let names: Vec<&str> = cloud.fields.iter().map(|field| field.name.as_str()).collect();
        return Err(PointCloudError::MissingField { field: name.to_owned(), present: names.join(", ") });
    };
    let Some(datatype) = Datatype::from_code(field.datatype).filter(|_| field.count > 0) else {
        return Err(field_type_error(field, "a datatype of 1 to 8 and at least one element"));
    };
    let end = u64::from(field.offset) + datatype.size() as u64;
    if end > u64::from(cloud.point_step) {
        return Err(PointCloudError::PointStep { point_step: cloud.point_step, field: name.to_owned(), end });
    }
    let offset = field.offset as usize;
    let big_endian = cloud.is_bigendian;
    Ok((field, FieldReader { offset, datatype, big_endian }))
}

fn coordinate_field(cloud: &PointCloud2, name: &str) -> Result<FieldReader, PointCloudError> {
    let (field, reader) = find_field(cloud, name)?;
    match reader.datatype {
        Datatype::F32 | Datatype::F64 => Ok(reader),
        _ => Err(field_type_error(field, "float32 (7) or float64 (8)")),
    }
}

fn field_type_error(field: &PointField, expected: &'static str) -> PointCloudError {
    let (datatype, count) = (field.datatype, field.count);
    PointCloudError::FieldType { field: field.name.clone(), datatype, count, expected }
}

/// After this, rows and points can be sliced: both steps are positive and all bytes are there.
fn check_steps(cloud: &PointCloud2) -> Result<(), PointCloudError> {
    let need = u64::from(cloud.width) * u64::from(cloud.point_step);
    let (row_step, point_step) = (cloud.row_step, cloud.point_step);
    if u64::from(row_step) < need {
        return Err(PointCloudError::RowStep { row_step, width: cloud.width, point_step, need });
    }
    let need = u64::from(cloud.height) * u64::from(row_step);
    if (cloud.data.len() as u64) < need {
        return Err(PointCloudError::DataLength { length: cloud.data.len(), height: cloud.height, row_step, need });
    }
    Ok(())
}

fn as_label(value: f64) -> Option<Label> {
    (value.fract() == 0.0 && (0.0..=f64::from(u32::MAX)).contains(&value)).then_some(Label(value as u32))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::io::messages::Header;
    use proptest::prelude::*;

    /// A layout with x, y, z and label at random places of a point, of random types, in rows with
    /// padding.
    #[derive(Clone, Debug)]
    struct Layout {
        datatypes: [u8; 4],
        gaps: [u32; 5],
        order: [usize; 4],
        row_padding: u32,
        big_endian: bool,
    }

    fn layouts() -> impl Strategy<Value = Layout> {
        let coordinate = || 7..=8_u8;
        let datatypes = (coordinate(), coordinate(), coordinate(), 1..=8_u8);
        let gaps = prop::array::uniform5(0..9_u32);
        let order = Just([0, 1, 2, 3]).prop_shuffle();
        (datatypes, gaps, order, 0..40_u32, any::<bool>()).prop_map(
            |((x, y, z, label), gaps, order, row_padding, big_endian)| Layout {
                datatypes: [x, y, z, label],
                gaps,
                order,
                row_padding,
                big_endian,
            },
        )
    }

    fn write_number(into: &mut [u8], datatype: u8, value: f64, big_endian: bool) {
        let mut bytes = match datatype {
            1 => (value as i8).to_le_bytes().to_vec(),
            2 => (value as u8).to_le_bytes().to_vec(),
            3 => (value as i16).to_le_bytes().to_vec(),
            4 => (value as u16).to_le_bytes().to_vec(),
            5 => (value as i32).to_le_bytes().to_vec(),
            6 => (value as u32).to_le_bytes().to_vec(),
            7 => (value as f32).to_le_bytes().to_vec(),
            _ => value.to_le_bytes().to_vec(),
        };
        if big_endian {
            bytes.reverse();
        }
        into[..bytes.len()].copy_from_slice(&bytes);
    }

    /// Rows of [x, y, z, label], written as the layout says.
    fn cloud_of(rows: &[Vec<[f64; 4]>], layout: &Layout) -> PointCloud2<'static> {
        let sizes = [1, 1, 2, 2, 4, 4, 4, 8];
        let mut offsets = [0; 4];
        let mut end = 0;
        for (gap, field) in layout.gaps.iter().zip(layout.order) {
            offsets[field] = end + gap;
            end = offsets[field] + sizes[layout.datatypes[field] as usize - 1];
        }
        let (width, point_step) = (rows[0].len() as u32, end + layout.gaps[4]);
        let row_step = width * point_step + layout.row_padding;
        let mut data = vec![0xAA; row_step as usize * rows.len()];
        for (row_index, row) in rows.iter().enumerate() {
            for (column, point) in row.iter().enumerate() {
                let begin = row_index * row_step as usize + column * point_step as usize;
                for field in 0..4 {
                    let at = begin + offsets[field] as usize;
                    let datatype = layout.datatypes[field];
                    write_number(&mut data[at..], datatype, point[field], layout.big_endian);
                }
            }
        }
        let field = |index: usize| PointField {
            name: ["x", "y", "z", "part"][index].into(),
            offset: offsets[index],
            datatype: layout.datatypes[index],
            count: 1,
        };
        PointCloud2 {
            header: Header::default(),
            height: rows.len() as u32,
            width,
            fields: layout.order.iter().map(|index| field(*index)).collect(),
            is_bigendian: layout.big_endian,
            point_step,
            row_step,
            data: data.into(),
            is_dense: true,
        }
    }

    /// Packed float32 coordinates and a label of the given type.
    fn packed(label_datatype: u8) -> Layout {
        Layout {
            datatypes: [7, 7, 7, label_datatype],
            gaps: [0; 5],
            order: [0, 1, 2, 3],
            row_padding: 0,
            big_endian: false,
        }
    }

    fn points() -> impl Strategy<Value = Vec<Vec<[f64; 4]>>> {
        let coordinate = || (-1000..1000_i32).prop_map(|x| f64::from(x) / 64.0);
        let point = (coordinate(), coordinate(), coordinate(), 0..128_u8)
            .prop_map(|(x, y, z, label)| [x, y, z, f64::from(label)]);
        (1..5_usize, 1..8_usize).prop_flat_map(move |(height, width)| {
            prop::collection::vec(prop::collection::vec(point.clone(), width), height)
        })
    }

    proptest! {
        #[test]
        fn any_layout_gives_the_points_back(rows in points(), layout in layouts()) {
            let (found, dropped) = read_points(&cloud_of(&rows, &layout), "part", &[]).unwrap();
            let found: Vec<[f64; 4]> = found
                .iter()
                .map(|p| [p.point_in_sensor.x, p.point_in_sensor.y, p.point_in_sensor.z, p.label.0.into()])
                .collect();
            prop_assert_eq!(found, rows.concat());
            prop_assert_eq!(dropped, DroppedPoints::default());
        }

        #[test]
        fn nonsense_headers_never_panic(
            (height, width) in (0..6_u32, 0..6_u32),
            (point_step, row_step) in (prop_oneof![0..40_u32, any::<u32>()], prop_oneof![0..99_u32, any::<u32>()]),
            fields in prop::collection::vec(("[xyz]|part", prop_oneof![0..40_u32, any::<u32>()], any::<u8>(), 0..3_u32), 0..6),
            data in prop::collection::vec(any::<u8>(), 0..200),
            is_bigendian: bool,
        ) {
            let fields = fields
                .into_iter()
                .map(|(name, offset, datatype, count)| PointField { name, offset, datatype: datatype % 11, count })
                .collect();
            let cloud = PointCloud2 {
                header: Header::default(), height, width, fields, is_bigendian, point_step, row_step,
                data: data.into(), is_dense: true,
            };
            if let Ok((points, _)) = read_points(&cloud, "part", &[]) {
                prop_assert!(points.iter().all(|point| point.point_in_sensor.iter().all(|x| x.is_finite())));
            }
        }
    }

    #[test]
    fn unusable_points_are_counted_by_reason() {
        let rows = vec![vec![
            [f64::NAN, 0.0, 1.0, 1.0],
            [0.0, f64::INFINITY, 1.0, 1.0],
            [0.0, 0.0, 1e7, 1.0],
            [0.0, 0.0, 1.0, -1.0],
            [0.0, 0.0, 1.0, 1.5],
            [0.0, 0.0, 1.0, f64::NAN],
            [0.0, 0.0, 1.0, 5e9],
            [0.0, 0.0, 1.0, 9.0],
            [0.0, 0.0, 1.0, 4_294_967_295.0],
        ]];
        let cloud = cloud_of(&rows, &packed(8));
        let (points, dropped) = read_points(&cloud, "part", &[Label(9)]).unwrap();
        assert_eq!(points.iter().map(|point| point.label).collect::<Vec<_>>(), [Label(u32::MAX)]);
        let expected = DroppedPoints { not_finite: 2, out_of_range: 1, bad_label: 4, ignored_label: 1 };
        assert_eq!(dropped, expected);
    }

    #[test]
    fn each_broken_layout_has_its_own_line() {
        let cloud = || cloud_of(&[vec![[0.0, 0.0, 1.0, 1.0]; 2], vec![[f64::NAN; 4]; 2]], &packed(6));
        let message = |change: &dyn Fn(&mut PointCloud2)| {
            let mut cloud = cloud();
            change(&mut cloud);
            read_points(&cloud, "part", &[]).unwrap_err().to_string()
        };
        assert!(read_points(&cloud(), "part", &[]).is_ok());
        assert_eq!(message(&|c| c.fields[3].name = "id".into()), "no field `part` (fields: x, y, z, id)");
        assert_eq!(message(&|c| c.fields[1].name = "Y".into()), "no field `y` (fields: x, Y, z, part)");
        assert_eq!(message(&|c| c.width = 0), "no points: height 2, width 0");
        assert_eq!(message(&|c| c.point_step = 0), "point_step is 0 bytes, field `x` ends at byte 4");
        assert_eq!(message(&|c| c.point_step = 15), "point_step is 15 bytes, field `part` ends at byte 16");
        assert_eq!(
            message(&|c| c.fields[2].offset = u32::MAX),
            "point_step is 16 bytes, field `z` ends at byte 4294967299"
        );
        assert_eq!(message(&|c| c.row_step = 31), "row_step is 31 bytes, 2 points of 16 bytes need 32");
        assert_eq!(message(&|c| c.height = 3), "64 bytes of data, 3 rows of 32 bytes need 96");
        assert_eq!(
            message(&|c| c.fields[0].datatype = 5),
            "field `x` has datatype 5 and count 1, expected float32 (7) or float64 (8)"
        );
        assert!(message(&|c| c.fields[3].datatype = 9).starts_with("field `part` has datatype 9 and count 1"));
        assert!(message(&|c| c.fields[3].count = 0).starts_with("field `part` has datatype 6 and count 0"));
        assert!(message(&|c| c.data.to_mut().fill(0xFF)).starts_with("no usable point of 4: 4 not finite"));
    }
}
