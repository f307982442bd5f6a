//! The box's own log of the truth, for tests that do not rely on the host.
//!
//! A thread writes the file. While another program fills the disk's cache, the operating system may hold a writer for hundreds of
//! milliseconds, and the box runs in real time.

use super::ProgramError;
use std::fmt::Write as _;
use std::fs::File;
use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{Sender, channel};
use std::thread::JoinHandle;

/// A row comes each 0.97 ms and at each change of the board's state. So rows fall anywhere in the period of a loop of 1 kHz, and tell when its
/// commands act.
const PERIOD_NS: i64 = 970_000;
const FLUSH_NS: i64 = 1_000_000_000;

/// A CSV file.
#[derive(Debug)]
pub(super) struct Log {
    /// Rows that the thread has not got yet.
    rows: String,
    writer: Option<(Sender<String>, JoinHandle<std::io::Result<()>>)>,
    path: PathBuf,
    start_ns: i64,
    next_ns: i64,
    flush_ns: i64,
    last_state: String,
}

/// One instant of the log.
#[derive(Debug, Clone, Copy)]
pub(super) struct Instant<'a> {
    /// Time, ns.
    pub now_ns: i64,
    /// Displacement at the converter, um.
    pub applied_um: f64,
    /// True displacement of the PZT, um.
    pub pzt_um: f64,
    /// True bead position, um.
    pub bead_um: f64,
    /// State of the board, if known.
    pub state: &'a str,
    /// Its fault, if known.
    pub fault: &'a str,
}

impl Log {
    /// Starts a log; an existing file is replaced.
    ///
    /// # Errors
    /// A refusal of the operating system.
    pub(super) fn create(path: &Path, start_ns: i64) -> Result<Self, ProgramError> {
        let file_error = |doing, source| ProgramError::File {
            path: path.to_owned(),
            doing,
            source,
        };
        let mut file = File::create(path).map_err(|e| file_error("creating the log", e))?;
        let (sender, received) = channel::<String>();
        let writing = move || {
            received
                .iter()
                .try_for_each(|rows| file.write_all(rows.as_bytes()))
        };
        let thread = std::thread::Builder::new()
            .name("log".to_owned())
            .spawn(writing)
            .map_err(|e| file_error("starting the log's thread", e))?;
        Ok(Self {
            rows: "time_s,monotonic_ns,applied_um,pzt_um,bead_um,state,fault\n".to_owned(),
            writer: Some((sender, thread)),
            path: path.to_owned(),
            start_ns,
            next_ns: start_ns,
            flush_ns: start_ns + FLUSH_NS,
            last_state: String::new(),
        })
    }

    /// Time of the next row, ns. Rows that waited for the box's next event would stand just behind steps of the output, none just before.
    pub(super) fn next_ns(&self) -> i64 {
        self.next_ns
    }

    /// Writes a row when one is due.
    ///
    /// # Errors
    /// A refusal of the operating system, for example a full disk.
    pub(super) fn note(&mut self, instant: &Instant<'_>) -> Result<(), ProgramError> {
        let now_ns = instant.now_ns;
        let changed = instant.state != self.last_state;
        if now_ns < self.next_ns && !changed {
            return Ok(());
        }
        // On the grid, unless a stall has delayed the log.
        if now_ns >= self.next_ns {
            self.next_ns = (self.next_ns + PERIOD_NS).max(now_ns - PERIOD_NS);
        }
        if changed {
            self.last_state = instant.state.to_owned();
        }
        let _ = writeln!(
            self.rows,
            "{:.6},{},{:.6},{:.6},{:.6},{},{}",
            (now_ns - self.start_ns) as f64 * 1e-9,
            now_ns,
            instant.applied_um,
            instant.pzt_um,
            instant.bead_um,
            instant.state,
            instant.fault
        );
        if now_ns >= self.flush_ns {
            self.flush_ns = now_ns + FLUSH_NS;
            self.hand_over()?;
        }
        Ok(())
    }

    /// Gives the thread what is there. It ends early only if it cannot write.
    fn hand_over(&mut self) -> Result<(), ProgramError> {
        let rows = std::mem::take(&mut self.rows);
        match &self.writer {
            Some((sender, _)) if sender.send(rows).is_ok() => Ok(()),
            _ => self.finish(),
        }
    }

    /// Writes the rest, and waits until it is written.
    ///
    /// # Errors
    /// A refusal of the operating system.
    pub(super) fn finish(&mut self) -> Result<(), ProgramError> {
        let Some((sender, thread)) = self.writer.take() else {
            return Ok(());
        };
        // A thread that has ended says why.
        let _ = sender.send(std::mem::take(&mut self.rows));
        drop(sender);
        let written = thread
            .join()
            .unwrap_or_else(|_| Err(std::io::Error::other("its thread died")));
        written.map_err(|source| ProgramError::File {
            path: self.path.clone(),
            doing: "writing the log",
            source,
        })
    }
}

/// A program that ends early loses no row.
impl Drop for Log {
    fn drop(&mut self) {
        let _ = self.finish();
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::os::fd::AsRawFd;

    fn note(log: &mut Log, row: i64) -> Result<(), ProgramError> {
        log.note(&Instant {
            now_ns: row * PERIOD_NS,
            applied_um: 20.0,
            pzt_um: 20.0,
            bead_um: 0.0,
            state: "Running",
            fault: "None",
        })
    }

    #[test]
    fn a_disk_that_takes_nothing_does_not_stop_the_box_and_a_refusal_names_the_file() {
        let (reader, writer) = std::io::pipe().expect("a pipe");
        let path = PathBuf::from(format!("/proc/self/fd/{}", writer.as_raw_fd()));
        let mut log = Log::create(&path, 0).expect("a log");
        drop(writer);
        // A megabyte, of which the pipe takes a sixteenth.
        for row in 0..20_000 {
            note(&mut log, row).expect("nothing waits");
        }
        drop(reader);
        let refused = log.finish().expect_err("nobody reads");
        assert!(refused.to_string().contains("writing the log"), "{refused}");
        assert!(
            refused.to_string().starts_with("/proc/self/fd/"),
            "{refused}"
        );
    }
}
