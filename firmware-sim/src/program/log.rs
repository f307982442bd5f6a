//! The box's own log of the truth, for tests that do not rely on the host.

use super::ProgramError;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// A row each 0.97 ms and at each change of the board's state: rows fall anywhere in the period of a loop of 1 kHz, so that they tell when
/// its commands act.
const PERIOD_NS: i64 = 970_000;
const FLUSH_NS: i64 = 1_000_000_000;

/// A CSV file.
#[derive(Debug)]
pub(super) struct Log {
    file: BufWriter<File>,
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
        let file = File::create(path).map_err(|source| ProgramError::File {
            path: path.to_owned(),
            doing: "creating the log",
            source,
        })?;
        let mut log = Self {
            file: BufWriter::with_capacity(1 << 16, file),
            path: path.to_owned(),
            start_ns,
            next_ns: start_ns,
            flush_ns: start_ns + FLUSH_NS,
            last_state: String::new(),
        };
        log.write(format_args!(
            "time_s,monotonic_ns,applied_um,pzt_um,bead_um,state,fault\n"
        ))?;
        Ok(log)
    }

    fn write(&mut self, text: std::fmt::Arguments<'_>) -> Result<(), ProgramError> {
        self.file
            .write_fmt(text)
            .map_err(|source| ProgramError::File {
                path: self.path.clone(),
                doing: "writing the log",
                source,
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
        self.write(format_args!(
            "{:.6},{},{:.6},{:.6},{:.6},{},{}\n",
            (now_ns - self.start_ns) as f64 * 1e-9,
            now_ns,
            instant.applied_um,
            instant.pzt_um,
            instant.bead_um,
            instant.state,
            instant.fault
        ))?;
        if now_ns >= self.flush_ns {
            self.flush_ns = now_ns + FLUSH_NS;
            self.flush()?;
        }
        Ok(())
    }

    /// Passes everything to the operating system.
    ///
    /// # Errors
    /// A refusal of the operating system.
    pub(super) fn flush(&mut self) -> Result<(), ProgramError> {
        self.file.flush().map_err(|source| ProgramError::File {
            path: self.path.clone(),
            doing: "writing the log",
            source,
        })
    }
}
