//! A text file that grows only by whole lines.

use crate::blocks::{Blocks, open_here};
use crate::error::RecordError;
use crate::faults::Faults;
use crate::synced::{DISK_ANSWERS, SyncedFile};
use cellpos_runtime::recorder::Unconfirmed;
use std::fs::{File, OpenOptions};
use std::io::{Read, Seek, SeekFrom};
use std::path::Path;

/// A text file with a head line that grows line by line. An acknowledged line is completely in the file, whatever happens to this
/// process afterwards.
///
/// Only one process can have it open: it holds a lock, which ends with the process. Lines that the disk refuses wait and are
/// tried again with the next ones; when too much waits, the newest are dropped and counted. Belongs to the recorder thread; may
/// block.
pub struct LineFile {
    blocks: Blocks<SyncedFile>,
    sync: bool,
    io_errors: u64,
    first: Option<String>,
    failing: bool,
}

/// The complete lines of a text, without a last one that was cut off.
pub fn whole_text(text: &str) -> &str {
    text.get(..whole_lines(text.as_bytes()) as usize)
        .unwrap_or("")
}

impl LineFile {
    /// Opens or makes a file. It removes a last line that was cut off, and writes the head into an empty file. `sync`: wait for
    /// the disk at each write.
    ///
    /// # Errors
    /// [`RecordError::Io`] when it cannot be opened, or another process has it open.
    pub fn open(path: &Path, head: &str, sync: bool) -> Result<Self, RecordError> {
        let attempt = || -> std::io::Result<Self> {
            let mut options = OpenOptions::new();
            options.read(true).write(true).create(true).truncate(false);
            let mut file = open_here(&mut options, path)?;
            file.try_lock().map_err(|error| match error {
                std::fs::TryLockError::Error(error) => error,
                std::fs::TryLockError::WouldBlock => std::io::Error::new(
                    std::io::ErrorKind::WouldBlock,
                    "another process is writing it: is the run still going on?",
                ),
            })?;
            let whole = whole_length(&mut file)?;
            file.set_len(whole)?;
            file.seek(SeekFrom::Start(whole))?;
            let mut lines = Self {
                blocks: Blocks::new(SyncedFile::new(file), whole),
                sync,
                io_errors: 0,
                first: None,
                failing: false,
            };
            if whole == 0 {
                lines.blocks.push(format!("{head}\n").as_bytes(), 0);
                lines.write()?;
            }
            Ok(lines)
        };
        attempt().map_err(RecordError::io("cannot open", path))
    }

    /// Takes a line (without its end); it goes to the disk with the next [`LineFile::flush`].
    pub fn push(&mut self, line: &str) {
        self.blocks.push(format!("{line}\n").as_bytes(), 1);
    }

    fn write(&mut self) -> std::io::Result<()> {
        self.blocks.write()?;
        if self.sync {
            self.blocks.sync()
        } else {
            Ok(())
        }
    }

    /// Writes the waiting lines; returns whether all are written.
    pub fn flush(&mut self) -> bool {
        let written = self.write();
        self.failing = written.is_err();
        if let Err(error) = written {
            self.fault(&error);
        }
        self.blocks.waiting_bytes() == 0
    }

    fn fault(&mut self, error: &std::io::Error) {
        self.io_errors += 1;
        if self.first.is_none() {
            tracing::error!("the table is incomplete: {error}");
            self.first = Some(error.to_string());
        }
    }

    /// Writes the waiting lines for the last time, and waits for the disk to confirm them.
    pub fn close(&mut self) {
        self.flush();
        if self.sync
            && let Err(error) = self.blocks.settle(DISK_ANSWERS)
        {
            self.fault(&error);
        }
    }

    /// Written lines that the disk has not confirmed.
    pub fn unconfirmed(&self) -> Unconfirmed {
        Unconfirmed {
            since: self.blocks.sink().unconfirmed(),
            rows: self.blocks.unconfirmed_units(),
        }
    }

    /// Whether the last attempt to write failed.
    pub fn is_failing(&self) -> bool {
        self.failing
    }

    /// Lines that could not be written: dropped ones, and those that still wait.
    pub fn faults(&self) -> Faults {
        Faults {
            rows_lost: self.blocks.lost(),
            events_lost: 0,
            io_errors: self.io_errors,
            first: self.first.clone(),
        }
    }
}

/// Length of a file without a last line that was cut off.
fn whole_length(file: &mut File) -> std::io::Result<u64> {
    const BLOCK: usize = 1 << 16;
    let mut block = vec![0; BLOCK];
    let mut end = file.seek(SeekFrom::End(0))?;
    while end > 0 {
        let start = end.saturating_sub(BLOCK as u64);
        let part = &mut block[..(end - start) as usize];
        file.seek(SeekFrom::Start(start))?;
        file.read_exact(part)?;
        let whole = whole_lines(part);
        if whole > 0 {
            return Ok(start + whole);
        }
        end = start;
    }
    Ok(0)
}

/// Length of the lines that end with a line end.
pub(crate) fn whole_lines(bytes: &[u8]) -> u64 {
    bytes
        .iter()
        .rposition(|byte| *byte == b'\n')
        .map_or(0, |last| last as u64 + 1)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_torn_line_is_cut_away_and_whole_ones_stay() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cycles.csv");
        let mut lines = LineFile::open(&path, "a,b", false).unwrap();
        lines.push("1,2");
        assert!(lines.flush() && lines.flush());
        drop(lines);
        let mut text = std::fs::read_to_string(&path).unwrap();
        text.push_str("3,");
        std::fs::write(&path, &text).unwrap();
        assert_eq!(whole_text(&text), "a,b\n1,2\n");
        let mut lines = LineFile::open(&path, "a,b", true).unwrap();
        lines.push("3,4");
        lines.push("5,6");
        assert!(lines.flush());
        assert_eq!(
            std::fs::read_to_string(&path).unwrap(),
            "a,b\n1,2\n3,4\n5,6\n"
        );
        assert_eq!(lines.faults(), Faults::default());
    }

    #[test]
    fn a_file_that_is_being_written_is_not_opened_a_second_time() {
        let folder = tempfile::tempdir().unwrap();
        let path = folder.path().join("cycles.csv");
        let first = LineFile::open(&path, "a", false).unwrap();
        let error = LineFile::open(&path, "a", false).err().unwrap();
        assert!(error.to_string().contains("cycles.csv"), "{error}");
        drop(first);
        assert!(LineFile::open(&path, "a", false).is_ok());
    }

    #[test]
    fn lines_that_a_full_disk_refuses_are_counted_and_wait() {
        // /dev/full refuses every write; it has no length to cut to.
        let Ok(file) = OpenOptions::new().write(true).open("/dev/full") else {
            eprintln!("no /dev/full here: nothing tested");
            return;
        };
        let mut lines = LineFile {
            blocks: Blocks::new(SyncedFile::new(file), 0),
            sync: false,
            io_errors: 0,
            first: None,
            failing: false,
        };
        for _ in 0..3 {
            lines.push("1,2");
            assert!(!lines.flush());
        }
        let faults = lines.faults();
        assert_eq!((faults.rows_lost, faults.io_errors), (3, 3));
        assert!(faults.first.is_some());
    }
}
