//! A run as text.

use super::columns::{COLUMNS, Row, Value, word};
use super::{Exported, Selection, Source};
use crate::error::RecordError;
use std::io::{self, Write};

/// First line of a CSV with all columns that every run has.
pub fn csv_head() -> String {
    let names: Vec<&str> = COLUMNS.iter().map(|column| column.name).collect();
    names.join(",")
}

/// Writes the rows of a run as CSV. Numbers read back to the same bits; a missing value is an empty field.
///
/// # Errors
/// When `out` refuses, or the run cannot be opened.
pub fn write_csv(
    source: &Source,
    selection: &Selection,
    out: &mut impl Write,
) -> Result<Exported, RecordError> {
    let failed = RecordError::io("cannot write", "the CSV");
    let columns = selection.columns(source)?;
    let names: Vec<&str> = columns.iter().map(|column| column.name).collect();
    if let Err(error) = writeln!(out, "{}", names.join(",")) {
        return Err(failed(error));
    }
    source.rows(selection, |rows| {
        let mut write = || {
            for row in rows {
                for (place, column) in columns.iter().enumerate() {
                    if place > 0 {
                        out.write_all(b",")?;
                    }
                    field(column.value, row, out)?;
                }
                out.write_all(b"\n")?;
            }
            io::Result::Ok(())
        };
        write().map_err(RecordError::io("cannot write", "the CSV"))
    })
}

fn field(value: Value, row: &Row, out: &mut impl Write) -> io::Result<()> {
    match value {
        Value::Number(get) => {
            let number = get(row);
            if number.is_finite() {
                write!(out, "{number}")?;
            }
            Ok(())
        }
        Value::Whole(get) => write!(out, "{}", get(row)),
        Value::Code(codes, get) => out.write_all(word(codes, get(row)).unwrap_or("").as_bytes()),
    }
}
