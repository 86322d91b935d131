//! Criticism on the public records beside this repository: what it finds from rigid bodies and viscous damping
//! on one part of a record, and what that leaves unexplained on another.
#![allow(clippy::unwrap_used)]

mod command;

use std::{fs, path::Path};

use bayesian_object_models::io::document::PosteriorDocument;
use command::{bom, measured, ours};
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

    /// By model on the way: its effects, and force and position of the parts [N or N·m, m or rad].
    fn ladder(&self, bag: &str) -> Vec<(Vec<String>, Vec<(f64, f64)>)> {
        let (model, bag, scores) = (self.path("model.json"), self.path(bag), self.path("scores.json"));
        done(&["evaluate", &model, &bag, "--config", &self.config, "--json", &scores]);
        let scores: Value = serde_json::from_str(&fs::read_to_string(scores).unwrap()).unwrap();
        let number = |value: &Value| value.as_f64().unwrap();
        let part = |row: &Value| match row.get("force_rmse_N") {
            Some(force) => (number(force), number(&row["position_rmse_m"])),
            None => (number(&row["torque_rmse_Nm"]), number(&row["rotation_rmse_rad"])),
        };
        let step = |step: &Value| {
            let names = step["effects"].as_array().unwrap().iter().map(|e| e["name"].as_str().unwrap().to_owned());
            (names.collect(), step["residuals"].as_array().unwrap().iter().map(part).collect())
        };
        scores["steps"].as_array().unwrap().iter().map(step).collect()
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
    let offset = ladder.iter().find(|(effects, _)| has(effects, "friction") && has(effects, "gravity_offset"));
    let (_, parts) = offset.unwrap_or_else(|| panic!("no step with an offset: {ladder:?}"));
    assert!(parts[0].0 <= 3.5 && parts[0].1 <= 2.0e-3, "{ladder:?}");
    let (last, parts) = ladder.last().unwrap();
    assert!(has(last, "asymmetric_friction") && parts[0].0 <= 3.1, "{ladder:?}");
}

#[test]
fn a_drive_with_friction_and_an_offset_has_its_published_parameters() {
    let Some(table) = measured("emps/emps.csv") else { return };
    let mut study = Study::new("emps");
    study.config = study.path("told.yaml");
    fs::write(&study.config, "model: { effects: [gravity_offset] }\nwindows: { longest_s: 2.5 }\n").unwrap();
    study.import(&table, "emps", "all.mcap", &[]);
    let posterior = study.learn("all.mcap", &[]).posterior;
    let edge = posterior.edges.iter().find(|edge| edge.child.0 == 1).unwrap();
    for (quantity, published) in [(&edge.joint_inertia, 95.11), (&edge.damping, 203.50), (&edge.friction, 20.39)] {
        assert!((quantity.median / published - 1.0).abs() < 0.05, "{quantity:?}, published {published}");
    }
}
