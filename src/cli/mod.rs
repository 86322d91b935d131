//! Subcommands, their options, logging.

mod evaluate;
mod import;
mod node;
mod progress;
mod recording;
mod replay;

use std::io::{self, Write};

use anyhow::Context;
use bayesian_object_models::node::rosout::RosoutLayer;
use bayesian_object_models::types::Label;
use clap::{Parser, Subcommand};
use tracing_subscriber::{EnvFilter, layer::SubscriberExt, util::SubscriberInitExt};

/// What is logged unless asked otherwise; what reading finds is in the table already.
const DEFAULT_LOG: &str = "warn,bayesian_object_models::io=error";
/// What the node logs unless asked otherwise; the transport's own complaints are in the node's words.
const NODE_LOG: &str = "warn,bayesian_object_models=info,rustdds=error,ros2_client=error";

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
    Evaluate(evaluate::EvaluateArguments),
    Node(node::NodeArguments),
}

/// Does what was asked.
pub fn run(arguments: &Arguments) -> anyhow::Result<()> {
    match &arguments.command {
        Command::Replay(replay) => {
            start_logging(arguments.log_level.as_deref(), DEFAULT_LOG)?;
            replay::run(replay)
        }
        Command::Node(node) => {
            let ros = node.parse()?;
            // ROS has a level that tracing does not: it is the same to it.
            let level = ros.log_level.as_deref().map(|level| if level == "fatal" { "error" } else { level });
            start_logging(level.or(arguments.log_level.as_deref()), NODE_LOG)?;
            node::run(node, &ros)
        }
        Command::Import(import) => {
            start_logging(arguments.log_level.as_deref(), DEFAULT_LOG)?;
            import::run(import)
        }
        Command::Evaluate(evaluate) => {
            start_logging(arguments.log_level.as_deref(), DEFAULT_LOG)?;
            evaluate::run(evaluate)
        }
    }
}

/// Says in one line on standard error what went wrong.
pub fn complain(error: &anyhow::Error) {
    let text = format!("{error:#}").lines().map(str::trim).collect::<Vec<_>>().join(" ");
    // Nobody is left to tell if this fails.
    let _ = writeln!(io::stderr().lock(), "bom: {text}");
}

fn start_logging(level: Option<&str>, otherwise: &str) -> anyhow::Result<()> {
    let filter = match level {
        // A bare level is for this program, not for the transport.
        Some(level) if level.parse::<tracing::Level>().is_ok() => {
            EnvFilter::try_new(format!("{level},rustdds=error,ros2_client=error"))?
        }
        Some(directives) => EnvFilter::try_new(directives).with_context(|| format!("--log-level {directives}"))?,
        None => match std::env::var(EnvFilter::DEFAULT_ENV) {
            Ok(directives) => EnvFilter::try_new(&directives).with_context(|| format!("RUST_LOG={directives}"))?,
            Err(_) => EnvFilter::new(otherwise),
        },
    };
    tracing_subscriber::registry()
        .with(filter)
        .with(tracing_subscriber::fmt::layer().with_writer(progress::AboveTheBar::new).without_time())
        .with(RosoutLayer)
        .init();
    Ok(())
}

/// What is wrong where a saved model's root is not where the first frame has it.
fn other_object(model: &str, root: Label) -> String {
    format!("{model}: another object, or it stands elsewhere: part {root}, its root, is not where the model has it")
}

/// Prints to standard output; a reader that has gone away is no failure.
fn print(text: &str) -> anyhow::Result<()> {
    let mut out = io::stdout().lock();
    match out.write_all(text.as_bytes()).and_then(|()| out.flush()) {
        Err(error) if error.kind() != io::ErrorKind::BrokenPipe => Err(error).context("standard output"),
        _ => Ok(()),
    }
}
