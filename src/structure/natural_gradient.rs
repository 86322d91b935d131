//! The natural gradient of the ELBO E_q[ln p − ln q] in the ln φ of a [`TreeDistribution`].
//!
//! q is an exponential family with the edge indicators T as statistics, so the gradient is
//! Cov_q(T, f) with f = ln p − ln q, the Fisher information F = Cov_q(T, T), and the natural
//! gradient F⁻¹ Cov_q(T, f) is the linear regression of f on T under q (Salimans, Knowles,
//! "Fixed-form variational posterior approximation through stochastic linear regression", 2013).
//! Where ln p is a sum over edges, f is linear in T and a step of rate one ends at p, whether the
//! regression sees all trees or only enough draws.
//!
//! F is singular, as ln φ has one free constant per column; the gradient is fixed by having mean
//! zero under q in each column.

use nalgebra::{DMatrix, DVector};

use super::{StructureError, Tree, TreeDistribution, TreeTarget};

/// Directions whose share of the largest eigenvalue of the scaled F is lower are rounding noise:
/// sums of up to 16 807 products, each off by 1e-16.
const RELATIVE_EIGENVALUE_FLOOR: f64 = 1e-12;

/// A tree, its weight in the regression, and f = ln p − ln q there.
struct Case {
    tree: Tree,
    weight: f64,
    log_ratio: f64,
}

/// ln p − ln q per edge, for ln p = Σ_edges `scores`; 0 where q has no such edge.
pub fn natural_gradient_of_edge_scores(distribution: &TreeDistribution, scores: &DMatrix<f64>) -> DMatrix<f64> {
    scores.zip_map(
        distribution.log_weights(),
        |score, log_weight| {
            if log_weight.is_finite() { score - log_weight } else { 0.0 }
        },
    )
}

/// Exact for any target, from all (N+1)^(N−1) trees.
///
/// # Errors
/// The target is not finite at a tree that q can draw.
pub fn natural_gradient_by_enumeration(
    distribution: &TreeDistribution,
    target: &dyn TreeTarget,
) -> Result<DMatrix<f64>, StructureError> {
    let mut cases = Vec::new();
    for tree in Tree::all(distribution.part_count()) {
        let weight = distribution.log_prob(&tree).exp();
        if weight > 0.0 {
            let log_ratio = log_ratio(distribution, target, &tree)?;
            cases.push(Case { tree, weight, log_ratio });
        }
    }
    Ok(regress(distribution, &cases))
}

/// Estimated from `count` exact draws; edges not drawn get 0. Also returns the mean of f, which
/// estimates the ELBO.
///
/// # Errors
/// The target is not finite at a tree drawn.
pub fn natural_gradient_by_samples(
    distribution: &TreeDistribution,
    target: &dyn TreeTarget,
    count: usize,
    rng: &mut dyn rand::Rng,
) -> Result<(DMatrix<f64>, f64), StructureError> {
    let weight = 1.0 / count.max(1) as f64;
    let mut cases = Vec::with_capacity(count);
    for _ in 0..count {
        let tree = distribution.sample(rng);
        let log_ratio = log_ratio(distribution, target, &tree)?;
        cases.push(Case { tree, weight, log_ratio });
    }
    let elbo = cases.iter().map(|case| case.weight * case.log_ratio).sum();
    Ok((regress(distribution, &cases), elbo))
}

/// E_q[ln p − ln q] over all trees: ln Σ p minus the divergence of q from the normalized p.
///
/// # Errors
/// The target is not finite at a tree that q can draw.
pub fn exact_elbo(distribution: &TreeDistribution, target: &dyn TreeTarget) -> Result<f64, StructureError> {
    let mut elbo = 0.0;
    for tree in Tree::all(distribution.part_count()) {
        let probability = distribution.log_prob(&tree).exp();
        if probability > 0.0 {
            elbo += probability * log_ratio(distribution, target, &tree)?;
        }
    }
    Ok(elbo)
}

fn log_ratio(distribution: &TreeDistribution, target: &dyn TreeTarget, tree: &Tree) -> Result<f64, StructureError> {
    let log_density = target.log_density(tree);
    if !log_density.is_finite() {
        return Err(StructureError::LogDensity { parents: tree.parents().to_vec(), log_density });
    }
    Ok(log_density - distribution.log_prob(tree))
}

/// Weighted least squares of f on the edge indicators, with an intercept.
fn regress(distribution: &TreeDistribution, cases: &[Case]) -> DMatrix<f64> {
    let size = distribution.part_count() + 1;
    let total: f64 = cases.iter().map(|case| case.weight).sum();
    let mut share = DMatrix::zeros(size, size);
    let mut mean_log_ratio = 0.0;
    for case in cases {
        let weight = case.weight / total;
        mean_log_ratio += weight * case.log_ratio;
        for edge in case.tree.edges() {
            share[edge] += weight;
        }
    }

    // Each column's likeliest edge is the reference that the others are measured against.
    let mut coordinate = DMatrix::from_element(size, size, None);
    let mut free = Vec::new();
    for child in 1..size {
        let reference = share.column(child).imax();
        for parent in (0..size).filter(|&parent| parent != reference) {
            if share[(parent, child)] > 0.0 {
                coordinate[(parent, child)] = Some(free.len());
                free.push((parent, child));
            }
        }
    }

    let means = DVector::from_iterator(free.len(), free.iter().map(|&edge| share[edge]));
    let mut information = DMatrix::zeros(free.len(), free.len());
    let mut gradient = DVector::zeros(free.len());
    for case in cases {
        let mut indicator = -&means;
        for index in case.tree.edges().filter_map(|edge| coordinate[edge]) {
            indicator[index] += 1.0;
        }
        let weight = case.weight / total;
        information.ger(weight, &indicator, &indicator, 1.0);
        gradient.axpy(weight * (case.log_ratio - mean_log_ratio), &indicator, 1.0);
    }

    let solution = solve_scaled(information, gradient);
    let mut step = DMatrix::zeros(size, size);
    for (index, &edge) in free.iter().enumerate() {
        step[edge] = solution[index];
    }
    for child in 1..size {
        let mean = share.column(child).dot(&step.column(child));
        for parent in 0..size {
            if share[(parent, child)] > 0.0 {
                step[(parent, child)] -= mean;
            }
        }
    }
    step
}

/// F⁺ g with F scaled to a unit diagonal first, so that rare edges count as much as common ones.
fn solve_scaled(mut information: DMatrix<f64>, mut gradient: DVector<f64>) -> DVector<f64> {
    if gradient.is_empty() {
        return gradient;
    }
    let scale = information.diagonal().map(|variance| if variance > 0.0 { 1.0 / variance.sqrt() } else { 0.0 });
    gradient.component_mul_assign(&scale);
    for (mut column, &factor) in information.column_iter_mut().zip(scale.iter()) {
        column.component_mul_assign(&scale);
        column *= factor;
    }
    let eigen = information.symmetric_eigen();
    let floor = RELATIVE_EIGENVALUE_FLOOR * eigen.eigenvalues.max();
    let mut coordinates = eigen.eigenvectors.tr_mul(&gradient);
    for (coordinate, &eigenvalue) in coordinates.iter_mut().zip(eigen.eigenvalues.iter()) {
        *coordinate = if eigenvalue > floor { *coordinate / eigenvalue } else { 0.0 };
    }
    (eigen.eigenvectors * coordinates).component_mul(&scale)
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure::EdgeScores;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    fn random_weights(size: usize, spread: f64, rng: &mut ChaCha8Rng) -> DMatrix<f64> {
        DMatrix::from_fn(size, size, |_, _| rng.random_range(-spread..spread))
    }

    fn largest_difference(a: &DMatrix<f64>, b: &DMatrix<f64>) -> f64 {
        (a - b).abs().max()
    }

    fn stepped(from: &TreeDistribution, step: &DMatrix<f64>) -> Result<TreeDistribution, StructureError> {
        TreeDistribution::new(&(from.log_weights() + step))
    }

    #[test]
    fn one_step_reaches_a_target_that_is_a_sum_over_edges() -> Result<(), StructureError> {
        let mut rng = ChaCha8Rng::seed_from_u64(11);
        for size in 2..=6 {
            let start = TreeDistribution::new(&random_weights(size, 2.0, &mut rng))?;
            let scores = random_weights(size, 3.0, &mut rng);
            let goal = TreeDistribution::new(&scores)?;
            let target = EdgeScores(scores);
            let steps = [
                natural_gradient_of_edge_scores(&start, &target.0),
                natural_gradient_by_enumeration(&start, &target)?,
                natural_gradient_by_samples(&start, &target, 20_000, &mut rng)?.0,
            ];
            for step in steps {
                let reached = stepped(&start, &step)?;
                let error = largest_difference(reached.edge_marginals(), goal.edge_marginals());
                assert!(error < 1e-9, "{} parts: {error:e}", size - 1);
            }
        }
        Ok(())
    }

    #[test]
    fn times_the_information_it_is_the_gradient() -> Result<(), StructureError> {
        let mut rng = ChaCha8Rng::seed_from_u64(12);
        let here = TreeDistribution::new(&random_weights(4, 1.0, &mut rng))?;
        // Not a sum over edges.
        let target = |tree: &Tree| (0..=3).map(|node| (tree.depth(node) as f64).powi(2)).sum::<f64>();
        let natural = natural_gradient_by_enumeration(&here, &target)?;
        for edge in [(0, 1), (2, 1), (3, 2), (0, 3)] {
            let moved = |by: f64| -> Result<f64, StructureError> {
                let mut log_weights = here.log_weights().clone();
                log_weights[edge] += by;
                exact_elbo(&TreeDistribution::new(&log_weights)?, &target)
            };
            let numerical = (moved(1e-5)? - moved(-1e-5)?) / 2e-5;
            // Row `edge` of F times the natural gradient: Cov(T_edge, Σ T · natural).
            let mut covariance = 0.0;
            for tree in Tree::all(3) {
                let indicator = f64::from(tree.parent(edge.1) == Some(edge.0));
                let along: f64 = tree.edges().map(|other| natural[other]).sum();
                let centred = indicator - here.edge_marginals()[edge];
                covariance += here.log_prob(&tree).exp() * centred * along;
            }
            assert!((covariance - numerical).abs() < 1e-7, "{covariance} {numerical}");
        }
        Ok(())
    }

    #[test]
    fn a_target_without_value_is_reported() -> Result<(), StructureError> {
        let target = |tree: &Tree| {
            if tree.depth(1) > 1 { f64::NEG_INFINITY } else { 0.0 }
        };
        let result = natural_gradient_by_enumeration(&TreeDistribution::uniform(2), &target);
        let expected = StructureError::LogDensity { parents: vec![2, 0], log_density: f64::NEG_INFINITY };
        assert_eq!(result.err(), Some(expected));
        Ok(())
    }
}
