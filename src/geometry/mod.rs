//! Shapes of parts: convex hulls and their mass properties. The only layer that knows parry.

mod hull;
mod shape;

pub use hull::{HullProperties, hull_properties};
pub use shape::{Surface, TurnedBox};
