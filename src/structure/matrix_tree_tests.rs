//! Against sums over all trees.

use super::*;
use proptest::prelude::*;

/// (Z, P(parent→child)) by enumeration, in the wide numbers.
fn by_enumeration(log_weights: &DMatrix<f64>) -> (Wide, DMatrix<Wide>) {
    let size = log_weights.nrows();
    let weights = log_weights.map(Wide::exp);
    let mut normalizer = Wide::ZERO;
    let mut sums = DMatrix::from_element(size, size, Wide::ZERO);
    for tree in Tree::all(size - 1) {
        let weight = tree.edges().fold(Wide::ONE, |product, edge| product * weights[edge]);
        normalizer = normalizer + weight;
        for edge in tree.edges() {
            sums[edge] = sums[edge] + weight;
        }
    }
    (normalizer, sums.map(|sum| sum / normalizer))
}

/// ln φ of 0..=5 parts, weights 1e±150, some edges impossible.
fn log_weights() -> impl Strategy<Value = DMatrix<f64>> {
    let spread = prop_oneof![Just(1.0), Just(30.0), Just(345.0)];
    let entry = prop_oneof![6 => -1.0..1.0_f64, 1 => Just(f64::NEG_INFINITY)];
    (1..=6_usize, spread, prop::collection::vec(entry, 36))
        .prop_map(|(size, spread, entries)| DMatrix::from_fn(size, size, |i, j| spread * entries[6 * i + j]))
}

fn assert_relative(actual: f64, expected: f64, tolerance: f64) {
    let error = (actual - expected).abs();
    assert!(error <= tolerance * expected.abs(), "{actual:e}, expected {expected:e}");
}

proptest! {
    #[test]
    fn agrees_with_enumeration(log_weights in log_weights()) {
        // All trees impossible: covered below.
        let Ok(distribution) = TreeDistribution::new(&log_weights) else { return Ok(()) };
        let (normalizer, marginals) = by_enumeration(&log_weights);
        prop_assert!((distribution.log_normalizer() - normalizer.ln()).abs() < 1e-12 * 1700.0);
        for child in 1..log_weights.nrows() {
            for parent in 0..log_weights.nrows() {
                let expected = marginals[(parent, child)];
                // Taking off the column's largest logarithm, up to 690, rounds by 1e-13.
                assert_relative(distribution.edge_marginals()[(parent, child)], expected.to_f64(), 1e-12);
                if !expected.is_zero() {
                    let log_marginal = distribution.log_edge_marginals()[(parent, child)];
                    prop_assert!((log_marginal - expected.ln()).abs() < 2e-12);
                }
            }
        }
    }

    #[test]
    fn sums_to_one_and_has_its_entropy(log_weights in log_weights()) {
        let Ok(distribution) = TreeDistribution::new(&log_weights) else { return Ok(()) };
        let log_probs: Vec<f64> = Tree::all(distribution.part_count())
            .map(|tree| distribution.log_prob(&tree))
            .filter(|log_prob| log_prob.is_finite())
            .collect();
        let total: f64 = log_probs.iter().map(|log_prob| log_prob.exp()).sum();
        let entropy: f64 = log_probs.iter().map(|log_prob| -log_prob * log_prob.exp()).sum();
        prop_assert!((total - 1.0).abs() < 1e-11, "{total}");
        prop_assert!((distribution.entropy() - entropy).abs() < 1e-10);
    }

    #[test]
    fn relabelled_parts_get_relabelled_marginals(
        log_weights in log_weights(),
        keys in prop::collection::vec(0.0..1.0_f64, 6),
    ) {
        let Ok(distribution) = TreeDistribution::new(&log_weights) else { return Ok(()) };
        let mut relabel: Vec<usize> = (1..log_weights.nrows()).collect();
        relabel.sort_by(|&a, &b| keys[a].total_cmp(&keys[b]));
        relabel.insert(0, 0);
        let size = log_weights.nrows();
        let permuted = DMatrix::from_fn(size, size, |i, j| log_weights[(relabel[i], relabel[j])]);
        let permuted = TreeDistribution::new(&permuted)?;
        for child in 1..size {
            for parent in 0..size {
                assert_relative(
                    permuted.edge_marginals()[(parent, child)],
                    distribution.edge_marginals()[(relabel[parent], relabel[child])],
                    1e-13,
                );
            }
        }
    }

    #[test]
    fn a_column_scales_freely(log_weights in log_weights(), factor in -700.0..700.0_f64) {
        prop_assume!(log_weights.nrows() > 1);
        let Ok(distribution) = TreeDistribution::new(&log_weights) else { return Ok(()) };
        let mut scaled = log_weights.clone();
        scaled.column_mut(1).add_scalar_mut(factor);
        let scaled = TreeDistribution::new(&scaled)?;
        prop_assert!((scaled.log_normalizer() - distribution.log_normalizer() - factor).abs() < 1e-11);
        for (a, b) in scaled.edge_marginals().iter().zip(distribution.edge_marginals()) {
            assert_relative(*a, *b, 2e-12);
        }
    }
}

#[test]
fn uniform_counts_the_trees() {
    for part_count in 1..=8_usize {
        let uniform = TreeDistribution::uniform(part_count);
        let count = ((part_count + 1) as f64).powi(part_count as i32 - 1);
        assert_relative(uniform.log_normalizer().exp(), count, 1e-14);
        assert_relative(uniform.entropy().exp(), count, 1e-13);
        assert_relative(uniform.edge_marginals()[(0, 1)], 2.0 / (part_count + 1) as f64, 1e-15);
    }
}

#[test]
fn a_marginal_of_1e_minus_200_keeps_its_digits() -> Result<(), StructureError> {
    // Three trees: φ01 φ02, φ01 φ12, φ02 φ21.
    let (to_1, to_2, from_1, from_2) = (1e-200_f64, 2e-200_f64, 3.0_f64, 1e-100_f64);
    let mut log_weights = DMatrix::zeros(3, 3);
    log_weights[(0, 1)] = to_1.ln();
    log_weights[(0, 2)] = to_2.ln();
    log_weights[(1, 2)] = from_1.ln();
    log_weights[(2, 1)] = from_2.ln();
    let distribution = TreeDistribution::new(&log_weights)?;
    // Over the likeliest tree, φ01 φ12: φ02/φ12 and φ02 φ21 / (φ01 φ12).
    let star = to_2 / from_1;
    let on_second = (to_2 / to_1) * (from_2 / from_1);
    let marginals = distribution.edge_marginals();
    assert_relative(marginals[(2, 1)], on_second, 1e-12);
    assert_relative(marginals[(0, 2)], star + on_second, 1e-12);
    assert_relative(marginals[(0, 1)], 1.0, 1e-15);

    log_weights[(2, 1)] = f64::NEG_INFINITY;
    let distribution = TreeDistribution::new(&log_weights)?;
    assert_relative(distribution.edge_marginals()[(0, 2)], star, 1e-12);
    assert_eq!(distribution.edge_marginals()[(2, 1)], 0.0);
    Ok(())
}

#[test]
fn an_empty_world_has_one_tree() -> Result<(), StructureError> {
    let distribution = TreeDistribution::new(&DMatrix::zeros(1, 1))?;
    assert_eq!((distribution.log_normalizer(), distribution.entropy()), (0.0, 0.0));
    assert_eq!(distribution.most_likely(), Tree::star(0));
    assert_eq!(distribution.log_prob(&Tree::star(0)), 0.0);
    Ok(())
}

#[test]
fn weights_without_a_tree_are_refused() {
    let mut log_weights = DMatrix::zeros(4, 4);
    log_weights[(0, 1)] = f64::NEG_INFINITY;
    log_weights[(0, 2)] = f64::NEG_INFINITY;
    log_weights[(3, 1)] = f64::NEG_INFINITY;
    log_weights[(3, 2)] = f64::NEG_INFINITY;
    assert_eq!(TreeDistribution::new(&log_weights).err(), Some(StructureError::NoTree));
    log_weights[(3, 2)] = f64::NAN;
    assert!(matches!(TreeDistribution::new(&log_weights), Err(StructureError::LogWeight { parent: 3, child: 2, .. })));
    let expected = StructureError::Shape { rows: 2, columns: 3, expected: 3 };
    assert_eq!(TreeDistribution::new(&DMatrix::zeros(2, 3)).err(), Some(expected));
}
