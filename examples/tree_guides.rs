//! Compares the guides over trees: divergence from the exact posterior against steps and time.
//!
//! `cargo run --release --example tree_guides`; the table is in `docs/structure.md`.
#![allow(clippy::print_stdout, reason = "the table is what this program is for")]
#![allow(clippy::disallowed_methods, reason = "it times what it compares")]

use std::collections::BTreeMap;
use std::time::{Duration, Instant};

use anyhow::Result;
use bayesian_object_models::structure::{
    EdgeScores, GumbelFitSettings, GumbelGuide, MatrixTreeGuide, Tree, TreeGuide, TreeTarget,
};
use nalgebra::DMatrix;
use rand::{RngExt, SeedableRng};
use rand_chacha::ChaCha8Rng;
use rand_distr::StandardNormal;

const SEEDS: u64 = 3;
/// Draws behind the histogram of a guide without a density.
const HISTOGRAM_DRAWS: u32 = 400_000;
/// Standard deviation of the edge scores \[nats\].
const SCORE_SPREAD: f64 = 2.0;
/// Standard deviation of what each tree has beyond its edges \[nats\].
const INTERACTION_SPREAD: f64 = 1.0;

fn main() -> Result<()> {
    println!("| N | target | guide | steps | KL(q ‖ p), nats | time, ms |");
    println!("|--:|---|---|--:|--:|--:|");
    for part_count in 3..=6 {
        for spread in [0.0, INTERACTION_SPREAD] {
            compare(part_count, spread)?;
        }
    }
    Ok(())
}

/// ln p = Σ edge scores + an independent normal per tree.
struct Table {
    log_densities: BTreeMap<Tree, f64>,
    log_evidence: f64,
}

impl Table {
    fn random(part_count: usize, interaction_spread: f64, rng: &mut ChaCha8Rng) -> Self {
        let size = part_count + 1;
        let mut normal = || rng.sample::<f64, _>(StandardNormal);
        let scores = EdgeScores(DMatrix::from_fn(size, size, |_, _| SCORE_SPREAD * normal()));
        let log_densities: BTreeMap<Tree, f64> = Tree::all(part_count)
            .map(|tree| {
                let log_density = scores.log_density(&tree) + interaction_spread * normal();
                (tree, log_density)
            })
            .collect();
        let log_evidence = log_densities.values().map(|value| value.exp()).sum::<f64>().ln();
        Self { log_densities, log_evidence }
    }

    /// KL(q ‖ p), exact where the guide has a density, else from a histogram with the bias of
    /// Miller and Madow (seen − 1) / (2 draws) taken off.
    fn divergence(&self, guide: &dyn TreeGuide, rng: &mut ChaCha8Rng) -> f64 {
        let log_ratio = |tree: &Tree, log_prob: f64| log_prob - self.log_density(tree) + self.log_evidence;
        if guide.log_prob(&Tree::star(guide.part_count())).is_some() {
            let trees = self.log_densities.keys();
            return trees
                .filter_map(|tree| guide.log_prob(tree).map(|log_prob| (tree, log_prob)))
                .filter(|(_, log_prob)| log_prob.is_finite())
                .map(|(tree, log_prob)| log_prob.exp() * log_ratio(tree, log_prob))
                .sum();
        }
        let mut counts = BTreeMap::new();
        for _ in 0..HISTOGRAM_DRAWS {
            *counts.entry(guide.sample(rng)).or_insert(0_u32) += 1;
        }
        let draws = f64::from(HISTOGRAM_DRAWS);
        let plug_in: f64 = counts
            .iter()
            .map(|(tree, &count)| {
                let share = f64::from(count) / draws;
                share * log_ratio(tree, share.ln())
            })
            .sum();
        plug_in - (counts.len() as f64 - 1.0) / (2.0 * draws)
    }
}

impl TreeTarget for Table {
    fn log_density(&self, tree: &Tree) -> f64 {
        self.log_densities.get(tree).copied().unwrap_or(f64::NEG_INFINITY)
    }
}

type MakeGuide = fn(usize) -> Box<dyn TreeGuide>;

fn enumerated(part_count: usize) -> Box<dyn TreeGuide> {
    Box::new(MatrixTreeGuide::uniform(part_count))
}

fn sampled(part_count: usize) -> Box<dyn TreeGuide> {
    Box::new(MatrixTreeGuide { enumerate_up_to: 0, rate: 0.5, ..MatrixTreeGuide::uniform(part_count) })
}

fn gumbel(part_count: usize) -> Box<dyn TreeGuide> {
    Box::new(GumbelGuide::new(part_count, GumbelFitSettings::default()))
}

fn gumbel_cold(part_count: usize) -> Box<dyn TreeGuide> {
    let mut guide = GumbelGuide::new(part_count, GumbelFitSettings::default());
    guide.parameters.edge_temperature = 0.2;
    Box::new(guide)
}

fn compare(part_count: usize, interaction_spread: f64) -> Result<()> {
    let label = if interaction_spread > 0.0 { "edges + interactions" } else { "sum over edges" };
    let guides: [(&str, MakeGuide, &[u32]); 4] = [
        ("matrix-tree, all trees", enumerated, &[0, 1, 3, 10]),
        ("matrix-tree, 16 N² draws", sampled, &[1, 3, 10, 30]),
        ("Gumbel, τ = 0.5", gumbel, &[0, 100, 300, 1000, 3000]),
        ("Gumbel, τ = 0.2", gumbel_cold, &[1000, 3000]),
    ];
    for (name, make, checkpoints) in guides {
        let mut divergences = vec![0.0; checkpoints.len()];
        let mut times = vec![Duration::ZERO; checkpoints.len()];
        for seed in 0..SEEDS {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let table = Table::random(part_count, interaction_spread, &mut rng);
            let mut guide = make(part_count);
            let mut elapsed = Duration::ZERO;
            let mut done = 0;
            for (index, &steps) in checkpoints.iter().enumerate() {
                let start = Instant::now();
                for _ in done..steps {
                    guide.step(&table, &mut rng)?;
                }
                elapsed += start.elapsed();
                done = steps;
                divergences[index] += table.divergence(guide.as_ref(), &mut rng) / SEEDS as f64;
                times[index] += elapsed / SEEDS as u32;
            }
        }
        for ((steps, divergence), time) in checkpoints.iter().zip(divergences).zip(times) {
            let milliseconds = time.as_secs_f64() * 1e3;
            println!("| {part_count} | {label} | {name} | {steps} | {divergence:.2e} | {milliseconds:.1} |");
        }
    }
    Ok(())
}
