//! What came in, what was dropped and why: the `counters` of posterior.json, and one line per cause.

use std::{collections::BTreeMap, fmt};

use serde::{Deserialize, Serialize};

use super::bag::Damage;
use crate::types::Stamp;

/// How many, by reason.
pub type ByReason = BTreeMap<String, u64>;

/// Everything counted while reading.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct Counters {
    /// Cloud messages that arrived.
    pub clouds_in: u64,
    /// Of these, not used.
    pub clouds_dropped: ByReason,
    /// Points in the clouds used.
    pub points_in: u64,
    /// Of the points that arrived, left out of a cloud.
    pub points_dropped: ByReason,
    /// Wrench messages that arrived.
    pub wrenches_in: u64,
    /// Of these, not used.
    pub wrenches_dropped: ByReason,
    /// Pose messages that arrived.
    pub poses_in: u64,
    /// Of these, not used.
    pub poses_dropped: ByReason,
    /// Transforms that arrived (a message can hold several).
    pub tf_in: u64,
    /// Of these, not used; a message that cannot be decoded counts as one.
    pub tf_dropped: ByReason,
    /// Places where the bag was damaged.
    pub bag_damage: ByReason,
}

impl Counters {
    /// With the damage of a bag counted in, by kind.
    #[must_use]
    pub fn with_damage(mut self, damage: &[Damage]) -> Self {
        for place in damage {
            Self::add(&mut self.bag_damage, place.kind.kind(), 1);
        }
        self
    }

    /// Adds `count` to a reason; a reason with nothing to count is not entered.
    pub fn add(reasons: &mut ByReason, reason: &str, count: u64) {
        if count > 0 {
            *reasons.entry(reason.to_owned()).or_default() += count;
        }
    }
}

/// The first message that was dropped for a cause; later ones of the same topic are only counted.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Diagnostic {
    /// The topic, absolute.
    pub topic: String,
    /// The message's stamp, if it could be read.
    pub stamp: Option<Stamp>,
    /// The reason's short name, as in [`Counters`].
    pub kind: &'static str,
    /// What was expected, what was there.
    pub reason: String,
}

impl fmt::Display for Diagnostic {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self.stamp {
            Some(stamp) => write!(f, "{}, stamp {:.3} s: {}", self.topic, stamp.0 as f64 * 1e-9, self.reason),
            None => write!(f, "{}: {}", self.topic, self.reason),
        }
    }
}
