//! `bom import`: a recorded table becomes a bag.

use std::path::PathBuf;

use anyhow::bail;
use bayesian_object_models::io::import::{ImportSpec, Table, import};
use clap::Args;

use super::print;

/// Turns a recorded table of joint positions, poses or points and of forces into a bag
#[derive(Debug, Args)]
pub struct ImportArguments {
    /// The table, CSV with the names of its columns in the first line
    table: PathBuf,
    /// What its columns are, TOML; config/import has examples
    #[arg(long, value_name = "SPEC.toml")]
    spec: PathBuf,
    /// The bag to write, .mcap
    #[arg(short, long, value_name = "OUT.mcap")]
    output: PathBuf,
    /// Only the rows of this split of the spec
    #[arg(long, value_name = "NAME")]
    split: Option<String>,
    /// Only the rows whose column holds this text; over the spec's own
    #[arg(long, value_name = "COLUMN=TEXT")]
    select: Vec<String>,
}

/// Runs it.
pub fn run(arguments: &ImportArguments) -> anyhow::Result<()> {
    let mut spec = ImportSpec::from_file(&arguments.spec)?;
    for text in &arguments.select {
        let Some((column, value)) = text.split_once('=') else {
            bail!("--select {text}: expected COLUMN=TEXT");
        };
        spec.select.insert(column.to_owned(), value.to_owned());
    }
    let split = match &arguments.split {
        None => None,
        Some(name) => match spec.splits.get(name) {
            Some(split) => Some(split),
            None => {
                let known: Vec<&str> = spec.splits.keys().map(String::as_str).collect();
                bail!("--split {name}: {} has {}", arguments.spec.display(), list(&known));
            }
        },
    };
    let table = Table::from_file(&arguments.table)?;
    let imported = import(table, &spec, split, &arguments.output)?;
    let left_out = match imported.rows_empty {
        0 => String::new(),
        count => format!("; {count} left out for an empty cell"),
    };
    print(&format!(
        "{}: {} messages from {} readings ({} rows in {}{left_out})\n",
        arguments.output.display(),
        imported.messages,
        imported.rows,
        imported.rows_in,
        arguments.table.display()
    ))
}

fn list(names: &[&str]) -> String {
    if names.is_empty() { "no splits".into() } else { format!("splits {}", names.join(", ")) }
}
