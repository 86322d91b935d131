#![allow(missing_docs, clippy::print_stdout, clippy::disallowed_methods, clippy::expect_used)]
#[path = "../tests/criticism/world.rs"]
mod world;
use bayesian_object_models::model::DeclaredPhysics;
fn main() {
    tracing_subscriber::fmt().with_env_filter(tracing_subscriber::EnvFilter::from_default_env()).without_time().with_ansi(false).init();
    let a: Vec<String> = std::env::args().collect();
    let (name, size, from, to): (&str, f64, u64, u64) = (&a[1], a[2].parse().expect("s"), a[3].parse().expect("n"), a[4].parse().expect("n"));
    for number in from..to {
        let (object, mut rng) = world::object(name, size, number);
        let count = if name.contains("brakes") { 8 } else { 5 };
        let record = world::Record::of(&object, count, &mut rng);
        let t = std::time::Instant::now();
        let (_, critic) = record.criticize(&DeclaredPhysics::default());
        let f = critic.findings(); let s = critic.selection.as_ref().expect("selection"); println!("{:?} {}", f.verdict, f.effects.iter().map(|e| format!("{} p{:.2} ~{:?} {:?}", e.name, e.probability, e.indistinguishable_from, e.parameters.iter().take(6).map(|(n,q)| format!("{n}={:.3}[{:.3},{:.3}]",q.median,q.q05,q.q95)).collect::<Vec<_>>())).collect::<Vec<_>>().join(" + ")); for (b,a) in f.before.iter().zip(&f.after) { println!("   {:?}N {:?} pos {:.4} lpd {:.1} p {:.3} -> {:?} {:?} {:.4} {:.1} {:.3}", b.force_rmse_n, b.torque_rmse_nm, b.position_rmse_m, b.log_predictive_density, b.residual_whiteness_p, a.force_rmse_n, a.torque_rmse_nm, a.position_rmse_m, a.log_predictive_density, a.residual_whiteness_p); }
        let added: Vec<String> = s.additions.iter().map(|x| format!("{x:?} {:.1}", -s.rivals.get(x).and_then(|r| r.iter().find(|r| r.0.is_none())).map_or(0.0, |r| r.1))).collect();
        println!("{name} {size} {number} {:?} ev {:.1} {:?} {:.2}s steps {}", object.undeclared, s.log_evidence, added, t.elapsed().as_secs_f64(), s.steps);
    }
}
