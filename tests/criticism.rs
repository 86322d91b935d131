//! Criticism names what an object has that its model does not, and is silent where nothing is.
#![allow(clippy::unwrap_used, clippy::expect_used)]

#[path = "criticism/world.rs"]
#[allow(dead_code, missing_docs, reason = "shared with the benchmark, which uses more of it")]
mod world;

use bayesian_object_models::mechanism::effects::EffectKind;
use bayesian_object_models::model::{DeclaredPhysics, WindowObservations};
use bayesian_object_models::types::Label;
use bayesian_object_models::types::posterior::{Criticism, Verdict};
use world::{Record, Undeclared, object};

fn findings(name: &str, number: u64, declared: &DeclaredPhysics) -> Criticism {
    let (object, mut rng) = object(name, 1.0, number);
    let record = Record::of(&object, 5, &mut rng);
    record.criticize(declared).1.findings()
}

/// Doors and drawers of each effect; more of them, at other sizes, are in docs/criticism.md.
#[test]
fn effects_are_named_and_their_error_goes() {
    let (mut named, mut wrong) = (0, Vec::new());
    for name in ["spring", "catch", "detent", "drag", "wrench_delay", "wrench_bias"] {
        for number in 0..3 {
            let found = findings(name, number, &DeclaredPhysics::default());
            if found.effects.first().is_none_or(|effect| effect.name != name) {
                wrong.push((name, number, found.effects.first().map(|effect| effect.name.clone())));
                continue;
            }
            named += 1;
            assert_eq!(found.verdict, Verdict::EffectFound, "{name}");
            for (before, after) in found.before.iter().zip(&found.after) {
                let gain = after.log_predictive_density - before.log_predictive_density;
                assert!(gain > 0.0, "{name} {number}: {before:?} {after:?}");
                assert!(after.position_rmse_m < before.position_rmse_m, "{name} {number}: {before:?} {after:?}");
            }
        }
    }
    // Neighbours in shape are still taken for each other now and then: a spring for a hinge that closes itself.
    assert!(6 * wrong.len() <= named + wrong.len(), "{named} named, wrong: {wrong:?}");
}

#[test]
fn a_model_that_explains_everything_is_adequate() {
    // The last two come to an end stop in one window, which process noise or a pulse there explain as well.
    for number in [0, 1, 2, 3, 78, 110] {
        let found = findings("plain", number, &DeclaredPhysics::default());
        assert_eq!(found.verdict, Verdict::Adequate, "{:?}", found.effects);
        assert!(found.effects.is_empty() && found.before == found.after);
    }
}

/// A joint that is braked in some windows, by another that is open: none of the library's effects.
#[test]
fn windows_that_noise_alone_explains_are_unknown() {
    for number in 1..4 {
        let (object, mut rng) = object("a joint that brakes another", 1.0, number);
        let found = Record::of(&object, 9, &mut rng).criticize(&DeclaredPhysics::default()).1.findings();
        assert_eq!(found.verdict, Verdict::Unexplained, "{number}");
        let [unknown] = &found.effects[..] else { panic!("{number}: {:?}", found.effects) };
        assert_eq!((unknown.name.as_str(), unknown.label), ("unknown", Some(Label(1))), "{number}");
        let left: Vec<f64> = unknown.parameters.values().map(|force| force.median.abs()).collect();
        let (least, most) = left.iter().fold((f64::INFINITY, 0.0_f64), |(l, m), f| (l.min(*f), m.max(*f)));
        assert!(most > 3.0 * least, "{number}: all windows lack as much: {left:?}");
    }
}

/// Friction that is another in the first window only, which no other window bears out.
#[test]
fn a_joint_of_which_windows_differ_is_unknown() {
    for number in 1..4 {
        let found = findings("friction that warms up", number, &DeclaredPhysics::default());
        assert_eq!(found.verdict, Verdict::Unexplained, "{number}");
        assert_eq!(found.effects.first().map(|e| e.name.as_str()), Some("unknown"), "{number}: {:?}", found.effects);
    }
}

#[test]
fn friction_that_was_not_declared_is_found() {
    for number in 0..2 {
        let found = findings("plain", number, &DeclaredPhysics { friction: false, ..DeclaredPhysics::default() });
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

/// The models on the way have it too, as it was fitted.
#[test]
fn an_effect_that_was_declared_is_in_every_model() {
    let declared = DeclaredPhysics { effects: vec![EffectKind::GravityOffset], ..DeclaredPhysics::default() };
    let (object, mut rng) = object("gravity_offset", 1.0, 0);
    let Some(Undeclared::Effect(_, truth)) = &object.undeclared else { panic!("{object:?}") };
    let record = Record::of(&object, 5, &mut rng);
    let (learner, critic) = record.criticize(&declared);
    let windows: Vec<&WindowObservations> = record.windows.iter().collect();
    let stages = critic.stages(&learner, &record.fit(5), &record.input(&windows)).unwrap();
    let model = &stages[0].hypothesis.mechanism.joints[0];
    let offset = EffectKind::GravityOffset.parameters()[0]
        .physical(stages[0].x[model.effect_offset(0)], &model.effects[0].scales);
    assert!((offset / truth[0] - 1.0).abs() < 0.1, "{offset}, truth {truth:?}");
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
