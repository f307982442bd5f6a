//! Writing a run while it runs.

use crate::columns::Builder;
use crate::error::RecordError;
use crate::events::Event;
use crate::meta::{RunEnd, RunMeta};
use crate::reader::RunReader;
use crate::{EVENTS_JSONL, RUN_TOML, TICKS_ARROW, TICKS_PARQUET};
use arrow_ipc::writer::StreamWriter;
use cellpos_runtime::TickRecord;
use cellpos_table::write_atomically;
use std::fs::{File, OpenOptions};
use std::io::{self, Seek, SeekFrom, Write};
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// When rows go to the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlushPolicy {
    /// Rows in a full batch.
    pub rows: usize,
    /// Longest time that a row waits; None: only full batches, so that the file is the same to the bit every time.
    pub interval: Option<Duration>,
    /// Whether each flush waits until the disk has it (fdatasync).
    pub sync: bool,
}

impl FlushPolicy {
    /// For the real clock: half a second at most, synced.
    pub const REAL: Self = Self {
        rows: 500,
        interval: Some(Duration::from_millis(500)),
        sync: true,
    };
    /// For the virtual clock: large batches of fixed size, synced at the end.
    pub const VIRTUAL: Self = Self {
        rows: 8192,
        interval: None,
        sync: false,
    };
}

/// What could not be written so far.
#[derive(Debug, Clone, Default, PartialEq, Eq)]
pub struct Faults {
    /// Rows not written.
    pub rows_lost: u64,
    /// Events not written.
    pub events_lost: u64,
    /// Refusals of the disk.
    pub io_errors: u64,
    /// The first refusal, in the system's words.
    pub first: Option<String>,
}

/// What [`RunWriter::finish`] leaves behind.
#[derive(Debug)]
pub struct Finished {
    /// The run's folder.
    pub folder: PathBuf,
    /// Rows written.
    pub rows: u64,
    /// What could not be written.
    pub faults: Faults,
    /// Why there is no `ticks.parquet`, if there is none.
    pub parquet: Result<(), RecordError>,
}

/// A file to append to, as far as the writer needs it.
pub(crate) trait Sink {
    /// Appends all bytes, or fails, perhaps after some of them.
    fn append(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Cuts the file to a length.
    fn cut(&mut self, length: u64) -> io::Result<()>;
    /// Waits until the disk has everything.
    fn sync(&mut self) -> io::Result<()>;
}

impl Sink for File {
    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.write_all(bytes)
    }

    fn cut(&mut self, length: u64) -> io::Result<()> {
        self.set_len(length)?;
        self.seek(SeekFrom::Start(length)).map(|_| ())
    }

    fn sync(&mut self) -> io::Result<()> {
        self.sync_data()
    }
}

/// A file of which only whole blocks are kept: a block that fails is taken back.
pub(crate) struct Blocks<S> {
    sink: S,
    /// Length up to which the file is whole.
    good: u64,
    /// Whether bytes of a failed block may still stand behind `good`.
    torn: bool,
}

impl<S: Sink> Blocks<S> {
    pub(crate) fn new(sink: S, good: u64) -> Self {
        Self {
            sink,
            good,
            torn: false,
        }
    }

    pub(crate) fn append(&mut self, bytes: &[u8], sync: bool) -> io::Result<()> {
        if self.torn {
            self.sink.cut(self.good)?;
            self.torn = false;
        }
        match self.sink.append(bytes) {
            Ok(()) => {
                self.good += bytes.len() as u64;
                if sync { self.sink.sync() } else { Ok(()) }
            }
            Err(error) => {
                // Cutting frees nothing and so works on a full disk; if not, it is tried again before the next block.
                self.torn = self.sink.cut(self.good).is_err();
                Err(error)
            }
        }
    }
}

/// Writes a run folder. See the crate's documentation; belongs to the recorder thread.
pub struct RunWriter {
    folder: PathBuf,
    meta: RunMeta,
    log: Log<File>,
}

/// Columns and events, with the account of what was lost.
pub(crate) struct Log<S: Sink> {
    builder: Builder,
    encoder: StreamWriter<Vec<u8>>,
    ticks: Blocks<S>,
    events: Blocks<S>,
    policy: FlushPolicy,
    last_flush: Instant,
    rows: u64,
    faults: Faults,
}

impl<S: Sink> Log<S> {
    pub(crate) fn new(
        ticks: Blocks<S>,
        events: Blocks<S>,
        policy: FlushPolicy,
        write_schema: bool,
    ) -> Result<Self, RecordError> {
        let builder = Builder::new(policy.rows);
        let mut encoder = StreamWriter::try_new(Vec::new(), builder.schema()).map_err(|error| {
            RecordError::Encode {
                what: "the columns of a run",
                message: error.to_string(),
            }
        })?;
        let schema = std::mem::take(encoder.get_mut());
        let mut log = Self {
            builder,
            encoder,
            ticks,
            events,
            policy,
            last_flush: Instant::now(),
            rows: 0,
            faults: Faults::default(),
        };
        if write_schema && let Err(error) = log.ticks.append(&schema, policy.sync) {
            log.fault(&error);
        }
        Ok(log)
    }

    fn fault(&mut self, error: &dyn std::fmt::Display) {
        self.faults.io_errors += 1;
        if self.faults.first.is_none() {
            // Said once: a full disk would otherwise fill the log too.
            tracing::error!(
                "the record is incomplete: {error}; control goes on, losses are counted"
            );
            self.faults.first = Some(error.to_string());
        }
    }

    pub(crate) fn tick(&mut self, row: &TickRecord) {
        self.builder.push(row);
        if self.builder.rows() >= self.policy.rows {
            self.flush();
        } else if self.builder.rows() == 1 {
            // The wait counts from the oldest row.
            self.last_flush = Instant::now();
        } else {
            self.poll();
        }
    }

    pub(crate) fn poll(&mut self) {
        if self.builder.rows() > 0
            && self
                .policy
                .interval
                .is_some_and(|longest| self.last_flush.elapsed() >= longest)
        {
            self.flush();
        }
    }

    pub(crate) fn flush(&mut self) {
        let rows = self.builder.rows() as u64;
        if rows == 0 {
            return;
        }
        let written = self
            .builder
            .take()
            .and_then(|batch| self.encoder.write(&batch))
            .map_err(|error| error.to_string())
            .and_then(|()| {
                let bytes = std::mem::take(self.encoder.get_mut());
                self.ticks
                    .append(&bytes, self.policy.sync)
                    .map_err(|error| error.to_string())
            });
        match written {
            Ok(()) => self.rows += rows,
            Err(error) => {
                self.encoder.get_mut().clear();
                self.faults.rows_lost += rows;
                self.fault(&error);
            }
        }
    }

    pub(crate) fn event(&mut self, event: &Event) {
        let written = event
            .line()
            .map_err(io::Error::from)
            .and_then(|line| self.events.append(line.as_bytes(), self.policy.sync));
        if let Err(error) = written {
            self.faults.events_lost += 1;
            self.fault(&error);
        }
    }

    /// Writes what waits and the end mark, and syncs.
    pub(crate) fn close(&mut self) {
        self.flush();
        let end = [0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0];
        if let Err(error) = self.ticks.append(&end, true) {
            self.fault(&error);
        }
        if let Err(error) = self.events.sink.sync() {
            self.fault(&error);
        }
    }
}

impl RunWriter {
    /// Makes a new folder `<root>/<UTC time>-<name>` (with `-2`, `-3`, ... if it exists) and starts writing.
    ///
    /// `meta.started_utc` is set here. The clock named in `meta` decides the [`FlushPolicy`].
    ///
    /// # Errors
    /// [`RecordError`] when the folder cannot be made or the name cannot be one. A run that cannot be recorded at its
    /// start should not begin.
    pub fn create(root: &Path, meta: RunMeta) -> Result<Self, RecordError> {
        let policy = if meta.clock == "virtual" {
            FlushPolicy::VIRTUAL
        } else {
            FlushPolicy::REAL
        };
        Self::create_with(root, meta, policy)
    }

    /// As [`RunWriter::create`], with a chosen policy.
    ///
    /// # Errors
    /// As [`RunWriter::create`].
    pub fn create_with(
        root: &Path,
        mut meta: RunMeta,
        policy: FlushPolicy,
    ) -> Result<Self, RecordError> {
        let fits = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
        if meta.name.is_empty() || meta.name.len() > 64 || !meta.name.chars().all(fits) {
            return Err(RecordError::Name(meta.name));
        }
        std::fs::create_dir_all(root).map_err(RecordError::io("cannot create", root))?;
        let now = jiff::Timestamp::now();
        meta.started_utc = now.strftime("%Y-%m-%dT%H:%M:%S%.3fZ").to_string();
        let stem = format!("{}-{}", now.strftime("%Y%m%dT%H%M%SZ"), meta.name);
        let folder = claim(root, &stem)?;
        write_atomically(&folder.join(RUN_TOML), meta.to_toml()?.as_bytes())?;
        let create = |name: &str| {
            let path = folder.join(name);
            OpenOptions::new()
                .write(true)
                .create_new(true)
                .open(&path)
                .map_err(RecordError::io("cannot create", path))
        };
        let ticks = Blocks::new(create(TICKS_ARROW)?, 0);
        let events = Blocks::new(create(EVENTS_JSONL)?, 0);
        Ok(Self {
            log: Log::new(ticks, events, policy.sane(), true)?,
            folder,
            meta,
        })
    }

    /// The run's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// The run's metadata as written.
    pub fn meta(&self) -> &RunMeta {
        &self.meta
    }

    /// Takes a row; it goes to the disk with its batch.
    pub fn tick(&mut self, row: &TickRecord) {
        self.log.tick(row);
    }

    /// Writes an event at once.
    pub fn event(&mut self, event: &Event) {
        self.log.event(event);
    }

    /// Flushes if a row has waited long enough. Call it when no row comes, at least ten times a second.
    pub fn poll(&mut self) {
        self.log.poll();
    }

    /// Writes what waits, whatever its age.
    pub fn flush(&mut self) {
        self.log.flush();
    }

    /// What could not be written so far.
    pub fn faults(&self) -> &Faults {
        &self.log.faults
    }

    /// Writes what waits, the end of `run.toml` (`ended_utc` and the counts are set here), and `ticks.parquet`.
    ///
    /// A failing disk is no error here either: what could be written is there, and [`Finished`] says the rest.
    pub fn finish(mut self, mut end: RunEnd) -> Finished {
        self.log.close();
        end.ended_utc = jiff::Timestamp::now()
            .strftime("%Y-%m-%dT%H:%M:%S%.3fZ")
            .to_string();
        end.rows = self.log.rows;
        end.rows_lost = self.log.faults.rows_lost;
        end.events_lost = self.log.faults.events_lost;
        self.meta.end = Some(end);
        let written = self.meta.to_toml().and_then(|text| {
            write_atomically(&self.folder.join(RUN_TOML), text.as_bytes())?;
            Ok(())
        });
        if let Err(error) = written {
            self.log.fault(&error);
        }
        let parquet = RunReader::open(&self.folder)
            .and_then(|run| crate::write_parquet(&run, &self.folder.join(TICKS_PARQUET)));
        if let Err(error) = &parquet {
            self.log.fault(error);
        }
        Finished {
            folder: self.folder.clone(),
            rows: self.log.rows,
            faults: self.log.faults.clone(),
            parquet,
        }
    }
}

impl Drop for RunWriter {
    /// A writer dropped on the way out of a failure leaves what it had.
    fn drop(&mut self) {
        self.log.flush();
    }
}

impl FlushPolicy {
    /// Bounds that keep a batch readable (see the reader's limits) and not empty.
    fn sane(self) -> Self {
        Self {
            rows: self.rows.clamp(1, 1 << 17),
            ..self
        }
    }
}

/// Length of the lines that end with a line end.
pub(crate) fn whole_lines(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |last| last as u64 + 1)
}

/// Makes a folder that did not exist.
fn claim(root: &Path, stem: &str) -> Result<PathBuf, RecordError> {
    let mut number = 1;
    loop {
        let folder = if number == 1 {
            root.join(stem)
        } else {
            root.join(format!("{stem}-{number}"))
        };
        match std::fs::create_dir(&folder) {
            Ok(()) => return Ok(folder),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => number += 1,
            Err(error) => return Err(RecordError::io("cannot create", folder)(error)),
        }
    }
}

#[cfg(test)]
#[path = "writer_tests.rs"]
mod tests;
