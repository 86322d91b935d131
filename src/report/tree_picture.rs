//! The kinematic tree as an SVG element: the root on top, children below their parents.

use std::collections::BTreeMap;

use maud::{Markup, html};

use super::found::Found;
use crate::types::Label;
use crate::types::posterior::ObjectPosterior;

/// Distance between neighbours and between generations, and a part's half size \[px\].
const STEP: (f64, f64) = (150.0, 96.0);
const HALF: (f64, f64) = (34.0, 17.0);
/// Edges less likely than this are not shown.
const SHOWN: f64 = 0.02;

/// The picture.
pub fn tree_picture(posterior: &ObjectPosterior, found: &Found<'_>) -> Markup {
    let mut children: BTreeMap<Label, Vec<Label>> = BTreeMap::new();
    for part in &posterior.parts {
        if let Some(joint) = found.joint(part.label).filter(|_| part.label != posterior.root_label) {
            children.entry(joint.edge.parent).or_default().push(part.label);
        }
    }
    let mut places = BTreeMap::new();
    let mut next = 0.0;
    place(posterior.root_label, 0, &children, &mut next, &mut places);
    let deepest = places.values().map(|(_, y)| *y).fold(0.0, f64::max);
    let width = STEP.0 * f64::max(next, 1.0);
    let view = format!("0 0 {width} {}", deepest + 2.0 * HALF.1 + 16.0);
    html! {
        svg class="tree" viewBox=(view) role="img" style=(format!("max-width: {width}px")) {
            @for edge in &posterior.edges {
                @if let (Some(from), Some(to)) = (places.get(&edge.parent), places.get(&edge.child)) {
                    @if edge.probability >= SHOWN && !is_shown(found, edge.parent, edge.child) {
                        line class="other" x1=(from.0) y1=(from.1) x2=(to.0) y2=(to.1)
                            opacity=(format!("{:.2}", edge.probability)) {}
                    }
                }
            }
            @for (label, (x, y)) in &places {
                @if let Some(joint) = found.joint(*label).filter(|_| *label != posterior.root_label) {
                    @if let Some((px, py)) = places.get(&joint.edge.parent) {
                        @let name = joint.settled().unwrap_or("open");
                        line class=(format!("joint {name}")) x1=(px) y1=(py) x2=(x) y2=(y) {}
                        text class="type" x=(0.5 * (px + x) + 8.0) y=(0.5 * (py + y) + 4.0) {
                            (name) " " (format!("{:.2}", joint.probability))
                        }
                    }
                }
            }
            @for (label, (x, y)) in &places {
                rect class=(if *label == posterior.root_label { "part root" } else { "part" })
                    x=(x - HALF.0) y=(y - HALF.1) width=(2.0 * HALF.0) height=(2.0 * HALF.1) rx="6" {}
                text class="name" x=(x) y=(y + 5.0) { (label) }
            }
        }
    }
}

fn is_shown(found: &Found<'_>, parent: Label, child: Label) -> bool {
    found.joint(child).is_some_and(|joint| joint.edge.parent == parent)
}

/// Leaves side by side, parents above the middle of their children; returns the part's x.
fn place(
    label: Label,
    depth: usize,
    children: &BTreeMap<Label, Vec<Label>>,
    next: &mut f64,
    places: &mut BTreeMap<Label, (f64, f64)>,
) -> f64 {
    let y = HALF.1 + 8.0 + STEP.1 * depth as f64;
    // Entered first, so that a loop, which a tree has not, would end.
    places.insert(label, (0.0, y));
    let below = children.get(&label).map_or(&[][..], Vec::as_slice);
    let mut xs = Vec::new();
    for child in below {
        if !places.contains_key(child) {
            xs.push(place(*child, depth + 1, children, next, places));
        }
    }
    let x = match (xs.first(), xs.last()) {
        (Some(first), Some(last)) => 0.5 * (first + last),
        _ => {
            *next += 1.0;
            STEP.0 * (*next - 0.5)
        }
    };
    places.insert(label, (x, y));
    x
}
