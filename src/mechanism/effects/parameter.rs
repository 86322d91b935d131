//! Parameters of effects: dimension, unit, and how a standard normal θ becomes a physical value.

use serde::{Deserialize, Serialize};

use super::super::joint::JointType;
use crate::math::Real;

/// The sizes that make priors dimensionless, taken from the data or the setting.
#[derive(Clone, Copy, Debug, PartialEq, Serialize, Deserialize)]
pub struct Scales {
    /// Of the generalized force on the joint \[N or N·m\].
    pub force: f64,
    /// Of its travel \[m or rad\].
    pub position: f64,
    /// Of its rate \[m/s or rad/s\].
    pub rate: f64,
    /// Of the record \[s\].
    pub duration_s: f64,
}

/// What a parameter measures.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Dimension {
    /// N or N·m.
    Force,
    /// m or rad.
    Position,
    /// m/s or rad/s.
    Rate,
    /// N/m or N·m/rad.
    Stiffness,
    /// N·s/m or N·m·s/rad.
    Damping,
    /// N·s²/m² or N·m·s²/rad².
    Drag,
    /// kg or kg·m².
    Inertia,
    /// rad, of a periodic law.
    Phase,
    /// s.
    Time,
}

impl Dimension {
    /// The unit on a joint of this type (a rigid joint is treated as prismatic).
    pub fn unit(self, joint: JointType) -> &'static str {
        let turns = joint == JointType::Revolute;
        match self {
            Self::Force => {
                if turns {
                    "N·m"
                } else {
                    "N"
                }
            }
            Self::Position => {
                if turns {
                    "rad"
                } else {
                    "m"
                }
            }
            Self::Rate => {
                if turns {
                    "rad/s"
                } else {
                    "m/s"
                }
            }
            Self::Stiffness => {
                if turns {
                    "N·m/rad"
                } else {
                    "N/m"
                }
            }
            Self::Damping => {
                if turns {
                    "N·m·s/rad"
                } else {
                    "N·s/m"
                }
            }
            Self::Drag => {
                if turns {
                    "N·m·s²/rad²"
                } else {
                    "N·s²/m²"
                }
            }
            Self::Inertia => {
                if turns {
                    "kg·m²"
                } else {
                    "kg"
                }
            }
            Self::Phase => "rad",
            Self::Time => "s",
        }
    }

    /// One unit of prior width.
    pub fn scale(self, scales: &Scales) -> f64 {
        match self {
            Self::Force => scales.force,
            Self::Position => scales.position,
            Self::Rate => scales.rate,
            Self::Stiffness => scales.force / scales.position,
            Self::Damping => scales.force / scales.rate,
            Self::Drag => scales.force / (scales.rate * scales.rate),
            // A rate is reached in about half a second.
            Self::Inertia => 0.5 * scales.force / scales.rate,
            Self::Phase => 1.0,
            Self::Time => scales.duration_s,
        }
    }
}

/// The physical value of θ ~ N(0, 1), in units of the dimension's scale.
#[derive(Clone, Copy, Debug, PartialEq)]
pub enum Prior {
    /// median · exp(log_sd θ): positive.
    LogNormal {
        /// Value at θ = 0.
        median: f64,
        /// Standard deviation of the logarithm.
        log_sd: f64,
    },
    /// mean + sd θ: any sign.
    Normal {
        /// Value at θ = 0.
        mean: f64,
        /// Standard deviation.
        sd: f64,
    },
}

/// One parameter of an effect.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct Parameter {
    /// The name used in files.
    pub name: &'static str,
    /// What it measures.
    pub dimension: Dimension,
    /// Where it comes from.
    pub prior: Prior,
}

impl Parameter {
    /// A positive parameter: median in units of its scale, standard deviation of its logarithm.
    pub const fn positive(name: &'static str, dimension: Dimension, median: f64, log_sd: f64) -> Self {
        Self { name, dimension, prior: Prior::LogNormal { median, log_sd } }
    }

    /// A parameter of either sign: mean and standard deviation in units of its scale.
    pub const fn signed(name: &'static str, dimension: Dimension, mean: f64, sd: f64) -> Self {
        Self { name, dimension, prior: Prior::Normal { mean, sd } }
    }

    /// The physical value for the unconstrained `theta`.
    pub fn physical<T: Real>(&self, theta: T, scales: &Scales) -> T {
        let scale = self.dimension.scale(scales);
        match self.prior {
            Prior::LogNormal { median, log_sd } => (theta * T::constant(log_sd)).exp() * T::constant(median * scale),
            Prior::Normal { mean, sd } => (theta * T::constant(sd) + T::constant(mean)) * T::constant(scale),
        }
    }

    /// The unconstrained θ of a physical value; `None` where the prior excludes it.
    pub fn unconstrained(&self, physical: f64, scales: &Scales) -> Option<f64> {
        let relative = physical / self.dimension.scale(scales);
        match self.prior {
            Prior::LogNormal { median, log_sd } => (relative > 0.0).then(|| (relative / median).ln() / log_sd),
            Prior::Normal { mean, sd } => Some((relative - mean) / sd),
        }
    }
}

#[cfg(test)]
mod tests {
    use super::super::EffectKind;
    use super::*;

    #[test]
    fn unconstrained_undoes_physical() {
        let scales = Scales { force: 5.0, position: 0.3, rate: 0.2, duration_s: 3.0 };
        for parameter in EffectKind::ALL.iter().flat_map(|kind| kind.parameters()) {
            let physical = parameter.physical(0.7, &scales);
            let theta = parameter.unconstrained(physical, &scales).unwrap();
            assert!((theta - 0.7).abs() < 1e-12, "{}", parameter.name);
        }
    }

    #[test]
    fn positive_parameters_have_no_negative_values() {
        let parameter = Parameter::positive("stiffness", Dimension::Stiffness, 1.0, 1.0);
        let scales = Scales { force: 1.0, position: 1.0, rate: 1.0, duration_s: 1.0 };
        assert_eq!(parameter.unconstrained(-1.0, &scales), None);
        assert_eq!(parameter.dimension.unit(JointType::Revolute), "N·m/rad");
    }
}
