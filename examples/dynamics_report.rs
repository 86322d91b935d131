//! Measures the dynamics: replays a bag and writes posterior.json with what it learned of friction,
//! damping and inertia, and the time that took.
#![allow(clippy::unwrap_used)]
use std::path::PathBuf;
use bayesian_object_models::{io::{bag::Bag, config::Config, ingest::Ingest}, pipeline::{Output, Pipeline, PipelineSettings, WindowSettings}, types::Label};
fn main() {
    tracing_subscriber::fmt().with_env_filter(tracing_subscriber::EnvFilter::from_default_env()).with_writer(std::io::stderr).without_time().init();
    let args: Vec<String> = std::env::args().collect();
    let path = PathBuf::from(&args[2]);
    let get = |n: &str| args.iter().position(|a| a == n).map(|i| args[i + 1].clone());
    let root = get("--root-label").map(|s| Label(s.parse().unwrap()));
    let config = Config::default();
    let mut ingest = Ingest::new(&config.input);
    let mut pipeline = Pipeline::new(PipelineSettings { root, use_tool: std::env::var("NOTOOL").is_err(), windows: WindowSettings::default() });
    let handle = |o: Output| if let Output::Learned { span_s } = o { tracing::info!(?span_s, "learned") };
    for m in Bag::open(&path).unwrap() {
        for i in ingest.push(&m.topic.name, &m.topic.type_name, m.bytes()) { pipeline.push(i).into_iter().for_each(handle); }
    }
    for i in ingest.flush() { pipeline.push(i).into_iter().for_each(handle); }
    pipeline.finish().into_iter().for_each(handle);
    let l = pipeline.learner().unwrap();
    let mut edges = vec![];
    let dynamics = l.dynamics.posterior();
    if let Err(e) = &dynamics { tracing::warn!("{e}"); }
    if let Some(fit) = &l.fit { for (k, j) in fit.joints.iter().enumerate() {
        let p = j.parent.map_or(l.root, |p| fit.joints[p].child);
        let o = fit.axis_offset(k); let n = j.axis_parameters();
        let cov: Vec<Vec<f64>> = (0..n).map(|a| (0..n).map(|b| fit.covariance[(o + a, o + b)]).collect()).collect();
        let ax = serde_json::json!({"axis_direction": j.axis.direction.as_slice(), "axis_point_m": j.axis.point.as_slice(), "covariance": cov});
        let t = j.joint_type.name();
        edges.push(serde_json::json!({"parent": p.0, "child": j.child.0, "probability": 1.0, "joint_type": {"rigid": if t=="rigid" {1.0} else {0.0}, "prismatic": if t=="prismatic" {1.0} else {0.0}, "revolute": if t=="revolute" {1.0} else {0.0}}, t: ax}));
        if let Ok(d) = &dynamics && let Some(j) = d.joints.iter().find(|d| d.label == j.child) && let Some(e) = edges.last_mut() {
            e["damping"] = serde_json::json!(j.damping); e["friction"] = serde_json::json!(j.friction); e["joint_inertia"] = serde_json::json!(j.joint_inertia);
            e["lower_limit"] = serde_json::json!(j.lower_limit); e["upper_limit"] = serde_json::json!(j.upper_limit);
        }
    } tracing::info!(offset=?fit.tool_offset.as_slice(), "tool"); }
    let out = serde_json::json!({"schema":"bom.posterior/1","root_label": l.root.0, "parts": [], "edges": edges, "windows": l.inferences.iter().zip(&l.dynamics_wall_s).map(|(i, w)| serde_json::json!({"steps": i.steps, "inference_wall_s": w, "elbo": i.elbo, "log_predictive_density": i.log_predictive_density, "noise_scale": i.noise_scale, "observations": i.observations, "failure": i.failure.map(|f| f.to_string())})).collect::<Vec<_>>(), "criticism": {"verdict":"insufficient","effects":[]}});
    if let Some(p) = get("--posterior") { std::fs::write(p, out.to_string()).unwrap(); }
}
