//! Undeclared effects on a joint: additive generalized forces, damping, friction bounds.
//!
//! One file each. x is the distance from the closed or reference position, v its rate, opening
//! positive. Parameters are physical; [`Parameter::physical`] makes them from standard normal θ.

mod asymmetric_friction;
mod catch;
mod detent;
mod drag;
mod gravity_offset;
mod impulse;
mod parameter;
mod position_friction;
mod reflected_inertia;
mod self_closing;
mod soft_close;
mod spring;
mod stribeck;
mod table;

pub use asymmetric_friction::AsymmetricFriction;
pub use catch::Catch;
pub use detent::Detent;
pub use drag::Drag;
pub use gravity_offset::GravityOffset;
pub use impulse::Impulse;
pub use parameter::{Dimension, Parameter, Prior, Scales};
pub use position_friction::PositionFriction;
pub use reflected_inertia::ReflectedInertia;
pub use self_closing::SelfClosing;
pub use soft_close::SoftClose;
pub use spring::Spring;
pub use stribeck::Stribeck;
pub use table::{AttachedTable, TableKind, TableSpan};

use serde::{Deserialize, Serialize};

use super::friction::FrictionBounds;
use super::parameters::JointForces;
use crate::math::Real;

/// Most parameters that an effect has.
pub const MAX_PARAMETERS: usize = 4;

/// Where a joint is, as an effect sees it.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct JointState<T: Real> {
    /// x or q \[m or rad\].
    pub position: T,
    /// v or q̇ \[m/s or rad/s\].
    pub rate: T,
    /// q̈ as of the step before \[m/s² or rad/s²\].
    pub acceleration: T,
    /// Middle of the step \[s\].
    pub time_s: f64,
    /// Length of the step \[s\], for what lasts no longer than one.
    pub step_s: f64,
}

/// One kind of effect: a law with named parameters. What it does not say stays as declared.
pub trait Effect {
    /// The name used in files.
    const NAME: &'static str;
    /// The parameters, in the order that the other functions take them.
    const PARAMETERS: &'static [Parameter];

    /// The force that is not damping \[N or N·m\], opening positive.
    fn force<T: Real>(_parameters: &[T], _joint: &JointState<T>) -> T {
        T::zero()
    }

    /// d in −d v \[N·s/m or N·m·s/rad\], instead of the `declared` one.
    fn damping<T: Real>(_parameters: &[T], _joint: &JointState<T>, declared: T) -> T {
        declared
    }

    /// The friction bounds, instead of the `declared` ones.
    fn friction_bounds<T: Real>(
        _parameters: &[T],
        _joint: &JointState<T>,
        declared: FrictionBounds<T>,
    ) -> FrictionBounds<T> {
        declared
    }

    /// Inertia added to the diagonal of M, of nothing that the tree carries \[kg or kg·m²\].
    fn armature<T: Real>(_parameters: &[T]) -> T {
        T::zero()
    }
}

macro_rules! effect_kinds {
    ($($kind:ident),* $(,)?) => {
        /// The effects that act on a joint.
        #[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
        #[serde(rename_all = "snake_case")]
        pub enum EffectKind {
            $(#[doc = concat!("See [`struct@", stringify!($kind), "`].")] $kind,)*
        }

        impl EffectKind {
            /// Every kind.
            pub const ALL: &[Self] = &[$(Self::$kind),*];

            /// The name used in files.
            pub fn name(self) -> &'static str {
                match self { $(Self::$kind => $kind::NAME,)* }
            }

            /// The parameters, in order.
            pub fn parameters(self) -> &'static [Parameter] {
                match self { $(Self::$kind => $kind::PARAMETERS,)* }
            }

            fn force<T: Real>(self, parameters: &[T], joint: &JointState<T>) -> T {
                match self { $(Self::$kind => $kind::force(parameters, joint),)* }
            }

            fn damping<T: Real>(self, parameters: &[T], joint: &JointState<T>, declared: T) -> T {
                match self { $(Self::$kind => $kind::damping(parameters, joint, declared),)* }
            }

            fn armature<T: Real>(self, parameters: &[T]) -> T {
                match self { $(Self::$kind => $kind::armature(parameters),)* }
            }

            fn friction_bounds<T: Real>(
                self,
                parameters: &[T],
                joint: &JointState<T>,
                declared: FrictionBounds<T>,
            ) -> FrictionBounds<T> {
                match self {
                    $(Self::$kind => $kind::friction_bounds(parameters, joint, declared),)*
                }
            }
        }
    };
}

effect_kinds!(
    Spring,
    Catch,
    SoftClose,
    Detent,
    SelfClosing,
    Stribeck,
    AsymmetricFriction,
    Drag,
    PositionFriction,
    GravityOffset,
    Impulse,
    ReflectedInertia,
);

/// An effect on one joint, with its parameters and the direction that counts as opening.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct AttachedEffect<T: Real> {
    /// Which effect.
    pub kind: EffectKind,
    /// Its parameters, in the order of [`EffectKind::parameters`]; the rest is not read.
    pub parameters: [T; MAX_PARAMETERS],
    /// The joint position where x = 0 \[m or rad\].
    pub reference: T,
    /// Whether x grows as q falls.
    pub reversed: bool,
}

impl<T: Real> AttachedEffect<T> {
    /// The effect with x = q, parameters in the order of [`EffectKind::parameters`]; what is not
    /// given is zero.
    pub fn new(kind: EffectKind, parameters: &[T]) -> Self {
        let mut all = [T::zero(); MAX_PARAMETERS];
        for (slot, parameter) in all.iter_mut().zip(parameters) {
            *slot = *parameter;
        }
        Self { kind, parameters: all, reference: T::zero(), reversed: false }
    }

    /// `forces` with this effect on top, in the joint's own direction.
    pub fn apply(&self, joint: &JointState<T>, forces: JointForces<T>) -> JointForces<T> {
        let distance = joint.position - self.reference;
        let (opening, declared) = if self.reversed {
            let opening =
                JointState { position: -distance, rate: -joint.rate, acceleration: -joint.acceleration, ..*joint };
            (opening, forces.friction.reversed())
        } else {
            (JointState { position: distance, ..*joint }, forces.friction)
        };
        let force = self.kind.force(&self.parameters, &opening);
        let friction = self.kind.friction_bounds(&self.parameters, &opening, declared);
        JointForces {
            force: if self.reversed { forces.force - force } else { forces.force + force },
            damping: self.kind.damping(&self.parameters, &opening, forces.damping),
            friction: if self.reversed { friction.reversed() } else { friction },
        }
    }

    /// Inertia that it adds to the diagonal of M \[kg or kg·m²\].
    pub fn armature(&self) -> T {
        self.kind.armature(&self.parameters)
    }

    /// What the effect adds to the generalized force on a joint that moves \[N or N·m\], damping
    /// and change of friction included: its signature in a residual.
    pub fn added_force(&self, joint: &JointState<T>, declared: &JointForces<T>) -> T {
        let with = self.apply(joint, *declared);
        let added = with.force - declared.force - (with.damping - declared.damping) * joint.rate;
        if joint.rate.value() > 0.0 {
            added - (with.friction.against_plus - declared.friction.against_plus)
        } else if joint.rate.value() < 0.0 {
            added + (with.friction.against_minus - declared.friction.against_minus)
        } else {
            added
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::math::gradient::assert_gradient;
    use num_dual::DualSVec64;

    type Dual = DualSVec64<6>;

    const STATES: [(f64, f64); 6] =
        [(0.05, 0.3), (0.05, -0.3), (0.012, 0.02), (0.3, -0.05), (0.0031, 0.4), (-0.02, -0.1)];
    const SCALES: Scales = Scales { force: 5.0, position: 0.3, rate: 0.2, duration_s: 3.0 };

    #[test]
    fn names_are_those_of_the_files() {
        for kind in EffectKind::ALL {
            let text = serde_json::to_string(kind).unwrap();
            assert_eq!(text, format!("\"{}\"", kind.name()));
            assert!(!kind.parameters().is_empty() && kind.parameters().len() <= MAX_PARAMETERS);
        }
    }

    #[test]
    fn every_effect_has_its_gradient() {
        for kind in EffectKind::ALL {
            for (position, rate) in STATES {
                for reversed in [false, true] {
                    let theta = [0.31, -0.27, 0.43, 0.12];
                    let point = [theta[0], theta[1], theta[2], theta[3], position, rate];
                    let law = |x: &[Dual; 6]| {
                        let mut effect = AttachedEffect::new(*kind, &[]);
                        effect.reversed = reversed;
                        for (i, parameter) in kind.parameters().iter().enumerate() {
                            effect.parameters[i] = parameter.physical(x[i], &SCALES);
                        }
                        let joint = JointState {
                            position: x[4],
                            rate: x[5],
                            acceleration: Dual::constant(0.0),
                            time_s: 1.9,
                            step_s: 1e-3,
                        };
                        let declared = JointForces {
                            force: Dual::constant(0.0),
                            damping: Dual::constant(2.0),
                            friction: FrictionBounds::symmetric(Dual::constant(3.0)),
                        };
                        effect.added_force(&joint, &declared)
                    };
                    assert_gradient(law, &point, 1e-6, 1e-5);
                }
            }
        }
    }

    #[test]
    fn a_reversed_effect_is_the_mirror_image() {
        for kind in EffectKind::ALL {
            let theta = [0.31, -0.27, 0.43, 0.12];
            let parameters: Vec<f64> =
                kind.parameters().iter().zip(theta).map(|(p, t)| p.physical(t, &SCALES)).collect();
            let plain = AttachedEffect::new(*kind, &parameters);
            let mirrored = AttachedEffect { reversed: true, ..plain };
            let declared = JointForces {
                force: 0.0,
                damping: 2.0,
                friction: FrictionBounds { against_plus: 3.0, against_minus: 1.0 },
            };
            let reversed = JointForces { friction: declared.friction.reversed(), ..declared };
            for (position, rate) in STATES {
                let joint = JointState { position, rate, acceleration: 0.0, time_s: 1.9, step_s: 1e-3 };
                let mirror = JointState { position: -position, rate: -rate, ..joint };
                let force = plain.added_force(&joint, &declared);
                assert!((force + mirrored.added_force(&mirror, &reversed)).abs() < 1e-12);
            }
        }
    }
}
