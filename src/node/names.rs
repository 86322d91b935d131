//! Names of topics and services: relative, private and absolute, and what remaps make of them.
//!
//! <https://design.ros2.org/articles/topic_and_service_names.html>

use thiserror::Error;

use super::arguments::{Remap, RosArguments};

/// Why a node cannot have a name.
#[derive(Debug, Error, PartialEq)]
#[error("`{name}` is no name: expected letters, digits and underscores, not beginning with a digit")]
pub struct NameError {
    name: String,
}

/// The node's own name, and the rules for all others.
#[derive(Clone, Debug, PartialEq)]
pub struct Names {
    /// As `/arm`; `/` at the top.
    pub namespace: String,
    /// As `bom`.
    pub node: String,
    remaps: Vec<Remap>,
}

impl Names {
    /// The names of a node called `node` unless the arguments say otherwise.
    ///
    /// # Errors
    /// A node name or a namespace that is none.
    pub fn new(node: &str, arguments: &RosArguments) -> Result<Self, NameError> {
        let name = arguments.special("__node", node).unwrap_or(node);
        let namespace = arguments.special("__ns", node).unwrap_or("/").trim_matches('/');
        let tokens = namespace.split('/').filter(|token| !token.is_empty()).chain([name]);
        for token in tokens {
            if !is_token(token) {
                return Err(NameError { name: token.to_owned() });
            }
        }
        let for_this = |rule: &&Remap| rule.node.as_deref().is_none_or(|only| only == node || only == name);
        let remaps = arguments.remaps.iter().filter(for_this).filter(|rule| !rule.from.starts_with("__"));
        Ok(Self { namespace: format!("/{namespace}"), node: name.to_owned(), remaps: remaps.cloned().collect() })
    }

    /// As `/arm/bom`.
    pub fn full(&self) -> String {
        format!("{}/{}", self.namespace.trim_end_matches('/'), self.node)
    }

    /// The absolute name on the network of a name in the code: `wrench`, `~/markers`, `/tf`. The first
    /// rule that matches counts, as in rcl.
    pub fn resolve(&self, name: &str) -> String {
        let absolute = self.expand(name);
        let rule = self.remaps.iter().find(|rule| self.expand(&rule.from) == absolute);
        rule.map_or(absolute, |rule| self.expand(&rule.to))
    }

    /// The absolute name, not remapped.
    pub fn expand(&self, name: &str) -> String {
        let namespace = self.namespace.trim_end_matches('/');
        match (name.strip_prefix('~'), name.starts_with('/')) {
            (Some(private), _) => format!("{}/{}", self.full(), private.trim_start_matches('/')),
            (None, true) => name.to_owned(),
            (None, false) => format!("{namespace}/{name}"),
        }
    }

    /// Whether a pattern as in a parameter file matches this node: `*` is one token, `**` any number.
    pub fn matched_by(&self, pattern: &str) -> bool {
        let full = self.full();
        let name: Vec<&str> = full.split('/').filter(|token| !token.is_empty()).collect();
        let pattern: Vec<&str> = pattern.split('/').filter(|token| !token.is_empty()).collect();
        matches(&pattern, &name)
    }
}

fn matches(pattern: &[&str], name: &[&str]) -> bool {
    match pattern.split_first() {
        None => name.is_empty(),
        Some((&"**", rest)) => (0..=name.len()).any(|skip| matches(rest, &name[skip..])),
        Some((first, rest)) => {
            name.split_first().is_some_and(|(token, others)| (*first == "*" || first == token) && matches(rest, others))
        }
    }
}

/// Whether a part of a name between slashes is well formed.
pub fn is_token(token: &str) -> bool {
    let legal = |c: char| c.is_ascii_alphanumeric() || c == '_';
    token.starts_with(|c: char| c.is_ascii_alphabetic() || c == '_') && token.chars().all(legal)
}

#[cfg(test)]
mod tests {
    use super::*;

    fn names(text: &str) -> Result<Names, NameError> {
        let arguments: Vec<String> =
            ["--ros-args"].into_iter().chain(text.split_whitespace()).map(str::to_owned).collect();
        Names::new("bom", &RosArguments::parse(&arguments).unwrap())
    }

    #[test]
    fn names_resolve_as_in_rcl() {
        let top = names("").unwrap();
        assert_eq!(top.full(), "/bom");
        assert_eq!(top.resolve("wrench"), "/wrench");
        assert_eq!(top.resolve("~/markers"), "/bom/markers");
        let arm = names("-r __ns:=/arm -r __node:=b -r wrench:=ft/raw -r ~/markers:=/m -r other:wrench:=no").unwrap();
        assert_eq!(arm.full(), "/arm/b");
        assert_eq!(arm.resolve("wrench"), "/arm/ft/raw");
        assert_eq!(arm.resolve("/arm/wrench"), "/arm/ft/raw");
        assert_eq!(arm.resolve("~/markers"), "/m");
        assert_eq!(arm.resolve("~/criticism"), "/arm/b/criticism");
        assert_eq!(arm.resolve("/tf"), "/tf");
    }

    #[test]
    fn names_that_are_none_are_refused() {
        assert_eq!(names("-r __node:=2b").unwrap_err().to_string().split(':').next(), Some("`2b` is no name"));
        assert!(names("-r __ns:=/a-b").is_err());
    }

    #[test]
    fn patterns_of_parameter_files() {
        let arm = names("-r __ns:=/arm/left").unwrap();
        for pattern in ["/**", "**", "/arm/left/bom", "arm/left/bom", "/arm/*/bom", "/**/bom", "/arm/**"] {
            assert!(arm.matched_by(pattern), "{pattern}");
        }
        for pattern in ["bom", "/bom", "/*", "/arm/bom", "/arm/left/other"] {
            assert!(!arm.matched_by(pattern), "{pattern}");
        }
    }
}
