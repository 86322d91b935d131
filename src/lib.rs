//! Online Bayesian inference of an articulated object's mechanism.
//!
//! Segmented part point clouds and applied wrenches go in; a posterior over the object's kinematic
//! tree, joint types, screw axes, friction, damping and inertia comes out, window by window.
//!
//! # Notation
//! SI units. Twists and wrenches are (angular, linear) six-vectors. `world_from_part` maps points
//! of the part into world; chains read `world_from_child = world_from_parent * parent_from_child`.
//! Screws are world-frame at the reference configuration, the first frame, where every joint
//! position is zero: `D_child = D_parent · exp(S q)` for displacements `D` since that frame.
//! A wrench is what the tool does **to** the object, its moment about the world origin.
//!
//! # Layers
//! Each module may use those before it in this list, never those after it; `tests/layers.rs` is
//! the wall: `math`, `types`, `geometry`, `registration`, `mechanism`, `structure`, `inference`,
//! `model`, `tracking`, `pipeline`, `io`, `report`, `ros`, `node`.

pub mod criticism;
pub mod geometry;
pub mod inference;
pub mod io;
pub mod math;
pub mod mechanism;
pub mod model;
pub mod node;
pub mod pipeline;
pub mod registration;
pub mod report;
pub mod ros;
pub mod structure;
pub mod tracking;
pub mod types;
