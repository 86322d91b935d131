//! What the residual of a model looks like: its regression on the signature of every effect.
//!
//! A small force δf anywhere along the way changes the whitened innovations by J δf. With J of many
//! narrow tables (over position, rate, time, of forces, friction, damping, inertia) the signature of
//! any law is a combination of columns, and amplitudes a of signatures Φ that best explain the
//! residual are (Φᵀ H Φ)⁻¹ Φᵀ g, for a gain of ½ gᵀ Φ (Φᵀ H Φ)⁻¹ Φᵀ g nats; H and g are the normal
//! equations with the model's own numbers eliminated: a score test.

use std::collections::BTreeSet;

use nalgebra::{DMatrix, DVector};
use rayon::prelude::*;

use super::numbers::{Addition, Workshop};
use crate::inference::Failure;
use crate::mechanism::effects::{EffectKind, Scales, TableKind};
use crate::model::{AddedTable, BatchFit, BatchWindow, Hypothesis, JointScales, SENSOR_SIZE, SIZE, carriers};

/// Spacing of nodes over time \[s\].
const TIME_SPACING: f64 = 0.15;

/// A candidate by its signature.
#[derive(Clone, Debug)]
pub struct Ranked {
    /// The effect.
    pub addition: Addition,
    /// What it would gain at first order \[nats\].
    pub gain: f64,
    /// Its numbers to start a fit from.
    pub start: Vec<f64>,
    /// What comes with it, with the numbers to start from: friction on other joints, where it is declared on
    /// none.
    pub also: Vec<(Addition, Vec<f64>)>,
}

/// Normal equations of probes on one joint, or of the sensor's errors, the model eliminated.
pub struct Probes {
    /// The joint; none for the sensor's.
    joint: Option<usize>,
    /// Whether it moves while one that carries it does.
    carried: bool,
    scales: JointScales,
    duration_s: f64,
    tables: Vec<(TableKind, Vec<f64>, usize)>,
    hessian: DMatrix<f64>,
    gradient: DVector<f64>,
}

/// The probes of a joint and of the sensor at a fitted model.
pub fn probes(
    workshop: &Workshop<'_>,
    hypothesis: &Hypothesis,
    fitted: &BatchFit,
    windows: &[&BatchWindow],
    joint: usize,
) -> Result<[Probes; 2], Failure> {
    let scales = workshop.learner.joint_scales(joint, workshop.fit).ok_or(Failure::NoInformation)?;
    let mut probed = hypothesis.clone();
    probed.mechanism.sensor.bias = true;
    probed.mechanism.sensor.delay = true;
    let own = hypothesis.mechanism.joints[joint].tables.len();
    let force = scales.force;
    let plans = plans(workshop, &scales, joint, windows);
    for (kind, nodes, scale) in plans {
        let table = AddedTable { kind, nodes, scale: scale * force, correlation: 1.0, reversed: scales.travel < 0.0 };
        probed.mechanism.joints[joint].tables.push(table);
    }
    let mechanism = &probed.mechanism;
    let before = hypothesis.mechanism.offset(joint) + hypothesis.mechanism.joints[joint].size();
    let added = mechanism.size() - hypothesis.mechanism.size();
    let shifted = |i: usize| if i >= before { i + added } else { i };
    let mut x = vec![0.0; mechanism.size()];
    for (i, value) in fitted.x.iter().enumerate() {
        x[shifted(i)] = *value;
    }
    // Numbers of the model, then the probes, then the sensor's.
    let model: Vec<usize> = fitted.active.iter().map(|&i| shifted(i)).collect();
    let sensor = mechanism.size() - SENSOR_SIZE;
    let extra: Vec<usize> =
        (before..before + added).chain(sensor..sensor + SENSOR_SIZE).filter(|i| !model.contains(i)).collect();
    let all: Vec<usize> = model.iter().chain(&extra).copied().collect();
    let model_of = &mechanism.joints[joint];
    let time_nodes: Vec<(usize, f64)> = (own..model_of.tables.len())
        .filter(|t| matches!(model_of.tables[*t].kind, TableKind::ForceOverTime | TableKind::FrictionOverTime))
        .flat_map(|t| {
            let first = mechanism.offset(joint) + model_of.table_offset(t);
            model_of.tables[t].nodes.iter().enumerate().map(move |(k, node)| (first + k, *node)).collect::<Vec<_>>()
        })
        .collect();
    let one = |w: usize| {
        let window = windows[w];
        let mut active = fitted.windows[w].active.iter().map(|&i| shifted(i)).collect::<Vec<usize>>();
        let observations = &window.track.observations;
        let span = [observations[0].time_s, observations[observations.len() - 1].time_s];
        let far = |i: usize| {
            let node = time_nodes.iter().find(|(place, _)| *place == i);
            node.is_some_and(|(_, t)| *t < span[0] - 4.0 * TIME_SPACING || *t > span[1] + 4.0 * TIME_SPACING)
        };
        active.extend(extra.iter().copied().filter(|i| !far(*i)));
        let innovations = probed.window(window, fitted.windows[w].noise_scale).linearize(&x, &active)?;
        let jacobian = DMatrix::from_row_slice(innovations.whitened.len(), active.len(), &innovations.slopes);
        let residual = DVector::from_column_slice(&innovations.whitened);
        let places: Vec<usize> = active.iter().filter_map(|i| all.iter().position(|a| a == i)).collect();
        Ok::<_, Failure>((jacobian.transpose() * &jacobian, jacobian.transpose() * residual, places))
    };
    let parts: Vec<_> = (0..windows.len()).into_par_iter().map(one).collect::<Result<_, _>>()?;
    let mut hessian = DMatrix::zeros(all.len(), all.len());
    let mut gradient = DVector::zeros(all.len());
    for (curvature, slope, places) in &parts {
        for (i, &row) in places.iter().enumerate() {
            gradient[row] -= slope[i];
            for (j, &column) in places.iter().enumerate() {
                hessian[(row, column)] += curvature[(i, j)];
            }
        }
    }
    // The model's numbers are eliminated, with their prior.
    let m = model.len();
    let prior = hypothesis.prior.marginal(&fitted.active)?;
    let at = DVector::from_iterator(m, fitted.active.iter().map(|&i| fitted.x[i]));
    let base = hessian.view((0, 0), (m, m)) + &prior.precision;
    let base_gradient = gradient.rows(0, m) + &prior.information - &prior.precision * at;
    let cross = hessian.view((0, m), (m, extra.len())).into_owned();
    let cholesky = base.cholesky().ok_or(Failure::Singular)?;
    let solved = cholesky.solve(&cross);
    let hessian = hessian.view((m, m), (extra.len(), extra.len())) - cross.transpose() * &solved;
    let gradient = gradient.rows(m, extra.len()) - solved.transpose() * base_gradient;
    let duration_s = workshop.duration_s();
    let carriers: Vec<usize> = carriers(&workshop.fit.joints, joint).collect();
    let moves_carried = |w: &&BatchWindow| w.moving.contains(&joint) && w.moving.iter().any(|j| carriers.contains(j));
    let carried = windows.iter().any(moves_carried);
    let mut tables = Vec::new();
    for t in own..model_of.tables.len() {
        let first = mechanism.offset(joint) + model_of.table_offset(t);
        let place = extra.iter().position(|&i| i == first).ok_or(Failure::NoInformation)?;
        tables.push((model_of.tables[t].kind, model_of.tables[t].nodes.clone(), place));
    }
    let of_tables = added;
    let of_sensor: Vec<usize> = (of_tables..extra.len()).collect();
    let part = |places: &[usize]| {
        let n = places.len();
        (
            DMatrix::from_fn(n, n, |i, j| hessian[(places[i], places[j])]),
            DVector::from_fn(n, |i, _| gradient[places[i]]),
        )
    };
    let (joint_hessian, joint_gradient) = part(&(0..of_tables).collect::<Vec<usize>>());
    let (sensor_hessian, sensor_gradient) = part(&of_sensor);
    Ok([
        Probes {
            joint: Some(joint),
            carried,
            scales,
            duration_s,
            tables,
            hessian: joint_hessian,
            gradient: joint_gradient,
        },
        Probes {
            joint: None,
            carried: false,
            scales,
            duration_s,
            tables: Vec::new(),
            hessian: sensor_hessian,
            gradient: sensor_gradient,
        },
    ])
}

/// The probes' kinds, nodes, and units beside the joint's force.
fn plans(
    workshop: &Workshop<'_>,
    scales: &JointScales,
    joint: usize,
    windows: &[&BatchWindow],
) -> Vec<(TableKind, Vec<f64>, f64)> {
    let (low, high) = workshop.range(joint);
    let travel = scales.travel.abs();
    // Narrow near the reference position, where catches are.
    let mut places: Vec<f64> = [0.0, 0.01, 0.02, 0.035, 0.055, 0.08].iter().map(|s| s * travel).collect();
    let many = windows.iter().all(|w| w.moving.len() == 1);
    let step = if many { 0.035 } else { 0.08 };
    let mut far = 0.08 + step;
    while far < 1.0 + step {
        places.push(far * travel);
        far += step;
    }
    let mut fine: Vec<f64> = places.iter().map(|x| x * scales.travel.signum()).collect();
    // The other side of the reference position, if the joint goes there.
    let other = if scales.travel > 0.0 { low } else { high };
    if other * scales.travel < 0.0 && other.abs() > 0.1 * travel {
        fine.extend((1..=12).map(|i| other * f64::from(i) / 12.0));
    }
    fine.sort_by(f64::total_cmp);
    let coarse: Vec<f64> = (0..=12).map(|i| low + (high - low) * f64::from(i) / 12.0).collect();
    let rates: Vec<f64> = [-3.0, -2.0, -1.5, -1.1, -0.8, -0.5, -0.3, -0.15, -0.07, -0.03, 0.0]
        .iter()
        .flat_map(|r: &f64| [*r, -*r])
        .map(|r| r * scales.rate)
        .collect();
    let mut rates = rates;
    rates.sort_by(f64::total_cmp);
    rates.dedup();
    let mut times: Vec<f64> = Vec::new();
    let mut slow: Vec<f64> = Vec::new();
    for window in windows {
        let observations = &window.track.observations;
        let (from, to) = (observations[0].time_s, observations[observations.len() - 1].time_s);
        let count = ((to - from) / TIME_SPACING).ceil().max(1.0) as usize;
        times.extend((0..=count).map(|i| from + (to - from) * i as f64 / count as f64));
        slow.extend([from, 0.5 * (from + to), to]);
    }
    for nodes in [&mut times, &mut slow] {
        nodes.sort_by(f64::total_cmp);
        nodes.dedup_by(|a, b| *a - *b < 1e-3);
    }
    let mut plans = vec![
        (TableKind::ForceOverPosition, fine.clone(), 1.0),
        (TableKind::FrictionOverPosition, if many { fine } else { coarse.clone() }, 1.0),
        (TableKind::ForceOverRate, rates, 1.0),
        (TableKind::ClosingDamping, coarse.clone(), 1.0 / scales.rate),
        (TableKind::FrictionOverTime, slow, 1.0),
        (TableKind::InertiaOverPosition, coarse, 1.0 / scales.rate),
    ];
    if many {
        plans.push((TableKind::ForceOverTime, times, 1.0));
    }
    plans
}

impl Probes {
    /// Gain and amplitudes of signatures, each a value of the probes.
    fn regress(&self, signatures: &[DVector<f64>]) -> Option<(f64, DVector<f64>)> {
        let m = signatures.len();
        let right = DVector::from_fn(m, |i, _| signatures[i].dot(&self.gradient));
        let mut matrix = DMatrix::zeros(m, m);
        for j in 0..m {
            let image = &self.hessian * &signatures[j];
            for i in 0..m {
                matrix[(i, j)] = signatures[i].dot(&image);
            }
        }
        // Amplitudes beyond a hundred times the joint's force are not believed.
        for i in 0..m {
            matrix[(i, i)] += 1e-4 + 1e-9 * matrix[(i, i)];
        }
        let amplitudes = matrix.cholesky()?.solve(&right);
        Some((0.5 * right.dot(&amplitudes), amplitudes))
    }

    /// A function of a table's argument as a value of the probes.
    fn signature(&self, kind: TableKind, law: impl Fn(f64) -> f64) -> DVector<f64> {
        let mut value = DVector::zeros(self.gradient.len());
        if let Some((_, nodes, first)) = self.tables.iter().find(|(own, _, _)| *own == kind) {
            for (k, node) in nodes.iter().enumerate() {
                value[first + k] = law(*node);
            }
        }
        value
    }

    /// A force of the opened distance x.
    fn force(&self, law: impl Fn(f64) -> f64) -> DVector<f64> {
        let sign = self.scales.travel.signum();
        self.signature(TableKind::ForceOverPosition, |q| sign * law(sign * q))
    }

    /// A force of the opening rate v.
    fn rate_force(&self, law: impl Fn(f64) -> f64) -> DVector<f64> {
        let sign = self.scales.travel.signum();
        self.signature(TableKind::ForceOverRate, |v| sign * law(sign * v))
    }

    /// A friction bound of the opened distance x.
    fn friction(&self, law: impl Fn(f64) -> f64) -> DVector<f64> {
        let sign = self.scales.travel.signum();
        self.signature(TableKind::FrictionOverPosition, |q| law(sign * q))
    }

    /// Log evidence that a table with independent entries of this deviation would gain \[nats\].
    pub fn table_gain(&self, kind: TableKind, deviation: f64, correlation: f64) -> Option<f64> {
        let (_, nodes, first) = self.tables.iter().find(|(own, _, _)| *own == kind)?;
        let n = nodes.len();
        let covariance =
            DMatrix::from_fn(n, n, |i, j| deviation * deviation * (-(nodes[i] - nodes[j]).abs() / correlation).exp());
        let hessian = self.hessian.view((*first, *first), (n, n)).into_owned();
        let gradient = self.gradient.rows(*first, n).into_owned();
        let precision = covariance.clone().cholesky()?.inverse();
        let inner = (&hessian + precision).cholesky()?;
        let gain = 0.5 * gradient.dot(&inner.solve(&gradient));
        let half_log = |m: &DMatrix<f64>| m.diagonal().iter().map(|d| d.max(1e-300).ln()).sum::<f64>();
        let determinant = half_log(&inner.l()) + half_log(&covariance.cholesky()?.l());
        Some(gain - determinant)
    }

    /// Every effect on this joint that the model does not have, by what it would gain.
    pub fn rank(&self, present: &BTreeSet<Addition>, friction_declared: bool) -> Vec<Ranked> {
        let Some(joint) = self.joint else { return self.rank_sensor(present) };
        let scales = Scales {
            force: self.scales.force,
            position: self.scales.travel.abs(),
            rate: self.scales.rate,
            duration_s: self.duration_s,
        };
        let mut ranked = Vec::new();
        if !friction_declared && !present.contains(&Addition::Friction(joint)) {
            let signature = self.friction(|_| 1.0);
            if let Some((gain, _)) = self.regress(&[signature]) {
                let start = vec![(0.2 * scales.force).ln()];
                ranked.push(Ranked { addition: Addition::Friction(joint), gain, start, also: Vec::new() });
            }
        }
        for kind in EffectKind::ALL {
            let addition = Addition::Effect(joint, *kind);
            if present.contains(&addition) {
                continue;
            }
            let best = self.best_of(*kind, &scales);
            if let Some((gain, physical)) = best {
                let laws = kind.parameters().iter().zip(&physical);
                let start =
                    laws.map(|(p, value)| p.unconstrained(*value, &scales).unwrap_or(-2.0).clamp(-2.5, 2.5)).collect();
                ranked.push(Ranked { addition, gain, start, also: Vec::new() });
            }
        }
        ranked
    }

    fn rank_sensor(&self, present: &BTreeSet<Addition>) -> Vec<Ranked> {
        let unit = |i: usize| DVector::from_fn(self.gradient.len(), |k, _| f64::from(u8::from(k == i)));
        let mut ranked = Vec::new();
        let groups = [(Addition::Bias, 0..6), (Addition::Delay, 6..7)];
        let absent = groups.into_iter().filter(|(addition, _)| !present.contains(addition));
        let mut at = 0;
        for (addition, range) in absent {
            let signatures: Vec<DVector<f64>> = range
                .map(|_| {
                    at += 1;
                    unit(at - 1)
                })
                .collect();
            if let Some((gain, amplitudes)) = self.regress(&signatures) {
                let start = amplitudes.iter().map(|a| a.clamp(-2.0, 2.0)).collect();
                ranked.push(Ranked { addition, gain, start, also: Vec::new() });
            }
        }
        ranked
    }

    /// The gain of an effect's best shape, and its physical parameters.
    fn best_of(&self, kind: EffectKind, scales: &Scales) -> Option<(f64, Vec<f64>)> {
        let travel = scales.position;
        let mut best: Option<(f64, Vec<f64>)> = None;
        let mut offer = |signatures: &[DVector<f64>], physical: &dyn Fn(&DVector<f64>) -> Option<Vec<f64>>| {
            if let Some((gain, amplitudes)) = self.regress(signatures)
                && best.as_ref().is_none_or(|(other, _)| gain > *other)
                && let Some(physical) = physical(&(amplitudes * scales.force))
            {
                best = Some((gain, physical));
            }
        };
        let turns = std::f64::consts::TAU;
        match kind {
            EffectKind::Spring => {
                offer(&[self.force(|x| -x), self.force(|_| 1.0)], &|a| {
                    (a[0] > 0.0).then(|| vec![a[0], (a[1] / a[0]).clamp(-travel, travel)])
                });
            }
            EffectKind::Catch => {
                for width in [0.008, 0.015, 0.03, 0.05, 0.08, 0.13, 0.2].map(|w| w * travel) {
                    let law = |x: f64| if x <= 0.0 { -1.0 } else { -(-x / width).exp() };
                    offer(&[self.force(law)], &|a| (a[0] > 0.0).then(|| vec![a[0], width]));
                }
            }
            EffectKind::SoftClose => {
                for range in [0.08, 0.12, 0.16, 0.2, 0.25, 0.3, 0.37, 0.45, 0.6].map(|r| r * travel) {
                    let inside = |x: f64| f64::from(u8::from(x < range));
                    let sign = self.scales.travel.signum();
                    let closing = self.signature(TableKind::ClosingDamping, |q| inside(sign * q));
                    let signatures =
                        [self.force(|x| -x * inside(x)), self.force(|x| -(x / 0.003).tanh() * inside(x)), closing];
                    offer(&signatures, &|a| {
                        let some = |value: f64, least: f64| value.max(least);
                        (a[1] > 0.0 || a[0] > 0.0).then(|| {
                            let least = 0.05 * scales.force;
                            vec![
                                range,
                                some(a[0], least / travel),
                                some(a[1], least),
                                some(a[2] / scales.rate, least / scales.rate),
                            ]
                        })
                    });
                }
            }
            EffectKind::Detent | EffectKind::PositionFriction => {
                for i in 0..40 {
                    let period = travel / (0.6 + 0.22 * f64::from(i));
                    let wave = |x: f64| (turns * x / period).sin();
                    let quarter = |x: f64| (turns * x / period).cos();
                    let signatures = if kind == EffectKind::Detent {
                        [self.force(|x| -wave(x)), self.force(|x| -quarter(x))]
                    } else {
                        [self.friction(wave), self.friction(quarter)]
                    };
                    offer(&signatures, &|a| Some(vec![a[0].hypot(a[1]), period, a[1].atan2(a[0])]));
                }
            }
            EffectKind::SelfClosing => {
                let widths = [0.05, 0.1, 0.2, 0.4].map(|w| w * travel);
                for centre in (0..=12).map(|i| travel * f64::from(i) / 12.0) {
                    for before in widths {
                        for after in widths {
                            let law = |x: f64| {
                                let width = if x < centre { before } else { after };
                                -(-0.5 * ((x - centre) / width).powi(2)).exp()
                            };
                            offer(&[self.force(law)], &|a| (a[0] > 0.0).then(|| vec![a[0], centre, before, after]));
                        }
                    }
                }
            }
            EffectKind::Stribeck => {
                for rate in [0.03, 0.07, 0.15, 0.3].map(|r| r * scales.rate) {
                    let law = |v: f64| if v == 0.0 { 0.0 } else { -v.signum() * (-(v / rate).powi(2)).exp() };
                    offer(&[self.rate_force(law)], &|a| (a[0] > 0.0).then(|| vec![a[0] + 0.3 * scales.force, rate]));
                }
            }
            EffectKind::AsymmetricFriction => {
                offer(&[self.force(|_| 1.0), self.rate_force(f64::abs)], &|a| {
                    // About the declared ones, which are not known here: the fit starts from both sides.
                    let middle = 0.3 * scales.force;
                    let least = 0.1 * middle;
                    let damping = 0.3 * scales.force / scales.rate;
                    Some(vec![(middle - a[0]).max(least), (middle + a[0]).max(least), damping, damping])
                });
            }
            EffectKind::Drag => {
                offer(&[self.rate_force(|v| -v * v.abs())], &|a| (a[0] > 0.0).then(|| vec![a[0]]));
            }
            // Of a joint that nothing moving carries it is part of the inertia.
            EffectKind::ReflectedInertia => {
                if !self.carried {
                    return None;
                }
                offer(&[self.signature(TableKind::InertiaOverPosition, |_| 1.0)], &|a| {
                    (a[0] > 0.0).then(|| vec![a[0] / scales.rate])
                });
            }
            EffectKind::GravityOffset => offer(&[self.force(|_| 1.0)], &|a| Some(vec![a[0]])),
            EffectKind::Impulse => {
                let times = self.tables.iter().find(|(own, _, _)| *own == TableKind::ForceOverTime);
                let sign = self.scales.travel.signum();
                for start in times.into_iter().flat_map(|(_, nodes, _)| nodes) {
                    for span in [0.1, 0.3, 0.6] {
                        let pulse = |t: f64| sign * f64::from(u8::from(t > start - 0.05 && t < start + span + 0.05));
                        let signature = self.signature(TableKind::ForceOverTime, pulse);
                        offer(&[signature], &|a| Some(vec![*start, span, a[0]]));
                    }
                }
            }
        }
        best
    }
}

/// Numbers of a joint that asymmetric friction starts from, given the declared ones: with the `offset` that it
/// takes the place of, or what its signature suggests \[N or N·m\].
pub fn start_by_direction(
    declared: &[f64],
    start: &[f64],
    offset: Option<f64>,
    kind: EffectKind,
    scales: &Scales,
) -> Vec<f64> {
    let parameters = kind.parameters();
    let (friction, damping) = (declared[crate::model::FRICTION].exp(), declared[crate::model::DAMPING].exp());
    let physical: Vec<f64> = parameters.iter().zip(start).map(|(p, theta)| p.physical(*theta, scales)).collect();
    let half = offset.unwrap_or(0.5 * (physical[1] - physical[0]));
    let values = [(friction - half).max(0.1 * friction), (friction + half).max(0.1 * friction), damping, damping];
    debug_assert!(declared.len() >= SIZE);
    let thetas = parameters.iter().zip(values);
    thetas.map(|(p, value)| p.unconstrained(value, scales).unwrap_or(0.0).clamp(-3.0, 3.0)).collect()
}
