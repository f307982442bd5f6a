//! The box's own log: what really happened, for proofs that do not rest on what the host says.

use super::ProgramError;
use cellpos_firmware_sim::RigInABox;
use std::fs::File;
use std::io::{BufWriter, Write};
use std::path::{Path, PathBuf};

/// A row each millisecond and at each change of the board's state.
const PERIOD_NS: i64 = 1_000_000;
const FLUSH_NS: i64 = 1_000_000_000;

/// A CSV file.
#[derive(Debug)]
pub struct Log {
    file: BufWriter<File>,
    path: PathBuf,
    start_ns: i64,
    next_ns: i64,
    flush_ns: i64,
    last_state: u8,
}

impl Log {
    /// Starts a log; an existing file is replaced.
    ///
    /// # Errors
    /// What the operating system refuses.
    pub fn create(path: &Path, start_ns: i64) -> Result<Self, ProgramError> {
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
            last_state: u8::MAX,
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

    /// Writes a row when one is due.
    ///
    /// # Errors
    /// What the operating system refuses, a full disk for example.
    pub fn note(&mut self, rig: &RigInABox) -> Result<(), ProgramError> {
        let now_ns = rig.now_ns();
        let state = rig.board().state();
        let changed = state as u8 != self.last_state;
        if now_ns < self.next_ns && !changed {
            return Ok(());
        }
        // On the grid, unless a stall has put the log behind it.
        if now_ns >= self.next_ns {
            self.next_ns = (self.next_ns + PERIOD_NS).max(now_ns - PERIOD_NS);
        }
        self.last_state = state as u8;
        self.write(format_args!(
            "{:.6},{},{:.6},{:.6},{:.6},{:?},{:?}\n",
            (now_ns - self.start_ns) as f64 * 1e-9,
            now_ns,
            rig.applied_um(),
            rig.world().pzt_um(),
            rig.world().bead_um(),
            state,
            rig.board().fault()
        ))?;
        if now_ns >= self.flush_ns {
            self.flush_ns = now_ns + FLUSH_NS;
            self.flush()?;
        }
        Ok(())
    }

    /// Hands everything to the operating system.
    ///
    /// # Errors
    /// What the operating system refuses.
    pub fn flush(&mut self) -> Result<(), ProgramError> {
        self.file.flush().map_err(|source| ProgramError::File {
            path: self.path.clone(),
            doing: "writing the log",
            source,
        })
    }
}
