//! Criticism on the public records beside this repository: what it finds from rigid bodies and viscous damping
//! on one part of a record, and what that leaves unexplained on another. And on a simulated pendulum, where the truth is known.
#![allow(clippy::unwrap_used)]

mod command;

use std::{fs, path::Path};

use bayesian_object_models::io::document::PosteriorDocument;
use bayesian_object_models::math::Screw;
use bayesian_object_models::mechanism::effects::{AttachedEffect, EffectKind};
use bayesian_object_models::mechanism::{
    Body, JointParameters, JointType, State, Tree, WrenchSample, WrenchTrack, rollout,
};
use bayesian_object_models::types::posterior::Criticism;
use command::{bom, measured, ours};
use nalgebra::{Matrix3, Vector3};
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;
use serde_json::Value;

fn text(path: &Path) -> &str {
    path.to_str().unwrap()
}

fn done(arguments: &[&str]) {
    let outcome = bom(arguments);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{arguments:?}: {outcome:?}");
}

/// A record that is learned and others that it is scored on.
struct Study {
    folder: tempfile::TempDir,
    config: String,
}

impl Study {
    fn new(name: &str) -> Self {
        let config = text(&ours(&format!("config/import/{name}.yaml"))).to_owned();
        Self { folder: tempfile::tempdir().unwrap(), config }
    }

    fn path(&self, name: &str) -> String {
        text(&self.folder.path().join(name)).to_owned()
    }

    fn import(&self, table: &Path, spec: &str, bag: &str, more: &[&str]) {
        let spec = ours(&format!("config/import/{spec}.toml"));
        let bag = self.path(bag);
        done(&[&["import", text(table), "--spec", text(&spec), "-o", &bag], more].concat());
    }

    fn learn(&self, bag: &str, more: &[&str]) -> PosteriorDocument {
        let (bag, model, posterior) = (self.path(bag), self.path("model.json"), self.path("posterior.json"));
        let arguments = ["replay", &bag, "--config", &self.config, "--save-model", &model, "--posterior", &posterior];
        done(&[&arguments, more].concat());
        serde_json::from_str(&fs::read_to_string(posterior).unwrap()).unwrap()
    }

    /// The models on the way, scored.
    fn steps(&self, bag: &str) -> Vec<Value> {
        let (model, bag, scores) = (self.path("model.json"), self.path(bag), self.path("scores.json"));
        done(&["evaluate", &model, &bag, "--config", &self.config, "--json", &scores]);
        let scores: Value = serde_json::from_str(&fs::read_to_string(scores).unwrap()).unwrap();
        scores["steps"].as_array().unwrap().clone()
    }

    /// By model on the way: its effects, and force and position of the parts [N or N·m, m or rad].
    fn ladder(&self, bag: &str) -> Vec<(Vec<String>, Vec<(f64, f64)>)> {
        let number = |value: &Value| value.as_f64().unwrap();
        let part = |row: &Value| match row.get("force_rmse_N") {
            Some(force) => (number(force), number(&row["position_rmse_m"])),
            None => (number(&row["torque_rmse_Nm"]), number(&row["rotation_rmse_rad"])),
        };
        let step = |step: &Value| {
            let names = step["effects"].as_array().unwrap().iter().map(|e| e["name"].as_str().unwrap().to_owned());
            (names.collect(), step["residuals"].as_array().unwrap().iter().map(part).collect())
        };
        self.steps(bag).iter().map(step).collect()
    }
}

fn has(effects: &[String], name: &str) -> bool {
    effects.iter().any(|effect| effect == name)
}

#[test]
fn a_drive_lacks_friction_then_an_offset_then_damping_by_direction() {
    let Some(table) = measured("emps/emps.csv") else { return };
    let study = Study::new("emps");
    for split in ["fit", "score"] {
        study.import(&table, "emps", &format!("{split}.mcap"), &["--split", split]);
    }
    study.learn("fit.mcap", &[]);
    let ladder = study.ladder("score.mcap");
    let (_, base) = &ladder[0];
    assert!(base[0].0 > 8.0 && base[0].1 > 5e-3, "{base:?}");
    let (first, _) = &ladder[1];
    assert_eq!(first, &["friction"], "friction explains most");
    let (offset, parts) = &ladder[2];
    assert_eq!(offset, &["friction", "gravity_offset"]);
    assert!(parts[0].0 <= 3.5 && parts[0].1 <= 2.0e-3, "{ladder:?}");
    // As published, by inverse dynamics over the whole record (an offset of -3.16 N pulls against us by 3.16 N).
    let values = &study.steps("score.mcap")[2]["parameters"]["1"];
    for (name, published) in [("inertia", 95.11), ("damping", 203.50), ("friction", 20.39)] {
        let value = values[name].as_f64().unwrap();
        assert!((value / published - 1.0).abs() < 0.05, "{name}: {values}");
    }
    // What is left goes by direction, and is named so.
    let (last, parts) = ladder.last().unwrap();
    assert!(has(last, "asymmetric_friction") && !has(last, "unknown"), "{ladder:?}");
    assert!(parts[0].0 <= 3.1 && parts[0].1 <= 2.0e-3, "{ladder:?}");
}

#[test]
fn a_cabinets_hinge_closes_itself() {
    let Some(table) = measured("pr2_door/ikea_cabinet_log.csv") else { return };
    let study = Study::new("pr2_door");
    for split in ["fit", "score"] {
        study.import(&table, "pr2_door", &format!("{split}.mcap"), &["--split", split]);
    }
    let criticism = study.learn("fit.mcap", &[]).posterior.criticism;
    let first = criticism.effects.first().unwrap();
    assert!(["self_closing", "position_friction"].contains(&first.name.as_str()), "{criticism:?}");
    // In the first half second the door goes 3 deg, and the wrist reads nothing: that is a push of something else.
    for other in &criticism.effects[1..] {
        assert_eq!(other.name, "impulse", "{criticism:?}");
        assert!(other.parameters["start"].median < 0.6, "{criticism:?}");
    }
    let ladder = study.ladder("score.mcap");
    // A door that nothing could move, or that a stop held, would leave no force.
    let (_, base) = &ladder[0];
    assert!(base[0].0 > 0.9, "{ladder:?}");
    let (first, parts) = &ladder[1];
    assert_eq!(first, &[criticism.effects[0].name.as_str()]);
    assert!(parts[0].0 <= 0.5 && parts[0].1 < 0.5 * base[0].1, "{ladder:?}");
    // The pulse is of one window, and tells the others nothing.
    assert!(ladder.last().unwrap().1[0].0 <= 0.5, "{ladder:?}");
}

#[test]
fn motors_rub_and_answer_late() {
    let Some(table) = measured("double_pendulum/record_00.csv") else { return };
    let Some(other) = measured("double_pendulum/record_06.csv") else { return };
    let study = Study::new("double_pendulum");
    study.import(&table, "double_pendulum", "fit.mcap", &[]);
    study.import(&other, "double_pendulum", "score.mcap", &[]);
    let criticism = study.learn("fit.mcap", &[]).posterior.criticism;
    let delay = criticism.effects.iter().find(|effect| effect.name == "wrench_delay");
    let delay = &delay.unwrap_or_else(|| panic!("{criticism:?}")).parameters["delay"];
    assert!(delay.q95 < 0.0, "torques act after their stamps: {delay:?}");
    assert_eq!(criticism.effects.len(), 3, "friction of both, the delay and nothing else: {criticism:?}");
    let ladder = study.ladder("score.mcap");
    let (_, base) = &ladder[0];
    let (first, parts) = &ladder[1];
    assert_eq!(first, &["friction", "friction"], "on both joints");
    for (before, after) in base.iter().zip(parts) {
        assert!(after.1 < 0.6 * before.1, "{ladder:?}");
    }
    let (_, late) = ladder.iter().find(|(effects, _)| has(effects, "wrench_delay")).unwrap();
    for (before, after) in parts.iter().zip(late) {
        assert!(after.1 < before.1, "{ladder:?}");
    }
    // An offset is none of it.
    assert!(ladder.iter().all(|(effects, _)| !has(effects, "gravity_offset")), "{ladder:?}");
}

/// Reflected inertia of the second motor \[kg·m²\], friction of both \[N·m\].
const MOTORS: (f64, [f64; 2]) = (0.006, [0.25, 0.19]);

/// Where the encoders of the simulated records count from \[rad\].
const ZEROS: [[f64; 2]; 2] = [[0.0, 0.0], [-0.05, 0.08]];

/// Records of two links in a chain as the double pendulum's are, its motors geared.
fn geared_pendulum(record: usize) -> String {
    let link = |k: usize| {
        let at = Vector3::new(0.0, 0.0, -0.2 * k as f64);
        let (mass, com, about_com) = [(0.6, -0.06, 0.018), (0.8, -0.2, 0.016)][k];
        let mut parameters = JointParameters::new(0.003, MOTORS.1[k]);
        if k == 1 {
            parameters.effects.push(AttachedEffect::new(EffectKind::ReflectedInertia, &[MOTORS.0]));
        }
        Body {
            joint: JointType::Revolute,
            screw: Screw::revolute(&Vector3::y(), &at),
            mass,
            com_in_world: at + Vector3::new(0.0, 0.0, com),
            inertia_about_com: Matrix3::identity() * about_com,
            parameters,
            ..Body::rigid(k.checked_sub(1))
        }
    };
    let tree = Tree::new(vec![link(0), link(1)], Vector3::new(0.0, 0.0, -9.81)).unwrap();
    let torques = |t: f64| match record {
        0 => [0.6 * (2.5 * t).sin(), 0.5 * (3.7 * t + 0.5).sin()],
        _ => [0.8 * (1.9 * t + 0.7).sin(), 0.4 * (4.3 * t).sin()],
    };
    let times: Vec<f64> = (0..2500).map(|k| 0.004 * f64::from(k)).collect();
    // The second motor stands on the first link.
    let acting = |k: usize| -> Vec<WrenchSample> {
        let torque = |t: f64| if k == 0 { torques(t)[0] - torques(t)[1] } else { torques(t)[1] };
        let sample = |&stamp_s: &f64| WrenchSample {
            stamp_s,
            point_in_world: Vector3::zeros(),
            force_in_world: Vector3::zeros(),
            torque_in_world: Vector3::y() * torque(stamp_s),
        };
        times.iter().map(sample).collect()
    };
    let (first, second) = (acting(0), acting(1));
    let tracks = [WrenchTrack::new(0, &first), WrenchTrack::new(1, &second)];
    let run = rollout(&tree, &State::new(vec![0.0; 2], vec![0.0; 2]), &tracks, &times, 1e-3).unwrap();
    let mut rng = ChaCha8Rng::seed_from_u64(7);
    let mut table = "t_s,q1_rad,q2_rad,tau1_commanded_Nm,tau2_commanded_Nm\n".to_owned();
    for (k, t) in times.iter().enumerate() {
        let noise = |q: &f64| q + 3e-4 * rng.sample::<f64, _>(StandardNormal);
        let noisy: Vec<f64> = run.positions(k).iter().map(noise).collect();
        let seen: Vec<f64> = noisy.iter().zip(ZEROS[record]).map(|(q, zero)| q + zero).collect();
        let [first, second] = torques(*t);
        table += &format!("{t},{},{},{first},{second}\n", seen[0], seen[1]);
    }
    table
}

#[test]
fn a_motor_behind_a_gear_is_told_from_its_link() {
    let study = Study::new("double_pendulum");
    let table = study.folder.path().join("geared.csv");
    fs::write(&table, geared_pendulum(0)).unwrap();
    study.import(&table, "double_pendulum", "fit.mcap", &[]);
    has_friction_and_a_motor(&study.learn("fit.mcap", &[]).posterior.criticism);
    // Switched on again elsewhere: what gravity then seems to do is no effect, and moves no number.
    fs::write(&table, geared_pendulum(1)).unwrap();
    study.import(&table, "double_pendulum", "again.mcap", &[]);
    let model = study.path("model.json");
    let first = study.path("first.json");
    fs::copy(&model, &first).unwrap();
    has_friction_and_a_motor(&study.learn("again.mcap", &["--load-model", &first]).posterior.criticism);
}

/// Of the simulated records, and nothing else.
fn has_friction_and_a_motor(criticism: &Criticism) {
    let found = |name: &str, label: u32| {
        let effect = criticism.effects.iter().find(|e| e.name == name && e.label.is_some_and(|l| l.0 == label));
        effect.unwrap_or_else(|| panic!("{name} on {label}: {criticism:?}"))
    };
    assert_eq!(criticism.effects.len(), 3, "friction of both, the motor and nothing else: {criticism:?}");
    let motor = &found("reflected_inertia", 2).parameters["inertia"];
    assert!(motor.q05 < MOTORS.0 && MOTORS.0 < motor.q95 && motor.q95 < 1.2 * motor.q05, "{motor:?}");
    for (label, truth) in (1..).zip(MOTORS.1) {
        let effect = found("friction", label);
        let friction = &effect.parameters["friction"];
        assert!(effect.probability > 0.9, "{effect:?}");
        assert!(friction.q05 < truth && truth < friction.q95, "{label}: {friction:?}");
    }
}

#[test]
fn a_cabinet_door_closes_itself_by_static_forces_alone() {
    let Some(table) = measured("door_survey/doors.csv") else { return };
    let study = Study::new("door_survey");
    for split in ["fit", "score"] {
        let door = ["--select", "mechanism=HSI_kitchen_cabinet_right_charlie", "--split", split];
        study.import(&table, "door_survey", &format!("{split}.mcap"), &door);
    }
    study.learn("fit.mcap", &[]);
    let ladder = study.ladder("score.mcap");
    let (last, parts) = ladder.last().unwrap();
    assert!(has(last, "self_closing") && !has(last, "unknown"), "{ladder:?}");
    assert!(parts[0].0 < 0.3 * ladder[0].1[0].0, "{ladder:?}");
}
