//! Writes a run during the run.

use crate::blocks::{Blocks, Sink, open_here};
use crate::columns::{self, Builder, Group};
use crate::error::RecordError;
use crate::events::Event;
use crate::faults::Faults;
use crate::meta::RunMeta;
use crate::synced::{DISK_ANSWERS, SyncedFile};
use crate::{EVENTS_JSONL, RUN_TOML, TICKS_ARROW};
use arrow_ipc::writer::StreamWriter;
use cellpos_runtime::TickRecord;
use cellpos_runtime::recorder::Unconfirmed;
use cellpos_table::write_atomically;
use std::fs::OpenOptions;
use std::io;
use std::path::{Path, PathBuf};
use std::time::{Duration, Instant};

/// The times at which rows go to the disk.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct FlushPolicy {
    /// Rows in a full batch.
    pub rows: usize,
    /// Longest time that a row waits; None: only full batches, so that the file is identical in every run.
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

/// What [`RunWriter::finish`] leaves behind.
#[derive(Debug)]
pub struct Finished {
    /// The run's folder.
    pub folder: PathBuf,
    /// Rows written.
    pub rows: u64,
    /// The data that could not be written.
    pub faults: Faults,
    /// Longest time that the disk took to confirm a write, if the policy syncs.
    pub slowest_sync: Option<Duration>,
    /// Whether `run.toml` has the end of the run.
    pub closed: bool,
    /// Why `ticks.parquet` is missing, if it is.
    pub parquet: Result<(), RecordError>,
}

/// Writes a run folder. See the crate's documentation; belongs to the recorder thread.
pub struct RunWriter {
    pub(crate) folder: PathBuf,
    pub(crate) meta: RunMeta,
    pub(crate) log: Log<SyncedFile>,
}

/// Columns and events, with counts of the losses.
pub(crate) struct Log<S: Sink> {
    builder: Builder,
    encoder: StreamWriter<Vec<u8>>,
    ticks: Blocks<S>,
    events: Blocks<S>,
    policy: FlushPolicy,
    last_flush: Instant,
    /// Rows that could not be encoded.
    rows_refused: u64,
    rows: u64,
    io_errors: u64,
    first: Option<String>,
    /// The last attempt to write failed.
    failing: bool,
    closed: bool,
}

impl<S: Sink> Drop for Log<S> {
    /// A log dropped after a failure writes the rest.
    fn drop(&mut self) {
        if !self.closed {
            self.flush();
        }
    }
}

impl<S: Sink> Log<S> {
    pub(crate) fn new(
        ticks: Blocks<S>,
        events: Blocks<S>,
        policy: FlushPolicy,
        groups: &[Group],
        law: &[String],
    ) -> Result<Self, RecordError> {
        let builder = Builder::new(policy.rows, groups, law);
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
            rows_refused: 0,
            rows: 0,
            io_errors: 0,
            first: None,
            failing: false,
            closed: false,
        };
        log.ticks.push(&schema, 0);
        log.write(policy.sync);
        Ok(log)
    }

    fn fault(&mut self, error: &dyn std::fmt::Display) {
        self.io_errors += 1;
        if self.first.is_none() {
            // Log it only once: a full disk would otherwise fill the log too.
            tracing::error!("the record is incomplete: {error}; losses are counted");
            self.first = Some(error.to_string());
        }
    }

    pub(crate) fn faults(&self) -> Faults {
        Faults {
            rows_lost: self.ticks.lost() + self.rows_refused,
            events_lost: self.events.lost(),
            io_errors: self.io_errors,
            first: self.first.clone(),
        }
    }

    pub(crate) fn tick(&mut self, row: &TickRecord) {
        if let Some(name) = self.builder.push(row) {
            self.fault(&format!("the run has no column for the value of {name}"));
        }
        self.rows += 1;
        if self.builder.rows() >= self.policy.rows {
            self.flush();
        } else {
            self.poll();
        }
    }

    pub(crate) fn poll(&mut self) {
        if self
            .policy
            .interval
            .is_some_and(|longest| self.last_flush.elapsed() >= longest)
        {
            self.flush();
        }
    }

    /// Passes the rows gathered so far to the file, then the events that came with them.
    pub(crate) fn flush(&mut self) {
        let rows = self.builder.rows() as u64;
        if rows > 0 {
            let encoded = self
                .builder
                .take()
                .and_then(|batch| self.encoder.write(&batch));
            let bytes = std::mem::take(self.encoder.get_mut());
            match encoded {
                Ok(()) => self.ticks.push(&bytes, rows),
                Err(error) => {
                    self.rows_refused += rows;
                    self.fault(&error);
                }
            }
        }
        self.write(self.policy.sync);
    }

    /// Rows first, so that the ticks of every logged event are in the file.
    fn write(&mut self, sync: bool) {
        self.last_flush = Instant::now();
        let mut attempt = || {
            self.ticks.is_there()?;
            self.ticks.write()?;
            if sync {
                self.ticks.sync()?;
            }
            self.events.write()?;
            if sync {
                self.events.sync()?;
            }
            io::Result::Ok(())
        };
        let written = attempt();
        self.failing = written.is_err();
        if let Err(error) = written {
            self.fault(&error);
        }
    }

    pub(crate) fn event(&mut self, event: &Event) {
        match event.line() {
            Ok(line) => self.events.push(line.as_bytes(), 1),
            Err(error) => self.fault(&error),
        }
    }

    /// Rows that were taken.
    pub(crate) fn rows(&self) -> u64 {
        self.rows
    }

    /// Whether each flush is synced.
    pub(crate) fn syncs(&self) -> bool {
        self.policy.sync
    }

    /// Length of the rows so far.
    pub(crate) fn bytes(&self) -> u64 {
        self.ticks.bytes()
    }

    /// Rows that are only in memory, as far as the disk has confirmed.
    pub(crate) fn unconfirmed_rows(&self) -> u64 {
        self.builder.rows() as u64 + self.ticks.waiting_units() + self.ticks.unconfirmed_units()
    }

    /// Writes the waiting rows and the end mark, and syncs; returns whether the disk confirmed them.
    pub(crate) fn close(&mut self, most: Duration) -> bool {
        self.closed = true;
        self.flush();
        if !self.failing {
            let end = [0xff, 0xff, 0xff, 0xff, 0, 0, 0, 0];
            self.ticks.push(&end, 0);
            self.write(true);
        }
        let until = Instant::now() + most;
        let mut answers = true;
        let settled = self.ticks.settle(most);
        // Both share one time limit; the second sync is requested even if the disk has not answered the first.
        let left = until.saturating_duration_since(Instant::now());
        for settled in [settled, self.events.settle(left.max(DISK_ANSWERS))] {
            if let Err(error) = settled {
                answers &= error.kind() != io::ErrorKind::TimedOut;
                self.fault(&error);
            }
        }
        answers
    }
}

impl Log<SyncedFile> {
    /// The longest sync so far.
    pub(crate) fn slowest_sync(&self) -> Duration {
        self.ticks
            .sink()
            .slowest()
            .max(self.events.sink().slowest())
    }

    fn unconfirmed(&self) -> Unconfirmed {
        let (ticks, events) = (self.ticks.sink(), self.events.sink());
        Unconfirmed {
            since: ticks.unconfirmed().max(events.unconfirmed()),
            rows: self.unconfirmed_rows(),
        }
    }
}

/// Refuses a name that a run cannot have.
///
/// # Errors
/// [`RecordError::Name`].
pub fn check_name(name: &str) -> Result<(), RecordError> {
    let fits = |c: char| c.is_ascii_alphanumeric() || c == '-' || c == '_';
    if name.is_empty() || name.len() > 64 || !name.chars().all(fits) {
        return Err(RecordError::Name(name.to_owned()));
    }
    Ok(())
}

impl RunWriter {
    /// Makes a new folder `<root>/<UTC time>-<name>` (with `-2`, `-3`, ... if it exists) and starts writing.
    ///
    /// `meta.started_utc` is set here. The clock named in `meta` decides the [`FlushPolicy`].
    ///
    /// # Errors
    /// [`RecordError`] if the folder cannot be made or the name is invalid. A run that cannot be recorded at its start
    /// should not begin.
    pub fn create(root: &Path, meta: RunMeta) -> Result<Self, RecordError> {
        crate::space::check(root, None, &meta.columns)?;
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
        check_name(&meta.name)?;
        if let Some(name) = columns::impossible(&meta.law_columns) {
            return Err(RecordError::LawColumn(name.to_owned()));
        }
        let made = std::fs::create_dir_all(root).map_err(|error| match root.is_file() {
            true => io::Error::new(error.kind(), "it is a file, not a folder"),
            false => error,
        });
        made.map_err(RecordError::io("cannot create", root))?;
        let now = jiff::Timestamp::now();
        meta.started_utc = now.strftime("%Y-%m-%dT%H:%M:%S%.3fZ").to_string();
        let stem = format!("{}-{}", now.strftime("%Y%m%dT%H%M%SZ"), meta.name);
        let folder = claim(root, &stem)?;
        write_atomically(&folder.join(RUN_TOML), meta.to_toml()?.as_bytes())?;
        let create = |name: &str| {
            let path = folder.join(name);
            open_here(OpenOptions::new().write(true).create_new(true), &path)
                .map(SyncedFile::new)
                .map_err(RecordError::io("cannot create", path))
        };
        let ticks = Blocks::new(create(TICKS_ARROW)?, 0);
        let events = Blocks::new(create(EVENTS_JSONL)?, 0);
        Ok(Self {
            log: Log::new(
                ticks,
                events,
                policy.sane(),
                &meta.columns,
                &meta.law_columns,
            )?,
            folder,
            meta,
        })
    }

    /// The run's folder.
    pub fn folder(&self) -> &Path {
        &self.folder
    }

    /// Adds conditions that are known only during the run; they are written at the end.
    pub fn add_conditions(&mut self, conditions: toml::Table) {
        self.meta.conditions.extend(conditions);
    }

    /// Takes a row; it goes to the disk with its batch.
    pub fn tick(&mut self, row: &TickRecord) {
        self.log.tick(row);
    }

    /// Takes an event; it goes to the disk with the next batch, after its ticks.
    pub fn event(&mut self, event: &Event) {
        self.log.event(event);
    }

    /// Flushes if a row has waited long enough. Call it when no row comes, at least ten times a second.
    pub fn poll(&mut self) {
        self.log.poll();
    }

    /// Writes all waiting rows, whatever their age.
    pub fn flush(&mut self) {
        self.log.flush();
    }

    /// Rows that the disk has not confirmed, including those that still gather for the next flush. The time counts from
    /// the flush.
    pub fn unconfirmed(&self) -> Unconfirmed {
        self.log.unconfirmed()
    }

    /// Whether the last attempt to write failed; the next batch tries the waiting rows again.
    pub fn is_failing(&self) -> bool {
        self.log.failing
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
