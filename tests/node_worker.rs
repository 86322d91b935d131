//! Learning beside the stream: a worker that keeps up gives what a replay gives, one that lags behind
//! gives the same posterior later.
#![allow(clippy::unwrap_used)]

use std::collections::{BTreeSet, VecDeque};
use std::path::Path;

use bayesian_object_models::{
    io::{bag::Bag, config::Config, ingest::Ingest},
    pipeline::{ClosedWindow, Output, Pipeline, Worker},
    types::{Input, Label, Stamp, posterior::ObjectPosterior},
};

/// The chain's first inputs, with a few windows in them.
fn inputs() -> Vec<Input> {
    let path = Path::new(env!("CARGO_MANIFEST_DIR")).join("bags/chain/chain.mcap");
    let bag = Bag::open(&path).unwrap();
    let mut ingest = Ingest::new(&Config::default().input);
    let mut inputs = Vec::new();
    for message in bag {
        inputs.extend(ingest.push(&message.topic.name, &message.topic.type_name, message.bytes()));
    }
    let first = inputs.iter().map(Input::stamp).min().unwrap();
    inputs.retain(|input| input.stamp().seconds_since(first) < 12.0);
    inputs
}

fn pipeline(live: bool) -> Pipeline {
    let mut settings = Config::default().pipeline_settings(None);
    settings.live = live;
    settings.predict = live;
    Pipeline::new(settings)
}

/// A live run.
struct Live {
    posterior: ObjectPosterior,
    /// When predictions were made \[s\].
    predicted: Vec<f64>,
    /// The last frames of the windows, from time zero on \[s\].
    ends: Vec<f64>,
    zero: Stamp,
}

/// A live run whose worker returns every window `lag` inputs after it closed.
fn live(lag: usize) -> Live {
    let (mut pipeline, mut worker) = (pipeline(true), Worker::default());
    let mut waiting: VecDeque<(usize, Box<ClosedWindow>)> = VecDeque::new();
    let (mut predicted, mut ends, mut learned) = (Vec::new(), Vec::new(), None);
    // Told twice: before physics are reviewed and after.
    let mut learn = |window: ClosedWindow, pipeline: &mut Pipeline| {
        let (mut first, count) = (None, pipeline.posterior().map_or(0, |posterior| posterior.windows.len()));
        let result = worker.learn(window, |learned| first = Some(learned));
        let first = first.expect("what is known before the review");
        pipeline.adopt(&first);
        assert_eq!(first.posterior.windows.len(), count + 1);
        pipeline.adopt(&result);
        learned = Some(result.posterior);
    };
    let mut take = |outputs: Vec<Output>, waiting: &mut VecDeque<_>, at: usize| {
        for output in outputs {
            match output {
                Output::WindowClosed(window) => {
                    ends.push(window.span_s().1);
                    waiting.push_back((at + lag, window));
                }
                Output::Prediction { time_s, .. } => predicted.push(time_s),
                _ => {}
            }
        }
    };
    for (at, input) in inputs().into_iter().enumerate() {
        take(pipeline.push(input), &mut waiting, at);
        while let Some((_, window)) = waiting.pop_front_if(|(due, _)| *due <= at) {
            learn(*window, &mut pipeline);
        }
    }
    take(pipeline.finish(), &mut waiting, 0);
    for (_, window) in waiting {
        learn(*window, &mut pipeline);
    }
    let posterior = pipeline.posterior().unwrap();
    assert_eq!(learned.unwrap(), posterior, "what the worker says is what the pipeline adopted");
    Live { posterior, predicted, ends, zero: pipeline.zero().unwrap() }
}

fn replayed(mut replay: Pipeline) -> ObjectPosterior {
    for input in inputs() {
        replay.push(input);
    }
    replay.finish();
    replay.posterior().unwrap()
}

#[test]
fn a_worker_learns_what_a_replay_learns() {
    let replayed = replayed(pipeline(false));
    assert!(replayed.windows.len() >= 2, "{}", replayed.windows.len());
    let prompt = live(0);
    assert_eq!(prompt.posterior, replayed);
    let mut stamps = prompt.predicted.clone();
    stamps.sort_by(f64::total_cmp);
    assert_eq!(stamps, prompt.predicted, "predictions come with their cloud, in order");
    let late = live(400).posterior;
    let joints = |posterior: &ObjectPosterior| -> Vec<(Label, Label, &'static str)> {
        let likely = posterior.edges.iter().filter(|edge| edge.probability > 0.5);
        likely.map(|edge| (edge.child, edge.parent, edge.joint_type.likeliest().0)).collect()
    };
    assert_eq!(late.windows.len(), replayed.windows.len());
    assert_eq!(joints(&late), joints(&replayed));
}

#[test]
fn a_replay_that_knows_where_a_lagging_run_ended_its_windows_learns_the_same() {
    let late = live(400);
    let ends: BTreeSet<Stamp> = late.ends.iter().map(|end_s| late.zero.plus_seconds(*end_s)).collect();
    assert_eq!(replayed(pipeline(false).with_window_ends(Some(ends.clone()))), late.posterior);
    // It ends them there and nowhere else: each two frames later, as of a run that saw something move for longer.
    let shift = |stamp: &Stamp| stamp.plus_seconds(0.2);
    let later = replayed(pipeline(false).with_window_ends(Some(ends.iter().map(shift).collect())));
    let spans = |posterior: &ObjectPosterior| posterior.windows.iter().map(|w| w.t1_s).collect::<Vec<f64>>();
    // The last ends with the stream.
    let last = late.posterior.windows.len() - 1;
    assert!(last >= 1);
    for (end, before) in spans(&later).into_iter().zip(spans(&late.posterior)).take(last) {
        assert!((end - before - 0.2).abs() < 1e-6, "{end} {before}");
    }
}
