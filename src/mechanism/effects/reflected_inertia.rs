//! Inertia of what turns with the joint and is carried by nothing else: a motor behind a gear.

use super::{Dimension, Effect, Parameter};
use crate::math::Real;

/// −inertia · q̈, as an armature: it adds to the diagonal of M (Featherstone, Rigid Body Dynamics Algorithms, §9.6).
///
/// On a joint that nothing moving carries it is part of the inertia; one that a moving part carries tells them apart.
#[derive(Clone, Copy, Debug)]
pub struct ReflectedInertia;

impl Effect for ReflectedInertia {
    const NAME: &'static str = "reflected_inertia";
    const PARAMETERS: &'static [Parameter] = &[Parameter::positive("inertia", Dimension::Inertia, 0.1, 1.5)];

    fn armature<T: Real>(parameters: &[T]) -> T {
        parameters[0]
    }
}
