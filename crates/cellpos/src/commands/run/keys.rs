//! Keys while a script runs: p pauses and goes on, s skips, q stops; and the signals that do the same where there is no
//! keyboard.

use cellpos_runtime::Request;
use cellpos_runtime::live::Operator;
use rustix::termios::{self, LocalModes, OptionalActions, SpecialCodeIndex, Termios};
use signal_hook::consts::{SIGUSR1, SIGUSR2};
use signal_hook::iterator::{Handle, Signals};
use std::sync::Arc;
use std::sync::atomic::{AtomicBool, Ordering};
use std::thread::JoinHandle;

/// The keyboard while it is listened to; dropping it gives the terminal back as it was.
pub struct Keys {
    before: Termios,
    stop: Arc<AtomicBool>,
    thread: Option<JoinHandle<()>>,
}

/// Listens, if standard input is a terminal.
pub fn listen(operator: &Arc<Operator>) -> Option<Keys> {
    let stdin = rustix::stdio::stdin();
    if !termios::isatty(stdin) {
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
    let thread = std::thread::Builder::new()
        .name("cellpos-keys".to_string())
        .spawn({
            let (operator, stop) = (Arc::clone(operator), Arc::clone(&stop));
            move || {
                let mut key = [0u8; 1];
                while !stop.load(Ordering::Acquire) {
                    match rustix::io::read(rustix::stdio::stdin(), &mut key) {
                        Ok(1) => press(key[0], &operator),
                        Ok(_) => {}
                        Err(_) => std::thread::sleep(std::time::Duration::from_millis(100)),
                    }
                }
            }
        })
        .ok();
    Some(Keys {
        before,
        stop,
        thread,
    })
}

/// The signals while they are listened to.
pub struct Nudges {
    handle: Handle,
    thread: Option<JoinHandle<()>>,
}

/// Listens to signals: USR1 does what p does, USR2 what s does.
pub fn listen_to_signals(operator: &Arc<Operator>) -> std::io::Result<Nudges> {
    let mut signals = Signals::new([SIGUSR1, SIGUSR2])?;
    let handle = signals.handle();
    let operator = Arc::clone(operator);
    let thread = std::thread::Builder::new()
        .name("cellpos-signals".to_string())
        .spawn(move || {
            for signal in signals.forever() {
                press(if signal == SIGUSR1 { b'p' } else { b's' }, &operator);
            }
        })?;
    Ok(Nudges {
        handle,
        thread: Some(thread),
    })
}

impl Drop for Nudges {
    fn drop(&mut self) {
        self.handle.close();
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
    }
}

/// What a key does.
fn press(key: u8, operator: &Operator) {
    // Whichever of two requests holds; neither once a stop has been asked for.
    let toggle = |from, to, back| {
        let _ = operator.change(Request::None, to) || operator.change(from, back);
    };
    match key {
        b'p' | b' ' => toggle(Request::Pause, Request::Pause, Request::None),
        b's' => toggle(Request::Pause, Request::Skip, Request::Skip),
        b'q' => {
            operator.stop();
        }
        _ => {}
    }
}

impl Drop for Keys {
    fn drop(&mut self) {
        self.stop.store(true, Ordering::Release);
        if let Some(thread) = self.thread.take() {
            let _ = thread.join();
        }
        let _ = termios::tcsetattr(rustix::stdio::stdin(), OptionalActions::Now, &self.before);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn p_pauses_and_goes_on_s_skips_once_and_neither_undoes_a_stop() {
        let operator = Operator::default();
        press(b'p', &operator);
        assert_eq!(operator.take(), Request::Pause);
        assert_eq!(operator.take(), Request::Pause);
        press(b'p', &operator);
        assert_eq!(operator.take(), Request::None);
        press(b's', &operator);
        assert_eq!(operator.take(), Request::Skip);
        assert_eq!(operator.take(), Request::None);
        press(b'q', &operator);
        press(b'p', &operator);
        press(b's', &operator);
        assert_eq!(operator.take(), Request::Freeze);
        press(b'q', &operator);
        assert_eq!(operator.take(), Request::Park);
    }
}
