//! What `bom evaluate` found: a table and a JSON document.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::io::Write;

use serde::Serialize;

use crate::io::counters::Counters;
use crate::io::document::DocumentError;
use crate::pipeline::{PartScore, Scores, StageScore};
use crate::types::Label;
use crate::types::finite::check_finite;

/// Name and version of the format.
pub const SCHEMA: &str = "bom.evaluation/1";

/// The whole document.
#[derive(Clone, Debug, PartialEq, Serialize)]
pub struct Evaluation {
    schema: &'static str,
    model: String,
    bag: String,
    /// The model has learned this very bag: its scores are not of anything new.
    was_learned: bool,
    horizon_s: f64,
    windows: usize,
    /// By the model as first declared.
    before: Vec<Residuals>,
    /// With what criticism added.
    after: Vec<Residuals>,
    /// The models on the way from the one to the other, both included.
    steps: Vec<Step>,
    counters: Counters,
}

/// One model.
#[derive(Clone, Debug, PartialEq, Serialize)]
struct Step {
    /// What it has beyond the declared physics.
    effects: Vec<EffectName>,
    residuals: Vec<Residuals>,
    /// By part, what the model says of its joint, SI units.
    parameters: BTreeMap<Label, BTreeMap<String, f64>>,
}

#[derive(Clone, Debug, PartialEq, Serialize)]
struct EffectName {
    name: &'static str,
    label: Option<Label>,
}

impl Step {
    fn of(stage: &StageScore) -> Self {
        let effects = stage.effects.iter().map(|(label, name)| EffectName { name, label: *label });
        Self { effects: effects.collect(), residuals: residuals_of(stage), parameters: stage.values.clone() }
    }
}

fn residuals_of(stage: &StageScore) -> Vec<Residuals> {
    stage.parts.iter().map(|(label, part)| Residuals::of(*label, part)).collect()
}

/// Root mean squares of one part.
#[derive(Clone, Copy, Debug, PartialEq, Serialize)]
struct Residuals {
    label: Label,
    scored_windows: usize,
    #[serde(rename = "force_rmse_N", skip_serializing_if = "Option::is_none")]
    force_rmse_n: Option<f64>,
    #[serde(rename = "torque_rmse_Nm", skip_serializing_if = "Option::is_none")]
    torque_rmse_nm: Option<f64>,
    position_rmse_m: f64,
    rotation_rmse_rad: f64,
}

impl Residuals {
    fn of(label: Label, part: &PartScore) -> Self {
        let rms = |square: f64, count: f64| (count > 0.0).then(|| (square / count).sqrt());
        let force = rms(part.force.0, part.force.1);
        let position = rms(part.position.0, part.position.1 as f64).unwrap_or_default();
        Self {
            label,
            scored_windows: part.windows,
            force_rmse_n: force.filter(|_| !part.turns),
            torque_rmse_nm: force.filter(|_| part.turns),
            position_rmse_m: if part.turns { position * part.radius_m } else { position },
            rotation_rmse_rad: if part.turns { position } else { 0.0 },
        }
    }
}

impl Evaluation {
    /// From the scores of a bag.
    pub fn new(model: &str, bag: &str, was_learned: bool, horizon_s: f64, scores: &Scores, counters: Counters) -> Self {
        let residuals = |stage: Option<&StageScore>| stage.map(residuals_of).unwrap_or_default();
        Self {
            schema: SCHEMA,
            model: model.to_owned(),
            bag: bag.to_owned(),
            was_learned,
            horizon_s,
            windows: scores.windows,
            before: residuals(scores.stages.first()),
            after: residuals(scores.stages.last()),
            steps: scores.stages.iter().map(Step::of).collect(),
            counters,
        }
    }

    /// Writes it as JSON, with a line's end.
    ///
    /// # Errors
    /// A number that is not finite, by name, before anything is written; or what the system said.
    pub fn write(&self, mut to: impl Write) -> Result<(), DocumentError> {
        check_finite(self)?;
        serde_json::to_writer_pretty(&mut to, self)?;
        writeln!(to).map_err(serde_json::Error::io)?;
        Ok(())
    }
}

/// The table, as lines.
pub fn table(evaluation: &Evaluation) -> String {
    let Evaluation { bag, model, horizon_s, windows, .. } = evaluation;
    let plural = if *windows == 1 { "" } else { "s" };
    let mut text =
        format!("{bag}: {windows} window{plural}, scored by {model} over {horizon_s} s, nothing learned\n\n");
    let _ = writeln!(text, "part  windows   position   rotation        force");
    for (row, before) in evaluation.before.iter().enumerate() {
        let _ = writeln!(text, "{:>4}  {:>7}  {}", before.label.0, before.scored_windows, columns(before));
        for step in evaluation.steps.iter().skip(1) {
            if let Some(residuals) = step.residuals.get(row) {
                let names: Vec<&str> = step.effects.iter().map(|effect| effect.name).collect();
                let _ = writeln!(text, "{:>13}  {}  with {}", "", columns(residuals), names.join(", "));
            }
        }
    }
    if evaluation.before.is_empty() {
        let _ = writeln!(text, "No part that the model has a joint for moved.");
    }
    if evaluation.was_learned {
        let _ = writeln!(text, "! the model has learned this bag: these are residuals, not predictions");
    }
    text
}

fn columns(residuals: &Residuals) -> String {
    let force = match (residuals.force_rmse_n, residuals.torque_rmse_nm) {
        (Some(force), _) => format!("{force:.3} N"),
        (_, Some(torque)) => format!("{torque:.3} N·m"),
        _ => "-".to_owned(),
    };
    let (millimetres, degrees) = (1e3 * residuals.position_rmse_m, residuals.rotation_rmse_rad.to_degrees());
    format!("{millimetres:>6.2} mm  {degrees:>8.3}°  {force:>11}")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_part_is_a_line_and_every_model_with_effects_another() {
        let slide = PartScore { windows: 2, force: (0.5, 2.0), position: (4e-6, 4), ..PartScore::default() };
        let hinge = PartScore { turns: true, radius_m: 0.5, ..slide.clone() };
        let stage = |effects: &[(Option<Label>, &'static str)], parts: [PartScore; 2]| StageScore {
            effects: effects.to_vec(),
            parts: [Label(1), Label(5)].into_iter().zip(parts).collect(),
            values: BTreeMap::from([(Label(1), BTreeMap::from([("damping".to_owned(), 7.0)]))]),
        };
        let less = PartScore { force: (0.02, 2.0), ..slide.clone() };
        let stages = vec![stage(&[], [slide, hinge.clone()]), stage(&[(Some(Label(1)), "spring")], [less, hinge])];
        let scores = Scores { windows: 3, stages };
        let evaluation = Evaluation::new("m.json", "a.mcap", true, 1.0, &scores, Counters::default());
        let expected = "a.mcap: 3 windows, scored by m.json over 1 s, nothing learned

part  windows   position   rotation        force
   1        2    1.00 mm     0.000°      0.500 N
                 1.00 mm     0.000°      0.100 N  with spring
   5        2    0.50 mm     0.057°    0.500 N·m
                 0.50 mm     0.057°    0.500 N·m  with spring
! the model has learned this bag: these are residuals, not predictions
";
        assert_eq!(table(&evaluation), expected);
        let value = serde_json::to_value(&evaluation).unwrap();
        assert_eq!(value["before"][1]["torque_rmse_Nm"], 0.5);
        assert_eq!(value["steps"][1]["parameters"]["1"]["damping"], 7.0);
        assert!(value["before"][1].get("force_rmse_N").is_none());
        assert_eq!(value["steps"][1]["effects"][0]["name"], "spring");
    }
}
