//! A run for other programs: CSV and Parquet.

use crate::columns::{self, Builder};
use crate::error::RecordError;
use crate::reader::RunReader;
use cellpos_runtime::TickRecord;
use std::fs::File;
use std::io::{self, BufWriter, Write};
use std::path::Path;

/// Header of the exported CSV.
///
/// Row k: the displacement commanded from `time_s` on, held until the next row; `bead_um` is the position that the
/// camera had delivered just before (exposed around `mid_exposure_s`), empty without a bead.
pub const CSV_HEAD: &str = "time_s,pzt_um,bead_um,seq,frame_id,mid_exposure_s,sigma_um,target_um,estimate_um,\
                            neutral_um,requested_um,applied_um,true_um,verdict,life,request,board,\
                            board_fault,flags,drained,wake_us,compute_us,track,decision,plan_s,stage,\
                            length_um,area_um2";

/// Formats of [`export`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Text with [`CSV_HEAD`].
    Csv,
    /// Apache Parquet with every column of `ticks.arrow`, uncompressed, dictionary-encoded where it helps.
    Parquet,
}

/// Writes a run to a file in one step: a reader never sees half of it.
///
/// # Errors
/// [`RecordError`] names the file.
pub fn export(run: &RunReader, format: Format, path: &Path) -> Result<(), RecordError> {
    match format {
        Format::Parquet => write_parquet(run, path),
        Format::Csv => whole(path, |file| {
            let mut out = BufWriter::new(file);
            write_csv(run, &mut out)?;
            out.flush()
        })
        .map_err(RecordError::io("cannot write", path)),
    }
}

/// Writes the rows of a run as CSV.
///
/// # Errors
/// When `out` refuses, or the run cannot be opened.
pub fn write_csv(run: &RunReader, out: &mut impl Write) -> io::Result<()> {
    writeln!(out, "{CSV_HEAD}")?;
    for batch in run.batches().map_err(io::Error::other)? {
        for row in batch {
            csv_row(&row, out)?;
        }
    }
    Ok(())
}

/// A number that may not exist.
struct Maybe(f64);

impl std::fmt::Display for Maybe {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        if self.0.is_finite() {
            write!(f, "{}", self.0)
        } else {
            Ok(())
        }
    }
}

fn csv_row(row: &TickRecord, out: &mut impl Write) -> io::Result<()> {
    // Dividing whole nanoseconds gives the nearest number to the decimal fraction; multiplying by 1e-9 does not.
    let seconds = |ns: i64| ns as f64 / 1e9;
    let bead_um = if row.verdict == 0 {
        row.measured_um
    } else {
        f64::NAN
    };
    writeln!(
        out,
        "{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{},{}",
        seconds(row.time_ns),
        Maybe(row.command_um),
        Maybe(bead_um),
        row.seq,
        row.frame_id,
        seconds(row.mid_exposure_ns),
        Maybe(row.variance_um2.sqrt()),
        Maybe(row.target_um),
        Maybe(row.estimate_um),
        Maybe(row.neutral_um),
        Maybe(row.requested_um),
        Maybe(row.applied_um),
        Maybe(row.true_um),
        row.verdict,
        row.life,
        row.request,
        row.board,
        row.board_fault,
        row.flags.0,
        row.drained,
        f64::from(row.wake_ns) / 1e3,
        f64::from(row.compute_ns) / 1e3,
        row.track,
        row.decision,
        Maybe(if row.plan_ns < 0 {
            f64::NAN
        } else {
            seconds(row.plan_ns)
        }),
        row.stage,
        Maybe(row.length_um),
        Maybe(row.area_um2),
    )
}

/// Writes the rows of a run as Parquet, in one step.
///
/// # Errors
/// [`RecordError`] names the file.
pub fn write_parquet(run: &RunReader, path: &Path) -> Result<(), RecordError> {
    let encode = |error: &dyn std::fmt::Display| RecordError::Encode {
        what: "Parquet",
        message: error.to_string(),
    };
    let mut batches = run.batches()?;
    let mut failure = None;
    let written = whole(path, |file| {
        let attempt = || -> Result<(), RecordError> {
            let mut writer =
                parquet::arrow::ArrowWriter::try_new(BufWriter::new(file), columns::schema(), None)
                    .map_err(|error| encode(&error))?;
            for batch in batches.by_ref() {
                let mut builder = Builder::new(batch.len());
                batch.iter().for_each(|row| builder.push(row));
                let batch = builder.take().map_err(|error| encode(&error))?;
                writer.write(&batch).map_err(|error| encode(&error))?;
            }
            let out = writer.into_inner().map_err(|error| encode(&error))?;
            out.into_inner().map_err(|error| encode(&error)).map(|_| ())
        };
        attempt().map_err(|error| {
            let text = error.to_string();
            failure = Some(error);
            io::Error::other(text)
        })
    });
    match (written, failure) {
        (Ok(()), _) => Ok(()),
        (Err(_), Some(error)) => Err(error),
        (Err(error), None) => Err(RecordError::io("cannot write", path)(error)),
    }
}

/// A column of a small table.
#[derive(Debug, Clone, PartialEq)]
pub enum TableColumn {
    /// Numbers; NaN where there is none.
    Numbers(Vec<f64>),
    /// Text.
    Texts(Vec<String>),
}

/// Writes a small table of named columns as Parquet, in one step.
///
/// # Errors
/// [`RecordError`] names the file; columns of different lengths are refused.
pub fn write_table_parquet(
    path: &Path,
    columns: &[(&str, TableColumn)],
) -> Result<(), RecordError> {
    use arrow_array::{ArrayRef, Float64Array, RecordBatch, StringArray};
    use std::sync::Arc;
    let encode = |error: &dyn std::fmt::Display| RecordError::Encode {
        what: "Parquet",
        message: error.to_string(),
    };
    let arrays = columns.iter().map(|(name, column)| {
        let array: ArrayRef = match column {
            TableColumn::Numbers(values) => Arc::new(Float64Array::from(values.clone())),
            TableColumn::Texts(values) => Arc::new(StringArray::from(values.clone())),
        };
        (*name, array)
    });
    let batch = RecordBatch::try_from_iter(arrays).map_err(|error| encode(&error))?;
    let mut bytes = Vec::new();
    let mut writer = parquet::arrow::ArrowWriter::try_new(&mut bytes, batch.schema(), None)
        .map_err(|error| encode(&error))?;
    writer
        .write(&batch)
        .and_then(|()| writer.close().map(|_| ()))
        .map_err(|error| encode(&error))?;
    cellpos_table::write_atomically(path, &bytes)?;
    Ok(())
}

/// Writes a file under a temporary name, syncs it, and gives it its name.
fn whole(path: &Path, write: impl FnOnce(File) -> io::Result<()>) -> io::Result<()> {
    if let Some(folder) = path.parent()
        && !folder.as_os_str().is_empty()
    {
        std::fs::create_dir_all(folder)?;
    }
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}.part", std::process::id()));
    let part = path.with_file_name(name);
    let attempt = || {
        write(File::create(&part)?)?;
        File::open(&part)?.sync_data()?;
        std::fs::rename(&part, path)
    };
    attempt().inspect_err(|_| {
        let _ = std::fs::remove_file(&part);
    })
}
