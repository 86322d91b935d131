//! The node against real ROS 2: rclpy over Fast DDS plays bags to it, listens to it and calls it; Cyclone DDS,
//! another vendor's, talks to it too.
//!
//! Needs `BOM_ROS_ENVIRONMENT` (`rosidl_peer/build.sh`) with `ros_peer/requirements.txt` in it.
#![allow(clippy::unwrap_used)]

mod ros;

use std::{
    collections::BTreeMap,
    fs::File,
    path::{Path, PathBuf},
    process::{Child, Command, Stdio},
    sync::{Mutex, MutexGuard, PoisonError},
};

use bayesian_object_models::io::bag::Bag;
use serde_json::{Value, json};

/// One at a time: they measure rates on a machine that has few cores.
static TURN: Mutex<()> = Mutex::new(());

/// The node with its peer, on loopback, in a domain of their own.
struct Bench {
    environment: PathBuf,
    domain: u32,
    node: Child,
    log: PathBuf,
    folder: tempfile::TempDir,
    _turn: MutexGuard<'static, ()>,
}

impl Bench {
    /// Starts the node with these ROS arguments; nothing where there is no ROS 2.
    fn start(domain: u32, arguments: &[&str]) -> Option<Self> {
        Self::start_recording(domain, None, arguments)
    }

    /// The same, recording.
    fn start_recording(domain: u32, record: Option<&Path>, arguments: &[&str]) -> Option<Self> {
        let environment = ros::environment()?;
        let turn = TURN.lock().unwrap_or_else(PoisonError::into_inner);
        let folder = tempfile::tempdir().unwrap();
        let log = folder.path().join("node.log");
        let node = Command::new(env!("CARGO_BIN_EXE_bom"))
            .arg("node")
            .args(record.iter().flat_map(|folder| [Path::new("--record"), folder]))
            .arg("--ros-args")
            .args(arguments)
            .env("ROS_DOMAIN_ID", domain.to_string())
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .stderr(File::create(&log).unwrap())
            .stdout(Stdio::null())
            .spawn()
            .unwrap();
        Some(Self { environment, domain, node, log, folder, _turn: turn })
    }

    /// What a scenario of `ros_peer/peer.py` saw.
    fn peer(&self, arguments: &[&str]) -> Value {
        self.run("peer.py", arguments)
    }

    /// What a script of `ros_peer/` saw.
    fn run(&self, script: &str, arguments: &[&str]) -> Value {
        let script = Path::new(env!("CARGO_MANIFEST_DIR")).join("tests/ros_peer").join(script);
        let output = Command::new("bash")
            .args(["-c", r#"source "$0" && exec python3 "$@""#])
            .args([&self.environment, &script])
            .args(arguments)
            .env("ROS_DOMAIN_ID", self.domain.to_string())
            .env("ROS_AUTOMATIC_DISCOVERY_RANGE", "LOCALHOST")
            .env("ROS_LOG_DIR", self.folder.path())
            .output()
            .unwrap();
        let said = || format!("{}\nnode:\n{}", String::from_utf8_lossy(&output.stderr), self.log());
        assert!(output.status.success(), "{}", said());
        serde_json::from_slice(&output.stdout).unwrap_or_else(|error| panic!("{error}: {}", said()))
    }

    fn log(&self) -> String {
        std::fs::read_to_string(&self.log).unwrap()
    }

    /// Tells it to stop; whether it ended well.
    fn stop(mut self) -> bool {
        let pid = rustix::process::Pid::from_child(&self.node);
        rustix::process::kill_process(pid, rustix::process::Signal::TERM).unwrap();
        self.node.wait().unwrap().success()
    }
}

impl Drop for Bench {
    fn drop(&mut self) {
        // It may have ended already.
        let _ = self.node.kill();
        let _ = self.node.wait();
    }
}

fn bag(name: &str) -> String {
    format!("{}/bags/{name}/{name}.mcap", env!("CARGO_MANIFEST_DIR"))
}

/// What a replay of a bag of this repository finds.
fn replayed(name: &str, root: &str) -> (BTreeMap<String, Value>, Value) {
    replayed_bag(Path::new(&bag(name)), root)
}

/// What a replay finds: the likely edges by child, parent and type, and the intervals of their numbers.
fn replayed_bag(bag: &Path, root: &str) -> (BTreeMap<String, Value>, Value) {
    let folder = tempfile::tempdir().unwrap();
    let path = folder.path().join("posterior.json");
    let status = Command::new(env!("CARGO_BIN_EXE_bom"))
        .args(["replay", bag.to_str().unwrap(), "--root-label", root, "--posterior", path.to_str().unwrap()])
        .stdout(Stdio::null())
        .status()
        .unwrap();
    assert!(status.success());
    let posterior: Value = serde_json::from_reader(File::open(path).unwrap()).unwrap();
    let mut joints = BTreeMap::new();
    let edges = posterior["edges"].as_array().unwrap().iter();
    for edge in edges.filter(|edge| edge["probability"].as_f64().unwrap() > 0.5) {
        let types = edge["joint_type"].as_object().unwrap().iter();
        let likeliest = types.max_by(|a, b| a.1.as_f64().unwrap().total_cmp(&b.1.as_f64().unwrap())).unwrap().0;
        joints.insert(edge["child"].to_string(), json!([edge["parent"], likeliest]));
    }
    (joints, posterior)
}

#[test]
fn a_bag_played_live_gives_what_its_replay_gives() {
    let Some(bench) = Bench::start(141, &["-p", "root_label:=4", "-p", "publish_tf:=true"]) else { return };
    let model = bench.folder.path().join("model.json");
    let seen = bench.peer(&["live", &bag("cabinet"), "180", model.to_str().unwrap()]);
    let note = || format!("{seen:#}\n{}", bench.log());
    assert_eq!(seen["state"], "active", "{}", note());
    assert_eq!(seen["prior"]["edges"], 0, "the prior is there from the start: {}", note());
    assert_eq!(seen["settled"], true, "{}", note());
    let (joints, posterior) = replayed("cabinet", "4");
    assert_eq!(seen["windows"], posterior["windows"].as_array().unwrap().len(), "{}", note());
    assert_eq!(seen["joints"], json!(joints), "{}", note());
    for edge in posterior["edges"].as_array().unwrap() {
        let live = &seen["edges"][edge["child"].to_string()];
        if edge["probability"].as_f64().unwrap() <= 0.5 || joints[&edge["child"].to_string()][1] == "rigid" {
            continue;
        }
        for name in ["damping", "friction", "joint_inertia"] {
            let number = |of: &Value, key: &str| of[name][key].as_f64().unwrap();
            let overlap = number(live, "q05") <= number(edge, "q95") && number(edge, "q05") <= number(live, "q95");
            assert!(overlap, "{name}: live {}, replayed {}", live[name], edge[name]);
        }
    }
    // Every frame is predicted but for those still waiting for their transforms at the start.
    assert!(seen["predicted"]["count"].as_u64().unwrap() > 200, "{}", note());
    assert_eq!(seen["predicted"]["horizons"], json!([0.1, 0.5, 1.0]), "{}", note());
    assert_eq!(seen["predicted"]["frame"], "world");
    assert_eq!(seen["predicted"]["labels"].as_array().unwrap().len(), posterior["parts"].as_array().unwrap().len());
    assert_eq!(seen["criticism"], true);
    assert_eq!(seen["markers"], json!(["axes", "edges", "parts", "uncertainty"]), "{}", note());
    assert!(seen["largest_markers"].as_u64().unwrap() < 100_000, "{}", note());
    let description = seen["description"].as_str().unwrap();
    for child in joints.keys() {
        assert!(description.contains(&format!("<joint name=\"joint_{child}\"")), "{description}");
        let moves = joints[child][1] != "rigid";
        assert_eq!(seen["joint_states"][format!("joint_{child}")].is_number(), moves, "{}", note());
    }
    assert_eq!(seen["late"]["description"], true);
    let planned = &seen["planned"];
    for plan in ["pull", "push"] {
        assert_eq!(
            (&planned[plan]["success"][0], &planned[plan]["label"]),
            (&json!(true), &planned["part"]),
            "{}",
            note()
        );
        assert_eq!(planned[plan]["labels"], seen["predicted"]["labels"], "{}", note());
        assert!(planned[plan]["variance"].as_f64().unwrap() > 0.0, "{}", note());
    }
    let way = |plan: &str| planned[plan]["way"].as_f64().unwrap();
    assert!(way("pull") - way("push") > 0.02, "{}", note());
    assert_eq!(planned["wrong"], json!([false, "part 999 has no joint that is known"]));
    let kept = &seen["model"];
    assert_eq!((&kept["saved"][0], &kept["reset"], &kept["loaded"][0]), (&json!(true), &json!(true), &json!(true)));
    assert_eq!(kept["forgotten"], 0, "{}", note());
    assert_eq!(kept["missing"][0], false);
    assert!(kept["missing"][1].as_str().unwrap().starts_with("/nowhere/model.json: No such file"), "{}", note());
    assert_eq!((&kept["windows"], &kept["joints"]), (&seen["windows"], &seen["joints"]), "{}", note());
    assert_eq!(seen["late"]["windows"], seen["windows"], "a late joiner gets the last posterior");
    assert!(seen["nodes"].as_array().unwrap().contains(&json!("/bom")), "{}", note());
    let tracking = &seen["diagnostics"]["bom: tracking"]["values"];
    assert!(tracking["cloud to prediction sent, p99 [ms]"].is_string(), "{}", note());
    assert!(seen["log"].as_array().unwrap().iter().any(|line| line.as_str().unwrap().contains("learned in")));
    assert!(bench.stop());
}

#[test]
fn parameters_lifecycle_and_services_answer_rclpy() {
    let folder = tempfile::tempdir().unwrap();
    let file = folder.path().join("parameters.yaml");
    std::fs::write(&file, "/bom:\n  ros__parameters:\n    windows: {quiet_s: 0.25}\n    quiet: 1.0\n").unwrap();
    let file = file.to_str().unwrap();
    let Some(bench) = Bench::start(142, &["--params-file", file]) else { return };
    let seen = bench.peer(&["services"]);
    let note = || format!("{seen:#}\n{}", bench.log());
    assert_eq!(seen["state"], "active", "{}", note());
    assert!(seen["names"].as_array().unwrap().len() > 35, "{}", note());
    assert!(seen["below"].as_array().unwrap().contains(&json!("windows.quiet_s")), "{}", note());
    let below = seen["below"].as_array().unwrap();
    assert!(below.iter().all(|name| name.as_str().unwrap().starts_with("windows.")), "{}", note());
    assert_eq!(
        seen["quiet"],
        json!([3, "It closes after this long without contact and motion [s].", false, [1e6]]),
        "{}",
        note()
    );
    assert_eq!(seen["sim"], json!([1, true]));
    assert_eq!(seen["values"], json!([0.25, 0]), "the file's value, and none for what is not declared");
    assert_eq!(seen["types"], json!([1, 3]));
    let refused = [
        (1, "`use_sim_time` is read-only"),
        (2, "`windows.quiet_s` can be set only while the node is unconfigured"),
        (3, "`wrench_timeout_s`: -1, expected 0.01 to 60"),
        (4, "`nothing` is not declared"),
    ];
    assert_eq!(seen["one_by_one"][0], json!([true, ""]));
    for (index, reason) in refused {
        assert_eq!(seen["one_by_one"][index][0], false);
        assert!(seen["one_by_one"][index][1].as_str().unwrap().starts_with(reason), "{}", note());
    }
    assert_eq!(seen["together"][0], false, "all or none");
    assert_eq!(seen["states"].as_array().unwrap().len(), 11);
    assert_eq!(seen["transitions"], json!(["deactivate", "shutdown"]));
    assert_eq!(seen["graph"], 7);
    assert_eq!(
        seen["changes"],
        json!([[true, "inactive"], [false, "inactive"], [true, "unconfigured"], [true, "inactive"], [true, "active"]]),
        "{}",
        note()
    );
    assert_eq!(seen["unconfigured"], json!([true, ""]));
    assert_eq!(seen["reset"], json!([true, "what was learned is forgotten"]));
    assert_eq!(seen["events"], json!(["inactive", "unconfigured", "inactive", "active"]), "{}", note());
    assert!(seen["parameter_events"].as_array().unwrap().contains(&json!("publish_tf")), "{}", note());
    let said = seen["diagnostics"]["bom: parameters"]["message"].as_str().unwrap();
    assert!(said.contains("unknown parameter `quiet`"), "{}", note());
    assert!(bench.log().contains("unknown parameter `quiet`"), "{}", note());
    assert_eq!(seen["bonded"], json!([true, true]), "{}", note());
    assert_eq!(seen["bond"], json!([[0, true], [0, false], [1, true]]), "{}", note());
    assert!(bench.log().contains("bond with a lifecycle manager"), "{}", note());
    assert!(bench.stop());
}

#[test]
fn bad_input_is_named_within_a_second_and_the_node_goes_on() {
    let arguments = ["-p", "use_sim_time:=true", "-p", "unknown_key:=1", "-p", "wrench_timeout_s:=0.2"];
    let Some(bench) = Bench::start(143, &arguments) else { return };
    let seen = bench.peer(&["trouble"]);
    let note = || format!("{seen:#}\n{}", bench.log());
    let named = seen["found"].as_object().unwrap();
    let wanted = ["no transform", "wrench dies", "clock stands still", "clock goes back", "slow clouds", "QoS"];
    for trouble in wanted {
        // In diagnostics and in the log; discovery of an unfit publisher comes before it can be named.
        let within_s = if trouble == "QoS" { 3.0 } else { 1.2 };
        let times = named[trouble].as_array().unwrap_or_else(|| panic!("{trouble} was not named: {}", note()));
        assert!(times.iter().all(|time| time.as_f64().unwrap() < within_s), "{trouble}: {}", note());
    }
    assert!(seen["going_on"].as_u64().unwrap() >= 8, "predictions go on after the clock went back: {}", note());
    assert_eq!(seen["state"], "active", "{}", note());
    let parameters = seen["diagnostics"]["bom: parameters"]["message"].as_str().unwrap();
    assert!(parameters.contains("unknown parameter `unknown_key`"), "{}", note());
    assert!(bench.stop());
}

#[test]
fn a_subscriber_that_stands_still_holds_up_nobody() {
    let Some(bench) = Bench::start(146, &["-p", "root_label:=3"]) else { return };
    let seen = bench.peer(&["held_up", &bag("chain")]);
    let note = format!("{seen:#}\n{}", bench.log());
    assert_eq!(seen["stood_still"], true, "{note}");
    // It would be the lease of the one that stands still, 20 s.
    assert!(seen["heard"].as_u64().unwrap() > 10 && seen["longest_gap"].as_f64().unwrap() < 3.0, "{note}");
    assert!(bench.stop());
}

#[test]
fn another_vendor_is_heard_and_gets_what_is_latched() {
    let Some(bench) = Bench::start(144, &["-p", "root_label:=1"]) else { return };
    let seen = bench.run("cyclone.py", &[]);
    assert!(seen["joint_states"].as_u64().unwrap() >= 5, "{seen:#}\n{}", bench.log());
    let description = seen["last"].as_str().unwrap();
    assert!(
        description.contains("<link name=\"part_1\">") && description.contains("<link name=\"part_2\">"),
        "{description}"
    );
    assert!(bench.stop());
}

#[test]
fn a_recording_has_what_was_taken_and_said_and_replays_to_the_same() {
    let folder = tempfile::tempdir().unwrap();
    let record = folder.path().join("run");
    let arguments = ["-p", "root_label:=3", "-p", "publish_tf:=true", "-p", "tf_prefix:=seen/"];
    let Some(bench) = Bench::start_recording(145, Some(&record), &arguments) else { return };
    let seen = bench.peer(&["play", &bag("chain")]);
    let note = format!("{seen:#}\n{}", bench.log());
    assert_eq!(seen["settled"], true, "{note}");
    assert!(bench.stop());
    let (joints, posterior) = replayed_bag(&record, "3");
    assert_eq!(seen["windows"], posterior["windows"].as_array().unwrap().len(), "{note}");
    assert_eq!(seen["joints"], json!(joints), "{note}");
    // Where a window ended went with when the one before was learned: the recording says it.
    let since_first = |spans: Vec<[f64; 2]>| -> Vec<[f64; 2]> {
        spans.iter().map(|span| span.map(|time_s| time_s - spans[0][0])).collect()
    };
    let span = |window: &Value| ["t0_s", "t1_s"].map(|end| window[end].as_f64().unwrap());
    let live_spans = since_first(serde_json::from_value(seen["spans"].clone()).unwrap());
    let replayed_spans = since_first(posterior["windows"].as_array().unwrap().iter().map(span).collect());
    let farthest = live_spans.as_flattened().iter().zip(replayed_spans.as_flattened()).map(|(a, b)| (a - b).abs());
    let spans = format!("{live_spans:?} {replayed_spans:?}");
    assert!(farthest.fold(0.0, f64::max) < 1e-6, "windows end elsewhere: {spans}\n{note}");
    for edge in posterior["edges"].as_array().unwrap() {
        let Some(medians) = seen["medians"].get(edge["child"].to_string()) else { continue };
        if edge["probability"].as_f64().unwrap() <= 0.5 {
            continue;
        }
        for (name, live) in ["damping", "friction", "joint_inertia"].iter().zip(medians.as_array().unwrap()) {
            let (live, replayed) = (live.as_f64().unwrap(), edge[name]["median"].as_f64().unwrap());
            assert!((live / replayed - 1.0).abs() < 1e-9, "{name}: live {live}, replayed {replayed}\n{note}");
        }
    }
    let bag = Bag::open(&record).unwrap();
    assert!(bag.damage().is_empty());
    let counts: BTreeMap<String, usize> = bag.fold(BTreeMap::new(), |mut counts, message| {
        *counts.entry(message.topic.name.clone()).or_default() += 1;
        counts
    });
    // All that was published, whether the peer heard it or not.
    assert!(counts["/bom/predicted_poses"] as u64 >= seen["predicted"].as_u64().unwrap(), "{counts:?}\n{note}");
    for topic in ["/parts/points", "/wrench", "/tf", "/bom/object_posterior", "/bom/criticism", "/diagnostics"] {
        assert!(counts[topic] > 1, "{topic}: {counts:?}\n{note}");
    }
    for topic in ["/bom/joint_states", "/bom/robot_description", "/bom/markers"] {
        assert!(counts[topic] > 1, "{topic}: {counts:?}\n{note}");
    }
    let metadata = std::fs::read_to_string(record.join("metadata.yaml")).unwrap();
    assert!(metadata.contains("- run_0.mcap"), "{metadata}");
    // Rates go with joint states, and frames have their prefix.
    assert!(seen["fastest"].as_f64().unwrap() > 0.02, "{note}");
    assert!(
        seen["tf"].as_array().unwrap().iter().all(|name| name.as_str().unwrap().starts_with("seen/part_")),
        "{note}"
    );
    assert!(!seen["tf"].as_array().unwrap().is_empty(), "{note}");
}
