//! `bom replay`: the whole pipeline over a recorded bag.

use std::collections::BTreeSet;
use std::path::PathBuf;
use std::time::{Duration, Instant};

use anyhow::{Context, bail};
use bayesian_object_models::{
    io::{
        bag::Bag, config::Config, counters::Counters, document::PosteriorDocument, ingest::Ingest,
        output_file::OutputFile, topics::MissingTopics,
    },
    pipeline::{Output, Pipeline},
    report::{
        displacement_csv::{self, Row, center_std},
        table::{Run, table},
    },
    types::{Input, Label, Stamp},
};
use clap::Args;

use super::{print, progress::Progress};

/// Learns an object from a recorded bag and prints what was found
#[derive(Debug, Args)]
pub struct ReplayArguments {
    /// An .mcap file or a rosbag2 folder
    bag: PathBuf,
    /// The part that is fixed to the world; found out if not given
    #[arg(long, value_name = "N")]
    root_label: Option<u32>,
    /// Configuration, YAML; config/default.yaml documents every key
    #[arg(long, value_name = "FILE")]
    config: Option<PathBuf>,
    /// Write the posterior, JSON
    #[arg(long, value_name = "OUT.json")]
    posterior: Option<PathBuf>,
    /// Write where registration saw each part, csv
    #[arg(long, value_name = "OUT.csv")]
    observations: Option<PathBuf>,
    /// Write where each part was expected, csv
    #[arg(long, value_name = "OUT.csv")]
    predictions: Option<PathBuf>,
}

/// Runs it.
pub fn run(arguments: &ReplayArguments) -> anyhow::Result<()> {
    let begin = now();
    let config = match &arguments.config {
        Some(path) => Config::from_file(path)?,
        None => Config::default(),
    };
    let mut bag = Bag::open(&arguments.bag)?;
    let missing = MissingTopics::of(&config.input, bag.summary());
    if let Some(missing) = missing.as_ref().filter(|missing| missing.nothing_to_see) {
        bail!("{}: {missing}", arguments.bag.display());
    }
    // Opened before the work, so that a wrong path does not cost a run.
    let posterior_file = arguments.posterior.as_deref().map(OutputFile::create).transpose()?;
    let mut replay = Replay::new(arguments, &config)?;
    replay.read(&mut bag)?;

    let mut remarks: Vec<String> = missing.iter().map(ToString::to_string).collect();
    remarks.extend(bag.damage().iter().map(ToString::to_string));
    remarks.extend(replay.ingest.diagnostics().iter().map(ToString::to_string));
    let document = replay.document(arguments, &bag)?;
    replay.finish_files()?;
    if let (Some(mut file), Some(path)) = (posterior_file, &arguments.posterior) {
        document.write(&mut file).with_context(|| path.display().to_string())?;
        file.finish()?;
    }
    print(&table(&Run {
        bag: &arguments.bag.display().to_string(),
        document: &document,
        root_is_given: arguments.root_label.is_some(),
        stream_s: replay.span.map_or(0.0, |(first, last)| last.seconds_since(first)),
        wall_s: begin.elapsed().as_secs_f64(),
        remarks: &remarks,
    }))
}

/// The core reads no clock; this does, for `inference_wall_s` and the table.
#[allow(clippy::disallowed_methods)]
fn now() -> Instant {
    Instant::now()
}

/// A replay under way.
struct Replay {
    ingest: Ingest,
    pipeline: Pipeline,
    observations: Option<OutputFile>,
    predictions: Option<OutputFile>,
    seen: BTreeSet<Label>,
    /// Earliest and latest stamp.
    span: Option<(Stamp, Stamp)>,
    /// Of each window's learning, in order.
    inference_wall: Vec<Duration>,
}

impl Replay {
    fn new(arguments: &ReplayArguments, config: &Config) -> anyhow::Result<Self> {
        let mut observations = arguments.observations.as_deref().map(OutputFile::create).transpose()?;
        if let Some(file) = &mut observations {
            displacement_csv::write_header(&mut *file, false).map_err(|error| file.fail(error))?;
        }
        let mut predictions = arguments.predictions.as_deref().map(OutputFile::create).transpose()?;
        if let Some(file) = &mut predictions {
            displacement_csv::write_header(&mut *file, true).map_err(|error| file.fail(error))?;
        }
        let mut settings = config.pipeline_settings(arguments.root_label.map(Label));
        settings.predict = predictions.is_some();
        Ok(Self {
            ingest: Ingest::new(&config.input),
            pipeline: Pipeline::new(settings),
            observations,
            predictions,
            seen: BTreeSet::new(),
            span: None,
            inference_wall: Vec::new(),
        })
    }

    /// Takes in every message of a bag, to its end.
    fn read(&mut self, bag: &mut Bag) -> anyhow::Result<()> {
        let progress = Progress::of_bytes(bag.summary().bytes);
        while let Some(message) = bag.next() {
            let inputs = self.ingest.push(&message.topic.name, &message.topic.type_name, message.bytes());
            for input in inputs {
                self.push(input)?;
            }
            progress.at(bag.bytes_read());
            progress.say(format!("{} windows", self.inference_wall.len()));
        }
        for input in self.ingest.flush() {
            self.push(input)?;
        }
        self.timed(Pipeline::finish)
    }

    fn push(&mut self, input: Input) -> anyhow::Result<()> {
        let stamp = input.stamp();
        let (first, last) = self.span.unwrap_or((stamp, stamp));
        self.span = Some((first.min(stamp), last.max(stamp)));
        self.timed(|pipeline| pipeline.push(input))
    }

    /// A step of the pipeline; where it learned windows, what it took is theirs.
    fn timed(&mut self, step: impl FnOnce(&mut Pipeline) -> Vec<Output>) -> anyhow::Result<()> {
        let begin = now();
        let outputs = step(&mut self.pipeline);
        let took = begin.elapsed();
        let learned = outputs.iter().filter(|output| matches!(output, Output::Learned { .. })).count();
        self.inference_wall.extend((0..learned).map(|_| took / learned as u32));
        outputs.iter().try_for_each(|output| self.take(output))
    }

    fn take(&mut self, output: &Output) -> anyhow::Result<()> {
        match output {
            Output::Observation { time_s, label, measurement } => {
                self.seen.insert(*label);
                let Some(file) = &mut self.observations else { return Ok(()) };
                let row = Row {
                    time_s: *time_s,
                    horizon_s: None,
                    label: *label,
                    displacement: measurement.displacement,
                    std_m: center_std(&measurement.displacement, &measurement.information),
                };
                displacement_csv::write_row(&mut *file, &row).map_err(|error| file.fail(error))?;
            }
            Output::Prediction { time_s, horizon_s, label, displacement, covariance_m2 } => {
                let Some(file) = &mut self.predictions else { return Ok(()) };
                let row = Row {
                    time_s: *time_s,
                    horizon_s: Some(*horizon_s),
                    label: *label,
                    displacement: *displacement,
                    std_m: covariance_m2.diagonal().map(|variance| variance.max(0.0).sqrt()),
                };
                displacement_csv::write_row(&mut *file, &row).map_err(|error| file.fail(error))?;
            }
            // A replay learns in the stream.
            Output::WindowClosed(_) => {}
            Output::Learned { span_s } => tracing::info!(from_s = span_s.0, to_s = span_s.1, "window learned"),
        }
        Ok(())
    }

    fn document(&self, arguments: &ReplayArguments, bag: &Bag) -> anyhow::Result<PosteriorDocument> {
        let bag_name = arguments.bag.display();
        let counters = self.ingest.counters().clone().with_damage(bag.damage());
        let Some(mut posterior) = self.pipeline.posterior() else {
            bail!("{bag_name}: no cloud and no pose could be used: {}", why_nothing(&counters, &self.ingest));
        };
        if let Some(root) = arguments.root_label.map(Label)
            && !self.seen.contains(&root)
            && counters.poses_in == 0
        {
            let seen: Vec<String> = self.seen.iter().map(Label::to_string).collect();
            bail!("{bag_name}: --root-label {root}: no such part, seen were {}", seen.join(", "));
        }
        for (window, wall) in posterior.windows.iter_mut().zip(&self.inference_wall) {
            window.inference_wall_s = wall.as_secs_f64();
        }
        Ok(PosteriorDocument::new(posterior, counters))
    }

    fn finish_files(&mut self) -> anyhow::Result<()> {
        for file in [self.observations.take(), self.predictions.take()].into_iter().flatten() {
            file.finish()?;
        }
        Ok(())
    }
}

fn why_nothing(counters: &Counters, ingest: &Ingest) -> String {
    let arrived = counters.clouds_in + counters.poses_in;
    match ingest.diagnostics().first() {
        Some(first) => format!("{arrived} arrived, the first dropped: {first}"),
        None => format!("{arrived} arrived"),
    }
}
