//! The survey of doors: each opening predicted by what was learned from the others of the same door.

use std::collections::BTreeMap;
use std::fmt::Write as _;
use std::fs;
use std::path::Path;

use anyhow::Context;
use bayesian_object_models::io::config::Config;
use bayesian_object_models::io::import::{self as importing, ImportSpec, Table};
use bayesian_object_models::pipeline::StageScore;

use crate::study::{Calibration, learn, score};

/// Openings of a door that are used at most, its first: some have 25.
const MOST_OPENINGS: usize = 10;

/// One door: its category, and the forces of each opening by angle \[N\], NaN where none was recorded.
struct Door {
    name: String,
    category: String,
    openings: Vec<Vec<f64>>,
}

/// Errors of one door's openings \[N\], root mean squares over angles, means over openings.
struct Errors {
    declared: f64,
    found: f64,
    repeats: f64,
}

/// Writes a table with a row for each door and one for each category.
pub fn section(text: &mut String, table: &Path, root: &Path, scratch: &Path) -> anyhow::Result<()> {
    let _ = writeln!(
        text,
        "\n### door_survey\n\nEach opening is predicted by what was learned from the other ones of the same door (its first \
         {MOST_OPENINGS} at most). *Declared* is inertia and damping, which at a steady rate is a constant force; *repeats* \
         is the error of the mean of the others, angle by angle. Means of the openings' root mean square errors. \
         self_closing and position_friction are one class where a door only opens.\n\n\
         | door | openings | declared | found | repeats | found / repeats | named last, in how many |\n\
         |---|--:|--:|--:|--:|--:|---|"
    );
    let mut by_category: BTreeMap<String, Vec<Errors>> = BTreeMap::new();
    for door in doors(table)? {
        eprintln!("{}", door.name);
        let (errors, names) = study(&door, table, root, scratch)?;
        let names: Vec<String> = names.iter().map(|(name, count)| format!("{name} {count}")).collect();
        row(text, &door.name, &door.openings.len().to_string(), &errors, &names.join("; "));
        by_category.entry(door.category).or_default().push(errors);
    }
    for (category, all) in by_category {
        let mean = |of: fn(&Errors) -> f64| all.iter().map(of).sum::<f64>() / all.len() as f64;
        let errors = Errors { declared: mean(|e| e.declared), found: mean(|e| e.found), repeats: mean(|e| e.repeats) };
        row(text, &format!("**{category}**, {} doors", all.len()), "", &errors, "");
    }
    Ok(())
}

fn row(text: &mut String, name: &str, openings: &str, errors: &Errors, names: &str) {
    let Errors { declared, found, repeats } = errors;
    let ratio = found / repeats;
    let _ = writeln!(
        text,
        "| {name} | {openings} | {declared:.2} N | {found:.2} N | {repeats:.2} N | {ratio:.2} | {names} |"
    );
}

/// All doors, in the order of the table.
fn doors(table: &Path) -> anyhow::Result<Vec<Door>> {
    let mut doors: Vec<Door> = Vec::new();
    for record in csv::Reader::from_path(table)?.records() {
        let record = record?;
        let cell = |i: usize| record.get(i).unwrap_or_default().to_owned();
        let opening: Vec<f64> = record.iter().skip(3).map(|text| text.parse().unwrap_or(f64::NAN)).collect();
        match doors.iter_mut().find(|door| door.name == cell(1)) {
            Some(door) if door.openings.len() < MOST_OPENINGS => door.openings.push(opening),
            Some(_) => {}
            None => doors.push(Door { name: cell(1), category: cell(0), openings: vec![opening] }),
        }
    }
    Ok(doors)
}

fn study(door: &Door, table: &Path, root: &Path, scratch: &Path) -> anyhow::Result<(Errors, BTreeMap<String, usize>)> {
    let spec = root.join("config/import/door_survey.toml");
    let config = Config::from_file(&root.join("config/import/door_survey.yaml"))?;
    let count = door.openings.len();
    let (mut errors, mut names) = (Errors { declared: 0.0, found: 0.0, repeats: 0.0 }, BTreeMap::new());
    for left_out in 0..count {
        let others: Vec<usize> = (0..count).filter(|run| *run != left_out).collect();
        // The table holds more openings than are used: no other has these numbers.
        let splits = format!(
            "\n[splits.others]\nruns_of = 1000\nruns = {others:?}\n[splits.one]\nruns_of = 1000\nruns = [{left_out}]\n"
        );
        let mut spec = ImportSpec::parse(&(fs::read_to_string(&spec)? + &splits), &spec)?;
        spec.select.insert("mechanism".into(), door.name.clone());
        let bag = |name: &str| -> anyhow::Result<_> {
            let bag = scratch.join(format!("door_{name}.mcap"));
            importing::import(Table::from_file(table)?, &spec, spec.splits.get(name), &bag)?;
            Ok(bag)
        };
        let learned = learn(&[bag("others")?], &config, &Calibration::default())?;
        let scores = score(&learned, &[bag("one")?], &config)?;
        let rms = |stage: Option<&StageScore>| {
            let part = stage.and_then(|stage| stage.parts.values().next()).context("nothing was scored")?;
            anyhow::Ok((part.force.0 / part.force.1.max(1e-9)).sqrt())
        };
        errors.declared += rms(scores.stages.first())? / count as f64;
        errors.found += rms(scores.stages.last())? / count as f64;
        errors.repeats += repeats(door, left_out) / count as f64;
        let found = scores.stages.last().map_or(&[][..], |stage| &stage.effects);
        let found: Vec<&str> = found.iter().map(|(_, name)| *name).collect();
        *names.entry(if found.is_empty() { "nothing".to_owned() } else { found.join(" + ") }).or_default() += 1;
    }
    Ok((errors, names))
}

/// What the mean of the other openings is off by \[N\].
fn repeats(door: &Door, left_out: usize) -> f64 {
    let (mut squares, mut count) = (0.0, 0);
    for (angle, force) in door.openings[left_out].iter().enumerate() {
        let others = door.openings.iter().enumerate().filter(|(run, _)| *run != left_out);
        let at: Vec<f64> = others.map(|(_, opening)| opening[angle]).filter(|force| force.is_finite()).collect();
        if force.is_finite() && !at.is_empty() {
            squares += (force - at.iter().sum::<f64>() / at.len() as f64).powi(2);
            count += 1;
        }
    }
    (squares / f64::from(count.max(1))).sqrt()
}
