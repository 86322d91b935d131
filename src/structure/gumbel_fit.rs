//! Fits the paper's sampler to a target by straight-through gradients.
//!
//! q(G) sums over all orders and has no closed form, so the ascent is on a lower bound of the ELBO
//! that keeps the order o as an auxiliary variable,
//!
//! E_q[ln p(G) + ln r(o | G) − ln q(o) − ln q(G | o)] ≤ E_q[ln p(G) − ln q(G)],
//!
//! with r uniform over the orders that agree with G, of which there are N! / Π_j size_j with size_j
//! the nodes in the subtree of part j (Knuth, The Art of Computer Programming 3, 5.1.4,
//! exercise 20). ln q(o) is Plackett–Luce; ln q(G | o) is a softmax per part: the law of the rounded
//! draw only for τ → 0, for it the bound holds. The first two terms get straight-through
//! derivatives, the entropies exact ones given the order, and the score function for the order.

use nalgebra::{DMatrix, DVector};
use rand::Rng;

use super::{FitStep, GumbelDraw, GumbelGradient, GumbelParameters, StructureError, Tree, TreeGuide, TreeTarget};
use crate::math::softmax;

/// A worse re-parenting than this [nats] is as good as impossible: exp(−50) = 2e-22.
const WORST_GAIN: f64 = -50.0;

/// How the sampler is fitted.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct GumbelFitSettings {
    /// Draws averaged in one gradient; at least 2.
    pub draws_per_step: usize,
    /// Adam's step size.
    pub learning_rate: f64,
    /// Draws behind `edge_marginals`.
    pub draws_for_marginals: usize,
}

impl Default for GumbelFitSettings {
    fn default() -> Self {
        Self { draws_per_step: 16, learning_rate: 0.03, draws_for_marginals: 10_000 }
    }
}

/// The paper's guide.
///
/// A step evaluates the target about N² times per draw, to learn ∂ ln p/∂A by re-parenting.
#[derive(Clone, Debug)]
pub struct GumbelGuide {
    /// Of the sampler.
    pub parameters: GumbelParameters,
    settings: GumbelFitSettings,
    optimizer: Adam,
}

impl GumbelGuide {
    /// Starts with all logits zero.
    pub fn new(part_count: usize, settings: GumbelFitSettings) -> Self {
        let size = part_count + 1;
        Self { parameters: GumbelParameters::new(part_count), settings, optimizer: Adam::new(part_count + size * size) }
    }

    /// The bound's value at one draw, and its gradient without the order's score function.
    fn evaluate(
        &self,
        draw: &GumbelDraw,
        target: &dyn TreeTarget,
    ) -> Result<(Evaluation, GumbelGradient), StructureError> {
        let reward = |tree: &Tree| target.log_density(tree) + log_order_posterior(tree);
        let here = reward(&draw.tree);
        if !here.is_finite() {
            let parents = draw.tree.parents().to_vec();
            return Err(StructureError::LogDensity { parents, log_density: here });
        }
        let gains = reparenting_gains(draw, |tree| (reward(tree) - here).max(WORST_GAIN));
        let mut gradient = self.parameters.straight_through(draw, &gains);

        let mut edge_entropy = 0.0;
        for (position, &child) in draw.order.iter().enumerate().skip(1) {
            let candidates = &draw.order[..position];
            let logits = candidates.iter().map(|&parent| self.parameters.edge_logits[(parent, child)]);
            let shares = softmax(logits);
            let entropy: f64 = shares.iter().copied().map(negative_x_ln_x).sum();
            for (&parent, &share) in candidates.iter().zip(&shares) {
                gradient.edge_logits[(parent, child)] += negative_x_ln_x(share) - share * entropy;
            }
            edge_entropy += entropy;
        }
        let (log_order, order_score) = plackett_luce(&self.parameters.order_logits, &draw.order);
        let entropies = edge_entropy - log_order;
        Ok((Evaluation { bound: here + entropies, entropies, order_score }, gradient))
    }
}

/// What one draw contributes besides its gradient.
struct Evaluation {
    bound: f64,
    /// −ln q(o) plus the entropy of the parents given the order.
    entropies: f64,
    /// ∂ ln q(o)/∂θ.
    order_score: DVector<f64>,
}

impl TreeGuide for GumbelGuide {
    fn part_count(&self) -> usize {
        self.parameters.part_count()
    }

    fn sample(&self, rng: &mut dyn Rng) -> Tree {
        self.parameters.draw(rng).tree
    }

    fn log_prob(&self, _tree: &Tree) -> Option<f64> {
        None
    }

    fn edge_marginals(&self, rng: &mut dyn Rng) -> DMatrix<f64> {
        let size = self.part_count() + 1;
        let draws = self.settings.draws_for_marginals.max(1);
        let mut marginals = DMatrix::zeros(size, size);
        for _ in 0..draws {
            for edge in self.sample(rng).edges() {
                marginals[edge] += 1.0 / draws as f64;
            }
        }
        marginals
    }

    fn step(&mut self, target: &dyn TreeTarget, rng: &mut dyn Rng) -> Result<FitStep, StructureError> {
        let draws = self.settings.draws_per_step.max(2);
        let weight = 1.0 / draws as f64;
        let size = self.part_count() + 1;
        let mut order_gradient = DVector::zeros(self.part_count());
        let mut edge_gradient = DMatrix::zeros(size, size);
        let mut evaluations = Vec::with_capacity(draws);
        for _ in 0..draws {
            let draw = self.parameters.draw(rng);
            let (evaluation, gradient) = self.evaluate(&draw, target)?;
            order_gradient += gradient.order_logits * weight;
            edge_gradient += gradient.edge_logits * weight;
            evaluations.push(evaluation);
        }
        let total: f64 = evaluations.iter().map(|evaluation| evaluation.entropies).sum();
        for evaluation in &evaluations {
            // The mean of the other draws as the baseline keeps the estimate unbiased.
            let baseline = (total - evaluation.entropies) / (draws - 1) as f64;
            let advantage = evaluation.entropies - baseline;
            order_gradient += &evaluation.order_score * (weight * advantage);
        }

        let gradient: Vec<f64> = order_gradient.iter().chain(edge_gradient.iter()).copied().collect();
        let steps = self.optimizer.step(&gradient, self.settings.learning_rate);
        let logits = self.parameters.order_logits.iter_mut();
        for (logit, step) in logits.chain(self.parameters.edge_logits.iter_mut()).zip(steps) {
            *logit += step;
        }
        let elbo = evaluations.iter().map(|evaluation| evaluation.bound * weight).sum();
        Ok(FitStep { elbo, rate: self.settings.learning_rate })
    }
}

/// ∂f/∂A of the extension of f that is linear in each column: for every edge i → j the gain of
/// hanging j on i.
///
/// Where i lies below j that makes a cycle. Then i first takes the place of j, in both trees that
/// are compared: without it nothing would pull a part past its own child in the order. Where f is a
/// sum over edges, either way the gain is the difference of the two edges' scores.
fn reparenting_gains(draw: &GumbelDraw, gain: impl Fn(&Tree) -> f64) -> DMatrix<f64> {
    let size = draw.relaxed.nrows();
    let mut gains = DMatrix::zeros(size, size);
    for (current, child) in draw.tree.edges() {
        for parent in (0..size).filter(|&parent| parent != current && parent != child) {
            gains[(parent, child)] = match draw.tree.reparented(child, parent) {
                Some(tree) => gain(&tree),
                None => draw
                    .tree
                    .reparented(parent, current)
                    .and_then(|freed| Some(gain(&freed.reparented(child, parent)?) - gain(&freed)))
                    .unwrap_or_else(|| unreachable!("{current} lies above both")),
            };
        }
    }
    gains
}

/// ln r(o | G) for any order that agrees with the tree.
fn log_order_posterior(tree: &Tree) -> f64 {
    let log_sizes: f64 = tree.subtree_sizes()[1..].iter().map(|&size| (size as f64).ln()).sum();
    let log_factorial: f64 = (1..=tree.part_count()).map(|count| (count as f64).ln()).sum();
    log_sizes - log_factorial
}

/// ln q(o) = Σ_a (θ_(a) − ln Σ_{b ≥ a} exp θ_(b)) and its gradient by θ.
fn plackett_luce(logits: &DVector<f64>, order: &[usize]) -> (f64, DVector<f64>) {
    let mut log_prob = 0.0;
    let mut gradient = DVector::zeros(logits.len());
    for position in 1..order.len() {
        let rest = &order[position..];
        let shares = softmax(rest.iter().map(|&part| logits[part - 1]));
        log_prob += shares[0].ln();
        gradient[rest[0] - 1] += 1.0;
        for (&part, share) in rest.iter().zip(shares) {
            gradient[part - 1] -= share;
        }
    }
    (log_prob, gradient)
}

fn negative_x_ln_x(x: f64) -> f64 {
    if x > 0.0 { -x * x.ln() } else { 0.0 }
}

/// Kingma, Ba, "Adam: a method for stochastic optimization", 2015, with its default constants.
#[derive(Clone, Debug)]
struct Adam {
    first: Vec<f64>,
    second: Vec<f64>,
    steps: i32,
}

impl Adam {
    const FIRST_DECAY: f64 = 0.9;
    const SECOND_DECAY: f64 = 0.999;
    const EPSILON: f64 = 1e-8;

    fn new(dimension: usize) -> Self {
        Self { first: vec![0.0; dimension], second: vec![0.0; dimension], steps: 0 }
    }

    /// What to add to the parameters to ascend.
    fn step(&mut self, gradient: &[f64], learning_rate: f64) -> Vec<f64> {
        self.steps += 1;
        let first_bias = 1.0 - Self::FIRST_DECAY.powi(self.steps);
        let second_bias = 1.0 - Self::SECOND_DECAY.powi(self.steps);
        let moments = self.first.iter_mut().zip(&mut self.second);
        moments
            .zip(gradient)
            .map(|((first, second), &slope)| {
                *first = Self::FIRST_DECAY * *first + (1.0 - Self::FIRST_DECAY) * slope;
                *second = Self::SECOND_DECAY * *second + (1.0 - Self::SECOND_DECAY) * slope * slope;
                let spread = (*second / second_bias).sqrt() + Self::EPSILON;
                learning_rate * (*first / first_bias) / spread
            })
            .collect()
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::structure::EdgeScores;
    use rand::{RngExt, SeedableRng};
    use rand_chacha::ChaCha8Rng;
    use std::collections::BTreeMap;

    /// KL(q ‖ p) from a histogram of draws; biased up by trees / (2 draws).
    fn divergence(guide: &GumbelGuide, target: &EdgeScores, draws: u32, rng: &mut ChaCha8Rng) -> f64 {
        let evidence: f64 = Tree::all(guide.part_count()).map(|tree| target.log_density(&tree).exp()).sum();
        let mut counts = BTreeMap::new();
        for _ in 0..draws {
            *counts.entry(guide.sample(rng)).or_insert(0_u32) += 1;
        }
        counts
            .iter()
            .map(|(tree, &count)| {
                let share = f64::from(count) / f64::from(draws);
                share * (share.ln() - target.log_density(tree) + evidence.ln())
            })
            .sum()
    }

    #[test]
    fn orders_that_agree_with_a_tree_are_counted() {
        for tree in Tree::all(4) {
            let agreeing = permutations(4)
                .into_iter()
                .filter(|order| {
                    let before =
                        |a: usize, b: usize| order.iter().position(|&x| x == a) < order.iter().position(|&x| x == b);
                    tree.edges().all(|(parent, child)| parent == 0 || before(parent, child))
                })
                .count();
            assert!((log_order_posterior(&tree) + (agreeing as f64).ln()).abs() < 1e-12);
        }
    }

    fn permutations(count: usize) -> Vec<Vec<usize>> {
        if count == 0 {
            return vec![Vec::new()];
        }
        let mut all = Vec::new();
        for shorter in permutations(count - 1) {
            for position in 0..count {
                let mut longer = shorter.clone();
                longer.insert(position, count);
                all.push(longer);
            }
        }
        all
    }

    #[test]
    fn gains_on_edge_scores_are_differences_of_scores() {
        let mut rng = ChaCha8Rng::seed_from_u64(42);
        let scores = EdgeScores(DMatrix::from_fn(6, 6, |_, _| rng.random_range(-3.0..3.0)));
        for _ in 0..50 {
            let draw = GumbelParameters::new(5).draw(&mut rng);
            let here = scores.log_density(&draw.tree);
            let gains = reparenting_gains(&draw, |tree| scores.log_density(tree) - here);
            for (current, child) in draw.tree.edges() {
                for parent in (0..6).filter(|&parent| parent != child) {
                    let expected = scores.0[(parent, child)] - scores.0[(current, child)];
                    assert!((gains[(parent, child)] - expected).abs() < 1e-12);
                }
            }
        }
    }

    #[test]
    fn the_order_score_is_the_derivative_of_its_log_probability() {
        let logits = DVector::from_column_slice(&[0.3, -0.7, 1.1]);
        let order = [0, 2, 3, 1];
        let (_, gradient) = plackett_luce(&logits, &order);
        for index in 0..3 {
            let moved = |by: f64| {
                let mut moved = logits.clone();
                moved[index] += by;
                plackett_luce(&moved, &order).0
            };
            let numerical = (moved(1e-6) - moved(-1e-6)) / 2e-6;
            assert!((gradient[index] - numerical).abs() < 1e-8);
        }
        let total: f64 = permutations(3)
            .into_iter()
            .map(|mut order| {
                order.insert(0, 0);
                plackett_luce(&logits, &order).0.exp()
            })
            .sum();
        assert!((total - 1.0).abs() < 1e-12);
    }

    #[test]
    fn fitting_comes_closer_to_the_target() -> Result<(), StructureError> {
        let mut rng = ChaCha8Rng::seed_from_u64(41);
        for part_count in 2..=5 {
            let size = part_count + 1;
            let scores = DMatrix::from_fn(size, size, |_, _| rng.random_range(-3.0..3.0));
            let target = EdgeScores(scores);
            let mut guide = GumbelGuide::new(part_count, GumbelFitSettings::default());
            let before = divergence(&guide, &target, 40_000, &mut rng);
            let mut bounds = Vec::new();
            for _ in 0..400 {
                bounds.push(guide.step(&target, &mut rng)?.elbo);
            }
            let after = divergence(&guide, &target, 40_000, &mut rng);
            assert!(after < 0.4 * before, "{part_count} parts: {before} -> {after}");
            let mean = |bounds: &[f64]| bounds.iter().sum::<f64>() / bounds.len() as f64;
            assert!(mean(&bounds[350..]) > mean(&bounds[..50]), "{part_count} parts");
        }
        Ok(())
    }
}
