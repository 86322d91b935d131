//! Where the links are and will be: joint states and tf.

use std::collections::BTreeMap;

use ros2_interfaces_jazzy_serde::{
    geometry_msgs::msg::TransformStamped, sensor_msgs::msg::JointState, tf2_msgs::msg::TFMessage,
};

use super::convert::{FixedFrame, PartPrediction, transform};
use super::link_tree::{LinkTree, joint_name, link_name};
use crate::math::Pose;
use crate::types::{Label, Stamp};

/// `~/joint_states`: positions \[m or rad\] of the joints that move, 0 where not given; rates \[m/s or
/// rad/s\] only if all are given, as the message has them for all or none. Not finite: left out.
pub fn joint_states(
    tree: &LinkTree,
    positions: &BTreeMap<Label, f64>,
    rates: &BTreeMap<Label, f64>,
    frame: &FixedFrame,
    stamp: Stamp,
) -> JointState {
    let value = |of: &BTreeMap<Label, f64>, label| of.get(label).copied().filter(|x| x.is_finite());
    let moving: Vec<Label> = tree.moving().map(|(link, _)| link.label).collect();
    let velocity: Option<Vec<f64>> = moving.iter().map(|label| value(rates, label)).collect();
    JointState {
        header: frame.header(stamp),
        name: moving.iter().map(|label| joint_name(*label)).collect(),
        position: moving.iter().map(|label| value(positions, label).unwrap_or_default()).collect(),
        velocity: velocity.unwrap_or_default(),
        effort: Vec::new(),
    }
}

/// Says of predictions where their joints are, each horizon by itself; parts that float have none.
pub fn place_joints(tree: &LinkTree, predictions: &mut [PartPrediction]) {
    let mut horizons: BTreeMap<u64, BTreeMap<Label, Pose>> = BTreeMap::new();
    for prediction in &*predictions {
        let parts = horizons.entry(prediction.horizon_s.to_bits()).or_default();
        parts.insert(prediction.label, prediction.displacement);
    }
    let positions: BTreeMap<u64, BTreeMap<Label, f64>> =
        horizons.iter().map(|(horizon, parts)| (*horizon, tree.positions(parts, &BTreeMap::new()))).collect();
    for prediction in predictions {
        let found = positions.get(&prediction.horizon_s.to_bits());
        prediction.joint_position = found.and_then(|found| found.get(&prediction.label).copied());
    }
}

/// The frame of a part's link as it will be in `horizon_s`.
pub fn predicted_frame_name(label: Label, horizon_s: f64) -> String {
    format!("{}_in_{:.0}_ms", link_name(label), 1e3 * horizon_s)
}

/// `/tf`: the links' frames now, by the parts' displacements since the first frame; parts without one stand
/// still. The same that robot_state_publisher makes of URDF and joint states, unless the parts are not
/// quite where the joints say.
pub fn link_transforms(
    tree: &LinkTree,
    displacements: &BTreeMap<Label, Pose>,
    frame: &FixedFrame,
    stamp: Stamp,
) -> TFMessage {
    let of = |label| displacements.get(&label).copied().unwrap_or_else(Pose::identity);
    let transforms = tree.links().iter().map(|link| {
        let world_from_link = of(link.label) * Pose::from_translation(link.origin);
        stamped(&world_from_link, link_name(link.label), frame, stamp)
    });
    TFMessage { transforms: transforms.filter(is_finite).collect() }
}

/// `/tf`: the links' frames as they will be, named by [`predicted_frame_name`], with the stamp that the
/// prediction starts from.
pub fn predicted_transforms(
    tree: &LinkTree,
    predictions: &[PartPrediction],
    frame: &FixedFrame,
    stamp: Stamp,
) -> TFMessage {
    let transforms = predictions.iter().filter_map(|prediction| {
        let link = tree.links().iter().find(|link| link.label == prediction.label)?;
        let world_from_link = prediction.displacement * Pose::from_translation(link.origin);
        let name = predicted_frame_name(prediction.label, prediction.horizon_s);
        Some(stamped(&world_from_link, name, frame, stamp))
    });
    TFMessage { transforms: transforms.filter(is_finite).collect() }
}

fn stamped(world_from_link: &Pose, child_frame_id: String, frame: &FixedFrame, stamp: Stamp) -> TransformStamped {
    TransformStamped { header: frame.header(stamp), child_frame_id, transform: transform(world_from_link) }
}

fn is_finite(stamped: &TransformStamped) -> bool {
    let (t, r) = (&stamped.transform.translation, &stamped.transform.rotation);
    [t.x, t.y, t.z, r.x, r.y, r.z, r.w].into_iter().all(f64::is_finite)
}

#[cfg(test)]
mod tests {
    use nalgebra::{Matrix3, Vector3};

    use super::*;
    use crate::ros::examples::door_with_drawer_and_handle;
    use crate::types::finite::check_finite;

    fn frame() -> FixedFrame {
        FixedFrame { name: "world".into(), zero: Stamp(5) }
    }

    #[test]
    fn rates_are_for_all_or_none() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        let positions = BTreeMap::from([(Label(2), 0.5), (Label(7), f64::NAN), (Label(1), 3.0)]);
        let mut rates = BTreeMap::from([(Label(2), 0.1), (Label(3), 0.2)]);
        let message = joint_states(&tree, &positions, &rates, &frame(), Stamp(2_000_000_001));
        assert_eq!(message.name, ["joint_2", "joint_3", "joint_7"]);
        assert_eq!((message.position, message.velocity), (vec![0.5, 0.0, 0.0], vec![]));
        assert_eq!((message.header.stamp.sec, message.header.stamp.nanosec), (2, 1));
        rates.insert(Label(7), 0.3);
        let message = joint_states(&tree, &positions, &rates, &frame(), Stamp(0));
        assert_eq!(message.velocity, [0.1, 0.2, 0.3]);
    }

    #[test]
    fn a_link_stands_on_its_axis() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        let positions = BTreeMap::from([(Label(2), 1.0), (Label(3), 0.25)]);
        let displacements = tree.displacements(&positions);
        let message = link_transforms(&tree, &displacements, &frame(), Stamp(0));
        let find = |name: &str| &message.transforms.iter().find(|t| t.child_frame_id == name).unwrap().transform;
        // The door turns about the origin of its frame, the drawer goes along its axis.
        let door = &find("part_2").translation;
        assert!((Vector3::new(door.x, door.y, door.z) - Vector3::new(0.1, 0.02, 0.5)).norm() < 1e-12);
        let drawer = &find("part_3").translation;
        let expected = Vector3::new(0.8 + 0.25 * 0.8, -0.25 * 0.6, 0.3);
        assert!((Vector3::new(drawer.x, drawer.y, drawer.z) - expected).norm() < 1e-12);
        assert_eq!(message.transforms.len(), 5);
    }

    #[test]
    fn predictions_that_are_not_finite_are_left_out() {
        let tree = LinkTree::likeliest(&door_with_drawer_and_handle());
        let good = PartPrediction {
            label: Label(3),
            horizon_s: 0.5,
            displacement: Pose::from_translation(Vector3::x()),
            center_in_world: Vector3::zeros(),
            covariance_m2: Matrix3::identity(),
            joint_position: None,
        };
        let bad = PartPrediction { displacement: Pose::from_translation(Vector3::x() * f64::NAN), ..good };
        let unknown = PartPrediction { label: Label(99), ..good };
        let message = predicted_transforms(&tree, &[bad, good, unknown], &frame(), Stamp(0));
        assert_eq!(message.transforms.len(), 1);
        assert_eq!(message.transforms[0].child_frame_id, "part_3_in_500_ms");
        assert!((message.transforms[0].transform.translation.x - 1.8).abs() < 1e-12);
        assert_eq!(check_finite(&message), Ok(()));
    }
}
