//! stub until merged
mod joint;
pub use joint::JointType;
