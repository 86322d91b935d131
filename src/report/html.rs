//! `--report`: one HTML file that needs nothing else, light or dark as the reader has it.

use maud::{DOCTYPE, Markup, PreEscaped, html};

use super::chart::{Chart, Ink, Line};
use super::found::Found;
use super::series::{ErrorSeries, Gatherer, JointSeries};
use super::table::{Run, significant};
use super::tree_picture::tree_picture;
use crate::io::counters::ByReason;
use crate::pipeline::Learner;
use crate::types::posterior::{EdgePosterior, InformedBy, ObjectPosterior, Quantity, ResidualScore, Verdict};
use crate::types::{Label, Stamp};

const STYLE: &str = include_str!("report.css");

/// What the report is made of, besides what the table shows.
#[derive(Clone, Copy)]
pub struct Evidence<'a> {
    /// What went by.
    pub gatherer: &'a Gatherer,
    /// What was learned; `None` before the first window.
    pub learner: Option<&'a Learner>,
    /// Time zero of the stream, and what the learner's clock says then \[s\].
    pub zero: (Stamp, f64),
}

/// The page.
pub fn page(run: &Run<'_>, evidence: &Evidence<'_>) -> String {
    let posterior = &run.document.posterior;
    let found = Found::new(posterior);
    let moved: Vec<Label> = Gatherer::joints_of(posterior, &found).iter().map(|joint| joint.edge.child).collect();
    html! {
        (DOCTYPE)
        html lang="en" {
            head {
                meta charset="utf-8";
                meta name="viewport" content="width=device-width, initial-scale=1";
                meta name="color-scheme" content="light dark";
                title { "What was found in " (run.bag) }
                style { (PreEscaped(STYLE)) }
            }
            body {
                header {
                    h1 { (run.bag) }
                    p class="facts" {
                        b { (posterior.parts.len()) } " parts"
                        b { (posterior.windows.len()) } " interaction windows"
                        b { (format!("{:.1} s", run.stream_s)) } " of stream"
                        b { (format!("{:.1} s", run.wall_s)) }
                        (format!(" of work, {:.1} × real time", run.stream_s / run.wall_s.max(1e-9)))
                    }
                }
                main {
                    section {
                        h2 { "Mechanism" }
                        (tree_picture(posterior, &found))
                        p class="note" {
                            "Lines: the likeliest joint of each part with its probability; dashed: other parents. "
                            "Part " (posterior.root_label) " is the root ("
                            (if run.root_is_given { "given" } else { "found" }) "), fixed to the world."
                            @if !found.at_rest.is_empty() && posterior.parts.len() > found.at_rest.len() + 1 {
                                " Never moved, so one with it as far as the data say: "
                                (found.at_rest.iter().map(Label::to_string).collect::<Vec<_>>().join(", ")) "."
                            }
                        }
                        (joint_table(posterior, &found))
                    }
                    @if let Some(learner) = evidence.learner {
                        section {
                            h2 { "Joints over time" }
                            (legend(&[("first", "as fitted"), ("faint", "as registration saw it, frame by frame"),
                                ("second", "what the tool's wrench does to the joint"), ("held", "the tool holds the part")]))
                            @for joint in Gatherer::joints_of(posterior, &found) {
                                @let series = evidence.gatherer.joint(&joint, posterior, learner, evidence.zero);
                                (joint_charts(joint.edge, joint.settled().unwrap_or("open"), &series, run.stream_s))
                            }
                        }
                        section {
                            h2 { "Predictions against what was then seen" }
                            p class="note" {
                                "Distance of each part's centre of mass from where it was expected, in advance, from the "
                                "measurements up to then and the wrench applied meanwhile. What is seen is itself measured, "
                                "to a few millimetres."
                            }
                            (legend(&[("first", "0.5 s ahead"), ("third", "0.1 s ahead"), ("faint", "spread as stated, 0.5 s")]))
                            @for label in moved {
                                (error_charts(label, &evidence.gatherer.errors(label, posterior), run.stream_s))
                            }
                        }
                    }
                    section { h2 { "Dynamics" } (dynamics(posterior, &found)) }
                    section { h2 { "Criticism" } (criticism(posterior)) }
                    section { h2 { "Windows" } (windows(posterior)) }
                    section { h2 { "Input" } (input(run)) }
                }
            }
        }
    }
    .into_string()
}

fn legend(entries: &[(&str, &str)]) -> Markup {
    html! {
        p class="legend" {
            @for (color, text) in entries {
                span { i style=(format!("background: var(--{color})")) {} (text) }
            }
        }
    }
}

fn joint_table(posterior: &ObjectPosterior, found: &Found<'_>) -> Markup {
    let vector = |v: [f64; 3]| format!("({:.3}, {:.3}, {:.3})", v[0], v[1], v[2]);
    let rms = |a: f64, b: f64| (0.5 * (a + b)).max(0.0).sqrt();
    html! {
        div class="wide" { table {
            thead { tr {
                th { "part" } th { "on" } th { "P(parent)" } th { "type" } th { "P(type)" }
                th { "axis direction" } th { "±" } th { "through [m]" } th { "±" }
            } }
            tbody { @for part in &posterior.parts {
                @if part.label == posterior.root_label {
                    tr { td { (part.label) } td colspan="8" class="quiet" { "root" } }
                } @else if let Some(joint) = found.joint(part.label) {
                    tr {
                        td { (part.label) } td { (joint.edge.parent) }
                        td class="number" { (format!("{:.3}", joint.probability)) }
                        @match joint.settled() {
                            Some(name) => {
                                td { span class=(format!("type {name}")) { (name) } }
                                td class="number" { (format!("{:.3}", joint.types.likeliest().1)) }
                                @match (name, &joint.edge.revolute, &joint.edge.prismatic) {
                                    ("revolute", Some(axis), _) => {
                                        td { (vector(axis.axis_direction)) }
                                        td class="number" { (significant(rms(axis.covariance[0][0], axis.covariance[1][1]).to_degrees())) "°" }
                                        td { (vector(axis.axis_point_m)) }
                                        td class="number" { (significant(1e3 * rms(axis.covariance[2][2], axis.covariance[3][3]))) " mm" }
                                    }
                                    ("prismatic", _, Some(axis)) => {
                                        td { (vector(axis.axis_direction)) }
                                        td class="number" { (significant(rms(axis.covariance[0][0], axis.covariance[1][1]).to_degrees())) "°" }
                                        td {} td {}
                                    }
                                    _ => { td colspan="4" {} }
                                }
                            }
                            None => td colspan="6" class="quiet" {
                                (format!("open: rigid {:.2}, prismatic {:.2}, revolute {:.2}",
                                    joint.types.rigid, joint.types.prismatic, joint.types.revolute))
                            }
                        }
                    }
                }
            } }
        } }
    }
}

fn joint_charts(edge: &EdgePosterior, name: &str, series: &JointSeries, stream_s: f64) -> Markup {
    let [position, force] = if name == "revolute" { ["rad", "N·m"] } else { ["m", "N"] };
    let times_s = (0.0, stream_s);
    let positions = Chart {
        value: format!("position [{position}]"),
        lines: vec![
            Line { pieces: vec![&series.observed], ink: Ink::Faint, dots: true },
            Line { pieces: series.fitted.iter().collect(), ink: Ink::First, dots: false },
        ],
        spans: series.held.clone(),
        times_s,
        from_zero: false,
    };
    let forces = Chart {
        value: format!("applied [{force}]"),
        lines: vec![Line { pieces: series.applied.iter().collect(), ink: Ink::Second, dots: false }],
        spans: series.held.clone(),
        times_s,
        from_zero: true,
    };
    html! {
        h3 { "Part " (edge.child) ", " (name) " on " (edge.parent) }
        @for chart in [positions.svg(), forces.svg()].into_iter().flatten() { (PreEscaped(chart)) }
    }
}

fn error_charts(label: Label, errors: &[ErrorSeries], stream_s: f64) -> Markup {
    let at = |horizon_s: f64| errors.iter().find(|series| (series.horizon_s - horizon_s).abs() < 1e-6);
    let mut lines = Vec::new();
    if let Some(middle) = at(0.5) {
        lines.push(Line { pieces: vec![&middle.stated], ink: Ink::Faint, dots: false });
        lines.push(Line { pieces: vec![&middle.errors], ink: Ink::First, dots: false });
    }
    if let Some(near) = at(0.1) {
        lines.push(Line { pieces: vec![&near.errors], ink: Ink::Third, dots: false });
    }
    let chart =
        Chart { value: "error [m]".into(), lines, spans: Vec::new(), times_s: (0.0, stream_s), from_zero: true };
    let summary: Vec<String> = errors
        .iter()
        .filter(|series| !series.errors.is_empty())
        .map(|series| format!("{:.1} mm at {} s", 1e3 * series.rms(), series.horizon_s))
        .collect();
    html! {
        h3 { "Part " (label) span class="quiet" { " root mean square over all frames: " (summary.join(", ")) } }
        @if let Some(chart) = chart.svg() { (PreEscaped(chart)) }
    }
}

fn dynamics(posterior: &ObjectPosterior, found: &Found<'_>) -> Markup {
    let joints = Gatherer::joints_of(posterior, found);
    if joints.is_empty() {
        return html! { p class="note" { "No joint was moved: nothing is known of its dynamics." } };
    }
    html! {
        p class="note" { "Median and 90 % interval; the bar shows them from a hundredth to a hundred times the median." }
        div class="wide" { table {
            thead { tr { th { "part" } th { "quantity" } th { "median" } th { "90 % interval" } th {} th {} th { "from" } } }
            tbody { @for joint in &joints {
                @let edge = joint.edge;
                @let mass = posterior.parts.iter().find(|part| part.label == edge.child).map(|part| &part.mass_kg);
                @let quantities = [("damping", Some(&edge.damping)), ("friction", Some(&edge.friction)),
                    ("inertia", Some(&edge.joint_inertia)), ("mass", mass),
                    ("lower end stop", edge.lower_limit.as_ref()), ("upper end stop", edge.upper_limit.as_ref())];
                @for (name, quantity) in quantities {
                    @if let Some(q) = quantity {
                        tr class=(if q.informed_by == InformedBy::Prior { "quiet" } else { "" }) {
                            td { (edge.child) } td { (name) }
                            td class="number" { (significant(q.median)) }
                            td class="number" { (significant(q.q05)) " – " (significant(q.q95)) }
                            td { (q.unit) }
                            td { (bar(q)) }
                            td { (if q.informed_by == InformedBy::Prior { "assumed" } else { "the motion" }) }
                        }
                    }
                }
            } }
        } }
    }
}

/// The interval about the median, on a logarithmic scale of four decades.
fn bar(q: &Quantity) -> Markup {
    let place = |x: f64| if x > 0.0 { (50.0 + 25.0 * (x / q.median).log10()).clamp(1.0, 99.0) } else { 1.0 };
    if q.median <= 0.0 || q.q05 <= 0.0 {
        return html! {};
    }
    let (from, to) = (place(q.q05), place(q.q95));
    html! {
        svg class="bar" viewBox="0 0 100 12" {
            line class="base" x1="0" y1="6" x2="100" y2="6" {}
            rect x=(format!("{from:.2}")) y="3" width=(format!("{:.2}", (to - from).max(0.6))) height="6" rx="1.5" {}
            line class="median" x1="50" y1="1" x2="50" y2="11" {}
        }
    }
}

fn criticism(posterior: &ObjectPosterior) -> Markup {
    let criticism = &posterior.criticism;
    let verdict = match criticism.verdict {
        Verdict::Adequate => "Adequate: what is left over is noise, as large as the noise model says.",
        Verdict::EffectFound => "The declared physics does not explain everything; effects were found that do.",
        Verdict::Unexplained => "What is left over has structure that no known effect explains.",
        Verdict::Insufficient => "Insufficient: fewer than two windows could be scored.",
    };
    html! {
        p { (verdict) }
        @if !criticism.effects.is_empty() {
            div class="wide" { table {
                thead { tr { th { "effect" } th { "part" } th { "probability" } th { "parameters: median (90 %)" } th { "may as well be" } } }
                tbody { @for effect in &criticism.effects { tr {
                    td { (effect.name) }
                    td { (effect.label.map_or_else(|| "sensor".to_owned(), |label| label.to_string())) }
                    td class="number" { (format!("{:.3}", effect.probability)) }
                    td { @for (name, q) in &effect.parameters {
                        div { (name) " " (significant(q.median)) " (" (significant(q.q05)) " – " (significant(q.q95)) ") " (q.unit) }
                    } }
                    td { (effect.indistinguishable_from.join(", ")) }
                } } }
            } }
        }
        @if !criticism.before.is_empty() {
            div class="wide" { table {
                thead { tr { th { "part" } th { "windows" } th {} th { "force" } th { "position" } th { "rotation" }
                    th { "log density" } th { "white, p" } } }
                tbody { @for before in &criticism.before {
                    (score_row(before, "as declared"))
                    @for after in criticism.after.iter().filter(|after| after.label == before.label) {
                        (score_row(after, "with effects"))
                    }
                } }
            } }
        }
    }
}

fn score_row(score: &ResidualScore, which: &str) -> Markup {
    let force = score.force_rmse_n.map(|f| format!("{f:.3} N")).or(score.torque_rmse_nm.map(|t| format!("{t:.3} N·m")));
    html! { tr {
        td { (score.label) } td class="number" { (score.scored_windows) } td { (which) }
        td class="number" { (force.unwrap_or_default()) }
        td class="number" { (format!("{:.2} mm", 1e3 * score.position_rmse_m)) }
        td class="number" { (format!("{:.3}°", score.rotation_rmse_rad.to_degrees())) }
        td class="number" { (format!("{:.1}", score.log_predictive_density)) }
        td class="number" { (format!("{:.3}", score.residual_whiteness_p)) }
    } }
}

fn windows(posterior: &ObjectPosterior) -> Markup {
    let number = |x: Option<f64>| x.map_or_else(String::new, |x| format!("{x:.1}"));
    html! {
        div class="wide" { table {
            thead { tr { th { "from [s]" } th { "to [s]" } th { "held" } th { "frames" } th { "steps" }
                th { "learned in [s]" } th { "log predictive density" } } }
            tbody { @for window in &posterior.windows { tr {
                td class="number" { (format!("{:.2}", window.t0_s)) } td class="number" { (format!("{:.2}", window.t1_s)) }
                td { (window.labels.iter().map(Label::to_string).collect::<Vec<_>>().join(", ")) }
                td class="number" { (window.frames) } td class="number" { (window.steps) }
                td class="number" { (format!("{:.2}", window.inference_wall_s)) }
                td class="number" { (number(window.log_predictive_density)) }
            } } }
        } }
    }
}

fn input(run: &Run<'_>) -> Markup {
    let c = &run.document.counters;
    let rows: [(&str, u64, &ByReason); 5] = [
        ("clouds", c.clouds_in, &c.clouds_dropped),
        ("points", c.points_in, &c.points_dropped),
        ("part poses", c.poses_in, &c.poses_dropped),
        ("wrenches", c.wrenches_in, &c.wrenches_dropped),
        ("transforms", c.tf_in, &c.tf_dropped),
    ];
    html! {
        div class="wide" { table {
            thead { tr { th {} th { "read" } th { "not used" } } }
            tbody { @for (name, count, dropped) in rows { @if count > 0 || !dropped.is_empty() { tr {
                td { (name) } td class="number" { (count) }
                td { (dropped.iter().map(|(reason, n)| format!("{reason} {n}")).collect::<Vec<_>>().join(", ")) }
            } } } }
        } }
        @if !run.remarks.is_empty() {
            ul class="remarks" { @for remark in run.remarks { li { (remark) } } }
        }
    }
}
