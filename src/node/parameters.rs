//! The parameters that the node has, with what they mean, what they may be and when they may change.
//!
//! Every key of the configuration is one, documented where `config/default.yaml` documents it; what
//! only a live stream needs comes on top.

use std::collections::BTreeMap;
use std::path::Path;

use ros2_interfaces_jazzy_serde::rcl_interfaces::msg::{FloatingPointRange, IntegerRange, ParameterDescriptor};
use serde_yaml_ng::{Mapping, Value as Yaml};

use super::arguments::{Override, flatten};
use super::names::Names;
use super::value::Value;
use crate::io::config::Config;
use crate::types::Label;

/// When a parameter may be set.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Change {
    /// Only with the arguments that start the node.
    AtStart,
    /// While the node is unconfigured.
    Unconfigured,
    /// Always.
    Always,
}

/// A parameter.
#[derive(Clone, Debug)]
pub struct Declaration {
    /// What it means, with its unit.
    pub description: String,
    /// Its value now.
    pub value: Value,
    /// Least and largest number.
    pub range: Option<(f64, f64)>,
    /// When it may be set.
    pub change: Change,
}

impl Declaration {
    fn new(description: &str, value: Value, range: Option<(f64, f64)>, change: Change) -> Self {
        Self { description: description.to_owned(), value, range, change }
    }
}

/// Topics that QoS parameters are for: the name in the code, whether the node reads it, whether it is
/// reliable and how many are kept.
pub const QOS_TOPICS: [(&str, bool, bool, i64); 10] = [
    ("wrench", true, false, 2000),
    ("parts/points", true, false, 2),
    ("parts/poses", true, false, 100),
    ("~/object_posterior", false, true, 1),
    ("~/predicted_poses", false, true, 10),
    ("~/criticism", false, true, 1),
    ("~/markers", false, true, 10),
    ("~/robot_description", false, true, 1),
    ("~/joint_states", false, true, 10),
    ("/diagnostics", false, true, 10),
];

/// What the names of parameters begin with that hardly anyone sets.
const RARE: &str = "kinematics.";

/// All parameters, by name.
#[derive(Clone, Debug)]
pub struct Parameters {
    declared: BTreeMap<String, Declaration>,
    /// See [`Parameters::undeclared`].
    rare: BTreeMap<String, Declaration>,
}

impl Default for Parameters {
    fn default() -> Self {
        Self::declared()
    }
}

impl Parameters {
    /// Every parameter, at its default.
    pub fn declared() -> Self {
        let mut declared = BTreeMap::new();
        let documentation = documentation(include_str!("../../config/default.yaml"));
        let config = serde_yaml_ng::to_value(Config::default()).unwrap_or_default();
        // A closure that only fails where a key is no text: none is.
        let _ = flatten(&config, "", &mut |name, yaml| {
            let Some(value) = default_value(name, yaml) else { return Ok(()) };
            let range = value.as_double().map(|_| (0.0, 1e6));
            // Subscriptions are there from the start on.
            let topic = ["input.clouds", "input.poses", "input.tf", "input.tf_static"].contains(&name);
            let change = if topic { Change::AtStart } else { Change::Unconfigured };
            let text = documentation.get(name).map_or("", String::as_str);
            declared.insert(name.to_owned(), Declaration::new(text, value, range, change));
            Ok(())
        });
        let texts = |items: &[&str]| Value::StringArray(items.iter().map(|item| (*item).to_owned()).collect());
        let own = [
            (
                "input.wrenches.topics",
                texts(&["wrench"]),
                None,
                Change::AtStart,
                "Topics of wrenches (geometry_msgs/WrenchStamped).",
            ),
            (
                "input.wrenches.parts",
                texts(&["auto"]),
                None,
                Change::Unconfigured,
                "For each of these topics the part that its tool acts on: a label, or auto to find the one in contact.",
            ),
            (
                "input.wrenches.reactions",
                Value::BoolArray(vec![false]),
                None,
                Change::Unconfigured,
                "For each of these topics whether the sensor reports what the object does to the tool.",
            ),
            (
                "root_label",
                Value::Integer(-1),
                Some((-1.0, f64::from(u32::MAX))),
                Change::Unconfigured,
                "The part that is fixed to the world; -1: found out.",
            ),
            ("use_sim_time", Value::Bool(false), None, Change::AtStart, "Whether /clock is the time."),
            (
                "autostart",
                Value::Bool(true),
                None,
                Change::AtStart,
                "Whether the node configures and activates itself; false: a lifecycle manager does.",
            ),
            (
                "publish_tf",
                Value::Bool(false),
                None,
                Change::Always,
                "Whether the parts' frames are sent on /tf, where they are and not only on ~/joint_states.",
            ),
            (
                "tf_prefix",
                Value::String(String::new()),
                None,
                Change::Always,
                "What the names of the parts' frames on /tf begin with, as robot_state_publisher's frame_prefix.",
            ),
            (
                "slowest_clouds_hz",
                Value::Double(5.0),
                Some((0.1, 100.0)),
                Change::Always,
                "A warning says when clouds come more slowly than this [Hz].",
            ),
            (
                "wrench_timeout_s",
                Value::Double(0.3),
                Some((0.01, 60.0)),
                Change::Always,
                "A warning says when a wrench topic has been silent for this long [s].",
            ),
            (
                "mesh_folder",
                Value::String(String::new()),
                None,
                Change::AtStart,
                "Folder, an absolute path, that the meshes of ~/robot_description are written to; empty: parts are boxes.",
            ),
            (
                "realtime",
                Value::Bool(true),
                None,
                Change::AtStart,
                "Whether tracking goes before other programs, in real time where the system permits it.",
            ),
            (
                "worker_threads",
                Value::Integer(0),
                Some((0.0, 1024.0)),
                Change::AtStart,
                "Threads that inference may use; 0: all cores but one.",
            ),
        ];
        for (name, value, range, change, text) in own {
            declared.insert(name.to_owned(), Declaration::new(text, value, range, change));
        }
        let rare = declared.extract_if(.., |name, _| name.starts_with(RARE)).collect();
        Self { declared, rare }
    }

    /// Sets what was given at the start, for this node. Returns what could not be used, a line each.
    pub fn start_with(&mut self, overrides: &[Override], names: &Names) -> Vec<String> {
        let mut unusable = Vec::new();
        for Override { node, name, value, source } in overrides {
            let bare = !node.contains('/') && (*node == names.node || *node == "bom");
            if !bare && !names.matched_by(node) {
                continue;
            }
            let Some(declaration) = self.declared.get(name).cloned().or_else(|| self.undeclared(name)) else {
                unusable.push(format!("unknown parameter `{name}` ({source})"));
                continue;
            };
            match checked(name, &declaration, value)
                .and_then(|value| self.with(name, Declaration { value, ..declaration }))
            {
                Ok(changed) => *self = changed,
                Err(reason) => unusable.push(format!("{reason} ({source})")),
            }
        }
        unusable
    }

    /// What is declared once it is given: all of it would make the list of parameters too long for one datagram,
    /// and RustDDS 0.15.1 writes fragments of an answer that Fast DDS does not read.
    fn undeclared(&self, name: &str) -> Option<Declaration> {
        self.rare.get(name).cloned().or_else(|| quality_declaration(name))
    }

    /// Sets parameters, all or none. `unconfigured`: the lifecycle state is that.
    ///
    /// # Errors
    /// Why not, with the parameter's name.
    pub fn set(&mut self, settings: &[(String, Value)], unconfigured: bool) -> Result<(), String> {
        let mut changed = self.clone();
        for (name, value) in settings {
            let declaration = self.declared.get(name).ok_or_else(|| format!("`{name}` is not declared"))?;
            match declaration.change {
                Change::AtStart => return Err(format!("`{name}` is read-only: give it when the node is started")),
                Change::Unconfigured if !unconfigured => {
                    return Err(format!("`{name}` can be set only while the node is unconfigured: clean it up first"));
                }
                _ => {
                    let value = checked(name, declaration, value)?;
                    changed = changed.with(name, Declaration { value, ..declaration.clone() })?;
                }
            }
        }
        *self = changed;
        Ok(())
    }

    /// With one value changed, if a configuration comes of it.
    fn with(&self, name: &str, declaration: Declaration) -> Result<Self, String> {
        let mut changed = self.clone();
        changed.declared.insert(name.to_owned(), declaration);
        changed.config()?;
        Ok(changed)
    }

    /// The value of a parameter.
    pub fn get(&self, name: &str) -> Option<&Value> {
        self.declared.get(name).map(|declaration| &declaration.value)
    }

    /// A switch; false if there is none of this name.
    pub fn is(&self, name: &str) -> bool {
        self.get(name).and_then(Value::as_bool).unwrap_or(false)
    }

    /// A number; zero if there is none of this name.
    pub fn number(&self, name: &str) -> f64 {
        self.get(name).and_then(Value::as_double).unwrap_or(0.0)
    }

    /// Texts; none if there are none of this name.
    pub fn texts(&self, name: &str) -> Vec<String> {
        if let Some(Value::StringArray(items)) = self.get(name) { items.clone() } else { Vec::new() }
    }

    /// All names, in order.
    pub fn names(&self) -> impl Iterator<Item = &str> {
        self.declared.keys().map(String::as_str)
    }

    /// What the parts' frames on /tf begin with; `None` if they are not sent.
    pub fn tf_prefix(&self) -> Option<String> {
        let prefix = self.get("tf_prefix").and_then(Value::as_text).unwrap_or_default();
        self.is("publish_tf").then_some(prefix)
    }

    /// The part that is fixed to the world, if it is given.
    pub fn root(&self) -> Option<Label> {
        let label = self.get("root_label").and_then(Value::as_integer)?;
        u32::try_from(label).ok().map(Label)
    }

    /// Whether a topic's QoS is reliable, and how many are kept.
    pub fn qos(&self, topic: &str, reads: bool) -> (bool, i32) {
        let prefix = qos_prefix(topic, reads);
        let value = |policy: &str| {
            let name = format!("{prefix}.{policy}");
            self.get(&name).cloned().or_else(|| quality_declaration(&name).map(|declaration| declaration.value))
        };
        let reliable = value("reliability").and_then(|value| value.as_text());
        let depth = value("depth").and_then(|value| value.as_integer()).unwrap_or(1);
        (reliable.as_deref() == Some("reliable"), depth as i32)
    }

    /// The configuration that the values make.
    ///
    /// # Errors
    /// The key and the reason.
    pub fn config(&self) -> Result<Config, String> {
        let mut top = Mapping::new();
        for (name, declaration) in &self.declared {
            if is_of_config(name) {
                insert(&mut top, name, declaration.value.to_yaml());
            }
        }
        insert(&mut top, "input.wrenches", self.wrenches()?);
        let text = serde_yaml_ng::to_string(&top).map_err(|error| error.to_string())?;
        let config = Config::parse(&text, Path::new("parameters")).map_err(|error| error.to_string())?;
        for (name, declaration) in self.declared.iter().filter(|(name, _)| name.ends_with(".reliability")) {
            let value = declaration.value.as_text().unwrap_or_default();
            if !["reliable", "best_effort"].contains(&value.as_str()) {
                return Err(format!("`{name}`: `{value}`, expected reliable or best_effort"));
            }
        }
        Ok(config)
    }

    fn wrenches(&self) -> Result<Yaml, String> {
        let topics = self.texts("input.wrenches.topics");
        let parts = self.texts("input.wrenches.parts");
        let reactions = match self.get("input.wrenches.reactions") {
            Some(Value::BoolArray(items)) => items.clone(),
            _ => Vec::new(),
        };
        // One value stands for all topics.
        let of = |index: usize, count: usize| if count == 1 { 0 } else { index };
        let entry = |index: usize, topic: &String| {
            let mut wrench = Mapping::new();
            wrench.insert("topic".into(), topic.clone().into());
            let part = parts.get(of(index, parts.len())).map_or("auto", String::as_str);
            let part = part.parse::<u32>().map_or_else(|_| Yaml::from(part), Yaml::from);
            wrench.insert("part".into(), part);
            wrench
                .insert("reaction".into(), reactions.get(of(index, reactions.len())).copied().unwrap_or(false).into());
            Yaml::Mapping(wrench)
        };
        Ok(Yaml::Sequence(topics.iter().enumerate().map(|(index, topic)| entry(index, topic)).collect()))
    }

    /// What a service says of a parameter.
    pub fn descriptor(&self, name: &str) -> ParameterDescriptor {
        let Some(declaration) = self.declared.get(name) else {
            return ParameterDescriptor { name: name.to_owned(), ..ParameterDescriptor::default() };
        };
        let mut descriptor = ParameterDescriptor {
            name: name.to_owned(),
            type_: declaration.value.type_number(),
            description: declaration.description.clone(),
            additional_constraints: match declaration.change {
                Change::Unconfigured => "can be set only while the node is unconfigured".to_owned(),
                Change::AtStart | Change::Always => String::new(),
            },
            read_only: declaration.change == Change::AtStart,
            ..ParameterDescriptor::default()
        };
        match (&declaration.value, declaration.range) {
            (Value::Integer(_), Some((from, to))) => {
                descriptor.integer_range = vec![IntegerRange { from_value: from as i64, to_value: to as i64, step: 1 }];
            }
            (Value::Double(_), Some((from, to))) => {
                descriptor.floating_point_range =
                    vec![FloatingPointRange { from_value: from, to_value: to, step: 0.0 }];
            }
            _ => {}
        }
        descriptor
    }
}

/// As `qos_overrides.wrench.subscription`.
fn qos_prefix(topic: &str, reads: bool) -> String {
    let side = if reads { "subscription" } else { "publisher" };
    format!("qos_overrides.{}.{side}", topic.trim_start_matches("~/").trim_start_matches('/'))
}

/// A QoS parameter of one of the topics that have them.
fn quality_declaration(name: &str) -> Option<Declaration> {
    QOS_TOPICS.into_iter().find_map(|(topic, reads, reliable, depth)| {
        let policy = name.strip_prefix(&qos_prefix(topic, reads))?;
        let (text, value, range) = match policy {
            ".reliability" => {
                let reliability = if reliable { "reliable" } else { "best_effort" };
                ("QoS: reliable or best_effort.", Value::String(reliability.to_owned()), None)
            }
            ".depth" => ("QoS: how many messages are kept.", Value::Integer(depth), Some((1.0, 100_000.0))),
            _ => return None,
        };
        Some(Declaration::new(text, value, range, Change::AtStart))
    })
}

/// The value that a parameter takes, in its own type.
fn checked(name: &str, declaration: &Declaration, value: &Value) -> Result<Value, String> {
    let value = value
        .in_type_of(&declaration.value)
        .ok_or_else(|| format!("`{name}`: {}, expected {}", value.type_name(), declaration.value.type_name()))?;
    if let (Some(number), Some((from, to))) = (value.as_double(), declaration.range)
        && !(from..=to).contains(&number)
    {
        return Err(format!("`{name}`: {number}, expected {from} to {to}"));
    }
    Ok(value)
}

fn is_of_config(name: &str) -> bool {
    let live = ["root_label", "use_sim_time", "autostart", "publish_tf", "slowest_clouds_hz", "wrench_timeout_s"];
    !live.contains(&name)
        && !["worker_threads", "mesh_folder", "tf_prefix", "realtime"].contains(&name)
        && !name.starts_with("qos_overrides.")
        && !name.starts_with("input.wrenches.")
}

/// The parameter that a key of the configuration becomes; `None` for what is told otherwise: the
/// namespace is the node's.
fn default_value(name: &str, yaml: &Yaml) -> Option<Value> {
    match name {
        "input.namespace" | "input.wrenches" => None,
        "input.ignored_labels" => Some(Value::IntegerArray(Vec::new())),
        _ => Value::from_yaml(yaml),
    }
}

fn insert(top: &mut Mapping, name: &str, value: Yaml) {
    match name.split_once('.') {
        None => {
            top.insert(name.into(), value);
        }
        Some((first, rest)) => {
            let inner = top.entry(first.into()).or_insert_with(|| Yaml::Mapping(Mapping::new()));
            if let Yaml::Mapping(inner) = inner {
                insert(inner, rest, value);
            }
        }
    }
}

/// The comment above each key of a YAML text, by the keys to it joined with dots.
fn documentation(text: &str) -> BTreeMap<String, String> {
    let mut found = BTreeMap::new();
    let (mut path, mut comment): (Vec<(usize, String)>, Vec<&str>) = (Vec::new(), Vec::new());
    for line in text.lines() {
        let trimmed = line.trim_start();
        let indent = line.len() - trimmed.len();
        if let Some(words) = trimmed.strip_prefix('#') {
            comment.push(words.trim());
        } else if let Some((key, _)) = trimmed.split_once(':').filter(|_| !trimmed.starts_with('-')) {
            path.retain(|(depth, _)| *depth < indent);
            path.push((indent, key.to_owned()));
            let name: Vec<&str> = path.iter().map(|(_, key)| key.as_str()).collect();
            // A key without a comment is told of with those above it.
            let above = found.get(&name[..name.len() - 1].join(".")).cloned().unwrap_or_default();
            let text = if comment.is_empty() { above } else { comment.join(" ") };
            found.insert(name.join("."), text);
            comment.clear();
        } else {
            comment.clear();
        }
    }
    found
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names() -> Names {
        Names::new("bom", &Default::default()).unwrap()
    }

    fn given(name: &str, value: Value) -> Override {
        Override { node: "/**".into(), name: name.into(), value, source: "test".into() }
    }

    #[test]
    fn the_defaults_are_the_configuration() {
        assert_eq!(Parameters::declared().config(), Ok(Config::default()));
    }

    #[test]
    fn the_list_of_all_fits_into_a_datagram() {
        // In CDR a text is its length, itself, a zero, and what fills up to four bytes.
        let bytes: usize = Parameters::declared().names().map(|name| 4 + (name.len() + 1).next_multiple_of(4)).sum();
        assert!(bytes < 1200, "{bytes} bytes: see `undeclared`");
    }

    #[test]
    fn every_parameter_is_described() {
        let parameters = Parameters::declared();
        for name in parameters.names() {
            let descriptor = parameters.descriptor(name);
            assert!(descriptor.description.len() > 10, "{name}: `{}`", descriptor.description);
            assert_ne!(descriptor.type_, 0, "{name}");
        }
        let quiet = parameters.descriptor("windows.quiet_s");
        assert_eq!(quiet.description, "It closes after this long without contact and motion [s].");
        assert_eq!(quiet.floating_point_range[0].to_value, 1e6);
        assert!(parameters.descriptor("use_sim_time").read_only);
    }

    #[test]
    fn what_is_given_at_the_start_reaches_the_configuration() {
        let mut parameters = Parameters::declared();
        let other = Override { node: "/other".into(), ..given("seed", Value::Integer(9)) };
        let unusable = parameters.start_with(
            &[
                given("windows.quiet_s", Value::Integer(1)),
                given("input.wrenches.topics", Value::StringArray(vec!["a".into(), "b".into()])),
                given("input.wrenches.parts", Value::StringArray(vec!["auto".into(), "7".into()])),
                given("windows.quiet", Value::Double(1.0)),
                given("windows.smoothing_s", Value::Double(0.0)),
                given("windows.lead_s", Value::String("long".into())),
                given("qos_overrides.wrench.subscription.reliability", Value::String("maybe".into())),
                given("qos_overrides.parts/points.subscription.reliability", Value::String("reliable".into())),
                other,
            ],
            &names(),
        );
        let config = parameters.config().unwrap();
        assert_eq!((config.windows.quiet_s, config.seed), (1.0, 0));
        assert_eq!(config.input.wrenches[1].topic, "b");
        assert_eq!(config.input.wrenches[1].part.label(), Some(Label(7)));
        assert_eq!(parameters.qos("parts/points", true), (true, 2));
        let expected = [
            "unknown parameter `windows.quiet`",
            "parameters: key `windows.smoothing_s`: 0, expected above 0",
            "`windows.lead_s`: string, expected double",
            "`qos_overrides.wrench.subscription.reliability`: `maybe`",
        ];
        for (line, expected) in unusable.iter().zip(expected) {
            assert!(line.starts_with(expected) && line.ends_with("(test)"), "{line}");
        }
        assert_eq!(unusable.len(), expected.len());
    }

    #[test]
    fn changes_are_refused_with_a_reason() {
        let mut parameters = Parameters::declared();
        let mut set = |name: &str, value, unconfigured| parameters.set(&[(name.to_owned(), value)], unconfigured);
        assert_eq!(set("publish_tf", Value::Bool(true), false), Ok(()));
        assert_eq!(set("windows.quiet_s", Value::Double(0.5), true), Ok(()));
        for (name, value, expected) in [
            ("use_sim_time", Value::Bool(true), "`use_sim_time` is read-only"),
            ("windows.quiet_s", Value::Double(0.6), "`windows.quiet_s` can be set only while"),
            ("publish_tf", Value::Integer(1), "`publish_tf`: integer, expected bool"),
            ("wrench_timeout_s", Value::Double(-1.0), "`wrench_timeout_s`: -1, expected 0.01 to 60"),
            ("nothing", Value::Bool(true), "`nothing` is not declared"),
        ] {
            let reason = set(name, value, false).unwrap_err();
            assert!(reason.starts_with(expected), "{reason}");
        }
        let both = [("publish_tf".to_owned(), Value::Bool(false)), ("nothing".to_owned(), Value::Bool(false))];
        assert!(parameters.set(&both, false).is_err());
        assert!(parameters.is("publish_tf"), "all or none");
        assert_eq!(parameters.number("windows.quiet_s"), 0.5);
    }
}
