//! Criticism names what an object has that its model does not, and is silent where nothing is.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "criticism/world.rs"]
#[allow(dead_code, missing_docs, reason = "shared with the benchmark, which uses more of it")]
mod world;

use bayesian_object_models::model::DeclaredPhysics;
use bayesian_object_models::types::posterior::{Criticism, Verdict};
use world::{Record, object};

fn findings(name: &str, number: u64, declared: &DeclaredPhysics) -> Criticism {
    let (object, mut rng) = object(name, 1.0, number);
    let record = Record::of(&object, 5, &mut rng);
    record.criticize(declared).1.findings()
}

/// One door or one drawer of each: the frequencies are in docs/criticism.md.
#[test]
fn effects_are_named_and_their_error_goes() {
    for (name, number) in
        [("spring", 0), ("catch", 1), ("detent", 0), ("drag", 1), ("wrench_delay", 0), ("wrench_bias", 1)]
    {
        let found = findings(name, number, &DeclaredPhysics::default());
        assert_eq!(found.verdict, Verdict::EffectFound, "{name}");
        assert_eq!(found.effects[0].name, name, "{:?}", found.effects);
        assert!(found.effects[0].probability > 0.9, "{:?}", found.effects);
        for (before, after) in found.before.iter().zip(&found.after) {
            assert!(after.log_predictive_density > before.log_predictive_density + 5.0, "{name}: {before:?} {after:?}");
            assert!(after.position_rmse_m < 0.5 * before.position_rmse_m, "{name}: {before:?} {after:?}");
        }
    }
}

#[test]
fn a_model_that_explains_everything_is_adequate() {
    for number in 0..4 {
        let found = findings("plain", number, &DeclaredPhysics::default());
        assert_eq!(found.verdict, Verdict::Adequate, "{:?}", found.effects);
        assert!(found.effects.is_empty() && found.before == found.after);
    }
}

#[test]
fn friction_that_was_not_declared_is_found() {
    for number in 0..2 {
        let found = findings("plain", number, &DeclaredPhysics { friction: false, effects: Vec::new() });
        assert_eq!(found.effects.first().map(|e| e.name.as_str()), Some("friction"), "{:?}", found.effects);
        let (object, _) = object("plain", 1.0, number);
        let friction = &found.effects[0].parameters["friction"];
        assert!((friction.median / object.friction - 1.0).abs() < 0.1, "{friction:?}, truth {}", object.friction);
    }
}

#[test]
fn an_effect_that_was_declared_is_not_found_again() {
    let declared =
        DeclaredPhysics { effects: serde_json::from_str("[\"spring\"]").unwrap(), ..DeclaredPhysics::default() };
    let found = findings("spring", 0, &declared);
    assert_eq!(found.verdict, Verdict::Adequate, "{:?}", found.effects);
}

#[test]
fn one_window_is_too_little() {
    let (object, mut rng) = object("spring", 1.0, 0);
    let record = Record::of(&object, 1, &mut rng);
    let found = record.criticize(&DeclaredPhysics::default()).1.findings();
    assert_eq!(found.verdict, Verdict::Insufficient);
    assert!(found.effects.is_empty());
}

#[test]
fn two_reviews_of_the_same_windows_are_the_same() {
    let once = findings("catch", 0, &DeclaredPhysics::default());
    assert_eq!(once, findings("catch", 0, &DeclaredPhysics::default()));
}
