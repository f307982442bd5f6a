//! Columns of anybody's text files: CSV with a header, or numbers separated by white space, commas or semicolons.

use std::path::{Path, PathBuf};

/// Why a column could not be read.
#[derive(Debug, thiserror::Error)]
pub enum ColumnError {
    /// The file cannot be read.
    #[error("{file}: cannot be read ({reason})")]
    Unreadable {
        /// The file.
        file: PathBuf,
        /// What the system says.
        reason: std::io::Error,
    },
    /// There is no such column.
    #[error(
        "{file}: there is no column {wanted}; there are {found}. Name a column of the header, or give its number from 1"
    )]
    NoColumn {
        /// The file.
        file: PathBuf,
        /// What was asked for.
        wanted: String,
        /// What there is.
        found: String,
    },
    /// A cell is not a number.
    #[error(
        "{file}, line {line}: column {column} holds `{text}`, which is not a number (an empty cell of the output means: no bead)"
    )]
    NotANumber {
        /// The file.
        file: PathBuf,
        /// Line from 1.
        line: usize,
        /// The column.
        column: String,
        /// What stands there.
        text: String,
    },
    /// A line has too few columns.
    #[error("{file}, line {line}: {found} columns, but column {wanted} is asked for")]
    ShortLine {
        /// The file.
        file: PathBuf,
        /// Line from 1.
        line: usize,
        /// Columns there.
        found: usize,
        /// Column asked for.
        wanted: usize,
    },
}

fn cells(line: &str) -> Vec<&str> {
    if line.contains(',') {
        line.split(',').map(str::trim).collect()
    } else if line.contains(';') {
        line.split(';').map(str::trim).collect()
    } else {
        line.split_whitespace().collect()
    }
}

/// Reads `input` and `output` columns (a header's name, or a number from 1). An empty output cell or `nan` is a row
/// without a position; anything else that is no number is an error with its line.
pub fn read(path: &Path, input: &str, output: &str) -> Result<(Vec<f64>, Vec<f64>), ColumnError> {
    let file = path.to_path_buf();
    let text = std::fs::read_to_string(path).map_err(|reason| ColumnError::Unreadable {
        file: file.clone(),
        reason,
    })?;
    let mut lines = text
        .lines()
        .enumerate()
        .filter(|(_, l)| !l.trim().is_empty() && !l.trim_start().starts_with(['#', '%']))
        .peekable();
    let first = lines.peek().map(|(_, l)| cells(l)).unwrap_or_default();
    let has_header = first
        .iter()
        .any(|c| !c.is_empty() && c.parse::<f64>().is_err());
    let find = |wanted: &str| -> Result<usize, ColumnError> {
        let by_name = has_header
            .then(|| first.iter().position(|c| *c == wanted))
            .flatten();
        let by_number = wanted
            .parse::<usize>()
            .ok()
            .filter(|n| (1..=first.len()).contains(n))
            .map(|n| n - 1);
        by_name.or(by_number).ok_or_else(|| ColumnError::NoColumn {
            file: file.clone(),
            wanted: wanted.to_owned(),
            found: if has_header {
                first.join(", ")
            } else {
                format!("{} columns without names", first.len())
            },
        })
    };
    let (u, y) = (find(input)?, find(output)?);
    if has_header {
        lines.next();
    }
    let (mut inputs, mut outputs) = (Vec::new(), Vec::new());
    for (index, line) in lines {
        let cells = cells(line);
        let number = |column: usize,
                      name: &str,
                      missing_allowed: bool|
         -> Result<f64, ColumnError> {
            let text = cells
                .get(column)
                .copied()
                .ok_or_else(|| ColumnError::ShortLine {
                    file: file.clone(),
                    line: index + 1,
                    found: cells.len(),
                    wanted: column + 1,
                })?;
            if text.is_empty() && missing_allowed {
                return Ok(f64::NAN);
            }
            match text.parse::<f64>() {
                Ok(value) if value.is_finite() || (missing_allowed && value.is_nan()) => Ok(value),
                _ => Err(ColumnError::NotANumber {
                    file: file.clone(),
                    line: index + 1,
                    column: name.to_owned(),
                    text: text.to_owned(),
                }),
            }
        };
        inputs.push(number(u, input, false)?);
        outputs.push(number(y, output, true)?);
    }
    Ok((inputs, outputs))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn file(text: &str) -> tempfile::NamedTempFile {
        let file = tempfile::NamedTempFile::new().unwrap();
        std::fs::write(file.path(), text).unwrap();
        file
    }

    #[test]
    fn columns_are_found_by_name_and_by_number() {
        let csv = file("time_s,pzt_um,bead_um\n0,1.5,2\n0.001,1.6,\n");
        let (u, y) = read(csv.path(), "pzt_um", "3").unwrap();
        assert_eq!(u, [1.5, 1.6]);
        assert!(y[0] == 2.0 && y[1].is_nan());
        let dat = file("  1.0   7e-1  3\n  2.0   8e-1  4\n");
        assert_eq!(
            read(dat.path(), "1", "3").unwrap(),
            (vec![1.0, 2.0], vec![3.0, 4.0])
        );
    }

    #[test]
    fn a_missing_column_and_a_word_among_numbers_are_named_with_their_place() {
        let dat = file("1 2\n3 x\n");
        let error = read(dat.path(), "1", "5").unwrap_err().to_string();
        assert!(
            error.contains("no column 5") && error.contains("2 columns"),
            "{error}"
        );
        let csv = file("a,b\n1,2\n3,oops\n");
        let error = read(csv.path(), "a", "b").unwrap_err().to_string();
        assert!(
            error.contains("line 3") && error.contains("oops"),
            "{error}"
        );
    }
}
