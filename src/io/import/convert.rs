//! Rows → poses and wrenches in world → messages of a bag.

use std::{collections::BTreeMap, path::Path};

use nalgebra::{Matrix3, Rotation3, Vector3};

use super::{
    ImportError, ImportSpec, Table,
    spec::{MovingType, PartSpec, SplitSpec, WrenchSpec, unit},
    table::Column,
};
use crate::{
    io::{
        bag::{BagWriter, TopicId},
        cdr::{self, Endianness},
        messages::{
            Header, POSE_TYPE, PoseWithCovariance, PoseWithCovarianceStamped, RawPose, RawQuaternion, TF_TYPE,
            TfMessage, TransformStamped, WRENCH_TYPE, Wrench, WrenchStamped,
        },
    },
    math::{Pose, Screw},
    types::Stamp,
};

/// The first row's stamp \[ns\]: stamps of zero mean "none" in ROS.
const FIRST_STAMP: i64 = 1_000_000_000;
/// How an orientation that was not measured is marked (REP 145).
const NOT_MEASURED: f64 = -1.0;

/// What was written.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Imported {
    /// Rows used.
    pub rows: usize,
    /// Of so many.
    pub rows_in: usize,
    /// Rows, or readings of a sweep, that are left out for an empty cell.
    pub rows_empty: usize,
    /// Messages written.
    pub messages: usize,
}

/// Writes the rows of a table, or of a split of it, as a bag.
///
/// # Errors
/// If the table is not what the spec says (with column and line), or the bag cannot be written.
pub fn import(table: Table, spec: &ImportSpec, split: Option<&SplitSpec>, bag: &Path) -> Result<Imported, ImportError> {
    let rows_in = table.len();
    let mut table = table;
    for (column, text) in &spec.select {
        table = table.select(column, text)?;
    }
    let (table, runs) = match &spec.sweep {
        Some(sweep) => table.swept(sweep)?,
        None => {
            let runs = vec![0; table.len()];
            (table, runs)
        }
    };
    let machine = Machine::new(&table, spec)?;
    let times_s = times(&table, spec, &runs)?;
    let first_s = times_s.iter().flatten().next().copied().unwrap_or(0.0);
    let keep = kept(&times_s, &runs, split);
    let fail = |error: &dyn ToString| ImportError::file(bag, error.to_string());
    let folder = bag.parent().filter(|folder| !folder.as_os_str().is_empty()).unwrap_or(Path::new("."));
    // It appears when it is complete.
    let aside = tempfile::Builder::new().suffix(".mcap").tempfile_in(folder).map_err(|e| fail(&e))?;
    let mut writer = Messages::new(BagWriter::create(aside.path()).map_err(|e| fail(&e))?);
    let mut imported = Imported { rows_in, ..Imported::default() };
    for (row, time_s) in times_s.iter().enumerate() {
        // Nothing was measured: a guess in its place would be taken for a measurement.
        let Some(time_s) = time_s.filter(|_| !machine.lacks(&table, row)) else {
            imported.rows_empty += 1;
            continue;
        };
        let instant = machine.at(&table, row)?;
        if keep[row] {
            let stamp = Stamp(FIRST_STAMP).plus_seconds(time_s - first_s);
            writer.write(stamp, &instant).map_err(|e| fail(&e))?;
            imported.rows += 1;
        }
    }
    if imported.rows == 0 {
        return Err(ImportError::file(table.path(), "no row is in the split"));
    }
    imported.messages = writer.count;
    writer.writer.finish().map_err(|e| fail(&e))?;
    aside.persist(bag).map_err(|e| fail(&e.error))?;
    Ok(imported)
}

/// When each row was recorded \[s\]; none where its cell is empty.
fn times(table: &Table, spec: &ImportSpec, runs: &[usize]) -> Result<Vec<Option<f64>>, ImportError> {
    let pause_s = spec.sweep.as_ref().map_or(0.0, |sweep| sweep.pause_s);
    let Some(column) = &spec.time.column else {
        let rate_hz = spec.time.rate_hz.unwrap_or(1.0);
        let time = |(row, run): (usize, &usize)| Some(row as f64 / rate_hz + *run as f64 * pause_s);
        return Ok(runs.iter().enumerate().map(time).collect());
    };
    let column = table.column(column)?;
    let mut times_s: Vec<Option<f64>> = Vec::with_capacity(table.len());
    let mut last: Option<f64> = None;
    for row in 0..table.len() {
        if table.is_empty_at(row, &column) {
            times_s.push(None);
            continue;
        }
        let time_s = table.value(row, &column)?;
        if let Some(before) = last.filter(|before| *before >= time_s) {
            return Err(table.bad(row, &column, format!("{time_s} s after {before} s, expected a later time")));
        }
        last = Some(time_s);
        times_s.push(last);
    }
    Ok(times_s)
}

/// Which rows are in a split.
fn kept(times_s: &[Option<f64>], runs: &[usize], split: Option<&SplitSpec>) -> Vec<bool> {
    let first = times_s.iter().flatten().next().copied().unwrap_or(0.0);
    let last = times_s.iter().flatten().last().copied().unwrap_or(0.0);
    let inside = |time_s: f64, run: usize| {
        let Some(split) = split else { return true };
        if let Some([from, to]) = split.share {
            let share = (time_s - first) / (last - first).max(1e-9);
            return share >= from && (share < to || (to >= 1.0 && share <= 1.0));
        }
        if let (Some(of), Some(runs)) = (split.runs_of, &split.runs) {
            return runs.contains(&((run % of as usize) as u32));
        }
        let (Some(block_s), Some(of), Some(blocks)) = (split.block_s, split.of, &split.blocks) else { return true };
        let block = ((time_s - first) / block_s).floor() as u64;
        blocks.contains(&((block % u64::from(of)) as u32))
    };
    times_s.iter().zip(runs).map(|(time_s, run)| time_s.is_some_and(|time_s| inside(time_s, *run))).collect()
}

/// A part in one row, in world.
struct PartAt {
    label: u32,
    world_from_frame: Pose,
    covariance: [f64; 6],
    /// Axis of its joint now, where it has one.
    axis: Option<(MovingType, Vector3<f64>)>,
}

/// A wrench on a part, at a point in world.
#[derive(Clone, Copy)]
struct WrenchAt {
    label: u32,
    point: Vector3<f64>,
    force: Vector3<f64>,
    torque: Vector3<f64>,
}

struct Instant {
    parts: Vec<PartAt>,
    wrenches: Vec<WrenchAt>,
}

/// The spec with its columns found.
struct Machine<'a> {
    world_from_table: Matrix3<f64>,
    parts: Vec<PartColumns<'a>>,
    wrenches: Vec<WrenchColumns<'a>>,
}

struct PartColumns<'a> {
    spec: &'a PartSpec,
    joint: Option<Column>,
    position: Option<[Column; 3]>,
    orientation: Option<[Column; 4]>,
}

struct WrenchColumns<'a> {
    spec: &'a WrenchSpec,
    force: Option<[Column; 3]>,
    torque: Option<[Column; 3]>,
    effort: Option<Column>,
}

impl<'a> Machine<'a> {
    fn new(table: &Table, spec: &'a ImportSpec) -> Result<Self, ImportError> {
        let down = unit(&spec.gravity_direction).unwrap_or_else(|| -Vector3::z());
        let parts = spec.parts.iter().map(|part| {
            Ok(PartColumns {
                spec: part,
                joint: part.joint.as_ref().map(|joint| table.column(&joint.position)).transpose()?,
                position: part.position.as_ref().map(|columns| table.columns(columns)).transpose()?,
                orientation: part.orientation.as_ref().map(|columns| table.columns(columns)).transpose()?,
            })
        });
        let wrenches = spec.wrenches.iter().map(|wrench| {
            Ok(WrenchColumns {
                spec: wrench,
                force: wrench.force.as_ref().map(|columns| table.columns(columns)).transpose()?,
                torque: wrench.torque.as_ref().map(|columns| table.columns(columns)).transpose()?,
                effort: wrench.effort.as_ref().map(|column| table.column(column)).transpose()?,
            })
        });
        // Half a turn where gravity points up: any axis across it serves.
        let turn = Rotation3::rotation_between(&down, &-Vector3::z())
            .unwrap_or_else(|| Rotation3::from_axis_angle(&Vector3::x_axis(), std::f64::consts::PI));
        Ok(Self {
            world_from_table: turn.into_inner(),
            parts: parts.collect::<Result<_, ImportError>>()?,
            wrenches: wrenches.collect::<Result<_, ImportError>>()?,
        })
    }

    /// Whether a cell that is read of a row is empty.
    fn lacks(&self, table: &Table, row: usize) -> bool {
        let empty = |columns: &[Column]| columns.iter().any(|column| table.is_empty_at(row, column));
        let triple = |columns: &Option<[Column; 3]>| columns.as_ref().is_some_and(|columns| empty(columns));
        let single = |column: &Option<Column>| column.as_ref().is_some_and(|column| table.is_empty_at(row, column));
        let of_part = |part: &PartColumns<'_>| {
            single(&part.joint)
                || triple(&part.position)
                || part.orientation.as_ref().is_some_and(|columns| empty(columns))
        };
        let of_wrench =
            |wrench: &WrenchColumns<'_>| triple(&wrench.force) || triple(&wrench.torque) || single(&wrench.effort);
        self.parts.iter().any(of_part) || self.wrenches.iter().any(of_wrench)
    }

    fn at(&self, table: &Table, row: usize) -> Result<Instant, ImportError> {
        let vector = |columns: &[Column; 3]| -> Result<Vector3<f64>, ImportError> {
            let mut found = Vector3::zeros();
            for (i, column) in columns.iter().enumerate() {
                found[i] = table.value(row, column)?;
            }
            Ok(found)
        };
        let turned = Pose { rotation: self.world_from_table, translation: Vector3::zeros() };
        let mut displacements: BTreeMap<u32, Pose> = BTreeMap::new();
        let mut parts = Vec::new();
        for part in &self.parts {
            let spec = part.spec;
            let (table_from_frame, axis) = if let (Some(joint), Some(column)) = (&spec.joint, &part.joint) {
                let parent = spec.parent.and_then(|p| displacements.get(&p)).copied().unwrap_or_else(Pose::identity);
                let direction = unit(&joint.axis).unwrap_or_else(Vector3::z);
                let screw = match joint.joint_type {
                    MovingType::Prismatic => Screw::prismatic(&direction),
                    MovingType::Revolute => Screw::revolute(&direction, &joint.point.into()),
                };
                let displacement = parent * screw.displacement(table.value(row, column)?);
                displacements.insert(spec.label, displacement);
                let axis = self.world_from_table * parent.rotation * direction;
                (displacement * Pose::from_translation(spec.frame.into()), Some((joint.joint_type, axis)))
            } else if let Some(position) = &part.position {
                let position = vector(position)?;
                let pose = match &part.orientation {
                    None => Pose::from_translation(position),
                    Some(columns) => {
                        let mut q = [0.0; 4];
                        for (value, column) in q.iter_mut().zip(columns) {
                            *value = table.value(row, column)?;
                        }
                        let raw = RawQuaternion { x: q[0], y: q[1], z: q[2], w: q[3] };
                        let rotation = raw.unit().ok_or_else(|| {
                            table.bad(row, &columns[3], format!("quaternion of norm {}, expected 1", raw.norm()))
                        })?;
                        Pose::from_quaternion(&rotation, position)
                    }
                };
                (pose, None)
            } else {
                continue;
            };
            let position = spec.noise.position_m.powi(2);
            let rotation = spec.noise.rotation_rad.map_or(NOT_MEASURED, |deviation| deviation.powi(2));
            parts.push(PartAt {
                label: spec.label,
                world_from_frame: turned * table_from_frame,
                covariance: [position, position, position, rotation, rotation, rotation],
                axis,
            });
        }
        let mut wrenches = Vec::new();
        for wrench in &self.wrenches {
            let Some(part) = parts.iter().find(|part| part.label == wrench.spec.part) else { continue };
            let read = |columns: &Option<[Column; 3]>| columns.as_ref().map_or(Ok(Vector3::zeros()), vector);
            let point = part.world_from_frame.translation;
            if let (Some(column), Some((joint_type, axis))) = (&wrench.effort, part.axis) {
                let effort = axis * table.value(row, column)?;
                let (force, torque) = match joint_type {
                    MovingType::Prismatic => (effort, Vector3::zeros()),
                    MovingType::Revolute => (Vector3::zeros(), effort),
                };
                wrenches.push(WrenchAt { label: part.label, point, force, torque });
                let parent = self.parts.iter().find(|p| p.spec.label == part.label).and_then(|p| p.spec.parent);
                wrenches.extend(parent.map(|label| WrenchAt { label, point, force: -force, torque: -torque }));
            } else {
                let (force, torque) = (read(&wrench.force)?, read(&wrench.torque)?);
                let (force, torque) = (self.world_from_table * force, self.world_from_table * torque);
                wrenches.push(WrenchAt { label: part.label, point, force, torque });
            }
        }
        Ok(Instant { parts, wrenches: summed(&wrenches) })
    }
}

/// All wrenches on a part as one, at the point of the part's first.
fn summed(wrenches: &[WrenchAt]) -> Vec<WrenchAt> {
    let mut by_part: BTreeMap<u32, WrenchAt> = BTreeMap::new();
    for wrench in wrenches {
        by_part
            .entry(wrench.label)
            .and_modify(|sum| {
                sum.force += wrench.force;
                sum.torque += wrench.torque + (wrench.point - sum.point).cross(&wrench.force);
            })
            .or_insert(*wrench);
    }
    by_part.into_values().collect()
}

struct Messages {
    writer: BagWriter,
    topics: BTreeMap<String, TopicId>,
    count: usize,
}

impl Messages {
    fn new(writer: BagWriter) -> Self {
        Self { writer, topics: BTreeMap::new(), count: 0 }
    }

    fn write(&mut self, stamp: Stamp, instant: &Instant) -> Result<(), String> {
        let header = |frame: &str| Header { stamp: stamp.into(), frame_id: frame.to_owned() };
        let origin = |label: u32| format!("parts/{label}/wrench_origin");
        let transforms = instant.wrenches.iter().map(|wrench| TransformStamped {
            header: header("world"),
            child_frame_id: origin(wrench.label),
            transform: Pose::from_translation(wrench.point).into(),
        });
        let transforms: Vec<TransformStamped> = transforms.collect();
        if !transforms.is_empty() {
            self.put("/tf".into(), TF_TYPE, stamp, &TfMessage { transforms })?;
        }
        for part in &instant.parts {
            let mut covariance = [[0.0; 6]; 6];
            for (i, variance) in part.covariance.into_iter().enumerate() {
                covariance[i][i] = variance;
            }
            let orientation = part.world_from_frame.quaternion().into();
            let pose = RawPose { position: part.world_from_frame.translation.into(), orientation };
            let message =
                PoseWithCovarianceStamped { header: header("world"), pose: PoseWithCovariance { pose, covariance } };
            self.put(format!("/parts/{}/pose", part.label), POSE_TYPE, stamp, &message)?;
        }
        for WrenchAt { label, force, torque, .. } in &instant.wrenches {
            let wrench = Wrench { force: (*force).into(), torque: (*torque).into() };
            let message = WrenchStamped { header: header(&origin(*label)), wrench };
            self.put(format!("/parts/{label}/wrench"), WRENCH_TYPE, stamp, &message)?;
        }
        Ok(())
    }

    fn put<T: serde::Serialize>(
        &mut self,
        topic: String,
        type_name: &str,
        stamp: Stamp,
        message: &T,
    ) -> Result<(), String> {
        let id = match self.topics.get(&topic) {
            Some(id) => *id,
            None => {
                let id = self.writer.add_topic(&topic, type_name).map_err(|e| e.to_string())?;
                self.topics.insert(topic, id);
                id
            }
        };
        let bytes = cdr::encode(message, Endianness::Little).map_err(|e| e.to_string())?;
        let log_time = u64::try_from(stamp.0).unwrap_or_default();
        self.count += 1;
        self.writer.write(id, log_time, log_time, &bytes).map_err(|e| e.to_string())
    }
}
