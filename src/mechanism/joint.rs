//! The three ways a part may be joined to its parent.

use serde::{Deserialize, Serialize};

/// How a part moves against its parent.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum JointType {
    /// Not at all.
    Rigid,
    /// Translation along an axis; q in m, forces in N.
    Prismatic,
    /// Rotation about an axis; q in rad, forces in N·m.
    Revolute,
}

impl JointType {
    /// All types, in the order of their discriminants.
    pub const ALL: [Self; 3] = [Self::Rigid, Self::Prismatic, Self::Revolute];

    /// Whether the joint has a coordinate.
    pub fn moves(self) -> bool {
        self != Self::Rigid
    }

    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Rigid => "rigid",
            Self::Prismatic => "prismatic",
            Self::Revolute => "revolute",
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn names_are_those_of_the_files() {
        for joint in JointType::ALL {
            let text = serde_json::to_string(&joint).unwrap();
            assert_eq!(text, format!("\"{}\"", joint.name()));
        }
    }
}
