//! The record: step, command, position.

use crate::error::{TableError, TableProblem};
use crate::file::{MOST_OF_A_RECORD, read_text, write_atomically};
use crate::mapping::{Gaps, Mapping};
use crate::sampling;
use crate::table::Table;
use std::fmt::Write;
use std::path::Path;

/// An evenly sampled record of commanded PZT displacement and bead position.
///
/// Row k: the displacement commanded from `start_s + k step_s` on, held until the next row; the bead's position just
/// before that command takes effect. So the model is strictly proper: y_k = C x_k + D u_(k-1).
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Source of the record for reports: the file's name.
    pub name: String,
    /// Time of the first row, s.
    pub start_s: f64,
    /// Sampling step, s.
    pub step_s: f64,
    /// Commanded PZT displacement, um; always finite.
    pub pzt_um: Vec<f64>,
    /// Bead position, um; NaN in rows without a bead. Same length as `pzt_um`.
    pub bead_um: Vec<f64>,
    /// Further columns that hold numbers, in the file's order, with their names; NaN for empty fields.
    pub more: Vec<(String, Vec<f64>)>,
    /// Rows that were missing from the file and were filled ([`Gaps::Hold`]).
    pub filled_rows: usize,
    /// Largest deviation of a time stamp's step from the even one, s.
    pub jitter_s: f64,
}

impl Record {
    /// A record from a program's data. `bead_um` is cut or filled with NaN to the length of `pzt_um`.
    pub fn new(name: &str, step_s: f64, pzt_um: Vec<f64>, mut bead_um: Vec<f64>) -> Self {
        bead_um.resize(pzt_um.len(), f64::NAN);
        Self {
            name: name.to_owned(),
            start_s: 0.0,
            step_s,
            pzt_um,
            bead_um,
            more: Vec::new(),
            filled_rows: 0,
            jitter_s: 0.0,
        }
    }

    /// Number of rows.
    pub fn len(&self) -> usize {
        self.pzt_um.len()
    }

    /// Whether there are no rows.
    pub fn is_empty(&self) -> bool {
        self.pzt_um.is_empty()
    }

    /// Sampling rate, Hz.
    pub fn rate_hz(&self) -> f64 {
        1.0 / self.step_s
    }

    /// Time of a row, s. Dividing by the rate keeps times such as 0.007 free of rounding dust at whole rates.
    pub fn time_s(&self, row: usize) -> f64 {
        let rate_hz = self.rate_hz().round();
        if rate_hz > 0.0 && (rate_hz * self.step_s - 1.0).abs() < 1e-9 {
            self.start_s + row as f64 / rate_hz
        } else {
            self.start_s + row as f64 * self.step_s
        }
    }

    /// A further column by its name.
    pub fn column(&self, name: &str) -> Option<&[f64]> {
        self.more
            .iter()
            .find(|(other, _)| other == name)
            .map(|(_, values)| values.as_slice())
    }

    /// Reads a record from a file.
    ///
    /// # Errors
    /// [`TableError`] names the file, the line and what would be right.
    pub fn read(path: &Path, mapping: &Mapping) -> Result<Self, TableError> {
        let fail = |problem| TableError {
            path: path.to_owned(),
            line: None,
            problem,
        };
        let text = read_text(path, MOST_OF_A_RECORD).map_err(|source| match source.kind() {
            std::io::ErrorKind::InvalidData => fail(TableProblem::NotText),
            _ => fail(TableProblem::Read(source)),
        })?;
        Self::parse(path, &text, mapping)
    }

    /// Reads a record from text; `path` gives the name and appears in messages.
    ///
    /// # Errors
    /// As [`Record::read`].
    pub fn parse(path: &Path, text: &str, mapping: &Mapping) -> Result<Self, TableError> {
        check(path, mapping)?;
        let table = Table::parse(path, text)?;
        if mapping.by_name() && !table.has_header() {
            return Err(table.fail(table.line(0), TableProblem::NoHeader));
        }
        let scaled = |values: Vec<f64>, factor: f64| -> Vec<f64> {
            if factor == 1.0 {
                values
            } else {
                values.into_iter().map(|value| value * factor).collect()
            }
        };
        let rows = table.len();
        let (start_s, grid) = match mapping.rate_hz {
            Some(rate_hz) => {
                let grid = sampling::Grid {
                    step_s: 1.0 / rate_hz,
                    places: (0..rows).collect(),
                    jitter_s: 0.0,
                };
                (0.0, grid)
            }
            None => {
                let time_s = table.numbers(&mapping.time, false)?;
                let grid = sampling::grid(&time_s, mapping.jitter, mapping.gaps == Gaps::Hold)
                    .map_err(|(row, problem)| {
                        table.fail(row.and_then(|row| table.line(row)), problem)
                    })?;
                (time_s.first().copied().unwrap_or(0.0), grid)
            }
        };
        let pzt_um = scaled(table.numbers(&mapping.pzt, false)?, mapping.pzt_factor);
        let bead_um = match &mapping.bead {
            Some(column) => scaled(table.numbers(column, true)?, mapping.bead_factor),
            None => vec![f64::NAN; rows],
        };
        let used: Vec<Option<usize>> = [
            Some(&mapping.time),
            Some(&mapping.pzt),
            mapping.bead.as_ref(),
        ]
        .into_iter()
        .map(|column| column.and_then(|column| table.find(column)))
        .collect();
        let more = table
            .names
            .iter()
            .enumerate()
            .filter(|(place, _)| !used.contains(&Some(*place)))
            .filter_map(|(place, name)| {
                let values: Option<Vec<f64>> = table
                    .fields(place)
                    .map(|field| match field {
                        "" => Some(f64::NAN),
                        field => field.parse().ok(),
                    })
                    .collect();
                Some((name.clone(), values?))
            })
            .collect::<Vec<_>>();

        Ok(Self::laid_out(path, start_s, grid, [pzt_um, bead_um], more))
    }

    /// A record of rows that a program has read, with their times. Missing rows are filled ([`Gaps::Hold`]); steps may differ
    /// from the usual one by the share `jitter`.
    ///
    /// # Errors
    /// [`TableError`] with the file's name, as for a table.
    pub fn from_rows(
        path: &Path,
        time_s: &[f64],
        [pzt_um, bead_um]: [Vec<f64>; 2],
        more: Vec<(String, Vec<f64>)>,
        jitter: f64,
    ) -> Result<Self, TableError> {
        let fail = |problem| TableError {
            path: path.to_owned(),
            line: None,
            problem,
        };
        if let Some(value) = pzt_um.iter().find(|value| !value.is_finite()) {
            return Err(fail(TableProblem::Cell {
                column: "pzt_um".to_owned(),
                text: value.to_string(),
                help: "a command is a number",
            }));
        }
        let grid = sampling::grid(time_s, jitter, true).map_err(|(_, problem)| fail(problem))?;
        let start_s = time_s.first().copied().unwrap_or(0.0);
        Ok(Self::laid_out(path, start_s, grid, [pzt_um, bead_um], more))
    }

    fn laid_out(
        path: &Path,
        start_s: f64,
        grid: sampling::Grid,
        [pzt_um, bead_um]: [Vec<f64>; 2],
        more: Vec<(String, Vec<f64>)>,
    ) -> Self {
        let rows = pzt_um.len();
        let total = grid.places.last().map_or(0, |place| place + 1);
        let places = &grid.places;
        Self {
            name: path
                .file_name()
                .map_or_else(String::new, |name| name.to_string_lossy().into_owned()),
            start_s,
            step_s: grid.step_s,
            pzt_um: spread(pzt_um, places, total, true),
            bead_um: spread(bead_um, places, total, false),
            more: more
                .into_iter()
                .map(|(name, values)| (name, spread(values, places, total, false)))
                .collect(),
            filled_rows: total - rows,
            jitter_s: grid.jitter_s,
        }
    }

    /// The record as CSV: `time_s,pzt_um,bead_um` and the further columns. Numbers read back to the same bits.
    pub fn to_csv(&self) -> String {
        let mut out = String::from("time_s,pzt_um,bead_um");
        for (name, _) in &self.more {
            out.push(',');
            out.push_str(&name.replace([',', '\n', '\r', '"'], "_"));
        }
        out.push('\n');
        for (row, pzt_um) in self.pzt_um.iter().enumerate() {
            // Writing to a String cannot fail.
            let _ = write!(out, "{},{pzt_um},", self.time_s(row));
            let rest = std::iter::once(&self.bead_um).chain(self.more.iter().map(|(_, v)| v));
            for (index, values) in rest.enumerate() {
                if index > 0 {
                    out.push(',');
                }
                if let Some(value) = values.get(row).filter(|value| value.is_finite()) {
                    let _ = write!(out, "{value}");
                }
            }
            out.push('\n');
        }
        out
    }

    /// Writes the record as CSV in one step: a reader never sees half a file.
    ///
    /// # Errors
    /// [`TableProblem::Write`] with the file's name.
    pub fn write(&self, path: &Path) -> Result<(), TableError> {
        write_atomically(path, self.to_csv().as_bytes())
    }
}

/// Puts rows at their places on the grid; rows between take the value before (`hold`) or NaN.
fn spread(values: Vec<f64>, places: &[usize], total: usize, hold: bool) -> Vec<f64> {
    if values.len() == total {
        return values;
    }
    let mut out = Vec::with_capacity(total);
    for (value, place) in values.into_iter().zip(places) {
        let fill = if hold {
            out.last().copied().unwrap_or(value)
        } else {
            f64::NAN
        };
        out.resize(*place, fill);
        out.push(value);
    }
    out
}

fn check(path: &Path, mapping: &Mapping) -> Result<(), TableError> {
    let fail = |key, value, help| {
        Err(TableError {
            path: path.to_owned(),
            line: None,
            problem: TableProblem::Setting { key, value, help },
        })
    };
    for (key, value) in [
        ("pzt_factor", mapping.pzt_factor),
        ("bead_factor", mapping.bead_factor),
    ] {
        if !value.is_finite() || value == 0.0 {
            return fail(key, value, "a factor must be finite and not 0");
        }
    }
    if let Some(rate_hz) = mapping.rate_hz
        && !(rate_hz.is_finite() && rate_hz > 0.0)
    {
        return fail(
            "rate_hz",
            rate_hz,
            "a sampling rate must be positive, for example 1000",
        );
    }
    if !(0.0..0.5).contains(&mapping.jitter) {
        return fail(
            "jitter",
            mapping.jitter,
            "must be at least 0 and less than 0.5",
        );
    }
    Ok(())
}
