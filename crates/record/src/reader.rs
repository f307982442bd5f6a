//! Reading a run, whatever happened to it.

use crate::error::RecordError;
use crate::events::{Events, read_events};
use crate::export::seconds;
use crate::meta::RunMeta;
use crate::stream::Stream;
use crate::{EVENTS_JSONL, FORMAT, RUN_TOML, TICKS_ARROW};
use cellpos_runtime::TickRecord;
use cellpos_table::{Record, read_text};
use std::fs::File;
use std::io::BufReader;
use std::path::{Path, PathBuf};

/// Largest metadata that are believed, bytes.
const MOST_META: u64 = 1 << 26;

/// Rows missing between two that are there.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct Gap {
    /// Number of the last row before.
    pub after_seq: u64,
    /// Number of the first row behind.
    pub before_seq: u64,
}

impl Gap {
    /// Rows missing.
    pub fn rows(&self) -> u64 {
        self.before_seq
            .saturating_sub(self.after_seq)
            .saturating_sub(1)
    }
}

/// Missing parts of a run.
#[derive(Debug, Clone, PartialEq, Eq, Default)]
pub struct Lost {
    /// Breaks in the sequence numbers, the first 1000.
    pub gaps: Vec<Gap>,
    /// Rows missing in all breaks.
    pub rows: u64,
    /// Rows that are not what was written: their check is wrong.
    pub damaged_rows: u64,
    /// Rows whose number is not larger than the one before: never in a sound run.
    pub disordered_rows: u64,
    /// Bytes passed over because they made no sense.
    pub damaged_bytes: u64,
    /// Bytes of a batch cut off at the end.
    pub torn_bytes: u64,
    /// Whether the file ends with the mark of a finished run.
    pub finished: bool,
    /// The disk refused to read on, in the system's words.
    pub read_error: Option<String>,
}

/// An opened run folder.
#[derive(Debug)]
pub struct RunReader {
    folder: PathBuf,
    meta: Result<RunMeta, String>,
}

impl RunReader {
    /// Opens a run folder. Damaged or missing metadata are no error ([`RunReader::meta`] says so): the rows still read.
    ///
    /// # Errors
    /// [`RecordError::NotARun`] without `ticks.arrow`, [`RecordError::Newer`] for a format that this version does not know.
    pub fn open(folder: &Path) -> Result<Self, RecordError> {
        if !folder.join(TICKS_ARROW).is_file() {
            return Err(RecordError::NotARun {
                path: folder.to_owned(),
            });
        }
        let path = folder.join(RUN_TOML);
        let meta: Result<RunMeta, String> = read_text(&path, MOST_META)
            .map_err(|error| error.to_string())
            .and_then(|text| {
                toml::from_str(&text).map_err(|error| format!("{}: {error}", path.display()))
            });
        if let Ok(meta) = &meta
            && meta.format > FORMAT
        {
            return Err(RecordError::Newer {
                path,
                found: meta.format,
            });
        }
        Ok(Self {
            folder: folder.to_owned(),
            meta,
        })
    }

    /// The run's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The metadata, or the reason for their absence.
    ///
    /// # Errors
    /// A sentence that names the file.
    pub fn meta(&self) -> Result<&RunMeta, &str> {
        self.meta.as_ref().map_err(String::as_str)
    }

    /// Names of the control law's own columns: [`TickRecord::law`] in this order. Empty if the metadata is damaged.
    pub fn law_columns(&self) -> &[String] {
        self.meta.as_ref().map_or(&[], |meta| &meta.law_columns)
    }

    /// The rows, batch by batch, so that a night's run needs no night's memory.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file cannot be opened.
    pub fn batches(&self) -> Result<Batches, RecordError> {
        let path = self.folder.join(TICKS_ARROW);
        let stream = File::open(&path)
            .and_then(|file| Stream::new(BufReader::new(file), self.law_columns().len()))
            .map_err(RecordError::io("cannot read", path))?;
        Ok(Batches {
            stream,
            last_seq: None,
            lost: Lost::default(),
        })
    }

    /// The last row that a condition holds for, without reading those before it.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file cannot be opened, or the disk refuses to read on.
    pub fn last_where(
        &self,
        is: impl Fn(&TickRecord) -> bool,
    ) -> Result<Option<TickRecord>, RecordError> {
        let path = self.folder.join(TICKS_ARROW);
        File::open(&path)
            .and_then(|file| {
                Stream::new(BufReader::new(file), self.law_columns().len())?.last_where(is)
            })
            .map_err(RecordError::io("cannot read", path))
    }

    /// All rows, and what is missing.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the file cannot be opened.
    pub fn ticks(&self) -> Result<(Vec<TickRecord>, Lost), RecordError> {
        let mut batches = self.batches()?;
        let mut ticks = Vec::new();
        for batch in batches.by_ref() {
            ticks.extend(batch);
        }
        Ok((ticks, batches.lost()))
    }

    /// The events, and how many lines are not readable.
    ///
    /// # Errors
    /// [`RecordError::Io`] when the log exists and cannot be read.
    pub fn events(&self) -> Result<Events, RecordError> {
        read_events(&self.folder.join(EVENTS_JSONL))
    }

    /// The run as a plain record: commanded PZT displacement, and the bead position that the camera had delivered
    /// when the command was given (so the camera's delay is in it, as in any record of two instruments). Missing rows
    /// are filled: the command is held, the bead not seen. Takes 24 bytes a row; an export has the other columns.
    ///
    /// # Errors
    /// [`RecordError`] if the rows cannot be read, [`cellpos_table::TableProblem::TooShort`] with fewer than two.
    pub fn to_record(&self) -> Result<Record, RecordError> {
        let mut batches = self.batches()?;
        let mut time_s = Vec::new();
        let (mut pzt_um, mut bead_um) = (Vec::new(), Vec::new());
        for tick in batches.by_ref().flatten() {
            time_s.push(seconds(tick.time_ns));
            pzt_um.push(tick.command_um);
            bead_um.push(crate::export::bead_um(&tick));
        }
        // Rows have numbers: jitter of the real clock is no reason to refuse a run.
        const JITTER: f64 = 0.49;
        Ok(Record::from_rows(
            &self.folder,
            &time_s,
            [pzt_um, bead_um],
            vec![],
            JITTER,
        )?)
    }
}

/// Batches of rows in the order written. See [`RunReader::batches`].
pub struct Batches {
    stream: Stream<BufReader<File>>,
    last_seq: Option<u64>,
    lost: Lost,
}

impl Batches {
    /// Missing rows of the batches so far; complete after the iterator's end.
    pub fn lost(&self) -> Lost {
        Lost {
            damaged_rows: self.stream.damaged_rows,
            damaged_bytes: self.stream.damaged_bytes,
            torn_bytes: self.stream.torn_bytes,
            finished: self.stream.ended,
            ..self.lost.clone()
        }
    }
}

impl Iterator for Batches {
    type Item = Vec<TickRecord>;

    fn next(&mut self) -> Option<Vec<TickRecord>> {
        let batch = match self.stream.next_batch() {
            Ok(batch) => batch?,
            Err(error) => {
                self.lost.read_error = Some(error.to_string());
                return None;
            }
        };
        for row in &batch {
            if let Some(last) = self.last_seq {
                let gap = Gap {
                    after_seq: last,
                    before_seq: row.seq,
                };
                if row.seq <= last {
                    self.lost.disordered_rows += 1;
                } else if gap.rows() > 0 {
                    self.lost.rows = self.lost.rows.saturating_add(gap.rows());
                    if self.lost.gaps.len() < 1000 {
                        self.lost.gaps.push(gap);
                    }
                }
            }
            self.last_seq = Some(row.seq);
        }
        Some(batch)
    }
}
