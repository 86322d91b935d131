//! Saved models: what was learned is kept, new bags add to it, and what is wrong is said in one line.
#![allow(clippy::unwrap_used)]

mod command;

use std::{
    ffi::OsStr,
    fs,
    path::{Path, PathBuf},
    sync::LazyLock,
};

use bayesian_object_models::{
    io::{
        bag::{Bag, BagWriter, Compression},
        document::PosteriorDocument,
    },
    types::posterior::{EdgePosterior, Quantity},
};
use command::{Outcome, bom, ours};
use tempfile::TempDir;

/// Between two interactions of the cabinet, each part having been held once before \[ns\].
const BETWEEN: u64 = 11_500_000_000;
const ROOT: &str = "4";

/// The cabinet in two halves, the model of the first, and what the second adds.
struct Halves {
    folder: TempDir,
    whole: PosteriorDocument,
}

impl Halves {
    fn path(&self, name: &str) -> PathBuf {
        self.folder.path().join(name)
    }
}

fn replay(bag: &Path, more: &[&str]) -> Outcome {
    let more: Vec<&OsStr> = more.iter().map(AsRef::as_ref).collect();
    bom(&[&["replay".as_ref(), bag.as_os_str()], &more[..]].concat())
}

fn done(outcome: &Outcome) {
    assert_eq!((outcome.status, outcome.err.as_str()), (0, ""), "{outcome:?}");
}

/// Failed with one line that holds all of `parts`.
fn failed(outcome: &Outcome, parts: &[&str]) {
    assert_eq!(outcome.status, 1, "{outcome:?}");
    assert!(outcome.err.starts_with("bom: ") && outcome.err.lines().count() == 1, "{outcome:?}");
    for part in parts {
        assert!(outcome.err.contains(part), "{part}: {outcome:?}");
    }
}

/// Copies what was logged from `from` to `to` ns after the first message, and all fixed transforms.
fn copy(name: &str, to: &Path, from_ns: u64, to_ns: u64, compression: Compression) {
    let mut writer = BagWriter::create_with(to, compression, Some(100_000)).unwrap();
    let mut topics = std::collections::BTreeMap::new();
    let mut begin = None;
    for message in Bag::open(&ours(name)).unwrap() {
        let t = message.log_time_ns - *begin.get_or_insert(message.log_time_ns);
        if (t < from_ns || t >= to_ns) && message.topic.name != "/tf_static" {
            continue;
        }
        let topic = *topics
            .entry(message.topic.name.clone())
            .or_insert_with(|| writer.add_topic(&message.topic.name, &message.topic.type_name).unwrap());
        writer.write(topic, message.log_time_ns, message.log_time_ns, message.bytes()).unwrap();
    }
    writer.finish().unwrap();
}

fn document(path: &Path) -> PosteriorDocument {
    serde_json::from_slice(&fs::read(path).unwrap()).unwrap()
}

const CABINET: &str = "bags/cabinet/cabinet.mcap";

static HALVES: LazyLock<Halves> = LazyLock::new(|| {
    let folder = tempfile::tempdir().unwrap();
    let path = |name: &str| folder.path().join(name);
    let text = |name: &str| path(name).to_str().unwrap().to_owned();
    copy(CABINET, &path("first.mcap"), 0, BETWEEN, Compression::Zstd);
    copy(CABINET, &path("second.mcap"), BETWEEN, u64::MAX, Compression::Zstd);
    done(&replay(&path("first.mcap"), &["--root-label", ROOT, "--save-model", &text("first.json")]));
    let whole = text("whole.json");
    done(&replay(&ours(CABINET), &["--root-label", ROOT, "--posterior", &whole]));
    let whole = document(Path::new(&whole));
    Halves { folder, whole }
});

fn holds(interval: &Quantity, value: f64) -> bool {
    (interval.q05..=interval.q95).contains(&value)
}

/// Asserts that the second posterior says what the first says of every joint that moved: its intervals
/// hold the first's medians, and are as wide up to the given factors.
fn assert_agree(one: &PosteriorDocument, other: &PosteriorDocument, width: std::ops::Range<f64>) {
    let mut compared = 0;
    for edge in &one.posterior.edges {
        let same = |e: &&EdgePosterior| (e.parent, e.child) == (edge.parent, edge.child);
        let found = other.posterior.edges.iter().find(same).unwrap_or_else(|| panic!("{edge:?}"));
        assert!((edge.probability - found.probability).abs() < 1e-3, "{edge:?} {found:?}");
        let (name, probability) = edge.joint_type.likeliest();
        if probability < 0.9 || edge.probability < 0.1 {
            continue;
        }
        assert_eq!(found.joint_type.likeliest().0, name);
        // What was explained badly in one of few windows leaves room for doubt.
        assert!(found.joint_type.likeliest().1 > 0.95);
        for (a, b) in [
            (&edge.damping, &found.damping),
            (&edge.friction, &found.friction),
            (&edge.joint_inertia, &found.joint_inertia),
        ] {
            assert!(holds(b, a.median), "part {}: {a:?} {b:?}", edge.child);
            let widths = (b.q95 / b.q05).ln() / (a.q95 / a.q05).ln();
            assert!(width.contains(&widths), "part {}: widths {widths}", edge.child);
        }
        let direction = |e: &EdgePosterior| match name {
            "revolute" => e.revolute.as_ref().map(|a| (a.axis_direction, a.covariance[0][0], a.covariance[1][1])),
            _ => e.prismatic.as_ref().map(|a| (a.axis_direction, a.covariance[0][0], a.covariance[1][1])),
        };
        let ((a, v, w), (b, x, y)) = (direction(edge).unwrap(), direction(found).unwrap());
        let cross = nalgebra::Vector3::from(a).cross(&nalgebra::Vector3::from(b)).norm();
        assert!(cross < 2.0 * (v + w + x + y).sqrt(), "part {}: {cross} rad", edge.child);
        compared += 1;
    }
    assert!(compared >= 3, "{compared} joints");
}

#[test]
fn going_on_with_a_model_is_as_good_as_one_run() {
    let halves = &*HALVES;
    let posterior = halves.path("resumed.json");
    let model = halves.path("first.json");
    let outcome = replay(
        &halves.path("second.mcap"),
        &["--load-model", model.to_str().unwrap(), "--posterior", posterior.to_str().unwrap()],
    );
    done(&outcome);
    let resumed = document(&posterior);
    assert_eq!(resumed.posterior.windows.len(), halves.whole.posterior.windows.len());
    let times: Vec<f64> = resumed.posterior.windows.iter().map(|window| window.t0_s).collect();
    assert!(times.windows(2).all(|pair| pair[0] < pair[1]), "time goes on: {times:?}");
    assert_agree(&halves.whole, &resumed, 0.7..1.5);
}

#[test]
fn the_same_object_gives_the_same_bytes() {
    let halves = &*HALVES;
    let again = halves.path("again.json");
    done(&replay(&halves.path("first.mcap"), &["--root-label", ROOT, "--save-model", again.to_str().unwrap()]));
    assert!(fs::read(&again).unwrap() == fs::read(halves.path("first.json")).unwrap());
}

#[test]
fn a_bag_that_was_learned_is_refused_whatever_its_name_and_packing() {
    let halves = &*HALVES;
    let copied = halves.path("copied.mcap");
    copy(CABINET, &copied, 0, BETWEEN, Compression::None);
    let outcome = replay(&copied, &["--load-model", halves.path("first.json").to_str().unwrap()]);
    failed(&outcome, &["copied.mcap: the model has learned this bag already"]);
    assert_eq!(outcome.out, "");
}

#[test]
fn what_is_no_model_of_this_object_is_refused() {
    let halves = &*HALVES;
    let second = halves.path("second.mcap");
    let model = halves.path("first.json");
    let load = |path: &Path| replay(&second, &["--load-model", path.to_str().unwrap()]);
    failed(&load(Path::new("/nowhere/m.json")), &["/nowhere/m.json: No such file"]);

    let text = fs::read_to_string(&model).unwrap();
    let broken = halves.path("broken.json");
    // One digit of one number.
    let at = text.len() / 2 + text[text.len() / 2..].find("0.").unwrap() + 2;
    let digit = if text.as_bytes()[at] == b'5' { "6" } else { "5" };
    fs::write(&broken, format!("{}{digit}{}", &text[..at], &text[at + 1..])).unwrap();
    failed(&load(&broken), &["broken.json: damaged: the content's SHA-256 is"]);
    // Cut off, but not within a number.
    let cut = at + text[at..].find(',').unwrap();
    fs::write(&broken, &text[..cut]).unwrap();
    failed(&load(&broken), &["broken.json: no saved model: EOF"]);
    fs::write(&broken, text.replacen("bom.model/3", "bom.model/9", 1)).unwrap();
    failed(&load(&broken), &["broken.json: no saved model: schema `bom.model/9`, expected `bom.model/3`"]);

    let root = replay(&second, &["--load-model", model.to_str().unwrap(), "--root-label", "2"]);
    failed(&root, &["first.json: its root is part 4, not 2"]);
    let config = halves.path("moon.yaml");
    fs::write(&config, "gravity_m_s2: [0, 0, -1.62]\n").unwrap();
    let gravity = replay(&second, &["--load-model", model.to_str().unwrap(), "--config", config.to_str().unwrap()]);
    failed(&gravity, &["first.json: it was learned under gravity [0.0, 0.0, -9.81] m/s², not"]);
    let other = replay(&ours("bags/chain/chain.mcap"), &["--load-model", model.to_str().unwrap()]);
    failed(&other, &["first.json: another object, or it stands elsewhere"]);
}

#[test]
fn nothing_learned_is_nothing_to_save() {
    let halves = &*HALVES;
    let still = halves.path("still.mcap");
    copy(CABINET, &still, 0, 500_000_000, Compression::Zstd);
    let outcome = replay(&still, &["--save-model", halves.path("none.json").to_str().unwrap()]);
    failed(&outcome, &["none.json: no interaction was seen: there is nothing to save"]);
    assert!(!halves.path("none.json").exists());
}

#[test]
fn windows_that_go_leave_what_they_said() {
    let halves = &*HALVES;
    let (config, posterior, model) =
        (halves.path("kept.yaml"), halves.path("kept.json"), halves.path("kept_model.json"));
    fs::write(&config, "windows: {kept: 3}\n").unwrap();
    let arguments = ["--root-label", ROOT, "--config", config.to_str().unwrap()];
    let outputs = ["--posterior", posterior.to_str().unwrap(), "--save-model", model.to_str().unwrap()];
    done(&replay(&ours(CABINET), &[arguments, outputs].concat()));
    let kept = document(&posterior);
    assert_eq!(kept.posterior.windows.len(), halves.whole.posterior.windows.len());
    assert!(kept.posterior.windows.len() > 5, "{} windows", kept.posterior.windows.len());
    let saved: serde_json::Value = serde_json::from_slice(&fs::read(&model).unwrap()).unwrap();
    let learner = &saved["content"]["object"]["learner"];
    assert_eq!(learner["windows"].as_array().unwrap().len(), 3);
    for tracks in learner["tracks"].as_object().unwrap().values() {
        assert_eq!(tracks.as_array().unwrap().len(), 3);
    }
    // What is dropped may widen, never narrow.
    assert_agree(&halves.whole, &kept, 0.7..3.0);
}

#[test]
fn a_recording_is_learned_as_what_was_recorded() {
    let halves = &*HALVES;
    let first = halves.path("first.mcap");
    let (recording, before, after) = (halves.path("rec.mcap"), halves.path("before.json"), halves.path("after.json"));
    let outputs = ["--record", recording.to_str().unwrap(), "--posterior", before.to_str().unwrap()];
    done(&replay(&first, &[&["--root-label", ROOT], &outputs[..]].concat()));
    done(&replay(&recording, &["--root-label", ROOT, "--posterior", after.to_str().unwrap()]));
    let timeless = |path: &Path| {
        let text = fs::read_to_string(path).unwrap();
        text.lines().filter(|line| !line.contains("inference_wall_s")).collect::<Vec<_>>().join("\n")
    };
    assert_eq!(timeless(&before), timeless(&after));
    failed(&replay(&first, &["--record", "/nowhere/rec.mcap"]), &["/nowhere/rec.mcap"]);
}

#[test]
fn a_model_is_scored_on_a_bag_that_it_has_not_learned() {
    let halves = &*HALVES;
    let (model, second) = (halves.path("first.json"), halves.path("second.mcap"));
    let json = halves.path("scores.json");
    let outcome =
        bom(&["evaluate", model.to_str().unwrap(), second.to_str().unwrap(), "--json", json.to_str().unwrap()]);
    done(&outcome);
    assert!(!outcome.out.contains("has learned this bag"), "{outcome:?}");
    let scores: serde_json::Value = serde_json::from_slice(&fs::read(&json).unwrap()).unwrap();
    assert_eq!(scores["schema"], "bom.evaluation/1");
    assert_eq!((scores["horizon_s"].as_f64(), scores["was_learned"].as_bool()), (Some(1.0), Some(false)));
    let before = scores["before"].as_array().unwrap();
    assert_eq!(before.len(), 3, "{before:?}");
    assert_eq!(before, scores["after"].as_array().unwrap(), "no effect was added");
    for part in before {
        assert!(part["scored_windows"].as_u64().unwrap() >= 1);
        // The door and a drawer reach end stops that the first half never met: no model of it knows them.
        assert!((1e-5..0.5).contains(&part["position_rmse_m"].as_f64().unwrap()), "{part}");
        assert!(part.get("force_rmse_N").is_some() != part.get("torque_rmse_Nm").is_some(), "{part}");
    }
    let itself = bom(&["evaluate", model.to_str().unwrap(), halves.path("first.mcap").to_str().unwrap()]);
    done(&itself);
    assert!(itself.out.contains("! the model has learned this bag"), "{itself:?}");
}

#[test]
fn an_evaluation_that_cannot_be_is_refused() {
    let halves = &*HALVES;
    let (model, second) = (halves.path("first.json"), halves.path("second.mcap"));
    let evaluate = |arguments: &[&Path]| {
        let arguments: Vec<&OsStr> = arguments.iter().map(|path| path.as_os_str()).collect();
        bom(&[&["evaluate".as_ref()], &arguments[..]].concat())
    };
    assert_eq!(evaluate(&[]).status, 2);
    assert_eq!(evaluate(&[&model]).status, 2);
    failed(&evaluate(&[Path::new("/nowhere/m.json"), &second]), &["/nowhere/m.json: No such file"]);
    failed(&evaluate(&[&model, Path::new("/nowhere/b.mcap")]), &["/nowhere/b.mcap"]);
    failed(&evaluate(&[&model, &ours("bags/chain/chain.mcap")]), &["first.json: another object"]);
    failed(&evaluate(&[&second, &second]), &["second.mcap: "]);
}

#[test]
fn the_report_needs_nothing_but_itself() {
    let halves = &*HALVES;
    let report = halves.path("report.html");
    done(&replay(&halves.path("first.mcap"), &["--root-label", ROOT, "--report", report.to_str().unwrap()]));
    let page = fs::read_to_string(&report).unwrap();
    let without_names = page.replace("http://www.w3.org/2000/svg", "");
    for outside in ["http://", "https://", "src=", "@import", "<script", "<link", "url("] {
        assert!(!without_names.contains(outside), "{outside}");
    }
    for part in ["<!DOCTYPE html>", "Mechanism", "Joints over time", "Predictions", "Dynamics", "Criticism", "Windows"]
    {
        assert!(page.contains(part), "{part}");
    }
    for label in 1..=5 {
        assert!(page.contains(&format!("<td>{label}</td>")), "part {label}");
    }
    assert!(page.matches("class=\"chart\"").count() >= 9, "position, force and errors of three parts");
    assert!(!page.contains("NaN") && !page.contains(">inf"));
    assert_eq!(page.matches("<svg").count(), page.matches("</svg>").count());
    failed(&replay(&halves.path("first.mcap"), &["--report", "/nowhere/r.html"]), &["/nowhere/r.html: No such file"]);
}

#[test]
fn the_seed_is_a_number() {
    assert_eq!(replay(&ours(CABINET), &["--seed", "dice"]).status, 2);
}
