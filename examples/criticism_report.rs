//! Writes `docs/criticism.md` with its plots: what criticism finds in the measured records and in the bags
//! with undeclared physics that lie beside this repository.
//!
//! `cargo run --release --example criticism_report`; the part on own objects is kept as
//! `criticism_benchmark` last printed it into `docs/criticism_benchmark.md`.
#![allow(clippy::print_stderr, reason = "a program for the command line")]

#[path = "criticism_report/doors.rs"]
mod doors;
#[path = "criticism_report/plot.rs"]
mod plot;
#[path = "criticism_report/study.rs"]
mod study;

use std::fmt::Write as _;
use std::fs;
use std::path::{Path, PathBuf};

use anyhow::Context;
use bayesian_object_models::io::config::Config;
use study::{Calibration, Learned, Study, import, learn};

fn main() -> anyhow::Result<()> {
    let root = Path::new(env!("CARGO_MANIFEST_DIR"));
    let (measured, bags) = (root.join("../shared/measured"), root.join("../shared/bags"));
    let docs = root.join("docs");
    fs::create_dir_all(docs.join("criticism"))?;
    let scratch = tempfile::tempdir()?;
    let mut text = include_str!("criticism_report/method.md").to_owned();
    text.push_str("\n## Bags with undeclared physics\n");
    text.push_str(
        "\nErrors are of windows scored before they are learned. *Told* is a model that has the effect \
         declared from the start, of the sensor one whose readings were corrected by the truth.\n",
    );
    for name in ["catch", "spring", "delay", "bias"] {
        let bag = bags.join(format!("undeclared_{name}"));
        if bag.is_dir() {
            eprintln!("undeclared_{name}");
            bag_section(&mut text, name, &bag, &docs)?;
            fs::write(docs.join("criticism.md"), &text)?;
        } else {
            let _ = writeln!(text, "\nSKIPPED: undeclared_{name} is not beside the repository.");
        }
    }
    text.push_str("\n## Measured records\n");
    if measured.is_dir() {
        for study in studies(&measured, root, scratch.path())? {
            eprintln!("{}", study.name);
            section(&mut text, &study.run()?, &docs)?;
            fs::write(docs.join("criticism.md"), &text)?;
        }
        eprintln!("door_survey");
        doors::section(&mut text, &measured.join("door_survey/doors.csv"), root, scratch.path())?;
        fs::write(docs.join("criticism.md"), &text)?;
    } else {
        text.push_str("\nSKIPPED: the records are not beside the repository.\n");
    }
    if let Ok(own) = fs::read_to_string(docs.join("criticism_benchmark.md")) {
        text.push('\n');
        text.push_str(&own);
    }
    fs::write(docs.join("criticism.md"), text).context("docs/criticism.md")
}

/// The measured sets: what is learned from, what is scored on.
fn studies(measured: &Path, root: &Path, scratch: &Path) -> anyhow::Result<Vec<Study>> {
    let spec = |name: &str| root.join("config/import").join(name);
    let bag = |name: &str| scratch.join(format!("{name}.mcap"));
    let mut studies = Vec::new();
    let split = |table: &str, toml: &str, config: &str, name: &'static str, select: &[(&str, &str)]| {
        let table = measured.join(table);
        let parts = ["fit", "score"].map(|split| bag(&format!("{name}_{split}")));
        for (split, part) in ["fit", "score"].into_iter().zip(&parts) {
            import(&table, &spec(toml), Some(split), select, part)?;
        }
        let [fit, score] = parts;
        let config = Config::from_file(&spec(config))?;
        Ok::<_, anyhow::Error>(Study { name, fit: vec![fit], score: vec![score], config })
    };
    studies.push(split("emps/emps.csv", "emps.toml", "emps.yaml", "emps", &[])?);
    studies.push(split("pr2_door/ikea_cabinet_log.csv", "pr2_door.toml", "pr2_door.yaml", "pr2_door", &[])?);
    for (name, toml) in
        [("double_pendulum", "double_pendulum.toml"), ("double_pendulum_measured", "double_pendulum_measured.toml")]
    {
        let part = |record: &str| -> anyhow::Result<PathBuf> {
            let part = bag(&format!("{name}_{record}"));
            let table = measured.join(format!("double_pendulum/record_{record}.csv"));
            import(&table, &spec(toml), None, &[], &part)?;
            Ok(part)
        };
        let config = Config::from_file(&spec("double_pendulum.yaml"))?;
        let (fit, score) = (["00", "02", "04"].map(part), ["06", "08"].map(part));
        let all = |parts: Vec<anyhow::Result<PathBuf>>| parts.into_iter().collect::<anyhow::Result<Vec<_>>>();
        studies.push(Study { name, fit: all(fit.into())?, score: all(score.into())?, config });
    }
    Ok(studies)
}

/// One measured set.
fn section(text: &mut String, (study, learned, scores): &study::Outcome, docs: &Path) -> anyhow::Result<()> {
    let _ = writeln!(text, "\n### {}\n", study.name);
    text.push_str(&learned.finding());
    text.push_str("\nOn data not fitted, from the declared physics on:\n\n");
    text.push_str(&study::ladder(scores));
    text.push_str(&learned.declined());
    text.push_str(&plot::residuals(scores, study.name, docs)?);
    Ok(())
}

fn bag_section(text: &mut String, name: &str, bag: &Path, docs: &Path) -> anyhow::Result<()> {
    let mut told = Config::default();
    let bags = [bag.to_owned()];
    let learned = learn(&bags, &told, &Calibration::default())?;
    let _ = writeln!(text, "\n### undeclared_{name}\n");
    text.push_str(&learned.finding());
    let told = if matches!(name, "bias" | "delay") {
        learn(&bags, &told, &Calibration::of_truth(bag)?)?
    } else {
        told.model.effects = serde_json::from_str(&format!("[\"{name}\"]"))?;
        learn(&bags, &told, &Calibration::default())?
    };
    text.push('\n');
    text.push_str(&prequential(&learned, &told));
    text.push_str(&learned.declined());
    let scores = learned.fitted_scores(1.0);
    text.push_str(&plot::residuals(&scores, &format!("undeclared_{name}"), docs)?);
    Ok(())
}

/// Before and after, each window scored before it was learned, and by a model that was told.
fn prequential(learned: &Learned, told: &Learned) -> String {
    let mut text = String::from("| part | before | after | told |\n|---|---|---|---|\n");
    let found = learned.criticism();
    let of_told = told.criticism();
    let cell = study::residual_cell;
    for (before, after) in found.before.iter().zip(&found.after) {
        let told = of_told.after.iter().find(|row| row.label == before.label);
        let told = told.map_or_else(|| "-".to_owned(), cell);
        let _ = writeln!(text, "| {} | {} | {} | {told} |", before.label, cell(before), cell(after));
    }
    text
}
