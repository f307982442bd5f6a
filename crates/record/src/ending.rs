//! Ends a run folder within a time limit: a disk that no longer answers must not hold the program.
//!
//! Separate threads do all work on the disk here. The program waits for them as long as a slow disk may take, and then leaves
//! them behind. A thread that hangs in the kernel blocks only itself; unconfirmed rows count as lost.

use crate::error::RecordError;
use crate::faults::Faults;
use crate::meta::{RunEnd, RunMeta};
use crate::reader::RunReader;
use crate::synced::{DISK_ANSWERS, LAST_PATIENCE};
use crate::writer::{Finished, RunWriter};
use crate::{RUN_TOML, TICKS_PARQUET};
use cellpos_table::write_atomically;
use std::path::{Path, PathBuf};
use std::sync::mpsc;
use std::thread;
use std::time::Duration;

/// Time limit of writing and reading on a slow disk that works: a minute, and a second for each five
/// megabytes.
fn patience(bytes: u64) -> Duration {
    Duration::from_secs(60 + bytes / 5_000_000)
}

/// Result of work on a separate thread, or None after the time limit.
fn within<T: Send + 'static>(
    most: Duration,
    work: impl FnOnce() -> T + Send + 'static,
) -> Option<T> {
    let (done, result) = mpsc::channel();
    let hand_over = move || {
        // The receiver is gone: the result came too late.
        let _ = done.send(work());
    };
    let thread = thread::Builder::new().name("cellpos-finish".to_owned());
    thread.spawn(hand_over).ok()?;
    result.recv_timeout(most).ok()
}

fn no_answer(path: &Path, after: Duration) -> RecordError {
    let text = format!("the disk did not answer within {} s", after.as_secs());
    let source = std::io::Error::new(std::io::ErrorKind::TimedOut, text);
    RecordError::io("cannot write", path)(source)
}

impl RunWriter {
    /// Writes the waiting rows, the end of `run.toml` (sets `ended_utc` and the counts), and `ticks.parquet`.
    ///
    /// It reads the rows back. Every row that does not come back counts as lost, in addition to `end.rows_lost`; the summary's
    /// `records_lost` is the sum. A failing disk is not an error here: the folder holds everything that could be written, and
    /// [`Finished`] reports the rest. A disk that does not answer has 15 s for the last rows. A run on the virtual clock, which
    /// syncs only here, waits a minute and a second for each 5 MB, and so does `ticks.parquet`.
    pub fn finish(self, end: RunEnd) -> Finished {
        let Self {
            folder,
            meta,
            mut log,
        } = self;
        let (taken, unconfirmed) = (log.rows(), log.unconfirmed_rows());
        let settling = match log.syncs() {
            true => LAST_PATIENCE,
            false => patience(log.bytes()),
        };
        let close = move || {
            let answers = log.close(settling);
            (log, answers)
        };
        let longest = settling + 2 * DISK_ANSWERS;
        let mut ending = Ending {
            end,
            meta,
            faults: Faults::default(),
            rows: taken.saturating_sub(unconfirmed),
            slowest_sync: None,
            parquet: Err(no_answer(&folder.join(TICKS_PARQUET), longest)),
            folder,
        };
        let Some((log, answers)) = within(longest, close) else {
            ending.faults.rows_lost = unconfirmed;
            ending.no_answer(longest);
            return ending.finished(false);
        };
        ending.faults = log.faults();
        if log.syncs() {
            let slowest = log.slowest_sync();
            ending.slowest_sync = Some(slowest);
            let ms = slowest.as_secs_f64() * 1e3;
            let summary = &mut ending.end.summary;
            summary.insert("slowest_sync_ms".to_owned(), toml::Value::Float(ms));
        }
        if answers {
            ending.read_back(taken, patience(log.bytes()));
        } else {
            ending.rows = taken.saturating_sub(ending.faults.rows_lost);
        }
        ending.close(answers)
    }
}

/// The end of the run as known so far.
struct Ending {
    folder: PathBuf,
    meta: RunMeta,
    end: RunEnd,
    faults: Faults,
    rows: u64,
    slowest_sync: Option<Duration>,
    parquet: Result<(), RecordError>,
}

impl Ending {
    fn fault(&mut self, error: &RecordError) {
        self.faults.io_errors += 1;
        self.faults.first.get_or_insert(error.to_string());
    }

    fn no_answer(&mut self, after: Duration) {
        let error = no_answer(&self.folder, after);
        self.fault(&error);
    }

    /// Writes `ticks.parquet`, and counts the rows that come back from the disk.
    fn read_back(&mut self, taken: u64, most: Duration) {
        let folder = self.folder.clone();
        let read = within(most, move || (parquet(&folder), rows_on_disk(&folder)));
        let Some((parquet, rows)) = read else {
            self.no_answer(most);
            return;
        };
        self.rows = rows.unwrap_or_else(|error| {
            self.faults.first.get_or_insert(error.to_string());
            0
        });
        self.faults.rows_lost = self.faults.rows_lost.max(taken.saturating_sub(self.rows));
        if let Err(error) = &parquet {
            self.fault(error);
        }
        self.parquet = parquet;
    }

    /// Puts the end into `run.toml`.
    fn close(mut self, answers: bool) -> Finished {
        let end = &mut self.end;
        end.ended_utc = jiff::Timestamp::now()
            .strftime("%Y-%m-%dT%H:%M:%S%.3fZ")
            .to_string();
        end.rows = self.rows;
        end.rows_lost += self.faults.rows_lost;
        end.events_lost += self.faults.events_lost;
        if let Some(lost) = end.summary.get_mut("records_lost") {
            *lost = toml::Value::Integer(i64::try_from(end.rows_lost).unwrap_or(i64::MAX));
        }
        self.meta.end = Some(end.clone());
        let (path, meta) = (self.folder.join(RUN_TOML), self.meta.clone());
        let most = if answers { LAST_PATIENCE } else { DISK_ANSWERS };
        let write = move || {
            let text = meta.to_toml()?;
            write_atomically(&path, text.as_bytes()).map_err(RecordError::from)
        };
        match within(most, write) {
            Some(Ok(())) => return self.finished(true),
            Some(Err(error)) => self.fault(&error),
            None => self.no_answer(most),
        }
        self.finished(false)
    }

    fn finished(self, closed: bool) -> Finished {
        Finished {
            folder: self.folder,
            rows: self.rows,
            slowest_sync: self.slowest_sync,
            faults: self.faults,
            closed,
            parquet: self.parquet,
        }
    }
}

/// Writes `ticks.parquet`. Without the feature the file does not exist and does not count as missing.
#[cfg(feature = "parquet")]
fn parquet(folder: &Path) -> Result<(), RecordError> {
    let run = RunReader::open(folder)?;
    let path = folder.join(TICKS_PARQUET);
    let (source, all) = (crate::Source::single(run), crate::Selection::default());
    crate::write_parquet(&source, &all, &path).map(|_| ())
}

#[cfg(not(feature = "parquet"))]
fn parquet(_: &Path) -> Result<(), RecordError> {
    Ok(())
}

/// Rows that come back from the disk.
fn rows_on_disk(folder: &Path) -> Result<u64, RecordError> {
    let mut batches = RunReader::open(folder)?.batches()?;
    Ok(batches.by_ref().map(|batch| batch.len() as u64).sum())
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn work_that_does_not_come_back_is_left_behind() {
        let (release, held) = mpsc::channel::<()>();
        let hangs = within(Duration::from_millis(20), move || held.recv());
        assert!(hangs.is_none());
        drop(release);
        assert_eq!(within(Duration::from_secs(60), || 7), Some(7));
    }
}
