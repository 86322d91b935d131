//! Chains against MuJoCo: within 1 mm or 1 mrad over 4 s, with steps up to 2 ms.
//!
//! The fixture is written by `mujoco_peer/trajectories.py`.
//!
//! With `BOM_PEER_PYTHON` set to a Python that has `mujoco_peer/requirements.txt`, the reference is
//! simulated anew. With `BOM_PEER_TABLE` set to a path, the errors are written there.

#![allow(clippy::unwrap_used, reason = "a test")]

use std::fmt::Write;
use std::path::Path;
use std::process::Command;

use bayesian_object_models::math::Screw;
use bayesian_object_models::mechanism::{
    Body, JointParameters, JointType, Limit, State, Tree, WrenchPoint, WrenchSample, WrenchTrack, rollout,
};
use nalgebra::{Matrix3, Quaternion, UnitQuaternion, Vector3};
use serde::Deserialize;

#[derive(Deserialize)]
struct Fixture {
    mujoco: String,
    chains: Vec<Chain>,
}

#[derive(Deserialize)]
struct Chain {
    bodies: Vec<Link>,
    gravity: [f64; 3],
    force_body: usize,
    force_point: [f64; 3],
    force_period_s: f64,
    force: Vec<[f64; 3]>,
    softness_s: f64,
    output_period_s: f64,
    positions: Vec<Vec<f64>>,
}

#[derive(Deserialize)]
struct Link {
    r#type: JointType,
    axis: [f64; 3],
    point: [f64; 3],
    mass: f64,
    com: [f64; 3],
    principal: [f64; 3],
    /// w, x, y, z.
    quaternion: [f64; 4],
    damping: f64,
    friction: f64,
    range: Option<[f64; 2]>,
}

fn fixture() -> Fixture {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/mujoco_peer");
    let text = match std::env::var_os("BOM_PEER_PYTHON") {
        Some(python) => {
            let output = Command::new(python).arg(folder.join("trajectories.py")).output().unwrap();
            assert!(output.status.success(), "{}", String::from_utf8_lossy(&output.stderr));
            String::from_utf8(output.stdout).unwrap()
        }
        None => std::fs::read_to_string(folder.join("trajectories.json")).unwrap(),
    };
    serde_json::from_str(&text).unwrap()
}

fn tree_of(chain: &Chain) -> Tree<f64> {
    let bodies = chain.bodies.iter().enumerate().map(|(i, link)| {
        let axis = Vector3::from(link.axis).normalize();
        let point = Vector3::from(link.point);
        let [w, x, y, z] = link.quaternion;
        let principal = UnitQuaternion::from_quaternion(Quaternion::new(w, x, y, z));
        let rotation = principal.to_rotation_matrix().into_inner();
        let moments = Matrix3::from_diagonal(&Vector3::from(link.principal));
        let mut parameters = JointParameters::new(link.damping, link.friction);
        let limit = |position| Limit { position, softness_s: chain.softness_s };
        parameters.lower = link.range.map(|[lower, _]| limit(lower));
        parameters.upper = link.range.map(|[_, upper]| limit(upper));
        Body {
            parent: i.checked_sub(1),
            joint: link.r#type,
            screw: match link.r#type {
                JointType::Rigid => Screw::rigid(),
                JointType::Prismatic => Screw::prismatic(&axis),
                JointType::Revolute => Screw::revolute(&axis, &point),
            },
            mass: link.mass,
            com_in_world: Vector3::from(link.com),
            inertia_about_com: rotation * moments * rotation.transpose(),
            parameters,
        }
    });
    Tree::new(bodies.collect(), Vector3::from(chain.gravity)).unwrap()
}

/// The largest error over the record \[m or rad\].
fn worst_error(chain: &Chain, step_s: f64) -> f64 {
    let tree = tree_of(chain);
    let samples: Vec<WrenchSample> = chain
        .force
        .iter()
        .enumerate()
        .map(|(i, force)| WrenchSample {
            stamp_s: i as f64 * chain.force_period_s,
            point_in_world: Vector3::zeros(),
            force_in_world: Vector3::from(*force),
            torque_in_world: Vector3::zeros(),
        })
        .collect();
    let mut track = WrenchTrack::new(chain.force_body, &samples);
    track.point = WrenchPoint::Carried(Vector3::from(chain.force_point));
    let times: Vec<f64> = (0..chain.positions.len()).map(|i| i as f64 * chain.output_period_s).collect();
    let start = State::at_rest(chain.bodies.len());
    let run = rollout(&tree, &start, &[track], &times, step_s).unwrap();
    let errors = chain
        .positions
        .iter()
        .enumerate()
        .flat_map(|(i, expected)| run.positions(i).iter().zip(expected).map(|(q, expected)| (q - expected).abs()));
    errors.fold(0.0, f64::max)
}

#[test]
fn chains_move_as_in_mujoco() {
    const STEPS_S: [f64; 4] = [0.0005, 0.001, 0.002, 0.004];
    let fixture = fixture();
    let mut table = format!("worst error over 4 s [mm or mrad], MuJoCo {}\n", fixture.mujoco);
    let mut failed = false;
    for chain in &fixture.chains {
        let errors = STEPS_S.map(|step_s| 1e3 * worst_error(chain, step_s));
        for link in &chain.bodies {
            let limited = if link.range.is_some() { "|" } else { "" };
            write!(table, "{}{limited} ", link.r#type.name()).unwrap();
        }
        for (step_s, error) in STEPS_S.iter().zip(errors) {
            write!(table, " {:.1} ms: {error:.3}", 1e3 * step_s).unwrap();
        }
        writeln!(table).unwrap();
        failed |= errors[..3].iter().any(|error| error.is_nan() || *error >= 1.0);
    }
    if let Some(path) = std::env::var_os("BOM_PEER_TABLE") {
        std::fs::write(path, &table).unwrap();
    }
    assert!(!failed, "{table}");
}
