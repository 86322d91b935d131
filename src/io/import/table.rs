//! A CSV table with names in its first line; numbers are read when they are asked for.

use std::path::{Path, PathBuf};

use super::{
    ImportError,
    spec::{ColumnSpec, SweepSpec},
};

/// A table in memory.
#[derive(Clone, Debug)]
pub struct Table {
    path: PathBuf,
    names: Vec<String>,
    rows: Vec<Row>,
}

#[derive(Clone, Debug)]
struct Row {
    line: u64,
    cells: Vec<String>,
}

/// A column found in a table.
#[derive(Clone, Debug)]
pub(super) struct Column {
    index: usize,
    gain: f64,
    offset: f64,
}

impl Table {
    /// Reads a file.
    ///
    /// # Errors
    /// If it cannot be read, or a row has more or fewer cells than there are names.
    pub fn from_file(path: &Path) -> Result<Self, ImportError> {
        let fail = |error: csv::Error| ImportError::file(path, error);
        let mut reader = csv::ReaderBuilder::new().trim(csv::Trim::All).from_path(path).map_err(fail)?;
        let names = reader.headers().map_err(fail)?.iter().map(str::to_owned).collect();
        let mut rows = Vec::new();
        for record in reader.records() {
            let record = record.map_err(fail)?;
            let line = record.position().map_or(0, csv::Position::line);
            rows.push(Row { line, cells: record.iter().map(str::to_owned).collect() });
        }
        if rows.is_empty() {
            return Err(ImportError::file(path, "no rows after the names of the columns"));
        }
        Ok(Self { path: path.to_owned(), names, rows })
    }

    /// How many rows it has.
    pub fn len(&self) -> usize {
        self.rows.len()
    }

    /// Whether it has none.
    pub fn is_empty(&self) -> bool {
        self.rows.is_empty()
    }

    pub(super) fn path(&self) -> &Path {
        &self.path
    }

    fn index(&self, name: &str) -> Result<usize, ImportError> {
        self.names.iter().position(|found| found == name).ok_or_else(|| ImportError::Column {
            path: self.path.clone(),
            column: name.to_owned(),
            reason: format!("not in the table, which has {}", self.names.join(", ")),
        })
    }

    pub(super) fn column(&self, spec: &ColumnSpec) -> Result<Column, ImportError> {
        let (name, gain, offset) = spec.parts();
        Ok(Column { index: self.index(name)?, gain, offset })
    }

    pub(super) fn columns<const N: usize>(&self, specs: &[ColumnSpec; N]) -> Result<[Column; N], ImportError> {
        let found: Vec<Column> = specs.iter().map(|spec| self.column(spec)).collect::<Result<_, _>>()?;
        found.try_into().map_err(|_| ImportError::file(&self.path, "columns"))
    }

    /// The value of a column in a row, SI.
    pub(super) fn value(&self, row: usize, column: &Column) -> Result<f64, ImportError> {
        let text = self.rows[row].cells.get(column.index).map_or("", String::as_str);
        let number = text.parse::<f64>().ok().filter(|number| number.is_finite());
        let number = number.ok_or_else(|| self.bad(row, column, format!("`{text}`, expected a number")))?;
        Ok(column.gain * number + column.offset)
    }

    /// Whether a row has nothing in a column.
    pub(super) fn is_empty_at(&self, row: usize, column: &Column) -> bool {
        self.rows[row].cells.get(column.index).is_none_or(String::is_empty)
    }

    /// An error about one value.
    pub(super) fn bad(&self, row: usize, column: &Column, reason: String) -> ImportError {
        let name = self.names.get(column.index).cloned().unwrap_or_default();
        ImportError::Value { path: self.path.clone(), line: self.rows[row].line, column: name, reason }
    }

    /// The rows whose column holds a text.
    ///
    /// # Errors
    /// If there is no such column or no such row.
    pub(super) fn select(mut self, column: &str, text: &str) -> Result<Self, ImportError> {
        let index = self.index(column)?;
        let mut others: Vec<String> = self.rows.iter().filter_map(|row| row.cells.get(index).cloned()).collect();
        self.rows.retain(|row| row.cells.get(index).is_some_and(|cell| cell == text));
        if self.rows.is_empty() {
            others.sort();
            others.dedup();
            others.truncate(30);
            let reason = format!("no row holds `{text}`; it holds {}", others.join(", "));
            return Err(ImportError::Column { path: self.path, column: column.to_owned(), reason });
        }
        Ok(self)
    }

    /// A table with one row for each reading of the sweeps; with each row, which run it is of.
    ///
    /// # Errors
    /// If a column is not there.
    pub(super) fn swept(self, sweep: &SweepSpec) -> Result<(Self, Vec<usize>), ImportError> {
        let indices: Vec<(i64, usize)> = (sweep.from..=sweep.to)
            .map(|i| Ok((i, self.index(&sweep.columns.replace("{}", &i.to_string()))?)))
            .collect::<Result<_, ImportError>>()?;
        let (mut rows, mut runs) = (Vec::new(), Vec::new());
        for (run, row) in self.rows.iter().enumerate() {
            for (i, index) in &indices {
                let value = row.cells.get(*index).cloned().unwrap_or_default();
                rows.push(Row { line: row.line, cells: vec![i.to_string(), value] });
                runs.push(run);
            }
        }
        let names = vec![sweep.index.clone(), sweep.value.clone()];
        Ok((Self { path: self.path, names, rows }, runs))
    }
}
