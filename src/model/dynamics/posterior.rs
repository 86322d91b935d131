//! The posterior of the dynamics, as it is published.

use nalgebra::{DMatrix, DVector, Matrix2, Matrix3, Vector2, Vector3};

use super::layout::{
    AddedTable, CENTER, DAMPING, FRICTION, INERTIA, JointModel, LOWER, MASS, SensorError, TILT, UPPER,
};
use super::learner::DynamicsLearner;
use crate::inference::Failure;
use crate::mechanism::effects::{EffectKind, TableKind};
use crate::mechanism::{JointType, Tree};
use crate::types::Label;
use crate::types::posterior::{InformedBy, Quantity};

/// Relative error that a model of rigid parts, one viscous and one Coulomb term keeps however long it
/// is watched: on the generator's well-excited doors inertias were off by .7 % to 1.2 % with stated
/// spreads a third of that.
pub(super) const MODEL_FLOOR: f64 = 0.012;
/// End stops are where the reference configuration has them, and where that is registration says: no stop is known
/// better, however hard it was hit \[m\].
const REFERENCE_ERROR: f64 = 0.001;

/// Of one joint.
#[derive(Clone, Debug, PartialEq)]
pub struct JointDynamics {
    /// The joint's child.
    pub label: Label,
    /// d.
    pub damping: Quantity,
    /// F.
    pub friction: Quantity,
    /// M_jj at q = 0.
    pub joint_inertia: Quantity,
    /// Where gravity shows how a slide lies: by how much its direction is off in the axis's own two turns
    /// \[rad\], and their covariance.
    pub turn: Option<(Vector2<f64>, Matrix2<f64>)>,
    /// End stops, where there are any known.
    pub lower_limit: Option<Quantity>,
    /// The upper one.
    pub upper_limit: Option<Quantity>,
}

/// Of one part.
#[derive(Clone, Debug, PartialEq)]
pub struct PartDynamics {
    /// The part.
    pub label: Label,
    /// Its mass.
    pub mass: Quantity,
    /// Its centre of mass at the reference configuration \[m\].
    pub com_in_world: Vector3<f64>,
    /// Covariance of it \[m²\].
    pub com_covariance: Matrix3<f64>,
}

/// All of it, with the joint distribution that it is made of.
#[derive(Clone, Debug)]
pub struct DynamicsPosterior {
    /// By joint, parents first.
    pub joints: Vec<JointDynamics>,
    /// Of every joint's child.
    pub parts: Vec<PartDynamics>,
    /// Mean of all joints' numbers (laid out as in `layout`), one joint after the other.
    pub mean: DVector<f64>,
    /// Their covariance.
    pub covariance: DMatrix<f64>,
}

impl DynamicsLearner {
    /// What is known of the joints of the last kinematic fit.
    pub fn posterior(&self) -> Result<DynamicsPosterior, Failure> {
        let models = &self.mechanism.joints;
        if models.is_empty() {
            return Err(Failure::NoInformation);
        }
        let blocks = self.blocks();
        let (mean, covariance) = self.belief.product(None).moments(&blocks)?;
        let mut posterior = DynamicsPosterior { joints: Vec::new(), parts: Vec::new(), mean, covariance };
        let prior_deviation = |k: usize, entry: usize| {
            let prior = self.belief.prior(&blocks[k])?.gaussian.moments().ok()?;
            Some(prior.1[(entry, entry)].sqrt())
        };
        for (k, model) in models.iter().enumerate() {
            let at = self.mechanism.offset(k);
            let deviation = |entry: usize| posterior.covariance[(at + entry, at + entry)].max(0.0).sqrt();
            let log_deviation = |entry: usize| deviation(entry).hypot(MODEL_FLOOR);
            let informed = |entry: usize, deviation: f64| match prior_deviation(k, entry) {
                Some(prior) if deviation < 0.7 * prior => InformedBy::Dynamics,
                _ => InformedBy::Prior,
            };
            let revolute = model.joint.joint_type == JointType::Revolute;
            let units = if revolute { ["N·m·s/rad", "N·m", "kg·m²", "rad"] } else { ["N·s/m", "N", "kg", "m"] };
            let log_normal = |unit: &str, entry: usize| {
                Quantity::from_log_normal(
                    unit,
                    posterior.mean[at + entry],
                    log_deviation(entry),
                    informed(entry, deviation(entry)),
                )
            };
            let floor = if revolute { REFERENCE_ERROR / model.joint.radius } else { REFERENCE_ERROR };
            let stop = |side: usize, entry: usize| {
                let place = posterior.mean[at + entry];
                let deviation = deviation(entry).hypot(floor);
                model.stops[side].then(|| Quantity::from_normal(units[3], place, deviation, InformedBy::Dynamics))
            };
            let (mean, covariance) = (&posterior.mean, &posterior.covariance);
            let (inertia, inertia_deviation) = self.log_of(mean, covariance, |tree| tree.joint_inertia(k))?;
            // Where damping and friction differ by direction, their means over both are published.
            let by_direction = model.effects.iter().position(|e| e.kind == EffectKind::AsymmetricFriction);
            let resisting = |unit: &str, entry: usize, first: usize| match by_direction {
                None => Ok(log_normal(unit, entry)),
                Some(effect) => {
                    let mean_of = |tree: &Tree<f64>| {
                        let both = &tree.bodies()[k].parameters.effects[effect].parameters[first..first + 2];
                        0.5 * (both[0] + both[1])
                    };
                    let (value, deviation) = self.log_of(mean, covariance, mean_of)?;
                    let deviation = deviation.hypot(MODEL_FLOOR);
                    Ok(Quantity::from_log_normal(unit, value, deviation, InformedBy::Dynamics))
                }
            };
            let turn = (!revolute && model.tilt.shown > 0).then(|| {
                let back = model.tilt.turns_to_numbers(&model.joint.axis).transpose();
                let tilt: Vector2<f64> = posterior.mean.fixed_rows::<2>(at + TILT).into();
                (back * tilt, back * posterior.covariance.fixed_view::<2, 2>(at + TILT, at + TILT) * back.transpose())
            });
            posterior.joints.push(JointDynamics {
                label: model.joint.child,
                turn,
                damping: resisting(units[0], DAMPING, 2)?,
                friction: resisting(units[1], FRICTION, 0)?,
                joint_inertia: Quantity::from_log_normal(
                    units[2],
                    inertia,
                    inertia_deviation.hypot(MODEL_FLOOR),
                    informed(INERTIA, inertia_deviation),
                ),
                lower_limit: stop(0, LOWER),
                upper_limit: stop(1, UPPER),
            });
            let com = |x: &DVector<f64>| self.mechanism.center_of_mass(k, x.as_slice());
            let center = com(&posterior.mean);
            let mut com_covariance = Matrix3::zeros();
            let entries = [MASS, INERTIA, CENTER, CENTER + 1];
            let slopes = entries.map(|entry| {
                let mut moved = posterior.mean.clone();
                moved[at + entry] += 1e-5;
                (com(&moved) - center) * 1e5
            });
            for (a, i) in slopes.iter().zip(entries) {
                for (b, j) in slopes.iter().zip(entries) {
                    com_covariance += a * b.transpose() * posterior.covariance[(at + i, at + j)];
                }
            }
            // Along the axis nothing is learned; the hull says within a spread.
            com_covariance += Matrix3::from_diagonal(&model.hull.spread.map(|s| (0.3 * s).powi(2)));
            posterior.parts.push(PartDynamics {
                label: model.joint.child,
                mass: log_normal("kg", if revolute { MASS } else { INERTIA }),
                com_in_world: center,
                com_covariance,
            });
        }
        Ok(posterior)
    }

    /// The logarithm of a positive number of the tree at q = 0, and its standard deviation.
    fn log_of(
        &self,
        mean: &DVector<f64>,
        covariance: &DMatrix<f64>,
        number: impl Fn(&Tree<f64>) -> f64,
    ) -> Result<(f64, f64), Failure> {
        let axes: Vec<_> = self.mechanism.joints.iter().map(|m| m.joint.axis).collect();
        let value = |x: &DVector<f64>| {
            let tree = self.mechanism.tree(x.as_slice(), &axes, &vec![None; axes.len()])?;
            let number = number(&tree);
            if number > 0.0 { Ok(number.ln()) } else { Err(Failure::Diverged) }
        };
        let here = value(mean)?;
        let slope = DVector::from_iterator(
            mean.len(),
            (0..mean.len()).map(|i| {
                let mut moved = mean.clone();
                moved[i] += 1e-5;
                value(&moved).map_or(0.0, |v| (v - here) * 1e5)
            }),
        );
        Ok((here, slope.dot(&(covariance * &slope)).max(0.0).sqrt()))
    }

    /// The trees of the joints of the last kinematic fit by their numbers, laid out as
    /// [`DynamicsPosterior::mean`]; `None` where numbers make none.
    pub fn trees(&self) -> impl Fn(&DVector<f64>) -> Option<Tree<f64>> + Send + Sync + 'static {
        let mechanism = self.mechanism.clone();
        let axes: Vec<_> = mechanism.joints.iter().map(|m| m.joint.axis).collect();
        let frozen = vec![None; axes.len()];
        move |numbers| mechanism.tree(numbers.as_slice(), &axes, &frozen).ok()
    }

    /// The wrench sensor's errors, by numbers as [`DynamicsPosterior::mean`] has them.
    pub fn sensor_error(&self, numbers: &DVector<f64>) -> SensorError<f64> {
        self.mechanism.sensor_error(numbers.as_slice())
    }

    /// By joint, the root mean square of a force over time that has no name: what it will be is not known
    /// \[N or N·m\].
    pub fn unexplained_forces(&self, numbers: &DVector<f64>) -> Vec<f64> {
        let of_joint = |(k, model): (usize, &JointModel)| {
            let over_time =
                |table: &&AddedTable| matches!(table.kind, TableKind::ForceOverTime | TableKind::FrictionOverTime);
            let squares = model.tables.iter().enumerate().filter(|(_, table)| over_time(table)).map(|(t, table)| {
                let first = self.mechanism.offset(k) + model.table_offset(t);
                let entries = (first..first + table.nodes.len()).filter_map(|at| numbers.get(at));
                entries.map(|entry| (entry * table.scale).powi(2)).sum::<f64>() / table.nodes.len().max(1) as f64
            });
            squares.sum::<f64>().sqrt()
        };
        self.mechanism.joints.iter().enumerate().map(of_joint).collect()
    }

    /// The numbers that the equations of motion hold: (joint, place in [`DynamicsPosterior::mean`]). Without the
    /// directions of axes, so that motion stays along the axes that are published.
    pub fn active_numbers(&self) -> Vec<(usize, usize)> {
        let models = self.mechanism.joints.iter().enumerate();
        let held = |at: &usize| !(TILT..TILT + 2).contains(at);
        models
            .flat_map(|(k, m)| m.active().into_iter().filter(held).map(move |at| (k, self.mechanism.offset(k) + at)))
            .collect()
    }

    /// Numbers as [`DynamicsPosterior::mean`] has them, with every axis as it is published: hinges' by the
    /// kinematic fit alone.
    pub fn along_published_axes(&self, mut numbers: DVector<f64>) -> DVector<f64> {
        for (k, model) in self.mechanism.joints.iter().enumerate() {
            if model.joint.joint_type == JointType::Revolute {
                numbers.rows_mut(self.mechanism.offset(k) + TILT, 2).fill(0.0);
            }
        }
        numbers
    }
}
