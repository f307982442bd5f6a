//! The use of the whole terminal for a view.

use std::collections::VecDeque;
use std::io::{self, Write};
use std::sync::atomic::{AtomicBool, Ordering};
use std::sync::mpsc::sync_channel;
use std::sync::{Arc, OnceLock};
use std::thread;
use std::time::Duration;

/// Takes the terminal: hides its content and the cursor.
const TAKE: &str = "\x1b[?1049h\x1b[?25l\x1b[2J\x1b[H";
/// Gives it back.
const GIVE: &str = "\x1b[0m\x1b[?25h\x1b[?1049l";
/// Most messages kept while a view uses it.
const KEPT: usize = 200;

/// Whether a view uses the terminal behind standard error.
static STDERR: OnceLock<Arc<AtomicBool>> = OnceLock::new();

/// Releases the terminal behind standard error if it is taken. For ends of the program that skip the normal path: a signal that
/// ends or stops it, a panic of the main thread. Waits no longer than a fifth of a second.
pub fn give_back() {
    let taken = STDERR.get();
    if !taken.is_some_and(|taken| taken.swap(false, Ordering::AcqRel)) {
        return;
    }
    let (done, written) = sync_channel(1);
    let writer = thread::Builder::new().spawn(move || {
        let mut out = io::stderr();
        let _ = out.write_all(GIVE.as_bytes()).and_then(|()| out.flush());
        let _ = done.send(());
    });
    if writer.is_ok() {
        let _ = written.recv_timeout(Duration::from_millis(200));
    }
}

/// The whole terminal as its own thread sees it.
#[derive(Debug, Default)]
pub(crate) struct Screen {
    open: bool,
    /// Whether a view still uses it: [`give_back`] may have released it.
    taken: Arc<AtomicBool>,
    kept: VecDeque<String>,
}

impl Screen {
    /// It is the one behind standard error.
    pub(crate) fn is_that_of_stderr(&self) {
        let _ = STDERR.set(Arc::clone(&self.taken));
    }

    pub(crate) fn is_open(&self) -> bool {
        self.open
    }

    pub(crate) fn open(&mut self, out: &mut impl Write) -> io::Result<()> {
        self.open = true;
        self.taken.store(true, Ordering::Release);
        out.write_all(TAKE.as_bytes()).and_then(|()| out.flush())
    }

    /// Shows a picture, unless the terminal was released meanwhile.
    pub(crate) fn draw(&self, out: &mut impl Write, picture: &str) -> io::Result<()> {
        if !self.open || !self.taken.load(Ordering::Acquire) {
            return Ok(());
        }
        out.write_all(picture.as_bytes()).and_then(|()| out.flush())
    }

    /// Keeps a message; drops the oldest if there are too many.
    pub(crate) fn keep(&mut self, text: &str) {
        if self.kept.len() == KEPT {
            self.kept.pop_front();
        }
        self.kept.push_back(text.to_string());
    }

    /// Releases the terminal; returns the messages kept meanwhile.
    pub(crate) fn close(&mut self, out: &mut impl Write) -> io::Result<VecDeque<String>> {
        if std::mem::take(&mut self.open) && self.taken.swap(false, Ordering::AcqRel) {
            out.write_all(GIVE.as_bytes()).and_then(|()| out.flush())?;
        }
        Ok(std::mem::take(&mut self.kept))
    }
}
