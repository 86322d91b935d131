//! Where every part is and will be: a filter over the joints of the likeliest tree, and simulation.
//!
//! What is learned of a part decides how it is predicted. Nothing: constant velocity, shrunk to rest
//! where nothing touches it ([`FreePart`]). A joint: the filter's position and rate, simulated on under
//! the applied wrench at the carried contact point ([`Filter`], [`Filter::forecast`]).

mod calibration;
mod filter;
mod forecast;
mod free;
mod mechanism;
mod mixture;
mod plan;
mod presence;
mod simulation;
mod skill;
#[cfg(test)]
mod tests;

pub use calibration::{Calibration, Kind};
pub use filter::{Filter, Held};
pub use forecast::Forecast;
pub use free::FreePart;
pub use mechanism::{ActiveNumber, Carried, TrackedMechanism, TreeFamily};
pub use mixture::{FreeAccount, JointAccount, Mixed, mixture};
pub use plan::{Plan, PlannedPose};
pub use presence::{Account, INDEPENDENT, Presence};
pub use skill::Skill;
