//! Distributions over kinematic trees: which part hangs on which.
//!
//! Parts are nodes 1..=N, the fixed body is node 0, and an edge parent → child is a joint. Matrices
//! over edges are (N+1) × (N+1), indexed `[(parent, child)]`; column 0 and the diagonal stand for
//! edges that no tree has, and are ignored when read.
//!
//! The uniform prior over all (N+1)^(N−1) trees (paper, 3.2) has log density 0 up to a constant.
//! Two guides stand behind [`TreeGuide`]: [`MatrixTreeGuide`], exact by the matrix-tree theorem, and
//! [`GumbelGuide`], the paper's relaxed sampler (3.3); `docs/structure.md` compares them.

mod arborescence;
mod guide;
mod gumbel;
mod gumbel_fit;
mod matrix_tree;
mod natural_gradient;
mod tree;
mod wide;
mod wilson;

pub use guide::{EdgeScores, FitStep, MatrixTreeGuide, TreeGuide, TreeTarget};
pub use gumbel::{GumbelDraw, GumbelGradient, GumbelParameters, opportunistic_rounding};
pub use gumbel_fit::{GumbelFitSettings, GumbelGuide};
pub use matrix_tree::TreeDistribution;
pub use natural_gradient::{
    exact_elbo, natural_gradient_by_enumeration, natural_gradient_by_samples, natural_gradient_of_edge_scores,
};
pub use tree::{AllTrees, Tree};

/// Why a tree or a distribution over trees could not be made.
#[derive(Clone, Debug, PartialEq, thiserror::Error)]
pub enum StructureError {
    /// A parent that does not exist.
    #[error("node {child}: parent {parent}, need one of 0..={part_count}")]
    UnknownParent {
        /// The node with that parent.
        child: usize,
        /// The parent given.
        parent: usize,
        /// N, the number of parts.
        part_count: usize,
    },
    /// Parents that lead in a circle, never to the root.
    #[error("node {child}: its ancestors form a cycle, need a path to the root 0")]
    Cycle {
        /// A node whose ancestors do not reach the root.
        child: usize,
    },
    /// A matrix over edges of the wrong size.
    #[error("matrix over edges: {rows} x {columns}, need {expected} x {expected}")]
    Shape {
        /// Rows given.
        rows: usize,
        /// Columns given.
        columns: usize,
        /// N + 1.
        expected: usize,
    },
    /// A log weight that is NaN or +∞.
    #[error("log weight of edge {parent} -> {child}: {log_weight}, need finite or -inf")]
    LogWeight {
        /// Parent of the edge.
        parent: usize,
        /// Child of the edge.
        child: usize,
        /// The value given.
        log_weight: f64,
    },
    /// The edges of positive weight hold no tree.
    #[error("edge weights: some part has no path of positive weight to the root")]
    NoTree,
    /// The target log density is not finite at a tree that the guide can draw.
    #[error("log density of tree {parents:?}: {log_density}, need finite where the guide is positive")]
    LogDensity {
        /// Parents of nodes 1..=N.
        parents: Vec<usize>,
        /// The value given.
        log_density: f64,
    },
}
