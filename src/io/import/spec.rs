//! What a table's columns are, and what is known of the machine that it was recorded from.

use std::{collections::BTreeMap, fs, path::Path};

use serde::Deserialize;

use super::ImportError;

/// A spec; config/import has those of the public records that this project is tested on.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ImportSpec {
    /// When each row was recorded.
    pub time: TimeSpec,
    /// Rows to be used: those whose columns hold these texts.
    #[serde(default)]
    pub select: BTreeMap<String, String>,
    /// The table has a sweep in every row, its readings side by side.
    pub sweep: Option<SweepSpec>,
    /// Where gravity points to in the table's frame; the bag's is turned so that it is along −z.
    #[serde(default = "down")]
    pub gravity_direction: [f64; 3],
    /// What was measured of each part, parents first.
    pub parts: Vec<PartSpec>,
    /// What acted on them.
    #[serde(default)]
    pub wrenches: Vec<WrenchSpec>,
    /// Shares of the record by name, to learn from and to score on.
    #[serde(default)]
    pub splits: BTreeMap<String, SplitSpec>,
}

fn down() -> [f64; 3] {
    [0.0, 0.0, -1.0]
}

/// When rows were recorded: by a column or at a rate.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct TimeSpec {
    /// The column with the time \[s\].
    pub column: Option<ColumnSpec>,
    /// Rows per second, where the table has no time \[Hz\].
    pub rate_hz: Option<f64>,
}

/// A column, as it is or in other units: value = gain · column + offset.
#[derive(Clone, Debug, Deserialize)]
#[serde(untagged)]
pub enum ColumnSpec {
    /// By name.
    Name(String),
    /// Scaled.
    Scaled(ScaledColumn),
}

/// A column in other units.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct ScaledColumn {
    /// Its name.
    pub column: String,
    /// SI units per unit of the column, sign included.
    #[serde(default = "one")]
    pub gain: f64,
    /// \[SI\].
    #[serde(default)]
    pub offset: f64,
}

fn one() -> f64 {
    1.0
}

impl ColumnSpec {
    /// Name, gain, offset.
    pub fn parts(&self) -> (&str, f64, f64) {
        match self {
            Self::Name(name) => (name, 1.0, 0.0),
            Self::Scaled(scaled) => (&scaled.column, scaled.gain, scaled.offset),
        }
    }
}

/// Readings of one sweep side by side in a row: each row becomes a run of its own.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SweepSpec {
    /// Names of the columns, with `{}` for the index.
    pub columns: String,
    /// The first index.
    pub from: i64,
    /// The last index.
    pub to: i64,
    /// The name by which the index is a column.
    pub index: String,
    /// The name by which the readings are a column.
    pub value: String,
    /// Between two runs \[s\].
    pub pause_s: f64,
}

/// One part: the joint that it is moved by, its measured pose, or a measured point of it.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct PartSpec {
    /// Its label in the bag.
    pub label: u32,
    /// The part that its joint is on; the world if left out.
    pub parent: Option<u32>,
    /// Known geometry and the column of the joint's position.
    pub joint: Option<JointSpec>,
    /// Columns of x, y, z of the measured point or frame \[m\].
    pub position: Option<[ColumnSpec; 3]>,
    /// Columns of the frame's orientation, x, y, z, w; without them a point is measured.
    pub orientation: Option<[ColumnSpec; 4]>,
    /// Where the measured frame's origin is while the joint is at zero \[m\].
    #[serde(default)]
    pub frame: [f64; 3],
    /// Standard deviations of what is measured.
    pub noise: NoiseSpec,
}

/// A joint of known geometry, at its zero.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct JointSpec {
    /// revolute or prismatic.
    #[serde(rename = "type")]
    pub joint_type: MovingType,
    /// Direction.
    pub axis: [f64; 3],
    /// A point of the axis \[m\].
    #[serde(default)]
    pub point: [f64; 3],
    /// The column of its position \[m or rad\].
    pub position: ColumnSpec,
}

/// How a joint moves.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum MovingType {
    /// Along its axis.
    Prismatic,
    /// About its axis.
    Revolute,
}

/// Standard deviations of one reading.
#[derive(Clone, Copy, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct NoiseSpec {
    /// Of the position, per axis \[m\].
    pub position_m: f64,
    /// Of the orientation, per axis \[rad\]; not for points.
    pub rotation_rad: Option<f64>,
}

/// What acts on a part: a force and a torque at its measured frame, a tangential force, or what its
/// joint exerts against its parent.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct WrenchSpec {
    /// The part.
    pub part: u32,
    /// Columns of the force in the table's frame \[N\].
    pub force: Option<[ColumnSpec; 3]>,
    /// Columns of the torque about the measured frame's origin \[N·m\].
    pub torque: Option<[ColumnSpec; 3]>,
    /// Column of the force or torque along the part's joint, on the part and, the other way, on its
    /// parent \[N or N·m\].
    pub effort: Option<ColumnSpec>,
}

/// Which rows of a record a split holds: a share of it from begin to end, or every so many of its blocks.
#[derive(Clone, Debug, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct SplitSpec {
    /// Begin and end, 0 to 1.
    pub share: Option<[f64; 2]>,
    /// Length of a block \[s\].
    pub block_s: Option<f64>,
    /// Of so many blocks in turn …
    pub of: Option<u32>,
    /// … those with these numbers, from 0.
    pub blocks: Option<Vec<u32>>,
    /// Of the runs of a sweep: every so many …
    pub runs_of: Option<u32>,
    /// … those with these numbers, from 0.
    pub runs: Option<Vec<u32>>,
}

impl ImportSpec {
    /// Reads a file.
    ///
    /// # Errors
    /// With the file, the key and the reason.
    pub fn from_file(path: &Path) -> Result<Self, ImportError> {
        let text = fs::read_to_string(path).map_err(|error| ImportError::file(path, error))?;
        Self::parse(&text, path)
    }

    /// Reads text; `path` is for error messages.
    ///
    /// # Errors
    /// With the key and the reason.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ImportError> {
        let error = |key: String, reason: String| ImportError::Spec { path: path.to_owned(), key, reason };
        let deserializer = toml::Deserializer::parse(text)
            .map_err(|e| error(".".into(), e.message().to_owned() + &place(text, e.span())))?;
        let spec: Self = serde_path_to_error::deserialize(deserializer)
            .map_err(|e| error(e.path().to_string(), e.inner().message().to_owned()))?;
        spec.check().map_err(|(key, reason)| error(key, reason))?;
        Ok(spec)
    }

    /// The key and the reason of the first thing that makes no sense.
    fn check(&self) -> Result<(), (String, String)> {
        let fail = |key: String, reason: &str| Err((key, reason.to_owned()));
        if self.time.column.is_some() == self.time.rate_hz.is_some() {
            return fail("time".into(), "expected either `column` or `rate_hz`");
        }
        if self.time.rate_hz.is_some_and(|rate| !(rate > 0.0 && rate <= 1e6)) {
            return fail("time.rate_hz".into(), "expected above 0 and at most 1e6");
        }
        if self.parts.is_empty() {
            return fail("parts".into(), "expected at least one");
        }
        if unit(&self.gravity_direction).is_none() {
            return fail("gravity_direction".into(), "expected a direction");
        }
        for (i, part) in self.parts.iter().enumerate() {
            let at = |key: &str| format!("parts[{i}].{key}");
            let known = |label: u32| self.parts[..i].iter().any(|part| part.label == label);
            if known(part.label) {
                return fail(at("label"), "given twice");
            }
            if part.joint.is_some() == part.position.is_some() {
                return fail(at("joint"), "expected either `joint` or `position`");
            }
            if let Some(parent) = part.parent.filter(|parent| !known(*parent)) {
                return fail(at("parent"), &format!("part {parent} is not among the parts before"));
            }
            if part.joint.as_ref().is_some_and(|joint| unit(&joint.axis).is_none()) {
                return fail(at("joint.axis"), "expected a direction");
            }
            if part.orientation.is_some() && part.position.is_none() {
                return fail(at("orientation"), "expected `position` with it");
            }
            let positive = |value: f64| value > 0.0 && value.is_finite();
            if !positive(part.noise.position_m) || part.noise.rotation_rad.is_some_and(|value| !positive(value)) {
                return fail(at("noise"), "expected above 0");
            }
            let turns = part.joint.is_some() || part.orientation.is_some();
            if turns != part.noise.rotation_rad.is_some() {
                return fail(at("noise.rotation_rad"), "expected where an orientation is measured, and only there");
            }
        }
        for (i, wrench) in self.wrenches.iter().enumerate() {
            let at = |key: &str| format!("wrenches[{i}].{key}");
            let Some(part) = self.parts.iter().find(|part| part.label == wrench.part) else {
                return fail(at("part"), &format!("part {} is not among the parts", wrench.part));
            };
            if wrench.effort.is_some() == (wrench.force.is_some() || wrench.torque.is_some()) {
                return fail(at("effort"), "expected either `effort`, or `force`, `torque` or both");
            }
            if wrench.effort.is_some() && part.joint.is_none() {
                return fail(at("effort"), &format!("part {} has no joint of known geometry", wrench.part));
            }
        }
        for (name, split) in &self.splits {
            let blocks = (split.block_s.is_some(), split.of.is_some(), split.blocks.is_some());
            let runs = (split.runs_of.is_some(), split.runs.is_some());
            let kinds = [split.share.is_some(), blocks == (true, true, true), runs == (true, true)];
            let nothing_else = matches!(blocks, (true, true, true) | (false, false, false)) && runs.0 == runs.1;
            if kinds.into_iter().filter(|kind| *kind).count() != 1 || !nothing_else {
                return fail(
                    format!("splits.{name}"),
                    "expected `share`, or `block_s`, `of` and `blocks`, or `runs_of` and `runs`",
                );
            }
            if split.block_s.is_some_and(|block| block.is_nan() || block <= 0.0)
                || split.of == Some(0)
                || split.runs_of == Some(0)
            {
                return fail(format!("splits.{name}"), "expected above 0");
            }
        }
        Ok(())
    }
}

/// `, line N` of a place in a text.
fn place(text: &str, span: Option<std::ops::Range<usize>>) -> String {
    let before = span.and_then(|span| text.get(..span.start));
    before.map_or_else(String::new, |before| format!(", line {}", before.matches('\n').count() + 1))
}

/// A direction made a unit vector; `None` if it is none.
pub(super) fn unit(direction: &[f64; 3]) -> Option<nalgebra::Vector3<f64>> {
    let vector = nalgebra::Vector3::from(*direction);
    vector.try_normalize(1e-9).filter(|unit| unit.iter().all(|x| x.is_finite()))
}
