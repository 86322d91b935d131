//! The filter on simulated tracks.
#![allow(clippy::unwrap_used)]

use std::sync::Arc;

use nalgebra::{DMatrix, DVector, Matrix6, Vector3};
use proptest::prelude::*;

use super::{ActiveNumber, Filter, TrackedMechanism, TreeFamily};
use crate::math::Pose;
use crate::mechanism::{
    Body, JointParameters, JointType, State, Tree, WrenchPoint, WrenchSample, WrenchTrack, rollout,
};
use crate::model::{Axis, KinematicJoint, PoseMeasurement};
use crate::types::Label;

const CONTACT: Vector3<f64> = Vector3::new(0.5, 0.0, 0.2);

/// A drawer along x of 3 kg.
pub(super) fn drawer(damping: f64) -> TrackedMechanism {
    let axis = Axis { direction: Vector3::x(), point: Vector3::zeros() };
    let joint = KinematicJoint {
        parent: None,
        child: Label(4),
        joint_type: JointType::Prismatic,
        axis,
        center: Vector3::zeros(),
        radius: 0.2,
        suggested: None,
    };
    // Its numbers are ln damping and ln friction.
    let trees = TreeFamily::new(|numbers| {
        let parameters = JointParameters::new(numbers[0].exp(), numbers[1].exp());
        let body = Body { parameters, ..Body::prismatic(None, &Vector3::x(), 3.0) };
        Tree::new(vec![body], Vector3::new(0.0, 0.0, -9.81)).ok()
    });
    let numbers = DVector::from_vec(vec![damping.ln(), 3f64.ln()]);
    TrackedMechanism {
        joints: vec![joint],
        tree: trees.tree(&numbers).unwrap(),
        trees,
        numbers,
        active: (0..2).map(|place| ActiveNumber { joint: 0, place }).collect(),
        covariance: DMatrix::identity(2, 2) * 0.05 * 0.05,
        explored: vec![[0.0, 1.0]],
        axis_roots: vec![DMatrix::zeros(2, 2)],
        centers: vec![Vector3::zeros()],
        tool_offset: Vector3::new(0.002, -0.001, 0.0),
        noise_scale: 1.0,
        sensor: crate::model::SensorError::none(),
        unexplained: vec![0.0],
    }
}

/// Readings at 125 Hz of a pull that varies, with no noise: a test needs no luck.
pub(super) fn readings() -> Vec<WrenchSample> {
    (0..250)
        .map(|i| {
            let stamp_s = f64::from(i) * 0.008;
            let force_in_world = Vector3::x() * (7.0 * (2.5 * stamp_s).sin());
            WrenchSample {
                stamp_s,
                point_in_world: Vector3::zeros(),
                force_in_world,
                torque_in_world: Vector3::zeros(),
            }
        })
        .collect()
}

pub(super) fn truth(tree: &Tree<f64>, samples: &[WrenchSample], times_s: &[f64]) -> Vec<(f64, f64)> {
    let track = WrenchTrack { point: WrenchPoint::Carried(CONTACT), ..WrenchTrack::new(0, samples) };
    let path = rollout(tree, &State::at_rest(1), &[track], times_s, 0.001).unwrap();
    (0..times_s.len()).map(|i| (path.positions(i)[0], path.rates(i)[0])).collect()
}

/// The filter of `mechanism` at .8 s, fed by the motion of a drawer with damping 8 N·s/m, and where the
/// drawer then is and goes.
fn filtered(mechanism: TrackedMechanism) -> (Filter, Vec<(f64, f64)>) {
    let real = drawer(8.0);
    let samples = readings();
    let times_s: Vec<f64> = (0..=100).map(|i| f64::from(i) * 0.008).collect();
    let path = truth(&real.tree, &samples, &times_s);
    let offset = mechanism.tool_offset;
    let tool = |q: f64| CONTACT + Vector3::x() * q + offset;
    let mut filter = Filter::new(Arc::new(mechanism), 0.0, vec![0.0], vec![0.0], (0.001, 0.01));
    filter.hold(0, &tool(0.0), 0.001);
    for (time_s, (q, _)) in times_s.iter().zip(&path).skip(1) {
        filter.advance(*time_s, &samples);
        assert!(filter.correct_by_tool(&tool(*q), 0.001));
    }
    let ahead = truth(&real.tree, &samples, &[0.0, 0.8, 0.9, 1.3]);
    (filter, ahead)
}

#[test]
fn a_simulated_track_is_recovered_and_predicted() {
    let (filter, ahead) = filtered(drawer(8.0));
    assert!((filter.positions()[0] - ahead[1].0).abs() < 5e-4, "{filter:?} {ahead:?}");
    assert!((filter.rates()[0] - ahead[1].1).abs() < 5e-3);
    for (horizon, forecast) in filter.forecast(&[0.1, 0.5], &readings()).iter().enumerate() {
        let error = forecast.positions[0] - ahead[2 + horizon].0;
        assert!(error.abs() < 1e-3, "{error} m at horizon {horizon}");
        assert!(error.abs() < 2.0 * forecast.covariances_m2[0][(0, 0)].sqrt());
    }
    assert_eq!(filter.placed(&[0.2])[&Label(4)], Pose::from_translation(Vector3::x() * 0.2));
}

#[test]
fn a_wrong_model_still_follows_the_tool() {
    let (filter, ahead) = filtered(drawer(20.0));
    assert!((filter.positions()[0] - ahead[1].0).abs() < 3e-3, "{} {ahead:?}", filter.positions()[0]);
    assert!((filter.rates()[0] - ahead[1].1).abs() < 0.05, "{} {ahead:?}", filter.rates()[0]);
}

#[test]
fn what_rests_stays_exactly() {
    let mut filter = Filter::new(Arc::new(drawer(8.0)), 0.0, vec![0.12], vec![0.0], (0.001, 0.01));
    filter.advance(10.0, &readings());
    assert!(filter.rests() && filter.positions() == [0.12]);
    for forecast in filter.forecast(&[0.1, 0.5, 1.0], &readings()) {
        assert_eq!(forecast.positions, [0.12]);
        assert!(forecast.covariances_m2[0][(0, 0)].sqrt() < 0.002);
    }
    // Held by less than friction: it sticks.
    let weak: Vec<WrenchSample> =
        readings().iter().map(|s| WrenchSample { force_in_world: s.force_in_world * 0.3, ..*s }).collect();
    let mut filter = Filter::new(Arc::new(drawer(8.0)), 0.0, vec![0.12], vec![0.0], (0.001, 0.01));
    filter.hold_point(0, CONTACT, 0.001);
    filter.advance(1.0, &weak);
    assert_eq!(filter.positions(), [0.12]);
}

#[test]
fn the_same_input_gives_the_same_bits() {
    let run = || filtered(drawer(8.0)).0.forecast(&[0.1, 0.5, 1.0], &readings());
    assert_eq!(run(), run());
}

#[test]
fn a_wrong_number_is_found_while_the_tool_pulls() {
    let mut wrong = drawer(20.0);
    wrong.covariance = DMatrix::identity(2, 2) * 0.5 * 0.5;
    let (filter, ahead) = filtered(wrong);
    let damping = filter.numbers()[0].exp();
    assert!((damping / 8.0).ln().abs() < (20.0f64 / 8.0).ln() * 0.5, "{damping} N·s/m");
    for (horizon, forecast) in filter.forecast(&[0.1, 0.5], &readings()).iter().enumerate() {
        let error = forecast.positions[0] - ahead[2 + horizon].0;
        let std = forecast.covariances_m2[0][(0, 0)].sqrt();
        assert!(error.abs() < 2.5 * std, "{error} m, stated {std} m, at horizon {horizon}");
    }
}

#[test]
fn an_unexplained_force_is_followed_and_fades() {
    // A spring of 2 N that the model knows nothing of, as a force of the tool that is not reported.
    let real = drawer(8.0);
    let samples = readings();
    let times_s: Vec<f64> = (0..=100).map(|i| f64::from(i) * 0.008).collect();
    let pushed: Vec<WrenchSample> =
        samples.iter().map(|s| WrenchSample { force_in_world: s.force_in_world - Vector3::x() * 2.0, ..*s }).collect();
    let path = truth(&real.tree, &pushed, &times_s);
    let tool = |q: f64| CONTACT + Vector3::x() * q + real.tool_offset;
    let mut filter = Filter::new(Arc::new(drawer(8.0)), 0.0, vec![0.0], vec![0.0], (0.001, 0.01));
    filter.hold(0, &tool(0.0), 0.001);
    for (time_s, (q, _)) in times_s.iter().zip(&path).skip(1) {
        filter.advance(*time_s, &samples);
        filter.correct_by_tool(&tool(*q), 0.001);
    }
    let (q, rate) = path[100];
    assert!((filter.positions()[0] - q).abs() < 2e-3, "{} {q}", filter.positions()[0]);
    assert!((filter.rates()[0] - rate).abs() < 0.03, "{} {rate}", filter.rates()[0]);
}

#[test]
fn a_stop_may_wait_beyond_what_was_seen() {
    let unexplored = TrackedMechanism { explored: vec![[0.0, 0.05]], ..drawer(8.0) };
    let far = |mechanism: TrackedMechanism| {
        let mut filter = Filter::new(Arc::new(mechanism), 0.0, vec![0.05], vec![0.5], (0.001, 0.01));
        filter.hold_point(0, CONTACT, 0.001);
        let strong: Vec<WrenchSample> =
            readings().iter().map(|s| WrenchSample { force_in_world: Vector3::x() * 7.0, ..*s }).collect();
        filter.forecast(&[0.5], &strong).remove(0)
    };
    let (known, unknown) = (far(drawer(8.0)), far(unexplored));
    let way = |forecast: &super::Forecast| forecast.positions[0] - 0.05;
    assert!(way(&unknown) < 0.9 * way(&known) && way(&unknown) > 0.5 * way(&known));
    assert!(unknown.covariances_m2[0][(0, 0)] > 2.0 * known.covariances_m2[0][(0, 0)]);
}

#[test]
fn a_joint_carries_the_tool_as_far_as_it_can() {
    let mechanism = drawer(8.0);
    let tool = CONTACT + mechanism.tool_offset;
    let carried = mechanism.carry(&[0.1], 0, &tool, &(tool + Vector3::new(0.05, 0.02, 0.0)));
    let place = carried.displacement.translation;
    assert!((carried.position - 0.15).abs() < 1e-9 && (place - Vector3::x() * 0.15).norm() < 1e-9, "{carried:?}");
    assert!((carried.miss_m - 0.02).abs() < 1e-9, "{carried:?}");
}

/// A drawer with another on it, of numbers that no part has:
/// ln damping and ln friction of both, then ln mass.
fn loose(numbers: [f64; 3], deviation: f64, noise_scale: f64) -> TrackedMechanism {
    let real = drawer(8.0);
    let trees = TreeFamily::new(|numbers| {
        let parameters = || JointParameters::new(numbers[0].exp(), numbers[1].exp());
        let mass = numbers[2].exp();
        let first = Body { parameters: parameters(), ..Body::prismatic(None, &Vector3::x(), mass) };
        let second = Body { parameters: parameters(), ..Body::prismatic(Some(0), &Vector3::x(), mass) };
        Tree::new(vec![first, second], Vector3::new(0.0, 0.0, -9.81)).ok()
    });
    let numbers = DVector::from_vec(numbers.to_vec());
    let second = KinematicJoint { parent: Some(0), child: Label(5), ..real.joints[0] };
    TrackedMechanism {
        joints: vec![real.joints[0], second],
        tree: trees.tree(&numbers).unwrap(),
        trees,
        numbers,
        active: (0..3).map(|place| ActiveNumber { joint: place % 2, place }).collect(),
        covariance: DMatrix::identity(3, 3) * deviation * deviation,
        explored: vec![[0.0, 0.3]; 2],
        axis_roots: vec![DMatrix::zeros(2, 2); 2],
        centers: vec![Vector3::zeros(); 2],
        noise_scale,
        unexplained: vec![0.0, 100.0],
        ..real
    }
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]
    /// Whatever the numbers, the forces and the measurements: where a part is said to be is where it can be.
    #[test]
    fn no_numbers_carry_a_part_away(
        numbers in (-25.0..5.0, -25.0..3.0, -16.0..3.0),
        deviation in 0.01..30.0,
        noise_scale in prop::sample::select(vec![1.0, 1e4, 1e9]),
        frames in prop::collection::vec((-1e4..1e4, -0.3..0.6, -0.3..0.6, 0..4u8), 12),
    ) {
        let mechanism = loose([numbers.0, numbers.1, numbers.2], deviation, noise_scale);
        let offset = mechanism.tool_offset;
        let mut filter = Filter::new(Arc::new(mechanism), 0.0, vec![0.1, 0.0], vec![0.3, 0.0], (0.01, 0.1));
        filter.hold(1, &(CONTACT + Vector3::x() * 0.1 + offset), 0.001);
        for (frame, (force, tool, pose, what)) in frames.into_iter().enumerate() {
            let time_s = 0.1 * (frame + 1) as f64;
            let pull = |stamp_s| WrenchSample { stamp_s, force_in_world: Vector3::x() * force, ..readings()[0] };
            let samples: Vec<_> = (0..300).map(|i| pull(0.008 * f64::from(i))).collect();
            filter.advance(time_s, &samples);
            if what & 1 == 0 {
                filter.correct_by_tool(&(CONTACT + Vector3::x() * tool + offset), 0.001);
            }
            if what & 2 == 0 {
                let displacement = Pose::from_translation(Vector3::x() * pose);
                let information = Matrix6::identity() * 1e6;
                filter.correct_by_pose(Label(4), &PoseMeasurement { displacement, information });
            }
            for forecast in filter.forecast(&[0.1, 0.5, 1.0], &samples) {
                // Measured within 0.6 m, two joints, each seen within as much or so, its leash, and a second.
                for (q, covariance) in forecast.positions.iter().zip(&forecast.covariances_m2) {
                    prop_assert!(q.abs() < 6.0, "{q} m at {time_s} s");
                    let deviation = covariance.trace().sqrt();
                    prop_assert!(deviation < 25.0, "{deviation} m at {time_s} s");
                }
            }
            prop_assert!(filter.rates().iter().all(|rate| rate.abs() < 5.0), "{:?}", filter.rates());
        }
    }
}

#[test]
fn a_hand_that_goes_without_pushing_takes_nothing_along() {
    let (mut filter, _) = filtered(drawer(8.0));
    let there = filter.positions()[0];
    let tool = CONTACT + drawer(8.0).tool_offset + Vector3::x() * there;
    assert!(filter.correct_by_idle_tool(&tool, 0.001), "it is where it was");
    assert!(!filter.correct_by_idle_tool(&(tool + Vector3::x() * 0.03), 0.001));
    assert!((filter.positions()[0] - there).abs() < 0.002, "{} m, was {there} m", filter.positions()[0]);
    // One that pushes has it along.
    assert!(filter.correct_by_tool(&(tool + Vector3::x() * 0.03), 0.001));
    assert!((filter.positions()[0] - there - 0.03).abs() < 0.01, "{} m, was {there} m", filter.positions()[0]);
}

#[test]
fn what_is_carried_is_left_behind_by_a_jerk() {
    // 3 kg on 3 kg, hardly any friction between: by 30 N the lower goes, the upper stays in world.
    let mut mechanism = loose([0.1f64.ln(), 0.5f64.ln(), 3f64.ln()], 0.05, 1.0);
    mechanism.unexplained = vec![0.0; 2];
    mechanism.explored = vec![[-1.0, 1.0]; 2];
    let mut filter = Filter::new(Arc::new(mechanism), 0.0, vec![0.0, 0.0], vec![0.0, 0.0], (0.001, 0.01));
    filter.hold_point(0, CONTACT, 0.001);
    let pull = |i| WrenchSample { stamp_s: 0.008 * f64::from(i), force_in_world: Vector3::x() * 30.0, ..readings()[0] };
    let samples: Vec<_> = (0..100).map(pull).collect();
    let ahead = filter.forecast(&[0.2], &samples).remove(0);
    let [lower, upper] = ahead.positions[..] else { panic!("two joints") };
    assert!(lower > 0.1 && upper < -0.7 * lower, "{lower} m, {upper} m on it");
    // At rest and let alone, both stay.
    filter.release();
    assert_eq!(filter.forecast(&[0.2], &samples).remove(0).positions, [0.0, 0.0]);
}
