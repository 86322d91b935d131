//! /diagnostics, once a second and whenever something new is wrong.

use std::collections::BTreeMap;
use std::time::Duration;

use ros2_interfaces_jazzy_serde::diagnostic_msgs::msg::{DiagnosticArray, DiagnosticStatus, KeyValue};
use tracing::{info, warn};

use super::health::{Health, Limits, now, wall_time};
use super::publications::Publication;
use super::services::Managed;
use crate::io::counters::ByReason;

/// How often the node looks after itself.
const LOOK_EVERY: Duration = Duration::from_millis(200);
/// Looks from one report to the next, if nothing is wrong.
const LOOKS_PER_REPORT: u32 = 5;

/// Looks after the node as long as it is there.
pub async fn watch(managed: Managed) {
    let mut known: BTreeMap<String, String> = BTreeMap::new();
    let mut looks = 0;
    let mut ticks = tokio::time::interval(LOOK_EVERY);
    loop {
        ticks.tick().await;
        let limits = {
            let parameters = managed.parameters();
            Limits {
                slowest_clouds_hz: parameters.number("slowest_clouds_hz"),
                wrench_timeout_s: parameters.number("wrench_timeout_s"),
            }
        };
        let found = managed.health.lock().complaints(limits);
        let new: Vec<&String> =
            found.iter().filter(|(key, _)| !known.contains_key(*key)).map(|(_, line)| line).collect();
        new.iter().for_each(|line| warn!("{line}"));
        for (_, line) in known.iter().filter(|(key, _)| !found.contains_key(*key)) {
            info!("over: {line}");
        }
        looks += 1;
        if !new.is_empty() || looks >= LOOKS_PER_REPORT {
            looks = 0;
            let health = managed.health.lock().clone();
            managed.outputs.send(Publication::Diagnostics(report(&managed.name, &health, &found)));
        }
        known = found;
    }
}

fn report(node: &str, health: &Health, complaints: &BTreeMap<String, String>) -> DiagnosticArray {
    let bare = node.trim_start_matches('/');
    let status = |name: &str, lines: &[&String], values: Vec<KeyValue>| DiagnosticStatus {
        level: if lines.is_empty() { DiagnosticStatus::OK } else { DiagnosticStatus::WARN },
        name: format!("{bare}: {name}"),
        message: match lines {
            [] => health.state.message().label,
            lines => lines.iter().map(|line| line.as_str()).collect::<Vec<_>>().join("; "),
        },
        hardware_id: bare.to_owned(),
        values,
    };
    let about = |keys: &[&str]| -> Vec<&String> {
        complaints
            .iter()
            .filter(|(key, _)| keys.iter().any(|start| key.starts_with(start)))
            .map(|(_, line)| line)
            .collect()
    };
    let parameters = about(&["parameter "]);
    let inference = about(&["windows dropped"]);
    let inputs: Vec<&String> =
        complaints.values().filter(|line| !parameters.contains(line) && !inference.contains(line)).collect();
    let mut message = DiagnosticArray {
        status: vec![
            status("inputs", &inputs, input_values(health)),
            status("tracking", &[], tracking_values(health)),
            status("inference", &inference, inference_values(health)),
            status("parameters", &parameters, Vec::new()),
        ],
        ..DiagnosticArray::default()
    };
    message.header.stamp = wall_time();
    message
}

fn value(key: impl Into<String>, value: impl ToString) -> KeyValue {
    KeyValue { key: key.into(), value: value.to_string() }
}

fn milliseconds(time_s: f64) -> String {
    format!("{:.1}", time_s * 1e3)
}

fn input_values(health: &Health) -> Vec<KeyValue> {
    let mut values = Vec::new();
    for (name, topic) in &health.topics {
        let rate = topic.period_s.map_or(0.0, |period| 1.0 / period.max(1e-6));
        values.push(value(format!("{name} rate [Hz]"), format!("{rate:.1}")));
        values.push(value(format!("{name} received"), topic.received));
        if let Some(last) = topic.last {
            values.push(value(format!("{name} age [s]"), format!("{:.2}", now().duration_since(last).as_secs_f64())));
        }
    }
    let counters = &health.counters;
    let groups: [(&str, &ByReason); 5] = [
        ("clouds dropped", &counters.clouds_dropped),
        ("points dropped", &counters.points_dropped),
        ("wrenches dropped", &counters.wrenches_dropped),
        ("poses dropped", &counters.poses_dropped),
        ("transforms dropped", &counters.tf_dropped),
    ];
    for (group, reasons) in groups {
        values.extend(reasons.iter().map(|(reason, count)| value(format!("{group}: {reason}"), count)));
    }
    let (superseded, overflown) = &health.dropped;
    values.extend(superseded.iter().map(|(topic, count)| value(format!("{topic} dropped for newer ones"), count)));
    values.extend(overflown.iter().map(|(topic, count)| value(format!("{topic} dropped for want of room"), count)));
    values.push(value("readings waiting", health.queued.0));
    values.push(value("clouds waiting", health.queued.1));
    values.push(value("jumps of time", health.jumps.0));
    values
}

fn tracking_values(health: &Health) -> Vec<KeyValue> {
    let mut values = Vec::new();
    let all = [
        ("cloud to prediction sent", &health.latency),
        ("tracking of a cloud", &health.tracking),
        ("tracking of a cloud on the processor", &health.processor),
        ("adoption on the processor", &health.adoption),
    ];
    for (name, times) in all {
        let [median, most, longest] = times.quantiles([0.5, 0.99, 1.0]);
        values.push(value(format!("{name}, p50 [ms]"), milliseconds(median)));
        values.push(value(format!("{name}, p99 [ms]"), milliseconds(most)));
        values.push(value(format!("{name}, max [ms]"), milliseconds(longest)));
        values.push(value(format!("{name}, count"), times.count()));
    }
    if let Some(bytes) = resident_bytes() {
        values.push(value("memory [MB]", bytes / 1_000_000));
    }
    values.extend(health.sent.iter().map(|(topic, count)| value(format!("{topic} sent"), count)));
    values.extend(health.unsent.iter().map(|(reason, count)| value(format!("not sent: {reason}"), count)));
    values
}

/// Memory that the node holds; `None` where the system does not tell.
fn resident_bytes() -> Option<u64> {
    let statm = std::fs::read_to_string("/proc/self/statm").ok()?;
    let pages: u64 = statm.split_whitespace().nth(1)?.parse().ok()?;
    Some(pages * rustix::param::page_size() as u64)
}

fn inference_values(health: &Health) -> Vec<KeyValue> {
    let inference = &health.inference;
    let running_s = inference.since.map_or(0.0, |since| now().duration_since(since).as_secs_f64());
    vec![
        value("windows learned", inference.learned),
        value("windows waiting", inference.waiting),
        value("windows dropped", inference.superseded),
        value("last inference [s]", format!("{:.2}", inference.last_s)),
        value("inference running for [s]", format!("{running_s:.2}")),
    ]
}
