//! A run for other programs.

pub mod columns;
mod csv;
#[cfg(feature = "hdf5")]
mod hdf5;
mod mat;
mod parquet;

pub use csv::{csv_head, write_csv};
#[cfg(feature = "hdf5")]
pub use hdf5::{write_hdf5, write_rtdc};
pub use mat::write_mat;
pub use parquet::{TableColumn, write_parquet, write_table_parquet};

use crate::error::RecordError;
use crate::events::Event;
use crate::meta::RunMeta;
use crate::reader::{Lost, RunReader};
use columns::{COLUMNS, Column, Row};
pub(crate) use columns::{bead_um, seconds};
use std::fs::{File, OpenOptions};
use std::io;
use std::num::NonZeroU64;
use std::path::{Path, PathBuf};

/// Rows handled at a time.
pub(crate) const ROWS_AT_A_TIME: usize = 8192;

/// Formats of [`export`].
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Format {
    /// Text.
    Csv,
    /// Apache Parquet, uncompressed, words as dictionaries.
    Parquet,
    /// HDF5: ticks, cycles, events and metadata in one file. Only where the crate is built with the feature `hdf5`.
    Hdf5,
    /// MAT-file of version 5.
    Mat,
    /// Cells for the tools of real-time deformability cytometry. Only with the feature `hdf5`.
    Rtdc,
}

/// A session of a run as a part of an export.
#[derive(Debug)]
pub struct Part {
    /// Its folder.
    pub reader: RunReader,
    /// Its number, from 1.
    pub number: u64,
    /// From the start of the run to its start, ns.
    pub offset_ns: i64,
}

/// The sessions of a run, in order.
#[derive(Debug)]
pub struct Source {
    parts: Vec<Part>,
}

/// What of a run is wanted.
#[derive(Debug, Clone, PartialEq)]
pub struct Selection {
    /// From this time of the run on, s.
    pub from_s: f64,
    /// Up to this time of the run, s.
    pub to_s: f64,
    /// Every so many rows one.
    pub every: NonZeroU64,
    /// Names of the columns, in the order wanted; None: all.
    pub columns: Option<Vec<String>>,
}

impl Default for Selection {
    fn default() -> Self {
        Self {
            from_s: f64::NEG_INFINITY,
            to_s: f64::INFINITY,
            every: NonZeroU64::MIN,
            columns: None,
        }
    }
}

impl Selection {
    /// The columns wanted.
    ///
    /// # Errors
    /// [`RecordError::Column`] for a name that is none.
    pub fn columns(&self) -> Result<Vec<&'static Column>, RecordError> {
        let Some(names) = &self.columns else {
            return Ok(COLUMNS.iter().collect());
        };
        names
            .iter()
            .map(|name| {
                columns::find(name).ok_or_else(|| RecordError::Column {
                    name: name.clone(),
                    known: COLUMNS.iter().map(|column| column.name).collect(),
                })
            })
            .collect()
    }
}

/// How an export went.
#[derive(Debug, Clone, PartialEq, Default)]
pub struct Exported {
    /// Rows written.
    pub rows: u64,
    /// What is not there, for each session.
    pub lost: Vec<Lost>,
}

impl Source {
    /// The sessions of a run.
    pub fn new(parts: Vec<Part>) -> Self {
        Self { parts }
    }

    /// A run of one session.
    pub fn single(reader: RunReader) -> Self {
        Self::new(vec![Part {
            reader,
            number: 1,
            offset_ns: 0,
        }])
    }

    /// The metadata of the first session, if they can be read.
    pub fn meta(&self) -> Option<&RunMeta> {
        self.parts.first().and_then(|part| part.reader.meta().ok())
    }

    /// The cycles of the run as a CSV, with its path; None for a run without.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the table exists and cannot be read.
    pub fn cycles(&self) -> Result<Option<(PathBuf, String)>, RecordError> {
        /// Larger than the table of any run, bytes.
        const MOST: u64 = 1 << 30;
        let Some(first) = self.parts.first() else {
            return Ok(None);
        };
        let path = first.reader.folder().join(crate::CYCLES_CSV);
        match cellpos_table::read_text(&path, MOST) {
            Err(error) if error.kind() == io::ErrorKind::NotFound => Ok(None),
            Err(error) => Err(RecordError::io("cannot read", path)(error)),
            Ok(text) => {
                let whole = crate::whole_text(&text);
                // A head without rows is no table yet.
                let rows = whole.lines().count() > 1;
                Ok(rows.then(|| (path, whole.to_owned())))
            }
        }
    }

    /// The events of all sessions, with the number of the session. Their times count from its start.
    ///
    /// # Errors
    /// [`RecordError::Io`] when a log exists and cannot be read.
    pub fn events(&self) -> Result<Vec<(u64, Event)>, RecordError> {
        let mut all = Vec::new();
        for part in &self.parts {
            let events = part.reader.events()?.events;
            all.extend(events.into_iter().map(|event| (part.number, event)));
        }
        Ok(all)
    }

    /// Hands over the rows wanted, some at a time, so that a night's run needs no night's memory.
    ///
    /// # Errors
    /// [`RecordError`] when a session cannot be read, or what `take` refuses.
    pub fn rows(
        &self,
        selection: &Selection,
        mut take: impl FnMut(&[Row]) -> Result<(), RecordError>,
    ) -> Result<Exported, RecordError> {
        let ns = |s: f64| (s * 1e9).round() as i64;
        let (from_ns, to_ns) = (ns(selection.from_s), ns(selection.to_s));
        let mut done = Exported::default();
        let mut rows = Vec::with_capacity(ROWS_AT_A_TIME);
        let mut number = 0;
        for part in &self.parts {
            let mut batches = part.reader.batches()?;
            for tick in batches.by_ref().flatten() {
                let time_ns = tick.time_ns.saturating_add(part.offset_ns);
                if time_ns < from_ns || time_ns > to_ns {
                    continue;
                }
                number += 1;
                if (number - 1) % selection.every != 0 {
                    continue;
                }
                rows.push(Row {
                    tick,
                    session: part.number,
                    offset_ns: part.offset_ns,
                });
                if rows.len() == ROWS_AT_A_TIME {
                    take(&rows)?;
                    done.rows += rows.len() as u64;
                    rows.clear();
                }
            }
            done.lost.push(batches.lost());
        }
        take(&rows)?;
        done.rows += rows.len() as u64;
        Ok(done)
    }
}

/// Writes a run to a file in one step: a reader never sees half of it.
///
/// # Errors
/// [`RecordError`] names the file.
pub fn export(
    source: &Source,
    selection: &Selection,
    format: Format,
    path: &Path,
) -> Result<Exported, RecordError> {
    match format {
        Format::Csv => whole(path, |file| {
            let mut out = io::BufWriter::new(file);
            let done = write_csv(source, selection, &mut out)?;
            io::Write::flush(&mut out).map_err(RecordError::io("cannot write", path))?;
            Ok(done)
        }),
        Format::Parquet => write_parquet(source, selection, path),
        #[cfg(feature = "hdf5")]
        Format::Hdf5 => write_hdf5(source, selection, path),
        #[cfg(feature = "hdf5")]
        Format::Rtdc => write_rtdc(source, selection, path),
        #[cfg(not(feature = "hdf5"))]
        Format::Hdf5 | Format::Rtdc => Err(RecordError::Encode {
            what: "HDF5",
            message: "this program was built without the feature hdf5".to_owned(),
        }),
        Format::Mat => write_mat(source, selection, path),
    }
}

/// The temporary name of a file, in a folder that is there.
fn part_of(path: &Path) -> Result<PathBuf, RecordError> {
    if let Some(folder) = path.parent()
        && !folder.as_os_str().is_empty()
    {
        std::fs::create_dir_all(folder).map_err(RecordError::io("cannot create", folder))?;
    }
    let mut name = std::ffi::OsString::from(".");
    name.push(path.file_name().unwrap_or_default());
    name.push(format!(".{}.part", std::process::id()));
    Ok(path.with_file_name(name))
}

/// Writes a file under a temporary name, syncs it, and gives it its name.
pub(crate) fn whole<T>(
    path: &Path,
    write: impl FnOnce(&File) -> Result<T, RecordError>,
) -> Result<T, RecordError> {
    let io = |error| RecordError::io("cannot write", path)(error);
    let part = part_of(path)?;
    let mut options = OpenOptions::new();
    options.read(true).write(true).create_new(true);
    let file = options
        .open(&part)
        .map_err(RecordError::io("cannot create", &part))?;
    let attempt = || {
        let done = write(&file)?;
        file.sync_data().map_err(io)?;
        std::fs::rename(&part, path).map_err(io)?;
        Ok(done)
    };
    attempt().inspect_err(|_| {
        let _ = std::fs::remove_file(&part);
    })
}
