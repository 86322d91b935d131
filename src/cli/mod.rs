//! Subcommands, their options, logging.

mod import;
mod progress;
mod replay;

use std::io::{self, Write};

use anyhow::Context;
use clap::{Parser, Subcommand};
use tracing_subscriber::EnvFilter;

/// What is logged unless asked otherwise; what reading finds is in the table already.
const DEFAULT_LOG: &str = "warn,bayesian_object_models::io=error";

/// Infers the mechanism of an articulated object from segmented point clouds and wrenches.
#[derive(Debug, Parser)]
#[command(name = "bom", version, arg_required_else_help = true)]
pub struct Arguments {
    #[command(subcommand)]
    command: Command,
    /// What to log, on standard error: a level (error, warn, info, debug, trace) or directives as
    /// in RUST_LOG, which counts where this is not given
    #[arg(long, global = true, value_name = "LEVEL")]
    log_level: Option<String>,
}

#[derive(Debug, Subcommand)]
enum Command {
    Replay(replay::ReplayArguments),
    Import(import::ImportArguments),
}

/// Does what was asked.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    start_logging(arguments.log_level.as_deref())?;
    match &arguments.command {
        Command::Replay(arguments) => replay::run(arguments),
        Command::Import(arguments) => import::run(arguments),
    }
}

/// Says in one line on standard error what went wrong.
pub fn complain(error: &anyhow::Error) {
    let text = format!("{error:#}").lines().map(str::trim).collect::<Vec<_>>().join(" ");
    // Nobody is left to tell if this fails.
    let _ = writeln!(io::stderr().lock(), "bom: {text}");
}

fn start_logging(level: Option<&str>) -> anyhow::Result<()> {
    let filter = match level {
        Some(directives) => EnvFilter::try_new(directives).with_context(|| format!("--log-level {directives}"))?,
        None => match std::env::var(EnvFilter::DEFAULT_ENV) {
            Ok(directives) => EnvFilter::try_new(&directives).with_context(|| format!("RUST_LOG={directives}"))?,
            Err(_) => EnvFilter::new(DEFAULT_LOG),
        },
    };
    tracing_subscriber::fmt().with_env_filter(filter).with_writer(progress::AboveTheBar::new).without_time().init();
    Ok(())
}

/// Prints to standard output; a reader that has gone away is no failure.
fn print(text: &str) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(error).context("standard output"),
        _ => Ok(()),
    }
}
