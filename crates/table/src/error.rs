//! Errors of a table, with what is needed to correct them.

use std::path::PathBuf;

/// A table that could not be read or written: position and problem.
#[derive(Debug, thiserror::Error)]
#[error("{}{}: {problem}", path.display(), line.map(|line| format!(":{line}")).unwrap_or_default())]
pub struct TableError {
    /// The file.
    pub path: PathBuf,
    /// The line, counted from 1 with the header, if the problem is at one.
    pub line: Option<usize>,
    /// What is wrong.
    pub problem: TableProblem,
}

/// The problem of a table.
#[derive(Debug, thiserror::Error)]
pub enum TableProblem {
    /// The file could not be read.
    #[error("cannot be read: {0}")]
    Read(std::io::Error),
    /// The file could not be written.
    #[error("cannot be written: {0}")]
    Write(std::io::Error),
    /// Not text in UTF-8.
    #[error("is not text (UTF-8); a record is a CSV file with the columns time_s,pzt_um,bead_um")]
    NotText,
    /// More text than can be parsed.
    #[error("is larger than 4 GB; cut it into parts, or give the run's folder")]
    TooLarge,
    /// No rows at all.
    #[error("has no rows")]
    Empty,
    /// Numbers instead of column names: a text without a header, or an array.
    #[error(
        "its columns have no names (it begins with numbers): say which column is which by its number from 1, and the sampling \
         rate; or, in a text file, write `time_s,pzt_um,bead_um` above them"
    )]
    NoHeader,
    /// A column is missing.
    #[error("has no column `{wanted}`; it has {}{}", list(found), hint.as_ref().map(|hint| format!("; {hint}")).unwrap_or_default())]
    MissingColumn {
        /// The column asked for.
        wanted: String,
        /// The columns that exist.
        found: Vec<String>,
        /// What was probably meant.
        hint: Option<String>,
    },
    /// The column exists in another unit.
    #[error(
        "column `{column}` is in {unit}, but `{wanted}` is needed: convert it{}, or map the column with its factor",
        factor.map(|factor| format!(" (multiply by {factor}) and rename it `{wanted}`")).unwrap_or_default()
    )]
    WrongUnit {
        /// The column found.
        column: String,
        /// The unit its name says.
        unit: &'static str,
        /// The column needed.
        wanted: String,
        /// Factor from the one to the other, if it is fixed.
        factor: Option<f64>,
    },
    /// Two columns have the same name.
    #[error("has two columns named `{0}`")]
    DuplicateColumn(String),
    /// A line has too few or too many fields.
    #[error("{found} fields, but the header names {expected} columns")]
    Fields {
        /// Fields that the header asks for.
        expected: usize,
        /// Fields in the line.
        found: usize,
    },
    /// A field is not a finite number.
    #[error("column `{column}`: `{text}` is not a finite number; {help}")]
    Cell {
        /// The column.
        column: String,
        /// The field, cut to a readable length.
        text: String,
        /// What would be right.
        help: &'static str,
    },
    /// Time does not advance or runs backwards.
    #[error("time goes from {before_s} s to {time_s} s; it must grow from row to row")]
    TimeOrder {
        /// Time of the row before.
        before_s: f64,
        /// Time of this row.
        time_s: f64,
    },
    /// A step differs too much from the others.
    #[error(
        "a step of {step_s} s where the others are {expected_s} s; a record must be sampled evenly (rows missing from \
         an otherwise even record can be allowed: the command is then held and the bead counted as not seen)"
    )]
    Sampling {
        /// The step before this row.
        step_s: f64,
        /// The usual step.
        expected_s: f64,
    },
    /// More rows are missing than present.
    #[error("{missing} rows are missing and only {present} present: this is not one record")]
    TooManyGaps {
        /// Rows missing.
        missing: usize,
        /// Rows present.
        present: usize,
    },
    /// Too few rows to know the sampling step.
    #[error("has {rows} row(s); at least two are needed to know the sampling step")]
    TooShort {
        /// Rows present.
        rows: usize,
    },
    /// A setting of the mapping is invalid.
    #[error("`{key}` = {value}: {help}")]
    Setting {
        /// The setting.
        key: &'static str,
        /// Its value.
        value: f64,
        /// What would be right.
        help: &'static str,
    },
}

fn list(names: &[String]) -> String {
    let mut text = names
        .iter()
        .take(20)
        .map(|name| format!("`{name}`"))
        .collect::<Vec<_>>()
        .join(", ");
    if names.len() > 20 {
        text.push_str(", ...");
    }
    text
}
