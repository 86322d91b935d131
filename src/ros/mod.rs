//! What ROS 2 is told, as pure functions from what the core says to messages: no DDS, no clock, no file.

mod convert;
#[cfg(test)]
mod examples;
mod link_tree;
mod markers;
pub mod messages;
mod motion;
mod urdf;

pub use convert::{
    FixedFrame, FutureWrench, MOST_BYTES, PartPrediction, criticism, encoded_bytes, object_posterior, point, pose,
    predicted_part_poses, predicted_poses, time, transform, vector,
};
pub use link_tree::{Link, LinkJoint, LinkTree, joint_name, link_name};
pub use markers::{Picture, markers, no_markers};
pub use motion::{joint_states, link_transforms, place_joints, predicted_frame_name, predicted_transforms};
pub use urdf::{Urdf, UrdfInput, urdf};
