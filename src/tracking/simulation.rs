//! Simulation of a tracked tree over short spans, with parts that rest and a disturbance that fades.

use super::filter::Held;
use super::mechanism::set_disturbance;
use crate::mechanism::{State, Step, Tree, Workspace, WrenchPoint, WrenchSample, WrenchTrack, step};
use crate::model::SensorError;

/// An unexplained force is forgotten within this \[s\]: e^(−t/T).
pub(super) const DISTURBANCE_MEMORY: f64 = 1.0;
/// Spans over which a disturbance is taken as constant \[s\].
const CONSTANT: f64 = 0.1;

/// What moves the joints.
pub(super) struct Drive<'a> {
    /// What the tool holds.
    pub held: Option<Held>,
    /// Readings of the wrench.
    pub samples: &'a [WrenchSample],
    /// What is wrong with them.
    pub sensor: SensorError<f64>,
    /// Joints that stay, with their positions.
    pub resting: &'a [(usize, f64)],
    /// Longest step \[s\].
    pub step_s: f64,
}

impl Drive<'_> {
    /// Carries `state` from one time to another \[s\]; `disturbance` is the unexplained force on each
    /// joint at the start of the span \[N or N·m\].
    pub fn run(
        &self,
        tree: &mut Tree<f64>,
        state: &mut State<f64>,
        span: [f64; 2],
        disturbance: &[f64],
        (workspace, cursor): (&mut Workspace<f64>, &mut usize),
    ) {
        let track = self.held.map(|held| WrenchTrack {
            point: WrenchPoint::Carried(held.point),
            delay_s: self.sensor.delay_s,
            force_bias: self.sensor.force_bias,
            torque_bias: self.sensor.torque_bias,
            ..WrenchTrack::new(held.body, self.samples)
        });
        let length = span[1] - span[0];
        let disturbed = disturbance.iter().any(|force| *force != 0.0);
        let pieces = if disturbed { (length / CONSTANT - 1e-6).ceil().max(1.0) as usize } else { 1 };
        for piece in 0..pieces {
            let from = span[0] + length * piece as f64 / pieces as f64;
            let piece_s = length / pieces as f64;
            if disturbed {
                let faded = (-(from - span[0] + 0.5 * piece_s) / DISTURBANCE_MEMORY).exp();
                set_disturbance(tree, &disturbance.iter().map(|force| force * faded).collect::<Vec<_>>());
            }
            let count = (piece_s / self.step_s - 1e-6).ceil().max(1.0) as usize;
            let length_s = piece_s / count as f64;
            for i in 0..count {
                let middle_s = from + (i as f64 + 0.5) * length_s;
                let wrench = track.as_ref().map(|track| track.wrench(middle_s, cursor));
                step(tree, state, wrench.as_slice(), Step { middle_s, length_s }, workspace);
                for &(joint, position) in self.resting {
                    state.positions[joint] = position;
                    state.rates[joint] = 0.0;
                }
            }
        }
        if disturbed {
            set_disturbance(tree, &vec![0.0; disturbance.len()]);
        }
    }
}
