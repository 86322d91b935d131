//! `bom` as it is called: exit codes, one line for what went wrong, bad bags.
#![allow(clippy::unwrap_used)]

mod command;

use std::{ffi::OsStr, fs, path::Path};

use bayesian_object_models::io::{
    bag::{Bag, BagMessage, BagWriter},
    document::PosteriorDocument,
};
use command::{Outcome, bom, ours};
use tempfile::TempDir;

fn folder() -> TempDir {
    tempfile::tempdir().unwrap()
}

fn replay(bag: &Path, more: &[&OsStr]) -> Outcome {
    bom(&[&["replay".as_ref(), bag.as_os_str()], more].concat())
}

/// Failed with one line that starts as expected and holds all of `parts`.
fn assert_fails(outcome: &Outcome, parts: &[&str]) {
    assert_eq!(outcome.status, 1, "{outcome:?}");
    assert!(outcome.err.starts_with("bom: ") && outcome.err.lines().count() == 1, "{outcome:?}");
    for part in parts {
        assert!(outcome.err.contains(part), "{part}: {outcome:?}");
    }
    assert!(outcome.out.is_empty(), "{outcome:?}");
}

/// Copies those messages of the cabinet that are kept; `rename` gives topics their new names.
fn copy(to: &Path, keep: impl Fn(&BagMessage) -> bool, rename: impl Fn(&str) -> String) {
    let mut writer = BagWriter::create(to).unwrap();
    let mut topics = std::collections::BTreeMap::new();
    for message in Bag::open(&ours("bags/cabinet/cabinet.mcap")).unwrap().filter(keep) {
        let topic = *topics
            .entry(message.topic.name.clone())
            .or_insert_with(|| writer.add_topic(&rename(&message.topic.name), &message.topic.type_name).unwrap());
        writer.write(topic, message.log_time_ns, message.log_time_ns, message.bytes()).unwrap();
    }
    writer.finish().unwrap();
}

fn start_ns() -> u64 {
    Bag::open(&ours("bags/cabinet/cabinet.mcap")).unwrap().next().unwrap().log_time_ns
}

fn document(path: &Path) -> PosteriorDocument {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

#[test]
fn wrong_usage_is_status_two_and_help_is_none() {
    for arguments in [
        &[][..],
        &["replay"],
        &["reply", "x.mcap"],
        &["replay", "x.mcap", "--root-label", "door"],
        &["replay", "x.mcap", "--fast"],
        &["replay", "x.mcap", "--load-model"],
        &["evaluate", "m.json"],
    ] {
        let outcome = bom(arguments);
        assert_eq!((outcome.status, outcome.out.as_str()), (2, ""), "{arguments:?}: {outcome:?}");
    }
    let help = bom(&["--help"]);
    assert_eq!(help.status, 0, "{help:?}");
    assert!(help.out.contains("replay") && help.out.contains("evaluate"), "{help:?}");
}

#[test]
fn a_bag_that_is_none_is_named() {
    let folder = folder();
    let missing = folder.path().join("missing.mcap");
    assert_fails(&replay(&missing, &[]), &["missing.mcap", "No such file"]);
    let text = folder.path().join("text.mcap");
    fs::write(&text, "this is no bag").unwrap();
    assert_fails(&replay(&text, &[]), &["text.mcap"]);
    assert_fails(&replay(folder.path(), &[]), &[folder.path().to_str().unwrap()]);
}

#[test]
fn a_wrong_configuration_is_named_by_file_and_key() {
    let folder = folder();
    let path = folder.path().join("bom.yaml");
    let cabinet = ours("bags/cabinet/cabinet.mcap");
    let with_config = |text: &str| {
        fs::write(&path, text).unwrap();
        replay(&cabinet, &["--config".as_ref(), path.as_os_str()])
    };
    assert_fails(&with_config("windows: {quite_s: 1}"), &["bom.yaml: key `windows.quite_s`: unknown field"]);
    assert_fails(&with_config("kinematics: {steps: 0}"), &["key `kinematics.steps`: 0, expected above 0"]);
    let missing = folder.path().join("missing.yaml");
    assert_fails(&replay(&cabinet, &["--config".as_ref(), missing.as_os_str()]), &["missing.yaml", "No such file"]);
}

#[test]
fn an_output_that_cannot_be_written_is_named_before_the_work() {
    let cabinet = ours("bags/cabinet/cabinet.mcap");
    for option in ["--posterior", "--observations"] {
        let outcome = replay(&cabinet, &[option.as_ref(), "/nowhere/out".as_ref()]);
        assert_fails(&outcome, &["/nowhere/out: No such file"]);
    }
}

#[test]
fn missing_topics_are_listed_with_those_that_exist() {
    let folder = folder();
    let path = folder.path().join("renamed.mcap");
    let begin = start_ns();
    copy(&path, |m| m.log_time_ns < begin + 1_000_000_000, |name| format!("/robot{name}"));
    let parts = [
        "renamed.mcap: no messages on /parts/points (sensor_msgs/msg/PointCloud2)",
        "the bag has: /robot/parts/points",
    ];
    assert_fails(&replay(&path, &[]), &parts);
}

#[test]
fn no_motion_gives_the_prior() {
    let folder = folder();
    let (bag, posterior) = (folder.path().join("still.mcap"), folder.path().join("posterior.json"));
    let begin = start_ns();
    copy(&bag, |m| m.log_time_ns < begin + 500_000_000, str::to_owned);
    let outcome = replay(&bag, &["--root-label".as_ref(), "4".as_ref(), "--posterior".as_ref(), posterior.as_os_str()]);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
    assert!(outcome.out.contains("No interaction was seen: the posterior is the prior."), "{outcome:?}");
    let posterior = document(&posterior).posterior;
    // Uniform over the 5³ trees on a given root: 2/5 hang on it, 1/5 on each of the other three.
    assert_eq!(posterior.edges.len(), 16);
    for edge in &posterior.edges {
        let expected = if edge.parent == posterior.root_label { 0.4 } else { 0.2 };
        assert!((edge.probability - expected).abs() < 1e-12, "{edge:?}");
        assert_eq!(edge.joint_type.likeliest().1, 1.0 / 3.0);
    }
    assert_eq!((posterior.parts.len(), posterior.windows.len()), (5, 0));
}

#[test]
fn a_bag_without_wrench_is_replayed_and_says_so() {
    let folder = folder();
    let path = folder.path().join("no_wrench.mcap");
    let begin = start_ns();
    copy(&path, |m| m.log_time_ns < begin + 500_000_000 && m.topic.name != "/wrench", str::to_owned);
    let outcome = replay(&path, &[]);
    assert_eq!(outcome.status, 0, "{outcome:?}");
    assert!(outcome.out.contains("! no messages on /wrench (geometry_msgs/msg/WrenchStamped)"), "{outcome:?}");
}

#[test]
fn an_unknown_root_is_named_with_the_parts_seen() {
    let folder = folder();
    let path = folder.path().join("short.mcap");
    let begin = start_ns();
    copy(&path, |m| m.log_time_ns < begin + 500_000_000, str::to_owned);
    let outcome = replay(&path, &["--root-label".as_ref(), "9".as_ref()]);
    assert_fails(&outcome, &["--root-label 9: no such part, seen were 1, 2, 3, 4, 5"]);
}

#[test]
fn a_truncated_bag_gives_what_comes_before_the_cut() {
    let folder = folder();
    let (bag, posterior) = (folder.path().join("cut.mcap"), folder.path().join("posterior.json"));
    let whole = fs::read(ours("bags/cabinet/cabinet.mcap")).unwrap();
    fs::write(&bag, &whole[..whole.len() / 3]).unwrap();
    let outcome = replay(&bag, &["--posterior".as_ref(), posterior.as_os_str()]);
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
    assert!(outcome.out.contains("! ") && outcome.out.contains("cut.mcap, byte "), "{outcome:?}");
    let document = document(&posterior);
    assert!(document.counters.clouds_in > 100 && !document.counters.bag_damage.is_empty(), "{:?}", document.counters);
    assert!(!document.posterior.windows.is_empty());
}
