//! `posterior.json`: the posterior with its schema's name and what was counted on the way to it.

use std::io::Write;

use serde::{Deserialize, Serialize};
use thiserror::Error;

use super::counters::Counters;
use crate::types::finite::{NotFinite, check_finite};
use crate::types::posterior::ObjectPosterior;

/// Name and version of the format.
pub const SCHEMA: &str = "bom.posterior/1";

/// The whole file.
#[derive(Clone, Debug, PartialEq, Serialize, Deserialize)]
pub struct PosteriorDocument {
    /// [`SCHEMA`].
    pub schema: String,
    /// What is believed.
    #[serde(flatten)]
    pub posterior: ObjectPosterior,
    /// What came in and what was dropped.
    pub counters: Counters,
}

/// Why a document could not be written.
#[derive(Debug, Error)]
pub enum DocumentError {
    /// A number that JSON cannot hold.
    #[error(transparent)]
    NotFinite(#[from] NotFinite),
    /// The system refused.
    #[error(transparent)]
    Write(#[from] serde_json::Error),
}

impl PosteriorDocument {
    /// Joins the two.
    pub fn new(posterior: ObjectPosterior, counters: Counters) -> Self {
        Self { schema: SCHEMA.to_owned(), posterior, counters }
    }

    /// Writes it as JSON, with a line's end.
    ///
    /// # Errors
    /// A number that is not finite, by name, before anything is written; or what the system said.
    pub fn write(&self, mut to: impl Write) -> Result<(), DocumentError> {
        check_finite(self)?;
        serde_json::to_writer_pretty(&mut to, self)?;
        writeln!(to).map_err(serde_json::Error::io)?;
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::types::{Label, posterior::Criticism};

    fn document() -> PosteriorDocument {
        let posterior = ObjectPosterior {
            root_label: Label(3),
            parts: Vec::new(),
            edges: Vec::new(),
            windows: Vec::new(),
            criticism: Criticism::insufficient(),
        };
        PosteriorDocument::new(posterior, Counters { clouds_in: 7, ..Counters::default() })
    }

    #[test]
    fn what_is_written_reads_back() {
        let mut text = Vec::new();
        document().write(&mut text).unwrap();
        assert_eq!(serde_json::from_slice::<PosteriorDocument>(&text).unwrap(), document());
        let value: serde_json::Value = serde_json::from_slice(&text).unwrap();
        assert_eq!(value["schema"], "bom.posterior/1");
        assert_eq!(value["root_label"], 3);
        assert_eq!(value["criticism"]["verdict"], "insufficient");
        assert_eq!(value["counters"]["clouds_in"], 7);
    }

    #[test]
    fn nothing_is_written_with_a_nan() {
        let mut document = document();
        document.posterior.windows.push(crate::types::posterior::WindowRecord {
            t0_s: f64::NAN,
            t1_s: 0.0,
            labels: Vec::new(),
            frames: 0,
            steps: 0,
            inference_wall_s: 0.0,
            elbo: None,
            log_predictive_density: None,
        });
        let mut text = Vec::new();
        let error = document.write(&mut text).unwrap_err();
        assert_eq!(error.to_string(), "windows[0].t0_s: NaN, expected a finite number");
        assert!(text.is_empty());
    }
}
