//! The one state machine that the node and the replay share.

mod explain;
mod learner;
mod windows;

pub use explain::Frame;
pub use learner::{Learner, ParentEvidence, WindowJob};
pub use windows::{FrameAssembler, WindowCutter, WindowSettings};
