//! Single keys from the terminal, without echo, in the background.

use rustix::termios::{self, LocalModes, OptionalActions, SpecialCodeIndex, Termios};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

/// The keyboard while it is listened to; dropping it gives the terminal back as it was.
pub(crate) struct Keyboard {
    before: Termios,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Passes typed bytes to `on_keys` on a separate thread, as many as came at once (an arrow key is several bytes). Only if
/// standard input is a terminal and this program is in its foreground: the system stops a background program that touches the
/// terminal, and a stopped program cannot hold a bead.
pub(crate) fn listen(mut on_keys: impl FnMut(&[u8]) + Send + 'static) -> Option<Keyboard> {
    let stdin = rustix::stdio::stdin();
    if !termios::isatty(stdin) {
        return None;
    }
    if termios::tcgetpgrp(stdin).ok() != Some(rustix::process::getpgrp()) {
        return None;
    }
    let before = termios::tcgetattr(stdin).ok()?;
    let mut raw = before.clone();
    // Single keys without echo; Ctrl-C stays a signal. A read gives up after a tenth of a second.
    raw.local_modes
        .remove(LocalModes::ICANON | LocalModes::ECHO);
    raw.special_codes[SpecialCodeIndex::VMIN] = 0;
    raw.special_codes[SpecialCodeIndex::VTIME] = 1;
    termios::tcsetattr(stdin, OptionalActions::Now, &raw).ok()?;
    let stop = Arc::new(AtomicBool::new(false));
    let asked = Arc::clone(&stop);
    let thread = std::thread::Builder::new()
        .name("cellpos-keys".to_string())
        .spawn(move || {
            let mut keys = [0u8; 32];
            while !asked.load(Ordering::Acquire) {
                match rustix::io::read(rustix::stdio::stdin(), &mut keys) {
                    Ok(count) => on_keys(keys.get(..count).unwrap_or(&[])),
                    Err(_) => std::thread::sleep(std::time::Duration::from_millis(100)),
                }
            }
        })
        .ok();
    Some(Keyboard {
        before,
        stop,
        thread,
    })
}

impl Drop for Keyboard {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        let _ = termios::tcsetattr(rustix::stdio::stdin(), OptionalActions::Now, &self.before);
    }
}
