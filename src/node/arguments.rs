//! The arguments that `ros2 run` and `ros2 launch` give a node: `--ros-args`.
//!
//! As in rcl: `-r [NODE:]FROM:=TO`, `-p [NODE:]NAME:=VALUE`, `--params-file`, `--log-level`; what is
//! given later counts. What is not understood is an error, never passed over.

use std::{fs, path::PathBuf};

use serde_yaml_ng::Value as Yaml;
use thiserror::Error;

use super::value::Value;

/// What is wrong with the arguments.
#[derive(Debug, Error, PartialEq)]
pub enum ArgumentError {
    /// Not one of those known.
    #[error("unknown argument `{0}`")]
    Unknown(String),
    /// An argument that needs a value has none.
    #[error("`{0}` needs a value after it")]
    Missing(String),
    /// Not `FROM:=TO` or `NAME:=VALUE`.
    #[error("`{flag} {text}`: expected {expected}")]
    Malformed {
        /// As `-r`.
        flag: String,
        /// What came after it.
        text: String,
        /// What should have.
        expected: &'static str,
    },
    /// A parameter file that cannot be used.
    #[error("{}: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        reason: String,
    },
}

/// A rule that gives a name another.
#[derive(Clone, Debug, PartialEq)]
pub struct Remap {
    /// The node that it is for; `None`: any.
    pub node: Option<String>,
    /// The name in the code, as `wrench` or `~/markers`.
    pub from: String,
    /// The name on the network.
    pub to: String,
}

/// A value for a parameter, for the nodes that a pattern matches.
#[derive(Clone, Debug, PartialEq)]
pub struct Override {
    /// As `/**` or `/arm/bom`.
    pub node: String,
    /// Parameter, as `windows.quiet_s`.
    pub name: String,
    /// Its value.
    pub value: Value,
    /// Where it was given, for messages.
    pub source: String,
}

/// All that was given, in order.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct RosArguments {
    /// Names.
    pub remaps: Vec<Remap>,
    /// Parameters.
    pub overrides: Vec<Override>,
    /// As `debug`.
    pub log_level: Option<String>,
    /// Logs go to /rosout unless switched off.
    pub rosout_disabled: bool,
}

impl RosArguments {
    /// Reads the arguments after `bom node`, and the parameter files that they name.
    ///
    /// # Errors
    /// The first argument that is not understood, or a file that cannot be read.
    pub fn parse(arguments: &[String]) -> Result<Self, ArgumentError> {
        let mut parsed = Self::default();
        let mut inside = false;
        let mut rest = arguments.iter();
        while let Some(argument) = rest.next() {
            match argument.as_str() {
                "--ros-args" => inside = true,
                "--" => inside = false,
                flag if inside => {
                    let mut value = || rest.next().ok_or_else(|| ArgumentError::Missing(flag.to_owned()));
                    parsed.take(flag, &mut value)?;
                }
                other => return Err(ArgumentError::Unknown(other.to_owned())),
            }
        }
        Ok(parsed)
    }

    fn take<'a>(
        &mut self,
        flag: &str,
        value: &mut dyn FnMut() -> Result<&'a String, ArgumentError>,
    ) -> Result<(), ArgumentError> {
        match flag {
            "-r" | "--remap" => self.remaps.push(remap(flag, value()?)?),
            "-p" | "--param" => self.overrides.push(parameter(flag, value()?)?),
            "--params-file" => self.overrides.extend(parameters_of_file(PathBuf::from(value()?))?),
            "--log-level" => {
                let text = value()?;
                // `NAME:=LEVEL` is for one logger; there is one.
                let level = text.split_once(":=").map_or(text.as_str(), |(_, level)| level);
                self.log_level = Some(level.to_lowercase());
            }
            "--enable-rosout-logs" => self.rosout_disabled = false,
            "--disable-rosout-logs" => self.rosout_disabled = true,
            // Standard error has the logs in any case, and no file has them.
            "--enable-stdout-logs" | "--disable-external-lib-logs" => {}
            _ => return Err(ArgumentError::Unknown(flag.to_owned())),
        }
        Ok(())
    }

    /// What a rule of this name says, as `__ns`; the last that is for the node.
    pub fn special(&self, name: &str, node: &str) -> Option<&str> {
        let applies = |rule: &&Remap| rule.from == name && rule.node.as_deref().is_none_or(|only| only == node);
        self.remaps.iter().rfind(applies).map(|rule| rule.to.as_str())
    }
}

fn remap(flag: &str, text: &str) -> Result<Remap, ArgumentError> {
    let malformed =
        || ArgumentError::Malformed { flag: flag.to_owned(), text: text.to_owned(), expected: "[NODE:]FROM:=TO" };
    let (from, to) = text.split_once(":=").ok_or_else(malformed)?;
    let (node, from) = match from.split_once(':') {
        Some((node, from)) if !from.starts_with("//") => (Some(node.to_owned()), from),
        _ => (None, from),
    };
    let strip = |name: &str| name.trim_start_matches("rostopic://").trim_start_matches("rosservice://").to_owned();
    let (from, to) = (strip(from), strip(to));
    if from.is_empty() || to.is_empty() {
        return Err(malformed());
    }
    // `__name` is the older spelling.
    let from = if from == "__name" { "__node".to_owned() } else { from };
    Ok(Remap { node, from, to })
}

fn parameter(flag: &str, text: &str) -> Result<Override, ArgumentError> {
    let malformed = |expected| ArgumentError::Malformed { flag: flag.to_owned(), text: text.to_owned(), expected };
    let (name, value) = text.split_once(":=").ok_or_else(|| malformed("[NODE:]NAME:=VALUE"))?;
    let (node, name) = name.split_once(':').unwrap_or(("/**", name));
    let yaml: Yaml = serde_yaml_ng::from_str(value).map_err(|_| malformed("a YAML value"))?;
    let value = Value::from_yaml(&yaml).ok_or_else(|| malformed("a value or a list of one type"))?;
    Ok(Override { node: node.to_owned(), name: name.to_owned(), value, source: format!("{flag} {text}") })
}

fn parameters_of_file(path: PathBuf) -> Result<Vec<Override>, ArgumentError> {
    let fail = |reason: String| ArgumentError::File { path: path.clone(), reason };
    let text = fs::read_to_string(&path).map_err(|error| fail(error.to_string()))?;
    let yaml: Yaml = serde_yaml_ng::from_str(&text).map_err(|error| fail(error.to_string()))?;
    let mut found = Vec::new();
    nodes_of(&yaml, "", &path.display().to_string(), &mut found).map_err(fail)?;
    Ok(found)
}

/// Every `ros__parameters` block, its node's name from the keys above it.
fn nodes_of(yaml: &Yaml, node: &str, source: &str, found: &mut Vec<Override>) -> Result<(), String> {
    let Yaml::Mapping(mapping) = yaml else {
        return Err(format!("`{node}`: expected nodes with `ros__parameters` in them"));
    };
    for (key, content) in mapping {
        let Some(key) = key.as_str() else { return Err(format!("`{node}`: a key is no text")) };
        if key == "ros__parameters" {
            flatten(content, "", &mut |name, value| {
                let value =
                    Value::from_yaml(value).ok_or_else(|| format!("`{name}`: not a value or a list of one type"))?;
                let node = if node.is_empty() { "/**" } else { node };
                let (node, name) = (node.to_owned(), name.to_owned());
                found.push(Override { node, name, value, source: source.to_owned() });
                Ok(())
            })?;
        } else {
            let name = key.trim_matches('/');
            nodes_of(content, &format!("{node}/{name}"), source, found)?;
        }
    }
    Ok(())
}

/// Calls `each` for every value, its name the keys to it joined by dots.
pub(super) fn flatten(
    yaml: &Yaml,
    prefix: &str,
    each: &mut dyn FnMut(&str, &Yaml) -> Result<(), String>,
) -> Result<(), String> {
    match yaml {
        Yaml::Mapping(mapping) => mapping.iter().try_for_each(|(key, content)| {
            let key = key.as_str().ok_or_else(|| format!("`{prefix}`: a key is no text"))?;
            let name = if prefix.is_empty() { key.to_owned() } else { format!("{prefix}.{key}") };
            flatten(content, &name, each)
        }),
        Yaml::Null if prefix.is_empty() => Ok(()),
        value => each(prefix, value),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn parse(text: &str) -> Result<RosArguments, ArgumentError> {
        RosArguments::parse(&text.split_whitespace().map(str::to_owned).collect::<Vec<_>>())
    }

    #[test]
    fn what_launch_passes_is_understood() {
        let parsed = parse(
            "--ros-args -r __node:=tracker -r __ns:=/arm --remap bom:wrench:=ft/wrench -p windows.quiet_s:=0.5 \
             -p bom:input.clouds:=[a,b] --log-level bom:=DEBUG -- --ros-args --disable-rosout-logs",
        )
        .unwrap();
        assert_eq!(parsed.special("__node", "bom"), Some("tracker"));
        assert_eq!(parsed.special("__ns", "bom"), Some("/arm"));
        assert_eq!(parsed.remaps[2].node.as_deref(), Some("bom"));
        assert_eq!((parsed.remaps[2].from.as_str(), parsed.remaps[2].to.as_str()), ("wrench", "ft/wrench"));
        assert_eq!(parsed.overrides[0].value, Value::Double(0.5));
        assert_eq!(parsed.overrides[1].value, Value::StringArray(vec!["a".into(), "b".into()]));
        assert_eq!(parsed.overrides[1].node, "bom");
        assert_eq!(parsed.log_level.as_deref(), Some("debug"));
        assert!(parsed.rosout_disabled);
        assert_eq!(parse(""), Ok(RosArguments::default()));
    }

    #[test]
    fn what_is_not_understood_is_named() {
        for (text, expected) in [
            ("wrench", "unknown argument `wrench`"),
            ("--ros-args --frobnicate", "unknown argument `--frobnicate`"),
            ("--ros-args -r", "`-r` needs a value after it"),
            ("--ros-args -r wrench", "`-r wrench`: expected [NODE:]FROM:=TO"),
            ("--ros-args -p x:=[1,a]", "`-p x:=[1,a]`: expected a value or a list of one type"),
            ("--ros-args --params-file /nowhere.yaml", "/nowhere.yaml: No such file"),
        ] {
            let message = parse(text).unwrap_err().to_string();
            assert!(message.starts_with(expected), "{message}");
        }
    }

    #[test]
    fn parameter_files_name_their_nodes() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("p.yaml");
        let text = "/**:\n  ros__parameters:\n    windows: {quiet_s: 0.5}\narm:\n  bom:\n    ros__parameters:\n      \
                    root_label: 3\n/arm/bom:\n  ros__parameters: {use_sim_time: true}\n";
        fs::write(&path, text).unwrap();
        let parsed = parse(&format!("--ros-args --params-file {}", path.display())).unwrap();
        let given: Vec<_> = parsed.overrides.iter().map(|o| (o.node.as_str(), o.name.as_str())).collect();
        assert_eq!(given, [("/**", "windows.quiet_s"), ("/arm/bom", "root_label"), ("/arm/bom", "use_sim_time")]);
        fs::write(&path, "a: 3").unwrap();
        let message = parse(&format!("--ros-args --params-file {}", path.display())).unwrap_err().to_string();
        assert!(message.contains("`/a`: expected nodes with `ros__parameters`"), "{message}");
    }
}
