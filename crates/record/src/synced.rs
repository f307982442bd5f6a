//! A file with syncs on a separate thread, so that a slow disk never blocks the recorder.
//!
//! [`SyncedFile::unconfirmed`] gives the time for which the disk has not confirmed a write. The run decides whether that is too
//! long; [`cellpos_runtime::recorder::Unconfirmed`] gives the reasons.

use crate::blocks::Sink;
use std::fs::File;
use std::io::{self, Seek, SeekFrom, Write};
use std::sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError};
use std::time::{Duration, Instant};

/// Longest wait for the disk at the end of a run.
pub(crate) const LAST_PATIENCE: Duration = Duration::from_secs(15);
/// A working disk with little to write answers within this time. A dropped file does not wait for its last sync.
pub(crate) const DISK_ANSWERS: Duration = Duration::from_secs(2);

#[derive(Default)]
struct State {
    /// Syncs requested, and syncs completed.
    asked: u64,
    done: u64,
    busy_since: Option<Instant>,
    /// Time of the request of a sync that waits for its turn.
    waiting_since: Option<Instant>,
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

    /// Waits until a condition holds, at most for a time; returns whether it does.
    fn wait_until(&self, most: Duration, holds: impl Fn(&State) -> bool) -> bool {
        let (state, _) = self
            .changed
            .wait_timeout_while(self.lock(), most, |state| !holds(state))
            .unwrap_or_else(PoisonError::into_inner);
        holds(&state)
    }

    /// The thread: one sync for all requests that have come meanwhile.
    fn serve(&self, sync: impl Fn() -> io::Result<()>) {
        let mut state = self.lock();
        loop {
            if state.done < state.asked {
                let asked = state.asked;
                let from = Instant::now();
                state.busy_since = Some(from);
                state.waiting_since = None;
                drop(state);
                let synced = sync();
                state = self.lock();
                state.busy_since = None;
                // Requests made meanwhile wait from now on: the disk has just shown that it works.
                if state.waiting_since.is_some() {
                    state.waiting_since = Some(Instant::now());
                }
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

/// A file that a separate thread syncs. The next sync reports a failed one.
pub(crate) struct SyncedFile {
    file: File,
    /// Made with the first sync.
    shared: Option<Arc<Shared>>,
}

impl SyncedFile {
    pub(crate) fn new(file: File) -> Self {
        Self { file, shared: None }
    }

    /// Time since the start of an unanswered sync. A request during a sync waits for the next one, so the unconfirmed rows may be
    /// older by the duration of the sync before.
    pub(crate) fn unconfirmed(&self) -> Duration {
        let Some(shared) = &self.shared else {
            return Duration::ZERO;
        };
        let state = shared.lock();
        let since = state.busy_since.or(state.waiting_since);
        since.map_or(Duration::ZERO, |at| at.elapsed())
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
        let mut state = shared.lock();
        state.asked += 1;
        state.waiting_since.get_or_insert_with(Instant::now);
        shared.changed.notify_all();
        state.failed.take().map_or(Ok(()), Err)
    }

    fn settle(&mut self, most: Duration) -> io::Result<()> {
        let shared = self.started()?;
        if shared.lock().asked == 0 {
            // Nothing was synced so far: a run on the virtual clock.
            shared.lock().asked = 1;
            shared.changed.notify_all();
        }
        if !shared.wait_until(most, |state| state.done == state.asked) {
            let text = format!("the disk did not confirm what was written within {most:.0?}");
            return Err(io::Error::new(io::ErrorKind::TimedOut, text));
        }
        shared.lock().failed.take().map_or(Ok(()), Err)
    }

    fn awaited(&self) -> u64 {
        self.shared.as_ref().map_or(0, |shared| {
            let state = shared.lock();
            state.asked - state.done
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
    /// The thread has the file open and so holds its lock: wait for the thread, unless the disk hangs.
    fn drop(&mut self) {
        if let Some(shared) = &self.shared {
            shared.lock().closed = true;
            shared.changed.notify_all();
            shared.wait_until(DISK_ANSWERS, |state| state.ended);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use std::sync::mpsc::{Receiver, Sender, channel};

    /// A file whose syncs begin and end under control of the test.
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
            assert!(file.awaited() > 0);
        }
        end.send(Ok(())).unwrap();
        begins.recv().unwrap();
        end.send(Ok(())).unwrap();
        file.settle(LAST_PATIENCE).unwrap();
        assert!(file.awaited() == 0 && begins.try_recv().is_err());
    }

    #[test]
    fn a_disk_that_answers_is_none_that_has_stopped_however_much_waits_for_it() {
        let (mut file, end, begins) = held();
        assert_eq!(file.unconfirmed(), Duration::ZERO);
        let first = Instant::now();
        file.sync().unwrap();
        begins.recv().unwrap();
        std::thread::sleep(Duration::from_millis(40));
        file.sync().unwrap();
        // The first one still runs.
        assert!(file.unconfirmed() >= Duration::from_millis(40));
        assert!(file.unconfirmed() <= first.elapsed());
        let second = Instant::now();
        end.send(Ok(())).unwrap();
        begins.recv().unwrap();
        // The disk has answered, so its time restarts, although the present sync was requested earlier.
        assert!(file.unconfirmed() <= second.elapsed());
        end.send(Ok(())).unwrap();
        file.settle(LAST_PATIENCE).unwrap();
        assert_eq!(file.unconfirmed(), Duration::ZERO);
    }

    #[test]
    fn a_disk_that_never_answers_is_not_waited_for_longer_than_said() {
        let (mut file, _end, begins) = held();
        file.sync().unwrap();
        begins.recv().unwrap();
        let given_up = file.settle(Duration::from_millis(20)).unwrap_err();
        assert_eq!(given_up.kind(), io::ErrorKind::TimedOut);
        assert!(file.unconfirmed() >= Duration::from_millis(20));
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
                file.settle(LAST_PATIENCE)
            } else {
                file.sync()
            };
            assert_eq!(said.unwrap_err().to_string(), "bad sector");
            if !at_the_end {
                begins.recv().unwrap();
                end.send(Ok(())).unwrap();
            }
            file.settle(LAST_PATIENCE).unwrap();
        }
    }

    #[test]
    fn without_a_sync_there_is_no_thread() {
        let mut file = SyncedFile::new(tempfile::tempfile().unwrap());
        file.append(b"row").unwrap();
        assert!(file.shared.is_none() && file.awaited() == 0);
        assert_eq!(file.slowest(), Duration::ZERO);
    }
}
