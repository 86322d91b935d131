//! The likeliest joint of every part, as the table and the report show it.

use std::collections::BTreeMap;

use crate::types::Label;
use crate::types::posterior::{EdgePosterior, JointTypeProbabilities, ObjectPosterior};

/// A type less likely than this is open: what never moved stays so.
const SETTLED: f64 = 0.9;

/// The edges by child, and which parts never moved.
pub struct Found<'a> {
    root: Label,
    by_child: BTreeMap<Label, Vec<&'a EdgePosterior>>,
    /// Parts whose joint type stayed open: they never moved.
    pub at_rest: Vec<Label>,
}

/// The joint that carries a part, as shown.
pub struct Joint<'a> {
    /// The likeliest edge.
    pub edge: &'a EdgePosterior,
    /// Of its parent, parts at rest taken together.
    pub probability: f64,
    /// Over all parents.
    pub types: JointTypeProbabilities,
}

impl<'a> Found<'a> {
    /// Of a posterior.
    pub fn new(posterior: &'a ObjectPosterior) -> Self {
        let mut by_child: BTreeMap<Label, Vec<&EdgePosterior>> = BTreeMap::new();
        for edge in &posterior.edges {
            by_child.entry(edge.child).or_default().push(edge);
        }
        let open = |edges: &Vec<&EdgePosterior>| types_over(edges).likeliest().1 <= SETTLED;
        let at_rest = by_child.iter().filter(|(_, edges)| open(edges)).map(|(label, _)| *label).collect();
        Self { root: posterior.root_label, by_child, at_rest }
    }

    /// The likeliest parent; the parts that never moved count as one with the root, which stands
    /// for them: which of them carries a joint is beyond the data.
    pub fn joint(&self, child: Label) -> Option<Joint<'a>> {
        let edges = self.by_child.get(&child)?;
        let rests = |label: Label| label == self.root || self.at_rest.contains(&label);
        let with_root: f64 = edges.iter().filter(|edge| rests(edge.parent)).map(|edge| edge.probability).sum();
        let likelier = |a: &&&EdgePosterior, b: &&&EdgePosterior| {
            a.probability.total_cmp(&b.probability).then(b.parent.cmp(&a.parent))
        };
        let moving = edges.iter().filter(|edge| !rests(edge.parent)).max_by(likelier);
        let types = types_over(edges);
        match moving {
            Some(edge) if edge.probability > with_root => Some(Joint { edge, probability: edge.probability, types }),
            _ => {
                let of_root = edges.iter().find(|edge| edge.parent == self.root);
                let edge = of_root.or_else(|| edges.iter().filter(|edge| rests(edge.parent)).max_by(likelier))?;
                Some(Joint { edge, probability: with_root, types })
            }
        }
    }
}

/// The types of a part's joint, over all its parents.
fn types_over(edges: &[&EdgePosterior]) -> JointTypeProbabilities {
    let total: f64 = edges.iter().map(|edge| edge.probability).sum();
    let mean = |of: fn(&JointTypeProbabilities) -> f64| {
        edges.iter().map(|edge| edge.probability * of(&edge.joint_type)).sum::<f64>() / total.max(f64::MIN_POSITIVE)
    };
    JointTypeProbabilities {
        rigid: mean(|t| t.rigid),
        prismatic: mean(|t| t.prismatic),
        revolute: mean(|t| t.revolute),
    }
}

impl Joint<'_> {
    /// The name of its type, unless that is open.
    pub fn settled(&self) -> Option<&'static str> {
        let (name, probability) = self.types.likeliest();
        (probability > SETTLED).then_some(name)
    }
}
