//! The simulated bags beside this repository are read whole: every message becomes an input.
#![allow(clippy::unwrap_used, clippy::print_stderr, clippy::disallowed_methods)]

use std::{
    collections::BTreeSet,
    path::{Path, PathBuf},
    time::Instant,
};

use bayesian_object_models::{
    io::{bag::Bag, config::InputConfig, ingest::Ingest},
    types::Input,
};

/// The .mcap files of ../shared/bags, or nothing and a line that says so.
fn shared_bags() -> Vec<PathBuf> {
    let folder = Path::new(env!("CARGO_MANIFEST_DIR")).join("../shared/bags");
    let Ok(entries) = std::fs::read_dir(&folder) else {
        eprintln!("SKIPPED: {} is not there", folder.display());
        return Vec::new();
    };
    let folders = entries.map(|entry| entry.unwrap().path()).filter(|path| path.is_dir());
    let mut bags: Vec<PathBuf> =
        folders.map(|path| path.join(path.file_name().unwrap()).with_extension("mcap")).collect();
    bags.sort();
    bags
}

fn read(path: &Path) -> (Bag, Ingest, Vec<Input>) {
    let mut bag = Bag::open(path).unwrap();
    let mut ingest = Ingest::new(&InputConfig::default());
    let mut inputs = Vec::new();
    for message in &mut bag {
        inputs.extend(ingest.push(&message.topic.name, &message.topic.type_name, message.bytes()));
    }
    inputs.extend(ingest.flush());
    (bag, ingest, inputs)
}

#[test]
fn every_message_of_the_shared_bags_becomes_an_input() {
    for path in shared_bags() {
        let begin = Instant::now();
        let (bag, ingest, inputs) = read(&path);
        let counters = ingest.counters();
        let elapsed_s = begin.elapsed().as_secs_f64();
        eprintln!("{}: {:.3} s, {} inputs, {counters:?}", path.display(), elapsed_s, inputs.len());
        assert!(bag.damage().is_empty(), "{:?}", bag.damage());
        assert_eq!(bag.bytes_read(), bag.summary().bytes);
        assert!(ingest.diagnostics().is_empty(), "{:?}", ingest.diagnostics());
        assert_eq!(inputs.len() as u64, counters.clouds_in + counters.wrenches_in);
        assert!(counters.clouds_in > 50 && counters.wrenches_in > 500);
        // Debug builds and loaded machines are slower; a release build takes some .1 s.
        assert!(elapsed_s < 10.0);
    }
}

#[test]
fn two_cameras_are_two_sources_and_a_fused_cloud_has_no_viewpoint() {
    for path in shared_bags() {
        let fused = path.ends_with("cabinet_two_doors.mcap");
        let (_, _, inputs) = read(&path);
        let clouds = || {
            inputs.iter().filter_map(|input| match input {
                Input::Cloud(cloud) => Some(cloud),
                _ => None,
            })
        };
        let sources: BTreeSet<usize> = clouds().map(|cloud| cloud.source).collect();
        assert_eq!(sources.len(), if fused { 1 } else { 2 }, "{}", path.display());
        assert!(clouds().all(|cloud| cloud.viewpoint_in_world.is_none() == fused));
    }
}
