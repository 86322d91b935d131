//! Which part the tool took hold of, by what went along with it.
//!
//! The part nearest to the tool is a guess: a door in front of another, a handle across a gap. Once the tool
//! has gone some way, the part that it holds is where its joint lets the tool carry it, and the others are where
//! they were.

use nalgebra::Vector3;

use super::explain::FEWEST_POINTS;
use super::touch::{Touch, Toucher};
use super::{Frame, Learner};
use crate::registration::thinned_cost;
use crate::tracking::{Filter, INDEPENDENT};
use crate::types::Label;

/// The tool has to go so far before it tells \[m\].
const WENT: f64 = 0.015;
/// A joint that carries the tool leaves it by no more than this, and this share of its way \[m\].
const MISS: (f64, f64) = (0.01, 0.2);
/// Parts this far from the tool are not held \[m\].
const REACH: f64 = 0.15;
/// Span of the tool's way that gives its rate \[s\].
const RATE_SPAN: f64 = 0.06;
/// Log odds beyond which another part than the nearest is held, and the nearest is.
const LOG_ODDS: f64 = 4.0;
/// Log prior odds that a tool that pushes and goes its way moves nothing.
const LOG_NONE: f64 = -3.0;

/// A contact under way whose part is not sure.
pub(super) struct Grip {
    label: Label,
    /// The tool, when contact began \[m\].
    tool_in_world: Vector3<f64>,
    /// Joint positions then.
    positions: Vec<f64>,
    decided: bool,
}

impl Grip {
    /// Looks at what a frame brought; the filter and the toucher learn of it where another part is held.
    /// `positions`: of the joints, before the filter took in the frame.
    pub fn look(
        grip: &mut Option<Self>,
        (frame, touches): (&Frame, &[Touch]),
        positions: &[f64],
        learner: &Learner,
        (filter, toucher): (&mut Filter, &mut Toucher),
    ) {
        let Some(last) = touches.last().filter(|touch| frame.time_s - touch.time_s < 0.05) else {
            *grip = None;
            return;
        };
        let Some(label) = last.part else { return };
        let began = touches.iter().rfind(|touch| touch.begins);
        let new = grip.as_ref().is_none_or(|grip| grip.positions.len() != positions.len());
        if let Some(first) = began.or(new.then_some(last)) {
            let tool_in_world = first.tool_in_world;
            *grip = Some(Self { label, tool_in_world, positions: positions.to_vec(), decided: false });
        }
        let Some(grip) = grip.as_mut().filter(|grip| !grip.decided) else { return };
        let way = (last.tool_in_world - grip.tool_in_world).norm();
        if way < WENT {
            return;
        }
        let mechanism = filter.mechanism();
        let Some(own) = mechanism.body(grip.label) else { return };
        // What hangs on what is held, or carries it, goes along.
        let apart = |body: usize| !mechanism.chain(body).contains(&own) && !mechanism.chain(own).contains(&body);
        let displacements = mechanism.tree.displacements(&grip.positions);
        let odds = |body: usize| {
            let label = mechanism.joints[body].child;
            let (model, scan) = (learner.models.get(&label)?, frame.scans.get(&label)?);
            let carried = mechanism.carry(&grip.positions, body, &grip.tool_in_world, &last.tool_in_world);
            let place = |point: &Vector3<f64>| carried.displacement.transform_point(point);
            let near = model.surfels.iter().any(|s| (place(&s.point) - last.tool_in_world).norm() < REACH);
            if scan.len() < FEWEST_POINTS || !near || carried.miss_m > MISS.0 + MISS.1 * way {
                return None;
            }
            let gain =
                thinned_cost(model, scan, &displacements[body]) - thinned_cost(model, scan, &carried.displacement);
            Some((INDEPENDENT * gain, carried))
        };
        let held = odds(own).map_or(0.0, |(odds, _)| odds);
        let others = (0..mechanism.joints.len()).filter(|&body| apart(body));
        let best = others.filter_map(|body| Some((body, odds(body)?))).max_by(|a, b| a.1.0.total_cmp(&b.1.0));
        let rival = best.as_ref().map_or(0.0, |(_, (odds, _))| *odds);
        tracing::debug!(label = %grip.label, held, rival, way, "grip");
        if held > rival.max(0.0) + LOG_ODDS {
            grip.decided = true;
            return;
        }
        let Some((body, (_, carried))) = best.filter(|_| rival > held.max(LOG_NONE) + LOG_ODDS) else { return };
        let before = touches.iter().find(|touch| last.time_s - touch.time_s < RATE_SPAN);
        let rate = before.filter(|before| last.time_s - before.time_s > 0.5 * RATE_SPAN).map_or(0.0, |before| {
            let then = mechanism.carry(&grip.positions, body, &grip.tool_in_world, &before.tool_in_world);
            (carried.position - then.position) / (last.time_s - before.time_s)
        });
        grip.label = mechanism.joints[body].child;
        grip.decided = true;
        toucher.takes(grip.label);
        let sigma_m = toucher.tool_sigma();
        filter.place(own, grip.positions[own], 0.0);
        filter.place(body, carried.position, rate);
        filter.trust();
        filter.hold(body, &last.tool_in_world, sigma_m);
    }
}
