//! `bom replay`: the whole pipeline over a recorded bag.

use std::collections::BTreeSet;
use std::io::Write;
use std::path::{Path, PathBuf};
use std::sync::LazyLock;
use std::time::Instant;

use anyhow::{Context, bail};
use bayesian_object_models::{
    io::{
        bag::Bag,
        config::{Config, Engine, InputConfig},
        counters::Counters,
        document::PosteriorDocument,
        ingest::Ingest,
        model_file::{BagHash, SavedModel, write_model},
        output_file::OutputFile,
        recorded_windows::recorded_windows,
        topics::MissingTopics,
    },
    pipeline::{Output, Pipeline},
    report::{
        displacement_csv::{self, Row, center_std},
        html::{Evidence, page},
        series::Gatherer,
        table::{Run, table},
    },
    types::{Input, Label, Stamp},
};
use clap::Args;

use super::{print, progress::Progress, recording::Recording};

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
    /// What the published dynamics come from, in place of the configuration's
    #[arg(long, value_enum)]
    engine: Option<Engine>,
    /// Seed of all random numbers, in place of the configuration's
    #[arg(long, value_name = "N")]
    seed: Option<u64>,
    /// Write what was read, and what a node would have published of it, as a bag: replaying it gives the
    /// same posterior
    #[arg(long, value_name = "OUT.mcap")]
    record: Option<PathBuf>,
    /// Write a report for people, one HTML file
    #[arg(long, value_name = "OUT.html")]
    report: Option<PathBuf>,
    /// Save what was learned, for --load-model and evaluate
    #[arg(long, value_name = "OUT.json")]
    save_model: Option<PathBuf>,
    /// Go on learning a saved model
    #[arg(long, value_name = "IN.json")]
    load_model: Option<PathBuf>,
}

/// Runs it.
pub fn run(arguments: &ReplayArguments) -> anyhow::Result<()> {
    let begin = now();
    let mut config = match &arguments.config {
        Some(path) => Config::from_file(path)?,
        None => Config::default(),
    };
    config.seed = arguments.seed.unwrap_or(config.seed);
    config.engine = arguments.engine.unwrap_or(config.engine);
    let mut bag = Bag::open(&arguments.bag)?;
    let missing = MissingTopics::of(&config.input, bag.summary());
    if let Some(missing) = missing.as_ref().filter(|missing| missing.nothing_to_see) {
        bail!("{}: {missing}", arguments.bag.display());
    }
    // Opened before the work, so that a wrong path does not cost a run.
    let mut outputs = Outputs::open(arguments, &config.input.fixed_frame)?;
    let mut replay = Replay::new(arguments, &config)?;
    let window_ends = recorded_windows(&arguments.bag, bag.summary())?;
    replay.pipeline = replay.pipeline.with_window_ends(window_ends);
    replay.read(&mut bag, &mut outputs)?;

    let mut remarks: Vec<String> = missing.iter().map(ToString::to_string).collect();
    remarks.extend(bag.damage().iter().map(ToString::to_string));
    remarks.extend(replay.ingest.diagnostics().iter().map(ToString::to_string));
    remarks.append(&mut replay.remarks);
    let document = replay.document(arguments, &bag)?;
    let bag_name = arguments.bag.display().to_string();
    let run = Run {
        bag: &bag_name,
        document: &document,
        root_is_given: replay.root_is_given,
        stream_s: replay.span.map_or(0.0, |(first, last)| last.seconds_since(first)),
        wall_s: begin.elapsed().as_secs_f64(),
        remarks: &remarks,
    };
    outputs.finish(&run, &mut replay)?;
    print(&table(&run))
}

/// The core reads no clock; this does, for `inference_wall_s` and the table.
#[allow(clippy::disallowed_methods)]
fn now() -> Instant {
    Instant::now()
}

/// Seconds since it was first asked.
fn clock() -> f64 {
    static BEGIN: LazyLock<Instant> = LazyLock::new(now);
    BEGIN.elapsed().as_secs_f64()
}

/// The files that a replay writes.
struct Outputs {
    posterior: Option<OutputFile>,
    observations: Option<OutputFile>,
    predictions: Option<OutputFile>,
    report: Option<OutputFile>,
    model: Option<OutputFile>,
    recording: Option<Recording>,
}

impl Outputs {
    fn open(arguments: &ReplayArguments, fixed_frame: &str) -> anyhow::Result<Self> {
        let create = |path: &Option<PathBuf>| path.as_deref().map(OutputFile::create).transpose();
        let table = |path: &Option<PathBuf>, with_horizon: bool| -> anyhow::Result<Option<OutputFile>> {
            let mut file = create(path)?;
            if let Some(file) = &mut file {
                displacement_csv::write_header(&mut *file, with_horizon).map_err(|error| file.fail(error))?;
            }
            Ok(file)
        };
        Ok(Self {
            posterior: create(&arguments.posterior)?,
            observations: table(&arguments.observations, false)?,
            predictions: table(&arguments.predictions, true)?,
            report: create(&arguments.report)?,
            model: create(&arguments.save_model)?,
            recording: arguments.record.as_deref().map(|path| Recording::create(path, fixed_frame)).transpose()?,
        })
    }

    fn write_row(file: &mut Option<OutputFile>, row: &Row) -> anyhow::Result<()> {
        let Some(file) = file else { return Ok(()) };
        Ok(displacement_csv::write_row(&mut *file, row).map_err(|error| file.fail(error))?)
    }

    /// Completes the files.
    fn finish(self, run: &Run<'_>, replay: &mut Replay) -> anyhow::Result<()> {
        if let Some(mut file) = self.report {
            let gatherer = replay.gatherer.take().unwrap_or_default();
            let zero = replay.pipeline.stream_zero().unwrap_or_default();
            let evidence = Evidence { gatherer: &gatherer, learner: replay.pipeline.learner(), zero };
            file.write_all(page(run, &evidence).as_bytes()).map_err(|error| file.fail(error))?;
            file.finish()?;
        }
        for file in [self.observations, self.predictions].into_iter().flatten() {
            file.finish()?;
        }
        if let Some(mut file) = self.posterior {
            let name = file.path().display().to_string();
            run.document.write(&mut file).context(name)?;
            file.finish()?;
        }
        if let Some(mut file) = self.model {
            let name = file.path().display().to_string();
            let Some(snapshot) = replay.pipeline.snapshot() else {
                bail!("{name}: no interaction was seen: there is nothing to save");
            };
            replay.learned_bags.push(std::mem::take(&mut replay.hash).finish());
            write_model(&mut file, &replay.learned_bags, &snapshot.saved()).context(name)?;
            file.finish()?;
        }
        self.recording.map(Recording::finish).transpose()?;
        Ok(())
    }
}

/// A replay under way.
struct Replay {
    ingest: Ingest,
    config: Config,
    pipeline: Pipeline,
    root_is_given: bool,
    /// Of the loaded model: its name, and the bags that it knows.
    model_name: String,
    learned_bags: Vec<String>,
    hash: BagHash,
    seen: BTreeSet<Label>,
    /// Earliest and latest stamp.
    span: Option<(Stamp, Stamp)>,
    /// Of each window's learning, in order.
    inference_wall_s: Vec<f64>,
    /// For the report.
    gatherer: Option<Gatherer>,
    /// Lines for the table.
    remarks: Vec<String>,
}

impl Replay {
    fn new(arguments: &ReplayArguments, config: &Config) -> anyhow::Result<Self> {
        let mut settings = config.pipeline_settings(arguments.root_label.map(Label));
        settings.predict = arguments.predictions.is_some() || arguments.report.is_some() || arguments.record.is_some();
        // A report and a recording take everything as it comes.
        let at_once = arguments.report.is_some() || arguments.record.is_some();
        settings.may_lag = !at_once && rayon::current_num_threads() > 1;
        let mut root_is_given = arguments.root_label.is_some();
        let mut learned_bags = Vec::new();
        let pipeline = match &arguments.load_model {
            None => Pipeline::new(settings),
            Some(path) => {
                let SavedModel { bags, object } = SavedModel::from_file(path)?;
                let name = || path.display().to_string();
                refuse_known(&arguments.bag, &bags, &config.input).with_context(name)?;
                learned_bags = bags;
                root_is_given |= object.learner().root_is_given;
                Pipeline::resume(settings, object).with_context(name)?
            }
        };
        Ok(Self {
            ingest: Ingest::new(&config.input),
            config: config.clone(),
            pipeline: pipeline.timed_by(clock),
            root_is_given,
            model_name: arguments.load_model.as_ref().map(|path| path.display().to_string()).unwrap_or_default(),
            learned_bags,
            hash: BagHash::default(),
            seen: BTreeSet::new(),
            span: None,
            inference_wall_s: Vec::new(),
            gatherer: arguments.report.is_some().then(Gatherer::default),
            remarks: Vec::new(),
        })
    }

    /// Takes in every message of a bag, to its end.
    fn read(&mut self, bag: &mut Bag, outputs: &mut Outputs) -> anyhow::Result<()> {
        let progress = Progress::of_bytes(bag.summary().bytes);
        while let Some(message) = bag.next() {
            if outputs.model.is_some() {
                self.hash.add(&message, &self.config.input);
            }
            if let Some(recording) = &mut outputs.recording {
                recording.take(&message, &self.config.input)?;
            }
            let inputs = self.ingest.push(&message.topic.name, &message.topic.type_name, message.bytes());
            for input in inputs {
                self.push(input, outputs)?;
            }
            progress.at(bag.bytes_read());
            progress.say(format!("{} windows", self.inference_wall_s.len()));
        }
        for input in self.ingest.flush() {
            self.push(input, outputs)?;
        }
        let said = self.pipeline.finish();
        self.heard(&said, outputs)
    }

    fn push(&mut self, input: Input, files: &mut Outputs) -> anyhow::Result<()> {
        let stamp = input.stamp();
        let (first, last) = self.span.unwrap_or((stamp, stamp));
        self.span = Some((first.min(stamp), last.max(stamp)));
        if let (Some(gatherer), Input::Wrench(wrench)) = (&mut self.gatherer, &input) {
            gatherer.wrench(wrench);
        }
        let outputs = self.pipeline.push(input);
        self.heard(&outputs, files)
    }

    /// What a step of the pipeline said.
    fn heard(&mut self, outputs: &[Output], files: &mut Outputs) -> anyhow::Result<()> {
        if let Some(recording) = &mut files.recording {
            recording.say(outputs, &self.pipeline, self.ingest.counters())?;
        }
        outputs.iter().try_for_each(|output| self.take(output, files))
    }

    fn take(&mut self, output: &Output, files: &mut Outputs) -> anyhow::Result<()> {
        if let Some(gatherer) = &mut self.gatherer {
            gatherer.output(output);
        }
        match output {
            Output::Observation { time_s, label, measurement } => {
                self.seen.insert(*label);
                let row = Row {
                    time_s: *time_s,
                    horizon_s: None,
                    label: *label,
                    displacement: measurement.displacement,
                    std_m: center_std(&measurement.displacement, &measurement.information),
                };
                Outputs::write_row(&mut files.observations, &row)?;
            }
            Output::Prediction { time_s, horizon_s, label, displacement, covariance_m2 } => {
                let row = Row {
                    time_s: *time_s,
                    horizon_s: Some(*horizon_s),
                    label: *label,
                    displacement: *displacement,
                    std_m: covariance_m2.diagonal().map(|variance| variance.max(0.0).sqrt()),
                };
                Outputs::write_row(&mut files.predictions, &row)?;
            }
            // A replay learns in the stream.
            Output::FirstLook(_) | Output::WindowClosed(_) | Output::Tracked { .. } => {}
            Output::Learned { span_s, wall_s } => {
                self.inference_wall_s.push(*wall_s);
                tracing::info!(from_s = span_s.0, to_s = span_s.1, "window learned");
            }
            Output::Resumed { root, unexplained, unknown } => self.taken_up(*root, unexplained, unknown)?,
        }
        Ok(())
    }

    /// Whether the loaded model is of the object that is seen.
    fn taken_up(&mut self, root: Label, unexplained: &[Label], unknown: &[Label]) -> anyhow::Result<()> {
        let name = &self.model_name;
        if unexplained.contains(&root) || unknown.contains(&root) {
            bail!("{}", super::other_object(name, root));
        }
        let all = |labels: &[Label]| labels.iter().map(Label::to_string).collect::<Vec<_>>().join(", ");
        if !unexplained.is_empty() {
            self.remarks.push(format!("{name}: not where their joints could have them: parts {}", all(unexplained)));
        }
        if !unknown.is_empty() {
            self.remarks.push(format!("{name}: parts that the model does not have, added: {}", all(unknown)));
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
        // Those of a loaded model come first; what they took is not known any more.
        let loaded = posterior.windows.len().saturating_sub(self.inference_wall_s.len());
        for (window, wall_s) in posterior.windows.iter_mut().skip(loaded).zip(&self.inference_wall_s) {
            window.inference_wall_s = *wall_s;
        }
        Ok(PosteriorDocument::new(posterior, counters))
    }
}

/// Fails if a model has learned the bag.
fn refuse_known(path: &Path, learned: &[String], config: &InputConfig) -> anyhow::Result<()> {
    let hash = bag_hash(path, config)?;
    if learned.contains(&hash) {
        bail!("{}: the model has learned this bag already (content {})", path.display(), &hash[..12]);
    }
    Ok(())
}

/// The content hash of a bag.
pub fn bag_hash(path: &Path, config: &InputConfig) -> anyhow::Result<String> {
    let mut hash = BagHash::default();
    for message in Bag::open(path)? {
        hash.add(&message, config);
    }
    Ok(hash.finish())
}

fn why_nothing(counters: &Counters, ingest: &Ingest) -> String {
    let arrived = counters.clouds_in + counters.poses_in;
    match ingest.diagnostics().first() {
        Some(first) => format!("{arrived} arrived, the first dropped: {first}"),
        None => format!("{arrived} arrived"),
    }
}
