//! How often criticism names the right effect, raises false alarms, and owns to not knowing.
//!
//! `cargo run --release --example criticism_benchmark [OBJECTS [PLAIN [EFFECT]]]`, the numbers each a count or a
//! range such as `2..4`, writes a line for each object to standard error, and tables at the end; `--sum LOG...`
//! makes the tables of such lines. The tables are in `docs/criticism.md`.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "the tables are what this program is for")]
#![allow(clippy::expect_used, reason = "a program for the command line")]

#[path = "../tests/criticism/world.rs"]
mod world;

use std::collections::BTreeMap;

use bayesian_object_models::model::DeclaredPhysics;
use bayesian_object_models::types::posterior::{Criticism, Verdict};
use rayon::prelude::*;
use world::{EFFECTS, Record, SIZES, UNLISTED, Undeclared, object};

/// Interactions with the joint that has the effect; where there is another they take turns.
const WINDOWS: usize = 5;

struct Run {
    name: &'static str,
    size: usize,
    number: u64,
    findings: Criticism,
    undeclared: Option<Undeclared>,
}

fn main() {
    let filter = tracing_subscriber::EnvFilter::from_default_env();
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false).init();
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let mut runs = match &arguments[..] {
        [flag, logs @ ..] if flag == "--sum" => logs.iter().flat_map(|log| logged(log)).collect(),
        _ => run(&arguments),
    };
    // A run that was stopped and begun anew may have some twice.
    runs.sort_by_key(|run| (run.name, run.size, run.number));
    runs.dedup_by_key(|run| (run.name, run.size, run.number));
    println!("{} objects.\n", runs.len());
    print_recognition(&runs);
    print_plain(&runs);
    print_confusion(&runs);
    print_coverage(&runs);
}

/// Runs what the arguments ask for, in the order of the objects' numbers, and logs each as it ends.
fn run(arguments: &[String]) -> Vec<Run> {
    let range = |i: usize, otherwise: u64| match arguments.get(i).map(|text| text.split_once("..").ok_or(text)) {
        None => 0..otherwise,
        Some(Ok((from, to))) => from.parse().expect("a number")..to.parse().expect("a number"),
        Some(Err(count)) => 0..count.parse().expect("a number"),
    };
    let (objects, plain) = (range(0, 8), range(1, 60));
    let asked = |name: &str| arguments.get(2).is_none_or(|only| only == name);
    let per_number = (plain.end - plain.start).div_ceil((objects.end - objects.start).max(1)).max(1);
    let mut plain = plain.peekable();
    let mut tasks: Vec<(&'static str, usize, u64)> = Vec::new();
    for number in objects {
        tasks.extend(plain.by_ref().take(per_number as usize).map(|number| ("plain", 2, number)));
        for name in EFFECTS.into_iter().chain(UNLISTED).filter(|name| asked(name)) {
            tasks.extend((0..SIZES.len()).map(|size| (name, size, number)));
        }
    }
    tasks.extend(plain.map(|number| ("plain", 2, number)));
    tasks
        .par_iter()
        .map(|&(name, size, number)| {
            let (object, mut rng) = object(name, SIZES[size], number);
            let twice = matches!(object.undeclared, Some(Undeclared::Brake(_)));
            let record = Record::of(&object, if twice { 2 * WINDOWS - 1 } else { WINDOWS }, &mut rng);
            let findings = record.criticize(&DeclaredPhysics::default()).1.findings();
            let line = serde_json::json!({ "name": name, "size": size, "number": number, "findings": findings });
            eprintln!("{line}");
            Run { name, size, number, findings, undeclared: object.undeclared }
        })
        .collect()
}

/// The runs in a log.
fn logged(path: &str) -> Vec<Run> {
    let text = std::fs::read_to_string(path).expect("a log");
    let lines = text.lines().filter_map(|line| serde_json::from_str::<serde_json::Value>(line).ok());
    let runs = lines.filter_map(|line| {
        let name = ["plain"].into_iter().chain(EFFECTS).chain(UNLISTED).find(|name| line["name"] == **name)?;
        let size = SIZES.iter().enumerate().position(|(size, _)| line["size"] == size)?;
        let number = line["number"].as_u64()?;
        let findings = serde_json::from_value(line["findings"].clone()).ok()?;
        Some(Run { name, size, number, findings, undeclared: object(name, SIZES[size], number).0.undeclared })
    });
    runs.collect()
}

/// What was named first; a class counts by any of its members.
fn first(findings: &Criticism) -> String {
    findings.effects.first().map_or_else(|| "nothing".to_owned(), |effect| effect.name.clone())
}

fn is_right(run: &Run) -> bool {
    let Some(effect) = run.findings.effects.first() else { return run.name == "plain" };
    if UNLISTED.contains(&run.name) {
        return effect.name == "unknown";
    }
    effect.name == run.name || effect.indistinguishable_from.iter().any(|other| other == run.name)
}

fn share(runs: &[&Run], of: impl Fn(&Run) -> bool) -> String {
    format!("{} of {}", runs.iter().filter(|run| of(run)).count(), runs.len())
}

fn print_recognition(runs: &[Run]) {
    println!("| effect | size .3 | size .6 | size 1 |\n|---|--:|--:|--:|");
    for name in EFFECTS.into_iter().chain(UNLISTED) {
        let cells: Vec<String> = (0..SIZES.len())
            .map(|size| {
                let own: Vec<&Run> = runs.iter().filter(|run| run.name == name && run.size == size).collect();
                share(&own, is_right)
            })
            .collect();
        println!("| {name} | {} |", cells.join(" | "));
    }
    for (title, names) in [("listed", &EFFECTS[..]), ("not listed", &UNLISTED[..])] {
        let larger: Vec<&Run> = runs.iter().filter(|run| names.contains(&run.name) && run.size > 0).collect();
        println!("\nRight at the two larger sizes, {title}: {}.", share(&larger, is_right));
        let named = |run: &Run| {
            let first = run.findings.effects.first();
            !is_right(run) && first.is_some_and(|effect| effect.name != "unknown" && effect.probability > 0.5)
        };
        println!("A wrong name with more than even odds: {}.", share(&larger, named));
    }
}

fn print_plain(runs: &[Run]) {
    let plain: Vec<&Run> = runs.iter().filter(|run| run.name == "plain").collect();
    let alarms = |run: &Run| run.findings.verdict != Verdict::Adequate;
    println!("\nFalse alarms on plain objects: {}.", share(&plain, alarms));
}

fn print_confusion(runs: &[Run]) {
    let mut counts: BTreeMap<(&str, String), usize> = BTreeMap::new();
    for run in runs.iter().filter(|run| run.name != "plain" && run.size > 0 && !is_right(run)) {
        *counts.entry((run.name, first(&run.findings))).or_default() += 1;
    }
    println!("\n| truth (two larger sizes) | named first | times |\n|---|---|--:|");
    for ((truth, found), count) in counts {
        println!("| {truth} | {found} | {count} |");
    }
}

/// How often 90 % intervals hold the parameters of effects that were named.
fn print_coverage(runs: &[Run]) {
    let (mut held, mut total) = (0, 0);
    for run in runs {
        let Some(Undeclared::Effect(kind, values)) = &run.undeclared else { continue };
        let Some(effect) = run.findings.effects.iter().find(|effect| effect.name == kind.name()) else { continue };
        for (parameter, value) in kind.parameters().iter().zip(values) {
            // A phase is known up to whole turns.
            let Some(q) = effect.parameters.get(parameter.name) else { continue };
            let turns =
                if parameter.name == "phase" { ((value - q.median) / std::f64::consts::TAU).round() } else { 0.0 };
            let value = value - turns * std::f64::consts::TAU;
            held += usize::from(q.q05 <= value && value <= q.q95);
            total += 1;
        }
    }
    println!("\n90 % intervals of the effects' parameters that hold the truth: {held} of {total}.");
}
