//! What ROS 2 is told, as pure functions from what the core says to messages: no DDS, no clock, no file.

mod convert;
pub mod messages;

pub use convert::{
    FixedFrame, FutureWrench, MOST_BYTES, PartPrediction, criticism, encoded_bytes, object_posterior, point, pose,
    predicted_part_poses, predicted_poses, time, transform, vector,
};
