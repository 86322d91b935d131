//! `bom node`: the live ROS 2 node.

use std::path::PathBuf;

use bayesian_object_models::node::{self, arguments::RosArguments};
use clap::Args;

/// Tracks and learns an object live, as a ROS 2 node
#[derive(Debug, Args)]
pub struct NodeArguments {
    /// Record what is taken in and what is published as a rosbag2 folder, which must not exist; before --ros-args
    #[arg(long, value_name = "FOLDER")]
    record: Option<PathBuf>,
    /// --ros-args and what follows, as ros2 run and ros2 launch give them: -r FROM:=TO, -p NAME:=VALUE,
    /// --params-file FILE, --log-level LEVEL
    #[arg(trailing_var_arg = true, allow_hyphen_values = true, value_name = "ROS_ARGUMENTS")]
    ros: Vec<String>,
}

impl NodeArguments {
    /// What the ROS arguments say.
    pub fn parse(&self) -> anyhow::Result<RosArguments> {
        Ok(RosArguments::parse(&self.ros)?)
    }
}

/// Runs it.
pub fn run(arguments: &NodeArguments, ros: &RosArguments) -> anyhow::Result<()> {
    node::run(ros, arguments.record.as_deref())
}
