//! Recorded tables of joint positions, poses or points and of forces → a bag that replay reads.
//!
//! A spec (TOML, `spec`) says what the columns are and what is known of the machine. Poses go to
//! `/parts/LABEL/pose`, wrenches to `/parts/LABEL/wrench`: what acts between two parts is a wrench on
//! the one and its opposite on the other. The bag's world has gravity along −z.

mod convert;
mod spec;
mod table;

use std::path::{Path, PathBuf};

use thiserror::Error;

pub use convert::{Imported, import};
pub use spec::ImportSpec;
pub use table::Table;

/// Why a table was not imported.
#[derive(Debug, Error)]
pub enum ImportError {
    /// A file cannot be read or written.
    #[error("{}: {reason}", path.display())]
    File {
        /// The file.
        path: PathBuf,
        /// What the system said.
        reason: String,
    },
    /// The spec does not make sense.
    #[error("{}: key `{key}`: {reason}", path.display())]
    Spec {
        /// The spec's file.
        path: PathBuf,
        /// From the top, as `parts[0].position`.
        key: String,
        /// What was expected, what was there.
        reason: String,
    },
    /// The table is not what the spec says.
    #[error("{}: column `{column}`: {reason}", path.display())]
    Column {
        /// The table's file.
        path: PathBuf,
        /// By its name in the first line.
        column: String,
        /// What was expected, what was there.
        reason: String,
    },
    /// One of its values is no number, or not in order.
    #[error("{}: line {line}, column `{column}`: {reason}", path.display())]
    Value {
        /// The table's file.
        path: PathBuf,
        /// From 1; the names of the columns are line 1.
        line: u64,
        /// By its name in the first line.
        column: String,
        /// What was expected, what was there.
        reason: String,
    },
}

impl ImportError {
    fn file(path: &Path, reason: impl ToString) -> Self {
        Self::File { path: path.to_owned(), reason: reason.to_string() }
    }
}
