//! No NaN and no infinity leaves the program: JSON would turn them into null without a word.

use serde::Serialize;
use serde_yaml_ng::Value;
use thiserror::Error;

/// Why a value must not be written.
#[derive(Clone, Debug, PartialEq, Eq, Error)]
pub enum NotFinite {
    /// A number that is NaN or infinite.
    #[error("{field}: {value}, expected a finite number")]
    Number {
        /// The field from the top, as `edges[2].damping.mean`.
        field: String,
        /// `NaN`, `inf` or `-inf`.
        value: String,
    },
    /// The value has no self-describing form, such as a map with keys that are no strings.
    #[error("cannot be looked through for numbers: {0}")]
    Opaque(String),
}

/// Looks through every number of a value, whatever its type.
///
/// # Errors
/// The first number that is not finite, by name.
pub fn check_finite<T: Serialize>(value: &T) -> Result<(), NotFinite> {
    // A YAML value, unlike a JSON one, keeps NaN and infinity apart from null.
    let tree = serde_yaml_ng::to_value(value).map_err(|error| NotFinite::Opaque(error.to_string()))?;
    check(&tree, "")
}

fn check(value: &Value, field: &str) -> Result<(), NotFinite> {
    match value {
        Value::Number(number) => match number.as_f64() {
            Some(x) if !x.is_finite() => Err(NotFinite::Number { field: field.to_owned(), value: x.to_string() }),
            _ => Ok(()),
        },
        Value::Sequence(items) => {
            items.iter().enumerate().try_for_each(|(index, item)| check(item, &format!("{field}[{index}]")))
        }
        Value::Mapping(entries) => entries.iter().try_for_each(|(key, item)| {
            let key = key.as_str().unwrap_or("?");
            let dot = if field.is_empty() { "" } else { "." };
            check(item, &format!("{field}{dot}{key}"))
        }),
        Value::Tagged(tagged) => check(&tagged.value, field),
        Value::Null | Value::Bool(_) | Value::String(_) => Ok(()),
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Serialize)]
    struct Inner {
        mean: f64,
        rows: [[f64; 2]; 2],
    }

    #[derive(Serialize)]
    struct Outer {
        count: u64,
        nothing: Option<f64>,
        items: Vec<Inner>,
    }

    fn outer(mean: f64, last: f64) -> Outer {
        let inner = |mean| Inner { mean, rows: [[0.0, 1.0], [2.0, last]] };
        Outer { count: u64::MAX, nothing: None, items: vec![inner(1.0), inner(mean)] }
    }

    #[test]
    fn finite_numbers_pass() {
        assert_eq!(check_finite(&outer(f64::MAX, -0.0)), Ok(()));
    }

    #[test]
    fn the_field_is_named() {
        let said = |outer: &Outer| check_finite(outer).unwrap_err().to_string();
        assert_eq!(said(&outer(f64::NAN, 0.0)), "items[1].mean: NaN, expected a finite number");
        assert_eq!(said(&outer(0.0, f64::NEG_INFINITY)), "items[0].rows[1][1]: -inf, expected a finite number");
    }
}
