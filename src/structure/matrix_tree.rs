//! The edge-factored distribution over trees, q(G) = Π φ(parent→child) / Z, exact.
//!
//! The matrix-tree theorem gives Z = det L, and P(i→j) = φ_ij (L⁻¹_jj − L⁻¹_ji), a difference that
//! loses all digits once weights span many orders. Here nothing is ever subtracted: read as a
//! Markov chain that steps from a part to its parent with probability ∝ φ,
//!
//! P(i→j) = φ_ij h_i / Σ_m φ_mj h_m,   Z = Z_j Σ_m φ_mj h_m,
//!
//! where h_i is the probability that the chain from i reaches the root before j, and Z_j the weight
//! of all forests rooted at {0, j}. Both follow from eliminating the other parts one by one
//! (Grassmann, Taksar, Heyman, "Regenerative analysis and steady state distributions for Markov
//! chains", 1985). O(N⁴) for all edges.

use nalgebra::DMatrix;

use super::wide::Wide;
use super::{StructureError, Tree, arborescence, wilson};

/// A distribution over the trees of N parts with one weight φ(parent→child) ≥ 0 per edge.
///
/// A common factor on all edges into one child changes nothing.
#[derive(Clone, Debug)]
pub struct TreeDistribution {
    /// ln φ, each column's largest entry 0; −∞ on the diagonal and in column 0.
    log_weights: DMatrix<f64>,
    /// What was taken off all columns together.
    log_scale: f64,
    /// ln Σ_G Π φ for the scaled weights.
    log_normalizer: f64,
    log_marginals: DMatrix<f64>,
    marginals: DMatrix<f64>,
}

impl TreeDistribution {
    /// From ln φ, (N+1) × (N+1), −∞ for an edge that cannot be.
    ///
    /// # Errors
    /// A matrix that is not square or empty, a weight that is NaN or +∞, no tree of positive weight.
    pub fn new(log_weights: &DMatrix<f64>) -> Result<Self, StructureError> {
        let (log_weights, log_scale) = scale_columns(log_weights)?;
        let size = log_weights.nrows();
        let weights = log_weights.map(Wide::exp);
        let mut log_normalizer = 0.0;
        let mut log_marginals = DMatrix::from_element(size, size, f64::NEG_INFINITY);
        let mut marginals = DMatrix::zeros(size, size);
        for child in 1..size {
            let column = ParentWeights::new(&weights, child).ok_or(StructureError::NoTree)?;
            for parent in 0..size {
                let probability = column.by_parent[parent] / column.total;
                marginals[(parent, child)] = probability.to_f64().min(1.0);
                log_marginals[(parent, child)] = probability.ln().min(0.0);
            }
            // Every child gives the same Z.
            log_normalizer = (column.forests * column.total).ln();
        }
        Ok(Self { log_weights, log_scale, log_normalizer, log_marginals, marginals })
    }

    /// The uniform distribution over all trees, the prior (paper, 3.2).
    pub fn uniform(part_count: usize) -> Self {
        let size = part_count + 1;
        match Self::new(&DMatrix::zeros(size, size)) {
            Ok(uniform) => uniform,
            Err(error) => unreachable!("unit weights admit every tree: {error}"),
        }
    }

    /// N.
    pub fn part_count(&self) -> usize {
        self.log_weights.nrows() - 1
    }

    /// ln φ with each column scaled to a largest entry of 0; −∞ on the diagonal and in column 0.
    pub fn log_weights(&self) -> &DMatrix<f64> {
        &self.log_weights
    }

    /// ln Z of the weights as they were given.
    pub fn log_normalizer(&self) -> f64 {
        self.log_normalizer + self.log_scale
    }

    /// P(parent→child); every column but 0 sums to one.
    pub fn edge_marginals(&self) -> &DMatrix<f64> {
        &self.marginals
    }

    /// ln P(parent→child), finite also where the probability underflows.
    pub fn log_edge_marginals(&self) -> &DMatrix<f64> {
        &self.log_marginals
    }

    /// ln q(tree), −∞ where some edge has weight zero.
    ///
    /// The tree must have as many parts as the distribution.
    pub fn log_prob(&self, tree: &Tree) -> f64 {
        tree.edges().map(|edge| self.log_weights[edge]).sum::<f64>() - self.log_normalizer
    }

    /// −Σ q ln q in nats.
    pub fn entropy(&self) -> f64 {
        // Absolute error about 1e-16 times the largest |ln φ| of a likely edge.
        (self.log_normalizer - self.expectation(&self.log_weights)).max(0.0)
    }

    /// E_q[Σ_edges score], edges of probability zero left out.
    pub fn expectation(&self, scores: &DMatrix<f64>) -> f64 {
        let terms = self.marginals.iter().zip(scores.iter());
        terms.filter(|(marginal, _)| **marginal > 0.0).map(|(marginal, score)| marginal * score).sum()
    }

    /// A most likely tree (Chu–Liu/Edmonds).
    pub fn most_likely(&self) -> Tree {
        arborescence::maximum(&self.log_weights)
    }

    /// An exact draw, by Wilson's algorithm.
    pub fn sample(&self, rng: &mut dyn rand::Rng) -> Tree {
        wilson::sample(&self.log_weights, rng)
    }
}

/// Edges into one child: φ_ij h_i for each parent i, their sum, and the forests Z_j.
pub(super) struct ParentWeights {
    pub(super) by_parent: Vec<Wide>,
    pub(super) total: Wide,
    forests: Wide,
}

impl ParentWeights {
    /// None where no tree has positive weight.
    pub(super) fn new(weights: &DMatrix<Wide>, child: usize) -> Option<Self> {
        let size = weights.nrows();
        let mut reduced = weights.clone();
        let eliminated: Vec<usize> = (1..size).filter(|&node| node != child).collect();
        let mut step_totals = Vec::with_capacity(eliminated.len());
        let mut forests = Wide::ONE;
        for (step, &node) in eliminated.iter().enumerate() {
            let later = &eliminated[step + 1..];
            let remaining = || [0, child].into_iter().chain(later.iter().copied());
            let total: Wide = remaining().map(|parent| reduced[(parent, node)]).sum();
            if total.is_zero() {
                return None;
            }
            for &other in later {
                let share = reduced[(node, other)] / total;
                for parent in remaining().filter(|&parent| parent != other) {
                    let detour = share * reduced[(parent, node)];
                    reduced[(parent, other)] = reduced[(parent, other)] + detour;
                }
            }
            forests = forests * total;
            step_totals.push(total);
        }
        let mut reaches_root = vec![Wide::ZERO; size];
        reaches_root[0] = Wide::ONE;
        for (step, &node) in eliminated.iter().enumerate().rev() {
            let later = eliminated[step + 1..].iter().copied();
            let towards_root: Wide =
                std::iter::once(0).chain(later).map(|parent| reduced[(parent, node)] * reaches_root[parent]).sum();
            reaches_root[node] = towards_root / step_totals[step];
        }
        let by_parent: Vec<Wide> = (0..size).map(|parent| weights[(parent, child)] * reaches_root[parent]).collect();
        let total: Wide = by_parent.iter().copied().sum();
        (!total.is_zero()).then_some(Self { by_parent, total, forests })
    }
}

/// Each column with its largest entry taken off, and the sum of what was taken.
fn scale_columns(log_weights: &DMatrix<f64>) -> Result<(DMatrix<f64>, f64), StructureError> {
    let (rows, columns) = log_weights.shape();
    if rows != columns || rows == 0 {
        return Err(StructureError::Shape { rows, columns, expected: columns.max(1) });
    }
    let mut scaled = DMatrix::from_element(rows, rows, f64::NEG_INFINITY);
    let mut log_scale = 0.0;
    for child in 1..rows {
        let mut largest = f64::NEG_INFINITY;
        for parent in (0..rows).filter(|&parent| parent != child) {
            let log_weight = log_weights[(parent, child)];
            if log_weight.is_nan() || log_weight == f64::INFINITY {
                return Err(StructureError::LogWeight { parent, child, log_weight });
            }
            largest = largest.max(log_weight);
        }
        if largest == f64::NEG_INFINITY {
            return Err(StructureError::NoTree);
        }
        for parent in (0..rows).filter(|&parent| parent != child) {
            scaled[(parent, child)] = log_weights[(parent, child)] - largest;
        }
        log_scale += largest;
    }
    Ok((scaled, log_scale))
}

#[cfg(test)]
#[path = "matrix_tree_tests.rs"]
mod tests;
