//! Exact draws of a tree: loop-erased random walks towards the root.
//!
//! Wilson, "Generating random spanning trees more quickly than the cover time", 1996. The walk can
//! circle for ever among parts that point strongly at each other. The cycles it erases are
//! independent of the tree it leaves (cycle popping, ibid., section 3), and the number of steps is
//! a function of those cycles, so giving up after too many steps does not bias the draw made
//! otherwise: parent by parent from the exact conditional marginals.

use nalgebra::DMatrix;
use rand::{Rng, RngExt};

use super::Tree;
use super::matrix_tree::ParentWeights;
use super::wide::Wide;

/// Steps per part before the walk gives way: about the cost of the O(N⁴) draw at N = 6.
const STEPS_PER_PART: usize = 100;

/// A draw ∝ Π φ. Some tree must have positive weight.
pub(super) fn sample(log_weights: &DMatrix<f64>, rng: &mut dyn Rng) -> Tree {
    walk(log_weights, rng).unwrap_or_else(|| parent_by_parent(log_weights, rng))
}

/// Wilson's algorithm, or none after too many steps. The largest ln φ of each column is 0.
pub(super) fn walk(log_weights: &DMatrix<f64>, rng: &mut dyn Rng) -> Option<Tree> {
    let size = log_weights.nrows();
    let weights = log_weights.map(f64::exp);
    let mut steps_left = STEPS_PER_PART * size;
    let mut in_tree = vec![false; size];
    in_tree[0] = true;
    let mut parents = vec![0; size];
    for start in 1..size {
        let mut node = start;
        while !in_tree[node] {
            steps_left = steps_left.checked_sub(1)?;
            // A later visit overwrites the parent: that erases the loop.
            parents[node] = draw_index(weights.column(node).iter().copied(), rng)?;
            node = parents[node];
        }
        let mut node = start;
        while !in_tree[node] {
            in_tree[node] = true;
            node = parents[node];
        }
    }
    Some(Tree::from_valid_parents(parents.split_off(1)))
}

/// Each part's parent from its marginal given the parents drawn before.
pub(super) fn parent_by_parent(log_weights: &DMatrix<f64>, rng: &mut dyn Rng) -> Tree {
    let size = log_weights.nrows();
    let mut weights = log_weights.map(Wide::exp);
    let mut parents = Vec::with_capacity(size - 1);
    for child in 1..size {
        let parent = ParentWeights::new(&weights, child)
            .and_then(|column| {
                let shares = column.by_parent.iter().map(|&weight| (weight / column.total).to_f64());
                draw_index(shares, rng)
            })
            .unwrap_or_else(|| unreachable!("some tree has positive weight"));
        for other in (0..size).filter(|&other| other != parent) {
            weights[(other, child)] = Wide::ZERO;
        }
        parents.push(parent);
    }
    Tree::from_valid_parents(parents)
}

/// An index drawn ∝ `weights`, never one of weight zero; none if all are.
fn draw_index(weights: impl Iterator<Item = f64> + Clone, rng: &mut dyn Rng) -> Option<usize> {
    let total: f64 = weights.clone().sum();
    let mut left = rng.random::<f64>() * total;
    let mut last_positive = None;
    for (index, weight) in weights.enumerate().filter(|&(_, weight)| weight > 0.0) {
        last_positive = Some(index);
        if left < weight {
            break;
        }
        left -= weight;
    }
    last_positive
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure::TreeDistribution;
    use rand::SeedableRng;
    use rand_chacha::ChaCha8Rng;
    use std::collections::BTreeMap;

    /// Sum over trees of (count − expected)² / expected.
    fn chi_square(distribution: &TreeDistribution, count: usize, mut draw: impl FnMut() -> Tree) -> f64 {
        let mut counts = BTreeMap::new();
        for _ in 0..count {
            *counts.entry(draw()).or_insert(0_u32) += 1;
        }
        Tree::all(distribution.part_count())
            .map(|tree| {
                let expected = distribution.log_prob(&tree).exp() * count as f64;
                let seen = f64::from(counts.get(&tree).copied().unwrap_or(0));
                (seen - expected).powi(2) / expected
            })
            .sum()
    }

    #[test]
    fn both_draws_follow_the_distribution() -> Result<(), crate::structure::StructureError> {
        let mut rng = ChaCha8Rng::seed_from_u64(5);
        let log_weights = DMatrix::from_fn(4, 4, |_, _| rng.random_range(-1.5..1.5));
        let distribution = TreeDistribution::new(&log_weights)?;
        let log_weights = distribution.log_weights();
        // 15 degrees of freedom: 37.7 is exceeded once in a thousand.
        let by_walk = chi_square(&distribution, 40_000, || sample(log_weights, &mut rng));
        assert!(by_walk < 37.7, "{by_walk}");
        let by_parents = chi_square(&distribution, 40_000, || parent_by_parent(log_weights, &mut rng));
        assert!(by_parents < 37.7, "{by_parents}");
        Ok(())
    }

    #[test]
    fn parts_that_point_at_each_other_do_not_hang() -> Result<(), crate::structure::StructureError> {
        let mut log_weights = DMatrix::from_element(3, 3, -600.0);
        log_weights[(1, 2)] = 600.0;
        log_weights[(2, 1)] = 600.0;
        log_weights[(0, 1)] = -600.0 + 3.0_f64.ln();
        let distribution = TreeDistribution::new(&log_weights)?;
        let mut rng = ChaCha8Rng::seed_from_u64(6);
        assert_eq!(walk(distribution.log_weights(), &mut rng), None);
        let on_first = (0..4000).filter(|_| distribution.sample(&mut rng).parents() == [0, 1]).count();
        // 3 : 1, four standard deviations of a binomial.
        assert!((on_first as f64 / 4000.0 - 0.75).abs() < 4.0 * (0.1875_f64 / 4000.0).sqrt());
        Ok(())
    }

    #[test]
    fn an_edge_of_weight_zero_is_never_drawn() -> Result<(), crate::structure::StructureError> {
        let mut log_weights = DMatrix::zeros(4, 4);
        log_weights[(0, 2)] = f64::NEG_INFINITY;
        let distribution = TreeDistribution::new(&log_weights)?;
        let mut rng = ChaCha8Rng::seed_from_u64(7);
        assert!((0..2000).all(|_| distribution.sample(&mut rng).parent(2) != Some(0)));
        Ok(())
    }
}
