//! Bytes in and out: bags, CDR messages, transforms, and the configuration file.
//!
//! `bag` delivers messages as bytes; `ingest` turns bytes into [`crate::types::Input`], in world,
//! and is shared by the replayer and the node. Nothing here repairs: what cannot be used is
//! dropped, counted by reason and reported once per cause.

pub mod bag;
pub mod cdr;
pub mod config;
pub mod counters;
pub mod definitions;
pub mod document;
pub mod import;
pub mod ingest;
pub mod messages;
pub mod model_file;
pub mod output_file;
pub mod point_cloud;
mod point_field;
pub mod pose_information;
pub mod recorded_windows;
mod resolve;
pub mod topics;
pub mod transforms;
