//! A file that grows only by whole blocks.

use std::collections::VecDeque;
use std::fs::{File, OpenOptions};
use std::io;
use std::path::Path;
use std::time::Duration;

/// Most bytes to keep while the disk refuses them: some minutes of a run.
const MOST_WAITING: usize = 1 << 26;

/// Opens a file for writing; refuses a symbolic link to another place.
pub(crate) fn open_here(options: &mut OpenOptions, path: &Path) -> io::Result<File> {
    #[cfg(unix)]
    {
        use std::os::unix::fs::OpenOptionsExt;
        options.custom_flags(rustix::fs::OFlags::NOFOLLOW.bits().cast_signed());
    }
    let file = options.open(path).map_err(|error| {
        if path.is_symlink() {
            io::Error::other("is a symbolic link; files of a run stay in its folder")
        } else {
            error
        }
    })?;
    if file.metadata()?.is_file() {
        Ok(file)
    } else {
        Err(io::Error::other("is not a plain file"))
    }
}

/// The operations of a file that the writer needs.
pub(crate) trait Sink {
    /// Appends all bytes, or fails, perhaps after a part.
    fn append(&mut self, bytes: &[u8]) -> io::Result<()>;
    /// Cuts the file to a length.
    fn cut(&mut self, length: u64) -> io::Result<()>;
    /// Syncs the file to the disk: now, or soon ([`Sink::awaited`]). In the second case the next sync reports the result.
    fn sync(&mut self) -> io::Result<()>;
    /// Waits for a pending sync, at most for a time; [`io::ErrorKind::TimedOut`] if it did not finish.
    fn settle(&mut self, most: Duration) -> io::Result<()> {
        let _ = most;
        Ok(())
    }
    /// Number of requested syncs, the newest ones, that are still pending.
    fn awaited(&self) -> u64 {
        0
    }
    /// Fails if the file was removed, so that nobody would find the data.
    fn is_there(&self) -> io::Result<()>;
}

/// A file with whole blocks only: a failed block is removed and waits for the next try.
pub(crate) struct Blocks<S> {
    sink: S,
    /// Length up to which the file is whole.
    good: u64,
    /// Whether bytes of a failed block may remain after `good`.
    torn: bool,
    /// Whether something was appended since the last sync.
    unsynced: bool,
    waiting: Vec<u8>,
    /// Rows, lines or events in `waiting`.
    waiting_units: u64,
    /// Rows, lines or events for which `waiting` had no room.
    dropped_units: u64,
    /// Rows, lines or events appended since the last sync.
    unsynced_units: u64,
    /// Rows, lines or events of each pending sync, the oldest first.
    pending: VecDeque<u64>,
    /// Rows, lines or events that the disk reported as lost.
    unkept_units: u64,
}

impl<S: Sink> Blocks<S> {
    pub(crate) fn new(sink: S, good: u64) -> Self {
        Self {
            sink,
            good,
            torn: false,
            unsynced: false,
            waiting: Vec::new(),
            waiting_units: 0,
            dropped_units: 0,
            unsynced_units: 0,
            pending: VecDeque::new(),
            unkept_units: 0,
        }
    }

    /// Takes a block of some rows, lines or events; it goes to the file with [`Blocks::write`].
    pub(crate) fn push(&mut self, bytes: &[u8], units: u64) {
        if self.waiting.len() + bytes.len() > MOST_WAITING {
            self.dropped_units += units;
        } else {
            self.waiting.extend_from_slice(bytes);
            self.waiting_units += units;
        }
    }

    /// Appends the waiting blocks, completely or not at all.
    pub(crate) fn write(&mut self) -> io::Result<()> {
        if self.waiting.is_empty() {
            return Ok(());
        }
        self.sink.is_there()?;
        if self.torn {
            self.sink.cut(self.good)?;
            self.torn = false;
        }
        if let Err(error) = self.sink.append(&self.waiting) {
            // Truncation needs no space, so it works on a full disk. If it fails, it is tried again before the next block.
            self.torn = self.sink.cut(self.good).is_err();
            return Err(error);
        }
        self.good += self.waiting.len() as u64;
        self.waiting.clear();
        self.unsynced_units += std::mem::take(&mut self.waiting_units);
        self.unsynced = true;
        Ok(())
    }

    /// Syncs appended data to the disk, if there are any.
    pub(crate) fn sync(&mut self) -> io::Result<()> {
        if !self.unsynced {
            return Ok(());
        }
        self.unsynced = false;
        self.pending
            .push_back(std::mem::take(&mut self.unsynced_units));
        let synced = self.sink.sync();
        self.account(synced)
    }

    /// Waits until the disk confirms the syncs, at most for a time. Rows without confirmation by then count as lost.
    pub(crate) fn settle(&mut self, most: Duration) -> io::Result<()> {
        let settled = self.sink.settle(most);
        if let Err(error) = &settled
            && error.kind() == io::ErrorKind::TimedOut
        {
            self.unkept_units += std::mem::take(&mut self.unsynced_units);
        }
        self.account(settled)
    }

    /// Rows, lines or events that this program has written but the disk has not confirmed.
    pub(crate) fn unconfirmed_units(&self) -> u64 {
        let awaited = self.awaited().min(self.pending.len());
        self.unsynced_units + self.pending.iter().rev().take(awaited).sum::<u64>()
    }

    fn awaited(&self) -> usize {
        usize::try_from(self.sink.awaited()).unwrap_or(usize::MAX)
    }

    /// Results of the syncs so far. A system that could not write reports it once and then drops the data.
    fn account(&mut self, synced: io::Result<()>) -> io::Result<()> {
        if synced.is_err() {
            self.unkept_units += self.pending.drain(..).sum::<u64>();
        }
        let confirmed = self.pending.len().saturating_sub(self.awaited());
        self.pending.drain(..confirmed);
        synced
    }

    /// The file to append to.
    pub(crate) fn sink(&self) -> &S {
        &self.sink
    }

    /// Whether the file still exists at its path.
    pub(crate) fn is_there(&self) -> io::Result<()> {
        self.sink.is_there()
    }

    /// Rows, lines or events that were taken but are not in the file, or that the disk reported as lost.
    pub(crate) fn lost(&self) -> u64 {
        self.waiting_units + self.dropped_units + self.unkept_units
    }

    /// Length up to which the file is whole.
    pub(crate) fn bytes(&self) -> u64 {
        self.good
    }

    /// Rows, lines or events that wait.
    pub(crate) fn waiting_units(&self) -> u64 {
        self.waiting_units
    }

    /// Bytes that wait.
    pub(crate) fn waiting_bytes(&self) -> usize {
        self.waiting.len()
    }
}
