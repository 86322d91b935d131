//! The paper's sampler of trees (3.3): a random order of the parts, a Gumbel–Softmax over the
//! parents that come before, a greedy rounding to one of them, and derivatives straight through.
//!
//! A = P U Pᵀ with a permutation P and a strictly upper triangular U, extending DP-DAG (Charpentier,
//! Kibler, Günnemann, "Differentiable DAG sampling", 2022):
//!
//! 1. Order: the root, then the parts by falling score s_i = θ_i + Gumbel noise (Plackett–Luce).
//!    Straight-through, "i before j" has the derivative of σ((s_i − s_j) / τ_P), for τ_P → 0 its
//!    law. DP-DAG's SoftSort (Prillo, Eisenschlos, 2020) acts through P_ai P_bj, flat to first
//!    order for neighbours that should change places.
//! 2. Parents: u_ij = softmax over the i before j of (γ_ij + ln π_ij) / τ. As in DP-DAG, π belongs to
//!    pairs of parts and not of positions, which keeps its meaning when the order changes.
//! 3. Opportunistic rounding: each column's first entry above δ becomes 1, all else 0; without one,
//!    the column's first non-zero entry.
//!
//! Every node but the root gets one parent, and that parent comes before it: a tree.

use nalgebra::{DMatrix, DVector};
use rand::{Rng, RngExt};
use rand_distr::Gumbel;

use crate::math::softmax;

use super::Tree;

/// Parameters of the relaxed sampler.
#[derive(Clone, Debug, PartialEq)]
pub struct GumbelParameters {
    /// θ: part j ∈ 1..=N, at index j − 1, tends to come early if large.
    pub order_logits: DVector<f64>,
    /// ln π, (N+1) × (N+1), `[(parent, child)]`.
    pub edge_logits: DMatrix<f64>,
    /// τ_P.
    pub order_temperature: f64,
    /// τ.
    pub edge_temperature: f64,
    /// δ ∈ (0, 1).
    pub threshold: f64,
}

/// A tree and the relaxation that was rounded to it.
#[derive(Clone, Debug)]
pub struct GumbelDraw {
    /// The rounded sample.
    pub tree: Tree,
    /// All nodes in their drawn order, the root first.
    pub order: Vec<usize>,
    /// U by nodes, `[(parent, child)]`: zero where the parent comes later.
    pub relaxed: DMatrix<f64>,
    /// s, per part.
    order_scores: DVector<f64>,
    /// (γ + ln π) / τ.
    edge_scores: DMatrix<f64>,
}

/// Derivatives by the parameters.
#[derive(Clone, Debug, PartialEq)]
pub struct GumbelGradient {
    /// By θ.
    pub order_logits: DVector<f64>,
    /// By ln π; zero on the diagonal and in column 0.
    pub edge_logits: DMatrix<f64>,
}

impl GumbelParameters {
    /// All logits zero, τ = τ_P = δ = ½.
    pub fn new(part_count: usize) -> Self {
        Self {
            order_logits: DVector::zeros(part_count),
            edge_logits: DMatrix::zeros(part_count + 1, part_count + 1),
            order_temperature: 0.5,
            edge_temperature: 0.5,
            threshold: 0.5,
        }
    }

    /// N.
    pub fn part_count(&self) -> usize {
        self.order_logits.len()
    }

    /// One draw.
    pub fn draw(&self, rng: &mut dyn Rng) -> GumbelDraw {
        let size = self.part_count() + 1;
        let order_scores = self.order_logits.map(|logit| logit + standard_gumbel(rng));
        let edge_scores = self.edge_logits.map(|logit| (logit + standard_gumbel(rng)) / self.edge_temperature);

        let mut order: Vec<usize> = (1..size).collect();
        order.sort_by(|&a, &b| order_scores[b - 1].total_cmp(&order_scores[a - 1]));
        order.insert(0, 0);

        let mut relaxed = DMatrix::zeros(size, size);
        let mut parents = vec![0; size - 1];
        for position in 1..size {
            let child = order[position];
            let candidates = &order[..position];
            let column = softmax(candidates.iter().map(|&parent| edge_scores[(parent, child)]));
            parents[child - 1] = candidates[opportunistic_rounding(&column, self.threshold)];
            for (&parent, value) in candidates.iter().zip(column) {
                relaxed[(parent, child)] = value;
            }
        }
        let tree = Tree::from_valid_parents(parents);
        GumbelDraw { tree, order, relaxed, order_scores, edge_scores }
    }

    /// Straight-through: carries ∂f/∂A at the rounded tree back to the parameters, as though the
    /// rounding and the sorting had been their relaxations.
    ///
    /// `by_adjacency` is (N+1) × (N+1); a constant added to a column changes nothing, as each
    /// column of A sums to one.
    pub fn straight_through(&self, draw: &GumbelDraw, by_adjacency: &DMatrix<f64>) -> GumbelGradient {
        let size = self.part_count() + 1;
        let mut edge_logits = DMatrix::zeros(size, size);
        for child in 1..size {
            let column = draw.relaxed.column(child);
            let mean = column.dot(&by_adjacency.column(child));
            for parent in (0..size).filter(|&parent| parent != child) {
                let advantage = by_adjacency[(parent, child)] - mean;
                edge_logits[(parent, child)] = column[parent] * advantage / self.edge_temperature;
            }
        }
        let by_mask = draw.gain_of_admission(by_adjacency);
        let order_logits = self.order_gradient(draw, &by_mask);
        GumbelGradient { order_logits, edge_logits }
    }

    /// Through mask_ij = σ((s_i − s_j) / τ_P).
    fn order_gradient(&self, draw: &GumbelDraw, by_mask: &DMatrix<f64>) -> DVector<f64> {
        let scores = &draw.order_scores;
        let mut gradient = DVector::zeros(self.part_count());
        for parent in 1..=self.part_count() {
            for child in (1..=self.part_count()).filter(|&child| child != parent) {
                let gap = (scores[parent - 1] - scores[child - 1]) / self.order_temperature;
                // σ' is even; with −|gap| the exponential cannot overflow.
                let decay = (-gap.abs()).exp();
                let slope = decay / (1.0 + decay).powi(2) / self.order_temperature;
                let by_gap = by_mask[(parent, child)] * slope;
                gradient[parent - 1] += by_gap;
                gradient[child - 1] -= by_gap;
            }
        }
        gradient
    }
}

impl GumbelDraw {
    /// For parts i, j the change of f(U) when the mask "i before j", which multiplies
    /// exp(score_ij) in U, goes from 0 to 1: u_ij (f_ij − mean of f over the other candidates).
    ///
    /// A difference and not the derivative at the mask's present value, which all but vanishes at
    /// u_ij ≈ 1, just where the order matters most.
    fn gain_of_admission(&self, by_adjacency: &DMatrix<f64>) -> DMatrix<f64> {
        let size = self.order.len();
        let mut gains = DMatrix::zeros(size, size);
        for (position, &child) in self.order.iter().enumerate().skip(1) {
            for parent in (1..size).filter(|&parent| parent != child) {
                // The root is always among them.
                let others = self.order[..position].iter().copied().filter(|&other| other != parent);
                let candidates = || others.clone().chain([parent]);
                let shares = softmax(candidates().map(|node| self.edge_scores[(node, child)]));
                let gain = by_adjacency[(parent, child)];
                let over_others = softmax(others.clone().map(|node| self.edge_scores[(node, child)]));
                let mean: f64 =
                    others.clone().zip(over_others).map(|(node, share)| share * by_adjacency[(node, child)]).sum();
                gains[(parent, child)] = shares[shares.len() - 1] * (gain - mean);
            }
        }
        gains
    }
}

/// Index of the first entry above `threshold`, else of the first that is not zero, else 0.
pub fn opportunistic_rounding(column: &[f64], threshold: f64) -> usize {
    let first = |limit: f64| column.iter().position(|&value| value > limit);
    first(threshold).or_else(|| first(0.0)).unwrap_or(0)
}

fn standard_gumbel(rng: &mut dyn Rng) -> f64 {
    match Gumbel::new(0.0, 1.0) {
        Ok(gumbel) => rng.sample(gumbel),
        Err(error) => unreachable!("location 0 and scale 1 are valid: {error}"),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use std::collections::BTreeSet;

    proptest! {
        #[test]
        fn every_draw_is_a_tree(
            part_count in 0..=8_usize,
            logits in prop::collection::vec(-50.0..50.0_f64, 90),
            temperature in 0.01..5.0_f64,
            threshold in 0.01..0.99_f64,
            seed: u64,
        ) {
            let mut rng = ChaCha8Rng::seed_from_u64(seed);
            let size = part_count + 1;
            let parameters = GumbelParameters {
                order_logits: DVector::from_column_slice(&logits[81..81 + part_count]),
                edge_logits: DMatrix::from_fn(size, size, |i, j| logits[9 * i + j]),
                order_temperature: temperature,
                edge_temperature: temperature,
                threshold,
            };
            let draw = parameters.draw(&mut rng);
            prop_assert!(Tree::new(draw.tree.parents().to_vec()).is_ok());
            for child in 1..size {
                prop_assert!((draw.relaxed.column(child).sum() - 1.0).abs() < 1e-12);
                prop_assert!(draw.tree.parent(child).is_some_and(|p| draw.relaxed[(p, child)] > 0.0));
            }
        }
    }

    #[test]
    fn every_tree_can_be_drawn() {
        let mut rng = ChaCha8Rng::seed_from_u64(31);
        for (part_count, draws) in [(1, 10), (2, 200), (3, 2000), (4, 20_000), (5, 300_000)] {
            let parameters = GumbelParameters::new(part_count);
            let seen: BTreeSet<Tree> = (0..draws).map(|_| parameters.draw(&mut rng).tree).collect();
            assert_eq!(seen, Tree::all(part_count).collect(), "{part_count} parts");
        }
    }

    #[test]
    fn rounding_takes_the_first_above_the_threshold() {
        assert_eq!(opportunistic_rounding(&[0.1, 0.4, 0.5], 0.3), 1);
        assert_eq!(opportunistic_rounding(&[0.3, 0.3, 0.4], 0.5), 0);
        assert_eq!(opportunistic_rounding(&[0.0, 0.4, 0.6], 0.7), 1);
    }

    /// f(U) = Σ c ∘ U is what the edge logits' derivative is exact for, the noise held fixed.
    #[test]
    fn edge_derivatives_are_those_of_the_relaxation() {
        let mut rng = ChaCha8Rng::seed_from_u64(32);
        let mut parameters = GumbelParameters::new(4);
        parameters.edge_logits = DMatrix::from_fn(5, 5, |_, _| rng.random_range(-1.0..1.0));
        let by_adjacency = DMatrix::from_fn(5, 5, |_, _| rng.random_range(-1.0..1.0));
        let value = |parameters: &GumbelParameters| {
            let draw = parameters.draw(&mut ChaCha8Rng::seed_from_u64(33));
            draw.relaxed.dot(&by_adjacency)
        };
        let draw = parameters.draw(&mut ChaCha8Rng::seed_from_u64(33));
        let gradient = parameters.straight_through(&draw, &by_adjacency);
        for child in 1..5 {
            for parent in 0..5 {
                let moved = |by: f64| {
                    let mut moved = parameters.clone();
                    moved.edge_logits[(parent, child)] += by;
                    value(&moved)
                };
                let numerical = (moved(1e-6) - moved(-1e-6)) / 2e-6;
                let error = gradient.edge_logits[(parent, child)] - numerical;
                assert!(error.abs() < 1e-8, "{parent} -> {child}: {error:e}");
            }
        }
    }

    #[test]
    fn order_derivatives_move_a_wanted_parent_forward() {
        let mut rng = ChaCha8Rng::seed_from_u64(34);
        let parameters = GumbelParameters::new(3);
        let mut by_adjacency = DMatrix::zeros(4, 4);
        by_adjacency[(2, 1)] = 1.0;
        let mut mean = DVector::zeros(3);
        for _ in 0..2000 {
            let draw = parameters.draw(&mut rng);
            mean += parameters.straight_through(&draw, &by_adjacency).order_logits / 2000.0;
        }
        assert!(mean[1] > 0.02 && mean[0] < -0.02 && mean[2].abs() < 0.02, "{mean}");
        assert!(mean.sum().abs() < 1e-12);
    }
}
