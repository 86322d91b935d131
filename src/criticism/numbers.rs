//! Models of the physics as sets of additions to the declared one, and their numbers by name.

use std::collections::{BTreeMap, BTreeSet};

use serde::{Deserialize, Serialize};

use crate::inference::{Failure, Gaussian};
use crate::mechanism::effects::{EffectKind, TableKind};
use crate::model::{
    AddedTable, DynamicsInput, DynamicsLearner, FRICTION, Hypothesis, JointScales, KinematicFit, LIMIT_DEVIATION,
    LOWER, SENSOR_SIZE, SIZE, UPPER,
};
use crate::types::pairs;

/// One effect beyond the declared model; joints by index in the fit.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Serialize, Deserialize)]
pub enum Addition {
    /// An end stop, lower or upper: part of the base, once it is reached.
    Stop(usize, bool),
    /// Coulomb friction, where it was not declared.
    Friction(usize),
    /// A named effect.
    Effect(usize, EffectKind),
    /// What has no name.
    Table(usize, TableKind),
    /// A constant in the sensor's readings.
    Bias,
    /// The sensor's reports act at another time.
    Delay,
}

impl Addition {
    /// The joint that it acts on; none for the sensor's.
    pub fn joint(self) -> Option<usize> {
        match self {
            Self::Stop(joint, _) | Self::Friction(joint) | Self::Effect(joint, _) | Self::Table(joint, _) => {
                Some(joint)
            }
            Self::Bias | Self::Delay => None,
        }
    }

    /// Whether it is an end stop, which is no effect.
    pub fn is_stop(&self) -> bool {
        matches!(self, Self::Stop(..))
    }

    /// The name used in files.
    pub fn name(self) -> &'static str {
        match self {
            Self::Stop(..) => "stop",
            Self::Friction(_) => "friction",
            Self::Effect(_, kind) => kind.name(),
            Self::Table(_, TableKind::FrictionOverPosition) => "position_friction",
            Self::Table(..) => "unknown",
            Self::Bias => "wrench_bias",
            Self::Delay => "wrench_delay",
        }
    }
}

/// All numbers of a model by what they are about: they outlive changes of the layout.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct Numbers {
    /// The declared numbers of each joint.
    pub joints: Vec<Vec<f64>>,
    /// The sensor's.
    pub sensor: Vec<f64>,
    /// Those of additions.
    #[serde(with = "pairs")]
    pub added: BTreeMap<Addition, Vec<f64>>,
}

/// What models are made from.
pub struct Workshop<'a> {
    /// The learner with the declared physics.
    pub learner: &'a DynamicsLearner,
    /// The kinematic fit of all windows.
    pub fit: &'a KinematicFit,
    /// All windows.
    pub input: &'a DynamicsInput<'a>,
    /// Of the sensor's numbers if it has a bias, by what it read at rest.
    pub rest_prior: Option<Gaussian>,
    /// Scales of the sensor's errors.
    pub sensor_scales: [f64; 3],
    /// Beginning and end of each window \[s\].
    pub spans: Vec<[f64; 2]>,
}

impl Workshop<'_> {
    /// The end stops that the learner believes.
    pub fn stops(&self) -> BTreeSet<Addition> {
        self.learner.stops().into_iter().map(|(joint, upper)| Addition::Stop(joint, upper)).collect()
    }

    /// The hypothesis that has `additions`, and no more.
    pub fn hypothesis(&self, additions: &BTreeSet<Addition>) -> Result<Hypothesis, Failure> {
        let mut mechanism = self.learner.declared_mechanism();
        mechanism.sensor.scales = self.sensor_scales;
        for addition in additions {
            match *addition {
                Addition::Stop(joint, upper) => mechanism.joints[joint].stops[usize::from(upper)] = true,
                Addition::Friction(joint) => mechanism.joints[joint].friction = true,
                Addition::Effect(joint, kind) => {
                    // What is in the learner's model keeps its scales, and so its numbers their meaning.
                    let declared = mechanism.joints[joint].effects.len();
                    let adopted = &self.learner.mechanism().joints[joint].effects;
                    let adopted = adopted.iter().skip(declared).find(|effect| effect.kind == kind).copied();
                    let mut effect = adopted
                        .or_else(|| self.learner.effect_on(joint, kind, self.fit))
                        .ok_or(Failure::NoInformation)?;
                    if adopted.is_none() {
                        effect.scales.duration_s = self.duration_s();
                    }
                    mechanism.joints[joint].effects.push(effect);
                }
                Addition::Table(joint, kind) => {
                    let scales = self.learner.joint_scales(joint, self.fit).ok_or(Failure::NoInformation)?;
                    mechanism.joints[joint].tables.push(self.table(kind, joint, &scales));
                }
                Addition::Bias => mechanism.sensor.bias = true,
                Addition::Delay => mechanism.sensor.delay = true,
            }
        }
        let biased = additions.contains(&Addition::Bias);
        let mut hypothesis = self.learner.hypothesis(mechanism, self.rest_prior.as_ref().filter(|_| biased))?;
        // Those that the learner believes have their prior.
        for addition in additions.difference(&self.stops()) {
            if let Addition::Stop(joint, upper) = *addition {
                let (low, high) = self.range(joint);
                let end = if upper { high } else { low };
                for place in places(&hypothesis, *addition) {
                    hypothesis.prior.precision[(place, place)] = LIMIT_DEVIATION.powi(-2);
                    hypothesis.prior.information[place] = end * LIMIT_DEVIATION.powi(-2);
                }
            }
        }
        Ok(hypothesis)
    }

    /// From time zero to the end of the last window \[s\].
    pub fn duration_s(&self) -> f64 {
        self.spans.last().map_or(1.0, |span| span[1].max(1.0))
    }

    /// A table that describes what has no name.
    fn table(&self, kind: TableKind, joint: usize, scales: &JointScales) -> AddedTable {
        let travel = scales.travel.abs();
        let (low, high) = self.range(joint);
        let even = |low: f64, high: f64, count: usize| -> Vec<f64> {
            (0..count).map(|i| low + (high - low) * i as f64 / (count - 1) as f64).collect()
        };
        let (nodes, correlation) = match kind {
            TableKind::ForceOverRate => (even(-1.5 * scales.rate, 1.5 * scales.rate, 9), scales.rate),
            TableKind::ForceOverTime | TableKind::FrictionOverTime => {
                let mut nodes: Vec<f64> = Vec::new();
                for [from, to] in &self.spans {
                    // Windows may touch.
                    let from = nodes.last().map_or(*from, |last| from.max(last + 1e-3));
                    let to = to.max(from + 0.1);
                    match kind {
                        TableKind::ForceOverTime => nodes.extend(even(from, to, 12)),
                        // What acts in a whole window is one number.
                        _ => nodes.push(0.5 * (from + to)),
                    }
                }
                (nodes, if kind == TableKind::ForceOverTime { 0.5 } else { 10.0 })
            }
            _ => (even(low, high, 13), 0.3 * travel),
        };
        let scale = match kind {
            TableKind::InertiaOverPosition => 0.2 * scales.force / scales.rate,
            TableKind::ClosingDamping => 0.3 * scales.force / scales.rate,
            _ => 0.3 * scales.force,
        };
        AddedTable { kind, nodes, scale, correlation, reversed: scales.travel < 0.0 }
    }

    /// The least and the greatest position of a joint \[m or rad\].
    pub fn range(&self, joint: usize) -> (f64, f64) {
        self.learner.range_of(joint, self.fit)
    }
}

/// Where the numbers of an addition are.
pub fn places(hypothesis: &Hypothesis, addition: Addition) -> Vec<usize> {
    let mechanism = &hypothesis.mechanism;
    let sensor = mechanism.size() - SENSOR_SIZE;
    match addition {
        Addition::Friction(joint) => vec![mechanism.offset(joint) + FRICTION],
        Addition::Stop(joint, upper) => vec![mechanism.offset(joint) + if upper { UPPER } else { LOWER }],
        Addition::Effect(joint, kind) => {
            let model = &mechanism.joints[joint];
            // Declared effects come first: the last of a kind is the added one.
            let Some(index) = model.effects.iter().rposition(|effect| effect.kind == kind) else { return Vec::new() };
            let first = mechanism.offset(joint) + model.effect_offset(index);
            (first..first + kind.parameters().len()).collect()
        }
        Addition::Table(joint, kind) => {
            let model = &mechanism.joints[joint];
            let Some(index) = model.tables.iter().position(|table| table.kind == kind) else { return Vec::new() };
            let first = mechanism.offset(joint) + model.table_offset(index);
            (first..first + model.tables[index].nodes.len()).collect()
        }
        Addition::Bias => (sensor..sensor + 6).collect(),
        Addition::Delay => vec![sensor + 6],
    }
}

/// How many numbers of a joint are declared, those of declared effects among them: they come before what is added.
fn declared_size(hypothesis: &Hypothesis, additions: &BTreeSet<Addition>, joint: usize) -> usize {
    let model = &hypothesis.mechanism.joints[joint];
    let added = additions.iter().filter(|a| matches!(a, Addition::Effect(other, _) if *other == joint)).count();
    model.effect_offset(model.effects.len().saturating_sub(added))
}

impl Numbers {
    /// The numbers in the layout of a hypothesis; what is not known is at its prior mean.
    pub fn laid_out(&self, hypothesis: &Hypothesis, additions: &BTreeSet<Addition>) -> Vec<f64> {
        let mechanism = &hypothesis.mechanism;
        let mut x = vec![0.0; mechanism.size()];
        if let Ok((mean, _)) = hypothesis.prior.moments() {
            x.copy_from_slice(mean.as_slice());
        }
        for (joint, own) in self.joints.iter().enumerate() {
            let offset = mechanism.offset(joint);
            let size = declared_size(hypothesis, additions, joint).min(own.len());
            x[offset..offset + size].copy_from_slice(&own[..size]);
        }
        for addition in additions {
            let known = self.added.get(addition);
            for (k, place) in places(hypothesis, *addition).into_iter().enumerate() {
                if let Some(value) = known.and_then(|values| values.get(k)) {
                    x[place] = *value;
                }
            }
        }
        x
    }

    /// Takes over the numbers of some joints, of the additions to them, and of the sensor's.
    pub fn take(&mut self, hypothesis: &Hypothesis, additions: &BTreeSet<Addition>, x: &[f64], joints: &[usize]) {
        self.joints.resize_with(hypothesis.mechanism.joints.len(), Vec::new);
        for joint in 0..self.joints.len() {
            if !joints.contains(&joint) && self.joints[joint].len() >= SIZE {
                continue;
            }
            let offset = hypothesis.mechanism.offset(joint);
            self.joints[joint] = x[offset..offset + declared_size(hypothesis, additions, joint)].to_vec();
        }
        for addition in additions.iter().filter(|a| a.joint().is_none_or(|joint| joints.contains(&joint))) {
            let values = places(hypothesis, *addition).into_iter().map(|place| x[place]).collect();
            self.added.insert(*addition, values);
        }
    }
}
