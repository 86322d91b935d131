//! Properties of the dynamics as a whole.

use nalgebra::{DMatrix, DVector, Matrix3, Vector3, Vector6};
use num_dual::DualSVec64;
use proptest::prelude::*;

use super::*;
use crate::math::gradient::assert_gradient;
use crate::math::{Pose, Real, Screw};

const GRAVITY: Vector3<f64> = Vector3::new(0.0, 0.0, -9.81);

/// A chain or a fork of bodies from plain numbers, eleven to a body.
fn tree_of<T: Real>(numbers: &[f64], parents: &[Option<usize>], frame: &Pose<f64>, gravity: Vector3<f64>) -> Tree<T> {
    let bodies = numbers
        .chunks_exact(11)
        .zip(parents)
        .map(|(x, &parent)| {
            let axis = Vector3::new(x[0], x[1], x[2] + 1.5).normalize();
            let point = Vector3::new(x[3], x[4], x[5]);
            let com = point + Vector3::new(x[6], x[7], x[8]);
            let turns = x[9] > 0.0;
            let screw = if turns { Screw::revolute(&axis, &point) } else { Screw::prismatic(&axis) };
            let size = Vector3::new(0.2 + x[6].abs(), 0.3, 0.2 + x[7].abs());
            let about_com = Matrix3::from_diagonal(&size) + size * size.transpose() * 0.1;
            let turned = frame.rotation * about_com * frame.rotation.transpose();
            Body {
                joint: if turns { JointType::Revolute } else { JointType::Prismatic },
                screw: Screw(frame.adjoint(&screw.0).map(T::constant)),
                mass: T::constant(1.5 + x[10]),
                com_in_world: frame.transform_point(&com).map(T::constant),
                inertia_about_com: turned.map(T::constant),
                ..Body::rigid(parent)
            }
        })
        .collect();
    Tree::new(bodies, frame.rotation * gravity).unwrap()
}

const CHAIN: [Option<usize>; 3] = [None, Some(0), Some(1)];
const FORK: [Option<usize>; 3] = [None, Some(0), Some(0)];

fn numbers() -> impl Strategy<Value = Vec<f64>> {
    prop::collection::vec(-1.0..1.0_f64, 33)
}

fn kinetic_energy(tree: &Tree<f64>, positions: &[f64], rates: &[f64]) -> f64 {
    let rates = DVector::from_column_slice(rates);
    0.5 * rates.dot(&(tree.mass_matrix(positions) * &rates))
}

/// Energy of bodies that move with D(q(t)), by differencing D: no mass matrix in it.
fn kinetic_energy_of_bodies(tree: &Tree<f64>, positions: &[f64], rates: &[f64]) -> f64 {
    const STEP_S: f64 = 1e-5;
    let at = |t: f64| {
        let moved: Vec<f64> = positions.iter().zip(rates).map(|(q, v)| q + v * t).collect();
        tree.displacements(&moved)
    };
    let (before, now, after) = (at(-STEP_S), at(0.0), at(STEP_S));
    let mut energy = 0.0;
    for (i, body) in tree.bodies().iter().enumerate() {
        let turning = (after[i].rotation - before[i].rotation) / (2.0 * STEP_S);
        let turning = turning * now[i].rotation.transpose();
        let omega = Vector3::new(turning[(2, 1)], turning[(0, 2)], turning[(1, 0)]);
        let com = |pose: &Pose<f64>| pose.transform_point(&body.com_in_world);
        let velocity = (com(&after[i]) - com(&before[i])) / (2.0 * STEP_S);
        let inertia = now[i].rotation * body.inertia_about_com * now[i].rotation.transpose();
        energy += 0.5 * body.mass * velocity.norm_squared() + 0.5 * omega.dot(&(inertia * omega));
    }
    energy
}

fn simulate(tree: &Tree<f64>, start: &State<f64>, seconds: f64, step_s: f64) -> State<f64> {
    let mut state = start.clone();
    let mut workspace = Workspace::new(tree);
    for i in 0..(seconds / step_s).round() as usize {
        let at = Step { middle_s: (i as f64 + 0.5) * step_s, length_s: step_s };
        step(tree, &mut state, &[], at, &mut workspace);
    }
    state
}

proptest! {
    #![proptest_config(ProptestConfig::with_cases(48))]

    #[test]
    fn mass_matrix_is_that_of_the_kinetic_energy(
        x in numbers(),
        q in prop::array::uniform3(-1.0..1.0_f64),
        v in prop::array::uniform3(-1.0..1.0_f64),
        fork in any::<bool>(),
    ) {
        let parents = if fork { FORK } else { CHAIN };
        let tree: Tree<f64> = tree_of(&x, &parents, &Pose::identity(), GRAVITY);
        let matrix = tree.mass_matrix(&q);
        prop_assert!((&matrix - matrix.transpose()).norm() < 1e-12);
        prop_assert!(matrix.clone().cholesky().is_some());
        let direct = kinetic_energy_of_bodies(&tree, &q, &v);
        prop_assert!((kinetic_energy(&tree, &q, &v) - direct).abs() < 1e-6 * (1.0 + direct));
    }

    #[test]
    fn bias_forces_are_those_of_the_lagrangian(
        x in numbers(),
        q in prop::array::uniform3(-1.0..1.0_f64),
        v in prop::array::uniform3(-1.0..1.0_f64),
    ) {
        // c + g = Ṁ q̇ − ∂T/∂q + ∂V/∂q
        const STEP: f64 = 1e-5;
        let tree: Tree<f64> = tree_of(&x, &FORK, &Pose::identity(), GRAVITY);
        let moved = |t: f64| -> Vec<f64> { q.iter().zip(&v).map(|(q, v)| q + v * t).collect() };
        let rate: DMatrix<f64> =
            (tree.mass_matrix(&moved(STEP)) - tree.mass_matrix(&moved(-STEP))) / (2.0 * STEP);
        let momentum_rate = rate * DVector::from_column_slice(&v);
        let lagrangian = |q: &[f64]| kinetic_energy(&tree, q, &v) - tree.potential_energy(q);
        let bias = tree.bias_forces(&q, &v);
        for i in 0..3 {
            let (mut plus, mut minus) = (q, q);
            plus[i] += STEP;
            minus[i] -= STEP;
            let gradient = (lagrangian(&plus) - lagrangian(&minus)) / (2.0 * STEP);
            prop_assert!((bias[i] - (momentum_rate[i] - gradient)).abs() < 1e-5);
        }
    }

    #[test]
    fn energy_is_kept_to_second_order(x in numbers(), v in prop::array::uniform3(-1.0..1.0_f64)) {
        let tree: Tree<f64> = tree_of(&x, &CHAIN, &Pose::identity(), GRAVITY);
        let start = State::new(vec![0.0; 3], v.to_vec());
        let energy = |s: &State<f64>| {
            kinetic_energy(&tree, &s.positions, &s.rates) + tree.potential_energy(&s.positions)
        };
        // The largest along the way: at one instant terms of different order may cancel.
        let drift = |step_s: f64| {
            [0.1, 0.2, 0.3, 0.4, 0.5]
                .map(|seconds| (energy(&simulate(&tree, &start, seconds, step_s)) - energy(&start)).abs())
                .into_iter()
                .fold(0.0, f64::max)
        };
        let scale = 1.0 + kinetic_energy(&tree, &start.positions, &start.rates);
        prop_assert!(drift(1e-3) < 2e-3 * scale, "{} of {scale}", drift(1e-3));
        prop_assert!(drift(6.25e-5) < 0.12 * drift(2.5e-4) + 1e-7 * scale);
    }

    #[test]
    fn moving_the_world_moves_nothing_in_it(x in numbers(), frame in prop::array::uniform6(-2.0..2.0_f64)) {
        let frame = Pose::exp(&Vector6::from_column_slice(&frame));
        let run = |frame: &Pose<f64>| {
            let tree: Tree<f64> = tree_of(&x, &CHAIN, frame, GRAVITY);
            let samples = [0.0, 0.3, 0.6].map(|stamp_s| WrenchSample {
                stamp_s,
                point_in_world: frame.transform_point(&Vector3::new(0.3, stamp_s, 0.1)),
                force_in_world: frame.rotation * Vector3::new(1.0 - stamp_s, 2.0, -3.0 * stamp_s),
                torque_in_world: frame.rotation * Vector3::new(0.5, -stamp_s, 0.2),
            });
            let mut tracks = [WrenchTrack::new(2, &samples), WrenchTrack::new(1, &samples)];
            tracks[1].point = WrenchPoint::Carried(frame.transform_point(&Vector3::new(0.1, 0.2, 0.3)));
            rollout(&tree, &State::at_rest(3), &tracks, &[0.0, 0.5], 1e-3).unwrap()
        };
        let (plain, moved) = (run(&Pose::identity()), run(&frame));
        for (a, b) in plain.positions(1).iter().zip(moved.positions(1)) {
            prop_assert!((a - b).abs() < 1e-9, "{a} {b}");
        }
    }

    #[test]
    fn one_joint_moves_as_the_tree_does(x in numbers(), limited in any::<bool>()) {
        let tree: Tree<f64> = tree_of(&x[..11], &[None], &Pose::identity(), GRAVITY);
        let mut body = tree.bodies()[0].clone();
        body.parameters = JointParameters::new(0.6, 0.8);
        body.parameters.effects.push(effects::AttachedEffect::new(effects::EffectKind::ReflectedInertia, &[0.1]));
        body.parameters.upper = limited.then(|| Limit::at(0.1));
        body.parameters.effects.push(effects::AttachedEffect::new(effects::EffectKind::Drag, &[0.4]));
        let attached = Body { mass: 0.7, com_in_world: Vector3::x(), ..Body::rigid(Some(0)) };
        let tree = Tree::new(vec![body, attached], GRAVITY).unwrap();
        let samples = [WrenchSample {
            stamp_s: 0.0,
            point_in_world: Vector3::new(0.3, 0.1, 0.1),
            force_in_world: Vector3::new(5.0, -4.0, 8.0),
            torque_in_world: Vector3::zeros(),
        }];
        let tracks = [WrenchTrack::new(1, &samples)];
        let start = State::new(vec![0.0; 2], vec![0.1, 0.0]);
        let times = [0.0, 0.3, 0.8];
        let single = rollout(&tree, &start, &tracks, &times, 1e-3).unwrap();
        // A second, idle joint of the world sends the same body through the general path.
        let idle = Body::prismatic(None, &Vector3::x(), 1.0);
        let mut bodies = tree.bodies().to_vec();
        bodies.push(idle);
        let general_tree = Tree::new(bodies, GRAVITY).unwrap();
        let start = State::new(vec![0.0; 3], vec![0.1, 0.0, 0.0]);
        let general = rollout(&general_tree, &start, &tracks, &times, 1e-3).unwrap();
        for i in 0..3 {
            prop_assert!((single.positions(i)[0] - general.positions(i)[0]).abs() < 1e-10);
            prop_assert!((single.rates(i)[0] - general.rates(i)[0]).abs() < 1e-9);
        }
    }
}

fn drawer<T: Real>(mass: T, damping: T, friction: T, lower: Option<T>) -> Tree<T> {
    let x = Vector3::new(T::one(), T::zero(), T::zero());
    let mut body = Body::prismatic(None, &x, mass);
    body.parameters = JointParameters::new(damping, friction);
    body.parameters.lower = lower.map(Limit::at);
    Tree::new(vec![body], GRAVITY).unwrap()
}

fn push(stamp_s: f64, force: f64) -> WrenchSample {
    WrenchSample {
        stamp_s,
        point_in_world: Vector3::new(0.4, 0.1, 0.3),
        force_in_world: Vector3::new(force, 0.0, 0.0),
        torque_in_world: Vector3::zeros(),
    }
}

#[test]
fn a_stuck_joint_stays_where_it_is_exactly() {
    for step_s in [1e-4, 1e-3, 1e-2, 0.1] {
        let tree = drawer(2.0, 1.0, 5.0, None);
        let start = State::new(vec![0.123], vec![0.0]);
        let held = [push(0.0, 4.999), push(1.0, -4.999)];
        let run = |samples: &[WrenchSample]| {
            let tracks = [WrenchTrack::new(0, samples)];
            rollout(&tree, &start, &tracks, &[0.0, 1.0], step_s).unwrap().positions(1)[0]
        };
        assert_eq!(run(&held), 0.123);
        assert!(run(&[push(0.0, 5.01)]) > 0.124);
        assert!(run(&[push(0.0, -5.01)]) < 0.122);
    }
}

#[test]
fn stuck_links_of_a_chain_stay_where_they_are_exactly() {
    let numbers: Vec<f64> = (0..33).map(|i| (i as f64 * 1.7).sin()).collect();
    let tree: Tree<f64> = tree_of(&numbers, &CHAIN, &Pose::identity(), GRAVITY);
    let mut bodies = tree.bodies().to_vec();
    let bias = tree.bias_forces(&[0.2; 3], &[0.0; 3]);
    for (body, bias) in bodies.iter_mut().zip(bias) {
        body.parameters.friction = bias.abs() * 1.001;
    }
    let tree = Tree::new(bodies, GRAVITY).unwrap();
    let start = State::new(vec![0.2; 3], vec![0.0; 3]);
    assert_eq!(simulate(&tree, &start, 1.0, 1e-3).positions, start.positions);
}

#[test]
fn huge_damping_and_a_huge_step_do_not_oscillate() {
    let tree = drawer(0.1, 1e4, 0.0, None);
    let mut state = State::new(vec![0.0], vec![1.0]);
    let mut workspace = Workspace::new(&tree);
    for _ in 0..10 {
        let before = state.rates[0];
        step(&tree, &mut state, &[], Step { middle_s: 0.0, length_s: 0.01 }, &mut workspace);
        assert!((0.0..before).contains(&state.rates[0]));
    }
}

#[test]
fn a_limit_stops_the_joint_and_holds_it() {
    for step_s in [5e-4, 1e-3, 2e-3, 4e-3] {
        let tree = drawer(2.0, 0.0, 0.0, Some(-0.05));
        let samples = [push(0.0, -20.0)];
        let times: Vec<f64> = (0..200).map(|i| i as f64 * 0.01).collect();
        let tracks = [WrenchTrack::new(0, &samples)];
        let run = rollout(&tree, &State::new(vec![0.1], vec![0.0]), &tracks, &times, step_s).unwrap();
        let deepest = (0..200).map(|i| run.positions(i)[0]).fold(f64::INFINITY, f64::min);
        // Arrives with √(2 · 10 · .15) = 1.7 m/s; critically damped: depth v T / e = 6.4 mm.
        assert!(deepest > -0.05 - 0.01, "{deepest} at step {step_s}");
        assert!((run.positions(199)[0] + 0.05).abs() < 1e-4);
        assert!(run.rates(199)[0].abs() < 0.05);
    }
}

#[test]
fn rollouts_have_their_gradient_away_from_switches() {
    type Dual = DualSVec64<6>;
    let samples = [push(0.0, 8.0), push(0.6, 14.0), push(1.0, -16.0), push(1.6, -10.0)];
    let end = |x: &[Dual; 6]| {
        let tree = drawer(x[0], x[1], x[2], Some(x[3]));
        let mut track = WrenchTrack::new(0, &samples);
        track.delay_s = x[4];
        let start = State::new(vec![x[5]], vec![Dual::constant(0.0)]);
        rollout(&tree, &start, &[track], &[0.0, 0.4, 0.8, 1.6], 1e-3).unwrap()
    };
    let point = [3.0, 4.0, 2.5, -5.0, 0.012, 0.02];
    for i in 1..4 {
        assert_gradient(|x| end(x).positions(i)[0], &point, 1e-7, 1e-3);
    }
    let at_stop = [3.0, 4.0, 2.5, -0.001, 0.012, 0.02];
    assert_gradient(|x| end(x).positions(3)[0], &at_stop, 1e-7, 1e-3);
}

#[test]
fn chains_have_their_gradient() {
    type Dual = DualSVec64<8>;
    let numbers: Vec<f64> = (0..33).map(|i| (i as f64 * 1.3).cos()).collect();
    let samples = [push(0.0, 30.0), push(0.5, -20.0)];
    let end = |x: &[Dual; 8]| {
        let tree: Tree<Dual> = tree_of(&numbers, &CHAIN, &Pose::identity(), GRAVITY);
        let mut bodies = tree.bodies().to_vec();
        bodies[0].mass = x[0];
        bodies[1].com_in_world.x += x[1];
        bodies[2].inertia_about_com[(0, 0)] += x[2];
        let tilt = Vector3::new(x[3], Dual::constant(0.0), x[4]);
        let tilt = Screw::revolute(&tilt, &Vector3::zeros()).displacement(Dual::constant(1.0));
        bodies[1].screw = Screw(tilt.adjoint(&bodies[1].screw.0));
        bodies[0].parameters = JointParameters::new(x[5], x[6]);
        let tree = Tree::new(bodies, GRAVITY).unwrap();
        let mut start = State::at_rest(3);
        start.positions[2] = x[7];
        rollout(&tree, &start, &[WrenchTrack::new(2, &samples)], &[0.0, 0.5], 1e-3).unwrap()
    };
    let point = [2.0, 0.1, 0.2, 0.05, 0.03, 0.7, 0.9, 0.1];
    for body in 0..3 {
        assert_gradient(|x| end(x).positions(1)[body], &point, 1e-6, 1e-4);
    }
}

#[test]
fn divergence_is_an_error_not_a_panic() {
    let tree = drawer(0.0, 0.0, 0.0, None);
    let samples = [push(0.0, 8.0)];
    let tracks = [WrenchTrack::new(0, &samples)];
    let run = rollout(&tree, &State::at_rest(1), &tracks, &[0.0, 0.1], 1e-3);
    assert_eq!(run, Err(RolloutError::Diverged { time_s: 0.1 }));
}

#[test]
fn a_cycle_is_no_tree() {
    let bodies = vec![Body::<f64>::rigid(None), Body::rigid(Some(2)), Body::rigid(Some(1))];
    assert_eq!(Tree::new(bodies, GRAVITY).unwrap_err(), TreeError::Cycle { body: 1 });
    let bodies = vec![Body::<f64>::rigid(Some(7))];
    let error = Tree::new(bodies, GRAVITY).unwrap_err();
    assert_eq!(error, TreeError::NoSuchParent { body: 0, parent: 7, count: 1 });
}

#[test]
fn the_shortcut_has_the_inertia_it_was_given() {
    let axis = Vector3::new(0.0, 0.6, 0.8);
    let point = Vector3::new(0.5, -0.2, 1.0);
    let com = Vector3::new(0.9, 0.3, 1.2);
    let body = Body::revolute(None, &axis, &point, 0.37, 2.0, com);
    let tree = Tree::new(vec![body], GRAVITY).unwrap();
    assert!((tree.joint_inertia(0) - 0.37).abs() < 1e-12);
}
