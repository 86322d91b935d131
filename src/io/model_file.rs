//! Saved models: a learned object with the bags that it was learned from, as JSON.
//!
//! `{"schema": "bom.model/3", "sha256": …, "content": {"bags": […], "object": {…}}}`: the sum is that of
//! the content's text, so that no damage is taken for an object. The same object gives the same bytes.

use std::{
    fs,
    io::{self, Write},
    path::{Path, PathBuf},
};

use serde::{Deserialize, Serialize};
use serde_json::value::RawValue;
use sha2::{Digest, Sha256};
use thiserror::Error;

use super::{bag::BagMessage, config::InputConfig, topics::Role};
use crate::pipeline::{SavedObject, SavedObjectRef};

/// Name and version of the format.
pub const SCHEMA: &str = "bom.model/3";

/// A saved model.
#[derive(Debug, Deserialize)]
pub struct SavedModel {
    /// [`BagHash`] of every bag that was learned, in order.
    pub bags: Vec<String>,
    /// What was learned.
    pub object: SavedObject,
}

#[derive(Serialize)]
struct Content<'a> {
    bags: &'a [String],
    object: &'a SavedObjectRef<'a>,
}

#[derive(Serialize, Deserialize)]
struct Envelope<'a> {
    schema: String,
    sha256: String,
    #[serde(borrow)]
    content: &'a RawValue,
}

/// Why there is no model.
#[derive(Debug, Error)]
pub enum ModelError {
    /// The file cannot be read.
    #[error("{}: {source}", path.display())]
    Read {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// It is something else, or cut short.
    #[error("{}: no saved model: {reason}", path.display())]
    NoModel {
        /// The file.
        path: PathBuf,
        /// What is wrong.
        reason: String,
    },
    /// The content is not what was saved.
    #[error("{}: damaged: the content's SHA-256 is {calculated}, expected {saved}", path.display())]
    Damaged {
        /// The file.
        path: PathBuf,
        /// As the file says.
        saved: String,
        /// As it is.
        calculated: String,
    },
    /// The model cannot be written.
    #[error("the model cannot be saved: {0}")]
    Write(String),
}

impl SavedModel {
    /// Reads a file.
    ///
    /// # Errors
    /// With the file and what is wrong with it.
    pub fn from_file(path: &Path) -> Result<Self, ModelError> {
        let text = fs::read_to_string(path).map_err(|source| ModelError::Read { path: path.to_owned(), source })?;
        Self::parse(&text, path)
    }

    /// Reads text; `path` is for error messages.
    ///
    /// # Errors
    /// What is wrong with it.
    pub fn parse(text: &str, path: &Path) -> Result<Self, ModelError> {
        #[derive(Deserialize)]
        struct Header {
            schema: String,
        }
        let no_model = |reason: String| ModelError::NoModel { path: path.to_owned(), reason };
        let header: Header = serde_json::from_str(text).map_err(|error| no_model(error.to_string()))?;
        if header.schema != SCHEMA {
            return Err(no_model(format!("schema `{}`, expected `{SCHEMA}`", header.schema)));
        }
        let envelope: Envelope<'_> = serde_json::from_str(text).map_err(|error| no_model(error.to_string()))?;
        let calculated = sha256(envelope.content.get().as_bytes());
        if calculated != envelope.sha256 {
            return Err(ModelError::Damaged { path: path.to_owned(), saved: envelope.sha256, calculated });
        }
        serde_json::from_str(envelope.content.get())
            .map_err(|error| no_model(format!("written by another version of this program: {error}")))
    }
}

/// Writes a model, with a line's end.
///
/// # Errors
/// A number that is not finite, before anything is written; or what the system said.
pub fn write_model(mut to: impl Write, bags: &[String], object: &SavedObjectRef<'_>) -> Result<(), ModelError> {
    let failed = |error: serde_json::Error| ModelError::Write(error.to_string());
    let content = serde_json::value::to_raw_value(&Content { bags, object }).map_err(failed)?;
    // A NaN would be written as null, and read as nothing: what cannot be read back is not written.
    serde_json::from_str::<SavedModel>(content.get()).map_err(failed)?;
    let envelope = Envelope { schema: SCHEMA.to_owned(), sha256: sha256(content.get().as_bytes()), content: &content };
    serde_json::to_writer(&mut to, &envelope).map_err(failed)?;
    writeln!(to).map_err(|error| ModelError::Write(error.to_string()))
}

/// What tells bags apart: the messages that are read of them, in order, whatever the file's name,
/// compression or log times.
#[derive(Clone, Debug, Default)]
pub struct BagHash(Sha256);

impl BagHash {
    /// Adds a message, if its topic is read.
    pub fn add(&mut self, message: &BagMessage, config: &InputConfig) {
        if Role::of(&message.topic.name, config).is_none() {
            return;
        }
        for field in [message.topic.name.as_bytes(), message.topic.type_name.as_bytes(), message.bytes()] {
            self.0.update((field.len() as u64).to_le_bytes());
            self.0.update(field);
        }
    }

    /// The hash, in hexadecimal digits.
    pub fn finish(self) -> String {
        hexadecimal(&self.0.finalize())
    }
}

fn sha256(bytes: &[u8]) -> String {
    hexadecimal(&Sha256::digest(bytes))
}

fn hexadecimal(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

#[cfg(test)]
mod tests {
    use super::*;

    fn error(text: &str) -> String {
        SavedModel::parse(text, Path::new("m.json")).unwrap_err().to_string()
    }

    #[test]
    fn what_is_no_model_is_named() {
        assert!(error("").starts_with("m.json: no saved model: EOF"), "{}", error(""));
        assert!(error("[1, 2]").starts_with("m.json: no saved model: "));
        assert!(
            error("{\"schema\": \"bom.posterior/1\", \"edges\": []}").contains("schema `bom.posterior/1`, expected")
        );
        let other = "{\"schema\": \"bom.model/3\", \"sha256\": \"00\", \"content\": {\"bags\": []}}";
        assert!(error(other).starts_with("m.json: damaged: the content's SHA-256 is "), "{}", error(other));
        let sum = sha256(b"{\"bags\": []}");
        let other = other.replace("\"00\"", &format!("\"{sum}\""));
        assert!(error(&other).contains("written by another version of this program: missing field `object`"));
    }
}
