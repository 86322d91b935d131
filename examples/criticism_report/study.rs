//! One record or several: learned from, scored on others.

use std::fmt::Write as _;
use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use bayesian_object_models::io::bag::Bag;
use bayesian_object_models::io::config::Config;
use bayesian_object_models::io::import::{self as importing, ImportSpec, Table};
use bayesian_object_models::io::ingest::Ingest;
use bayesian_object_models::io::model_file::{SavedModel, write_model};
use bayesian_object_models::pipeline::{PartScore, Pipeline, Scores, StageScore};
use bayesian_object_models::types::posterior::{Criticism, Quantity, ResidualScore, Verdict};
use bayesian_object_models::types::{AppliedWrench, Input};
use nalgebra::Vector3;

/// Parameters of an effect that are written out at most; tables have more.
const MOST_PARAMETERS: usize = 6;

/// What is learned from and scored on.
pub struct Study {
    /// Its name, also of its plots.
    pub name: &'static str,
    /// Bags to learn, one after the other.
    pub fit: Vec<PathBuf>,
    /// Bags to score on.
    pub score: Vec<PathBuf>,
    /// What is declared.
    pub config: Config,
}

/// A study with its results.
pub type Outcome = (Study, Learned, Scores);

/// A pipeline that has learned.
pub struct Learned(Pipeline);

impl Study {
    /// Learns and scores.
    pub fn run(self) -> anyhow::Result<Outcome> {
        let learned = learn(&self.fit, &self.config, &Calibration::default())?;
        let scores = score(&learned, &self.score, &self.config)?;
        Ok((self, learned, scores))
    }
}

/// A table, or a split of it, as a bag.
pub fn import(
    table: &Path,
    spec: &Path,
    split: Option<&str>,
    select: &[(&str, &str)],
    bag: &Path,
) -> anyhow::Result<()> {
    let mut spec = ImportSpec::from_file(spec)?;
    spec.select.extend(select.iter().map(|(column, text)| ((*column).to_owned(), (*text).to_owned())));
    let split = match split {
        Some(name) => Some(spec.splits.get(name).with_context(|| format!("no split {name}"))?.clone()),
        None => None,
    };
    importing::import(Table::from_file(table)?, &spec, split.as_ref(), bag)?;
    Ok(())
}

/// Errors of a wrench sensor that are known: readings are corrected before anything sees them.
#[derive(Clone, Copy, Debug, Default)]
pub struct Calibration {
    /// A constant in the readings, in world axes \[N\].
    pub bias: Vector3<f64>,
    /// Reports are late by this \[s\].
    pub delay_s: f64,
}

impl Calibration {
    /// The sensor's errors in a simulated bag, whose tool frame has the axes of the world.
    pub fn of_truth(bag: &Path) -> anyhow::Result<Self> {
        let text = std::fs::read_to_string(bag.join("truth.json")).context("truth.json")?;
        let truth: serde_json::Value = serde_json::from_str(&text)?;
        let number = |value: &serde_json::Value| value.as_f64().context("truth.json: a number is missing");
        let [x, y, z] = [0, 1, 2].map(|axis| number(&truth["bias_N"][axis]));
        Ok(Self { bias: Vector3::new(x?, y?, z?), delay_s: number(&truth["delay_s"])? })
    }

    fn corrected(&self, input: Input) -> Input {
        match input {
            Input::Wrench(wrench) => Input::Wrench(AppliedWrench {
                stamp: wrench.stamp.plus_seconds(-self.delay_s),
                force_in_world: wrench.force_in_world - self.bias,
                ..wrench
            }),
            other => other,
        }
    }
}

/// Everything in a bag goes through a pipeline.
fn stream(pipeline: &mut Pipeline, bag: &Path, config: &Config, known: &Calibration) -> anyhow::Result<()> {
    let mut ingest = Ingest::new(&config.input);
    for message in Bag::open(bag)? {
        for input in ingest.push(&message.topic.name, &message.topic.type_name, message.bytes()) {
            pipeline.push(known.corrected(input));
        }
    }
    for input in ingest.flush() {
        pipeline.push(known.corrected(input));
    }
    pipeline.finish();
    Ok(())
}

/// Learns bags, one after the other; predictions are not asked for.
pub fn learn(bags: &[PathBuf], config: &Config, known: &Calibration) -> anyhow::Result<Learned> {
    let mut settings = config.pipeline_settings(None);
    settings.predict = false;
    let mut last: Option<Learned> = None;
    for bag in bags {
        let mut pipeline = match &last {
            None => Pipeline::new(settings.clone()),
            Some(learned) => Pipeline::resume(settings.clone(), learned.saved()?.object)?,
        };
        stream(&mut pipeline, bag, config, known)?;
        last = Some(Learned(pipeline));
    }
    let Some(learned) = last else { bail!("no bags") };
    Ok(learned)
}

/// Scores what was learned on other bags.
pub fn score(learned: &Learned, bags: &[PathBuf], config: &Config) -> anyhow::Result<Scores> {
    let mut settings = config.pipeline_settings(None);
    settings.predict = false;
    let mut all = Scores::default();
    for bag in bags {
        let saved = learned.saved()?.object;
        let mut pipeline = Pipeline::evaluate(settings.clone(), saved, config.evaluation_horizon_s)?;
        stream(&mut pipeline, bag, config, &Calibration::default())?;
        let scores = pipeline.scores().cloned().unwrap_or_default();
        all.windows += scores.windows;
        all.stages.resize_with(scores.stages.len().max(all.stages.len()), StageScore::default);
        for (sum, stage) in all.stages.iter_mut().zip(scores.stages) {
            sum.effects = stage.effects;
            sum.values.extend(stage.values);
            for (label, part) in stage.parts {
                add(sum.parts.entry(label).or_default(), part);
            }
        }
    }
    Ok(all)
}

fn add(sum: &mut PartScore, part: PartScore) {
    *sum = PartScore {
        windows: sum.windows + part.windows,
        force: (sum.force.0 + part.force.0, sum.force.1 + part.force.1),
        position: (sum.position.0 + part.position.0, sum.position.1 + part.position.1),
        residuals: sum.residuals.drain(..).chain(part.residuals).collect(),
        turns: part.turns,
        radius_m: part.radius_m,
    };
}

/// What every model on the way leaves, as a table.
pub fn ladder(scores: &Scores) -> String {
    let mut text = String::from("| model | part | residual force | position |\n|---|---|--:|--:|\n");
    for stage in &scores.stages {
        let names: Vec<&str> = stage.effects.iter().map(|(_, name)| *name).collect();
        let name = if names.is_empty() { "declared".to_owned() } else { names.join(", ") };
        for (label, part) in &stage.parts {
            let force = (part.force.0 / part.force.1.max(1e-9)).sqrt();
            let position = (part.position.0 / part.position.1.max(1) as f64).sqrt();
            let cells = if part.turns {
                format!("{force:.3} N·m | {:.2}°", position.to_degrees())
            } else {
                format!("{force:.2} N | {:.2} mm", 1e3 * position)
            };
            let _ = writeln!(text, "| {name} | {label} | {cells} |");
        }
    }
    text
}

/// One row's force and position.
pub fn residual_cell(row: &ResidualScore) -> String {
    let force = match (row.force_rmse_n, row.torque_rmse_nm) {
        (Some(force), _) => format!("{force:.2} N"),
        (_, Some(torque)) => format!("{torque:.3} N·m"),
        _ => "-".to_owned(),
    };
    format!("{force}, {:.1} mm", 1e3 * row.position_rmse_m)
}

impl Learned {
    fn saved(&self) -> anyhow::Result<SavedModel> {
        let snapshot = self.0.snapshot().context("nothing was learned")?;
        let mut text = Vec::new();
        write_model(&mut text, &[], &snapshot.saved())?;
        Ok(SavedModel::parse(&String::from_utf8(text)?, Path::new("model"))?)
    }

    /// What was found.
    pub fn criticism(&self) -> Criticism {
        self.0.posterior().map_or_else(Criticism::insufficient, |posterior| posterior.criticism)
    }

    /// The models on the way, on the windows that they were fitted to.
    pub fn fitted_scores(&self, horizon_s: f64) -> Scores {
        let learner = self.0.learner().zip(self.0.zero());
        learner.map_or_else(Scores::default, |(learner, zero)| learner.fitted_scores(zero, horizon_s))
    }

    /// The verdict, and the effects with their parameters and 90 % intervals.
    pub fn finding(&self) -> String {
        let criticism = self.criticism();
        let verdict = match criticism.verdict {
            Verdict::Adequate => "Adequate: nothing is missing.",
            Verdict::EffectFound => "Found:",
            Verdict::Unexplained => "Structured, and without a name:",
            Verdict::Insufficient => "Too few windows to be scored.",
        };
        let mut text = format!("{verdict}\n");
        for effect in &criticism.effects {
            let place = effect.label.map_or_else(|| "the sensor".to_owned(), |label| format!("part {label}"));
            let same = if effect.indistinguishable_from.is_empty() {
                String::new()
            } else {
                format!(" (or {})", effect.indistinguishable_from.join(", "))
            };
            let quantity = |(name, q): (&String, &Quantity)| {
                format!("{name} {:.3} [{:.3}, {:.3}] {}", q.median, q.q05, q.q95, q.unit)
            };
            let mut parameters: Vec<String> = effect.parameters.iter().take(MOST_PARAMETERS).map(quantity).collect();
            if effect.parameters.len() > MOST_PARAMETERS {
                parameters.push("…".to_owned());
            }
            let _ = writeln!(
                text,
                "- {}{same} on {place}, probability {:.2}: {}",
                effect.name,
                effect.probability,
                parameters.join("; ")
            );
        }
        text
    }

    /// What was refitted last and not taken.
    pub fn declined(&self) -> String {
        let selection = self.0.learner().and_then(|learner| learner.critic.selection.as_ref());
        let Some(selection) = selection.filter(|selection| !selection.declined.is_empty()) else {
            return String::new();
        };
        let joints = self.0.learner().map_or(&[][..], |learner| learner.joints());
        let name = |(addition, gain): &(bayesian_object_models::criticism::Addition, f64)| {
            let place = addition.joint().and_then(|joint| joints.get(joint)).map(|joint| joint.child);
            let place = place.map_or_else(|| "the sensor".to_owned(), |label| format!("part {label}"));
            format!("{} on {place} ({gain:.1} nats)", addition.name())
        };
        let names: Vec<String> = selection.declined.iter().map(name).collect();
        format!("\nDeclined at the end, with what each would gain: {}.\n", names.join(", "))
    }
}
