//! What is believed of an object: `posterior.json` but for its schema's name and the counters.
//!
//! World frame at the first frame, SI units. `parameters` of an edge are conditional on the edge
//! and the likelier of its two moving types, marginal over all else; intervals are central.

use std::collections::BTreeMap;

use nalgebra::{Matrix2, Matrix3, Matrix4, Vector3};
use serde::{Deserialize, Serialize};

use super::Label;
use crate::math::{Pose, orthonormal_pair};

/// z of a standard normal at 95 %: a central 90 % interval is ± this many standard deviations.
const Z_95: f64 = 1.644_853_626_951_472_2;

/// Posterior over the mechanism of one object.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ObjectPosterior {
    /// The part that is fixed to the world.
    pub root_label: Label,
    /// Every part, by label.
    pub parts: Vec<PartPosterior>,
    /// Every ordered pair at or above [`ObjectPosterior::LEAST_PROBABILITY`], by child, then parent.
    pub edges: Vec<EdgePosterior>,
    /// The windows learned, in order.
    pub windows: Vec<WindowRecord>,
    /// What the model does not explain.
    pub criticism: Criticism,
}

impl ObjectPosterior {
    /// Edges below it are left out.
    pub const LEAST_PROBABILITY: f64 = 1e-6;

    /// The same in another frame: what stands at x here stands at `to_from_here · x` there.
    #[must_use]
    pub fn carried_by(mut self, to_from_here: &Pose) -> Self {
        let rotation = to_from_here.rotation;
        let point = |p: [f64; 3]| to_from_here.transform_point(&p.into()).into();
        for part in &mut self.parts {
            part.com_in_world_m = point(part.com_in_world_m);
            // Matrices are symmetric, so that rows and columns are the same.
            part.com_covariance_m2 = (rotation * Matrix3::from(part.com_covariance_m2) * rotation.transpose()).into();
        }
        for edge in &mut self.edges {
            if let Some(axis) = &mut edge.revolute {
                let (direction, basis) = turned_axis(&axis.axis_direction, &rotation);
                let mut both = Matrix4::zeros();
                both.fixed_view_mut::<2, 2>(0, 0).copy_from(&basis);
                both.fixed_view_mut::<2, 2>(2, 2).copy_from(&basis);
                axis.axis_direction = direction;
                axis.axis_point_m = point(axis.axis_point_m);
                axis.covariance = (both * Matrix4::from(axis.covariance) * both.transpose()).into();
            }
            if let Some(axis) = &mut edge.prismatic {
                let (direction, basis) = turned_axis(&axis.axis_direction, &rotation);
                axis.axis_direction = direction;
                axis.covariance = (basis * Matrix2::from(axis.covariance) * basis.transpose()).into();
            }
        }
        for effect in &mut self.criticism.effects {
            for names in [["force_x", "force_y", "force_z"], ["torque_x", "torque_y", "torque_z"]] {
                turn_vector(&mut effect.parameters, &names, &rotation);
            }
        }
        self
    }
}

/// Turns a vector of normal quantities; its components' errors count as independent.
fn turn_vector(parameters: &mut BTreeMap<String, Quantity>, names: &[&str; 3], rotation: &Matrix3<f64>) {
    let old: Vec<Quantity> = names.iter().filter_map(|name| parameters.get(*name).cloned()).collect();
    if old.len() != 3 {
        return;
    }
    let mean = rotation * Vector3::from_fn(|i, _| old[i].mean);
    let variance = rotation.map(|r| r * r) * Vector3::from_fn(|i, _| old[i].std * old[i].std);
    for (i, name) in names.iter().enumerate() {
        let turned = Quantity::from_normal(&old[i].unit, mean[i], variance[i].sqrt(), old[i].informed_by);
        parameters.insert((*name).to_owned(), turned);
    }
}

/// An axis's direction, turned, and what takes components across the old one, turned with it, to
/// components across the new one: [`orthonormal_pair`] chooses by the frame's axes.
fn turned_axis(direction: &[f64; 3], rotation: &Matrix3<f64>) -> ([f64; 3], Matrix2<f64>) {
    let old = Vector3::from(*direction);
    let new = rotation * old;
    let (first, second) = orthonormal_pair(&old);
    let (first, second) = (rotation * first, rotation * second);
    let (new_first, new_second) = orthonormal_pair(&new);
    let basis =
        Matrix2::new(new_first.dot(&first), new_first.dot(&second), new_second.dot(&first), new_second.dot(&second));
    (new.into(), basis)
}

/// What is believed of one part by itself.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PartPosterior {
    /// The part.
    pub label: Label,
    /// Centre of mass \[m\].
    pub com_in_world_m: [f64; 3],
    /// Its covariance \[m²\].
    pub com_covariance_m2: [[f64; 3]; 3],
    /// Mass \[kg\].
    pub mass_kg: Quantity,
}

/// What is believed of one joint, if there is one between these two parts.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EdgePosterior {
    /// The part nearer the root.
    pub parent: Label,
    /// The part that the joint carries.
    pub child: Label,
    /// Marginal over all trees.
    pub probability: f64,
    /// Given this edge.
    pub joint_type: JointTypeProbabilities,
    /// The axis if revolute; null where nothing is known of it.
    pub revolute: Option<RevoluteAxis>,
    /// The axis if prismatic; null where nothing is known of it.
    pub prismatic: Option<PrismaticAxis>,
    /// Viscous damping: N·m·s/rad, N·s/m if prismatic.
    pub damping: Quantity,
    /// Coulomb friction: N·m, N if prismatic.
    pub friction: Quantity,
    /// Diagonal entry of the joint-space mass matrix at q = 0, the subtree carried: kg·m², kg if
    /// prismatic.
    pub joint_inertia: Quantity,
    /// Lower end stop, from the first frame; null if no stop is known of.
    pub lower_limit: Option<Quantity>,
    /// Upper end stop.
    pub upper_limit: Option<Quantity>,
}

/// Probabilities of the joint types, summing to one.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct JointTypeProbabilities {
    /// No motion.
    pub rigid: f64,
    /// Translation along the axis.
    pub prismatic: f64,
    /// Rotation about the axis.
    pub revolute: f64,
}

impl JointTypeProbabilities {
    /// Nothing is known.
    pub const UNIFORM: Self = Self { rigid: 1.0 / 3.0, prismatic: 1.0 / 3.0, revolute: 1.0 / 3.0 };

    /// The likeliest type's name and probability.
    pub fn likeliest(&self) -> (&'static str, f64) {
        let types = [("rigid", self.rigid), ("prismatic", self.prismatic), ("revolute", self.revolute)];
        types.into_iter().fold(("rigid", f64::NEG_INFINITY), |best, next| if next.1 > best.1 { next } else { best })
    }
}

/// A hinge's axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct RevoluteAxis {
    /// Unit vector; its sign is free.
    pub axis_direction: [f64; 3],
    /// The point of the axis nearest the child's centre of mass \[m\].
    pub axis_point_m: [f64; 3],
    /// Of two directions across the axis \[rad\], then two positions across it \[m\], along the pair
    /// of [`orthonormal_pair`]. A direction's component is the rotation about that unit vector.
    pub covariance: [[f64; 4]; 4],
}

/// A slide's axis.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PrismaticAxis {
    /// Unit vector; its sign is free.
    pub axis_direction: [f64; 3],
    /// Of two directions across the axis \[rad\].
    pub covariance: [[f64; 2]; 2],
}

/// What a quantity's spread was learned from.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum InformedBy {
    /// The motion under the wrench, the prior included.
    Dynamics,
    /// Nothing but what is assumed of any object.
    Prior,
}

/// A distribution over one number, by its summaries.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Quantity {
    /// As `N·s/m`.
    pub unit: String,
    /// The 50 % quantile.
    pub median: f64,
    /// Expected value.
    pub mean: f64,
    /// Standard deviation.
    pub std: f64,
    /// The 5 % quantile.
    pub q05: f64,
    /// The 95 % quantile.
    pub q95: f64,
    /// Whether the data say anything of it.
    pub informed_by: InformedBy,
}

impl Quantity {
    /// x with ln x ~ N(mu, sigma²), x in `unit`.
    pub fn from_log_normal(unit: &str, mu: f64, sigma: f64, informed_by: InformedBy) -> Self {
        let variance = sigma * sigma;
        let mean = (mu + 0.5 * variance).exp();
        Self {
            unit: unit.to_owned(),
            median: mu.exp(),
            mean,
            std: mean * variance.exp_m1().sqrt(),
            q05: (mu - Z_95 * sigma).exp(),
            q95: (mu + Z_95 * sigma).exp(),
            informed_by,
        }
    }

    /// Of draws in `unit`; all zero of none.
    pub fn from_samples(unit: &str, mut draws: Vec<f64>, informed_by: InformedBy) -> Self {
        draws.sort_by(f64::total_cmp);
        let count = draws.len().max(1) as f64;
        let mean = draws.iter().sum::<f64>() / count;
        let std = (draws.iter().map(|x| (x - mean).powi(2)).sum::<f64>() / (count - 1.0).max(1.0)).sqrt();
        // Between the two nearest draws.
        let quantile = |share: f64| {
            let place = share * (count - 1.0);
            let below = draws.get(place as usize).copied().unwrap_or(0.0);
            let above = draws.get(place.ceil() as usize).copied().unwrap_or(below);
            below + (above - below) * place.fract()
        };
        let (median, q05, q95) = (quantile(0.5), quantile(0.05), quantile(0.95));
        Self { unit: unit.to_owned(), median, mean, std, q05, q95, informed_by }
    }

    /// x ~ N(mean, std²), x in `unit`.
    pub fn from_normal(unit: &str, mean: f64, std: f64, informed_by: InformedBy) -> Self {
        Self {
            unit: unit.to_owned(),
            median: mean,
            mean,
            std,
            q05: mean - Z_95 * std,
            q95: mean + Z_95 * std,
            informed_by,
        }
    }
}

/// One interaction window as it was learned.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct WindowRecord {
    /// Time of the first frame \[s\].
    pub t0_s: f64,
    /// Time of the last frame \[s\].
    pub t1_s: f64,
    /// The parts that were touched.
    pub labels: Vec<Label>,
    /// Frames in it.
    pub frames: usize,
    /// Steps that inference took.
    pub steps: usize,
    /// Wall time that inference took: 0 from the core, which reads no clock; set by its caller \[s\].
    pub inference_wall_s: f64,
    /// Evidence lower bound after this window \[nats\]; null where none was computed.
    pub elbo: Option<f64>,
    /// By the posterior before this window was learned \[nats\]; null where it was not scored.
    pub log_predictive_density: Option<f64>,
}

/// Whether the model explains what was seen.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(rename_all = "snake_case")]
pub enum Verdict {
    /// The residual is white and of the size the noise model says.
    Adequate,
    /// It is not, and declared effects explain it.
    EffectFound,
    /// It is not, and no declared effect explains it.
    Unexplained,
    /// Fewer than two windows were scored.
    Insufficient,
}

/// What the model does not explain, and what was added for it.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct Criticism {
    /// The outcome.
    pub verdict: Verdict,
    /// The effects found, likeliest first.
    pub effects: Vec<EffectPosterior>,
    /// The base model fitted to the same windows as `after`.
    pub before: Vec<ResidualScore>,
    /// The model with the effects.
    pub after: Vec<ResidualScore>,
}

impl Criticism {
    /// Nothing was scored.
    pub fn insufficient() -> Self {
        Self { verdict: Verdict::Insufficient, effects: Vec::new(), before: Vec::new(), after: Vec::new() }
    }
}

/// An undeclared effect.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct EffectPosterior {
    /// As `catch`.
    pub name: String,
    /// The part whose joint it acts on; null for an effect on a sensor.
    pub label: Option<Label>,
    /// That it is there.
    pub probability: f64,
    /// Effects that would explain the same data as well.
    pub indistinguishable_from: Vec<String>,
    /// Its parameters by name.
    pub parameters: BTreeMap<String, Quantity>,
}

/// How well windows not yet learned were predicted, for one part.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct ResidualScore {
    /// The part.
    pub label: Label,
    /// Over how many windows.
    pub scored_windows: usize,
    /// Of a prismatic joint \[N\].
    #[serde(rename = "force_rmse_N", default, skip_serializing_if = "Option::is_none")]
    pub force_rmse_n: Option<f64>,
    /// Of a revolute joint \[N·m\].
    #[serde(rename = "torque_rmse_Nm", default, skip_serializing_if = "Option::is_none")]
    pub torque_rmse_nm: Option<f64>,
    /// Position \[m\].
    pub position_rmse_m: f64,
    /// Rotation \[rad\].
    pub rotation_rmse_rad: f64,
    /// Mean per window \[nats\].
    pub log_predictive_density: f64,
    /// p-value of the residual being white.
    pub residual_whiteness_p: f64,
}

impl ResidualScore {
    /// The residual force, by the joint's type \[N or N·m\].
    pub fn force_rmse(&self) -> Option<f64> {
        self.force_rmse_n.or(self.torque_rmse_nm)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn log_normal_summaries() {
        // ln x ~ N(ln 2, .5²): mean 2 exp(1/8), std mean √(exp(1/4) − 1), quantiles 2 exp(∓.5 z).
        let q = Quantity::from_log_normal("N", 2f64.ln(), 0.5, InformedBy::Dynamics);
        let near = |a: f64, b: f64| assert!((a - b).abs() < 1e-12 * b.abs(), "{a} {b}");
        near(q.median, 2.0);
        near(q.mean, 2.266_296_906_133_652_6);
        near(q.std, 1.207_801_066_421_762_2);
        near(q.q05 * q.q95, 4.0);
        near((q.q95 / q.q05).ln(), Z_95);
        let certain = Quantity::from_log_normal("N", 0.0, 0.0, InformedBy::Prior);
        assert_eq!((certain.mean, certain.std, certain.q05), (1.0, 0.0, 1.0));
    }

    #[test]
    fn samples_have_their_quantiles() {
        let q = Quantity::from_samples("N", (0..=100).rev().map(f64::from).collect(), InformedBy::Dynamics);
        assert_eq!((q.median, q.mean, q.q05, q.q95), (50.0, 50.0, 5.0, 95.0));
        assert!((q.std - 29.300_170_647_967_224).abs() < 1e-12);
        assert_eq!(Quantity::from_samples("N", Vec::new(), InformedBy::Prior).q95, 0.0);
    }

    #[test]
    fn normal_interval_holds_ninety_percent() {
        let q = Quantity::from_normal("m", -1.0, 2.0, InformedBy::Dynamics);
        assert_eq!((q.median, q.mean, q.std), (-1.0, -1.0, 2.0));
        assert!((q.q95 - 2.289_707_253_902_944).abs() < 1e-12 && (q.q05 + 4.289_707_253_902_944).abs() < 1e-12);
    }

    #[test]
    fn names_are_those_of_the_interface() {
        let score = ResidualScore {
            label: Label(1),
            scored_windows: 2,
            force_rmse_n: Some(0.5),
            torque_rmse_nm: None,
            position_rmse_m: 0.0,
            rotation_rmse_rad: 0.0,
            log_predictive_density: 0.0,
            residual_whiteness_p: 1.0,
        };
        let text = serde_json::to_string(&(score, Verdict::EffectFound, InformedBy::Dynamics)).unwrap();
        let expected = "[{\"label\":1,\"scored_windows\":2,\"force_rmse_N\":0.5,\"position_rmse_m\":0.0,\
            \"rotation_rmse_rad\":0.0,\"log_predictive_density\":0.0,\"residual_whiteness_p\":1.0},\
            \"effect_found\",\"dynamics\"]";
        assert_eq!(text, expected);
    }

    #[test]
    fn likeliest_type_is_the_first_among_equals() {
        assert_eq!(JointTypeProbabilities::UNIFORM.likeliest().0, "rigid");
        let types = JointTypeProbabilities { rigid: 0.1, prismatic: 0.7, revolute: 0.2 };
        assert_eq!(types.likeliest(), ("prismatic", 0.7));
    }
}
