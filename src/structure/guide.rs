//! What a variational family over trees can do, and the exact one.

use nalgebra::DMatrix;
use rand::Rng;

use super::natural_gradient::{
    exact_elbo, natural_gradient_by_enumeration, natural_gradient_by_samples, natural_gradient_of_edge_scores,
};
use super::{StructureError, Tree, TreeDistribution};

/// An unnormalized log density over trees to fit a guide to.
pub trait TreeTarget {
    /// ln p(tree) up to a constant.
    fn log_density(&self, tree: &Tree) -> f64;

    /// The scores s with ln p(tree) = Σ_edges s(parent→child), if it is such a sum.
    fn edge_scores(&self) -> Option<&DMatrix<f64>> {
        None
    }
}

impl<F: Fn(&Tree) -> f64> TreeTarget for F {
    fn log_density(&self, tree: &Tree) -> f64 {
        self(tree)
    }
}

/// The target ln p(tree) = Σ_edges score.
#[derive(Clone, Debug)]
pub struct EdgeScores(pub DMatrix<f64>);

impl TreeTarget for EdgeScores {
    fn log_density(&self, tree: &Tree) -> f64 {
        tree.edges().map(|edge| self.0[edge]).sum()
    }

    fn edge_scores(&self) -> Option<&DMatrix<f64>> {
        Some(&self.0)
    }
}

/// What one step of fitting saw and did.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct FitStep {
    /// The ELBO before the step, exact or estimated; for [`super::GumbelGuide`] a lower bound of it.
    pub elbo: f64,
    /// The part of the full step that was taken, 0 if none improved.
    pub rate: f64,
}

/// A variational family over the trees of N parts.
pub trait TreeGuide {
    /// N.
    fn part_count(&self) -> usize;

    /// A draw.
    fn sample(&self, rng: &mut dyn Rng) -> Tree;

    /// ln q(tree), if the guide can tell.
    fn log_prob(&self, tree: &Tree) -> Option<f64>;

    /// P(parent→child), exact or from draws.
    fn edge_marginals(&self, rng: &mut dyn Rng) -> DMatrix<f64>;

    /// Moves the parameters once towards the target.
    ///
    /// # Errors
    /// The target is not finite at a tree that the guide can draw, or leaves no tree possible. The
    /// guide stays as it was.
    fn step(&mut self, target: &dyn TreeTarget, rng: &mut dyn Rng) -> Result<FitStep, StructureError>;
}

/// The edge-factored family, fitted by natural gradients.
///
/// The gradient is exact where the target is a sum over edges and, by enumeration, for few parts;
/// else it is estimated from draws.
#[derive(Clone, Debug)]
pub struct MatrixTreeGuide {
    /// q.
    pub distribution: TreeDistribution,
    /// Part of the natural gradient to go per step, in (0, 1].
    pub rate: f64,
    /// Up to this many parts, all trees are visited: 16 807 for six.
    pub enumerate_up_to: usize,
    /// Draws per step beyond that.
    pub draws_per_step: usize,
}

/// Halvings of the step before giving up: 2^-20 of a natural gradient moves nothing that matters.
const MAX_HALVINGS: i32 = 20;

impl MatrixTreeGuide {
    /// Starts at the uniform distribution over the trees of `part_count` parts.
    pub fn uniform(part_count: usize) -> Self {
        Self::from_distribution(TreeDistribution::uniform(part_count))
    }

    /// Starts at a given distribution; edges of weight zero stay so.
    pub fn from_distribution(distribution: TreeDistribution) -> Self {
        // A regression needs more draws than its N (N − 1) unknowns.
        let draws_per_step = (16 * distribution.part_count().pow(2)).max(16);
        Self { distribution, rate: 1.0, enumerate_up_to: 6, draws_per_step }
    }

    fn moved(&self, gradient: &DMatrix<f64>, rate: f64) -> Result<TreeDistribution, StructureError> {
        TreeDistribution::new(&(self.distribution.log_weights() + gradient * rate))
    }

    /// The longest step that does not lower the exact ELBO.
    fn step_by_enumeration(&mut self, target: &dyn TreeTarget) -> Result<FitStep, StructureError> {
        let elbo = exact_elbo(&self.distribution, target)?;
        let gradient = natural_gradient_by_enumeration(&self.distribution, target)?;
        for halvings in 0..=MAX_HALVINGS {
            let rate = self.rate * 0.5_f64.powi(halvings);
            let moved = self.moved(&gradient, rate)?;
            if exact_elbo(&moved, target)? >= elbo {
                self.distribution = moved;
                return Ok(FitStep { elbo, rate });
            }
        }
        Ok(FitStep { elbo, rate: 0.0 })
    }
}

impl TreeGuide for MatrixTreeGuide {
    fn part_count(&self) -> usize {
        self.distribution.part_count()
    }

    fn sample(&self, rng: &mut dyn Rng) -> Tree {
        self.distribution.sample(rng)
    }

    fn log_prob(&self, tree: &Tree) -> Option<f64> {
        Some(self.distribution.log_prob(tree))
    }

    fn edge_marginals(&self, _rng: &mut dyn Rng) -> DMatrix<f64> {
        self.distribution.edge_marginals().clone()
    }

    fn step(&mut self, target: &dyn TreeTarget, rng: &mut dyn Rng) -> Result<FitStep, StructureError> {
        let (gradient, elbo) = if let Some(scores) = target.edge_scores() {
            let elbo = self.distribution.expectation(scores) + self.distribution.entropy();
            (natural_gradient_of_edge_scores(&self.distribution, scores), elbo)
        } else if self.part_count() <= self.enumerate_up_to {
            return self.step_by_enumeration(target);
        } else {
            natural_gradient_by_samples(&self.distribution, target, self.draws_per_step, rng)?
        };
        self.distribution = self.moved(&gradient, self.rate)?;
        Ok(FitStep { elbo, rate: self.rate })
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;

    #[test]
    fn edge_scores_are_met_in_one_step_of_rate_one() -> Result<(), StructureError> {
        let mut rng = ChaCha8Rng::seed_from_u64(21);
        let mut scores = DMatrix::from_fn(5, 5, |_, _| rng.random_range(-4.0..4.0));
        scores[(2, 3)] = f64::NEG_INFINITY;
        let goal = TreeDistribution::new(&scores)?;
        let mut guide = MatrixTreeGuide::uniform(4);
        let target = EdgeScores(scores);
        guide.step(&target, &mut rng)?;
        let error = (guide.edge_marginals(&mut rng) - goal.edge_marginals()).abs().max();
        assert!(error < 1e-14, "{error:e}");
        let second = guide.step(&target, &mut rng)?;
        assert!((second.elbo - goal.log_normalizer()).abs() < 1e-12);
        Ok(())
    }

    #[test]
    fn the_elbo_never_falls_on_a_target_with_interactions() -> Result<(), StructureError> {
        let mut rng = ChaCha8Rng::seed_from_u64(22);
        let scores = EdgeScores(DMatrix::from_fn(5, 5, |_, _| rng.random_range(-3.0..3.0)));
        // Rewards chains over stars, beyond any sum over edges.
        let target = |tree: &Tree| {
            let deepest = (1..=4).map(|node| tree.depth(node)).max().unwrap_or(0);
            scores.log_density(tree) + 2.0 * deepest as f64
        };
        let log_evidence = Tree::all(4).map(|tree| target(&tree).exp()).sum::<f64>().ln();
        let mut guide = MatrixTreeGuide::uniform(4);
        let mut last = f64::NEG_INFINITY;
        for _ in 0..60 {
            let step = guide.step(&target, &mut rng)?;
            assert!(step.elbo >= last - 1e-12);
            last = step.elbo;
        }
        // No sum over edges is this target, so a gap stays; the end is a stationary point.
        assert!(last <= log_evidence, "{last} {log_evidence}");
        let left = natural_gradient_by_enumeration(&guide.distribution, &target)?;
        let pull = left.component_mul(guide.distribution.edge_marginals()).abs().max();
        assert!(pull < 1e-6, "{pull:e}");

        // From draws: ends near the same optimum.
        let mut sampled = MatrixTreeGuide { enumerate_up_to: 0, rate: 0.3, ..MatrixTreeGuide::uniform(4) };
        for _ in 0..60 {
            sampled.step(&target, &mut rng)?;
        }
        let reached = exact_elbo(&sampled.distribution, &target)?;
        assert!(reached > last - 0.05, "{reached} {last}");
        Ok(())
    }
}
