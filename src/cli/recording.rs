//! `--record`: the messages that were read and what a node would have said of them, as a bag that appears
//! when it is complete.

use std::collections::BTreeMap;
use std::path::{Path, PathBuf};

use anyhow::Context;
use bayesian_object_models::{
    io::{
        bag::{BagMessage, Recorder},
        config::InputConfig,
        counters::Counters,
        topics::Role,
    },
    math::Pose,
    node::publications::topics,
    pipeline::{Output, Pipeline},
    ros::{
        self, FixedFrame, FutureWrench, LinkTree, PartPrediction, UrdfInput, joint_states, place_joints,
        predicted_part_poses, urdf,
    },
    types::{Label, Stamp},
};
use nalgebra::{Vector3, Vector6};
use ros2_interfaces_jazzy_serde::std_msgs::msg::String as Text;
use serde::Serialize;
use tempfile::TempDir;

/// A bag being written.
pub struct Recording {
    path: PathBuf,
    folder: TempDir,
    recorder: Recorder,
    fixed_frame: String,
    /// When the last message was logged \[ns\].
    log_ns: u64,
    /// The tree last said, with the parts' centres of mass \[m\].
    tree: LinkTree,
    centers: BTreeMap<Label, Vector3<f64>>,
    /// Joint positions, to count turns.
    positions: BTreeMap<Label, f64>,
}

impl Recording {
    /// Opens it, aside; all is said in `fixed_frame`.
    pub fn create(path: &Path, fixed_frame: &str) -> anyhow::Result<Self> {
        let beside = match path.parent() {
            Some(folder) if !folder.as_os_str().is_empty() => folder,
            _ => Path::new("."),
        };
        let folder = tempfile::Builder::new().prefix(".bom-").tempdir_in(beside);
        let folder = folder.with_context(|| path.display().to_string())?;
        let recorder = Recorder::create(&folder.path().join("recording.mcap"))?;
        Ok(Self {
            path: path.to_owned(),
            folder,
            recorder,
            fixed_frame: fixed_frame.to_owned(),
            log_ns: 0,
            tree: LinkTree::default(),
            centers: BTreeMap::new(),
            positions: BTreeMap::new(),
        })
    }

    /// Writes a message as it came, if its topic is read.
    pub fn take(&mut self, message: &BagMessage, config: &InputConfig) -> anyhow::Result<()> {
        let (name, type_name) = (&message.topic.name, &message.topic.type_name);
        self.log_ns = message.log_time_ns;
        if Role::of(name, config).is_some() {
            self.recorder.bytes(name, type_name, self.log_ns, message.bytes())?;
        }
        Ok(())
    }

    /// Writes what a node would have published of what the pipeline says; parts do not float.
    pub fn say(&mut self, outputs: &[Output], pipeline: &Pipeline, counters: &Counters) -> anyhow::Result<()> {
        let Some(zero) = pipeline.zero() else { return Ok(()) };
        let frame = FixedFrame { name: self.fixed_frame.clone(), zero };
        let mut predicted: BTreeMap<Stamp, Vec<PartPrediction>> = BTreeMap::new();
        let mut tracked: BTreeMap<Stamp, (BTreeMap<Label, Pose>, BTreeMap<Label, Vector6<f64>>)> = BTreeMap::new();
        for output in outputs {
            match *output {
                Output::Learned { span_s: (_, end_s), .. } => {
                    self.say_posterior(pipeline, counters, &frame, zero.plus_seconds(end_s))?;
                }
                Output::Tracked { time_s, label, displacement, twist } => {
                    let (places, twists) = tracked.entry(zero.plus_seconds(time_s)).or_default();
                    places.insert(label, displacement);
                    twists.insert(label, twist);
                }
                Output::Prediction { time_s, label, .. } => {
                    if self.centers.is_empty() {
                        self.say_posterior(pipeline, counters, &frame, zero.plus_seconds(time_s))?;
                    }
                    let Some(center_in_world) = self.centers.get(&label).copied() else { continue };
                    let prediction = PartPrediction::of(output, center_in_world);
                    predicted.entry(zero.plus_seconds(time_s)).or_default().extend(prediction);
                }
                _ => {}
            }
        }
        for (stamp, (places, twists)) in tracked {
            self.positions = self.tree.positions(&places, &self.positions);
            let rates = self.tree.rates(&twists);
            let states = joint_states(&self.tree, &self.positions, &rates, &frame, stamp);
            self.publish(topics::JOINT_STATES, &states)?;
        }
        for (stamp, mut predictions) in predicted {
            place_joints(&self.tree, &mut predictions);
            let message = predicted_part_poses(&predictions, FutureWrench::Planned, &frame, stamp)?;
            self.publish(topics::PREDICTED_POSES, &message)?;
        }
        Ok(())
    }

    fn say_posterior(
        &mut self,
        pipeline: &Pipeline,
        counters: &Counters,
        frame: &FixedFrame,
        stamp: Stamp,
    ) -> anyhow::Result<()> {
        let Some(posterior) = pipeline.posterior() else { return Ok(()) };
        self.publish(topics::OBJECT_POSTERIOR, &ros::object_posterior(&posterior, counters, frame, stamp)?)?;
        let criticism = ros::criticism(&posterior.criticism, posterior.windows.len(), frame, stamp)?;
        self.publish(topics::CRITICISM, &criticism)?;
        self.tree = LinkTree::likeliest(&posterior);
        self.centers = posterior.parts.iter().map(|part| (part.label, part.com_in_world_m.into())).collect();
        let (hulls, ranges_seen) = (pipeline.hulls(), pipeline.ranges_seen());
        let fixed_frame = &frame.name;
        let input = UrdfInput { fixed_frame, hulls: &hulls, ranges_seen: &ranges_seen, mesh_folder: None };
        let description = urdf(&self.tree, &posterior, &input)?;
        self.publish(topics::ROBOT_DESCRIPTION, &Text { data: description.text })
    }

    fn publish<M: Serialize>(&mut self, (name, type_name): (&str, &str), message: &M) -> anyhow::Result<()> {
        let topic = format!("/{}/{}", bayesian_object_models::node::NAME, name.trim_start_matches("~/"));
        Ok(self.recorder.message(&topic, type_name, self.log_ns, message)?)
    }

    /// Completes it.
    pub fn finish(self) -> anyhow::Result<()> {
        self.recorder.finish()?;
        let written = self.folder.path().join("recording.mcap");
        std::fs::rename(written, &self.path).with_context(|| self.path.display().to_string())
    }
}
