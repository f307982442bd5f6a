//! A run for other programs.

pub mod columns;
mod csv;
#[cfg(feature = "hdf5")]
mod hdf5;
mod mat;
#[cfg(feature = "parquet")]
mod parquet;

pub use csv::{csv_head, write_csv};
#[cfg(feature = "hdf5")]
pub use hdf5::{write_hdf5, write_rtdc};
pub use mat::write_mat;
#[cfg(feature = "parquet")]
pub use parquet::{TableColumn, write_parquet, write_table_parquet};

use crate::error::RecordError;
use crate::events::Event;
use crate::meta::RunMeta;
use crate::reader::{Lost, RunReader};
use cellpos_runtime::LAW_COLUMNS;
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
    /// Apache Parquet, uncompressed, words as dictionaries. Only with the feature `parquet`.
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
    /// Names of the control law's own columns, of all sessions.
    law: Vec<String>,
}

/// Selected part of a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Selection {
    /// From this time of the run on, s.
    pub from_s: f64,
    /// Up to this time of the run, s.
    pub to_s: f64,
    /// Keep one of N rows.
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
    /// [`RecordError::Column`] for an unknown name, [`RecordError::Twice`] for a repeated name.
    pub fn columns<'s>(&self, source: &'s Source) -> Result<Vec<Column<'s>>, RecordError> {
        let mut all: Vec<Column<'s>> = COLUMNS.to_vec();
        all.extend(columns::of_law(&source.law));
        let Some(names) = &self.columns else {
            return Ok(all);
        };
        let twice = names
            .iter()
            .enumerate()
            .find(|(place, name)| names[..*place].contains(name));
        if let Some((_, name)) = twice {
            return Err(RecordError::Twice(name.clone()));
        }
        names
            .iter()
            .map(|name| {
                let found = all.iter().find(|column| column.name == name);
                found.copied().ok_or_else(|| RecordError::Column {
                    name: name.clone(),
                    known: all.iter().map(|column| column.name.to_owned()).collect(),
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
    /// The missing rows of each session.
    pub lost: Vec<Lost>,
}

impl Source {
    /// The sessions of a run.
    pub fn new(parts: Vec<Part>) -> Self {
        let mut law: Vec<String> = Vec::new();
        for name in parts.iter().flat_map(|part| part.reader.law_columns()) {
            if !law.contains(name) {
                law.push(name.clone());
            }
        }
        Self { parts, law }
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
                // A head without rows is not a table yet.
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

    /// Passes on the requested rows in pieces, so that memory does not grow with the length of a run.
    ///
    /// # Errors
    /// [`RecordError`] if a session cannot be read or has no rows in the requested time, and any error of `take`.
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
        let (mut first_ns, mut last_ns) = (None, i64::MIN);
        for part in &self.parts {
            let places = self.places(part)?;
            let mut batches = part.reader.batches()?;
            for mut tick in batches.by_ref().flatten() {
                let time_ns = tick.time_ns.saturating_add(part.offset_ns);
                first_ns = first_ns.or(Some(time_ns));
                last_ns = last_ns.max(time_ns);
                if time_ns < from_ns || time_ns > to_ns {
                    continue;
                }
                number += 1;
                if (number - 1) % selection.every != 0 {
                    continue;
                }
                if let Some(places) = &places {
                    let law = tick.law;
                    tick.law = places.map(|place| {
                        let value = place.and_then(|place| law.get(place));
                        value.copied().unwrap_or(f32::NAN)
                    });
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
        match first_ns {
            Some(first_ns) if done.rows == 0 => Err(RecordError::Nothing {
                first_s: seconds(first_ns),
                last_s: seconds(last_ns),
            }),
            _ => Ok(done),
        }
    }

    /// Places of the whole run's control-law columns in a session; None if all sessions have the same ones.
    fn places(&self, part: &Part) -> Result<Option<[Option<usize>; LAW_COLUMNS]>, RecordError> {
        let own = part.reader.law_columns();
        if own == self.law {
            return Ok(None);
        }
        if let Some(name) = self.law.get(LAW_COLUMNS) {
            return Err(RecordError::LawColumn(name.clone()));
        }
        let mut places = [None; LAW_COLUMNS];
        for (place, name) in places.iter_mut().zip(&self.law) {
            *place = own.iter().position(|other| other == name);
        }
        Ok(Some(places))
    }
}

/// Writes a run to a file in one step: a reader never sees half a file.
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
        #[cfg(feature = "parquet")]
        Format::Parquet => write_parquet(source, selection, path),
        #[cfg(not(feature = "parquet"))]
        Format::Parquet => Err(RecordError::Encode {
            what: "Parquet",
            message: "this program was built without the feature parquet".to_owned(),
        }),
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

/// Whether the name belongs to a device or a pipe, which no file may replace.
fn is_device(path: &Path) -> bool {
    std::fs::metadata(path).is_ok_and(|found| !found.is_file() && !found.is_dir())
}

/// Renames a complete temporary file to its final name. A device or a pipe gets the bytes and is not replaced.
fn settle(part: &Path, path: &Path) -> io::Result<()> {
    if !is_device(path) {
        return std::fs::rename(part, path);
    }
    let mut device = OpenOptions::new().write(true).open(path)?;
    io::copy(&mut File::open(part)?, &mut device)?;
    std::fs::remove_file(part)
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
    Ok(if is_device(path) {
        std::env::temp_dir().join(name)
    } else {
        path.with_file_name(name)
    })
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
        settle(&part, path).map_err(io)?;
        Ok(done)
    };
    attempt().inspect_err(|_| {
        let _ = std::fs::remove_file(&part);
    })
}
