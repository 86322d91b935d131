//! Which topic is what, by configuration, and which of those wanted a bag lacks.

use std::fmt;

use super::{
    bag::BagSummary,
    config::InputConfig,
    messages::{POINT_CLOUD_TYPE, POSE_TYPE, TF_TYPE, WRENCH_TYPE},
};
use crate::types::Label;

/// What a topic is to us.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Role {
    /// Segmented clouds.
    Cloud,
    /// The wrench topic of this index in the configuration.
    Wrench(usize),
    /// Wrenches on this part.
    PartWrench(Label),
    /// Poses of this part.
    Pose(Label),
    /// Moving transforms.
    Tf,
    /// Fixed transforms.
    TfStatic,
}

impl Role {
    /// The role of an absolute topic name, if it has one.
    pub fn of(topic: &str, config: &InputConfig) -> Option<Self> {
        let is = |name: &String| config.absolute(name) == topic;
        if config.clouds.iter().any(is) {
            return Some(Self::Cloud);
        }
        if let Some(index) = config.wrenches.iter().position(|wrench| is(&wrench.topic)) {
            return Some(Self::Wrench(index));
        }
        match topic {
            _ if is(&config.tf) => Some(Self::Tf),
            _ if is(&config.tf_static) => Some(Self::TfStatic),
            _ => {
                let pose = config.pose_label(topic).map(Self::Pose);
                pose.or_else(|| config.part_wrench_label(topic).map(Self::PartWrench))
            }
        }
    }

    /// The message type that such a topic must have.
    pub fn type_name(self) -> &'static str {
        match self {
            Self::Cloud => POINT_CLOUD_TYPE,
            Self::Wrench(_) | Self::PartWrench(_) => WRENCH_TYPE,
            Self::Pose(_) => POSE_TYPE,
            Self::Tf | Self::TfStatic => TF_TYPE,
        }
    }
}

/// Topics that configuration names and a bag does not have.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct MissingTopics {
    /// Absolute names, with the type expected.
    pub missing: Vec<(String, &'static str)>,
    /// What the bag has, with types.
    pub present: Vec<(String, String)>,
    /// There is no cloud and no pose in the bag: nothing can be learned from it.
    pub nothing_to_see: bool,
}

impl MissingTopics {
    /// Compares configuration and bag; `None` if all is there. Poses stand in for clouds and the
    /// other way round, a part's own wrench for a tool's; transforms are not missed, as clouds may come in the fixed frame. A topic
    /// without messages is as good as none.
    pub fn of(config: &InputConfig, bag: &BagSummary) -> Option<Self> {
        let mut roles = Vec::new();
        for (topic, count) in &bag.topics {
            if let Some(role) = Role::of(&topic.name, config).filter(|_| *count > 0) {
                roles.push((topic.name.as_str(), role));
            }
        }
        let has_poses = roles.iter().any(|(_, role)| matches!(role, Role::Pose(_)));
        let has_clouds = roles.iter().any(|(_, role)| *role == Role::Cloud);
        let mut missing = Vec::new();
        let mut require = |name: &String, type_name| {
            let name = config.absolute(name);
            if !roles.iter().any(|(present, _)| *present == name) {
                missing.push((name, type_name));
            }
        };
        if !has_poses {
            config.clouds.iter().for_each(|name| require(name, POINT_CLOUD_TYPE));
        }
        if !roles.iter().any(|(_, role)| matches!(role, Role::PartWrench(_))) {
            config.wrenches.iter().for_each(|wrench| require(&wrench.topic, WRENCH_TYPE));
        }
        if missing.is_empty() && (has_clouds || has_poses) {
            return None;
        }
        let present = bag.topics.iter().map(|(topic, _)| (topic.name.clone(), topic.type_name.clone()));
        let nothing_to_see = !has_clouds && !has_poses;
        Some(Self { missing, present: present.collect(), nothing_to_see })
    }
}

impl fmt::Display for MissingTopics {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let list = |topics: Vec<String>| match topics.is_empty() {
            true => "none".to_owned(),
            false => topics.join(", "),
        };
        let missing = self.missing.iter().map(|(name, type_name)| format!("{name} ({type_name})"));
        let present = self.present.iter().map(|(name, type_name)| format!("{name} ({type_name})"));
        write!(f, "no messages on {}; the bag has: {}", list(missing.collect()), list(present.collect()))
    }
}
