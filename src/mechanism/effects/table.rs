//! An effect without a formula: a force, a friction bound or a damping tabulated over one argument.
//!
//! Linear between nodes, constant beyond them. What no named law explains is described by one of
//! these; over many nodes it is also the signature that named laws are compared with.

use std::sync::Arc;

use serde::{Deserialize, Serialize};

use super::super::parameters::JointForces;
use super::super::rollout::Reach;
use super::{Dimension, JointState};
use crate::math::Real;

/// What is tabulated, and over what.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum TableKind {
    /// A force over the joint's position.
    ForceOverPosition,
    /// A force over the joint's rate.
    ForceOverRate,
    /// A force over time.
    ForceOverTime,
    /// A change of the friction bound over the joint's position.
    FrictionOverPosition,
    /// A change of the friction bound over time.
    FrictionOverTime,
    /// Damping over position, while the joint closes.
    ClosingDamping,
    /// A change of inertia m over position: the force −m q̈ − ½ m′ q̇².
    InertiaOverPosition,
}

impl TableKind {
    /// What the argument measures.
    pub fn argument(self) -> Dimension {
        match self {
            Self::ForceOverRate => Dimension::Rate,
            Self::ForceOverTime | Self::FrictionOverTime => Dimension::Time,
            Self::ForceOverPosition | Self::FrictionOverPosition | Self::ClosingDamping | Self::InertiaOverPosition => {
                Dimension::Position
            }
        }
    }

    /// What the entries measure; an inertia is in units of force per rate and second.
    pub fn entry(self) -> Dimension {
        match self {
            Self::ClosingDamping => Dimension::Damping,
            Self::InertiaOverPosition => Dimension::Inertia,
            _ => Dimension::Force,
        }
    }
}

/// The arguments between which an entry of a table matters.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct TableSpan {
    argument: Dimension,
    least: f64,
    greatest: f64,
}

impl TableSpan {
    /// Of the entry at one of the `nodes`.
    pub fn of_node(kind: TableKind, nodes: &[f64], node: usize) -> Self {
        // Beyond its ends a table goes on as there.
        let least = node.checked_sub(1).map_or(f64::NEG_INFINITY, |before| nodes[before]);
        let greatest = nodes.get(node + 1).copied().unwrap_or(f64::INFINITY);
        Self { argument: kind.argument(), least, greatest }
    }

    /// Whether a joint that goes so far in `span_s` comes within `margin` of it.
    pub fn meets(&self, reach: &Reach, span_s: [f64; 2], margin: f64) -> bool {
        let [least, greatest] = match self.argument {
            Dimension::Position => reach.position,
            Dimension::Rate => reach.rate,
            _ => span_s,
        };
        least - margin <= self.greatest && greatest + margin >= self.least
    }
}

/// A table on one joint, in the joint's own direction.
#[derive(Clone, Debug, PartialEq)]
pub struct AttachedTable<T: Real> {
    /// What it tabulates.
    pub kind: TableKind,
    /// Arguments, ascending \[m or rad, m/s or rad/s, s\].
    pub nodes: Arc<[f64]>,
    /// An entry per node, in the units of [`TableKind::entry`].
    pub values: Vec<T>,
    /// Whether the joint opens as q falls.
    pub reversed: bool,
}

impl<T: Real> AttachedTable<T> {
    /// The entry at `argument` and its slope.
    fn at(&self, argument: T) -> (T, T) {
        let (Some(first), Some(last)) = (self.values.first(), self.values.last()) else {
            return (T::zero(), T::zero());
        };
        let after = self.nodes.partition_point(|node| *node <= argument.value());
        if after == 0 {
            return (*first, T::zero());
        }
        if after >= self.nodes.len() {
            return (*last, T::zero());
        }
        let (low, high) = (self.values[after - 1], self.values[after]);
        let slope = (high - low) * T::constant(1.0 / (self.nodes[after] - self.nodes[after - 1]));
        (low + slope * (argument - T::constant(self.nodes[after - 1])), slope)
    }

    /// `forces` with the table's on top.
    pub fn apply(&self, joint: &JointState<T>, mut forces: JointForces<T>) -> JointForces<T> {
        match self.kind {
            TableKind::ForceOverPosition => forces.force += self.at(joint.position).0,
            TableKind::ForceOverRate => forces.force += self.at(joint.rate).0,
            TableKind::ForceOverTime => forces.force += self.at(T::constant(joint.time_s)).0,
            TableKind::FrictionOverPosition | TableKind::FrictionOverTime => {
                let over_time = self.kind == TableKind::FrictionOverTime;
                let change = self.at(if over_time { T::constant(joint.time_s) } else { joint.position }).0;
                let bound = |declared: T| {
                    let bound = declared + change;
                    if bound.value() > 0.0 { bound } else { T::zero() }
                };
                forces.friction.against_plus = bound(forces.friction.against_plus);
                forces.friction.against_minus = bound(forces.friction.against_minus);
            }
            TableKind::ClosingDamping => {
                if (joint.rate.value() < 0.0) != self.reversed && joint.rate.value() != 0.0 {
                    forces.damping += self.at(joint.position).0;
                }
            }
            TableKind::InertiaOverPosition => {
                let (inertia, slope) = self.at(joint.position);
                forces.force -= inertia * joint.acceleration + slope * joint.rate * joint.rate * T::constant(0.5);
            }
        }
        forces
    }
}

#[cfg(test)]
mod tests {
    use super::super::super::friction::FrictionBounds;
    use super::*;
    use crate::math::gradient::assert_gradient;
    use num_dual::DualSVec64;

    #[test]
    fn every_table_has_its_gradient() {
        for kind in [
            TableKind::ForceOverPosition,
            TableKind::ForceOverRate,
            TableKind::ForceOverTime,
            TableKind::FrictionOverPosition,
            TableKind::FrictionOverTime,
            TableKind::ClosingDamping,
            TableKind::InertiaOverPosition,
        ] {
            for reversed in [false, true] {
                type Dual = DualSVec64<5>;
                let law = |x: &[Dual; 5]| {
                    let values = vec![x[0], x[1], x[2]];
                    let table = AttachedTable { kind, nodes: [-0.4, 0.0, 0.6].into(), values, reversed };
                    let joint = JointState {
                        position: x[3],
                        rate: x[4],
                        acceleration: Dual::constant(0.7),
                        time_s: 0.1,
                        step_s: 1e-3,
                    };
                    let declared = JointForces {
                        force: Dual::constant(0.0),
                        damping: Dual::constant(2.0),
                        friction: FrictionBounds::symmetric(Dual::constant(3.0)),
                    };
                    let with = table.apply(&joint, declared);
                    with.force - with.damping * joint.rate - with.friction.against_plus
                };
                for state in [[0.3, 0.2], [-0.1, -0.3], [0.9, 0.1]] {
                    assert_gradient(law, &[0.4, -0.2, 0.5, state[0], state[1]], 1e-6, 1e-6);
                }
            }
        }
    }

    #[test]
    fn entries_matter_between_their_neighbours() {
        let span = |node| TableSpan::of_node(TableKind::ForceOverPosition, &[0.0, 1.0, 3.0], node);
        let meets = |node, position| span(node).meets(&Reach { position, rate: [0.0; 2] }, [0.0; 2], 0.0);
        assert_eq!([0, 1, 2].map(|node| meets(node, [1.5, 2.0])), [false, true, true]);
        assert_eq!([0, 1, 2].map(|node| meets(node, [-5.0, -4.0])), [true, false, false]);
        assert_eq!([0, 1, 2].map(|node| meets(node, [0.5, 1.5])), [true; 3]);
    }

    #[test]
    fn linear_between_nodes_constant_beyond() {
        let table = AttachedTable {
            kind: TableKind::ForceOverPosition,
            nodes: [0.0, 1.0, 3.0].into(),
            values: vec![1.0, 2.0, 0.0],
            reversed: false,
        };
        assert_eq!([-1.0, 0.5, 2.0, 9.0].map(|x| table.at(x).0), [1.0, 1.5, 1.0, 0.0]);
    }
}
