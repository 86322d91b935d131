//! The table of what was found: at most 100 columns, part by part.

use std::fmt::Write;

use super::found::Found;
use crate::io::counters::{ByReason, Counters};
use crate::io::document::PosteriorDocument;
use crate::types::Label;
use crate::types::posterior::{
    Criticism, EdgePosterior, InformedBy, JointTypeProbabilities, ObjectPosterior, Quantity, ResidualScore, Verdict,
    WindowRecord,
};

/// Longer lists of an effect's parameters (tables) are cut.
const MOST_PARAMETERS: usize = 8;

/// A run, as the table tells it.
#[derive(Clone, Copy, Debug)]
pub struct Run<'a> {
    /// What was read.
    pub bag: &'a str,
    /// What came out.
    pub document: &'a PosteriorDocument,
    /// Whether the root was given, not found.
    pub root_is_given: bool,
    /// From the first to the last stamp \[s\].
    pub stream_s: f64,
    /// How long it took \[s\].
    pub wall_s: f64,
    /// What was damaged, dropped or missing, a line each.
    pub remarks: &'a [String],
}

/// The table, as lines.
pub fn table(run: &Run<'_>) -> String {
    let posterior = &run.document.posterior;
    let labels = labels_of(posterior);
    let mut text = format!("{}: {:.1} s of stream, {} parts\n\n", run.bag, run.stream_s, labels.len());
    let found = Found::new(posterior);
    let width = labels.iter().map(|label| label.to_string().len()).max().unwrap_or(1).max(4);
    let margin = " ".repeat(2 * width + 11);
    line(&mut text, &format!("{:>width$}  {:<on$}joint", "part", "on", on = width + 9));
    for label in &labels {
        if *label == posterior.root_label {
            let how = if run.root_is_given { "given" } else { "found" };
            line(&mut text, &format!("{label:>width$}  root ({how}), fixed to the world"));
            continue;
        }
        let Some(joint) = found.joint(*label) else { continue };
        let type_probability = joint.types.likeliest().1;
        let on = format!("{:>width$} {:.3}", joint.edge.parent.to_string(), joint.probability);
        let Some(name) = joint.settled() else {
            let JointTypeProbabilities { rigid, prismatic, revolute } = joint.types;
            line(
                &mut text,
                &format!(
                    "{label:>width$}  {on}   open: rigid {rigid:.3}, prismatic {prismatic:.3}, revolute {revolute:.3}"
                ),
            );
            continue;
        };
        line(&mut text, &format!("{label:>width$}  {on}   {name} {type_probability:.3}"));
        for detail in details(joint.edge, name) {
            line(&mut text, &format!("{margin}{detail}"));
        }
    }
    if !found.at_rest.is_empty() && labels.len() > found.at_rest.len() + 1 {
        let list: Vec<String> = found.at_rest.iter().map(Label::to_string).collect();
        let (parts, them) = if list.len() == 1 { ("Part", "it") } else { ("Parts", "one of them") };
        line(&mut text, "");
        line(
            &mut text,
            &format!("{parts} {} never moved: a joint on {them} is shown as on the root.", list.join(", ")),
        );
    }
    criticism_lines(&mut text, &posterior.criticism);
    line(&mut text, "");
    line(&mut text, &windows_line(&posterior.windows, run.stream_s, run.wall_s));
    counter_lines(&mut text, &run.document.counters);
    run.remarks.iter().for_each(|remark| line(&mut text, &format!("! {remark}")));
    text
}

fn line(text: &mut String, content: &str) {
    text.push_str(content.trim_end());
    text.push('\n');
}

pub(super) fn labels_of(posterior: &ObjectPosterior) -> Vec<Label> {
    let ends = posterior.edges.iter().flat_map(|edge| [edge.parent, edge.child]);
    let parts = posterior.parts.iter().map(|part| part.label);
    let mut labels: Vec<Label> = ends.chain(parts).chain([posterior.root_label]).collect();
    labels.sort_unstable();
    labels.dedup();
    labels
}

fn details(edge: &EdgePosterior, joint_type: &str) -> Vec<String> {
    let mut lines = Vec::new();
    let vector = |[x, y, z]: [f64; 3]| format!("({x:>7.3}, {y:>7.3}, {z:>7.3})");
    let rms = |a: f64, b: f64| (0.5 * (a + b)).max(0.0).sqrt();
    match joint_type {
        "revolute" => {
            if let Some(axis) = &edge.revolute {
                let c = &axis.covariance;
                let degrees = rms(c[0][0], c[1][1]).to_degrees();
                let millimetres = 1e3 * rms(c[2][2], c[3][3]);
                lines.push(format!("axis       {} ± {}°", vector(axis.axis_direction), significant(degrees)));
                lines.push(format!("through    {} m ± {} mm", vector(axis.axis_point_m), significant(millimetres)));
            }
        }
        "prismatic" => {
            if let Some(axis) = &edge.prismatic {
                let degrees = rms(axis.covariance[0][0], axis.covariance[1][1]).to_degrees();
                lines.push(format!("axis       {} ± {}°", vector(axis.axis_direction), significant(degrees)));
            }
        }
        _ => return lines,
    }
    for (name, quantity) in [("damping", &edge.damping), ("friction", &edge.friction), ("inertia", &edge.joint_inertia)]
    {
        lines.push(format!("{name:<9}{}", interval(quantity)));
    }
    for (name, limit) in [("lower end", &edge.lower_limit), ("upper end", &edge.upper_limit)] {
        if let Some(limit) = limit {
            lines.push(format!("{name}{}", interval(limit)));
        }
    }
    lines
}

/// Median and 90 % interval.
fn interval(q: &Quantity) -> String {
    let source = if q.informed_by == InformedBy::Prior { ", assumed" } else { "" };
    let [median, q05, q95] = [q.median, q.q05, q.q95].map(significant);
    format!("{median:>9}  [{q05}, {q95}] {}{source}", q.unit)
}

/// Three significant digits.
pub(super) fn significant(x: f64) -> String {
    let magnitude = x.abs();
    match magnitude {
        _ if magnitude == 0.0 => "0".to_owned(),
        _ if !(1e-3..1e5).contains(&magnitude) => format!("{x:.2e}"),
        _ => {
            let decimals = (2 - magnitude.log10().floor() as i32).max(0) as usize;
            format!("{x:.decimals$}")
        }
    }
}

/// What was found beyond the declared physics, and how well windows were predicted before and after.
fn criticism_lines(text: &mut String, criticism: &Criticism) {
    let verdict = match criticism.verdict {
        Verdict::Adequate => "the model explains what was seen",
        Verdict::EffectFound => "the model lacked an effect, which was found",
        Verdict::Unexplained => "something is left that no known effect explains",
        Verdict::Insufficient => return,
    };
    line(text, "");
    line(text, &format!("Criticism: {verdict}."));
    for effect in &criticism.effects {
        let place = effect.label.map_or_else(|| "the sensor".to_owned(), |label| format!("part {label}"));
        line(text, &format!("{} on {place}, probability {:.3}", effect.name, effect.probability));
        if !effect.indistinguishable_from.is_empty() {
            line(text, &format!("    or {}", effect.indistinguishable_from.join(", ")));
        }
        for (name, quantity) in effect.parameters.iter().take(MOST_PARAMETERS) {
            line(text, &format!("    {name:<16}{}", interval(quantity)));
        }
        if effect.parameters.len() > MOST_PARAMETERS {
            line(text, &format!("    and {} more", effect.parameters.len() - MOST_PARAMETERS));
        }
    }
    for after in &criticism.after {
        let Some(before) = criticism.before.iter().find(|before| before.label == after.label) else { continue };
        let force = |score: &ResidualScore| match (score.force_rmse_n, score.torque_rmse_nm) {
            (Some(force), _) => format!("{} N", significant(force)),
            (_, Some(torque)) => format!("{} N·m", significant(torque)),
            _ => "-".to_owned(),
        };
        let both = |score: &ResidualScore| format!("{}, {} mm", force(score), significant(1e3 * score.position_rmse_m));
        let change = if before == after { both(after) } else { format!("{} -> {}", both(before), both(after)) };
        let count = after.scored_windows;
        let plural = if count == 1 { "" } else { "s" };
        line(text, &format!("part {}: residual over {count} window{plural} {change}", after.label));
    }
}

fn windows_line(windows: &[WindowRecord], stream_s: f64, wall_s: f64) -> String {
    let speed =
        format!("{stream_s:.1} s of stream in {wall_s:.1} s: {:.1} times real time", stream_s / wall_s.max(1e-9));
    let mut walls: Vec<f64> = windows.iter().map(|window| window.inference_wall_s).collect();
    walls.sort_by(f64::total_cmp);
    match walls[..] {
        [] => format!("No interaction was seen: the posterior is the prior.\n{speed}"),
        [.., longest] => {
            let median = walls[walls.len() / 2];
            let count = walls.len();
            let plural = if count == 1 { "" } else { "s" };
            format!(
                "{count} interaction window{plural}, inference {median:.2} s at the median, {longest:.2} s at most\n{speed}"
            )
        }
    }
}

fn counter_lines(text: &mut String, counters: &Counters) {
    let reasons = |reasons: &ByReason| {
        reasons.iter().map(|(reason, count)| format!("{reason} {count}")).collect::<Vec<_>>().join(", ")
    };
    let mut arrived = Vec::new();
    let kinds = [
        ("clouds", counters.clouds_in, &counters.clouds_dropped),
        ("points", counters.points_in, &counters.points_dropped),
        ("poses", counters.poses_in, &counters.poses_dropped),
        ("wrenches", counters.wrenches_in, &counters.wrenches_dropped),
        ("transforms", counters.tf_in, &counters.tf_dropped),
    ];
    for (name, count, _) in &kinds {
        if *count > 0 {
            arrived.push(format!("{count} {name}"));
        }
    }
    let _ = writeln!(text, "read: {}", arrived.join(", "));
    for (name, _, dropped) in kinds {
        if !dropped.is_empty() {
            let _ = writeln!(text, "{name} not used: {}", reasons(dropped));
        }
    }
    if !counters.bag_damage.is_empty() {
        let _ = writeln!(text, "damage in the bag: {}", reasons(&counters.bag_damage));
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::posterior::{PrismaticAxis, RevoluteAxis};

    const OPEN: JointTypeProbabilities = JointTypeProbabilities::UNIFORM;
    const HINGE: JointTypeProbabilities = JointTypeProbabilities { rigid: 0.0, prismatic: 0.004, revolute: 0.996 };
    const SLIDE: JointTypeProbabilities = JointTypeProbabilities { rigid: 0.0, prismatic: 1.0, revolute: 0.0 };

    fn edge(parent: u32, child: u32, probability: f64, joint_type: JointTypeProbabilities) -> EdgePosterior {
        let log_normal = |unit, informed_by| Quantity::from_log_normal(unit, 0.3, 0.1, informed_by);
        EdgePosterior {
            parent: Label(parent),
            child: Label(child),
            probability,
            joint_type,
            revolute: Some(RevoluteAxis {
                axis_direction: [0.0, -0.002, 1.0],
                axis_point_m: [0.4121, -0.231, 0.5],
                covariance: std::array::from_fn(|i| std::array::from_fn(|j| if i == j { 4e-6 } else { 0.0 })),
            }),
            prismatic: Some(PrismaticAxis { axis_direction: [1.0, 0.0, 0.0], covariance: [[1e-5, 0.0], [0.0, 1e-5]] }),
            damping: log_normal("N·m·s/rad", InformedBy::Dynamics),
            friction: log_normal("N·m", InformedBy::Dynamics),
            joint_inertia: Quantity::from_log_normal("kg·m²", -8.0, 1.5, InformedBy::Prior),
            lower_limit: None,
            upper_limit: Some(Quantity::from_normal("rad", 1.52, 0.003, InformedBy::Dynamics)),
        }
    }

    fn run_of(edges: Vec<EdgePosterior>, windows: Vec<WindowRecord>, remarks: &[String]) -> String {
        let posterior = ObjectPosterior {
            root_label: Label(3),
            parts: Vec::new(),
            edges,
            windows,
            criticism: Criticism::insufficient(),
        };
        let mut counters = Counters { clouds_in: 20, wrenches_in: 300, ..Counters::default() };
        Counters::add(&mut counters.clouds_dropped, "unknown_frame", 2);
        let document = PosteriorDocument::new(posterior, counters);
        table(&Run { bag: "a.mcap", document: &document, root_is_given: true, stream_s: 30.0, wall_s: 3.0, remarks })
    }

    fn window(inference_wall_s: f64) -> WindowRecord {
        WindowRecord {
            t0_s: 0.0,
            t1_s: 1.0,
            labels: Vec::new(),
            frames: 10,
            steps: 3,
            inference_wall_s,
            elbo: None,
            log_predictive_density: None,
        }
    }

    #[test]
    fn parts_at_rest_are_one_with_the_root() {
        // Part 1 is on 3 or on 5, which never moved; part 2 slides on 1.
        let edges = vec![
            edge(3, 1, 0.4, HINGE),
            edge(5, 1, 0.595, HINGE),
            edge(2, 1, 0.005, HINGE),
            edge(1, 2, 0.98, SLIDE),
            edge(3, 2, 0.02, SLIDE),
            edge(3, 5, 1.0, OPEN),
        ];
        let text = run_of(edges, vec![window(0.2), window(0.4), window(0.3)], &["/wrench: 2 s late".into()]);
        let expected = "a.mcap: 30.0 s of stream, 4 parts

part  on           joint
   1     3 0.995   revolute 0.996
                   axis       (  0.000,  -0.002,   1.000) ± 0.115°
                   through    (  0.412,  -0.231,   0.500) m ± 2.00 mm
                   damping       1.35  [1.15, 1.59] N·m·s/rad
                   friction      1.35  [1.15, 1.59] N·m
                   inertia    3.35e-4  [2.85e-5, 0.00396] kg·m², assumed
                   upper end     1.52  [1.52, 1.52] rad
   2     1 0.980   prismatic 1.000
                   axis       (  1.000,   0.000,   0.000) ± 0.181°
                   damping       1.35  [1.15, 1.59] N·m·s/rad
                   friction      1.35  [1.15, 1.59] N·m
                   inertia    3.35e-4  [2.85e-5, 0.00396] kg·m², assumed
                   upper end     1.52  [1.52, 1.52] rad
   3  root (given), fixed to the world
   5     3 1.000   open: rigid 0.333, prismatic 0.333, revolute 0.333

Part 5 never moved: a joint on it is shown as on the root.

3 interaction windows, inference 0.30 s at the median, 0.40 s at most
30.0 s of stream in 3.0 s: 10.0 times real time
read: 20 clouds, 300 wrenches
clouds not used: unknown_frame 2
! /wrench: 2 s late
";
        assert_eq!(text, expected);
        assert!(text.lines().all(|line| line.chars().count() <= 100));
    }

    #[test]
    fn no_interaction_is_said() {
        let text = run_of(vec![edge(3, 1, 1.0, OPEN)], Vec::new(), &[]);
        assert!(text.contains("No interaction was seen: the posterior is the prior."), "{text}");
        assert!(!text.contains("never moved"), "{text}");
    }

    #[test]
    fn three_digits() {
        let shown = [0.0, 0.012345, 1.0, -9.99, 123.4, 54321.0, 1e5, 1e-5].map(significant);
        assert_eq!(shown, ["0", "0.0123", "1.00", "-9.99", "123", "54321", "1.00e5", "1.00e-5"]);
    }
}
