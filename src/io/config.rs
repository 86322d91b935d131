//! The YAML configuration: every key optional, none unknown.
//!
//! `config/default.yaml` documents each key and is, by test, the same as [`Config::default`].

use std::{
    fmt, fs, io,
    path::{Path, PathBuf},
};

use clap::ValueEnum;
use serde::{Deserialize, Deserializer, Serialize, Serializer, de};
use thiserror::Error;

use crate::{
    inference::{Sampler, SamplingSettings},
    model::{DeclaredPhysics, KinematicSettings},
    pipeline::{PipelineSettings, PoseSettings, WindowSettings},
    types::Label,
};

/// Why there is no configuration.
#[derive(Debug, Error)]
pub enum ConfigError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// An unknown key, a wrong type, or no YAML.
    #[error("{}: key `{key}`: {reason}", path.display())]
    Key {
        /// The file.
        path: PathBuf,
        /// The key from the top, as `input.wrenches[0].part`; `.` is the whole file.
        key: String,
        /// What was expected, what was there.
        reason: String,
    },
}

/// The whole configuration.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct Config {
    /// Seed of all random numbers.
    pub seed: u64,
    /// What the published dynamics come from.
    pub engine: Engine,
    /// How long HMC and NUTS sample.
    pub sampling: SamplingConfig,
    /// Gravity in world \[m/s²\].
    pub gravity_m_s2: [f64; 3],
    /// Topics, frames and what to make of them.
    pub input: InputConfig,
    /// A posterior counts from its window's close plus this, in stamp time \[s\].
    pub posterior_latency_s: f64,
    /// `bom evaluate` simulates this far from what was seen \[s\].
    pub evaluation_horizon_s: f64,
    /// When interaction windows open and close.
    pub windows: WindowSettings,
    /// How poses that a topic measures become observations.
    pub poses: PoseSettings,
    /// What counts as an observation.
    pub observations: ObservationConfig,
    /// What is assumed of pose measurements.
    pub kinematics: KinematicSettings,
    /// Which physics is in the model from the start.
    pub model: DeclaredPhysics,
}

impl Default for Config {
    fn default() -> Self {
        Self {
            seed: 0,
            engine: Engine::Svi,
            sampling: SamplingConfig::default(),
            gravity_m_s2: [0.0, 0.0, -9.81],
            input: InputConfig::default(),
            posterior_latency_s: 0.0,
            evaluation_horizon_s: 1.0,
            windows: WindowSettings::default(),
            poses: PoseSettings::default(),
            observations: ObservationConfig::default(),
            kinematics: KinematicSettings::default(),
            model: DeclaredPhysics::default(),
        }
    }
}

impl Config {
    /// What the pipeline needs of it; `root` is the part fixed to the world, if known.
    pub fn pipeline_settings(&self, root: Option<Label>) -> PipelineSettings {
        PipelineSettings {
            root,
            use_tool: self.observations.tool_pose,
            points_per_part: self.input.points_per_part,
            windows: self.windows,
            poses: self.poses,
            kinematics: self.kinematics,
            gravity_in_world: self.gravity_m_s2.into(),
            sampling: self.sampling(),
            declared: self.model.clone(),
            predict: false,
            may_lag: false,
            posterior_latency_s: self.posterior_latency_s,
            live: false,
        }
    }

    fn sampling(&self) -> Option<SamplingSettings> {
        let sampler = match self.engine {
            Engine::Svi => return None,
            Engine::Hmc => Sampler::Hmc,
            Engine::Nuts => Sampler::Nuts,
        };
        let SamplingConfig { chains, warmup, draws, leapfrog_steps } = self.sampling;
        Some(SamplingSettings { sampler, chains, warmup, draws, seed: self.seed, leapfrog_steps })
    }

    /// Reads a file.
    ///
    /// # Errors
    /// With the file, the key and the reason.
    pub fn from_file(path: &Path) -> Result<Self, ConfigError> {
        let text = fs::read_to_string(path).map_err(|source| ConfigError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// Reads text; `path` is for error messages. Text without any key is the default.
    ///
    /// # Errors
    /// With the key and the reason.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ConfigError> {
        let has_content = |line: &str| !matches!(line.trim_start().chars().next(), None | Some('#'));
        if !text.lines().any(has_content) {
            return Ok(Self::default());
        }
        let key_error = |key: String, reason: String| ConfigError::Key { path: path.to_owned(), key, reason };
        let config: Self =
            serde_path_to_error::deserialize(serde_yaml_ng::Deserializer::from_str(text)).map_err(|error| {
                let key = error.path().to_string();
                let reason = without_key(&error.inner().to_string(), &key);
                key_error(key, reason)
            })?;
        config.check().map_err(|(key, reason)| key_error(key, reason))?;
        Ok(config)
    }

    /// The key and the reason of the first value that makes no sense.
    fn check(&self) -> Result<(), (String, String)> {
        // Heavier than any planet's; a wrong unit shows here.
        let strength: f64 = self.gravity_m_s2.iter().map(|component| component * component).sum::<f64>().sqrt();
        if strength.is_nan() || strength > 100.0 {
            return Err(("gravity_m_s2".into(), format!("{:?}, expected at most 100 m/s²", self.gravity_m_s2)));
        }
        let positive = [
            ("windows.force_threshold_n", self.windows.force_threshold_n),
            ("windows.smoothing_s", self.windows.smoothing_s),
            ("evaluation_horizon_s", self.evaluation_horizon_s),
            ("windows.quiet_s", self.windows.quiet_s),
            ("windows.longest_s", self.windows.longest_s),
            ("poses.rate_hz", self.poses.rate_hz),
            ("poses.evaluation_rate_hz", self.poses.evaluation_rate_hz),
            ("kinematics.tool_offset_sigma", self.kinematics.tool_offset_sigma),
            ("kinematics.shared_error", self.kinematics.shared_error),
            ("kinematics.own_error", self.kinematics.own_error),
            ("kinematics.shared_distance", self.kinematics.shared_distance),
            ("kinematics.view_error", self.kinematics.view_error),
            ("kinematics.view_distance", self.kinematics.view_distance),
            ("kinematics.rest_deviations", self.kinematics.rest_deviations),
            ("kinematics.student_freedom", self.kinematics.student_freedom),
            ("windows.kept", self.windows.kept as f64),
            ("kinematics.steps", self.kinematics.steps as f64),
        ];
        positive.into_iter().try_for_each(|(key, value)| positive_number(key, value))?;
        self.model.inertia.values().try_for_each(|value| positive_number("model.inertia", *value))?;
        for (key, value) in [("posterior_latency_s", self.posterior_latency_s), ("windows.lead_s", self.windows.lead_s)]
        {
            if !(0.0..=1e6).contains(&value) {
                return Err((key.into(), format!("{value}, expected 0 to 1e6")));
            }
        }
        let SamplingConfig { chains, warmup, draws, leapfrog_steps } = self.sampling;
        for (key, value, least) in [
            ("sampling.chains", chains, 1),
            ("sampling.warmup", warmup, 1),
            ("sampling.draws", draws, 10),
            ("sampling.leapfrog_steps", leapfrog_steps, 1),
        ] {
            if !(least..=1_000_000).contains(&value) {
                return Err((key.into(), format!("{value}, expected {least} to 1000000")));
            }
        }
        self.input.check()
    }
}

/// What the published dynamics come from.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize, ValueEnum)]
#[serde(rename_all = "lowercase")]
pub enum Engine {
    /// Gaussian factors by natural gradients
    #[default]
    Svi,
    /// Hamiltonian Monte Carlo
    Hmc,
    /// The no-U-turn sampler
    Nuts,
}

/// How long HMC and NUTS sample.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct SamplingConfig {
    /// Chains, side by side.
    pub chains: usize,
    /// Draws per chain that tune the step and are thrown away.
    pub warmup: usize,
    /// Draws per chain that are kept.
    pub draws: usize,
    /// Evaluations of the density per draw at most.
    pub leapfrog_steps: usize,
}

impl Default for SamplingConfig {
    fn default() -> Self {
        Self { chains: 2, warmup: 60, draws: 200, leapfrog_steps: 15 }
    }
}

fn positive_number(key: &str, value: f64) -> Result<(), (String, String)> {
    if value > 0.0 && value <= 1e6 {
        return Ok(());
    }
    Err((key.into(), format!("{value}, expected above 0 and at most 1e6")))
}

/// What counts as an observation.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct ObservationConfig {
    /// The tool's position measures the part that it holds.
    pub tool_pose: bool,
}

impl Default for ObservationConfig {
    fn default() -> Self {
        Self { tool_pose: true }
    }
}

/// The YAML parser puts the key, or the one it is in, before its reasons: once is enough.
fn without_key(reason: &str, key: &str) -> String {
    match reason.split_once(": ") {
        Some((place, rest)) if key.starts_with(place) => rest.to_owned(),
        _ => reason.to_owned(),
    }
}

/// What to read from a bag or from the network.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct InputConfig {
    /// Prefix of the relative topic names below.
    pub namespace: String,
    /// Topics of segmented clouds, sensor_msgs/PointCloud2.
    pub clouds: Vec<String>,
    /// Topics of part poses, geometry_msgs/PoseWithCovarianceStamped; `{label}` is the part.
    pub poses: String,
    /// Topics of wrenches that tools apply, geometry_msgs/WrenchStamped.
    pub wrenches: Vec<WrenchTopic>,
    /// Topics of wrenches on a part that no tool applies, geometry_msgs/WrenchStamped; `{label}` is the
    /// part.
    pub part_wrenches: String,
    /// Topic of moving transforms, tf2_msgs/TFMessage.
    pub tf: String,
    /// Topic of fixed transforms, tf2_msgs/TFMessage.
    pub tf_static: String,
    /// World: what everything is expressed in, at rest, with gravity as configured.
    pub fixed_frame: String,
    /// The PointCloud2 field with the part's label.
    pub label_field: String,
    /// Labels that are no part (background): their points are left out.
    pub ignored_labels: Vec<Label>,
    /// Points of a part that are used of a frame at most; 0: all.
    pub points_per_part: usize,
    /// How far back moving transforms are kept \[s\].
    pub tf_history_s: f64,
    /// How far the stream may go on before a message that waits for its transform is dropped \[s\].
    pub tf_timeout_s: f64,
    /// Standard deviation meant by an all-zero pose covariance.
    pub default_pose_std: PoseStd,
}

impl Default for InputConfig {
    fn default() -> Self {
        Self {
            namespace: "/".into(),
            clouds: vec!["parts/points".into()],
            poses: "parts/{label}/pose".into(),
            wrenches: vec![WrenchTopic::default()],
            part_wrenches: "parts/{label}/wrench".into(),
            tf: "/tf".into(),
            tf_static: "/tf_static".into(),
            fixed_frame: "world".into(),
            label_field: "label".into(),
            ignored_labels: Vec::new(),
            points_per_part: 2500,
            tf_history_s: 10.0,
            tf_timeout_s: 1.0,
            default_pose_std: PoseStd::default(),
        }
    }
}

impl InputConfig {
    /// A topic name made absolute: a relative one gets the namespace.
    pub fn absolute(&self, topic: &str) -> String {
        if topic.starts_with('/') {
            return topic.to_owned();
        }
        match self.namespace.trim_matches('/') {
            "" => format!("/{topic}"),
            namespace => format!("/{namespace}/{topic}"),
        }
    }

    /// The part whose pose a topic carries, if it is such a topic.
    pub fn pose_label(&self, topic: &str) -> Option<Label> {
        self.label_in(&self.poses, topic)
    }

    /// The part that the wrenches of a topic act on, if it is such a topic.
    pub fn part_wrench_label(&self, topic: &str) -> Option<Label> {
        self.label_in(&self.part_wrenches, topic)
    }

    fn label_in(&self, pattern: &str, topic: &str) -> Option<Label> {
        let pattern = self.absolute(pattern);
        let (before, after) = pattern.split_once("{label}")?;
        topic.strip_prefix(before)?.strip_suffix(after)?.parse().ok().map(Label)
    }

    fn check(&self) -> Result<(), (String, String)> {
        for (key, value) in [
            ("input.tf_history_s", self.tf_history_s),
            ("input.tf_timeout_s", self.tf_timeout_s),
            ("input.default_pose_std.rotation_rad", self.default_pose_std.rotation_rad),
            ("input.default_pose_std.position_m", self.default_pose_std.position_m),
        ] {
            positive_number(key, value)?;
        }
        for (key, pattern) in [("input.poses", &self.poses), ("input.part_wrenches", &self.part_wrenches)] {
            if pattern.matches("{label}").count() != 1 {
                return Err((key.into(), format!("`{pattern}`, expected {{label}} in it, once")));
            }
        }
        if self.absolute(&self.poses) == self.absolute(&self.part_wrenches) {
            return Err(("input".into(), format!("topic {} is given twice", self.absolute(&self.poses))));
        }
        let wrenches = self.wrenches.iter().map(|wrench| &wrench.topic);
        let names = self.clouds.iter().chain(wrenches).chain([&self.tf, &self.tf_static]);
        let mut topics: Vec<String> = names.map(|name| self.absolute(name)).collect();
        topics.sort();
        if let Some(pair) = topics.windows(2).find(|pair| pair[0] == pair[1]) {
            return Err(("input".into(), format!("topic {} is given twice", pair[0])));
        }
        for (key, value) in [("input.fixed_frame", &self.fixed_frame), ("input.label_field", &self.label_field)] {
            if value.is_empty() {
                return Err((key.into(), "is empty".into()));
            }
        }
        Ok(())
    }
}

/// A topic of wrenches, and what they act on.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct WrenchTopic {
    /// The topic.
    pub topic: String,
    /// The part that it acts on.
    pub part: PartBinding,
    /// The sensor reports what the object does to the tool: both signs are turned.
    pub reaction: bool,
}

impl Default for WrenchTopic {
    fn default() -> Self {
        Self { topic: "wrench".into(), part: PartBinding::Auto, reaction: false }
    }
}

/// What a wrench acts on: written `auto`, or a label.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum PartBinding {
    /// The part in contact, found from the geometry.
    #[default]
    Auto,
    /// Always this part.
    Part(Label),
}

impl PartBinding {
    /// The label, if bound to one.
    pub fn label(self) -> Option<Label> {
        match self {
            Self::Auto => None,
            Self::Part(label) => Some(label),
        }
    }
}

impl Serialize for PartBinding {
    fn serialize<S: Serializer>(&self, serializer: S) -> Result<S::Ok, S::Error> {
        match self {
            Self::Auto => serializer.serialize_str("auto"),
            Self::Part(label) => serializer.serialize_u32(label.0),
        }
    }
}

impl<'de> Deserialize<'de> for PartBinding {
    fn deserialize<D: Deserializer<'de>>(deserializer: D) -> Result<Self, D::Error> {
        deserializer.deserialize_any(PartBindingVisitor)
    }
}

struct PartBindingVisitor;

impl de::Visitor<'_> for PartBindingVisitor {
    type Value = PartBinding;

    fn expecting(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str("`auto` or a label, an integer of 0 to 4294967295")
    }

    fn visit_str<E: de::Error>(self, text: &str) -> Result<PartBinding, E> {
        match text {
            "auto" => Ok(PartBinding::Auto),
            _ => Err(E::invalid_value(de::Unexpected::Str(text), &self)),
        }
    }

    fn visit_u64<E: de::Error>(self, label: u64) -> Result<PartBinding, E> {
        let label = u32::try_from(label).map_err(|_| E::invalid_value(de::Unexpected::Unsigned(label), &self))?;
        Ok(PartBinding::Part(Label(label)))
    }
}

/// Spread of a measured pose.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
#[serde(default, deny_unknown_fields)]
pub struct PoseStd {
    /// About each axis \[rad\].
    pub rotation_rad: f64,
    /// Along each axis \[m\].
    pub position_m: f64,
}

impl Default for PoseStd {
    fn default() -> Self {
        Self { rotation_rad: 0.01, position_m: 0.002 }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<Config, ConfigError> {
        Config::parse(text, Path::new("bom.yaml"))
    }

    #[test]
    fn default_yaml_is_the_default() {
        let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("config/default.yaml");
        assert_eq!(Config::from_file(&path).unwrap(), Config::default());
    }

    #[test]
    fn default_yaml_names_every_key() {
        let text = include_str!("../../config/default.yaml");
        let given: serde_yaml_ng::Value = serde_yaml_ng::from_str(text).unwrap();
        assert_eq!(given, serde_yaml_ng::to_value(Config::default()).unwrap());
    }

    #[test]
    fn nothing_but_comments_is_the_default() {
        assert_eq!(parse("# seed: 3\n\n").unwrap(), Config::default());
    }

    #[test]
    fn errors_name_file_key_and_reason() {
        for (text, expected) in [
            ("input: {topics: 3}", "bom.yaml: key `input.topics`: unknown field `topics`"),
            ("input: {wrenches: [{topic: w, part: left}]}", "key `input.wrenches[0].part`: invalid value"),
            ("input: {wrenches: [{part: -1}]}", "key `input.wrenches[0].part`: invalid type: integer `-1`"),
            ("input: {tf_timeout_s: -1}", "key `input.tf_timeout_s`: -1, expected above 0"),
            ("input: {tf_timeout_s: .nan}", "key `input.tf_timeout_s`: NaN, expected above 0"),
            ("model: {inertia: {1: 0}}", "key `model.inertia`: 0, expected above 0"),
            ("input: {poses: parts/pose}", "key `input.poses`: `parts/pose`, expected {label}"),
            ("input: {part_wrenches: wrenches}", "key `input.part_wrenches`: `wrenches`, expected {label}"),
            ("input: {clouds: [wrench]}", "key `input`: topic /wrench is given twice"),
            ("gravity_m_s2: [0, 0]", "key `gravity_m_s2"),
            ("gravity_m_s2: [0, 0, -9810]", "key `gravity_m_s2`: [0.0, 0.0, -9810.0], expected at most"),
            ("seed: [", "bom.yaml: key `"),
        ] {
            let message = parse(text).unwrap_err().to_string();
            assert!(message.contains(expected), "{message}");
        }
    }

    #[test]
    fn relative_names_take_the_namespace() {
        let mut input = InputConfig::default();
        assert_eq!(input.absolute("parts/points"), "/parts/points");
        assert_eq!(input.pose_label("/parts/12/pose"), Some(Label(12)));
        input.namespace = "robot".into();
        assert_eq!(input.absolute("wrench"), "/robot/wrench");
        assert_eq!(input.absolute("/tf"), "/tf");
        assert_eq!(input.pose_label("/robot/parts/12/pose"), Some(Label(12)));
        assert_eq!(input.pose_label("/parts/12/pose"), None);
        assert_eq!(input.pose_label("/robot/parts/x/pose"), None);
    }
}
