//! Recorded tables → bags → posteriors: `bom import`, then `bom replay`, on simulated tables and on the
//! public records beside this repository.
#![allow(clippy::unwrap_used)]

mod command;

use std::{
    fmt::Write,
    fs,
    path::{Path, PathBuf},
};

use bayesian_object_models::{
    io::document::PosteriorDocument,
    math::{Pose, Screw},
    mechanism::{Body, JointParameters, JointType, State, Tree, WrenchSample, WrenchTrack, rollout},
    types::{
        Label,
        posterior::{EdgePosterior, ObjectPosterior},
    },
};
use command::{bom, measured, ours};
use nalgebra::{Matrix3, Vector3};
use rand::SeedableRng;
use rand_chacha::ChaCha8Rng;
use rand_distr::{Distribution, StandardNormal};
use tempfile::TempDir;

/// Imports a table and replays it.
fn learned(folder: &Path, table: &Path, spec: &Path, import: &[&str], replay: &[&str]) -> ObjectPosterior {
    let (bag, posterior) = (folder.join("imported.mcap"), folder.join("posterior.json"));
    let mut arguments = vec!["import", text(table), "--spec", text(spec), "-o", text(&bag)];
    arguments.extend(import);
    let outcome = bom(&arguments);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
    let mut arguments = vec!["replay", text(&bag), "--posterior", text(&posterior)];
    arguments.extend(replay);
    let outcome = bom(&arguments);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
    let document: PosteriorDocument = serde_json::from_str(&fs::read_to_string(posterior).unwrap()).unwrap();
    document.posterior
}

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

/// The likeliest edge into a part.
fn edge(posterior: &ObjectPosterior, child: u32) -> &EdgePosterior {
    let edges = posterior.edges.iter().filter(|edge| edge.child == Label(child));
    edges.max_by(|a, b| a.probability.total_cmp(&b.probability)).unwrap()
}

fn degrees_between(found: [f64; 3], truth: Vector3<f64>) -> f64 {
    Vector3::from(found).cross(&truth).norm().min(1.0).asin().to_degrees()
}

/// Distance of an axis from a point of the true one \[m\].
fn axis_miss(direction: [f64; 3], point: [f64; 3], truth: Vector3<f64>) -> f64 {
    Vector3::from(direction).cross(&(truth - Vector3::from(point))).norm()
}

/// A simulated machine: bodies in a row, each on the one before, driven by torques or forces on joints.
struct Machine {
    tree: Tree<f64>,
    axes: Vec<(JointType, Vector3<f64>, Vector3<f64>)>,
}

impl Machine {
    /// Joint type, axis, point, mass, centre, damping, friction of each.
    fn chain(joints: &[(JointType, Vector3<f64>, Vector3<f64>, f64, Vector3<f64>, f64, f64)]) -> Self {
        let bodies = joints.iter().enumerate().map(|(k, (joint, axis, point, mass, center, damping, friction))| Body {
            parent: k.checked_sub(1),
            joint: *joint,
            screw: match joint {
                JointType::Revolute => Screw::revolute(axis, point),
                _ => Screw::prismatic(axis),
            },
            mass: *mass,
            com_in_world: *center,
            inertia_about_com: Matrix3::identity() * (mass * 0.01),
            parameters: JointParameters::new(*damping, *friction),
        });
        let tree = Tree::new(bodies.collect(), Vector3::new(0.0, 0.0, -9.81)).unwrap();
        Self { tree, axes: joints.iter().map(|j| (j.0, j.1, j.2)).collect() }
    }

    /// Rows of (time, joint positions, efforts), efforts by a spring to a wave with some drift.
    fn run(&self, seconds: f64, stiffness: &[f64], amplitude: f64) -> Vec<(f64, Vec<f64>, Vec<f64>)> {
        let n = self.axes.len();
        let dt = 0.004;
        let mut state = State::at_rest(n);
        let mut rows = Vec::new();
        for i in 0..(seconds / dt) as usize {
            let t = i as f64 * dt;
            // A second of rest, then waves of rising frequency.
            let s = (t - 1.0).max(0.0);
            let wave = |k: usize| amplitude * (0.5 - 0.5 * ((2.0 + 0.35 * s + 0.8 * k as f64) * s).cos());
            let efforts: Vec<f64> = (0..n).map(|k| stiffness[k] * (wave(k) - state.positions[k])).collect();
            let efforts: Vec<f64> = if s > 0.0 { efforts } else { vec![0.0; n] };
            rows.push((t, state.positions.clone(), efforts.clone()));
            let displacements = self.tree.displacements(&state.positions);
            let mut samples: Vec<(usize, [WrenchSample; 2])> = Vec::new();
            for (k, (joint, axis, _)) in self.axes.iter().enumerate() {
                let parent = k.checked_sub(1).map_or_else(Pose::identity, |p| displacements[p]);
                let effort = parent.rotation * axis * efforts[k];
                let zero = Vector3::zeros();
                let (force, torque) = if *joint == JointType::Revolute { (zero, effort) } else { (effort, zero) };
                let at = |stamp_s, sign: f64| WrenchSample {
                    stamp_s,
                    point_in_world: zero,
                    force_in_world: force * sign,
                    torque_in_world: torque * sign,
                };
                samples.push((k, [at(t, 1.0), at(t + dt, 1.0)]));
                if k > 0 {
                    samples.push((k - 1, [at(t, -1.0), at(t + dt, -1.0)]));
                }
            }
            let tracks: Vec<WrenchTrack<'_, f64>> =
                samples.iter().map(|(body, samples)| WrenchTrack::new(*body, samples)).collect();
            let run = rollout(&self.tree, &state, &tracks, &[t, t + dt], 1e-3).unwrap();
            state = State::new(run.positions(1).to_vec(), run.rates(1).to_vec());
        }
        rows
    }

    fn displacements(&self, q: &[f64]) -> Vec<Pose> {
        self.tree.displacements(q)
    }
}

struct Noise(ChaCha8Rng);

impl Noise {
    fn draw(&mut self, deviation: f64) -> f64 {
        let x: f64 = StandardNormal.sample(&mut self.0);
        deviation * x
    }
}

fn noise(seed: u64) -> Noise {
    Noise(ChaCha8Rng::seed_from_u64(seed))
}

fn written(folder: &TempDir, name: &str, content: &str) -> PathBuf {
    let path = folder.path().join(name);
    fs::write(&path, content).unwrap();
    path
}

const HINGE: (Vector3<f64>, Vector3<f64>) = (Vector3::new(0.0, 0.0, 1.0), Vector3::new(0.4, -0.3, 0.2));

fn hinge() -> Machine {
    let center = HINGE.1 + Vector3::new(0.2, 0.1, 0.0);
    Machine::chain(&[(JointType::Revolute, HINGE.0, HINGE.1, 4.0, center, 0.35, 0.4)])
}

/// Inertia of [`hinge`] about its axis \[kg·m²\].
const HINGE_INERTIA: f64 = 4.0 * (0.05 + 0.01);

#[test]
fn noisy_poses_and_forces_tell_the_hinge() {
    let folder = tempfile::tempdir().unwrap();
    let (machine, mut noise) = (hinge(), noise(1));
    let mut table = "t,x,y,z,qx,qy,qz,qw,fx,fy,fz\n".to_owned();
    let handle = HINGE.1 + Vector3::new(0.4, 0.0, 0.1);
    for (t, q, efforts) in machine.run(14.0, &[6.0], 1.0) {
        let displacement = machine.displacements(&q)[0];
        let turn = Screw::revolute(&Vector3::new(0.6, 0.0, 0.8), &Vector3::zeros()).displacement(noise.draw(0.003));
        let pose = displacement * Pose::from_translation(handle) * turn;
        let x = pose.translation.map(|x| x + noise.draw(0.001));
        let rotation = pose.quaternion();
        // The torque as a force across the lever, at the handle.
        let arm = displacement.transform_point(&handle) - HINGE.1;
        let across = HINGE.0.cross(&arm);
        let force = across * (efforts[0] / across.norm_squared());
        let force = force.map(|f| f + noise.draw(0.05));
        let q = rotation.coords;
        writeln!(
            table,
            "{t},{},{},{},{},{},{},{},{},{},{}",
            x.x, x.y, x.z, q.x, q.y, q.z, q.w, force.x, force.y, force.z
        )
        .unwrap();
    }
    let spec = "[time]\ncolumn = \"t\"\n[[parts]]\nlabel = 7\nposition = [\"x\", \"y\", \"z\"]\n\
                orientation = [\"qx\", \"qy\", \"qz\", \"qw\"]\nnoise = { position_m = 0.001, rotation_rad = 0.002 }\n\
                [[wrenches]]\npart = 7\nforce = [\"fx\", \"fy\", \"fz\"]\n";
    let (table, spec) = (written(&folder, "hinge.csv", &table), written(&folder, "hinge.toml", spec));
    let posterior = learned(folder.path(), &table, &spec, &[], &[]);
    let edge = edge(&posterior, 7);
    assert!(edge.probability > 0.95 && edge.joint_type.revolute > 0.99, "{edge:?}");
    let axis = edge.revolute.as_ref().unwrap();
    assert!(degrees_between(axis.axis_direction, HINGE.0) < 0.1, "{axis:?}");
    assert!(axis_miss(axis.axis_direction, axis.axis_point_m, HINGE.1) < 0.001, "{axis:?}");
    let quantities = [(&edge.damping, 0.35), (&edge.friction, 0.4), (&edge.joint_inertia, HINGE_INERTIA)];
    for (quantity, truth) in quantities {
        assert!((quantity.median / truth - 1.0).abs() < 0.1, "{quantity:?}, truth {truth}");
    }
}

#[test]
fn the_track_of_a_point_tells_hinge_from_slide() {
    for (revolute, seed) in [(true, 2), (false, 3)] {
        let folder = tempfile::tempdir().unwrap();
        let mut noise = noise(seed);
        let screw = if revolute { Screw::revolute(&HINGE.0, &HINGE.1) } else { Screw::prismatic(&Vector3::x()) };
        let start = HINGE.1 + Vector3::new(0.3, 0.0, 0.0);
        let mut table = "x,y,z\n".to_owned();
        for i in 0..400 {
            let q = (f64::from(i - 30).max(0.0) / 370.0) * if revolute { 1.2 } else { 0.35 };
            let x = screw.displacement(q).transform_point(&start).map(|x| x + noise.draw(0.002));
            writeln!(table, "{},{},{}", x.x, x.y, x.z).unwrap();
        }
        let spec = "[time]\nrate_hz = 30\n[[parts]]\nlabel = 1\nposition = [\"x\", \"y\", \"z\"]\n\
                    noise = { position_m = 0.002 }\n";
        let (table, spec) = (written(&folder, "track.csv", &table), written(&folder, "track.toml", spec));
        let posterior = learned(folder.path(), &table, &spec, &[], &["--root-label", "9"]);
        assert_eq!(posterior.root_label, Label(9), "a root that nobody sees");
        let edge = edge(&posterior, 1);
        let found = if revolute { edge.joint_type.revolute } else { edge.joint_type.prismatic };
        assert!(edge.parent == Label(9) && found > 0.95, "{edge:?}");
        if revolute {
            let axis = edge.revolute.as_ref().unwrap();
            assert!(axis_miss(axis.axis_direction, axis.axis_point_m, HINGE.1) < 0.003, "{axis:?}");
        }
    }
}

#[test]
fn torques_between_two_links_tell_the_chain() {
    let folder = tempfile::tempdir().unwrap();
    let (down, mut noise) = (|z: f64| Vector3::new(0.0, 0.0, z), noise(4));
    let machine = Machine::chain(&[
        (JointType::Revolute, Vector3::y(), down(0.0), 0.8, down(-0.15), 0.05, 0.08),
        (JointType::Revolute, Vector3::y(), down(-0.3), 0.5, down(-0.42), 0.03, 0.05),
    ]);
    let mut table = "t,q1,q2,tau1,tau2\n".to_owned();
    for (t, q, efforts) in machine.run(12.0, &[8.0, 3.0], 0.9) {
        let q = [q[0] + noise.draw(2e-4), q[1] + noise.draw(2e-4)];
        writeln!(table, "{t},{},{},{},{}", q[0], q[1], efforts[0], efforts[1]).unwrap();
    }
    let part = |label: u32, parent: &str, z: f64| {
        format!(
            "[[parts]]\nlabel = {label}\n{parent}joint = {{ type = \"revolute\", axis = [0, 1, 0], point = [0, 0, {z}], \
             position = \"q{label}\" }}\nframe = [0, 0, {z}]\nnoise = {{ position_m = 1e-4, rotation_rad = 3e-4 }}\n\
             [[wrenches]]\npart = {label}\neffort = \"tau{label}\"\n"
        )
    };
    let spec = format!("[time]\ncolumn = \"t\"\n{}{}", part(1, "", 0.0), part(2, "parent = 1\n", -0.3));
    let (table, spec) = (written(&folder, "chain.csv", &table), written(&folder, "chain.toml", &spec));
    let posterior = learned(folder.path(), &table, &spec, &[], &[]);
    for (child, parent, point) in [(1, posterior.root_label, down(0.0)), (2, Label(1), down(-0.3))] {
        let edge = edge(&posterior, child);
        assert!(edge.parent == parent && edge.probability > 0.95 && edge.joint_type.revolute > 0.95, "{edge:?}");
        let axis = edge.revolute.as_ref().unwrap();
        assert!(degrees_between(axis.axis_direction, Vector3::y()) < 0.1, "{axis:?}");
        assert!(axis_miss(axis.axis_direction, axis.axis_point_m, point) < 0.001, "{axis:?}");
    }
    for (child, inertia, friction) in
        [(1, machine.tree.joint_inertia(0), 0.08), (2, machine.tree.joint_inertia(1), 0.05)]
    {
        let edge = edge(&posterior, child);
        assert!((edge.joint_inertia.median / inertia - 1.0).abs() < 0.1, "{inertia}: {edge:?}");
        assert!((edge.friction.median / friction - 1.0).abs() < 0.25, "{friction}: {edge:?}");
    }
}

#[test]
fn errors_name_file_column_and_line() {
    let folder = tempfile::tempdir().unwrap();
    let spec = "[time]\ncolumn = \"t\"\n[[parts]]\nlabel = 1\nposition = [\"x\", \"y\", \"z\"]\n\
                noise = { position_m = 0.001 }\n[splits]\nfit = { share = [0.0, 0.5] }\n";
    let table = "t,x,y,z\n0,1,2,3\n1,1,2,3\n";
    let outcome = |table: &str, spec: &str, more: &[&str]| {
        let (table, spec) = (written(&folder, "table.csv", table), written(&folder, "spec.toml", spec));
        let bag = folder.path().join("out.mcap");
        let mut arguments = vec!["import", text(&table), "--spec", text(&spec), "-o", text(&bag)];
        arguments.extend(more);
        let outcome = bom(&arguments);
        assert_eq!(bag.exists(), outcome.status == 0);
        let _ = fs::remove_file(bag);
        outcome
    };
    assert_eq!(outcome(table, spec, &[]).status, 0);
    assert_eq!(outcome(table, spec, &["--split", "fit"]).status, 0);
    for (bad, spec, more, expected) in [
        (
            "t,x,y,z\n0,1,2,3\n1,1,two,3\n",
            spec.to_owned(),
            &[][..],
            "table.csv: line 3, column `y`: `two`, expected a number",
        ),
        (
            "t,x,y,z\n0,1,2,3\n1,1,2,nan\n",
            spec.to_owned(),
            &[],
            "table.csv: line 3, column `z`: `nan`, expected a number",
        ),
        (
            "t,x,y,z\n1,1,2,3\n0,1,2,3\n",
            spec.to_owned(),
            &[],
            "table.csv: line 3, column `t`: 0 s after 1 s, expected a later",
        ),
        ("t,x,y\n0,1,2\n", spec.to_owned(), &[], "table.csv: column `z`: not in the table, which has t, x, y"),
        ("t,x,y,z\n", spec.to_owned(), &[], "table.csv: no rows"),
        ("t,x,y,z\n0,1,2\n", spec.to_owned(), &[], "table.csv: CSV error: record 1 (line: 2"),
        (table, spec.replace("position_m", "position"), &[], "spec.toml: key `parts[0].noise.position`: unknown field"),
        (table, spec.replace("0.001", "-0.001"), &[], "spec.toml: key `parts[0].noise`: expected above 0"),
        (
            table,
            spec.replace("column = \"t\"", ""),
            &[],
            "spec.toml: key `time`: expected either `column` or `rate_hz`",
        ),
        (table, spec.to_owned(), &["--split", "test"], "--split test: "),
        (table, spec.to_owned(), &["--select", "x=7"], "table.csv: column `x`: no row holds `7`; it holds 1"),
    ] {
        let outcome = outcome(bad, &spec, more);
        assert_eq!(outcome.status, 1, "{expected}");
        assert!(outcome.err.contains(expected), "{} lacks {expected}", outcome.err);
        assert_eq!(outcome.err.lines().count(), 1, "{}", outcome.err);
    }
}

#[test]
fn a_row_with_an_empty_cell_is_left_out_and_counted() {
    let folder = tempfile::tempdir().unwrap();
    let parts = "[[parts]]\nlabel = 1\nposition = [\"x\", \"y\", \"z\"]\nnoise = { position_m = 0.001 }\n";
    let import = |table: &str, spec: &str| {
        let (table, spec) = (written(&folder, "table.csv", table), written(&folder, "spec.toml", spec));
        let bag = folder.path().join("out.mcap");
        bom(&["import", text(&table), "--spec", text(&spec), "-o", text(&bag)])
    };
    // A column that is not read may be empty; a cell that is read, or the time, may not.
    let table = "t,x,y,z,note\n0,1,2,3,\n1,1,,3,\n,1,2,3,\n2,1,2,3,a\n";
    let outcome = import(table, &format!("[time]\ncolumn = \"t\"\n{parts}"));
    assert_eq!(outcome.status, 0, "{outcome:?}");
    assert!(outcome.out.contains("2 readings (4 rows in"), "{}", outcome.out);
    assert!(outcome.out.contains("; 2 left out for an empty cell)"), "{}", outcome.out);
    let outcome = import("t,x,y,z\n0,1,2,3\n1,1,2,3\n", &format!("[time]\ncolumn = \"t\"\n{parts}"));
    assert!(!outcome.out.contains("left out"), "{}", outcome.out);
    // Of a sweep only the reading goes.
    let joint = "joint = { type = \"prismatic\", axis = [1, 0, 0], position = \"at\" }\n";
    let spec = format!(
        "[time]\nrate_hz = 10\n[sweep]\ncolumns = \"f{{}}\"\nfrom = 0\nto = 2\nindex = \"at\"\nvalue = \"f\"\n\
         pause_s = 1\n[[parts]]\nlabel = 1\n{joint}noise = {{ position_m = 0.001, rotation_rad = 0.001 }}\n\
         [[wrenches]]\npart = 1\neffort = \"f\"\n"
    );
    let outcome = import("f0,f1,f2\n1,,3\n4,5,6\n", &spec);
    assert!(outcome.out.contains("5 readings (2 rows in"), "{outcome:?}");
    assert!(outcome.out.contains("; 1 left out for an empty cell)"), "{outcome:?}");
}

#[test]
fn a_robots_hook_tells_the_cabinets_hinge() {
    let Some(table) = measured("pr2_door/ikea_cabinet_log.csv") else { return };
    let folder = tempfile::tempdir().unwrap();
    let posterior = learned(folder.path(), &table, &ours("config/import/pr2_door.toml"), &[], &[]);
    let edge = edge(&posterior, 1);
    assert!(edge.joint_type.revolute > 0.95, "{edge:?}");
    let axis = edge.revolute.as_ref().unwrap();
    let start = Vector3::new(1.05240158, -0.354913041, 0.104500952);
    let radius = axis_miss(axis.axis_direction, axis.axis_point_m, start);
    assert!((radius - 0.30).abs() < 0.01, "{radius}");
}

#[test]
fn markers_tell_doors_from_a_drawer() {
    for (name, revolute) in [("dishwasher_001", true), ("right_door_001", true), ("drawer_001", false)] {
        let Some(table) = measured(&format!("pose_tracks/{name}.csv")) else { return };
        let folder = tempfile::tempdir().unwrap();
        // There is no force: a remark says so, on standard output.
        let posterior = learned(folder.path(), &table, &ours("config/import/pose_tracks.toml"), &[], &[]);
        let edge = edge(&posterior, 1);
        let found = if revolute { edge.joint_type.revolute } else { edge.joint_type.prismatic };
        assert!(found > 0.95, "{name}: {edge:?}");
    }
}

#[test]
fn a_measured_double_pendulum_is_a_chain() {
    let Some(table) = measured("double_pendulum/record_00.csv") else { return };
    let folder = tempfile::tempdir().unwrap();
    let spec = ours("config/import/double_pendulum.toml");
    let posterior = learned(folder.path(), &table, &spec, &[], &[]);
    for (child, parent, z) in [(1, posterior.root_label, 0.0), (2, Label(1), -0.2)] {
        let edge = edge(&posterior, child);
        assert!(edge.parent == parent && edge.probability > 0.95 && edge.joint_type.revolute > 0.95, "{edge:?}");
        let axis = edge.revolute.as_ref().unwrap();
        assert!(degrees_between(axis.axis_direction, Vector3::y()) < 0.5, "{axis:?}");
        assert!(axis_miss(axis.axis_direction, axis.axis_point_m, Vector3::new(0.0, 0.0, z)) < 0.002, "{axis:?}");
    }
}

#[test]
fn a_measured_drive_has_its_published_parameters() {
    let Some(table) = measured("emps/emps.csv") else { return };
    let folder = tempfile::tempdir().unwrap();
    // Coulomb friction and an offset, as in the published fit, and nothing else.
    let config = folder.path().join("config.yaml");
    fs::write(&config, "model: {effects: [gravity_offset], criticism: false}\n").unwrap();
    let posterior = learned(folder.path(), &table, &ours("config/import/emps.toml"), &[], &["--config", text(&config)]);
    let edge = edge(&posterior, 1);
    assert!(edge.joint_type.prismatic > 0.95, "{edge:?}");
    for (quantity, published) in [(&edge.joint_inertia, 95.11), (&edge.damping, 203.5), (&edge.friction, 20.39)] {
        assert!((quantity.median / published - 1.0).abs() < 0.05, "{quantity:?}, published {published}");
    }
}

#[test]
fn openings_of_a_door_become_runs() {
    let Some(table) = measured("door_survey/doors.csv") else { return };
    let folder = tempfile::tempdir().unwrap();
    let door = ["--select", "mechanism=ikea_cabinet_pr2_robot"];
    let posterior = learned(folder.path(), &table, &ours("config/import/door_survey.toml"), &door, &[]);
    assert!(posterior.windows.len() >= 10, "{}", posterior.windows.len());
    assert!(edge(&posterior, 1).joint_type.revolute > 0.95);
}
