//! How often criticism names the right effect, raises false alarms, and owns to not knowing.
//!
//! `cargo run --release --example criticism_benchmark [OBJECTS [PLAIN]]`; the tables are in
//! `docs/criticism.md`.
#![allow(clippy::print_stdout, clippy::print_stderr, reason = "the tables are what this program is for")]
#![allow(clippy::expect_used, reason = "a program for the command line")]

#[path = "../tests/criticism/world.rs"]
mod world;

use std::collections::BTreeMap;

use bayesian_object_models::model::DeclaredPhysics;
use bayesian_object_models::types::posterior::{Criticism, Verdict};
use rayon::prelude::*;
use world::{EFFECTS, Record, SIZES, UNLISTED, Undeclared, object};

/// Interactions with one joint; of two joints twice as many.
const WINDOWS: usize = 5;

struct Run {
    name: &'static str,
    size: usize,
    findings: Criticism,
    undeclared: Option<Undeclared>,
}

fn main() {
    let argument = |i: usize| std::env::args().nth(i).map(|text| text.parse::<u64>().expect("a number"));
    let objects = argument(1).unwrap_or(8);
    let plain = argument(2).unwrap_or(60);
    let mut tasks: Vec<(&'static str, usize, u64)> = (0..plain).map(|number| ("plain", 2, number)).collect();
    for number in 0..objects {
        for name in EFFECTS.into_iter().chain(UNLISTED) {
            tasks.extend((0..SIZES.len()).map(|size| (name, size, number)));
        }
    }
    let runs: Vec<Run> = tasks
        .par_iter()
        .map(|&(name, size, number)| {
            let (object, mut rng) = object(name, SIZES[size], number);
            let twice = matches!(object.undeclared, Some(Undeclared::Brake(_)));
            let record = Record::of(&object, if twice { 2 * WINDOWS } else { WINDOWS }, &mut rng);
            let findings = record.criticize(&DeclaredPhysics::default()).1.findings();
            let found: Vec<&str> = findings.effects.iter().map(|effect| effect.name.as_str()).collect();
            eprintln!("{name} {} {number}: {:?} {found:?}", SIZES[size], findings.verdict);
            Run { name, size, findings, undeclared: object.undeclared }
        })
        .collect();
    print_recognition(&runs);
    print_plain(&runs);
    print_confusion(&runs);
    print_coverage(&runs);
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
