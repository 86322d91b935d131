//! How far a mechanism's simulation is from what a window showed.
//!
//! The window is cut into spans of one horizon. Each starts from the measured positions and rates and is
//! simulated under the measured wrench, with no correction: what it is off by on the way is the position
//! and rotation residual. The force residual of a joint over a span of half a second is the constant
//! generalized force that, added to the model's, makes the joint end where it was seen to end.

use nalgebra::Vector3;

use super::TrackedMechanism;
use crate::mechanism::effects::{AttachedEffect, EffectKind};
use crate::mechanism::{Body, JointType, State, Tree, WrenchSample, WrenchTrack, rollout};

/// Span over which a force is told from a position \[s\].
const FORCE_SPAN: f64 = 0.5;
/// Span, to either side, over which a rate is taken \[s\].
const RATE_SPAN: f64 = 0.25;
/// Longest step of the simulation \[s\].
const STEP_S: f64 = 0.002;
/// A joint that goes less than this in a span rests in it \[m at the part's radius\].
const RESTS: f64 = 0.002;
/// Iterations on a force, and the miss at which they end \[m at the part's radius\].
const FORCE_STEPS: usize = 12;
const FORCE_MISS: f64 = 1e-4;

/// A window as the mechanism's joints went through it.
#[derive(Clone, Debug)]
pub struct MeasuredPath {
    /// Times of the frames \[s\].
    pub times_s: Vec<f64>,
    /// Measured positions by joint and frame \[m or rad\].
    pub positions: Vec<Vec<f64>>,
    /// The wrench, by time; nothing acts without any.
    pub samples: Vec<WrenchSample>,
    /// The body that it acts on.
    pub touched: Option<usize>,
}

/// Squares of residuals, summed.
#[derive(Clone, Copy, Debug, Default, PartialEq)]
pub struct ResidualSum {
    /// Of forces \[N² or (N·m)²\], and how many.
    pub force: (f64, usize),
    /// Of positions of the part's centre of mass \[m²\], and how many.
    pub position: (f64, usize),
    /// Of rotations \[rad²\].
    pub rotation: f64,
}

impl ResidualSum {
    /// Adds another sum to this one.
    pub fn add(&mut self, other: &Self) {
        self.force = (self.force.0 + other.force.0, self.force.1 + other.force.1);
        self.position = (self.position.0 + other.position.0, self.position.1 + other.position.1);
        self.rotation += other.rotation;
    }
}

impl MeasuredPath {
    /// Residuals of every joint that moves in the window or should, `None` for the others, under the
    /// mechanism's tree.
    pub fn residuals(&self, mechanism: &TrackedMechanism, horizon_s: f64) -> Vec<Option<ResidualSum>> {
        let mut sums = vec![None; mechanism.joints.len()];
        for span in spans(&self.times_s, horizon_s) {
            let Some(run) = self.simulated(&mechanism.tree, &span, mechanism) else { continue };
            for (k, simulated) in span.clone().skip(1).zip(&run) {
                let measured: Vec<f64> = self.positions.iter().map(|path| path[k]).collect();
                let (there, here) = (mechanism.tree.displacements(&measured), mechanism.tree.displacements(simulated));
                for (joint, sum) in sums.iter_mut().enumerate() {
                    if !self.concerns(joint, &span, mechanism, &run) {
                        continue;
                    }
                    let sum: &mut ResidualSum = sum.get_or_insert_default();
                    let center = &mechanism.centers[joint];
                    let miss = there[joint].transform_point(center) - here[joint].transform_point(center);
                    sum.position = (sum.position.0 + miss.norm_squared(), sum.position.1 + 1);
                    let turn = there[joint].inverse() * here[joint];
                    sum.rotation += turn.log().fixed_rows::<3>(0).norm_squared();
                }
            }
        }
        for span in spans(&self.times_s, FORCE_SPAN) {
            for (joint, sum) in sums.iter_mut().enumerate() {
                let Some(sum) = sum else { continue };
                if let Some(force) = self.missing_force(joint, &span, mechanism) {
                    sum.force = (sum.force.0 + force * force, sum.force.1 + 1);
                }
            }
        }
        sums
    }

    /// Whether a joint moves in a span, or is simulated to.
    fn concerns(
        &self,
        joint: usize,
        span: &std::ops::Range<usize>,
        mechanism: &TrackedMechanism,
        run: &[Vec<f64>],
    ) -> bool {
        let start = self.positions[joint][span.start];
        let gone = |q: f64| (q - start).abs() * reach(mechanism, joint) > RESTS;
        self.positions[joint][span.clone()].iter().any(|q| gone(*q)) || run.iter().any(|q| gone(q[joint]))
    }

    /// Positions of all joints at the span's frames but the first; `None` where the model diverges.
    fn simulated(
        &self,
        tree: &Tree<f64>,
        span: &std::ops::Range<usize>,
        mechanism: &TrackedMechanism,
    ) -> Option<Vec<Vec<f64>>> {
        let start = span.start;
        let positions = self.positions.iter().map(|path| path[start]).collect();
        let rates = (0..self.positions.len()).map(|joint| self.rate(joint, start, mechanism)).collect();
        let track = self.touched.map(|body| WrenchTrack::new(body, &self.samples));
        let times = &self.times_s[span.clone()];
        let run = rollout(tree, &State::new(positions, rates), track.as_slice(), times, STEP_S).ok()?;
        let paths: Vec<Vec<f64>> = (1..times.len()).map(|i| run.positions(i).to_vec()).collect();
        paths.iter().flatten().all(|q| q.is_finite()).then_some(paths)
    }

    /// Rate of a joint at a frame, by a quadratic over the frames around; none where it rests.
    fn rate(&self, joint: usize, frame: usize, mechanism: &TrackedMechanism) -> f64 {
        let at = self.times_s[frame];
        let near = (0..self.times_s.len()).filter(|k| (self.times_s[*k] - at).abs() <= RATE_SPAN);
        let near: Vec<(f64, f64)> = near.map(|k| (self.times_s[k] - at, self.positions[joint][k])).collect();
        let (low, high) = near.iter().fold((f64::INFINITY, f64::NEG_INFINITY), |(l, h), (_, q)| (l.min(*q), h.max(*q)));
        if near.len() < 4 || (high - low) * reach(mechanism, joint) < RESTS {
            return 0.0;
        }
        let (mut matrix, mut right) = (nalgebra::Matrix3::zeros(), Vector3::zeros());
        for (t, q) in near {
            let row = Vector3::new(1.0, t / RATE_SPAN, (t / RATE_SPAN).powi(2));
            matrix += row * row.transpose();
            right += row * q;
        }
        matrix.cholesky().map_or(0.0, |cholesky| cholesky.solve(&right).y / RATE_SPAN)
    }

    /// The constant force on a joint that lets a span end where it was seen to; `None` where the joint
    /// rests and should, or no force is found.
    fn missing_force(&self, joint: usize, span: &std::ops::Range<usize>, mechanism: &TrackedMechanism) -> Option<f64> {
        let goal = self.positions[joint][span.end - 1];
        let reach = reach(mechanism, joint);
        let miss = |force: f64| {
            let tree = pushed(&mechanism.tree, joint, force)?;
            Some((self.simulated(&tree, span, mechanism)?.last()?[joint] - goal) * reach)
        };
        let without = self.simulated(&mechanism.tree, span, mechanism)?;
        if !self.concerns(joint, span, mechanism, &without) {
            return None;
        }
        let first = (without.last()?[joint] - goal) * reach;
        if first.abs() < FORCE_MISS {
            return Some(0.0);
        }
        // Friction can hold what is too weak: widen until the miss changes sign, then close in.
        let length_s = self.times_s[span.end - 1] - self.times_s[span.start];
        let scale = 2.0 * mechanism.tree.joint_inertia(joint) / (reach * length_s * length_s);
        let (mut near, mut far) = ((0.0, first), (0.0, first));
        let mut step = -first * scale;
        for _ in 0..FORCE_STEPS {
            far = (far.0 + step, miss(far.0 + step)?);
            if far.1 * first <= 0.0 {
                break;
            }
            near = far;
            step *= 2.0;
        }
        if far.1 * first > 0.0 {
            return None;
        }
        for _ in 0..FORCE_STEPS {
            let middle = if far.1 == near.1 { 0.5 } else { (near.1 / (near.1 - far.1)).clamp(0.05, 0.95) };
            let force = near.0 + middle * (far.0 - near.0);
            let here = miss(force)?;
            if here.abs() < FORCE_MISS {
                return Some(force);
            }
            if here * first > 0.0 { near = (force, here) } else { far = (force, here) }
        }
        Some(0.5 * (near.0 + far.0))
    }
}

/// Metres at the part per unit of the joint.
fn reach(mechanism: &TrackedMechanism, joint: usize) -> f64 {
    let joint = &mechanism.joints[joint];
    if joint.joint_type == JointType::Revolute { joint.radius.max(0.05) } else { 1.0 }
}

/// The tree with a constant force on a joint.
fn pushed(tree: &Tree<f64>, joint: usize, force: f64) -> Option<Tree<f64>> {
    let mut bodies: Vec<Body<f64>> = tree.bodies().to_vec();
    bodies.get_mut(joint)?.parameters.effects.push(AttachedEffect::new(EffectKind::GravityOffset, &[force]));
    Tree::new(bodies, tree.gravity()).ok()
}

/// Frames in spans of a length, one after the other, of three frames at least; each ends where the next
/// begins.
fn spans(times_s: &[f64], length_s: f64) -> Vec<std::ops::Range<usize>> {
    let (mut spans, mut start) = (Vec::new(), 0);
    for k in 1..times_s.len() {
        if times_s[k] - times_s[start] >= length_s - 1e-6 {
            if k - start >= 2 {
                spans.push(start..k + 1);
            }
            start = k;
        }
    }
    spans
}

#[cfg(test)]
mod tests {
    use super::super::tests::{drawer, readings, truth};
    use super::*;

    fn path(damping: f64) -> MeasuredPath {
        let samples = readings();
        let times_s: Vec<f64> = (0..=19).map(|i| f64::from(i) * 0.1).collect();
        let positions = truth(&drawer(damping).tree, &samples, &times_s).into_iter().map(|(q, _)| q).collect();
        MeasuredPath { times_s, positions: vec![positions], samples, touched: Some(0) }
    }

    #[test]
    fn the_true_model_leaves_nothing_and_a_wrong_one_the_force_that_it_lacks() {
        let sum = path(8.0).residuals(&drawer(8.0), 1.0)[0].unwrap();
        let rms = |(square, count): (f64, usize)| (square / count as f64).sqrt();
        // Rates are taken from ten positions a second.
        assert!(rms(sum.position) < 2e-3 && rms(sum.force) < 0.25, "{sum:?}");
        let less = path(8.0).residuals(&drawer(2.0), 1.0)[0].unwrap();
        // 6 N·s/m too little at rates of .3 m/s to .8 m/s.
        assert!(rms(less.force) > 1.0 && rms(less.position) > 5.0 * rms(sum.position), "{less:?} {sum:?}");
        assert_eq!(sum.rotation, 0.0);
    }

    #[test]
    fn a_drawer_at_rest_is_not_scored() {
        let still = MeasuredPath { positions: vec![vec![0.1; 20]], samples: Vec::new(), touched: None, ..path(8.0) };
        assert_eq!(still.residuals(&drawer(8.0), 1.0), [None]);
    }

    #[test]
    fn spans_meet_and_the_rest_is_left_out() {
        let times: Vec<f64> = (0..26).map(|i| f64::from(i) * 0.1).collect();
        assert_eq!(spans(&times, 1.0), [0..11, 10..21]);
        assert!(spans(&times[..5], 1.0).is_empty());
    }
}
