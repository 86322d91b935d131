//! Effects as they are published: probabilities within a class, parameters with their spread.

use std::collections::BTreeMap;

use super::numbers::{Addition, places};
use super::score::ForceLeft;
use super::selection::Selection;
use crate::mechanism::JointType;
use crate::mechanism::effects::{Dimension, EffectKind, Prior, TableKind};
use crate::model::{DynamicsLearner, Hypothesis, KinematicFit, KinematicJoint};
use crate::types::posterior::{EffectPosterior, InformedBy, Quantity};

/// Relative error that a law keeps however long it is watched, as the declared parameters do.
const MODEL_FLOOR: f64 = 0.012;
/// A rival at least this probable is named.
const NAMED: f64 = 0.05;

/// The effects of a selection that the learner has taken over, likeliest first.
pub fn effects(
    learner: &DynamicsLearner,
    hypothesis: &Hypothesis,
    selection: &Selection,
    fit: &KinematicFit,
) -> Vec<EffectPosterior> {
    let mut found: Vec<(f64, EffectPosterior)> = Vec::new();
    for addition in selection.additions.iter().filter(|a| !a.is_stop()) {
        let rivals = selection.rivals.get(addition).map_or(&[][..], Vec::as_slice);
        let total: f64 = 1.0 + rivals.iter().map(|(_, difference)| difference.exp()).sum::<f64>();
        let likely = rivals.iter().filter(|(_, difference)| difference.exp() / total > NAMED);
        let mut same: Vec<String> = likely.filter_map(|(rival, _)| Some(rival.as_ref()?.name().to_owned())).collect();
        let mut probability = 1.0 / total;
        for name in class_of(*addition, fit) {
            probability = probability.min(0.5);
            same.push((*name).to_owned());
        }
        same.retain(|name| name != addition.name());
        same.sort();
        same.dedup();
        let gain = rivals.iter().find(|(rival, _)| rival.is_none()).map_or(0.0, |(_, difference)| -difference);
        let effect = EffectPosterior {
            name: addition.name().to_owned(),
            label: addition.joint().map(|joint| fit.joints[joint].child),
            probability,
            indistinguishable_from: same,
            parameters: parameters(learner, hypothesis, *addition, fit),
        };
        found.push((gain, effect));
    }
    // By how much each is needed: probabilities near one do not tell them apart.
    found.sort_by(|a, b| b.0.total_cmp(&a.0));
    let mut effects: Vec<EffectPosterior> = found.into_iter().map(|(_, effect)| effect).collect();
    effects.sort_by_key(|effect| std::cmp::Reverse(effect.probability > 0.3));
    effects
}

/// That something acts on a joint which noise or a friction of every window's own stands in for: none of 180 plain
/// objects of `examples/criticism_benchmark.rs` was called so.
const UNKNOWN: f64 = 0.95;

/// What acts on a joint and has no name, by the force that is left of its windows over time.
pub fn unknown(joint: &KinematicJoint, left: &[ForceLeft]) -> EffectPosterior {
    let unit = Dimension::Force.unit(joint.joint_type);
    let entry = |window: &ForceLeft| {
        let force = Quantity::from_normal(unit, window.mean, window.deviation, InformedBy::Dynamics);
        (format!("force_at_t_{:.4}", window.time_s), force)
    };
    EffectPosterior {
        name: "unknown".to_owned(),
        label: Some(joint.child),
        probability: UNKNOWN,
        indistinguishable_from: Vec::new(),
        parameters: left.iter().map(entry).collect(),
    }
}

/// What no data of this kind can tell apart (CONTRACT.md, Effects).
fn class_of(addition: Addition, fit: &KinematicFit) -> &'static [&'static str] {
    match addition {
        Addition::Effect(_, EffectKind::GravityOffset) => &["asymmetric_friction"],
        Addition::Effect(_, EffectKind::AsymmetricFriction) => &["gravity_offset"],
        Addition::Effect(joint, EffectKind::SelfClosing | EffectKind::PositionFriction) if only_opens(fit, joint) => {
            &["self_closing", "position_friction"]
        }
        _ => &[],
    }
}

/// Whether a joint went one way only.
fn only_opens(fit: &KinematicFit, joint: usize) -> bool {
    let (mut up, mut down) = (0.0, 0.0);
    for step in fit.positions.iter().flat_map(|window| window[joint].windows(2)) {
        let change = step[1] - step[0];
        if change > 0.0 { up += change } else { down -= change }
    }
    f64::min(up, down) < 0.05 * f64::max(up, down)
}

fn parameters(
    learner: &DynamicsLearner,
    hypothesis: &Hypothesis,
    addition: Addition,
    fit: &KinematicFit,
) -> BTreeMap<String, Quantity> {
    let places = places(hypothesis, addition);
    let Ok((mean, covariance)) = learner.moments_of(&places) else { return BTreeMap::new() };
    let mut all = BTreeMap::new();
    let joint_type = addition.joint().map_or(JointType::Prismatic, |joint| fit.joints[joint].joint_type);
    let informed = |deviation: f64| if deviation < 0.7 { InformedBy::Dynamics } else { InformedBy::Prior };
    let deviation = |k: usize| covariance[(k, k)].max(0.0).sqrt();
    match addition {
        Addition::Stop(..) => {}
        Addition::Friction(_) => {
            let unit = Dimension::Force.unit(joint_type);
            let quantity =
                Quantity::from_log_normal(unit, mean[0], deviation(0).hypot(MODEL_FLOOR), informed(deviation(0)));
            all.insert("friction".to_owned(), quantity);
        }
        Addition::Effect(joint, kind) => {
            let effects = &hypothesis.mechanism.joints[joint].effects;
            let Some(effect) = effects.iter().rfind(|effect| effect.kind == kind) else { return all };
            for (k, parameter) in kind.parameters().iter().enumerate() {
                let unit = parameter.dimension.unit(joint_type);
                let scale = parameter.dimension.scale(&effect.scales);
                let quantity = match parameter.prior {
                    Prior::LogNormal { median, log_sd } => Quantity::from_log_normal(
                        unit,
                        (median * scale).ln() + log_sd * mean[k],
                        (log_sd * deviation(k)).hypot(MODEL_FLOOR),
                        informed(deviation(k)),
                    ),
                    Prior::Normal { mean: centre, sd } => {
                        let value = (centre + sd * mean[k]) * scale;
                        let spread = (sd * deviation(k) * scale).hypot(MODEL_FLOOR * value);
                        Quantity::from_normal(unit, value, spread, informed(deviation(k)))
                    }
                };
                all.insert(parameter.name.to_owned(), quantity);
            }
        }
        Addition::Table(joint, kind) => {
            let tables = &hypothesis.mechanism.joints[joint].tables;
            let Some(table) = tables.iter().find(|table| table.kind == kind) else { return all };
            let what = match kind {
                TableKind::FrictionOverPosition | TableKind::FrictionOverTime => "friction",
                TableKind::InertiaOverPosition => "inertia",
                TableKind::ClosingDamping => "damping",
                _ => "force",
            };
            let over = match kind.argument() {
                Dimension::Rate => "v",
                Dimension::Time => "t",
                _ => "x",
            };
            // An inertia of one force unit per rate and second is a kilogram.
            let unit = kind.entry().unit(joint_type);
            let turned = table.reversed && over != "t";
            for (k, node) in table.nodes.iter().enumerate() {
                let sign = if turned && what == "force" { -1.0 } else { 1.0 };
                let node = if turned { -node } else { *node };
                let quantity = Quantity::from_normal(
                    unit,
                    sign * mean[k] * table.scale,
                    deviation(k) * table.scale,
                    informed(deviation(k)),
                );
                all.insert(format!("{what}_at_{over}_{node:.4}"), quantity);
            }
        }
        Addition::Bias | Addition::Delay => {
            let [force, torque, delay] = hypothesis.mechanism.sensor.scales;
            let names = ["force_x", "force_y", "force_z", "torque_x", "torque_y", "torque_z"];
            for k in 0..mean.len() {
                let (name, unit, scale) = match addition {
                    Addition::Delay => ("delay", "s", delay),
                    _ if k < 3 => (names[k], "N", force),
                    _ => (names[k], "N·m", torque),
                };
                let quantity =
                    Quantity::from_normal(unit, mean[k] * scale, deviation(k) * scale, informed(deviation(k)));
                all.insert(name.to_owned(), quantity);
            }
        }
    }
    all
}
