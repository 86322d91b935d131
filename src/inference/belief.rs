//! A posterior as base prior × sites over named blocks of numbers.
//!
//! Each observation (a window) has one site. To learn it again, its old site is left out of the
//! product (the cavity), it is fitted against the rest, and the new site takes the old one's place
//! (expectation propagation, Minka 2001): nothing is counted twice, however often it is replayed.

use std::collections::BTreeMap;

use nalgebra::{DMatrix, DVector};
use serde::{Deserialize, Serialize};

use super::gaussian::Gaussian;
use super::solver::Failure;
use crate::types::pairs;

/// A Gaussian factor of some blocks, in their order.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Factor<N> {
    /// The blocks with their lengths.
    pub blocks: Vec<(N, usize)>,
    /// The factor, of the blocks' numbers one after the other.
    pub gaussian: Gaussian,
}

/// Prior factors and sites.
#[derive(Clone, Debug, Serialize, Deserialize)]
#[serde(bound(serialize = "N: Serialize, S: Serialize", deserialize = "N: Deserialize<'de>, S: Deserialize<'de>"))]
pub struct Belief<N: Ord + Clone, S: Ord> {
    #[serde(with = "pairs")]
    priors: BTreeMap<N, Factor<N>>,
    #[serde(with = "pairs")]
    sites: BTreeMap<S, Factor<N>>,
}

impl<N: Ord + Clone, S: Ord> Default for Belief<N, S> {
    fn default() -> Self {
        Self { priors: BTreeMap::new(), sites: BTreeMap::new() }
    }
}

/// A product of factors, with where each block is in it.
#[derive(Clone, Debug)]
pub struct Joint<N: Ord> {
    places: BTreeMap<N, (usize, usize)>,
    /// The product.
    pub gaussian: Gaussian,
}

impl<N: Ord + Clone> Joint<N> {
    /// Indices of a block's numbers; none if it is not in the product.
    pub fn places(&self, block: &N) -> Vec<usize> {
        self.places.get(block).map_or_else(Vec::new, |&(start, length)| (start..start + length).collect())
    }

    /// Mean and covariance of some blocks, one after the other.
    pub fn moments(&self, blocks: &[N]) -> Result<(DVector<f64>, DMatrix<f64>), Failure> {
        let places: Vec<usize> = blocks.iter().flat_map(|block| self.places(block)).collect();
        let (mean, covariance) = self.gaussian.moments()?;
        Ok((
            DVector::from_fn(places.len(), |i, _| mean[places[i]]),
            DMatrix::from_fn(places.len(), places.len(), |i, j| covariance[(places[i], places[j])]),
        ))
    }
}

impl<N: Ord + Clone, S: Ord> Belief<N, S> {
    /// Sets the prior factor of that name; its blocks may be any.
    pub fn set_prior(&mut self, name: N, factor: Factor<N>) {
        self.priors.insert(name, factor);
    }

    /// Forgets the prior factor of that name.
    pub fn remove_prior(&mut self, name: &N) {
        self.priors.remove(name);
    }

    /// The prior factor of that name.
    pub fn prior(&self, name: &N) -> Option<&Factor<N>> {
        self.priors.get(name)
    }

    /// The site of an observation.
    pub fn site(&self, site: &S) -> Option<&Factor<N>> {
        self.sites.get(site)
    }

    /// All sites, to carry them to other coordinates.
    pub fn sites_mut(&mut self) -> impl Iterator<Item = (&S, &mut Factor<N>)> {
        self.sites.iter_mut()
    }

    /// Puts a site in the place of the old one.
    pub fn replace(&mut self, site: S, factor: Factor<N>) {
        self.sites.insert(site, factor);
    }

    /// Takes a site out.
    pub fn remove(&mut self, site: &S) -> Option<Factor<N>> {
        self.sites.remove(site)
    }

    /// Multiplies a factor onto a site: what was two observations is one from now on.
    pub fn multiply(&mut self, site: S, factor: &Factor<N>) {
        let old = self.sites.remove(&site);
        let joint = product(old.iter().chain([factor]));
        let blocks = joint.places.iter().map(|(name, (_, length))| (name.clone(), *length)).collect();
        self.sites.insert(site, Factor { blocks, gaussian: joint.gaussian });
    }

    /// Gives the sites other names.
    pub fn rename_sites(&mut self, name: impl Fn(S) -> S) {
        self.sites = std::mem::take(&mut self.sites).into_iter().map(|(site, factor)| (name(site), factor)).collect();
    }

    /// Drops the sites that mention a block; says which.
    pub fn drop_sites_of(&mut self, block: &N) -> Vec<S> {
        let sites = std::mem::take(&mut self.sites);
        let (dropped, kept): (BTreeMap<_, _>, BTreeMap<_, _>) =
            sites.into_iter().partition(|(_, f)| f.blocks.iter().any(|(name, _)| name == block));
        self.sites = kept;
        dropped.into_keys().collect()
    }

    /// Prior × sites, without one of them if asked.
    pub fn product(&self, without: Option<&S>) -> Joint<N> {
        let factors: Vec<&Factor<N>> = self
            .priors
            .values()
            .chain(self.sites.iter().filter(|(name, _)| Some(*name) != without).map(|(_, f)| f))
            .collect();
        product(factors)
    }
}

/// The product of factors, over all their blocks.
fn product<'a, N: Ord + Clone + 'a>(factors: impl IntoIterator<Item = &'a Factor<N>>) -> Joint<N> {
    let factors: Vec<&Factor<N>> = factors.into_iter().collect();
    let mut places: BTreeMap<N, (usize, usize)> = BTreeMap::new();
    for (name, length) in factors.iter().flat_map(|f| &f.blocks) {
        places.insert(name.clone(), (0, *length));
    }
    let mut total = 0;
    for (start, length) in places.values_mut() {
        *start = total;
        total += *length;
    }
    let mut joint = Joint { places, gaussian: Gaussian::flat(total) };
    for factor in factors {
        let at: Vec<usize> = factor.blocks.iter().flat_map(|(name, _)| joint.places(name)).collect();
        joint.gaussian.multiply_at(&factor.gaussian, &at);
    }
    joint
}

#[cfg(test)]
mod tests {
    use super::*;

    fn factor(mean: f64, deviation: f64) -> Factor<&'static str> {
        let covariance = DMatrix::from_element(1, 1, deviation * deviation);
        let gaussian = Gaussian::from_moments(&DVector::from_element(1, mean), &covariance).expect("positive");
        Factor { blocks: vec![("x", 1)], gaussian }
    }

    #[test]
    fn replaying_never_narrows() {
        let mut belief = Belief::default();
        belief.set_prior("x", factor(0.0, 1.0));
        for site in 0..3 {
            belief.replace(site, factor(0.5, 0.7));
        }
        let (_, before) = belief.product(None).moments(&["x"]).expect("proper");
        for _ in 0..4 {
            for site in 0..3 {
                let cavity = belief.product(Some(&site));
                // A linear observation: the refit against any cavity is the same site.
                let mut posterior = cavity.gaussian.clone();
                posterior.multiply_at(&factor(0.5, 0.7).gaussian, &[0]);
                let gaussian = Gaussian {
                    precision: posterior.precision - cavity.gaussian.precision,
                    information: posterior.information - cavity.gaussian.information,
                };
                belief.replace(site, Factor { blocks: vec![("x", 1)], gaussian });
            }
        }
        let (_, after) = belief.product(None).moments(&["x"]).expect("proper");
        assert!((before[(0, 0)] - after[(0, 0)]).abs() < 1e-12);
    }

    #[test]
    fn a_multiplied_site_says_what_its_parts_said() {
        let mut belief = Belief::default();
        belief.set_prior("x", factor(0.0, 1.0));
        belief.replace(0, factor(3.0, 0.1));
        belief.replace(1, Factor { blocks: vec![("y", 1)], ..factor(-1.0, 0.3) });
        belief.set_prior("y", Factor { blocks: vec![("y", 1)], ..factor(0.0, 2.0) });
        let before = belief.product(None).moments(&["x", "y"]).expect("proper");
        for site in [0, 1] {
            let taken = belief.remove(&site).expect("a site");
            belief.multiply(7, &taken);
        }
        belief.rename_sites(|site| site + 1);
        assert!(belief.site(&0).is_none() && belief.site(&8).is_some_and(|f| f.blocks.len() == 2));
        let after = belief.product(None).moments(&["x", "y"]).expect("proper");
        assert!((before.0 - after.0).norm() < 1e-12 && (before.1 - after.1).norm() < 1e-12);
    }

    #[test]
    fn the_cavity_is_the_product_without_the_site() {
        let mut belief = Belief::default();
        belief.set_prior("x", factor(0.0, 1.0));
        belief.replace(0, factor(3.0, 0.1));
        let (mean, covariance) = belief.product(Some(&0)).moments(&["x"]).expect("proper");
        assert!(mean[0].abs() < 1e-12 && (covariance[(0, 0)] - 1.0).abs() < 1e-12);
    }
}
