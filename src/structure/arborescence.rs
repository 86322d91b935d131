//! The tree of greatest weight: Chu–Liu/Edmonds.
//!
//! Edmonds, "Optimum branchings", 1967: give every node its best parent; contract a cycle, with
//! each edge into it priced at what it costs to break the cycle there; solve; expand. O(N³).

use nalgebra::DMatrix;

use super::Tree;

/// A tree that maximizes Σ ln φ(parent→child). Some tree must have finite weight.
///
/// Equal weights go to the lower parent.
pub(super) fn maximum(log_weights: &DMatrix<f64>) -> Tree {
    Tree::from_valid_parents(best_parents(log_weights).split_off(1))
}

/// Parents of all nodes; the root's own is 0.
fn best_parents(weights: &DMatrix<f64>) -> Vec<usize> {
    let size = weights.nrows();
    let mut parents = vec![0; size];
    for child in 1..size {
        for parent in (1..size).filter(|&parent| parent != child) {
            if weights[(parent, child)] > weights[(parents[child], child)] {
                parents[child] = parent;
            }
        }
    }
    let Some(in_cycle) = find_cycle(&parents) else {
        return parents;
    };

    // Nodes outside the cycle keep their order, so the root stays 0; the cycle becomes the last.
    let outside: Vec<usize> = (0..size).filter(|&node| !in_cycle[node]).collect();
    let cycle: Vec<usize> = (0..size).filter(|&node| in_cycle[node]).collect();
    let contracted = outside.len();
    let mut smaller = DMatrix::from_element(contracted + 1, contracted + 1, f64::NEG_INFINITY);
    let mut entry = vec![cycle[0]; contracted];
    let mut exit = vec![cycle[0]; contracted];
    for (row, &parent) in outside.iter().enumerate() {
        for (column, &child) in outside.iter().enumerate().filter(|&(column, _)| column != row) {
            smaller[(row, column)] = weights[(parent, child)];
        }
        for &node in &cycle {
            let into_cycle = weights[(parent, node)] - weights[(parents[node], node)];
            if into_cycle > smaller[(row, contracted)] {
                smaller[(row, contracted)] = into_cycle;
                entry[row] = node;
            }
            if weights[(node, parent)] > smaller[(contracted, row)] {
                smaller[(contracted, row)] = weights[(node, parent)];
                exit[row] = node;
            }
        }
    }

    let smaller_parents = best_parents(&smaller);
    for (column, &child) in outside.iter().enumerate().skip(1) {
        let parent = smaller_parents[column];
        parents[child] = if parent == contracted { exit[column] } else { outside[parent] };
    }
    let row = smaller_parents[contracted];
    parents[entry[row]] = outside[row];
    parents
}

/// Which nodes lie on one cycle of the parent map, if it has any.
fn find_cycle(parents: &[usize]) -> Option<Vec<bool>> {
    for start in 1..parents.len() {
        // After as many steps as there are nodes the walk is at the root or on a cycle.
        let on_cycle = (0..parents.len()).fold(start, |node, _| parents[node]);
        if on_cycle != 0 {
            let mut in_cycle = vec![false; parents.len()];
            let mut node = on_cycle;
            while !in_cycle[node] {
                in_cycle[node] = true;
                node = parents[node];
            }
            return Some(in_cycle);
        }
    }
    None
}

#[cfg(test)]
mod tests {
    use super::*;
    use proptest::prelude::*;

    fn weight(weights: &DMatrix<f64>, tree: &Tree) -> f64 {
        tree.edges().map(|edge| weights[edge]).sum()
    }

    proptest! {
        #[test]
        fn no_tree_weighs_more(
            part_count in 1..=5_usize,
            entries in prop::collection::vec(
                prop_oneof![4 => -9.0..0.0_f64, 1 => Just(f64::NEG_INFINITY)], 36),
        ) {
            let size = part_count + 1;
            let weights = DMatrix::from_fn(size, size, |i, j| entries[6 * i + j]);
            let best = Tree::all(part_count)
                .map(|tree| weight(&weights, &tree))
                .fold(f64::NEG_INFINITY, f64::max);
            prop_assume!(best.is_finite());
            prop_assert!((weight(&weights, &maximum(&weights)) - best).abs() < 1e-12);
        }
    }
}
