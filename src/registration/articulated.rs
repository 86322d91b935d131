//! Where along a joint a part is, in every frame of a window: a grid over the joint position,
//! then the cheapest path through it (Viterbi).

use nalgebra::Vector3;

use super::{FromBehind, PartModel, ScanPoint, truncated_cost};
use crate::math::{Pose, Screw};

/// Points of a scan that the grid looks at.
const GRID_POINTS: usize = 60;
/// Cost of moving by one grid step from one frame to the next, per point.
const STEP_COST: f64 = 0.004;
/// Grid steps that a joint can move between frames.
const MOST_STEPS: usize = 12;
/// Paths that cost this much more than the best, per point, are given up.
const BEAM: f64 = 1.5;
/// A tool further than this from where the joint puts it says no more \[m\].
const TOOL_CAP: f64 = 0.030;

/// One frame of a part that may move along a joint.
#[derive(Clone, Copy, Debug)]
pub struct JointFrame<'a> {
    /// The part's points; empty where it was not seen.
    pub scan: &'a [ScanPoint],
    /// Displacement of the joint's parent.
    pub parent: Pose,
    /// The tool's position in world \[m\], where it holds the part.
    pub tool: Option<Vector3<f64>>,
}

/// A path of joint positions and what it costs.
#[derive(Clone, Debug)]
pub struct JointPath {
    /// Joint position per frame \[m or rad\].
    pub positions: Vec<f64>,
    /// Mean truncated cost per point along the path.
    pub cost: f64,
}

/// The cheapest path over the grid `low..=high` of the given `step`.
///
/// `contact_point` is where the tool holds the part at the reference configuration \[m\].
pub fn search_path(
    model: &PartModel,
    frames: &[JointFrame<'_>],
    screw: &Screw,
    grid: (f64, f64, f64),
    contact_point: Option<&Vector3<f64>>,
) -> JointPath {
    let (low, high, step) = grid;
    let count = (((high - low) / step).round() as usize).max(1) + 1;
    let places: Vec<Pose> = (0..count).map(|g| screw.displacement(low + step * g as f64)).collect();
    let mut best = vec![0.0; count];
    let mut came_from: Vec<Vec<usize>> = Vec::with_capacity(frames.len());
    let mut unary: Vec<Vec<f64>> = Vec::with_capacity(frames.len());
    for frame in frames {
        let stride = (frame.scan.len() / GRID_POINTS).max(1);
        let cost_of = |place: &Pose| {
            let displacement = frame.parent * *place;
            let mut cost = truncated_cost(model, frame.scan, stride, &displacement, FromBehind::OtherSide);
            if let (Some(tool), Some(point)) = (frame.tool, contact_point) {
                let miss = (displacement.transform_point(point) - tool).norm().min(TOOL_CAP);
                cost += 0.5 * (miss / 0.010).powi(2);
            }
            cost
        };
        // Only paths near the best so far are followed: the rest of the grid is not looked at.
        let leader = best.iter().copied().fold(f64::INFINITY, f64::min);
        let mut next = vec![f64::INFINITY; count];
        let mut from = vec![0; count];
        for (g, &value) in best.iter().enumerate().filter(|(_, value)| **value <= leader + BEAM) {
            let reach = if came_from.is_empty() { 0 } else { MOST_STEPS };
            for other in g.saturating_sub(reach)..=(g + reach).min(count - 1) {
                let reached = value + STEP_COST * g.abs_diff(other) as f64;
                if reached < next[other] {
                    (next[other], from[other]) = (reached, g);
                }
            }
        }
        let mut costs = vec![f64::INFINITY; count];
        for (g, place) in places.iter().enumerate().filter(|(g, _)| next[*g].is_finite()) {
            costs[g] = cost_of(place);
        }
        for (value, cost) in next.iter_mut().zip(&costs) {
            *value += cost;
        }
        best = next;
        came_from.push(from);
        unary.push(costs);
    }
    let mut at = (0..count).min_by(|&a, &b| best[a].total_cmp(&best[b])).unwrap_or(0);
    let mut positions = vec![0.0; frames.len()];
    let mut cost = 0.0;
    for k in (0..frames.len()).rev() {
        positions[k] = low + step * at as f64;
        cost += unary[k][at];
        at = came_from[k][at];
    }
    JointPath { positions, cost: cost / frames.len().max(1) as f64 }
}
