//! A rooted tree over the body (node 0) and the parts (nodes 1..=N), and the set of all such trees.

use super::StructureError;

/// A tree with root 0 over the nodes 0..=N.
///
/// Trees order by their parents, node 1 first.
#[derive(Clone, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct Tree {
    parents: Vec<usize>,
}

impl Tree {
    /// The tree in which node j ∈ 1..=N hangs on `parents[j - 1]`.
    ///
    /// # Errors
    /// A parent beyond N, or a cycle.
    pub fn new(parents: Vec<usize>) -> Result<Self, StructureError> {
        let part_count = parents.len();
        for (index, &parent) in parents.iter().enumerate() {
            if parent > part_count {
                let child = index + 1;
                return Err(StructureError::UnknownParent { child, parent, part_count });
            }
        }
        let tree = Self { parents };
        for child in 1..=part_count {
            if tree.ancestors(child).take(part_count + 1).last() != Some(0) {
                return Err(StructureError::Cycle { child });
            }
        }
        Ok(tree)
    }

    /// Every part on the body.
    pub fn star(part_count: usize) -> Self {
        Self { parents: vec![0; part_count] }
    }

    /// Parents known to form a tree.
    pub(super) fn from_valid_parents(parents: Vec<usize>) -> Self {
        debug_assert!(Self::new(parents.clone()).is_ok(), "{parents:?} is no tree");
        Self { parents }
    }

    /// All (N+1)^(N−1) trees of N parts (Cayley), each once, in a fixed order.
    pub fn all(part_count: usize) -> AllTrees {
        AllTrees { part_count, next_code: Some(vec![0; part_count.saturating_sub(1)]) }
    }

    /// N, the number of nodes without the root.
    pub fn part_count(&self) -> usize {
        self.parents.len()
    }

    /// Parents of the nodes 1..=N.
    pub fn parents(&self) -> &[usize] {
        &self.parents
    }

    /// The parent of `node`, none for the root.
    pub fn parent(&self, node: usize) -> Option<usize> {
        node.checked_sub(1).map(|index| self.parents[index])
    }

    /// The N edges as (parent, child), by child.
    pub fn edges(&self) -> impl Iterator<Item = (usize, usize)> + '_ {
        self.parents.iter().enumerate().map(|(index, &parent)| (parent, index + 1))
    }

    /// The nodes that hang directly on `node`, ascending.
    pub fn children(&self, node: usize) -> impl Iterator<Item = usize> + '_ {
        self.edges().filter_map(move |(parent, child)| (parent == node).then_some(child))
    }

    /// Parent, grandparent, … up to the root 0; empty for the root.
    pub fn ancestors(&self, node: usize) -> impl Iterator<Item = usize> + '_ {
        std::iter::successors(self.parent(node), |&ancestor| self.parent(ancestor))
    }

    /// Whether `ancestor` lies strictly above `node`.
    pub fn is_ancestor(&self, ancestor: usize, node: usize) -> bool {
        self.ancestors(node).any(|above| above == ancestor)
    }

    /// Number of joints between `node` and the root.
    pub fn depth(&self, node: usize) -> usize {
        self.ancestors(node).count()
    }

    /// All nodes, root first, parents before children, equals by number.
    pub fn topological_order(&self) -> Vec<usize> {
        let mut order: Vec<usize> = (0..=self.part_count()).collect();
        order.sort_by_key(|&node| (self.depth(node), node));
        order
    }

    /// For every node 0..=N, how many nodes its subtree holds, itself included.
    pub fn subtree_sizes(&self) -> Vec<usize> {
        let mut sizes = vec![1; self.part_count() + 1];
        for &node in self.topological_order().iter().rev() {
            if let Some(parent) = self.parent(node) {
                sizes[parent] += sizes[node];
            }
        }
        sizes
    }

    /// This tree with `child` hung on `parent` instead; none if that makes a cycle.
    pub fn reparented(&self, child: usize, parent: usize) -> Option<Self> {
        if child == 0 || child == parent || self.is_ancestor(child, parent) {
            return None;
        }
        let mut parents = self.parents.clone();
        parents[child - 1] = parent;
        Some(Self { parents })
    }
}

/// Iterator over all trees of N parts: every Prüfer code once, decoded and rooted at 0.
#[derive(Clone, Debug)]
pub struct AllTrees {
    part_count: usize,
    next_code: Option<Vec<usize>>,
}

impl Iterator for AllTrees {
    type Item = Tree;

    fn next(&mut self) -> Option<Tree> {
        let code = self.next_code.take()?;
        let tree = decode_pruefer(&code, self.part_count);
        self.next_code = successor(code, self.part_count + 1);
        Some(tree)
    }
}

/// The next number in base `base`, most significant digit first; none after the last.
fn successor(mut digits: Vec<usize>, base: usize) -> Option<Vec<usize>> {
    for digit in digits.iter_mut().rev() {
        *digit += 1;
        if *digit < base {
            return Some(digits);
        }
        *digit = 0;
    }
    None
}

/// The labelled tree on 0..=N with this Prüfer code of length N − 1, rooted at 0.
///
/// Leaves go in the order of their labels, highest first, so 0 is never removed as a leaf: each
/// leaf's code entry is its parent towards the root.
fn decode_pruefer(code: &[usize], part_count: usize) -> Tree {
    let mut degree = vec![1; part_count + 1];
    for &node in code {
        degree[node] += 1;
    }
    let mut parents = vec![0; part_count];
    for &parent in code {
        // Two leaves always exist, so the highest leaf is not 0.
        if let Some(leaf) = (1..=part_count).rev().find(|&node| degree[node] == 1) {
            parents[leaf - 1] = parent;
            degree[leaf] = 0;
            degree[parent] -= 1;
        }
    }
    // The last two nodes are 0 and one other, whose parent stays 0.
    Tree::from_valid_parents(parents)
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::collections::BTreeSet;

    #[test]
    fn enumeration_holds_every_tree_once() {
        for (part_count, expected) in [(0, 1), (1, 1), (2, 3), (3, 16), (4, 125), (5, 1296)] {
            let trees: Vec<Tree> = Tree::all(part_count).collect();
            let distinct: BTreeSet<&Tree> = trees.iter().collect();
            assert_eq!((trees.len(), distinct.len()), (expected, expected));
            for tree in &trees {
                assert_eq!(Tree::new(tree.parents().to_vec()).as_ref(), Ok(tree));
            }
        }
        assert_eq!(Tree::all(6).count(), 16_807);
    }

    #[test]
    fn what_is_no_tree_is_refused() {
        assert_eq!(Tree::new(vec![2, 1]), Err(StructureError::Cycle { child: 1 }));
        assert_eq!(Tree::new(vec![0, 2]), Err(StructureError::Cycle { child: 2 }));
        let unknown = StructureError::UnknownParent { child: 1, parent: 3, part_count: 2 };
        assert_eq!(Tree::new(vec![3, 0]), Err(unknown));
    }

    #[test]
    fn relations_on_a_branching_tree() -> Result<(), StructureError> {
        // 0 ─ 3 ─ 1 ─ 2
        //       └ 4
        let tree = Tree::new(vec![3, 1, 0, 3])?;
        assert_eq!(tree.ancestors(2).collect::<Vec<_>>(), [1, 3, 0]);
        assert_eq!(tree.children(3).collect::<Vec<_>>(), [1, 4]);
        assert_eq!(tree.topological_order(), [0, 3, 1, 4, 2]);
        assert_eq!(tree.subtree_sizes(), [5, 2, 1, 4, 1]);
        assert!(tree.is_ancestor(3, 2) && !tree.is_ancestor(2, 3) && !tree.is_ancestor(2, 2));
        assert_eq!(tree.reparented(3, 2), None);
        assert_eq!(tree.reparented(2, 4), Some(Tree::new(vec![3, 4, 0, 3])?));
        Ok(())
    }
}
