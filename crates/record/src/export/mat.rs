//! A run as a MAT-file of version 5: one variable per column, for MATLAB, Octave and SciPy.
//!
//! It counts the rows first, so that every variable has its place in the file. Then it writes the values, some rows of all
//! variables at a time.

use super::columns::{Column, Row, Value, listed, word};
use super::{Exported, Selection, Source, whole};
use crate::error::RecordError;
use std::fs::File;
use std::io::{self, BufWriter, Seek, SeekFrom, Write};
use std::path::Path;

/// Most bytes that a variable of this version may have.
const MOST_BYTES: u64 = i32::MAX as u64;

/// Codes of the format.
mod code {
    pub(super) const INT8: u32 = 1;
    pub(super) const UINT16: u32 = 4;
    pub(super) const INT32: u32 = 5;
    pub(super) const UINT32: u32 = 6;
    pub(super) const DOUBLE: u32 = 9;
    pub(super) const MATRIX: u32 = 14;
    pub(super) const CLASS_CHAR: u32 = 4;
    pub(super) const CLASS_DOUBLE: u32 = 6;
}

/// Writes the rows of a run as a MAT-file, in one step. A word is written as its number; the variable `codes_<column>` lists
/// them.
///
/// # Errors
/// [`RecordError`] names the file; more rows than the format can hold are refused.
pub fn write_mat(
    source: &Source,
    selection: &Selection,
    path: &Path,
) -> Result<Exported, RecordError> {
    let columns = selection.columns(source)?;
    let rows = source.rows(selection, |_| Ok(()))?.rows;
    if rows * 8 > MOST_BYTES {
        return Err(RecordError::Encode {
            what: "a MAT-file",
            message: format!(
                "{rows} rows are more than it can hold: cut the run with --from, --to or --every, or write HDF5"
            ),
        });
    }
    let io = |error| RecordError::io("cannot write", path)(error);
    whole(path, |file| {
        let places = heads(file, &columns, rows).map_err(io)?;
        let mut before = 0;
        source.rows(selection, |rows| {
            for (column, place) in columns.iter().zip(&places) {
                let bytes: Vec<u8> = rows
                    .iter()
                    .flat_map(|row| value(column, row).to_le_bytes())
                    .collect();
                write_at(file, place + 8 * before, &bytes).map_err(io)?;
            }
            before += rows.len() as u64;
            Ok(())
        })
    })
}

fn write_at(mut file: &File, place: u64, bytes: &[u8]) -> io::Result<()> {
    file.seek(SeekFrom::Start(place))?;
    file.write_all(bytes)
}

fn value(column: &Column<'_>, row: &Row) -> f64 {
    match column.value {
        Value::Code(codes, get) => {
            let number = get(row);
            word(codes, number).map_or(f64::NAN, |_| f64::from(number))
        }
        _ => column.number(row),
    }
}

/// Writes everything but the values; gives the place of each column's first.
fn heads(file: &File, columns: &[Column<'_>], rows: u64) -> io::Result<Vec<u64>> {
    let mut out = BufWriter::new(file);
    let mut head = b"MATLAB 5.0 MAT-file, written by cellpos".to_vec();
    head.resize(124, b' ');
    // Version 1.0, and the mark of the byte order.
    head.extend_from_slice(&[0x00, 0x01, b'I', b'M']);
    out.write_all(&head)?;
    for column in columns {
        if let Value::Code(codes, _) = column.value {
            text(&mut out, &format!("codes_{}", column.name), &listed(codes))?;
        }
    }
    out.flush()?;
    let mut places = Vec::with_capacity(columns.len());
    for column in columns {
        let bytes = 8 * rows;
        let mut head = Vec::new();
        matrix_head(&mut head, code::CLASS_DOUBLE, [rows, 1], column.name);
        head.extend_from_slice(&code::DOUBLE.to_le_bytes());
        head.extend_from_slice(&(bytes as u32).to_le_bytes());
        tag(&mut out, code::MATRIX, head.len() as u64 + bytes)?;
        out.write_all(&head)?;
        out.flush()?;
        let mut file = file;
        let place = file.stream_position()?;
        file.set_len(place + bytes)?;
        file.seek(SeekFrom::Start(place + bytes))?;
        places.push(place);
    }
    Ok(places)
}

fn tag(out: &mut impl Write, kind: u32, bytes: u64) -> io::Result<()> {
    out.write_all(&kind.to_le_bytes())?;
    out.write_all(&(bytes as u32).to_le_bytes())
}

/// Class, size and name of a variable.
fn matrix_head(out: &mut Vec<u8>, class: u32, size: [u64; 2], name: &str) {
    let word = |out: &mut Vec<u8>, word: u32| out.extend_from_slice(&word.to_le_bytes());
    word(out, code::UINT32);
    word(out, 8);
    word(out, class);
    word(out, 0);
    word(out, code::INT32);
    word(out, 8);
    for length in size {
        word(out, length as u32);
    }
    word(out, code::INT8);
    word(out, name.len() as u32);
    out.extend_from_slice(name.as_bytes());
    out.resize(out.len().next_multiple_of(8), 0);
}

/// A variable that holds a line of text.
fn text(out: &mut impl Write, name: &str, text: &str) -> io::Result<()> {
    let units: Vec<u16> = text.encode_utf16().collect();
    let mut body = Vec::new();
    matrix_head(&mut body, code::CLASS_CHAR, [1, units.len() as u64], name);
    body.extend_from_slice(&code::UINT16.to_le_bytes());
    body.extend_from_slice(&(2 * units.len() as u32).to_le_bytes());
    units
        .iter()
        .for_each(|unit| body.extend_from_slice(&unit.to_le_bytes()));
    body.resize(body.len().next_multiple_of(8), 0);
    tag(out, code::MATRIX, body.len() as u64)?;
    out.write_all(&body)
}
