//! Joints that move together and are seen by clouds: criticism foretells their windows, and looks for effects where
//! that leaves too much.
#![allow(clippy::unwrap_used)]

mod command;

use std::fs;

use bayesian_object_models::{
    io::document::PosteriorDocument,
    types::posterior::{Criticism, Verdict},
};
use command::{bom, ours};
use serde_json::Value;

/// What the replay of a bag of this repository finds, and the truth beside the bag.
fn findings(name: &str) -> (Criticism, Value) {
    let folder = tempfile::tempdir().unwrap();
    let posterior = folder.path().join("posterior.json");
    let bag = ours(&format!("bags/{name}/{name}.mcap"));
    let outcome = bom(&["replay", bag.to_str().unwrap(), "--posterior", posterior.to_str().unwrap()]);
    assert_eq!(outcome.status, 0, "{outcome:?}");
    let document: PosteriorDocument = serde_json::from_str(&fs::read_to_string(posterior).unwrap()).unwrap();
    let truth = fs::read_to_string(ours(&format!("bags/{name}/truth.json"))).unwrap();
    (document.posterior.criticism, serde_json::from_str(&truth).unwrap())
}

#[test]
fn a_plain_chain_is_adequate() {
    let (found, truth) = findings("chain");
    assert_eq!(found.verdict, Verdict::Adequate, "{:?}", found.effects);
    let moving = truth["parts"].as_array().unwrap().iter().filter(|part| part["joint"] != "root");
    assert_eq!(found.after.len(), moving.count(), "every joint is scored");
    assert_eq!(found.before, found.after);
}

#[test]
fn springs_of_joints_that_move_together_are_found() {
    let (found, truth) = findings("sprung");
    assert_eq!(found.verdict, Verdict::EffectFound);
    let parts = truth["parts"].as_array().unwrap();
    let sprung = parts.iter().filter_map(|part| Some((part["label"].as_u64()?, part["effects"].get("spring")?)));
    let mut labels: Vec<u64> = Vec::new();
    for (label, spring) in sprung {
        let effect = found.effects.iter().find(|e| e.label.is_some_and(|l| u64::from(l.0) == label)).unwrap();
        assert_eq!(effect.name, "spring", "{:?}", found.effects);
        let (stiffness, true_stiffness) = (&effect.parameters["stiffness"], spring["stiffness"].as_f64().unwrap());
        // A lever of .2 kg is found a fifth too stiff, as such come out too heavy to turn.
        assert!((stiffness.median / true_stiffness - 1.0).abs() < 0.25, "{stiffness:?}, not {true_stiffness}");
        labels.push(label);
    }
    assert_eq!(labels.len(), 2);
    assert_eq!(found.effects.len(), labels.len(), "{:?}", found.effects);
    for (before, after) in found.before.iter().zip(&found.after) {
        assert!(after.force_rmse() < before.force_rmse(), "{before:?} {after:?}");
    }
}
