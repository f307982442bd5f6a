//! A file whose syncs are waited for by a thread of its own, so that a slow disk never holds the recorder.

use crate::blocks::Sink;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// A disk that needs longer for a sync is said to be slow.
const SLOW: Duration = Duration::from_millis(500);
/// A disk that needs longer for a sync is said to refuse.
const PATIENCE: Duration = Duration::from_secs(8);
/// How long the end of a run waits for the disk.
const LAST_PATIENCE: Duration = Duration::from_secs(30);

#[derive(Default)]
struct State {
    /// Syncs asked for, and of these those that are over.
    asked: u64,
    done: u64,
    busy_since: Option<Instant>,
    slowest: Duration,
    failed: Option<io::Error>,
    closed: bool,
    ended: bool,
}

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    changed: Condvar,
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Waits until something holds, at most for a time; says whether it does.
    fn wait_until(&self, most: Duration, holds: impl Fn(&State) -> bool) -> bool {
        let (state, _) = self
            .changed
            .wait_timeout_while(self.lock(), most, |state| !holds(state))
            .unwrap_or_else(PoisonError::into_inner);
        holds(&state)
    }

    /// The thread: a sync whenever one was asked for, one for all that were asked for meanwhile.
    fn serve(&self, sync: impl Fn() -> io::Result<()>) {
        let mut state = self.lock();
        loop {
            if state.done < state.asked {
                let asked = state.asked;
                let from = Instant::now();
                state.busy_since = Some(from);
                drop(state);
                let synced = sync();
                state = self.lock();
                state.busy_since = None;
                state.slowest = state.slowest.max(from.elapsed());
                state.done = asked;
                if let Err(error) = synced {
                    state.failed.get_or_insert(error);
                }
                self.changed.notify_all();
            } else if state.closed {
                state.ended = true;
                self.changed.notify_all();
                return;
            } else {
                state = self
                    .changed
                    .wait(state)
                    .unwrap_or_else(PoisonError::into_inner);
            }
        }
    }
}

/// A file that is synced on a thread of its own. That a sync failed is said by the next one.
pub(crate) struct SyncedFile {
    file: File,
    /// Made with the first sync.
    shared: Option<Arc<Shared>>,
    slow_was_said: bool,
}

impl SyncedFile {
    pub(crate) fn new(file: File) -> Self {
        Self {
            file,
            shared: None,
            slow_was_said: false,
        }
    }

    /// The longest sync so far.
    pub(crate) fn slowest(&self) -> Duration {
        let Some(shared) = &self.shared else {
            return Duration::ZERO;
        };
        let state = shared.lock();
        let now = state.busy_since.map_or(Duration::ZERO, |at| at.elapsed());
        state.slowest.max(now)
    }

    fn started(&mut self) -> io::Result<&Arc<Shared>> {
        if self.shared.is_none() {
            let file = self.file.try_clone()?;
            self.start(move || file.sync_data())?;
        }
        self.shared
            .as_ref()
            .ok_or_else(|| io::Error::other("no thread for the disk"))
    }

    fn start(&mut self, sync: impl Fn() -> io::Result<()> + Send + 'static) -> io::Result<()> {
        let shared = Arc::new(Shared::default());
        let of_thread = Arc::clone(&shared);
        std::thread::Builder::new()
            .name("cellpos-sync".to_owned())
            .spawn(move || of_thread.serve(sync))?;
        self.shared = Some(shared);
        Ok(())
    }
}

impl Sink for SyncedFile {
    fn append(&mut self, bytes: &[u8]) -> io::Result<()> {
        self.file.write_all(bytes)
    }

    fn cut(&mut self, length: u64) -> io::Result<()> {
        self.file.set_len(length)?;
        self.file.seek(SeekFrom::Start(length)).map(|_| ())
    }

    fn sync(&mut self) -> io::Result<()> {
        let shared = self.started()?;
        let (failed, busy) = {
            let mut state = shared.lock();
            state.asked += 1;
            shared.changed.notify_all();
            let busy = state.busy_since.map_or(Duration::ZERO, |at| at.elapsed());
            (state.failed.take(), busy)
        };
        if let Some(error) = failed {
            return Err(error);
        }
        if busy > PATIENCE {
            let text = format!("the disk has not finished a write for {busy:.0?}");
            return Err(io::Error::new(io::ErrorKind::TimedOut, text));
        }
        if busy > SLOW && !std::mem::replace(&mut self.slow_was_said, true) {
            tracing::warn!(
                "the disk takes longer than {SLOW:.1?} for a write: a power failure now would cost more than the last second"
            );
        }
        Ok(())
    }

    fn settle(&mut self) -> io::Result<()> {
        let Some(shared) = &self.shared else {
            return self.file.sync_data();
        };
        if !shared.wait_until(LAST_PATIENCE, |state| state.done == state.asked) {
            let text = format!("the disk has not finished a write for {LAST_PATIENCE:.0?}");
            return Err(io::Error::new(io::ErrorKind::TimedOut, text));
        }
        shared.lock().failed.take().map_or(Ok(()), Err)
    }

    fn is_pending(&self) -> bool {
        self.shared.as_ref().is_some_and(|shared| {
            let state = shared.lock();
            state.done < state.asked
        })
    }

    fn is_there(&self) -> io::Result<()> {
        #[cfg(unix)]
        {
            use std::os::unix::fs::MetadataExt;
            if self.file.metadata()?.nlink() == 0 {
                return Err(io::Error::other(
                    "the file was removed while it was being written",
                ));
            }
        }
        Ok(())
    }
}

impl Drop for SyncedFile {
    /// The thread has the file open, and with it its lock: it is waited for, but not for a disk that hangs.
    fn drop(&mut self) {
        if let Some(shared) = &self.shared {
            shared.lock().closed = true;
            shared.changed.notify_all();
            shared.wait_until(PATIENCE, |state| state.ended);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    /// A file whose syncs begin, and end as the test says.
    fn held() -> (SyncedFile, Sender<io::Result<()>>, Receiver<()>) {
        let mut file = SyncedFile::new(tempfile::tempfile().unwrap());
        let (end, ends) = channel();
        let (began, begins) = channel();
        let ends = Mutex::new(ends);
        file.start(move || {
            let _ = began.send(());
            ends.lock().unwrap().recv().unwrap_or(Ok(()))
        })
        .unwrap();
        (file, end, begins)
    }

    #[test]
    fn a_sync_that_hangs_holds_nobody_and_those_asked_for_meanwhile_become_one() {
        let (mut file, end, begins) = held();
        file.sync().unwrap();
        begins.recv().unwrap();
        for _ in 0..5 {
            // Comes back although the first one hangs.
            file.append(b"row").unwrap();
            file.sync().unwrap();
            assert!(file.is_pending());
        }
        end.send(Ok(())).unwrap();
        begins.recv().unwrap();
        end.send(Ok(())).unwrap();
        file.settle().unwrap();
        assert!(!file.is_pending() && begins.try_recv().is_err());
    }

    #[test]
    fn a_sync_that_failed_is_said_once_by_the_next_or_at_the_end() {
        let (mut file, end, begins) = held();
        for at_the_end in [false, true] {
            file.sync().unwrap();
            begins.recv().unwrap();
            end.send(Err(io::Error::other("bad sector"))).unwrap();
            assert!(
                file.shared
                    .as_ref()
                    .unwrap()
                    .wait_until(LAST_PATIENCE, |state| state.done == state.asked)
            );
            let said = if at_the_end {
                file.settle()
            } else {
                file.sync()
            };
            assert_eq!(said.unwrap_err().to_string(), "bad sector");
            if !at_the_end {
                begins.recv().unwrap();
                end.send(Ok(())).unwrap();
            }
            file.settle().unwrap();
        }
    }

    #[test]
    fn without_a_sync_there_is_no_thread() {
        let mut file = SyncedFile::new(tempfile::tempfile().unwrap());
        file.append(b"row").unwrap();
        file.settle().unwrap();
        assert!(file.shared.is_none() && !file.is_pending());
        assert_eq!(file.slowest(), Duration::ZERO);
    }
}
