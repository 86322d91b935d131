//! `bom evaluate`: a saved model on a bag that it does not learn from.

use std::path::PathBuf;

use anyhow::{Context, bail};
use bayesian_object_models::{
    io::{bag::Bag, config::Config, ingest::Ingest, model_file::SavedModel, output_file::OutputFile},
    pipeline::{Output, Pipeline},
    report::evaluation::{Evaluation, table},
    types::Input,
};
use clap::Args;

use super::{print, progress::Progress, replay::bag_hash};

/// Scores a saved model on a bag without learning from it
#[derive(Debug, Args)]
pub struct EvaluateArguments {
    /// A model, as replay --save-model writes it
    #[arg(value_name = "MODEL.json")]
    model: PathBuf,
    /// An .mcap file or a rosbag2 folder
    bag: PathBuf,
    /// Configuration, YAML; config/default.yaml documents every key
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write the scores, JSON
    #[arg(long, value_name = "OUT.json")]
    json: Option<PathBuf>,
}

/// Runs it.
pub fn run(arguments: &EvaluateArguments) -> anyhow::Result<()> {
    let config = match &arguments.config {
        Some(path) => Config::from_file(path)?,
        None => Config::default(),
    };
    let (model_name, bag_name) = (arguments.model.display().to_string(), arguments.bag.display().to_string());
    let SavedModel { bags, object } = SavedModel::from_file(&arguments.model)?;
    let json = arguments.json.as_deref().map(OutputFile::create).transpose()?;
    let was_learned = bags.contains(&bag_hash(&arguments.bag, &config.input)?);
    let mut bag = Bag::open(&arguments.bag)?;
    let horizon_s = config.evaluation_horizon_s;
    let mut pipeline =
        Pipeline::evaluate(config.pipeline_settings(None), object, horizon_s).with_context(|| model_name.clone())?;
    let mut ingest = Ingest::new(&config.input);
    let progress = Progress::of_bytes(bag.summary().bytes);
    let push = |pipeline: &mut Pipeline, input: Input| check(&pipeline.push(input), &model_name);
    while let Some(message) = bag.next() {
        for input in ingest.push(&message.topic.name, &message.topic.type_name, message.bytes()) {
            push(&mut pipeline, input)?;
        }
        progress.at(bag.bytes_read());
    }
    for input in ingest.flush() {
        push(&mut pipeline, input)?;
    }
    check(&pipeline.finish(), &model_name)?;
    drop(progress);

    let counters = ingest.counters().clone().with_damage(bag.damage());
    if counters.clouds_in + counters.poses_in == 0 {
        bail!("{bag_name}: no cloud and no pose could be used");
    }
    let scores = pipeline.scores().cloned().unwrap_or_default();
    let evaluation = Evaluation::new(&model_name, &bag_name, was_learned, horizon_s, &scores, counters);
    if let Some(mut file) = json {
        evaluation.write(&mut file).with_context(|| file.path().display().to_string())?;
        file.finish()?;
    }
    print(&table(&evaluation))
}

/// Whether the model is of the object that is seen.
fn check(outputs: &[Output], model: &str) -> anyhow::Result<()> {
    for output in outputs {
        if let Output::Resumed { root, unexplained, unknown } = output
            && (unexplained.contains(root) || unknown.contains(root))
        {
            bail!("{}", super::other_object(model, *root));
        }
    }
    Ok(())
}
