//! Robot description and markers, made beside the stream: hulls and meshes take their time.

use std::collections::{BTreeMap, BTreeSet};
use std::path::{Path, PathBuf};
use std::sync::Arc;
use std::sync::mpsc::{self, Receiver, Sender};

use anyhow::Context as _;
use ros2_interfaces_jazzy_serde::std_msgs::msg::String as Text;
use tracing::warn;

use super::learning::give_way;
use super::publications::{Outputs, Publication};
use crate::geometry::HullProperties;
use crate::io::output_file::OutputFile;
use crate::math::Pose;
use crate::ros::{FixedFrame, LinkTree, Picture, UrdfInput, markers, no_markers, urdf};
use crate::types::posterior::ObjectPosterior;
use crate::types::{Label, Stamp};

/// What a posterior says of the object's shape and joints.
#[derive(Debug)]
pub struct Model {
    /// The posterior.
    pub posterior: ObjectPosterior,
    /// Its likeliest tree.
    pub tree: LinkTree,
    /// Parts that float in it.
    pub floating: BTreeSet<Label>,
    /// Hulls of the parts, world at the first frame.
    pub hulls: BTreeMap<Label, HullProperties>,
    /// Least and greatest position of each joint seen \[m or rad\].
    pub ranges_seen: BTreeMap<Label, (f64, f64)>,
}

/// What is to be drawn.
#[derive(Clone, Debug)]
pub struct Scene {
    /// The object.
    pub model: Arc<Model>,
    /// Where its parts are.
    pub displacements: BTreeMap<Label, Pose>,
    /// The frame that all is in.
    pub frame: FixedFrame,
    /// When.
    pub stamp: Stamp,
}

/// Hands scenes to the thread that draws; where it is behind it draws the last.
#[derive(Clone, Debug)]
pub struct Drawing(Sender<Scene>);

impl Drawing {
    /// Starts the thread; it ends with the last that can hand it scenes. `meshes`: where they are written;
    /// without, parts are boxes.
    ///
    /// # Errors
    /// No thread.
    pub fn start(outputs: Outputs, meshes: Option<PathBuf>) -> anyhow::Result<Self> {
        let (sender, scenes) = mpsc::channel();
        std::thread::Builder::new()
            .name("drawing".into())
            .spawn(move || draw_all(&scenes, &outputs, meshes.as_deref()))
            .context("the thread that draws")?;
        Ok(Self(sender))
    }

    /// Draws a scene soon.
    pub fn draw(&self, scene: Scene) {
        // The thread outlives all that could hand it scenes.
        let _ = self.0.send(scene);
    }
}

fn draw_all(scenes: &Receiver<Scene>, outputs: &Outputs, meshes: Option<&Path>) {
    give_way();
    let mut described: Option<Arc<Model>> = None;
    while let Ok(first) = scenes.recv() {
        let scene = scenes.try_iter().last().unwrap_or(first);
        let Scene { model, displacements, frame, stamp } = &scene;
        if !described.as_ref().is_some_and(|described| Arc::ptr_eq(described, model)) {
            describe(model, frame, outputs, meshes);
            if described.is_none_or(|before| before.posterior.parts.len() > model.posterior.parts.len()) {
                outputs.send(Publication::Markers(no_markers(frame, *stamp)));
            }
            described = Some(Arc::clone(model));
        }
        let picture = Picture { tree: &model.tree, posterior: &model.posterior, hulls: &model.hulls, displacements };
        for message in markers(&picture, frame, *stamp) {
            outputs.send(Publication::Markers(message));
        }
    }
}

fn describe(model: &Model, frame: &FixedFrame, outputs: &Outputs, meshes: Option<&Path>) {
    let folder = meshes.and_then(Path::to_str);
    let input = UrdfInput {
        fixed_frame: &frame.name,
        hulls: &model.hulls,
        ranges_seen: &model.ranges_seen,
        mesh_folder: folder,
    };
    let description = match urdf(&model.tree, &model.posterior, &input) {
        Ok(description) => description,
        Err(error) => return warn!("robot_description: not sent: {error}"),
    };
    if let Some(folder) = meshes {
        for (name, content) in &description.meshes {
            if let Err(error) = write_mesh(&folder.join(name), content) {
                warn!("robot_description: {error:#}");
            }
        }
    }
    outputs.send(Publication::Description(Text { data: description.text }));
}

fn write_mesh(path: &Path, content: &[u8]) -> anyhow::Result<()> {
    use std::io::Write as _;
    let mut file = OutputFile::create(path)?;
    file.write_all(content).with_context(|| path.display().to_string())?;
    file.finish()?;
    Ok(())
}
